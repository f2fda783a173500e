"""What can be chosen of instruments."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

from minimax_cal.core.errors import OptionError
from minimax_cal.core.option_fields import option_field_in_group

KnownDistance = tuple[str, str, float]
MAX_GIVEN_DEVIATION_SIGMAS = 4.0  # sigmas that what is given, or known before, may be off


def parse_known_distance(text: str) -> KnownDistance:
    """A,B,MM: two sockets and the distance of their centres.  Raises OptionError."""
    parts = [part.strip() for part in text.split(",")]
    number = parts[-1].removesuffix("mm").strip()
    if len(parts) == 3 and parts[0] and parts[1] and re.fullmatch(r"[-+.\deE]+", number):
        try:
            return parts[0], parts[1], 1e-3 * float(number)
        except ValueError:
            pass
    raise OptionError(f"known_distances={text!r}: write two sockets and a length, as A,B,500.02")


def format_known_distance(known: KnownDistance) -> str:
    """A known distance as it was asked for."""
    first, second, distance = known
    return f"known_distances={f'{first},{second},{1e3 * distance:g}'!r}"


fitted_option_field = option_field_in_group("What is fitted")


@dataclass(frozen=True)
class InstrumentOptions:
    """What instruments ask of whoever calibrates.

    holdout: share kept out of the fit.  seed: of that choice.  offset: of lengths, fit a constant
    one of each wire.  known_distances: of closures, sockets A, B and the distance of their centres
    [m].  lever: of poses, what a radian counts as [m]; the file's own unless given.
    """

    holdout: float = 0.2
    seed: int = 0
    offset: bool = fitted_option_field(
        False, "Lengths: fit a constant offset of each wire (weakly determined)."
    )
    known_distances: Sequence[KnownDistance] = fitted_option_field(
        (),
        "Closures: the distance between two sockets' centres; gives the scale.",
        flag="--known-distance",
        metavar="A,B,MM",
        read=parse_known_distance,
        many=tuple,
    )
    lever: float | None = fitted_option_field(
        None,
        "Poses: what a radian counts as, linear over angular noise [default: of the columns "
        "u95_mm and rotation_u95_rad, else 100].",
        "mm",
    )
