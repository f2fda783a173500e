"""Laws by which the arm of several instruments gives way, beyond its geometry.

An effect is the arm's, and so is shared: each instrument sees it through its own rows.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from minimax_cal.core.arrays import Array
from minimax_cal.core.errors import OptionError
from minimax_cal.modelling.effects.scene import PRIOR_REFERENCE_ERROR, PosedArm
from minimax_cal.modelling.effects.table import (
    EFFECTS,
    ChooseVariant,
    Term,
    effect_displacement_fields,
    effect_parameter_bounds,
    effect_parameter_names_and_units,
    effect_prior_weights,
    parse_effect_text,
)
from minimax_cal.modelling.effects.table import parse_effect_terms as terms_of
from minimax_cal.modelling.effects_in_model import split_values_by_effect


def is_arm_effect(name: str) -> bool:
    """Whether an effect moves the arm, whatever instrument looks at it."""
    return EFFECTS[name].moves_flange


@dataclass(frozen=True)
class InstrumentLaws:
    """The effects of a fit.

    names, units: of their k parameters, SI.
    """

    terms: tuple[Term, ...] = ()
    names: tuple[str, ...] = ()
    units: tuple[str, ...] = ()

    @staticmethod
    def from_texts(
        scene: PosedArm,
        scenes: Sequence[PosedArm],
        texts: Sequence[str | Term],
        pick: ChooseVariant,
    ) -> InstrumentLaws:
        """Those that texts name, as `effects.table.parse_effect_terms` reads them.  Raises
        OptionError.

        scene: of all poses; scenes: of each instrument.
        """
        for text in texts:
            name = text.effect if isinstance(text, Term) else parse_effect_text(text)[0]
            if not is_arm_effect(name):
                raise OptionError(
                    f"effect {name}: belongs to one instrument, not to the arm that all share; "
                    "leave it out, or calibrate from that instrument alone"
                )
        found = terms_of(scene, texts, pick)
        for term in found:
            if term.ends_with_session and len(scenes) > 1:
                raise OptionError(
                    f"effect {term.label}: follows the time of one file, and there are "
                    f"{len(scenes)}; give temperature_C, or calibrate from one file"
                )
            for each in scenes:
                if missing := EFFECTS[term.effect].needs(each):
                    raise OptionError(f"effect {term.effect}: {each.data.source} lacks {missing}")
        names, units = effect_parameter_names_and_units(found, scene)
        return InstrumentLaws(found, names, units)

    def displacement_fields(self, scene: PosedArm, values: Array) -> tuple[Array, Array]:
        """(d, k, 3, m) motions of a scene's targets per unit, and (k, 3, m) what they leave [m].

        That is what finite turns add at the values (d,).
        """
        fields, more = effect_displacement_fields(self.terms, scene), np.zeros(scene.points.shape)
        if values.any():
            exact = split_values_by_effect(self.terms, scene, values).displaced_targets(scene)
            more = exact - scene.points - np.tensordot(values, fields, 1)
        return fields, more

    def sigma(self, scene: PosedArm) -> Array:
        """(k,) of the priors of mean zero, infinite where there is none [SI]."""
        ridge = effect_prior_weights(self.terms, scene)
        return np.where(
            ridge > 0.0, PRIOR_REFERENCE_ERROR / np.sqrt(np.maximum(ridge, 1e-300)), np.inf
        )

    def parameter_bounds(self, scenes: Sequence[PosedArm]) -> Array:
        """(k, 2) between which the parameters must lie, whichever instrument is asked."""
        every = np.array([effect_parameter_bounds(scene, self.terms) for scene in scenes])
        return np.stack([every[..., 0].max(axis=0), every[..., 1].min(axis=0)], axis=-1)


NO_LAWS = InstrumentLaws()
