"""How much each joint scatters, and the instrument along its line of sight and across it.

Effects are sought with two noises, of the instrument and of all joints alike.  Where joints scatter
unlike each other, or range and angles of a tracker do, the sizes are estimated by restricted
maximum likelihood [Patterson and Thompson 1971] from what geometry and effects leave, and the rows
are weighed by them: motions of joints and of the points, so scaled that one noise stands for all.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy

from minimax_cal.diagnosing.study import Study
from minimax_cal.evidence.limits import CERTAIN, HEAVY, LEAST_DOF, MAX_GAUSSIAN
from minimax_cal.evidence.noise import orthonormal, restricted
from minimax_cal.fitting.suspects import Scores, Spread, spread_of
from minimax_cal.ground.arrays import Array
from minimax_cal.measuring.faults.fault import Fault, between
from minimax_cal.measuring.faults.points import far_off
from minimax_cal.measuring.history import visits
from minimax_cal.measuring.measurements import Measurements
from minimax_cal.modelling.rows import linearised
from minimax_cal.robots.kinematics import cross

LEAST = 1e-7  # standard deviation that is none [m, rad]
STEADY = 0.05  # least part of the instrument's variance that all directions have
ROOM = 9.0  # of a logarithm of a variance, on both sides of where it starts


def weighed_anew(study: Study, known: Array, *, each: bool = True) -> Study:
    """The study, its rows weighed by the noises that the data tell, or itself if those are alike.

    known: (N, q) columns of effects.  each: whether every joint may scatter by itself: not where
    structure is left, which would pass for scatter of its joint.
    """
    whole = np.asarray((study.rows.weight > 0.0).all(axis=1))
    dof = int(whole.sum()) * study.rows.width - study.rows.basis.shape[1] - known.shape[1]
    noise = restricted(study.rows, known)
    if dof < LEAST_DOF or noise.variance < study.rows.exact**2:
        return study
    joints, sight = motions(study)
    rest = WholePoses.of(study, known, whole)
    turned, (along, across) = rest.products(joints), rest.products(sight)
    size, alike = (noise.jitter**2, noise.variance), turned.sum(axis=0)
    least, _ = rest.fit_variances([alike, along + across], np.array(size))
    parts = [*(turned if each else alike[None]), along, across]
    most, found = rest.fit_variances(parts, np.repeat(size, (len(parts) - 2, 2)))
    if scipy.stats.chi2.sf(least - most, len(parts) - 2) > CERTAIN:
        return study
    scatter = np.broadcast_to(np.sqrt(found[:-2]), len(turned))
    return weighed(study, scatter, sight, found[-2:])


def motions(study: Study) -> tuple[list[Array], list[Array]]:
    """Fields (d, k, 3, m) by which each joint moves the points; along and across the sight."""
    scene, k = study.scene, study.scene.targets
    seen = scene.points - scene.instruments
    along = seen / np.linalg.norm(seen, axis=1, keepdims=True)
    helper = np.zeros_like(along)
    helper[:, 2] = 1.0
    side = cross(along, helper)
    side = side / np.maximum(np.linalg.norm(side, axis=1, keepdims=True), 1e-12)
    own = np.eye(k)[:, :, None, None]  # each point errs by itself
    root = np.where(study.model.weight > 0.0, np.sqrt(study.model.weight), 1.0)[None, :, None]
    parts = [own * part / root for part in (along, side, cross(along, side))]
    return list(scene.jacobian[:, None]), [parts[0], np.concatenate(parts[1:])]


def weighed(study: Study, joints: Array, sight: Sequence[Array], size: Array) -> Study:
    """The study, its rows weighed by given noises.

    joints: (n,) standard deviations.  sight: motions along and across it, as `motions`; size: (2,)
    the variance of a coordinate of each [m^2].
    """
    along, across = size
    usual = max(float(np.sqrt(np.mean(joints**2))), LEAST)
    mean = (along + 2.0 * across) / 3.0
    both = max(min(along, across), STEADY * mean)
    more = sight[0] if along > across else sight[1]
    parts = np.concatenate([
        study.scene.jacobian * (joints / usual)[:, None, None, None],
        more * np.sqrt(max(along, across) - both) / usual,
    ])  # fmt: skip
    rows = linearised(study.model, study.fit.state, parts)
    return replace(study, rows=rows.with_poses(study.rows.poses), uneven=mean / both)


@dataclass(frozen=True, eq=False)
class WholePoses:
    """Poses at which every point was measured.

    study: whose rows they are.  whole: (m,) which poses.  y: (w, r).  fitted: (w, r, p).
    """

    study: Study
    whole: Array
    y: Array
    fitted: Array

    @staticmethod
    def of(study: Study, known: Array, whole: Array) -> WholePoses:
        """The rows of some poses, with geometry and known columns (N, q) to be fitted."""
        m, r = study.rows.weight.shape
        columns = orthonormal(np.concatenate([study.rows.basis, known], axis=1))
        y = study.rows.error.reshape(m, r)[whole]
        return WholePoses(study, whole, y, columns.reshape(m, r, -1)[whole])

    def products(self, fields: Sequence[Array]) -> Array:
        """(g, w, r, r) covariance that fields (d, k, 3, m) of unit variance give."""
        m, r = self.study.rows.weight.shape
        out = []
        for field in fields:
            part = self.study.rows.of(field).reshape(m, r, -1)[self.whole]
            out.append(part @ np.swapaxes(part, 1, 2))
        return np.array(out)

    def fit_variances(self, parts: Sequence[Array], start: Array) -> tuple[float, Array]:
        """-2 log restricted likelihood at its least, and the variance (g,) of each part.

        start: (g,) variances near by.
        """
        begin = np.log(np.maximum(start, LEAST**2))
        whole = np.array(parts)
        room = [(x - ROOM, x + ROOM) for x in begin]
        found = scipy.optimize.minimize(
            self.cost, begin, (whole,), jac=True, method="L-BFGS-B", bounds=room
        )
        return float(found.fun), np.asarray(np.exp(found.x))

    def cost(self, logs: Array, parts: Array) -> tuple[float, Array]:
        """-2 log restricted likelihood and its gradient by the logarithms of the variances (g,)."""
        v = np.exp(logs)
        covariance = np.tensordot(v, parts, 1)
        inverse = np.linalg.inv(covariance)
        pressed = inverse @ self.fitted
        gram = np.einsum("mrp,mrq->pq", self.fitted, pressed, optimize=True)
        gram += 1e-11 * np.trace(gram) / max(len(gram), 1) * np.eye(len(gram))
        factor = np.linalg.cholesky(gram)
        pull = np.einsum("mrp,mr->p", pressed, self.y)
        value = np.linalg.solve(gram, pull)
        rest = (inverse @ self.y[..., None])[..., 0] - pressed @ value
        taken = np.linalg.solve(factor, pressed.reshape(-1, len(gram)).T).T.reshape(pressed.shape)
        spread = inverse - taken @ np.swapaxes(taken, 1, 2) - rest[:, :, None] * rest[:, None]
        cost = np.linalg.slogdet(covariance)[1].sum() + 2.0 * np.log(np.diag(factor)).sum()
        slope = v * np.einsum("gmrs,mrs->g", parts, spread, optimize=True)
        return float(cost + np.sum(self.y * rest)), np.asarray(slope)


# ---- tails ---------------------------------------------------------------------------------------


def find_rows_beyond_tails(data: Measurements, error: Array) -> Array:
    """(m,) True where a point is farther off than the tails of all others allow.

    Judged by the errors of a fit, and by the distances between targets, each against Student's t
    with as heavy tails as the other points show.  Where the errors' tails are heavy no point is
    wrong for being far off.  error: (m, k, 3) of all points [m].
    """
    out = np.zeros(data.poses, dtype=bool)
    spread, far = fit_tails(np.linalg.norm(error, axis=-1), 3)
    if spread.dof <= HEAVY:
        return out
    off = np.abs(between(data).off.T)
    return np.asarray(far | fit_tails(off, 1)[1] if off.size else far)


def find_points_of_pulled_fit(
    error: Array, again: Callable[[], Array], data: Measurements
) -> tuple[Fault, ...]:
    """Points that are wrong where so many are that they pull the fit.

    error: (m, k, 3) of a plain fit [m].  again: that of one which wrong points do not pull, asked
    where an error is larger than those of Gaussian noise are.  Its heavy tails are no wrong points,
    nor are poses that were visited one after the other.
    """
    size = np.linalg.norm(error, axis=-1)
    if not np.nanmax(size, initial=0.0) > MAX_GAUSSIAN * np.nanmedian(size):
        return ()
    robust = again()
    spread, far = fit_tails(np.linalg.norm(robust, axis=-1), 3)
    runs = int((np.diff(far[visits(data)].astype(int), prepend=0) == 1).sum())
    is_scattered = 2 * runs > int(far.sum())  # most are single ones among the visits
    return far_off(data, robust, far) if spread.dof > HEAVY and is_scattered else ()


def fit_tails(size: Array, directions: int) -> tuple[Spread, Array]:
    """How sizes (m, s) scatter, and (m,) True where one stands out.  NaN is unknown."""
    seen = np.isfinite(size)
    scores = Scores(np.where(seen, size, 0.0) ** 2, directions * seen)
    spread = spread_of(scores, float(directions * seen.sum()))
    return spread, np.asarray(spread.far(scores).any(axis=1))
