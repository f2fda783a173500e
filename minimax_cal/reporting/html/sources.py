"""What a report is made of: a calibration, a diagnosis, or both; or a relative calibration."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from minimax_cal.diagnosing.instruments_result import RelativeDiagnosis
from minimax_cal.diagnosing.result import Diagnosis
from minimax_cal.dynamics.result import MotionDiagnosis
from minimax_cal.fitting.fit import Fit, Provenance
from minimax_cal.fitting.opened import RELATIVE
from minimax_cal.fitting.pose_rows import comes_back
from minimax_cal.fitting.several.result import RelativeCalibration, read_result
from minimax_cal.ground.arrays import Array
from minimax_cal.ground.errors import CalibrationError
from minimax_cal.ground.files import json_of, read_raw
from minimax_cal.ground.records import AGAIN
from minimax_cal.ground.words import visible
from minimax_cal.measuring.history import numbered, visits, with_history
from minimax_cal.measuring.measurements import Measurements
from minimax_cal.modelling.cell import Cell
from minimax_cal.simulators.result import MotionGap, SimulatorGap

Result = (
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
class Poses:
    """Measured poses with their errors before and after.

    held: (m,) True where held out.  before, after: (m, k, 3) measured minus predicted, NaN where
    not measured [mm].  told: whether the file told the visit order.
    """

    data: Measurements
    held: Array
    before: Array
    after: Array

    @property
    def told(self) -> bool:
        """Whether the measurements told the visit order."""
        return numbered(self.data)

    @property
    def visit(self) -> Array:
        """(m,) when each pose was visited, 1 first; its row where nobody told."""
        place = np.empty(self.data.poses)
        place[visits(self.data)] = np.arange(1, self.data.poses + 1)
        return place


@dataclass(frozen=True)
class File:
    """Where a result came from.  digest: SHA-256."""

    kind: str
    path: str
    digest: str


@dataclass(frozen=True, eq=False)
class Sources:
    """A calibration, a diagnosis, or both, and the arm in a simulator; or a relative calibration.

    causes: the diagnosis of a relative calibration, where its file holds one.
    notices: what the reader should know of both.
    """

    fit: Fit | None
    gap: Diagnosis | None
    files: tuple[File, ...] = ()
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
    def poses(self) -> Poses | None:
        """Of the calibration, or else of the diagnosis; None where the file has none."""
        fit, gap = self.fit, self.gap
        if fit and fit.data.poses:
            return Poses(fit.data, fit.held, 1e3 * fit.error_nominal, 1e3 * fit.error)
        if gap and gap.data.poses:
            before, after = gap.errors
            return Poses(gap.data, gap.held, 1e3 * before, 1e3 * after)
        return None

    @cached_property
    def turned(self) -> tuple[Measurements, Array] | None:
        """The poses, and how far all effects turn each joint there: (m, n), 0 of a slide [rad].

        None where none turns one, or the file does not tell.
        """
        cell, poses = self.cell, self.poses
        if not (cell and poses and cell.effects.terms):
            return None
        if not comes_back(cell.error(poses.data), 1e-3 * poses.after):
            return None
        turn = np.abs(cell.effects.turn(cell.scene(with_history(poses.data))))
        turn[:, poses.data.sliding] = 0.0
        return (poses.data, turn) if turn.any() else None

    @property
    def cell(self) -> Cell | None:
        """The arm to draw; None without points in space."""
        if self.fit:
            return self.fit.cell
        return self.gap.cells[-1] if self.gap and self.gap.cells else None


def named(sources: Sources) -> list[tuple[str, Fit | Diagnosis | RelativeCalibration]]:
    """The results with what they are."""
    every = (("calibration", sources.fit), ("diagnosis", sources.gap), (RELATIVE, sources.relative))
    return [(kind, result) for kind, result in every if result]


def read_sources(results: Sequence[Result]) -> Sources:
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
        content, path, digest = content_of(result)
        kind = content.get("kind", "calibration" if "parameters" in content else "")
        if kind == RELATIVE:
            if len(results) > 1:
                raise CalibrationError(f"{path}: is a {RELATIVE}; report it alone")
            return without_coordinates(content, File(kind, path, digest))
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
                f"{path}: is neither a calibration nor a diagnosis; {AGAIN} calibrate or diagnose"
            )
        files.append(File(kind, path, digest))
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
    notices = [*together(fit, gap, files), *simulated(arm, fit, gap)]
    motion = moving[0] if moving else None
    return Sources(fit, gap, tuple(files), tuple(notices), arm, motion=motion)


def without_coordinates(content: dict[str, Any], file: File) -> Sources:
    """A relative calibration, and its diagnosis where the file holds one."""
    if "diagnosis" in content:
        causes = RelativeDiagnosis.from_dict(content, file.path)
        return Sources(None, None, (file,), relative=causes.calibration, causes=causes)
    return Sources(None, None, (file,), relative=read_result(content, file.path))


def simulated(arm: SimulatorGap | None, fit: Fit | None, gap: Diagnosis | None) -> tuple[str, ...]:
    """What to know of a gap in a simulator beside results: its arm goes by the model's name."""
    known = {part.provenance.data_sha256 for part in (fit, gap) if part}
    if arm is None or arm.provenance.data_sha256 in known:
        return ()
    robots = {name for name in (fit and fit.cell.robot.name, gap and gap.robot) if name}
    other = "" if arm.robot in robots else (
        f", and of {arm.robot}, not of {' and '.join(sorted(robots))}: is it the same arm?"
    )  # fmt: skip
    return (f"The gap in the simulator is of other measurements than the rest{other or '.'}",)


def content_of(result: Result) -> tuple[dict[str, Any], str, str]:
    """JSON, name and SHA-256 of a result, every text visible."""
    if isinstance(result, Path | str):
        content, digest = read_json(result)
        return content, str(result), digest
    text = result.json()
    content = clean(json.loads(text))
    digest = hashlib.sha256(text.encode("utf-8")).hexdigest()
    return content, f"{content['kind']}, not saved", digest


def together(fit: Fit | None, gap: Diagnosis | None, files: Sequence[File]) -> tuple[str, ...]:
    """What to know of two results, of the same measurements.  Raises CalibrationError if not."""
    if not (fit and gap):
        return ()
    out, one, other = [], fit.provenance, gap.provenance
    if one.data_sha256 != other.data_sha256:
        named = " and ".join(file.path for file in files) or "the calibration and the diagnosis"
        raise CalibrationError(
            f"{named} are of different measurements (SHA-256 "
            f"{one.data_sha256[:12] or 'none'} and {other.data_sha256[:12] or 'none'}); "
            "make both from one file"
        )
    if not one.data_sha256:
        out.append("Neither file tells the SHA-256 of its measurements: they may differ.")
    if fit.cell.robot.name != gap.robot:
        out.append(f"The calibration is of {fit.cell.robot.name}, the diagnosis of {gap.robot}.")
    lines = [{int(x) for x in result.data.line[result.held]} for result in (fit, gap)]
    if fit.data.poses and gap.data.poses and lines[0] != lines[1]:
        out.append(
            "Calibration and diagnosis held out different poses: their numbers do not compare "
            "exactly."
        )
    return tuple(out)


def read_json(path: Path | str) -> tuple[dict[str, Any], str]:
    """A JSON object with its text cleaned, and the SHA-256 of the file."""
    raw = read_raw(path)
    try:
        content = clean(json_of(raw))
    except (ValueError, RecursionError) as error:
        raise CalibrationError(f"{path}: is not JSON ({error})") from error
    if not isinstance(content, dict):
        raise CalibrationError(f"{path}: is neither a calibration nor a diagnosis")
    return content, hashlib.sha256(raw).hexdigest()


def clean(value: Any) -> Any:
    """The same with every text visible: `visible`."""
    if isinstance(value, str):
        return visible(value)
    if isinstance(value, list):
        return [clean(part) for part in value]
    if isinstance(value, dict):
        return {visible(key): clean(part) for key, part in value.items()}
    return value
