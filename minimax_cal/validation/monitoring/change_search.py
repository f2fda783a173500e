"""What of a calibrated arm has moved since: score tests of its parameters on a few new poses.

A parameter has moved where its score is larger than chance allows once frame, reflectors, noise,
what the calibration did not know and what its model lacks are taken out [Rao 1948], the largest
first; the level is shared among all parameters that are looked at [Bonferroni].
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Any, NamedTuple

import numpy as np
import scipy

from minimax_cal.core.arrays import Array
from minimax_cal.core.errors import DataError
from minimax_cal.core.record_fields import FieldFormat, derived_field
from minimax_cal.core.tables import Table
from minimax_cal.core.units import display_unit_of_change, record_in_file_unit
from minimax_cal.measuring.pose_groups import cluster_joint_regions
from minimax_cal.measuring.visit_history import has_session_time, session_clock_values
from minimax_cal.modelling.error_rows import (
    MAX_SESSION_WAVES,
    lack_of_fit_motions_by_pose,
    lack_of_fit_motions_by_time,
)
from minimax_cal.modelling.parameters import flatten_link_parameters
from minimax_cal.validation.monitoring.calibration_poses import CalibrationPoses
from minimax_cal.validation.monitoring.monitored_arm import MonitoredArm
from minimax_cal.validation.monitoring.placing import LinearPlacement, MonitoredRows, solve_placing
from minimax_cal.validation.monitoring.session_pair import (
    FOOT,
    KNOWN_COMPONENT,
    NEW,
    OLD,
    RowProducts,
    SessionPair,
    student_critical_value,
)


def build_session_pair(watched: MonitoredArm, rows: MonitoredRows, column: Array) -> SessionPair:
    """New rows beside those of the calibration.  column: (c,) parameters that may have moved."""
    random, component = lack_of_fit_columns(watched, rows)
    old = watched.calibration_poses
    component = np.concatenate(
        [np.full(watched.unmeasured_covariance_root.shape[1], KNOWN_COMPONENT), component]
    )
    new = tuple(new_row_products(watched, rows, random, column))
    before = tuple(calibration_row_products_by_region(watched, old, len(column))) if old else ()
    free = free_parameter_columns(watched, rows).shape[1]
    zero = np.isin(column, watched.zero_parameters)
    near = old.factor if old else np.ones(0)
    return SessionPair((*before, *new), free, len(component), component, column, zero, near)


def new_row_products(
    watched: MonitoredArm, rows: MonitoredRows, random: Array, column: Array
) -> Iterator[RowProducts]:
    """Products of the new rows, region by region, and of each reflector on the foot."""
    kept = -rows.jacobian @ watched.unmeasured_covariance_root
    if rows.foot_coordinate_count and watched.calibration_poses is None:
        kept[rows.pose < 0] = rows.latent[rows.pose < 0]
    whole = np.concatenate(
        [
            free_parameter_columns(watched, rows),
            kept,
            random,
            rows.jacobian[:, column],
            rows.error[:, None],
        ],
        axis=1,
    )
    region = cluster_joint_regions(watched.data)
    label = np.append(region, -1)[rows.pose]
    label[rows.pose < 0] = -1 - np.arange(rows.foot_coordinate_count) // 3
    seen = (~np.isnan(watched.data.y)).sum(axis=(1, 2))
    for one in np.unique(label):
        part = whole[label == one]
        if one < 0:
            yield RowProducts(part.T @ part, len(part), FOOT)
        else:
            yield RowProducts(part.T @ part, int(seen[region == one].sum()), NEW)


def calibration_row_products_by_region(
    watched: MonitoredArm, old: CalibrationPoses, candidates: int
) -> Iterator[RowProducts]:
    """Products of the calibration's rows, region by region."""
    m, r, _ = old.jacobian.shape
    drift, _ = drift_columns(watched, old.links, old.arm, old.when, OLD)
    by_angle, _ = lack_of_fit_motions_by_pose(watched.cell.robot, old.q, old.arm)
    random = np.concatenate([old.latent, by_angle, drift], axis=2)
    elsewhere = np.zeros((m, r, int(watched.is_open.sum())))
    nowhere = np.zeros((m, r, candidates))
    whole = np.concatenate([old.jacobian, elsewhere, random, nowhere, old.error[..., None]], axis=2)
    return old.row_products_by_region(whole)


def free_parameter_columns(watched: MonitoredArm, rows: MonitoredRows) -> Array:
    """(N, f) new rows by what the calibration fitted, where it is still so, and by what is open."""
    names, open_ = watched.names.all_names, watched.is_open
    now = rows.jacobian[:, open_]
    if watched.calibration_poses is None:
        return now
    place = {name: i for i, name in enumerate(names)}
    at = np.array([place.get(name, -1) for name in watched.calibration_poses.names])
    still = (at >= 0) & ~open_[at]
    before = np.where(still, rows.jacobian[:, at], 0.0)
    if rows.foot_coordinate_count:  # where the foot stands now is measured from where it stood
        foot, base = rows.pose < 0, np.arange(watched.base.start, watched.base.stop)
        of_base = np.isin(at, base)
        before[np.ix_(foot, of_base)] = -rows.jacobian[np.ix_(foot, at[of_base])]
    return np.concatenate([before, now], axis=1)


class LackOfFitColumns(NamedTuple):
    """(N, l) rows by what the model lacks, and (l,) which factors share a variance."""

    columns: Array
    variance_groups: Array


def lack_of_fit_columns(watched: MonitoredArm, rows: MonitoredRows) -> LackOfFitColumns:
    """(N, l) new rows by what the model lacks, and (l,) which factors share a variance."""
    robot, (m, r, n) = watched.cell.robot, rows.arm.shape
    by_angle, turned = lack_of_fit_motions_by_pose(
        robot, robot.chain_joint_values(watched.data.q), rows.arm
    )
    links = rows.jacobian[: m * r, : 5 * n].reshape(m, r, 5 * n)
    drift, kind = drift_columns(watched, links, rows.arm, session_times(watched), NEW)
    columns = np.concatenate([by_angle, drift], axis=2).reshape(m * r, -1)
    return LackOfFitColumns(
        np.pad(columns, ((0, rows.foot_coordinate_count), (0, 0))),
        np.append(turned[:, 0], n + kind),
    )


def session_times(watched: MonitoredArm) -> Array | None:
    """(m,) place of new poses in their session, 0 to 1; None where nothing tells it."""
    return session_clock_values(watched.data) if has_session_time(watched.data) else None


class DriftColumns(NamedTuple):
    """(m, r, d) motion by what drifts, and (d,) the kind of each."""

    columns: Array
    kinds: Array


def drift_columns(
    watched: MonitoredArm, links: Array, arm: Array, when: Array | None, source: int
) -> DriftColumns:
    """(m, r, d) motion by what drifts in either session and between them, and (d,) the kind.

    links: (m, r, 5n) by the link parameters.  The columns are waves of the old session, what is
    between the two, waves of the new one; what drifts by so much in a session does so between two.
    """
    robot, old = watched.cell.robot, watched.calibration_poses
    n, (m, r, _) = robot.joints, arm.shape
    if session_times(watched) is None and (old is None or old.when is None):
        return DriftColumns(np.zeros((m, r, 0)), np.zeros(0, dtype=int))
    growth = links[..., : 2 * n] @ robot.mdh[:, :2].T.reshape(-1)
    moved, kind = lack_of_fit_motions_by_time(
        robot, np.zeros(m) if when is None else when, arm, growth
    )
    waves = np.concatenate(list(moved[1:] if when is not None else 0.0 * moved[1:]), axis=2)
    none, apart = 0.0 * waves, moved[0]
    blocks = [none, apart, waves] if source == NEW else [waves, 0.0 * apart, none]
    return DriftColumns(np.concatenate(blocks, axis=2), np.tile(kind, 1 + 2 * MAX_SESSION_WAVES))


# ---- what moved ----------------------------------------------------------------------------------


MAX_FALSE_ALARM_PROBABILITY = (
    0.005  # chance that anything at all is named on an arm that did not move
)
# share of it for zero positions, which a knock or a service changes; links have the rest
FALSE_ALARM_FRACTION_OF_ZEROS = 0.8
# share of a motion that frame and reflectors do not imitate, of what can be told
MIN_OWN_MOTION = 1e-6
MIN_LINK_LEAD = 9.0  # by how much a link must explain more than a zero position, in squared sigmas
MAX_ALTERNATIVE_LOSS = 6.6  # rivals lose less than this, in squared sigmas: the 99 % point of one
POWER_SIGMAS = 1.645  # sigmas that a normal variable falls short of in 5 of 100 cases
NO_CANDIDATES = np.zeros(0, dtype=int)
FIRST_SCREEN_COLUMNS = (
    "parameter",
    "by",
    "unit",
    "sigma",
    "p-value",
    "or as well",
)  # on a first screen
MAX_MOVED_PARAMETERS = 4  # parameters that are named; where more moved, the arm wants a calibration


@dataclass(frozen=True)
class MovedParameter:
    """A parameter that has moved.  by, sigma: [SI].  others: would explain it nearly as well."""

    parameter: str
    by: float
    sigma: float
    unit: str
    p_value: float
    others: Annotated[tuple[str, ...], FieldFormat(key="alternatives")] = ()

    @derived_field()
    def joint(self) -> str:
        """Its joint, as J3."""
        return joint_name_of_parameter(self.parameter)

    def to_dict(self) -> dict[str, Any]:
        """For JSON: lengths in mm, angles in rad."""
        return record_in_file_unit(self, "by", "sigma")


def moved_parameter_table(title: str, moved: Sequence[MovedParameter]) -> Table:
    """What moved, in mm and mrad."""
    rows = (
        (m.parameter, m.joint, unit, scale * m.by, scale * m.sigma, m.p_value, m.others)
        for m in moved
        for scale, unit in [display_unit_of_change(m.unit)]
    )
    columns = "parameter | joint | unit | by +.4f | sigma .2g | p-value .2g | or as well"
    return Table.from_rows(title, rows, columns)


def joint_name_of_parameter(parameter: str) -> str:
    """The joint of a link's parameter, as J3."""
    return "J" + parameter.lstrip("abcdefghijklmnopqrstuvwxyz")


class SelectedChange(NamedTuple):
    """Number of a candidate, and of those that would do nearly as well."""

    candidate: int
    alternatives: list[int]


def select_change(
    explained_squares: Array, is_significant: Array, is_zero: Array
) -> SelectedChange:
    """The one of those that passed that explains most, and which would do nearly as well.

    A zero position goes before links that are not clearly better.  explained_squares: (c,) what
    each explains, in squared sigmas, -inf where it is not asked.  is_significant, is_zero: (c,).
    """
    pick = int(
        np.argmax(np.where(is_significant, explained_squares + MIN_LINK_LEAD * is_zero, -np.inf))
    )
    lost = explained_squares[pick] - explained_squares
    return SelectedChange(
        pick, [int(i) for i in np.argsort(lost) if lost[i] < MAX_ALTERNATIVE_LOSS and i != pick]
    )


class ClearestChange(NamedTuple):
    """A candidate that moved, its p-value, and those that would do nearly as well."""

    candidate: int
    p_value: float
    alternatives: list[int]


@dataclass(frozen=True, eq=False)
class ChangeCandidates:
    """Parameters that may have moved.

    column: (c,) which.  zero: (c,) True for zero positions.  level: (c,) chance that each is named
    where nothing moved.
    """

    column: Array
    zero: Array
    level: Array

    @staticmethod
    def from_rows(watched: MonitoredArm, rows: MonitoredRows, links: Array) -> ChangeCandidates:
        """Those that frame and reflectors cannot imitate.

        links: (p,) True for link parameters that the calibration identified.
        """
        zeros = watched.zero_parameters
        others = np.setdiff1d(np.flatnonzero(links & watched.names.link_mask), zeros)
        kinds = [
            kind[rows.independent_motion_fraction(kind, watched.is_open) > MIN_OWN_MOTION]
            for kind in (zeros, others)
        ]
        counts = [len(kind) for kind in kinds]
        shares = [
            FALSE_ALARM_FRACTION_OF_ZEROS / max(counts[0], 1),
            (1.0 - FALSE_ALARM_FRACTION_OF_ZEROS) / max(counts[1], 1),
        ]
        zero = np.repeat([True, False], counts)
        return ChangeCandidates(
            np.concatenate(kinds), zero, MAX_FALSE_ALARM_PROBABILITY * np.repeat(shares, counts)
        )

    def detectable_changes(self, both: SessionPair) -> Array:
        """(c,) smallest change that is found in 95 of 100 cases [SI]."""
        _, sigma, dof = both.candidate_scores(NO_CANDIDATES)
        return np.asarray(sigma * (student_critical_value(self.level, dof) + POWER_SIGMAS))

    def p_value_of_no_change(self, both: SessionPair) -> float:
        """p-value of nothing having moved: of the clearest, shared among all [Bonferroni]."""
        by, sigma, dof = both.candidate_scores(NO_CANDIDATES)
        _, p_value = student_test(by, sigma, dof)
        return float(np.min(MAX_FALSE_ALARM_PROBABILITY * p_value / self.level, initial=1.0))

    def find_clearest_change(self, both: SessionPair, chosen: Array) -> ClearestChange | None:
        """The one that explains most, its p-value and its rivals; None where all may be chance.

        Only one that helps poses it was not estimated from: what mends nothing has not moved.
        chosen: what was found before.  All are numbers of candidates.
        """
        by, sigma, dof = both.candidate_scores(chosen)
        size, p_value = student_test(by, sigma, dof)
        passed = (p_value <= self.level) & ~np.isin(np.arange(len(size)), chosen)
        for i in np.flatnonzero(passed).tolist():
            # what is significant beside the noises must be so beside the folds' scatter, and
            # poses that were left out must gain by more than a standard error
            wide = max(sigma[i], both.jackknife_sigma(chosen, i))
            size[i], p_value[i] = student_test(by[i], wide, dof[i])
            gains = both.left_out_gains(chosen, i)
            spread = float(np.std(gains, ddof=1)) if len(gains) > 1 else np.inf
            helps = bool(gains.mean() > spread / np.sqrt(len(gains)))
            passed[i] = p_value[i] <= self.level[i] and helps
        if not passed.any():
            return None
        square = size**2
        square[chosen] = -np.inf
        pick, near = select_change(square, passed, self.zero)
        return ClearestChange(pick, float(p_value[pick]), near)


class StudentTest(NamedTuple):
    """A change in sigmas, and its p-value."""

    size: Array
    p_value: Array


def student_test(by: Array, sigma: Array, dof: Array) -> StudentTest:
    """How large a change is, in sigmas, and its p-value [Student]."""
    size = np.abs(by) / sigma
    return StudentTest(np.asarray(size), np.asarray(2.0 * scipy.stats.t.sf(size, dof)))


@dataclass(frozen=True, eq=False)
class ChangeSearch:
    """What was looked for and what was found.

    named: what moved, the clearest first.  first: both sessions with nothing moved.  before: placed
    as if nothing had moved; after: with all that did.  looked: what was looked for.  same: p-value
    of nothing having moved.
    """

    named: tuple[MovedParameter, ...]
    first: SessionPair
    before: LinearPlacement
    after: LinearPlacement
    looked: ChangeCandidates
    same: float


def search_changes(watched: MonitoredArm, is_identified: Array) -> ChangeSearch:
    """What moved.

    is_identified: (p,) as in `ChangeCandidates.from_rows`.  Raises DataError for too few poses.
    """
    _, state = watched.placed_start
    rows = first_rows = watched.build_rows(watched.is_open, state)
    if rows.count <= int(watched.is_open.sum()):
        raise DataError(
            f"{watched.data.source}: {watched.data.poses} poses do not even tell where instrument "
            "and reflectors are; measure more"
        )
    looked = ChangeCandidates.from_rows(watched, rows, is_identified)
    both = first = build_session_pair(watched, rows, looked.column)
    names = watched.names
    chosen, told = NO_CANDIDATES, []
    while len(chosen) < MAX_MOVED_PARAMETERS and (
        found := looked.find_clearest_change(both, chosen)
    ):
        pick, p_value, others = found
        chosen = np.append(chosen, pick)
        told.append((p_value, tuple(names.all_names[looked.column[i]] for i in others)))
        active = watched.is_open.copy()
        active[looked.column[chosen]] = True
        rows = watched.build_rows(active, rows.state)
        both = both.with_variances_from(build_session_pair(watched, rows, looked.column))
    change, sense = (
        flatten_link_parameters(rows.state.mdh - watched.cell.robot.mdh),
        file_signs_of_link_parameters(watched),
    )
    more, sigma = both.joint_changes(chosen)
    named = tuple(
        MovedParameter(
            names.all_names[i],
            float(sense[i] * (change[i] + by)),
            float(sure),
            names.units[i],
            *said,
        )
        for i, by, sure, said in zip(looked.column[chosen], more, sigma, told, strict=True)
    )
    before, after = (
        solve_placing(rows_with_lack_of_fit(watched, one, first)) for one in (first_rows, rows)
    )
    return ChangeSearch(named, first, before, after, looked, looked.p_value_of_no_change(first))


def file_signs_of_link_parameters(watched: MonitoredArm) -> Array:
    """(5n,) the sign that a change of each link parameter has in the robot's file."""
    robot = watched.cell.robot
    return flatten_link_parameters(robot.notation.file_value_signs(robot.joints))


def rows_with_lack_of_fit(
    watched: MonitoredArm, rows: MonitoredRows, both: SessionPair
) -> MonitoredRows:
    """The same rows with what the model lacks, there and in the calibration, and the noise now."""
    found, scale = both.variances, both.noise_ratio
    random = lack_of_fit_columns(watched, rows)[0] * np.sqrt(
        found.factor[both.component != KNOWN_COMPONENT]
    )
    if watched.calibration_poses is not None:
        past = (both.shift_by_lack_of_fit() * np.sqrt(found.factor))[
            :, both.component != KNOWN_COMPONENT
        ]
        random = random + free_parameter_columns(watched, rows)[:, : len(past)] @ past
    return replace(rows, latent=np.concatenate([rows.latent, random], axis=1), scale=scale)


def with_jointly_estimated_changes(
    watched: MonitoredArm, placed: LinearPlacement, found: Sequence[MovedParameter]
) -> tuple[MovedParameter, ...]:
    """The same with how far each moved as placed, all of them together, and how sure that is."""
    names = watched.names
    change = file_signs_of_link_parameters(watched) * flatten_link_parameters(
        placed.state.mdh - watched.cell.robot.mdh
    )
    sigma = np.linalg.norm(
        placed.covariance_factor(np.zeros_like(watched.kept_covariance_root)), axis=1
    )
    at = [names.index_of_name(each.parameter) for each in found]
    return tuple(
        replace(each, by=float(change[i]), sigma=float(sigma[i]))
        for each, i in zip(found, at, strict=True)
    )
