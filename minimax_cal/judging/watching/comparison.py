"""What differs between two calibrations of an arm: before and after a repair, this month and last.

Parameters that move the points alike (d1 and the base's z) can be traded for each other at no cost.
Both arms are therefore told with the same ones kept at the drawing: x' = x - N N_g^-1 x_g, with N
the motions of the links that base and reflectors imitate and g the parameters that are kept.  What
is left can be compared, in sigmas of both covariances, of noise and of folds.  What changed is
asked of the poses themselves (`moved.search`).
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np

from minimax_cal.fitting import identify
from minimax_cal.fitting.accuracy import Accuracy, accuracy
from minimax_cal.fitting.beyond import needed, step_without
from minimax_cal.fitting.checks import wild
from minimax_cal.fitting.fit import Fit
from minimax_cal.fitting.uncertainty import Poses
from minimax_cal.ground.arrays import Array
from minimax_cal.ground.errors import OptionError
from minimax_cal.ground.facts import Apart, Fact, derived, scaled
from minimax_cal.ground.results import Result
from minimax_cal.ground.tables import Table, filled
from minimax_cal.ground.units import for_people, in_own_unit
from minimax_cal.judging.watching.moved import FIRST, Moved, moved_table, search
from minimax_cal.judging.watching.opening import match_names, open_parameters
from minimax_cal.measuring.grouping import regions
from minimax_cal.modelling.effects.words import name_effect
from minimax_cal.modelling.model import model_of
from minimax_cal.modelling.parameters import links_of, zero_positions


@dataclass(frozen=True)
class Difference:
    """B minus A of one parameter, in a common choice of what is kept [SI].

    sigma: NaN, with a reason, where it cannot be compared.
    """

    parameter: str
    unit: str
    a: float
    b: float
    sigma: float
    reason: Annotated[str, Fact(brief=True)] = ""

    @derived()
    def by(self) -> float:
        """B minus A [SI]."""
        return self.b - self.a

    @derived()
    def sigmas(self) -> float:
        """The same in sigmas."""
        return self.by / self.sigma

    def to_dict(self) -> dict[str, Any]:
        """For JSON: lengths in mm, angles in rad."""
        return in_own_unit(self, "a", "b", "by", "sigma")


class OnPoses(NamedTuple):
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

    names: Apart[tuple[str, str]]
    robot: str
    differences: Annotated[tuple[Difference, ...], Fact(key="parameters")]
    changed: tuple[Moved, ...]
    accuracy: tuple[OnPoses, ...]
    same: Annotated[float, Fact(key="p_value_nothing_changed")]
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
            f"{c.parameter} by {1e3 * c.by:+.3f} {for_people(c.unit)[1]}" for c in self.changed
        )
        return f"{self.robot}: {', '.join(self.joints)} changed from {a} to {b} ({told})."

    def first_tables(self) -> tuple[Table, ...]:
        """What changed, by how much; where nothing did, the accuracy on common poses."""
        first = self.changed_table().brief(*FIRST) if self.changed else self.common_table().brief()
        return (first,)

    def changed_table(self) -> Table:
        """The parameters that explain the differences."""
        return moved_table("parameters that explain the differences", self.changed)

    def common_table(self) -> Table:
        """The accuracy of both on common poses."""
        return Table.of(
            "the same poses; base and reflectors may have moved",
            self.accuracy,
            "poses | a.poses=count d | a.rms_mm=A RMS mm .4f | a.max_mm=A max mm .4f | "
            "b.rms_mm=B RMS mm .4f | b.max_mm=B max mm .4f",
        )

    def tables(self) -> tuple[Table, ...]:
        """Which joints changed, accuracy on common poses, every parameter."""
        rows = (
            (d.parameter, unit, *scaled((d.a, d.b, d.by, d.sigma), scale), d.sigmas, d.reason)
            for d in self.differences
            for scale, unit in [for_people(d.unit)]
        )
        columns = "parameter | unit | A .4f | B .4f | B - A +.4f | sigma .2g | in sigmas +.1f"
        title = f"A: {self.names[0]}, B: {self.names[1]}"
        each = Table.made(title, rows, columns, "not compared because")
        return filled(self.changed_table(), self.common_table(), each)

    def beside(self, *, poses: bool = True) -> dict[str, Any]:
        """The names."""
        return dict(zip("ab", self.names, strict=True))


# ---- the record ----------------------------------------------------------------------------------


TINY = 1e-300  # in place of a zero
ALIKE = 1e-9  # two drawings are one to this [m, rad]


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
    check_alike(one, other)
    robot, links = one.cell.robot, slice(5 * one.cell.robot.joints)

    # A common gauge: links that base, reflectors or neighbours imitate are as drawn in both, by
    # the arm whose reflectors show less.
    kept, motion = max((gauge(fit) for fit in fits), key=lambda found: len(found[0]))
    projection = np.eye(links.stop)
    projection[:, kept] -= motion
    drawn, values, identified = links_of(one.nominal.robot.mdh), [], []
    covariance = np.zeros((links.stop, links.stop))
    for fit in fits:
        value = drawn + projection @ (links_of(fit.cell.robot.mdh) - drawn)
        notation = robot.notation.told(value.reshape(5, -1).T, robot.prismatic)
        values.append(links_of(notation))

        # By noise, and by folds; zero where a link was kept.
        own = np.nan_to_num(fit.uncertainty.covariance[links, links])
        own = own + folds_covariance(fit)[links, links]
        covariance += projection @ own @ projection.T

        # A link is identified, or any other that moves the points alike.
        kinds = {p.name: p.because for p in fit.parameters}
        same_motion = [kinds.get(name) is identify.Because.SAME_MOTION
                       for name in fit.uncertainty.names.all[links]]  # fmt: skip
        identified.append(fit.identification.active[links] | same_motion)
    each = tuple(differences(one, values, covariance, kept, identified))

    found, same = changed(one, other)
    return Comparison(
        names=(names[0], names[1]),
        robot=robot.name,
        differences=tuple(each[i] for i in one.uncertainty.names.link_by_link[links]),
        changed=found,
        accuracy=tuple(on_common(one, other)),
        same=same,
        notices=tuple(remarks(one, other)),
    )


def check_alike(one: Fit, other: Fit) -> None:
    """Raise OptionError unless both are of one kind of arm."""
    a, b = one.cell.robot, other.cell.robot
    if a.joints != b.joints or np.any(a.sign != b.sign) or np.any(a.prismatic != b.prismatic):
        raise OptionError(
            f"{a.name} ({a.joints} joints) and {b.name} ({b.joints}) differ in number, signs or "
            "types of joints; compare calibrations of one arm"
        )
    apart = links_of(other.nominal.robot.mdh - one.nominal.robot.mdh)
    if named := wild(one.uncertainty.names, apart, a.reach()):
        raise OptionError(
            f"{a.name} and {b.name} are drawn as different arms ({named}); compare calibrations "
            "that start from one drawing"
        )


def gauge(fit: Fit) -> tuple[Array, Array]:
    """Links to be kept as drawn (d,), and what else moves with each unseen (5n, d).

    What base and reflectors imitate on plenty of poses.
    """
    state, n = replace(fit.cell.state, effects=np.zeros(0)), 5 * fit.cell.robot.joints
    model = identify.plenty_of_poses(fit.cell.robot, model_of(fit.cell.robot, fit.data))
    gram = identify.gram_of(model, state)
    order = identify.drop_order(fit.nominal.robot, model.names)
    everything = np.ones(model.names.count, dtype=bool)
    gone = np.array(identify.redundant(gram, everything, order, identify.RANK_TOLERANCE), dtype=int)
    size = np.sqrt(np.maximum(np.diag(gram), TINY))
    _, vectors = np.linalg.eigh(gram / np.outer(size, size))
    null = vectors[:, : len(gone)] / size[:, None]
    return gone[gone < n], null[:n, :] @ np.linalg.pinv(null[gone])[:, gone < n]


def folds_covariance(fit: Fit) -> Array:
    """(p, p) of what fits without each region of the poses change: the jackknife over regions.

    Zero where regions cannot be left out.
    """
    out = np.zeros((fit.uncertainty.names.count,) * 2)
    if not fit.train.poses:
        return out
    poses, label = Poses(fit.estimator, fit.cell.state), regions(fit.train)
    parts = [part for part in (label == one for one in np.unique(label)) if not needed(poses, part)]
    active = np.flatnonzero(fit.estimator.model.active)
    steps = np.array([step_without(poses, part) for part in parts]).reshape(-1, len(active))
    out[np.ix_(active, active)] = (len(steps) - 1) / max(len(steps), 1) * steps.T @ steps
    return out


def differences(
    fit: Fit, value: list[Array], covariance: Array, kept: Array, told: list[Array]
) -> Iterator[Difference]:
    """Every link parameter, in the order of `Names`."""
    names, sigma = fit.uncertainty.names, np.sqrt(np.maximum(np.diag(covariance), 0.0))
    for i in range(len(sigma)):
        missing = [which for which, known in zip("AB", told, strict=True) if not known[i]]
        reason = ""
        if i in kept:
            reason = "base, reflectors or neighbours imitate it: kept as drawn"
        elif missing or sigma[i] == 0.0:
            reason = f"not identified in {' and '.join(missing) or 'A and B'}"
        size = math.nan if reason else float(sigma[i])
        yield Difference(
            names.all[i], names.units[i], float(value[0][i]), float(value[1][i]), size, reason
        )


def changed(one: Fit, other: Fit) -> tuple[tuple[Moved, ...], float]:
    """What moved from one calibration to the other, the clearest first; p-value of nothing.

    The poses of the second are new ones of the first, or the reverse where only that has poses.
    """
    for fit, new, sign in ((one, other, 1.0), (other, one, -1.0)):
        if new.data.poses:
            watched, _ = open_parameters(fit, replace(new.train, frames={}), ())
            found = search(watched, match_names(fit, watched, fit.identification.active))
            return tuple(replace(m, by=sign * m.by) for m in found.named), found.same
    return (), math.nan


def on_common(one: Fit, other: Fit) -> Iterator[OnPoses]:
    """Both on the poses of each: on those that its own fit did not see, if there are any."""
    for name, fit in (("A", one), ("B", other)):
        if not fit.data.poses:
            continue
        held = fit.held if fit.held.any() else ~fit.held
        data = fit.data.take(held)
        found = []
        for arm in (one, other):
            model, state = open_parameters(arm, replace(data, frames={}), ())[0].start
            found.append(accuracy(model.error(state)))
        which = "held-out" if fit.held.any() else "training"
        yield OnPoses(f"{which} poses of {name}", *found)


def remarks(one: Fit, other: Fit) -> Iterator[str]:
    """What the reader should know."""
    if not (one.data.poses or other.data.poses):
        yield (
            "neither file holds its poses, so that no joint can be said to have changed; save "
            "them with their poses"
        )
    if np.array_equal(one.data.y, other.data.y, equal_nan=True):
        yield (
            "both are fitted to the same measurements: what differs is the way of fitting, and "
            "the sigmas, which take them for independent, say nothing of it"
        )
    effects = [[name_effect(*t.key) for t in fit.cell.effects.terms] for fit in (one, other)]
    if effects[0] != effects[1]:
        told = " against ".join(", ".join(labels) or "none" for labels in effects)
        yield f"they hold different effects ({told}): geometry takes over part of what one lacks"
    change = links_of(other.cell.robot.mdh - one.cell.robot.mdh)
    change[zero_positions(one.cell.robot.prismatic)] = 0.0  # a service may set them anew
    if named := wild(one.uncertainty.names, change, one.cell.robot.reach()):
        yield f"implausibly large changes: {named}; are both of the same arm?"
    if np.abs(one.nominal.robot.mdh - other.nominal.robot.mdh).max() > ALIKE:
        yield "they start from different drawings: what neither identifies differs by that alone"
