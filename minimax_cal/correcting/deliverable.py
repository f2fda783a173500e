"""What leaves the house: a file, or corrected targets, with a fit and figures of its own.

A geometry that was fitted together with effects is right only together with them.  What carries
none of them, or some, is therefore fitted again for exactly what it carries.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from minimax_cal.correcting.exporters.job import Export, job_of
from minimax_cal.correcting.exporters.table import EXPORTERS, FORMATS, export
from minimax_cal.fitting.accuracy import Accuracy, accuracy
from minimax_cal.fitting.calibrate import fit_split
from minimax_cal.fitting.fit import Fit
from minimax_cal.fitting.opened import GEOMETRIC, Opened, Result, open_result
from minimax_cal.fitting.options import OFFSETS, Progress, silent
from minimax_cal.ground.errors import CalibrationError, OptionError
from minimax_cal.ground.files import finite
from minimax_cal.measuring.history import with_history
from minimax_cal.measuring.measurements import Measurements
from minimax_cal.modelling.cell import Cell
from minimax_cal.modelling.effects.table import EFFECTS, Term
from minimax_cal.modelling.effects.words import name_kinds
from minimax_cal.modelling.reach import flange_terms
from minimax_cal.solvers.status import Status

COMPENSATED = "compensate"  # targets corrected by `compensate`, which are no file of a robot
DELIVERABLES: dict[str, Callable[[Cell], tuple[Term, ...]]] = {
    **{name: exporter.carries for name, exporter in EXPORTERS.items()},
    COMPENSATED: flange_terms,
}
PARTS = {"": "geometry", OFFSETS: "joint offsets"}  # of the links, by `Options.only`


@dataclass(frozen=True)
class Figures:
    """How well an arm predicts points that no fit saw [mm], NaN where that is not known.

    rms, largest: on held-out poses, inside the measured region.  typical, worst: RMS outside it, of
    all parts that were left out and of the worst; furthest: largest error there.
    """

    rms: float = math.nan
    largest: float = math.nan
    typical: float = math.nan
    worst: float = math.nan
    furthest: float = math.nan

    @staticmethod
    def of(fit: Fit, crossed: bool = True) -> Figures:
        """Of a calibration.  crossed: where it was cross-validated, by that."""
        inside, outside = fit.accuracy["holdout"], fit.beyond
        if crossed and fit.error_crossed.size:
            inside = fit.within.after
        rms, largest = (inside.rms_mm, inside.max_mm) if inside.poses else (math.nan, math.nan)
        return Figures(rms, largest, outside.typical_mm, outside.worst_mm, outside.largest_mm)

    @staticmethod
    def at_rung(known: Opened) -> Figures:
        """Of the rung of a result."""
        last, rung = known.number == len(known.rungs) - 1, known.rungs[known.number]
        if known.fit and last:
            return Figures.of(known.fit)
        away = known.outside()
        outside = (math.nan,) * 3
        if last:
            outside = away.typical_mm, away.worst_mm, away.largest_mm
        elif rung.name == GEOMETRIC:
            outside = away.geometric_typical_mm, away.geometric_worst_mm, math.nan
        if not known.held.any():
            return Figures(math.nan, math.nan, *outside)
        seen = known.data.take(known.held)
        error = rung.error[known.held] if rung.error is not None else None
        inside = accuracy(known.cell.error(with_history(seen)) if error is None else error)
        return Figures(inside.rms_mm, inside.max_mm, *outside)

    def sentence(self) -> str:
        """For people; that nothing is known where that is so."""
        said = []
        if not math.isnan(self.rms):
            said.append(f"held-out RMS {self.rms:.3f} mm, largest {self.largest:.3f} mm")
        if not math.isnan(self.typical):
            far = "" if math.isnan(self.furthest) else f", largest {self.furthest:.3f} mm"
            said.append(
                f"outside the measured region RMS {self.typical:.3f} mm, worst region "
                f"{self.worst:.3f} mm RMS{far}"
            )
        return "; ".join(said) or "not known"


@dataclass(frozen=True, eq=False)
class Delivered:
    """What a file, or corrected targets, hold of a result, and how well that does by itself.

    format: of `export`, or compensate.  part: of the geometry that it holds, in words; rest: what
    it does not hold beside effects, empty for nothing.  carries, not_carried: effects, as
    joint_compliance:all.  cell: the arm as fitted for exactly that.
    nominal: before the calibration, None where the result does not tell it.  figures: its own;
    whole: those of the full model.  fit: the calibration that `cell` is of, None where there is
    none.  reason: why it was not fitted again though it does not hold all; else empty.  unmade: why
    the file cannot be made; else empty.
    missed: the held-out poses by the formulas of the fit and by the file, where they may differ.
    """

    format: str
    part: str
    carries: tuple[str, ...]
    not_carried: tuple[str, ...]
    cell: Cell
    nominal: Cell | None
    figures: Figures
    whole: Figures
    fit: Fit | None = None
    rest: str = ""
    reason: str = ""
    unmade: str = ""
    missed: tuple[Accuracy, Accuracy] | None = None

    def rms_of_file(self, size: float) -> float:
        """Of a file, where that of its fit is some size [mm]."""
        if self.missed is None:
            return size
        before, after = (one.rms_mm**2 for one in self.missed)
        return math.sqrt(max(size**2 + after - before, 0.0))

    def largest_of_file(self, size: float) -> float:
        """The same for a largest error."""
        return size + self.missed[1].max_mm - self.missed[0].max_mm if self.missed else size

    @property
    def holds(self) -> str:
        """What it holds, in words."""
        return (
            f"{self.part} and {name_kinds(self.carries)}" if self.carries else f"{self.part} alone"
        )

    @property
    def lacks(self) -> str:
        """What of the full model it does not hold, in words; empty where it holds all."""
        return ", ".join(filter(None, (self.rest, name_kinds(self.not_carried))))

    def to_dict(self) -> dict[str, Any]:
        """For JSON."""
        return block(self.format, self.carries, self.not_carried, self.figures)

    def sentence(self) -> str:
        """What it holds and how well it does, beside the full model."""
        if self.unmade:
            return f"{self.format} cannot be made: {self.unmade}"
        if self.reason:
            return (
                f"{self.format} does not hold {self.lacks}, and how well the rest does without is "
                f"not known: {self.reason}; give a calibration with its measurements"
            )
        own = f"{self.format} holds {self.holds}: {self.figures.sentence()}"
        if not self.lacks:
            return own
        return f"{own} (fitted without {self.lacks}; the full model: {self.whole.sentence()})"


def block(
    to: str,
    carries: Sequence[str] = (),
    not_carried: Sequence[str] = (),
    figures: Figures = Figures(),
) -> dict[str, Any]:
    """`delivered` in JSON; of a bare robot nothing is known."""
    return {
        "format": to,
        "carries": list(carries),
        "not_carried": list(not_carried),
        "holdout_rms_mm": finite(figures.rms),
        "outside_typical_mm": finite(figures.typical),
        "outside_worst_mm": finite(figures.worst),
        "outside_largest_mm": finite(figures.furthest),
    }


def deliver(
    fit: Result,
    to: str,
    *,
    rung: int | None = None,
    clock: float | None = None,
    progress: Progress = silent,
) -> Delivered:
    """What a format of `export`, or `compensate`, holds of a result, fitted for exactly that.

    Parameters
    ----------
    fit
        A calibration, its cell, a diagnosis (of which the confirmed effects count), a
        relative calibration, or the file of one.
    to
        A format of `export`, or compensate.
    rung
        Of a diagnosis, with all effects up to it.
    clock
        The moment of the measurements' session, 0 to 1, that corrected targets are for;
        without it what follows that session's time is not corrected.
    progress
        Called with a word on each stage.

    Returns
    -------
    Delivered
        The result as the format holds it, with its own accuracy. Data, objective, losses,
        priors, fixed parameters and held-out poses are those of the result.

    Raises
    ------
    CalibrationError
        For wrong input.

    Examples
    --------
    >>> mc.deliver(fit, "urdf").to_dict()
    """
    check_format(to)
    known = open_result(fit, rung)
    made = delivered(known, to, clock, progress)
    if not (to in EXPORTERS and EXPORTERS[to].simulated and known.held.any()):
        return made
    job = job_of(known.source, made.cell, made.nominal, known.train.q)
    return as_written(made, known, EXPORTERS[to].write(job))


def deliver_or_explain(fit: Result, to: str, rung: int | None = None) -> Delivered:
    """As `deliver`; where the file cannot be made, what says why.

    Raises OptionError for a format that does not exist.
    """
    check_format(to)
    try:
        made = deliver(fit, to, rung=rung)
        if to in FORMATS and not EXPORTERS[to].simulated:  # that of a simulator was written already
            export(job_of(made.format, made.cell, made.nominal), to)
        return made
    except (CalibrationError, np.linalg.LinAlgError) as error:
        known = open_result(fit, rung)
        whole, why = Figures.at_rung(known), " ".join(str(error).split()).removeprefix(f"{to}: ")
        return Delivered(
            to, PARTS[""], (), (), known.cell, known.nominal, Figures(), whole, unmade=why
        )


def check_format(to: str) -> None:
    """Raise OptionError for a deliverable that does not exist."""
    if to not in DELIVERABLES:
        raise OptionError(f"{to}: no such format; choose one of {', '.join(DELIVERABLES)}")


def check_kept(known: Opened, keep_anyway: bool) -> None:
    """Raise OptionError for a calibrated arm beside which the drawn one is kept."""
    if known.status and known.status.keeps_drawn and known.number and not keep_anyway:
        raise kept_back(known.source, known.status)


def kept_back(source: str, status: Status) -> OptionError:
    """What is said where the drawn arm should be kept."""
    return OptionError(
        f"{source}: {status}: {status.advice}; with keep_anyway=True the calibrated one is taken "
        "all the same"
    )


def kept(
    known: Opened,
    to: str,
    keep_anyway: bool,
    clock: float | None = None,
    *,
    torques: bool = False,
) -> Delivered:
    """As `deliver`; OptionError where the arm, or what of it is delivered, is no better than drawn.

    keep_anyway: deliver it all the same.  torques: whether they are measured where it is used.
    """
    check_kept(known, keep_anyway)
    found = delivered(known, to, clock, torques=torques)
    if found.fit is not None and found.fit.status.keeps_drawn and not keep_anyway:
        raise kept_back(f"{known.source}: {to}, without {found.lacks}", found.fit.status)
    return found


def delivered(
    known: Opened,
    to: str,
    clock: float | None = None,
    progress: Progress = silent,
    *,
    torques: bool = False,
) -> Delivered:
    """As `deliver`, of an opened result.  torques: whether they are measured where it is used."""
    if known.status is Status.FAILED:
        raise OptionError(f"{known.source}: {Status.FAILED}: {Status.FAILED.advice}")
    cell, whole = known.cell, Figures.at_rung(known)
    only = EXPORTERS[to].only if to in EXPORTERS and known.number else ""
    held = carried(known, to, clock)
    data = known.data if torques else without_torques(known)
    lost = tuple(term for term in cell.effects.causes if term not in held)
    own = known.fit if known.number else None
    made = Delivered(
        to, PARTS[only], labels(held), labels(lost), cell, known.nominal, whole, whole, own
    )
    if only and not (known.options and known.options.only == only):
        made = replace(made, rest="the rest of the geometry")
    elif data is not known.data:
        made = replace(made, rest="the measured torques")
    if not made.lacks:
        return made
    if known.options is None or known.nominal is None:
        return as_it_is(made, known)
    options, robot = known.options, known.nominal.robot
    crossed = known.fit is not None  # judged as the full model was
    if only:  # what was freed beside the offsets is fixed now
        options = replace(options, only=only, free=())

    def refit(effects: tuple[Term, ...]) -> tuple[Fit, Figures]:
        own = replace(options, effects=effects)
        fit = fit_split(robot, data, known.held, own, progress)
        return fit, Figures.of(fit, crossed)

    fit, figures = refit(held)
    light = tuple(term for term in held if EFFECTS[term.effect].follows != "load")
    if data is not known.data and light != held:  # gravity alone may not explain them
        other = refit(light)
        if not figures.rms < other[1].rms:
            held, (fit, figures) = light, other
            lost = tuple(term for term in cell.effects.causes if term not in held)
            made = replace(made, carries=labels(held), not_carried=labels(lost))
    if fit.status is Status.FAILED:
        raise OptionError(
            f"{known.source}: {to}: without {made.lacks} the fit is {fit.status}; "
            f"{fit.status.advice}"
        )
    # of geometry alone the digits are those that the result's own file holds
    placed = known.fit.geometric if known.fit and not (held or only) else fit.cell
    return replace(made, cell=placed, nominal=fit.nominal, figures=figures, fit=fit)


def as_written(made: Delivered, known: Opened, file: Export) -> Delivered:
    """The same with the figures of the file: its own, where it stands off the formulas."""
    if file.off is None or math.isnan(made.figures.rms):
        return made
    rows = with_history(without_torques(known)).take(known.held)
    error = made.cell.error(rows)
    found = replace(made, missed=(accuracy(error), accuracy(error + file.off(rows))))
    own, rms = made.figures, found.rms_of_file
    figures = Figures(rms(own.rms), found.largest_of_file(own.largest), rms(own.typical),
                      rms(own.worst), found.largest_of_file(own.furthest))  # fmt: skip
    return replace(found, figures=figures)


def without_torques(known: Opened) -> Measurements:
    """The poses of a result; where its effects use torques measured there, without these.

    A file's arm, and targets, have those of gravity alone.
    """
    columns = {n: c for n, c in known.data.columns.items() if not n.startswith("tau")}
    if len(columns) == len(known.data.columns) or not known.cell.effects.causes:
        return known.data
    plain = replace(known.data, columns=columns)
    one, other = (known.cell.error(with_history(data)) for data in (known.data, plain))
    return known.data if np.array_equal(one, other, equal_nan=True) else plain


def held_by(to: str, cell: Cell) -> tuple[Term, ...]:
    """The effects of a cell that a deliverable holds, with those that are past: it is as of now."""
    own = DELIVERABLES[to](cell)
    return tuple(t for t in cell.effects.causes if t in own or EFFECTS[t.effect].of_past)


def carried(known: Opened, to: str, clock: float | None) -> tuple[Term, ...]:
    """The effects of a result that a deliverable holds.

    Those of one session end with it: its time, where its nests, its instrument and its frame were.
    """
    cell = known.cell
    held = held_by(to, cell)
    timed = clock is not None and to == COMPENSATED
    return tuple(
        term
        for term in cell.effects.causes
        if term in held
        and term.text not in known.possible
        and (not term.ends_with_session or (timed and term.by_clock))
    )


def as_it_is(made: Delivered, known: Opened) -> Delivered:
    """What a result holds that cannot be fitted again: its own geometry, or its arm whole."""
    held = held_by(made.format, made.cell)
    lost = tuple(term for term in made.cell.effects.causes if term not in held)
    why = f"{known.source} holds no measurements"
    if known.data.poses:
        why = f"{known.source} does not tell its nominal robot"
        if known.nominal:
            why = f"{known.source} was placed by a check, on poses too few for a fit"
    alone = made.cell
    if known.number and not held:  # else it would be right only together with its effects
        alone = known.fit.geometric if known.fit else known.geometric or alone
    return replace(
        made, carries=labels(held), not_carried=labels(lost), cell=alone, figures=Figures(),
        fit=None, reason=why if lost or made.rest else "",
    )  # fmt: skip


def labels(terms: Sequence[Term]) -> tuple[str, ...]:
    """As joint_compliance:all, each once."""
    return tuple(dict.fromkeys(term.label for term in terms))
