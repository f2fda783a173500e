"""Where the errors of a diagnosis lie, and the library of effects as a table."""

from __future__ import annotations

import math
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
from minimax_cal.modelling.effects.words import name_place
from minimax_cal.robots.robot import load_robot

LEVEL = 0.01  # chance of a pattern below which it is one
NOWHERE = "poses or joints at which it would show"


def numbers(entry: Mapping[str, Any], *keys: str) -> list[float]:
    """Some of the numbers of an entry of a JSON."""
    return [number(entry[key]) for key in keys]


def where_tables(where: Mapping[str, Any]) -> tuple[Table, ...]:
    """Where the geometric errors lie: kind, targets, joints, directions, regions, trends.

    where: as in the JSON of a diagnosis.
    """
    targets = tuple(
        (entry["target"], entry["points"], *numbers(entry, "rms_mm", "max_mm", "mean_sight_mm"))
        for entry in where["by_target"]
    )
    joints = tuple(
        (entry["joint"], unit, *numbers(entry, f"rms_{unit}", "share", "p"))
        for entry in where["by_joint"]
        for unit in ("mm" if "rms_mm" in entry else "mrad",)
    )
    directions = tuple(
        (name.removesuffix("_mm").replace("_", " "), number(value))
        for name, value in where["by_direction"].items()
    )
    regions = tuple(
        (cell["region"], *map(number, (*cell["radius_mm"], *cell["height_mm"])), cell["points"],
         number(cell["rms_mm"]))
        for cell in where["by_region"]["cells"]
    )  # fmt: skip
    trends = tuple(
        ({"clock": "visit order"}.get(name, name), *numbers(trend, "share", "p"))
        for name, trend in where["by_order"].items()
        if trend
    )
    parts = (
        ("by target", ("target", "points", "RMS mm", "max mm", "mean along the line of sight mm"),
         targets, ("", "d", ".4f", ".4f", "+.4f")),
        (f"as rotations of each joint; p-values below {LEVEL:g} are significant",
         ("joint", "unit", "RMS", "share that its own value explains", "p-value"),
         joints, ("", "", ".4f", ".2f", ".1g")),
        ("by direction", ("direction", "RMS mm"), directions, ("", ".4f")),
        ("by region", ("region", "from the base axis mm", "to mm", "height from mm", "to mm",
                       "points", "RMS mm"), regions, ("", ".0f", ".0f", ".0f", ".0f", "d", ".4f")),
        (f"trends; p-values below {LEVEL:g} are significant", ("against", "share explained",
         "p-value"), trends, ("", ".2f", ".1g")),
    )  # fmt: skip
    left = [Table(f"error after geometry, {by}", *rest) for by, *rest in parts]
    shown = tuple(table for table in (triage_table(where["triage"]), *left) if table.rows)
    for table in shown:
        table.cells()  # an entry that is no number is found here, where its file is known
    return shown


def remainder_table(found: Diagnosis) -> Table:
    """What the last rung leaves: what follows the pose, and where; what random."""
    left, rows = found.remainder, []
    if left:
        ends = zip(("at least", "at most"), left.floor_mm or (), strict=False)
        rows = [
            ("follows the pose, and could be predicted", left.predictable_mm, math.nan),
            *(
                (f"  of it {name_place(place)}", math.nan, 100.0 * share)
                for place, share in left.where
            ),
            ("random", left.unpredictable_mm, math.nan),
            *((f"noise alone, {name}", end, math.nan) for name, end in ends),
        ]
    header = ("part", "RMS mm", "share %")
    return Table("remaining error", header, tuple(rows), ("", ".4f", ".0f"))


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
