from dataclasses import replace

import numpy as np
import pytest
from conftest import run
from numpy.testing import assert_allclose, assert_array_equal
from scipy.spatial.transform import Rotation

import minimax_cal as mc
from minimax_cal.core.arrays import Array
from minimax_cal.core.errors import DataError
from minimax_cal.fitting import geometry_fit, identification, unknown_arm
from minimax_cal.fitting.identification import ReasonKind
from minimax_cal.fitting.opened_results import open_result
from minimax_cal.fitting.pose_records import build_pose_records, parse_pose_records
from minimax_cal.fitting.unknown_arm import (
    SEARCH,
    SWEEPS,
    build_rough_robot,
    identify_arm,
    parse_joint_types,
)
from minimax_cal.measuring.measurements import measurements
from minimax_cal.modelling import global_start
from minimax_cal.modelling.cell import Cell
from minimax_cal.modelling.global_start import CUBE_ROTATIONS, RotationProblem, fit_base_and_targets
from minimax_cal.modelling.point_model import PointLeastSquares, build_point_model
from minimax_cal.modelling.simulate import simulate
from minimax_cal.robots import kinematics
from minimax_cal.robots.joint_sampling import random_joint_values_above_floor
from minimax_cal.robots.kernels import plain
from minimax_cal.robots.robot import robot_from_dict
from minimax_cal.robots.transforms import nearest_rotations

# ---- identify ------------------------------------------------------------------------------------


TWELVE = "d1 theta1 d2 beta1 beta3 beta4 beta5 a6 d6 theta6 alpha6 beta6"


def find(robot: mc.Robot, data: mc.Measurements):
    model = build_point_model(robot, data)
    frame = global_start.fit_base_and_targets(model, robot.mdh)
    return model, frame.state, identification.identify_point_parameters(
        model,
        frame.state,
        identification.redundancy_drop_order(robot, model.names),
        is_allowed=model.active,
        reference_model=identification.build_reference_model(robot, model),
        has_prior=np.zeros(model.names.parameter_count, dtype=bool),
    )  # fmt: skip


def test_the_twelve_redundant_parameters(robot, noisy):
    _, _, found = find(robot, noisy.data)
    assert set(found.reasons) == set(TWELVE.split())
    assert found.active.sum() == 33
    assert found.reasons["d1"].text == "same motion as base_z"
    assert found.reasons["theta1"].text == "same motion as base_rz"
    assert found.reasons["d2"].text == "same motion as d3"
    assert found.reasons["theta6"].text == "same motion as all targets moved together"


def test_one_target_leaves_27_of_39(robot):
    _, _, found = find(robot, simulate(robot, 60, 1, seed=1).data)
    assert len(found.active) == 39
    assert found.active.sum() == 27


@pytest.mark.parametrize(("name", "dropped"), [("ur10", "d2 d3"), ("irb120", "d2")])
def test_beta_instead_of_d_on_parallel_axes(name, dropped):
    robot = mc.load_robot(name)
    _, _, found = find(robot, simulate(robot, 80, 3, seed=2).data)
    for d in dropped.split():
        assert d in found.reasons
        assert d.replace("d", "beta") not in found.reasons


def test_singular_values_are_those_of_the_scaled_jacobian(robot, noisy):
    model, state, found = find(robot, noisy.data)
    jacobian = model.point_jacobian(state).reshape(-1, model.names.parameter_count)[:, found.active]
    norms = np.sqrt((jacobian**2).sum(axis=0) / model.pose_counts_by_target.sum())
    expected = np.linalg.svd(jacobian / norms, compute_uv=False)
    assert_allclose(found.singular, expected, rtol=1e-9)


def test_a_prismatic_joint_has_its_own_redundancy():
    robot = mc.load_robot("scara_600")
    data = simulate(robot, 80, 3, seed=3).data
    model, state, found = find(robot, data)
    _, _, gram = PointLeastSquares(model).normal_equations_of(
        state, np.ones(model.names.parameter_count, dtype=bool)
    )
    scale = np.sqrt(np.diag(gram))
    rank = np.linalg.matrix_rank(gram / np.outer(scale, scale), tol=1e-10, hermitian=True)
    assert found.active.sum() <= rank
    fit = mc.calibrate(robot, data, "sum", holdout=0.25)
    assert fit.status == "converged"
    assert fit.accuracy["holdout"].rms_mm < 0.3 * fit.accuracy["nominal"].rms_mm


def test_what_the_poses_do_not_show_is_told_from_what_no_pose_can(robot):
    """Joint 4 never moves: its offset is then told from nothing, and the reason says so."""
    rng = np.random.default_rng(7)
    made = simulate(robot, 80, 3, seed=7)
    q = made.data.q.copy()
    q[:, 3] = 0.3
    data = mc.measurements(q, made.cell.predict(q) + 1e-5 * rng.normal(size=(80, 3, 3)))
    _, _, found = find(robot, data)
    assert found.active.sum() < 33
    extra = {name: why for name, why in found.reasons.items() if name not in TWELVE.split()}
    assert extra
    assert all(why.kind is ReasonKind.NOT_TOLD for why in extra.values())


def test_a_target_on_the_last_axis_does_not_measure_the_wrist(robot):
    """A tenth of a millimetre of lever (as on a real UR10) must not yield angles of ten degrees."""
    from minimax_cal.modelling.simulate import Truth

    made = simulate(robot, 100, 1, seed=9, truth=Truth(circle=1e-4))
    fit = mc.calibrate(robot, made.data, "sum")
    changes = [abs(p.value - p.nominal) for p in fit.parameters if p.name[0] in "abdt"]
    assert max(changes) < 0.02  # 20 mm, 20 mrad
    assert fit.accuracy["holdout"].rms_mm < 0.7


# ---- hardly determined ---------------------------------------------------------------------------


NOISE = 0.3e-3  # of a coordinate [m]
LAST = ("a5", "d5", "theta5", "alpha5")  # which joint 6 alone tells from the tool


def measured(seed: int, still: float) -> tuple[mc.Measurements, Cell]:
    """A UR10 drawn as well as `drawn_within`, joint 6 within 10 mrad in a share of 30 poses."""
    robot, rng = mc.load_robot("ur10"), np.random.default_rng(seed)
    off = rng.normal(size=(6, 5)) * np.repeat(robot.drawn_within, (2, 3))
    q = random_joint_values_above_floor(robot, 30, rng)
    q[rng.random(30) < still, 5] *= 0.01 / np.pi
    base = np.eye(4)
    base[:3, 3] = [2.0, 1.0, 0.3]
    cell = Cell(robot.with_mdh(robot.mdh + off), base, ("smr1",), np.array([[0.0, 0.0, 0.1]]))
    y = cell.predict(q)
    data = mc.measurements(q, y + NOISE * rng.normal(size=y.shape))
    return replace(data, target_names=cell.target_names), cell


def misses(cell: Cell, true: Cell, q: Array) -> float:
    """RMS distance of points over the joints' range, the base fitted [m]."""
    here, there = (one.predict(q)[:, 0] for one in (cell, true))
    here, there = (points - points.mean(axis=0) for points in (here, there))
    turn = nearest_rotations(there.T @ here)
    return float(np.sqrt(((here @ turn.T - there) ** 2).sum(axis=1).mean()))


@pytest.mark.parametrize("seed", range(3))
def test_a_joint_that_nearly_stands_still(seed):
    data, true = measured(seed, 1.0)
    fit = mc.calibrate("ur10", data, "sum")
    assert fit.status in ("converged", "no_better")
    assert any("drawing holds them, to 0.3 mm and 0.5 mrad" in text for text in fit.notices)
    q = random_joint_values_above_floor(true.robot, 300, np.random.default_rng(99))
    assert misses(fit.cell, true, q) < misses(fit.nominal, true, q)
    away = np.abs(fit.cell.robot.mdh - true.robot.mdh).T.reshape(-1)
    for name in LAST:
        i = fit.uncertainty.names.index_of_name(name)
        assert away[i] < 4.0 * fit.uncertainty.sigma[i], name
    freely = mc.calibrate("ur10", data, "sum", allow_large_changes=True)
    assert np.array_equal(freely.cell.robot.mdh, fit.cell.robot.mdh)


def test_poses_that_determine_all_need_no_drawing():
    data, _ = measured(0, 0.0)
    fit = mc.calibrate("ur10", data, "sum")
    assert not fit.prior.any()
    assert not any("drawing holds" in text for text in fit.notices)


def test_a_diagnosis_holds_them_as_well():
    """Its geometry is that of the calibration, to the rounds that weigh the prior."""
    data, _ = measured(2, 1.0)
    fit = mc.calibrate("ur10", data, "sum", holdout=0.2)
    found = open_result(mc.diagnose("ur10", data, quick=True), 1)
    own = found.cell.robot.mdh
    assert np.abs(own - fit.cell.robot.mdh).max() < 1e-4


# ---- gross errors --------------------------------------------------------------------------------


KINDS = ("six axes", "seven axes", "SCARA", "coaxial neighbours")
GROSS_NOISE = 5e-5  # of a point [m]
OFF, LONGER = 0.5, 2e-3  # errors of angles [rad] and lengths [m]


def drawn(kind: str, seed: int) -> mc.Robot:
    """A robot of a kind as its drawing has it: its axes are parallel or at right angles."""
    rng = np.random.default_rng([KINDS.index(kind), seed])
    n = {"seven axes": 7, "SCARA": 4}.get(kind, 6)
    sliding = (kind == "SCARA") & (np.arange(n) == 2)
    if kind == "SCARA":
        a, alpha = np.array([*rng.uniform(0.2, 0.5, 2), 0.0, 0.0]), np.array([0.0, np.pi, 0.0, 0.0])
        d = np.array([rng.uniform(0.2, 0.5), 0.0, 0.0, rng.uniform(0.0, 0.1)])
    else:
        alpha = rng.choice([0.0, np.pi / 2, -np.pi / 2], size=n, p=[0.3, 0.35, 0.35])
        alpha[-1] = 0.0
        a = np.where(rng.random(n) < 0.5, rng.uniform(0.05, 0.6, n), 0.0)
        a = np.where((alpha == 0.0) & (a < 0.1), rng.uniform(0.2, 0.6, n), a)
        d = np.where(rng.random(n) < 0.5, rng.uniform(0.1, 0.5, n), 0.0)
    if kind == "coaxial neighbours":
        i = int(rng.integers(0, n - 1))
        a[i], alpha[i] = 0.0, 0.0
    joints = [
        {
            "a": 1e3 * float(a[i]), "d": 1e3 * float(d[i]), "alpha": float(alpha[i]),
            "theta": 0.0, "beta": 0.0, "type": "prismatic" if slides else "revolute",
            "lower": 0.0 if slides else -2.6, "upper": 300.0 if slides else 2.6,
        }
        for i, slides in enumerate(sliding)
    ]  # fmt: skip
    units = {"length": "mm", "angle": "rad"}
    return robot_from_dict({"name": kind, "units": units, "joints": joints}, kind)


def tracked(kind: str, seed: int, robot: mc.Robot) -> mc.Measurements:
    """What a tracker sees of the real arm."""
    rng = np.random.default_rng([KINDS.index(kind), seed, 1])
    q = rng.uniform(robot.lower, robot.upper, size=(100, robot.joints))
    mdh = robot.mdh.copy()
    mdh[:, :2] += rng.uniform(-LONGER, LONGER, size=(robot.joints, 2))
    mdh[:, 2:4] += rng.uniform(-OFF, OFF, size=(robot.joints, 2))
    spots = 0.1 * np.eye(3) + rng.normal(scale=0.02, size=(3, 3))
    flange = kinematics.forward_kinematics(mdh, robot.sign * q, robot.prismatic)
    turn, move = Rotation.random(rng=rng).as_matrix(), rng.uniform(-3.0, 3.0, size=3)
    points: Array = np.einsum("mij,kj->mki", flange[:, :3, :3], spots) + flange[:, None, :3, 3]
    y = points @ turn.T + move + rng.normal(scale=GROSS_NOISE / np.sqrt(3.0), size=points.shape)
    return replace(mc.measurements(q, y), sliding=robot.prismatic)


def calibrated(kind: str, seed: int) -> mc.Fit:
    robot = drawn(kind, seed)
    data = tracked(kind, seed, robot)
    return mc.calibrate(robot, data, "sum", holdout=0.2, allow_large_changes=True)


def at_noise(fit: mc.Fit) -> bool:
    return str(fit.status) == "converged" and fit.accuracy["holdout"].rms_mm <= 1.3e3 * GROSS_NOISE


@pytest.mark.parametrize(
    ("kind", "seed"),
    [*((k, s) for k in KINDS for s in (0, 3)), (KINDS[3], 54), (KINDS[3], 60)],
)
def test_a_random_arm_reaches_the_noise(kind, seed):
    assert at_noise(calibrated(kind, seed))


def test_offsets_of_coaxial_axes_have_two_coordinates(monkeypatch):
    """Axes drawn coaxial that are not: with one coordinate the fit stops above the noise."""
    after = calibrated("coaxial neighbours", 0)
    monkeypatch.setattr(geometry_fit, "find_coaxial_joints", lambda robot: [])
    before = calibrated("coaxial neighbours", 0)
    assert not at_noise(before)
    many, few = (sum(p.identifiable for p in fit.parameters) for fit in (after, before))
    assert many > few


# ---- start ---------------------------------------------------------------------------------------


def test_the_only_minimum_is_the_best_of_many(rng):
    """Where one start is said to be enough, no other of 24 finds less."""
    alone = 0
    for noise in np.logspace(-4, 0, 40):
        truth = Rotation.random(rng=rng).as_matrix()
        matrix = rng.normal(size=(60, 9))
        right = matrix @ truth.reshape(9) + noise * rng.normal(size=60)
        turning = RotationProblem(matrix, right)
        turn, cost = turning.solve()
        guess = np.linalg.lstsq(matrix, right, rcond=1e-9)[0].reshape(3, 3)
        alone += turning.is_only_minimum(turn, guess)
        _, costs = plain.refine_rotations(matrix, right, CUBE_ROTATIONS.copy())
        assert cost <= costs.min() * (1.0 + 1e-9)
    assert 5 < alone < 40


def test_poses_in_parts_are_all_poses(robot, noisy, monkeypatch):
    y = noisy.data.y.copy()
    y[::4, 1] = np.nan
    model = build_point_model(robot, noisy.data.with_y(y))
    weight = model.weight * np.linspace(0.5, 2.0, len(model.q))
    model = replace(model, weight=weight)
    whole = fit_base_and_targets(model, robot.mdh)
    monkeypatch.setattr(global_start, "POSES_PER_QR_CHUNK", 7)
    parts = fit_base_and_targets(model, robot.mdh)
    assert_allclose(parts.state.base_pose, whole.state.base_pose, rtol=0, atol=1e-11)
    assert_allclose(parts.state.target_positions, whole.state.target_positions, rtol=0, atol=1e-11)
    assert parts.mean_square == pytest.approx(whole.mean_square, rel=1e-9)


# ---- unknown arm ---------------------------------------------------------------------------------


UNKNOWN_NOISE = 20e-6


def any_arm(rng: np.random.Generator, joints: int = 0) -> mc.Robot:
    """An arm of 3 to 7 joints: square axes, a little off, some of them slides."""
    n = joints or int(rng.integers(3, 8))
    mdh = np.zeros((n, 5))
    mdh[:, 0] = rng.uniform(0.0, 0.6, n) * rng.choice([0, 1], n, p=[0.3, 0.7])
    mdh[:, 1] = rng.uniform(-0.5, 0.5, n) * rng.choice([0, 1], n)
    mdh[:, 2] = rng.uniform(-3.0, 3.0, n)
    mdh[:, 3] = 0.5 * np.pi * rng.choice([0, 1, -1], n) + rng.normal(0.0, 2e-3, n)
    mdh[:, 4] = rng.normal(0.0, 2e-3, n)
    return build_rough_robot("arm", mdh, rng.uniform(size=n) < 0.12)


def sweeps(robot: mc.Robot, rng: np.random.Generator) -> list[np.ndarray]:
    """Each joint by itself, from a home pose of its own."""
    rows = []
    for joint, slides in enumerate(robot.prismatic):
        home = np.where(
            robot.prismatic, rng.uniform(-0.1, 0.1), rng.uniform(-1.0, 1.0, robot.joints)
        )
        values = np.linspace(-1.0, 1.0, 9) * (0.25 if slides else 1.2)
        rows += [np.where(np.arange(robot.joints) == joint, value, home) for value in values]
    return rows


def seen_anywhere(
    robot: mc.Robot, rng: np.random.Generator, *, swept: bool = True, noise: float = UNKNOWN_NOISE
) -> mc.Measurements:
    """Sweeps of each joint and 40 random poses, of one reflector or three, from anywhere."""
    span = np.where(robot.prismatic, 0.3, 2.0)
    q = np.array([*(sweeps(robot, rng) if swept else []),
                  *rng.uniform(-span, span, (40, robot.joints))])  # fmt: skip
    spots = np.array([0.05, 0.05, 0.1]) + rng.uniform(-0.15, 0.15, (int(rng.choice([1, 3])), 3))
    turn = Rotation.random(rng=rng).as_matrix()
    pose = robot.pose(q)
    y = spots @ np.swapaxes(pose[:, :3, :3], 1, 2) + pose[:, None, :3, 3]
    y = y @ turn.T + np.array([2.0, 1.0, 0.3]) + noise * rng.normal(size=y.shape)
    return replace(mc.measurements(q, y), sliding=robot.prismatic)


def reaches_the_noise(seed: int, *, swept: bool = True) -> bool:
    rng = np.random.default_rng(seed)
    robot = any_arm(rng)
    found = identify_arm(seen_anywhere(robot, rng, swept=swept), names_of(robot))
    assert found.way == (SWEEPS if swept else SEARCH)
    return found.fit.accuracy["holdout"].rms_mm < 1.5e3 * UNKNOWN_NOISE * np.sqrt(3)


def names_of(robot: mc.Robot) -> list[str]:
    return ["prismatic" if slides else "revolute" for slides in robot.prismatic]


@pytest.mark.parametrize("first", [0, pytest.param(10, marks=pytest.mark.slow)])
def test_arms_by_circle_sweeps_reach_the_noise(first):
    count = 200 if first else 8
    good = [reaches_the_noise(first + seed) for seed in range(count)]
    assert np.mean(good) >= 0.98


def test_an_arm_by_random_poses_alone():
    assert reaches_the_noise(3, swept=False)


def test_the_command_writes_a_rough_robot_that_calibrates(rng, tmp_path):
    robot = any_arm(rng, 5)
    data, path, out = (
        seen_anywhere(robot, rng),
        tmp_path / "sweeps.csv",
        tmp_path / "robot.json",
    )
    mc.write_measurements(path, data)
    joints = ",".join(names_of(robot))
    assert run("identify", path, "--joints", joints, "--name", "mine", "-o", out) == 0
    found = mc.load_robot(out)
    assert found.rough
    assert found.name == "mine"
    fit = mc.calibrate(found, mc.read_measurements(path), "sum")
    assert fit.accuracy["holdout"].rms_mm < 1.5e3 * UNKNOWN_NOISE * np.sqrt(3)
    assert run("identify", path, "--joints", "revolute,revolute") == 2
    assert run("identify", path, "--joints", "hinge") == 2


def test_joints_that_never_move_alone_are_named(rng, monkeypatch):
    monkeypatch.setattr(unknown_arm, "TRIALS", 1)
    monkeypatch.setattr(unknown_arm, "ROUNDS", 0)
    robot = any_arm(rng, 4)
    data = seen_anywhere(robot, rng, swept=False)
    noisy = data.with_y(data.y + 0.05 * rng.normal(size=data.y.shape))
    with pytest.raises(mc.DataError, match="measure sweeps of joint 1, 2, 3, 4"):
        identify_arm(noisy, names_of(robot))


def test_types_of_joints():
    assert parse_joint_types("R, prismatic,p").tolist() == [False, True, True]
    with pytest.raises(mc.OptionError, match="write revolute or prismatic"):
        parse_joint_types("")


# ---- pose rows -----------------------------------------------------------------------------------


def test_poses_come_back(rng):
    y = rng.normal(size=(7, 2, 3))
    y[3, 1] = np.nan
    labels = np.array(list("abcabca"))
    u95 = np.array([1e-5] * 6 + [np.nan])
    data = measurements(rng.normal(size=(7, 4)), y, pose=labels, u95=u95, order=np.arange(7)[::-1])
    data = replace(data, sliding=np.array([False, True, False, False]))
    held = np.arange(7) % 3 == 0
    block = build_pose_records(data, held, {"nominal": y})
    back, again = parse_pose_records(block, "fit.json")
    assert_array_equal(again, held)
    assert_array_equal(back.q, data.q)
    assert_array_equal(back.sliding, data.sliding)
    assert_allclose(back.y, y, rtol=1e-15)  # to millimetres and back
    assert_array_equal(back.columns["pose"], labels)
    assert_array_equal(back.columns["u95"], u95)
    assert_array_equal(back.columns["order"], np.arange(7, 0, -1))
    assert block["errors_mm"]["nominal"][3][1] == [None, None, None]


@pytest.mark.parametrize(
    ("key", "value"),
    [("q", [[0.0, 1.0]]), ("split", []), ("line", "x"), ("columns", None), ("measured_mm", [])],
)
def test_broken_poses_are_named(key, value, rng):
    data = measurements(rng.normal(size=(4, 2)), rng.normal(size=(4, 3)))
    block = build_pose_records(data, np.zeros(4, dtype=bool), {}) | {key: value}
    with pytest.raises(DataError, match=r"fit\.json: .*"):
        parse_pose_records(block, "fit.json")
