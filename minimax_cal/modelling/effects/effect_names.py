"""Effects, places and steps of an error budget as people call them; files keep the code names."""

from __future__ import annotations

import math
from collections.abc import Iterable

from minimax_cal.modelling.effects.table import EFFECTS
from minimax_cal.selection.remaining_structure import PLACE_DRIVER_SEPARATOR
from minimax_cal.selection.thresholds import REMAINING_STRUCTURE_P_VALUE

TARGET_FAULT_EFFECTS = (
    "outliers",
    "swapped_rows",
)  # faults of the data: all of their place are the targets
ALL_PLACE_WORDS = {
    "target": "of the targets",
    "tool": "of the tool",
}  # what "all" is, by what moves
PARTS_NAMED_BY_EFFECT = ("foot", "frame", "tool")  # what moves where the name of an effect says so
PLACE_LETTER_WORDS = {"J": "joint", "L": "link"}
BUDGET_STEP_WORDS = {"nominal": "nominal arm", "geometric": "calibrated geometry"}


def format_place(place: str, effect: str = "") -> str:
    """A place, as at joint 2.  effect: what is there, which may be no part of the arm."""
    if place == "all":
        moved = EFFECTS[effect].moves if effect in EFFECTS else ""
        return (
            ALL_PLACE_WORDS["target"]
            if effect in TARGET_FAULT_EFFECTS
            else ALL_PLACE_WORDS.get(moved, "of the whole arm")
        )
    if place == "frame":
        return "of the base"
    return f"at {format_arm_part(place) or place}"


def format_arm_part(place: str) -> str:
    """A part of the arm, as joint 2 for J2; '' where the place is none."""
    kind = PLACE_LETTER_WORDS.get(place[:1]) if place[1:].isdigit() else None
    return f"{kind} {place[1:]}" if kind else ""


def format_effect(effect: str, place: str = "") -> str:
    """An effect with its place, as joint compliance at joint 2."""
    said = effect in EFFECTS and EFFECTS[effect].moves in PARTS_NAMED_BY_EFFECT
    at = f" {format_place(place, effect)}" if place and not said else ""
    return f"{effect.replace('_', ' ')}{at}"


def format_effect_kinds(labels: Iterable[str]) -> str:
    """Kinds of effects, each once, of labels as joint_compliance:J2."""
    return ", ".join(dict.fromkeys(format_effect(label.partition(":")[0]) for label in labels))


def format_effect_label(label: str) -> str:
    """An effect by its label, as joint_compliance:J2; anything else stays."""
    effect, _, place = label.partition(":")
    return format_effect(effect, place) if effect in EFFECTS else label


def format_parameter(parameter_code: str) -> str:
    """A parameter of an effect, as joint_compliance:J2.c2; one of geometry stays."""
    label, _, parameter = parameter_code.partition(".")
    return f"{format_effect_label(label)}, {parameter}" if ":" in label else parameter_code


def parameter_name_without_effect(parameter_code: str) -> str:
    """A parameter by its name alone, as c2 of joint_compliance:J2.c2; one of geometry stays."""
    return parameter_code.partition(".")[2] or parameter_code


def format_remaining_structure(text: str) -> str:
    """What remains, as J2 following time; a text that says no driver stays."""
    place, _, driver = text.partition(PLACE_DRIVER_SEPARATOR)
    part, mark, how = place.partition(" ")
    moving = format_effect_label(format_arm_part(part) or part) + mark + how
    return f"a motion of {moving} that depends on {driver}" if driver else text


def format_p_value(p_value: float) -> str:
    """The chance of what may remain; below what is certain it matters not how small it is."""
    return (
        "-"
        if math.isnan(p_value)
        else f"< {REMAINING_STRUCTURE_P_VALUE:g}"
        if p_value < REMAINING_STRUCTURE_P_VALUE
        else f"{p_value:.2g}"
    )


def format_budget_step(step: str) -> str:
    """A step of an error budget, as + joint compliance at joint 2."""
    if not step.startswith("+ "):
        return BUDGET_STEP_WORDS.get(step, step)
    return f"+ {format_effect(*step.removeprefix('+ ').split(' ', 1))}"
