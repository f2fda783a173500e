"""A ball on the flange that visits sockets again: the places of the sockets are eliminated."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np

from minimax_cal.fitting.checks import POOR_FIT
from minimax_cal.fitting.instruments.closing import closing_poses, reach
from minimax_cal.fitting.instruments.options import FAR, RelativeOptions, known_text, sigmas_of
from minimax_cal.fitting.instruments.plausible import check_slips
from minimax_cal.fitting.instruments.record import Columns, Instrument, Words
from minimax_cal.fitting.instruments.rows import (
    LINEAR_RANK,
    SPOT,
    Block,
    OnFlange,
    motion,
    own_state,
    places,
)
from minimax_cal.fitting.instruments.visits import SOCKET, Visits, held_back, misclosures, read
from minimax_cal.ground.arrays import Array
from minimax_cal.ground.errors import OptionError
from minimax_cal.measuring.measurements import FARTHEST
from minimax_cal.modelling.model import Model, arm_at
from minimax_cal.modelling.parameters import State
from minimax_cal.robots.robot import Robot

SOCKETS, VISITS = 20, 10


@dataclass(frozen=True, eq=False)
class Closures(OnFlange):
    """Visits to sockets, about each socket's barycentre, as a block, see `rows.Block`.

    model: the arm at the m poses, sorted by socket.  first: (g,) where each socket begins.
    pairs: (l, 2) sockets whose distance (l,) is known [m].  labels: (g,) of the sockets.
    known: these distances as given.  sole_length: whether they are the only lengths of the fit;
    alone: whether the closures are all of it.  loose: whether rows move with their own visit alone,
    the sockets standing where they do.
    """

    model: Model
    first: Array
    pairs: Array
    distance: Array
    labels: tuple[str, ...] = ()
    known: tuple[tuple[str, str, float], ...] = ()
    sole_length: bool = True
    alone: bool = True
    loose: bool = False

    kind = "closures"
    own = SPOT
    parts = ("visits",)

    @staticmethod
    def seen(robot: Robot, data: Visits, options: RelativeOptions) -> Closures:
        """Visits to sockets, with the distances that are known between them."""
        labels, number = np.unique(data.socket, return_inverse=True)
        place = {str(label): i for i, label in enumerate(labels)}
        known = tuple(one for one in options.known_distances if set(one[:2]) <= set(place))
        pairs = np.array([(place[a], place[b]) for a, b, _ in known], dtype=int).reshape(-1, 2)
        distance = np.array([length for _, _, length in known])
        made = Closures.of(robot, data.at.q, number, pairs, distance)
        return replace(made, labels=data.sockets, known=known)

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
    def given(self) -> int:
        """The known distances."""
        return len(self.pairs)

    def beside(self, others: Sequence[Block]) -> Self:
        """A length of any other instrument is as good as a known distance."""
        lengths = any(block.has_length for block in others if not isinstance(block, Closures))
        return replace(self, sole_length=not lengths, alone=not others)

    def size(self, x: State) -> float:
        """The target's spread: an arm that hardly moves closes anything."""
        return self.spread(x)

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

    def errors(self, model: Model, x: State, data: Visits, held: Array) -> Array:
        """Of visits about their socket."""
        return misclosures(places(model, x).T, data.socket, held)[None]

    def placed(self, x: State, nominal: State) -> dict[str, Any]:
        """Ball in the last frame, sockets in the robot's base."""
        centre = self.barycentres(places(self.model, x)).T
        drawn = "as drawn" if self.alone else "other files"
        return {
            "target_mm": (1e3 * x.effects[:3]).tolist(),
            "sockets_mm": dict(zip(self.labels, (1e3 * centre).tolist(), strict=True)),
            "known_distances": [[a, b, 1e3 * length] for a, b, length in self.known],
            "scale": "known distance" if self.pairs.size else drawn,
        }


# ---- what is chosen and said of it -------------------------------------------------------------


def check_options(every: Sequence[Visits], options: RelativeOptions) -> None:
    """Raise OptionError for a known distance that is none of these files'."""
    sockets = [set(data.sockets) for data in every]
    files = ", ".join(data.at.source for data in every)
    asked: set[frozenset[str]] = set()
    for known in options.known_distances:
        first, second, distance = known
        said = known_text(known)
        if {first, second} in asked:
            raise OptionError(f"{said}: this distance is given twice; give it once")
        asked.add(frozenset((first, second)))
        for label in (first, second):
            if not any(label in some for some in sockets):
                raise OptionError(f"{said}: {files} has no socket {label!r}")
        if first == second or not 0.0 < distance < FARTHEST:
            raise OptionError(f"{said}: needs two different sockets and a positive length")
        if sum({first, second} <= some for some in sockets) != 1:
            raise OptionError(f"{said}: both sockets must be in one file, and in no other")


def check(robot: Robot, data: Visits, options: RelativeOptions) -> None:
    """Raise DataError for slips, of all visits; OptionError for known distances."""
    near = check_slips(robot, data, options)
    if near is not None:
        check_known(robot, data, options, *near)


def check_known(
    robot: Robot, data: Visits, options: RelativeOptions, closures: Closures, x: State
) -> None:
    """Raise OptionError for a known distance that no arm like the drawn one can have."""
    centre = closures.barycentres(places(closures.model, x)).T
    limits = farthest(robot, options, closures, x)
    for known, (a, b), limit in zip(closures.known, closures.pairs, limits, strict=True):
        drawn, told = float(np.linalg.norm(centre[a] - centre[b])), known[2]
        if abs(drawn - told) <= limit:
            continue
        metres = "; metres? give millimetres" if abs(drawn - 1e3 * told) <= limit else ""
        raise OptionError(
            f"{known_text(known)}: by the arm as drawn these sockets of {data.at.source} are "
            f"{1e3 * drawn:.4g} mm apart{metres or '; check the labels and the length'}"
        )


def farthest(robot: Robot, options: RelativeOptions, closures: Closures, x: State) -> list[float]:
    """By how much the drawn arm may miss each known distance: more where priors let it [m]."""
    sigma = sigmas_of(closures.model.names, options)
    free = np.pad(np.isfinite(sigma), (0, closures.model.names.count - len(sigma)))
    limit = 4.0 * POOR_FIT * robot.reach()
    if not (free.any() and len(closures.pairs)):
        return [limit] * len(closures.pairs)
    _, jacobian = closures.rows(x, free)
    slope = jacobian[:, -len(closures.pairs) :] / np.sqrt(closures.weights[-1])
    spread = np.linalg.norm(slope * sigma[np.isfinite(sigma)][:, None], axis=0)
    return [limit + FAR * float(one) for one in spread]


INSTRUMENT = Instrument(
    name=Visits.kind,
    words=Words(
        quantity="ball about its socket",
        caution="A misclosure is no error of position: what moves all visits of a socket alike "
        "does not show in it. ",
        counted="coordinates of visits",
        check="the labels of the sockets",
        more="more sockets, farther apart",
    ),
    block=Closures.seen,
    columns=Columns(SOCKET, SOCKET, "socket", read),
    check_slips=check,
    options=("known_distances",),
    check_options=check_options,
    held_back=held_back,
    unmoved="moves or turns all sockets alike: closures know no base frame",
    scale=(
        "a closure has no length standard",
        "one known length, as known_distances= A,B,MM, gives it",
    ),
)
