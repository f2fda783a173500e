"""Known causes show where they lie, and noise shows nowhere."""

import json
import math
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
import pytest
from conftest import shared
from numpy.testing import assert_allclose
from problems_fit import study
from scipy.stats import binom

import minimax_cal as mc
from minimax_cal.diagnosing.diagnose import located
from minimax_cal.diagnosing.where import Where, joint_equivalent, noise_of, where
from minimax_cal.diagnosing.where.mean_squares import lack_of_fit, shape_energy, shape_scatter
from minimax_cal.diagnosing.where.residual import residual_of
from minimax_cal.diagnosing.where.significance import flips, score_flips
from minimax_cal.evidence.evened import TOGETHER, evened, times_before
from minimax_cal.evidence.noise import orthonormal
from minimax_cal.ground.arrays import Array
from minimax_cal.ground.files import plain
from minimax_cal.measuring.grouping import from_means, groups
from minimax_cal.modelling.model import model_of
from minimax_cal.modelling.simulate import Truth, gravity, simulate
from minimax_cal.reporting.tables import where_tables
from minimax_cal.robots import kinematics

SIGMA = 15e-6
SEEDS = 200
EXACT = Truth(compliance=0, noise=0, noise_per_metre=0)


@dataclass(frozen=True, eq=False)
class Scene:
    """A robot as calibrated; errors are made by hand and fitted to first order."""

    robot: mc.Robot
    cell: mc.Cell
    data: mc.Measurements
    jacobian: Array
    joint_jacobian: Array

    @property
    def shape(self) -> tuple[int, int, int]:
        return self.jacobian.shape[:3]

    def turned(self, dq: Array) -> Array:
        """Errors (k, m, 3) of joints that are off by dq (m, n)."""
        return np.asarray(np.einsum("jkcm,mj->kmc", self.joint_jacobian, dq))

    def noise(self, rng: np.random.Generator, sigma: float = SIGMA) -> Array:
        return sigma * rng.normal(size=self.shape)

    def measured(self, error: Array) -> mc.Measurements:
        """What the instrument would have seen."""
        off = np.moveaxis(error, 0, 1) @ self.cell.base[:3, :3].T
        return self.data.with_y(self.cell.predict(self.data.q) + off)

    def fitted(self, error: Array) -> Array:
        """What the geometric fit leaves of errors, to first order."""
        seen = np.isfinite(error).reshape(-1)
        basis = orthonormal(self.jacobian.reshape(-1, self.jacobian.shape[3])[seen])
        out = error.reshape(-1).copy()
        out[seen] -= basis @ (basis.T @ out[seen])
        return out.reshape(error.shape)

    def where(self, error: Array, noise: float = SIGMA, fit: bool = True) -> Where:
        data, base = self.measured(error), self.cell.base
        if not fit:
            return where(data, error, self.joint_jacobian, base, noise)
        rest = self.fitted(error)
        return where(data, rest, self.joint_jacobian, base, noise, fitted=self.jacobian)


def derivative(cell: mc.Cell, data: mc.Measurements) -> Array:
    """Of all points by all parameters: (k, m, 3, p)."""
    state = cell.state
    return model_of(cell.robot, data).jacobian(state)


def joint_jacobians(robot: mc.Robot, cell: mc.Cell, q: Array) -> Array:
    """Motion of every target with every joint: (n, k, 3, m)."""
    links = kinematics.chain(robot.mdh, q * robot.sign, robot.prismatic)
    lever = kinematics.points(links, cell.target_positions)[None] - links.before[:, None]
    turn = kinematics.cross(links.z[:, None], lever)
    slide = np.broadcast_to(links.z[:, None], turn.shape)
    flat = robot.prismatic[:, None, None, None]
    return np.where(flat, slide, turn) * robot.sign[:, None, None, None]


@cache
def scene(
    poses: int = 100, targets: int = 3, again: int = 15, robot_name: str = "irb2600"
) -> Scene:
    robot = mc.load_robot(robot_name)
    made = simulate(robot, poses, targets, seed=3, truth=EXACT)
    rows = np.concatenate([np.arange(poses), np.arange(again)])
    order = np.random.default_rng(4).permutation(len(rows)).astype(float)
    data = replace(made.data.take(rows), columns={"order": order})
    state = made.cell.state
    jacobian = model_of(made.cell.robot, data).jacobian(state)
    joint_jacobian = joint_jacobians(made.cell.robot, made.cell, data.q)
    return Scene(made.cell.robot, made.cell, data, jacobian, joint_jacobian)


def by_chance(p: list[float], level: float = 0.05) -> bool:
    """Whether as many p are below the level as should be, within 99.9 %."""
    low, high = binom.interval(0.999, len(p), level)
    return bool(low <= np.sum(np.array(p) < level) <= high)


# ---------------------------------------------------------------- distributions


@pytest.mark.parametrize("features", [3, 12, 40])
def test_flips_against_flipping(features: int, rng: np.random.Generator) -> None:
    """By all sign patterns of twelve poses: the p of a typical and of a large total."""
    score = rng.normal(size=(12, features))
    sign = 2.0 * (np.arange(4096)[:, None] >> np.arange(12) & 1) - 1.0
    total = ((sign @ score) ** 2).sum(axis=1)
    for level in (0.5, 0.9, 0.98):
        at = float(np.quantile(total, level))
        assert_allclose(score_flips(at, score), np.mean(total > at), atol=0.02)
        assert_allclose(score_flips(at, score), flips(at, score @ score.T), rtol=1e-6)


def smooth_error(made: Scene, rng: np.random.Generator, size: float) -> Array:
    """A gear error at a joint with |projected effect| = size."""
    joint, turns, phase = rng.integers(6), rng.integers(1, 3), rng.uniform(0, 6.3)
    dq = np.zeros((made.data.poses, 6))
    dq[:, joint] = np.cos(turns * made.data.q[:, joint] + phase)
    left = made.fitted(made.turned(dq))
    return np.asarray(size * left / np.linalg.norm(left))


# ---------------------------------------------------------------- nothing there


def test_white_noise_lies_nowhere() -> None:
    made = scene(60, 2, 10)
    p: dict[str, list[float]] = {}
    shares, joints = [], []
    for seed in range(SEEDS):
        found = made.where(made.noise(np.random.default_rng(seed)))
        joints.append([gap.share for gap in found.by_joint])
        for gap in found.by_joint:
            p.setdefault(gap.joint, []).append(gap.p)
        p.setdefault("order", []).append(found.order.p)
        for name in ("shape", "repeat", "pose"):
            p.setdefault(name, []).append(getattr(found.triage, name).p)
        shares.append([part.share for part in vars(found.triage).values()])
    for name, values in p.items():
        assert by_chance(values), name
    noise, shape, repeat, pose = np.mean(shares, axis=0)
    assert noise > 0.9
    assert max(shape, repeat, pose) < 0.07
    assert np.mean(joints) < 0.011  # seven features explain 0.018 of 360 free rows by chance


# ---------------------------------------------------------------- something there


def test_compliance_of_a_joint_appears_at_that_joint() -> None:
    """On a whole calibration: torque at joint 2 alone, mostly a function of q2 and q3."""
    robot = mc.load_robot("irb2600")
    made = simulate(robot, 120, 3, seed=1, truth=EXACT)
    rng = np.random.default_rng(0)
    bend = np.zeros_like(made.data.q)
    bend[:, 1] = 1e-6 * gravity(robot, made.data.q)[:, 1]
    y = made.cell.predict(made.data.q + bend)
    data = made.data.with_y(y + SIGMA * rng.normal(size=y.shape))
    fit = mc.calibrate(robot, data, objective="sum", holdout=0.0)
    cell = fit.cell
    error = fit.errors["train"] @ cell.base[:3, :3]
    jacobian = derivative(cell, data)
    joint_jacobian = joint_jacobians(cell.robot, cell, data.q)
    found = where(data, error, joint_jacobian, cell.base, SIGMA, fitted=jacobian)
    share = [gap.share for gap in found.by_joint]
    assert np.argmax(share) == 1
    assert share[1] > 0.5
    assert found.by_joint[1].p < 1e-6
    assert found.triage.pose.share > 0.9
    assert found.order.p > 1e-3


@pytest.mark.parametrize("joint", range(6))
def test_a_gear_error_appears_at_its_joint(joint: int, rng: np.random.Generator) -> None:
    made = scene()
    dq = np.zeros((made.data.poses, 6))
    dq[:, joint] = np.cos(2.0 * made.data.q[:, joint] + 1.0)
    left = made.fitted(made.turned(dq))
    error = made.noise(rng) + 2e-3 * left / np.linalg.norm(left)
    found = made.where(error)
    assert int(np.argmin([gap.p for gap in found.by_joint])) == joint
    share = found.by_joint[joint].share
    assert share == max(gap.share for gap in found.by_joint)
    whole = float((made.fitted(error) ** 2).sum())
    assert_allclose(share, 4e-6 / whole, atol=0.06)


def test_scatter_of_a_nest_is_shape(rng: np.random.Generator) -> None:
    made = scene()
    error = made.noise(rng)
    error[1] += 60e-6 * rng.normal(size=error[1].shape)
    found = made.where(error)
    assert found.triage.shape.p < 1e-12
    assert found.triage.shape.share > 0.65
    assert_allclose(found.triage.shape.rms, 60e-6, rtol=0.12)  # sqrt(3) 60 um at one of three
    worst = max(found.by_target, key=lambda gap: gap.rms)
    assert worst.name == "smr2"
    assert_allclose(worst.rms, math.sqrt(3) * math.hypot(60e-6, SIGMA), rtol=0.1)


def test_jitter_is_repeat_and_its_size_is_right() -> None:
    """Mean over seeds, since 15 revisits tell the size of a jitter to a sixth."""
    made = scene()
    size = []
    for seed in range(20):
        rng = np.random.default_rng(seed)
        jitter = made.turned(40e-6 * rng.normal(size=(made.data.poses, 6)))
        found = made.where(made.noise(rng) + jitter)
        assert found.triage.repeat.p < 1e-9
        assert found.triage.repeat.share > 0.3
        assert found.triage.shape.p > 1e-3
        size.append(found.triage.repeat.rms**2)
    true = np.mean([(made.turned(d) ** 2).sum(-1).mean() for d in 40e-6 * np.eye(6)[:, None]]) * 6
    assert_allclose(np.sqrt(np.mean(size)), math.sqrt(true), rtol=0.15)


def test_drift_is_repeat_and_order(rng: np.random.Generator) -> None:
    made = scene()
    late = made.data.columns["order"] / made.data.poses
    drift = 150e-6 * np.cos(2.0 * late)[None, :, None] * np.array([0.0, 0.6, 0.8])
    found = made.where(made.noise(rng) + drift)
    assert found.order.share > 0.7
    assert found.order.p < 1e-9
    assert found.triage.repeat.p < 1e-6
    assert found.triage.repeat.share > 0.3
    still = replace(made, data=replace(made.data, columns={"order": rng.permutation(late)}))
    assert still.where(made.noise(rng) + drift).order.share < 0.2


def test_static_error_is_pose(rng: np.random.Generator) -> None:
    made = scene()
    error = made.noise(rng) + smooth_error(made, rng, 3e-3)
    found = made.where(error)
    assert found.triage.pose.share > 0.8
    assert found.triage.pose.p < 1e-2
    assert found.triage.repeat.share < 0.05
    visits = residual_of(made.noise(rng), made.jacobian, groups(made.data))
    assert lack_of_fit(visits) > 1e-3


def test_temperature(rng: np.random.Generator) -> None:
    made = scene()
    hot = rng.uniform(20.0, 30.0, made.data.poses)
    hot[::10] = np.nan
    warm = replace(made, data=replace(made.data, columns={**made.data.columns, "temperature": hot}))
    lift = np.zeros(made.shape)
    lift[..., 2] = 10e-6 * np.nan_to_num(hot - 25.0)
    found = warm.where(made.noise(rng) + lift)
    assert found.temperature.share > 0.2
    assert found.temperature.p < 1e-6
    assert found.order.p > 1e-3
    assert made.where(made.noise(rng)).to_dict()["by_order"]["temperature"] is None  # type: ignore[index]


# ---------------------------------------------------------------- cuts


def test_mean_along_the_line_of_sight() -> None:
    made = scene()
    y = made.cell.predict(made.data.q)
    sight = np.moveaxis(y / np.linalg.norm(y, axis=-1, keepdims=True), 0, 1)
    error = 80e-6 * sight @ made.cell.base[:3, :3]
    found = where(made.data.with_y(y), error, made.joint_jacobian, made.cell.base, SIGMA)
    for gap in found.by_target:
        assert_allclose(gap.sight, 80e-6, rtol=1e-9)
        assert_allclose(gap.rms, 80e-6, rtol=1e-9)
    assert_allclose(found.by_direction["along_sight"], 80e-6, rtol=1e-9)
    assert found.by_direction["across_sight"] < 1e-12


def test_directions() -> None:
    made = scene()
    fixed = np.broadcast_to([30e-6, 0.0, 40e-6], made.shape)
    found = made.where(np.array(fixed), fit=False).by_direction
    assert_allclose([found["x"], found["z"], found["vertical"]], [30e-6, 40e-6, 40e-6], rtol=1e-9)
    assert found["y"] == 0.0
    assert_allclose(math.hypot(found["radial"], found["tangential"]), 30e-6, rtol=1e-9)
    white = made.where(made.noise(np.random.default_rng(0)), fit=False).by_direction
    assert_allclose(list(white.values()), SIGMA, rtol=0.15)
    turn = np.zeros((made.data.poses, 6))
    turn[:, 0] = 1e-4
    found = made.where(made.turned(turn), fit=False).by_direction
    assert found["radial"] < 1e-2 * found["tangential"]


def test_worst_region_is_where_the_error_is(rng: np.random.Generator) -> None:
    made = scene()
    y = made.cell.predict(made.data.q)
    point = np.moveaxis((y - made.cell.base[:3, 3]) @ made.cell.base[:3, :3], 0, 1)
    far = np.hypot(point[..., 0], point[..., 1])
    error = made.noise(rng)
    error[far > np.quantile(far, 2 / 3)] *= 5.0
    found = made.where(error, fit=False)
    assert found.worst_region.startswith("far out")
    for cell in found.by_region:
        assert (cell.rms > 3.0 * math.sqrt(3) * SIGMA) == cell.name.startswith("far out")


def test_joint_equivalent_is_the_turn(rng: np.random.Generator) -> None:
    made = scene()
    dq = 1e-3 * rng.normal(size=(made.data.poses, 6))
    found = joint_equivalent(made.turned(dq), made.joint_jacobian, 1e-7)
    off = np.abs(found - dq)  # large only where the wrist or the arm is stretched
    assert np.median(off) < 1e-5
    assert np.quantile(off[:, :3], 0.9) < 1e-4


# ---------------------------------------------------------------- mean squares


@pytest.mark.parametrize("targets", [2, 3, 4, 5])
def test_shape_energy_is_what_no_rigid_motion_explains(
    targets: int, rng: np.random.Generator
) -> None:
    q = rng.normal(size=(40, 6))
    spot = rng.normal(size=(targets, 3))
    moved = 1e-6 * rng.normal(size=(40, targets, 3))
    data = mc.measurements(q, spot + moved)
    apart = np.linalg.norm(spot[:, None] - spot, axis=-1)[np.triu_indices(targets, 1)]
    seen = np.linalg.norm(data.y[:, :, None] - data.y[:, None], axis=-1)
    energy, rank = shape_energy(data, seen[:, *np.triu_indices(targets, 1)] - apart)
    turns = [np.cross(axis, spot).ravel() for axis in np.eye(3)]
    rigid = orthonormal(np.stack([*np.tile(np.eye(3), targets), *turns], axis=1))
    flat = moved.reshape(40, -1)
    left = flat - flat @ rigid @ rigid.T
    assert_allclose(energy, (left**2).sum(1), rtol=1e-3)
    assert np.all(rank == 3 * targets - rigid.shape[1])


def test_a_missing_target_takes_its_distances_only(rng: np.random.Generator) -> None:
    made = scene(200, 3, 0)
    error = made.noise(rng)
    error[2, ::2] = np.nan
    energy, free = shape_scatter(made.measured(error))
    assert free == 100 * 3 + 100 * 1 - 3
    assert_allclose(energy / free, SIGMA**2, rtol=0.25)
    assert_allclose(noise_of(made.measured(error)), SIGMA, rtol=0.2)
    found = made.where(error)
    assert [gap.points for gap in found.by_target] == [200, 200, 100]
    json.dumps(found.to_dict(), allow_nan=False)


def test_scatter_counts_what_was_measured() -> None:
    values = np.array([[1.0, np.nan], [3.0, 5.0], [10.0, 7.0], [np.nan, 8.0]])
    off, free = from_means(values, np.array([0, 0, 1, 1]))
    assert_allclose(off, [[-1.0, 0.0], [1.0, 0.0], [0.0, -0.5], [0.0, 0.5]])
    assert_allclose(free, [[0.5, 0.0], [0.5, 0.0], [0.0, 0.5], [0.0, 0.5]])


def test_noise_is_found_in_the_data(rng: np.random.Generator) -> None:
    made = scene(200, 3, 0)
    jitter = made.turned(1e-4 * rng.normal(size=(200, 6)))
    assert_allclose(noise_of(made.measured(made.noise(rng) + jitter)), SIGMA, rtol=0.15)
    alone = scene(60, 1, 30)
    assert_allclose(noise_of(alone.measured(alone.noise(rng))), SIGMA, rtol=0.2)
    assert math.isnan(noise_of(scene(60, 1, 0).data))


def test_shares_add_up_and_what_cannot_be_told_is_null(rng: np.random.Generator) -> None:
    for targets, again, noise, told in (
        (3, 15, SIGMA, {"noise", "shape", "repeat", "pose"}),
        (3, 15, math.nan, {"noise", "repeat", "pose"}),
        (1, 10, SIGMA, {"noise", "repeat", "pose"}),
        (1, 10, math.nan, {"noise", "pose"}),
        (2, 0, SIGMA, {"noise", "shape", "pose"}),
        (1, 0, SIGMA, {"noise", "pose"}),
        (1, 0, math.nan, set()),
    ):
        made = scene(60, targets, again)
        found = made.where(
            made.noise(rng) + made.turned(2e-5 * rng.normal(size=(60 + again, 6))), noise
        )
        parts = plain(found.triage)
        assert {name for name, part in parts.items() if part is not None} == told
        shares = [part.share for part in vars(found.triage).values()]
        if told:
            assert_allclose(np.nansum(shares), 1.0, rtol=1e-12)
        json.dumps(found.to_dict(), allow_nan=False)


def test_an_uncertain_noise_makes_p_larger(rng: np.random.Generator) -> None:
    made = scene()
    error = made.noise(rng, 1.2 * SIGMA)
    data, rest = made.measured(error), made.fitted(error)
    sure = where(data, rest, made.joint_jacobian, made.cell.base, SIGMA)
    guess = where(data, rest, made.joint_jacobian, made.cell.base, SIGMA, dof=10)
    assert sure.triage.shape.p < 1e-3
    assert guess.triage.shape.p > 0.05


# ---------------------------------------------------------------- edges


def test_one_target_a_row(rng: np.random.Generator) -> None:
    made = scene()
    error = made.noise(rng) + smooth_error(made, rng, 3e-3)
    which = rng.integers(3, size=made.data.poses)
    error[np.arange(3)[:, None] != which] = np.nan
    found = made.where(error)
    assert sum(gap.points for gap in found.by_target) == made.data.poses
    assert plain(found.triage)["shape"] is None


def test_a_slide_is_in_millimetres(rng: np.random.Generator) -> None:
    made = scene(60, 3, 0, "scara_600")
    sliding = int(np.argmax(made.data.sliding))
    dq = np.zeros_like(made.data.q)
    dq[:, sliding] = 50e-6 * rng.normal(size=60)
    found = made.where(made.turned(dq), fit=False)
    gap = found.by_joint[sliding]
    assert plain(gap)["rms_mm"] == pytest.approx(50e-3, rel=0.3)
    assert "rms_mrad" in found.by_joint[0].to_dict()


def test_no_error_at_all() -> None:
    made = scene()
    found = made.where(np.zeros(made.shape), fit=False)
    assert all(gap.share == 0.0 for gap in found.by_joint)
    json.dumps(found.to_dict(), allow_nan=False)


@pytest.mark.parametrize(("promised", "own"), [(1.0, False), (0.5, True)])
def test_targets_that_scatter_on_their_own_show_beside_a_noise_that_is_declared(
    promised: float, own: bool
) -> None:
    """Of a diagnosis; where nothing is declared they are the noise, by definition."""
    made = study(6e-6, 1.0, 3)
    assert math.isnan(located(made).triage.shape.rms)
    u95 = np.full(made.data.poses, 1.959964 * promised * noise_of(made.data))
    data = replace(made.data, columns={**made.data.columns, "u95": u95})
    shape = located(replace(made, data=data)).triage.shape
    assert (shape.p < 1e-6) == own
    assert own or shape.p > 0.01
    assert own == (shape.share > 0.3)


def test_a_table_holds_the_numbers(rng: np.random.Generator) -> None:
    found = scene().where(scene().noise(rng))
    triage, text = found.triage, where_tables(found.to_dict())[0].text()
    assert f"{1e3 * triage.noise.rms:.4f}" in text
    assert f"{triage.noise.share:.3f}" in text


def test_a_real_arm() -> None:
    """IRB 120, commanded joints: gravity bends joint 2 and 3, not the frame."""
    name, path = shared("irb120")
    data = mc.read_measurements(path)
    fit = mc.calibrate(mc.load_robot(name), data, objective="sum", holdout=0.0)
    cell = fit.cell
    state = cell.state
    jacobian = model_of(cell.robot, data).jacobian(state)
    error = fit.errors["train"] @ cell.base[:3, :3]
    joint_jacobian = joint_jacobians(cell.robot, cell, data.q)
    found = where(data, error, joint_jacobian, cell.base, math.nan, fitted=jacobian)
    share = {gap.joint: gap.share for gap in found.by_joint}
    assert max(share, key=lambda joint: share[joint]) in ("J2", "J3")
    assert found.noise < 30e-6
    json.dumps(found.to_dict(), allow_nan=False)


def test_many_visits_to_one_pose_are_evened_some_at_a_time(rng: np.random.Generator) -> None:
    """Blocks of few visits leave the rest as it was; times of a number are counted in order."""
    group = np.array([3, 1, 3, 3, 1, 2])
    assert times_before(group).tolist() == [0, 0, 1, 2, 1, 0]
    m, wide, p = 200, 3, 4
    basis = np.linalg.qr(rng.normal(size=(m * wide, p)))[0]
    rows = rng.normal(size=m * wide)
    rows = (rows - basis @ (basis.T @ rows)).reshape(m, wide)
    spread = np.broadcast_to(np.eye(wide), (m, wide, wide))
    apart, one = (evened(rows, basis.reshape(m, wide, p), spread, g)
                  for g in (np.arange(m) // TOGETHER, np.zeros(m, dtype=int)))  # fmt: skip
    assert_allclose(one, apart, atol=1e-12)
