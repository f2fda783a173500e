"""What a fit may claim: how it does on poses it has not seen, and whether it is one at all."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from types import MappingProxyType
from typing import TYPE_CHECKING

import numpy as np

from minimax_cal.evidence.noise import orthonormal
from minimax_cal.fitting.beyond import Beyond, left_out, not_claimed
from minimax_cal.fitting.crossed import MIN_HELD_POSES, crossed
from minimax_cal.fitting.options import Options, known_within
from minimax_cal.fitting.solve import Solved
from minimax_cal.fitting.stations import steps_of
from minimax_cal.fitting.suspects import Suspect, aside, held_suspects
from minimax_cal.fitting.uncertainty import Estimator
from minimax_cal.ground.arrays import Array
from minimax_cal.ground.words import name_first
from minimax_cal.instruments.instrument import PLENTY, anywhere
from minimax_cal.instruments.protocol import (
    Arm,
    FlangePoses,
    Given,
    ResidualRows,
    by_arm,
    corners,
)
from minimax_cal.measuring.grouping import clusters, grouped, parts
from minimax_cal.measuring.measurements import Measurements
from minimax_cal.measuring.stations import Sessions
from minimax_cal.modelling.cell import Cell, still
from minimax_cal.modelling.effects.scene import Scene
from minimax_cal.modelling.effects.table import NOTHING, of_sessions
from minimax_cal.modelling.joint_fit import extended, fitted, refitted
from minimax_cal.modelling.model import model_of
from minimax_cal.modelling.parameters import Names, State, zero_positions
from minimax_cal.modelling.rows import by_pose
from minimax_cal.robots.kinematics import hat
from minimax_cal.robots.robot import Robot

if TYPE_CHECKING:
    from minimax_cal.fitting.several.laws import Laws

TOOL = np.array([0.0, 0.0, 0.1])  # a point beside the last axes, in the flange [m]
OPEN = 1e-4  # of the largest column: positions that a parameter moves by less depend on it no more
NO_VALUES: Array = np.zeros(0)
NO_MOTION: Array = np.zeros((0, 0))
NO_PRIORS: Mapping[str, float] = MappingProxyType({})


def position_sigma(
    robot: Robot, mdh: Array, spots: Array, covariance: Array, laws: Laws | None = None,
    values: Array = NO_VALUES, moved: Array = NO_MOTION, moment: Array = NO_MOTION,
) -> float:  # fmt: skip
    """RMS of a position's standard deviation at random poses [m].

    Arguments as of `positions_by`.  covariance: (p, p), NaN where not identified.  moved: (p, c)
    how far each factor of the lack of fit moves the parameters, whose covariance is then without
    it; moment: (c, c) mean of the factors' products.  Without them, by the parameters alone.
    """
    known = np.isfinite(np.diag(covariance))
    known[5 * robot.joints : 5 * robot.joints + 6] = False  # the base, fitted again
    jacobian, lack = positions_by(robot, mdh, spots, laws, values), 0.0
    if moved.size:
        turned = positions_by_lack(robot, mdh, spots) - jacobian[:, known] @ moved[known]
        lack = float(np.sum((turned @ moment) * turned))
    # by its square root: where much is known badly, rounding would make the sum itself negative
    spread, axes = np.linalg.eigh(covariance[np.ix_(known, known)])
    root = jacobian[:, known] @ (axes * np.sqrt(np.maximum(spread, 0.0)))
    return float(np.sqrt(3.0 * ((root**2).sum() + lack) / len(jacobian)))


def lacking(jacobian: Array, active: Array, asked: Array) -> Array:
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


def positions_by(
    robot: Robot, mdh: Array, spots: Array, laws: Laws | None = None, values: Array = NO_VALUES
) -> Array:
    """(3 m, p) motion of the targets' centroid at random poses per unit of each parameter.

    But for the best rigid motion of all positions: a base is fitted wherever an arm is put to work.
    mdh: (n, 5).  spots: (k, 3) targets on the flange, none where a tool is fitted there too [m].
    The parameters are links, a base, the targets and the laws, with values (d,).
    """
    at = still(anywhere(robot, PLENTY).q, (), robot)
    spot = spots.mean(axis=0) if len(spots) else TOOL
    arm, frame = Arm.of(robot, at.q), (np.eye(3), np.zeros(3))
    if laws and laws.terms:
        scene = Scene.of(robot.with_mdh(mdh), at, frame, corners(spot), arm.q)
        arm = replace(arm, given=Given.of(arm.at(mdh), spot, *laws.fields(scene, values), values))
    flange = arm.at(mdh, values, np.ones(5 * len(mdh) + len(values), dtype=bool))
    point, pose = np.repeat(flange.place(spot), 3, axis=0), np.repeat(np.arange(PLENTY), 3)
    axes, none = np.tile(np.eye(3), (PLENTY, 1)), np.zeros((len(pose), 3))
    by = by_arm(flange, ResidualRows(none[:, 0], pose, point, axes, none, none[:, :0])).T
    target = flange.rotation.reshape(-1, 3) / max(len(spots), 1)
    links, bends = np.split(by, [5 * len(mdh)], axis=1)
    jacobian = np.hstack([links, np.zeros((len(by), 6)), *[target] * len(spots), bends])
    return without_rigid_motion(jacobian, arm.at(mdh), spots)


def without_rigid_motion(motion: Array, flange: FlangePoses, spots: Array) -> Array:
    """(3 m, p) motion of a point without the best rigid motion of all its positions.

    Where no target is known on the flange, without what another point of the tool does either.
    """
    spot = spots.mean(axis=0) if len(spots) else TOOL
    stiff = flange.place(spot)
    stiff = stiff - stiff.mean(axis=0)
    rigid = np.concatenate([np.tile(np.eye(3), (len(stiff), 1, 1)), -hat(stiff)], axis=2)
    target = flange.rotation.reshape(-1, 3)
    basis = orthonormal(np.hstack([rigid.reshape(-1, 6), *[target] * (not len(spots))]))
    return np.asarray(motion - basis @ (basis.T @ motion))


def positions_by_lack(robot: Robot, mdh: Array, spots: Array) -> Array:
    """(3 m, c) as `positions_by`, per factor of each function of the pose (`rows.by_pose`)."""
    at, zeros = anywhere(robot, PLENTY), zero_positions(robot.prismatic)
    arm, spot = Arm.of(robot, at.q), spots.mean(axis=0) if len(spots) else TOOL
    flange = arm.at(mdh, NO_VALUES, np.isin(np.arange(5 * len(mdh)), zeros))
    point = flange.place(spot)
    by_joint = flange.linear + np.cross(flange.angular, point - flange.origin)  # (n, m, 3)
    by_joint = by_joint[np.argsort(np.argsort(zeros))]
    motion, _ = by_pose(robot.with_mdh(mdh), arm.q, np.moveaxis(by_joint, 0, -1))
    return without_rigid_motion(motion.reshape(3 * PLENTY, -1), arm.at(mdh), spots)


def drawn_sigmas(robot: Robot, priors: Mapping[str, float] = NO_PRIORS) -> Array:
    """(5n,) how well the links of a drawing are known: by `drawn_within`, or by a prior [SI]."""
    within = np.repeat(robot.drawn_within, np.array([2, 3]) * robot.joints)
    told = known_within(Names.of(robot, ()), priors, "")[: len(within)]
    return np.where(np.isfinite(told), told, within)


def known_positions(robot: Robot, solved: Solved, within: Array) -> tuple[float, float]:
    """RMS by which positions of the calibrated and of the drawn arm are known, by `position_sigma`.

    within: (5n,) sigmas of the drawing.  Of the drawn one the links that were adopted count.  NaN
    where no sigma is known [m].
    """
    spots, sure = solved.state.target_positions, solved.uncertainty.covariance
    count = 5 * robot.joints + 6 + spots.size
    links, active = slice(5 * robot.joints), solved.identification.active[:count]
    if not np.isfinite(np.diag(sure)[:count][active]).all():
        return np.nan, np.nan
    drawn = np.full((count, count), np.nan)
    drawn[links, links] = np.diag(within**2)
    drawn[~active] = drawn[:, ~active] = np.nan
    return (
        position_sigma(robot, solved.state.mdh, spots, sure[:count, :count]),
        position_sigma(robot, robot.mdh, spots, drawn),
    )


# ---- what is claimed -----------------------------------------------------------------------------


MAX_NAMED = 5  # poses that a notice names
WEAK = 3.0  # times what the reflectors miss by: points that are known worse are weakly told


def unseen_suspects(
    robot: Robot, data: Measurements, held: Array, solved: Solved
) -> tuple[Suspect, ...]:
    """The held-out points that stand out.  held: (m,)."""
    model, state = model_of(robot, data), solved.state
    if solved.effects.terms:
        model, state = extended(model, robot, data, state, solved.effects.terms)
    weights = np.zeros(model.weight.shape)
    weights[:, ~held] = solved.robust.weights
    model = model.only(solved.identification.active).with_prior(solved.estimator.model.prior)
    spread = solved.robust.scored[1]
    return held_suspects(model, state, weights, held, spread, data.line)


def other_points(robot: Robot, solved: Solved, error: Array) -> Iterator[str]:
    """Notice where other points of the tool are known far worse than these targets.

    A tool's offset is measured wherever it is put to work, as a base is.  error: (m, k, 3) [m].
    """
    known, n, spots = solved.identification, 5 * robot.joints, solved.state.target_positions
    if len(spots) > 2:  # they tell the whole flange
        return
    names = solved.names.all[:n]
    rest = []
    for spot in corners(spots.mean(axis=0)):
        motion = positions_by(robot, solved.state.mdh, spot[None])
        tool = orthonormal(motion[:, n + 6 :])
        rest.append(motion[:, :n] - tool @ (tool.T @ motion[:, :n]))
    whole = np.concatenate(rest)
    untold = np.flatnonzero(lacking(whole, known.active[:n], known.asked(names)))
    sigma = np.sqrt(3.0 * ((whole @ solved.uncertainty.root[:n]) ** 2).sum() / len(whole))
    missed = np.sqrt(np.nanmean((error**2).sum(axis=-1)))
    if len(untold) or sigma > WEAK * missed:
        depend = f"depend on {name_first([names[i] for i in untold])}, not determined here"
        known_to = f"are known to {1e3 * sigma:.3g} mm by the sigmas alone"
        yield (
            f"other points of the tool {depend if len(untold) else known_to}: the accuracy is that "
            "of the reflector's place; measure one away from the last axis"
        )


def unjudged(data: Measurements, crossed: Array) -> Iterator[str]:
    """Notice of poses that the fit cannot do without, so that none judges them.

    crossed: (m, k, 3) errors by a fit without each pose, NaN where there is none; may be empty.
    """
    if crossed.size:
        lost = data.seen.any(axis=1) & ~np.isfinite(crossed).any(axis=(1, 2))
        if lost.any():
            named = data.list_rows(np.flatnonzero(lost), MAX_NAMED)
            yield (
                f"{data.source}: {lost.sum()} of {data.poses} poses are needed for the fit, so "
                f"that none without them judges them: {named}"
            )


def errors_of(robot: Robot, data: Measurements, solved: Solved) -> Callable[[State, Array], Array]:
    """Errors (r, k, 3) of a state near the solution at some rows of all poses [m].

    data: in the first frame of the fit's sessions (`Cell.placed`).
    """
    every, free = solved.effects.terms, of_sessions(data.frames)
    names, sessions = data.target_names, Sessions.of(data)
    scene = Cell.of(robot, solved.state, names, NOTHING, sessions).scene(data) if every else None
    model = model_of(robot, data)

    def error_of(state: State, rows: Array) -> Array:
        if scene is None:
            return np.asarray(model.take(rows).error(state) @ state.rotation.T)
        terms = free if len(state.effects) == steps_of(data.frames) else every
        effects = fitted(terms, scene, state.effects)
        return Cell.of(robot, state, names, effects, sessions).error(data.take(rows))

    return error_of


def is_crossed(options: Options, held: Measurements) -> bool:
    """Whether to cross-validate: asked for, or few poses are held out."""
    return options.cv or (bool(held.poses) and len(np.unique(clusters(held))) < MIN_HELD_POSES)


def crossed_of(
    robot: Robot, options: Options, data: Measurements, held: Array, solved: Solved
) -> tuple[Array, Array]:
    """Errors (m, k, 3) of every pose by fits without it, of the drawn and the calibrated arm [m].

    Of the drawn one base, targets and frames are fitted without each pose.
    """
    train, names = data.take(~held), data.target_names
    free = np.arange(5 * robot.joints + 6 + 3 * len(names)) >= 5 * robot.joints
    free &= solved.identification.active[: len(free)]
    model, state = refitted(robot, train, solved.nominal, free)
    group, error_of = grouped(data, options.holdout_by), errors_of(robot, data, solved)
    given = held, group, error_of, options.seed, steps_of(data.frames)
    drawn = crossed(Estimator(model, np.ones(len(names))), state, *given)
    return drawn, crossed(solved.estimator, solved.state, *given)


def beyond_of(
    robot: Robot,
    options: Options,
    data: Measurements,
    held: Array,
    solved: Solved,
    suspects: Sequence[Suspect],
) -> Beyond:
    """How the fit does on parts of the poses that it has not seen.

    held: (m,) not of the fit.  Points that stand out judge it, those of the fit too where they are
    left out; beside they are set aside.
    """
    known = not_claimed(robot, data.take(~held))
    if known.narrow:
        return known
    doubted = np.isnan(aside(data.y, data, suspects)).any(axis=-1) & data.seen
    every, free = solved.effects.terms, of_sessions(data.frames)
    geometric = None
    if len(every) > len(free):
        train, names = data.take(~held), data.target_names
        own = slice(5 * robot.joints + 6 + 3 * len(names))
        active, weight = solved.identification.active[own], solved.estimator.model.prior.weight[own]
        model, state = refitted(robot, train, solved.state, active, weight)
        geometric = Estimator(model, np.ones(len(names))), state
    found, error_of = parts(data, options.holdout_by), errors_of(robot, data, solved)
    claim = left_out(
        solved.estimator,
        solved.state,
        ~held,
        found,
        error_of,
        doubted,
        geometric,
        steps_of(data.frames),
    )
    return replace(claim, spans=known.spans)
