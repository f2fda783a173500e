"""What drives an effect, as numbers for people: the axis that its curve is drawn against."""

from __future__ import annotations

import numpy as np

from minimax_cal.core.arrays import Array
from minimax_cal.modelling.effects.scene import Choice, PosedArm
from minimax_cal.modelling.effects.sudden_changes import session_numbers
from minimax_cal.modelling.effects.table import EFFECTS, Term

CurveAxis = tuple[str, Array]  # label with unit, (m,) values


def curve_axis_of_effect(posed_arm: PosedArm, term: Term, joint: int) -> CurveAxis:
    """(m,) what the law of an effect looks at, with its label; of a joint where it has joints."""
    effect = EFFECTS.get(term.effect)
    if effect and effect.against:
        return effect.against(posed_arm, joint, term.choice)
    return AXIS_BY_DRIVER.get(effect.follows if effect else "", joint_value_axis)(
        posed_arm, joint, term.choice
    )


def joint_value_axis(posed_arm: PosedArm, joint: int, choice: Choice) -> CurveAxis:
    """A joint's own value, as people read it."""
    if posed_arm.robot.prismatic[joint]:
        return f"joint {joint + 1} (mm)", 1e3 * posed_arm.data.q[:, joint]
    return f"joint {joint + 1} (deg)", np.degrees(posed_arm.data.q[:, joint])


def wave_phase_axis(posed_arm: PosedArm, joint: int, choice: Choice) -> CurveAxis:
    """Where in its wave a joint stands."""
    period = 360.0 / choice["turns"]
    wave = np.mod(np.degrees(posed_arm.q[joint]), period)
    return f"joint {joint + 1} within a wave of {period:.3g}° (deg)", wave


def source_joint_axis(posed_arm: PosedArm, joint: int, choice: Choice) -> CurveAxis:
    """The value of the joint that turns another."""
    return joint_value_axis(posed_arm, int(choice["source"]) - 1, choice)


def gravity_torque_axis(posed_arm: PosedArm, joint: int, choice: Choice) -> CurveAxis:
    """Gravity's torque."""
    told = posed_arm.has_known_masses or posed_arm.has_measured_torques
    masses = "" if told else ", masses assumed"
    return f"static torque of joint {joint + 1}{masses} (N m)", posed_arm.gravity[joint]


def last_move_axis(posed_arm: PosedArm, joint: int, choice: Choice) -> CurveAxis:
    """How far a joint moved last; where that is not known, the side that it came from."""
    if not posed_arm.column_varies(f"move{joint + 1}"):
        side = posed_arm.column(f"approach{joint + 1}")
        return f"side that joint {joint + 1} came from (-1 or 1)", side
    unit, scale = ("mm", 1e3) if posed_arm.robot.prismatic[joint] else ("deg", 180.0 / np.pi)
    move = posed_arm.column(f"move{joint + 1}")
    return f"last move of joint {joint + 1} ({unit})", scale * move


def time_or_temperature_axis(posed_arm: PosedArm, joint: int, choice: Choice) -> CurveAxis:
    """The time in the session, or the temperature where the law looks at that."""
    if "temperature" in choice:
        return "temperature (°C)", posed_arm.data.columns["temperature"].astype(float)
    return "time in the session (0 first, 1 last)", posed_arm.column("clock")


def session_or_time_axis(posed_arm: PosedArm, joint: int, choice: Choice) -> CurveAxis:
    """The number of the session, or the time where the law looks at a moment of it."""
    if "session" in choice:
        return "session", np.minimum(session_numbers(posed_arm), len(posed_arm.data.frames) + 1.0)
    return time_or_temperature_axis(posed_arm, joint, choice)


def flange_tilt_axis(posed_arm: PosedArm, joint: int, choice: Choice) -> CurveAxis:
    """How the flange stands to gravity."""
    tilt = np.clip((posed_arm.links.axes[2] * posed_arm.robot.up[:, None]).sum(axis=0), -1.0, 1.0)
    return "flange axis from the vertical (deg)", np.degrees(np.arccos(tilt))


AXIS_BY_DRIVER = {
    "wave": wave_phase_axis,
    "source": source_joint_axis,
    "load": gravity_torque_axis,
    "approach": last_move_axis,
    "move": last_move_axis,
    "time": time_or_temperature_axis,
    "session": session_or_time_axis,
    "attitude": flange_tilt_axis,
}
