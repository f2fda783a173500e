"""The convex problem of a relaxation as cvxpy builds it; cvxpy takes half a second to import."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from importlib import import_module
from typing import Any

import numpy as np

from minimax_cal.ground.arrays import Array
from minimax_cal.planning.designs.criteria import (
    Criterion,
    Determinant,
    Eigenvalue,
    Largest,
    Trace,
)
from minimax_cal.planning.designs.exchange import Menu, polar

cp: Any = import_module("cvxpy")  # it has no types

Pull = Callable[[Array], Array]  # the polar at a covariance (f, f), by the solver's multipliers


@dataclass(frozen=True, eq=False)
class Form:
    """What to minimise, under what, and the polar that the answer gives."""

    objective: Any
    constraints: list[Any]
    pull: Pull


def solved(
    menu: Menu,
    criterion: Criterion,
    count: int,
    given: Array,
    cov: Array,
    solvers: Mapping[str, Mapping[str, float]],
) -> tuple[Array, Pull, str]:
    """Weights (c,) of the experiments given, their polar, and the solver; "" if none answers.

    cov: of a design like the answer.  In coordinates in which it is 1 the numbers are near 1.
    solvers: by cvxpy's name, with their settings, tried in turn.
    """
    back = np.linalg.cholesky(cov).T  # C = back' back, so that C^-1 becomes 1
    turned = menu.rows[given] @ back.T
    each = (np.swapaxes(turned, 1, 2) @ turned).reshape(len(given), -1)
    share = cp.Variable(len(given), nonneg=True)
    f = menu.unknowns
    info = cp.reshape(each.T @ share, (f, f), order="C") + back @ menu.base @ back.T
    info = 0.5 * (info + info.T)
    form = FORMS[type(criterion)](info, criterion, back, cov)
    whole = [cp.sum(share) == count, share <= 1.0]
    problem = cp.Problem(form.objective, [*form.constraints, *whole])
    for name, settings in solvers.items():
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # an inaccurate answer does no harm here
                problem.solve(solver=name, **settings)
        except cp.SolverError:
            continue
        if share.value is not None and np.isfinite(share.value).all():
            weights = np.zeros(menu.count)
            weights[given] = capped(np.asarray(share.value), count)
            return weights, form.pull, name
    return np.zeros(menu.count), form.pull, ""


def capped(weights: Array, count: int) -> Array:
    """The weights shifted until they lie in [0, 1] and sum to count: a projection on both."""
    low, high = weights.min() - 1.0, weights.max()
    for _ in range(60):
        middle = 0.5 * (low + high)
        if np.clip(weights - middle, 0.0, 1.0).sum() > count:
            low = middle
        else:
            high = middle
    return np.asarray(np.clip(weights - high, 0.0, 1.0))


def schur(info: Any, sides: Array) -> tuple[Any, Any]:
    """Z >= K' M^-1 K and the constraint that says so.  sides: K (f, s)."""
    s = sides.shape[1]
    z = cp.Variable((s, s), symmetric=True)
    return z, cp.bmat([[info, sides], [sides.T, z]]) >> 0


def by_determinant(info: Any, criterion: Determinant, back: Array, cov: Array) -> Form:
    """log det M as large as possible."""
    return Form(cp.Maximize(cp.log_det(info)), [], lambda c: polar(c, criterion.mix(c)))


def by_trace(info: Any, criterion: Trace, back: Array, cov: Array) -> Form:
    """tr Z, with K K' = W."""
    values, axes = np.linalg.eigh(back @ criterion.weight @ back.T)
    kept = values > 1e-12 * values[-1]
    z, above = schur(info, axes[:, kept] * np.sqrt(values[kept] / values.sum()))
    return Form(cp.Minimize(cp.trace(z)), [above], lambda c: polar(c, criterion.weight))


def by_largest(info: Any, criterion: Largest, back: Array, cov: Array) -> Form:
    """t >= tr(Z W_g) for all g; the multipliers say how much each of them counts."""
    z, above = schur(info, np.eye(len(cov)))
    largest = cp.Variable()
    flat = back @ criterion.weights @ back.T / criterion.size(cov)
    flat = flat.reshape(len(criterion.weights), -1)
    binding = flat @ cp.reshape(z, (len(cov) ** 2,), order="C") <= largest

    def pull(c: Array) -> Array:
        share = np.maximum(np.nan_to_num(np.asarray(binding.dual_value, dtype=float)), 0.0)
        if not share.sum() > 0.0:
            return polar(c, criterion.mix(c))
        return polar(c, np.tensordot(share / share.sum(), criterion.weights, 1))

    return Form(cp.Minimize(largest), [above, binding], pull)


def by_eigenvalue(info: Any, criterion: Eigenvalue, back: Array, cov: Array) -> Form:
    """M >= t; the multiplier Y says which axes count: lambda_min(M) <= <Y, M> where tr Y = 1."""
    least = cp.Variable()
    unit = back @ back.T
    above = info - least * unit / np.linalg.eigvalsh(unit)[-1] >> 0

    def pull(c: Array) -> Array:
        values, axes = np.linalg.eigh(back.T @ np.asarray(above.dual_value, dtype=float) @ back)
        values = np.maximum(values, 0.0)
        if not values.sum() > 0.0:
            return polar(c, criterion.mix(c))
        return np.asarray((axes * (values / values.sum())) @ axes.T)

    return Form(cp.Maximize(least), [above], pull)


FORMS: dict[type, Callable[..., Form]] = {
    Determinant: by_determinant,
    Trace: by_trace,
    Largest: by_largest,
    Eigenvalue: by_eigenvalue,
}
