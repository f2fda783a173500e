"""Blocks of several instruments as one least-squares problem over one arm."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import pairwise

import numpy as np

from minimax_cal.core.arrays import Array
from minimax_cal.fitting.multi_instrument.laws import NO_LAWS, InstrumentLaws
from minimax_cal.fitting.robust_fit import SQUARE_LOSS
from minimax_cal.instruments.instrument import Instrument
from minimax_cal.instruments.protocol import (
    NO_PART,
    NO_ROW_NUMBERS,
    EffectMotion,
    FlangeKinematics,
    FlangePoses,
    ResidualRows,
    flange_corners,
    slopes_by_arm_parameters,
)
from minimax_cal.modelling.effects.scene import PosedArm
from minimax_cal.modelling.parameters import BASE_PARAMETER_NAMES, ParameterNames, ParameterValues
from minimax_cal.robots.robot import Robot
from minimax_cal.solvers import least_squares
from minimax_cal.solvers.least_squares import (
    LEAST_SQUARES_METHODS,
    CostGradientGram,
    LeastSquaresLimits,
    ReducedProblem,
    solve_normal_equations,
)

SCREENING_LIMITS = LeastSquaresLimits(
    step=1e-6
)  # tells one start from another; the best is refined


@dataclass(frozen=True)
class InstrumentParameterNames(ParameterNames):
    """Parameters of an arm whose base is the frame, and so none of them, and of instruments.

    own: units of the instruments' parameters.  laws: of the last ones, those of the laws by which
    the arm gives way.
    """

    own: tuple[str, ...] = ()
    laws: tuple[str, ...] = ()

    @cached_property
    def all_names(self) -> tuple[str, ...]:
        """Every name, in order; the base's are empty."""
        links = ParameterNames(self.joints, (), (), self.rows).all_names[: 5 * self.joints]
        return (*links, *[""] * len(BASE_PARAMETER_NAMES), *self.effects)

    @cached_property
    def units(self) -> tuple[str, ...]:
        """(p,) SI."""
        links = ("m" if length else "rad" for length in self.linear_mask[: self.geometric_count])
        return (*links, *self.own, *self.laws)


@dataclass(frozen=True, eq=False)
class InstrumentBlock:
    """An instrument, and the arm at its poses.

    A state of it has the links and, as effects, the e parameters of the instrument's own and those
    of the laws by which its arm gives way; its p parameters are in the order of `ParameterNames`:
    links, the base (which is the frame), its own, the laws'.  share: (rows,) weights by a robust
    loss, empty where all rows weigh alike.
    """

    instrument: Instrument
    arm: FlangeKinematics
    share: Array = field(default_factory=lambda: NO_ROW_NUMBERS)

    @staticmethod
    def without_effects(robot: Robot, one: Instrument) -> InstrumentBlock:
        """With a stiff arm."""
        return InstrumentBlock(one, FlangeKinematics.from_robot(robot, one.at.q))

    def own_values(self, x: ParameterValues) -> Array:
        """(e,) of the instrument."""
        return x.effects[: len(self.instrument.names)]

    def flange(self, x: ParameterValues, active: Array | None = None) -> FlangePoses:
        """The flange at a state.  active: (5n + d,) as `FlangeKinematics.flange_and_own_values` has
        it.
        """
        return self.arm.compute_flange_poses(x.mdh, x.effects[len(self.instrument.names) :], active)

    def flange_and_own_values(self, x: ParameterValues) -> tuple[FlangePoses, Array]:
        """The flange, and what is of the instrument."""
        return self.flange(x), self.own_values(x)

    def read_residual_rows(self, x: ParameterValues) -> ResidualRows:
        """What the instrument says at a state."""
        return self.instrument.read(*self.flange_and_own_values(x))

    def centre_of_targets(self, x: ParameterValues) -> Array:
        """(3,) amid the instrument's points on the flange, about which laws are asked [m]."""
        return np.asarray(self.instrument.flange_points(self.own_values(x)).mean(axis=0))

    def rows(
        self, x: ParameterValues, active: Array, *, loose: bool = False
    ) -> tuple[Array, Array]:
        """Measured minus predicted (..., rows) [m], derivative of the latter (..., active, rows).

        active: (p,).  loose: as `ResidualRows.eliminate_places_and_add_sums`.
        """
        if x.mdh.ndim > 2:
            found = [self.rows(x.take(np.array(i)), active) for i in range(len(x.mdh))]
            return np.stack([error for error, _ in found]), np.stack([slope for _, slope in found])
        n, e = 5 * len(x.mdh), len(self.instrument.names)
        links, _, own, laws = np.split(active, [n, n + 6, n + 6 + e])
        flange = self.flange(x, np.concatenate([links, laws]))
        rows = self.instrument.read(flange, self.own_values(x))
        by, count = slopes_by_arm_parameters(flange, rows), int(links.sum())
        slopes = np.concatenate([by[:count], rows.by_own.T[own], by[count:]])
        return rows.eliminate_places_and_add_sums(slopes, keep_slopes=loose, row_weights=self.share)

    def part_indices(self, rows: ResidualRows) -> Array:
        """(r,) which of the instrument's parts each row is of; corners of one pose are none."""
        several = len(rows.part) and len(self.instrument.part_names) > 1
        return rows.part if several else np.zeros(len(rows.pose), dtype=int)

    @property
    def weight(self) -> Array:
        """(rows,) by the loss, or a single one."""
        return self.share if len(self.share) else np.ones(1)

    def with_row_weights(self, share: Array) -> InstrumentBlock:
        """The same with weights (rows,) of the rows."""
        return replace(self, instrument=self.instrument.with_row_weights(share), share=share)

    def build_arm_state(self, robot: Robot, x: ParameterValues, spots: Array) -> PosedArm:
        """What laws look at, with the geometry of a state.  spots: (k, 3) on the flange [m]."""
        one = self.instrument
        return PosedArm.at_measured_poses(
            robot.with_mdh(x.mdh),
            one.measurements_with_points,
            one.base_rotation_and_origin(self.own_values(x)),
            spots,
            self.arm.q,
        )

    def with_measurements(
        self, robot: Robot, one: Instrument, laws: InstrumentLaws, x: ParameterValues
    ) -> InstrumentBlock:
        """The same at other measurements of the instrument, the laws linear at a state."""
        block = InstrumentBlock.without_effects(robot, self.instrument.copy_choices_to(one))
        return block.with_laws(robot, laws, x)

    def with_laws(self, robot: Robot, laws: InstrumentLaws, x: ParameterValues) -> InstrumentBlock:
        """The same looking at an arm that gives way, linear at a state with the laws' values."""
        if not laws.terms:
            return self
        middle, values = self.centre_of_targets(x), x.effects[len(self.instrument.names) :]
        scene = self.build_arm_state(robot, x, flange_corners(middle))
        given = EffectMotion.from_corner_motions(
            self.arm.compute_flange_poses(x.mdh),
            middle,
            *laws.displacement_fields(scene, values),
            values,
        )
        return replace(self, arm=replace(self.arm, given=given))


@dataclass(frozen=True, eq=False)
class InstrumentStack:
    """Instruments that share an arm.

    labels: of each; the names of a lone one's parameters go without.  precision: of each block's
    rows, relative to any.  names: all p parameters, behind the arm's those of the instruments, and
    last those of the laws.  given: (b,) variance of a row that is given, NaN where residuals say it
    [m^2].  laws: by which the arm gives way.
    """

    blocks: tuple[InstrumentBlock, ...]
    labels: tuple[str, ...]
    names: InstrumentParameterNames
    precision: Array
    given: Array
    laws: InstrumentLaws = NO_LAWS

    @staticmethod
    def from_instruments(
        robot: Robot, every: Sequence[Instrument], labels: Sequence[str]
    ) -> InstrumentStack:
        """Instruments that weigh alike."""
        stems = [f"{label}." if len(every) > 1 else "" for label in labels]
        own = [stem + name for stem, one in zip(stems, every, strict=True) for name in one.names]
        units = tuple(unit for one in every for unit in one.units)
        names = InstrumentParameterNames(
            robot.joints, (), tuple(own), robot.notation.parameter_names(robot.joints), units
        )
        blocks, count = (
            tuple(InstrumentBlock.without_effects(robot, one) for one in every),
            len(every),
        )
        return InstrumentStack(blocks, tuple(labels), names, np.ones(count), np.full(count, np.nan))

    def with_fixed_links(self, mdh: Array) -> InstrumentStack:
        """The same with links (n, 5) that stay."""
        still = (replace(block, arm=block.arm.with_fixed_links(mdh)) for block in self.blocks)
        return replace(self, blocks=tuple(still))

    @property
    def instruments(self) -> tuple[Instrument, ...]:
        """Of the blocks."""
        return tuple(block.instrument for block in self.blocks)

    @property
    def points(self) -> int:
        """Number of compared points."""
        return sum(one.point_count for one in self.instruments)

    @cached_property
    def movable(self) -> Array:
        """(p,) False for the base, which is the frame."""
        place, first = np.arange(self.names.parameter_count), 5 * self.names.joints
        return np.asarray((place < first) | (place >= self.names.geometric_count))

    @cached_property
    def own_slices(self) -> tuple[slice, ...]:
        """Where the parameters of each block stand among the instruments' own."""
        ends = np.cumsum([0, *(len(one.names) for one in self.instruments)]).tolist()
        return tuple(slice(*pair) for pair in pairwise(ends))

    @property
    def parameter_count_without_laws(self) -> int:
        """Number of parameters before those of the laws."""
        return self.names.parameter_count - len(self.laws.names)

    def own_columns(self, i: int) -> Array:
        """Where the parameters of a block's own stand among all."""
        return np.arange(self.names.geometric_count, self.names.parameter_count)[self.own_slices[i]]

    def block_columns(self, i: int) -> Array:
        """Where the parameters that a block's rows depend on stand among all."""
        every = np.arange(self.names.parameter_count)
        return np.concatenate(
            [
                every[: self.names.geometric_count],
                self.own_columns(i),
                every[self.parameter_count_without_laws :],
            ]
        )

    def state(self, mdh: Array, own: Sequence[Array]) -> ParameterValues:
        """A state of all blocks, of an arm that does not give way."""
        return build_own_state(mdh, np.concatenate([*own, np.zeros(len(self.laws.names))]))

    def state_of_block(self, x: ParameterValues, i: int) -> ParameterValues:
        """The state of a block."""
        first = self.names.geometric_count
        return replace(x, effects=x.effects[..., self.block_columns(i)[first:] - first])

    def blocks_with_states(
        self, x: ParameterValues
    ) -> list[tuple[InstrumentBlock, ParameterValues]]:
        """The blocks, each with its state."""
        return [(block, self.state_of_block(x, i)) for i, block in enumerate(self.blocks)]

    def law_values(self, x: ParameterValues) -> Array:
        """(k,) of the laws."""
        return x.effects[..., self.parameter_count_without_laws - self.names.geometric_count :]

    def state_for_display(self, x: ParameterValues) -> ParameterValues:
        """A state as people are told it."""
        own = [
            block.instrument.unknowns_for_report(block.own_values(at))
            for block, at in self.blocks_with_states(x)
        ]
        return replace(x, effects=np.concatenate([*own, self.law_values(x)]))

    def arm_states(self, robot: Robot, x: ParameterValues) -> list[PosedArm]:
        """What laws look at, block by block, with the geometry of a state and the targets."""
        return [
            block.build_arm_state(robot, at, block.instrument.flange_points(block.own_values(at)))
            for block, at in self.blocks_with_states(x)
        ]

    def with_laws(
        self, robot: Robot, laws: InstrumentLaws, x: ParameterValues
    ) -> tuple[InstrumentStack, ParameterValues]:
        """The same instruments looking at an arm that gives way, linear at a state; that state.

        Laws that the stack did not have yet have the value 0.
        """
        values = self.law_values(x) if self.laws.names else np.zeros(len(laws.names))
        stiff = self.names.effects[: self.parameter_count_without_laws - self.names.geometric_count]
        names = replace(self.names, effects=(*stiff, *laws.names), laws=laws.units)
        x = replace(x, effects=np.concatenate([x.effects[: len(stiff)], values]))
        stack = replace(self, names=names, laws=laws)
        blocks = tuple(
            block.with_laws(robot, laws, at) for block, at in stack.blocks_with_states(x)
        )
        return replace(stack, blocks=blocks), x

    def rows_by_block(self, x: ParameterValues, active: Array) -> Iterator[tuple[Array, Array]]:
        """Of each block: measured minus predicted (..., rows), as heavy as those of any other.

        And the derivative of the predicted (..., active, rows).  active: (p,).
        """
        place = np.cumsum(active) - 1
        for i, block in enumerate(self.blocks):
            columns = self.block_columns(i)
            mine = active[columns] & self.movable[: len(columns)]
            error, jacobian = block.rows(self.state_of_block(x, i), mine)
            whole = np.zeros((*error.shape[:-1], int(active.sum()), error.shape[-1]))
            whole[..., place[columns[mine]], :] = jacobian
            yield error, whole

    def rows(self, x: ParameterValues, active: Array) -> tuple[Array, Array]:
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
    def part_names(self) -> tuple[str, ...]:
        """Every part by name, as wire1; of several files with what the file is called."""
        several = len(self.blocks) > 1
        return tuple(
            f"{label} {part}" if several else part
            for label, one in zip(self.labels, self.instruments, strict=True)
            for part in one.part_names
        )

    def part_indices(self, x: ParameterValues) -> Array:
        """(rows,) which of all parts each is of, block by block; -2 of rows that are of several."""
        out, first = [], 0
        for block, at in self.blocks_with_states(x):
            rows, count = block.read_residual_rows(at), len(block.instrument.part_names)
            part = block.part_indices(rows)
            part = np.where(part == NO_PART, -2, first + part)
            out += [part, np.full(len(rows.short), -2)]
            first += count
        return np.concatenate(out)

    def row_variances(self, left: Array) -> Array:
        """(b,) of a row of each block, as given or as a fit leaves [m^2]."""
        return np.where(np.isnan(self.given), left, self.given)

    def row_weights(self, x: ParameterValues) -> Array:
        """(rows,) how much more each weighs than its noise says."""
        return np.concatenate(
            [block.read_residual_rows(at).row_weights for block, at in self.blocks_with_states(x)]
        )

    def gram_matrix(self, x: ParameterValues) -> Array:
        """The Gram matrix of all parameters at a state: (p, p)."""
        _, jacobian = self.rows(x, np.ones(self.names.parameter_count, dtype=bool))
        return np.asarray(jacobian @ jacobian.T)

    def at_reference_poses(self, robot: Robot, x: ParameterValues) -> InstrumentStack:
        """Every instrument at plenty of poses, alike in weight."""
        found = [
            InstrumentBlock.without_effects(
                robot, block.instrument.at_random_poses(robot, block.own_values(at))
            )
            for block, at in self.blocks_with_states(x)
        ]
        return replace(self, blocks=tuple(found), precision=np.ones(len(found)))

    def at_nominal_measurements(self, robot: Robot, x: ParameterValues) -> InstrumentStack:
        """Every instrument where the arm as drawn itself fits it."""
        found = []
        for block, at in self.blocks_with_states(x):
            one = block.instrument.at_exactly_fitting_poses(robot, block.own_values(at))
            found.append(
                InstrumentBlock(one, replace(block.arm, q=robot.chain_joint_values(one.at.q)))
            )
        return replace(self, blocks=tuple(found))


@dataclass(frozen=True, eq=False)
class LinkPriors:
    """What is known of the links before any measurement.

    mean: (5 n,) as drawn.  sigma: (5 n,) how far they may be from there, infinite where nothing is
    known [SI].  laws: (k,) the same of the laws' parameters, whose mean is 0.
    """

    mean: Array
    sigma: Array
    laws: Array = field(default_factory=lambda: np.zeros(0))

    @property
    def has_any(self) -> bool:
        """Whether anything is known."""
        return bool(np.isfinite(self.sigma).any() or np.isfinite(self.laws).any())

    def has_prior(self, count: int) -> Array:
        """(count,) True for parameters of which something is known."""
        return self.weights(1.0, count) > 0.0

    def weights(self, variance: float, count: int) -> Array:
        """(count,) weights of all parameters beside rows of a variance [m^2 per unit^2]."""
        links = np.pad(variance / self.sigma**2, (0, count - len(self.sigma)))
        return links + np.pad(variance / self.laws**2, (count - len(self.laws), 0))

    def deviation_from_mean(self, x: ParameterValues, count: int) -> Array:
        """(..., count) how far the parameters are from their mean, 0 where they have none."""
        links = np.swapaxes(x.mdh, -1, -2)  # in the order of `parameters.flatten_link_parameters`
        links = links.reshape(*links.shape[:-2], -1)
        out = np.zeros((*links.shape[:-1], count))
        out[..., : len(self.mean)] = self.mean - links[..., : len(self.mean)]
        out[..., count - len(self.laws) :] = -x.effects[..., x.effects.shape[-1] - len(self.laws) :]
        return out


NO_PRIOR_KNOWLEDGE = LinkPriors(np.zeros(0), np.zeros(0))


@dataclass(frozen=True, eq=False)
class InstrumentLeastSquares:
    """The sum of squared rows over the active parameters, for `solvers.least_squares`.

    known: of the links and the laws, which counts with the
    weights (p,) where these are given.  room: (k, 2) between which the laws' parameters must lie.
    loss: by which the rows have weights, at a scale (b,): sigma of a row of each block [m].
    """

    stack: InstrumentStack
    active: Array
    known: LinkPriors = NO_PRIOR_KNOWLEDGE
    weight: Array = field(default_factory=lambda: np.zeros(0))
    room: Array = field(default_factory=lambda: np.zeros((0, 2)))
    loss: str = SQUARE_LOSS
    scale: Array = field(default_factory=lambda: np.zeros(0))

    @property
    def names(self) -> ParameterNames:
        """Of all parameters."""
        return self.stack.names

    @property
    def effect_bounds(self) -> Array:
        """(e, 2) between which all that stands as effects in a state must lie."""
        open_ends = np.full(
            (self.stack.parameter_count_without_laws - self.names.geometric_count, 2), np.inf
        )
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

    def with_variances(self, variance: Array) -> InstrumentLeastSquares:
        """Instruments and priors weighed by the variances (b,) of their numbers [m^2].

        The best instrument weighs 1, so that a step of the rows is one of metres.
        """
        unit = float(variance.min())
        weight = self.known.weights(unit, self.names.parameter_count)
        return replace(self, stack=replace(self.stack, precision=unit / variance), weight=weight)

    def normal(self, x: ParameterValues) -> CostGradientGram:
        """Cost (...), gradient (..., free) and Gram matrix (..., free, free)."""
        error, jacobian = self.stack.rows(x, self.active)
        cost = np.einsum("...r,...r->...", error, error)
        gradient = (jacobian @ error[..., None])[..., 0]
        gram = jacobian @ np.swapaxes(jacobian, -1, -2)
        if len(self.weight):
            off = self.known.deviation_from_mean(x, len(self.active))[..., self.active]
            weight = self.weight[self.active]
            cost = cost + (weight * off**2).sum(axis=-1)
            gradient = gradient + weight * off
            gram = gram + self.prior
        return CostGradientGram(np.asarray(cost), np.asarray(gradient), gram)

    def reduced(self, x: ParameterValues, *, full: bool) -> ReducedProblem[ParameterValues]:
        """The states with their best linear parameters; Kaufman's variant, without coupling."""
        r, normal = self.linear, self.normal(x)
        if r.any():
            move = np.zeros(normal.gradient.shape)
            move[:, r] = solve_normal_equations(
                normal.gram[:, r][:, :, r], normal.gradient[:, r, None]
            )[..., 0]
            x = self.step(x, move)
            normal = self.normal(x)
        coupling = np.zeros((len(normal.cost), int(r.sum()), int((~r).sum())))
        return ReducedProblem(x, *normal, coupling)

    def step(self, x: ParameterValues, dx: Array) -> ParameterValues:
        """The states moved by a step in the active parameters."""
        whole = np.zeros((*dx.shape[:-1], self.stack.names.parameter_count))
        whole[..., self.active] = dx
        return x.step(whole)


def row_index_in_pose(pose_indices: Array) -> Array:
    """(rows,) which row of its pose each is, from 0.  pose_indices: (rows,)."""
    order = np.argsort(pose_indices, kind="stable")
    first = np.concatenate([[True], np.diff(pose_indices[order]) > 0])
    start = np.maximum.accumulate(np.where(first, np.arange(len(pose_indices)), 0))
    out = np.empty(len(pose_indices), dtype=int)
    out[order] = np.arange(len(pose_indices)) - start
    return out


# ---- the start ---------------------------------------------------------------------------------


def start_own_values(robot: Robot, instrument: Instrument, is_free: Array) -> Array:
    """(e,) own unknowns that fit the arm as drawn best, of several starts.  is_free: (e,) mask."""
    starts = np.stack(
        list(
            instrument.starts(
                InstrumentBlock.without_effects(robot, instrument).arm.compute_flange_poses(
                    robot.mdh
                ),
                is_free,
            )
        )
    )
    if not instrument.refines:
        return np.asarray(starts[0])
    active = np.concatenate([np.zeros(5 * robot.joints + 6, dtype=bool), is_free])
    few, whole = (
        InstrumentStack.from_instruments(robot, [some], [""]).with_fixed_links(robot.mdh)
        for some in (instrument.take_rows(instrument.rows_for_screening()), instrument)
    )
    x = build_own_state(robot.mdh, starts[0]).repeat(len(starts))
    x.effects[:] = starts
    if len(starts) > 1:
        some, points = InstrumentLeastSquares(few, active), float(few.points)
        first = least_squares.solve(
            some, x, len(starts), points, limits=SCREENING_LIMITS, keep_trace=False
        )
        cost = np.where(np.isfinite(first.cost), first.cost, np.inf)
        x = first.x.take(np.array([int(cost.argmin())]))
    limits, points = LeastSquaresLimits(damping=1e-6), float(whole.points)
    found = least_squares.solve(
        InstrumentLeastSquares(whole, active), x, 1, points, LEAST_SQUARES_METHODS["snllm"], limits
    )
    return np.asarray(found.x.effects[0])


def build_own_state(mdh: Array, own_values: Array) -> ParameterValues:
    """A state of a block, or of several.  mdh: (..., n, 5).  own_values: (..., e)."""
    *batch, _, _ = mdh.shape
    rotation = np.broadcast_to(np.eye(3), (*batch, 3, 3))
    return ParameterValues(
        mdh, rotation, np.zeros((*batch, 3)), np.zeros((*batch, 0, 3)), own_values
    )
