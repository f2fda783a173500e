"""What changes as the measurement goes on: warm links, a creeping base, a nest that moves."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from minimax_cal.core.arrays import Array
from minimax_cal.measuring.session_frames import frame_index_of_rows
from minimax_cal.modelling.effects.scene import Choice, Effect, EffectColumns, PosedArm
from minimax_cal.modelling.effects.sudden_changes import (
    change_active_indicator,
    change_moment_choices,
    has_sessions_or_clock,
    later_session_choices,
    missing_change_columns,
    refine_change_moments,
)
from minimax_cal.robots.kinematics import cross

TIME_CONSTANTS = (0.15, 0.5, np.inf)  # of the session; infinite is a straight line
TIME_CONSTANT_FACTORS = np.array([0.5, 0.65, 0.8, 0.9, 1.1, 1.25, 1.5, 2.0])
TWO_TIME_CONSTANTS = {
    "fast": 0.15,
    "slow": np.inf,
}  # two constants: one settles fast, the other slowly
REFERENCE_TEMPERATURE_C = 20.0  # temperature at which lengths are what they are called [C]


def time_or_temperature_course(posed_arm: PosedArm, choice: Choice) -> Array:
    """(m,) how far a change has gone: 1 - exp(-t/tau) over the session, or the temperature.

    Where the temperature was not read it is the mean of those that were, or that of the room.
    """
    if "temperature" in choice:
        warm = posed_arm.data.columns.get("temperature", np.zeros(0)).astype(float)
        known = warm[np.isfinite(warm)]
        if not len(known):
            return np.zeros(posed_arm.poses)
        return np.where(np.isfinite(warm), warm, known.mean()) - REFERENCE_TEMPERATURE_C
    clock, constant = posed_arm.column("clock"), choice["constant"]
    return clock if np.isinf(constant) else np.asarray(1.0 - np.exp(-clock / constant))


def fast_and_slow_courses(posed_arm: PosedArm, choice: Choice) -> list[Array]:
    """The course, or a fast and a slow one where a law has two constants."""
    if "slow" not in choice:
        return [time_or_temperature_course(posed_arm, choice)]
    return [
        time_or_temperature_course(posed_arm, {"constant": choice[which]})
        for which in ("fast", "slow")
    ]


def time_course_choices(posed_arm: PosedArm, place: str) -> Sequence[Choice]:
    """Time courses worth trying."""
    found: list[Choice] = (
        [{"constant": c} for c in TIME_CONSTANTS] if posed_arm.column_varies("clock") else []
    )
    return (
        (*found, {"temperature": 1.0}) if posed_arm.column_varies("temperature") else tuple(found)
    )


def refine_time_choice(posed_arm: PosedArm, choice: Choice) -> Sequence[Choice]:
    """Time constants, or moments, near one that was chosen."""
    if "constant" not in choice and "fast" not in choice:
        return refine_change_moments(posed_arm, choice)
    if "fast" in choice:
        return tuple(
            {**choice, "fast": float(fast)} for fast in choice["fast"] * TIME_CONSTANT_FACTORS
        )
    constant = choice["constant"]
    values = (1.0, 1.5, 2.5, 5.0) if np.isinf(constant) else constant * TIME_CONSTANT_FACTORS
    return tuple({**choice, "constant": float(value)} for value in values)


def time_constant_for_report(choice: Choice) -> dict[str, float]:
    """The choice for the report."""
    constant = choice.get("constant", np.nan)
    return {"time_constant_of_session": constant} if np.isfinite(constant) else {}


def thermal_growth_columns(posed_arm: PosedArm, place: str, choice: Choice) -> EffectColumns:
    """The long lengths grow: together by one strain, or each by its own."""
    a, d = posed_arm.robot.mdh[:, 0], posed_arm.robot.mdh[:, 1]
    along = np.stack(
        [a[:, None, None] * posed_arm.links.x, d[:, None, None] * posed_arm.links.z], axis=1
    )
    size = np.stack([np.abs(a), np.abs(d)], axis=1)
    if not choice.get("apart"):
        long = along[size > 0.1 * posed_arm.robot.reach()].sum(axis=0)
        parts = fast_and_slow_courses(posed_arm, choice)
        shift = np.stack([np.broadcast_to(one * long, posed_arm.points.shape) for one in parts])
        names = ("strain", "slow strain")[: len(parts)]
        return EffectColumns(
            names, ("1",) * len(parts), shift=shift, fixed=time_constant_for_report(choice)
        )
    grown = time_or_temperature_course(posed_arm, choice) * along
    chosen = sorted(np.argsort(-size.reshape(-1))[:3].tolist())
    names = tuple(f"strain {'ad'[i % 2]}{i // 2 + 1}" for i in chosen)
    parts = grown.reshape(-1, *grown.shape[2:])[chosen]
    shift = np.broadcast_to(parts[:, None], (len(chosen), *posed_arm.points.shape))
    return EffectColumns(
        names, ("1",) * len(names), shift=shift, fixed=time_constant_for_report(choice)
    )


THERMAL_GROWTH = Effect(
    "thermal_growth",
    "links grow as the arm warms up",
    "dl = l s (1 - exp(-t/tau)), or l s (T - 20 C)",
    lambda scene: ("all",) if time_course_choices(scene, "all") else (),
    thermal_growth_columns,
    finer=refine_time_choice,
    needs=lambda scene: (
        ""
        if time_course_choices(scene, "all")
        else "columns time_s, order or temperature_C" + scene.missing_order_clause
    ),
    choices=lambda scene, place: tuple(
        [
            {**choice, "apart": apart}
            for choice in time_course_choices(scene, place)
            for apart in (0.0, 1.0)
        ]
        + ([{**TWO_TIME_CONSTANTS, "apart": 0.0}] if scene.column_varies("clock") else [])
    ),
    typical=1e-3,
    follows="time",
)


RIGID_MOTION_NAMES = ("x", "y", "z", "rx", "ry", "rz")
RIGID_MOTION_UNITS = ("m",) * 3 + ("rad",) * 3


def rigid_base_motions(posed_arm: PosedArm) -> Array:
    """(6, k, 3, m) motion of the points with the base: along and about its axes."""
    eye = np.broadcast_to(np.eye(3)[:, None, :, None], (3, *posed_arm.points.shape))
    return np.concatenate([eye, cross(eye, np.broadcast_to(posed_arm.points, eye.shape))])


def frame_drift_columns(posed_arm: PosedArm, place: str, choice: Choice) -> EffectColumns:
    """The base moves and turns with time."""
    parts = [
        one * rigid_base_motions(posed_arm) for one in fast_and_slow_courses(posed_arm, choice)
    ]
    names = (*RIGID_MOTION_NAMES, *(f"slow {name}" for name in RIGID_MOTION_NAMES))[
        : 6 * len(parts)
    ]
    units = RIGID_MOTION_UNITS * len(parts)
    return EffectColumns(
        names, units, shift=np.concatenate(parts), fixed=time_constant_for_report(choice)
    )


FRAME_DRIFT = Effect(
    "frame_drift",
    "robot base or instrument creeps during the session",
    "the base moves by (t, r) (1 - exp(-t/tau))",
    lambda scene: ("frame",) if scene.column_varies("clock") else (),
    frame_drift_columns,
    finer=refine_time_choice,
    needs=lambda scene: (
        ""
        if scene.column_varies("clock")
        else "column order or time_s" + scene.missing_order_clause
    ),
    choices=lambda scene, place: (
        *(c for c in time_course_choices(scene, place) if "constant" in c),
        TWO_TIME_CONSTANTS,
    ),
    typical=1e-2,
    moves="frame",
    follows="time",
)


def target_shift_columns(posed_arm: PosedArm, place: str, choice: Choice) -> EffectColumns:
    """One target sits elsewhere on the flange from a session, or a moment, on."""
    target = posed_arm.data.target_names.index(place)
    shift = np.zeros((3, *posed_arm.points.shape))
    shift[:, target] = change_active_indicator(posed_arm, choice) * posed_arm.links.axes
    return EffectColumns(("x", "y", "z"), ("m",) * 3, shift=shift, fixed=dict(choice))


TARGET_SHIFT = Effect(
    "target_shift",
    "a reflector's nest moved during the session, or between sessions",
    "the target sits elsewhere after row k, or from a session on",
    lambda scene: (
        scene.data.target_names if scene.targets > 1 and has_sessions_or_clock(scene) else ()
    ),
    target_shift_columns,
    finer=refine_time_choice,
    needs=lambda scene: "a second target" if scene.targets < 2 else missing_change_columns(scene),
    choices=lambda scene, place: (*later_session_choices(scene), *change_moment_choices(scene)),
    typical=5e-3,
    moves="target",
    follows="time",
)


def target_reseat_columns(posed_arm: PosedArm, place: str, choice: Choice) -> EffectColumns:
    """All targets sit elsewhere from then on: the plate as a body, or (`apart`) each nest."""
    after = change_active_indicator(posed_arm, choice)
    axes = posed_arm.links.axes
    fixed = {name: value for name, value in choice.items() if name != "apart"}
    if choice["apart"]:
        shift = np.zeros((posed_arm.targets, 3, *posed_arm.points.shape))
        for target in range(posed_arm.targets):
            shift[target, :, target] = after * axes
        names = tuple(f"{name} {axis}" for name in posed_arm.data.target_names for axis in "xyz")
        whole = shift.reshape(-1, *posed_arm.points.shape)
        return EffectColumns(names, ("m",) * len(names), shift=whole, fixed=fixed)
    moved = np.broadcast_to(axes[:, None], (3, *posed_arm.points.shape))
    arm = posed_arm.points - posed_arm.links.origin
    turned = cross(moved, np.broadcast_to(arm, moved.shape))
    return EffectColumns(
        RIGID_MOTION_NAMES,
        RIGID_MOTION_UNITS,
        shift=after * np.concatenate([moved, turned]),
        fixed=fixed,
    )


def target_reseat_choices(posed_arm: PosedArm, place: str) -> Sequence[Choice]:
    """Sessions and moments, the plate as a body where the targets show its turn."""
    apart = (0.0,) if posed_arm.targets > 2 else (1.0,)
    found = (*later_session_choices(posed_arm), *change_moment_choices(posed_arm))
    return tuple({**choice, "apart": a} for choice in found for a in apart)


TARGET_RESEAT = Effect(
    "target_reseat",
    "the plate of the reflectors, or all of them, re-seated",
    "all targets sit elsewhere on the flange after row k, or from a session on",
    lambda scene: ("all",) if has_sessions_or_clock(scene) else (),
    target_reseat_columns,
    finer=refine_time_choice,
    needs=missing_change_columns,
    choices=target_reseat_choices,
    typical=5e-3,
    moves="target",
    follows="time",
)


def session_jump_columns(posed_arm: PosedArm, place: str, choice: Choice) -> EffectColumns:
    """The base stands elsewhere from a moment on, or in each session but the first."""
    if "sessions" not in choice:
        after = (posed_arm.column("clock") >= choice["since"]).astype(float)
        fixed = {"since": choice["since"]}
        return EffectColumns(
            RIGID_MOTION_NAMES,
            RIGID_MOTION_UNITS,
            shift=after * rigid_base_motions(posed_arm),
            fixed=fixed,
        )
    one, where = rigid_base_motions(posed_arm), frame_index_of_rows(posed_arm.data)
    further = range(1, int(choice["sessions"]))
    return EffectColumns(
        tuple(f"{name}{number + 1}" for number in further for name in RIGID_MOTION_NAMES),
        RIGID_MOTION_UNITS * len(further),
        shift=np.concatenate([(where == number) * one for number in further]),
    )


SESSION_JUMP = Effect(
    "session_jump",
    "instrument or robot was moved",
    "the base stands elsewhere by (t, r) after row k, or in a further session",
    lambda scene: ("frame",) if scene.column_varies("clock") else (),
    session_jump_columns,
    needs=lambda scene: "" if scene.column_varies("clock") else "column order or time_s",
    choices=lambda scene, place: (),  # its moment is read off the errors: `faults.jumps`
    typical=1e-2,
    moves="frame",
    follows="time",
)


def line_of_sight_columns(posed_arm: PosedArm, place: str, choice: Choice) -> EffectColumns:
    """The distance reads r too far along the line of sight."""
    seen = posed_arm.points - posed_arm.instruments
    unit = seen / np.linalg.norm(seen, axis=1, keepdims=True)
    shift = np.zeros((1, *posed_arm.points.shape))
    chosen = slice(None) if place == "all" else posed_arm.data.target_names.index(place)
    shift[0, chosen] = unit[chosen]
    return EffectColumns(("r",), ("m",), shift=shift)


TARGET_OFFSET = Effect(
    "target_offset",
    "a reflector's offset or the instrument's zero is wrong along the line of sight",
    "dp = r u, u from the instrument to the point",
    lambda scene: (*scene.data.target_names, "all") if scene.targets > 1 else ("all",),
    line_of_sight_columns,
    typical=5e-3,
    moves="instrument",
    follows="sight",
)
