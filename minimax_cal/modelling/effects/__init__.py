"""Effects beyond geometry: one physical cause each, with its law, places and units."""

from minimax_cal.modelling.effects.scene import Effect, EffectColumns, PosedArm
from minimax_cal.modelling.effects.scene import EffectColumns as Columns
from minimax_cal.modelling.effects.scene import PosedArm as Scene
from minimax_cal.modelling.effects.table import EFFECTS, Term, register

__all__ = [
    "EFFECTS", "Columns", "Effect", "EffectColumns", "PosedArm", "Scene", "Term", "register",
]  # fmt: skip
