import json
import re
import subprocess
import sys
from csv import reader
from pathlib import Path
from types import ModuleType

import pytest
from conftest import run

import minimax_cal as mc
from minimax_cal.modelling.simulate import Simulation
from minimax_cal.robots.robot import robot_from_dict


@pytest.fixture
def csv(tmp_path: Path, noisy: Simulation) -> Path:
    path = tmp_path / "poses.csv"
    mc.write_measurements(path, noisy.data)
    return path


def test_summary_on_stdout(csv, capsys):
    assert run("calibrate", "irb2600", csv, "--details") == 0
    out, err = capsys.readouterr()
    for words in (
        "held out, calibrated",
        "same motion as base_z",
        "33 of 45 parameters",
        "F_i mm^2",
    ):
        assert words in out
    assert "\x1b" not in out + err  # no colour codes into a pipe


def test_the_first_screen_is_short_and_narrow(csv, capsys):
    assert run("calibrate", "irb2600", csv, "-o", csv.with_name("fit.json")) == 0
    out = capsys.readouterr().out
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


def test_json_alone_on_stdout(csv, capsys):
    assert run("calibrate", "irb2600", csv, "--objective", "sum", "--json") == 0
    content = json.loads(capsys.readouterr().out)
    assert content["schema"] == 1
    assert content["status"] == "converged"
    assert content["accuracy"]["holdout"]["rms_mm"] < content["accuracy"]["nominal"]["rms_mm"]
    # the calibrated robot is whole: the robot schema reads it
    assert robot_from_dict(content["robot"]).joints == 6


def test_output_file_figure_and_evaluate(csv, tmp_path, capsys):
    fit, picture = tmp_path / "fit.json", tmp_path / "errors.svg"
    assert run("calibrate", "irb2600", csv, "-o", fit, "--figure", picture, "-q") == 0
    assert "<svg" in picture.read_text()
    assert json.loads(fit.read_text())["schema"] == 1
    capsys.readouterr()
    assert run("evaluate", fit, csv, "--json") == 0
    found, own = json.loads(capsys.readouterr().out), json.loads(fit.read_text())["accuracy"]
    whole = found["accuracy"]
    assert whole["poses"] == 60
    assert found["training_poses"] == own["train"]["poses"]
    assert run("evaluate", fit, csv) == 0
    said = capsys.readouterr()
    assert f"{whole['rms_mm']:.4f}" in said.out
    assert not re.search(r"smr\d .*  -", said.out)  # mean and largest of each target too
    assert f"{own['train']['poses']} of 60 poses are training poses of the fit" in said.err
    assert f"the others: RMS {own['holdout']['rms_mm']:.4f} mm" in said.err
    new = tmp_path / "new.csv"
    mc.write_measurements(new, mc.simulate("irb2600", 20, seed=9).data)
    assert run("evaluate", fit, new, "--json") == 0
    said = capsys.readouterr()
    assert json.loads(said.out)["training_poses"] == 0
    assert "training poses" not in said.err


def test_every_option_reaches_the_fit(csv, capsys):
    arguments = (
        "--fix",
        "a2,beta*",
        "--free",
        "d1",
        "--prior",
        "d4=0.5mm",
        "--prior",
        "theta3=1mrad",
    )
    more = (
        "--holdout",
        0.3,
        "--seed",
        7,
        "--method",
        "nllm",
        "--hessian",
        "bfgs",
        "--qp",
        "clarabel",
    )
    last = ("--distance", "squared", "--distance-tolerance", 0.05, "--json")
    assert run("calibrate", "irb2600", csv, *arguments, *more, *last) == 0
    content = json.loads(capsys.readouterr().out)
    settings = content["provenance"]["settings"]
    assert settings["priors"] == {"d4": 0.0005, "theta3": 0.001}
    assert settings["distance_tolerance"] == pytest.approx(5e-5)
    assert settings["seed"] == 7
    assert content["accuracy"]["holdout"]["poses"] == 18
    assert {step["backend"] for step in content["minimax"]["trace"]} == {"clarabel"}
    found = {p["name"]: p for p in content["parameters"]}
    assert not found["a2"]["identifiable"]
    assert found["d1"]["identifiable"]


def test_the_same_seed_gives_the_same_numbers(csv, capsys):
    results = []
    for _ in range(2):
        assert run("calibrate", "irb2600", csv, "--json") == 0
        content = json.loads(capsys.readouterr().out)
        content.pop("seconds")
        results.append(content)
    assert results[0] == results[1]


@pytest.mark.parametrize(
    ("arguments", "say"),
    [
        (("calibrate", "irb2600", "CSV", "--qp", "dacp"), "daqp"),
        (("calibrate", "irb2600", "CSV", "--objective", "best"), "no objective 'best'"),
        (("calibrate", "irb2600", "CSV", "--holdout", "lots"), "holdout"),
        (("calibrate", "irb2600", "CSV", "--holdout", "2"), "fraction"),
        (("calibrate", "irb2600", "CSV", "--prior", "a2"), "NAME=SIGMA"),
        (("calibrate", "irb2600", "CSV", "--prior", "a2=3inch"), "NAME=SIGMA"),
        (("calibrate", "irb2600", "CSV", "--prior", "a*=0.5mrad"), "a length"),
        (("calibrate", "irb2600", "CSV", "--seed", "-1"), "seed -1"),
        (("calibrate", "x" * 5000, "CSV"), "no robot called"),
        (
            ("calibrate", "irb2600", "CSV", "-o", "two.json", "--figure", "no/x.svg"),
            "no such folder",
        ),
        (("calibrate", "irb2600", "CSV", "-o", "."), "is a folder"),
        (("simulate", "irb2600", "--noise", "nan", "-o", "x.csv"), "finite"),
        (("simulate", "irb2600", "--poses", "10000000000", "-o", "x.csv"), "at most"),
        (("calibrate", "irb2600", "CSV", "--colour", "red"), "--colour"),
        (("calibrate", "irb2600", "CSV", "--figure", "x.bmp"), ".png, .svg, .pdf"),
        (("calibrate", "irb2600", "CSV", "-o", "/no/such/folder/fit.json"), "cannot be written"),
        (("calibrate", "irb2600", "absent.csv"), "absent.csv"),
        (("calibrate", "irb26", "CSV"), "irb2600"),
        (("calibrate", "ur10", "CSV", "--objective", "sum"), "error"),
        (("evaluate", "CSV", "CSV"), "is not JSON"),
        (("calibrate", "irb2600"), "DATA"),
        (("callibrate", "irb2600", "CSV"), "callibrate"),
        (("simulate", "irb2600"), "-o"),
        (("simulate", "irb2600", "--poses", "0", "-o", "x.csv"), "at least one pose"),
    ],
)
def test_wrong_input_is_one_line_and_exit_2(arguments, say, csv, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    before = set(tmp_path.iterdir())
    code = run(*(csv if a == "CSV" else a for a in arguments))
    out, err = capsys.readouterr()
    if arguments[1] == "ur10":  # another robot than that of the data: failed, or refused
        assert code in (1, 2)
        return
    assert code == 2
    lines = [line for line in err.splitlines() if line.startswith("error: ")]
    assert len(lines) == 1
    assert say in lines[0]
    assert "Traceback" not in err
    assert out == ""
    assert set(tmp_path.iterdir()) == before  # nothing half written


def test_numbers_that_do_not_work_out_are_exit_1(csv, capsys, monkeypatch):
    from minimax_cal.fitting import solve
    from minimax_cal.solvers.minimax import Sqp

    monkeypatch.setattr(solve, "Sqp", lambda hessian: Sqp(iterations=1, hessian=hessian))
    assert run("calibrate", "irb2600", csv) == 1
    assert "iteration limit" in capsys.readouterr().err


def test_simulate_backends_robots_and_help(tmp_path, capsys):
    data, truth = tmp_path / "d.csv", tmp_path / "t.json"
    assert run("simulate", "ur5e", "--poses", 30, "-o", data, "--truth", truth) == 0
    assert mc.read_measurements(data).poses == 30
    perfect = mc.evaluate(mc.load_cell(truth), mc.read_measurements(data))
    assert perfect.rms_mm < 2.0
    assert run("backends", "--json") == 0
    assert "daqp" in json.loads(capsys.readouterr().out)["backends"]
    assert run("robots") == 0
    assert "irb2600" in capsys.readouterr().out
    assert run("--help") == 0
    assert "calibrate" in capsys.readouterr().out
    assert run("--version") == 0


def test_console_script_runs(csv):
    command = [sys.executable, "-m", "minimax_cal.cli", "calibrate", "nothing", str(csv)]
    ended = subprocess.run(command, capture_output=True, text=True, check=False)
    assert ended.returncode == 2
    assert ended.stderr.startswith("error: no robot called 'nothing'")
    assert len(ended.stderr.splitlines()) == 1


def test_evaluate_doubts_data_that_do_not_belong(csv, tmp_path, noisy, capsys):
    fit, wrong = tmp_path / "fit.json", tmp_path / "wrong.csv"
    assert run("calibrate", "irb2600", csv, "-o", fit) == 0
    mc.write_measurements(wrong, noisy.data.with_y(noisy.data.y * 1e-3))
    capsys.readouterr()
    assert run("evaluate", fit, wrong) == 0
    assert "the same robot, measurement frame, units" in capsys.readouterr().err
    (tmp_path / "other.json").write_text('{"schema": 1, "kind": "diagnosis"}')
    assert run("evaluate", tmp_path / "other.json", csv) == 2
    assert "holds no arm" in capsys.readouterr().err


def test_a_bootstrap_is_shown_and_saved(csv, tmp_path, capsys):
    out = tmp_path / "fit.json"
    arguments = ("calibrate", "irb2600", csv, "--objective", "sum", "--bootstrap")
    assert run(*arguments, "40", "-o", out) == 0
    assert "calibrations of resampled poses" in capsys.readouterr().out
    found = json.loads(out.read_text())["bootstrap"]
    assert found["replicates"] + found["lost"] == 40
    assert all(row["interval"][0] < row["interval"][1] for row in found["parameters"])
    assert run(*arguments, "1") == 2
    assert "1 replicates" in capsys.readouterr().err


def test_inputs_are_never_overwritten(csv, capsys):
    before = csv.read_bytes()
    for arguments in (
        ("calibrate", "irb2600", csv, "-o", csv),
        ("calibrate", "irb2600", csv, "--figure", csv),
        ("diagnose", "irb2600", csv, "-o", csv.parent / ".." / csv.parent.name / csv.name),
    ):
        assert run(*arguments) == 2
        assert "is an input of this command" in capsys.readouterr().err
    assert csv.read_bytes() == before
    assert run("calibrate", "irb2600", csv, "-o", "-") == 2
    assert "name a file" in capsys.readouterr().err
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


def test_ctrl_c_during_imports_is_one_line(monkeypatch, capsys):
    class Interrupted(ModuleType):
        def __getattr__(self, name: str) -> None:
            raise KeyboardInterrupt

    name = "minimax_cal.cli.running"
    monkeypatch.setitem(sys.modules, name, Interrupted(name))
    assert run("robots") == 130
    assert capsys.readouterr().err == "error: interrupted\n"


def test_too_little_memory_is_one_line(monkeypatch, capsys):
    from minimax_cal.cli import robots

    def greedy(**_: object) -> None:
        raise MemoryError

    monkeypatch.setattr(robots.robots_command, "callback", greedy)
    assert run("robots") == 1
    assert "not enough memory" in capsys.readouterr().err


def test_cells_that_a_spreadsheet_would_run(csv, tmp_path, capsys):
    """They pass through `import` and `compensate`, which say so; --safe-cells makes them text."""
    header, *rows = csv.read_text().splitlines()
    formula = "=cmd|' /C calc'!A0"
    odd, out, fit = (tmp_path / name for name in ("odd.csv", "out.csv", "fit.json"))
    odd.write_text("\n".join([f"{header},@note", *(f"{row},{formula}" for row in rows)]))
    assert run("calibrate", "irb2600", csv, "--objective", "sum", "-o", fit, "-q") == 0
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


def test_what_a_file_holds_moves_no_cursor(csv, tmp_path, capsys):
    """Terminal codes in a header, and a cell of 200,000 digits."""
    header, first, *rest = csv.read_text().splitlines()
    odd = tmp_path / "odd.csv"
    lines = [f"{header},\x1b]0;title\x07", f"{first},1", *(f"{row},2" for row in rest)]
    odd.write_text("\n".join(lines))
    assert run("calibrate", "irb2600", odd, "--objective", "sum") == 0
    out, err = capsys.readouterr()
    assert "title" in err
    assert "\x1b" not in out + err
    long = "7" * 200_000
    odd.write_text("\n".join([header, first.replace(first.split(",")[0], long + "x"), *rest]))
    assert run("calibrate", "irb2600", odd) == 2
    assert len(capsys.readouterr().err) < 1100


def test_results_are_written_before_pictures(csv, tmp_path, monkeypatch):
    from minimax_cal.cli import calibrate

    def broken(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(calibrate, "save_errors", broken)
    out = tmp_path / "fit.json"
    assert run("calibrate", "irb2600", csv, "-o", out, "--figure", tmp_path / "a.png") == 1
    assert mc.load_fit(out).status == "converged"


def test_calibrate_starts_without_what_it_does_not_use():
    """And what is put off is there when it is asked for."""
    unused = (
        "numba", "numpy.f2py.crackfortran", "unittest", "yaml", "minimax_cal.evidence.selection",
        "minimax_cal.judging.bootstrap", "minimax_cal.robots.urdf",
    )  # fmt: skip
    code = (
        "import sys\n"
        "from minimax_cal.cli.commands import quickly\n"
        "quickly('minimax_cal.cli.calibrate')\n"
        f"print([name for name in {unused} if name in sys.modules])\n"
        "from numpy import testing\n"
        "testing.assert_allclose(1.0, 1.0)\n"
    )
    ended = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert ended.stdout == "[]\n"


def test_the_package_itself_is_the_command():
    command = [sys.executable, "-m", "minimax_cal", "--version"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout.split()[0]) == (0, "minimax-cal,")


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


def test_a_result_without_parameters_is_refused(csv, tmp_path, capsys):
    """`compare` would find no difference where nothing is there to differ."""
    fit, empty = tmp_path / "fit.json", tmp_path / "empty.json"
    assert run("calibrate", "irb2600", csv, "--objective", "sum", "-o", fit) == 0
    content = json.loads(fit.read_text())
    for left in (content["parameters"][:-1], []):
        empty.write_text(json.dumps({**content, "parameters": left}))
        capsys.readouterr()
        for pair in ((fit, empty), (empty, fit)):
            assert run("compare", *pair) == 2
            assert "empty.json" in capsys.readouterr().err
