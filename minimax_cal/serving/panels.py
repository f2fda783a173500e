"""What the page shows of a session: how each step stands, and what the commands wrote."""

from __future__ import annotations

import csv
from collections.abc import Callable
from functools import lru_cache
from typing import Any

from numpy import nan_to_num

from minimax_cal.diagnosing.result import load_diagnosis
from minimax_cal.fitting.fit import Fit
from minimax_cal.ground.errors import CalibrationError
from minimax_cal.ground.files import json_of
from minimax_cal.ground.tables import Table, filled
from minimax_cal.ground.words import capitalise, visible
from minimax_cal.reporting.html.more_charts import waterfall
from minimax_cal.reporting.html.page import figure_data, needed, template
from minimax_cal.robots.robot import builtin_robots, load_robot
from minimax_cal.robots.transforms import links_table
from minimax_cal.serving.cell import Point, points_of
from minimax_cal.serving.sessions import GIVEN, SCRIPT, Choices, Session, mark
from minimax_cal.serving.steps import (
    CORRECTED,
    DIAGNOSIS,
    FIT,
    MJCF,
    NEXT,
    POSES,
    REPORT,
    STEPS,
    UNDERSTOOD,
    URDF,
    USED,
    Command,
)
from minimax_cal.serving.work import Progress, Record, record_of

MOST_POINTS = 300  # rows of the table; the worst come first
MOST_ROWS = 60
KEPT = 16  # results in memory
ARMS = (FIT, URDF, MJCF, CORRECTED)  # whose accuracy stands beside them
WHAT = {
    SCRIPT: "all that was done here, as command lines",
    POSES: "the measurements, as they were understood",
    USED: "the measurements, with the points that were set aside and why",
    UNDERSTOOD: "what was understood of the files",
    FIT: "the calibration",
    DIAGNOSIS: "the diagnosis",
    REPORT: "the report to sign",
    NEXT: "the poses to measure next",
    URDF: "the calibrated robot",
    MJCF: "the calibrated robot for MuJoCo",
    CORRECTED: "the joint targets, corrected",
}
Panel = dict[str, Any]
Tile = tuple[str, str, str]  # name, before, after


def state_of(at: Session, job: Progress | None) -> dict[str, Any]:
    """All that the page shows, in JSON."""
    chosen = at.choices
    return {
        "name": at.name,
        "choices": chosen.model_dump(mode="json"),
        "robots": robots(at, chosen),
        "steps": {name: how(at, chosen, name, job) for name in STEPS},
        "panels": panels(at, chosen, job),
        "views": views(at),
    }


def robots(at: Session, chosen: Choices) -> list[tuple[str, str]]:
    """Value and label of every robot to choose: those built in, and files that were dropped."""
    known = chosen.files() - {chosen.robot}
    dropped = [(name, name) for name in at.given() if name not in known]
    return [*dropped, *builtins()]


@lru_cache(maxsize=1)
def builtins() -> tuple[tuple[str, str], ...]:
    """Value and label of the built-in robots."""
    return tuple((name, load_robot(name).name) for name in builtin_robots())


def how(at: Session, chosen: Choices, name: str, job: Progress | None) -> dict[str, Any]:
    """How a step stands: waiting, ready, working, done, old or failed; and its command lines."""
    record = record_of(at, name)
    commands: tuple[Command, ...] = ()
    waits = ""
    try:
        commands = STEPS[name].commands(at, chosen)
    except CalibrationError as error:
        waits = str(error)
    lines = [command.line() for command in commands]
    out = {"lines": lines, "waits": waits, "error": "", "notices": [], "state": "ready"}
    if job and job.step == name:
        return out | {"state": "working"}
    if record is None:
        return out | {"state": "waiting" if waits else "ready"}
    kept = {"error": record.error, "notices": list(record.notices), "seconds": record.seconds}
    if record.code:
        return out | kept | {"state": "failed"}
    return out | kept | {"state": "old" if is_old(at, record, lines) else "done"}


def is_old(at: Session, record: Record, lines: list[str]) -> bool:
    """Whether a step would do something else now: other words, or other files."""
    changed = (at.digest(path) != digest for path, digest in record.inputs.items())
    return list(record.commands) != lines or any(changed)


# ---- parts of the page -------------------------------------------------------------------------


def panels(at: Session, chosen: Choices, job: Progress | None) -> dict[str, str]:
    """HTML by the name of its place."""
    out = {}
    for name, made in PANELS.items():
        try:
            content = made(at, chosen, job)
        except CalibrationError as error:
            out[name] = written("problem", {"text": str(error)})
        else:
            out[name] = written(name, content) if content is not None else ""
    return out


def written(name: str, content: Panel) -> str:
    """A part of the page, by the macro of its name."""
    return str(getattr(macros(), name)(**content))


@lru_cache(maxsize=1)
def macros() -> Any:
    """The macros that write the parts."""
    from markupsafe import Markup

    jinja, _ = needed()
    found = template(jinja, "panels.html.jinja", "minimax_cal.serving")
    found.globals["grid"] = lambda table: Markup(table.html())
    return found.module


def files_panel(at: Session, chosen: Choices, job: Progress | None) -> Panel:
    """The measured files, each with its part."""
    sizes = [(name, (at.folder / GIVEN / name).stat().st_size) for name in chosen.measured]
    return {"files": sizes, "joints": chosen.joints}


def understood_panel(at: Session, chosen: Choices, job: Progress | None) -> Panel | None:
    """What the importer said."""
    path = at.folder / UNDERSTOOD
    if not path.is_file():
        return None
    try:
        content = json_of(path.read_bytes())
        headline = (
            f"{content['poses']} poses, {content['joints']} joints, "
            f"targets {', '.join(map(str, content['targets']))}"
        )
        tables = [understood(each) for each in content["files"]]
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise CalibrationError(f"{path}: is not the JSON of an import") from error
    return {"headline": visible(headline), "tables": tables, "notices": content["notices"]}


def understood(file: dict[str, Any]) -> tuple[str, Table]:
    """A file in a line, and its columns."""
    line = f"{file['file']}: {file['format']}, {file['rows']} rows, {file['delimiter']}, "
    line += f"decimal {file['decimal']}, {file['encoding']}"
    columns = file["columns"]
    header = tuple(columns[0]) if columns else ("column",)
    rows = tuple(tuple(visible(str(v)) for v in column.values()) for column in columns)
    return visible(line), Table(str(file["file"]), header, rows)


def robot_panel(at: Session, chosen: Choices, job: Progress | None) -> Panel | None:
    """The links of the robot, as its file was understood."""
    if not chosen.robot:
        return None
    built_in = chosen.robot in builtin_robots()
    file = (chosen.robot, 0, 0) if built_in else mark(at.folder / GIVEN / chosen.robot)
    return {"table": links_of(*file)}


@lru_cache(maxsize=KEPT)
def links_of(path: str, moment: int, size: int) -> Table:
    """Links and limits of a built-in robot, or of a file as it was at a moment."""
    return links_table(load_robot(path))


def fit_panel(at: Session, chosen: Choices, job: Progress | None) -> Panel | None:
    """The calibration in a sentence, and its numbers in large letters."""
    path = at.folder / FIT
    if not path.is_file():
        return None
    headline, tiles, _, solution = fit_words(*mark(path))
    return {"headline": headline, "tiles": tiles, "solution": solution}


def accuracy_panel(at: Session, chosen: Choices, job: Progress | None) -> Panel | None:
    """The calibration's table of accuracy."""
    path = at.folder / FIT
    return {"table": fit_words(*mark(path))[2]} if path.is_file() else None


@lru_cache(maxsize=KEPT)
def fit_words(path: str, moment: int, size: int) -> tuple[str, list[Tile], Table, str]:
    """Headline, numbers, accuracy and facts of a calibration's file as it was at a moment."""
    fit = Fit.load(path)
    seen = fit.within
    known = sum(parameter.identifiable for parameter in fit.parameters)
    tiles = [
        ("RMS", f"{seen.before.rms_mm:.3f}", f"{seen.after.rms_mm:.3f} mm"),
        ("largest", f"{seen.before.max_mm:.3f}", f"{seen.after.max_mm:.3f} mm"),
        ("parameters known", "", f"{known} of {len(fit.parameters)}"),
    ]
    return fit.headline(), tiles, fit.accuracy_table(), fit.solution()


def points_panel(at: Session, chosen: Choices, job: Progress | None) -> Panel | None:
    """Every point with its error, the worst first."""
    fit, poses = at.folder / FIT, at.folder / POSES
    if not (fit.is_file() and poses.is_file()):
        return None
    found = points_of(*mark(fit), *mark(poses))
    left = set(chosen.left_out)

    def order(point: Point) -> tuple[bool, float]:
        return point.key not in left, -nan_to_num(point.after)

    shown = sorted(found, key=order)[: MOST_POINTS + len(left)]
    over = [p for p in found if chosen.most and p.after > chosen.most and p.key not in left]
    return {"points": shown, "left": left, "why": chosen.reasons, "limit": chosen.most,
            "over": len(over), "more": len(found) - len(shown), "count": len(found)}  # fmt: skip


def ladder_panel(at: Session, chosen: Choices, job: Progress | None) -> Panel | None:
    """The diagnosis: while it is at work the rungs so far, then what it says."""
    if job and job.step == "diagnose":
        return {"rungs": job.rungs, "sentences": (), "tables": []}
    path = at.folder / DIAGNOSIS
    if not path.is_file():
        return None
    sentences, tables, _ = diagnosis_words(*mark(path))
    return {"rungs": [], "sentences": sentences, "tables": tables}


@lru_cache(maxsize=KEPT)
def diagnosis_words(
    path: str, moment: int, size: int
) -> tuple[tuple[str, ...], tuple[Table, ...], Panel]:
    """Sentences, tables and chart of a diagnosis' file as it was at a moment."""
    gap = load_diagnosis(path)
    tables = filled(gap.ladder_table(), gap.effects_table(), gap.rival_table())
    return gap.said, tables, figure_data(waterfall(gap))


def verdict_panel(at: Session, chosen: Choices, job: Progress | None) -> Panel | None:
    """What the report printed: passed, not passed or not stated, and why."""
    record = record_of(at, "judge")
    if not record or record.code:
        return None
    verdict, *lines = paragraph(at, "judge").splitlines() or [""]
    kind = record.more.get("looks", "unstated")
    return {"verdict": capitalise(verdict), "kind": kind, "lines": lines, "base": base(at)}


def plan_panel(at: Session, chosen: Choices, job: Progress | None) -> Panel | None:
    """What the plan promises, and its poses."""
    record, path = record_of(at, "plan"), at.folder / NEXT
    if not record or record.code or not path.is_file():
        return None
    rows = list(csv.reader(path.read_text("utf-8").splitlines()))
    header = rows[0] if rows else []
    kept = [i for i, name in enumerate(header) if name.startswith(("pose", "q"))]
    body = tuple(tuple(row[i] for i in kept) for row in rows[1 : MOST_ROWS + 1])
    return {
        "promise": paragraph(at, "plan"),
        "table": Table(NEXT, tuple(header[i] for i in kept), body),
    }


def told_panel(step: str) -> Callable[[Session, Choices, Progress | None], Panel | None]:
    """What the command of a step printed before its tables."""

    def made(at: Session, chosen: Choices, job: Progress | None) -> Panel | None:
        text = paragraph(at, step)
        return {"text": text} if text else None

    return made


def paragraph(at: Session, step: str) -> str:
    """The first paragraph that the command of a step printed; empty where it did not end well."""
    record = record_of(at, step)
    return record.told.partition("\n\n")[0] if record and not record.code else ""


def downloads_panel(at: Session, chosen: Choices, job: Progress | None) -> Panel:
    """Every file that the commands wrote."""
    files = [
        (p.name, p.stat().st_size, WHAT.get(p.name, ""), accuracy_of(at, p.name))
        for p in at.files()
    ]
    return {"files": files, "base": base(at)}


def accuracy_of(at: Session, name: str) -> str:
    """How accurate the arm of a file is, as the command said that wrote it; else empty."""
    if name not in ARMS:
        return ""
    step = next(step for step, one in STEPS.items() if one.writes == name)
    record = record_of(at, step)
    told = record.more.get("accuracy", "") if record and not record.code else ""
    return paragraph(at, step) or told


def base(at: Session) -> str:
    """Where the files of a session are."""
    return f"/s/{at.name}/file"


PANELS: dict[str, Callable[[Session, Choices, Progress | None], Panel | None]] = {
    "files": files_panel,
    "understood": understood_panel,
    "robot": robot_panel,
    "fit": fit_panel,
    "accuracy": accuracy_panel,
    "points": points_panel,
    "ladder": ladder_panel,
    "verdict": verdict_panel,
    "plan": plan_panel,
    "told": told_panel("correct"),
    "downloads": downloads_panel,
}


def views(at: Session) -> dict[str, str]:
    """The charts that there are, each with a name that changes when it does."""
    paths = {"workspace": at.folder / FIT, "ladder": at.folder / DIAGNOSIS}
    return {name: "-".join(map(str, mark(p)[1:])) for name, p in paths.items() if p.is_file()}
