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

from minimax_cal.evidence.noise import fit_components
from minimax_cal.fitting.claims import TOOL, drawn_sigmas
from minimax_cal.fitting.common_scale import (
    ScaleOfLengths,
    but_for_tool,
    fit_scale_of_lengths,
)
from minimax_cal.fitting.pixels.fit import PixelFit
from minimax_cal.fitting.several.identify import lengths_of
from minimax_cal.ground.arrays import Array
from minimax_cal.measuring.measurements import measurements
from minimax_cal.modelling.cell import still
from minimax_cal.modelling.model import TARGET, model_of
from minimax_cal.modelling.parameters import State, links_of, zero_positions
from minimax_cal.modelling.rows import DRIVERS, UNIT, by_pose, joint_units
from minimax_cal.modelling.start import fit_base
from minimax_cal.robots.robot import Robot
from minimax_cal.robots.sampling import random_joints
from minimax_cal.solvers.least_squares import solve_normal


@dataclass(frozen=True, eq=False)
class Lack:
    """What no link holds, by c factors: functions of the pose, then numbers of each pose.

    moment: (c, c) mean of their products.  functions: how many of them are of the pose.
    scatter: (n,) variance of the joints at a pose, which no pose tells of another [rad^2, m^2].
    """

    moment: Array
    functions: int
    scatter: Array


@dataclass(frozen=True, eq=False)
class Uncertainty:
    """How far all p parameters are off: covariance is noise + lack + that of what was not fitted.

    active: (p,) what was fitted.  noise: (p, p) by pixels, and lenses' priors.  moved: (p, c) by
    the factors of the lack.  drawn: (p, h) by one sigma of each link that was not fitted.
    """

    active: Array
    noise: Array
    moved: Array
    drawn: Array
    lack: Lack

    @property
    def covariance(self) -> Array:
        """(p, p) of the fitted parameters, the others as they are held, where they are NaN."""
        whole = self.noise + self.moved @ self.lack.moment @ self.moved.T
        known = self.active[:, None] & self.active
        return np.where(known, whole, np.nan)

    def after(self, gain: Array, links: Array, noise: Array) -> Uncertainty:
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


def uncertainty_of(robot: Robot, fit: PixelFit, group: Array) -> Uncertainty:
    """Of a fit.  robot: as drawn.  group: (N,) the pose of each training pixel, from 0.

    Noise and lack are what the least squares leave; they move the fit by the pixels' shares in it.
    """
    problem, x, active, prior = fit.problem, fit.squares, fit.problem.active, fit.prior
    error, jacobian = problem.rows(x, active)
    gram = jacobian @ jacobian.T
    cover = solve_normal(gram + np.diag(prior), np.eye(len(gram)))
    joints = problem.by_joints(x).reshape(robot.joints, 2, -1)
    columns, kind, functions = lacking(robot.with_mdh(x.mdh), fit, joints, group)
    moved = cover @ (jacobian @ columns.T)
    left = columns - moved.T @ jacobian
    dof = max(2 * fit.images.points - len(gram), 1)
    found = fit_components(left @ columns.T, left @ error, float(error @ error), dof, kind)
    size = (UNIT * joint_units(robot)) ** 2
    own = kind[functions:].reshape(robot.joints, -1)[:, 0]
    lack = Lack(found.moment, functions, found.variance[own] * size)
    noise = np.zeros((len(active),) * 2)
    pulled = jacobian * np.tile(fit.share, 2)
    cover = solve_normal(pulled @ jacobian.T + np.diag(prior), np.eye(len(gram)))
    moved = cover @ (pulled @ columns.T)
    told = found.noise * pulled @ pulled.T + np.diag(fit.noise_px**2 * prior)
    noise[np.ix_(active, active)] = cover @ told @ cover
    if fit.held:
        shift = shift_by(fit, problem.lenses, fit.lens_sigma.reshape(-1))
        noise += shift @ shift.T
    every = np.zeros((len(active), len(columns)))
    every[active] = moved
    return Uncertainty(active, noise, every, unfitted(robot, fit), lack)


def lacking(arm: Robot, fit: PixelFit, joints: Array, group: Array) -> tuple[Array, Array, int]:
    """(c, 2N) motion of the pixels by each factor of the lack, (c,) its group; how many functions.

    joints: (n, 2, N) motion by each joint.  group: (N,).
    """
    n, q = arm.joints, fit.problem.block.arm.q[fit.images.pixels.pose]
    turned, kind = by_pose(arm, q, joints.transpose(2, 1, 0))
    unit = UNIT * joint_units(arm)[:, None, None]
    alone = [joint * (group == each) for joint in unit * joints for each in range(group.max() + 1)]
    columns = np.concatenate([turned.transpose(2, 1, 0), np.stack(alone)])
    of_joint = np.repeat(np.arange(n), len(alone) // n)
    which = np.concatenate([len(DRIVERS) * kind[:, 0] + kind[:, 1], len(DRIVERS) * n + of_joint])
    return columns.reshape(len(columns), -1), which, len(kind)


def shift_by(fit: PixelFit, held: Array, sigma: Array) -> Array:
    """(p, h) how far the fitted parameters go when each of the held ones is wrong by its sigma.

    held: (p,) mask of h that were not fitted.  sigma: (h,).
    """
    active = fit.problem.active
    rows = fit.problem.changed(weight=fit.share).rows(fit.squares, active | held)[1]
    free = active[active | held]
    out = np.zeros((len(active), len(sigma)))
    normal = rows[free] @ rows[free].T + np.diag(fit.prior)
    out[active] = -solve_normal(normal, rows[free] @ rows[~free].T) * sigma
    return out


def unfitted(robot: Robot, fit: PixelFit) -> Array:
    """(p, h) how far all parameters are off by each link that was not fitted, as drawings are.

    What pixels take for others moves these along; where it moves no position, it counts for none.
    """
    held = fit.problem.names.links & ~fit.problem.active
    sigma = np.where(lengths_of(fit.problem.names)[held], *robot.drawn_within)
    out = shift_by(fit, held, sigma)
    out[held] = np.diag(sigma)
    return out


# ---- what it claims ------------------------------------------------------------------------------


POSES = 300  # over the joints' whole range


def missed(robot: Robot, q: Array, point: Array) -> float:
    """RMS distance of points of a tool from where an arm has them, base and tool fitted [m].

    q: (m, n).  point: (m, 3) [m].
    """
    fit = fit_base(model_of(robot, measurements(q, point)), robot.mdh)
    return float(np.sqrt(fit.mean_square))


def tool_points(robot: Robot, q: Array) -> Array:
    """(m, 3) of a tool's point at joint values (m, n) [m]."""
    pose = robot.pose(q)
    return np.asarray(pose[:, :3, :3] @ TOOL + pose[:, :3, 3])


def arms_apart(one: Robot, other: Robot) -> float:
    """`missed` by one arm of the points of another, over the joints' range [m]."""
    q = everywhere(one)
    return missed(other, q, tool_points(one, q))


def free_motion(robot: Robot, q: Array) -> tuple[Array, Array, Array]:
    """Motion of a tool's point at poses (m, n), less what base and tool take away.

    (3m, 5n) by the links, (3m, f) by the functions of `modelling.lack`, (3m, n) by the joints [m].
    """
    arm = model_of(robot, still(q, (TARGET,), robot))
    every = arm.jacobian(State(robot.mdh, np.eye(3), np.zeros(3), TOOL[None]))[:, 0]
    joints = every[..., zero_positions(robot.prismatic)]
    turned, _ = by_pose(robot, arm.q, joints)
    every, turned, joints = (part.reshape(3 * len(q), -1) for part in (every, turned, joints))
    u, size, _ = np.linalg.svd(every[:, 5 * robot.joints :], full_matrices=False)
    taken = u[:, size > 1e-9 * size[0]]

    def left(rows: Array) -> Array:
        return np.asarray(rows - taken @ (taken.T @ rows))

    return left(every[:, : 5 * robot.joints]), left(turned), left(joints)


def position_error(robot: Robot, links: Array, moved: Array, lack: Lack) -> float:
    """RMS over the joints' range of a position's standard deviation, base and tool fitted [m].

    links: (5n, 5n) covariance of the link parameters, besides what the lack does.  moved: (5n, c)
    how each factor of the lack moves them.
    """
    every, turned, joints = free_motion(robot, everywhere(robot))
    by_lack = every @ moved
    by_lack[:, : lack.functions] -= turned
    square = np.sum((every @ links) * every) + np.sum((by_lack @ lack.moment) * by_lack)
    square += np.sum(joints**2 @ lack.scatter)
    return float(np.sqrt(max(square, 0.0) / POSES))


def everywhere(robot: Robot) -> Array:
    """(`POSES`, n) joint values over the joints' whole range, which an arm is judged at."""
    return random_joints(robot, (POSES,), np.random.default_rng(0))


def position_sigma(robot: Robot, sure: Uncertainty) -> float:
    """`position_error` of a calibrated arm [m]."""
    n = 5 * robot.joints
    links = np.nan_to_num(sure.noise) + sure.drawn @ sure.drawn.T
    return position_error(robot, links[:n, :n], sure.moved[:n], sure.lack)


def drawn_sigma(robot: Robot, lack: Lack, share: float = 1.0) -> float:
    """`position_error` that a drawing leaves, which holds no more of the lack [m].

    share: of the variance that `drawn_within` says.
    """
    nothing = np.zeros((5 * robot.joints, len(lack.moment)))
    return position_error(robot, share * np.diag(drawn_sigmas(robot) ** 2), nothing, lack)


# ---- the drawing beside the pixels --------------------------------------------------------------


SHARES = np.geomspace(1e-6, 1.0, 121)  # of the drawing's variance that are tried
LEAST = 1e-12  # variance of a direction, in parts of the drawing's
# twice a log-likelihood ratio: pixels contradict a drawing without error (1 of 100)
EVIDENCE = 5.41


@dataclass(frozen=True, eq=False)
class Drawing:
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
    def of(robot: Robot, fit: PixelFit, sure: Uncertainty, among: Array) -> Drawing:
        """That of an arm.  among: (5n,) True for links that count."""
        links = np.flatnonzero(among & fit.problem.active[: len(among)])
        off = links_of(robot.mdh - fit.state.mdh)[links]
        some = np.ix_(links, links)
        noise = np.diag(drawn_sigmas(robot) ** 2)[some] + (sure.drawn @ sure.drawn.T)[some]
        return Drawing(links, off, sure.covariance[some], noise)

    @cached_property
    def share(self) -> float:
        """The likeliest share of the variance by `drawn_within`, 0 where none is as likely."""
        root = np.linalg.inv(np.linalg.cholesky(self.noise))
        size, axes = np.linalg.eigh(root @ self.cover @ root.T)
        square = (axes.T @ root @ self.off) ** 2
        every = np.maximum(size, LEAST) + np.append(0.0, SHARES)[:, None]
        deviance = (np.log(every) + square / every).sum(axis=1)
        best = int(np.argmin(deviance))
        return float(SHARES[best - 1]) if deviance[0] - deviance[best] > EVIDENCE else 0.0

    def beside(self, fit: PixelFit, sure: Uncertainty) -> tuple[PixelFit, Uncertainty]:
        """The fit with the drawing as a prior; as it was where it is taken to be without error."""
        if not self.share:
            return fit, sure
        noise = self.share * self.noise
        across = np.nan_to_num(sure.covariance[self.links])
        gain = np.linalg.solve(self.cover + noise, across).T
        step = np.where(fit.problem.active, gain @ self.off, 0.0)
        return replace(fit, state=fit.state.step(step)), sure.after(gain, self.links, noise)


def scale_of(robot: Robot, fit: PixelFit, sure: Uncertainty) -> ScaleOfLengths | None:
    """One factor of all lengths; None where nothing tells it.

    Without a board the drawing gives the scale; the tool's lengths may be anything.
    """
    drawing = Drawing.of(robot, fit, sure, but_for_tool(robot))
    if not fit.images.has_length or robot.rough:
        return None
    return fit_scale_of_lengths(robot, drawing.links, -drawing.off, drawing.cover + drawing.noise)
