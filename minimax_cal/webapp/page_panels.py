"""What the page shows of a session: how each step stands, and what the commands wrote."""

from __future__ import annotations

import csv
from collections.abc import Callable
from functools import lru_cache
from typing import Any, NamedTuple

from numpy import nan_to_num

from minimax_cal.core.display_text import capitalise_sentence, replace_invisible_and_bidi_characters
from minimax_cal.core.errors import CalibrationError
from minimax_cal.core.files import parse_json
from minimax_cal.core.tables import Table, drop_empty_tables
from minimax_cal.diagnosing.diagnosis import load_diagnosis
from minimax_cal.fitting.fit import Fit
from minimax_cal.reporting.html.diagnosis_charts import build_budget_chart_of_diagnosis
from minimax_cal.reporting.html.html_page import (
    chart_to_json_data,
    import_report_packages,
    load_template,
)
from minimax_cal.robots.robot import builtin_robots, load_robot
from minimax_cal.robots.transforms import build_links_table
from minimax_cal.webapp.job_runner import StepProgress, StepRecord, read_step_record
from minimax_cal.webapp.point_errors import MeasuredPoint, list_points_with_errors
from minimax_cal.webapp.sessions import (
    SCRIPT_FILE,
    UPLOAD_FOLDER,
    FileVersion,
    Session,
    SessionChoices,
    file_version,
)
from minimax_cal.webapp.step_commands import (
    CORRECTED_TARGETS_FILE,
    DIAGNOSIS_FILE,
    FIT_FILE,
    IMPORT_SUMMARY_FILE,
    MJCF_FILE,
    PLAN_FILE,
    POSES_FILE,
    REPORT_FILE,
    SESSION_STEPS,
    URDF_FILE,
    USED_POINTS_FILE,
    CommandLine,
)

MAX_LISTED_POINTS = 300  # rows of the table; the worst come first
MAX_PLAN_ROWS = 60
MAX_CACHED_RESULTS = 16  # results in memory
FILES_WITH_ACCURACY = (
    FIT_FILE,
    URDF_FILE,
    MJCF_FILE,
    CORRECTED_TARGETS_FILE,
)  # whose accuracy stands beside them
WRITTEN_FILE_DESCRIPTIONS = {
    SCRIPT_FILE: "all that was done here, as command lines",
    POSES_FILE: "the measurements, as they were understood",
    USED_POINTS_FILE: "the measurements, with the points that were set aside and why",
    IMPORT_SUMMARY_FILE: "what was understood of the files",
    FIT_FILE: "the calibration",
    DIAGNOSIS_FILE: "the diagnosis",
    REPORT_FILE: "the report to sign",
    PLAN_FILE: "the poses to measure next",
    URDF_FILE: "the calibrated robot",
    MJCF_FILE: "the calibrated robot for MuJoCo",
    CORRECTED_TARGETS_FILE: "the joint targets, corrected",
}
PanelContent = dict[str, Any]


class NumberTile(NamedTuple):
    """A number in large letters, before and after the calibration."""

    name: str
    before: str
    after: str


class RobotChoice(NamedTuple):
    """A robot to choose."""

    value: str
    label: str


class ImportedFileSummary(NamedTuple):
    """A measured file: format and rows in a sentence, and its columns."""

    sentence: str
    column_table: Table


class FitSummary(NamedTuple):
    """What the page shows of a calibration."""

    headline: str
    tiles: list[NumberTile]
    accuracy_table: Table
    solution: str


class DiagnosisSummary(NamedTuple):
    """What the page shows of a diagnosis.  chart: the error budget, for plotly."""

    sentences: tuple[str, ...]
    tables: tuple[Table, ...]
    chart: PanelContent


def build_page_state(session: Session, progress: StepProgress | None) -> dict[str, Any]:
    """All that the page shows, in JSON."""
    chosen = session.choices
    return {
        "name": session.name,
        "choices": chosen.model_dump(mode="json"),
        "robots": list_robot_choices(session, chosen),
        "steps": {
            name: describe_step_state(session, chosen, name, progress) for name in SESSION_STEPS
        },
        "panels": render_panels(session, chosen, progress),
        "views": list_chart_versions(session),
    }


def list_robot_choices(session: Session, choices: SessionChoices) -> list[RobotChoice]:
    """Value and label of every robot to choose: those built in, and files that were dropped."""
    known = choices.named_files() - {choices.robot}
    dropped = [
        RobotChoice(name, name) for name in session.list_uploaded_files() if name not in known
    ]
    return [*dropped, *list_builtin_robots()]


@lru_cache(maxsize=1)
def list_builtin_robots() -> tuple[RobotChoice, ...]:
    """Value and label of the built-in robots."""
    return tuple(RobotChoice(name, load_robot(name).name) for name in builtin_robots())


def describe_step_state(
    session: Session, choices: SessionChoices, step_name: str, progress: StepProgress | None
) -> dict[str, Any]:
    """How a step stands: waiting, ready, working, done, old or failed; and its command lines."""
    record = read_step_record(session, step_name)
    commands: tuple[CommandLine, ...] = ()
    waits = ""
    try:
        commands = SESSION_STEPS[step_name].build_commands(session, choices)
    except CalibrationError as error:
        waits = str(error)
    lines = [command.format_shell_line() for command in commands]
    out = {"lines": lines, "waits": waits, "error": "", "notices": [], "state": "ready"}
    if progress and progress.step == step_name:
        return out | {"state": "working"}
    if record is None:
        return out | {"state": "waiting" if waits else "ready"}
    kept = {"error": record.error, "notices": list(record.notices), "seconds": record.seconds}
    if record.code:
        return out | kept | {"state": "failed"}
    return out | kept | {"state": "old" if is_step_outdated(session, record, lines) else "done"}


def is_step_outdated(session: Session, record: StepRecord, command_lines: list[str]) -> bool:
    """Whether a step would do something else now: other words, or other files."""
    changed = (session.file_sha256(path) != digest for path, digest in record.inputs.items())
    return list(record.commands) != command_lines or any(changed)


# ---- parts of the page -------------------------------------------------------------------------


def render_panels(
    session: Session, choices: SessionChoices, progress: StepProgress | None
) -> dict[str, str]:
    """HTML by the name of its place."""
    out = {}
    for name, made in PANEL_BUILDERS.items():
        try:
            content = made(session, choices, progress)
        except CalibrationError as error:
            out[name] = render_panel("problem", {"text": str(error)})
        else:
            out[name] = render_panel(name, content) if content is not None else ""
    return out


def render_panel(name: str, content: PanelContent) -> str:
    """A part of the page, by the macro of its name."""
    return str(getattr(load_panel_macros(), name)(**content))


@lru_cache(maxsize=1)
def load_panel_macros() -> Any:
    """The macros that write the parts."""
    from markupsafe import Markup

    jinja, _ = import_report_packages()
    found = load_template(jinja, "panels.html.jinja", "minimax_cal.webapp")
    found.globals["grid"] = lambda table: Markup(table.html())
    return found.module


def build_files_panel(
    session: Session, choices: SessionChoices, progress: StepProgress | None
) -> PanelContent:
    """The measured files, each with its part."""
    sizes = [
        (name, (session.folder / UPLOAD_FOLDER / name).stat().st_size) for name in choices.measured
    ]
    return {"files": sizes, "joints": choices.joints}


def build_import_panel(
    session: Session, choices: SessionChoices, progress: StepProgress | None
) -> PanelContent | None:
    """What the importer said."""
    path = session.folder / IMPORT_SUMMARY_FILE
    if not path.is_file():
        return None
    try:
        content = parse_json(path.read_bytes())
        headline = (
            f"{content['poses']} poses, {content['joints']} joints, "
            f"targets {', '.join(map(str, content['targets']))}"
        )
        tables = [describe_imported_file(each) for each in content["files"]]
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise CalibrationError(f"{path}: is not the JSON of an import") from error
    return {
        "headline": replace_invisible_and_bidi_characters(headline),
        "tables": tables,
        "notices": content["notices"],
    }


def describe_imported_file(file_record: dict[str, Any]) -> ImportedFileSummary:
    """A file in a line, and its columns."""
    line = (
        f"{file_record['file']}: {file_record['format']}, "
        f"{file_record['rows']} rows, {file_record['delimiter']}, "
    )
    line += f"decimal {file_record['decimal']}, {file_record['encoding']}"
    columns = file_record["columns"]
    header = tuple(columns[0]) if columns else ("column",)
    rows = tuple(
        tuple(replace_invisible_and_bidi_characters(str(v)) for v in column.values())
        for column in columns
    )
    return ImportedFileSummary(
        replace_invisible_and_bidi_characters(line),
        Table(str(file_record["file"]), header, rows),
    )


def build_robot_panel(
    session: Session, choices: SessionChoices, progress: StepProgress | None
) -> PanelContent | None:
    """The links of the robot, as its file was understood."""
    if not choices.robot:
        return None
    built_in = choices.robot in builtin_robots()
    file = (
        FileVersion(choices.robot, 0, 0)
        if built_in
        else file_version(session.folder / UPLOAD_FOLDER / choices.robot)
    )
    return {"table": read_links_table(*file)}


@lru_cache(maxsize=MAX_CACHED_RESULTS)
def read_links_table(robot_path: str, modified_ns: int, byte_count: int) -> Table:
    """Links and limits of a built-in robot, or of a file as it was at a moment."""
    return build_links_table(load_robot(robot_path))


def build_fit_result_panel(
    session: Session, choices: SessionChoices, progress: StepProgress | None
) -> PanelContent | None:
    """The calibration in a sentence, and its numbers in large letters."""
    path = session.folder / FIT_FILE
    if not path.is_file():
        return None
    found = read_fit_summary(*file_version(path))
    return {"headline": found.headline, "tiles": found.tiles, "solution": found.solution}


def build_accuracy_panel(
    session: Session, choices: SessionChoices, progress: StepProgress | None
) -> PanelContent | None:
    """The calibration's table of accuracy."""
    path = session.folder / FIT_FILE
    return (
        {"table": read_fit_summary(*file_version(path)).accuracy_table} if path.is_file() else None
    )


@lru_cache(maxsize=MAX_CACHED_RESULTS)
def read_fit_summary(fit_path: str, modified_ns: int, byte_count: int) -> FitSummary:
    """Headline, numbers, accuracy and facts of a calibration's file as it was at a moment."""
    fit = Fit.load(fit_path)
    seen = fit.within
    known = sum(parameter.identifiable for parameter in fit.parameters)
    tiles = [
        NumberTile("RMS", f"{seen.before.rms_mm:.3f}", f"{seen.after.rms_mm:.3f} mm"),
        NumberTile("largest", f"{seen.before.max_mm:.3f}", f"{seen.after.max_mm:.3f} mm"),
        NumberTile("parameters known", "", f"{known} of {len(fit.parameters)}"),
    ]
    return FitSummary(fit.headline(), tiles, fit.accuracy_table(), fit.describe_solution())


def build_points_panel(
    session: Session, choices: SessionChoices, progress: StepProgress | None
) -> PanelContent | None:
    """Every point with its error, the worst first."""
    fit, poses = session.folder / FIT_FILE, session.folder / POSES_FILE
    if not (fit.is_file() and poses.is_file()):
        return None
    found = list_points_with_errors(*file_version(fit), *file_version(poses))
    left = set(choices.left_out)

    def order(point: MeasuredPoint) -> tuple[bool, float]:
        return point.key not in left, -nan_to_num(point.after)

    shown = sorted(found, key=order)[: MAX_LISTED_POINTS + len(left)]
    over = [p for p in found if choices.most and p.after > choices.most and p.key not in left]
    return {"points": shown, "left": left, "why": choices.reasons, "limit": choices.most,
            "over": len(over), "more": len(found) - len(shown), "count": len(found)}  # fmt: skip


def build_diagnosis_panel(
    session: Session, choices: SessionChoices, progress: StepProgress | None
) -> PanelContent | None:
    """The diagnosis: while it is at work the rungs so far, then what it says."""
    if progress and progress.step == "diagnose":
        return {"rungs": progress.rungs, "sentences": (), "tables": []}
    path = session.folder / DIAGNOSIS_FILE
    if not path.is_file():
        return None
    sentences, tables, _ = read_diagnosis_summary(*file_version(path))
    return {"rungs": [], "sentences": sentences, "tables": tables}


@lru_cache(maxsize=MAX_CACHED_RESULTS)
def read_diagnosis_summary(
    diagnosis_path: str, modified_ns: int, byte_count: int
) -> DiagnosisSummary:
    """Sentences, tables and chart of a diagnosis' file as it was at a moment."""
    gap = load_diagnosis(diagnosis_path)
    tables = drop_empty_tables(gap.budget_table(), gap.effects_table(), gap.alternative_table())
    return DiagnosisSummary(
        gap.said, tables, chart_to_json_data(build_budget_chart_of_diagnosis(gap))
    )


def build_verdict_panel(
    session: Session, choices: SessionChoices, progress: StepProgress | None
) -> PanelContent | None:
    """What the report printed: passed, not passed or not stated, and why."""
    record = read_step_record(session, "judge")
    if not record or record.code:
        return None
    verdict, *lines = first_output_paragraph(session, "judge").splitlines() or [""]
    kind = record.more.get("looks", "unstated")
    return {
        "verdict": capitalise_sentence(verdict),
        "kind": kind,
        "lines": lines,
        "base": session_file_url(session),
    }


def build_plan_panel(
    session: Session, choices: SessionChoices, progress: StepProgress | None
) -> PanelContent | None:
    """What the plan promises, and its poses."""
    record, path = read_step_record(session, "plan"), session.folder / PLAN_FILE
    if not record or record.code or not path.is_file():
        return None
    rows = list(csv.reader(path.read_text("utf-8").splitlines()))
    header = rows[0] if rows else []
    kept = [i for i, name in enumerate(header) if name.startswith(("pose", "q"))]
    body = tuple(tuple(row[i] for i in kept) for row in rows[1 : MAX_PLAN_ROWS + 1])
    return {
        "promise": first_output_paragraph(session, "plan"),
        "table": Table(PLAN_FILE, tuple(header[i] for i in kept), body),
    }


def make_command_output_panel(
    step: str,
) -> Callable[[Session, SessionChoices, StepProgress | None], PanelContent | None]:
    """What the command of a step printed before its tables."""

    def made(at: Session, chosen: SessionChoices, job: StepProgress | None) -> PanelContent | None:
        text = first_output_paragraph(at, step)
        return {"text": text} if text else None

    return made


def first_output_paragraph(session: Session, step: str) -> str:
    """The first paragraph that the command of a step printed; empty where it did not end well."""
    record = read_step_record(session, step)
    return record.told.partition("\n\n")[0] if record and not record.code else ""


def build_downloads_panel(
    session: Session, choices: SessionChoices, progress: StepProgress | None
) -> PanelContent:
    """Every file that the commands wrote."""
    files = [
        (
            p.name,
            p.stat().st_size,
            WRITTEN_FILE_DESCRIPTIONS.get(p.name, ""),
            describe_file_accuracy(session, p.name),
        )
        for p in session.list_written_files()
    ]
    return {"files": files, "base": session_file_url(session)}


def describe_file_accuracy(session: Session, file_name: str) -> str:
    """How accurate the arm of a file is, as the command said that wrote it; else empty."""
    if file_name not in FILES_WITH_ACCURACY:
        return ""
    step = next(step for step, one in SESSION_STEPS.items() if one.result_file == file_name)
    record = read_step_record(session, step)
    told = record.more.get("accuracy", "") if record and not record.code else ""
    return first_output_paragraph(session, step) or told


def session_file_url(session: Session) -> str:
    """Where the files of a session are."""
    return f"/s/{session.name}/file"


PANEL_BUILDERS: dict[
    str, Callable[[Session, SessionChoices, StepProgress | None], PanelContent | None]
] = {
    "files": build_files_panel,
    "understood": build_import_panel,
    "robot": build_robot_panel,
    "fit": build_fit_result_panel,
    "accuracy": build_accuracy_panel,
    "points": build_points_panel,
    "ladder": build_diagnosis_panel,
    "verdict": build_verdict_panel,
    "plan": build_plan_panel,
    "told": make_command_output_panel("correct"),
    "downloads": build_downloads_panel,
}


def list_chart_versions(session: Session) -> dict[str, str]:
    """The charts that there are, each with a name that changes when it does."""
    paths = {"workspace": session.folder / FIT_FILE, "ladder": session.folder / DIAGNOSIS_FILE}
    return {
        name: "-".join(map(str, file_version(p)[1:])) for name, p in paths.items() if p.is_file()
    }
