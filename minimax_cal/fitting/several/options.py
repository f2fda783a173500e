"""What can be chosen of a calibration without coordinates, and which choice suits which kind."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from minimax_cal.fitting.options import Options, check_priors, known_within
from minimax_cal.fitting.pixels.options import PixelOptions
from minimax_cal.ground.arrays import Array
from minimax_cal.ground.errors import OptionError
from minimax_cal.ground.stages import Progress as Progress
from minimax_cal.ground.stages import silent as silent
from minimax_cal.instruments.options import InstrumentOptions, fitted
from minimax_cal.modelling.effects.table import Term
from minimax_cal.modelling.parameters import Names


def noise_of(text: str) -> tuple[str, float]:
    """FILE=SIGMA: a file by its stem, and how noisy its numbers are, in mm.  Raises OptionError."""
    name, _, size = text.rpartition("=")
    number = size.strip().removesuffix("mm").strip()
    if name.strip() and re.fullmatch(r"[-+.\deE]+", number):
        try:
            return name.strip(), 1e-3 * float(number)
        except ValueError:
            pass
    raise OptionError(f"noise {text!r}: write FILE=SIGMA in mm, as wires=0.2mm")


@dataclass(frozen=True)
class RelativeOptions(InstrumentOptions):
    """How to calibrate.

    holdout, seed, offset, known_distances, lever: see `InstrumentOptions`.  fix, free: names or
    patterns as ``beta*``.
    noises: sigma of a number of a file by its name [m], or a text as 0.2mm; of others residuals
    say it.  priors: sigma of a parameter's deviation from nominal, by name [m, rad], or a text as
    5mm.  effects: of the arm beyond geometry, fitted with it, as joint_compliance:all; or a
    diagnosis, of which the confirmed effects are taken.
    camera_on, fix_camera, camera_prior: of pixels, as `calibrate_pixels` takes them.
    method: of the least squares.  resolution: relative singular value that counts as not measured.
    """

    fix: Sequence[str] = ()
    free: Sequence[str] = ()
    noises: Mapping[str, float] = fitted(
        dict,
        "How noisy a file's numbers are, by its name without ending [default: as its residuals].",
        flag="--noise",
        metavar="FILE=SIGMA",
        read=noise_of,
        many=dict,
    )
    priors: Mapping[str, float] = field(default_factory=dict)
    effects: Sequence[str | Term] = ()
    camera_on: str = PixelOptions.camera_on
    fix_camera: bool = PixelOptions.fix_camera
    camera_prior: str = PixelOptions.camera_prior
    method: str = Options.method
    resolution: float = Options.resolution

    def settings(self) -> dict[str, object]:
        """For the record."""
        told = [list(known) for known in self.known_distances]
        effects = [e.text if isinstance(e, Term) else e for e in self.effects]
        return {**vars(self), "known_distances": told, "priors": dict(self.priors),
                "noises": dict(self.noises), "effects": effects}  # fmt: skip


def read_noises(noises: Mapping[str, float | str]) -> dict[str, float]:
    """Noises in metres, from numbers or texts.  Raises OptionError."""
    pairs = (noise_of(f"{k}={v}") if isinstance(v, str) else (k, v) for k, v in noises.items())
    return dict(pairs)


def sigmas_of(names: Names, options: RelativeOptions) -> Array:
    """(5 n,) sigma of each link's prior, infinite where nothing is known.  Raises OptionError."""
    check_priors(options.priors)
    return known_within(names, options.priors, "targets and anchors")[names.links]
