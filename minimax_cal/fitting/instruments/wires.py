"""Lengths from fixed anchors to a target on the flange."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from minimax_cal.fitting.fit import Parameter
from minimax_cal.fitting.identify import plenty_of_poses
from minimax_cal.fitting.instruments.data import RelativeData
from minimax_cal.fitting.instruments.refine import refined, spots_aside
from minimax_cal.fitting.instruments.rows import (
    SPOT,
    OnFlange,
    arm_at,
    motion,
    places,
    scaled_lstsq,
)
from minimax_cal.ground.arrays import Array
from minimax_cal.modelling.model import Model
from minimax_cal.modelling.parameters import State
from minimax_cal.robots import kinematics
from minimax_cal.robots.kinematics import Chain
from minimax_cal.robots.robot import Robot

PLENTY = 200  # poses that show what no poses could tell
ENOUGH = 60  # poses that tell one start from another


@dataclass(frozen=True, eq=False)
class Wires(OnFlange):
    """Wires as a block, see `rows.Block`.

    length: (m, s), NaN where not measured [m].  Its own: the target, s anchors, s offsets.
    """

    model: Model
    wires: tuple[str, ...]
    length: Array
    with_offsets: bool = False

    kind = "distances"
    row_noise = 1.0
    whole = "all anchors moved together"
    has_length = True

    @staticmethod
    def of(robot: Robot, q: Array, wires: tuple[str, ...], length: Array) -> Wires:
        """Wires of a robot; the parameters of wire3 are anchor3_x ... and offset3."""
        return Wires(arm_at(robot, q), wires, length)

    @property
    def own(self) -> tuple[str, ...]:
        """Target, anchors, offsets."""
        numbers = [wire.removeprefix("wire") for wire in self.wires]
        anchors = (f"anchor{number}_{axis}" for number in numbers for axis in "xyz")
        return (*SPOT, *anchors, *(f"offset{number}" for number in numbers))

    @property
    def given_up(self) -> tuple[str, ...]:
        """The offsets."""
        return tuple(name for name in self.own if name.startswith("offset"))

    @property
    def held(self) -> tuple[str, ...]:
        """The offsets, unless they are to be fitted: 0."""
        return () if self.with_offsets else self.given_up

    @property
    def parts(self) -> tuple[str, ...]:
        """The wires."""
        return self.wires

    @property
    def points(self) -> int:
        """Number of measured lengths."""
        return int(np.isfinite(self.length).sum())

    @property
    def numbers(self) -> int:
        """As many."""
        return self.points

    @property
    def weights(self) -> Array:
        """(rows,) one each."""
        return np.ones(self.points)

    @property
    def pose_of_row(self) -> Array:
        """Wire by wire."""
        return np.nonzero(np.isfinite(self.length.T))[1]

    def split(self, x: State) -> tuple[Array, Array]:
        """Anchors (..., s, 3) and offsets (..., s) [m]."""
        s, own = self.length.shape[1], x.effects[..., 3:]
        return own[..., : 3 * s].reshape(*own.shape[:-1], s, 3), own[..., 3 * s : 4 * s]

    def misses(self, x: State) -> Array:
        """Measured minus predicted lengths: (..., s, m), NaN where not measured [m]."""
        anchors, offsets = self.split(x)
        gap = places(self.model, x)[..., None, :, :] - anchors[..., None]
        return np.asarray(self.length.T - np.linalg.norm(gap, axis=-2) - offsets[..., None])

    def rows(self, x: State, active: Array) -> tuple[Array, Array]:
        """A row for each measured length: it grows as the target moves along the wire."""
        first = self.model.names.geometric
        point, arms = motion(self.model, x, active)
        anchors, offsets = self.split(x)
        gap = point[..., None, :, :] - anchors[..., None]
        distance = np.maximum(np.linalg.norm(gap, axis=-2), 1e-12)
        unit = gap / distance[..., None, :]
        *batch, s, m = distance.shape
        own = np.zeros((*batch, len(active), s, m))
        for i in range(s):
            own[..., first + 3 * i : first + 3 * i + 3, i, :] = -unit[..., i, :, :]
            own[..., first + 3 * s + i, i, :] = 1.0
        along = np.einsum("...scm,...pcm->...psm", unit, arms)
        jacobian = along + own[..., active, :, :]
        seen = np.isfinite(self.length.T)
        error = self.length.T - distance - offsets[..., None]
        return error[..., seen], jacobian[..., seen]

    def start(self, robot: Robot, free: Array) -> Array:
        """Anchors and target (and offsets, where free) that fit the arm as drawn best.

        With the last frame (R, o) known at every pose, |o + R t - A| = L - z squared is
        2 o.Rt - 2 o.A - 2 Rt.A + 2 L z + c = L^2 - |o|^2: linear in t, A, the nine products t A', z
        and c.  That start, and trilaterations from some places t, are refined; the best is kept.
        """
        with_offset = bool(free[3 + 3 * len(self.wires) :].any())
        links = kinematics.chain(robot.mdh, self.model.q, self.model.prismatic)
        first = linear_target(links, self.length, with_offset=with_offset)
        starts = [
            np.concatenate([spot, trilaterated(links, self.length, spot, with_offset)])
            for spot in spots_aside(robot, first)
        ]
        return refined(robot, self, self.thinned(), free, starts)

    def thinned(self) -> Wires:
        """At some of the poses, the same number for each wire as far as there are."""
        chosen = np.zeros(len(self.model.q), dtype=bool)
        for lengths in self.length.T:
            seen = np.flatnonzero(np.isfinite(lengths))
            chosen[seen[np.linspace(0, len(seen) - 1, min(len(seen), ENOUGH)).astype(int)]] = True
        return replace(self, model=self.model.take(chosen), length=self.length[chosen])

    def reference(self, robot: Robot, x: State) -> Wires:
        """At plenty of random poses."""
        count = max(PLENTY, self.model.names.geometric + 4 * len(self.wires))
        model = plenty_of_poses(robot, self.model, count)
        return replace(self, model=model, length=np.zeros((count, len(self.wires))))

    def closed(self, robot: Robot, x: State) -> Wires:
        """The same: lengths fit any arm by its anchors."""
        return self

    def mean_square(self, x: State) -> float:
        """Of the misses of lengths [m^2]."""
        return float(np.nanmean(self.misses(x) ** 2))

    def errors(self, model: Model, x: State, data: RelativeData, held: Array) -> Array:
        """The error of a length stands first of three."""
        error = replace(self, model=model, length=data.length).misses(x)
        return np.stack([error, *(np.where(np.isnan(error), np.nan, 0.0),) * 2], axis=-1)

    def listed(
        self, fitted: tuple[Parameter, ...], nominal: State, x: State, covariance: Array
    ) -> tuple[Parameter, ...]:
        """Without the offsets, unless they were to be fitted."""
        return fitted if self.with_offsets else fitted[: -len(self.wires)]

    def placed(self, x: State, nominal: State) -> dict[str, Any]:
        """Target in the last frame, anchors in the robot's base."""
        anchors, offsets = self.split(x)
        out: dict[str, Any] = {"target_mm": (1e3 * x.effects[:3]).tolist()}
        out["anchors_mm"] = dict(zip(self.wires, (1e3 * anchors).tolist(), strict=True))
        if self.with_offsets:
            out["offsets_mm"] = dict(zip(self.wires, (1e3 * offsets).tolist(), strict=True))
        return out


def linear_target(links: Chain, length: Array, *, with_offset: bool) -> Array:
    """The target (3,) of the linear start [m].  length: (m, s), NaN where not measured."""
    s = length.shape[1]
    parts, rights = [], []
    for i in range(s):
        seen = np.isfinite(length[:, i])
        o, axes, long = links.origin[:, seen], links.axes[..., seen], length[seen, i]
        own = np.zeros((len(long), s, 14))
        own[:, i, :3] = -2.0 * o.T
        own[:, i, 3:12] = -2.0 * axes.reshape(9, -1).T
        own[:, i, 12] = 1.0
        own[:, i, 13] = 2.0 * long if with_offset else 0.0
        turned = 2.0 * np.einsum("kjm,jm->mk", axes, o)
        parts.append(np.concatenate([turned, own.reshape(len(long), -1)], axis=1))
        rights.append(long**2 - (o**2).sum(axis=0))
    return scaled_lstsq(np.concatenate(parts), np.concatenate(rights))[:3]


def trilaterated(links: Chain, length: Array, target: Array, with_offset: bool) -> Array:
    """Anchors and offsets (4s,) for a given target: 2 p.A - 2 L z - c = |p|^2 - L^2 [m]."""
    point = kinematics.points(links, target[None])[0]
    anchors, offsets = [], []
    for long in length.T:
        seen = np.isfinite(long)
        p, long = point[:, seen], long[seen]
        matrix = np.stack([*(2.0 * p), -np.ones(len(long)), -2.0 * long * with_offset], axis=1)
        found = scaled_lstsq(matrix, (p**2).sum(axis=0) - long**2)
        anchors.append(found[:3])
        offsets.append(found[4])
    return np.concatenate([*anchors, offsets])
