"""Friction and torques that no MuJoCo element holds, for the model of the same name.

    model = mujoco.MjModel.from_xml_path("arm.xml")
    data = mujoco.MjData(model)
    install(model)

`install` gives the model the numbers that belong to these laws, and MuJoCo a passive callback that
sets the largest friction of each joint at every step, forward and inverse: so that friction stays a
constraint, which no timestep makes unstable.  A second `install` replaces the first.
"""

from typing import Any

import mujoco
import numpy as np

NUMBERS: dict[str, dict[str, Any]] = {}  # by joint: its elements, and its laws as (law, numbers)
FRICTION = int(mujoco.mjtConstraint.mjCNSTR_FRICTION_DOF)
LEAST = 1e-9  # of a friction, for MuJoCo to have a constraint [N m]
PRESLIDING = "presliding"  # the law that remembers where a joint turned round


def degressive(qd: float, amount: float, fastest: float, power: float) -> float:
    """Viscous friction that levels off."""
    return float(amount * (abs(qd) / fastest) ** power)


def stribeck(qd: float, amount: float, fastest: float, speed: float) -> float:
    """Friction that falls with the speed."""
    return float(amount * np.exp(-((qd / fastest / speed) ** 2)))


class Joint:
    """A joint of a model with its laws."""

    def __init__(self, model: Any, name: str, told: dict[str, Any]) -> None:
        joint = model.joint(name)
        self.dof, self.place = int(joint.dofadr[0]), int(joint.qposadr[0])
        self.friction, self.laws = told["frictionloss"], told["laws"]
        self.turned: dict[int, tuple[bool, float]] = {}
        model.dof_frictionloss[self.dof] = max(self.friction, LEAST)
        model.dof_damping[self.dof] = told["damping"][0]
        if hasattr(model, "dof_dampingpoly"):
            model.dof_dampingpoly[self.dof] = told["damping"][1:]

    def largest(self, data: Any, load: Any) -> tuple[float, float]:
        """The largest friction, and a torque that is none."""
        q, qd = float(data.qpos[self.place]), float(data.qvel[self.dof])
        friction, torque = self.friction, 0.0
        for law, numbers in self.laws:
            if law == "load_friction":
                friction += numbers["share"] * abs(load[self.dof])
            elif law == "degressive":
                friction += degressive(qd, **numbers)
            elif law == "stribeck":
                friction += stribeck(qd, **numbers)
            elif law == "angle_friction":
                friction += numbers["cos"] * np.cos(q) + numbers["sin"] * np.sin(q)
            elif law == PRESLIDING:
                friction -= numbers["amount"] * np.exp(-self.since(data, q, qd) / numbers["length"])
            elif law == "asymmetry":
                torque += numbers["amount"] * abs(qd) / numbers["fastest"]
            elif law == "waves":
                turn = numbers["times"] * q
                torque += numbers["cos"] * np.cos(turn) + numbers["sin"] * np.sin(turn)
        return max(friction, LEAST), torque

    def since(self, data: Any, q: float, qd: float) -> float:
        """How far the joint is from where it turned round last."""
        back, at = self.turned.get(data._address, (qd < 0.0, q))
        if back != (qd < 0.0) or data.time == 0.0:
            back, at = qd < 0.0, q
        self.turned[data._address] = back, at
        return abs(q - at)


def install(model: Any) -> None:
    """Let a model have these laws too."""
    joints = [Joint(model, name, told) for name, told in NUMBERS.items()]
    load, names, size = np.zeros(model.nv), bytes(model.names), model.nv

    def passive(of: Any, data: Any) -> None:
        if of.nv != size or bytes(of.names) != names:
            return
        mujoco.mj_rne(of, data, 1, load)
        rows = np.flatnonzero(data.efc_type == FRICTION)
        at = dict(zip(data.efc_id[rows].tolist(), rows.tolist(), strict=True))
        for joint in joints:
            friction, torque = joint.largest(data, load)
            if joint.dof in at:
                data.efc_frictionloss[at[joint.dof]] = friction
            data.qfrc_passive[joint.dof] -= torque
        if getattr(data, "nisland", 0):  # the solver has taken its own copy already
            order = data.map_iefc2efc[: len(data.iefc_frictionloss)]
            data.iefc_frictionloss[:] = data.efc_frictionloss[order]

    mujoco.set_mjcb_passive(passive)


def remove() -> None:
    """Let MuJoCo have no callback."""
    mujoco.set_mjcb_passive(None)
