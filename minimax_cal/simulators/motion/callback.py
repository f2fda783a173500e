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

NUMBERS: dict[str, dict[str, Any]] = {}
# of each law whether it is friction, and its torque per unit of each of its parameters
LAWS: dict[str, tuple[bool, Any]] = {}
FRICTION = int(mujoco.mjtConstraint.mjCNSTR_FRICTION_DOF)
LEAST = 1e-9  # of a friction, for MuJoCo to have a constraint [N m]


class Joint:
    """A joint of a model: its elements, and its laws as (law, amounts, tuned numbers)."""

    def __init__(self, model: Any, name: str, told: dict[str, Any]) -> None:
        joint = model.joint(name)
        self.dof, self.place = int(joint.dofadr[0]), int(joint.qposadr[0])
        self.friction, self.laws = told["frictionloss"], told["laws"]
        self.fastest, self.gear = told["fastest"], told.get("gear")
        self.turned: dict[int, tuple[bool, float]] = {}
        model.dof_frictionloss[self.dof] = max(self.friction, LEAST)
        model.dof_damping[self.dof] = told["damping"][0]
        if hasattr(model, "dof_dampingpoly"):
            model.dof_dampingpoly[self.dof] = told["damping"][1:]

    def largest(self, data: Any, load: Any) -> tuple[float, float]:
        """The largest friction, and a torque that is none."""
        q, qd = float(data.qpos[self.place]), float(data.qvel[self.dof])
        at = {"q": q, "v": qd / self.fastest, "load": load[self.dof], "gear": self.gear,
              "way": self.since(data, q, qd)}  # fmt: skip
        friction, torque = self.friction, 0.0
        for law, amounts, tuned in self.laws:
            dry, units = LAWS[law]
            each = zip(amounts, units(**at, **tuned), strict=True)
            amount = float(sum(amount * unit for amount, unit in each))
            friction, torque = friction + dry * amount, torque + (not dry) * amount
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
