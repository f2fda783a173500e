"""What a few new poses say of a calibration."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, NamedTuple

from minimax_cal.core.files import format_json, write_file_atomically
from minimax_cal.core.record_fields import FieldFormat, StoredSeparately, derived_field
from minimax_cal.core.results import Result
from minimax_cal.core.tables import Table, drop_empty_tables
from minimax_cal.core.units import file_unit
from minimax_cal.fitting.accuracy import Accuracy
from minimax_cal.fitting.fit import Fit
from minimax_cal.fitting.set_aside_points import describe_points_set_aside
from minimax_cal.measuring.measurements import SetAsidePoint
from minimax_cal.solvers.status import Status
from minimax_cal.validation.monitoring.change_search import (
    FIRST_SCREEN_COLUMNS,
    MovedParameter,
    moved_parameter_table,
)
from minimax_cal.validation.tolerance import LIMIT_KIND_NAMES

VALID, NOT_VALID, NOT_DECIDED = "valid", "not valid", "not decided"
VERDICT_WORDS = {True: VALID, False: NOT_VALID, None: NOT_DECIDED}
ASKED_ZERO_SHIFT = 2e-4  # of a zero position, whose discovery is asked of the poses [rad]


@dataclass(frozen=True)
class LimitVerdict:
    """One requirement.  valid: None where it is not decided; confidence: of that; why: a clause."""

    kind: str
    limit_mm: float
    value_mm: Annotated[float, FieldFormat(key="seen_mm")]
    ends_mm: Annotated[tuple[float, float], FieldFormat(key="ci95_mm")]
    valid: bool | None
    confidence: float
    why: str


class InseparableZero(NamedTuple):
    """A zero position whose shift these data cannot tell.  like: what moves everything alike."""

    parameter: str
    like: str
    needs: str


@dataclass(frozen=True, eq=False)
class CheckResult(Result):
    """What a few new poses say of a calibration.

    verdicts: of each requirement.  moved: parameters that have.  hidden: those that nobody could
    tell.  accuracy: of the calibrated arm, with what is open placed anew, as if nothing had moved;
    refitted: with what moved corrected; of both, what placing took off is put back.  findable:
    smallest shift of each zero position that these poses find in 95 of 100 cases [rad, m].
    enough: how many of these poses would have been enough to find SHIFT in every joint; asked:
    about how many would be, where these are not.  noise: by how much what is left is noisier than
    the calibration was.  fit: refitted.  set_aside: of these points, with_them: the accuracy where
    they count, None without any.
    """

    KIND = "check"

    robot: StoredSeparately[str]
    verdicts: Annotated[tuple[LimitVerdict, ...], FieldFormat(key="required")]
    moved: tuple[MovedParameter, ...]
    hidden: Annotated[tuple[InseparableZero, ...], FieldFormat(key="not_separable")]
    accuracy: Accuracy
    refitted: Annotated[Accuracy, FieldFormat(key="accuracy_refitted")]
    findable: StoredSeparately[Mapping[str, float]]
    sliding: StoredSeparately[frozenset[str]]
    enough: Annotated[int | None, FieldFormat(key="poses.enough")]
    asked: Annotated[int | None, FieldFormat(key="poses.needed")]
    noise: Annotated[float, FieldFormat(key="noise_ratio")]
    poses: Annotated[int, FieldFormat(key="poses.given")]
    fit: StoredSeparately[Fit]
    notices: tuple[str, ...] = ()
    set_aside: tuple[SetAsidePoint, ...] = ()
    with_them: StoredSeparately[Accuracy | None] = None

    @derived_field()
    def valid(self) -> bool | None:
        """Whether the calibration keeps all that is required; None where it is not decided."""
        found = [verdict.valid for verdict in self.verdicts]
        return False if False in found else None if None in found else True

    @property
    def word(self) -> str:
        """The verdict in words."""
        return VERDICT_WORDS[self.valid]

    @derived_field()
    def confidence(self) -> float:
        """In the verdict."""
        every = [v.confidence for v in self.verdicts if v.valid == self.valid]
        return max(every) if self.valid is False else min(every)

    @property
    def status(self) -> Status:
        """Of the refit."""
        return self.fit.status

    def headline(self) -> str:
        """The result in a few sentences."""
        said = [
            f"The calibration of {self.robot} is {self.word}",
            *dict.fromkeys(v.why for v in self.verdicts),
        ]
        text = f"{said[0]} ({'; '.join(said[1:])}; confidence {100 * self.confidence:.1f} %). "
        if self.moved:
            joints = ", ".join(dict.fromkeys(m.joint for m in self.moved))
            text += (
                f"Moved: {joints}.  With that corrected RMS {self.accuracy.rms_mm:.3f} -> "
                f"{self.refitted.rms_mm:.3f} mm on these {self.poses} poses."
            )
        else:
            text += "No joint is found to have moved."
        if self.set_aside:
            text += f" {describe_points_set_aside(self.set_aside, self.with_them)}"
        return text

    def first_tables(self) -> tuple[Table, ...]:
        """What moved, by how much; where nothing did, what was required."""
        if self.moved:
            return (self.moved_table().shorten(*FIRST_SCREEN_COLUMNS),)
        return (self.required_table().select_columns(*range(6)).shorten(),)

    def required_table(self) -> Table:
        """What was required, and what was seen."""
        rows = (
            (
                LIMIT_KIND_NAMES[v.kind],
                v.limit_mm,
                v.value_mm,
                *v.ends_mm,
                VERDICT_WORDS[v.valid],
                100 * v.confidence,
            )
            for v in self.verdicts
        )
        title = f"required of {self.robot}; base and reflectors fitted to {self.poses} poses"
        columns = "error | at most mm g | seen mm .4f | 95 % from .4f | to .4f | verdict"
        return Table.from_rows(title, rows, columns, "confidence % .1f")

    def moved_table(self) -> Table:
        """What moved."""
        return moved_parameter_table("moved since the calibration", self.moved)

    def tables(self) -> tuple[Table, ...]:
        """What was required, what moved, what could have been found."""
        rows = (
            (name, "mm" if name in self.sliding else "mrad", 1e3 * size)
            for name, size in self.findable.items()
        )
        title = "smallest shift that these poses find in 95 of 100 cases"
        found = Table.from_rows(title, rows, "zero position | unit | shift .3f")
        columns = "parameter=zero position | like=looks like | needs=measure"
        hidden = Table.from_records("joints that these data cannot check", self.hidden, columns)
        return drop_empty_tables(self.required_table(), self.moved_table(), found, hidden)

    def extra_file_content(self, *, with_measurements: bool = True) -> dict[str, Any]:
        """Accuracy, and what could be found: lengths in mm, angles in rad."""
        found = []
        for name, size in self.findable.items():
            scale, unit = file_unit("m" if name in self.sliding else "rad")
            found.append({"parameter": name, "size": scale * size, "unit": unit})
        with_it = {"holdout_with_them": self.with_them} if self.with_them else {}
        shift = {"to_find_rad": ASKED_ZERO_SHIFT}
        return {"accuracy": with_it, "smallest_found": found, "poses": shift}

    def fit_dict(self, *, poses: bool = True) -> dict[str, Any]:
        """The refitted calibration as its file, with this answer."""
        told = self.to_dict()
        first = {key: told[key] for key in ("valid", "confidence", "moved")}
        return {**self.fit.to_dict(poses=poses), **first, "check": told}

    def save(self, path: Path | str, *, poses: bool = True) -> None:
        """Write the refitted calibration, with this answer; never a half-written file."""
        write_file_atomically(path, format_json(self.fit_dict(poses=poses)))
