"""How far each joint went in the poses of a fit, and which went too little to say more.

Of a joint that hardly moved, the poses tell no more than what lies between them: parameters that
take each other's place there part elsewhere, and no part of such poses that is left out shows it.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from minimax_cal.ground.arrays import Array
from minimax_cal.measuring.grouping import FEWEST, MOVES, groups
from minimax_cal.measuring.measurements import Measurements
from minimax_cal.robots.robot import Robot

# Simulated IRB 2600, 60 poses, 0.02 mm noise: poses over the whole range miss by 74, 9.4, 4.9, 2.4
# and 1.2 times what the worst part left out says where joint 1 spans 0, 2.6, 5, 10 and 20 degrees.
LEAST_TURN, LEAST_SLIDE = np.radians(10.0), 0.02  # [rad, m]
SHARE = 0.05  # of a joint's range, where that asks for more
MOST_SHARE = 0.5  # of a joint's range, which a joint of a short range needs at most
MOST_PLANNED = 100  # poses of a proposal; more take minutes to choose and hardly tell more
PEOPLES = {True: (1e3, "mm"), False: (180.0 / np.pi, "deg")}  # by whether the joint slides


@dataclass(frozen=True)
class Span:
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

    def leaves(self, q: Array) -> Array:
        """(m,) True for joint values outside.  q: (m,) [rad, m]."""
        scale, _ = PEOPLES[self.unit == "mm"]
        margin = scale * MOVES  # what does not move comes back no nearer
        return np.asarray((scale * q < self.low - margin) | (scale * q > self.high + margin))


def spans_of(robot: Robot, data: Measurements) -> tuple[Span, ...]:
    """The span of each joint over the poses at which something was measured."""
    q = data.q[data.seen.any(axis=1)]
    _, first = np.unique(groups(data)[data.seen.any(axis=1)], return_index=True)
    out = []
    for joint, slides in enumerate(robot.prismatic):
        scale, unit = PEOPLES[bool(slides)]
        value = np.sort(q[first, joint])
        ends = (float(scale * value[0]), float(scale * value[-1])) if len(value) else (0.0, 0.0)
        size, least = scale * inner_size(value), scale * least_span(robot, joint)
        out.append(Span(f"J{joint + 1}", *ends, float(size), float(least), unit))
    return tuple(out)


def inner_size(value: Array) -> float:
    """The least width that holds all but `FEWEST` - 1 of some sorted values (m,)."""
    kept = len(value) - (FEWEST - 1)
    return float((value[kept - 1 :] - value[: len(value) - kept + 1]).min()) if kept > 0 else 0.0


def least_span(robot: Robot, joint: int) -> float:
    """What a joint must span [rad, m]."""
    least = LEAST_SLIDE if robot.prismatic[joint] else LEAST_TURN
    size = float(robot.upper[joint] - robot.lower[joint])
    return max(SHARE * size, min(least, MOST_SHARE * size)) if np.isfinite(size) else float(least)


def narrow(spans: Iterable[Span]) -> tuple[Span, ...]:
    """Those of joints that went too little."""
    return tuple(span for span in spans if span.is_narrow)


def outside(spans: Sequence[Span], q: Array) -> Array:
    """(m,) True for poses at which a joint that went too little is outside its span.

    spans: of all joints, or none.  q: (m, n) [rad, m].
    """
    away = [span.leaves(q[:, joint]) for joint, span in enumerate(spans) if span.is_narrow]
    return np.any(away, axis=0) if away else np.zeros(len(q), dtype=bool)


def spans_in_words(spans: Sequence[Span]) -> str:
    """Joints and how far each went, for people."""
    return ", ".join(
        f"joint {span.joint[1:]} spans {span.size:.2g} {span.unit} ({span.least:.3g} needed)"
        for span in spans
    )


def plan_that_mends(poses: int) -> str:
    """The command that proposes poses over the whole range of the joints.

    poses: how many, as many as were measured.
    """
    return f"minimax-cal plan ROBOT --poses {min(max(poses, 1), MOST_PLANNED)} -o plan.csv"
