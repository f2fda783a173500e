"""What no model can take away: how far apart visits to one pose are, or what is declared.

Where neither is known, the distances between targets tell the instrument's noise.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import chdtri

from minimax_cal.ground.arrays import Array
from minimax_cal.ground.errors import OptionError
from minimax_cal.measuring.faults.points import noise_between
from minimax_cal.measuring.grouping import from_means, visits
from minimax_cal.measuring.measurements import Measurements
from minimax_cal.reading.sheet import number_of
from minimax_cal.reading.words import LENGTHS

REPEATS, DECLARED, AT_MOST = "repeated poses", "declared", "at most"
DISTANCES, NOTHING_TELLS = "distances between the targets", "nothing"
FEWEST = 5  # repeated visits that tell
RESAMPLES = 500
USUAL = float(chdtri(3.0, 0.5)) / 3.0  # median square of a Gaussian over its mean, in space
SIGMAS = 1.959964  # of a coordinate that a u95 holds
# ISO 9283: repeatability is the mean distance from the middle plus three of its standard
# deviations; of a Gaussian, alike in all directions, the RMS distance is this share of it.
RMS_OF_REPEATABILITY = float(
    math.sqrt(3.0) / (math.sqrt(8.0 / math.pi) + 3.0 * math.sqrt(3.0 - 8.0 / math.pi))
)


@dataclass(frozen=True)
class Floor:
    """RMS distance that noise alone would leave [mm], between two ends, and how it is known.

    value: the best estimate; where nothing but the fit tells, what noise is at most by its errors.
    """

    value: float
    low: float
    high: float
    source: str

    @property
    def certain(self) -> bool:
        """Whether it is known by more than what the fit leaves."""
        return self.source != AT_MOST

    @property
    def ends(self) -> tuple[float, float] | None:
        """Between which it is [mm], where it is known by more than what the fit leaves."""
        return (self.low, self.high) if self.certain else None

    @property
    def least(self) -> float:
        """The floor to take off where the gap is not to be told too small [mm]."""
        return self.value if self.certain else 0.0

    def beneath(self, error: float) -> Floor:
        """The same where a model errs by no more than so much [mm]: noise is part of that."""
        return replace(
            self,
            value=min(self.value, error),
            low=min(self.low, error),
            high=min(self.high, error),
        )

    def drawn(self, count: int, rng: np.random.Generator) -> Array:
        """(count,) values that it may have [mm]."""
        if not self.certain:
            return np.asarray(rng.uniform(self.low, self.high, count))
        low, high = max(self.low, 1e-9), max(self.high, 1e-9)
        middle = min(max(self.value, low), high)
        side = rng.normal(size=count) / SIGMAS
        up, down = np.log(high / middle), np.log(middle / low)
        return np.asarray(middle * np.exp(np.where(side > 0.0, side * up, side * down)))


def floor_of(data: Measurements, error: Array, repeatability: float, most: float) -> Floor:
    """The floor, by revisits, else by what is declared, else by the distances between targets.

    Where there is nothing of these, what a fit leaves at most.  The distances are asked too where
    one part of what is declared is missing.

    error: (m, k, 3) of the best model [m].  repeatability: of the arm by ISO 9283, NaN unknown [m].
    most: RMS distance that noise leaves at most, as the fit tells it [mm].
    """
    again = least_scatter(data, error)
    if again:
        return between(*again)
    instrument, arm = declared(data, repeatability) or (math.nan, math.nan)
    both, seen = float(np.hypot(instrument, arm)), noise_between(data)
    more = seen is not None and of_coordinate(seen[0]) > instrument * wider(seen[1])
    if more or not both < most:  # a part is not known, or data sheets promise less than is seen
        return by_distances(seen, instrument, arm, most)
    low = float(np.hypot(instrument, 0.5 * arm))  # a data sheet promises no more than this
    return Floor(both, low, both, DECLARED)


def by_distances(
    seen: tuple[float, float] | None, instrument: float, arm: float, most: float
) -> Floor:
    """The floor where what is declared does not tell it.

    seen: as `noise_between`.  instrument, arm: RMS distance of what is declared, NaN unknown [mm].
    most: as `floor_of`.
    """
    known = float(np.nan_to_num(instrument))
    if seen:
        value = math.hypot(max(of_coordinate(seen[0]), known), float(np.nan_to_num(arm)))
        grown = wider(seen[1])
        if value / grown < most:  # a fit that leaves less than their middle contradicts no distance
            ends = max(value / grown, min(known, most)), min(value * grown, most)
            return Floor(min(value, most), *ends, DISTANCES)
    return Floor(most, min(known, most), most, AT_MOST)


def of_coordinate(sigma: float) -> float:
    """RMS distance [mm] of points whose coordinates have a standard deviation [m]."""
    return 1e3 * math.sqrt(3.0) * sigma


def wider(relative: float) -> float:
    """How far up or down a value may be, 95 times in 100, by its relative standard error."""
    return math.exp(SIGMAS * relative)


def noise_at_most(error: Array, dof: float) -> float:
    """RMS distance of the noise, 97.5 times in 100 less than this, by what a fit leaves [mm].

    What the fit lacks only adds to it.  error: (m, k, 3) of its points, NaN unknown [m].  dof:
    coordinates less parameters; they tell as much as the poses' squares vary little, since what
    joints do moves all points of a pose together [Satterthwaite 1946].
    """
    square = 1e6 * np.nansum(error**2, axis=(1, 2))
    count = 3.0 * np.count_nonzero(np.isfinite(error[..., 0]))
    told = 2.0 * float(square.sum()) ** 2 / max(len(square) * float(np.var(square)), 1e-300)
    free = max(dof * min(told / count, 1.0), 1.0)
    return math.sqrt(3.0 * float(square.sum()) / dof * free / float(chdtri(free, 0.975)))


def declared(data: Measurements, repeatability: float) -> tuple[float, float] | None:
    """RMS distance by the instrument's u95 and by the arm's repeatability, NaN unknown [mm]."""
    instrument = of_coordinate(instrument_noise(data))
    arm = 1e3 * RMS_OF_REPEATABILITY * repeatability
    return None if np.isnan(instrument) and np.isnan(arm) else (instrument, arm)


def instrument_noise(data: Measurements) -> float:
    """Of a coordinate by the instrument's u95 [m]; NaN if none is told."""
    u95 = data.columns.get("u95", np.full(data.poses, np.nan)) / SIGMAS
    return float(np.sqrt(np.nanmean(u95**2))) if np.isfinite(u95).any() else math.nan


def instrument_alone(data: Measurements) -> tuple[float, str]:
    """RMS distance by the instrument's noise, without that of the joints, and how it is known [mm].

    As declared, or by the targets' distances where these show more; NaN where neither tells.
    """
    told, seen = of_coordinate(instrument_noise(data)), noise_between(data)
    between = of_coordinate(seen[0]) if seen else math.nan
    if math.isnan(told) and math.isnan(between):
        return math.nan, NOTHING_TELLS
    largest = float(np.fmax(between, told))
    return largest, DECLARED if largest == told else DISTANCES


def known_floor(data: Measurements, error: Array, repeatability: float) -> tuple[float, str] | None:
    """The floor [mm] and how it is known, where it is by more than a fit.  As `floor_of`."""
    again = least_scatter(data, error)
    if again:
        return rms_mm(again[0]), REPEATS
    told = declared(data, repeatability)
    both = float(np.hypot(*told)) if told else np.nan
    return (both, DECLARED) if np.isfinite(both) else None


def least_scatter(data: Measurements, error: Array) -> tuple[Array, Array] | None:
    """Deviations among visits to one pose: of the errors, or of the points if these are less.

    Moves between visits are in the points, noise of joints that were read back in the errors.
    """
    both = (visited(data, part) for part in (error, data.y))
    return min((one for one in both if one), key=lambda one: rms_mm(one[0]), default=None)


def visited(data: Measurements, error: Array) -> tuple[Array, Array] | None:
    """As `deviations`, None where too few poses were visited again.  error: or points [m]."""
    group = visits(data)
    if np.count_nonzero(np.bincount(group) > 1) < FEWEST:
        return None
    square, group = deviations(error, group)
    return None if len(np.unique(group)) < FEWEST else (square, group)


def rms_mm(square: Array) -> float:
    """RMS distance [mm] by the median of squared ones [m^2], as of a Gaussian: few wrong points do
    not set it.
    """
    return 1e3 * float(np.sqrt(np.median(square) / USUAL))


def between(square: Array, group: Array) -> Floor:
    """The floor with its ends, poses drawn anew.  square, group: as `deviations`."""
    names, rng = np.unique(group), np.random.default_rng(0)
    member = [np.flatnonzero(group == name) for name in names]
    drawn = [
        rms_mm(square[np.concatenate([member[i] for i in rng.integers(0, len(names), len(names))])])
        for _ in range(RESAMPLES)
    ]
    low, high = np.quantile(drawn, (0.025, 0.975))
    return Floor(rms_mm(square), float(low), float(high), REPEATS)


def deviations(error: Array, group: Array) -> tuple[Array, Array]:
    """Squared distances of visits from their pose's middle, each as large as a point's own scatter
    is expected to be [m^2], and the group of each.

    error: (m, k, 3), NaN unknown [m].  group: (m,).
    """  # fmt: skip
    square, member = [np.zeros(0)], [np.zeros(0, dtype=int)]
    for points in np.swapaxes(error, 0, 1):
        off, free = from_means(points, group)
        again = free[:, 0] > 0.0
        square.append((off[again] ** 2).sum(axis=1) / free[again, 0])
        member.append(group[again])
    return np.concatenate(square), np.concatenate(member)


# ---- what an instrument promises ----------------------------------------------------------------


PATTERN = re.compile(r"([\d.]+)\s*(um|mm)(?:\s*\+\s*([\d.]+)\s*(um|mm)\s*/\s*m)?")


@dataclass(frozen=True)
class Instrument:
    """u95 of a coordinate: a part that is always there [m], and its growth with range [m per m]."""

    base: float
    per_metre: float = 0.0


def instrument_of(text: str) -> Instrument:
    """As ``10um+2.5um/m`` or ``0.05mm``.  Raises OptionError."""
    found = PATTERN.fullmatch(text.strip().replace("µ", "u"))
    base, unit, more, of = found.groups("") if found else ("", "mm", "", "")
    told = Instrument(number_of(base) * LENGTHS[unit], number_of(more or "0") * LENGTHS[of or "mm"])
    if not (0.0 < told.base < 1.0 and told.per_metre <= 1e-2):
        raise OptionError(f"instrument={text!r}: write u95 as 10um+2.5um/m, or as 0.05mm")
    return told


def with_instrument(data: Measurements, text: str | None) -> Measurements:
    """The data with a `u95` column by an instrument's promise; one that is there is kept.

    Raises OptionError.
    """
    if text is None:
        return data
    told = instrument_of(text)
    if "u95" in data.columns:
        said = f"{data.source}: column u95_mm is used, not instrument={text!r}"
        return replace(data, notices=(*data.notices, said))
    reach = np.linalg.norm(data.y, axis=-1)
    far = np.where(np.isfinite(reach), reach, 0.0).sum(axis=1) / np.maximum(data.seen.sum(1), 1)
    return replace(data, columns={**data.columns, "u95": told.base + told.per_metre * far})
