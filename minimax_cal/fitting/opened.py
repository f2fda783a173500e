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

from minimax_cal.fitting.beyond import Beyond
from minimax_cal.fitting.fit import Fit
from minimax_cal.fitting.options import Options, listed, read_options
from minimax_cal.fitting.pose_rows import measured_poses
from minimax_cal.fitting.spans import Span, spans_of
from minimax_cal.fitting.stations import MIN_FRAME_POINTS, fit_rigid_motion
from minimax_cal.fitting.uncertainty import Uncertainty
from minimax_cal.ground.arrays import Array
from minimax_cal.ground.errors import CalibrationError, DataError, OptionError
from minimax_cal.ground.files import saved_content
from minimax_cal.ground.records import AGAIN, read, reading
from minimax_cal.measuring.checks import check_joints
from minimax_cal.measuring.history import with_history
from minimax_cal.measuring.measurements import Measurements
from minimax_cal.measuring.stations import labels
from minimax_cal.modelling.cell import Cell, cell_from_dict
from minimax_cal.modelling.effects.table import EFFECTS, Term
from minimax_cal.modelling.joint_fit import extended
from minimax_cal.modelling.model import model_of
from minimax_cal.modelling.near import nearby
from minimax_cal.modelling.start import fit_base
from minimax_cal.robots.robot import Robot, robot_from_dict
from minimax_cal.solvers.status import Status

RELATIVE = "relative calibration"  # kind of a file
FINITE_PASSES = 2  # of a fit with effects: the second takes finite turns into account
NOMINAL, CALIBRATED, GEOMETRIC = "nominal", "calibrated", "geometric"
NO_JOINTS = np.zeros((0, 0))
NOWHERE = Measurements(NO_JOINTS, np.zeros((0, 0, 3)), (), np.zeros(0, dtype=bool), np.zeros(0), {})


@runtime_checkable
class Writes(Protocol):
    """A result that tells all of itself."""

    def to_dict(self) -> dict[str, Any]:
        """As its file."""


Result = Fit | Cell | Writes | Path | str


@dataclass(frozen=True, eq=False)
class Rung:
    """A state of the arm.

    error: (m, k, 3) of its poses as the file tells them [m], None where it does not.
    """

    name: str
    cell: Cell
    error: Array | None = None


@dataclass(frozen=True, eq=False)
class Opened:
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
    rungs: tuple[Rung, ...]
    number: int
    data: Measurements = NOWHERE
    held: Array = field(default_factory=lambda: np.zeros(0, dtype=bool))
    digest: str = ""
    uncertainty: Uncertainty | None = None
    placed: bool = True
    status: Status | None = None
    spans: tuple[Span, ...] = ()
    options: Options | None = None
    fit: Fit | None = None
    outside: Callable[[], Beyond] = Beyond
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

    def placed_by(
        self, data: Measurements, new_frame: bool = False
    ) -> tuple[Cell, Cell | None, tuple[str, ...]]:
        """The arm and the nominal one with base and targets that fit data best; a notice.

        As they are where the result knows its place.  new_frame: measured from elsewhere, so that
        base and instrument are placed by the data.  Raises CalibrationError.
        """
        if self.placed and new_frame:
            return (
                in_new_frame(self.cell, data),
                in_new_frame(self.nominal, data) if self.nominal else None,
                (f"{data.source}: the frame is placed by these points: six numbers are fitted",),
            )
        if self.placed:
            return self.cell, self.nominal, ()
        before = place(self.nominal.robot, data) if self.nominal else None
        said = f"{self.source}: knows no base and no targets: both are fitted to {data.source}"
        return settled(self.cell, data), before, (said,)


def in_new_frame(cell: Cell, data: Measurements) -> Cell:
    """A cell as an instrument sees it that stands elsewhere; base and targets stay together.

    Raises DataError for several sessions, and for fewer than three points.
    """
    data = check_joints(cell.robot, data)
    if len(np.unique(labels(data))) > 1:
        raise DataError(f"{data.source}: holds several sessions; evaluate them one by one")
    alone = replace(cell, sessions=replace(cell.sessions, frames={}))
    error = alone.error(data)
    here = data.y[data.seen]
    if len(here) < MIN_FRAME_POINTS:
        raise DataError(f"{data.source}: {len(here)} points do not place a frame; measure more")
    there = here - error[data.seen]  # where the calibration's instrument would see them
    return replace(alone, base=fit_rigid_motion(there, here) @ cell.base)


def place(robot: Robot, data: Measurements) -> Cell:
    """An arm where it fits all poses best.  Raises DataError."""
    data = check_joints(robot, data)
    return Cell.of(robot, fit_base(model_of(robot, data), robot.mdh).state, data.target_names)


def settled(cell: Cell, data: Measurements) -> Cell:
    """A cell whose base and targets are not known where it fits all poses best, effects included.

    Raises DataError.
    """
    found, terms = place(cell.robot, data), cell.effects.terms
    if not terms:
        return found
    data = with_history(check_joints(cell.robot, data))
    model, state = model_of(cell.robot, data), replace(found.state, effects=cell.state.effects)
    free = np.arange(model.names.count) >= 5 * model.names.joints
    for _ in range(FINITE_PASSES):
        bent, begin = extended(model, cell.robot, data, state, terms)
        alone = bent.only(np.pad(free, (0, len(state.effects))))
        state = nearby(alone, begin).x.take(np.array(0))
    return Cell.of(cell.robot, state, data.target_names, cell.effects, cell.sessions)


def open_result(source: Result | Opened, rung: int | None = None) -> Opened:
    """A result, or its file, at one of its rungs.

    source: a calibration, a diagnosis, a relative calibration, a cell, or a file of one.  rung: 0
    nominal, 1 geometric (or calibrated), 2 ... with each effect of a diagnosis; the last unless
    given.  Raises CalibrationError.
    """
    if isinstance(source, Opened):
        found = source
    elif isinstance(source, Fit):
        found = of_fit(source, source.cell.robot.name)
    elif isinstance(source, Cell):
        found = Opened(source.robot.name, (Rung(CALIBRATED, source),), 0)
    elif isinstance(source, Path | str):
        found = of_content(saved_content(source), str(source))
    else:
        content = source.to_dict()
        found = of_content(content, str(content.get("kind", "result")))
    return found if rung is None else at_rung(found, rung)


def at_rung(found: Opened, number: int) -> Opened:
    """The same result at another rung.  Raises OptionError."""
    if not 0 <= number < len(found.rungs):
        names = ", ".join(f"{i} ({rung.name})" for i, rung in enumerate(found.rungs))
        raise OptionError(f"{found.source}: has no step {number}; it has {names}")
    whole = found.uncertainty if number == len(found.rungs) - 1 else None
    return replace(found, number=number, uncertainty=whole, possible=frozenset())


def of_content(content: Mapping[str, Any], source: str) -> Opened:
    """From the JSON of a result, by its kind.  Raises CalibrationError."""
    kind = content.get("kind", "calibration")
    if kind == "diagnosis":
        with reading(source):
            return of_diagnosis(content, source)
    if kind == RELATIVE:
        return of_relative(content, source)
    if {"parameters", "accuracy", "provenance"} <= set(content):
        return of_fit(Fit.from_dict(content, source), source)
    return Opened(source, (Rung(CALIBRATED, cell_from_dict(content, source)),), 0)


def of_fit(fit: Fit, source: str) -> Opened:
    """A calibration: nominal and calibrated."""
    rungs = (Rung(NOMINAL, fit.nominal, fit.error_nominal), Rung(CALIBRATED, fit.cell, fit.error))
    fitted = bool(fit.data.poses) and not fit.is_after_check
    options = fit.options if fitted else None
    return Opened(
        source, rungs, 1, fit.data, fit.held, fit.provenance.data_sha256, fit.uncertainty,
        status=fit.status, spans=fit.spans, options=options, fit=fit, outside=lambda: fit.beyond,
    )  # fmt: skip


def of_relative(content: Mapping[str, Any], source: str) -> Opened:
    """A calibration without coordinates: the robots alone, in the base that both share."""

    def bare(key: str) -> Cell:
        robot = robot_from_dict(content.get(key, {}), f"{source}: {key}")
        return Cell(robot, np.eye(4), (), np.zeros((0, 3)))

    calibrated = "calibrated_robot" if "calibrated_robot" in content else "robot"
    alone = bare(calibrated)
    whole = cell_from_dict(content["cell"], f"{source}: cell") if content.get("cell") else alone
    rungs = (Rung(NOMINAL, bare("nominal_robot")), Rung(CALIBRATED, whole))
    status = Status(content["status"]) if "status" in content else None
    known = whole.effects.causes
    firm = {term.text for term in established(content, source)} if "diagnosis" in content else None
    possible = frozenset(term.text for term in known) - firm if firm is not None else frozenset()
    digest = str(content.get("provenance", {}).get("data_sha256", ""))
    return Opened(
        source, rungs, 1, digest=digest, placed=False, status=status, geometric=alone,
        possible=possible,
    )  # fmt: skip


def of_diagnosis(content: Mapping[str, Any], source: str) -> Opened:
    """A diagnosis: nominal, geometric, then with each effect."""
    rungs = rungs_of(content, source)
    first = rungs[0].cell
    data, held, (geometric, final) = measured_poses(content, source, first, "geometric")
    told = {GEOMETRIC: geometric, rungs[-1].name: final} if data.poses else {}
    rungs = tuple(Rung(r.name, r.cell, told.get(r.name)) for r in rungs)
    digest = str(content["provenance"]["data_sha256"])
    status = Status(content["status"])
    spans = spans_of(first.robot, data.take(~held)) if data.poses else ()
    settings = content["provenance"]["settings"]
    known = rungs[-1].cell.effects.causes
    firm = {term.text for term in confirmed(content, known)}
    beyond = read(Beyond, content["gap"]["beyond"], "gap.beyond")
    return Opened(
        source, rungs, len(rungs) - 1, data, held, digest, status=status, spans=spans,
        options=read_options(settings, objective="sum") if data.poses else None,
        outside=lambda: beyond,
        possible=frozenset(term.text for term in known) - firm,
    )  # fmt: skip


def rungs_of(content: Mapping[str, Any], source: str) -> tuple[Rung, ...]:
    """The rungs of a diagnosis' JSON.  Raises CalibrationError, or one of `records.FAULTS`."""
    listed = content.get("rungs")
    if not listed:
        raise CalibrationError(f"{source}: holds no arm; {AGAIN}")
    return tuple(
        Rung(str(each["name"]), cell_from_dict(each, f"{source}: rungs[{i}]"))
        for i, each in enumerate(listed)
    )


# ---- the effects of a diagnosis, for a fit -----------------------------------------------------


def listed_effects(given: object) -> tuple[str | Term, ...]:
    """Effects by name, as terms, or those that a diagnosis (or its file) has established.

    Raises CalibrationError.
    """
    several = listed(given) if isinstance(given, Sequence) else (given,)
    out: list[str | Term] = []
    for each in several:
        if isinstance(each, Term) or (isinstance(each, str) and not each.endswith(".json")):
            out.append(each)
        elif isinstance(each, Path | str):
            out += established(saved_content(each), str(each))
        elif isinstance(each, Writes):
            out += established(each.to_dict(), "the diagnosis")
        else:
            raise OptionError(f"effects {each!r}: name them, or give a diagnosis")
    return tuple(out)


def established(content: Mapping[str, Any], source: str) -> list[Term]:
    """The effects that a diagnosis holds for established, with the variants that it chose.

    Raises CalibrationError.
    """
    if content.get("kind") == RELATIVE and "diagnosis" in content:
        with reading(source):
            cell = content.get("cell")
            terms = cell_from_dict(cell, f"{source}: cell").effects.causes if cell else ()
            return confirmed(content["diagnosis"], terms)
    if content.get("kind") != "diagnosis":
        raise OptionError(f"{source}: is no diagnosis, so that it names no effects")
    with reading(source):
        return confirmed(content, rungs_of(content, source)[-1].cell.effects.terms)


def confirmed(content: Mapping[str, Any], known: Sequence[Term]) -> list[Term]:
    """The established effects of a diagnosis' JSON.  known: those fitted, with their variants."""
    found = [
        (str(effect["effect"]), str(effect["place"]))
        for effect in content["effects"]
        if effect["established"]
        and effect["effect"] in EFFECTS
        and not effect["lines"]  # a fault of the data
    ]
    return [term for key in found for term in [t for t in known if t.key == key] or [Term(*key)]]
