"""Lines in the residual: ripple of gears whose number of waves a turn nobody told."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.special import chdtrc

from minimax_cal.core.arrays import Array
from minimax_cal.modelling.effects.gears import find_sweeping_joints
from minimax_cal.modelling.effects.scene import PosedArm, joint_index_from_place
from minimax_cal.modelling.effects.table import Term
from minimax_cal.modelling.error_rows import PoseRows
from minimax_cal.selection.noise_model import Noise, weighted_residual
from minimax_cal.selection.thresholds import (
    HALF_SWEEP_DIFFERENCE_P_VALUE,
    MAX_HALF_SWEEP_GAIN_DIFFERENCE,
)

MIN_WAVES_PER_TURN, MAX_WAVES_PER_TURN = (
    8.0,
    260.0,
)  # waves a turn that are looked for; no gear has fewer teeth
FREQUENCY_OVERSAMPLING = 4.0  # frequencies tried for each one that is independent
WAVES_PER_MOTOR_TURN = (1, 2)  # waves of a gear in each turn of its motor
MIN_TRIED_FREQUENCIES = 2.0  # a line is never found at once
STRAIN_WAVE_RATIO_OFFSET = 1.0  # a strain wave gear turns by one more or less than its ratio tells


def find_gear_lines_with_tried_counts(
    posed_arm: PosedArm,
    rows: PoseRows,
    noise: Noise,
    fitted_columns: Array,
    *,
    found_lines: Sequence[Term] = (),
) -> list[tuple[Term, float]]:
    """The strongest line of each joint near its gear's ratio, and any, if it stays.

    A ratio is told by the robot, else by lines of other joints: arms have few kinds of gears.

    With the number of independent frequencies tried of such lines, at all joints; near ratios at
    the joint alone once another has a line: each gear of an arm whose gears err is asked for by
    itself.  fitted_columns: (N, q) columns that are fitted already.  found_lines: lines that were
    found.
    """
    weight = noise.row_weights(rows)
    pull = weight * weighted_residual(rows, weight, fitted_columns)
    arms = rows.rows_from_fields(posed_arm.jacobian)
    apart: list[tuple[Term, float]] = []
    near: list[Term] = []
    free: list[Term] = []
    tried_near, tried = MIN_TRIED_FREQUENCIES, MIN_TRIED_FREQUENCIES
    for j in find_sweeping_joints(posed_arm):
        score = (arms[:, j] * pull).reshape(posed_arm.poses, -1).sum(axis=1)
        size = (arms[:, j] ** 2 * weight).reshape(posed_arm.poses, -1).sum(axis=1)
        line, place = WaveScore(posed_arm.q[j], score, size), f"J{j + 1}"
        ratio, others = (
            float(posed_arm.robot.ratio[j]),
            waves_per_turn_at_other_joints(place, found_lines),
        )
        found = [line.find_strongest_wave(*band) for band in expected_line_bands(ratio, others)]
        here = sum(tries for _, tries in found)
        tried_near += here
        stay = [
            turns
            for turns, _ in found
            if line_bands_of_ratio(ratio) or line.is_wave_in_both_halves(turns)
        ]
        lines = [Term("gear_ripple", place, {"turns": turns}) for turns in stay]
        if others:
            apart += [(term, MIN_TRIED_FREQUENCIES + here) for term in lines]
        else:
            near += lines
        turns, tries = line.find_strongest_wave(MIN_WAVES_PER_TURN, MAX_WAVES_PER_TURN)
        tried += tries
        if line.is_wave_in_both_halves(turns):
            free.append(Term("gear_ripple", place, {"turns": turns}))
    return [*apart, *((term, tried_near) for term in near), *((term, tried) for term in free)]


def waves_per_turn_at_other_joints(place: str, found_lines: Sequence[Term]) -> list[float]:
    """Waves a turn of lines at other joints."""
    return [term.choice["turns"] for term in found_lines if term.place != place]


def is_line_near_expected_ratio(
    posed_arm: PosedArm, line: Term, found_lines: Sequence[Term]
) -> bool:
    """Whether a line is where its gear's is, on an arm of which another gear has one."""
    joint, others = (
        joint_index_from_place(line.place),
        waves_per_turn_at_other_joints(line.place, found_lines),
    )
    near = has_line_near_expected_ratio(
        float(posed_arm.robot.ratio[joint]), posed_arm.q[joint], [line.choice["turns"]], others
    )
    return bool(others) and near


def has_line_near_expected_ratio(
    gear_ratio: float,
    joint_angles: Array,
    waves_at_joint: Sequence[float],
    waves_elsewhere: Sequence[float],
) -> bool:
    """Whether some line of a joint is where its gear's ratio tells, or of a kind with another line.

    To half of what the joint's sweep resolves.  joint_angles: (m,) its angles.  waves_at_joint,
    waves_elsewhere: waves a turn of lines at the joint, and elsewhere.
    """
    loose = 0.5 / sweep_in_turns(joint_angles)
    for number, turns in enumerate(waves_at_joint):
        near = expected_line_bands(
            gear_ratio, [*waves_elsewhere, *waves_at_joint[:number], *waves_at_joint[number + 1 :]]
        )
        if any(low - loose <= turns <= high + loose for low, high in near):
            return True
    return False


def sweep_in_turns(joint_angles: Array) -> float:
    """Of angles (m,), in turns; a wave is resolved from another that makes one more in it."""
    return max(float(np.ptp(joint_angles)) / (2.0 * np.pi), 0.1)


class WaveBand(NamedTuple):
    """A range of waves a turn."""

    low: float
    high: float


def expected_line_bands(gear_ratio: float, waves_elsewhere: Sequence[float]) -> list[WaveBand]:
    """Where lines of a joint's gear may be: near its ratio, else where gears of others have theirs.

    gear_ratio: NaN untold.  waves_elsewhere: waves a turn of lines that were heard.
    """
    return line_bands_of_ratio(gear_ratio) or line_bands_of_like_gears(waves_elsewhere)


def line_bands_of_ratio(gear_ratio: float) -> list[WaveBand]:
    """Where lines of a gear may be, whose ratio is told, of either sign; none for NaN."""
    size = abs(gear_ratio)
    return [
        WaveBand(k * (size - STRAIN_WAVE_RATIO_OFFSET), k * (size + STRAIN_WAVE_RATIO_OFFSET))
        for k in WAVES_PER_MOTOR_TURN
        if size > MIN_WAVES_PER_TURN
    ]


def line_bands_of_like_gears(waves_elsewhere: Sequence[float]) -> list[WaveBand]:
    """Where lines of a gear may be that is of the kind of others, whose lines were heard."""
    ratios = {one / k for one in waves_elsewhere for k in WAVES_PER_MOTOR_TURN}
    wide = sorted(
        band
        for ratio in ratios
        for band in line_bands_of_ratio(ratio)
        if band.high <= MAX_WAVES_PER_TURN
    )
    out: list[WaveBand] = []
    for band in wide:
        if out and band.low <= out[-1].high:
            out[-1] = WaveBand(out[-1].low, max(band.high, out[-1].high))
        else:
            out.append(band)
    return out


class StrongestWave(NamedTuple):
    """The strongest wave of a band, and the number of independent frequencies in the band."""

    waves_per_turn: float
    tried_frequency_count: float


@dataclass(frozen=True, eq=False)
class WaveScore:
    """What poses tell of waves of one joint's angle.

    q: (m,) angles.  score, size: (m,) weighed products of its motion with the errors and itself.
    """

    q: Array
    score: Array
    size: Array

    def gains_of_waves(self, waves_per_turn: Array) -> Array:
        """(f,) by equally spaced waves a turn."""
        return wave_gains_from_sums(
            *sum_wave_products(waves_per_turn, self.q, self.score, self.size)
        )

    def find_strongest_wave(
        self, min_waves_per_turn: float, max_waves_per_turn: float
    ) -> StrongestWave:
        """The strongest of a band, and the number of independent frequencies in it."""
        step = 1.0 / (FREQUENCY_OVERSAMPLING * sweep_in_turns(self.q))
        turns = np.arange(min_waves_per_turn, max_waves_per_turn + step, step)
        near = turns[int(np.argmax(self.gains_of_waves(turns)))] + step * np.linspace(-1.0, 1.0, 41)
        return StrongestWave(
            float(near[int(np.argmax(self.gains_of_waves(near)))]),
            len(turns) / FREQUENCY_OVERSAMPLING * 2.0,
        )

    def is_wave_in_both_halves(
        self, waves_per_turn: float, max_gain_difference: float = MAX_HALF_SWEEP_GAIN_DIFFERENCE
    ) -> bool:
        """Whether both halves of the sweep show a wave, of the same frequency, size and phase.

        max_gain_difference: of its gain, by which they may differ in any case.
        """
        low = self.q < np.median(self.q)
        if not low.any():  # most poses stand at one end: there are no two halves
            return False
        whole = float(self.gains_of_waves(waves_per_turn + np.array([0.0, 1e-3]))[0])
        more = -whole
        for half in (low, ~low):
            own = WaveScore(self.q[half], self.score[half], self.size[half])
            near = waves_per_turn + np.linspace(-1.0, 1.0, 41) / sweep_in_turns(own.q)
            more += float(own.gains_of_waves(near).max())
        return bool(
            chdtrc(4, more) > HALF_SWEEP_DIFFERENCE_P_VALUE or more < max_gain_difference * whole
        )


class WaveSums(NamedTuple):
    """Sums over poses of score e^(i k q) (f,), of size e^(2 i k q) (f,), and of size."""

    score_sums: Array
    size_sums: Array
    size_total: float


def sum_wave_products(
    waves_per_turn: Array, joint_angles: Array, score: Array, size: Array
) -> WaveSums:
    """Sums over poses of score e^(i k q) and of size e^(2 i k q) for turns k (f,), and of size.

    waves_per_turn: equally spaced, so that every wave is a product of one from a coarse grid and
    one of the few between, themselves powers: the sums over poses are products of two small
    matrices.
    """
    count = int(np.ceil(np.sqrt(len(waves_per_turn))))
    step = np.exp(1j * (waves_per_turn[1] - waves_per_turn[0]) * joint_angles)
    fine = complex_geometric_sequence(np.ones_like(step), step, count)
    coarse = complex_geometric_sequence(
        np.exp(1j * waves_per_turn[0] * joint_angles),
        fine[-1] * step,
        -(-len(waves_per_turn) // count),
    )
    pull = (coarse * score) @ fine.T
    square = (coarse**2 * size) @ (fine**2).T
    return WaveSums(
        pull.reshape(-1)[: len(waves_per_turn)],
        square.reshape(-1)[: len(waves_per_turn)],
        float(size.sum()),
    )


def complex_geometric_sequence(first: Array, step: Array, count: int) -> Array:
    """(count, m) first, then each times step.  first, step: (m,)."""
    out = np.empty((count, len(first)), dtype=complex)
    out[0] = first
    for i in range(1, count):
        np.multiply(out[i - 1], step, out=out[i])
    return out


def wave_gains_from_sums(score_sums: Array, size_sums: Array, size_total: float) -> Array:
    """(f,) gain of a wave of each frequency.  score_sums, size_sums, size_total: as
    `sum_wave_products` has them.
    """
    cc, ss, cs = (
        0.5 * (size_total + size_sums.real),
        0.5 * (size_total - size_sums.real),
        0.5 * size_sums.imag,
    )
    det = np.maximum(cc * ss - cs * cs, 1e-12 * cc * ss + 1e-300)
    top = (
        ss * score_sums.real**2
        - 2.0 * cs * score_sums.real * score_sums.imag
        + cc * score_sums.imag**2
    )
    return np.asarray(top / det)
