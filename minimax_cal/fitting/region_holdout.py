"""How a fit does on whole parts of the poses that it has not seen.

Poses held out at random stand among those of the fit, and tell nothing of places where none was
measured.  Here every part (`list_holdout_regions`) is left out in its turn, the fit is made again
of the rest, and the part judges it.  Parts that none can judge are counted and named.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Annotated

import numpy as np

from minimax_cal.core.arrays import Array
from minimax_cal.core.record_fields import FieldFormat, derived_field
from minimax_cal.core.results import JsonRecord
from minimax_cal.core.tables import Table
from minimax_cal.fitting.accuracy import (
    Accuracy,
    bootstrap_rms_interval,
    interval_for_display,
    predict_max_error_interval,
    summarise_point_errors,
)
from minimax_cal.fitting.identification import DEFAULT_RESOLUTION, select_redundant_parameters
from minimax_cal.fitting.joint_spans import (
    JointSpan,
    describe_spans,
    measure_joint_spans,
    select_narrow_spans,
    suggest_plan_command,
)
from minimax_cal.fitting.uncertainty import Estimator, LinearisedFit, PosewiseFit, RegionSums
from minimax_cal.measuring.measurements import Measurements
from minimax_cal.measuring.pose_groups import HoldoutRegion, group_repeated_poses
from minimax_cal.modelling.nearby_fit import fit_within_bounds_from_start, is_within_bounds
from minimax_cal.modelling.parameters import ParameterValues
from minimax_cal.modelling.point_model import PointLeastSquares
from minimax_cal.robots.robot import Robot
from minimax_cal.solvers.least_squares import solve_normal_equations
from minimax_cal.solvers.status import Status

# a part is needed, and not left out, if the condition without it is so much worse
MAX_CONDITION_GROWTH = 3.0
# of a part's error: a fit that another step would move there by less has arrived
MAX_SECOND_STEP = 5e-3
MAX_SHOWN_REGIONS = 4  # parts, the worst, for people
NO_REGION_LEFT_REASON = "every part of the poses is needed for the fit"


@dataclass(frozen=True)
class RegionError:
    """A part that was left out: RMS and largest distance there, and RMS with geometry alone."""

    where: str
    poses: int
    rms_mm: float
    max_mm: float
    geometric_mm: float


@dataclass(frozen=True)
class TrustedRegionErrors:
    """The same parts without the points that stand out: RMS of all, of the worst [mm], its name."""

    typical_mm: float
    worst_mm: float
    where: str


@dataclass(frozen=True)
class RegionHoldout(JsonRecord):
    """The claim for poses where none was measured.

    typical: RMS over all parts together.  worst: of the worst part.  Both [mm], NaN with a
    `reason` where nothing can be left out.  geometric: the same for geometry alone.  rms_high,
    max_high: upper 95 % limits, of the worst part and of the part with the largest distance [mm].
    missed: parts that could not be judged.  sought: whether effects were sought anew without each
    part; None without effects.  trusted: where held-out points stand out, which judge as well.
    spans: of every joint in the poses of the fit.  plan: the command that proposes poses over the
    whole range, where a joint went too little for a claim.
    """

    folds: tuple[RegionError, ...] = ()
    typical_mm: float = math.nan
    geometric_typical_mm: Annotated[float, FieldFormat(key="geometric.typical_mm")] = math.nan
    reason: Annotated[str, FieldFormat(brief=True)] = ""
    rms_high_mm: Annotated[float, FieldFormat(key="worst_high95_mm")] = math.nan
    max_high_mm: Annotated[float, FieldFormat(key="max_high95_mm")] = math.nan
    missed: Annotated[tuple[str, ...], FieldFormat(key="not_judged")] = ()
    sought: Annotated[bool | None, FieldFormat(key="effects_sought_anew")] = None
    trusted: Annotated[TrustedRegionErrors | None, FieldFormat(key="without_suspects")] = None
    spans: tuple[JointSpan, ...] = ()
    plan: str | None = None

    @property
    def narrow_spans(self) -> tuple[JointSpan, ...]:
        """The joints that went too little for a claim."""
        return select_narrow_spans(self.spans)

    @property
    def judged_region_text(self) -> str:
        """How many parts judged, of how many, where that is not all."""
        count = len(self.folds)
        return f"{count} of {count + len(self.missed)} parts" if self.missed else ""

    @property
    def kept_effects_text(self) -> str:
        """That the effects were given, a clause for people; empty where they were sought anew."""
        return ", with the same effects" if self.sought is False else ""

    @property
    def worst(self) -> RegionError | None:
        """The part with the largest RMS."""
        return max(self.folds, key=lambda fold: fold.rms_mm, default=None)

    @derived_field()
    def worst_mm(self) -> float:
        """Its RMS."""
        return self.worst.rms_mm if self.worst else math.nan

    @derived_field()
    def worst_where(self) -> str | None:
        """Where it is."""
        return self.worst.where if self.worst else None

    @property
    def largest_mm(self) -> float:
        """Largest distance in any part."""
        return max((fold.max_mm for fold in self.folds), default=math.nan)

    @derived_field(key="narrow")
    def narrow_joints(self) -> list[str]:
        """Names of the joints that went too little for a claim."""
        return [span.joint for span in self.narrow_spans]

    @derived_field(key="geometric.worst_mm")
    def geometric_worst_mm(self) -> float:
        """Largest RMS of geometry alone."""
        return max((fold.geometric_mm for fold in self.folds), default=math.nan)

    def sentence(self, how: str = "") -> str:
        """For the headline, empty where there is no claim and no joint that is the cause.

        how: what parts are predicted by, where effects are not kept.
        """
        if not self.worst:
            return (
                f"Outside the measured region nothing is claimed: {self.reason}."
                if self.narrow_spans
                else ""
            )
        parts = f"{len(self.folds)} parts"
        if self.missed:
            parts = f"{self.judged_region_text} (the fit needs the others)"
        less = ""
        if self.trusted:
            worst = f"{self.trusted.worst_mm:.3f} mm ({self.trusted.where})"
            less = f"; without outliers worst part {worst}"
        return (
            f"Outside the measured region, {parts} left out in turn and predicted from the rest"
            f"{self.kept_effects_text or how}: RMS {self.typical_mm:.3f}"
            f" mm, worst part {self.worst_mm:.3f} "
            f"mm RMS ({self.worst.where}), largest error {self.largest_mm:.3f} mm{less}."
        )

    def table(self) -> Table:
        """All parts together, and the worst few."""
        shown = sorted(self.folds, key=lambda fold: -fold.rms_mm)[:MAX_SHOWN_REGIONS]
        count = sum(fold.poses for fold in self.folds)
        whole = self.judged_region_text or f"all {len(self.folds)} parts"
        rows: list[tuple[object, ...]] = [
            (whole, count, self.typical_mm, self.largest_mm, self.geometric_typical_mm)
        ]
        if self.trusted:
            rows.append((f"{whole}, without suspects", count, self.trusted.typical_mm, None, None))
        how = f"each part judged by a fit without it{self.kept_effects_text}"
        return Table.from_records(
            f"outside the measured region: {how}, the worst ones",
            shown,
            "where=left out | poses d | rms_mm=RMS mm .4f | max_mm=max mm .4f | "
            "geometric_mm=geometry alone RMS mm .4f",
        ).with_rows(*(rows if shown else ()))


def check_joint_spans(robot: Robot, data: Measurements) -> RegionHoldout:
    """The joints' spans before any part is left out, and why there is no claim if one is narrow.

    data: the poses of the fit.
    """
    spans = measure_joint_spans(robot, data)
    few = select_narrow_spans(spans)
    if not few:
        return RegionHoldout(spans=spans)
    plan = suggest_plan_command(len(np.unique(group_repeated_poses(data))))
    reason = f"{describe_spans(few)}; measure over the whole range ({plan})"
    return RegionHoldout(reason=reason, spans=spans, plan=plan)


@dataclass(frozen=True, eq=False)
class RegionErrors:
    """Errors of parts that were left out: names, and (m_i, k, 3) of each [m].

    trusted: the same without points that stand out, NaN there.  missed: parts that cannot judge.
    """

    names: list[str] = field(default_factory=list)
    final: list[Array] = field(default_factory=list)
    geometric: list[Array] = field(default_factory=list)
    trusted: list[Array] = field(default_factory=list)
    missed: list[str] = field(default_factory=list)

    def add_region(
        self, name: str, final: Array, geometric: Array, doubted: Array | None = None
    ) -> None:
        """One part.  doubted: (m_i, k) True for points that stand out."""
        self.names.append(name)
        self.final.append(final)
        self.geometric.append(geometric)
        out = np.zeros(final.shape[:2], dtype=bool) if doubted is None else doubted
        self.trusted.append(np.where(out[..., None], np.nan, final))

    def build_region_holdout(
        self, reason: str = NO_REGION_LEFT_REASON, sought: bool | None = None
    ) -> RegionHoldout:
        """The claim.  reason: why there is none, if there is none.  sought: see `RegionHoldout`."""
        if not self.names:
            return RegionHoldout(reason=reason, missed=tuple(self.missed))
        every = [summarise_point_errors(error) for error in self.final]
        plain = [summarise_point_errors(error) for error in self.geometric]
        folds = tuple(
            RegionError(name, one.poses, one.rms_mm, one.max_mm, other.rms_mm)
            for name, one, other in zip(self.names, every, plain, strict=True)
        )
        return RegionHoldout(
            folds,
            pooled_rms_mm(every),
            pooled_rms_mm(plain),
            "",
            *self.upper_limits_mm(folds),
            missed=tuple(self.missed),
            sought=sought,
            trusted=self.build_trusted_errors(),
        )

    def build_trusted_errors(self) -> TrustedRegionErrors | None:
        """The claim of points that do not stand out, where others do."""
        lost = [np.isnan(less).sum() - np.isnan(error).sum()
                for less, error in zip(self.trusted, self.final, strict=True)]  # fmt: skip
        every = [summarise_point_errors(error) for error in self.trusted]
        told = [i for i, one in enumerate(every) if sum(one.counts)]
        if not any(lost) or not told:
            return None
        worst = max(told, key=lambda i: every[i].rms_mm)
        return TrustedRegionErrors(pooled_rms_mm(every), every[worst].rms_mm, self.names[worst])

    def upper_limits_mm(self, folds: Sequence[RegionError]) -> tuple[float, float]:
        """Upper 95 % limits of the largest RMS and of the largest distance [mm]."""
        rng = np.random.default_rng(0)
        worst, far = (
            max(range(len(folds)), key=lambda i: getattr(folds[i], kind))
            for kind in ("rms_mm", "max_mm")
        )
        rms = interval_for_display(
            bootstrap_rms_interval(self.final[worst], rng=rng), 1e-3 * folds[worst].rms_mm
        )
        largest = interval_for_display(
            predict_max_error_interval(self.final[far], rng=rng), 1e-3 * folds[far].max_mm
        )
        return 1e3 * rms.high, 1e3 * largest.high


def pooled_rms_mm(point_errors: Sequence[Accuracy]) -> float:
    """RMS over several sets of points [mm]."""
    total, count = (
        sum(sum(a.sse_mm2) for a in point_errors),
        sum(sum(a.counts) for a in point_errors),
    )
    return math.sqrt(total / count) if count else math.nan


def is_region_needed(poses: LinearisedFit, is_left_out: Array) -> bool:
    """Whether a fit loses parameters, or much sureness, without some poses.  is_left_out: mask
    (m,).
    """
    return bool(are_regions_needed(poses.normal_matrix, poses.gram_of_poses(is_left_out)[None])[0])


def are_regions_needed(normal_matrix: Array, region_matrices: Array) -> Array:
    """(f,) whether parameters are lost, or much sureness, without each of some parts of a sum.

    normal_matrix: J'J (p, p) of all poses.  region_matrices: (f, p, p) of each part.  What all
    poses hardly tell, as a gear's curve beside the joint's compliance, no part costs.
    """
    scale = np.sqrt(np.maximum(np.diag(normal_matrix), 1e-300))
    alike = np.concatenate([normal_matrix[None], normal_matrix - region_matrices]) / np.outer(
        scale, scale
    )
    size = np.sqrt(np.maximum(np.linalg.eigvalsh(alike), 0.0))
    kept = (size > DEFAULT_RESOLUTION * size[:, -1:]).sum(axis=1)
    whole, rest, had = size[0], size[1:], int(kept[0])
    wider = rest[:, -1] * whole[-had] > MAX_CONDITION_GROWTH * whole[-1] * rest[:, -had]
    return np.asarray((kept[1:] < had) | wider)


def step_without_poses(poses: LinearisedFit, is_left_out: Array) -> Array:
    """(p,) the step of the free parameters once some poses are left out.  is_left_out: mask
    (m,).
    """
    gram, gradient = poses.sums_of_poses(is_left_out)
    left = poses.gradient - gradient + poses.prior * poses.prior_deviation
    return solve_normal_equations(poses.normal_matrix - gram, left[:, None])[:, 0]


def refit_without_regions(
    estimator: Estimator,
    state: ParameterValues,
    region_masks: Sequence[Array],
    frame_parameter_count: int,
) -> list[ParameterValues | None]:
    """The fit without each of some parts, None where there is none.

    That is where the rest loses geometry: base, links, targets and the frames of further sessions.
    Parameters of effects that the rest does not tell it gives up, as a calibration of the rest
    would.  One step of Gauss and Newton from the whole fit is taken for the answer where a second
    would hardly move the part that is left out, and where effects keep their bounds; else the
    search goes on to its end.  The weights of targets and points stay as they were.

    region_masks: masks (m,) of the fit's poses.  frame_parameter_count: how many of the effects'
    parameters, the first, are those of the frames.
    """
    if not region_masks:
        return []
    poses, model = PosewiseFit(estimator, state), estimator.model
    free = np.flatnonzero(model.active) < model.names.geometric_count + frame_parameter_count
    every = poses.sums_by_part(region_masks)
    lost = are_regions_needed(
        poses.normal_matrix[np.ix_(free, free)], every.gram[:, free][:, :, free]
    )
    lost &= np.array([part.any() for part in region_masks])
    gone = np.array([unidentified_without_poses(poses, gram, ~free) for gram in every.gram])
    near = one_step_without_regions(poses, region_masks, every, ~lost & ~gone.any(axis=1))
    return [
        None if lost[i] else near.get(i) or fit_remaining_poses(poses, part, gone[i])
        for i, part in enumerate(region_masks)
    ]


def unidentified_without_poses(poses: PosewiseFit, is_left_out: Array, is_asked: Array) -> Array:
    """(p,) True for parameters that poses outside a part do not tell, as `identify.identify` asks.

    is_left_out: its J'AJ (p, p).  is_asked: (p,) those that may be given up.
    """
    out = np.zeros(len(is_asked), dtype=bool)
    if is_asked.any():
        gram = poses.normal_matrix - np.diag(poses.prior) - is_left_out
        own = np.maximum(np.diag(gram), 0.0)
        gram[np.diag_indices_from(gram)] = np.where(poses.prior > 0.0, 2.0 * own, own)
        every = np.ones(len(is_asked), dtype=bool)
        out[
            select_redundant_parameters(gram, every, np.flatnonzero(is_asked), DEFAULT_RESOLUTION)
        ] = True
    return out


def one_step_without_regions(
    poses: PosewiseFit, region_masks: Sequence[Array], states: RegionSums, is_allowed: Array
) -> dict[int, ParameterValues]:
    """Where one step leads without a part, for parts after which a second would hardly matter.

    It would where it moved the part's points by more than MAX_SECOND_STEP of their error in the
    whole fit.  That step is a simplified one of Newton, by the normal matrix of the first.

    region_masks: masks (m,), states: their sums.  is_allowed: (f,) False for parts that are not to
    be tried. Returns states by the number of the part.
    """
    model, whole, which = (
        poses.estimator.model,
        poses.estimator.fully_weighted_model,
        np.flatnonzero(is_allowed),
    )
    if not len(which):
        return {}
    own, rest = states.gram[which], poses.normal_matrix - states.gram[which]
    left = poses.gradient - states.gradient[which] + poses.prior * poses.prior_deviation
    first = solve_normal_equations(rest, left[..., None])[..., 0]
    near = PointLeastSquares(model).step(poses.state.repeat(len(which)), first)
    off = (model.prior.mean - model.parameter_vector(near))[:, model.active]
    gradient = (
        whole.gradients_under_pose_weights(near, ~np.array(region_masks)[which]) + poses.prior * off
    )
    more = solve_normal_equations(rest, gradient[..., None])
    motion = (np.swapaxes(more, 1, 2) @ own @ more)[:, 0, 0]
    arrived = motion <= MAX_SECOND_STEP**2 * states.square[which]  # not where it is no number
    found = {int(which[i]): near.take(np.array(i)) for i in np.flatnonzero(arrived)}
    return {part: at for part, at in found.items() if is_within_bounds(at, model.room)}


def fit_remaining_poses(
    poses: PosewiseFit, is_left_out: Array, is_dropped: Array
) -> ParameterValues | None:
    """The fit of the poses outside a part, None where the search does not end.

    is_left_out: mask (m,).  is_dropped: (p,) True for free parameters that then keep their nominal
    value.
    """
    estimator, state = poses.estimator, poses.state
    rest = estimator.at_poses(np.flatnonzero(~is_left_out)).fully_weighted_model
    active, free = rest.active.copy(), np.flatnonzero(rest.active)
    active[free[is_dropped]] = False
    effects, nominal = state.effects.copy(), rest.prior.mean[rest.names.geometric_count :]
    dropped = free[is_dropped] - rest.names.geometric_count
    effects[dropped] = nominal[dropped]
    found = fit_within_bounds_from_start(rest.with_active(active), replace(state, effects=effects))
    return found.x.take(np.array(0)) if found.status[0] is Status.CONVERGED else None


def judge_left_out_regions(
    estimator: Estimator,
    state: ParameterValues,
    train: Array,
    region_masks: Sequence[HoldoutRegion],
    compute_errors: Callable[[ParameterValues, Array], Array],
    is_outlier: Array,
    geometric: tuple[Estimator, ParameterValues] | None = None,
    frame_parameter_count: int = 0,
) -> RegionHoldout:
    """Every part judges the fit of the training poses outside it.

    train: (m,) True for training poses, of all.  compute_errors: errors (r, k, 3) of a state at
    some rows of all poses [m].  is_outlier: (m, k) True for points that stand out.  geometric: the
    fit without effects, where the fit has some.  frame_parameter_count: as `refit_without_regions`.
    """
    masks = [part.rows[train] for part in region_masks]
    fits = refit_without_regions(estimator, state, masks, frame_parameter_count)
    plain = refit_without_regions(*geometric, masks, frame_parameter_count) if geometric else fits
    errors = RegionErrors()
    for part, fit, other in zip(region_masks, fits, plain, strict=True):
        if fit and other:
            final = compute_errors(fit, part.rows)
            alone = compute_errors(other, part.rows) if geometric else final
            errors.add_region(part.name, final, alone, is_outlier[part.rows])
        else:
            errors.missed.append(part.name)
    if not region_masks:
        return RegionHoldout(reason="the poses are too few or too much alike")
    return errors.build_region_holdout(sought=False if geometric else None)
