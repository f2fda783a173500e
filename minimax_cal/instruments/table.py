"""The instruments by name: each is a class, imported when it is first asked for."""

from __future__ import annotations

from importlib import import_module

from minimax_cal.ground.errors import OptionError
from minimax_cal.ground.options import SI
from minimax_cal.instruments.instrument import Instrument

INSTRUMENTS: dict[str, str | type[Instrument]] = {  # name: where its class is, or the class
    "distances": "minimax_cal.instruments.wires:Lengths",
    "closures": "minimax_cal.instruments.sockets:Visits",
    "poses": "minimax_cal.instruments.poses:WholePoses",
    "points": "minimax_cal.instruments.tracker:Points",
    "contacts": "minimax_cal.instruments.probe:Touches",
    "pixels": "minimax_cal.fitting.pixels.beside:FittedImages",
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

    Its `unit` says what its rows are in: m unless given.

    Parameters
    ----------
    kind
        The class.  Its files are then read by the columns that its `file` announces, and fitted
        beside any others.

    Returns
    -------
    type
        The same.

    Raises
    ------
    OptionError
        Where it has no kind of its own, or a unit that is not SI.

    Examples
    --------
    >>> mc.register_instrument(DrawWire)
    """
    name = getattr(kind, "kind", "")
    if not name or isinstance(INSTRUMENTS.get(name), str):
        what = f"{name!r} is built in" if name else "it has none"
        raise OptionError(f"{kind.__name__}: give it a kind of its own: {what}")
    if SI.get(kind.unit, 1.0) != 1.0 or not kind.unit:
        raise OptionError(
            f"{kind.__name__}: unit {kind.unit!r}: give its rows in SI: m, rad, px or another unit"
        )
    INSTRUMENTS[name] = kind
    return kind


def is_registered(one: Instrument) -> bool:
    """Whether an instrument is none of the built-in ones."""
    return not isinstance(INSTRUMENTS.get(one.kind), str)
