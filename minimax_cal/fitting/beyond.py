"""How a fit does on whole parts of the poses that it has not seen.

Poses held out at random stand among those of the fit, and tell nothing of places where none was
measured.  Here every part (`grouping.parts`) is left out in its turn, the fit is made again of the
rest, and the part judges it.  Parts that none can judge are counted and named.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Annotated

import numpy as np

from minimax_cal.fitting.accuracy import Accuracy, accuracy, max_interval, rms_interval, told
from minimax_cal.fitting.identify import RESOLUTION, redundant
from minimax_cal.fitting.spans import Span, narrow, plan_that_mends, spans_in_words, spans_of
from minimax_cal.fitting.uncertainty import Estimator, Linearised, PartSums, Poses
from minimax_cal.ground.arrays import Array
from minimax_cal.ground.facts import Fact, derived
from minimax_cal.ground.results import Record
from minimax_cal.ground.tables import Table
from minimax_cal.measuring.grouping import Region, groups
from minimax_cal.measuring.measurements import Measurements
from minimax_cal.modelling.model import SumOfSquares
from minimax_cal.modelling.near import is_kept, nearby
from minimax_cal.modelling.parameters import State
from minimax_cal.robots.robot import Robot
from minimax_cal.solvers.least_squares import solve_normal
from minimax_cal.solvers.status import Status

# a part is needed, and not left out, if the condition without it is so much worse
MAX_CONDITION_GROWTH = 3.0
# of a part's error: a fit that another step would move there by less has arrived
MAX_SECOND_STEP = 5e-3
MAX_SHOWN_PARTS = 4  # parts, the worst, for people
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
class Trusted:
    """The same parts without the points that stand out: RMS of all, of the worst [mm], its name."""

    typical_mm: float
    worst_mm: float
    where: str


@dataclass(frozen=True)
class Beyond(Record):
    """The claim for poses where none was measured.

    typical: RMS over all parts together.  worst: of the worst part.  Both [mm], NaN with a
    `reason` where nothing can be left out.  geometric: the same for geometry alone.  rms_high,
    max_high: upper 95 % limits, of the worst part and of the part with the largest distance [mm].
    missed: parts that could not be judged.  sought: whether effects were sought anew without each
    part; None without effects.  trusted: where held-out points stand out, which judge as well.
    spans: of every joint in the poses of the fit.  plan: the command that proposes poses over the
    whole range, where a joint went too little for a claim.
    """

    folds: tuple[Fold, ...] = ()
    typical_mm: float = math.nan
    geometric_typical_mm: Annotated[float, Fact(key="geometric.typical_mm")] = math.nan
    reason: Annotated[str, Fact(brief=True)] = ""
    rms_high_mm: Annotated[float, Fact(key="worst_high95_mm")] = math.nan
    max_high_mm: Annotated[float, Fact(key="max_high95_mm")] = math.nan
    missed: Annotated[tuple[str, ...], Fact(key="not_judged")] = ()
    sought: Annotated[bool | None, Fact(key="effects_sought_anew")] = None
    trusted: Annotated[Trusted | None, Fact(key="without_suspects")] = None
    spans: tuple[Span, ...] = ()
    plan: str | None = None

    @property
    def narrow(self) -> tuple[Span, ...]:
        """The joints that went too little for a claim."""
        return narrow(self.spans)

    @property
    def judged(self) -> str:
        """How many parts judged, of how many, where that is not all."""
        count = len(self.folds)
        return f"{count} of {count + len(self.missed)} parts" if self.missed else ""

    @property
    def kept(self) -> str:
        """That the effects were given, a clause for people; empty where they were sought anew."""
        return ", with the same effects" if self.sought is False else ""

    @property
    def worst(self) -> Fold | None:
        """The part with the largest RMS."""
        return max(self.folds, key=lambda fold: fold.rms_mm, default=None)

    @derived()
    def worst_mm(self) -> float:
        """Its RMS."""
        return self.worst.rms_mm if self.worst else math.nan

    @derived()
    def worst_where(self) -> str | None:
        """Where it is."""
        return self.worst.where if self.worst else None

    @property
    def largest_mm(self) -> float:
        """Largest distance in any part."""
        return max((fold.max_mm for fold in self.folds), default=math.nan)

    @derived(key="narrow")
    def narrow_joints(self) -> list[str]:
        """Names of the joints that went too little for a claim."""
        return [span.joint for span in self.narrow]

    @derived(key="geometric.worst_mm")
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
                if self.narrow
                else ""
            )
        parts = f"{len(self.folds)} parts"
        if self.missed:
            parts = f"{self.judged} (the fit needs the others)"
        less = ""
        if self.trusted:
            worst = f"{self.trusted.worst_mm:.3f} mm ({self.trusted.where})"
            less = f"; without outliers worst part {worst}"
        return (
            f"Outside the measured region, {parts} left out in turn and predicted from the rest"
            f"{self.kept or how}: RMS {self.typical_mm:.3f} mm, worst part {self.worst_mm:.3f} "
            f"mm RMS ({self.worst.where}), largest error {self.largest_mm:.3f} mm{less}."
        )

    def table(self) -> Table:
        """All parts together, and the worst few."""
        shown = sorted(self.folds, key=lambda fold: -fold.rms_mm)[:MAX_SHOWN_PARTS]
        count = sum(fold.poses for fold in self.folds)
        whole = self.judged or f"all {len(self.folds)} parts"
        rows: list[tuple[object, ...]] = [
            (whole, count, self.typical_mm, self.largest_mm, self.geometric_typical_mm)
        ]
        if self.trusted:
            rows.append((f"{whole}, without suspects", count, self.trusted.typical_mm, None, None))
        how = f"each part judged by a fit without it{self.kept}"
        return Table.of(
            f"outside the measured region: {how}, the worst ones",
            shown,
            "where=left out | poses d | rms_mm=RMS mm .4f | max_mm=max mm .4f | "
            "geometric_mm=geometry alone RMS mm .4f",
        ).plus(*(rows if shown else ()))


def not_claimed(robot: Robot, data: Measurements) -> Beyond:
    """The joints' spans before any part is left out, and why there is no claim if one is narrow.

    data: the poses of the fit.
    """
    spans = spans_of(robot, data)
    few = narrow(spans)
    if not few:
        return Beyond(spans=spans)
    plan = plan_that_mends(len(np.unique(groups(data))))
    reason = f"{spans_in_words(few)}; measure over the whole range ({plan})"
    return Beyond(reason=reason, spans=spans, plan=plan)


@dataclass(frozen=True, eq=False)
class Errors:
    """Errors of parts that were left out: names, and (m_i, k, 3) of each [m].

    trusted: the same without points that stand out, NaN there.  missed: parts that cannot judge.
    """

    names: list[str] = field(default_factory=list)
    final: list[Array] = field(default_factory=list)
    geometric: list[Array] = field(default_factory=list)
    trusted: list[Array] = field(default_factory=list)
    missed: list[str] = field(default_factory=list)

    def add(self, name: str, final: Array, geometric: Array, doubted: Array | None = None) -> None:
        """One part.  doubted: (m_i, k) True for points that stand out."""
        self.names.append(name)
        self.final.append(final)
        self.geometric.append(geometric)
        out = np.zeros(final.shape[:2], dtype=bool) if doubted is None else doubted
        self.trusted.append(np.where(out[..., None], np.nan, final))

    def beyond(self, reason: str = NOTHING_LEFT, sought: bool | None = None) -> Beyond:
        """The claim.  reason: why there is none, if there is none.  sought: see `Beyond`."""
        if not self.names:
            return Beyond(reason=reason, missed=tuple(self.missed))
        every = [accuracy(error) for error in self.final]
        plain = [accuracy(error) for error in self.geometric]
        folds = tuple(
            Fold(name, one.poses, one.rms_mm, one.max_mm, other.rms_mm)
            for name, one, other in zip(self.names, every, plain, strict=True)
        )
        return Beyond(
            folds,
            pooled(every),
            pooled(plain),
            "",
            *self.limits(folds),
            missed=tuple(self.missed),
            sought=sought,
            trusted=self.without_suspects(),
        )

    def without_suspects(self) -> Trusted | None:
        """The claim of points that do not stand out, where others do."""
        lost = [np.isnan(less).sum() - np.isnan(error).sum()
                for less, error in zip(self.trusted, self.final, strict=True)]  # fmt: skip
        every = [accuracy(error) for error in self.trusted]
        told = [i for i, one in enumerate(every) if sum(one.counts)]
        if not any(lost) or not told:
            return None
        worst = max(told, key=lambda i: every[i].rms_mm)
        return Trusted(pooled(every), every[worst].rms_mm, self.names[worst])

    def limits(self, folds: Sequence[Fold]) -> tuple[float, float]:
        """Upper 95 % limits of the largest RMS and of the largest distance [mm]."""
        rng = np.random.default_rng(0)
        worst, far = (
            max(range(len(folds)), key=lambda i: getattr(folds[i], kind))
            for kind in ("rms_mm", "max_mm")
        )
        rms = told(rms_interval(self.final[worst], rng=rng), 1e-3 * folds[worst].rms_mm)
        largest = told(max_interval(self.final[far], rng=rng), 1e-3 * folds[far].max_mm)
        return 1e3 * rms.high, 1e3 * largest.high


def pooled(every: Sequence[Accuracy]) -> float:
    """RMS over several sets of points [mm]."""
    total, count = sum(sum(a.sse_mm2) for a in every), sum(sum(a.counts) for a in every)
    return math.sqrt(total / count) if count else math.nan


def needed(poses: Linearised, part: Array) -> bool:
    """Whether a fit loses parameters, or much sureness, without some poses.  part: mask (m,)."""
    return bool(are_needed(poses.normal_matrix, poses.gram_of(part)[None])[0])


def are_needed(gram: Array, parts: Array) -> Array:
    """(f,) whether parameters are lost, or much sureness, without each of some parts of a sum.

    gram: J'J (p, p) of all poses.  parts: (f, p, p) of each part.  What all poses hardly tell, as
    a gear's curve beside the joint's compliance, no part costs.
    """
    scale = np.sqrt(np.maximum(np.diag(gram), 1e-300))
    alike = np.concatenate([gram[None], gram - parts]) / np.outer(scale, scale)
    size = np.sqrt(np.maximum(np.linalg.eigvalsh(alike), 0.0))
    kept = (size > RESOLUTION * size[:, -1:]).sum(axis=1)
    whole, rest, had = size[0], size[1:], int(kept[0])
    wider = rest[:, -1] * whole[-had] > MAX_CONDITION_GROWTH * whole[-1] * rest[:, -had]
    return np.asarray((kept[1:] < had) | wider)


def step_without(poses: Linearised, part: Array) -> Array:
    """(p,) the step of the free parameters once some poses are left out.  part: mask (m,)."""
    gram, gradient = poses.sums_of(part)
    left = poses.gradient - gradient + poses.prior * poses.off
    return solve_normal(poses.normal_matrix - gram, left[:, None])[:, 0]


def without(
    estimator: Estimator, state: State, parts: Sequence[Array], frames: int
) -> list[State | None]:
    """The fit without each of some parts, None where there is none.

    That is where the rest loses geometry: base, links, targets and the frames of further sessions.
    Parameters of effects that the rest does not tell it gives up, as a calibration of the rest
    would.  One step of Gauss and Newton from the whole fit is taken for the answer where a second
    would hardly move the part that is left out, and where effects keep their bounds; else the
    search goes on to its end.  The weights of targets and points stay as they were.

    parts: masks (m,) of the fit's poses.  frames: how many of the effects' parameters, the first,
    are those of the frames.
    """
    if not parts:
        return []
    poses, model = Poses(estimator, state), estimator.model
    free = np.flatnonzero(model.active) < model.names.geometric + frames
    every = poses.sums_by_part(parts)
    lost = are_needed(poses.normal_matrix[np.ix_(free, free)], every.gram[:, free][:, :, free])
    lost &= np.array([part.any() for part in parts])
    gone = np.array([unidentified(poses, gram, ~free) for gram in every.gram])
    near = one_step(poses, parts, every, ~lost & ~gone.any(axis=1))
    return [
        None if lost[i] else near.get(i) or fit_of_rest(poses, part, gone[i])
        for i, part in enumerate(parts)
    ]


def unidentified(poses: Poses, part: Array, asked: Array) -> Array:
    """(p,) True for parameters that poses outside a part do not tell, as `identify.identify` asks.

    part: its J'AJ (p, p).  asked: (p,) those that may be given up.
    """
    out = np.zeros(len(asked), dtype=bool)
    if asked.any():
        gram = poses.normal_matrix - np.diag(poses.prior) - part
        own = np.maximum(np.diag(gram), 0.0)
        gram[np.diag_indices_from(gram)] = np.where(poses.prior > 0.0, 2.0 * own, own)
        every = np.ones(len(asked), dtype=bool)
        out[redundant(gram, every, np.flatnonzero(asked), RESOLUTION)] = True
    return out


def one_step(
    poses: Poses, parts: Sequence[Array], every: PartSums, allowed: Array
) -> dict[int, State]:
    """Where one step leads without a part, for parts after which a second would hardly matter.

    It would where it moved the part's points by more than MAX_SECOND_STEP of their error in the
    whole fit.  That step is a simplified one of Newton, by the normal matrix of the first.

    parts: masks (m,), every: their sums.  allowed: (f,) False for parts that are not to be tried.
    Returns states by the number of the part.
    """
    model, whole, which = poses.estimator.model, poses.estimator.whole, np.flatnonzero(allowed)
    if not len(which):
        return {}
    own, rest = every.gram[which], poses.normal_matrix - every.gram[which]
    left = poses.gradient - every.gradient[which] + poses.prior * poses.off
    first = solve_normal(rest, left[..., None])[..., 0]
    near = SumOfSquares(model).step(poses.state.repeat(len(which)), first)
    off = (model.prior.mean - model.values(near))[:, model.active]
    gradient = whole.gradients(near, ~np.array(parts)[which]) + poses.prior * off
    more = solve_normal(rest, gradient[..., None])
    motion = (np.swapaxes(more, 1, 2) @ own @ more)[:, 0, 0]
    arrived = motion <= MAX_SECOND_STEP**2 * every.square[which]  # not where it is no number
    found = {int(which[i]): near.take(np.array(i)) for i in np.flatnonzero(arrived)}
    return {part: at for part, at in found.items() if is_kept(at, model.room)}


def fit_of_rest(poses: Poses, part: Array, gone: Array) -> State | None:
    """The fit of the poses outside a part, None where the search does not end.

    part: mask (m,).  gone: (p,) True for free parameters that then keep their nominal value.
    """
    estimator, state = poses.estimator, poses.state
    rest = estimator.at(np.flatnonzero(~part)).whole
    active, free = rest.active.copy(), np.flatnonzero(rest.active)
    active[free[gone]] = False
    effects, nominal = state.effects.copy(), rest.prior.mean[rest.names.geometric :]
    dropped = free[gone] - rest.names.geometric
    effects[dropped] = nominal[dropped]
    found = nearby(rest.only(active), replace(state, effects=effects))
    return found.x.take(np.array(0)) if found.status[0] is Status.CONVERGED else None


def left_out(
    estimator: Estimator,
    state: State,
    train: Array,
    parts: Sequence[Region],
    error_of: Callable[[State, Array], Array],
    doubted: Array,
    geometric: tuple[Estimator, State] | None = None,
    frames: int = 0,
) -> Beyond:
    """Every part judges the fit of the training poses outside it.

    train: (m,) True for training poses, of all.  error_of: errors (r, k, 3) of a state at some rows
    of all poses [m].  doubted: (m, k) True for points that stand out.  geometric: the fit without
    effects, where the fit has some.  frames: as `without`.
    """
    masks = [part.rows[train] for part in parts]
    fits = without(estimator, state, masks, frames)
    plain = without(*geometric, masks, frames) if geometric else fits
    errors = Errors()
    for part, fit, other in zip(parts, fits, plain, strict=True):
        if fit and other:
            final = error_of(fit, part.rows)
            alone = error_of(other, part.rows) if geometric else final
            errors.add(part.name, final, alone, doubted[part.rows])
        else:
            errors.missed.append(part.name)
    if not parts:
        return Beyond(reason="the poses are too few or too much alike")
    return errors.beyond(sought=False if geometric else None)
