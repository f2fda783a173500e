"""Blocks of several instruments as one least-squares problem over one arm."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import pairwise

import numpy as np

from minimax_cal.fitting.instruments.data import RelativeData
from minimax_cal.fitting.instruments.laws import NO_LAWS, Laws
from minimax_cal.fitting.instruments.rows import Block, own_state, through
from minimax_cal.ground.arrays import Array
from minimax_cal.modelling.effects.scene import Scene
from minimax_cal.modelling.joint_fit import scene_of
from minimax_cal.modelling.model import Model
from minimax_cal.modelling.parameters import BASE_NAMES, Names, State
from minimax_cal.robots.robot import Robot

ANGLES = ("_rx", "_ry", "_rz", "_tilt1", "_tilt2")  # endings of names


@dataclass(frozen=True)
class OwnNames(Names):
    """Parameters of an arm whose base is the frame, and so none of them, and of instruments.

    laws: units of the last ones, those of the laws by which the arm gives way.
    """

    laws: tuple[str, ...] = ()

    @cached_property
    def all(self) -> tuple[str, ...]:
        """Every name, in order; the base's are empty."""
        links = Names(self.joints, (), (), self.rows).all[: 5 * self.joints]
        return (*links, *[""] * len(BASE_NAMES), *self.effects)

    @cached_property
    def units(self) -> tuple[str, ...]:
        """(p,) SI."""
        turned = [name.endswith(ANGLES) for name in self.all]
        length = self.linear & ~np.array(turned)
        own = length[: self.count - len(self.laws)]
        return (*("m" if each else "rad" for each in own), *self.laws)


@dataclass(frozen=True, eq=False)
class Stack:
    """Instruments that share an arm.

    labels: of each; the names of a lone one's parameters go without.  precision: of each block's
    rows, relative to any.  names: all p parameters, behind the arm's those of the instruments, and
    last those of the laws.  given: (b,) variance of a row that is given, NaN where residuals say it
    [m^2].  laws: by which the arm gives way.
    """

    blocks: tuple[Block, ...]
    labels: tuple[str, ...]
    names: OwnNames
    precision: Array
    given: Array
    laws: Laws = NO_LAWS

    @staticmethod
    def of(robot: Robot, blocks: Sequence[Block], labels: Sequence[str]) -> Stack:
        """Blocks that weigh alike."""
        stems = [f"{label}." if len(blocks) > 1 else "" for label in labels]
        own = [stem + name for stem, one in zip(stems, blocks, strict=True) for name in one.own]
        names = OwnNames(robot.joints, (), tuple(own), robot.notation.names(robot.joints))
        count = len(blocks)
        return Stack(tuple(blocks), tuple(labels), names, np.ones(count), np.full(count, np.nan))

    @property
    def points(self) -> int:
        """Number of compared points."""
        return sum(block.points for block in self.blocks)

    @cached_property
    def movable(self) -> Array:
        """(p,) False for the base, which is the frame."""
        place, first = np.arange(self.names.count), 5 * self.names.joints
        return np.asarray((place < first) | (place >= self.names.geometric))

    @cached_property
    def slots(self) -> tuple[slice, ...]:
        """Where the parameters of each block stand among the instruments' own."""
        ends = np.cumsum([0, *(len(block.own) for block in self.blocks)]).tolist()
        return tuple(slice(*pair) for pair in pairwise(ends))

    @property
    def lawless(self) -> int:
        """Number of parameters before those of the laws."""
        return self.names.count - len(self.laws.names)

    def own(self, i: int) -> Array:
        """Where the parameters of a block's own stand among all."""
        return np.arange(self.names.geometric, self.names.count)[self.slots[i]]

    def columns(self, i: int) -> Array:
        """Where the parameters that a block's rows depend on stand among all."""
        every = np.arange(self.names.count)
        return np.concatenate([every[: self.names.geometric], self.own(i), every[self.lawless :]])

    def state(self, mdh: Array, own: Sequence[Array]) -> State:
        """A state of all blocks, of an arm that does not give way."""
        return own_state(mdh, np.concatenate([*own, np.zeros(len(self.laws.names))]))

    def part(self, x: State, i: int) -> State:
        """The state of a block."""
        first = self.names.geometric
        return replace(x, effects=x.effects[..., self.columns(i)[first:] - first])

    def values(self, x: State) -> Array:
        """(k,) of the laws."""
        return x.effects[..., self.lawless - self.names.geometric :]

    def scenes(self, robot: Robot, data: Sequence[RelativeData], x: State) -> list[Scene]:
        """What laws look at, block by block, with the geometry of a state.

        data: of each block, in the order of its poses.
        """
        out = []
        for i, (block, each) in enumerate(zip(self.blocks, data, strict=True)):
            state = block.arm_state(self.part(x, i))
            out.append(scene_of(robot, block.seen_at(each), block.model, state))
        return out

    def bent(
        self, robot: Robot, data: Sequence[RelativeData], laws: Laws, x: State
    ) -> tuple[Stack, State]:
        """The same instruments looking at an arm that gives way, linear at a state; that state.

        data: as `scenes`.  Laws that the stack did not have yet have the value 0.
        """
        values = self.values(x) if self.laws.names else np.zeros(len(laws.names))
        blocks = []
        for i, (block, each) in enumerate(zip(self.blocks, data, strict=True)):
            state = replace(block.arm_state(self.part(x, i)), effects=values)
            model = laws.on(block.model, robot, block.seen_at(each), state)
            blocks.append(through(block, model))
        stiff = self.names.effects[: self.lawless - self.names.geometric]
        names = replace(self.names, effects=(*stiff, *laws.names), laws=laws.units)
        own = x.effects[..., : len(stiff)]
        stack = replace(self, blocks=tuple(blocks), names=names, laws=laws)
        return stack, replace(x, effects=np.concatenate([own, values], axis=-1))

    def model_at(self, robot: Robot, i: int, data: RelativeData, x: State) -> Model:
        """The arm of a block at all rows of its data, its laws linear at a state."""
        block = self.blocks[i]
        state = replace(block.arm_state(self.part(x, i)), effects=self.values(x))
        return self.laws.on(block.model_at(robot, data), robot, block.seen_at(data), state)

    def rows_by_block(self, x: State, active: Array) -> Iterator[tuple[Array, Array]]:
        """Of each block: measured minus predicted (..., rows), as heavy as those of any other.

        And the derivative of the predicted (..., active, rows).  active: (p,).
        """
        place = np.cumsum(active) - 1
        for i, block in enumerate(self.blocks):
            columns = self.columns(i)
            mine = active[columns] & self.movable[: len(columns)]
            error, jacobian = block.rows(self.part(x, i), mine)
            whole = np.zeros((*error.shape[:-1], int(active.sum()), error.shape[-1]))
            whole[..., place[columns[mine]], :] = jacobian
            yield error, whole

    def rows(self, x: State, active: Array) -> tuple[Array, Array]:
        """Those of all blocks, each by the root of its precision."""
        found = list(self.rows_by_block(x, active))
        roots = np.sqrt(self.precision)
        errors, jacobians = (
            np.concatenate([root * part for root, part in zip(roots, parts, strict=True)], axis=-1)
            for parts in zip(*found, strict=True)
        )
        return errors, jacobians

    @property
    def weights(self) -> Array:
        """(rows,) see `Block.weights`."""
        return np.concatenate([block.weights for block in self.blocks])

    def gram(self, x: State) -> Array:
        """The Gram matrix of all parameters at a state: (p, p)."""
        _, jacobian = self.rows(x, np.ones(self.names.count, dtype=bool))
        return np.asarray(jacobian @ jacobian.T)

    def reference(self, robot: Robot, x: State) -> Stack:
        """Every block at plenty of poses, alike in weight."""
        found = [b.reference(robot, self.part(x, i)) for i, b in enumerate(self.blocks)]
        return replace(self, blocks=tuple(found), precision=np.ones(len(found)))

    def closed(self, robot: Robot, x: State) -> Stack:
        """Every block where the arm at a state itself fits it."""
        found = [b.closed(robot, self.part(x, i)) for i, b in enumerate(self.blocks)]
        return replace(self, blocks=tuple(found))


@dataclass(frozen=True, eq=False)
class Known:
    """What is known of the links before any measurement.

    mean: (5 n,) as drawn.  sigma: (5 n,) how far they may be from there, infinite where nothing is
    known [SI].  laws: (k,) the same of the laws' parameters, whose mean is 0.
    """

    mean: Array
    sigma: Array
    laws: Array = field(default_factory=lambda: np.zeros(0))

    @property
    def any(self) -> bool:
        """Whether anything is known."""
        return bool(np.isfinite(self.sigma).any() or np.isfinite(self.laws).any())

    def told(self, count: int) -> Array:
        """(count,) True for parameters of which something is known."""
        return self.weights(1.0, count) > 0.0

    def weights(self, variance: float, count: int) -> Array:
        """(count,) weights of all parameters beside rows of a variance [m^2 per unit^2]."""
        links = np.pad(variance / self.sigma**2, (0, count - len(self.sigma)))
        return links + np.pad(variance / self.laws**2, (count - len(self.laws), 0))

    def off(self, x: State, count: int) -> Array:
        """(..., count) how far the parameters are from their mean, 0 where they have none."""
        links = np.swapaxes(x.mdh, -1, -2)  # in the order of `parameters.links_of`
        links = links.reshape(*links.shape[:-2], -1)
        out = np.zeros((*links.shape[:-1], count))
        out[..., : len(self.mean)] = self.mean - links
        out[..., count - len(self.laws) :] = -x.effects[..., x.effects.shape[-1] - len(self.laws) :]
        return out


@dataclass(frozen=True, eq=False)
class Squares:
    """The sum of squared rows over the active parameters, for `solvers.least_squares`.

    Nothing is left to eliminate linearly.  known: of the links and the laws, which counts with the
    weights (p,) where these are given.  room: (k, 2) between which the laws' parameters must lie.
    """

    stack: Stack
    active: Array
    known: Known | None = None
    weight: Array = field(default_factory=lambda: np.zeros(0))
    room: Array = field(default_factory=lambda: np.zeros((0, 2)))

    @property
    def names(self) -> Names:
        """Of all parameters."""
        return self.stack.names

    @property
    def whole_room(self) -> Array:
        """(e, 2) between which all that stands as effects in a state must lie."""
        open_ends = np.full((self.stack.lawless - self.names.geometric, 2), np.inf)
        return np.concatenate([open_ends * [-1.0, 1.0], self.room])

    @property
    def linear(self) -> Array:
        """(free,) False: all parameters count as nonlinear."""
        return np.zeros(int(self.active.sum()), dtype=bool)

    @property
    def prior(self) -> Array:
        """(free, free) what the priors add to the Gram matrix."""
        weight = self.weight if len(self.weight) else np.zeros(len(self.active))
        return np.diag(weight[self.active])

    def normal(self, x: State) -> tuple[Array, Array, Array]:
        """Cost (...), gradient (..., free) and Gram matrix (..., free, free)."""
        error, jacobian = self.stack.rows(x, self.active)
        cost = np.einsum("...r,...r->...", error, error)
        gradient = (jacobian @ error[..., None])[..., 0]
        gram = jacobian @ np.swapaxes(jacobian, -1, -2)
        if self.known and len(self.weight):
            off = self.known.off(x, len(self.active))[..., self.active]
            weight = self.weight[self.active]
            cost = cost + (weight * off**2).sum(axis=-1)
            gradient = gradient + weight * off
            gram = gram + self.prior
        return np.asarray(cost), np.asarray(gradient), gram

    def reduced(self, x: State, *, full: bool) -> tuple[State, Array, Array, Array, Array]:
        """The same: there is nothing to eliminate."""
        cost, gradient, gram = self.normal(x)
        return x, cost, gradient, gram, np.zeros((len(cost), 0, gradient.shape[-1]))

    def step(self, x: State, dx: Array) -> State:
        """The states moved by a step in the active parameters."""
        whole = np.zeros((*dx.shape[:-1], self.stack.names.count))
        whole[..., self.active] = dx
        return x.step(whole)
