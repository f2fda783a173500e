"""Does anything remain?  One test of all that might, whatever its law.

What a fit leaves is asked for motions that follow smooth functions of something: components of
variance [Rao and Kleffe 1988].  A component's score is the squared length of its products with the
rows; simulated white rows tell how large it is by chance, and how large the largest of all.  A
motion may scatter more than the rest, and a visit be off by itself, which is no such function:
flipped signs of whole visits [Winkler et al. 2014] must not score as much either.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import groupby

import numpy as np

from minimax_cal.core.arrays import Array
from minimax_cal.core.linear_algebra import project_out
from minimax_cal.selection.noise_model import LinearProblem, Noise
from minimax_cal.selection.thresholds import MAX_TESTED_COMPONENT_P_VALUE, SIGN_FLIP_P_VALUE

MAX_VISITS_PER_BLOCK = 30  # visits to one pose in a block, whose cost grows with their cube


def correct_leverage(
    residuals: Array, basis: Array, row_covariances: Array, visit_groups: Array
) -> Array:
    """Residuals (m, 3k) with the covariance they had before the fit [Bell & McCaffrey 2002].

    Rows of covariance V_g = `row_covariances` (m, 3k, 3k), up to a factor, leave residuals of
    covariance V_g - H_gg V_g - V_g H_gg + sum_h H_gh V_h H_hg with H = QQ', Q = `fitted_basis` (m,
    3k, p).  All visits to a pose are one block g: the fit ties them together; of very many so many
    at a time.
    """
    middle = np.tensordot(basis, row_covariances @ basis, ((0, 1), (0, 1)))
    several = np.stack(
        [visit_groups, count_earlier_occurrences(visit_groups) // MAX_VISITS_PER_BLOCK]
    )
    _, place, count = np.unique(several, axis=1, return_inverse=True, return_counts=True)
    place, out = place.reshape(-1), np.empty_like(residuals)
    for visits in np.unique(count):
        alike = np.flatnonzero(count[place] == visits)
        chosen = alike[np.argsort(place[alike], kind="stable")].reshape(-1, visits)
        wide = visits * residuals.shape[1]
        block = np.zeros((len(chosen), visits, residuals.shape[1], visits, residuals.shape[1]))
        for visit in range(visits):
            block[:, visit, :, visit] = row_covariances[chosen[:, visit]]
        even = correct_leverage_of_blocks(
            residuals[chosen].reshape(-1, wide),
            basis[chosen].reshape(-1, wide, basis.shape[2]),
            block.reshape(-1, wide, wide),
            middle,
        )
        out[chosen] = even.reshape(residuals[chosen].shape)
    return out


def count_earlier_occurrences(labels: Array) -> Array:
    """(m,) how often each row's number stands before it."""
    order = np.argsort(labels, kind="stable")
    known, first = labels[order], np.arange(len(labels))
    start = np.maximum.accumulate(np.where(np.append(True, known[1:] != known[:-1]), first, 0))
    out = np.empty_like(first)
    out[order] = first - start
    return out


def correct_leverage_of_blocks(
    residuals: Array, basis: Array, block_covariances: Array, basis_covariance: Array
) -> Array:
    """`correct_leverage` for blocks of one size.  basis_covariance: (p, p) sum of Q_g' V_g Q_g over
    all blocks.
    """
    back = np.swapaxes(basis, 1, 2)
    followed = basis @ (back @ block_covariances)
    left = (
        block_covariances - followed - np.swapaxes(followed, 1, 2) + basis @ basis_covariance @ back
    )
    factor = np.linalg.cholesky(block_covariances)
    white = np.linalg.solve(factor, np.swapaxes(np.linalg.solve(factor, left), 1, 2))
    value, vector = np.linalg.eigh(0.5 * (white + np.swapaxes(white, 1, 2)))
    turned = np.swapaxes(vector, 1, 2) @ np.linalg.solve(factor, residuals[..., None])
    stretch = 1.0 / np.sqrt(np.maximum(value, 0.1))  # a pose the fit has all but taken tells little
    return np.asarray((factor @ vector @ (stretch[..., None] * turned))[..., 0])


# ---- even errors ---------------------------------------------------------------------------------


RANDOM_DRAW_COUNT = 499  # of rows, and of signs: the least p-value that is reported is 0.002
MAX_SIGN_FLIPPED_COMPONENTS = 40  # of the loudest, at most, are asked whether they scatter
PLACE_DRIVER_SEPARATOR = " following "  # between a place and what drives it
MAX_REPORTED_COMPONENTS = 6  # components that are told at most


@dataclass(frozen=True, eq=False)
class FadingMemory:
    """A covariance of the visits that fades from each to the next.

    visit_order: (m,) the visits as they came.  lag_correlation: correlation of one with the next.
    """

    visit_order: Array
    lag_correlation: float

    def score_products(self, visit_products: Array) -> Array:
        """(b,) squares of what is felt (d, m, b), each visit adding to what is kept of the past."""
        kept, total = (
            np.zeros((len(visit_products), visit_products.shape[2])),
            np.zeros(visit_products.shape[2]),
        )
        for visit in self.visit_order.tolist():
            kept = self.lag_correlation * kept + visit_products[:, visit]
            total += (kept**2).sum(axis=0)
        return total


@dataclass(frozen=True, eq=False)
class StructureComponent:
    """What may remain: motions of a place that follow functions of a driver.

    motion_columns: (N, d) rows per unit.  driver_features: (w, f, m) of the visits, f functions in
    each of w ways, of which the loudest counts; or their covariance.
    """

    place: str
    driver: str
    motion_columns: Array
    driver_features: Array | FadingMemory

    @property
    def function_count(self) -> int:
        """How many functions its motion may follow."""
        return (
            self.driver_features.shape[1]
            if isinstance(self.driver_features, np.ndarray)
            else len(self.motion_columns)
        )


@dataclass(frozen=True)
class RemainingComponent:
    """A component that remains.

    score: as that of a standard normal variable.  p: chance that any of all components scores so
    much on white rows; 1 where any that is loud does by flipped signs.  square_fraction: of the
    square of what is left, as far as this component tells it.  function_count: how many it may
    follow.
    """

    place: str
    driver: str
    score: float
    p: float
    square_fraction: float
    function_count: int = 0

    @property
    def sort_key_by_fraction(self) -> tuple[float, int]:
        """What tells more of the error comes first, of equal ones that of fewer functions."""
        return -min(self.square_fraction, 1.0), self.function_count

    @property
    def place_and_driver(self) -> str:
        """For people."""
        return f"{self.place}{PLACE_DRIVER_SEPARATOR}{self.driver}"


@dataclass(frozen=True, eq=False)
class WhitenedResidual:
    """What is left, white under the null hypothesis.

    residuals: (N,).  fitted_basis: (N, p) orthonormal span of all that was fitted.  weight_roots:
    (N,) square roots of the weights.  degrees_of_freedom: degrees of freedom.  visit_groups: (m,)
    of visits to one pose, from 0.  row_rotations: (m, r, r) rotations of a visit's measurements
    into its rows.
    """

    residuals: Array
    fitted_basis: Array
    weight_roots: Array
    degrees_of_freedom: int
    visit_groups: Array
    row_rotations: Array

    @property
    def rows_per_visit(self) -> int:
        """Rows of a visit."""
        return int(self.row_rotations.shape[1])

    @property
    def residual_square(self) -> float:
        """Its square."""
        return float(self.residuals @ self.residuals)

    def leverage_corrected_rows(self) -> Array:
        """(N,) the rows as large as they were before the fit."""
        m, r = len(self.residuals) // self.rows_per_visit, self.rows_per_visit
        spread = np.broadcast_to(np.eye(r), (m, r, r))
        basis = self.fitted_basis.reshape(m, r, -1)
        return correct_leverage(
            self.residuals.reshape(m, r), basis, spread, self.visit_groups
        ).reshape(-1)

    def stack_with_projected_draws(self, random_rows: Array) -> Array:
        """(N, 1 + b) the rows, and drawn ones (N, b) without what was fitted."""
        return np.concatenate(
            [self.residuals[:, None], project_out(random_rows, self.fitted_basis)], axis=1
        )

    def visit_products(self, motion_columns: Array, row_vectors: Array) -> Array:
        """(d, m, b) products at each visit of motions (N, d) with rows (N, b)."""
        shape = len(self.visit_groups), self.rows_per_visit, -1
        weighted = (
            motion_columns * self.weight_roots[:, None]
        )  # and of one size each, without those fitted
        size = np.linalg.norm(weighted, axis=0)
        moved = (weighted[:, size > 0.0] / size[size > 0.0]).reshape(shape)
        return np.asarray(
            np.einsum("mwd,mwb->dmb", moved, row_vectors.reshape(shape), optimize=True)
        )


def whiten_residual(
    problem: LinearProblem, noise: Noise, fitted_columns: Array, row_rotations: Array
) -> WhitenedResidual:
    """Weighted rows without the span of nuisance and known columns (N, q).  row_rotations: as in
    `WhitenedResidual`.
    """
    root = np.sqrt(noise.row_weights(problem))
    columns = np.concatenate([problem.nuisance_basis, fitted_columns], axis=1) * root[:, None]
    norm = np.linalg.norm(columns, axis=0)
    basis = np.linalg.qr(columns[:, norm > 0] / norm[norm > 0])[0]
    rest = project_out(problem.error * root, basis)
    dof = problem.measured_row_count - basis.shape[1]
    return WhitenedResidual(
        rest, basis, root, dof, problem.row_groups[:: row_rotations.shape[1]], row_rotations
    )


@dataclass(frozen=True, eq=False)
class StructureTest:
    """What was asked of a rest, and how loud each component of it is.

    scores, p_values: (c,) as in `RemainingComponent`.  significant_numbers: numbers of those that
    chance does not make so loud, of which alone it is known whether they scatter.  rows_and_draws:
    (N, 1 + b) the rows, and rows by chance.
    """

    residual: WhitenedResidual
    components: Sequence[StructureComponent]
    scores: Array
    p_values: Array
    significant_numbers: Sequence[int]
    rows_and_draws: Array

    @property
    def significant_components(self) -> tuple[RemainingComponent, ...]:
        """Components that the rest may hold, the loudest first."""
        return self.select_most_significant(self.significant_numbers, MAX_REPORTED_COMPONENTS)

    def select_most_significant(
        self, component_numbers: Sequence[int], max_count: int
    ) -> tuple[RemainingComponent, ...]:
        """Of some components those that are least by chance."""
        order = sorted(component_numbers, key=lambda i: (self.p_values[i], -self.scores[i], i))
        return tuple(self.describe_component(i) for i in order[:max_count])

    def describe_component(self, component_number: int) -> RemainingComponent:
        """What is known of a component: with its share of the rest's square beyond chance.

        With z features of variance v the score |z'r|^2 is that by chance plus v |z'z|^2 (MINQUE);
        by chance, of rows of variance s, it has the mean s tr z'z and the variance 2 s^2 |z'z|^2.
        """
        one = self.components[component_number]
        felt, feature = (
            self.residual.visit_products(one.motion_columns, self.rows_and_draws),
            one.driver_features,
        )
        if not isinstance(feature, FadingMemory) and len(feature) > 1:
            ways = [max_squared_product(way[None], felt[..., :1])[0] for way in feature]
            feature = feature[[int(np.argmax(ways))]]
        found, *chance = max_squared_product(feature, felt).tolist()
        mean, spread = float(np.mean(chance)), float(np.var(chance))
        share = 2.0 * (found - mean) * mean / max(spread * self.residual.degrees_of_freedom, 1e-300)
        return RemainingComponent(
            one.place,
            one.driver,
            float(self.scores[component_number]),
            float(self.p_values[component_number]),
            float(max(share, 0.0)),
            one.function_count,
        )


def find_remaining_structure(
    residual: WhitenedResidual, components: Sequence[StructureComponent]
) -> StructureTest:
    """Every component that moves anything, asked of the rest together."""
    rng = np.random.default_rng(0)
    moving = [one for one in components if np.any(one.motion_columns)]
    # Drawn as measurements: the axes of rows that are alike, and all signs, are rounding's choice.
    measured = rng.normal(
        size=(len(residual.visit_groups), residual.rows_per_visit, RANDOM_DRAW_COUNT)
    )
    white = (np.swapaxes(residual.row_rotations, 1, 2) @ measured).reshape(-1, RANDOM_DRAW_COUNT)
    drawn = residual.stack_with_projected_draws(white * (residual.weight_roots > 0.0)[:, None])
    drawn[:, 1:] *= np.sqrt(residual.residual_square / max(residual.degrees_of_freedom, 1))
    if not moving:
        return StructureTest(residual, (), np.zeros(0), np.zeros(0), (), drawn)
    score, chance = scores_and_max_p_values(residual, moving, drawn)
    order = np.argsort(-score).tolist()
    loud = sorted(
        [i for i in order if chance[i] < MAX_TESTED_COMPONENT_P_VALUE][:MAX_SIGN_FLIPPED_COMPONENTS]
        or order[:1]
    )
    signs = np.repeat(
        rng.choice((-1.0, 1.0), (len(residual.visit_groups), RANDOM_DRAW_COUNT)),
        residual.rows_per_visit,
        axis=0,
    )
    flipped = residual.stack_with_projected_draws(
        signs * residual.leverage_corrected_rows()[:, None]
    )
    _, by_signs = scores_and_max_p_values(residual, [moving[i] for i in loud], flipped)
    p = chance.copy()
    p[loud] = np.where(by_signs > SIGN_FLIP_P_VALUE, 1.0, chance[loud])
    return StructureTest(residual, moving, score, p, loud, drawn)


def max_squared_product(driver_features: Array | FadingMemory, visit_products: Array) -> Array:
    """(b,) the largest squared product of the ways (w, f, m) with what is felt (d, m, b)."""
    if isinstance(driver_features, FadingMemory):
        return driver_features.score_products(visit_products)
    ways, count, visits = driver_features.shape
    told = driver_features.reshape(-1, visits) @ visit_products
    np.square(told, out=told)
    return np.asarray(
        told.reshape(len(visit_products), ways, count, -1).sum(axis=(0, 2)).max(axis=0)
    )


def scores_and_max_p_values(
    residual: WhitenedResidual, components: Sequence[StructureComponent], rows_and_draws: Array
) -> tuple[Array, Array]:
    """(c,) scores as of a standard normal variable, and chance that the largest of all is so large.

    rows_and_draws: (N, 1 + DRAWS), the rows, and rows by chance.
    """
    # Squared products with the rows, of all components of one motion together.
    found: list[Array] = []
    for _, same in groupby(components, key=lambda one: id(one.motion_columns)):
        several = list(same)
        felt = residual.visit_products(several[0].motion_columns, rows_and_draws)
        found += [max_squared_product(one.driver_features, felt) for one in several]
    scores = np.array(found)
    # Cube root of Wilson and Hilferty [1931], the degrees of freedom by the moments.
    mean, spread = scores[:, 1:].mean(axis=1)[:, None], scores[:, 1:].var(axis=1)[:, None]
    unit = 2.0 / 9.0 * spread / np.maximum(2.0 * mean**2, 1e-300)  # 2 / 9 of one over the freedom
    root = np.cbrt(scores / np.maximum(mean, 1e-300))
    score = (root - 1.0 + unit) / np.sqrt(np.maximum(unit, 1e-300))
    most = np.sort(score[:, 1:].max(axis=0))
    return score[:, 0], 1.0 - np.searchsorted(most, score[:, 0]) / (RANDOM_DRAW_COUNT + 1.0)
