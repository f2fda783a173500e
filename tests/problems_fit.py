"""Fits that several tests start from."""

import re
from collections.abc import Sequence

import numpy as np
from numpy.testing import assert_allclose

from experiments.gap_cases import GapCase, GapCause, SealedArm, build_and_measure_arm
from minimax_cal.core.arrays import Array
from minimax_cal.diagnosing.study import LinearisedGeometry, linearise_geometry
from minimax_cal.fitting.cell_fit import fit_cell
from minimax_cal.fitting.options import Options, silent_progress
from minimax_cal.measuring.pose_groups import split_train_and_holdout
from minimax_cal.measuring.visit_history import add_history_columns
from minimax_cal.modelling.parameters import ParameterValues
from minimax_cal.modelling.point_model import PointLeastSquares, PointModel
from minimax_cal.robots.robot import Robot, load_robot, robot_from_dict
from minimax_cal.selection.gram_products import ProductsAtRatios
from minimax_cal.solvers import least_squares
from minimax_cal.solvers.least_squares import LEAST_SQUARES_METHODS

SPOTS = np.array([[0.1, 0.0, 0.05], [-0.05, 0.09, 0.05], [-0.05, -0.08, 0.06]])
MASSES = (100.0, 60.0, 45.0, 20.0, 8.0, 3.0)
CENTRES = ([-60, 90, 5], [-430, 12, -30], [-70, 0, 40], [8, 250, 3], [0, -10, 25], [0, 4, -40])
ROUNDING = 1e-9  # of products, relative to the largest of their columns


def weighty(turned: int, up: Sequence[float] = (0.0, 0.0, 1.0), **more: float) -> Robot:
    """An IRB 2600 with masses, of which one joint counts the other way."""
    content = load_robot("irb2600").to_dict() | {"up": list(up)}
    for joint, mass, com in zip(content["joints"], MASSES, CENTRES, strict=True):
        joint |= {"mass_kg": mass, "com_mm": com, **more}
    content["joints"][turned]["sign"] = -1
    return robot_from_dict(content)


def solve(model: PointModel, begin: ParameterValues, method: str = "snllm", **kw: object):  # type: ignore[no-untyped-def]
    points = float(model.pose_counts_by_target.sum())
    return least_squares.solve(
        PointLeastSquares(model), begin.batch(), 1, points, LEAST_SQUARES_METHODS[method], **kw
    )  # type: ignore[arg-type]


def study(jitter: float, noise: float, seed: int, poses: int = 100) -> LinearisedGeometry:
    """The training poses of an arm that errs in its geometry only."""
    return study_of(
        build_and_measure_arm(
            GapCase("irb2600", "none", jitter=jitter, noise=noise, seed=seed, poses=poses)
        )
    )


def rough_study() -> LinearisedGeometry:
    """100 poses with play in a joint, a gear's line, and joints that do not come back."""
    causes = (GapCause("backlash", "J2", 400.0), GapCause("gear_ripple", "J4", 400.0))
    return study_of(build_and_measure_arm(GapCase("irb2600", "pair", causes, seed=4)))


def study_of(made: SealedArm) -> LinearisedGeometry:
    """The training poses of a made arm."""
    train, _, _ = split_train_and_holdout(add_history_columns(made.data), 0.2, 0)
    return linearise_geometry(
        made.robot, train, fit_cell(made.robot, train, Options(objective="sum"), silent_progress)
    )


def check_products(
    found: ProductsAtRatios, i: int, index: Array, sets: Array, columns: Array, geometry: Array,
    weight: Array, raw: Array,
) -> None:  # fmt: skip
    """Products of a ratio are sums over rows of what weighted least squares leaves of columns.

    i: the ratio's number.  geometry: times the root of the weight (r,) of each row.
    """
    basis = np.linalg.qr(geometry.T)[0]
    every = columns * np.sqrt(weight)
    rest = every - (every @ basis) @ basis.T
    size = np.linalg.norm(columns, axis=1)
    gram, atol = rest @ rest.T, ROUNDING * np.outer(size, size)
    assert np.all(
        np.abs(found.products_with_candidates[i] - gram[1 + index, 1:]) <= atol[1 + index, 1:]
    )
    assert np.all(np.abs(found.error_products[i] - gram[0]) <= atol[0])
    assert np.all(np.abs(found.gradients[i] - gram[1 + index, 0]) <= atol[1 + index, 0])
    for c, pair in enumerate(1 + sets):
        off = np.abs(found.build_products_within_sets(sets)[i, c] - gram[np.ix_(pair, pair)])
        assert np.all(off <= atol[np.ix_(pair, pair)])
    assert_allclose(found.column_squares[i], weight @ raw**2, rtol=ROUNDING)
    assert_allclose(found.unprojected_error_square[i], every[0] @ every[0], rtol=ROUNDING)
    assert_allclose(
        found.geometry_log_determinants[i], np.linalg.slogdet(geometry @ geometry.T)[1], atol=1e-8
    )
    lower = found.geometry_factors[i]
    assert_allclose(lower @ lower.T, geometry @ geometry.T, rtol=ROUNDING, atol=1e-9)
    shared = geometry @ every[np.concatenate([[0], 1 + index])].T
    assert_allclose(
        lower @ found.geometry_coordinates[i], shared, rtol=ROUNDING, atol=ROUNDING * size.max()
    )


def numbers(text: str) -> list[float]:
    """Numbers in a sentence, whatever its words are."""
    return [float(number) for number in re.findall(r"\d+(?:\.\d+)?", text)]
