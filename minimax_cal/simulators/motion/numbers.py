"""What a simulator's elements hold of an arm in motion: masses, friction, armature, springs."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from minimax_cal.dynamics.laws import Term
from minimax_cal.dynamics.scene import YIELD
from minimax_cal.ground.arrays import Array
from minimax_cal.robots.mjcf import mujoco
from minimax_cal.simulators.chain import Chain
from minimax_cal.simulators.motion.bodies import Bodies

FRICTION, STIFFNESS = 3, 5  # places in a dcmotor's biasprm and dynprm, then its damper
POWERS = 3  # of the speed in MuJoCo's damping: v, v |v|, v^3; of the angle in its springs


@dataclass(frozen=True, eq=False)
class Numbers:
    """Of n joints, all in SI and at the joints.

    bodies: (n, 4, 4) pseudo-inertias of the joints' bodies in their own frames.
    armature: (n,) [kg m^2].  friction: (n,) [N m].  damping: (n, 3) of v, v |v|, v^3.
    bristles: (n, k) share of the friction that bristles hold [N m]; yields: (n, k) the ways after
    which they yield [rad, m]; damped: (n,) their dampers over their stiffness [s].
    stiffness: (n, 3) of x, x^2, x^3, x from rest: (n,) [rad].
    gain: (n,) torque of the log per torque of the joint.  late: by which torques are logged after
    the motion [s].
    laws, value: what no element holds, in the unit of the log; fastest, soft: (n,) speeds by which
    these count.
    """

    bodies: Array
    armature: Array
    friction: Array
    damping: Array
    stiffness: Array
    rest: Array
    gain: Array
    bristles: Array
    yields: Array
    damped: Array
    late: float = 0.0
    laws: tuple[Term, ...] = ()
    value: tuple[Array, ...] = ()
    fastest: Array = field(default_factory=lambda: np.zeros(0))

    @property
    def joints(self) -> int:
        """How many there are."""
        return len(self.armature)

    @property
    def loss(self) -> Array:
        """(n,) friction that no bristle holds."""
        return np.asarray(np.maximum(self.friction - self.bristles.sum(axis=1), 0.0))

    def put(self, **changes: Any) -> Numbers:
        """With other fields."""
        return replace(self, **changes)


def given_numbers(chain: Chain, bodies: Bodies) -> Numbers:
    """Those of a model."""
    model, dofs, joints = chain.model, chain.dofs, np.array(chain.joints)
    damping = np.column_stack([model.dof_damping[dofs], of_powers(model, "dof_dampingpoly", dofs)])
    spring = np.column_stack(
        [model.jnt_stiffness[joints], of_powers(model, "jnt_stiffnesspoly", joints)]
    )
    held, yields, damped = given_bristles(chain)
    return Numbers(
        bodies=bodies.drawn,
        armature=np.array(model.dof_armature[dofs]),
        friction=np.array(model.dof_frictionloss[dofs]) + held.sum(axis=1),
        damping=damping,
        stiffness=spring,
        rest=np.array(model.qpos_spring[chain.places]),
        gain=np.ones(len(dofs)),
        bristles=held,
        yields=yields,
        damped=damped,
    )


def bristle(joint: str, number: int) -> str:
    """The name of a joint's bristle, from 0."""
    return f"{joint}_bristle{number + 1}"


def bristles_in(chain: Chain) -> list[tuple[int, int, int]]:
    """Joint, number and id of every bristle of a model."""
    mj, model = mujoco(), chain.model
    places = [(j, k, mj.mj_name2id(model, mj.mjtObj.mjOBJ_ACTUATOR, bristle(name, k)))
              for j, name in enumerate(chain.names) for k in range(len(YIELD))]  # fmt: skip
    return [place for place in places if place[2] >= 0]


def given_bristles(chain: Chain) -> tuple[Array, Array, Array]:
    """Friction (n, k), ways (n, k) and dampers (n,) of a model's bristles, as in `Numbers`."""
    damped = np.zeros(len(chain.joints))
    held, yields = np.zeros((len(damped), len(YIELD))), np.tile(YIELD, (len(damped), 1))
    for j, k, number in bristles_in(chain):
        stiffness, damper = chain.model.actuator_dynprm[number, STIFFNESS : STIFFNESS + 2]
        held[j, k] = chain.model.actuator_biasprm[number, FRICTION]
        yields[j, k], damped[j] = held[j, k] / stiffness, damper / stiffness
    return held, yields, damped


def of_powers(model: Any, name: str, places: Array) -> Array:
    """(n, 2) of the higher powers, 0 in a MuJoCo that has none."""
    found = getattr(model, name, None)
    return np.zeros((len(places), POWERS - 1)) if found is None else np.array(found[places])


def has_powers(model: Any) -> bool:
    """Whether this MuJoCo has polynomials of the speed."""
    return hasattr(model, "dof_dampingpoly")
