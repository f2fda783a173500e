"""Blocks of several instruments as one least-squares problem over one arm."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import pairwise

import numpy as np

from minimax_cal.fitting.instruments.rows import Block, own_state
from minimax_cal.ground.arrays import Array
from minimax_cal.modelling.parameters import BASE_NAMES, Names, State
from minimax_cal.robots.robot import Robot

ANGLES = ("_rx", "_ry", "_rz", "_tilt1", "_tilt2")  # endings of names


@dataclass(frozen=True)
class OwnNames(Names):
    """Parameters of an arm whose base is the frame, and so none of them, and of instruments."""

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
        return tuple("m" if each else "rad" for each in length)


@dataclass(frozen=True, eq=False)
class Stack:
    """Instruments that share an arm.

    labels: of each; the names of a lone one's parameters go without.  precision: of each block's
    rows, relative to any.  names: all p parameters, those of the instruments at the end.
    given: (b,) variance of a row that is given, NaN where residuals say it [m^2].
    """

    blocks: tuple[Block, ...]
    labels: tuple[str, ...]
    names: Names
    precision: Array
    given: Array

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

    def columns(self, i: int) -> Array:
        """Where the parameters of a block stand among all."""
        first = self.names.geometric
        own = np.arange(first, self.names.count)[self.slots[i]]
        return np.concatenate([np.arange(first), own])

    def state(self, mdh: Array, own: Sequence[Array]) -> State:
        """A state of all blocks."""
        return own_state(mdh, np.concatenate([*own, np.zeros(0)]))

    def part(self, x: State, i: int) -> State:
        """The state of a block."""
        return replace(x, effects=x.effects[..., self.slots[i]])

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

    Nothing is left to eliminate linearly.  known: of the links, which counts with the weights (p,)
    where these are given.
    """

    stack: Stack
    active: Array
    known: Known | None = None
    weight: Array = field(default_factory=lambda: np.zeros(0))

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
            off = np.zeros((*cost.shape, len(self.active)))
            off[..., : len(self.known.mean)] = self.known.off(x)
            off, weight = off[..., self.active], self.weight[self.active]
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
