"""What a report is made of: a calibration, a diagnosis, or both; or a relative calibration."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from minimax_cal.core.arrays import Array
from minimax_cal.core.display_text import replace_invisible_and_bidi_characters
from minimax_cal.core.errors import CalibrationError
from minimax_cal.core.files import parse_json, read_bytes
from minimax_cal.core.record_parsing import WRITE_AGAIN_ADVICE
from minimax_cal.diagnosing.diagnosis import Diagnosis
from minimax_cal.diagnosing.instruments_result import RelativeDiagnosis
from minimax_cal.dynamics.result import MotionDiagnosis
from minimax_cal.fitting.fit import Fit, Provenance
from minimax_cal.fitting.multi_instrument.relative_result import RelativeCalibration, read_result
from minimax_cal.fitting.opened_results import RELATIVE_CALIBRATION_KIND
from minimax_cal.fitting.pose_records import are_errors_reproduced
from minimax_cal.measuring.measurements import Measurements
from minimax_cal.measuring.visit_history import (
    add_history_columns,
    has_order_numbers,
    rows_in_visit_order,
)
from minimax_cal.modelling.cell import Cell
from minimax_cal.simulators.result import MotionGap, SimulatorGap

ReportableResult = (
    Fit
    | Diagnosis
    | RelativeCalibration
    | RelativeDiagnosis
    | SimulatorGap
    | MotionDiagnosis
    | MotionGap
    | Path
    | str
)


@dataclass(frozen=True, eq=False)
class PosesWithErrors:
    """Measured poses with their errors before and after.

    held: (m,) True where held out.  before, after: (m, k, 3) measured minus predicted, NaN where
    not measured [mm].  has_visit_order: whether the file told the visit order.
    """

    data: Measurements
    held: Array
    before: Array
    after: Array

    @property
    def has_visit_order(self) -> bool:
        """Whether the measurements told the visit order."""
        return has_order_numbers(self.data)

    @property
    def visit_numbers(self) -> Array:
        """(m,) when each pose was visited, 1 first; its row where nobody told."""
        place = np.empty(self.data.poses)
        place[rows_in_visit_order(self.data)] = np.arange(1, self.data.poses + 1)
        return place


@dataclass(frozen=True)
class ResultFile:
    """Where a result came from.  digest: SHA-256."""

    kind: str
    path: str
    digest: str


class JointRotations(NamedTuple):
    """How far all effects turn each joint: rotations (m, n) at the poses [rad]."""

    measurements: Measurements
    rotations: Array


class NamedResult(NamedTuple):
    """A result and its kind."""

    kind: str
    result: Fit | Diagnosis | RelativeCalibration


class ResultContent(NamedTuple):
    """JSON of a result, the name of its file, and its SHA-256."""

    content: dict[str, Any]
    name: str
    sha256: str


@dataclass(frozen=True, eq=False)
class ReportSources:
    """A calibration, a diagnosis, or both, and the arm in a simulator; or a relative calibration.

    causes: the diagnosis of a relative calibration, where its file holds one.
    notices: what the reader should know of both.
    """

    fit: Fit | None
    gap: Diagnosis | None
    files: tuple[ResultFile, ...] = ()
    notices: tuple[str, ...] = ()
    simulator: SimulatorGap | None = None
    relative: RelativeCalibration | None = None
    causes: RelativeDiagnosis | None = None
    motion: MotionGap | None = None

    @property
    def results(self) -> tuple[Fit | Diagnosis, ...]:
        """Those of measured points that there are."""
        return tuple(result for result in (self.fit, self.gap) if result)

    @property
    def robot(self) -> str:
        """Name of the robot."""
        if self.fit:
            return self.fit.cell.robot.name
        if self.relative:
            return self.relative.robot.name
        return self.gap.robot if self.gap else ""

    @property
    def provenance(self) -> Provenance:
        """Of the calibration, or else of the diagnosis."""
        return (self.relative or self.results[0]).provenance

    @property
    def poses(self) -> PosesWithErrors | None:
        """Of the calibration, or else of the diagnosis; None where the file has none."""
        fit, gap = self.fit, self.gap
        if fit and fit.data.poses:
            return PosesWithErrors(fit.data, fit.held, 1e3 * fit.error_nominal, 1e3 * fit.error)
        if gap and gap.data.poses:
            before, after = gap.errors
            return PosesWithErrors(gap.data, gap.held, 1e3 * before, 1e3 * after)
        return None

    @cached_property
    def joint_rotations_by_effects(self) -> JointRotations | None:
        """The poses, and how far all effects turn each joint there: (m, n), 0 of a slide [rad].

        None where none turns one, or the file does not tell.
        """
        cell, poses = self.cell, self.poses
        if not (cell and poses and cell.effects.terms):
            return None
        if not are_errors_reproduced(cell.error(poses.data), 1e-3 * poses.after):
            return None
        turn = np.abs(cell.effects.joint_shifts(cell.pose_arm(add_history_columns(poses.data))))
        turn[:, poses.data.sliding] = 0.0
        return JointRotations(poses.data, turn) if turn.any() else None

    @property
    def cell(self) -> Cell | None:
        """The arm to draw; None without points in space."""
        if self.fit:
            return self.fit.cell
        return self.gap.cells[-1] if self.gap and self.gap.cells else None


def list_named_results(
    sources: ReportSources,
) -> list[NamedResult]:
    """The results with what they are."""
    every = (
        ("calibration", sources.fit),
        ("diagnosis", sources.gap),
        (RELATIVE_CALIBRATION_KIND, sources.relative),
    )
    return [NamedResult(kind, result) for kind, result in every if result]


def read_report_sources(results: Sequence[ReportableResult]) -> ReportSources:
    """One or two results, each itself or its file, and a gap in a simulator.

    Raises CalibrationError.
    """
    if not 1 <= len(results) <= 3:
        raise CalibrationError(f"a report takes one to three files, not {len(results)}")
    fits: list[Fit] = []
    gaps: list[Diagnosis] = []
    arms: list[SimulatorGap] = []
    moving: list[MotionGap] = []
    files = []
    for result in results:
        content, path, digest = read_result_content(result)
        kind = content.get("kind", "calibration" if "parameters" in content else "")
        if kind == RELATIVE_CALIBRATION_KIND:
            if len(results) > 1:
                raise CalibrationError(f"{path}: is a {RELATIVE_CALIBRATION_KIND}; report it alone")
            return read_relative_sources(content, ResultFile(kind, path, digest))
        if kind == "calibration" and "parameters" in content:
            fits.append(Fit.from_dict(content, path))
        elif kind == "diagnosis":
            gaps.append(Diagnosis.from_dict(content, path))
        elif kind == MotionGap.KIND and "along" in content:
            moving.append(MotionGap.from_dict(content, path))
        elif kind == SimulatorGap.KIND:
            arms.append(SimulatorGap.from_dict(content, path))
        else:
            raise CalibrationError(
                f"{path}: is neither a calibration nor a diagnosis; "
                f"{WRITE_AGAIN_ADVICE} calibrate or diagnose"
            )
        files.append(ResultFile(kind, path, digest))
    for kind, other, count in (
        ("calibration", "diagnosis", len(fits)),
        ("diagnosis", "calibration", len(gaps)),
    ):
        if count > 1:
            raise CalibrationError(f"{path}: is a second {kind}; give one and one {other}")
    if len(arms) > 1 or len(moving) > 1 or not (fits or gaps):
        raise CalibrationError(
            f"{path}: a report is of a calibration or a diagnosis: give one as well, and at most "
            "one gap in a simulator"
        )
    files.sort(key=lambda file: file.kind)
    fit, gap = fits[0] if fits else None, gaps[0] if gaps else None
    arm = arms[0] if arms else None
    notices = [
        *check_results_belong_together(fit, gap, files),
        *warn_of_unrelated_simulator_gap(arm, fit, gap),
    ]
    motion = moving[0] if moving else None
    return ReportSources(fit, gap, tuple(files), tuple(notices), arm, motion=motion)


def read_relative_sources(content: dict[str, Any], file: ResultFile) -> ReportSources:
    """A relative calibration, and its diagnosis where the file holds one."""
    if "diagnosis" in content:
        causes = RelativeDiagnosis.from_dict(content, file.path)
        return ReportSources(None, None, (file,), relative=causes.calibration, causes=causes)
    return ReportSources(None, None, (file,), relative=read_result(content, file.path))


def warn_of_unrelated_simulator_gap(
    simulator_gap: SimulatorGap | None, fit: Fit | None, diagnosis: Diagnosis | None
) -> tuple[str, ...]:
    """What to know of a gap in a simulator beside results: its arm goes by the model's name."""
    known = {part.provenance.data_sha256 for part in (fit, diagnosis) if part}
    if simulator_gap is None or simulator_gap.provenance.data_sha256 in known:
        return ()
    robots = {name for name in (fit and fit.cell.robot.name, diagnosis and diagnosis.robot) if name}
    other = (
        ""
        if simulator_gap.robot in robots
        else (
            f", and of {simulator_gap.robot}, not of "
            f"{' and '.join(sorted(robots))}: is it the same arm?"
        )
    )
    return (f"The gap in the simulator is of other measurements than the rest{other or '.'}",)


def read_result_content(result: ReportableResult) -> ResultContent:
    """JSON, name and SHA-256 of a result, every text visible."""
    if isinstance(result, Path | str):
        return read_json_object(result)
    text = result.json()
    content = replace_control_characters_in_json(json.loads(text))
    digest = hashlib.sha256(text.encode("utf-8")).hexdigest()
    return ResultContent(content, f"{content['kind']}, not saved", digest)


def check_results_belong_together(
    fit: Fit | None, diagnosis: Diagnosis | None, files: Sequence[ResultFile]
) -> tuple[str, ...]:
    """What to know of two results, of the same measurements.  Raises CalibrationError if not."""
    if not (fit and diagnosis):
        return ()
    out, one, other = [], fit.provenance, diagnosis.provenance
    if one.data_sha256 != other.data_sha256:
        named = " and ".join(file.path for file in files) or "the calibration and the diagnosis"
        raise CalibrationError(
            f"{named} are of different measurements (SHA-256 "
            f"{one.data_sha256[:12] or 'none'} and {other.data_sha256[:12] or 'none'}); "
            "make both from one file"
        )
    if not one.data_sha256:
        out.append("Neither file tells the SHA-256 of its measurements: they may differ.")
    if fit.cell.robot.name != diagnosis.robot:
        out.append(
            f"The calibration is of {fit.cell.robot.name}, the diagnosis of {diagnosis.robot}."
        )
    lines = [{int(x) for x in result.data.line[result.held]} for result in (fit, diagnosis)]
    if fit.data.poses and diagnosis.data.poses and lines[0] != lines[1]:
        out.append(
            "Calibration and diagnosis held out different poses: their numbers do not compare "
            "exactly."
        )
    return tuple(out)


def read_json_object(path: Path | str) -> ResultContent:
    """A JSON object with its text cleaned, and the SHA-256 of the file."""
    raw = read_bytes(path)
    try:
        content = replace_control_characters_in_json(parse_json(raw))
    except (ValueError, RecursionError) as error:
        raise CalibrationError(f"{path}: is not JSON ({error})") from error
    if not isinstance(content, dict):
        raise CalibrationError(f"{path}: is neither a calibration nor a diagnosis")
    return ResultContent(content, str(path), hashlib.sha256(raw).hexdigest())


def replace_control_characters_in_json(value: Any) -> Any:
    """The same with every text visible: `replace_invisible_and_bidi_characters`."""
    if isinstance(value, str):
        return replace_invisible_and_bidi_characters(value)
    if isinstance(value, list):
        return [replace_control_characters_in_json(part) for part in value]
    if isinstance(value, dict):
        return {
            replace_invisible_and_bidi_characters(key): replace_control_characters_in_json(part)
            for key, part in value.items()
        }
    return value
