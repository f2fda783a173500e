"""What is otherwise from a session or a moment on: the zero of a joint, and when it changed."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from minimax_cal.ground.arrays import Array
from minimax_cal.measuring.stations import labels
from minimax_cal.modelling.effects.scene import (
    Choice,
    Columns,
    Effect,
    Scene,
    joint_of,
    one_joint,
)
from minimax_cal.robots.kinematics import THETA, D

MAX_MOMENTS = 12  # moments at which something may have changed
NEARBY = 24  # moments before one that was chosen, and after it
MIN_POSES = 12  # poses among which a moment is looked for


def session_number(scene: Scene) -> Array:
    """(m,) the session of each row, from 1 in the order of the fit's; infinite for other rows.

    What is measured later finds the arm as it was last.
    """
    known = {label: number + 1.0 for number, label in enumerate(scene.data.frames)}
    return np.array([known.get(label, np.inf) for label in labels(scene.data).tolist()])


def later_sessions(scene: Scene) -> tuple[Choice, ...]:
    """From each session on but the first, or in it alone; none where there is one session."""
    count = len(scene.data.frames)
    since = [{"session": float(number)} for number in range(2, count + 1)]
    alone = [{"session": float(number), "alone": 1.0} for number in range(2, count)]
    return (*since, *alone)


def moments(scene: Scene) -> tuple[Choice, ...]:
    """Moments spread over the measurement, with poses enough on both sides."""
    clock = np.sort(scene.column("clock"))
    if not scene.has("clock") or len(clock) < MIN_POSES:
        return ()
    at = np.unique(np.linspace(5, len(clock) - 5, MAX_MOMENTS).astype(int))
    return tuple({"since": float(clock[i])} for i in at)


def can_change(scene: Scene) -> bool:
    """Whether the data tell sessions or times."""
    return len(scene.data.frames) > 1 or scene.has("clock")


def lacking(scene: Scene) -> str:
    """What the data lack for a change to be tested; empty for nothing."""
    return "" if can_change(scene) else "column session, order or time_s" + scene.untold


def is_after(scene: Scene, choice: Choice) -> Array:
    """(m,) 1 where the change holds, 0 elsewhere."""
    if "session" not in choice:
        return (scene.column("clock") >= choice["since"]).astype(float)
    number = session_number(scene)
    same = number == choice["session"] if "alone" in choice else number >= choice["session"]
    return same.astype(float)


def zero(scene: Scene, place: str, choice: Choice) -> Columns:
    """A joint's zero is another from then on.

    Geometry is that of the last rows: what was before, or what was in between, is turned from it.
    The zero grows as theta (of a slide d) of the robot's file does.
    """
    joint = joint_of(place)
    after = is_after(scene, choice)
    if "alone" not in choice:
        timed = "session" in choice or {"order", "time"} & scene.data.columns.keys()
        after = after - 1.0 if timed else 0.0 * after  # an arm at rest is as it was last
    is_slide = bool(scene.robot.prismatic[joint])
    sense = scene.robot.notation.sense(scene.joints)[joint, D if is_slide else THETA]
    unit, turn = "m" if is_slide else "rad", one_joint(scene, joint, sense * after[None])
    return Columns(("zero",), (unit,), turn=turn, fixed=dict(choice))


def finer_moments(scene: Scene, choice: Choice) -> Sequence[Choice]:
    """Moments near one that was chosen; sessions are what they are."""
    if "since" not in choice:
        return ()
    clock = np.sort(scene.column("clock"))
    at = int(np.searchsorted(clock, choice["since"]))
    step = max(1, len(clock) // MAX_MOMENTS)
    away = np.unique(np.geomspace(1, step, NEARBY).astype(int))  # fine nearby, coarse afar
    near = at + np.concatenate([-away[::-1], [0], away])
    near = near[(near >= 3) & (near < len(clock) - 3)]
    return tuple({**choice, "since": float(t)} for t in clock[near])


ENCODER_ZERO = Effect(
    "encoder_zero",
    "the zero of a joint has changed: a new motor or encoder, a collision, mastering",
    "the joint turns by c more from a session, or a moment, on",
    lambda scene: (
        tuple(f"J{joint + 1}" for joint in np.flatnonzero(~scene.robot.passive))
        if can_change(scene)
        else ()
    ),
    zero,
    finer=finer_moments,
    needs=lacking,
    choices=lambda scene, place: (*later_sessions(scene), *moments(scene)),
    typical=1e-3,
    follows="session",
    of_past=True,
)
