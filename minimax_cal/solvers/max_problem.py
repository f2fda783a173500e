"""A smooth minimax problem over R^n, in units in which its values are about one."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from minimax_cal.core.arrays import Array
from minimax_cal.core.errors import OptionError
from minimax_cal.solvers.constraint_rows import ConstraintRows
from minimax_cal.solvers.derivatives import (
    CountedFunction,
    CountedJacobian,
    measure_variable_lengths,
)
from minimax_cal.solvers.linearisation import (
    FunctionsAndConstraints,
    Linearisation,
    constraint_excess,
)

ROW_SIZE_SHARE_OF_REACH = (
    1e-6  # of what a row's variables could reach: so much of its size is always there
)
MAX_CANCELLING_TERMS_RATIO = 1e2  # times the sum of terms: so much of terms that cancel counts
EPS = float(np.finfo(float).eps)
SMALLEST_NORMAL = float(np.finfo(float).tiny)


def empty_curvature(weights: Array) -> Array:
    """The curvature of functions that only BFGS can estimate: an empty matrix."""
    return np.zeros((0, 0))


@dataclass(frozen=True, eq=False)
class MaxOfFunctions:
    """min over x of max_i f_i(x), as `solvers.minimax` takes it.

    function, jacobian: of the caller.  rows: bounds and constraints.
    low, high: (n,) bounds of the variables, infinite where open.
    exponent: values are divided by 2 to this power, exactly.
    lengths: (n,) over which a variable alone changes the functions by their size.
    first_lengths: (n,) those at the start.
    """

    function: CountedFunction
    jacobian: CountedJacobian
    rows: ConstraintRows
    low: Array
    high: Array
    exponent: int
    lengths: Array
    first_lengths: Array

    @staticmethod
    def from_functions(
        x: Array, function: CountedFunction, scheme: Any, bounds: Any, constraints: Any
    ) -> MaxOfFunctions:
        """The problem as it is at x.  Raises OptionError where values or gradients do not fit."""
        low, high = (np.full(len(x), end) if bounds is None else
                     np.broadcast_to(side, len(x)).astype(float)
                     for end, side in ((-np.inf, getattr(bounds, "lb", 0)),
                                       (np.inf, getattr(bounds, "ub", 0))))  # fmt: skip
        values = function(x)
        if values.ndim != 1 or not np.all(np.isfinite(values)):
            raise OptionError("minimize_max: fun(x0) must be a vector of finite numbers")
        if not len(values):
            raise OptionError("minimize_max: fun(x0) is empty; give at least one function")
        level = float(np.abs(values).max()) or 1.0
        lengths = measure_variable_lengths(
            function, x, low, high, level, np.where(x, np.abs(x), 1.0)
        )
        jacobian = CountedJacobian(function, scheme, lengths)
        slopes = jacobian(x)
        if slopes.shape != (len(values), len(x)):
            raise OptionError(
                f"minimize_max: jac(x0) has shape {slopes.shape}; {len(values)} functions of "
                f"{len(x)} variables need {(len(values), len(x))}"
            )
        rows = ConstraintRows.from_scipy_constraints(x, lengths, bounds, constraints)
        return MaxOfFunctions(
            function, jacobian, rows, low, high, int(np.frexp(level)[1]), lengths, lengths
        )

    def with_units_at(self, x: Array) -> MaxOfFunctions:
        """The same problem with the units of values and variables as they are at x."""
        values = self.function(x)
        level = float(abs(values.max())) or float(np.abs(values).max())
        level = max(level or float(np.ldexp(1.0, self.exponent)), SMALLEST_NORMAL)
        lengths = measure_variable_lengths(
            self.function, x, self.low, self.high, level, self.lengths
        )
        self.jacobian.lengths = lengths
        for _, jacobian in self.rows.parts:
            jacobian.lengths = lengths
        return replace(self, exponent=int(np.frexp(level)[1]), lengths=lengths)

    @property
    def lower(self) -> Array:
        """(l,) lower ends of the constraints."""
        return self.rows.lower

    @property
    def upper(self) -> Array:
        """(l,) upper ends of the constraints."""
        return self.rows.upper

    def values(self, x: Array) -> Array:
        """(m,) in the unit of values."""
        values = np.asarray(self.function(x), dtype=float)
        with np.errstate(over="ignore"):
            return np.asarray(np.ldexp(values, -self.exponent))

    def evaluate(self, x: Array) -> FunctionsAndConstraints:
        """f and c."""
        return FunctionsAndConstraints(self.values(x), self.rows.values(x))

    def linearise(self, x: Array) -> Linearisation:
        """f, c and their derivatives; the curvature is left to BFGS."""
        f, c = self.evaluate(x)
        slopes = np.ldexp(self.jacobian(x), -self.exponent)
        return Linearisation(f, slopes, c, self.rows.jacobian(x), empty_curvature)

    def linearise_with_central_differences(self, x: Array) -> Linearisation:
        """The same with central differences in place of forward ones."""
        slopes = np.ldexp(self.jacobian.central_difference_jacobian(x), -self.exponent)
        f, c = self.evaluate(x)
        return Linearisation(
            f, slopes, c, self.rows.central_difference_jacobian(x), empty_curvature
        )

    def step(self, x: Array, d: Array) -> Array:
        """The point moved."""
        return x + d

    def relative_violations(self, x: Array, c: Array, normal: Array) -> Array:
        """(l,) of each constraint, relative to its own terms at x.

        c: (l,) and normal: (l, n), its values and derivatives.  As `qp_backends.accuracy` has it:
        a row whose end is 0 is measured by what its variables reach; terms that cancel count for
        at most MAX_CANCELLING times what is left, else rows that contradict each other would be
        met by an x that is large enough.
        """
        end = np.where(c > self.upper, self.upper, np.where(c < self.lower, self.lower, c))
        reach = np.abs(normal) @ np.minimum(self.lengths, self.first_lengths)
        reach = np.where(end == 0.0, np.abs(normal) @ np.maximum(self.lengths, np.abs(x)), reach)
        left = np.maximum(np.abs(end), np.abs(c))
        size = np.maximum(
            left, np.minimum(np.abs(normal) @ np.abs(x), MAX_CANCELLING_TERMS_RATIO * left)
        )
        size = size + np.where(end == 0.0, 1.0, ROW_SIZE_SHARE_OF_REACH) * reach
        return constraint_excess(c, self.lower, self.upper) / np.where(size > 0.0, size, 1.0)
