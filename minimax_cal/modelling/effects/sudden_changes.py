"""What is otherwise from a session or a moment on: the zero of a joint, and when it changed."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from minimax_cal.core.arrays import Array
from minimax_cal.measuring.session_frames import session_labels
from minimax_cal.modelling.effects.scene import (
    Choice,
    Effect,
    EffectColumns,
    PosedArm,
    joint_index_from_place,
    one_joint,
)
from minimax_cal.robots.kinematics import THETA, D

MAX_CHANGE_MOMENTS = 12  # moments at which something may have changed
REFINED_MOMENTS_PER_SIDE = 24  # moments before one that was chosen, and after it
MIN_CHANGE_POSES = 12  # poses among which a moment is looked for


def session_numbers(posed_arm: PosedArm) -> Array:
    """(m,) the session of each row, from 1 in the order of the fit's; infinite for other rows.

    What is measured later finds the arm as it was last.
    """
    known = {label: number + 1.0 for number, label in enumerate(posed_arm.data.frames)}
    return np.array([known.get(label, np.inf) for label in session_labels(posed_arm.data).tolist()])


def later_session_choices(posed_arm: PosedArm) -> tuple[Choice, ...]:
    """From each session on but the first, or in it alone; none where there is one session."""
    count = len(posed_arm.data.frames)
    since = [{"session": float(number)} for number in range(2, count + 1)]
    alone = [{"session": float(number), "alone": 1.0} for number in range(2, count)]
    return (*since, *alone)


def change_moment_choices(posed_arm: PosedArm) -> tuple[Choice, ...]:
    """Moments spread over the measurement, with poses enough on both sides."""
    clock = np.sort(posed_arm.column("clock"))
    if not posed_arm.column_varies("clock") or len(clock) < MIN_CHANGE_POSES:
        return ()
    at = np.unique(np.linspace(5, len(clock) - 5, MAX_CHANGE_MOMENTS).astype(int))
    return tuple({"since": float(clock[i])} for i in at)


def has_sessions_or_clock(posed_arm: PosedArm) -> bool:
    """Whether the data tell sessions or times."""
    return len(posed_arm.data.frames) > 1 or posed_arm.column_varies("clock")


def missing_change_columns(posed_arm: PosedArm) -> str:
    """What the data lack for a change to be tested; empty for nothing."""
    return (
        ""
        if has_sessions_or_clock(posed_arm)
        else "column session, order or time_s" + posed_arm.missing_order_clause
    )


def change_active_indicator(posed_arm: PosedArm, choice: Choice) -> Array:
    """(m,) 1 where the change holds, 0 elsewhere."""
    if "session" not in choice:
        return (posed_arm.column("clock") >= choice["since"]).astype(float)
    number = session_numbers(posed_arm)
    same = number == choice["session"] if "alone" in choice else number >= choice["session"]
    return same.astype(float)


def encoder_zero_change_columns(posed_arm: PosedArm, place: str, choice: Choice) -> EffectColumns:
    """A joint's zero is another from then on.

    Geometry is that of the last rows: what was before, or what was in between, is turned from it.
    The zero grows as theta (of a slide d) of the robot's file does.
    """
    joint = joint_index_from_place(place)
    after = change_active_indicator(posed_arm, choice)
    if "alone" not in choice:
        timed = "session" in choice or {"order", "time"} & posed_arm.data.columns.keys()
        after = after - 1.0 if timed else 0.0 * after  # an arm at rest is as it was last
    is_slide = bool(posed_arm.robot.prismatic[joint])
    sense = posed_arm.robot.notation.file_value_signs(posed_arm.joints)[
        joint, D if is_slide else THETA
    ]
    unit, turn = "m" if is_slide else "rad", one_joint(posed_arm, joint, sense * after[None])
    return EffectColumns(("zero",), (unit,), turn=turn, fixed=dict(choice))


def refine_change_moments(posed_arm: PosedArm, choice: Choice) -> Sequence[Choice]:
    """Moments near one that was chosen; sessions are what they are."""
    if "since" not in choice:
        return ()
    clock = np.sort(posed_arm.column("clock"))
    at = int(np.searchsorted(clock, choice["since"]))
    step = max(1, len(clock) // MAX_CHANGE_MOMENTS)
    away = np.unique(
        np.geomspace(1, step, REFINED_MOMENTS_PER_SIDE).astype(int)
    )  # fine nearby, coarse afar
    near = at + np.concatenate([-away[::-1], [0], away])
    near = near[(near >= 3) & (near < len(clock) - 3)]
    return tuple({**choice, "since": float(t)} for t in clock[near])


ENCODER_ZERO = Effect(
    "encoder_zero",
    "the zero of a joint has changed: a new motor or encoder, a collision, mastering",
    "the joint turns by c more from a session, or a moment, on",
    lambda scene: (
        tuple(f"J{joint + 1}" for joint in np.flatnonzero(~scene.robot.passive))
        if has_sessions_or_clock(scene)
        else ()
    ),
    encoder_zero_change_columns,
    finer=refine_change_moments,
    needs=missing_change_columns,
    choices=lambda scene, place: (*later_session_choices(scene), *change_moment_choices(scene)),
    typical=1e-3,
    follows="session",
    of_past=True,
)
