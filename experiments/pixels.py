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
    BOARD_CORNER_COUNTS,
    BOARD_SQUARE,
    LENS_PARAMETERS_PX,
    PixelCell,
    SimulatedCamera,
    board_corner_points,
    build_pixel_data,
    cramer_rao_variances,
    draw_compliance_law,
    draw_gear_error_law,
    project_points,
    rms_arm_error_mm,
    simulate_pixel_cell,
)
from experiments.sweep import Study, study_options
from minimax_cal.core.arrays import Array, rms
from minimax_cal.core.tables import Table
from minimax_cal.fitting.pixels.calibrate import calibrate_pixel_data
from minimax_cal.fitting.pixels.fit import (
    ANY_RESOLUTION,
    PixelSquares,
    fit_at_given_depths,
    fit_nominal_scene,
    fit_reprojection_errors,
)
from minimax_cal.fitting.pixels.options import PixelOptions
from minimax_cal.fitting.pixels.pixel_start import (
    board_poses_in_images,
    start_from_far,
    start_scene,
    undistorted_directions,
)
from minimax_cal.instruments import flange_poses
from minimax_cal.instruments.pixel_data import PixelData
from minimax_cal.measuring.pose_groups import select_holdout_rows
from minimax_cal.robots.kinematics import rotation_from_vector, rotation_to_vector
from minimax_cal.robots.transforms import build_transform
from minimax_cal.solvers.status import Status

SEEDS_PER_WAY, FAR_START_COUNT = 10, 10
BOUND_ERROR_DRAWS = 20_000  # of errors at the bound
PIXEL_POSES, QUICK_PIXEL_POSES = 60, 40
SMALL_BOARD_CORNER_COUNTS, SMALL_BOARD_SQUARE = (
    (6, 5),
    0.04,
)  # a board with few corners, for a quick look
OUTLIER_PIXEL_FRACTION = 0.05  # share of the pixels
MEAN_OUTLIER_PX = 30.0  # how far they are off, on average [px]
FAR_START_ANGLE_SIGMA, FAR_START_LENGTH_SIGMA = (
    0.3,
    0.05,
)  # of starts that are far off: zeros, lengths [rad, m]
MAX_REACHED_ARM_ERROR_MM = 0.1  # an arm so near to the true one has found its minimum [mm]
TELE_FOCAL_LENGTH_PX, TELE_DISTANCE_RANGE = (
    8000.0,
    (1.8, 2.2),
)  # a tele lens: 0.25 mm a pixel [px], [m]
TELE_PIXEL_NOISES = (0.1, 0.3, 1.0)  # [px]
TELE_LINK_ERROR_SIGMAS = (
    (3e-4, 5e-4),
    (1e-4, 2e-4),
    (3e-5, 5e-5),
)  # of links from their drawing [m, rad]
NARROW_CAMERA_TILT = 0.25  # tilt of the camera where all poses are to one side [rad]
TAG_SIDE = 0.05  # of the one tag that a tele lens sees [m]


@dataclass(frozen=True)
class PixelJob:
    """One way on one cell."""

    way: str
    seed: int
    small: bool


@dataclass(frozen=True)
class PixelResult:
    """Arm error and its claimed sigma [mm], NaN for none; held-out pixels [px]; what was named.

    least: as `cramer_rao_variances`, () where the links' errors are not all that a fit has to find.
    """

    error: float
    sigma: float
    pixels: float
    named: str = ""
    least: tuple[float, ...] = ()


def simulate_cell_of_job(job: PixelJob, **more: object) -> PixelCell:
    """The cell of a job."""
    rng = np.random.default_rng(job.seed)
    points = (
        board_corner_points(SMALL_BOARD_CORNER_COUNTS, SMALL_BOARD_SQUARE)
        if job.small
        else board_corner_points(BOARD_CORNER_COUNTS, BOARD_SQUARE)
    )
    poses = QUICK_PIXEL_POSES if job.small else PIXEL_POSES
    given = {"target_points": points, "pose_count": poses} | more
    return simulate_pixel_cell(rng, **given)  # type: ignore[arg-type]


def fit_and_judge_pixels(cell: PixelCell, data: PixelData, **options: object) -> PixelResult:
    """A calibration by cameras, judged."""
    on = "flange" if cell.on_flange else "ground"
    fit = calibrate_pixel_data(cell.drawn, data, PixelOptions(camera_on=on, **options))  # type: ignore[arg-type]
    named = f"{len(fit.set_aside)} set aside" if fit.set_aside else ""
    arm = fit.calibrated or fit.robot
    least: Array = np.zeros(0)
    if cell.law is np.asarray and len(data.board):
        held = select_holdout_rows(data.at, 0.2, 0)[0]
        doubt = PixelOptions().lens_sigma(np.stack([one.intrinsic for one in data.cameras]))
        train = data.take_pixels(~held[data.pose])
        least = cramer_rao_variances(cell, train, fit.identification.active, doubt)
    error, sigma = rms_arm_error_mm(cell, arm), 1e3 * fit.claim.sigma
    return PixelResult(error, sigma, fit.pixels["holdout"][0], named, tuple(least))


# ---- ways ------------------------------------------------------------------------------------


def run_hand_eye_alone(job: PixelJob) -> PixelResult:
    """The arm as drawn; only camera and board are fitted."""
    cell = simulate_cell_of_job(job)
    fit = calibrate_pixel_data(cell.drawn, build_pixel_data(cell), PixelOptions(camera_on="flange"))
    return PixelResult(rms_arm_error_mm(cell, cell.drawn), np.nan, fit.pixels["nominal"][0])


def run_whole_poses(job: PixelJob) -> PixelResult:
    """A pose from each image, then a calibration from whole poses."""
    cell = simulate_cell_of_job(job)
    data = build_pixel_data(cell)
    rows, image = board_poses_in_images(data, undistorted_directions(data))[0]
    pose = np.stack(
        [fit_board_pose_to_image(cell, data, *each) for each in zip(rows, image, strict=True)]
    )
    fit = mc.relative(cell.drawn, flange_poses(data.at.q[rows], np.linalg.inv(pose)))
    return PixelResult(rms_arm_error_mm(cell, fit.robot), 1e3 * fit.position_sigma, np.nan)


def fit_board_pose_to_image(
    cell: PixelCell, data: PixelData, pose_index: int, start_pose: Array
) -> Array:
    """Pose (4, 4) of the board in the camera that fits one image best, from a start."""
    mine = data.pose == pose_index
    point, pixel = data.board[data.target[mine]], data.pixel[mine]
    view = replace(cell.views[0], size=(10**6, 10**6))

    def errors(x: Array) -> Array:
        seen = project_points(view, point @ rotation_from_vector(x[:3]).T + x[3:])
        return np.asarray((np.nan_to_num(seen, nan=1e4) - pixel).reshape(-1))

    begin = np.concatenate([rotation_to_vector(start_pose[:3, :3]), start_pose[:3, 3]])
    found = least_squares(errors, begin, method="lm").x
    return build_transform(rotation_from_vector(found[:3]), found[3:])


def scale_focal_lengths(data: PixelData, factor: float) -> PixelData:
    """The data with another focal length in the file of each camera."""
    scale = np.r_[factor, factor, np.ones(14)]
    cameras = (replace(camera, intrinsic=camera.intrinsic * scale) for camera in data.cameras)
    return replace(data, cameras=tuple(cameras))


def run_reprojection(
    job: PixelJob, *, fix_lenses: bool, focal_length_factor: float = 1.0, on_flange: bool = True
) -> PixelResult:
    """The fit of pixels; focal_length_factor: of the focal length in the camera's file."""
    cell = simulate_cell_of_job(job, on_flange=on_flange)
    return fit_and_judge_pixels(
        cell,
        scale_focal_lengths(build_pixel_data(cell), focal_length_factor),
        fix_camera=fix_lenses,
    )


def run_two_cameras(job: PixelJob) -> PixelResult:
    """Two cameras on the flange."""
    poses = [
        build_transform(np.eye(3), np.array(at))
        for at in ((0.04, -0.03, 0.08), (-0.06, 0.02, 0.08))
    ]
    lenses = LENS_PARAMETERS_PX, (2300.0, 2300.0, 1200.0, 1000.0)
    views = tuple(SimulatedCamera(pose, lens) for pose, lens in zip(poses, lenses, strict=True))
    cell = simulate_cell_of_job(job, views=views)
    return fit_and_judge_pixels(cell, build_pixel_data(cell))


def run_unknown_tags(job: PixelJob) -> PixelResult:
    """Fifteen tags of unknown place, on an arm that is drawn as well as its file says."""
    rng = np.random.default_rng(job.seed)
    points = rng.uniform(-1.0, 1.0, (15, 3)) * [0.3, 0.3, 0.05]
    cell = simulate_cell_of_job(
        job, target_points=points, min_visible_share=0.3, link_error_sigmas=(3e-4, 5e-4)
    )
    return fit_and_judge_pixels(cell, build_pixel_data(cell, with_board=False))


def run_with_outliers(job: PixelJob) -> PixelResult:
    """A share of the pixels is wrong."""
    cell, rng = simulate_cell_of_job(job), np.random.default_rng(job.seed)
    data = build_pixel_data(cell)
    wrong = rng.random(data.pixel_count) < OUTLIER_PIXEL_FRACTION
    away = 2.0 + rng.exponential(MEAN_OUTLIER_PX, data.pixel.shape)
    found = fit_and_judge_pixels(
        cell, replace(data, pixel=data.pixel + np.where(wrong[:, None], away, 0.0))
    )
    return replace(found, named=f"{found.named}, {wrong.sum()} wrong")


def run_arm_with_model_error(job: PixelJob, *, is_compliant: bool, one_sided: bool) -> PixelResult:
    """An arm whose gears err, or whose joints bend, which no link holds."""
    rng = np.random.default_rng([job.seed, 1])
    law = (
        draw_compliance_law(mc.load_robot("ur5"), rng) if is_compliant else draw_gear_error_law(rng)
    )
    cell = simulate_cell_of_job(
        job,
        true_joint_law=law,
        one_sided=one_sided,
        **({"tilt": NARROW_CAMERA_TILT} if one_sided else {}),
    )
    return fit_and_judge_pixels(cell, build_pixel_data(cell))


PIXEL_METHODS: dict[str, Callable[[PixelJob], PixelResult]] = {
    "hand-eye alone, arm as drawn": run_hand_eye_alone,
    "poses by PnP, then whole poses": run_whole_poses,
    "reprojection, lenses given": partial(run_reprojection, fix_lenses=True),
    "reprojection, lenses freed": partial(run_reprojection, fix_lenses=False),
    "lenses wrong by 0.03 % and held": partial(
        run_reprojection, fix_lenses=True, focal_length_factor=1.0003
    ),
    "lenses wrong by 0.1 % and held": partial(
        run_reprojection, fix_lenses=True, focal_length_factor=1.001
    ),
    "lenses wrong by 0.1 %, freed": partial(
        run_reprojection, fix_lenses=False, focal_length_factor=1.001
    ),
    "eye to hand, lenses freed": partial(run_reprojection, fix_lenses=False, on_flange=False),
    "eye to hand, wrong by 0.1 % and held": partial(
        run_reprojection, fix_lenses=True, focal_length_factor=0.999, on_flange=False
    ),
    "two cameras, lenses freed": run_two_cameras,
    "tags of unknown place": run_unknown_tags,
    "5 % outliers, lenses freed": run_with_outliers,
    "gear errors": partial(run_arm_with_model_error, is_compliant=False, one_sided=False),
    "gear errors, poses to one side": partial(
        run_arm_with_model_error, is_compliant=False, one_sided=True
    ),
    "bending": partial(run_arm_with_model_error, is_compliant=True, one_sided=False),
    "bending, poses to one side": partial(
        run_arm_with_model_error, is_compliant=True, one_sided=True
    ),
}


def run_job(job: PixelJob) -> PixelResult:
    """One way on one cell."""
    return PIXEL_METHODS[job.way](job)


def build_methods_table(jobs: Sequence[PixelJob], results: Sequence[PixelResult]) -> Table:
    """Arm errors by way over the seeds, against the bound of these poses and what is claimed."""
    rows = []
    for way in PIXEL_METHODS:
        mine = [one for job, one in zip(jobs, results, strict=True) if job.way == way]
        error, sigma, pixels = (
            np.array([getattr(one, name) for one in mine]) for name in ("error", "sigma", "pixels")
        )
        over = error / sigma
        rows.append((way, rms(error), error.max(), *compare_with_cramer_rao_bound(mine),
                     rms(sigma), rms(over), over.max(), float(pixels.mean()),
                     mine[0].named))  # fmt: skip
    return Table.from_rows(
        "arm errors over the joints' whole range, mm, base and tool fitted",
        rows,
        "way | RMS .4f | largest .4f | Cramer-Rao bound .4f | p of the largest .2f | "
        "claimed .4f | RMS over claimed .2f | largest over claimed .2f | held out px .3f | "
        "named",
    )


def compare_with_cramer_rao_bound(results: Sequence[PixelResult]) -> tuple[float, float]:
    """RMS error of fits that reach the bound [mm], and how often their largest is as large."""
    if not all(one.least for one in results):
        return np.nan, np.nan
    rng = np.random.default_rng(0)
    draws = [
        rng.chisquare(1.0, (BOUND_ERROR_DRAWS, len(one.least))) @ np.array(one.least)
        for one in results
    ]
    largest = max(one.error for one in results)
    bound = rms(np.sqrt([sum(one.least) for one in results]))
    return bound, float((np.max(draws, axis=0) >= largest**2).mean())


# ---- bad starts ------------------------------------------------------------------------------


@dataclass(frozen=True)
class FarStart:
    """A drawing that is far from the arm."""

    seed: int
    small: bool


def arm_errors_from_far_start(start: FarStart) -> tuple[float, float]:
    """Arm errors from a bad start: by the images' poses first, and by pixels alone [mm]."""
    cell = simulate_cell_of_job(PixelJob("", 0, start.small))
    rng = np.random.default_rng(start.seed)
    mdh = cell.drawn.mdh.copy()
    mdh[:, :2] += FAR_START_LENGTH_SIGMA * rng.normal(size=(len(mdh), 2))
    mdh[:, 2] += FAR_START_ANGLE_SIGMA * rng.normal(size=len(mdh))
    drawn, data = cell.drawn.with_mdh(mdh), build_pixel_data(cell)
    begun = start_from_far(drawn, data, start_scene(drawn, data, on_flange=True))
    doubt = PixelOptions().lens_sigma(begun.images.intrinsic)
    problem = PixelSquares.from_images(drawn, replace(begun.images, doubt=doubt))
    scene, allowed = (
        fit_nominal_scene(problem, begun.state),
        problem.stack.movable & ~problem.is_lens_parameter,
    )
    told = problem.identify_pixel_parameters(
        drawn, begun.begin or scene, allowed, ~allowed, ANY_RESOLUTION
    )
    problem = replace(problem, active=told.active)
    errors = []
    for x in (fit_at_given_depths(problem, begun.begin or scene, begun), scene):
        found = fit_reprojection_errors(problem, x)[1]
        errors.append(rms_arm_error_mm(cell, drawn.with_mdh(found.mdh)))
    return errors[0], errors[1]


def build_far_starts_table(errors: Sequence[tuple[float, float]]) -> Table:
    """How many starts reach the arm."""
    names = ("image poses, given depths, pixels", "pixels alone (bundle adjustment)")
    rows = tuple(
        (name, sum(each[i] < MAX_REACHED_ARM_ERROR_MM for each in errors), len(errors))
        for i, name in enumerate(names)
    )
    title = (
        f"starts off by {FAR_START_ANGLE_SIGMA:g} rad (each zero) and "
        f"{1e3 * FAR_START_LENGTH_SIGMA:g} mm (each length)"
    )
    return Table.from_rows(title, rows, "way | reach the arm d | of d")


# ---- pixels too weak -------------------------------------------------------------------------


@dataclass(frozen=True)
class WeakPixelJob:
    """One tag before a tele lens."""

    off: tuple[float, float]
    noise: float
    seed: int


def run_weak_pixels(job: WeakPixelJob) -> tuple[float, float, float, float, bool]:
    """Error of the drawn, fitted and delivered arm, and with a prior; whether the drawn is kept."""
    stands = build_transform(np.array([[0.0, 0.0, -1.0], [1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]),
                       np.array([2.5, 0.0, 0.4]))  # fmt: skip
    view = SimulatedCamera(
        stands,
        (TELE_FOCAL_LENGTH_PX, TELE_FOCAL_LENGTH_PX, *LENS_PARAMETERS_PX[2:]),
        (-0.02, 0.1, 0.0, 0.0, 0.0),
    )
    cell = simulate_pixel_cell(
        np.random.default_rng(job.seed),
        on_flange=False,
        views=(view,),
        pose_count=QUICK_PIXEL_POSES,
        target_points=board_corner_points((2, 2), TAG_SIDE),
        distance=TELE_DISTANCE_RANGE,
        link_error_sigmas=job.off,
        noise=job.noise,
        min_visible_share=0.5,
    )
    fit, beside = (
        calibrate_pixel_data(
            cell.drawn, build_pixel_data(cell), PixelOptions(camera_on="ground", drawn_prior=prior)
        )
        for prior in (False, True)
    )
    arms = (cell.drawn, fit.calibrated or fit.robot, fit.robot, beside.robot)
    drawn, calibrated, out, prior = (rms_arm_error_mm(cell, arm) for arm in arms)
    return drawn, calibrated, out, prior, fit.status is Status.NO_BETTER


def build_weak_pixels_table(
    jobs: Sequence[WeakPixelJob], results: Sequence[tuple[float, float, float, float, bool]]
) -> Table:
    """What comes out where pixels are weak."""
    rows = []
    for off, noise in dict.fromkeys((job.off, job.noise) for job in jobs):
        mine = [
            one
            for job, one in zip(jobs, results, strict=True)
            if (job.off, job.noise) == (off, noise)
        ]
        drawn, calibrated, out, prior = np.array([one[:4] for one in mine]).T
        kept = sum(one[4] for one in mine)
        drawing = f"{1e3 * off[0]:g} mm, {1e3 * off[1]:g} mrad"
        means = (drawn.mean(), calibrated.mean(), out.mean())
        rows.append((drawing, noise, *means, (out / drawn).max(), prior.mean(),
                     (prior / drawn).max(), kept, len(mine)))  # fmt: skip
    return Table.from_rows(
        "one tag before a tele lens at 2 m, 0.25 mm a pixel: arm errors, RMS mm",
        rows,
        "drawing off by | noise px g | drawn .3f | fitted .3f | delivered .3f | "
        "worst over drawn .3f | with the prior .3f | its worst over drawn .3f | "
        "drawn kept d | of d",
    )


@study_options("pixels")
def main(study: Study) -> None:
    """What pixels tell of an arm."""
    seeds = range(study.seed, study.seed + (1 if study.quick else SEEDS_PER_WAY))
    jobs = [PixelJob(way, seed, study.quick) for way in PIXEL_METHODS for seed in seeds]
    found = study.sweep(run_job, jobs, "ways")
    starts = [FarStart(study.seed + i, True) for i in range(1 if study.quick else FAR_START_COUNT)]
    reached = study.sweep(arm_errors_from_far_start, starts, "starts")
    offs, noises = (
        (TELE_LINK_ERROR_SIGMAS[1:2], TELE_PIXEL_NOISES[-1:])
        if study.quick
        else (TELE_LINK_ERROR_SIGMAS, TELE_PIXEL_NOISES)
    )
    tele = [WeakPixelJob(off, noise, seed) for off in offs for noise in noises for seed in seeds]
    kept = study.sweep(run_weak_pixels, tele, "weak pixels")
    tables = [
        build_methods_table(jobs, found),
        build_far_starts_table(reached),
        build_weak_pixels_table(tele, kept),
    ]
    content = {
        "ways": {
            way: [
                {"error_mm": one.error, "sigma_mm": one.sigma, "holdout_px": one.pixels}
                for job, one in zip(jobs, found, strict=True) if job.way == way
            ] for way in PIXEL_METHODS
        },
        "starts": [{"depths_mm": one, "pixels_mm": other} for one, other in reached],
        "weak": [
            {"drawn_mm": drawn, "fitted_mm": own, "delivered_mm": out, "prior_mm": prior,
             "kept": bool(held)}
            for drawn, own, out, prior, held in kept
        ],
    }  # fmt: skip
    study.save(tables, content)
