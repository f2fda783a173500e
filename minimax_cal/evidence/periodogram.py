"""Lines in the residual: ripple of gears whose number of waves a turn nobody told."""

from __future__ import annotations

import numpy as np

from minimax_cal.evidence.noise import Noise, Rows, remaining
from minimax_cal.ground.arrays import Array
from minimax_cal.modelling.effects.gears import sweeping
from minimax_cal.modelling.effects.scene import Scene
from minimax_cal.modelling.effects.table import Term

SLOWEST, FASTEST = 8.0, 260.0  # waves a turn that are looked for; no gear has fewer teeth
DENSITY = 4.0  # frequencies tried for each one that is independent


def strongest_lines(
    scene: Scene,
    rows: Rows,
    noise: Noise,
    known: Array,
    *,
    most: int = 1,
    kept: Array | None = None,
) -> list[tuple[Term, float]]:
    """The strongest line of each joint, with the number of independent frequencies tried.

    known: (N, q) columns that are fitted already.  kept: (N,) rows that count, None for all.
    """
    weight = noise.weights(rows) * (1.0 if kept is None else kept)
    pull = weight * remaining(rows, weight, known)
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
        gain = power(*sums(turns, scene.q[j], score, size))
        for at in np.argsort(-gain)[:most]:
            near = turns[at] + step * np.linspace(-1.0, 1.0, 41)
            best = near[int(np.argmax(power(*sums(near, scene.q[j], score, size))))]
            found.append((Term("gear_ripple", f"J{j + 1}", {"turns": float(best)}), tries))
    return found


def sums(turns: Array, q: Array, score: Array, size: Array) -> tuple[Array, Array, float]:
    """Sums over poses of score e^(i k q) and of size e^(2 i k q) for turns k (f,), and of size.

    turns: equally spaced, so that every wave is a product of one from a coarse grid and one of the
    few between: the sums over poses are products of two small matrices.
    """
    count = int(np.ceil(np.sqrt(len(turns))))
    step = turns[1] - turns[0]
    coarse = np.exp(1j * np.outer(turns[::count], q))
    fine = np.exp(1j * np.outer(step * np.arange(count), q))
    pull = (coarse * score) @ fine.T
    square = (coarse**2 * size) @ (fine**2).T
    return pull.reshape(-1)[: len(turns)], square.reshape(-1)[: len(turns)], float(size.sum())


def power(pull: Array, square: Array, whole: float) -> Array:
    """(f,) gain of a wave of each frequency.  pull, square, whole: as `sums` has them."""
    cc, ss, cs = 0.5 * (whole + square.real), 0.5 * (whole - square.real), 0.5 * square.imag
    det = np.maximum(cc * ss - cs * cs, 1e-12 * cc * ss + 1e-300)
    top = ss * pull.real**2 - 2.0 * cs * pull.real * pull.imag + cc * pull.imag**2
    return np.asarray(top / det)
