"""What poses will tell, in numbers and words: growth with their number, effects told apart."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from minimax_cal.modelling.effects.words import name_label


@dataclass(frozen=True)
class Growth:
    """What so many poses tell, planned and random (median): sigma of a position [m].

    mean: root of the mean variance over the workspace.  worst: the largest there.
    size: of the criterion, as `Plan.size`.
    """

    poses: int
    mean: tuple[float, float]
    worst: tuple[float, float]
    size: tuple[float, float]

    def to_dict(self) -> dict[str, Any]:
        """For JSON, in micrometres."""
        sigmas = {"mean_um": self.mean, "worst_um": self.worst}
        both = {
            name: {"planned": 1e6 * planned, "random": 1e6 * random}
            for name, (planned, random) in sigmas.items()
        }
        return {"poses": self.poses, **both}


@dataclass(frozen=True)
class Separation:
    """Two effects that the poses are to tell apart.

    now, planned: power of the poses at hand, and of those planned besides.  needed: that is enough.
    everything: of all candidates together.  alike: whether no pose tells them apart.
    else_: what would, besides poses like these.
    """

    one: str
    other: str
    now: float
    planned: float
    everything: float
    needed: float
    alike: bool
    else_: str

    def headline(self) -> str:
        """How far the poses get, in words."""
        pair = f"{name_label(self.one)} and {name_label(self.other)}"
        if self.alike:
            return (
                f"{pair} move the targets alike at every pose: no pose tells them apart. "
                f"Otherwise: {self.else_}."
            )
        text = (
            f"Power to tell {pair} apart: {self.now:.3g} now, {self.planned:.3g} with these "
            f"poses; {self.needed:.0f} is enough."
        )
        if self.planned >= self.needed:
            return text
        if self.everything >= self.needed:
            return f"{text} All candidates together reach {self.everything:.3g}: plan more poses."
        return (
            f"{text} All candidates together reach {self.everything:.3g}: no poses like these "
            f"tell them apart. Otherwise: {self.else_}."
        )

    def to_dict(self) -> dict[str, Any]:
        """For JSON."""
        return {
            "effect": self.one,
            "rival": self.other,
            "power": {
                "now": self.now,
                "planned": self.planned,
                "all_candidates": self.everything,
                "needed": self.needed,
            },
            "alike_at_every_pose": self.alike,
            "separate_with": self.else_,
        }
