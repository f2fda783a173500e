"""Is anything said to have moved within one session, where nothing has, and is a move found?

    python -m experiments one_session [--quick] [--out FOLDER] [--json FILE] [--seed N] [--arms N]

A session is cut in halves, by time and by the range of a joint; each half is calibrated by itself.
`compare` of both, and `check` of each half by the poses of the other, should name nothing: whatever
they name is a false alarm.  So should one fit, and one diagnosis, of both halves as two sessions of
which the second was measured from elsewhere.  Real arms where their measurements are on this
machine, and simulated ones whose model lacks what real ones lack: compliant joints, gears that err
once and twice a turn, lengths and zeros that drift.  Of the simulated ones the zero of a joint is
also shifted in the second half, by so much that its noncentrality is `SHIFT_NONCENTRALITY`: its
square over the variance with which least squares tells it beside moves of base, reflectors and
links.  That variance counts noise and lack of fit, the lack of fit as it is drawn, alike at poses
that are alike; or, which is less, as if it were so much more noise.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

import click
import numpy as np
from scipy.spatial.transform import Rotation

from experiments.real_arms import has_measurements, read_real_arm
from experiments.study_record import percentage_with_interval
from experiments.sweep import Study, study_options
from minimax_cal.core.arrays import Array
from minimax_cal.core.errors import CalibrationError, CalibrationWarning
from minimax_cal.core.tables import Table
from minimax_cal.core.tables import TableCell as TableCell
from minimax_cal.diagnosing.diagnose import diagnose
from minimax_cal.fitting.calibrate import calibrate
from minimax_cal.fitting.fit import Fit
from minimax_cal.fitting.uncertainty import Estimator, PosewiseFit
from minimax_cal.measuring.measurements import Measurements
from minimax_cal.modelling.cell import Cell
from minimax_cal.modelling.effects.sudden_changes import ENCODER_ZERO
from minimax_cal.modelling.point_model import build_point_model
from minimax_cal.modelling.simulate import Simulation, Truth, gravity, simulate
from minimax_cal.robots.robot import Robot, load_robot
from minimax_cal.selection.noise_model import orthonormal_basis
from minimax_cal.validation.monitoring.calibration_check import check
from minimax_cal.validation.monitoring.comparison import compare

REAL_SESSION_ARMS = ("fanuc_r2000", "irb120", "meca500_r", "qkm_hl6", "ur10_b")
SIMULATED_SESSION_ARMS = ("irb2600", "irb120", "ur10")
SIMULATED_SESSION_POSES = 120  # of a simulated session
MAX_REAL_SESSION_POSES = 400  # poses of a real one
SHIFT_NONCENTRALITY = 50.0
MIN_JOINT_RANGE_TO_CUT = 0.02  # a joint with less range has no halves [rad, m]
SESSION_COMPLIANCE_SIGMA = 3e-7  # usual turn of a joint per gravity torque [rad/(N m)]
SESSION_GEAR_AMPLITUDE_SIGMA = 8e-5  # usual amplitude of each of a gear's waves [rad]
SESSION_GROWTH_SIGMA = 5e-5  # usual growth of all lengths during a session: four kelvins of steel
SESSION_COORDINATE_NOISE = 20e-6  # of a coordinate [m]
RELATIVE_GROWTH_STEP = 1e-4  # share of all lengths, over which growth is linear
SESSION_ZERO_DRIFT_SIGMA = 3e-5  # usual drift of a joint's zero during a session [rad]


COMMAND_RESULT_FIELDS = {  # and where what they name is kept
    "compare": "compared", "check": "checked", "calibrate": "fitted", "diagnose": "diagnosed",
}  # fmt: skip
MovedNames = (
    tuple[str, ...] | None
)  # that a command names; None where it was not asked, or could not
NO_SHIFT, LACK_OF_FIT_AS_DRAWN, LACK_OF_FIT_AS_NOISE = (
    "",
    "as drawn",
    "as noise",
)  # how lack of fit counts


@dataclass(frozen=True)
class SessionJob:
    """One session and how it is cut.

    arm: of `SIMULATED_SESSION_ARMS`, or of `REAL_SESSION_ARMS` where is_real.  way: time, or a
    joint's number from 1.  moved: how the lack of fit counts in the noncentrality of a joint's
    shift in the second half, or nothing where none is shifted.  flip: whether the second half comes
    first.  commands: that are asked.  drift: whether the arm drifts all through the session.
    """

    arm: str
    seed: int
    way: str
    moved: str = NO_SHIFT
    flip: bool = False
    is_real: bool = False
    commands: tuple[str, ...] = tuple(COMMAND_RESULT_FIELDS)
    drift: bool = True


@dataclass(frozen=True)
class SessionFindings:
    """What was named: by `compare`, and by `check`, which may not be possible; by one fit, and one
    diagnosis, of both halves as sessions.

    joint: that was moved, as J3; shift: by how much [mrad].
    """

    compared: MovedNames = None
    checked: MovedNames = None
    fitted: MovedNames = None
    diagnosed: MovedNames = None
    joint: str = ""
    shift: float = 0.0


def find_first_half(data: Measurements, way: str) -> Array:
    """(m,) True for the first half of the poses."""
    if way == "time":
        order = data.columns.get("order", np.arange(data.poses))
        return np.asarray(np.argsort(np.argsort(order)) < data.poses // 2)
    q = data.q[:, int(way) - 1]
    return np.asarray(q <= np.median(q))


def list_cuts(data: Measurements) -> list[str]:
    """In which a session can be cut."""
    moving = np.flatnonzero(np.ptp(data.q, axis=0) > MIN_JOINT_RANGE_TO_CUT)
    return ["time", *(str(j + 1) for j in moving)]


# ---- simulated arms that their model does not quite hold ---------------------------------------


@dataclass(frozen=True, eq=False)
class SessionLackOfFit:
    """A session's lack of fit: what each law does to joints and lengths, with its usual size.

    turn: (l, m, n) [rad], length: (l, m) share of all lengths; factor: (l,) drawn.
    """

    turn: Array
    length: Array
    factor: Array


def draw_lack_of_fit(
    robot_cell: Cell,
    q: Array,
    session_time: Array,
    rng: np.random.Generator,
    with_drift: bool = True,
) -> SessionLackOfFit:
    """Compliance, gears, growth and drift, each of a random size.  session_time: (m,) 0 to 1.

    with_drift: whether zeros and lengths go on changing from the first pose to the last.
    """
    session_time = session_time * with_drift
    n, m = q.shape[1], len(q)
    turn: list[Array] = []

    def add(joint: int, size: Array) -> None:
        turn.append(np.zeros((m, n)))
        turn[-1][:, joint] = size

    load = gravity(robot_cell.robot, q)
    for j in range(n):
        add(j, SESSION_COMPLIANCE_SIGMA * load[:, j])
        for wave in (1, 2):
            add(j, SESSION_GEAR_AMPLITUDE_SIGMA * np.sin(wave * q[:, j]))
            add(j, SESSION_GEAR_AMPLITUDE_SIGMA * np.cos(wave * q[:, j]))
        add(j, SESSION_ZERO_DRIFT_SIGMA * session_time)
    turn.append(np.zeros((m, n)))
    length = np.zeros((len(turn), m))
    length[-1] = SESSION_GROWTH_SIGMA * session_time
    return SessionLackOfFit(np.array(turn), length, rng.normal(size=len(turn)))


def simulate_measurements(
    simulation: Simulation,
    lack_of_fit: SessionLackOfFit,
    joint_index: int,
    shift: Array,
    noise: Array,
) -> Measurements:
    """What is seen of the arm.  shift: (m,) of a joint [rad].  noise: (m, k, 3) [m]."""
    q = simulation.data.q + np.tensordot(lack_of_fit.factor, lack_of_fit.turn, 1)
    q[:, joint_index] += shift * simulation.cell.robot.sign[joint_index]
    growth = lack_of_fit.factor @ lack_of_fit.length
    flat = simulation.cell.robot.mdh.copy()
    flat[:, :2] *= 1.0 + RELATIVE_GROWTH_STEP
    grown = replace(simulation.cell, robot=simulation.cell.robot.with_mdh(flat))
    y = simulation.cell.predict(q)
    y = y + (grown.predict(q) - y) * (growth / RELATIVE_GROWTH_STEP)[:, None, None]
    return simulation.data.with_y(y + noise)


def shift_of_noncentrality(
    fit: Fit,
    data: Measurements,
    is_later_half: Array,
    joint_index: int,
    lack_of_fit: SessionLackOfFit | None = None,
) -> float:
    """The shift of a joint's zero in the later half whose noncentrality is LAMBDA [rad].

    By least squares over all links that are identified and both places of base and reflectors. Its
    variance is that over noise and lack of fit of the usual sizes; without `lack_of_fit`, as if all
    that the fit of the whole session leaves were noise.  is_later_half: (m,) True where shifted.
    """
    model = build_point_model(fit.nominal.robot, data)
    every = Estimator(
        model.with_active(np.ones(model.names.parameter_count, dtype=bool)), np.ones(len(model.y))
    )
    poses, n = PosewiseFit(every, fit.cell.parameter_values), fit.robot.joints
    slope, after = poses.jacobian, is_later_half[:, None, None]
    identified = slope[..., : 5 * n][..., fit.identification.active[: 5 * n]]
    place = slope[..., 5 * n :]
    free = np.concatenate([identified, place * after, place * ~after], axis=2)
    moved = (poses.joint_motion[..., joint_index] * is_later_half[:, None]).reshape(-1)
    basis = orthonormal_basis(free.reshape(len(moved), -1))
    alone = moved - basis @ (basis.T @ moved)
    size = float(alone @ alone)
    if lack_of_fit is None:
        return float(np.sqrt(SHIFT_NONCENTRALITY * np.nanmean(fit.error**2) / size))
    growth = slope[..., : 2 * n] @ fit.cell.robot.mdh[:, :2].T.reshape(-1)
    laws = np.einsum("mrn,lmn->lmr", poses.joint_motion * fit.robot.sign, lack_of_fit.turn)
    laws = laws + growth * lack_of_fit.length[..., None]
    by_laws = laws.reshape(len(laws), -1) @ alone / size
    return float(
        np.sqrt(SHIFT_NONCENTRALITY * (SESSION_COORDINATE_NOISE**2 / size + by_laws @ by_laws))
    )


def simulate_session(job: SessionJob) -> tuple[Measurements, Array, str, float]:
    """A session, its first half, the joint that moved and by how much [rad]."""
    rng = np.random.default_rng([job.seed, 7])
    robot = load_robot(job.arm)
    made = simulate(robot, SIMULATED_SESSION_POSES, 3, job.seed, Truth(compliance=0.0))
    first = find_first_half(made.data, job.way)
    when = np.arange(SIMULATED_SESSION_POSES) / (SIMULATED_SESSION_POSES - 1.0)
    lack = draw_lack_of_fit(made.cell, made.data.q, when, rng, job.drift)
    noise = SESSION_COORDINATE_NOISE * rng.normal(size=made.data.y.shape)
    joint = 1 + job.seed % (robot.joints - 2)
    still = simulate_measurements(made, lack, joint, np.zeros(SIMULATED_SESSION_POSES), noise)
    if not job.moved:
        return still, first, "", 0.0
    fit = calibrate(robot, still, "sum", holdout=0.0)
    counted = lack if job.moved == LACK_OF_FIT_AS_DRAWN else None
    shift = shift_of_noncentrality(fit, still, ~first, joint, counted) * (1 if job.seed % 2 else -1)
    return (
        simulate_measurements(made, lack, joint, shift * ~first, noise),
        first,
        f"J{joint + 1}",
        shift,
    )


# ---- the study ---------------------------------------------------------------------------------


def load_or_simulate_session(job: SessionJob) -> tuple[Robot, Measurements, Array, str, float]:
    """Robot, measurements, first half, joint that moved, by how much [rad]."""
    if job.is_real:
        robot, data = read_real_arm(job.arm)
        if data.poses > MAX_REAL_SESSION_POSES:
            data = data.take(
                np.sort(
                    np.random.default_rng(job.seed).permutation(data.poses)[:MAX_REAL_SESSION_POSES]
                )
            )
        return robot, data, find_first_half(data, job.way), "", 0.0
    return load_robot(job.arm), *simulate_session(job)


def label_halves_as_sessions(data: Measurements, is_first_half: Array, seed: int) -> Measurements:
    """The halves as two sessions, the second measured from elsewhere."""
    rng = np.random.default_rng([seed, 11])
    turn, away = Rotation.random(rng=rng).as_matrix(), rng.normal(size=3)
    y = np.where(is_first_half[:, None, None], data.y, data.y @ turn.T + away)
    label = np.where(is_first_half, "first", "second")
    return replace(data.with_y(y), columns={**data.columns, "session": label})


def joint_or_term_name(term: str) -> str:
    """J3 of encoder_zero:J3; the whole name of what is no joint's."""
    effect, _, at = term.partition(":")
    return at if effect == ENCODER_ZERO.name else term


def moved_in_one_fit(robot: Robot, both: Measurements) -> MovedNames:
    """What one fit of two sessions says has moved of arm and reflectors."""
    try:
        fit = calibrate(robot, both, "sum")
    except CalibrationError:
        return None
    labels = [f"{one.effect}:{one.place}" for one in fit.moved if one.text]
    return tuple(dict.fromkeys(map(joint_or_term_name, labels)))


def moved_in_one_diagnosis(robot: Robot, both: Measurements) -> MovedNames:
    """What a diagnosis of two sessions has confirmed of what moved."""
    try:
        found = diagnose(robot, both, quick=True)
    except CalibrationError:
        return None
    named = [
        joint_or_term_name(one.term.label)
        for one in found.effects
        if one.established
        and (one.term.effect == ENCODER_ZERO.name or "session" in one.term.choice)
    ]
    return tuple(dict.fromkeys(named))


def moved_between_halves(
    job: SessionJob, robot: Robot, data: Measurements, is_first_half: Array
) -> dict[str, MovedNames]:
    """What `compare` of both halves and `check` of the first by the second name, if they can."""
    if not {"compare", "check"} & set(job.commands):
        return {}
    out: dict[str, MovedNames] = {}
    with suppress(CalibrationError):  # half a session may not calibrate the arm
        a, b = (
            calibrate(robot, data.take(half), "sum") for half in (is_first_half, ~is_first_half)
        )
        out["compared"] = tuple(dict.fromkeys(m.joint for m in compare(a, b).changed))
        moved = check(a, data.take(~is_first_half), "rms 0.5").moved
        out["checked"] = tuple(dict.fromkeys(m.joint for m in moved))
    return out


def run_session(job: SessionJob) -> SessionFindings:
    """Both halves calibrated, compared, the first checked by the second, and both in one fit."""
    warnings.simplefilter("ignore", CalibrationWarning)
    robot, data, first, joint, shift = load_or_simulate_session(job)
    if job.flip:
        first = ~first
    found = moved_between_halves(job, robot, data, first)
    both = label_halves_as_sessions(data, first, job.seed)
    if "calibrate" in job.commands:
        found["fitted"] = moved_in_one_fit(robot, both)
    if "diagnose" in job.commands:
        found["diagnosed"] = moved_in_one_diagnosis(robot, both)
    return SessionFindings(**found, joint=joint, shift=1e3 * shift)


def list_real_jobs(seed: int) -> Iterator[SessionJob]:
    """Every cut of every arm that is here, either half first."""
    for arm in REAL_SESSION_ARMS:
        if has_measurements(arm):
            for way in list_cuts(read_real_arm(arm)[1]):
                yield from (
                    SessionJob(arm, seed, way, NO_SHIFT, flip, True) for flip in (False, True)
                )


def list_simulated_jobs(seed: int, arm_count: int) -> Iterator[SessionJob]:
    """So many arms as they were, cut by time and by range in turn; half of them with a joint moved.

    Cut by time, both halves hold the same lack of fit, which may then count as noise.
    """
    for number in range(arm_count):
        arm = SIMULATED_SESSION_ARMS[number % len(SIMULATED_SESSION_ARMS)]
        joints = load_robot(arm).joints
        joint = str(1 + number // (2 * len(SIMULATED_SESSION_ARMS)) % joints)
        way = "time" if number // len(SIMULATED_SESSION_ARMS) % 2 else joint
        yield SessionJob(arm, seed + number, way)
        if number < arm_count // 2:
            yield SessionJob(arm, seed + number, way, LACK_OF_FIT_AS_DRAWN)
            if way == "time":
                yield SessionJob(arm, seed + number, way, LACK_OF_FIT_AS_NOISE)


def build_rate_rows(
    jobs: Sequence[SessionJob], results: Sequence[SessionFindings]
) -> Iterator[tuple[TableCell, ...]]:
    """Rates of both commands, of false alarms and of moves that were found."""
    pairs = list(zip(jobs, results, strict=True))
    kinds = (
        ("real, nothing moved", lambda job: job.is_real),
        ("simulated, nothing moved", lambda job: not job.is_real and not job.moved),
        ("moved, lack of fit as drawn", lambda job: job.moved == LACK_OF_FIT_AS_DRAWN),
        ("moved, lack of fit as noise", lambda job: job.moved == LACK_OF_FIT_AS_NOISE),
    )
    for kind, belongs in kinds:
        for cut in ("time", "range"):
            for command, name in COMMAND_RESULT_FIELDS.items():
                some = [
                    (found.joint, getattr(found, name))
                    for job, found in pairs
                    if belongs(job) and (job.way == "time") == (cut == "time")
                    if getattr(found, name) is not None
                ]
                if not some:
                    continue
                right = [joint in named if joint else not named for joint, named in some]
                other = [bool(set(named) - {joint}) for joint, named in some]
                yield (
                    kind,
                    cut,
                    command,
                    len(some),
                    *(
                        of
                        for hits in (right, other)
                        for of in percentage_with_interval(sum(hits), len(some))
                    ),
                )


@study_options("one_session")
@click.option("--arms", "count", type=int, default=200, show_default=True, help="Simulated ones.")
@click.option("--drift/--no-drift", default=True, help="Whether zeros and lengths drift.")
@click.option(
    "--command",
    "commands",
    type=click.Choice(list(COMMAND_RESULT_FIELDS)),
    multiple=True,
    default=tuple(COMMAND_RESULT_FIELDS),
    help="Ask these alone.",
)
def main(study: Study, count: int, drift: bool, commands: tuple[str, ...]) -> None:
    """Rates at which halves of one session are said to differ, and at which a move is found."""
    jobs = list(list_simulated_jobs(study.seed, 2 if study.quick else count))
    jobs += [] if study.quick else list(list_real_jobs(study.seed))
    jobs = [replace(job, commands=commands, drift=drift) for job in jobs]
    results = study.sweep(run_session, jobs, "halves of a session")
    table = Table.from_rows(
        f"halves of one session; a joint moved has a noncentrality of {SHIFT_NONCENTRALITY:g}",
        build_rate_rows(jobs, results),
        "arms | cut by | command | cuts d | right % .1f | 95 % from .1f | to .1f | "
        "another named % .1f | 95 % from .1f | to .1f",
    )
    names = ("arms", "cut", "command", "cuts", "right_percent", "right_low", "right_high",
             "other_percent", "other_low", "other_high")  # fmt: skip
    study.save([table], {"rows": table.to_records(*names)})
