"""Simulated cells with cameras: an arm, a board or tags, and the pixels that cameras saw of them.

The projection is written here a second time, corner by corner as OpenCV's manual states it, so that
no fit is judged by its own formulas.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

import minimax_cal as mc
from experiments.real_arms import perturb_link_parameters
from minimax_cal.core.arrays import Array
from minimax_cal.fitting.multi_instrument.instrument_stack import build_own_state
from minimax_cal.fitting.pixels.fit import PixelSquares
from minimax_cal.fitting.pixels.pixel_uncertainty import JUDGED_POSE_COUNT as JUDGED
from minimax_cal.fitting.pixels.pixel_uncertainty import (
    sample_joint_range,
    tool_motion_without_rigid,
    tool_position_rms_error,
    tool_positions,
)
from minimax_cal.instruments.camera_images import CameraImages
from minimax_cal.instruments.camera_model import Camera
from minimax_cal.instruments.pixel_data import PixelData
from minimax_cal.measuring.measurements import Measurements
from minimax_cal.robots import kinematics
from minimax_cal.robots.gravity_torques import joint_gravity_torques, link_masses_and_centres
from minimax_cal.robots.joint_sampling import random_joint_values
from minimax_cal.robots.transforms import build_transform
from minimax_cal.solvers.least_squares import solve_normal_equations

IMAGE_SIZE_PX = (2448, 2048)  # five megapixels
LENS_PARAMETERS_PX = (2500.0, 2500.0, 1223.5, 1023.5)
LENS_DISTORTION = (-0.12, 0.08, 2e-4, -3e-4, 0.0)
BOARD_CORNER_COUNTS, BOARD_SQUARE = (11, 8), 0.025  # corners, and their distance [m]
PIXEL_NOISE = 0.106  # of u and v [px]: 0.15 px together
LINK_LENGTH_ERROR_SIGMA, LINK_ANGLE_ERROR_SIGMA = 0.5e-3, 1e-3  # of each link parameter [m, rad]
CAMERA_DISTANCE_RANGE, MAX_CAMERA_TILT = (
    (0.35, 0.75),
    0.7,
)  # of cameras from the board, and to its normal [m], [rad]
IMAGE_MARGIN_PX = 20.0  # from the edge of the image [px]
ARM_ERROR_POSES = 1000  # that an arm is judged by
GEAR_ERROR_AMPLITUDE = 3e-4  # error of a gear once a turn, half of it twice a turn [rad]
JOINT_COMPLIANCES = (
    np.array([0.0, 1.0, 1.0, 0.5, 0.0, 0.0]) * 1e-5
)  # bending of the joints [rad/Nm]
WIDE_POSE_HALF_RANGE, NARROW_POSE_HALF_RANGE = (
    1.5,
    0.05,
)  # joints about a middle where poses are sought [rad]
ONE_SIDED_POSE_CENTRE = np.array(
    [0.3, -1.2, 1.2, -1.0, -1.5, 0.3]
)  # the middle of poses to one side [rad]
TrueJointLaw = Callable[[Array], Array]


@dataclass(frozen=True, eq=False)
class SimulatedCamera:
    """A camera: where it is in what it is fixed to, and its lens.

    pose: (4, 4) [m].  lens: fx, fy, cx, cy [px].  distortion: (5,).
    """

    pose: Array
    lens: tuple[float, float, float, float] = LENS_PARAMETERS_PX
    distortion: tuple[float, ...] = LENS_DISTORTION
    size: tuple[int, int] = IMAGE_SIZE_PX


@dataclass(frozen=True, eq=False)
class PixelCell:
    """drawn, true: the arm.  q: (m, n).  points: (k, 3) targets in their own frame [m].

    place: (4, 4) of that frame in the base or on the flange.  pixel: (c, m, k, 2) [px], NaN where
    a target is not in the image.  law: where the joints truly are.
    """

    drawn: mc.Robot
    true: mc.Robot
    on_flange: bool
    views: tuple[SimulatedCamera, ...]
    points: Array
    place: Array
    q: Array
    pixel: Array
    names: tuple[str, ...] = field(default_factory=tuple)
    law: TrueJointLaw = np.asarray


def board_corner_points(
    corner_counts: tuple[int, int] = BOARD_CORNER_COUNTS, square_size: float = BOARD_SQUARE
) -> Array:
    """(k, 3) corners of a board about its middle [m]."""
    x, y = np.meshgrid(np.arange(corner_counts[0]), np.arange(corner_counts[1]))
    flat = square_size * np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1)
    return np.asarray(flat - flat.mean(axis=0))


def project_points(camera: SimulatedCamera, points: Array) -> Array:
    """Pixels (..., 2) of points (..., 3) in the camera's axes; NaN outside the image."""
    fx, fy, cx, cy = camera.lens
    k1, k2, p1, p2, k3 = camera.distortion
    with np.errstate(divide="ignore", invalid="ignore"):
        x, y = points[..., 0] / points[..., 2], points[..., 1] / points[..., 2]
        r2 = x**2 + y**2
        radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
        u = fx * (x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x**2)) + cx
        v = fy * (y * radial + p1 * (r2 + 2 * y**2) + 2 * p2 * x * y) + cy
    pixel = np.stack([u, v], axis=-1)
    seen = (points[..., 2] > 0.05) & (r2 < 0.6)
    seen &= ((pixel >= IMAGE_MARGIN_PX) & (pixel <= np.array(camera.size) - IMAGE_MARGIN_PX)).all(
        axis=-1
    )
    return np.where(seen[..., None], pixel, np.nan)


def pixels_of_targets(
    simulated_camera: SimulatedCamera, robot: mc.Robot, q: Array, points: Array, on_flange: bool
) -> Array:
    """Pixels (m, k, 2) of targets (k, 3), which stand in the base or ride on the flange."""
    flange = robot.pose(q)
    camera = (
        flange @ simulated_camera.pose
        if on_flange
        else np.broadcast_to(simulated_camera.pose, flange.shape)
    )
    own = np.broadcast_to(np.eye(4), flange.shape) if on_flange else flange
    world = np.einsum("mij,kj->mki", own[:, :3, :3], points) + own[:, None, :3, 3]
    local = np.einsum("mji,mkj->mki", camera[:, :3, :3], world - camera[:, None, :3, 3])
    return project_points(simulated_camera, local)


def draw_camera_pose(
    rng: np.random.Generator, distance_range: tuple[float, float], max_tilt: float
) -> Array:
    """(4, 4) a camera that looks at the origin from above, more or less, rolled anyhow."""
    away = rng.uniform(*distance_range)
    turn = Rotation.from_euler(
        "zxz",
        [rng.uniform(0, 2 * np.pi), np.pi - rng.uniform(0, max_tilt), rng.uniform(0, 2 * np.pi)],
    ).as_matrix()
    aim = rng.normal(size=3) * 0.03
    return build_transform(turn, aim - away * turn[:, 2])


def draw_gear_error_law(rng: np.random.Generator) -> TrueJointLaw:
    """Errors of six gears, once and twice a turn."""
    size = GEAR_ERROR_AMPLITUDE * rng.uniform(0.5, 1.5, (2, 6)) * [[1.0], [0.5]]
    phase = rng.uniform(0.0, 2.0 * np.pi, (2, 6))
    return lambda q: q + size[0] * np.sin(q + phase[0]) + size[1] * np.sin(2.0 * q + phase[1])


def draw_compliance_law(robot: mc.Robot, rng: np.random.Generator) -> TrueJointLaw:
    """Joints that are compliant under gravity."""
    spring = JOINT_COMPLIANCES * rng.uniform(0.5, 1.5, 6)

    def law(q: Array) -> Array:
        links = kinematics.compute_link_frames(
            robot.mdh, robot.chain_joint_values(q), robot.prismatic
        )
        return np.asarray(
            q + spring * joint_gravity_torques(links, *link_masses_and_centres(robot), robot.up).T
        )

    return law


def simulate_pixel_cell(
    rng: np.random.Generator,
    *,
    robot: str = "ur5",
    pose_count: int = 60,
    on_flange: bool = True,
    views: Sequence[SimulatedCamera] = (),
    target_points: Array | None = None,
    noise: float = PIXEL_NOISE,
    distance: tuple[float, float] = CAMERA_DISTANCE_RANGE,
    tilt: float = MAX_CAMERA_TILT,
    link_error_sigmas: tuple[float, float] = (LINK_LENGTH_ERROR_SIGMA, LINK_ANGLE_ERROR_SIGMA),
    min_visible_share: float = 0.6,
    true_joint_law: TrueJointLaw = np.asarray,
    one_sided: bool = False,
) -> PixelCell:
    """A cell: poses where every camera sees most of the targets.

    distance: of the camera from the targets [m].  link_error_sigmas: of the arm's links from their
    drawing [m, rad].  min_visible_share: share of the targets in an image.  true_joint_law: where
    the joints truly are.  one_sided: whether all poses are to one side.
    """
    drawn = mc.load_robot(robot)
    true = perturb_link_parameters(drawn, rng, *link_error_sigmas)
    target_points = board_corner_points() if target_points is None else target_points
    mounted = build_transform(Rotation.from_euler("xyz", rng.uniform(-0.3, 0.3, 3)).as_matrix(),
                        np.array([0.04, -0.03, 0.08]))  # fmt: skip
    stands = build_transform(Rotation.from_euler("xyz", rng.uniform(-0.2, 0.2, 3)).as_matrix(),
                       np.array([0.5 * drawn.reach(), 0.1, 0.05]))  # fmt: skip
    views = tuple(views) or (SimulatedCamera(mounted if on_flange else stands),)
    place = stands if on_flange else mounted
    away, middle = (
        (NARROW_POSE_HALF_RANGE, ONE_SIDED_POSE_CENTRE)
        if one_sided
        else (WIDE_POSE_HALF_RANGE, np.zeros(drawn.joints))
    )
    q = np.zeros((0, drawn.joints))
    world = target_points @ place[:3, :3].T + place[:3, 3]
    while len(q) < pose_count:
        relative = np.stack([draw_camera_pose(rng, distance, tilt) for _ in range(pose_count)])
        if on_flange:
            goal = place @ relative @ np.linalg.inv(views[0].pose)
        else:
            goal = views[0].pose @ np.linalg.inv(relative) @ np.linalg.inv(place)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            found = drawn.inverse(
                goal, near=rng.uniform(-away, away, (pose_count, drawn.joints)) + middle
            )
        found = (found + np.pi) % (2 * np.pi) - np.pi
        seen = (
            pixels_of_targets(view, true, true_joint_law(found), world, on_flange) for view in views
        )
        share = np.mean([np.isfinite(each[..., 0]).mean(axis=1) for each in seen], axis=0)
        q = np.concatenate([q, found[share >= min_visible_share]])
    names = tuple(f"c{i}" for i in range(len(target_points)))
    none = np.zeros((len(views), 0, len(target_points), 2))
    cell = PixelCell(
        drawn, true, on_flange, views, target_points, place, q[:0], none, names, true_joint_law
    )
    return cell_at_joint_values(cell, q[:pose_count], rng, noise)


def cell_at_joint_values(
    cell: PixelCell, q: Array, rng: np.random.Generator, noise: float = PIXEL_NOISE
) -> PixelCell:
    """The same cell at other joint values (m, n)."""
    world = cell.points @ cell.place[:3, :3].T + cell.place[:3, 3]
    pixel = np.stack(
        [
            pixels_of_targets(view, cell.true, cell.law(q), world, cell.on_flange)
            for view in cell.views
        ]
    )
    return replace(cell, q=q, pixel=pixel + noise * rng.normal(size=pixel.shape))


def write_cell_files(cell: PixelCell, folder: Path, *, with_board: bool = True) -> list[str]:
    """Write the files of a cell; the options of `calibrate` that read them."""
    folder.mkdir(parents=True, exist_ok=True)
    n = cell.q.shape[1]
    joints = ["pose," + ",".join(f"q{i + 1}_rad" for i in range(n))]
    joints += [
        f"P{j}," + ",".join(f"{value:.12f}" for value in row) for j, row in enumerate(cell.q)
    ]
    rows = ["pose,camera,target,u_px,v_px"]
    for c in range(len(cell.views)):
        for j, k in np.argwhere(np.isfinite(cell.pixel[c, ..., 0])):
            u, v = cell.pixel[c, j, k]
            rows.append(f"P{j},cam{c},{cell.names[k]},{u:.6f},{v:.6f}")
    (folder / "joints.csv").write_text("\n".join(joints) + "\n")
    (folder / "detections.csv").write_text("\n".join(rows) + "\n")
    given = ["--pixels", str(folder / "detections.csv"), "--joints", str(folder / "joints.csv")]
    for c, view in enumerate(cell.views):
        path = folder / f"cam{c}.yaml"
        path.write_text(format_camera_yaml(view))
        given += ["--camera", f"cam{c}={path}"]
    if with_board:
        lines = ["target,x_mm,y_mm,z_mm"]
        places = zip(cell.names, 1e3 * cell.points, strict=True)
        lines += [f"{name},{x:.6f},{y:.6f},{z:.6f}" for name, (x, y, z) in places]
        (folder / "board.csv").write_text("\n".join(lines) + "\n")
        given += ["--board", str(folder / "board.csv")]
    return [*given, "--camera-on", "flange" if cell.on_flange else "ground"]


def build_pixel_data(cell: PixelCell, *, with_board: bool = True) -> PixelData:
    """What the files of `write_cell_files` are read as."""
    camera, pose, target = np.nonzero(np.isfinite(cell.pixel[..., 0]))
    cameras = tuple(
        Camera(f"cam{c}", np.array([*v.lens, *v.distortion, *np.zeros(7)]), v.size, f"cam{c}.yaml")
        for c, v in enumerate(cell.views)
    )
    nothing, lines = np.zeros((len(cell.q), 0, 3)), np.arange(len(cell.q)) + 2
    sliding = cell.drawn.prismatic
    return PixelData(
        at=Measurements(cell.q, nothing, (), sliding, lines, {}),
        labels=tuple(f"P{j}" for j in range(len(cell.q))),
        cameras=cameras,
        targets=cell.names,
        board=cell.points if with_board else np.zeros((0, 3)),
        pose=pose,
        camera=camera,
        target=target,
        pixel=cell.pixel[camera, pose, target],
        line=np.arange(len(pose)) + 2,
    )


def format_camera_yaml(camera: SimulatedCamera) -> str:
    """A camera's file as OpenCV's FileStorage writes it."""
    fx, fy, cx, cy = camera.lens
    matrix = ", ".join(f"{x:.17g}" for x in (fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0))
    distortion = ", ".join(f"{x:.17g}" for x in camera.distortion)
    return (
        f"%YAML:1.0\n---\nimage_width: {camera.size[0]}\nimage_height: {camera.size[1]}\n"
        "camera_matrix: !!opencv-matrix\n   rows: 3\n   cols: 3\n   dt: d\n"
        f"   data: [ {matrix} ]\n"
        "distortion_coefficients: !!opencv-matrix\n"
        f"   rows: {len(camera.distortion)}\n   cols: 1\n   dt: d\n   data: [ {distortion} ]\n"
    )


def rms_arm_error_mm(cell: PixelCell, robot: mc.Robot) -> float:
    """RMS error of an arm over the joints' whole range, base and tool fitted [mm]."""
    q = random_joint_values(cell.true, (ARM_ERROR_POSES,), np.random.default_rng(0))
    return 1e3 * tool_position_rms_error(robot, q, tool_positions(cell.true, cell.law(q)))


def cramer_rao_variances(
    cell: PixelCell,
    data: PixelData,
    is_fitted: Array,
    lens_sigma: Array,
    noise: float = PIXEL_NOISE,
) -> Array:
    """(f,) variances of independent parts of a squared arm error that no unbiased fit is below.

    Their sum is the Cramer-Rao bound of the mean square [mm^2]: at the true cell, with the true
    noise.  is_fitted: (p,) what is fitted.  lens_sigma: (c, 9) of the lenses' files.
    """
    cameras = [
        replace(camera, intrinsic=np.array([*view.lens, *view.distortion, *np.zeros(7)]))
        for camera, view in zip(data.cameras, cell.views, strict=True)
    ]
    poses = np.stack([view.pose for view in cell.views])
    data = replace(data, cameras=tuple(cameras))
    images, own = CameraImages.build_with_start(
        data, poses, cell.place, cell.points, on_flange=cell.on_flange
    )
    rows = PixelSquares.from_images(cell.true, images).rows(
        build_own_state(cell.true.mdh, own), is_fitted
    )[1]
    known = np.pad(lens_sigma.reshape(-1) ** -2.0, (len(is_fitted) - lens_sigma.size, 0))[is_fitted]
    cover = solve_normal_equations(rows @ rows.T / noise**2 + np.diag(known), np.eye(len(rows)))
    links = is_fitted[: 5 * cell.true.joints]
    moved = tool_motion_without_rigid(cell.true, sample_joint_range(cell.true))[0][:, links]
    root = np.linalg.cholesky(cover[: links.sum(), : links.sum()])
    return np.asarray(1e6 * np.linalg.svd(moved @ root, compute_uv=False) ** 2 / JUDGED)
