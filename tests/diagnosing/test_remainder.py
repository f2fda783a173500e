from dataclasses import replace

import numpy as np
from numpy.testing import assert_allclose

from experiments.gap_cases import Case, Cause, make
from minimax_cal import diagnose
from minimax_cal.diagnosing.joint import Joint, joint
from minimax_cal.diagnosing.remainder import Beside, Block, Left, begun, far_apart, remainder
from minimax_cal.diagnosing.study import SUM, studied
from minimax_cal.fitting.options import silent
from minimax_cal.fitting.solve import fit_cell
from minimax_cal.ground.arrays import Array
from minimax_cal.measuring.floor import AT_MOST, DECLARED, Floor
from minimax_cal.measuring.history import with_history
from minimax_cal.modelling.effects.table import Term
from minimax_cal.modelling.simulate import Simulation, Truth, simulate
from minimax_cal.robots.robot import Robot

UNTOLD = Floor(0.1, 0.0, 0.1, AT_MOST)
NOISE = (
    1e-3 * np.hypot(10.0, 2.5 * 3.0) * np.sqrt(3.0)
)  # RMS distance of the simulated tracker [mm]


def rigid(robot: Robot, poses: int, targets: int, seed: int) -> Simulation:
    return simulate(robot, poses, targets, seed=seed, truth=Truth(compliance=0.0))


def geometric(robot: Robot, sim: Simulation, turn: Array | float) -> Joint:
    """The geometric fit of an arm whose joints turn by so much more: (m, n) [rad]."""
    data = with_history(sim.data)
    moved = sim.cell.predict(data.q + turn) - sim.cell.predict(data.q)
    data = data.with_y(data.y + moved)
    return joint(studied(robot, data, fit_cell(robot, data, SUM, silent)), ())


def test_a_fit_without_a_part_is_that_of_the_others(rng: np.random.Generator) -> None:
    y, columns = rng.normal(size=(20, 3)), rng.normal(size=(20, 3, 4))
    block = Block("J1", rng.normal(size=(20, 3, 5)), np.array([[0.3] * 5]))
    parts = np.arange(20) % 4 == np.arange(4)[:, None]
    after = Beside.of(parts, y, columns, np.zeros(columns.shape[-1])).with_block(block)
    penalty = np.diag(np.sqrt(after.ridge))
    for part in parts:
        rows = np.concatenate([after.columns[~part].reshape(-1, 9), penalty])
        told = np.concatenate([y[~part].reshape(-1), np.zeros(9)])
        value = np.linalg.lstsq(rows, told, rcond=None)[0]
        assert_allclose(after.error[part], y[part] - after.columns[part] @ value, atol=1e-9)


def test_the_prior_that_meets_the_parts_best_is_taken(rng: np.random.Generator) -> None:
    columns = rng.normal(size=(30, 3, 2))
    y = columns @ np.array([1.0, -2.0]) + 0.01 * rng.normal(size=(30, 3))
    parts = np.arange(30) % 5 == np.arange(5)[:, None]
    at = Beside.of(parts, y, rng.normal(size=(30, 3, 1)), np.zeros(1))
    sizes = [at.with_block(Block("J1", columns, np.full((1, 2), s))).square for s in (1e-3, 2.0)]
    both = at.with_block(Block("J1", columns, np.array([[1e-3, 1e-3], [2.0, 2.0]])))
    assert_allclose(both.square, min(sizes), rtol=1e-12)
    assert sizes[1] < 0.01 * sizes[0]


def test_noise_alone_predicts_nothing(robot: Robot) -> None:
    found = []
    for seed in range(8):  # half of them with joints that stop 20 urad off
        jitter = 2e-5 * (seed % 2) * np.random.default_rng(seed).normal(size=(60, 6))
        fit = geometric(robot, rigid(robot, 60, 1 + seed % 3, seed), jitter)
        found.append(remainder(fit, UNTOLD).predictable_mm)
    assert sum(one > 0.0 for one in found) <= 1  # by chance one in a hundred does


def test_a_curve_of_a_joint_is_found_there(robot: Robot) -> None:
    sim = rigid(robot, 120, 2, 3)
    turn = np.zeros_like(sim.data.q)
    turn[:, 1] = 2e-4 * np.sign(np.sin(5.0 * sim.data.q[:, 1]))
    left = remainder(geometric(robot, sim, turn), Floor(0.02, 0.015, 0.03, DECLARED))
    assert left.where[0][0] == "J2"
    assert left.where[0][1] > 0.9
    hidden = 1e3 * np.linalg.norm(
        sim.cell.predict(sim.data.q + turn) - sim.cell.predict(sim.data.q), axis=-1
    )
    assert 0.6 * hidden.mean() < left.predictable_mm < 1.1 * np.sqrt((hidden**2).mean())
    assert NOISE < left.unpredictable_mm < 0.6 * left.predictable_mm
    assert left.floor_mm == (0.015, 0.03)


def test_what_two_joints_do_together_is_told_of_all(robot: Robot) -> None:
    sim = simulate(robot, 160, 2, seed=4, truth=Truth(compliance=0.0, span=1.0))
    q = sim.data.q
    turn = np.zeros_like(q)
    turn[:, 0] = 3e-4 * np.sin(2.0 * q[:, 0]) * np.cos(2.0 * q[:, 1])
    left = remainder(geometric(robot, sim, turn), UNTOLD)
    assert "all" in [place for place, _ in left.where]
    assert left.floor_mm is None


def test_one_point_that_is_far_off_is_no_remainder(robot: Robot) -> None:
    sim = rigid(robot, 80, 1, 5)
    y = sim.data.y.copy()
    y[7] += 3e-3
    left = remainder(geometric(robot, replace(sim, data=sim.data.with_y(y)), 0.0), UNTOLD)
    assert left.predictable_mm == 0.0
    assert left.unpredictable_mm < 10.0 * NOISE  # 3 mm at one of 80 poses is 0.34 mm RMS


def test_centres_lie_apart(rng: np.random.Generator) -> None:
    corners = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0], [1.0, 1.0]])
    q = np.concatenate([corners, 0.5 + 0.1 * rng.uniform(-1, 1, (50, 2))])
    chosen = far_apart(q, 4)
    assert {tuple(one) for one in chosen.tolist()} == {tuple(one) for one in corners.tolist()}


def test_what_holds_a_fit_holds_it_without_a_part(robot: Robot) -> None:
    """Left out, each part is met as the fit with its priors meets it: a map has many columns."""
    sim = rigid(robot, 60, 2, 3)
    turn = np.zeros_like(sim.data.q)
    turn[:, 1] = 3e-4 * np.sin(9.0 * sim.data.q[:, 1])
    bare = geometric(robot, sim, turn)
    choice = {"low": -1.6, "high": 2.4, "length": 0.35, "size": 3e-4}
    fit = joint(bare.study, [Term("joint_error_map", "J2", choice)])
    left = Left.of(fit)
    at = begun(left)
    assert_allclose(at.square, fit.cross_validated(list(left.parts)), rtol=1e-6)
    free = Beside.of(left.parts, left.y, left.columns, np.zeros(left.columns.shape[-1]))
    assert free.square > 1.5 * at.square  # as it would be without


def test_what_no_pose_shows_is_nothing(rng: np.random.Generator) -> None:
    """As a session's frame, once its poses stand out."""
    y, columns = rng.normal(size=(20, 3)), rng.normal(size=(20, 3, 4))
    columns[..., 2] = 0.0
    parts = np.arange(20) % 4 == np.arange(4)[:, None]
    some, whole = (
        Beside.of(parts, y, columns[..., kept], np.zeros(np.count_nonzero(kept)))
        for kept in (np.arange(4) != 2, np.ones(4, dtype=bool))
    )
    assert_allclose(whole.error, some.error, atol=1e-12)


def test_what_a_name_takes_no_free_function_predicts() -> None:
    """Play, of which functions of the joints know nothing."""
    made = make(Case("irb2600", "single", (Cause("backlash", "J2", 2000.0),), seed=11))
    told = diagnose(made.robot, made.data, quick=True)
    train = told.data.take(~told.held)
    study = studied(made.robot, train, fit_cell(made.robot, train, SUM, silent))
    bare, named = (
        remainder(joint(study, terms), told.floor) for terms in ((), told.cells[-1].effects.terms)
    )
    geometry, left = (np.hypot(r.predictable_mm, r.unpredictable_mm) for r in (bare, named))
    assert left < 0.7 * geometry
    assert bare.unpredictable_mm > 0.9 * geometry
    assert named.unpredictable_mm > 0.9 * left
    assert 0.7 < told.ladder[-1].trusted.rms_mm / left < 1.4
