"""A change between the sessions of a fit: what, since when, and by how much."""

from __future__ import annotations

import math
from dataclasses import dataclass

from minimax_cal.ground.units import for_people
from minimax_cal.modelling.effects.words import name_effect

STILL = 0.01  # p-value above which a frame may stand where it stood


@dataclass(frozen=True)
class Amount:
    """A parameter with its 95 % interval.  [SI]"""

    name: str
    value: float
    sigma: float
    low95: float
    high95: float
    unit: str

    @property
    def text(self) -> str:
        """As +0.502 +- 0.003 mrad, the interval of 95 %."""
        scale, unit = for_people(self.unit)
        half = 0.5 * scale * (self.high95 - self.low95)
        digits = max(0, 1 - math.floor(math.log10(half))) if half > 0.0 else 3
        return f"{scale * self.value:+.{digits}f} +- {half:.{digits}f} {unit}"


@dataclass(frozen=True)
class Change:
    """Something that is otherwise from a session on, or in one alone.

    effect, place: as in the library.  session: from which on; only: whether in that alone.
    p_value: of so much by accident, among all that was looked at.
    """

    effect: str
    place: str
    session: str
    only: bool
    amounts: tuple[Amount, ...]
    p_value: float
    text: str

    @property
    def when(self) -> str:
        """In which sessions."""
        return f"in session {self.session} alone" if self.only else f"from {self.session} on"

    @property
    def sizes(self) -> str:
        """By how much."""
        several = len(self.amounts) > 1
        parts = (f"{one.name} {one.text}" if several else one.text for one in self.amounts)
        return f"{', '.join(parts)} (95 %)"

    @property
    def sentence(self) -> str:
        """What changed, by how much, since when, and how a fit takes it into account."""
        if self.text:
            what = f"{name_effect(self.effect, self.place)} {self.when} by {self.sizes}"
            return f"moved between sessions: {what}; effects='{self.text}' fits it"
        if self.p_value > STILL:
            most = f"{1e3 * self.amounts[0].high95:.2g} mm"
            return f"session {self.session}: instrument and base stand as at first, within {most}"
        return f"instrument or base stands elsewhere {self.when}: {self.sizes}"
