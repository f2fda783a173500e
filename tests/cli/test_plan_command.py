"""The command `plan`: poses out as files that the other commands read, and mistakes in one line."""

import csv
import json
import shlex
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from conftest import invoked
from numpy.testing import assert_allclose

import minimax_cal as mc
from minimax_cal.cli.compensate import read_target_file
from minimax_cal.cli.plan import plan_command
from minimax_cal.modelling.simulate import Simulation
from minimax_cal.planning.visit_route import RADIANS_TO_ANGLE_UNIT

FEW = ("--candidates", 80, "-q")
WIDE = ("--acceptance", 180)


pytestmark = pytest.mark.usefixtures("few_candidates")
run = partial(invoked, plan_command)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("plan")


@pytest.fixture(scope="module")
def poses(folder: Path, noisy: Simulation) -> Path:
    path = folder / "poses.csv"
    mc.write_measurements(path, noisy.data.take(np.arange(30)))
    return path


@pytest.fixture(scope="module")
def fit(folder: Path, poses: Path) -> Path:
    path = folder / "fit.json"
    mc.calibrate("irb2600", poses, "sum").save(path)
    return path


@pytest.fixture(scope="module")
def planned(folder: Path, few_candidates: None) -> Path:
    """A file of stops, with revisits from the other side."""
    path, picture = folder / "plan.csv", folder / "plan.svg"
    code, out, err = run("irb2600", "--poses", 10, "-o", path, "--figure", picture, "--revisit", 2,
                         "--approach", "both", "--candidates", 80, "--details", *WIDE)  # fmt: skip
    assert code == 0
    for words in ("10 poses by criterion I", "self-collision", "worth"):
        assert words in out
    for words in ("the tracker is taken to stand at", "check every move yourself", "10 um + 2.5"):
        assert words in err
    assert "\x1b" not in out + err
    assert "<svg" in picture.read_text()
    return path


def rows_of(path: Path) -> tuple[list[str], list[list[str]]]:
    header, *rows = csv.reader(path.read_text().splitlines())
    return header, rows


def test_the_file_says_its_units(planned):
    header, rows = rows_of(planned)
    assert header[:3] == ["order", "pose", "q1_deg"]
    assert header[14] == "via"
    assert header[-1] == "expected_smr3_z_mm"
    assert len(rows) == 10 + 2 * 2
    assert [row[0] for row in rows] == [str(i + 1) for i in range(14)]
    via = [row for row in rows if row[14] == "1"]
    assert len(via) == 2
    assert all(cell == "" for row in via for cell in row[15:])  # nothing is measured there


def test_compensate_reads_the_stops(planned):
    _, rows = rows_of(planned)
    given = read_target_file(planned)
    assert_allclose(np.degrees(given.data.q), np.array([row[2:8] for row in rows], dtype=float))
    assert given.data.columns["approach3"].tolist() == [float(row[10]) for row in rows]


def test_calibrate_reads_the_stops_once_they_are_measured(planned, folder):
    """What the plan expects is where the nominal arm is: measured so, nothing is left to fit."""
    header, rows = rows_of(planned)
    expected = [i for i, name in enumerate(header) if name.startswith("expected_")]
    full = [[*header, *(header[i].removeprefix("expected_") for i in expected)]]
    full += [[*row, *(row[i] for i in expected)] for row in rows]
    path = folder / "measured.csv"
    with path.open("w", newline="") as stream:
        csv.writer(stream).writerows(full)
    data = mc.read_measurements(path)
    assert data.poses == 12  # not the stops on the way
    assert {"approach6", "order", "pose"} <= set(data.columns)
    error = mc.Cell(mc.load_robot("irb2600"), base_of(data), data.target_names, SPOTS).error(data)
    assert np.nanmax(np.abs(error)) < 1e-6  # the file's digits


SPOTS = 0.1 * np.array([[np.cos(a), np.sin(a), 0.3] for a in 2 * np.pi * np.arange(3) / 3])


def base_of(data: mc.Measurements) -> np.ndarray:
    """The base as the plan assumed it: its axes are the tracker's."""
    robot = mc.load_robot("irb2600")
    pose = robot.pose(data.q)
    points = np.einsum("mij,kj->mki", pose[:, :3, :3], SPOTS) + pose[:, None, :3, 3]
    base = np.eye(4)
    base[:3, 3] = np.nanmean(data.y - points, axis=(0, 1))
    return base


def test_radians_and_slides(folder):
    path = folder / "scara.csv"
    code, _, _ = run("scara_600", "--poses", 8, "--unit", "rad", "--targets", 1, "-o", path, *FEW,
                     *WIDE)  # fmt: skip
    assert code == 0
    header, rows = rows_of(path)
    robot = mc.load_robot("scara_600")
    names = [f"q{j + 1}_{'mm' if slides else 'rad'}" for j, slides in enumerate(robot.prismatic)]
    assert header[2 : 2 + robot.joints] == names
    q = np.array([row[2 : 2 + robot.joints] for row in rows], dtype=float)
    q = q * np.where(robot.prismatic, 1e-3, 1.0)
    assert np.all((q >= robot.lower - 1e-9) & (q <= robot.upper + 1e-9))
    assert set(RADIANS_TO_ANGLE_UNIT) == {"deg", "rad"}


def test_json_alone_on_stdout():
    code, out, _ = run("irb2600", "--poses", 10, "--json", "--targets", 1, "--tracker",
                       "2500,-500,800", "--criterion", "D", "--joint", "J2=-20:40", *FEW,
                       *WIDE)  # fmt: skip
    assert code == 0
    content = json.loads(out)
    assert content["kind"] == "plan"
    assert content["criterion"] == "D"
    assert content["targets"] == ["smr1"]
    assert_allclose(content["instrument"]["place_in_base_mm"], [2500.0, -500.0, 800.0])
    second = np.degrees(np.array(content["q"])[:, 1])
    assert second.min() >= -20.0 - 1e-9
    assert second.max() <= 40.0 + 1e-9
    assert 0.0 < content["efficiency_at_least"] <= 1.0
    assert json.loads(run("irb2600", "--poses", 10, "--json", "--targets", 1, "--tracker",
                          "2500,-500,800", "--criterion", "D", "--joint", "J2=-20:40", *FEW,
                          *WIDE)[1])["q"] == content["q"]  # fmt: skip


def test_a_fit_and_its_poses(fit, poses):
    """The file of a calibration holds its poses: they count, as they do with --data."""
    found = []
    for more in (("--fit", fit), ("--fit", fit, "--data", poses), ("--data", poses)):
        code, out, _ = run("irb2600", "--poses", 3, *more, "--json", *FEW, *WIDE)
        assert code == 0
        found.append(json.loads(out))
    for content in found:
        assert content["at_hand"] == 30
        assert content["growth"][0]["mean_um"]["planned"] > 0.0
    assert_allclose(np.array(found[0]["q"]), np.array(found[1]["q"]), rtol=0, atol=1e-9)
    noise = [content["instrument"]["noise_um"] for content in found]
    assert_allclose(noise[0], noise[1], rtol=1e-6)


def test_separate(poses):
    code, out, _ = run("irb2600", "--poses", 5, "--data", poses, "--separate", "encoder_gain:J3",
                       "gear_error:J3:turns=1", "--details", *FEW, *WIDE)  # fmt: skip
    assert code == 0
    text = " ".join(out.split())
    assert "Power to tell encoder gain at joint 3 and gear error at joint 3 apart" in text
    assert "power to tell the effects apart" in text
    assert "stops in order" in text  # without -o the poses are shown


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("--poses 3", "3 poses do not tell the 33 parameters apart; plan at least"),
        ("--poses 10 --joint J2=40:-20", "the limits are reversed"),
        ("--poses 10 --joint J2=10:20 --joint J2=40:50", "joint 2 is given twice"),
        ("--poses 10 --joint two=0:1", "write J2=-30:60"),
        ("--poses 10 --range 9", "--range 9: give low:high"),
        ("--poses 10 --tracker 0,0,9000", "elevation rejects most"),
        ("--poses 10 --volume 8000:9000,0:1,0:1", "volume rejects most"),
        ("--poses 10 --volume 8000:9000", "give x, y and z"),
        ("--poses 10 --tracker 1,2", "give x,y,z in mm"),
        ("--poses 10 --target 1,2,nan", "give x,y,z in mm"),
        ("--poses 10 --unit grad", "no unit 'grad'"),
        ("--poses 10 --fit missing.json", "missing.json: cannot be read"),
        ("--poses 10 --data missing.csv", "missing.csv: cannot be read"),
        ("", "poses"),
    ],
)
def test_mistakes_are_told_in_one_line(arguments, message):
    code, out, err = run("irb2600", *shlex.split(arguments), *FEW)
    assert code == 2
    assert out == ""
    assert message in " ".join(err.split())
    assert len(err.strip().splitlines()) == 1
