"""How far the errors shrink on poses that no fit has seen, and what noise alone would leave."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from minimax_cal.core.arrays import Array
from minimax_cal.core.linear_algebra import jackknife_variance, project_out
from minimax_cal.diagnosing.diagnosis import (
    MOTION_UNITS_WITHOUT_MASSES,
    BudgetStep,
    Finding,
    motion_unit,
)
from minimax_cal.diagnosing.joint_fit import GeometryEffectFit, fit_geometry_and_effects
from minimax_cal.diagnosing.linear_trials import TrialColumns, TrialFit
from minimax_cal.diagnosing.study import LinearisedGeometry
from minimax_cal.fitting.accuracy import summarise_point_errors
from minimax_cal.fitting.noise_floor import NoiseFloor
from minimax_cal.fitting.region_holdout import refit_without_regions
from minimax_cal.fitting.session_frames import count_frame_parameters
from minimax_cal.measuring.faults import correct_faults, find_outlier_faults
from minimax_cal.measuring.faults.target_steps import TARGET_RESEAT_EFFECT
from minimax_cal.measuring.measurements import Measurements
from minimax_cal.measuring.pose_groups import cluster_poses
from minimax_cal.modelling.cell import Cell
from minimax_cal.modelling.effects.joint_error_maps import fitted_map_curve
from minimax_cal.modelling.effects.scene import PosedArm, joint_index_from_place
from minimax_cal.modelling.effects.table import EFFECTS, Term
from minimax_cal.selection.thresholds import (
    BUDGET_FOLD_COUNT,
    DRIVER_END_QUANTILE,
    MIN_GEOMETRIC_OUTLIER_FRACTION,
    MIN_RELATIVE_HELDOUT_GAIN,
    MINOR_EFFECT_SQUARE_FRACTION,
    UNINFORMATIVE_INTERVAL_WIDTH,
)

BOOTSTRAP_RESAMPLE_COUNT = 1000
MIN_RESAMPLES_WITH_GAP = 100  # of them that show a gap
MAX_RELATIVE_ROUNDING = 1e-9  # share of a squared error that is none
JACKKNIFE_GROUP_COUNT = 10  # groups of training poses that are left out in turn, for the interval
MENDED_FAULT_NAMES = (
    "outliers",
    "swapped_rows",
    TARGET_RESEAT_EFFECT,
)  # that are mended before anything is fitted

IntervalEnds = tuple[float, float]


class LazyJointFits(Sequence[GeometryEffectFit]):
    """Geometry, then with each of some effects more; each fit is made when it is first asked for.

    steps: the terms of each effect.  made: fits by their number.  The first of them make none.
    """

    def __init__(
        self,
        study: LinearisedGeometry,
        steps: Sequence[Sequence[Term]],
        made: dict[int, GeometryEffectFit] | None = None,
    ) -> None:
        self.study, self.steps = study, steps
        self.made = {} if made is None else made

    def __len__(self) -> int:
        return 1 + len(self.steps)

    def __getitem__(self, at: Any) -> Any:
        if isinstance(at, slice):
            start, stop, step = at.indices(len(self))
            if (start, step) == (0, 1) and stop:
                return LazyJointFits(self.study, self.steps[: stop - 1], self.made)
            return [self[i] for i in range(start, stop, step)]
        number = range(len(self))[at]
        if number not in self.made:
            terms = [term for some in self.steps[:number] for term in some]
            self.made[number] = fit_geometry_and_effects(self.study, terms)
        return self.made[number]


@dataclass(frozen=True, eq=False)
class BudgetSteps:
    """Geometry, then with each effect that helps, those that are confirmed first.

    taken_numbers: numbers of the effects that the ladder took.  With the others groups of poses
    that were left out, or the training poses themselves, are met no better. fold_masks: masks (m,)
    of those groups.  confirmed_count: how many of those taken are confirmed.
    """

    joint_fits: Sequence[GeometryEffectFit]
    taken_numbers: tuple[int, ...]
    fold_masks: tuple[Array, ...]
    confirmed_count: int

    @property
    def confirmed_steps(self) -> BudgetSteps:
        """As far as it is recommended."""
        return replace(
            self,
            joint_fits=self.joint_fits[: 1 + self.confirmed_count],
            taken_numbers=self.taken_numbers[: self.confirmed_count],
        )

    @property
    def last_fit(self) -> GeometryEffectFit:
        """With every effect taken."""
        return self.joint_fits[-1]

    @property
    def error_map_terms(self) -> tuple[Term, ...]:
        """The error maps of joints that it took."""
        return tuple(term for term in self.last_fit.terms if EFFECTS[term.effect].is_map)


def assign_folds(data: Measurements, fold_count: int) -> Array:
    """(m,) number of a fold, groups of poses together, at random."""
    group = cluster_poses(data)
    order = np.random.default_rng(0).permutation(int(group.max()) + 1)
    return np.asarray(order[group] % fold_count)


def fit_budget_steps(
    study: LinearisedGeometry,
    effects: Sequence[Sequence[Term]],
    are_confirmed: Sequence[bool],
    *,
    are_best_guesses: bool = False,
) -> BudgetSteps:
    """The ladder of a study's effects, in their order; with maps of joints the largest first.

    Those that are sure come first: what is recommended is fitted without the others.

    What is refused is tried again beside what was taken after it: beside errors much larger than
    its own the prior of a map is too wide.

    are_best_guesses: whether effects are a best guess: structure is left, or names change with the
    poses. Then laws of a joint's angle, or of the time, must predict the ends of what drives them,
    left out, no worse either.
    """
    part, trials = assign_folds(study.data, BUDGET_FOLD_COUNT), TrialColumns(study, effects)
    last, taken = trials.fit_trial(()), list[int]()
    spared = last.select_dispensable_folds([part == number for number in range(BUDGET_FOLD_COUNT)])
    mapped = any(EFFECTS[term.effect].is_map for terms in effects for term in terms)
    order = order_by_motion_size(trials, study, effects) if mapped else list(range(len(effects)))

    def helps(wide: TrialFit, number: int) -> bool:
        both = wide.select_dispensable_folds(spared)
        better = wide.cross_validate_folds(both) < (
            1.0 - MIN_RELATIVE_HELDOUT_GAIN
        ) * last.cross_validate_folds(both)
        if not (better and wide.fits_no_worse(last)):
            return False
        ends = select_driver_ends(study.scene, effects[number][0]) if are_best_guesses else []
        both = wide.select_dispensable_folds(last.select_dispensable_folds(ends))
        return wide.cross_validate_folds(both) <= last.cross_validate_folds(both)

    for first in (True, False):
        waiting = [number for number in order if are_confirmed[number] == first]
        while waiting:
            refused: list[tuple[int, int]] = []  # with how many were taken before
            for number in waiting:
                wide = trials.fit_trial((*taken, number))
                if helps(wide, number):
                    last = wide
                    taken.append(number)
                else:
                    refused.append((number, len(taken)))
            waiting = [number for number, before in refused if mapped and before < len(taken)]
    fits = LazyJointFits(study, [effects[number] for number in taken])
    confirmed = sum(are_confirmed[number] for number in taken)
    return BudgetSteps(fits, tuple(taken), tuple(spared), confirmed)


def order_by_motion_size(
    trials: TrialColumns, study: LinearisedGeometry, effects: Sequence[Sequence[Term]]
) -> list[int]:
    """Effects in the order of how far they move the points beside what geometry does.

    All are fitted together; rows weigh as those in which they were sought.
    """
    whole, rows = np.zeros((len(effects), len(study.rows.error))), study.rows
    values, at = trials.fit_trial(range(len(effects))).values, 0
    for number, terms in enumerate(effects):
        for term in terms:
            if term.frees_session_frames:
                continue
            fields = term.columns(study.scene).target_displacements(study.scene)
            value = values[at : at + len(fields)]
            at += len(fields)
            whole[number] += rows.rows_from_fields(np.tensordot(value, fields, 1)[None])[:, 0]
    clear = project_out(whole.T, rows.nuisance_basis)
    return [int(number) for number in np.argsort(-(clear**2).sum(axis=0), kind="stable")]


def select_driver_ends(scene: PosedArm, term: Term) -> list[Array]:
    """Poses (m,) at both ends of the angle or the time that a law follows; none of other laws.

    A map is nothing outside the angles that were measured.
    """
    effect, driver = EFFECTS[term.effect], np.zeros(0)
    if effect.follows == "time":
        driver = scene.column("clock")
    elif effect.follows_own_angle and not effect.is_map and term.place != "all":
        driver = scene.q[joint_index_from_place(term.place)]
    if not driver.size or np.ptp(driver) == 0.0:
        return []
    low, high = np.quantile(driver, (DRIVER_END_QUANTILE, 1.0 - DRIVER_END_QUANTILE))
    return [driver <= low, driver >= high]


def fill_fitted_values(findings: Sequence[Finding], budget: BudgetSteps) -> list[Finding]:
    """The findings that a ladder took, with values and sigmas of its last fit."""
    out, last = [], budget.last_fit
    at = len(budget.joint_fits[0].parameter_values.effects)  # after the frames of sessions
    geometric = last.model.names.geometric_count
    sigma = last.uncertainty.sigma[geometric:] if budget.taken_numbers else np.zeros(0)
    for finding in [findings[number] for number in budget.taken_numbers]:
        own = slice(at, at + len(finding.values))
        at = own.stop
        values, sure = last.parameter_values.effects[own], sigma[own].tolist()
        motion, term, curve = (
            max_motion_per_unit(last.study.scene, finding),
            finding.term,
            finding.curve,
        )
        if EFFECTS[term.effect].is_map:
            sign = float(last.study.robot.sign[joint_index_from_place(term.place)])
            covers = slice(geometric + own.start, geometric + own.stop)
            covariance = last.uncertainty.covariance[covers, covers]
            curve = fitted_map_curve(term.choice, sign, values, covariance)
        new = replace(finding, values=tuple(values.tolist()), sigmas=tuple(sure), motion=motion)
        out.append(replace(new, curve=curve))
    return out


def max_motion_per_unit(scene: PosedArm, finding: Finding) -> tuple[float, ...]:
    """The largest motion per unit of each parameter, where its unit rests on assumed masses.

    Turns of a joint [rad], or motion of a target [m].
    """
    told = scene.has_known_masses or scene.has_measured_torques
    units = {motion_unit(finding.term.effect, unit) for unit in finding.units}
    if told or "" in units:
        return ()
    out: list[float] = []
    for term in finding.terms:
        columns = term.columns(scene)
        turns = units == {MOTION_UNITS_WITHOUT_MASSES["rad/(N m)"]}
        fields = columns.turn if turns else columns.target_displacements(scene)
        size = np.abs(fields) if turns else np.linalg.norm(fields, axis=2)
        out += [float(part.max()) for part in size]
    return tuple(out)


# ---- accuracy ----------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class JudgingPoses:
    """Poses that judge: those of the fit, those held out, and points held out that stand out.

    outlier_mask: (m, k) True for points of `heldout_measurements` that no sound arm shows.
    holdout_by: whose groups are left out in turn, as in `pose_groups.list_holdout_regions`.
    """

    training_measurements: Measurements
    heldout_measurements: Measurements
    outlier_mask: Array
    holdout_by: str | None = None

    @staticmethod
    def from_measurements(
        heldout_measurements: Measurements,
        reordered_measurements: Measurements,
        clean_measurements: Measurements,
        training_measurements: Measurements,
        holdout_by: str | None,
    ) -> JudgingPoses:
        """Every held-out point as measured, those that stand out marked.

        reordered_measurements: points that stood in each other's rows put back.
        clean_measurements: without faults.
        """
        right = dict(zip(reordered_measurements.line, reordered_measurements.y, strict=True))
        y = [
            right.get(line, heldout_measurements.y[i])
            for i, line in enumerate(heldout_measurements.line)
        ]
        heldout_measurements = heldout_measurements.with_y(np.array(y))
        sound = select_rows_by_line(
            heldout_measurements.line, clean_measurements.line, clean_measurements.seen
        )
        return JudgingPoses(
            training_measurements,
            heldout_measurements,
            heldout_measurements.seen & ~sound,
            holdout_by,
        )

    @property
    def all_measurements(self) -> Measurements:
        """All poses in the order of the file, held-out points that stand out NaN."""
        y = np.where(self.outlier_mask[..., None], np.nan, self.heldout_measurements.y)
        every = self.training_measurements.append_measurements(self.heldout_measurements.with_y(y))
        return every.take(np.argsort(every.line, kind="stable"))

    @property
    def all_seen_measurements(self) -> Measurements:
        """The same without poses of which nothing is left."""
        whole = self.all_measurements
        return whole.take(np.asarray(whole.seen.any(axis=1)))

    def mark_outliers(
        self, geometric_cell: Cell, last_cell: Cell
    ) -> tuple[JudgingPoses, tuple[str, ...]]:
        """With what stands out from the last fit marked too, and the points, of all poses.

        What geometry leaves may hide a point that is off by less.  Of one that is wrong the first
        fit, of geometry alone, says nearly the same: one that only the last misses is its own.
        """
        whole = self.all_measurements
        before, error = (cell.error(whole) for cell in (geometric_cell, last_cell))
        sound = correct_faults(
            whole, find_outlier_faults(last_cell.align_to_first_session(whole), error)
        ).seen
        alike = (before * error).sum(axis=-1) > MIN_GEOMETRIC_OUTLIER_FRACTION * (error**2).sum(
            axis=-1
        )
        far = whole.seen & ~sound & alike
        points = [
            f"{whole.called(whole.line[row])} {whole.target_names[i]}"
            for row, i in np.argwhere(far)
        ]
        more = select_rows_by_line(self.heldout_measurements.line, whole.line, far)
        return replace(self, outlier_mask=self.outlier_mask | more), tuple(points)

    def judge_cell(self, name: str, cell: Cell) -> BudgetStep:
        """A rung: the accuracy of a cell."""
        every, trusted = cell.error(self.heldout_measurements), self.heldout_errors(cell)
        return BudgetStep(
            name,
            summarise_point_errors(cell.error(self.training_measurements)),
            summarise_point_errors(every),
            summarise_point_errors(trusted),
        )

    def heldout_errors(self, cell: Cell) -> Array:
        """(m, k, 3) of a cell at the held-out poses, NaN for what stands out [m]."""
        return np.where(self.outlier_mask[..., None], np.nan, cell.error(self.heldout_measurements))


def select_rows_by_line(wanted_lines: Array, row_lines: Array, row_values: Array) -> Array:
    """(w, k) of some lines of the file their rows, False for those that are not there.

    row_lines: (m,) of the rows (m, k).
    """
    known, nothing = (
        dict(zip(row_lines, row_values, strict=True)),
        np.zeros(row_values.shape[1], dtype=bool),
    )
    return np.array([known.get(one, nothing) for one in wanted_lines])


def fill_error_fractions(
    findings: Sequence[Finding], steps: Sequence[BudgetStep], noise_floor_mm: float
) -> list[Finding]:
    """Findings with the held-out RMS before and after, and their shares of the gap, largest first.

    Faults that are mended share the first step after geometry.  Points that stand out judge none.
    """
    whole = steps[1].trusted.rms_mm ** 2
    gap = (
        whole - noise_floor_mm**2
        if noise_floor_mm**2 < whole * (1.0 - MAX_RELATIVE_ROUNDING)
        else np.nan
    )
    out, at = [], 1
    of_data = [f for f in findings if f.rows or f.term.effect not in EFFECTS]
    mendable = [f for f in of_data if f.term.effect in MENDED_FAULT_NAMES]
    geometric = steps[2 if mendable else 1].trusted.rms_mm ** 2
    for found in findings:
        fault = found in mendable
        if not fault and found.term.effect == "readback":
            out.append(found)
            continue
        low = 2 if fault else (at + 1 if at > 1 or not mendable else 3)
        before, after = steps[low - 1].trusted.rms_mm, steps[low].trusted.rms_mm
        at = low if not fault or found is mendable[-1] else at
        share = min((before**2 - after**2) / gap, 1.0) / (len(mendable) if fault else 1)
        minor = not fault and before**2 - after**2 < MINOR_EFFECT_SQUARE_FRACTION * geometric
        out.append(replace(found, before=before, after=after, share=share, minor=minor))
    return sorted(out, key=lambda f: -f.share if np.isfinite(f.share) else -np.inf)


# ---- how much is closed ------------------------------------------------------------------------


def explained_fraction(
    budget: BudgetSteps, judging_poses: JudgingPoses, floor: NoiseFloor, seed: int
) -> tuple[float, IntervalEnds]:
    """Share of the gap that a ladder closes on held-out poses, and its 95 % interval."""
    before, after = (
        judging_poses.heldout_errors(fit.cell) for fit in (budget.joint_fits[0], budget.last_fit)
    )
    variance, rng = (
        jackknife_explained_fraction(budget, judging_poses, floor),
        np.random.default_rng(seed),
    )
    return clip_explained_fraction(
        *estimate_explained_fraction(
            before, after, cluster_poses(judging_poses.heldout_measurements), floor, variance, rng
        )
    )


def clip_explained_fraction(
    share: float, interval_ends: IntervalEnds
) -> tuple[float, IntervalEnds]:
    """A share and its interval between 0 and 1; NaN for an interval that says nothing."""
    low, high = np.clip(interval_ends, 0.0, 1.0).tolist()
    if not high - low < UNINFORMATIVE_INTERVAL_WIDTH:
        low = high = float("nan")
    return float(np.clip(share, 0.0, 1.0)), (low, high)


def estimate_explained_fraction(
    errors_before: Array,
    errors_after: Array,
    pose_groups: Array,
    floor: NoiseFloor,
    training_variance: float,
    rng: np.random.Generator,
) -> tuple[float, IntervalEnds]:
    """Share of the gap that is closed, and its 95 % interval.

    1 - (after^2 - floor^2) / (before^2 - floor^2) of the RMS distances; NaN where there is no gap.
    Groups of poses and the floor are drawn anew; what other poses of the fit would change is the
    variance.  errors_before, errors_after: (m, k, 3) errors of the same poses [m].  pose_groups:
    (m,).
    """
    pair = [error_squares_and_counts(error) for error in (errors_before, errors_after)]
    share = float(
        compute_explained_fraction(
            [part.sum(axis=1) for part in pair], np.array([floor.lower_limit_mm])
        )[0]
    )
    if not np.isfinite(share):
        return share, (share, share)
    pose_groups = np.unique(pose_groups, return_inverse=True)[1].reshape(-1)
    count = int(pose_groups.max()) + 1
    whole = [np.stack([np.bincount(pose_groups, row, count) for row in part]) for part in pair]
    rows = rng.integers(0, count, (BOOTSTRAP_RESAMPLE_COUNT, count))
    drawn = compute_explained_fraction(
        [part[:, rows].sum(axis=-1) for part in whole],
        floor.sample_values_mm(BOOTSTRAP_RESAMPLE_COUNT, rng),
    )
    drawn = drawn[np.isfinite(drawn)]
    if len(drawn) < MIN_RESAMPLES_WITH_GAP:
        return share, (float("nan"), float("nan"))
    middle = float(np.median(drawn))
    grow = np.sqrt(1.0 + training_variance / max(float(np.var(drawn)), 1e-300))
    low, high = middle + grow * (np.quantile(drawn, (0.025, 0.975)) - middle)
    return share, (float(min(low, share)), float(max(high, share)))


def error_squares_and_counts(point_errors: Array) -> Array:
    """(2, m) sum of squares [mm^2] and number of points of each pose.  point_errors: (m, k, 3)
    [m].
    """
    squares = np.nansum(1e6 * (point_errors**2).sum(axis=-1), axis=1)
    return np.stack([squares, np.isfinite(point_errors[..., 0]).sum(axis=1)])


def compute_explained_fraction(squares_before_and_after: Sequence[Array], floor: Array) -> Array:
    """Share of the gap closed, NaN where there is none.  squares_before_and_after: sums and counts
    (2, ...) [mm^2].
    """
    gap, rest = (part[0] / np.maximum(part[1], 1) - floor**2 for part in squares_before_and_after)
    return np.where(gap > 0.0, 1.0 - rest / np.where(gap > 0.0, gap, 1.0), np.nan)


def jackknife_explained_fraction(
    budget: BudgetSteps, judging_poses: JudgingPoses, floor: NoiseFloor
) -> float:
    """Variance of the share closed that the choice of training poses brings: a jackknife."""
    part, frames = (
        assign_folds(judging_poses.training_measurements, JACKKNIFE_GROUP_COUNT),
        count_frame_parameters(judging_poses.training_measurements.frames),
    )
    masks = [part == number for number in range(JACKKNIFE_GROUP_COUNT)]
    fits, known = (budget.joint_fits[0], budget.last_fit), np.zeros(0)
    for states in zip(
        *(refit_without_regions(f.estimator, f.parameter_values, masks, frames) for f in fits),
        strict=True,
    ):
        pair = [
            error_squares_and_counts(judging_poses.heldout_errors(fit.build_cell(state))).sum(
                axis=1
            )
            for fit, state in zip(fits, states, strict=True)
            if state is not None
        ]
        if len(pair) == len(fits):
            known = np.append(
                known, compute_explained_fraction(pair, np.array([floor.lower_limit_mm]))
            )
    known = known[np.isfinite(known)]
    return float(jackknife_variance(known)) if len(known) > 2 else 0.0
