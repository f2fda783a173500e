"""What each third-party solver wants to be given: a table, so that all backends agree on it."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np

from .problem import Status


@dataclass(frozen=True)
class Trait:
    """What a solver wants to be given.

    storage: dense arrays, CSC matrices, or whichever of the two the problem came in.
    box: whether bounds on x are better than rows.
    tolerances: its settings that mean `tolerance`; none for a direct method.
    finest: the smallest tolerance it makes sense to ask for.
    clock: its setting for a time limit [s]; empty when it has none.
    pace: what a solve takes at most, per (variables + rows)³, where there is no clock [s].
    sparse_pace: the same for sparse data [s].
    warm: what of a warm start it takes, through qpsolvers' `initvals` and its own settings: "x",
    "dual" (x too, where multipliers are not at hand) or "all"; empty when it takes none.
    shortest: with rows of A that are shorter the problem is equilibrated first.
    definite: whether it refuses a P that is only semi-definite.
    fixed: settings of the first run.
    rescue: settings that are changed for a second run when the first finds nothing.
    """

    storage: Literal["dense", "sparse", "either"] = "either"
    box: bool = False
    tolerances: tuple[str, ...] = ()
    finest: float = 1e-13
    clock: str = ""
    pace: float = 1e-9
    sparse_pace: float = 1e-9
    warm: Literal["x", "dual", "all", ""] = ""
    shortest: float = 0.0
    definite: bool = False
    fixed: Mapping[str, Any] = field(default_factory=dict)
    rescue: Mapping[str, Any] = field(default_factory=dict)


TRAITS = {
    "daqp": Trait(
        "dense",
        box=True,
        tolerances=("eta_prox",),
        clock="time_limit",
        pace=2e-10,  # before its clock starts it took at most 1.3e-10 on 15 Maros-Meszaros problems
        warm="dual",
        shortest=1e-3,  # it takes very short rows for empty ones
        # its rows are scaled by the square root of P, which makes 1e-6 there 1e-2 in Ax
        fixed={"primal_tol": 1e-11},
        rescue={"primal_tol": 1e-6},  # its own: a finer one makes it cycle on degenerate problems
    ),
    "quadprog": Trait("dense", definite=True),
    "piqp": Trait(
        box=True,
        tolerances=("eps_abs", "eps_rel", "eps_duality_gap_abs", "eps_duality_gap_rel"),
        sparse_pace=1e-12,
    ),
    "clarabel": Trait(
        "sparse",
        tolerances=("tol_feas", "tol_gap_abs", "tol_gap_rel"),
        clock="time_limit",
    ),
    "osqp": Trait(
        "sparse",
        tolerances=("eps_abs", "eps_rel"),
        clock="time_limit",
        warm="x",
        # It adapts rho by residuals relative to Ax and to Px, q, A'y: where x is small beside what
        # pulls at it, as in the last steps of an SQP, it takes rho to its limit and crawls there.
        fixed={"max_iter": 4_000, "adaptive_rho": False, "rho": 1.0},
        rescue={"max_iter": 50_000, "adaptive_rho": True, "rho": 0.1},
    ),
    "proxqp": Trait(
        tolerances=("eps_abs",),
        warm="all",
        fixed={"eps_rel": 0.0, "max_iter": 1_000},
        rescue={"rho": 1e-2},  # without curvature it takes feasible problems for infeasible
    ),
    "highs": Trait(
        "sparse",
        box=True,
        tolerances=("primal_feasibility_tolerance", "dual_feasibility_tolerance"),
        finest=1e-10,
        clock="time_limit",
        # what HiGHS adds to P makes it robust, and wrong by as much; without it it may cycle
        fixed={"qp_regularization_value": 0.0, "qp_iteration_limit": 20_000},
        rescue={"qp_regularization_value": 1e-7},
    ),
    "scs": Trait(
        "sparse",
        tolerances=("eps_abs", "eps_rel"),
        clock="time_limit_secs",
        warm="x",
        fixed={"max_iters": 50_000},
    ),
    "ecos": Trait("dense", tolerances=("feastol", "abstol", "reltol"), definite=True),
    "qpalm": Trait("sparse", tolerances=("eps_abs", "eps_rel"), clock="time_limit", warm="x"),
    "cvxopt": Trait(),
    "kvxopt": Trait(),
}


def settings(method: str, tolerance: float, time_limit: float) -> dict[str, Any]:
    """A solver's own settings for our tolerance and time limit [s]."""
    trait = TRAITS.get(method, Trait())
    chosen = dict(trait.fixed)
    for name in trait.tolerances:
        chosen[name] = max(tolerance, trait.finest)
    if trait.clock and time_limit < np.inf:
        chosen[trait.clock] = max(time_limit, 1e-6)  # 0 means no limit to some
    return chosen


REASONS = (
    (re.compile("dual.?infeasible|unbounded", re.IGNORECASE), Status.UNBOUNDED),
    (re.compile("infeasible", re.IGNORECASE), Status.INFEASIBLE),
    (re.compile("inaccurate|almost", re.IGNORECASE), Status.INACCURATE),
    (re.compile("iter|user.?limit", re.IGNORECASE), Status.ITERATION_LIMIT),
    (re.compile("time", re.IGNORECASE), Status.TIME_LIMIT),
)


def reason(text: str) -> Status:
    """Why a solver found nothing, from the words of its status."""
    return next((status for sign, status in REASONS if sign.search(text)), Status.FAILED)
