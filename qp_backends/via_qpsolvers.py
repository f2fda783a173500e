"""Any solver that qpsolvers offers, each with data, settings and warm start as it likes them."""

from __future__ import annotations

import time
import warnings
from collections.abc import Mapping
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
import qpsolvers
from scipy import sparse

from . import child
from .problem import COLD, EMPTY, BackendError, Solution, Status, dense
from .quiet import ungreeted
from .rows import Rows, multipliers, parts, split
from .scaling import in_good_units
from .traits import TRAITS, Trait, reason, settings

if TYPE_CHECKING:
    from .problem import Problem

LARGEST_DENSE = 30_000_000  # entries of P and A that a dense solver is given, 240 MB


def solve(
    problem: Problem,
    *,
    method: str,
    tolerance: float = 1e-8,
    time_limit: float = np.inf,
    warm_start: Solution = COLD,
) -> Solution:
    """The answer of one solver of qpsolvers as the solver gives it, not yet judged."""
    start = time.perf_counter()
    trait = TRAITS.get(method, Trait())
    pace = trait.sparse_pace if problem.has_sparse else trait.pace
    watched = trait.clock and trait.storage != "dense"  # what DAQP does first has no clock
    if not watched and time_limit < pace * sum(problem.A.shape) ** 3:
        return child.run(__name__, problem, method, tolerance, time_limit, warm_start)
    if trait.shortest and problem.row_norm.min(initial=1.0) < trait.shortest:
        run = partial(solve, method=method, tolerance=tolerance, time_limit=time_limit)
        return in_good_units(run)(problem, warm_start=warm_start)
    rows = split(problem, trait.box)
    chosen = settings(method, tolerance, time_limit)
    given = warm_start.x.size == problem.q.size and bool(np.isfinite(warm_start.x).all())
    if warm := bool(trait.warm) and given:
        chosen |= _warm(trait, rows, warm_start, problem)
    qp = _model(problem, rows, trait)
    if trait.definite:
        raw = _definite(qp, method, chosen, tolerance, start + time_limit)
    else:
        raw = _run(qp, method, chosen)
        left = start + time_limit - time.perf_counter()
        if not raw.found and trait.rescue and left > 0:
            raw = _run(qp, method, settings(method, tolerance, left) | dict(trait.rescue))
    return _answer(problem, rows, raw, method, start, warm)


def _model(problem: Problem, rows: Rows, trait: Trait) -> qpsolvers.Problem:
    """The problem in the form of qpsolvers."""
    if trait.storage == "sparse" or (trait.storage == "either" and problem.has_sparse):
        stored: Any = sparse.csc_matrix
    else:
        if problem.has_sparse and problem.q.size * sum(problem.A.shape) > LARGEST_DENSE:
            raise BackendError("too large for a solver that works on dense matrices")
        stored = dense
    G, h = (stored(rows.G), rows.h) if rows.h.size else (None, None)
    E, b = (stored(rows.E), rows.b) if rows.b.size else (None, None)
    lower, upper = (rows.box[0].lower, rows.box[0].upper) if rows.box else (None, None)
    if G is None and E is None and not rows.box:  # qpsolvers would leave this to LSQR
        G, h = stored(np.zeros((1, problem.q.size))), np.ones(1)
    return qpsolvers.Problem(stored(problem.P), problem.q, G, h, E, b, lower, upper)


def _warm(trait: Trait, rows: Rows, guess: Solution, problem: Problem) -> dict[str, Any]:
    """The settings that hand over a warm start: x as `initvals`, and what more a solver takes."""
    size = problem.q.size
    if trait.warm == "x" or guess.y.size != problem.l.size or not np.isfinite(guess.y).all():
        return {"initvals": guess.x}
    z, y, bounds = parts(rows, guess.y, size)
    if trait.warm == "dual":
        dual = np.concatenate([bounds[: size * len(rows.box)], z, y])
        return {"initvals": guess.x, "dual_start": dual}
    return {"initvals": guess.x, "y": y, "z": np.concatenate([z, bounds[: size * len(rows.box)]])}


def _run(qp: qpsolvers.Problem, method: str, chosen: dict[str, Any]) -> Any:
    """One call of the solver, its warnings silenced: the judge looks at the answer anyway."""
    with warnings.catch_warnings(), ungreeted(method):
        warnings.simplefilter("ignore")
        return qpsolvers.solve_problem(qp, method, **chosen)


def _definite(qp: Any, method: str, chosen: dict[str, Any], tolerance: float, until: float) -> Any:
    """The answer of a solver that wants P positive definite, by the proximal point method.

    Where P is singular, x is the limit of x ← argmin of the problem with ρ/2 ‖x' - x‖² added: each
    of these is strictly convex, and at the limit the addition is gone [Rockafellar 1976].
    """
    size = float(qp.P.diagonal().max(initial=0.0)) or 1.0
    if not 1e-4 < size < 1e4:  # quadprog's own tolerances are absolute
        qp.P, qp.q = qp.P / size, qp.q / size
        raw = _definite(qp, method, chosen, tolerance, until)
        raw.y, raw.z = (part if part is None else size * part for part in (raw.y, raw.z))
        return raw
    try:
        return _run(qp, method, chosen)
    except (ValueError, qpsolvers.ProblemError):
        pass
    P, q = qp.P, qp.q
    rho = 1e-7 * size
    x = np.zeros_like(q)
    qp.P = P + rho * np.eye(q.size)
    for _ in range(50):
        qp.q = q - rho * x
        raw = _run(qp, method, chosen)
        if not raw.found:
            break
        step, x = float(np.abs(raw.x - x).max()), raw.x
        gradient = max(float(np.abs(P @ x).max()), float(np.abs(q).max()))
        if rho * step <= 0.1 * tolerance * gradient or time.perf_counter() > until:
            break
    return raw


def _answer(
    problem: Problem, rows: Rows, raw: Any, method: str, start: float, warm: bool
) -> Solution:
    """A solution of qpsolvers in our terms.  start: when the solve began [s]."""
    info = raw.extras.get("info", raw.extras)
    status = Status.SOLVED if raw.found else reason(str(_told(info, "status", "")))
    if method == "quadprog" and not raw.found:  # it stops early for no other reason
        status = Status.INFEASIBLE
    if raw.x is None:
        x, y = np.full(problem.q.shape, np.nan), np.full(problem.l.shape, np.nan)
    else:
        parts_found = (raw.z, raw.y, raw.z_box)
        z, equal, bounds = (EMPTY if part is None else np.asarray(part) for part in parts_found)
        x = np.asarray(raw.x, dtype=np.float64)
        y = multipliers(rows, problem.l.size, z[: rows.h.size], equal, bounds)
    steps = _told(info, "iter", 0)
    count = int(steps) if isinstance(steps, (int, np.integer)) else 0
    seconds = time.perf_counter() - start
    return Solution(x, y, status, seconds, method, iterations=count, warm=warm)


def _told(info: Any, name: str, default: object) -> object:
    """What a solver tells about a run under this name; some use a dictionary, some an object."""
    return info.get(name, default) if isinstance(info, Mapping) else getattr(info, name, default)
