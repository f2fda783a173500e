"""A minimax problem at a point: values, derivatives, scaling and the optimality conditions.

min over x of  max_i f_i(x)   subject to   lower <= c(x) <= upper
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple, Protocol, TypeVar

import numpy as np

from minimax_cal.core.arrays import Array

X = TypeVar("X")
MULTIPLIER_SUM_WEIGHT = 1e3  # of the row that holds the sum of the multipliers: kept to a millionth


@dataclass(frozen=True, eq=False)
class Linearisation:
    """Values and first derivatives at a point.

    f: (k,).  jacobian: (k, p) of f.  c: (l,).  normal: (l, p) of c.
    curvature: from weights (k,) to the weighted sum of the f_i's second derivatives (p, p), or to
    an empty matrix where only BFGS can estimate them.
    """

    f: Array
    jacobian: Array
    c: Array
    normal: Array
    curvature: Callable[[Array], Array]

    def take_functions(self, rows: Array) -> Linearisation:
        """Some of the functions; the curvature is that of all."""
        return replace(self, f=self.f[rows], jacobian=self.jacobian[rows])

    def descent_lengths(self, level: float) -> Array:
        """(p,) how far a variable alone may go until a function is above the largest by level.

        By the derivatives here; 1 where no function depends on it.
        """
        room = level + self.f.max() - self.f
        steepest = np.abs(self.jacobian / room[:, None]).max(axis=0)
        return np.asarray(1.0 / np.where(steepest > 0.0, steepest, 1.0))


class FunctionsAndConstraints(NamedTuple):
    """Values of the functions (k,) and of the constraints (l,)."""

    f: Array
    c: Array


class MinimaxProblem(Protocol[X]):
    """A smooth max-of-functions problem with two-sided constraints."""

    @property
    def lower(self) -> Array:
        """(l,) -inf where open."""

    @property
    def upper(self) -> Array:
        """(l,) inf where open."""

    def evaluate(self, x: X) -> FunctionsAndConstraints:
        """f (k,) and c (l,)."""

    def linearise(self, x: X) -> Linearisation:
        """f, c and their derivatives."""

    def step(self, x: X, d: Array) -> X:
        """The point moved by d (p,)."""


@dataclass(frozen=True, eq=False)
class Scaling:
    """Units in which a problem is about one: of the value, the variables (p,), constraints (l,)."""

    value: float
    x: Array
    c: Array

    @staticmethod
    def from_lengths(
        linearisation: Linearisation, value: float, lengths: Array, lower: Array, upper: Array
    ) -> Scaling:
        """A constraint's is its way to a bound, at least how much it changes along a variable's."""
        change = np.abs(linearisation.normal * lengths).max(axis=1, initial=0.0)
        return Scaling(value, lengths, find_constraint_units(linearisation, change, lower, upper))

    def apply(self, linearisation: Linearisation) -> Linearisation:
        """A linearisation in these units."""
        return replace(
            linearisation,
            f=linearisation.f / self.value,
            jacobian=linearisation.jacobian * (self.x / self.value),
            c=linearisation.c / self.c,
            normal=linearisation.normal * (self.x / self.c[:, None]),
        )


def find_constraint_units(
    linearisation: Linearisation, change: Array, lower: Array, upper: Array
) -> Array:
    """(l,) ways of constraints to their bounds, at least a change (l,) of theirs; 1 for none."""
    way = np.minimum(np.abs(upper - linearisation.c), np.abs(linearisation.c - lower))
    units = np.maximum(change, np.where(np.isfinite(way), way, 0.0))
    return np.where(units > 0.0, units, 1.0)


@dataclass(frozen=True)
class Kkt:
    """How far from optimal: all three are zero at a Karush-Kuhn-Tucker point.

    stationarity: largest entry of sum mu_i f_i' + sum lambda_l c_l'.
    complementarity: sum mu_i (max f - f_i) + sum |lambda_l| (distance of c_l to its bound).
    violation: largest violation of a constraint.

    In a `Scaling`.  By duality of linear programs the linearised problem then offers no more,
    within a box of the variables' units, than complementarity + sum of stationarity.
    """

    stationarity: float
    complementarity: float
    violation: float

    @property
    def residual(self) -> float:
        """The largest of the three."""
        return max(self.stationarity, self.complementarity, self.violation)


def measure_kkt(
    linearisation: Linearisation,
    mu: Array,
    lam: Array,
    lower: Array,
    upper: Array,
    lengths: Array | float = 1.0,
    constraint_units: Array | float = 1.0,
) -> Kkt:
    """The KKT residuals at a point, for multipliers mu (k,) of sum one and lam (l,).

    lengths: (p,) of the variables, for stationarity.  constraint_units: (l,), for violation.
    """
    stationarity = (mu @ linearisation.jacobian + lam @ linearisation.normal) * lengths
    complementarity = float(mu @ (linearisation.f.max() - linearisation.f))
    if lam.any():
        held = np.flatnonzero(lam)  # elsewhere a bound may be infinitely far
        room = np.where(lam > 0.0, upper - linearisation.c, linearisation.c - lower)[held]
        complementarity += float(np.abs(lam[held] * room).sum())
    violation = 0.0
    if len(lam):
        violation = float(
            (constraint_excess(linearisation.c, lower, upper) / constraint_units).max()
        )
    return Kkt(float(np.abs(stationarity).max(initial=0.0)), complementarity, violation)


class Multipliers(NamedTuple):
    """Multipliers of the functions (k,), which sum to one, and of the constraints (l,)."""

    mu: Array
    lam: Array


def fit_multipliers_by_least_squares(
    linearisation: Linearisation, lower: Array, upper: Array
) -> Multipliers:
    """mu and lam that make stationarity and complementarity at a point least, mu of sum one.

    Non-negative least squares, so that nothing of a QP solver is in them.
    """
    from scipy.optimize import nnls

    k, (above, below) = (
        len(linearisation.f),
        (np.flatnonzero(upper < np.inf), np.flatnonzero(lower > -np.inf)),
    )
    columns = np.concatenate(
        [linearisation.jacobian, linearisation.normal[above], -linearisation.normal[below]]
    ).T
    if not np.all(np.isfinite(columns)):
        return Multipliers(np.full(k, 1.0 / k), np.zeros(len(linearisation.c)))
    rooms = (
        linearisation.f.max() - linearisation.f,
        (upper - linearisation.c)[above],
        (linearisation.c - lower)[below],
    )
    room = np.maximum(np.concatenate(rooms), 0.0)
    sum_row = MULTIPLIER_SUM_WEIGHT * (np.arange(len(room)) < k)
    found, _ = nnls(
        np.vstack([columns, np.diag(room), sum_row]),
        np.append(np.zeros(len(columns) + len(room)), MULTIPLIER_SUM_WEIGHT),
    )
    found = found / found[:k].sum()
    lam = np.zeros(len(linearisation.c))
    lam[above] += found[k : k + len(above)]
    lam[below] -= found[k + len(above) :]
    return Multipliers(found[:k], lam)


def constraint_excess(c: Array, lower: Array, upper: Array) -> Array:
    """(l,) by how much each constraint is violated."""
    return np.asarray(np.maximum(np.maximum(c - upper, lower - c), 0.0))
