"""Where the errors of a diagnosis lie, and the library of effects as a table."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from minimax_cal.core.files import float_from_json
from minimax_cal.core.tables import Table, drop_empty_tables
from minimax_cal.diagnosing.diagnosis import Diagnosis
from minimax_cal.measuring.measurements import Measurements
from minimax_cal.modelling.cell import Cell
from minimax_cal.modelling.effects.effect_names import format_p_value, format_remaining_structure
from minimax_cal.modelling.effects.scene import PosedArm
from minimax_cal.modelling.effects.table import EFFECTS
from minimax_cal.robots.robot import load_robot

NO_PLACE_TO_TEST_TEXT = "poses or joints at which it would show"


def read_numbers(entry: Mapping[str, Any], *keys: str) -> list[float]:
    """Some of the numbers of an entry of a JSON."""
    return [float_from_json(entry[key]) for key in keys]


def build_error_location_tables(
    locations: Mapping[str, Any], joint_rotations: Mapping[str, tuple[float, str]] | None = None
) -> tuple[Table, ...]:
    """Where the geometric errors lie: targets, joints, regions, and what they follow.

    locations: as in the JSON of a diagnosis.  joint_rotations: how far effects turn a joint at most
    [mrad], and at which pose, by the joint's name.
    """
    most = joint_rotations or {}

    def what(entry: Mapping[str, Any]) -> tuple[str, float, str]:
        share, p = float_from_json(entry.get("share")), float_from_json(entry.get("p"))
        return str(entry.get("follows", "")), 100.0 * share, format_p_value(p)

    targets = (
        (
            entry["target"],
            entry["points"],
            *read_numbers(entry, "rms_mm", "max_mm", "mean_sight_mm"),
            *what(entry),
        )
        for entry in locations["by_target"]
    )
    joints = (
        (entry["joint"], unit, *read_numbers(entry, f"rms_{unit}"), *what(entry),
         *most.get(str(entry["joint"]), ("", "")))
        for entry in locations["by_joint"]
        for unit in ("mm" if "rms_mm" in entry else "mrad",)
    )  # fmt: skip
    regions = (
        (
            cell["region"],
            *map(float_from_json, (*cell["radius_mm"], *cell["height_mm"])),
            cell["points"],
            float_from_json(cell["rms_mm"]),
        )
        for cell in locations["by_region"]["cells"]
    )
    trends = (
        ({"clock": "visit order"}.get(name, name), trend.get("place", ""), *what(trend))
        for name, trend in locations["by_order"].items()
        if trend
    )
    left, follows = "error after geometry,", "follows | % of it .0f | p-value"
    by_joint = Table.from_rows(
        f"{left} as rotations of each joint alone",
        joints,
        f"joint | unit | RMS .4f | {follows} | all effects turn it at most mrad .4f | at",
    )
    shown = drop_empty_tables(
        Table.from_rows(
            f"{left} by target",
            targets,
            "target | points d | RMS mm .4f | max mm .4f | "
            f"mean along the line of sight mm +.4f | {follows}",
        ),
        by_joint if most else by_joint.select_columns(*range(6)),
        Table.from_rows(
            f"{left} by region",
            regions,
            "region | from the base axis mm .0f | to mm .0f | "
            "height from mm .0f | to mm .0f | points d | RMS mm .4f",
        ),
        Table.from_rows(f"{left} by time", trends, f"by | where | {follows}"),
    )
    for table in shown:
        table.formatted_cells()  # an entry that is no number is found here, where its file is known
    return shown


def build_remaining_error_table(diagnosis: Diagnosis) -> Table:
    """What the last step leaves, by where it comes from."""
    left, rows = diagnosis.remaining, []
    if left:
        known = np.isfinite(left.noise_mm)
        rows = [
            (f"noise ({left.noise_from})" if known else "noise, not known", left.noise_mm, "-"),
            *(
                (format_remaining_structure(one.name), one.rms_mm, format_p_value(one.p))
                for one in left.depends
            ),
            ("explained by nothing", left.unexplained_mm, "-"),
        ]
    return Table.from_rows(
        "remaining error; motions overlap: the first counts", rows, "part | RMS mm .4f | p-value"
    )


def build_minimal_posed_arm() -> PosedArm:
    """An arm of which nothing is known: one pose, one target, no visit order."""
    robot = load_robot("irb2600")
    cell = Cell(robot, np.eye(4), ("smr1",), np.zeros((1, 3)))
    q, y = np.zeros((1, robot.joints)), np.full((1, 1, 3), np.nan)
    return cell.pose_arm(
        Measurements(q, y, cell.target_names, robot.prismatic, np.ones(1, dtype=int), {})
    )


def list_effects(posed_arm: PosedArm | None = None) -> list[dict[str, Any]]:
    """The library for JSON; with a scene, the places that its data can test and what they lack."""
    out: list[dict[str, Any]] = []
    at = build_minimal_posed_arm() if posed_arm is None else posed_arm
    for effect in EFFECTS.values():
        missing = effect.needs(at)
        out.append({"effect": effect.name, "cause": effect.cause, "law": effect.law})
        if posed_arm is not None:
            places = [] if missing else list(effect.places(posed_arm))
            missing = missing or ("" if places else NO_PLACE_TO_TEST_TEXT)
            out[-1]["places"] = places
        out[-1]["needs"] = missing
    return out


def build_effects_table(entries: Sequence[Mapping[str, Any]]) -> Table:
    """`list_effects` for people."""
    columns = "effect=name | cause | law | needs"
    if "places" in entries[0]:
        columns = "effect=name | places=places these data can test | cause | needs=lacking"
    return Table.from_records("effects beyond geometry", entries, columns)
