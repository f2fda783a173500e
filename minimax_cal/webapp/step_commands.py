"""The steps of the work: the choices of a session as the command lines that do them."""

from __future__ import annotations

import shlex
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

from minimax_cal.core.errors import OptionError
from minimax_cal.core.files import parse_json
from minimax_cal.robots.robot import builtin_robots
from minimax_cal.webapp.sessions import UPLOAD_FOLDER, Session, SessionChoices, file_version

POSES_FILE, USED_POINTS_FILE, IMPORT_SUMMARY_FILE = "poses.csv", "used.csv", "understood.json"
FIT_FILE, DIAGNOSIS_FILE, REPORT_FILE, PLAN_FILE = (
    "fit.json",
    "diagnosis.json",
    "report.html",
    "next.csv",
)
URDF_FILE, MJCF_FILE, CORRECTED_TARGETS_FILE = "robot.urdf", "robot.xml", "corrected.csv"
PROGRAM_NAME = "minimax-cal"
MAX_CACHED_DATA_HASHES = 64  # results whose data are remembered


@dataclass(frozen=True)
class CommandLine:
    """A command line.  words: after the program's name.  to: the file that gets its stdout.

    judges: exit code 1 with words on stdout is an answer, as not passed.
    """

    words: tuple[str, ...]
    to: str = ""
    judges: bool = False

    def format_shell_line(self) -> str:
        """As people type it, in the session's folder."""
        return shlex.join((PROGRAM_NAME, *self.words)) + (
            f" > {shlex.quote(self.to)}" if self.to else ""
        )


@dataclass(frozen=True)
class SessionStep:
    """A step of the work.  result_file: its result.  build_commands: what does it; raises
    OptionError.
    """

    result_file: str
    build_commands: Callable[[Session, SessionChoices], tuple[CommandLine, ...]]


class StepFitInputs(NamedTuple):
    """Inputs of a fit.  import_commands: write the data file without points left out."""

    import_commands: tuple[CommandLine, ...]
    robot: str
    data_file: str


def build_import_commands(session: Session, choices: SessionChoices) -> tuple[CommandLine, ...]:
    """The files of tracker and controller, as measurements."""
    if not choices.measured:
        raise OptionError("drop the files of the tracker and the controller first")
    points = [f"{UPLOAD_FOLDER}/{name}" for name in choices.measured if name != choices.joints]
    told = {
        "--joints": f"{UPLOAD_FOLDER}/{choices.joints}" if choices.joints else "",
        "--units": choices.units,
        "--columns": choices.columns,
        "--layout": choices.layout,
        "--decimal": choices.decimal,
    }
    more = [f"{option}={value}" for option, value in told.items() if value]
    return (
        CommandLine(("import", *points, *more, "-o", POSES_FILE, "--json"), IMPORT_SUMMARY_FILE),
    )


def prepare_fit_inputs(session: Session, choices: SessionChoices) -> StepFitInputs:
    """Robot and data file of a fit.  Raises OptionError where one is missing."""
    if not (session.folder / POSES_FILE).is_file():
        raise OptionError("the measurements have not been read yet")
    if not choices.robot:
        raise OptionError("choose a robot first")
    robot = (
        choices.robot if choices.robot in builtin_robots() else f"{UPLOAD_FOLDER}/{choices.robot}"
    )
    if not choices.left_out:
        return StepFitInputs((), robot, POSES_FILE)
    by_reason: dict[str, list[str]] = {}
    for point in choices.left_out:
        by_reason.setdefault(choices.reasons.get(point, "").strip(), []).append(point)
    left = [
        f"--leave-out={','.join(points)}" + (f"={why}" if why else "")
        for why, points in by_reason.items()
    ]
    return StepFitInputs(
        (CommandLine(("import", POSES_FILE, *left, "-o", USED_POINTS_FILE)),),
        robot,
        USED_POINTS_FILE,
    )


def build_calibrate_commands(session: Session, choices: SessionChoices) -> tuple[CommandLine, ...]:
    """The calibration."""
    first, robot, data = prepare_fit_inputs(session, choices)
    words = ["calibrate", robot, data, "--objective", choices.objective]
    if choices.effects:
        if not (session.folder / DIAGNOSIS_FILE).is_file():
            raise OptionError("diagnose first: its effects are to be fitted too")
        words += ["--effects", DIAGNOSIS_FILE]
    return (*first, CommandLine((*words, "-o", FIT_FILE)))


def build_diagnose_commands(session: Session, choices: SessionChoices) -> tuple[CommandLine, ...]:
    """The diagnosis."""
    first, robot, data = prepare_fit_inputs(session, choices)
    quick = ("--quick",) if choices.quick else ()
    return (*first, CommandLine(("diagnose", robot, data, *quick, "-o", DIAGNOSIS_FILE)))


def build_report_commands(session: Session, choices: SessionChoices) -> tuple[CommandLine, ...]:
    """The report, with the requirement."""
    results = [require_fit_file(session)]
    diagnosed = read_measurements_sha256(*file_version(session.folder / DIAGNOSIS_FILE))
    if diagnosed and diagnosed == read_measurements_sha256(
        *file_version(session.folder / FIT_FILE)
    ):
        results.append(DIAGNOSIS_FILE)
    limits = {"rms": choices.rms, "max": choices.most}
    told = ", ".join(f"{name} {limit:g}" for name, limit in limits.items() if limit)
    asked = ("--tolerance", told, "--tolerance-for", choices.claim) if told else ()
    return (CommandLine(("report", *results, *asked, "-o", REPORT_FILE), judges=True),)


def build_plan_commands(session: Session, choices: SessionChoices) -> tuple[CommandLine, ...]:
    """The poses to measure next."""
    _, robot, _ = prepare_fit_inputs(session, choices)
    words = (
        "plan",
        robot,
        "--poses",
        str(choices.poses),
        "--fit",
        require_fit_file(session),
        "-o",
        PLAN_FILE,
    )
    return (CommandLine(words),)


def build_compensate_commands(session: Session, choices: SessionChoices) -> tuple[CommandLine, ...]:
    """Joint targets, corrected."""
    if not choices.targets:
        raise OptionError("drop a file of joint targets first (CSV with q1_deg, q2_deg ...)")
    words = (
        "compensate",
        require_fit_file(session),
        f"{UPLOAD_FOLDER}/{choices.targets}",
        "-o",
        CORRECTED_TARGETS_FILE,
    )
    return (CommandLine(words),)


def make_export_command_builder(
    format_name: str, output_path: str
) -> Callable[[Session, SessionChoices], tuple[CommandLine, ...]]:
    """The calibrated robot as a file."""
    return lambda at, _: (
        CommandLine(("export", require_fit_file(at), "--to", format_name, "-o", output_path)),
    )


SESSION_STEPS = {
    "read": SessionStep(POSES_FILE, build_import_commands),
    "fit": SessionStep(FIT_FILE, build_calibrate_commands),
    "diagnose": SessionStep(DIAGNOSIS_FILE, build_diagnose_commands),
    "judge": SessionStep(REPORT_FILE, build_report_commands),
    "plan": SessionStep(PLAN_FILE, build_plan_commands),
    "urdf": SessionStep(URDF_FILE, make_export_command_builder("urdf", URDF_FILE)),
    "mjcf": SessionStep(MJCF_FILE, make_export_command_builder("mjcf", MJCF_FILE)),
    "correct": SessionStep(CORRECTED_TARGETS_FILE, build_compensate_commands),
}


def require_fit_file(session: Session) -> str:
    """The calibration's file.  Raises OptionError where there is none yet."""
    if not (session.folder / FIT_FILE).is_file():
        raise OptionError("calibrate first")
    return FIT_FILE


@lru_cache(maxsize=MAX_CACHED_DATA_HASHES)
def read_measurements_sha256(result_path: str, modified_ns: int, byte_count: int) -> str:
    """SHA-256 of the measurements of a result's file at a moment, empty where it tells none."""
    try:
        content = parse_json(Path(result_path).read_bytes())
        return str(content["provenance"]["data_sha256"])
    except (OSError, ValueError, KeyError, TypeError):
        return ""
