"""Many calibrations at once: one process a core, or the workers of a Dask cluster."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from numpy.typing import ArrayLike

from minimax_cal.fitting.calibrate import calibrate
from minimax_cal.fitting.fit import Fit
from minimax_cal.ground.errors import CalibrationError
from minimax_cal.ground.parallel import share
from minimax_cal.measuring.measurements import Measurements
from minimax_cal.robots.robot import Robot, load_robot

Data = Measurements | str | Path | tuple[ArrayLike, ArrayLike]


def calibrate_many(
    robots: Robot | str | Path | Sequence[Robot | str | Path],
    data: Sequence[Data],
    *,
    jobs: int = -1,
    cluster: str = "",
    **options: Any,
) -> tuple[Fit | CalibrationError, ...]:
    """Calibrate from many sets of measurements.

    Parameters
    ----------
    robots
        One for all, or one for each set.
    data
        As `calibrate` takes each.
    jobs
        Processes, -1 for one a core, 1 for this one alone.
    cluster
        Address of a Dask scheduler, as tcp://host:port, whose workers then do it.
    options
        Of `calibrate`, for all.

    Returns
    -------
    tuple[Fit | CalibrationError, ...]
        A fit for each set in its order, or the error that says why there is none.

    Raises
    ------
    OptionError
        For wrong input.

    Examples
    --------
    >>> fits = mc.calibrate_many("irb120", ["monday.csv", "friday.csv"], objective="sum")
    """
    return do_many(calibrate, robots, data, jobs, cluster, options)


def do_many(
    verb: Callable[..., Any],
    robots: Robot | str | Path | Sequence[Robot | str | Path],
    data: Sequence[Data],
    jobs: int,
    cluster: str,
    options: dict[str, Any],
) -> tuple[Any, ...]:
    """What a verb makes of each robot and its data, or the error that says why it makes nothing."""
    arms = [robots] * len(data) if isinstance(robots, Robot | str | Path) else list(robots)
    if len(arms) != len(data):
        raise CalibrationError(f"{len(arms)} robots for {len(data)} data sets; give one for each")
    known: dict[str, Robot] = {}
    for arm in arms:
        if not isinstance(arm, Robot) and str(arm) not in known:
            known[str(arm)] = load_robot(arm)
    loaded = [arm if isinstance(arm, Robot) else known[str(arm)] for arm in arms]
    calls = [(verb, arm, sheet, options) for arm, sheet in zip(loaded, data, strict=True)]
    found = dict(share(one, calls, [verb.__module__], processes=jobs, cluster=cluster))
    return tuple(found[number] for number in range(len(calls)))


def one(verb: Callable[..., Any], robot: Robot, data: Data, options: dict[str, Any]) -> Any:
    """What a verb makes of one, or the error that says why it makes nothing."""
    try:
        return verb(robot, data, **options)
    except CalibrationError as error:
        return error
