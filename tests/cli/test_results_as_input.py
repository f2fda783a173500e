"""Six commands take a calibration, a diagnosis or a relative calibration alike."""

import json
from pathlib import Path

import numpy as np
import pytest
from conftest import run
from numpy.testing import assert_allclose

import minimax_cal as mc
from minimax_cal.diagnosing.result import load_diagnosis
from minimax_cal.fitting.opened import open_result
from minimax_cal.instruments import flange_poses, write_relative
from minimax_cal.modelling.simulate import Truth, simulate

MM = 1e-6  # of numbers that went through a file in mm


@pytest.fixture(scope="module")
def found(here: Path) -> mc.Diagnosis:
    """The diagnosis that stands in the file."""
    return load_diagnosis(here / "diagnosis.json")


@pytest.fixture(scope="module")
def here(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An arm that gives way: poses, its diagnosis, two calibrations, whole poses of its flange."""
    folder = tmp_path_factory.mktemp("results")
    made = simulate(mc.load_robot("ur10"), 60, 3, seed=1, truth=Truth(compliance=2e-6))
    mc.write_measurements(folder / "gap.csv", made.data)
    data, q = folder / "gap.csv", made.data.q
    mc.diagnose("ur10", data).save(folder / "diagnosis.json")
    mc.calibrate("ur10", data).save(folder / "fit.json")
    write_relative(folder / "flange.csv", flange_poses(q, made.cell.robot.pose(q)))
    mc.relative("ur10", folder / "flange.csv").save(folder / "relative.json")
    mc.write_measurements(folder / "targets.csv", made.data.take(np.arange(3)))
    return folder


RESULTS = ("fit.json", "diagnosis.json", "relative.json")


@pytest.mark.parametrize("result", RESULTS)
def test_every_command_takes_every_result(result, here, tmp_path, capsys):
    source, data = here / result, here / "gap.csv"
    for command in (
        ("evaluate", source, data, "--json"),
        ("export", source, "--to", "dh-csv"),
        ("export", source, "--to", "dh-csv", "-o", tmp_path / "arm.csv"),
        ("compensate", source, here / "targets.csv", "--max-change", 20, "--json"),
        ("iso9283", source, data, "--json"),
        ("map", source, data, "--bins", 10, "--json"),
        ("report", source, "-o", tmp_path / "report.html"),
    ):
        assert run(*command) == 0, capsys.readouterr().err
        assert capsys.readouterr().out or "-o" in command
    assert (tmp_path / "arm.csv").read_text().count("\n") > 6
    assert (tmp_path / "report.html").read_text().count("<table") > 3


def test_rungs_are_those_of_the_ladder(here, found, capsys):
    held = found.data.take(found.held)
    assert len(found.ladder) == len(found.rungs()) >= 3
    for number, step in enumerate(found.ladder):
        rms = mc.evaluate(found, held, rung=number).rms_mm
        assert_allclose(rms, step.holdout.rms_mm, rtol=MM)
        assert run("evaluate", here / "diagnosis.json", here / "gap.csv", "--rung", number,
                   "--json") == 0  # fmt: skip
        whole = json.loads(capsys.readouterr().out)["accuracy"]["rms_mm"]
        cell = (found.nominal, *found.cells)[number]
        assert_allclose(whole, mc.evaluate(cell, found.data).rms_mm, rtol=1e-4)
    again = mc.Diagnosis.from_dict(found.to_dict())
    assert len(again.cells) == len(found.cells)
    assert again.nominal is not None
    assert run("evaluate", here / "diagnosis.json", here / "gap.csv", "--rung", 9) == 2
    assert "has no step 9; it has 0 (nominal), 1 (geometric)" in capsys.readouterr().err


def test_a_relative_calibration_is_placed_by_the_data(here):
    data = mc.read_measurements(here / "gap.csv")
    known = open_result(here / "relative.json")
    cell, before, said = known.placed_by(data)
    assert before is not None
    assert "knows no base and no targets" in said[0]
    assert mc.evaluate(cell, data).rms_mm < mc.evaluate(before, data).rms_mm
    moved = data.with_y(data.y + np.array([1.0, 2.0, 3.0]))  # the instrument stands elsewhere
    assert_allclose(
        mc.evaluate(here / "relative.json", moved).rms_mm, mc.evaluate(cell, data).rms_mm, rtol=1e-6
    )


def test_a_diagnosis_tells_a_fit_its_effects(here, found):
    path, data = here / "diagnosis.json", here / "gap.csv"
    told = (path, str(path), found)
    fits = [mc.calibrate("ur10", data, "sum", effects=source) for source in told]
    labels = {tuple(term.label for term in fit.cell.effects.terms) for fit in fits}
    assert labels == {("joint_compliance:all",)}
    assert fits[0].accuracy["holdout"].rms_mm < 0.2 * found.ladder[1].holdout.rms_mm
    content = json.loads(path.read_text())
    content["effects"][0]["established"] = False
    doubtful = here / "doubtful.json"
    doubtful.write_text(json.dumps(content))
    assert not mc.calibrate("ur10", data, "sum", effects=doubtful).cell.effects.terms
    with pytest.raises(mc.OptionError, match="is no diagnosis"):
        mc.calibrate("ur10", data, effects=here / "fit.json")
