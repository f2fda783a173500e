"""The tutorial as a newcomer types it: in a fresh environment, with what it tells to install."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import tarfile
from pathlib import Path

import pytest
from conftest import ROOT
from test_docs import DOCS, blocks, chunks, printed, words
from test_wheel import call

TUTORIAL = DOCS / "tutorial.md"


def install() -> str:
    """What the page tells to install, as `.[plot]`."""
    (told,) = re.findall(r'`pip install "(\.\[[\w,]+\])"`', TUTORIAL.read_text())
    return str(told)


def shell(line: str, folder: Path, environment: dict[str, str]) -> str:
    """A line as it is typed; its exit code is 0, or the one that its comment tells."""
    expected = re.search(r"# exit code (\d)", line)
    done = subprocess.run(
        ["bash", "-c", line], capture_output=True, text=True, cwd=folder, env=environment
    )
    assert done.returncode == int(expected[1] if expected else 0), f"{line}\n{done.stderr}"
    assert "Traceback" not in done.stderr
    return done.stdout


def test_all_that_the_tutorial_runs_is_told_to_be_installed():
    """Pictures need [plot] and the report [report]; this form needs no network."""
    text = TUTORIAL.read_text()
    for used, extra in (
        ("--figure", "plot"),
        ("minimax-cal report", "report"),
        ("minimax-cal gap", "mujoco"),
    ):
        if any(used in body for language, body in blocks(TUTORIAL) if language == "bash"):
            assert extra in re.split(r"\W+", install()), f"{used} in {text[:40]!r}"


@pytest.mark.slow
def test_the_tutorial_runs_to_its_last_line(tmp_path):
    tree, place, folder = (tmp_path / name for name in ("tree", "venv", "work"))
    folder.mkdir()
    files = call("git", "-C", ROOT, "archive", "--format=tar", "-o", tmp_path / "tree.tar", "HEAD")
    if files.returncode:
        pytest.skip("git does not know this tree")
    with tarfile.open(tmp_path / "tree.tar") as archive:
        archive.extractall(tree, filter="data")
    subprocess.run([sys.executable, "-m", "venv", str(place)], check=True)
    done = call(place / "bin" / "pip", "install", "--quiet", install(), folder=tree)
    assert done.returncode == 0, done.stderr[-2000:]
    bare = {k: v for k, v in os.environ.items() if k not in ("PYTHONPATH", "VIRTUAL_ENV")}
    environment = {**bare, "PATH": f"{place / 'bin'}:{bare['PATH']}", "MPLBACKEND": "agg"}
    found: list[str] = []
    for language, body in blocks(TUTORIAL):
        if language == "bash":
            found = words("".join(shell(line, folder, environment) for line in body.splitlines()))
        elif language == "python":
            name = re.match(r"# (\w+\.py)\n", body)
            (folder / (name[1] if name else "typed.py")).write_text(body)
            found = [] if name else words(shell("python typed.py", folder, environment))
        elif language == "text":
            for chunk in chunks(body):
                end = printed(chunk, found)
                assert end or not chunk, f"not printed: {' '.join(chunk)!r}"
                found = found[end:]
    assert (folder / "report.html").stat().st_size > 100_000
