import numpy as np
from numpy.testing import assert_allclose

from minimax_cal.diagnosing.joint import Joint, joint
from minimax_cal.diagnosing.left_out import Beside, Block, Left, begun
from minimax_cal.diagnosing.study import SUM, studied
from minimax_cal.fitting.floor import AT_MOST, Floor
from minimax_cal.fitting.options import silent
from minimax_cal.fitting.solve import fit_cell
from minimax_cal.ground.arrays import Array
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
