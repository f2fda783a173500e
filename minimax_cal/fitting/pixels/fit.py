"""The fit of pixels: least squares from far and near, wrong pixels, lenses that are not as told.

Pixels know no base and no tool, and no length either where no board gives one.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any, cast

import numpy as np

from minimax_cal.core.arrays import Array
from minimax_cal.core.errors import DataError
from minimax_cal.core.progress_stages import Progress
from minimax_cal.fitting.identification import Identification, NotIdentifiedReason, ReasonKind
from minimax_cal.fitting.multi_instrument.instrument_fit import InstrumentFit, select_parameters
from minimax_cal.fitting.multi_instrument.instrument_identification import (
    identify_instrument_parameters,
    instrument_drop_order,
    is_link_length,
    is_scale_undetermined,
)
from minimax_cal.fitting.multi_instrument.instrument_stack import (
    InstrumentBlock,
    InstrumentLeastSquares,
    InstrumentStack,
    LinkPriors,
)
from minimax_cal.fitting.pixels.options import PixelOptions
from minimax_cal.fitting.pixels.pixel_start import PixelStart
from minimax_cal.instruments.camera_images import (
    LENS_PARAMETER_COUNT,
    POSE_AXIS_NAMES,
    CameraImages,
    TargetSight,
)
from minimax_cal.instruments.protocol import FlangePoses
from minimax_cal.measuring.pose_groups import group_repeated_poses
from minimax_cal.modelling.parameters import (
    ParameterValues,
    flatten_link_parameters,
    joint_zero_indices,
)
from minimax_cal.robots.robot import Robot
from minimax_cal.solvers import least_squares
from minimax_cal.solvers.least_squares import (
    LEAST_SQUARES_METHODS,
    LeastSquaresLimits,
    LeastSquaresSolution,
)
from minimax_cal.solvers.status import Status

RAYLEIGH_MEDIAN_TO_SIGMA = (
    1.1774  # median of the length of two normal errors over their sigma [Rayleigh]
)
SOFT_LOSS_SIGMAS = 3.0  # times sigma: from here on a pixel counts less, until the fit is near
MAX_PIXEL_SIGMAS = 6.0  # times sigma: no pixel of a right corner is so far off (p = 2e-8)
MIN_PIXEL_SIGMA = 1e-3  # no corner is found better [px]
MAX_OUTLIER_ROUNDS = 8  # in which wrong pixels are looked for
MAX_ERROR_OF_FOCAL_LENGTH = (
    0.01  # of the focal length: a fit with such errors is not worth finishing
)
MAX_LENS_SIGMAS = 4.0  # times its doubt: the pixels contradict the file of a lens
FREED_LENS_SIGMAS = 300.0  # times its doubt: what is then known of such a lens
DEPTH_ROUNDS = 2  # in which depths follow the lengths
COARSE_LIMITS = LeastSquaresLimits(step=1e-2, iterations=40)  # of a fit that another follows [px]
FINE_LIMITS = LeastSquaresLimits(step=1e-7, iterations=100, damping=1e-9)
ANY_RESOLUTION = 0.0  # resolution at which everything counts that any pixels could tell
JOINT_METHOD, SEPARABLE_METHOD = (
    LEAST_SQUARES_METHODS["nllm"],
    LEAST_SQUARES_METHODS["snllm-kaufman"],
)
LENS_HELD_REASON = NotIdentifiedReason("held as the camera's file says", ReasonKind.OTHER)


@dataclass(frozen=True, eq=False)
class PixelSquares(InstrumentLeastSquares):
    """The sum of squared pixels of one arm; at given depths its errors are affine in lengths."""

    @staticmethod
    def from_images(robot: Robot, images: CameraImages) -> PixelSquares:
        """Every parameter free and nothing known."""
        stack = InstrumentStack.from_instruments(robot, [images], [""])
        return PixelSquares(stack, np.ones(stack.names.parameter_count, dtype=bool))

    @property
    def block(self) -> InstrumentBlock:
        """The only one."""
        return self.stack.blocks[0]

    @property
    def images(self) -> CameraImages:
        """Its instrument."""
        return cast(CameraImages, self.block.instrument)

    @property
    def is_lens_parameter(self) -> Array:
        """(p,) True for what is of a lens."""
        count = self.names.parameter_count
        return np.asarray(
            np.arange(count) >= count - self.images.intrinsic[:, :LENS_PARAMETER_COUNT].size
        )

    @property
    def linear(self) -> Array:
        """(free,) True for lengths."""
        own = [name.rpartition("_")[2] in POSE_AXIS_NAMES[:3] for name in self.names.effects]
        every = is_link_length(self.names) | np.pad(own, (self.names.geometric_count, 0))
        return np.asarray(every[self.active])

    def with_image_changes(self, **changes: Any) -> PixelSquares:
        """The same of other images; noise: beside which files and drawing count [px]."""
        block = replace(self.block, instrument=replace(self.images, **changes))
        out = replace(self, stack=replace(self.stack, blocks=(block,)))
        if "noise" not in changes:
            return out
        return replace(
            out, weight=self.known.weights(changes["noise"] ** 2, self.names.parameter_count)
        )

    def flange_and_own_parameters(self, x: ParameterValues) -> tuple[FlangePoses, Array]:
        """The arm, and the images' own parameters."""
        return self.block.flange_and_own_values(x)

    def errors(self, x: ParameterValues) -> Array:
        """(2, N) measured minus predicted [px]."""
        return self.images.pixel_errors(*self.flange_and_own_parameters(x))

    def rows(self, x: ParameterValues, active: Array) -> tuple[Array, Array]:
        """Errors (2N,), u and then v, and slopes (k, 2N) of what is predicted, by roots of weights.

        active: (p,) True for the k parameters.
        """
        error, slope = self.block.rows(x, active)
        count = 2 * len(self.images.weight)
        return error[:count], slope[:, :count]

    def joint_jacobian(self, x: ParameterValues) -> Array:
        """(n, 2N) slopes of what is predicted by each joint, by roots of weights."""
        at = joint_zero_indices(self.block.arm.prismatic)
        rows = self.rows(x, np.isin(np.arange(self.names.parameter_count), at))[1]
        return rows[np.argsort(np.argsort(at))]

    def solve_least_squares(
        self,
        x: ParameterValues,
        limits: LeastSquaresLimits,
        method: least_squares.LeastSquaresMethod = JOINT_METHOD,
    ) -> tuple[ParameterValues, LeastSquaresSolution[ParameterValues]]:
        """Least squares over the active parameters from one state: where it ends, and all of it."""
        points = float(max(len(self.images.weight), 1))
        found = least_squares.solve(self, x.batch(), 1, points, method, limits)
        return found.x.take(np.array(0)), found

    def identify_pixel_parameters(
        self, robot: Robot, x: ParameterValues, allowed: Array, wanted: Array, resolution: float
    ) -> Identification:
        """What pixels determine; lenses as well as files know them.

        x: the arm as drawn, with cameras and targets fitted to it.
        """
        stack = self.with_image_changes(noise=0.0).stack
        return identify_instrument_parameters(
            robot,
            stack,
            stack.at_reference_poses(robot, x),
            x,
            allowed,
            wanted,
            known=self.is_lens_parameter,
            resolution=resolution,
        )


@dataclass(frozen=True, eq=False, kw_only=True)
class PixelFit(InstrumentFit):
    """What the solver found, in pixels.

    problem: of the training pixels, of weight 0 where set aside.  lens_sigma: (c, 9) how well the
    files know the lenses.  held: whether lenses are held so.  by_drawing: whether nothing but the
    drawing tells the scale.  lens: (c, 9) the lenses as the pixels say they are, also where they
    are held; doubt: (c, 9) as it was given.  share: (N,) how much each pixel counts in the state.
    squares: the state of the least squares.
    """

    problem: PixelSquares
    lens_sigma: Array
    held: bool
    by_drawing: bool
    lens: Array
    doubt: Array
    share: Array
    squares: ParameterValues

    @property
    def images(self) -> CameraImages:
        """Of training, as they weigh."""
        return self.problem.images

    @property
    def noise_px(self) -> float:
        """Sigma of u and v [px]."""
        return float(self.noise[0])

    @property
    def prior(self) -> Array:
        """(free,) weights of what is known of the parameters besides pixels."""
        _, slope = self.problem.block.rows(self.squares, self.problem.active)
        lens = slope[:, 2 * len(self.images.weight) :]
        return np.asarray((lens**2).sum(axis=1) + np.diag(self.problem.prior))


def robust_pixel_sigma(pixel_errors: Array, weight: Array | None = None) -> float:
    """Sigma of u and v from errors (2, N), by their median [px]."""
    size = np.linalg.norm(pixel_errors, axis=0)
    size = size if weight is None else size[weight > 0.0]
    return max(float(np.median(size)) / RAYLEIGH_MEDIAN_TO_SIGMA, MIN_PIXEL_SIGMA)


def cauchy_weights(pixel_errors: Array) -> Array:
    """(N,) weights of pixels in a fit that is not near yet [Cauchy]."""
    size = np.linalg.norm(pixel_errors, axis=0) / (
        SOFT_LOSS_SIGMAS * robust_pixel_sigma(pixel_errors)
    )
    return np.asarray(1.0 / (1.0 + size**2))


def inlier_weights(pixel_errors: Array, weight: Array) -> Array:
    """(N,) 1, or 0 where a pixel stands out from the errors (2, N) of those that count."""
    return np.asarray(
        np.linalg.norm(pixel_errors, axis=0)
        <= MAX_PIXEL_SIGMAS * robust_pixel_sigma(pixel_errors, weight),
        dtype=float,
    )


def fit_nominal_scene(problem: PixelSquares, x: ParameterValues) -> ParameterValues:
    """The arm as drawn with the cameras and targets that fit it best, wrong pixels weighed down."""
    own = np.arange(problem.names.parameter_count) >= problem.names.geometric_count
    problem = replace(problem, active=own & ~problem.is_lens_parameter)
    for _ in range(3):
        x, _ = problem.with_image_changes(
            weight=cauchy_weights(problem.errors(x))
        ).solve_least_squares(x, COARSE_LIMITS)
    return x


def fit_pixels(
    robot: Robot, started: PixelStart, options: PixelOptions, progress: Progress
) -> PixelFit:
    """Fit the identifiable parameters to the training pixels.  Raises DataError."""
    doubt = sigma = options.lens_sigma(started.images.intrinsic)
    problem, held = (
        PixelSquares.from_images(robot, replace(started.images, doubt=doubt)),
        options.fix_camera,
    )
    allowed, wanted = select_parameters(problem.stack, options)
    lens = problem.is_lens_parameter
    allowed[lens] &= not held
    nominal = fit_nominal_scene(problem, started.state)
    progress("lengths and angles at given depths")
    first = started.begin or nominal
    told = problem.identify_pixel_parameters(robot, first, allowed, wanted, ANY_RESOLUTION)
    reference = problem.stack.at_reference_poses(robot, first)
    order = instrument_drop_order(robot, problem.stack)
    by_drawing = is_scale_undetermined(
        reference, first, reference.gram_matrix(first), told.active, order
    )
    if by_drawing:
        drawn = np.where(is_link_length(problem.names), robot.drawn_within[0], np.inf)
        known = LinkPriors(flatten_link_parameters(robot.mdh), drawn[problem.names.link_mask])
        problem = replace(problem, known=known)
    near = replace(problem, active=told.active & ~lens)
    x = fit_at_given_depths(
        near.with_image_changes(noise=robust_pixel_sigma(near.errors(first))), first, started
    )
    progress("identifiable parameters")  # where the arm is, not where a bad drawing has it
    told = problem.identify_pixel_parameters(robot, x, allowed, wanted, options.resolution)
    known_links = told.active[: 5 * robot.joints]
    check_pixel_count(problem.images, int(told.active.sum()), int(known_links.sum()))
    x = replace(x, mdh=np.where(known_links.reshape(5, -1).T, x.mdh, robot.mdh))
    progress("reprojection")
    problem, x, found = fit_reprojection_errors(replace(problem, active=told.active), x)
    own = x
    if held:  # what the pixels say of the lenses: of the files hardly anything counts
        error, weak = problem.errors(x), FREED_LENS_SIGMAS * problem.images.doubt
        freed = replace(problem, active=problem.active | problem.is_lens_parameter)
        freed = freed.with_image_changes(
            noise=robust_pixel_sigma(error), doubt=weak, weight=cauchy_weights(error)
        )
        own, _ = freed.solve_least_squares(x, COARSE_LIMITS)
    if (lens_deviations(problem, own) > MAX_LENS_SIGMAS * doubt).any() and not held:
        problem, x, found = fit_reprojection_errors(
            problem.with_image_changes(doubt=FREED_LENS_SIGMAS * doubt), x
        )
        own = x
    off = lens_deviations(problem, own)
    if held:  # known, or as the user says; where pixels contradict a lens, as far as they say
        sigma = np.where(off > MAX_LENS_SIGMAS * doubt, off, doubt * bool(options.camera_prior))
        reasons = dict.fromkeys(problem.images.names[-lens.sum() :], LENS_HELD_REASON)
        told = replace(told, reasons={**told.reasons, **reasons})
    images = problem.images
    dof = max(2 * int(images.counted_pixel_mask.sum()) - int(problem.active.sum()), 1)
    squares = float((problem.errors(x)[:, images.counted_pixel_mask] ** 2).sum())
    noise = max(math.sqrt(squares / dof), MIN_PIXEL_SIGMA)
    lenses, turn = images.lens_parameters(own.effects), images.camera_and_board_frames(x.effects)[0]
    x, nominal = (replace(one, effects=images.count_rotations_from(one.effects, turn))
                  for one in (x, nominal))  # fmt: skip
    return PixelFit(
        problem=problem.with_image_changes(turn=turn),
        nominal=nominal,
        state=x,
        identification=told,
        least_squares=found,
        covariance=np.zeros((0, 0)),
        noise=np.array([noise]),
        training_data={},
        determined_alone=(),
        lens_sigma=sigma,
        held=held,
        by_drawing=by_drawing,
        lens=lenses,
        doubt=doubt,
        share=images.weight,
        squares=x,
    )


def fit_at_given_depths(
    problem: PixelSquares, x: ParameterValues, started: PixelStart
) -> ParameterValues:
    """A fit of lengths and angles in errors that are affine in the lengths, from far away.

    Depths are those that the images tell by themselves, as far as they do; then those of the fit.
    """
    for at in range(DEPTH_ROUNDS):
        depth = np.maximum(
            problem.images.target_depths(*problem.flange_and_own_parameters(x)), started.nearest
        )
        if at == 0 and len(started.depth):
            depth = np.where(started.depth > 0.0, started.depth, depth)
        sight = problem.with_image_changes(sight=TargetSight(depth, started.direction))
        error, _ = sight.rows(x, np.zeros(sight.names.parameter_count, dtype=bool))
        x, _ = sight.with_image_changes(
            weight=cauchy_weights(error.reshape(2, -1))
        ).solve_least_squares(x, COARSE_LIMITS, SEPARABLE_METHOD)
    return x


def fit_reprojection_errors(
    problem: PixelSquares, x: ParameterValues
) -> tuple[PixelSquares, ParameterValues, LeastSquaresSolution[ParameterValues]]:
    """The fit of the pixels, those that stand out set aside: where it ends, and all of it."""
    for _ in range(2):
        error = problem.errors(x)
        problem = problem.with_image_changes(
            noise=robust_pixel_sigma(error), weight=cauchy_weights(error)
        )
        x, found = problem.solve_least_squares(x, COARSE_LIMITS)
    problem = problem.with_image_changes(weight=np.ones(len(problem.images.weight)))
    if (
        robust_pixel_sigma(problem.errors(x))
        > MAX_ERROR_OF_FOCAL_LENGTH * problem.images.intrinsic[:, 0].max()
    ):
        return problem, x, replace(found, status=(Status.FAILED,))
    for _ in range(MAX_OUTLIER_ROUNDS):
        before, error = problem.images.weight, problem.errors(x)
        weight = inlier_weights(error, before)
        problem = problem.with_image_changes(noise=robust_pixel_sigma(error, before), weight=weight)
        x, found = problem.solve_least_squares(x, FINE_LIMITS)
        if np.array_equal(weight, before):
            break
    return problem, x, found


def lens_deviations(problem: PixelSquares, x: ParameterValues) -> Array:
    """(c, 9) how far the lenses are from their files."""
    images = problem.images
    return np.asarray(
        abs(images.lens_parameters(x.effects) - images.intrinsic[:, :LENS_PARAMETER_COUNT])
    )


def check_pixel_count(train: CameraImages, unknowns: int, links: int) -> None:
    """Raise DataError if the training pixels cannot determine the unknowns, links among them.

    Many targets in one image are no more than one pose of a camera, which has six numbers.
    """
    data, count = train.pixels, 2 * train.pixels.pixel_count
    poses, cameras = (
        len(np.unique(group_repeated_poses(train.at)[np.unique(data.pose)])),
        len(data.cameras),
    )
    seen = min(count / max(poses, 1), 6.0 * cameras)
    needed = int(np.ceil((links + 6 * cameras) / max(seen, 1.0))) + 1
    if poses < needed or count <= unknowns:
        raise DataError(
            f"{data.source}: {poses} poses with {count} numbers for the fit, but "
            f"{unknowns} unknown parameters, {links} of links, need at least {needed} poses; take "
            "more images, hold out fewer or fix parameters (fix)"
        )
