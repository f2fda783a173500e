"""What hostile runs found, each in its smallest form."""

from __future__ import annotations

import json
import shlex
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import run
from numpy.testing import assert_allclose

import minimax_cal as mc
from minimax_cal.core.files import parse_json
from minimax_cal.instruments import read_relative
from minimax_cal.instruments.pixel_data import read_board_targets
from minimax_cal.measuring.measurement_checks import check_and_complete_joints
from minimax_cal.modelling.simulate import simulate
from minimax_cal.reporting.plots.error_figure import new_figure, write_figure
from minimax_cal.robots.joint_ranges import clip_range_near_zero
from qp_backends import Problem, child
from qp_backends.problem import COLD

from .material import material


def broken(folder: Path, name: str, change: Any) -> Path:
    """A result file of the material after a change of its JSON."""
    content = json.loads(material()[name])
    change(content)
    path = folder / name
    path.write_text(json.dumps(content))
    return path


def refused(capsys: pytest.CaptureFixture[str], *arguments: object) -> str:
    """The one line of a refusal."""
    capsys.readouterr()
    assert run(*arguments) == 2
    (line,) = [line for line in capsys.readouterr().err.splitlines() if line.startswith("error")]
    return line


@pytest.mark.parametrize(
    ("files", "arguments", "says"),
    [
        ("fit.json targets.csv", "compensate fit.json targets.csv --lever 1e9", "positive and fin"),
        ("fit.json targets.csv", "compensate fit.json targets.csv --lever 1e308", "at most 1e+12"),
        ("fit.json targets.csv", "compensate fit.json targets.csv --tolerance 1e308", "at most 1e"),
        ("", "plan irb120 --poses 9 --noise -1e300", "cannot be"),
        ("", "plan irb120 --motion --payload null", "payload"),
        ("data.csv fit.json", "check fit.json data.csv --tolerance 'rms 1' --seed -1", "seed -1"),
        ("data.csv", "plan irb120 --motion --waypoints a.csv -o a.csv", "two results"),
        ("data.csv", f"calibrate irb120 data.csv --bootstrap {10**20}", "give 2 to 100000"),
        ("links.json run1.csv", "torques links.json run1.csv --payload 1e308", "payload"),
        ("links.json run1.csv", "torques links.json run1.csv --ratio 1e308", "ratio"),
        (
            "arm.xml data.csv fit.json",
            "gap arm.xml data.csv --fit fit.json --holdout nan",
            "holdou",
        ),
        ("arm.xml data.csv fit.json", "gap arm.xml data.csv --fit fit.json --holdout 7", "holdout"),
        ("arm.xml data.csv fit.json", "gap arm.xml data.csv --fit fit.json --seed -1", "seed"),
    ],
)
def test_what_cannot_be_is_refused_and_leaves_nothing(
    files, arguments, says, tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    if "arm.xml" in files:
        pytest.importorskip("mujoco", reason="needs pip install minimax-cal[mujoco]")
    for name in files.split():
        Path(name).write_bytes(material()[name])
    assert says in refused(capsys, *shlex.split(arguments))
    assert {path.name for path in tmp_path.iterdir()} == {*files.split()}


def settings_of(name: str, value: Any) -> Any:
    return lambda content: content["provenance"]["settings"].update({name: value})


OPTIONS = (("objective", 1), ("distance_tolerance", [0.1]), ("seed", -1))
POSES = (("split", None), ("line", [None]), ("q", [[1.0], [1.0, 2.0]]), ("measured_mm", "x"))
ARRAYS = (("prior", [0.0] * 5, "prior is not of"), ("prior", [[1.0], [1.0, 2.0]], "something else"),
          ("singular", 3.0, "singular is not a row"), ("singular", [], "is not a row"))  # fmt: skip


@pytest.mark.parametrize(
    ("name", "change", "arguments", "says"),
    [
        ("diagnosis.json", lambda c: c["rungs"][-1]["robot"]["joints"].pop(2), "report",
         "its cells are not of one arm"),
        ("diagnosis.json", lambda c: [v.update(views=[]) for v in c["curves"].values()], "report",
         "has no values"),
        ("truth.json", lambda c: c.update(targets_mm=[7]), "evaluate", "is not a saved calibrat"),
        *(("fit.json", lambda c, k=k, v=v: c["poses"].update({k: v}), "iso9283",
           "its list of poses cannot be read") for k, v in POSES),
        *(("fit.json", lambda c, k=k, v=v: c["arrays"].update({k: v}), "iso9283", says)
          for k, v, says in ARRAYS),
        *((name, settings_of(k, v), "export", f"provenance.settings.{k}")
          for name in ("fit.json", "effects.json") for k, v in OPTIONS),
        *(("motion.json", change, "report", "motion.json") for change in (
            lambda c: c["curves"][0].update(sigma="x"),
            lambda c: c["curves"][0]["torque"].pop(),
            lambda c: c["held_run"]["measured"][0].pop(),
            lambda c: c["not_testable"].append({"effect": "x", "place": "J1", "needs": ""}),
            lambda c: c["budget"][0]["holdout_rms"].append(1.0),
            lambda c: c["effects"][0].update(parameters=[]),
        )),
    ],
)  # fmt: skip
def test_a_result_of_other_parts_is_told_in_our_words(
    name, change, arguments, says, tmp_path, capsys
):
    data = tmp_path / "data.csv"
    data.write_bytes(material()["data.csv"])
    more = {"report": ["-o", tmp_path / "page.html"], "export": ["--to", "ur-yaml"],
            "evaluate": [data]}.get(arguments, [])  # fmt: skip
    line = refused(capsys, arguments, broken(tmp_path, name, change), *more)
    assert says in line
    assert not any(word in line for word in ("NoneType", "shape", "inhomogeneous", "convert"))


@pytest.mark.parametrize("cell", ["1e308", "-1e300", "100001"])
def test_joints_that_cannot_be_are_refused(cell, tmp_path):
    """Rounding them overflowed."""
    for name, read in (("data.csv", mc.read_measurements), ("wires.csv", read_relative)):
        lines = material()[name].decode().splitlines()
        rest = lines[2].split(",")
        lines[2] = ",".join([rest[0], cell, *rest[2:]])
        path = tmp_path / name
        path.write_text("\n".join(lines))
        with pytest.raises(mc.DataError, match=r":3: column q2_rad: .* cannot be"):
            read(path)


@pytest.mark.slow
def test_positions_that_are_told_badly_are_told_in_numbers(tmp_path):
    """A variance that rounding made negative was a warning, and "good to nan mm"."""
    robot = mc.load_robot("irb120")
    mdh = robot.mdh.copy()
    mdh[3, 3] = np.pi  # two axes that are one: alpha4 of another arm
    path = tmp_path / "wires.csv"
    path.write_bytes(material()["wires.csv"])
    found = mc.relative(robot.with_mdh(mdh), read_relative(path))
    assert not any("nan" in notice for notice in found.notices)


def test_the_name_of_an_output_moves_no_cursor(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    odd = "\x1b]0;owned\x07"
    for name in ("data.csv", "truth.json"):
        Path(name).write_bytes(material()[name])
    for command in (
        ("import", "data.csv"),
        ("evaluate", "truth.json", "data.csv"),
        ("export", "truth.json", "--to", "json"),
        ("simulate", "irb120", "--poses", 9),
    ):
        assert run(*command, "-o", odd) == 0
    out, err = capsys.readouterr()
    assert err.count("written: ") == 4
    assert "\x1b" not in out + err


def test_targets_on_a_terminal_move_no_cursor():
    """In a pipe they are the file as it is; `compensate` without -o prints them."""
    from minimax_cal.cli.compensate import replace_control_characters_in_lines

    assert (
        replace_control_characters_in_lines("q1_rad,\x1b[31m\n1,2\n")
        == "q1_rad,\N{REPLACEMENT CHARACTER}[31m\n1,2\n"
    )


def test_a_picture_without_room_is_drawn_without_a_warning(tmp_path):
    figure = new_figure(0.5, 0.5)
    axes = figure.subplots()
    axes.set_ylabel("long" * 40)
    axes.set_xlabel("long" * 40)
    axes.set_title("t\n" * 40)
    write_figure(figure, tmp_path / "a.png")
    assert (tmp_path / "a.png").stat().st_size > 0


def test_numbers_that_no_result_has_are_refused(tmp_path, capsys):
    """The charts of a diagnosis drew them with warnings of overflow."""
    for value in (1e308, -1e160, 10**300):

        def huge(content: Any, value: Any = value) -> None:
            content["curves"]["order"]["views"][0]["values"][0] = value

        path = broken(tmp_path, "diagnosis.json", huge)
        assert "cannot be; at most 1e+100" in refused(capsys, "report", path)
    assert parse_json("[1e99, -3, 0, 2.5e-320, true]") == [1e99, -3, 0, 2.5e-320, True]
    assert [type(value) for value in parse_json("[1, 1.0, -0]")] == [int, float, int]
    for text in ("1e400", "-" + "9" * 5000):
        with pytest.raises(ValueError, match="at most"):
            parse_json(text)


def test_two_outputs_are_two_files(tmp_path, monkeypatch, capsys):
    """The second result replaced the first."""
    monkeypatch.chdir(tmp_path)
    Path("link").symlink_to("a.csv")
    for other in ("a.csv", "./a.csv", "link"):
        arguments = ("simulate", "irb120", "--poses", 9, "-o", "a.csv", "--truth", other)
        assert "is to hold two results" in refused(capsys, *arguments)
    assert not Path("a.csv").exists()
    same = ("-o", "/dev/null", "--truth", "/dev/null")
    assert run("simulate", "irb120", "--poses", 9, *same) == 0


def test_a_file_whose_link_is_named_is_an_input(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    Path("robot.urdf").write_bytes(material()["robot.urdf"])
    for named in ("robot.urdf", "robot.urdf#tool0"):
        arguments = ("export", named, "--to", "urdf", "-o", "robot.urdf")
        assert "is an input of this command" in refused(capsys, *arguments)
    assert Path("robot.urdf").read_bytes() == material()["robot.urdf"]


@pytest.mark.slow
def test_a_joint_zero_off_by_a_quarter_turn_is_found_by_whole_poses(tmp_path):
    """Several starts are compared there; two that end alike were a batch of two."""
    path = tmp_path / "data.csv"
    path.write_bytes(material()["data.csv"])
    robot = mc.load_robot("irb120")
    off = robot.with_mdh(robot.mdh + np.pi / 2 * np.eye(5)[2] * np.eye(6)[:, [2]])
    found, right = (mc.calibrate(r, path, "pose", holdout=0.0) for r in (off, robot))
    assert found.accuracy["train"].rms_mm == pytest.approx(right.accuracy["train"].rms_mm, rel=1e-3)


def test_a_diagnosis_of_another_arm_says_so(tmp_path, capsys):
    path = tmp_path / "data.csv"
    path.write_bytes(material()["data.csv"])
    run("diagnose", "irb2600", path, "--quick")
    assert "check" in capsys.readouterr().err


def test_a_fit_without_targets_is_told_in_our_words(tmp_path, capsys):
    """Its lever was the root of a mean of nothing."""
    targets = tmp_path / "targets.csv"
    targets.write_bytes(material()["targets.csv"])
    path = broken(tmp_path, "truth.json", lambda content: content.update(targets_mm={}))
    capsys.readouterr()
    assert run("compensate", path, targets, "--robot", "irb120", "--json") in (0, 1)
    out, _ = capsys.readouterr()
    assert all(np.isfinite(row["residual_mm"]) for row in json.loads(out)["targets"])


def test_fifty_notices_are_enough(capsys):
    from minimax_cal.cli.options import CommandOutput

    CommandOutput(None, False, None, False).print_notices(*map(str, range(20_000)))
    lines = capsys.readouterr().err.splitlines()
    assert lines[0] == "notice: 0"
    assert lines[50:] == ["notice: and 19950 more, in the JSON"]


def test_a_backends_process_imports_nothing_from_the_current_folder(tmp_path, monkeypatch):
    """A numpy.py that lies about would have run."""
    (tmp_path / "numpy.py").write_text("raise SystemExit('imported')")
    monkeypatch.chdir(tmp_path)
    problem = Problem(np.eye(2), -np.ones(2), np.zeros((0, 2)), np.zeros(0), np.zeros(0))
    found = child.run("qp_backends.via_qpsolvers", problem, "quadprog", 1e-8, 60.0, COLD)
    np.testing.assert_allclose(found.x, 1.0, rtol=0, atol=1e-9)


def test_measurements_without_a_joint_are_not_those_of_the_fit(tmp_path, capsys):
    """Their joints were looked for among the training poses."""
    fit, path = tmp_path / "fit.json", tmp_path / "data.csv"
    fit.write_bytes(material()["fit.json"])
    rows = [line.split(",") for line in material()["data.csv"].decode().splitlines()]
    path.write_text("\n".join(",".join(row[:5] + row[6:]) for row in rows))
    for command in ("iso9283", "map", "evaluate", "check"):
        more = ("--tolerance", "rms 0.5") if command == "check" else ()
        assert "has 5 joint columns" in refused(capsys, command, fit, path, *more)


def test_what_is_no_scheduler_is_told_in_our_words(tmp_path, capsys, monkeypatch):
    """Dask took the first bytes of another server for the size of an array."""
    distributed = pytest.importorskip("distributed")
    for name in ("robot.json", "data.csv"):
        (tmp_path / name).write_bytes(material()[name])

    def other(*given: object, **more: object) -> None:
        raise MemoryError("Unable to allocate 3.07 EiB for an array and data type uint8")

    monkeypatch.setattr(distributed, "rpc", other)
    said = refused(capsys, "diagnose", tmp_path / "robot.json", tmp_path / "data.csv", "--cluster",
                   "tcp://127.0.0.1:9")  # fmt: skip
    assert "what answers there is something else" in said
    assert "uint8" not in said


def test_a_joint_that_never_comes_to_zero_is_no_trouble():
    """Limits of 3.5 to 7 rad, or of 1 to 3 m, left nothing to draw from."""
    for lower, upper in ((3.5, 7.0), (-20.0, -15.0), (4.0, np.inf), (-np.inf, -4.0), (-1.0, 9.0)):
        low, high = clip_range_near_zero(np.array([lower]), np.array([upper]))
        assert lower <= low[0] < high[0] <= upper
        assert high[0] - low[0] <= 2.0 * np.pi + 1e-12
    for lower, upper in ((-5.0, 1.0), (-1.0, 5.0), (-7.0, 7.0), (-np.inf, np.inf)):  # as ever
        ends = clip_range_near_zero(np.array([lower]), np.array([upper]))
        assert ends == (max(lower, -np.pi), min(upper, np.pi))
    low, high = clip_range_near_zero(np.array([1.0]), np.array([3.0]), np.array([0.5]))
    assert_allclose([low[0], high[0]], [1.0, 2.0])


def test_a_simulator_keeps_no_log_beside_the_results(tmp_path, monkeypatch):
    """MuJoCo wrote its warnings to a file in the folder where it was called."""
    pytest.importorskip("mujoco", reason="needs pip install minimax-cal[mujoco]")
    from minimax_cal.robots.mjcf_import import import_mujoco

    monkeypatch.chdir(tmp_path)
    found = import_mujoco()
    model = '<mujoco><worldbody><body><freejoint/><geom size="1"/></body></worldbody></mujoco>'
    data = found.MjData(found.MjModel.from_xml_string(model))
    data.qvel[:] = np.nan
    found.mj_step(data.model, data)
    assert data.warning[found.mjtWarning.mjWARN_BADQVEL].number
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("code", ["utf-16", "utf-8"])
def test_xml_in_another_encoding_than_it_says_is_refused(code, tmp_path):
    """One of the two parsers that read a model did not mind."""
    pytest.importorskip("mujoco", reason="needs pip install minimax-cal[mujoco]")
    from minimax_cal.robots.xml_document import read_xml_with_includes

    path = tmp_path / "arm.xml"
    other = "utf-8" if code == "utf-16" else "utf-16"
    path.write_bytes(f'<?xml version="1.0" encoding="{other}"?><mujoco/>'.encode(code))
    with pytest.raises(mc.CalibrationError, match=r"arm\.xml"):
        read_xml_with_includes(path)


def test_import_writes_nothing_that_cannot_be_read(tmp_path, capsys):
    """What was left of a target could not be used, which was seen after writing."""
    header, *rows = material()["data.csv"].decode().splitlines()
    out, data = tmp_path / "out.csv", tmp_path / "data.csv"
    data.write_text("\n".join([header, *rows[:4]]))
    lines = ",".join(f"{n}:smr2" for n in range(2, 6))
    line = refused(capsys, "import", data, "--leave-out", lines, "-o", out)
    assert "smr2 is measured at no pose" in line
    assert not out.exists()


def test_a_part_of_held_out_poses_alone_judges_a_diagnosis(tmp_path):
    """Of the 12 training poses it left out none, and products of no rows were a traceback."""
    path = tmp_path / "data.csv"
    path.write_bytes(material()["data.csv"])
    found = mc.diagnose("irb120", path, holdout=0.5)
    assert found.beyond.folds
    assert np.isfinite(found.beyond.typical_mm)


@pytest.mark.filterwarnings("error")
def test_a_joint_limit_beyond_all_numbers_is_no_warning():
    """Twice 1e308 overflowed."""
    robot = mc.load_robot("irb120")
    upper = np.where(np.arange(6) == 0, 1e308, robot.upper)
    check_and_complete_joints(replace(robot, upper=upper), simulate(robot, poses=9).data)


def test_a_board_larger_than_a_hall_is_refused(tmp_path):
    path = tmp_path / "board.csv"
    path.write_text("target,x_mm,y_mm,z_mm\na,0,0,0\nb,1e300,0,0\nc,0,40,0\n")
    with pytest.raises(mc.DataError, match=r"board\.csv:3: target 'b' is more than 100 m"):
        read_board_targets(path)
