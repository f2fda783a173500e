"""Over which speeds friction changes its sign: simulators make it soft, and gears with much play.

A friction that is softer than it is drawn to be looks like a force without a law; one column beside
all that is named says so.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from minimax_cal.dynamics.laws import Term
from minimax_cal.dynamics.scene import sense_of
from minimax_cal.dynamics.search import Columns
from minimax_cal.evidence.noise import orthonormal
from minimax_cal.ground.arrays import Array

SOFTER = np.geomspace(0.005, 0.1, 9)  # of a joint's largest speed
NEAR = np.geomspace(0.7, 1.4, 9)  # of the best of these: a second, finer look
WORTH = 0.15  # of the square of the remaining error that a softer friction must close


def softened(columns: Columns, terms: Sequence[Term]) -> Array:
    """(n,) speeds over which friction changes its sign; as they are where that is soft enough.

    columns: of a scene.  terms: what is named.
    """
    scene, arm = columns.scene, columns.scene.arm
    logs, error, out = scene.logs, columns.error, arm.soft.copy()
    design = columns.design(terms)
    for j in range(logs.joints):
        rows = logs.fitted[:, j]
        beside = design[j, rows]
        if np.count_nonzero(rows) < 2 * beside.shape[1]:
            continue
        beside[:, columns.rigid.shape[2] + 2 * j] = 0.0  # the Coulomb friction of this joint
        basis = orthonormal(beside)
        left = error[j, rows] - basis @ (basis.T @ error[j, rows])

        def remaining(speeds: Array, j: int = j, basis: Array = basis, left: Array = left) -> Array:
            sense = logs.filtered(sense_of(logs.motion.qd[:, j, None], speeds))[logs.fitted[:, j]]
            sense = sense - basis @ (basis.T @ sense)
            size = np.maximum((sense**2).sum(axis=0), 1e-300)
            return np.asarray(float(left @ left) - (left @ sense) ** 2 / size)

        rough = arm.fastest[j] * SOFTER
        found = rough[np.argmin(remaining(rough))] * NEAR
        softer = float(found[np.argmin(remaining(found))])
        as_it_is, then = remaining(np.array([arm.soft[j], softer]))
        if then < (1.0 - WORTH) * as_it_is:
            out[j] = max(out[j], softer)
    return out
