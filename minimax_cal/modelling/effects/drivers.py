"""What drives an effect, as numbers for people: the axis that its curve is drawn against."""

from __future__ import annotations

import numpy as np

from minimax_cal.ground.arrays import Array
from minimax_cal.modelling.effects.changes import session_number
from minimax_cal.modelling.effects.scene import Choice, Scene
from minimax_cal.modelling.effects.table import EFFECTS, Term

Axis = tuple[str, Array]  # label with unit, (m,) values


def axis_of(scene: Scene, term: Term, joint: int) -> Axis:
    """(m,) what the law of an effect looks at, with its label; of a joint where it has joints."""
    effect = EFFECTS.get(term.effect)
    if effect and effect.against:
        return effect.against(scene, joint, term.choice)
    return AXES.get(effect.follows if effect else "", own_value)(scene, joint, term.choice)


def own_value(scene: Scene, joint: int, choice: Choice) -> Axis:
    """A joint's own value, as people read it."""
    if scene.robot.prismatic[joint]:
        return f"joint {joint + 1} (mm)", 1e3 * scene.data.q[:, joint]
    return f"joint {joint + 1} (deg)", np.degrees(scene.data.q[:, joint])


def within_wave(scene: Scene, joint: int, choice: Choice) -> Axis:
    """Where in its wave a joint stands."""
    period = 360.0 / choice["turns"]
    wave = np.mod(np.degrees(scene.q[joint]), period)
    return f"joint {joint + 1} within a wave of {period:.3g}° (deg)", wave


def of_source(scene: Scene, joint: int, choice: Choice) -> Axis:
    """The value of the joint that turns another."""
    return own_value(scene, int(choice["source"]) - 1, choice)


def torque(scene: Scene, joint: int, choice: Choice) -> Axis:
    """Gravity's torque."""
    told = scene.known_masses or scene.measured_torques
    masses = "" if told else ", masses assumed"
    return f"static torque of joint {joint + 1}{masses} (N m)", scene.gravity[joint]


def last_move(scene: Scene, joint: int, choice: Choice) -> Axis:
    """How far a joint moved last; where that is not known, the side that it came from."""
    if not scene.has(f"move{joint + 1}"):
        side = scene.column(f"approach{joint + 1}")
        return f"side that joint {joint + 1} came from (-1 or 1)", side
    unit, scale = ("mm", 1e3) if scene.robot.prismatic[joint] else ("deg", 180.0 / np.pi)
    move = scene.column(f"move{joint + 1}")
    return f"last move of joint {joint + 1} ({unit})", scale * move


def time_or_warmth(scene: Scene, joint: int, choice: Choice) -> Axis:
    """The time in the session, or the temperature where the law looks at that."""
    if "temperature" in choice:
        return "temperature (°C)", scene.data.columns["temperature"].astype(float)
    return "time in the session (0 first, 1 last)", scene.column("clock")


def session_or_moment(scene: Scene, joint: int, choice: Choice) -> Axis:
    """The number of the session, or the time where the law looks at a moment of it."""
    if "session" in choice:
        return "session", np.minimum(session_number(scene), len(scene.data.frames) + 1.0)
    return time_or_warmth(scene, joint, choice)


def attitude(scene: Scene, joint: int, choice: Choice) -> Axis:
    """How the flange stands to gravity."""
    tilt = np.clip((scene.links.axes[2] * scene.robot.up[:, None]).sum(axis=0), -1.0, 1.0)
    return "flange axis from the vertical (deg)", np.degrees(np.arccos(tilt))


AXES = {
    "wave": within_wave,
    "source": of_source,
    "load": torque,
    "approach": last_move,
    "move": last_move,
    "time": time_or_warmth,
    "session": session_or_moment,
    "attitude": attitude,
}
