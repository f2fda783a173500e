"""What changes as the measurement goes on: warm links, a creeping base, a nest that moves."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from minimax_cal.ground.arrays import Array
from minimax_cal.measuring.stations import station
from minimax_cal.modelling.effects.changes import (
    can_change,
    finer_moments,
    is_after,
    lacking,
    later_sessions,
    moments,
)
from minimax_cal.modelling.effects.scene import Choice, Columns, Effect, Scene
from minimax_cal.robots.kinematics import cross

CONSTANTS = (0.15, 0.5, np.inf)  # of the session; infinite is a straight line
FINER = np.array([0.5, 0.65, 0.8, 0.9, 1.1, 1.25, 1.5, 2.0])
TWO = {"fast": 0.15, "slow": np.inf}  # two constants: one settles fast, the other slowly
ROOM = 20.0  # temperature at which lengths are what they are called [C]


def course(scene: Scene, choice: Choice) -> Array:
    """(m,) how far a change has gone: 1 - exp(-t/tau) over the session, or the temperature.

    Where the temperature was not read it is the mean of those that were, or that of the room.
    """
    if "temperature" in choice:
        warm = scene.data.columns.get("temperature", np.zeros(0)).astype(float)
        known = warm[np.isfinite(warm)]
        if not len(known):
            return np.zeros(scene.poses)
        return np.where(np.isfinite(warm), warm, known.mean()) - ROOM
    clock, constant = scene.column("clock"), choice["constant"]
    return clock if np.isinf(constant) else np.asarray(1.0 - np.exp(-clock / constant))


def paths(scene: Scene, choice: Choice) -> list[Array]:
    """The course, or a fast and a slow one where a law has two constants."""
    if "slow" not in choice:
        return [course(scene, choice)]
    return [course(scene, {"constant": choice[which]}) for which in ("fast", "slow")]


def courses(scene: Scene, place: str) -> Sequence[Choice]:
    """Time courses worth trying."""
    found: list[Choice] = [{"constant": c} for c in CONSTANTS] if scene.has("clock") else []
    return (*found, {"temperature": 1.0}) if scene.has("temperature") else tuple(found)


def finer(scene: Scene, choice: Choice) -> Sequence[Choice]:
    """Time constants, or moments, near one that was chosen."""
    if "constant" not in choice and "fast" not in choice:
        return finer_moments(scene, choice)
    if "fast" in choice:
        return tuple({**choice, "fast": float(fast)} for fast in choice["fast"] * FINER)
    constant = choice["constant"]
    values = (1.0, 1.5, 2.5, 5.0) if np.isinf(constant) else constant * FINER
    return tuple({**choice, "constant": float(value)} for value in values)


def told(choice: Choice) -> dict[str, float]:
    """The choice for the report."""
    constant = choice.get("constant", np.nan)
    return {"time_constant_of_session": constant} if np.isfinite(constant) else {}


def growth(scene: Scene, place: str, choice: Choice) -> Columns:
    """The long lengths grow: together by one strain, or each by its own."""
    a, d = scene.robot.mdh[:, 0], scene.robot.mdh[:, 1]
    along = np.stack([a[:, None, None] * scene.links.x, d[:, None, None] * scene.links.z], axis=1)
    size = np.stack([np.abs(a), np.abs(d)], axis=1)
    if not choice.get("apart"):
        long = along[size > 0.1 * scene.robot.reach()].sum(axis=0)
        parts = paths(scene, choice)
        shift = np.stack([np.broadcast_to(one * long, scene.points.shape) for one in parts])
        names = ("strain", "slow strain")[: len(parts)]
        return Columns(names, ("1",) * len(parts), shift=shift, fixed=told(choice))
    grown = course(scene, choice) * along
    chosen = sorted(np.argsort(-size.reshape(-1))[:3].tolist())
    names = tuple(f"strain {'ad'[i % 2]}{i // 2 + 1}" for i in chosen)
    parts = grown.reshape(-1, *grown.shape[2:])[chosen]
    shift = np.broadcast_to(parts[:, None], (len(chosen), *scene.points.shape))
    return Columns(names, ("1",) * len(names), shift=shift, fixed=told(choice))


THERMAL_GROWTH = Effect(
    "thermal_growth",
    "links grow as the arm warms up",
    "dl = l s (1 - exp(-t/tau)), or l s (T - 20 C)",
    lambda scene: ("all",) if courses(scene, "all") else (),
    growth,
    finer=finer,
    needs=lambda scene: (
        "" if courses(scene, "all") else "columns time_s, order or temperature_C" + scene.untold
    ),
    choices=lambda scene, place: tuple(
        [{**choice, "apart": apart} for choice in courses(scene, place) for apart in (0.0, 1.0)]
        + ([{**TWO, "apart": 0.0}] if scene.has("clock") else [])
    ),
    typical=1e-3,
    follows="time",
)


RIGID = ("x", "y", "z", "rx", "ry", "rz")
RIGID_UNITS = ("m",) * 3 + ("rad",) * 3


def rigid(scene: Scene) -> Array:
    """(6, k, 3, m) motion of the points with the base: along and about its axes."""
    eye = np.broadcast_to(np.eye(3)[:, None, :, None], (3, *scene.points.shape))
    return np.concatenate([eye, cross(eye, np.broadcast_to(scene.points, eye.shape))])


def drift(scene: Scene, place: str, choice: Choice) -> Columns:
    """The base moves and turns with time."""
    parts = [one * rigid(scene) for one in paths(scene, choice)]
    names = (*RIGID, *(f"slow {name}" for name in RIGID))[: 6 * len(parts)]
    units = RIGID_UNITS * len(parts)
    return Columns(names, units, shift=np.concatenate(parts), fixed=told(choice))


FRAME_DRIFT = Effect(
    "frame_drift",
    "robot base or instrument creeps during the session",
    "the base moves by (t, r) (1 - exp(-t/tau))",
    lambda scene: ("frame",) if scene.has("clock") else (),
    drift,
    finer=finer,
    needs=lambda scene: "" if scene.has("clock") else "column order or time_s" + scene.untold,
    choices=lambda scene, place: (*(c for c in courses(scene, place) if "constant" in c), TWO),
    typical=1e-2,
    moves="frame",
    follows="time",
)


def nest(scene: Scene, place: str, choice: Choice) -> Columns:
    """One target sits elsewhere on the flange from a session, or a moment, on."""
    target = scene.data.target_names.index(place)
    shift = np.zeros((3, *scene.points.shape))
    shift[:, target] = is_after(scene, choice) * scene.links.axes
    return Columns(("x", "y", "z"), ("m",) * 3, shift=shift, fixed=dict(choice))


TARGET_SHIFT = Effect(
    "target_shift",
    "a reflector's nest moved during the session, or between sessions",
    "the target sits elsewhere after row k, or from a session on",
    lambda scene: scene.data.target_names if scene.targets > 1 and can_change(scene) else (),
    nest,
    finer=finer,
    needs=lambda scene: "a second target" if scene.targets < 2 else lacking(scene),
    choices=lambda scene, place: (*later_sessions(scene), *moments(scene)),
    typical=5e-3,
    moves="target",
    follows="time",
)


def plate(scene: Scene, place: str, choice: Choice) -> Columns:
    """All targets sit elsewhere from then on: the plate as a body, or (`apart`) each nest."""
    after = is_after(scene, choice)
    axes = scene.links.axes
    fixed = {name: value for name, value in choice.items() if name != "apart"}
    if choice["apart"]:
        shift = np.zeros((scene.targets, 3, *scene.points.shape))
        for target in range(scene.targets):
            shift[target, :, target] = after * axes
        names = tuple(f"{name} {axis}" for name in scene.data.target_names for axis in "xyz")
        whole = shift.reshape(-1, *scene.points.shape)
        return Columns(names, ("m",) * len(names), shift=whole, fixed=fixed)
    moved = np.broadcast_to(axes[:, None], (3, *scene.points.shape))
    arm = scene.points - scene.links.origin
    turned = cross(moved, np.broadcast_to(arm, moved.shape))
    return Columns(RIGID, RIGID_UNITS, shift=after * np.concatenate([moved, turned]), fixed=fixed)


def reseats(scene: Scene, place: str) -> Sequence[Choice]:
    """Sessions and moments, the plate as a body where the targets show its turn."""
    apart = (0.0,) if scene.targets > 2 else (1.0,)
    found = (*later_sessions(scene), *moments(scene))
    return tuple({**choice, "apart": a} for choice in found for a in apart)


TARGET_RESEAT = Effect(
    "target_reseat",
    "the plate of the reflectors, or all of them, re-seated",
    "all targets sit elsewhere on the flange after row k, or from a session on",
    lambda scene: ("all",) if can_change(scene) else (),
    plate,
    finer=finer,
    needs=lacking,
    choices=reseats,
    typical=5e-3,
    moves="target",
    follows="time",
)


def jump(scene: Scene, place: str, choice: Choice) -> Columns:
    """The base stands elsewhere from a moment on, or in each session but the first."""
    if "sessions" not in choice:
        after = (scene.column("clock") >= choice["since"]).astype(float)
        fixed = {"since": choice["since"]}
        return Columns(RIGID, RIGID_UNITS, shift=after * rigid(scene), fixed=fixed)
    one, where = rigid(scene), station(scene.data)
    further = range(1, int(choice["sessions"]))
    return Columns(
        tuple(f"{name}{number + 1}" for number in further for name in RIGID),
        RIGID_UNITS * len(further),
        shift=np.concatenate([(where == number) * one for number in further]),
    )


SESSION_JUMP = Effect(
    "session_jump",
    "instrument or robot was moved",
    "the base stands elsewhere by (t, r) after row k, or in a further session",
    lambda scene: ("frame",) if scene.has("clock") else (),
    jump,
    needs=lambda scene: "" if scene.has("clock") else "column order or time_s",
    choices=lambda scene, place: (),  # its moment is read off the errors: `faults.jumps`
    typical=1e-2,
    moves="frame",
    follows="time",
)


def sight(scene: Scene, place: str, choice: Choice) -> Columns:
    """The distance reads r too far along the line of sight."""
    seen = scene.points - scene.instruments
    unit = seen / np.linalg.norm(seen, axis=1, keepdims=True)
    shift = np.zeros((1, *scene.points.shape))
    chosen = slice(None) if place == "all" else scene.data.target_names.index(place)
    shift[0, chosen] = unit[chosen]
    return Columns(("r",), ("m",), shift=shift)


TARGET_OFFSET = Effect(
    "target_offset",
    "a reflector's offset or the instrument's zero is wrong along the line of sight",
    "dp = r u, u from the instrument to the point",
    lambda scene: (*scene.data.target_names, "all") if scene.targets > 1 else ("all",),
    sight,
    typical=5e-3,
    moves="instrument",
    follows="sight",
)
