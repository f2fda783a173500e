"""What an instrument promises, where the measurements do not say."""

from __future__ import annotations

import re
from dataclasses import dataclass, replace

import numpy as np

from minimax_cal.ground.errors import OptionError
from minimax_cal.measuring.measurements import Measurements
from minimax_cal.reading.sheet import number_of
from minimax_cal.reading.words import LENGTHS

PATTERN = re.compile(r"([\d.]+)\s*(um|mm)(?:\s*\+\s*([\d.]+)\s*(um|mm)\s*/\s*m)?")


@dataclass(frozen=True)
class Instrument:
    """u95 of a coordinate: a part that is always there [m], and its growth with range [m per m]."""

    base: float
    per_metre: float = 0.0


def instrument_of(text: str) -> Instrument:
    """As ``10um+2.5um/m`` or ``0.05mm``.  Raises OptionError."""
    found = PATTERN.fullmatch(text.strip().replace("µ", "u"))
    base, unit, more, of = found.groups("") if found else ("", "mm", "", "")
    told = Instrument(number_of(base) * LENGTHS[unit], number_of(more or "0") * LENGTHS[of or "mm"])
    if not (0.0 < told.base < 1.0 and told.per_metre <= 1e-2):
        raise OptionError(f"instrument={text!r}: write u95 as 10um+2.5um/m, or as 0.05mm")
    return told


def with_instrument(data: Measurements, text: str | None) -> Measurements:
    """The data with a `u95` column by an instrument's promise; one that is there is kept.

    Raises OptionError.
    """
    if text is None:
        return data
    told = instrument_of(text)
    if "u95" in data.columns:
        said = f"{data.source}: column u95_mm is used, not instrument={text!r}"
        return replace(data, notices=(*data.notices, said))
    reach = np.linalg.norm(data.y, axis=-1)
    far = np.where(np.isfinite(reach), reach, 0.0).sum(axis=1) / np.maximum(data.seen.sum(1), 1)
    return replace(data, columns={**data.columns, "u95": told.base + told.per_metre * far})
