"""Sizes of covariances: what a choice of experiments is judged by.

Each is a size that falls as 1/t when the information M = C^-1 grows by t, and whose inverse is
concave in M [Pukelsheim 1993, chapter 5].
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np

from minimax_cal.core.arrays import Array

LARGEST_VARIANCE_EXPONENT = (
    16.0  # how much the worst of several counts for more than the next worst
)


class OptimalityCriterion(Protocol):
    """A size of covariances (..., f, f); smaller is better."""

    def evaluate(self, covariance: Array) -> Array:
        """(...,) the size."""

    def equivalent_trace_weight(self, covariance: Array) -> Array:
        """W (f, f) with tr(CW) = size, or a little less where the worst of several counts."""

    def evaluate_after_adding(self, covariance: Array, experiment_sensitivities: Array) -> Array:
        """(c,) size once an experiment (c, r, f) is added; a lower bound where worst ones count."""


@dataclass(frozen=True)
class DeterminantCriterion:
    """D: the geometric mean of the variances along the axes of the confidence ellipsoid."""

    def evaluate(self, covariance: Array) -> Array:
        """det(C)^(1/f)."""
        sign, log = np.linalg.slogdet(covariance)
        return np.where(sign > 0.0, np.exp(log / covariance.shape[-1]), np.inf)

    def equivalent_trace_weight(self, covariance: Array) -> Array:
        """size/f times the inverse."""
        return np.asarray(np.linalg.inv(covariance) * self.evaluate(covariance) / len(covariance))

    def evaluate_after_adding(self, covariance: Array, experiment_sensitivities: Array) -> Array:
        """By det(M + A'A) = det(M) det(1 + A C A')."""
        _, inner = woodbury_products(covariance, experiment_sensitivities)
        log = np.linalg.slogdet(inner)[1]
        return np.asarray(self.evaluate(covariance) * np.exp(-log / len(covariance)))


@dataclass(frozen=True, eq=False)
class TraceCriterion:
    """A mean variance, tr(CW): A with W = 1/f, I with the mean of B'B over predictions B.

    weight: W (f, f) positive semi-definite.
    """

    weight: Array

    def evaluate(self, covariance: Array) -> Array:
        """tr(CW)."""
        return np.asarray(np.einsum("...ij,ij->...", covariance, self.weight))

    def equivalent_trace_weight(self, covariance: Array) -> Array:
        """W itself."""
        return self.weight

    def evaluate_after_adding(self, covariance: Array, experiment_sensitivities: Array) -> Array:
        """By the lemma of `weighted_trace_after_adding`."""
        return weighted_trace_after_adding(covariance, self.weight, experiment_sensitivities)


@dataclass(frozen=True, eq=False)
class LargestVarianceCriterion:
    """G: the largest of several variances tr(C W_g).

    weights: (g, f, f) positive semi-definite.
    """

    weights: Array

    def weighted_variances(self, covariance: Array) -> Array:
        """(..., g) variances."""
        flat = self.weights.reshape(len(self.weights), -1)
        return np.asarray(covariance.reshape(*covariance.shape[:-2], -1) @ flat.T)

    def evaluate(self, covariance: Array) -> Array:
        """The largest."""
        return np.asarray(self.weighted_variances(covariance).max(axis=-1))

    def equivalent_trace_weight(self, covariance: Array) -> Array:
        """A mean of the W_g in which the largest variances count most."""
        variance = self.weighted_variances(covariance)
        share = (variance / variance.max()) ** LARGEST_VARIANCE_EXPONENT
        return np.asarray(np.tensordot(share / share.sum(), self.weights, 1))

    def evaluate_after_adding(self, covariance: Array, experiment_sensitivities: Array) -> Array:
        """Of that mean."""
        return weighted_trace_after_adding(
            covariance, self.equivalent_trace_weight(covariance), experiment_sensitivities
        )


@dataclass(frozen=True)
class LargestEigenvalueCriterion:
    """E: the largest variance along any axis of the confidence ellipsoid."""

    def evaluate(self, covariance: Array) -> Array:
        """The largest eigenvalue of C."""
        return np.asarray(np.linalg.eigvalsh(covariance)[..., -1])

    def equivalent_trace_weight(self, covariance: Array) -> Array:
        """A mean of axes in which the longest count most."""
        values, axes = np.linalg.eigh(covariance)
        share = (np.maximum(values, 0.0) / values[-1]) ** LARGEST_VARIANCE_EXPONENT
        return np.asarray((axes * (share / share.sum())) @ axes.T)

    def evaluate_after_adding(self, covariance: Array, experiment_sensitivities: Array) -> Array:
        """Of that mean."""
        return weighted_trace_after_adding(
            covariance, self.equivalent_trace_weight(covariance), experiment_sensitivities
        )


class WoodburyProducts(NamedTuple):
    """A C (c, r, f) and 1 + A C A' (c, r, r)."""

    across: Array
    inner: Array


def woodbury_products(covariance: Array, experiment_sensitivities: Array) -> WoodburyProducts:
    """A C (c, r, f) and 1 + A C A' (c, r, r) for rows A (c, r, f)."""
    c, r, f = experiment_sensitivities.shape
    across = (experiment_sensitivities.reshape(c * r, f) @ covariance).reshape(c, r, f)
    inner = across @ np.swapaxes(experiment_sensitivities, 1, 2)
    inner[:, np.arange(r), np.arange(r)] += 1.0
    return WoodburyProducts(across, inner)


def weighted_trace_after_adding(
    covariance: Array, weight: Array, experiment_sensitivities: Array
) -> Array:
    """(c,) tr((M + A'A)^-1 W) = tr(CW) - tr((1 + A C A')^-1 A C W C A') [Woodbury 1950]."""
    c, r, f = experiment_sensitivities.shape
    across, inner = woodbury_products(covariance, experiment_sensitivities)
    outer = (across.reshape(c * r, f) @ weight).reshape(c, r, f) @ np.swapaxes(across, 1, 2)
    gain = np.einsum("cii->c", np.linalg.solve(inner, outer))
    return np.asarray(np.einsum("ij,ij->", covariance, weight) - gain)


def invert_information_matrices(information: Array) -> Array:
    """Covariances (..., f, f) of information matrices; infinite where they tell not everything."""
    scale = np.sqrt(np.maximum(np.einsum("...ii->...i", information), 1e-300))
    both = scale[..., :, None] * scale[..., None, :]
    values, axes = np.linalg.eigh(information / both)
    whole = values[..., 0] > 1e-13 * values[..., -1]
    safe = np.where(whole[..., None], values, 1.0)
    out = (axes / safe[..., None, :]) @ np.swapaxes(axes, -1, -2) / both
    return np.where(whole[..., None, None], out, np.inf)


def evaluate_information_matrices(criterion: OptimalityCriterion, information: Array) -> Array:
    """(...,) sizes of the covariances that information (..., f, f) leaves; infinite if singular."""
    cov = invert_information_matrices(information)
    whole = np.asarray(np.isfinite(cov).all(axis=(-2, -1)))
    safe = np.where(whole[..., None, None], cov, np.eye(cov.shape[-1]))
    return np.where(whole, criterion.evaluate(safe), np.inf)


def evaluate_information_matrix(criterion: OptimalityCriterion, information: Array) -> float:
    """`evaluate_information_matrices` one information matrix."""
    return float(evaluate_information_matrices(criterion, information))
