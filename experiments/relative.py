"""Calibration without coordinates: what lengths, closures and poses tell beside a tracker.

    python -m experiments.relative [--quick] [--out FOLDER] [--json FILE] [--seed N] [--jobs N] ...

The same imperfect arms are measured at the same number of poses by wires, a ball bar, sockets that
are visited again, a 6D instrument, and a tracker with one reflector.  The error of what was
measured, held out, stands beside the true error of positions over the joints' range, a base fitted:
the simulation knows it.  The number of identified parameters stands beside the rank of a Jacobian
by finite differences of a model that knows nothing of ours.  Real arms, where there are any, are
calibrated from their tracker's points reduced to lengths, and judged by held-out points.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING

import click
import numpy as np
from scipy.spatial.transform import Rotation

from experiments.real_arms import has_measurements, perturb_link_parameters, read_real_arm
from experiments.study_record import new_figure
from experiments.sweep import Study, study_options
from minimax_cal.core.arrays import Array, rms
from minimax_cal.core.tables import Table
from minimax_cal.fitting.accuracy_claims import random_position_sigma
from minimax_cal.fitting.calibrate import calibrate
from minimax_cal.fitting.fit import Fit
from minimax_cal.fitting.multi_instrument.relative_calibration import relative
from minimax_cal.fitting.multi_instrument.relative_result import RelativeCalibration
from minimax_cal.instruments import Instrument, closures, distances, flange_poses
from minimax_cal.instruments.sockets import MAX_CLOSED_GAP, SocketVisits, reach
from minimax_cal.instruments.whole_poses import WholePoses
from minimax_cal.instruments.wires import WireLengths, format_wire_names
from minimax_cal.measuring.measurements import Measurements, measurements
from minimax_cal.measuring.pose_groups import split_train_and_holdout
from minimax_cal.modelling.simulate import gravity
from minimax_cal.robots.joint_sampling import random_joint_values_above_floor
from minimax_cal.robots.robot import Robot, load_robot
from minimax_cal.robots.transforms import nearest_rotations

if TYPE_CHECKING:
    from matplotlib.figure import Figure

RELATIVE_LENGTH_SIGMA, RELATIVE_ANGLE_SIGMA = (
    0.5e-3,
    1.0e-3,
)  # standard deviation of the errors of links [m, rad]
RELATIVE_LENGTH_NOISE, RELATIVE_ANGLE_NOISE = (
    15e-6,
    0.15e-3,
)  # of a length or coordinate, and of an angle [m, rad]
RELATIVE_JOINT_COMPLIANCE = (
    3.0e-7  # of every joint, where the arm bends and no fit knows [rad/(N m)]
)
RELATIVE_TARGET_POSITION = np.array([0.06, 0.03, 0.12])  # the target in the last frame [m]
RELATIVE_POSES, POSITION_CHECK_POSES = 100, 500
SOCKET_COUNT = 10
BAR_LENGTHS_PER_REACH = (0.15, 0.225, 0.3)  # lengths of the telescoping bar, per metre of reach
RELATIVE_ROBOTS = {"irb2600": "IRB 2600", "ur10": "UR10"}
MEASUREMENT_KINDS = {
    "tracker": "tracker, 1 reflector",
    "poses": "6D poses",
    "wires_4": "4 wires",
    "wires_3": "3 wires",
    "wires_1": "1 wire",
    "ball_bar": "ball bar, 3 cups",
    "closures": "closures",
    "closures_known": "closures, 1 distance",
    "plate_known": "closures on a plate, 1 distance",
}
RANK_DIFFERENCE_STEP, MIN_RANK_SINGULAR_VALUE = (
    1e-6,
    1e-6,
)  # of finite differences, and of their singular values


@dataclass(frozen=True)
class ImperfectArm:
    """An arm as drawn, the true one, and how it bends."""

    robot: Robot
    real: Robot
    compliance: float

    @staticmethod
    def draw(name: str, seed: int, compliance: float) -> ImperfectArm:
        """The same true arm for the same seed, whatever measures it."""
        robot, rng = load_robot(name), np.random.default_rng([seed, 1])
        return ImperfectArm(
            robot,
            perturb_link_parameters(robot, rng, RELATIVE_LENGTH_SIGMA, RELATIVE_ANGLE_SIGMA),
            compliance,
        )

    def bent_joint_values(self, q: Array) -> Array:
        """Joint values that a stiff arm would have where this one is told q."""
        return q + self.compliance * gravity(self.real, q) if self.compliance else q

    def target_positions(self, q: Array) -> Array:
        """The true target in the base: (m, 3) [m]."""
        return target_positions_in_base(
            self.real, self.bent_joint_values(q), RELATIVE_TARGET_POSITION
        )


def target_positions_in_base(robot: Robot, q: Array, target_position: Array) -> Array:
    """A point of the last frame in the base: (m, 3) [m]."""
    pose = robot.pose(q)
    return np.asarray(pose[:, :3, :3] @ target_position + pose[:, :3, 3])


# ---- what is measured ------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class RelativeMeasurement:
    """data: of an instrument.  known: distances between sockets, as `RelativeOptions` has them."""

    data: Instrument
    known: tuple[tuple[str, str, float], ...] = ()


def measure_by_wires(
    arm: ImperfectArm, rng: np.random.Generator, pose_count: int, noise: float, wire_count: int
) -> RelativeMeasurement:
    """Draw-wires from anchors around the arm to the target."""
    size = 0.8 * arm.robot.reach()
    angle = 2.0 * np.pi * np.arange(wire_count) / wire_count + 0.5
    high = 0.35 * np.arange(wire_count) - 0.2
    anchors = size * np.stack([np.cos(angle), np.sin(angle), high], axis=1)
    q = random_joint_values_above_floor(arm.robot, pose_count, rng)
    length = np.linalg.norm(arm.target_positions(q)[:, None] - anchors, axis=-1)
    return RelativeMeasurement(distances(q, length + noise * rng.normal(size=length.shape)))


def measure_by_ball_bar(
    arm: ImperfectArm, rng: np.random.Generator, pose_count: int, noise: float
) -> RelativeMeasurement:
    """A telescoping bar, of some nominal lengths, in three cups by turns."""
    size = arm.robot.reach()
    cups = size * np.array([[0.3, 0.1, 0.1], [-0.1, 0.35, 0.15], [-0.2, -0.25, 0.3]])
    q, cup = np.zeros((0, arm.robot.joints)), np.zeros(0, dtype=int)
    while len(q) < pose_count:
        which = rng.integers(len(cups), size=2 * pose_count)
        aside = rng.normal(size=(2 * pose_count, 3))
        aside[:, 2] = np.abs(aside[:, 2])  # cups hold from above
        long = (
            size * rng.choice(BAR_LENGTHS_PER_REACH, 2 * pose_count) / np.linalg.norm(aside, axis=1)
        )
        start = random_joint_values_above_floor(arm.robot, 2 * pose_count, rng)
        found, gap = reach(
            arm.robot, RELATIVE_TARGET_POSITION, cups[which] + long[:, None] * aside, start, 30
        )
        kept = (gap < MAX_CLOSED_GAP) & is_within_limits(arm.robot, found)
        q, cup = (
            np.concatenate([q, found[kept]])[:pose_count],
            np.append(cup, which[kept])[:pose_count],
        )
    length = np.full((pose_count, len(cups)), np.nan)
    true = np.linalg.norm(arm.target_positions(q) - cups[cup], axis=1)
    length[np.arange(pose_count), cup] = true + noise * rng.normal(size=pose_count)
    return RelativeMeasurement(distances(q, length))


def measure_by_sockets(
    arm: ImperfectArm,
    rng: np.random.Generator,
    pose_count: int,
    noise: float,
    *,
    on_plate: bool,
    with_known_distance: bool,
) -> RelativeMeasurement:
    """The ball in sockets, in the whole workspace or on a plate, each reached in many ways."""
    visits, size = pose_count // SOCKET_COUNT, arm.robot.reach()
    q, label = np.zeros((0, arm.robot.joints)), np.zeros(0, dtype=int)
    centres = np.zeros((0, 3))
    while len(centres) < SOCKET_COUNT:
        centre = arm.target_positions(random_joint_values_above_floor(arm.robot, 1, rng))[0]
        if on_plate:
            centre = size * np.array([0.35, 0.0, 0.25]) + rng.uniform(-0.2, 0.2, 3) * [1, 1, 0.1]
        goal = centre + noise * rng.normal(size=(10 * visits, 3))
        start = random_joint_values_above_floor(arm.robot, len(goal), rng)
        found, gap = reach(arm.real, RELATIVE_TARGET_POSITION, goal, start, iterations=30)
        told = found
        for _ in range(5):  # what the controller is told, so that the bent arm is there
            told = found - (arm.bent_joint_values(told) - told)
        kept = np.flatnonzero((gap < MAX_CLOSED_GAP) & is_within_limits(arm.robot, told))[:visits]
        if len(kept) == visits:
            q, label = np.concatenate([q, told[kept]]), np.append(label, [len(centres)] * visits)
            centres = np.concatenate([centres, centre[None]])
    names = np.array([f"S{i + 1}" for i in range(SOCKET_COUNT)])
    away = np.linalg.norm(centres - centres[0], axis=1)
    far = int(away.argmax())
    pair = (str(names[0]), str(names[far]), float(away[far] + noise * rng.normal()))
    return RelativeMeasurement(closures(q, names[label]), (pair,) if with_known_distance else ())


def measure_whole_poses(
    arm: ImperfectArm, rng: np.random.Generator, pose_count: int, noise: float
) -> RelativeMeasurement:
    """Whole poses of a frame at the target, from a random place."""
    q = random_joint_values_above_floor(arm.robot, pose_count, rng)
    base, tool = np.eye(4), np.eye(4)
    base[:3, :3], base[:3, 3] = Rotation.random(rng=rng).as_matrix(), 3.0 * rng.normal(size=3)
    tool[:3, 3] = RELATIVE_TARGET_POSITION
    pose = base @ arm.real.pose(arm.bent_joint_values(q)) @ tool
    pose[:, :3, 3] += noise * rng.normal(size=(pose_count, 3))
    turn = Rotation.from_rotvec(
        noise / RELATIVE_LENGTH_NOISE * RELATIVE_ANGLE_NOISE * rng.normal(size=(pose_count, 3))
    )
    pose[:, :3, :3] = pose[:, :3, :3] @ turn.as_matrix()
    return RelativeMeasurement(flange_poses(q, pose))


def is_within_limits(robot: Robot, q: Array) -> Array:
    """(m,) True within the limits and one turn."""
    span = np.where(robot.prismatic, 0.5, np.pi)
    lower, upper = np.maximum(robot.lower, -span), np.minimum(robot.upper, span)
    return np.asarray(((q >= lower) & (q <= upper)).all(axis=1))


MeasurementSimulator = Callable[
    [ImperfectArm, np.random.Generator, int, float], RelativeMeasurement
]
MEASUREMENT_SIMULATORS: dict[str, MeasurementSimulator] = {
    "poses": measure_whole_poses,
    "wires_4": partial(measure_by_wires, wire_count=4),
    "wires_3": partial(measure_by_wires, wire_count=3),
    "wires_1": partial(measure_by_wires, wire_count=1),
    "ball_bar": measure_by_ball_bar,
    "closures": partial(measure_by_sockets, on_plate=False, with_known_distance=False),
    "closures_known": partial(measure_by_sockets, on_plate=False, with_known_distance=True),
    "plate_known": partial(measure_by_sockets, on_plate=True, with_known_distance=True),
}


# ---- what is true ----------------------------------------------------------------------------


def position_errors(
    arm: ImperfectArm, robot: Robot, target_position: Array, q: Array, *, with_scale: bool
) -> Array:
    """Distance (m,) of true from predicted positions after the best rigid motion [m].

    with_scale: after the best scale too.
    """
    return distances_after_alignment(
        arm.target_positions(q),
        target_positions_in_base(robot, q, target_position),
        with_scale=with_scale,
    )


def distances_after_alignment(true: Array, predicted: Array, *, with_scale: bool) -> Array:
    """Distance (m,) of points from points (m, 3) after the best rigid motion, or similarity [m]."""
    off, moved = true - true.mean(axis=0), predicted - predicted.mean(axis=0)
    moved = moved @ nearest_rotations(off.T @ moved).T
    scale = (off * moved).sum() / (moved**2).sum() if with_scale else 1.0
    return np.asarray(np.linalg.norm(off - scale * moved, axis=1))


PredictMeasurement = Callable[[Robot, Array, Array, Array], Array]


def jacobian_rank_by_differences(
    arm: ImperfectArm, q: Array, instrument_unknowns: Array, predict: PredictMeasurement
) -> int:
    """Parameters that a Jacobian by central differences tells, at the true arm.

    Every unknown is moved, sockets' places too: nothing is eliminated, and nothing is known about
    redundancy.  predict(robot, q, spot, own) are the numbers measured.  instrument_unknowns: (o,)
    unknowns of the instrument.
    """
    n = arm.real.joints
    x0 = np.concatenate(
        [arm.real.mdh.reshape(-1), RELATIVE_TARGET_POSITION, instrument_unknowns.reshape(-1)]
    )

    def numbers(x: Array) -> Array:
        robot = arm.real.with_mdh(x[: 5 * n].reshape(n, 5))
        return predict(robot, q, x[5 * n : 5 * n + 3], x[5 * n + 3 :])

    steps = RANK_DIFFERENCE_STEP * np.eye(len(x0))
    slope = [
        (numbers(x0 + step) - numbers(x0 - step)) / (2.0 * RANK_DIFFERENCE_STEP) for step in steps
    ]
    norm = np.linalg.norm(slope, axis=1, keepdims=True)
    matrix = np.array(slope)[norm[:, 0] > 1e-9] / norm[norm[:, 0] > 1e-9]
    values = np.linalg.svd(matrix, compute_uv=False)
    return int((values > MIN_RANK_SINGULAR_VALUE * values[0]).sum())


def tracker_points(robot: Robot, q: Array, target_position: Array, base_pose: Array) -> Array:
    """What a tracker sees: own is the base's pose."""
    base = Rotation.from_rotvec(base_pose[3:]).as_matrix()
    return np.asarray(
        target_positions_in_base(robot, q, target_position) @ base.T + base_pose[:3]
    ).reshape(-1)


def pose_corner_points(
    robot: Robot, q: Array, target_position: Array, base_and_tool: Array
) -> Array:
    """Four points of the measured frame: own is the base's pose and the tool's turn."""
    tool = Rotation.from_rotvec(base_and_tool[6:]).as_matrix()
    corners = [target_position, *(target_position + 0.1 * tool.T)]
    return np.concatenate(
        [tracker_points(robot, q, corner, base_and_tool[:6]) for corner in corners]
    )


def wire_lengths(
    robot: Robot, q: Array, target_position: Array, anchors: Array, is_measured: Array
) -> Array:
    """Lengths of wires where seen (m, s): own is the anchors."""
    gap = target_positions_in_base(robot, q, target_position)[:, None] - anchors.reshape(-1, 3)
    return np.asarray(np.linalg.norm(gap, axis=-1)[is_measured])


def closure_gaps_and_distances(
    robot: Robot,
    q: Array,
    target_position: Array,
    socket_positions: Array,
    socket: Array,
    pairs: Sequence[Array],
) -> Array:
    """Gaps of visits, and distances between pairs of sockets: own is the sockets' places."""
    centres = socket_positions.reshape(-1, 3)
    apart = [np.linalg.norm(centres[a] - centres[b]) for a, b in pairs]
    return np.concatenate(
        [(target_positions_in_base(robot, q, target_position) - centres[socket]).reshape(-1), apart]
    )


def measurement_rank(arm: ImperfectArm, measurement: RelativeMeasurement) -> int:
    """Rank of the plain model of a measurement, the sockets' places not counted."""
    data = measurement.data
    q = arm.bent_joint_values(data.at.q)
    if isinstance(data, WholePoses):
        return jacobian_rank_by_differences(arm, q, np.zeros(9), pose_corner_points)
    if isinstance(data, WireLengths):
        anchors = arm.real.reach() * np.random.default_rng(0).normal(size=(len(data.wires), 3))
        seen = np.isfinite(data.length)
        return jacobian_rank_by_differences(
            arm, q, anchors, partial(wire_lengths, is_measured=seen)
        )
    visits = data.socket if isinstance(data, SocketVisits) else np.zeros(0)
    labels, socket = np.unique(visits, return_inverse=True)
    at = target_positions_in_base(arm.real, q, RELATIVE_TARGET_POSITION)
    centres = np.stack([at[socket == i].mean(axis=0) for i in range(len(labels))])
    # where closures miss by the noise's micrometres, even the scale seems told
    q, _ = reach(arm.real, RELATIVE_TARGET_POSITION, centres[socket], q)
    pairs = [np.searchsorted(labels, known[:2]) for known in measurement.known]
    predict = partial(closure_gaps_and_distances, socket=socket, pairs=pairs)
    return jacobian_rank_by_differences(arm, q, centres, predict) - 3 * len(labels)


# ---- the study -------------------------------------------------------------------------------


@dataclass(frozen=True)
class RelativeJob:
    """One arm seen by one instrument.  compliance: of every joint [rad/(N m)]."""

    robot: str
    kind: str
    seed: int
    compliance: float


@dataclass(frozen=True)
class RelativeOutcome:
    """What a job found.

    numbers: independent numbers measured in training.  parameters, identified: of the fit.  rank:
    by finite differences.  held_mm: RMS of what was measured, held out, nominal and calibrated.
    true_mm: RMS of positions over the joints' range, nominal and calibrated.  shape_mm: the latter
    with the best scale, too.  worst_mm: the largest.  sigma_mm: what the fit's sigmas expect.
    """

    numbers: int
    parameters: int
    identified: int
    rank: int
    held_mm: tuple[float, float]
    true_mm: tuple[float, float]
    shape_mm: float
    worst_mm: float
    sigma_mm: float
    converged: bool


def run_job(job: RelativeJob) -> RelativeOutcome:
    """Simulate, calibrate, and compare with the truth; a tracker with one reflector by itself."""
    arm = ImperfectArm.draw(job.robot, job.seed, job.compliance)
    rng = np.random.default_rng([job.seed, 2, list(MEASUREMENT_KINDS).index(job.kind)])
    checks = random_joint_values_above_floor(
        arm.robot, POSITION_CHECK_POSES, np.random.default_rng([job.seed, 3])
    )
    fit: Fit | RelativeCalibration
    if job.kind == "tracker":
        q = random_joint_values_above_floor(arm.robot, RELATIVE_POSES, rng)
        y = arm.target_positions(q) + RELATIVE_LENGTH_NOISE * rng.normal(size=(RELATIVE_POSES, 3))
        fit = calibrate(arm.robot, measurements(q, y), objective="sum")
        state, spot = fit.cell.parameter_values, fit.cell.target_positions[0]
        numbers, identified = 3 * fit.accuracy["train"].poses, count_identified_parameters(fit)
        rank = jacobian_rank_by_differences(
            arm, arm.bent_joint_values(q), np.zeros(6), tracker_points
        )
        sigma = random_position_sigma(arm.robot, state.mdh, state.target_positions, fit.covariance)
    else:
        measured = MEASUREMENT_SIMULATORS[job.kind](arm, rng, RELATIVE_POSES, RELATIVE_LENGTH_NOISE)
        fit = relative(arm.robot, measured.data, known_distances=measured.known)
        numbers, identified = fit.numbers["train"] + len(measured.known), fit.identified
        rank, sigma, spot = (
            measurement_rank(arm, measured),
            fit.position_sigma,
            fitted_target_position(fit),
        )
    found, shape = (
        position_errors(arm, fit.robot, spot, checks, with_scale=scaled) for scaled in (False, True)
    )
    nominal = position_errors(arm, arm.robot, RELATIVE_TARGET_POSITION, checks, with_scale=False)
    return RelativeOutcome(
        numbers=numbers,
        parameters=len(fit.parameters),
        identified=identified,
        rank=rank,
        held_mm=(fit.accuracy["nominal"].rms_mm, fit.accuracy["holdout"].rms_mm),
        true_mm=(rms_in_mm(nominal), rms_in_mm(found)),
        shape_mm=rms_in_mm(shape),
        worst_mm=float(1e3 * found.max()),
        sigma_mm=1e3 * sigma,
        converged=fit.status == "converged",
    )


def count_identified_parameters(fit: Fit) -> int:
    """How many parameters are identified."""
    return sum(p.identifiable for p in fit.parameters)


def fitted_target_position(fit: RelativeCalibration) -> Array:
    """The fitted target in the last frame: (3,) [m]."""
    place = fit.instrument
    millimetres = place["target_mm"] if "target_mm" in place else place["tool"]["translation_mm"]
    return 1e-3 * np.array(millimetres)


def rms_in_mm(distance: Array) -> float:
    """Root mean square of distances [m], in millimetres."""
    return 1e3 * rms(distance)


# ---- real arms -------------------------------------------------------------------------------

REAL_RELATIVE_ARMS = {"irb120": "IRB 120", "meca500_r": "Meca500", "fanuc_r2000": "FANUC R-2000"}
REAL_MEASUREMENT_KINDS = ("tracker", "wires_3", "wires_1")


@dataclass(frozen=True)
class RealRelativeJob:
    """A real arm, its tracker's points seen as lengths from some places.

    held: share held out, by which seed.
    """

    robot: str
    kind: str
    seed: int
    held: float = 0.2


@dataclass(frozen=True)
class RealRelativeOutcome:
    """poses: in training.  identified: parameters.  held_mm: RMS of what was measured, held out.

    position_mm: RMS of the reflector's held-out positions, nominal and calibrated, a base fitted.
    """

    poses: int
    identified: int
    held_mm: float
    position_mm: tuple[float, float]


def run_real_job(job: RealRelativeJob) -> RealRelativeOutcome:
    """Reduce real points to lengths, calibrate, and judge by the held-out points."""
    robot, every = read_real_arm(job.robot)
    data = every.only(0)
    train, held, _ = split_train_and_holdout(data, job.held, job.seed)
    fit = calibrate(robot, train, objective="sum", holdout=0.0)
    nominal = rms_position_error_mm(held, robot, fit.nominal.target_positions[0])
    if job.kind == "tracker":
        held_mm = rms_in_mm(np.linalg.norm(fit.cell.error(held)[:, 0], axis=1))
        after = rms_position_error_mm(held, fit.robot, fit.cell.target_positions[0])
        return RealRelativeOutcome(
            train.poses, count_identified_parameters(fit), held_mm, (nominal, after)
        )
    other = relative(
        robot, reduce_points_to_lengths(data, job.kind), seed=job.seed, holdout=job.held
    )
    return RealRelativeOutcome(
        train.poses,
        other.identified,
        other.accuracy["holdout"].rms_mm,
        (nominal, rms_position_error_mm(held, other.robot, fitted_target_position(other))),
    )


def reduce_points_to_lengths(data: Measurements, measurement_kind: str) -> WireLengths:
    """Points as lengths: from three places around them, or from the tracker itself."""
    y = data.y[:, 0]
    around = np.array([[1.0, 0.2, -0.2], [-0.6, 0.9, 0.1], [-0.3, -1.0, 0.5]])
    three = y.mean(axis=0) + 3.0 * y.std(axis=0).max() * around
    anchors = three if measurement_kind == "wires_3" else np.zeros((1, 3))
    length = np.linalg.norm(y[:, None] - anchors, axis=-1)
    at = replace(data, y=data.y[:, :0], target_names=())
    return WireLengths(at, format_wire_names(range(1, len(anchors) + 1)), length)


def rms_position_error_mm(data: Measurements, robot: Robot, target_position: Array) -> float:
    """RMS distance of measured from predicted points after the best rigid motion [mm]."""
    return rms_in_mm(
        distances_after_alignment(
            data.y[:, 0], target_positions_in_base(robot, data.q, target_position), with_scale=False
        )
    )


def build_real_arms_table(outcomes: dict[tuple[str, str], list[RealRelativeOutcome]]) -> Table:
    """Real arms by their own points: medians over the hold-outs."""
    rows = []
    for (robot, kind), some in outcomes.items():
        middle = np.median([(o.held_mm, *o.position_mm) for o in some], axis=0).tolist()
        rows.append(
            (
                REAL_RELATIVE_ARMS[robot],
                MEASUREMENT_KINDS[kind],
                some[0].poses,
                some[0].identified,
                *middle,
            )
        )
    return Table.from_rows(
        "real arms, a tracker's points as lengths: medians over the hold-outs",
        rows,
        "robot | measured | training poses d | identified d | held out RMS mm .4f | "
        "held-out position, nominal RMS mm .3f | held-out position RMS mm .4f",
    )


RelativeOutcomes = dict[tuple[str, str, float], list[RelativeOutcome]]


def build_identified_table(outcomes_by_case: RelativeOutcomes) -> Table:
    """What each kind of measurement can tell."""
    rows = []
    for (robot, kind, compliance), outcomes in outcomes_by_case.items():
        if not compliance:
            one, agree = outcomes[0], sum(o.rank == o.identified for o in outcomes)
            rows.append(
                (
                    RELATIVE_ROBOTS[robot],
                    MEASUREMENT_KINDS[kind],
                    one.numbers,
                    one.parameters,
                    one.identified,
                    one.rank,
                    f"{agree}/{len(outcomes)}",
                )
            )
    return Table.from_rows(
        "what is identifiable",
        rows,
        "robot | measured | numbers in training d | parameters d | identified d | "
        "rank by differences d | agree",
    )


def median_of(values: Sequence[float]) -> float:
    """The median."""
    return float(np.median(values))


def build_accuracy_table(outcomes_by_case: RelativeOutcomes, compliance: float) -> Table:
    """Medians over the seeds of held-out and true errors."""
    rows = []
    for (robot, kind, bend), some in outcomes_by_case.items():
        if bend == compliance:
            tracker = median_of(
                [o.true_mm[1] for o in outcomes_by_case[robot, "tracker", compliance]]
            )
            each = [(*o.held_mm, *o.true_mm, o.worst_mm, o.shape_mm, o.sigma_mm) for o in some]
            *held, true, worst, shape, sigma = np.median(each, axis=0).tolist()
            rows.append(
                (
                    RELATIVE_ROBOTS[robot],
                    MEASUREMENT_KINDS[kind],
                    *held,
                    true,
                    true / tracker,
                    worst,
                    shape,
                    sigma,
                    f"{sum(o.converged for o in some)}/{len(some)}",
                )
            )
    bends = f"joints bend by {1e6 * compliance:g} urad/(N m), not fitted"
    arms = bends if compliance else "stiff arms"
    return Table.from_rows(
        (
            f"{RELATIVE_POSES} poses, {1e6 * RELATIVE_LENGTH_NOISE:g}"
            f" um, {arms}: medians over the seeds"
        ),
        rows,
        "robot | measured | held out, nominal RMS mm .3f | held out RMS mm .4f | "
        "true position, nominal RMS mm .3f | true position RMS mm .4f | over tracker's .2f | "
        "largest mm .4f | scaled, too: RMS mm .4f | expected by sigmas mm .4f | converged",
    )


def draw_error_figure(outcomes_by_case: RelativeOutcomes) -> Figure:
    """Held-out error of what was measured, and true error of positions, by kind."""
    figure = new_figure(11, 5)
    panels = np.atleast_1d(figure.subplots(1, len(RELATIVE_ROBOTS), sharex=True, sharey=True))
    at = np.arange(len(MEASUREMENT_KINDS))
    for axes, (robot, title) in zip(panels, RELATIVE_ROBOTS.items(), strict=True):
        for compliance, marker, word in (
            (0.0, "o", "stiff"),
            (RELATIVE_JOINT_COMPLIANCE, "s", "bending"),
        ):
            cells = [outcomes_by_case[robot, kind, compliance] for kind in MEASUREMENT_KINDS]
            held = [median_of([o.held_mm[1] for o in outcomes]) for outcomes in cells]
            true = [median_of([o.true_mm[1] for o in outcomes]) for outcomes in cells]
            axes.plot(held, at, marker, color="#0072b2", mfc="none", label=f"held out, {word} arm")
            axes.plot(true, at, marker, color="#d55e00", label=f"true position, {word} arm")
        axes.set(title=title, xscale="log", xlabel="RMS error (mm)")
        axes.set_yticks(at, list(MEASUREMENT_KINDS.values()))
        axes.grid(visible=True, alpha=0.3)
    panels[0].invert_yaxis()
    handles = panels[0].get_legend_handles_labels()
    figure.legend(*handles, loc="outside lower center", ncols=4, frameon=False)
    figure.suptitle(f"{RELATIVE_POSES} poses: what is measured, held out, and what is true")
    return figure


@study_options("relative")
@click.option("--seeds", type=int, default=20, show_default=True, help="Arms of each kind.")
def main(study: Study, seeds: int) -> None:
    """What calibration without coordinates can tell, and how true its positions are."""
    seeds = 1 if study.quick else seeds
    bends = (0.0, RELATIVE_JOINT_COMPLIANCE)
    keys = [
        (robot, kind, bend)
        for bend in bends
        for robot in RELATIVE_ROBOTS
        for kind in MEASUREMENT_KINDS
    ]
    jobs = [RelativeJob(r, k, study.seed + i, bend) for r, k, bend in keys for i in range(seeds)]
    outcomes = study.sweep(run_job, jobs, "arms")
    found = {key: outcomes[i * seeds : (i + 1) * seeds] for i, key in enumerate(keys)}
    real_keys = [
        (robot, kind)
        for robot in filter(has_measurements, REAL_RELATIVE_ARMS)
        for kind in REAL_MEASUREMENT_KINDS
    ]
    splits = 1 if study.quick else min(seeds, 10)
    tries = [RealRelativeJob(r, k, study.seed + i) for r, k in real_keys for i in range(splits)]
    results = study.sweep(run_real_job, tries, "real arms")
    judged = {key: results[i * splits : (i + 1) * splits] for i, key in enumerate(real_keys)}
    tables = [build_identified_table(found), *(build_accuracy_table(found, bend) for bend in bends)]
    tables += [build_real_arms_table(judged)] if judged else []
    content: dict[str, object] = {
        "rows": [
            {"robot": robot, "kind": kind, "compliance": bend, "seeds": [*map(vars, some)]}
            for (robot, kind, bend), some in found.items()
        ],
        "real": [
            {"robot": robot, "kind": kind, "hold_outs": [*map(vars, some)]}
            for (robot, kind), some in judged.items()
        ],
    }
    study.save(tables, content, {"relative": draw_error_figure(found)})
