"""Runs a case within limits of time and memory, and judges what came of it."""

from __future__ import annotations

import io
import json
import multiprocessing
import os
import re
import resource
import signal
import tempfile
import time
import traceback
import warnings
from collections.abc import Callable, Iterable, Iterator
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass
from functools import cache
from itertools import pairwise
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import minimax_cal as mc
from minimax_cal.cli import main
from minimax_cal.core.errors import CalibrationError

from .cases import Case, case
from .known import disagreement
from .material import MADE, material
from .mutations import MARKUP

PROCESSOR, WALL = 60.0, 1200.0  # of a case [s]; the second for machines with other work
MEMORY = 6 << 30  # of a process that runs cases [bytes]
KINDS = (
    "ok", "refusal", "failure", "traceback", "hang", "memory", "crash", "silently wrong", "unclear",
    "damage",
)  # fmt: skip
GOOD = ("ok", "refusal", "failure")
EVENT = '{"event": "error", '  # how --progress json begins the line of an error
INTERNALS = re.compile(
    r"operands could not|shapes? \(|ndarray|dtype|has no attribute|object is not|NoneType|KeyError|"
    r"IndexError|TypeError|ValueError|list index|out of bounds for|site-packages|\.py\b|<class"
)
CONTROL = re.compile(r"[\x00-\x08\x0b-\x1f\x7f-\x9f\u202a-\u202e\u2066-\u2069]")
DOUBT = re.compile(
    r"check|misses|implausibl|stand|off by|outside|suspect|outlier|far|swapped|mirror|handed|unit"
    r"|doubt"
)


@dataclass(frozen=True)
class Outcome:
    """How a case ended.  detail: the evidence where it is none of GOOD."""

    number: int
    command: str
    kind: str
    detail: str
    broke: tuple[str, ...]
    seconds: float


def outcome(one: Case) -> Outcome:
    """Run a case here and judge it."""
    began = time.perf_counter()
    before = Path.cwd()
    with tempfile.TemporaryDirectory(prefix="fuzz") as folder:
        os.chdir(folder)
        try:
            for name, raw in one.files.items():
                Path(name).write_bytes(raw)
            Path("loop").symlink_to("loop")
            kind, detail = judged(one)
        finally:
            os.chdir(before)
    seconds = time.perf_counter() - began
    return Outcome(one.number, one.command, kind, detail[:400], one.broke, seconds)


def judged(one: Case) -> tuple[str, str]:
    """The kind of what came of a case in the current folder, and the evidence."""
    said, told = io.StringIO(), io.StringIO()
    code: Any = 0
    with warnings.catch_warnings(record=True) as warned:
        warnings.simplefilter("always")
        warnings.filterwarnings("ignore", "Loky-backed")  # of daemons, as these processes are
        try:
            with redirect_stdout(said), redirect_stderr(told):
                main(list(one.arguments))
        except SystemExit as ended:
            code = ended.code or 0
        except BaseException:
            return "traceback", traceback.format_exc()[-400:]
    out, err = said.getvalue(), told.getvalue()
    read = [name for name in one.files if name not in outputs(one.arguments)]
    if changed := [name for name in read if not kept(name, one.files[name])]:
        return "damage", f"{changed} changed"
    if warned:
        first = warned[0]
        return "unclear", f"warning {first.message} at {first.filename}:{first.lineno}"
    if "not enough memory" in err:
        return "memory", err[-300:]
    found = manners(one, code, out, err) or truth(one, code, out, err)
    return found or (unread(one) if not code else None) or (kind_of(code), "")


def outputs(arguments: tuple[str, ...]) -> set[str]:
    """Files that a command may replace: named as an output, and not as an input too."""
    pairs = pairwise(arguments)
    named = [
        word for flag, word in pairs if flag in ("-o", "--output", "--figure", "--truth", "--write")
    ]
    return {word for word in named if arguments.count(word) == named.count(word)}


def kept(name: str, raw: bytes) -> bool:
    """Whether an input is what it was."""
    return Path(name).is_file() and Path(name).read_bytes() == raw


def kind_of(code: int) -> str:
    """Of an exit code."""
    return {0: "ok", 1: "failure", 2: "refusal"}.get(code, "crash")


def manners(one: Case, code: int, out: str, err: str) -> tuple[str, str] | None:
    """What is wrong with how a command spoke, if anything."""
    errors = [line for line in err.splitlines() if line.startswith(("error: ", EVENT))]
    added = [path.name for path in Path().iterdir() if path.name not in {*one.files, "loop"}]
    if code not in (0, 1, 2):
        return "crash", f"exit code {code!r}"
    if "Traceback" in out + err:
        return "traceback", err[-300:]
    if code and len(errors) != 1 and not out.startswith("Usage"):
        return "unclear", f"exit {code} with {len(errors)} lines of error: {err[-200:]!r}"
    if any(INTERNALS.search(line) for line in errors):
        return "unclear", f"speaks of its inside: {errors[0]}"
    shown = err if one.command == "compensate" else out + err  # whose stdout is a file, in a pipe
    if control := CONTROL.search(shown.replace("\r\n", "\n")):
        return "unclear", f"prints {control[0]!r}"
    if any(len(line) > 1100 for line in err.splitlines()):
        return "unclear", "a line of more than 1100 letters"
    if code == 2 and added:
        return "damage", f"refused, and left {added}"
    if "--json" in one.arguments and code == 0 and out and not out.startswith("Usage"):
        try:
            json.loads(out, parse_constant=lambda word: 1 / 0)
        except (ValueError, ZeroDivisionError):
            return "unclear", f"no JSON: {out[:200]!r}"
    return None


def truth(one: Case, code: int, out: str, err: str) -> tuple[str, str] | None:
    """What is wrong with the answer of a success, if that is known."""
    if code:
        return None
    page = Path("out.html")
    if page.exists() and MARKUP in page.read_text():
        return "silently wrong", "a page that runs what a file holds"
    if one.expect == "noticed" and not DOUBT.search(err):
        return "silently wrong", f"not a word on {one.broke}"
    if not out.startswith("{") or "data.csv" not in one.arguments or "later.csv" in one.arguments:
        return None
    fit = one.arguments[1] if one.command == "evaluate" else ""
    if one.command == "calibrate" or fit in one.files:
        try:
            nominal = ("--rung", "0") in pairwise(one.arguments)
            moved = "--new-frame" in one.arguments
            said = disagreement(out, one.files["data.csv"], one.files.get(fit), nominal, moved)
        except (ValueError, KeyError, IndexError, TypeError):
            return None  # broken in a way that the independent reader does not follow
        if said:
            return "silently wrong", said
    if one.expect == "same" and fit in one.files:
        now, then = json.loads(out)["accuracy"], good_accuracy(fit)
        if abs(now["rms_mm"] - then) > 1e-5:
            return "silently wrong", f"{now['rms_mm']} mm, {then} mm before the files were changed"
    return None


def still(path: Path) -> None:
    """A model is compiled and stays finite for half a second.  Raises ValueError."""
    import mujoco

    model = mujoco.MjModel.from_xml_path(str(path))
    data = mujoco.MjData(model)
    mujoco.mj_step(model, data, min(2_000, int(0.5 / model.opt.timestep) + 1))
    warned = mujoco.mjtWarning
    if any(data.warning[kind].number for kind in (warned.mjWARN_BADQPOS, warned.mjWARN_BADQACC)):
        raise ValueError("it is unstable")


def measured(path: Path) -> None:
    """Measurements, or logs of motions, are read.  Raises CalibrationError."""
    header = path.read_text(encoding="utf-8-sig").split("\n", 1)[0]
    is_log = "t_s" in header.split(",")
    mc.read_runs([path]) if is_log else mc.read_measurements(path)


def robot(path: Path) -> None:
    """A robot is read.  Raises CalibrationError."""
    mc.load_robot(path)


READERS: dict[tuple[str, str], Callable[[Path], None]] = {  # of what a command writes, by ending
    ("import", ".csv"): measured,
    ("simulate", ".csv"): measured,
    ("gap", ".xml"): still,
    ("export --to json", ".json"): robot,
    ("export --to urdf", ".urdf"): robot,
}


def unread(one: Case) -> tuple[str, str] | None:
    """What a success wrote and its own reader refuses."""
    form = [word for flag, word in pairwise(one.arguments) if flag == "--to"]
    command = " --to ".join([one.command, *form[-1:]])
    for name in outputs(one.arguments):
        reader = READERS.get((command, Path(name).suffix))
        if reader and Path(name).is_file():
            try:
                reader(Path(name))
            except (ValueError, CalibrationError) as error:
                return "silently wrong", f"{name} was written and is not read: {error}"
    return None


@cache
def good_accuracy(fit: str) -> float:
    """What `evaluate` says of the unbroken files [mm]."""
    with tempfile.TemporaryDirectory() as folder:
        for name in (fit, "data.csv"):
            (Path(folder) / name).write_bytes(material()[name])
        cell = mc.load_cell(Path(folder) / fit)
        return mc.evaluate(cell, mc.read_measurements(Path(folder) / "data.csv")).rms_mm


# ---- a process for cases -----------------------------------------------------------------------


def work(pipe: Connection, files: dict[str, bytes]) -> None:
    """Run the cases whose numbers arrive; too much time or memory ends the process."""
    MADE.update(files)
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
    signal.signal(signal.SIGPROF, signal.SIG_DFL)
    while True:
        seed, number = pipe.recv()
        if number < 0:
            return
        one = case(seed, number)
        signal.setitimer(signal.ITIMER_PROF, PROCESSOR)
        pipe.send(outcome(one))
        signal.setitimer(signal.ITIMER_PROF, 0.0)


def outcomes(seed: int, numbers: Iterable[int]) -> Iterator[Outcome]:
    """Run cases one after the other in a process that is replaced when it ends."""
    context = multiprocessing.get_context("spawn")
    process, pipe = None, None
    for number in numbers:
        if process is None:
            pipe, inner = context.Pipe()
            process = context.Process(target=work, args=(inner, material()), daemon=True)
            process.start()
            inner.close()
        assert pipe is not None
        pipe.send((seed, number))
        try:
            found = pipe.recv() if pipe.poll(WALL) else None
        except EOFError:
            found = None
        if found is None:
            process.kill() if process.exitcode is None and not waited(process) else None
            yield ended(case(seed, number), process.exitcode)
            process = None
        else:
            yield found
    if process is not None and pipe is not None:
        pipe.send((seed, -1))
        process.join(10.0)


def waited(process: Any) -> bool:
    """Whether a process that hung up has come to its end."""
    process.join(2.0)
    return process.exitcode is not None


def ended(one: Case, code: int | None) -> Outcome:
    """The outcome of a case that took its process along."""
    hang = code is None or code in (-signal.SIGPROF, -signal.SIGKILL)
    kind = "hang" if hang else "crash"
    return Outcome(one.number, one.command, kind, f"process ended with {code}", one.broke, WALL)
