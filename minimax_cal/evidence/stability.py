"""How often a name is found again: the search repeated on subsamples of the groups of rows.

Each round parts the groups at random, and each part is left out in turn, so that every group is as
often asked as any other.  A name's frequency is the share of the subsamples that find it
[Meinshausen and Buehlmann 2010; Shah and Samworth 2013].
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np

from minimax_cal.evidence.bench import Added, Bench
from minimax_cal.evidence.library import Key
from minimax_cal.evidence.limits import (
    BAND,
    ENOUGH,
    INSTEAD,
    LEAST_DOF,
    LEVEL,
    LUCK,
    PARTS,
    REPEATED_LEVEL,
    ROUNDS,
)
from minimax_cal.evidence.selection import NOTHING, Choice, select
from minimax_cal.ground.arrays import Array
from minimax_cal.ground.parallel import share

NOT_ASKED = float("nan")  # the frequency where rows are too few to leave any out


@dataclass(frozen=True)
class Repeats:
    """What searches of the subsamples find.

    names: of those whose rows were enough to ask.  asked: how many subsamples there are.
    """

    names: tuple[frozenset[Key], ...]
    asked: int

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


def halves(group: Array, rounds: int) -> list[Array]:
    """Masks (N,) of the rows of complementary halves.  group: as `subsamples` has it."""
    rng, count = np.random.default_rng(0), int(group.max()) + 1
    first = [(rng.permutation(count) < count // 2)[group] for _ in range(rounds)]
    return [kept for half in first for kept in (half, ~half)]


def subsamples(group: Array) -> list[Array]:
    """Masks (N,) of the rows of each subsample.  group: (N,) from 0, of rows that stay together."""
    rng, count = np.random.default_rng(0), int(group.max()) + 1
    parts = [(rng.permutation(count) % PARTS)[group] for _ in range(ROUNDS)]
    return [part != left for part in parts for left in range(PARTS)]


def repeated(
    whole: Choice,
    masks: Sequence[Array],
    *,
    level: float = REPEATED_LEVEL,
    jobs: int = 1,
    cluster: str = "",
) -> Repeats:
    """The search of subsamples, each choosing among what that of all rows tuned.

    masks: (N,) of the rows of each.  level: chance of a false name in one.  jobs: processes, -1 for
    one a core.  cluster: address of a Dask scheduler instead.
    """
    one = whole.portable()
    calls = [(one, kept, level) for kept in masks]
    found = dict(share(names_in, calls, processes=jobs, cluster=cluster))
    names = [found[number] for number in range(len(masks))]
    return Repeats(tuple(keys for keys in names if keys is not None), len(masks))


def names_in(whole: Choice, kept: Array, level: float) -> frozenset[Key] | None:
    """What the search of a part finds; None where its rows are too few.  kept: (N,) of its rows."""
    part = whole.part(kept)
    if part.products.dof(NOTHING) < LEAST_DOF:
        return None
    return frozenset(c.key for c in select(part, level=level).chosen)


# ---- alternatives --------------------------------------------------------------------------------


def alternatives(table: Bench, one: Added) -> list[tuple[Added, float, float]]:
    """Other effects or places that may be the truth, with rho^2 and the power to tell them apart.

    Those that do nearly as well; and those that do worse by some luck, the data having too little
    power to tell them apart.  Where they have it, what is needed beside another too is no other
    name for it: both are there, or something else is.
    """
    out, seen = [], {one.candidate.key, *(c.key for c in table.chosen)}
    for other in table.everyone:
        if other.candidate.key in seen or other.evidence <= 0.0:
            continue
        close = other.evidence > one.evidence - BAND
        alike = other.candidate.family == one.candidate.family  # as all joints hold one
        if not close and (alike or other.evidence < one.evidence - LUCK):
            continue
        size, rho2 = table.likeness(one, other.candidate)
        power = size * (1.0 - rho2)
        if power < ENOUGH or (close and table.p_beside(one, other.candidate) >= LEVEL):
            seen.add(other.candidate.key)
            out.append((other, rho2, power))
    return out
