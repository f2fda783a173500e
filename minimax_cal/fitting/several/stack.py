"""Blocks of several instruments as one least-squares problem over one arm."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import pairwise

import numpy as np

from minimax_cal.fitting.robust import SQUARE
from minimax_cal.fitting.several.laws import NO_LAWS, Laws
from minimax_cal.ground.arrays import Array
from minimax_cal.instruments.instrument import Instrument
from minimax_cal.instruments.protocol import (
    NONE,
    OF_NONE,
    Arm,
    FlangePoses,
    Given,
    ResidualRows,
    by_arm,
    corners,
)
from minimax_cal.modelling.effects.scene import Scene
from minimax_cal.modelling.parameters import BASE_NAMES, Names, State
from minimax_cal.robots.robot import Robot
from minimax_cal.solvers import least_squares
from minimax_cal.solvers.least_squares import METHODS, Limits, solve_normal

SCREENED = Limits(step=1e-6)  # tells one start from another; the best is refined


@dataclass(frozen=True)
class OwnNames(Names):
    """Parameters of an arm whose base is the frame, and so none of them, and of instruments.

    own: units of the instruments' parameters.  laws: of the last ones, those of the laws by which
    the arm gives way.
    """

    own: tuple[str, ...] = ()
    laws: tuple[str, ...] = ()

    @cached_property
    def all(self) -> tuple[str, ...]:
        """Every name, in order; the base's are empty."""
        links = Names(self.joints, (), (), self.rows).all[: 5 * self.joints]
        return (*links, *[""] * len(BASE_NAMES), *self.effects)

    @cached_property
    def units(self) -> tuple[str, ...]:
        """(p,) SI."""
        links = ("m" if length else "rad" for length in self.linear[: self.geometric])
        return (*links, *self.own, *self.laws)


@dataclass(frozen=True, eq=False)
class Block:
    """An instrument, and the arm at its poses.

    A state of it has the links and, as effects, the e parameters of the instrument's own and those
    of the laws by which its arm gives way; its p parameters are in the order of `Names`: links, the
    base (which is the frame), its own, the laws'.  share: (rows,) weights by a robust loss, empty
    where all rows weigh alike.
    """

    instrument: Instrument
    arm: Arm
    share: Array = field(default_factory=lambda: NONE)

    @staticmethod
    def of(robot: Robot, one: Instrument) -> Block:
        """With a stiff arm."""
        return Block(one, Arm.of(robot, one.at.q))

    def own(self, x: State) -> Array:
        """(e,) of the instrument."""
        return x.effects[: len(self.instrument.names)]

    def flange(self, x: State, active: Array | None = None) -> FlangePoses:
        """The flange at a state.  active: (5n + d,) as `Arm.at` has it."""
        return self.arm.at(x.mdh, x.effects[len(self.instrument.names) :], active)

    def at(self, x: State) -> tuple[FlangePoses, Array]:
        """The flange, and what is of the instrument."""
        return self.flange(x), self.own(x)

    def read(self, x: State) -> ResidualRows:
        """What the instrument says at a state."""
        return self.instrument.read(*self.at(x))

    def middle(self, x: State) -> Array:
        """(3,) amid the instrument's points on the flange, about which laws are asked [m]."""
        return np.asarray(self.instrument.targets(self.own(x)).mean(axis=0))

    def rows(self, x: State, active: Array, *, loose: bool = False) -> tuple[Array, Array]:
        """Measured minus predicted (..., rows) [m], derivative of the latter (..., active, rows).

        active: (p,).  loose: as `ResidualRows.settled`.
        """
        if x.mdh.ndim > 2:
            found = [self.rows(x.take(np.array(i)), active) for i in range(len(x.mdh))]
            return np.stack([error for error, _ in found]), np.stack([slope for _, slope in found])
        n, e = 5 * len(x.mdh), len(self.instrument.names)
        links, _, own, laws = np.split(active, [n, n + 6, n + 6 + e])
        flange = self.flange(x, np.concatenate([links, laws]))
        rows = self.instrument.read(flange, self.own(x))
        by, count = by_arm(flange, rows), int(links.sum())
        slopes = np.concatenate([by[:count], rows.by_own.T[own], by[count:]])
        return rows.settled(slopes, loose=loose, share=self.share)

    def part_of(self, rows: ResidualRows) -> Array:
        """(r,) which of the instrument's parts each row is of; corners of one pose are none."""
        several = len(rows.part) and len(self.instrument.parts) > 1
        return rows.part if several else np.zeros(len(rows.pose), dtype=int)

    @property
    def weight(self) -> Array:
        """(rows,) by the loss, or a single one."""
        return self.share if len(self.share) else np.ones(1)

    def weighed(self, share: Array) -> Block:
        """The same with weights (rows,) of the rows."""
        return replace(self, instrument=self.instrument.weighed(share), share=share)

    def scene(self, robot: Robot, x: State, spots: Array) -> Scene:
        """What laws look at, with the geometry of a state.  spots: (k, 3) on the flange [m]."""
        one = self.instrument
        return Scene.of(robot.with_mdh(x.mdh), one.seen, one.base(self.own(x)), spots, self.arm.q)

    def at_rows_of(self, robot: Robot, one: Instrument, laws: Laws, x: State) -> Block:
        """The same at other measurements of the instrument, the laws linear at a state."""
        block = Block.of(robot, self.instrument.at_rows_of(one))
        return block.bent(robot, laws, x)

    def bent(self, robot: Robot, laws: Laws, x: State) -> Block:
        """The same looking at an arm that gives way, linear at a state with the laws' values."""
        if not laws.terms:
            return self
        middle, values = self.middle(x), x.effects[len(self.instrument.names) :]
        scene = self.scene(robot, x, corners(middle))
        given = Given.of(self.arm.at(x.mdh), middle, *laws.fields(scene, values), values)
        return replace(self, arm=replace(self.arm, given=given))


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
    def of(robot: Robot, every: Sequence[Instrument], labels: Sequence[str]) -> Stack:
        """Instruments that weigh alike."""
        stems = [f"{label}." if len(every) > 1 else "" for label in labels]
        own = [stem + name for stem, one in zip(stems, every, strict=True) for name in one.names]
        units = tuple(unit for one in every for unit in one.units)
        names = OwnNames(robot.joints, (), tuple(own), robot.notation.names(robot.joints), units)
        blocks, count = tuple(Block.of(robot, one) for one in every), len(every)
        return Stack(blocks, tuple(labels), names, np.ones(count), np.full(count, np.nan))

    def stopped(self, mdh: Array) -> Stack:
        """The same with links (n, 5) that stay."""
        still = (replace(block, arm=block.arm.stopped(mdh)) for block in self.blocks)
        return replace(self, blocks=tuple(still))

    @property
    def instruments(self) -> tuple[Instrument, ...]:
        """Of the blocks."""
        return tuple(block.instrument for block in self.blocks)

    @property
    def points(self) -> int:
        """Number of compared points."""
        return sum(one.points for one in self.instruments)

    @cached_property
    def movable(self) -> Array:
        """(p,) False for the base, which is the frame."""
        place, first = np.arange(self.names.count), 5 * self.names.joints
        return np.asarray((place < first) | (place >= self.names.geometric))

    @cached_property
    def slots(self) -> tuple[slice, ...]:
        """Where the parameters of each block stand among the instruments' own."""
        ends = np.cumsum([0, *(len(one.names) for one in self.instruments)]).tolist()
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

    def parted(self, x: State) -> list[tuple[Block, State]]:
        """The blocks, each with its state."""
        return [(block, self.part(x, i)) for i, block in enumerate(self.blocks)]

    def values(self, x: State) -> Array:
        """(k,) of the laws."""
        return x.effects[..., self.lawless - self.names.geometric :]

    def read_out(self, x: State) -> State:
        """A state as people are told it."""
        own = [block.instrument.read_out(block.own(at)) for block, at in self.parted(x)]
        return replace(x, effects=np.concatenate([*own, self.values(x)]))

    def scenes(self, robot: Robot, x: State) -> list[Scene]:
        """What laws look at, block by block, with the geometry of a state and the targets."""
        return [block.scene(robot, at, block.instrument.targets(block.own(at)))
                for block, at in self.parted(x)]  # fmt: skip

    def bent(self, robot: Robot, laws: Laws, x: State) -> tuple[Stack, State]:
        """The same instruments looking at an arm that gives way, linear at a state; that state.

        Laws that the stack did not have yet have the value 0.
        """
        values = self.values(x) if self.laws.names else np.zeros(len(laws.names))
        stiff = self.names.effects[: self.lawless - self.names.geometric]
        names = replace(self.names, effects=(*stiff, *laws.names), laws=laws.units)
        x = replace(x, effects=np.concatenate([x.effects[: len(stiff)], values]))
        stack = replace(self, names=names, laws=laws)
        blocks = tuple(block.bent(robot, laws, at) for block, at in stack.parted(x))
        return replace(stack, blocks=blocks), x

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
        """Those of all blocks, by the roots of precisions and of the rows' weights."""
        found = list(self.rows_by_block(x, active))
        roots = [
            np.sqrt(w * block.weight) for w, block in zip(self.precision, self.blocks, strict=True)
        ]
        errors, jacobians = (
            np.concatenate([root * part for root, part in zip(roots, parts, strict=True)], axis=-1)
            for parts in zip(*found, strict=True)
        )
        return errors, jacobians

    @property
    def parts(self) -> tuple[str, ...]:
        """Every part by name, as wire1; of several files with what the file is called."""
        several = len(self.blocks) > 1
        return tuple(
            f"{label} {part}" if several else part
            for label, one in zip(self.labels, self.instruments, strict=True)
            for part in one.parts
        )

    def part_of_rows(self, x: State) -> Array:
        """(rows,) which of all parts each is of, block by block; -2 of rows that are of several."""
        out, first = [], 0
        for block, at in self.parted(x):
            rows, count = block.read(at), len(block.instrument.parts)
            part = block.part_of(rows)
            part = np.where(part == OF_NONE, -2, first + part)
            out += [part, np.full(len(rows.short), -2)]
            first += count
        return np.concatenate(out)

    def variance(self, left: Array) -> Array:
        """(b,) of a row of each block, as given or as a fit leaves [m^2]."""
        return np.where(np.isnan(self.given), left, self.given)

    def weights(self, x: State) -> Array:
        """(rows,) how much more each weighs than its noise says."""
        return np.concatenate([block.read(at).weights for block, at in self.parted(x)])

    def gram(self, x: State) -> Array:
        """The Gram matrix of all parameters at a state: (p, p)."""
        _, jacobian = self.rows(x, np.ones(self.names.count, dtype=bool))
        return np.asarray(jacobian @ jacobian.T)

    def reference(self, robot: Robot, x: State) -> Stack:
        """Every instrument at plenty of poses, alike in weight."""
        found = [
            Block.of(robot, block.instrument.elsewhere(robot, block.own(at)))
            for block, at in self.parted(x)
        ]
        return replace(self, blocks=tuple(found), precision=np.ones(len(found)))

    def closed(self, robot: Robot, x: State) -> Stack:
        """Every instrument where the arm as drawn itself fits it."""
        found = []
        for block, at in self.parted(x):
            one = block.instrument.fitting(robot, block.own(at))
            found.append(Block(one, replace(block.arm, q=robot.turned(one.at.q))))
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
        out[..., : len(self.mean)] = self.mean - links[..., : len(self.mean)]
        out[..., count - len(self.laws) :] = -x.effects[..., x.effects.shape[-1] - len(self.laws) :]
        return out


NOTHING = Known(np.zeros(0), np.zeros(0))


@dataclass(frozen=True, eq=False)
class Squares:
    """The sum of squared rows over the active parameters, for `solvers.least_squares`.

    known: of the links and the laws, which counts with the
    weights (p,) where these are given.  room: (k, 2) between which the laws' parameters must lie.
    loss: by which the rows have weights, at a scale (b,): sigma of a row of each block [m].
    """

    stack: Stack
    active: Array
    known: Known = NOTHING
    weight: Array = field(default_factory=lambda: np.zeros(0))
    room: Array = field(default_factory=lambda: np.zeros((0, 2)))
    loss: str = SQUARE
    scale: Array = field(default_factory=lambda: np.zeros(0))

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
        """(free,) True for parameters in which the rows are affine: none that would be worth it."""
        return np.zeros(int(self.active.sum()), dtype=bool)

    @property
    def prior(self) -> Array:
        """(free, free) what the priors add to the Gram matrix."""
        weight = self.weight if len(self.weight) else np.zeros(len(self.active))
        return np.diag(weight[self.active])

    def believed(self, variance: Array) -> Squares:
        """Instruments and priors weighed by the variances (b,) of their numbers [m^2].

        The best instrument weighs 1, so that a step of the rows is one of metres.
        """
        unit = float(variance.min())
        weight = self.known.weights(unit, self.names.count)
        return replace(self, stack=replace(self.stack, precision=unit / variance), weight=weight)

    def normal(self, x: State) -> tuple[Array, Array, Array]:
        """Cost (...), gradient (..., free) and Gram matrix (..., free, free)."""
        error, jacobian = self.stack.rows(x, self.active)
        cost = np.einsum("...r,...r->...", error, error)
        gradient = (jacobian @ error[..., None])[..., 0]
        gram = jacobian @ np.swapaxes(jacobian, -1, -2)
        if len(self.weight):
            off = self.known.off(x, len(self.active))[..., self.active]
            weight = self.weight[self.active]
            cost = cost + (weight * off**2).sum(axis=-1)
            gradient = gradient + weight * off
            gram = gram + self.prior
        return np.asarray(cost), np.asarray(gradient), gram

    def reduced(self, x: State, *, full: bool) -> tuple[State, Array, Array, Array, Array]:
        """The states with their best linear parameters; Kaufman's variant, without coupling."""
        r, normal = self.linear, self.normal(x)
        if r.any():
            move = np.zeros(normal[1].shape)
            move[:, r] = solve_normal(normal[2][:, r][:, :, r], normal[1][:, r, None])[..., 0]
            x = self.step(x, move)
            normal = self.normal(x)
        return x, *normal, np.zeros((len(normal[0]), int(r.sum()), int((~r).sum())))

    def step(self, x: State, dx: Array) -> State:
        """The states moved by a step in the active parameters."""
        whole = np.zeros((*dx.shape[:-1], self.stack.names.count))
        whole[..., self.active] = dx
        return x.step(whole)


def place_in(pose: Array) -> Array:
    """(rows,) which row of its pose each is, from 0.  pose: (rows,)."""
    order = np.argsort(pose, kind="stable")
    first = np.concatenate([[True], np.diff(pose[order]) > 0])
    start = np.maximum.accumulate(np.where(first, np.arange(len(pose)), 0))
    out = np.empty(len(pose), dtype=int)
    out[order] = np.arange(len(pose)) - start
    return out


# ---- the start ---------------------------------------------------------------------------------


def started(robot: Robot, one: Instrument, free: Array) -> Array:
    """(e,) own unknowns that fit the arm as drawn best, of several starts.  free: (e,) mask."""
    starts = np.stack(list(one.starts(Block.of(robot, one).arm.at(robot.mdh), free)))
    if not one.refines:
        return np.asarray(starts[0])
    active = np.concatenate([np.zeros(5 * robot.joints + 6, dtype=bool), free])
    few, whole = (
        Stack.of(robot, [some], [""]).stopped(robot.mdh) for some in (one.take(one.screened()), one)
    )
    x = own_state(robot.mdh, starts[0]).repeat(len(starts))
    x.effects[:] = starts
    if len(starts) > 1:
        some, points = Squares(few, active), float(few.points)
        first = least_squares.solve(some, x, len(starts), points, limits=SCREENED, trace=False)
        cost = np.where(np.isfinite(first.cost), first.cost, np.inf)
        x = first.x.take(np.array([int(cost.argmin())]))
    limits, points = Limits(damping=1e-6), float(whole.points)
    found = least_squares.solve(Squares(whole, active), x, 1, points, METHODS["snllm"], limits)
    return np.asarray(found.x.effects[0])


def own_state(mdh: Array, own: Array) -> State:
    """A state of a block, or of several.  mdh: (..., n, 5).  own: (..., e)."""
    *batch, _, _ = mdh.shape
    rotation = np.broadcast_to(np.eye(3), (*batch, 3, 3))
    return State(mdh, rotation, np.zeros((*batch, 3)), np.zeros((*batch, 0, 3)), own)
