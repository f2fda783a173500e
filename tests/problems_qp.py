"""Quadratic programs for the tests: with known answers, random, and like those of a calibration."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy import sparse
from scipy.io import loadmat

from qp_backends import Problem

MAROS_MESZAROS = Path(__file__).parents[2] / "shared" / "data" / "maros_meszaros"


def maros_meszaros(path: Path) -> Problem:
    """One problem of the Maros-Meszaros set, sparse."""
    data = loadmat(path)
    P, A = sparse.csc_array(data["P"]), sparse.csc_array(data["A"])
    return Problem(P, data["q"].ravel(), A, data["l"].ravel(), data["u"].ravel())


def epigraph(
    rng: np.random.Generator,
    n: int = 46,
    m: int = 9,
    condition: float = 1e4,
    curvature: float = 1e-8,
) -> Problem:
    """What the SQP of a minimax calibration solves: min ½dᵀHd + v with F_i + gᵢᵀd - F_max ≤ v.

    n: variables, the last of them v.  m: rows.  condition: of H.  curvature: entry of P at v, which
    some solvers need to be positive.  Two thirds of the rows, and at most six, are distance
    constraints |e + aᵀd| ≤ 0.01, without v, as far as m is small; with many rows all are maxima.
    """
    k = n - 1
    basis, _ = np.linalg.qr(rng.normal(size=(k, k)))
    H = (basis * np.geomspace(1.0, 1.0 / condition, k)) @ basis.T
    P = np.zeros((n, n))
    P[:k, :k] = 0.5 * (H + H.T)
    P[k, k] = curvature
    q = np.zeros(n)
    q[k] = 1.0
    pairs = 3 if m == 9 else 0
    maxima = m - pairs
    A = np.zeros((m, n))
    # gradients of sums of squares lie in the range of H, weighted like its square root
    root = (basis * np.sqrt(np.geomspace(1.0, 1.0 / condition, k))) @ basis.T
    A[:, :k] = rng.normal(size=(m, k)) @ root
    A[:maxima, k] = -1.0
    values = np.abs(rng.normal(size=maxima))
    l, u = np.full(m, -np.inf), np.full(m, 0.01)  # noqa: E741
    u[:maxima] = values.max() - values
    l[maxima:] = -0.01
    return Problem(P, q, A, l, u)


def random_problem(rng: np.random.Generator, n: int = 8, rank: int = 5, m: int = 12) -> Problem:
    """A feasible problem with equalities, one- and two-sided rows and open ones; P of some rank."""
    root = rng.normal(size=(rank, n))
    A = rng.normal(size=(m, n))
    center = A @ rng.normal(size=n)
    l, u = center - rng.random(m), center + rng.random(m)  # noqa: E741
    kind = np.arange(m) % 4
    l[kind == 0] = u[kind == 0] = center[kind == 0]
    l[kind == 1] = -np.inf
    u[kind == 2] = np.inf
    return Problem(root.T @ root, root.T @ rng.normal(size=rank), A, l, u)


def any_problem(rng: np.random.Generator) -> Problem:
    """A small problem that may be anything: degenerate, singular, contradictory, unbounded."""
    n, m = int(rng.integers(1, 8)), int(rng.integers(0, 12))
    whole = rng.random() < 0.5

    def draw(*shape: int) -> np.ndarray:
        return rng.integers(-2, 3, size=shape).astype(float) if whole else rng.normal(size=shape)

    root = draw(int(rng.integers(0, n + 1)), n)
    A = draw(m, n) * (rng.random((m, n)) < 0.7)
    if rng.random() < 0.3:
        A = A * 10.0 ** rng.integers(-3, 4, size=(m, 1))
    center = A @ draw(n)
    l, u = center - np.abs(draw(m)), center + np.abs(draw(m))  # noqa: E741
    kind = rng.integers(0, 5, size=m)
    l[kind == 0] = u[kind == 0] = center[kind == 0]
    l[kind == 1] = -np.inf
    u[kind == 2] = np.inf
    if m and rng.random() < 0.2:
        l[0] += 3.0
        u[0] = max(u[0], l[0])
    return Problem(root.T @ root, draw(n) * (rng.random() < 0.9), A, l, u)


def in_units(
    problem: Problem, unit: np.ndarray, row: np.ndarray | float = 1.0, size: float = 1.0
) -> Problem:
    """The same problem for unit * x, rows and objective times a number."""
    rows = np.broadcast_to(row, problem.l.shape)
    return Problem(
        size * problem.P / np.outer(unit, unit), size * problem.q / unit,
        rows[:, None] * problem.A / unit, rows * problem.l, rows * problem.u,
    )  # fmt: skip
