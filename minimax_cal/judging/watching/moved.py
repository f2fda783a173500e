"""What of a calibrated arm has moved since: score tests of its parameters on a few new poses.

A parameter has moved where its score is larger than chance allows once frame, reflectors, noise,
what the calibration did not know and what its model lacks are taken out [Rao 1948], the largest
first; the level is shared among all parameters that are looked at [Bonferroni].
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Any

import numpy as np
import scipy

from minimax_cal.ground.arrays import Array
from minimax_cal.ground.errors import DataError
from minimax_cal.ground.facts import Fact, derived
from minimax_cal.ground.tables import Table
from minimax_cal.ground.units import for_people, in_own_unit
from minimax_cal.judging.watching.both import KNOWN, Both, critical
from minimax_cal.judging.watching.joined import free_columns, joined, lacking
from minimax_cal.judging.watching.placing import Placing
from minimax_cal.judging.watching.rows import Rows
from minimax_cal.judging.watching.watched import Watched
from minimax_cal.modelling.parameters import links_of

FALSE_ALARM = 0.005  # chance that anything at all is named on an arm that did not move
# share of it for zero positions, which a knock or a service changes; links have the rest
ZEROS = 0.8
# share of a motion that frame and reflectors do not imitate, of what can be told
MIN_OWN_MOTION = 1e-6
CLEARER = 9.0  # by how much a link must explain more than a zero position, in squared sigmas
LIKEWISE = 6.6  # rivals lose less than this, in squared sigmas: the 99 % point of one
OF_POWER = 1.645  # sigmas that a normal variable falls short of in 5 of 100 cases
NOTHING = np.zeros(0, dtype=int)
FIRST = ("parameter", "by", "unit", "sigma", "p-value", "or as well")  # on a first screen
MAX_MOVED = 4  # parameters that are named; where more moved, the arm wants a calibration


@dataclass(frozen=True)
class Moved:
    """A parameter that has moved.  by, sigma: [SI].  others: would explain it nearly as well."""

    parameter: str
    by: float
    sigma: float
    unit: str
    p_value: float
    others: Annotated[tuple[str, ...], Fact(key="alternatives")] = ()

    @derived()
    def joint(self) -> str:
        """Its joint, as J3."""
        return joint_of(self.parameter)

    def to_dict(self) -> dict[str, Any]:
        """For JSON: lengths in mm, angles in rad."""
        return in_own_unit(self, "by", "sigma")


def moved_table(title: str, moved: Sequence[Moved]) -> Table:
    """What moved, in mm and mrad."""
    rows = (
        (m.parameter, m.joint, unit, scale * m.by, scale * m.sigma, m.p_value, m.others)
        for m in moved
        for scale, unit in [for_people(m.unit)]
    )
    columns = "parameter | joint | unit | by +.4f | sigma .2g | p-value .2g | or as well"
    return Table.made(title, rows, columns)


def joint_of(parameter: str) -> str:
    """The joint of a link's parameter, as J3."""
    return "J" + parameter.lstrip("abcdefghijklmnopqrstuvwxyz")


def levels(zero: Array) -> Array:
    """(c,) chance that each parameter is named where nothing moved; zero: (c,) as `Candidates`."""
    counts = [max(int(kind.sum()), 1) for kind in (zero, ~zero)]
    return FALSE_ALARM * np.where(zero, ZEROS / counts[0], (1.0 - ZEROS) / counts[1])


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
    where nothing moved.
    """

    column: Array
    zero: Array
    level: Array

    @staticmethod
    def of(watched: Watched, rows: Rows, links: Array) -> Candidates:
        """Those that frame and reflectors cannot imitate.

        links: (p,) True for link parameters that the calibration identified.
        """
        zeros = watched.zeros
        others = np.setdiff1d(np.flatnonzero(links & watched.names.links), zeros)
        kinds = [kind[rows.share(kind, watched.open) > MIN_OWN_MOTION] for kind in (zeros, others)]
        zero = np.repeat([True, False], [len(kind) for kind in kinds])
        return Candidates(np.concatenate(kinds), zero, levels(zero))

    def least(self, both: Both) -> Array:
        """(c,) smallest change that is found in 95 of 100 cases [SI]."""
        _, sigma, dof = both.scores(NOTHING)
        return np.asarray(sigma * (critical(self.level, dof) + OF_POWER))

    def same(self, both: Both) -> float:
        """p-value of nothing having moved: of the clearest, shared among all [Bonferroni]."""
        by, sigma, dof = both.scores(NOTHING)
        _, p_value = tested(by, sigma, dof)
        return float(np.min(FALSE_ALARM * p_value / self.level, initial=1.0))

    def clearest(self, both: Both, chosen: Array) -> tuple[int, float, list[int]] | None:
        """The one that explains most, its p-value and its rivals; None where all may be chance.

        Only one that helps poses it was not estimated from: what mends nothing has not moved.
        chosen: what was found before.  All are numbers of candidates.
        """
        by, sigma, dof = both.scores(chosen)
        size, p_value = tested(by, sigma, dof)
        passed = (p_value <= self.level) & ~np.isin(np.arange(len(size)), chosen)
        for i in np.flatnonzero(
            passed
        ).tolist():  # whoever clears the noises must clear the folds' scatter
            wide = max(sigma[i], both.scatter(chosen, i))
            size[i], p_value[i] = tested(by[i], wide, dof[i])
            passed[i] = p_value[i] <= self.level[i] and helps(both.gains(chosen, i))
        if not passed.any():
            return None
        square = size**2
        square[chosen] = -np.inf
        pick, near = picked(square, passed, self.zero)
        return pick, float(p_value[pick]), near


def tested(by: Array, sigma: Array, dof: Array) -> tuple[Array, Array]:
    """How large a change is, in sigmas, and its p-value [Student]."""
    size = np.abs(by) / sigma
    return np.asarray(size), np.asarray(2.0 * scipy.stats.t.sf(size, dof))


def helps(gains: Array) -> bool:
    """Whether parts left out gain by more than a standard error.  gains: (g,)."""
    spread = float(np.std(gains, ddof=1)) if len(gains) > 1 else np.inf
    return bool(gains.mean() > spread / np.sqrt(len(gains)))


@dataclass(frozen=True, eq=False)
class Search:
    """What was looked for and what was found.

    named: what moved, the clearest first.  first: both sessions with nothing moved.  before: placed
    as if nothing had moved; after: with all that did.  looked: what was looked for.  same: p-value
    of nothing having moved.
    """

    named: tuple[Moved, ...]
    first: Both
    before: Placing
    after: Placing
    looked: Candidates
    same: float


def search(watched: Watched, links: Array) -> Search:
    """What moved.

    links: (p,) as in `Candidates.of`.  Raises DataError for too few poses.
    """
    _, state = watched.start
    rows = first_rows = watched.rows(watched.open, state)
    if rows.count <= int(watched.open.sum()):
        raise DataError(
            f"{watched.data.source}: {watched.data.poses} poses do not even tell where instrument "
            "and reflectors are; measure more"
        )
    looked = Candidates.of(watched, rows, links)
    both = first = joined(watched, rows, looked.column)
    names = watched.names
    chosen, told = NOTHING, []
    while len(chosen) < MAX_MOVED and (found := looked.clearest(both, chosen)):
        pick, p_value, others = found
        chosen = np.append(chosen, pick)
        told.append((p_value, tuple(names.all[looked.column[i]] for i in others)))
        active = watched.open.copy()
        active[looked.column[chosen]] = True
        rows = watched.rows(active, rows.state)
        both = both.again(joined(watched, rows, looked.column))
    change, sense = links_of(rows.state.mdh - watched.cell.robot.mdh), in_file(watched)
    more, sigma = both.change(chosen)
    named = tuple(
        Moved(names.all[i], float(sense[i] * (change[i] + by)), float(sure), names.units[i], *said)
        for i, by, sure, said in zip(looked.column[chosen], more, sigma, told, strict=True)
    )
    before, after = (Placing(informed(watched, one, first)) for one in (first_rows, rows))
    return Search(named, first, before, after, looked, looked.same(first))


def in_file(watched: Watched) -> Array:
    """(5n,) the sign that a change of each link parameter has in the robot's file."""
    robot = watched.cell.robot
    return links_of(robot.notation.sense(robot.joints))


def informed(watched: Watched, rows: Rows, both: Both) -> Rows:
    """The same rows with what the model lacks, there and in the calibration, and the noise now."""
    found, scale = both.variances, both.noise_ratio
    random = lacking(watched, rows)[0] * np.sqrt(found.factor[both.component != KNOWN])
    if watched.old is not None:
        past = (both.lacking() * np.sqrt(found.factor))[:, both.component != KNOWN]
        random = random + free_columns(watched, rows)[:, : len(past)] @ past
    return replace(rows, latent=np.concatenate([rows.latent, random], axis=1), scale=scale)


def sized(watched: Watched, placed: Placing, found: Sequence[Moved]) -> tuple[Moved, ...]:
    """The same with how far each moved as placed, all of them together, and how sure that is."""
    names = watched.names
    change = in_file(watched) * links_of(placed.state.mdh - watched.cell.robot.mdh)
    sigma = np.linalg.norm(placed.factor(np.zeros_like(watched.root)), axis=1)
    at = [names.index(each.parameter) for each in found]
    return tuple(
        replace(each, by=float(change[i]), sigma=float(sigma[i]))
        for each, i in zip(found, at, strict=True)
    )
