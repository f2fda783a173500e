"""Effects, places and steps of an error budget as people call them; files keep the code names."""

from __future__ import annotations

import math
from collections.abc import Iterable

from minimax_cal.evidence.limits import STRUCTURE
from minimax_cal.evidence.remains import FOLLOWING
from minimax_cal.modelling.effects.table import EFFECTS

OF_TARGETS = ("outliers", "swapped_rows")  # faults of the data: all of their place are the targets
WHOLE = {"target": "of the targets", "tool": "of the tool"}  # what "all" is, by what moves
PLACED = ("foot", "frame", "tool")  # what moves where the name of an effect says so
KINDS = {"J": "joint", "L": "link"}
STEPS = {"nominal": "nominal arm", "geometric": "calibrated geometry"}


def name_place(place: str, effect: str = "") -> str:
    """A place, as at joint 2.  effect: what is there, which may be no part of the arm."""
    if place == "all":
        moved = EFFECTS[effect].moves if effect in EFFECTS else ""
        return WHOLE["target"] if effect in OF_TARGETS else WHOLE.get(moved, "of the whole arm")
    if place == "frame":
        return "of the base"
    return f"at {name_part(place) or place}"


def name_part(place: str) -> str:
    """A part of the arm, as joint 2 for J2; '' where the place is none."""
    kind = KINDS.get(place[:1]) if place[1:].isdigit() else None
    return f"{kind} {place[1:]}" if kind else ""


def name_effect(effect: str, place: str = "") -> str:
    """An effect with its place, as joint compliance at joint 2."""
    said = effect in EFFECTS and EFFECTS[effect].moves in PLACED
    at = f" {name_place(place, effect)}" if place and not said else ""
    return f"{effect.replace('_', ' ')}{at}"


def name_kinds(labels: Iterable[str]) -> str:
    """Kinds of effects, each once, of labels as joint_compliance:J2."""
    return ", ".join(dict.fromkeys(name_effect(label.partition(":")[0]) for label in labels))


def name_label(label: str) -> str:
    """An effect by its label, as joint_compliance:J2; anything else stays."""
    effect, _, place = label.partition(":")
    return name_effect(effect, place) if effect in EFFECTS else label


def name_parameter(code: str) -> str:
    """A parameter of an effect, as joint_compliance:J2.c2; one of geometry stays."""
    label, _, parameter = code.partition(".")
    return f"{name_label(label)}, {parameter}" if ":" in label else code


def own_name(code: str) -> str:
    """A parameter by its name alone, as c2 of joint_compliance:J2.c2; one of geometry stays."""
    return code.partition(".")[2] or code


def name_structure(text: str) -> str:
    """What remains, as J2 following time; a text that says no driver stays."""
    place, _, driver = text.partition(FOLLOWING)
    part, mark, how = place.partition(" ")
    moving = name_label(name_part(part) or part) + mark + how
    return f"a motion of {moving} that depends on {driver}" if driver else text


def name_chance(p: float) -> str:
    """The chance of what may remain; below what is certain it matters not how small it is."""
    return "-" if math.isnan(p) else f"< {STRUCTURE:g}" if p < STRUCTURE else f"{p:.2g}"


def name_step(step: str) -> str:
    """A step of an error budget, as + joint compliance at joint 2."""
    if not step.startswith("+ "):
        return STEPS.get(step, step)
    return f"+ {name_effect(*step.removeprefix('+ ').split(' ', 1))}"
