"""Least-squares fit of an arm's geometry: start, identifiable parameters, priors of a drawing."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np

from minimax_cal.core.arrays import Array
from minimax_cal.core.display_text import format_first_names
from minimax_cal.core.errors import OptionError
from minimax_cal.fitting import identification
from minimax_cal.fitting.coaxial_axes import (
    build_offset_trial,
    find_coaxial_joints,
    identification_with_offset,
    is_offset_significant,
)
from minimax_cal.fitting.data_slips import MAX_CALIBRATION_ERROR_OF_REACH
from minimax_cal.fitting.identification import MAX_NAMED_PARAMETERS, Identification, ReasonKind
from minimax_cal.fitting.options import (
    ONLY_OFFSETS,
    Options,
    Progress,
    parse_objective_target,
    prior_sigmas,
    select_freed_parameters,
)
from minimax_cal.fitting.robust_fit import RobustFit, fit_robust_loss
from minimax_cal.fitting.session_frames import count_frame_parameters
from minimax_cal.measuring import measurement_checks
from minimax_cal.measuring.measurements import Measurements
from minimax_cal.measuring.pose_groups import group_repeated_poses
from minimax_cal.modelling import global_start
from minimax_cal.modelling.effects.table import Term
from minimax_cal.modelling.global_start import BaseFit
from minimax_cal.modelling.nearby_fit import fit_within_bounds_from_start
from minimax_cal.modelling.parameters import ParameterValues, joint_zero_indices
from minimax_cal.modelling.point_model import PointLeastSquares, PointModel, build_point_model
from minimax_cal.robots.robot import Robot
from minimax_cal.solvers.least_squares import LeastSquaresSolution, solve_normal_equations

# With smr:K the other targets follow the geometry without pulling at it: a weight that is nothing
# beside 1, but leaves their own coordinates determined.
FOLLOWING_WEIGHT = 1e-9
MAX_PRIOR_ROUNDS = 20  # of weighing a prior against the noise that remains
MIN_VARIANCE_CHANGE = 0.01  # relative; a smaller one ends these rounds
MIN_NOISE = 5e-6  # of a coordinate, when a fit with priors leaves no residual to judge by [m]
MIN_TARGET_POSES = 3  # of a target in the fit; with fewer its own position explains all
MAX_SEARCHED_COST_RATIO = 0.99  # a fit of the search that costs less is a better one
# of the cost: a fit that holds the drawing and leaves more than its inverse contradicts the drawing
MAX_REMAINING_COST = 0.5
# times the drawing's uncertainty, or as many times a usual link's: of a larger sigma the poses
# hardly determine a link
MAX_UNCERTAINTY_RATIO = 10.0


@dataclass(frozen=True, eq=False)
class FitTask:
    """What is fitted, and which parameters the user wants.

    model: (p parameters) of geometry at the training poses.  start: base and targets that fit the
    nominal geometry best.  reference: the model at plenty of poses, which separate what no pose
    could determine.  target_weights: (k,).  allowed: (p,) False for parameters that stay nominal.
    drop_order: (p,) indices, those to give up first at the front.  prior_sigma: (p,) [SI], inf for
    none.
    """

    robot: Robot
    data: Measurements
    options: Options
    model: PointModel
    start: BaseFit
    reference: PointModel
    target_weights: Array
    allowed: Array
    drop_order: Array
    prior_sigma: Array

    @property
    def fitted_targets(self) -> Array:
        """(k,) True for targets that determine the geometry, False for those that follow it."""
        return self.target_weights > FOLLOWING_WEIGHT

    def count_coordinates(self, model: PointModel) -> float:
        """Coordinates measured; of a target that follows the three that place it."""
        fitted = self.fitted_targets
        return 3.0 * float(model.pose_counts_by_target[fitted].sum() + (~fitted).sum())

    def identify_parameters(
        self, model: PointModel, state: ParameterValues, offsets: Iterable[int] = ()
    ) -> Identification:
        """The parameters that the poses determine; those of effects are given up first.

        offsets: indices of parameters by which coaxial axes are fitted apart: these stay.
        """
        count, effect_count = self.model.names.parameter_count, len(model.fields)
        has_prior = np.isfinite(self.prior_sigma)
        has_prior[[*offsets]] = True
        return identification.identify_point_parameters(
            model,
            state,
            np.concatenate([np.arange(count, count + effect_count), self.drop_order]),
            is_allowed=np.pad(self.allowed, (0, effect_count), constant_values=True),
            reference_model=self.reference,
            has_prior=np.concatenate([has_prior, model.prior.weight[count:] > 0.0]),
            resolution=self.options.resolution,
        )

    def fit_least_squares(
        self, model: PointModel, begin: ParameterValues
    ) -> tuple[PointModel, LeastSquaresSolution[ParameterValues]]:
        """Least squares of the free parameters; priors are weighed against the noise that remains.

        Returns the model with the priors' weights, and the fit.
        """
        sigma, effect_weight = self.prior_sigma, model.prior.weight[len(self.prior_sigma) :]
        if not np.isfinite(sigma).any():
            return model, fit_within_bounds_from_start(model, begin, self.options.method)
        points = float(model.pose_counts_by_target[self.fitted_targets].sum())
        following = 3.0 * (~self.fitted_targets).sum()
        variance = self.start.mean_square / 3.0
        for _ in range(MAX_PRIOR_ROUNDS):
            weight = np.concatenate([variance / sigma**2, effect_weight])
            model = model.with_prior(replace(model.prior, weight=weight))
            fit = fit_within_bounds_from_start(model, begin, self.options.method)
            state = fit.x.take(np.array(0))

            # Degrees of freedom: numbers measured less those that the data pay for parameters,
            # tr(H^-1 G) of their Gram matrix G within the whole H.
            _, _, gram = PointLeastSquares(model).normal(state)
            of_data = gram - np.diag(weight[model.active])
            paid = np.trace(solve_normal_equations(gram, of_data)) - following
            last_variance = variance
            dof = max(3.0 * points - paid, 1.0)
            variance = max(float(model.target_costs(state).sum()) / dof, MIN_NOISE**2)
            if abs(variance - last_variance) <= MIN_VARIANCE_CHANGE * last_variance:
                break
        return model, fit

    def fit_robustly(
        self, model: PointModel, fit: LeastSquaresSolution[ParameterValues]
    ) -> RobustFit:
        """The fit with the loss and the trimming that were asked for, from that of all points."""
        line, options = self.data.line, self.options
        return fit_robust_loss(
            self.fit_least_squares, model, fit, line, options.loss, options.trim,
            is_judged=self.fitted_targets,
        )  # fmt: skip


@dataclass(frozen=True, eq=False)
class ParameterFit:
    """A least-squares fit of the identifiable parameters.

    terms: effects in its model.  offsets: indices of parameters by which coaxial axes are apart.
    """

    identification: Identification
    robust: RobustFit
    terms: tuple[Term, ...] = ()
    notices: tuple[str, ...] = ()
    offsets: tuple[int, ...] = ()

    @property
    def cost(self) -> float:
        """Weighted sum of squares [m^2]."""
        return float(self.robust.least_squares.cost[0])


def start_fit(
    robot: Robot,
    data: Measurements,
    options: Options,
    base_rotation: Array = global_start.NO_BASE_ROTATION,
) -> FitTask:
    """Where a fit starts, and what it may fit, with poses enough for its unknowns.

    base_rotation: (3, 3) as of `global_start.fit_base_and_targets`.  Raises OptionError, DataError.
    """
    model, target_count = build_point_model(robot, data), len(data.target_names)
    names, target = model.names, parse_objective_target(options.objective, data)

    # What the user asked of the parameters.
    allowed = ~names.match_patterns(options.fix, "fix")
    if options.only == ONLY_OFFSETS:
        zeros = np.isin(np.arange(names.parameter_count), joint_zero_indices(robot.prismatic))
        allowed &= zeros | ~names.link_mask
    is_freed = select_freed_parameters(names, options.free, allowed)
    order = identification.redundancy_drop_order(robot, names)
    order = np.concatenate([order[~is_freed[order]], order[is_freed[order]]])
    sigma = prior_sigmas(names, options.priors, "base and targets")

    # Poses of the targets of the objective against what plenty of poses would determine.
    reference = identification.build_reference_model(robot, model)
    unknowns = identification.count_generic_parameters(
        robot, reference, order, allowed
    ) + count_frame_parameters(data.frames)
    weights, fitted = np.ones(target_count), data
    if target >= 0:
        fitted = data.only(target)
        unknowns -= 3 * (target_count - 1)  # the others follow
        weights = np.where(np.arange(target_count) == target, 1.0, FOLLOWING_WEIGHT)
    poses, prior_count = (
        len(np.unique(group_repeated_poses(fitted))),
        int(np.isfinite(sigma[allowed]).sum()),
    )
    measurement_checks.check_pose_count(fitted, poses, unknowns, prior_count)
    if options.objective == "pose":
        if target_count < MIN_TARGET_POSES or measurement_checks.has_collinear_targets(data):
            raise OptionError("objective pose needs three targets that are not on a line")
        whole = int(data.seen.all(axis=1).sum())
        if whole < MIN_TARGET_POSES:
            raise OptionError("objective pose needs poses at which all targets were measured; "
                              f"there are {whole}")  # fmt: skip

    base = global_start.fit_base_and_targets(model, robot.mdh, base_rotation)
    return FitTask(robot, data, options, model, base, reference, weights, allowed, order, sigma)


def fit_geometry(task: FitTask, progress: Progress, *, with_search: bool = True) -> ParameterFit:
    """Least squares of the geometry's identifiable parameters.

    with_search: whether base rotations are searched where the fit from the drawing is poor.
    """
    # The largest set of parameters whose Gram matrix has full rank, in an order of preference.
    progress("identifiable parameters")
    robot, begin = task.robot, task.start.state
    model = task.model.with_target_weights(task.target_weights)
    identification = task.identify_parameters(model, begin)

    # Gauss-Newton, separable or joint [paper S], then the loss and the trimming.
    progress("least squares")
    robust = task.fit_robustly(
        *task.fit_least_squares(model.with_active(identification.active), begin)
    )

    # Gross errors of the angles: a search over base rotations.  What counts is how the points that
    # kept their weights fit: a few outliers are no reason to search.
    notices: tuple[str, ...] = ()
    limit, points = (
        MAX_CALIBRATION_ERROR_OF_REACH * robot.reach(),
        float(robust.model.pose_counts_by_target.sum()),
    )
    error = float(np.sqrt(robust.least_squares.cost[0] / points))
    if with_search and not error <= limit:
        progress("search over base rotations")
        searched = global_start.search_base_rotations(robust.model, robot.mdh, points, limit)
        better = searched.cost[0] < MAX_SEARCHED_COST_RATIO * robust.least_squares.cost[0]
        if better:
            error = float(np.sqrt(searched.cost[0] / points))
            notices += ("the nominal angles are far off; a search over base rotations found this "
                        "fit",)  # fmt: skip
            robust = task.fit_robustly(robust.unweighted_model, searched)
        if error > limit:
            notices += (
                f"the best fit still misses by {1e3 * error:.3g} mm: check joint signs, units "
                "and the link lengths in the robot file",
            )

    # Axes that are drawn coaxial: apart in any direction, if the poses show it by an F test.
    fit = ParameterFit(identification, robust, notices=notices)
    for joint in find_coaxial_joints(robot):
        fit = separate_coaxial_axes(task, fit, joint)
    return fit


def separate_coaxial_axes(task: FitTask, fit: ParameterFit, joint: int) -> ParameterFit:
    """The fit with a joint's axis and the next apart in any direction, if the poses show it."""
    robust, model, known = (
        fit.robust,
        task.model.with_target_weights(task.target_weights),
        fit.identification,
    )
    trial = build_offset_trial(
        task.robot, robust.state, joint, known.active, task.allowed, task.drop_order,
        lambda state: identification.full_gram_matrix(task.reference, state),
    )  # fmt: skip
    if trial is None:
        return fit
    _, apart = task.fit_least_squares(robust.model.with_active(trial.is_free), trial.begin)
    dof = task.count_coordinates(robust.model) - float(trial.is_free.sum())
    if not is_offset_significant(robust.least_squares.cost[0], apart.cost[0], trial.is_added, dof):
        return fit
    begin = apart.x.take(np.array(0))
    separated = task.fit_least_squares(robust.unweighted_model.with_active(trial.is_free), begin)
    return replace(
        fit,
        identification=identification_with_offset(
            known,
            model.names,
            trial,
            identification.full_gram_matrix(model, begin),
            model.names.target_names,
            identification.ALL_TARGETS_TEXT,
        ),
        robust=task.fit_robustly(*separated),
        offsets=(*fit.offsets, *(int(i) for i in np.flatnonzero(trial.is_added))),
    )


def add_nominal_priors(
    task: FitTask, fit: ParameterFit, progress: Progress
) -> tuple[FitTask, ParameterFit]:
    """The fit in which the drawing, as a prior, holds the links that the poses hardly determine.

    Where the sigma of a link, by the poses alone, is many times the drawing's, the drawing is a
    prior of all that it knows better: noise moves such links together, however far.  Not where
    all sigmas are as large, nor where the drawing contradicts the data: as of another arm.
    """
    robot, names, model = task.robot, task.model.names, fit.robust.model
    active = model.active

    # How well the drawing knows each link.  Of coaxial axes only the sum of angles is drawn.
    drawn_sigma = np.full(names.parameter_count, np.inf)
    drawn_sigma[names.link_mask] = np.repeat(robot.drawn_within, np.array([2, 3]) * names.joints)
    begin = task.start.state
    for joint in find_coaxial_joints(robot) if fit.offsets else ():
        drawn_sigma[2 * names.joints + np.array([joint, joint + 1])] = np.inf
        mdh = begin.mdh.copy()
        mdh[joint, 0] = fit.robust.state.mdh[joint, 0]
        begin = replace(begin, mdh=mdh)

    # Sigmas by the poses alone, at the drawing too, since the fit may have gone astray.
    dof = task.count_coordinates(model) - active.sum()
    variance, ratio = fit.cost / max(dof, 1.0), np.zeros(names.parameter_count)
    for state in (begin, fit.robust.state):
        gram = PointLeastSquares(model).normal(state)[2]
        covariance = variance * np.diag(solve_normal_equations(gram, np.eye(len(gram))))
        sigma = np.sqrt(np.maximum(covariance, 0.0))
        ratio[active] = np.maximum(ratio[active], sigma / drawn_sigma[active])
    usual = max(float(np.median(ratio[active & names.link_mask])), 1.0) if ratio.any() else 1.0
    vague = (ratio > MAX_UNCERTAINTY_RATIO * usual) & np.isinf(task.prior_sigma)
    if robot.rough or not vague.any():
        return task, fit

    # Fit again with priors; near the drawing its base is the best of all.
    reasons = fit.identification.reasons
    undetermined = [name for name, why in reasons.items() if why.kind is ReasonKind.NOT_TOLD]
    better_drawn = (ratio > usual) | np.isin(names.all_names, undetermined)
    sigma = np.where(better_drawn, np.minimum(task.prior_sigma, drawn_sigma), task.prior_sigma)
    held_task = replace(task, prior_sigma=sigma)
    held = fit_geometry(held_task, progress, with_search=False)
    if fit.cost < MAX_REMAINING_COST * held.cost:
        return task, fit  # the drawing contradicts the data
    vague_names = format_first_names(
        [names.all_names[i] for i in np.flatnonzero(vague)], MAX_NAMED_PARAMETERS
    )
    length, angle = 1e3 * np.array(robot.drawn_within)
    notice = (
        f"these poses hardly determine {vague_names}: the drawing holds them, to {length:g} mm and "
        f"{angle:g} mrad (drawn_within of the robot); move all joints farther"
    )
    return held_task, replace(held, notices=(*held.notices, notice))
