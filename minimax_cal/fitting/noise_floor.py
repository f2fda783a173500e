"""What no model can take away: how far apart visits to one pose are, or what is declared.

Where neither is known, the distances between targets tell the instrument's noise.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import chdtri

from minimax_cal.core.arrays import Array
from minimax_cal.core.errors import OptionError
from minimax_cal.measuring.faults.point_faults import estimate_noise_from_distances
from minimax_cal.measuring.measurements import Measurements
from minimax_cal.measuring.pose_groups import deviations_from_group_means, group_agreeing_visits
from minimax_cal.reading.column_words import METRES_PER_LENGTH_UNIT
from minimax_cal.reading.text_sheet import parse_number

REPEATS, DECLARED, AT_MOST = "repeated poses", "declared", "at most"
DISTANCES, NOTHING_TELLS = "distances between the targets", "nothing"
MIN_REVISITED_POSES = 5  # repeated visits that tell
FLOOR_RESAMPLES = 500
MEDIAN_SQUARE_OF_GAUSSIAN = (
    float(chdtri(3.0, 0.5)) / 3.0
)  # median square of a Gaussian over its mean, in space
U95_SIGMAS = 1.959964  # of a coordinate that a u95 holds
# ISO 9283: repeatability is the mean distance from the middle plus three of its standard
# deviations; of a Gaussian, alike in all directions, the RMS distance is this share of it.
RMS_TO_REPEATABILITY_RATIO = float(
    math.sqrt(3.0) / (math.sqrt(8.0 / math.pi) + 3.0 * math.sqrt(3.0 - 8.0 / math.pi))
)


@dataclass(frozen=True)
class NoiseFloor:
    """RMS distance that noise alone would leave [mm], between two ends, and how it is known.

    value: the best estimate; where nothing but the fit tells, what noise is at most by its errors.
    """

    value: float
    low: float
    high: float
    source: str

    @property
    def is_certain(self) -> bool:
        """Whether it is known by more than what the fit leaves."""
        return self.source != AT_MOST

    @property
    def interval_mm(self) -> tuple[float, float] | None:
        """Between which it is [mm], where it is known by more than what the fit leaves."""
        return (self.low, self.high) if self.is_certain else None

    @property
    def lower_limit_mm(self) -> float:
        """The floor to take off where the gap is not to be told too small [mm]."""
        return self.value if self.is_certain else 0.0

    def limited_by_error(self, error: float) -> NoiseFloor:
        """The same where a model errs by no more than so much [mm]: noise is part of that."""
        return replace(
            self,
            value=min(self.value, error),
            low=min(self.low, error),
            high=min(self.high, error),
        )

    def sample_values_mm(self, count: int, rng: np.random.Generator) -> Array:
        """(count,) values that it may have [mm]."""
        if not self.is_certain:
            return np.asarray(rng.uniform(self.low, self.high, count))
        low, high = max(self.low, 1e-9), max(self.high, 1e-9)
        middle = min(max(self.value, low), high)
        side = rng.normal(size=count) / U95_SIGMAS
        up, down = np.log(high / middle), np.log(middle / low)
        return np.asarray(middle * np.exp(np.where(side > 0.0, side * up, side * down)))


def estimate_noise_floor(
    data: Measurements, point_errors: Array, repeatability: float, max_floor_mm: float
) -> NoiseFloor:
    """The floor, by revisits, else by what is declared, else by the distances between targets.

    Where there is nothing of these, what a fit leaves at most.  The distances are asked too where
    one part of what is declared is missing.

    point_errors: (m, k, 3) of the best model [m].  repeatability: of the arm by ISO 9283, NaN
    unknown [m]. max_floor_mm: RMS distance that noise leaves at most, as the fit tells it [mm].
    """
    again = smallest_revisit_deviations(data, point_errors)
    if again:
        return floor_from_revisits(*again)
    instrument, arm = declared_noise_mm(data, repeatability) or (math.nan, math.nan)
    both, seen = float(np.hypot(instrument, arm)), estimate_noise_from_distances(data)
    more = seen is not None and rms_mm_from_coordinate_sigma(
        seen[0]
    ) > instrument * confidence_factor(seen[1])
    if (
        more or not both < max_floor_mm
    ):  # a part is not known, or data sheets promise less than is seen
        return floor_from_distances(seen, instrument, arm, max_floor_mm)
    low = float(np.hypot(instrument, 0.5 * arm))  # a data sheet promises no more than this
    return NoiseFloor(both, low, both, DECLARED)


def floor_from_distances(
    distance_noise: tuple[float, float] | None, instrument: float, arm: float, max_floor_mm: float
) -> NoiseFloor:
    """The floor where what is declared does not tell it.

    distance_noise: as `estimate_noise_from_distances`.  instrument, arm: RMS distance of what is
    declared, NaN unknown [mm]. max_floor_mm: as `estimate_noise_floor`.
    """
    known = float(np.nan_to_num(instrument))
    if distance_noise:
        value = math.hypot(
            max(rms_mm_from_coordinate_sigma(distance_noise[0]), known), float(np.nan_to_num(arm))
        )
        grown = confidence_factor(distance_noise[1])
        if (
            value / grown < max_floor_mm
        ):  # a fit that leaves less than their middle contradicts no distance
            ends = max(value / grown, min(known, max_floor_mm)), min(value * grown, max_floor_mm)
            return NoiseFloor(min(value, max_floor_mm), *ends, DISTANCES)
    return NoiseFloor(max_floor_mm, min(known, max_floor_mm), max_floor_mm, AT_MOST)


def rms_mm_from_coordinate_sigma(sigma: float) -> float:
    """RMS distance [mm] of points whose coordinates have a standard deviation [m]."""
    return 1e3 * math.sqrt(3.0) * sigma


def confidence_factor(relative_sigma: float) -> float:
    """How far up or down a value may be, 95 times in 100, by its relative standard error."""
    return math.exp(U95_SIGMAS * relative_sigma)


def noise_upper_bound_mm(point_errors: Array, degrees_of_freedom: float) -> float:
    """RMS distance of the noise, 97.5 times in 100 less than this, by what a fit leaves [mm].

    What the fit lacks only adds to it.  point_errors: (m, k, 3) of its points, NaN unknown [m].
    degrees_of_freedom: coordinates less parameters; they tell as much as the poses' squares vary
    little, since what joints do moves all points of a pose together [Satterthwaite 1946].
    """
    square = 1e6 * np.nansum(point_errors**2, axis=(1, 2))
    count = 3.0 * np.count_nonzero(np.isfinite(point_errors[..., 0]))
    told = 2.0 * float(square.sum()) ** 2 / max(len(square) * float(np.var(square)), 1e-300)
    free = max(degrees_of_freedom * min(told / count, 1.0), 1.0)
    return math.sqrt(
        3.0 * float(square.sum()) / degrees_of_freedom * free / float(chdtri(free, 0.975))
    )


def declared_noise_mm(data: Measurements, repeatability: float) -> tuple[float, float] | None:
    """RMS distance by the instrument's u95 and by the arm's repeatability, NaN unknown [mm]."""
    instrument = rms_mm_from_coordinate_sigma(instrument_coordinate_sigma(data))
    arm = 1e3 * RMS_TO_REPEATABILITY_RATIO * repeatability
    return None if np.isnan(instrument) and np.isnan(arm) else (instrument, arm)


def instrument_coordinate_sigma(data: Measurements) -> float:
    """Of a coordinate by the instrument's u95 [m]; NaN if none is told."""
    u95 = data.columns.get("u95", np.full(data.poses, np.nan)) / U95_SIGMAS
    return float(np.sqrt(np.nanmean(u95**2))) if np.isfinite(u95).any() else math.nan


def instrument_noise_without_joints(data: Measurements) -> tuple[float, str]:
    """RMS distance by the instrument's noise, without that of the joints, and how it is known [mm].

    As declared, or by the targets' distances where these show more; NaN where neither tells.
    """
    told, seen = (
        rms_mm_from_coordinate_sigma(instrument_coordinate_sigma(data)),
        estimate_noise_from_distances(data),
    )
    between = rms_mm_from_coordinate_sigma(seen[0]) if seen else math.nan
    if math.isnan(told) and math.isnan(between):
        return math.nan, NOTHING_TELLS
    largest = float(np.fmax(between, told))
    return largest, DECLARED if largest == told else DISTANCES


def known_noise_floor(
    data: Measurements, point_errors: Array, repeatability: float
) -> tuple[float, str] | None:
    """The floor [mm] and how it is known, where it is by more than a fit.  As
    `estimate_noise_floor`.
    """
    again = smallest_revisit_deviations(data, point_errors)
    if again:
        return robust_rms_mm(again[0]), REPEATS
    told = declared_noise_mm(data, repeatability)
    both = float(np.hypot(*told)) if told else np.nan
    return (both, DECLARED) if np.isfinite(both) else None


def smallest_revisit_deviations(
    data: Measurements, point_errors: Array
) -> tuple[Array, Array] | None:
    """Deviations among visits to one pose: of the errors, or of the points if these are less.

    Moves between visits are in the points, noise of joints that were read back in the errors.
    """
    both = (squared_revisit_deviations(data, part) for part in (point_errors, data.y))
    return min((one for one in both if one), key=lambda one: robust_rms_mm(one[0]), default=None)


def squared_revisit_deviations(
    data: Measurements, point_errors: Array
) -> tuple[Array, Array] | None:
    """As `squared_deviations_from_pose_mean`, None where too few poses were visited again.
    point_errors: or points [m].
    """
    group = group_agreeing_visits(data)
    if np.count_nonzero(np.bincount(group) > 1) < MIN_REVISITED_POSES:
        return None
    square, group = squared_deviations_from_pose_mean(point_errors, group)
    return None if len(np.unique(group)) < MIN_REVISITED_POSES else (square, group)


def robust_rms_mm(squared_distances: Array) -> float:
    """RMS distance [mm] by the median of squared ones [m^2], as of a Gaussian: few wrong points do
    not set it.
    """
    return 1e3 * float(np.sqrt(np.median(squared_distances) / MEDIAN_SQUARE_OF_GAUSSIAN))


def floor_from_revisits(squared_deviations: Array, pose_groups: Array) -> NoiseFloor:
    """The floor with its ends, poses drawn anew.  squared_deviations, pose_groups: as
    `squared_deviations_from_pose_mean`.
    """
    names, rng = np.unique(pose_groups), np.random.default_rng(0)
    member = [np.flatnonzero(pose_groups == name) for name in names]
    drawn = [
        robust_rms_mm(
            squared_deviations[
                np.concatenate([member[i] for i in rng.integers(0, len(names), len(names))])
            ]
        )
        for _ in range(FLOOR_RESAMPLES)
    ]
    low, high = np.quantile(drawn, (0.025, 0.975))
    return NoiseFloor(robust_rms_mm(squared_deviations), float(low), float(high), REPEATS)


def squared_deviations_from_pose_mean(
    point_errors: Array, pose_groups: Array
) -> tuple[Array, Array]:
    """Squared distances of visits from their pose's middle, each as large as a point's own scatter
    is expected to be [m^2], and the group of each.

    point_errors: (m, k, 3), NaN unknown [m].  pose_groups: (m,).
    """  # fmt: skip
    square, member = [np.zeros(0)], [np.zeros(0, dtype=int)]
    for points in np.swapaxes(point_errors, 0, 1):
        off, free = deviations_from_group_means(points, pose_groups)
        again = free[:, 0] > 0.0
        square.append((off[again] ** 2).sum(axis=1) / free[again, 0])
        member.append(pose_groups[again])
    return np.concatenate(square), np.concatenate(member)


# ---- what an instrument promises ----------------------------------------------------------------


INSTRUMENT_TEXT_PATTERN = re.compile(r"([\d.]+)\s*(um|mm)(?:\s*\+\s*([\d.]+)\s*(um|mm)\s*/\s*m)?")


@dataclass(frozen=True)
class InstrumentAccuracy:
    """u95 of a coordinate: a part that is always there [m], and its growth with range [m per m]."""

    base: float
    per_metre: float = 0.0


def parse_instrument_accuracy(text: str) -> InstrumentAccuracy:
    """As ``10um+2.5um/m`` or ``0.05mm``.  Raises OptionError."""
    found = INSTRUMENT_TEXT_PATTERN.fullmatch(text.strip().replace("µ", "u"))
    base, unit, more, of = found.groups("") if found else ("", "mm", "", "")
    told = InstrumentAccuracy(
        parse_number(base) * METRES_PER_LENGTH_UNIT[unit],
        parse_number(more or "0") * METRES_PER_LENGTH_UNIT[of or "mm"],
    )
    if not (0.0 < told.base < 1.0 and told.per_metre <= 1e-2):
        raise OptionError(f"instrument={text!r}: write u95 as 10um+2.5um/m, or as 0.05mm")
    return told


def with_u95_of_instrument(data: Measurements, instrument_text: str | None) -> Measurements:
    """The data with a `u95` column by an instrument's promise; one that is there is kept.

    Raises OptionError.
    """
    if instrument_text is None:
        return data
    told = parse_instrument_accuracy(instrument_text)
    if "u95" in data.columns:
        said = f"{data.source}: column u95_mm is used, not instrument={instrument_text!r}"
        return replace(data, notices=(*data.notices, said))
    reach = np.linalg.norm(data.y, axis=-1)
    far = np.where(np.isfinite(reach), reach, 0.0).sum(axis=1) / np.maximum(data.seen.sum(1), 1)
    return replace(data, columns={**data.columns, "u95": told.base + told.per_metre * far})
