"""What a design could reach if experiments could be done in part: weights by convex programming.

    minimise size(C), C^-1 = M = base + sum_j w_j A_j'A_j  s.t.  sum w = n, 0 <= w_j <= 1

With Z >= K'CK as [[M, K], [K', Z]] >= 0 mean variances are linear in Z [Boyd and Vandenberghe 2004,
section 7.5].  cvxpy builds the problem and hands it to a solver; the answer is only ever used as
weights and as the polar that gives the bound (`exchange.floor`), so that a sloppy answer makes the
bound looser, never wrong.  Of many experiments a few are given to the solver; those that score
highest come in next, and the bound holds for all.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
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
    inverse,
    size_of,
)
from minimax_cal.planning.designs.exchange import Menu, floor, polar

cp: Any = import_module("cvxpy")  # it has no types

SOLVERS: dict[str, dict[str, float]] = {  # by cvxpy's name, tried in turn
    "SCS": {"eps_abs": 1e-4, "eps_rel": 1e-4, "max_iters": 1000},
    "CLARABEL": {},
}
# experiments beyond the number to choose that the solver sees at a time
MAX_EXTRA_EXPERIMENTS = 160
WORST = 60  # predictions of `Largest` that it sees at a time
GAP = 3e-3  # relative, between size and bound, at which no more rounds are needed
STALE = 0.8  # of the gap that a round leaves: more, and further ones are in vain
MAX_ROUNDS = 6
NOTHING = 1e-6  # a smaller weight is none


@dataclass(frozen=True, eq=False)
class Relaxed:
    """weights: (c,).  size: with them.  bound: no design of so many experiments is below it.

    scores: (c,) by the polar of the bound: the best designs hold what scores high.
    solver: that was used, "" for none.  rounds: how often.  given: experiments it saw at last.
    """

    weights: Array
    size: float
    bound: float
    scores: Array
    solver: str
    rounds: int
    given: int


def relax(
    menu: Menu,
    criterion: Criterion,
    begin: Array,
    solvers: tuple[str, ...] = tuple(SOLVERS),
    gap: float = GAP,
    rounds: int = MAX_ROUNDS,
) -> Relaxed:
    """The best weights for as many experiments as there are in a design, and a bound.

    begin: (n,) a design of different experiments that tells all unknowns, to start from.
    solvers: of SOLVERS, tried in turn.
    """
    count = len(begin)
    weights = np.bincount(begin, minlength=menu.count).astype(float)
    cov = inverse(menu.information(weights))
    size = float(criterion.size(cov))
    pull = latest = polar(cov, criterion.mix(cov))
    bound, used, done = floor(menu, pull, count), "", 0
    given, posed, found = begin[:0], begin[:0], weights
    for _ in range(rounds):
        support = np.flatnonzero(weights + found > NOTHING)
        newer = union(begin, support, highest(menu.scores(latest), count + MAX_EXTRA_EXPERIMENTS))
        worse = union(posed, minimax_problem(criterion, cov))
        known = np.isin(newer, given).all() and np.isin(worse, posed).all()
        if bound >= size * (1.0 - gap) or known:
            break
        given, posed, before = newer, worse, 1.0 - bound / size
        small = Largest(criterion.weights[posed]) if isinstance(criterion, Largest) else criterion
        found, pulls, name = solved(menu, small, count, given, cov, solvers)
        reached = size_of(criterion, menu.information(found))
        if not (name and np.isfinite(reached)):
            break
        done, used = done + 1, name
        if reached < size:
            size, weights = reached, found
        cov = inverse(menu.information(found))
        for latest in (polar(cov, criterion.mix(cov)), pulls(cov)):
            new = floor(menu, latest, count)
            if new > bound:
                bound, pull = new, latest
        if done > 2 and 1.0 - bound / size > STALE * before:
            break
    return Relaxed(weights, size, min(bound, size), menu.scores(pull), used, done, len(given))


def union(*parts: Array) -> Array:
    """Indices in any of them."""
    return np.unique(np.concatenate(parts))


def minimax_problem(criterion: Criterion, cov: Array) -> Array:
    """The predictions that matter most where the largest counts; none otherwise."""
    if not isinstance(criterion, Largest):
        return np.zeros(0, dtype=int)
    return highest(criterion.each(cov), WORST)


def highest(scores: Array, count: int) -> Array:
    """Indices of the largest scores."""
    return np.argsort(-scores, kind="stable")[:count]


# ---- the convex problem ------------------------------------------------------------------------

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
    solvers: tuple[str, ...],
) -> tuple[Array, Pull, str]:
    """Weights (c,) of the experiments given, their polar, and the solver; "" if none answers.

    cov: of a design like the answer.  In coordinates in which it is 1 the numbers are near 1.
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
    for name in solvers:
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # an inaccurate answer does no harm here
                problem.solve(solver=name, **SOLVERS[name])
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
