"""Where the errors that geometry leaves lie, and what they follow there, before any cause is named.

What they follow is asked once for all, of everything that may remain: see `evidence.remains`.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np

from minimax_cal.core.arrays import Array, rms
from minimax_cal.core.files import convert_to_plain_json
from minimax_cal.core.record_fields import (
    FieldFormat,
    InMillimetres,
    LengthInMillimetres,
    StoredSeparately,
    derived_field,
    record_to_file_values,
)
from minimax_cal.diagnosing.remaining_error import compare_all_components
from minimax_cal.diagnosing.residual_curves import fit_equivalent_rotations
from minimax_cal.diagnosing.study import LinearisedGeometry
from minimax_cal.fitting.noise_floor import instrument_coordinate_sigma
from minimax_cal.measuring.faults.point_faults import estimate_noise_from_distances
from minimax_cal.measuring.session_frames import instrument_positions
from minimax_cal.selection.remaining_structure import StructureComponent, StructureTest
from minimax_cal.selection.thresholds import REMAINING_STRUCTURE_P_VALUE

MIN_POINTS_FOR_NINE_REGIONS = (
    90  # points from which the workspace is cut into three by three regions, not two by two
)
MIN_REGION_POINTS = 9  # points of a region: the RMS of fewer is luck


@dataclass(frozen=True)
class LocalDependence:
    """What errors follow at a place, of all that was asked there.

    place, follows: of it.  share: of the squared error, as far as this tells it.  p: chance that
    anything that was asked is so loud.
    """

    place: str = ""
    follows: str = ""
    share: float = math.nan
    p: float = math.nan


@dataclass(frozen=True, eq=False)
class TargetErrors:
    """Errors of one target.  mean: (3,) in base axes; sight: mean along the line of sight [m]."""

    name: Annotated[str, FieldFormat(key="target")]
    points: int
    rms: LengthInMillimetres
    worst: Annotated[float, FieldFormat(key="max_mm", scale=1e3)]
    mean: InMillimetres[Array]
    sight: Annotated[float, FieldFormat(key="mean_sight_mm", scale=1e3)]
    what: StoredSeparately[LocalDependence]


@dataclass(frozen=True)
class JointErrors:
    """Errors as one joint's: RMS of its equivalent turn [rad, m], and what they follow there."""

    joint: str
    sliding: bool
    rms: float
    what: LocalDependence


@dataclass(frozen=True)
class WorkspaceRegion:
    """Errors in one cell of the workspace.  radius, height: its edges [m]."""

    name: Annotated[str, FieldFormat(key="region")]
    radius: InMillimetres[tuple[float, float]]
    height: InMillimetres[tuple[float, float]]
    points: int
    rms: LengthInMillimetres


@dataclass(frozen=True, eq=False)
class ErrorLocations:
    """Where the errors of a fit lie.

    order, temperature: what follows them, None where the data cannot tell.  noise: of the
    instrument, per coordinate, as given or by the targets' distances, NaN if neither [m].
    """

    by_target: tuple[TargetErrors, ...]
    by_joint: tuple[JointErrors, ...]
    by_region: Annotated[tuple[WorkspaceRegion, ...], FieldFormat(key="by_region.cells")]
    order: Annotated[LocalDependence | None, FieldFormat(key="by_order.clock")]
    temperature: Annotated[LocalDependence | None, FieldFormat(key="by_order.temperature")]
    noise: LengthInMillimetres

    @derived_field(key="by_region.worst")
    def worst_region(self) -> str:
        """The cell with the largest RMS, in words; empty if there are none."""
        if not self.by_region:
            return ""
        worst = max(self.by_region, key=lambda cell: cell.rms)
        points = sum(cell.points for cell in self.by_region)
        square = sum(cell.points * cell.rms**2 for cell in self.by_region)
        (near, far), (low, high) = worst.radius, worst.height
        return (
            f"{worst.name}: {near:.2f} to {far:.2f} m from the base axis, {low:.2f} to "
            f"{high:.2f} m high, RMS {1e3 * worst.rms:.3f} mm "
            f"({1e3 * math.sqrt(square / points):.3f} mm everywhere)"
        )

    def to_dict(self) -> dict[str, object]:
        """For JSON: strictly JSON-able, units in the names, null for what cannot be told."""
        told = record_to_file_values(self)
        told["by_target"] = [record_to_file_values(one) | vars(one.what) for one in self.by_target]
        told["by_joint"] = [
            {"joint": one.joint, f"rms_{'mm' if one.sliding else 'mrad'}": 1e3 * one.rms,
             **vars(one.what)}
            for one in self.by_joint
        ]  # fmt: skip
        return dict(convert_to_plain_json(told))


def locate_errors(study: LinearisedGeometry) -> ErrorLocations:
    """Where the errors of a study's geometric fit lie."""
    data, base = study.data, study.geometric_cell.base
    error = study.model.point_errors(study.fit.state)
    point = (data.y - base[:3, 3]) @ base[:3, :3]
    seen = data.y - instrument_positions(data)[:, None]  # from the instrument
    sight = seen / np.linalg.norm(seen, axis=-1, keepdims=True) @ base[:3, :3]
    given, between = instrument_coordinate_sigma(data), estimate_noise_from_distances(data)
    noise = between[0] if between and not math.isfinite(given) else given
    turn = fit_equivalent_rotations(error, study.scene.jacobian, noise)
    every = compare_all_components(study.scene, study.rows)
    if np.sum(study.rows.error**2) < study.rows.measured_row_count * study.rows.rounding_noise**2:
        every = replace(every, components=())  # rounding follows nothing

    def at(place: str) -> LocalDependence:
        own = (place, f"{place} tilting", f"{place} along the line of sight")
        return find_main_dependence(every, lambda one: one.place in own) or LocalDependence(place)

    return ErrorLocations(
        by_target=tuple(
            summarise_target_errors(name, error[:, i], sight[:, i], at(name))
            for i, name in enumerate(data.target_names)
        ),
        by_joint=tuple(
            JointErrors(f"J{j + 1}", bool(slides), rms(turn[:, j]), at(f"J{j + 1}"))
            for j, slides in enumerate(data.sliding)
        ),
        by_region=summarise_region_errors(error, point, study.robot.up),
        order=find_main_dependence(
            every, lambda one: one.driver.startswith(("time", "the previous"))
        ),
        temperature=find_main_dependence(every, lambda one: one.driver == "temperature"),
        noise=noise,
    )


def find_main_dependence(
    structure_test: StructureTest, is_selected: Callable[[StructureComponent], bool]
) -> LocalDependence | None:
    """What the errors follow of some components; None where none was asked.

    Of those that are certain what tells most of the error, by the fewest functions; else what is
    the least by chance.
    """
    numbers = [i for i, one in enumerate(structure_test.components) if is_selected(one)]
    sure = [
        i
        for i in numbers
        if i in structure_test.significant_numbers
        and structure_test.p_values[i] < REMAINING_STRUCTURE_P_VALUE
    ]
    told = sorted(
        map(structure_test.describe_component, sure), key=lambda one: one.sort_key_by_fraction
    )
    most = next(iter(told or structure_test.select_most_significant(numbers, 1)), None)
    return (
        LocalDependence(most.place, most.driver, min(most.square_fraction, 1.0), most.p)
        if most
        else None
    )


def summarise_target_errors(
    name: str, error: Array, sight: Array, dependence: LocalDependence
) -> TargetErrors:
    """Errors of a target.  error, sight (unit vectors): (m, 3), NaN if not measured."""
    seen = np.isfinite(error[:, 0])
    rows, far = error[seen], np.linalg.norm(error[seen], axis=1)
    if not len(rows):
        return TargetErrors(name, 0, math.nan, math.nan, np.full(3, np.nan), math.nan, dependence)
    along = float((rows * sight[seen]).sum(axis=1).mean())
    return TargetErrors(
        name, len(rows), rms(far), float(far.max()), rows.mean(0), along, dependence
    )


def summarise_region_errors(error: Array, point: Array, up: Array) -> tuple[WorkspaceRegion, ...]:
    """Cells of the workspace by radius and height, each with as many points; few have fewer cells.

    error, point: (m, k, 3) in base axes.
    """
    axis, seen = up / np.linalg.norm(up), np.isfinite(error[..., 0])
    spots, square = point[seen], (error[seen] ** 2).sum(-1)
    height = spots @ axis
    radius = np.linalg.norm(spots - height[:, None] * axis, axis=1)
    out, away = ["close in", "far out"], ["low", "high"]
    if len(spots) >= MIN_POINTS_FOR_NINE_REGIONS:
        out, away = ["close in", "midway", "far out"], ["low", "mid-height", "high"]
    rings = np.quantile(radius, np.linspace(0.0, 1.0, len(out) + 1))
    floors = np.quantile(height, np.linspace(0.0, 1.0, len(away) + 1))
    ring = np.searchsorted(rings[1:-1], radius, side="right")
    floor = np.searchsorted(floors[1:-1], height, side="right")
    cells = []
    for i, far in enumerate(out):
        for j, high in enumerate(away):
            inside = (ring == i) & (floor == j)
            if inside.sum() < MIN_REGION_POINTS:
                continue
            edges = (float(rings[i]), float(rings[i + 1])), (float(floors[j]), float(floors[j + 1]))
            size = float(np.sqrt(square[inside].mean()))
            cells.append(WorkspaceRegion(f"{far} and {high}", *edges, int(inside.sum()), size))
    return tuple(cells)
