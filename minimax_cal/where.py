"""Where the gap between model and robot lies, before any effect is named.

Nothing here knows a displacement law.  Errors are cut by target, joint, direction, region and visit
order; mean squares tell the instrument's noise, the targets' scatter against each other, the
scatter between revisits and the static rest apart; a kernel test tells whether structure is left.

Rows are kept as blocks, one for each pose: (m, 3k) with 0 where a target was not measured.  Tests
treat poses, not points, as independent: the joints' jitter moves all targets of a pose together.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from scipy.linalg import qr
from scipy.optimize import brentq
from scipy.stats import chi2, f, norm

from minimax_cal.data import Measurements, groups
from minimax_cal.kinematics import Array
from minimax_cal.tables import Cell, Table

NO_FIT: Array = np.zeros((0, 0, 0, 0))
UP: Array = np.array([0.0, 0.0, 1.0])
WAVES = 6  # half-waves over the range of a joint that count as smooth
SLOW = 2  # half-waves over the session that count as a drift
RANK = 24  # features of the kernel over the joints
GRID = 25
FLAT = 1e-8  # share of a feature's energy below which the fit has taken it


# ---------------------------------------------------------------- numbers for people


def plain(value: float, scale: float = 1.0) -> float | None:
    """A number for JSON: NaN and infinity are null."""
    return float(value) * scale if math.isfinite(value) else None


@dataclass(frozen=True, eq=False)
class TargetGap:
    """Errors of one target.  mean: (3,) in base axes; sight: mean along the line of sight [m]."""

    name: str
    points: int
    rms: float
    worst: float
    mean: Array
    sight: float

    def lengths(self) -> tuple[float, ...]:
        """RMS, worst, mean x, y, z, mean along the line of sight [m]."""
        return (self.rms, self.worst, *self.mean, self.sight)

    def to_dict(self) -> dict[str, object]:
        """For JSON, in millimetres."""
        return {
            "target": self.name,
            "points": self.points,
            "rms_mm": plain(self.rms, 1e3),
            "max_mm": plain(self.worst, 1e3),
            "mean_mm": [plain(v, 1e3) for v in self.mean],
            "mean_sight_mm": plain(self.sight, 1e3),
        }


@dataclass(frozen=True)
class JointGap:
    """Errors as one joint's: RMS of its equivalent turn [rad, m], and what q_j alone explains."""

    joint: str
    sliding: bool
    rms: float
    share: float
    p: float

    def to_dict(self) -> dict[str, object]:
        """For JSON, in milliradians, millimetres for a slide."""
        unit = "mm" if self.sliding else "mrad"
        return {
            "joint": self.joint,
            f"rms_{unit}": plain(self.rms, 1e3),
            "share": plain(self.share),
            "p": plain(self.p),
        }


@dataclass(frozen=True)
class Region:
    """Errors in one cell of the workspace.  radius, height: its edges [m]."""

    name: str
    radius: tuple[float, float]
    height: tuple[float, float]
    points: int
    rms: float

    def to_dict(self) -> dict[str, object]:
        """For JSON, in millimetres."""
        return {
            "region": self.name,
            "radius_mm": [1e3 * edge for edge in self.radius],
            "height_mm": [1e3 * edge for edge in self.height],
            "points": self.points,
            "rms_mm": plain(self.rms, 1e3),
        }


@dataclass(frozen=True)
class Part:
    """A part of the mean square: its root per point [m], its share, and p that it is nothing."""

    rms: float
    share: float
    p: float

    def to_dict(self) -> dict[str, object]:
        """For JSON, in millimetres."""
        return {"rms_mm": plain(self.rms, 1e3), "share": plain(self.share), "p": plain(self.p)}


CANNOT_TELL = Part(math.nan, math.nan, math.nan)


@dataclass(frozen=True)
class Trend:
    """Share of the error that a slow function of something explains, and p that it is chance."""

    share: float
    p: float

    def to_dict(self) -> dict[str, object] | None:
        """For JSON; null where the data hold no such column."""
        if math.isnan(self.share):
            return None
        return {"share": plain(self.share), "p": plain(self.p)}


@dataclass(frozen=True)
class Triage:
    """Mean squares per point that tell the kind of cause apart, each a `Part`; NaN if untellable.

    noise: of the instrument.  shape: of targets against each other.  repeat: between revisits.
    pose: the rest, which returns when a pose returns (without revisits: may or may not return).
    Exactly: see `triage`.
    """

    noise: Part
    shape: Part
    repeat: Part
    pose: Part

    def to_dict(self) -> dict[str, object]:
        """For JSON; null where the data cannot tell."""
        return {
            name: None if math.isnan(part.rms) else part.to_dict()
            for name, part in vars(self).items()
        }


@dataclass(frozen=True, eq=False)
class Where:
    """Where the errors of a fit lie.

    by_direction: RMS per axis [m].  structure: p that residuals are unrelated to the joint values.
    noise: of the instrument, per coordinate, given or estimated, NaN if neither [m].
    turn: (m, n) joint-equivalent residual, see `joint_equivalent` [rad, m].
    """

    by_target: tuple[TargetGap, ...]
    by_joint: tuple[JointGap, ...]
    by_direction: dict[str, float]
    by_region: tuple[Region, ...]
    order: Trend
    temperature: Trend
    triage: Triage
    structure: float
    noise: float
    turn: Array

    @property
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
        return {
            "by_target": [gap.to_dict() for gap in self.by_target],
            "by_joint": [gap.to_dict() for gap in self.by_joint],
            "by_direction": {
                f"{name}_mm": plain(rms, 1e3) for name, rms in self.by_direction.items()
            },
            "by_region": {
                "cells": [cell.to_dict() for cell in self.by_region],
                "worst": self.worst_region,
            },
            "by_order": {
                "clock": self.order.to_dict(),
                "temperature": self.temperature.to_dict(),
            },
            "triage": self.triage.to_dict(),
            "structure_p": plain(self.structure),
            "noise_mm": plain(self.noise, 1e3),
        }

    def tables(self) -> tuple[Table, ...]:
        """Triage, targets, joints, directions, regions and trends, a table each."""
        return (
            triage_table(self.triage),
            Table(
                "by target",
                ("target", "points", "RMS mm", "max mm", "x mm", "y mm", "z mm", "sight mm"),
                tuple(
                    (gap.name, gap.points, *(1e3 * float(v) for v in gap.lengths()))
                    for gap in self.by_target
                ),
                ("", "d", *(".4f",) * 6),
            ),
            Table(
                "by joint: errors as a turn of each, and what a function of it alone explains",
                ("joint", "RMS mrad|mm", "share", "p"),
                tuple((gap.joint, 1e3 * gap.rms, gap.share, gap.p) for gap in self.by_joint),
                ("", ".4f", ".3f", ".2g"),
            ),
            Table(
                "by direction",
                ("direction", "RMS mm"),
                tuple((name, 1e3 * rms) for name, rms in self.by_direction.items()),
                ("", ".4f"),
            ),
            Table(
                "by region",
                ("region", "points", "RMS mm"),
                tuple((cell.name, cell.points, 1e3 * cell.rms) for cell in self.by_region),
                ("", "d", ".4f"),
            ),
            Table(
                "trends",
                ("against", "share", "p"),
                (
                    ("visit order", self.order.share, self.order.p),
                    ("temperature", self.temperature.share, self.temperature.p),
                ),
                ("", ".3f", ".2g"),
            ),
        )


def triage_table(triage: Triage) -> Table:
    """The mean squares, one a row."""
    causes = {
        "noise": "instrument noise",
        "shape": "targets against each other",
        "repeat": "revisits against each other",
        "pose": "static model error",
    }
    rows: tuple[tuple[Cell, ...], ...] = tuple(
        (causes[name], 1e3 * part.rms, part.share, part.p) for name, part in vars(triage).items()
    )
    return Table("kind of error", ("kind", "RMS mm", "share", "p"), rows, ("", ".4f", ".3f", ".2g"))


# ---------------------------------------------------------------- the answer


def where(
    data: Measurements,
    error: Array,
    slope: Array,
    base: Array,
    noise: float,
    *,
    fitted: Array = NO_FIT,
    up: Array = UP,
    freedom: float = math.inf,
) -> Where:
    """Where the errors of a geometric fit lie.

    error: (k, m, 3) measured minus predicted in base axes, NaN where not measured [m].
    slope: (n, k, 3, m) motion of each target with each joint, base axes [m/rad, or 1 if sliding].
    base: (4, 4) pose of the base in the measurement frame, at whose origin the instrument stands.
    noise: of the instrument per coordinate [m]; NaN to estimate it, see `noise_of`.
    fitted: (k, m, 3, p) derivative of the points by all that was fitted to these rows (as
    `Model.jacobian`); what the fit has taken is then not looked for.  Empty for held-out rows.
    up: (3,) vertical in base axes.  freedom: degrees of freedom that `noise` was estimated from.
    """
    point = (data.y - base[:3, 3]) @ base[:3, :3]
    sight = data.y / np.linalg.norm(data.y, axis=-1, keepdims=True) @ base[:3, :3]
    point, sight = np.moveaxis(point, 1, 0), np.moveaxis(sight, 1, 0)
    known = noise if math.isfinite(noise) else noise_of(data)
    rest = residual_of(error, fitted, groups(data), slope, known)
    turn = joint_equivalent(error, slope, known)
    motion = joint_rows(slope, rest.seen)
    shared = base_rows(point, up, rest.seen)
    hot = data.columns.get("temperature", np.full(data.poses, np.nan))
    return Where(
        by_target=by_target(data.targets, error, sight),
        by_joint=by_joint(data, rest, motion, turn),
        by_direction=by_direction(error, point, sight, up),
        by_region=by_region(error, point, up),
        order=trend(rest, shared, clock(data)),
        temperature=trend(rest, shared, hot),
        triage=triage(data, rest, noise, known, freedom),
        structure=structure_by_pose(rest, levelled(rest.without_fit(smooth_rows(data, motion)))),
        noise=known,
        turn=turn,
    )


def by_target(names: tuple[str, ...], error: Array, sight: Array) -> tuple[TargetGap, ...]:
    """One `TargetGap` a target.  error, sight (unit vectors): (k, m, 3), NaN if not measured."""
    gaps = []
    for name, all_rows, away in zip(names, error, sight, strict=True):
        seen = np.isfinite(all_rows[:, 0])
        rows, far = all_rows[seen], np.linalg.norm(all_rows[seen], axis=1)
        if not len(rows):
            gaps.append(TargetGap(name, 0, math.nan, math.nan, np.full(3, np.nan), math.nan))
            continue
        along = float((rows * away[seen]).sum(axis=1).mean())
        gaps.append(TargetGap(name, len(rows), root(far), float(far.max()), rows.mean(0), along))
    return tuple(gaps)


def root(values: Array) -> float:
    """Root of the mean square, NaN left out; NaN if nothing is left."""
    known = values[np.isfinite(values)]
    return float(np.sqrt(np.mean(known**2))) if known.size else math.nan


def by_direction(error: Array, point: Array, sight: Array, up: Array) -> dict[str, float]:
    """RMS along each direction [m]; `across` is per axis, so that white noise is alike in all.

    radial points away from the vertical through the base's origin, tangential around it.
    error, point, sight: (k, m, 3) in base axes.
    """
    radial, around = round_axis(point, up)
    along = {
        "x": error[..., 0],
        "y": error[..., 1],
        "z": error[..., 2],
        "radial": (error * radial).sum(-1),
        "tangential": (error * around).sum(-1),
        "vertical": error @ (up / np.linalg.norm(up)),
        "along_sight": (error * sight).sum(-1),
    }
    out = {name: root(values) for name, values in along.items()}
    square = 3.0 * root(error) ** 2 - out["along_sight"] ** 2
    return out | {"across_sight": math.sqrt(max(0.0, 0.5 * square))}


def round_axis(point: Array, up: Array) -> tuple[Array, Array]:
    """Unit vectors (..., 3) away from the axis `up` through the origin, and around it."""
    axis = up / np.linalg.norm(up)
    flat = point - (point @ axis)[..., None] * axis
    radial = flat / np.maximum(np.linalg.norm(flat, axis=-1, keepdims=True), 1e-9)
    return radial, np.cross(axis, radial)


def by_region(error: Array, point: Array, up: Array) -> tuple[Region, ...]:
    """RMS in cells of equal number by radius and height, 3 x 3 (2 x 2 under 90 points)."""
    axis = up / np.linalg.norm(up)
    seen = np.isfinite(error[..., 0])
    spots, square = point[seen], (error[seen] ** 2).sum(-1)
    height = spots @ axis
    radius = np.linalg.norm(spots - height[:, None] * axis, axis=1)
    few = len(spots) < 90
    out, away = ["close in", "far out"], ["low", "high"]
    if not few:
        out, away = ["close in", "midway", "far out"], ["low", "mid-height", "high"]
    rings = np.quantile(radius, np.linspace(0.0, 1.0, len(out) + 1))
    floors = np.quantile(height, np.linspace(0.0, 1.0, len(away) + 1))
    ring = np.searchsorted(rings[1:-1], radius, side="right")
    floor = np.searchsorted(floors[1:-1], height, side="right")
    cells = []
    for i, far in enumerate(out):
        for j, high in enumerate(away):
            inside = (ring == i) & (floor == j)
            if inside.sum() < 9:  # the RMS of a few points is luck
                continue
            edges = (float(rings[i]), float(rings[i + 1])), (float(floors[j]), float(floors[j + 1]))
            rms = float(np.sqrt(square[inside].mean()))
            cells.append(Region(f"{far} and {high}", *edges, int(inside.sum()), rms))
    return tuple(cells)


def joint_equivalent(error: Array, slope: Array, noise: float) -> Array:
    """Turns of the joints that would make the errors of each pose: (m, n) [rad, m].

    Ridge least squares, min |e - S dq|^2 + lambda |dq|^2 with lambda = noise^2 / turn^2, where turn
    is the RMS turn that would make all of the error if every joint had its part.  Without ridge a
    wrist in line, or a single target, would ask for endless turns.  Arguments as `where`.
    """
    rows, seen = blocks(error)
    motion = joint_rows(slope, seen)
    gram = np.swapaxes(motion, 1, 2) @ motion
    size = np.trace(gram, axis1=1, axis2=2).mean()
    square = (rows**2).sum(1).mean()
    if not (size > 0.0 and square > 0.0):
        return np.zeros((len(rows), len(slope)))
    floor = max(noise**2 if math.isfinite(noise) else 0.0, 1e-4 * square / seen.sum(1).mean())
    ridge = floor * size / square
    pull = (np.swapaxes(motion, 1, 2) @ rows[..., None])[..., 0]
    return np.asarray(np.linalg.solve(gram + ridge * np.eye(len(slope)), pull[..., None])[..., 0])


def by_joint(
    data: Measurements, rest: Residual, motion: Array, turn: Array
) -> tuple[JointGap, ...]:
    """One `JointGap` a joint.  motion: (m, 3k, n) as `joint_rows`.  turn: (m, n)."""
    wave = np.stack([waves(column, WAVES, start=0) for column in data.q.T])  # (n, m, w)
    tall = np.einsum("mrj,jmw->mrjw", motion, wave)
    tall = rest.without_fit(tall.reshape(*motion.shape[:2], -1)).reshape(tall.shape)
    gaps = []
    for j in range(motion.shape[2]):
        size = float((motion[:, :, j] ** 2).sum())
        share, p = explained(rest, tall[:, :, j], size)
        sliding = bool(data.sliding[j])
        gaps.append(JointGap(f"J{j + 1}", sliding, root(turn[:, j]), share, p))
    return tuple(gaps)


def trend(rest: Residual, shared: Array, against: Array) -> Trend:
    """What slow changes of base frame and size with `against` (m,) explain; NaN rows left out."""
    known = np.isfinite(against)
    if known.sum() < 8 or np.ptp(against[known]) == 0.0:
        return Trend(math.nan, math.nan)
    slow = np.where(known[:, None], waves(against, SLOW, start=1), 0.0)
    share, p = explained(rest, rest.without_fit(products(shared, slow)), float((shared**2).sum()))
    return Trend(share, p)


def clock(data: Measurements) -> Array:
    """(m,) when each row was visited, in [0, 1]: by `clock`, time, order or the row's place."""
    for name in ("clock", "time", "order"):
        if name in data.columns and np.isfinite(data.columns[name]).any():
            return scaled(data.columns[name].astype(float))
    return scaled(np.arange(data.poses, dtype=float))


# ---------------------------------------------------------------- rows and features


@dataclass(frozen=True, eq=False)
class Residual:
    """What a fit leaves over, in blocks of rows.

    rows: (m, 3k) residual with what the fit could still take removed, 0 where not measured [m].
    even: the same, made larger where the fit has followed a pose: covariance as before the fit.
    basis: (m, 3k, p) orthonormal columns that span what was fitted.  seen: (m, 3k).
    group: (m,) number of the pose, shared by revisits.
    """

    rows: Array
    even: Array
    basis: Array
    seen: Array
    group: Array

    @property
    def fitted(self) -> int:
        """Number of directions that the fit has taken."""
        return int(self.basis.shape[2])

    def without_fit(self, features: Array) -> Array:
        """Features (m, 3k, r) with what the fit spans removed."""
        flat, basis = features.reshape(-1, features.shape[2]), flat_of(self.basis)
        return np.asarray((flat - basis @ (basis.T @ flat)).reshape(features.shape))


def flat_of(rows: Array) -> Array:
    """Blocks (m, 3k, p) as (3km, p)."""
    return rows.reshape(rows.shape[0] * rows.shape[1], rows.shape[2])


def blocks(error: Array) -> tuple[Array, Array]:
    """Errors (k, m, 3, ...) as blocks (m, 3k, ...), 0 where not measured, and where they were."""
    k, m, _, *more = error.shape
    rows = np.moveaxis(error, 0, 1).reshape(m, 3 * k, *more)
    seen = np.isfinite(rows)
    return np.where(seen, rows, 0.0), seen


def joint_rows(slope: Array, seen: Array) -> Array:
    """Slopes (n, k, 3, m) as blocks (m, 3k, n), 0 where not measured."""
    n, k, _, m = slope.shape
    return np.where(seen[..., None], slope.transpose(3, 1, 2, 0).reshape(m, 3 * k, n), 0.0)


def base_rows(point: Array, up: Array, seen: Array) -> Array:
    """Motions of the targets with the base, and with a growth of radius and height: (m, 3k, 8).

    Three shifts, three turns about the middle of the points, away from the axis, along it.
    point: (k, m, 3) in base axes [m].
    """
    centred = point - np.nanmean(point, axis=(0, 1))
    size = max(float(np.sqrt(np.nanmean(centred**2))), 1e-9)
    axes = np.broadcast_to(np.eye(3), (*point.shape[:2], 3, 3))
    turns = np.stack([np.cross(axis, centred / size) for axis in np.eye(3)], axis=-1)
    axis = up / np.linalg.norm(up)
    height = (centred @ axis)[..., None] * axis / size
    growth = np.stack([centred / size - height, height], axis=-1)
    rows, _ = blocks(np.concatenate([axes, turns, growth], axis=-1))
    return np.where(seen[..., None], rows, 0.0)


def residual_of(
    error: Array, fitted: Array, group: Array, slope: Array = NO_FIT, noise: float = math.nan
) -> Residual:
    """Errors (k, m, 3) of a fit with derivatives (k, m, 3, p), NaN where not measured.

    slope, noise: as `where`; they tell how a jitter of the joints would spread, for `evened`.
    """
    rows, seen = blocks(error)
    m, wide = rows.shape
    if not fitted.size:
        return Residual(rows, rows, np.zeros((m, wide, 0)), seen, group)
    columns, _ = blocks(np.nan_to_num(fitted))
    basis = orthonormal(flat_of(np.where(seen[..., None], columns, 0.0))).reshape(m, wide, -1)
    bare = Residual(rows, rows, basis, seen, group)
    rows = bare.without_fit(rows[..., None])[..., 0]
    spread = np.broadcast_to(np.eye(wide), (m, wide, wide))
    if slope.size and math.isfinite(noise):
        motion = joint_rows(slope, seen)
        energy, free = float((rows**2).sum()), float(seen.sum() - basis.shape[2])
        level = max(noise**2, 1e-4 * energy / max(free, 1.0))
        jitter = max(0.0, energy / max(level, 1e-300) - free) / max(
            float((motion**2).sum()), 1e-300
        )
        spread = spread + jitter * motion @ np.swapaxes(motion, 1, 2)
    return replace(bare, rows=rows, even=evened(rows, basis, spread, group))


def evened(rows: Array, basis: Array, spread: Array, group: Array) -> Array:
    """Residuals (m, 3k) with the covariance they had before the fit [Bell & McCaffrey 2002].

    Rows of covariance V_g = `spread` (m, 3k, 3k), up to a factor, leave residuals of covariance
    V_g - H_gg V_g - V_g H_gg + sum_h H_gh V_h H_hg with H = QQ', Q = `basis` (m, 3k, p).  All
    visits to a pose are one block g: the fit ties them together.
    """
    middle = (np.swapaxes(basis, 1, 2) @ spread @ basis).sum(axis=0)
    _, place, count = np.unique(group, return_inverse=True, return_counts=True)
    out = np.empty_like(rows)
    for visits in np.unique(count):
        alike = np.flatnonzero(count[place] == visits)
        chosen = alike[np.argsort(place[alike], kind="stable")].reshape(-1, visits)
        wide = visits * rows.shape[1]
        block = np.zeros((len(chosen), visits, rows.shape[1], visits, rows.shape[1]))
        for visit in range(visits):
            block[:, visit, :, visit] = spread[chosen[:, visit]]
        even = unfollowed(
            rows[chosen].reshape(-1, wide),
            basis[chosen].reshape(-1, wide, basis.shape[2]),
            block.reshape(-1, wide, wide),
            middle,
        )
        out[chosen] = even.reshape(rows[chosen].shape)
    return out


def unfollowed(rows: Array, basis: Array, spread: Array, middle: Array) -> Array:
    """`evened` for blocks of one size.  middle: (p, p) sum of Q_g' V_g Q_g over all blocks."""
    back = np.swapaxes(basis, 1, 2)
    followed = basis @ (back @ spread)
    left = spread - followed - np.swapaxes(followed, 1, 2) + basis @ middle @ back
    factor = np.linalg.cholesky(spread)
    white = np.linalg.solve(factor, np.swapaxes(np.linalg.solve(factor, left), 1, 2))
    value, vector = np.linalg.eigh(0.5 * (white + np.swapaxes(white, 1, 2)))
    turned = np.swapaxes(vector, 1, 2) @ np.linalg.solve(factor, rows[..., None])
    stretch = 1.0 / np.sqrt(np.maximum(value, 0.1))  # a pose the fit has all but taken tells little
    return np.asarray((factor @ vector @ (stretch[..., None] * turned))[..., 0])


def orthonormal(columns: Array, least: float = 1e-9) -> Array:
    """Orthonormal basis of the columns (N, p): (N, rank)."""
    length = np.linalg.norm(columns, axis=0)
    columns = columns[:, length > 0.0] / length[length > 0.0]
    if not columns.shape[1]:
        return columns
    basis, triangle, _ = qr(columns, mode="economic", pivoting=True, check_finite=False)
    size = np.abs(np.diag(triangle))
    return np.asarray(basis[:, : len(size)][:, size > least * size[0]])


def scaled(x: Array) -> Array:
    """Values mapped to [0, 1]; NaN stays."""
    low, high = np.nanmin(x), np.nanmax(x)
    return np.asarray((x - low) / (high - low if high > low else 1.0))


def waves(x: Array, count: int, start: int) -> Array:
    """Half-waves cos(pi l u) of x mapped to u in [0, 1], l = start ... count: (m, ...)."""
    return np.asarray(np.cos(np.pi * np.arange(start, count + 1) * scaled(x)[:, None]))


def products(motion: Array, feature: Array) -> Array:
    """Every motion (m, 3k, n) times every feature of the pose (m, r): (m, 3k, n r)."""
    m, wide, _ = motion.shape
    return (motion[..., None] * feature[:, None, None, :]).reshape(m, wide, -1)


def circles(data: Measurements) -> Array:
    """Joint values as points whose distance a kernel may use: (m, n, 2), a turn is a circle."""
    spread = np.maximum(data.q.std(axis=0), 1e-12)
    slide = np.stack([data.q / spread, np.zeros_like(data.q)], axis=-1)
    turn = np.stack([np.cos(data.q), np.sin(data.q)], axis=-1)
    return np.where(data.sliding[:, None], slide, turn)


def smooth_rows(data: Measurements, motion: Array) -> Array:
    """Features (m, 3k, r) that span smooth motions of the joints, for `structure`.

    Every joint moves by a random function of its own value and by one of all values, of equal
    energy; joints weigh alike, wrist or shoulder.  motion: (m, 3k, n) as `joint_rows`.
    """
    even = motion / np.maximum(np.sqrt((motion**2).mean(axis=(0, 1))), 1e-12)
    fade = 1.0 / np.arange(1, WAVES + 1)
    wave = np.stack([waves(column, WAVES - 1, start=0) * fade for column in data.q.T])
    own = np.einsum("mrj,jmw->mrjw", even, wave).reshape(*motion.shape[:2], -1)
    shared = products(even, factors(circles(data), RANK, width=2.0))
    parts = [part / max(float(np.sqrt((part**2).sum())), 1e-300) for part in (own, shared)]
    return np.concatenate(parts, axis=2)


def levelled(features: Array) -> Array:
    """F (..., r) with the kernel FF' replaced by its square root: weaker directions count more.

    Apply it after the fit was taken out.  A smooth kernel otherwise looks at its first few
    directions only; most of those the geometric fit has taken.
    """
    flat = features.reshape(-1, features.shape[-1])
    value, vector = np.linalg.eigh(flat.T @ flat)
    kept = value > 1e-6 * max(float(value[-1]), 1e-300)
    turned = flat @ (vector[:, kept] * value[kept] ** -0.25)
    return np.asarray(turned.reshape(*features.shape[:-1], -1))


def factors(coordinates: Array, rank: int, width: float = 1.0) -> Array:
    """F (m, <= rank) with F F' nearly a kernel K over the poses.

    K(a, b) = mean_i exp(-|a_i - b_i|^2 / 2 w^2) + exp(-mean_i |a_i - b_i|^2 / w^2), for functions
    of one coordinate each and of all together.  coordinates: (m, c, d), c of d numbers each, or
    (m, c), in units in which `width` is a small step.  Pivoted Cholesky: Nystroem at the poses that
    tell most [Harbrecht, Peters & Schneider 2012].
    """
    x = coordinates[..., None] if coordinates.ndim == 2 else coordinates
    left, columns = np.full(len(x), 2.0), np.zeros((min(rank, len(x)), len(x)))
    for i in range(len(columns)):
        pivot = int(np.argmax(left))
        if left[pivot] < 1e-6:
            return columns[:i].T
        off = ((x - x[pivot]) ** 2).sum(-1) / width**2
        column = np.exp(-0.5 * off).mean(-1) + np.exp(-off.mean(-1))
        column -= columns[:i, pivot] @ columns[:i]
        columns[i] = column / math.sqrt(left[pivot])
        left = np.maximum(left - columns[i] ** 2, 0.0)
        left[pivot] = 0.0
    return columns.T


# ---------------------------------------------------------------- tests


def explained(rest: Residual, features: Array, size: float) -> tuple[float, float]:
    """Share of the residual's energy that features (m, 3k, r) explain, and p that it is chance.

    Share: that of the least-squares fit less what unrelated poses would give it, so that it is 0 on
    average where there is nothing.  p: as `structure_by_pose`.  The features must be without what
    was fitted; size: energy of one before, to tell which are nothing now.
    """
    flat = flat_of(features)
    value, vector = np.linalg.eigh(flat.T @ flat)
    kept = value > FLAT * size
    total = float((rest.rows**2).sum())
    if not (kept.any() and total > 0.0):
        return 0.0, 1.0
    unit = features @ (vector[:, kept] / np.sqrt(value[kept]))
    pull, score = scores(rest, unit)
    after = rest.rows - unit @ pull
    lever = np.minimum(summed((unit**2).sum((1, 2)), rest.group), 0.9)
    left = summed(np.einsum("mrs,mr->ms", unit, after), rest.group)
    chance = float(((left**2).sum(1) / (1.0 - lever)).sum())
    share = (float(pull @ pull) - chance) / total
    return min(1.0, max(0.0, share)), score_flips(float(pull @ pull), score)


def structure_by_pose(rest: Residual, features: Array) -> float:
    """p that poses (groups of revisits) have residuals unrelated to the features (m, 3k, r).

    U = |F'r|^2 sums s_g's_h over all pairs of poses, s_g = F_g'r_g.  Signs of whole poses are
    flipped in thought (see `flips`), so that nothing is assumed about noise or jitter but that
    poses are independent.
    """
    bare = rest.without_fit(features)
    pull, score = scores(rest, bare)
    return score_flips(float(pull @ pull), score)


def scores(rest: Residual, features: Array) -> tuple[Array, Array]:
    """F'r (r,) and each pose's part of it (poses, r), at the covariance before the fit."""
    pull = flat_of(features).T @ rest.rows.reshape(-1)
    part = (rest.even[:, None, :] @ features)[:, 0]
    return pull, summed(part, rest.group)


def summed(rows: Array, group: Array) -> Array:
    """Sums of rows (m, ...) over each group."""
    _, place = np.unique(group, return_inverse=True)
    out = np.zeros((place.max() + 1, *rows.shape[1:]))
    np.add.at(out, place, rows)
    return out


def flips(total: float, gram: Array) -> float:
    """p of T = total - trace(gram) when the signs of poses are arbitrary.

    Under flips e'Ae with A = gram without its diagonal has mean 0, variance 2 tr A^2 and third
    cumulant 8 tr A^3: matched by a shifted chi^2 (Pearson III).
    gram: (g, g) inner products of the poses' scores.
    """
    off = gram - np.diag(np.diag(gram))
    squared = off @ off
    moments = float(np.trace(squared)), float((squared * off).sum())
    return pearson(total - float(np.trace(gram)), *moments)


def score_flips(total: float, score: Array) -> float:
    """`flips` with gram = score score', for fewer features than poses.  score: (g, r)."""
    if len(score) <= score.shape[1]:
        return flips(total, score @ score.T)
    own = (score**2).sum(axis=1)
    gram = score.T @ score
    squared = gram @ gram
    second = float(np.trace(squared) - (own**2).sum())
    crossed = float(own @ ((score @ gram) * score).sum(axis=1))
    third = float((squared * gram).sum()) - 3.0 * crossed + 2.0 * float((own**3).sum())
    return pearson(total - float(own.sum()), second, third)


def pearson(excess: float, second: float, third: float) -> float:
    """P(T > excess) for T of mean 0, variance 2 `second` and third cumulant 8 `third`."""
    if second <= 0.0:
        return 1.0
    skew = third / second**1.5
    if skew < 1e-3:
        return float(norm.sf(excess / math.sqrt(2.0 * second)))
    freedom = skew**-2.0
    return float(chi2.sf(freedom + excess / math.sqrt(second) * math.sqrt(freedom), freedom))


def structure_p(values: Array, coordinates: Array, basis: Array = NO_FIT) -> float:
    """p that vectors (m, d) of the poses are unrelated to coordinates (m, c): a kernel test.

    coordinates: scaled by their spread here.  basis: (m, p) orthonormal columns that were fitted to
    each column of the values; without one, their mean.
    """
    m = len(values)
    basis = basis if basis.size else np.full((m, 1), 1.0 / math.sqrt(m))
    spread = np.maximum(coordinates.std(axis=0), 1e-12)
    feature = factors(coordinates / spread, min(m, 4 * RANK))
    feature = feature - basis @ (basis.T @ feature)
    rest = values - basis @ (basis.T @ values)
    even = rest / np.sqrt(np.maximum(1.0 - (basis**2).sum(1), 0.1))[:, None]
    total = float(((feature.T @ rest) ** 2).sum())
    return flips(total, (even @ even.T) * (feature @ feature.T))


def structure(residual: Array, kernel: Array, basis: Array) -> float:
    """p that whitened residuals hold no structure of a kernel; exact for white Gaussian noise.

    With P = I - QQ', r = P residual and U = r'FF'r: the chance that U / r'r would be as large as it
    is, whatever the noise level.  residual: (N,).  kernel: (N, r) factor F of K = FF'.
    basis: (N, p) orthonormal columns Q that span what was fitted, p may be 0.
    """
    rest = residual - basis @ (basis.T @ residual)
    bare = kernel - basis @ (basis.T @ kernel)
    energy = float(rest @ rest)
    if not energy > 0.0:
        return 1.0
    ratio = float(((bare.T @ rest) ** 2).sum()) / energy
    value = np.linalg.eigvalsh(bare.T @ bare)
    value = value[value > 1e-10 * max(float(value[-1]), 1e-300)]
    others = len(residual) - basis.shape[1] - len(value)
    weight = np.append(value - ratio, -ratio)
    return positive(weight, np.append(np.ones(len(value)), max(others, 0)))


def positive(weight: Array, freedom: Array) -> float:
    """P(sum_i w_i X_i > 0), X_i independent chi^2 with f_i degrees of freedom; any signs.

    Inverts the moment generating function along the line through the saddle point, so that small
    probabilities are right to their own size [Rice 1980].
    """
    weight, freedom = weight[freedom > 0], freedom[freedom > 0]
    if not len(weight) or weight.max() <= 0.0:
        return 0.0
    if weight.min() >= 0.0:
        return 1.0
    weight = weight / np.abs(weight).max()
    low, high = 0.5 / weight.min(), 0.5 / weight.max()

    def tilt(s: float) -> float:
        return float((freedom * weight / (1.0 - 2.0 * s * weight)).sum())

    left, right = low * (1.0 - 1e-13), high * (1.0 - 1e-13)
    if tilt(left) >= 0.0 or tilt(right) <= 0.0:  # one sign has next to no weight
        return 1.0 if tilt(left) >= 0.0 else 0.0
    saddle = float(brentq(tilt, left, right, xtol=1e-300, rtol=1e-14))
    spread = 1.0 / math.sqrt(float((2 * freedom * (weight / (1 - 2 * saddle * weight)) ** 2).sum()))
    nearest = min(0.5 * spread, 0.5 * high, -0.5 * low)  # keeps the line off the pole at 0
    upper = saddle > -nearest
    at = max(saddle, nearest) if upper else saddle
    x = np.linspace(0.0, 12.0, 601)
    s = at + 1j * spread * np.sinh(x)
    grown = -0.5 * np.log(1.0 - 2.0 * s[:, None] * weight) @ freedom
    under = np.exp(grown) / s * spread * np.cosh(x)
    under[0] *= 0.5  # trapezoidal rule; at the far end there is nothing left
    area = float(under.real.sum() * x[1]) / math.pi
    return min(1.0, max(0.0, area if upper else 1.0 + area))


# ---------------------------------------------------------------- mean squares


def noise_of(data: Measurements) -> float:
    """Noise per coordinate from the data alone [m]: distances between targets, else revisits.

    Distances: median over pairs of the robust scatter / sqrt(2).  NaN if there are neither.
    """
    off, weight = scatter(distances(data), np.zeros(data.poses, dtype=int))
    if weight.sum() >= 8.0:
        spread = [np.median(np.abs(c[w > 0])) for c, w in zip(off.T, weight.T, strict=True)]
        return float(np.median(spread)) * 1.4826 / math.sqrt(2.0)
    off, weight = scatter(data.y.reshape(data.poses, -1), groups(data))
    freedom = float(weight.sum())
    return math.sqrt(float((off**2).sum()) / freedom) if freedom >= 8.0 else math.nan


def pairs(k: int) -> Array:
    """All pairs of k targets: (k (k - 1) / 2, 2)."""
    return np.array(list(combinations(range(k), 2)), dtype=int).reshape(-1, 2)


def distances(data: Measurements) -> Array:
    """Between all pairs of targets: (m, pairs), NaN where not both were measured [m]."""
    pair = pairs(len(data.targets))
    return np.asarray(np.linalg.norm(data.y[:, pair[:, 0]] - data.y[:, pair[:, 1]], axis=-1))


def scatter(values: Array, group: Array) -> tuple[Array, Array]:
    """Deviations (m, c) from the mean of the group, 0 for NaN, and degrees of freedom of each."""
    known = np.isfinite(values)
    _, place = np.unique(group, return_inverse=True)
    count = np.maximum(summed(known.astype(float), group), 1.0)[place]
    # means of what is left after one row of each group are exact to rounding, far from the origin
    first = np.unique(place, return_index=True)[1][place]
    moved = np.where(known & known[first], values - values[first], 0.0)
    moved = np.where(known & ~known[first], values, moved)
    alone = np.where(known, moved - (summed(moved, group)[place] / count), 0.0)
    return alone, np.where(known, 1.0 - 1.0 / count, 0.0)


def shape_energy(data: Measurements, off: Array) -> tuple[Array, Array]:
    """Least sum of squared target motions that changes distances by `off` (m, pairs).

    Changes are D e to first order, e (3k,) the targets' motions: |e|^2 = off' (DD')^+ off, which no
    rigid motion enters.  DD' follows from the mean distances by the law of cosines.
    Returns energy (m,) [m^2] and rank (m,), 3k - 6 for k > 2 targets in general places.
    """
    pair, seen = pairs(len(data.targets)), data.seen
    apart = distances(data)
    known = np.isfinite(apart)
    mean = np.where(known, apart, 0.0).sum(0) / np.maximum(known.sum(0), 1)
    square = np.zeros((len(data.targets),) * 2)
    square[pair[:, 0], pair[:, 1]] = square[pair[:, 1], pair[:, 0]] = mean**2
    (a, b), (c, d) = pair.T[:, :, None], pair.T[:, None, :]
    dot = 0.5 * (square[a, d] + square[b, c] - square[a, c] - square[b, d])
    common = (a == c).astype(float) + (b == d) - (a == d) - (b == c)
    gram = common * dot / np.maximum(np.outer(mean, mean), 1e-12)
    energy, rank = np.zeros(data.poses), np.zeros(data.poses)
    for pattern in np.unique(seen, axis=0):
        rows = (seen == pattern).all(axis=1)
        both = pattern[pair].all(axis=1)
        if both.any():
            value, vector = np.linalg.eigh(gram[np.ix_(both, both)])
            kept = value > 1e-3 * value[-1]
            part = off[np.ix_(rows, both)] @ (vector[:, kept] / np.sqrt(value[kept]))
            energy[rows], rank[rows] = (part**2).sum(1), kept.sum()
    return energy, rank


def shape_scatter(data: Measurements) -> tuple[float, float]:
    """Energy [m^2] of the targets' motion against each other, and its degrees of freedom.

    From the scatter of inter-target distances over all poses: free of model and fit.  White noise
    of s per coordinate gives s^2 times the degrees of freedom; more is instrument, nests, bracket.
    """
    off, _ = scatter(distances(data), np.zeros(data.poses, dtype=int))
    energy, rank = shape_energy(data, off)
    return float(energy.sum()), float(rank.sum() - rank.max(initial=0.0))


def revisit_scatter(data: Measurements) -> tuple[float, float, float]:
    """Energy [m^2] of rigid motion between visits to a pose, degrees of freedom, free points.

    The targets' motion against each other is taken off: it is told by `shape_scatter`.
    """
    group = groups(data)
    off, weight = scatter(data.y.reshape(data.poses, -1), group)
    apart, free = scatter(distances(data), group)
    energy, rank = shape_energy(data, apart)
    most = free.max(axis=1, initial=0.0)
    points = float(weight.sum()) / 3.0
    shape = float((rank * most).sum())
    return float((off**2).sum() - energy.sum()), 3.0 * points - shape, points


def lack_of_fit(rest: Residual) -> float:
    """p that residuals do not return when a pose returns; by flips of the visits' signs."""
    once, count = np.unique(rest.group, return_counts=True)
    again = np.isin(rest.group, once[count > 1])
    rows, group = rest.even[again], rest.group[again]
    gram = np.where(group[:, None] == group, rows @ rows.T, 0.0)
    return flips(float(gram.sum()), gram)


def triage(
    data: Measurements, rest: Residual, noise: float, known: float, freedom: float
) -> Triage:
    """Mean squares per point of the errors `rest`: noise + shape + repeat + pose.

    With s^2 = noise^2, per coordinate, p fitted directions and N points:
    noise: s^2 (3 - p / N).
    shape: u^2 (3 - p / N), u^2 = `shape_scatter` per degree of freedom less s^2: targets that
    scatter on their own seem to move rigidly, too, as noise does.
    repeat: `revisit_scatter` per visit less that of s^2 + u^2, less what the fit has taken.
    pose: what is left.  Negative parts are 0; shares add up to 1 over the parts that can be told,
    and what cannot (no revisits, one target) falls to pose.
    p of shape: chi^2 against s^2, F if that has finite `freedom`.  p of repeat: the same, but F
    against the scatter of the shape where that is clearly larger.  p of pose: `lack_of_fit`.
    noise: as given, NaN if it was estimated from the data as `known`: then the scatter that gave it
    is noise by definition, and cannot be told.
    """
    points = float(rest.seen.sum()) / 3.0
    total = float((rest.rows**2).sum()) / points
    if not (math.isfinite(known) and total > 0.0):
        return Triage(CANNOT_TELL, CANNOT_TELL, CANNOT_TELL, CANNOT_TELL)
    given, left = math.isfinite(noise), 3.0 - rest.fitted / points
    least, behind = max(known**2, 1e-24), freedom
    told = {"noise": (known**2 * left, math.nan)}
    shape, shape_free = shape_scatter(data)
    if given and shape_free >= 1.0:
        p = above(shape, shape_free, least, behind)
        told["shape"] = (max(0.0, shape / shape_free - known**2) * left, p)
        if p < 0.01:
            least, behind = shape / shape_free, shape_free
    repeat, repeat_free, visits = revisit_scatter(data)
    if repeat_free >= 1.0 and (given or shape_free >= 1.0):
        own = sum(square for square, _ in told.values()) / left * repeat_free
        kept = max(0.0, 1.0 - rest.fitted / (3.0 * points - shape_free))
        p = above(repeat, repeat_free, least, behind)
        told["repeat"] = (max(0.0, repeat - own) / visits * kept, p)
    static = max(0.0, total - sum(square for square, _ in told.values()))
    told["pose"] = (static, lack_of_fit(rest) if repeat_free >= 1.0 else math.nan)
    whole = max(sum(square for square, _ in told.values()), 1e-300)
    parts = {name: Part(math.sqrt(ms), ms / whole, p) for name, (ms, p) in told.items()}
    return Triage(*(parts.get(name, CANNOT_TELL) for name in ("noise", "shape", "repeat", "pose")))


def above(energy: float, free: float, variance: float, behind: float) -> float:
    """p that energy / free is that large if its expectation is variance, known from `behind`."""
    ratio = energy / variance
    return float(f.sf(ratio / free, free, behind) if behind < 1e9 else chi2.sf(ratio, free))


# ---------------------------------------------------------------- maps


@dataclass(frozen=True, eq=False)
class Maps:
    """Smooth curves of each joint's equivalent residual against one thing at a time.

    against: c names, q1 ... qn, clock, temperature.  grid: (c, 25) [rad, m, -, C].
    value, sigma: (c, n, 25) curve and its standard error, NaN where no poses are near [rad, m].
    """

    against: tuple[str, ...]
    grid: Array
    value: Array
    sigma: Array

    def to_dict(self) -> dict[str, object]:
        """For JSON, in milliradians or millimetres; null where no poses are near."""

        def curve(values: Array, scale: float) -> list[float | None]:
            return [plain(v, scale) for v in values]

        return {
            name: {
                "at": curve(self.grid[i], 1.0),
                "joint_milli": [curve(row, 1e3) for row in self.value[i]],
                "sigma_milli": [curve(row, 1e3) for row in self.sigma[i]],
            }
            for i, name in enumerate(self.against)
        }


def maps(data: Measurements, turn: Array) -> Maps:
    """Kernel means (Nadaraya-Watson) of turn (m, n) against joints, clock and temperature."""
    columns = {f"q{i + 1}": column for i, column in enumerate(data.q.T)}
    columns["clock"] = clock(data)
    hot = data.columns.get("temperature", np.zeros(0))
    if np.isfinite(hot).sum() > 8:
        columns["temperature"] = hot
    x = np.stack(list(columns.values()))
    share = np.stack([scaled(column) for column in x])
    steps = np.linspace(0.0, 1.0, GRID)
    width = 0.25 * data.poses**-0.2  # of the range
    weight = np.exp(-0.5 * ((steps[:, None] - share[:, None, :]) / width) ** 2)
    weight = np.where(np.isfinite(share)[:, None, :], weight, 0.0)
    many = weight.sum(-1, keepdims=True)
    near = many**2 / np.maximum((weight**2).sum(-1, keepdims=True), 1e-300) >= 3.0
    mean = weight @ turn / np.maximum(many, 1e-300)
    twice = weight**2
    square = twice @ turn**2 - 2.0 * mean * (twice @ turn) + mean**2 * twice.sum(-1, keepdims=True)
    error = np.sqrt(np.maximum(square, 0.0)) / np.maximum(many, 1e-300)
    low, high = np.nanmin(x, axis=1)[:, None], np.nanmax(x, axis=1)[:, None]
    value, sigma = (np.where(near, a, np.nan).swapaxes(1, 2) for a in (mean, error))
    return Maps(tuple(columns), low + (high - low) * steps, value, sigma)
