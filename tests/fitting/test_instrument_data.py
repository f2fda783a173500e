"""Files of lengths, closures and poses: read as meant, or one line says why not."""

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

import minimax_cal as mc
from experiments.relative import (
    RELATIVE_LENGTH_NOISE,
    RELATIVE_TARGET_POSITION,
    ImperfectArm,
    is_within_limits,
    position_errors,
)
from minimax_cal.core.arrays import Array
from minimax_cal.fitting.multi_instrument.relative_calibration import relative
from minimax_cal.fitting.multi_instrument.relative_result import RelativeCalibration
from minimax_cal.instruments import (
    Instrument,
    Surface,
    closures,
    contacts,
    distances,
    flange_poses,
    read_relative,
    write_relative,
)
from minimax_cal.instruments.sockets import reach
from minimax_cal.robots.joint_sampling import random_joint_values_above_floor

# ---- instrument data -----------------------------------------------------------------------------


JOINTS = "q1_rad,q2_rad,q3_rad"


def poses(count: int, rng: np.random.Generator) -> np.ndarray:
    out = np.tile(np.eye(4), (count, 1, 1))
    out[:, :3, :3] = Rotation.random(count, rng=rng).as_matrix()
    out[:, :3, 3] = rng.normal(size=(count, 3))
    return out


def examples(rng: np.random.Generator) -> dict[str, Instrument]:
    q = rng.uniform(-2, 2, (12, 3))
    length = rng.uniform(0.5, 2, (12, 2))
    length[0, 1] = length[3, 0] = np.nan
    socket = np.array(["A", "B", "plate 3"] * 4)
    return {
        "distances": distances(q, length, order=np.arange(12)),
        "closures": closures(q, socket, split=np.array(["train", "holdout"] * 6)),
        "poses": flange_poses(
            q, poses(12, rng), u95=np.full(12, 2e-5), rotation_u95=np.full(12, 2e-4)
        ),
    }


@pytest.mark.parametrize("kind", ["distances", "closures", "poses"])
def test_what_is_written_is_read_back(kind, tmp_path, rng):
    data, path = examples(rng)[kind], tmp_path / "data.csv"
    write_relative(path, data)
    found = read_relative(path)
    assert found.kind == kind
    assert found.at.notices == ()
    assert found.at.line.tolist() == list(range(2, 14))
    # nine decimals of radians and millimetres
    assert_allclose(found.at.q, data.at.q, rtol=0, atol=1e-9)
    told = data.file_columns()
    assert list(found.file_columns()) == list(told) != []
    for name, column in found.file_columns().items():
        if column.dtype.kind == "U":
            assert column.tolist() == told[name].tolist()
        else:
            assert_allclose(column, told[name], rtol=0, atol=2e-9 if "rad" in name else 1e-9)
    assert set(found.at.columns) == set(data.at.columns)
    for name, column in data.at.columns.items():
        if column.dtype.kind == "U":
            assert found.at.columns[name].tolist() == column.tolist()
        else:
            assert_allclose(found.at.columns[name], column, rtol=0, atol=1e-9)


def test_slides_and_degrees_and_metres(tmp_path):
    path = tmp_path / "data.csv"
    rows = [f"{10 * i},{100 + i},{1.5 + 0.01 * i}" for i in range(6)]
    path.write_text("\n".join(["q1_deg,q2_mm,wire3_m", *rows]))
    found = read_relative(path)
    assert found.wires == ("wire3",)
    assert found.at.sliding.tolist() == [False, True]
    assert_allclose(found.at.q[5], [np.radians(50), 0.105], rtol=1e-14)
    assert_allclose(found.length[:, 0], 1.5 + 0.01 * np.arange(6), rtol=1e-14)


def test_quaternions_and_rotation_vectors_are_the_same_poses(tmp_path, rng):
    turn = Rotation.random(5, rng=rng)
    place = rng.normal(size=(5, 3))
    sign = np.array([1, -1, 1, -1, 1])  # q and -q are the same turn
    files = {
        "rx_deg,ry_deg,rz_deg": np.degrees(turn.as_rotvec()),
        "qw,qx,qy,qz": sign[:, None] * turn.as_quat(scalar_first=True),
    }
    for names, values in files.items():
        header = [f"flange_{name}" for name in ("x_m", "y_m", "z_m", *names.split(","))]
        path = tmp_path / "data.csv"
        lines = [
            ",".join(map(repr, map(float, (i, 2 * i, *place[i], *values[i])))) for i in range(5)
        ]
        path.write_text("\n".join([",".join(["q1_rad", "q2_rad", *header]), *lines]))
        found = read_relative(path)
        assert_allclose(found.pose[:, :3, :3], turn.as_matrix(), rtol=0, atol=1e-14)
        assert_allclose(found.pose[:, :3, 3], place, rtol=0, atol=1e-15)


def test_rows_and_columns_of_no_use_are_said(tmp_path):
    path = tmp_path / "data.csv"
    rows = [f"{i / 10},0,0,{500 + i},7,0.02" for i in range(6)] + ["0.7,0,0,,7,0.02"]
    path.write_text("\n".join([f"{JOINTS},wire1_mm,operator,u95_mm", *rows]))
    found = read_relative(path)
    assert found.poses == 6
    assert {*found.at.notices} == {
        f"{path}: 1 rows hold nothing measured and are left out",
        f"{path}: column operator is not used", f"{path}: column u95_mm is not used",
    }  # fmt: skip


GOOD = {
    "wire1_mm": [f"{500 + i}" for i in range(6)],
    "socket": ["A", "A", "A", "B", "B", "B"],
    "flange_x_mm,flange_y_mm,flange_z_mm,flange_rx_rad,flange_ry_rad,flange_rz_rad": [
        f"{i},2,3,0.1,0.2,0.3" for i in range(6)
    ],
    "flange_x_mm,flange_y_mm,flange_z_mm,flange_qw,flange_qx,flange_qy,flange_qz": [
        f"{i},2,3,1,0,0,0" for i in range(6)
    ],
}
WIRE, SOCKET, VECTOR, QUATERNION = GOOD
TOUCH = "surface,kind"


def changed(header: str, row: int, text: str) -> list[str]:
    return [text if i == row else cell for i, cell in enumerate(GOOD[header])]


@pytest.mark.parametrize(
    ("header", "cells", "place", "words"),
    [
        ("weight_kg", ["1"] * 6, ":1:", "no measured columns; name them wire1_mm"),
        ("wire1_cm", ["1"] * 6, ":1:", "column wire1_cm is not understood; write wire1_mm"),
        ("wire1_mm,wire1_m", ["1,1"] * 6, ":1:", "wire1 has two columns"),
        ("wire1_mm,socket", ["1,A"] * 6, ":1:", "columns wire1_mm and socket are of different"),
        (WIRE, changed(WIRE, 2, "-510"), ":4:", "column wire1_mm: -510 is no length"),
        (WIRE, changed(WIRE, 2, "0"), ":4:", "column wire1_mm: 0 is no length"),
        (WIRE, changed(WIRE, 2, "nan"), ":4:", "column wire1_mm: nan is not a finite number"),
        (WIRE, changed(WIRE, 2, "1e12"), ":4:", "is more than 100 km"),
        (WIRE, changed(WIRE, 2, "5x"), ":4:", "column wire1_mm: '5x' is not a number"),
        (WIRE, changed(WIRE, 2, "500;5"), ":4:", "is not a number"),
        ("wire1_mm,wire2_mm", [f"{500 + i}," for i in range(6)], ":", "wire2 is measured at 0"),
        (WIRE, ["500", "501", "", "", "", ""], ":", "wire1 is measured at 2 poses"),
        (WIRE, [""] * 6, ":", "nothing was measured at any pose"),
        (SOCKET, changed(SOCKET, 5, "C"), ":7:", "column socket: 'C' is visited once"),
        (SOCKET, [""] * 6, ":", "nothing was measured at any pose"),
        (VECTOR, changed(VECTOR, 2, "1,2,3,,0.2,0.3"), ":4:", "some of the flange's columns"),
        (VECTOR, changed(VECTOR, 2, "1,2,3,inf,0,0"), ":4:", "inf is not a finite number"),
        (VECTOR, changed(VECTOR, 2, "1e12,2,3,0,0,0"), ":4:", "is more than 100 km"),
        (QUATERNION, changed(QUATERNION, 2, "1,2,3,2,0,0,0"), ":4:", "length 2, not 1"),
        (VECTOR.replace("flange_ry_rad,", ""), ["1,2,3,4,5"] * 6, ":1:", "flange_ry_rad is mis"),
        (VECTOR.replace("flange_y_mm,", ""), ["1,2,3,4,5"] * 6, ":1:", "flange_y_mm is missing"),
        ("flange_x_mm,flange_y_mm,flange_z_mm", ["1,2,3"] * 6, ":1:", "give the flange's orien"),
        ("flange_rx_rad,flange_ry_rad,flange_rz_rad", ["1,2,3"] * 6, ":1:", "flange_x_mm is miss"),
        ("flange_x_cm", ["1"] * 6, ":1:", "column flange_x_cm is not understood"),
        ("surface", ["A"] * 5, ":1:", "column kind is missing"),
        (TOUCH, ["A,cone"] * 5, ":", "kind: 'cone' of surface 'A'; write plane or sphere"),
        (TOUCH, ["A,plane"] * 3, ":", "column surface: 'A' is touched at 3 different poses"),
        (TOUCH, ["A,sphere"] * 4, ":", "touch a sphere at 5 or more"),
        (TOUCH, ["A,plane"] * 5 + ["A,sphere"], ":7:", "surface 'A' has another kind, size"),
        (f"{TOUCH},radius_mm", ["A,sphere,-3"] * 6, ":", "a radius must be positive"),
        (f"{TOUCH},ball_radius_mm", ["A,plane,3"] * 5 + ["A,plane,4"], ":", "2 values; a probe"),
        (f"{TOUCH},normal_x", ["A,plane,1"] * 6, ":1:", "a face has normal_x, normal_y and nor"),
        (f"{TOUCH},socket", ["A,plane,1"] * 6, ":", "columns socket and surface are of different"),
        (TOUCH, [","] * 6, ":", "nothing was measured at any pose"),
    ],
)  # fmt: skip
def test_bad_columns_are_one_line_with_place_and_mend(header, cells, place, words, tmp_path):
    rows = [f"0.{i},0.2,-0.{i},{cell}" for i, cell in enumerate(cells)]
    check_refused(tmp_path / "bad.csv", "\n".join([f"{JOINTS},{header}", *rows]), place, words)


def check_refused(path: Path, text: str, place: str, words: str) -> None:
    path.write_text(text)
    with pytest.raises(mc.DataError) as caught:
        read_relative(path)
    message = str(caught.value)
    assert message.startswith(f"{path}{place}")
    assert words in message
    assert "\n" not in message


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "is empty"),
        (f"{JOINTS},wire1_mm\n", "holds a header but no rows"),
        ("wire1_mm\n500\n", "no joint columns"),
        ("q1_rad,q3_rad,wire1_mm\n0,0,5\n", "column q2_rad is missing"),
        (f"{JOINTS},wire1_mm\n0,0,0\n", "3 cells, but the header has 4"),
        (f"{JOINTS},wire1_mm\n,0,0,500\n", "column q1_rad: is empty"),
        (f"{JOINTS},wire1_mm\n" + "0,0,0,500\n" * 6, "holds one pose only"),
        (f"{JOINTS},socket\n0,0,0,A\n", "holds one pose only"),
        (f"{JOINTS},socket\n0,0,0,A\n0,0,0,A\n1,0,0,B\n2,0,0,B\n", "the same joint values only"),
    ],
)
def test_bad_files_are_one_line(text, words, tmp_path):
    check_refused(tmp_path / "bad.csv", text, ":", words)


def test_bad_arrays():
    q = np.arange(18.0).reshape(6, 3)
    with pytest.raises(mc.DataError, match="holds no poses"):
        distances(np.zeros((0, 3)), np.zeros((0, 1)))
    with pytest.raises(mc.DataError, match="joint 1 is not a finite number"):
        closures(np.full((6, 3), np.nan), np.repeat("A", 6))
    mirrored = np.tile(np.diag([1.0, 1.0, -1.0, 1.0]), (6, 1, 1))
    with pytest.raises(mc.DataError, match="no rigid motion"):
        flange_poses(q, mirrored)
    with pytest.raises(mc.DataError, match=r"must be \(m, 4, 4\)"):
        flange_poses(q, np.zeros((6, 4)))
    with pytest.raises(mc.DataError, match="pose has 4 entries, but there are 6 poses"):
        flange_poses(q, np.eye(4))
    with pytest.raises(mc.DataError, match="order has 5 entries"):
        closures(q, np.repeat(["A", "B"], 3), order=np.arange(5))
    with pytest.raises(mc.DataError, match=r"q must be \(m, n\)"):
        distances(q[0], np.ones(6))


# ---- contacts ------------------------------------------------------------------------------------


BALL, RADIUS, HALF = 0.01, 0.02, 0.1  # of the probe, of spheres, of the cube's edge [m]
FACES = np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1]], dtype=float)
Places = Callable[[int, np.random.Generator], tuple[Array, Array]]  # where, and the normals there


def touched(
    arm: ImperfectArm, rng: np.random.Generator, places: Places, count: int, noise: float
) -> Array:
    """Joints (count, n) at which the true arm's ball is at places of a surface."""
    q = np.zeros((0, arm.robot.joints))
    while len(q) < count:
        goal, normal = places(4 * count, rng)
        goal = goal + noise * rng.normal(size=(len(goal), 1)) * normal
        found, gap = reach(
            arm.real,
            RELATIVE_TARGET_POSITION,
            goal,
            random_joint_values_above_floor(arm.robot, len(goal), rng),
            30,
        )
        q = np.concatenate([q, found[(gap < 1e-9) & is_within_limits(arm.robot, found)]])[:count]
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
    arm: ImperfectArm, rng: np.random.Generator, shapes: list[tuple[Surface, Places]], noise: float,
    ball: float = np.nan,
) -> Instrument:  # fmt: skip
    q = [touched(arm, rng, places, 30, noise) for _, places in shapes]
    labels = np.repeat([surface.label for surface, _ in shapes], 30)
    return contacts(np.concatenate(q), labels, [surface for surface, _ in shapes], ball)


def planes(arm: ImperfectArm, seed: int, noise: float) -> Instrument:
    size, rng = arm.robot.reach(), np.random.default_rng([seed, 3])
    specs = [([0, 0, 1], [0.45, 0, 0.1]), ([-1, 0.1, 0], [0.6, 0, 0.4]),
             ([0, 1, 0.2], [0.3, -0.4, 0.35]), ([0.5, 0.5, 0.7], [-0.1, 0.4, 0.3])]  # fmt: skip
    boards = [board(np.array(n), size * np.array(c), 0.2) for n, c in specs]
    return contacts_with(arm, rng, [(Surface(f"B{i}"), b) for i, b in enumerate(boards)], noise)


def spheres(arm: ImperfectArm, seed: int, noise: float, *, known: bool = True) -> Instrument:
    size, rng = arm.robot.reach(), np.random.default_rng([seed, 4])
    centres = size * np.array([[0.45, 0.1, 0.25], [0.1, 0.5, 0.4], [-0.3, -0.4, 0.2]])
    radius, ball = (RADIUS, BALL) if known else (np.nan, np.nan)
    shapes = [(Surface(f"K{i}", "sphere", radius), dome(c)) for i, c in enumerate(centres)]
    return contacts_with(arm, rng, shapes, noise, ball)


def cube(arm: ImperfectArm, seed: int, noise: float) -> Instrument:
    rng, turn = np.random.default_rng([seed, 5]), Rotation.from_rotvec([0.2, -0.1, 0.5]).as_matrix()
    origin = arm.robot.reach() * np.array([0.45, 0.1, 0.3])
    shapes = [
        (Surface(f"F{i}", "plane", HALF, n), board(turn @ n, origin + HALF * turn @ n, HALF))
        for i, n in enumerate(FACES)
    ]
    return contacts_with(arm, rng, shapes, noise, BALL)


MAKERS = {"planes": planes, "spheres": spheres, "cube": cube}


@cache
def fitted(
    kind: str, name: str, seed: int, noise: float
) -> tuple[ImperfectArm, RelativeCalibration]:
    arm = ImperfectArm.draw(name, seed, 0.0)
    return arm, relative(arm.robot, MAKERS[kind](arm, seed, noise))


def off(arm: ImperfectArm, fit: RelativeCalibration, *, scaled: bool) -> float:
    """RMS error of fresh positions after the best rigid motion, or similarity [mm]."""
    spot = 1e-3 * np.array(fit.instrument["target_mm"])
    q = random_joint_values_above_floor(arm.robot, 300, np.random.default_rng(8))
    return float(
        1e3 * np.sqrt(np.mean(position_errors(arm, fit.robot, spot, q, with_scale=scaled) ** 2))
    )


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
            arm, fit = fitted(kind, name, seed, RELATIVE_LENGTH_NOISE)
            assert fit.accuracy["holdout"].rms_mm < 3e3 * RELATIVE_LENGTH_NOISE
            assert np.isnan(fit.position_sigma) == (kind == "planes")  # which know no length
            ratios.append(off(arm, fit, scaled=False) / (1e3 * fit.position_sigma))
    if kind == "planes":
        return
    assert 0.45 < np.sqrt(np.mean(np.square(ratios))) < 1.3
    assert max(ratios) < 3.0


def test_what_was_touched_is_where_it_is_said_to_be():
    _, fit = fitted("cube", "irb2600", 1, RELATIVE_LENGTH_NOISE)
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
    arm = ImperfectArm.draw("ur10", 2, 0.0)
    fit = relative(arm.robot, spheres(arm, 2, RELATIVE_LENGTH_NOISE, known=False))
    told = {p.name: p for p in fit.parameters}
    assert not told["ball_radius"].identifiable
    assert "all surfaces moved together" in told["ball_radius"].reason
    sums = [fit.instrument["surfaces"][f"K{i}"]["radius_mm"] for i in range(3)]
    assert_allclose(sums, 1e3 * (RADIUS + BALL), rtol=2e-3)  # by the scale of the drawing


def test_contacts_join_a_tracker():
    arm, rng = ImperfectArm.draw("irb2600", 0, 0.0), np.random.default_rng(1)
    q = random_joint_values_above_floor(arm.robot, 20, rng)
    seen = mc.measurements(
        q, arm.target_positions(q) + RELATIVE_LENGTH_NOISE * rng.normal(size=(20, 3))
    )
    fit = relative(arm.robot, [planes(arm, 0, RELATIVE_LENGTH_NOISE), seen])
    assert [one.name for one in fit.instruments] == ["contacts", "points"]
    assert not any("scale" in notice for notice in fit.notices)
    assert fit.instruments[1].directions_alone == 1  # the scale
    spot = 1e-3 * np.array(fit.instruments[0].instrument["target_mm"])
    checks = random_joint_values_above_floor(arm.robot, 300, np.random.default_rng(8))
    error = position_errors(arm, fit.robot, spot, checks, with_scale=False)
    assert np.sqrt(np.mean(error**2)) < 1.6 * fit.position_sigma < 40e-6


# ---- slips and files ---------------------------------------------------------------------------


def test_slips_are_named():
    arm = ImperfectArm.draw("irb2600", 1, 0.0)
    data = planes(arm, 1, RELATIVE_LENGTH_NOISE)
    turned = replace(data, at=replace(data.at, q=data.at.q * [1, 1, -1, 1, 1, 1]))
    with pytest.raises(mc.DataError, match="the sign of joint 3 looks reversed"):
        relative(arm.robot, turned)
    balls = spheres(arm, 1, RELATIVE_LENGTH_NOISE)
    small = tuple(replace(s, size=1e-3 * s.size) for s in balls.surfaces)
    with pytest.raises(mc.DataError, match=r"has a radius of .* mm, not 0.02 mm; check radius_mm"):
        relative(arm.robot, replace(balls, surfaces=small))


@pytest.mark.parametrize("kind", list(MAKERS))
def test_contacts_that_are_written_are_read_back(kind, tmp_path):
    data = MAKERS[kind](ImperfectArm.draw("ur10", 0, 0.0), 0, RELATIVE_LENGTH_NOISE)
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
