from dataclasses import replace
from types import ModuleType

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

import minimax_cal as mc
from minimax_cal.modelling.cell import build_measurements_at_rest
from minimax_cal.modelling.effects.table import Fitted, Term
from minimax_cal.modelling.inverse_with_effects import build_flange_cell
from minimax_cal.modelling.inverse_with_effects import (
    effect_joint_shifts_and_flange_motions as reached_at,
)
from minimax_cal.modelling.parameters import ParameterValues
from minimax_cal.modelling.point_model import PointModel, build_point_model, to_kernel_state
from minimax_cal.robots import kinematics
from minimax_cal.robots.joint_sampling import random_joint_values_above_floor
from minimax_cal.robots.kernels import kernel_choice, plain, pose_sums
from minimax_cal.robots.transforms import (
    ABC_ANGLES_CONVENTION,
    Frame,
    build_frame_tables,
    build_transform,
)

# ---- kinematics ----------------------------------------------------------------------------------


TARGETS = np.array([[0.1, 0.0, 0.05], [-0.05, 0.08, 0.05], [0.0, -0.09, 0.02]])


def bent(robot: mc.Robot, rng: np.random.Generator) -> np.ndarray:
    """A geometry with no entry at a special value."""
    return robot.mdh + rng.normal(size=robot.mdh.shape) * [0.05, 0.05, 0.2, 0.2, 0.2]


@pytest.mark.parametrize("name", ["irb2600", "ur10", "scara_600"])
def test_jacobian_is_the_complex_step_derivative(name, rng):
    robot = mc.load_robot(name)
    n = robot.joints
    q = rng.uniform(-2, 2, (20, n))
    data = mc.measurements(q, rng.normal(size=(20, 3, 3)))
    model = build_point_model(robot, data)
    turn = kinematics.rotation_from_vector(rng.normal(size=3))
    state = ParameterValues(bent(robot, rng), turn, rng.normal(size=3), TARGETS)
    analytic = model.point_jacobian(state)
    for i in range(model.names.parameter_count):
        dx = np.zeros(model.names.parameter_count, dtype=complex)
        dx[i] = 1e-30j  # exact to rounding: no difference is taken
        moved = state.step(dx)
        links = kinematics.compute_link_frames(moved.mdh, model.q, model.prismatic)
        point = np.moveaxis(kinematics.targets_in_base(links, moved.target_positions), -1, 0)
        seen = point @ moved.rotation.T + moved.origin
        slope = (seen.imag / 1e-30) @ state.rotation  # from measurement into base axes
        assert_allclose(
            analytic[..., i], slope, rtol=0, atol=1e-14, err_msg=model.names.all_names[i]
        )


def pinocchio_model(robot: mc.Robot):
    """The same arm in Pinocchio: frame i-1 to joint i is the rest of link i-1."""
    pin = pytest.importorskip("pinocchio", reason="Pinocchio (pip install pin) is not installed")

    def rest(row: np.ndarray) -> "pin.SE3":
        a, _, _, alpha, beta = row
        first = pin.SE3(pin.utils.rotate("x", alpha), np.array([a, 0.0, 0.0]))
        return first * pin.SE3(pin.utils.rotate("y", beta), np.zeros(3))

    model = pin.Model()
    placement, parent = pin.SE3.Identity(), 0
    for i, row in enumerate(robot.mdh):
        before = pin.SE3(pin.utils.rotate("z", row[2]), np.array([0.0, 0.0, row[1]]))
        kinds = {False: (pin.JointModelRZ, "revolute"), True: (pin.JointModelPZ, "prismatic")}
        kind, _ = kinds[bool(robot.prismatic[i])]
        parent = model.addJoint(parent, kind(), placement * before, f"j{i + 1}")
        placement = rest(row)
    frame = pin.Frame("flange", parent, 0, placement, pin.FrameType.OP_FRAME)
    return pin, model, model.addFrame(frame)


@pytest.mark.dev
@pytest.mark.parametrize("name", ["irb2600", "irb120", "ur5e", "scara_600", "fanuc_r2000ic_165f"])
def test_forward_agrees_with_pinocchio(name, rng):
    robot = mc.load_robot(name)
    robot = robot.with_mdh(bent(robot, rng))
    pin, model, flange = pinocchio_model(robot)
    data = model.createData()
    for q in rng.uniform(-3, 3, (30, robot.joints)):
        pin.framesForwardKinematics(model, data, q * robot.sign)
        assert_allclose(robot.pose(q), data.oMf[flange].homogeneous, rtol=0, atol=1e-13)


def test_batched_chain_equals_each_alone(robot, rng):
    mdh = np.stack([bent(robot, rng) for _ in range(4)])
    q = rng.uniform(-3, 3, (7, 6))
    together = kinematics.forward_kinematics(mdh, q, robot.prismatic)
    for one, alone in zip(mdh, together, strict=True):
        assert_allclose(
            kinematics.forward_kinematics(one, q, robot.prismatic), alone, rtol=0, atol=1e-15
        )


@pytest.mark.parametrize("size", [0.0, 1e-12, 1e-5, 1.0, 3.1])
def test_rotation_is_scipys(size, rng):
    from scipy.spatial.transform import Rotation

    w = rng.normal(size=3)
    w *= size / np.linalg.norm(w)
    expected = Rotation.from_rotvec(w).as_matrix()
    assert_allclose(kinematics.rotation_from_vector(w), expected, rtol=0, atol=1e-15)


# ---- kernels -------------------------------------------------------------------------------------


Arrays = tuple[np.ndarray, ...]
ALIKE = 1e-12  # relative to the largest entry
POSES = 210  # more than a block of the compiled kernels


@pytest.fixture
def fast() -> ModuleType:
    pytest.importorskip("numba", reason="numba is not installed: pip install 'minimax-cal[fast]'")
    from minimax_cal.robots.kernels import fast

    return fast


def cell(
    name: str, robots: int, effects: int, rng: np.random.Generator
) -> tuple[PointModel, ParameterValues]:
    """An arm amid measurements with holes and weights, and a batch of states near the truth."""
    sim = mc.simulate(mc.load_robot(name), POSES, 2, 0)
    y = sim.data.y.copy()
    y[rng.random(y.shape[:2]) < 0.2] = np.nan
    model = build_point_model(sim.cell.robot, sim.data.with_y(y))
    fields, moved = (
        1e-3 * rng.normal(size=(effects, *model.y.shape)),
        1e-4 * rng.normal(size=model.y.shape),
    )
    weight = model.weight * rng.uniform(0.5, 2.0, model.weight.shape)
    names = replace(model.names, effects=tuple(f"e{i}" for i in range(effects)))
    model = replace(
        model, names=names, weight=weight, active=np.ones(names.parameter_count, dtype=bool),
        fields=fields if effects else model.fields, moved=moved if effects else model.moved,
    )  # fmt: skip
    begin = replace(sim.cell.parameter_values, effects=np.zeros(effects)).repeat(robots)
    return model, begin.step(1e-3 * rng.normal(size=(robots, names.parameter_count)))


CELLS = [("irb120", 1, 0), ("irb2600", 3, 2), ("scara_600", 2, 0), ("scara_600", 1, 3)]


def near(found: Arrays, wanted: Arrays, alike: float = ALIKE) -> None:
    for mine, other in zip(found, wanted, strict=True):
        assert mine.shape == other.shape
        assert_allclose(mine, other, rtol=0, atol=alike * np.abs(other).max(initial=0.0))


@pytest.mark.parametrize(("name", "robots", "effects"), CELLS)
def test_pairs(name, robots, effects, fast, rng):
    model, state = cell(name, robots, effects, rng)
    at, seen = to_kernel_state(state), model.kernel_data
    (mdh, *place), (q, prismatic, *_) = at, seen
    near(
        fast.link_axes_and_origins(mdh, q, prismatic),
        plain.link_axes_and_origins(mdh, q, prismatic),
    )
    arm = plain.link_frames_in_flange(mdh, q, prismatic, 20, 90)
    near((fast.link_frames_in_flange(mdh, q, prismatic, 20, 90),), (arm,))
    near(
        fast.weighted_target_errors(arm, *place, *seen[2:], 20),
        plain.weighted_target_errors(arm, *place, *seen[2:], 20),
    )
    near(
        (pose_sums.sum_target_costs(fast, at, seen),),
        (pose_sums.sum_target_costs(plain, at, seen),),
    )
    one = tuple(part[:1] for part in at)
    for share in (1.0, 0.6):
        which = np.flatnonzero(rng.random(model.names.parameter_count) < share)
        step = 1e-2 * rng.normal(size=len(which))
        near(
            pose_sums.sum_normal_equations(fast, at, seen, which),
            pose_sums.sum_normal_equations(plain, at, seen, which),
        )
        near(
            pose_sums.weighted_errors_and_jacobian(fast, one, seen, which, 20, 90),
            pose_sums.weighted_errors_and_jacobian(plain, one, seen, which, 20, 90),
        )
        near(
            pose_sums.squared_distances_and_gradients(fast, one, seen, which),
            pose_sums.squared_distances_and_gradients(plain, one, seen, which),
        )
        near(
            fast.apply_parameter_step(*one, which, step),
            plain.apply_parameter_step(*one, which, step),
        )


def test_a_system_that_is_not_definite_is_told(fast, rng):
    """And one that is has its solution; the last row repeats the first."""
    rows = rng.normal(size=(1, 3, 20, 6))
    right, off, hold = rng.normal(size=(1, 3, 6)), rng.normal(size=6), np.zeros(6)
    for hold in (np.zeros(6), rng.uniform(size=6)):
        gram = np.swapaxes(rows, 2, 3) @ rows
        given = rng.uniform(size=(1, 3)), right, gram, off, hold
        found, wanted = fast.solve_gauss_newton_step(*given), plain.solve_gauss_newton_step(*given)
        assert_allclose(found[0], wanted[0], rtol=1e-11)
        assert_allclose(found[1:3], wanted[1:3], rtol=1e-11)
        assert found[3]
        assert wanted[3]
        total = gram[0].sum(axis=0) + np.diag(hold)
        assert_allclose(total @ wanted[0], right[0].sum(axis=0) + hold * off, rtol=1e-9)
    rows[..., -1] = rows[..., 0]
    given = given[0], right, np.swapaxes(rows, 2, 3) @ rows, off, np.zeros(6)
    assert not fast.solve_gauss_newton_step(*given)[3]
    assert not plain.solve_gauss_newton_step(*given)[3]


@pytest.mark.parametrize(("name", "robots", "effects"), CELLS)
def test_rows_make_the_normal_equations(name, robots, effects, rng):
    model, state = cell(name, 1, effects, rng)
    which = np.flatnonzero(rng.random(model.names.parameter_count) < 0.8)
    given = plain, to_kernel_state(state), model.kernel_data, which
    error, J = pose_sums.weighted_errors_and_jacobian(*given, 0, POSES)
    cost, gradient, gram = pose_sums.sum_normal_equations(*given)
    made = (
        (error**2).sum(axis=(1, 2)),
        np.einsum("kpic,kic->kp", J, error),
        np.einsum("kpic,kqic->kpq", J, J),
    )
    near(made, (cost[0], gradient[0], gram[0]))
    f, slope = pose_sums.squared_distances_and_gradients(*given)
    near((f.sum(axis=1), slope.sum(axis=1)), (cost[0], -2.0 * gradient[0]))


@pytest.mark.parametrize(("name", "robots", "effects"), CELLS)
def test_normal_equations_are_those_of_the_jacobian(name, robots, effects, rng):
    model, state = cell(name, robots, effects, rng)
    which = np.flatnonzero(rng.random(model.names.parameter_count) < 0.8)
    cost, gradient, gram = pose_sums.sum_normal_equations(
        plain, to_kernel_state(state), model.kernel_data, which
    )
    error, J = np.nan_to_num(model.point_errors(state)), model.point_jacobian(state)[..., which]
    weight = model.weight.T[..., None]
    near(
        (cost, gradient, gram),
        (
            (weight * error**2).sum(axis=(-1, -3)),
            np.einsum("km,bmki,bmkip->bkp", model.weight, error, J),
            np.einsum("km,bmkip,bmkiq->bkpq", model.weight, J, J),
        ),
    )
    near((pose_sums.sum_target_costs(plain, to_kernel_state(state), model.kernel_data),), (cost,))


@pytest.mark.parametrize(("name", "effects"), [("irb120", 0), ("irb2600", 2)])
def test_plain_steps_end_alike(name, effects, fast, rng):
    model, state = cell(name, 1, effects, rng)
    names = ("a1", "a2", "a3", "theta2", "theta3", "theta4", "theta5")
    told = [model.names.index_of_name(one) for one in names]  # by any poses
    which = np.array([*told, *range(5 * model.names.joints, model.names.parameter_count)])
    prior = np.full(len(which), 1e-3), np.where(which < 5 * model.names.joints, 1e-3, 0.0)
    ends = [
        pose_sums.descend_by_gauss_newton(
            module, to_kernel_state(state), model.kernel_data, which, prior, 1e-12, 15
        )
        for module in (fast, plain)
    ]
    assert ends[0][-1]
    assert ends[1][-1]
    near(ends[0][0], ends[1][0], alike=1e-10)  # systems of a condition of 1e4
    near(ends[0][1:2], ends[1][1:2], alike=1e-10)


def test_polish(fast, rng):
    truth = Rotation.random(rng=rng).as_matrix()
    matrix = rng.normal(size=(10, 9))
    right = matrix @ truth.reshape(9) + 1e-3 * rng.normal(size=10)
    starts = np.stack(
        [truth @ plain.rotation_from_vector(0.5 * rng.normal(size=3)) for _ in range(8)]
    )
    ends = [module.refine_rotations(matrix, right, starts) for module in (fast, plain)]
    assert ends[0][1].min() < 1e-5
    near(ends[0], ends[1], alike=1e-9)
    best = ends[1][0][np.argmin(ends[1][1])]
    assert_allclose(best @ best.T, np.eye(3), rtol=0, atol=1e-14)
    assert_allclose(best, truth, rtol=0, atol=5e-3)


def test_choice(monkeypatch, fast):
    kernel_choice.load_best_kernels.cache_clear()
    monkeypatch.setenv(kernel_choice.KERNELS_VARIABLE, "plain")
    assert kernel_choice.active_kernels() is plain
    kernel_choice.load_best_kernels.cache_clear()
    monkeypatch.delenv(kernel_choice.KERNELS_VARIABLE)
    assert kernel_choice.active_kernels() is fast
    with kernel_choice.use_numpy_kernels_for_brief_work(brief=True):
        assert kernel_choice.active_kernels() is plain
        with kernel_choice.use_numpy_kernels_for_brief_work(brief=False):
            assert kernel_choice.active_kernels() is fast
    assert kernel_choice.active_kernels() is fast


def test_without_numba_numpy_answers(monkeypatch):
    kernel_choice.load_best_kernels.cache_clear()
    monkeypatch.delenv(kernel_choice.KERNELS_VARIABLE, raising=False)
    monkeypatch.setattr(kernel_choice.util, "find_spec", lambda name: None)
    assert kernel_choice.active_kernels() is plain
    kernel_choice.load_best_kernels.cache_clear()


def test_where_compiled_kernels_have_no_folder_numpy_answers(monkeypatch, caplog):
    """numba raises where package and home are both read-only, as in a container."""

    def fail(_: str) -> None:
        raise RuntimeError("cannot cache function 'chain': no locator available")

    kernel_choice.load_best_kernels.cache_clear()
    monkeypatch.delenv(kernel_choice.KERNELS_VARIABLE, raising=False)
    monkeypatch.setattr(kernel_choice, "import_module", fail)
    monkeypatch.setattr(kernel_choice.util, "find_spec", lambda name: True)
    assert kernel_choice.active_kernels() is plain
    assert "NUMBA_CACHE_DIR" in caplog.text
    kernel_choice.load_best_kernels.cache_clear()


@pytest.mark.parametrize("name", ["plain", "fast"])
def test_targets_alone_may_be_free(name, request, rng):
    own = plain if name == "plain" else request.getfixturevalue(name)
    model, state = cell("irb120", 1, 0, rng)
    given = plain, to_kernel_state(state), model.kernel_data
    first, every = 5 * 6 + 6, np.arange(model.names.parameter_count)
    whole = pose_sums.sum_normal_equations(*given, every)
    cost, gradient, gram = pose_sums.sum_normal_equations(own, *given[1:], every[first:])
    near((cost, gradient, gram), (whole[0], whole[1][..., first:], whole[2][..., first:, first:]))


# ---- inverse -------------------------------------------------------------------------------------


THERE = 1e-7  # of a pose [m, and what turns a point at the lever so far]


def test_every_robot_comes_back_to_its_pose(rng):
    for name in mc.builtin_robots():
        robot = mc.load_robot(name)
        q = random_joint_values_above_floor(robot, 20, rng, 0.9 * np.pi)
        near = np.clip(q + 0.05 * rng.normal(size=q.shape), robot.lower, robot.upper)
        if robot.joints < 6:  # a start away from it may choose another of fewer ways
            near = q + 1e-3
        pose = robot.pose(q)
        assert_allclose(robot.pose(robot.inverse(pose, near=near)), pose, rtol=0, atol=THERE)


def test_a_regular_pose_gives_the_joints_near_by(robot):
    q = np.array([0.3, 0.2, 0.1, 0.5, 0.8, -0.4])
    assert_allclose(robot.inverse(robot.pose(q), near=q + 0.05), q, rtol=0, atol=1e-9)


def test_batches_have_the_shape_of_their_poses(robot, rng):
    q = np.array([0.3, 0.2, 0.1, 0.5, 0.8, -0.4]) + 0.1 * rng.normal(size=(2, 3, 6))
    pose = robot.pose(q)
    assert robot.inverse(pose, near=q).shape == (2, 3, 6)
    assert robot.inverse(pose, near=q[0, 0]).shape == (2, 3, 6)
    assert robot.inverse(pose[0, 0], near=q[0, 0]).shape == (6,)
    assert robot.inverse(pose[:0], near=q[0, 0]).shape == (0, 3, 6)


def test_without_a_start_any_way_is_found(robot, rng):
    pose = robot.pose(random_joint_values_above_floor(robot, 30, rng))
    q = robot.inverse(pose)
    assert_allclose(robot.pose(q), pose, rtol=0, atol=1e-6)
    assert (q >= robot.lower).all()
    assert (q <= robot.upper).all()


def test_what_is_out_of_reach_is_said(robot):
    pose = np.eye(4)
    pose[0, 3] = 9.0
    with pytest.warns(mc.CalibrationWarning, match="1 of 1 poses are not reached"):
        robot.inverse(pose, near=np.zeros(6))


@pytest.mark.parametrize(
    ("pose", "near", "said"),
    [
        (np.eye(3), None, "shape"),
        (2.0 * np.eye(4), None, "rotation"),
        (np.diag([1.0, 1.0, -1.0, 1.0]), None, "rotation"),
        (np.full((4, 4), np.nan), None, "finite"),
        (np.eye(4), np.zeros(5), "near"),
        (np.eye(4), [np.inf] * 6, "near"),
        ("here", None, "numbers"),
    ],
)
def test_no_pose_is_one_line(robot, pose, near, said):
    with pytest.raises(mc.RobotError, match=said):
        robot.inverse(pose, near=near)


def test_a_fit_counts_its_effects(noisy, rng):
    """The flange with its compliance, by the law itself, is at the pose."""
    fit = mc.calibrate("irb2600", noisy.data, "sum", effects="joint_compliance:all")
    arm, robot = build_flange_cell(fit.cell), fit.cell.robot
    q = random_joint_values_above_floor(robot, 10, rng)
    turn, moved = reached_at(arm, build_measurements_at_rest(q, arm.target_names, robot))
    assert np.abs(turn).max() > 1e-4
    pose = moved @ robot.pose(q + turn * robot.sign)
    found = fit.inverse(pose, near=q + 1e-3)
    turn, moved = reached_at(arm, build_measurements_at_rest(found, arm.target_names, robot))
    assert_allclose(moved @ robot.pose(found + turn * robot.sign), pose, rtol=0, atol=THERE)
    assert np.abs(robot.pose(robot.inverse(pose, near=q)) - pose).max() < THERE
    assert np.abs(found - robot.inverse(pose, near=found)).max() > 1e-5  # the effects' share


def test_what_only_the_tracker_sees_moves_no_flange(clean):
    cell, q = clean.cell, np.array([0.3, 0.2, 0.1, 0.5, 0.8, -0.4])
    drift = Fitted((Term("target_offset", "smr1", {}),), (np.array([1e-3]),))
    pose = cell.robot.pose(q)
    assert_allclose(replace(cell, effects=drift).inverse(pose, near=q), q, rtol=0, atol=1e-9)


# ---- frames --------------------------------------------------------------------------------------


TURNS = Rotation.random(50, random_state=3).as_matrix()
SPECIAL = Rotation.from_euler(
    "ZYX",
    [[0, 0, 0], [180, 0, 0], [0, 0, 180], [10, 90, 0], [-30, -90, 0], [180, 90, 0], [90, 0, -90]],
    degrees=True,
).as_matrix()


@pytest.mark.parametrize("turn", [*TURNS, *SPECIAL])
def test_a_frame_is_what_scipy_says(turn):
    pose = build_transform(turn, np.array([0.1, -2.0, 3.0]))
    frame = Frame.from_pose(pose)
    assert_allclose(frame.pose, pose, rtol=0, atol=1e-14)
    assert_allclose(frame.xyz_mm, [100.0, -2000.0, 3000.0], rtol=1e-15)
    back = Rotation.from_euler("ZYX", frame.abc_deg, degrees=True).as_matrix()
    assert_allclose(back, turn, rtol=0, atol=1e-14)
    assert abs(frame.abc_deg[1]) < 90.0 + 1e-12
    assert_allclose(np.linalg.norm(frame.quaternion_wxyz), 1.0, rtol=1e-15)
    assert frame.quaternion_wxyz[0] >= 0.0
    of_quaternion = Rotation.from_quat(frame.quaternion_wxyz, scalar_first=True).as_matrix()
    assert_allclose(of_quaternion, turn, rtol=0, atol=1e-14)
    of_vector = Rotation.from_rotvec(frame.rotation_vector_rad).as_matrix()
    assert_allclose(of_vector, turn, rtol=0, atol=1e-14)


def test_a_turns_about_z_b_about_y_c_about_x():
    """Each angle alone, by hand: what KUKA calls A, B, C."""
    quarter = {"A": [[0, -1, 0], [1, 0, 0], [0, 0, 1]], "C": [[1, 0, 0], [0, 0, -1], [0, 1, 0]]}
    for name, turn in quarter.items():
        found = Frame.from_pose(build_transform(np.array(turn, dtype=float), np.zeros(3))).abc_deg
        assert_allclose(found, np.array([90.0, 0.0, 0.0] if name == "A" else [0.0, 0.0, 90.0]))
    tilt = np.array([[0, 0, 1], [0, 1, 0], [-1, 0, 0]], dtype=float)
    assert_allclose(
        Frame.from_pose(build_transform(tilt, np.zeros(3))).abc_deg, [0.0, 90.0, 0.0], atol=1e-12
    )
    assert "Rz(A) Ry(B) Rx(C)" in ABC_ANGLES_CONVENTION


def test_tables_hold_every_digit_and_say_the_order():
    frame = Frame.from_pose(build_transform(TURNS[0], np.array([0.1, -2.0, 3.0])))
    places, turns = build_frame_tables({"base": frame}, "frames")
    assert places.rows == (("base", *frame.xyz_mm, *frame.abc_deg),)
    assert turns.rows == (("base", *frame.quaternion_wxyz, *frame.rotation_vector_rad),)
    assert ABC_ANGLES_CONVENTION in places.title
    assert frame.origin_distance_mm == pytest.approx(np.linalg.norm(frame.xyz_mm), rel=1e-15)
