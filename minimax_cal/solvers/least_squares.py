"""Nonlinear and separable least squares, many starts at once [paper S].

The four methods of the paper differ in two switches: whether the lengths are eliminated (variable
projection) and whether the step is damped.  Everything works on normal equations, so the cost of a
step does not depend on how the residuals are stored.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Generic, NamedTuple, Protocol, Self, TypeVar

import numpy as np

from minimax_cal.core.arrays import Array
from minimax_cal.core.linear_algebra import column_norms_from_gram
from minimax_cal.solvers.status import Status


class IterateBatch(Protocol):
    """A batch of iterates that can be picked apart."""

    def take(self, rows: Array) -> Self:
        """Some members of the batch."""

    def put(self, rows: Array, other: Self) -> Self:
        """The batch with some members replaced."""


X = TypeVar("X", bound=IterateBatch)


class CostGradientGram(NamedTuple):
    """Sum of squares (B,), slope J'e (B, p) and Gram matrix J'J (B, p, p) of a batch."""

    cost: Array
    gradient: Array
    gram: Array


class ReducedProblem(NamedTuple, Generic[X]):
    """Iterates at their best lengths r, `CostGradientGram` there, and the coupling (B, r, w)."""

    x: X
    cost: Array
    gradient: Array
    gram: Array
    coupling: Array


class SeparableProblem(Protocol[X]):
    """min over (r, omega) of |y - Phi(omega) r|^2, for a batch of B iterates."""

    @property
    def linear(self) -> Array:
        """(p,) True for the parameters r in which the residual is affine."""

    def normal(self, x: X) -> CostGradientGram:
        """Cost (B,), slope J'e (B, p) and Gram matrix J'J (B, p, p)."""

    def reduced(self, x: X, *, full: bool) -> ReducedProblem[X]:
        """The iterates with their best lengths r, `normal` there, and the coupling.

        The coupling M = (d Phi/d omega)' e (B, r, omega) is needed only if full [paper S, eq. 24].
        """

    def step(self, x: X, dx: Array) -> X:
        """The iterates moved by dx (B, p)."""


@dataclass(frozen=True)
class LeastSquaresMethod:
    """separable: eliminate the lengths.  damped: Levenberg-Marquardt instead of Gauss-Newton.

    full: Golub and Pereyra's Jacobian; False is Kaufman's, which drops its second term.
    """

    separable: bool
    damped: bool
    full: bool = True


LEAST_SQUARES_METHODS = {
    "nlgn": LeastSquaresMethod(separable=False, damped=False),
    "nllm": LeastSquaresMethod(separable=False, damped=True),
    "snlgn": LeastSquaresMethod(separable=True, damped=False),
    "snllm": LeastSquaresMethod(separable=True, damped=True),
    "snlgn-kaufman": LeastSquaresMethod(separable=True, damped=False, full=False),
    "snllm-kaufman": LeastSquaresMethod(separable=True, damped=True, full=False),
}

# For starts that are mostly near: plain Gauss-Newton steps where they lead straight down, else the
# damped method.  AUTO's are those of snlgn; JOINT's are in all parameters at once, and cheaper.
AUTO_METHOD_NAME, JOINT_METHOD_NAME = "auto", "joint"
DAMPED_METHOD_NAME = "snllm"


def find_method(name: str) -> LeastSquaresMethod:
    """The method called name; of auto and joint that for a start that may be far."""
    return LEAST_SQUARES_METHODS[
        DAMPED_METHOD_NAME if name in (AUTO_METHOD_NAME, JOINT_METHOD_NAME) else name
    ]


def find_method_name(method: LeastSquaresMethod) -> str:
    """What a method is called."""
    return next(name for name, known in LEAST_SQUARES_METHODS.items() if known == method)


@dataclass(frozen=True)
class LeastSquaresLimits:
    """When to stop.

    step: root mean square motion of a point that a step would cause [the residual's unit].
    iterations: at most so many.  damping: the first one, relative to the largest column; a start
    that is known to be near wants hardly any (NEAR).
    """

    step: float = 1e-12
    iterations: int = 200
    damping: float = 1e-3


NEAR_START_LIMITS = LeastSquaresLimits(damping=1e-9)
MAX_LEAST_SQUARES_DAMPING = 1e12  # beyond it no step leads on


@dataclass(frozen=True, eq=False)
class LeastSquaresSolution(Generic[X]):
    """x: the batch of solutions.  cost, iterations: (B,).  status: B of them.

    trace: (iterations + 1, B) cost at each iterate, constant after a member has ended.
    method: which took the steps.
    """

    x: X
    cost: Array
    iterations: Array
    status: tuple[Status, ...]
    trace: Array
    method: LeastSquaresMethod


@np.errstate(over="ignore", invalid="ignore")  # an undamped step may diverge: a status says so
def solve(
    problem: SeparableProblem[X],
    starts: X,
    start_count: int,
    residual_point_count: float,
    method: LeastSquaresMethod = LEAST_SQUARES_METHODS["snllm"],
    limits: LeastSquaresLimits = LeastSquaresLimits(),
    progress: Callable[[int], None] = lambda iteration: None,
    *,
    keep_trace: bool = True,
) -> LeastSquaresSolution[X]:
    """Minimise from each of `start_count` starts [paper S, Algorithm 1; damping by Nielsen's rule].

    residual_point_count: number of residual points, which turns a sum of squares into a mean
    motion. keep_trace: whether to keep the cost of every iteration; else only those of start and
    end.
    """
    at = linearise_iterates(problem, starts, method)
    x, cost = at.x, at.cost
    costs = [cost]
    status = [Status.ITERATION_LIMIT] * start_count
    iterations = np.zeros(start_count, dtype=int)
    damping, growth = np.full(start_count, limits.damping), np.full(start_count, 2.0)
    alive = np.arange(start_count)  # the members still iterating
    for iteration in range(1, limits.iterations + 1):
        if not len(alive):
            break
        progress(iteration)
        trial, motion, gain = take_trial_step(
            problem, at, damping[alive] * method.damped, residual_point_count, method
        )
        accept = np.isfinite(trial.cost) & np.isfinite(motion)
        done = accept & (motion <= limits.step)
        ended, failure = done | ~accept, Status.FAILED
        if method.damped:
            lower, ratio = compare_trial_costs(at, trial, gain)
            accept &= lower | done
            damping[alive], growth[alive] = update_damping_by_nielsen(
                damping[alive], growth[alive], accept, ratio
            )
            ended, failure = done | (damping[alive] > MAX_LEAST_SQUARES_DAMPING), Status.STALLED
        at = trial if accept.all() else at.put(np.flatnonzero(accept), trial)
        cost = cost.copy()
        cost[alive] = at.cost
        if keep_trace:
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
    costs = costs if keep_trace else [*costs, cost]
    return LeastSquaresSolution(x, cost, iterations, tuple(status), np.stack(costs), method)


class TrialStep(NamedTuple, Generic[X]):
    """Iterates a step ahead, the mean motion (B,) of a point and the predicted decrease (B,)."""

    iterates: LinearisedIterates[X]
    point_motion: Array
    predicted_decrease: Array


def take_trial_step(
    problem: SeparableProblem[X],
    iterates: LinearisedIterates[X],
    damping: Array,
    residual_point_count: float,
    method: LeastSquaresMethod,
) -> TrialStep[X]:
    """Iterates a step ahead, the mean motion (B,) of a point, and the decrease (B,) predicted."""
    short, gain = solve_damped_step(iterates, damping)
    square = np.einsum("bi,bij,bj->b", short, iterates.matrix, short)
    motion = np.sqrt(np.maximum(square, 0.0) / residual_point_count)
    move = extend_step_to_all_parameters(
        problem.linear, short, iterates.gradient, iterates.gram, method
    )
    return TrialStep(
        linearise_iterates(problem, problem.step(iterates.x, move), method), motion, gain
    )


class TrialComparison(NamedTuple):
    """(B,) whether a trial costs less, and its decrease over the predicted one, 0 to 1."""

    is_cheaper: Array
    decrease_ratio: Array


def compare_trial_costs(
    iterates: LinearisedIterates[X], trial: LinearisedIterates[X], predicted_decrease: Array
) -> TrialComparison:
    """(B,) True where a trial costs less; the decrease over the one predicted, 0 to 1."""
    tiny = (
        predicted_decrease <= 1e-13 * iterates.cost
    )  # below rounding of the cost: trust the model
    ratio = (iterates.cost - trial.cost) / np.where(
        predicted_decrease > 0, predicted_decrease, np.inf
    )
    ratio = np.where(tiny | ~np.isfinite(ratio), 1.0, np.clip(ratio, 0.0, 1.0))
    return TrialComparison((trial.cost < iterates.cost) | tiny, ratio)


class Damping(NamedTuple):
    """The damping of a step and its next growth, (B,) each."""

    damping: Array
    growth: Array


def update_damping_by_nielsen(
    damping: Array, growth: Array, is_accepted: Array, decrease_ratio: Array
) -> Damping:
    """The next damping and its next growth, (B,) each."""
    shrink = np.maximum(1.0 / 3.0, 1.0 - (2.0 * decrease_ratio - 1.0) ** 3)
    next_damping = np.where(is_accepted, damping * shrink, damping * growth)
    return Damping(next_damping, np.where(is_accepted, 2.0, growth * 2.0))


@dataclass(frozen=True, eq=False)
class LinearisedIterates(Generic[X]):
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

    def take(self, member_indices: Array) -> LinearisedIterates[X]:
        """Some members of the batch."""
        return LinearisedIterates(
            self.x.take(member_indices), *(array[member_indices] for array in self.arrays)
        )

    def put(self, member_indices: Array, other: LinearisedIterates[X]) -> LinearisedIterates[X]:
        """The batch with some members taken from another one of the same size."""
        out = LinearisedIterates(
            self.x.put(member_indices, other.x.take(member_indices)), *map(np.copy, self.arrays)
        )
        for mine, new in zip(out.arrays, other.arrays, strict=True):
            mine[member_indices] = new[member_indices]
        return out


def linearise_iterates(
    problem: SeparableProblem[X], x: X, method: LeastSquaresMethod
) -> LinearisedIterates[X]:
    """Cost and (reduced) normal equations; separable methods move x to its best lengths first."""
    if not method.separable:
        cost, gradient, gram = problem.normal(x)
        return LinearisedIterates(
            x, cost, gradient, gram, gradient, gram, column_norms_from_gram(gram)
        )
    x, cost, gradient, gram, coupled = problem.reduced(x, full=method.full)
    r, w = problem.linear, ~problem.linear
    lengths, mixed = gram[:, r][:, :, r], gram[:, r][:, :, w]
    # Golub and Pereyra: P J_w on top of (G+)' M; both halves need the inverse of the lengths' part
    both = np.concatenate([mixed, coupled], axis=-1)
    solved = solve_normal_equations(lengths, both)
    angles = mixed.shape[-1]
    matrix = gram[:, w][:, :, w] - np.swapaxes(mixed, -1, -2) @ solved[..., :angles]
    matrix = matrix + np.swapaxes(coupled, -1, -2) @ solved[..., angles:]
    size = np.maximum(column_norms_from_gram(matrix), 1e-5 * column_norms_from_gram(gram)[:, w])
    if method.damped:  # angles share a unit: the paper's mu I, in units of the largest column
        size = np.repeat(size.max(axis=1, keepdims=True), size.shape[1], axis=1)
    return LinearisedIterates(x, cost, gradient, gram, gradient[:, w], matrix, size)


def extend_step_to_all_parameters(
    is_linear: Array, reduced_step: Array, gradient: Array, gram: Array, method: LeastSquaresMethod
) -> Array:
    """A step in all parameters from one in the angles; the lengths follow to first order."""
    if not method.separable:
        return reduced_step
    out = np.zeros(gradient.shape)
    out[:, ~is_linear] = reduced_step
    mixed = gram[:, is_linear][:, :, ~is_linear]
    pull = gradient[:, is_linear, None] - mixed @ reduced_step[..., None]
    out[:, is_linear] = solve_normal_equations(gram[:, is_linear][:, :, is_linear], pull)[..., 0]
    return out


class DampedStep(NamedTuple):
    """The step (B, p) and the predicted decrease (B,) of the cost."""

    step: Array
    predicted_decrease: Array


def solve_damped_step(iterates: LinearisedIterates[X], damping: Array) -> DampedStep:
    """(H + mu D) step = slope with D = scale^2, and the predicted decrease of the cost."""
    scaled = iterates.matrix / iterates.scale[:, :, None] / iterates.scale[:, None, :]
    right = iterates.target / iterates.scale
    eye = np.eye(right.shape[-1])
    step = solve_normal_equations(
        scaled + damping[:, None, None] * eye, right[..., None], rescale=False
    )
    step = step[..., 0]
    model = 2.0 * right * step - step * (scaled @ step[..., None])[..., 0]
    return DampedStep(step / iterates.scale, model.sum(-1))


def solve_normal_equations(matrix: Array, right: Array, *, rescale: bool = True) -> Array:
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
