"""How far the errors shrink on poses that no fit has seen, and what noise alone would leave."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from minimax_cal.diagnosing.joint import Joint, joint
from minimax_cal.diagnosing.result import TOLD_AS, Finding, Step, as_motion
from minimax_cal.diagnosing.study import Study
from minimax_cal.diagnosing.trial import Trial, Trials
from minimax_cal.evidence.limits import END, FOLDS, HELPS, MINOR, SAYS_NOTHING, SEEN_BEFORE
from minimax_cal.fitting.accuracy import accuracy
from minimax_cal.fitting.beyond import without
from minimax_cal.fitting.floor import Floor
from minimax_cal.fitting.stations import steps_of
from minimax_cal.ground.arrays import Array
from minimax_cal.ground.linear_algebra import jackknife_variance, project_out
from minimax_cal.measuring.faults import mended, standing_out
from minimax_cal.measuring.faults.nests import RESEAT
from minimax_cal.measuring.grouping import clusters
from minimax_cal.measuring.measurements import Measurements
from minimax_cal.modelling.cell import Cell
from minimax_cal.modelling.effects.maps import curve_of
from minimax_cal.modelling.effects.scene import Scene, joint_of
from minimax_cal.modelling.effects.table import EFFECTS, Term

RESAMPLES = 1000
FEWEST = 100  # of them that show a gap
ROUNDING = 1e-9  # share of a squared error that is none
SPARED = 10  # groups of training poses that are left out in turn, for the interval
FAULTS = ("outliers", "swapped_rows", RESEAT)  # that are mended before anything is fitted

Ends = tuple[float, float]


class Fits(Sequence[Joint]):
    """Geometry, then with each of some effects more; each fit is made when it is first asked for.

    steps: the terms of each effect.  made: fits by their number.  The first of them make none.
    """

    def __init__(
        self, study: Study, steps: Sequence[Sequence[Term]], made: dict[int, Joint] | None = None
    ) -> None:
        self.study, self.steps = study, steps
        self.made = {} if made is None else made

    def __len__(self) -> int:
        return 1 + len(self.steps)

    def __getitem__(self, at: Any) -> Any:
        if isinstance(at, slice):
            start, stop, step = at.indices(len(self))
            if (start, step) == (0, 1) and stop:
                return Fits(self.study, self.steps[: stop - 1], self.made)
            return [self[i] for i in range(start, stop, step)]
        number = range(len(self))[at]
        if number not in self.made:
            terms = [term for some in self.steps[:number] for term in some]
            self.made[number] = joint(self.study, terms)
        return self.made[number]


@dataclass(frozen=True, eq=False)
class Ladder:
    """Geometry, then with each effect that helps, those that are confirmed first.

    taken: numbers of the effects that the ladder took.  With the others groups of poses that were
    left out, or the training poses themselves, are met no better.
    parts: masks (m,) of those groups.  sure: how many of those taken are confirmed.
    """

    fits: Sequence[Joint]
    taken: tuple[int, ...]
    parts: tuple[Array, ...]
    sure: int

    @property
    def confirmed(self) -> Ladder:
        """As far as it is recommended."""
        return replace(self, fits=self.fits[: 1 + self.sure], taken=self.taken[: self.sure])

    @property
    def last(self) -> Joint:
        """With every effect taken."""
        return self.fits[-1]

    @property
    def maps(self) -> tuple[Term, ...]:
        """The error maps of joints that it took."""
        return tuple(term for term in self.last.terms if EFFECTS[term.effect].is_map)


def folds(data: Measurements, count: int) -> Array:
    """(m,) number of a fold, groups of poses together, at random."""
    group = clusters(data)
    order = np.random.default_rng(0).permutation(int(group.max()) + 1)
    return np.asarray(order[group] % count)


def fit_ladder(
    study: Study, effects: Sequence[Sequence[Term]], sure: Sequence[bool], *, guessed: bool = False
) -> Ladder:
    """The ladder of a study's effects, in their order; with maps of joints the largest first.

    Those that are sure come first: what is recommended is fitted without the others.

    What is refused is tried again beside what was taken after it: beside errors much larger than
    its own the prior of a map is too wide.

    guessed: whether effects are a best guess: structure is left, or names change with the poses.
    Then laws of a joint's angle, or of the time, must predict the ends of what drives them, left
    out, no worse either.
    """
    part, trials = folds(study.data, FOLDS), Trials(study, effects)
    last, taken = trials.trial(()), list[int]()
    spared = last.spared([part == number for number in range(FOLDS)])
    mapped = any(EFFECTS[term.effect].is_map for terms in effects for term in terms)
    order = by_size(trials, study, effects) if mapped else list(range(len(effects)))

    def helps(wide: Trial, number: int) -> bool:
        both = wide.spared(spared)
        better = wide.cross_validated(both) < (1.0 - HELPS) * last.cross_validated(both)
        if not (better and wide.no_worse(last)):
            return False
        ends = ends_of(study.scene, effects[number][0]) if guessed else []
        both = wide.spared(last.spared(ends))
        return wide.cross_validated(both) <= last.cross_validated(both)

    for first in (True, False):
        waiting = [number for number in order if sure[number] == first]
        while waiting:
            refused: list[tuple[int, int]] = []  # with how many were taken before
            for number in waiting:
                wide = trials.trial((*taken, number))
                if helps(wide, number):
                    last = wide
                    taken.append(number)
                else:
                    refused.append((number, len(taken)))
            waiting = [number for number, before in refused if mapped and before < len(taken)]
    fits = Fits(study, [effects[number] for number in taken])
    confirmed = sum(sure[number] for number in taken)
    return Ladder(fits, tuple(taken), tuple(spared), confirmed)


def by_size(trials: Trials, study: Study, effects: Sequence[Sequence[Term]]) -> list[int]:
    """Effects in the order of how far they move the points beside what geometry does.

    All are fitted together; rows weigh as those in which they were sought.
    """
    whole, rows = np.zeros((len(effects), len(study.rows.error))), study.rows
    values, at = trials.trial(range(len(effects))).values, 0
    for number, terms in enumerate(effects):
        for term in terms:
            if term.frees_frames:
                continue
            fields = term.columns(study.scene).displacement(study.scene)
            value = values[at : at + len(fields)]
            at += len(fields)
            whole[number] += rows.of(np.tensordot(value, fields, 1)[None])[:, 0]
    clear = project_out(whole.T, rows.basis)
    return [int(number) for number in np.argsort(-(clear**2).sum(axis=0), kind="stable")]


def ends_of(scene: Scene, term: Term) -> list[Array]:
    """Poses (m,) at both ends of the angle or the time that a law follows; none of other laws.

    A map is nothing outside the angles that were measured.
    """
    effect, driver = EFFECTS[term.effect], np.zeros(0)
    if effect.follows == "time":
        driver = scene.column("clock")
    elif effect.of_angle and not effect.is_map and term.place != "all":
        driver = scene.q[joint_of(term.place)]
    if not driver.size or np.ptp(driver) == 0.0:
        return []
    low, high = np.quantile(driver, (END, 1.0 - END))
    return [driver <= low, driver >= high]


def valued(findings: Sequence[Finding], ladder: Ladder) -> list[Finding]:
    """The findings that a ladder took, with values and sigmas of its last fit."""
    out, last = [], ladder.last
    at = len(ladder.fits[0].state.effects)  # after the frames of sessions
    geometric = last.model.names.geometric
    sigma = last.uncertainty.sigma[geometric:] if ladder.taken else np.zeros(0)
    for finding in [findings[number] for number in ladder.taken]:
        own = slice(at, at + len(finding.values))
        at = own.stop
        values, sure = last.state.effects[own], sigma[own].tolist()
        motion, term, curve = motions(last.study.scene, finding), finding.term, finding.curve
        if EFFECTS[term.effect].is_map:
            sign = float(last.study.robot.sign[joint_of(term.place)])
            covers = slice(geometric + own.start, geometric + own.stop)
            covariance = last.uncertainty.covariance[covers, covers]
            curve = curve_of(term.choice, sign, values, covariance)
        new = replace(finding, values=tuple(values.tolist()), sigmas=tuple(sure), motion=motion)
        out.append(replace(new, curve=curve))
    return out


def motions(scene: Scene, finding: Finding) -> tuple[float, ...]:
    """The largest motion per unit of each parameter, where its unit rests on assumed masses.

    Turns of a joint [rad], or motion of a target [m].
    """
    told = scene.known_masses or scene.measured_torques
    units = {as_motion(finding.term.effect, unit) for unit in finding.units}
    if told or "" in units:
        return ()
    out: list[float] = []
    for term in finding.terms:
        columns = term.columns(scene)
        turns = units == {TOLD_AS["rad/(N m)"]}
        fields = columns.turn if turns else columns.displacement(scene)
        size = np.abs(fields) if turns else np.linalg.norm(fields, axis=2)
        out += [float(part.max()) for part in size]
    return tuple(out)


# ---- accuracy ----------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Judges:
    """Poses that judge: those of the fit, those held out, and points held out that stand out.

    far: (m, k) True for points of `held` that no sound arm shows.  by: whose groups are left out
    in turn, as in `grouping.parts`.
    """

    train: Measurements
    held: Measurements
    far: Array
    by: str | None = None

    @staticmethod
    def of(
        held: Measurements,
        measured: Measurements,
        clean: Measurements,
        train: Measurements,
        by: str | None,
    ) -> Judges:
        """Every held-out point as measured, those that stand out marked.

        measured: points that stood in each other's rows put back.  clean: without faults.
        """
        right = dict(zip(measured.line, measured.y, strict=True))
        y = [right.get(line, held.y[i]) for i, line in enumerate(held.line)]
        held = held.with_y(np.array(y))
        sound = of_lines(held.line, clean.line, clean.seen)
        return Judges(train, held, held.seen & ~sound, by)

    @property
    def whole(self) -> Measurements:
        """All poses in the order of the file, held-out points that stand out NaN."""
        y = np.where(self.far[..., None], np.nan, self.held.y)
        every = self.train.followed_by(self.held.with_y(y))
        return every.take(np.argsort(every.line, kind="stable"))

    @property
    def everyone(self) -> Measurements:
        """The same without poses of which nothing is left."""
        whole = self.whole
        return whole.take(np.asarray(whole.seen.any(axis=1)))

    def marked(self, first: Cell, last: Cell) -> tuple[Judges, tuple[str, ...]]:
        """With what stands out from the last fit marked too, and the points, of all poses.

        What geometry leaves may hide a point that is off by less.  Of one that is wrong the first
        fit, of geometry alone, says nearly the same: one that only the last misses is its own.
        """
        whole = self.whole
        before, error = (cell.error(whole) for cell in (first, last))
        sound = mended(whole, standing_out(last.placed(whole), error)).seen
        alike = (before * error).sum(axis=-1) > SEEN_BEFORE * (error**2).sum(axis=-1)
        far = whole.seen & ~sound & alike
        points = [
            f"{whole.called(whole.line[row])} {whole.target_names[i]}"
            for row, i in np.argwhere(far)
        ]
        more = of_lines(self.held.line, whole.line, far)
        return replace(self, far=self.far | more), tuple(points)

    def step(self, name: str, cell: Cell) -> Step:
        """A rung: the accuracy of a cell."""
        every, trusted = cell.error(self.held), self.errors(cell)
        return Step(name, accuracy(cell.error(self.train)), accuracy(every), accuracy(trusted))

    def errors(self, cell: Cell) -> Array:
        """(m, k, 3) of a cell at the held-out poses, NaN for what stands out [m]."""
        return np.where(self.far[..., None], np.nan, cell.error(self.held))


def of_lines(wanted: Array, line: Array, rows: Array) -> Array:
    """(w, k) of some lines of the file their rows, False for those that are not there.

    line: (m,) of the rows (m, k).
    """
    known, nothing = dict(zip(line, rows, strict=True)), np.zeros(rows.shape[1], dtype=bool)
    return np.array([known.get(one, nothing) for one in wanted])


def with_shares(findings: Sequence[Finding], steps: Sequence[Step], floor: float) -> list[Finding]:
    """Findings with the held-out RMS before and after, and their shares of the gap, largest first.

    Faults that are mended share the first step after geometry.  Points that stand out judge none.
    """
    whole = steps[1].trusted.rms_mm ** 2
    gap = whole - floor**2 if floor**2 < whole * (1.0 - ROUNDING) else np.nan
    out, at = [], 1
    of_data = [f for f in findings if f.rows or f.term.effect not in EFFECTS]
    mendable = [f for f in of_data if f.term.effect in FAULTS]
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
        minor = not fault and before**2 - after**2 < MINOR * geometric
        out.append(replace(found, before=before, after=after, share=share, minor=minor))
    return sorted(out, key=lambda f: -f.share if np.isfinite(f.share) else -np.inf)


# ---- how much is closed ------------------------------------------------------------------------


def closed(ladder: Ladder, judges: Judges, floor: Floor, seed: int) -> tuple[float, Ends]:
    """Share of the gap that a ladder closes on held-out poses, and its 95 % interval."""
    before, after = (judges.errors(fit.cell) for fit in (ladder.fits[0], ladder.last))
    variance, rng = spared(ladder, judges, floor), np.random.default_rng(seed)
    return clip_share(*closed_share(before, after, clusters(judges.held), floor, variance, rng))


def clip_share(share: float, ends: Ends) -> tuple[float, Ends]:
    """A share and its interval between 0 and 1; NaN for an interval that says nothing."""
    low, high = np.clip(ends, 0.0, 1.0).tolist()
    if not high - low < SAYS_NOTHING:
        low = high = float("nan")
    return float(np.clip(share, 0.0, 1.0)), (low, high)


def closed_share(
    before: Array,
    after: Array,
    group: Array,
    floor: Floor,
    variance: float,
    rng: np.random.Generator,
) -> tuple[float, Ends]:
    """Share of the gap that is closed, and its 95 % interval.

    1 - (after^2 - floor^2) / (before^2 - floor^2) of the RMS distances; NaN where there is no gap.
    Groups of poses and the floor are drawn anew; what other poses of the fit would change is the
    variance.  before, after: (m, k, 3) errors of the same poses [m].  group: (m,).
    """
    pair = [sums(error) for error in (before, after)]
    share = float(share_of([part.sum(axis=1) for part in pair], np.array([floor.least]))[0])
    if not np.isfinite(share):
        return share, (share, share)
    group = np.unique(group, return_inverse=True)[1].reshape(-1)
    count = int(group.max()) + 1
    whole = [np.stack([np.bincount(group, row, count) for row in part]) for part in pair]
    rows = rng.integers(0, count, (RESAMPLES, count))
    drawn = share_of([part[:, rows].sum(axis=-1) for part in whole], floor.drawn(RESAMPLES, rng))
    drawn = drawn[np.isfinite(drawn)]
    if len(drawn) < FEWEST:
        return share, (float("nan"), float("nan"))
    middle = float(np.median(drawn))
    grow = np.sqrt(1.0 + variance / max(float(np.var(drawn)), 1e-300))
    low, high = middle + grow * (np.quantile(drawn, (0.025, 0.975)) - middle)
    return share, (float(min(low, share)), float(max(high, share)))


def sums(error: Array) -> Array:
    """(2, m) sum of squares [mm^2] and number of points of each pose.  error: (m, k, 3) [m]."""
    squares = np.nansum(1e6 * (error**2).sum(axis=-1), axis=1)
    return np.stack([squares, np.isfinite(error[..., 0]).sum(axis=1)])


def share_of(pair: Sequence[Array], floor: Array) -> Array:
    """Share of the gap closed, NaN where there is none.  pair: sums and counts (2, ...) [mm^2]."""
    gap, rest = (part[0] / np.maximum(part[1], 1) - floor**2 for part in pair)
    return np.where(gap > 0.0, 1.0 - rest / np.where(gap > 0.0, gap, 1.0), np.nan)


def spared(ladder: Ladder, judges: Judges, floor: Floor) -> float:
    """Variance of the share closed that the choice of training poses brings: a jackknife."""
    part, frames = folds(judges.train, SPARED), steps_of(judges.train.frames)
    masks = [part == number for number in range(SPARED)]
    fits, known = (ladder.fits[0], ladder.last), np.zeros(0)
    for states in zip(*(without(f.estimator, f.state, masks, frames) for f in fits), strict=True):
        pair = [
            sums(judges.errors(fit.with_state(state))).sum(axis=1)
            for fit, state in zip(fits, states, strict=True)
            if state is not None
        ]
        if len(pair) == len(fits):
            known = np.append(known, share_of(pair, np.array([floor.least])))
    known = known[np.isfinite(known)]
    return float(jackknife_variance(known)) if len(known) > 2 else 0.0
