"""A start that needs no guess: the tracker may stand anywhere.

Near the nominal geometry the base and the targets come out in closed form; far from it a search
over base rotations finds the basin of the global minimum.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from minimax_cal.core.arrays import Array
from minimax_cal.modelling.parameters import ParameterValues
from minimax_cal.modelling.point_model import PointLeastSquares, PointModel
from minimax_cal.robots import kinematics
from minimax_cal.robots.kernels.kernel_choice import (
    active_kernels,
    prepare_kernel_arrays,
    use_numpy_kernels_for_brief_work,
)
from minimax_cal.robots.transforms import nearest_rotations
from minimax_cal.solvers import least_squares
from minimax_cal.solvers.least_squares import LeastSquaresLimits, LeastSquaresSolution

MAX_SCREEN_STEPS, MAX_KEPT_STARTS, MAX_SEARCH_ROUNDS = (
    15,
    6,
    8,
)  # steps of the first look, starts that go on, further rounds
MAX_SCREENED_POSES = 60  # poses that tell one basin from another
POSES_PER_QR_CHUNK = 1024  # poses whose rows are kept at a time
NO_BASE_ROTATION: Array = np.zeros((0, 3))  # where to look for a base of which nothing is known


def build_cube_rotations() -> Array:
    """(24, 3, 3) the rotations that bring a cube onto itself."""
    signed = (
        np.eye(3)[list(order)] * np.array(signs)[:, None]
        for order in itertools.permutations(range(3))
        for signs in itertools.product((1.0, -1.0), repeat=3)
    )
    return np.stack([turn for turn in signed if np.linalg.det(turn) > 0.0])


CUBE_ROTATIONS = build_cube_rotations()


@dataclass(frozen=True, eq=False)
class BaseFit:
    """Base and targets that fit a fixed geometry best.

    state: the geometry with its base and targets.  mean_square: of the point errors [m^2].
    """

    state: ParameterValues
    mean_square: float


class RotationFit(NamedTuple):
    """A rotation (3, 3), and what it costs."""

    rotation: Array
    cost: float


@dataclass(frozen=True, eq=False)
class RotationProblem:
    """|matrix vec(S) - right|^2 over the rotations S.

    matrix: (r, 9).  right: (r,).
    """

    matrix: Array
    right: Array

    def solve(self) -> RotationFit:
        """The best rotation, and what it costs.

        From the unconstrained minimum projected by SVD, and where that may not be the only minimum
        from the 24 turns of a cube too.
        """
        guess = np.linalg.lstsq(self.matrix, self.right, rcond=1e-9)[0].reshape(3, 3)
        found = self.refine_best_start(nearest_rotations(guess[None]))
        if self.is_only_minimum(found.rotation, guess):
            return found
        return min(found, self.refine_best_start(CUBE_ROTATIONS), key=lambda fit: fit.cost)

    def refine_best_start(self, start_rotations: Array) -> RotationFit:
        """The best minimum that some starts (s, 3, 3) lead to."""
        found, cost = active_kernels().refine_rotations(
            self.matrix, self.right, *prepare_kernel_arrays(start_rotations)
        )
        winner = int(np.argmin(cost))
        return RotationFit(found[winner], float(cost[winner]))

    def is_only_minimum(self, rotation: Array, unconstrained: Array) -> bool:
        """Whether no other rotation can be a better minimum.

        unconstrained: (3, 3) the unconstrained minimum G.  One as good as S has |A (S - G)| as
        small, and so lies within rho = |A (S - G)| / s_9 of G (s the singular values of A), as the
        geodesic between the two does within 3 rho.  There the second derivative along it, at least
        2 s_9^2 - 2^(1/2) s_1 |A (S - G)|, is positive where rho (s_1 / s_9)^2 < 2^(1/2) / 3.
        """
        size = np.linalg.svd(self.matrix, compute_uv=False)
        if len(size) < 9 or not size[-1] > 0.0:
            return False
        rho = float(np.linalg.norm(self.matrix @ (rotation - unconstrained).reshape(9))) / size[-1]
        return bool(rho * (size[0] / size[-1]) ** 2 < 0.4)


def fit_base_and_targets(
    model: PointModel, mdh: Array, near_rotation: Array = NO_BASE_ROTATION
) -> BaseFit:
    """The global best base and targets for a given geometry.

    With S = R_b' the residual S y - c - R_n t - o_n is linear in (S, c, t).  Eliminating c and t
    leaves a quadratic in the nine entries of S, which is minimised over the rotations.
    near_rotation: (3, 3) rotation of a base that is known to be close, from which alone it then is.
    """
    centre = np.swapaxes(model.y, -1, -2)[model.measured_mask].mean(axis=0)
    whole = qr_of_base_fit_rows(model, mdh, centre)
    plain, rest = np.split(whole, [whole.shape[1] - 10], axis=1)
    inside, left = np.split(rest, [plain.shape[1]])
    turning = RotationProblem(np.ascontiguousarray(left[:, :9]), left[:, 9].copy())
    turn, cost = (
        turning.refine_best_start(near_rotation.T[None]) if len(near_rotation) else turning.solve()
    )
    # an ill-conditioned set of poses leaves some of c, t open: the least solution then
    remaining = inside[:, :9] @ turn.reshape(9) - inside[:, 9]
    lengths = np.linalg.lstsq(plain[: len(inside)], remaining, rcond=1e-10)[0]
    shift, targets = lengths[:3], lengths[3:].reshape(-1, 3)
    state = ParameterValues(mdh, turn.T, centre + turn.T @ shift, targets)
    return BaseFit(state, cost / int(np.count_nonzero(model.measured_mask)))


def qr_of_base_fit_rows(model: PointModel, mdh: Array, point_centre: Array) -> Array:
    """R of the QR decomposition of what the residual of `fit_base_and_targets` is linear in, block
    by block.

    Its columns are c, t, S, and what is known.  point_centre: (3,) that is taken off the points
    [m].
    """
    out = np.zeros((0, 13 + 3 * len(model.y)))
    for first in range(0, len(model.q), POSES_PER_QR_CHUNK):
        rows = build_base_fit_rows(
            model, mdh, point_centre, slice(first, first + POSES_PER_QR_CHUNK)
        )
        out = np.asarray(np.linalg.qr(np.concatenate([out, rows]), mode="r"))
    return out


def build_base_fit_rows(model: PointModel, mdh: Array, point_centre: Array, poses: slice) -> Array:
    """What the residual of `fit_base_and_targets` is linear in, times the root of each weight.

    point_centre: (3,) that is taken off the points [m].  Returns (3 points, 3 + 3k + 9 + 1):
    columns of c, t and S, and what is known.
    """
    links = kinematics.compute_link_frames(mdh, model.q[poses], model.prismatic)
    y, weight = model.y[..., poses], model.weight[:, poses]
    k, _, m = y.shape
    rows = np.zeros((k, m, 3, 13 + 3 * k))
    turned = rows[..., 3 + 3 * k : 12 + 3 * k].reshape(k, m, 3, 3, 3)
    moved = np.moveaxis(y, 1, 2) - point_centre
    for i in range(3):
        rows[:, :, i, i] = 1.0
        turned[:, :, i, i] = moved
    for target in range(k):
        own = rows[target, :, :, 3 + 3 * target : 6 + 3 * target]
        own[:] = np.moveaxis(links.axes, -1, 0).swapaxes(-1, -2)
    rows[..., -1] = links.origin.T
    rows *= np.sqrt(weight)[..., None, None]
    return np.asarray(rows[weight > 0.0].reshape(-1, rows.shape[-1]))


@use_numpy_kernels_for_brief_work(brief=False)
def search_base_rotations(
    model: PointModel,
    mdh: Array,
    point_count: float,
    good_error: float = 0.0,
    max_rounds: int = MAX_SEARCH_ROUNDS,
) -> LeastSquaresSolution[ParameterValues]:
    """The best fit over base rotations when the geometry's angles may be far off.

    First the 24 turns of a cube for the base, with the angles as given.  While the best fit misses
    by more than good [m], further rounds turn the cube at random and set two link angles at random
    in each start: what is far off is mostly one or two zero positions.  Returns the best fits on
    all poses, best first.
    """
    from scipy.spatial.transform import Rotation

    rng = np.random.default_rng(0)  # the same data give the same answer
    found = fit_best_of_starts(
        model,
        build_search_starts(model, np.repeat(mdh[None], 24, axis=0), CUBE_ROTATIONS),
        point_count,
    )
    for _ in range(max_rounds if good_error > 0.0 else 0):
        if np.sqrt(found.cost[0] / point_count) <= good_error:
            break
        turns = CUBE_ROTATIONS @ Rotation.random(rng=rng).as_matrix()
        links = np.repeat(mdh[None], 24, axis=0)
        for link in links:
            spots = [(rng.integers(len(mdh)), rng.integers(2, 4)) for _ in range(2)]
            for joint, column in spots:
                link[joint, column] = rng.uniform(-np.pi, np.pi)
        other = fit_best_of_starts(model, build_search_starts(model, links, turns), point_count)
        found = other if other.cost[0] < found.cost[0] else found
    return found


def build_search_starts(model: PointModel, mdh: Array, base_rotations: Array) -> ParameterValues:
    """Starts with the base turned and amid the points, targets in the flange."""
    centre = np.swapaxes(model.y, -1, -2)[model.measured_mask].mean(axis=0)
    origin = np.broadcast_to(centre, (len(mdh), 3))
    return ParameterValues(mdh, base_rotations, origin, np.zeros((len(mdh), model.y.shape[0], 3)))


def fit_best_of_starts(
    model: PointModel, starts: ParameterValues, point_count: float
) -> LeastSquaresSolution[ParameterValues]:
    """The best of many starts, screened on some of the poses and finished on all.

    All take a few damped steps, the best few go on, and the two best of these are finished.
    """
    few, count = thin_poses(model, MAX_SCREENED_POSES), len(starts.mdh)
    some = float(few.pose_counts_by_target.sum())
    problem = PointLeastSquares(few)
    first = least_squares.solve(
        problem, starts, count, some, limits=LeastSquaresLimits(1e-9, MAX_SCREEN_STEPS)
    )
    chosen = np.argsort(first.cost)[:MAX_KEPT_STARTS]
    second = least_squares.solve(
        problem, first.x.take(chosen), len(chosen), some, limits=LeastSquaresLimits(1e-9, 100)
    )
    best = np.argsort(second.cost)[:2]  # the others are other minima, or the same one
    final = least_squares.solve(
        PointLeastSquares(model), second.x.take(best), len(best), point_count
    )
    order = np.argsort(final.cost)
    return replace(
        final,
        x=final.x.take(order),
        cost=final.cost[order],
        iterations=final.iterations[order],
        status=tuple(final.status[i] for i in order),
        trace=final.trace[:, order],
    )


def thin_poses(model: PointModel, max_poses: int) -> PointModel:
    """The model with at most so many poses, spread evenly over the rows."""
    m = len(model.q)
    rows = np.linspace(0, m - 1, min(m, max_poses)).astype(int)
    thin = replace(model, q=model.q[rows], y=model.y[..., rows], weight=model.weight[:, rows])
    return thin if np.all(thin.pose_counts_by_target >= 3) else model
