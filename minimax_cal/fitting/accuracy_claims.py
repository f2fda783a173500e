"""What a fit may claim: how it does on poses it has not seen, and whether it is one at all."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from types import MappingProxyType
from typing import TYPE_CHECKING

import numpy as np

from minimax_cal.core.arrays import Array
from minimax_cal.core.display_text import format_first_names
from minimax_cal.fitting.cell_fit import CellFit
from minimax_cal.fitting.cross_validation import MIN_HELD_POSES, cross_validate
from minimax_cal.fitting.options import Options, prior_sigmas
from minimax_cal.fitting.outliers import Outlier, list_held_out_outliers, mask_outliers
from minimax_cal.fitting.region_holdout import (
    RegionHoldout,
    check_joint_spans,
    judge_left_out_regions,
)
from minimax_cal.fitting.session_frames import count_frame_parameters
from minimax_cal.fitting.uncertainty import Estimator
from minimax_cal.instruments.instrument import RANDOM_POSE_COUNT, build_random_poses
from minimax_cal.instruments.protocol import (
    EffectMotion,
    FlangeKinematics,
    FlangePoses,
    ResidualRows,
    flange_corners,
    slopes_by_arm_parameters,
)
from minimax_cal.measuring.measurements import Measurements
from minimax_cal.measuring.pose_groups import cluster_poses, group_for_holdout, list_holdout_regions
from minimax_cal.measuring.session_frames import SessionFrames
from minimax_cal.modelling.cell import Cell, build_measurements_at_rest
from minimax_cal.modelling.effects.scene import PosedArm
from minimax_cal.modelling.effects.table import NO_EFFECTS, session_frame_terms
from minimax_cal.modelling.effects_in_model import (
    extend_model_with_effects,
    fit_geometry_nearby,
    split_values_by_effect,
)
from minimax_cal.modelling.error_rows import lack_of_fit_motions_by_pose
from minimax_cal.modelling.parameters import ParameterNames, ParameterValues, joint_zero_indices
from minimax_cal.modelling.point_model import build_point_model
from minimax_cal.robots.kinematics import skew_matrix
from minimax_cal.robots.robot import Robot
from minimax_cal.selection.noise_model import orthonormal_basis

if TYPE_CHECKING:
    from minimax_cal.fitting.multi_instrument.laws import InstrumentLaws

DEFAULT_TOOL_POINT = np.array([0.0, 0.0, 0.1])  # a point beside the last axes, in the flange [m]
MIN_COLUMN_RATIO = (
    1e-4  # of the largest column: positions that a parameter moves by less depend on it no more
)
NO_LAW_VALUES: Array = np.zeros(0)
NO_LACK_MOTION: Array = np.zeros((0, 0))
NO_PRIORS: Mapping[str, float] = MappingProxyType({})


def random_position_sigma(
    robot: Robot,
    mdh: Array,
    target_positions: Array,
    covariance: Array,
    laws: InstrumentLaws | None = None,
    values: Array = NO_LAW_VALUES,
    lack_motion: Array = NO_LACK_MOTION,
    lack_moment: Array = NO_LACK_MOTION,
) -> float:
    """RMS of a position's standard deviation at random poses [m].

    Arguments as of `random_position_jacobian`.  covariance: (p, p), NaN where not identified.
    lack_motion: (p, c) how far each factor of the lack of fit moves the parameters, whose
    covariance is then without it; lack_moment: (c, c) mean of the factors' products.  Without them,
    by the parameters alone.
    """
    known = np.isfinite(np.diag(covariance))
    known[5 * robot.joints : 5 * robot.joints + 6] = False  # the base, fitted again
    jacobian, lack = random_position_jacobian(robot, mdh, target_positions, laws, values), 0.0
    if lack_motion.size:
        turned = (
            random_position_motion_by_lack(robot, mdh, target_positions)
            - jacobian[:, known] @ lack_motion[known]
        )
        lack = float(np.sum((turned @ lack_moment) * turned))
    # by its square root: where much is known badly, rounding would make the sum itself negative
    spread, axes = np.linalg.eigh(covariance[np.ix_(known, known)])
    root = jacobian[:, known] @ (axes * np.sqrt(np.maximum(spread, 0.0)))
    return float(np.sqrt(3.0 * ((root**2).sum() + lack) / len(jacobian)))


def select_missing_parameters(jacobian: Array, is_identified: Array, is_asked: Array) -> Array:
    """(p,) the fewest of the parameters asked for with which all of them would be determined.

    Those that move positions as no others together do.  jacobian: (r, p) as
    `random_position_jacobian`. is_identified: (p,) the identified parameters.
    """
    size = np.linalg.norm(jacobian, axis=0)
    waiting = is_asked & ~is_identified & (size > MIN_COLUMN_RATIO * size.max())
    known, out = is_identified.copy(), np.zeros_like(is_identified)
    while waiting.any():
        basis = orthonormal_basis(jacobian[:, known])
        rest = np.linalg.norm(jacobian - basis @ (basis.T @ jacobian), axis=0)
        waiting &= ~known & (rest > MIN_COLUMN_RATIO * size.max())
        share = np.where(waiting, rest / np.maximum(size, 1e-300), 0.0)
        if waiting.any():
            most = int(np.argmax(share))
            known[most] = out[most] = True
    return out


def random_position_jacobian(
    robot: Robot,
    mdh: Array,
    target_positions: Array,
    laws: InstrumentLaws | None = None,
    law_values: Array = NO_LAW_VALUES,
) -> Array:
    """(3 m, p) motion of the targets' centroid at random poses per unit of each parameter.

    But for the best rigid motion of all positions: a base is fitted wherever an arm is put to work.
    mdh: (n, 5).  target_positions: (k, 3) targets on the flange, none where a tool is fitted there
    too [m]. The parameters are links, a base, the targets and the laws, with values (d,).
    """
    at = build_measurements_at_rest(build_random_poses(robot, RANDOM_POSE_COUNT).q, (), robot)
    spot = target_positions.mean(axis=0) if len(target_positions) else DEFAULT_TOOL_POINT
    arm, frame = FlangeKinematics.from_robot(robot, at.q), (np.eye(3), np.zeros(3))
    if laws and laws.terms:
        scene = PosedArm.at_measured_poses(
            robot.with_mdh(mdh), at, frame, flange_corners(spot), arm.q
        )
        arm = replace(
            arm,
            given=EffectMotion.from_corner_motions(
                arm.compute_flange_poses(mdh),
                spot,
                *laws.displacement_fields(scene, law_values),
                law_values,
            ),
        )
    flange = arm.compute_flange_poses(
        mdh, law_values, np.ones(5 * len(mdh) + len(law_values), dtype=bool)
    )
    point, pose = (
        np.repeat(flange.place(spot), 3, axis=0),
        np.repeat(np.arange(RANDOM_POSE_COUNT), 3),
    )
    axes, none = np.tile(np.eye(3), (RANDOM_POSE_COUNT, 1)), np.zeros((len(pose), 3))
    by = slopes_by_arm_parameters(
        flange, ResidualRows(none[:, 0], pose, point, axes, none, none[:, :0])
    ).T
    target = flange.rotation.reshape(-1, 3) / max(len(target_positions), 1)
    links, bends = np.split(by, [5 * len(mdh)], axis=1)
    jacobian = np.hstack([links, np.zeros((len(by), 6)), *[target] * len(target_positions), bends])
    return project_out_rigid_motion(jacobian, arm.compute_flange_poses(mdh), target_positions)


def project_out_rigid_motion(motion: Array, flange: FlangePoses, target_positions: Array) -> Array:
    """(3 m, p) motion of a point without the best rigid motion of all its positions.

    Where no target is known on the flange, without what another point of the tool does either.
    """
    spot = target_positions.mean(axis=0) if len(target_positions) else DEFAULT_TOOL_POINT
    stiff = flange.place(spot)
    stiff = stiff - stiff.mean(axis=0)
    rigid = np.concatenate([np.tile(np.eye(3), (len(stiff), 1, 1)), -skew_matrix(stiff)], axis=2)
    target = flange.rotation.reshape(-1, 3)
    basis = orthonormal_basis(
        np.hstack([rigid.reshape(-1, 6), *[target] * (not len(target_positions))])
    )
    return np.asarray(motion - basis @ (basis.T @ motion))


def random_position_motion_by_lack(robot: Robot, mdh: Array, target_positions: Array) -> Array:
    """(3 m, c) as `random_position_jacobian`, per factor of each function of the pose
    (`rows.lack_of_fit_motions_by_pose`).
    """
    at, zeros = build_random_poses(robot, RANDOM_POSE_COUNT), joint_zero_indices(robot.prismatic)
    arm, spot = (
        FlangeKinematics.from_robot(robot, at.q),
        target_positions.mean(axis=0) if len(target_positions) else DEFAULT_TOOL_POINT,
    )
    flange = arm.compute_flange_poses(mdh, NO_LAW_VALUES, np.isin(np.arange(5 * len(mdh)), zeros))
    point = flange.place(spot)
    by_joint = flange.linear + np.cross(flange.angular, point - flange.origin)  # (n, m, 3)
    by_joint = by_joint[np.argsort(np.argsort(zeros))]
    motion, _ = lack_of_fit_motions_by_pose(
        robot.with_mdh(mdh), arm.q, np.moveaxis(by_joint, 0, -1)
    )
    return project_out_rigid_motion(
        motion.reshape(3 * RANDOM_POSE_COUNT, -1), arm.compute_flange_poses(mdh), target_positions
    )


def nominal_link_sigmas(robot: Robot, priors: Mapping[str, float] = NO_PRIORS) -> Array:
    """(5n,) how well the links of a drawing are known: by `drawn_within`, or by a prior [SI]."""
    within = np.repeat(robot.drawn_within, np.array([2, 3]) * robot.joints)
    told = prior_sigmas(ParameterNames.for_robot(robot, ()), priors, "")[: len(within)]
    return np.where(np.isfinite(told), told, within)


def position_sigmas_of_both_arms(
    robot: Robot, solved: CellFit, nominal_sigmas: Array
) -> tuple[float, float]:
    """RMS by which positions of the calibrated and of the drawn arm are known, by
    `random_position_sigma`.

    nominal_sigmas: (5n,) sigmas of the drawing.  Of the drawn one the links that were adopted
    count.  NaN where no sigma is known [m].
    """
    spots, sure = solved.state.target_positions, solved.uncertainty.covariance
    count = 5 * robot.joints + 6 + spots.size
    links, active = slice(5 * robot.joints), solved.identification.active[:count]
    if not np.isfinite(np.diag(sure)[:count][active]).all():
        return np.nan, np.nan
    drawn = np.full((count, count), np.nan)
    drawn[links, links] = np.diag(nominal_sigmas**2)
    drawn[~active] = drawn[:, ~active] = np.nan
    return (
        random_position_sigma(robot, solved.state.mdh, spots, sure[:count, :count]),
        random_position_sigma(robot, robot.mdh, spots, drawn),
    )


# ---- what is claimed -----------------------------------------------------------------------------


MAX_NAMED_CLAIM_POSES = 5  # poses that a notice names
MAX_SIGMA_TO_ERROR_RATIO = (
    3.0  # times what the reflectors miss by: points that are known worse are weakly told
)


def find_held_out_outliers(
    robot: Robot, data: Measurements, is_held: Array, solved: CellFit
) -> tuple[Outlier, ...]:
    """The held-out points that stand out.  is_held: (m,)."""
    model, state = build_point_model(robot, data), solved.state
    if solved.effects.terms:
        model, state = extend_model_with_effects(model, robot, data, state, solved.effects.terms)
    weights = np.zeros(model.weight.shape)
    weights[:, ~is_held] = solved.robust.weights
    model = model.with_active(solved.identification.active).with_prior(solved.estimator.model.prior)
    spread = solved.robust.scores_and_spread[1]
    return list_held_out_outliers(model, state, weights, is_held, spread, data.line)


def warn_of_uncertain_tool_points(
    robot: Robot, solved: CellFit, point_errors: Array
) -> Iterator[str]:
    """Notice where other points of the tool are known far worse than these targets.

    A tool's offset is measured wherever it is put to work, as a base is.  point_errors: (m, k, 3)
    [m].
    """
    known, n, spots = solved.identification, 5 * robot.joints, solved.state.target_positions
    if len(spots) > 2:  # they tell the whole flange
        return
    names = solved.names.all_names[:n]
    rest = []
    for spot in flange_corners(spots.mean(axis=0)):
        motion = random_position_jacobian(robot, solved.state.mdh, spot[None])
        tool = orthonormal_basis(motion[:, n + 6 :])
        rest.append(motion[:, :n] - tool @ (tool.T @ motion[:, :n]))
    whole = np.concatenate(rest)
    untold = np.flatnonzero(
        select_missing_parameters(whole, known.active[:n], known.is_not_fixed(names))
    )
    sigma = np.sqrt(
        3.0 * ((whole @ solved.uncertainty.covariance_root[:n]) ** 2).sum() / len(whole)
    )
    missed = np.sqrt(np.nanmean((point_errors**2).sum(axis=-1)))
    if len(untold) or sigma > MAX_SIGMA_TO_ERROR_RATIO * missed:
        depend = f"depend on {format_first_names([names[i] for i in untold])}, not determined here"
        known_to = f"are known to {1e3 * sigma:.3g} mm by the sigmas alone"
        yield (
            f"other points of the tool {depend if len(untold) else known_to}: the accuracy is that "
            "of the reflector's place; measure one away from the last axis"
        )


def warn_of_unjudged_poses(data: Measurements, cross_validated_errors: Array) -> Iterator[str]:
    """Notice of poses that the fit cannot do without, so that none judges them.

    cross_validated_errors: (m, k, 3) errors by a fit without each pose, NaN where there is none;
    may be empty.
    """
    if cross_validated_errors.size:
        lost = data.seen.any(axis=1) & ~np.isfinite(cross_validated_errors).any(axis=(1, 2))
        if lost.any():
            named = data.format_row_names(np.flatnonzero(lost), MAX_NAMED_CLAIM_POSES)
            yield (
                f"{data.source}: {lost.sum()} of {data.poses} poses are needed for the fit, so "
                f"that none without them judges them: {named}"
            )


def build_error_function(
    robot: Robot, data: Measurements, solved: CellFit
) -> Callable[[ParameterValues, Array], Array]:
    """Errors (r, k, 3) of a state near the solution at some rows of all poses [m].

    data: in the first frame of the fit's sessions (`Cell.placed`).
    """
    every, free = solved.effects.terms, session_frame_terms(data.frames)
    names, sessions = data.target_names, SessionFrames.from_measurements(data)
    scene = (
        Cell.from_parameters(robot, solved.state, names, NO_EFFECTS, sessions).pose_arm(data)
        if every
        else None
    )
    model = build_point_model(robot, data)

    def error_of(state: ParameterValues, rows: Array) -> Array:
        if scene is None:
            return np.asarray(model.take_poses(rows).point_errors(state) @ state.rotation.T)
        terms = free if len(state.effects) == count_frame_parameters(data.frames) else every
        effects = split_values_by_effect(terms, scene, state.effects)
        return Cell.from_parameters(robot, state, names, effects, sessions).error(data.take(rows))

    return error_of


def needs_cross_validation(options: Options, held_out_data: Measurements) -> bool:
    """Whether to cross-validate: asked for, or few poses are held out."""
    return options.cv or (
        bool(held_out_data.poses) and len(np.unique(cluster_poses(held_out_data))) < MIN_HELD_POSES
    )


def cross_validate_both_arms(
    robot: Robot, options: Options, data: Measurements, is_held: Array, solved: CellFit
) -> tuple[Array, Array]:
    """Errors (m, k, 3) of every pose by fits without it, of the drawn and the calibrated arm [m].

    Of the drawn one base, targets and frames are fitted without each pose.
    """
    train, names = data.take(~is_held), data.target_names
    free = np.arange(5 * robot.joints + 6 + 3 * len(names)) >= 5 * robot.joints
    free &= solved.identification.active[: len(free)]
    model, state = fit_geometry_nearby(robot, train, solved.nominal, free)
    group, error_of = (
        group_for_holdout(data, options.holdout_by),
        build_error_function(robot, data, solved),
    )
    given = is_held, group, error_of, options.seed, count_frame_parameters(data.frames)
    drawn = cross_validate(Estimator(model, np.ones(len(names))), state, *given)
    return drawn, cross_validate(solved.estimator, solved.state, *given)


def judge_outside_measured_region(
    robot: Robot,
    options: Options,
    data: Measurements,
    is_held: Array,
    solved: CellFit,
    suspects: Sequence[Outlier],
) -> RegionHoldout:
    """How the fit does on parts of the poses that it has not seen.

    is_held: (m,) not of the fit.  Points that stand out judge it, those of the fit too where they
    are left out; beside they are set aside.
    """
    known = check_joint_spans(robot, data.take(~is_held))
    if known.narrow_spans:
        return known
    doubted = np.isnan(mask_outliers(data.y, data, suspects)).any(axis=-1) & data.seen
    every, free = solved.effects.terms, session_frame_terms(data.frames)
    geometric = None
    if len(every) > len(free):
        train, names = data.take(~is_held), data.target_names
        own = slice(5 * robot.joints + 6 + 3 * len(names))
        active, weight = solved.identification.active[own], solved.estimator.model.prior.weight[own]
        model, state = fit_geometry_nearby(robot, train, solved.state, active, weight)
        geometric = Estimator(model, np.ones(len(names))), state
    found, error_of = (
        list_holdout_regions(data, options.holdout_by),
        build_error_function(robot, data, solved),
    )
    claim = judge_left_out_regions(
        solved.estimator,
        solved.state,
        ~is_held,
        found,
        error_of,
        doubted,
        geometric,
        count_frame_parameters(data.frames),
    )
    return replace(claim, spans=known.spans)
