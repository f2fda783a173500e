"""A ball on the flange that visits sockets again: the places of the sockets are eliminated."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, ClassVar, Self

import numpy as np

from minimax_cal.fitting.instruments.closing import closing_poses, reach
from minimax_cal.fitting.instruments.data import RelativeData
from minimax_cal.fitting.instruments.rows import (
    LINEAR_RANK,
    SPOT,
    OnFlange,
    arm_at,
    motion,
    own_state,
    places,
)
from minimax_cal.fitting.instruments.split import misclosures
from minimax_cal.ground.arrays import Array
from minimax_cal.modelling.model import Model
from minimax_cal.modelling.parameters import State
from minimax_cal.robots.robot import Robot

SOCKETS, VISITS = 20, 10


@dataclass(frozen=True, eq=False)
class Closures(OnFlange):
    """Visits to sockets, about each socket's barycentre, as a block, see `rows.Block`.

    model: the arm at the m poses, sorted by socket.  first: (g,) where each socket begins.
    pairs: (l, 2) sockets whose distance (l,) is known [m].  labels: (g,) of the sockets.
    known: these distances as given.  sole_length: whether they are the only lengths of the fit.
    loose: whether rows move with their own visit alone, the sockets standing where they do.
    """

    model: Model
    first: Array
    pairs: Array
    distance: Array
    labels: tuple[str, ...] = ()
    known: tuple[tuple[str, str, float], ...] = ()
    sole_length: bool = True
    loose: bool = False

    kind = "closures"
    own = SPOT
    given_up: ClassVar[tuple[str, ...]] = ()
    held: ClassVar[tuple[str, ...]] = ()
    row_noise = 1.0
    whole = ""
    parts = ("visits",)

    @staticmethod
    def of(robot: Robot, q: Array, socket: Array, pairs: Array, distance: Array) -> Closures:
        """Closures of a robot.  socket: (m,) numbers from 0, each there.  pairs: of these."""
        order = np.argsort(socket, kind="stable")
        _, first = np.unique(socket[order], return_index=True)
        return Closures(arm_at(robot, q[order]), first, pairs.reshape(-1, 2), distance)

    @property
    def has_length(self) -> bool:
        """Whether a distance of sockets is known."""
        return bool(len(self.pairs))

    @property
    def points(self) -> int:
        """Number of visits."""
        return len(self.model.q)

    @property
    def numbers(self) -> int:
        """Independent ones: three less for each socket's place; and known distances."""
        return 3 * (self.points - len(self.first)) + len(self.pairs)

    @property
    def weights(self) -> Array:
        """(rows,) one each for visits, and for a known distance as much as all of them together.

        Else the fit would shrink the arm to shrink its misclosures.  Where other instruments
        measure lengths too, it counts as a coordinate.
        """
        coordinates = 3 * self.points
        heavy = coordinates if self.sole_length else 1
        return np.concatenate([np.ones(coordinates), np.full(len(self.pairs), heavy)])

    @property
    def visits(self) -> Array:
        """(g,) how often each socket was visited."""
        return np.diff(np.append(self.first, self.points))

    def barycentres(self, values: Array) -> Array:
        """Means over the visits of each socket: (..., g).  values: (..., m), in sorted order."""
        return np.asarray(np.add.reduceat(values, self.first, axis=-1) / self.visits)

    def centred(self, values: Array) -> Array:
        """Values (..., m) without their socket's mean."""
        return np.asarray(values - np.repeat(self.barycentres(values), self.visits, axis=-1))

    def rows(self, x: State, active: Array) -> tuple[Array, Array]:
        """Three rows a visit, and one for each known distance.

        The best place of a socket is the visits' barycentre, whatever the other parameters are:
        eliminating it leaves the visits about it.
        """
        point, arms = motion(self.model, x, active)
        *batch, p, _, m = arms.shape
        error, jacobian = -self.centred(point), arms if self.loose else self.centred(arms)
        parts = [error.reshape(*batch, 3 * m), jacobian.reshape(*batch, p, 3 * m)]
        if len(self.pairs):
            a, b = self.pairs.T
            place, moved = self.barycentres(point), self.barycentres(arms)
            gap = place[..., a] - place[..., b]
            length = np.maximum(np.linalg.norm(gap, axis=-2), 1e-12)
            weight = np.sqrt(self.weights[3 * m :])
            along = (gap / length[..., None, :])[..., None, :, :] * (moved[..., a] - moved[..., b])
            parts[0] = np.concatenate([parts[0], weight * (self.distance - length)], axis=-1)
            parts[1] = np.concatenate([parts[1], weight * along.sum(axis=-2)], axis=-1)
        return parts[0], parts[1]

    @property
    def pose_of_row(self) -> Array:
        """Axis by axis; a known distance with the first visit to its first socket."""
        return np.concatenate([np.tile(np.arange(self.points), 3), self.first[self.pairs[:, 0]]])

    def by_pose(self) -> Self:
        """With the sockets where they are."""
        return replace(self, loose=True)

    def places_of_rows(self) -> Array:
        """The sockets' places."""
        here = np.repeat(np.arange(len(self.first)), self.visits)
        of_visit = (here == np.arange(len(self.first))[:, None]).astype(float)
        moved = np.kron(np.eye(3), of_visit)
        return np.pad(moved, ((0, 0), (0, len(self.pairs))))

    def start(self, robot: Robot, free: Array) -> Array:
        """The ball's place on the flange for the arm as drawn, in which misclosures are linear."""
        arm = np.zeros(5 * robot.joints + 6, dtype=bool)
        alone = replace(self, pairs=self.pairs[:0], distance=self.distance[:0])
        rows = alone.rows(own_state(robot.mdh, np.zeros(3)), np.concatenate([arm, free]))
        values, vectors = np.linalg.eigh(rows[1] @ rows[1].T)
        told = values > LINEAR_RANK**2 * max(float(values[-1]), 1e-30)
        ball = np.zeros(3)
        ball[free] = vectors[:, told] @ (vectors[:, told].T @ (rows[1] @ rows[0]) / values[told])
        return ball

    def reference(self, robot: Robot, x: State) -> Closures:
        """At plenty of random poses that close."""
        rng = np.random.default_rng(0)
        q, socket = closing_poses(robot, x.effects[:3], SOCKETS, VISITS, rng)
        if len(np.unique(socket)) < 2:  # an arm that hardly reaches a place in two ways
            return self.closed(robot, x)
        _, socket = np.unique(socket, return_inverse=True)
        known = min(len(self.pairs), 1)
        return Closures.of(robot, q, socket, np.array([[0, 1]])[:known], np.zeros(known))

    def closed(self, robot: Robot, x: State) -> Closures:
        """At nearby poses where the arm itself closes.

        Where a closure misses by millimetres, its rows turn with a turn of the whole arm, as if
        that could be told.
        """
        centre = self.barycentres(places(self.model, x))
        goal = np.repeat(centre, self.visits, axis=-1).T
        q, _ = reach(robot, x.effects[:3], goal, robot.commanded(self.model.q))
        return replace(self, model=replace(self.model, q=robot.turned(q)))

    def mean_square(self, x: State) -> float:
        """Of visits about their socket [m^2]."""
        off = self.centred(places(self.model, x))
        return float((off**2).sum(axis=0).mean())

    def errors(self, model: Model, x: State, data: RelativeData, held: Array) -> Array:
        """Of visits about their socket."""
        return misclosures(places(model, x).T, data.socket, held)[None]

    def placed(self, x: State, nominal: State) -> dict[str, Any]:
        """Ball in the last frame, sockets in the robot's base."""
        centre = self.barycentres(places(self.model, x)).T
        return {
            "target_mm": (1e3 * x.effects[:3]).tolist(),
            "sockets_mm": dict(zip(self.labels, (1e3 * centre).tolist(), strict=True)),
            "known_distances": [[a, b, 1e3 * length] for a, b, length in self.known],
        }
