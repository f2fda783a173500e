"""Fits that several tests start from."""

from experiments.gap_cases import Case, Sealed, make
from minimax_cal.diagnosing.study import Study, studied
from minimax_cal.fitting.options import Options, silent
from minimax_cal.fitting.solve import fit_cell
from minimax_cal.measuring.grouping import split
from minimax_cal.measuring.history import with_history
from minimax_cal.modelling.model import Model, SumOfSquares
from minimax_cal.modelling.parameters import State
from minimax_cal.solvers import least_squares
from minimax_cal.solvers.least_squares import METHODS


def solve(model: Model, begin: State, method: str = "snllm", **kw: object):  # type: ignore[no-untyped-def]
    points = float(model.counts.sum())
    return least_squares.solve(SumOfSquares(model), begin.batch(), 1, points, METHODS[method], **kw)  # type: ignore[arg-type]


def study(jitter: float, noise: float, seed: int, poses: int = 100) -> Study:
    """The training poses of an arm that errs in its geometry only."""
    return study_of(
        make(Case("irb2600", "none", jitter=jitter, noise=noise, seed=seed, poses=poses))
    )


def study_of(made: Sealed) -> Study:
    """The training poses of a made arm."""
    train, _, _ = split(with_history(made.data), 0.2, 0)
    return studied(made.robot, train, fit_cell(made.robot, train, Options(objective="sum"), silent))
