"""A start that needs no guess: the tracker may stand anywhere.

Near the nominal geometry the base and the targets come out in closed form; far from it a search
over base rotations finds the basin of the global minimum.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace

import numpy as np

from minimax_cal.ground.arrays import Array
from minimax_cal.modelling.model import Model, SumOfSquares
from minimax_cal.modelling.parameters import State
from minimax_cal.robots import kinematics
from minimax_cal.robots.kernels.choice import kernels, ready
from minimax_cal.robots.transforms import nearest_rotation
from minimax_cal.solvers import least_squares
from minimax_cal.solvers.least_squares import LeastSquares, Limits

SCREEN, KEEP, ROUNDS = 15, 6, 8  # steps of the first look, starts that go on, further rounds
ENOUGH = 60  # poses that tell one basin from another
EVERYWHERE: Array = np.zeros((0, 3))  # where to look for a base of which nothing is known


def turns_of_a_cube() -> Array:
    """(24, 3, 3) the rotations that bring a cube onto itself."""
    signed = (
        np.eye(3)[list(order)] * np.array(signs)[:, None]
        for order in itertools.permutations(range(3))
        for signs in itertools.product((1.0, -1.0), repeat=3)
    )
    return np.stack([turn for turn in signed if np.linalg.det(turn) > 0.0])


CUBE = turns_of_a_cube()


@dataclass(frozen=True, eq=False)
class BaseFit:
    """Base and targets that fit a fixed geometry best.

    state: the geometry with its base and targets.  mean_square: of the point errors [m^2].
    mirrored: the same if the measurement frame were left-handed [m^2].
    """

    state: State
    mean_square: float
    mirrored: float


def fit_base(model: Model, mdh: Array, near: Array = EVERYWHERE) -> BaseFit:
    """The global best base and targets for a given geometry.

    With S = R_b' the residual S y - c - R_n t - o_n is linear in (S, c, t).  Eliminating c and t
    leaves a quadratic in the nine entries of S; over the rotations it is minimised from its
    unconstrained minimum projected by SVD, and from the 24 turns of a cube, all at once.
    near: (3, 3) rotation of a base that is known to be close, from which alone it then is.
    """
    centre = np.swapaxes(model.y, -1, -2)[model.seen].mean(axis=0)
    plain, turned, known = np.split(linear_rows(model, mdh, centre), (-10, -1), axis=1)
    # one QR eliminates c and t and condenses the rest to ten columns
    plain_q, plain_r = np.linalg.qr(plain)
    rest = np.concatenate([turned, known], axis=1)
    inside = plain_q.T @ rest
    condensed = np.asarray(np.linalg.qr(rest - plain_q @ inside, mode="r"))
    matrix, right = np.ascontiguousarray(condensed[:, :9]), condensed[:, 9].copy()
    if len(near):
        starts, signs = near.T[None], np.ones(1)
    else:
        guess = np.linalg.lstsq(matrix, right, rcond=1e-9)[0].reshape(3, 3)
        starts = np.concatenate(
            [nearest_rotation(g) for g in (guess[None], -guess[None])] + 2 * [CUBE]
        )
        signs = np.repeat([1.0, -1.0, 1.0, -1.0], [1, 1, len(CUBE), len(CUBE)])
    found, cost = kernels().polish(matrix, right, *ready(starts), signs)
    points = np.count_nonzero(model.seen)
    winner = int(np.argmin(np.where(signs > 0.0, cost, np.inf)))
    turn, mean_square = found[winner], float(cost[winner]) / points
    mirrored = float(cost[signs < 0.0].min(initial=np.inf)) / points
    # an ill-conditioned set of poses leaves some of c, t open: the least solution then
    remaining = inside[:, :9] @ turn.reshape(9) - inside[:, 9]
    lengths = np.linalg.lstsq(plain_r, remaining, rcond=1e-10)[0]
    shift, targets = lengths[:3], lengths[3:].reshape(-1, 3)
    state = State(mdh, turn.T, centre + turn.T @ shift, targets)
    return BaseFit(state, mean_square, mirrored)


def linear_rows(model: Model, mdh: Array, centre: Array) -> Array:
    """What the residual of `fit_base` is linear in, times the root of each weight.

    centre: (3,) that is taken off the points [m].  Returns (3 points, 3 + 3k + 9 + 1): columns of
    c, t and S, and what is known.
    """
    links = kinematics.chain(mdh, model.q, model.prismatic)
    k, _, m = model.y.shape
    plain = np.zeros((k, m, 3, 3 + 3 * k))
    plain[..., :3] = np.eye(3)
    for i in range(k):
        plain[i, ..., 3 + 3 * i : 6 + 3 * i] = np.moveaxis(links.axes, -1, 0).swapaxes(-1, -2)
    y = np.swapaxes(model.y, -1, -2) - centre
    turned = np.einsum("ij,kmc->kmijc", np.eye(3), y).reshape(k, m, 3, 9)
    known = np.broadcast_to(links.origin.T[None, :, :, None], (k, m, 3, 1))
    root = np.sqrt(model.weight)[..., None, None]
    rows = root * np.concatenate([plain, turned, known], axis=-1)
    return np.asarray(rows[model.seen].reshape(-1, rows.shape[-1]))


def search(
    model: Model, mdh: Array, points: float, good: float = 0.0, rounds: int = ROUNDS
) -> LeastSquares[State]:
    """The best fit over base rotations when the geometry's angles may be far off.

    First the 24 turns of a cube for the base, with the angles as given.  While the best fit misses
    by more than good [m], further rounds turn the cube at random and set two link angles at random
    in each start: what is far off is mostly one or two zero positions.  Returns the best fits on
    all poses, best first.
    """
    from scipy.spatial.transform import Rotation

    rng = np.random.default_rng(0)  # the same data give the same answer
    found = descend(model, starts_at(model, np.repeat(mdh[None], 24, axis=0), CUBE), points)
    for _ in range(rounds if good > 0.0 else 0):
        if np.sqrt(found.cost[0] / points) <= good:
            break
        turns = CUBE @ Rotation.random(rng=rng).as_matrix()
        links = np.repeat(mdh[None], 24, axis=0)
        for link in links:
            spots = [(rng.integers(len(mdh)), rng.integers(2, 4)) for _ in range(2)]
            for joint, column in spots:
                link[joint, column] = rng.uniform(-np.pi, np.pi)
        other = descend(model, starts_at(model, links, turns), points)
        found = other if other.cost[0] < found.cost[0] else found
    return found


def starts_at(model: Model, mdh: Array, turns: Array) -> State:
    """Starts with the base turned and amid the points, targets in the flange."""
    centre = np.swapaxes(model.y, -1, -2)[model.seen].mean(axis=0)
    origin = np.broadcast_to(centre, (len(mdh), 3))
    return State(mdh, turns, origin, np.zeros((len(mdh), model.y.shape[0], 3)))


def descend(model: Model, starts: State, points: float) -> LeastSquares[State]:
    """The best of many starts, screened on some of the poses and finished on all.

    All take a few damped steps, the best few go on, and the two best of these are finished.
    """
    few, count = thinned(model, ENOUGH), len(starts.mdh)
    some = float(few.counts.sum())
    problem = SumOfSquares(few)
    first = least_squares.solve(problem, starts, count, some, limits=Limits(1e-9, SCREEN))
    chosen = np.argsort(first.cost)[:KEEP]
    second = least_squares.solve(
        problem, first.x.take(chosen), len(chosen), some, limits=Limits(1e-9, 100)
    )
    best = np.argsort(second.cost)[:2]  # the others are other minima, or the same one
    final = least_squares.solve(SumOfSquares(model), second.x.take(best), len(best), points)
    order = np.argsort(final.cost)
    return replace(
        final,
        x=final.x.take(order),
        cost=final.cost[order],
        iterations=final.iterations[order],
        status=tuple(final.status[i] for i in order),
        trace=final.trace[:, order],
    )


def thinned(model: Model, most: int) -> Model:
    """The model with at most so many poses, spread evenly over the rows."""
    m = len(model.q)
    rows = np.linspace(0, m - 1, min(m, most)).astype(int)
    thin = replace(model, q=model.q[rows], y=model.y[..., rows], weight=model.weight[:, rows])
    return thin if np.all(thin.counts >= 3) else model
