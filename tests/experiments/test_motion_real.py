"""The study of torques on runs that no fit saw, on its simulated arm."""

import numpy as np
import pytest

from experiments.motion_real import (
    ACROSS,
    LOAD_FRICTION,
    SIMULATED,
    Left,
    Told,
    names_table,
    run,
    simulated,
    steps_table,
)


@pytest.fixture(scope="module")
def told() -> Told:
    return run(Left(SIMULATED, 0, 0))


def test_withheld_effects_are_named_and_help_on_a_run_that_no_fit_saw(told):
    assert {"load_friction J2", "armature J3"} <= set(told.confirmed)
    before = told.reached[told.steps.index("usual friction refitted")]
    assert np.all(told.reached[-1, 1:] < 0.5 * before[1:])
    assert np.all(told.reached[-1] <= told.whole[-1])  # rows at rest only add


def test_boosting_takes_little_where_all_has_a_name(told):
    moving, whole = told.boosted
    assert np.all(moving > 0.85 * told.reached[-1])
    assert np.all(whole > 0.85 * told.whole[-1])


def test_tables_count_runs_and_compare_with_the_claim(told):
    table = steps_table(SIMULATED, [told, told])
    last = dict(zip((row[0] for row in table.rows), table.rows, strict=True))
    assert last["all effects"][1:] == pytest.approx(told.reached[-1])
    assert last["claimed over reached"][1:] == pytest.approx(told.claimed[-1] / told.reached[-1])
    assert all(row[1:] == (2, 2) for row in names_table(SIMULATED, [told, told]).rows)


def test_the_simulated_arm_repeats_by_its_seed():
    robot, runs = simulated(3)
    again = simulated(3)[1]
    assert np.array_equal(runs[0].torque, again[0].torque)
    assert not np.array_equal(runs[0].torque, simulated(4)[1][0].torque)
    assert robot.inertia[0, 0] == pytest.approx(8.0 * ACROSS**2 / 6.0)
    assert 0.0 < LOAD_FRICTION < 1.0
