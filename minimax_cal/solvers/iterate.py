"""A point of the minimax SQP with its multipliers, scaling and history of progress."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Generic, TypeVar

import numpy as np

from minimax_cal.core.arrays import Array
from minimax_cal.solvers.bfgs import EPS, Bfgs
from minimax_cal.solvers.linearisation import (
    Kkt,
    Linearisation,
    MinimaxProblem,
    Scaling,
    find_constraint_units,
    fit_multipliers_by_least_squares,
    measure_kkt,
)
from minimax_cal.solvers.status import Status

X = TypeVar("X")
NO_MULTIPLIERS: Array = np.zeros(0)

VALUE_ROUNDING = 1e-12  # relative: a fall of the value by less is none
INEXACT_VALUE_ROUNDING = 1e-8  # the same where QP answers are used though they missed the tolerance
MIN_VALUE_LEVEL = float(np.finfo(float).tiny)  # of a value: what is divided by less overflows
RELATIVE_ZERO_VALUE = 1e-12  # of the value at the start: what is as good as zero
MAX_VALUE_GROWTH = 1e32  # times that: a value so large belongs to what falls without end
MIN_VALUE_OF_TERMS = 1e-7  # a value below this share of the terms that make it is known no better
MAX_STALLED_ITERATIONS = 10  # without progress in value or optimality
MAX_DAMPING = 1e8  # of the Hessian's diagonal
NEARLY_OPTIMAL_TOLERANCES = 100.0  # times the tolerance: optimal as far as rounding lets one see
FLAT_CURVATURE = (
    1e-8  # relative, of a direction that has none, for solvers that ask for a definite P
)
WORKING_SET_FUNCTIONS_PER_UNKNOWN = (
    3  # times the unknowns; so many functions make the first QP of more than twice that
)


@dataclass(frozen=True, eq=False)
class StartScales:
    """Scales of a problem at the start.

    lengths: (p,) over which a variable alone changes the functions by their size.
    largest_level: with what changes of the value are compared at most; less than the value where
    that holds a number which is added to all functions.
    """

    lengths: Array
    largest_level: float = np.inf


@dataclass(frozen=True, eq=False)
class PointTerms:
    """What scaling takes from a point alone, whatever the multipliers.

    functions: (k,) and constraints: (l,), the sizes of the terms that values and changes within
    reach are the sums of.  constraint_units: (l,) as `Scaling` has them.
    """

    functions: Array
    constraints: Array
    constraint_units: Array

    @staticmethod
    def measure(
        linearisation: Linearisation, reach: Array, lower: Array, upper: Array
    ) -> PointTerms:
        """Of a linearisation with variables that reach (p,) so far."""
        normal = np.abs(linearisation.normal * reach)
        return PointTerms(
            np.abs(linearisation.f) + np.abs(linearisation.jacobian) @ reach,
            normal.sum(axis=1),
            find_constraint_units(linearisation, normal.max(axis=1, initial=0.0), lower, upper),
        )


@dataclass(frozen=True, eq=False)
class Iterate(Generic[X]):
    """Where the iteration is.

    linearisation: the problem at x.  mu, lam: multipliers of the latest QP.  quasi_newton: the
    Hessian where the problem has none of its own.  displacement: (p,) from the start.  reach: (p,)
    its farthest, at least as far as the start's derivatives suggest.  terms: of the point.
    penalties: (l,) of violations. zero_level: a value that is as good as none.  largest_level: as
    `StartScales` has it. damping: of the Hessian's diagonal.  least_residual, least_value: so far.
    stalled_count: iterations since either fell.  qp_count: QPs so far.
    """

    problem: MinimaxProblem[X]
    x: X
    linearisation: Linearisation
    mu: Array
    lam: Array
    quasi_newton: Bfgs | None
    displacement: Array
    reach: Array
    terms: PointTerms
    penalties: Array
    zero_level: float
    largest_level: float = np.inf
    damping: float = 0.0
    least_residual: float = np.inf
    least_value: float = np.inf
    stalled_count: int = 0
    qp_count: int = 0

    @staticmethod
    def start_at(
        problem: MinimaxProblem[X],
        x: X,
        hessian: str,
        mu: Array,
        scales: StartScales | None = None,
    ) -> Iterate[X]:
        """The first one; without mu all functions share the multipliers evenly.

        hessian: as `Sqp.hessian`.
        """
        here = problem.linearise(x)
        (k, p), none = here.jacobian.shape, np.zeros(len(here.c))
        f, slope = np.abs(here.f), np.abs(here.jacobian)
        level = float(max(abs(here.f.max()), MIN_VALUE_OF_TERMS * f.mean()) or slope.max() or 1.0)
        curvature = level / (scales.lengths if scales else here.descent_lengths(level)) ** 2
        bfgs = Bfgs.from_linearisation(here, curvature)
        reach = np.sqrt(level / np.maximum(curvature, np.diag(bfgs.matrix)))
        return Iterate(
            problem, x, here, mu if len(mu) else np.full(k, 1.0 / k), none,
            None if hessian == "gauss-newton" else bfgs, np.zeros(p), reach,
            PointTerms.measure(here, reach, problem.lower, problem.upper), none,
            RELATIVE_ZERO_VALUE * level, scales.largest_level if scales else np.inf,
        )  # fmt: skip

    @cached_property
    def value_terms(self) -> float:
        """Size of the terms that the value is the sum of; its rounding is relative to them."""
        return float(self.mu @ self.terms.functions + np.abs(self.lam) @ self.terms.constraints)

    @cached_property
    def scaling(self) -> Scaling:
        """Of the value as large as it is, of variables as far as they have gone."""
        size = min(abs(float(self.linearisation.f.max())), self.largest_level)
        zero_level = min(self.zero_level, self.largest_level)
        level = max(size, MIN_VALUE_OF_TERMS * self.value_terms, zero_level, MIN_VALUE_LEVEL)
        return Scaling(level, self.reach, self.terms.constraint_units)

    @property
    def scaled_constraint_multipliers(self) -> Array:
        """(l,) multipliers of the constraints in the scaled problem."""
        return np.asarray(self.lam * self.scaling.c / self.scaling.value)

    @cached_property
    def kkt(self) -> Kkt:
        """How far from optimal, scaled."""
        scaling, problem = self.scaling, self.problem
        kkt = measure_kkt(
            self.linearisation,
            self.mu,
            self.lam,
            problem.lower,
            problem.upper,
            scaling.x,
            scaling.c,
        )
        return replace(
            kkt,
            stationarity=kkt.stationarity / scaling.value,
            complementarity=kkt.complementarity / scaling.value,
        )

    @cached_property
    def descent_lengths(self) -> Array:
        """(p,) how far a variable alone may go until a function has grown by the value's unit."""
        return self.linearisation.descent_lengths(self.scaling.value)

    @cached_property
    def minimal_penalties(self) -> Array:
        """(l,) at which a constraint's unit is worth what the functions can gain by it."""
        scaling = self.scaling
        steepness = float((self.reach / self.descent_lengths).max())
        return np.asarray(scaling.value / scaling.c * steepness)

    @property
    def is_finite(self) -> bool:
        """Whether values and derivatives are numbers, and the value has not grown without end."""
        here = self.linearisation
        numbers = np.all(np.isfinite(here.f)) and np.all(np.isfinite(here.jacobian))
        return bool(numbers) and self.scaling.value <= MAX_VALUE_GROWTH * self.zero_level

    def damped_hessian(self, floor: float) -> Array:
        """(p, p) of the Lagrangian, its diagonal raised by the damping.  floor: as `Sqp.floor`."""
        if self.quasi_newton is None:
            matrix = self.linearisation.curvature(np.maximum(self.mu, floor / len(self.mu)))
        else:
            matrix = self.quasi_newton.matrix
        if not self.damping:
            return matrix
        with np.errstate(over="ignore"):
            least = FLAT_CURVATURE * np.diag(self.scaling.value / self.descent_lengths**2)
        return np.asarray(matrix + self.damping * np.maximum(np.diag(np.diag(matrix)), least))

    def select_largest_functions(self, here: Linearisation) -> Array:
        """Functions that may be the largest after a step: all, or of many the largest now."""
        k, p = here.jacobian.shape
        count = WORKING_SET_FUNCTIONS_PER_UNKNOWN * p
        if k <= 2 * count:
            return np.arange(k)
        large = here.f >= np.partition(here.f, k - count)[k - count]
        return np.flatnonzero(large | (self.mu > 0.0) if self.qp_count else large)

    def update_after_qp(
        self, mu: Array, lam: Array, penalties: Array, is_exact: bool
    ) -> Iterate[X]:
        """The same point with the multipliers of a QP, one more iteration counted.

        is_exact: whether the QP's answer kept its tolerance.
        """
        at = replace(self, mu=mu, lam=lam, penalties=penalties, qp_count=self.qp_count + 1)
        value, residual = float(self.linearisation.f.max()), at.kkt.residual
        rounding = VALUE_ROUNDING if is_exact else INEXACT_VALUE_ROUNDING
        is_nearer = is_exact and residual < 0.9 * self.least_residual
        if is_nearer or value < self.least_value - rounding * abs(self.least_value):
            least = min(self.least_residual, residual)
            return replace(at, least_residual=least, least_value=value, stalled_count=0)
        return replace(at, stalled_count=self.stalled_count + 1)

    def with_fitted_multipliers(self) -> Iterate[X]:
        """The same point with multipliers that balance the gradients here best, of no QP."""
        scaling, rows = self.scaling, self.select_largest_functions(self.linearisation)
        some, mu = scaling.apply(self.linearisation).take_functions(rows), np.zeros(len(self.mu))
        low, high = self.problem.lower / scaling.c, self.problem.upper / scaling.c
        mu[rows], lam = fit_multipliers_by_least_squares(some, low, high)
        return replace(self, mu=mu, lam=lam * scaling.value / scaling.c)

    def relative_decrease_bound(self) -> float:
        """By how much of itself the value may still fall, to first order, within the units."""
        here = self.scaling.apply(self.linearisation)
        slopes = np.abs(self.mu @ here.jacobian + self.scaled_constraint_multipliers @ here.normal)
        return float(slopes.sum()) + self.kkt.complementarity

    def is_nearly_optimal(self, tolerance: float) -> bool:
        """Whether what is offered is the rounding of the value, or of that at the start."""
        kkt, start = self.kkt, self.zero_level / RELATIVE_ZERO_VALUE
        offered = max(kkt.stationarity, kkt.complementarity) * self.scaling.value
        is_rounding = offered <= EPS * start and kkt.violation <= tolerance
        return is_rounding or kkt.residual <= NEARLY_OPTIMAL_TOLERANCES * tolerance

    def status_before_step(self, tolerance: float, is_exact: bool = True) -> Status | None:
        """How it ends here, if it is optimal or nothing has become better for long.

        is_exact: whether QPs are solved to a tolerance; else a violation may be there to stay.
        """
        if self.kkt.residual <= tolerance:
            return Status.CONVERGED
        is_stalled = self.stalled_count >= MAX_STALLED_ITERATIONS
        if is_stalled and (self.kkt.violation <= tolerance or not is_exact):
            return Status.STALLED
        return None

    def after_step(self, d: Array, x: X, there: Linearisation) -> Iterate[X]:
        """At the end x of a step d (p,), less damped."""
        quasi_newton = self.quasi_newton and self.quasi_newton.update(
            d, self.linearisation, there, self.mu, self.lam
        )
        displacement = self.displacement + d
        reach = np.maximum(self.reach, np.abs(displacement))
        return replace(
            self, x=x, linearisation=there, quasi_newton=quasi_newton,
            damping=self.damping / 10.0 if self.damping > 1e-6 else 0.0,
            displacement=displacement, reach=reach,
            terms=PointTerms.measure(there, reach, self.problem.lower, self.problem.upper),
        )  # fmt: skip

    def with_more_damping(self) -> Iterate[X]:
        """The same point, more damped, since no step led on."""
        return replace(self, damping=max(10.0 * self.damping, 1e-3))

    def status_after_step(self, tolerance: float, is_exact: bool = True) -> Status | None:
        """How it ends after a step, if the point is optimal or no damping helps any more."""
        if self.kkt.residual <= tolerance:
            return Status.CONVERGED
        if self.damping > MAX_DAMPING:
            is_infeasible = is_exact and self.kkt.violation > tolerance
            return Status.INFEASIBLE if is_infeasible else Status.STALLED
        return None
