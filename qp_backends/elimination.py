"""The eliminated form of an epigraph problem: its last variable replaced by one active row."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from .problem import Array, BackendError, Problem, Solution, dense


@dataclass(frozen=True, eq=False)
class Elimination:
    """An epigraph problem and the smaller one in which row `active` holds with equality.

    problem: n - 1 variables and m - 1 rows, the others in their order.
    epigraph: the problem it was made from.  active: the row that is gone.
    slope: (n - 1,) and offset: the last variable is slopeᵀd - offset.
    """

    problem: Problem
    epigraph: Problem
    active: int
    slope: Array
    offset: float


def eliminate(problem: Problem, active: int = -1) -> Elimination:
    """Fix one active row of an epigraph problem and drop the variable it determines [M eq. 20-27].

    problem: min ½dᵀHd + v with rows gᵢᵀd - v ≤ F_max - F_i, v the last variable, and any others.
    active: the row I to hold with equality; -1 for the one with the largest F_i (smallest u).

    With v = g_Iᵀd + F_I - F_max the other rows become (gᵢ - g_I)ᵀd ≤ F_I - F_i.  This forces the
    linearised F_I to stay the largest: it is a restriction of the epigraph problem, not the same
    problem, and its answer is worse wherever another F_i would take over.
    """
    P, A = dense(problem.P), dense(problem.A)
    if np.any(P[-1, :-1]):
        raise BackendError("P couples the last variable to others: not an epigraph problem")
    fits = (A[:, -1] < 0) & (problem.u < np.inf) & (problem.l == -np.inf)
    if not fits.any():
        raise BackendError("no row g'd - v <= u: not an epigraph problem")
    if active < 0:
        steep = np.where(fits, -A[:, -1], 1.0)
        active = int(np.argmin(np.where(fits, problem.u / steep, np.inf)))
    elif not fits[active]:
        raise BackendError(f"row {active} is not of the form g'd - v <= u")
    steep = -A[active, -1]
    slope, offset = A[active, :-1] / steep, float(problem.u[active] / steep)
    others = np.delete(np.arange(problem.u.size), active)
    weight, curvature = A[others, -1], P[-1, -1]
    smaller = Problem(
        P=P[:-1, :-1] + curvature * np.outer(slope, slope),
        q=problem.q[:-1] + (problem.q[-1] - curvature * offset) * slope,
        A=A[others, :-1] + np.outer(weight, slope),
        l=problem.l[others] + weight * offset,
        u=problem.u[others] + weight * offset,
    )
    return Elimination(smaller, problem, active, slope, offset)


def restore(elimination: Elimination, solution: Solution) -> Solution:
    """The solution of the smaller problem as one of the epigraph problem.

    The multiplier of the active row makes the gradient in v vanish; where it comes out negative,
    fixing that row was a restriction that cost something.
    """
    problem, active = elimination.epigraph, elimination.active
    v = float(elimination.slope @ solution.x) - elimination.offset
    y = np.insert(solution.y, active, 0.0)
    column = dense(problem.A[:, [-1]]).ravel()
    force = problem.q[-1] + problem.P[-1, -1] * v + column @ y
    y[active] = -force / column[active]
    return replace(solution, x=np.append(solution.x, v), y=y)
