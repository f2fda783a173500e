"""What of a calibrated arm has moved since: score tests of its parameters on a few new poses.

A parameter has moved where its score is larger than chance allows once frame, reflectors, noise and
what the calibration did not know are taken out [Rao 1948], the largest first; the level is shared
among all parameters that are looked at [Bonferroni].
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy import stats

from minimax_cal.ground.arrays import Array
from minimax_cal.ground.errors import DataError
from minimax_cal.ground.tables import Table
from minimax_cal.ground.units import for_people, in_files
from minimax_cal.judging.watching.own import Own
from minimax_cal.judging.watching.placing import Placing, predicts
from minimax_cal.judging.watching.rows import Both, Rows
from minimax_cal.judging.watching.watched import Watched
from minimax_cal.measuring.grouping import groups
from minimax_cal.modelling.parameters import links_of

LEVEL = 0.005  # chance that anything at all is named on an arm that did not move
ZEROS = (
    0.8  # share of it for zero positions, which a knock or a service changes; links have the rest
)
APART = 1e-6  # share of a motion that frame and reflectors do not imitate, of what can be told
CLEARER = 9.0  # by how much a link must explain more than a zero position, in squared sigmas
LIKEWISE = 6.6  # rivals lose less than this, in squared sigmas: the 99 % point of one
OF_POWER = 1.645  # sigmas that a normal variable falls short of in 5 of 100 cases
MOST = 4  # parameters that are named; where more moved, the arm wants a calibration


@dataclass(frozen=True)
class Moved:
    """A parameter that has moved.  by, sigma: [SI].  others: would explain it nearly as well."""

    parameter: str
    by: float
    sigma: float
    unit: str
    p_value: float
    others: tuple[str, ...] = ()

    @property
    def joint(self) -> str:
        """Its joint, as J3."""
        return joint_of(self.parameter)

    def to_dict(self) -> dict[str, Any]:
        """For JSON: lengths in mm, angles in rad."""
        scale, unit = in_files(self.unit)
        return {
            "parameter": self.parameter, "joint": self.joint, "by": scale * self.by,
            "sigma": scale * self.sigma, "unit": unit, "p_value": self.p_value,
            "alternatives": list(self.others),
        }  # fmt: skip


def moved_table(title: str, moved: Sequence[Moved]) -> Table:
    """What moved, in mm and mrad."""
    return Table(
        title,
        ("parameter", "joint", "unit", "by", "sigma", "p-value", "or as well"),
        tuple(
            (m.parameter, m.joint, for_people(m.unit)[1], 1e3 * m.by, 1e3 * m.sigma, m.p_value,
             ", ".join(m.others))
            for m in moved
        ),
        ("", "", "", "+.4f", ".2g", ".2g", ""),
    )  # fmt: skip


def joint_of(parameter: str) -> str:
    """The joint of a link's parameter, as J3."""
    return "J" + parameter.lstrip("abcdefghijklmnopqrstuvwxyz")


def levels(zero: Array) -> Array:
    """(c,) chance that each parameter is named where nothing moved; zero: (c,) as `Candidates`."""
    counts = [max(int(kind.sum()), 1) for kind in (zero, ~zero)]
    return LEVEL * np.where(zero, ZEROS / counts[0], (1.0 - ZEROS) / counts[1])


def picked(square: Array, passed: Array, zero: Array) -> tuple[int, list[int]]:
    """The one of those that passed that explains most, and which would do nearly as well.

    A zero position goes before links that are not clearly better.  square: (c,) what each explains,
    in squared sigmas, -inf where it is not asked.  passed, zero: (c,).
    """
    pick = int(np.argmax(np.where(passed, square + CLEARER * zero, -np.inf)))
    lost = square[pick] - square
    return pick, [int(i) for i in np.argsort(lost) if lost[i] < LIKEWISE and i != pick]


@dataclass(frozen=True, eq=False)
class Candidates:
    """Parameters that may have moved.

    column: (c,) which.  zero: (c,) True for zero positions.  level: (c,) chance that each is named
    where nothing moved.  wider: (c,) by how much its scores spread more than the noises say, as
    the calibration's own poses have them: what the model lacks is no noise.  alike: (c,) True where
    rows with all coordinates alike are asked.  single: (c,) share of their coordinates that so many
    independent ones would be.
    """

    column: Array
    zero: Array
    level: Array
    wider: Array
    alike: Array
    single: Array

    @staticmethod
    def of(watched: Watched, rows: Rows, links: Array) -> Candidates:
        """Those that frame and reflectors cannot imitate.

        links: (p,) True for link parameters that the calibration identified.
        """
        zeros = watched.zeros
        others = np.setdiff1d(np.flatnonzero(links & watched.names.links), zeros)
        kinds = [kind[rows.share(kind, watched.open) > APART] for kind in (zeros, others)]
        zero = np.repeat([True, False], [len(kind) for kind in kinds])
        one, by_noise = np.ones(len(zero)), np.zeros(len(zero), dtype=bool)
        return Candidates(np.concatenate(kinds), zero, levels(zero), one, by_noise, one)

    def without(self, chosen: list[int]) -> Candidates:
        """All but some."""
        return self.only(self.column[~np.isin(self.column, chosen)])

    def only(self, some: Array) -> Candidates:
        """Some of them."""
        kept = np.isin(self.column, some)
        return Candidates(*(part[kept] for part in vars(self).values()))

    def sizes(self, rows: Both) -> tuple[Array, Array]:
        """How large each score is, in sigmas: (c,); its degrees of freedom: (c,)."""
        noise, alike = (each.sizes(self.column) for each in (rows.noise, rows.alike))
        return np.where(self.alike, alike, noise) / self.wider, self.dof(rows.noise)

    def dof(self, rows: Rows) -> Array:
        """(c,) of each score."""
        taken = rows.count - rows.dof + 1  # what is explained is no noise
        return np.asarray(np.maximum(self.single * rows.count - taken, 1.0))

    def sigmas(self, rows: Both) -> Array:
        """(c,) of each parameter's change, where noises are what they were [SI]."""
        noise, alike = (each.sigmas(self.column) for each in (rows.noise, rows.alike))
        return np.asarray(np.where(self.alike, alike, noise) * self.wider)

    def least(self, rows: Both) -> Array:
        """(c,) smallest change that is found in 95 of 100 cases [SI]."""
        return np.asarray(
            self.sigmas(rows) * (critical(self.level, self.dof(rows.noise)) + OF_POWER)
        )

    def widened(self, rows: Both, own: Own, poses: int, seed: int) -> Candidates:
        """The same with `wider` from samples of so many of the calibration's own poses.

        Each is asked by the rows that tell it best then, which the new errors have no part in.
        """
        wider, single = own.spread(self.column, poses, seed), own.single
        one, other = (
            replace(
                self,
                wider=wider[row],
                alike=np.full(len(self.alike), bool(row)),
                single=np.full(len(self.alike), single[row]),
            )
            for row in (0, 1)
        )
        alike = other.least(rows) < one.least(rows)
        return replace(
            self,
            wider=np.where(alike, other.wider, one.wider),
            alike=alike,
            single=np.where(alike, other.single, one.single),
        )

    def clearest(self, rows: Both, group: Array) -> tuple[int, float, tuple[int, ...]] | None:
        """The one that explains most, its p-value and its rivals; None where all may be chance.

        Only one that helps poses it was not estimated from: what mends nothing has not moved.
        group: (m,) poses that are left out at once.
        """
        size, dof = self.sizes(rows)
        p_value = np.asarray(2.0 * stats.t.sf(size, dof))
        passed = p_value <= self.level
        passed[passed] = [predicts(rows.noise, int(i), group) for i in self.column[passed]]
        if not passed.any():
            return None
        pick, near = picked(size**2, passed, self.zero)
        return int(self.column[pick]), float(p_value[pick]), tuple(self.column[near].tolist())


@dataclass(frozen=True, eq=False)
class Search:
    """What was looked for and what was found.

    named: what moved, the clearest first.  first: the rows with nothing moved.  before: placed as
    if nothing had moved; after: with all that did.  looked: what was looked for.
    """

    named: tuple[Moved, ...]
    first: Both
    before: Placing
    after: Placing
    looked: Candidates


def search(watched: Watched, links: Array, own: Own | None, seed: int) -> Search:
    """What moved.

    links: (p,) as in `Candidates.of`.  own: the calibration's own poses, where they are known.
    seed: of samples of these.  Raises DataError for too few poses.
    """
    _, state = watched.start
    rows = first = watched.both(watched.open, state)
    if rows.noise.count <= int(watched.open.sum()):
        raise DataError(
            f"{watched.data.source}: {watched.data.poses} poses do not even tell where instrument "
            "and reflectors are; measure more"
        )
    looked = Candidates.of(watched, rows.noise, links)
    if own is not None:
        looked = looked.widened(rows, own, watched.data.poses, seed)
    names = watched.names.all
    group = groups(watched.data)
    chosen: list[int] = []
    found: list[Moved] = []
    while len(chosen) < MOST and (picked := looked.without(chosen).clearest(rows, group)):
        column, p_value, others = picked
        chosen.append(column)
        found.append(Moved(names[column], 0.0, 0.0, "", p_value, tuple(names[i] for i in others)))
        active = watched.open.copy()
        active[chosen] = True
        rows = watched.both(active, rows.noise.state)
    before, after = Placing(first.noise), Placing(rows.noise)
    return Search(sized(watched, after, found), first, before, after, looked)


def critical(level: Array, dof: Array) -> Array:
    """Sigmas that chance exceeds, either way, with the probabilities given [Student]."""
    return np.asarray(stats.t.isf(0.5 * level, dof))


def sized(watched: Watched, placed: Placing, found: list[Moved]) -> tuple[Moved, ...]:
    """The same with how far each moved, all of them together, and how sure that is."""
    names = watched.names
    change = links_of(placed.state.mdh - watched.cell.robot.mdh)
    sigma = np.linalg.norm(placed.factor(np.zeros_like(watched.root)), axis=1)
    out = []
    for each in found:
        i = names.index(each.parameter)
        by, size = float(change[i]), float(sigma[i])
        out.append(replace(each, by=by, sigma=size, unit=names.units[i]))
    return tuple(out)
