import numpy as np
import pytest
from numpy.testing import assert_allclose

import minimax_cal as mc
from minimax_cal.modelling.model import model_of
from minimax_cal.modelling.parameters import State
from minimax_cal.robots import kinematics
from minimax_cal.robots.gravity import G, torques

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
    model = model_of(robot, data)
    turn = kinematics.rotation(rng.normal(size=3))
    state = State(bent(robot, rng), turn, rng.normal(size=3), TARGETS)
    analytic = model.jacobian(state)
    for i in range(model.names.count):
        dx = np.zeros(model.names.count, dtype=complex)
        dx[i] = 1e-30j  # exact to rounding: no difference is taken
        moved = state.step(dx)
        links = kinematics.chain(moved.mdh, model.q, model.prismatic)
        point = np.swapaxes(kinematics.points(links, moved.target_positions), -1, -2)
        seen = point @ moved.rotation.T + moved.origin
        slope = (seen.imag / 1e-30) @ state.rotation  # from measurement into base axes
        assert_allclose(analytic[..., i], slope, rtol=0, atol=1e-14, err_msg=model.names.all[i])


def pinocchio_model(robot: mc.Robot):  # type: ignore[no-untyped-def]
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
    together = kinematics.forward(mdh, q, robot.prismatic)
    for one, alone in zip(mdh, together, strict=True):
        assert_allclose(kinematics.forward(one, q, robot.prismatic), alone, rtol=0, atol=1e-15)


@pytest.mark.parametrize("size", [0.0, 1e-12, 1e-5, 1.0, 3.1])
def test_rotation_is_scipys(size, rng):
    from scipy.spatial.transform import Rotation

    w = rng.normal(size=3)
    w *= size / np.linalg.norm(w)
    expected = Rotation.from_rotvec(w).as_matrix()
    assert_allclose(kinematics.rotation(w), expected, rtol=0, atol=1e-15)


def test_gravity_torque_is_the_slope_of_potential_energy(rng):
    robot = mc.load_robot("irb2600")
    mass, com = rng.uniform(1, 50, 6), rng.normal(size=(6, 3)) * 0.2
    up = rng.normal(size=3)
    up /= np.linalg.norm(up)
    q = rng.uniform(-3, 3, (5, 6))

    def energy(q: np.ndarray) -> np.ndarray:
        total = 0.0
        for i in range(6):  # each link alone, as a target on a shorter arm
            links = kinematics.chain(robot.mdh[: i + 1], q[:, : i + 1], robot.prismatic[: i + 1])
            point = kinematics.points(links, com[i][None])[0]
            total = total + mass[i] * G * (up @ point)
        return np.asarray(total)

    found = torques(kinematics.chain(robot.mdh, q, robot.prismatic), mass, com, up)
    for i in range(6):
        step = 1e-30j * np.eye(6)[i]
        assert_allclose(found[i], -energy(q + step).imag / 1e-30, rtol=0, atol=1e-10)
