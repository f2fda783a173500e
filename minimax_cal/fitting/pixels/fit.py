"""The fit of pixels: start, identifiable parameters, least squares, wrong pixels, covariance.

Pixels know no base and no tool, and no length either where no board gives one.  Both show in the
rank of the directions to the targets at plenty of poses that no one had to take.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from minimax_cal.fitting.identify import (
    RANK_TOLERANCE,
    Because,
    Identification,
    Kept,
    drop_order,
    redundant,
    scale_keeper,
)
from minimax_cal.fitting.options import freed
from minimax_cal.fitting.pixels.data import PixelData
from minimax_cal.fitting.pixels.model import PixelModel, Scene, Sight
from minimax_cal.fitting.pixels.options import PixelOptions
from minimax_cal.fitting.pixels.start import Started
from minimax_cal.ground.arrays import Array
from minimax_cal.ground.errors import DataError
from minimax_cal.ground.stages import Progress
from minimax_cal.measuring.grouping import groups
from minimax_cal.modelling.model import Prior
from minimax_cal.modelling.parameters import Names, links_of
from minimax_cal.robots.robot import Robot
from minimax_cal.robots.sampling import random_joints
from minimax_cal.solvers import least_squares
from minimax_cal.solvers.least_squares import METHODS, LeastSquares, Limits
from minimax_cal.solvers.status import Status

PLENTY = 60  # poses that show what no poses could tell
STILL = 1e-9  # relative motion of a column that moves nothing
WHOLE = 4  # targets of a board that stand for all
NO_BASE = "no pixel knows the base"


@dataclass(frozen=True)
class Told:
    """What was identified; by_drawing: whether nothing but the drawing tells the scale."""

    identification: Identification
    by_drawing: bool


def lengths_of(names: Names) -> Array:
    """(p,) True for the lengths of the links."""
    return np.asarray(np.arange(names.count) < 2 * names.joints)


def reference_of(robot: Robot, model: PixelModel) -> PixelModel:
    """Every target seen by every camera at plenty of random poses; of a board some targets."""
    q = random_joints(robot, (PLENTY,), np.random.default_rng(0))
    targets = np.unique(model.target)
    if len(model.board):
        chosen = np.linspace(0, len(targets) - 1, min(len(targets), WHOLE)).astype(int)
        spread = np.argsort(np.linalg.norm(model.board[targets] - model.board.mean(axis=0), axis=1))
        targets = targets[spread[chosen]]
    cameras = np.arange(len(model.intrinsic))
    grid = np.meshgrid(np.arange(PLENTY), cameras, targets, indexing="ij")
    pose, camera, target = (part.reshape(-1) for part in grid)
    none = np.zeros((len(pose), 2))
    return replace(
        model, q=robot.turned(q), pose=pose, camera=camera, target=target, pixel=none,
        weight=np.ones(len(pose)),
    )  # fmt: skip


def gram_of_bearings(model: PixelModel, x: Scene, active: Array) -> Array:
    """(p, p) Gram matrix of the directions to the targets, 0 but for the active parameters."""
    rows = model.bearings(x, active)
    flat = rows.reshape(len(rows), -1)
    gram = np.zeros((len(active),) * 2)
    gram[np.ix_(active, active)] = flat @ flat.T
    return gram


def gram_of_pixels(model: PixelModel, x: Scene, active: Array) -> Array:
    """(p, p) Gram matrix of the pixels, 0 but for the active parameters."""
    _, rows = model.rows(x, active)
    flat = (rows * np.sqrt(model.weight)).reshape(len(rows), -1)
    gram = np.zeros((len(active),) * 2)
    gram[np.ix_(active, active)] = flat @ flat.T
    return gram


def identified(
    robot: Robot,
    model: PixelModel,
    x: Scene,
    allowed: Array,
    wanted: Array,
    resolution: float,
) -> Told:
    """The largest set of allowed parameters that the pixels determine; see `fitting.identify`.

    x: the arm as drawn, with cameras and targets fitted to it.  allowed: (p,) False for what the
    user fixed, lenses that are held among it.  wanted: (p,) those to give up last.
    """
    names = model.names
    lens = np.arange(names.count) >= names.count - x.lens[0].size
    base = ~names.links & (np.arange(names.count) < names.geometric)
    plain = gram_of_bearings(reference_of(robot, model), x, ~lens & ~base)
    gram = gram_of_pixels(model, x, ~base)
    scale = np.sqrt(np.diag(gram) / max(len(model.pose), 1))
    kept = Kept(names, allowed & ~base, {}).without(base, Because.OTHER, NO_BASE)
    kept = kept.without(~allowed & names.links, Because.FIXED)
    kept = kept.without(~allowed & lens, Because.OTHER, "held as the camera's file says")
    size = np.sqrt(np.diag(plain))
    for motion, reason in ((size, "turns no direction"), (scale, "moves nothing at these poses")):
        part = kept.active & ~lens
        still = part & (motion <= STILL * motion[~lens].max())
        kept = kept.without(still, Because.OTHER, reason)
    order = np.concatenate([drop_order(robot, names), np.arange(names.geometric, names.count)])
    order = np.concatenate([order[~wanted[order]], order[wanted[order]]])
    keeper = [] if len(model.board) else scale_keeper(robot, kept.active & names.links, wanted)
    order = np.array(list(dict.fromkeys([*keeper, *(int(i) for i in order)])))
    gone = redundant(plain, kept.active & ~lens, order, RANK_TOLERANCE)
    by_drawing = set(keeper) & set(gone)  # nothing but the drawing tells the scale
    kept = kept.without([i for i in gone if i not in by_drawing], Because.SAME_MOTION)
    known = lens | (bool(by_drawing) & lengths_of(names))
    told = gram + np.diag(np.where(known, np.diag(gram), 0.0))
    kept = kept.without(redundant(told, kept.active, order, resolution), Because.NOT_TOLD)
    stems = {"board"} | {name.rpartition("_")[0] for name in names.all if "_" in name}
    found = kept.identification(told, scale, stems, "cameras and targets moved together")
    return Told(found, bool(by_drawing))


# ---- the fit -------------------------------------------------------------------------------------


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


@dataclass(frozen=True, eq=False)
class Known:
    """What is known of parameters besides pixels: mean, sigma (p,), inf where nothing is."""

    mean: Array
    sigma: Array

    def prior(self, noise: float) -> Prior:
        """As a prior beside pixels as noisy as `noise` [px]."""
        return Prior(self.mean, (noise / self.sigma) ** 2)


@dataclass(frozen=True, eq=False)
class PixelFit:
    """What the solver found.

    model: of the training pixels, weight 0 where set aside.  nominal: the arm as drawn with cameras
    and targets fitted to it.  scene: the calibrated one.  noise: sigma of u and v [px].
    lens_sigma: (c, 9) how well the files know the lenses.  held: whether lenses are held so.
    by_drawing: whether nothing but the drawing tells the scale.  lens: (c, 9) the lenses as the
    pixels say they are, also where they are held; doubt: (c, 9) as it was given.
    share: (N,) how much each pixel counts in the scene.  squares: the scene of the least squares.
    """

    model: PixelModel
    nominal: Scene
    scene: Scene
    identification: Identification
    found: LeastSquares[Scene]
    noise: float
    lens_sigma: Array
    held: bool
    by_drawing: bool
    lens: Array
    doubt: Array
    share: Array
    squares: Scene

    @property
    def active(self) -> Array:
        """(p,) True where a parameter was fitted."""
        return self.identification.active


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


def solved(
    model: PixelModel, x: Scene, limits: Limits, method: least_squares.Method = METHOD
) -> LeastSquares[Scene]:
    """Least squares over the model's active parameters from one scene."""
    return least_squares.solve(model, x, 1, float(max(len(model.pose), 1)), method, limits)


def placing(names: Names, lenses: int) -> Array:
    """(p,) True for the poses of cameras and the places of targets."""
    mask = np.arange(names.count) >= names.geometric
    mask[-lenses:] = False
    return mask


def fit_drawn(model: PixelModel, x: Scene) -> Scene:
    """The arm as drawn with the cameras and targets that fit it best, wrong pixels weighed down."""
    model = replace(model, active=placing(model.names, x.lens[0].size))
    for _ in range(3):
        model = replace(model, weight=softly(model.errors(x)))
        x = solved(model, x, COARSE).x
    return x


def known_of(robot: Robot, model: PixelModel, lens: Array, *, by_drawing: bool) -> Known:
    """What the files know of the lenses, and, where nothing else tells the scale, the drawing.

    lens: (c, 9) sigmas.
    """
    names = model.names
    mean, sigma = np.zeros(names.count), np.full(names.count, np.inf)
    mean[-lens.size :] = model.intrinsic[:, : lens.shape[1]].reshape(-1)
    sigma[-lens.size :] = lens.reshape(-1)
    mean[names.links] = links_of(robot.mdh)
    sigma[lengths_of(names)] = robot.drawn_within[0] if by_drawing else np.inf
    return Known(mean, sigma)


def fit_pixels(
    robot: Robot, train: PixelData, started: Started, options: PixelOptions, progress: Progress
) -> PixelFit:
    """Fit the identifiable parameters to the training pixels.  Raises DataError."""
    model, x = PixelModel.of(robot, train, started.on_flange), started.scene
    lenses = x.lens[0].size
    sigma = options.lens_sigma(model.intrinsic)
    allowed = ~model.names.match(options.fix, "fix")
    wanted = freed(model.names, options.free, allowed)
    if options.fix_camera:
        allowed[-lenses:] = False
    nominal = fit_drawn(model, x)
    progress("lengths and angles at given depths")
    lens = np.arange(model.names.count) >= model.names.count - lenses
    first = nominal if started.begin is None else started.begin
    told = identified(robot, model, first, allowed, wanted, ANY)
    beside = known_of(robot, model, sigma, by_drawing=told.by_drawing)
    near = replace(model, active=told.identification.active & ~lens)
    near = replace(near, prior=beside.prior(sigma_of(model.errors(first))))
    x = by_depths(near, first, started)
    progress("identifiable parameters")  # where the arm is, not where a bad drawing has it
    known = identified(robot, model, x, allowed, wanted, options.resolution).identification
    check_count(train, int(known.active.sum()), int(known.active[model.names.links].sum()))
    told_links = known.active[: 5 * robot.joints].reshape(5, -1).T
    x = replace(x, mdh=np.where(told_links, x.mdh, robot.mdh))
    progress("reprojection")
    model = replace(model, active=known.active)
    model, found, noise = reprojected(model, x, beside)
    held = options.fix_camera
    own = found.x if not held else with_lenses(model, found.x, beside)
    if np.abs(lens_off(model, own, sigma)).max() > FAR_LENS and not held:
        loose = replace(beside, sigma=np.where(lens, LOOSE * beside.sigma, beside.sigma))
        model, found, noise = reprojected(model, found.x, loose)
        own = found.x
    off = np.abs(lens_off(model, own, sigma)) * sigma
    if held:  # known, or as the user says; where pixels contradict a lens, as far as they say
        sigma = np.where(off > FAR_LENS * sigma, off, sigma * bool(options.camera_prior))
    return PixelFit(
        model, nominal, found.x, known, found, noise, sigma, held, told.by_drawing, own.lens[0],
        options.lens_sigma(model.intrinsic), model.weight, found.x,
    )  # fmt: skip


def by_depths(model: PixelModel, x: Scene, started: Started) -> Scene:
    """A fit of lengths and angles in errors that are affine in the lengths, from far away.

    Depths are those that the images tell by themselves, as far as they do; then those of the fit.
    """
    for at in range(DEPTH_ROUNDS):
        depth = np.maximum(model.seen(x).point[2], started.nearest)
        if at == 0 and len(started.depth):
            depth = np.where(started.depth > 0.0, started.depth, depth)
        sight = replace(model, sight=Sight(depth, started.direction))
        sight = replace(sight, weight=softly(sight.rows(x, np.zeros(0, dtype=bool))[0]))
        x = solved(sight, x, COARSE, AFFINE).x
    return x


def with_lenses(model: PixelModel, x: Scene, beside: Known) -> Scene:
    """What the pixels say of lenses that are held: a fit that frees them, from that which does not.

    Of what the files know of them hardly anything counts.
    """
    lens = np.arange(model.names.count) >= model.names.count - x.lens[0].size
    prior = replace(beside, sigma=np.where(lens, LOOSE * beside.sigma, beside.sigma))
    free = replace(model, active=model.active | lens, weight=softly(model.errors(x)))
    return solved(replace(free, prior=prior.prior(sigma_of(model.errors(x)))), x, COARSE).x


def reprojected(
    model: PixelModel, x: Scene, beside: Known
) -> tuple[PixelModel, LeastSquares[Scene], float]:
    """The fit of the pixels, those that stand out set aside; the noise of the others [px]."""
    for _ in range(2):
        noise = sigma_of(model.errors(x))
        model = replace(model, weight=softly(model.errors(x)), prior=beside.prior(noise))
        found = solved(model, x, COARSE)
        x = found.x
    model = replace(model, weight=np.ones(len(model.pose)))
    if sigma_of(model.errors(x)) > HOPELESS * model.intrinsic[:, 0].max():
        return model, replace(found, status=(Status.FAILED,)), spread_of(model, x)
    for _ in range(ROUNDS):
        before, error = model.weight, model.errors(x)
        weight = right(error, before)
        model = replace(model, weight=weight, prior=beside.prior(sigma_of(error, before)))
        found = solved(model, x, FINE)
        x = found.x
        if np.array_equal(weight, before):
            break
    return model, found, spread_of(model, x)


def lens_off(model: PixelModel, x: Scene, sigma: Array) -> Array:
    """(c, 9) how far the lenses are from their files, in doubts sigma (c, 9)."""
    return np.asarray((x.lens[0] - model.intrinsic[:, : sigma.shape[1]]) / sigma)


def spread_of(model: PixelModel, x: Scene) -> float:
    """Sigma of u and v by the squares of the pixels that count [px]."""
    counted = model.weight > 0.0
    freedom = max(2 * int(counted.sum()) - int(model.active.sum()), 1)
    return max(float(np.sqrt((model.errors(x)[:, counted] ** 2).sum() / freedom)), FINEST)


def check_count(train: PixelData, unknowns: int, links: int) -> None:
    """Raise DataError if the training pixels cannot determine the unknowns, links among them.

    Many targets in one image are no more than one pose of a camera, which has six numbers.
    """
    poses = len(np.unique(groups(train.at)[np.unique(train.pose)]))
    seen = min(2.0 * train.count / max(poses, 1), 6.0 * len(train.cameras))
    needed = int(np.ceil((links + 6 * len(train.cameras)) / max(seen, 1.0))) + 1
    if poses < needed or 2 * train.count <= unknowns:
        raise DataError(
            f"{train.source}: {poses} poses with {2 * train.count} numbers for the fit, but "
            f"{unknowns} unknown parameters, {links} of links, need at least {needed} poses; take "
            "more images, hold out fewer or fix parameters (fix)"
        )
