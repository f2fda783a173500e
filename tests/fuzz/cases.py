"""A hostile run: a command, the files that it reads, and what is known of the answer."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from typing import Any

import click
import numpy as np

from minimax_cal.cli.command_runner import cli

from .known import FATAL, HARMLESS, with_known
from .material import material
from .mutations import VALUES, Rng, broken, misspelt, pick

# Command lines that work, each word that names a file of the material one that may be broken.
PIXELS = "--pixels detections.csv --joints joints.csv --camera cam0=cam0.yaml --board board.csv"
TEMPLATES = (
    "calibrate ROBOT data.csv --objective sum --json",
    "calibrate ROBOT data.csv --json -o out.json",
    "calibrate ROBOT data.csv --objective point --json",
    "calibrate ROBOT data.csv --objective pose",
    "calibrate irb120 data.csv --objective sum --effects joint_compliance:all",
    "calibrate irb120 data.csv --objective sum --loss huber --figure out.svg",
    "calibrate irb120 data.csv --prior a*=0.5mm --fix beta* --holdout 0.3",
    "evaluate fit.json data.csv --json",
    "evaluate truth.json data.csv --json",
    "evaluate effects.json data.csv -o out.json",
    "import data.csv -o out.csv",
    "import data.csv --leave-out 3:smr1,5 -o out.csv",
    "import tracker.csv -o out.csv --json",
    "import tracker.csv -o out.csv --safe-cells",
    "import log.csv -o out.csv",
    "import log.csv rtde.csv --json",
    "import rtde.csv -o out.json",
    "compensate fit.json targets.csv -o out.csv",
    "compensate effects.json targets.csv --json",
    "compensate fit.json weld.mod -o out.mod",
    "compensate truth.json targets.csv --robot ROBOT --safe-cells",
    "check fit.json data.csv --tolerance rms=0.3 --json",
    "check effects.json data.csv --tolerance max=5 -o out.json",
    "compare fit.json effects.json --json",
    "iso9283 fit.json --poses --json",
    "iso9283 fit.json data.csv -o out.json",
    "map fit.json --samples 500 --json",
    "map fit.json data.csv --samples 500 -o out.png",
    "export fit.json --to urdf -o out.urdf",
    "export fit.json --to dh-csv -o out.csv",
    "export fit.json --to ros2-control -o out.xml",
    "export ROBOT --to json -o out.json",
    "export effects.json --to ur-yaml -o out.yaml",
    "export fit.json --to urdf --urdf robot.urdf -o out.urdf",
    "report fit.json -o out.html --date 2026-01-01",
    "report effects.json -o out.html --date 2026-01-01 --customer Name",
    "report diagnosis.json -o out.html --date 2026-01-01",
    "relative ROBOT wires.csv --json",
    "relative irb120 wires.csv -o out.json",
    "diagnose irb120 data.csv --json",
    "plan ROBOT --poses 6 --candidates 40 -o out.csv",
    "plan irb120 --poses 4 --candidates 40 --fit fit.json --data data.csv --json",
    "plan irb120 --motion --duration 6 --rows-per-second 20 -o out.csv",
    "simulate ROBOT --poses 8 -o out.csv --truth out.json",
    "effects ROBOT data.csv --json",
    "gap robot.urdf data.csv --fit fit.json --diagnosis diagnosis.json --json",
    "gap arm.xml data.csv --fit fit.json --diagnosis diagnosis.json --write out.xml -o out.json",
    "calibrate irb120 data.csv later.csv --json",
    f"calibrate ur5 {PIXELS} --json",
    f"calibrate ur5 {PIXELS} --fix-camera -o out.json",
    "evaluate fit.json later.csv --new-frame --json",
    "relative irb120 wires.csv --prior a*=0.5mm --json",
    "relative irb120 wires.csv data.csv --json",
    "relative irb120 contacts.csv data.csv --json",
    "relative irb120 wires.csv data.csv --diagnose -o out.json",
    "relative irb120 wires.csv --diagnose --without backlash --json",
    "relative irb120 wires.csv data.csv --effects joint_compliance:all -o out.json",
    "identify sweeps.csv --joints revolute,revolute,revolute,revolute,revolute,revolute --json",
    "import run1.csv run2.csv -o out.csv",
    "import data.csv --preview",
    "torques links.json run1.csv run2.csv --json",
    "torques links.json run1.csv run2.csv --write out.xml -o out.json",
    "gap links.xml run1.csv run2.csv --json",
    "gap links.xml run1.csv run2.csv --write out.xml -o out.json",
    "report motion.json -o out.html --date 2026-01-01",
    "robots --json",
    "backends --json",
)
EACH = -1  # in place of a seed
PLAIN = -2  # as well: the command lines of TEMPLATES as they are
KNOWN = ("calibrate", "evaluate", "check")  # commands whose answer to some changes is known
ROBOTS = ("robot.json", "robot.yaml", "robot.toml", "robot.urdf", "irb120")
# How often, beside the others: those that take seconds, and those that can hardly go wrong.
RATES = {"calibrate": 0.15, "diagnose": 0.1, "plan": 0.08, "gap": 0.3}
RATES |= {"robots": 0.2, "backends": 0.2}
PLACES = (
    "/dev/null",
    ".",
    "no/such/x",
    "/proc/x",
    "loop",
    "out.json/x",
    "x" * 300,
    "data.csv",
    "-",
    "",
)


@dataclass(frozen=True)
class Case:
    """number, seed: make it again.  files: by name.  broke: what was done.

    expect: "" nothing is known, "same": the answer is that of the good files, "noticed": no success
    without a word.
    """

    number: int
    seed: int
    arguments: tuple[str, ...]
    files: dict[str, bytes]
    broke: tuple[str, ...]
    expect: str = ""

    @property
    def command(self) -> str:
        """The first word."""
        return self.arguments[0]


def case(seed: int, number: int) -> Case:
    """The hostile run of that number.  seed: EACH for those of `each_option`, PLAIN for none."""
    if seed == PLAIN:
        words = tuple("irb120" if word == "ROBOT" else word for word in TEMPLATES[number].split())
        return Case(number, seed, words, dict(material()), ("nothing",))
    if seed == EACH:
        words = each_option()[number]
        said = " ".join(words[len(words) - 2 :])[:60]
        return Case(number, seed, words, dict(material()), (said,))
    rng = np.random.default_rng([seed, number])
    rates = np.array([RATES.get(line.split()[0], 1.0) for line in TEMPLATES])
    line = TEMPLATES[int(rng.choice(len(TEMPLATES), p=rates / rates.sum()))]
    words = [str(pick(rng, ROBOTS)) if word == "ROBOT" else word for word in line.split()]
    files = dict(material())
    if "data.csv" in words and words[0] in KNOWN and rng.random() < 0.3:
        return known(seed, number, words, files, rng)
    if "robot.json" in words and rng.random() < 0.2:
        files["robot.json"], said = misspelt(files["robot.json"], rng)
        return Case(number, seed, tuple(words), files, (said,), "noticed")
    broke = []
    inputs = [word for word in words if word in files]
    for _ in range(int(rng.choice([1, 2, 3], p=[0.7, 0.2, 0.1]))):
        how = rng.random()
        if inputs and how < 0.65:
            name = str(pick(rng, inputs))
            files[name], said = broken(name, files[name], rng) if files[name] else (b"", name)
            broke.append(said)
        elif how < 0.92:
            broke.append(option(words, rng))
        else:
            broke.append(place(words, rng))
    return Case(number, seed, tuple(words), files, tuple(broke))


@cache
def each_option() -> tuple[tuple[str, ...], ...]:
    """Every command line with every option of the command and every odd value, or odd output."""
    out = []
    for line in TEMPLATES:
        words = tuple("irb120" if word == "ROBOT" else word for word in line.split())
        for flag, values in odd_options(words[0]):
            out.append((*words, flag, *values))
        for where in PLACES:
            at = words.index("-o") if "-o" in words else len(words)
            out.append((*words[:at], "-o", where, *words[at + 2 :]))
    return tuple(out)


def odd_options(command: str) -> Iterator[tuple[str, list[str]]]:
    """The options of a command with each odd value, and with each choice there is."""
    for part in cli.commands[command].params:
        if not isinstance(part, click.Option) or "--pdf" in part.opts:  # which starts a browser
            continue
        flag = max(part.opts, key=len)
        if part.is_flag:
            yield flag, []
            continue
        choices = part.type.choices if isinstance(part.type, click.Choice) else ()
        for value in (*choices, *VALUES):
            yield flag, [str(value)] * part.nargs


def known(seed: int, number: int, words: list[str], files: dict[str, bytes], rng: Rng) -> Case:
    """Measurements changed in a way of which it is known what it does."""
    harmless = words[0] == "evaluate" or rng.random() < 0.4
    way = pick(rng, HARMLESS if harmless else FATAL)
    files["data.csv"] = with_known(files["data.csv"], way, rng)
    expect = "same" if harmless and words[0] == "evaluate" else "noticed" if not harmless else ""
    return Case(number, seed, tuple(words), files, (f"data.csv: {way.__name__}",), expect)


def option(words: list[str], rng: Rng) -> str:
    """Give an option of the command, known or not, an odd value; or change a word."""
    if rng.random() < 0.15:
        at = int(rng.integers(1, len(words))) if len(words) > 1 else 0
        words[at] = str(pick(rng, VALUES))
        return f"word {at}: {words[at][:20]}"
    found: list[click.Option] = [
        part for part in cli.commands[words[0]].params if isinstance(part, click.Option)
    ]
    chosen: Any = pick(rng, found)
    flag = max(chosen.opts, key=len)
    if flag == "--pdf":  # starts a browser
        return "nothing"
    values = [] if chosen.is_flag else [str(pick(rng, VALUES)) for _ in range(chosen.nargs)]
    if isinstance(chosen.type, click.Choice) and rng.random() < 0.7:
        values = [str(pick(rng, list(chosen.type.choices)))]
    words += [flag, *values]
    return f"{flag} {' '.join(values)[:30]}".strip()


def place(words: list[str], rng: Rng) -> str:
    """Send an output to an odd place."""
    where = str(pick(rng, PLACES))
    if "-o" in words:
        words[words.index("-o") + 1] = where
    else:
        words += ["-o", where]
    return f"-o {where[:20]}"
