"""Everything that a calibration knows: what was found, how well it does, where it came from."""

from __future__ import annotations

import math
import platform
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import cache, cached_property
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, overload

import numpy as np
import scipy

from minimax_cal.core.arrays import Array, rms
from minimax_cal.core.display_text import capitalise_sentence, format_counts_largest_first
from minimax_cal.core.files import read_saved_result_json
from minimax_cal.core.record_fields import (
    SEPARATE_FIELD_FORMAT,
    FieldFormat,
    LazyValue,
    derived_field,
    format_record_fields,
    record_to_file_values,
    scale_numbers,
)
from minimax_cal.core.record_parsing import parse_array, parse_as_type, parse_record
from minimax_cal.core.results import Result
from minimax_cal.core.tables import Table, drop_empty_tables
from minimax_cal.fitting.accuracy import (
    IS_HELD_BY_KEY,
    UNKNOWN_ENDS,
    UNKNOWN_INTERVAL,
    Accuracy,
    Interval,
    accuracy_before_and_after,
    split_errors_by_key,
    summarise_point_errors,
    with_intervals,
)
from minimax_cal.fitting.contradiction import Contradiction
from minimax_cal.fitting.cross_validation import (
    NO_CROSS_VALIDATED_ERRORS,
    UnseenAccuracy,
    error_intervals,
)
from minimax_cal.fitting.identification import Identification
from minimax_cal.fitting.joint_spans import JointSpan, measure_joint_spans
from minimax_cal.fitting.minimax_problem import Certificate, TargetDistanceLimits, trusted_distances
from minimax_cal.fitting.options import Options, read_options
from minimax_cal.fitting.outliers import Outlier, mask_outliers, outlier_table
from minimax_cal.fitting.parameter_results import (
    Parameter,
    Parameters,
    effect_parameter_table,
    geometry_parameter_table,
)
from minimax_cal.fitting.pose_records import (
    build_pose_records,
    compute_or_restore_errors,
    parse_measured_poses,
)
from minimax_cal.fitting.region_holdout import RegionHoldout
from minimax_cal.fitting.session_changes import SessionChange
from minimax_cal.fitting.set_aside_points import describe_points_set_aside
from minimax_cal.fitting.uncertainty import Estimator, Uncertainty, uncertainty_from_dict
from minimax_cal.measuring.measurements import Measurements, SetAsidePoint
from minimax_cal.measuring.pose_groups import cluster_poses, group_for_holdout
from minimax_cal.measuring.visit_history import add_history_columns
from minimax_cal.modelling.cell import Cell, cell_from_dict
from minimax_cal.modelling.cell_frames import (
    WITH_EFFECTS_SUFFIX,
    build_cell_frame_tables,
    build_cell_frames,
    format_frame_name,
    name_frames_with_effects,
)
from minimax_cal.modelling.effects.effect_names import format_effect
from minimax_cal.modelling.effects.scene import joint_index_from_place
from minimax_cal.modelling.effects.table import EFFECTS
from minimax_cal.modelling.effects_in_model import extend_model_with_effects
from minimax_cal.modelling.parameters import ParameterNames
from minimax_cal.modelling.point_model import NO_POSE_MIX, build_point_model, pose_error_weights
from minimax_cal.robots.robot import Robot
from minimax_cal.robots.transforms import ABC_ANGLES_CONVENTION, Frame, build_frame_tables
from minimax_cal.solvers.linearisation import Kkt
from minimax_cal.solvers.minimax import Step
from minimax_cal.solvers.status import Status

if TYPE_CHECKING:  # it imports this module
    from minimax_cal.fitting.multi_instrument.relative_result import RelativeCalibration

POSE_ARRAY_NAMES = ("weights", "share", "crossed", "drawn crossed")  # arrays of a file
VERSIONED_PACKAGES = ("minimax-cal", "numpy", "scipy", "qpsolvers")
ACCURACY_TITLES_AND_KEYS = (  # where accuracy is told: title, key
    ("held out, nominal", "nominal"),
    ("held out, calibrated", "holdout"),
    ("training, nominal", "nominal_train"),
    ("training, calibrated", "train"),
)
FIRST_SCREEN_FRAMES = ("base", "tool")  # frames on the first screen
MAX_SILENT_QP_RESIDUAL = 1e-6  # a QP answered worse than this is told


@dataclass(frozen=True)
class Provenance:
    """Where a result came from, so that it can be had again."""

    robot: str = ""
    data: str = ""
    data_sha256: str = ""
    settings: Mapping[str, Any] = field(default_factory=dict)
    versions: Mapping[str, str] = field(default_factory=dict)

    @staticmethod
    def from_run(robot: Robot, data: Measurements, settings: Mapping[str, object]) -> Provenance:
        """Of this run, on this machine."""
        return Provenance(robot.name, data.source, data.digest, dict(settings), package_versions())


@cache
def package_versions() -> Mapping[str, str]:
    """Of the packages that a result depends on: asked once, for it takes as long as a fit."""
    loaded = {"numpy": np.__version__, "scipy": scipy.__version__}
    found = {name: loaded.get(name) or version(name) for name in VERSIONED_PACKAGES}
    return found | {"python": platform.python_version()}


@dataclass(frozen=True)
class KeptDistance:
    """A distance between two targets that the minimax keeps [m]."""

    pair: tuple[str, str]
    measured: Annotated[float, FieldFormat(key="measured_mm", scale=1e3)]
    tolerance: Annotated[float, FieldFormat(key="tolerance_mm", scale=1e3)]
    multiplier: float

    @property
    def target_pair_text(self) -> str:
        """Which targets, for people."""
        return " - ".join(self.pair)


@dataclass(frozen=True, eq=False)
class WorstCase:
    """What the minimax rests on: targets, or points by line of the file.

    functions: of every target, or of the points with a multiplier.  size: F_i [mm^2], or distance
    [mm], of each.  active: those that equal the largest, named.  trace: a step a QP.
    """

    functions: tuple[str, ...]
    size: Array
    multiplier: Annotated[Array, FieldFormat(key="multipliers")]
    active: tuple[str, ...]
    distances: tuple[KeptDistance, ...]
    kkt: Kkt
    iterations: int
    trace: tuple[Step, ...]

    def __post_init__(self) -> None:
        if not len(self.functions) == len(self.size) == len(self.multiplier):
            raise ValueError("functions, their sizes and multipliers differ in number")

    def table(self) -> Table:
        """Errors of targets or points, multipliers (they sum to one), activity."""
        active = (name in self.active for name in self.functions)
        return Table.from_rows(
            "what the worst error on the training poses rests on; targets compare by F_i over the "
            "number of their points",
            zip(self.functions, self.size, self.multiplier, active, strict=True),
            "error of | F_i mm^2, of a point mm .4f | multiplier .4f | is the worst",
        )


@dataclass(frozen=True)
class SolverWork:
    """What the solvers did.

    least_squares: the method that led to the start of the minimax.  steps: of it.
    qps: quadratic programs.  warm_starts: those of them that began at the answer to the last one.
    qp_residual: the largest relative residual of an answer that was used.
    """

    least_squares: str = ""
    steps: int = 0
    qps: int = 0
    warm_starts: int = 0
    qp_residual: float = 0.0


@dataclass(frozen=True, eq=False, repr=False)
class Fit(Result):
    """A calibrated robot and everything that is known about its fit.

    A field is in the file by itself unless it is `SEPARATE_FIELD_FORMAT`, as is a property that is
    `derived_field`; what has words is shown in the terminal, the report and the page.

    cell: the calibrated robot with base, targets and effects, all fitted together; it predicts.
    nominal: the nominal robot with its best base and targets.
    accuracy: nominal and holdout on the held-out poses, nominal_train and train on the training
    poses, holdout_with_them with the points set aside.  claim: looks for `beyond`.
    uncertainty: of all parameters, base in its own axes [SI].
    minimax: what the worst rests on, if it was the objective.  certificate: how far the worst point
    is from its optimum.  trace: cost at each iterate of the least squares [m^2].
    data: all m poses, with their history where effects need it; none where the file was written
    without them.
    held: (m,) True where held out.  error_nominal, error: (m, k, 3) measured minus predicted, NaN
    where not measured [m].
    loss: of the least squares.  suspects: training points that are outliers of the fit.
    weights: (k, training poses) of the points besides their u95, 0 where set aside.  share: (k,)
    weight of each target, or (k, training poses) of each point, in the objective.  prior: (p,)
    weight of each parameter's nominal value.  widening: what a robust loss adds to all sigmas.
    error_crossed: (m, k, 3) of every pose by a fit without it [m], empty unless cross-validated;
    error_drawn_crossed: the same of the drawn arm.
    reason: why it failed or keeps the drawn arm, and what to do; empty where neither.
    contradictions: of the files, each a session.
    set_aside: points that take no part.
    answered: quadratic programs by the backend that answered.  work: what the solvers did.
    moved: what changed between sessions.
    stated_geometric: `geometric` as the file of the fit holds it.
    """

    KIND = "calibration"
    COMMAND = "calibrate"

    cell: Annotated[Cell, SEPARATE_FIELD_FORMAT]
    nominal: Annotated[Cell, SEPARATE_FIELD_FORMAT]
    objective: str
    qp: str
    status: Status
    iterations: Annotated[int, FieldFormat("{} iterations")]
    seconds: Annotated[float, FieldFormat("{:.2f} s")]
    parameters: Annotated[Parameters, SEPARATE_FIELD_FORMAT]
    accuracy: Annotated[Mapping[str, Accuracy], SEPARATE_FIELD_FORMAT]
    identification: Annotated[Identification, SEPARATE_FIELD_FORMAT]
    uncertainty: Annotated[Uncertainty, SEPARATE_FIELD_FORMAT]
    minimax: Annotated[WorstCase | None, FieldFormat(brief=True)]
    certificate: Annotated[Certificate | None, FieldFormat(brief=True)]
    trace: Annotated[tuple[float, ...], FieldFormat(key="trace_mm2", scale=1e6)]
    data: Annotated[Measurements, SEPARATE_FIELD_FORMAT]
    held: Annotated[Array, SEPARATE_FIELD_FORMAT]
    error_nominal: Annotated[Array, SEPARATE_FIELD_FORMAT]
    error: Annotated[Array, SEPARATE_FIELD_FORMAT]
    notices: tuple[str, ...]
    loss: str
    suspects: tuple[Outlier, ...]
    weights: Annotated[Array, SEPARATE_FIELD_FORMAT]
    share: Annotated[Array, SEPARATE_FIELD_FORMAT]
    prior: Annotated[Array, SEPARATE_FIELD_FORMAT]
    widening: float
    provenance: Provenance
    claim: Annotated[LazyValue[RegionHoldout], SEPARATE_FIELD_FORMAT]
    error_crossed: Annotated[Array, SEPARATE_FIELD_FORMAT] = field(
        default_factory=NO_CROSS_VALIDATED_ERRORS.copy
    )
    set_aside: tuple[SetAsidePoint, ...] = ()
    answered: Mapping[str, int] = field(default_factory=dict)
    work: SolverWork = SolverWork()
    stated_geometric: Annotated[Cell | None, SEPARATE_FIELD_FORMAT] = None
    error_drawn_crossed: Annotated[Array, SEPARATE_FIELD_FORMAT] = field(
        default_factory=NO_CROSS_VALIDATED_ERRORS.copy
    )
    reason: str = ""
    moved: Annotated[tuple[SessionChange, ...], FieldFormat(key="between_sessions")] = ()
    contradictions: tuple[Contradiction, ...] = ()

    @classmethod
    def build(
        cls, cell: Cell, nominal: Cell, data: Measurements, held: Array,
        errors: tuple[Array, Array], settings: Mapping[str, Any], uncertainty: Uncertainty,
        **fields: Any,
    ) -> Fit:  # fmt: skip
        """A result, with what follows from its two arms at all poses, and from its settings.

        errors: (m, k, 3) of the nominal and the calibrated arm [m].  fields: the others; those not
        given are of least squares of all training points, without priors.  accuracy: what is to be
        added to that of these errors.
        """
        scores = {
            key: summarise_point_errors(error)
            for key, error in split_errors_by_key(*errors, held).items()
        }
        derived_fields: dict[str, Any] = {
            "cell": cell,
            "nominal": nominal,
            "objective": settings["objective"],
            "qp": settings["qp"],
            "uncertainty": uncertainty,
            "minimax": None,
            "certificate": None,
            "trace": (),
            "data": data,
            "held": held,
            "error_nominal": errors[0],
            "error": errors[1],
            "loss": settings["loss"],
            "suspects": (),
            "weights": data.take(~held).seen.T.astype(float),
            "share": np.ones(len(data.target_names)),
            "prior": np.zeros(uncertainty.names.parameter_count),
            "widening": 1.0,
            "provenance": Provenance.from_run(nominal.robot, data, settings),
        }
        accuracies = scores | fields.pop("accuracy", {})
        return cls(**derived_fields | fields, accuracy=accuracies)

    def __repr__(self) -> str:
        after, known = self.within.after, sum(p.identifiable for p in self.parameters)
        return (
            f"<Fit of {self.cell.robot.name}: {self.objective}, RMS {after.rms_mm:.3f} mm, largest "
            f"{after.max_mm:.3f} mm, {known} of {len(self.parameters)} parameters, {self.status}>"
        )

    @property
    def robot(self) -> Robot:
        """The calibrated robot of geometry alone, usable wherever a robot is.

        Beside effects it is fitted without them: that of `cell` is right only together with them.
        The drawn one where its status keeps that.
        """
        return self.usable_cell.robot

    @property
    def usable_cell(self) -> Cell:
        """The arm to use: `geometric`, or the drawn one in its place where that is kept."""
        return self.nominal if self.status.keeps_drawn else self.geometric

    @cached_property
    def geometric(self) -> Cell:
        """The geometry fitted alone, in its place; `cell` itself where the fit has no effects.

        Fitted when it is first asked for, from the same poses with the same options.
        """
        if self.stated_geometric is not None:
            return self.stated_geometric
        if not self.cell.effects.cause_terms:
            return self.cell
        from minimax_cal.fitting.calibrate import refit_with_options

        return refit_with_options(self, effects=()).cell

    @property
    def train(self) -> Measurements:
        """The training poses."""
        return self.data.take(~self.held)

    @cached_property
    def beyond(self) -> RegionHoldout:
        """On whole parts that were left out; looked for when it is first asked for."""
        return self.claim.value

    @property
    def spans(self) -> tuple[JointSpan, ...]:
        """How far each joint went in the training poses."""
        train = self.train
        return measure_joint_spans(self.cell.robot, train) if train.poses else self.beyond.spans

    @property
    def errors(self) -> Mapping[str, Array]:
        """Errors (m, k, 3) by the keys of `accuracy` [m]."""
        return split_errors_by_key(self.error_nominal, self.error, self.held)

    @property
    def trusted(self) -> Accuracy:
        """On the held-out points that do not stand out."""
        return summarise_point_errors(
            mask_outliers(self.error, self.data, self.suspects)[self.held]
        )

    @property
    def with_them(self) -> Accuracy | None:
        """How it does where the points that were set aside count; None without any."""
        return self.accuracy.get("holdout_with_them")

    @property
    def covariance(self) -> Array:
        """(p, p) of all parameters, NaN where not identified [SI, base in its own axes]."""
        return self.uncertainty.covariance

    @derived_field("condition {:.3g}")
    def condition(self) -> float:
        """Condition number of what was identified."""
        return self.identification.condition

    @derived_field()
    def advice(self) -> str:
        """What to do where it failed or keeps the drawn arm, else what its status advises."""
        return self.reason or self.status.advice

    @property
    def options(self) -> Options:
        """How it was made, its effects with the variants that were chosen."""
        return read_options(self.provenance.settings, effects=self.cell.effects.terms)

    @property
    def is_after_check(self) -> bool:
        """Whether a check placed it on a few poses, which tell its links only where they moved."""
        return bool(self.provenance.settings.get("after_check"))

    @property
    def group(self) -> Array:
        """(training poses,) rows with one number belong together: a pose, or a cluster of poses."""
        return cluster_poses(self.train)

    @cached_property
    def distances(self) -> TargetDistanceLimits:
        """Between targets, as the believed training points tell them."""
        return trusted_distances(self.train, self.weights, self.options.distance_tolerance)

    @cached_property
    def estimator(self) -> Estimator:
        """How the fit weighed its poses, linear where it ended."""
        train, state = self.train, self.cell.parameter_values
        model = build_point_model(self.nominal.robot, train)
        if self.cell.effects.terms:
            model, _ = extend_model_with_effects(
                model, self.nominal.robot, train, state, self.cell.effects.terms
            )
        model = model.with_active(self.identification.active)
        model = model.with_prior(replace(model.prior, weight=self.prior))
        mix = (
            pose_error_weights(train, self.options.lever)
            if self.objective == "pose"
            else NO_POSE_MIX
        )
        weights = self.weights
        if len(mix):  # a pose needs all of its targets
            weights = np.where(model.measured_mask, weights, 1.0).min(axis=0)
        return Estimator(replace(model, weight=model.weight * weights), self.share, mix)

    @cached_property
    def intervals(self) -> Mapping[str, tuple[Interval, Interval]]:
        """95 % intervals of RMS and largest error on poses like those held out, by key.

        As they are told to people: open above where the poses tell no upper end.
        """
        seen = {key: self.accuracy[key] for key in ("nominal", "holdout")}
        if any(one.rms_ci95_mm for one in seen.values()):
            return {
                key: (
                    Interval(*scale_numbers(one.rms_ci95_mm or UNKNOWN_ENDS, 1e-3)),
                    Interval(*scale_numbers(one.max_ci95_mm or UNKNOWN_ENDS, 1e-3)),
                )
                for key, one in seen.items()
            }
        rng = np.random.default_rng(self.options.seed)
        group = group_for_holdout(self.data, self.options.holdout_by)[self.held]
        return {key: error_intervals(self.errors[key], group, rng) for key in seen}

    @property
    def unjudged(self) -> Array:
        """Lines of the poses that no fit without them judges, where it is cross-validated."""
        if not self.error_crossed.size:
            return np.zeros(0, dtype=int)
        told, judged = (
            np.isfinite(error).any(axis=(1, 2)) for error in (self.error, self.error_crossed)
        )
        return np.asarray(self.data.line[told & ~judged])

    @cached_property
    def within(self) -> UnseenAccuracy:
        """Before and after on poses that the fit had not seen: cross-validated, or held out."""
        group = (
            group_for_holdout(self.data, self.options.holdout_by)
            if self.data.poses
            else np.zeros(0)
        )
        if self.error_crossed.size:
            judged = np.isfinite(self.error_crossed).any(axis=(1, 2))
            after = summarise_point_errors(self.error_crossed)
            drawn = self.error_drawn_crossed
            before = summarise_point_errors(
                np.where(np.isfinite(self.error_crossed), drawn, np.nan)
            )
            missed = len(self.unjudged)
            of = f" of {after.poses + missed}" if missed else ""
            where = f"{after.poses}{of} poses, each judged by a fit without it"
            ends = error_intervals(self.error_crossed, group, self.options.seed)
            return UnseenAccuracy(
                before, after, where, len(np.unique(group[judged])), *ends, missed
            )
        before, after, where = accuracy_before_and_after(self.accuracy)
        if not self.accuracy["holdout"].poses:
            return UnseenAccuracy(before, after, where)
        poses = len(np.unique(group[self.held])) or after.poses
        return UnseenAccuracy(before, after, where, poses, *self.intervals["holdout"])

    def predict(self, q: Array) -> Array:
        """Where the instrument should see each target: (m, k, 3) [m].  q: (m, n) [rad, m]."""
        return self.cell.predict(q)

    def inverse(self, pose: Array, near: Array | None = None) -> Array:
        """Joints (..., n) that bring the flange to poses in the base, effects counted.

        pose: (..., 4, 4) [m].  near: joints to start from, (n,) or (..., n), which choose among the
        ways of the arm [rad, m].  More: `Cell.inverse`; without effects: `Robot.inverse`.
        """
        return self.cell.inverse(pose, near)

    def list_accuracies(self) -> Iterator[tuple[str, Accuracy]]:
        """What the table of accuracy tells, with titles."""
        if self.error_crossed.size:
            yield "cross-validated, nominal", self.within.before
            yield "cross-validated, calibrated", self.within.after
        for title, key in ACCURACY_TITLES_AND_KEYS:
            yield title, self.accuracy[key]
            if key == "holdout" and any(one.held for one in self.suspects):
                yield f"{title}, without suspects", self.trusted
            if key == "holdout" and self.with_them:
                yield f"{title}, with {len(self.set_aside)} set aside", self.with_them

    def accuracy_table(self) -> Table:
        """Accuracy before and after, on the held-out and on the training poses."""
        return Table.from_rows(
            f"{self.cell.robot.name}: position accuracy, objective {self.objective}",
            [(title, a.poses, a.rms_mm, a.mean_mm, a.max_mm, *a.rms_by_target())
             for title, a in self.list_accuracies()],
            "poses | count d | RMS mm .4f | mean mm .4f | max mm .4f",
            *(f"{name} RMS mm .4f" for name in self.cell.target_names),
        )  # fmt: skip

    def first_tables(self) -> tuple[Table, ...]:
        """What stands on the first screen: accuracy in at most six rows, and the frames."""
        first = Table.from_rows(
            f"position error, objective {self.objective}",
            [row for row in self.list_accuracy_rows() if row[1] != 0],
            "error at | poses d | RMS mm .3f | 95 % low .3f | 95 % high .3f | max mm .3f",
        )
        frames, of = self.frames, "" if self.geometric is self.cell else WITH_EFFECTS_SUFFIX
        shown = {name: frames[name + of] for name in FIRST_SCREEN_FRAMES if name + of in frames}
        where = f"base in the instrument's frame, tool in the flange's{format_frame_name(of)}"
        return first, replace(build_frame_tables(shown, "")[0], title=f"{where}; Rz(A) Ry(B) Rx(C)")

    def list_accuracy_rows(self) -> Iterator[tuple[object, ...]]:
        """New poses, inside and outside the measured region, then those of the fit."""
        inside, unknown = self.within, scale_numbers(UNKNOWN_INTERVAL, 1e3)
        if self.error_crossed.size or self.accuracy["holdout"].poses:
            drawn = UNKNOWN_INTERVAL if self.error_crossed.size else self.intervals["nominal"][0]
            for name, seen, ends in (
                ("nominal", inside.before, drawn),
                ("calibrated", inside.after, inside.rms),
            ):
                yield (
                    f"new poses, {name}",
                    seen.poses,
                    seen.rms_mm,
                    *scale_numbers(ends, 1e3),
                    seen.max_mm,
                )
        if self.beyond.worst:
            away = self.beyond
            yield "outside, calibrated", "", away.typical_mm, None, None, away.largest_mm
        for key, name in (("nominal_train", "nominal"), ("train", "calibrated")):
            seen = self.accuracy[key]
            yield f"training poses, {name}", seen.poses, seen.rms_mm, *unknown, seen.max_mm

    def interval_table(self) -> Table:
        """95 % intervals of the held-out accuracy; empty where the poses are too few."""
        rows = [
            (title, a.rms_mm, *scale_numbers(rms, 1e3), a.max_mm, *scale_numbers(largest, 1e3))
            for title, key in (("nominal", "nominal"), ("calibrated", "holdout"))
            for a, (rms, largest) in [(self.accuracy[key], self.intervals[key])]
            if math.isfinite(rms.low)
        ]
        dash = any(np.isnan([row[3], row[6]]).any() for row in rows)
        why = "; a dash: too few poses, or too unlike each other, to tell an upper end"
        return Table.from_rows(
            "held out, with 95 % intervals: of the RMS over such poses, of the largest error of as "
            f"many new ones{why if dash else ''}",
            rows,
            "robot | RMS mm .4f | from .4f | to .4f | max mm .4f | from .4f | to .4f",
        )

    @property
    def frames(self) -> dict[str, Frame]:
        """Where base and tool stand, those of the drawn arm, and the corrections:
        `build_cell_frames`.

        They go with `robot`; those that go with the effects of the `cell` stand beside them.
        """
        out = build_cell_frames(self.geometric, self.nominal)
        if self.geometric is not self.cell:
            out |= name_frames_with_effects(build_cell_frames(self.cell, self.nominal))
        return out

    def parameter_table(self) -> Table:
        """Every parameter of geometry."""
        return geometry_parameter_table(self.parameters)

    def effect_table(self) -> Table:
        """The parameters of effects beyond geometry, as in the files; empty without any.

        A curve with many is one row: its RMS as the poses show it.
        """
        maps = [term for term in self.cell.effects.terms if EFFECTS[term.effect].is_map]
        labels = tuple(f"{term.label}." for term in maps)
        rows: list[tuple[object, ...]] = []
        if maps:
            scene, effects = self.cell.pose_arm(add_history_columns(self.data)), self.cell.effects
            for term in maps:
                at = effects.terms.index(term)
                own = effects.values[at]
                first = len(self.covariance) - sum(map(len, effects.values[at:]))
                part = slice(first, first + len(own))

                each = term.columns(scene).turn[:, joint_index_from_place(term.place)]
                sigma = ((np.nan_to_num(self.covariance[part, part]) @ each) * each).sum(axis=0)
                sizes = rms(own @ each), float(np.sqrt(sigma.mean()))
                rows.append((f"{format_effect(*term.key)}, RMS", "rad", *sizes, ""))
        plain = effect_parameter_table(p for p in self.parameters if not p.name.startswith(labels))
        return plain.with_rows(*rows)

    def sentences(self) -> tuple[str, ...]:
        """The result: what went wrong if anything, inside, set aside, outside, identified."""
        before, after, where = self.within.before, self.within.after, self.within.where
        count, identified = len(self.parameters), sum(p.identifiable for p in self.parameters)
        rest = ", the others stay nominal" if identified < count else ""
        advice = "" if self.reason else self.advice
        who = (
            f"; quadratic programs of the minimax: {self.describe_qp_backends()}"
            if self.answered
            else ""
        )
        every = (
            f"{capitalise_sentence(self.reason)}." if self.reason else "",
            f"RMS error {before.rms_mm:.3f} mm -> {after.rms_mm:.3f} mm, largest "
            f"{before.max_mm:.3f} mm -> {after.max_mm:.3f} mm, on {where}.",
            self.describe_points_set_aside() if self.set_aside else "",
            self.beyond.sentence(),
            f"{identified} of {count} parameters identified{rest}; {self.status}{who}.",
            f"{advice}." if advice else "",
        )
        return tuple(sentence for sentence in every if sentence)

    def headline(self) -> str:
        """The result in a few sentences."""
        return " ".join(self.sentences())

    def describe_solution(self) -> str:
        """How the fit was found: what its facts say, and who answered the QPs."""
        facts, work = f"{capitalise_sentence(format_record_fields(self))}.", self.work
        if not self.answered:
            return facts
        steps = f"{work.steps} steps of least squares ({work.least_squares})"
        return (
            f"{facts} QPs: {self.describe_qp_backends()} "
            f"({work.warm_starts} warm-started), after {steps}."
        )

    def describe_qp_backends(self) -> str:
        """Backends with the number of QPs they answered, and how rough the answers were."""
        who = format_counts_largest_first(self.answered)
        residual = self.work.qp_residual
        if residual > MAX_SILENT_QP_RESIDUAL:
            who += f" (used as they are, relative residual up to {residual:.1g})"
        return who

    def describe_points_set_aside(self) -> str:
        """How many points were set aside, by whom, and the error with them."""
        return describe_points_set_aside(self.set_aside, self.with_them)

    def tables(self) -> tuple[Table, ...]:
        """Every table of the result."""
        worst = None if self.objective == "point" else self.minimax
        return drop_empty_tables(
            self.accuracy_table(),
            self.interval_table(),
            self.beyond.table(),
            *(one.table() for one in (worst, self.certificate) if one),
            *build_cell_frame_tables(self.frames),
            self.effect_table(),
            outlier_table(self.suspects, self.data),
            self.parameter_table(),
        )

    def summary(self, width: int = 110) -> str:
        """The result as plain text."""
        return f"{super().summary(width)}\n\n{self.describe_solution()}"

    # ---- its file ------------------------------------------------------------------------------

    def extra_file_content(self, *, with_measurements: bool = True) -> dict[str, Any]:
        """The arms, the accuracies and, in SI, what later work rests on.

        with_measurements: whether with the measurements, which of many poses are nearly all of it.
        """
        kept = self.usable_cell.whole()
        cell: dict[str, Any] = {"effects": kept.pop("effects")}
        cell = cell if self.usable_cell is self.cell else self.cell.whole()
        crossed = self.error_crossed.size
        arrays = {
            "singular": self.identification.singular,
            "sensitivity": self.identification.scale,
            "prior": self.prior,
            **({"share": self.share} if with_measurements or self.share.ndim == 1 else {}),
            **({"weights": self.weights} if with_measurements else {}),
            **({"crossed": np.swapaxes(self.error_crossed, 0, 1),  # files have targets first
                "drawn crossed": np.swapaxes(self.error_drawn_crossed, 0, 1)}
               if with_measurements and crossed else {}),
        }  # fmt: skip
        errors = {"nominal": self.error_nominal, "final": self.error}
        new = self.within
        judged = record_to_file_values(with_intervals(new.after, new.rms, new.largest))
        judged |= {"not_judged": self.unjudged, "nominal": new.before}
        told = with_measurements and self.data.poses
        return {
            **kept,
            "cell": cell,
            "nominal_robot": self.nominal.robot,
            "nominal_cell": self.nominal,
            "frames": self.frames,
            "frames_convention": ABC_ANGLES_CONVENTION,
            "parameters": self.parameters.every,
            "accuracy": {
                **{
                    key: with_intervals(seen, *self.intervals[key])
                    if key in self.intervals
                    else seen
                    for key, seen in self.accuracy.items()
                },
                "holdout_trusted": self.trusted,
                "beyond": self.beyond,
                **({"cv": judged} if crossed else {}),
            },
            "covariance": self.uncertainty,
            "arrays": arrays,
            **({"poses": build_pose_records(self.data, self.held, errors)} if told else {}),
        }

    @classmethod
    def parse_extra_fields(
        cls, content: Mapping[str, Any], parsed_fields: Mapping[str, Any], source: str
    ) -> dict[str, Any]:
        """The arms, the poses and what later work rests on, from a file."""
        read_options(parsed_fields["provenance"].settings)  # what later work rests on
        cell = cell_from_dict(content, source)
        drawn = {"robot": content["nominal_robot"], **content["nominal_cell"]}
        nominal = cell_from_dict(drawn, f"{source}: nominal_cell")
        data, held, errors = parse_measured_poses(content, source, cell, "nominal")
        known = uncertainty_from_dict(content, cell, source)
        every = parse_as_type(
            tuple[Parameter, ...], content["parameters"], FieldFormat(), "parameters"
        )
        parameters = Parameters(every, known.dof)
        names = ParameterNames.for_robot(
            cell.robot, cell.target_names, tuple(p.name for p in every if p.is_of_effect)
        )
        if missing := set(names.all_names) - set(parameters.names):
            raise ValueError(f"parameters: {min(missing)} is missing, of {len(missing)}")
        scores = content["accuracy"]
        beyond = parse_record(RegionHoldout, scores["beyond"], "accuracy.beyond")
        keys = [
            *IS_HELD_BY_KEY,
            *(["holdout_with_them"] if scores.get("holdout_with_them") else []),
        ]
        accuracies = {
            key: parse_record(Accuracy, scores.get(key), f"accuracy.{key}") for key in keys
        }
        target_count = len(cell.target_names)
        for key, seen in accuracies.items():
            if not len(seen.sse_mm2) == len(seen.counts) == target_count:
                raise ValueError(f"accuracy.{key} is not of {target_count} targets")
        arrays = {name: parse_array(value, name) for name, value in content["arrays"].items()}
        check_array_shapes(arrays, names.parameter_count, data.take(~held), data)
        crossed, drawn_crossed = (
            np.swapaxes(arrays.get(name, NO_CROSS_VALIDATED_ERRORS), 0, 1)
            for name in ("crossed", "drawn crossed")
        )
        kept = parsed_fields["status"].keeps_drawn or not cell.effects.cause_terms
        active = np.zeros(names.parameter_count, dtype=bool)
        active[[names.index_of_name(p.name) for p in every]] = [p.identifiable for p in every]
        reasons = {p.name: p.reason_record for p in every if p.reason}
        return {
            "cell": cell,
            "nominal": nominal,
            "parameters": parameters,
            "accuracy": accuracies,
            "claim": LazyValue(lambda: beyond),
            "identification": Identification(
                active, reasons, arrays["singular"], arrays["sensitivity"]
            ),
            "uncertainty": known,
            "data": replace(data, digest=parsed_fields["provenance"].data_sha256),
            "held": held,
            "error_nominal": compute_or_restore_errors(nominal, data, errors[0]),
            "error": compute_or_restore_errors(cell, data, errors[1]),
            "weights": arrays.get("weights", data.take(~held).seen.T.astype(float)),
            "share": arrays.get("share", np.ones(len(cell.target_names))),
            "prior": arrays["prior"],
            "error_crossed": crossed if data.poses else NO_CROSS_VALIDATED_ERRORS,
            "error_drawn_crossed": drawn_crossed,
            "stated_geometric": None if kept else cell_from_dict({**content, "cell": {}}, source),
        }


def check_array_shapes(
    arrays: Mapping[str, Array],
    parameter_count: int,
    training_data: Measurements,
    data: Measurements,
) -> None:
    """Raise ValueError for arrays that are not of these parameters and poses."""
    k, m = len(data.target_names), training_data.poses
    every = (k, data.poses, 3)
    shapes: dict[str, tuple[tuple[int, ...], ...]] = {
        "sensitivity": ((parameter_count,),), "prior": ((parameter_count,),), "weights": ((k, m),),
        "share": ((k,), (k, m)), "crossed": (every,), "drawn crossed": (every,)
    }  # fmt: skip
    if arrays["singular"].ndim != 1 or not arrays["singular"].size:
        raise ValueError("singular is not a row of numbers")
    for name, values in arrays.items():
        known = shapes.get(name, (values.shape,))
        asked = data.poses or name not in POSE_ARRAY_NAMES
        if values.shape not in known and asked:
            raise ValueError(f"{name} is not of these parameters and poses")


@overload
def load_fit(path: Fit) -> Fit: ...
@overload
def load_fit(path: Path | str) -> Fit | RelativeCalibration: ...
def load_fit(path: Fit | Path | str) -> Fit | RelativeCalibration:
    """A calibration from its file, whole.

    Parameters
    ----------
    path
        What `Fit.save` or `minimax-cal calibrate -o` wrote; a calibration stays as it is.

    Returns
    -------
    Fit | RelativeCalibration
        The calibration, whole.  A `RelativeCalibration` where the data were not points of trackers
        alone.

    Raises
    ------
    CalibrationError
        For a file that is none.

    Examples
    --------
    >>> print(mc.load_fit("fit.json").summary())
    """
    if isinstance(path, Fit):
        return path
    content = read_saved_result_json(path)
    if "measured" in content and content.get("kind") != Fit.KIND:
        from minimax_cal.fitting.multi_instrument.relative_result import (
            read_result,
        )  # it knows this file

        return read_result(content, str(path))
    return Fit.from_dict(content, str(path))
