"""The smaller tables of a diagnosis, and the library of effects as a table."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from minimax_cal.diagnosing.result import Diagnosis
from minimax_cal.diagnosing.where import triage_table
from minimax_cal.ground.files import number
from minimax_cal.ground.tables import Table
from minimax_cal.measuring.measurements import Measurements
from minimax_cal.modelling.cell import Cell
from minimax_cal.modelling.effects.scene import Scene
from minimax_cal.modelling.effects.table import EFFECTS
from minimax_cal.robots.robot import load_robot

NOWHERE = "poses or joints at which it would show"


def numbers(entry: Mapping[str, Any], *keys: str) -> list[float]:
    """Some of the numbers of an entry of a JSON."""
    return [number(entry[key]) for key in keys]


def where_tables(where: Mapping[str, Any]) -> tuple[Table, ...]:
    """What kind the geometric errors are, and how they spread over targets and joints.

    where: as in the JSON of a diagnosis.
    """
    targets = tuple(
        (entry["target"], entry["points"], *numbers(entry, "rms_mm", "max_mm", "mean_sight_mm"))
        for entry in where["by_target"]
    )
    joints = tuple(
        (
            entry["joint"],
            "mm" if "rms_mm" in entry else "mrad",
            number(entry.get("rms_mm", entry.get("rms_mrad"))),
            *numbers(entry, "share", "p"),
        )
        for entry in where["by_joint"]
    )
    return (
        triage_table(where["triage"]),
        Table(
            "what geometry leaves, by target",
            ("target", "points", "RMS mm", "max mm", "mean along the line of sight mm"),
            targets,
            ("", "d", ".4f", ".4f", "+.4f"),
        ),
        Table(
            "what geometry leaves, as turns of each joint",
            ("joint", "unit", "RMS", "share that its own value explains", "p"),
            joints,
            ("", "", ".4f", ".2f", ".1g"),
        ),
    )


def closing_tables(diagnosis: Diagnosis) -> tuple[Table, ...]:
    """What could not be tested, and which further measurement would tell rivals apart."""
    rows = tuple(
        (f"{f.term.effect} {f.term.place}", f"{a.effect} {a.place}", a.rho2, a.separate_with)
        for f in diagnosis.findings
        for a in f.alternatives
        if a.separate_with
    )
    needs = Table("not testable with these data", ("effect", "needs"), diagnosis.not_testable)
    header = ("effect", "or rather", "likeness", "what would tell them apart")
    further = Table("what to measure next", header, rows, ("", "", ".3f", ""))
    return tuple(table for table in (needs, further) if table.rows)


def bare_scene() -> Scene:
    """An arm of which nothing is known: one pose, one target, no visit order."""
    robot = load_robot("irb2600")
    cell = Cell(robot, np.eye(4), ("smr1",), np.zeros((1, 3)))
    q, y = np.zeros((1, robot.joints)), np.full((1, 1, 3), np.nan)
    return cell.scene(
        Measurements(q, y, cell.target_names, robot.prismatic, np.ones(1, dtype=int), {})
    )


def effects_list(scene: Scene | None = None) -> list[dict[str, Any]]:
    """The library for JSON; with a scene, the places that its data can test and what they lack."""
    out: list[dict[str, Any]] = []
    at = bare_scene() if scene is None else scene
    for effect in EFFECTS.values():
        missing = effect.needs(at)
        out.append({"effect": effect.name, "cause": effect.cause, "law": effect.law})
        if scene is not None:
            places = [] if missing else list(effect.places(scene))
            missing = missing or ("" if places else NOWHERE)
            out[-1]["places"] = places
        out[-1]["needs"] = missing
    return out


def effects_table(entries: Sequence[Mapping[str, Any]]) -> Table:
    """`effects_list` for people."""
    header = {"effect": "name", "cause": "cause", "law": "law", "needs": "needs"}
    if "places" in entries[0]:
        places = "places these data can test"
        header = {"effect": "name", "places": places, "cause": "cause", "needs": "lacking"}
    told = [{**entry, "places": ", ".join(entry.get("places", ()))} for entry in entries]
    rows = tuple(tuple(entry[key] for key in header) for entry in told)
    return Table("effects beyond geometry", tuple(header.values()), rows)
