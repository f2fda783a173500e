"""Points that stand out from a fit, each with the chance that an ordinary point does so.

A suspect is no verdict.  The point may be wrong, or the model: an effect that it lacks, such as a
compliant joint, makes errors of millimetres at the poses that load it.  So suspects are listed and
left to the reader.

A model that misses a point by much may lack an effect.  A second visit that misses it as well lacks
none: the arm stood there at the same joint values.  One of both is wrong, or something moved.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Annotated

import numpy as np
from scipy.special import betaln, fdtr, fdtrc, fdtri

from minimax_cal.core.arrays import Array
from minimax_cal.core.display_text import format_first_names
from minimax_cal.core.record_fields import FieldFormat
from minimax_cal.core.tables import Table
from minimax_cal.fitting.noise_floor import MIN_REVISITED_POSES
from minimax_cal.measuring.faults.data_fault import MIN_INSTRUMENT_NOISE
from minimax_cal.measuring.measurements import Measurements
from minimax_cal.measuring.pose_groups import group_agreeing_visits
from minimax_cal.modelling.parameters import ParameterValues
from minimax_cal.modelling.point_model import PointModel
from minimax_cal.solvers.least_squares import solve_normal_equations
from minimax_cal.solvers.scalar_minimum import minimise_scalar_between

FALSE_DISCOVERY_RATE = 0.01  # share of a list that is expected to be ordinary points
# a fit that leaves less of a direction's variance hides what is wrong there
MIN_VARIANCE_SHARE = 0.01
MIN_RELATIVE_PIVOT = (
    1e-10  # of each parameter's own weight: one that the kept points do not tell is open
)
MIN_POINTS_LEFT = 2.0 / 3.0  # of the points: where fewer are no suspects, all count
MIN_HELD_EXCESS = 1.5  # times what any point of the fit is off: a held-out point that is suspect
MIN_SCALE = 1e-7  # no instrument tells less [m]
TAIL_DOFS = (3.0, 4.0, 6.0, 10.0, 20.0)  # degrees of freedom of Student's t: heavy tails to light
MIN_TAIL_GAIN = 2.0  # gain in log-likelihood that makes tails heavier than the Gaussian's
MAX_SCALE_FIT_ROUNDS = 30
MAX_LOG_SCALE_CHANGE = 1e-8  # change of a log scale that ends its search

OUTLIER_EXPLANATION = (
    "a suspect may be a wrong point or a real effect that the fit lacks (a compliant joint moves a "
    "small arm by millimetres at the poses that load it); run minimax-cal diagnose before you "
    "delete a row"
)


@dataclass(frozen=True, eq=False)
class PointScores:
    """How far each point is from the fit, in what the noise and the fit's own error allow.

    square: (k, m) squared distance, standardised [m^2].  directions: (k, m) in how many
    directions the point was judged, 0 where not measured or where the fit follows the point.
    """

    square: Array
    directions: Array


def standardised_point_scores(
    model: PointModel, state: ParameterValues, weights: Array
) -> PointScores:
    """Standardised distances e' C^-1 e at a fit in which points had weights besides the model's.

    weights: (k, m), 0 for points that the fit has not used.  With whitened rows X_i of the
    Jacobian, A = sum w X'X + P and B = sum w^2 X'X + P (P the prior's weight) the error of point i
    has the covariance C = I - 2 w_i X_i A^-1 X_i' + X_i A^-1 B A^-1 X_i' in units of the noise:
    I - H for a point of the fit, I + H for another.  Either way the result is that of the point
    judged by all others [Cook and Weisberg 1982, "Residuals and Influence in Regression", ch. 2].
    """
    prior = np.diag(model.prior.weight[model.active])

    def gram(share: Array) -> Array:
        some = replace(model, weight=model.weight * share)
        return np.asarray(some.normal_equations(state, model.active).gram.sum(axis=0))

    every = gram(np.ones_like(weights))
    once = every if (weights == model.measured_mask).all() else gram(weights)
    twice = once if ((weights == 0.0) | (weights == 1.0)).all() else gram(weights**2)
    cover, spread = loo_covariance_terms(every, once, twice, prior)
    square, directions = np.zeros(weights.shape), np.zeros(weights.shape, dtype=int)
    for part, error, rows in model.iterate_errors_and_jacobians(state):
        if every is twice:  # all points count alike
            left = np.eye(3) - hat_matrix_blocks(rows, 2.0 * cover - spread)
        else:
            own = weights[:, part, None, None]
            left = (
                np.eye(3)
                - 2.0 * own * hat_matrix_blocks(rows, cover)
                + hat_matrix_blocks(rows, spread)
            )
        square[:, part], directions[:, part] = standardise_errors(left, np.swapaxes(error, 1, 2))
    return PointScores(square, np.where(model.measured_mask, directions, 0))


def loo_covariance_terms(
    gram: Array, weighted_gram: Array, twice_weighted_gram: Array, prior: Array
) -> tuple[Array, Array]:
    """A^-1 and A^-1 B A^-1 of `standardised_point_scores`, from Gram matrices of weights to the
    powers 0, 1 and 2.
    """
    ridge = MIN_RELATIVE_PIVOT * np.diag(np.diag(gram))
    cover = solve_normal_equations(weighted_gram + prior + ridge, np.eye(len(prior)))
    return cover, cover @ (twice_weighted_gram + prior) @ cover


def standardise_errors(covariance: Array, error: Array) -> tuple[Array, Array]:
    """Squares of errors (k, c, d) over their covariance (k, c, d, d), and in how many directions.

    Those of less variance than FOLLOWED are left out.
    """
    try:
        np.linalg.cholesky(covariance - MIN_VARIANCE_SHARE * np.eye(error.shape[-1]))
    except np.linalg.LinAlgError:
        share, axes = np.linalg.eigh(covariance)
        along = np.einsum("kcab,kca->kcb", axes, error)
        told = share > MIN_VARIANCE_SHARE
        square = (along**2 * told / np.where(told, share, 1.0)).sum(axis=-1)
        return square, told.sum(axis=-1)
    solved = np.linalg.solve(covariance, error[..., None])[..., 0]
    return (error * solved).sum(axis=-1), np.full(error.shape[:2], error.shape[-1])


def hat_matrix_blocks(rows: Array, matrix: Array) -> Array:
    """X_i M X_i' of every point: (k, c, d, d).  rows: (k, p, d, c).  matrix: M (p, p)."""
    k, p, *_ = rows.shape
    turned = (matrix @ rows.reshape(k, p, -1)).reshape(rows.shape)
    return np.asarray(np.einsum("kpac,kpbc->kcab", rows, turned))


@dataclass(frozen=True)
class StudentSpread:
    """Ordinary points scatter by Student's t: scale per coordinate [m], degrees of freedom."""

    scale: float
    dof: float

    def p_value(self, found: PointScores) -> Array:
        """(k, m) that an ordinary point is as far off or farther; 1 where it was not judged."""
        judged = found.directions > 0
        return np.where(
            judged, self.tail_probability(np.maximum(found.directions, 1), found.square), 1.0
        )

    def tail_probability(self, directions: Array, square: Array) -> Array:
        """Chance of a larger square [m^2] in so many directions."""
        return np.asarray(fdtrc(directions, self.dof, square / directions / self.scale**2))

    def is_outlier(self, found: PointScores) -> Array:
        """(k, m) True for the points that stand out, see `reject_by_false_discovery_rate`."""
        judged, kinds = found.directions > 0, np.arange(found.directions.max(initial=0)) + 1
        edge = fdtri(kinds, self.dof, 1.0 - FALSE_DISCOVERY_RATE) * kinds * self.scale**2
        directions, square = found.directions[judged], found.square[judged]
        near_edge = square > (1.0 - 1e-9) * edge[directions - 1]  # none below is unlikely
        p_value = np.ones(len(square))
        p_value[near_edge] = self.tail_probability(directions[near_edge], square[near_edge])
        out = np.zeros(judged.shape, dtype=bool)
        out[judged] = reject_by_false_discovery_rate(p_value)
        return out


def estimate_spread(scores: PointScores, dof: float) -> StudentSpread:
    """Scale and tails of the ordinary points, whatever the suspects are.

    The start is the median of the distances, taken for Gaussian.  In turn the suspects are listed
    and Student's t is fitted to the other points by maximum likelihood [Lange, Little and Taylor
    1989], which knows that their distances end where the suspects begin.  Errors of a model have
    heavy tails: they make the list shorter, while outliers beyond a gap do not.  dof: degrees of
    freedom of the fit, which the scale cannot have more of.
    """
    judged = scores.directions > 0
    directions = scores.directions[judged]
    mean_square = scores.square[judged] / directions
    if not len(mean_square):
        return StudentSpread(MIN_SCALE, 1.0)
    kinds = np.arange(directions.max()) + 1
    middle = np.median(mean_square / fdtri(kinds, dof, 0.5)[directions - 1])
    here = StudentSpread(max(float(np.sqrt(middle)), MIN_SCALE), dof)
    before = [np.zeros(len(mean_square), dtype=bool)]
    for _ in range(MAX_SCALE_FIT_ROUNDS):
        far = here.is_outlier(scores)[judged]
        if any(np.array_equal(far, other) for other in before):
            break
        before.append(far)
        edge = float(mean_square[far].min(initial=np.inf))
        here = fit_student_t(mean_square[~far], directions[~far], edge, dof, here.scale)
    if len(before) == 1:  # no suspects at the median's scale: the rest decides on the tails
        here = fit_student_t(mean_square, directions, np.inf, dof, here.scale)
    return here


def fit_student_t(
    mean_square: Array, directions: Array, edge: float, dof: float, usual: float
) -> StudentSpread:
    """Student's t by maximum likelihood from points below an edge; light tails if in doubt.

    mean_square: (n,) standardised squared distance per direction [m^2], which over the variance is
    distributed as F.  directions: (n,) directions.
    """
    known = np.maximum(mean_square, MIN_SCALE**2)
    kinds, times = np.unique(directions, return_counts=True)
    count, half, size = len(known), 0.5 * directions, directions * known
    constant, degrees = float((half - 1.0) @ np.log(known)), float((half - 1.0).sum())
    below = np.isfinite(edge)

    def loss(log_scale: float, tail: float) -> float:
        variance = math.exp(2.0 * log_scale)
        wide = float((half + 0.5 * tail) @ np.log1p(size / (variance * tail)))
        inside = float(times @ np.log(fdtr(kinds, tail, edge / variance))) if below else 0.0
        log_ratio = constant - degrees * 2.0 * log_scale
        return count * 2.0 * log_scale - log_ratio + wide - shapes[tail] + inside

    def shape(tail: float) -> float:
        own = 0.5 * kinds * np.log(kinds / tail) - betaln(0.5 * kinds, 0.5 * tail)
        return float(times @ own)

    tails = (dof, *(tail for tail in TAIL_DOFS if tail < dof))
    shapes = {tail: shape(tail) for tail in tails}
    low, high = math.log(usual) - 2.0, math.log(usual) + 2.0
    best: list[tuple[float, StudentSpread]] = []
    for tail in tails:
        if below:
            at, value = minimise_scalar_between(partial(loss, tail=tail), low, high)
        else:
            at = min(max(fit_log_scale(size, half, tail, math.log(usual)), low), high)
            value = loss(at, tail)
        doubt = MIN_TAIL_GAIN if tail < dof else 0.0
        spread = StudentSpread(max(float(np.exp(at)), MIN_SCALE), float(tail))
        best.append((value + doubt, spread))
    return min(best, key=lambda trial: trial[0])[1]


def fit_log_scale(size: Array, half: Array, tail: float, log_scale: float) -> float:
    """The log scale of `fit_student_t` where no edge cuts points off: the loss is convex in it
    [Newton].

    size: (n,) squares [m^2], half: (n,) half their directions.
    """
    weight, target = half + 0.5 * tail, float(half.sum())
    for _ in range(MAX_SCALE_FIT_ROUNDS):
        ratio = size * (math.exp(-2.0 * log_scale) / tail)
        share = ratio / (1.0 + ratio)
        step = 0.5 * (float(weight @ share) - target) / float(weight @ (share / (1.0 + ratio)))
        log_scale += min(max(step, -1.0), 1.0)
        if abs(step) <= MAX_LOG_SCALE_CHANGE:
            break
    return log_scale


def reject_by_false_discovery_rate(
    p_value: Array, false_discovery_rate: float = FALSE_DISCOVERY_RATE
) -> Array:
    """True for points that stand out, of any shape [Benjamini and Hochberg 1995].

    Of those listed a share `false_discovery_rate` is expected to be ordinary; without outliers the
    list is empty but for one data set in 1 / level.  That holds for points of one noise: where
    noise grows with range and no u95 tells, two to five times as many lists name an ordinary point.
    """
    order = np.sort(p_value, axis=None)
    count = len(order)
    below = np.flatnonzero(order <= false_discovery_rate * (np.arange(count) + 1.0) / max(count, 1))
    limit = order[below[-1]] if len(below) else -1.0
    return np.asarray(p_value <= limit)


@dataclass(frozen=True)
class Outlier:
    """A point that stands out from the fit.

    line: of the file.  distance: from the prediction [m].  score: the distance standardised by
    scale and leverage.  p_value: that an ordinary point scores as much.  together: whether all
    targets of the pose are suspects: then its joint values may be wrong.  held: whether the fit has
    not seen the pose.
    """

    line: int
    target: str
    distance: Annotated[float, FieldFormat(key="distance_mm", scale=1e3)]
    score: float
    p_value: Annotated[float, FieldFormat(key="chance")]
    together: bool
    held: bool = False

    def describe(self, data: Measurements) -> str:
        """Which, and how far off, for people."""
        return f"{data.called(self.line)} {self.target} {1e3 * self.distance:.3g} mm"


def list_outliers(
    model: PointModel,
    state: ParameterValues,
    scores: PointScores,
    spread: StudentSpread,
    file_lines: Array,
) -> tuple[Outlier, ...]:
    """The points that stand out, the least likely first.  file_lines: (m,) of the file."""
    far = spread.is_outlier(scores)
    if not far.any():
        return ()
    p_value = spread.p_value(scores)
    distance = np.linalg.norm(model.point_errors(state), axis=-1)  # (m, k), beside scores (k, m)
    score = np.sqrt(scores.square) / spread.scale
    together = (far == model.measured_mask).all(axis=0) & (model.measured_mask.sum(axis=0) > 1)
    where = sorted(np.argwhere(far).tolist(), key=lambda at: (p_value[*at], -score[*at]))
    return tuple(
        Outlier(
            line=int(file_lines[pose]),
            target=model.names.target_names[target],
            distance=float(distance[pose, target]),
            score=float(score[target, pose]),
            p_value=float(p_value[target, pose]),
            together=bool(together[pose]),
        )
        for target, pose in where
    )


def list_held_out_outliers(
    model: PointModel,
    state: ParameterValues,
    weights: Array,
    is_held: Array,
    spread: StudentSpread,
    file_lines: Array,
) -> tuple[Outlier, ...]:
    """The points that stand out among those that the fit has not seen, judged by those it has.

    A model's own errors are larger at poses that it has not seen: those listed are also
    `MIN_HELD_EXCESS` times farther off than any point of the fit.
    model: of all poses, with the fit's free parameters.  weights: (k, m) 0 where held out.
    spread: of ordinary points of the fit.  is_held: (m,).  file_lines: (m,) of the file.
    """
    if not is_held.any():
        return ()
    every = standardised_point_scores(model, state, weights)
    found = PointScores(every.square[:, is_held], every.directions[:, is_held])
    most = MIN_HELD_EXCESS * np.sqrt(every.square[weights > 0.0].max(initial=0.0)) / spread.scale
    told = list_outliers(model.take_poses(is_held), state, found, spread, file_lines[is_held])
    return tuple(replace(one, held=True) for one in told if one.score > most)


def mask_outliers(point_errors: Array, data: Measurements, suspects: Sequence[Outlier]) -> Array:
    """Errors (m, k, 3) without those of suspects, NaN there [m]."""
    out = point_errors.copy()
    for one in suspects:
        out[data.line == one.line, data.target_names.index(one.target)] = np.nan
    return out


def outlier_table(suspects: Sequence[Outlier], data: Measurements) -> Table:
    """The list for people."""
    return Table.from_rows(
        "outliers (1 % of the list are false alarms; they may be real effects)",
        [(data.called(s.line), s.target, 1e3 * s.distance, s.score, s.p_value,
          "held out" if s.held else "training", "all targets" if s.together else "")
         for s in suspects],
        "point | target | distance mm .4f | score .1f | p-value .1e | poses | of the pose",
    )  # fmt: skip


# ---- second visits -------------------------------------------------------------------------------


MIN_GUILTY_RATIO = 3.0  # times the error of the other visit: the one that is wrong
MAX_NAMED_PAIRS = 8  # pairs that are told
USUAL_REVISIT_QUANTILE = 0.95  # share of the other visits that keep to what is told of them
# times that: drift, growth and nests that shift part visits by less (blind_gap)
MIN_GROSS_RATIO = 4.0


def find_contradicting_points(data: Measurements, error: Array) -> Iterator[str]:
    """Which visits to one pose contradict each other, to people; nothing where none do.

    A visit does to which no other comes nearer than Student's t, fitted to all visits, allows
    [Benjamini and Hochberg 1995], by far.  The errors of a fit are compared, or the points where
    these are nearer to each other: moves between visits are in the points, noise of joints that
    were read back in the errors.  By far: beside how far visits are from half of the others of
    their pose, for joints that stop on either side part them into two groups.  Fewer than five
    poses that were visited again tell nothing.
    error: (m, k, 3), NaN unknown [m].
    """
    group = group_agreeing_visits(data)
    near = [nearest_revisits(part, group) for part in (error, data.y)]
    known = np.isfinite(near[0][0])
    if len(np.unique(group[known.any(axis=1)])) < MIN_REVISITED_POSES:
        return
    apart, other, amid = min(near, key=lambda visit: float(np.median(visit[0][known])))
    scores = PointScores(np.where(known, apart, 0.0) ** 2, 3 * known)
    far = estimate_spread(scores, 3.0 * known.sum()).is_outlier(scores)
    usual = (
        float(np.quantile(amid[known & ~far], USUAL_REVISIT_QUANTILE))
        if (known & ~far).any()
        else 0.0
    )
    far &= apart > max(MIN_GROSS_RATIO * usual, MIN_INSTRUMENT_NOISE)
    if not far.any():
        return
    size = np.linalg.norm(error, axis=-1)
    told: dict[tuple[int, int, int], str] = {}
    for row, target in sorted(np.argwhere(far), key=lambda at: -apart[tuple(at)]):
        pair = sorted((row, other[row, target]), key=lambda i: size[i, target])
        right, wrong = (data.called(data.line[i]) for i in pair)
        name, off = data.target_names[target], 1e3 * apart[row, target]
        guilty = size[pair[1], target] > MIN_GUILTY_RATIO * size[pair[0], target]
        text = f"{wrong} {name} is {off:.2g} mm from {right}"
        told.setdefault((*sorted(pair), target), text + (", which fits" if guilty else ""))
    yield (
        f"{data.source}: visits to one pose that contradict each other; of each pair one point is "
        f"wrong, or something moved (95 % of the others come within {1e3 * usual:.2g} mm): "
        f"{format_first_names(list(told.values()), MAX_NAMED_PAIRS, '; ')}"
    )


def nearest_revisits(points: Array, pose_groups: Array) -> tuple[Array, Array, Array]:
    """Of every visit its distance to the nearest other to the same pose, the row of that, and its
    median distance to the others.

    (m, k) [m], NaN where there is none.  points: (m, k, 3), NaN unknown.  pose_groups: (m,).
    """  # fmt: skip
    apart, amid = np.full((2, *points.shape[:2]), np.inf)
    other = np.zeros(points.shape[:2], dtype=int)
    names, counts = np.unique(pose_groups, return_counts=True)
    for name in names[counts > 1]:
        rows = np.flatnonzero(pose_groups == name)
        between = np.linalg.norm(points[rows, None] - points[rows], axis=-1)  # (r, r, k)
        between[range(len(rows)), range(len(rows))] = np.nan
        seen = np.isfinite(between).any(axis=1, keepdims=True)
        half = np.nanmedian(np.where(seen, between, 0.0), axis=1)
        amid[rows] = np.where(seen[:, 0], half, np.inf)
        between = np.where(np.isfinite(between), between, np.inf)
        apart[rows], other[rows] = between.min(axis=1), rows[between.argmin(axis=1)]
    return np.where(np.isfinite(apart), apart, np.nan), other, amid
