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

from experiments.relative import (
    MEASUREMENT_SIMULATORS,
    RELATIVE_JOINT_COMPLIANCE,
    RELATIVE_LENGTH_NOISE,
    ImperfectArm,
    RelativeMeasurement,
)
from experiments.sweep import Study, study_options
from minimax_cal.core.arrays import Array
from minimax_cal.core.tables import Table
from minimax_cal.diagnosing.diagnose_instruments import diagnose_relative
from minimax_cal.fitting.multi_instrument.relative_calibration import file_labels
from minimax_cal.instruments.instrument_files import InstrumentInput, convert_to_instrument
from minimax_cal.measuring.measurements import measurements
from minimax_cal.modelling.simulate import gravity
from minimax_cal.robots.joint_sampling import random_joint_values_above_floor

GEAR_RIPPLE_AMPLITUDE, GEAR_RIPPLE_WAVES = (
    60e-6,
    80.0,
)  # amplitude [rad] and waves a turn of the third joint's gear
OUTSIDE_LAW_AMPLITUDE = 150e-6  # amplitude of a turn that two joints give a third [rad]
RELATIVE_GAP_ARMS = ("irb2600", "ur10")
RELATIVE_GAP_INSTRUMENT_SETS = {
    "tracker + sockets": ("tracker", "closures"),
    "wires + tracker": ("wires_3", "tracker"),
    "whole poses": ("poses",),
}
RELATIVE_GAP_CAUSES = ("sound", "compliance", "ripple", "outside")
CAUSES_WITH_GIVEN_NOISE = (
    "sound",
    "outside",
)  # of these also where the noises of the files are given
EFFECTS_BY_CAUSE = {"compliance": ("joint_compliance",), "ripple": ("gear_ripple", "gear_error")}
REPORTED_VERDICTS = ("named", "one_of", "none", "unknown")


@dataclass(frozen=True)
class ArmWithCause(ImperfectArm):
    """An arm whose joints turn by more than gravity makes them.

    ripple: amplitude of the third gear's [rad].  outside: of what no law has [rad].
    """

    ripple: float = 0.0
    outside: float = 0.0

    def bent_joint_values(self, q: Array) -> Array:
        """Joint values that a stiff arm would have where this one is commanded q."""
        out = q + self.compliance * gravity(self.real, q)
        out[..., 2] += self.ripple * np.sin(GEAR_RIPPLE_WAVES * q[..., 2] + 0.4)
        out[..., 1] += self.outside * np.sin(2.0 * q[..., 0] + 3.0 * q[..., 2])
        return out


@dataclass(frozen=True)
class RelativeGapJob:
    """One arm, measured in one way, with one cause.  given: whether the noises are."""

    robot: str
    instruments: tuple[str, ...]
    cause: str
    seed: int
    poses: int
    given: bool = False

    @property
    def cause_label(self) -> str:
        """The cause, and what is given."""
        return f"{self.cause}, noise given" if self.given else self.cause


@dataclass(frozen=True)
class RelativeGapAnswer:
    """verdict: of the diagnosis.  right, wrong: confirmed causes.

    before, after: held-out RMS of geometry and with the effects [mm].
    """

    verdict: str
    right: int
    wrong: tuple[str, ...]
    before: float
    after: float
    seconds: float = field(default=0.0)


def draw_arm(job: RelativeGapJob) -> ArmWithCause:
    """The arm of a job: the same links for the same seed, whatever measures it."""
    sizes = {
        "compliance": RELATIVE_JOINT_COMPLIANCE,
        "ripple": GEAR_RIPPLE_AMPLITUDE,
        "outside": OUTSIDE_LAW_AMPLITUDE,
    }
    has = (size * (cause == job.cause) for cause, size in sizes.items())
    plain = ImperfectArm.draw(job.robot, job.seed, 0.0)
    return ArmWithCause(plain.robot, plain.real, *has)


def simulate_instrument(
    arm: ImperfectArm, instrument_kind: str, pose_count: int, rng: np.random.Generator
) -> InstrumentInput:
    """What an instrument measures."""
    if instrument_kind != "tracker":
        made: RelativeMeasurement = MEASUREMENT_SIMULATORS[instrument_kind](
            arm, rng, pose_count, RELATIVE_LENGTH_NOISE
        )
        return made.data
    q = random_joint_values_above_floor(arm.robot, pose_count, rng)
    turn, shift = Rotation.random(rng=rng).as_matrix(), rng.normal(size=3)
    y = (
        arm.target_positions(q) @ turn.T
        + shift
        + RELATIVE_LENGTH_NOISE * rng.normal(size=(pose_count, 3))
    )
    return measurements(q, y)


def run_job(job: RelativeGapJob) -> RelativeGapAnswer:
    """The diagnosis of one arm."""
    arm, rng = draw_arm(job), np.random.default_rng([job.seed, 2])
    data = [simulate_instrument(arm, kind, job.poses, rng) for kind in job.instruments]
    names = file_labels([convert_to_instrument(each) for each in data])
    noises = dict.fromkeys(names, RELATIVE_LENGTH_NOISE) if job.given else {}
    found = diagnose_relative(arm.robot, data, noises=noises)
    sure = [f.term.effect for f in found.effects if f.established and not f.minor]
    right = [name for name in sure if name in EFFECTS_BY_CAUSE.get(job.cause, ())]
    wrong = tuple(name for name in sure if name not in right)
    ends = found.steps[1].holdout.rms_mm, found.steps[-1].holdout.rms_mm
    return RelativeGapAnswer(found.verdict, len(right), wrong, *ends, found.seconds)


def build_verdict_table(jobs: list[RelativeGapJob], answers: list[RelativeGapAnswer]) -> Table:
    """How often each verdict was given, and wrong names."""
    rows = []
    pairs = list(zip(jobs, answers, strict=True))
    for title, kinds in RELATIVE_GAP_INSTRUMENT_SETS.items():
        for cause in dict.fromkeys(job.cause_label for job in jobs):
            own = [a for job, a in pairs if (job.instruments, job.cause_label) == (kinds, cause)]
            count = [sum(a.verdict == verdict for a in own) for verdict in REPORTED_VERDICTS]
            right, wrong = sum(a.right > 0 for a in own), sum(bool(a.wrong) for a in own)
            ends = np.median([(a.before, a.after) for a in own], axis=0).tolist()
            rows.append((title, cause, len(own), *count, right, wrong, *ends))
    return Table.from_rows(
        "diagnosis of several instruments",
        rows,
        "instruments | cause | arms d | named d | one of d | none d | unknown d | right cause d | "
        "wrong cause d | geometry mm .4f | final mm .4f",
    )


@study_options("relative_gap")
def main(study: Study) -> None:
    """Name the cause from several instruments."""
    count = 2 if study.quick else 20
    robots = RELATIVE_GAP_ARMS[:1] if study.quick else RELATIVE_GAP_ARMS
    jobs = [
        RelativeGapJob(robot, kinds, cause, study.seed + number, 100, given)
        for kinds in RELATIVE_GAP_INSTRUMENT_SETS.values()
        for cause in RELATIVE_GAP_CAUSES
        for given in ((False, True) if cause in CAUSES_WITH_GIVEN_NOISE else (False,))
        for robot in robots
        for number in range(count)
    ]
    answers = study.sweep(run_job, jobs)
    table = build_verdict_table(jobs, answers)
    study.save([table], {"answers": [vars(a) for a in answers]})
