"""What instruments can tell, alone and together, and why not the rest.

Lengths and closures know no base frame; closures know no length either.  Both show in the rank of
their rows at plenty of poses that no one had to measure.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from minimax_cal.evidence.noise import orthonormal
from minimax_cal.fitting.identify import (
    RANK_TOLERANCE,
    RESOLUTION,
    Because,
    Identification,
    Kept,
    drop_order,
    plenty_of_poses,
    redundant,
    scale_keeper,
)
from minimax_cal.fitting.instruments.laws import NO_LAWS, Laws
from minimax_cal.fitting.instruments.record import FRAMELESS
from minimax_cal.fitting.instruments.rows import motion
from minimax_cal.fitting.instruments.stack import Stack
from minimax_cal.fitting.instruments.table import instrument
from minimax_cal.ground.arrays import Array
from minimax_cal.modelling.cell import still
from minimax_cal.modelling.model import TARGET, Model
from minimax_cal.modelling.parameters import State
from minimax_cal.robots import kinematics
from minimax_cal.robots.kinematics import hat
from minimax_cal.robots.robot import Robot

STILL = 1e-7  # relative motion of a column that moves nothing
SHARED = 0.05  # of a direction that others leave open: a parameter with less is known without it
OPEN = 1e-4  # of the largest column: positions that a parameter moves by less depend on it no more
LENGTHS = "all lengths together: "
ALL_OWN = "all frames, anchors and targets of the files moved together"


def order_of(robot: Robot, stack: Stack) -> Array:
    """Parameters in the order in which redundant ones are given up.

    First laws and what the instruments give up, as offsets of wires, then as
    `identify.drop_order`, the instruments' own last.
    """
    names, laws = stack.names, range(stack.lawless, stack.names.count)
    extra = np.arange(names.geometric, stack.lawless)
    soft = np.array([name in b.given_up for b in stack.blocks for name in b.own], dtype=bool)
    order = [*laws, *extra[soft], *drop_order(robot, names), *extra[~soft]]
    return np.array([int(i) for i in order], dtype=int)


def length_row(stack: Stack, x: State) -> Array:
    """(p,) derivative of the distance between two places of the first block's target."""
    block, columns = stack.blocks[0], stack.columns(0)
    point, moved = motion(block.model, stack.part(x, 0), np.ones(len(columns), dtype=bool))
    far = int(np.argmax(((point - point[:, :1]) ** 2).sum(axis=0)))
    gap = point[:, far] - point[:, 0]
    row = np.zeros(stack.names.count)
    along = gap / max(float(np.linalg.norm(gap)), 1e-12)
    row[columns] = along @ (moved[..., far] - moved[..., 0]).T
    return row


def open_scale(reference: Stack, x: State, plain: Array, active: Array, order: Array) -> bool:
    """Whether one more length would tell one more of the active parameters.

    Not so where the user fixed a length of the arm.
    """
    if any(block.has_length for block in reference.blocks):
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
    unmoved = {instrument(block.kind).unmoved for block in stack.blocks}
    for motion_of, reason in (
        (size, unmoved.pop() if len(unmoved) == 1 else FRAMELESS),
        (scale, "moves nothing at these poses"),
    ):
        still = np.zeros(names.count, dtype=bool)
        still[: len(motion_of)] = motion_of <= STILL * motion_of[:stiff].max()
        kept = kept.without(kept.active & still, Because.OTHER, reason)
    order = order_of(robot, stack)
    order = np.concatenate([order[~wanted[order]], order[wanted[order]]])
    no_length = open_scale(reference, x, plain, kept.active[:stiff], order[order < stiff])
    keeper = scale_keeper(robot, kept.active, wanted) if no_length else []
    order = np.array(list(dict.fromkeys([*keeper, *(int(i) for i in order)])))
    gone = redundant(plain, kept.active[:stiff], order[order < stiff], RANK_TOLERANCE)
    no_scale = LENGTHS + "; ".join(instrument(stack.blocks[0].kind).scale)
    kept = kept.without(gone, Because.SAME_MOTION).without(
        [i for i in gone if i in keeper], Because.NO_SCALE, no_scale
    )
    told = gram + np.diag(np.where(known, np.maximum(np.diag(gram), RANK_TOLERANCE), 0.0))
    kept = kept.without(redundant(told, kept.active, order, resolution), Because.NOT_TOLD)
    whole = stack.blocks[0].whole if len(stack.blocks) == 1 else ALL_OWN
    own = names.effects[: stiff - names.geometric]
    stems = {name.rpartition("_")[0] for name in own if whole}
    curves = gram + np.diag(np.where(known & (np.arange(names.count) >= stiff), np.diag(gram), 0.0))
    return kept.identification(curves, scale, stems - {TARGET, "base"}, whole)


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


def position_sigma(
    robot: Robot, model: Model, x: State, covariance: Array, laws: Laws = NO_LAWS
) -> float:
    """RMS of a position's standard deviation at random poses, by the parameters alone [m].

    Of the targets' centroid in base axes.  The best rigid motion of all positions is taken out: a
    base is fitted wherever an arm is put to work.  covariance: (p, p) of the model's parameters,
    behind them those of laws by which the arm gives way, NaN where not identified.
    """
    known = np.isfinite(np.diag(covariance))
    known[5 * model.names.joints : 5 * model.names.joints + 6] = False  # the base, fitted again
    jacobian = positions_by(robot, model, x, laws)
    # by its square root: where much is known badly, rounding would make the sum itself negative
    spread, axes = np.linalg.eigh(covariance[np.ix_(known, known)])
    root = jacobian[:, known] @ (axes * np.sqrt(np.maximum(spread, 0.0)))
    return float(np.sqrt(3.0 * (root**2).sum() / len(jacobian)))


def left_open(jacobian: Array, active: Array, asked: Array) -> Array:
    """(p,) the fewest of the parameters asked for with which all of them would be determined.

    Those that move positions as no others together do.  jacobian: (r, p) as `positions_by`.
    active: (p,) the identified parameters.
    """
    size = np.linalg.norm(jacobian, axis=0)
    waiting = asked & ~active & (size > OPEN * size.max())
    known, out = active.copy(), np.zeros_like(active)
    while waiting.any():
        basis = orthonormal(jacobian[:, known])
        rest = np.linalg.norm(jacobian - basis @ (basis.T @ jacobian), axis=0)
        waiting &= ~known & (rest > OPEN * size.max())
        share = np.where(waiting, rest / np.maximum(size, 1e-300), 0.0)
        if waiting.any():
            most = int(np.argmax(share))
            known[most] = out[most] = True
    return out


def positions_by(robot: Robot, model: Model, x: State, laws: Laws = NO_LAWS) -> Array:
    """(3 m, p) motion of the targets' centroid at random poses per unit of each parameter.

    But for the best rigid motion of all positions; behind the model's parameters those of laws.
    """
    some = plenty_of_poses(robot, replace(model, names=replace(model.names, effects=())))
    here = still(robot.commanded(some.q), model.names.target_names, robot)
    some = laws.on(some, robot, here, x)
    jacobian = some.jacobian(x).mean(axis=0)
    jacobian = jacobian.reshape(-1, jacobian.shape[-1])
    links = kinematics.chain(x.mdh, some.q, some.prismatic)
    point = kinematics.points(links, x.target_positions).mean(axis=0).T
    point = point - point.mean(axis=0)
    rigid = np.concatenate([np.tile(np.eye(3), (len(point), 1, 1)), -hat(point)], axis=2)
    basis, _ = np.linalg.qr(rigid.reshape(-1, 6))
    return np.asarray(jacobian - basis @ (basis.T @ jacobian))
