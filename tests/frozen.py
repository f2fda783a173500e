"""What comes out of two versions of the project, compared as numbers.

    python tests/frozen.py [REVISION] [--rel 1e-9] [--only WORD]

For changes of the code that must not change results: REVISION (default: HEAD) in a worktree of its
own and the working tree run the same commands on the same files (`tests/frozen_inputs`, and real
arms of `../shared/data` where they are there).  Every number, word and exit code is compared, and
every byte of an export; times and versions aside, and what stands in GONE, ADDED, CHANGED and
RENAMED.  Answers of a revision are kept outside git (results/frozen), for they do not change.
"""

from __future__ import annotations

import argparse
import contextlib
import hashlib
import io
import json
import os
import re
import shlex
import shutil
import subprocess
import sys
import time
import traceback
from collections.abc import Iterator
from fnmatch import fnmatchcase
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parent.parent
INPUTS = ROOT / "tests" / "frozen_inputs"
STORE = ROOT / "results" / "frozen"

# What differs on purpose from the version before: patterns of the paths that are printed (* is
# anything), and why.  GONE: only before.  ADDED: only now.  CHANGED: another value.
GONE: dict[str, str] = {}
ADDED: dict[str, str] = {}
CHANGED: dict[str, str] = {
    "import leica/stdout*": "a table breaks no path",
    "import wrong/stdout*": "a table breaks no path",
    "gap logs/files/driven.gap.json/notices": "what other simulators leave out of a file is said",
    **dict.fromkeys(
        ("gap poses/files/posed.xml/*", "export mjcf again/files/*", "export effects mjcf/files/*"),
        "a gain that carries a deflection says so in the file",
    ),
    "relative diagnose/*": "a law turns the flange, not the place where a target once was",
    "gap logs/stderr*": "what other simulators leave out of a file is said",
    "*/files/*_friction.py/*": "laws of the module are written from their one statement",
}
RENAMED: dict[str, str] = {}  # keys of before by what they are called now
# What rounding leaves of larger numbers, and how far off it may be: a difference of coordinates of
# metres, a certificate.
ROUNDING = {
    **dict.fromkeys(("*_mm*", "*_mrad*", "*_deg*", "*/power", "*multiplier", "*/gap"), 1e-9),
    **dict.fromkeys(("*/kkt*", "*violation", "*qp_residual"), 1e-8),
    "*/arrays/*": 1e-11,
}
TIMES = {"seconds", "versions", "date", "cpu_seconds"}  # keys that no two runs share
NUMBER = re.compile(r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?")
# What no two runs share: progress, durations, hashes of files that hold one.
CLOCKED = re.compile(
    r"^(?:progress: |compiling kernels ).*\n|\b\d+\.\d+ s\b|\b[0-9a-f]{64}\b", re.M
)

# name: command.  @ is a file of INPUTS; others were written by the commands above.
COMMANDS = """
calibrate plain: calibrate irb2600 @plain.csv --bootstrap 20 -o plain.json
calibrate effects: calibrate irb2600 @plain.csv --effects joint_compliance:all,backlash:J5 -o effects.json
calibrate huber: calibrate irb2600 @plain.csv --loss huber --objective sum --details -o huber.json
calibrate trim: calibrate irb2600 @arms/outliers.irb2600.csv --trim 0.03 --objective point -o trim.json
calibrate prior: calibrate irb2600 @plain.csv --prior a*=0.5mm --prior theta*=1mrad --objective sum --json
calibrate one: calibrate irb2600 @plain.csv --objective smr:3 --effects joint_compliance:J2 --cv --json
calibrate pose: calibrate irb2600 @plain.csv --objective pose --lever 300 --json
calibrate bfgs: calibrate irb2600 @plain.csv --hessian bfgs --qp clarabel --distance squared --json
calibrate fixed: calibrate irb2600 @plain.csv --fix d2,beta* --method nllm --json
calibrate base: calibrate irb2600 @plain.csv --objective sum --holdout 0 -o base.json
calibrate sessions: calibrate irb2600 @plain.csv @moved.csv --objective sum --json
calibrate moved: calibrate irb2600 @moved.csv --objective sum -o moved.json
calibrate pixels: calibrate ur5 {pixels} -o pixels.json
calibrate pixels minimax: calibrate ur5 {pixels} --objective minimax --json
evaluate plain: evaluate plain.json @moved.csv --new-frame --json
evaluate effects: evaluate effects.json @plain.csv --json
compensate plain: compensate plain.json @targets.csv -o corrected.csv
compensate effects: compensate effects.json @targets.csv --json
compensate rapid: compensate base.json @program.mod --tool tGrip --wobj wTable -o corrected.mod
compensate krl: compensate plain.json @program.dat -o corrected.dat
map effects: map effects.json --samples 2000 --json
map base: map base.json @plain.csv --samples 2000 --frame base --json
iso9283 effects: iso9283 effects.json --poses --json
report plain: report plain.json --date 2026-01-01 --tolerance "rms 0.2, max 0.5" -o plain.html
compare: compare base.json moved.json --json
check: check base.json @plain.csv --tolerance "rms 0.5" --json
check moved: check base.json @moved.csv --tolerance "rms 0.2" -o checked.json
import leica: import @makers/tracker.csv --joints @makers/kalib.dat -o leica.csv
import sa: import @makers/points.csv --joints @makers/calib.script --json
import wrong: import @plain.csv --mend reverse --leave-out 12:smr2=bumped -o mended.csv
import log: import @makers/rtde.csv -o log.csv
identify: identify @sweeps.csv --joints revolute,revolute,revolute,prismatic,revolute -o found.json
calibrate identified: calibrate found.json @sweeps.csv --objective sum --json
plan: plan ur10 --poses 12 --candidates 80 --json
plan fit: plan irb2600 --poses 6 --fit effects.json --candidates 60 -o plan.csv
plan separate: plan irb2600 --poses 4 --fit base.json --candidates 40 --separate joint_compliance:J2 link_bending:L2 --json
plan motion: plan irb2600 --motion --duration 6 --payload 2 -o motion.csv --waypoints ways.csv
effects: effects irb2600 @plain.csv --json
robots: robots --json
simulate: simulate ur10 --poses 9 --compliance 2 -o simulated.csv --truth truth.json
relative wires: relative irb2600 @wires.csv --json
relative poses: relative irb2600 @poses.csv -o relative.json
relative closures: relative irb2600 @closures.csv --json
relative contacts: relative irb2600 @contacts.csv --json
relative effects: relative irb2600 @wires.csv @closures.csv --effects joint_compliance --json
relative diagnose: relative irb2600 @wires.csv @poses.csv --diagnose --json
relative pixels: relative ur5 @cell/poses.csv {pixels} --json
report relative: report relative.json --date 2026-01-01 -o relative.html
diagnose sessions: diagnose irb2600 @plain.csv @moved.csv --json
report diagnosis: report compliance.gap.json --date 2026-01-01 -o diagnosis.html
evaluate diagnosis: evaluate compliance.gap.json @arms/compliance.irb2600.csv --step 1 --json
compensate diagnosis: compensate compliance.gap.json @targets.csv --json
export drawn urdf: export irb2600 --to urdf -o drawn.urdf
export drawn mjcf: export irb2600 --to mjcf -o drawn.xml
export urdf again: export plain.json --to urdf --urdf drawn.urdf -o again.urdf
export mjcf again: export effects.json --to mjcf --mjcf drawn.xml -o again.xml
export diagnosis: export compliance.gap.json --to json -o diagnosed.json
calibrate posed: calibrate ur10 @posed/poses.csv --objective sum --effects joint_compliance:all -o posed.json
gap poses: gap @posed/arm.xml @posed/poses.csv --fit posed.json --write posed.xml -o posed.gap.json
torques: torques @driven/arm.xml @driven/run0.csv @driven/run1.csv @driven/run2.csv --write still.xml -o torques.json
evaluate torques: evaluate torques.json @driven/run2.csv --json
report torques: report torques.json --date 2026-01-01 -o torques.html
gap logs: gap @driven/arm.xml @driven/run0.csv @driven/run1.csv @driven/run2.csv --write driven.xml -o driven.gap.json
"""  # noqa: E501
PIXELS = (
    "--pixels @cell/detections.csv --joints @cell/joints.csv --camera cam0=@cell/cam0.yaml "
    "--board @cell/board.csv --camera-on flange"
)
DIAGNOSED = "diagnose {0}: diagnose @arms/{1}.json @arms/{0}.{1}.csv -o {0}.gap.json"
EXPORTED = "export {0} {1}: export {0}.json --to {1} --experimental -o {0}.as.{1}"
FORMATS = ("urdf", "ur-yaml", "ros-yaml", "ros2-control", "dh-csv", "json", "moc", "mjcf")
# Real arms, $ being their folder; each by another objective and in another format.
REAL = {
    "fanuc_r2000": ("sum", "ros-yaml"),
    "irb120": ("point", "moc"),
    "meca500_r": ("point", "dh-csv"),
    "qkm_hl6": ("smr:2", "json"),
    "ur10_b": ("sum", "ur-yaml"),
}
OF_REAL = """
calibrate {0}: calibrate ${0}/robot.json ${0}/measurements.csv -o {0}.json
calibrate {0} otherwise: calibrate ${0}/robot.json ${0}/measurements.csv --objective {1} --json
diagnose {0}: diagnose ${0}/robot.json ${0}/measurements.csv -o {0}.gap.json
report {0}: report {0}.json {0}.gap.json --date 2026-01-01 -o {0}.html
export {0} {2}: export {0}.json --to {2} --experimental -o {0}.as.{2}
"""
MOTION = """
torques ur10e: torques $ur10e_torque/ur10e.urdf {logs} --drive-gain 14.87,13.26,11.13,10.62,11.03,11.47 -o ur10e.json
evaluate ur10e: evaluate ur10e.json $ur10e_torque/20_02_12-40sec_12harm.csv --json
"""  # noqa: E501
LOGS = ("05-20sec_8harm", "06-20sec_10harm", "06-20sec_5harm", "10-20sec_7harm")


def cases(shared: Path) -> dict[str, list[str]]:
    """Commands by name, in an order in which later ones may read what earlier ones wrote."""
    arms = sorted(path.name.split(".")[:2] for path in (INPUTS / "arms").glob("*.csv"))
    lines = [DIAGNOSED.format(*arm) for arm in arms]
    lines += COMMANDS.strip().format(pixels=PIXELS).splitlines()
    lines += [EXPORTED.format(fit, to) for fit in ("plain", "effects") for to in FORMATS]
    if shared.is_dir():
        for arm, chosen in REAL.items():
            lines += OF_REAL.strip().format(arm, *chosen).splitlines()
        logs = " ".join(f"$ur10e_torque/20_02_{name}.csv" for name in LOGS)
        lines += MOTION.strip().format(logs=logs).splitlines()
    pairs = (line.split(": ", 1) for line in lines)
    files = {name: command.replace("@", f"{INPUTS}/") for name, command in pairs}
    return {
        name: shlex.split(command.replace("$", f"{shared}/")) for name, command in files.items()
    }


def chosen_cases(all_cases: dict[str, list[str]], only: str) -> dict[str, list[str]]:
    """Those whose name holds a word, after those that write what they read."""
    needed, out = set[str](), []
    for name, command in reversed(all_cases.items()):
        if only in name or needed & {word for word in command if word == output_of(command)}:
            needed |= set(command)
            out.append(name)
    return {name: all_cases[name] for name in reversed(out)}


def output_of(command: list[str]) -> str:
    """The file that -o names."""
    return command[command.index("-o") + 1] if "-o" in command else ""


# ---- one revision --------------------------------------------------------------------------------


def run(tree: Path, out: Path, shared: Path, only: str) -> None:
    """Run commands with the code in a tree; leave what each said and wrote in a folder."""
    sys.path[:0] = [str(tree)]
    os.chdir(out)
    from minimax_cal.cli import main

    assert Path(sys.modules["minimax_cal"].__file__ or "").is_relative_to(tree)
    for name, command in chosen_cases(cases(shared), only).items():
        before = {path: path.stat().st_mtime_ns for path in out.rglob("*")}
        said, told, began = io.StringIO(), io.StringIO(), time.process_time()
        code: Any = 0
        with contextlib.redirect_stdout(said), contextlib.redirect_stderr(told):
            try:
                main(command)
            except SystemExit as end:
                code = end.code
            except Exception:
                code = traceback.format_exc()
        seconds = time.process_time() - began
        files = {
            str(path.relative_to(out)): path.read_bytes().decode("utf-8", "surrogateescape")
            for path in sorted(out.rglob("*.*"))
            if path.is_file()
            and path.suffix not in (".answer", ".txt")
            and before.get(path) != path.stat().st_mtime_ns
        }
        answer = {"code": code, "stdout": said.getvalue(), "stderr": told.getvalue(),
                  "files": files, "cpu_seconds": seconds}  # fmt: skip
        text = json.dumps(answer).replace(str(out), "")
        (out / f"{name}.answer").write_text(text)
        print(f"{seconds:7.1f} {name}: {code}", flush=True)


class Page(HTMLParser):
    """What a page shows: text, and the JSON of its plots."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.parts: list[str] = []
        self.hidden = False
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        """Style and program are not shown; data of plots are."""
        data = ("type", "application/json") in attrs
        self.hidden = tag == "style" or (tag == "script" and not data)

    def handle_endtag(self, tag: str) -> None:
        """Shown again."""
        self.hidden = False

    def handle_data(self, data: str) -> None:
        """Text between tags."""
        if not self.hidden and data.strip():
            self.parts.append(data.strip())


def content(name: str, text: str) -> Any:
    """An output as something that compares: JSON as it is, other text as words and numbers."""
    if name.endswith(".html"):
        return [content("", part) for part in Page(text).parts]
    try:
        return json.loads(text)
    except ValueError:
        lines = CLOCKED.sub("", text).splitlines()
    return [[re.sub(r"\s+", " ", NUMBER.sub("#", line)), *map(float, NUMBER.findall(line))]
            for line in lines]  # fmt: skip


def answer_of(folder: Path, name: str) -> dict[str, Any]:
    """What a command did, its outputs as what compares; of a file for others its bytes too."""
    found: dict[str, Any] = json.loads((folder / f"{name}.answer").read_text())
    found["stderr"] = content("", found["stderr"])
    if not found["stdout"].startswith("{"):  # a table may be laid out in another way
        words = CLOCKED.sub("", found["stdout"]).replace("\N{BOX DRAWINGS LIGHT HORIZONTAL}", "")
        found["stdout"] = " ".join(sorted(set(words.split())))
    found["stdout"] = content("", found["stdout"])
    for file, text in found["files"].items():
        mine = Path(file).suffix in (".json", ".csv", ".html") and not name.startswith("export")
        numbers = content(file, text)
        found["files"][file] = numbers if mine else {"as numbers": numbers, "bytes": text}
    return found


# ---- two revisions -------------------------------------------------------------------------------


def differences(one: Any, other: Any, rel: float, at: str) -> Iterator[str]:
    """Where two contents differ, but for what the tables accept."""
    for place, what, off in unlike(one, other, rel, at):
        least = max((ROUNDING[name] for name in ROUNDING if fnmatchcase(place, name)), default=0.0)
        table = {ONLY_BEFORE: GONE, ONLY_NOW: ADDED}.get(what, CHANGED)
        if not (off <= least or any(fnmatchcase(place, pattern) for pattern in table)):
            yield f"{place}: {what}"


ONLY_BEFORE, ONLY_NOW, WHOLLY = "only before", "only now", float("inf")
Unlike = tuple[str, str, float]


def unlike(one: Any, other: Any, rel: float, at: str) -> Iterator[Unlike]:
    """Where, how and how far; a number may be off relative to the largest beside it."""
    if isinstance(one, dict) and isinstance(other, dict):
        one = {RENAMED.get(key, key): value for key, value in one.items()}
        for key in sorted((one.keys() | other.keys()) - TIMES):
            if key not in one or key not in other:
                yield f"{at}/{key}", ONLY_BEFORE if key in one else ONLY_NOW, WHOLLY
            else:
                yield from unlike(one[key], other[key], rel, f"{at}/{key}")
    elif isinstance(one, list) and isinstance(other, list):
        size = max((abs(x) for x in one if isinstance(x, int | float) and x == x), default=0.0)
        for i, (a, b) in enumerate(zip(one, other, strict=False)):
            if isinstance(a, int | float) and isinstance(b, int | float):
                if not close(a, b, rel, size):
                    yield f"{at}[{i}]", f"{a!r} and {b!r}", abs(a - b)
            else:
                yield from unlike(a, b, rel, f"{at}[{i}]")
        if len(one) != len(other):
            yield at, f"{len(one)} and {len(other)} entries", WHOLLY
    elif isinstance(one, int | float) and isinstance(other, int | float):
        if not close(one, other, rel, abs(one)):
            yield at, f"{one!r} and {other!r}", abs(one - other)
    elif one != other:
        yield at, f"{shown(one, other)} and {shown(other, one)}", WHOLLY


def shown(text: Any, other: Any) -> str:
    """A text from shortly before where it departs from another."""
    pairs = enumerate(zip(str(text), str(other), strict=False))
    start = next((i for i, (a, b) in pairs if a != b), 0)
    return repr(str(text)[max(start - 20, 0) : start + 80])


def close(a: float, b: float, rel: float, size: float) -> bool:
    """Whether two numbers are the same, to a share of a size."""
    return a == b or (a != a and b != b) or abs(a - b) <= rel * max(size, abs(b))


def git(*words: str) -> str:
    """What git answers."""
    done = subprocess.run(["git", "-C", str(ROOT), *words], check=True, capture_output=True)
    return done.stdout.decode().strip()


def started(tree: Path, out: Path, shared: Path, only: str) -> subprocess.Popen[bytes]:
    """A revision at work, in a process of its own."""
    shutil.rmtree(out, ignore_errors=True)
    out.mkdir(parents=True)
    command = [sys.executable, str(Path(__file__).resolve()), "--only", only]
    command += ["--inside", str(tree), str(out), str(shared)]
    log = (out / "log.txt").open("wb")
    return subprocess.Popen(
        command, stdout=log, stderr=log, env={**os.environ, "PYTHONPATH": str(tree)}
    )


def main() -> int:
    """Compare; 1 where something differs."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("revision", nargs="?", default="HEAD")
    parser.add_argument("--rel", type=float, default=1e-9, help="how far numbers may be off")
    parser.add_argument("--only", default="", help="commands whose name holds this")
    parser.add_argument("--inside", nargs=3, type=Path, help=argparse.SUPPRESS)
    chosen = parser.parse_args()
    if chosen.inside:
        run(*chosen.inside, chosen.only)
        return 0
    single = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MINIMAX_CAL_NO_FSYNC")
    os.environ |= dict.fromkeys(single, "1")
    common = git("rev-parse", "--path-format=absolute", "--git-common-dir")
    shared = Path(common).parent.parent / "shared" / "data"  # beside the first of all worktrees
    commit, asked = git("rev-parse", chosen.revision), cases(shared)
    names = list(chosen_cases(asked, chosen.only))
    if not names:
        raise SystemExit(f"no command's name holds {chosen.only!r}: nothing is compared")
    if not shared.is_dir():
        print(f"skipped: real arms, for {shared} is not there")
    mark = hashlib.sha256(json.dumps(asked).encode())
    for path in sorted(INPUTS.rglob("*.*")):
        mark.update(path.read_bytes())
    before, now = STORE / f"{commit[:12]}-{mark.hexdigest()[:8]}", STORE / "now"
    tree = STORE / "tree"
    running = [started(ROOT, now, shared, chosen.only)]
    if not (before / "done").exists():
        if tree.exists():
            git("worktree", "remove", "--force", str(tree))
        git("worktree", "add", "--detach", str(tree), commit)
        running.append(started(tree, before, shared, ""))
    if sum(process.wait() != 0 for process in running):
        raise SystemExit(f"a revision could not be run; see {STORE}/*/log.txt")
    (before / "done").write_text("")
    found = [
        line
        for name in names
        for line in differences(answer_of(before, name), answer_of(now, name), chosen.rel, name)
    ]
    print("\n".join(found[:200]))
    spent = sum(json.loads((now / f"{name}.answer").read_text())["cpu_seconds"] for name in names)
    print(f"{len(names)} commands in {spent:.0f} s of a processor; "
          f"{len(found)} differences from {commit[:12]} at {chosen.rel:g} relative")  # fmt: skip
    return int(bool(found))


if __name__ == "__main__":
    sys.exit(main())
