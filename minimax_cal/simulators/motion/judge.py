"""What judges a model: runs that no fit saw, their torques, and the drives that move it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
import scipy

from minimax_cal.core.arrays import Array
from minimax_cal.core.errors import OptionError
from minimax_cal.dynamics.drives import joint_commands
from minimax_cal.dynamics.known_inputs import MotionKnown
from minimax_cal.dynamics.logs.log_table import NO_TORQUE_UNIT, Run
from minimax_cal.dynamics.torque_rows import (
    UNUSED_EDGE_DURATION,
    ArmMotion,
    MotionLogs,
    TorqueArm,
    check_held_out_run_names,
    compute_rms_by_joint,
    interpolate_linearly,
    resample_and_filter_runs,
)
from minimax_cal.simulators.chain import ModelArm, fill_command_history
from minimax_cal.simulators.drive import check_simulation_is_stable
from minimax_cal.simulators.motion.model_parameters import ModelParameters, OpenedModel
from minimax_cal.simulators.result import LOGGED_COMMANDS_TEXT, MotionGapStep

# ---- a simulated arm along a log -----------------------------------------------------------------


HoldingTorque = Callable[
    [Array, Array, Array], Array
]  # torque of joint values, and how far they are off
HOLDING_BANDWIDTH = (
    2.0 * np.pi * 5.0
)  # of drives that hold an arm to a log, where none are given [1/s]


@dataclass(frozen=True, eq=False)
class PdGains:
    """Of proportional and derivative drives: (n,) stiffness [N m/rad] and damper [N m s/rad]."""

    stiffness: Array
    damper: Array

    def __call__(self, q: Array, off: Array, slow: Array) -> Array:
        """(n,) torque where joints and their speeds are off by so much."""
        return np.asarray(self.stiffness * off + self.damper * slow)


def compute_inverse_torque(chain: ModelArm, logs: MotionLogs) -> Array:
    """(M, n) torque that a model takes for the motion of logs, as its drives feel it [N m]."""
    mj, model, data, at, dofs = chain.create_data_with_indices()
    out = np.empty(logs.motion.q.shape)
    floating = ~model.jnt_actgravcomp[list(chain.joint_ids)].astype(bool)
    motion = logs.motion
    for k in range(len(out)):
        data.qpos[at], data.qvel[dofs], data.qacc[dofs] = motion.q[k], motion.qd[k], motion.qdd[k]
        mj.mj_inverse(model, data)
        out[k] = data.qfrc_inverse[dofs] + floating * data.qfrc_gravcomp[dofs]
    return out


def simulate_commands(chain: ModelArm, run: Run, commands: Array, source: str) -> Array:
    """(m, n) joint values where a model's own position servos bring an arm.

    commands: (m, n) at the times of the run [rad, m].  Raises RobotError for an unstable model.
    """
    servos = chain.servo_ids
    speeds = chain.find_feed_forward_joints_by_actuator()

    def drive(data: Any, now: int) -> None:
        data.ctrl[servos] = path[now]
        data.ctrl[list(speeds)] = rates[now, list(speeds.values())]
        if not now:  # delayed and filtered commands begin as if they had been there all the time
            fill_command_history(chain.model, data)
            states = chain.model.actuator_actadr[servos]
            data.act[states[states >= 0]] = path[0][states >= 0]

    path = interpolate_linearly(timesteps_along_log(run.time, chain), run.time, commands)
    rates = np.gradient(path, chain.timestep, axis=0)
    return simulate_run(chain, run, drive, source)


def simulate_torques(
    chain: ModelArm,
    run: Run,
    path: tuple[Array, Array, Array],
    holding_torque: HoldingTorque,
    source: str,
) -> Array:
    """(m, n) joint values under torques, and drives that hold an arm to joint values and speeds.

    path: these values and speeds and torques at the steps of the model, (steps, n) each
    [rad, rad/s, N m].  The model's own actuators are off, and it has all its weight.
    """
    at, dofs, model = chain.qpos_indices, chain.dof_indices, chain.model
    q, qd, torque = path

    def drive(data: Any, now: int) -> None:
        off, slow = q[now] - data.qpos[at], qd[now] - data.qvel[dofs]
        data.qfrc_applied[dofs] = torque[now] + holding_torque(data.qpos[at], off, slow)

    fields = ("actuator_gainprm", "actuator_biasprm", "body_gravcomp")
    kept = {name: getattr(model, name).copy() for name in fields}
    try:
        for name in fields:
            getattr(model, name)[:] = 0.0
        return simulate_run(chain, run, drive, source)
    finally:
        for name in fields:
            getattr(model, name)[:] = kept[name]


def inertia_scaled_holding_torque(chain: ModelArm) -> HoldingTorque:
    """Drives whose gains follow the inertia of an arm: critically damped."""
    mj, model, data, at, dofs = chain.create_data_with_indices()
    wanted, torque = np.zeros(model.nv), np.zeros(model.nv)

    def pull(q: Array, off: Array, slow: Array) -> Array:
        data.qpos[at] = q
        mj.mj_fwdPosition(model, data)
        wanted[dofs] = HOLDING_BANDWIDTH**2 * off + 2.0 * HOLDING_BANDWIDTH * slow
        mj.mj_mulM(model, data, torque, wanted)
        return torque[dofs]

    return pull


def timesteps_along_log(time: Array, chain: ModelArm) -> Array:
    """Times of a model's steps along a log [s]."""
    step = chain.timestep
    return np.asarray(time[0] + step * np.arange(int((time[-1] - time[0]) / step) + 1))


def simulate_run(
    chain: ModelArm, run: Run, apply_controls: Callable[[Any, int], None], source: str
) -> Array:
    """(m, n) joint values at the times of a run.  apply_controls: sets what acts at a step."""
    mj, model, data, at, dofs = chain.create_data_with_indices()
    start = scipy.interpolate.CubicSpline(run.time, run.q)
    data.qpos[at], data.qvel[dofs] = start(run.time[0]), start(run.time[0], 1)
    time = timesteps_along_log(run.time, chain)
    out = np.empty((len(time), run.joints))
    for now in range(len(time)):
        out[now] = data.qpos[at]
        apply_controls(data, now)
        mj.mj_step(model, data)
    check_simulation_is_stable(mj, data, source)
    return interpolate_linearly(run.time, time, out)


# ---- the judge -----------------------------------------------------------------------------------


GainPair = tuple[Sequence[float], Sequence[float]]  # stiffness and damper
MIN_HELD_OUT_SECONDS = 4.0  # of a single run: length of the end that is held out [s]
OWN_SERVOS_TEXT = f"its position servos and {LOGGED_COMMANDS_TEXT}"
GIVEN_GAINS_TEXT = f"the given gains and {LOGGED_COMMANDS_TEXT}"
TORQUES_TEXT = "the measured torques and drives that hold it to the log"


@dataclass(frozen=True, eq=False)
class TorqueErrors:
    """(n,) RMS torque that a model gets wrong: of all rows, and of those that move [as logged]."""

    all_rows: Array
    moving_rows: Array


@dataclass(frozen=True, eq=False)
class MotionJudge:
    """Runs to learn from and runs that judge, and how the arm is driven along these.

    arm: of the model as it is read, with gains and speeds.  inertia: (n,) largest about each joint
    of the model as given [kg m^2].  learning_logs, held_out_logs: on the even grid.  held_out_runs:
    that judge, as logged. drive_text: in words, empty where nothing is driven.  holding_torque:
    given gains, or those of usual drives.
    """

    arm: TorqueArm
    inertia: Array
    learning_logs: MotionLogs
    learning_runs: tuple[Run, ...]
    held_out_logs: MotionLogs
    held_out_runs: tuple[Run, ...]
    source: str
    drive_text: str = ""
    holding_torque: HoldingTorque | None = None

    @staticmethod
    def from_runs(
        opened: OpenedModel,
        runs: Sequence[Run],
        known: MotionKnown,
        *,
        judge_by_fastest: bool = False,
    ) -> MotionJudge:
        """Of logs of the arm of a model.  judge_by_fastest: whether fast runs judge.

        Raises CalibrationError.
        """
        if judge_by_fastest:  # by the RMS speed of the joints, hinges and slides alike
            runs = sorted(runs, key=lambda run: float(
                np.sqrt((np.gradient(run.q, run.time, axis=0) ** 2).mean())))  # fmt: skip
        robot = opened.chain.robot_under_gravity()
        gains = known.require_drive_gains(robot, runs)
        learning, held = split_runs(
            known.add_payload_to_runs(runs), known.holdout, known.holdout_run
        )
        logs = resample_and_filter_runs([*learning, *held])
        arm = TorqueArm.build(
            robot,
            gains,
            known.find_gear_ratios(robot),
            known.payload_inertial_parameters_per_kg,
            logs,
        )
        return MotionJudge(
            arm,
            opened.chain.largest_inertias_over_workspace(),
            resample_and_filter_runs(learning),
            tuple(learning),
            resample_and_filter_runs(held),
            tuple(held),
            opened.given.source,
        )

    def with_drives(self, opened: OpenedModel, gains: GainPair | None) -> MotionJudge:
        """With drives: the model's own where commands were logged, or the given gains.

        Else measured torques, with usual gains for what these leave.  Raises OptionError.
        """
        chain = opened.chain
        commanded = all(
            run.command is not None for run in (*self.held_out_runs, *self.learning_runs)
        )
        own = bool((chain.servo_ids >= 0).all())
        hold: HoldingTorque = inertia_scaled_holding_torque(chain)
        if gains is not None:
            try:
                hold = PdGains(*(np.broadcast_to(np.array(one, dtype=float), len(self.inertia))
                               for one in gains))  # fmt: skip
            except ValueError as error:
                raise OptionError(f"gains: give one pair, or {len(self.inertia)}") from error
        served = (
            OWN_SERVOS_TEXT
            if own and gains is None
            else GIVEN_GAINS_TEXT
            if gains
            else TORQUES_TEXT
        )
        return replace(self, drive_text=served if commanded else TORQUES_TEXT, holding_torque=hold)

    @property
    def is_driven_by_commands(self) -> bool:
        """Whether logged commands drive the arm."""
        return self.drive_text in (OWN_SERVOS_TEXT, GIVEN_GAINS_TEXT)

    def for_model(self, opened: OpenedModel) -> MotionJudge:
        """The same runs and drives, for another model of the arm."""
        return replace(self, arm=replace(self.arm, robot=opened.chain.robot_under_gravity()))

    def torque_gain_and_delay(self, numbers: ModelParameters | None) -> tuple[Array, float]:
        """(n,) torque of the log per torque of the joint, and by how much it is late [s]."""
        if numbers is None:
            return np.ones(len(self.inertia)), 0.0
        return numbers.gain, numbers.delay

    def compute_torque_error(
        self, chain: ModelArm, logs: MotionLogs, numbers: ModelParameters | None
    ) -> Array:
        """(R, n) torque that a model gets wrong along some logs [unit of the log]."""
        gain, late = self.torque_gain_and_delay(numbers)
        seen = logs.with_torque_delay_removed(late) if late else logs
        said = compute_inverse_torque(chain, logs) * gain / self.arm.gain
        known = (
            self.known_payload_torque
            if logs is self.held_out_logs
            else ArmMotion.build(self.arm, logs).known_payload_torque
        )
        return seen.row_torques - logs.filter_to_rows(said + known)

    def measure_torque_error(
        self, chain: ModelArm, numbers: ModelParameters | None = None
    ) -> TorqueErrors:
        """What a model gets wrong on the runs that judge."""
        off = self.compute_torque_error(chain, self.held_out_logs, numbers)
        return TorqueErrors(
            compute_rms_by_joint(off), compute_rms_by_joint(off, self.held_out_logs.is_row_moving)
        )

    @cached_property
    def known_payload_torque(self) -> Array:
        """(M, n) torque of a known payload on the runs that judge [unit of the log]."""
        return ArmMotion.build(self.arm, self.held_out_logs).known_payload_torque

    def measure_joint_error(self, chain: ModelArm, numbers: ModelParameters | None = None) -> Array:
        """(n,) RMS joint error under the drives over the runs that judge [rad, m].

        Without the ends of each run.
        """
        squares = []
        for number, run in enumerate(self.held_out_runs):
            inside = (run.time > run.time[0] + UNUSED_EDGE_DURATION) & (
                run.time < run.time[-1] - UNUSED_EDGE_DURATION
            )
            off = (self.simulate_run(chain, run, number, numbers) - run.q)[inside]
            squares.append(np.square(np.sqrt((off**2).mean(axis=0))))
        weights = [run.duration for run in self.held_out_runs]
        return np.asarray(np.sqrt(np.average(squares, axis=0, weights=weights)))

    def simulate_run(
        self, chain: ModelArm, run: Run, number: int, numbers: ModelParameters | None
    ) -> Array:
        """(m, n) where the drives bring the arm along a run that judges."""
        assert self.holding_torque is not None
        if self.drive_text == OWN_SERVOS_TEXT:
            return simulate_commands(chain, run, joint_commands(run), self.source)
        steps = timesteps_along_log(run.time, chain)
        if self.drive_text == GIVEN_GAINS_TEXT:
            wanted = interpolate_linearly(steps, run.time, joint_commands(run))
            path = wanted, 0.0 * wanted, 0.0 * wanted
        else:
            # The drives make up for what the model gets wrong: where it is right, the arm follows
            # the log by the measured torques alone, less those of a known payload.
            gain, late = self.torque_gain_and_delay(numbers)
            rows, time = self.held_out_logs.run_slices[number], run.time - run.time[0]
            carried = interpolate_linearly(
                time, self.held_out_logs.since[rows], self.known_payload_torque[rows]
            )
            torque = (
                interpolate_linearly(time + late, time, run.torque - carried) * self.arm.gain / gain
            )
            spline = scipy.interpolate.CubicSpline(run.time, run.q)
            path = spline(steps), spline(steps, 1), interpolate_linearly(steps, run.time, torque)
        return simulate_torques(chain, run, path, self.holding_torque, self.source)

    def measure_step(self, name: str, chain: ModelArm, numbers: ModelParameters | None = None,
             torque_errors: TorqueErrors | None = None) -> MotionGapStep:  # fmt: skip
        """How far a model misses.  torque_errors: where it is known already."""
        if self.held_out_logs.unit == NO_TORQUE_UNIT:
            return MotionGapStep(
                name, (), (), (), tuple((1e3 * self.measure_joint_error(chain)).tolist())
            )
        off = self.measure_torque_error(chain, numbers) if torque_errors is None else torque_errors
        where = self.measure_joint_error(chain, numbers) if self.drive_text else np.zeros(0)
        sizes = (off.all_rows * self.arm.gain, off.all_rows, off.moving_rows, 1e3 * where)
        return MotionGapStep(name, *(tuple(size.tolist()) for size in sizes))


def split_runs(
    runs: Sequence[Run], holdout_share: float, holdout_names: str | Sequence[str] | None
) -> tuple[list[Run], list[Run]]:
    """Runs to learn from, and runs that judge: those named, the last ones, or the end of the only.

    Raises OptionError.
    """
    if not 0.0 < holdout_share < 1.0:
        raise OptionError(f"holdout={holdout_share:g} must lie between 0 and 1")
    wanted = check_held_out_run_names(resample_and_filter_runs(runs), holdout_names)
    if not wanted and len(runs) == 1:
        run = runs[0]
        cut = run.time[-1] - max(holdout_share * run.duration, MIN_HELD_OUT_SECONDS)
        if cut - run.time[0] < MIN_HELD_OUT_SECONDS:
            raise OptionError(
                f"{run.source}: {run.duration:.1f} s are too short to learn and to judge; log more"
            )
        early = run.time < cut
        parts = {run.name: run.at(early), f"{run.name} (its end)": run.at(~early)}
        start, end = (replace(part, name=name, time=part.time - part.time[0])
                      for name, part in parts.items())  # fmt: skip
        return [start], [end]
    if not wanted:
        count = min(len(runs) - 1, max(1, round(holdout_share * len(runs))))
        wanted = tuple(run.name for run in runs[-count:])
    return [r for r in runs if r.name not in wanted], [r for r in runs if r.name in wanted]
