"""What an instrument promises, where the measurements do not say."""

from __future__ import annotations

import re
from dataclasses import dataclass, replace

import numpy as np

from minimax_cal.ground.errors import OptionError
from minimax_cal.measuring.measurements import Measurements

LENGTHS = {"um": 1e-6, "µm": 1e-6, "mm": 1e-3, "m": 1.0}
PATTERN = re.compile(
    r"(?P<base>[\d.]+)\s*(?P<unit>um|µm|mm)"
    r"(\s*\+\s*(?P<more>[\d.]+)\s*(?P<of>um|µm|mm)\s*/\s*m)?"
)


@dataclass(frozen=True)
class Instrument:
    """u95 of a coordinate: a part that is always there [m], and its growth with range [m per m]."""

    base: float
    per_metre: float = 0.0


def instrument_of(text: str) -> Instrument:
    """As ``10um+2.5um/m`` or ``0.05mm``.  Raises OptionError."""
    found = PATTERN.fullmatch(text.strip())
    try:
        base = float(found["base"]) * LENGTHS[found["unit"]] if found else 0.0
        more = float(found["more"]) * LENGTHS[found["of"]] if found and found["more"] else 0.0
    except ValueError:
        base, more = 0.0, 0.0
    if not 0.0 < base < 1.0 or more > 1e-2:
        raise OptionError(f"instrument={text!r}: write u95 as 10um+2.5um/m, or as 0.05mm")
    return Instrument(base, more)


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
