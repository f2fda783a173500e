"""The fit of pixels: least squares from far and near, wrong pixels, lenses that are not as told.

Pixels know no base and no tool, and no length either where no board gives one.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any, cast

import numpy as np

from minimax_cal.fitting.identify import Because, Identification, Reason
from minimax_cal.fitting.pixels.options import PixelOptions
from minimax_cal.fitting.pixels.start import Started
from minimax_cal.fitting.several.fit import InstrumentFit, allowed_of
from minimax_cal.fitting.several.identify import identified, lengths_of, open_scale, order_of
from minimax_cal.fitting.several.stack import Block, Known, Squares, Stack
from minimax_cal.ground.arrays import Array
from minimax_cal.ground.errors import DataError
from minimax_cal.ground.stages import Progress
from minimax_cal.instruments.images import AXES, LENS, Images, Sight
from minimax_cal.instruments.protocol import FlangePoses
from minimax_cal.measuring.grouping import groups
from minimax_cal.modelling.parameters import State, links_of, zero_positions
from minimax_cal.robots.robot import Robot
from minimax_cal.solvers import least_squares
from minimax_cal.solvers.least_squares import METHODS, LeastSquares, Limits
from minimax_cal.solvers.status import Status

TYPICAL = 1.1774  # median of the length of two normal errors over their sigma [Rayleigh]
SOFT = 3.0  # times sigma: from here on a pixel counts less, until the fit is near
APART = 6.0  # times sigma: no pixel of a right corner is so far off (p = 2e-8)
FINEST = 1e-3  # no corner is found better [px]
ROUNDS = 8  # in which wrong pixels are looked for
HOPELESS = 0.01  # of the focal length: a fit with such errors is not worth finishing
FAR_LENS = 4.0  # times its doubt: the pixels contradict the file of a lens
LOOSE = 300.0  # times its doubt: what is then known of such a lens
DEPTH_ROUNDS = 2  # in which depths follow the lengths
COARSE = Limits(step=1e-2, iterations=40)  # of a fit that another follows [px]
FINE = Limits(step=1e-7, iterations=100, damping=1e-9)
ANY = 0.0  # resolution at which everything counts that any pixels could tell
METHOD, AFFINE = METHODS["nllm"], METHODS["snllm-kaufman"]
LENS_HELD = Reason("held as the camera's file says", Because.OTHER)


@dataclass(frozen=True, eq=False)
class PixelSquares(Squares):
    """The sum of squared pixels of one arm; at given depths its errors are affine in lengths."""

    @staticmethod
    def of(robot: Robot, images: Images) -> PixelSquares:
        """Every parameter free and nothing known."""
        stack = Stack.of(robot, [images], [""])
        return PixelSquares(stack, np.ones(stack.names.count, dtype=bool))

    @property
    def block(self) -> Block:
        """The only one."""
        return self.stack.blocks[0]

    @property
    def images(self) -> Images:
        """Its instrument."""
        return cast(Images, self.block.instrument)

    @property
    def lenses(self) -> Array:
        """(p,) True for what is of a lens."""
        count = self.names.count
        return np.asarray(np.arange(count) >= count - self.images.intrinsic[:, :LENS].size)

    @property
    def linear(self) -> Array:
        """(free,) True for lengths."""
        own = [name.rpartition("_")[2] in AXES[:3] for name in self.names.effects]
        every = lengths_of(self.names) | np.pad(own, (self.names.geometric, 0))
        return np.asarray(every[self.active])

    def changed(self, **changes: Any) -> PixelSquares:
        """The same of other images; noise: beside which files and drawing count [px]."""
        block = replace(self.block, instrument=replace(self.images, **changes))
        out = replace(self, stack=replace(self.stack, blocks=(block,)))
        if "noise" not in changes:
            return out
        return replace(out, weight=self.known.weights(changes["noise"] ** 2, self.names.count))

    def at(self, x: State) -> tuple[FlangePoses, Array]:
        """The arm, and the images' own parameters."""
        return self.block.at(x)

    def errors(self, x: State) -> Array:
        """(2, N) measured minus predicted [px]."""
        return self.images.off(*self.at(x))

    def rows(self, x: State, active: Array) -> tuple[Array, Array]:
        """Errors (2N,), u and then v, and slopes (k, 2N) of what is predicted, by roots of weights.

        active: (p,) True for the k parameters.
        """
        error, slope = self.block.rows(x, active)
        count = 2 * len(self.images.weight)
        return error[:count], slope[:, :count]

    def by_joints(self, x: State) -> Array:
        """(n, 2N) slopes of what is predicted by each joint, by roots of weights."""
        at = zero_positions(self.block.arm.prismatic)
        rows = self.rows(x, np.isin(np.arange(self.names.count), at))[1]
        return rows[np.argsort(np.argsort(at))]

    def solved(
        self, x: State, limits: Limits, method: least_squares.Method = METHOD
    ) -> tuple[State, LeastSquares[State]]:
        """Least squares over the active parameters from one state: where it ends, and all of it."""
        points = float(max(len(self.images.weight), 1))
        found = least_squares.solve(self, x.batch(), 1, points, method, limits)
        return found.x.take(np.array(0)), found

    def identified(
        self, robot: Robot, x: State, allowed: Array, wanted: Array, resolution: float
    ) -> Identification:
        """What pixels determine; lenses as well as files know them.

        x: the arm as drawn, with cameras and targets fitted to it.
        """
        stack = self.changed(noise=0.0).stack
        return identified(
            robot, stack, stack.reference(robot, x), x, allowed, wanted, known=self.lenses,
            resolution=resolution,
        )  # fmt: skip


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
    squares: State

    @property
    def images(self) -> Images:
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


def sigma_of(error: Array, weight: Array | None = None) -> float:
    """Sigma of u and v from errors (2, N), by their median [px]."""
    size = np.linalg.norm(error, axis=0)
    size = size if weight is None else size[weight > 0.0]
    return max(float(np.median(size)) / TYPICAL, FINEST)


def softly(error: Array) -> Array:
    """(N,) weights of pixels in a fit that is not near yet [Cauchy]."""
    size = np.linalg.norm(error, axis=0) / (SOFT * sigma_of(error))
    return np.asarray(1.0 / (1.0 + size**2))


def right(error: Array, weight: Array) -> Array:
    """(N,) 1, or 0 where a pixel stands out from the errors (2, N) of those that count."""
    return np.asarray(np.linalg.norm(error, axis=0) <= APART * sigma_of(error, weight), dtype=float)


def fit_drawn(problem: PixelSquares, x: State) -> State:
    """The arm as drawn with the cameras and targets that fit it best, wrong pixels weighed down."""
    own = np.arange(problem.names.count) >= problem.names.geometric
    problem = replace(problem, active=own & ~problem.lenses)
    for _ in range(3):
        x, _ = problem.changed(weight=softly(problem.errors(x))).solved(x, COARSE)
    return x


def fit_pixels(
    robot: Robot, started: Started, options: PixelOptions, progress: Progress
) -> PixelFit:
    """Fit the identifiable parameters to the training pixels.  Raises DataError."""
    doubt = sigma = options.lens_sigma(started.images.intrinsic)
    problem, held = PixelSquares.of(robot, replace(started.images, doubt=doubt)), options.fix_camera
    allowed, wanted = allowed_of(problem.stack, options)
    lens = problem.lenses
    allowed[lens] &= not held
    nominal = fit_drawn(problem, started.state)
    progress("lengths and angles at given depths")
    first = started.begin or nominal
    told = problem.identified(robot, first, allowed, wanted, ANY)
    reference = problem.stack.reference(robot, first)
    order = order_of(robot, problem.stack)
    by_drawing = open_scale(reference, first, reference.gram(first), told.active, order)
    if by_drawing:
        drawn = np.where(lengths_of(problem.names), robot.drawn_within[0], np.inf)
        known = Known(links_of(robot.mdh), drawn[problem.names.links])
        problem = replace(problem, known=known)
    near = replace(problem, active=told.active & ~lens)
    x = by_depths(near.changed(noise=sigma_of(near.errors(first))), first, started)
    progress("identifiable parameters")  # where the arm is, not where a bad drawing has it
    told = problem.identified(robot, x, allowed, wanted, options.resolution)
    known_links = told.active[: 5 * robot.joints]
    check_count(problem.images, int(told.active.sum()), int(known_links.sum()))
    x = replace(x, mdh=np.where(known_links.reshape(5, -1).T, x.mdh, robot.mdh))
    progress("reprojection")
    problem, x, found = reprojected(replace(problem, active=told.active), x)
    own = x
    if held:  # what the pixels say of the lenses: of the files hardly anything counts
        error, weak = problem.errors(x), LOOSE * problem.images.doubt
        freed = replace(problem, active=problem.active | problem.lenses)
        freed = freed.changed(noise=sigma_of(error), doubt=weak, weight=softly(error))
        own, _ = freed.solved(x, COARSE)
    if (lens_off(problem, own) > FAR_LENS * doubt).any() and not held:
        problem, x, found = reprojected(problem.changed(doubt=LOOSE * doubt), x)
        own = x
    off = lens_off(problem, own)
    if held:  # known, or as the user says; where pixels contradict a lens, as far as they say
        sigma = np.where(off > FAR_LENS * doubt, off, doubt * bool(options.camera_prior))
        reasons = dict.fromkeys(problem.images.names[-lens.sum() :], LENS_HELD)
        told = replace(told, reasons={**told.reasons, **reasons})
    images = problem.images
    dof = max(2 * int(images.counted.sum()) - int(problem.active.sum()), 1)
    squares = float((problem.errors(x)[:, images.counted] ** 2).sum())
    noise = max(math.sqrt(squares / dof), FINEST)
    lenses, turn = images.lens(own.effects), images.frames(x.effects)[0]
    x, nominal = (replace(one, effects=images.counted_from(one.effects, turn))
                  for one in (x, nominal))  # fmt: skip
    return PixelFit(
        problem=problem.changed(turn=turn), nominal=nominal, state=x, identification=told,
        found=found, covariance=np.zeros((0, 0)), noise=np.array([noise]), trains={}, alone=(),
        lens_sigma=sigma, held=held, by_drawing=by_drawing, lens=lenses, doubt=doubt,
        share=images.weight, squares=x,
    )  # fmt: skip


def by_depths(problem: PixelSquares, x: State, started: Started) -> State:
    """A fit of lengths and angles in errors that are affine in the lengths, from far away.

    Depths are those that the images tell by themselves, as far as they do; then those of the fit.
    """
    for at in range(DEPTH_ROUNDS):
        depth = np.maximum(problem.images.depth(*problem.at(x)), started.nearest)
        if at == 0 and len(started.depth):
            depth = np.where(started.depth > 0.0, started.depth, depth)
        sight = problem.changed(sight=Sight(depth, started.direction))
        error, _ = sight.rows(x, np.zeros(sight.names.count, dtype=bool))
        x, _ = sight.changed(weight=softly(error.reshape(2, -1))).solved(x, COARSE, AFFINE)
    return x


def reprojected(problem: PixelSquares, x: State) -> tuple[PixelSquares, State, LeastSquares[State]]:
    """The fit of the pixels, those that stand out set aside: where it ends, and all of it."""
    for _ in range(2):
        error = problem.errors(x)
        problem = problem.changed(noise=sigma_of(error), weight=softly(error))
        x, found = problem.solved(x, COARSE)
    problem = problem.changed(weight=np.ones(len(problem.images.weight)))
    if sigma_of(problem.errors(x)) > HOPELESS * problem.images.intrinsic[:, 0].max():
        return problem, x, replace(found, status=(Status.FAILED,))
    for _ in range(ROUNDS):
        before, error = problem.images.weight, problem.errors(x)
        weight = right(error, before)
        problem = problem.changed(noise=sigma_of(error, before), weight=weight)
        x, found = problem.solved(x, FINE)
        if np.array_equal(weight, before):
            break
    return problem, x, found


def lens_off(problem: PixelSquares, x: State) -> Array:
    """(c, 9) how far the lenses are from their files."""
    images = problem.images
    return np.asarray(abs(images.lens(x.effects) - images.intrinsic[:, :LENS]))


def check_count(train: Images, unknowns: int, links: int) -> None:
    """Raise DataError if the training pixels cannot determine the unknowns, links among them.

    Many targets in one image are no more than one pose of a camera, which has six numbers.
    """
    data, count = train.pixels, 2 * train.pixels.count
    poses, cameras = len(np.unique(groups(train.at)[np.unique(data.pose)])), len(data.cameras)
    seen = min(count / max(poses, 1), 6.0 * cameras)
    needed = int(np.ceil((links + 6 * cameras) / max(seen, 1.0))) + 1
    if poses < needed or count <= unknowns:
        raise DataError(
            f"{data.source}: {poses} poses with {count} numbers for the fit, but "
            f"{unknowns} unknown parameters, {links} of links, need at least {needed} poses; take "
            "more images, hold out fewer or fix parameters (fix)"
        )
