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
from experiments.real import off_drawing
from minimax_cal.fitting.pixels.fit import PixelSquares
from minimax_cal.fitting.pixels.judge import POSES as JUDGED
from minimax_cal.fitting.pixels.judge import everywhere, free_motion, missed, tool_points
from minimax_cal.fitting.several.stack import own_state
from minimax_cal.ground.arrays import Array
from minimax_cal.instruments.camera import Camera
from minimax_cal.instruments.images import Images
from minimax_cal.instruments.pixels import PixelData
from minimax_cal.measuring.measurements import Measurements
from minimax_cal.robots import kinematics
from minimax_cal.robots.gravity import masses_of, torques
from minimax_cal.robots.sampling import random_joints
from minimax_cal.robots.transforms import transform
from minimax_cal.solvers.least_squares import solve_normal

SIZE = (2448, 2048)  # five megapixels
LENS = (2500.0, 2500.0, 1223.5, 1023.5)
BARREL = (-0.12, 0.08, 2e-4, -3e-4, 0.0)
BOARD, SQUARE = (11, 8), 0.025  # corners, and their distance [m]
NOISE = 0.106  # of u and v [px]: 0.15 px together
OFF_LENGTH, OFF_ANGLE = 0.5e-3, 1e-3  # of each link parameter [m, rad]
DISTANCE, TILT = (0.35, 0.75), 0.7  # of cameras from the board, and to its normal [m], [rad]
MARGIN = 20.0  # from the edge of the image [px]
POSES = 1000  # that an arm is judged by
GEARS = 3e-4  # error of a gear once a turn, half of it twice a turn [rad]
SPRINGS = np.array([0.0, 1.0, 1.0, 0.5, 0.0, 0.0]) * 1e-5  # bending of the joints [rad/Nm]
ALL_OVER, WITHIN = 1.5, 0.05  # joints about a middle where poses are sought [rad]
ASIDE = np.array([0.3, -1.2, 1.2, -1.0, -1.5, 0.3])  # the middle of poses to one side [rad]
Law = Callable[[Array], Array]


@dataclass(frozen=True, eq=False)
class View:
    """A camera: where it is in what it is fixed to, and its lens.

    pose: (4, 4) [m].  lens: fx, fy, cx, cy [px].  distortion: (5,).
    """

    pose: Array
    lens: tuple[float, float, float, float] = LENS
    distortion: tuple[float, ...] = BARREL
    size: tuple[int, int] = SIZE


@dataclass(frozen=True, eq=False)
class Cell:
    """drawn, true: the arm.  q: (m, n).  points: (k, 3) targets in their own frame [m].

    place: (4, 4) of that frame in the base or on the flange.  pixel: (c, m, k, 2) [px], NaN where
    a target is not in the image.  law: where the joints truly are.
    """

    drawn: mc.Robot
    true: mc.Robot
    on_flange: bool
    views: tuple[View, ...]
    points: Array
    place: Array
    q: Array
    pixel: Array
    names: tuple[str, ...] = field(default_factory=tuple)
    law: Law = np.asarray


def board_points(corners: tuple[int, int] = BOARD, square: float = SQUARE) -> Array:
    """(k, 3) corners of a board about its middle [m]."""
    x, y = np.meshgrid(np.arange(corners[0]), np.arange(corners[1]))
    flat = square * np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1)
    return np.asarray(flat - flat.mean(axis=0))


def projected(view: View, point: Array) -> Array:
    """Pixels (..., 2) of points (..., 3) in the camera's axes; NaN outside the image."""
    fx, fy, cx, cy = view.lens
    k1, k2, p1, p2, k3 = view.distortion
    with np.errstate(divide="ignore", invalid="ignore"):
        x, y = point[..., 0] / point[..., 2], point[..., 1] / point[..., 2]
        r2 = x**2 + y**2
        radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
        u = fx * (x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x**2)) + cx
        v = fy * (y * radial + p1 * (r2 + 2 * y**2) + 2 * p2 * x * y) + cy
    pixel = np.stack([u, v], axis=-1)
    seen = (point[..., 2] > 0.05) & (r2 < 0.6)
    seen &= ((pixel >= MARGIN) & (pixel <= np.array(view.size) - MARGIN)).all(axis=-1)
    return np.where(seen[..., None], pixel, np.nan)


def seen_by(view: View, robot: mc.Robot, q: Array, points: Array, on_flange: bool) -> Array:
    """Pixels (m, k, 2) of targets (k, 3), which stand in the base or ride on the flange."""
    flange = robot.pose(q)
    camera = flange @ view.pose if on_flange else np.broadcast_to(view.pose, flange.shape)
    own = np.broadcast_to(np.eye(4), flange.shape) if on_flange else flange
    world = np.einsum("mij,kj->mki", own[:, :3, :3], points) + own[:, None, :3, 3]
    local = np.einsum("mji,mkj->mki", camera[:, :3, :3], world - camera[:, None, :3, 3])
    return projected(view, local)


def looking(rng: np.random.Generator, distance: tuple[float, float], tilt: float) -> Array:
    """(4, 4) a camera that looks at the origin from above, more or less, rolled anyhow."""
    away = rng.uniform(*distance)
    turn = Rotation.from_euler(
        "zxz", [rng.uniform(0, 2 * np.pi), np.pi - rng.uniform(0, tilt), rng.uniform(0, 2 * np.pi)]
    ).as_matrix()
    aim = rng.normal(size=3) * 0.03
    return transform(turn, aim - away * turn[:, 2])


def geared(rng: np.random.Generator) -> Law:
    """Errors of six gears, once and twice a turn."""
    size = GEARS * rng.uniform(0.5, 1.5, (2, 6)) * [[1.0], [0.5]]
    phase = rng.uniform(0.0, 2.0 * np.pi, (2, 6))
    return lambda q: q + size[0] * np.sin(q + phase[0]) + size[1] * np.sin(2.0 * q + phase[1])


def bent(robot: mc.Robot, rng: np.random.Generator) -> Law:
    """Joints that are compliant under gravity."""
    spring = SPRINGS * rng.uniform(0.5, 1.5, 6)

    def law(q: Array) -> Array:
        links = kinematics.chain(robot.mdh, robot.turned(q), robot.prismatic)
        return np.asarray(q + spring * torques(links, *masses_of(robot), robot.up).T)

    return law


def make_cell(
    rng: np.random.Generator,
    *,
    robot: str = "ur5",
    poses: int = 60,
    on_flange: bool = True,
    views: Sequence[View] = (),
    points: Array | None = None,
    noise: float = NOISE,
    distance: tuple[float, float] = DISTANCE,
    tilt: float = TILT,
    off: tuple[float, float] = (OFF_LENGTH, OFF_ANGLE),
    least: float = 0.6,
    law: Law = np.asarray,
    aside: bool = False,
) -> Cell:
    """A cell: poses where every camera sees most of the targets.

    distance: of the camera from the targets [m].  off: of the arm's links from their drawing [m,
    rad].  least: share of the targets in an image.  law: where the joints truly are.  aside:
    whether all poses are to one side.
    """
    drawn = mc.load_robot(robot)
    true = off_drawing(drawn, rng, *off)
    points = board_points() if points is None else points
    mounted = transform(Rotation.from_euler("xyz", rng.uniform(-0.3, 0.3, 3)).as_matrix(),
                        np.array([0.04, -0.03, 0.08]))  # fmt: skip
    stands = transform(Rotation.from_euler("xyz", rng.uniform(-0.2, 0.2, 3)).as_matrix(),
                       np.array([0.5 * drawn.reach(), 0.1, 0.05]))  # fmt: skip
    views = tuple(views) or (View(mounted if on_flange else stands),)
    place = stands if on_flange else mounted
    away, middle = (WITHIN, ASIDE) if aside else (ALL_OVER, np.zeros(drawn.joints))
    q = np.zeros((0, drawn.joints))
    world = points @ place[:3, :3].T + place[:3, 3]
    while len(q) < poses:
        relative = np.stack([looking(rng, distance, tilt) for _ in range(poses)])
        if on_flange:
            goal = place @ relative @ np.linalg.inv(views[0].pose)
        else:
            goal = views[0].pose @ np.linalg.inv(relative) @ np.linalg.inv(place)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            found = drawn.inverse(
                goal, near=rng.uniform(-away, away, (poses, drawn.joints)) + middle
            )
        found = (found + np.pi) % (2 * np.pi) - np.pi
        seen = (seen_by(view, true, law(found), world, on_flange) for view in views)
        share = np.mean([np.isfinite(each[..., 0]).mean(axis=1) for each in seen], axis=0)
        q = np.concatenate([q, found[share >= least]])
    names = tuple(f"c{i}" for i in range(len(points)))
    none = np.zeros((len(views), 0, len(points), 2))
    cell = Cell(drawn, true, on_flange, views, points, place, q[:0], none, names, law)
    return taken(cell, q[:poses], rng, noise)


def taken(cell: Cell, q: Array, rng: np.random.Generator, noise: float = NOISE) -> Cell:
    """The same cell at other joint values (m, n)."""
    world = cell.points @ cell.place[:3, :3].T + cell.place[:3, 3]
    pixel = np.stack([
        seen_by(view, cell.true, cell.law(q), world, cell.on_flange) for view in cell.views
    ])  # fmt: skip
    return replace(cell, q=q, pixel=pixel + noise * rng.normal(size=pixel.shape))


def write_cell(cell: Cell, folder: Path, *, board: bool = True) -> list[str]:
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
        path.write_text(camera_text(view))
        given += ["--camera", f"cam{c}={path}"]
    if board:
        lines = ["target,x_mm,y_mm,z_mm"]
        places = zip(cell.names, 1e3 * cell.points, strict=True)
        lines += [f"{name},{x:.6f},{y:.6f},{z:.6f}" for name, (x, y, z) in places]
        (folder / "board.csv").write_text("\n".join(lines) + "\n")
        given += ["--board", str(folder / "board.csv")]
    return [*given, "--camera-on", "flange" if cell.on_flange else "ground"]


def data_of(cell: Cell, *, board: bool = True) -> PixelData:
    """What the files of `write_cell` are read as."""
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
        board=cell.points if board else np.zeros((0, 3)),
        pose=pose,
        camera=camera,
        target=target,
        pixel=cell.pixel[camera, pose, target],
        line=np.arange(len(pose)) + 2,
    )


def camera_text(view: View) -> str:
    """A camera's file as OpenCV's FileStorage writes it."""
    fx, fy, cx, cy = view.lens
    matrix = ", ".join(f"{x:.17g}" for x in (fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0))
    distortion = ", ".join(f"{x:.17g}" for x in view.distortion)
    return (
        f"%YAML:1.0\n---\nimage_width: {view.size[0]}\nimage_height: {view.size[1]}\n"
        "camera_matrix: !!opencv-matrix\n   rows: 3\n   cols: 3\n   dt: d\n"
        f"   data: [ {matrix} ]\n"
        "distortion_coefficients: !!opencv-matrix\n"
        f"   rows: {len(view.distortion)}\n   cols: 1\n   dt: d\n   data: [ {distortion} ]\n"
    )


def arm_error(cell: Cell, arm: mc.Robot) -> float:
    """RMS error of an arm over the joints' whole range, base and tool fitted [mm]."""
    q = random_joints(cell.true, (POSES,), np.random.default_rng(0))
    return 1e3 * missed(arm, q, tool_points(cell.true, cell.law(q)))


def least_variances(
    cell: Cell, data: PixelData, active: Array, lens_sigma: Array, noise: float = NOISE
) -> Array:
    """(f,) variances of independent parts of a squared arm error that no unbiased fit is below.

    Their sum is the Cramer-Rao bound of the mean square [mm^2]: at the true cell, with the true
    noise.  active: (p,) what is fitted.  lens_sigma: (c, 9) of the lenses' files.
    """
    cameras = [
        replace(camera, intrinsic=np.array([*view.lens, *view.distortion, *np.zeros(7)]))
        for camera, view in zip(data.cameras, cell.views, strict=True)
    ]
    poses = np.stack([view.pose for view in cell.views])
    data = replace(data, cameras=tuple(cameras))
    images, own = Images.placed_at(data, poses, cell.place, cell.points, on_flange=cell.on_flange)
    rows = PixelSquares.of(cell.true, images).rows(own_state(cell.true.mdh, own), active)[1]
    known = np.pad(lens_sigma.reshape(-1) ** -2.0, (len(active) - lens_sigma.size, 0))[active]
    cover = solve_normal(rows @ rows.T / noise**2 + np.diag(known), np.eye(len(rows)))
    links = active[: 5 * cell.true.joints]
    moved = free_motion(cell.true, everywhere(cell.true))[0][:, links]
    root = np.linalg.cholesky(cover[: links.sum(), : links.sum()])
    return np.asarray(1e6 * np.linalg.svd(moved @ root, compute_uv=False) ** 2 / JUDGED)
