"""Where the errors of a diagnosis lie, and the library of effects as a table."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from minimax_cal.diagnosing.result import Diagnosis
from minimax_cal.ground.files import number
from minimax_cal.ground.tables import Table, filled
from minimax_cal.measuring.measurements import Measurements
from minimax_cal.modelling.cell import Cell
from minimax_cal.modelling.effects.scene import Scene
from minimax_cal.modelling.effects.table import EFFECTS
from minimax_cal.modelling.effects.words import name_chance, name_structure
from minimax_cal.robots.robot import load_robot

NOWHERE = "poses or joints at which it would show"


def numbers(entry: Mapping[str, Any], *keys: str) -> list[float]:
    """Some of the numbers of an entry of a JSON."""
    return [number(entry[key]) for key in keys]


def where_tables(
    where: Mapping[str, Any], turned: Mapping[str, tuple[float, str]] | None = None
) -> tuple[Table, ...]:
    """Where the geometric errors lie: targets, joints, regions, and what they follow.

    where: as in the JSON of a diagnosis.  turned: how far effects turn a joint at most [mrad], and
    at which pose, by the joint's name.
    """
    most = turned or {}

    def what(entry: Mapping[str, Any]) -> tuple[str, float, str]:
        share, p = number(entry.get("share")), number(entry.get("p"))
        return str(entry.get("follows", "")), 100.0 * share, name_chance(p)

    targets = (
        (entry["target"], entry["points"], *numbers(entry, "rms_mm", "max_mm", "mean_sight_mm"),
         *what(entry))
        for entry in where["by_target"]
    )  # fmt: skip
    joints = (
        (entry["joint"], unit, *numbers(entry, f"rms_{unit}"), *what(entry),
         *most.get(str(entry["joint"]), ("", "")))
        for entry in where["by_joint"]
        for unit in ("mm" if "rms_mm" in entry else "mrad",)
    )  # fmt: skip
    regions = (
        (cell["region"], *map(number, (*cell["radius_mm"], *cell["height_mm"])), cell["points"],
         number(cell["rms_mm"]))
        for cell in where["by_region"]["cells"]
    )  # fmt: skip
    trends = (
        ({"clock": "visit order"}.get(name, name), trend.get("place", ""), *what(trend))
        for name, trend in where["by_order"].items()
        if trend
    )
    left, follows = "error after geometry,", "follows | % of it .0f | p-value"
    by_joint = Table.made(
        f"{left} as rotations of each joint alone",
        joints,
        f"joint | unit | RMS .4f | {follows} | all effects turn it at most mrad .4f | at",
    )
    shown = filled(
        Table.made(f"{left} by target", targets, "target | points d | RMS mm .4f | max mm .4f | "
                   f"mean along the line of sight mm +.4f | {follows}"),
        by_joint if most else by_joint.only(*range(6)),
        Table.made(f"{left} by region", regions, "region | from the base axis mm .0f | to mm .0f | "
                   "height from mm .0f | to mm .0f | points d | RMS mm .4f"),
        Table.made(f"{left} by time", trends, f"by | where | {follows}"),
    )  # fmt: skip
    for table in shown:
        table.cells()  # an entry that is no number is found here, where its file is known
    return shown


def remaining_table(found: Diagnosis) -> Table:
    """What the last step leaves, by where it comes from."""
    left, rows = found.remaining, []
    if left:
        known = np.isfinite(left.noise_mm)
        rows = [
            (f"noise ({left.noise_from})" if known else "noise, not known", left.noise_mm, "-"),
            *((name_structure(one.name), one.rms_mm, name_chance(one.p)) for one in left.depends),
            ("explained by nothing", left.unexplained_mm, "-"),
        ]
    return Table.made(
        "remaining error; motions overlap: the first counts", rows, "part | RMS mm .4f | p-value"
    )


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
    columns = "effect=name | cause | law | needs"
    if "places" in entries[0]:
        columns = "effect=name | places=places these data can test | cause | needs=lacking"
    return Table.of("effects beyond geometry", entries, columns)
