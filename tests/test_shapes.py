"""Arrays of points are (poses, targets, 3) wherever one room hands them to another.

Every point is off by its own vector, so that not the shape alone tells which axis is which: with as
many poses as targets, and with one target, an exchange would pass in silence.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import minimax_cal as mc
from minimax_cal.core.arrays import Array
from minimax_cal.diagnosing.budget_steps import JudgingPoses
from minimax_cal.diagnosing.residual_curves import ResidualViews
from minimax_cal.fitting.accuracy import summarise_point_errors
from minimax_cal.fitting.arm_comparison import mask_points
from minimax_cal.fitting.noise_floor import squared_deviations_from_pose_mean
from minimax_cal.fitting.opened_results import open_result, place_in_new_frame
from minimax_cal.fitting.outliers import Outlier, mask_outliers, nearest_revisits
from minimax_cal.fitting.pose_records import build_pose_records, compute_or_restore_errors
from minimax_cal.instruments.instrument import Instrument
from minimax_cal.instruments.instrument_options import InstrumentOptions
from minimax_cal.instruments.protocol import FlangeKinematics
from minimax_cal.instruments.tracker_points import TrackerPoints
from minimax_cal.measuring.faults import find_data_faults
from minimax_cal.measuring.faults.point_faults import find_points_missed_by_fit
from minimax_cal.measuring.measurement_checks import list_outlier_notices
from minimax_cal.modelling.point_model import build_point_model
from minimax_cal.modelling.simulate import Simulation, Truth, simulate

ROBOT = mc.load_robot("irb2600")
EXACT = Truth(length=0.0, angle=0.0, compliance=0.0, noise=0.0, noise_per_metre=0.0)
SIZES = [(7, 3), (3, 3), (7, 1), (2, 3)]


def spoilt(poses: int, targets: int) -> tuple[Simulation, Array]:
    """Exact measurements and by how much (m, k, 3) each point is then off [m]."""
    made = simulate(ROBOT, poses, targets, seed=3, truth=EXACT)
    by = 1e-3 * np.random.default_rng(5).normal(size=(poses, targets, 3))
    return replace(made, data=made.data.with_y(made.data.y + by)), by


def by_tracker(made: Simulation, errors: Callable[..., Array]) -> Array:
    """Errors of an instrument where the cell has base and targets, in axes of the instrument."""
    cell, flange = (
        made.cell,
        FlangeKinematics.from_robot(ROBOT, made.data.q).compute_flange_poses(ROBOT.mdh),
    )
    tracker = replace(
        TrackerPoints(made.data).ready(ROBOT, InstrumentOptions()), drawn=cell.parameter_values
    )
    (own,) = tracker.starts(flange, np.zeros(0))
    found = errors(tracker, flange, own, np.zeros(made.data.poses, dtype=bool))
    return np.asarray(found @ cell.base[:3, :3].T)


def model_error(made: Simulation) -> Array:
    """Of the model, turned from base axes into those of the instrument."""
    state = made.cell.parameter_values
    return np.asarray(build_point_model(ROBOT, made.data).point_errors(state) @ state.rotation.T)


ERRORS: Mapping[str, Callable[[Simulation], Array]] = {
    "Cell.error": lambda made: made.cell.error(made.data),
    "Cell.predict": lambda made: made.data.y - made.cell.predict(made.data.q),
    "Cell.follow": lambda made: made.data.y - made.cell.follow(made.data),
    "Model.error": model_error,
    "Points.errors": lambda made: by_tracker(made, TrackerPoints.part_errors),
    "pose_rows.errors_of": lambda made: compute_or_restore_errors(
        made.cell, made.data, made.data.y - made.cell.predict(made.data.q)
    ),
    "Judges.errors": lambda made: JudgingPoses(
        made.data, made.data, np.zeros(made.data.seen.shape, dtype=bool)
    ).heldout_errors(made.cell),
    "Leftover.errors": lambda made: (
        ResidualViews.from_cells(
            made.data, np.zeros(made.data.poses, dtype=bool), 1e-5, (made.cell, made.cell), ()
        ).errors[0]
        @ made.cell.base[:3, :3].T
    ),
    "written and read": lambda made: (
        1e-3
        * np.array(
            build_pose_records(
                made.data,
                np.zeros(made.data.poses, dtype=bool),
                {"final": made.cell.error(made.data)},
            )["errors_mm"]["final"]
        )
    ),
}


@pytest.mark.parametrize("name", ERRORS)
@pytest.mark.parametrize(("poses", "targets"), SIZES)
def test_errors_are_of_poses_and_targets(name: str, poses: int, targets: int) -> None:
    made, by = spoilt(poses, targets)
    found = ERRORS[name](made)
    assert found.shape == (poses, targets, 3)
    assert_allclose(found, by, rtol=0, atol=1e-12)


@pytest.mark.parametrize(("poses", "targets"), SIZES)
def test_derivatives_and_rows_of_any_instrument_are_too(poses: int, targets: int) -> None:
    made, _ = spoilt(poses, targets)
    model, state = build_point_model(ROBOT, made.data), made.cell.parameter_values
    jacobian = model.point_jacobian(state)
    assert jacobian.shape == (poses, targets, 3, model.names.parameter_count)
    for column in (1, 14, 30):  # by central differences
        step = 1e-6 * np.eye(model.names.parameter_count)[column]
        up, down = (model.point_errors(state.step(sign * step)) for sign in (1.0, -1.0))
        assert_allclose((down - up) / 2e-6, jacobian[..., column], rtol=0, atol=1e-8)
    assert by_tracker(made, Instrument.part_errors).shape == (poses, targets, 3)
    assert made.data.seen.shape == (poses, targets)


@pytest.mark.parametrize(("poses", "targets"), SIZES)
def test_who_takes_errors_tells_poses_from_targets(poses: int, targets: int) -> None:
    made, by = spoilt(poses, targets)
    data, pose, target = made.data, poses - 1, targets - 1
    by[pose, target] *= 1e3
    size = np.linalg.norm(by, axis=-1)
    found = summarise_point_errors(by)
    assert (found.poses, found.counts) == (poses, (poses,) * targets)
    assert found.worst == (pose, target)
    assert_allclose(found.rms_by_target(), 1e3 * np.sqrt((size**2).mean(axis=0)), rtol=1e-12)
    one = Outlier(int(data.line[pose]), data.target_names[target], 1.0, 9.0, 0.0, False)
    gone = np.isnan(mask_outliers(by, data, [one])).all(axis=-1)
    assert np.argwhere(gone).tolist() == [[pose, target]]
    assert all(np.array_equal(np.isnan(e).all(axis=-1), gone) for e in mask_points(by, by, gone))
    same = np.zeros(poses, dtype=int)
    assert nearest_revisits(by, same)[0].shape == (poses, targets)
    assert len(squared_deviations_from_pose_mean(by, same)[0]) == poses * targets
    if poses * targets > 20:  # enough that one of them can stand out
        (said,) = list_outlier_notices(data, size)
        assert f"{data.called(int(data.line[pose]))} {data.target_names[target]} " in said


@pytest.mark.parametrize("targets", [1, 3, 20])
def test_a_point_that_a_fit_misses_is_named_by_row_and_target(targets: int) -> None:
    made, by = spoilt(20, targets)
    data, error = made.data, by.copy()
    error[17, targets - 1] += 1.0
    assert find_points_missed_by_fit(error) == [(17, targets - 1)]
    (fault,) = [one for one in find_data_faults(data, error) if one.effect == "outliers"]
    assert set(fault.rows.tolist()) == {17}
    assert targets - 1 in fault.targets


@pytest.mark.parametrize("targets", [1, 3, 20])
def test_errors_of_a_fit_and_its_file_are_measured_minus_predicted(
    targets: int, tmp_path: Path
) -> None:
    data = simulate(ROBOT, 20, targets, seed=2).data
    fit = mc.calibrate(ROBOT, data, "sum", cv=True)
    assert_allclose(fit.error, data.y - fit.predict(data.q), rtol=0, atol=1e-12)
    assert_allclose(fit.error_nominal, data.y - fit.nominal.predict(data.q), rtol=0, atol=1e-12)
    for key, error in fit.errors.items():
        held = fit.held if key in ("nominal", "holdout") else ~fit.held
        whole = fit.error_nominal if key.startswith("nominal") else fit.error
        assert_array_equal(error, whole[held])
    # the poses held out are judged by the fit itself, the others by fits without them
    assert_allclose(fit.error_crossed[fit.held], fit.error[fit.held], rtol=0, atol=1e-12)
    assert fit.error_crossed.shape == fit.error_drawn_crossed.shape == (20, targets, 3)
    fit.save(tmp_path / "fit.json")
    again = mc.load_fit(tmp_path / "fit.json")
    for name in ("error", "error_nominal", "error_crossed", "error_drawn_crossed"):
        assert_allclose(getattr(again, name), getattr(fit, name), rtol=0, atol=1e-9)
    assert [r.error.shape for r in open_result(again).rungs if r.error is not None] == [
        (20, targets, 3)
    ] * 2
    judged = mc.evaluate(fit, data)
    size = np.linalg.norm(fit.error, axis=-1)
    assert judged.worst == np.unravel_index(int(size.argmax()), size.shape)
    turned = place_in_new_frame(fit.cell, data)
    assert turned.error(data).shape == (20, targets, 3)
