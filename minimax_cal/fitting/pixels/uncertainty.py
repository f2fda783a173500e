"""How sure an arm is that pixels have calibrated: noise, lenses, drawing, and what no link holds.

What no link holds (gears, bending, servos) moves all pixels of an image together, and moves what is
fitted along.  Each joint is taken to be turned by random functions of the pose (`modelling.lack`)
and by a number of its own at each pose; how large they are, the pixels tell.  Where no pose was
measured they are as large as elsewhere.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from minimax_cal.evidence.components import fit_components
from minimax_cal.fitting.pixels.fit import PixelFit
from minimax_cal.fitting.pixels.identify import gram_of_pixels, lengths_of
from minimax_cal.ground.arrays import Array
from minimax_cal.modelling.lack import DRIVERS, UNIT, by_pose, joint_units
from minimax_cal.modelling.parameters import zero_positions
from minimax_cal.robots.robot import Robot
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
    model, x, active = fit.model, fit.squares, fit.active
    root = np.sqrt(model.weight)
    zero = np.zeros(len(active), dtype=bool)
    zero[zero_positions(model.prismatic)] = True
    error, jacobian = model.rows(x, active)
    joints = root * model.rows(x, zero)[1]
    error, jacobian = (root * error).reshape(-1), (root * jacobian).reshape(len(jacobian), -1)
    prior = model.prior.weight[active]
    gram = jacobian @ jacobian.T
    cover = solve_normal(gram + np.diag(prior), np.eye(len(gram)))
    columns, kind, functions = lacking(robot.with_mdh(x.mdh[0]), fit, joints, group)
    moved = cover @ (jacobian @ columns.T)
    left = columns - moved.T @ jacobian
    dof = max(2 * int((model.weight > 0.0).sum()) - len(gram), 1)
    found = fit_components(left @ columns.T, left @ error, float(error @ error), dof, kind)
    size = (UNIT * joint_units(robot)) ** 2
    own = kind[functions:].reshape(robot.joints, -1)[:, 0]
    lack = Lack(found.moment, functions, found.variance[own] * size)
    noise = np.zeros((len(active),) * 2)
    pulled = jacobian * np.tile(fit.share, 2)
    cover = solve_normal(pulled @ jacobian.T + np.diag(prior), np.eye(len(gram)))
    moved = cover @ (pulled @ columns.T)
    told = found.noise * pulled @ pulled.T + np.diag(fit.noise**2 * prior)
    noise[np.ix_(active, active)] = cover @ told @ cover
    if fit.held:
        lens = np.arange(len(active)) >= len(active) - x.lens[0].size
        shift = shift_by(fit, lens, fit.lens_sigma.reshape(-1))
        noise += shift @ shift.T
    every = np.zeros((len(active), len(columns)))
    every[active] = moved
    return Uncertainty(active, noise, every, unfitted(robot, fit), lack)


def lacking(arm: Robot, fit: PixelFit, joints: Array, group: Array) -> tuple[Array, Array, int]:
    """(c, 2N) motion of the pixels by each factor of the lack, (c,) its group; how many functions.

    joints: (n, 2, N) motion by each joint.  group: (N,).
    """
    model, n = fit.model, arm.joints
    turned, kind = by_pose(arm, model.q[model.pose], joints.transpose(2, 1, 0))
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
    model, active = replace(fit.model, weight=fit.share), fit.active
    gram = gram_of_pixels(model, fit.squares, active | held)
    normal = gram + np.diag(np.where(active, model.prior.weight, 0.0))
    out = np.zeros((len(active), len(sigma)))
    mixed = gram[np.ix_(active, held)]
    out[active] = -solve_normal(normal[np.ix_(active, active)], mixed) * sigma
    return out


def unfitted(robot: Robot, fit: PixelFit) -> Array:
    """(p, h) how far all parameters are off by each link that was not fitted, as drawings are.

    What pixels take for others moves these along; where it moves no position, it counts for none.
    """
    links = fit.model.names.links
    held = links & ~fit.active
    sigma = np.where(lengths_of(fit.model.names)[held], *robot.drawn_within)
    out = shift_by(fit, held, sigma)
    out[held] = np.diag(sigma)
    return out
