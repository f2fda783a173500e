"""Plan a motion whose torques tell an arm's masses and friction, and what they will tell."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np

from minimax_cal.core.arrays import Array
from minimax_cal.core.errors import OptionError
from minimax_cal.core.files import convert_to_plain_json
from minimax_cal.core.option_fields import (
    check_seed,
    option_field_in_group,
    take_option_fields_as_keywords,
)
from minimax_cal.core.progress_stages import Progress, silent_progress
from minimax_cal.core.record_fields import FieldFormat, StoredSeparately
from minimax_cal.core.results import Result
from minimax_cal.core.tables import Table
from minimax_cal.dynamics.regressor import (
    INERTIAL_PARAMETERS_PER_LINK,
    JointMotion,
    build_nominal_inertial_parameters,
    compute_base_parameter_combinations,
    regressor,
)
from minimax_cal.planning.candidate_poses import find_joint_limits
from minimax_cal.planning.fourier_motion import (
    FINAL_COLLISION_CHECK_HZ,
    FourierMotion,
    MotionLimits,
    draw_allowed_motion,
    improve_motion_by_random_steps,
    shrink_until_allowed,
)
from minimax_cal.planning.plan_options import PlanOptions
from minimax_cal.planning.pose_visibility import BODY_RADIUS_FRACTION_OF_REACH, ArmWorkspace
from minimax_cal.planning.visit_route import RADIANS_TO_ANGLE_UNIT, format_rounded_csv
from minimax_cal.robots.gravity_torques import known_link_mass_mask, link_masses_and_centres
from minimax_cal.robots.robot import Robot, load_robot

MOTION_OPTION_GROUP = "A motion instead of poses"
MOTION_RELATED_PLAN_OPTIONS = (
    "joints",
    "volume",
    "floor",
    "body",
    "seed",
)  # options of a plan that are about motions too
FAST_MOTION_HARMONICS, SLOW_MOTION_HARMONICS = 8, 3  # of a series
MAX_SLOW_MOTION_SPEED = (
    0.2  # peak of the slow part: friction below it is seen nowhere else [rad/s, m/s]
)
MIN_SLOW_MOTION_PERIOD = 30.0  # of the slow part at least [s]
MOTIONS_DRAWN, MOTION_IMPROVEMENT_STEPS = (
    8,
    150,
)  # series drawn, and random steps from the best of them
INDEPENDENT_TORQUE_ROWS_HZ = (
    5.0  # rows that count as independent: noise of torques is correlated in time
)
TORQUE_NOISE_FRACTION_OF_RANGE = (
    0.01  # of the range of a joint's torque; measured arms have 0.3 to 2 %
)
MIN_TORQUE_NOISE = 0.05  # of any joint [N m, N]
RESTING_FRACTION_OF_MAX_SPEED = 0.02  # of the largest speed: below it friction has no sign
MAX_SEPARABLE_RELATIVE_SIGMA = 1e4  # relative sigma above which a parameter is not separable
MAX_DRIVE_GAIN_SIGMA = 1.0  # sigma of a drive gain, of itself, that says nothing of it
WAYPOINTS_HZ = 10.0
MIN_PART_SECONDS, MAX_PART_SECONDS = 5.0, 300.0  # of a part [s]
MAX_MOTION_ROWS_HZ = 1000.0


motion_option = option_field_in_group(MOTION_OPTION_GROUP)


@dataclass(frozen=True)
class MotionOptions:
    """What a motion is to be like.

    duration: of a part of the motion [s].  speed, acceleration: of every joint at most [rad/s,
    rad/s^2]; a slide has 1 mm where others have 1 degree.
    payload: known mass at the flange [kg], for a part that tells masses and drive gains apart.
    rows: of the file, a second.
    """

    duration: float = motion_option(20.0, "How long a part of the motion takes, s.")
    speed: float = motion_option(
        np.radians(60.0), "The highest speed of a joint, deg/s (slides: mm/s).", "deg"
    )
    acceleration: float = motion_option(
        np.radians(120.0), "The highest acceleration of a joint, deg/s^2 (slides: mm/s^2).", "deg"
    )
    payload: float | None = motion_option(
        None, "A known mass at the flange; a part with it tells masses and drive gains apart.", "kg"
    )
    rows: float = motion_option(100.0, "Rows a second in the file.", flag="--rows-per-second")


@dataclass(frozen=True, eq=False)
class MotionPart:
    """A part of the motion, recorded as a run of its own.  payload: [kg]."""

    name: str
    motion: FourierMotion
    payload: float


class PredictedSigma(NamedTuple):
    """What a parameter's sigma will be [unit], inf if not separable.  place: as J2."""

    parameter: str
    place: str
    sigma: float
    unit: str


@dataclass(frozen=True, eq=False)
class MotionPlan(Result):
    """parts: in the order of driving.  told: what they will tell, for a noise of `noise` (n,)."""

    KIND = "motion_plan"

    robot: StoredSeparately[Robot]
    parts: StoredSeparately[tuple[MotionPart, ...]]
    told: Annotated[tuple[PredictedSigma, ...], FieldFormat(key="tells")]
    noise: Array
    base: Annotated[int, FieldFormat(key="base_parameters")]
    settings: Mapping[str, object]
    notices: tuple[str, ...]
    seconds: float

    def headline(self) -> str:
        """The plan in a few sentences."""
        total = sum(part.motion.period for part in self.parts)
        names = ", ".join(f"{part.name} {part.motion.period:g} s" for part in self.parts)
        return (
            f"{self.robot.name}: {total:g} s of motion ({names}), each begins and ends at rest. "
            f"Tells {self.base} base parameters of the masses, and the friction of each joint."
        )

    def motion_table(self) -> Table:
        """Range, speed and acceleration of each joint in each part."""
        rows: list[tuple[object, ...]] = []
        slides = self.robot.prismatic
        for part in self.parts:
            moved = part.motion.evaluate(part.motion.sample_times(FINAL_COLLISION_CHECK_HZ))
            top = [np.abs(values).max(axis=0) for values in (moved.qd, moved.qdd)]
            sizes = np.stack([moved.q.min(axis=0), moved.q.max(axis=0), *top], axis=1)
            for j, size in enumerate(
                np.where(slides, 1e3, RADIANS_TO_ANGLE_UNIT["deg"])[:, None] * sizes
            ):
                rows.append((part.name, f"J{j + 1}", *size, "mm" if slides[j] else "deg"))
        columns = "part | joint | from .1f | to .1f | speed /s .1f | acceleration /s^2 .1f | unit"
        return Table.from_rows("motion", rows, columns)

    def told_table(self) -> Table:
        """Predicted standard deviations, a row a joint."""
        kinds = dict.fromkeys(told.parameter for told in self.told)
        rows = (
            (f"J{j + 1}", noise, *map(format_predicted_sigma, self.told[j :: len(self.noise)]))
            for j, noise in enumerate(self.noise)
        )
        heads = (f"{kind} +-" for kind in kinds)
        return Table.from_rows("standard deviations, predicted", rows, "joint | noise .3g", *heads)

    def format_motion_csv(self, angle_unit: str, rows_per_second: float, with_speeds: bool) -> str:
        """CSV of all parts.  angle_unit: of turning joints.  Raises OptionError."""
        if angle_unit not in RADIANS_TO_ANGLE_UNIT:
            raise OptionError(
                f"no unit {angle_unit!r}; choose {' or '.join(RADIANS_TO_ANGLE_UNIT)}"
            )
        slides, n = self.robot.prismatic, self.robot.joints
        scale = np.where(slides, 1e3, RADIANS_TO_ANGLE_UNIT[angle_unit])
        named = ["mm" if slides[j] else angle_unit for j in range(n)]
        header = ["run", "t_s", *(f"q{j + 1}_{named[j]}" for j in range(n))]
        header += [f"qd{j + 1}_{named[j]}_s" for j in range(n)] if with_speeds else []
        loaded = any(part.payload for part in self.parts)
        header += ["payload_kg"] if loaded else []
        rows: list[list[Any]] = []
        for part in self.parts:
            grid = part.motion.sample_times(rows_per_second)
            moved, load = part.motion.evaluate(grid), [f"{part.payload:g}"] if loaded else []
            block = np.concatenate([moved.q, *([moved.qd] if with_speeds else [])], axis=1)
            block = block * np.tile(scale, 1 + with_speeds)
            rows += [
                [part.name, f"{t:.6g}", *row, *load]
                for t, row in zip(grid, block.tolist(), strict=True)
            ]
        return format_rounded_csv(header, rows)

    def csv(self, unit: str = "deg") -> str:
        """The motion, in the columns of a log: drive it, and add the torques."""
        return self.format_motion_csv(unit, float(str(self.settings["rows"])), False)

    def waypoints(self, unit: str = "deg") -> str:
        """Points and speeds for a controller that joins them by itself."""
        return self.format_motion_csv(unit, WAYPOINTS_HZ, True)

    def tables(self) -> tuple[Table, ...]:
        """What the motion will tell, and what moves."""
        return self.told_table(), self.motion_table()

    def extra_file_content(self, *, with_measurements: bool = True) -> dict[str, Any]:
        """The series' coefficients in SI, and how far and how fast they move each joint."""
        return {
            "robot": self.robot.name,
            "parts": [
                {
                    "name": part.name,
                    "period_s": part.motion.period,
                    "payload_kg": part.payload,
                    "centre": part.motion.centre,
                    "cos": part.motion.cos_coefficients,
                    "sin": part.motion.sin_coefficients,
                }
                for part in self.parts
            ],
            "motion": self.motion_table().to_records(),
        }


def format_predicted_sigma(prediction: PredictedSigma) -> str:
    """A predicted sigma, to people."""
    return (
        f"{prediction.sigma:.2g} {prediction.unit}"
        if np.isfinite(prediction.sigma)
        else "not separable"
    )


@take_option_fields_as_keywords(
    options=MotionOptions, room=(PlanOptions, MOTION_RELATED_PLAN_OPTIONS)
)
def plan_motion(
    robot: Robot | str | Path,
    *,
    options: MotionOptions,
    room: PlanOptions,
    progress: Progress = silent_progress,
) -> MotionPlan:
    """A motion whose torques tell masses and friction, within limits, and what it will tell.

    Parameters
    ----------
    robot
        A robot, its file, or a built-in name.
    options
        See `MotionOptions`.
    room
        See `PlanOptions`.
    progress
        Called with a sentence at each stage.

    Returns
    -------
    MotionPlan
        Its parts, what they will tell, and CSV in the columns of a log.

    Raises
    ------
    OptionError
        For options that make no sense, and where no motion stays within the limits.

    Examples
    --------
    >>> mc.plan_motion("irb2600", payload=5.0).save("motion.json")
    """
    began = time.perf_counter()
    arm = load_robot(robot)
    check_motion_options(options)
    check_seed(room.seed)
    bounds, notices = build_motion_limits(arm, options, room)
    rng = np.random.default_rng(room.seed)
    progress("drawing motions")
    draw = partial(draw_allowed_motion, bounds, FAST_MOTION_HARMONICS, options.duration)
    drawn = [draw(rng) for _ in range(MOTIONS_DRAWN)]
    model = build_torque_prediction_model(arm, drawn)
    worth = partial(log_determinant_information, model)
    best = max(drawn, key=worth)
    progress("improving the best of them")
    best = improve_motion_by_random_steps(best, bounds, worth, MOTION_IMPROVEMENT_STEPS, rng)
    slow = draw_slow_motion(best, bounds, worth, rng)
    parts = [
        MotionPart("fast", shrink_until_allowed_on_fine_grid(best, bounds), 0.0),
        MotionPart("slow", shrink_until_allowed_on_fine_grid(slow, bounds), 0.0),
    ]
    if options.payload:
        parts.append(MotionPart("loaded", parts[0].motion, options.payload))
    else:
        notices = (*notices, NO_PAYLOAD_NOTICE)
    if not known_link_mass_mask(arm).all():
        notices = (*notices, f"{arm.name} gives no masses: the noise is that of assumed ones")
    settings = convert_to_plain_json(
        vars(options) | {name: getattr(room, name) for name in MOTION_RELATED_PLAN_OPTIONS}
    )
    told = tuple(predict_parameter_sigmas(model, parts))
    seconds = time.perf_counter() - began
    base = model.base_parameter_basis.shape[1]
    return MotionPlan(arm, tuple(parts), told, model.noise, base, settings, notices, seconds)


NO_PAYLOAD_NOTICE = (
    "without a known payload, currents cannot tell masses from drive gains; plan a part with one "
    "(payload=) where currents are logged"
)


def check_motion_options(options: MotionOptions) -> None:
    """Raise OptionError for options that make no sense."""
    if not MIN_PART_SECONDS <= options.duration <= MAX_PART_SECONDS:
        raise OptionError(
            f"duration={options.duration:g}: give {MIN_PART_SECONDS:g} to {MAX_PART_SECONDS:g} s"
        )
    for name in ("speed", "acceleration"):
        value = getattr(options, name)
        if not 0.0 < value < np.inf:
            raise OptionError(f"{name}={value:g}: give a number above 0")
    if options.payload is not None and not 0.0 < options.payload < 3e3:
        raise OptionError(f"payload={options.payload:g}: give its mass in kg, above 0")
    if not 2.0 <= options.rows <= MAX_MOTION_ROWS_HZ:
        raise OptionError(f"rows={options.rows:g}: give 2 to {MAX_MOTION_ROWS_HZ:g} a second")


class LimitsWithNotices(NamedTuple):
    """What a motion may do, and notices on it."""

    limits: MotionLimits
    notices: tuple[str, ...]


def build_motion_limits(
    robot: Robot, options: MotionOptions, plan_options: PlanOptions
) -> LimitsWithNotices:
    """What the motion may do, and notices.  Raises OptionError."""
    lower, upper, notices = find_joint_limits(robot, plan_options.joints)
    lower, upper = (np.where(robot.passive, 0.0, limit) for limit in (lower, upper))
    radius = (
        BODY_RADIUS_FRACTION_OF_REACH * robot.reach()
        if plan_options.body is None
        else plan_options.body
    )
    up = np.array([[0.0, 0.0, 1.0]])
    space = ArmWorkspace(robot, np.zeros((1, 3)), up, lower, upper, radius, plan_options.floor)
    scale = np.where(robot.prismatic, 1e-3 * 180.0 / np.pi, 1.0)  # degrees to mm
    box = np.array(plan_options.volume, dtype=float).reshape(-1, 3)
    return LimitsWithNotices(
        MotionLimits(space, box, scale * options.speed, scale * options.acceleration), notices
    )


@dataclass(frozen=True, eq=False)
class TorquePredictionModel:
    """What torques depend on.  base_parameter_basis: (10 n, r) of base parameters.  noise: (n,) [N
    m, N].

    inertial_parameters: (10 n,) inertial parameters, as given or assumed.
    """

    robot: Robot
    base_parameter_basis: Array
    inertial_parameters: Array
    noise: Array


def build_torque_prediction_model(
    robot: Robot, motions: Sequence[FourierMotion]
) -> TorquePredictionModel:
    """The model of an arm, its base parameters and noise as some motions show them."""
    known = known_link_mass_mask(robot)
    mass, com = link_masses_and_centres(robot)
    given = robot if known.all() else replace(robot, mass=mass, com=com)
    links = build_nominal_inertial_parameters(given).ravel()
    columns = [
        regressor(robot, series.evaluate(series.sample_times(INDEPENDENT_TORQUE_ROWS_HZ)))
        for series in motions
    ]
    basis = compute_base_parameter_combinations(
        np.concatenate(columns).reshape(-1, robot.joints * INERTIAL_PARAMETERS_PER_LINK)
    )
    span = np.ptp(np.concatenate([block @ links for block in columns]), axis=0)
    return TorquePredictionModel(
        robot, basis, links, np.maximum(TORQUE_NOISE_FRACTION_OF_RANGE * span, MIN_TORQUE_NOISE)
    )


def friction_regressor(motion: JointMotion) -> Array:
    """(m, n, 2 n) columns of Coulomb and viscous friction of each joint."""
    m, n = motion.qd.shape
    out = np.zeros((m, n, 2 * n))
    moves = np.abs(motion.qd) > RESTING_FRACTION_OF_MAX_SPEED * np.abs(motion.qd).max(axis=0)
    for j in range(n):
        out[:, j, j] = np.sign(motion.qd[:, j]) * moves[:, j]
        out[:, j, n + j] = motion.qd[:, j]
    return out


def log_determinant_information(
    model: TorquePredictionModel, fourier_motion: FourierMotion
) -> float:
    """Log-determinant of what a motion tells of base parameters and friction."""
    motion = fourier_motion.evaluate(fourier_motion.sample_times(INDEPENDENT_TORQUE_ROWS_HZ))
    columns = np.concatenate(
        [regressor(model.robot, motion) @ model.base_parameter_basis, friction_regressor(motion)],
        -1,
    )
    white = (columns / model.noise[:, None]).reshape(-1, columns.shape[-1])
    white = white[:, white.any(axis=0)]  # a joint without a drive has no friction
    sign, size = np.linalg.slogdet(white.T @ white)
    return float(size) if sign > 0.0 else -np.inf


def draw_slow_motion(
    fast_motion: FourierMotion, limits: MotionLimits, objective: Any, rng: np.random.Generator
) -> FourierMotion:
    """A series whose joints all peak at SLOW_SPEED, or below where limits say so."""
    slow = replace(limits, speed=np.minimum(limits.speed, MAX_SLOW_MOTION_SPEED))
    period = max(MIN_SLOW_MOTION_PERIOD, fast_motion.period)
    drawn = [
        draw_allowed_motion(slow, SLOW_MOTION_HARMONICS, period, rng) for _ in range(MOTIONS_DRAWN)
    ]
    return max(drawn, key=objective)


def shrink_until_allowed_on_fine_grid(motion: FourierMotion, limits: MotionLimits) -> FourierMotion:
    """The series, smaller where its points are not free between the rows that were looked at."""
    return shrink_until_allowed(
        motion, limits, FINAL_COLLISION_CHECK_HZ
    ) or motion.scale_amplitudes(0.0)


def predict_parameter_sigmas(
    model: TorquePredictionModel, parts: Sequence[MotionPart]
) -> list[PredictedSigma]:
    """Sigma of friction, armature and drive gain of each joint, all fitted together with masses."""
    robot, n = model.robot, model.robot.joints
    rows = []
    for part in parts:
        motion = part.motion.evaluate(part.motion.sample_times(INDEPENDENT_TORQUE_ROWS_HZ))
        rigid = regressor(robot, motion)
        payload = (
            part.payload * rigid[:, :, INERTIAL_PARAMETERS_PER_LINK * (n - 1)]
        )  # a point mass at the flange
        torque = rigid @ model.inertial_parameters + payload
        own = np.zeros((len(torque), n, 2 * n))
        for j in range(n):
            own[:, j, j], own[:, j, n + j] = motion.qdd[:, j], torque[:, j]
        rows.append(
            np.concatenate(
                [rigid @ model.base_parameter_basis, friction_regressor(motion), own], axis=-1
            )
        )
    columns = np.concatenate(rows) / model.noise[:, None]
    white = columns.reshape(-1, columns.shape[-1])
    sigma = standard_deviations_from_columns(white)[model.base_parameter_basis.shape[1] :].reshape(
        4, n
    )
    out = []
    for kind, values in zip(("Coulomb", "viscous", "armature", "drive gain"), sigma, strict=True):
        for j, value in enumerate(values):
            unit, scale = display_unit_and_scale(kind, bool(robot.prismatic[j]))
            value = np.inf if kind == "drive gain" and value > MAX_DRIVE_GAIN_SIGMA else value
            out.append(PredictedSigma(kind, f"J{j + 1}", scale * float(value), unit))
    return out


def display_unit_and_scale(parameter_kind: str, is_prismatic: bool) -> tuple[str, float]:
    """How people read a parameter's sigma, and the factor to it from SI."""
    if parameter_kind == "drive gain":
        return "%", 100.0
    turning = {"Coulomb": "N m", "viscous": "N m s/rad", "armature": "kg m^2"}
    sliding = {"Coulomb": "N", "viscous": "N s/m", "armature": "kg"}
    return (sliding if is_prismatic else turning)[parameter_kind], 1.0


def standard_deviations_from_columns(whitened_columns: Array) -> Array:
    """(p,) standard deviations by whitened columns (N, p), inf where others do as well."""
    scale = np.linalg.norm(whitened_columns, axis=0)
    used = scale > 0.0
    out = np.full(whitened_columns.shape[1], np.inf)
    _, size, right = np.linalg.svd(whitened_columns[:, used] / scale[used], full_matrices=False)
    within = ((right / np.maximum(size, 1e-300)[:, None]) ** 2).sum(axis=0)
    sigma = np.sqrt(within)  # 1 for a column that no other resembles
    out[used] = np.where(sigma < MAX_SEPARABLE_RELATIVE_SIGMA, sigma / scale[used], np.inf)
    return out
