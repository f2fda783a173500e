"""A result, or its file, as the arm that it describes: a calibration, a diagnosis, a relative one.

Each is a row of rungs, from the nominal arm on.  Results of rooms below this one come as what they
write, so that a result and its file say the same.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import numpy as np

from minimax_cal.core.arrays import Array
from minimax_cal.core.errors import CalibrationError, DataError, OptionError
from minimax_cal.core.files import read_saved_result_json
from minimax_cal.core.record_parsing import (
    WRITE_AGAIN_ADVICE,
    parse_record,
    raise_read_errors_as_calibration_error,
)
from minimax_cal.fitting.fit import Fit
from minimax_cal.fitting.joint_spans import JointSpan, measure_joint_spans
from minimax_cal.fitting.options import Options, read_options, split_names
from minimax_cal.fitting.pose_records import parse_measured_poses
from minimax_cal.fitting.region_holdout import RegionHoldout
from minimax_cal.fitting.session_frames import MIN_FRAME_POINTS, fit_rigid_motion
from minimax_cal.fitting.uncertainty import Uncertainty
from minimax_cal.measuring.measurement_checks import check_and_complete_joints
from minimax_cal.measuring.measurements import Measurements
from minimax_cal.measuring.session_frames import session_labels
from minimax_cal.measuring.visit_history import add_history_columns
from minimax_cal.modelling.cell import Cell, cell_from_dict
from minimax_cal.modelling.effects.table import EFFECTS, Term
from minimax_cal.modelling.effects_in_model import extend_model_with_effects
from minimax_cal.modelling.global_start import fit_base_and_targets
from minimax_cal.modelling.nearby_fit import fit_within_bounds_from_start
from minimax_cal.modelling.point_model import build_point_model
from minimax_cal.robots.robot import Robot, robot_from_dict
from minimax_cal.solvers.status import Status

RELATIVE_CALIBRATION_KIND = "relative calibration"  # kind of a file
PLACING_PASSES = 2  # of a fit with effects: the second takes finite turns into account
NOMINAL, CALIBRATED, GEOMETRIC = "nominal", "calibrated", "geometric"
NO_JOINT_VALUES = np.zeros((0, 0))
NO_MEASUREMENTS = Measurements(
    NO_JOINT_VALUES, np.zeros((0, 0, 3)), (), np.zeros(0, dtype=bool), np.zeros(0), {}
)


@runtime_checkable
class SavableResult(Protocol):
    """A result that tells all of itself."""

    def to_dict(self) -> dict[str, Any]:
        """As its file."""


ResultOrFile = Fit | Cell | SavableResult | Path | str


@dataclass(frozen=True, eq=False)
class ArmStep:
    """A state of the arm.

    error: (m, k, 3) of its poses as the file tells them [m], None where it does not.
    """

    name: str
    cell: Cell
    error: Array | None = None


@dataclass(frozen=True, eq=False)
class OpenedResult:
    """One rung of a result, and what the result tells besides.

    number: of the rung.  placed: whether base and targets are known; lengths tell neither.
    data: its poses, none where it holds none; held: (m,) True where held out.  digest: SHA-256 of
    the measurements.  uncertainty: of the last rung of a calibration.  spans: how far each joint
    went in the training poses, none where the file does not tell.
    options: how it was fitted, None where its poses do not tell its links.  fit: the calibration.
    outside: the claim of the last rung.  possible: effects, as texts, that a diagnosis has not
    confirmed; none where its rung was chosen.  geometric: the last rung fitted without effects,
    where the file tells it.
    """

    source: str
    rungs: tuple[ArmStep, ...]
    number: int
    data: Measurements = NO_MEASUREMENTS
    held: Array = field(default_factory=lambda: np.zeros(0, dtype=bool))
    digest: str = ""
    uncertainty: Uncertainty | None = None
    placed: bool = True
    status: Status | None = None
    spans: tuple[JointSpan, ...] = ()
    options: Options | None = None
    fit: Fit | None = None
    outside: Callable[[], RegionHoldout] = RegionHoldout
    possible: frozenset[str] = frozenset()
    geometric: Cell | None = None

    @property
    def cell(self) -> Cell:
        """The arm of the rung."""
        return self.rungs[self.number].cell

    @property
    def nominal(self) -> Cell | None:
        """The arm before calibration, where the result tells it."""
        return self.rungs[0].cell if self.rungs[0].name == NOMINAL else None

    @property
    def train(self) -> Measurements:
        """The training poses."""
        return self.data.take(~self.held)

    def place_on_data(
        self, data: Measurements, new_frame: bool = False
    ) -> tuple[Cell, Cell | None, tuple[str, ...]]:
        """The arm and the nominal one with base and targets that fit data best; a notice.

        As they are where the result knows its place.  new_frame: measured from elsewhere, so that
        base and instrument are placed by the data.  Raises CalibrationError.
        """
        if self.placed and new_frame:
            return (
                place_in_new_frame(self.cell, data),
                place_in_new_frame(self.nominal, data) if self.nominal else None,
                (f"{data.source}: the frame is placed by these points: six numbers are fitted",),
            )
        if self.placed:
            return self.cell, self.nominal, ()
        before = place_nominal_arm(self.nominal.robot, data) if self.nominal else None
        said = f"{self.source}: knows no base and no targets: both are fitted to {data.source}"
        return place_unplaced_cell(self.cell, data), before, (said,)


def place_in_new_frame(cell: Cell, data: Measurements) -> Cell:
    """A cell as an instrument sees it that stands elsewhere; base and targets stay together.

    Raises DataError for several sessions, and for fewer than three points.
    """
    data = check_and_complete_joints(cell.robot, data)
    if len(np.unique(session_labels(data))) > 1:
        raise DataError(f"{data.source}: holds several sessions; evaluate them one by one")
    alone = replace(cell, sessions=replace(cell.sessions, frames={}))
    error = alone.error(data)
    here = data.y[data.seen]
    if len(here) < MIN_FRAME_POINTS:
        raise DataError(f"{data.source}: {len(here)} points do not place a frame; measure more")
    there = here - error[data.seen]  # where the calibration's instrument would see them
    return replace(alone, base=fit_rigid_motion(there, here) @ cell.base)


def place_nominal_arm(robot: Robot, data: Measurements) -> Cell:
    """An arm where it fits all poses best.  Raises DataError."""
    data = check_and_complete_joints(robot, data)
    return Cell.from_parameters(
        robot,
        fit_base_and_targets(build_point_model(robot, data), robot.mdh).state,
        data.target_names,
    )


def place_unplaced_cell(cell: Cell, data: Measurements) -> Cell:
    """A cell whose base and targets are not known where it fits all poses best, effects included.

    Raises DataError.
    """
    found, terms = place_nominal_arm(cell.robot, data), cell.effects.terms
    if not terms:
        return found
    data = add_history_columns(check_and_complete_joints(cell.robot, data))
    model, state = (
        build_point_model(cell.robot, data),
        replace(found.parameter_values, effects=cell.parameter_values.effects),
    )
    free = np.arange(model.names.parameter_count) >= 5 * model.names.joints
    for _ in range(PLACING_PASSES):
        bent, begin = extend_model_with_effects(model, cell.robot, data, state, terms)
        alone = bent.with_active(np.pad(free, (0, len(state.effects))))
        state = fit_within_bounds_from_start(alone, begin).x.take(np.array(0))
    return Cell.from_parameters(cell.robot, state, data.target_names, cell.effects, cell.sessions)


def open_result(source: ResultOrFile | OpenedResult, step_name: int | None = None) -> OpenedResult:
    """A result, or its file, at one of its rungs.

    source: a calibration, a diagnosis, a relative calibration, a cell, or a file of one.
    step_name: 0 nominal, 1 geometric (or calibrated), 2 ... with each effect of a diagnosis; the
    last unless given.  Raises CalibrationError.
    """
    if isinstance(source, OpenedResult):
        found = source
    elif isinstance(source, Fit):
        found = open_fit(source, source.cell.robot.name)
    elif isinstance(source, Cell):
        found = OpenedResult(source.robot.name, (ArmStep(CALIBRATED, source),), 0)
    elif isinstance(source, Path | str):
        found = open_json_content(read_saved_result_json(source), str(source))
    else:
        content = source.to_dict()
        found = open_json_content(content, str(content.get("kind", "result")))
    return found if step_name is None else select_step(found, step_name)


def select_step(opened: OpenedResult, step: int) -> OpenedResult:
    """The same result at another rung.  Raises OptionError."""
    if not 0 <= step < len(opened.rungs):
        names = ", ".join(f"{i} ({rung.name})" for i, rung in enumerate(opened.rungs))
        raise OptionError(f"{opened.source}: has no step {step}; it has {names}")
    whole = opened.uncertainty if step == len(opened.rungs) - 1 else None
    return replace(opened, number=step, uncertainty=whole, possible=frozenset())


def open_json_content(content: Mapping[str, Any], source: str) -> OpenedResult:
    """From the JSON of a result, by its kind.  Raises CalibrationError."""
    kind = content.get("kind", "calibration")
    if kind == "diagnosis":
        with raise_read_errors_as_calibration_error(source):
            return open_diagnosis(content, source)
    if kind == RELATIVE_CALIBRATION_KIND:
        return open_relative_calibration(content, source)
    if {"parameters", "accuracy", "provenance"} <= set(content):
        return open_fit(Fit.from_dict(content, source), source)
    return OpenedResult(source, (ArmStep(CALIBRATED, cell_from_dict(content, source)),), 0)


def open_fit(fit: Fit, source: str) -> OpenedResult:
    """A calibration: nominal and calibrated."""
    rungs = (
        ArmStep(NOMINAL, fit.nominal, fit.error_nominal),
        ArmStep(CALIBRATED, fit.cell, fit.error),
    )
    fitted = bool(fit.data.poses) and not fit.is_after_check
    options = fit.options if fitted else None
    return OpenedResult(
        source, rungs, 1, fit.data, fit.held, fit.provenance.data_sha256, fit.uncertainty,
        status=fit.status, spans=fit.spans, options=options, fit=fit, outside=lambda: fit.beyond,
    )  # fmt: skip


def open_relative_calibration(content: Mapping[str, Any], source: str) -> OpenedResult:
    """A calibration without coordinates: the robots alone, in the base that both share."""

    def bare(key: str) -> Cell:
        robot = robot_from_dict(content.get(key, {}), f"{source}: {key}")
        return Cell(robot, np.eye(4), (), np.zeros((0, 3)))

    calibrated = "calibrated_robot" if "calibrated_robot" in content else "robot"
    alone = bare(calibrated)
    whole = cell_from_dict(content["cell"], f"{source}: cell") if content.get("cell") else alone
    rungs = (ArmStep(NOMINAL, bare("nominal_robot")), ArmStep(CALIBRATED, whole))
    status = Status(content["status"]) if "status" in content else None
    known = whole.effects.cause_terms
    firm = (
        {term.text for term in read_confirmed_effects(content, source)}
        if "diagnosis" in content
        else None
    )
    possible = frozenset(term.text for term in known) - firm if firm is not None else frozenset()
    digest = str(content.get("provenance", {}).get("data_sha256", ""))
    return OpenedResult(
        source, rungs, 1, digest=digest, placed=False, status=status, geometric=alone,
        possible=possible,
    )  # fmt: skip


def open_diagnosis(content: Mapping[str, Any], source: str) -> OpenedResult:
    """A diagnosis: nominal, geometric, then with each effect."""
    rungs = read_diagnosis_steps(content, source)
    first = rungs[0].cell
    data, held, (geometric, final) = parse_measured_poses(content, source, first, "geometric")
    told = {GEOMETRIC: geometric, rungs[-1].name: final} if data.poses else {}
    rungs = tuple(ArmStep(r.name, r.cell, told.get(r.name)) for r in rungs)
    digest = str(content["provenance"]["data_sha256"])
    status = Status(content["status"])
    spans = measure_joint_spans(first.robot, data.take(~held)) if data.poses else ()
    settings = content["provenance"]["settings"]
    known = rungs[-1].cell.effects.cause_terms
    firm = {term.text for term in select_confirmed_effects(content, known)}
    beyond = parse_record(RegionHoldout, content["gap"]["beyond"], "gap.beyond")
    return OpenedResult(
        source, rungs, len(rungs) - 1, data, held, digest, status=status, spans=spans,
        options=read_options(settings, objective="sum") if data.poses else None,
        outside=lambda: beyond,
        possible=frozenset(term.text for term in known) - firm,
    )  # fmt: skip


def read_diagnosis_steps(content: Mapping[str, Any], source: str) -> tuple[ArmStep, ...]:
    """The rungs of a diagnosis' JSON.  Raises CalibrationError, or one of `FILE_CONTENT_ERRORS`."""
    listed = content.get("rungs")
    if not listed:
        raise CalibrationError(f"{source}: holds no arm; {WRITE_AGAIN_ADVICE}")
    return tuple(
        ArmStep(str(each["name"]), cell_from_dict(each, f"{source}: rungs[{i}]"))
        for i, each in enumerate(listed)
    )


# ---- the effects of a diagnosis, for a fit -----------------------------------------------------


def read_effect_list(effects: object) -> tuple[str | Term, ...]:
    """Effects by name, as terms, or those that a diagnosis (or its file) has established.

    Raises CalibrationError.
    """
    several = split_names(effects) if isinstance(effects, Sequence) else (effects,)
    out: list[str | Term] = []
    for each in several:
        if isinstance(each, Term) or (isinstance(each, str) and not each.endswith(".json")):
            out.append(each)
        elif isinstance(each, Path | str):
            out += read_confirmed_effects(read_saved_result_json(each), str(each))
        elif isinstance(each, SavableResult):
            out += read_confirmed_effects(each.to_dict(), "the diagnosis")
        else:
            raise OptionError(f"effects {each!r}: name them, or give a diagnosis")
    return tuple(out)


def read_confirmed_effects(content: Mapping[str, Any], source: str) -> list[Term]:
    """The effects that a diagnosis holds for established, with the variants that it chose.

    Raises CalibrationError.
    """
    if content.get("kind") == RELATIVE_CALIBRATION_KIND and "diagnosis" in content:
        with raise_read_errors_as_calibration_error(source):
            cell = content.get("cell")
            terms = cell_from_dict(cell, f"{source}: cell").effects.cause_terms if cell else ()
            return select_confirmed_effects(content["diagnosis"], terms)
    if content.get("kind") != "diagnosis":
        raise OptionError(f"{source}: is no diagnosis, so that it names no effects")
    with raise_read_errors_as_calibration_error(source):
        return select_confirmed_effects(
            content, read_diagnosis_steps(content, source)[-1].cell.effects.terms
        )


def select_confirmed_effects(
    content: Mapping[str, Any], fitted_terms: Sequence[Term]
) -> list[Term]:
    """The established effects of a diagnosis' JSON.  fitted_terms: those fitted, with their
    variants.
    """
    found = [
        (str(effect["effect"]), str(effect["place"]))
        for effect in content["effects"]
        if effect["established"]
        and effect["effect"] in EFFECTS
        and not effect["lines"]  # a fault of the data
    ]
    return [
        term for key in found for term in [t for t in fitted_terms if t.key == key] or [Term(*key)]
    ]
