"""The steps of the work: the choices of a session as the command lines that do them."""

from __future__ import annotations

import shlex
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

from minimax_cal.ground.errors import OptionError
from minimax_cal.ground.files import json_of
from minimax_cal.robots.robot import builtin_robots
from minimax_cal.serving.sessions import GIVEN, Choices, Session, mark

POSES, USED, UNDERSTOOD = "poses.csv", "used.csv", "understood.json"
FIT, DIAGNOSIS, REPORT, NEXT = "fit.json", "diagnosis.json", "report.html", "next.csv"
URDF, MJCF, CORRECTED = "robot.urdf", "robot.xml", "corrected.csv"
PROGRAM = "minimax-cal"
KEPT = 64  # results whose data are remembered


@dataclass(frozen=True)
class Command:
    """A command line.  words: after the program's name.  to: the file that gets its stdout.

    judges: exit code 1 with words on stdout is an answer, as not passed.
    """

    words: tuple[str, ...]
    to: str = ""
    judges: bool = False

    def line(self) -> str:
        """As people type it, in the session's folder."""
        return shlex.join((PROGRAM, *self.words)) + (
            f" > {shlex.quote(self.to)}" if self.to else ""
        )


@dataclass(frozen=True)
class Step:
    """A step of the work.  writes: its result.  commands: what does it; raises OptionError."""

    writes: str
    commands: Callable[[Session, Choices], tuple[Command, ...]]


def reading(at: Session, chosen: Choices) -> tuple[Command, ...]:
    """The files of tracker and controller, as measurements."""
    if not chosen.measured:
        raise OptionError("drop the files of the tracker and the controller first")
    points = [f"{GIVEN}/{name}" for name in chosen.measured if name != chosen.joints]
    told = {
        "--joints": f"{GIVEN}/{chosen.joints}" if chosen.joints else "",
        "--units": chosen.units,
        "--columns": chosen.columns,
        "--layout": chosen.layout,
        "--decimal": chosen.decimal,
    }
    more = [f"{option}={value}" for option, value in told.items() if value]
    return (Command(("import", *points, *more, "-o", POSES, "--json"), UNDERSTOOD),)


def subject(at: Session, chosen: Choices) -> tuple[tuple[Command, ...], str, str]:
    """What makes the data of a fit, the robot and the data."""
    if not (at.folder / POSES).is_file():
        raise OptionError("the measurements have not been read yet")
    if not chosen.robot:
        raise OptionError("choose a robot first")
    robot = chosen.robot if chosen.robot in builtin_robots() else f"{GIVEN}/{chosen.robot}"
    if not chosen.left_out:
        return (), robot, POSES
    by_reason: dict[str, list[str]] = {}
    for point in chosen.left_out:
        by_reason.setdefault(chosen.reasons.get(point, "").strip(), []).append(point)
    left = [
        f"--leave-out={','.join(points)}" + (f"={why}" if why else "")
        for why, points in by_reason.items()
    ]
    return (Command(("import", POSES, *left, "-o", USED)),), robot, USED


def fitting(at: Session, chosen: Choices) -> tuple[Command, ...]:
    """The calibration."""
    first, robot, data = subject(at, chosen)
    words = ["calibrate", robot, data, "--objective", chosen.objective]
    if chosen.effects:
        if not (at.folder / DIAGNOSIS).is_file():
            raise OptionError("diagnose first: its effects are to be fitted too")
        words += ["--effects", DIAGNOSIS]
    return (*first, Command((*words, "-o", FIT)))


def diagnosing(at: Session, chosen: Choices) -> tuple[Command, ...]:
    """The diagnosis."""
    first, robot, data = subject(at, chosen)
    quick = ("--quick",) if chosen.quick else ()
    return (*first, Command(("diagnose", robot, data, *quick, "-o", DIAGNOSIS)))


def judging(at: Session, chosen: Choices) -> tuple[Command, ...]:
    """The report, with the requirement."""
    results = [fitted(at)]
    diagnosed = data_of(*mark(at.folder / DIAGNOSIS))
    if diagnosed and diagnosed == data_of(*mark(at.folder / FIT)):
        results.append(DIAGNOSIS)
    limits = {"rms": chosen.rms, "max": chosen.most}
    told = ", ".join(f"{name} {limit:g}" for name, limit in limits.items() if limit)
    asked = ("--tolerance", told, "--tolerance-for", chosen.claim) if told else ()
    return (Command(("report", *results, *asked, "-o", REPORT), judges=True),)


def planning(at: Session, chosen: Choices) -> tuple[Command, ...]:
    """The poses to measure next."""
    _, robot, _ = subject(at, chosen)
    words = ("plan", robot, "--poses", str(chosen.poses), "--fit", fitted(at), "-o", NEXT)
    return (Command(words),)


def correcting(at: Session, chosen: Choices) -> tuple[Command, ...]:
    """Joint targets, corrected."""
    if not chosen.targets:
        raise OptionError("drop a file of joint targets first (CSV with q1_deg, q2_deg ...)")
    words = ("compensate", fitted(at), f"{GIVEN}/{chosen.targets}", "-o", CORRECTED)
    return (Command(words),)


def exporting(kind: str, path: str) -> Callable[[Session, Choices], tuple[Command, ...]]:
    """The calibrated robot as a file."""
    return lambda at, _: (Command(("export", fitted(at), "--to", kind, "-o", path)),)


STEPS = {
    "read": Step(POSES, reading),
    "fit": Step(FIT, fitting),
    "diagnose": Step(DIAGNOSIS, diagnosing),
    "judge": Step(REPORT, judging),
    "plan": Step(NEXT, planning),
    "urdf": Step(URDF, exporting("urdf", URDF)),
    "mjcf": Step(MJCF, exporting("mjcf", MJCF)),
    "correct": Step(CORRECTED, correcting),
}


def fitted(at: Session) -> str:
    """The calibration's file.  Raises OptionError where there is none yet."""
    if not (at.folder / FIT).is_file():
        raise OptionError("calibrate first")
    return FIT


@lru_cache(maxsize=KEPT)
def data_of(path: str, moment: int, size: int) -> str:
    """SHA-256 of the measurements of a result's file at a moment, empty where it tells none."""
    try:
        content = json_of(Path(path).read_bytes())
        return str(content["provenance"]["data_sha256"])
    except (OSError, ValueError, KeyError, TypeError):
        return ""
