"""Is anything left?  What effects leave of an arm's errors, asked by `evidence.remains`.

error^2 = noise^2 + what depends on something^2 + what nothing explains^2.  A part that nobody has
measured is no number here: the scatter of the joints, which only visits to one pose tell.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from minimax_cal.core.arrays import Array
from minimax_cal.diagnosing.diagnosis import DriverDependence, RemainingError
from minimax_cal.diagnosing.study import LinearisedGeometry
from minimax_cal.fitting.noise_floor import (
    REPEATS,
    instrument_noise_without_joints,
    smallest_revisit_deviations,
)
from minimax_cal.measuring.measurements import Measurements
from minimax_cal.modelling.effects.scene import PosedArm
from minimax_cal.modelling.error_rows import PoseRows
from minimax_cal.modelling.remaining_components import list_error_components
from minimax_cal.selection.forward_selection import EffectSelection
from minimax_cal.selection.noise_model import LinearProblem, Noise, estimate_noise_by_reml
from minimax_cal.selection.remaining_structure import (
    RemainingComponent,
    StructureTest,
    find_remaining_structure,
    whiten_residual,
)
from minimax_cal.selection.thresholds import (
    MAX_ERROR_TO_INSTRUMENT_RATIO,
    MIN_COMPONENT_SQUARE_FRACTION,
    REMAINING_STRUCTURE_P_VALUE,
    SOUND_JOINT_JITTER_RAD,
)

MAX_SEPARATE_MOTION_PARAMETERS = 2  # parameters of an effect whose motions are asked each by itself
NO_REMAINING_COMPONENT = RemainingComponent("nothing", "anything", 0.0, 1.0, 0.0)


def find_remaining_components(
    study: LinearisedGeometry, selection: EffectSelection, more_columns: Array | None = None
) -> tuple[RemainingComponent, ...]:
    """What effects leave, the loudest first, whatever the masses are that they were told with.

    more_columns: (N, q) columns that were fitted besides.
    """
    known = (
        selection.effect_and_variation_columns
        if more_columns is None
        else np.concatenate([selection.effect_and_variation_columns, more_columns], axis=1)
    )
    if selection.noise.variance < study.rows.rounding_noise**2:
        return (NO_REMAINING_COMPONENT,)
    return find_remaining_component(study.scene, study.rows, known, list_effect_motions(selection))


def find_remaining_component(
    scene: PosedArm,
    rows: PoseRows,
    fitted_columns: Array,
    named_motions: Sequence[tuple[str, Array]] = (),
) -> tuple[RemainingComponent, ...]:
    """What geometry and known columns (N, q) leave.  named_motions: motions as
    `list_error_components` has them.
    """
    return compare_all_components(
        scene, rows, fitted_columns, named_motions
    ).significant_components or (NO_REMAINING_COMPONENT,)


def compare_all_components(
    scene: PosedArm,
    rows: PoseRows,
    fitted_columns: Array | None = None,
    named_motions: Sequence[tuple[str, Array]] = (),
) -> StructureTest:
    """Everything that may remain, asked of what geometry and known columns leave.

    As `find_remaining_component`.
    """
    columns = np.zeros((len(rows.error), 0)) if fitted_columns is None else fitted_columns
    noise = limit_joint_noise(estimate_noise_by_reml(rows, columns), rows)
    return find_remaining_structure(
        whiten_residual(rows, noise, columns, rows.turn),
        list(list_error_components(scene, rows, named_motions)),
    )


def limit_joint_noise(noise: Noise, rows: LinearProblem) -> Noise:
    """The noise, its joints no worse than sound ones are: more is lack of fit."""
    most = SOUND_JOINT_JITTER_RAD**2 * rows.mean_variance_ratio / noise.variance
    return replace(noise, joint_to_instrument_ratio=min(noise.joint_to_instrument_ratio, most))


def list_effect_motions(selection: EffectSelection) -> list[tuple[str, Array]]:
    """The effects with the rows of their motions: of few parameters each its own, else together."""
    out = []
    for candidate, (value, _) in zip(selection.candidates, selection.joint_estimates, strict=True):
        motion = selection.library.candidate_columns[:, candidate.column_indices]
        whole = (motion @ value)[:, None]
        out.append(
            (
                candidate.term.label,
                motion if motion.shape[1] <= MAX_SEPARATE_MOTION_PARAMETERS else whole,
            )
        )
    return out


def select_certain_components(components: Sequence[RemainingComponent]) -> list[RemainingComponent]:
    """What certainly remains and matters, what tells most of it first."""
    sure = [
        one
        for one in components
        if one.p < REMAINING_STRUCTURE_P_VALUE
        and one.square_fraction > MIN_COMPONENT_SQUARE_FRACTION
    ]
    return sorted(sure, key=lambda one: one.sort_key_by_fraction)


def most_telling_component(components: Sequence[RemainingComponent]) -> RemainingComponent | None:
    """Of what certainly remains and matters the loudest; None where nothing does."""
    return next(iter(select_certain_components(components)), None)


# ---- where each part is known from ---------------------------------------------------------------


def split_remaining_error(
    components: Sequence[RemainingComponent],
    remaining_rms_mm: float,
    data: Measurements,
    error: Array,
    max_noise_mm: float = math.inf,
) -> tuple[RemainingError, bool]:
    """What remains, and whether all noise beneath it is known.

    components: what the last step leaves, as asked of its poses.  remaining_rms_mm: RMS distance
    that it leaves at held-out poses [mm].  data: without faults; error: (m, k, 3) of its arm at
    them [m].  max_noise_mm: what noise is said to be at most, which few visits that are far off do
    not change [mm].
    """
    again = smallest_revisit_deviations(data, error)
    noise, source = instrument_noise_without_joints(data)
    if again:  # joints that stop on either side have no middle: by the mean of the squares
        noise, source = 1e3 * math.sqrt(float(again[0].mean())), REPEATS
    known = source == REPEATS or remaining_rms_mm <= MAX_ERROR_TO_INSTRUMENT_RATIO * noise
    noise = min(noise, remaining_rms_mm, max_noise_mm) if math.isfinite(noise) else noise
    rest = math.sqrt(remaining_rms_mm**2 - (noise**2 if noise > 0.0 else 0.0))
    depends = tuple(
        DriverDependence(
            one.place,
            one.driver,
            min(remaining_rms_mm * math.sqrt(one.square_fraction), rest),
            one.p,
        )
        for one in select_certain_components(components)
    )
    told = RemainingError(depends, 0.0, noise, source)
    return replace(told, unexplained_mm=math.sqrt(rest**2 - told.dependent_mm**2)), known
