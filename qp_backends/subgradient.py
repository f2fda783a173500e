"""Primal-dual first-order methods: restarted averaged PDHG, and paper M's subgradient as printed.

All variants move along T = (∂L/∂x, -∂L/∂y) of the Lagrangian L = ½xᵀPx + qᵀx + yᵀ(Ax - bound).

"raw" is the paper's Algorithm 1 for the QP as it stands [M eq. 22-24; Boyd, Subgradient Methods,
primal-dual subgradient method]: steps of length 1/k along T/‖T‖, the last iterate is the answer.
Only rows that are violated enter T, each with its multiplier, and a multiplier grows with every
violation and never shrinks; the paper leaves Boyd's augmentation out (rho = 0).
"eliminated" is the same on the eliminated form of an epigraph problem (`elimination`), eq. 20-27.

"restarted", the default, is another method that starts from the same T: the primal-dual hybrid
gradient (PDHG) of Chambolle and Pock, restarted and averaged as in PDLP.  From "raw" to it:
1. x is measured in the metric of P (whitening) and rows are scaled to length 1, so that one step
   length suits all directions.
2. Multipliers keep the sign of their side by projection, so that they can shrink again.
3. The quadratic term is taken at the new x (in the metric of P that is a division) and the rows at
   the extrapolated point 2x⁺ - x: constant steps then converge [Chambolle and Pock 2011].
4. Iterates are averaged; the better of average and last iterate starts the method afresh whenever
   it has become much better than the start was, which makes the convergence linear on quadratic
   programs, and the ratio of dual to primal step length, the radius that the user of the raw
   method must guess, follows the distances travelled [PDLP: Applegate et al. 2021, 2023].
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cache
from itertools import count
from typing import Any

import numpy as np

from .accuracy import accuracy
from .elimination import eliminate, restore
from .problem import COLD, Array, BackendError, Problem, Solution, Status, dense

METHODS = {"restarted": 100_000, "raw": 10_000, "eliminated": 10_000}  # name: iteration limit
LARGEST = 3000  # variables and rows; whitening costs their third power
NEARLY_FLAT = 1e-5  # of the largest curvature: less decides nothing about a direction's unit
COMPILE_AFTER = 2_000  # iterations after which compiling the loop pays


def solve(
    problem: Problem,
    *,
    method: str = "restarted",
    tolerance: float = 1e-8,
    time_limit: float = math.inf,
    warm_start: Solution = COLD,
    iterations: int = 0,
) -> Solution:
    """Iterate until the accuracy is at most the tolerance, or a limit is reached.

    iterations: their largest number; 0 for what stands in METHODS.
    """
    start = time.perf_counter()
    most = iterations or METHODS.get(method, 0)
    answer, status = COLD, Status.ITERATION_LIMIT
    for answer in iterate(problem, method, warm_start):
        if accuracy(problem, answer).worst <= tolerance:
            status = Status.SOLVED
        elif answer.iterations >= most:
            status = Status.ITERATION_LIMIT
        elif time.perf_counter() - start > time_limit:
            status = Status.TIME_LIMIT
        else:
            continue
        break
    seconds = time.perf_counter() - start
    fits = warm_start.x.shape == problem.q.shape and warm_start.y.shape == problem.l.shape
    return Solution(
        answer.x, answer.y, status, seconds, "subgradient", iterations=answer.iterations,
        warm=fits and method == "restarted",
    )  # fmt: skip


def iterate(
    problem: Problem, method: str = "restarted", warm_start: Solution = COLD, every: int = 64
) -> Iterator[Solution]:
    """The iterates, one every so many iterations, for ever: accuracy against iterations.

    method: one of METHODS.  every: iterations between two of them.
    """
    check(method)
    if max(problem.A.shape) > LARGEST:
        raise BackendError(f"the subgradient method is for up to {LARGEST} variables and rows")
    if method == "restarted":
        return _restarted(problem, warm_start, every)
    if method == "raw":
        return _raw(problem, every)
    elimination = eliminate(problem)
    return (restore(elimination, answer) for answer in _raw(elimination.problem, every))


def check(method: str) -> None:
    """Refuse a name that is not a method."""
    if method not in METHODS:
        raise BackendError(f"no subgradient method {method!r}; choose one of {', '.join(METHODS)}")


@dataclass(frozen=True, eq=False)
class Scaled:
    """The problem in w, x = T w: minimise ½ Σ d w² + cᵀw with low ≤ Bw ≤ high, rows of length 1.

    B: (m, n).  c, d: (n,), d is 1 where P has curvature.  low, high, row: (m,).  T: (n, n).
    """

    B: Array
    c: Array
    d: Array
    low: Array
    high: Array
    row: Array
    T: Array

    def start(self, guess: Solution) -> tuple[Array, Array]:
        """A guess of x and y in these coordinates, or zeros."""
        if guess.x.shape != self.c.shape or guess.y.shape != self.low.shape:
            return np.zeros(self.c.shape), np.zeros(self.low.shape)
        w = self.T.T @ guess.x / np.einsum("ij,ij->j", self.T, self.T)  # columns are orthogonal
        return np.nan_to_num(w), np.nan_to_num(guess.y * self.row)

    def error(self, w: Array, y: Array) -> float:
        """Size of all optimality residuals together, in these coordinates."""
        Bw = self.B @ w
        bound = np.where(y > 0, self.high, np.where(y < 0, self.low, 0.0))
        gap = w @ (self.d * w + self.c) + y @ bound
        outside = Bw - np.minimum(np.maximum(Bw, self.low), self.high)
        uneven = self.d * w + self.c + y @ self.B
        return math.sqrt(outside @ outside + uneven @ uneven + float(gap) ** 2)


def scaled(problem: Problem) -> Scaled:
    """Whiten: coordinates in which P is the identity where it has curvature.

    A direction with (nearly) none gets the scale at which the rows that feel it feel it as much as
    all the others together: a much larger one would make these rows nearly parallel.
    """
    P, A = dense(problem.P), dense(problem.A)
    curvature, V = np.linalg.eigh(P)
    largest = float(curvature.max(initial=0.0))
    bent = curvature > NEARLY_FLAT * largest
    B = A @ V
    scale = 1.0 / np.sqrt(np.where(bent, curvature, 1.0))
    square = B**2
    felt = square.sum(axis=0)
    feel = square > 1e-16 * felt
    others = (square * np.where(bent, scale, 0.0) ** 2).sum(axis=1) @ feel
    others /= np.maximum(np.minimum(feel.sum(axis=0), np.count_nonzero(bent)), 1)
    flat = ~bent & (felt > 0)
    scale[flat] = np.sqrt(np.where(others[flat] > 0, others[flat], 1.0) / felt[flat])
    B = B * scale
    row = np.sqrt(np.einsum("ij,ij->i", B, B))
    row = np.where(row > 0, row, 1.0)
    return Scaled(
        B=np.ascontiguousarray(B / row[:, None]),
        c=(V.T @ problem.q) * scale,
        d=np.maximum(curvature, 0.0) * scale**2,
        low=problem.l / row,
        high=problem.u / row,
        row=row,
        T=V * scale,
    )


def _restarted(problem: Problem, warm_start: Solution, every: int) -> Iterator[Solution]:
    """The usable method: steps, averages, restarts."""
    form = scaled(problem)
    length = 0.99 / (float(np.linalg.norm(form.B, 2)) if form.B.size else 1.0)
    ratio = 1.0  # dual over primal step length
    w, y = form.start(warm_start)
    origin, first = (w, y), form.error(w, y)
    total, since, before = 0, 0, math.inf
    sums = np.zeros(w.shape), np.zeros(y.shape)
    while True:
        run = _compiled(_steps) if total >= COMPILE_AFTER else _steps
        w, y, *new = run(
            form.B, form.c, form.d, form.low, form.high,
            w, y, length / ratio, length * ratio, every,
        )  # fmt: skip
        sums = sums[0] + new[0], sums[1] + new[1]
        total, since = total + every, since + every
        mean = sums[0] / since, sums[1] / since
        best = min(((w, y), mean), key=lambda pair: form.error(*pair))
        error = form.error(*best)
        yield _answer(form, *best, total)
        enough = error <= 0.2 * first
        stalls = error <= 0.8 * first and error > before
        if enough or stalls or since >= 0.36 * total:
            ratio = _ratio(ratio, origin, best)
            (w, y), origin, first = best, best, error
            since, before = 0, math.inf
            sums = np.zeros(w.shape), np.zeros(y.shape)
        else:
            before = error


def _ratio(ratio: float, start: tuple[Array, Array], end: tuple[Array, Array]) -> float:
    """The ratio of step lengths after a stretch: half way to that of the distances travelled."""
    primal, dual = (float(np.linalg.norm(b - a)) for a, b in zip(start, end, strict=True))
    return math.sqrt(ratio * dual / primal) if min(primal, dual) > 1e-12 else ratio


def _answer(form: Scaled, w: Array, y: Array, total: int) -> Solution:
    return Solution(form.T @ w, y / form.row, Status.ITERATION_LIMIT, 0.0, iterations=total)


def _steps(
    B: Array, c: Array, d: Array, low: Array, high: Array,
    w: Array, y: Array, primal: float, dual: float, steps: int,
) -> tuple[Array, Array, Array, Array]:  # fmt: skip
    """Some steps of PDHG and the sums of their iterates; NumPy or compiled."""
    shrink = 1.0 / (1.0 + primal * d)
    sum_w, sum_y = np.zeros(w.shape), np.zeros(y.shape)
    low, high = dual * low, dual * high
    for _ in range(steps):
        new = (w - primal * (c + y @ B)) * shrink
        t = y + dual * (B @ (2.0 * new - w))
        y = t - np.minimum(np.maximum(t, low), high)
        w = new
        sum_w += w
        sum_y += y
    return w, y, sum_w, sum_y


def _raw(problem: Problem, every: int) -> Iterator[Solution]:
    """The paper's Algorithm 1, two-sided rows written as two."""
    P, A = dense(problem.P), dense(problem.A)
    above, below = np.flatnonzero(problem.u < np.inf), np.flatnonzero(problem.l > -np.inf)
    G = np.concatenate([A[above], -A[below]])
    h = np.concatenate([problem.u[above], -problem.l[below]])
    x, z = np.zeros(problem.q.shape), np.zeros(h.shape)
    for chunk in count():
        run = _compiled(_raw_steps) if chunk * every >= COMPILE_AFTER else _raw_steps
        x, z = run(P, problem.q, G, h, x, z, chunk * every, every)
        y = np.zeros(problem.l.shape)
        y[above] += z[: above.size]
        y[below] -= z[above.size :]
        yield Solution(x, y, Status.ITERATION_LIMIT, 0.0, iterations=(chunk + 1) * every)


def _raw_steps(
    P: Array, q: Array, G: Array, h: Array, x: Array, z: Array, done: int, steps: int
) -> tuple[Array, Array]:
    """Some steps of length 1/k along T/‖T‖, after `done` earlier ones [M eq. 22-24]."""
    for k in range(done + 1, done + steps + 1):
        violation = np.maximum(G @ x - h, 0.0)
        slope = P @ x + q + np.where(violation > 0.0, z, 0.0) @ G
        size = math.sqrt(slope @ slope + violation @ violation)
        if size > 0.0:
            x = x - slope / (k * size)
            z = z + violation / (k * size)
    return x, z


@cache
def _compiled(loop: Callable[..., Any]) -> Callable[..., Any]:
    """The loop compiled by numba where that is installed; the results agree to rounding."""
    try:
        from numba import njit
    except ImportError:
        return loop
    compiled: Callable[..., Any] = njit(cache=True)(loop)
    return compiled
