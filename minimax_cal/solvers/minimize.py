"""`minimize_max`: the minimax SQP behind a function in SciPy's style, for any smooth problem."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, Literal

import numpy as np
from scipy.optimize import Bounds, LinearConstraint, NonlinearConstraint, OptimizeResult

from minimax_cal.core.arrays import Array
from minimax_cal.core.errors import OptionError
from minimax_cal.solvers import minimax
from minimax_cal.solvers.answer_check import (
    AnswerCheck,
    find_better_point_near_stationary_point,
    is_unbounded_below_along_line,
    measure_answer_optimality,
)
from minimax_cal.solvers.constraint_rows import (
    convert_to_scipy_bounds,
    split_function_with_jacobian,
)
from minimax_cal.solvers.derivatives import CountedFunction, find_function_with_wrong_gradient
from minimax_cal.solvers.epigraph_qp import VerifiedQpSolver
from minimax_cal.solvers.feasibility import find_feasible_point
from minimax_cal.solvers.iterate import NO_MULTIPLIERS, StartScales
from minimax_cal.solvers.linearisation import constraint_excess
from minimax_cal.solvers.max_problem import EPS, MaxOfFunctions
from minimax_cal.solvers.minimax import Optimum, Sqp, Step
from minimax_cal.solvers.qp_function import QpFunction, build_verified_qp_solver
from minimax_cal.solvers.status import Status
from qp_backends import solve as solve_qp
from qp_backends.registry import BackendName

Constraint = LinearConstraint | NonlinearConstraint
ConstraintLike = Constraint | Mapping[str, Any]  # or as `scipy.optimize.minimize` takes it
Scheme = Literal["2-point", "3-point", "cs"]

QP_TOLERANCE = 1e-9
MAX_STATIONARY_POINT_ESCAPES = (
    3  # from points where every gradient vanishes but better ones are near
)
MIN_PROGRESS_PER_TOLERANCE = 1e-3  # of the tolerance: a search that gains less ends
UNBOUNDED_STATUS = "unbounded"
STATUS_MESSAGES = {
    "converged": "optimal to the tolerance",
    "iteration_limit": "the iteration limit was reached; raise maxiter, or give an exact jac",
    "stalled": "no step lowers the largest function any more, yet the optimality test fails; give "
    "an exact jac, another QP backend, or a larger tol",
    "infeasible": "the constraints could not be met and may contradict each other; loosen them",
    "failed": "fun or jac gave no finite numbers, or the QP backend no answer; try another x0, or "
    "another qp",
    UNBOUNDED_STATUS: "the largest function falls without end; add bounds or constraints",
    "wrong_gradient": "jac is not the derivative of fun (function {}); mend it, or leave it out",
}


@np.errstate(all="ignore")  # values on the way may be infinite; the outcome says what they did
def minimize_max(
    fun: Callable[..., Any],
    x0: Any,
    jac: Callable[..., Any] | Scheme | bool | None = "2-point",
    bounds: Bounds | Sequence[tuple[float | None, float | None]] | None = None,
    constraints: ConstraintLike | Sequence[ConstraintLike] = (),
    qp: BackendName | QpFunction = "daqp",
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
        (n,) -> (m,).  It may return the same buffer each time.
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
        Name of a QP backend, or a function from Problem to x (n,), to (x, y) with the multipliers
        y (m,), or to a Solution.
    args
        Further arguments of fun and jac.
    tol
        On the KKT residual relative to fun at the answer: what moving each variable over the
        length in which it changes the functions by their size could gain, to first order; and on
        violations relative to the terms of their row.
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
        at the lower), kkt and violation (both measured at the answer; violation in the units of
        the constraints), notes, history (value, violation, kkt and step of each QP, but for those
        that only looked for a point that meets the constraints). A jac that
        is given is checked against differences of fun in a few directions, at x0 and at the answer.

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
    settings = {"tol": tol, "maxiter": maxiter, **(options or {})}
    if unknown := settings.keys() - {"tol", "maxiter"}:
        first = min(map(str, unknown))
        raise OptionError(f"minimize_max: options: no {first}; they are tol and maxiter")
    tol, maxiter = float(settings["tol"]), int(settings["maxiter"])
    if not (0.0 < tol < 1.0 and maxiter >= 1):
        raise OptionError(f"minimize_max: tol {tol:g}, maxiter {maxiter}: give tol between 0 and 1 "
                          "and maxiter of 1 or more")  # fmt: skip
    if jac is True:
        fun, jac = split_function_with_jacobian(fun)
    scheme: Any = (lambda z: jac(z, *args)) if callable(jac) else jac or "2-point"
    box = convert_to_scipy_bounds(bounds, len(x))
    alone = isinstance(constraints, Constraint | Mapping)
    rows: Any = [constraints] if alone else constraints
    if box is not None:
        x = np.clip(x, box.lb, box.ub)
    function = CountedFunction(lambda z: fun(z, *args))
    problem = MaxOfFunctions.from_functions(x, function, scheme, box, rows)
    solver: VerifiedQpSolver = (
        partial(solve_qp, name=qp, tolerance=QP_TOLERANCE)
        if isinstance(qp, str)
        else build_verified_qp_solver(qp, QP_TOLERANCE)
    )
    is_exact = callable(jac) or jac == "cs"
    if is_exact and (wrong := find_index_of_wrong_gradient(problem, x)) is not None:
        return build_wrong_gradient_result(problem, x, wrong)

    search = OptimumSearch(solver, tol, maxiter, callback)
    answer = search.find_optimum(problem, x)
    problem, optimum = answer.problem, answer.optimum
    status = str(answer.status)
    if (
        status != UNBOUNDED_STATUS
        and is_exact
        and (wrong := find_index_of_wrong_gradient(problem, optimum.x)) is not None
    ):
        return build_wrong_gradient_result(problem, optimum.x, wrong)
    values = problem.function(optimum.x)
    violation = constraint_excess(optimum.c, problem.lower, problem.upper).max(initial=0.0)
    message = STATUS_MESSAGES[status]
    rounding = EPS * float(np.abs(values).max())
    if status == Status.CONVERGED and rounding > tol * search.gained:
        message += f"; values near {np.abs(values).max():.3g} are rounded to {rounding:.1g}"
    return build_optimize_result(
        x=optimum.x, fun=float(values.max()), values=values, success=status == Status.CONVERGED,
        status=status, message=message, nit=search.iteration_count,
        nfev=function.count, njev=problem.jacobian.count, multipliers=answer.check.mu,
        constraint_multipliers=np.ldexp(answer.check.lam, problem.exponent),
        kkt=answer.check.kkt.residual, violation=float(violation), notes=optimum.notes,
        history=tuple(search.history),
    )  # fmt: skip


@dataclass(frozen=True, eq=False)
class SearchAnswer:
    """Where a search ended: the problem in the units of that point, and what was found there."""

    problem: MaxOfFunctions
    optimum: Optimum[Array]
    check: AnswerCheck
    status: str


@dataclass
class OptimumSearch:
    """Runs of the SQP, each from where the last one ended and in the units of that point.

    A run measures tolerance, reach and zero from where it began; far from the start they mean
    nothing.  So its end is checked where it is, and the search goes on from there until the check
    holds, nothing more is gained, or the QPs are used up.

    gained: by how much the largest function fell.  history: one entry a QP.
    """

    solver: VerifiedQpSolver
    tolerance: float
    max_iterations: int
    callback: Callable[[OptimizeResult], None] | None = None
    iteration_count: int = 0
    gained: float = 0.0
    history: list[OptimizeResult] = field(default_factory=list)

    def find_optimum(
        self, problem: MaxOfFunctions, x: Array, with_feasibility: bool = True
    ) -> SearchAnswer:
        """Minimise from x (n,).

        with_feasibility: whether to look for a feasible point where none was found on the way.
        """
        start, described, start_value = x, problem, float(problem.function(x).max())
        last_value, last_violation = start_value, np.inf
        escape_count, mu, largest_level = 0, NO_MULTIPLIERS, np.inf
        while True:
            optimum = self.run_sqp(problem, x, mu, largest_level)
            x, last_exponent = optimum.x, problem.exponent
            problem = problem.with_units_at(x)
            lam = np.ldexp(optimum.lam, last_exponent - problem.exponent)
            optimum = replace(optimum, f=problem.values(x), lam=lam)
            check = measure_answer_optimality(
                problem, x, optimum.mu, optimum.lam, start, self.tolerance
            )
            value = float(np.ldexp(optimum.f.max(), problem.exponent))
            violation = check.kkt.violation
            self.gained = start_value - value
            answer = SearchAnswer(problem, optimum, check, Status.CONVERGED)

            if check.kkt.residual <= self.tolerance:
                lower = find_better_point_near_stationary_point(problem, x)
                if lower is None or escape_count == MAX_STATIONARY_POINT_ESCAPES:
                    return answer
                x, mu, escape_count = lower, NO_MULTIPLIERS, escape_count + 1
                continue
            has_ended = self.iteration_count >= self.max_iterations
            if (has_ended or optimum.status is Status.FAILED) and (
                self.is_unbounded_below_between(described, start, x)
            ):
                return replace(answer, status=UNBOUNDED_STATUS)
            if has_ended:
                return replace(answer, status=Status.ITERATION_LIMIT)

            # No optimum can be told from a point that breaks constraints: first one that does not.
            if violation > self.tolerance and with_feasibility:
                nearer = min((x, start), key=lambda place: largest_violation(problem, place))
                found = find_feasible_point(problem, nearer, self)
                if found.is_proven and not found.is_feasible:
                    return replace(answer, status=Status.INFEASIBLE)
                with_feasibility = False
                if found.is_feasible:
                    x, mu, problem = found.x, NO_MULTIPLIERS, problem.with_units_at(found.x)
                    last_value = last_violation = largest_level = np.inf
                    continue

            # From here again, as long as that gains anything.
            gain = (last_value - value) / np.ldexp(check.level, problem.exponent)
            has_gained = gain > MIN_PROGRESS_PER_TOLERANCE * self.tolerance and violation <= max(
                last_violation, self.tolerance
            )
            is_nearer = self.tolerance < violation < 0.9 * last_violation
            is_finer = check.level < 0.5 * largest_level
            last_value, last_violation, largest_level = value, violation, check.level
            if np.isfinite(value) and (has_gained or is_nearer or is_finer):
                mu = optimum.mu
                continue
            if problem.jacobian.scheme == "2-point":  # too coarse
                problem.jacobian.scheme = "3-point"
                continue
            if self.is_unbounded_below_between(described, start, x):
                return replace(answer, status=UNBOUNDED_STATUS)
            ended = optimum.status
            return replace(answer, status=Status.STALLED if ended is Status.CONVERGED else ended)

    def is_unbounded_below_between(self, problem: MaxOfFunctions, start: Array, end: Array) -> bool:
        """Whether the functions fall on and on from a feasible point near a start to an end."""
        anchor = start
        if largest_violation(problem, start) > self.tolerance:
            found = find_feasible_point(problem, start, self)
            if not found.is_feasible:
                return False
            anchor = found.x
        return is_unbounded_below_along_line(problem, anchor, end, self.tolerance)

    def run_sqp(
        self, problem: MaxOfFunctions, x: Array, mu: Array, largest_level: float
    ) -> Optimum[Array]:
        """One run from x.

        mu: (m,) multipliers to begin with, or none.  largest_level: with what changes of the value
        are compared at most, in the problem's unit.
        """
        before = self.iteration_count

        def report(step: Step) -> None:
            self.iteration_count = before + step.iteration
            value = float(np.ldexp(step.value, problem.exponent))
            self.history.append(
                build_optimize_result(
                    value=value, violation=step.violation, kkt=step.kkt, step=step.length
                )
            )
            if self.callback is not None:
                self.callback(
                    build_optimize_result(fun=value, nit=self.iteration_count, kkt=step.kkt)
                )

        settings = Sqp(self.tolerance, self.max_iterations - before, hessian="bfgs")
        scales = StartScales(problem.lengths, largest_level)
        return minimax.solve(problem, x, self.solver, settings, report, mu, scales)


def largest_violation(problem: MaxOfFunctions, x: Array) -> float:
    """Of the constraints at x, each relative to its terms; infinite where it is no number."""
    c = problem.rows.values(x)
    violations = problem.relative_violations(x, c, problem.rows.jacobian(x))
    return float(np.nan_to_num(violations, nan=np.inf).max(initial=0.0))


def find_index_of_wrong_gradient(problem: MaxOfFunctions, x: Array) -> int | None:
    """Index of a function whose given gradient is not its derivative near x."""
    return find_function_with_wrong_gradient(
        problem.values, lambda z: problem.linearise(z).jacobian, x, problem.low, problem.high,
        problem.lengths,
    )  # fmt: skip


def build_wrong_gradient_result(problem: MaxOfFunctions, x: Array, index: int) -> OptimizeResult:
    """The result where a gradient is wrong: no answer, and where it was found out."""
    values = problem.function(x)
    status = "wrong_gradient"
    return build_optimize_result(
        x=x, fun=float(values.max()), values=values, success=False, status=status,
        message=STATUS_MESSAGES[status].format(index), nit=0, nfev=problem.function.count,
        njev=problem.jacobian.count, multipliers=np.full(len(values), 1.0 / len(values)),
        constraint_multipliers=np.zeros(len(problem.lower)), kkt=np.inf, violation=0.0, notes=(),
        history=(),
    )  # fmt: skip


def build_optimize_result(**fields: Any) -> OptimizeResult:
    """A result in SciPy's form."""
    out = OptimizeResult()
    out.update(fields)
    return out
