"""What users install: built, checked, and run far from the checkout with required packages only."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tarfile
import zipfile
from collections.abc import Callable
from pathlib import Path

import pytest
from conftest import ROOT

from minimax_cal.cli.command_group import COMMAND_MODULES
from tests.fuzz.material import material

pytestmark = pytest.mark.slow
Ran = subprocess.CompletedProcess[str]
known: set[str] = set()  # commands that were run


def call(*command: object, folder: Path | None = None) -> Ran:
    """A command that sees nothing of this checkout."""
    bare = {k: v for k, v in os.environ.items() if k not in ("PYTHONPATH", "VIRTUAL_ENV")}
    return subprocess.run(
        [str(word) for word in command],
        capture_output=True, text=True, check=False, cwd=folder, env=bare,
    )  # fmt: skip


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Wheel and sdist, of what git knows."""
    pytest.importorskip("build")
    tree, out = tmp_path_factory.mktemp("tree"), tmp_path_factory.mktemp("dist")
    files = call("git", "-C", ROOT, "archive", "--format=tar", "-o", out / "tree.tar", "HEAD")
    if files.returncode:
        pytest.skip("git does not know this tree")
    with tarfile.open(out / "tree.tar") as archive:
        archive.extractall(tree, filter="data")
    (out / "tree.tar").unlink()
    done = call(sys.executable, "-m", "build", "--outdir", out, tree)
    assert done.returncode == 0, done.stderr[-2000:]
    return sorted(out.iterdir())


@pytest.fixture(scope="module")
def installed(built: list[Path], tmp_path_factory: pytest.TempPathFactory) -> Callable[..., Ran]:
    """`minimax-cal` from the wheel, in a virtual environment of its own."""
    place, folder = tmp_path_factory.mktemp("venv"), tmp_path_factory.mktemp("elsewhere")
    subprocess.run([sys.executable, "-m", "venv", str(place)], check=True)
    wheel = next(path for path in built if path.suffix == ".whl")
    done = call(place / "bin" / "pip", "install", "--quiet", wheel)
    assert done.returncode == 0, done.stderr[-2000:]

    header = ",".join(f"q{joint}_deg" for joint in range(1, 7))
    (folder / "targets.csv").write_text(f"{header}\n20,30,-10,40,50,60\n-20,10,20,-40,60,10\n")

    (folder / "wires.csv").write_bytes(material()["wires.csv"])
    known.clear()

    def run(*arguments: object, code: int = 0) -> Ran:
        known.add(str(arguments[0]))
        ended = call(place / "bin" / "minimax-cal", *arguments, folder=folder)
        assert "Traceback" not in ended.stderr, ended.stderr
        assert ended.returncode == code, ended.stderr
        return ended

    return run


def test_wheel_and_sdist_are_whole(built):
    pytest.importorskip("twine")
    done = call(sys.executable, "-m", "twine", "check", "--strict", *built)
    assert done.returncode == 0, done.stdout
    wheel = zipfile.ZipFile(next(path for path in built if path.suffix == ".whl")).namelist()
    for folder in ("minimax_cal", "qp_backends"):
        here = [
            p for p in (ROOT / folder).rglob("*") if p.is_file() and "__pycache__" not in p.parts
        ]
        wanted = {str(p.relative_to(ROOT)) for p in here if p.suffix not in (".pyc", ".md")}
        assert wanted <= set(wheel)
    assert not [name for name in wheel if name.startswith(("tests", "experiments", "docs"))]


def test_every_command_runs_or_names_its_extra(installed):
    """Required packages only: everything but pictures, report and some backends."""
    run = installed
    robots = json.loads(run("robots", "--json").stdout)
    assert robots
    run("simulate", "irb120", "--poses", 40, "-o", "poses.csv", "--truth", "truth.json")
    run("calibrate", "irb120", "poses.csv", "-o", "fit.json")
    run("calibrate", "irb120", "poses.csv", "--objective", "point", "--qp", "clarabel")
    run("evaluate", "fit.json", "poses.csv")
    run("diagnose", "irb120", "poses.csv", "-o", "diagnosis.json")
    run("import", "poses.csv", "-o", "again.csv")
    run("relative", "irb120", "wires.csv", code=1)  # no better than the drawn arm
    run("check", "fit.json", "poses.csv", "--tolerance", "rms 0.5")
    run("compare", "fit.json", "fit.json")
    run("compensate", "fit.json", "targets.csv")
    run("iso9283", "fit.json")
    run("map", "fit.json", "--samples", 1000, "--json")
    run("plan", "irb120", "--poses", 8, "--candidates", 60, "-o", "next.csv")
    run("export", "fit.json", "--to", "urdf", "-o", "arm.urdf")
    run("export", "fit.json", "--to", "mjcf", "-o", "arm.xml")
    run("identify", "nowhere.csv", "--joints", "revolute", "-o", "arm.json", code=2)
    run("torques", "irb120", "nowhere.csv", code=2)
    run("effects")
    run("effects", "irb120", "poses.csv")
    run("backends")
    run("--version")
    for command, extra in (
        (("calibrate", "irb120", "poses.csv", "--figure", "a.png"), "[plot]"),
        (("map", "fit.json", "-o", "a.png"), "[plot]"),
        (("report", "fit.json", "-o", "a.html"), "[report]"),
        (("gap", "arm.xml", "poses.csv"), "mujoco"),
        (("serve", "--no-browser"), "[app]"),
    ):
        ended = run(*command, code=2)
        line = ended.stderr.strip()
        assert "\n" not in line, ended.stderr
        assert "pip install" in line
        assert extra in line
    assert known - {"--version"} == set(COMMAND_MODULES)
    missing = run("calibrate", "irb120", "poses.csv", "--qp", "piqp").stderr
    assert "pip install piqp; daqp is used" in missing
