"""Where the errors that geometry leaves lie, and what they follow there, before any cause is named.

What they follow is asked once for all, of everything that may remain: see `evidence.remains`.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np

from minimax_cal.diagnosing.curves import joint_equivalent
from minimax_cal.diagnosing.study import Study
from minimax_cal.diagnosing.what_remains import asked_of
from minimax_cal.evidence.limits import STRUCTURE
from minimax_cal.evidence.remains import Asked, Component
from minimax_cal.fitting.floor import instrument_noise
from minimax_cal.ground.arrays import Array, rms
from minimax_cal.ground.facts import Apart, Fact, Milli, Mm, derived, in_file
from minimax_cal.ground.files import plain
from minimax_cal.measuring.faults.points import noise_between
from minimax_cal.measuring.stations import stood

MANY = 90  # points from which the workspace is cut into three by three regions, not two by two
FEWEST = 9  # points of a region: the RMS of fewer is luck


@dataclass(frozen=True)
class Follows:
    """What errors follow at a place, of all that was asked there.

    place, follows: of it.  share: of the squared error, as far as this tells it.  p: chance that
    anything that was asked is so loud.
    """

    place: str = ""
    follows: str = ""
    share: float = math.nan
    p: float = math.nan


@dataclass(frozen=True, eq=False)
class TargetGap:
    """Errors of one target.  mean: (3,) in base axes; sight: mean along the line of sight [m]."""

    name: Annotated[str, Fact(key="target")]
    points: int
    rms: Mm
    worst: Annotated[float, Fact(key="max_mm", scale=1e3)]
    mean: Milli[Array]
    sight: Annotated[float, Fact(key="mean_sight_mm", scale=1e3)]
    what: Apart[Follows]


@dataclass(frozen=True)
class JointGap:
    """Errors as one joint's: RMS of its equivalent turn [rad, m], and what they follow there."""

    joint: str
    sliding: bool
    rms: float
    what: Follows


@dataclass(frozen=True)
class Region:
    """Errors in one cell of the workspace.  radius, height: its edges [m]."""

    name: Annotated[str, Fact(key="region")]
    radius: Milli[tuple[float, float]]
    height: Milli[tuple[float, float]]
    points: int
    rms: Mm


@dataclass(frozen=True, eq=False)
class Where:
    """Where the errors of a fit lie.

    order, temperature: what follows them, None where the data cannot tell.  noise: of the
    instrument, per coordinate, as given or by the targets' distances, NaN if neither [m].
    """

    by_target: tuple[TargetGap, ...]
    by_joint: tuple[JointGap, ...]
    by_region: Annotated[tuple[Region, ...], Fact(key="by_region.cells")]
    order: Annotated[Follows | None, Fact(key="by_order.clock")]
    temperature: Annotated[Follows | None, Fact(key="by_order.temperature")]
    noise: Mm

    @derived(key="by_region.worst")
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
        told = in_file(self)
        told["by_target"] = [in_file(one) | vars(one.what) for one in self.by_target]
        told["by_joint"] = [
            {"joint": one.joint, f"rms_{'mm' if one.sliding else 'mrad'}": 1e3 * one.rms,
             **vars(one.what)}
            for one in self.by_joint
        ]  # fmt: skip
        return dict(plain(told))


def where(study: Study) -> Where:
    """Where the errors of a study's geometric fit lie."""
    data, base = study.data, study.geometric.base
    error = study.model.error(study.fit.state)
    point = (data.y - base[:3, 3]) @ base[:3, :3]
    seen = data.y - stood(data)[:, None]  # from the instrument
    sight = seen / np.linalg.norm(seen, axis=-1, keepdims=True) @ base[:3, :3]
    given, between = instrument_noise(data), noise_between(data)
    noise = between[0] if between and not math.isfinite(given) else given
    turn = joint_equivalent(error, study.scene.jacobian, noise)
    every = asked_of(study.scene, study.rows)
    if np.sum(study.rows.error**2) < study.rows.count * study.rows.exact**2:
        every = replace(every, components=())  # rounding follows nothing

    def at(place: str) -> Follows:
        own = (place, f"{place} tilting", f"{place} along the line of sight")
        return loudest(every, lambda one: one.place in own) or Follows(place)

    return Where(
        by_target=tuple(
            of_target(name, error[:, i], sight[:, i], at(name))
            for i, name in enumerate(data.target_names)
        ),
        by_joint=tuple(
            JointGap(f"J{j + 1}", bool(slides), rms(turn[:, j]), at(f"J{j + 1}"))
            for j, slides in enumerate(data.sliding)
        ),
        by_region=by_region(error, point, study.robot.up),
        order=loudest(every, lambda one: one.driver.startswith(("time", "the previous"))),
        temperature=loudest(every, lambda one: one.driver == "temperature"),
        noise=noise,
    )


def loudest(every: Asked, chosen: Callable[[Component], bool]) -> Follows | None:
    """What the errors follow of some components; None where none was asked.

    Of those that are certain what tells most of the error, by the fewest functions; else what is
    the least by chance.
    """
    numbers = [i for i, one in enumerate(every.components) if chosen(one)]
    sure = [i for i in numbers if i in every.loud and every.p[i] < STRUCTURE]
    told = sorted(map(every.told, sure), key=lambda one: one.telling)
    most = next(iter(told or every.loudest(numbers, 1)), None)
    return Follows(most.place, most.driver, min(most.share, 1.0), most.p) if most else None


def of_target(name: str, error: Array, sight: Array, what: Follows) -> TargetGap:
    """Errors of a target.  error, sight (unit vectors): (m, 3), NaN if not measured."""
    seen = np.isfinite(error[:, 0])
    rows, far = error[seen], np.linalg.norm(error[seen], axis=1)
    if not len(rows):
        return TargetGap(name, 0, math.nan, math.nan, np.full(3, np.nan), math.nan, what)
    along = float((rows * sight[seen]).sum(axis=1).mean())
    return TargetGap(name, len(rows), rms(far), float(far.max()), rows.mean(0), along, what)


def by_region(error: Array, point: Array, up: Array) -> tuple[Region, ...]:
    """Cells of the workspace by radius and height, each with as many points; few have fewer cells.

    error, point: (m, k, 3) in base axes.
    """
    axis, seen = up / np.linalg.norm(up), np.isfinite(error[..., 0])
    spots, square = point[seen], (error[seen] ** 2).sum(-1)
    height = spots @ axis
    radius = np.linalg.norm(spots - height[:, None] * axis, axis=1)
    out, away = ["close in", "far out"], ["low", "high"]
    if len(spots) >= MANY:
        out, away = ["close in", "midway", "far out"], ["low", "mid-height", "high"]
    rings = np.quantile(radius, np.linspace(0.0, 1.0, len(out) + 1))
    floors = np.quantile(height, np.linspace(0.0, 1.0, len(away) + 1))
    ring = np.searchsorted(rings[1:-1], radius, side="right")
    floor = np.searchsorted(floors[1:-1], height, side="right")
    cells = []
    for i, far in enumerate(out):
        for j, high in enumerate(away):
            inside = (ring == i) & (floor == j)
            if inside.sum() < FEWEST:
                continue
            edges = (float(rings[i]), float(rings[i + 1])), (float(floors[j]), float(floors[j + 1]))
            size = float(np.sqrt(square[inside].mean()))
            cells.append(Region(f"{far} and {high}", *edges, int(inside.sum()), size))
    return tuple(cells)
