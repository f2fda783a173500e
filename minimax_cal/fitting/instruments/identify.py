"""What lengths and closures can tell, and why not the rest.

Lengths and closures know no base frame; closures know no length either.  Both show in the rank of
their rows at plenty of poses that no one had to measure.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from minimax_cal.fitting.identify import (
    NOT_TOLD,
    RANK_TOLERANCE,
    RESOLUTION,
    SAME_MOTION,
    Identification,
    Kept,
    drop_order,
    plenty_of_poses,
    redundant,
)
from minimax_cal.fitting.instruments.closing import closing_poses, reach
from minimax_cal.fitting.instruments.rows import Closures, Instrument, Wires, gram_of, places
from minimax_cal.ground.arrays import Array
from minimax_cal.modelling.model import Model
from minimax_cal.modelling.parameters import Names, State
from minimax_cal.robots import kinematics
from minimax_cal.robots.kinematics import hat
from minimax_cal.robots.robot import Robot

PLENTY = 200  # poses that show what no poses could tell
SOCKETS, VISITS = 20, 10
STILL = 1e-7  # relative motion of a column that moves nothing
FRAMELESS = {
    Wires: "moves nothing that is measured",
    Closures: "moves or turns all sockets alike: closures know no base frame",
}
SCALE = (
    "all lengths together: a closure has no length standard; one known length, as "
    "known_distances= A,B,MM, gives it"
)


def order_of(robot: Robot, names: Names) -> Array:
    """Parameters in the order in which redundant ones are given up.

    First the offsets of wires, then as `identify.drop_order`, anchors last.
    """
    extra = np.arange(names.geometric, names.count)
    offset = np.array([names.all[i].startswith("offset") for i in extra], dtype=bool)
    order = [*extra[offset], *drop_order(robot, names), *extra[~offset]]
    return np.array([int(i) for i in order], dtype=int)


def has_scale(instrument: Instrument) -> bool:
    """Whether something measured is a length."""
    return not isinstance(instrument, Closures) or bool(len(instrument.pairs))


def open_scale(reference: Instrument, x: State, active: Array, order: Array) -> bool:
    """Whether one more length would tell one more of the active parameters.

    Not so where the user fixed a length of the arm.
    """
    if has_scale(reference) or not isinstance(reference, Closures):
        return False
    if len(reference.first) < 2:  # one socket: nothing has a length
        return True
    told = replace(reference, pairs=np.array([[0, 1]]), distance=np.zeros(1))
    missing = [
        len(redundant(gram_of(r, x), active, order, RANK_TOLERANCE)) for r in (reference, told)
    ]
    return missing[1] < missing[0]


def scale_keeper(robot: Robot, allowed: Array, wanted: Array) -> list[int]:
    """The link length to keep as drawn where nothing tells the scale: the longest.

    An error of the drawing is then the smallest part of it.  allowed, wanted: (p,) what may be
    fitted, and what the user wants fitted.
    """
    lengths = np.abs(robot.mdh[:, :2].T.reshape(-1))
    chosen = np.flatnonzero(allowed[: len(lengths)])
    preferred = [i for i in chosen if not wanted[i]] or list(chosen)
    return [int(max(preferred, key=lambda i: lengths[i]))] if preferred else []


def reference_of(robot: Robot, instrument: Instrument, x: State) -> Instrument:
    """The instrument at plenty of random poses; of closures, poses that close."""
    if isinstance(instrument, Wires):
        poses = max(PLENTY, instrument.names.count)
        model = plenty_of_poses(robot, instrument.model, poses)
        return Wires(model, instrument.names, np.zeros((poses, instrument.length.shape[1])))
    rng = np.random.default_rng(0)
    q, socket = closing_poses(robot, x.target_positions[0], SOCKETS, VISITS, rng)
    if len(np.unique(socket)) < 2:  # an arm that hardly reaches a place in two ways
        return closed(robot, instrument, x)
    _, socket = np.unique(socket, return_inverse=True)
    known = min(len(instrument.pairs), 1)
    return Closures.of(robot, q, socket, np.array([[0, 1]])[:known], np.zeros(known))


def closed(robot: Robot, closures: Closures, x: State) -> Closures:
    """The instrument at nearby poses where the arm as drawn itself closes.

    Where a closure misses by millimetres, its rows turn with a turn of the whole arm, as if that
    could be told.
    """
    centre = closures.barycentres(places(closures.model, x))
    goal = np.repeat(centre, closures.visits, axis=-1).T
    q, _ = reach(robot, x.target_positions[0], goal, robot.commanded(closures.model.q))
    socket = np.repeat(np.arange(len(closures.first)), closures.visits)
    return Closures.of(robot, q, socket, closures.pairs, closures.distance)


def identified(
    robot: Robot,
    instrument: Instrument,
    x: State,
    allowed: Array,
    wanted: Array,
    *,
    known: Array,
    resolution: float = RESOLUTION,
) -> Identification:
    """The largest set of allowed parameters that the measurements determine; see `identify`.

    x: the arm as drawn, with the instrument's own parameters fitted to it.  wanted: (p,) those to
    give up last.  known: (p,) True where a prior stands in for measurements.
    """
    names = instrument.names
    reference = reference_of(robot, instrument, x)
    plain = gram_of(reference, x)
    here = closed(robot, instrument, x) if isinstance(instrument, Closures) else instrument
    gram = gram_of(here, x)
    size, scale = np.sqrt(np.diag(plain)), np.sqrt(np.diag(gram) / max(instrument.points, 1))
    kept = Kept(names, allowed, {}).without(~allowed & names.links, "fixed by the user")
    for motion, reason in (
        (size, FRAMELESS[type(instrument)]),
        (scale, "moves nothing at these poses"),
    ):
        kept = kept.without(kept.active & (motion <= STILL * motion.max()), reason)
    order = order_of(robot, names)
    order = np.concatenate([order[~wanted[order]], order[wanted[order]]])
    no_length = open_scale(reference, x, kept.active, order)
    keeper = scale_keeper(robot, kept.active, wanted) if no_length else []
    order = np.array(list(dict.fromkeys([*keeper, *(int(i) for i in order)])))
    gone = redundant(plain, kept.active, order, RANK_TOLERANCE)
    kept = kept.without(gone, SAME_MOTION).without([i for i in gone if i in keeper], SCALE)
    told = gram + np.diag(np.where(known, np.maximum(np.diag(gram), RANK_TOLERANCE), 0.0))
    kept = kept.without(redundant(told, kept.active, order, resolution), NOT_TOLD)
    anchors = {name.partition("_")[0] for name in names.all if name.startswith("anchor")}
    return kept.identification(gram, scale, anchors, "all anchors moved together")


def generic_count(robot: Robot, instrument: Instrument, x: State, allowed: Array) -> int:
    """How many of the allowed parameters plenty of poses would determine."""
    plain = gram_of(reference_of(robot, instrument, x), x)
    moving = allowed & (np.sqrt(np.diag(plain)) > STILL * np.sqrt(np.diag(plain).max()))
    gone = redundant(plain, moving, order_of(robot, instrument.names), RANK_TOLERANCE)
    return int(moving.sum()) - len(gone)


def position_sigma(robot: Robot, model: Model, x: State, covariance: Array) -> float:
    """RMS of a position's standard deviation at random poses, by the parameters alone [m].

    Of the targets' centroid in base axes.  The best rigid motion of all positions is taken out: a
    base is fitted wherever an arm is put to work.  covariance: (p, p) of the model's parameters,
    NaN where not identified.
    """
    names = model.names
    told = np.isfinite(np.diag(covariance))
    told[5 * names.joints : 5 * names.joints + 6] = False  # the base, which is fitted again
    some = plenty_of_poses(robot, model)
    jacobian = some.jacobian(x).mean(axis=0)[..., told].reshape(3 * len(some.q), -1)
    links = kinematics.chain(x.mdh, some.q, some.prismatic)
    point = kinematics.points(links, x.target_positions).mean(axis=0).T
    point = point - point.mean(axis=0)
    rigid = np.concatenate([np.tile(np.eye(3), (len(point), 1, 1)), -hat(point)], axis=2)
    basis, _ = np.linalg.qr(rigid.reshape(-1, 6))
    jacobian = jacobian - basis @ (basis.T @ jacobian)
    # by its square root: where much is known badly, rounding would make the sum itself negative
    spread, axes = np.linalg.eigh(covariance[np.ix_(told, told)])
    root = jacobian @ (axes * np.sqrt(np.maximum(spread, 0.0)))
    return float(np.sqrt((root**2).sum() / len(point)))
