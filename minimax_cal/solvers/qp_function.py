"""A caller's function as a QP solver whose answers are judged."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from minimax_cal.core.arrays import Array
from minimax_cal.core.errors import OptionError
from minimax_cal.solvers.epigraph_qp import VerifiedQpSolver
from qp_backends import Problem, Solution, accuracy
from qp_backends import Status as QpStatus
from qp_backends.multipliers import estimate_multipliers
from qp_backends.problem import COLD

QpFunction = Callable[[Problem], Any]  # to x (n,), (x, y) or a Solution
MAX_USABLE_QP_VIOLATION = 1e-2  # relative violation above which an answer is none


def build_verified_qp_solver(
    qp: QpFunction, tolerance: float, name: str = "qp"
) -> VerifiedQpSolver:
    """A solver from a function of the problem alone; its answers are judged by `accuracy`.

    tolerance: up to which relative residual an answer counts as solved.  name: of the backend,
    where the answer gives none.
    """

    def run(problem: Problem, /, *, warm_start: Solution = COLD) -> Solution:
        answer = convert_qp_answer(problem, qp(problem))
        answer = answer if answer.backend else replace(answer, backend=name)
        judged = accuracy(problem, answer)
        if not answer.y.size and answer.x.size:
            return answer
        status = answer.status
        if judged.worst <= tolerance:
            status = QpStatus.SOLVED
        elif not judged.primal_relative <= MAX_USABLE_QP_VIOLATION:
            status = QpStatus.FAILED
        elif status is QpStatus.SOLVED:
            status = QpStatus.INACCURATE
        return replace(answer, status=status, residual=judged.worst)

    return run


def convert_qp_answer(problem: Problem, answer: Any) -> Solution:
    """x (n,), (x, y), a Solution or None as a Solution.  Raises OptionError for anything else."""
    if isinstance(answer, Solution):
        return answer
    n, m = problem.q.shape, problem.l.shape
    if answer is None:
        return Solution(np.full(n, np.nan), np.full(m, np.nan), QpStatus.FAILED, 0.0)
    try:
        x, y = answer if isinstance(answer, tuple) and len(answer) == 2 else (answer, None)
        x = to_vector(x, n)
        y = estimate_multipliers(problem, x) if y is None else to_vector(y, m)
    except (TypeError, ValueError):
        raise OptionError(
            f"qp is to return x ({n[0]},), (x, y) with y ({m[0]},), or a Solution, "
            f"not {type(answer).__name__}"
        ) from None
    return Solution(x, y, QpStatus.SOLVED, 0.0)


def to_vector(numbers: Any, shape: tuple[int, ...]) -> Array:
    """Numbers as a vector of a shape.  Raises ValueError."""
    vector = np.array(numbers, dtype=float).reshape(-1)
    if vector.shape != shape:
        raise ValueError(f"shape {vector.shape}")
    return vector
