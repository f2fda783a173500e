"""What every instrument brings to the fit: rows of residuals, their derivatives, parameters.

The robot's base is the frame.  What an instrument adds to the unknowns (its frame, anchors,
targets, surfaces) stands in the state where effects stand elsewhere.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, Protocol, Self, TypeVar, cast

import numpy as np

from minimax_cal.fitting.found import Parameter
from minimax_cal.ground.arrays import Array
from minimax_cal.measuring.measurements import Measurements
from minimax_cal.modelling.model import TARGET, Model, arm_at
from minimax_cal.modelling.model import Block as Poses
from minimax_cal.modelling.parameters import State
from minimax_cal.robots import kinematics
from minimax_cal.robots.robot import Robot

SPOT = tuple(f"{TARGET}_{axis}" for axis in "xyz")  # the point on the flange, or the ball
LINEAR_RANK = 1e-6  # relative singular value below which a linear start says nothing


class Block(Protocol):
    """An instrument's measurements as a part of the least-squares problem.

    A state of a block has the links and, as effects, the e parameters of the block's own and those
    of the laws by which its arm gives way; its p parameters are in the order of `Names`: links, the
    base (which is the frame), its own, the laws'.  Its model's `names.geometric`
    counts links, base and target.
    """

    @property
    def kind(self) -> str:
        """Name of the instrument."""

    @property
    def model(self) -> Model:
        """The arm at the poses, with the block's own points on the flange and the laws' fields."""

    @property
    def own(self) -> tuple[str, ...]:
        """(e,) names of its own parameters."""

    @property
    def given_up(self) -> tuple[str, ...]:
        """Those of them that redundancy takes first."""

    @property
    def held(self) -> tuple[str, ...]:
        """Those of them that are not fitted, as their values are given."""

    @property
    def spots(self) -> slice:
        """Where the model's targets stand among its own."""

    @property
    def numbers(self) -> int:
        """Independent numbers, and as many more as parameters that cost none."""

    @property
    def points(self) -> int:
        """Number of compared points, which turns a sum of squares into a mean motion."""

    @property
    def row_noise(self) -> float:
        """Sigma of a row over that of a number."""

    @property
    def weights(self) -> Array:
        """(rows,) one each; more where a row weighs more than its noise says."""

    @property
    def costless(self) -> int:
        """Parameters that cost no number, which stand among the numbers."""

    @property
    def given(self) -> int:
        """Numbers that are given besides those of the data."""

    @property
    def choices(self) -> Mapping[str, object]:
        """What it has chosen where the user has not, for the record."""

    @property
    def has_length(self) -> bool:
        """Whether something that it measures is a length."""

    @property
    def whole(self) -> str:
        """What several of its places are together, for reasons."""

    @property
    def parts(self) -> tuple[str, ...]:
        """What each row of `errors` is."""

    def rows(self, x: State, active: Array) -> tuple[Array, Array]:
        """Measured minus predicted (..., rows) [m], derivative of the latter (..., active, rows).

        active: (p,).
        """

    @property
    def pose_of_row(self) -> Array:
        """(rows,) the pose at which each was measured."""

    def by_pose(self) -> Self:
        """The block with rows that move with their own pose alone, but for what is eliminated."""

    def places_of_rows(self) -> Array:
        """(q, rows) how the rows of `by_pose` move with each number that `rows` eliminates."""

    def shapeless(self, x: State) -> Array:
        """(m, r, r) projector, pose by pose, on sums of its rows that hold no number."""

    def beside(self, others: Sequence[Block]) -> Self:
        """The instrument in one fit with all of some others."""

    def size(self, x: State) -> float:
        """By what a mean square is to be seen where an arm that hardly moves fits anything."""

    def start(self, robot: Robot, free: Array) -> Array:
        """(e,) that fit the arm as drawn best.  free: (e,) True where one may be fitted."""

    def reference(self, robot: Robot, x: State) -> Self:
        """The instrument at plenty of poses that it could measure, of the arm at a state."""

    def closed(self, robot: Robot, x: State) -> Self:
        """The instrument at poses near its own where the arm at a state itself fits it."""

    def arm_state(self, x: State) -> State:
        """The state of its model."""

    def mean_square(self, x: State) -> float:
        """Of the misses, as `errors` has them [m^2]."""

    def seen_at(self, data: Any) -> Measurements:
        """Where the poses of data stand, with the points that the model compares."""

    def model_at(self, robot: Robot, data: Any) -> Model:
        """The stiff arm as `model` has it, at all rows of the data."""

    def errors(self, model: Model, x: State, data: Any, held: Array) -> Array:
        """Of all rows of the data: (parts, m, 3), NaN where not measured [m]; numbers first.

        model: the arm at these rows.
        """

    def turns(self, model: Model, x: State, data: Any) -> Array:
        """(m,) errors of orientation [rad], empty where none is measured."""

    def listed(
        self, fitted: tuple[Parameter, ...], nominal: State, x: State, covariance: Array
    ) -> tuple[Parameter, ...]:
        """Its own parameters as people read them.  covariance: (e, e) of its own."""

    def placed(self, x: State, nominal: State) -> dict[str, Any]:
        """For JSON: what was fitted besides the robot."""


class Plain:
    """Of `Block`, what most instruments have: rows of one noise, nothing given, no orientations."""

    row_noise = 1.0
    whole = ""

    @property
    def given_up(self) -> tuple[str, ...]:
        """None."""
        return ()

    @property
    def held(self) -> tuple[str, ...]:
        """None."""
        return ()

    @property
    def costless(self) -> int:
        """None."""
        return 0

    @property
    def given(self) -> int:
        """None."""
        return 0

    @property
    def numbers(self: Block) -> int:
        """One a point."""
        return self.points

    @property
    def weights(self: Block) -> Array:
        """(rows,) one each."""
        return np.ones(self.points)

    @property
    def choices(self) -> Mapping[str, object]:
        """None."""
        return {}

    def beside(self, others: Sequence[Block]) -> Self:
        """The same."""
        return self

    def size(self, x: State) -> float:
        """As it is."""
        return 1.0

    def turns(self, model: Model, x: State, data: Any) -> Array:
        """None."""
        return np.zeros(0)

    def by_pose(self) -> Self:
        """As it is."""
        return self

    def places_of_rows(self: Block) -> Array:
        """Nothing is eliminated."""
        return np.zeros((0, len(self.weights)))

    def shapeless(self: Block, x: State) -> Array:
        """Every row holds a number."""
        return np.zeros((len(self.model.q), 0, 0))

    def seen_at(self, data: Any) -> Measurements:
        """As they are."""
        at: Measurements = data.at
        return at

    def listed(
        self: Block, fitted: tuple[Parameter, ...], nominal: State, x: State, covariance: Array
    ) -> tuple[Parameter, ...]:
        """Those that are not given."""
        held = self.held
        own = zip(fitted, self.own, strict=True)
        return tuple(parameter for parameter, name in own if name not in held)


class OnFlange(Plain):
    """Of `Block`, what instruments have whose one target comes first among their own."""

    spots = slice(0, 3)

    def arm_state(self: Block, x: State) -> State:
        """The state of its model."""
        return with_spot(self.model, x)

    def model_at(self, robot: Robot, data: Any) -> Model:
        """With the one target."""
        return arm_at(robot, data.at.q)

    def spread(self: Block, x: State) -> float:
        """Variance of the target's places, three axes together [m^2]."""
        return max(float(places(self.model, x).var(axis=-1).sum()), 1e-12)


Some = TypeVar("Some", bound=Block)


def through(block: Some, model: Model) -> Some:
    """The block with another arm at its poses.  Of an instrument that has its arm as a field."""
    return cast(Some, replace(cast(Any, block), model=model))


def own_state(mdh: Array, own: Array) -> State:
    """A state of a block, or of several.  mdh: (..., n, 5).  own: (..., e)."""
    *batch, _, _ = mdh.shape
    rotation = np.broadcast_to(np.eye(3), (*batch, 3, 3))
    return State(mdh, rotation, np.zeros((*batch, 3)), np.zeros((*batch, 0, 3)), own)


def of_laws(model: Model, x: State) -> Array:
    """(..., k) values of the laws by which a model gives way, which are last in a block's state."""
    return x.effects[..., x.effects.shape[-1] - len(model.fields) :]


def with_spot(model: Model, x: State) -> State:
    """The state of the arm with the target that is first among a block's own."""
    return State(x.mdh, x.rotation, x.origin, x.effects[..., None, :3], of_laws(model, x))


def places(model: Model, x: State) -> Array:
    """The point on the flange in the base: (..., 3, m) [m]."""
    links, state = kinematics.chain(x.mdh, model.q, model.prismatic), with_spot(model, x)
    point = kinematics.points(links, state.target_positions)
    return np.asarray(model.displaced(state, point, slice(None))[..., 0, :, :])


def motion(model: Model, x: State, active: Array) -> tuple[Array, Array]:
    """`places`, and their derivative by the active parameters of a block: (..., active, 3, m).

    active: (p,).  What is neither of the arm nor its target moves nothing.
    """
    links = kinematics.chain(x.mdh, model.q, model.prismatic)
    poses = Poses(slice(0, len(model.q)), links)
    moving = np.zeros(len(active), dtype=bool)
    moving[: model.names.geometric] = moving[len(active) - len(model.fields) :] = True
    error, turned = model.weighted_rows(with_spot(model, x), poses, active[moving])
    slope = np.zeros((*turned.shape[:-4], int(active.sum()), *turned.shape[-2:]))
    slope[..., moving[active], :, :] = turned[..., 0, :, :, :]
    return -error[..., 0, :, :], slope


def scaled_lstsq(matrix: Array, right: Array) -> Array:
    """Least squares with columns scaled to one; the least solution where poses do not tell."""
    norm = np.linalg.norm(matrix, axis=0)
    norm = np.where(norm > 0.0, norm, 1.0)
    return np.asarray(np.linalg.lstsq(matrix / norm, right, rcond=LINEAR_RANK)[0] / norm)
