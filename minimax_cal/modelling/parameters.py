"""Which numbers describe a calibrated cell: names, kinds, units, and how a step changes them.

The order is fixed: all a, all d, all theta, all alpha, all beta, the base frame's translation and
rotation, then the targets.  Base steps are taken in the base's own axes, so that nothing depends on
where the measuring instrument stands.
"""

from __future__ import annotations

import difflib
from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from fnmatch import fnmatchcase
from functools import cached_property

import numpy as np

from minimax_cal.core.arrays import Array
from minimax_cal.core.errors import OptionError
from minimax_cal.robots import kinematics
from minimax_cal.robots.kinematics import MDH_NAMES
from minimax_cal.robots.robot import Robot
from minimax_cal.robots.transforms import build_transform

BASE_PARAMETER_NAMES = ("base_x", "base_y", "base_z", "base_rx", "base_ry", "base_rz")


@dataclass(frozen=True, eq=False)
class ParameterValues:
    """A geometry, the base in the measurement frame, and the targets; ``...`` is a batch.

    mdh: (..., n, 5) [m, rad].  rotation: (..., 3, 3), origin: (..., 3) [m], pose of the base.
    target_positions: (..., k, 3) in the last frame [m].
    effects: (..., e) parameters of effects beyond geometry, in their own units; (0,) without any.
    """

    mdh: Array
    rotation: Array
    origin: Array
    target_positions: Array
    effects: Array = field(default_factory=lambda: np.zeros(0))

    def step(self, dx: Array) -> ParameterValues:
        """The state moved by dx (..., p), all parameters in the order of `ParameterNames`."""
        n, k = self.mdh.shape[-2], self.target_positions.shape[-2]
        batch = dx.shape[:-1]
        links = np.swapaxes(dx[..., : 5 * n].reshape(*batch, 5, n), -1, -2)
        move, turn, shift, more = np.split(dx[..., 5 * n :], (3, 6, 6 + 3 * k), axis=-1)
        return ParameterValues(
            mdh=self.mdh + links,
            rotation=self.rotation @ kinematics.rotation_from_vector(turn),
            origin=self.origin + (self.rotation @ move[..., None])[..., 0],
            target_positions=self.target_positions + shift.reshape(*batch, k, 3),
            effects=self.effects + more,
        )

    @property
    def base_pose(self) -> Array:
        """(4, 4) pose of the base in the measurement frame, of a single state."""
        return build_transform(self.rotation, self.origin)

    def values_in_file_convention(self, base_axes: Array, robot: Robot) -> Array:
        """(p,) all parameters of a single state as people are told them, in the order of
        `ParameterNames`.

        base_axes: (3, 3) a rotation, along and from which the base's origin and turn are told.
        robot: in whose file's convention links are told.
        """
        links = robot.notation.values_in_file_convention(self.mdh, robot.prismatic)
        turn = kinematics.rotation_to_vector(base_axes.T @ self.rotation)
        base = (base_axes.T @ self.origin, turn)
        return np.concatenate(
            [flatten_link_parameters(links), *base, self.target_positions.reshape(-1), self.effects]
        )

    @property
    def geometry_arrays(self) -> tuple[Array, Array, Array, Array]:
        """All but the effects, in the order of the fields."""
        return self.mdh, self.rotation, self.origin, self.target_positions

    def take(self, rows: Array) -> ParameterValues:
        """Some members of a batch."""
        some = self.effects[rows] if self.effects.ndim > 1 else self.effects
        return replace(
            ParameterValues(*(part[rows] for part in self.geometry_arrays)), effects=some
        )

    def put(self, rows: Array, other: ParameterValues) -> ParameterValues:
        """The batch with some members replaced."""
        out = replace(
            ParameterValues(*map(np.copy, self.geometry_arrays)), effects=self.effects.copy()
        )
        for mine, new in zip(out.geometry_arrays, other.geometry_arrays, strict=True):
            mine[rows] = new
        if self.effects.ndim > 1:
            out.effects[rows] = other.effects
        return out

    def batch(self) -> ParameterValues:
        """A single state as a batch of one."""
        return replace(
            ParameterValues(*(part[None] for part in self.geometry_arrays)),
            effects=self.effects[None],
        )

    def repeat(self, count: int) -> ParameterValues:
        """A single state, count times."""
        return self.batch().take(np.zeros(count, dtype=int))


@dataclass(frozen=True)
class ParameterNames:
    """The parameters of an arm with n joints seen through some targets, and of its effects.

    rows: names of the link parameters as the robot's file has them; empty for a1 ... beta_n.
    """

    joints: int
    target_names: tuple[str, ...]
    effects: tuple[str, ...] = ()
    rows: tuple[str, ...] = ()

    @staticmethod
    def for_robot(
        robot: Robot, target_names: tuple[str, ...], effect_names: tuple[str, ...] = ()
    ) -> ParameterNames:
        """Of a robot, in the convention of its file."""
        rows = robot.notation.parameter_names(robot.joints)
        return ParameterNames(robot.joints, target_names, effect_names, rows)

    @cached_property
    def all_names(self) -> tuple[str, ...]:
        """Every name, in order: a1 ... beta_n, base_x ... base_rz, smr1_x ..., effects."""
        links = self.rows or [f"{kind}{i + 1}" for kind in MDH_NAMES for i in range(self.joints)]
        spots = [f"{target}_{axis}" for target in self.target_names for axis in "xyz"]
        return (*links, *BASE_PARAMETER_NAMES, *spots, *self.effects)

    @property
    def parameter_count(self) -> int:
        """Number of parameters."""
        return self.geometric_count + len(self.effects)

    @property
    def geometric_count(self) -> int:
        """Number of parameters that are not of effects; those come first."""
        return 5 * self.joints + 6 + 3 * len(self.target_names)

    @property
    def linear_mask(self) -> Array:
        """(p,) True for lengths and effects: positions are affine in them [paper S, eq. 11]."""
        n = self.joints
        mask = np.ones(self.parameter_count, dtype=bool)
        mask[2 * n : 5 * n] = False
        mask[5 * n + 3 : 5 * n + 6] = False
        return mask

    @property
    def link_mask(self) -> Array:
        """(p,) True for the robot's own parameters, False for base and targets."""
        return np.arange(self.parameter_count) < 5 * self.joints

    def index_of_name(self, name: str) -> int:
        """Place of a name."""
        return self.all_names.index(name)

    @cached_property
    def units(self) -> tuple[str, ...]:
        """(p,) SI; effects count as lengths."""
        return tuple("m" if length else "rad" for length in self.linear_mask)

    @property
    def joint_by_joint_order(self) -> Array:
        """(p,) the order in which people read them: joint after joint, then the rest."""
        links = np.arange(5 * self.joints).reshape(5, -1).T.reshape(-1)
        return np.concatenate([links, np.arange(5 * self.joints, self.parameter_count)])

    def match_patterns(self, patterns: Iterable[str], option_name: str) -> Array:
        """(p,) True where the name of a link parameter matches.  Raises OptionError.

        ``a*`` is every a (not alpha), ``*2`` all of joint 2, ``*`` every link parameter.
        """
        names, chosen = self.all_names, np.zeros(self.parameter_count, dtype=bool)
        kinds = np.array([name.rstrip("0123456789") for name in names])
        for pattern in patterns:
            hits = np.array([fnmatchcase(name, pattern) for name in names])
            if pattern.endswith("*") and pattern[:-1] in MDH_NAMES:
                hits = kinds == pattern[:-1]
            if "*" in pattern:
                hits &= self.link_mask
            if (hits & ~self.link_mask).any():
                raise OptionError(
                    f"{option_name} {pattern}: base and targets have no nominal value to keep"
                )
            if not hits.any():
                close = difflib.get_close_matches(pattern, names, 1)
                hint = f"did you mean {close[0]}?" if close else "try a1, theta2, beta*, base_z"
                raise OptionError(f"{option_name}: no parameter called {pattern!r}; {hint}")
            chosen |= hits
        return chosen


def joint_zero_indices(prismatic: Array) -> Array:
    """(n,) which parameters say where each joint's zero is: theta, or d where it slides."""
    n = len(prismatic)
    return np.arange(n) + np.where(prismatic, n, 2 * n)


def flatten_link_parameters(mdh: Array) -> Array:
    """Link parameters of an MDH table in the order of `ParameterNames`: (5n,)."""
    return np.asarray(mdh.T.reshape(-1))
