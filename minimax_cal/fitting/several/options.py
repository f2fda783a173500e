"""What can be chosen of a calibration without coordinates, and which choice suits which kind."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any

import numpy as np

from minimax_cal.fitting.opened import listed_effects
from minimax_cal.fitting.options import (
    Options,
    QpSolver,
    check_priors,
    check_resolution,
    known_within,
    listed,
    priors_of,
    qp_name,
)
from minimax_cal.fitting.robust import SQUARE, check_robust
from minimax_cal.ground.arrays import Array
from minimax_cal.ground.errors import DataError, OptionError
from minimax_cal.ground.options import SI, grouped
from minimax_cal.ground.stages import Progress as Progress
from minimax_cal.ground.stages import silent as silent
from minimax_cal.ground.units import for_people
from minimax_cal.instruments.instrument import Instrument
from minimax_cal.instruments.options import InstrumentOptions, fitted
from minimax_cal.instruments.table import INSTRUMENTS, instrument
from minimax_cal.instruments.tracker import Points
from minimax_cal.measuring.measurements import Measurements
from minimax_cal.modelling.effects.table import Term
from minimax_cal.modelling.parameters import Names
from minimax_cal.solvers.least_squares import AUTO, METHODS

BASE_UNITS = {"mm": "m", "um": "m", "deg": "rad", "mrad": "rad", "urad": "rad"}  # SI
SUM, WORST_TARGET = "sum", "minimax"  # what is minimised
seen = grouped("Cameras")


class StatedNoise(float):
    """Sigma in SI, and the unit in which it was stated."""

    unit: str

    def __new__(cls, sigma: float, unit: str) -> StatedNoise:
        """sigma: in SI.  unit: as stated, as mm or mrad."""
        made = super().__new__(cls, sigma)
        made.unit = unit
        return made


def noise_of(text: str) -> tuple[str, float]:
    """FILE=SIGMA: a file by its stem, and how noisy its numbers are, in mm unless a unit is given.

    Raises OptionError.
    """
    name, _, size = text.rpartition("=")
    found = re.fullmatch(r"([-+.\d]+(?:[eE][-+]?\d+)?)\s*([A-Za-z/]*)", size.strip())
    if name.strip() and found:
        number, unit = found.groups()
        try:
            return name.strip(), StatedNoise(
                SI.get(unit or "mm", 1.0) * float(number), unit or "mm"
            )
        except ValueError:
            pass
    raise OptionError(
        f"noise {text!r}: write FILE=SIGMA in mm or the instrument's unit, as wires=0.2mm or "
        "level=0.02mrad"
    )


@dataclass(frozen=True)
class RelativeOptions(InstrumentOptions):
    """How to calibrate.

    holdout, seed, offset, known_distances, lever: see `InstrumentOptions`.  fix, free: names or
    patterns as ``beta*``.
    noises: sigma of a number of a file by its name, in its unit [m, rad], or a text as 0.2mm; of
    others residuals say it.
    priors: sigma of a parameter's deviation from nominal, by name [m, rad], or a text as 5mm.
    effects: of the arm beyond geometry, fitted with it, as joint_compliance:all; or a
    diagnosis, of which the confirmed effects are taken.
    camera_on, fix_camera, camera_prior: of pixels, as `calibrate_pixels` takes them.
    objective: sum, or minimax: the worst part of any file, as a wire or a contact.  qp: backend of
    its quadratic programs.
    loss: how errors count: square, or huber, cauchy or tukey, which outliers pull less.
    method: of the least squares.  resolution: relative singular value that counts as not measured.
    allow_large_changes: accept an arm that is another than the one drawn.
    """

    objective: str = fitted(
        SUM, "What is minimised: sum, or minimax (the worst wire, contact, target ... of any file)."
    )
    qp: QpSolver = Options.qp
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
    camera_on: str = seen(
        "",
        "What the cameras are fixed to: flange or ground [default: what fits better].",
        metavar="flange|ground",
    )
    fix_camera: bool = seen(
        False,
        "Hold the lenses as their files say, taken as known but where a prior of theirs is given.",
    )
    camera_prior: str = seen(
        "",
        "How well the files know the lenses: focal length, centre, radial and tangential "
        "distortion [default: f 0.1%, c 2px, k 0.005, p 0.0005].",
        metavar='"f 0.1%, c 2px"',
    )
    loss: str = Options.loss
    method: str = Options.method
    resolution: float = Options.resolution
    allow_large_changes: bool = Options.allow_large_changes

    def settings(self) -> dict[str, object]:
        """For the record."""
        told = [list(known) for known in self.known_distances]
        effects = [e.text if isinstance(e, Term) else e for e in self.effects]
        return {**vars(self), "known_distances": told, "priors": dict(self.priors),
                "noises": dict(self.noises), "effects": effects,
                "qp": qp_name(self.qp)}  # fmt: skip


def read_noises(noises: Mapping[str, float | str]) -> dict[str, float]:
    """Noises in metres, from numbers or texts.  Raises OptionError."""
    pairs = (noise_of(f"{k}={v}") if isinstance(v, str) else (k, v) for k, v in noises.items())
    return dict(pairs)


READ: Mapping[str, Callable[[Any], Any]] = {  # what people give of an option, as its record has it
    "fix": listed,
    "free": listed,
    "known_distances": tuple,
    "noises": lambda given: read_noises(given or {}),
    "priors": priors_of,
    "effects": listed_effects,
}


def sigmas_of(names: Names, options: RelativeOptions) -> Array:
    """(5 n,) sigma of each link's prior, infinite where nothing is known.  Raises OptionError."""
    check_priors(options.priors)
    return known_within(names, options.priors, "targets and anchors")[names.links]


# ---- checks --------------------------------------------------------------------------------------


def check_given(every: Sequence[Instrument], *, bends: bool) -> None:
    """Raise DataError where there is nothing, or nothing but what another command takes.

    bends: whether effects of the arm are fitted, or sought.
    """
    if not every:
        raise DataError("no file of measurements is given")
    first = every[0]
    taken = not first.alone or (bends and first.alone_bends)
    if not taken and all(data.kind == first.kind for data in every):
        raise DataError(f"{first.at.source}: {first.alone}")


def check_options(every: Sequence[Instrument], options: RelativeOptions) -> None:
    """Raise OptionError for a choice that does not exist or does not suit the data."""
    if options.method not in (AUTO, *METHODS):
        raise OptionError(f"no method {options.method!r}; choose {', '.join((AUTO, *METHODS))}")
    check_resolution(options.resolution)
    if options.objective not in (SUM, WORST_TARGET):
        raise OptionError(f"no objective {options.objective!r}; choose {SUM} or {WORST_TARGET}")
    if options.objective == WORST_TARGET and options.effects:
        raise OptionError("effects= of other instruments are fitted by objective='sum': give one")
    check_robust(options.loss)
    if options.loss != SQUARE and options.objective == WORST_TARGET:
        raise OptionError(f"loss={options.loss} and objective=minimax weigh errors twice: give one")
    if options.loss != SQUARE and any(one.kind == "pixels" for one in every):
        raise OptionError(f"loss={options.loss} is not for pixels yet: leave it or them out")
    default, kinds = RelativeOptions(), {data.kind for data in every}
    chosen = {
        one.name
        for one in fields(options)
        if getattr(options, one.name) != getattr(default, one.name)
    }
    # An instrument is imported only where its files are given, or an option might be its own.
    for found in (instrument(name) for name in INSTRUMENTS if chosen or name in kinds):
        mine = [data for data in every if data.kind == found.kind]
        for name in found.options:
            if not mine and name in chosen:
                raise OptionError(f"{name}= is for {found.kind}; {held_by(every)}: leave it out")
        if mine:
            found.check_options(mine, options)


def held_by(every: Sequence[Instrument]) -> str:
    """What each file holds."""
    return " and ".join(f"{data.at.source} holds {data.kind}" for data in every)


def check_noises(
    labels: Sequence[str], every: Sequence[Instrument], options: RelativeOptions
) -> None:
    """Raise OptionError for the noise of a file that is not there, or that is none."""
    known = dict(zip(labels, every, strict=True))
    for name, sigma in options.noises.items():
        if name not in labels:
            raise OptionError(f"noise {name}: no file is called so; they are {', '.join(labels)}")
        if not known[name].noise_given:
            raise OptionError(
                f"noise {name}: of {known[name].kind} the residuals say it; leave it out"
            )
        rows = known[name].unit
        if isinstance(sigma, StatedNoise) and BASE_UNITS.get(sigma.unit, sigma.unit) != rows:
            raise OptionError(
                f"noise {name}: {sigma.unit} is no unit of {known[name].kind}, whose rows are in "
                f"{rows}: write FILE=SIGMA in {for_people(rows)[1]}"
            )
        if not (np.isfinite(sigma) and sigma > 0.0):
            raise OptionError(f"noise {name}: sigma {sigma:g} must be positive")


def only_others(kind: type) -> list[str]:
    """Options of other instruments than trackers, which those of a tracker's verb lack."""
    own = {one.name for one in fields(kind)}
    return [one.name for one in fields(RelativeOptions) if one.name not in own]


def with_others(
    every: Sequence[Instrument], options: Any, others: RelativeOptions
) -> RelativeOptions:
    """What is chosen of a verb for trackers, and of other instruments, which are given.

    Raises OptionError for what they do not know.  All have the objective sum: `relative` has more.
    """
    default, known = type(options)(), {one.name for one in fields(RelativeOptions)} - {"objective"}
    chosen = {one.name: getattr(options, one.name) for one in fields(options)}
    for name, value in chosen.items():
        is_sum = name == "objective" and value == "sum"
        if not (name in known or is_sum or value == getattr(default, name)):
            raise OptionError(f"{name}= is for points of a tracker; {held_by(every)}: leave it out")
    return replace(others, **{name: value for name, value in chosen.items() if name in known})


def check_no_others(data: Measurements, others: RelativeOptions) -> None:
    """Raise OptionError for what is chosen of other instruments beside points of a tracker."""
    check_options([Points(data)], others)
    if others.noises:
        raise OptionError("noises= is for several instruments; of one say instrument=")
