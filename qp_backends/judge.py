"""Run a backend, judge its answer, and go on to others while it is not good enough."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

from .accuracy import Accuracy, accuracy
from .certificates import proof
from .polish import polish
from .problem import COLD, Problem, Solution, Status, nothing
from .registry import Solver, backend, fallback_order
from .scaling import equilibrate, in_units

NO_ANSWER = (Status.INFEASIBLE, Status.UNBOUNDED, Status.FAILED)
NEAR = 1e-2  # relative residuals up to which an answer is worth polishing; beyond, it is wrong
# Methods of paper M as printed.  They answer every QP, none to a tolerance that an exact solver is
# asked for, and are shown as they are: judged, but not replaced unless that is asked for.
AS_THEY_ARE = ("subgradient:raw", "subgradient:eliminated")
TIGHTER = 1e-3  # what the tolerance is multiplied by when an answer is asked for again


def solve(
    problem: Problem,
    name: str = "daqp",
    *,
    tolerance: float = 1e-8,
    time_limit: float = math.inf,
    warm_start: Solution = COLD,
    fallback: bool | Sequence[str] | None = None,
) -> Solution:
    """Solve a QP with the named backend; its answer is judged, and others take over if need be.

    tolerance: what the worst relative residual of `accuracy` may be, for every backend.
    time_limit: wall time for everything, fallbacks and checks included [s].
    warm_start: an earlier solution of a similar problem, used by backends that can.
    fallback: True for the installed backends in the order of `registry.fallback_order`, False for
    none, or the names to try.  None: True, but a finite answer of a method that is shown as it is
    (`AS_THEY_ARE`) stays, INACCURATE, with its residual and `as_is` set.

    An answer counts as solved if and only if `accuracy` says so, whatever the backend claims.  One
    that is not accurate enough is polished, then asked for again at a tighter tolerance, then the
    next backend is tried; one that runs has half of the time that is left while others wait.
    "Infeasible" and "unbounded" are believed only with a certificate (`certificates.proof`).
    A mistake in `name` or in the data raises BackendError; nothing else is raised.
    """
    start = time.perf_counter()
    run = backend(name)
    share = time_limit if fallback is False else 0.5 * time_limit
    raw = _call(run, problem, tolerance, share, warm_start)
    judged = accuracy(problem, raw)
    worst = judged.worst
    if worst <= tolerance:  # the usual case, kept short
        return Solution(
            raw.x,
            raw.y,
            Status.SOLVED,
            time.perf_counter() - start,
            name,
            worst,
            iterations=raw.iterations,
            warm=raw.warm,
        )
    if fallback is None and name in AS_THEY_ARE and math.isfinite(worst):
        return replace(
            raw, status=Status.INACCURATE, backend=name, residual=worst, as_is=True,
            seconds=time.perf_counter() - start,
        )  # fmt: skip
    given = fallback if fallback is not None else True
    others = fallback_order(problem) if given is True else tuple(given or ())
    queue = (name, *(other for other in others if other != name.partition(":")[0]))
    scaled, s, t = equilibrate(problem)
    to_scaled = partial(in_units, s=1.0 / s, t=1.0 / t)
    job = Job(scaled, tolerance, to_scaled(warm_start), start, start + time_limit)
    return in_units(_persist(job, queue, to_scaled(raw), judged), s, t)


@dataclass(frozen=True, eq=False)
class Job:
    """What all attempts at a problem share; start and until are moments of perf_counter [s]."""

    problem: Problem
    tolerance: float
    warm_start: Solution
    start: float
    until: float

    @property
    def left(self) -> float:
        """Time that is left [s]."""
        return self.until - time.perf_counter()


def _named(name: str) -> Solver:
    """A backend that is looked up when it is called: a missing one is passed over then."""
    return lambda problem, **keywords: backend(name)(problem, **keywords)


def _call(
    run: Solver, problem: Problem, tolerance: float, time_limit: float, warm_start: Solution
) -> Solution:
    """What a backend answers; FAILED with a note when it raises."""
    try:
        return run(problem, tolerance=tolerance, time_limit=time_limit, warm_start=warm_start)
    except (KeyboardInterrupt, SystemExit):
        raise
    except BaseException as error:  # a solver may raise anything; a panic in Rust is no Exception
        return nothing(problem, Status.FAILED, f"raised {type(error).__name__}: {error}")


def _persist(job: Job, queue: Sequence[str], raw: Solution, judged: Accuracy) -> Solution:
    """Improve the first answer, then go through the other backends until one is good enough.

    judged: the first answer's accuracy, which does not depend on units.
    """
    best, asked = nothing(job.problem, Status.FAILED), False
    notes: tuple[str, ...] = ()
    for index, name in enumerate(queue):
        last = index + 1 == len(queue)
        if index:
            share = job.left if last else 0.5 * job.left
            raw = _call(_named(name), job.problem, job.tolerance, share, job.warm_start)
            judged = accuracy(job.problem, raw)
        raw = replace(raw, residual=judged.worst)
        if raw.residual <= job.tolerance:
            return _closed(job, raw, Status.SOLVED, name, notes)
        better = _improved(job, name, raw, judged)
        remark = _remark(name, raw)
        if better.residual <= job.tolerance:
            notes += (f"{remark}; improved to {better.residual:.1e}",)
            return _closed(job, better, Status.SOLVED, name, notes)
        notes += (remark,)
        if better.residual < best.residual:
            best = replace(better, backend=name)
        if not asked and job.left > 0 and (raw.status in NO_ANSWER or last):
            asked = True  # once is enough: the answer does not depend on the backend
            status, certificate = proof(job.problem, job.left)
            if status is not Status.FAILED:
                none = nothing(job.problem, status)
                return _closed(job, replace(none, certificate=certificate), status, name, notes)
        if job.left <= 0:
            return _closed(job, best, Status.TIME_LIMIT, best.backend or name, notes)
    limits = (Status.ITERATION_LIMIT, Status.TIME_LIMIT)
    end = best.status if best.status in limits else Status.INACCURATE
    if not math.isfinite(best.residual):
        end = Status.FAILED
    return _closed(job, best, end, best.backend or queue[0], notes)


def _improved(job: Job, name: str, raw: Solution, judged: Accuracy) -> Solution:
    """An answer after polishing and, if that is not enough, after a second, tighter run.

    Its `residual` is that of what is returned.  Our own subgradient method has to stand on its own:
    its failures are part of what it shows.
    """
    if name.startswith("subgradient"):
        return raw
    better = _polished(job, raw, judged)
    if better.residual <= job.tolerance or raw.status is not Status.SOLVED or job.left <= 0:
        return better
    again = _call(backend(name), job.problem, TIGHTER * job.tolerance, 0.5 * job.left, better)
    judged = accuracy(job.problem, again)
    tighter = _polished(job, replace(again, residual=judged.worst), judged)
    return tighter if tighter.residual < better.residual else better


def _polished(job: Job, answer: Solution, judged: Accuracy) -> Solution:
    """An answer, polished if it is nearly right and not right yet."""
    near = max(judged.primal_relative, judged.dual_relative) <= NEAR  # the gap comes last
    if not near or judged.worst <= job.tolerance:
        return answer
    return polish(job.problem, answer, job.tolerance, judged)


def _remark(name: str, raw: Solution) -> str:
    """One line on an answer that was not good enough."""
    said = "; ".join(raw.notes) or f"said {raw.status.name.lower()}"
    known = math.isfinite(raw.residual)
    return f"{name} {said}, " + (
        f"its relative residual is {raw.residual:.1e}" if known else "it gave no x"
    )


def _closed(
    job: Job, answer: Solution, status: Status, name: str, notes: tuple[str, ...]
) -> Solution:
    """The answer, its `residual` known, with what is known about how it was come by."""
    seconds = time.perf_counter() - job.start
    return replace(answer, status=status, seconds=seconds, backend=name, notes=notes)
