"""Maps of the workspace: where a fit is sure, where the arm was seen to miss, how far data reach.

Two sections in the base frame: a half-plane through the axis of joint 1 (distance from it, height),
into which all poses are turned, and a horizontal slab.  Joints are sampled within their limits;
collisions and the floor are not known.  Numbers only: `map_figure` draws them.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np
import scipy
from scipy.spatial import cKDTree

from minimax_cal.core.arrays import Array
from minimax_cal.core.errors import OptionError
from minimax_cal.core.option_fields import check_seed, option_field_in_group
from minimax_cal.core.record_fields import (
    FieldFormat,
    InMillimetres,
    LengthInMillimetres,
    StoredSeparately,
)
from minimax_cal.core.results import Result
from minimax_cal.core.tables import Table
from minimax_cal.fitting.joint_spans import (
    JointSpan,
    describe_spans,
    is_outside_narrow_spans,
    select_narrow_spans,
    suggest_plan_command,
)
from minimax_cal.fitting.uncertainty import (
    POSITION_FRAMES,
    Uncertainty,
    position_confidence_radius,
    position_covariance_factor,
)
from minimax_cal.modelling.cell import Cell
from minimax_cal.robots.joint_ranges import DEFAULT_SLIDE_RANGE, clip_range_near_zero
from minimax_cal.robots.robot import Robot
from minimax_cal.validation.evaluation import AFTER, BEFORE, SavedResult

Predict = Callable[[Array], Array]  # joints (m, n) [rad, m] -> radius that holds 95 % (m,) [m]
PREDICTION_CHUNK = 2048  # samples that are predicted at once
MAP_MARGIN_OF_REACH = (
    0.25  # share of the poses' range added at either end where a limit is not known
)
REACHED_QUANTILE = 0.95  # share of the training poses that count as near another one
MIN_INSIDE_FRACTION = 0.5  # a joint that moved over less of its range is worth a notice
LEVEL, DOUBT = 0.95, 0.01  # share that the radius holds; chance of as few, below which it is told


def predict_nan_radius(q: Array) -> Array:
    """The prediction of a fit that does not tell its covariance: (m,) NaN."""
    return np.full(len(q), np.nan)


def build_radius_predictor(
    cell: Cell, known: Uncertainty, frame: str = "measurement", *, measured: bool = False
) -> Predict:
    """What a fit's covariance predicts for the targets' centroid.  frame: see `uncertainty`.

    Without the joints' own scatter (repeatability) and without the instrument's, which a centroid
    that is measured has as well; and true only as far as the model is: what the model leaves out
    is not in it.  Raises OptionError for a frame that does not exist.
    """
    if frame not in POSITION_FRAMES:
        raise OptionError(f"no frame {frame!r}; choose {' or '.join(POSITION_FRAMES)}")

    def radius(q: Array) -> Array:
        factor = position_covariance_factor(cell, known, q, frame, jitter=measured).mean(axis=1)
        noise = known.noise.variance / len(cell.target_positions) if measured else 0.0
        return position_confidence_radius(
            factor @ np.swapaxes(factor, -1, -2) + noise * np.eye(3), LEVEL
        )

    return radius


SECTION_OPTION_GROUP = option_field_in_group("The sections")


@dataclass(frozen=True)
class MapGrid:
    """What is mapped.  samples: of the joints.  bins: along the wider side of a section.

    height, slab: middle and thickness of the horizontal section in the base frame, NaN for the
    median height of the samples and a fifth of the arm's reach [m].
    """

    samples: int = SECTION_OPTION_GROUP(100_000, "The number of arm postures that are predicted.")
    bins: int = SECTION_OPTION_GROUP(40, "The number of bins along the wider side of a section.")
    height: float = SECTION_OPTION_GROUP(
        np.nan, "The height of the horizontal section [default: the median].", "mm"
    )
    slab: float = SECTION_OPTION_GROUP(
        np.nan, "How thick a section is [default: a fifth of the reach].", "mm"
    )
    seed: int = SECTION_OPTION_GROUP(0, "The seed of the samples.")


@dataclass(frozen=True, eq=False)
class MapSection:
    """Predictions binned over a section.

    axes: labels of its coordinates.  edges: of the bins along them, (a + 1,), (b + 1,) [m].
    count: (a, b) samples.  median, worst: (a, b) radius that holds 95 % [m].  reached: (a, b) share
    of the samples among the training poses.  outside: (a, b) share of them where a joint is outside
    its span, having gone too little for a claim.  The last four are NaN in an empty bin; median and
    worst are of the other samples.
    """

    name: str
    axes: tuple[str, str]
    edges: InMillimetres[tuple[Array, Array]]
    count: Annotated[Array, FieldFormat(key="samples")]
    median: Annotated[Array, FieldFormat(key="radius95_median_mm", scale=1e3)]
    worst: Annotated[Array, FieldFormat(key="radius95_worst_mm", scale=1e3)]
    reached: Array
    outside: Annotated[Array, FieldFormat(key="outside_spans")]


@dataclass(frozen=True, eq=False)
class ObservedErrors:
    """Observed errors of the targets' centroid.

    place: (m, 3) in the base frame [m].  before, after: (m,), NaN where no target was measured [m].
    held: (m,) True where the fit has not seen the pose.
    """

    place: InMillimetres[Array]
    before: InMillimetres[Array]
    after: InMillimetres[Array]
    held: Annotated[Array, FieldFormat(key="held_out")]


@dataclass(frozen=True, eq=False)
class SampledJoints:
    """Joints at random, and the training poses.  place: (N, 3) in the base frame [m].

    radius: (N,) that holds 95 %, NaN where none is known [m].  reached: (N,) True among the
    training poses.  outside: (N,) True where a joint that went too little is outside its span, of
    which no radius is predicted.
    """

    place: Array
    radius: Array
    reached: Array
    outside: Array

    def take(self, mask: Array) -> SampledJoints:
        """Some of the samples."""
        return SampledJoints(
            self.place[mask], self.radius[mask], self.reached[mask], self.outside[mask]
        )


@dataclass(frozen=True, eq=False)
class WorkspaceMap(Result):
    """Sections through the workspace, and what was observed.  height, slab: see `MapGrid`.

    inside: how many held-out poses lie within the radius predicted for a measurement there, and of
    how many.
    """

    KIND = "map"

    robot: str
    sections: tuple[MapSection, ...]
    sampled: StoredSeparately[SampledJoints]
    seen: Annotated[ObservedErrors, FieldFormat(key="observed")]
    height: LengthInMillimetres
    slab: LengthInMillimetres
    inside: StoredSeparately[tuple[int, int]]
    notices: tuple[str, ...]

    @property
    def predicted(self) -> bool:
        """Whether the fit told its covariance."""
        return bool(np.isfinite(self.sampled.radius).any())

    def table(self) -> Table:
        """Predicted radius where the data reach and beyond; observed errors."""
        seen, reached, outside = self.seen, self.sampled.reached, self.sampled.outside
        every = [
            (f"predicted, {title} ({100.0 * mask.mean():.0f} % of the samples)", mask,
             self.sampled.radius)
            for title, mask in (
                ("where the data reach", reached),
                ("beyond", ~reached & ~outside),
                ("outside the spans of joints that hardly moved: none", outside),
            )
        ]  # fmt: skip
        every += [
            (f"observed {name}, {title} poses", mask, error)
            for title, mask in (("held-out", seen.held), ("training", ~seen.held))
            for name, error in ((BEFORE, seen.before), (AFTER, seen.after))
        ]
        return Table.from_rows(
            f"{self.robot}: position over the workspace; predicted: radius that holds 95 %, by the "
            "fit's covariance; observed: error of the targets' centroid",
            [
                (what, mask.sum(), *median_quantile_and_max_mm(of[mask]))
                for what, mask, of in every
                if mask.any()
            ],
            "what | count d | median mm .4f | 95 % mm .4f | worst mm .4f",
        )

    def headline(self) -> str:
        """How many held-out poses miss by no more than is predicted."""
        count, of = self.inside
        return f"{self.robot}: {count} of {of} held-out poses are within the predicted radius."

    def extra_file_content(self, *, with_measurements: bool = True) -> dict[str, Any]:
        """The table, and how many poses lie within."""
        return {
            "summary": self.table().to_records("what", "count", "median_mm", "q95_mm", "worst_mm"),
            "held_out_inside": dict(zip(("count", "of"), self.inside, strict=True)),
        }


def median_quantile_and_max_mm(values: Array) -> tuple[float, float, float]:
    """Median, 95 % quantile and largest [mm]; NaN without any."""
    known = 1e3 * values[np.isfinite(values)]
    if not len(known):
        return np.nan, np.nan, np.nan
    return float(np.median(known)), float(np.quantile(known, 0.95)), float(known.max())


class SampledRange(NamedTuple):
    """(n,) lowest and highest joint values to sample [rad, m]."""

    lower: Array
    upper: Array


def sampled_joint_range(robot: Robot, q: Array) -> SampledRange:
    """(n,) lowest and highest joint values to sample: the limits, at most one turn [rad, m].

    q: (m, n) poses that say what to sample where a limit is not known; m may be 0.
    """
    most, turn = (np.where(robot.prismatic, far, np.pi) for far in (DEFAULT_SLIDE_RANGE, np.inf))
    low, high = -most, most
    if len(q):
        low, high = q.min(axis=0), q.max(axis=0)
        more = MAP_MARGIN_OF_REACH * (high - low)
        low = np.minimum(low, np.maximum(low - more, -turn))
        high = np.maximum(high, np.minimum(high + more, turn))
    lower = np.where(np.isfinite(robot.lower), robot.lower, low)
    upper = np.where(np.isfinite(robot.upper), robot.upper, high)
    return SampledRange(*clip_range_near_zero(lower, upper, turn))


def tcp_positions(cell: Cell, q: Array) -> Array:
    """The targets' centroid in the base frame, effects left out: (m, 3) [m].  q: (m, n)."""
    pose = cell.robot.pose(q)
    return np.asarray(pose[:, :3, :3] @ cell.target_positions.mean(axis=0) + pose[:, :3, 3])


def is_interpolated_by_training_poses(train: Array, q: Array) -> Array:
    """(m,) True where a pose lies among the training poses: interpolation, not extrapolation.

    Every joint is within its range in the training poses, and the nearest of them is no farther
    than 95 % of them are from their own nearest; joints in units of their ranges.
    train: (M, n) [rad, m].  q: (m, n).
    """
    poses = np.unique(np.round(train, 9), axis=0)
    if len(poses) < 3:
        return np.zeros(len(q), dtype=bool)
    low, high = poses.min(axis=0), poses.max(axis=0)
    size = np.where(high > low, high - low, 1.0)
    tree = cKDTree(poses / size)
    own = np.asarray(tree.query(poses / size, k=2)[0])
    inside = np.all((q >= low - 1e-9) & (q <= high + 1e-9), axis=1)
    away = np.asarray(tree.query(q / size)[0])
    return np.asarray(inside & (away <= np.quantile(own[:, 1], REACHED_QUANTILE)))


def sample_joint_workspace(
    cell: Cell, predict: Predict, train: Array, grid: MapGrid, spans: Sequence[JointSpan] = ()
) -> SampledJoints:
    """Joints at random over their range, and the training poses; what is predicted there.

    Nothing is where a joint that went too little is outside its span.
    """
    low, high = sampled_joint_range(cell.robot, train)
    rng = np.random.default_rng(grid.seed)
    q = np.concatenate([train, rng.uniform(low, high, (grid.samples, cell.robot.joints))])
    parts = np.array_split(q, max(1, len(q) // PREDICTION_CHUNK))
    radius = np.concatenate([predict(part) for part in parts])
    away = is_outside_narrow_spans(spans, q)
    radius = np.where(away, np.nan, radius)
    return SampledJoints(
        tcp_positions(cell, q), radius, is_interpolated_by_training_poses(train, q) & ~away, away
    )


def bin_section(
    name: str,
    axes: tuple[str, str],
    coordinates: tuple[Array, Array],
    samples: SampledJoints,
    bin_size: float,
) -> MapSection:
    """Samples binned into squares.  coordinates: (N,) coordinates of each [m].  bin_size: of a bin
    [m].
    """
    edges = [
        bin_size * np.arange(np.floor(part.min() / bin_size), np.ceil(part.max() / bin_size) + 1.5)
        for part in coordinates
    ]

    every = np.ones(len(samples.radius), dtype=bool)

    def binned(
        values: Array, statistic: Literal["count", "mean", "median", "max"], mask: Array = every
    ) -> Array:
        x, y = (part[mask] for part in coordinates)
        found = scipy.stats.binned_statistic_2d(x, y, values[mask], statistic=statistic, bins=edges)
        return np.asarray(found.statistic, dtype=float)

    count = binned(samples.radius, "count").astype(int)
    reached, away = (
        binned(mask.astype(float), "mean") for mask in (samples.reached, samples.outside)
    )
    median = worst = np.full(count.shape, np.nan)
    known = np.isfinite(samples.radius)
    if known.any():
        median, worst = (
            binned(samples.radius, "median", known),
            binned(samples.radius, "max", known),
        )
    return MapSection(name, axes, (edges[0], edges[1]), count, median, worst, reached, away)


def build_workspace_map(
    saved: SavedResult,
    predict: Predict = predict_nan_radius,
    grid: MapGrid = MapGrid(),
    measured: Predict = predict_nan_radius,
) -> WorkspaceMap:
    """Sections through the workspace of a saved calibration.

    predict: radius that holds 95 % of the position of the targets' centroid, at given joints.
    measured: the same of the centroid as it is measured, which held-out poses are asked about.
    Raises OptionError.
    """
    check_map_grid(grid)
    cell, data, held = saved.cells[AFTER], saved.data, saved.held
    train = data.q[~held]
    some = sample_joint_workspace(cell, predict, train if len(train) else data.q, grid, saved.spans)
    sections, height, slab = build_sections(some, grid, cell.robot.reach())
    seen = observed_errors(saved)
    radius, error = measured(data.q[held]), seen.after[held]
    known = np.isfinite(radius) & np.isfinite(error)
    inside = int((error[known] <= radius[known]).sum()), int(known.sum())
    notices = tuple(list_map_notices(cell.robot, train, inside))
    if few := select_narrow_spans(saved.spans):
        share = 100.0 * float(some.outside.mean())
        notices += (
            f"nothing is predicted for {share:.0f} % of the samples, outside what joints spanned "
            f"in the fit: {describe_spans(few)}; {suggest_plan_command(len(train))}",
        )
    return WorkspaceMap(cell.robot.name, sections, some, seen, height, slab, inside, notices)


class MapSections(NamedTuple):
    """Sections, and the height and thickness of the horizontal one [m]."""

    sections: tuple[MapSection, ...]
    height: float
    slab: float


def build_sections(samples: SampledJoints, grid: MapGrid, reach: float) -> MapSections:
    """The vertical and the horizontal section, and height and thickness of the latter [m].

    reach: of the arm [m].  Raises OptionError.
    """
    height = grid.height if np.isfinite(grid.height) else float(np.median(samples.place[:, 2]))
    slab = grid.slab if np.isfinite(grid.slab) else 0.2 * reach
    x, y, z = samples.place.T
    flat = np.abs(z - height) <= 0.5 * slab
    if not flat.any():
        raise OptionError(
            f"height {1e3 * height:g} mm: the arm does not come there; it reaches "
            f"{1e3 * z.min():.0f} to {1e3 * z.max():.0f} mm"
        )
    size = float(max(2.0 * np.hypot(x, y).max(), np.ptp(z))) / grid.bins
    upright, level = ("distance from axis 1 (m)", "height (m)"), ("x (m)", "y (m)")
    sections = (
        bin_section("vertical", upright, (np.hypot(x, y), z), samples, size),
        bin_section("horizontal", level, (x[flat], y[flat]), samples.take(flat), size),
    )
    return MapSections(sections, height, slab)


def observed_errors(saved: SavedResult) -> ObservedErrors:
    """What was observed at the poses that were measured."""
    data, there = saved.data, saved.data.seen[..., None]

    def off(cell: Cell) -> Array:
        total = np.where(there, cell.error(data), 0.0).sum(axis=1)
        return np.asarray(np.linalg.norm(total, axis=-1) / there.sum(axis=(1, 2)))

    before, after = (off(saved.cells[name]) for name in (BEFORE, AFTER))
    return ObservedErrors(tcp_positions(saved.cells[AFTER], data.q), before, after, saved.held)


def check_map_grid(grid: MapGrid) -> None:
    """Raise OptionError for a grid that makes no sense."""
    for name, value, least, most in (
        ("samples", grid.samples, 100, 10_000_000),
        ("bins", grid.bins, 2, 400),
    ):
        if not least <= value <= most:
            raise OptionError(f"{name} {value}: give {least} to {most}")
    check_seed(grid.seed)
    if grid.slab <= 0.0 or np.isinf(grid.slab) or np.isinf(grid.height):
        raise OptionError("height and slab of the section: give finite numbers, slab over 0")


def list_map_notices(robot: Robot, train: Array, inside: tuple[int, int]) -> list[str]:
    """Notices about what was sampled, and about a prediction that the held-out poses belie."""
    out = []
    count, of = inside
    if scipy.stats.binom.cdf(count, of, LEVEL) < DOUBT:
        out.append(
            f"the predicted radius, made wider for the noise of a measurement, holds {count} of "
            f"{of} held-out poses, not {100 * LEVEL:.0f} %: what the model leaves out is not in "
            "the prediction"
        )
    free = ~(np.isfinite(robot.lower) & np.isfinite(robot.upper))
    names = ", ".join(f"J{i + 1}" for i in np.flatnonzero(free))
    if free.any():
        out.append(
            f"{robot.name}: no limits of {names}: sampled over the range of the poses and a "
            "quarter more at either end"
        )
    if len(train):
        low, high = sampled_joint_range(robot, train)
        share = np.ptp(train, axis=0) / np.maximum(high - low, 1e-12)
        out += [
            f"J{i + 1} moved over {100.0 * share[i]:.0f} % of its range in the training poses: "
            "what lies beyond is extrapolation"
            for i in np.flatnonzero(share < MIN_INSIDE_FRACTION)
        ]
    return out
