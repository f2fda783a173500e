"""The drawing beside the pixels: as a prior, and as the measure of a board's size.

A drawing may be better than its tolerance: how much, the pixels tell, by how far the arm that they
make is from it [empirical Bayes, Efron and Morris 1973].
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import scipy

from minimax_cal.fitting.pixels.fit import PixelFit
from minimax_cal.fitting.pixels.judge import Uncertainty, drawn_covariance
from minimax_cal.ground.arrays import Array
from minimax_cal.modelling.parameters import links_of
from minimax_cal.robots.robot import Robot

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
        noise = drawn_covariance(robot)[some] + (sure.drawn @ sure.drawn.T)[some]
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


@dataclass(frozen=True)
class Scale:
    """By which share the arm's lengths come out longer than drawn, as one factor.

    sigma: of that, by pixels, drawing and by how little one factor explains.  p_value: of no
    factor.
    """

    share: float
    sigma: float
    p_value: float


def scale_of(robot: Robot, fit: PixelFit, sure: Uncertainty) -> Scale | None:
    """One factor of all lengths, by generalised least squares; None where nothing tells it.

    Without a board the drawing gives the scale; the tool's lengths may be anything.
    """
    n = robot.joints
    number = np.arange(5 * n)
    length = number < 2 * n
    drawing = Drawing.of(robot, fit, sure, ~(length & (number % n == n - 1)))
    drawn = np.where(length, links_of(robot.mdh), 0.0)[drawing.links]
    dof = len(drawn) - 1
    if not fit.images.has_length or robot.rough or not drawn.any() or dof < 1:
        return None
    root = np.linalg.cholesky(drawing.cover + drawing.noise)
    white = np.linalg.solve(root, np.stack([drawn, -drawing.off], axis=1))
    told = float(white[:, 0] @ white[:, 0])
    share = float(white[:, 0] @ white[:, 1]) / told
    left = float(((white[:, 1] - share * white[:, 0]) ** 2).sum()) / dof
    sigma = float(np.sqrt(max(left, 1.0) / told))
    return Scale(share, sigma, float(2.0 * scipy.stats.t.sf(abs(share) / sigma, dof)))
