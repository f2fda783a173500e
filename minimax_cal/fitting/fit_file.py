"""The file of a fit: what `Fit.to_dict` writes and `Fit.from_dict` reads.

Each number is there once: in millimetres what people read, in SI, under `arrays`, what no person
asks for.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import Annotated, Any

import numpy as np
from pydantic import Field

from minimax_cal.fitting.beyond import Beyond, Fold, Trusted
from minimax_cal.fitting.certificate import Certificate
from minimax_cal.fitting.changed import Change
from minimax_cal.fitting.crossed import NOT_CROSSED
from minimax_cal.fitting.fit import (
    Fit,
    KeptDistance,
    Parameter,
    Parameters,
    Provenance,
    Work,
    WorstCase,
)
from minimax_cal.fitting.identify import Identification
from minimax_cal.fitting.intervals import Interval
from minimax_cal.fitting.options import read_options
from minimax_cal.fitting.set_aside import WithThem
from minimax_cal.fitting.suspects import Suspect
from minimax_cal.fitting.uncertainty import uncertainty_from_dict
from minimax_cal.ground.arrays import Array
from minimax_cal.ground.errors import CalibrationError, said
from minimax_cal.ground.files import finite, numbers, plain
from minimax_cal.ground.records import (
    AGAIN,
    FAULTS,
    UNKNOWN,
    Count,
    Ends,
    Gaps,
    Number,
    Part,
    Recorded,
    Square,
    Values,
    check_schema,
    checked,
)
from minimax_cal.measuring.accuracy import Accuracy
from minimax_cal.measuring.aside import SetAside
from minimax_cal.measuring.measurements import FARTHEST, Measurements
from minimax_cal.measuring.pose_rows import pose_rows, read_poses
from minimax_cal.measuring.spans import Span
from minimax_cal.modelling.cell import Cell, cell_from_dict
from minimax_cal.modelling.parameters import Names
from minimax_cal.robots.frames import CONVENTION
from minimax_cal.solvers.minimax import Kkt, Step
from minimax_cal.solvers.status import Status

SCHEMA = 1
NO_KKT = Kkt(math.nan, math.nan, math.nan)
POSE_BY_POSE = ("weights", "share", "crossed", "drawn crossed")
EARLIER = "an earlier version wrote this file"
NEAR = 1e-6  # a file's own errors come back to this, or it lacks columns of the measurements [m]


# ---- what stands in the file -------------------------------------------------------------------


class ScoresPart(Part):
    """Accuracy on some poses, with its 95 % intervals where they are known [mm, mm^2]."""

    rms_mm: Number = math.nan
    max_mm: Number = math.nan
    mean_mm: Number = math.nan
    poses: Count = 0
    sse_mm2: tuple[Square, ...] = ()
    points: tuple[Count, ...] = ()
    rms_ci95_mm: Ends = UNKNOWN
    max_ci95_mm: Ends = UNKNOWN

    def accuracy(self) -> Accuracy:
        """As the code has it."""
        return Accuracy(
            self.rms_mm, self.max_mm, self.mean_mm, self.poses, self.sse_mm2, self.points
        )


class BeyondPart(Part):
    """On parts that were left out [mm]."""

    folds: tuple[Recorded[Fold], ...] = ()
    typical_mm: Number = math.nan
    geometric: dict[str, Number] = Field(default_factory=dict)
    reason: str = ""
    worst_high95_mm: Number = math.nan
    max_high95_mm: Number = math.nan
    not_judged: tuple[str, ...] | None = None
    effects_sought_anew: bool | None = None
    without_suspects: Recorded[Trusted] | None = None
    spans: tuple[Recorded[Span], ...] = ()
    plan: str | None = None

    def beyond(self) -> Beyond:
        """As the code has it."""
        plain = self.geometric.get("typical_mm", math.nan)
        high = self.worst_high95_mm, self.max_high95_mm
        return Beyond(
            self.folds,
            self.typical_mm,
            plain,
            self.reason,
            *high,
            missed=self.not_judged,
            sought=self.effects_sought_anew,
            trusted=self.without_suspects,
            spans=self.spans,
            plan=self.plan or "",
        )


class AccuraciesPart(Part):
    """Before and after, on the held-out and on the training poses."""

    nominal: ScoresPart
    train: ScoresPart
    holdout: ScoresPart
    nominal_train: ScoresPart
    holdout_with_them: ScoresPart | None = None
    beyond: BeyondPart = Field(default_factory=lambda: BeyondPart(reason=EARLIER))

    def told(self) -> Iterator[tuple[str, ScoresPart]]:
        """All but `beyond`, with their names."""
        return ((name, part) for name, part in self if isinstance(part, ScoresPart))


TableParameter = Annotated[Parameter, Gaps(required=("value",))]  # in its unit: mm, rad, ...


class DistancePart(Part):
    """A distance between two targets that the minimax keeps."""

    pair: tuple[str, str]
    measured_mm: Number
    tolerance_mm: Number
    multiplier: Number


class MinimaxPart(Part):
    """How the minimax ended."""

    functions: tuple[str, ...] = ()
    size: tuple[Number, ...] = ()
    multipliers: tuple[Number, ...] = ()
    active: tuple[str, ...] = ()
    distances: tuple[DistancePart, ...] = ()
    kkt: Recorded[Kkt] = NO_KKT
    iterations: int = 0
    trace: tuple[Recorded[Step], ...] = ()


class PointPart(Part):
    """A point that decides."""

    target: str
    line: int
    distance_mm: Number
    multiplier: Number


class CertificatePart(Part):
    """How far the worst point is from its optimum."""

    value_mm: Number
    bound_mm: Number
    kkt: Recorded[Kkt] = NO_KKT
    points: tuple[PointPart, ...] = ()


class SuspectPart(Part):
    """A point that does not fit the others.  together: all points of its pose are suspect."""

    line: int
    target: str
    distance_mm: Number = math.nan
    score: Number = math.nan
    chance: Number = math.nan
    together: bool = False
    held: bool = False


class FitPart(Part):
    """The file of `minimax-cal calibrate -o`."""

    objective: str
    qp: str = ""
    answered: dict[str, int] = Field(default_factory=dict)
    work: Work = Work()
    between_sessions: tuple[Change, ...] = ()
    status: Status
    iterations: int = 0
    seconds: Number = math.nan
    parameters: tuple[TableParameter, ...]
    accuracy: AccuraciesPart
    cell: dict[str, Any]
    condition: Number = math.nan
    trace_mm2: tuple[Number, ...] = ()
    minimax: MinimaxPart | None = None
    certificate: CertificatePart | None = None
    suspects: tuple[SuspectPart, ...] = ()
    reason: str = ""
    set_aside: tuple[Recorded[SetAside], ...] = ()
    notices: tuple[str, ...] = ()
    loss: str = "square"
    widening: float = 1.0
    provenance: Provenance
    arrays: dict[str, Values]


# ---- writing -----------------------------------------------------------------------------------


def written(fit: Fit, *, poses: bool = True) -> dict[str, Any]:
    """The JSON of the contract, and more.  poses: whether with what was measured."""
    out: dict[str, Any] = {"schema": SCHEMA, "kind": "calibration", **fit.kept.whole()}
    out["cell"] = {"effects": out.pop("effects")}
    if fit.kept is not fit.cell:
        out["cell"] = fit.cell.whole()
    if fit.nominal:
        out["nominal_robot"] = fit.nominal.robot.to_dict()
        out["nominal_cell"] = fit.nominal.to_dict()
    out |= {
        "frames": {name: frame.to_dict() for name, frame in fit.frames.items()},
        "frames_convention": CONVENTION,
        "objective": fit.objective,
        "loss": fit.loss,
        "suspects": [suspect.to_dict() for suspect in fit.suspects],
        "set_aside": [point.to_dict() for point in fit.set_aside],
        "qp": fit.qp,
        "answered": dict(fit.answered),
        "work": vars(fit.work),
        "between_sessions": [change.to_dict() for change in fit.moved],
        "status": str(fit.status),
        "advice": fit.reason or fit.status.advice,
        "reason": fit.reason,
        "iterations": fit.iterations,
        "seconds": finite(fit.seconds),
        "parameters": [p.to_dict() for p in fit.parameters],
        "accuracy": {
            **{key: value.to_dict() | ends(fit, key) for key, value in fit.accuracy.items()},
            **({"holdout_with_them": fit.with_them.to_dict()} if fit.with_them else {}),
            "holdout_trusted": fit.trusted.to_dict(),
            "beyond": fit.beyond.to_dict(),
            **({"cv": crossed_to_dict(fit)} if fit.error_crossed.size else {}),
        },
        "condition": finite(fit.identification.condition),
        "trace_mm2": [value * 1e6 for value in fit.trace],
        "notices": list(fit.notices),
        "provenance": vars(fit.provenance),
    }
    if fit.uncertainty:
        out["covariance"] = fit.uncertainty.to_dict()
    if fit.data.poses and poses:
        errors = {"nominal": fit.error_nominal, "final": fit.error}
        out["poses"] = pose_rows(fit.data, fit.held, errors)
    if fit.minimax:
        out["minimax"] = minimax_to_dict(fit.minimax)
    if fit.certificate:
        out["certificate"] = fit.certificate.to_dict()
    return out | {"widening": fit.widening, "arrays": arrays_of(fit, poses=poses)}


def ends(fit: Fit, key: str) -> dict[str, list[float | None]]:
    """The intervals of some poses; nothing for training poses."""
    names = ("rms_ci95_mm", "max_ci95_mm")
    return {
        name: [finite(1e3 * interval.low), finite(1e3 * interval.high)]
        for name, interval in zip(names, fit.intervals.get(key, ()), strict=False)
    }


def crossed_to_dict(fit: Fit) -> dict[str, Any]:
    """The cross-validated accuracy."""
    names = ("rms_ci95_mm", "max_ci95_mm")
    return (
        fit.within.after.to_dict()
        | {"not_judged": [int(x) for x in fit.unjudged], "nominal": fit.within.before.to_dict()}
        | {
            name: [finite(1e3 * interval.low), finite(1e3 * interval.high)]
            for name, interval in zip(names, (fit.within.rms, fit.within.largest), strict=True)
        }
    )


def minimax_to_dict(worst: WorstCase) -> dict[str, Any]:
    """How the minimax ended."""
    return {
        "functions": list(worst.functions),
        "size": worst.size.tolist(),
        "multipliers": worst.multiplier.tolist(),
        "active": list(worst.active),
        "distances": [
            {
                "pair": list(kept.pair),
                "measured_mm": kept.measured * 1e3,
                "tolerance_mm": kept.tolerance * 1e3,
                "multiplier": kept.multiplier,
            }
            for kept in worst.distances
        ],
        "kkt": vars(worst.kkt),
        "iterations": worst.iterations,
        "trace": [vars(step) for step in worst.trace],
    }


def arrays_of(fit: Fit, *, poses: bool) -> dict[str, Any]:
    """What later work rests on, in SI.  poses: whether with what is told pose by pose."""
    out = {
        "singular": fit.identification.singular,
        "sensitivity": fit.identification.scale,
        "weights": fit.weights,
        "share": fit.share,
        "prior": fit.prior,
    }
    if fit.error_crossed.size:
        out["crossed"], out["drawn crossed"] = fit.error_crossed, fit.error_drawn_crossed
    if not poses:
        out = {name: values for name, values in out.items() if name not in POSE_BY_POSE}
        out |= {"share": fit.share} if fit.share.ndim == 1 else {}
    return {name: plain(values) for name, values in out.items()}


# ---- reading -----------------------------------------------------------------------------------


def read(content: Mapping[str, Any], source: str) -> Fit:
    """A fit from its JSON.  Raises CalibrationError."""
    check_schema(content, source, SCHEMA)
    cell = cell_from_dict(content, source)
    part = checked(FitPart, content, source)
    geometric = None
    if cell.effects.causes and part.status is not Status.NO_BETTER:
        geometric = cell_from_dict({**content, "cell": {}}, source)
    for name, scores in part.accuracy.told():
        if not len(scores.sse_mm2) == len(scores.points) == len(cell.target_names):
            raise CalibrationError(
                f"{source}: accuracy.{name} is not of {len(cell.target_names)} targets; {AGAIN}"
            )
    data, held, told = measured_poses(content, source, cell, "nominal")
    data = replace(data, digest=part.provenance.data_sha256)
    nominal = nominal_of(content, source)
    before, after = errors_of(nominal, data, told[0]), errors_of(cell, data, told[1])
    made = assembled(content, source, part, cell, nominal, data, held, before, after)
    return replace(made, stated_geometric=geometric)


def assembled(
    content: Mapping[str, Any],
    source: str,
    part: FitPart,
    cell: Cell,
    nominal: Cell | None,
    data: Measurements,
    held: Array,
    before: Array,
    after: Array,
) -> Fit:
    """The fit from what was read.  Raises one of FAULTS."""
    read_options(part.provenance.settings)  # what later work rests on
    known = uncertainty_from_dict(content, cell, source) if "covariance" in content else None
    parameters = Parameters(
        tuple(in_si(p) for p in part.parameters), known.dof if known else math.nan
    )
    train = data.take(~held)
    k, names = len(cell.target_names), parameter_names(parameters, cell)
    arrays = part.arrays
    check_shapes(arrays, names.count, train, data)
    if missing := set(names.all) - {p.name for p in parameters}:
        raise ValueError(f"parameters: {min(missing)} is missing, of {len(missing)}")
    return Fit(
        cell=cell,
        nominal=nominal,
        objective=part.objective,
        qp=part.qp,
        status=part.status,
        iterations=part.iterations,
        seconds=part.seconds,
        parameters=parameters,
        accuracy={key: scores.accuracy() for key, scores in part.accuracy.told()},
        identification=identification_of(part, parameters, names),
        uncertainty=known,
        minimax=minimax_of(part),
        certificate=certificate_of(part.certificate),
        trace=tuple(1e-6 * value for value in part.trace_mm2),
        data=data,
        held=held,
        error_nominal=before,
        error=after,
        notices=part.notices,
        loss=part.loss,
        suspects=tuple(suspect_of(suspect, data, held) for suspect in part.suspects),
        weights=arrays.get("weights", train.seen.T.astype(float)),
        share=arrays.get("share", np.ones(k)),
        prior=arrays["prior"],
        widening=part.widening,
        provenance=part.provenance,
        claim=part.accuracy.beyond.beyond,
        stated=intervals_of(part),
        error_crossed=arrays.get("crossed", NOT_CROSSED) if data.poses else NOT_CROSSED,
        set_aside=part.set_aside,
        with_them=with_them_of(part.accuracy.holdout_with_them),
        answered=part.answered,
        work=part.work,
        moved=part.between_sessions,
        error_drawn_crossed=arrays.get("drawn crossed", NOT_CROSSED) if data.poses else NOT_CROSSED,
        reason=part.reason,
    )


def check_shapes(
    arrays: Mapping[str, Array], count: int, train: Measurements, data: Measurements
) -> None:
    """Raise ValueError for arrays that are not of these parameters and poses."""
    k, m = len(data.target_names), train.poses
    every = (k, data.poses, 3)
    shapes: dict[str, tuple[tuple[int, ...], ...]] = {
        "sensitivity": ((count,),), "prior": ((count,),), "weights": ((k, m),),
        "share": ((k,), (k, m)), "crossed": (every,), "drawn crossed": (every,)
    }  # fmt: skip
    if arrays["singular"].ndim != 1 or not arrays["singular"].size:
        raise ValueError("singular is not a row of numbers")
    for name, values in arrays.items():
        known = shapes.get(name, (values.shape,))
        asked = data.poses or name not in POSE_BY_POSE
        if values.shape not in known and asked:
            raise ValueError(f"{name} is not of these parameters and poses")


def with_them_of(scores: ScoresPart | None) -> WithThem | None:
    """How it does with the points that were set aside, where there were any."""
    if scores is None:
        return None
    return WithThem(scores.accuracy(), scores.rms_ci95_mm, scores.max_ci95_mm)


def nominal_of(content: Mapping[str, Any], source: str) -> Cell | None:
    """The nominal robot in its place; None where the file tells none."""
    if "nominal_robot" not in content:
        return None
    whole = {"robot": content["nominal_robot"], **content["nominal_cell"]}
    return cell_from_dict(whole, f"{source}: nominal_cell")


def measured_poses(
    content: Mapping[str, Any], source: str, cell: Cell | None, first: str
) -> tuple[Measurements, Array, tuple[Array, Array]]:
    """The poses of a result file, (m,) which are held out, and errors (k, m, 3) of `first` and
    `final` as they stand there [m].  None where the file has none.  Raises CalibrationError.
    """  # fmt: skip
    if content.get("poses") is None or cell is None:
        nowhere = np.zeros((0, 0, 3)) if cell is None else np.zeros((0, len(cell.target_names), 3))
        joints = cell.robot.joints if cell else 0
        nothing, lines = np.zeros((0, joints)), np.zeros(0, dtype=int)
        names = cell.target_names if cell else ()
        data = Measurements(nothing, nowhere, names, np.zeros(joints, dtype=bool), lines, {})
        none = np.moveaxis(nowhere, 1, 0)
        return replace(data, source=source), np.zeros(0, dtype=bool), (none, none)
    given = content["poses"]
    data, held = read_poses(given, source)
    try:
        if data.q.shape[1] != cell.robot.joints or set(data.target_names) - set(cell.target_names):
            raise ValueError("joints or targets are not those of the robot")
        errors = (told_errors(given, first, data), told_errors(given, "final", data))
        frames = cell.sessions.frames  # points were written as the first session saw them
        return replace(data, source=str(given["source"]), frames=frames), held, errors
    except FAULTS as error:
        raise CalibrationError(
            f"{source}: its list of poses cannot be read ({said(error)}); {AGAIN}"
        ) from error


def told_errors(given: Mapping[str, Any], name: str, data: Measurements) -> Array:
    """(k, m, 3) errors of a name as they stand in a file [m].  Raises ValueError."""
    told = 1e-3 * numbers(given["errors_mm"][name])
    if told.shape != data.y.shape:
        raise ValueError(f"errors_mm.{name} differs in length")
    if np.nanmax(np.abs(told), initial=0.0) > FARTHEST:
        raise ValueError(f"errors_mm.{name} holds a distance that no instrument measures")
    return np.moveaxis(np.where(np.isfinite(told), told, np.nan), 1, 0)


def errors_of(cell: Cell | None, data: Measurements, told: Array) -> Array:
    """(k, m, 3) errors of a cell [m]: worked out, or as they stand in a file that lacks columns of
    the measurements which its effects look at.
    """  # fmt: skip
    if cell is None or not data.poses:
        return told
    exact = cell.error(data)
    same = np.nanmax(np.abs(exact - told), initial=0.0) <= NEAR
    return exact if same else told


def in_si(p: Parameter) -> Parameter:
    """A parameter of a file, its millimetres as metres."""
    if p.unit != "mm":
        return p
    return replace(
        p, value=1e-3 * p.value, nominal=1e-3 * p.nominal, sigma=1e-3 * p.sigma, unit="m"
    )


def parameter_names(parameters: Parameters, cell: Cell) -> Names:
    """All names in their order."""
    effects = tuple(p.name for p in parameters if p.of_effect)
    return Names.of(cell.robot, cell.target_names, effects)


def identification_of(part: FitPart, parameters: Parameters, names: Names) -> Identification:
    """What was identified, and why the rest was not."""
    active = np.zeros(names.count, dtype=bool)
    for p in parameters:
        active[names.index(p.name)] = p.identifiable
    return Identification(
        active=active,
        reasons={p.name: p.reason for p in parameters if p.reason},
        singular=part.arrays["singular"],
        scale=part.arrays["sensitivity"],
    )


def intervals_of(part: FitPart) -> dict[str, tuple[Interval, Interval]]:
    """Of RMS and largest error on poses like those held out [m]."""

    def in_metres(ends: tuple[float, float]) -> Interval:
        return Interval(1e-3 * ends[0], 1e-3 * ends[1])

    return {
        name: (in_metres(scores.rms_ci95_mm), in_metres(scores.max_ci95_mm))
        for name, scores in (("nominal", part.accuracy.nominal), ("holdout", part.accuracy.holdout))
    }


def minimax_of(part: FitPart) -> WorstCase | None:
    """What the minimax rests on, where there was one."""
    worst = part.minimax
    if worst is None:
        return None
    size = worst.size or (math.nan,) * len(worst.functions)
    if not len(worst.functions) == len(worst.multipliers) == len(size):
        raise ValueError("minimax: functions and multipliers differ in number")
    return WorstCase(
        functions=worst.functions,
        size=np.array(size),
        multiplier=np.array(worst.multipliers),
        active=worst.active,
        distances=tuple(
            KeptDistance(d.pair, 1e-3 * d.measured_mm, 1e-3 * d.tolerance_mm, d.multiplier)
            for d in worst.distances
        ),
        kkt=worst.kkt,
        iterations=worst.iterations,
        trace=worst.trace,
    )


def certificate_of(part: CertificatePart | None) -> Certificate | None:
    """Of the worst point, where it was the objective."""
    if part is None:
        return None
    return Certificate(
        target=tuple(point.target for point in part.points),
        line=np.array([point.line for point in part.points], dtype=int),
        multiplier=np.array([point.multiplier for point in part.points]),
        distance=1e-3 * np.array([point.distance_mm for point in part.points]),
        kkt=part.kkt,
        value=1e-3 * part.value_mm,
        bound=1e-3 * part.bound_mm,
    )


def suspect_of(part: SuspectPart, data: Measurements, held: Array) -> Suspect:
    """A point that stands out."""
    rows = np.flatnonzero(data.line[held == part.held] == part.line)
    return Suspect(
        line=part.line,
        target=part.target,
        pose=int(rows[0]) if len(rows) else -1,
        distance=1e-3 * part.distance_mm,
        score=part.score,
        p_value=part.chance,
        together=part.together,
        held=part.held,
    )
