"""Where a written file lets its targets stand, beside what the formulas of its fit say."""

from __future__ import annotations

from copy import copy
from dataclasses import dataclass, replace

import numpy as np

from minimax_cal.ground.arrays import Array
from minimax_cal.measuring.measurements import Measurements
from minimax_cal.modelling.cell import Cell
from minimax_cal.robots.mjcf import mujoco, way_to
from minimax_cal.robots.transforms import inverse
from minimax_cal.simulators.arm import Arm
from minimax_cal.simulators.chain import Chain, fill_history
from minimax_cal.simulators.commands import Commands
from minimax_cal.simulators.drive import plays

ROUNDS, CLOSE = 20, 1e-12  # of Newton's method, and the largest step that is none [rad, m]
SMALL = 1e-7  # to find slopes of forces [rad, m]


@dataclass(frozen=True, eq=False)
class Written:
    """An arm in a written model.  cell: which it is to be.  base: (4, 4) of it in the world [m]."""

    chain: Chain
    cell: Cell
    arm: Arm
    base: Array

    def off(self, data: Measurements) -> Array:
        """(k, m, 3) from where the targets stand to where the cell says, as the instrument sees it.

        Its command map corrects the commands [m].
        """
        asked = Commands(replace(self.cell, effects=self.arm.mapped)).follow(data)
        points = stand(self.chain, data.target_names, asked, resting(self.arm, data))
        to = self.cell.base @ inverse(self.base)
        chosen = [self.cell.target_names.index(name) for name in data.target_names]
        said = self.cell.seen(data)[:, chosen]
        return np.moveaxis(said - points @ to[:3, :3].T - to[:3, 3], 1, 0)


def resting(arm: Arm, data: Measurements) -> Array | None:
    """(m, n) where joints rest in their play, by the moves that led to each pose [rad]."""
    if not arm.play.any():
        return None
    sides = [data.columns[f"approach{i + 1}"] for i in range(data.q.shape[1])]
    return np.asarray(0.5 * arm.play * np.stack(sides, axis=1))


def stand(chain: Chain, names: tuple[str, ...], commands: Array, play: Array | None) -> Array:
    """(m, k, 3) sites of these names, in the world, with all forces of the arm in balance [m].

    commands: (m, n) [rad, m].  play: (m, n) where each joint rests in its play [rad].
    """
    mj, model = mujoco(), copy(chain.model)
    data, sides = mj.MjData(model), plays(chain)
    servos = np.array([chain.servo(joint) for joint in chain.joints])
    joints = list(way_to(model, int(model.site(names[0]).bodyid[0])))
    at, dofs = model.jnt_qposadr[joints], model.jnt_dofadr[joints]
    states = model.actuator_actadr[servos]
    out = np.empty((len(commands), len(names), 3))

    def force(q: Array) -> Array:
        data.qpos[at] = q
        mj.mj_forward(model, data)
        return np.array(data.qfrc_smooth[dofs])

    for row, command in enumerate(commands):
        mj.mj_resetData(model, data)
        data.qpos[chain.places] = data.ctrl[servos] = command
        fill_history(model, data)
        data.act[states[states >= 0]] = command[states >= 0]
        for joint, place in sides.items():
            data.qpos[place] = model.qpos_spring[place] = 0.0 if play is None else play[row, joint]
        q = np.array(data.qpos[at])
        for _ in range(ROUNDS):
            here = force(q)
            slope = np.array([force(q + step) - here for step in SMALL * np.eye(len(q))]).T / SMALL
            step = np.linalg.solve(slope, here)
            q = q - step
            if np.abs(step).max() < CLOSE:
                break
        force(q)
        out[row] = [data.site(name).xpos for name in names]
    return out
