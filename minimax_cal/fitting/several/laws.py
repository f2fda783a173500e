"""Laws by which the arm of several instruments gives way, beyond its geometry.

An effect is the arm's, and so is shared: each instrument sees it through its own rows.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from minimax_cal.ground.arrays import Array
from minimax_cal.ground.errors import OptionError
from minimax_cal.modelling.effects.scene import BESIDE, Scene
from minimax_cal.modelling.effects.table import (
    EFFECTS,
    Pick,
    Term,
    bounds,
    fields_of,
    names_of,
    parse,
    ridge_of,
)
from minimax_cal.modelling.effects.table import terms as terms_of
from minimax_cal.modelling.joint_fit import fitted


def is_shared(name: str) -> bool:
    """Whether an effect moves the arm, whatever instrument looks at it."""
    return EFFECTS[name].of_flange


@dataclass(frozen=True)
class Laws:
    """The effects of a fit.

    names, units: of their k parameters, SI.
    """

    terms: tuple[Term, ...] = ()
    names: tuple[str, ...] = ()
    units: tuple[str, ...] = ()

    @staticmethod
    def of(scene: Scene, scenes: Sequence[Scene], texts: Sequence[str | Term], pick: Pick) -> Laws:
        """Those that texts name, as `effects.table.terms` reads them.  Raises OptionError.

        scene: of all poses; scenes: of each instrument.
        """
        for text in texts:
            name = text.effect if isinstance(text, Term) else parse(text)[0]
            if not is_shared(name):
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
        names, units = names_of(found, scene)
        return Laws(found, names, units)

    def fields(self, scene: Scene, values: Array) -> tuple[Array, Array]:
        """(d, k, 3, m) motions of a scene's targets per unit, and (k, 3, m) what they leave [m].

        That is what finite turns add at the values (d,).
        """
        fields, more = fields_of(self.terms, scene), np.zeros(scene.points.shape)
        if values.any():
            exact = fitted(self.terms, scene, values).points(scene)
            more = exact - scene.points - np.tensordot(values, fields, 1)
        return fields, more

    def sigma(self, scene: Scene) -> Array:
        """(k,) of the priors of mean zero, infinite where there is none [SI]."""
        ridge = ridge_of(self.terms, scene)
        return np.where(ridge > 0.0, BESIDE / np.sqrt(np.maximum(ridge, 1e-300)), np.inf)

    def room(self, scenes: Sequence[Scene]) -> Array:
        """(k, 2) between which the parameters must lie, whichever instrument is asked."""
        every = np.array([bounds(scene, self.terms) for scene in scenes])
        return np.stack([every[..., 0].max(axis=0), every[..., 1].min(axis=0)], axis=-1)


NO_LAWS = Laws()
