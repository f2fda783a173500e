"""What poses will tell, in numbers and words: growth with their number, effects told apart."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, NamedTuple

from minimax_cal.ground.facts import Apart, Fact
from minimax_cal.modelling.effects.words import name_label

MICRO = Fact(scale=1e6, unit="um")


class Both(NamedTuple):
    """Of the poses planned, and the median of random ones."""

    planned: float
    random: float


@dataclass(frozen=True)
class Growth:
    """What so many poses tell: sigma of a position [m].

    mean: root of the mean variance over the workspace.  worst: the largest there.
    size: of the criterion, as `Plan.size`.
    """

    poses: int
    mean: Annotated[Both, MICRO]
    worst: Annotated[Both, MICRO]
    size: Apart[Both]


@dataclass(frozen=True)
class Separation:
    """Two effects that the poses are to tell apart.

    now, planned: power of the poses at hand, and of those planned besides.  needed: that is enough.
    everything: of all candidates together.  alike: whether no pose tells them apart.
    else_: what would, besides poses like these.
    """

    one: Annotated[str, Fact(key="effect")]
    other: Annotated[str, Fact(key="rival")]
    now: Annotated[float, Fact(key="power.now")]
    planned: Annotated[float, Fact(key="power.planned")]
    everything: Annotated[float, Fact(key="power.all_candidates")]
    needed: Annotated[float, Fact(key="power.needed")]
    alike: Annotated[bool, Fact(key="alike_at_every_pose")]
    else_: Annotated[str, Fact(key="separate_with")]

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
