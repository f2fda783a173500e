"""How sure the parameters of a fit are, and the positions that it predicts.

An estimator that weighs the errors e of each pose by A is off, to first order, by H^-1 sum J'A e
with H = sum J'A J plus the prior.  What the e do from pose to pose is told in two ways.
`noise_covariance` knows it: covariance s^2 W^-1 + t^2 S S', the instrument's noise and the joints'
jitter, which moves all targets of a pose together (`noise`); the sandwich is H^-1 (sum J'A V A J)
H^-1 [Huber 1967]. `jackknife_covariance_over_poses` asks the poses: what does the fit do without
each of them?  It covers model error too.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from typing import Any, Protocol

import numpy as np
from scipy.special import gammaincinv, stdtrit

from minimax_cal.core.arrays import Array
from minimax_cal.core.errors import CalibrationError, OptionError, describe_file_content_error
from minimax_cal.core.units import file_unit
from minimax_cal.modelling.cell import Cell, build_measurements_at_rest
from minimax_cal.modelling.effects.table import effect_parameter_names_and_units
from minimax_cal.modelling.effects_in_model import build_model_of_cell
from minimax_cal.modelling.error_rows import build_point_rows
from minimax_cal.modelling.parameters import ParameterNames, ParameterValues, joint_zero_indices
from minimax_cal.modelling.point_model import (
    NO_POSE_MIX,
    NormalEquations,
    PointModel,
    PoseBlock,
    with_pose_errors,
)
from minimax_cal.robots import kinematics
from minimax_cal.selection.noise_model import (
    LinearProblem,
    Noise,
    estimate_noise_by_reml,
    identifiable_combinations,
    orthonormal_basis,
)
from minimax_cal.solvers.least_squares import solve_normal_equations

MAX_THINNED_POSES = 1000  # poses that tell all; of more, so many are drawn
MIN_DEGREES_OF_FREEDOM = 3.0  # degrees of freedom that tell two noises apart
# of what all poses tell of a direction, all but one must tell this share
MIN_SHARE_WITHOUT_ONE = 1e-3
# A fit of the worst point rests on a few points: other noise would choose others.  With this share
# of the mean multiplier as the least of any point, `noise_covariance` covers as it should; no
# theory says so, but runs with 30 to 160 poses, one target and three (experiments.coverage shows
# some).
MIN_POINT_WEIGHT = 0.3
POSITION_CHUNK = 2048  # poses whose Jacobian is kept at a time
POSITION_FRAMES = ("measurement", "base")


@dataclass(frozen=True, eq=False)
class Estimator:
    """How a fit weighs its points: min over x of the sum of share_i F_i, and the prior.

    model: with the fit's free parameters, prior and effects; its weights are the instrument's.
    share: (k,) weight of each target besides, or (k, m) of each point where the worst one counts.
    mix: (m, 3k, 3k) as `model.pose_weights` where it weighs poses; empty for plain points.
    """

    model: PointModel
    share: Array
    mix: Array = field(default_factory=lambda: NO_POSE_MIX)

    @cached_property
    def fully_weighted_model(self) -> PointModel:
        """The model with all weights in it: its sum of squares is what the fit made least."""
        if len(self.mix):
            return with_pose_errors(self.model, self.mix)
        share = self.share.reshape(len(self.share), -1)
        return replace(self.model, weight=self.model.weight * share)

    def at_poses(self, rows: Array) -> Estimator:
        """The same on some poses.  rows: indices, possibly repeated."""
        share = self.share if self.share.ndim == 1 else self.share[:, rows]
        mix = self.mix[rows] if len(self.mix) else self.mix
        return Estimator(self.model.take_poses(rows), share, mix)

    def thinned(self, group: Array, most: int) -> tuple[Estimator, Array]:
        """About so many rows at most, whole poses drawn at random; as much less of the prior.

        group: (m,) rows with the same number are one pose.  Returns the rows too.
        """
        m = len(group)
        if m <= most:
            return self, np.arange(m)
        _, member = np.unique(group, return_inverse=True)
        count = int(member.max()) + 1
        chosen = np.random.default_rng(0).permutation(count)[: max(count * most // m, 1)]
        rows = np.flatnonzero(np.isin(member, chosen))
        few, prior = self.at_poses(rows), self.model.prior
        less = replace(prior, weight=prior.weight * len(rows) / m)
        return replace(few, model=few.model.with_prior(less)), rows


def point_weights_from_multipliers(multipliers: Array, is_measured: Array) -> Array:
    """(k, m) weights of the points in a fit of the worst one.

    multipliers: (points,) its multipliers, target by target.  is_measured: (k, m) which points
    there are.
    """
    out = np.zeros(is_measured.shape)
    out[is_measured] = np.maximum(multipliers * np.count_nonzero(is_measured), MIN_POINT_WEIGHT)
    return out


class LinearisedFit(Protocol):
    """A fit at its solution: p free parameters, r coordinates a pose, of m poses."""

    @property
    def error(self) -> Array:
        """(m, r) errors."""

    @property
    def jacobian(self) -> Array:
        """(m, r, p) derivative by the free parameters."""

    @property
    def seen(self) -> Array:
        """(k, m) which points were measured."""

    @property
    def prior(self) -> Array:
        """(p,) weights of a prior."""

    @property
    def prior_deviation(self) -> Array:
        """(p,) how far the parameters are from the prior's mean."""

    def sums_of_poses(self, part: Array) -> tuple[Array, Array]:
        """J'A J (p, p) and J'A e (p,) of some poses, A the weights.  part: mask (m,)."""

    def gram_of_poses(self, part: Array) -> Array:
        """(p, p) J'A J of some poses.  part: mask (m,)."""
        return self.sums_of_poses(part)[0]

    @cached_property
    def sums(self) -> tuple[Array, Array]:
        """`sums_of_poses` all poses."""
        return self.sums_of_poses(np.ones(self.seen.shape[1], dtype=bool))

    @cached_property
    def normal_matrix(self) -> Array:
        """(p, p) normal matrix, the prior in it."""
        return np.asarray(self.sums[0] + np.diag(self.prior))

    @property
    def gradient(self) -> Array:
        """(p,) J'A e of all poses."""
        return self.sums[1]


@dataclass(frozen=True, eq=False)
class RegionSums:
    """Sums over each of some parts of the poses: J'AJ (f, p, p), J'Ae (f, p), e'Ae (f,)."""

    gram: Array
    gradient: Array
    square: Array


@dataclass(frozen=True, eq=False)
class PosewiseFit(LinearisedFit):
    """A linearised fit pose by pose, points in units of the instrument's noise.

    With r = 3k coordinates a pose, of m poses.
    """

    estimator: Estimator
    state: ParameterValues

    @cached_property
    def errors_and_full_jacobian(self) -> tuple[Array, Array]:
        """Errors (m, r) and their slopes by all parameters (m, r, all).

        In axes of the base, or of the instrument where poses are weighed.
        """
        model, (m, _) = self.estimator.model, self.estimator.model.q.shape
        state, everything = (
            self.state,
            np.ones(self.estimator.model.names.parameter_count, dtype=bool),
        )
        block = PoseBlock(
            slice(0, m), kinematics.compute_link_frames(state.mdh, model.q, model.prismatic)
        )
        error, turned = model.block_errors_and_jacobian(state, block, everything)
        if len(self.estimator.mix):
            error, turned = state.rotation @ error, state.rotation @ turned
        return rows_by_pose(error, turned)

    @property
    def error(self) -> Array:
        """(m, r) errors."""
        return self.errors_and_full_jacobian[0]

    @cached_property
    def jacobian(self) -> Array:
        """(m, r, p) derivative by the free parameters."""
        return self.errors_and_full_jacobian[1][..., self.estimator.model.active]

    @cached_property
    def joint_motion(self) -> Array:
        """(m, r, n) motion of the points per unit of each joint."""
        return self.errors_and_full_jacobian[1][
            ..., joint_zero_indices(self.estimator.model.prismatic)
        ]

    @cached_property
    def weighted_jacobian(self) -> Array:
        """(m, r, p) A times `jacobian`."""
        share = self.estimator.share
        if len(self.estimator.mix):
            return np.asarray(self.estimator.mix @ self.jacobian)
        shares = share.reshape(len(share), -1).T
        return np.asarray(np.repeat(shares, 3, axis=1)[..., None] * self.jacobian)

    @cached_property
    def half_weighted_rows(self) -> tuple[Array, Array]:
        """A^(1/2) times the errors (m, r) and slopes (m, r, p), in axes of each pose's own."""
        parts = [
            rows_by_pose(error, rows)
            for _, error, rows in self.estimator.fully_weighted_model.iterate_errors_and_jacobians(
                self.state
            )
        ]
        return np.concatenate([e for e, _ in parts]), np.concatenate([j for _, j in parts])

    @property
    def seen(self) -> Array:
        """(k, m) which points were measured."""
        return self.estimator.model.measured_mask

    @cached_property
    def prior_deviation(self) -> Array:
        """(p,) how far the parameters are from the prior's mean."""
        model = self.estimator.model
        return (model.prior.mean - model.parameter_vector(self.state))[model.active]

    @cached_property
    def prior(self) -> Array:
        """(p,) its weights."""
        return self.estimator.model.prior.weight[self.estimator.model.active]

    @property
    def prior_reference_variance(self) -> Array:
        """(p,) variance beside which a prior was weighed, 0 for a typical coordinate [m^2]."""
        prior, active = self.estimator.model.prior, self.estimator.model.active
        return prior.beside[active] if len(prior.beside) else np.zeros(np.count_nonzero(active))

    @cached_property
    def degrees_of_freedom(self) -> float:
        """Degrees of freedom of the errors: coordinates less parameters that the data pay for."""
        paid = float(
            np.trace(
                solve_normal_equations(self.normal_matrix, self.normal_matrix - np.diag(self.prior))
            )
        )
        return max(3.0 * np.count_nonzero(self.seen) - paid, 1.0)

    @property
    def mean_square(self) -> float:
        """Of a coordinate's error, as a prior was weighed against it in the fit [m^2]."""
        return float(self.estimator.model.target_costs(self.state).sum()) / self.degrees_of_freedom

    @cached_property
    def target_normal_equations(self) -> NormalEquations:
        """Normal equations of each target, without the shares."""
        return self.estimator.model.normal_equations(self.state, self.estimator.model.active)

    @cached_property
    def noise_degrees_of_freedom(self) -> float:
        """Degrees of freedom of the noise: none where the poses do not tell the parameters."""
        gram = self.target_normal_equations.gram.sum(axis=0) + np.diag(self.prior)
        rows = 3 * np.count_nonzero(self.seen) + np.count_nonzero(self.prior)
        return (
            float(rows - len(gram))
            if identifiable_combinations(gram).shape[1] == len(gram)
            else 0.0
        )

    def sums_of_poses(self, part: Array) -> tuple[Array, Array]:
        """J'A J (p, p) and J'A e (p,) of some poses.  part: mask (m,)."""
        share = self.estimator.share
        if part.all() and share.ndim == 1 and not len(self.estimator.mix):
            return np.tensordot(
                share, self.target_normal_equations.gram, 1
            ), share @ self.target_normal_equations.gradient
        whole = self.estimator.fully_weighted_model
        found = (whole if part.all() else whole.take_poses(part)).normal_equations(
            self.state, whole.active
        )
        return found.gram.sum(axis=0), found.gradient.sum(axis=0)

    def sums_by_part(self, parts: Sequence[Array]) -> RegionSums:
        """The sums over each part, the poses linearised once.  parts: masks (m,)."""
        f, p, whole = (
            len(parts),
            int(self.estimator.model.active.sum()),
            self.estimator.fully_weighted_model,
        )
        out = RegionSums(np.zeros((f, p, p)), np.zeros((f, p)), np.zeros(f))
        for rows, *found in whole.iterate_errors_and_jacobians(self.state):
            error, jacobian = rows_by_pose(*found)
            for i, part in enumerate(parts):
                some = part[rows]
                if some.any():
                    e, j = error[some].ravel(), jacobian[some].reshape(-1, p)
                    out.gram[i] += j.T @ j
                    out.gradient[i] += j.T @ e
                    out.square[i] += e @ e
        return out

    @cached_property
    def score(self) -> Array:
        """(m, p) J'A e of each pose."""
        error, jacobian = self.half_weighted_rows
        return np.asarray(np.einsum("mrp,mr->mp", jacobian, error))

    def rows(self) -> LinearProblem:
        """For the estimate of the noises; a prior is some more rows, as noisy as a typical one."""
        m, r, p = self.jacobian.shape
        parts = (
            np.moveaxis(a.reshape(m, r // 3, 3, -1), 0, 3)
            for a in (self.jacobian, self.joint_motion)
        )
        jacobian, arm = (np.moveaxis(part, 2, 0) for part in parts)
        plain = np.moveaxis(self.error.reshape(m, r // 3, 3), 0, 2)
        none = np.zeros((r // 3, 0, 3, m))
        bare = build_point_rows(plain, none, arm, self.seen.astype(float))
        known = np.flatnonzero(self.prior)
        root = np.sqrt(self.prior[known])
        more = np.zeros((len(known), p))
        more[np.arange(len(known)), known] = root
        return LinearProblem(
            error=np.concatenate([bare.error, root * self.prior_deviation[known]]),
            nuisance_basis=orthonormal_basis(
                np.concatenate([bare.rows_from_fields(jacobian), more])
            ),
            variance_ratio=np.concatenate([bare.variance_ratio, np.ones(len(known))]),
            mean_variance_ratio=bare.mean_variance_ratio,
            row_groups=np.concatenate([bare.row_groups, m + np.arange(len(known))]),
            measured=np.concatenate([bare.measured, np.ones(len(known), dtype=bool)]),
            rounding_noise=bare.rounding_noise,
        )


def rows_by_pose(error: Array, rows: Array) -> tuple[Array, Array]:
    """Errors (m, 3k) and Jacobian (m, 3k, p), from errors (k, 3, m) and rows (k, p, 3, m)."""
    k, p, _, m = rows.shape
    jacobian = np.moveaxis(rows, (3, 0, 2, 1), (0, 1, 2, 3)).reshape(m, 3 * k, p)
    return np.moveaxis(error, 2, 0).reshape(m, 3 * k), jacobian


@dataclass(frozen=True, eq=False)
class Uncertainty:
    """What is known about the parameters of a fit.

    names: of all p parameters.  units: of each, SI.  covariance: (p, p), the base's in its own
    axes, NaN where a parameter is not identified.  estimate_noise: looks for `noise`.  dof: degrees
    of freedom of the noise.  source: `poses` or `noise`.
    """

    names: ParameterNames
    units: tuple[str, ...]
    covariance: Array
    estimate_noise: Callable[[], Noise]
    dof: float
    source: str

    @cached_property
    def noise(self) -> Noise:
        """Of a typical coordinate and of the joints; looked for when it is first asked for."""
        return self.estimate_noise()

    @property
    def active(self) -> Array:
        """(p,) True where a parameter is identified."""
        return np.asarray(np.isfinite(np.diag(self.covariance)))

    @property
    def sigma(self) -> Array:
        """(p,) standard deviations [SI]."""
        return np.asarray(np.sqrt(np.maximum(np.diag(self.covariance), 0.0)))

    @property
    def correlation(self) -> Array:
        """(p, p) correlations; NaN where not identified."""
        with np.errstate(invalid="ignore", divide="ignore"):
            return np.asarray(self.covariance / np.outer(self.sigma, self.sigma))

    @property
    def covariance_root(self) -> Array:
        """R (p, r) with RR' the covariance, rows of zeros where not identified."""
        known = np.flatnonzero(self.active)
        sigma = np.where(self.sigma[known] > 0.0, self.sigma[known], 1.0)
        alike = self.covariance[np.ix_(known, known)] / np.outer(sigma, sigma)
        values, vectors = np.linalg.eigh(alike)
        out = np.zeros((self.names.parameter_count, len(known)))
        out[known] = sigma[:, None] * vectors * np.sqrt(np.maximum(values, 0.0))
        return out

    def scale_sigmas(self, factor: float) -> Uncertainty:
        """The same with all sigmas times a factor."""
        return replace(self, covariance=factor**2 * self.covariance)

    def to_dict(self) -> dict[str, Any]:
        """For JSON: the identified parameters, lengths in millimetres."""
        known = np.flatnonzero(self.active)
        scale = file_scales(self.units)[known]
        rows = self.covariance[np.ix_(known, known)] * np.outer(scale, scale)
        names = self.names.all_names
        return {
            "names": [names[i] for i in known],
            "units": [file_unit(self.units[i])[1] for i in known],
            "rows": rows.tolist(),
            "source": self.source,
            "degrees_of_freedom": self.dof,
            "noise_mm": 1e3 * float(np.sqrt(self.noise.variance)),
            "jitter_rad": self.noise.joint_jitter,
            "jitter_ratio": self.noise.joint_to_instrument_ratio,
        }


def student_quantile(level: float, dof: float) -> float:
    """Student's two-sided quantile.  dof: degrees of freedom, at least one counts."""
    return float(stdtrit(max(dof, 1.0), 0.5 + 0.5 * level))


def file_scales(units: tuple[str, ...]) -> Array:
    """(p,) what a parameter is multiplied by in JSON: 1e3 for lengths."""
    return np.array([file_unit(unit)[0] for unit in units])


def estimate_fit_noise(estimator: Estimator, state: ParameterValues) -> Noise:
    """Instrument's noise and joints' jitter by `noise.estimate_noise_by_reml`.

    The instrument's alone where the poses do not determine the parameters.
    """
    poses = PosewiseFit(estimator, state)
    rows, dof = poses.rows(), poses.noise_degrees_of_freedom
    if dof >= MIN_DEGREES_OF_FREEDOM:
        return estimate_noise_by_reml(rows, np.zeros((len(rows.error), 0)))
    left = rows.error - rows.nuisance_basis @ (rows.nuisance_basis.T @ rows.error)
    return Noise(0.0, float(left @ left) / max(dof, 1.0), 0.0)


def noise_covariance(poses: PosewiseFit, noise: Noise) -> Array:
    """H^-1 F H^-1 with F = sum J'A (s^2 + t^2 S S') A J: (p, p) of the free parameters [SI]."""
    weighted = poses.weighted_jacobian.reshape(-1, poses.weighted_jacobian.shape[-1])
    swing = np.swapaxes(poses.weighted_jacobian, -1, -2) @ poses.joint_motion
    score_covariance = noise.variance * weighted.T @ weighted
    score_covariance += noise.joint_jitter**2 * np.einsum(
        "mpn,mqn->pq", swing, swing, optimize=True
    )
    return sandwich_covariance(poses, score_covariance)


def jackknife_covariance_over_poses(poses: PosewiseFit, pose_groups: Array) -> Array:
    """The jackknife over poses: (p, p) of the free parameters [SI].

    (M-1)/M sum d d' with d = (H - J'AJ)^-1 J'A e, the change that leaving out one of M poses makes:
    the cluster-robust sandwich CR3 [Bell and McCaffrey 2002].  With C = H^-1, K = A^(1/2) J and L =
    K C K' it is C K' (1 - L)^-1 A^(1/2) e.  pose_groups: (m,) rows with the same number are one
    pose. NaN where the fit needs one of the poses.
    """
    member, sizes = np.unique(pose_groups, return_inverse=True, return_counts=True)[1:]
    order = np.argsort(member.reshape(-1), kind="stable")
    count, p = len(sizes), len(poses.normal_matrix)
    cover, ends = solve_normal_equations(poses.normal_matrix, np.eye(p)), np.cumsum(sizes)
    total = np.zeros((p, p))
    for size in np.unique(sizes):  # groups of as many rows at once
        rows = order[(ends[sizes == size] - size)[:, None] + np.arange(size)]
        error, jacobian = (part[rows] for part in poses.half_weighted_rows)
        jacobian = jacobian.reshape(len(rows), -1, p)
        back = jacobian @ cover
        lever = back @ np.swapaxes(jacobian, 1, 2)
        eye = np.eye(lever.shape[1])
        try:  # no eigenvalue is as large as 1 - ALONE
            np.linalg.cholesky((1.0 - MIN_SHARE_WITHOUT_ONE) * eye - lever)
        except np.linalg.LinAlgError:
            return np.full((p, p), np.nan)
        left = np.linalg.solve(eye - lever, error.reshape(len(rows), -1, 1))
        change = (np.swapaxes(back, 1, 2) @ left)[..., 0]
        total += change.T @ change
    prior = sandwich_covariance(poses, np.zeros((p, p))) if poses.prior.any() else 0.0
    return np.asarray((count - 1) / count * total + prior)


def sandwich_covariance(poses: PosewiseFit, score_covariance: Array) -> Array:
    """H^-1 F H^-1.  A prior is rows as noisy as what it was weighed beside."""
    if poses.prior.any():
        variance = np.where(
            poses.prior_reference_variance > 0.0, poses.prior_reference_variance, poses.mean_square
        )
        score_covariance = score_covariance + np.diag(variance * poses.prior)
    half = solve_normal_equations(poses.normal_matrix, score_covariance)
    return np.asarray(solve_normal_equations(poses.normal_matrix, half.T))


def estimate_uncertainty(
    estimator: Estimator, state: ParameterValues, pose_groups: Array, units: tuple[str, ...] = ()
) -> Uncertainty:
    """What is known about the parameters of a fit, given its solution.

    `jackknife_covariance_over_poses` where the fit needs none of its poses, for it covers as well
    as `noise_covariance` where the noises are all there is, and better where they are not
    (experiments.coverage).  Not for a fit of the worst point, which always needs a few.
    pose_groups: (m,) as `data.groups`.  units: of effects.
    """
    few, rows = estimator.thinned(pose_groups, MAX_THINNED_POSES)
    poses = PosewiseFit(few, state)
    dof = poses.noise_degrees_of_freedom
    found, source = np.full(poses.normal_matrix.shape, np.nan), "poses"
    if dof >= 1.0 and estimator.share.ndim == 1:
        found = jackknife_covariance_over_poses(poses, pose_groups[rows])
    if dof >= 1.0 and np.isnan(found).any():
        found, source = noise_covariance(poses, estimate_fit_noise(few, state)), "noise"
    names, active = few.model.names, few.model.active
    covariance = np.full((names.parameter_count,) * 2, np.nan)
    covariance[np.ix_(active, active)] = 0.5 * (found + found.T) * len(rows) / len(pose_groups)
    own = names.units[: names.geometric_count]
    listen = partial(estimate_fit_noise, few, state)
    return Uncertainty(names, (*own, *units), covariance, listen, dof, source)


# ---- positions -------------------------------------------------------------------------------


def position_covariance_factor(
    cell: Cell, known: Uncertainty, q: Array, frame: str, *, jitter: bool = False
) -> Array:
    """F (m, k, 3, r) with FF' the covariance of positions; columns are the same for all targets.

    So that the mean over the targets is the factor of their centroid's.
    q: (m, n) joints as the controller gives them [rad, m].  jitter: whether to add that of the
    joints at a new pose.  frame: `measurement`, where the instrument will see the targets, in its
    axes: base, links and targets all enter, and which of several redundant parameters were kept
    does not matter.  `base`, where they are in the robot's base frame, in its axes: links and
    targets enter, the base's pose does not.  Where a link parameter repeats the base (d1, theta1)
    and is not identified, the base frame is the one in which it is nominal.  Raises OptionError.
    """
    if frame not in POSITION_FRAMES:
        raise OptionError(f"no frame {frame!r}; choose {' or '.join(POSITION_FRAMES)}")
    model, state = build_model_of_cell(cell, q)
    n = model.names.joints
    jacobian = model.point_jacobian(state)
    if frame == "measurement":
        jacobian = state.rotation @ jacobian
    root = known.covariance_root
    if frame == "base":
        root[5 * n : 5 * n + 6] = 0.0
    factor = jacobian @ root
    if not jitter:
        return np.asarray(factor)
    joints = joint_zero_indices(model.prismatic)
    return np.concatenate([factor, known.noise.joint_jitter * jacobian[..., joints]], axis=-1)


def position_confidence_radius(covariance: Array, level: float = 0.95) -> Array:
    """Radius about the prediction that holds a share of the positions: (...) [m].

    covariance: (..., 3, 3) [m^2].  The squared distance is taken for a gamma variable of its mean
    and variance [Welch 1938, Satterthwaite 1946]: exact where one direction or all three are alike.
    """
    mean = np.trace(covariance, axis1=-2, axis2=-1)
    square = np.einsum("...ij,...ij->...", covariance, covariance)
    spread = np.where(mean > 0.0, square / np.where(mean > 0.0, mean, 1.0), 0.0)
    dof = np.where(square > 0.0, mean**2 / np.where(square > 0.0, square, 1.0), 1.0)
    return np.asarray(np.sqrt(spread * 2.0 * gammaincinv(0.5 * dof, level)))


# ---- saved fits ------------------------------------------------------------------------------


def uncertainty_from_dict(content: Mapping[str, Any], cell: Cell, source: str) -> Uncertainty:
    """From the JSON of a calibration: its key `covariance`.  Raises CalibrationError."""
    if "covariance" not in content:
        raise CalibrationError(
            f"{source}: does not hold a covariance; write it again with minimax-cal calibrate"
        )
    nowhere = cell.pose_arm(
        build_measurements_at_rest(np.zeros((1, cell.robot.joints)), cell.target_names, cell.robot)
    )
    effects, own = effect_parameter_names_and_units(cell.effects.terms, nowhere)
    names = ParameterNames.for_robot(cell.robot, cell.target_names, effects)
    units = (*names.units[: names.geometric_count], *own)
    try:
        part = content["covariance"]
        place = np.array([names.index_of_name(str(name)) for name in part["names"]], dtype=int)
        rows = np.array(part["rows"], dtype=float).reshape(len(place), len(place))
        ratio, jitter = float(part["jitter_ratio"]), float(part["jitter_rad"])
        noise = partial(Noise, ratio, (1e-3 * float(part["noise_mm"])) ** 2, jitter)
        dof, kind = float(part["degrees_of_freedom"]), str(part["source"])
    except (KeyError, TypeError, ValueError) as error:
        raise CalibrationError(
            f"{source}: its covariance does not fit its robot and targets "
            f"({describe_file_content_error(error)})"
        ) from error
    if not np.isfinite(rows).all() or np.any(np.diag(rows) < 0.0) or np.any(rows != rows.T):
        raise CalibrationError(f"{source}: its covariance is no symmetric matrix of numbers")
    scale = file_scales(units)[place]
    covariance = np.full((names.parameter_count,) * 2, np.nan)
    covariance[np.ix_(place, place)] = rows / np.outer(scale, scale)
    return Uncertainty(names, units, covariance, noise, dof, kind)
