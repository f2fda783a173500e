"""Quadratic programs by any solver, each answer judged by one formula; knows no robot."""

from __future__ import annotations

from .accuracy import Accuracy, accuracy
from .elimination import eliminate
from .judge import solve
from .problem import BackendError, Problem, ProblemError, Solution, Status
from .registry import available, fallback_order, names, register

__all__ = [
    "Accuracy",
    "BackendError",
    "Problem",
    "ProblemError",
    "Solution",
    "Status",
    "accuracy",
    "available",
    "eliminate",
    "fallback_order",
    "names",
    "register",
    "solve",
]
