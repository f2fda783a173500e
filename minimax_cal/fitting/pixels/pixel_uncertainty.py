"""How well pixels determine a position of the arm, against how well the drawing is known.

An error of the arm is what no base and no tool takes away: both are fitted wherever it works.

What no link holds (gears, bending, servos) moves all pixels of an image together, and moves what is
fitted along.  Each joint is taken to be turned by random functions of the pose (`modelling.lack`)
and by a number of its own at each pose; how large they are, the pixels tell.  Where no pose was
measured they are as large as elsewhere.

A drawing may be better than its tolerance: how much, the pixels tell, by how far the arm that they
make is from it [empirical Bayes, Efron and Morris 1973].
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from minimax_cal.core.arrays import Array
from minimax_cal.fitting.accuracy_claims import DEFAULT_TOOL_POINT, nominal_link_sigmas
from minimax_cal.fitting.common_scale import (
    LengthScale,
    fit_scale_of_lengths,
    is_not_tool_length,
)
from minimax_cal.fitting.multi_instrument.instrument_identification import is_link_length
from minimax_cal.fitting.pixels.fit import PixelFit
from minimax_cal.measuring.measurements import measurements
from minimax_cal.modelling.cell import build_measurements_at_rest
from minimax_cal.modelling.error_rows import (
    FUNCTION_UNIT_ANGLE,
    LACK_OF_FIT_DRIVERS,
    joint_radian_equivalents,
    lack_of_fit_motions_by_pose,
)
from minimax_cal.modelling.global_start import fit_base_and_targets
from minimax_cal.modelling.parameters import (
    ParameterValues,
    flatten_link_parameters,
    joint_zero_indices,
)
from minimax_cal.modelling.point_model import DEFAULT_TARGET_NAME, build_point_model
from minimax_cal.robots.joint_sampling import random_joint_values
from minimax_cal.robots.robot import Robot
from minimax_cal.selection.noise_model import fit_variance_components
from minimax_cal.solvers.least_squares import solve_normal_equations


@dataclass(frozen=True, eq=False)
class PixelLackOfFit:
    """What no link holds, by c factors: functions of the pose, then numbers of each pose.

    moment: (c, c) mean of their products.  functions: how many of them are of the pose.
    scatter: (n,) variance of the joints at a pose, which no pose tells of another [rad^2, m^2].
    """

    moment: Array
    functions: int
    scatter: Array


@dataclass(frozen=True, eq=False)
class PixelUncertainty:
    """How far all p parameters are off: covariance is noise + lack + that of what was not fitted.

    active: (p,) what was fitted.  noise: (p, p) by pixels, and lenses' priors.  moved: (p, c) by
    the factors of the lack.  drawn: (p, h) by one sigma of each link that was not fitted.
    """

    active: Array
    noise: Array
    moved: Array
    drawn: Array
    lack: PixelLackOfFit

    @property
    def covariance(self) -> Array:
        """(p, p) of the fitted parameters, the others as they are held, where they are NaN."""
        whole = self.noise + self.moved @ self.lack.moment @ self.moved.T
        known = self.active[:, None] & self.active
        return np.where(known, whole, np.nan)

    def with_link_correction(self, gain: Array, links: Array, noise: Array) -> PixelUncertainty:
        """When gain (p, l) times what some links (l,) of a drawing differ is added.

        noise: (l, l) covariance of that drawing.
        """
        keep = np.eye(len(gain))
        keep[:, links] -= gain
        return replace(
            self,
            noise=keep @ self.noise @ keep.T + gain @ noise @ gain.T,
            moved=keep @ self.moved,
        )


def estimate_pixel_uncertainty(robot: Robot, fit: PixelFit, group: Array) -> PixelUncertainty:
    """Of a fit.  robot: as drawn.  group: (N,) the pose of each training pixel, from 0.

    Noise and lack are what the least squares leave; they move the fit by the pixels' shares in it.
    """
    problem, x, active, prior = fit.problem, fit.squares, fit.problem.active, fit.prior
    error, jacobian = problem.rows(x, active)
    gram = jacobian @ jacobian.T
    cover = solve_normal_equations(gram + np.diag(prior), np.eye(len(gram)))
    joints = problem.joint_jacobian(x).reshape(robot.joints, 2, -1)
    columns, kind, functions = pixel_motion_by_lack(robot.with_mdh(x.mdh), fit, joints, group)
    moved = cover @ (jacobian @ columns.T)
    left = columns - moved.T @ jacobian
    dof = max(2 * fit.images.point_count - len(gram), 1)
    found = fit_variance_components(left @ columns.T, left @ error, float(error @ error), dof, kind)
    size = (FUNCTION_UNIT_ANGLE * joint_radian_equivalents(robot)) ** 2
    own = kind[functions:].reshape(robot.joints, -1)[:, 0]
    lack = PixelLackOfFit(found.second_moment, functions, found.variance[own] * size)
    noise = np.zeros((len(active),) * 2)
    pulled = jacobian * np.tile(fit.share, 2)
    cover = solve_normal_equations(pulled @ jacobian.T + np.diag(prior), np.eye(len(gram)))
    moved = cover @ (pulled @ columns.T)
    told = found.noise * pulled @ pulled.T + np.diag(fit.noise_px**2 * prior)
    noise[np.ix_(active, active)] = cover @ told @ cover
    if fit.held:
        shift = parameter_shift_by_held(fit, problem.is_lens_parameter, fit.lens_sigma.reshape(-1))
        noise += shift @ shift.T
    every = np.zeros((len(active), len(columns)))
    every[active] = moved
    return PixelUncertainty(active, noise, every, shift_by_unfitted_links(robot, fit), lack)


def pixel_motion_by_lack(
    arm: Robot, fit: PixelFit, joints: Array, group: Array
) -> tuple[Array, Array, int]:
    """(c, 2N) motion of the pixels by each factor of the lack, (c,) its group; how many functions.

    joints: (n, 2, N) motion by each joint.  group: (N,).
    """
    n, q = arm.joints, fit.problem.block.arm.q[fit.images.pixels.pose]
    turned, kind = lack_of_fit_motions_by_pose(arm, q, joints.transpose(2, 1, 0))
    unit = FUNCTION_UNIT_ANGLE * joint_radian_equivalents(arm)[:, None, None]
    alone = [joint * (group == each) for joint in unit * joints for each in range(group.max() + 1)]
    columns = np.concatenate([turned.transpose(2, 1, 0), np.stack(alone)])
    of_joint = np.repeat(np.arange(n), len(alone) // n)
    which = np.concatenate(
        [
            len(LACK_OF_FIT_DRIVERS) * kind[:, 0] + kind[:, 1],
            len(LACK_OF_FIT_DRIVERS) * n + of_joint,
        ]
    )
    return columns.reshape(len(columns), -1), which, len(kind)


def parameter_shift_by_held(fit: PixelFit, held: Array, sigma: Array) -> Array:
    """(p, h) how far the fitted parameters go when each of the held ones is wrong by its sigma.

    held: (p,) mask of h that were not fitted.  sigma: (h,).
    """
    active = fit.problem.active
    rows = fit.problem.with_image_changes(weight=fit.share).rows(fit.squares, active | held)[1]
    free = active[active | held]
    out = np.zeros((len(active), len(sigma)))
    normal = rows[free] @ rows[free].T + np.diag(fit.prior)
    out[active] = -solve_normal_equations(normal, rows[free] @ rows[~free].T) * sigma
    return out


def shift_by_unfitted_links(robot: Robot, fit: PixelFit) -> Array:
    """(p, h) how far all parameters are off by each link that was not fitted, as drawings are.

    What pixels take for others moves these along; where it moves no position, it counts for none.
    """
    held = fit.problem.names.link_mask & ~fit.problem.active
    sigma = np.where(is_link_length(fit.problem.names)[held], *robot.drawn_within)
    out = parameter_shift_by_held(fit, held, sigma)
    out[held] = np.diag(sigma)
    return out


# ---- what it claims ------------------------------------------------------------------------------


JUDGED_POSE_COUNT = 300  # over the joints' whole range


def tool_position_rms_error(robot: Robot, q: Array, point: Array) -> float:
    """RMS distance of points of a tool from where an arm has them, base and tool fitted [m].

    q: (m, n).  point: (m, 3) [m].
    """
    fit = fit_base_and_targets(build_point_model(robot, measurements(q, point)), robot.mdh)
    return float(np.sqrt(fit.mean_square))


def tool_positions(robot: Robot, q: Array) -> Array:
    """(m, 3) of a tool's point at joint values (m, n) [m]."""
    pose = robot.pose(q)
    return np.asarray(pose[:, :3, :3] @ DEFAULT_TOOL_POINT + pose[:, :3, 3])


def rms_difference_of_arms(one: Robot, other: Robot) -> float:
    """`tool_position_rms_error` by one arm of the points of another, over the joints' range [m]."""
    q = sample_joint_range(one)
    return tool_position_rms_error(other, q, tool_positions(one, q))


def tool_motion_without_rigid(robot: Robot, q: Array) -> tuple[Array, Array, Array]:
    """Motion of a tool's point at poses (m, n), less what base and tool take away.

    (3m, 5n) by the links, (3m, f) by the functions of `modelling.lack`, (3m, n) by the joints [m].
    """
    arm = build_point_model(robot, build_measurements_at_rest(q, (DEFAULT_TARGET_NAME,), robot))
    every = arm.point_jacobian(
        ParameterValues(robot.mdh, np.eye(3), np.zeros(3), DEFAULT_TOOL_POINT[None])
    )[:, 0]
    joints = every[..., joint_zero_indices(robot.prismatic)]
    turned, _ = lack_of_fit_motions_by_pose(robot, arm.q, joints)
    every, turned, joints = (part.reshape(3 * len(q), -1) for part in (every, turned, joints))
    u, size, _ = np.linalg.svd(every[:, 5 * robot.joints :], full_matrices=False)
    taken = u[:, size > 1e-9 * size[0]]

    def left(rows: Array) -> Array:
        return np.asarray(rows - taken @ (taken.T @ rows))

    return left(every[:, : 5 * robot.joints]), left(turned), left(joints)


def rms_position_error(robot: Robot, links: Array, moved: Array, lack: PixelLackOfFit) -> float:
    """RMS over the joints' range of a position's standard deviation, base and tool fitted [m].

    links: (5n, 5n) covariance of the link parameters, besides what the lack does.  moved: (5n, c)
    how each factor of the lack moves them.
    """
    every, turned, joints = tool_motion_without_rigid(robot, sample_joint_range(robot))
    by_lack = every @ moved
    by_lack[:, : lack.functions] -= turned
    square = np.sum((every @ links) * every) + np.sum((by_lack @ lack.moment) * by_lack)
    square += np.sum(joints**2 @ lack.scatter)
    return float(np.sqrt(max(square, 0.0) / JUDGED_POSE_COUNT))


def sample_joint_range(robot: Robot) -> Array:
    """(`JUDGED_POSE_COUNT`, n) joint values over the joints' whole range, which an arm is judged
    at.
    """
    return random_joint_values(robot, (JUDGED_POSE_COUNT,), np.random.default_rng(0))


def calibrated_position_sigma(robot: Robot, uncertainty: PixelUncertainty) -> float:
    """`rms_position_error` of a calibrated arm [m]."""
    n = 5 * robot.joints
    links = np.nan_to_num(uncertainty.noise) + uncertainty.drawn @ uncertainty.drawn.T
    return rms_position_error(robot, links[:n, :n], uncertainty.moved[:n], uncertainty.lack)


def nominal_position_sigma(robot: Robot, lack: PixelLackOfFit, share: float = 1.0) -> float:
    """`rms_position_error` that a drawing leaves, which holds no more of the lack [m].

    share: of the variance that `drawn_within` says.
    """
    nothing = np.zeros((5 * robot.joints, len(lack.moment)))
    return rms_position_error(
        robot, share * np.diag(nominal_link_sigmas(robot) ** 2), nothing, lack
    )


# ---- the drawing beside the pixels --------------------------------------------------------------


TRIAL_VARIANCE_FRACTIONS = np.geomspace(1e-6, 1.0, 121)  # of the drawing's variance that are tried
MIN_DEVIATION_VARIANCE = 1e-12  # variance of a direction, in parts of the drawing's
# twice a log-likelihood ratio: pixels contradict a drawing without error (1 of 100)
MIN_LOG_LIKELIHOOD_GAIN = 5.41


@dataclass(frozen=True, eq=False)
class NominalLinks:
    """What a drawing knows of the links that were fitted.

    links: (l,) their numbers.  off: (l,) of the drawing from the fit [m, rad].  cover: (l, l)
    covariance of the fit, links that were not fitted as they are drawn.  noise: (l, l) of the
    drawing, by `drawn_within`, with what the errors of those move the others.
    """

    links: Array
    off: Array
    cover: Array
    noise: Array

    @staticmethod
    def from_fit(robot: Robot, fit: PixelFit, sure: PixelUncertainty, among: Array) -> NominalLinks:
        """That of an arm.  among: (5n,) True for links that count."""
        links = np.flatnonzero(among & fit.problem.active[: len(among)])
        off = flatten_link_parameters(robot.mdh - fit.state.mdh)[links]
        some = np.ix_(links, links)
        noise = np.diag(nominal_link_sigmas(robot) ** 2)[some] + (sure.drawn @ sure.drawn.T)[some]
        return NominalLinks(links, off, sure.covariance[some], noise)

    @cached_property
    def variance_fraction(self) -> float:
        """The likeliest share of the variance by `drawn_within`, 0 where none is as likely."""
        root = np.linalg.inv(np.linalg.cholesky(self.noise))
        size, axes = np.linalg.eigh(root @ self.cover @ root.T)
        square = (axes.T @ root @ self.off) ** 2
        every = (
            np.maximum(size, MIN_DEVIATION_VARIANCE)
            + np.append(0.0, TRIAL_VARIANCE_FRACTIONS)[:, None]
        )
        deviance = (np.log(every) + square / every).sum(axis=1)
        best = int(np.argmin(deviance))
        return (
            float(TRIAL_VARIANCE_FRACTIONS[best - 1])
            if deviance[0] - deviance[best] > MIN_LOG_LIKELIHOOD_GAIN
            else 0.0
        )

    def with_nominal_prior(
        self, fit: PixelFit, sure: PixelUncertainty
    ) -> tuple[PixelFit, PixelUncertainty]:
        """The fit with the drawing as a prior; as it was where it is taken to be without error."""
        if not self.variance_fraction:
            return fit, sure
        noise = self.variance_fraction * self.noise
        across = np.nan_to_num(sure.covariance[self.links])
        gain = np.linalg.solve(self.cover + noise, across).T
        step = np.where(fit.problem.active, gain @ self.off, 0.0)
        return replace(fit, state=fit.state.step(step)), sure.with_link_correction(
            gain, self.links, noise
        )


def fit_length_scale(
    robot: Robot, fit: PixelFit, uncertainty: PixelUncertainty
) -> LengthScale | None:
    """One factor of all lengths; None where nothing tells it.

    Without a board the drawing gives the scale; the tool's lengths may be anything.
    """
    drawing = NominalLinks.from_fit(robot, fit, uncertainty, is_not_tool_length(robot))
    if not fit.images.has_length or robot.rough:
        return None
    return fit_scale_of_lengths(robot, drawing.links, -drawing.off, drawing.cover + drawing.noise)
