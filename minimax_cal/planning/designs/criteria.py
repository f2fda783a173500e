"""Sizes of covariances: what a choice of experiments is judged by.

Each is a size that falls as 1/t when the information M = C^-1 grows by t, and whose inverse is
concave in M [Pukelsheim 1993, chapter 5].
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from minimax_cal.ground.arrays import Array

SOFT = 16.0  # how much the worst of several counts for more than the next worst


class Criterion(Protocol):
    """A size of covariances (..., f, f); smaller is better."""

    def size(self, cov: Array) -> Array:
        """(...,) the size."""

    def mix(self, cov: Array) -> Array:
        """W (f, f) with tr(CW) = size, or a little less where the worst of several counts."""

    def after(self, cov: Array, rows: Array) -> Array:
        """(c,) size once an experiment (c, r, f) is added; a lower bound where worst ones count."""


@dataclass(frozen=True)
class Determinant:
    """D: the geometric mean of the variances along the axes of the confidence ellipsoid."""

    def size(self, cov: Array) -> Array:
        """det(C)^(1/f)."""
        sign, log = np.linalg.slogdet(cov)
        return np.where(sign > 0.0, np.exp(log / cov.shape[-1]), np.inf)

    def mix(self, cov: Array) -> Array:
        """size/f times the inverse."""
        return np.asarray(np.linalg.inv(cov) * self.size(cov) / len(cov))

    def after(self, cov: Array, rows: Array) -> Array:
        """By det(M + A'A) = det(M) det(1 + A C A')."""
        _, inner = turned(cov, rows)
        log = np.linalg.slogdet(inner)[1]
        return np.asarray(self.size(cov) * np.exp(-log / len(cov)))


@dataclass(frozen=True, eq=False)
class Trace:
    """A mean variance, tr(CW): A with W = 1/f, I with the mean of B'B over predictions B.

    weight: W (f, f) positive semi-definite.
    """

    weight: Array

    def size(self, cov: Array) -> Array:
        """tr(CW)."""
        return np.asarray(np.einsum("...ij,ij->...", cov, self.weight))

    def mix(self, cov: Array) -> Array:
        """W itself."""
        return self.weight

    def after(self, cov: Array, rows: Array) -> Array:
        """By the lemma of `left`."""
        return left(cov, self.weight, rows)


@dataclass(frozen=True, eq=False)
class Largest:
    """G: the largest of several variances tr(C W_g).

    weights: (g, f, f) positive semi-definite.
    """

    weights: Array

    def each(self, cov: Array) -> Array:
        """(..., g) variances."""
        flat = self.weights.reshape(len(self.weights), -1)
        return np.asarray(cov.reshape(*cov.shape[:-2], -1) @ flat.T)

    def size(self, cov: Array) -> Array:
        """The largest."""
        return np.asarray(self.each(cov).max(axis=-1))

    def mix(self, cov: Array) -> Array:
        """A mean of the W_g in which the largest variances count most."""
        variance = self.each(cov)
        share = (variance / variance.max()) ** SOFT
        return np.asarray(np.tensordot(share / share.sum(), self.weights, 1))

    def after(self, cov: Array, rows: Array) -> Array:
        """Of that mean."""
        return left(cov, self.mix(cov), rows)


@dataclass(frozen=True)
class Eigenvalue:
    """E: the largest variance along any axis of the confidence ellipsoid."""

    def size(self, cov: Array) -> Array:
        """The largest eigenvalue of C."""
        return np.asarray(np.linalg.eigvalsh(cov)[..., -1])

    def mix(self, cov: Array) -> Array:
        """A mean of axes in which the longest count most."""
        values, axes = np.linalg.eigh(cov)
        share = (np.maximum(values, 0.0) / values[-1]) ** SOFT
        return np.asarray((axes * (share / share.sum())) @ axes.T)

    def after(self, cov: Array, rows: Array) -> Array:
        """Of that mean."""
        return left(cov, self.mix(cov), rows)


def turned(cov: Array, rows: Array) -> tuple[Array, Array]:
    """A C (c, r, f) and 1 + A C A' (c, r, r) for rows A (c, r, f)."""
    c, r, f = rows.shape
    across = (rows.reshape(c * r, f) @ cov).reshape(c, r, f)
    inner = across @ np.swapaxes(rows, 1, 2)
    inner[:, np.arange(r), np.arange(r)] += 1.0
    return across, inner


def left(cov: Array, weight: Array, rows: Array) -> Array:
    """(c,) tr((M + A'A)^-1 W) = tr(CW) - tr((1 + A C A')^-1 A C W C A') [Woodbury 1950]."""
    c, r, f = rows.shape
    across, inner = turned(cov, rows)
    outer = (across.reshape(c * r, f) @ weight).reshape(c, r, f) @ np.swapaxes(across, 1, 2)
    gain = np.einsum("cii->c", np.linalg.solve(inner, outer))
    return np.asarray(np.einsum("ij,ij->", cov, weight) - gain)


def inverse(info: Array) -> Array:
    """Covariances (..., f, f) of information matrices; infinite where they tell not everything."""
    scale = np.sqrt(np.maximum(np.einsum("...ii->...i", info), 1e-300))
    both = scale[..., :, None] * scale[..., None, :]
    values, axes = np.linalg.eigh(info / both)
    whole = values[..., 0] > 1e-13 * values[..., -1]
    safe = np.where(whole[..., None], values, 1.0)
    out = (axes / safe[..., None, :]) @ np.swapaxes(axes, -1, -2) / both
    return np.where(whole[..., None, None], out, np.inf)


def sizes_of(criterion: Criterion, info: Array) -> Array:
    """(...,) sizes of the covariances that information (..., f, f) leaves; infinite if singular."""
    cov = inverse(info)
    whole = np.asarray(np.isfinite(cov).all(axis=(-2, -1)))
    safe = np.where(whole[..., None, None], cov, np.eye(cov.shape[-1]))
    return np.where(whole, criterion.size(safe), np.inf)


def size_of(criterion: Criterion, info: Array) -> float:
    """`sizes_of` one information matrix."""
    return float(sizes_of(criterion, info))
