"""Accuracy of positions: functions of error arrays, nothing else."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Annotated

import numpy as np

from minimax_cal.ground.arrays import Array
from minimax_cal.ground.facts import APART, Fact
from minimax_cal.ground.results import Record
from minimax_cal.ground.tables import Table

# the accuracies of a result, and whether they are of held-out poses
Ends = tuple[float, float]
NO_ENDS = (math.nan, math.nan)
HELD = {"nominal": True, "train": False, "holdout": True, "nominal_train": False}


@dataclass(frozen=True)
class Accuracy(Record):
    """Distances between measured and predicted points, over all measured points.

    sse_mm2, counts: per target, the sum of squares F_i and at how many poses it was measured.
    rms_ci95_mm, max_ci95_mm: 95 % intervals of RMS and largest, where they were worked out.
    worst: (pose, target) of the largest distance, (-1, -1) without points.
    means_mm, largest_mm: per target, empty where a file does not tell them.
    """

    rms_mm: float
    max_mm: float
    mean_mm: float
    poses: Annotated[int, Fact(least=0)]
    sse_mm2: Annotated[tuple[float, ...], Fact(least=0.0)]
    counts: Annotated[tuple[int, ...], Fact(key="points", least=0)]
    worst: Annotated[tuple[int, int], APART] = (-1, -1)
    means_mm: Annotated[tuple[float, ...], APART] = field(default=(), compare=False)
    largest_mm: Annotated[tuple[float, ...], APART] = field(default=(), compare=False)
    rms_ci95_mm: Annotated[Ends | None, Fact(brief=True)] = field(default=None, compare=False)
    max_ci95_mm: Annotated[Ends | None, Fact(brief=True)] = field(default=None, compare=False)

    def by_target(self) -> tuple[float, ...]:
        """RMS of each target, NaN where it was not measured [mm]."""
        return tuple(
            math.sqrt(square / count) if count else math.nan
            for square, count in zip(self.sse_mm2, self.counts, strict=True)
        )

    def table(self, title: str, targets: tuple[str, ...]) -> Table:
        """As a table, a row a target and one for all."""
        untold = (math.nan,) * len(targets)
        means, largest = self.means_mm or untold, self.largest_mm or untold
        columns = (targets, self.counts, self.by_target(), means, largest, self.sse_mm2)
        total = (sum(self.counts), self.rms_mm, self.mean_mm, self.max_mm, sum(self.sse_mm2))
        heads = "target | points d | RMS mm .4f | mean mm .4f | max mm .4f | sum mm^2 .4f"
        return Table.made(title, zip(*columns, strict=True), heads).plus(("all", *total))


def accuracy(error: Array) -> Accuracy:
    """Summary of point errors (k, m, 3), NaN where not measured [m]; NaN without any point."""
    error = np.ascontiguousarray(error)  # sums are then the same, however it is stored
    distance = 1e3 * np.sqrt(np.einsum("kmi,kmi->km", error, error))
    seen = np.isfinite(distance)
    known = np.where(seen, distance, 0.0)
    sse, counts = tuple((known**2).sum(axis=1).tolist()), tuple(seen.sum(axis=1).tolist())
    total = sum(counts)
    if not total:
        return Accuracy(math.nan, math.nan, math.nan, 0, sse, counts)
    target, pose = divmod(int(np.argmax(np.where(seen, distance, -1.0))), distance.shape[1])
    return Accuracy(
        rms_mm=math.sqrt(sum(sse) / total),
        max_mm=float(distance[target, pose]),
        mean_mm=float(known.sum()) / total,
        poses=int(np.count_nonzero(seen.any(axis=0))),
        sse_mm2=sse,
        counts=counts,
        worst=(pose, target),
        means_mm=tuple((known.sum(axis=1) / np.where(counts, counts, np.nan)).tolist()),
        largest_mm=tuple(np.where(counts, known.max(axis=1), np.nan).tolist()),
    )


def before_and_after(accuracies: Mapping[str, Accuracy]) -> tuple[Accuracy, Accuracy, str]:
    """Before and after a fit, at held-out poses where there are any, and which poses those are."""
    held, train = accuracies["holdout"], accuracies["train"]
    if held.poses:
        where = f"{held.poses} poses that were not used for the fit"
        return accuracies["nominal"], held, where
    where = f"the {train.poses} poses of the fit itself (none was held out)"
    return accuracies["nominal_train"], train, where
