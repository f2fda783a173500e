"""Commands where something is missing, refused or ends: a result or one line, and whole files."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from hashlib import sha256
from pathlib import Path

import pytest
from conftest import run
from fuzz.material import material
from measuring.test_exports import workbook

from minimax_cal.core import files, write_journal
from minimax_cal.core.errors import CalibrationError

POSIX = pytest.mark.skipif(sys.platform == "win32", reason="limits and signals are those of POSIX")
PATIENCE = 60.0  # seconds
# The modules of all extras.  joblib and jinja2 come with OSQP today, which need not stay so.
EXTRAS = (
    "matplotlib", "quadprog", "piqp", "numba", "mujoco", "pooch", "plotly", "starlette", "uvicorn",
    "h11", "rosbags", "python_calamine", "dask", "distributed", "pandas",
)  # fmt: skip
CORE_ALONE = """
import contextlib, importlib.machinery, io, json, sys
absent = set(sys.argv[1].split(","))
found = importlib.machinery.PathFinder.find_spec
def find_spec(name, path=None, target=None):
    return None if name.partition(".")[0] in absent else found(name, path, target)
importlib.machinery.PathFinder.find_spec = find_spec
from minimax_cal.cli.command_runner import run_command_line
for line in sys.argv[2:]:
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        code = run_command_line(line.split())
    print(json.dumps([line, code, err.getvalue()]))
"""
NAMED = {  # a command line, and what it says to install; "" where it needs nothing more
    "robots": "",
    "backends": "",
    "simulate irb120 --poses 12 -o made.csv": "",
    "import data.csv -o again.csv": "",
    "calibrate irb120 data.csv --objective sum -o fit2.json": "",
    "evaluate fit.json data.csv": "",
    "export fit.json --to urdf -o arm.urdf": "",
    "export fit.json --to mjcf -o mjcf.xml": "",
    "compensate fit.json targets.csv -o out.csv": "",
    "calibrate irb120 data.csv --figure a.png": ".[plot]",
    "calibrate irb120 data.csv -o a.svg": ".[plot]",
    "map fit.json --samples 100 -o m.png": ".[plot]",
    "plan irb120 --poses 4 --figure a.pdf": ".[plot]",
    "report fit.json -o a.html": ".[report]",
    "report motion.json -o a.html": ".[report]",
    "serve --no-browser": ".[app]",
    "serve": ".[app]",
    "calibrate irb120 book.xlsx": ".[xlsx]",
    "import book.ods -o b.csv": ".[xlsx]",
    "calibrate book.xls data.csv": ".[xlsx]",
    "import log.bag -o b.csv": ".[logs]",
    "diagnose links.json log.mcap": ".[logs]",
    "calibrate arm.xml data.csv": ".[mujoco]",
    "gap arm.xml data.csv": ".[mujoco]",
    "gap links.xml run1.csv run2.csv --write w.xml": ".[mujoco]",
    "torques links.json run1.csv run2.csv --write w.xml": ".[mujoco]",
    "diagnose irb120 data.csv --cluster tcp://127.0.0.1:1": ".[distributed]",
    "calibrate irb120 data.csv --objective minimax --qp piqp --json": "piqp",
}


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a good file of every kind."""
    folder = tmp_path_factory.mktemp("material")
    for name, content in material().items():
        (folder / name).write_bytes(content)
    for name in ("book.xlsx", "book.xls", "book.ods", "log.bag", "log.mcap"):
        (folder / name).write_bytes(b"PK")
    return folder


def started(folder: Path, *words: object) -> subprocess.Popen[str]:
    """A process of Python."""
    return subprocess.Popen(
        [sys.executable, *map(str, words)], cwd=folder, text=True,
        stdout=subprocess.PIPE, stderr=subprocess.PIPE,
    )  # fmt: skip


def digest(folder: Path) -> dict[str, str]:
    return {path.name: sha256(path.read_bytes()).hexdigest() for path in folder.iterdir()}


# ---- what is missing -----------------------------------------------------------------------------


def test_without_any_extra_a_command_runs_or_says_what_to_install(made):
    """From a clone: no index has the package."""
    process = started(made, "-c", CORE_ALONE, ",".join(EXTRAS), *NAMED)
    out, err = process.communicate(timeout=10 * PATIENCE)
    assert process.returncode == 0, err
    said = {line: (code, text) for line, code, text in map(json.loads, out.splitlines())}
    assert said.keys() == NAMED.keys()
    for line, extra in NAMED.items():
        code, text = said[line]
        assert "Traceback" not in text, text
        assert "minimax-cal[" not in text, text
        if extra.startswith("."):
            assert code == 2, (line, text)
            (error,) = (words for words in text.splitlines() if words.startswith("error: "))
            assert f'pip install "{extra}" in a clone of the repository' in error, (line, text)
            assert text.endswith(f"{error}\n"), (line, text)
        else:
            assert code == 0, (line, text)
            assert f"pip install {extra}" in text or not extra, (line, text)


# ---- what is refused -----------------------------------------------------------------------------


@POSIX
def test_a_workbook_is_read_where_no_limit_can_be_set(tmp_path, monkeypatch):
    """As on every Mac, which refuses limits of address space."""
    pytest.importorskip("python_calamine", reason='needs pip install ".[xlsx]"')
    (tmp_path / "sitecustomize.py").write_text(
        "import resource\n"
        "def refuse(kind, limits):\n"
        "    raise ValueError('current limit exceeds maximum limit')\n"
        "resource.setrlimit = refuse\n"
    )
    path = tmp_path / "book.xlsx"
    rows = [
        ["q1_deg", "smr1_x_mm", "smr1_y_mm", "smr1_z_mm"],
        *([i, i, 2 * i, 3] for i in range(5)),
    ]
    path.write_bytes(workbook(rows))
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(tmp_path), *sys.path]))
    assert run("import", path, "-o", tmp_path / "out.csv") == 0
    assert len((tmp_path / "out.csv").read_text().splitlines()) == 6


@POSIX
@pytest.mark.parametrize("mebibytes", [60, 150, 190, 240, 600, 1000])
def test_a_small_address_space_is_one_line(mebibytes, made):
    """OpenBLAS would wait for ever, or abort."""
    limited = (
        f"import resource; resource.setrlimit(resource.RLIMIT_AS, ({mebibytes << 20},) * 2); "
        "from minimax_cal.cli import main; main()"
    )
    process = started(made, "-c", limited, "import", "data.csv", "-o", "none.csv")
    _, err = process.communicate(timeout=PATIENCE)
    assert process.returncode == 1, err
    assert err == (f"error: this process may map {mebibytes} MiB (ulimit -v); it needs 1024 MiB\n")
    assert not (made / "none.csv").exists()


@pytest.mark.parametrize(
    ("error", "code"),
    [(MemoryError(), 1), (OSError(12, "Cannot allocate memory"), 1),
     (ImportError("libx.so: failed to map segment from shared object"), 1)],
)  # fmt: skip
def test_too_little_memory_is_one_line(error, code, tmp_path, monkeypatch, capsys):
    def fail(*_: object) -> None:
        raise error

    monkeypatch.setattr("minimax_cal.cli.simulate.simulate", fail)
    assert run("simulate", "irb120", "-o", tmp_path / "out.csv") == code
    said = capsys.readouterr().err
    assert said == "error: there is not enough memory for this; give fewer poses or samples\n"
    assert list(tmp_path.iterdir()) == []


WRITERS = (
    "simulate irb120 --poses 8 -o one.csv --truth two.json",
    "calibrate irb120 data.csv --objective sum -o one.json --figure two.svg",
    "plan irb120 --motion --duration 6 --rows-per-second 20 -o one.csv --waypoints two.csv",
    "plan irb120 --poses 6 --candidates 40 -o one.csv --figure two.svg",
    "torques links.json run1.csv run2.csv -o one.json --figure two.svg",
)
SLOW_WRITERS = (
    "torques links.json run1.csv run2.csv --write one.xml -o two.json",
    "gap links.xml run1.csv run2.csv --write one.xml -o two.json",
    "gap arm.xml data.csv --fit fit.json --diagnosis diagnosis.json --write one.xml -o two.json",
)


@pytest.fixture
def folder(made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A copy of the good files, where commands run."""
    for path in made.iterdir():
        (tmp_path / path.name).write_bytes(path.read_bytes())
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.parametrize(
    "line", [*WRITERS, *(pytest.param(line, marks=pytest.mark.slow) for line in SLOW_WRITERS)]
)
def test_exit_2_means_that_nothing_was_written(line, folder, monkeypatch, capsys):
    """Also where all but the last of several files were written when the disk was full."""
    pytest.importorskip("matplotlib", reason='needs pip install ".[plot]"')
    written: list[Path] = []
    replace = files.replace_file_durably

    def counted(source: Path, path: Path) -> None:
        written.append(path)
        replace(source, path)

    monkeypatch.setattr(files, "replace_file_durably", counted)
    run(*line.split())
    assert len(written) >= 2, written
    assert all(path.exists() for path in written)
    said = capsys.readouterr().err
    assert all(f"written: {path.name}\n" in said for path in written)
    written[0].unlink()  # one that is new and one that is replaced
    written[-1].write_text("old")
    before, last = digest(folder), len(written)
    written.clear()

    def full(source: Path, path: Path) -> None:
        if len(written) == last - 1:
            raise OSError(28, "No space left on device")
        counted(source, path)

    monkeypatch.setattr(files, "replace_file_durably", full)
    assert run(*line.split()) == 2
    assert len(written) == last - 1
    assert digest(folder) == before
    said = capsys.readouterr().err
    assert "written:" not in said
    assert said.splitlines()[-1].endswith("cannot be written (No space left on device)")


@pytest.mark.parametrize("line", [*WRITERS, *SLOW_WRITERS])
def test_a_folder_that_is_read_only_is_one_line(line, folder, monkeypatch, capsys):
    """Before the work, not after it."""
    opened = os.open

    def refused(path: object, flags: int, *more: int) -> int:
        if flags & os.O_CREAT:
            raise OSError(30, "Read-only file system")
        return opened(path, flags, *more)  # type: ignore[arg-type]

    monkeypatch.setattr(files.os, "open", refused)
    before = digest(folder)
    began = time.process_time()
    assert run(*line.split()) == 2
    assert time.process_time() - began < 5.0
    (said,) = capsys.readouterr().err.splitlines()
    assert said.endswith("cannot be written (Read-only file system)")
    assert digest(folder) == before


def write_all(*paths: Path) -> None:
    with write_journal.undo_writes_on_error():
        for path in paths:
            files.write_file_atomically(path, "after")


def test_all_or_none_puts_back_what_was_there(tmp_path):
    old, new = tmp_path / "old", tmp_path / "new"
    old.write_text("before")
    missing = tmp_path / "none" / "new"
    with pytest.raises(CalibrationError):
        write_all(old, new, old, new, missing)
    assert {path.name: path.read_text() for path in tmp_path.iterdir()} == {"old": "before"}
    write_all(old)
    assert {path.name: path.read_text() for path in tmp_path.iterdir()} == {"old": "after"}


# ---- what ends -----------------------------------------------------------------------------------

WRITER = """
import sys
from minimax_cal.cli import TerminatedBySignal, raise_on_termination_signals
from minimax_cal.core.files import write_file_atomically
from minimax_cal.core.write_journal import undo_writes_on_error
raise_on_termination_signals()
print("ready", flush=True)
try:
    while True:
        with undo_writes_on_error():
            for name in sys.argv[1:]:
                write_file_atomically(name, b"new" * 100_000)
except (KeyboardInterrupt, TerminatedBySignal):
    sys.exit(3)
"""


@POSIX
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_signal_leaves_no_hidden_file(number, tmp_path, monkeypatch):
    """At any moment of writing several files."""
    monkeypatch.setenv(files.NO_FSYNC_VARIABLE, "1")
    for k in range(12):
        process = started(tmp_path, "-c", WRITER, "one", "two")
        assert process.stdout
        assert process.stdout.readline() == "ready\n"
        time.sleep(0.0037 * k)
        process.send_signal(number)
        process.communicate(timeout=PATIENCE)
        assert process.returncode == 3
        assert {path.name for path in tmp_path.iterdir()} <= {"one", "two"}


@POSIX
@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_a_command_that_is_ended_says_so(number, code, tmp_path):
    words = ("-m", "minimax_cal", "simulate", "irb120", "--poses", 200_000, "-o", "out.csv")
    process = started(tmp_path, *words)
    time.sleep(2.0)
    process.send_signal(number)
    _, err = process.communicate(timeout=PATIENCE)
    assert process.returncode == code, err
    assert err.splitlines()[-1] in ("error: interrupted", "error: terminated")
    assert list(tmp_path.iterdir()) == []


@POSIX
def test_a_server_that_is_ended_leaves_no_file_for_the_browser(tmp_path):
    pytest.importorskip("uvicorn", reason='needs pip install ".[app]"')
    browser = tmp_path / "browser"
    browser.write_text("#!/bin/sh\nexit 0\n")
    browser.chmod(0o755)
    sessions = tmp_path / "sessions"
    process = subprocess.Popen(
        [sys.executable, "-m", "minimax_cal", "serve", "--port", "0", "--folder", str(sessions)],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        env={**os.environ, "BROWSER": str(browser)},
    )  # fmt: skip
    assert process.stdout
    assert process.stdout.readline().startswith("http://")
    end = time.monotonic() + PATIENCE
    while not list(sessions.iterdir()):
        assert time.monotonic() < end
        time.sleep(0.02)
    time.sleep(1.0)
    process.terminate()
    process.communicate(timeout=PATIENCE)
    assert process.returncode == 143
    assert list(sessions.iterdir()) == []
