"""Any QP solver that cvxpy offers, through its own modelling: a reference, not an inner loop."""

from __future__ import annotations

import math
import time
import warnings
from dataclasses import dataclass
from functools import lru_cache
from importlib import import_module
from threading import Lock
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy import sparse

from .problem import COLD, EMPTY, BackendError, Solution, Status, nothing
from .quiet import ungreeted
from .rows import multipliers, split
from .traits import TRAITS, Trait, reason, settings

if TYPE_CHECKING:
    from .problem import Array, Matrix, Problem
    from .rows import Rows

cp: Any = import_module("cvxpy")  # it has no types
LARGEST_COMPILED = 40_000  # entries of P and A up to which compiling a model with parameters pays
LINEAR_ONLY = ("SCIPY", "GLPK", "GLPK_MI", "CBC", "PDLP")
_lock = Lock()  # a compiled model is shared, and is not to be solved twice at a time


@dataclass(frozen=True, eq=False)
class Model:
    """A cvxpy problem ½‖Fx‖² + qᵀx with Gx ≤ h, Ex = b, and its parts.

    data: F, q, G, h, E, b by name, as far as it has them: parameters or constants.
    """

    problem: Any
    x: Any
    rows: Any
    equal: Any
    data: dict[str, Any]


def solve(
    problem: Problem,
    *,
    method: str = "",
    tolerance: float = 1e-8,
    time_limit: float = math.inf,
    warm_start: Solution = COLD,
) -> Solution:
    """The answer of cvxpy, not yet judged.  method: one of its solvers, or "" for its default.

    Small problems of one shape share a model whose data are parameters (DPP), so that cvxpy works
    it out only once.
    """
    start = time.perf_counter()
    chosen = check(method)
    rows = split(problem)
    small = problem.q.size * (problem.q.size + problem.l.size) <= LARGEST_COMPILED
    with _lock, warnings.catch_warnings(), ungreeted(chosen):
        warnings.simplefilter("ignore")
        if small and not problem.has_sparse:
            model = _compiled(problem.q.size, rows.h.size, rows.b.size)
            _fill(model, problem, rows)
        else:
            model = _constant(problem, rows)
        options = settings(chosen.lower(), tolerance, time_limit)
        model.problem.solve(solver=chosen, warm_start=False, **options)
        status, rescue = str(model.problem.status), TRAITS.get(chosen.lower(), Trait()).rescue
        left = time_limit - (time.perf_counter() - start)
        if status != cp.OPTIMAL and rescue and left > 0.0:
            options = settings(chosen.lower(), tolerance, left) | dict(rescue)
            model.problem.solve(solver=chosen, warm_start=False, **options)
            status = str(model.problem.status)
        if model.x.value is None:
            return nothing(problem, reason(status), f"said {status}")
        z, y = (EMPTY if part is None else part.dual_value for part in (model.rows, model.equal))
        found = Solution(
            np.array(model.x.value, dtype=np.float64),
            multipliers(rows, problem.l.size, np.asarray(z), np.asarray(y), EMPTY),
            Status.SOLVED if status == cp.OPTIMAL else reason(status),
            time.perf_counter() - start,
        )
    return found


def solvers() -> list[str]:
    """Those of cvxpy's installed solvers that take a quadratic objective."""
    return [solver for solver in cp.installed_solvers() if solver not in LINEAR_ONLY]


def check(name: str) -> str:
    """cvxpy's name of a solver; its default for QPs is OSQP, where it is installed."""
    known = solvers()
    if name and name.upper() not in known:
        raise BackendError(f"cvxpy has no QP solver {name!r} here; choose one of {known}")
    return name.upper() or ("OSQP" if "OSQP" in known else known[0])


def _model(x: Any, curved: Any, data: dict[str, Any]) -> Model:
    """The model with this quadratic term and these data; rows that are not there are left out."""
    rows = data["G"] @ x <= data["h"] if "G" in data else None
    equal = data["E"] @ x == data["b"] if "E" in data else None
    constraints = [part for part in (rows, equal) if part is not None]
    target = cp.Minimize(0.5 * curved + data["q"] @ x)
    return Model(cp.Problem(target, constraints), x, rows, equal, data)


@lru_cache(maxsize=32)
def _compiled(n: int, g: int, e: int) -> Model:
    """A model of n variables, g inequalities and e equalities whose data are parameters."""
    shapes: dict[str, tuple[int, ...]] = {"F": (n, n), "q": (n,)}
    shapes |= {"G": (g, n), "h": (g,)} if g else {}
    shapes |= {"E": (e, n), "b": (e,)} if e else {}
    data = {name: cp.Parameter(shape) for name, shape in shapes.items()}
    x = cp.Variable(n)
    return _model(x, cp.sum_squares(data["F"] @ x), data)


def _fill(model: Model, problem: Problem, rows: Rows) -> None:
    """Put the data of a problem into a compiled model."""
    values = {"F": _root(problem.P), "q": problem.q}
    values |= {"G": rows.G, "h": rows.h, "E": rows.E, "b": rows.b}
    for name, parameter in model.data.items():
        parameter.value = values[name]


def _root(P: Matrix) -> Array:
    """F with FᵀF = P, for a P that may be singular.  P: (n, n).  Returns (n, n)."""
    curvature, V = np.linalg.eigh(P)
    root: Array = np.sqrt(np.maximum(curvature, 0.0))[:, None] * V.T
    return root


def _constant(problem: Problem, rows: Rows) -> Model:
    """A model for this problem only, its data as they are."""
    data = {"q": problem.q}
    data |= {"G": rows.G, "h": rows.h} if rows.h.size else {}
    data |= {"E": rows.E, "b": rows.b} if rows.b.size else {}
    x = cp.Variable(problem.q.size)
    return _model(x, cp.quad_form(x, cp.psd_wrap(sparse.csc_matrix(problem.P))), data)
