"""How a fit does on whole parts of the poses that it has not seen.

Poses held out at random stand among those of the fit, and tell nothing of places where none was
measured.  Here every part (`grouping.parts`) is left out in its turn, the fit is made again of the
rest, and the part judges it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from minimax_cal.fitting.intervals import max_interval, rms_interval
from minimax_cal.fitting.uncertainty import Estimator, Poses
from minimax_cal.ground.arrays import Array
from minimax_cal.ground.files import finite
from minimax_cal.ground.tables import Table
from minimax_cal.measuring.accuracy import Accuracy, accuracy
from minimax_cal.measuring.grouping import Region
from minimax_cal.modelling.parameters import State
from minimax_cal.solvers.least_squares import solve_normal

WORSE = 3.0  # a part is needed, and not left out, if the condition without it is so much worse
RANK = 1e-3  # singular value below which a parameter is lost, as `identify.RESOLUTION`
SHOWN = 4  # parts, the worst, for people
NOTHING_LEFT = "every part of the poses is needed for the fit"


@dataclass(frozen=True)
class Fold:
    """A part that was left out: RMS and largest distance there, and RMS with geometry alone."""

    where: str
    poses: int
    rms_mm: float
    max_mm: float
    geometric_mm: float


@dataclass(frozen=True)
class Beyond:
    """The claim for poses where none was measured.

    typical: RMS over all parts together.  worst: of the worst part.  Both [mm], NaN with a
    `reason` where nothing can be left out.  geometric: the same for geometry alone.  rms_high,
    max_high: upper 95 % limits, of the worst part and of the part with the largest distance [mm].
    """

    folds: tuple[Fold, ...] = ()
    typical_mm: float = math.nan
    geometric_typical_mm: float = math.nan
    reason: str = ""
    rms_high_mm: float = math.nan
    max_high_mm: float = math.nan

    @property
    def worst(self) -> Fold | None:
        """The part with the largest RMS."""
        return max(self.folds, key=lambda fold: fold.rms_mm, default=None)

    @property
    def worst_mm(self) -> float:
        """Its RMS."""
        return self.worst.rms_mm if self.worst else math.nan

    @property
    def geometric_worst_mm(self) -> float:
        """Largest RMS of geometry alone."""
        return max((fold.geometric_mm for fold in self.folds), default=math.nan)

    def sentence(self) -> str:
        """For the headline, empty where there is no claim."""
        if not self.worst:
            return ""
        return (
            f"Beyond the measured poses, each part left out in turn: RMS {self.typical_mm:.3f} mm, "
            f"at worst {self.worst_mm:.3f} mm ({self.worst.where})."
        )

    def table(self) -> Table:
        """All parts together, and the worst few."""
        shown = sorted(self.folds, key=lambda fold: -fold.rms_mm)[:SHOWN]
        count = sum(fold.poses for fold in self.folds)
        most = max((fold.max_mm for fold in self.folds), default=math.nan)
        whole = (f"all {len(self.folds)} parts", count, self.typical_mm, most)
        rows = tuple((f.where, f.poses, f.rms_mm, f.max_mm, f.geometric_mm) for f in shown)
        return Table(
            "beyond the measured poses: each part judged by a fit without it, the worst ones",
            ("left out", "poses", "RMS mm", "max mm", "geometry alone RMS mm"),
            (*rows, (*whole, self.geometric_typical_mm)) if rows else (),
            ("", "d", ".4f", ".4f", ".4f"),
        )

    def to_dict(self) -> dict[str, Any]:
        """For JSON."""
        out: dict[str, Any] = {
            "typical_mm": finite(self.typical_mm),
            "worst_mm": finite(self.worst_mm),
            "worst_where": self.worst.where if self.worst else None,
            "worst_high95_mm": finite(self.rms_high_mm),
            "max_high95_mm": finite(self.max_high_mm),
            "folds": [vars(fold) for fold in self.folds],
            "geometric": {
                "typical_mm": finite(self.geometric_typical_mm),
                "worst_mm": finite(self.geometric_worst_mm),
            },
        }
        return out | ({"reason": self.reason} if self.reason else {})


@dataclass(frozen=True, eq=False)
class Errors:
    """Errors of parts that were left out: names, and (k, m_i, 3) of each [m]."""

    names: list[str] = field(default_factory=list)
    final: list[Array] = field(default_factory=list)
    geometric: list[Array] = field(default_factory=list)

    def add(self, name: str, final: Array, geometric: Array) -> None:
        """One part."""
        self.names.append(name)
        self.final.append(final)
        self.geometric.append(geometric)

    def beyond(self, reason: str = NOTHING_LEFT) -> Beyond:
        """The claim.  reason: why there is none, if there is none."""
        if not self.names:
            return Beyond(reason=reason)
        every = [accuracy(error) for error in self.final]
        plain = [accuracy(error) for error in self.geometric]
        folds = tuple(
            Fold(name, one.poses, one.rms_mm, one.max_mm, other.rms_mm)
            for name, one, other in zip(self.names, every, plain, strict=True)
        )
        return Beyond(folds, pooled(every), pooled(plain), "", *self.limits(folds))

    def limits(self, folds: Sequence[Fold]) -> tuple[float, float]:
        """Upper 95 % limits of the largest RMS and of the largest distance [mm]."""
        rng = np.random.default_rng(0)
        worst, far = (
            max(range(len(folds)), key=lambda i: getattr(folds[i], kind))
            for kind in ("rms_mm", "max_mm")
        )
        rms, largest = (
            rms_interval(self.final[worst], rng=rng),
            max_interval(self.final[far], rng=rng),
        )
        return 1e3 * rms.high, 1e3 * largest.high


def pooled(every: Sequence[Accuracy]) -> float:
    """RMS over several sets of points [mm]."""
    total, count = sum(sum(a.sse_mm2) for a in every), sum(sum(a.counts) for a in every)
    return math.sqrt(total / count) if count else math.nan


def needed(poses: Poses, part: Array) -> bool:
    """Whether a fit loses parameters, or much sureness, without some poses.  part: mask (m,).

    What all poses hardly tell, as a gear's curve beside the joint's compliance, no part costs.
    """
    gram = poses.bread
    scale = np.sqrt(np.maximum(np.diag(gram), 1e-300))
    whole, rest = (
        np.sqrt(np.maximum(np.linalg.eigvalsh(one / np.outer(scale, scale)), 0.0))
        for one in (gram, gram - poses.gram_of(part))
    )
    had, kept = (int((one > RANK * one[-1]).sum()) for one in (whole, rest))
    return bool(kept < had or rest[-1] * whole[-had] > WORSE * whole[-1] * rest[-had])


def step_without(poses: Poses, part: Array) -> Array:
    """(p,) the step of the free parameters once some poses are left out.  part: mask (m,)."""
    gram, pull = poses.sums_of(part)
    left = poses.pull - pull + poses.prior * poses.off
    return solve_normal(poses.bread - gram, left[:, None])[:, 0]


def without(estimator: Estimator, state: State, parts: Sequence[Array]) -> list[State | None]:
    """The fit without each of some parts, None where the part is needed.

    One step of Gauss and Newton from the whole fit, which is near: a second changes the RMS of a
    part by less than 0.5 % on the real arms tried.  The weights of targets and points stay as they
    were.  parts: masks (m,) of the fit's poses.
    """
    poses = Poses.of(estimator, state)
    out: list[State | None] = []
    for part in parts:
        if not part.any():
            out.append(state)
            continue
        if needed(poses, part):
            out.append(None)
            continue
        out.append(moved(estimator, state, step_without(poses, part)))
    return out


def moved(estimator: Estimator, state: State, step: Array) -> State:
    """A state after a step of the free parameters."""
    full = np.zeros(estimator.model.names.count)
    full[estimator.model.active] = step
    return state.step(full)


def left_out(
    estimator: Estimator,
    state: State,
    train: Array,
    parts: Sequence[Region],
    error_of: Callable[[State, Array], Array],
    geometric: tuple[Estimator, State] | None = None,
) -> Beyond:
    """Every part judges the fit of the training poses outside it.

    train: (m,) True for training poses, of all.  error_of: errors (k, r, 3) of a state at some rows
    of all poses [m].  geometric: the fit without effects, where the fit has some.
    """
    masks = [part.rows[train] for part in parts]
    fits = without(estimator, state, masks)
    plain = without(*geometric, masks) if geometric else fits
    errors = Errors()
    for part, fit, other in zip(parts, fits, plain, strict=True):
        if not (fit and other):
            continue
        final = error_of(fit, part.rows)
        if np.isfinite(final).any():  # else every point of the part stands out
            errors.add(part.name, final, error_of(other, part.rows) if geometric else final)
    return errors.beyond() if parts else Beyond(reason="the poses are too few or too much alike")
