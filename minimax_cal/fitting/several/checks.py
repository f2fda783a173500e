"""Whether what is given and what is chosen go together."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields, replace
from typing import Any

import numpy as np

from minimax_cal.fitting.options import check_resolution
from minimax_cal.fitting.several.options import RelativeOptions
from minimax_cal.ground.errors import DataError, OptionError
from minimax_cal.instruments.instrument import Instrument
from minimax_cal.instruments.table import INSTRUMENTS, instrument
from minimax_cal.instruments.tracker import Points
from minimax_cal.measuring.measurements import Measurements
from minimax_cal.solvers.least_squares import AUTO, METHODS


def check_given(every: Sequence[Instrument]) -> None:
    """Raise DataError where there is nothing, or nothing but what another command takes."""
    if not every:
        raise DataError("no file of measurements is given")
    first = every[0]
    if first.alone and all(data.kind == first.kind for data in every):
        raise DataError(f"{first.at.source}: {first.alone}")


def check_options(every: Sequence[Instrument], options: RelativeOptions) -> None:
    """Raise OptionError for a choice that does not exist or does not suit the data."""
    if options.method not in (AUTO, *METHODS):
        raise OptionError(f"no method {options.method!r}; choose {', '.join((AUTO, *METHODS))}")
    check_resolution(options.resolution)
    default = RelativeOptions()
    for found in map(instrument, INSTRUMENTS):
        mine = [data for data in every if data.kind == found.kind]
        for name in found.options:
            if not mine and getattr(options, name) != getattr(default, name):
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

    Raises OptionError for what they do not know.  All have the objective sum.
    """
    default, known = type(options)(), {one.name for one in fields(RelativeOptions)}
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
