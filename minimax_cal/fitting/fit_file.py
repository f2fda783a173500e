"""The file of a fit: what `Fit.to_dict` writes and `Fit.from_dict` reads.

Each number is there once: in millimetres what people read, in SI, under `arrays`, what no person
asks for.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Annotated, Any

import numpy as np

from minimax_cal.fitting.beyond import Beyond, Fold, Trusted
from minimax_cal.fitting.crossed import NOT_CROSSED
from minimax_cal.fitting.fit import Fit, Parameter, Parameters
from minimax_cal.fitting.identify import Identification
from minimax_cal.fitting.intervals import Interval
from minimax_cal.fitting.options import read_options
from minimax_cal.fitting.set_aside import WithThem
from minimax_cal.fitting.uncertainty import uncertainty_from_dict
from minimax_cal.ground.arrays import Array
from minimax_cal.ground.errors import CalibrationError, said
from minimax_cal.ground.facts import derived_facts, from_file, in_file, stored_facts
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
    part_with,
)
from minimax_cal.measuring.accuracy import Accuracy
from minimax_cal.measuring.measurements import FARTHEST, Measurements
from minimax_cal.measuring.pose_rows import pose_rows, read_poses
from minimax_cal.measuring.spans import Span
from minimax_cal.modelling.cell import Cell, cell_from_dict
from minimax_cal.modelling.parameters import Names
from minimax_cal.robots.frames import CONVENTION
from minimax_cal.solvers.status import Status

SCHEMA = 1
CROSSED = ("crossed", "drawn crossed")
POSE_BY_POSE = ("weights", "share", *CROSSED)
NEAR = 1e-6  # a file's own errors come back to this, or it lacks columns of the measurements [m]


# ---- what stands in the file -------------------------------------------------------------------


class ScoresPart(Part):
    """Accuracy on some poses, with its 95 % intervals where they are known [mm, mm^2]."""

    rms_mm: Number
    max_mm: Number
    mean_mm: Number
    poses: Count
    sse_mm2: tuple[Square, ...]
    points: tuple[Count, ...]
    rms_ci95_mm: Ends = UNKNOWN
    max_ci95_mm: Ends = UNKNOWN

    def accuracy(self) -> Accuracy:
        """As the code has it."""
        return Accuracy(
            self.rms_mm, self.max_mm, self.mean_mm, self.poses, self.sse_mm2, self.points
        )


class GeometricPart(Part):
    """The same of geometry alone [mm]."""

    typical_mm: Number


class BeyondPart(Part):
    """On parts that were left out [mm]."""

    folds: tuple[Recorded[Fold], ...]
    typical_mm: Number
    geometric: GeometricPart
    reason: str = ""
    worst_high95_mm: Number
    max_high95_mm: Number
    not_judged: tuple[str, ...]
    effects_sought_anew: bool | None
    without_suspects: Recorded[Trusted] | None
    spans: tuple[Recorded[Span], ...]
    plan: str | None

    def beyond(self) -> Beyond:
        """As the code has it."""
        return Beyond(
            folds=self.folds,
            typical_mm=self.typical_mm,
            geometric_typical_mm=self.geometric.typical_mm,
            reason=self.reason,
            rms_high_mm=self.worst_high95_mm,
            max_high_mm=self.max_high95_mm,
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
    beyond: BeyondPart

    def told(self) -> Iterator[tuple[str, ScoresPart]]:
        """All but `beyond`, with their names."""
        return ((name, part) for name, part in self if isinstance(part, ScoresPart))


TableParameter = Annotated[Parameter, Gaps(required=("value",))]  # in its unit: mm, rad, ...


class OwnPart(Part):
    """What of a fit's file is no fact by itself."""

    parameters: tuple[TableParameter, ...]
    accuracy: AccuraciesPart
    cell: dict[str, Any]
    nominal_robot: dict[str, Any]
    nominal_cell: dict[str, Any]
    covariance: dict[str, Any]
    arrays: dict[str, Values]


FitPart = part_with("FitPart", OwnPart, Fit)  # the file of `minimax-cal calibrate -o`


# ---- writing -----------------------------------------------------------------------------------


def written(fit: Fit, *, poses: bool = True) -> dict[str, Any]:
    """The JSON of the contract, and more.  poses: whether with what was measured."""
    out: dict[str, Any] = {"schema": SCHEMA, "kind": "calibration", **fit.kept.whole()}
    out["cell"] = {"effects": out.pop("effects")}
    if fit.kept is not fit.cell:
        out["cell"] = fit.cell.whole()
    facts = in_file(fit, {**stored_facts(Fit), **derived_facts(Fit)})
    out |= {
        "nominal_robot": fit.nominal.robot.to_dict(),
        "nominal_cell": fit.nominal.to_dict(),
        "frames": {name: frame.to_dict() for name, frame in fit.frames.items()},
        "frames_convention": CONVENTION,
        **{key: plain(value) for key, value in facts.items() if value is not None},
        "parameters": [p.to_dict() for p in fit.parameters],
        "accuracy": {
            **{
                key: value.to_dict() | ends_in_mm(fit.intervals.get(key, ()))
                for key, value in fit.accuracy.items()
            },
            **({"holdout_with_them": fit.with_them.to_dict()} if fit.with_them else {}),
            "holdout_trusted": fit.trusted.to_dict(),
            "beyond": fit.beyond.to_dict(),
            **({"cv": crossed_to_dict(fit)} if fit.error_crossed.size else {}),
        },
        "covariance": fit.uncertainty.to_dict(),
        "arrays": arrays_of(fit, poses=poses),
    }
    if fit.data.poses and poses:
        errors = {"nominal": fit.error_nominal, "final": fit.error}
        out["poses"] = pose_rows(fit.data, fit.held, errors)
    return out


def ends_in_mm(intervals: Sequence[Interval]) -> dict[str, list[float | None]]:
    """Intervals of the RMS and of the largest error, where there are any."""
    return {
        name: [finite(1e3 * interval.low), finite(1e3 * interval.high)]
        for name, interval in zip(("rms_ci95_mm", "max_ci95_mm"), intervals, strict=False)
    }


def crossed_to_dict(fit: Fit) -> dict[str, Any]:
    """The cross-validated accuracy."""
    return {
        **fit.within.after.to_dict(),
        "not_judged": [int(x) for x in fit.unjudged],
        "nominal": fit.within.before.to_dict(),
        **ends_in_mm((fit.within.rms, fit.within.largest)),
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
    """A fit from its JSON.  Raises CalibrationError, or one of FAULTS."""
    check_schema(content, source, SCHEMA)
    part = checked(FitPart, content, source)
    facts = from_file(part, stored_facts(Fit))
    read_options(facts["provenance"].settings)  # what later work rests on
    cell = cell_from_dict(content, source)
    drawn = {"robot": part.nominal_robot, **part.nominal_cell}
    nominal = cell_from_dict(drawn, f"{source}: nominal_cell")
    data, held, told = measured_poses(content, source, cell, "nominal")
    known = uncertainty_from_dict(content, cell, source)
    parameters = Parameters(tuple(in_si(p) for p in part.parameters), known.dof)
    names = parameter_names(parameters, cell)
    crossed, drawn_crossed = (
        part.arrays.get(name, NOT_CROSSED) if data.poses else NOT_CROSSED for name in CROSSED
    )
    train, k = data.take(~held), len(cell.target_names)
    check_numbers(part, cell, source)
    check_shapes(part.arrays, names.count, train, data)
    if missing := set(names.all) - {p.name for p in parameters}:
        raise ValueError(f"parameters: {min(missing)} is missing, of {len(missing)}")
    return Fit(
        **facts,
        cell=cell,
        nominal=nominal,
        parameters=parameters,
        accuracy={key: scores.accuracy() for key, scores in part.accuracy.told()},
        identification=identification_of(part, parameters, names),
        uncertainty=known,
        data=replace(data, digest=facts["provenance"].data_sha256),
        held=held,
        error_nominal=errors_of(nominal, data, told[0]),
        error=errors_of(cell, data, told[1]),
        weights=part.arrays.get("weights", train.seen.T.astype(float)),
        share=part.arrays.get("share", np.ones(k)),
        prior=part.arrays["prior"],
        claim=part.accuracy.beyond.beyond,
        stated=intervals_of(part.accuracy),
        error_crossed=crossed,
        error_drawn_crossed=drawn_crossed,
        with_them=with_them_of(part.accuracy.holdout_with_them),
        stated_geometric=geometric_of(content, source, cell, facts["status"]),
    )


def geometric_of(
    content: Mapping[str, Any], source: str, cell: Cell, status: Status
) -> Cell | None:
    """The geometry fitted alone, where the file holds it beside a fit with effects."""
    if not cell.effects.causes or status is Status.NO_BETTER:
        return None
    return cell_from_dict({**content, "cell": {}}, source)


def check_numbers(part: OwnPart, cell: Cell, source: str) -> None:
    """Raise CalibrationError for accuracies that are not of the cell's targets."""
    for name, scores in part.accuracy.told():
        if not len(scores.sse_mm2) == len(scores.points) == len(cell.target_names):
            raise CalibrationError(
                f"{source}: accuracy.{name} is not of {len(cell.target_names)} targets; {AGAIN}"
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


def identification_of(part: OwnPart, parameters: Parameters, names: Names) -> Identification:
    """What was identified, and why the rest was not."""
    active = np.zeros(names.count, dtype=bool)
    for p in parameters:
        active[names.index(p.name)] = p.identifiable
    return Identification(
        active=active,
        reasons={p.name: p.why for p in parameters if p.reason},
        singular=part.arrays["singular"],
        scale=part.arrays["sensitivity"],
    )


def intervals_of(accuracy: AccuraciesPart) -> dict[str, tuple[Interval, Interval]]:
    """Of RMS and largest error on poses like those held out [m]."""

    def in_metres(ends: tuple[float, float]) -> Interval:
        return Interval(1e-3 * ends[0], 1e-3 * ends[1])

    return {
        name: (in_metres(scores.rms_ci95_mm), in_metres(scores.max_ci95_mm))
        for name, scores in (("nominal", accuracy.nominal), ("holdout", accuracy.holdout))
    }
