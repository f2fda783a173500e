"""No answer is passed on unchecked, and whatever a backend does, others take over."""

from __future__ import annotations

import time
from dataclasses import replace
from importlib import import_module

import numpy as np
import pytest
from numpy.testing import assert_allclose
from problems_qp import epigraph

from qp_backends import BackendError, Problem, Solution, Status, accuracy, registry, solve
from qp_backends.certificates import proof
from qp_backends.judge import NEAR
from qp_backends.problem import nothing


@pytest.fixture
def problem():
    return epigraph(np.random.default_rng(0), 12, 9)


@pytest.fixture
def truth(problem):
    return solve(problem, "clarabel", tolerance=1e-9)


@pytest.fixture
def own(monkeypatch):
    """Register a backend for one test only."""
    monkeypatch.setattr(registry, "_registered", {})
    return registry.register


def killed(problem, note):
    raise RuntimeError(note)


def test_a_wrong_solved_is_found_out_and_the_fallback_takes_over(problem, truth, own):
    own("liar", lambda p: replace(truth, x=truth.x + 1.0, status=Status.SOLVED))
    solution = solve(problem, "liar")
    assert solution.status is Status.SOLVED
    assert solution.backend == "daqp"
    assert_allclose(solution.x, truth.x, rtol=0, atol=1e-6)
    assert len(solution.notes) == 1
    assert solution.notes[0].startswith("liar said solved, its relative residual is")


def test_without_a_fallback_a_wrong_solved_is_called_inaccurate(problem, truth, own):
    own("liar", lambda p: (truth.x + 1.0, truth.y))
    solution = solve(problem, "liar", fallback=False)
    assert solution.status is Status.INACCURATE
    assert solution.backend == "liar"
    assert not solution.solved
    assert solution.residual == accuracy(problem, solution).worst > NEAR


def test_an_accurate_answer_counts_whatever_the_backend_says(problem, truth, own):
    own("modest", lambda p: replace(truth, status=Status.FAILED))
    solution = solve(problem, "modest")
    assert solution.status is Status.SOLVED
    assert solution.backend == "modest"
    assert solution.notes == ()


def test_a_nearly_right_answer_is_polished_and_the_note_says_so(problem, truth, own):
    rng = np.random.default_rng(1)
    own("rough", lambda p: (truth.x * (1 + 1e-5 * rng.normal(size=12)), truth.y))
    solution = solve(problem, "rough", fallback=False)
    assert solution.solved
    assert solution.residual < 1e-10
    assert "improved to" in solution.notes[0]


def test_a_backend_is_asked_again_at_a_tighter_tolerance(problem, truth, own):
    asked = []

    def careless(p, tolerance):
        asked.append(tolerance)
        return truth.x + 1e9 * tolerance * np.arange(12), truth.y

    own("careless", careless)
    assert solve(problem, "careless", tolerance=1e-7, fallback=False).solved is False
    assert asked == [1e-7, pytest.approx(1e-10)]


@pytest.mark.parametrize(
    ("answer", "said"),
    [
        (lambda p: killed(p, "out of order"), "raised RuntimeError: out of order"),
        (lambda p: (np.full(12, np.nan), np.full(9, np.nan)), "said solved, it gave no x"),
        (lambda p: (np.zeros(3), np.zeros(9)), "said solved, it gave no x"),
        (lambda p: None, "raised TypeError"),
        (lambda p: nothing(p, Status.ITERATION_LIMIT), "said iteration_limit, it gave no x"),
        (lambda p: nothing(p, Status.TIME_LIMIT), "said time_limit, it gave no x"),
        (lambda p: nothing(p, Status.INFEASIBLE), "said infeasible, it gave no x"),
        (lambda p: nothing(p, Status.UNBOUNDED), "said unbounded, it gave no x"),
    ],
)
def test_whatever_a_backend_does_the_next_one_answers(problem, truth, own, answer, said):
    own("broken", answer)
    solution = solve(problem, "broken")
    assert solution.status is Status.SOLVED
    assert solution.backend == "daqp"
    assert_allclose(solution.x, truth.x, rtol=0, atol=1e-6)
    assert said in solution.notes[0]
    alone = solve(problem, "broken", fallback=False)
    assert not alone.solved
    assert alone.status not in (Status.INFEASIBLE, Status.UNBOUNDED)  # it is neither
    assert alone.x.shape == (12,)


def test_a_panic_that_is_no_exception_is_survived_but_ctrl_c_is_not(problem, own):
    class Panic(BaseException):
        pass

    def panicking(p):
        raise Panic("index out of bounds")

    def interrupted(p):
        raise KeyboardInterrupt

    own("panicking", panicking)
    own("interrupted", interrupted)
    assert solve(problem, "panicking").solved
    with pytest.raises(KeyboardInterrupt):
        solve(problem, "interrupted")


def test_a_built_in_backend_can_be_replaced_and_so_be_killed(problem, own):
    own("daqp", lambda p: killed(p, "gone"))
    solution = solve(problem)
    assert solution.solved
    assert solution.backend == "quadprog"
    assert "gone" in solution.notes[0]


def test_the_users_own_order_is_kept(problem, own):
    own("first", lambda p: killed(p, "one"))
    own("second", lambda p: killed(p, "two"))
    solution = solve(problem, "first", fallback=("second", "no such thing", "osqp"))
    assert solution.backend == "osqp"
    assert [note.split()[0] for note in solution.notes[:2]] == ["first", "second"]
    assert "no QP backend 'no such thing'" in solution.notes[2]


def test_when_all_fail_the_best_answer_comes_back_with_all_reasons(problem, truth, own):
    own("bad", lambda p: (truth.x + 0.5, truth.y))
    own("worse", lambda p: (truth.x + 9.0, truth.y))
    solution = solve(problem, "worse", fallback=("bad",))
    assert solution.status is Status.INACCURATE
    assert solution.backend == "bad"
    assert len(solution.notes) == 2


def test_a_backend_that_uses_up_its_time_leaves_the_others_theirs(problem, own):
    def slow(p, time_limit):
        time.sleep(time_limit)
        return nothing(p, Status.TIME_LIMIT)

    own("slow", slow)
    start = time.perf_counter()
    solution = solve(problem, "slow", time_limit=4.0)
    assert solution.solved
    assert solution.backend == "daqp"
    assert time.perf_counter() - start < 4.0
    alone = solve(problem, "slow", time_limit=0.1, fallback=False)
    assert alone.status is Status.TIME_LIMIT
    assert 0.1 <= alone.seconds < 2.0


def test_every_solve_tells_its_time_and_statuses_tell_what_to_try(problem):
    assert 0 < solve(problem).seconds < 1
    for status in Status:
        if status is not Status.SOLVED:
            assert ": " in status.value
            assert any(word in status.value for word in ("try", "loosen", "relax", "bound"))


def test_a_mistake_in_the_name_is_raised(problem):
    with pytest.raises(BackendError, match="did you mean 'quadprog'"):
        solve(problem, "quadprogg")


def test_proofs_are_not_found_where_there_are_none(problem):
    assert proof(problem)[0] is Status.FAILED
    free = Problem(np.eye(2), np.ones(2), np.zeros((0, 2)), [], [])
    assert proof(free)[0] is Status.FAILED


def test_crossed_bounds_are_named_by_the_certificate():
    crossed = Problem(np.eye(2), np.ones(2), np.eye(2), [0.0, 2.0], [1.0, 1.0])
    solution = solve(crossed)
    assert solution.status is Status.INFEASIBLE
    np.testing.assert_array_equal(solution.certificate, [0.0, 1.0])


@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e6])
def test_rows_that_miss_each_other_by_little_are_still_contradictory(scale):
    """x ≤ 1 and x ≥ 1 + 1e-4, in any units."""
    A, bounds = scale * np.array([[1.0], [1.0]]), scale * np.array([1.0, 1.0001])
    problem = Problem([[1.0]], [0.0], A, [-np.inf, bounds[1]], [bounds[0], np.inf])
    assert solve(problem).status is Status.INFEASIBLE


def test_rounding_of_a_bound_is_no_contradiction():
    """x1 + x2 = 0 and 2 (x1 + x2) = 1e-16, in a box of 1."""
    rows = np.vstack([[1.0, 1.0], [2.0, 2.0], np.eye(2)])
    low, high = np.array([0.0, 1e-16, -1.0, -1.0]), np.array([0.0, 1e-16, 1.0, 1.0])
    problem = Problem(np.eye(2), [1.0, -1.0], rows, low, high)
    assert proof(problem)[0] is Status.FAILED
    solution = solve(problem)
    assert solution.solved
    assert_allclose(solution.x, [-1.0, 1.0], rtol=1e-12)


def test_an_unbounded_objective_over_contradictory_rows_is_infeasible():
    problem = Problem([[0.0]], [1.0], [[0.0], [0.0]], [1.0, -np.inf], [np.inf, 2.0])
    assert solve(problem).status is Status.INFEASIBLE


def test_a_solution_is_returned_as_float_arrays(problem, own):
    own("lists", lambda p: Solution([0] * 12, [0] * 9, Status.SOLVED, 0.0))
    solution = solve(problem, "lists", fallback=False)
    assert solution.x.dtype == solution.y.dtype == np.float64


def test_no_answer_is_judged_twice(problem, truth, own, monkeypatch):
    """One that is right after polishing, and one that is wrong before another takes over."""
    judge, polishing = (import_module(f"qp_backends.{name}") for name in ("judge", "polish"))
    seen = []

    def counted(given, solution):
        seen.append(solution.x.tobytes() + solution.y.tobytes())
        return accuracy(given, solution)

    monkeypatch.setattr(judge, "accuracy", counted)
    monkeypatch.setattr(polishing, "accuracy", counted)
    own("rough", lambda p: (truth.x + 1e-6, truth.y))
    assert solve(problem, "rough").backend == "rough"
    assert len(seen) == len(set(seen)) == 2
    seen.clear()
    own("wrong", lambda p: replace(truth, x=truth.x + 1.0, status=Status.ITERATION_LIMIT))
    assert solve(problem, "wrong").backend == "daqp"
    assert len(seen) == len(set(seen))
