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

# For starts that are mostly near: plain Gauss-Newton steps where they lead straight down, else the
# damped method.  AUTO's are those of snlgn; JOINT's are in all parameters at once, and cheaper.
AUTO, JOINT = "auto", "joint"
DAMPED = "snllm"


def method_of(name: str) -> Method:
    """The method called name; of auto and joint that for a start that may be far."""
    return METHODS[DAMPED if name in (AUTO, JOINT) else name]


def name_of(method: Method) -> str:
    """What a method is called."""
    return next(name for name, known in METHODS.items() if known == method)


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
MOST_DAMPING = 1e12  # beyond it no step leads on


@dataclass(frozen=True, eq=False)
class LeastSquares(Generic[X]):
    """x: the batch of solutions.  cost, iterations: (B,).  status: B of them.

    trace: (iterations + 1, B) cost at each iterate, constant after a member has ended.
    method: which took the steps.
    """

    x: X
    cost: Array
    iterations: Array
    status: tuple[Status, ...]
    trace: Array
    method: Method


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
        trial, motion, gain = tried(problem, at, damping[alive] * method.damped, points, method)
        accept = np.isfinite(trial.cost) & np.isfinite(motion)
        done = accept & (motion <= limits.step)
        ended, failure = done | ~accept, Status.FAILED
        if method.damped:
            lower, ratio = compared(at, trial, gain)
            accept &= lower | done
            damping[alive], growth[alive] = nielsen(damping[alive], growth[alive], accept, ratio)
            ended, failure = done | (damping[alive] > MOST_DAMPING), Status.STALLED
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
    costs = costs if trace else [*costs, cost]
    return LeastSquares(x, cost, iterations, tuple(status), np.stack(costs), method)


def tried(
    problem: Separable[X], at: Examined[X], damping: Array, points: float, method: Method
) -> tuple[Examined[X], Array, Array]:
    """Iterates a step ahead, the mean motion (B,) of a point, and the decrease (B,) predicted."""
    short, gain = damped_step(at, damping)
    square = np.einsum("bi,bij,bj->b", short, at.matrix, short)
    motion = np.sqrt(np.maximum(square, 0.0) / points)
    move = lift(problem.linear, short, at.gradient, at.gram, method)
    return examine(problem, problem.step(at.x, move), method), motion, gain


def compared(at: Examined[X], trial: Examined[X], gain: Array) -> tuple[Array, Array]:
    """(B,) True where a trial costs less; the decrease over the one predicted, 0 to 1."""
    tiny = gain <= 1e-13 * at.cost  # below rounding of the cost: trust the model
    ratio = (at.cost - trial.cost) / np.where(gain > 0, gain, np.inf)
    ratio = np.where(tiny | ~np.isfinite(ratio), 1.0, np.clip(ratio, 0.0, 1.0))
    return (trial.cost < at.cost) | tiny, ratio


def nielsen(damping: Array, growth: Array, accept: Array, ratio: Array) -> tuple[Array, Array]:
    """The next damping and its next growth, (B,) each."""
    shrink = np.maximum(1.0 / 3.0, 1.0 - (2.0 * ratio - 1.0) ** 3)
    next_damping = np.where(accept, damping * shrink, damping * growth)
    return next_damping, np.where(accept, 2.0, growth * 2.0)


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

    @property
    def arrays(self) -> tuple[Array, ...]:
        """All but x, in the order of the fields."""
        return self.cost, self.gradient, self.gram, self.target, self.matrix, self.scale

    def take(self, rows: Array) -> Examined[X]:
        """Some members of the batch."""
        return Examined(self.x.take(rows), *(array[rows] for array in self.arrays))

    def put(self, rows: Array, other: Examined[X]) -> Examined[X]:
        """The batch with some members taken from another one of the same size."""
        out = Examined(self.x.put(rows, other.x.take(rows)), *map(np.copy, self.arrays))
        for mine, new in zip(out.arrays, other.arrays, strict=True):
            mine[rows] = new[rows]
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
