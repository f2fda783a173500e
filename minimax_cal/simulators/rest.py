"""A simulated arm driven to its commands, and where it comes to rest."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from minimax_cal.ground.arrays import Array
from minimax_cal.simulators.chain import Chain, body_pose, mujoco, way_to

LONGEST = 8.0  # that an arm may take to come to rest [s]
STILL = 1e-6  # slower is at rest [rad/s, m/s]
CHUNK = 25  # timesteps between two looks


@dataclass(frozen=True, eq=False)
class Rested:
    """poses: (m, 4, 4) of the body that carries the targets, in the world [m].

    q: (m, n) where the joints stand [rad, m].  moving: (m,) True where it had not come to rest.
    touching: (m,) True where something pressed on it.  driven: whether servos moved it; else its
    joints were set.
    """

    poses: Array
    q: Array
    moving: Array
    touching: Array
    driven: bool


def at_rest(
    chain: Chain,
    q: Array,
    commands: Array,
    play: Array | None = None,
    progress: Callable[[int], object] = lambda done: None,
) -> Rested:
    """Drive an arm to commands, pose by pose, from its joint values, and let it settle.

    q, commands: (m, n) [rad, m].  play: (m, n) where each joint stands in its play [rad].
    progress: called with the number of poses done.
    """
    model, mj = chain.model, mujoco()
    data = mj.MjData(model)
    servos = np.array([chain.servo(joint) for joint in chain.joints])
    driven = bool((servos >= 0).all())
    at = np.array([int(model.jnt_qposadr[joint]) for joint in chain.joints])
    dofs = np.array([int(model.jnt_dofadr[j]) for j in way_to(model, carrier(chain))])
    sides = plays(chain)
    springs = np.array(model.qpos_spring)
    out, stands, moving, touching = [], [], [], []
    for row in range(len(q)):
        mj.mj_resetData(model, data)
        data.qpos[at] = q[row]
        for joint, place in sides.items():
            side = 0.0 if play is None else play[row, joint]
            model.qpos_spring[place] = data.qpos[place] = side
        if driven:
            data.ctrl[servos] = commands[row]
            moving.append(not settled(mj, model, data, dofs))
            touching.append(bool(data.ncon) and pressed(mj, model, data))
        else:
            mj.mj_kinematics(model, data)
            moving.append(False)
            touching.append(False)
        out.append(body_pose(data, carrier(chain)))
        stands.append(np.array(data.qpos[at]))
        progress(row + 1)
    model.qpos_spring[:] = springs
    return Rested(np.array(out), np.array(stands), np.array(moving), np.array(touching), driven)


def settled(mj: Any, model: Any, data: Any, dofs: Array) -> bool:
    """Step until the arm's joints are still, or for LONGEST; whether it came to rest."""
    before = False
    while data.time < LONGEST:
        mj.mj_step(model, data, CHUNK)
        still = bool(np.abs(data.qvel[dofs]).max(initial=0.0) < STILL)
        if still and before:
            return True
        before = still
    return before


def pressed(mj: Any, model: Any, data: Any) -> bool:
    """Whether a contact carries force."""
    force = np.zeros(6)
    for i in range(data.ncon):
        mj.mj_contactForce(model, data, i, force)
        if abs(force[0]) > 1e-6:
            return True
    return False


def plays(chain: Chain) -> dict[int, int]:
    """Joint, and where the position in its play stands in qpos."""
    model, out = chain.model, {}
    for i in range(len(chain.joints)):
        found = mujoco().mj_name2id(model, mujoco().mjtObj.mjOBJ_JOINT, f"play{i + 1}")
        if found >= 0:
            out[i] = int(model.jnt_qposadr[found])
    return out


def carrier(chain: Chain) -> int:
    """Id of the body that carries the targets: a tool of ours that sags, else the last one."""
    found = int(mujoco().mj_name2id(chain.model, mujoco().mjtObj.mjOBJ_BODY, "tool"))
    last = chain.bodies[-1]
    ours = found >= 0 and way_holds(chain.model, found, last)
    return found if ours else last


def way_holds(model: Any, body: int, other: int) -> bool:
    """Whether a body hangs on another."""
    while body > 0:
        if body == other:
            return True
        body = int(model.body_parentid[body])
    return False
