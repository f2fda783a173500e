"""Residuals made as large as errors were before the fit that left them."""

from __future__ import annotations

import numpy as np

from minimax_cal.ground.arrays import Array

TOGETHER = 30  # visits to one pose in a block, whose cost grows with their cube


def evened(rows: Array, basis: Array, spread: Array, group: Array) -> Array:
    """Residuals (m, 3k) with the covariance they had before the fit [Bell & McCaffrey 2002].

    Rows of covariance V_g = `spread` (m, 3k, 3k), up to a factor, leave residuals of covariance
    V_g - H_gg V_g - V_g H_gg + sum_h H_gh V_h H_hg with H = QQ', Q = `basis` (m, 3k, p).  All
    visits to a pose are one block g: the fit ties them together; of very many so many at a time.
    """
    middle = np.tensordot(basis, spread @ basis, ((0, 1), (0, 1)))
    several = np.stack([group, times_before(group) // TOGETHER])
    _, place, count = np.unique(several, axis=1, return_inverse=True, return_counts=True)
    place, out = place.reshape(-1), np.empty_like(rows)
    for visits in np.unique(count):
        alike = np.flatnonzero(count[place] == visits)
        chosen = alike[np.argsort(place[alike], kind="stable")].reshape(-1, visits)
        wide = visits * rows.shape[1]
        block = np.zeros((len(chosen), visits, rows.shape[1], visits, rows.shape[1]))
        for visit in range(visits):
            block[:, visit, :, visit] = spread[chosen[:, visit]]
        even = unfollowed(
            rows[chosen].reshape(-1, wide),
            basis[chosen].reshape(-1, wide, basis.shape[2]),
            block.reshape(-1, wide, wide),
            middle,
        )
        out[chosen] = even.reshape(rows[chosen].shape)
    return out


def times_before(group: Array) -> Array:
    """(m,) how often each row's number stands before it."""
    order = np.argsort(group, kind="stable")
    known, first = group[order], np.arange(len(group))
    start = np.maximum.accumulate(np.where(np.append(True, known[1:] != known[:-1]), first, 0))
    out = np.empty_like(first)
    out[order] = first - start
    return out


def unfollowed(rows: Array, basis: Array, spread: Array, middle: Array) -> Array:
    """`evened` for blocks of one size.  middle: (p, p) sum of Q_g' V_g Q_g over all blocks."""
    back = np.swapaxes(basis, 1, 2)
    followed = basis @ (back @ spread)
    left = spread - followed - np.swapaxes(followed, 1, 2) + basis @ middle @ back
    factor = np.linalg.cholesky(spread)
    white = np.linalg.solve(factor, np.swapaxes(np.linalg.solve(factor, left), 1, 2))
    value, vector = np.linalg.eigh(0.5 * (white + np.swapaxes(white, 1, 2)))
    turned = np.swapaxes(vector, 1, 2) @ np.linalg.solve(factor, rows[..., None])
    stretch = 1.0 / np.sqrt(np.maximum(value, 0.1))  # a pose the fit has all but taken tells little
    return np.asarray((factor @ vector @ (stretch[..., None] * turned))[..., 0])
