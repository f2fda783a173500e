import json
from dataclasses import replace
from functools import partial
from pathlib import Path

import cvxpy as cp
import numpy as np
import pytest
from numpy.testing import assert_allclose

import minimax_cal as mc
from minimax_cal.cli import main
from minimax_cal.fitting import solve
from minimax_cal.fitting.calibrate import calibrate
from minimax_cal.fitting.certificate import PointCones
from minimax_cal.fitting.minimax_problem import MinimaxProblem
from minimax_cal.judging.tradeoff import (
    Blend,
    Tradeoff,
    problem_of,
    tradeoff,
)
from minimax_cal.modelling.cell import cell_from_dict
from minimax_cal.modelling.parameters import State
from minimax_cal.modelling.simulate import Simulation, simulate
from minimax_cal.reporting.plots.tradeoff import save_tradeoff
from minimax_cal.solvers import minimax
from minimax_cal.solvers.status import Status
from qp_backends import solve as solve_qp


@pytest.fixture(scope="module")
def found(robot: mc.Robot, noisy: Simulation) -> Tradeoff:
    return tradeoff(robot, noisy.data, 5)


def test_the_ends_are_sum_and_point(found: Tradeoff, robot: mc.Robot, noisy: Simulation) -> None:
    for choice, objective in ((found.choices[0], "sum"), (found.choices[-1], "point")):
        fit = calibrate(robot, noisy.data, objective)
        assert choice.objective == objective
        assert choice.train == fit.accuracy["train"]
        assert choice.holdout == fit.accuracy["holdout"]
        assert_allclose(choice.cell.target_positions, fit.cell.target_positions, rtol=0, atol=1e-15)


def test_the_rms_grows_and_the_largest_error_falls(found: Tradeoff) -> None:
    assert len(found.choices) == 7
    assert found.status is Status.CONVERGED
    assert np.all(np.diff([c.train.rms_mm for c in found.choices]) > 0)
    assert np.all(np.diff([c.train.max_mm for c in found.choices]) < 0)
    assert np.all(np.diff([c.share for c in found.choices]) < 0)


def test_no_choice_beats_another_at_its_own_share(found: Tradeoff) -> None:
    """Each minimises (1 - w) max^2 + w RMS^2 among all of them: the curve is convex."""
    rms = np.array([c.train.rms_mm for c in found.choices]) ** 2
    most = np.array([c.train.max_mm for c in found.choices]) ** 2
    for number, choice in enumerate(found.choices):
        level = (1.0 - choice.share) * most + choice.share * rms
        assert level[number] <= level.min() * (1 + 1e-9)


def small(robot: mc.Robot, share_of_missing: float = 0.0, **columns: np.ndarray) -> mc.Measurements:
    data = simulate(robot, 40, 2, seed=3).data
    gone = np.random.default_rng(1).uniform(size=data.y.shape[:2]) < share_of_missing
    gone[:, 0] &= ~gone[:, 1]  # one target is left at every pose
    return replace(
        data.with_y(np.where(gone[..., None], np.nan, data.y)), columns={**data.columns, **columns}
    )


def cvxpy_blend(worst: MinimaxProblem, x: State, share: float) -> float:
    """The same compromise by a sequence of cone programs with cvxpy."""
    cones = PointCones.of(worst)
    value = np.inf
    for _ in range(8):
        rows = cones.linearise(x)
        n, w, p = rows.J.shape
        d, t = cp.Variable(p), cp.Variable()
        r = rows.r + cp.reshape(rows.J.reshape(n * w, p) @ d, (n, w), order="C")
        c = rows.c + rows.C @ d
        kept = [cp.norm(r, axis=1) <= t, c >= cones.lower, c <= cones.upper]
        cost = (1.0 - share) * cp.square(t) + share * cp.sum_squares(r) / n
        cp.Problem(cp.Minimize(cost), kept).solve(solver="CLARABEL")
        x, before = cones.step(x, d.value), value
        value = Blend(worst, share).evaluate(x)[0].max()
        if abs(before - value) < 1e-9 * value:
            break
    return float(value)


@pytest.mark.parametrize("share", [0.9, 0.3])
def test_a_compromise_is_cvxpys(share: float, robot: mc.Robot) -> None:
    fit = calibrate(robot, small(robot, 0.2), "sum", holdout=0.0)
    worst, x = problem_of(fit), fit.cell.state
    qp = partial(solve_qp, name="daqp", tolerance=1e-9)
    best = minimax.solve(Blend(worst, share), x, qp)
    assert best.status is Status.CONVERGED
    assert_allclose(best.value, cvxpy_blend(worst, x, share), rtol=1e-7)


def test_derivatives_of_a_blend(robot: mc.Robot, noisy: Simulation) -> None:
    worst = problem_of(calibrate(robot, noisy.data, "sum"))
    blend, rng = Blend(worst, 0.4), np.random.default_rng(0)
    size = len(worst.scale)
    at = blend.step(worst.start, 0.3 * rng.normal(size=size))
    here, e, step = blend.linearise(at), rng.normal(size=size), 1e-5
    f, c = blend.evaluate(at)
    assert_allclose(here.f, f, rtol=1e-11)  # metres rounded, of which millimetres are left
    assert_allclose(here.c, c, rtol=1e-11)
    plus, minus = (blend.evaluate(blend.step(at, sign * step * e))[0] for sign in (1, -1))
    assert_allclose(here.jacobian @ e, (plus - minus) / (2 * step), rtol=1e-6, atol=1e-6)
    weights = rng.uniform(size=len(f))
    n = len(f)
    mix = (1 - 0.4) * np.eye(n) + 0.4 / n
    inner = worst.linearise(at)
    expected = sum(w * inner.curvature(row) for w, row in zip(weights[:5], mix[:5], strict=True))
    some = np.where(np.arange(n) < 5, weights, 0.0)
    assert_allclose(here.curvature(some), expected, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("kind", ["one target", "missing points", "weights"])
def test_other_data(kind: str, robot: mc.Robot) -> None:
    data = small(robot, 0.3 if kind == "missing points" else 0.0)
    if kind == "one target":
        data = data.keep(np.array([True, False]))
    if kind == "weights":
        data = small(robot, u95=np.random.default_rng(0).uniform(1e-5, 3e-5, 40))
    found = tradeoff(robot, data, 3, holdout=0.1)
    assert found.status is Status.CONVERGED
    assert len(found.choices) == 5
    if kind != "weights":  # there the curve is that of the weighted errors
        assert np.all(np.diff([c.train.rms_mm for c in found.choices]) > 0)
        assert np.all(np.diff([c.train.max_mm for c in found.choices]) < 0)


def test_without_steps_only_the_ends(robot: mc.Robot) -> None:
    found = tradeoff(robot, small(robot), 0, holdout=0.0)
    assert [choice.objective for choice in found.choices] == ["sum", "point"]
    assert "no pose was held out" in found.headline()
    assert found.to_dict()["choices"][0]["holdout"]["rms_mm"] is None


def test_the_first_bad_status_is_the_whole_ones(found: Tradeoff) -> None:
    bad = replace(found.choices[2], status=Status.STALLED)
    whole = replace(found, choices=(*found.choices[:2], bad, *found.choices[3:]))
    assert whole.status is Status.STALLED
    assert "another QP backend" in whole.to_dict()["advice"]


def test_json_holds_cells_that_work(found: Tradeoff, noisy: Simulation, tmp_path: Path) -> None:
    found.save(tmp_path / "found.json")
    content = json.loads((tmp_path / "found.json").read_text())
    assert (content["schema"], content["kind"]) == (1, "tradeoff")
    for kept, choice in zip(content["choices"], found.choices, strict=True):
        cell = cell_from_dict(kept["cell"], "found.json")
        assert_allclose(cell.predict(noisy.data.q), choice.cell.predict(noisy.data.q), atol=1e-12)
        assert kept["train"]["max_mm"] == choice.train.max_mm


def test_picture(found: Tradeoff, tmp_path: Path) -> None:
    save_tradeoff(found, tmp_path / "curve.svg")
    text = (tmp_path / "curve.svg").read_text()
    assert "<svg" in text
    save_tradeoff(found, tmp_path / "again.svg")
    assert (tmp_path / "again.svg").read_text() == text  # the same picture gives the same file


def run(*arguments: object) -> int:
    with pytest.raises(SystemExit) as ended:
        main([str(a) for a in arguments])
    code = ended.value.code
    return code if isinstance(code, int) else 0


@pytest.fixture
def csv(tmp_path: Path, robot: mc.Robot) -> Path:
    path = tmp_path / "poses.csv"
    mc.write_measurements(path, small(robot))
    return path


def test_command(csv: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out, picture = tmp_path / "found.json", tmp_path / "curve.png"
    arguments = ("--steps", 2, "--seed", 3, "--holdout", 0.1, "-o", out, "--figure", picture)
    assert run("tradeoff", "irb2600", csv, *arguments) == 0
    text, err = capsys.readouterr()
    assert "held-out max mm" in text
    assert "From sum to point" in text
    assert "\x1b" not in text + err
    assert picture.read_bytes().startswith(b"\x89PNG")
    content = json.loads(out.read_text())
    assert len(content["choices"]) == 4
    assert content["provenance"]["settings"]["seed"] == 3
    assert run("tradeoff", "irb2600", csv, *arguments[:6], "--json") == 0
    again = json.loads(capsys.readouterr().out)
    assert again["choices"] == content["choices"]


@pytest.mark.parametrize(
    ("arguments", "say"),
    [
        (("irb2600", "CSV", "--steps", "-1"), "steps -1"),
        (("irb2600", "CSV", "--steps", "many"), "--steps"),
        (("irb2600", "CSV", "--holdout", "2"), "fraction"),
        (("irb2600", "CSV", "--qp", "dacp"), "daqp"),
        (("irb2600", "CSV", "--figure", "x.bmp"), ".png, .svg, .pdf"),
        (("irb2600", "CSV", "-o", "no/such/x.json"), "no such folder"),
        (("irb2600", "absent.csv"), "absent.csv"),
        (("irb26", "CSV"), "irb2600"),
    ],
)
def test_wrong_input_is_one_line_and_exit_2(
    arguments: tuple[str, ...], say: str, csv: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    code = run("tradeoff", *(csv if a == "CSV" else a for a in arguments))
    out, err = capsys.readouterr()
    assert code == 2
    lines = [line for line in err.splitlines() if line.startswith("error: ")]
    assert len(lines) == 1
    assert say in lines[0]
    assert out == ""


def test_numbers_that_do_not_work_out_are_exit_1(
    csv: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    few = partial(minimax.Sqp, iterations=1)
    monkeypatch.setattr(solve, "Sqp", few)
    assert run("tradeoff", "irb2600", csv, "--steps", 0) == 1
    assert "iteration limit" in capsys.readouterr().err


def test_a_saved_fit_is_enough(robot: mc.Robot, tmp_path: Path) -> None:
    data = small(robot)
    mc.calibrate(robot, data, "point").save(tmp_path / "fit.json")
    one = tradeoff(robot, data, 2)
    other = tradeoff(mc.load_fit(tmp_path / "fit.json"), steps=2)
    for a, b in zip(one.choices, other.choices, strict=True):
        for one_part, other_part in ((a.train, b.train), (a.holdout, b.holdout)):
            assert_allclose(one_part.rms_mm, other_part.rms_mm, rtol=1e-9)
            assert_allclose(one_part.max_mm, other_part.max_mm, rtol=1e-9)
    with pytest.raises(mc.OptionError, match="give the measurements too"):
        tradeoff(robot)


def test_no_compromise_is_looked_for_where_nothing_fits(robot: mc.Robot) -> None:
    """One target mirrored: least squares misses by far, and the worst point took minutes."""
    data = simulate(robot, 60, 2, seed=5).data
    y = data.y.copy()
    y[:, 1, 1] *= -1.0
    found = tradeoff(robot, data.with_y(y))
    assert found.status is Status.FAILED
    assert [choice.objective for choice in found.choices] == ["sum"]
    assert "no calibration" in found.headline()
    assert json.loads(found.json())["status"] == "failed"
