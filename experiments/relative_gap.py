"""Does a diagnosis of several instruments name the cause?  Arms of which the causes are known.

    python -m experiments.relative_gap [--quick] [--out FOLDER] [--seed N] [--jobs N] ...

The same imperfect arms are measured by a tracker and sockets, by wires and a tracker, and by whole
poses: sound ones, ones with compliant joints, with a ripple of one gear, and with a motion that no
law of the library has.  How often is a cause named, and is it the right one?
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from scipy.spatial.transform import Rotation

from experiments.relative import COMPLIANCE, NOISE, SIMULATORS, Arm, Measured
from experiments.sweep import Study, study_options
from minimax_cal.diagnosing.instruments import diagnose_relative
from minimax_cal.fitting.several.kinds import labels_of
from minimax_cal.ground.arrays import Array
from minimax_cal.ground.tables import Table
from minimax_cal.instruments.file import Given, as_instrument
from minimax_cal.measuring.measurements import measurements
from minimax_cal.modelling.simulate import gravity
from minimax_cal.robots.sampling import random_poses

RIPPLE, TEETH = 60e-6, 80.0  # amplitude [rad] and waves a turn of the third joint's gear
OUTSIDE = 150e-6  # amplitude of a turn that two joints give a third [rad]
ARMS = ("irb2600", "ur10")
SETS = {
    "tracker + sockets": ("tracker", "closures"),
    "wires + tracker": ("wires_3", "tracker"),
    "whole poses": ("poses",),
}
CAUSES = ("sound", "compliance", "ripple", "outside")
GIVEN = ("sound", "outside")  # of these also where the noises of the files are given
OF_CAUSE = {"compliance": ("joint_compliance",), "ripple": ("gear_ripple", "gear_error")}
VERDICTS = ("named", "one_of", "none", "unknown")


@dataclass(frozen=True)
class Imperfect(Arm):
    """An arm whose joints turn by more than gravity makes them.

    ripple: amplitude of the third gear's [rad].  outside: of what no law has [rad].
    """

    ripple: float = 0.0
    outside: float = 0.0

    def bent(self, q: Array) -> Array:
        """Joint values that a stiff arm would have where this one is commanded q."""
        out = q + self.compliance * gravity(self.real, q)
        out[..., 2] += self.ripple * np.sin(TEETH * q[..., 2] + 0.4)
        out[..., 1] += self.outside * np.sin(2.0 * q[..., 0] + 3.0 * q[..., 2])
        return out


@dataclass(frozen=True)
class Job:
    """One arm, measured in one way, with one cause.  given: whether the noises are."""

    robot: str
    instruments: tuple[str, ...]
    cause: str
    seed: int
    poses: int
    given: bool = False

    @property
    def called(self) -> str:
        """The cause, and what is given."""
        return f"{self.cause}, noise given" if self.given else self.cause


@dataclass(frozen=True)
class Answer:
    """verdict: of the diagnosis.  right, wrong: confirmed causes.

    before, after: held-out RMS of geometry and with the effects [mm].
    """

    verdict: str
    right: int
    wrong: tuple[str, ...]
    before: float
    after: float
    seconds: float = field(default=0.0)


def arm_of(job: Job) -> Imperfect:
    """The arm of a job: the same links for the same seed, whatever measures it."""
    sizes = {"compliance": COMPLIANCE, "ripple": RIPPLE, "outside": OUTSIDE}
    has = (size * (cause == job.cause) for cause, size in sizes.items())
    plain = Arm.of(job.robot, job.seed, 0.0)
    return Imperfect(plain.robot, plain.real, *has)


def seen(arm: Arm, kind: str, poses: int, rng: np.random.Generator) -> Given:
    """What an instrument measures."""
    if kind != "tracker":
        made: Measured = SIMULATORS[kind](arm, rng, poses, NOISE)
        return made.data
    q = random_poses(arm.robot, poses, rng)
    turn, shift = Rotation.random(rng=rng).as_matrix(), rng.normal(size=3)
    y = arm.place(q) @ turn.T + shift + NOISE * rng.normal(size=(poses, 3))
    return measurements(q, y)


def run(job: Job) -> Answer:
    """The diagnosis of one arm."""
    arm, rng = arm_of(job), np.random.default_rng([job.seed, 2])
    data = [seen(arm, kind, job.poses, rng) for kind in job.instruments]
    names = labels_of([as_instrument(each) for each in data])
    noises = dict.fromkeys(names, NOISE) if job.given else {}
    found = diagnose_relative(arm.robot, data, noises=noises)
    sure = [f.term.effect for f in found.effects if f.established and not f.minor]
    right = [name for name in sure if name in OF_CAUSE.get(job.cause, ())]
    wrong = tuple(name for name in sure if name not in right)
    ends = found.steps[1].holdout.rms_mm, found.steps[-1].holdout.rms_mm
    return Answer(found.verdict, len(right), wrong, *ends, found.seconds)


def table_of(jobs: list[Job], answers: list[Answer]) -> Table:
    """How often each verdict was given, and wrong names."""
    rows = []
    pairs = list(zip(jobs, answers, strict=True))
    for title, kinds in SETS.items():
        for cause in dict.fromkeys(job.called for job in jobs):
            own = [a for job, a in pairs if (job.instruments, job.called) == (kinds, cause)]
            count = [sum(a.verdict == verdict for a in own) for verdict in VERDICTS]
            right, wrong = sum(a.right > 0 for a in own), sum(bool(a.wrong) for a in own)
            ends = np.median([(a.before, a.after) for a in own], axis=0).tolist()
            rows.append((title, cause, len(own), *count, right, wrong, *ends))
    return Table.made(
        "diagnosis of several instruments",
        rows,
        "instruments | cause | arms d | named d | one of d | none d | unknown d | right cause d | "
        "wrong cause d | geometry mm .4f | final mm .4f",
    )


@study_options("relative_gap")
def main(study: Study) -> None:
    """Name the cause from several instruments."""
    count = 2 if study.quick else 20
    robots = ARMS[:1] if study.quick else ARMS
    jobs = [
        Job(robot, kinds, cause, study.seed + number, 100, given)
        for kinds in SETS.values()
        for cause in CAUSES
        for given in ((False, True) if cause in GIVEN else (False,))
        for robot in robots
        for number in range(count)
    ]
    answers = study.sweep(run, jobs)
    table = table_of(jobs, answers)
    study.save([table], {"answers": [vars(a) for a in answers]})
