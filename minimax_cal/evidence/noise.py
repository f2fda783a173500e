"""The linearised fit with two kinds of noise: of the instrument, and of the joints at every pose.

A pose's errors have the covariance s^2 I + t^2 S S', with S the motion of its points per radian of
each joint: the joints do not stop exactly where they are told.  In the eigenvectors of S S' that
matrix is diagonal for any s and t, so that one rotation of the rows makes every later step plain
weighted least squares.  s and t are estimated by restricted maximum likelihood [Patterson and
Thompson 1971].
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from minimax_cal.evidence.ratios import likeliest
from minimax_cal.ground.arrays import Array
from minimax_cal.modelling.model import Model
from minimax_cal.modelling.parameters import State

RANK = 1e-5  # singular value of the scaled Jacobian below which a direction is no direction
SAME = 1e-12  # added to products of unit columns where some are the same
FREE = 3  # degrees of freedom below which no noise is told from another


@dataclass(frozen=True, eq=False)
class Rows:
    """Rows of a linear fit, poses rotated so that both noises are diagonal.

    error: (N,) what the geometry leaves [m].  basis: (N, p) orthonormal span of the geometry.
    variance_ratio: (N,) variance of a row per variance of the joints, relative to its mean.
    size: the mean [m^2/rad^2].  count: rows that were measured.
    turn: (m, r, r) the rotations, r = 3k.  weight: (m, r) square roots of the points' weights.
    poses: (m,) a number, from 0, of each pose, of repeats the same.
    """

    error: Array
    basis: Array
    variance_ratio: Array
    size: float
    count: int
    turn: Array
    weight: Array
    poses: Array

    @property
    def group(self) -> Array:
        """(N,) the pose of each row."""
        return np.repeat(self.poses, self.weight.shape[1])

    def of(self, fields: Array) -> Array:
        """(N, D) displacement fields (D, k, 3, m) as rows."""
        d, k, _, m = fields.shape
        flat = np.moveaxis(fields.reshape(d, 3 * k, m), -1, 0) * self.weight[:, None, :]
        return np.asarray((flat @ self.turn).swapaxes(1, 2).reshape(3 * k * m, d))

    def beside(self, columns: Array) -> Rows:
        """With columns (N, q) projected out as geometry is, as far as they are told.

        columns: of factors whose priors weigh as one row of unit error; what is told of a direction
        by no more than that is left.
        """
        rest = columns - self.basis @ (self.basis.T @ columns)
        span, size, _ = np.linalg.svd(rest, full_matrices=False)
        span = span[:, size > 1.0]
        error = self.error - span @ (span.T @ self.error)
        return replace(self, error=error, basis=np.concatenate([self.basis, span], axis=1))

    def back(self, rows: Array) -> Array:
        """(k, 3, m) rows (N,) as points again; what was not measured is 0."""
        m, r = self.weight.shape
        flat = (self.turn @ rows.reshape(m, r, 1))[..., 0]
        plain = np.where(self.weight > 0, flat / np.where(self.weight > 0, self.weight, 1.0), 0.0)
        return np.asarray(plain.T.reshape(r // 3, 3, m))


def rows_of(error: Array, jacobian: Array, joint_jacobian: Array, weight: Array) -> Rows:
    """Rows from an error (k, 3, m), geometry's Jacobian (k, p, 3, m), slope (n, k, 3, m).

    weight: (k, m) of each point, 0 where not measured.
    """
    k, _, m = error.shape
    root = np.repeat(np.sqrt(weight)[:, None], 3, axis=1).reshape(3 * k, m).T
    arm = (
        np.moveaxis(joint_jacobian.reshape(len(joint_jacobian), 3 * k, m), -1, 0) * root[:, None, :]
    )
    spread, turn = np.linalg.eigh(np.swapaxes(arm, 1, 2) @ arm)
    spread = np.maximum(spread, 0.0).reshape(-1)
    count = 3 * int(np.count_nonzero(weight))
    size = float(spread.sum() / count)
    alone = np.arange(m)
    bare = Rows(np.zeros(0), np.zeros((0, 0)), spread / size, size, count, turn, root, alone)
    matrix = bare.of(np.moveaxis(jacobian, 1, 0))
    rest = bare.of(np.where(weight[:, None] > 0, error, 0.0)[None])[:, 0]
    return replace(bare, error=rest, basis=orthonormal(matrix))


def linearised(model: Model, state: State, joint_jacobian: Array) -> Rows:
    """The rows of a model at a fitted state.  joint_jacobian: (n, k, 3, m) as `Scene.jacobian`."""
    error = np.nan_to_num(np.swapaxes(model.error(state), -1, -2))
    jacobian = np.moveaxis(model.jacobian(state), (1, 2, 3), (3, 2, 1))
    return rows_of(error, jacobian, joint_jacobian, model.weight)


def orthonormal(matrix: Array) -> Array:
    """Orthonormal columns with the span of a matrix (N, p) whose columns are first scaled."""
    norm = np.linalg.norm(matrix, axis=0)
    scaled = matrix[:, norm > 0] / norm[norm > 0]
    return np.asarray(np.linalg.qr(scaled @ told_apart(scaled.T @ scaled))[0])


def identified(gram: Array) -> Array:
    """(p, r) combinations of parameters that turn a Gram matrix (p, p) into 1."""
    norm = np.sqrt(np.diag(gram))
    used = norm > 0.0
    whole = told_apart(gram[np.ix_(used, used)] / np.outer(norm[used], norm[used]))
    out = np.zeros((len(gram), whole.shape[1]))
    out[used] = whole / norm[used][:, None]
    return out


def told_apart(gram: Array) -> Array:
    """(p, r) combinations that turn a Gram matrix (p, p) of unit columns into 1."""
    values, vectors = np.linalg.eigh(gram)
    kept = values > RANK**2 * values[-1] if len(values) else np.zeros(0, dtype=bool)
    return np.asarray(vectors[:, kept] / np.sqrt(values[kept]))


def inflation(field: Array, rest: Array, group: Array, dof: int) -> float:
    """How much noisier rows are along a field than all together, as groups of them tell it, >= 1.

    By the jackknife, no group judging itself: wrong points, an instrument whose directions differ,
    and groups whose rows err alike give a field no more weight than they deserve.  field: (N,) as
    fitted, and rest: (N,) without it, both white.  group: (N,) from 0.
    """
    own = np.bincount(group, field * field)
    whole = float(own.sum())
    if whole <= 0.0:
        return 1.0
    rest = rest - field
    pull = np.bincount(group, field * rest) / np.maximum(1.0 - own / whole, 0.1)
    variance = max(float(rest @ rest) / max(dof, 1), 1e-300)
    return max(float(pull @ pull) / (whole * variance), 1.0)


@dataclass(frozen=True)
class Noise:
    """ratio: variance that the joints add to a mean row over that of the instrument.

    variance: of the instrument per coordinate [m^2].  jitter: standard deviation of a joint [rad].
    """

    ratio: float
    variance: float
    jitter: float

    def weights(self, rows: Rows) -> Array:
        """(N,) inverse variances [1/m^2]."""
        return np.asarray(1.0 / (self.variance * (1.0 + self.ratio * rows.variance_ratio)))


def remaining(rows: Rows, weight: Array, known: Array) -> Array:
    """(N,) what the weighted least squares on geometry and known columns leaves of the error [m].

    weight: (N,) inverse variances, 0 for rows that are not fitted.  known: (N, q).
    """
    columns = np.concatenate([rows.basis, known], axis=1)
    columns = columns / np.maximum(np.linalg.norm(columns, axis=0), 1e-300)
    gram = columns.T @ (columns * weight[:, None])
    value = np.linalg.lstsq(gram, columns.T @ (weight * rows.error), rcond=1e-12)[0]
    return np.asarray(rows.error - columns @ value)


def restricted(rows: Rows, known: Array) -> Noise:
    """Noise by restricted maximum likelihood.  known: (N, q) further columns that are fitted."""
    columns = np.concatenate([rows.basis, known, rows.error[:, None]], axis=1)
    dof = rows.count - columns.shape[1] + 1
    if dof < FREE:
        return Noise(0.0, float(rows.error @ rows.error) / max(rows.count, 1) + 1e-18, 0.0)

    def cost(ratios: Array) -> tuple[Array, Array]:
        halves = (columns / np.sqrt(1.0 + r * rows.variance_ratio)[:, None] for r in ratios)
        gram = np.array([half.T @ half for half in halves])
        return costs(gram, ratios, rows.variance_ratio, dof)

    ratio = likeliest(lambda ratios: cost(ratios)[0])
    return noise_of(ratio, float(cost(np.array([ratio]))[1][0]) / dof, rows)


def noise_of(ratio: float, variance: float, rows: Rows) -> Noise:
    """Both noises of a ratio and of the variance of the instrument."""
    return Noise(ratio, variance, float(np.sqrt(ratio * variance / rows.size)))


def costs(gram: Array, ratios: Array, varied: Array, dof: int) -> tuple[Array, Array]:
    """-2 log restricted likelihood (g,) at ratios (g,) [Patterson and Thompson 1971].

    And squares (g,) of what is left of the error.  gram: (g, p + 1, p + 1) weighted products of
    what is fitted and, last, the error.  varied: variance ratios of the rows that count.
    """
    gram = gram + 0.0
    gram[:, -1, -1] += 1e-300
    logs = np.log(np.einsum("rpp->rp", triangles(gram)))
    squares = np.exp(2.0 * logs[:, -1])
    spread = np.log1p(ratios[:, None] * varied).sum(axis=1)
    return dof * np.log(squares) + spread + 2.0 * logs[:, :-1].sum(axis=1), squares


def triangles(gram: Array) -> Array:
    """(s, f, f) lower triangles whose squares are matrices (s, f, f), as near as those allow."""
    scale = np.sqrt(np.maximum(np.einsum("sff->sf", gram), 1e-300))[..., None]
    unit = gram / scale / np.swapaxes(scale, 1, 2)
    try:
        return np.asarray(scale * np.linalg.cholesky(unit))
    except np.linalg.LinAlgError:  # two columns are the same, or the geometry imitates one
        lift = SAME + 2.0 * np.maximum(-np.linalg.eigvalsh(unit)[:, 0], 0.0)
        eye = np.eye(gram.shape[-1])
        return np.asarray(scale * np.linalg.cholesky(unit + lift[:, None, None] * eye))
