"""The instruments by name: each is a class, imported when it is first asked for."""

from __future__ import annotations

from importlib import import_module

from minimax_cal.instruments.instrument import Instrument

INSTRUMENTS: dict[str, str | type[Instrument]] = {  # name: where its class is, or the class
    "distances": "minimax_cal.instruments.wires:Lengths",
    "closures": "minimax_cal.instruments.sockets:Visits",
    "poses": "minimax_cal.instruments.poses:WholePoses",
    "points": "minimax_cal.instruments.tracker:Points",
    "contacts": "minimax_cal.instruments.contacts:Touches",
    "pixels": "minimax_cal.fitting.several.cameras:Images",
}


def instrument(name: str) -> type[Instrument]:
    """The class of an instrument."""
    found = INSTRUMENTS[name]
    if isinstance(found, str):
        module, _, kind = found.partition(":")
        found = getattr(import_module(module), kind)
    return found


def register_instrument(kind: type[Instrument]) -> type[Instrument]:
    """Make a class of instruments known, by its `kind`: a decorator.

    Parameters
    ----------
    kind
        The class.  Its files are then read by the columns that its `file` announces, and fitted
        beside any others.

    Returns
    -------
    type
        The same.

    Examples
    --------
    >>> mc.register_instrument(DrawWire)
    """
    INSTRUMENTS[kind.kind] = kind
    return kind
