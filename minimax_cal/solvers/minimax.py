"""Minimax by sequential quadratic programming on the epigraph QP [paper M, eq. 10-13].

    min over x of  max_i f_i(x)   subject to   lower <= c(x) <= upper

Each step solves  min 1/2 d'Hd + v,  f + f'd - max f <= v,  lower - c <= c'd <= upper - c  with any
QP solver, in units in which all is about one.  Globalisation (the paper has none): a line search on
max f + price @ violation, with a second-order correction where the curvature of the active pieces
spoils the full step [Maratos effect; Nocedal and Wright, Numerical Optimization, ch. 18], and
damping of H as the last resort.
The solver knows no robot; problem and iterate are the caller's.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from typing import Generic, Protocol, TypeVar

import numpy as np

from minimax_cal.ground.arrays import Array
from minimax_cal.solvers.status import Status
from qp_backends import Problem, ProblemError, Solution
from qp_backends import Status as QpStatus
from qp_backends.problem import COLD

X = TypeVar("X")
Ask = Callable[[Problem], Solution]

HESSIANS = ("gauss-newton", "bfgs")

EVEN: Array = np.zeros(0)
NUMBER = re.compile(r"\d[\d.]*(e[+-]?\d+)?")

# Differences of the merit function below this, relative, are rounding: the model is trusted there.
ROUNDING, EPS = 1e-12, float(np.finfo(float).eps)
SHARE = 3  # times the unknowns: of more functions than twice that, so many make a first QP
PATIENCE = 10  # iterations without progress in value or optimality before giving up
WORTH = 1e-8  # relative: a fall by less is no progress where QP answers are used as they are
NOTHING = 1e-12  # of the value at the start: what is as good as zero
ENDLESS = 1e32  # times that: a value so large belongs to what falls without end
CANCELLED = 1e-7  # a value below this share of the terms that make it is known no better
MOST_DAMPING = 1e8  # of the Hessian's diagonal
RELENTLESS = 1e6  # price of a violation, in slopes of f, beyond which it is there to stay
MIN_FALLING_SLOPE = 0.25  # at the end of a step, relative to its start: worth going on
MAX_LENGTHENING = 1e15  # times a step
NEARLY = 100.0  # times the tolerance: optimal as far as rounding lets one see

# Curvature of a direction that has none, for solvers that ask for a definite P.
EPIGRAPH = 1e-8
# P_vv of the epigraph variable v: a force that changes the sum of the multipliers by a part of
# NEGLIGIBLE_FORCE at the decrease that is still to be had, but no more curvature than this.  Active
# set methods work with A P^-1 A', whose entries are of size one beside 1 / P_vv: from 1e8 on the
# rounding of the sum exceeds a QP's tolerance.
NEGLIGIBLE_FORCE = 1e-9
MAX_DECREASE_CURVATURE = 1e-6


@dataclass(frozen=True, eq=False)
class StartScales:
    """Scales of a problem at the start.

    lengths: (p,) over which a variable alone changes the functions by their size.
    largest_level: with what changes of the value are compared at most; less than the value where
    that holds a number which is added to all functions.
    """

    lengths: Array
    largest_level: float = np.inf


class Solver(Protocol):
    """A QP solver whose answers are verified already, as `qp_backends.solve` with a name."""

    def __call__(self, problem: Problem, /, *, warm_start: Solution = COLD) -> Solution:
        """The answer.  warm_start: that of a similar problem of the same size, or COLD."""


def from_nothing(qp: Ask) -> Solver:
    """A solver that takes nothing but the problem, as one of ours."""

    def run(problem: Problem, /, *, warm_start: Solution = COLD) -> Solution:
        return qp(problem)

    return run


@dataclass
class Asking:
    """Puts QPs to a solver, each from the answer to the last one of its size, and keeps count.

    answered: QPs by the backend that answered.  warm: those that a backend began at that answer.
    residual: the largest relative residual of an answer, as its judge says.
    """

    qp: Solver
    last: Solution = COLD
    answered: Counter[str] = field(default_factory=Counter)
    warm: int = 0
    residual: float = 0.0

    def __call__(self, problem: Problem) -> Solution:
        """The answer to a problem."""
        start = self.last if self.last.x.shape == problem.q.shape else COLD
        answer = self.qp(problem, warm_start=start)
        self.answered[answer.backend or "unnamed"] += 1
        self.warm += answer.warm
        if np.isfinite(answer.residual):
            self.residual = max(self.residual, answer.residual)
        if answer.usable:
            self.last = answer
        return answer


@dataclass(frozen=True, eq=False)
class Linear:
    """Values and first derivatives at a point.

    f: (k,).  jacobian: (k, p) of f.  c: (l,).  normal: (l, p) of c.
    curvature: from weights (k,) to the weighted sum of the f_i's second derivatives (p, p), or to
    an empty matrix where only BFGS can find them.
    """

    f: Array
    jacobian: Array
    c: Array
    normal: Array
    curvature: Callable[[Array], Array]

    def of(self, rows: Array) -> Linear:
        """Some of the functions; their curvature is that of all."""
        return replace(self, f=self.f[rows], jacobian=self.jacobian[rows])

    def lengths(self, level: float) -> Array:
        """(p,) how far a variable alone may go until a function is above the largest by level.

        By the derivatives here; 1 where no function depends on it.
        """
        room = level + self.f.max() - self.f
        steepest = np.abs(self.jacobian / room[:, None]).max(axis=0)
        return np.asarray(1.0 / np.where(steepest > 0.0, steepest, 1.0))


class Minimax(Protocol[X]):
    """A smooth max-of-functions problem with two-sided constraints."""

    @property
    def lower(self) -> Array:
        """(l,) -inf where open."""

    @property
    def upper(self) -> Array:
        """(l,) inf where open."""

    def evaluate(self, x: X) -> tuple[Array, Array]:
        """f (k,) and c (l,)."""

    def linearise(self, x: X) -> Linear:
        """f, c and their derivatives."""

    def step(self, x: X, d: Array) -> X:
        """The point moved by d (p,)."""


@dataclass(frozen=True, eq=False)
class Units:
    """Units in which a problem is about one: of the value, the variables (p,), constraints (l,)."""

    value: float
    x: Array
    c: Array

    @staticmethod
    def of(here: Linear, value: float, x: Array, lower: Array, upper: Array) -> Units:
        """A constraint's is its way to a bound, at least how much it changes along a variable's."""
        way = np.minimum(np.abs(upper - here.c), np.abs(here.c - lower))
        c = np.abs(here.normal * x).max(axis=1, initial=0.0)
        c = np.maximum(c, np.where(np.isfinite(way), way, 0.0))
        return Units(value, x, np.where(c > 0.0, c, 1.0))

    def scaled(self, here: Linear) -> Linear:
        """The problem in these units."""
        return replace(
            here, f=here.f / self.value, jacobian=here.jacobian * (self.x / self.value),
            c=here.c / self.c, normal=here.normal * (self.x / self.c[:, None]),
        )  # fmt: skip


@dataclass(frozen=True)
class Sqp:
    """Settings of the SQP.

    tolerance: on stationarity, complementarity and violation, as `Kkt` has them.
    iterations: at most so many QPs.  floor: least weight of the functions in the Gauss-Newton
    Hessian, shared evenly, which inactive ones would otherwise leave singular.
    hessian: "gauss-newton" (the problem's own curvature, weighted by the multipliers) or "bfgs"
    (damped, Powell; it starts from the problem's curvature where there is one).
    """

    tolerance: float = 1e-8
    iterations: int = 200
    floor: float = 3e-3
    hessian: str = "gauss-newton"


@dataclass(frozen=True)
class Kkt:
    """How far from optimal: all three are zero at a Karush-Kuhn-Tucker point.

    stationarity: largest entry of sum mu_i f_i' + sum lambda_l c_l'.
    complementarity: sum mu_i (max f - f_i) + sum |lambda_l| (distance of c_l to its bound).
    violation: largest violation of a constraint.

    In an `Iterate`'s units.  By duality of linear programs the linearised problem then offers no
    more, within a box of the variables' units, than complementarity + sum of stationarity.
    """

    stationarity: float
    complementarity: float
    violation: float

    @property
    def residual(self) -> float:
        """The largest of the three."""
        return max(self.stationarity, self.complementarity, self.violation)


@dataclass(frozen=True)
class Step:
    """One line of the iteration trace; `backend` is the QP solver that really answered."""

    iteration: int
    value: float
    violation: float
    kkt: float
    length: float
    backend: str = ""


@dataclass(frozen=True, eq=False)
class Optimum(Generic[X]):
    """x with its f (k,), c (l,), multipliers mu (k,) that sum to one and lambda (l,).

    lambda is > 0 at an upper bound and < 0 at a lower one.
    answered, warm: as in `Asking`; qp_residual: its residual.
    """

    x: X
    f: Array
    c: Array
    mu: Array
    lam: Array
    kkt: Kkt
    iterations: int
    status: Status
    trace: tuple[Step, ...] = ()
    notes: tuple[str, ...] = field(default=())
    answered: Mapping[str, int] = field(default_factory=dict)
    warm: int = 0
    qp_residual: float = 0.0

    @property
    def value(self) -> float:
        """max f."""
        return float(self.f.max())


def solve(
    problem: Minimax[X],
    x: X,
    qp: Solver,
    settings: Sqp = Sqp(),
    progress: Callable[[Step], None] = lambda step: None,
    mu: Array = EVEN,
    scales: StartScales | None = None,
) -> Optimum[X]:
    """Minimise max f from x.  qp: a QP solver; it is given each answer as the next one's start.

    mu: (k,) multipliers of a similar problem, to begin with.
    scales: of variables and value, where they are known; else the derivatives at x give them.
    """
    at, ask = Iterate.begin(problem, x, settings, mu, scales), Asking(qp)
    status, tolerance = Status.ITERATION_LIMIT, settings.tolerance
    trace: list[Step] = []
    notes: list[str] = []
    for iteration in range(1, settings.iterations + 1):
        numbers = np.all(np.isfinite(at.here.f)) and np.all(np.isfinite(at.here.jacobian))
        if not numbers or at.units.value > ENDLESS * at.least:
            status = Status.FAILED
            break
        hessian = at.hessian(settings.floor)
        try:
            plan = at.subproblem(hessian, ask)
        except ProblemError:  # values so large that the QP's numbers overflow
            status = Status.FAILED
            break
        notes += plan.notes
        if not plan.usable:  # the point may be optimal all the same
            best, status = at.balanced(), Status.FAILED
            if best.is_nearly_optimal(tolerance):
                at, status = best, Status.CONVERGED
            break
        if not plan.exact:
            best = at.balanced()
            plan = replace(plan, mu=best.mu, lam=best.lam)
        price = priced(at, plan, tolerance)
        at = at.after(plan, at.price if price is None else price)
        if price is None:
            status = Status.INFEASIBLE
            break
        length, move, end, there = 0.0, np.zeros_like(plan.d), at.x, at.here
        if at.kkt.residual > tolerance:
            length, move, end, there = search(at, plan, partial(at.subproblem, hessian, ask))
        value, kkt = float(at.here.f.max()), at.kkt
        trace.append(Step(iteration, value, kkt.violation, kkt.residual, length, plan.backend))
        progress(trace[-1])
        ended = at.patience(tolerance, plan.exact)
        if ended is None:
            at = at.moved(move, end, there) if length else at.damped()
            ended = at.arrived(tolerance, plan.exact)
        if ended is Status.STALLED or (ended is None and not length):
            best = at.balanced()  # the multipliers of its QP may be to blame
            if best.is_nearly_optimal(tolerance):
                at, ended = best, Status.CONVERGED
        if ended is not None:
            status = ended
            break
    if status is Status.STALLED:
        may = 100.0 * at.offer()
        notes.append(f"to first order the largest function may still fall by {may:.2g} %")
    return Optimum(
        at.x, at.here.f, at.here.c, at.mu, at.lam, at.kkt, len(trace), status, tuple(trace),
        told_once(notes), dict(ask.answered), ask.warm, ask.residual,
    )  # fmt: skip


def told_once(notes: Sequence[str]) -> tuple[str, ...]:
    """Notes, of those that differ in nothing but numbers the first, with their count."""
    alike: dict[str, list[str]] = {}
    for note in notes:
        alike.setdefault(NUMBER.sub("#", note), []).append(note)
    return tuple(
        same[0] if len(same) == 1 else f"{same[0]} (the first of {len(same)} alike)"
        for same in alike.values()
    )


@dataclass(frozen=True, eq=False)
class Iterate(Generic[X]):
    """Where the iteration stands.

    here: the problem at x.  mu, lam: multipliers of the latest QP.  quasi: the Hessian where the
    problem has none of its own.  gone: (p,) from the start.  reach: (p,) the farthest of it, at
    least as far as the start's derivatives suggest.  price: (l,) of a violation.  least: a value
    that is as good as none.  largest_level: as `StartScales` has it.  damping: of the Hessian's
    diagonal.  best, lowest: least residual and value so far.  idle: iterations since either fell.
    step: QPs so far.
    """

    problem: Minimax[X]
    x: X
    here: Linear
    mu: Array
    lam: Array
    quasi: Bfgs | None
    gone: Array
    reach: Array
    price: Array
    least: float
    largest_level: float = np.inf
    damping: float = 0.0
    best: float = np.inf
    lowest: float = np.inf
    idle: int = 0
    step: int = 0

    @staticmethod
    def begin(
        problem: Minimax[X], x: X, settings: Sqp, mu: Array, scales: StartScales | None = None
    ) -> Iterate[X]:
        """The start; without mu all functions share the multipliers evenly."""
        here = problem.linearise(x)
        (k, p), none = here.jacobian.shape, np.zeros(len(here.c))
        f, slope = np.abs(here.f), np.abs(here.jacobian)
        level = float(max(abs(here.f.max()), CANCELLED * f.mean()) or slope.max() or 1.0)
        bent = level / (scales.lengths if scales else here.lengths(level)) ** 2
        bfgs = Bfgs.start(here, bent)
        reach = np.sqrt(level / np.maximum(bent, np.diag(bfgs.matrix)))
        quasi = None if settings.hessian == "gauss-newton" else bfgs
        mu, least = mu if len(mu) else np.full(k, 1.0 / k), NOTHING * level
        cap = scales.largest_level if scales else np.inf
        return Iterate(problem, x, here, mu, none, quasi, np.zeros(p), reach, none, least, cap)

    @cached_property
    def terms(self) -> float:
        """Size of the terms that the value is the sum of; its rounding is relative to them."""
        here, held = self.here, self.mu > 0.0
        slopes = self.mu[held] @ np.abs(here.jacobian[held]) + np.abs(self.lam) @ np.abs(
            here.normal
        )
        return float(self.mu @ np.abs(here.f) + slopes @ self.reach)

    @cached_property
    def units(self) -> Units:
        """Of the value as large as it is, of variables as far as they go."""
        size = min(abs(float(self.here.f.max())), self.largest_level)
        level = max(size, CANCELLED * self.terms, min(self.least, self.largest_level))
        return Units.of(self.here, level, self.reach, self.problem.lower, self.problem.upper)

    @cached_property
    def kkt(self) -> Kkt:
        """How far from optimal, in these units."""
        units, low, high = self.units, self.problem.lower, self.problem.upper
        lam = self.lam * units.c / units.value
        return optimality(units.scaled(self.here), self.mu, lam, low / units.c, high / units.c)

    @cached_property
    def lengths(self) -> Array:
        """(p,) as `Linear` has them."""
        return self.here.lengths(self.units.value)

    @cached_property
    def fair(self) -> Array:
        """(l,) prices at which a constraint's unit is worth what the functions can gain by it."""
        units = self.units
        return np.asarray(units.value / units.c * float((self.reach / self.lengths).max()))

    def hessian(self, floor: float) -> Array:
        """(p, p) of the Lagrangian, damped.  floor: as `Sqp.floor`."""
        with np.errstate(over="ignore"):
            least = EPIGRAPH * np.diag(self.units.value / self.lengths**2)
        if self.quasi is None:
            matrix = self.here.curvature(np.maximum(self.mu, floor / len(self.mu)))
        else:
            matrix = self.quasi.matrix
        if not self.damping:
            return matrix
        return np.asarray(matrix + self.damping * np.maximum(np.diag(np.diag(matrix)), least))

    def subproblem(
        self, hessian: Array, qp: Ask, f: Array | None = None, c: Array | None = None
    ) -> Plan:
        """The answer of the epigraph QP here, or with other values f, c.

        If its constraints contradict each other, of their elastic relaxation.
        """
        bend = np.diag(hessian) / self.units.value
        x = np.where(bend > 0.0, 1.0 / np.sqrt(np.where(bend > 0.0, bend, 1.0)), self.lengths)
        units = replace(self.units, x=x)
        here = self.here if f is None or c is None else replace(self.here, f=f, c=c)
        here, lower = units.scaled(here), self.problem.lower / units.c
        bent, upper = (
            hessian / units.value * np.outer(units.x, units.x),
            self.problem.upper / units.c,
        )
        # What weak duality leaves at the last multipliers, the Hessian taken as its diagonal.
        slope = self.mu @ here.jacobian + (self.lam * units.c / units.value) @ here.normal
        decrease = self.kkt.complementarity + 0.5 * float(slope @ slope)
        missed = rows = self.likely(here)
        while len(missed):
            some = here if len(rows) == len(here.f) else here.of(rows)
            plain = epigraph(some, here.f.max(), bent, lower, upper, decrease)
            solution = qp(plain)
            missed = forgotten(here, rows, solution)
            rows = np.concatenate([rows, missed])
        if given(solution) or not len(here.c):
            return read(solution, here, rows, units)
        price = np.maximum(self.price, 1e2 * self.fair)
        relaxed = qp(elastic(plain, len(rows), price * units.c / units.value))
        return replace(read(relaxed, here, rows, units), relaxed=price)

    def likely(self, here: Linear) -> Array:
        """The functions that may be the largest after a step: all, or of many the largest now."""
        k, p = here.jacobian.shape
        most = SHARE * p
        if k <= 2 * most:
            return np.arange(k)
        large = here.f >= np.partition(here.f, k - most)[k - most]
        return np.flatnonzero(large | (self.mu > 0.0) if self.step else large)

    def after(self, plan: Plan, price: Array) -> Iterate[X]:
        """The same point with the multipliers of a QP, one more iteration counted."""
        at = replace(self, mu=plan.mu, lam=plan.lam, price=price, step=self.step + 1)
        value, best, lowest, idle = float(self.here.f.max()), self.best, self.lowest, self.idle + 1
        worth = ROUNDING if plan.exact else WORTH
        better = plan.exact and at.kkt.residual < 0.9 * best
        if better or value < lowest - worth * abs(lowest):
            best, lowest, idle = min(best, at.kkt.residual), value, 0
        return replace(at, best=best, lowest=lowest, idle=idle)

    def balanced(self) -> Iterate[X]:
        """The same point with multipliers that balance the gradients here best, of no QP."""
        units, rows, mu = self.units, self.likely(self.here), np.zeros(len(self.mu))
        some, low, high = units.scaled(self.here).of(rows), self.problem.lower, self.problem.upper
        mu[rows], lam = multipliers_at(some, low / units.c, high / units.c)
        return replace(self, mu=mu, lam=lam * units.value / units.c)

    def offer(self) -> float:
        """By how much of itself the value may still fall, to first order, within the units."""
        here, lam = self.units.scaled(self.here), self.lam * self.units.c / self.units.value
        slopes = np.abs(self.mu @ here.jacobian + lam @ here.normal)
        return float(slopes.sum()) + self.kkt.complementarity

    def patience(self, tolerance: float, exact: bool = True) -> Status | None:
        """How it ends here, if it is optimal or nothing has become better for long.

        exact: whether QPs are solved to a tolerance; else a violation may be there to stay.
        """
        if self.kkt.residual <= tolerance:
            return Status.CONVERGED
        if self.idle >= PATIENCE and (self.kkt.violation <= tolerance or not exact):
            return Status.STALLED
        return None

    def is_nearly_optimal(self, tolerance: float) -> bool:
        """Whether what is offered is the rounding of the value, or of that at the start."""
        kkt, start = self.kkt, self.least / NOTHING
        offered = max(kkt.stationarity, kkt.complementarity) * self.units.value
        nothing = offered <= EPS * start and kkt.violation <= tolerance
        return nothing or kkt.residual <= NEARLY * tolerance

    def moved(self, move: Array, x: X, there: Linear) -> Iterate[X]:
        """At the end of a step, less damped."""
        quasi = self.quasi and self.quasi.update(move, self.here, there, self.mu, self.lam)
        damping = self.damping / 10.0 if self.damping > 1e-6 else 0.0
        gone = self.gone + move
        reach = np.maximum(self.reach, np.abs(gone))
        return replace(self, x=x, here=there, quasi=quasi, damping=damping, gone=gone, reach=reach)

    def damped(self) -> Iterate[X]:
        """The same point, more damped, since no step led on."""
        return replace(self, damping=max(10.0 * self.damping, 1e-3))

    def arrived(self, tolerance: float, exact: bool = True) -> Status | None:
        """How it ends after a step, if the point is optimal or no damping helps any more."""
        if self.kkt.residual <= tolerance:
            return Status.CONVERGED
        if self.damping > MOST_DAMPING:
            return Status.INFEASIBLE if exact and self.kkt.violation > tolerance else Status.STALLED
        return None


def priced(at: Iterate[X], plan: Plan, tolerance: float) -> Array | None:
    """(l,) the next prices of violations; None where no price makes the constraints agree."""
    c, lower, upper = at.units.c, at.problem.lower, at.problem.upper
    if plan.relaxed is None:
        return np.asarray(np.maximum(at.price, 1.5 * np.abs(plan.lam * c).max(initial=0.0) / c))
    price = np.maximum(at.price, plan.relaxed)
    if not hopeless(at.units.scaled(at.here), plan.d / at.reach, lower / c, upper / c, tolerance):
        return price
    return None if np.all(price > RELENTLESS * at.fair) else 10.0 * price


@dataclass(frozen=True, eq=False)
class Plan:
    """An answer of the QP: step d, multipliers, and which backend gave it.

    exact: whether the answer kept the tolerance; else it is one that is used as it is.
    relaxed: (l,) prices at which it may violate constraints that contradict each other.
    """

    d: Array
    mu: Array
    lam: Array
    usable: bool
    backend: str
    notes: tuple[str, ...]
    exact: bool = True
    relaxed: Array | None = None


Resolve = Callable[[Array, Array], Plan]


def given(answer: Solution) -> bool:
    """Whether a QP has an answer, exact or not: what it is good for the search finds out."""
    return answer.usable or (
        answer.status is QpStatus.INACCURATE and bool(np.isfinite(answer.x).all())
    )


def forgotten(here: Linear, rows: Array, solution: Solution) -> Array:
    """Functions beyond the chosen rows that an answer of the epigraph QP makes larger than v.

    All, where there is no answer.
    """
    k, p = here.jacobian.shape
    if len(rows) == k:
        return rows[:0]
    if not given(solution):
        return np.setdiff1d(np.arange(k), rows)
    over = here.f - here.f.max() + here.jacobian @ solution.x[:p] - solution.x[p]
    over[rows] = -np.inf
    found = np.flatnonzero(over > 0.0)
    return found[np.argsort(-over[found])[:p]]


def epigraph(
    here: Linear, largest: float, hessian: Array, lower: Array, upper: Array, decrease: float
) -> Problem:
    """min 1/2 d'Hd + v with rows f - largest + f'd <= v and lower - c <= c'd <= upper - c.

    decrease: about how far v may fall.
    """
    k, p = here.jacobian.shape
    rows = np.zeros((k + len(here.c), p + 1))
    rows[:k, :p], rows[:k, p], rows[k:, :p] = here.jacobian, -1.0, here.normal
    quadratic = np.zeros((p + 1, p + 1))
    quadratic[:p, :p] = hessian
    quadratic[p, p] = min(MAX_DECREASE_CURVATURE, NEGLIGIBLE_FORCE / max(decrease, EPIGRAPH))
    linear = np.zeros(p + 1)
    linear[p] = 1.0
    low = np.concatenate([np.full(k, -np.inf), lower - here.c])
    high = np.concatenate([largest - here.f, upper - here.c])
    return Problem(quadratic, linear, rows, low, high)


def elastic(problem: Problem, k: int, price: Array) -> Problem:
    """The same QP with slacks s, t >= 0 on its constraint rows: c'd + s - t, at a price each."""
    n, m = len(problem.q), len(problem.l)
    slack = np.zeros((m, 2 * (m - k)))
    slack[k:] = np.hstack([np.eye(m - k), -np.eye(m - k)])
    rows = np.block([[problem.A, slack], [np.zeros((2 * (m - k), n)), np.eye(2 * (m - k))]])
    quadratic = np.zeros((n + 2 * (m - k),) * 2)
    quadratic[:n, :n] = problem.P
    quadratic[n:, n:] = EPIGRAPH * np.eye(2 * (m - k))
    linear = np.concatenate([problem.q, price, price])
    low = np.concatenate([problem.l, np.zeros(2 * (m - k))])
    high = np.concatenate([problem.u, np.full(2 * (m - k), np.inf)])
    return Problem(quadratic, linear, rows, low, high)


def read(answer: Solution, here: Linear, rows: Array, units: Units) -> Plan:
    """Step and multipliers of a QP answer; mu is brought back to sum one exactly.

    rows: the functions that the QP knew.  units: of the QP.
    """
    k, p = here.jacobian.shape
    usable, few = given(answer), len(rows)
    mu = np.zeros(k) if usable else np.full(k, 1.0 / k)
    if usable:
        mu[rows] = np.maximum(answer.y[:few], 0.0)
    total = mu.sum()
    lam = answer.y[few : few + len(here.c)] if usable else np.zeros(len(here.c))
    return Plan(
        d=answer.x[:p] * units.x if usable else np.zeros(p),
        mu=mu / total if total > 0.0 else np.full(k, 1.0 / k),
        lam=lam * units.value / units.c,
        usable=usable,
        backend=answer.backend,
        notes=answer.notes,
        exact=answer.solved or not usable,
    )


def optimality(here: Linear, mu: Array, lam: Array, lower: Array, upper: Array) -> Kkt:
    """The KKT residuals at a point."""
    stationarity = mu @ here.jacobian + lam @ here.normal
    complementarity = float(mu @ (here.f.max() - here.f))
    if lam.any():
        held = np.flatnonzero(lam)  # elsewhere a bound may be infinitely far
        room = np.where(lam > 0.0, upper - here.c, here.c - lower)[held]
        complementarity += float(np.abs(lam[held] * room).sum())
    return Kkt(
        float(np.abs(stationarity).max(initial=0.0)),
        complementarity,
        float(excess(here.c, lower, upper).max(initial=0.0)) if len(lam) else 0.0,
    )


def multipliers_at(here: Linear, lower: Array, upper: Array) -> tuple[Array, Array]:
    """mu and lam that make stationarity and complementarity at a point least, mu of sum one.

    Non-negative least squares, so that nothing of a QP solver is in them.
    """
    from scipy.optimize import nnls

    k, (above, below) = (
        len(here.f),
        (np.flatnonzero(upper < np.inf), np.flatnonzero(lower > -np.inf)),
    )
    columns = np.concatenate([here.jacobian, here.normal[above], -here.normal[below]]).T
    if not np.all(np.isfinite(columns)):
        return np.full(k, 1.0 / k), np.zeros(len(here.c))
    rooms = (here.f.max() - here.f, (upper - here.c)[above], (here.c - lower)[below])
    room = np.maximum(np.concatenate(rooms), 0.0)
    one = 1e3 * (np.arange(len(room)) < k)  # heavy: the sum is then one but for a millionth
    found, _ = nnls(
        np.vstack([columns, np.diag(room), one]), np.append(np.zeros(len(columns) + len(room)), 1e3)
    )
    found = found / found[:k].sum()
    lam = np.zeros(len(here.c))
    lam[above] += found[k : k + len(above)]
    lam[below] -= found[k + len(above) :]
    return found[:k], lam


def hopeless(here: Linear, d: Array, lower: Array, upper: Array, tolerance: float) -> bool:
    """Whether constraints are violated and the relaxed QP sees no way to violate them less."""
    now = excess(here.c, lower, upper).sum()
    ahead = excess(here.c + here.normal @ d, lower, upper).sum()
    return bool(now > tolerance and ahead > (1.0 - 1e-6) * now)


def excess(c: Array, lower: Array, upper: Array) -> Array:
    """(l,) by how much each constraint is violated."""
    return np.asarray(np.maximum(np.maximum(c - upper, lower - c), 0.0))


def search(at: Iterate[X], plan: Plan, resolve: Resolve) -> tuple[float, Array, X, Linear]:
    """A step that lowers max f + price @ violation: its length (0 if none), move and end.

    The full step is nearly always taken, so its derivatives are computed at once.  resolve: solves
    the QP again with other values f, c, for the second-order correction.
    """
    problem, x, here = at.problem, at.x, at.here

    def merit(f: Array, c: Array) -> float:
        value = float(f.max())
        if len(c):
            value += float(at.price @ excess(c, problem.lower, problem.upper))
        return value if np.isfinite(value) else float("inf")

    start = merit(here.f, here.c)
    ahead = merit(here.f + here.jacobian @ plan.d, here.c + here.normal @ plan.d)
    decrease = start - ahead
    slack = ROUNDING * abs(start) + EPS * at.terms
    trial = problem.step(x, plan.d)
    there = problem.linearise(trial)
    value = merit(there.f, there.c)
    if value <= start - 1e-4 * decrease + slack:
        falls_on = value - merit(there.f + there.jacobian @ plan.d, there.c + there.normal @ plan.d)
        length = 1.0
        if at.quasi is not None and falls_on > MIN_FALLING_SLOPE * decrease > slack:
            length = lengthen(at, plan.d, merit, start, value)
        if length == 1.0:
            return 1.0, plan.d, trial, there
        move = length * plan.d
        trial = problem.step(x, move)
        return length, move, trial, problem.linearise(trial)
    if np.isfinite(value):
        # what the linear model missed at the full step goes into the constants
        bent = resolve(there.f - here.jacobian @ plan.d, there.c - here.normal @ plan.d)
        if bent.usable and np.linalg.norm(bent.d / at.lengths) <= 2.0 * np.linalg.norm(
            plan.d / at.lengths
        ):
            trial = problem.step(x, bent.d)
            there = problem.linearise(trial)
            if merit(there.f, there.c) <= start - 1e-4 * decrease + slack:
                return 1.0, bent.d, trial, there
    length = 1.0
    while length * decrease > slack:  # what falls by less tells nothing
        curved = 2.0 * (value - start + length * decrease)
        fit = length**2 * decrease / curved if np.isfinite(value) and curved > 0 else 0.0
        length = min(max(fit, 0.1 * length), 0.5 * length)
        move = length * plan.d
        trial = problem.step(x, move)
        value = merit(*problem.evaluate(trial))
        if value <= start - 1e-4 * length * decrease + slack:
            return length, move, trial, problem.linearise(trial)
    return 0.0, np.zeros_like(plan.d), x, here


def lengthen(
    at: Iterate[X], d: Array, merit: Callable[[Array, Array], float], start: float, value: float
) -> float:
    """How many times the step d to go, doubled while the merit falls well.

    Where an estimated Hessian is far too large, as after steps through functions that grow fast.
    start, value: merits here and after d.  A step ends where a linearised constraint does.
    """
    here, lower, upper = at.here, at.problem.lower, at.problem.upper
    length = 1.0
    while length < MAX_LENGTHENING:
        ends = here.c + 2.0 * length * (here.normal @ d)
        if np.any(excess(ends, lower, upper) > excess(here.c, lower, upper)):
            break
        farther = merit(*at.problem.evaluate(at.problem.step(at.x, 2.0 * length * d)))
        if not value - farther > min(0.1 * (start - value), 0.5 * abs(value)):
            break
        length, value = 2.0 * length, farther
    return length


@dataclass(frozen=True, eq=False)
class Bfgs:
    """A damped BFGS estimate of the Hessian of the Lagrangian [Powell 1978]."""

    matrix: Array
    fresh: bool

    @staticmethod
    def start(here: Linear, curvature: Array) -> Bfgs:
        """The mean Gauss-Newton Hessian where there is one, else a guess of its diagonal (p,)."""
        mean = here.curvature(np.full(len(here.f), 1.0 / len(here.f)))
        if len(mean):
            return Bfgs(mean + 1e-3 * np.diag(np.diag(mean)), fresh=False)
        return Bfgs(np.diag(curvature), fresh=True)

    def update(self, s: Array, before: Linear, after: Linear, mu: Array, lam: Array) -> Bfgs:
        """With the change of the Lagrangian's gradient over the step s, same multipliers."""
        q = (after.jacobian - before.jacobian).T @ mu + (after.normal - before.normal).T @ lam
        length = float(s @ s)
        if length == 0.0 or not np.all(np.isfinite(q)):
            return self
        matrix = self.matrix
        if self.fresh and q @ s > 0:  # size of the first guess [Nocedal and Wright, eq. 6.20]
            guess = np.diag(matrix)
            matrix = float(q @ (q / guess)) / float(q @ s) * matrix
        bs = matrix @ s
        curve = float(s @ bs)
        if curve <= 0.0:
            return self
        if float(q @ s) < 0.2 * curve:
            share = 0.8 * curve / (curve - float(q @ s))
            q = share * q + (1.0 - share) * bs
        bs, q = bs / np.sqrt(curve), q / np.sqrt(float(q @ s))  # first, against overflow
        new = matrix - np.outer(bs, bs) + np.outer(q, q)
        new = 0.5 * (new + new.T)
        if not is_positive_definite(new):  # by rounding, of entries of many sizes
            new = np.diag(np.maximum(np.diag(new), EPS * np.diag(matrix)))
        return Bfgs(new, fresh=False)


def is_positive_definite(matrix: Array) -> bool:
    """Whether a symmetric matrix has a Cholesky factor; also where it holds no numbers."""
    try:
        np.linalg.cholesky(matrix)
    except np.linalg.LinAlgError:
        return not bool(np.all(np.isfinite(matrix)))
    return True
