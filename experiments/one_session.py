"""Is anything said to have moved within one session, where nothing has, and is a move found?

    python -m experiments one_session [--quick] [--out FOLDER] [--json FILE] [--seed N] [--arms N]

A session is cut in halves, by time and by the range of a joint; each half is calibrated by itself.
`compare` of both, and `check` of each half by the poses of the other, should name nothing: whatever
they name is a false alarm.  So should one fit, and one diagnosis, of both halves as two sessions of
which the second was measured from elsewhere.  Real arms where their measurements are on this
machine, and simulated ones whose model lacks what real ones lack: compliant joints,
gears that err once and twice a turn, lengths and zeros that drift.  Of the simulated ones
the zero of a joint is also shifted in the second half, by so much that its noncentrality is
`LAMBDA`: its square over the variance with which least squares tells it beside moves of base,
reflectors and links.  That variance counts noise and lack of fit, the lack of fit as it is drawn,
alike at poses that are alike; or, which is less, as if it were so much more noise.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

import click
import numpy as np
from scipy.spatial.transform import Rotation

from experiments.real import here, real
from experiments.record import rate
from experiments.sweep import Study, study_options
from minimax_cal.diagnosing.diagnose import diagnose
from minimax_cal.evidence.noise import orthonormal
from minimax_cal.fitting.calibrate import calibrate
from minimax_cal.fitting.fit import Fit
from minimax_cal.fitting.uncertainty import Estimator, Poses
from minimax_cal.ground.arrays import Array
from minimax_cal.ground.errors import CalibrationError, CalibrationWarning
from minimax_cal.ground.tables import Cell as TableCell
from minimax_cal.ground.tables import Table
from minimax_cal.judging.watching.comparison import compare
from minimax_cal.judging.watching.health import check
from minimax_cal.measuring.measurements import Measurements
from minimax_cal.modelling.cell import Cell
from minimax_cal.modelling.effects.changes import ENCODER_ZERO
from minimax_cal.modelling.model import model_of
from minimax_cal.modelling.simulate import Simulation, Truth, gravity, simulate
from minimax_cal.robots.robot import Robot, load_robot

REAL = ("fanuc_r2000", "irb120", "meca500_r", "qkm_hl6", "ur10_b")
ARMS = ("irb2600", "irb120", "ur10")
POSES = 120  # of a simulated session
MOST = 400  # poses of a real one
LAMBDA = 50.0
MOVES = 0.02  # a joint with less range has no halves [rad, m]
COMPLIANCE = 3e-7  # usual turn of a joint per gravity torque [rad/(N m)]
GEAR = 8e-5  # usual amplitude of each of a gear's waves [rad]
GROWTH = 5e-5  # usual growth of all lengths during a session: four kelvins of steel
NOISE = 20e-6  # of a coordinate [m]
SMALL_STEP = 1e-4  # share of all lengths, over which growth is linear
DRIFT = 3e-5  # usual drift of a joint's zero during a session [rad]


COMMANDS = {  # and where what they name is kept
    "compare": "compared", "check": "checked", "calibrate": "fitted", "diagnose": "diagnosed",
}  # fmt: skip
Names = tuple[str, ...] | None  # that a command names; None where it was not asked, or could not
NOT_MOVED, DRAWN, AS_NOISE = "", "as drawn", "as noise"  # how lack of fit counts


@dataclass(frozen=True)
class Job:
    """One session and how it is cut.

    arm: of `ARMS`, or of `REAL` where is_real.  way: time, or a joint's number from 1.  moved:
    how the lack of fit counts in the noncentrality of a joint's shift in the second half, or
    nothing where none is shifted.  flip: whether the second half comes first.  commands: that are
    asked.  drift: whether the arm drifts all through the session.
    """

    arm: str
    seed: int
    way: str
    moved: str = NOT_MOVED
    flip: bool = False
    is_real: bool = False
    commands: tuple[str, ...] = tuple(COMMANDS)
    drift: bool = True


@dataclass(frozen=True)
class Found:
    """What was named: by `compare`, and by `check`, which may not be possible; by one fit, and one
    diagnosis, of both halves as sessions.

    joint: that was moved, as J3; shift: by how much [mrad].
    """

    compared: Names = None
    checked: Names = None
    fitted: Names = None
    diagnosed: Names = None
    joint: str = ""
    shift: float = 0.0


def halves(data: Measurements, way: str) -> Array:
    """(m,) True for the first half of the poses."""
    if way == "time":
        order = data.columns.get("order", np.arange(data.poses))
        return np.asarray(np.argsort(np.argsort(order)) < data.poses // 2)
    q = data.q[:, int(way) - 1]
    return np.asarray(q <= np.median(q))


def ways(data: Measurements) -> list[str]:
    """In which a session can be cut."""
    moving = np.flatnonzero(np.ptp(data.q, axis=0) > MOVES)
    return ["time", *(str(j + 1) for j in moving)]


# ---- simulated arms that their model does not quite hold ---------------------------------------


@dataclass(frozen=True, eq=False)
class Lack:
    """A session's lack of fit: what each law does to joints and lengths, with its usual size.

    turn: (l, m, n) [rad], length: (l, m) share of all lengths; factor: (l,) drawn.
    """

    turn: Array
    length: Array
    factor: Array


def lack_of(
    robot_cell: Cell, q: Array, when: Array, rng: np.random.Generator, drift: bool = True
) -> Lack:
    """Compliance, gears, growth and drift, each of a random size.  when: (m,) 0 to 1.

    drift: whether zeros and lengths go on changing from the first pose to the last.
    """
    when = when * drift
    n, m = q.shape[1], len(q)
    turn: list[Array] = []

    def add(joint: int, size: Array) -> None:
        turn.append(np.zeros((m, n)))
        turn[-1][:, joint] = size

    load = gravity(robot_cell.robot, q)
    for j in range(n):
        add(j, COMPLIANCE * load[:, j])
        for wave in (1, 2):
            add(j, GEAR * np.sin(wave * q[:, j]))
            add(j, GEAR * np.cos(wave * q[:, j]))
        add(j, DRIFT * when)
    turn.append(np.zeros((m, n)))
    length = np.zeros((len(turn), m))
    length[-1] = GROWTH * when
    return Lack(np.array(turn), length, rng.normal(size=len(turn)))


def measured(made: Simulation, lack: Lack, joint: int, shift: Array, noise: Array) -> Measurements:
    """What is seen of the arm.  shift: (m,) of a joint [rad].  noise: (m, k, 3) [m]."""
    q = made.data.q + np.tensordot(lack.factor, lack.turn, 1)
    q[:, joint] += shift * made.cell.robot.sign[joint]
    growth = lack.factor @ lack.length
    flat = made.cell.robot.mdh.copy()
    flat[:, :2] *= 1.0 + SMALL_STEP
    grown = replace(made.cell, robot=made.cell.robot.with_mdh(flat))
    y = made.cell.predict(q)
    y = y + (grown.predict(q) - y) * (growth / SMALL_STEP)[:, None, None]
    return made.data.with_y(y + noise)


def shift_of(
    fit: Fit, data: Measurements, late: Array, joint: int, lack: Lack | None = None
) -> float:
    """The shift of a joint's zero in the later half whose noncentrality is LAMBDA [rad].

    By least squares over all links that are identified and both places of base and reflectors.
    Its variance is that over noise and lack of fit of the usual sizes; without `lack`, as if all
    that the fit of the whole session leaves were noise.  late: (m,) True where shifted.
    """
    model = model_of(fit.nominal.robot, data)
    every = Estimator(model.only(np.ones(model.names.count, dtype=bool)), np.ones(len(model.y)))
    poses, n = Poses(every, fit.cell.state), fit.robot.joints
    slope, after = poses.jacobian, late[:, None, None]
    identified = slope[..., : 5 * n][..., fit.identification.active[: 5 * n]]
    place = slope[..., 5 * n :]
    free = np.concatenate([identified, place * after, place * ~after], axis=2)
    moved = (poses.arm[..., joint] * late[:, None]).reshape(-1)
    basis = orthonormal(free.reshape(len(moved), -1))
    alone = moved - basis @ (basis.T @ moved)
    size = float(alone @ alone)
    if lack is None:
        return float(np.sqrt(LAMBDA * np.nanmean(fit.error**2) / size))
    growth = slope[..., : 2 * n] @ fit.cell.robot.mdh[:, :2].T.reshape(-1)
    laws = np.einsum("mrn,lmn->lmr", poses.arm * fit.robot.sign, lack.turn)
    laws = laws + growth * lack.length[..., None]
    by_laws = laws.reshape(len(laws), -1) @ alone / size
    return float(np.sqrt(LAMBDA * (NOISE**2 / size + by_laws @ by_laws)))


def simulated(job: Job) -> tuple[Measurements, Array, str, float]:
    """A session, its first half, the joint that moved and by how much [rad]."""
    rng = np.random.default_rng([job.seed, 7])
    robot = load_robot(job.arm)
    made = simulate(robot, POSES, 3, job.seed, Truth(compliance=0.0))
    first = halves(made.data, job.way)
    when = np.arange(POSES) / (POSES - 1.0)
    lack = lack_of(made.cell, made.data.q, when, rng, job.drift)
    noise = NOISE * rng.normal(size=made.data.y.shape)
    joint = 1 + job.seed % (robot.joints - 2)
    still = measured(made, lack, joint, np.zeros(POSES), noise)
    if not job.moved:
        return still, first, "", 0.0
    fit = calibrate(robot, still, "sum", holdout=0.0)
    counted = lack if job.moved == DRAWN else None
    shift = shift_of(fit, still, ~first, joint, counted) * (1 if job.seed % 2 else -1)
    return measured(made, lack, joint, shift * ~first, noise), first, f"J{joint + 1}", shift


# ---- the study ---------------------------------------------------------------------------------


def session(job: Job) -> tuple[Robot, Measurements, Array, str, float]:
    """Robot, measurements, first half, joint that moved, by how much [rad]."""
    if job.is_real:
        robot, data = real(job.arm)
        if data.poses > MOST:
            data = data.take(
                np.sort(np.random.default_rng(job.seed).permutation(data.poses)[:MOST])
            )
        return robot, data, halves(data, job.way), "", 0.0
    return load_robot(job.arm), *simulated(job)


def as_sessions(data: Measurements, first: Array, seed: int) -> Measurements:
    """The halves as two sessions, the second measured from elsewhere."""
    rng = np.random.default_rng([seed, 11])
    turn, away = Rotation.random(rng=rng).as_matrix(), rng.normal(size=3)
    y = np.where(first[:, None, None], data.y, data.y @ turn.T + away)
    label = np.where(first, "first", "second")
    return replace(data.with_y(y), columns={**data.columns, "session": label})


def place(term: str) -> str:
    """J3 of encoder_zero:J3; the whole name of what is no joint's."""
    effect, _, at = term.partition(":")
    return at if effect == ENCODER_ZERO.name else term


def in_one_fit(robot: Robot, both: Measurements) -> Names:
    """What one fit of two sessions says has moved of arm and reflectors."""
    try:
        fit = calibrate(robot, both, "sum")
    except CalibrationError:
        return None
    labels = [f"{one.effect}:{one.place}" for one in fit.moved if one.text]
    return tuple(dict.fromkeys(map(place, labels)))


def in_one_diagnosis(robot: Robot, both: Measurements) -> Names:
    """What a diagnosis of two sessions has confirmed of what moved."""
    try:
        found = diagnose(robot, both, quick=True)
    except CalibrationError:
        return None
    named = [
        place(one.term.label)
        for one in found.effects
        if one.established
        and (one.term.effect == ENCODER_ZERO.name or "session" in one.term.choice)
    ]
    return tuple(dict.fromkeys(named))


def of_halves(job: Job, robot: Robot, data: Measurements, first: Array) -> dict[str, Names]:
    """What `compare` of both halves and `check` of the first by the second name, if they can."""
    if not {"compare", "check"} & set(job.commands):
        return {}
    out: dict[str, Names] = {}
    with suppress(CalibrationError):  # half a session may not calibrate the arm
        a, b = (calibrate(robot, data.take(half), "sum") for half in (first, ~first))
        out["compared"] = tuple(dict.fromkeys(m.joint for m in compare(a, b).changed))
        moved = check(a, data.take(~first), "rms 0.5").moved
        out["checked"] = tuple(dict.fromkeys(m.joint for m in moved))
    return out


def run(job: Job) -> Found:
    """Both halves calibrated, compared, the first checked by the second, and both in one fit."""
    warnings.simplefilter("ignore", CalibrationWarning)
    robot, data, first, joint, shift = session(job)
    if job.flip:
        first = ~first
    found = of_halves(job, robot, data, first)
    both = as_sessions(data, first, job.seed)
    if "calibrate" in job.commands:
        found["fitted"] = in_one_fit(robot, both)
    if "diagnose" in job.commands:
        found["diagnosed"] = in_one_diagnosis(robot, both)
    return Found(**found, joint=joint, shift=1e3 * shift)


def real_jobs(seed: int) -> Iterator[Job]:
    """Every cut of every arm that is here, either half first."""
    for arm in REAL:
        if here(arm):
            for way in ways(real(arm)[1]):
                yield from (Job(arm, seed, way, NOT_MOVED, flip, True) for flip in (False, True))


def simulated_jobs(seed: int, count: int) -> Iterator[Job]:
    """So many arms as they were, cut by time and by range in turn; half of them with a joint moved.

    Cut by time, both halves hold the same lack of fit, which may then count as noise.
    """
    for number in range(count):
        arm = ARMS[number % len(ARMS)]
        joints = load_robot(arm).joints
        joint = str(1 + number // (2 * len(ARMS)) % joints)
        way = "time" if number // len(ARMS) % 2 else joint
        yield Job(arm, seed + number, way)
        if number < count // 2:
            yield Job(arm, seed + number, way, DRAWN)
            if way == "time":
                yield Job(arm, seed + number, way, AS_NOISE)


def rows_of(jobs: Sequence[Job], results: Sequence[Found]) -> Iterator[tuple[TableCell, ...]]:
    """Rates of both commands, of false alarms and of moves that were found."""
    pairs = list(zip(jobs, results, strict=True))
    kinds = (
        ("real, nothing moved", lambda job: job.is_real),
        ("simulated, nothing moved", lambda job: not job.is_real and not job.moved),
        ("moved, lack of fit as drawn", lambda job: job.moved == DRAWN),
        ("moved, lack of fit as noise", lambda job: job.moved == AS_NOISE),
    )
    for kind, belongs in kinds:
        for cut in ("time", "range"):
            for command, name in COMMANDS.items():
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
                    *(of for hits in (right, other) for of in rate(sum(hits), len(some))),
                )


@study_options("one_session")
@click.option("--arms", "count", type=int, default=200, show_default=True, help="Simulated ones.")
@click.option("--drift/--no-drift", default=True, help="Whether zeros and lengths drift.")
@click.option("--command", "commands", type=click.Choice(list(COMMANDS)), multiple=True,
              default=tuple(COMMANDS), help="Ask these alone.")  # fmt: skip
def main(study: Study, count: int, drift: bool, commands: tuple[str, ...]) -> None:
    """Rates at which halves of one session are said to differ, and at which a move is found."""
    jobs = list(simulated_jobs(study.seed, 2 if study.quick else count))
    jobs += [] if study.quick else list(real_jobs(study.seed))
    jobs = [replace(job, commands=commands, drift=drift) for job in jobs]
    results = study.sweep(run, jobs, "halves of a session")
    table = Table.made(
        f"halves of one session; a joint moved has a noncentrality of {LAMBDA:g}",
        rows_of(jobs, results),
        "arms | cut by | command | cuts d | right % .1f | 95 % from .1f | to .1f | "
        "another named % .1f | 95 % from .1f | to .1f",
    )
    names = ("arms", "cut", "command", "cuts", "right_percent", "right_low", "right_high",
             "other_percent", "other_low", "other_high")  # fmt: skip
    study.save([table], {"rows": table.records(*names)})
