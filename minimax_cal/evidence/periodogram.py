"""Lines in the residual: ripple of gears whose number of waves a turn nobody told."""

from __future__ import annotations

import numpy as np

from minimax_cal.evidence.noise import Noise, Rows
from minimax_cal.ground.arrays import Array
from minimax_cal.modelling.effects.gears import sweeping
from minimax_cal.modelling.effects.scene import Scene
from minimax_cal.modelling.effects.table import Term

SLOWEST, FASTEST = 8.0, 260.0  # waves a turn that are looked for; no gear has fewer teeth
DENSITY = 4.0  # frequencies tried for each one that is independent


def leftover(rows: Rows, noise: Noise, known: Array) -> Array:
    """(N,) weighted residual W r of the generalised least squares on geometry and known columns."""
    weight = noise.weights(rows)
    columns = np.concatenate([rows.basis, known], axis=1)
    scale = np.maximum(np.linalg.norm(columns, axis=0), 1e-300)
    columns = columns / scale
    gram = columns.T @ (columns * weight[:, None])
    value = np.linalg.lstsq(gram, columns.T @ (weight * rows.error), rcond=1e-12)[0]
    return np.asarray(weight * (rows.error - columns @ value))


def strongest_lines(
    scene: Scene, rows: Rows, noise: Noise, known: Array, *, most: int = 1
) -> list[tuple[Term, float]]:
    """The strongest line of each joint, with the number of independent frequencies tried.

    known: (N, q) columns that are fitted already.
    """
    pull = leftover(rows, noise, known)
    weight = noise.weights(rows)
    arms = rows.of(scene.jacobian)
    poses = scene.poses
    found = []
    for j in sweeping(scene):
        span = max(float(np.ptp(scene.q[j])) / (2.0 * np.pi), 0.1)
        step = 1.0 / (DENSITY * span)
        turns = np.arange(SLOWEST, FASTEST, step)
        tries = float(len(turns)) / DENSITY * 2.0
        score = (arms[:, j] * pull).reshape(poses, -1).sum(axis=1)
        size = (arms[:, j] ** 2 * weight).reshape(poses, -1).sum(axis=1)
        gain = power(turns, scene.q[j], score, size)
        for at in np.argsort(-gain)[:most]:
            near = turns[at] + step * np.linspace(-1.0, 1.0, 41)
            best = near[int(np.argmax(power(near, scene.q[j], score, size)))]
            found.append((Term("gear_ripple", f"J{j + 1}", {"turns": float(best)}), tries))
    return found


def power(turns: Array, q: Array, score: Array, size: Array) -> Array:
    """(f,) gain of a wave of each frequency.  score, size: (m,) pull and information of a pose."""
    angle = np.outer(turns, q)
    c, s = np.cos(angle), np.sin(angle)
    a, b = c @ score, s @ score
    cc, ss, cs = (c * c) @ size, (s * s) @ size, (c * s) @ size
    det = np.maximum(cc * ss - cs * cs, 1e-12 * cc * ss + 1e-300)
    return np.asarray((ss * a * a - 2.0 * cs * a * b + cc * b * b) / det)
