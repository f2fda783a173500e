"""Accuracy of positions: functions of error arrays, nothing else."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from minimax_cal.ground.arrays import Array
from minimax_cal.ground.files import plain
from minimax_cal.ground.tables import Cell, Table

# the accuracies of a result, and whether they are of held-out poses
HELD = {"nominal": True, "train": False, "holdout": True, "nominal_train": False}


@dataclass(frozen=True)
class Accuracy:
    """Distances between measured and predicted points, over all measured points.

    sse_mm2, counts: per target, the sum of squares F_i and at how many poses it was measured.
    worst: (pose, target) of the largest distance, (-1, -1) without points.
    means_mm, largest_mm: per target, empty where a file does not tell them.
    """

    rms_mm: float
    max_mm: float
    mean_mm: float
    poses: int
    sse_mm2: tuple[float, ...]
    counts: tuple[int, ...]
    worst: tuple[int, int] = (-1, -1)
    means_mm: tuple[float, ...] = field(default=(), compare=False)
    largest_mm: tuple[float, ...] = field(default=(), compare=False)

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
        rows: list[tuple[Cell, ...]] = list(zip(*columns, strict=True))
        total = (sum(self.counts), self.rms_mm, self.mean_mm, self.max_mm, sum(self.sse_mm2))
        return Table(
            title,
            ("target", "points", "RMS mm", "mean mm", "max mm", "sum mm^2"),
            (*rows, ("all", *total)),
            ("", "d", ".4f", ".4f", ".4f", ".4f"),
        )

    def to_dict(self) -> dict[str, object]:
        """For JSON: NaN, which JSON does not know, is null."""
        whole = {
            "rms_mm": self.rms_mm,
            "max_mm": self.max_mm,
            "mean_mm": self.mean_mm,
            "poses": self.poses,
            "sse_mm2": self.sse_mm2,
            "points": self.counts,
        }
        return dict(plain(whole))


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
