"""What differs between two calibrations of an arm: before and after a repair, this month and last.

Parameters that move the points alike (d1 and the base's z) can be traded for each other at no cost.
Both arms are therefore told with the same ones kept at the drawing: x' = x - N N_g^-1 x_g, with N
the motions of the links that base and reflectors imitate and g the parameters that are kept.  What
is left can be compared, in sigmas of both covariances, of noise and of folds.  What changed is
asked of the poses themselves (`moved.search_changes`).
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np

from minimax_cal.core.arrays import Array
from minimax_cal.core.errors import OptionError
from minimax_cal.core.record_fields import (
    FieldFormat,
    StoredSeparately,
    derived_field,
    scale_numbers,
)
from minimax_cal.core.results import Result
from minimax_cal.core.tables import Table, drop_empty_tables
from minimax_cal.core.units import display_unit_of_change, record_in_file_unit
from minimax_cal.fitting import identification
from minimax_cal.fitting.accuracy import Accuracy, summarise_point_errors
from minimax_cal.fitting.data_slips import describe_implausible_changes
from minimax_cal.fitting.fit import Fit
from minimax_cal.fitting.region_holdout import is_region_needed, step_without_poses
from minimax_cal.fitting.uncertainty import PosewiseFit
from minimax_cal.measuring.pose_groups import cluster_joint_regions
from minimax_cal.modelling.effects.effect_names import format_effect
from minimax_cal.modelling.parameters import flatten_link_parameters, joint_zero_indices
from minimax_cal.modelling.point_model import build_point_model
from minimax_cal.validation.monitoring.change_search import (
    FIRST_SCREEN_COLUMNS,
    MovedParameter,
    moved_parameter_table,
    search_changes,
)
from minimax_cal.validation.monitoring.open_arm import match_flags_by_name, open_monitored_arm


@dataclass(frozen=True)
class ParameterDifference:
    """B minus A of one parameter, in a common choice of what is kept [SI].

    sigma: NaN, with a reason, where it cannot be compared.
    """

    parameter: str
    unit: str
    a: float
    b: float
    sigma: float
    reason: Annotated[str, FieldFormat(brief=True)] = ""

    @derived_field()
    def by(self) -> float:
        """B minus A [SI]."""
        return self.b - self.a

    @derived_field()
    def sigmas(self) -> float:
        """The same in sigmas."""
        return self.by / self.sigma

    def to_dict(self) -> dict[str, Any]:
        """For JSON: lengths in mm, angles in rad."""
        return record_in_file_unit(self, "a", "b", "by", "sigma")


class PosesAccuracy(NamedTuple):
    """The accuracy of A and of B on some poses, base and reflectors placed anew for both."""

    poses: str
    a: Accuracy
    b: Accuracy


@dataclass(frozen=True, eq=False)
class Comparison(Result):
    """Two calibrations side by side.

    differences: of every link parameter.  changed: those that explain them, the clearest first.
    accuracy: on the poses of A and of B.  same: chance of such differences where nothing changed.
    """

    KIND = "comparison"

    names: StoredSeparately[tuple[str, str]]
    robot: str
    differences: Annotated[tuple[ParameterDifference, ...], FieldFormat(key="parameters")]
    changed: tuple[MovedParameter, ...]
    accuracy: tuple[PosesAccuracy, ...]
    same: Annotated[float, FieldFormat(key="p_value_nothing_changed")]
    notices: tuple[str, ...]

    @property
    def joints(self) -> tuple[str, ...]:
        """That changed, as J3."""
        return tuple(dict.fromkeys(c.joint for c in self.changed))

    def headline(self) -> str:
        """The result in a sentence or two."""
        a, b = self.names
        if not self.changed:
            return f"{self.robot}: no joint differs between {a} and {b} by more than chance allows."
        told = ", ".join(
            f"{c.parameter} by {1e3 * c.by:+.3f} {display_unit_of_change(c.unit)[1]}"
            for c in self.changed
        )
        return f"{self.robot}: {', '.join(self.joints)} changed from {a} to {b} ({told})."

    def first_tables(self) -> tuple[Table, ...]:
        """What changed, by how much; where nothing did, the accuracy on common poses."""
        first = (
            self.changed_table().shorten(*FIRST_SCREEN_COLUMNS)
            if self.changed
            else self.common_table().shorten()
        )
        return (first,)

    def changed_table(self) -> Table:
        """The parameters that explain the differences."""
        return moved_parameter_table("parameters that explain the differences", self.changed)

    def common_table(self) -> Table:
        """The accuracy of both on common poses."""
        return Table.from_records(
            "the same poses; base and reflectors may have moved",
            self.accuracy,
            "poses | a.poses=count d | a.rms_mm=A RMS mm .4f | a.max_mm=A max mm .4f | "
            "b.rms_mm=B RMS mm .4f | b.max_mm=B max mm .4f",
        )

    def tables(self) -> tuple[Table, ...]:
        """Which joints changed, accuracy on common poses, every parameter."""
        rows = (
            (
                d.parameter,
                unit,
                *scale_numbers((d.a, d.b, d.by, d.sigma), scale),
                d.sigmas,
                d.reason,
            )
            for d in self.differences
            for scale, unit in [display_unit_of_change(d.unit)]
        )
        columns = "parameter | unit | A .4f | B .4f | B - A +.4f | sigma .2g | in sigmas +.1f"
        title = f"A: {self.names[0]}, B: {self.names[1]}"
        each = Table.from_rows(title, rows, columns, "not compared because")
        return drop_empty_tables(self.changed_table(), self.common_table(), each)

    def extra_file_content(self, *, with_measurements: bool = True) -> dict[str, Any]:
        """The names."""
        return dict(zip("ab", self.names, strict=True))


# ---- the record ----------------------------------------------------------------------------------


MIN_GRAM_DIAGONAL = 1e-300  # in place of a zero
MAX_EQUAL_DRAWING_DIFFERENCE = 1e-9  # two drawings are one to this [m, rad]


def compare(a: Fit | Path | str, b: Fit | Path | str) -> Comparison:
    """What differs between two calibrations of an arm.

    Parameters
    ----------
    a, b
        Calibrations with their covariance, or their files, the earlier first.

    Returns
    -------
    Comparison
        What differs. Instrument and reflectors may have moved.

    Raises
    ------
    CalibrationError
        For wrong input.

    Examples
    --------
    >>> print(mc.compare("may.json", "june.json").summary())
    """
    fits = one, other = Fit.load(a), Fit.load(b)
    names = tuple("calibration" if isinstance(each, Fit) else str(each) for each in (a, b))
    names = (f"{names[0]} A", f"{names[1]} B") if names[0] == names[1] else names
    check_same_kind_of_arm(one, other)
    robot, links = one.cell.robot, slice(5 * one.cell.robot.joints)

    # A common gauge: links that base, reflectors or neighbours imitate are as drawn in both, by
    # the arm whose reflectors show less.
    kept, motion = max((unobservable_links(fit) for fit in fits), key=lambda found: len(found[0]))
    projection = np.eye(links.stop)
    projection[:, kept] -= motion
    drawn, values, identified = flatten_link_parameters(one.nominal.robot.mdh), [], []
    covariance = np.zeros((links.stop, links.stop))
    for fit in fits:
        value = drawn + projection @ (flatten_link_parameters(fit.cell.robot.mdh) - drawn)
        notation = robot.notation.values_in_file_convention(value.reshape(5, -1).T, robot.prismatic)
        values.append(flatten_link_parameters(notation))

        # By noise, and by folds; zero where a link was kept.
        own = np.nan_to_num(fit.uncertainty.covariance[links, links])
        own = own + jackknife_covariance_over_regions(fit)[links, links]
        covariance += projection @ own @ projection.T

        # A link is identified, or any other that moves the points alike.
        kinds = {p.name: p.because for p in fit.parameters}
        same_motion = [kinds.get(name) is identification.ReasonKind.SAME_MOTION
                       for name in fit.uncertainty.names.all_names[links]]  # fmt: skip
        identified.append(fit.identification.active[links] | same_motion)
    each = tuple(list_differences(one, values, covariance, kept, identified))

    found, same = find_changed_parameters(one, other)
    return Comparison(
        names=(names[0], names[1]),
        robot=robot.name,
        differences=tuple(each[i] for i in one.uncertainty.names.joint_by_joint_order[links]),
        changed=found,
        accuracy=tuple(accuracy_on_common_poses(one, other)),
        same=same,
        notices=tuple(list_comparison_notices(one, other)),
    )


def check_same_kind_of_arm(first: Fit, second: Fit) -> None:
    """Raise OptionError unless both are of one kind of arm."""
    a, b = first.cell.robot, second.cell.robot
    if a.joints != b.joints or np.any(a.sign != b.sign) or np.any(a.prismatic != b.prismatic):
        raise OptionError(
            f"{a.name} ({a.joints} joints) and {b.name} ({b.joints}) differ in number, signs or "
            "types of joints; compare calibrations of one arm"
        )
    apart = flatten_link_parameters(second.nominal.robot.mdh - first.nominal.robot.mdh)
    if named := describe_implausible_changes(first.uncertainty.names, apart, a.reach()):
        raise OptionError(
            f"{a.name} and {b.name} are drawn as different arms ({named}); compare calibrations "
            "that start from one drawing"
        )


class UnobservableLinks(NamedTuple):
    """(d,) links that stay as drawn, and (5n, d) what else moves with each."""

    link_indices: Array
    imitating_motions: Array


def unobservable_links(fit: Fit) -> UnobservableLinks:
    """Links to be kept as drawn (d,), and what else moves with each unseen (5n, d).

    What base and reflectors imitate on plenty of poses.
    """
    state, n = replace(fit.cell.parameter_values, effects=np.zeros(0)), 5 * fit.cell.robot.joints
    model = identification.build_reference_model(
        fit.cell.robot, build_point_model(fit.cell.robot, fit.data)
    )
    gram = identification.full_gram_matrix(model, state)
    order = identification.redundancy_drop_order(fit.nominal.robot, model.names)
    everything = np.ones(model.names.parameter_count, dtype=bool)
    gone = np.array(
        identification.select_redundant_parameters(
            gram, everything, order, identification.MIN_RANK_RATIO
        ),
        dtype=int,
    )
    size = np.sqrt(np.maximum(np.diag(gram), MIN_GRAM_DIAGONAL))
    _, vectors = np.linalg.eigh(gram / np.outer(size, size))
    null = vectors[:, : len(gone)] / size[:, None]
    return UnobservableLinks(gone[gone < n], null[:n, :] @ np.linalg.pinv(null[gone])[:, gone < n])


def jackknife_covariance_over_regions(fit: Fit) -> Array:
    """(p, p) of what fits without each region of the poses change: the jackknife over regions.

    Zero where regions cannot be left out.
    """
    out = np.zeros((fit.uncertainty.names.parameter_count,) * 2)
    if not fit.train.poses:
        return out
    poses, label = (
        PosewiseFit(fit.estimator, fit.cell.parameter_values),
        cluster_joint_regions(fit.train),
    )
    parts = [
        part
        for part in (label == one for one in np.unique(label))
        if not is_region_needed(poses, part)
    ]
    active = np.flatnonzero(fit.estimator.model.active)
    steps = np.array([step_without_poses(poses, part) for part in parts]).reshape(-1, len(active))
    out[np.ix_(active, active)] = (len(steps) - 1) / max(len(steps), 1) * steps.T @ steps
    return out


def list_differences(
    fit: Fit, values: list[Array], covariance: Array, kept_links: Array, is_identified: list[Array]
) -> Iterator[ParameterDifference]:
    """Every link parameter, in the order of `Names`."""
    names, sigma = fit.uncertainty.names, np.sqrt(np.maximum(np.diag(covariance), 0.0))
    for i in range(len(sigma)):
        missing = [which for which, known in zip("AB", is_identified, strict=True) if not known[i]]
        reason = ""
        if i in kept_links:
            reason = "base, reflectors or neighbours imitate it: kept as drawn"
        elif missing or sigma[i] == 0.0:
            reason = f"not identified in {' and '.join(missing) or 'A and B'}"
        size = math.nan if reason else float(sigma[i])
        yield ParameterDifference(
            names.all_names[i],
            names.units[i],
            float(values[0][i]),
            float(values[1][i]),
            size,
            reason,
        )


class ChangedParameters(NamedTuple):
    """Parameters that moved, the clearest first, and the p-value of nothing having moved."""

    changed: tuple[MovedParameter, ...]
    p_value_of_no_change: float


def find_changed_parameters(first: Fit, second: Fit) -> ChangedParameters:
    """What moved from one calibration to the other, the clearest first; p-value of nothing.

    The poses of the second are new ones of the first, or the reverse where only that has poses.
    """
    for fit, new, sign in ((first, second, 1.0), (second, first, -1.0)):
        if new.data.poses:
            watched, _ = open_monitored_arm(fit, replace(new.train, frames={}), ())
            found = search_changes(
                watched, match_flags_by_name(fit, watched, fit.identification.active)
            )
            return ChangedParameters(
                tuple(replace(m, by=sign * m.by) for m in found.named), found.same
            )
    return ChangedParameters((), math.nan)


def accuracy_on_common_poses(first: Fit, second: Fit) -> Iterator[PosesAccuracy]:
    """Both on the poses of each: on those that its own fit did not see, if there are any."""
    for name, fit in (("A", first), ("B", second)):
        if not fit.data.poses:
            continue
        held = fit.held if fit.held.any() else ~fit.held
        data = fit.data.take(held)
        found = []
        for arm in (first, second):
            model, state = open_monitored_arm(arm, replace(data, frames={}), ())[0].placed_start
            found.append(summarise_point_errors(model.point_errors(state)))
        which = "held-out" if fit.held.any() else "training"
        yield PosesAccuracy(f"{which} poses of {name}", *found)


def list_comparison_notices(first: Fit, second: Fit) -> Iterator[str]:
    """What the reader should know."""
    if not (first.data.poses or second.data.poses):
        yield (
            "neither file holds its poses, so that no joint can be said to have changed; save "
            "them with their poses"
        )
    if np.array_equal(first.data.y, second.data.y, equal_nan=True):
        yield (
            "both are fitted to the same measurements: what differs is the way of fitting, and "
            "the sigmas, which take them for independent, say nothing of it"
        )
    effects = [[format_effect(*t.key) for t in fit.cell.effects.terms] for fit in (first, second)]
    if effects[0] != effects[1]:
        told = " against ".join(", ".join(labels) or "none" for labels in effects)
        yield f"they hold different effects ({told}): geometry takes over part of what one lacks"
    change = flatten_link_parameters(second.cell.robot.mdh - first.cell.robot.mdh)
    change[joint_zero_indices(first.cell.robot.prismatic)] = 0.0  # a service may set them anew
    if named := describe_implausible_changes(
        first.uncertainty.names, change, first.cell.robot.reach()
    ):
        yield f"implausibly large changes: {named}; are both of the same arm?"
    if (
        np.abs(first.nominal.robot.mdh - second.nominal.robot.mdh).max()
        > MAX_EQUAL_DRAWING_DIFFERENCE
    ):
        yield "they start from different drawings: what neither identifies differs by that alone"
