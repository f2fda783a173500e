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

from experiments.real import here, off_drawing, real
from experiments.record import canvas
from experiments.sweep import Study, study_options
from minimax_cal.fitting.calibrate import calibrate
from minimax_cal.fitting.claims import position_sigma
from minimax_cal.fitting.fit import Fit
from minimax_cal.fitting.several.kinds import relative
from minimax_cal.fitting.several.result import RelativeCalibration
from minimax_cal.ground.arrays import Array, rms
from minimax_cal.ground.tables import Table
from minimax_cal.instruments import Instrument, closures, distances, flange_poses
from minimax_cal.instruments.poses import WholePoses
from minimax_cal.instruments.sockets import CLOSED, Visits, reach
from minimax_cal.instruments.wires import Lengths, wire_names
from minimax_cal.measuring.grouping import split
from minimax_cal.measuring.measurements import Measurements, measurements
from minimax_cal.modelling.simulate import gravity
from minimax_cal.robots.robot import Robot, load_robot
from minimax_cal.robots.sampling import random_poses
from minimax_cal.robots.transforms import nearest_rotation

if TYPE_CHECKING:
    from matplotlib.figure import Figure

LENGTH, ANGLE = 0.5e-3, 1.0e-3  # standard deviation of the errors of links [m, rad]
NOISE, TURN = 15e-6, 0.15e-3  # of a length or coordinate, and of an angle [m, rad]
COMPLIANCE = 3.0e-7  # of every joint, where the arm bends and no fit knows [rad/(N m)]
SPOT = np.array([0.06, 0.03, 0.12])  # the target in the last frame [m]
POSES, CHECKS = 100, 500
SOCKETS = 10
BARS = (0.15, 0.225, 0.3)  # lengths of the telescoping bar, per metre of reach
ROBOTS = {"irb2600": "IRB 2600", "ur10": "UR10"}
KINDS = {
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
STEP, RANK = 1e-6, 1e-6  # of finite differences, and of their singular values


@dataclass(frozen=True)
class Arm:
    """An arm as drawn, the true one, and how it bends."""

    robot: Robot
    real: Robot
    compliance: float

    @staticmethod
    def of(name: str, seed: int, compliance: float) -> Arm:
        """The same true arm for the same seed, whatever measures it."""
        robot, rng = load_robot(name), np.random.default_rng([seed, 1])
        return Arm(robot, off_drawing(robot, rng, LENGTH, ANGLE), compliance)

    def bent(self, q: Array) -> Array:
        """Joint values that a stiff arm would have where this one is told q."""
        return q + self.compliance * gravity(self.real, q) if self.compliance else q

    def place(self, q: Array) -> Array:
        """The true target in the base: (m, 3) [m]."""
        return place(self.real, self.bent(q), SPOT)


def place(robot: Robot, q: Array, spot: Array) -> Array:
    """A point of the last frame in the base: (m, 3) [m]."""
    pose = robot.pose(q)
    return np.asarray(pose[:, :3, :3] @ spot + pose[:, :3, 3])


# ---- what is measured ------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Measured:
    """data: of an instrument.  known: distances between sockets, as `RelativeOptions` has them."""

    data: Instrument
    known: tuple[tuple[str, str, float], ...] = ()


def wires(arm: Arm, rng: np.random.Generator, poses: int, noise: float, count: int) -> Measured:
    """Draw-wires from anchors around the arm to the target."""
    size = 0.8 * arm.robot.reach()
    angle = 2.0 * np.pi * np.arange(count) / count + 0.5
    high = 0.35 * np.arange(count) - 0.2
    anchors = size * np.stack([np.cos(angle), np.sin(angle), high], axis=1)
    q = random_poses(arm.robot, poses, rng)
    length = np.linalg.norm(arm.place(q)[:, None] - anchors, axis=-1)
    return Measured(distances(q, length + noise * rng.normal(size=length.shape)))


def ball_bar(arm: Arm, rng: np.random.Generator, poses: int, noise: float) -> Measured:
    """A telescoping bar, of some nominal lengths, in three cups by turns."""
    size = arm.robot.reach()
    cups = size * np.array([[0.3, 0.1, 0.1], [-0.1, 0.35, 0.15], [-0.2, -0.25, 0.3]])
    q, cup = np.zeros((0, arm.robot.joints)), np.zeros(0, dtype=int)
    while len(q) < poses:
        which = rng.integers(len(cups), size=2 * poses)
        aside = rng.normal(size=(2 * poses, 3))
        aside[:, 2] = np.abs(aside[:, 2])  # cups hold from above
        long = size * rng.choice(BARS, 2 * poses) / np.linalg.norm(aside, axis=1)
        start = random_poses(arm.robot, 2 * poses, rng)
        found, gap = reach(arm.robot, SPOT, cups[which] + long[:, None] * aside, start, 30)
        kept = (gap < CLOSED) & inside(arm.robot, found)
        q, cup = np.concatenate([q, found[kept]])[:poses], np.append(cup, which[kept])[:poses]
    length = np.full((poses, len(cups)), np.nan)
    true = np.linalg.norm(arm.place(q) - cups[cup], axis=1)
    length[np.arange(poses), cup] = true + noise * rng.normal(size=poses)
    return Measured(distances(q, length))


def sockets(
    arm: Arm, rng: np.random.Generator, poses: int, noise: float, *, plate: bool, known: bool
) -> Measured:
    """The ball in sockets, in the whole workspace or on a plate, each reached in many ways."""
    visits, size = poses // SOCKETS, arm.robot.reach()
    q, label = np.zeros((0, arm.robot.joints)), np.zeros(0, dtype=int)
    centres = np.zeros((0, 3))
    while len(centres) < SOCKETS:
        centre = arm.place(random_poses(arm.robot, 1, rng))[0]
        if plate:
            centre = size * np.array([0.35, 0.0, 0.25]) + rng.uniform(-0.2, 0.2, 3) * [1, 1, 0.1]
        goal = centre + noise * rng.normal(size=(10 * visits, 3))
        start = random_poses(arm.robot, len(goal), rng)
        found, gap = reach(arm.real, SPOT, goal, start, iterations=30)
        told = found
        for _ in range(5):  # what the controller is told, so that the bent arm is there
            told = found - (arm.bent(told) - told)
        kept = np.flatnonzero((gap < CLOSED) & inside(arm.robot, told))[:visits]
        if len(kept) == visits:
            q, label = np.concatenate([q, told[kept]]), np.append(label, [len(centres)] * visits)
            centres = np.concatenate([centres, centre[None]])
    names = np.array([f"S{i + 1}" for i in range(SOCKETS)])
    away = np.linalg.norm(centres - centres[0], axis=1)
    far = int(away.argmax())
    pair = (str(names[0]), str(names[far]), float(away[far] + noise * rng.normal()))
    return Measured(closures(q, names[label]), (pair,) if known else ())


def poses_6d(arm: Arm, rng: np.random.Generator, poses: int, noise: float) -> Measured:
    """Whole poses of a frame at the target, from a random place."""
    q = random_poses(arm.robot, poses, rng)
    base, tool = np.eye(4), np.eye(4)
    base[:3, :3], base[:3, 3] = Rotation.random(rng=rng).as_matrix(), 3.0 * rng.normal(size=3)
    tool[:3, 3] = SPOT
    pose = base @ arm.real.pose(arm.bent(q)) @ tool
    pose[:, :3, 3] += noise * rng.normal(size=(poses, 3))
    turn = Rotation.from_rotvec(noise / NOISE * TURN * rng.normal(size=(poses, 3)))
    pose[:, :3, :3] = pose[:, :3, :3] @ turn.as_matrix()
    return Measured(flange_poses(q, pose))


def inside(robot: Robot, q: Array) -> Array:
    """(m,) True within the limits and one turn."""
    span = np.where(robot.prismatic, 0.5, np.pi)
    lower, upper = np.maximum(robot.lower, -span), np.minimum(robot.upper, span)
    return np.asarray(((q >= lower) & (q <= upper)).all(axis=1))


Simulator = Callable[[Arm, np.random.Generator, int, float], Measured]
SIMULATORS: dict[str, Simulator] = {
    "poses": poses_6d,
    "wires_4": partial(wires, count=4),
    "wires_3": partial(wires, count=3),
    "wires_1": partial(wires, count=1),
    "ball_bar": ball_bar,
    "closures": partial(sockets, plate=False, known=False),
    "closures_known": partial(sockets, plate=False, known=True),
    "plate_known": partial(sockets, plate=True, known=True),
}


# ---- what is true ----------------------------------------------------------------------------


def position_errors(arm: Arm, robot: Robot, spot: Array, q: Array, *, scaled: bool) -> Array:
    """Distance (m,) of true from predicted positions after the best rigid motion [m].

    scaled: after the best scale too.
    """
    return apart(arm.place(q), place(robot, q, spot), scaled=scaled)


def apart(true: Array, predicted: Array, *, scaled: bool) -> Array:
    """Distance (m,) of points from points (m, 3) after the best rigid motion, or similarity [m]."""
    off, moved = true - true.mean(axis=0), predicted - predicted.mean(axis=0)
    moved = moved @ nearest_rotation(off.T @ moved).T
    scale = (off * moved).sum() / (moved**2).sum() if scaled else 1.0
    return np.asarray(np.linalg.norm(off - scale * moved, axis=1))


Predict = Callable[[Robot, Array, Array, Array], Array]


def rank_by_differences(arm: Arm, q: Array, own: Array, predict: Predict) -> int:
    """Parameters that a Jacobian by central differences tells, at the true arm.

    Every unknown is moved, sockets' places too: nothing is eliminated, and nothing is known about
    redundancy.  predict(robot, q, spot, own) are the numbers measured.  own: (o,) unknowns of the
    instrument.
    """
    n = arm.real.joints
    x0 = np.concatenate([arm.real.mdh.reshape(-1), SPOT, own.reshape(-1)])

    def numbers(x: Array) -> Array:
        robot = arm.real.with_mdh(x[: 5 * n].reshape(n, 5))
        return predict(robot, q, x[5 * n : 5 * n + 3], x[5 * n + 3 :])

    steps = STEP * np.eye(len(x0))
    slope = [(numbers(x0 + step) - numbers(x0 - step)) / (2.0 * STEP) for step in steps]
    norm = np.linalg.norm(slope, axis=1, keepdims=True)
    matrix = np.array(slope)[norm[:, 0] > 1e-9] / norm[norm[:, 0] > 1e-9]
    values = np.linalg.svd(matrix, compute_uv=False)
    return int((values > RANK * values[0]).sum())


def seen_points(robot: Robot, q: Array, spot: Array, own: Array) -> Array:
    """What a tracker sees: own is the base's pose."""
    base = Rotation.from_rotvec(own[3:]).as_matrix()
    return np.asarray(place(robot, q, spot) @ base.T + own[:3]).reshape(-1)


def seen_poses(robot: Robot, q: Array, spot: Array, own: Array) -> Array:
    """Four points of the measured frame: own is the base's pose and the tool's turn."""
    tool = Rotation.from_rotvec(own[6:]).as_matrix()
    corners = [spot, *(spot + 0.1 * tool.T)]
    return np.concatenate([seen_points(robot, q, corner, own[:6]) for corner in corners])


def lengths(robot: Robot, q: Array, spot: Array, own: Array, seen: Array) -> Array:
    """Lengths of wires where seen (m, s): own is the anchors."""
    gap = place(robot, q, spot)[:, None] - own.reshape(-1, 3)
    return np.asarray(np.linalg.norm(gap, axis=-1)[seen])


def gaps(
    robot: Robot, q: Array, spot: Array, own: Array, socket: Array, pairs: Sequence[Array]
) -> Array:
    """Gaps of visits, and distances between pairs of sockets: own is the sockets' places."""
    centres = own.reshape(-1, 3)
    apart = [np.linalg.norm(centres[a] - centres[b]) for a, b in pairs]
    return np.concatenate([(place(robot, q, spot) - centres[socket]).reshape(-1), apart])


def rank_of(arm: Arm, measured: Measured) -> int:
    """Rank of the plain model of a measurement, the sockets' places not counted."""
    data = measured.data
    q = arm.bent(data.at.q)
    if isinstance(data, WholePoses):
        return rank_by_differences(arm, q, np.zeros(9), seen_poses)
    if isinstance(data, Lengths):
        anchors = arm.real.reach() * np.random.default_rng(0).normal(size=(len(data.wires), 3))
        seen = np.isfinite(data.length)
        return rank_by_differences(arm, q, anchors, partial(lengths, seen=seen))
    visits = data.socket if isinstance(data, Visits) else np.zeros(0)
    labels, socket = np.unique(visits, return_inverse=True)
    at = place(arm.real, q, SPOT)
    centres = np.stack([at[socket == i].mean(axis=0) for i in range(len(labels))])
    # where closures miss by the noise's micrometres, even the scale seems told
    q, _ = reach(arm.real, SPOT, centres[socket], q)
    pairs = [np.searchsorted(labels, known[:2]) for known in measured.known]
    predict = partial(gaps, socket=socket, pairs=pairs)
    return rank_by_differences(arm, q, centres, predict) - 3 * len(labels)


# ---- the study -------------------------------------------------------------------------------


@dataclass(frozen=True)
class Job:
    """One arm seen by one instrument.  compliance: of every joint [rad/(N m)]."""

    robot: str
    kind: str
    seed: int
    compliance: float


@dataclass(frozen=True)
class Outcome:
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


def run(job: Job) -> Outcome:
    """Simulate, calibrate, and compare with the truth; a tracker with one reflector by itself."""
    arm = Arm.of(job.robot, job.seed, job.compliance)
    rng = np.random.default_rng([job.seed, 2, list(KINDS).index(job.kind)])
    checks = random_poses(arm.robot, CHECKS, np.random.default_rng([job.seed, 3]))
    fit: Fit | RelativeCalibration
    if job.kind == "tracker":
        q = random_poses(arm.robot, POSES, rng)
        y = arm.place(q) + NOISE * rng.normal(size=(POSES, 3))
        fit = calibrate(arm.robot, measurements(q, y), objective="sum")
        state, spot = fit.cell.state, fit.cell.target_positions[0]
        numbers, identified = 3 * fit.accuracy["train"].poses, count_of(fit)
        rank = rank_by_differences(arm, arm.bent(q), np.zeros(6), seen_points)
        sigma = position_sigma(arm.robot, state.mdh, state.target_positions, fit.covariance)
    else:
        measured = SIMULATORS[job.kind](arm, rng, POSES, NOISE)
        fit = relative(arm.robot, measured.data, known_distances=measured.known)
        numbers, identified = fit.numbers["train"] + len(measured.known), fit.identified
        rank, sigma, spot = rank_of(arm, measured), fit.position_sigma, spot_of(fit)
    found, shape = (
        position_errors(arm, fit.robot, spot, checks, scaled=scaled) for scaled in (False, True)
    )
    nominal = position_errors(arm, arm.robot, SPOT, checks, scaled=False)
    return Outcome(
        numbers=numbers,
        parameters=len(fit.parameters),
        identified=identified,
        rank=rank,
        held_mm=(fit.accuracy["nominal"].rms_mm, fit.accuracy["holdout"].rms_mm),
        true_mm=(rms_mm(nominal), rms_mm(found)),
        shape_mm=rms_mm(shape),
        worst_mm=float(1e3 * found.max()),
        sigma_mm=1e3 * sigma,
        converged=fit.status == "converged",
    )


def count_of(fit: Fit) -> int:
    """How many parameters are identified."""
    return sum(p.identifiable for p in fit.parameters)


def spot_of(fit: RelativeCalibration) -> Array:
    """The fitted target in the last frame: (3,) [m]."""
    place = fit.instrument
    millimetres = place["target_mm"] if "target_mm" in place else place["tool"]["translation_mm"]
    return 1e-3 * np.array(millimetres)


def rms_mm(distance: Array) -> float:
    """Root mean square of distances [m], in millimetres."""
    return 1e3 * rms(distance)


# ---- real arms -------------------------------------------------------------------------------

REAL = {"irb120": "IRB 120", "meca500_r": "Meca500", "fanuc_r2000": "FANUC R-2000"}
REAL_KINDS = ("tracker", "wires_3", "wires_1")


@dataclass(frozen=True)
class RealJob:
    """A real arm, its tracker's points seen as lengths from some places.

    held: share held out, by which seed.
    """

    robot: str
    kind: str
    seed: int
    held: float = 0.2


@dataclass(frozen=True)
class RealOutcome:
    """poses: in training.  identified: parameters.  held_mm: RMS of what was measured, held out.

    position_mm: RMS of the reflector's held-out positions, nominal and calibrated, a base fitted.
    """

    poses: int
    identified: int
    held_mm: float
    position_mm: tuple[float, float]


def run_real(job: RealJob) -> RealOutcome:
    """Reduce real points to lengths, calibrate, and judge by the held-out points."""
    robot, every = real(job.robot)
    data = every.only(0)
    train, held, _ = split(data, job.held, job.seed)
    fit = calibrate(robot, train, objective="sum", holdout=0.0)
    nominal = after_base(held, robot, fit.nominal.target_positions[0])
    if job.kind == "tracker":
        held_mm = rms_mm(np.linalg.norm(fit.cell.error(held)[:, 0], axis=1))
        after = after_base(held, fit.robot, fit.cell.target_positions[0])
        return RealOutcome(train.poses, count_of(fit), held_mm, (nominal, after))
    other = relative(robot, seen_from(data, job.kind), seed=job.seed, holdout=job.held)
    return RealOutcome(
        train.poses,
        other.identified,
        other.accuracy["holdout"].rms_mm,
        (nominal, after_base(held, other.robot, spot_of(other))),
    )


def seen_from(data: Measurements, kind: str) -> Lengths:
    """Points as lengths: from three places around them, or from the tracker itself."""
    y = data.y[:, 0]
    around = np.array([[1.0, 0.2, -0.2], [-0.6, 0.9, 0.1], [-0.3, -1.0, 0.5]])
    three = y.mean(axis=0) + 3.0 * y.std(axis=0).max() * around
    anchors = three if kind == "wires_3" else np.zeros((1, 3))
    length = np.linalg.norm(y[:, None] - anchors, axis=-1)
    at = replace(data, y=data.y[:, :0], target_names=())
    return Lengths(at, wire_names(range(1, len(anchors) + 1)), length)


def after_base(data: Measurements, robot: Robot, spot: Array) -> float:
    """RMS distance of measured from predicted points after the best rigid motion [mm]."""
    return rms_mm(apart(data.y[:, 0], place(robot, data.q, spot), scaled=False))


def real_table(found: dict[tuple[str, str], list[RealOutcome]]) -> Table:
    """Real arms by their own points: medians over the hold-outs."""
    rows = []
    for (robot, kind), some in found.items():
        middle = np.median([(o.held_mm, *o.position_mm) for o in some], axis=0).tolist()
        rows.append((REAL[robot], KINDS[kind], some[0].poses, some[0].identified, *middle))
    return Table.made(
        "real arms, a tracker's points as lengths: medians over the hold-outs",
        rows,
        "robot | measured | training poses d | identified d | held out RMS mm .4f | "
        "held-out position, nominal RMS mm .3f | held-out position RMS mm .4f",
    )


Found = dict[tuple[str, str, float], list[Outcome]]


def identified_table(found: Found) -> Table:
    """What each kind of measurement can tell."""
    rows = []
    for (robot, kind, compliance), outcomes in found.items():
        if not compliance:
            one, agree = outcomes[0], sum(o.rank == o.identified for o in outcomes)
            rows.append((ROBOTS[robot], KINDS[kind], one.numbers, one.parameters, one.identified,
                         one.rank, f"{agree}/{len(outcomes)}"))  # fmt: skip
    return Table.made(
        "what is identifiable",
        rows,
        "robot | measured | numbers in training d | parameters d | identified d | "
        "rank by differences d | agree",
    )


def middle(values: Sequence[float]) -> float:
    """The median."""
    return float(np.median(values))


def accuracy_table(found: Found, compliance: float) -> Table:
    """Medians over the seeds of held-out and true errors."""
    rows = []
    for (robot, kind, bend), some in found.items():
        if bend == compliance:
            tracker = middle([o.true_mm[1] for o in found[robot, "tracker", compliance]])
            each = [(*o.held_mm, *o.true_mm, o.worst_mm, o.shape_mm, o.sigma_mm) for o in some]
            *held, true, worst, shape, sigma = np.median(each, axis=0).tolist()
            rows.append((ROBOTS[robot], KINDS[kind], *held, true, true / tracker, worst, shape,
                         sigma, f"{sum(o.converged for o in some)}/{len(some)}"))  # fmt: skip
    bends = f"joints bend by {1e6 * compliance:g} urad/(N m), not fitted"
    arms = bends if compliance else "stiff arms"
    return Table.made(
        f"{POSES} poses, {1e6 * NOISE:g} um, {arms}: medians over the seeds",
        rows,
        "robot | measured | held out, nominal RMS mm .3f | held out RMS mm .4f | "
        "true position, nominal RMS mm .3f | true position RMS mm .4f | over tracker's .2f | "
        "largest mm .4f | scaled, too: RMS mm .4f | expected by sigmas mm .4f | converged",
    )


def figure_of(found: Found) -> Figure:
    """Held-out error of what was measured, and true error of positions, by kind."""
    figure = canvas(11, 5)
    panels = np.atleast_1d(figure.subplots(1, len(ROBOTS), sharex=True, sharey=True))
    at = np.arange(len(KINDS))
    for axes, (robot, title) in zip(panels, ROBOTS.items(), strict=True):
        for compliance, marker, word in ((0.0, "o", "stiff"), (COMPLIANCE, "s", "bending")):
            cells = [found[robot, kind, compliance] for kind in KINDS]
            held = [middle([o.held_mm[1] for o in outcomes]) for outcomes in cells]
            true = [middle([o.true_mm[1] for o in outcomes]) for outcomes in cells]
            axes.plot(held, at, marker, color="#0072b2", mfc="none", label=f"held out, {word} arm")
            axes.plot(true, at, marker, color="#d55e00", label=f"true position, {word} arm")
        axes.set(title=title, xscale="log", xlabel="RMS error (mm)")
        axes.set_yticks(at, list(KINDS.values()))
        axes.grid(visible=True, alpha=0.3)
    panels[0].invert_yaxis()
    handles = panels[0].get_legend_handles_labels()
    figure.legend(*handles, loc="outside lower center", ncols=4, frameon=False)
    figure.suptitle(f"{POSES} poses: what is measured, held out, and what is true")
    return figure


@study_options("relative")
@click.option("--seeds", type=int, default=20, show_default=True, help="Arms of each kind.")
def main(study: Study, seeds: int) -> None:
    """What calibration without coordinates can tell, and how true its positions are."""
    seeds = 1 if study.quick else seeds
    bends = (0.0, COMPLIANCE)
    keys = [(robot, kind, bend) for bend in bends for robot in ROBOTS for kind in KINDS]
    jobs = [Job(r, k, study.seed + i, bend) for r, k, bend in keys for i in range(seeds)]
    outcomes = study.sweep(run, jobs, "arms")
    found = {key: outcomes[i * seeds : (i + 1) * seeds] for i, key in enumerate(keys)}
    real_keys = [(robot, kind) for robot in filter(here, REAL) for kind in REAL_KINDS]
    splits = 1 if study.quick else min(seeds, 10)
    tries = [RealJob(r, k, study.seed + i) for r, k in real_keys for i in range(splits)]
    results = study.sweep(run_real, tries, "real arms")
    judged = {key: results[i * splits : (i + 1) * splits] for i, key in enumerate(real_keys)}
    tables = [identified_table(found), *(accuracy_table(found, bend) for bend in bends)]
    tables += [real_table(judged)] if judged else []
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
    study.save(tables, content, {"relative": figure_of(found)})
