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

from minimax_cal.fitting.identify import (
    RANK_TOLERANCE,
    RESOLUTION,
    Identification,
    Kept,
    redundant,
    with_priors,
)
from minimax_cal.ground.arrays import Array
from minimax_cal.modelling.parameters import Names, State
from minimax_cal.robots import kinematics
from minimax_cal.robots.robot import Robot

MAX_P_OF_OFFSET = 1e-4  # of no second coordinate, below which the rows show one


def coaxial_joints(robot: Robot) -> list[int]:
    """Joints whose axis is drawn as that of the next one, as well as the drawing is known.

    So are those whose common normal is so short that theta would count as not measured.  Both turn:
    where an axis of a slide lies moves nothing.
    """
    length, angle = robot.drawn_within
    length = max(length, RESOLUTION * robot.reach())
    tilt = np.hypot(np.sin(robot.mdh[:, kinematics.ALPHA]), np.sin(robot.mdh[:, kinematics.BETA]))
    on_next = (np.abs(robot.mdh[:, 0]) <= length) & (tilt <= angle)
    both_turn = ~robot.prismatic[:-1] & ~robot.prismatic[1:]
    return [int(joint) for joint in np.flatnonzero(on_next[:-1] & both_turn)]


@dataclass(frozen=True, eq=False)
class OffsetTrial:
    """A fit in which the common normal of two axes may turn.

    begin: where it starts.  active: (p,) what it fits.  joined: (p,) True for what is new in it.
    """

    begin: State
    active: Array
    joined: Array


def start_with_offset(
    robot: Robot,
    state: State,
    joint: int,
    active: Array,
    allowed: Array,
    order: Array,
    gram: Callable[[State], Array],
) -> OffsetTrial | None:
    """The trial for an axis and its next; None where theta of neither is new.

    active, allowed: (p,) masks.  order: of the parameters, those to give up first at the front.
    gram: of plenty of poses at a state, of the first of the p parameters.
    """
    mdh = state.mdh.copy()
    mdh[joint, 0] = np.copysign(max(abs(mdh[joint, 0]), robot.drawn_within[0]), mdh[joint, 0])
    begin = replace(state, mdh=mdh)
    zeros = np.isin(np.arange(len(active)), 2 * robot.joints + np.array([joint, joint + 1]))
    joined, plain = zeros & allowed & ~active, gram(begin)
    order = np.concatenate([order[joined[order]], order[~joined[order]]])
    known = np.arange(len(active)) < len(plain)
    gone = redundant(plain, ((active | joined) & known)[: len(plain)],
                     order[known[order]], RANK_TOLERANCE)  # fmt: skip
    joined[[i for i in gone if joined[i]]] = False
    return OffsetTrial(begin, active | joined, joined) if joined.any() else None


def with_normal_turned(robot: Robot, mdh: Array, joint: int, active: Array, angle: float) -> Array:
    """(n, 5) of an arm whose common normal of two coaxial axes lies elsewhere, its length zero.

    The axes are as drawn; theta turns where it is fitted, else base or tool do.  active: (p,) mask.
    angle: [rad].
    """
    mdh, theta = mdh.copy(), 2 * robot.joints + joint
    tilt = [kinematics.ALPHA, kinematics.BETA]
    mdh[joint, 0], mdh[joint, tilt] = 0.0, robot.mdh[joint, tilt]
    mdh[joint, kinematics.THETA] += angle * active[theta]
    same = np.sign(np.cos(robot.mdh[joint, kinematics.ALPHA]))
    mdh[joint + 1, kinematics.THETA] -= same * angle * active[theta + 1]
    return mdh


def is_offset_shown(before: float, after: float, joined: Array, spare: float) -> bool:
    """Whether a fit with more parameters is better than chance makes it.

    before, after: sums of squares.  joined: (p,) mask of what is new.  spare: numbers beyond what
    is then fitted.
    """
    if after <= 0.0 or spare < 1.0:
        return before > after
    count = int(joined.sum())
    ratio = max(before - after, 0.0) / count / (after / spare)
    return float(fdtrc(count, spare, ratio)) < MAX_P_OF_OFFSET


def identify_with_offset(
    known: Identification,
    names: Names,
    trial: OffsetTrial,
    gram: Array,
    stems: Iterable[str],
    whole: str,
) -> Identification:
    """What is identified with an offset.

    gram: (p, p) where the fit ended.  stems, whole: as of `Kept.identification`.
    """
    kept = Kept(names, trial.active, {})
    found = kept.identification(with_priors(gram, trial.joined), known.scale, stems, whole)
    new = {names.all[i] for i in np.flatnonzero(trial.joined)}
    return replace(found, reasons={k: why for k, why in known.reasons.items() if k not in new})


def change_of_coaxial_zeros(robot: Robot, change: Array) -> Array:
    """Changes of links (5n,) where a common normal without a direction may turn.

    Of thetas about axes that are drawn coaxial only the sum is drawn: it is written as the first's,
    before the flange as the last's, so that a base or a tool may take it.
    """
    change, zeros = change.copy(), 2 * robot.joints + np.arange(robot.joints)
    for joint in reversed(coaxial_joints(robot)):
        same = np.sign(np.cos(robot.mdh[joint, kinematics.ALPHA]))
        kept, gone = zeros[[joint, joint + 1]]
        if joint == robot.joints - 2:
            kept, gone = gone, kept
        change[kept] += same * change[gone]
        change[gone] = 0.0
    return change
