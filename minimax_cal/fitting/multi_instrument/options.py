"""What can be chosen of a calibration without coordinates, and which choice suits which kind."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any

import numpy as np

from minimax_cal.core.arrays import Array
from minimax_cal.core.errors import DataError, OptionError
from minimax_cal.core.option_fields import SI_PER_OPTION_UNIT, option_field_in_group
from minimax_cal.core.progress_stages import Progress as Progress
from minimax_cal.core.progress_stages import silent_progress as silent_progress
from minimax_cal.core.units import display_unit_of_change
from minimax_cal.fitting.opened_results import read_effect_list
from minimax_cal.fitting.options import (
    Options,
    QpSolver,
    check_priors,
    check_resolution,
    parse_priors,
    prior_sigmas,
    qp_solver_name,
    split_names,
)
from minimax_cal.fitting.robust_fit import SQUARE_LOSS, check_loss_and_trim
from minimax_cal.instruments.instrument import Instrument
from minimax_cal.instruments.instrument_options import InstrumentOptions, fitted_option_field
from minimax_cal.instruments.instrument_registry import INSTRUMENT_CLASSES, load_instrument_class
from minimax_cal.instruments.tracker_points import TrackerPoints
from minimax_cal.measuring.measurements import Measurements
from minimax_cal.modelling.effects.table import Term
from minimax_cal.modelling.parameters import ParameterNames
from minimax_cal.solvers.least_squares import AUTO_METHOD_NAME, LEAST_SQUARES_METHODS

BASE_UNITS = {"mm": "m", "um": "m", "deg": "rad", "mrad": "rad", "urad": "rad"}  # SI
SUM, WORST_TARGET = "sum", "minimax"  # what is minimised
CAMERA_OPTION_GROUP = option_field_in_group("Cameras")


class StatedNoise(float):
    """Sigma in SI, and the unit in which it was stated."""

    unit: str

    def __new__(cls, sigma: float, unit: str) -> StatedNoise:
        """sigma: in SI.  unit: as stated, as mm or mrad."""
        made = super().__new__(cls, sigma)
        made.unit = unit
        return made


def parse_file_noise(text: str) -> tuple[str, float]:
    """FILE=SIGMA: a file by its stem, and how noisy its numbers are, in mm unless a unit is given.

    Raises OptionError.
    """
    name, _, size = text.rpartition("=")
    found = re.fullmatch(r"([-+.\d]+(?:[eE][-+]?\d+)?)\s*([A-Za-z/]*)", size.strip())
    if name.strip() and found:
        number, unit = found.groups()
        try:
            return name.strip(), StatedNoise(
                SI_PER_OPTION_UNIT.get(unit or "mm", 1.0) * float(number), unit or "mm"
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

    objective: str = fitted_option_field(
        SUM, "What is minimised: sum, or minimax (the worst wire, contact, target ... of any file)."
    )
    qp: QpSolver = Options.qp
    fix: Sequence[str] = ()
    free: Sequence[str] = ()
    noises: Mapping[str, float] = fitted_option_field(
        dict,
        "How noisy a file's numbers are, by its name without ending [default: as its residuals].",
        flag="--noise",
        metavar="FILE=SIGMA",
        read=parse_file_noise,
        many=dict,
    )
    priors: Mapping[str, float] = field(default_factory=dict)
    effects: Sequence[str | Term] = ()
    camera_on: str = CAMERA_OPTION_GROUP(
        "",
        "What the cameras are fixed to: flange or ground [default: what fits better].",
        metavar="flange|ground",
    )
    fix_camera: bool = CAMERA_OPTION_GROUP(
        False,
        "Hold the lenses as their files say, taken as known but where a prior of theirs is given.",
    )
    camera_prior: str = CAMERA_OPTION_GROUP(
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
                "qp": qp_solver_name(self.qp)}  # fmt: skip


def parse_file_noises(noises: Mapping[str, float | str]) -> dict[str, float]:
    """Noises in metres, from numbers or texts.  Raises OptionError."""
    pairs = (
        parse_file_noise(f"{k}={v}") if isinstance(v, str) else (k, v) for k, v in noises.items()
    )
    return dict(pairs)


RELATIVE_OPTION_READERS: Mapping[
    str, Callable[[Any], Any]
] = {  # what people give of an option, as its record has it
    "fix": split_names,
    "free": split_names,
    "known_distances": tuple,
    "noises": lambda given: parse_file_noises(given or {}),
    "priors": parse_priors,
    "effects": read_effect_list,
}


def link_prior_sigmas(names: ParameterNames, options: RelativeOptions) -> Array:
    """(5 n,) sigma of each link's prior, infinite where nothing is known.  Raises OptionError."""
    check_priors(options.priors)
    return prior_sigmas(names, options.priors, "targets and anchors")[names.link_mask]


# ---- checks --------------------------------------------------------------------------------------


def check_given_instruments(instruments: Sequence[Instrument], *, with_effects: bool) -> None:
    """Raise DataError where there is nothing, or nothing but what another command takes.

    with_effects: whether effects of the arm are fitted, or sought.
    """
    if not instruments:
        raise DataError("no file of measurements is given")
    first = instruments[0]
    taken = not first.alone or (with_effects and first.alone_bends)
    if not taken and all(data.kind == first.kind for data in instruments):
        raise DataError(f"{first.at.source}: {first.alone}")


def check_relative_options(every: Sequence[Instrument], options: RelativeOptions) -> None:
    """Raise OptionError for a choice that does not exist or does not suit the data."""
    if options.method not in (AUTO_METHOD_NAME, *LEAST_SQUARES_METHODS):
        raise OptionError(
            f"no method {options.method!r}; choose "
            f"{', '.join((AUTO_METHOD_NAME, *LEAST_SQUARES_METHODS))}"
        )
    check_resolution(options.resolution)
    if options.objective not in (SUM, WORST_TARGET):
        raise OptionError(f"no objective {options.objective!r}; choose {SUM} or {WORST_TARGET}")
    if options.objective == WORST_TARGET and options.effects:
        raise OptionError("effects= of other instruments are fitted by objective='sum': give one")
    check_loss_and_trim(options.loss)
    if options.loss != SQUARE_LOSS and options.objective == WORST_TARGET:
        raise OptionError(f"loss={options.loss} and objective=minimax weigh errors twice: give one")
    if options.loss != SQUARE_LOSS and any(one.kind == "pixels" for one in every):
        raise OptionError(f"loss={options.loss} is not for pixels yet: leave it or them out")
    default, kinds = RelativeOptions(), {data.kind for data in every}
    chosen = {
        one.name
        for one in fields(options)
        if getattr(options, one.name) != getattr(default, one.name)
    }
    # An instrument is imported only where its files are given, or an option might be its own.
    for found in (
        load_instrument_class(name) for name in INSTRUMENT_CLASSES if chosen or name in kinds
    ):
        mine = [data for data in every if data.kind == found.kind]
        for name in found.options:
            if not mine and name in chosen:
                raise OptionError(
                    f"{name}= is for {found.kind}; {describe_held_data(every)}: leave it out"
                )
        if mine:
            found.check_options(mine, options)


def describe_held_data(instruments: Sequence[Instrument]) -> str:
    """What each file holds."""
    return " and ".join(f"{data.at.source} holds {data.kind}" for data in instruments)


def check_file_noises(
    labels: Sequence[str], instruments: Sequence[Instrument], options: RelativeOptions
) -> None:
    """Raise OptionError for the noise of a file that is not there, or that is none."""
    known = dict(zip(labels, instruments, strict=True))
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
                f"{rows}: write FILE=SIGMA in {display_unit_of_change(rows)[1]}"
            )
        if not (np.isfinite(sigma) and sigma > 0.0):
            raise OptionError(f"noise {name}: sigma {sigma:g} must be positive")


def list_other_instrument_options(kind: type) -> list[str]:
    """Options of other instruments than trackers, which those of a tracker's verb lack."""
    own = {one.name for one in fields(kind)}
    return [one.name for one in fields(RelativeOptions) if one.name not in own]


def merge_instrument_options(
    instruments: Sequence[Instrument], options: Any, others: RelativeOptions
) -> RelativeOptions:
    """What is chosen of a verb for trackers, and of other instruments, which are given.

    Raises OptionError for what they do not know.  All have the objective sum: `relative` has more.
    """
    default, known = type(options)(), {one.name for one in fields(RelativeOptions)} - {"objective"}
    chosen = {one.name: getattr(options, one.name) for one in fields(options)}
    for name, value in chosen.items():
        is_sum = name == "objective" and value == "sum"
        if not (name in known or is_sum or value == getattr(default, name)):
            raise OptionError(
                f"{name}= is for points of a tracker; "
                f"{describe_held_data(instruments)}: leave it out"
            )
    return replace(others, **{name: value for name, value in chosen.items() if name in known})


def check_no_instrument_options(data: Measurements, others: RelativeOptions) -> None:
    """Raise OptionError for what is chosen of other instruments beside points of a tracker."""
    check_relative_options([TrackerPoints(data)], others)
    if others.noises:
        raise OptionError("noises= is for several instruments; of one say instrument=")
