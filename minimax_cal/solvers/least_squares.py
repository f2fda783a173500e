"""Nonlinear and separable least squares, many starts at once [paper S].

The four methods of the paper differ in two switches: whether the lengths are eliminated (variable
projection) and whether the step is damped.  Everything works on normal equations, so the cost of a
step does not depend on how the residuals are stored.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Generic, Protocol, Self, TypeVar

import numpy as np

from minimax_cal.ground.arrays import Array
from minimax_cal.solvers.status import Status


class Point(Protocol):
    """A batch of iterates that can be picked apart."""

    def take(self, rows: Array) -> Self:
        """Some members of the batch."""

    def put(self, rows: Array, other: Self) -> Self:
        """The batch with some members replaced."""


X = TypeVar("X", bound=Point)


class Separable(Protocol[X]):
    """min over (r, omega) of |y - Phi(omega) r|^2, for a batch of B iterates."""

    @property
    def linear(self) -> Array:
        """(p,) True for the parameters r in which the residual is affine."""

    def normal(self, x: X) -> tuple[Array, Array, Array]:
        """Cost (B,), slope J'e (B, p) and Gram matrix J'J (B, p, p)."""

    def reduced(self, x: X, *, full: bool) -> tuple[X, Array, Array, Array, Array]:
        """The iterates with their best lengths r, `normal` there, and the coupling.

        The coupling M = (d Phi/d omega)' e (B, r, omega) is needed only if full [paper S, eq. 24].
        """

    def step(self, x: X, dx: Array) -> X:
        """The iterates moved by dx (B, p)."""


@dataclass(frozen=True)
class Method:
    """separable: eliminate the lengths.  damped: Levenberg-Marquardt instead of Gauss-Newton.

    full: Golub and Pereyra's Jacobian; False is Kaufman's, which drops its second term.
    """

    separable: bool
    damped: bool
    full: bool = True


METHODS = {
    "nlgn": Method(separable=False, damped=False),
    "nllm": Method(separable=False, damped=True),
    "snlgn": Method(separable=True, damped=False),
    "snllm": Method(separable=True, damped=True),
    "snlgn-kaufman": Method(separable=True, damped=False, full=False),
    "snllm-kaufman": Method(separable=True, damped=True, full=False),
}


@dataclass(frozen=True)
class Limits:
    """When to stop.

    step: root mean square motion of a point that a step would cause [the residual's unit].
    iterations: at most so many.  damping: the first one, relative to the largest column; a start
    that is known to be near wants hardly any (NEAR).
    """

    step: float = 1e-12
    iterations: int = 200
    damping: float = 1e-3


NEAR = Limits(damping=1e-9)


@dataclass(frozen=True, eq=False)
class LeastSquares(Generic[X]):
    """x: the batch of solutions.  cost, iterations: (B,).  status: B of them.

    trace: (iterations + 1, B) cost at each iterate, constant after a member has ended.
    """

    x: X
    cost: Array
    iterations: Array
    status: tuple[Status, ...]
    trace: Array


@np.errstate(over="ignore", invalid="ignore")  # an undamped step may diverge: a status says so
def solve(
    problem: Separable[X],
    start: X,
    count: int,
    points: float,
    method: Method = METHODS["snllm"],
    limits: Limits = Limits(),
    progress: Callable[[int], None] = lambda iteration: None,
    *,
    trace: bool = True,
) -> LeastSquares[X]:
    """Minimise from each of `count` starts [paper S, Algorithm 1; damping by Nielsen's rule].

    points: number of residual points, which turns a sum of squares into a mean motion.
    trace: whether to keep the cost of every iteration; else only those of start and end.
    """
    at = examine(problem, start, method)
    x, cost = at.x, at.cost
    costs = [cost]
    status = [Status.ITERATION_LIMIT] * count
    iterations = np.zeros(count, dtype=int)
    damping, growth = np.full(count, limits.damping), np.full(count, 2.0)
    alive = np.arange(count)  # the members still iterating
    for iteration in range(1, limits.iterations + 1):
        if not len(alive):
            break
        progress(iteration)
        damp = damping[alive] if method.damped else np.zeros(len(alive))
        short, gain = damped_step(at, damp)
        square = np.einsum("bi,bij,bj->b", short, at.matrix, short)
        motion = np.sqrt(np.maximum(square, 0.0) / points)
        move = lift(problem.linear, short, at.gradient, at.gram, method)
        trial = examine(problem, problem.step(at.x, move), method)
        sane = np.isfinite(trial.cost) & np.isfinite(motion)
        done = sane & (motion <= limits.step)
        accept, ended = sane, done | ~sane
        failure = Status.FAILED
        if method.damped:
            # below rounding of the cost a comparison says nothing: trust the model
            tiny = gain <= 1e-13 * at.cost
            accept = sane & ((trial.cost < at.cost) | tiny | done)
            ratio = (at.cost - trial.cost) / np.where(gain > 0, gain, np.inf)
            ratio = np.where(tiny | ~np.isfinite(ratio), 1.0, np.clip(ratio, 0.0, 1.0))
            shrink = np.maximum(1.0 / 3.0, 1.0 - (2.0 * ratio - 1.0) ** 3)
            damping[alive] = np.where(accept, damp * shrink, damp * growth[alive])
            growth[alive] = np.where(accept, 2.0, growth[alive] * 2.0)
            ended = done | (damping[alive] > 1e12)
            failure = Status.STALLED
        at = trial if accept.all() else at.put(np.flatnonzero(accept), trial)
        cost = cost.copy()
        cost[alive] = at.cost
        if trace:
            costs.append(cost)
        iterations[alive] = iteration
        if ended.any():
            for i in np.flatnonzero(ended):
                status[alive[i]] = Status.CONVERGED if done[i] else failure
            gone, stay = np.flatnonzero(ended), np.flatnonzero(~ended)
            x = x.put(alive[gone], at.x.take(gone))
            alive, at = alive[stay], at.take(stay)
    if len(alive):
        x = x.put(alive, at.x)
    return LeastSquares(
        x, cost, iterations, tuple(status), np.stack(costs if trace else [*costs, cost])
    )


@dataclass(frozen=True, eq=False)
class Examined(Generic[X]):
    """Iterates with what a step needs.

    cost: (B,).  gradient: (B, p), gram: (B, p, p) over all parameters.  target, matrix: right
    side and matrix of the reduced problem in the angles alone (Schur complement), or again over
    all.  scale: size of the matrix's columns, but not less than a part in 1e5 of what they were
    before the lengths took theirs: what is left of a redundant angle is rounding, not to be scaled
    up.
    """

    x: X
    cost: Array
    gradient: Array
    gram: Array
    target: Array
    matrix: Array
    scale: Array

    def take(self, rows: Array) -> Examined[X]:
        """Some members of the batch."""
        arrays = (self.cost, self.gradient, self.gram, self.target, self.matrix, self.scale)
        return Examined(self.x.take(rows), *(array[rows] for array in arrays))

    def put(self, rows: Array, other: Examined[X]) -> Examined[X]:
        """The batch with some members taken from another one of the same size."""
        chosen = other.take(rows)
        out = Examined(
            self.x.put(rows, chosen.x),
            self.cost.copy(),
            self.gradient.copy(),
            self.gram.copy(),
            self.target.copy(),
            self.matrix.copy(),
            self.scale.copy(),
        )
        out.cost[rows], out.gradient[rows], out.gram[rows] = (
            chosen.cost,
            chosen.gradient,
            chosen.gram,
        )
        out.target[rows], out.matrix[rows] = chosen.target, chosen.matrix
        out.scale[rows] = chosen.scale
        return out


def examine(problem: Separable[X], x: X, method: Method) -> Examined[X]:
    """Cost and (reduced) normal equations; separable methods move x to its best lengths first."""
    if not method.separable:
        cost, gradient, gram = problem.normal(x)
        return Examined(x, cost, gradient, gram, gradient, gram, column_size(gram))
    x, cost, gradient, gram, coupled = problem.reduced(x, full=method.full)
    r, w = problem.linear, ~problem.linear
    lengths, mixed = gram[:, r][:, :, r], gram[:, r][:, :, w]
    # Golub and Pereyra: P J_w on top of (G+)' M; both halves need the inverse of the lengths' part
    both = np.concatenate([mixed, coupled], axis=-1)
    solved = solve_normal(lengths, both)
    angles = mixed.shape[-1]
    matrix = gram[:, w][:, :, w] - np.swapaxes(mixed, -1, -2) @ solved[..., :angles]
    matrix = matrix + np.swapaxes(coupled, -1, -2) @ solved[..., angles:]
    size = np.maximum(column_size(matrix), 1e-5 * column_size(gram)[:, w])
    if method.damped:  # angles share a unit: the paper's mu I, in units of the largest column
        size = np.repeat(size.max(axis=1, keepdims=True), size.shape[1], axis=1)
    return Examined(x, cost, gradient, gram, gradient[:, w], matrix, size)


def column_size(gram: Array) -> Array:
    """Norms of the Jacobian's columns: (B, p)."""
    return np.asarray(np.sqrt(np.maximum(np.einsum("bii->bi", gram), 1e-300)))


def lift(linear: Array, short: Array, gradient: Array, gram: Array, method: Method) -> Array:
    """A step in all parameters from one in the angles; the lengths follow to first order."""
    if not method.separable:
        return short
    out = np.zeros(gradient.shape)
    out[:, ~linear] = short
    mixed = gram[:, linear][:, :, ~linear]
    pull = gradient[:, linear, None] - mixed @ short[..., None]
    out[:, linear] = solve_normal(gram[:, linear][:, :, linear], pull)[..., 0]
    return out


def damped_step(at: Examined[X], damping: Array) -> tuple[Array, Array]:
    """(H + mu D) step = slope with D = scale^2, and the predicted decrease of the cost."""
    scaled = at.matrix / at.scale[:, :, None] / at.scale[:, None, :]
    right = at.target / at.scale
    eye = np.eye(right.shape[-1])
    step = solve_normal(scaled + damping[:, None, None] * eye, right[..., None], rescale=False)
    step = step[..., 0]
    model = 2.0 * right * step - step * (scaled @ step[..., None])[..., 0]
    return step / at.scale, model.sum(-1)


def solve_normal(matrix: Array, right: Array, *, rescale: bool = True) -> Array:
    """Solve a batch of symmetric positive semi-definite systems; the least solution if singular.

    rescale: bring the diagonal to one first, which a matrix in bad units needs.
    """
    if not matrix.shape[-1]:
        return np.zeros_like(right)
    diagonal = np.maximum(np.einsum("...ii->...i", matrix), 1e-300)
    scale = np.sqrt(diagonal) if rescale else np.ones_like(diagonal)
    scaled = matrix / scale[..., :, None] / scale[..., None, :]
    try:
        np.linalg.cholesky(scaled - 1e-14 * np.eye(matrix.shape[-1]))
        solution = np.linalg.solve(scaled, right / scale[..., None])
    except np.linalg.LinAlgError:
        finite = np.where(np.isfinite(scaled), scaled, 0.0)
        inverse = np.linalg.pinv(finite, rcond=1e-13, hermitian=True)
        solution = inverse @ (right / scale[..., None])
    return np.asarray(solution / scale[..., None])
