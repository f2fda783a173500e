"""Corrected joint targets, for controllers that take no parameters.

The goal of a target is the flange pose of the nominal arm at the commanded joints.  Corrected
joints bring the calibrated arm, effects included, to that pose [docs/compensate.md].
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from minimax_cal.correcting.deliverable import (
    COMPENSATED,
    Delivered,
    Figures,
    kept,
)
from minimax_cal.fitting.opened import Result as Given
from minimax_cal.fitting.opened import open_result
from minimax_cal.ground.arrays import Array, rms
from minimax_cal.ground.errors import CalibrationError, DataError, OptionError
from minimax_cal.ground.facts import Apart, Fact, derived
from minimax_cal.ground.options import grouped, takes
from minimax_cal.ground.results import Result
from minimax_cal.ground.tables import Table, records_of
from minimax_cal.ground.words import name_first
from minimax_cal.measuring.checks import arm_notices, check_joints
from minimax_cal.measuring.history import ordered
from minimax_cal.measuring.measurements import FARTHEST, Measurements, check_columns
from minimax_cal.modelling.cell import Cell, still
from minimax_cal.modelling.effects.compliance import WHOLE
from minimax_cal.modelling.effects.scene import unmasked
from minimax_cal.modelling.effects.time import ROOM
from minimax_cal.modelling.effects.words import name_effect
from minimax_cal.modelling.reach import Outcome, Reach, arm_of, bent, lever_of, motion, seen
from minimax_cal.robots import kinematics
from minimax_cal.robots.robot import Robot, load_robot
from minimax_cal.robots.sampling import random_poses

FRAMES = ("best-fit", "flange", "own")
SAMPLE = 200  # poses that place a nominal base where no calibration did


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

    q: Apart[Array]
    commanded: Apart[Array]
    distance: Apart[Array]
    angle: Apart[Array]
    distance_before: Apart[Array]
    angle_before: Apart[Array]
    outcome: Apart[tuple[Outcome, ...]]
    sliding: Apart[Array]
    line: Apart[Array]
    name: Annotated[str, Fact(key="robot")]
    frame: str
    notices: tuple[str, ...]
    delivered: Delivered | None = None

    @property
    def expected(self) -> Figures:
        """What the arm misses by once its targets are corrected: measured, not by the model."""
        return self.delivered.figures if self.delivered else Figures()

    @property
    def failed(self) -> Array:
        """(m,) True where a target is missed."""
        return np.array([outcome.failed for outcome in self.outcome], dtype=bool)

    @derived()
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
        found = [(o, self.outcome.count(o), o.advice) for o in Outcome if o in self.outcome]
        joints = (
            (f"J{j + 1}", "mm" if self.sliding[j] else "mrad", rms(by), np.abs(by).max())
            for j, by in enumerate(1e3 * (self.q - self.commanded).T)
        )
        return (
            Table.made(f"{self.name}: error of the flange ({self.frame})", rows, "joints | "
                       "targets d | RMS mm .4f | max mm .4f | RMS mrad .4f | max mrad .4f"),
            Table.made("targets", found, "status | targets d | meaning"),
            Table.made("change of the joints", joints, "joint | unit | RMS .4f | max .4f"),
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
        return f"{'; '.join(said)}. Expect on the arm: {self.expected.sentence()}."

    @property
    def before(self) -> tuple[Array, Array]:
        """Distance and angle of each target as commanded: (m,) [m] and (m,) [rad]."""
        return self.distance_before, self.angle_before

    def complaint(self) -> str:
        """Which targets are missed and what to try; '' if none is."""
        parts = []
        for kind in Outcome:
            lines = [str(n) for n, o in zip(self.line, self.outcome, strict=True) if o == kind]
            if lines and kind.failed:
                parts.append(f"{kind} at line {name_first(lines)}: {kind.advice}")
        said = f"{self.missed} of {len(self.q)} targets are missed: "
        return said + "; ".join(parts) if self.missed else ""

    def beside(self, *, poses: bool = True) -> dict[str, Any]:
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
        return {"targets": records_of(columns)}


HOW = "How targets are corrected"
how = grouped(HOW)


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

    frame: str = how(
        "best-fit",
        "Where the nominal arm stands: best-fit (base and reflectors as the calibration placed "
        "them), flange (the base so, the flange as drawn), own (on the calibrated base).",
    )
    tolerance: float = how(1e-5, "What may remain of a target that counts as reached.", "mm")
    most_change: float = how(
        np.pi / 36.0,
        "The most that a joint may change (a slide 8.7 mm per degree).",
        "deg",
        flag="--max-change",
    )
    lever: float = how(np.nan, "What a radian counts as [default: the targets' own].", "mm")
    clock: float = how(
        np.nan,
        "Correct what follows the session's time too, as at this moment of it, 0 to 1 [default: "
        "not at all].",
    )
    rung: int | None = None
    keep_anyway: bool = how(False, "Also where the calibrated arm is no better than the drawn one.")


@takes(options=CompensateOptions)
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
    check_choices(options)
    nominal = load_robot(nominal) if isinstance(nominal, str | Path) else nominal
    known = open_result(fit, options.rung)
    moment = None if np.isnan(options.clock) else options.clock
    data = path_of(targets, known.cell.robot, moment or 0.0)
    torques = arm_of(known.cell).scene(data).measured_torques
    made = kept(known, COMPENSATED, options.keep_anyway, moment, torques=torques)
    cell, drawn = made.cell, made.nominal if known.placed else None
    robot = made.nominal.robot if made.nominal else None
    if nominal is not None and not (robot and same(nominal, robot)):
        robot, drawn = nominal, None
    if robot is None:
        source = fit if isinstance(fit, (str, Path)) else "the fit"
        raise CalibrationError(f"{source}: does not tell its nominal robot; give nominal=")
    check_like(robot, cell.robot)
    arm = arm_of(cell)
    base, tool, said = placed(cell, arm, robot, drawn, options.frame)
    goal = base @ robot.pose(data.q) @ tool
    lever = lever_of(cell) if np.isnan(options.lever) else options.lever
    reach = Reach(arm, data, goal, lever, options.tolerance, options.most_change)
    q, outcome = reach.best()
    lacks = (made.sentence(),) if made.lacks else ()
    said = (*data.notices, *said, *remarks(arm, data), *lacks)
    return Compensation(
        q, data.q, *reach.error(q), *reach.error(data.q), outcome, cell.robot.prismatic, data.line,
        cell.robot.name, options.frame, said, made,
    )  # fmt: skip


def check_choices(options: CompensateOptions) -> None:
    """Raise OptionError for choices that `compensate` does not have."""
    if options.frame not in FRAMES:
        raise OptionError(f"no frame {options.frame!r}; choose {', '.join(FRAMES)}")
    sizes = {"tolerance": options.tolerance, "largest change": options.most_change}
    for name, value in sizes.items():
        if not (np.isfinite(value) and value > 0.0):
            raise OptionError(f"{name} {value:g}: must be positive and finite")
    lever, clock = options.lever, options.clock
    if lever <= 0.0 or lever > FARTHEST:
        raise OptionError(f"lever {lever:g} m: must be positive and finite, at most {FARTHEST:g}")
    if not (np.isnan(clock) or 0.0 <= clock <= 1.0):
        raise OptionError(f"clock {clock:g}: give 0 (start of the session) to 1 (its end)")


def same(one: Robot, other: Robot) -> bool:
    """Whether two robots have the same geometry."""
    if one.joints != other.joints:
        return False
    equal = np.allclose(one.mdh, other.mdh, rtol=0.0, atol=1e-9)
    return bool(
        equal and np.all(one.sign == other.sign) and np.all(one.prismatic == other.prismatic)
    )


def check_like(nominal: Robot, robot: Robot) -> None:
    """Raise OptionError if the joints of the nominal robot are not those of the calibrated one."""
    if nominal.joints != robot.joints:
        raise OptionError(
            f"{nominal.name} has {nominal.joints} joints, the calibrated {robot.name} "
            f"{robot.joints}; give the nominal robot of this fit, nominal="
        )
    odd = (nominal.prismatic != robot.prismatic) | (nominal.sign != robot.sign)
    if odd.any():
        raise OptionError(
            f"joint {int(np.argmax(odd)) + 1} of {nominal.name} has another type or sign than the "
            "calibrated one's; give the nominal robot of this fit, nominal="
        )


def path_of(
    targets: Measurements | Array | Sequence[Sequence[float]], robot: Robot, clock: float
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
    data = check_joints(robot, data)
    check_columns(data)
    data = data if ordered(data) else data.in_visit_order()  # a path is in its order
    return replace(data, columns={**data.columns, "clock": np.full(data.poses, clock)})


def remarks(arm: Cell, data: Measurements) -> list[str]:
    """What the reader should know about effects and limits."""
    out = arm_notices(arm.robot, data)
    terms = arm.effects.terms
    timed = [
        name_effect(*term.key)
        for term in terms
        if {"constant", "fast", "since"} & term.choice.keys()
    ]
    if timed:
        out.append(
            f"{', '.join(timed)} depends on the time in the calibration's session: taken at "
            f"{data.columns['clock'][0]:g} of it (clock 0 is its start, 1 its end)"
        )
    scene = arm.scene(data.take(np.arange(1)))
    whole = any(
        part % 4 == WHOLE
        for term in terms
        if "assumed" not in term.choice
        for part in unmasked(term.choice.get("parts", 0.0))
    )
    if whole and not (scene.known_masses or scene.measured_torques):
        out.append(
            "the compliance was fitted to measured torques, and these targets have none (tau1_Nm "
            "...): torques of assumed masses are used"
        )
    warm = [name_effect(*term.key) for term in terms if "temperature" in term.choice]
    if warm and "temperature" not in data.columns:
        out.append(f"{', '.join(warm)}: no column temperature_C, taken at {ROOM:.0f} C")
    return out


def placed(
    cell: Cell, arm: Cell, nominal: Robot, drawn: Cell | None, frame: str
) -> tuple[Array, Array, tuple[str, ...]]:
    """Where the nominal arm stands: its base in the calibrated base, its flange's own offset.

    (4, 4) each: the goal of the calibrated flange is base @ nominal pose @ tool.  And notices.
    """
    if frame == "own":
        return np.eye(4), np.eye(4), ()
    if drawn:
        base = np.linalg.inv(cell.base) @ drawn.base
        if frame == "flange":
            return base, np.eye(4), ()
        return base, motion(cell.target_positions, drawn.target_positions), ()
    q = random_poses(nominal, SAMPLE, np.random.default_rng(0))
    turn, moved = bent(arm, still(q, arm.target_names, arm.robot))
    flange = moved @ kinematics.forward(
        arm.robot.mdh, arm.robot.turned(q) + turn, arm.robot.prismatic
    )
    pose, tool = nominal.pose(q), np.eye(4)
    for _ in range(1 if frame == "flange" else 50):
        base = motion(
            seen(pose @ tool, arm.target_positions).reshape(-1, 3),
            seen(flange, arm.target_positions).reshape(-1, 3),
        )
        if frame == "best-fit":
            wanted = seen(np.linalg.inv(base @ pose) @ flange, arm.target_positions).mean(axis=0)
            tool = motion(arm.target_positions, wanted)
    said = (
        f"the nominal base was placed by {SAMPLE} poses of the two models, not by the measurements"
    )
    return base, tool, (said,)
