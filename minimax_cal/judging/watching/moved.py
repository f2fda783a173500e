"""What of a calibrated arm has moved since: score tests of its parameters on a few new poses.

A parameter has moved where its score is larger than chance allows once frame, reflectors, noise,
what the calibration did not know and what its model lacks are taken out [Rao 1948], the largest
first; the level is shared among all parameters that are looked at [Bonferroni].
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Any

import numpy as np
import scipy

from minimax_cal.ground.arrays import Array
from minimax_cal.ground.errors import DataError
from minimax_cal.ground.facts import Fact, derived
from minimax_cal.ground.tables import Table
from minimax_cal.ground.units import for_people, in_own_unit
from minimax_cal.judging.watching.both import FOOT, KNOWN, NEW, OLD, Both, Part, critical
from minimax_cal.judging.watching.old import Old
from minimax_cal.judging.watching.placing import Placing, Rows, solve_placing
from minimax_cal.judging.watching.watched import Watched
from minimax_cal.measuring.grouping import regions
from minimax_cal.measuring.history import clock, is_timed
from minimax_cal.modelling.parameters import links_of
from minimax_cal.modelling.rows import WAVES, by_pose, by_time


def joined(watched: Watched, rows: Rows, column: Array) -> Both:
    """New rows beside those of the calibration.  column: (c,) parameters that may have moved."""
    random, component = lacking(watched, rows)
    old = watched.old
    component = np.concatenate([np.full(watched.held.shape[1], KNOWN), component])
    new = tuple(new_parts(watched, rows, random, column))
    before = tuple(old_parts(watched, old, len(column))) if old else ()
    free = free_columns(watched, rows).shape[1]
    zero = np.isin(column, watched.zeros)
    near = old.factor if old else np.ones(0)
    return Both((*before, *new), free, len(component), component, column, zero, near)


def new_parts(watched: Watched, rows: Rows, random: Array, column: Array) -> Iterator[Part]:
    """Products of the new rows, region by region, and of each reflector on the foot."""
    kept = -rows.jacobian @ watched.held
    if rows.foot and watched.old is None:
        kept[rows.pose < 0] = rows.latent[rows.pose < 0]
    whole = np.concatenate(
        [free_columns(watched, rows), kept, random, rows.jacobian[:, column], rows.error[:, None]],
        axis=1,
    )
    region = regions(watched.data)
    label = np.append(region, -1)[rows.pose]
    label[rows.pose < 0] = -1 - np.arange(rows.foot) // 3
    seen = (~np.isnan(watched.data.y)).sum(axis=(1, 2))
    for one in np.unique(label):
        part = whole[label == one]
        if one < 0:
            yield Part(part.T @ part, len(part), FOOT)
        else:
            yield Part(part.T @ part, int(seen[region == one].sum()), NEW)


def old_parts(watched: Watched, old: Old, candidates: int) -> Iterator[Part]:
    """Products of the calibration's rows, region by region."""
    m, r, _ = old.jacobian.shape
    drift, _ = drifts(watched, old.links, old.arm, old.when, OLD)
    by_angle, _ = by_pose(watched.cell.robot, old.q, old.arm)
    random = np.concatenate([old.latent, by_angle, drift], axis=2)
    elsewhere = np.zeros((m, r, int(watched.open.sum())))
    nowhere = np.zeros((m, r, candidates))
    whole = np.concatenate([old.jacobian, elsewhere, random, nowhere, old.error[..., None]], axis=2)
    return old.parts(whole)


def free_columns(watched: Watched, rows: Rows) -> Array:
    """(N, f) new rows by what the calibration fitted, where it is still so, and by what is open."""
    names, open_ = watched.names.all, watched.open
    now = rows.jacobian[:, open_]
    if watched.old is None:
        return now
    place = {name: i for i, name in enumerate(names)}
    at = np.array([place.get(name, -1) for name in watched.old.names])
    still = (at >= 0) & ~open_[at]
    before = np.where(still, rows.jacobian[:, at], 0.0)
    if rows.foot:  # where the foot stands now is measured from where it stood
        foot, base = rows.pose < 0, np.arange(watched.base.start, watched.base.stop)
        of_base = np.isin(at, base)
        before[np.ix_(foot, of_base)] = -rows.jacobian[np.ix_(foot, at[of_base])]
    return np.concatenate([before, now], axis=1)


def lacking(watched: Watched, rows: Rows) -> tuple[Array, Array]:
    """(N, l) new rows by what the model lacks, and (l,) which factors share a variance."""
    robot, (m, r, n) = watched.cell.robot, rows.arm.shape
    by_angle, turned = by_pose(robot, robot.turned(watched.data.q), rows.arm)
    links = rows.jacobian[: m * r, : 5 * n].reshape(m, r, 5 * n)
    drift, kind = drifts(watched, links, rows.arm, when_of(watched), NEW)
    columns = np.concatenate([by_angle, drift], axis=2).reshape(m * r, -1)
    return np.pad(columns, ((0, rows.foot), (0, 0))), np.append(turned[:, 0], n + kind)


def when_of(watched: Watched) -> Array | None:
    """(m,) place of new poses in their session, 0 to 1; None where nothing tells it."""
    return clock(watched.data) if is_timed(watched.data) else None


def drifts(
    watched: Watched, links: Array, arm: Array, when: Array | None, source: int
) -> tuple[Array, Array]:
    """(m, r, d) motion by what drifts in either session and between them, and (d,) the kind.

    links: (m, r, 5n) by the link parameters.  The columns are waves of the old session, what is
    between the two, waves of the new one; what drifts by so much in a session does so between two.
    """
    robot, old = watched.cell.robot, watched.old
    n, (m, r, _) = robot.joints, arm.shape
    if when_of(watched) is None and (old is None or old.when is None):
        return np.zeros((m, r, 0)), np.zeros(0, dtype=int)
    growth = links[..., : 2 * n] @ robot.mdh[:, :2].T.reshape(-1)
    moved, kind = by_time(robot, np.zeros(m) if when is None else when, arm, growth)
    waves = np.concatenate(list(moved[1:] if when is not None else 0.0 * moved[1:]), axis=2)
    none, apart = 0.0 * waves, moved[0]
    blocks = [none, apart, waves] if source == NEW else [waves, 0.0 * apart, none]
    return np.concatenate(blocks, axis=2), np.tile(kind, 1 + 2 * WAVES)


# ---- what moved ----------------------------------------------------------------------------------


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
        counts = [len(kind) for kind in kinds]
        shares = [ZEROS / max(counts[0], 1), (1.0 - ZEROS) / max(counts[1], 1)]
        zero = np.repeat([True, False], counts)
        return Candidates(np.concatenate(kinds), zero, FALSE_ALARM * np.repeat(shares, counts))

    def least(self, both: Both) -> Array:
        """(c,) smallest change that is found in 95 of 100 cases [SI]."""
        _, sigma, dof = both.scores(NOTHING)
        return np.asarray(sigma * (critical(self.level, dof) + OF_POWER))

    def same(self, both: Both) -> float:
        """p-value of nothing having moved: of the clearest, shared among all [Bonferroni]."""
        by, sigma, dof = both.scores(NOTHING)
        _, p_value = student_test(by, sigma, dof)
        return float(np.min(FALSE_ALARM * p_value / self.level, initial=1.0))

    def clearest(self, both: Both, chosen: Array) -> tuple[int, float, list[int]] | None:
        """The one that explains most, its p-value and its rivals; None where all may be chance.

        Only one that helps poses it was not estimated from: what mends nothing has not moved.
        chosen: what was found before.  All are numbers of candidates.
        """
        by, sigma, dof = both.scores(chosen)
        size, p_value = student_test(by, sigma, dof)
        passed = (p_value <= self.level) & ~np.isin(np.arange(len(size)), chosen)
        for i in np.flatnonzero(passed).tolist():
            # what is significant beside the noises must be so beside the folds' scatter, and
            # poses that were left out must gain by more than a standard error
            wide = max(sigma[i], both.scatter(chosen, i))
            size[i], p_value[i] = student_test(by[i], wide, dof[i])
            gains = both.gains(chosen, i)
            spread = float(np.std(gains, ddof=1)) if len(gains) > 1 else np.inf
            helps = bool(gains.mean() > spread / np.sqrt(len(gains)))
            passed[i] = p_value[i] <= self.level[i] and helps
        if not passed.any():
            return None
        square = size**2
        square[chosen] = -np.inf
        pick, near = picked(square, passed, self.zero)
        return pick, float(p_value[pick]), near


def student_test(by: Array, sigma: Array, dof: Array) -> tuple[Array, Array]:
    """How large a change is, in sigmas, and its p-value [Student]."""
    size = np.abs(by) / sigma
    return np.asarray(size), np.asarray(2.0 * scipy.stats.t.sf(size, dof))


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
    before, after = (solve_placing(informed(watched, one, first)) for one in (first_rows, rows))
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
