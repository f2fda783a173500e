"""Many diagnoses at once: one process a core, or the workers of a Dask cluster."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from minimax_cal.core.errors import CalibrationError
from minimax_cal.diagnosing.diagnose import diagnose
from minimax_cal.diagnosing.diagnosis import Diagnosis
from minimax_cal.fitting.calibrate import SingleCampaignData, run_for_many_arms
from minimax_cal.robots.robot import Robot


def diagnose_many(
    robots: Robot | str | Path | Sequence[Robot | str | Path],
    data: Sequence[SingleCampaignData],
    *,
    jobs: int = -1,
    cluster: str = "",
    **options: Any,
) -> tuple[Diagnosis | CalibrationError, ...]:
    """Diagnose many sets of measurements.

    Parameters
    ----------
    robots
        One for all, or one for each set.
    data
        As `diagnose` takes each.
    jobs
        Processes, -1 for one a core, 1 for this one alone.
    cluster
        Address of a Dask scheduler, as tcp://host:port, whose workers then do it.
    options
        Of `diagnose`, for all.

    Returns
    -------
    tuple[Diagnosis | CalibrationError, ...]
        A diagnosis for each set in its order, or the error that says why there is none.

    Raises
    ------
    OptionError
        For wrong input.

    Examples
    --------
    >>> found = mc.diagnose_many("irb120", ["cell1.csv", "cell2.csv"], holdout=0.2)
    """
    return run_for_many_arms(diagnose, robots, data, jobs, cluster, options)
