"""All that the program asks of an instrument, in one record; its module fills it in."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Generic

from minimax_cal.fitting.instruments.data import D
from minimax_cal.fitting.instruments.options import RelativeOptions
from minimax_cal.fitting.instruments.rows import Block
from minimax_cal.ground.arrays import Array
from minimax_cal.measuring.grouping import held_out
from minimax_cal.reading.rows import Rows
from minimax_cal.robots.robot import Robot

if TYPE_CHECKING:
    from minimax_cal.fitting.instruments.fit import InstrumentFit

FRAMELESS = "moves nothing that is measured"


@dataclass(frozen=True)
class Columns(Generic[D]):
    """How a file of an instrument is known, and read.

    announce: a column that says that the file is of the instrument.  own: every column that `read`
    understands.  written: how these are named, for messages.  yields: whether columns of another
    instrument come first.
    """

    announce: re.Pattern[str]
    own: re.Pattern[str]
    written: str
    read: Callable[[Rows], D]
    yields: bool = False


@dataclass(frozen=True)
class Words:
    """What a result says of what an instrument measured.

    quantity: what the errors are of.  part: what each row of them is.  caution: what they do not
    say.  counted: its numbers.  check: what to check where they contradict the arm.  more: what
    helps where they tell positions weakly, empty where they are positions.  of_position: whether
    the errors are.
    """

    quantity: str
    part: str = "part"
    caution: str = ""
    counted: str = "numbers"
    check: str = "the order of the rows"
    more: str = ""
    of_position: bool = False


def by_poses(data: D, options: RelativeOptions) -> tuple[Array, tuple[str, ...]]:
    """(m,) True where a row is held out, as `grouping.held_out` chooses; notices."""
    return held_out(data.at, options.holdout, options.seed)


def any_options(every: Sequence[D], options: RelativeOptions) -> None:
    """No choice is wrong."""


def no_slips(robot: Robot, data: D, options: RelativeOptions) -> None:
    """None is looked for."""


def no_remarks(
    robot: Robot, fit: InstrumentFit, i: int, options: RelativeOptions
) -> tuple[str, ...]:
    """None."""
    return ()


def all_fitted(
    robot: Robot, fit: InstrumentFit, i: int, options: RelativeOptions
) -> tuple[str, str]:
    """Nothing is left out."""
    return "", ""


def nothing_beyond(robot: Robot, fit: InstrumentFit, options: RelativeOptions) -> tuple[str, ...]:
    """None."""
    return ()


@dataclass(frozen=True)
class Instrument(Generic[D]):
    """An instrument of `relative`: a measurement model, its files, and what is said of it.

    block: residuals, Jacobian, noise and own parameters at some data.  columns: of its file, None
    where it has none of its own.  check_slips: raises for what shows where the arm as drawn is
    fitted.  options: the fields of `RelativeOptions` that are its own; check_options: raises for
    wrong ones, of all its files.  held_back: which rows are held out.
    alone: what to do instead where nothing else is given, empty where it needs nothing else.
    on_arm: whether a point on the flange is among its own parameters.  noise_given: whether the
    user may say it.  unmoved: why a link tells nothing that moves nothing.  scale: what it lacks
    where it has no length standard, and what gives it.
    remarks: what the reader should know, of the i-th instrument of a fit; unfitted: what that fit
    leaves out and the residuals show, and its mend; beyond: parameters that one reflector would
    not tell.
    """

    name: str
    words: Words
    block: Callable[[Robot, D, RelativeOptions], Block]
    columns: Columns[D] | None = None
    check_slips: Callable[[Robot, D, RelativeOptions], None] = no_slips
    options: tuple[str, ...] = ()
    check_options: Callable[[Sequence[D], RelativeOptions], None] = any_options
    held_back: Callable[[D, RelativeOptions], tuple[Array, tuple[str, ...]]] = by_poses
    alone: str = ""
    on_arm: bool = True
    noise_given: bool = True
    unmoved: str = FRAMELESS
    scale: tuple[str, ...] = ()
    remarks: Callable[[Robot, InstrumentFit, int, RelativeOptions], tuple[str, ...]] = no_remarks
    unfitted: Callable[[Robot, InstrumentFit, int, RelativeOptions], tuple[str, str]] = all_fitted
    beyond: Callable[[Robot, InstrumentFit, RelativeOptions], tuple[str, ...]] = nothing_beyond
