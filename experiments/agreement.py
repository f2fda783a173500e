"""Do files of one arm agree?  Rates at which contradictions are found, and how true sigmas are.

    python -m experiments.agreement [--quick] [--out FOLDER] [--json FILE] [--seed N] [--jobs N] ...

Arms of their own kinematics (a product of 4x4 matrices, with springs, leaning axes, gears and
coupled joints) are measured by two or three of a tracker, wires and whole poses.  Half of them have
an effect that no link holds, of 0.05 to 0.5 mm, half see other joint ranges in each file.  In some
one file contradicts the others: all its lengths are longer, the zero of a joint moved, or the base
did, between files of trackers and whole poses whose instrument stayed where it was.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import click
import numpy as np
from scipy.spatial.transform import Rotation

from experiments.sweep import Study, study_options
from minimax_cal.core.arrays import Array
from minimax_cal.core.tables import Table
from minimax_cal.fitting.multi_instrument.relative_calibration import relative
from minimax_cal.fitting.multi_instrument.relative_result import RelativeCalibration
from minimax_cal.instruments import Instrument, distances, flange_poses
from minimax_cal.instruments.instrument import build_random_poses
from minimax_cal.instruments.tracker_points import build_tracker_points
from minimax_cal.measuring.measurements import measurements
from minimax_cal.robots.robot import Robot, load_robot

AGREEMENT_ROBOTS = ("irb2600", "irb120", "ur10", "ur5")
INSTRUMENT_KINDS = ("tracker", "wires", "poses")
INSTRUMENT_SETS = (  # of instruments, for the sigmas
    ("wires",), ("poses",), ("tracker", "wires"), ("tracker", "poses"), ("wires", "poses"),
    ("wires", "wires"), ("poses", "poses"), ("tracker", "wires", "poses"),
    ("wires", "wires", "poses"), ("tracker", "poses", "poses"),
)  # fmt: skip
SIMULATED_EFFECTS = ("spring", "leaning", "both", "gear", "coupled")
NO_CONTRADICTION, SCALE_CONTRADICTION, JOINT_ZERO_CONTRADICTION, BASE_CONTRADICTION = (
    "",
    "scale",
    "joint_zero",
    "base",
)
AGREEMENT_LENGTH_SIGMA, AGREEMENT_ANGLE_SIGMA = (
    0.3e-3,
    0.5e-3,
)  # standard deviation of the errors of links [m, rad]
ASSUMED_LINK_MASSES_KG = np.array([40.0, 60.0, 40.0, 15.0, 8.0, 4.0])  # of links [kg]
EFFECT_RMS_RANGE = (0.05e-3, 0.5e-3)  # RMS of what an effect moves, but for a shift of all [m]
INSTRUMENT_NOISE_RANGE = (1e-5, 6e-5)  # of a coordinate or a length [m]
CONTRADICTION_SIZE_RANGE = (3e-4, 3e-3)  # of a factor, or of a zero [rad]
BASE_SHIFT_RANGE, BASE_ROTATION_SIGMA = (
    (1e-3, 5e-3),
    1e-3,
)  # of a base that moved [m], and in each axis [rad]
MAX_JOINT_HALF_RANGE = 2.0  # at most, of a joint [rad]
ROTATION_NOISE_LEVER_ARM = 0.1  # that turns the noise of a coordinate into that of a rotation [m]


def homogeneous_transform(rotation: Array, translation: Array | None = None) -> Array:
    """(..., 4, 4) of rotations (..., 3, 3) and places (3,) [m]."""
    out = np.zeros((*rotation.shape[:-2], 4, 4))
    out[..., :3, :3], out[..., 3, 3] = rotation, 1.0
    out[..., :3, 3] = 0.0 if translation is None else translation
    return out


def rotation_about_axis(axis: str, angle: Array) -> Array:
    """(..., 4, 4) rotations about an axis by angles [rad]."""
    return homogeneous_transform(Rotation.from_euler(axis, np.reshape(angle, (-1, 1))).as_matrix())


def draw_log_uniform(rng: np.random.Generator, limits: tuple[float, float]) -> float:
    """A size between two ends, as likely in each octave."""
    return float(np.exp(rng.uniform(*np.log(limits))))


@dataclass(eq=False)
class SimulatedArm:
    """An arm whose links are off the drawing, and that may bend.

    size: RMS of what the effect moves [m].  spots: where each file's target was, in the flange.
    """

    robot: Robot
    rng: np.random.Generator
    effect: str = ""
    size: float = 0.0
    spots: list[Array] = field(default_factory=list)

    def __post_init__(self) -> None:
        rng, n = self.rng, self.robot.joints
        off = [
            AGREEMENT_LENGTH_SIGMA,
            AGREEMENT_LENGTH_SIGMA,
            AGREEMENT_ANGLE_SIGMA,
            AGREEMENT_ANGLE_SIGMA,
            AGREEMENT_ANGLE_SIGMA,
        ]
        self.mdh = self.robot.mdh + rng.normal(size=(n, 5)) * off
        self.share = rng.uniform(0.3, 1.0, n) * np.where(rng.random(n) < 0.6, 1.0, 0.0)
        self.share[1], self.phase = 1.0, rng.uniform(0.0, 2.0 * np.pi, n)
        self.unit = 0.0
        if self.effect:
            q, self.unit = self.draw_joint_values(200, in_narrow_range=False), 1e-6
            stiff = self.link_frames(q)[-1][:, :3, 3]
            for _ in range(2):  # springs are nearly linear
                moved = self.flange_poses(q)[:, :3, 3] - stiff
                moved = moved - moved.mean(axis=0)
                self.unit *= self.size / float(np.sqrt((moved**2).sum(axis=1).mean()))

    def draw_joint_values(self, count: int, *, in_narrow_range: bool) -> Array:
        """(count, n) joint values of a file [rad]; in_narrow_range: over a part of their range."""
        low, high = np.maximum(self.robot.lower, -np.pi), np.minimum(self.robot.upper, np.pi)
        middle, half = 0.5 * (low + high), np.minimum(0.5 * (high - low), MAX_JOINT_HALF_RANGE)
        if in_narrow_range:
            half = half * self.rng.uniform(0.35, 0.6, len(half))
            middle = middle + half * self.rng.uniform(-0.4, 0.4, len(half))
        return np.asarray(np.round(middle + half * self.rng.uniform(-1, 1, (count, len(half))), 6))

    def link_frames(self, q: Array, bending_vectors: Array | None = None) -> list[Array]:
        """(m, 4, 4) frames before each joint and after the last.

        bending_vectors: (n, m, 3) rotation vectors of each joint's carrier [rad].
        """
        frame, out = np.broadcast_to(np.eye(4), (len(q), 4, 4)), []
        for j, (a, d, theta, alpha, beta) in enumerate(self.mdh):
            out.append(frame)
            if bending_vectors is not None:
                frame = frame @ homogeneous_transform(
                    Rotation.from_rotvec(bending_vectors[j]).as_matrix()
                )
            frame = frame @ rotation_about_axis("z", theta + self.robot.sign[j] * q[:, j])
            frame = (
                frame
                @ homogeneous_transform(np.eye(3), np.array([a, 0.0, d]))
                @ rotation_about_axis("x", alpha)
            )
            frame = frame @ rotation_about_axis("y", beta)
        return [*out, frame]

    def flange_poses(self, q: Array) -> Array:
        """(m, 4, 4) of the flange in the base."""
        if not self.effect:
            return self.link_frames(q)[-1]
        if self.effect == "gear":
            waves = np.sin(q + self.phase) + 0.5 * np.sin(2.0 * (q + self.phase))
            return self.link_frames(q + self.unit * self.share * waves)[-1]
        if self.effect == "coupled":
            return self.link_frames(q + self.unit * np.roll(np.sin(q + self.phase), 1, axis=1))[-1]
        frames, axes = self.link_frames(q), {"spring": [2], "leaning": [0, 1], "both": [0, 1, 2]}
        bends = np.zeros((len(self.mdh), len(q), 3))
        for j in range(len(self.mdh)):
            moment = np.zeros((len(q), 3))
            for k in range(j, len(self.mdh)):
                centre = 0.5 * (frames[k] + frames[k + 1])[:, :3, 3]
                weight = np.array(
                    [
                        0.0,
                        0.0,
                        -9.81 * ASSUMED_LINK_MASSES_KG[min(k, len(ASSUMED_LINK_MASSES_KG) - 1)],
                    ]
                )
                moment += np.cross(centre - frames[j][:, :3, 3], weight)
            local = np.einsum("mji,mj->mi", frames[j][:, :3, :3], moment)
            some = axes[self.effect]
            bends[j][:, some] = self.unit * self.share[j] * local[:, some]
        return self.link_frames(q, bends)[-1]

    def simulate_measurement(
        self,
        instrument_kind: str,
        pose_count: int,
        noise: float,
        *,
        narrow: bool = False,
        length_factor: float = 1.0,
        joint_zero_errors: Array | None = None,
        base_pose: Array | None = None,
    ) -> Instrument:
        """What an instrument says of the arm from a place of its own.

        length_factor: by which it stretches lengths.  joint_zero_errors: (n,) by which joints are
        off [rad].  base_pose: (4, 4) where it stands in the frame of the instrument, anywhere
        unless given [m].
        """
        rng, q = self.rng, self.draw_joint_values(pose_count, in_narrow_range=narrow)
        pose = self.flange_poses(q if joint_zero_errors is None else q + joint_zero_errors)
        turn, origin = Rotation.random(random_state=rng).as_matrix(), rng.uniform(-2.0, 2.0, 3)
        if base_pose is not None:
            turn, origin = base_pose[:3, :3], base_pose[:3, :3].T @ base_pose[:3, 3]
        spot = np.array([0.06, -0.04, 0.1]) + rng.uniform(-0.03, 0.03, 3)
        self.spots.append(spot)
        place = pose[:, :3, 3] + pose[:, :3, :3] @ spot
        if instrument_kind == "tracker":
            y = length_factor * (place @ turn.T + origin) + noise * rng.normal(size=place.shape)
            return build_tracker_points(measurements(q, y))
        if instrument_kind == "wires":
            around = 2.0 * np.pi * np.arange(3) / 3.0 + rng.uniform(0.0, 2.0 * np.pi)
            high = rng.uniform(-0.3, 0.8, 3)
            anchors = np.stack([np.cos(around), np.sin(around), high], axis=1)
            gap = place[:, None] - 1.2 * self.robot.reach() * anchors
            length = length_factor * np.linalg.norm(gap, axis=-1)
            return distances(q, length + noise * rng.normal(size=length.shape))
        tool = Rotation.random(random_state=rng).as_matrix()
        jitter = Rotation.from_rotvec(
            noise / ROTATION_NOISE_LEVER_ARM * rng.normal(size=(pose_count, 3))
        ).as_matrix()
        seen = homogeneous_transform(jitter @ turn @ pose[:, :3, :3] @ tool)
        seen[:, :3, 3] = length_factor * (place @ turn.T + origin) + noise * rng.normal(
            size=place.shape
        )
        return flange_poses(q, seen)

    def rms_position_error(self, robot: Robot, target_position: Array) -> float:
        """RMS error of a robot's positions over the joints' range, a base fitted.

        target_position: the target on its flange [m].
        """
        q = build_random_poses(self.robot, 200).q
        true, fitted = self.flange_poses(q), robot.pose(q)
        p = true[:, :3, 3] + true[:, :3, :3] @ self.spots[0]
        g = fitted[:, :3, 3] + fitted[:, :3, :3] @ target_position
        best = Rotation.align_vectors(p - p.mean(axis=0), g - g.mean(axis=0))[0]
        left = p - p.mean(axis=0) - best.apply(g - g.mean(axis=0))
        return float(np.sqrt((left**2).sum(axis=1).mean()))


# ---- files that agree, or do not -----------------------------------------------------------------


@dataclass(frozen=True)
class AgreementJob:
    """cause: what differs in one of the files, empty where they agree."""

    seed: int
    cause: str = NO_CONTRADICTION


@dataclass(frozen=True)
class ContradictionReport:
    """cause: what is named, empty where nothing is; right: whether that is what differs."""

    status: str
    cause: str
    right: bool
    p: float


def simulate_files(job: AgreementJob) -> tuple[Robot, list[Instrument], str]:
    """A robot as drawn, the files of a job, and the place of what differs."""
    rng = np.random.default_rng([job.seed, 78])
    robot = load_robot(AGREEMENT_ROBOTS[rng.integers(len(AGREEMENT_ROBOTS))])
    effect = SIMULATED_EFFECTS[rng.integers(len(SIMULATED_EFFECTS))] if rng.random() < 0.5 else ""
    arm = SimulatedArm(robot, rng, effect, draw_log_uniform(rng, EFFECT_RMS_RANGE))
    kinds = [
        INSTRUMENT_KINDS[i] for i in rng.integers(len(INSTRUMENT_KINDS), size=rng.integers(2, 4))
    ]
    kinds[0] = "wires" if set(kinds) == {"tracker"} else kinds[0]
    bad, by = (
        int(rng.integers(len(kinds))),
        draw_log_uniform(rng, CONTRADICTION_SIZE_RANGE) * rng.choice([-1, 1]),
    )
    if job.cause == BASE_CONTRADICTION:
        kinds = [kind if kind != "wires" else "poses" for kind in kinds]
        kinds[0] = "poses" if set(kinds) == {"tracker"} else kinds[0]
    frame = homogeneous_transform(
        Rotation.random(random_state=rng).as_matrix(), rng.uniform(-2.0, 2.0, 3)
    )
    away = rng.normal(size=3)
    away *= draw_log_uniform(rng, BASE_SHIFT_RANGE) / np.linalg.norm(away)
    tilt = Rotation.from_rotvec(BASE_ROTATION_SIGMA * rng.normal(size=3)).as_matrix()
    joint, narrow = int(rng.integers(1, robot.joints - 1)), bool(rng.random() < 0.5)
    files = []
    for i, kind in enumerate(kinds):
        wrong = job.cause if i == bad else NO_CONTRADICTION
        zeros = by * (np.arange(robot.joints) == joint) * (wrong == JOINT_ZERO_CONTRADICTION)
        factor = 1.0 + by * (wrong == SCALE_CONTRADICTION)
        poses, noise = int(rng.integers(40, 90)), draw_log_uniform(rng, INSTRUMENT_NOISE_RANGE)
        moved = frame @ homogeneous_transform(tilt, away) if wrong == BASE_CONTRADICTION else frame
        base = moved if job.cause == BASE_CONTRADICTION else None
        one = arm.simulate_measurement(
            kind,
            poses,
            noise,
            narrow=narrow,
            length_factor=factor,
            joint_zero_errors=zeros,
            base_pose=base,
        )
        files.append(one)
    return robot, files, f"J{joint + 1}" if job.cause == JOINT_ZERO_CONTRADICTION else ""


def report_contradictions(job: AgreementJob) -> ContradictionReport:
    """What is told of the files of a job."""
    robot, files, place = simulate_files(job)
    found = relative(robot, files)
    first = found.contradictions[0] if found.contradictions else None
    cause = first.cause if first else None
    right = bool(cause and cause.kind == job.cause and place in ("", cause.place))
    return ContradictionReport(
        str(found.status),
        cause.kind if cause else NO_CONTRADICTION,
        right,
        first.p if first else 1.0,
    )


# ---- sigmas --------------------------------------------------------------------------------------


@dataclass(frozen=True)
class PositionSigmaJob:
    """kinds: of the files.  bends: whether the arm has an effect that no link holds."""

    seed: int
    kinds: tuple[str, ...]
    bends: bool


def fitted_target_position(calibration: RelativeCalibration) -> Array:
    """(3,) the target of the first file on the flange, as fitted [m]."""
    one = calibration.instruments[0].instrument
    if "tool" in one:
        return 1e-3 * np.array(one["tool"]["translation_mm"])
    spots = one["targets_mm"].values() if "targets_mm" in one else [one["target_mm"]]
    return np.asarray(1e-3 * np.array(list(spots)).mean(axis=0))


def position_error_over_sigma(job: PositionSigmaJob) -> float:
    """True error of positions over the claimed sigma."""
    rng = np.random.default_rng([job.seed, 4])
    robot = load_robot(AGREEMENT_ROBOTS[job.seed % len(AGREEMENT_ROBOTS)])
    effect = SIMULATED_EFFECTS[job.seed % len(SIMULATED_EFFECTS)] if job.bends else ""
    arm = SimulatedArm(robot, rng, effect, draw_log_uniform(rng, EFFECT_RMS_RANGE))
    found = relative(robot, [arm.simulate_measurement(kind, 50, 3e-5) for kind in job.kinds])
    fitted = found.calibrated or found.robot
    return arm.rms_position_error(fitted, fitted_target_position(found)) / found.position_sigma


def build_sigma_rows(
    jobs: Sequence[PositionSigmaJob], ratios: Sequence[float]
) -> Iterator[tuple[object, ...]]:
    """Medians by set of instruments, rigid and bending."""
    for kinds in INSTRUMENT_SETS:
        both = [
            [r for job, r in zip(jobs, ratios, strict=True) if (job.kinds, job.bends) == (kinds, b)]
            for b in (False, True)
        ]
        yield " + ".join(kinds), *(float(np.median(some)) for some in both)


@study_options("agreement")
@click.option("--sets", "count", type=int, default=200, show_default=True, help="That agree.")
@click.option("--arms", type=int, default=20, show_default=True, help="Of each set, for sigmas.")
def main(study: Study, count: int, arms: int) -> None:
    """Rates of contradictions, false and told, and true errors over claimed sigmas."""
    count, arms = (6, 1) if study.quick else (count, arms)
    jobs = [AgreementJob(study.seed + i) for i in range(count)]
    jobs += [
        AgreementJob(
            study.seed + 10_000 + i,
            (SCALE_CONTRADICTION, JOINT_ZERO_CONTRADICTION, BASE_CONTRADICTION)[i % 3],
        )
        for i in range(count // 2)
    ]
    told = study.sweep(report_contradictions, jobs, "files")
    rows = []
    for cause in (
        NO_CONTRADICTION,
        SCALE_CONTRADICTION,
        JOINT_ZERO_CONTRADICTION,
        BASE_CONTRADICTION,
    ):
        some = [t for job, t in zip(jobs, told, strict=True) if job.cause == cause]
        known = sum(t.p < 1.0 for t in some)
        rows.append((cause or "they agree", len(some), known, sum(t.right for t in some)))
    table = Table.from_rows(
        "two or three files", rows, "what differs | sets d | reported d | right cause d"
    )
    sigma_jobs = [
        PositionSigmaJob(study.seed + s, k, b)
        for k in INSTRUMENT_SETS
        for b in (False, True)
        for s in range(arms)
    ]
    ratios = study.sweep(position_error_over_sigma, sigma_jobs, "sigmas")
    sigmas = Table.from_rows(
        "true error of positions over claimed sigma, median",
        build_sigma_rows(sigma_jobs, ratios),
        "files | rigid .2f | bending .2f",
    )
    content = {
        "rows": table.to_records("cause", "sets", "told", "right"),
        "sigmas": sigmas.to_records("files", "rigid", "bending"),
    }
    study.save([table, sigmas], content)


if __name__ == "__main__":
    main()
