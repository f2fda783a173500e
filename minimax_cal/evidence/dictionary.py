"""What may explain the error of a problem: laws, and the protocol of whoever knows them.

A dictionary knows its domain (an arm, torques along a trajectory, what moved between two
calibrations); the engine knows only columns, priors and prices.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol

from minimax_cal.evidence.noise import Noise, Problem
from minimax_cal.ground.arrays import Array

Key = tuple[str, str]


@dataclass(frozen=True, eq=False)
class Spec:
    """A law at a place, with the rows it would add to the error.

    term: what the dictionary calls it.  text: its unique name; key: its family and its place.
    columns: (N, d) rows per unit of each parameter.  doubts: (N, r) by which these may differ, one
    sigma per unit of the parameter owner (r,).  nonnegative: (d,) True for parameters that are
    never below 0.  typical: the usual size of a parameter.  tuned: numbers of the law that are
    searched, and cost as parameters do.  repeats: whether one place may hold several of the family.
    """

    term: Any
    text: str
    key: Key
    columns: Array
    doubts: Array
    owner: Array
    nonnegative: Array
    typical: float
    tuned: int
    repeats: bool


class Dictionary(Protocol):
    """The laws of a domain, for one problem."""

    @property
    def problem(self) -> Problem:
        """Whose rows the columns are."""

    def spec(self, term: Any) -> Spec | None:
        """A law with its columns; None where it adds nothing to any row."""

    def finer(self, term: Any) -> Sequence[Any]:
        """The law with its tuned numbers closer together about those given; empty for none."""

    def lines(self, noise: Noise, known: Array, found: Sequence[Any]) -> list[tuple[Any, float]]:
        """Lines that what is left shows, with how many frequencies were tried for each.

        known: (N, q) columns fitted already.  found: lines chosen.
        """

    def is_expected(self, line: Any, found: Sequence[Any]) -> bool:
        """Whether a line is where the domain expects one, beside those found."""
