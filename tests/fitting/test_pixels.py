"""Pixels as an instrument: the lens, the derivatives, the fit, and what it must not claim."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.optimize import minimize

import minimax_cal as mc
from experiments.pixel_cells import (
    PixelCell,
    SimulatedCamera,
    board_corner_points,
    build_pixel_data,
    draw_gear_error_law,
    pixels_of_targets,
    rms_arm_error_mm,
    simulate_pixel_cell,
)
from minimax_cal.core.arrays import Array
from minimax_cal.fitting.multi_instrument.instrument_stack import build_own_state
from minimax_cal.fitting.multi_instrument.relative_result import PositionClaim
from minimax_cal.fitting.pixels.calibrate import (
    calibrate_pixel_data,
    conclude_pixel_calibration,
    fit_and_estimate_uncertainty,
)
from minimax_cal.fitting.pixels.fit import PixelSquares
from minimax_cal.fitting.pixels.options import PixelOptions, check_pixel_options, parse_lens_sigmas
from minimax_cal.fitting.pixels.pixel_start import (
    merge_camera_placements,
    place_camera_by_rotation_search,
    start_scene,
    undistorted_directions,
)
from minimax_cal.instruments.camera_images import CameraImages, TargetSight
from minimax_cal.instruments.camera_model import (
    FITTED_INTRINSICS,
    pixel_derivatives,
    project_to_pixels,
    undistort_pixels,
)
from minimax_cal.instruments.pixel_data import PixelData
from minimax_cal.measuring.pose_groups import select_holdout_rows
from minimax_cal.modelling.parameters import ParameterValues
from minimax_cal.robots.joint_sampling import random_joint_values
from minimax_cal.robots.robot import robot_from_dict
from minimax_cal.robots.transforms import build_transform
from minimax_cal.robots.urdf_file import parse_urdf
from minimax_cal.robots.urdf_robot import convert_urdf_to_robot
from minimax_cal.solvers.status import Status

LENS = np.array([2500, 2510, 1220, 1030, -0.1, 0.05, 1e-3, -2e-3, 0.01, 0.02, 0.01, 3e-3,
                 1e-3, 2e-3, -1e-3, 5e-4])  # fmt: skip
EXACT = 1e-9  # of pixels, beside 1e3 of them
SMALL, WIDE = (6, 5), 0.04  # a board with few corners
GIVEN_MM = 0.03  # arm error with 30 poses of 30 corners, lenses known to the data


def cell_of(seed: int, **more: object) -> PixelCell:
    """A small cell."""
    points = board_corner_points(SMALL, WIDE)
    return simulate_pixel_cell(
        np.random.default_rng(seed), **{"target_points": points, "pose_count": 30} | more
    )


@pytest.fixture(scope="module", params=[True, False], ids=["eye in hand", "eye to hand"])
def cell(request: pytest.FixtureRequest) -> PixelCell:
    return cell_of(2, on_flange=request.param)


@pytest.fixture(scope="module")
def ground() -> PixelCell:
    return cell_of(2, on_flange=False)


# ---- the lens --------------------------------------------------------------------------------


def test_projection_is_that_of_opencv():
    cv2 = pytest.importorskip("cv2", reason="OpenCV is not installed")
    rng = np.random.default_rng(0)
    point = rng.uniform(-0.3, 0.3, (40, 3)) + np.array([0.0, 0.0, 0.7])
    matrix = np.array([[LENS[0], 0, LENS[2]], [0, LENS[1], LENS[3]], [0, 0, 1]])
    for count in (4, 5, 8, 12):
        given = np.concatenate([LENS[4 : 4 + count], np.zeros(12 - count)])
        theirs, _ = cv2.projectPoints(point, np.zeros(3), np.zeros(3), matrix, LENS[4 : 4 + count])
        x, y = (point[:, :2] / point[:, 2:]).T
        ours = project_to_pixels(np.array([*LENS[:4], *given])[:, None], x, y)
        assert_allclose(ours.T, theirs[:, 0], rtol=0, atol=EXACT)


def test_slopes_are_the_derivatives_of_the_projection():
    rng, step = np.random.default_rng(0), 1e-30
    x, y = rng.uniform(-0.4, 0.4, (2, 30))
    lens = LENS[:, None]
    pixel, by, own = pixel_derivatives(lens, x, y)
    assert_allclose(pixel, project_to_pixels(lens, x, y), rtol=0, atol=EXACT)
    assert_allclose(by[0], project_to_pixels(lens, x + 1j * step, y + 0j).imag / step, rtol=1e-12)
    assert_allclose(by[1], project_to_pixels(lens, x + 0j, y + 1j * step).imag / step, rtol=1e-12)
    for i in range(len(FITTED_INTRINSICS)):
        moved = lens.astype(complex)
        moved[i] += 1j * step
        slope = project_to_pixels(moved, x + 0j, y + 0j).imag / step
        assert_allclose(own[i], slope, rtol=0, atol=1e-10)


def test_undistorted_is_the_inverse():
    x, y = np.random.default_rng(0).uniform(-0.4, 0.4, (2, 50))
    back = undistort_pixels(LENS[:, None], project_to_pixels(LENS[:, None], x, y))
    assert_allclose(back, np.stack([x, y]), rtol=0, atol=1e-13)


# ---- the model -------------------------------------------------------------------------------


def scene_of(cell: PixelCell, data: PixelData) -> tuple[PixelSquares, ParameterValues]:
    """Every twentieth pixel, and a state near the truth whose turns are none; lenses have files."""
    started = start_scene(cell.drawn, data, cell.on_flange)
    some = data.take_pixels(np.arange(data.pixel_count) % 20 == 0)
    images = replace(started.images, pixels=some, weight=np.ones(some.pixel_count))
    own = started.state.effects.copy()
    own[3:6] += (0.2, -0.1, 0.3)
    problem = PixelSquares.from_images(
        cell.drawn, replace(images, noise=0.1, doubt=np.full((1, 9), 0.5))
    )
    return replace(problem, active=problem.stack.movable), replace(started.state, effects=own)


@pytest.mark.parametrize("board", [True, False], ids=["board", "tags"])
@pytest.mark.parametrize("kind", ["pixels", "given depths"])
def test_rows_are_the_derivatives_of_the_pixels(cell, board, kind):
    problem, x = scene_of(cell, build_pixel_data(cell, with_board=board))
    if kind == "given depths":
        pixels = problem.images.pixels
        depth = np.linspace(0.3, 0.6, pixels.pixel_count)
        problem = problem.with_image_changes(
            sight=TargetSight(depth, undistorted_directions(pixels))
        )
    _, rows = problem.stack.rows(x, problem.active)
    free, step = int(problem.active.sum()), 1e-6
    for i in range(free):
        move = step * (np.arange(free) == i)
        ends = (problem.step(x, way * move) for way in (1, -1))
        there, back = (problem.stack.rows(end, problem.active)[0] for end in ends)
        slope = (back - there) / (2.0 * step)
        assert_allclose(rows[i], slope, rtol=0, atol=2e-6 * max(float(np.abs(rows[i]).max()), 1.0))


def test_joints_move_pixels_in_their_order():
    """Of an arm whose third of four joints slides, by differences of the joint values."""
    robot, step, rng = mc.load_robot("scara_600"), 1e-6, np.random.default_rng(0)
    q, above = (
        random_joint_values(robot, (5,), rng),
        build_transform(np.diag([1.0, -1.0, -1.0]), np.eye(3)[2]),
    )
    cell = PixelCell(
        robot,
        robot,
        False,
        (SimulatedCamera(above),),
        board_corner_points(SMALL, WIDE),
        np.eye(4),
        q,
        np.zeros((1, 5, 30, 2)),
        tuple(map(str, range(30))),
    )

    def seen(q: Array) -> tuple[PixelSquares, ParameterValues]:
        images, own = CameraImages.build_with_start(
            build_pixel_data(replace(cell, q=q)),
            above[None],
            np.eye(4),
            cell.points,
            on_flange=False,
        )
        return PixelSquares.from_images(robot, images), build_own_state(robot.mdh, own)

    problem, x = seen(q)
    for joint, slope in enumerate(problem.joint_jacobian(x)):
        back, there = (one.errors(x) for one, x in (
            seen(q + way * step * robot.chain_joint_values(np.eye(4))[joint])
            for way in (-1, 1)))  # fmt: skip
        assert_allclose(slope, (back - there).reshape(-1) / (2.0 * step), rtol=1e-6, atol=1e-3)


@pytest.mark.parametrize(
    "board", [pytest.param(True, marks=pytest.mark.slow), False], ids=["board", "tags"]
)
def test_a_search_over_rotations_needs_no_board(cell, board):
    data = build_pixel_data(cell, with_board=board)
    told = place_camera_by_rotation_search(
        cell.drawn, data, cell.on_flange, undistorted_directions(data), 0
    )
    images, own = merge_camera_placements(data, cell.on_flange, [told])
    away = np.linalg.norm(images.camera_and_board_frames(own)[1][0] - cell.views[0].pose[:3, 3])
    assert away < 0.01
    error = PixelSquares.from_images(cell.drawn, images).errors(
        build_own_state(cell.drawn.mdh, own)
    )
    assert np.median(np.linalg.norm(error, axis=0)) < 30.0


# ---- the fit ---------------------------------------------------------------------------------


def test_the_arm_comes_out_and_its_sigma_is_true(cell):
    fit = calibrate_pixel_data(cell.drawn, build_pixel_data(cell), PixelOptions())
    assert fit.status is Status.CONVERGED
    assert rms_arm_error_mm(cell, cell.drawn) > 0.5
    assert rms_arm_error_mm(cell, fit.robot) < GIVEN_MM
    assert rms_arm_error_mm(cell, fit.robot) < 2.0 * 1e3 * fit.claim.sigma < 4.0 * GIVEN_MM
    assert fit.instrument["cameras_in"] == ("flange" if cell.on_flange else "base")
    assert 0.1 < fit.pixels["holdout"][0] < 0.25
    assert fit.pixels["nominal"][0] > 2.0


def test_two_cameras_are_better_than_one():
    cell = cell_of(4, views=two_views())
    data = build_pixel_data(cell)
    both = calibrate_pixel_data(cell.drawn, data, PixelOptions())
    one = replace(data.take_pixels(data.camera == 0), cameras=data.cameras[:1])
    alone = calibrate_pixel_data(cell.drawn, one, PixelOptions())
    assert both.claim.sigma < alone.claim.sigma
    assert rms_arm_error_mm(cell, both.robot) < GIVEN_MM


def test_tags_of_unknown_place_leave_the_scale_to_the_drawing():
    rng = np.random.default_rng(3)
    points = rng.uniform(-1, 1, (15, 3)) * [0.3, 0.3, 0.05]
    cell = simulate_pixel_cell(
        rng, target_points=points, min_visible_share=0.3, link_error_sigmas=(0.3e-3, 0.5e-3)
    )
    fit = calibrate_pixel_data(
        cell.drawn, build_pixel_data(cell, with_board=False), PixelOptions(camera_on="flange")
    )
    assert fit.status is Status.CONVERGED
    assert any("scale is that of the drawing" in notice for notice in fit.notices)
    assert 0.1e-3 < fit.claim.sigma < 0.5e-3  # 0.3 mm of drawn lengths
    assert rms_arm_error_mm(cell, fit.robot) < 2.0 * 1e3 * fit.claim.sigma
    scaled = cell.true.mdh.copy()  # the same arm, larger as the pixels allow
    scaled[:, :2] *= fit.robot.mdh[1, 0] / cell.true.mdh[1, 0]
    assert rms_arm_error_mm(replace(cell, true=cell.true.with_mdh(scaled)), fit.robot) < 0.1


def test_corners_of_unknown_place_need_no_more_poses():
    cell = cell_of(2, target_points=board_corner_points((8, 7), 0.025))
    options = PixelOptions(holdout=0.0, camera_on="flange")
    fit = calibrate_pixel_data(cell.drawn, build_pixel_data(cell, with_board=False), options)
    assert fit.status is Status.CONVERGED
    assert sum(p.name.startswith("target_") for p in fit.parameters) == 3 * len(cell.names)


@pytest.mark.parametrize("off", [1.001, pytest.param(0.999, marks=pytest.mark.slow)])
def test_lenses_that_are_wrong_and_held_are_counted(cell, off):
    data = wrong_lens(build_pixel_data(cell), off)
    fit = calibrate_pixel_data(
        cell.drawn, data, PixelOptions(fix_camera=True, camera_prior="f 0.1%")
    )
    assert rms_arm_error_mm(cell, fit.robot) < 2.0 * 1e3 * fit.claim.sigma
    free = calibrate_pixel_data(cell.drawn, data, PixelOptions())
    assert rms_arm_error_mm(cell, free.robot) < GIVEN_MM


def test_wrong_pixels_are_named(cell):
    rng, data = np.random.default_rng(1), build_pixel_data(cell)
    wrong = rng.random(data.pixel_count) < 0.05
    pixel = data.pixel + np.where(wrong[:, None], 3.0 + rng.exponential(30.0, data.pixel.shape), 0)
    fit = calibrate_pixel_data(cell.drawn, replace(data, pixel=pixel), PixelOptions())
    assert {point.row for point in fit.set_aside} == set(data.line[wrong].tolist())
    assert rms_arm_error_mm(cell, fit.robot) < GIVEN_MM
    assert fit.with_them is not None
    assert fit.with_them.rms_mm > 5.0 * fit.accuracy["holdout"].rms_mm


def test_an_image_with_other_joints_is_named_whole(cell):
    data = build_pixel_data(cell)
    q = data.at.q.copy()
    q[7] += 0.1
    fit = calibrate_pixel_data(cell.drawn, replace(data, at=replace(data.at, q=q)), PixelOptions())
    assert any("whole images are outliers" in n and "pose P7 of" in n for n in fit.notices)
    assert rms_arm_error_mm(cell, fit.robot) < GIVEN_MM


@pytest.mark.parametrize("kind", ["two images lost", "any order"])
def test_images_of_other_poses_are_named(cell, kind):
    data = build_pixel_data(cell)
    m = data.at.poses
    image = np.delete(np.arange(m), [8, 9])  # the image that stands where pose 0, 1, ... was
    if kind == "any order":
        image = np.random.default_rng(3).permutation(m)
    place = np.full(m, -1)
    place[image] = np.arange(len(image))
    mixed = data.take_pixels(place[data.pose] >= 0)
    mixed = replace(mixed, pose=place[mixed.pose])
    with pytest.raises(mc.DataError, match="are paired with other poses: that of") as caught:
        calibrate_pixel_data(cell.drawn, mixed, PixelOptions(holdout=0.0))
    named = re.search(
        r"(\d+) of (\d+) images .* of pose P(\d+) is of pose P(\d+);", str(caught.value)
    )
    assert named is not None
    first = int(np.argmax(image != np.arange(len(image))))
    right = [np.count_nonzero(image != np.arange(len(image))), len(image), first, image[first]]
    assert [int(each) for each in named.groups()] == right


def test_what_judges_a_fit_is_not_set_aside_by_it(cell):
    """Held-out images of an arm whose joint 2 has moved: all misses count, wrong corners do not."""
    data, options = build_pixel_data(cell), PixelOptions()
    before = calibrate_pixel_data(cell.drawn, data, options)
    held, _ = select_holdout_rows(data.at, options.holdout, options.seed)
    q = data.at.q.copy()
    q[held, 1] += 0.01
    rows = np.flatnonzero(held[data.pose])[::40]
    pixel = data.pixel.copy()
    pixel[rows] += 25.0
    moved = replace(data, at=replace(data.at, q=q), pixel=pixel)
    after = calibrate_pixel_data(cell.drawn, moved, options)
    assert {point.row for point in after.set_aside} == set(data.line[rows].tolist())
    turned = cell.true.pose(data.at.q[held])[:, :3, 3] - cell.true.pose(q[held])[:, :3, 3]
    assert after.pixels["holdout"][0] > 50.0 * before.pixels["holdout"][0]
    far = np.sqrt((turned**2).sum(axis=1).mean())  # the flange's; a camera sees less, or a lever
    assert 0.2 * far < 1e-3 * after.accuracy["holdout"].rms_mm < 3.0 * far


def test_a_lens_that_is_held_is_known(ground):
    """Its true focal length held tells more of the arm than the same length freed with a prior."""
    held, freed, doubted = (
        calibrate_pixel_data(ground.drawn, build_pixel_data(ground), PixelOptions(**given))
        for given in ({"fix_camera": True}, {}, {"fix_camera": True, "camera_prior": "f 0.1%"})
    )
    assert held.claim.sigma <= freed.claim.sigma < doubted.claim.sigma
    assert rms_arm_error_mm(ground, held.robot) < 2.0 * 1e3 * held.claim.sigma
    assert held.status is Status.CONVERGED


def test_a_gantry_is_calibrated():
    """Three slides and a wrist whose drawn links are all zero: no load has a lever as drawn."""
    joints = "".join(
        f'<joint name="j{i}" type="{kind}"><parent link="l{i}"/><child link="l{i + 1}"/>'
        f'<axis xyz="{axis}"/><limit lower="-0.5" upper="0.5"/></joint>'
        for i, (kind, axis) in enumerate(zip(["prismatic"] * 3 + ["revolute"] * 3,
                                             ["1 0 0", "0 1 0", "0 0 1"] * 2, strict=True))
    )  # fmt: skip
    links = "".join(f'<link name="l{i}"/>' for i in range(7))
    urdf = parse_urdf(f'<robot name="gantry">{links}{joints}</robot>'.encode())
    drawn = robot_from_dict(convert_urdf_to_robot(urdf).content, "gantry")
    assert not drawn.mdh[:, :2].any()
    rng = np.random.default_rng(2)
    true = drawn.with_mdh(drawn.mdh + rng.normal(size=(6, 5)) * [3e-4, 3e-4, 1e-3, 1e-3, 0.0])
    points, place = (
        board_corner_points(SMALL, WIDE),
        build_transform(np.eye(3), np.array([0.01, 0.0, 0.04])),
    )
    facing = build_transform(np.diag([1.0, -1.0, -1.0]), np.array([0.0, 0.0, 0.6]))
    view = SimulatedCamera(drawn.pose(np.zeros(6)) @ place @ facing)
    q = rng.uniform(-1, 1, (40, 6)) * [0.08, 0.08, 0.06, 0.4, 0.4, 0.4]
    pixel = pixels_of_targets(
        view, true, q, points @ place[:3, :3].T + place[:3, 3], on_flange=False
    )
    pixel = (pixel + rng.normal(size=pixel.shape) * 0.106)[None]
    names = tuple(f"c{i}" for i in range(len(points)))
    cell = PixelCell(drawn, true, False, (view,), points, place, q, pixel, names)
    fit = calibrate_pixel_data(drawn, build_pixel_data(cell), PixelOptions())
    assert fit.status in (Status.CONVERGED, Status.NO_BETTER)
    assert_allclose(fit.pixels["holdout"][0], 0.15, rtol=0.1)
    assert rms_arm_error_mm(cell, fit.calibrated) < 2.0 * 1e3 * fit.claim.sigma


# ---- the minimax -----------------------------------------------------------------------------


def two_views() -> tuple[SimulatedCamera, SimulatedCamera]:
    """Two cameras on the flange."""
    poses = np.tile(np.eye(4), (2, 1, 1))
    poses[:, :3, 3] = (0.04, -0.03, 0.08), (-0.06, 0.02, 0.08)
    return SimulatedCamera(poses[0]), SimulatedCamera(
        poses[1], lens=(2300.0, 2300.0, 1200.0, 1000.0)
    )


@pytest.mark.parametrize(("objective", "count"), [("minimax", 24), ("camera", 2)])
def test_the_minimax_is_that_of_slsqp(objective, count):
    cell = cell_of(
        4, views=two_views(), target_points=board_corner_points((4, 3), 0.06), pose_count=20
    )
    data, options = build_pixel_data(cell), PixelOptions(objective=objective, fix_camera=True)
    plain = fit_and_estimate_uncertainty(cell.drawn, data, replace(options, objective="sum"))
    found = fit_and_estimate_uncertainty(cell.drawn, data, options).fit
    assert found.worst is not None
    assert len(found.worst.functions) == count
    problem, kept = plain.fit.problem, plain.fit.images.counted_pixel_mask
    seen = plain.fit.images.pixels
    label = (seen.part_of_pixels if objective == "minimax" else seen.camera)[kept]
    slopes = problem.rows(plain.fit.state, problem.active)[1]
    scale = np.sqrt(len(kept)) / np.linalg.norm(slopes, axis=1)

    def sizes(x: Array) -> Array:
        error = problem.errors(problem.step(plain.fit.state, scale * x[:-1]))
        square = np.bincount(label, (error[:, kept] ** 2).sum(axis=0))
        return x[-1] - square / np.bincount(label)

    begin = np.zeros(len(scale) + 1)
    begin[-1] = -sizes(begin).min()
    slope = np.append(np.zeros(len(scale)), 1.0)
    theirs = minimize(
        lambda x: x[-1], begin, jac=lambda x: slope, method="SLSQP",
        constraints={"type": "ineq", "fun": sizes}, options={"maxiter": 200, "ftol": 1e-12},
    )  # fmt: skip
    reached = theirs.x[-1] - sizes(theirs.x).min()  # whatever it says of itself
    assert found.worst.size.max() ** 2 <= reached * (1.0 + 1e-6)
    assert_allclose(found.worst.size.max() ** 2, reached, rtol=1e-3)
    assert found.worst.kkt.residual <= 1e-6
    assert found.worst.size.max() < found.worst.before
    assert_allclose(found.worst.multiplier.sum(), 1.0)
    assert found.worst.answered.keys() == {"daqp"}


def test_sigmas_of_a_minimax_are_true():
    """Pixels that do not count tell nothing: the arm is known less, by as much as is claimed."""
    ratio, against = [], []
    for seed in range(5):
        cell = cell_of(seed)
        sums, fit = (
            calibrate_pixel_data(
                cell.drawn, build_pixel_data(cell), PixelOptions(camera_on="flange", objective=name)
            )
            for name in ("sum", "minimax")
        )
        ratio.append(rms_arm_error_mm(cell, fit.calibrated) / (1e3 * fit.claim.sigma))
        against.append(fit.claim.sigma / sums.claim.sigma)
    assert 0.6 < np.sqrt(np.mean(np.square(ratio))) < 1.4
    assert min(against) > 1.2


@pytest.mark.parametrize(
    ("given", "said"),
    [({"objective": "point"}, "is not for pixels: give sum, minimax or camera"),
     ({"objective": "minimax", "drawn_prior": True}, "drawn_prior= is for objective='sum'")],
)  # fmt: skip
def test_objectives_that_pixels_do_not_have(given, said):
    with pytest.raises(mc.OptionError, match=re.escape(said)):
        check_pixel_options(PixelOptions(**given))


# ---- slips -----------------------------------------------------------------------------------


def wrong_lens(data: PixelData, factor: float) -> PixelData:
    """The data with another focal length in the camera's file."""
    camera = data.cameras[0]
    lens = camera.intrinsic * np.r_[factor, factor, np.ones(14)]
    return replace(data, cameras=(replace(camera, intrinsic=lens),))


def test_v_from_below_is_named(ground):
    data = build_pixel_data(ground)
    height = data.cameras[0].size[1] - 1.0
    flipped = np.stack([data.pixel[:, 0], height - data.pixel[:, 1]], axis=1)
    with pytest.raises(mc.DataError, match=r"v_px counts from the bottom of the image"):
        calibrate_pixel_data(ground.drawn, replace(data, pixel=flipped), PixelOptions())


def test_a_board_in_metres_is_named(ground):
    data = build_pixel_data(ground)
    with pytest.raises(mc.DataError, match=r"the board's places look 1000 times too large"):
        calibrate_pixel_data(ground.drawn, replace(data, board=1e3 * data.board), PixelOptions())


@pytest.mark.parametrize("size", [24.0 / 25.0, pytest.param(30.0 / 25.0, marks=pytest.mark.slow)])
def test_a_board_of_another_size_is_named(ground, size):
    data = build_pixel_data(ground)
    fit = calibrate_pixel_data(ground.drawn, replace(data, board=size * data.board), PixelOptions())
    assert fit.status is Status.FAILED
    assert "larger than its file" in fit.reason or "smaller than its file" in fit.reason
    told = float(fit.reason.split("is ")[1].split(" %")[0]) / 100.0
    sign = 1.0 if "larger than its file" in fit.reason else -1.0
    assert_allclose(1.0 + sign * told, 1.0 / size, rtol=0, atol=3e-3)


@pytest.mark.parametrize(
    "held", [pytest.param(False, marks=pytest.mark.slow), True], ids=["freed", "held"]
)
def test_the_file_of_another_camera_is_named(ground, held):
    data = wrong_lens(build_pixel_data(ground), 1.2)
    fit = calibrate_pixel_data(ground.drawn, data, PixelOptions(fix_camera=held))
    assert fit.status is Status.FAILED
    assert "cam0.yaml: the pixels of cam0 fit fx 2500" in fit.reason


# ---- what may be claimed ---------------------------------------------------------------------


def test_hand_eye_alone_is_a_result():
    """With every link fixed there is no arm to keep back; the camera is found to its sigma."""
    cell = cell_of(5, link_error_sigmas=(0.0, 0.0))
    fit = calibrate_pixel_data(
        cell.drawn, build_pixel_data(cell), PixelOptions(fix=("[ad]*", "theta*", "beta*"))
    )
    assert fit.status is Status.CONVERGED
    assert not fit.reason
    assert_allclose(fit.robot.mdh, cell.drawn.mdh)
    assert "The arm stays as drawn" in fit.headline()


def test_a_change_that_noise_makes_up_is_kept_back(ground):
    still = cell_of(5, link_error_sigmas=(0.0, 0.0), on_flange=False)
    known = replace(still.drawn, drawn_within=(1e-6, 1e-6))
    for drawn, why, status in (
        (still.drawn, "too little", Status.NO_BETTER),
        (known, "do not determine", Status.NOT_DETERMINED),
    ):
        fit = calibrate_pixel_data(drawn, build_pixel_data(still), PixelOptions())
        assert fit.status is status
        assert fit.robot is drawn
        assert why in fit.reason
        assert rms_arm_error_mm(still, fit.robot) < 1e-6 < rms_arm_error_mm(still, fit.calibrated)
    fit = calibrate_pixel_data(still.drawn, build_pixel_data(still), PixelOptions(drawn_prior=True))
    assert fit.robot is still.drawn


@pytest.mark.parametrize("aside", [False, True], ids=["all over", "to one side"])
def test_sigmas_count_what_no_link_holds(aside):
    """Gears err: the arm's errors are as large as is claimed, also where no pose was measured."""
    more = {"one_sided": aside, "tilt": 0.25 if aside else 0.7}
    cells = [
        cell_of(seed, true_joint_law=draw_gear_error_law(np.random.default_rng(seed)), **more)
        for seed in range(4)
    ]
    fits = [
        calibrate_pixel_data(cell.drawn, build_pixel_data(cell), PixelOptions()) for cell in cells
    ]
    ratio = np.array([
        rms_arm_error_mm(cell, fit.calibrated) / (1e3 * fit.claim.sigma)
        for cell, fit in zip(cells, fits, strict=True)
    ])  # fmt: skip
    assert 0.7 < np.sqrt((ratio**2).mean()) < 1.4


def test_a_drawing_as_a_prior_helps_weak_pixels():
    errors, ratio = [], []
    for seed in range(6):
        cell = cell_of(seed, noise=5.0, link_error_sigmas=(0.3e-3, 0.5e-3))
        known = fit_and_estimate_uncertainty(
            cell.drawn, build_pixel_data(cell), PixelOptions(camera_on="flange")
        )
        plain, fit = (
            conclude_pixel_calibration(known, PixelOptions(drawn_prior=p), 0.0)
            for p in (False, True)
        )
        arms = (fit.calibrated, plain.calibrated, cell.drawn)
        errors.append([rms_arm_error_mm(cell, arm) for arm in arms])
        ratio.append(errors[-1][0] / (1e3 * fit.claim.sigma))
        assert fit.claim.sigma < plain.claim.sigma
        assert fit.pixels["holdout"][0] < 1.1 * plain.pixels["holdout"][0]
    prior, pixels, drawn = np.sqrt(np.mean(np.square(errors), axis=0))
    assert prior < 0.9 * min(pixels, drawn)
    assert 0.6 < np.sqrt(np.mean(np.square(ratio))) < 1.5


@pytest.mark.parametrize("size", [1.003, 0.997])
def test_a_board_slightly_off_is_named_with_its_size(size):
    cell = cell_of(3, on_flange=False, link_error_sigmas=(0.3e-3, 0.5e-3))
    data = build_pixel_data(cell)
    fit = calibrate_pixel_data(cell.drawn, replace(data, board=size * data.board), PixelOptions())
    assert any("measure its squares" in text for text in (*fit.notices, fit.reason))
    found = fit.instrument["lengths_over_drawn"]
    assert abs(1.0 + found["share"] - size) < 3.0 * found["sigma"] < 2e-3
    right = calibrate_pixel_data(cell.drawn, data, PixelOptions())
    assert not any("measure its squares" in text for text in (*right.notices, right.reason))


def test_claims_compare_sigma_and_drawing():
    assert PositionClaim(0.1, 1.0, 1.0, 0.9).is_better
    assert not PositionClaim(1.1, 1.0, 5.0, 1.0).is_better
    assert not PositionClaim(0.1, 1.0, 0.15, 0.05).is_better
    assert "the calibrated arm is better" in PositionClaim(1e-4, 1e-3, 1e-3, 1e-3).sentence()
    assert "keep the drawn arm" in PositionClaim(1e-4, 1e-3, 1e-4, 0.0).sentence()


def test_doubts_of_lenses_are_read():
    assert parse_lens_sigmas("") == {"f": 1e-3, "c": 2.0, "k": 5e-3, "p": 5e-4}
    assert parse_lens_sigmas("f 0.05%, c 1px, k 0.01")["f"] == pytest.approx(5e-4)
    for wrong in ("f 0.1", "f 0.1px", "g 1%", "c -1px", "f 0%", "f 1% c 1px"):
        with pytest.raises(mc.OptionError, match="camera_prior="):
            parse_lens_sigmas(wrong)
