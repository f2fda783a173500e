"""How far the errors shrink on poses that no fit has seen, and what noise alone would leave."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from minimax_cal.diagnosing.causes import Causes
from minimax_cal.diagnosing.result import Finding, Step
from minimax_cal.diagnosing.study import SUM, Study
from minimax_cal.evidence.noise import Noise, Rows
from minimax_cal.fitting.options import silent
from minimax_cal.fitting.solve import fit_cell
from minimax_cal.ground.arrays import Array
from minimax_cal.measuring.accuracy import Accuracy, accuracy
from minimax_cal.measuring.faults import Fault
from minimax_cal.measuring.grouping import groups, split
from minimax_cal.measuring.measurements import Measurements
from minimax_cal.modelling.cell import Cell
from minimax_cal.modelling.effects.table import Term

SHAKY = 3.0  # times what the instrument alone would show between visits
REPEATS = "repeated poses"
REVISITS = 5  # repeated poses that tell a noise floor
RESAMPLES = 1000


@dataclass(frozen=True, eq=False)
class Gap:
    """How far the errors shrink.

    steps: accuracy with the nominal robot, with geometry, and with each effect.  cells: from
    geometry on.  floor: RMS distance that noise alone leaves [mm], floor_from: how it is known.
    closed: share of the gap that is closed on held-out poses, with its 95 % interval.
    """

    steps: tuple[Step, ...]
    cells: tuple[Cell, ...]
    floor: float
    floor_from: str
    closed: float
    closed_ci: tuple[float, float]

    def shaky(self, noise: Noise) -> bool:
        """Whether what is left is mostly that the arm does not come back to the same place."""
        if self.floor_from != REPEATS:
            return False
        instrument = 1e3 * float(np.sqrt(3.0 * noise.variance))
        return self.floor > max(SHAKY * instrument, self.steps[-1].holdout.rms_mm / SHAKY)


def gap_of(
    study: Study,
    raw: Measurements,
    sound: Measurements,
    held: Measurements,
    causes: Causes,
    seed: int,
    holdout: float,
) -> Gap:
    """The gap on poses that no fit has seen.  raw, sound: before and after faults were mended."""
    steps, error = geometric_steps(study, raw, held, causes.faults, seed, holdout)
    cells = [study.geometric]
    terms: list[Term] = []
    for effect in causes.effects:
        terms += effect.terms
        cells.append(study.cell(study.data, terms))
        label = f"+ {effect.term.effect} {effect.term.place}"
        steps.append(step_of(label, cells[-1], study.data, held))
    noise = causes.choice.noise
    floor, source = noise_floor(study.rows, noise, sound, cells[-1], steps[-1].train)
    closed, interval = closed_share(error, cells[-1].error(held), floor, seed)
    return Gap(tuple(steps), tuple(cells), floor, source, closed, interval)


def step_of(name: str, cell: Cell, train: Measurements, held: Measurements) -> Step:
    """A rung: the accuracy of a cell."""
    return Step(name, accuracy(cell.error(train)), accuracy(cell.error(held)))


def geometric_steps(
    study: Study,
    raw: Measurements,
    held: Measurements,
    faults: Sequence[Fault],
    seed: int,
    holdout: float,
) -> tuple[list[Step], Array]:
    """The rungs up to geometry, and the geometric errors of the held-out poses (k, m, 3) [m].

    Faults in the data come first: what they do to a fit and to its judgement.
    """
    train, geometric = study.data, study.geometric
    mended_faults = dict.fromkeys(f.effect for f in faults if f.effect != "readback")
    if not mended_faults:
        nominal = step_of("nominal", study.nominal, train, held)
        return [nominal, step_of("geometric", geometric, train, held)], geometric.error(held)
    first, rest, _ = split(raw, holdout, seed)
    fit = fit_cell(study.robot, first, SUM, silent)
    start, wrong = fit.nominal_cell(study.robot, raw), fit.cell(study.robot, raw)
    steps = [
        step_of("nominal", start, first, rest),
        step_of("geometric", wrong, first, rest),
        step_of(f"without {' and '.join(mended_faults)}", geometric, train, held),
    ]
    return steps, wrong.error(rest)


def with_shares(findings: Sequence[Finding], steps: Sequence[Step], floor: float) -> list[Finding]:
    """Findings with the held-out RMS before and after, and their shares of the gap, largest first.

    Faults that are mended share the first step after geometry.
    """
    gap = max(steps[1].holdout.rms_mm ** 2 - floor**2, 1e-12)
    out, at = [], 1
    mendable = [f for f in findings if f.term.effect in ("outliers", "swapped_rows")]
    for found in findings:
        if found.term.effect == "readback":
            out.append(found)
            continue
        fault = found in mendable
        low = 2 if fault else (at + 1 if at > 1 or not mendable else 3)
        before, after = steps[low - 1].holdout.rms_mm, steps[low].holdout.rms_mm
        at = low if not fault or found is mendable[-1] else at
        share = (before**2 - after**2) / gap / (len(mendable) if fault else 1)
        out.append(replace(found, before=before, after=after, share=share))
    return sorted(out, key=lambda f: -f.share if np.isfinite(f.share) else -np.inf)


def noise_floor(
    rows: Rows, noise: Noise, data: Measurements, cell: Cell, fitted: Accuracy
) -> tuple[float, str]:
    """RMS distance that noise alone leaves [mm], and how it is known.

    From poses visited again, with the effects of time and approach taken out, where there are
    enough; from the noise of the final fit where that is less, because nobody repeats better.
    Where the fit still has structure it is an upper bound.  fitted: of the final fit.
    """
    spread = noise.variance * (1.0 + noise.ratio * rows.variance_ratio).sum() / max(rows.count, 1)
    model = min(1e3 * float(np.sqrt(3.0 * spread)), fitted.rms_mm)
    group = groups(data)
    error = np.moveaxis(cell.error(data), 1, 0).reshape(data.poses, -1)
    total, dof, again = 0.0, 0, 0
    names, counts = np.unique(group, return_counts=True)
    for name in names[counts > 1]:
        mine = error[group == name]
        whole = np.isfinite(mine).all(axis=0)
        off = mine[:, whole] - mine[:, whole].mean(axis=0)
        total += float((off**2).sum())
        dof += (len(mine) - 1) * int(whole.sum())
        again += len(mine) - 1
    if again >= REVISITS and dof:
        revisits = 1e3 * float(np.sqrt(3.0 * total / dof))
        if revisits < model:
            return revisits, REPEATS
    return model, "noise of the fit"


def closed_share(
    before: Array, after: Array, floor: float, seed: int
) -> tuple[float, tuple[float, float]]:
    """Share of the gap that is closed on held-out poses, and its 95 % interval over poses.

    1 - (after^2 - floor^2) / (before^2 - floor^2) of the RMS distances; NaN where there is no gap.
    before, after: (k, m, 3) errors [m], of the same poses if no rows were left out.
    """
    sums = []
    for error in (before, after):
        squares = np.nansum(1e6 * (error**2).sum(axis=-1), axis=0)
        sums.append(np.stack([squares, np.isfinite(error[..., 0]).sum(axis=0)]))

    def share(first: Array, last: Array) -> Array:
        gap = first[0] / np.maximum(first[1], 1) - floor**2
        rest = last[0] / np.maximum(last[1], 1) - floor**2
        return np.where(gap > 0.0, 1.0 - rest / np.where(gap > 0.0, gap, 1.0), np.nan)

    rng = np.random.default_rng(seed)
    drawn = [rng.integers(0, part.shape[1], (RESAMPLES, part.shape[1])) for part in sums]
    if sums[0].shape == sums[1].shape:
        drawn[1] = drawn[0]
    spread = share(*(part[:, rows].sum(axis=-1) for part, rows in zip(sums, drawn, strict=True)))
    spread = spread[np.isfinite(spread)]
    if not len(spread):
        return float("nan"), (float("nan"), float("nan"))
    low, high = np.quantile(spread, (0.025, 0.975))
    return float(share(*(part.sum(axis=1) for part in sums))), (float(low), float(high))


def blocked(study: Study, data: Measurements, cell: Cell) -> dict[str, float | None]:
    """RMS on the last fifth of the session, fitted to what came before [mm].

    A random choice of held-out poses does not show what drifts; this does.
    """
    own = len(study.fit.effects.terms)  # frames of sessions are free anyway
    terms, found = cell.effects.terms[own:], cell.effects.values[own:]
    values = np.concatenate([np.zeros(0), *found])
    clock = data.columns["clock"]
    late = clock > np.quantile(clock, 0.8)
    first, last = data.take(~late), data.take(late)
    out: dict[str, float | None] = {"last_poses": last.poses}
    if last.poses and first.poses > 3 * last.poses:
        geometric = accuracy(study.cell(first).error(last)).rms_mm
        usual = 3.0 * np.abs(values)
        final = accuracy(study.cell(first, terms, usual).error(last)).rms_mm if terms else geometric
        out |= {"geometric_rms_mm": geometric, "final_rms_mm": final}
    return out
