"""Slips of the user: each a clear line, none explained away by a fit."""

from dataclasses import replace

import numpy as np
import pytest
from conftest import shared

import minimax_cal as mc
from minimax_cal.modelling.simulate import simulate


def refused(robot: mc.Robot, data: mc.Measurements) -> str:
    with pytest.raises(mc.DataError) as caught:
        mc.calibrate(robot, data)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def test_degrees_in_a_radian_column(robot, noisy):
    message = refused(robot, replace(noisy.data, q=np.degrees(noisy.data.q)))
    assert "q1_deg" in message


def test_small_degrees_in_a_radian_column(robot):
    """Angles below two turns of radians even in degrees: found because nothing else fits."""
    made = simulate(robot, 60, 3, seed=1)
    q = np.random.default_rng(0).uniform(-0.2, 0.2, (60, 6))
    data = mc.measurements(np.degrees(q), made.cell.predict(q))
    assert "look like degrees" in refused(robot, data)


def test_radians_in_a_degree_column(robot, noisy):
    assert "look like radians" in refused(robot, replace(noisy.data, q=np.radians(noisy.data.q)))


@pytest.mark.parametrize(("factor", "say"), [(1e3, "smr1_x_mm"), (1e-3, "smr1_x_m")])
def test_wrong_length_unit(factor, say, robot, noisy):
    assert say in refused(robot, noisy.data.with_y(noisy.data.y * factor))


def test_mirrored_frame(robot, noisy):
    assert "left-handed" in refused(robot, noisy.data.with_y(noisy.data.y * [1, -1, 1]))


def test_reversed_joint(robot, noisy):
    q = noisy.data.q * [1, 1, -1, 1, 1, 1]
    assert "sign of joint 3 looks reversed" in refused(robot, replace(noisy.data, q=q))


def test_coupled_joints(robot, noisy):
    q = noisy.data.q.copy()
    q[:, 2] -= q[:, 1]
    assert "look coupled" in refused(robot, replace(noisy.data, q=q))


@pytest.mark.parametrize("order", [(1, 0, 2), (1, 2, 0)])
def test_targets_swapped_in_some_rows(order, robot, noisy):
    """Every swapped row is named, held out or not."""
    y = noisy.data.y.copy()
    rows = [3, 17, 40]
    y[rows] = y[rows][:, order]
    message = refused(robot, noisy.data.with_y(y))
    assert "targets look swapped in 3 rows" in message
    lines = ", ".join(str(noisy.data.line[row]) for row in rows)
    assert f"lines {lines}" in message


@pytest.mark.parametrize("share", [0.05, 0.2, 0.33])
def test_a_third_of_the_rows_swapped_on_a_real_equilateral_triangle(share):
    robot, path = shared("irb120")
    data = mc.read_measurements(path)
    rng = np.random.default_rng(int(100 * share))
    rows = np.sort(rng.permutation(data.poses)[: int(share * data.poses)])
    y = data.y.copy()
    y[rows] = y[rows][:, [1, 0, 2]]
    message = refused(mc.load_robot(robot), data.with_y(y))
    assert f"targets look swapped in {len(rows)} rows" in message


def test_a_target_seen_too_rarely_is_left_out(robot, noisy):
    for count in (1, 2):
        y = noisy.data.y.copy()
        y[count:, 2] = np.nan
        fit = mc.calibrate(robot, noisy.data.with_y(y))
        assert fit.cell.target_names == ("smr1", "smr2")
        assert any("left out: smr3" in note for note in fit.notices)
        assert fit.json()


def test_one_target_in_another_unit(robot, noisy):
    message = refused(robot, noisy.data.with_y(noisy.data.y * np.array([1, 1e3, 1])[:, None]))
    assert "smr2" in message
    assert "wrong unit" in message


def test_targets_that_are_one_are_refused(robot, noisy):
    """A column that was copied: also where some of its points are missing."""
    y = noisy.data.y.copy()
    y[:, 2], y[4, 2], y[9, 0] = y[:, 0], np.nan, np.nan
    message = refused(robot, noisy.data.with_y(y))
    assert "smr1 and smr3 have the same points" in message
    y[11, 2] += 1e-6
    mc.calibrate(robot, noisy.data.with_y(y))  # one point tells them apart


@pytest.mark.parametrize("factor", [1e-12, 1e-2])
def test_points_of_no_arm_are_refused(factor, robot, noisy):
    message = refused(robot, noisy.data.with_y(noisy.data.y * factor))
    assert "but the flange of" in message


def test_an_outlier_is_named_wherever_it_is(robot, noisy):
    y = noisy.data.y.copy()
    y[30, 1] += [0.0, 0.05, 0.0]
    for seed in range(3):
        fit = mc.calibrate(robot, noisy.data.with_y(y), seed=seed)
        assert any(
            "outliers" in note and f"line {noisy.data.line[30]} smr2" in note
            for note in fit.notices
        )
    assert not any("outliers" in note for note in mc.calibrate(robot, noisy.data).notices)


def test_another_robot_is_doubted(noisy):
    fit = mc.calibrate("irb120", noisy.data)
    text = " ".join(fit.notices)
    assert "nominal robot misses" in text
    assert "implausibly large changes" in text


def test_one_pose_repeated(robot, noisy):
    data = noisy.data.take(np.zeros(30, dtype=int))
    assert "all 30 rows have the same joint values" in refused(robot, data)


def test_one_label_for_all_poses(robot, noisy):
    data = replace(noisy.data, columns={"pose": np.full(noisy.data.poses, "p")})
    first = noisy.data.line[0]
    assert f"pose 'p' is also that of line {first}, where joint" in refused(robot, data)


def test_two_poses(robot, noisy):
    message = refused(robot, noisy.data.take(np.array([0, 1])))
    assert "2 different poses" in message
    assert "at least" in message


def test_wrong_number_of_joints(robot, noisy):
    five = replace(noisy.data, q=noisy.data.q[:, :5], sliding=noisy.data.sliding[:5])
    assert "5 joint columns" in refused(robot, five)


def test_slide_given_as_an_angle():
    robot = mc.load_robot("scara_600")
    data = simulate(robot, 40, 3, seed=1).data
    message = refused(robot, replace(data, sliding=np.zeros(4, dtype=bool)))
    assert "q3_mm" in message


def test_honest_data_pass_the_gates(robot):
    """Large geometric errors and noise are not mistaken for slips."""
    from minimax_cal.modelling.simulate import Truth

    for seed, objective in enumerate(("minimax", "sum", "sum", "sum", "sum")):
        truth = Truth(length=5e-3, angle=10e-3, compliance=2e-6, noise=2e-4)
        data = simulate(robot, 60, 3, seed, truth).data
        assert mc.calibrate(robot, data, objective).status == "converged"


def test_joints_outside_their_limits_are_a_notice(robot, noisy):
    narrow = replace(robot, upper=np.where(np.arange(6) == 1, 0.5, robot.upper))
    fit = mc.calibrate(narrow, noisy.data)
    assert any("joint 2 is outside the limits" in note for note in fit.notices)


def test_an_arm_without_lengths(robot, noisy):
    flat = robot.with_mdh(robot.mdh * [0, 0, 1, 1, 1])
    assert "has no lengths: every a and d of its joints is 0" in refused(flat, noisy.data)
    short = robot.with_mdh(robot.mdh * [1e-6, 1e-6, 1, 1, 1])
    assert any("implausibly large" in notice for notice in mc.calibrate(short, noisy.data).notices)
