"""What comes out of two versions of the project, compared as numbers.

    python tests/frozen.py [REVISION] [--rel 1e-12] [--only WORD]

For changes of the code that must not change results: REVISION (default: HEAD) in a worktree of its
own and the working tree run the same commands on the same files, and every number, word and exit
code of theirs is compared; times, versions and the renames in RENAMED aside.  Answers of a
revision are kept outside git (results/frozen), for they do not change.
"""

from __future__ import annotations

import argparse
import contextlib
import hashlib
import inspect
import io
import json
import os
import re
import shutil
import subprocess
import sys
import traceback
from collections.abc import Iterator
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parent.parent
SHARED = ROOT.parent / "shared" / "data"
STORE = ROOT / "results" / "frozen"
REAL = ("fanuc_r2000", "irb120", "meca500_r", "qkm_hl6", "ur10_b")
OBJECTIVES = ("minimax", "sum", "point", "pose", "smr:2")
FORMATS = ("urdf", "ur-yaml", "ros-yaml", "ros2-control", "dh-csv", "json", "moc", "mjcf")
TIMES = {"seconds", "versions", "date", "cpu_seconds"}  # keys that no two runs share
ADDED = {"arrays", "widening", "size"}  # keys that only the later revision has
RENAMED: dict[str, str] = {}  # words of the earlier revision that were renamed on purpose
POWER, SEED = 300.0, 41
SEVERAL = 8  # pairs of effects, arms without a fault, arms of small effects
NUMBER = re.compile(r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?")
CLOCKED = re.compile(r"\b\d+\.\d+ s\b|\b[0-9a-f]{64}\b")  # a duration, a hash of a file with one


def cases(data: Path) -> Iterator[tuple[str, list[str]]]:
    """Names and commands, in an order in which later ones may read what earlier ones wrote."""
    calibrated = []
    for name in REAL:
        robot, measured = str(SHARED / name / "robot.json"), str(SHARED / name / "measurements.csv")
        if not Path(robot).exists():
            continue
        for objective in OBJECTIVES:
            fit = f"{name}_{objective.replace(':', '')}.json"
            yield f"calibrate {name} {objective}", [
                "calibrate", robot, measured, "--objective", objective, "-o", fit,
            ]  # fmt: skip
        calibrated += [f"{name}_minimax.json"]
        yield f"diagnose {name}", ["diagnose", robot, measured, "-o", f"{name}_gap.json"]
        yield f"report {name}", [
            "report", f"{name}_minimax.json", f"{name}_gap.json", "--date", "2026-01-01",
            "-o", f"{name}.html",
        ]  # fmt: skip
    arm, poses = "irb2600", str(data / "plain" / "data.csv")
    for name, options in {
        "plain": ["--bootstrap", "20"],
        "effects": ["--effects", "joint_compliance:all,backlash:J5"],
        "huber": ["--loss", "huber", "--objective", "sum"],
        "trim": ["--trim", "0.03", "--objective", "point"],
        "prior": ["--prior", "a*=0.5mm", "--prior", "theta*=1mrad", "--objective", "sum"],
        "one": ["--objective", "smr:3", "--effects", "joint_compliance:J2"],
        "pose": ["--objective", "pose", "--lever", "300"],
        "bfgs": ["--hessian", "bfgs", "--qp", "clarabel", "--distance", "squared"],
        "fixed": ["--fix", "d2,beta*", "--method", "nllm"],
        "base": ["--objective", "sum", "--holdout", "0"],
    }.items():
        yield f"calibrate {name}", ["calibrate", arm, poses, *options, "-o", f"{name}.json"]
        calibrated.append(f"{name}.json")
    for fit in calibrated:
        for form in FORMATS:
            yield f"export {fit} {form}", [
                "export", fit, "--to", form, "--experimental", "-o", f"{fit}.{form}",
            ]  # fmt: skip
        yield f"iso9283 {fit}", ["iso9283", fit, "--poses", "--json"]
        yield f"report {fit}", ["report", fit, "--date", "2026-01-01", "-o", f"{fit}.html"]
    for fit in ("plain.json", "effects.json", "base.json"):
        yield f"evaluate {fit}", ["evaluate", fit, poses, "--json"]
        yield (
            f"compensate {fit}",
            ["compensate", fit, str(data / "targets.csv"), "-o", f"{fit}.csv"],
        )
        yield f"compensate {fit} json", ["compensate", fit, str(data / "targets.csv"), "--json"]
        yield f"map {fit}", ["map", fit, "--samples", "2000", "--json"]
        yield (
            f"map {fit} base",
            ["map", fit, poses, "--samples", "2000", "--frame", "base", "--json"],
        )
        yield (
            f"plan {fit}",
            ["plan", arm, "--poses", "6", "--fit", fit, "--candidates", "60", "--json"],
        )
    yield "plan", ["plan", "ur10", "--poses", "12", "--candidates", "80", "--json"]
    yield "plan separate", [
        "plan", arm, "--poses", "4", "--fit", "plain.json", "--candidates", "40",
        "--separate", "joint_compliance:J2", "link_bending:L2", "--json",
    ]  # fmt: skip
    yield "check", ["check", "plain.json", poses, "--tolerance", "rms 0.5", "--json"]
    yield "compare", ["compare", "plain.json", "base.json", "--json"]
    yield "effects", ["effects", arm, poses, "--json"]
    yield "robots", ["robots", "--json"]
    for kind in ("wires", "poses", "closures", "contacts"):
        yield f"relative {kind}", ["relative", arm, str(data / f"{kind}.csv"), "--json"]
    both = [str(data / f"{kind}.csv") for kind in ("wires", "closures")]
    yield "relative several", ["relative", arm, *both, "--json"]
    yield "relative diagnose", ["relative", arm, *both, "--diagnose", "--json"]
    yield "relative effects", ["relative", arm, *both, "--effects", "joint_compliance", "--json"]
    folder = data / "cell"
    seen = [
        "--pixels", str(folder / "detections.csv"), "--joints", str(folder / "joints.csv"),
        "--camera", f"cam0={folder / 'cam0.yaml'}", "--board", str(folder / "board.csv"), "--json",
    ]  # fmt: skip
    yield "calibrate pixels", ["calibrate", "ur5", *seen]
    yield "calibrate pixels minimax", ["calibrate", "ur5", *seen, "--objective", "minimax"]
    yield "relative pixels", ["relative", "ur5", str(folder / "poses.csv"), *seen]
    yield (
        "simulate",
        ["simulate", "ur10", "--poses", "9", "--compliance", "2", "-o", "simulated.csv"],
    )
    for folder in sorted(data.glob("case*")):
        yield f"diagnose {folder.name}", [
            "diagnose", str(folder / "robot.json"), str(folder / "data.csv"), "--json",
        ]  # fmt: skip


def prepare(data: Path) -> None:
    """Files that both revisions read: simulated arms with their faults, inputs of commands."""
    import numpy as np

    from experiments import blind_gap, gap_cases, pixel_cells, relative
    from minimax_cal.fitting.instruments import flange_poses, write_relative
    from minimax_cal.robots.sampling import random_poses
    from tests.fitting.test_contacts import planes

    if (data / "done").exists():
        return
    size = blind_gap.Size(
        none=SEVERAL, none_rough=1, single=1, poses=0, rough=0, pair=SEVERAL, triple=3,
        background=SEVERAL, outside=1, deleted=0, wrong_law=1, fault=2, powers=(POWER,),
        clear=(POWER,), beyond=(POWER,), removed=(),
    )  # fmt: skip
    for number, case in enumerate(blind_gap.plan(SEED, size)):
        gap_cases.write(gap_cases.make(case), data / f"case{number:02}")
    rng = np.random.default_rng(SEED)
    plain = gap_cases.make(gap_cases.Case("irb2600", "none", seed=SEED))
    gap_cases.write(plain, data / "plain")
    header = ",".join(f"q{joint}_rad" for joint in range(1, 7))
    np.savetxt(
        data / "targets.csv", rng.uniform(-1, 1, (12, 6)), "%.17g", ",", header=header, comments=""
    )
    arm = relative.Arm.of("irb2600", SEED, 0.0)
    for kind, name in {"wires": "wires_3", "poses": "poses", "closures": "closures"}.items():
        measured = relative.SIMULATORS[name](arm, np.random.default_rng(SEED), 60, relative.NOISE)
        write_relative(data / f"{kind}.csv", measured.data)
    write_relative(data / "contacts.csv", planes(arm, SEED, relative.NOISE))
    points = pixel_cells.board_points((6, 5), 0.04)
    cell = pixel_cells.make_cell(np.random.default_rng(1), points=points, poses=20, on_flange=True)
    (data / "cell").mkdir()
    pixel_cells.write_cell(cell, data / "cell")
    q = random_poses(cell.true, 24, np.random.default_rng(SEED))
    write_relative(data / "cell" / "poses.csv", flange_poses(q, cell.true.pose(q)))
    (data / "done").write_text("")


# ---- one revision --------------------------------------------------------------------------------


def run(tree: Path, out: Path, data: Path, only: str) -> None:
    """Run every command with the code in a tree; leave what it said and wrote in a folder."""
    sys.path[:0] = [str(tree)]
    os.chdir(out)
    from minimax_cal.cli import main

    assert Path(sys.modules["minimax_cal"].__file__ or "").is_relative_to(tree)
    for name, command in cases(data):
        target = out / (re.sub(r"[^\w.]+", "-", name) + ".answer.json")
        if only and only not in name:
            continue
        before = {path: path.stat().st_mtime_ns for path in out.iterdir()}
        said, told = io.StringIO(), io.StringIO()
        code: Any = 0
        with contextlib.redirect_stdout(said), contextlib.redirect_stderr(told):
            try:
                main(command)
            except SystemExit as end:
                code = end.code
            except Exception:
                code = traceback.format_exc()
        wrote = sorted(p for p in out.iterdir() if before.get(p) != p.stat().st_mtime_ns)
        files = {path.name: path.read_text() for path in wrote}
        answer = {
            "code": code,
            "stdout": said.getvalue(),
            "stderr": told.getvalue(),
            "files": files,
        }
        target.write_text(json.dumps(answer))
        print(f"{name}: {code}", flush=True)


class Text(HTMLParser):
    """What a page shows: text, and the JSON of its plots."""

    def __init__(self) -> None:
        super().__init__()
        self.parts: list[str] = []
        self.hidden = 0

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        """Style and program are not shown; data of plots are."""
        self.hidden = tag == "style" or (
            tag == "script" and ("type", "application/json") not in attrs
        )

    def handle_endtag(self, tag: str) -> None:
        """Shown again."""
        self.hidden = False

    def handle_data(self, data: str) -> None:
        """Text between tags."""
        if not self.hidden and data.strip():
            self.parts.append(data.strip())


def content(name: str, text: str) -> Any:
    """A file or an output as something that compares."""
    if name.endswith(".html"):
        page = Text()
        page.feed(text)
        return [parsed(part) for part in page.parts]
    return parsed(text)


def parsed(text: str) -> Any:
    """JSON as it is, other text as words and numbers."""
    try:
        return json.loads(text)
    except ValueError:
        text = CLOCKED.sub("TIME", text)
        return [re.sub(r"\s+", " ", NUMBER.sub("#", text)), *map(float, NUMBER.findall(text))]


def differences(one: Any, other: Any, rel: float, at: str = "") -> Iterator[str]:
    """Where two contents differ; a number may be off relative to the largest beside it."""
    if isinstance(one, dict) and isinstance(other, dict):
        for key in sorted(one.keys() | other.keys()):
            new = RENAMED.get(key, key)
            new_here = key not in one and (key in ADDED or key in RENAMED.values())
            if key in TIMES or new_here:
                continue
            if key not in one or new not in other:
                yield f"{at}/{key}: only {'before' if key in one else 'now'}"
            else:
                yield from differences(one[key], other[new], rel, f"{at}/{key}")
    elif isinstance(one, list) and isinstance(other, list):
        if len(one) != len(other):
            yield f"{at}: {len(one)} and {len(other)} entries"
            return
        numbers = [abs(x) for x in one if isinstance(x, int | float) and x == x]
        for i, (a, b) in enumerate(zip(one, other, strict=True)):
            if isinstance(a, int | float) and isinstance(b, int | float):
                if not close(a, b, rel, max(numbers, default=0.0)):
                    yield f"{at}[{i}]: {a!r} and {b!r}"
            else:
                yield from differences(a, b, rel, f"{at}[{i}]")
    elif isinstance(one, int | float) and isinstance(other, int | float):
        if not close(one, other, rel, abs(one)):
            yield f"{at}: {one!r} and {other!r}"
    elif one != other:
        yield f"{at}: {str(one)[:300]!r} and {str(other)[:300]!r}"


def close(a: float, b: float, rel: float, size: float) -> bool:
    """Whether two numbers are the same, to a share of a size."""
    return a == b or (a != a and b != b) or abs(a - b) <= rel * max(size, abs(b))


def compare(before: Path, now: Path, rel: float, only: str) -> list[str]:
    """What differs between the answers of two revisions."""
    out = []
    for path in sorted(before.glob("*.answer.json")):
        if only and re.sub(r"[^\w.]+", "-", only) not in path.name:
            continue
        if not (now / path.name).exists():
            out.append(f"{path.name}: no answer now")
            continue
        one, other = (json.loads((folder / path.name).read_text()) for folder in (before, now))
        for folder, answer in ((before, one), (now, other)):
            for key in ("code", "stdout", "stderr"):
                answer[key] = str(answer[key]).replace(str(folder), "")
        for side in (one, other):
            side["stdout"] = parsed(side["stdout"])
            side["stderr"] = parsed(side["stderr"])
            side["files"] = {name: content(name, text) for name, text in side["files"].items()}
        out += [f"{path.name}{line}" for line in differences(one, other, rel)]
    return out


def git(*words: str) -> str:
    """What git answers."""
    done = subprocess.run(["git", "-C", str(ROOT), *words], check=True, capture_output=True)
    return done.stdout.decode().strip()


def main() -> int:
    """Compare; 1 where something differs."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("revision", nargs="?", default="HEAD")
    parser.add_argument("--rel", type=float, default=1e-12, help="how far numbers may be off")
    parser.add_argument("--only", default="", help="commands whose name holds this")
    parser.add_argument("--inside", nargs=3, type=Path, help=argparse.SUPPRESS)
    chosen = parser.parse_args()
    if chosen.inside:
        run(*chosen.inside, chosen.only)
        return 0
    sys.path[:0] = [str(ROOT)]
    os.environ |= {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    commit = git("rev-parse", chosen.revision)
    asked = inspect.getsource(cases) + inspect.getsource(prepare)
    mark = hashlib.sha256(asked.encode()).hexdigest()[:8]
    data, before, now = STORE / f"data-{mark}", STORE / f"{commit[:12]}-{mark}", STORE / "now"
    data.mkdir(parents=True, exist_ok=True)
    prepare(data)
    shutil.rmtree(now, ignore_errors=True)
    now.mkdir()
    running = [started(ROOT, now, data, chosen.only)]
    tree = STORE / "tree"
    if not (before / "done").exists():
        shutil.rmtree(before, ignore_errors=True)
        before.mkdir()
        git("worktree", "prune")
        subprocess.run(
            ["git", "-C", str(ROOT), "worktree", "remove", "--force", str(tree)],
            check=False,
            capture_output=True,
        )
        git("worktree", "add", "--detach", str(tree), commit)
        running.append(started(tree, before, data, ""))
    for process in running:
        if process.wait():
            raise SystemExit("a revision could not be run; see what it printed")
    (before / "done").write_text("")
    if not list(now.glob("*.answer.json")):
        raise SystemExit(f"no command's name holds {chosen.only!r}: nothing is compared")
    found = compare(before, now, chosen.rel, chosen.only)
    print("\n".join(found[:200]))
    print(f"{len(found)} differences from {commit[:12]} at {chosen.rel:g} relative")
    return int(bool(found))


def started(tree: Path, out: Path, data: Path, only: str) -> subprocess.Popen[bytes]:
    """A revision at work, in a process of its own."""
    command = [sys.executable, str(Path(__file__).resolve()), "--only", only]
    command += ["--inside", str(tree), str(out), str(data)]
    log = (out / "log.txt").open("wb")
    return subprocess.Popen(
        command, stdout=log, stderr=log, env={**os.environ, "PYTHONPATH": str(tree)}
    )


if __name__ == "__main__":
    sys.exit(main())
