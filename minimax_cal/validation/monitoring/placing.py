"""Frame, reflectors and what moved, placed where new poses have them, every point weighing alike.

What moved is sought by rows in units of their noise, for they tell most.  What is written is used
as it stands: its distances count.  Weights by noises alone would trust directions in which neither
joints nor instrument are noisy, and there what the model lacks leads astray by more than is mended.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from minimax_cal.core.arrays import Array
from minimax_cal.modelling.parameters import ParameterValues
from minimax_cal.selection.noise_model import orthonormal_basis


@dataclass(frozen=True, eq=False)
class MonitoredRows:
    """New errors in units of their noise, linear in all parameters.

    error: (N,).  jacobian: (N, p).  latent: (N, r) by what the calibration did not know, and
    by what the model lacks, each of variance 1.  active: (p,) what is free.  state: about which.
    count: coordinates that were measured.  pose: (N,) number of each row's pose, -1 for the foot,
    last.  half: (m, r, r) root of each pose's noise [m].  arm: (m, r, n) motion of the points per
    unit of each joint, in units of the noise.  scale: by how much the noise is larger than it was.
    """

    error: Array
    jacobian: Array
    latent: Array
    active: Array
    state: ParameterValues
    count: int
    pose: Array
    half: Array
    arm: Array
    scale: float = 1.0

    @property
    def foot_coordinate_count(self) -> int:
        """Coordinates of the foot."""
        return int(np.count_nonzero(self.pose < 0))

    def independent_motion_fraction(self, columns: Array, held: Array) -> Array:
        """(c,) share of each motion that other parameters, (p,) True in held, do not imitate."""
        size = (self.jacobian[:, columns] ** 2).sum(axis=0)
        rest = size
        if held.any():
            basis = orthonormal_basis(self.jacobian[:, held])
            off = self.jacobian[:, columns] - basis @ (basis.T @ self.jacobian[:, columns])
            rest = (off**2).sum(axis=0)
        return np.asarray(rest / np.where(size > 0.0, size, np.inf))


# ---- placing -------------------------------------------------------------------------------------


MIN_SINGULAR_RATIO = (
    1e-10  # share of the largest singular value below which a direction is not told
)


@dataclass(frozen=True, eq=False)
class LinearPlacement:
    """Least squares of the distances over what is free in some rows, the rest as calibrated.

    state: where what is free explains the errors best.  used: coordinates of the poses that what is
    free takes up.  inverse: (f, N) from errors to what is free.  size: of a coordinate that is
    left, what model and noises both leave [m].
    """

    rows: MonitoredRows
    state: ParameterValues
    used: float
    inverse: Array
    size: float

    def covariance_factor(self, root: Array) -> Array:
        """F (p, r + N) with FF' the covariance of all parameters there.

        root: (p, r) of what is kept, before; what the model lacks stands after it.
        """
        rows, half = self.rows, self.rows.half
        m, r, _ = half.shape
        poses, foot = np.split(self.inverse, [m * r], axis=1)
        coloured = np.einsum("fmr,mrs->fms", poses.reshape(-1, m, r), half) / self.size
        noise = np.concatenate([coloured.reshape(poses.shape), foot], axis=1)
        known = np.pad(root, ((0, 0), (0, rows.latent.shape[1] - root.shape[1])))
        known[rows.active] += noise @ rows.latent
        out = np.concatenate([known, np.zeros((len(root), noise.shape[1]))], axis=1)
        out[rows.active, known.shape[1] :] = rows.scale * noise
        return out


def solve_placing(rows: MonitoredRows) -> LinearPlacement:
    """Place what is free in some rows; reflectors on the foot hold the frame, by their noise."""
    # Back from units of the noise to metres: errors (m, r), slopes (m, r, f) by what is free.
    half, active = rows.half, rows.active
    m, r, _ = half.shape
    whole = np.concatenate([rows.error[:, None], rows.jacobian[:, active]], axis=1)
    in_metres = half @ whole[: m * r].reshape(m, r, -1)
    error, slope = in_metres[..., 0], in_metres[..., 1:]

    # All coordinates weigh alike, by the size of what is left; no less than the noise of one.
    dof = rows.count - rows.foot_coordinate_count - slope.shape[-1]
    least = float((half[:, 0] ** 2).sum(axis=-1).min())
    size = float(np.sqrt(max(float((error**2).sum()) / max(dof, 1), least)))
    is_foot = rows.pose < 0
    matrix = np.concatenate([slope.reshape(m * r, -1) / size, rows.jacobian[:, active][is_foot]])
    right = np.concatenate([error.reshape(-1) / size, rows.error[is_foot]])

    # Least squares with columns of unit length.
    norm = np.linalg.norm(matrix, axis=0)
    norm = np.where(norm > 0.0, norm, 1.0)
    inverse = np.asarray(np.linalg.pinv(matrix / norm, rcond=MIN_SINGULAR_RATIO) / norm[:, None])
    step = np.zeros(len(active))
    step[active] = inverse @ right
    used = float(np.einsum("nf,fn->", matrix[: m * r], inverse[:, : m * r]))
    return LinearPlacement(rows, rows.state.step(step), used, inverse, size)
