"""Offsets of neighbouring axes that are drawn coaxial.

Such an offset has two coordinates, a and theta describe it in polar form, and at the drawing, where
a is zero, theta moves nothing: a fit that starts there finds one coordinate of the two.  From a
length of the common normal that is not zero, theta finds the other.  How little theta then moves
beside other parameters (as much as the offset is long) says nothing of how well it is known.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import fdtrc

from minimax_cal.core.arrays import Array
from minimax_cal.fitting.identification import (
    DEFAULT_RESOLUTION,
    MIN_RANK_RATIO,
    Identification,
    KeptParameters,
    gram_with_priors,
    select_redundant_parameters,
)
from minimax_cal.modelling.parameters import ParameterNames, ParameterValues
from minimax_cal.robots import kinematics
from minimax_cal.robots.robot import Robot

MAX_P_OF_OFFSET = 1e-4  # of no second coordinate, below which the rows show one


def find_coaxial_joints(robot: Robot) -> list[int]:
    """Joints whose axis is drawn as that of the next one, as well as the drawing is known.

    So are those whose common normal is so short that theta would count as not measured.  Both turn:
    where an axis of a slide lies moves nothing.
    """
    length, angle = robot.drawn_within
    length = max(length, DEFAULT_RESOLUTION * robot.reach())
    tilt = np.hypot(np.sin(robot.mdh[:, kinematics.ALPHA]), np.sin(robot.mdh[:, kinematics.BETA]))
    on_next = (np.abs(robot.mdh[:, 0]) <= length) & (tilt <= angle)
    both_turn = ~robot.prismatic[:-1] & ~robot.prismatic[1:]
    return [int(joint) for joint in np.flatnonzero(on_next[:-1] & both_turn)]


@dataclass(frozen=True, eq=False)
class OffsetTrial:
    """A fit in which the common normal of two axes may turn.

    begin: where it starts.  is_free: (p,) what it fits.  is_added: (p,) True for what is new in it.
    """

    begin: ParameterValues
    is_free: Array
    is_added: Array


def build_offset_trial(
    robot: Robot,
    state: ParameterValues,
    joint: int,
    is_free: Array,
    is_allowed: Array,
    drop_order: Array,
    compute_gram: Callable[[ParameterValues], Array],
) -> OffsetTrial | None:
    """The trial for an axis and its next; None where theta of neither is new.

    is_free, is_allowed: (p,) masks.  drop_order: of the parameters, those to give up first at the
    front. compute_gram: of plenty of poses at a state, of the first of the p parameters.
    """
    mdh = state.mdh.copy()
    mdh[joint, 0] = np.copysign(max(abs(mdh[joint, 0]), robot.drawn_within[0]), mdh[joint, 0])
    begin = replace(state, mdh=mdh)
    zeros = np.isin(np.arange(len(is_free)), 2 * robot.joints + np.array([joint, joint + 1]))
    joined, plain = zeros & is_allowed & ~is_free, compute_gram(begin)
    drop_order = np.concatenate([drop_order[joined[drop_order]], drop_order[~joined[drop_order]]])
    known = np.arange(len(is_free)) < len(plain)
    gone = select_redundant_parameters(plain, ((is_free | joined) & known)[: len(plain)],
                     drop_order[known[drop_order]], MIN_RANK_RATIO)  # fmt: skip
    joined[[i for i in gone if joined[i]]] = False
    return OffsetTrial(begin, is_free | joined, joined) if joined.any() else None


def with_rotated_common_normal(
    robot: Robot, mdh: Array, joint: int, is_free: Array, angle: float
) -> Array:
    """(n, 5) of an arm whose common normal of two coaxial axes lies elsewhere, its length zero.

    The axes are as drawn; theta turns where it is fitted, else base or tool do.  is_free: (p,)
    mask. angle: [rad].
    """
    mdh, theta = mdh.copy(), 2 * robot.joints + joint
    tilt = [kinematics.ALPHA, kinematics.BETA]
    mdh[joint, 0], mdh[joint, tilt] = 0.0, robot.mdh[joint, tilt]
    mdh[joint, kinematics.THETA] += angle * is_free[theta]
    same = np.sign(np.cos(robot.mdh[joint, kinematics.ALPHA]))
    mdh[joint + 1, kinematics.THETA] -= same * angle * is_free[theta + 1]
    return mdh


def is_offset_significant(
    cost_before: float, cost_after: float, is_added: Array, degrees_of_freedom: float
) -> bool:
    """Whether a fit with more parameters is better than chance makes it.

    cost_before, cost_after: sums of squares.  is_added: (p,) mask of what is new.
    degrees_of_freedom: numbers beyond what is then fitted.
    """
    if cost_after <= 0.0 or degrees_of_freedom < 1.0:
        return cost_before > cost_after
    count = int(is_added.sum())
    ratio = max(cost_before - cost_after, 0.0) / count / (cost_after / degrees_of_freedom)
    return float(fdtrc(count, degrees_of_freedom, ratio)) < MAX_P_OF_OFFSET


def identification_with_offset(
    identification: Identification,
    names: ParameterNames,
    trial: OffsetTrial,
    gram: Array,
    target_stems: Iterable[str],
    all_targets_text: str,
) -> Identification:
    """What is identified with an offset.

    gram: (p, p) where the fit ended.  target_stems, all_targets_text: as of
    `KeptParameters.identification`.
    """
    kept = KeptParameters(names, trial.is_free, {})
    found = kept.build_identification(
        gram_with_priors(gram, trial.is_added), identification.scale, target_stems, all_targets_text
    )
    new = {names.all_names[i] for i in np.flatnonzero(trial.is_added)}
    return replace(
        found, reasons={k: why for k, why in identification.reasons.items() if k not in new}
    )


def merge_coaxial_zero_changes(robot: Robot, link_changes: Array) -> Array:
    """Changes of links (5n,) where a common normal without a direction may turn.

    Of thetas about axes that are drawn coaxial only the sum is drawn: it is written as the first's,
    before the flange as the last's, so that a base or a tool may take it.
    """
    link_changes, zeros = link_changes.copy(), 2 * robot.joints + np.arange(robot.joints)
    for joint in reversed(find_coaxial_joints(robot)):
        same = np.sign(np.cos(robot.mdh[joint, kinematics.ALPHA]))
        kept, gone = zeros[[joint, joint + 1]]
        if joint == robot.joints - 2:
            kept, gone = gone, kept
        link_changes[kept] += same * link_changes[gone]
        link_changes[gone] = 0.0
    return link_changes
