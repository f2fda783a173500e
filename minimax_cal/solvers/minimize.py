"""`minimize_max`: the minimax SQP behind a function in SciPy's style, for any smooth problem."""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from scipy.optimize import (
    Bounds,
    LinearConstraint,
    NonlinearConstraint,
    OptimizeResult,
)

from minimax_cal.ground.arrays import Array
from minimax_cal.ground.errors import OptionError
from minimax_cal.solvers import minimax
from minimax_cal.solvers.minimax import Linear, Optimum, Solver, Sqp, Step, excess, from_nothing
from minimax_cal.solvers.status import Status
from qp_backends import Problem, Solution
from qp_backends import solve as solve_qp

Constraint = LinearConstraint | NonlinearConstraint
Given = Constraint | Mapping[str, Any]  # or as `scipy.optimize.minimize` takes it
Function = Callable[[Array], Array]
COMPLEX_STEP = 1e-30
QP_TOLERANCE = 1e-9
ESCAPES = 3  # from points where every gradient vanishes but better ones are near
FLAT = 1e-6  # gradients below, of problems scaled to about one, count as none
PROBE = 1e-4  # share of a variable's length over which that is tried
TRIES, FASTER = 40, 1e4  # of a length; by how much it may be too short at each
NEARBY = 1e-3  # how far a better point is looked for, relative to x
DIRECTIONS = 3  # in which a given gradient is checked
SLOPE_ERROR = 1e-2  # relative to the function's steepest slope; more is a wrong gradient
FARTHER = (1.0, 1e2, 1e4, 1e6)  # times the way of a search that found no end
MESSAGES = {
    "converged": "optimal to the tolerance",
    "iteration_limit": "the iteration limit was reached; raise maxiter, or give an exact jac",
    "stalled": "no step lowers the largest function any more, yet the optimality test fails; give "
    "an exact jac, another QP backend, or a larger tol",
    "infeasible": "the constraints could not be met and may contradict each other; loosen them",
    "failed": "fun or jac gave no finite numbers, or the QP backend no answer; try another x0, or "
    "another qp",
    "unbounded": "the largest function falls without end; add bounds or constraints",
    "wrong_gradient": "jac is not the derivative of fun{}; mend it, or leave it out",
}


def minimize_max(
    fun: Callable[..., Any],
    x0: Any,
    jac: Callable[..., Any] | str | bool | None = "2-point",
    bounds: Bounds | Sequence[tuple[float | None, float | None]] | None = None,
    constraints: Given | Sequence[Given] = (),
    qp: str | Callable[[Problem], Solution] = "daqp",
    *,
    args: tuple[Any, ...] = (),
    tol: float = 1e-8,
    maxiter: int = 500,
    options: Mapping[str, Any] | None = None,
    callback: Callable[[OptimizeResult], None] | None = None,
) -> OptimizeResult:
    """Minimise over x the largest of several smooth functions.

    Parameters
    ----------
    fun
        (n,) -> (m,).
    x0
        (n,).
    jac
        (n,) -> (m, n), or "cs" for the complex step (exact; fun must take complex numbers),
        or "3-point" or "2-point" for finite differences (least accurate; where they do not
        suffice, "3-point" follows), or True where fun returns both.
    bounds, constraints
        scipy.optimize's Bounds, LinearConstraint, NonlinearConstraint, or its dictionaries
        of type, fun, jac and args; bounds also as n pairs, None where open.
    qp
        Name of a QP backend, or a function from Problem to a verified Solution.
    args
        Further arguments of fun and jac.
    tol
        On the KKT residual relative to fun: what moving each variable as far as it went could
        gain, to first order; and on violations relative to that way.
    maxiter
        QPs at most.
    options
        The same by name, as scipy.optimize takes them: tol, maxiter.
    callback
        Called with fun, nit, kkt after each QP.

    Returns
    -------
    OptimizeResult
        x, fun (the largest), values (m,), success, status (as in `Status`, or unbounded, or
        wrong_gradient), message, nit, nfev, njev, multipliers (m,) that sum to one,
        constraint_multipliers (one row a bound or constraint, > 0 at the upper side and < 0
        at the lower), kkt, violation, notes. A jac that is given is checked against
        differences of fun in a few directions, at x0 and at the answer.

    Raises
    ------
    OptionError
        For arguments that do not fit together.

    Examples
    --------
    >>> r = mc.minimize_max(lambda x: np.array([x[0] ** 2, (x[0] - 1.0) ** 2]), [3.0])
    >>> round(float(r.x[0]), 6)
    0.5
    """
    x = np.array(x0, dtype=float).reshape(-1)
    if not len(x):
        raise OptionError("minimize_max: x0 is empty; give the variables to begin with")
    if not np.all(np.isfinite(x)):
        raise OptionError("minimize_max: x0 holds NaN or infinite entries")
    asked = {"tol": tol, "maxiter": maxiter, **(options or {})}
    if unknown := asked.keys() - {"tol", "maxiter"}:
        named = min(map(str, unknown))
        raise OptionError(f"minimize_max: options: no {named}; they are tol and maxiter")
    if jac is None or jac is False:
        jac = "2-point"
    tol, maxiter = float(asked["tol"]), int(asked["maxiter"])
    if jac is True:
        fun, jac = apart(fun)
    if not (0.0 < tol < 1.0 and maxiter >= 1):
        raise OptionError(f"minimize_max: tol {tol:g}, maxiter {maxiter}: give tol between 0 and 1 "
                          "and maxiter of 1 or more")  # fmt: skip
    alone = isinstance(constraints, Constraint | Mapping)
    several: Any = [constraints] if alone else constraints
    listed = [as_scipys(one) for one in several]
    box = bounds if bounds is None or isinstance(bounds, Bounds) else box_of(bounds, len(x))
    ends = (-np.inf, np.inf) if box is None else (box.lb, box.ub)
    x = np.clip(x, *ends)
    count = Count()
    function = counted(lambda z: np.atleast_1d(fun(z, *args)), count)
    length = lengths(function, x, *ends)
    slopes = derivative(function, jac, args, count, length)
    problem = MaxOfFunctions.at(x, function, slopes, Rows.of(length, box, listed), length)
    solver: Solver = (
        from_nothing(qp)
        if not isinstance(qp, str)
        else partial(solve_qp, name=qp, tolerance=QP_TOLERANCE)
    )

    def tell(step: Step) -> None:
        if callback is not None:
            callback(result(fun=step.value, nit=step.iteration, kkt=step.kkt))

    settings = Sqp(tolerance=tol, iterations=maxiter, hessian="bfgs")
    given = callable(jac) or jac == "cs"
    if given and (wrong := mistaken(problem, x, *ends)):
        return without_gradient(problem, x, count, wrong)
    best = minimax.solve(problem, x, solver, settings, tell)
    if jac == "2-point" and best.status in (Status.STALLED, Status.FAILED):  # too coarse
        slopes, steps = derivative(function, "3-point", args, count, length), best.iterations
        problem = replace(problem, jacobian=slopes)
        best = minimax.solve(problem, best.x, solver, settings, tell)
        best = replace(best, iterations=steps + best.iterations)
    for _ in range(ESCAPES):
        lower = below(problem, best.x) if best.status is Status.CONVERGED else None
        if lower is None:
            break
        best = minimax.solve(problem, lower, solver, settings, tell)
    far = best.status is not Status.CONVERGED and falls_on(problem, x, best.x)
    if given and not far and (wrong := mistaken(problem, best.x, *ends)):
        return without_gradient(problem, best.x, count, wrong)
    return answer(problem, best, count, endless=far)


def apart(fun: Callable[..., Any]) -> tuple[Callable[..., Any], Callable[..., Any]]:
    """Values and derivative of a function that returns both, which is asked once a place."""
    last: list[Any] = [None, None]

    def both(x: Array, *args: Any) -> Any:
        if last[0] != (place := x.tobytes()):
            found = fun(x, *args)
            if not (isinstance(found, tuple) and len(found) == 2):
                raise OptionError("minimize_max: jac=True: fun is to return values and derivative")
            last[:] = place, copy.deepcopy(found)
        return last[1]

    return (lambda x, *args: both(x, *args)[0]), (lambda x, *args: both(x, *args)[1])


def as_scipys(given: Any) -> Any:
    """A constraint as it is, or of a dictionary of type, fun, jac, args.  Raises OptionError."""
    if not isinstance(given, Mapping):
        return given
    kind, fun, jac = str(given.get("type")).lower(), given.get("fun"), given.get("jac")
    if kind not in ("eq", "ineq") or not callable(fun):
        raise OptionError(
            "minimize_max: constraints are scipy.optimize's, or dictionaries of type 'eq' or "
            f"'ineq', fun, jac and args, not dict of {', '.join(map(str, given)) or 'nothing'}"
        )
    args, upper = given.get("args", ()), 0.0 if kind == "eq" else np.inf
    args = args if isinstance(args, tuple) else (args,)
    if jac is True:
        fun, jac = apart(fun)
    slopes: Any = (lambda x: jac(x, *args)) if callable(jac) else jac or "2-point"
    return NonlinearConstraint(lambda x: fun(x, *args), 0.0, upper, jac=slopes)


def mistaken(problem: MaxOfFunctions, x: Array, low: Any, high: Any) -> str:
    """Where the gradient differs from the functions' differences; empty where it does not.

    Along a few directions between the bounds, at x and, against a kink just there, beside it.
    """
    rng = np.random.default_rng(0)
    reach = problem.reach(x)
    found: list[set[int]] = []
    beside = x + NEARBY * reach * rng.uniform(-1.0, 1.0, size=len(x))
    for place in (x, np.clip(beside, low, high)):
        slopes, values = problem.jacobian(place), problem.evaluate(place)[0]
        if not (np.all(np.isfinite(slopes)) and np.all(np.isfinite(values))):
            return ""
        off = np.zeros(len(values), dtype=bool)
        for _ in range(DIRECTIONS):
            way = np.finfo(float).eps ** (1.0 / 3.0) * reach * rng.normal(size=len(x))
            ends = np.clip(place + way, low, high), np.clip(place - way, low, high)
            ahead, back = (problem.evaluate(end)[0] for end in ends)
            seen, said = ahead - back, slopes @ (ends[0] - ends[1])
            rounding = 1e3 * np.finfo(float).eps * (np.abs(ahead) + np.abs(back))
            bent = 2.0 * np.abs(ahead + back - 2.0 * values)  # more than differences miss
            steep = np.linalg.norm(slopes * way, axis=1) + np.abs(seen)
            error = np.abs(seen - said)
            off |= np.isfinite(error) & (error > SLOPE_ERROR * steep + rounding + bent)
        found.append(set(np.flatnonzero(off).tolist()))
    wrong = sorted(found[0] & found[1])
    return f" (function {wrong[0]})" if wrong else ""


def without_gradient(problem: MaxOfFunctions, x: Array, count: Count, where: str) -> OptimizeResult:
    """The result where the gradient is wrong: no answer, and where it was found out."""
    values = problem.function(x)
    status = "wrong_gradient"
    return result(
        x=x, fun=float(values.max()), values=values, success=False, status=status,
        message=MESSAGES[status].format(where), nit=0, nfev=count.function, njev=count.jacobian,
        multipliers=np.full(len(values), 1.0 / len(values)),
        constraint_multipliers=np.zeros(len(problem.lower)), kkt=np.inf, violation=0.0, notes=(),
    )  # fmt: skip


def box_of(pairs: Sequence[tuple[float | None, float | None]], n: int) -> Bounds:
    """Bounds from pairs, None where open.  Raises OptionError."""
    try:
        ends = [(-np.inf if low is None else low, np.inf if high is None else high)
                for low, high in pairs]  # fmt: skip
        low, high = np.array(ends, dtype=float).reshape(n, 2).T
    except (TypeError, ValueError):
        raise OptionError(f"minimize_max: bounds: give {n} pairs (low, high), or Bounds") from None
    return Bounds(low, high)


def falls_on(problem: MaxOfFunctions, start: Array, end: Array) -> bool:
    """Whether the largest function falls on and on, the way from a start to an end gone farther."""
    before, _ = problem.evaluate(start)
    worst = float(before.max())
    for far in FARTHER:
        f, c = problem.evaluate(start + far * (end - start))
        if not (np.all(c >= problem.lower) and np.all(c <= problem.upper) and f.max() < worst):
            return False
        worst = float(f.max())
    return True


def below(problem: MaxOfFunctions, x: Array) -> Array | None:
    """A point near x that is better though every gradient vanishes at x, as on a hilltop.

    None where there is none, or where the multipliers balance gradients that do not vanish.
    """
    here = problem.linearise(x)
    worst, reach = float(here.f.max()), problem.reach(x)
    level = max(abs(worst), problem.size)
    active = here.f >= worst - FLAT * level
    if np.abs(here.jacobian[active] * reach).max(initial=0.0) > FLAT * level:
        return None
    steps = NEARBY * np.concatenate([np.diag(reach), -np.diag(reach)])
    best, found = worst - FLAT**2 * level, None
    for step in steps:
        f, c = problem.evaluate(x + step)
        inside = np.all(c >= problem.lower) and np.all(c <= problem.upper)
        if inside and np.all(np.isfinite(f)) and f.max() < best:
            best, found = float(f.max()), x + step
    return found


def result(**fields: Any) -> OptimizeResult:
    """A result in SciPy's form."""
    out = OptimizeResult()
    out.update(fields)
    return out


def answer(
    problem: MaxOfFunctions, best: Optimum[Array], count: Count, *, endless: bool
) -> OptimizeResult:
    """The result of a minimisation."""
    status = "unbounded" if endless else str(best.status)
    return result(
        x=best.x,
        fun=best.value,
        values=best.f,
        success=status == Status.CONVERGED,
        status=status,
        message=MESSAGES[status],
        nit=best.iterations,
        nfev=count.function,
        njev=count.jacobian,
        multipliers=best.mu,
        constraint_multipliers=best.lam,
        kkt=best.kkt.residual,
        violation=float(excess(best.c, problem.lower, problem.upper).max(initial=0.0)),
        notes=best.notes,
    )


@dataclass
class Count:
    """How often function and Jacobian were evaluated."""

    function: int = 0
    jacobian: int = 0


def counted(function: Function, count: Count) -> Function:
    """The function, counting its calls; what it returns that is no number becomes infinite."""

    def run(x: Array) -> Array:
        count.function += 1
        with np.errstate(all="ignore"):
            return np.asarray(function(x))

    return run


def derivative(
    function: Function,
    jac: Callable[..., Any] | str | bool,
    args: tuple[Any, ...],
    count: Count,
    length: Array,
) -> Function:
    """The Jacobian as a function of x alone, differences by shares of x or of a length (n,).

    Raises OptionError for an unknown kind.
    """

    def run(x: Array) -> Array:
        count.jacobian += 1
        if callable(jac):
            return dense(jac(x, *args))
        if jac == "cs":
            return complex_step(function, x)
        return differences(function, x, np.maximum(np.abs(x), length), jac == "3-point")

    if not callable(jac) and jac not in ("cs", "3-point", "2-point"):
        raise OptionError(
            f"minimize_max: jac {jac!r}: give a function, True, 'cs', '3-point' or '2-point'"
        )
    return run


def dense(matrix: Any) -> Array:
    """A matrix, sparse or not, as a two-dimensional array of floats."""
    whole: Any = matrix.toarray() if hasattr(matrix, "toarray") else matrix
    return np.atleast_2d(np.array(whole, dtype=float))


def lengths(function: Function, x: Array, low: Any, high: Any) -> Array:
    """(n,) over which a variable alone changes the functions by their size, at most its bounds.

    By slopes and curvatures, since either may vanish at x; |x|, or 1 at 0, where both do.  Raises
    OptionError for functions that make no sense at x.
    """
    f = function(x)
    if f.ndim != 1 or not np.all(np.isfinite(f)):
        raise OptionError("minimize_max: fun(x0) must be a vector of finite numbers")
    size, width = np.abs(f).max(initial=0.0) or 1.0, np.where(high > low, high - low, np.inf)
    first = length = np.minimum(np.where(x, np.abs(x), 1.0), width)
    for _ in range(TRIES):
        steps = PROBE * length
        beyond, short = x + steps > high, x - steps < low
        ahead = (
            np.array([function(x + s) - f for s in np.diag(np.where(beyond, 0.0, steps))]) / size
        )
        back = np.array([function(x - s) - f for s in np.diag(np.where(short, 0.0, steps))]) / size
        ahead = np.where(beyond[:, None], -back, ahead)
        back = np.where(short[:, None] | ~np.isfinite(back), -ahead, back)
        change = np.maximum(np.abs(ahead - back) / 2.0, np.sqrt(np.abs(ahead + back)))
        seen = change.max(axis=1, initial=0.0)
        found = steps / np.maximum(np.where(np.isfinite(seen), seen, 1.0), PROBE / FASTER)
        found = np.minimum(found, width)
        if np.all((found >= 0.1 * length) & (found <= 10.0 * length)):
            break
        length = np.where(found < length, found, np.sqrt(found * length))
    return np.where(seen > 0.0, found, first)


def differences(function: Function, x: Array, length: Array, central: bool) -> Array:
    """The derivative (m, n) by differences, central or forward, in shares of a length (n,)."""
    size = np.finfo(float).eps ** (1.0 / 3.0 if central else 0.5) * length
    behind = [function(x - step) for step in np.diag(size)] if central else [function(x)] * len(x)
    ahead = [function(x + step) for step in np.diag(size)]
    rise = np.stack(ahead, axis=-1) - np.stack(behind, axis=-1)
    return np.asarray(rise / ((1 + central) * size))


def complex_step(function: Function, x: Array) -> Array:
    """Exact derivative (m, n) of a function that takes complex numbers [Squire and Trapp 1998]."""
    steps = x + 1j * COMPLEX_STEP * np.eye(len(x))
    return np.stack([function(step).imag / COMPLEX_STEP for step in steps], axis=-1)


@dataclass(frozen=True, eq=False)
class Rows:
    """Bounds and constraints as one function c(x) with lower <= c(x) <= upper.

    linear: (l, n) matrix of bounds and linear constraints.  parts: the nonlinear ones, each with
    its derivative.
    """

    linear: Array
    parts: tuple[tuple[Function, Function], ...]
    lower: Array
    upper: Array

    @staticmethod
    def of(length: Array, bounds: Bounds | None, constraints: Sequence[Constraint]) -> Rows:
        """Of variables with lengths (n,).  Raises OptionError where sizes or a kind do not fit."""
        n = len(length)
        blocks = [] if bounds is None else [bound_rows(bounds, n)]
        curved = []
        for constraint in constraints:
            if isinstance(constraint, LinearConstraint):
                blocks.append(linear_rows(constraint, n))
            elif isinstance(constraint, NonlinearConstraint):
                curved.append(constraint)
            else:
                raise OptionError(
                    "minimize_max: constraints are scipy.optimize's LinearConstraint and "
                    f"NonlinearConstraint, not {type(constraint).__name__}"
                )
        nothing = np.zeros(0)
        lower = [*(low for _, low, _ in blocks), *(one_row(c.lb) for c in curved), nothing]
        upper = [*(high for _, _, high in blocks), *(one_row(c.ub) for c in curved), nothing]
        rows = Rows(
            np.concatenate([np.zeros((0, n)), *(matrix for matrix, _, _ in blocks)]),
            tuple(with_derivative(constraint, length) for constraint in curved),
            np.concatenate(lower),
            np.concatenate(upper),
        )
        if np.any(rows.lower > rows.upper):
            raise OptionError("minimize_max: a lower bound is above its upper bound")
        return rows

    def values(self, x: Array) -> Array:
        """c(x): (l,)."""
        return np.concatenate([self.linear @ x, *(function(x) for function, _ in self.parts)])

    def jacobians(self, x: Array) -> Array:
        """c'(x): (l, n)."""
        return np.concatenate(
            [self.linear, *(np.atleast_2d(jacobian(x)) for _, jacobian in self.parts)]
        )


def bound_rows(bounds: Bounds, n: int) -> tuple[Array, Array, Array]:
    """Matrix, lower and upper side of the bounds that are not open."""
    low, high = (np.broadcast_to(side, n).astype(float) for side in (bounds.lb, bounds.ub))
    some = np.isfinite(low) | np.isfinite(high)
    return np.eye(n)[some], low[some], high[some]


def linear_rows(constraint: LinearConstraint, n: int) -> tuple[Array, Array, Array]:
    """Matrix, lower and upper side.  Raises OptionError where the matrix does not fit x."""
    matrix = dense(constraint.A)
    if matrix.shape[1] != n:
        raise OptionError(
            f"minimize_max: a LinearConstraint has {matrix.shape[1]} columns, x has {n}"
        )
    low, high = (np.broadcast_to(side, len(matrix)) for side in (constraint.lb, constraint.ub))
    return matrix, low.astype(float), high.astype(float)


def with_derivative(constraint: NonlinearConstraint, length: Array) -> tuple[Function, Function]:
    """The function of a constraint and its derivative."""
    function = counted(lambda x: one_row(constraint.fun(x)), Count())
    kind = constraint.jac
    kind = kind if callable(kind) or kind in ("cs", "3-point") else "2-point"
    return function, derivative(function, kind, (), Count(), length)


def one_row(values: Any) -> Array:
    """Numbers as a vector."""
    return np.atleast_1d(np.asarray(values))


def unknown(weights: Array) -> Array:
    """The curvature of functions that only BFGS can tell."""
    return np.zeros((0, 0))


@dataclass(frozen=True, eq=False)
class MaxOfFunctions:
    """A problem over R^n as `solvers.minimax` wants it.

    size, length: of the functions and (n,) of the variables at the start.
    """

    function: Function
    jacobian: Function
    rows: Rows
    size: float
    length: Array

    @staticmethod
    def at(
        x: Array, function: Function, jacobian: Function, rows: Rows, length: Array
    ) -> MaxOfFunctions:
        """Raises OptionError for gradients that make no sense at x."""
        first, slope = function(x), jacobian(x)
        if slope.shape != (len(first), len(x)):
            raise OptionError(
                f"minimize_max: jac(x0) has shape {slope.shape}; {len(first)} functions of "
                f"{len(x)} variables need {(len(first), len(x))}"
            )
        size = float(np.abs(first).max(initial=0.0)) or 1.0
        return MaxOfFunctions(function, jacobian, rows, size, length)

    def reach(self, x: Array) -> Array:
        """(n,) what counts as far at x."""
        return np.maximum(np.abs(x), self.length)

    @property
    def lower(self) -> Array:
        """Lower bounds of the constraints."""
        return self.rows.lower

    @property
    def upper(self) -> Array:
        """Upper bounds of the constraints."""
        return self.rows.upper

    def evaluate(self, x: Array) -> tuple[Array, Array]:
        """f and c."""
        return self.function(x), self.rows.values(x)

    def linearise(self, x: Array) -> Linear:
        """f, c and their derivatives; the curvature is left to BFGS."""
        f, c = self.evaluate(x)
        return Linear(f, self.jacobian(x), c, self.rows.jacobians(x), unknown)

    def step(self, x: Array, d: Array) -> Array:
        """The point moved."""
        return x + d
