"""What poses will tell, in numbers and words: growth with their number, effects told apart.

Observability indices: what the field calls a good set of poses.

All are functions of the singular values s_1 >= ... >= s_f of the Jacobian of every measured
coordinate by every identifiable parameter.  They depend on the units of the parameters.  Here each
parameter is counted by the root mean square motion that it gives a target, so that the Jacobian has
no unit; the indices then compare sets of poses of one robot with one list of parameters.

O1 = (s_1 ... s_f)^(1/f) / sqrt(m)    Borm and Menq 1991 (m poses): volume of the ellipsoid, D
O2 = s_f / s_1                        Driels and Pathre 1990: inverse of the condition number
O3 = s_f                              Nahvi, Hollerbach and Hayward 1994: E
O4 = s_f^2 / s_1                      Nahvi and Hollerbach 1996: noise amplification index
O5 = 1 / (1/s_1 + ... + 1/s_f)        Sun and Hollerbach 2008: of the kind of A
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, NamedTuple

import numpy as np

from minimax_cal.core.arrays import Array
from minimax_cal.core.record_fields import FieldFormat, StoredSeparately
from minimax_cal.modelling.effects.effect_names import format_effect_label

MICROMETRE_FACT = FieldFormat(scale=1e6, unit="um")


class PlannedAndRandom(NamedTuple):
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
    mean: Annotated[PlannedAndRandom, MICROMETRE_FACT]
    worst: Annotated[PlannedAndRandom, MICROMETRE_FACT]
    size: StoredSeparately[PlannedAndRandom]


@dataclass(frozen=True)
class Separation:
    """Two effects that the poses are to tell apart.

    now, planned: power of the poses at hand, and of those planned besides.  needed: that is enough.
    everything: of all candidates together.  alike: whether no pose tells them apart.
    else_: what would, besides poses like these.
    """

    one: Annotated[str, FieldFormat(key="effect")]
    other: Annotated[str, FieldFormat(key="rival")]
    now: Annotated[float, FieldFormat(key="power.now")]
    planned: Annotated[float, FieldFormat(key="power.planned")]
    everything: Annotated[float, FieldFormat(key="power.all_candidates")]
    needed: Annotated[float, FieldFormat(key="power.needed")]
    alike: Annotated[bool, FieldFormat(key="alike_at_every_pose")]
    else_: Annotated[str, FieldFormat(key="separate_with")]

    def headline(self) -> str:
        """How far the poses get, in words."""
        pair = f"{format_effect_label(self.one)} and {format_effect_label(self.other)}"
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


# ---- observability -------------------------------------------------------------------------------


OBSERVABILITY_INDEX_NAMES = {
    "O1": "Borm and Menq: volume",
    "O2": "Driels and Pathre: inverse condition number",
    "O3": "Nahvi, Hollerbach and Hayward: least singular value",
    "O4": "Nahvi and Hollerbach: noise amplification",
    "O5": "Sun and Hollerbach: inverse sum of inverses",
}


def observability_indices(singular_values: Array, pose_count: int) -> dict[str, float]:
    """The five indices.  singular_values: (f,) of the scaled Jacobian, the largest first, f > 0."""
    largest, least = float(singular_values[0]), float(singular_values[-1])
    if not least > 0.0:
        return dict.fromkeys(OBSERVABILITY_INDEX_NAMES, 0.0)
    return {
        "O1": float(np.exp(np.log(singular_values).mean())) / float(np.sqrt(pose_count)),
        "O2": least / largest,
        "O3": least,
        "O4": least**2 / largest,
        "O5": 1.0 / float((1.0 / singular_values).sum()),
    }
