"""How sure a calibration is, by calibrating again on poses drawn from those measured.

Poses are drawn with replacement, all rows of a pose together [Davison and Hinkley 1997, sec. 6.2.4:
cases], and each fit starts at the solution.  A sum of squares takes two Gauss-Newton steps from
there, the first of all replicates at once; a minimax is solved again.  Nothing is assumed about the
errors but that poses are independent.  The poses left out of a replicate judge it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from minimax_cal.core.arrays import Array
from minimax_cal.core.errors import DataError, OptionError
from minimax_cal.core.files import convert_to_plain_json
from minimax_cal.core.option_fields import check_seed
from minimax_cal.core.progress_stages import build_counted_stage
from minimax_cal.core.record_fields import scale_numbers
from minimax_cal.core.tables import Table, columns_to_records
from minimax_cal.core.units import display_unit_of_change, file_unit
from minimax_cal.fitting.accuracy import Interval
from minimax_cal.fitting.cell_fit import FIT_QP_TOLERANCE
from minimax_cal.fitting.fit import Fit
from minimax_cal.fitting.minimax_problem import build_minimax_problem, measured_distances
from minimax_cal.fitting.options import Progress, build_qp_solver, silent_progress
from minimax_cal.modelling.effects_in_model import build_model_of_cell
from minimax_cal.modelling.parameters import ParameterValues, flatten_link_parameters
from minimax_cal.modelling.point_model import PointLeastSquares, PointModel, with_pose_errors
from minimax_cal.robots.kinematics import rotation_to_vector
from minimax_cal.solvers import minimax
from minimax_cal.solvers.iterate import NO_MULTIPLIERS
from minimax_cal.solvers.least_squares import solve_normal_equations
from minimax_cal.solvers.minimax import Sqp
from minimax_cal.solvers.status import Status

MIN_BUNDLED_REPLICATES = 2000  # more poses than these are drawn in bundles
MIN_DRAWN_INFORMATION_FRACTION = (
    1e-3  # of what all poses tell of some direction, those drawn must tell as much
)
MAX_REPLICATES = 100_000  # replicates: of 2000 poses their draws fill 1.6 GB
MAX_LOST_FRACTION = 0.5  # of the replicates
REPLICATES_PER_BATCH = 64  # replicates whose Gram matrices are kept at a time
REPLICATES_PER_PROGRESS = 25  # replicates between two words on progress


@dataclass(frozen=True, eq=False)
class Bootstrap:
    """Calibrations of poses drawn anew.

    fit: of the poses as measured.  names, units, value: of the p identified parameters [SI].
    change: (B, p) from the fit to each replicate, the base's along its own axes [SI].
    place: (p,) of each among all parameters.  out_of_bag: (B,) RMS distance on the poses that were
    not drawn, NaN without any [m].  lost: replicates whose poses did not determine the parameters,
    or whose solver did not end well.
    """

    fit: Fit
    names: tuple[str, ...]
    units: tuple[str, ...]
    value: Array
    change: Array
    place: Array
    out_of_bag: Array
    lost: int

    @property
    def sigma(self) -> Array:
        """(p,) standard deviation over the replicates [SI]."""
        return np.asarray(self.change.std(axis=0, ddof=1))

    def interval(self, level: float = 0.95) -> Array:
        """(p, 2) percentiles of each parameter [SI]."""
        return np.asarray(self.value[:, None] + percentile_interval(self.change, level).T)

    def predict_positions(self, q: Array) -> Array:
        """(B, m, k, 3) where each replicate expects the instrument to see each target [m].

        To first order about the fit.  q: (m, n) joints as the controller gives them [rad, m].
        """
        model, state = build_model_of_cell(self.fit.cell, q)
        jacobian = state.rotation @ model.point_jacobian(state)
        return np.asarray(
            self.fit.predict(q) + np.einsum("mkcp,bp->bmkc", jacobian[..., self.place], self.change)
        )

    def position_interval(self, q: Array, level: float = 0.95) -> Array:
        """(2, m, k, 3) percentiles of each coordinate of the predicted positions [m]."""
        return percentile_interval(self.predict_positions(q), level)

    def rms_interval(self, level: float = 0.95) -> Interval:
        """Percentiles of the RMS distance on poses that a replicate has not seen [m].

        Somewhat too large: a replicate has seen fewer poses than the fit.
        """
        known = self.out_of_bag[np.isfinite(self.out_of_bag)]
        low, high = percentile_interval(known, level) if len(known) else (np.nan, np.nan)
        return Interval(float(low), float(high))

    def table(self, level: float = 0.95) -> Table:
        """Every parameter with its percentiles, in mm, mrad, or the effect's own unit."""
        rows: list[tuple[object, ...]] = []
        for i, (low, high) in enumerate(self.interval(level)):
            one, (scale, unit) = (
                self.fit.parameters[self.names[i]],
                display_unit_of_change(self.units[i]),
            )
            start = one.nominal if one.corrected_quantity else 0.0
            numbers = (self.value[i] - start, self.sigma[i], low - start, high - start)
            rows.append((one.title, unit, *scale_numbers(numbers, scale)))
        title = f"{len(self.change)} calibrations of resampled poses: {100.0 * level:g} % intervals"
        columns = "name | unit | value .5g | sigma .5g | low .5g | high .5g"
        return Table.from_rows(title, rows, columns)

    def to_dict(self, level: float = 0.95) -> dict[str, Any]:
        """For JSON, lengths in millimetres."""
        scale = np.array([file_unit(unit)[0] for unit in self.units])
        unit, rms = [file_unit(unit)[1] for unit in self.units], self.rms_interval(level)
        ends = self.interval(level) * scale[:, None]
        columns = {"name": self.names, "unit": unit, "sigma": self.sigma * scale, "interval": ends}
        whole = {
            "replicates": len(self.change),
            "lost": self.lost,
            "level": level,
            "parameters": columns_to_records(columns),
            "out_of_bag_rms_mm": None if np.isnan(rms.low) else [*scale_numbers(rms, 1e3)],
        }
        return dict(convert_to_plain_json(whole))


def percentile_interval(values: Array, level: float) -> Array:
    """(2, ...) the ends of the middle share of values (B, ...)."""
    return np.asarray(np.quantile(values, (0.5 - 0.5 * level, 0.5 + 0.5 * level), axis=0))


def bootstrap(
    fit: Fit, replicates: int = 500, seed: int = 0, progress: Progress = silent_progress
) -> Bootstrap:
    """Calibrate again on poses drawn from the training poses.

    Parameters
    ----------
    fit
        Of any objective but point.
    replicates
        Draws of whole poses.
    seed
        Of the draws.
    progress
        Called with a word on progress.

    Returns
    -------
    Bootstrap
        Intervals of every parameter.

    Raises
    ------
    OptionError
        For wrong input.
    DataError
        Where most draws do not determine the parameters.

    Examples
    --------
    >>> print(mc.bootstrap(fit, replicates=200).table().text())
    """
    if not 2 <= replicates <= MAX_REPLICATES:
        raise OptionError(f"{replicates} replicates: give 2 to {MAX_REPLICATES}, 500 as a rule")
    check_seed(seed)
    if fit.objective == "point":
        raise OptionError(
            "objective point depends on the few worst points, which a bootstrap cannot resample; "
            "choose sum, minimax, pose or smr:K"
        )
    draws = draw_poses(fit.group, replicates, np.random.default_rng(seed))
    change, good = (refit_minimax_replicates if fit.minimax else refit_by_gauss_newton_steps)(
        fit, draws, progress
    )
    # a robust loss would weigh each draw anew, and so give way more than with weights that are kept
    change = change * fit.widening
    lost = replicates - int(np.count_nonzero(good))
    if lost > MAX_LOST_FRACTION * replicates:
        raise DataError(
            f"{fit.data.source}: {lost} of {replicates} draws of {draws.draw_counts.shape[1]} "
            f"poses do not determine the {change.shape[1]} parameters; measure more poses"
        )
    place = np.flatnonzero(fit.identification.active)
    names = fit.estimator.model.names.all_names
    chosen = [fit.parameters[names[i]] for i in place]
    return Bootstrap(
        fit=fit,
        names=tuple(p.name for p in chosen),
        units=tuple(p.unit for p in chosen),
        value=np.array([p.value for p in chosen]),
        change=change[good],
        place=place,
        out_of_bag=out_of_bag_rms(fit, change[good], draws, good),
        lost=lost,
    )


@dataclass(frozen=True, eq=False)
class PoseDraws:
    """draw_counts: (B, M) how often each pose is drawn.  pose_of_row: (m,) the pose of each row."""

    draw_counts: Array
    pose_of_row: Array

    def draw_counts_of_rows(self, replicate: int) -> Array:
        """(m,) how often each row is drawn in one replicate."""
        return np.asarray(self.draw_counts[replicate][self.pose_of_row])


def draw_poses(pose_groups: Array, replicates: int, rng: np.random.Generator) -> PoseDraws:
    """Poses drawn with replacement.  pose_groups: (m,) rows with the same number are one pose."""
    _, member = np.unique(pose_groups, return_inverse=True)
    member = member % MIN_BUNDLED_REPLICATES
    count = int(member.max()) + 1
    return PoseDraws(rng.multinomial(count, np.full(count, 1.0 / count), size=replicates), member)


class BootstrapReplicates(NamedTuple):
    """Changes (B, p) of the free parameters, and (B,) True where a replicate is one."""

    change: Array
    is_usable: Array


def refit_by_gauss_newton_steps(
    fit: Fit, draws: PoseDraws, progress: Progress
) -> BootstrapReplicates:
    """Replicates of a sum of squares: two Gauss-Newton steps from the fit.

    The first takes all at once, since each row's part of the normal equations is the same for all.
    Returns the changes (B, p) of the free parameters, and (B,) True where the draws determine them.
    """
    estimator, state = fit.estimator, fit.cell.parameter_values
    model = estimator.model.with_target_weights(estimator.share)
    model = with_pose_errors(model, estimator.mix) if len(estimator.mix) else model
    part, gradient = normal_equations_by_pose(model, state, draws)
    prior = model.prior.weight[model.active]
    off = (model.prior.mean - model.parameter_vector(state))[model.active]
    good = is_draw_determined(draws, part, prior)
    gram = np.tensordot(draws.draw_counts[good], part, 1) + np.diag(prior)
    change = np.zeros((len(good), len(prior)))
    change[good] = solve_normal_equations(
        gram, (draws.draw_counts[good] @ gradient + prior * off)[..., None]
    )[..., 0]
    for done, number in enumerate(np.flatnonzero(good).tolist()):
        if done % REPLICATES_PER_PROGRESS == 0:
            progress(build_counted_stage("replicate", number + 1, len(good)))
        problem = PointLeastSquares(
            replace(model, weight=model.weight * draws.draw_counts_of_rows(number))
        )
        x = problem.step(state, change[number])
        _, gradient, gram = problem.normal(x)
        x = problem.step(x, solve_normal_equations(gram, gradient[:, None])[:, 0])
        change[number] = parameter_step(state, x)[model.active]
    return BootstrapReplicates(change, good)


def refit_minimax_replicates(fit: Fit, draws: PoseDraws, progress: Progress) -> BootstrapReplicates:
    """Replicates of a minimax, each solved from the fit.  Returns as
    `refit_by_gauss_newton_steps`.
    """
    options, estimator, state, train = (
        fit.options,
        fit.estimator,
        fit.cell.parameter_values,
        fit.train,
    )
    qp, _ = build_qp_solver(options.qp, FIT_QP_TOLERANCE)
    settings, active = Sqp(hessian=options.hessian), estimator.model.active
    mu = fit.minimax.multiplier if fit.minimax else NO_MULTIPLIERS
    part, _ = normal_equations_by_pose(estimator.model, state, draws)
    good = is_draw_determined(draws, part, estimator.model.prior.weight[active])
    change = np.zeros((len(good), int(active.sum())))
    for done, number in enumerate(np.flatnonzero(good).tolist()):
        if done % REPLICATES_PER_PROGRESS == 0:
            progress(build_counted_stage("replicate", number + 1, len(good)))
        rows = np.repeat(np.arange(len(draws.pose_of_row)), draws.draw_counts_of_rows(number))
        model = estimator.at_poses(rows).model
        distances = measured_distances(train.take(rows), options.distance_tolerance)
        problem = build_minimax_problem(model, state, distances, options.distance, "target")
        best = minimax.solve(problem, state, qp, settings, mu=mu)
        good[number] = best.status is Status.CONVERGED
        change[number] = parameter_step(state, best.x)[active]
    return BootstrapReplicates(change, good)


class PoseNormalEquations(NamedTuple):
    """What each pose adds to the Gram matrix (M, p, p) and the gradient (M, p)."""

    gram: Array
    gradient: Array


def normal_equations_by_pose(
    model: PointModel, state: ParameterValues, draws: PoseDraws
) -> PoseNormalEquations:
    """What each pose adds to Gram matrix (M, p, p) and gradient (M, p) of the free parameters."""
    count, p = draws.draw_counts.shape[1], int(model.active.sum())
    gram, gradient = np.zeros((count, p, p)), np.zeros((count, p))
    for block in model.split_into_blocks(state):
        error, turned = model.block_errors_and_jacobian(state, block, model.active)
        jacobian = np.moveaxis(turned, (3, 1), (0, 1)).reshape(error.shape[-1], p, -1)
        own = draws.pose_of_row[block.rows]
        np.add.at(gram, own, jacobian @ np.swapaxes(jacobian, 1, 2))
        flat = np.moveaxis(error, 2, 0).reshape(len(jacobian), -1, 1)
        np.add.at(gradient, own, (jacobian @ flat)[..., 0])
    return PoseNormalEquations(gram, gradient)


def is_draw_determined(draws: PoseDraws, gram: Array, prior: Array) -> Array:
    """(B,) True where a draw tells every direction a share LEAST as well as all poses do."""
    root = np.linalg.inv(np.linalg.cholesky(gram.sum(axis=0) + np.diag(prior)))
    alike = root @ gram @ root.T
    known = root @ np.diag(prior) @ root.T
    out = np.zeros(len(draws.draw_counts), dtype=bool)
    for first in range(0, len(out), REPLICATES_PER_BATCH):
        part = (
            np.tensordot(draws.draw_counts[first : first + REPLICATES_PER_BATCH], alike, 1) + known
        )
        out[first : first + REPLICATES_PER_BATCH] = (
            np.linalg.eigvalsh(part)[:, 0] > MIN_DRAWN_INFORMATION_FRACTION
        )
    return out


def parameter_step(start: ParameterValues, end: ParameterValues) -> Array:
    """(p,) the step that takes one state to another."""
    turn = rotation_to_vector(start.rotation.T @ end.rotation)
    return np.concatenate(
        [
            flatten_link_parameters(end.mdh - start.mdh),
            start.rotation.T @ (end.origin - start.origin),
            turn,
            (end.target_positions - start.target_positions).reshape(-1),
            end.effects - start.effects,
        ]
    )


def out_of_bag_rms(fit: Fit, change: Array, draws: PoseDraws, is_determined: Array) -> Array:
    """(B,) RMS distance of each replicate on the poses that it has not seen, to first order [m]."""
    model, state = fit.estimator.model, fit.cell.parameter_values
    error = np.nan_to_num(model.point_errors(state))
    jacobian = model.point_jacobian(state)[..., model.active]
    out = np.full(len(change), np.nan)
    for i, number in enumerate(np.flatnonzero(is_determined).tolist()):
        left = draws.draw_counts_of_rows(number) == 0
        seen = model.measured_mask.T[left]
        if seen.any():
            square = ((error[left] - jacobian[left] @ change[i]) ** 2).sum(axis=-1)
            out[i] = np.sqrt(square[seen].mean())
    return out
