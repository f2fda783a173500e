"""How often a name is found again: the search repeated on subsamples of the groups of rows.

Each round parts the groups at random, and each part is left out in turn, so that every group is as
often asked as any other.  A name's frequency is the share of the subsamples that find it
[Meinshausen and Buehlmann 2010; Shah and Samworth 2013].
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, replace

import numpy as np

from minimax_cal.evidence.dictionary import Key
from minimax_cal.evidence.limits import INSTEAD, LEAST_DOF, PARTS, REPEATED_LEVEL, ROUNDS
from minimax_cal.evidence.noise import identified, remaining
from minimax_cal.evidence.selection import NOTHING, Choice, select
from minimax_cal.ground.arrays import Array

NOT_ASKED = float("nan")  # the frequency where rows are too few to leave any out


@dataclass(frozen=True)
class Repeats:
    """What searches of the subsamples find.

    names: of those whose rows were enough to ask.  asked: how many subsamples there are.
    met: square of what effects leave of the rows without which they were sought, over that of
    geometry alone; each row counts as the others determine it.  NaN where rows are too few.
    """

    names: tuple[frozenset[Key], ...]
    asked: int
    met: float

    def frequency(self, keys: Collection[Key]) -> float:
        """The share of subsamples that find one of the keys; NaN where too few can be asked."""
        if 2 * len(self.names) < self.asked:
            return NOT_ASKED
        return sum(not found.isdisjoint(keys) for found in self.names) / len(self.names)

    def instead_of(self, keys: Collection[Key]) -> list[Key]:
        """Names that take the place of keys: found without them, and hardly ever beside them."""
        without = [found for found in self.names if found.isdisjoint(keys)]
        beside = [found for found in self.names if not found.isdisjoint(keys)]
        every = sorted({key for found in without for key in found})
        counts = {key: sum(key in found for found in without) for key in every}
        seldom = {key: sum(key in found for found in beside) < counts[key] for key in every}
        return [key for key in every if seldom[key] and counts[key] >= INSTEAD * len(self.names)]


def subsamples(group: Array) -> list[Array]:
    """Masks (N,) of the rows of each subsample.  group: (N,) from 0, of rows that stay together."""
    rng, count = np.random.default_rng(0), int(group.max()) + 1
    parts = [(rng.permutation(count) % PARTS)[group] for _ in range(ROUNDS)]
    return [part != left for part in parts for left in range(PARTS)]


def repeated(whole: Choice, group: Array) -> Repeats:
    """The search of subsamples, each choosing among what that of all rows tuned."""
    masks = subsamples(group)
    names, squares = [], np.zeros(2)
    for kept in masks:
        part = whole.part(kept)
        if part.products.dof(NOTHING) < LEAST_DOF:
            continue
        choice = select(part, level=REPEATED_LEVEL)
        names.append(frozenset(c.key for c in choice.chosen))
        squares += predicted(choice)
    alone, beside = squares
    met = float(beside / max(alone, 1e-300)) if names else NOT_ASKED
    return Repeats(tuple(names), len(masks), met)


def predicted(choice: Choice) -> Array:
    """(2,) squares of what geometry, and with it effects, leave of rows that were not kept [m^2].

    Rows count by their variance over that of what is left of them: what the rows that were kept do
    not tell of another, the one end of a joint, is no test.
    """
    lib = choice.library
    rows, kept = lib.rows, lib.products.kept
    every, none = choice.noise.weights(rows), np.zeros((len(kept), 0))
    values = [value for value, _ in choice.estimates]
    moved = choice.known @ np.concatenate([*values, np.zeros(0)])
    left = [
        remaining(replace(rows, error=error), every * kept, none)[~kept]
        for error in (rows.error, rows.error - moved)
    ]
    columns = np.concatenate([rows.basis, choice.known], axis=1)
    told = columns[kept] * every[kept, None]
    unit = columns[~kept] @ identified(columns[kept].T @ told)
    share = 1.0 / (1.0 + every[~kept] * (unit**2).sum(axis=1))
    return np.array([share @ one**2 for one in left])
