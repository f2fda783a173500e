"""Residuals of lengths and of closures, and their derivatives: a least-squares problem each.

The robot's base is the frame: no instrument has one.  What an instrument adds to the unknowns (the
anchors of wires and their offsets) stands at the end of the state, where effects stand elsewhere;
the places of sockets are eliminated.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from minimax_cal.ground.arrays import Array
from minimax_cal.modelling.model import Block, Model, Prior
from minimax_cal.modelling.parameters import Names, State, links_of
from minimax_cal.robots import kinematics
from minimax_cal.robots.robot import Robot

TARGET = "target"  # the point on the flange: of the wires, or the ball


def arm_at(robot: Robot, q: Array) -> Model:
    """The arm with one point on its flange at joint values (m, n), as the controller gives them."""
    names = Names.of(robot, (TARGET,))
    mean = np.zeros(names.count)
    mean[names.links] = links_of(robot.mdh)
    return Model(
        q=robot.turned(q),
        prismatic=robot.prismatic,
        y=np.zeros((1, 3, len(q))),
        weight=np.ones((1, len(q))),
        names=names,
        active=np.ones(names.count, dtype=bool),
        prior=Prior(mean, np.zeros(names.count)),
    )


def state_of(mdh: Array, target: Array, own: Array) -> State:
    """A state with the base as the frame.  target: (3,) [m].  own: (e,) of the instrument."""
    return State(mdh, np.eye(3), np.zeros(3), target[None], own)


def places(model: Model, x: State) -> Array:
    """The point on the flange in the base: (..., 3, m) [m]."""
    links = kinematics.chain(x.mdh, model.q, model.prismatic)
    return np.asarray(kinematics.points(links, x.target_positions)[..., 0, :, :])


def motion(model: Model, x: State, active: Array) -> tuple[Array, Array]:
    """`places`, and their derivative by the active parameters of the arm: (..., active, 3, m)."""
    links = kinematics.chain(x.mdh, model.q, model.prismatic)
    error, turned = model.weighted_rows(x, Block(slice(0, len(model.q)), links), active)
    return -error[..., 0, :, :], turned[..., 0, :, :, :]


@dataclass(frozen=True, eq=False)
class Wires:
    """Lengths from fixed anchors to the target.

    model: the arm at the m poses.  names: all p parameters, anchors and offsets at the end.
    length: (m, s), NaN where not measured [m].
    """

    model: Model
    names: Names
    length: Array

    @staticmethod
    def of(robot: Robot, q: Array, wires: tuple[str, ...], length: Array) -> Wires:
        """Wires of a robot; the parameters of wire3 are anchor3_x ... and offset3."""
        numbers = [wire.removeprefix("wire") for wire in wires]
        own = [f"anchor{number}_{axis}" for number in numbers for axis in "xyz"]
        own += [f"offset{number}" for number in numbers]
        return Wires(arm_at(robot, q), Names.of(robot, (TARGET,), tuple(own)), length)

    @property
    def points(self) -> int:
        """Number of measured lengths."""
        return int(np.isfinite(self.length).sum())

    @property
    def weights(self) -> Array:
        """(rows,) one each."""
        return np.ones(self.points)

    def split(self, own: Array) -> tuple[Array, Array]:
        """Anchors (..., s, 3) and offsets (..., s) [m]."""
        s = self.length.shape[1]
        return own[..., : 3 * s].reshape(*own.shape[:-1], s, 3), own[..., 3 * s :]

    def errors(self, x: State) -> Array:
        """Measured minus predicted lengths: (..., s, m), NaN where not measured [m]."""
        anchors, offsets = self.split(x.effects)
        gap = places(self.model, x)[..., None, :, :] - anchors[..., None]
        return np.asarray(self.length.T - np.linalg.norm(gap, axis=-2) - offsets[..., None])

    def rows(self, x: State, active: Array) -> tuple[Array, Array]:
        """Measured minus predicted (..., rows), and the derivative of the predicted.

        A row for each measured length: it grows as the target moves along the wire.  active: (p,).
        The derivative is (..., active, rows).
        """
        arm = self.model.names.count
        point, arms = motion(self.model, x, active[:arm])
        anchors, offsets = self.split(x.effects)
        gap = point[..., None, :, :] - anchors[..., None]
        distance = np.maximum(np.linalg.norm(gap, axis=-2), 1e-12)
        unit = gap / distance[..., None, :]
        *batch, s, m = distance.shape
        own = np.zeros((*batch, 4 * s, s, m))
        for i in range(s):
            own[..., 3 * i : 3 * i + 3, i, :] = -unit[..., i, :, :]
            own[..., 3 * s + i, i, :] = 1.0
        along = np.einsum("...scm,...pcm->...psm", unit, arms)
        jacobian = np.concatenate([along, own[..., active[arm:], :, :]], axis=-3)
        seen = np.isfinite(self.length.T)
        error = self.length.T - distance - offsets[..., None]
        return error[..., seen], jacobian[..., seen]


@dataclass(frozen=True, eq=False)
class Closures:
    """Visits to sockets, about each socket's barycentre; known distances between sockets.

    model: the arm at the m poses, sorted by socket.  first: (g,) where each socket begins.
    pairs: (l, 2) sockets whose distance (l,) is known [m].
    """

    model: Model
    first: Array
    pairs: Array
    distance: Array

    @staticmethod
    def of(robot: Robot, q: Array, socket: Array, pairs: Array, distance: Array) -> Closures:
        """Closures of a robot.  socket: (m,) numbers from 0, each there.  pairs: of these."""
        order = np.argsort(socket, kind="stable")
        _, first = np.unique(socket[order], return_index=True)
        return Closures(arm_at(robot, q[order]), first, pairs.reshape(-1, 2), distance)

    @property
    def names(self) -> Names:
        """The arm's parameters: the sockets' places are eliminated."""
        return self.model.names

    @property
    def points(self) -> int:
        """Number of visits."""
        return len(self.model.q)

    @property
    def weights(self) -> Array:
        """(rows,) one each for visits, and as much as all of them for a known distance."""
        coordinates = 3 * self.points
        return np.concatenate([np.ones(coordinates), np.full(len(self.pairs), coordinates)])

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
        """Measured minus predicted (..., rows), and the derivative of the predicted.

        Three rows a visit, and one for each known distance.  active: (p,).  The derivative is
        (..., active, rows).

        The best place of a socket is the visits' barycentre, whatever the other parameters are:
        eliminating it leaves the visits about it.  A known distance weighs as all of them together:
        else the fit would shrink the arm to shrink its misclosures.
        """
        point, arms = motion(self.model, x, active)
        *batch, p, _, m = arms.shape
        error, jacobian = -self.centred(point), self.centred(arms)
        parts = [error.reshape(*batch, 3 * m), jacobian.reshape(*batch, p, 3 * m)]
        if len(self.pairs):
            a, b = self.pairs.T
            place, moved = self.barycentres(point), self.barycentres(arms)
            gap = place[..., a] - place[..., b]
            length = np.maximum(np.linalg.norm(gap, axis=-2), 1e-12)
            weight = np.sqrt(3.0 * m)
            along = (gap / length[..., None, :])[..., None, :, :] * (moved[..., a] - moved[..., b])
            parts[0] = np.concatenate([parts[0], weight * (self.distance - length)], axis=-1)
            parts[1] = np.concatenate([parts[1], weight * along.sum(axis=-2)], axis=-1)
        return parts[0], parts[1]


# Both have: model, the arm at the poses measured; names, all p parameters, the instrument's own at
# the end; points, how many are compared; weights of the rows; and `rows`.
Instrument = Wires | Closures


@dataclass(frozen=True, eq=False)
class Known:
    """What is known of the links before any measurement.

    mean: (5 n,) as drawn.  sigma: (5 n,) how far they may be from there, infinite where nothing is
    known [SI].
    """

    mean: Array
    sigma: Array

    @property
    def any(self) -> bool:
        """Whether anything is known."""
        return bool(np.isfinite(self.sigma).any())

    def weights(self, variance: float, count: int) -> Array:
        """(count,) weights of all parameters beside rows of a variance [m^2 per unit^2]."""
        return np.pad(variance / self.sigma**2, (0, count - len(self.sigma)))

    def off(self, x: State) -> Array:
        """(..., 5 n) how far the links are from their mean."""
        links = np.swapaxes(x.mdh, -1, -2)  # in the order of `parameters.links_of`
        return np.asarray(self.mean - links.reshape(*links.shape[:-2], -1))


@dataclass(frozen=True, eq=False)
class Squares:
    """The sum of squared rows over the active parameters, for `solvers.least_squares`.

    Nothing is left to eliminate linearly: sockets are gone, and lengths of wires are affine in
    none of the parameters but the offsets.  known: of the links, which counts with the weights (p,)
    where these are given.
    """

    instrument: Instrument
    active: Array
    known: Known | None = None
    weight: Array = field(default_factory=lambda: np.zeros(0))

    @property
    def linear(self) -> Array:
        """(free,) False: all parameters count as nonlinear."""
        return np.zeros(int(self.active.sum()), dtype=bool)

    def normal(self, x: State) -> tuple[Array, Array, Array]:
        """Cost (...), gradient (..., free) and Gram matrix (..., free, free)."""
        error, jacobian = self.instrument.rows(x, self.active)
        cost = np.einsum("...r,...r->...", error, error)
        gradient = (jacobian @ error[..., None])[..., 0]
        gram = jacobian @ np.swapaxes(jacobian, -1, -2)
        if self.known and len(self.weight):
            off = np.zeros((*cost.shape, len(self.active)))
            off[..., : len(self.known.mean)] = self.known.off(x)
            off, weight = off[..., self.active], self.weight[self.active]
            cost = cost + (weight * off**2).sum(axis=-1)
            gradient = gradient + weight * off
            gram = gram + np.diag(weight)
        return np.asarray(cost), np.asarray(gradient), gram

    def reduced(self, x: State, *, full: bool) -> tuple[State, Array, Array, Array, Array]:
        """The same: there is nothing to eliminate."""
        cost, gradient, gram = self.normal(x)
        return x, cost, gradient, gram, np.zeros((len(cost), 0, gradient.shape[-1]))

    def step(self, x: State, dx: Array) -> State:
        """The states moved by a step in the active parameters."""
        whole = np.zeros((*dx.shape[:-1], self.instrument.names.count))
        whole[..., self.active] = dx
        return x.step(whole)


def gram_of(instrument: Instrument, x: State) -> Array:
    """The Gram matrix of all parameters at a state: (p, p)."""
    every = np.ones(instrument.names.count, dtype=bool)
    _, jacobian = instrument.rows(x, every)
    return np.asarray(jacobian @ jacobian.T)
