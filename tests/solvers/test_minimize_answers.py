"""`minimize_max` says success only at an optimum, whatever the start, in closed form."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.optimize import Bounds, LinearConstraint, NonlinearConstraint, linprog

import minimax_cal as mc
from qp_backends import solve as solve_qp

FACTORS = [1.0, 1e3, 1e6, 1e9]


def opposed_exponentials(x):
    return np.array([np.exp(x[0]), np.exp(-x[0])])


@pytest.mark.parametrize("start", [20.0, 50.0, 100.0, 300.0, 600.0])
def test_functions_that_grow_fast_are_followed_to_the_optimum(start):
    """Of max(e^x, e^-x) the least is 1; at the start it is up to 1e260."""
    found = mc.minimize_max(opposed_exponentials, [start])
    assert found.success
    assert_allclose(found.fun, 1.0, rtol=1e-6)


SQUARES = np.arange(1, 11)
FAR = {  # functions, start, least value
    "fourth powers": (lambda x: np.array([x[0] ** 4, (x[0] - 1.0) ** 4]), [1.0], 0.0625),
    "parabola and line": (lambda x: np.array([(x[0] - 3.0) ** 2 + 1.0, 2.0 - x[0]]), [1.0], 1.0),
    "a square of value 0": (lambda x: np.array([(x[0] - 1.0) ** 2]), [3.0], 0.0),
    "ten squares of value 0": (
        lambda x: (x[0] - 1.0) ** 2 + (x[1] + 2.0) ** 2 * SQUARES,
        [3.0, 3.0],
        0.0,
    ),
    "two lines": (lambda x: np.array([x[0] + x[1], -x[0], 1.0 - x[1]]), [1.0, 2.0], 1.0 / 3.0),
}


@pytest.mark.parametrize("jac", ["2-point", "cs"])
@pytest.mark.parametrize("factor", FACTORS)
@pytest.mark.parametrize("name", FAR)
def test_a_far_start_does_not_loosen_the_tolerance(name, factor, jac):
    fun, start, least = FAR[name]
    found = mc.minimize_max(fun, factor * np.array(start), jac=jac)
    assert found.success, found.message
    assert_allclose(found.fun, least, rtol=1e-6, atol=1e-12)


@pytest.mark.parametrize("unit", [1e-300, 1e-150, 1e150])
def test_values_of_any_size_are_minimised(unit):
    """max((x - 3)^2 + 1, 2 - x) is 1 at 3; and (x + y)^2 + (x - 1)^2 with a second like it."""
    fun = FAR["parabola and line"][0]
    for jac in ("2-point", "cs"):
        found = mc.minimize_max(lambda x: unit * fun(x), [40.0], jac=jac)
        assert found.success, found.message
        assert_allclose(found.fun / unit, 1.0, rtol=1e-6)


@pytest.mark.parametrize("offset", [1e8, 1e12])
def test_a_number_added_to_all_functions_moves_the_optimum_by_rounding_only(offset):
    """max((x - 1)^2, (x + 1)^2 + 1) is (5/4)^2 at -1/4."""
    found = mc.minimize_max(
        lambda x: offset + np.array([(x[0] - 1.0) ** 2, (x[0] + 1.0) ** 2 + 1.0]), [0.9], jac="cs"
    )
    assert found.success
    assert_allclose(found.fun - offset, 25.0 / 16.0, atol=1e2 * np.spacing(offset))
    assert "are rounded to" in found.message or offset < 1e9


def test_a_start_at_a_kink_of_two_offset_lines_is_left():
    """max(1e8 + x, 1e8 - x) from .9: its relative error there is below the tolerance."""
    found = mc.minimize_max(lambda x: 1e8 + np.array([x[0], -x[0]]), [0.9], jac="cs")
    assert found.success
    assert abs(found.x[0]) < 1e-6


@pytest.mark.parametrize("factor", FACTORS)
def test_contradicting_equalities_are_infeasible_from_any_start(factor):
    rows = LinearConstraint(np.ones((2, 2)), [1.0, 1.01], [1.0, 1.01])
    found = mc.minimize_max(
        lambda x: np.concatenate([x, -x]), factor * np.ones(2), constraints=rows
    )
    assert (found.success, found.status) == (False, "infeasible")


@pytest.mark.parametrize("width", [1.0, 1e-8, 1e-12])
def test_bounds_are_held_in_their_own_units(width):
    """Three variables between 0 and the width: their sum is never six widths, but may be two."""
    for asked, status in ((6.0, "infeasible"), (2.0, "converged")):
        found = mc.minimize_max(
            lambda x: np.array([x.sum() - 1.0, -x[0]]),
            np.zeros(3),
            bounds=[(0.0, width)] * 3,
            constraints=LinearConstraint(np.ones((1, 3)), asked * width, np.inf),
        )
        assert found.status == status
        assert found.success == (status == "converged")
        if found.success:  # of all sums from two widths on, x_0 = width makes -x_0 smallest
            assert_allclose(found.x.sum(), 2.0 * width, atol=3.0 * width)
            assert found.violation <= 1e-6 * width


def test_a_disc_and_a_half_plane_that_do_not_meet_are_infeasible():
    disc = NonlinearConstraint(lambda x: x @ x, -np.inf, 1.0)
    for distance, status in ((1.5, "infeasible"), (0.5, "converged")):
        half_plane = LinearConstraint([[1.0, 0.0]], distance, np.inf)
        for start in ([0.0, 0.0], [1e3, -1e3]):
            found = mc.minimize_max(
                lambda x: np.array([x[1], x[0] - 4.0]), start, constraints=[disc, half_plane]
            )
            assert found.status == status
    assert_allclose(found.fun, -np.sqrt(0.75), rtol=1e-6)


@pytest.mark.parametrize(
    ("fun", "constraints"),
    [
        (lambda x: np.array([x[0] - x[1], 2.0 * (x[0] - x[1])]), ()),
        (lambda x: np.array([-x[0] - x[1]]), LinearConstraint([[1.0, -1.0]], 0.0, 0.0)),
        (lambda x: np.array([-np.log(x[0])]), LinearConstraint([[1.0, 0.0]], 1.0, np.inf)),
        (lambda x: np.array([-np.sqrt(np.abs(x[0]) + 1.0)]), ()),
    ],
    ids=["lines", "along an equality", "a logarithm", "a root"],
)
def test_what_falls_without_end_along_a_line_is_unbounded(fun, constraints):
    found = mc.minimize_max(fun, [2.0, 2.0], constraints=constraints)
    assert (found.success, found.status) == (False, "unbounded")


def test_infinite_values_on_the_way_end_in_a_status_or_are_avoided():
    """log and root have no value below 0, e^(e^x) none far off; each least is known."""
    cases = [
        (lambda x: np.array([x[0] - np.log(x[0])]), [1e5], 1.0),
        (lambda x: np.array([np.sqrt(x[0]), 1.0 / x[0]]), [1e-5], 1.0),
        (lambda x: np.array([np.exp(np.exp(x[0])), -x[0]]), [5.0], None),
        (lambda x: np.where(x[0] > 2.0, np.inf, [(x[0] - 3.0) ** 2, x[0]]), [0.0], None),
    ]
    for fun, start, least in cases:
        found = mc.minimize_max(fun, start)
        if least is None:
            assert isinstance(found.success, bool)
        else:
            assert found.success
            assert_allclose(found.fun, least, rtol=1e-6)


def test_a_function_may_return_its_own_buffer():
    """max((x - 1)^2 + 1/4, (x + 1)^2 - 1): equal at x = 5/16."""
    buffer = np.zeros(2)

    def shared(x):
        buffer[:] = (x[0] - 1.0) ** 2 + 0.25, (x[0] + 1.0) ** 2 - 1.0
        return buffer

    for jac in ("2-point", "3-point"):
        found = mc.minimize_max(shared, [3.0], jac=jac)
        assert found.success
        assert_allclose(found.fun, (11.0 / 16.0) ** 2 + 0.25, rtol=1e-7)


BOX = Bounds(-np.ones(4), np.ones(4))


@pytest.mark.parametrize(
    "constraints",
    [
        {"bounds": BOX, "constraints": [{"type": "ineq", "fun": lambda x: x - 0.5}]},
        {
            "constraints": [
                {"type": "ineq", "fun": lambda x: x - 0.5},
                {"type": "ineq", "fun": lambda x: 2.0 - x},
            ]
        },
        {"bounds": BOX, "constraints": [NonlinearConstraint(lambda x: x, 0.5, np.inf)]},
        {"bounds": BOX, "constraints": [{"type": "eq", "fun": lambda x: x[:2] - 0.5}]},
        {"constraints": LinearConstraint(np.eye(4), 0.5, [2.0])},
    ],
    ids=["dictionary and bounds", "two dictionaries", "scalar ends", "equality", "linear"],
)
def test_constraints_of_several_rows_with_scalar_ends_stand_beside_others(constraints):
    """max(x - 1, -x - 1) over x of .5 or more is -.5."""
    found = mc.minimize_max(
        lambda x: np.concatenate([x - 1.0, -x - 1.0]), np.zeros(4), **constraints
    )
    assert found.success
    assert_allclose(found.fun, -0.5, atol=1e-7)


def test_ends_of_a_constraint_that_fit_no_row_are_named():
    with pytest.raises(mc.OptionError, match="of 4 rows has 3 lower and 1 upper ends"):
        mc.minimize_max(
            lambda x: x, np.zeros(4), constraints=NonlinearConstraint(lambda x: x, np.zeros(3), 1.0)
        )


def test_a_battery_shaves_the_peak_that_linprog_shaves():
    """48 steps of a load, 3 kWh and .8 kW."""
    rng, steps = np.random.default_rng(3), 48
    load = 2.0 + np.sin(np.arange(steps) / steps * 4.0 * np.pi) + 0.3 * rng.normal(size=steps)
    sums = np.tril(np.ones((steps, steps)))
    peak = np.ones((steps, 1))
    best = linprog(
        np.r_[np.zeros(steps), 1.0],
        np.block([[np.eye(steps), -peak], [sums, 0.0 * peak], [-sums, 0.0 * peak]]),
        np.r_[-load, np.full(steps, 3.0), np.zeros(steps)],
        bounds=[(-0.8, 0.8)] * steps + [(None, None)],
    ).fun
    found = mc.minimize_max(
        lambda x: load + x,
        np.zeros(steps),
        bounds=Bounds(np.full(steps, -0.8), np.full(steps, 0.8)),
        constraints=[
            {"type": "ineq", "fun": lambda x: 3.0 - sums @ x, "jac": lambda x: -sums},
            {"type": "ineq", "fun": lambda x: sums @ x, "jac": lambda x: sums},
        ],
    )
    assert found.success
    assert_allclose(found.fun, best, rtol=1e-7)


def pair(x):
    return np.array([(x[0] - 1.0) ** 2 + x[1] ** 2, (x[0] + 1.0) ** 2 + x[1] ** 2 + 1.0])


@pytest.mark.parametrize("form", ["x", "x and y", "solution"])
def test_a_function_of_ones_own_solves_the_qps(form):
    """It returns x, x with multipliers, or a Solution; the optimum is (5/4)^2 with x = -1/4."""

    def own(problem):
        answer = solve_qp(problem, "daqp", tolerance=1e-12)
        return {"x": answer.x, "x and y": (answer.x, answer.y), "solution": answer}[form]

    bounds = [(-0.1, None), (0.5, 2.0)]  # the optimum is at (-.1, .5) then
    for box, least in ((None, 25.0 / 16.0), (bounds, 0.9**2 + 1.25)):
        found = mc.minimize_max(pair, [3.0, 1.0], qp=own, bounds=box)
        assert found.success, found.message
        assert_allclose(found.fun, least, rtol=1e-8)


@pytest.mark.parametrize("answer", ["text", np.zeros(2), (np.zeros(3), np.zeros(1)), object()])
def test_a_qp_function_that_returns_something_else_is_named(answer):
    with pytest.raises(mc.OptionError, match="qp is to return x"):
        mc.minimize_max(pair, [3.0, 1.0], qp=lambda problem: answer)


@pytest.mark.parametrize("answer", [None, np.full(3, np.nan)])
def test_a_qp_function_without_an_answer_ends_in_a_status(answer):
    found = mc.minimize_max(pair, [3.0, 1.0], qp=lambda problem: answer)
    assert (found.success, found.status) == (False, "failed")


def test_no_functions_at_all_are_refused():
    with pytest.raises(mc.OptionError, match="fun\\(x0\\) is empty"):
        mc.minimize_max(lambda x: np.zeros(0), [1.0])


def test_the_result_has_one_entry_of_history_a_qp():
    found = mc.minimize_max(pair, [3.0, 1.0])
    assert len(found.history) == found.nit
    assert found.history[0].value == pytest.approx(pair([3.0, 1.0]).max(), rel=1e-12)
    assert found.history[-1].value == pytest.approx(found.fun, rel=1e-6)
    assert {"value", "violation", "kkt", "step"} == set(found.history[0])


@pytest.mark.parametrize("stiffness", [1e5, 1e10, 1e20, 1e200])
def test_the_end_of_a_stiff_curved_valley_is_no_optimum(stiffness):
    """max(s (x^2 + y^2 - 1), ((x - 3)^2 + y^2) / 1000): the least is .004 at (1, 0), all along a
    circle on which each function alone changes s times as fast as both together."""
    found = mc.minimize_max(
        lambda x: np.array([stiffness * (x @ x - 1.0), 1e-3 * ((x[0] - 3.0) ** 2 + x[1] ** 2)]),
        [2.0, 2.0],
        jac=lambda x: np.array([2.0 * stiffness * x, 2e-3 * np.array([x[0] - 3.0, x[1]])]),
    )
    assert found.success == (abs(found.fun - 0.004) < 1e-8)
    assert found.success or stiffness > 1e5


@pytest.mark.parametrize("jac", ["2-point", "3-point", "cs"])
@pytest.mark.parametrize("edge", [np.nan, np.inf])
def test_a_start_at_the_edge_of_the_domain_is_left(edge, jac):
    """(x + 2)^2 + 1 without a value beyond 1, where the search begins."""
    found = mc.minimize_max(
        lambda x: np.array([(x[0] + 2.0) ** 2 + 1.0 if x[0].real <= 1.0 else edge]), [1.0], jac=jac
    )
    assert found.success
    assert_allclose(found.fun, 1.0, rtol=1e-6)


def test_rows_that_are_nearly_equal_show_no_optimum():
    """x + y on a circle that is given twice, by differences of two kinds: multipliers of 1e7
    balance any gradient by the differences of the rows' rounding."""
    circles = [
        NonlinearConstraint(lambda x: x @ x * np.array([1.0, 2.0]), [1.0, 2.0], [1.0, 2.0], jac=jac)
        for jac in ("2-point", "3-point")
    ]
    found = mc.minimize_max(
        lambda x: np.array([x.sum()]), [-3.0, 1.0], jac=lambda x: np.ones((1, 2)),
        constraints=circles,
    )  # fmt: skip
    assert found.success == (abs(found.fun + np.sqrt(2.0)) < 1e-6)


def test_what_meets_a_far_bound_or_falls_ever_less_is_not_unbounded():
    disc = NonlinearConstraint(lambda x: x @ x, -np.inf, 1e16)
    found = mc.minimize_max(lambda x: np.array([-x[0]]), [1.0, 1.0], jac="cs", constraints=disc)
    assert found.status != "unbounded"
    found = mc.minimize_max(lambda x: np.array([1.0 / x[0]]), [1.0], bounds=[(1.0, None)])
    assert found.status != "unbounded"
    assert found.fun >= 0.0


@pytest.mark.parametrize("maxiter", [1, 2, 4, 8, 20, 30])
@pytest.mark.parametrize(
    "start", [[2.7878, -59.7546], [-781.3330, 348.5631], [56.8972, -238.1249], [0.0, 50.0]]
)
def test_a_feasible_problem_is_never_called_infeasible_for_want_of_qps(start, maxiter):
    """A ring crossed by a wave, from far off: QPs that seek a point of both count as others."""
    ring = NonlinearConstraint(lambda x: x @ x, 1.0, 1.0001)
    wave = NonlinearConstraint(lambda x: np.array([np.sin(3.0 * x[0]) - x[1]]), 0.0, 0.0)
    found = mc.minimize_max(
        lambda x: np.array([x[1], x[0] - 4.0]), start, constraints=[ring, wave], maxiter=maxiter
    )
    assert found.status != "infeasible"
    assert len(found.history) <= found.nit <= maxiter
