"""A simulated arm along a log: the torque that its motion takes, and where its drives bring it."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy

from minimax_cal.dynamics.rows import EDGE_S, Logs
from minimax_cal.dynamics.run import Run
from minimax_cal.dynamics.scene import bent_bristles
from minimax_cal.ground.arrays import Array
from minimax_cal.robots.mjcf import mujoco
from minimax_cal.simulators.chain import Chain, fill_history
from minimax_cal.simulators.drive import check_stable
from minimax_cal.simulators.motion.numbers import FRICTION, bristles_in, given_bristles

BANDWIDTH = 2.0 * np.pi * 5.0  # of drives that hold an arm to a log, where none are given [1/s]


@dataclass(frozen=True, eq=False)
class Gains:
    """Of proportional and derivative drives: (n,) stiffness [N m/rad] and damper [N m s/rad]."""

    stiffness: Array
    damper: Array


def inverse_torque(chain: Chain, logs: Logs) -> Array:
    """(M, n) torque that a model takes for the motion of logs, as its drives feel it [N m]."""
    mj, model = mujoco(), chain.model
    data, (at, dofs) = mj.MjData(model), (chain.places, chain.dofs)
    out = np.empty(logs.motion.q.shape)
    joint, number, bristle = np.array(bristles_in(chain), dtype=int).reshape(-1, 3).T
    yields = given_bristles(chain)[1]
    bent = (bent_bristles(logs, yields) * yields)[:, joint, number]
    floating = ~model.jnt_actgravcomp[list(chain.joints)].astype(bool)
    motion = logs.motion
    for k in range(len(out)):
        data.qpos[at], data.qvel[dofs], data.qacc[dofs] = motion.q[k], motion.qd[k], motion.qdd[k]
        data.time = float(logs.since[k])
        mj.mj_inverse(model, data)
        out[k] = data.qfrc_inverse[dofs] + floating * data.qfrc_gravcomp[dofs]
        if len(bristle):
            data.act[model.actuator_actadr[bristle]] = bent[k]
            mj.mj_fwdActuation(model, data)
            np.subtract.at(out[k], joint, data.actuator_force[bristle])
    return out


def follow_commands(chain: Chain, run: Run, commands: Array, source: str) -> Array:
    """(m, n) joint values where a model's own position servos bring an arm.

    commands: (m, n) at the times of the run [rad, m].  Raises RobotError for an unstable model.
    """
    servos = np.array([chain.servo(joint) for joint in chain.joints])
    speeds = ahead_of(chain.model, chain.names)

    def drive(data: Any, now: int) -> None:
        data.ctrl[servos] = path[now]
        data.ctrl[list(speeds)] = rates[now, list(speeds.values())]
        if not now:
            fill_history(chain.model, data)

    path = on_steps(run.time, commands, chain)
    rates = np.gradient(path, float(chain.model.opt.timestep), axis=0)
    return stepped(chain, run, drive, source)


def ahead_of(model: Any, names: Sequence[str]) -> dict[int, int]:
    """Ids of actuators that take the commanded speed of some joints, and of which (from 0)."""
    mj = mujoco()
    ids = (mj.mj_name2id(model, mj.mjtObj.mjOBJ_ACTUATOR, f"{name}_ahead") for name in names)
    return {number: j for j, number in enumerate(ids) if number >= 0}


def follow_torques(
    chain: Chain, run: Run, torque: Array, hold: Gains | Chain, source: str
) -> Array:
    """(m, n) joint values under measured torques and drives that hold the arm to the log.

    torque: (m, n) at the times of the run [N m].  hold: gains of the drives, or the arm for whose
    inertia they are critically damped.  They make up for what the model gets wrong: where it is
    right, the arm follows the log by the measured torques alone.
    """
    model, at, dofs = chain.model, chain.places, chain.dofs
    wanted = scipy.interpolate.CubicSpline(run.time, run.q)
    time = steps_of(run.time, chain)
    q, qd, ahead = wanted(time), wanted(time, 1), on_steps(run.time, torque, chain)
    pull = by_gains(hold) if isinstance(hold, Gains) else by_inertia(hold)

    def drive(data: Any, now: int) -> None:
        off, slow = q[now] - data.qpos[at], qd[now] - data.qvel[dofs]
        data.qfrc_applied[dofs] = ahead[now] + pull(data.qpos[at], off, slow)

    with own_drives_off(model):
        return stepped(chain, run, drive, source)


Pull = Callable[[Array, Array, Array], Array]  # torque of joint values, and how far they are off


def by_gains(gains: Gains) -> Pull:
    """Drives of constant gains."""
    return lambda q, off, slow: gains.stiffness * off + gains.damper * slow


def by_inertia(chain: Chain) -> Pull:
    """Drives whose gains follow the inertia of an arm."""
    mj, model = mujoco(), chain.model
    data, (at, dofs) = mj.MjData(model), (chain.places, chain.dofs)
    wanted, torque = np.zeros(model.nv), np.zeros(model.nv)

    def pull(q: Array, off: Array, slow: Array) -> Array:
        data.qpos[at] = q
        mj.mj_fwdPosition(model, data)
        wanted[dofs] = BANDWIDTH**2 * off + 2.0 * BANDWIDTH * slow
        mj.mj_mulM(model, data, torque, wanted)
        return np.asarray(torque[dofs])

    return pull


def follow_gains(chain: Chain, run: Run, commands: Array, gains: Gains, source: str) -> Array:
    """(m, n) joint values where proportional and derivative drives bring an arm by commands."""
    model, at, dofs = chain.model, chain.places, chain.dofs
    wanted = on_steps(run.time, commands, chain)

    def drive(data: Any, now: int) -> None:
        off = wanted[now] - data.qpos[at]
        data.qfrc_applied[dofs] = gains.stiffness * off - gains.damper * data.qvel[dofs]

    with own_drives_off(model):
        return stepped(chain, run, drive, source)


@contextmanager
def own_drives_off(model: Any) -> Iterator[None]:
    """A model without its actuators' forces but for bristles, and with all its weight."""
    fields = ("actuator_gainprm", "actuator_biasprm", "body_gravcomp")
    kept = {name: getattr(model, name).copy() for name in fields}
    drives = kept["actuator_biasprm"][:, FRICTION] == 0.0
    try:
        for name in fields:
            getattr(model, name)[drives if name.startswith("actuator") else ...] = 0.0
        yield
    finally:
        for name in fields:
            getattr(model, name)[:] = kept[name]


def steps_of(time: Array, chain: Chain) -> Array:
    """Times of a model's steps along a log [s]."""
    step = float(chain.model.opt.timestep)
    return np.asarray(time[0] + step * np.arange(int((time[-1] - time[0]) / step) + 1))


def on_steps(time: Array, values: Array, chain: Chain) -> Array:
    """Values (m, n) of a log at a model's steps, straight between rows."""
    steps = steps_of(time, chain)
    return np.stack([np.interp(steps, time, column) for column in values.T], axis=1)


def stepped(chain: Chain, run: Run, drive: Callable[[Any, int], None], source: str) -> Array:
    """(m, n) joint values at the times of a run.  drive: sets what acts at a step."""
    mj, model = mujoco(), chain.model
    data, (at, dofs) = mj.MjData(model), (chain.places, chain.dofs)
    start = scipy.interpolate.CubicSpline(run.time, run.q)
    data.qpos[at], data.qvel[dofs] = start(run.time[0]), start(run.time[0], 1)
    time = steps_of(run.time, chain)
    out = np.empty((len(time), run.joints))
    for now in range(len(time)):
        out[now] = data.qpos[at]
        drive(data, now)
        mj.mj_step(model, data)
    check_stable(mj, data, source)
    return np.stack([np.interp(run.time, time, column) for column in out.T], axis=1)


def tracking(q: Array, run: Run) -> Array:
    """(n,) RMS distance of joint values (m, n) from those of a run, its ends left out [rad, m]."""
    inside = (run.time > run.time[0] + EDGE_S) & (run.time < run.time[-1] - EDGE_S)
    return np.asarray(np.sqrt(((q - run.q)[inside] ** 2).mean(axis=0)))
