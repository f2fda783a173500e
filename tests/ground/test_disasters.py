"""A writer that is killed, a full disk, two who write one file: it is whole all the same."""

from __future__ import annotations

import subprocess
import sys
import time
from pathlib import Path

import pytest

ONE, OTHER = "a" * 4_000_000, "b" * 3_000_000
WRITER = """
import sys
from minimax_cal.core.files import write_file_atomically
path, letter, count = sys.argv[1:]
text = letter * {"a": 4_000_000, "b": 3_000_000}[letter]
print("ready", flush=True)
for _ in range(int(count)):
    write_file_atomically(path, text)
"""
FULL = """
import resource, sys
resource.setrlimit(resource.RLIMIT_FSIZE, (2000, 2000))
from minimax_cal.cli import main
main(sys.argv[1:])
"""
pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="processes are those of POSIX")


def writer(path: Path, letter: str, count: int) -> subprocess.Popen[str]:
    """Someone at work on a file."""
    command = [sys.executable, "-c", WRITER, str(path), letter, str(count)]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    assert process.stdout
    assert process.stdout.readline() == "ready\n"
    return process


def test_a_writer_that_is_killed_leaves_the_file_whole(tmp_path):
    path = tmp_path / "fit.json"
    path.write_text(OTHER)
    for wait in (0.0, 0.003, 0.011, 0.031):
        process = writer(path, "a", 1_000_000)
        time.sleep(wait)
        process.kill()
        process.communicate()
        assert path.read_text() in (ONE, OTHER)


def test_two_writers_leave_the_file_of_one(tmp_path):
    path = tmp_path / "fit.json"
    both = [writer(path, letter, 20) for letter in "ab"]
    seen = set()
    while any(process.poll() is None for process in both):
        if path.exists():
            seen.add(path.read_text())
    for process in both:
        process.communicate()
        assert process.returncode == 0
    assert seen | {path.read_text()} <= {ONE, OTHER}
    assert [each.name for each in tmp_path.iterdir()] == ["fit.json"]  # nothing left beside it


def test_a_full_disk_is_said_and_the_old_file_stays(tmp_path):
    """A limit on the size of files ends a write as a full disk does: half way."""
    path = tmp_path / "poses.csv"
    path.write_text("old")
    command = [sys.executable, "-c", FULL, "simulate", "irb120", "--poses", "100", "-o", str(path)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert done.stderr == f"error: {path}: cannot be written (File too large)\n"
    assert path.read_text() == "old"
    assert [each.name for each in tmp_path.iterdir()] == ["poses.csv"]


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="there is no /dev/full")
def test_a_full_stdout_is_said():
    with open("/dev/full", "w") as full:
        done = subprocess.run(
            [sys.executable, "-m", "minimax_cal.cli", "robots", "--json"],
            stdout=full, stderr=subprocess.PIPE, text=True, check=False,
        )  # fmt: skip
    assert done.returncode == 1
    assert done.stderr == "error: the output cannot be written (No space left on device)\n"
