"""The instruments by name: each is a class, imported when it is first asked for."""

from __future__ import annotations

from importlib import import_module

from minimax_cal.core.errors import OptionError
from minimax_cal.core.option_fields import SI_PER_OPTION_UNIT
from minimax_cal.instruments.instrument import Instrument

INSTRUMENT_CLASSES: dict[str, str | type[Instrument]] = {  # name: where its class is, or the class
    "distances": "minimax_cal.instruments.wires:WireLengths",
    "closures": "minimax_cal.instruments.sockets:SocketVisits",
    "poses": "minimax_cal.instruments.whole_poses:WholePoses",
    "points": "minimax_cal.instruments.tracker_points:TrackerPoints",
    "contacts": "minimax_cal.instruments.probe_contacts:SurfaceContacts",
    "pixels": "minimax_cal.fitting.pixels.image_instrument:FittedImages",
}


def load_instrument_class(kind_name: str) -> type[Instrument]:
    """The class of an instrument."""
    found = INSTRUMENT_CLASSES[kind_name]
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
    if not name or isinstance(INSTRUMENT_CLASSES.get(name), str):
        what = f"{name!r} is built in" if name else "it has none"
        raise OptionError(f"{kind.__name__}: give it a kind of its own: {what}")
    if SI_PER_OPTION_UNIT.get(kind.unit, 1.0) != 1.0 or not kind.unit:
        raise OptionError(
            f"{kind.__name__}: unit {kind.unit!r}: give its rows in SI: m, rad, px or another unit"
        )
    INSTRUMENT_CLASSES[name] = kind
    return kind


def is_user_registered(instrument: Instrument) -> bool:
    """Whether an instrument is none of the built-in ones."""
    return not isinstance(INSTRUMENT_CLASSES.get(instrument.kind), str)
