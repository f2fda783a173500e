"""What remains: right levels on noise, power against what no library holds."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from problems_fit import study
from scipy import stats

from experiments.gap_cases import Case, Cause, make
from minimax_cal.diagnosing.lack_of_fit import (
    Named,
    chance_of,
    exceeds,
    repeats,
    rest_of,
    shrunk,
    structure,
)
from minimax_cal.diagnosing.study import Study
from minimax_cal.evidence.limits import STRUCTURE
from minimax_cal.evidence.noise import Noise, restricted
from minimax_cal.ground.arrays import Array
from minimax_cal.modelling.effects.table import Term


def test_probabilities_are_right_on_noise() -> None:
    """White rows of the assumed covariance: each question's p below 0.1 in a tenth of all runs.

    Bands are of 99.9 % for all questions of 40 drawings together; the lack of fit and the wave are
    bounds on a maximum, which may only be rarer.
    """
    made = study(6e-6, 1.0, 0)
    rng, rows = np.random.default_rng(1), made.rows
    noise = Noise(0.5, 1e-10, 0.0)
    spread = np.sqrt(1e-10 * (1.0 + 0.5 * rows.variance_ratio))
    hits = []
    for _ in range(40):
        drawn = replace(rows, error=spread * rng.normal(size=len(rows.error)))
        found = structure(made.scene, drawn, noise, np.zeros((len(rows.error), 0)))
        hits.append([trace.p < 0.1 for trace in found if "wave" not in trace.name])
    count = np.array(hits)
    low, high = stats.binom.ppf((0.0005, 0.9995), 40, 0.1)
    each = count.sum(axis=0)
    assert np.mean((each >= low) & (each <= high)) > 0.95
    assert abs(count.mean() - 0.1) < 0.03


@pytest.mark.parametrize("law", ["outside_sum", "outside_product", "outside_waves"])
def test_laws_outside_the_library_leave_a_trace(law: str) -> None:
    from minimax_cal.diagnosing.study import studied
    from minimax_cal.fitting.options import Options, silent
    from minimax_cal.fitting.solve import fit_cell
    from minimax_cal.measuring.grouping import split
    from minimax_cal.measuring.history import with_history

    sealed = make(Case("irb2600", "outside", (Cause(law, "J2", 300.0),), seed=5))
    train, _, _ = split(with_history(sealed.data), 0.2, 0)
    fit = fit_cell(sealed.robot, train, Options(objective="sum"), silent)
    made = studied(sealed.robot, train, fit)
    none = np.zeros((len(made.rows.error), 0))
    found = structure(made.scene, made.rows, restricted(made.rows, none), none)
    best = min(found, key=lambda trace: trace.p)
    assert best.p * len(found) < 1e-4
    assert "J2" in best.name or "wave" in best.name or "repeated" in best.name


def test_a_joint_that_wanders_with_time_leaves_a_trace() -> None:
    """To and fro three times, of a joint among six: by a few hundredths of a milliradian."""
    made = study(3e-6, 1.0, 2)
    clock = made.scene.column("clock")
    course = 5e-5 * np.cos(6.0 * np.pi * clock)
    moved = made.rows.of((made.scene.jacobian[2] * course)[None])[:, 0]
    rows = made.rows
    moved -= rows.basis @ (rows.basis.T @ moved)
    none = np.zeros((len(rows.error), 0))
    wandering = replace(rows, error=rows.error + moved)
    found = structure(made.scene, wandering, restricted(wandering, none), none)
    best = min(found, key=lambda trace: trace.p)
    assert best.name == "J3 to and fro with time"
    assert best.p < 1e-6
    frozen = replace(made.scene.data, columns={"temperature": np.full(made.scene.poses, 20.0)})
    still = replace(made.scene, data=frozen)
    asked = structure(still, rows, restricted(rows, none), none)
    assert not [trace for trace in asked if "to and fro" in trace.name]


def test_what_was_fitted_is_not_found_again() -> None:
    made = study(6e-6, 1.0, 2)
    wave = np.cos(made.scene.q[1]) * made.scene.jacobian[1]
    column = made.rows.of(wave[None])
    rest = rest_of(made.rows, Noise(0.1, 1e-10, 0.0), column)
    root = rest.root
    assert abs(rest.rows @ (column[:, 0] * root)) < 1e-8 * np.linalg.norm(column[:, 0] * root)


def test_one_pose_that_is_off_is_no_structure() -> None:
    """Of many functions few poses have each a part of its own, and one row is 9 sigmas off."""
    made = study(6e-6, 1.0, 0, poses=50)
    rng, noise = np.random.default_rng(1), Noise(0.5, 1e-10, 0.0)
    spread = np.sqrt(1e-10 * (1.0 + 0.5 * made.rows.variance_ratio))
    none = np.zeros((len(spread), 0))
    for pose in (0, 8, 24):
        error = spread * rng.normal(size=len(spread))
        row = np.flatnonzero(made.rows.group == pose)[8]
        error[row] += 9.0 * spread[row]
        found = structure(made.scene, replace(made.rows, error=error), noise, none)
        assert min(t.p for t in found if "wave" not in t.name) * len(found) > 0.005


def shaken(made: Study, kind: str, rng: np.random.Generator) -> Array:
    """(N,) rows of an arm whose poses scatter: all targets along x, y, z alike, or one joint."""
    own = 1.5e-5 * rng.normal(size=made.scene.points.shape)
    if kind == "shakes":
        moved = np.broadcast_to(2.5e-5 * rng.normal(size=(1, 3, made.scene.poses)), own.shape)
    else:
        moved = made.scene.jacobian[int(kind[1:]) - 1] * (1e-4 * rng.normal(size=made.scene.poses))
    error = made.rows.of((own + moved)[None])[:, 0]
    return error - made.rows.basis @ (made.rows.basis.T @ error)


@pytest.mark.parametrize("kind", ["shakes", "J5", "J3"])
def test_scatter_from_visit_to_visit_is_no_structure(kind: str) -> None:
    """However it moves the targets: twelve drawings, of which one at most is called structure.

    And a law of the joint's angle beside its scatter still is, in all of them.
    """
    made = study(6e-6, 1.0, 0)
    rng, none = np.random.default_rng(7), np.zeros((len(made.rows.error), 0))
    bent = (made.scene.jacobian[4] * (2e-4 * np.sin(made.scene.q[1] + made.scene.q[2])))[None]
    law = made.rows.of(bent)[:, 0]
    law -= made.rows.basis @ (made.rows.basis.T @ law)
    chances = []
    for _ in range(12):
        error = shaken(made, kind, rng)
        drawn = [replace(made.rows, error=part) for part in (error, error + law)]
        chances.append([chance_of(structure(made.scene, rows, restricted(rows, none), none))
                        for rows in drawn])  # fmt: skip
    alone, beside = np.array(chances).T
    assert np.count_nonzero(alone < STRUCTURE) <= 1
    assert np.all(beside < STRUCTURE)


def test_a_motion_counts_by_its_own_scatter_where_that_is_larger() -> None:
    """White rows of one variance, and those along one joint of nine times that."""
    made, rng = study(6e-6, 1.0, 0), np.random.default_rng(3)
    none = np.zeros((len(made.rows.error), 0))
    joint = made.rows.of(made.scene.jacobian[2:3])
    width = made.rows.weight.shape[1]
    block = joint.reshape(-1, width)
    unit = block / np.linalg.norm(block, axis=1, keepdims=True)
    white = rng.normal(size=block.shape)
    for scale, expected in ((1.0, 1.0), (3.0, 9.0)):
        along = (unit * white).sum(axis=1, keepdims=True)
        error = 1e-5 * (white + (scale - 1.0) * along * unit).ravel()
        rest = rest_of(replace(made.rows, error=error), Noise(0.0, 1e-10, 0.0), none)
        square, free = rest.along(joint, none)
        assert abs(square / free / expected - 1.0) < 4.0 * np.sqrt(2.0 / free)
        assert 0.5 * made.scene.poses < free < made.scene.poses
    assert shrunk((90.0, 20.0), (1000.0, 1000.0)) == (100.0, 30.0)
    assert shrunk((10.0, 20.0), (1000.0, 1000.0)) == (1000.0, 1000.0)
    assert_allclose(exceeds(30.0, 3, (100.0, 10.0)), stats.f.sf(1.0, 3, 10.0), rtol=1e-12)


def test_poses_that_are_off_are_no_lack_of_fit() -> None:
    """Poses measured twice scatter as the others do, but for one in fifty that is far off."""
    made, rng, noise = study(6e-6, 1.0, 0), np.random.default_rng(2), Noise(0.0, 1e-10, 0.0)
    data, again = made.scene.data, np.repeat(np.arange(10), 2)
    q = np.concatenate([data.q[again], data.q[len(again) :]])
    scene = replace(made.scene, data=replace(data, q=q))
    error = 1e-5 * rng.normal(size=len(made.rows.error))
    none = np.zeros((len(error), 0))
    off, bent = error.copy(), error.reshape(len(q), -1).copy()
    off[9 * len(again) :: 450] += 1.2e-4
    assert repeats(scene, rest_of(replace(made.rows, error=off), noise, none))[0] > 0.01
    bent += 1e-5 * np.sin(5.0 * q[:, :1])
    assert repeats(scene, rest_of(replace(made.rows, error=bent.ravel()), noise, none))[0] < 1e-3


def test_few_functions_tell_what_a_name_stands_for() -> None:
    """One of three nests moved, and a plate that was seated anew is named for it: lambda 60.

    So is scale that grows beside a base that drifts, and a joint that yields to another's angle.
    """
    made = study(6e-6, 1.0, 0)
    scene, rows = made.scene, made.rows
    seated = Term("target_reseat", "all", {"since": 0.5, "apart": 0.0})
    nest = Term("target_shift", "smr2", {"since": 0.5}).columns(scene).displacement(scene)[:1]
    grown = (scene.points * scene.column("clock"))[None]
    bent = (scene.jacobian[2] * np.sin(scene.q[4]))[None]
    backlash = Term("backlash", "J3")
    drift = Term("frame_drift", "frame", {"constant": np.inf})
    cases = (
        (seated, nest, "smr2 since target_reseat:all"),
        (drift, grown, "the scale with time"),
        (backlash, bent, "backlash:J3 with J5"),
    )
    for name, motion, expected in cases:
        fields = name.columns(scene).displacement(scene)
        known, moved = rows.of(fields), rows.of(motion)[:, 0]
        noise = Noise(0.0, 1e-10, 0.0)
        clear = rest_of(replace(rows, error=moved), noise, known)
        moved *= np.sqrt(60.0 / clear.total)
        drawn = np.random.default_rng(3).normal(size=len(moved)) * 1e-5
        named = [Named(name, known.T, known.sum(axis=1))]
        found = structure(scene, replace(rows, error=moved + drawn), noise, known, named)
        best = min(found, key=lambda trace: trace.p)
        assert best.name == expected
        assert best.p < 1e-6
        assert best.doubts == (name is not drift)


def of_joint(made: Study, joint: int, turn: Array) -> Array:
    """(N,) rows of a joint that turns by so much (m,) [rad]."""
    return made.rows.of((turn * made.scene.jacobian[joint])[None])[:, 0]


@pytest.mark.parametrize(("power", "heard"), [(1, False), (3, True)])
def test_a_law_that_is_not_in_proportion_leaves_a_trace(power: int, heard: bool) -> None:
    """A joint that gives way as the cube of its load, named a compliance."""
    made, noise = study(6e-6, 1.0, 3), Noise(0.1, 1e-10, 0.0)
    rng, load = (
        np.random.default_rng(2),
        made.scene.gravity[1] / np.abs(made.scene.gravity[1]).max(),
    )
    spread = np.sqrt(1.0 / noise.weights(made.rows))
    error = spread * rng.normal(size=len(spread)) + of_joint(made, 1, 6e-4 * load**power)
    rows = replace(made.rows, error=error)
    column = of_joint(made, 1, load)
    named = Named(Term("joint_compliance", "J2"), column[None], column)
    assert_allclose(named.size(made.scene, rows), np.abs(load), rtol=1e-9)
    found = structure(made.scene, rows, noise, column[:, None], [named])
    (own,) = (trace for trace in found if trace.name.endswith("with its own size"))
    assert (own.p < 1e-6) == heard
    assert heard or own.p > 0.01


@pytest.mark.parametrize(("low", "high", "play"), [(0.0, 0.5, 6e-5), (0.3, 0.6, 9e-5)])
def test_play_in_one_sector_leaves_a_trace(low: float, high: float, play: float) -> None:
    """By a question of six functions, where those of load and move by themselves ask seven."""
    made, noise = study(6e-6, 1.0, 3), Noise(0.1, 1e-10, 0.0)
    q, side = made.scene.q[2], made.scene.each("approach")[2]
    first, last = np.quantile(q, (low, high))
    turn = play * np.where((q > first) & (q < last), side, 0.0)
    spread = np.sqrt(1.0 / noise.weights(made.rows))
    error = spread * np.random.default_rng(2).normal(size=len(spread)) + of_joint(made, 2, turn)
    found = structure(
        made.scene, replace(made.rows, error=error), noise, np.zeros((len(spread), 0))
    )
    best = min(found, key=lambda trace: trace.p)
    assert best.name == "J3 with its approach and angle"
    assert best.p * len(found) < 0.005
