"""What people give for a motion diagnosis: logs, a payload, drive gains and gear ratios."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from minimax_cal.core.arrays import Array
from minimax_cal.core.errors import OptionError
from minimax_cal.core.option_fields import (
    option_field_in_group,
    parse_finite_numbers,
    parse_number_or_nan,
)
from minimax_cal.dynamics.logs import read_runs
from minimax_cal.dynamics.logs.log_table import CURRENT_UNIT, NO_TORQUE_UNIT, TORQUE_UNIT, Run
from minimax_cal.dynamics.regressor import (
    JointMotion,
    build_nominal_inertial_parameters,
    compute_link_inertial_parameters,
    regressor,
)
from minimax_cal.dynamics.torque_rows import (
    MotionLogs,
    TorqueArm,
    check_held_out_run_names,
    resample_and_filter_runs,
)
from minimax_cal.robots.gravity_torques import known_link_mass_mask
from minimax_cal.robots.robot import Robot, load_robot
from minimax_cal.robots.urdf_robot import is_urdf_or_mjcf_source, load_urdf

MAX_PAYLOAD_KG, MAX_PAYLOAD_DISTANCE = (
    1e4,
    10.0,
)  # payload of the largest arms, several times over [kg, m]
MAX_GAIN_OR_RATIO = 1e6  # a gear ratio, or a torque for one ampere [N m/A], and 1 / the least

Payload = tuple[float, tuple[float, float, float]]
ARM_OPTION_GROUP = "The arm"
arm_option, judging_option = (
    option_field_in_group(ARM_OPTION_GROUP),
    option_field_in_group("What judges"),
)


def parse_payload(payload_text: str) -> Payload:
    """KG@x,y,z in kg and m.  Raises OptionError."""
    mass, mark, at = payload_text.partition("@")
    parts = [parse_number_or_nan(part) for part in at.split(",")] if mark else [0.0, 0.0, 0.0]
    if not parse_number_or_nan(mass) > 0.0 or len(parts) != 3 or not all(map(math.isfinite, parts)):
        raise OptionError(f"payload={payload_text!r}: give KG@x,y,z in kg and m, as 2@0,0,0.05")
    return parse_number_or_nan(mass), (parts[0], parts[1], parts[2])


@dataclass(frozen=True, eq=False)
class MotionDiagnosisInputs:
    """What a motion diagnosis begins with.

    fold_by_row: (R,) in which a row of the logs is left out, negative for rows that are always
    fitted. notices: of the files.
    """

    arm: TorqueArm
    logs: MotionLogs
    fold_by_row: Array
    notices: tuple[str, ...]


@dataclass(frozen=True)
class MotionKnown:
    """What is known of an arm whose motion was logged, and which of its runs judge.

    payload: what the flange is known to carry: its mass [kg] and its centre in the last frame [m].
    A mass that a run itself reports counts for that run.
    drive_gain: torque for one ampere, of each joint [N m/A], where the logs hold currents.
    ratio: gear ratio, of all joints or of each.
    holdout: share of the runs that judge, left out in turn; in a simulator the last ones, and of a
    single run its end.
    holdout_run: names of runs that judge instead, and that neither the search nor a fit sees.
    """

    payload: Payload | None = arm_option(  # noqa: RUF009
        None,
        "What the flange is known to carry: kg, and its centre in the last frame in m.",
        metavar="KG@X,Y,Z",
        read=parse_payload,
    )
    drive_gain: Sequence[float] | None = arm_option(
        None,
        "Torque for one ampere of each joint, N m per A.",
        metavar="LIST",
        read=partial(parse_finite_numbers, name="drive_gain"),
    )
    ratio: float | Sequence[float] | None = arm_option(
        None,
        "Gear ratio of all joints, or of each.",
        metavar="LIST",
        read=partial(parse_finite_numbers, name="ratio"),
    )
    holdout: float = judging_option(0.2, "Share of the runs that is left out in turn to judge.")
    holdout_run: str | Sequence[str] | None = judging_option(
        None,
        "Judge on this run alone, which no fit and no search sees.",
        metavar="NAME",
        many=tuple,
    )

    def read_inputs(
        self, robot: Robot | str | Path, logs: Sequence[Run | str | Path] | str | Path
    ) -> MotionDiagnosisInputs:
        """Arm, rows and folds of a diagnosis.  Raises CalibrationError."""
        arm_of = load_robot(robot)
        runs = read_checked_runs(robot, arm_of, logs)
        rows = resample_and_filter_runs(self.add_payload_to_runs(runs))
        arm = TorqueArm.build(
            arm_of,
            self.find_drive_gains(arm_of, runs),
            self.find_gear_ratios(arm_of),
            self.payload_inertial_parameters_per_kg,
            rows,
        )
        held_out_runs = check_held_out_run_names(rows, self.holdout_run)
        if not (held_out_runs or 0.0 < self.holdout < 1.0):
            raise OptionError(f"holdout={self.holdout:g} must lie between 0 and 1")
        notices = dict.fromkeys(text for run in runs for text in run.notices)
        run_fold = rows.split_rows_into_folds(self.holdout, held_out_runs)
        return MotionDiagnosisInputs(arm, rows, run_fold, tuple(notices))

    def add_payload_to_runs(self, runs: Sequence[Run]) -> list[Run]:
        """The runs with the mass at the flange, where they say none.  Raises OptionError."""
        if self.payload is None:
            return [replace(run, payload=None) for run in runs]
        mass, at = self.payload
        if not (0.0 < mass <= MAX_PAYLOAD_KG and np.abs(at).max() <= MAX_PAYLOAD_DISTANCE):
            raise OptionError(
                f"payload of {mass:.3g} kg at {tuple(at)} m: give "
                f"at most {MAX_PAYLOAD_KG:g} kg within "
                f"{MAX_PAYLOAD_DISTANCE:g} m of the flange"
            )
        return [run if run.payload is not None else replace(run, payload=mass) for run in runs]

    @property
    def payload_inertial_parameters_per_kg(self) -> Array:
        """(10,) inertial parameters of what the flange carries, per kilogram."""
        if self.payload is None:
            return np.zeros(10)
        return compute_link_inertial_parameters(
            1.0, np.array(self.payload[1], dtype=float), np.zeros(6)
        )

    def find_drive_gains(self, robot: Robot, runs: Sequence[Run]) -> Array:
        """(n,) torque per unit of the log; empty where currents have none.  Raises OptionError."""
        n, given = robot.joints, self.drive_gain
        if runs[0].unit != CURRENT_UNIT:
            if given is not None:
                what = "holds torques, not currents; leave it"
                raise OptionError(f"drive_gain: {runs[0].source} {what}")
            return np.ones(n)
        gain = np.array(robot.drive_gain if given is None else given, dtype=float)
        if given is not None and (
            gain.shape != (n,) or not np.all(gain > 0.0) or has_implausible_gain_or_ratio(gain)
        ):
            raise OptionError(
                f"drive_gain must be {n} positive numbers up to "
                f"{MAX_GAIN_OR_RATIO:g}, N m per A, one for "
                "each joint"
            )
        return gain if gain.size and np.isfinite(gain).all() else np.zeros(0)

    def require_drive_gains(self, robot: Robot, runs: Sequence[Run]) -> Array:
        """The same for a simulator.  Raises OptionError where none is known."""
        gains = self.find_drive_gains(robot, runs)
        if not len(gains):
            raise OptionError(
                f"{runs[0].source}: holds currents; give drive_gain=, the torque for one ampere of "
                "each joint: a simulator counts in N m"
            )
        return gains

    def find_gear_ratios(self, robot: Robot) -> Array:
        """(n,) gear ratios.  Raises OptionError."""
        if self.ratio is None:
            return robot.ratio
        values = np.atleast_1d(np.array(self.ratio, dtype=float))
        if values.shape not in ((1,), (robot.joints,)) or has_implausible_gain_or_ratio(values):
            raise OptionError(
                f"ratio must be a number, or one for each of {robot.joints} joints, between "
                f"{1.0 / MAX_GAIN_OR_RATIO:g} and {MAX_GAIN_OR_RATIO:g}"
            )
        return np.array(np.broadcast_to(values, robot.joints))


def read_runs_of_robot(
    robot_source: Robot | str | Path, logs: Sequence[Run | str | Path] | str | Path
) -> tuple[Run, ...]:
    """The runs of an arm, those of files read.  Raises CalibrationError."""
    listed = [logs] if isinstance(logs, str | Path) else list(logs)
    paths = [one for one in listed if not isinstance(one, Run)]
    runs = [one for one in listed if isinstance(one, Run)]
    if not paths:
        return tuple(runs)
    names: tuple[str, ...] = ()
    if not isinstance(robot_source, Robot) and is_urdf_or_mjcf_source(
        robot_source
    ):  # a URDF or MJCF
        names = tuple(joint.name for joint in load_urdf(robot_source).chain if joint.is_moving)
    return (*runs, *read_runs(paths, names))


def read_checked_runs(
    robot_source: Robot | str | Path,
    robot: Robot,
    logs: Sequence[Run | str | Path] | str | Path,
    *,
    allow_commands_only: bool = False,
) -> tuple[Run, ...]:
    """The runs of this robot and of one unit, with notices of what does not fit the robot.

    allow_commands_only: whether these will do without torques.  Raises CalibrationError.
    """
    runs = read_runs_of_robot(robot_source, logs)
    if not runs:
        raise OptionError("logs: name a file or more; each is a trajectory")
    for run in runs:
        if run.joints != robot.joints:
            raise OptionError(
                f"{run.source}: has {run.joints} joints, {robot.name} has {robot.joints}; give the "
                "log of this arm"
            )
        if run.unit == NO_TORQUE_UNIT and not allow_commands_only:
            what = "no column of torque or current; log tau1_Nm (or i1_A), tau2_Nm, ..."
            raise OptionError(f"{run.source}: {what}")
        if run.unit != runs[0].unit:
            raise OptionError(
                f"{run.source}: is in {run.unit}, {runs[0].source} in {runs[0].unit}; diagnose "
                "currents and torques apart"
            )
    return tuple(add_notices_of_robot_mismatch(robot, run) for run in runs)


def has_implausible_gain_or_ratio(values: Array) -> bool:
    """Whether a number is zero, none, or of a size that no drive has."""
    size = np.abs(values)
    return not bool(np.all((size >= 1.0 / MAX_GAIN_OR_RATIO) & (size <= MAX_GAIN_OR_RATIO)))


# ---- what only a robot's file can tell of a log --------------------------------------------------


MAX_GRAVITY_COMPARISON_ROWS = 400  # rows of a run that are compared with gravity
MIN_GRAVITY_TORQUE_RANGE = (
    5.0  # range of gravity's torque at a joint that shows the size of a torque [N m]
)
MIN_PLAUSIBLE_TORQUE_SCALE, MAX_PLAUSIBLE_TORQUE_SCALE = (
    0.4,
    2.5,
)  # masses of data sheets are not wrong by more
MIN_GRAVITY_CORRELATION = (
    0.9  # correlation of a torque with gravity; 0.93 to 0.96 at the shoulder of real arms
)
JOINT_LIMIT_SLACK_SHARE = 0.01  # of the range of a joint: how far outside its limits it may be


def add_notices_of_robot_mismatch(robot: Robot, run: Run) -> Run:
    """A run of the robot's joints, with notices of what does not fit it."""
    source, notices = run.source, list(run.notices)

    # Joints outside their limits.
    slack = JOINT_LIMIT_SLACK_SHARE * (robot.upper - robot.lower)
    slack = np.where(np.isfinite(slack), slack, 0.0)
    off = (run.q < robot.lower - slack) | (run.q > robot.upper + slack)
    for j in np.flatnonzero(off.any(axis=0)).tolist():
        low, high = run.q[:, j].min(), run.q[:, j].max()
        unit, scale = ("mm", 1e3) if robot.prismatic[j] else ("deg", 180.0 / np.pi)
        notices.append(
            f"{source}: joint {j + 1} moves from {scale * low:.4g} to {scale * high:.4g} "
            f"{unit}, outside the limits of {robot.name}; check its unit and zero"
        )

    # Torques that are not those that hold the arm's masses: order, sign, size.
    if run.unit == NO_TORQUE_UNIT or not known_link_mass_mask(robot).all():
        return replace(run, notices=tuple(notices))
    rows = np.unique(np.linspace(0, len(run.time) - 1, MAX_GRAVITY_COMPARISON_ROWS).astype(int))
    weight, torque = compute_gravity_torques(robot, run.q[rows]), run.torque[rows]
    span = np.where(robot.prismatic, 0.0, np.ptp(weight, axis=0))
    j = int(np.argmax(span))
    if span[j] < MIN_GRAVITY_TORQUE_RANGE:
        return replace(run, notices=tuple(notices))
    alike = np.nan_to_num(np.corrcoef(weight[:, j], torque.T)[0, 1:])
    other = int(np.argmax(np.abs(alike)))
    if abs(alike[other]) > MIN_GRAVITY_CORRELATION and other != j:
        notices.append(
            f"{source}: the torque of joint {other + 1} follows gravity at joint {j + 1} "
            f"(correlation {alike[other]:.2f}, that of joint {j + 1} {alike[j]:.2f}); check the "
            "order of the joints"
        )
    elif alike[j] < -MIN_GRAVITY_CORRELATION:
        notices.append(
            f"{source}: the torque of joint {j + 1} has the sign of gravity, not of what holds "
            "it; check its sign"
        )
    elif run.unit == TORQUE_UNIT:
        speed = np.gradient(run.q[:, j], run.time)[rows]
        columns = np.column_stack([weight[:, j], np.sign(speed), speed, np.ones(len(speed))])
        scale = float(np.linalg.lstsq(columns, torque[:, j], rcond=None)[0][0])
        if not MIN_PLAUSIBLE_TORQUE_SCALE < scale < MAX_PLAUSIBLE_TORQUE_SCALE:
            notices.append(
                f"{source}: the torque of joint {j + 1} is {scale:.3g} times what holds the masses "
                f"of {robot.name}; a current? then name the columns i1_A, i2_A, ..."
            )
    return replace(run, notices=tuple(notices))


def compute_gravity_torques(robot: Robot, q: Array) -> Array:
    """(m, n) torques that hold the arm's links at rest [N m, N].  q: (m, n)."""
    rest = np.zeros_like(q)
    columns = regressor(robot, JointMotion(q, rest, rest))
    return columns @ build_nominal_inertial_parameters(robot).ravel()
