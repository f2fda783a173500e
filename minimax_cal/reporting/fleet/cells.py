"""The cells of a fleet, as a TOML file names them."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError, model_validator

from minimax_cal.ground.errors import OptionError
from minimax_cal.ground.files import read_toml
from minimax_cal.judging.tolerance import limits_of

MOST = 10_000  # cells
NAME = re.compile(r"[\w][\w .()+-]{0,80}")


def required(text: str) -> str:
    """A tolerance.  Raises ValueError."""
    try:
        limits_of(text)
    except OptionError as error:
        raise ValueError(str(error)) from error
    return text


def plain_name(text: str) -> str:
    """A name that is also one of a file.  Raises ValueError."""
    if not NAME.fullmatch(text) or text.endswith((".", " ")):
        raise ValueError(f"{text!r}: letters, digits, spaces, . _ - + ( ) only; it names a file")
    return text


class Common(BaseModel):
    """What all cells, or one, may have."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    robot: str = ""
    tolerance: Annotated[str, AfterValidator(required)] = ""
    objective: str = "minimax"
    effects: str = ""
    fix: str = ""
    holdout: Annotated[float, Field(ge=0.0, lt=1.0)] = 0.2
    seed: Annotated[int, Field(ge=0)] = 0


class CellPart(Common):
    """One cell: measurements to calibrate by, or a calibration and poses to check it by."""

    name: Annotated[str, AfterValidator(plain_name)]
    data: str = ""
    fit: str = ""
    check: str = ""

    @model_validator(mode="after")
    def whole(self) -> CellPart:
        """Raises ValueError for a cell with nothing to do."""
        if self.data and not self.robot:
            raise ValueError("data needs robot, a file or a built-in name")
        if self.check and not (self.fit and self.tolerance):
            raise ValueError("check needs fit, the calibration, and tolerance")
        if not (self.data or self.check):
            raise ValueError("give data (and robot), or fit and check")
        if self.data and self.check:
            raise ValueError("give data or check, not both; data with fit compares")
        return self


@dataclass(frozen=True)
class Job:
    """A cell to be done.  told: its settings.  folder: its files are named from there.

    out: where its calibration goes, None for nowhere.
    """

    told: CellPart
    folder: Path
    out: Path | None

    def path(self, name: str) -> str:
        """A file of the cell, or a built-in robot."""
        there = self.folder / name
        return str(there) if there.exists() or Path(name).suffix else name


def read_cells(path: Path | str, out: Path | None) -> tuple[Job, ...]:
    """The jobs of a TOML file: ``[[cells]]`` with what ``[defaults]`` gives all.

    Raises OptionError for what is wrong in the file; what is wrong with one cell's own files is
    found when it is done.
    """
    content = read_toml(path)
    strange = sorted(set(content) - {"defaults", "cells"})
    if strange:
        raise OptionError(f"{path}: the key {strange[0]!r} is not known; there are defaults, cells")
    cells, common = content.get("cells", []), content.get("defaults", {})
    if not (isinstance(cells, list) and isinstance(common, dict)):
        raise OptionError(f"{path}: write [defaults] once, and [[cells]] for each cell")
    if not 1 <= len(cells) <= MOST:
        raise OptionError(f"{path}: holds {len(cells)} cells; give 1 to {MOST} as [[cells]]")
    told = [read_cell(path, number, each, common) for number, each in enumerate(cells, 1)]
    names = [cell.name.casefold() for cell in told]
    twice = [cell.name for cell in told if names.count(cell.name.casefold()) > 1]
    if twice:
        raise OptionError(f"{path}: two cells are called {twice[0]!r}; name each otherwise")
    folder = Path(path).resolve().parent
    return tuple(Job(cell, folder, out) for cell in told)


def read_cell(path: Path | str, number: int, given: Any, common: dict[str, Any]) -> CellPart:
    """One cell.  Raises OptionError."""
    if not isinstance(given, dict):
        raise OptionError(f"{path}: write [[cells]] for each cell")
    where = f"{path}: cell {number}"
    try:
        return CellPart.model_validate({**common, **given})
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        place = ".".join(map(str, first["loc"]))
        text = first["msg"].removeprefix("Value error, ")
        if first["type"] == "extra_forbidden":
            text = f"is not known; choose {', '.join(CellPart.model_fields)}"
        raise OptionError(f"{where}: {place}{': ' if place else ''}{text}") from error
