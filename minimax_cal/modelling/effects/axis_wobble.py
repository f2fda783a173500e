"""A joint whose axis does not stand still: it tilts as the joint turns."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from minimax_cal.modelling.effects.bending import displace_by_small_rotation
from minimax_cal.modelling.effects.gears import MIN_JOINT_SWEEP
from minimax_cal.modelling.effects.scene import (
    Choice,
    Effect,
    EffectColumns,
    PosedArm,
    joint_index_from_place,
)
from minimax_cal.robots.kinematics import cross


def axis_tilt_columns(posed_arm: PosedArm, place: str, choice: Choice) -> EffectColumns:
    """omega = R(s k q_j) (a u + b v), u and v across the axis in the link before it, k = turns.

    s = -1 tilts against the joint's turn, s = 1 with it.  Once a turn with the joint is a wrong
    twist of the link that it carries, which is geometry: it is left out.
    """
    joint, turns = joint_index_from_place(place), choice["turns"]
    z, x = posed_arm.links.z[joint], posed_arm.links.x[joint]
    angle = posed_arm.angles[joint] + posed_arm.robot.mdh[joint, 2]
    u = np.cos(angle) * x - np.sin(angle) * cross(z, x)  # the link's own x, turned back
    v = cross(z, u)
    ways = (-1.0,) if turns == 1.0 else (-1.0, 1.0)
    fields, names = [], []
    for way in ways:
        c, s = (f(way * turns * posed_arm.angles[joint]) for f in (np.cos, np.sin))
        for name, tilt in (("cos", c * u + s * v), ("sin", c * v - s * u)):
            fields.append(
                displace_by_small_rotation(posed_arm, tilt, posed_arm.links.before[joint])
            )
            names.append(name if len(ways) == 1 else f"{name} {'against' if way < 0.0 else 'with'}")
    return EffectColumns(tuple(names), ("rad",) * len(names), shift=np.stack(fields),
                   fixed={"waves_per_turn": turns})  # fmt: skip


def wobble_places(posed_arm: PosedArm) -> tuple[str, ...]:
    """Joints that turn far enough, whatever drives them, but the last of these."""
    wide = ~posed_arm.robot.prismatic & (np.ptp(posed_arm.angles, axis=1) > MIN_JOINT_SWEEP)
    return tuple(f"J{j + 1}" for j in np.flatnonzero(wide)[:-1])


def wobble_order_choices(posed_arm: PosedArm, place: str) -> Sequence[Choice]:
    """Once and twice a turn."""
    return ({"turns": 1.0}, {"turns": 2.0})


AXIS_WOBBLE = Effect(
    "axis_wobble",
    "the axis of a joint tilts as it turns: a bearing out of true",
    "omega = R(-k q_j) (a u + b v), and R(+k q_j), k = 1, 2",
    wobble_places,
    axis_tilt_columns,
    choices=wobble_order_choices,
    typical=2e-4,
    follows="angle",
)
