"""Runs that are one, and torques that repeat to the digit while the motion does not."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations

import numpy as np

from minimax_cal.dynamics.logs.draft import Draft
from minimax_cal.ground.arrays import Array
from minimax_cal.ground.errors import DataError

WORD = 4  # rows that have to follow each other alike
MOST_ALIKE = 0.2  # share of a run's words of torque that may stand elsewhere


def words(values: Array) -> Array:
    """Rows that follow each other, WORD at a time, a number for each; repeated rows count once."""
    fresh = np.append(True, (values[1:] != values[:-1]).any(axis=1))
    bits = np.ascontiguousarray(values[fresh], dtype=float).view(np.uint64)
    count, random = max(len(bits) - WORD + 1, 0), np.random.default_rng(0)
    mixed = bits @ (2 * random.integers(2**63, size=(bits.shape[1], WORD), dtype=np.uint64) + 1)
    return np.asarray(sum(mixed[i : i + count, i] for i in range(WORD)))


def check_repeats(drafts: Sequence[Draft]) -> None:
    """Raise DataError for a run given twice, or torques equal to the digit in other motions."""
    said = [words(draft.torque) for draft in drafts]
    of_torque = [np.unique(every) for every in said]
    for a, b in combinations(range(len(drafts)), 2):
        few = min(len(of_torque[a]), len(of_torque[b]))
        if alike(of_torque[a], of_torque[b]) <= MOST_ALIKE * few:
            continue
        one, other = drafts[a], drafts[b]
        moved = np.unique(words(one.q)), np.unique(words(other.q))
        if alike(*moved) > MOST_ALIKE * min(map(len, moved)):
            raise DataError(
                f"{other.log.source}: run {other.name} holds rows of {one.name}; give each once"
            )
        raise DataError(
            f"{other.log.source}: torques of run {other.name} equal those of {one.name} to the "
            "digit, but the motions differ: they are commands; log the measured ones"
        )
    for draft, every, torque in zip(drafts, said, of_torque, strict=True):
        if within(draft, every, len(every) - len(torque)):
            raise draft.error(
                "torques repeat to the digit while the motion differs: they are commands; log the "
                "measured ones"
            )


def alike(one: Array, other: Array) -> int:
    """How many words two runs share."""
    return len(np.intersect1d(one, other, assume_unique=True))


def within(draft: Draft, said: Array, repeated: int) -> bool:
    """Whether torques of one run repeat to the digit, and its motion does not.

    said: their words, of which so many stand there before.
    """
    if len(said) <= WORD or repeated <= MOST_ALIKE * len(said):
        return False
    moved = words(draft.q)
    return len(moved) - len(np.unique(moved)) < 0.5 * repeated
