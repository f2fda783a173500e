"""Whether all points are longer or shorter by one factor than errors of links would have them.

After the fit, by how its lengths changed: all by one share, beyond what its angles let expect, and
beyond what smooth functions of the pose that the fit lacks would make of it.

Before the fit, by the drawn arm alone: errors e of its points are A x + c s + noise, A the links'
columns and c that of a scale, both without what base and targets take.  Links are off by what arms
are, times an unknown factor; the evidence for s is the gain in marginal likelihood over s = 0.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.special import stdtr

from minimax_cal.core.arrays import Array
from minimax_cal.measuring.measurements import Measurements
from minimax_cal.modelling.error_rows import lack_of_fit_motions_by_pose
from minimax_cal.modelling.nearby_fit import fit_within_bounds_from_start
from minimax_cal.modelling.parameters import (
    ParameterValues,
    flatten_link_parameters,
    joint_zero_indices,
)
from minimax_cal.modelling.point_model import PointModel, build_point_model
from minimax_cal.robots import kinematics
from minimax_cal.robots.robot import Robot
from minimax_cal.selection.noise_model import fit_variance_components

OFF_LENGTH, OFF_ANGLE = 0.3e-3, 0.5e-3  # how well arms are drawn; times FACTORS [m, rad]
MIN_SCALE_ERROR = 7e-4  # a smaller common factor may be the warmth of the arm: aluminium by 30 K
LINK_VARIANCE_FACTORS = np.geomspace(0.1, 30.0, 26)  # of the links' errors
TRIAL_NOISES = np.geomspace(2e-6, 2e-2, 30)  # of a coordinate, with what no link explains [m]
MAX_SCALE_POSES = 60  # that tell a scale
LEAST_LENGTH, FEWEST = 0.05, 4  # of lengths that tell a common share: size [m]; their number
# that lengths which are off at random agree so well on a share
MAX_P_VALUE, MAX_DOUBTFUL_P_VALUE = 0.003, 0.05
# sigmas of what the angles let expect, beside which doubtful agreement is enough
MIN_CLEAR_SIGMAS = 3.0
NUISANCE_FRACTIONS = np.linspace(0.0, 1.0, 33)  # of the range in which lengths are off at random,
MAX_SCALE_ROUNDS = 12  # cut again in each round
NORMAL_MEDIAN_DEVIATION = 0.6745  # of a Gaussian's absolute value, in sigmas


def estimate_common_length_change(
    nominal_mdh: Array, mdh_change: Array, is_identified: Array, covariance: Array
) -> float:
    """The share by which the lengths of a fit changed together, 0 where that may be chance.

    The lengths must agree on it, or nearly so where it is more than the angles let expect: of arms
    that are drawn to OFF_LENGTH and OFF_ANGLE, times one factor.  Each counts by its own sigma
    beside what lengths are off at random.  A share that a warm arm may have is none.

    nominal_mdh, mdh_change: (n, 5) rows [m, rad].  is_identified: (n, 5) True where identified.
    covariance: (5n, 5n) of the changes, in the order of `parameters.flatten_link_parameters`, with
    what the model lacks.
    """
    lengths = is_identified[:, :2] & (np.abs(nominal_mdh[:, :2]) > LEAST_LENGTH)
    angles = np.abs(mdh_change[:, 2:][is_identified[:, 2:]])
    if lengths.sum() < FEWEST or len(angles) < FEWEST:
        return 0.0
    place = np.arange(2 * len(nominal_mdh)).reshape(2, -1).T[lengths]
    length, more = nominal_mdh[:, :2][lengths], mdh_change[:, :2][lengths]
    own = covariance[np.ix_(place, place)]
    share, sigma = weighted_relative_change(length, more, own, 0.0)
    chance = 2.0 * float(stdtr(len(length) - 1, -abs(share) / sigma))
    usual = float(np.median(angles)) / NORMAL_MEDIAN_DEVIATION / OFF_ANGLE * OFF_LENGTH
    clear = chance < MAX_P_VALUE or (
        chance < MAX_DOUBTFUL_P_VALUE
        and abs(share) > MIN_CLEAR_SIGMAS * weighted_relative_change(length, more, own, usual)[1]
    )
    return share if clear and abs(share) > MIN_SCALE_ERROR else 0.0


def weighted_relative_change(
    length: Array, changes: Array, variances: Array, min_sigma: float
) -> tuple[float, float]:
    """The share of lengths (k,) by which they changed, more (k,), and its sigma.

    variances: (k, k) covariance of the changes.  min_sigma: sigma of what lengths are off at
    random, at least; as much as their disagreement asks for [Mandel and Paule 1970].
    """
    variance, axes = np.linalg.eigh(variances)
    along, turned = axes.T @ length, axes.T @ changes

    def at(size: Array) -> tuple[Array, Array, Array]:
        weight = 1.0 / (variance + size[:, None] ** 2)
        total = weight @ along**2
        share = weight @ (along * turned) / total
        left = (weight * (turned - share[:, None] * along) ** 2).sum(axis=-1)
        return left, share, total**-0.5

    low, high = 1e-9, float(np.sqrt(changes @ changes)) + 1e-9
    for _ in range(MAX_SCALE_ROUNDS):
        tried = low * (high / low) ** NUISANCE_FRACTIONS
        above = int((at(tried)[0] > len(length) - 1).sum())  # it falls with the size
        if not above:
            break
        low, high = tried[above - 1], tried[min(above, len(tried) - 1)]
    _, share, sigma = at(np.array([max(low, min_sigma)]))
    return float(share[0]), float(sigma[0])


def links_with_lack_of_fit(
    robot: Robot, model: PointModel, state: ParameterValues
) -> tuple[Array, Array]:
    """How far what the model lacks has moved the links of a fit, and their covariance with it.

    The lack is one of smooth functions of the pose, as large as the fit's errors say
    (`modelling.lack`): joints that bend stretch an arm as a scale would, but leave errors.
    model: of the fitted poses.  Returns (5n,) and (5n, 5n) [m, rad], zero where not identified.
    """
    n, active = robot.joints, model.active[: model.names.geometric_count]
    seen = np.broadcast_to(
        model.measured_mask.T[..., None], (*model.measured_mask.T.shape, 3)
    ).reshape(-1)
    every = model.point_jacobian(state)[..., : model.names.geometric_count]
    m, k, _, p = every.shape
    error = model.point_errors(state).reshape(-1)[seen]
    arm = every.reshape(m, 3 * k, p)[..., joint_zero_indices(robot.prismatic)]
    columns, kind = lack_of_fit_motions_by_pose(robot.with_mdh(state.mdh), model.q, arm)
    lack = columns.reshape(3 * k * m, -1)[seen]
    rows = every.reshape(-1, p)[seen][:, active]
    back = np.linalg.pinv(rows)
    left = lack - rows @ (back @ lack)
    dof = max(len(error) - rows.shape[1], 1)
    found = fit_variance_components(
        left.T @ lack, left.T @ error, float(error @ error), dof, kind[:, 1]
    )
    moved = back @ lack
    spread = found.second_moment - np.outer(found.mean, found.mean)
    shift, covariance = np.zeros(p), np.zeros((p, p))
    shift[active] = back @ error - moved @ found.mean
    covariance[np.ix_(active, active)] = found.noise * back @ back.T + moved @ spread @ moved.T
    return shift[: 5 * n], covariance[: 5 * n, : 5 * n]


@dataclass(frozen=True)
class PointScale:
    """factor: 1 + s by which the points are too long.  gain: in twice the log likelihood."""

    factor: float
    gain: float


def estimate_point_scale(robot: Robot, data: Measurements, state: ParameterValues) -> PointScale:
    """The common factor that the points of a drawn arm suggest, its links linear at a state.

    state: the drawn arm in its place; or as its links explain the points best, which far off are
    not linear at the drawing: `fit_state_with_links`.
    """
    rows = np.linspace(0, data.poses - 1, min(data.poses, MAX_SCALE_POSES)).astype(int)
    model = build_point_model(robot, data.take(rows))
    n, p = 5 * robot.joints, model.names.geometric_count
    seen = np.broadcast_to(
        model.measured_mask.T[..., None], (*model.measured_mask.T.shape, 3)
    ).reshape(-1)
    every = model.point_jacobian(state).reshape(-1, p)[seen]
    error = model.point_errors(state).reshape(-1)[seen] + every[:, :n] @ flatten_link_parameters(
        state.mdh - robot.mdh
    )
    links_at = kinematics.compute_link_frames(state.mdh, model.q, model.prismatic)
    drawn = kinematics.targets_in_base(links_at, state.target_positions)  # measured ones hold error
    points = np.moveaxis(drawn, -1, 0).reshape(-1)[seen]
    sigma = nominal_link_deviations(robot)
    columns = np.column_stack([every[:, n:], every[:, :n] * sigma, points, error])
    triangle = np.asarray(np.linalg.qr(columns, mode="r"))
    reduced = triangle[p - n :, p - n :]  # beside base and targets
    u, size, _ = np.linalg.svd(reduced[:, :n], full_matrices=False)
    stretch, left = reduced[:, n], reduced[:, n + 1]
    inside = np.array([u.T @ left, u.T @ stretch])
    outside = np.array([left - u @ inside[0], stretch - u @ inside[1]])
    free = max(len(error) - p, 1) - len(size)
    without, with_it, change = maximise_scale_likelihood(size, inside, outside, free)
    return PointScale(1.0 + change, 2.0 * (with_it - without))


def fit_state_with_links(
    robot: Robot, data: Measurements, state: ParameterValues
) -> ParameterValues:
    """As base, targets and links fit the points best, links that none shows as drawn."""
    model = build_point_model(robot, data)
    weight = np.zeros(model.names.parameter_count)
    weight[: 5 * robot.joints] = (
        TRIAL_NOISES[0] / (LINK_VARIANCE_FACTORS[-1] * nominal_link_deviations(robot))
    ) ** 2
    found = fit_within_bounds_from_start(
        model.with_prior(replace(model.prior, weight=weight)), state
    )
    return found.x.take(np.array(0))


def nominal_link_deviations(robot: Robot) -> Array:
    """(5n,) how far links are off as drawn, before any factor [m, rad]."""
    return np.repeat([OFF_LENGTH, OFF_ANGLE], [2 * robot.joints, 3 * robot.joints])


def maximise_scale_likelihood(
    size: Array, inside: Array, outside: Array, free: int
) -> tuple[float, float, float]:
    """The largest log likelihood over factors and noises, without a scale and with it; the scale.

    size: singular values of the links' columns.  inside, outside: error and stretch along these
    columns, and beside them.  free: numbers beside them.
    """
    variance = (LINK_VARIANCE_FACTORS[:, None, None] * size) ** 2 + TRIAL_NOISES[
        :, None
    ] ** 2  # (f, v, r)
    noise, beside = TRIAL_NOISES**2, outside @ outside.T
    e, c = inside
    ee, ec, cc = np.moveaxis((1.0 / variance) @ np.array([e * e, e * c, c * c]).T, -1, 0)
    ee, ec, cc = ee + beside[0, 0] / noise, ec + beside[0, 1] / noise, cc + beside[1, 1] / noise
    sizes = np.log(variance).sum(-1) + free * np.log(noise)
    likely = -0.5 * (ee - ec**2 / cc + sizes)
    at = np.unravel_index(int(np.argmax(likely)), likely.shape)
    return float(np.max(-0.5 * (ee + sizes))), float(likely[at]), float(ec[at] / cc[at])


# ---- beside the drawing, by any instrument -------------------------------------------------------


@dataclass(frozen=True)
class LengthScale:
    """By which share the arm's lengths come out longer than drawn, as one factor.

    sigma: of that, by instrument, drawing and by how little one factor explains.  p_value: of no
    factor.
    """

    share: float
    sigma: float
    p_value: float


def is_not_tool_length(robot: Robot) -> Array:
    """(5n,) False for lengths of the last link, which are those of the tool and may be anything."""
    number = np.arange(5 * robot.joints)
    last = (number % robot.joints) == robot.joints - 1
    return np.asarray(~((number < 2 * robot.joints) & last))


def fit_scale_of_lengths(
    robot: Robot, links: Array, change: Array, covariance: Array
) -> LengthScale | None:
    """One factor of all lengths, by generalised least squares; None where no length tells it.

    links: (l,) indices of links that were fitted.  change: (l,) from the drawing.  covariance:
    (l, l) of the fit and of the drawing together [m, rad].
    """
    lengths = np.arange(5 * robot.joints) < 2 * robot.joints
    drawn = np.where(lengths, flatten_link_parameters(robot.mdh), 0.0)[links]
    dof = len(drawn) - 1
    if not drawn.any() or dof < 1:
        return None
    root = np.linalg.cholesky(covariance)
    white = np.linalg.solve(root, np.stack([drawn, change], axis=1))
    told = float(white[:, 0] @ white[:, 0])
    share = float(white[:, 0] @ white[:, 1]) / told
    left = float(((white[:, 1] - share * white[:, 0]) ** 2).sum()) / dof
    sigma = float(np.sqrt(max(left, 1.0) / told))
    return LengthScale(share, sigma, float(2.0 * stdtr(dof, -abs(share) / sigma)))
