"""The command evaluate: measurements of a calibration, or logs of a motion diagnosis."""

from __future__ import annotations

from conftest import run


def test_one_file_of_measurements_is_judged(tmp_path, capsys):
    fit = tmp_path / "fit.json"
    fit.write_text('{"kind": "calibration"}')
    assert run("evaluate", fit, tmp_path / "a.csv", tmp_path / "b.csv") == 2
    err = capsys.readouterr().err
    assert "b.csv: evaluate takes one file of measurements; join them first" in err


def test_a_motion_diagnosis_says_when_it_is_none(tmp_path, capsys):
    motion = tmp_path / "motion.json"
    motion.write_text('{"kind": "motion_diagnosis", "schema": 1}')
    assert run("evaluate", motion, tmp_path / "a.csv") == 2
    assert "motion.json: cannot be read (unit: is missing)" in capsys.readouterr().err
