"""Six commands take a calibration, a diagnosis or a relative calibration alike."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import run
from numpy.testing import assert_allclose

import minimax_cal as mc
from minimax_cal.diagnosing.diagnosis import load_diagnosis
from minimax_cal.fitting.multi_instrument.instrument_stack import InstrumentBlock
from minimax_cal.fitting.opened_results import open_result
from minimax_cal.instruments import flange_poses, write_relative
from minimax_cal.instruments.sockets import SocketVisits
from minimax_cal.instruments.wires import WireLengths
from minimax_cal.modelling.cell import Cell
from minimax_cal.modelling.point_model import PointModel
from minimax_cal.modelling.simulate import Truth, simulate

# ---- results as input ----------------------------------------------------------------------------


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


def test_rungs_are_those_of_the_ladder(here, found, capsys, refuses):
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
    refuses(
        "has no step 9; it has 0 (nominal), 1 (geometric)",
        "evaluate",
        here / "diagnosis.json",
        here / "gap.csv",
        "--rung",
        9,
    )


def test_a_relative_calibration_is_placed_by_the_data(here):
    data = mc.read_measurements(here / "gap.csv")
    known = open_result(here / "relative.json")
    cell, before, said = known.place_on_data(data)
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


# ---- outside command -----------------------------------------------------------------------------


FROZEN = ["J1", "J2", "J3"]


@pytest.fixture(scope="module")
def frozen_arm(robot: mc.Robot, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Poses of an arm whose first three joints never moved, poses all over, and both results."""
    folder = tmp_path_factory.mktemp("frozen")
    made = simulate(robot, 60, 3, seed=4)
    q, rng = made.data.q.copy(), np.random.default_rng(4)
    q[:, :3] = [0.3, 0.2, -0.1]
    y = made.cell.predict(q)
    data = mc.measurements(q, y + 2e-5 * rng.normal(size=y.shape))
    mc.write_measurements(folder / "poses.csv", data)
    mc.write_measurements(folder / "fresh.csv", made.data)
    fit = mc.calibrate(robot, folder / "poses.csv", "sum")
    fit.save(folder / "fit.json")
    fit.save(folder / "bare.json", poses=False)
    mc.diagnose(robot, folder / "poses.csv").save(folder / "diagnosis.json")
    return folder


@pytest.mark.parametrize(
    ("result", "outside", "inside"),
    [("fit.json", "outside", "inside"), ("diagnosis.json", "beyond", "within")],
)
def test_a_requirement_outside_is_not_judged(result, outside, inside, frozen_arm, tmp_path, says):
    page = tmp_path / "report.html"
    told = ("report", frozen_arm / result, "--tolerance", "rms 50", "-o", page, "-q")
    first, why, *_ = says(*told, "--tolerance-for", outside).out.splitlines()
    assert first == "not stated"
    assert "joint 1 spans 0 deg (18 needed), joint 2 spans 0 deg" in why
    assert "minimax-cal plan ROBOT --poses" in why
    assert "joint 3 spans 0 deg" in page.read_text()
    assert says(*told, "--tolerance-for", inside).out.startswith("passed")


def test_old_spellings_are_not_offered(says):
    told = says("report --help").out
    assert "inside or outside" in " ".join(told.split())
    assert "within or beyond" not in " ".join(told.split())


@pytest.mark.parametrize("result", ["fit.json", "bare.json", "diagnosis.json"])
def test_evaluate_says_which_poses_are_outside(result, frozen_arm, says):
    out, err = says("evaluate", frozen_arm / result, frozen_arm / "fresh.csv", "--json")
    assert json.loads(out)["outside_spans"] == {"poses": 60, "joints": FROZEN}
    assert json.loads(out)["accuracy"]["rms_mm"] > 0.5  # they are far worse indeed
    assert "60 of 60 poses are outside what the joints of the fit spanned (joint 1 spans" in err
    out, err = says("evaluate", frozen_arm / result, frozen_arm / "poses.csv", "--json")
    assert json.loads(out)["outside_spans"]["poses"] == 0
    assert "outside what" not in err


def test_a_map_predicts_nothing_outside(frozen_arm, says):
    out, err = says("map", frozen_arm / "fit.json", "--samples", 500, "--bins", 6, "--json")
    found = json.loads(out)
    summary = {row["what"].partition(" (")[0]: row for row in found["summary"]}
    away = summary["predicted, outside the spans of joints that hardly moved: none"]
    assert (away["count"], away["worst_mm"]) == (500, None)
    for section in found["sections"]:
        shares = [v for row in section["outside_spans"] for v in row if v is not None]
        assert max(shares) == 1.0
        radii = [v for row in section["radius95_worst_mm"] for v in row]
        known = [s for row in section["outside_spans"] for s in row]
        assert all(r is None for r, s in zip(radii, known, strict=True) if s in (None, 1.0))
        assert any(r is not None for r in radii)
    assert "nothing is predicted for" in err
    assert "joint 1 spans 0 deg" in err


# ---- exact data ----------------------------------------------------------------------------------


ROUNDING = 1e-8  # [m]
EXACT = Truth(length=0.0, angle=0.0, compliance=0.0, noise=0.0, noise_per_metre=0.0)


def rounded(errors: Callable[..., Any]) -> Callable[..., Any]:
    """Errors, or errors and what goes with them, that are 0 where they are rounding."""

    def zero(error: Any) -> Any:
        return np.where(np.abs(error) < ROUNDING, 0.0, error)

    def made(*given: Any, **named: Any) -> Any:
        found = errors(*given, **named)
        return (zero(found[0]), *found[1:]) if isinstance(found, tuple) else zero(found)

    return made


@pytest.fixture
def exact() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        for owner, name in [
            (Cell, "error"), (PointModel, "point_errors"), (PointModel, "block_errors_and_points"),
            (InstrumentBlock, "rows"), (WireLengths, "part_errors"), (SocketVisits, "part_errors"),
        ]:  # fmt: skip
            patch.setattr(owner, name, rounded(getattr(owner, name)))
        yield


@pytest.mark.usefixtures("exact")
@pytest.mark.parametrize("off", [(), (7,)], ids=["none", "one"])
def test_commands_take_exact_points(off, tmp_path, robot):
    """Of the poses none or one is off."""
    data, rng = simulate(robot, 40, 3, seed=3, truth=EXACT).data, np.random.default_rng(0)
    y = data.y.copy()
    y[list(off)] += 5e-5 * rng.normal(size=(len(off), 3, 3))
    poses, fit, gap, targets = (tmp_path / n for n in ("d.csv", "f.json", "g.json", "t.csv"))
    mc.write_measurements(poses, data.with_y(y))
    header = ",".join(f"q{joint}_rad" for joint in range(1, 7))
    np.savetxt(targets, data.q[:4], "%.17g", ",", header=header, comments="")
    commands = [
        *(("calibrate", "irb2600", poses, "--objective", o, "-o", fit) for o in ("sum", "point")),
        ("calibrate", "irb2600", poses, "--loss", "tukey", "--effects", "joint_compliance:J2"),
        ("calibrate", "irb2600", poses, "--bootstrap", "5", "-o", fit),
        ("diagnose", "irb2600", poses, "-o", gap),
        ("evaluate", fit, poses, "--json"),
        ("check", fit, poses, "--tolerance", "rms 0.5"),
        ("compare", fit, fit),
        ("map", fit, poses, "--samples", "200"),
        ("iso9283", fit),
        ("compensate", fit, targets, "--keep-anyway", "-o", tmp_path / "out.csv"),
        ("plan", "irb2600", "--poses", "3", "--fit", fit, "--candidates", "30"),
        ("report", fit, gap, "--date", "2026-01-01", "-o", tmp_path / "r.html"),
    ]
    for command in commands:
        assert run(*command) in (0, 1), command  # 1: no better than the drawn arm, which is exact


@pytest.mark.usefixtures("exact")
@pytest.mark.parametrize("kind", ["wires_3", "closures"])
def test_instruments_take_exact_rows(kind, tmp_path):
    from experiments import relative

    arm = relative.ImperfectArm.draw("irb2600", 3, 0.0)
    made = relative.MEASUREMENT_SIMULATORS[kind](arm, np.random.default_rng(3), 60, 0.0)
    write_relative(tmp_path / "d.csv", made.data)
    assert run("relative irb2600", tmp_path / "d.csv", "--diagnose") == 0


# ---- evaluate ------------------------------------------------------------------------------------


def test_one_file_of_measurements_is_judged(tmp_path, says):
    fit = tmp_path / "fit.json"
    fit.write_text('{"kind": "calibration"}')
    err = says("evaluate", fit, tmp_path / "a.csv", tmp_path / "b.csv", code=2).err
    assert "b.csv: evaluate takes one file of measurements; join them first" in err


def test_a_motion_diagnosis_says_when_it_is_none(tmp_path, refuses):
    motion = tmp_path / "motion.json"
    motion.write_text('{"kind": "motion_diagnosis", "schema": 1}')
    refuses(
        "motion.json: cannot be read (unit: is missing)", "evaluate", motion, tmp_path / "a.csv"
    )
