"""The files that a report is made of, read and checked: a calibration, a diagnosis, or both."""

from __future__ import annotations

import hashlib
import json
import unicodedata
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from pydantic import ValidationError

from minimax_cal.ground.arrays import Array
from minimax_cal.ground.errors import CalibrationError
from minimax_cal.measuring.measurements import FARTHEST, Measurements
from minimax_cal.measuring.pose_rows import numbers, read_poses
from minimax_cal.modelling.cell import Cell, cell_from_dict
from minimax_cal.reporting.html.schema import FitFile, GapFile, Part
from minimax_cal.robots.robot import explain

Model = TypeVar("Model", bound=Part)

HIDDEN = ("Cc", "Cs", "LRE", "RLE", "LRO", "RLO", "PDF", "LRI", "RLI", "FSI", "PDI")
REPLACED = "\N{REPLACEMENT CHARACTER}"
AGAIN = "write it again with minimax-cal"
FAULTS = (KeyError, TypeError, ValueError, AttributeError, IndexError, OverflowError)
BEFORE = {"calibration": "nominal", "diagnosis": "geometric"}


@dataclass(frozen=True, eq=False)
class Poses:
    """Measured poses with their errors before and after.

    held: (m,) True where held out.  before, after: (k, m, 3) measured minus predicted, NaN where
    not measured [mm].  told: whether the file told the visit order.
    """

    data: Measurements
    held: Array
    before: Array
    after: Array
    told: bool


@dataclass(frozen=True, eq=False)
class Fit:
    """A calibration.  digest: SHA-256 of its file.

    nominal: the arm before, and poses: one of each, or none in an old file.
    """

    path: str
    digest: str
    content: FitFile
    cell: Cell
    nominal: tuple[Cell, ...]
    poses: tuple[Poses, ...]


@dataclass(frozen=True, eq=False)
class Diagnosed:
    """A diagnosis.  cells: geometric, then with the effects; as poses, none in an old file."""

    path: str
    digest: str
    content: GapFile
    cells: tuple[Cell, ...]
    poses: tuple[Poses, ...]


@dataclass(frozen=True, eq=False)
class Sources:
    """At most one calibration and one diagnosis.  notices: what the reader should know of both."""

    fits: tuple[Fit, ...] = ()
    gaps: tuple[Diagnosed, ...] = ()
    notices: tuple[str, ...] = ()

    @property
    def robot(self) -> str:
        """Name of the robot."""
        return self.fits[0].cell.robot.name if self.fits else self.gaps[0].content.robot

    @property
    def poses(self) -> tuple[Poses, ...]:
        """Of the calibration, or else of the diagnosis."""
        found = self.fits[0].poses if self.fits else ()
        return found or (self.gaps[0].poses if self.gaps else ())

    @property
    def cells(self) -> tuple[Cell, ...]:
        """The arm to draw; none in an old file."""
        return tuple(fit.cell for fit in self.fits) or self.gaps[0].cells[-1:]


def read_sources(paths: Sequence[Path | str]) -> Sources:
    """Read one or two result files.  Raises CalibrationError."""
    if not 1 <= len(paths) <= 2:
        raise CalibrationError(f"a report takes one or two files, not {len(paths)}")
    fits: list[Fit] = []
    gaps: list[Diagnosed] = []
    for path in paths:
        content, digest = read_json(path)
        kind = content.get("kind", "calibration" if "parameters" in content else "")
        if kind == "calibration" and "parameters" in content:
            fits.append(fit_of(content, str(path), digest))
        elif kind == "diagnosis":
            gaps.append(gap_of(content, str(path), digest))
        else:
            raise CalibrationError(
                f"{path}: is neither a calibration nor a diagnosis; {AGAIN} calibrate -o or "
                "diagnose -o"
            )
    for found, kind in ((fits, "calibration"), (gaps, "diagnosis")):
        if len(found) > 1:
            other = "diagnosis" if kind == "calibration" else "calibration"
            raise CalibrationError(f"{paths[1]}: is a second {kind}; give one and one {other}")
    return Sources(tuple(fits), tuple(gaps), together(fits, gaps))


def together(fits: Sequence[Fit], gaps: Sequence[Diagnosed]) -> tuple[str, ...]:
    """What to know of two files, of the same measurements.  Raises CalibrationError if not."""
    out = []
    for fit in fits:
        for gap in gaps:
            one, other = fit.content.provenance, gap.content.provenance
            if one.data_sha256 != other.data_sha256:
                raise CalibrationError(
                    f"{fit.path} and {gap.path} are of different measurements (SHA-256 "
                    f"{one.data_sha256[:12] or 'none'} and {other.data_sha256[:12] or 'none'}); "
                    "make both from one file"
                )
            if not one.data_sha256:
                out.append("Neither file tells the SHA-256 of its measurements: they may differ.")
            if fit.cell.robot.name != gap.content.robot:
                out.append(
                    f"The calibration is of {fit.cell.robot.name}, the diagnosis of "
                    f"{gap.content.robot}."
                )
            if differ(fit.poses, gap.poses):
                out.append(
                    "Calibration and diagnosis held out different poses: their numbers do not "
                    "compare exactly."
                )
    return tuple(out)


def differ(one: Sequence[Poses], other: Sequence[Poses]) -> bool:
    """Whether two results held out different lines of the file."""
    lines = [{int(x) for x in p.data.line[p.held]} for p in (*one, *other)]
    return len(lines) == 2 and lines[0] != lines[1]


def read_json(path: Path | str) -> tuple[dict[str, Any], str]:
    """A JSON object with its text cleaned, and the SHA-256 of the file."""
    try:
        raw = Path(path).read_bytes()
    except OSError as error:
        raise CalibrationError(f"{path}: cannot be read ({error.strerror})") from error
    try:
        content = clean(json.loads(raw, parse_constant=refuse))
    except (ValueError, RecursionError) as error:
        raise CalibrationError(f"{path}: is not JSON ({error})") from error
    if not isinstance(content, dict):
        raise CalibrationError(f"{path}: is neither a calibration nor a diagnosis")
    if content.get("schema", 1) != 1:
        raise CalibrationError(
            f"{path}: is of schema {content['schema']!r}, this version knows 1; update minimax-cal"
        )
    return content, hashlib.sha256(raw).hexdigest()


def refuse(constant: str) -> float:
    """NaN and Infinity are no JSON."""
    raise ValueError(f"{constant} is not a number that JSON knows")


def clean(value: Any) -> Any:
    """The same with every text visible: `visible`."""
    if isinstance(value, str):
        return visible(value)
    if isinstance(value, list):
        return [clean(part) for part in value]
    if isinstance(value, dict):
        return {visible(key): clean(part) for key, part in value.items()}
    return value


def visible(text: str) -> str:
    """Text without control characters, which could hide or reverse what a reader signs."""
    if text.isascii() and text.isprintable():
        return text
    return "".join(
        REPLACED
        if unicodedata.category(letter) in HIDDEN or unicodedata.bidirectional(letter) in HIDDEN
        else letter
        for letter in text
    )


@contextmanager
def reading(path: str, part: str) -> Iterator[None]:
    """Turns what goes wrong while a part of a file is used into one line for people."""
    try:
        yield
    except FAULTS as error:
        raise CalibrationError(f"{path}: its {part} cannot be read ({error}); {AGAIN}") from error


def checked(model: type[Model], content: Mapping[str, Any], path: str) -> Model:
    """A file as its schema.  Raises CalibrationError."""
    try:
        return model.model_validate(content)
    except ValidationError as error:
        raise CalibrationError(f"{path}: {explain(error)}; {AGAIN}") from error


def fit_of(content: Mapping[str, Any], path: str, digest: str) -> Fit:
    """A calibration from its JSON."""
    found = checked(FitFile, content, path)
    with reading(path, "base, targets or effects"):
        cell = cell_from_dict(content, path)
    for name, scores in found.accuracy:
        if not len(scores.sse_mm2) == len(scores.points) == len(cell.target_names):
            raise CalibrationError(
                f"{path}: accuracy.{name} is not of {len(cell.target_names)} targets; {AGAIN}"
            )
    poses = poses_of(content, path, "calibration", cell)
    return Fit(path, digest, found, cell, nominal_of(content, path), poses)


def nominal_of(content: Mapping[str, Any], path: str) -> tuple[Cell, ...]:
    """The arm before calibration, if the file has it."""
    if not {"nominal_cell", "nominal_robot"} <= set(content):
        return ()
    with reading(path, "nominal_cell"):
        both = {"robot": content["nominal_robot"], **content["nominal_cell"]}
        return (cell_from_dict(both, f"{path}: nominal_cell"),)


def gap_of(content: Mapping[str, Any], path: str, digest: str) -> Diagnosed:
    """A diagnosis from its JSON."""
    found = checked(GapFile, content, path)
    with reading(path, "cells"):
        cells = tuple(
            cell_from_dict(cell, f"{path}: cells[{i}]")
            for i, cell in enumerate(content.get("cells", []))
        )
    poses = tuple(p for cell in cells[:1] for p in poses_of(content, path, "diagnosis", cell))
    return Diagnosed(path, digest, found, cells, poses)


def poses_of(content: Mapping[str, Any], path: str, kind: str, cell: Cell) -> tuple[Poses, ...]:
    """The poses of a file, if it has them."""
    given = content.get("poses")
    if given is None:
        return ()
    with reading(path, "list of poses"):
        data, held = read_poses(given, path)
        before, after = (errors_of(given, name, data) for name in (BEFORE[kind], "final"))
        if data.q.shape[1] != cell.robot.joints or set(data.target_names) - set(cell.target_names):
            raise ValueError("joints or targets are not those of the robot")
        told = bool(given["visits_told"])
    return (Poses(data, held, before, after, told),)


def errors_of(given: Mapping[str, Any], name: str, data: Measurements) -> Array:
    """(k, m, 3) errors of a name, of the poses."""
    out: Array = numbers(given["errors_mm"][name])
    if out.shape != data.y.shape:
        raise ValueError(f"errors_mm.{name} differs in length")
    if np.nanmax(np.abs(out), initial=0.0) > 1e3 * FARTHEST:
        raise ValueError(f"errors_mm.{name} holds a distance that no instrument measures")
    return np.moveaxis(np.where(np.isfinite(out), out, np.nan), 1, 0)
