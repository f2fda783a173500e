"""What instruments can tell, alone and together, and why not the rest.

Lengths and closures know no base frame; closures know no length either.  Both show in the rank of
their rows at plenty of poses that no one had to measure.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from minimax_cal.fitting.identify import (
    RANK_TOLERANCE,
    RESOLUTION,
    Because,
    Identification,
    Kept,
    doubted_last,
    drop_order,
    redundant,
    scale_keeper,
    with_priors,
)
from minimax_cal.fitting.several.stack import Stack
from minimax_cal.ground.arrays import Array
from minimax_cal.instruments.instrument import FRAMELESS
from minimax_cal.instruments.protocol import ResidualRows, by_arm
from minimax_cal.modelling.model import TARGET
from minimax_cal.modelling.parameters import Names, State
from minimax_cal.robots.robot import Robot

STILL = 1e-7  # relative motion of a column that moves nothing
SHARED = 0.05  # of a direction that others leave open: a parameter with less is known without it
LENGTHS = "all lengths together: "
ALL_OWN = "all frames, anchors and targets of the files moved together"


def order_of(robot: Robot, stack: Stack) -> Array:
    """Parameters in the order in which redundant ones are given up.

    First laws and what the instruments give up, as offsets of wires, then as
    `identify.drop_order`, the instruments' own last.
    """
    names, laws = stack.names, range(stack.lawless, stack.names.count)
    extra = np.arange(names.geometric, stack.lawless)
    soft = np.array([name.startswith(one.given_up) for one in stack.instruments
                     for name in one.names], dtype=bool)  # fmt: skip
    order = [*laws, *extra[soft], *drop_order(robot, names), *extra[~soft]]
    return np.array([int(i) for i in order], dtype=int)


def length_row(stack: Stack, x: State) -> Array:
    """(p,) derivative of the distance between two places of the first instrument's target."""
    block, x, links = stack.blocks[0], stack.part(x, 0), 5 * stack.names.joints
    one = block.instrument
    arm = block.flange(x, np.ones(links + stack.names.count - stack.lawless, dtype=bool))
    point = arm.place(one.targets(block.own(x))[0])
    ends = np.array([int(np.argmax(((point - point[0]) ** 2).sum(axis=1))), 0])
    gap = point[ends[0]] - point[0]
    along = gap / max(float(np.linalg.norm(gap)), 1e-12)
    by_point, none = np.stack([along, -along]), np.zeros((2, 3))
    slopes = by_arm(arm, ResidualRows(none[:, 0], ends, point[ends], by_point, none, none[:, :0]))
    row, (far, near) = np.zeros(stack.names.count), arm.rotation[ends]
    row[:links], row[stack.lawless :] = np.split(slopes.sum(axis=1), [links])
    at = stack.own(0)[one.targets_at][:3]
    row[at] = (along @ (far - near))[: len(at)]
    return row


def open_scale(reference: Stack, x: State, plain: Array, active: Array, order: Array) -> bool:
    """Whether one more length would tell one more of the active parameters.

    Not so where the user fixed a length of the arm.
    """
    if any(one.has_length for one in reference.instruments):
        return False
    row = length_row(reference, x)
    if not row.any():  # one socket: nothing has a length
        return True
    more = plain + reference.points * np.outer(row, row)
    missing = [len(redundant(gram, active, order, RANK_TOLERANCE)) for gram in (plain, more)]
    return missing[1] < missing[0]


def identified(
    robot: Robot,
    stack: Stack,
    reference: Stack,
    x: State,
    allowed: Array,
    wanted: Array,
    *,
    known: Array,
    resolution: float = RESOLUTION,
) -> Identification:
    """The largest set of allowed parameters that the measurements determine; see `identify`.

    reference: the instruments at plenty of poses, without laws, which only the poses at hand tell.
    x: the arm as drawn, with the instruments' own parameters fitted to it.  wanted: (p,) those to
    give up last.  known: (p,) True where a prior stands in for measurements.
    """
    names = stack.names
    plain, gram = reference.gram(x), stack.closed(robot, x).gram(x)
    stiff = stack.lawless
    size, scale = np.sqrt(np.diag(plain)), np.sqrt(np.diag(gram) / max(stack.points, 1))
    kept = Kept(names, allowed, {}).without(~allowed & names.links, Because.FIXED)
    unmoved = {one.unmoved for one in stack.instruments}
    for motion_of, reason in (
        (size, unmoved.pop() if len(unmoved) == 1 else FRAMELESS),
        (scale, "moves nothing at these poses"),
    ):
        still = np.zeros(names.count, dtype=bool)
        still[: len(motion_of)] = motion_of <= STILL * motion_of[:stiff].max()
        kept = kept.without(kept.active & still, Because.OTHER, reason)
    order = order_of(robot, stack)
    order = np.concatenate([order[~wanted[order]], order[wanted[order]]])
    order = doubted_last(order, names, known)
    no_length = open_scale(reference, x, plain, kept.active[:stiff], order[order < stiff])
    keeper = scale_keeper(robot, kept.active, wanted) if no_length else []
    order = np.array(list(dict.fromkeys([*keeper, *(int(i) for i in order)])))
    gone = redundant(plain, kept.active[:stiff], order[order < stiff], RANK_TOLERANCE)
    gone = [i for i in gone if not known[i] or i in keeper]
    if all(one.drawn_scale for one in stack.instruments) and keeper:
        gone, known = [i for i in gone if i not in keeper], known | lengths_of(names)
    no_scale = LENGTHS + "; ".join(stack.instruments[0].scale)
    kept = kept.without(gone, Because.SAME_MOTION).without(
        [i for i in gone if i in keeper], Because.NO_SCALE, no_scale
    )
    told = with_priors(gram, known)
    kept = kept.without(redundant(told, kept.active, order, resolution), Because.NOT_TOLD)
    return kept.identification(told, scale, *words_of_own(stack))


def words_of_own(stack: Stack) -> tuple[set[str], str]:
    """Stems of what is the instruments' own, and what all of it is called."""
    whole = stack.instruments[0].words.whole if len(stack.blocks) == 1 else ALL_OWN
    own = stack.names.effects[: stack.lawless - stack.names.geometric]
    return {name.rpartition("_")[0] for name in own if whole} - {TARGET, "base"}, whole


def lengths_of(names: Names) -> Array:
    """(p,) True for the lengths of the links."""
    return np.asarray(np.arange(names.count) < 2 * names.joints)


def generic_count(robot: Robot, reference: Stack, x: State, allowed: Array) -> int:
    """How many of the allowed parameters plenty of poses would determine."""
    plain = reference.gram(x)
    moving = allowed & (np.sqrt(np.diag(plain)) > STILL * np.sqrt(np.diag(plain).max()))
    gone = redundant(plain, moving, order_of(robot, reference), RANK_TOLERANCE)
    return int(moving.sum()) - len(gone)


@dataclass(frozen=True)
class Alone:
    """What a single instrument determines.

    directions: number of independent ones that the others leave open.  names: link parameters that
    take part in them.
    """

    directions: int
    names: tuple[str, ...]


def determined_alone(stack: Stack, x: State, active: Array, resolution: float) -> tuple[Alone, ...]:
    """What the links would lack without each of several blocks.

    stack: where the arm fits it.  active: (p,).
    """
    out = []
    every = np.ones(stack.names.count, dtype=bool)
    grams = [slope @ slope.T for _, slope in stack.rows_by_block(x, every)]
    whole = np.sqrt(np.diag(np.sum(grams, axis=0)))
    for i in range(len(stack.blocks)):
        others, chosen = np.sum(grams[:i] + grams[i + 1 :], axis=0), active.copy()
        chosen[stack.own(i)] = False
        size = whole[chosen]
        alike = others[np.ix_(chosen, chosen)] / np.outer(size, size)
        values, vectors = np.linalg.eigh(alike)
        lost = vectors[:, values <= resolution**2 * values[-1]]
        share = np.linalg.norm(lost, axis=1)
        places = np.flatnonzero(chosen)
        named = [stack.names.all[p] for p, s in zip(places, share, strict=True)
                 if s > SHARED and stack.names.links[p]]  # fmt: skip
        out.append(Alone(lost.shape[1], tuple(named)))
    return tuple(out)
