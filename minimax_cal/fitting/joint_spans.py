"""How far each joint went in the poses of a fit, and which went too little to say more.

Of a joint that hardly moved, the poses tell no more than what lies between them: parameters that
take each other's place there part elsewhere, and no part of such poses that is left out shows it.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from minimax_cal.core.arrays import Array
from minimax_cal.measuring.measurements import Measurements
from minimax_cal.measuring.pose_groups import (
    MIN_MOVING_JOINT_RANGE,
    MIN_REGION_POSES,
    group_repeated_poses,
)
from minimax_cal.robots.robot import Robot

# Simulated IRB 2600, 60 poses, 0.02 mm noise: poses over the whole range miss by 74, 9.4, 4.9, 2.4
# and 1.2 times what the worst part left out says where joint 1 spans 0, 2.6, 5, 10 and 20 degrees.
LEAST_TURN, LEAST_SLIDE = np.radians(10.0), 0.02  # [rad, m]
MIN_SPAN_OF_RANGE = 0.05  # of a joint's range, where that asks for more
MAX_SPAN_OF_RANGE = 0.5  # of a joint's range, which a joint of a short range needs at most
MAX_SUGGESTED_POSES = 100  # poses of a proposal; more take minutes to choose and hardly tell more
JOINT_DISPLAY_UNITS = {
    True: (1e3, "mm"),
    False: (180.0 / np.pi, "deg"),
}  # by whether the joint slides


@dataclass(frozen=True)
class JointSpan:
    """Where a joint was in some poses, in its unit for people, `deg` or `mm`.

    joint: J1 ... Jn.  low, high: its ends.  size: between them without the poses farthest out, so
    few that they could not be left out as a part.  least: what it must be to say more.
    """

    joint: str
    low: float
    high: float
    size: float
    least: float
    unit: str

    @property
    def is_narrow(self) -> bool:
        """Whether the joint went too little for a claim about poses outside."""
        return self.size < self.least

    def is_outside(self, q: Array) -> Array:
        """(m,) True for joint values outside.  q: (m,) [rad, m]."""
        scale, _ = JOINT_DISPLAY_UNITS[self.unit == "mm"]
        margin = scale * MIN_MOVING_JOINT_RANGE  # what does not move comes back no nearer
        return np.asarray((scale * q < self.low - margin) | (scale * q > self.high + margin))


def measure_joint_spans(robot: Robot, data: Measurements) -> tuple[JointSpan, ...]:
    """The span of each joint over the poses at which something was measured."""
    q = data.q[data.seen.any(axis=1)]
    _, first = np.unique(group_repeated_poses(data)[data.seen.any(axis=1)], return_index=True)
    out = []
    for joint, slides in enumerate(robot.prismatic):
        scale, unit = JOINT_DISPLAY_UNITS[bool(slides)]
        value = np.sort(q[first, joint])
        ends = (float(scale * value[0]), float(scale * value[-1])) if len(value) else (0.0, 0.0)
        size, least = scale * robust_span_width(value), scale * min_joint_span(robot, joint)
        out.append(JointSpan(f"J{joint + 1}", *ends, float(size), float(least), unit))
    return tuple(out)


def robust_span_width(sorted_values: Array) -> float:
    """The least width that holds all but `MIN_REGION_POSES` - 1 of some sorted values (m,)."""
    kept = len(sorted_values) - (MIN_REGION_POSES - 1)
    return (
        float((sorted_values[kept - 1 :] - sorted_values[: len(sorted_values) - kept + 1]).min())
        if kept > 0
        else 0.0
    )


def min_joint_span(robot: Robot, joint: int) -> float:
    """What a joint must span [rad, m]."""
    least = LEAST_SLIDE if robot.prismatic[joint] else LEAST_TURN
    size = float(robot.upper[joint] - robot.lower[joint])
    return (
        max(MIN_SPAN_OF_RANGE * size, min(least, MAX_SPAN_OF_RANGE * size))
        if np.isfinite(size)
        else float(least)
    )


def select_narrow_spans(spans: Iterable[JointSpan]) -> tuple[JointSpan, ...]:
    """Those of joints that went too little."""
    return tuple(span for span in spans if span.is_narrow)


def is_outside_narrow_spans(spans: Sequence[JointSpan], q: Array) -> Array:
    """(m,) True for poses at which a joint that went too little is outside its span.

    spans: of all joints, or none.  q: (m, n) [rad, m].
    """
    away = [span.is_outside(q[:, joint]) for joint, span in enumerate(spans) if span.is_narrow]
    return np.any(away, axis=0) if away else np.zeros(len(q), dtype=bool)


def describe_spans(spans: Sequence[JointSpan]) -> str:
    """Joints and how far each went, for people."""
    return ", ".join(
        f"joint {span.joint[1:]} spans {span.size:.2g} {span.unit} ({span.least:.3g} needed)"
        for span in spans
    )


def suggest_plan_command(pose_count: int) -> str:
    """The command that proposes poses over the whole range of the joints.

    pose_count: how many, as many as were measured.
    """
    return (
        f"minimax-cal plan ROBOT --poses {min(max(pose_count, 1), MAX_SUGGESTED_POSES)} -o plan.csv"
    )
