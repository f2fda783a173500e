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
from minimax_cal.robots.kernels.choice import kernels, ready, work
from minimax_cal.robots.transforms import nearest_rotation
from minimax_cal.solvers import least_squares
from minimax_cal.solvers.least_squares import LeastSquares, Limits

MAX_SCREEN_STEPS, MAX_KEPT_STARTS, MAX_SEARCH_ROUNDS = (
    15,
    6,
    8,
)  # steps of the first look, starts that go on, further rounds
MAX_SCREENED_POSES = 60  # poses that tell one basin from another
CHUNK = 1024  # poses whose rows are kept at a time
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
    """

    state: State
    mean_square: float


@dataclass(frozen=True, eq=False)
class Turning:
    """|matrix vec(S) - right|^2 over the rotations S.

    matrix: (r, 9).  right: (r,).
    """

    matrix: Array
    right: Array

    def best(self) -> tuple[Array, float]:
        """The best rotation, and what it costs.

        From the unconstrained minimum projected by SVD, and where that may not be the only minimum
        from the 24 turns of a cube too.
        """
        guess = np.linalg.lstsq(self.matrix, self.right, rcond=1e-9)[0].reshape(3, 3)
        found = self.polished(nearest_rotation(guess[None]))
        if self.alone(found[0], guess):
            return found
        return min(found, self.polished(CUBE), key=lambda one: one[1])

    def polished(self, starts: Array) -> tuple[Array, float]:
        """The best minimum that some starts (s, 3, 3) lead to."""
        found, cost = kernels().polish(self.matrix, self.right, *ready(starts))
        winner = int(np.argmin(cost))
        return found[winner], float(cost[winner])

    def alone(self, turn: Array, guess: Array) -> bool:
        """Whether no other rotation can be a better minimum.

        guess: (3, 3) the unconstrained minimum G.  One as good as S has |A (S - G)| as small, and
        so lies within rho = |A (S - G)| / s_9 of G (s the singular values of A), as the geodesic
        between the two does within 3 rho.  There the second derivative along it, at least
        2 s_9^2 - 2^(1/2) s_1 |A (S - G)|, is positive where rho (s_1 / s_9)^2 < 2^(1/2) / 3.
        """
        size = np.linalg.svd(self.matrix, compute_uv=False)
        if len(size) < 9 or not size[-1] > 0.0:
            return False
        rho = float(np.linalg.norm(self.matrix @ (turn - guess).reshape(9))) / size[-1]
        return bool(rho * (size[0] / size[-1]) ** 2 < 0.4)


def fit_base(model: Model, mdh: Array, near: Array = EVERYWHERE) -> BaseFit:
    """The global best base and targets for a given geometry.

    With S = R_b' the residual S y - c - R_n t - o_n is linear in (S, c, t).  Eliminating c and t
    leaves a quadratic in the nine entries of S, which is minimised over the rotations.
    near: (3, 3) rotation of a base that is known to be close, from which alone it then is.
    """
    centre = np.swapaxes(model.y, -1, -2)[model.seen].mean(axis=0)
    whole = condensed(model, mdh, centre)
    plain, rest = np.split(whole, [whole.shape[1] - 10], axis=1)
    inside, left = np.split(rest, [plain.shape[1]])
    turning = Turning(np.ascontiguousarray(left[:, :9]), left[:, 9].copy())
    turn, cost = turning.polished(near.T[None]) if len(near) else turning.best()
    # an ill-conditioned set of poses leaves some of c, t open: the least solution then
    remaining = inside[:, :9] @ turn.reshape(9) - inside[:, 9]
    lengths = np.linalg.lstsq(plain[: len(inside)], remaining, rcond=1e-10)[0]
    shift, targets = lengths[:3], lengths[3:].reshape(-1, 3)
    state = State(mdh, turn.T, centre + turn.T @ shift, targets)
    return BaseFit(state, cost / int(np.count_nonzero(model.seen)))


def condensed(model: Model, mdh: Array, centre: Array) -> Array:
    """R of the QR decomposition of what the residual of `fit_base` is linear in, block by block.

    Its columns are c, t, S, and what is known.  centre: (3,) that is taken off the points [m].
    """
    out = np.zeros((0, 13 + 3 * len(model.y)))
    for first in range(0, len(model.q), CHUNK):
        rows = linear_rows(model, mdh, centre, slice(first, first + CHUNK))
        out = np.asarray(np.linalg.qr(np.concatenate([out, rows]), mode="r"))
    return out


def linear_rows(model: Model, mdh: Array, centre: Array, poses: slice) -> Array:
    """What the residual of `fit_base` is linear in, times the root of each weight.

    centre: (3,) that is taken off the points [m].  Returns (3 points, 3 + 3k + 9 + 1): columns of
    c, t and S, and what is known.
    """
    links = kinematics.chain(mdh, model.q[poses], model.prismatic)
    y, weight = model.y[..., poses], model.weight[:, poses]
    k, _, m = y.shape
    rows = np.zeros((k, m, 3, 13 + 3 * k))
    turned = rows[..., 3 + 3 * k : 12 + 3 * k].reshape(k, m, 3, 3, 3)
    moved = np.moveaxis(y, 1, 2) - centre
    for i in range(3):
        rows[:, :, i, i] = 1.0
        turned[:, :, i, i] = moved
    for target in range(k):
        own = rows[target, :, :, 3 + 3 * target : 6 + 3 * target]
        own[:] = np.moveaxis(links.axes, -1, 0).swapaxes(-1, -2)
    rows[..., -1] = links.origin.T
    rows *= np.sqrt(weight)[..., None, None]
    return np.asarray(rows[weight > 0.0].reshape(-1, rows.shape[-1]))


@work(brief=False)
def search(
    model: Model, mdh: Array, points: float, good: float = 0.0, rounds: int = MAX_SEARCH_ROUNDS
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
    few, count = thinned(model, MAX_SCREENED_POSES), len(starts.mdh)
    some = float(few.counts.sum())
    problem = SumOfSquares(few)
    first = least_squares.solve(problem, starts, count, some, limits=Limits(1e-9, MAX_SCREEN_STEPS))
    chosen = np.argsort(first.cost)[:MAX_KEPT_STARTS]
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
