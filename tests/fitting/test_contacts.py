"""Contacts of a probe with planes, spheres and a cube, against simulation with known truth."""

from collections.abc import Callable
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

import minimax_cal as mc
from experiments.relative import NOISE, SPOT, Arm, inside, position_errors
from minimax_cal.fitting.several import RelativeCalibration, relative
from minimax_cal.fitting.several.options import RelativeOptions
from minimax_cal.fitting.several.stack import Block, Stack, own_state
from minimax_cal.ground.arrays import Array
from minimax_cal.instruments import Instrument, Surface, contacts, read_relative, write_relative
from minimax_cal.instruments.closing import reach
from minimax_cal.instruments.shapes import fit_plane, fit_sphere
from minimax_cal.robots.kinematics import forward, hat
from minimax_cal.robots.sampling import random_poses

BALL, RADIUS, HALF = 0.01, 0.02, 0.1  # of the probe, of spheres, of the cube's edge [m]
FACES = np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1]], dtype=float)
Places = Callable[[int, np.random.Generator], tuple[Array, Array]]  # where, and the normals there


def touched(arm: Arm, rng: np.random.Generator, places: Places, count: int, noise: float) -> Array:
    """Joints (count, n) at which the true arm's ball is at places of a surface."""
    q = np.zeros((0, arm.robot.joints))
    while len(q) < count:
        goal, normal = places(4 * count, rng)
        goal = goal + noise * rng.normal(size=(len(goal), 1)) * normal
        found, gap = reach(arm.real, SPOT, goal, random_poses(arm.robot, len(goal), rng), 30)
        q = np.concatenate([q, found[(gap < 1e-9) & inside(arm.robot, found)]])[:count]
    return q


def board(normal: Array, centre: Array, half: float) -> Places:
    """A square patch of a plane; the ball's centre is off it by its radius."""
    n = np.asarray(normal) / np.linalg.norm(normal)
    across = np.linalg.svd(n[None])[2][1:]

    def places(count: int, rng: np.random.Generator) -> tuple[Array, Array]:
        p = centre + rng.uniform(-half, half, (count, 2)) @ across + BALL * n
        return p, np.broadcast_to(n, p.shape)

    return places


def dome(centre: Array) -> Places:
    def places(count: int, rng: np.random.Generator) -> tuple[Array, Array]:
        n = rng.normal(size=(count, 3))
        n[:, 2] = np.abs(n[:, 2])
        n /= np.linalg.norm(n, axis=1)[:, None]
        return centre + (RADIUS + BALL) * n, n

    return places


def contacts_with(
    arm: Arm, rng: np.random.Generator, shapes: list[tuple[Surface, Places]], noise: float,
    ball: float = np.nan,
) -> Instrument:  # fmt: skip
    q = [touched(arm, rng, places, 30, noise) for _, places in shapes]
    labels = np.repeat([surface.label for surface, _ in shapes], 30)
    return contacts(np.concatenate(q), labels, [surface for surface, _ in shapes], ball)


def planes(arm: Arm, seed: int, noise: float) -> Instrument:
    size, rng = arm.robot.reach(), np.random.default_rng([seed, 3])
    specs = [([0, 0, 1], [0.45, 0, 0.1]), ([-1, 0.1, 0], [0.6, 0, 0.4]),
             ([0, 1, 0.2], [0.3, -0.4, 0.35]), ([0.5, 0.5, 0.7], [-0.1, 0.4, 0.3])]  # fmt: skip
    boards = [board(np.array(n), size * np.array(c), 0.2) for n, c in specs]
    return contacts_with(arm, rng, [(Surface(f"B{i}"), b) for i, b in enumerate(boards)], noise)


def spheres(arm: Arm, seed: int, noise: float, *, known: bool = True) -> Instrument:
    size, rng = arm.robot.reach(), np.random.default_rng([seed, 4])
    centres = size * np.array([[0.45, 0.1, 0.25], [0.1, 0.5, 0.4], [-0.3, -0.4, 0.2]])
    radius, ball = (RADIUS, BALL) if known else (np.nan, np.nan)
    shapes = [(Surface(f"K{i}", "sphere", radius), dome(c)) for i, c in enumerate(centres)]
    return contacts_with(arm, rng, shapes, noise, ball)


def cube(arm: Arm, seed: int, noise: float) -> Instrument:
    rng, turn = np.random.default_rng([seed, 5]), Rotation.from_rotvec([0.2, -0.1, 0.5]).as_matrix()
    origin = arm.robot.reach() * np.array([0.45, 0.1, 0.3])
    shapes = [
        (Surface(f"F{i}", "plane", HALF, n), board(turn @ n, origin + HALF * turn @ n, HALF))
        for i, n in enumerate(FACES)
    ]
    return contacts_with(arm, rng, shapes, noise, BALL)


MAKERS = {"planes": planes, "spheres": spheres, "cube": cube}


@cache
def fitted(kind: str, name: str, seed: int, noise: float) -> tuple[Arm, RelativeCalibration]:
    arm = Arm.of(name, seed, 0.0)
    return arm, relative(arm.robot, MAKERS[kind](arm, seed, noise))


def off(arm: Arm, fit: RelativeCalibration, *, scaled: bool) -> float:
    """RMS error of fresh positions after the best rigid motion, or similarity [mm]."""
    spot = 1e-3 * np.array(fit.instrument["target_mm"])
    q = random_poses(arm.robot, 300, np.random.default_rng(8))
    return float(
        1e3 * np.sqrt(np.mean(position_errors(arm, fit.robot, spot, q, scaled=scaled) ** 2))
    )


# ---- the rows ----------------------------------------------------------------------------------


def plain_gaps(block: Block, robot: mc.Robot, x: Array) -> Array:
    """The gaps at parameters x of a stack, by matrices alone: any dtype."""
    n, shapes, touched = robot.joints, block.instrument.shapes, block.instrument.touched
    pose = forward(x[: 5 * n].reshape(5, n).T, block.arm.q, robot.prismatic)
    own = x[5 * n + 6 :]
    p = pose[:, :3, :3] @ own[:3] + pose[:, :3, 3]
    out = np.zeros(len(p), dtype=x.dtype)
    body = shapes.turn @ expm(hat(own[-4:-1].real) + 1j * hat(own[-4:-1].imag))
    for at, slot in enumerate(shapes.slots()):
        here, surface, values = touched == at, shapes.surfaces[at], own[slot]
        if surface.kind == "sphere":
            distance = np.sqrt(((p[here] - values[:3]) ** 2).sum(axis=1))
        elif surface.is_face:
            distance = (p[here] - own[-7:-4]) @ (body @ surface.normal)
        else:
            normal = shapes.axes[at, 0] + values[0] * shapes.axes[at, 1]
            normal = normal + values[1] * shapes.axes[at, 2]
            distance = p[here] @ normal / np.sqrt((normal**2).sum())
        out[here] = distance - values[-1] - own[-1]
    return out


@pytest.mark.parametrize("name", ["irb2600", "scara_600"])
def test_slopes_are_the_derivative_by_complex_step(name, rng):
    robot = mc.load_robot(name)
    surfaces = [Surface("A"), Surface("B", "sphere"), Surface("C", "plane", 0.1, FACES[0]),
                Surface("D", "plane", np.nan, FACES[2]), Surface("E", "sphere", 0.3)]  # fmt: skip
    q, labels = random_poses(robot, 40, rng), [s.label for s in surfaces] * 8
    probe = contacts(q, labels, surfaces).ready(robot, RelativeOptions())
    stack = Stack.of(robot, [probe], [""])
    block = stack.blocks[0]
    x = own_state(robot.mdh, 0.5 * rng.normal(size=len(probe.names)))
    error, jacobian = stack.rows(x, stack.movable)
    values = np.concatenate([x.mdh.T.reshape(-1), np.zeros(6), x.effects]).astype(complex)
    assert_allclose(-error, plain_gaps(block, robot, values).real, rtol=0, atol=1e-13)
    for column, i in enumerate(np.flatnonzero(stack.movable)):
        moved = values.copy()
        moved[i] += 1e-30j
        slope = plain_gaps(block, robot, moved).imag / 1e-30
        assert_allclose(jacobian[column], slope, rtol=0, atol=1e-12)


def test_planes_and_spheres_are_found_in_closed_form(rng):
    normal, centre = np.array([2.0, -1.0, 2.0]) / 3.0, np.array([0.3, -0.2, 0.9])
    flat = rng.normal(size=(20, 3))
    flat -= ((flat @ normal) - 0.4)[:, None] * normal
    found, offset = fit_plane(flat)
    assert_allclose(found * np.sign(offset), normal, atol=1e-12)
    assert_allclose(abs(offset), 0.4, atol=1e-12)
    way = rng.normal(size=(20, 3))
    ball = centre + 0.05 * way / np.linalg.norm(way, axis=1)[:, None]
    for radius in (np.nan, 0.05):
        place, size = fit_sphere(ball, radius)
        assert_allclose(place, centre, atol=1e-12)
        assert_allclose(size, 0.05, atol=1e-12)


# ---- what the fit finds ------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["irb2600", "ur10"])
@pytest.mark.parametrize("kind", list(MAKERS))
def test_without_noise_the_true_arm_is_found(kind, name):
    arm, fit = fitted(kind, name, 1, 0.0)
    assert fit.status == "converged"
    assert fit.accuracy["nominal"].rms_mm > 0.3
    assert fit.accuracy["holdout"].max_mm < 1e-6
    # of the arm and the ball, and of four planes, three spheres, one body
    assert fit.identified == {"planes": 20 + 12, "spheres": 21 + 9, "cube": 21 + 6}[kind]
    # planes have no length: the arm is found but for its scale
    assert off(arm, fit, scaled=kind == "planes") < 1e-5
    assert any("scale is not identifiable from contacts" in n for n in fit.notices) == (
        kind == "planes"
    )


@pytest.mark.parametrize("kind", list(MAKERS))
def test_errors_are_what_the_sigmas_say(kind):
    ratios = []
    for name in ("irb2600", "ur10"):
        for seed in range(4):
            arm, fit = fitted(kind, name, seed, NOISE)
            assert fit.accuracy["holdout"].rms_mm < 3e3 * NOISE
            assert np.isnan(fit.position_sigma) == (kind == "planes")  # which know no length
            ratios.append(off(arm, fit, scaled=False) / (1e3 * fit.position_sigma))
    if kind == "planes":
        return
    assert 0.45 < np.sqrt(np.mean(np.square(ratios))) < 1.3
    assert max(ratios) < 3.0


def test_what_was_touched_is_where_it_is_said_to_be():
    _, fit = fitted("cube", "irb2600", 1, NOISE)
    found = fit.instrument["surfaces"]
    normals = np.array([found[f"F{i}"]["normal"] for i in range(5)])
    assert_allclose(normals @ normals.T, FACES @ FACES.T, atol=1e-9)  # a cube
    sizes = [found[f"F{i}"]["offset_mm"] for i in range(4)]
    assert_allclose([sizes[0] + sizes[1], sizes[2] + sizes[3]], 2e3 * HALF, atol=1e-6)
    names = {p.name for p in fit.parameters}
    assert {"body_x", "body_rz"} <= names
    assert "ball_radius" not in names  # given
    assert "surface_F0_offset" not in names


def test_unknown_radii_of_ball_and_spheres_are_said_to_be_one():
    arm = Arm.of("ur10", 2, 0.0)
    fit = relative(arm.robot, spheres(arm, 2, NOISE, known=False))
    told = {p.name: p for p in fit.parameters}
    assert not told["ball_radius"].identifiable
    assert "all surfaces moved together" in told["ball_radius"].reason
    sums = [fit.instrument["surfaces"][f"K{i}"]["radius_mm"] for i in range(3)]
    assert_allclose(sums, 1e3 * (RADIUS + BALL), rtol=2e-3)  # by the scale of the drawing


def test_contacts_join_a_tracker():
    arm, rng = Arm.of("irb2600", 0, 0.0), np.random.default_rng(1)
    q = random_poses(arm.robot, 20, rng)
    seen = mc.measurements(q, arm.place(q) + NOISE * rng.normal(size=(20, 3)))
    fit = relative(arm.robot, [planes(arm, 0, NOISE), seen])
    assert [one.name for one in fit.instruments] == ["contacts", "points"]
    assert not any("scale" in notice for notice in fit.notices)
    assert fit.instruments[1].directions_alone == 1  # the scale
    spot = 1e-3 * np.array(fit.instruments[0].instrument["target_mm"])
    checks = random_poses(arm.robot, 300, np.random.default_rng(8))
    error = position_errors(arm, fit.robot, spot, checks, scaled=False)
    assert np.sqrt(np.mean(error**2)) < 1.6 * fit.position_sigma < 40e-6


# ---- slips and files ---------------------------------------------------------------------------


def test_slips_are_named():
    arm = Arm.of("irb2600", 1, 0.0)
    data = planes(arm, 1, NOISE)
    turned = replace(data, at=replace(data.at, q=data.at.q * [1, 1, -1, 1, 1, 1]))
    with pytest.raises(mc.DataError, match="the sign of joint 3 looks reversed"):
        relative(arm.robot, turned)
    balls = spheres(arm, 1, NOISE)
    small = tuple(replace(s, size=1e-3 * s.size) for s in balls.surfaces)
    with pytest.raises(mc.DataError, match=r"has a radius of .* mm, not 0.02 mm; check radius_mm"):
        relative(arm.robot, replace(balls, surfaces=small))


@pytest.mark.parametrize("kind", list(MAKERS))
def test_what_is_written_is_read_back(kind, tmp_path):
    data = MAKERS[kind](Arm.of("ur10", 0, 0.0), 0, NOISE)
    path = tmp_path / "contacts.csv"
    write_relative(path, data)
    found = read_relative(path)
    assert found.kind == "contacts"
    assert found.at.notices == ()
    assert found.surface.tolist() == data.surface.tolist()
    assert_allclose(found.ball_radius, data.ball_radius, rtol=0, atol=1e-12)
    for one, other in zip(found.surfaces, data.surfaces, strict=True):
        assert (one.label, one.kind) == (other.label, other.kind)
        assert_allclose(one.size, other.size, rtol=0, atol=1e-12)
        assert_allclose(one.normal, other.normal, rtol=0, atol=1e-12)
