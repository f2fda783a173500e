"""The table of backends: a name, and the module that is imported when it is first used."""

from __future__ import annotations

import difflib
import inspect
import time
from collections.abc import Callable
from copy import deepcopy
from dataclasses import replace
from functools import cache, partial
from importlib import import_module, metadata, util
from typing import Any, Literal

import numpy as np

from . import child
from .problem import COLD, BackendError, Problem, Solution, Status
from .scaling import in_good_units

Solver = Callable[..., Solution]

BACKENDS: dict[str, tuple[str, str]] = {  # name: (module, method)
    "daqp": ("via_daqp", "daqp"),
    "quadprog": ("via_qpsolvers", "quadprog"),
    "piqp": ("via_qpsolvers", "piqp"),
    "clarabel": ("via_qpsolvers", "clarabel"),
    "proxqp": ("via_qpsolvers", "proxqp"),
    "highs": ("via_qpsolvers", "highs"),
    "osqp": ("via_qpsolvers", "osqp"),
    "scs": ("via_qpsolvers", "scs"),
    "ecos": ("via_qpsolvers", "ecos"),
    "qpalm": ("via_qpsolvers", "qpalm"),
    "cvxopt": ("via_qpsolvers", "cvxopt"),
    "kvxopt": ("via_qpsolvers", "kvxopt"),
    "gurobi": ("via_qpsolvers", "gurobi"),
    "mosek": ("via_qpsolvers", "mosek"),
    "copt": ("via_qpsolvers", "copt"),
    "qpoases": ("via_qpsolvers", "qpoases"),
    "qpswift": ("via_qpsolvers", "qpswift"),
    "hpipm": ("via_qpsolvers", "hpipm"),
    "cvxpy": ("via_cvxpy", ""),  # also "cvxpy:CLARABEL" and its other solvers
    "subgradient": ("subgradient", "restarted"),  # also "subgradient:raw", "subgradient:eliminated"
}
BackendName = Literal[  # every name of the table, and the choices of those that take one
    "daqp", "daqp:direct", "quadprog", "quadprog:direct", "piqp", "clarabel", "proxqp", "highs",
    "osqp", "scs", "ecos", "qpalm", "cvxopt", "kvxopt", "gurobi", "mosek", "copt", "qpoases",
    "qpswift", "hpipm", "cvxpy", "cvxpy:CLARABEL", "cvxpy:OSQP", "cvxpy:SCS", "subgradient",
    "subgradient:restarted", "subgradient:raw", "subgradient:eliminated",
]  # fmt: skip
# "quadprog:direct" goes without qpsolvers; "daqp:direct" is daqp, which always does.
DIRECT = {"daqp": "via_daqp", "quadprog": "via_quadprog"}
FRAIL = ("highs",)  # HiGHS 1.16 kills the process on P = diag(3e-14, 2e-4)
CHOOSING = ("cvxpy", "subgradient", *DIRECT)  # those that take a choice after a colon
PACKAGES = {  # where the package is not called like the backend: (module, distribution)
    "proxqp": ("proxsuite", "proxsuite"),
    "highs": ("highspy", "highspy"),
    "gurobi": ("gurobipy", "gurobipy"),
    "copt": ("coptpy", "coptpy"),
    "hpipm": ("hpipm_python", "hpipm_python"),
}
# Who takes over when another fails.  For dense problems the exact and fast ones come first, for
# sparse ones those that solve most of the 40 Maros-Meszaros problems: 38, 40, 38, 33, 32, ...
DENSE_ORDER = ("daqp", "quadprog", "piqp", "clarabel", "proxqp", "highs", "osqp", "scs")
SPARSE_ORDER = ("piqp", "clarabel", "scs", "highs", "osqp", "daqp", "quadprog", "proxqp")

_registered: dict[str, Solver] = {}


def register(name: str, solver: Callable[..., Any], *, seconds: float | None = None) -> None:
    """Make the user's own solver choosable by name.

    solver(problem) returns a Solution or a pair (x, y); it may take the keywords tolerance,
    time_limit and warm_start.  A name of the table is replaced by it.
    seconds: run it in a process of its own, which is ended after so long: a solver that never
    ends, or dies, then costs no more than that.  It must stand at the top of a module that can be
    imported.  None: in this process, without a clock.
    """
    module, where = getattr(solver, "__module__", ""), getattr(solver, "__qualname__", "")
    if seconds is not None and (module == "__main__" or not where.isidentifier()):
        raise BackendError(
            f"{name!r} in a process of its own must be a function at the top of a module that can "
            "be imported; move it into a file of its own"
        )
    if seconds is not None and not seconds > 0.0:
        raise BackendError(f"{name!r}: {seconds} seconds; give a positive number")
    _registered[name] = partial(_own, solver=solver, keywords=_keywords(solver), seconds=seconds)


def names() -> tuple[str, ...]:
    """All names that `solve` knows, installed or not."""
    return tuple(dict.fromkeys((*BACKENDS, *_registered)))


def backend(name: str) -> Solver:
    """The QP solver called name; BackendError when there is none or its package is missing."""
    if name in _registered:
        return _registered[name]
    family, _, choice = name.partition(":")
    if family not in BACKENDS or (choice and family not in CHOOSING):
        near = difflib.get_close_matches(name, names(), 1)
        hint = f"did you mean {near[0]!r}? " if near else ""
        raise BackendError(f"no QP backend {name!r}; {hint}choose one of {', '.join(names())}")
    return _imported(family, choice)


@cache
def _imported(family: str, choice: str) -> Solver:
    module, method = BACKENDS[family]
    if family in DIRECT and choice:
        if choice != "direct":
            raise BackendError(f"no QP backend '{family}:{choice}'; there is {family}:direct")
        module, choice = DIRECT[family], ""
    if not _installed(family):
        raise BackendError(f"{family!r} needs a package that is not here: {_pip(family)}")
    try:
        loaded = import_module(f".{module}", __package__)
    except ModuleNotFoundError as error:
        raise BackendError(f"{family!r} needs {error.name!r}: {_pip(family)}") from error
    if choice:
        loaded.check(choice)
    solver: Solver = partial(loaded.solve, method=choice or method)
    return in_good_units(solver) if (choice or method).lower() in FRAIL else solver


def _pip(name: str) -> str:
    """The command that installs a backend."""
    return f"pip install {_package(name)[1]}"


def _package(name: str) -> tuple[str, str]:
    """The module and the distribution behind a backend."""
    return PACKAGES.get(name, (name, name))


def _installed(name: str) -> bool:
    module, _ = BACKENDS[name]
    return module == "subgradient" or util.find_spec(_package(name)[0]) is not None


def available() -> dict[str, str]:
    """The backends that can be used here, and the version of the package behind each."""
    versions = {}
    for name, (module, _) in BACKENDS.items():
        if _installed(name):
            versions[name] = "own" if module == "subgradient" else _version(_package(name)[1])
    return versions | dict.fromkeys(_registered, "registered")


def _version(distribution: str) -> str:
    try:
        return metadata.version(distribution)
    except metadata.PackageNotFoundError:
        return "unknown"


def fallback_order(problem: Problem) -> tuple[str, ...]:
    """The installed backends in the order in which they take over."""
    order = SPARSE_ORDER if problem.has_sparse else DENSE_ORDER
    return tuple(name for name in order if name in _registered or _installed(name))


def _keywords(solver: Callable[..., Any]) -> tuple[str, ...]:
    """Which of our keywords a callable takes."""
    ours = ("tolerance", "time_limit", "warm_start")
    try:
        parameters = inspect.signature(solver).parameters
    except (TypeError, ValueError):
        return ()
    if any(p.kind is inspect.Parameter.VAR_KEYWORD for p in parameters.values()):
        return ours
    return tuple(name for name in ours if name in parameters)


def _own(
    problem: Problem,
    *,
    solver: Callable[..., Any],
    keywords: tuple[str, ...],
    seconds: float | None,
    **given: Any,
) -> Solution:
    """The answer of the user's own solver as a Solution."""
    start = time.perf_counter()
    known = {name: given[name] for name in keywords}
    if seconds is None:
        answer = solver(deepcopy(problem), **known)  # it may change what it gets
    else:
        limit = min(seconds, given["time_limit"])
        answer = child.call(solver.__module__, solver.__qualname__, problem, known, limit)
    warm = bool((known.get("warm_start") or COLD).x.size)
    if isinstance(answer, Solution):
        if not isinstance(answer.status, Status):
            raise TypeError(f"the status is {answer.status!r}, which is no qp_backends.Status")
        x, y = np.asarray(answer.x, np.float64), np.asarray(answer.y, np.float64)
        return replace(answer, x=x, y=y, warm=warm)
    x, y = (np.asarray(part, np.float64) for part in answer)
    return Solution(x, y, Status.SOLVED, time.perf_counter() - start, warm=warm)
