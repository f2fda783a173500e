"""The largest of many norms by second-order cone programs: a second opinion on the SQP.

    min over x of  max_i |r_i(x)|   subject to   lower <= c(x) <= upper

Each step solves the problem with r and c linearised, exactly and for norms as they are (the SQP of
`minimax` takes their squares):

    min t   subject to   |r_i + J_i d| <= t,   lower <= c + C d <= upper,   |d| <= radius.

Globalisation: a trust region, and slacks on the constraints at a price [Fletcher's Sl1QP; Nocedal
and Wright, Numerical Optimization, sec. 18.5].  Only points that can matter enter a program; the
answer is judged on all of them, and those it missed are added.  The solver knows no robot.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Generic, Protocol, TypeVar

import clarabel
import numpy as np
from scipy import sparse

from minimax_cal.ground.arrays import Array
from minimax_cal.solvers.dual_bound import (
    Multipliers,
    Rows,
    aligned,
    dual_value,
    gap_of,
    lower_bound,
)
from minimax_cal.solvers.minimax import RELENTLESS, ROUNDING, excess
from minimax_cal.solvers.status import Status

X = TypeVar("X")

TRUSTED = 1e-6  # relative error, proven by its own multipliers, up to which an answer is used
FIRST = 4  # points per unknown in a program at first: at most one per unknown will be active
TIGHT = 1e-12  # tolerances asked of Clarabel, which comes as near to them as it can
NEARLY = 10.0  # times the tolerance: optimal as far as rounding lets one see


def ahead(rows: Rows, d: Array) -> tuple[Array, Array]:
    """Norms (n,) and constraints (l,) after a step d (p,), as the linear model has them."""
    return np.linalg.norm(rows.r + rows.J @ d, axis=1), rows.c + rows.C @ d


def some_of(rows: Rows, chosen: Array) -> Rows:
    """Some of the vectors, all of the constraints."""
    return Rows(rows.r[chosen], rows.J[chosen], rows.c, rows.C)


class Norms(Protocol[X]):
    """A smooth max-of-norms problem with two-sided constraints, scaled to values of about one."""

    @property
    def lower(self) -> Array:
        """(l,) -inf where open."""

    @property
    def upper(self) -> Array:
        """(l,) inf where open."""

    def linearise(self, x: X) -> Rows:
        """r, c and their derivatives."""

    def step(self, x: X, d: Array) -> X:
        """The point moved by d (p,)."""


@dataclass(frozen=True)
class Settings:
    """tolerance: on the proven gap, relative, and on violation.  iterations: at most so many steps.

    radius: of the first trust region.  penalty: first price of a violation.
    """

    tolerance: float = 1e-9
    iterations: int = 100
    radius: float = 1.0
    penalty: float = 10.0


@dataclass(frozen=True, eq=False)
class Proven(Generic[X]):
    """x with its norms (n,) and constraints c (l,).

    bound: below which the linearised problem cannot get, by the multipliers alone.
    iterations: cone programs' steps.
    """

    x: X
    norms: Array
    c: Array
    multipliers: Multipliers
    bound: float
    violation: float
    iterations: int
    status: Status

    @property
    def value(self) -> float:
        """The largest norm."""
        return float(self.norms.max())

    @property
    def gap(self) -> float:
        """How much lower the value could be at most, to first order, relative."""
        return gap_of(self.value, self.bound)


def solve(problem: Norms[X], x: X, settings: Settings = Settings()) -> Proven[X]:
    """Minimise the largest norm from x."""
    rows = problem.linearise(x)
    at = Place(problem, x, rows, aligned(rows, np.ones(len(rows.r)), np.zeros(len(rows.c))), 0.0)
    program = Program.empty(problem.lower, problem.upper)
    radius, penalty, tolerance = settings.radius, settings.penalty, settings.tolerance
    status, iteration = Status.ITERATION_LIMIT, 0
    while iteration < settings.iterations and status is Status.ITERATION_LIMIT:
        iteration += 1
        answer, program = program.answer(at.rows, radius, penalty)
        if not answer.error <= TRUSTED:
            status = Status.FAILED
            break
        at = at.judged(answer.multipliers)
        decrease, left = at.ahead(answer.d, penalty)
        if at.optimal(tolerance):
            status = Status.CONVERGED
        elif left > tolerance and np.linalg.norm(answer.d) < 0.99 * radius:
            status = Status.INFEASIBLE if penalty > RELENTLESS else status
            penalty *= 10.0
        elif decrease <= ROUNDING * at.merit(at.rows.norms, at.rows.c, penalty):
            status = Status.CONVERGED if at.optimal(NEARLY * tolerance) else Status.STALLED
        else:
            at, radius = at.moved(answer.d, penalty, decrease, radius)
            status = Status.CONVERGED if at.optimal(tolerance) else status
    return Proven(
        at.x, at.rows.norms, at.rows.c, at.multipliers, at.bound, at.violation, iteration, status
    )


@dataclass(frozen=True, eq=False)
class Place(Generic[X]):
    """An iterate with what is known there: multipliers, and the bound that they prove."""

    problem: Norms[X]
    x: X
    rows: Rows
    multipliers: Multipliers
    bound: float

    @property
    def violation(self) -> float:
        """The largest violation of a constraint."""
        excessive = excess(self.rows.c, self.problem.lower, self.problem.upper)
        return float(excessive.max(initial=0.0))

    def judged(self, multipliers: Multipliers) -> Place[X]:
        """The same place with other multipliers."""
        bound = lower_bound(self.rows, self.problem.lower, self.problem.upper, multipliers)
        return replace(self, multipliers=multipliers, bound=bound)

    def optimal(self, tolerance: float) -> bool:
        """Whether the gap is closed and the constraints hold."""
        value = float(self.rows.norms.max())
        gap = min(gap_of(value, self.bound), value)  # a value of nothing has nothing to lose
        return bool(max(gap, self.violation) <= tolerance)

    def merit(self, norms: Array, c: Array, penalty: float) -> float:
        """The largest norm plus the priced violations."""
        left = excess(c, self.problem.lower, self.problem.upper).sum()
        value = float(norms.max() + penalty * left)
        return value if np.isfinite(value) else float("inf")

    def ahead(self, d: Array, penalty: float) -> tuple[float, float]:
        """Decrease of the merit by a step, and violations left, as the linear model has them."""
        norms, c = ahead(self.rows, d)
        now = self.merit(self.rows.norms, self.rows.c, penalty)
        left = excess(c, self.problem.lower, self.problem.upper).sum()
        return now - self.merit(norms, c, penalty), float(left)

    def moved(
        self, d: Array, penalty: float, decrease: float, radius: float
    ) -> tuple[Place[X], float]:
        """The place after a step if it lowers the merit, else this one; and the next radius.

        decrease: what the linear model promises.
        """
        x = self.problem.step(self.x, d)
        there = self.problem.linearise(x)
        now = self.merit(self.rows.norms, self.rows.c, penalty)
        then = self.merit(there.norms, there.c, penalty)
        share, length = (now - then + ROUNDING * now) / decrease, float(np.linalg.norm(d))
        if share < 0.25:
            radius = 0.25 * length
        elif share > 0.75 and length > 0.9 * radius:
            radius *= 2.0
        if share < 1e-4:
            return self, radius
        mu = np.linalg.norm(self.multipliers.y, axis=1)
        force = aligned(there, mu, self.multipliers.lam)
        return replace(self, x=x, rows=there).judged(force), radius


# ---- the cone program --------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Answer:
    """d: (p,) step.  error: how far it is from the best at most, by its own multipliers, relative.

    Relative to the merit, largest norm and priced violations, before the step.
    """

    d: Array
    multipliers: Multipliers
    error: float


@dataclass(frozen=True, eq=False)
class Program:
    """Clarabel with the pattern of one shape of program in it; other values go into the same.

    Unknowns: d (p,), t, and a slack s >= 0 for every constraint.  pattern: of the matrix, True
    where an entry may be, row by row: upper and lower bounds, s >= 0, trust region, points.
    count: points in it.  solver: Clarabel's, none yet for count 0.
    """

    lower: Array
    upper: Array
    count: int
    pattern: Array
    solver: tuple[Any, ...]

    @staticmethod
    def empty(lower: Array, upper: Array) -> Program:
        """No program yet."""
        return Program(lower, upper, 0, np.zeros((0, 0), dtype=bool), ())

    def answer(self, rows: Rows, radius: float, penalty: float) -> tuple[Answer, Program]:
        """The best step within the radius, and the program to go on with."""
        n, _, p = rows.J.shape
        if not (np.isfinite(rows.r).all() and np.isfinite(rows.J).all()):
            none = Multipliers(np.zeros_like(rows.r), np.zeros_like(rows.c))
            return Answer(np.zeros(p), none, np.inf), self
        count = max(self.count, min(n, FIRST * (p + 1)))
        chosen = np.sort(np.argsort(-rows.norms, kind="stable")[:count])
        program = self
        while True:
            some = some_of(rows, chosen)
            d, force, program = program.solved(some, radius, penalty)
            norms, c = ahead(rows, d)
            missed = np.flatnonzero(norms > norms[chosen].max() * (1.0 + ROUNDING))
            if not len(missed):
                break
            worst = missed[np.argsort(-norms[missed], kind="stable")]
            chosen = np.union1d(chosen, worst[: FIRST * (p + 1)])
        lam = np.clip(force.lam, -penalty, penalty)
        now = rows.norms.max() + penalty * excess(rows.c, self.lower, self.upper).sum()
        value = norms.max() + penalty * excess(c, self.lower, self.upper).sum()
        bound = dual_value(some, self.lower, self.upper, Multipliers(force.y, lam), radius)
        every = np.zeros_like(rows.r)
        every[chosen] = force.y
        error = float(value - bound) / float(now)
        return Answer(d, Multipliers(every, lam), error), program

    def solved(
        self, rows: Rows, radius: float, penalty: float
    ) -> tuple[Array, Multipliers, Program]:
        """Step and multipliers as Clarabel gives them, not yet judged."""
        n, w, p = rows.J.shape
        above, below = np.isfinite(self.upper), np.isfinite(self.lower)
        A, b = self.matrix(rows, radius)
        q = np.concatenate([np.zeros(p), [1.0], np.full(len(rows.c), penalty)])
        program = self
        if self.count != n:
            program = self.started(A, b, q, rows)
        (solver,) = program.solver
        solver.update(A=A.T[program.pattern.T], b=b, q=q)
        found = solver.solve()
        z, d = np.array(found.z), np.array(found.x)[:p]
        if not (np.isfinite(z).all() and np.isfinite(d).all()):
            return np.zeros(p), Multipliers(np.zeros((n, w)), np.zeros(len(rows.c))), program
        lam = np.zeros(len(rows.c))
        lam[above] += z[: above.sum()]
        lam[below] -= z[above.sum() : above.sum() + below.sum()]
        y = -z[-n * (1 + w) :].reshape(n, 1 + w)[:, 1:]
        return d, Multipliers(y, lam), program

    def started(self, A: Array, b: Array, q: Array, rows: Rows) -> Program:
        """A solver for programs of this shape: zeros that could be something else are kept."""
        n, w, p = rows.J.shape
        full = Rows(np.ones_like(rows.r), np.ones_like(rows.J), rows.c, np.ones_like(rows.C))
        pattern = self.matrix(full, 1.0)[0] != 0.0
        entries = sparse.csc_matrix(pattern, dtype=float)
        entries.data = A.T[pattern.T]
        sides = int(np.isfinite(self.upper).sum() + np.isfinite(self.lower).sum())
        cones = [
            clarabel.NonnegativeConeT(sides + len(rows.c)),
            clarabel.SecondOrderConeT(1 + p),
            *[clarabel.SecondOrderConeT(1 + w)] * n,
        ]
        nothing = sparse.csc_matrix((len(q), len(q)))
        solver = clarabel.DefaultSolver(nothing, q, entries, b, cones, clarabel_settings())
        return Program(self.lower, self.upper, n, pattern, (solver,))

    def matrix(self, rows: Rows, radius: float) -> tuple[Array, Array]:
        """A and b of b - A (d, t, s) in the cones."""
        n, w, p = rows.J.shape
        l = len(rows.c)  # noqa: E741
        above, below = np.isfinite(self.upper), np.isfinite(self.lower)
        none, slack = np.zeros((l, 1)), -np.eye(l)
        sides = np.block([[rows.C, none, slack], [-rows.C, none, slack]])
        kept = np.concatenate([above, below])
        points = np.zeros((n, 1 + w, p + 1 + l))
        points[:, 0, p] = -1.0
        points[:, 1:, :p] = -rows.J
        A = np.concatenate(
            [
                sides[kept],
                np.eye(l, p + 1 + l, p + 1) * -1.0,
                np.zeros((1, p + 1 + l)),
                -np.eye(p, p + 1 + l),
                points.reshape(n * (1 + w), -1),
            ]
        )
        room = np.concatenate([self.upper - rows.c, rows.c - self.lower])[kept]
        right = np.concatenate([np.zeros((n, 1)), rows.r], axis=1)
        b = np.concatenate([room, np.zeros(l), [radius], np.zeros(p), right.reshape(-1)])
        return A, b


def clarabel_settings() -> Any:
    """Quiet, exact, one thread, and with its data open to new values."""
    chosen = clarabel.DefaultSettings()
    chosen.verbose = False
    chosen.presolve_enable = False
    chosen.chordal_decomposition_enable = False
    chosen.max_threads = 1
    chosen.tol_gap_abs = chosen.tol_gap_rel = chosen.tol_feas = TIGHT
    return chosen
