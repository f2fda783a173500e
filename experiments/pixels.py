"""What pixels tell of an arm: ways to use them, lenses that are wrong, starts, and weak pixels.

    python -m experiments.pixels [--quick] [--out FOLDER] [--json FILE] [--seed N] [--jobs N]

Every arm is judged by its positions over the joints' whole range, base and tool fitted, against the
arm that the pixels were simulated with.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from scipy.optimize import least_squares

import minimax_cal as mc
from experiments.pixel_cells import (
    BOARD,
    LENS,
    SQUARE,
    Cell,
    View,
    arm_error,
    bent,
    board_points,
    data_of,
    geared,
    least_variances,
    make_cell,
    projected,
)
from experiments.sweep import Study, study_options
from minimax_cal.fitting.pixels.calibrate import fitted
from minimax_cal.fitting.pixels.fit import ANY, PixelSquares, by_depths, fit_drawn, reprojected
from minimax_cal.fitting.pixels.options import PixelOptions
from minimax_cal.fitting.pixels.start import directions, from_far, poses_of_images, start_scene
from minimax_cal.ground.arrays import Array, rms
from minimax_cal.ground.tables import Table
from minimax_cal.instruments import flange_poses
from minimax_cal.instruments.pixels import PixelData
from minimax_cal.measuring.grouping import held_out
from minimax_cal.robots.kinematics import rotation, rotation_vector
from minimax_cal.robots.transforms import transform
from minimax_cal.solvers.status import Status

SEEDS, STARTS = 10, 10
DRAWS = 20_000  # of errors at the bound
POSES, FEW_POSES = 60, 40
SMALL, WIDE = (6, 5), 0.04  # a board with few corners, for a quick look
OUTLIERS = 0.05  # share of the pixels
GROSS = 30.0  # how far they are off, on average [px]
BAD_ANGLE, BAD_LENGTH = 0.3, 0.05  # of starts that are far off: zeros, lengths [rad, m]
REACHED = 0.1  # an arm so near to the true one has found its minimum [mm]
WEAK_FOCAL, WEAK_DISTANCE = 8000.0, (1.8, 2.2)  # a tele lens: 0.25 mm a pixel [px], [m]
WEAK_NOISES = (0.1, 0.3, 1.0)  # [px]
WEAK_OFF = ((3e-4, 5e-4), (1e-4, 2e-4), (3e-5, 5e-5))  # of links from their drawing [m, rad]
NARROW = 0.25  # tilt of the camera where all poses are to one side [rad]
SIDE = 0.05  # of the one tag that a tele lens sees [m]


@dataclass(frozen=True)
class Job:
    """One way on one cell."""

    way: str
    seed: int
    small: bool


@dataclass(frozen=True)
class Found:
    """Arm error and its claimed sigma [mm], NaN for none; held-out pixels [px]; what was named.

    least: as `least_variances`, () where the links' errors are not all that a fit has to find.
    """

    error: float
    sigma: float
    pixels: float
    named: str = ""
    least: tuple[float, ...] = ()


def cell_of(job: Job, **more: object) -> Cell:
    """The cell of a job."""
    rng = np.random.default_rng(job.seed)
    points = board_points(SMALL, WIDE) if job.small else board_points(BOARD, SQUARE)
    poses = FEW_POSES if job.small else POSES
    given = {"points": points, "poses": poses} | more
    return make_cell(rng, **given)  # type: ignore[arg-type]


def judged(cell: Cell, data: PixelData, **options: object) -> Found:
    """A calibration by cameras, judged."""
    on = "flange" if cell.on_flange else "ground"
    fit = fitted(cell.drawn, data, PixelOptions(camera_on=on, **options))  # type: ignore[arg-type]
    named = f"{len(fit.set_aside)} set aside" if fit.set_aside else ""
    arm = fit.calibrated or fit.robot
    least: Array = np.zeros(0)
    if cell.law is np.asarray and len(data.board):
        held = held_out(data.at, 0.2, 0)[0]
        doubt = PixelOptions().lens_sigma(np.stack([one.intrinsic for one in data.cameras]))
        train = data.some(~held[data.pose])
        least = least_variances(cell, train, fit.identification.active, doubt)
    error, sigma = arm_error(cell, arm), 1e3 * fit.claim.sigma
    return Found(error, sigma, fit.pixels["holdout"][0], named, tuple(least))


# ---- ways ------------------------------------------------------------------------------------


def hand_eye(job: Job) -> Found:
    """The arm as drawn; only camera and board are fitted."""
    cell = cell_of(job)
    fit = fitted(cell.drawn, data_of(cell), PixelOptions(camera_on="flange"))
    return Found(arm_error(cell, cell.drawn), np.nan, fit.pixels["nominal"][0])


def whole_poses(job: Job) -> Found:
    """A pose from each image, then a calibration from whole poses."""
    cell = cell_of(job)
    data = data_of(cell)
    rows, image = poses_of_images(data, directions(data))[0]
    pose = np.stack([resected(cell, data, *each) for each in zip(rows, image, strict=True)])
    fit = mc.relative(cell.drawn, flange_poses(data.at.q[rows], np.linalg.inv(pose)))
    return Found(arm_error(cell, fit.robot), 1e3 * fit.position_sigma, np.nan)


def resected(cell: Cell, data: PixelData, row: int, start: Array) -> Array:
    """Pose (4, 4) of the board in the camera that fits one image best, from a start."""
    mine = data.pose == row
    point, pixel = data.board[data.target[mine]], data.pixel[mine]
    view = replace(cell.views[0], size=(10**6, 10**6))

    def errors(x: Array) -> Array:
        seen = projected(view, point @ rotation(x[:3]).T + x[3:])
        return np.asarray((np.nan_to_num(seen, nan=1e4) - pixel).reshape(-1))

    begin = np.concatenate([rotation_vector(start[:3, :3]), start[:3, 3]])
    found = least_squares(errors, begin, method="lm").x
    return transform(rotation(found[:3]), found[3:])


def wrong_lens(data: PixelData, factor: float) -> PixelData:
    """The data with another focal length in the file of each camera."""
    scale = np.r_[factor, factor, np.ones(14)]
    cameras = (replace(camera, intrinsic=camera.intrinsic * scale) for camera in data.cameras)
    return replace(data, cameras=tuple(cameras))


def reprojection(job: Job, *, held: bool, factor: float = 1.0, on_flange: bool = True) -> Found:
    """The fit of pixels; factor: of the focal length in the camera's file."""
    cell = cell_of(job, on_flange=on_flange)
    return judged(cell, wrong_lens(data_of(cell), factor), fix_camera=held)


def two_cameras(job: Job) -> Found:
    """Two cameras on the flange."""
    poses = [
        transform(np.eye(3), np.array(at)) for at in ((0.04, -0.03, 0.08), (-0.06, 0.02, 0.08))
    ]
    lenses = LENS, (2300.0, 2300.0, 1200.0, 1000.0)
    views = tuple(View(pose, lens) for pose, lens in zip(poses, lenses, strict=True))
    cell = cell_of(job, views=views)
    return judged(cell, data_of(cell))


def unknown_tags(job: Job) -> Found:
    """Fifteen tags of unknown place, on an arm that is drawn as well as its file says."""
    rng = np.random.default_rng(job.seed)
    points = rng.uniform(-1.0, 1.0, (15, 3)) * [0.3, 0.3, 0.05]
    cell = cell_of(job, points=points, least=0.3, off=(3e-4, 5e-4))
    return judged(cell, data_of(cell, board=False))


def outliers(job: Job) -> Found:
    """A share of the pixels is wrong."""
    cell, rng = cell_of(job), np.random.default_rng(job.seed)
    data = data_of(cell)
    wrong = rng.random(data.count) < OUTLIERS
    away = 2.0 + rng.exponential(GROSS, data.pixel.shape)
    found = judged(cell, replace(data, pixel=data.pixel + np.where(wrong[:, None], away, 0.0)))
    return replace(found, named=f"{found.named}, {wrong.sum()} wrong")


def lacking(job: Job, *, bends: bool, aside: bool) -> Found:
    """An arm whose gears err, or whose joints bend, which no link holds."""
    rng = np.random.default_rng([job.seed, 1])
    law = bent(mc.load_robot("ur5"), rng) if bends else geared(rng)
    cell = cell_of(job, law=law, aside=aside, **({"tilt": NARROW} if aside else {}))
    return judged(cell, data_of(cell))


WAYS: dict[str, Callable[[Job], Found]] = {
    "hand-eye alone, arm as drawn": hand_eye,
    "poses by PnP, then whole poses": whole_poses,
    "reprojection, lenses given": partial(reprojection, held=True),
    "reprojection, lenses freed": partial(reprojection, held=False),
    "lenses wrong by 0.03 % and held": partial(reprojection, held=True, factor=1.0003),
    "lenses wrong by 0.1 % and held": partial(reprojection, held=True, factor=1.001),
    "lenses wrong by 0.1 %, freed": partial(reprojection, held=False, factor=1.001),
    "eye to hand, lenses freed": partial(reprojection, held=False, on_flange=False),
    "eye to hand, wrong by 0.1 % and held": partial(
        reprojection, held=True, factor=0.999, on_flange=False
    ),
    "two cameras, lenses freed": two_cameras,
    "tags of unknown place": unknown_tags,
    "5 % outliers, lenses freed": outliers,
    "gear errors": partial(lacking, bends=False, aside=False),
    "gear errors, poses to one side": partial(lacking, bends=False, aside=True),
    "bending": partial(lacking, bends=True, aside=False),
    "bending, poses to one side": partial(lacking, bends=True, aside=True),
}


def run(job: Job) -> Found:
    """One way on one cell."""
    return WAYS[job.way](job)


def ways_table(jobs: Sequence[Job], found: Sequence[Found]) -> Table:
    """Arm errors by way over the seeds, against the bound of these poses and what is claimed."""
    rows = []
    for way in WAYS:
        mine = [one for job, one in zip(jobs, found, strict=True) if job.way == way]
        error, sigma, pixels = (
            np.array([getattr(one, name) for one in mine]) for name in ("error", "sigma", "pixels")
        )
        over = error / sigma
        rows.append((way, rms(error), error.max(), *against_bound(mine),
                     rms(sigma), rms(over), over.max(), float(pixels.mean()),
                     mine[0].named))  # fmt: skip
    return Table.made(
        "arm errors over the joints' whole range, mm, base and tool fitted",
        rows,
        "way | RMS .4f | largest .4f | Cramer-Rao bound .4f | p of the largest .2f | "
        "claimed .4f | RMS over claimed .2f | largest over claimed .2f | held out px .3f | "
        "named",
    )


def against_bound(found: Sequence[Found]) -> tuple[float, float]:
    """RMS error of fits that reach the bound [mm], and how often their largest is as large."""
    if not all(one.least for one in found):
        return np.nan, np.nan
    rng = np.random.default_rng(0)
    draws = [rng.chisquare(1.0, (DRAWS, len(one.least))) @ np.array(one.least) for one in found]
    largest = max(one.error for one in found)
    bound = rms(np.sqrt([sum(one.least) for one in found]))
    return bound, float((np.max(draws, axis=0) >= largest**2).mean())


# ---- bad starts ------------------------------------------------------------------------------


@dataclass(frozen=True)
class Start:
    """A drawing that is far from the arm."""

    seed: int
    small: bool


def reach(start: Start) -> tuple[float, float]:
    """Arm errors from a bad start: by the images' poses first, and by pixels alone [mm]."""
    cell = cell_of(Job("", 0, start.small))
    rng = np.random.default_rng(start.seed)
    mdh = cell.drawn.mdh.copy()
    mdh[:, :2] += BAD_LENGTH * rng.normal(size=(len(mdh), 2))
    mdh[:, 2] += BAD_ANGLE * rng.normal(size=len(mdh))
    drawn, data = cell.drawn.with_mdh(mdh), data_of(cell)
    begun = from_far(drawn, data, start_scene(drawn, data, on_flange=True))
    doubt = PixelOptions().lens_sigma(begun.images.intrinsic)
    problem = PixelSquares.of(drawn, replace(begun.images, doubt=doubt))
    scene, allowed = fit_drawn(problem, begun.state), problem.stack.movable & ~problem.lenses
    told = problem.identified(drawn, begun.begin or scene, allowed, ~allowed, ANY)
    problem = replace(problem, active=told.active)
    errors = []
    for x in (by_depths(problem, begun.begin or scene, begun), scene):
        found = reprojected(problem, x)[1]
        errors.append(arm_error(cell, drawn.with_mdh(found.mdh)))
    return errors[0], errors[1]


def starts_table(found: Sequence[tuple[float, float]]) -> Table:
    """How many starts reach the arm."""
    names = ("image poses, given depths, pixels", "pixels alone (bundle adjustment)")
    rows = tuple(
        (name, sum(each[i] < REACHED for each in found), len(found)) for i, name in enumerate(names)
    )
    title = f"starts off by {BAD_ANGLE:g} rad (each zero) and {1e3 * BAD_LENGTH:g} mm (each length)"
    return Table.made(title, rows, "way | reach the arm d | of d")


# ---- pixels too weak -------------------------------------------------------------------------


@dataclass(frozen=True)
class Weak:
    """One tag before a tele lens."""

    off: tuple[float, float]
    noise: float
    seed: int


def weak(job: Weak) -> tuple[float, float, float, float, bool]:
    """Error of the drawn, fitted and delivered arm, and with a prior; whether the drawn is kept."""
    stands = transform(np.array([[0.0, 0.0, -1.0], [1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]),
                       np.array([2.5, 0.0, 0.4]))  # fmt: skip
    view = View(stands, (WEAK_FOCAL, WEAK_FOCAL, *LENS[2:]), (-0.02, 0.1, 0.0, 0.0, 0.0))
    cell = make_cell(
        np.random.default_rng(job.seed), on_flange=False, views=(view,), poses=FEW_POSES,
        points=board_points((2, 2), SIDE), distance=WEAK_DISTANCE, off=job.off, noise=job.noise,
        least=0.5,
    )  # fmt: skip
    fit, beside = (
        fitted(cell.drawn, data_of(cell), PixelOptions(camera_on="ground", drawn_prior=prior))
        for prior in (False, True)
    )
    arms = (cell.drawn, fit.calibrated or fit.robot, fit.robot, beside.robot)
    drawn, calibrated, out, prior = (arm_error(cell, arm) for arm in arms)
    return drawn, calibrated, out, prior, fit.status is Status.NO_BETTER


def weak_table(
    jobs: Sequence[Weak], found: Sequence[tuple[float, float, float, float, bool]]
) -> Table:
    """What comes out where pixels are weak."""
    rows = []
    for off, noise in dict.fromkeys((job.off, job.noise) for job in jobs):
        mine = [
            one
            for job, one in zip(jobs, found, strict=True)
            if (job.off, job.noise) == (off, noise)
        ]
        drawn, calibrated, out, prior = np.array([one[:4] for one in mine]).T
        kept = sum(one[4] for one in mine)
        drawing = f"{1e3 * off[0]:g} mm, {1e3 * off[1]:g} mrad"
        means = (drawn.mean(), calibrated.mean(), out.mean())
        rows.append((drawing, noise, *means, (out / drawn).max(), prior.mean(),
                     (prior / drawn).max(), kept, len(mine)))  # fmt: skip
    return Table.made(
        "one tag before a tele lens at 2 m, 0.25 mm a pixel: arm errors, RMS mm",
        rows,
        "drawing off by | noise px g | drawn .3f | fitted .3f | delivered .3f | "
        "worst over drawn .3f | with the prior .3f | its worst over drawn .3f | "
        "drawn kept d | of d",
    )


@study_options("pixels")
def main(study: Study) -> None:
    """What pixels tell of an arm."""
    seeds = range(study.seed, study.seed + (1 if study.quick else SEEDS))
    jobs = [Job(way, seed, study.quick) for way in WAYS for seed in seeds]
    found = study.sweep(run, jobs, "ways")
    starts = [Start(study.seed + i, True) for i in range(1 if study.quick else STARTS)]
    reached = study.sweep(reach, starts, "starts")
    offs, noises = (WEAK_OFF[1:2], WEAK_NOISES[-1:]) if study.quick else (WEAK_OFF, WEAK_NOISES)
    tele = [Weak(off, noise, seed) for off in offs for noise in noises for seed in seeds]
    kept = study.sweep(weak, tele, "weak pixels")
    tables = [ways_table(jobs, found), starts_table(reached), weak_table(tele, kept)]
    content = {
        "ways": {
            way: [
                {"error_mm": one.error, "sigma_mm": one.sigma, "holdout_px": one.pixels}
                for job, one in zip(jobs, found, strict=True) if job.way == way
            ] for way in WAYS
        },
        "starts": [{"depths_mm": one, "pixels_mm": other} for one, other in reached],
        "weak": [
            {"drawn_mm": drawn, "fitted_mm": own, "delivered_mm": out, "prior_mm": prior,
             "kept": bool(held)}
            for drawn, own, out, prior, held in kept
        ],
    }  # fmt: skip
    study.save(tables, content)
