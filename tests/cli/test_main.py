from __future__ import annotations

import json
import re
import shlex
import socket
import subprocess
import sys
from csv import reader
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from conftest import run
from dynamics.motions import fourier
from numpy.testing import assert_allclose

import minimax_cal as mc
from minimax_cal.cli import progress
from minimax_cal.cli.progress import ProgressTicker, StageClock, show_stage_progress
from minimax_cal.core.progress_stages import ProgressStage, build_counted_stage, format_duration
from minimax_cal.modelling.simulate import Simulation, Truth, simulate
from minimax_cal.robots.robot import robot_from_dict

# ---- main ----------------------------------------------------------------------------------------


@pytest.fixture
def csv(tmp_path: Path, noisy: Simulation) -> Path:
    path = tmp_path / "poses.csv"
    mc.write_measurements(path, noisy.data)
    return path


def test_summary_on_stdout(csv, says):
    out, err = says("calibrate irb2600", csv, "--details")
    for words in (
        "held out, calibrated",
        "same motion as base_z",
        "33 of 45 parameters",
        "F_i mm^2",
    ):
        assert words in out
    assert "\x1b" not in out + err  # no colour codes into a pipe


def test_the_first_screen_is_short_and_narrow(csv, says):
    out = says("calibrate irb2600", csv, "-o", csv.with_name("fit.json")).out
    lines = [line.rstrip() for line in out.splitlines()]
    assert max(len(line) for line in lines if not line.startswith("  minimax-cal")) <= 80
    assert len(lines) < 40
    rule = next(i for i, line in enumerate(lines) if "─" in line)
    rows = lines[rule + 1 :][: lines[rule + 1 :].index("")]
    assert len(rows) <= 6
    assert rows[0].startswith("  new poses, nominal")
    said = " ".join(out.split())
    fit = mc.load_fit(csv.with_name("fit.json"))
    assert said.startswith(fit.headline())
    assert f"{fit.within.after.rms_mm:.3f} mm" in said
    assert (
        "Outside the measured region, 18 parts left out in turn and predicted from the rest: RMS "
        f"{fit.beyond.typical_mm:.3f} mm" in said
    )
    assert f"minimax-cal diagnose irb2600 {csv}" in " ".join(lines)
    assert "--details" in out


def test_output_file_figure_and_evaluate(csv, tmp_path, answered, says):
    fit, picture = tmp_path / "fit.json", tmp_path / "errors.svg"
    assert run("calibrate irb2600", csv, "-o", fit, "--figure", picture, "-q") == 0
    assert "<svg" in picture.read_text()
    assert json.loads(fit.read_text())["schema"] == 1
    found, own = answered("evaluate", fit, csv), json.loads(fit.read_text())["accuracy"]
    whole = found["accuracy"]
    assert whole["poses"] == 60
    assert found["training_poses"] == own["train"]["poses"]
    said = says("evaluate", fit, csv)
    assert f"{whole['rms_mm']:.4f}" in said.out
    assert not re.search(r"smr\d .*  -", said.out)  # mean and largest of each target too
    assert f"{own['train']['poses']} of 60 poses are training poses of the fit" in said.err
    assert f"the others: RMS {own['holdout']['rms_mm']:.4f} mm" in said.err
    new = tmp_path / "new.csv"
    mc.write_measurements(new, mc.simulate("irb2600", 20, seed=9).data)
    said = says("evaluate", fit, new, "--json")
    assert json.loads(said.out)["training_poses"] == 0
    assert "training poses" not in said.err


def test_every_option_reaches_the_fit(csv, answered):
    options = (
        "--fix a2,beta* --free d1 --prior d4=0.5mm --prior theta3=1mrad --holdout 0.3 --seed 7 "
        "--method nllm --hessian bfgs --qp clarabel --distance squared --distance-tolerance 0.05"
    )
    content = answered("calibrate irb2600", csv, *options.split())
    assert content["schema"] == 1
    assert content["status"] == "converged"
    assert content["accuracy"]["holdout"]["rms_mm"] < content["accuracy"]["nominal"]["rms_mm"]
    assert robot_from_dict(content["robot"]).joints == 6
    settings = content["provenance"]["settings"]
    assert settings["priors"] == {"d4": 0.0005, "theta3": 0.001}
    assert settings["distance_tolerance"] == pytest.approx(5e-5)
    assert settings["seed"] == 7
    assert content["accuracy"]["holdout"]["poses"] == 18
    assert {step["backend"] for step in content["minimax"]["trace"]} == {"clarabel"}
    found = {p["name"]: p for p in content["parameters"]}
    assert not found["a2"]["identifiable"]
    assert found["d1"]["identifiable"]


def test_the_same_seed_gives_the_same_numbers(csv, answered):
    one, other = (answered("calibrate irb2600", csv) | {"seconds": 0} for _ in range(2))
    assert one == other


@pytest.mark.parametrize(
    ("arguments", "say"),
    [
        ("calibrate irb2600 CSV --holdout lots", "holdout"),
        ("calibrate irb2600 CSV --prior a2", "NAME=SIGMA"),
        ("calibrate irb2600 CSV --prior a2=3inch", "NAME=SIGMA"),
        ("calibrate irb2600 CSV --prior 'a*=0.5mrad'", "a length"),
        (f"calibrate {'x' * 5000} CSV", "no robot called"),
        ("calibrate irb2600 CSV -o two.json --figure no/x.svg", "no such folder"),
        ("calibrate irb2600 CSV -o .", "is a folder"),
        ("simulate irb2600 --noise nan -o x.csv", "finite"),
        ("simulate irb2600 --poses 10000000000 -o x.csv", "at most"),
        ("calibrate irb2600 CSV --colour red", "--colour"),
        ("calibrate irb2600 CSV --figure x.bmp", ".png, .svg, .pdf"),
        ("calibrate irb2600 CSV -o /no/such/folder/fit.json", "cannot be written"),
        ("calibrate irb2600 absent.csv", "absent.csv"),
        ("calibrate irb26 CSV", "irb2600"),
        ("evaluate CSV CSV", "is not JSON"),
        ("calibrate irb2600", "DATA"),
        ("callibrate irb2600 CSV", "callibrate"),
        ("simulate irb2600", "-o"),
        ("simulate irb2600 --poses 0 -o x.csv", "at least one pose"),
    ],
)
def test_wrong_input_is_one_line_and_exit_2(arguments, say, csv, tmp_path, refuses, monkeypatch):
    monkeypatch.chdir(tmp_path)
    before = set(tmp_path.iterdir())
    refuses(say, *(csv if a == "CSV" else a for a in shlex.split(arguments)))
    assert set(tmp_path.iterdir()) == before  # nothing half written


def test_numbers_that_do_not_work_out_are_exit_1(csv, says, monkeypatch):
    from minimax_cal.fitting import cell_fit
    from minimax_cal.solvers.minimax import Sqp

    monkeypatch.setattr(cell_fit, "Sqp", lambda hessian: Sqp(iterations=1, hessian=hessian))
    assert "iteration limit" in says("calibrate irb2600", csv, code=1).err


def test_simulate_backends_robots_and_help(tmp_path, answered, says):
    data, truth = tmp_path / "d.csv", tmp_path / "t.json"
    assert run("simulate ur5e --poses 30 -o", data, "--truth", truth) == 0
    assert mc.read_measurements(data).poses == 30
    perfect = mc.evaluate(mc.load_cell(truth), mc.read_measurements(data))
    assert perfect.rms_mm < 2.0
    assert "daqp" in answered("backends")["backends"]
    assert "irb2600" in says("robots").out
    assert "calibrate" in says("--help").out
    assert "--cv" in says("calibrate --help-all").out
    assert run("--version") == 0


def test_evaluate_doubts_data_that_do_not_belong(csv, tmp_path, noisy, refuses, says):
    fit, wrong = tmp_path / "fit.json", tmp_path / "wrong.csv"
    assert run("calibrate irb2600", csv, "-o", fit) == 0
    mc.write_measurements(wrong, noisy.data.with_y(noisy.data.y * 1e-3))
    assert "the same robot, measurement frame, units" in says("evaluate", fit, wrong).err
    (tmp_path / "other.json").write_text('{"schema": 1, "kind": "diagnosis"}')
    refuses("holds no arm", "evaluate", tmp_path / "other.json", csv)


def test_a_bootstrap_is_shown_and_saved(csv, tmp_path, refuses, says):
    out = tmp_path / "fit.json"
    arguments = ("calibrate", "irb2600", csv, "--objective", "sum", "--bootstrap")
    assert "calibrations of resampled poses" in says(*arguments, "40", "-o", out).out
    found = json.loads(out.read_text())["bootstrap"]
    assert found["replicates"] + found["lost"] == 40
    assert all(row["interval"][0] < row["interval"][1] for row in found["parameters"])
    refuses("1 replicates", *arguments, "1")


def test_inputs_are_never_overwritten(csv, refuses):
    before = csv.read_bytes()
    for arguments in (
        ("calibrate", "irb2600", csv, "-o", csv),
        ("calibrate", "irb2600", csv, "--figure", csv),
        ("diagnose", "irb2600", csv, "-o", csv.parent / ".." / csv.parent.name / csv.name),
    ):
        refuses("is an input of this command", *arguments)
    assert csv.read_bytes() == before
    refuses("name a file", "calibrate irb2600", csv, "-o", "-")
    assert not Path("-").exists()


def test_a_closed_stdout_is_told_before_the_work(csv):
    """What is opened next would take its place, and hold the result."""
    closed = '"$@" >&-'
    command = ["sh", "-c", closed, "sh", sys.executable, "-m", "minimax_cal.cli"]
    ended = subprocess.run(
        [*command, "calibrate", "irb2600", str(csv)], capture_output=True, text=True, check=False
    )
    assert ended.returncode == 2
    assert ended.stderr.startswith("error: stdout is closed")
    assert len(ended.stderr.splitlines()) == 1


def test_too_little_memory_is_one_line(monkeypatch, says):
    from minimax_cal.cli import robots

    def greedy(**_: object) -> None:
        raise MemoryError

    monkeypatch.setattr(robots.robots_command, "callback", greedy)
    assert "not enough memory" in says("robots", code=1).err


def test_cells_that_a_spreadsheet_would_run(csv, tmp_path, capsys):
    """They pass through `import` and `compensate`, which say so; --safe-cells makes them text."""
    header, *rows = csv.read_text().splitlines()
    formula = "=cmd|' /C calc'!A0"
    odd, out, fit = (tmp_path / name for name in ("odd.csv", "out.csv", "fit.json"))
    odd.write_text("\n".join([f"{header},@note", *(f"{row},{formula}" for row in rows)]))
    assert run("calibrate irb2600", csv, "--objective", "sum", "-o", fit, "-q") == 0
    for command in (("import", odd), ("compensate", fit, odd)):
        capsys.readouterr()
        run(*command, "-o", out)
        assert "61 cells begin as a formula does" in capsys.readouterr().err
        assert f",{formula}" in out.read_text()
        run(*command, "-o", out, "--safe-cells")
        assert "formula" not in capsys.readouterr().err
        table = list(reader(out.read_text().splitlines()))
        at = next(i for i, name in enumerate(table[0]) if "note" in name)
        assert [row[at] for row in table] == ["'@note", *[f"'{formula}"] * 60]
        assert not any(cell.startswith("'") for row in table for cell in row[:at])  # -1.5 stays


def test_what_a_file_holds_moves_no_cursor(csv, tmp_path, says):
    """Terminal codes in a header, and a cell of 200,000 digits."""
    header, first, *rest = csv.read_text().splitlines()
    odd = tmp_path / "odd.csv"
    lines = [f"{header},\x1b]0;title\x07", f"{first},1", *(f"{row},2" for row in rest)]
    odd.write_text("\n".join(lines))
    out, err = says("calibrate irb2600", odd, "--objective", "sum")
    assert "title" in err
    assert "\x1b" not in out + err
    long = "7" * 200_000
    odd.write_text("\n".join([header, first.replace(first.split(",")[0], long + "x"), *rest]))
    assert len(says("calibrate irb2600", odd, code=2).err) < 1100


def test_results_are_written_before_pictures(csv, tmp_path, monkeypatch):
    from minimax_cal.cli import calibrate

    def broken(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(calibrate, "save_errors", broken)
    out = tmp_path / "fit.json"
    assert run("calibrate irb2600", csv, "-o", out, "--figure", tmp_path / "a.png") == 1
    assert mc.load_fit(out).status == "converged"


@pytest.mark.parametrize("module", ["minimax_cal", "minimax_cal.cli"])
def test_the_package_itself_is_the_command(module, csv):
    command = [sys.executable, "-m", module, "calibrate", "nothing", str(csv)]
    ended = subprocess.run(command, capture_output=True, text=True, check=False)
    assert ended.returncode == 2
    *_, line = ended.stderr.splitlines()  # a busy machine tells its progress before
    assert line.startswith("error: no robot called 'nothing'")


@pytest.mark.parametrize("factor", [1e3, 1e-3])
def test_u95_in_another_unit_is_reported_by_both(factor, tmp_path, noisy, capsys):
    """Micrometres or metres under the name of millimetres."""
    csv = tmp_path / "poses.csv"
    mc.write_measurements(csv, noisy.data)
    header, *rows = csv.read_text().splitlines()
    lines = [f"{header},u95_mm", *(f"{row},{0.03 * factor:g}" for row in rows)]
    csv.write_text("\n".join(lines))
    for command in (("calibrate", "--objective", "sum"), ("diagnose", "--quick")):
        run(command[0], "irb2600", csv, *command[1:])
        err = capsys.readouterr().err
        assert f"column u95_mm says {0.03 * factor:.3g} mm" in err, command
        assert "is it in mm?" in err


def test_a_result_without_parameters_is_refused(csv, tmp_path, capsys, refuses):
    """`compare` would find no difference where nothing is there to differ."""
    fit, empty = tmp_path / "fit.json", tmp_path / "empty.json"
    assert run("calibrate irb2600", csv, "--objective", "sum", "-o", fit) == 0
    content = json.loads(fit.read_text())
    for left in (content["parameters"][:-1], []):
        empty.write_text(json.dumps({**content, "parameters": left}))
        capsys.readouterr()
        for pair in ((fit, empty), (empty, fit)):
            refuses("empty.json", "compare", *pair)


# ---- progress ------------------------------------------------------------------------------------


class Hands:
    """A clock that a test sets."""

    def __init__(self) -> None:
        self.at = 100.0

    def __call__(self) -> float:
        return self.at


def test_time_left_is_that_of_the_steps_so_far():
    now = Hands()
    told = StageClock(now)

    def replicate(part: int) -> ProgressStage:
        return build_counted_stage("replicate", part, 10)

    assert told.format_stage("geometry") == "geometry, 0 s"
    now.at += 60.0
    assert told.format_stage(replicate(1)) == "replicate 1 of 10, 1 min 0 s"
    now.at += 4.0  # two steps took four seconds, eight are left
    assert told.format_stage(replicate(3)) == "replicate 3 of 10, 1 min 4 s, about 16 s left"
    now.at += 10.0
    first = build_counted_stage("part", 1, 3, " left out: joint 2")
    assert told.format_stage(first) == "part 1 of 3 left out: joint 2, 1 min 14 s"
    assert (
        told.format_stage("step 3 of 9") == "step 3 of 9, 1 min 14 s"
    )  # words are never read back
    assert format_duration(125.4) == "2 min 5 s"


def test_a_line_every_ten_seconds_from_the_first_second(monkeypatch, capsys):
    now, waits = Hands(), list[float]()
    ticker = ProgressTicker(StageClock(now))

    def wait(seconds: float) -> bool:
        """As an event that is set after three lines; stages begin meanwhile."""
        waits.append(seconds)
        now.at += seconds
        if len(waits) == 2:
            ticker.start_stage(build_counted_stage("part", 3, 18))
        return len(waits) > 3

    monkeypatch.setattr(progress, "SECONDS_TO_FIRST_PROGRESS_LINE", 1.0)  # as it is but for tests
    ticker.start_stage("geometry")
    monkeypatch.setattr(ticker.over, "wait", wait)
    ticker.print_lines_until_over()
    assert waits == [progress.SECONDS_TO_FIRST_PROGRESS_LINE, 10.0, 10.0, 10.0]
    assert capsys.readouterr().err.splitlines() == [
        "progress: geometry, 1 s",
        "progress: part 3 of 18, 11 s",
        "progress: part 3 of 18, 21 s, about 1 min 20 s left",
    ]
    with show_stage_progress(is_quiet=True) as show:
        show("start")
    with show_stage_progress(is_quiet=False) as show:  # over before the first second
        show("start")
    assert capsys.readouterr().err == ""


def test_files_by_their_ending(tmp_path, capsys, refuses, says):
    mc.write_measurements(tmp_path / "poses.csv", mc.simulate("irb120", 30, 2, seed=1).data)
    command = ("calibrate", "irb120", tmp_path / "poses.csv", "--objective", "sum")
    assert (
        f"written: {tmp_path / 'errors.svg'}" in says(*command, "-o", tmp_path / "errors.svg").err
    )
    assert b"<svg" in (tmp_path / "errors.svg").read_bytes()
    assert "written" not in says(*command, "-o", tmp_path / "fit.json", "-q").err
    for name, start in (("map.json", "{"), ("map.svg", "<?xml")):
        assert run("map", tmp_path / "fit.json", "--bins", 4, "-o", tmp_path / name) == 0
        assert (tmp_path / name).read_text().startswith(start)
    assert json.loads((tmp_path / "map.json").read_text())
    capsys.readouterr()
    assert run("evaluate", tmp_path / "fit.json", tmp_path / "poses.csv", "-o",
               tmp_path / "a.png") == 2  # fmt: skip
    assert "this command draws no picture; write a .json" in capsys.readouterr().err
    refuses("this command writes no CSV; write a .json", *command, "-o", tmp_path / "fit.csv")
    refuses("the measurements are a CSV", "simulate ur10 -o", tmp_path / "poses.json")
    assert run("import", tmp_path / "poses.csv", "-o", tmp_path / "said.json") == 0
    assert json.loads((tmp_path / "said.json").read_text())["poses"] == 30
    plan = ("plan", "irb120", "--poses", 6, "--candidates", 30, "-q", "-o")
    for name, start in (("plan.json", "{"), ("plan.csv", "order,pose,q1_deg")):
        assert run(*plan, tmp_path / name) == 0
        assert (tmp_path / name).read_text().startswith(start)


def test_events_are_lines_of_json(tmp_path, says):
    """Every line of stderr is one, in whatever order options stand; the next command is silent."""
    mc.write_measurements(tmp_path / "poses.csv", mc.simulate("irb120", 30, 2, seed=1).data)
    command = ("calibrate", "irb120", tmp_path / "poses.csv", "--objective", "sum", "-o",
               tmp_path / "fit.json", "--bootstrap", 20)  # fmt: skip
    events = [json.loads(line) for line in says(*command, "--progress", "json").err.splitlines()]
    by_kind = {event["event"]: event for event in events}
    assert {"progress", "written"} <= set(by_kind)
    assert by_kind["written"]["text"] == str(tmp_path / "fit.json")
    counted = [event for event in events if "parts" in event]
    assert counted[0]["text"] == "replicate 1 of 20"
    assert (counted[0]["part"], counted[0]["parts"]) == (1, 20)
    for wrong in (("--objective", "best"), ("--holdout", "-1")):
        (event,) = [
            json.loads(line)
            for line in says(
                "calibrate irb120", tmp_path / "poses.csv", *wrong, "--progress", "json", code=2
            ).err.splitlines()
        ]
        assert (event["event"], event["exit_code"]) == ("error", 2)
        assert not event["text"].startswith("error")
    assert says("calibrate irb120", tmp_path / "none.csv", code=2).err.startswith("error: ")


# ---- serve command -------------------------------------------------------------------------------


@pytest.mark.parametrize("missing", ["uvicorn", "starlette", "plotly.offline"])
def test_a_missing_extra_is_named(missing, tmp_path, monkeypatch, says):
    pytest.importorskip("uvicorn", reason="the page needs pip install minimax-cal[app]")
    monkeypatch.setitem(sys.modules, missing, None)
    (line,) = says("serve --no-browser --folder", tmp_path / "sessions", code=2).err.splitlines()
    assert missing.partition(".")[0] in line
    assert "pip install" in line
    assert not (tmp_path / "sessions").exists()


def test_a_port_that_is_taken(tmp_path, capsys):
    pytest.importorskip("uvicorn", reason="the page needs pip install minimax-cal[app]")
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        assert run("serve --no-browser --folder", tmp_path, "--port", port) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(f"error: --port {port}: cannot be had")


def test_a_folder_that_cannot_be(tmp_path, says):
    pytest.importorskip("uvicorn", reason="the page needs pip install minimax-cal[app]")
    (tmp_path / "file").write_text("x")
    (line,) = says(
        "serve --no-browser --folder", tmp_path / "file" / "sessions", code=2
    ).err.splitlines()
    assert "cannot be made" in line


# ---- import logs ---------------------------------------------------------------------------------


def rtde(path: Path, seed: int) -> Path:
    """A log as UR's recorder writes it: cells that spaces separate."""
    rng = np.random.default_rng(seed)
    t = 0.008 * np.arange(500)
    q, qd, _ = fourier(rng, t, 6, rate=0.3)
    current = np.cos(q) + 0.02 * rng.normal(size=q.shape)
    stems = ("actual_q", "actual_qd", "actual_current")
    header = ["timestamp", *(f"{stem}_{j}" for stem in stems for j in range(6))]
    table = np.column_stack([100.0 + t, q, qd, current])
    np.savetxt(path, table, fmt="%.8g", header=" ".join(header), comments="")
    return path


def test_logs_become_the_houses_columns(tmp_path, says):
    files = [rtde(tmp_path / "a.csv", 1), rtde(tmp_path / "b.csv", 2)]
    said = says("import", *files, "-o", tmp_path / "out.csv")
    assert "2 runs, 8.0 s, 6 joints" in said.out
    assert "UR RTDE" in said.out
    header = (tmp_path / "out.csv").read_text().partition("\n")[0].split(",")
    assert header[:3] == ["run", "t_s", "q1_rad"]
    assert header[-1] == "i6_A"
    for one, again in zip(mc.read_runs(files), mc.read_runs(tmp_path / "out.csv"), strict=True):
        assert again.name == f"out:{one.name}"
        assert_allclose(again.torque, one.torque, atol=1e-8)
        assert_allclose(again.q, one.q, atol=1e-8)


def test_logs_in_json(tmp_path, answered):
    path = rtde(tmp_path / "a.csv", 1)
    told = answered("import", path)
    assert (told["joints"], told["unit"], told["notices"]) == (6, "A", [])
    assert told["runs"][0]["rows"] == 500
    assert told["runs"][0]["step_s"] == pytest.approx(0.008)
    assert told["runs"][0]["columns"][-1] == "actual_current_5"


def test_what_is_wrong_ends_with_2(tmp_path, refuses):
    path = rtde(tmp_path / "a.csv", 1)
    refuses("--leave-out is about measured points", "import", path, "--leave-out", "3")
    refuses("--mend is about measured points", "import", path, "--mend", "shift=2")
    rows = ["t_s,q1_deg,q2_deg", *(f"{0.01 * i},{i},{2 * i}" for i in range(300))]
    (tmp_path / "plan.csv").write_text("\n".join(rows))
    refuses("no column of torque or current; drive this motion", "import", tmp_path / "plan.csv")


# ---- printed commands ----------------------------------------------------------------------------


ARMS = ("irb120", "ur10", "scara_600")


def printed(out: str) -> list[list[str]]:
    """The commands among the lines that are indented, as a shell would take them."""
    lines = (line.strip() for line in out.splitlines())
    return [shlex.split(line)[1:] for line in lines if line.startswith("minimax-cal ")]


@pytest.mark.parametrize("name", ARMS)
def test_what_is_advised_runs(name, tmp_path, monkeypatch, capsys):
    pytest.importorskip("mujoco", reason="needs pip install minimax-cal[mujoco]")
    monkeypatch.chdir(tmp_path)
    robot = mc.load_robot(name)
    truth = Truth(compliance=0.0 if name == "scara_600" else 3e-6)
    data = simulate(robot, 60, 3, seed=1, truth=truth).data
    mc.write_measurements("poses.csv", data)
    units = [f"q{i + 1}_{'mm' if slides else 'rad'}" for i, slides in enumerate(robot.prismatic)]
    rows = data.q[:3] * np.where(robot.prismatic, 1e3, 1.0)
    np.savetxt("targets.csv", rows, "%.6f", ",", header=",".join(units), comments="")
    waiting = [
        ["calibrate", name, "poses.csv", "-o", "fit.json"],
        ["diagnose", name, "poses.csv", "-o", "diagnosis.json", "--quick"],
    ]
    done: list[list[str]] = []
    while waiting:
        command = waiting.pop(0)
        done.append(command)
        code = run(*command)
        out, err = capsys.readouterr()
        singular = command[0] == "compensate" and "are missed: singular" in err
        assert code == singular, f"{' '.join(command)}: {err}"
        waiting += [more for more in printed(out) if more not in (*done, *waiting)]
    verbs = {command[0] for command in done}
    assert {"calibrate", "diagnose", "compensate", "export"} <= verbs


def test_ctrl_c_during_imports_is_one_line(monkeypatch, capsys):
    class Interrupted(ModuleType):
        def __getattr__(self, name: str) -> None:
            raise KeyboardInterrupt

    name = "minimax_cal.cli.command_runner"
    monkeypatch.setitem(sys.modules, name, Interrupted(name))
    assert run("robots") == 130
    assert capsys.readouterr().err == "error: interrupted\n"
