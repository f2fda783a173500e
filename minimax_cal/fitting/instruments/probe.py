"""Contacts of a ball on the flange with planes, spheres and the faces of one known body.

A contact says that the ball's centre p lies at the ball's radius r from the surface: n.p = c + r of
a plane, |p - C| = R + r of a sphere, n.(p - t) = d + r of a face with the normal n and the offset d
in the body's frame, which stands at t.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from minimax_cal.fitting.instruments.closing import CLOSED, reach
from minimax_cal.fitting.instruments.options import FAR, RelativeOptions
from minimax_cal.fitting.instruments.plausible import check_slips, started
from minimax_cal.fitting.instruments.record import Columns, Instrument, Words
from minimax_cal.fitting.instruments.refine import refined
from minimax_cal.fitting.instruments.rows import (
    OnFlange,
    motion,
    places,
)
from minimax_cal.fitting.instruments.shapes import Shapes, placed_best
from minimax_cal.fitting.instruments.touches import (
    CONTACT,
    SPHERE,
    Touches,
    read,
)
from minimax_cal.ground.arrays import Array
from minimax_cal.ground.errors import DataError
from minimax_cal.modelling.model import Model, arm_at
from minimax_cal.modelling.parameters import State
from minimax_cal.robots.kinematics import hat, right_jacobian
from minimax_cal.robots.robot import Robot
from minimax_cal.robots.sampling import random_joints

PLENTY = 300  # contacts that show what no contacts could tell
BETTER_RADIUS = 4.0  # times the mean square of a sphere whose radius is free


@dataclass(frozen=True, eq=False)
class Contacts(OnFlange):
    """Contacts as a block, see `rows.Block`.

    model: the arm at the m poses.  shapes: the surfaces.  touched: (m,) which.  drawn: (e,) own
    parameters that fit the arm as drawn, before they are refined.
    """

    model: Model
    shapes: Shapes
    touched: Array
    drawn: Array

    kind = "contacts"
    given_up = ("ball_radius",)
    has_length = False  # the rank says whether some radius is one
    whole = "all surfaces moved together"

    @staticmethod
    def of(robot: Robot, data: Touches, options: RelativeOptions) -> Contacts:
        """Contacts of a robot, with a start that needs no guess."""
        labels = [surface.label for surface in data.surfaces]
        touched = np.array([labels.index(str(label)) for label in data.surface])
        model = arm_at(robot, data.at.q)
        shapes, drawn = placed_best(robot, model, data.surfaces, data.ball_radius, touched)
        return Contacts(model, shapes, touched, drawn)

    @property
    def own(self) -> tuple[str, ...]:
        """Ball, surfaces, body, radius of the ball."""
        return self.shapes.own()

    @property
    def held(self) -> tuple[str, ...]:
        """The radii and offsets that are given."""
        return self.shapes.given()

    @property
    def parts(self) -> tuple[str, ...]:
        """The surfaces."""
        return tuple(surface.label for surface in self.shapes.surfaces)

    @property
    def points(self) -> int:
        """Number of contacts."""
        return len(self.touched)

    def size(self, x: State) -> float:
        """The target's spread: an arm that hardly moves touches anything."""
        return self.spread(x)

    @property
    def pose_of_row(self) -> Array:
        """One a pose."""
        return np.arange(self.points)

    def gaps(self, x: State) -> Array:
        """(..., m) how far the ball is from its surface [m]."""
        count = self.model.names.count - 3 + len(self.own)
        return -self.rows(x, np.zeros(count, dtype=bool))[0]

    def rows(self, x: State, active: Array) -> tuple[Array, Array]:
        """A row for each contact: the ball's distance from the surface, which is zero."""
        own = x.effects[..., : len(self.own)]
        point, arms = motion(self.model, x, active)
        *batch, _, m = point.shape
        gap, along = np.zeros((*batch, m)), np.zeros((*batch, 3, m))
        slope = np.zeros((*batch, own.shape[-1], m))
        slope[..., -1, :] = -1.0
        for at, slot in enumerate(self.shapes.slots()):
            here = self.touched == at
            along[..., here], gap[..., here], slope[..., slot, here] = self.met(
                point[..., here], at, own
            )
            if self.shapes.surfaces[at].is_face:
                slope[..., -7:-1, here] = self.by_body(point[..., here], at, own)
        by_arm = np.einsum("...cm,...pcm->...pm", along, arms)
        first = self.model.names.geometric - 3
        every = np.zeros((*batch, len(active), m))
        every[..., first + 3 : first + own.shape[-1], :] = slope[..., 3:, :]
        return -gap, by_arm + every[..., active, :]

    def met(self, p: Array, at: int, own: Array) -> tuple[Array, Array, Array]:
        """Normal (..., 3, m) where p lies, its gap (..., m), slopes by the surface's own (.., m).

        p: (..., 3, m) of the ball's centre [m].  at: which surface.
        """
        surface, values = self.shapes.surfaces[at], own[..., self.shapes.slots()[at]]
        if surface.kind == SPHERE:
            off = p - values[..., :3, None]
            size = np.maximum(np.linalg.norm(off, axis=-2), 1e-12)
            normal, distance = off / size[..., None, :], size
            slopes = [-normal]
        elif surface.is_face:
            turn, origin = self.shapes.body(own)
            normal = np.broadcast_to((turn @ surface.normal)[..., None], p.shape)
            distance, slopes = (normal * (p - origin[..., None])).sum(axis=-2), []
        else:
            n, *tilts = (each[..., None] for each in self.shapes.plane(at, own))
            normal = np.broadcast_to(n, p.shape)
            distance = (n * p).sum(axis=-2)
            slopes = [(tilt * p).sum(axis=-2)[..., None, :] for tilt in tilts]
        slopes.append(-np.ones_like(p[..., :1, :]))
        gap = distance - values[..., -1, None] - own[..., -1, None]
        return normal, gap, np.concatenate(slopes, axis=-2)

    def by_body(self, p: Array, at: int, own: Array) -> Array:
        """(..., 6, m) slopes of a face's distance by the body's place and turn."""
        turn, origin = self.shapes.body(own)
        surface = self.shapes.surfaces[at]
        n = turn @ surface.normal
        swing = -turn @ hat(surface.normal) @ right_jacobian(own[..., -4:-1])
        turned = np.einsum("...ij,...im->...jm", swing, p - origin[..., None])
        moved = np.broadcast_to(-n[..., None], turned.shape)
        return np.concatenate([moved, turned], axis=-2)

    def start(self, robot: Robot, free: Array) -> Array:
        """The closed start, refined."""
        return refined(robot, self, self, free, [self.drawn])

    def nearest(self, robot: Robot, x: State, p: Array, touched: Array) -> Array:
        """(m, 3) ball's places on the surfaces nearest to p (3, m) [m]."""
        goal = p.T.copy()
        for at in range(len(self.shapes.surfaces)):
            rows = touched == at
            normal, gap, _ = self.met(p[:, rows], at, x.effects[: len(self.own)])
            goal[rows] -= (gap * normal).T
        return goal

    def reference(self, robot: Robot, x: State) -> Contacts:
        """At plenty of random poses that touch."""
        rng, count = np.random.default_rng(0), PLENTY * len(self.shapes.surfaces)
        q = random_joints(robot, (count,), rng)
        touched = np.arange(count) % len(self.shapes.surfaces)
        goal = self.nearest(robot, x, places(arm_at(robot, q), x), touched)
        found, gap = reach(robot, x.effects[:3], goal, q)
        kept = gap < CLOSED
        if len(np.unique(touched[kept])) < len(self.shapes.surfaces):  # hardly within reach
            return self.closed(robot, x)
        return replace(self, model=arm_at(robot, found[kept]), touched=touched[kept])

    def closed(self, robot: Robot, x: State) -> Contacts:
        """At nearby poses where the arm itself touches."""
        goal = self.nearest(robot, x, places(self.model, x), self.touched)
        q, _ = reach(robot, x.effects[:3], goal, robot.commanded(self.model.q))
        return replace(self, model=replace(self.model, q=robot.turned(q)))

    def mean_square(self, x: State) -> float:
        """Of the gaps [m^2]."""
        return float(np.mean(self.gaps(x) ** 2))

    def errors(self, model: Model, x: State, data: Touches, held: Array) -> Array:
        """The gap at a contact stands first of three, a part a surface."""
        labels = self.parts
        touched = np.array([labels.index(str(label)) for label in data.surface])
        gap = replace(self, model=model, touched=touched).gaps(x)
        error = np.full((len(labels), data.poses, 3), np.nan)
        error[touched, np.arange(data.poses)] = 0.0
        error[touched, np.arange(data.poses), 0] = -gap
        return error

    def placed(self, x: State, nominal: State) -> dict[str, Any]:
        """Ball in the last frame, surfaces in the robot's base."""
        own, out = x.effects[: len(self.own)], {}
        turn, origin = self.shapes.body(own) if self.shapes.has_body else (np.eye(3), np.zeros(3))
        for at, (surface, slot) in enumerate(
            zip(self.shapes.surfaces, self.shapes.slots(), strict=True)
        ):
            size = 1e3 * own[slot][-1]
            if surface.kind == SPHERE:
                found = {"centre_mm": (1e3 * own[slot][:3]).tolist(), "radius_mm": size}
            else:
                n = turn @ surface.normal if surface.is_face else self.shapes.plane(at, own)[0]
                offset = size + 1e3 * float(n @ origin) if surface.is_face else size
                found = {"normal": n.tolist(), "offset_mm": offset}
            out[surface.label] = {"kind": surface.kind, **found}
        radius = 1e3 * float(own[-1])
        return {"target_mm": (1e3 * own[:3]).tolist(), "ball_radius_mm": radius, "surfaces": out}


# ---- what is said of it ------------------------------------------------------------------------


def check(robot: Robot, data: Touches, options: RelativeOptions) -> None:
    """Raise DataError for slips."""
    check_radii(robot, data, options)
    check_slips(robot, data, options)


def check_radii(robot: Robot, data: Touches, options: RelativeOptions) -> None:
    """Raise DataError for a given radius that no arm like the drawn one can have found."""
    if not (np.isfinite(data.ball_radius) and any(s.kind == SPHERE for s in data.surfaces)):
        return
    free = tuple(replace(s, size=np.nan) if s.kind == SPHERE else s for s in data.surfaces)
    contacts, x = started(robot, data, options)
    block, at = started(robot, replace(data, surfaces=free), options)
    one, other = contacts.mean_square(x), block.mean_square(at)
    found = block.placed(at, at)["surfaces"]
    for surface in data.surfaces:
        size_mm = found[surface.label].get("radius_mm", 0.0)
        off = abs(size_mm - 1e3 * surface.size) if surface.kind == SPHERE else 0.0
        if one > BETTER_RADIUS * other and off > FAR * 1e3 * np.sqrt(other):
            raise DataError(
                f"{data.at.source}: column radius_mm: by the arm as drawn surface "
                f"{surface.label!r} has a radius of {size_mm:.4g} mm, not "
                f"{1e3 * surface.size:.4g} mm; check radius_mm, ball_radius_mm and their units"
            )


INSTRUMENT = Instrument(
    name=Touches.kind,
    words=Words(
        quantity="gap between the probe's ball and its surface",
        part="surface",
        caution="A gap is no error of position: what moves along the surface does not show in it. ",
        counted="contacts",
        check="the labels of the surfaces, and radii",
        more="more surfaces, of other directions and farther apart",
    ),
    block=Contacts.of,
    columns=Columns(re.compile("surface"), CONTACT, "surface with kind", read),
    check_slips=check,
    scale=(
        "a contact has no length standard",
        "a ball of known radius on a sphere or body of known size gives it, or a file of lengths",
    ),
)
