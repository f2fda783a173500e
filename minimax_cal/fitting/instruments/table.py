"""The instruments by name: each is a module, imported when it is first asked for."""

from __future__ import annotations

from importlib import import_module
from typing import Any

from minimax_cal.fitting.instruments.data import RelativeData
from minimax_cal.fitting.instruments.record import Instrument

INSTRUMENTS = {  # name: its module
    "distances": "wires",
    "closures": "sockets",
    "poses": "poses",
    "points": "points",
    "contacts": "probe",
    "pixels": "cameras",
}


def instrument(name: str) -> Instrument[Any]:
    """All that is asked of an instrument."""
    found: Instrument[Any] = import_module(f"{__package__}.{INSTRUMENTS[name]}").INSTRUMENT
    return found


def instrument_of(data: RelativeData) -> Instrument[Any]:
    """That of some data."""
    return instrument(data.kind)
