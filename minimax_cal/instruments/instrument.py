"""An instrument: what was measured at some poses, what is unknown of it, and how it reads an arm.

`names`, `starts`, `read` and the `unit` of the rows are the protocol.  The rest is policy and has a
default: which unknowns redundancy takes first, what an instrument lacks, its columns in a file, its
slips, its words.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar, NamedTuple, Self, TypeVar

import numpy as np

from minimax_cal.core.arrays import Array
from minimax_cal.core.errors import DataError
from minimax_cal.instruments.instrument_options import InstrumentOptions
from minimax_cal.instruments.protocol import FlangePoses, ResidualRows
from minimax_cal.measuring.measurements import Measurements
from minimax_cal.measuring.pose_groups import HoldoutMask, group_repeated_poses, select_holdout_rows
from minimax_cal.modelling.point_model import DEFAULT_TARGET_NAME
from minimax_cal.reading.measurement_table import MeasurementTable
from minimax_cal.robots.joint_sampling import random_joint_values
from minimax_cal.robots.robot import Robot

METRE_UNIT, RADIAN_UNIT = "m", "rad"
SPOT = tuple(
    f"{DEFAULT_TARGET_NAME}_{axis}" for axis in "xyz"
)  # the point on the flange, or the ball
MOVES_NOTHING_REASON = "moves nothing that is measured"
ANGLE_NAME_ENDINGS = ("_rx", "_ry", "_rz", "_tilt1", "_tilt2")  # endings of names
RANDOM_POSE_COUNT = 200  # poses that show what no poses could tell
MIN_LINEAR_START_SINGULAR_VALUE = (
    1e-6  # relative singular value below which a linear start says nothing
)
TARGET_OFFSETS_PER_REACH = (
    0.05,
    0.2,
)  # where the target may be, from the last frame, per metre of reach
ReportedParameter = tuple[str, str, float, float, float]  # name, unit, value, as drawn, sigma [SI]
NOT_READY: Any = None  # what `ready` fills
DataCorrection = tuple[str, "Instrument"]  # what to say, and the measurements with the slip mended
FitNominalArm = Callable[
    ["Instrument"], tuple[Any, FlangePoses, Array]
]  # ready, and fitted as drawn
DistanceLimits = Callable[
    ["Instrument", Array], Array
]  # of each sum, how far priors let it be off [m]


@dataclass(frozen=True)
class InstrumentColumns:
    """How a file of an instrument is known, and read.

    announce: a column that says that the file is of the instrument.  own: every column that `read`
    understands.  written: how these are named, for messages.  yields: whether columns of another
    instrument come first.
    """

    announce: re.Pattern[str]
    own: re.Pattern[str]
    written: str
    read: Callable[[MeasurementTable], Instrument]
    yields: bool = False


@dataclass(frozen=True)
class Words:
    """What a result says of what an instrument measured.

    quantity: what the errors are of.  part: what each row of them is.  caution: what they do not
    say.  counted: its numbers.  check: what to check where they contradict the arm.  more: what
    helps where they tell positions weakly, empty where they are positions.  of_position: whether
    the errors are.  whole: what several of its places are together, for reasons.  fitted: what is
    fitted wherever positions are told.
    """

    quantity: str
    part: str = "part"
    caution: str = ""
    counted: str = "numbers"
    check: str = "the order of the rows"
    more: str = ""
    of_position: bool = False
    whole: str = ""
    fitted: str = "a base is"


class NumberCounts(NamedTuple):
    """How many numbers are behind the errors of training and of held-out rows."""

    train: int
    holdout: int


class FramePose(NamedTuple):
    """Rotations (..., 3, 3) and origins (..., 3) of frames in another [m]."""

    rotation: Array
    origin: Array


class NoticeAndMend(NamedTuple):
    """A notice to the user, and what mends it; both '' for none."""

    notice: str
    mend: str


@dataclass(frozen=True, eq=False)
class Instrument:
    """Joint values, and in a class of each instrument's own what was measured there.

    at: the m poses (q, line, columns), with points where these were measured.

    Of a class: kind: its name.  unit: of its rows in SI, as m, rad or px; noise and accuracy are
    reported in it.  words: what is said of it.  by_row: fields with an entry for each pose; chosen:
    fields that `ready` fills.  file: its columns, None where it has none of its own. options: the
    fields of the options that are its own.  targets_at: where the points on the flange stand among
    its own parameters.  given_up: beginnings of those that redundancy takes first. has_length:
    whether something that it measures is a length.  shrinks: whether an arm that hardly moves fits
    anything.  refines: whether its starts are to be refined.  row_noise: sigma of a row over that
    of a number.  costless_parameter_count: parameters that cost no number.  on_arm: whether a point
    on the flange is among its own.  noise_given: whether the user may say its noise.  alone: what
    to do instead where nothing else is given, empty where it needs nothing else; alone_bends:
    whether effects of the arm are fitted, and sought, in it alone all the same.  unmoved: why a
    link tells nothing that moves nothing.  scale: what it lacks where it has no length standard,
    and what gives it.  lone_names: of its unknowns from the targets on, as people read them, those
    of `single_point_instrument` first.  first_column: the beginning of its first column, for
    messages.
    """

    at: Measurements

    kind: ClassVar[str]
    unit: ClassVar[str] = METRE_UNIT
    words: ClassVar[Words]
    by_row: ClassVar[tuple[str, ...]] = ()
    chosen: ClassVar[tuple[str, ...]] = ()
    file: ClassVar[InstrumentColumns | None] = None
    options: ClassVar[tuple[str, ...]] = ()
    targets_at: ClassVar[slice] = slice(0, 3)
    given_up: ClassVar[tuple[str, ...]] = ()
    shrinks: ClassVar[bool] = False
    refines: ClassVar[bool] = True
    row_noise: ClassVar[float] = 1.0
    on_arm: ClassVar[bool] = True
    noise_given: ClassVar[bool] = True
    alone: ClassVar[str] = ""
    alone_bends: ClassVar[bool] = False
    unmoved: ClassVar[str] = MOVES_NOTHING_REASON
    scale: ClassVar[tuple[str, ...]] = ()
    drawn_scale: ClassVar[bool] = False
    lone_names: ClassVar[tuple[str, ...]] = ()
    first_column: ClassVar[str] = "smr1_x_"

    # ---- the protocol ------------------------------------------------------------------------

    @property
    def names(self) -> tuple[str, ...]:
        """(e,) names of its own unknowns."""
        raise NotImplementedError

    def starts(self, arm: FlangePoses, free_unknowns: Array) -> Sequence[Array]:
        """Values (e,) each from which its own unknowns may be fitted to the arm as drawn.

        free_unknowns: (e,) True where one may be fitted.
        """
        raise NotImplementedError

    def read(self, arm: FlangePoses, unknowns: Array) -> ResidualRows:
        """What was measured minus what it would measure.  unknowns: (e,)."""
        raise NotImplementedError

    # ---- what was measured -------------------------------------------------------------------

    @property
    def poses(self) -> int:
        """Number of rows."""
        return len(self.at.q)

    @property
    def numbers_per_pose(self) -> Array:
        """(m,) how many numbers each row holds: one."""
        return np.ones(self.poses, dtype=int)

    @property
    def point_count(self) -> int:
        """Number of compared points, which turns a sum of squares into a mean motion."""
        return int(self.numbers_per_pose.sum())

    @property
    def degrees_of_freedom(self) -> int:
        """Independent numbers, and as many more as parameters that cost none."""
        return int(self.numbers_per_pose.sum()) + self.costless_parameter_count

    @property
    def costless_parameter_count(self) -> int:
        """Parameters that cost no number."""
        return 0

    @property
    def independent_number_count(self) -> int:
        """How many of the numbers are independent of each other: those of different poses."""
        _, first = np.unique(group_repeated_poses(self.at), return_index=True)
        return int(self.numbers_per_pose[first].sum())

    def count_train_and_holdout_numbers(self, holdout_mask: Array) -> NumberCounts:
        """Numbers behind the errors of training and held-out rows.  holdout_mask: (m,)."""
        return NumberCounts(
            int(self.numbers_per_pose[~holdout_mask].sum()),
            int(self.numbers_per_pose[holdout_mask].sum()),
        )

    def check_data(self) -> None:
        """Raise DataError where no fit can make sense of them: for fields that are no numbers."""
        for name in self.by_row:
            values = np.asarray(getattr(self, name))
            if len(values) != self.poses:
                raise DataError(f"{name} has {len(values)} entries; there are {self.poses} poses")
            if values.dtype.kind == "f" and not np.isfinite(values).all():
                raise DataError(
                    f"{self.row_location(int(np.argwhere(~np.isfinite(values))[0][0]))}: "
                    f"{name} is not a finite number"
                )

    def check_enough_training_data(self) -> None:
        """Raise DataError where they are too few to be fitted."""

    def file_columns(self) -> Mapping[str, Array]:
        """What was measured, by the names of a file's columns and in their units."""
        return {}

    def take_rows(self, rows: Array) -> Self:
        """The measurements at some rows only.  rows: indices or a mask."""
        own = {name: getattr(self, name)[rows] for name in self.by_row}
        return replace(self, at=self.at.take(rows), **own)

    def sort_rows_for_fit(self) -> Self:
        """The rows in the order in which they are fitted."""
        return self

    def rows_for_screening(self) -> Array:
        """Rows that tell one start from another."""
        return np.arange(self.poses)

    def row_location(self, row: int) -> str:
        """Where a row stands, for a message."""
        return f"{self.at.source}:{self.at.line[row]}"

    def holdout_rows_and_notices(self, options: InstrumentOptions) -> HoldoutMask:
        """(m,) True where a row is held out; notices."""
        return select_holdout_rows(self.at, options.holdout, options.seed)

    # ---- what it is in a fit -----------------------------------------------------------------

    def ready(self, robot: Robot, options: InstrumentOptions) -> Self:
        """The instrument with what it chooses before a fit."""
        return self

    def copy_choices_to(self, other: Self) -> Self:
        """Other measurements of it, with what this one has chosen."""
        return replace(other, **{name: getattr(self, name) for name in self.chosen})

    def adapt_to_other_instruments(self, other_instruments: Sequence[Instrument]) -> Self:
        """The instrument in one fit with all of some others."""
        return self

    def with_row_weights(self, row_weights: Array) -> Self:
        """The instrument whose rows have weights (r + c,), where it reads means of them."""
        return self

    @property
    def given_unknown_names(self) -> tuple[str, ...]:
        """Its unknowns that are not fitted, as their values are given."""
        return ()

    @property
    def has_length(self) -> bool:
        """Whether something that it measures is a length."""
        return True

    @property
    def given_number_count(self) -> int:
        """Numbers that are given besides those of the data."""
        return 0

    @property
    def choices_for_record(self) -> Mapping[str, object]:
        """What it has chosen where the user has not, for the record."""
        return {}

    @property
    def units(self) -> tuple[str, ...]:
        """(e,) SI, of its own unknowns."""
        return tuple("rad" if name.endswith(ANGLE_NAME_ENDINGS) else "m" for name in self.names)

    @property
    def measurements_with_points(self) -> Measurements:
        """Its poses, with the points that are compared."""
        return self.at

    @property
    def single_point_instrument(self) -> Instrument | None:
        """One point of what it measures, None where it measures no more."""
        return None

    def single_point_unknowns(self, unknowns: Array) -> Array:
        """(e',) unknowns of `single_point_instrument`, by its own."""
        raise NotImplementedError

    def base_rotation_and_origin(self, unknowns: Array) -> FramePose:
        """Rotation (3, 3) and origin (3,) of the robot's base in its frame [m]."""
        return FramePose(np.eye(3), np.zeros(3))

    def flange_points(self, unknowns: Array) -> Array:
        """(k, 3) points on the flange, its origin where it has none of its own [m]."""
        spots = unknowns[self.targets_at].reshape(-1, 3)
        return np.asarray(spots if len(spots) else np.zeros((1, 3)))

    def at_random_poses(self, robot: Robot, unknowns: Array) -> Self:
        """The instrument at plenty of poses that it could measure, of an arm: at any."""
        count = max(RANDOM_POSE_COUNT, 5 * robot.joints + 6 + len(self.names))
        at, names = build_random_poses(robot, count), self.at.target_names
        at = replace(at, y=np.zeros((count, len(names), 3)), target_names=names)
        blank = {name: np.zeros((count, *getattr(self, name).shape[1:])) for name in self.by_row}
        return replace(self, at=at, **blank)

    def at_exactly_fitting_poses(self, robot: Robot, unknowns: Array) -> Self:
        """The instrument at poses near its own where an arm itself fits it."""
        return self

    def projectors_on_empty_rows(self, arm: FlangePoses, unknowns: Array) -> Array:
        """(m, r, r) projector, pose by pose, on sums of its rows that hold no number."""
        return np.zeros((self.poses, 0, 0))

    # ---- how well it is fitted ---------------------------------------------------------------

    @property
    def part_names(self) -> tuple[str, ...]:
        """What each row of `part_errors` is."""
        return (self.kind,)

    def mean_square_error(self, arm: FlangePoses, unknowns: Array) -> float:
        """Of the misses of its points [unit^2]."""
        return float((self.read(arm, unknowns).residual ** 2).sum() / self.point_count)

    def part_errors(self, arm: FlangePoses, unknowns: Array, holdout_mask: Array) -> Array:
        """(m, parts, 3), NaN where not measured [unit]; numbers first."""
        rows = self.read(arm, unknowns)
        out = np.full((self.poses, len(self.part_names), 3), np.nan)
        part = rows.part if len(rows.part) else np.zeros(len(rows.pose), dtype=int)
        out[rows.pose, part] = 0.0
        out[rows.pose, part, 0] = rows.residual
        return out

    def orientation_errors(self, arm: FlangePoses, unknowns: Array) -> Array:
        """(m,) errors of orientation [rad], empty where none is measured."""
        return np.zeros(0)

    def parameters_for_report(
        self, unknowns: Array, nominal_unknowns: Array, covariance: Array
    ) -> tuple[ReportedParameter, ...]:
        """Those of its unknowns, the last ones, that people are told otherwise.

        unknowns, nominal_unknowns: (e,) found, and fitted to the arm as drawn.  covariance: (e, e).
        """
        return ()

    def unknowns_for_report(self, unknowns: Array) -> Array:
        """(e,) of its unknowns, as people are told them."""
        return unknowns

    def fitted_values_to_dict(
        self, arm: FlangePoses, unknowns: Array, nominal_unknowns: Array
    ) -> dict[str, Any]:
        """For JSON: what was fitted besides the robot.  nominal_unknowns: (e,) to the arm as
        drawn.
        """
        return {}

    # ---- slips and remarks -------------------------------------------------------------------

    @classmethod
    def check_options(cls, instruments: Sequence[Any], options: InstrumentOptions) -> None:
        """Raise OptionError for wrong choices, of all its files."""

    def propose_data_corrections(self) -> Iterable[DataCorrection]:
        """Slips of its own, besides those of joints."""
        return ()

    def thin_for_trials(self) -> Self:
        """At some of the poses, that are enough to try slips."""
        return self

    def check_given_values(self, fit_nominal_arm: FitNominalArm) -> None:
        """Raise DataError for what is given and cannot be."""

    def check_nominal_fit(
        self, fit_nominal_arm: FitNominalArm, distance_limits: DistanceLimits
    ) -> None:
        """Raise for what shows where the arm as drawn, `fit_nominal_arm`, fits it."""

    def list_remarks(self, parameters: Sequence[Any], noise: float) -> tuple[str, ...]:
        """What the reader should know.  parameters: its own, found.  noise: of a number [unit]."""
        return ()

    def options_for_more_parameters(self) -> Mapping[str, object]:
        """Options that would fit more of it."""
        return {}

    def describe_wider_fit(self, noise_before: float, noise_after: float) -> NoticeAndMend:
        """What to say, and the mend, where `options_for_more_parameters` explains most.  Noises
        [m].
        """
        return NoticeAndMend("", "")


D = TypeVar("D", bound=Instrument)


def spots_aside(arm: FlangePoses, first_spot: Array) -> list[Array]:
    """Places (3,) on the flange worth a start: a first one, the last frame, and about it [m]."""
    aside = np.concatenate(
        [np.zeros((1, 3)), *(s * np.eye(3) for s in TARGET_OFFSETS_PER_REACH), -0.1 * np.eye(3)]
    )
    return [first_spot, *(arm.reach * aside)]


def scaled_least_squares(matrix: Array, right_side: Array) -> Array:
    """Least squares with columns scaled to one; the least solution where poses do not tell."""
    norm = np.linalg.norm(matrix, axis=0)
    norm = np.where(norm > 0.0, norm, 1.0)
    return np.asarray(
        np.linalg.lstsq(matrix / norm, right_side, rcond=MIN_LINEAR_START_SINGULAR_VALUE)[0] / norm
    )


def build_random_poses(robot: Robot, pose_count: int) -> Measurements:
    """Random poses over the joints' whole range, nothing measured."""
    return bare(random_joint_values(robot, (pose_count,), np.random.default_rng(0)), {})


def bare(q: Array, columns: Mapping[str, Array], **measured: Array) -> Measurements:
    """Poses without any point.  q: (m, n) [rad, m].  measured: by what the caller calls it."""
    q = np.array(q, dtype=float)
    if q.ndim != 2:
        raise DataError(f"q must be (m, n); got {q.shape}")
    extra = {name: np.asarray(column) for name, column in columns.items()}
    for name, column in (*measured.items(), *extra.items()):
        if len(column) != len(q):
            raise DataError(f"{name} has {len(column)} entries, but there are {len(q)} poses")
    sliding = np.zeros(q.shape[1], dtype=bool)
    return Measurements(q, np.zeros((len(q), 0, 3)), (), sliding, np.arange(len(q)) + 1, extra)


def check_instrument_data(data: D) -> D:
    """The data, if a fit can make sense of them.  Raises DataError."""
    where = data.at.source
    if not data.poses:
        raise DataError(f"{where}: holds no poses")
    if not np.isfinite(data.at.q).all():
        row, joint = np.argwhere(~np.isfinite(data.at.q))[0]
        raise DataError(f"{data.row_location(row)}: joint {joint + 1} is not a finite number")
    if len(np.unique(group_repeated_poses(data.at))) == 1:
        raise DataError(
            f"{where}: holds one pose only; its joint values must differ from row to row"
        )
    data.check_data()
    return data


def drop_unmeasured_rows(data: D, unmeasured_rows: Array) -> D:
    """The data of a file without the rows at which nothing was measured.  unmeasured_rows: (m,)
    mask.
    """
    path = data.at.source
    if unmeasured_rows.all():
        raise DataError(f"{path}: nothing was measured at any pose")
    if not unmeasured_rows.any():
        return data
    notice = f"{path}: {unmeasured_rows.sum()} rows hold nothing measured and are left out"
    data = data.take_rows(~unmeasured_rows)
    return replace(data, at=replace(data.at, notices=(*data.at.notices, notice)))


def count_distinct_poses(measurements: Measurements, rows: Array) -> int:
    """How many different poses some rows (m,) hold."""
    return len(np.unique(group_repeated_poses(measurements)[rows]))
