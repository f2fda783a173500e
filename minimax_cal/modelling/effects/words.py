"""Effects, places and steps of an error budget as people call them; files keep the code names."""

from __future__ import annotations

import re
from collections.abc import Iterable

from minimax_cal.evidence.remains import FOLLOWING
from minimax_cal.modelling.effects.table import EFFECTS

OF_TARGETS = ("outliers", "swapped_rows")  # faults of the data: all of their place are the targets
WHOLE = {"target": "of the targets", "tool": "of the tool"}  # what "all" is, by what moves
PLACED = ("foot", "frame", "tool")  # what moves where the name of an effect says so
KINDS = {"J": "joint", "L": "link"}
STEPS = {"nominal": "nominal arm", "geometric": "calibrated geometry"}
CODE = re.compile(r"\b([a-z]+(?:_[a-z]+)+):(\w+)(?:\.(\w+))?")  # as joint_compliance:J2.c2
PLACE = re.compile(r"\b([JL])(\d+)\b")


def name_place(place: str, effect: str = "") -> str:
    """A place, as at joint 2.  effect: what is there, which may be no part of the arm."""
    if place == "all":
        moved = EFFECTS[effect].moves if effect in EFFECTS else ""
        return WHOLE["target"] if effect in OF_TARGETS else WHOLE.get(moved, "of the whole arm")
    if place == "frame":
        return "of the base"
    kind = KINDS.get(place[:1]) if place[1:].isdigit() else None
    return f"at {kind} {place[1:]}" if kind else f"at {place}"


def name_effect(effect: str, place: str = "") -> str:
    """An effect with its place, as joint compliance at joint 2."""
    said = effect in EFFECTS and EFFECTS[effect].moves in PLACED
    at = f" {name_place(place, effect)}" if place and not said else ""
    return f"{effect.replace('_', ' ')}{at}"


def name_kinds(labels: Iterable[str]) -> str:
    """Kinds of effects, each once, of labels as joint_compliance:J2."""
    return ", ".join(dict.fromkeys(name_effect(label.partition(":")[0]) for label in labels))


def name_codes(text: str) -> str:
    """A text in which code names, as joint_compliance:J2.c2, are words."""

    def named(code: re.Match[str]) -> str:
        effect, place, parameter = code.groups()
        if effect not in EFFECTS:
            return code[0]
        return name_effect(effect, place) + (f", {parameter}" if parameter else "")

    return PLACE.sub(lambda at: f"{KINDS[at[1]]} {at[2]}", CODE.sub(named, text))


def name_structure(text: str) -> str:
    """What remains, as J2 following time, in words; another text stays but for its code names."""
    place, _, driver = name_codes(text).partition(FOLLOWING)
    return f"a motion of {place} that depends on {driver}" if driver else place


def name_step(step: str) -> str:
    """A step of an error budget, as + joint compliance at joint 2."""
    if not step.startswith("+ "):
        return STEPS.get(step, step)
    return f"+ {name_effect(*step.removeprefix('+ ').split(' ', 1))}"
