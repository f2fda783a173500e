import json
from dataclasses import replace

import numpy as np
import pytest
from conftest import run
from numpy.testing import assert_allclose

import minimax_cal as mc
from minimax_cal.ground.files import plain
from minimax_cal.measuring.measurements import Measurements
from minimax_cal.modelling.simulate import simulate


def mirrored(data: Measurements) -> Measurements:
    """One coordinate of one target with the wrong sign."""
    y = data.y.copy()
    y[:, 1, 0] *= -1.0
    return data.with_y(y)


def stuck(robot: mc.Robot, data: Measurements) -> tuple[Measurements, np.ndarray]:
    """A joint that was not read anew for some of the held-out rows, and those rows."""
    rows = np.flatnonzero(mc.calibrate(robot, data, "sum").held)[:5]
    q = data.q.copy()
    q[rows, 2] = q[rows[0], 2]
    return replace(data, q=q), rows[1:]


def test_a_fit_that_contradicts_its_data_has_failed_and_writes_no_robot(robot, tmp_path, capsys):
    data, out = tmp_path / "d.csv", tmp_path / "fit.json"
    mc.write_measurements(data, mirrored(simulate(robot, 110, 2, seed=5).data))
    assert run("calibrate", "irb2600", data, "--objective", "sum", "--json", "-o", out) == 1
    fit = mc.Fit.from_dict(json.loads(capsys.readouterr().out))
    assert not out.exists()
    assert fit.status == "failed"
    assert "no calibration of this arm" in fit.notices[-1]
    with pytest.raises(mc.OptionError, match="contradicts its own data"):
        mc.export(fit, "json")


def test_bad_rows_that_are_held_out_are_told(robot, noisy):
    data, wrong = stuck(robot, noisy.data)
    fit = mc.calibrate(robot, data, "sum")
    assert fit.status == "converged"
    assert {one.line for one in fit.suspects if one.held} >= set(data.line[wrong].tolist())
    assert any("outliers among the held-out points" in text for text in fit.notices)
    assert fit.accuracy["holdout"].rms_mm > 20.0
    clean = mc.calibrate(robot, noisy.data, "sum")
    # the same arm judged by the rows that are left
    assert_allclose(fit.trusted.rms_mm, clean.accuracy["holdout"].rms_mm, rtol=0.15)
    assert fit.beyond.worst_mm > 20.0  # they judge outside the measured region as well
    assert fit.beyond.trusted is not None
    assert_allclose(fit.beyond.trusted.worst_mm, clean.beyond.worst_mm, rtol=0.3)
    assert "without outliers worst part" in fit.headline()


def test_sound_held_out_rows_are_no_suspects(robot):
    named = [
        one
        for seed in range(6)
        for one in mc.calibrate(robot, simulate(robot, 80, seed=seed).data, "sum").suspects
        if one.held
    ]
    assert not named  # errors of the model are larger at new poses, and no fault of the rows


def test_suspects_of_a_file_come_back(robot, noisy, tmp_path):
    data, _ = stuck(robot, noisy.data)
    fit = mc.calibrate(robot, data, "sum")
    fit.save(tmp_path / "fit.json")
    again = mc.load_fit(tmp_path / "fit.json")
    keys = [[(s.line, s.target, s.held) for s in one.suspects] for one in (fit, again)]
    assert keys[0] == keys[1]
    assert plain(again.beyond) == plain(fit.beyond)
    assert again.trusted.rms_mm == pytest.approx(fit.trusted.rms_mm, rel=1e-9)


def test_a_wrong_point_of_the_fit_is_set_aside_where_its_part_judges(robot):
    """As beyond as measured without it: the loss gives it no weight, its part would tell it."""
    data = mc.simulate(robot, 100, 3, seed=4).data
    clean = mc.calibrate(robot, data, "sum", loss="tukey")
    y = data.y.copy()
    y[np.flatnonzero(~clean.held)[3], 1] += [5e-3, 0.0, 0.0]
    fit = mc.calibrate(robot, data.with_y(y), "sum", loss="tukey")
    assert [one.held for one in fit.suspects] == [False]
    assert fit.beyond.trusted is not None
    assert fit.beyond.worst_mm > 1.5 * clean.beyond.worst_mm
    assert fit.beyond.trusted.worst_mm == pytest.approx(clean.beyond.worst_mm, rel=0.02)
