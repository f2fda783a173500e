"""Corrected joint targets, for controllers that take no parameters.

The goal of a target is the flange pose of the nominal arm at the commanded joints.  Corrected
joints bring the calibrated arm, effects included, to that pose [docs/compensate.md].
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np

from minimax_cal.compensation.deliverable import (
    COMPENSATED_TARGETS,
    AccuracyFigures,
    Delivered,
    deliver_if_better,
)
from minimax_cal.core.arrays import Array, rms
from minimax_cal.core.display_text import format_first_names
from minimax_cal.core.errors import CalibrationError, DataError, OptionError
from minimax_cal.core.option_fields import option_field_in_group, take_option_fields_as_keywords
from minimax_cal.core.record_fields import FieldFormat, StoredSeparately, derived_field
from minimax_cal.core.results import Result
from minimax_cal.core.tables import Table, columns_to_records
from minimax_cal.fitting.opened_results import ResultOrFile as Given
from minimax_cal.fitting.opened_results import open_result
from minimax_cal.measuring.measurement_checks import check_and_complete_joints, list_robot_notices
from minimax_cal.measuring.measurements import (
    MAX_POINT_DISTANCE,
    Measurements,
    check_optional_columns,
)
from minimax_cal.measuring.visit_history import has_visit_order
from minimax_cal.modelling.cell import Cell, build_measurements_at_rest
from minimax_cal.modelling.effects.compliance import ALL_LINKS_GROUP
from minimax_cal.modelling.effects.effect_names import format_effect
from minimax_cal.modelling.effects.scene import bit_mask_to_numbers
from minimax_cal.modelling.effects.time_effects import REFERENCE_TEMPERATURE_C
from minimax_cal.modelling.inverse_with_effects import (
    InverseOutcome,
    InverseProblem,
    build_flange_cell,
    effect_joint_shifts_and_flange_motions,
    fit_rigid_motions,
    flange_points_in_base,
    target_lever,
)
from minimax_cal.robots import kinematics
from minimax_cal.robots.joint_sampling import random_joint_values_above_floor
from minimax_cal.robots.robot import Robot, load_robot

NOMINAL_FRAME_CHOICES = ("best-fit", "flange", "own")
BASE_PLACEMENT_POSES = 200  # poses that place a nominal base where no calibration did


@dataclass(frozen=True, eq=False)
class Compensation(Result):
    """Corrected joint targets.

    q: (m, n) corrected, commanded: (m, n) as given [rad, m].  distance, angle: (m,) what remains
    of the flange pose by the calibrated model [m, rad]; distance_before, angle_before: without
    correction.  outcome: m words.  sliding: (n,).  line: (m,) line of the file.
    frame: how the nominal arm was placed.  notices: what the reader should know.  delivered: the
    arm that was corrected for, and how well it does; None if not asked for.
    """

    KIND = "compensation"

    q: StoredSeparately[Array]
    commanded: StoredSeparately[Array]
    distance: StoredSeparately[Array]
    angle: StoredSeparately[Array]
    distance_before: StoredSeparately[Array]
    angle_before: StoredSeparately[Array]
    outcome: StoredSeparately[tuple[InverseOutcome, ...]]
    sliding: StoredSeparately[Array]
    line: StoredSeparately[Array]
    name: Annotated[str, FieldFormat(key="robot")]
    frame: str
    notices: tuple[str, ...]
    delivered: Delivered | None = None

    @property
    def expected(self) -> AccuracyFigures:
        """What the arm misses by once its targets are corrected: measured, not by the model."""
        return self.delivered.figures if self.delivered else AccuracyFigures()

    @property
    def failed(self) -> Array:
        """(m,) True where a target is missed."""
        return np.array([outcome.failed for outcome in self.outcome], dtype=bool)

    @derived_field()
    def missed(self) -> int:
        """How many targets are."""
        return int(self.failed.sum())

    def tables(self) -> tuple[Table, ...]:
        """What the correction does, how targets ended, and by how much each joint changes."""
        rows: list[tuple[object, ...]] = []
        missed, expected = self.failed, self.expected
        for title, which, off in (
            ("as commanded", np.ones_like(missed), self.before),
            ("missed, by the model", missed, (self.distance, self.angle)),
        ):
            if which.any():
                sizes = (f(1e3 * part[which]) for part in off for f in (rms, np.max))
                rows.append((title, which.sum(), *sizes))
        if not math.isnan(expected.rms):
            corrected = len(missed) - self.missed, expected.rms, expected.largest, None, None
            rows.append(("corrected, on the arm", *corrected))
        found = [(o, self.outcome.count(o), o.advice) for o in InverseOutcome if o in self.outcome]
        joints = (
            (f"J{j + 1}", "mm" if self.sliding[j] else "mrad", rms(by), np.abs(by).max())
            for j, by in enumerate(1e3 * (self.q - self.commanded).T)
        )
        return (
            Table.from_rows(f"{self.name}: error of the flange ({self.frame})", rows, "joints | "
                       "targets d | RMS mm .4f | max mm .4f | RMS mrad .4f | max mrad .4f"),
            Table.from_rows("targets", found, "status | targets d | meaning"),
            Table.from_rows("change of the joints", joints, "joint | unit | RMS .4f | max .4f"),
        )  # fmt: skip

    def headline(self) -> str:
        """The result in a sentence."""
        missed, said = self.failed, list[str]()
        if not missed.all():
            far, turned = (1e3 * part[~missed].max() for part in self.before)
            said.append(
                f"{len(missed) - self.missed} of {len(missed)} targets corrected, which are off by "
                f"up to {far:.3f} mm, {turned:.3f} mrad as commanded"
            )
        if missed.any():
            far, turned = (1e3 * part[missed].max() for part in (self.distance, self.angle))
            said.append(
                f"{self.missed} missed, which stay off by up to {far:.3f} mm, {turned:.3f} mrad"
            )
        return f"{'; '.join(said)}. Expect on the arm: {self.expected.describe()}."

    @property
    def before(self) -> tuple[Array, Array]:
        """Distance and angle of each target as commanded: (m,) [m] and (m,) [rad]."""
        return self.distance_before, self.angle_before

    def complaint(self) -> str:
        """Which targets are missed and what to try; '' if none is."""
        parts = []
        for kind in InverseOutcome:
            lines = [str(n) for n, o in zip(self.line, self.outcome, strict=True) if o == kind]
            if lines and kind.failed:
                parts.append(f"{kind} at line {format_first_names(lines)}: {kind.advice}")
        said = f"{self.missed} of {len(self.q)} targets are missed: "
        return said + "; ".join(parts) if self.missed else ""

    def extra_file_content(self, *, with_measurements: bool = True) -> dict[str, Any]:
        """The targets, joints in SI."""
        columns = {
            "line": self.line,
            "status": map(str, self.outcome),
            "q": self.q,
            "residual_mm": 1e3 * self.distance,
            "residual_mrad": 1e3 * self.angle,
            "before_mm": 1e3 * self.distance_before,
            "before_mrad": 1e3 * self.angle_before,
        }
        return {"targets": columns_to_records(columns)}


COMPENSATION_OPTION_GROUP = "How targets are corrected"
compensation_option = option_field_in_group(COMPENSATION_OPTION_GROUP)


@dataclass(frozen=True)
class CompensateOptions:
    """How targets are corrected.

    frame: where the nominal arm stands, one of FRAMES.
    tolerance: of the position, and of the orientation times the lever [m].
    most_change: of a joint [rad; half as many m for a slide].
    lever: what a radian counts as [m], NaN for the targets' own.
    clock: the moment of the calibration's session, 0 to 1, that the arm is in: what follows that
    session's time is then corrected as it was at that moment, and not at all where NaN.
    rung: of a diagnosis, the last unless given, of which the confirmed effects count. The arm is
    fitted again for exactly the effects that joints can correct (`deliver`).
    keep_anyway: also where the calibrated arm is no better than the drawn one.
    """

    frame: str = compensation_option(
        "best-fit",
        "Where the nominal arm stands: best-fit (base and reflectors as the calibration placed "
        "them), flange (the base so, the flange as drawn), own (on the calibrated base).",
    )
    tolerance: float = compensation_option(
        1e-5, "What may remain of a target that counts as reached.", "mm"
    )
    most_change: float = compensation_option(
        np.pi / 36.0,
        "The most that a joint may change (a slide 8.7 mm per degree).",
        "deg",
        flag="--max-change",
    )
    lever: float = compensation_option(
        np.nan, "What a radian counts as [default: the targets' own].", "mm"
    )
    clock: float = compensation_option(
        np.nan,
        "Correct what follows the session's time too, as at this moment of it, 0 to 1 [default: "
        "not at all].",
    )
    rung: int | None = None
    keep_anyway: bool = compensation_option(
        False, "Also where the calibrated arm is no better than the drawn one."
    )


@take_option_fields_as_keywords(options=CompensateOptions)
def compensate(
    fit: Given,
    targets: Measurements | Array | Sequence[Sequence[float]],
    nominal: Robot | str | Path | None = None,
    *,
    options: CompensateOptions,
) -> Compensation:
    """Joints that bring the calibrated arm to where the nominal one would stand.

    Parameters
    ----------
    fit
        A calibration, its cell, a diagnosis, a relative calibration, or its file.
    targets
        (m, n) commanded joints in the order of the path [rad, m], or measurements, whose
        columns (payload, approach ...) then count.
    nominal
        The arm the controller believes in, its file or its name; that of the fit unless
        given.
    options
        See `CompensateOptions`.

    Returns
    -------
    Compensation
        Corrected joints, with a status of each target.

    Raises
    ------
    CalibrationError
        For wrong input.

    Examples
    --------
    >>> q = mc.compensate(fit, targets, tolerance=2e-5).q
    """
    check_compensate_options(options)
    nominal = load_robot(nominal) if isinstance(nominal, str | Path) else nominal
    known = open_result(fit, options.rung)
    moment = None if np.isnan(options.clock) else options.clock
    data = convert_targets_to_measurements(targets, known.cell.robot, moment or 0.0)
    torques = build_flange_cell(known.cell).pose_arm(data).has_measured_torques
    made = deliver_if_better(
        known, COMPENSATED_TARGETS, options.keep_anyway, moment, has_measured_torques=torques
    )
    cell, drawn = made.cell, made.nominal if known.placed else None
    robot = made.nominal.robot if made.nominal else None
    if nominal is not None and not (robot and has_same_geometry(nominal, robot)):
        robot, drawn = nominal, None
    if robot is None:
        source = fit if isinstance(fit, (str, Path)) else "the fit"
        raise CalibrationError(f"{source}: does not tell its nominal robot; give nominal=")
    check_same_joints(robot, cell.robot)
    arm = build_flange_cell(cell)
    base, tool, said = place_nominal_robot(cell, arm, robot, drawn, options.frame)
    goal = base @ robot.pose(data.q) @ tool
    lever = target_lever(cell) if np.isnan(options.lever) else options.lever
    reach = InverseProblem(arm, data, goal, lever, options.tolerance, options.most_change)
    q, outcome = reach.solve()
    lacks = (made.sentence(),) if made.lacks else ()
    said = (*data.notices, *said, *collect_compensation_notices(arm, data), *lacks)
    return Compensation(
        q,
        data.q,
        *reach.position_and_angle_errors(q),
        *reach.position_and_angle_errors(data.q),
        outcome,
        cell.robot.prismatic,
        data.line,
        cell.robot.name,
        options.frame,
        said,
        made,
    )


def check_compensate_options(options: CompensateOptions) -> None:
    """Raise OptionError for choices that `compensate` does not have."""
    if options.frame not in NOMINAL_FRAME_CHOICES:
        raise OptionError(f"no frame {options.frame!r}; choose {', '.join(NOMINAL_FRAME_CHOICES)}")
    sizes = {"tolerance": options.tolerance, "largest change": options.most_change}
    for name, value in sizes.items():
        if not (np.isfinite(value) and value > 0.0):
            raise OptionError(f"{name} {value:g}: must be positive and finite")
    lever, clock = options.lever, options.clock
    if lever <= 0.0 or lever > MAX_POINT_DISTANCE:
        raise OptionError(
            f"lever {lever:g} m: must be positive and finite, at most {MAX_POINT_DISTANCE:g}"
        )
    if not (np.isnan(clock) or 0.0 <= clock <= 1.0):
        raise OptionError(f"clock {clock:g}: give 0 (start of the session) to 1 (its end)")


def has_same_geometry(first_robot: Robot, second_robot: Robot) -> bool:
    """Whether two robots have the same geometry."""
    if first_robot.joints != second_robot.joints:
        return False
    equal = np.allclose(first_robot.mdh, second_robot.mdh, rtol=0.0, atol=1e-9)
    return bool(
        equal
        and np.all(first_robot.sign == second_robot.sign)
        and np.all(first_robot.prismatic == second_robot.prismatic)
    )


def check_same_joints(nominal: Robot, calibrated_robot: Robot) -> None:
    """Raise OptionError if the joints of the nominal robot are not those of the calibrated one."""
    if nominal.joints != calibrated_robot.joints:
        raise OptionError(
            f"{nominal.name} has {nominal.joints} joints, the calibrated {calibrated_robot.name} "
            f"{calibrated_robot.joints}; give the nominal robot of this fit, nominal="
        )
    odd = (nominal.prismatic != calibrated_robot.prismatic) | (
        nominal.sign != calibrated_robot.sign
    )
    if odd.any():
        raise OptionError(
            f"joint {int(np.argmax(odd)) + 1} of {nominal.name} has another type or sign than the "
            "calibrated one's; give the nominal robot of this fit, nominal="
        )


def convert_targets_to_measurements(
    targets: Measurements | Array | Sequence[Sequence[float]], robot: Robot, session_moment: float
) -> Measurements:
    """The commanded joints as measurements without targets.  Raises DataError."""
    if isinstance(targets, Measurements):
        data = targets
    else:
        try:
            q = np.atleast_2d(np.array(targets, dtype=float))
        except (TypeError, ValueError) as error:
            raise DataError(f"targets: must be numbers, one row of joints each ({error})") from None
        if q.ndim != 2 or not np.all(np.isfinite(q)):
            raise DataError("targets: must be finite numbers, one row of joints each")
        rows = np.arange(len(q)) + 1
        nowhere = np.zeros((len(q), 0, 3))
        sliding = robot.prismatic if q.shape[1] == robot.joints else np.zeros(q.shape[1], bool)
        data = Measurements(q, nowhere, (), sliding, rows, {}, source="targets")
    if not data.poses:
        raise DataError(f"{data.source}: holds no targets")
    data = check_and_complete_joints(robot, data)
    check_optional_columns(data)
    data = data if has_visit_order(data) else data.in_visit_order()  # a path is in its order
    return replace(data, columns={**data.columns, "clock": np.full(data.poses, session_moment)})


def collect_compensation_notices(arm_cell: Cell, measurements: Measurements) -> list[str]:
    """What the reader should know about effects and limits."""
    out = list_robot_notices(arm_cell.robot, measurements)
    terms = arm_cell.effects.terms
    timed = [
        format_effect(*term.key)
        for term in terms
        if {"constant", "fast", "since"} & term.choice.keys()
    ]
    if timed:
        out.append(
            f"{', '.join(timed)} depends on the time in the calibration's session: taken at "
            f"{measurements.columns['clock'][0]:g} of it (clock 0 is its start, 1 its end)"
        )
    scene = arm_cell.pose_arm(measurements.take(np.arange(1)))
    whole = any(
        part % 4 == ALL_LINKS_GROUP
        for term in terms
        if "assumed" not in term.choice
        for part in bit_mask_to_numbers(term.choice.get("parts", 0.0))
    )
    if whole and not (scene.has_known_masses or scene.has_measured_torques):
        out.append(
            "the compliance was fitted to measured torques, and these targets have none (tau1_Nm "
            "...): torques of assumed masses are used"
        )
    warm = [format_effect(*term.key) for term in terms if "temperature" in term.choice]
    if warm and "temperature" not in measurements.columns:
        out.append(
            f"{', '.join(warm)}: no column temperature_C, taken at {REFERENCE_TEMPERATURE_C:.0f} C"
        )
    return out


class NominalPlacement(NamedTuple):
    """Base and flange offset of the nominal arm (4, 4), and notices."""

    base: Array
    tool: Array
    notices: tuple[str, ...]


def place_nominal_robot(
    cell: Cell, arm_cell: Cell, nominal: Robot, nominal_cell: Cell | None, frame: str
) -> NominalPlacement:
    """Where the nominal arm stands: its base in the calibrated base, its flange's own offset.

    (4, 4) each: the goal of the calibrated flange is base @ nominal pose @ tool.  And notices.
    """
    if frame == "own":
        return NominalPlacement(np.eye(4), np.eye(4), ())
    if nominal_cell:
        base = np.linalg.inv(cell.base) @ nominal_cell.base
        if frame == "flange":
            return NominalPlacement(base, np.eye(4), ())
        return NominalPlacement(
            base, fit_rigid_motions(cell.target_positions, nominal_cell.target_positions), ()
        )
    q = random_joint_values_above_floor(nominal, BASE_PLACEMENT_POSES, np.random.default_rng(0))
    turn, moved = effect_joint_shifts_and_flange_motions(
        arm_cell, build_measurements_at_rest(q, arm_cell.target_names, arm_cell.robot)
    )
    flange = moved @ kinematics.forward_kinematics(
        arm_cell.robot.mdh, arm_cell.robot.chain_joint_values(q) + turn, arm_cell.robot.prismatic
    )
    pose, tool = nominal.pose(q), np.eye(4)
    for _ in range(1 if frame == "flange" else 50):
        base = fit_rigid_motions(
            flange_points_in_base(pose @ tool, arm_cell.target_positions).reshape(-1, 3),
            flange_points_in_base(flange, arm_cell.target_positions).reshape(-1, 3),
        )
        if frame == "best-fit":
            wanted = flange_points_in_base(
                np.linalg.inv(base @ pose) @ flange, arm_cell.target_positions
            ).mean(axis=0)
            tool = fit_rigid_motions(arm_cell.target_positions, wanted)
    said = (
        f"the nominal base was placed by {BASE_PLACEMENT_POSES} "
        f"poses of the two models, not by the measurements"
    )
    return NominalPlacement(base, tool, (said,))
