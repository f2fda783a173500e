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

from minimax_cal.compensation.exporters.export_formats import (
    DOCUMENTED_EXPORT_FORMATS,
    EXPORTERS,
    build_exported_file,
)
from minimax_cal.compensation.exporters.export_job import ExportedFile, build_export_job
from minimax_cal.core.errors import CalibrationError, OptionError
from minimax_cal.core.files import finite_or_none
from minimax_cal.fitting.accuracy import Accuracy, summarise_point_errors
from minimax_cal.fitting.calibrate import fit_held_split
from minimax_cal.fitting.fit import Fit
from minimax_cal.fitting.opened_results import GEOMETRIC, OpenedResult, ResultOrFile, open_result
from minimax_cal.fitting.options import ONLY_OFFSETS, Progress, silent_progress
from minimax_cal.measuring.measurements import Measurements
from minimax_cal.measuring.visit_history import add_history_columns
from minimax_cal.modelling.cell import Cell
from minimax_cal.modelling.effects.effect_names import format_effect_kinds
from minimax_cal.modelling.effects.table import EFFECTS, Term
from minimax_cal.modelling.inverse_with_effects import flange_terms
from minimax_cal.solvers.status import Status

COMPENSATED_TARGETS = (
    "compensate"  # targets corrected by `compensate`, which are no file of a robot
)
DELIVERABLES: dict[str, Callable[[Cell], tuple[Term, ...]]] = {
    **{name: exporter.carries for name, exporter in EXPORTERS.items()},
    COMPENSATED_TARGETS: flange_terms,
}
GEOMETRY_PART_NAMES = {
    "": "geometry",
    ONLY_OFFSETS: "joint offsets",
}  # of the links, by `Options.only`


@dataclass(frozen=True)
class AccuracyFigures:
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
    def from_fit(fit: Fit, prefer_cross_validation: bool = True) -> AccuracyFigures:
        """Of a calibration.  prefer_cross_validation: where it was cross-validated, by that."""
        inside, outside = fit.accuracy["holdout"], fit.beyond
        if prefer_cross_validation and fit.error_crossed.size:
            inside = fit.within.after
        rms, largest = (inside.rms_mm, inside.max_mm) if inside.poses else (math.nan, math.nan)
        return AccuracyFigures(
            rms, largest, outside.typical_mm, outside.worst_mm, outside.largest_mm
        )

    @staticmethod
    def from_heldout_poses_of_step(opened_result: OpenedResult) -> AccuracyFigures:
        """Of the rung of a result."""
        last, rung = (
            opened_result.number == len(opened_result.rungs) - 1,
            opened_result.rungs[opened_result.number],
        )
        if opened_result.fit and last:
            return AccuracyFigures.from_fit(opened_result.fit)
        away = opened_result.outside()
        outside = (math.nan,) * 3
        if last:
            outside = away.typical_mm, away.worst_mm, away.largest_mm
        elif rung.name == GEOMETRIC:
            outside = away.geometric_typical_mm, away.geometric_worst_mm, math.nan
        if not opened_result.held.any():
            return AccuracyFigures(math.nan, math.nan, *outside)
        seen = opened_result.data.take(opened_result.held)
        error = rung.error[opened_result.held] if rung.error is not None else None
        inside = summarise_point_errors(
            opened_result.cell.error(add_history_columns(seen)) if error is None else error
        )
        return AccuracyFigures(inside.rms_mm, inside.max_mm, *outside)

    def describe(self) -> str:
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

    format: of `build_exported_file`, or compensate.  part: of the geometry that it holds, in words;
    rest: what it does not hold beside effects, empty for nothing.  carries, not_carried: effects,
    as joint_compliance:all.  cell: the arm as fitted for exactly that. nominal: before the
    calibration, None where the result does not tell it.  figures: its own; whole: those of the full
    model.  fit: the calibration that `cell` is of, None where there is none.  reason: why it was
    not fitted again though it does not hold all; else empty.  unmade: why the file cannot be made;
    else empty. missed: the held-out poses by the formulas of the fit and by the file, where they
    may differ.
    """

    format: str
    part: str
    carries: tuple[str, ...]
    not_carried: tuple[str, ...]
    cell: Cell
    nominal: Cell | None
    figures: AccuracyFigures
    whole: AccuracyFigures
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
            f"{self.part} and {format_effect_kinds(self.carries)}"
            if self.carries
            else f"{self.part} alone"
        )

    @property
    def lacks(self) -> str:
        """What of the full model it does not hold, in words; empty where it holds all."""
        return ", ".join(filter(None, (self.rest, format_effect_kinds(self.not_carried))))

    def to_dict(self) -> dict[str, Any]:
        """For JSON."""
        return build_delivered_json(self.format, self.carries, self.not_carried, self.figures)

    def sentence(self) -> str:
        """What it holds and how well it does, beside the full model."""
        if self.unmade:
            return f"{self.format} cannot be made: {self.unmade}"
        if self.reason:
            return (
                f"{self.format} does not hold {self.lacks}, and how well the rest does without is "
                f"not known: {self.reason}; give a calibration with its measurements"
            )
        own = f"{self.format} holds {self.holds}: {self.figures.describe()}"
        if not self.lacks:
            return own
        return f"{own} (fitted without {self.lacks}; the full model: {self.whole.describe()})"


def build_delivered_json(
    format_name: str,
    carries: Sequence[str] = (),
    not_carried: Sequence[str] = (),
    figures: AccuracyFigures = AccuracyFigures(),
) -> dict[str, Any]:
    """`fit_deliverable` in JSON; of a bare robot nothing is known."""
    return {
        "format": format_name,
        "carries": list(carries),
        "not_carried": list(not_carried),
        "holdout_rms_mm": finite_or_none(figures.rms),
        "outside_typical_mm": finite_or_none(figures.typical),
        "outside_worst_mm": finite_or_none(figures.worst),
        "outside_largest_mm": finite_or_none(figures.furthest),
    }


def deliver(
    fit: ResultOrFile,
    to: str,
    *,
    rung: int | None = None,
    clock: float | None = None,
    progress: Progress = silent_progress,
) -> Delivered:
    """What a format of `build_exported_file`, or `compensate`, holds of a result, fitted for
    exactly that.

    Parameters
    ----------
    fit
        A calibration, its cell, a diagnosis (of which the confirmed effects count), a
        relative calibration, or the file of one.
    to
        A format of `build_exported_file`, or compensate.
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
    check_deliverable_format(to)
    known = open_result(fit, rung)
    made = fit_deliverable(known, to, clock, progress)
    if not (to in EXPORTERS and EXPORTERS[to].simulated and known.held.any()):
        return made
    job = build_export_job(known.source, made.cell, made.nominal, known.train.q)
    return with_figures_of_file(made, known, EXPORTERS[to].write(job))


def deliver_or_describe_failure(
    fit: ResultOrFile, format_name: str, step_number: int | None = None
) -> Delivered:
    """As `deliver`; where the file cannot be made, what says why.

    Raises OptionError for a format that does not exist.
    """
    check_deliverable_format(format_name)
    try:
        made = deliver(fit, format_name, rung=step_number)
        if (
            format_name in DOCUMENTED_EXPORT_FORMATS and not EXPORTERS[format_name].simulated
        ):  # that of a simulator was written already
            build_exported_file(build_export_job(made.format, made.cell, made.nominal), format_name)
        return made
    except (CalibrationError, np.linalg.LinAlgError) as error:
        known = open_result(fit, step_number)
        whole, why = (
            AccuracyFigures.from_heldout_poses_of_step(known),
            " ".join(str(error).split()).removeprefix(f"{format_name}: "),
        )
        return Delivered(
            format_name,
            GEOMETRY_PART_NAMES[""],
            (),
            (),
            known.cell,
            known.nominal,
            AccuracyFigures(),
            whole,
            unmade=why,
        )


def check_deliverable_format(format_name: str) -> None:
    """Raise OptionError for a deliverable that does not exist."""
    if format_name not in DELIVERABLES:
        raise OptionError(f"{format_name}: no such format; choose one of {', '.join(DELIVERABLES)}")


def check_calibrated_arm_is_better(opened_result: OpenedResult, keep_anyway: bool) -> None:
    """Raise OptionError for a calibrated arm beside which the drawn one is kept."""
    if (
        opened_result.status
        and opened_result.status.keeps_drawn
        and opened_result.number
        and not keep_anyway
    ):
        raise build_not_better_error(opened_result.source, opened_result.status)


def build_not_better_error(source: str, status: Status) -> OptionError:
    """What is said where the drawn arm should be kept."""
    return OptionError(
        f"{source}: {status}: {status.advice}; with keep_anyway=True the calibrated one is taken "
        "all the same"
    )


def deliver_if_better(
    opened_result: OpenedResult,
    format_name: str,
    keep_anyway: bool,
    session_moment: float | None = None,
    *,
    has_measured_torques: bool = False,
) -> Delivered:
    """As `deliver`; OptionError where the arm, or what of it is delivered, is no better than drawn.

    keep_anyway: deliver it all the same.  has_measured_torques: whether they are measured where it
    is used.
    """
    check_calibrated_arm_is_better(opened_result, keep_anyway)
    found = fit_deliverable(
        opened_result, format_name, session_moment, has_measured_torques=has_measured_torques
    )
    if found.fit is not None and found.fit.status.keeps_drawn and not keep_anyway:
        raise build_not_better_error(
            f"{opened_result.source}: {format_name}, without {found.lacks}", found.fit.status
        )
    return found


def fit_deliverable(
    opened_result: OpenedResult,
    format_name: str,
    session_moment: float | None = None,
    progress: Progress = silent_progress,
    *,
    has_measured_torques: bool = False,
) -> Delivered:
    """As `deliver`, of an opened result.  has_measured_torques: whether they are measured where it
    is used.
    """
    if opened_result.status is Status.FAILED:
        raise OptionError(f"{opened_result.source}: {Status.FAILED}: {Status.FAILED.advice}")
    cell, whole = opened_result.cell, AccuracyFigures.from_heldout_poses_of_step(opened_result)
    only = EXPORTERS[format_name].only if format_name in EXPORTERS and opened_result.number else ""
    held = list_effects_outliving_session(opened_result, format_name, session_moment)
    data = (
        opened_result.data
        if has_measured_torques
        else measurements_without_used_torques(opened_result)
    )
    lost = tuple(term for term in cell.effects.cause_terms if term not in held)
    own = opened_result.fit if opened_result.number else None
    made = Delivered(
        format_name,
        GEOMETRY_PART_NAMES[only],
        list_effect_labels(held),
        list_effect_labels(lost),
        cell,
        opened_result.nominal,
        whole,
        whole,
        own,
    )
    if only and not (opened_result.options and opened_result.options.only == only):
        made = replace(made, rest="the rest of the geometry")
    elif data is not opened_result.data:
        made = replace(made, rest="the measured torques")
    if not made.lacks:
        return made
    if opened_result.options is None or opened_result.nominal is None:
        return deliver_without_refit(made, opened_result)
    options, robot = opened_result.options, opened_result.nominal.robot
    crossed = opened_result.fit is not None  # judged as the full model was
    if only:  # what was freed beside the offsets is fixed now
        options = replace(options, only=only, free=())

    def refit(effects: tuple[Term, ...]) -> tuple[Fit, AccuracyFigures]:
        own = replace(options, effects=effects)
        fit = fit_held_split(robot, data, opened_result.held, own, progress)
        return fit, AccuracyFigures.from_fit(fit, crossed)

    fit, figures = refit(held)
    light = tuple(term for term in held if EFFECTS[term.effect].follows != "load")
    if data is not opened_result.data and light != held:  # gravity alone may not explain them
        other = refit(light)
        if not figures.rms < other[1].rms:
            held, (fit, figures) = light, other
            lost = tuple(term for term in cell.effects.cause_terms if term not in held)
            made = replace(
                made, carries=list_effect_labels(held), not_carried=list_effect_labels(lost)
            )
    if fit.status is Status.FAILED:
        raise OptionError(
            f"{opened_result.source}: {format_name}: without {made.lacks} the fit is {fit.status}; "
            f"{fit.status.advice}"
        )
    # of geometry alone the digits are those that the result's own file holds
    placed = opened_result.fit.geometric if opened_result.fit and not (held or only) else fit.cell
    return replace(made, cell=placed, nominal=fit.nominal, figures=figures, fit=fit)


def with_figures_of_file(
    delivered: Delivered, opened_result: OpenedResult, exported_file: ExportedFile
) -> Delivered:
    """The same with the figures of the exported file: its own, where it stands off the formulas."""
    if exported_file.point_deviations is None or math.isnan(delivered.figures.rms):
        return delivered
    rows = add_history_columns(measurements_without_used_torques(opened_result)).take(
        opened_result.held
    )
    error = delivered.cell.error(rows)
    found = replace(
        delivered,
        missed=(
            summarise_point_errors(error),
            summarise_point_errors(error + exported_file.point_deviations(rows)),
        ),
    )
    own, rms = delivered.figures, found.rms_of_file
    figures = AccuracyFigures(rms(own.rms), found.largest_of_file(own.largest), rms(own.typical),
                      rms(own.worst), found.largest_of_file(own.furthest))  # fmt: skip
    return replace(found, figures=figures)


def measurements_without_used_torques(opened_result: OpenedResult) -> Measurements:
    """The poses of a result; where its effects use torques measured there, without these.

    A file's arm, and targets, have those of gravity alone.
    """
    columns = {n: c for n, c in opened_result.data.columns.items() if not n.startswith("tau")}
    if (
        len(columns) == len(opened_result.data.columns)
        or not opened_result.cell.effects.cause_terms
    ):
        return opened_result.data
    plain = replace(opened_result.data, columns=columns)
    one, other = (
        opened_result.cell.error(add_history_columns(data)) for data in (opened_result.data, plain)
    )
    return opened_result.data if np.array_equal(one, other, equal_nan=True) else plain


def list_effects_held_by_format(format_name: str, cell: Cell) -> tuple[Term, ...]:
    """The effects of a cell that a deliverable holds, with those that are past: it is as of now."""
    own = DELIVERABLES[format_name](cell)
    return tuple(t for t in cell.effects.cause_terms if t in own or EFFECTS[t.effect].of_past)


def list_effects_outliving_session(
    opened_result: OpenedResult, format_name: str, session_moment: float | None
) -> tuple[Term, ...]:
    """The effects of a result that a deliverable holds.

    Those of one session end with it: its time, where its nests, its instrument and its frame were.
    """
    cell = opened_result.cell
    held = list_effects_held_by_format(format_name, cell)
    timed = session_moment is not None and format_name == COMPENSATED_TARGETS
    return tuple(
        term
        for term in cell.effects.cause_terms
        if term in held
        and term.text not in opened_result.possible
        and (not term.ends_with_session or (timed and term.follows_clock))
    )


def deliver_without_refit(delivered: Delivered, opened_result: OpenedResult) -> Delivered:
    """What a result holds that cannot be fitted again: its own geometry, or its arm whole."""
    held = list_effects_held_by_format(delivered.format, delivered.cell)
    lost = tuple(term for term in delivered.cell.effects.cause_terms if term not in held)
    why = f"{opened_result.source} holds no measurements"
    if opened_result.data.poses:
        why = f"{opened_result.source} does not tell its nominal robot"
        if opened_result.nominal:
            why = f"{opened_result.source} was placed by a check, on poses too few for a fit"
    alone = delivered.cell
    if opened_result.number and not held:  # else it would be right only together with its effects
        alone = (
            opened_result.fit.geometric if opened_result.fit else opened_result.geometric or alone
        )
    return replace(
        delivered,
        carries=list_effect_labels(held),
        not_carried=list_effect_labels(lost),
        cell=alone,
        figures=AccuracyFigures(),
        fit=None,
        reason=why if lost or delivered.rest else "",
    )


def list_effect_labels(terms: Sequence[Term]) -> tuple[str, ...]:
    """As joint_compliance:all, each once."""
    return tuple(dict.fromkeys(term.label for term in terms))
