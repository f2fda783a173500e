"""How sure a calibration is, by calibrating again on poses drawn from those measured.

Poses are drawn with replacement, all rows of a pose together [Davison and Hinkley 1997, sec. 6.2.4:
cases], and each fit starts at the solution.  A sum of squares takes two Gauss-Newton steps from
there, the first of all replicates at once; a minimax is solved again.  Nothing is assumed about the
errors but that poses are independent.  The poses left out of a replicate judge it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from minimax_cal.fitting.accuracy import Interval
from minimax_cal.fitting.fit import Fit
from minimax_cal.fitting.minimax_problem import measured_distances, minimax_problem
from minimax_cal.fitting.options import Progress, silent, solver_of
from minimax_cal.fitting.solve import QP_TOLERANCE
from minimax_cal.ground.arrays import Array
from minimax_cal.ground.errors import DataError, OptionError
from minimax_cal.ground.facts import scaled
from minimax_cal.ground.files import plain
from minimax_cal.ground.options import check_seed
from minimax_cal.ground.stages import count_stage
from minimax_cal.ground.tables import Table, records_of
from minimax_cal.ground.units import for_people, in_files
from minimax_cal.modelling.joint_fit import model_at
from minimax_cal.modelling.model import Model, SumOfSquares, with_poses
from minimax_cal.modelling.parameters import State, links_of
from minimax_cal.robots.kinematics import rotation_vector
from minimax_cal.solvers import minimax
from minimax_cal.solvers.iterate import NO_MULTIPLIERS
from minimax_cal.solvers.least_squares import solve_normal
from minimax_cal.solvers.minimax import Sqp
from minimax_cal.solvers.status import Status

BUNDLES = 2000  # more poses than these are drawn in bundles
MIN_DRAWN_SHARE = 1e-3  # of what all poses tell of some direction, those drawn must tell as much
MAX_REPLICATES = 100_000  # replicates: of 2000 poses their draws fill 1.6 GB
MOST_LOST = 0.5  # of the replicates
BATCH = 64  # replicates whose Gram matrices are kept at a time
PACE = 25  # replicates between two words on progress


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
        return np.asarray(self.value[:, None] + percentiles(self.change, level).T)

    def positions(self, q: Array) -> Array:
        """(B, m, k, 3) where each replicate expects the instrument to see each target [m].

        To first order about the fit.  q: (m, n) joints as the controller gives them [rad, m].
        """
        model, state = model_at(self.fit.cell, q)
        jacobian = state.rotation @ model.jacobian(state)
        return np.asarray(
            self.fit.predict(q) + np.einsum("mkcp,bp->bmkc", jacobian[..., self.place], self.change)
        )

    def position_interval(self, q: Array, level: float = 0.95) -> Array:
        """(2, m, k, 3) percentiles of each coordinate of the predicted positions [m]."""
        return percentiles(self.positions(q), level)

    def rms_interval(self, level: float = 0.95) -> Interval:
        """Percentiles of the RMS distance on poses that a replicate has not seen [m].

        Somewhat too large: a replicate has seen fewer poses than the fit.
        """
        known = self.out_of_bag[np.isfinite(self.out_of_bag)]
        low, high = percentiles(known, level) if len(known) else (np.nan, np.nan)
        return Interval(float(low), float(high))

    def table(self, level: float = 0.95) -> Table:
        """Every parameter with its percentiles, in mm, mrad, or the effect's own unit."""
        rows: list[tuple[object, ...]] = []
        for i, (low, high) in enumerate(self.interval(level)):
            one, (scale, unit) = self.fit.parameters[self.names[i]], for_people(self.units[i])
            start = one.nominal if one.corrects else 0.0
            numbers = (self.value[i] - start, self.sigma[i], low - start, high - start)
            rows.append((one.title, unit, *scaled(numbers, scale)))
        title = f"{len(self.change)} calibrations of resampled poses: {100.0 * level:g} % intervals"
        columns = "name | unit | value .5g | sigma .5g | low .5g | high .5g"
        return Table.made(title, rows, columns)

    def to_dict(self, level: float = 0.95) -> dict[str, Any]:
        """For JSON, lengths in millimetres."""
        scale = np.array([in_files(unit)[0] for unit in self.units])
        unit, rms = [in_files(unit)[1] for unit in self.units], self.rms_interval(level)
        ends = self.interval(level) * scale[:, None]
        columns = {"name": self.names, "unit": unit, "sigma": self.sigma * scale, "interval": ends}
        whole = {
            "replicates": len(self.change),
            "lost": self.lost,
            "level": level,
            "parameters": records_of(columns),
            "out_of_bag_rms_mm": None if np.isnan(rms.low) else [*scaled(rms, 1e3)],
        }
        return dict(plain(whole))


def percentiles(values: Array, level: float) -> Array:
    """(2, ...) the ends of the middle share of values (B, ...)."""
    return np.asarray(np.quantile(values, (0.5 - 0.5 * level, 0.5 + 0.5 * level), axis=0))


def bootstrap(
    fit: Fit, replicates: int = 500, seed: int = 0, progress: Progress = silent
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
    draws = draw(fit.group, replicates, np.random.default_rng(seed))
    change, good = (solved_again if fit.minimax else stepped)(fit, draws, progress)
    # a robust loss would weigh each draw anew, and so give way more than with weights that are kept
    change = change * fit.widening
    lost = replicates - int(np.count_nonzero(good))
    if lost > MOST_LOST * replicates:
        raise DataError(
            f"{fit.data.source}: {lost} of {replicates} draws of {draws.times.shape[1]} poses do "
            f"not determine the {change.shape[1]} parameters; measure more poses"
        )
    place = np.flatnonzero(fit.identification.active)
    names = fit.estimator.model.names.all
    chosen = [fit.parameters[names[i]] for i in place]
    return Bootstrap(
        fit=fit,
        names=tuple(p.name for p in chosen),
        units=tuple(p.unit for p in chosen),
        value=np.array([p.value for p in chosen]),
        change=change[good],
        place=place,
        out_of_bag=unseen(fit, change[good], draws, good),
        lost=lost,
    )


@dataclass(frozen=True, eq=False)
class Draws:
    """times: (B, M) how often each pose is drawn.  member: (m,) the pose of each row."""

    times: Array
    member: Array

    def rows(self, number: int) -> Array:
        """(m,) how often each row is drawn in one replicate."""
        return np.asarray(self.times[number][self.member])


def draw(group: Array, replicates: int, rng: np.random.Generator) -> Draws:
    """Poses drawn with replacement.  group: (m,) rows with the same number are one pose."""
    _, member = np.unique(group, return_inverse=True)
    member = member % BUNDLES
    count = int(member.max()) + 1
    return Draws(rng.multinomial(count, np.full(count, 1.0 / count), size=replicates), member)


def stepped(fit: Fit, draws: Draws, progress: Progress) -> tuple[Array, Array]:
    """Replicates of a sum of squares: two Gauss-Newton steps from the fit.

    The first takes all at once, since each row's part of the normal equations is the same for all.
    Returns the changes (B, p) of the free parameters, and (B,) True where the draws determine them.
    """
    estimator, state = fit.estimator, fit.cell.state
    model = estimator.model.emphasise(estimator.share)
    model = with_poses(model, estimator.mix) if len(estimator.mix) else model
    part, gradient = normal_parts(model, state, draws)
    prior = model.prior.weight[model.active]
    off = (model.prior.mean - model.values(state))[model.active]
    good = determined(draws, part, prior)
    gram = np.tensordot(draws.times[good], part, 1) + np.diag(prior)
    change = np.zeros((len(good), len(prior)))
    change[good] = solve_normal(gram, (draws.times[good] @ gradient + prior * off)[..., None])[
        ..., 0
    ]
    for done, number in enumerate(np.flatnonzero(good).tolist()):
        if done % PACE == 0:
            progress(count_stage("replicate", number + 1, len(good)))
        problem = SumOfSquares(replace(model, weight=model.weight * draws.rows(number)))
        x = problem.step(state, change[number])
        _, gradient, gram = problem.normal(x)
        x = problem.step(x, solve_normal(gram, gradient[:, None])[:, 0])
        change[number] = between(state, x)[model.active]
    return change, good


def solved_again(fit: Fit, draws: Draws, progress: Progress) -> tuple[Array, Array]:
    """Replicates of a minimax, each solved from the fit.  Returns as `stepped`."""
    options, estimator, state, train = fit.options, fit.estimator, fit.cell.state, fit.train
    qp, _ = solver_of(options.qp, QP_TOLERANCE)
    settings, active = Sqp(hessian=options.hessian), estimator.model.active
    mu = fit.minimax.multiplier if fit.minimax else NO_MULTIPLIERS
    part, _ = normal_parts(estimator.model, state, draws)
    good = determined(draws, part, estimator.model.prior.weight[active])
    change = np.zeros((len(good), int(active.sum())))
    for done, number in enumerate(np.flatnonzero(good).tolist()):
        if done % PACE == 0:
            progress(count_stage("replicate", number + 1, len(good)))
        rows = np.repeat(np.arange(len(draws.member)), draws.rows(number))
        model = estimator.at(rows).model
        distances = measured_distances(train.take(rows), options.distance_tolerance)
        problem = minimax_problem(model, state, distances, options.distance, "target")
        best = minimax.solve(problem, state, qp, settings, mu=mu)
        good[number] = best.status is Status.CONVERGED
        change[number] = between(state, best.x)[active]
    return change, good


def normal_parts(model: Model, state: State, draws: Draws) -> tuple[Array, Array]:
    """What each pose adds to Gram matrix (M, p, p) and gradient (M, p) of the free parameters."""
    count, p = draws.times.shape[1], int(model.active.sum())
    gram, gradient = np.zeros((count, p, p)), np.zeros((count, p))
    for block in model.blocks(state):
        error, turned = model.weighted_rows(state, block, model.active)
        jacobian = np.moveaxis(turned, (3, 1), (0, 1)).reshape(error.shape[-1], p, -1)
        own = draws.member[block.rows]
        np.add.at(gram, own, jacobian @ np.swapaxes(jacobian, 1, 2))
        flat = np.moveaxis(error, 2, 0).reshape(len(jacobian), -1, 1)
        np.add.at(gradient, own, (jacobian @ flat)[..., 0])
    return gram, gradient


def determined(draws: Draws, gram: Array, prior: Array) -> Array:
    """(B,) True where a draw tells every direction a share LEAST as well as all poses do."""
    root = np.linalg.inv(np.linalg.cholesky(gram.sum(axis=0) + np.diag(prior)))
    alike = root @ gram @ root.T
    known = root @ np.diag(prior) @ root.T
    out = np.zeros(len(draws.times), dtype=bool)
    for first in range(0, len(out), BATCH):
        part = np.tensordot(draws.times[first : first + BATCH], alike, 1) + known
        out[first : first + BATCH] = np.linalg.eigvalsh(part)[:, 0] > MIN_DRAWN_SHARE
    return out


def between(start: State, end: State) -> Array:
    """(p,) the step that takes one state to another."""
    turn = rotation_vector(start.rotation.T @ end.rotation)
    return np.concatenate(
        [
            links_of(end.mdh - start.mdh),
            start.rotation.T @ (end.origin - start.origin),
            turn,
            (end.target_positions - start.target_positions).reshape(-1),
            end.effects - start.effects,
        ]
    )


def unseen(fit: Fit, change: Array, draws: Draws, good: Array) -> Array:
    """(B,) RMS distance of each replicate on the poses that it has not seen, to first order [m]."""
    model, state = fit.estimator.model, fit.cell.state
    error = np.nan_to_num(model.error(state))
    jacobian = model.jacobian(state)[..., model.active]
    out = np.full(len(change), np.nan)
    for i, number in enumerate(np.flatnonzero(good).tolist()):
        left = draws.rows(number) == 0
        seen = model.seen.T[left]
        if seen.any():
            square = ((error[left] - jacobian[left] @ change[i]) ** 2).sum(axis=-1)
            out[i] = np.sqrt(square[seen].mean())
    return out
