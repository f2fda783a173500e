"""Bounds and constraints in SciPy's forms as one function c(x) with lower <= c(x) <= upper."""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from scipy.optimize import Bounds, LinearConstraint, NonlinearConstraint

from minimax_cal.core.arrays import Array
from minimax_cal.core.errors import OptionError
from minimax_cal.solvers.derivatives import (
    EPS,
    CountedFunction,
    CountedJacobian,
    Function,
    to_dense_matrix,
)

Constraint = LinearConstraint | NonlinearConstraint


@dataclass(frozen=True, eq=False)
class ConstraintRows:
    """Rows c(x) between lower (l,) and upper (l,), -inf and inf where open.

    linear: (k, n) matrix of the first k rows: bounds, then linear constraints.
    bound_count: how many of them are bounds.
    parts: the nonlinear constraints, each with its derivative.
    """

    linear: Array
    bound_count: int
    parts: tuple[tuple[Function, CountedJacobian], ...]
    lower: Array
    upper: Array

    @staticmethod
    def from_scipy_constraints(
        x: Array, lengths: Array, bounds: Bounds | None, constraints: Sequence[Any]
    ) -> ConstraintRows:
        """Of variables at x (n,) with lengths (n,).

        constraints: scipy.optimize's LinearConstraint, NonlinearConstraint or dictionaries.
        Raises OptionError where sizes or a kind do not fit.
        """
        n = len(x)
        blocks = [] if bounds is None else [bounds_to_linear_rows(bounds, n)]
        bound_count = sum(len(matrix) for matrix, _, _ in blocks)
        parts, ends = [], []
        for given in constraints:
            constraint = convert_dictionary_constraint(given)
            if isinstance(constraint, LinearConstraint):
                blocks.append(constraint_to_linear_rows(constraint, n))
            elif isinstance(constraint, NonlinearConstraint):
                function = CountedFunction(constraint.fun)
                kind = constraint.jac
                kind = kind if callable(kind) or kind in ("cs", "3-point") else "2-point"
                parts.append((function, CountedJacobian(function, kind, lengths)))
                values = function(x)
                if not np.all(np.isfinite(values)):
                    raise OptionError("minimize_max: a constraint at x0 is no finite number")
                ends.append(broadcast_constraint_ends(constraint, len(values)))
            else:
                raise OptionError(
                    "minimize_max: constraints are scipy.optimize's LinearConstraint and "
                    f"NonlinearConstraint, not {type(constraint).__name__}"
                )
        sides = [(low, high) for _, low, high in blocks] + ends
        lower, upper = (np.concatenate([np.zeros(0), *side]) for side in zip(*sides, strict=True)
                        ) if sides else (np.zeros(0), np.zeros(0))  # fmt: skip
        if np.any(lower > upper):
            raise OptionError("minimize_max: a lower bound is above its upper bound")
        matrix = np.concatenate([np.zeros((0, n)), *(matrix for matrix, _, _ in blocks)])
        return ConstraintRows(matrix, bound_count, tuple(parts), lower, upper)

    def values(self, x: Array) -> Array:
        """c(x): (l,)."""
        return np.concatenate([self.linear @ x, *(function(x) for function, _ in self.parts)])

    def jacobian(self, x: Array) -> Array:
        """c'(x): (l, n)."""
        return np.concatenate([self.linear, *(jacobian(x) for _, jacobian in self.parts)])

    def central_difference_jacobian(self, x: Array) -> Array:
        """c'(x): (l, n), by central differences in place of forward ones."""
        return np.concatenate(
            [self.linear, *(jacobian.central_difference_jacobian(x) for _, jacobian in self.parts)]
        )

    def relative_derivative_rounding(self, x: Array) -> Array:
        """(l,) relative error of each row's derivative."""
        linear = np.full(len(self.linear), EPS)
        curved = (np.full(len(fun(x)), jacobian.relative_rounding) for fun, jacobian in self.parts)
        return np.concatenate([linear, *curved])

    def bound_rows(self) -> ConstraintRows:
        """The bounds alone."""
        k = self.bound_count
        return ConstraintRows(self.linear[:k], k, (), self.lower[:k], self.upper[:k])


def convert_dictionary_constraint(constraint: Any) -> Any:
    """A constraint as it is, or of a dictionary of type, fun, jac, args.  Raises OptionError."""
    if not isinstance(constraint, Mapping):
        return constraint
    kind, fun, jac = (
        str(constraint.get("type")).lower(),
        constraint.get("fun"),
        constraint.get("jac"),
    )
    if kind not in ("eq", "ineq") or not callable(fun):
        raise OptionError(
            "minimize_max: constraints are scipy.optimize's, or dictionaries of type 'eq' or "
            f"'ineq', fun, jac and args, not dict of {', '.join(map(str, constraint)) or 'nothing'}"
        )
    args, upper = constraint.get("args", ()), 0.0 if kind == "eq" else np.inf
    args = args if isinstance(args, tuple) else (args,)
    if jac is True:
        fun, jac = split_function_with_jacobian(fun)
    slopes: Any = (lambda x: jac(x, *args)) if callable(jac) else jac or "2-point"
    return NonlinearConstraint(lambda x: fun(x, *args), 0.0, upper, jac=slopes)


class SplitFunction(NamedTuple):
    """Values and derivative of a function as two functions of the same arguments."""

    values: Callable[..., Any]
    jacobian: Callable[..., Any]


def split_function_with_jacobian(
    fun: Callable[..., Any],
) -> SplitFunction:
    """Values and derivative of a function that returns both, which is asked once a place."""
    last: list[Any] = [None, None]

    def evaluate_both(x: Array, *args: Any) -> Any:
        if last[0] != (place := x.tobytes()):
            found = fun(x, *args)
            if not (isinstance(found, tuple) and len(found) == 2):
                raise OptionError("minimize_max: jac=True: fun is to return values and derivative")
            last[:] = place, copy.deepcopy(found)
        return last[1]

    return SplitFunction(
        lambda x, *args: evaluate_both(x, *args)[0],
        lambda x, *args: evaluate_both(x, *args)[1],
    )


def convert_to_scipy_bounds(bounds: Any, variable_count: int) -> Bounds | None:
    """SciPy's Bounds of n variables, from pairs too, None where open.  Raises OptionError."""
    if bounds is None or isinstance(bounds, Bounds):
        return bounds
    try:
        ends = [(-np.inf if low is None else low, np.inf if high is None else high)
                for low, high in bounds]  # fmt: skip
        low, high = np.array(ends, dtype=float).reshape(variable_count, 2).T
    except (TypeError, ValueError):
        raise OptionError(
            f"minimize_max: bounds: give {variable_count} pairs (low, high), or Bounds"
        ) from None
    return Bounds(low, high)


class LinearRows(NamedTuple):
    """Rows lower <= matrix @ x <= upper."""

    matrix: Array
    lower: Array
    upper: Array


def bounds_to_linear_rows(bounds: Bounds, variable_count: int) -> LinearRows:
    """Matrix, lower and upper side of the bounds that are not open."""
    low, high = (
        np.broadcast_to(side, variable_count).astype(float) for side in (bounds.lb, bounds.ub)
    )
    closed = np.isfinite(low) | np.isfinite(high)
    return LinearRows(np.eye(variable_count)[closed], low[closed], high[closed])


def constraint_to_linear_rows(constraint: LinearConstraint, variable_count: int) -> LinearRows:
    """Matrix, lower and upper side.  Raises OptionError where the matrix does not fit x."""
    matrix = to_dense_matrix(constraint.A)
    if matrix.shape[1] != variable_count:
        raise OptionError(
            f"minimize_max: a LinearConstraint has {matrix.shape[1]}"
            f" columns, x has {variable_count}"
        )
    return LinearRows(matrix, *broadcast_constraint_ends(constraint, len(matrix)))


class LinearRowEnds(NamedTuple):
    """(l,) lower and upper end of each row."""

    lower: Array
    upper: Array


def broadcast_constraint_ends(constraint: Any, row_count: int) -> LinearRowEnds:
    """Lower and upper end of each row, from scalars or vectors.  Raises OptionError."""
    try:
        low, high = (
            np.broadcast_to(np.asarray(end, dtype=float), row_count).copy()
            for end in (constraint.lb, constraint.ub)
        )
    except ValueError:
        raise OptionError(
            f"minimize_max: a {type(constraint).__name__} of {row_count} rows has "
            f"{np.size(constraint.lb)} lower and {np.size(constraint.ub)} upper ends; give one, "
            "or one a row"
        ) from None
    if np.isnan(low).any() or np.isnan(high).any():
        raise OptionError("minimize_max: an end of a constraint is NaN; open is -inf or inf")
    return LinearRowEnds(low, high)
