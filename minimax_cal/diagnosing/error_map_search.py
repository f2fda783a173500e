"""Joints whose error is a curve of their own angle that no formula tells: sought after the names.

A map enters where groups of poses that are left out tell that it helps, beside geometry, the
effects that were named, and more than slow laws of the same joint do: a gain, one to three waves.
Where its curve is one wave, that wave is named instead.  Laws of the same angle that the map makes
needless leave: lines of a free frequency are a series for such a curve.

Lines of gears are sought once more in the same way, near ratios that the robot tells or lines of
other joints have shown: where all that a model lacks passes for noise of the joints, the weights by
which effects are sought hide fine waves of the first ones, which move the targets most.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from minimax_cal.core.arrays import Array
from minimax_cal.diagnosing.curve_cross_validation import (
    CURVE_PRIOR_SHAPES,
    CrossValidatedFit,
    CurveColumns,
    LinearResidual,
    build_joint_curves,
    cross_validate_residual,
    heldout_gain_p_value,
)
from minimax_cal.diagnosing.diagnosis import Finding
from minimax_cal.diagnosing.joint_fit import GeometryEffectFit
from minimax_cal.modelling.effects.gears import GEAR_RIPPLE, find_sweeping_joints
from minimax_cal.modelling.effects.joint_error_maps import (
    JOINT_ERROR_MAP,
    MIN_MAP_WAVELENGTH,
    map_range_of_angles,
    sine_basis,
)
from minimax_cal.modelling.effects.scene import (
    PRIOR_REFERENCE_ERROR,
    PosedArm,
    joint_index_from_place,
)
from minimax_cal.modelling.effects.table import EFFECTS, Term
from minimax_cal.modelling.gear_periodogram import (
    WaveScore,
    expected_line_bands,
    waves_per_turn_at_other_joints,
)
from minimax_cal.selection.thresholds import (
    CURVE_GAIN_P_VALUE,
    MAX_GEAR_LINE_GAIN_DIFFERENCE,
    MAX_REDUNDANT_RISE_FRACTION,
    MIN_SINGLE_WAVE_FRACTION,
)

TYPICAL_SLOW_LAW_SIZE_RAD = 1e-3  # size of slow laws [rad]
MIN_RIPPLE_WAVES_PER_TURN = 4.0  # waves a turn of the slowest that is called a ripple


@dataclass(frozen=True, eq=False)
class FoundErrorMaps:
    """terms: what is found, the largest gain first.  p_values: that groups gain so much by
    accident.

    gains: of the square left out, over its variance.  frequencies: share of the parts left out that
    are met better.  replaced_terms: terms that they replace.
    """

    terms: tuple[Term, ...] = ()
    p_values: tuple[float, ...] = ()
    gains: tuple[float, ...] = ()
    frequencies: tuple[float, ...] = ()
    replaced_terms: tuple[Term, ...] = ()

    def merge_with_effects(self, effects: Sequence[Sequence[Term]]) -> list[Sequence[Term]]:
        """The effects of a ladder with the maps, without what these replace."""
        gone = {term.key for term in self.replaced_terms}
        kept = [terms for terms in effects if terms[0].key not in gone]
        had = {terms[0].key for terms in kept}
        return [*kept, *((term,) for term in self.terms if term.key not in had)]

    def build_findings(self, named_findings: Sequence[Finding], scene: PosedArm) -> list[Finding]:
        """`beside` for findings; values are those of a fit that comes."""
        gone = {term.key for term in self.replaced_terms}
        out = [finding for finding in named_findings if finding.term.key not in gone]
        for i, term in enumerate(self.terms):
            columns = term.columns(scene)
            none = (0.0,) * len(columns.names)
            names, units, chance = columns.names, columns.units, self.p_values[i]
            new = Finding((term,), names, units, none, none, self.gains[i], chance)
            out.append(replace(new, fixed=columns.fixed, again=self.frequencies[i]))
        return out


NO_ERROR_MAPS = FoundErrorMaps()


def search_error_maps(
    fit: GeometryEffectFit, excluded_effects: Sequence[str] = ()
) -> FoundErrorMaps:
    """The error maps, and lines of gears, that a fit of geometry and named effects lacks.

    excluded_effects: effects that are not sought.
    """
    left = LinearResidual.from_fit(fit)
    if not len(left.fold_masks):
        return FoundErrorMaps()
    usual = cross_validate_residual(left).usual_poses
    some = left.select_poses(usual)
    if not len(some.fold_masks):
        return FoundErrorMaps()
    lines = search_gear_lines(fit, some) if GEAR_RIPPLE.name not in excluded_effects else []
    maps: list[FoundCurve] = []
    if JOINT_ERROR_MAP.name not in excluded_effects:
        maps = select_map_joints(fit, some, [found.curve_columns for found in lines])
    if not (lines or maps):
        return FoundErrorMaps()
    rippled = {term.place for term in fit.terms if term.effect == GEAR_RIPPLE.name}
    rippled |= {found.curve_columns.place for found in lines}
    needless = find_redundant_laws(fit, left, usual, lines, maps)
    at = cross_validate_residual(residual_without_terms(fit, left, needless).select_poses(usual))
    terms, gains, again = [], [], []
    for found in (*lines, *maps):
        wide = at.with_curve(found.curve_columns)
        wave = GEAR_RIPPLE.name not in excluded_effects and found.curve_columns.place not in rippled
        terms.append(
            found.term
            or build_curve_term(
                fit, found.curve_columns, wide, at.heldout_variance, may_be_wave=wave
            )
        )
        gains.append((at.heldout_square - wide.heldout_square) / wide.heldout_variance)
        fell = (at.error**2 - wide.error**2).sum(axis=1)
        again.append(float(np.mean([fell[part].sum() > 0.0 for part in at.fold_masks])))
        at = wide
    chances = tuple(found.p_value for found in (*lines, *maps))
    return FoundErrorMaps(tuple(terms), chances, tuple(gains), tuple(again), needless)


@dataclass(frozen=True, eq=False)
class FoundCurve:
    """Functions that groups left out call for.  p_value: of that by accident.

    term: what they are, None where the curve will tell.
    """

    curve_columns: CurveColumns
    p_value: float
    term: Term | None = None


def search_gear_lines(fit: GeometryEffectFit, residual: LinearResidual) -> list[FoundCurve]:
    """Lines of gears that a fit lacks, near their ratios, one a joint."""
    heard = [t for t in fit.terms if t.effect == GEAR_RIPPLE.name]
    silent = [
        j
        for j in find_sweeping_joints(fit.study.scene)
        if f"J{j + 1}" not in {term.place for term in heard}
    ]
    waiting = [line for j in silent for line in find_strongest_gear_line(fit, residual, j, heard)]
    asked = 1 if heard else len(silent)  # each by itself, where another has a line
    at, out = cross_validate_residual(residual), []
    for block, turns, tries in waiting:
        wide = at.with_curve(block)
        chance = asked * tries * heldout_gain_p_value(at, wide, residual.pose_groups)
        if chance < CURVE_GAIN_P_VALUE:
            out.append(
                FoundCurve(block, chance, Term(GEAR_RIPPLE.name, block.place, {"turns": turns}))
            )
            at = wide
    return out


def find_strongest_gear_line(
    fit: GeometryEffectFit,
    residual: LinearResidual,
    joint_index: int,
    significant_lines: Sequence[Term],
) -> list[tuple[CurveColumns, float, float]]:
    """The strongest line of a joint near its gear's ratio, its waves a turn, and how many were
    tried; none if the halves of the sweep do not agree on it.
    """
    arm, at = residual.joint_motions[:, :, joint_index], cross_validate_residual(residual)
    score, size = ((arm * other).sum(axis=1) / at.heldout_variance for other in (at.error, arm))
    line = WaveScore(residual.joint_values[:, joint_index], score, size)
    place = f"J{joint_index + 1}"
    near = expected_line_bands(
        float(fit.study.scene.robot.ratio[joint_index]),
        waves_per_turn_at_other_joints(place, significant_lines),
    )
    if not near:
        return []
    found = [line.find_strongest_wave(*band) for band in near]
    gains = [float(line.gains_of_waves(turns + np.array([0.0, 1e-3]))[0]) for turns, _ in found]
    turns = found[int(np.argmax(gains))][0]
    if not line.is_wave_in_both_halves(turns, MAX_GEAR_LINE_GAIN_DIFFERENCE):
        return []
    wave = np.stack(
        [f(turns * residual.joint_values[:, joint_index]) for f in (np.cos, np.sin)], axis=1
    )
    block = CurveColumns(
        place, arm[:, :, None] * wave[:, None], np.full((1, 2), TYPICAL_SLOW_LAW_SIZE_RAD)
    )
    return [(block, turns, sum(tries for _, tries in found))]


def select_map_joints(
    fit: GeometryEffectFit, residual: LinearResidual, blocks_beside: Sequence[CurveColumns]
) -> list[FoundCurve]:
    """The joints that have a map beside some blocks, the weightiest first."""
    sliding, at = fit.study.scene.robot.prismatic, cross_validate_residual(residual)
    for block in blocks_beside:
        at = at.with_curve(block)
    waiting = [
        block
        for block in build_joint_curves(residual)
        if not sliding[joint_index_from_place(block.place)]
    ]
    out: list[FoundCurve] = []
    tries = len(waiting)
    while waiting:
        tried = [at.with_curve(block) for block in waiting]
        for number in np.argsort([one.heldout_square for one in tried]).tolist():
            # Laws of the joint's own angle that have a name: its gain, and slow waves.
            joint = joint_index_from_place(waiting[number].place)
            q = residual.joint_values[:, joint]
            laws = np.stack([q, *(f(k * q) for k in (1, 2, 3) for f in (np.cos, np.sin))], axis=1)
            columns = residual.joint_motions[:, :, joint, None] * laws[:, None]
            slow = CurveColumns(
                f"J{joint + 1}", columns, np.full((1, laws.shape[1]), TYPICAL_SLOW_LAW_SIZE_RAD)
            )
            plain = at.with_curve(slow)
            each = [
                heldout_gain_p_value(base, tried[number], residual.pose_groups)
                for base in (at, plain)
            ]
            chance = tries * max(each)
            if chance < CURVE_GAIN_P_VALUE:
                at = tried[number]
                out.append(FoundCurve(waiting.pop(number), chance))
                break
        else:
            return out
    return out


def build_curve_term(
    fit: GeometryEffectFit,
    curve_columns: CurveColumns,
    holdout_fit: CrossValidatedFit,
    variance: float,
    *,
    may_be_wave: bool,
) -> Term:
    """The map of a block that was just fitted, or the wave that it is, where that may be its name.

    variance: of a coordinate, with which its prior was weighed [m^2].
    """
    q, (size, length) = (
        fit.study.scene.q[joint_index_from_place(curve_columns.place)],
        CURVE_PRIOR_SHAPES[holdout_fit.selected_prior],
    )
    low, high = map_range_of_angles(q)
    x = np.linspace(q.min(), q.max(), 8 * curve_columns.columns.shape[-1])
    curve = holdout_fit.parameter_values[-curve_columns.columns.shape[-1] :] @ sine_basis(
        x, low, high, curve_columns.columns.shape[-1]
    )
    turns, share = find_strongest_wave(x, curve)
    if may_be_wave and share > MIN_SINGLE_WAVE_FRACTION:
        return Term(GEAR_RIPPLE.name, curve_columns.place, {"turns": turns})
    size *= PRIOR_REFERENCE_ERROR / float(np.sqrt(variance))
    choice = {"low": low, "high": high, "length": length, "size": size}
    return Term(JOINT_ERROR_MAP.name, curve_columns.place, choice)


def find_strongest_wave(joint_values: Array, curve: Array) -> tuple[float, float]:
    """Waves a turn that come nearest to a curve (g,), and the share of its square they explain."""
    least, most = 2.0 * np.pi / np.ptp(joint_values), 2.0 * np.pi / MIN_MAP_WAVELENGTH
    turns = np.arange(max(least, MIN_RIPPLE_WAVES_PER_TURN), most, 0.1 * least)
    best, bare = (0.0, 0.0), curve - np.polyval(np.polyfit(joint_values, curve, 1), joint_values)
    for k in turns:
        columns = np.stack(
            [
                np.ones_like(joint_values),
                joint_values,
                np.cos(k * joint_values),
                np.sin(k * joint_values),
            ],
            axis=1,
        )
        rest = curve - columns @ np.linalg.lstsq(columns, curve, rcond=None)[0]
        best = max(best, (1.0 - float(rest @ rest) / max(float(bare @ bare), 1e-300), float(k)))
    return best[1], best[0]


# ---- laws that a map makes needless ------------------------------------------------------------


def find_redundant_laws(
    fit: GeometryEffectFit,
    residual: LinearResidual,
    usual_poses: Array,
    lines: Sequence[FoundCurve],
    maps: Sequence[FoundCurve],
) -> tuple[Term, ...]:
    """Named laws of the same angles as maps, without which groups left out are met as well."""
    blocks = [found.curve_columns for found in (*lines, *maps)]
    places = {found.curve_columns.place for found in maps}
    own = []  # a wave, or a gain: a part of any curve of its joint's angle
    for term in fit.terms:
        law = EFFECTS[term.effect]
        if term.place in places and law.follows_own_angle and (law.lines or law.linear):
            own.append(term)
    least = heldout_square_with_curves(residual, usual_poses, blocks)
    bare = cross_validate_residual(
        residual_without_terms(fit, residual, own).select_poses(usual_poses)
    ).heldout_square
    gone: tuple[Term, ...] = ()
    for key in dict.fromkeys((t.effect, t.place) for t in own):
        fewer = (*gone, *(t for t in own if (t.effect, t.place) == key))
        if heldout_square_with_curves(
            residual_without_terms(fit, residual, fewer), usual_poses, blocks
        ) - least < MAX_REDUNDANT_RISE_FRACTION * (bare - least):
            gone = fewer
    return gone


def heldout_square_with_curves(
    residual: LinearResidual, usual_poses: Array, blocks: Sequence[CurveColumns]
) -> float:
    """The square of poses left out with maps of some joints [m^2]."""
    at = cross_validate_residual(residual.select_poses(usual_poses))
    for block in blocks:
        at = at.with_curve(block)
    return at.heldout_square


def residual_without_terms(
    fit: GeometryEffectFit, residual: LinearResidual, dropped_terms: Sequence[Term]
) -> LinearResidual:
    """What is left once some effects of a fit are not in it."""
    if not dropped_terms:
        return residual
    scene, count = fit.study.scene, fit.model.names.geometric_count
    texts = {term.text for term in dropped_terms}
    owner = [t.text in texts for t in fit.terms for _ in t.columns(scene).names]
    names = np.concatenate([np.zeros(count, dtype=bool), owner])
    own = names[fit.estimator.model.active]
    value = np.concatenate([np.zeros(count), fit.parameter_values.effects])[
        fit.estimator.model.active
    ]
    held = residual.prior_weights > 0.0  # of which nothing was taken away
    back = residual.columns[..., own] @ np.where(held, 0.0, value)[own]
    kept = residual.columns[..., ~own]
    return replace(
        residual,
        errors=residual.errors + back,
        columns=kept,
        prior_weights=residual.prior_weights[~own],
    )
