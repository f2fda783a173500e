"""Diagnose the gap that geometry leaves: where it lies, what causes it, how far it shrinks."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from threadpoolctl import threadpool_limits

from minimax_cal.diagnosing.lack_of_fit import Trace, rest_of, structure
from minimax_cal.diagnosing.next_measurement import Site, separate_with
from minimax_cal.diagnosing.result import Alternative, Diagnosis, Finding, Step
from minimax_cal.diagnosing.sentences import reasons
from minimax_cal.diagnosing.where import Where, where
from minimax_cal.evidence import selection
from minimax_cal.evidence.alternatives import ENOUGH, alternatives, resemblances
from minimax_cal.evidence.noise import Noise, Rows, linearised
from minimax_cal.evidence.selection import Choice, Library
from minimax_cal.fitting.calibrate import Fit, Options, Progress, fit_cell, silent
from minimax_cal.fitting.calibration import Provenance
from minimax_cal.fitting.checks import check_plausible, misplaced, put_right
from minimax_cal.ground.arrays import Array
from minimax_cal.ground.errors import DataError, OptionError
from minimax_cal.measuring import checks
from minimax_cal.measuring.accuracy import Accuracy, accuracy
from minimax_cal.measuring.faults import Fault, find_faults, looks_read_back, mended
from minimax_cal.measuring.history import with_history
from minimax_cal.measuring.measurements import Measurements, groups, read_measurements, split
from minimax_cal.modelling.cell import Cell
from minimax_cal.modelling.effects.scene import Scene
from minimax_cal.modelling.effects.table import EFFECTS, NOTHING, Term
from minimax_cal.modelling.joint_fit import refitted, scene_of
from minimax_cal.modelling.model import Model, model_of
from minimax_cal.robots.robot import Robot, load_robot

LEVEL = 0.01  # chance that noise alone is called structure
MATTERS = 0.015  # share of what was explained below which more structure is of no account
OF_ANGLE = {"gear_error", "encoder_gain", "gravity_compensator"}  # functions of one joint angle
SHAKY = 3.0  # times what the instrument alone would show between visits
REPEATS = "repeated poses"
ADVISED = 3  # rivals of an effect for which a further measurement is worked out
REVISITS = 5  # repeated poses that tell a noise floor
RESAMPLES = 1000
SUM = Options(objective="sum")
ANY: Array = np.zeros(0)


@dataclass(frozen=True, eq=False)
class Study:
    """The geometric fit of the training poses, linearised.

    model, fit: geometry alone.  scene: what effects look at.  rows: rotated, for the two noises.
    """

    robot: Robot
    data: Measurements
    model: Model
    fit: Fit
    scene: Scene
    rows: Rows

    def cell(self, data: Measurements, terms: Sequence[Term] = (), usual: Array = ANY) -> Cell:
        """Geometry and effects fitted to some poses, from the fit of the training poses.

        usual: (e,) size of the effects' parameters, where the poses may not tell them.
        """
        active = self.fit.identification.active
        state, effects = refitted(self.robot, data, self.fit.state, active, terms, usual)
        return Cell.of(self.robot, state, self.data.target_names, effects)

    @property
    def geometric(self) -> Cell:
        """The calibrated robot without effects."""
        return Cell.of(self.robot, self.fit.state, self.data.target_names, NOTHING)

    @property
    def nominal(self) -> Cell:
        """The nominal robot with its best base and targets."""
        return Cell.of(self.robot, self.fit.nominal, self.data.target_names, NOTHING)


def studied(robot: Robot, data: Measurements, fit: Fit) -> Study:
    """A geometric fit linearised."""
    model, state = model_of(robot, data), fit.state
    scene = scene_of(robot, data, model, state)
    return Study(robot, data, model, fit, scene, linearised(model, state, scene.jacobian))


def diagnose(
    robot: Robot | str | Path,
    data: Measurements | str | Path,
    *,
    seed: int = 0,
    holdout: float = 0.2,
    exclude: Sequence[str] = (),
    progress: Progress = silent,
) -> Diagnosis:
    """Say what is still wrong with a calibrated robot, and why, as far as the data can tell.

    robot, data: loaded, or a name or path.  seed, holdout: as of `calibrate`.  exclude: effects
    that are not to be considered.  Raises CalibrationError for wrong input.
    """
    began = time.perf_counter()
    robot = robot if isinstance(robot, Robot) else load_robot(robot)
    given = data if isinstance(data, Measurements) else read_measurements(data)
    for name in exclude:
        if name not in EFFECTS:
            raise OptionError(f"no effect {name!r} to leave out; choose {', '.join(EFFECTS)}")
    checks.check_joints(robot, given)
    checks.check_spread(given)
    with threadpool_limits(limits=1, user_api="blas"):  # more would wait for each other, and longer
        return examined(robot, given, seed, holdout, exclude, progress, began)


def examined(
    robot: Robot,
    given: Measurements,
    seed: int,
    holdout: float,
    exclude: Sequence[str],
    progress: Progress,
    began: float,
) -> Diagnosis:
    """The diagnosis of checked measurements.  began: when the work did [s]."""
    progress("data faults")
    raw = with_history(given)
    sound, faults, remarks, fits = cleaned(robot, raw, seed, holdout, progress)
    train, held, notices = split(sound, holdout, seed)
    if not held.poses:
        raise DataError(
            f"{given.source}: no pose is held out; a diagnosis needs some that no fit has seen"
        )
    study = studied(robot, train, fits or fit_cell(robot, train, SUM, progress))
    progress("effects")
    library, choice = chosen(study, exclude)
    read_back = read_back_fault(study, choice)
    if read_back:  # what is left of a move looks like play in the gears
        library, choice = chosen(study, (*exclude, "backlash"))
    progress("what remains")
    traces = structure(study.scene, study.rows, choice.noise, choice.known)
    if choice.noise.variance < selection.EXACT**2:
        traces = (Trace("rounding", 1.0, 0.0),)
    order = by_weight(study, choice)
    effects = merged([finding(study, choice, i) for i in order])
    progress("gap ladder")
    wrong = [*faults, *read_back]
    steps, cells, raw_error = ladder(robot, raw, study, held, wrong, effects, seed, holdout)
    floor, source = noise_floor(study.rows, choice.noise, sound, cells[-1], steps[-1].train)
    findings = with_shares([*fault_findings(wrong), *effects], steps, floor)
    closed, interval = closed_share(raw_error, cells[-1].error(held), floor, seed)
    verdict, rest = judged(findings, traces, explained(study, choice))
    noise = float(np.sqrt(choice.noise.variance))
    if verdict == "none" and source == REPEATS and shaky(floor, noise, steps[-1].holdout.rms_mm):
        verdict = "not_repeatable"
    lies = located(study)
    notices = (*given.notices, *notices, *remarks, *study.fit.notices)
    settings = {"seed": seed, "holdout": holdout, "exclude": list(exclude)}
    return Diagnosis(
        robot=robot.name,
        status=study.fit.status,
        verdict=verdict,
        reasons=reasons(verdict, steps, floor, findings, closed, interval, rest),
        findings=tuple(findings),
        ladder=steps,
        floor=floor,
        floor_from=source,
        closed=closed,
        closed_ci=interval,
        blocked=blocked(study, sound, cells[-1]),
        noise=noise,
        jitter=choice.noise.jitter,
        structure=rest[1],
        structure_in=rest[0],
        where=lies.to_dict(),
        not_testable=library.untestable,
        notices=notices,
        provenance=Provenance.of(robot, given, settings),
        seconds=time.perf_counter() - began,
        data=sound,
        held=np.isin(sound.line, held.line),
        cells=tuple(cells),
        maps=lies.turn,
    )


def located(study: Study) -> Where:
    """Where the geometric errors of the training poses lie."""
    state = study.fit.state
    base = np.eye(4)
    base[:3, :3], base[:3, 3] = state.rotation, state.origin
    return where(
        study.data,
        study.model.error(state),
        study.scene.jacobian,
        base,
        float("nan"),
        fitted=study.model.jacobian(state)[..., study.fit.identification.active],
        up=study.robot.up,
    )


# ---- data faults -------------------------------------------------------------------------------


def cleaned(
    robot: Robot, data: Measurements, seed: int, holdout: float, progress: Progress
) -> tuple[Measurements, list[Fault], tuple[str, ...], Fit | None]:
    """The data with rows and points put right or left out, the faults, and remarks.

    Rows of the faults are lines of the file.  Also the geometric fit of the training poses, where
    it is that of the clean data.
    """
    rows, source = misplaced(robot, data)
    faults: list[Fault] = []
    if len(rows):
        lines = ", ".join(str(data.line[row]) for row in rows[:8])
        text = f"{data.source}: rows hold each other's points: lines {lines}"
        none = np.zeros(0, dtype=int)
        faults.append(Fault("swapped_rows", "all", data.line[rows], none, (), text))
        data = put_right(data, rows, source)
    found = find_faults(data)
    faults += in_lines(data, found, "swapped_rows", "outliers")
    data = mended(data, found)
    check_plausible(robot, data)
    train, _, _ = split(data, holdout, seed)
    progress("geometry")
    fit = fit_cell(robot, train, SUM, progress)
    error = Cell.of(robot, fit.state, data.target_names).error(data)
    more = tuple(fault for fault in find_faults(data, error) if fault.effect == "outliers")
    faults += in_lines(data, more, "outliers")
    data = mended(data, more)
    data = data.take(np.asarray(data.seen.any(axis=1)))
    remarks = tuple(fault.text for fault in (*found, *more) if fault.effect != "target_shift")
    return data, faults, remarks, None if more else fit


def in_lines(data: Measurements, faults: Sequence[Fault], *effects: str) -> list[Fault]:
    """Faults of some kinds, their rows as lines of the file."""
    return [replace(f, rows=data.line[f.rows]) for f in faults if f.effect in effects]


def chosen(study: Study, exclude: Sequence[str]) -> tuple[Library, Choice]:
    """The library and what it explains."""
    library = selection.library(study.scene, study.rows, exclude)
    return library, selection.select(library, ripple="gear_ripple" not in exclude)


def read_back_fault(study: Study, choice: Choice) -> list[Fault]:
    """A fault if the joint values look read back before the arm had settled.

    Asked of what the effects leave: a joint that always lacks the same part of its move settles.
    """
    effects = {c.term.effect for c in choice.chosen}
    if not effects & {"backlash", "settling"}:
        return []
    rest = rest_of(study.rows, choice.noise, choice.known)
    error = np.moveaxis(study.rows.back(rest.rows / rest.root), -1, 1)
    error = np.where(study.model.seen[..., None], error, np.nan)
    error = error @ study.fit.state.rotation.T
    push = np.einsum("ab,nkbm->kman", study.fit.state.rotation, study.scene.jacobian)
    found = looks_read_back(study.data, error, push * study.robot.sign)
    return in_lines(study.data, found, "readback")


def fault_findings(faults: Sequence[Fault]) -> list[Finding]:
    """Faults as entries of the list of effects, those of a kind together."""
    out = []
    for effect in dict.fromkeys(fault.effect for fault in faults):
        same = [fault for fault in faults if fault.effect == effect]
        places = {fault.place for fault in same}
        amounts = [amount for fault in same for amount in fault.parameters]
        out.append(
            Finding(
                terms=(Term(effect, places.pop() if len(places) == 1 else "all"),),
                names=tuple(a.name for a in amounts),
                units=tuple(a.unit for a in amounts),
                values=tuple(a.value for a in amounts),
                sigmas=tuple(a.sigma for a in amounts),
                size=float("nan"),
                p_value=float("nan"),
                rows=tuple(sorted({int(row) for fault in same for row in fault.rows})),
            )
        )
    return out


# ---- effects -----------------------------------------------------------------------------------


def by_weight(study: Study, choice: Choice) -> list[int]:
    """The effects in the order in which each takes most of what is left, points weighing alike."""
    rows, columns = study.rows, choice.library.columns
    fields = [columns[:, one.candidate.main] for one in choice.fits]
    fields = [field - rows.basis @ (rows.basis.T @ field) for field in fields]
    rest, order = rows.error, []
    waiting = list(range(len(fields)))
    taken = np.zeros((len(rest), 0))
    while waiting:
        left = []
        for i in waiting:
            basis = np.linalg.qr(np.concatenate([taken, fields[i]], axis=1))[0]
            left.append(float(((rest - basis @ (basis.T @ rest)) ** 2).sum()))
        best = waiting.pop(int(np.argmin(left)))
        taken = np.concatenate([taken, fields[best]], axis=1)
        order.append(best)
    return order


def finding(study: Study, choice: Choice, number: int) -> Finding:
    """An effect with its rivals, and what would tell the nearest of them apart."""
    one, table = choice.fits[number], choice.benches[number]
    found = alternatives(table, one)
    advice = [""] * len(found)
    unclear = [i for i, (_, _, power) in enumerate(found) if power < ENOUGH][:ADVISED]
    if unclear:
        site = Site(study.scene, study.model, study.fit.state, choice.noise)
        others = [(f.candidate.term, f.value) for f in choice.fits if f is not one]
        for i in unclear:
            rival = found[i][0].candidate.term
            advice[i] = separate_with(site, one.candidate.term, one.value, rival, others)
    columns = one.candidate.term.columns(table.library.scene)
    size, _ = table.setting(one).likeness(one, one.candidate)
    return Finding(
        terms=(one.candidate.term,),
        names=columns.names,
        units=columns.units,
        values=tuple(float(v) for v in one.value),
        sigmas=tuple(float(v) for v in one.sigma),
        size=size,
        p_value=table.p_value(one),
        alternatives=tuple(
            Alternative(
                other.candidate.term.effect,
                other.candidate.term.place,
                rho2,
                power,
                one.evidence - other.evidence,
                text,
            )
            for (other, rho2, power), text in zip(found, advice, strict=True)
        ),
        fixed=columns.fixed,
    )


def merged(findings: Sequence[Finding]) -> list[Finding]:
    """Lines of one joint are one effect: their parameters together, the strongest first."""
    out: dict[tuple[str, str], Finding] = {}
    for found in findings:
        key = (found.term.effect, found.term.place)
        if found.term.effect == "gear_ripple":
            turns = found.fixed["waves_per_turn"]
            names = tuple(f"{name} {turns:.4g}/turn" for name in found.names)
            found = replace(found, names=names, fixed={f"waves_per_turn {turns:.4g}": turns})
        if key not in out:
            out[key] = found
            continue
        first = out[key]
        others = {(a.effect, a.place): a for a in (*first.alternatives, *found.alternatives)}
        out[key] = replace(
            first,
            terms=(*first.terms, *found.terms),
            names=(*first.names, *found.names),
            units=(*first.units, *found.units),
            values=(*first.values, *found.values),
            sigmas=(*first.sigmas, *found.sigmas),
            size=first.size + found.size,
            p_value=max(first.p_value, found.p_value),
            alternatives=tuple(others.values()),
            fixed={**first.fixed, **found.fixed},
        )
    return list(out.values())


def judged(
    findings: Sequence[Finding], traces: Sequence[Trace], explained: float
) -> tuple[str, tuple[str, float]]:
    """The verdict; where what remains has structure, and the probability of that by chance.

    explained: weighed square that the effects explain; structure far below it is of no account.
    """
    worst = min(traces, key=lambda trace: trace.p)
    p = min(1.0, worst.p * len(traces))
    loud = [t for t in traces if t.p * len(traces) < LEVEL and t.excess > MATTERS * explained]
    if loud:
        return "unknown", (min(loud, key=lambda t: t.p).name, p)
    if patched(findings):
        return "unknown", ("two laws for one joint may stand for one that is not known", p)
    if not findings:
        return "none", (worst.name, p)
    several = any(found.alternatives for found in findings)
    return ("one_of" if several else "named"), (worst.name, p)


def shaky(floor: float, noise: float, error: float) -> bool:
    """Whether what is left is mostly that the arm does not come back to the same place.

    floor: RMS between repeated poses [mm].  noise: of the instrument per coordinate [m].
    error: held-out RMS [mm].
    """
    return floor > SHAKY * 1e3 * np.sqrt(3.0) * noise and floor > error / SHAKY


def explained(study: Study, choice: Choice) -> float:
    """Weighed square that the effects explain."""
    none = np.zeros((len(study.rows.error), 0))
    without, left = (
        rest_of(study.rows, choice.noise, known).total for known in (none, choice.known)
    )
    return without - left


def patched(findings: Sequence[Finding]) -> bool:
    """Whether one joint needs two laws of its own angle: likely one law that is not known."""
    by_angle = [f.term for f in findings if f.term.effect in OF_ANGLE]
    joints = [t.place for t in by_angle if t.place != "all"]
    twice = len(set(joints)) < len(joints)
    return twice or (bool(joints) and any(t.place == "all" for t in by_angle))


# ---- how far -----------------------------------------------------------------------------------


def ladder(
    robot: Robot,
    raw: Measurements,
    study: Study,
    held: Measurements,
    faults: Sequence[Fault],
    effects: Sequence[Finding],
    seed: int,
    holdout: float,
) -> tuple[tuple[Step, ...], list[Cell], Array]:
    """Accuracy with the nominal robot, with geometry, and with each effect.

    Also the cells from geometry on, and the geometric errors of the held-out poses (k, m, 3) [m].
    Faults in the data come first: what they do to a fit and to its judgement.
    """
    steps, train = [], study.data
    real = [fault for fault in faults if fault.effect != "readback"]
    nominal, geometric = study.nominal, study.geometric
    error = geometric.error(held)
    if real:
        first, rest, _ = split(raw, holdout, seed)
        fit = fit_cell(robot, first, SUM, silent)
        wrong = Cell.of(robot, fit.state, raw.target_names)
        start = Cell.of(robot, fit.nominal, raw.target_names)
        steps.append(Step("nominal", accuracy(start.error(first)), accuracy(start.error(rest))))
        steps.append(Step("geometric", accuracy(wrong.error(first)), accuracy(wrong.error(rest))))
        error = wrong.error(rest)
        names = " and ".join(dict.fromkeys(fault.effect for fault in real))
        name = f"without {names}"
    else:
        steps.append(Step("nominal", accuracy(nominal.error(train)), accuracy(nominal.error(held))))
        name = "geometric"
    steps.append(Step(name, accuracy(geometric.error(train)), accuracy(geometric.error(held))))
    cells = [geometric]
    terms: list[Term] = []
    for found in effects:
        terms += found.terms
        cell = study.cell(train, terms)
        label = f"+ {found.term.effect} {found.term.place}"
        steps.append(Step(label, accuracy(cell.error(train)), accuracy(cell.error(held))))
        cells.append(cell)
    return tuple(steps), cells, error


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
    terms, values = cell.effects.terms, np.concatenate([np.zeros(0), *cell.effects.values])
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


def resemblance(
    robot: Robot | str | Path, data: Measurements | str | Path, displacement: Array, seed: int = 0
) -> dict[tuple[str, str], float]:
    """rho^2 between a known displacement and every effect that the data can test.

    displacement: (k, m, 3) of the points of all rows in the measurement frame [m].  Both are seen
    by the training poses, after projection on what geometry cannot imitate.  For studies.
    """
    robot = robot if isinstance(robot, Robot) else load_robot(robot)
    data = with_history(data if isinstance(data, Measurements) else read_measurements(data))
    train, _, _ = split(data, 0.2, seed)
    study = studied(robot, train, fit_cell(robot, train, SUM, silent))
    rows = np.isin(data.line, train.line)
    moved = np.einsum("ab,kma->kbm", study.fit.state.rotation, displacement[:, rows])
    return resemblances(selection.library(study.scene, study.rows), moved)
