"""What the customer wants to read of a cell: serial number, tool, instrument ... from a TOML."""

from __future__ import annotations

from collections.abc import Mapping
from difflib import get_close_matches
from pathlib import Path
from typing import NamedTuple

import numpy as np

from minimax_cal.core.display_text import replace_invisible_and_bidi_characters
from minimax_cal.core.errors import OptionError
from minimax_cal.core.files import read_toml
from minimax_cal.measuring.measurements import Measurements

FACT_LABELS = {  # key of the TOML: as the page calls it
    "serial_number": "Serial number",
    "controller": "Controller",
    "tool": "Tool",
    "payload": "Payload",
    "temperature": "Temperature",
    "instrument": "Instrument",
    "certificate": "Certificate of the instrument",
    "place": "Place",
    "validity": "Valid until",
}
REPORT_TEXT_KEYS = ("title", "customer", "author", "date")  # these may stand there too
MEASURED_FACT_COLUMNS = {"payload": ("payload", "kg"), "temperature": ("temperature", "°C")}


class LabelledFact(NamedTuple):
    """A fact of the title block.  text: empty where people fill it in by hand."""

    label: str
    text: str


def read_facts_file(path: Path | str) -> dict[str, str]:
    """The facts of a TOML file by their keys.  Raises OptionError."""
    content = read_toml(path)
    known = (*FACT_LABELS, *REPORT_TEXT_KEYS)
    for key, value in content.items():
        if key not in known:
            near = get_close_matches(key, known, 1)
            hint = f"; {near[0]} is meant?" if near else f"; choose {', '.join(known)}"
            raise OptionError(
                f"{path}: the key {replace_invisible_and_bidi_characters(key)!r} is not known{hint}"
            )
        if isinstance(value, dict | list):
            raise OptionError(f"{path}: {key} must be a text or a number")
    return {
        key: replace_invisible_and_bidi_characters(str(value)) for key, value in content.items()
    }


def list_labelled_facts(
    facts: Mapping[str, str], measurements: Measurements | None
) -> tuple[LabelledFact, ...]:
    """Label and text of every fact; measured ones from their columns; empty to be filled in."""
    measured = (
        {
            key: format_column_range(measurements, *column)
            for key, column in MEASURED_FACT_COLUMNS.items()
        }
        if measurements
        else {}
    )
    return tuple(
        LabelledFact(label, facts.get(key) or measured.get(key, ""))
        for key, label in FACT_LABELS.items()
    )


def format_column_range(measurements: Measurements, column_name: str, unit: str) -> str:
    """The range of a column, empty where nobody measured it."""
    column = np.asarray(measurements.columns.get(column_name, np.zeros(0)), dtype=float)
    known = column[np.isfinite(column)]
    if not known.size:
        return ""
    low, high = f"{known.min():.3g}", f"{known.max():.3g}"
    return f"{low} {unit}" if low == high else f"{low} to {high} {unit}"
