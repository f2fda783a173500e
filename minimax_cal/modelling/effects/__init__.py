"""Effects beyond geometry: one physical cause each, with its law, places and units."""

from minimax_cal.modelling.effects.scene import Columns, Effect, Scene
from minimax_cal.modelling.effects.table import EFFECTS, Term, register

__all__ = ["EFFECTS", "Columns", "Effect", "Scene", "Term", "register"]
