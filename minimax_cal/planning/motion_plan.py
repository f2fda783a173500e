"""Plan a motion whose torques tell an arm's masses and friction, and what they will tell."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np

from minimax_cal.dynamics.regressor import (
    PER_LINK,
    Motion,
    base_parameters,
    inertial_parameters,
    regressor,
)
from minimax_cal.ground.arrays import Array
from minimax_cal.ground.errors import OptionError
from minimax_cal.ground.facts import Apart, Fact
from minimax_cal.ground.files import plain
from minimax_cal.ground.options import check_seed, grouped, takes
from minimax_cal.ground.results import Result
from minimax_cal.ground.stages import Progress, silent
from minimax_cal.ground.tables import Table
from minimax_cal.planning.candidates import limits_of
from minimax_cal.planning.motion import (
    SURE_HZ,
    Bounds,
    Series,
    free_series,
    improved,
    shrunk,
)
from minimax_cal.planning.options import PlanOptions
from minimax_cal.planning.route import ANGLES, rounded_csv
from minimax_cal.planning.visibility import THICK, Room
from minimax_cal.robots.gravity import masses_of, weighed
from minimax_cal.robots.robot import Robot, load_robot

GROUP = "A motion instead of poses"
ROOM = ("joints", "volume", "floor", "body", "seed")  # options of a plan that are about motions too
HARMONICS, SLOW_HARMONICS = 8, 3  # of a series
SLOW_SPEED = 0.2  # peak of the slow part: friction below it is seen nowhere else [rad/s, m/s]
SLOW_PERIOD = 30.0  # of the slow part at least [s]
DRAWN, ROUNDS = 8, 150  # series drawn, and random steps from the best of them
ROWS_HZ = 5.0  # rows that count as independent: noise of torques is correlated in time
NOISE = 0.01  # of the range of a joint's torque; measured arms have 0.3 to 2 %
LEAST_NOISE = 0.05  # of any joint [N m, N]
REST = 0.02  # of the largest speed: below it friction has no sign
NOT_APART = 1e4  # relative sigma above which a parameter is not separable
VAGUE_GAIN = 1.0  # sigma of a drive gain, of itself, that says nothing of it
WAYPOINTS_HZ = 10.0
SHORTEST, LONGEST = 5.0, 300.0  # of a part [s]
FASTEST_ROWS = 1000.0


moved = grouped(GROUP)


@dataclass(frozen=True)
class MotionOptions:
    """What a motion is to be like.

    duration: of a part of the motion [s].  speed, acceleration: of every joint at most [rad/s,
    rad/s^2]; a slide has 1 mm where others have 1 degree.
    payload: known mass at the flange [kg], for a part that tells masses and drive gains apart.
    rows: of the file, a second.
    """

    duration: float = moved(20.0, "How long a part of the motion takes, s.")
    speed: float = moved(
        np.radians(60.0), "The highest speed of a joint, deg/s (slides: mm/s).", "deg"
    )
    acceleration: float = moved(
        np.radians(120.0), "The highest acceleration of a joint, deg/s^2 (slides: mm/s^2).", "deg"
    )
    payload: float | None = moved(
        None, "A known mass at the flange; a part with it tells masses and drive gains apart.", "kg"
    )
    rows: float = moved(100.0, "Rows a second in the file.", flag="--rows-per-second")


@dataclass(frozen=True, eq=False)
class Part:
    """A part of the motion, recorded as a run of its own.  payload: [kg]."""

    name: str
    series: Series
    payload: float


class Told(NamedTuple):
    """What a parameter's sigma will be [unit], inf if not separable.  place: as J2."""

    parameter: str
    place: str
    sigma: float
    unit: str


@dataclass(frozen=True, eq=False)
class MotionPlan(Result):
    """parts: in the order of driving.  told: what they will tell, for a noise of `noise` (n,)."""

    KIND = "motion_plan"

    robot: Apart[Robot]
    parts: Apart[tuple[Part, ...]]
    told: Annotated[tuple[Told, ...], Fact(key="tells")]
    noise: Array
    base: Annotated[int, Fact(key="base_parameters")]
    settings: Mapping[str, object]
    notices: tuple[str, ...]
    seconds: float

    def headline(self) -> str:
        """The plan in a few sentences."""
        total = sum(part.series.period for part in self.parts)
        names = ", ".join(f"{part.name} {part.series.period:g} s" for part in self.parts)
        return (
            f"{self.robot.name}: {total:g} s of motion ({names}), each begins and ends at rest. "
            f"Tells {self.base} base parameters of the masses, and the friction of each joint."
        )

    def motion_table(self) -> Table:
        """Range, speed and acceleration of each joint in each part."""
        rows: list[tuple[object, ...]] = []
        slides = self.robot.prismatic
        for part in self.parts:
            moved = part.series.at(part.series.grid(SURE_HZ))
            top = [np.abs(values).max(axis=0) for values in (moved.qd, moved.qdd)]
            sizes = np.stack([moved.q.min(axis=0), moved.q.max(axis=0), *top], axis=1)
            for j, size in enumerate(np.where(slides, 1e3, ANGLES["deg"])[:, None] * sizes):
                rows.append((part.name, f"J{j + 1}", *size, "mm" if slides[j] else "deg"))
        columns = "part | joint | from .1f | to .1f | speed /s .1f | acceleration /s^2 .1f | unit"
        return Table.made("motion", rows, columns)

    def told_table(self) -> Table:
        """Predicted standard deviations, a row a joint."""
        kinds = dict.fromkeys(told.parameter for told in self.told)
        rows = (
            (f"J{j + 1}", noise, *map(shown, self.told[j :: len(self.noise)]))
            for j, noise in enumerate(self.noise)
        )
        heads = (f"{kind} +-" for kind in kinds)
        return Table.made("standard deviations, predicted", rows, "joint | noise .3g", *heads)

    def rows_of(self, unit: str, rate: float, speeds: bool) -> str:
        """CSV of all parts.  unit: of turning joints.  Raises OptionError."""
        if unit not in ANGLES:
            raise OptionError(f"no unit {unit!r}; choose {' or '.join(ANGLES)}")
        slides, n = self.robot.prismatic, self.robot.joints
        scale = np.where(slides, 1e3, ANGLES[unit])
        named = ["mm" if slides[j] else unit for j in range(n)]
        header = ["run", "t_s", *(f"q{j + 1}_{named[j]}" for j in range(n))]
        header += [f"qd{j + 1}_{named[j]}_s" for j in range(n)] if speeds else []
        loaded = any(part.payload for part in self.parts)
        header += ["payload_kg"] if loaded else []
        rows: list[list[Any]] = []
        for part in self.parts:
            grid = part.series.grid(rate)
            moved, load = part.series.at(grid), [f"{part.payload:g}"] if loaded else []
            block = np.concatenate([moved.q, *([moved.qd] if speeds else [])], axis=1)
            block = block * np.tile(scale, 1 + speeds)
            rows += [
                [part.name, f"{t:.6g}", *row, *load]
                for t, row in zip(grid, block.tolist(), strict=True)
            ]
        return rounded_csv(header, rows)

    def csv(self, unit: str = "deg") -> str:
        """The motion, in the columns of a log: drive it, and add the torques."""
        return self.rows_of(unit, float(str(self.settings["rows"])), False)

    def waypoints(self, unit: str = "deg") -> str:
        """Points and speeds for a controller that joins them by itself."""
        return self.rows_of(unit, WAYPOINTS_HZ, True)

    def tables(self) -> tuple[Table, ...]:
        """What the motion will tell, and what moves."""
        return self.told_table(), self.motion_table()

    def beside(self, *, poses: bool = True) -> dict[str, Any]:
        """The series' coefficients in SI, and how far and how fast they move each joint."""
        return {
            "robot": self.robot.name,
            "parts": [
                {"name": part.name, "period_s": part.series.period, "payload_kg": part.payload,
                 "centre": part.series.centre, "cos": part.series.a, "sin": part.series.b}
                for part in self.parts
            ],
            "motion": self.motion_table().records(),
        }  # fmt: skip


def shown(told: Told) -> str:
    """A predicted sigma, to people."""
    return f"{told.sigma:.2g} {told.unit}" if np.isfinite(told.sigma) else "not separable"


@takes(options=MotionOptions, room=(PlanOptions, ROOM))
def plan_motion(
    robot: Robot | str | Path,
    *,
    options: MotionOptions,
    room: PlanOptions,
    progress: Progress = silent,
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
    check_motion(options)
    check_seed(room.seed)
    bounds, notices = bounds_of(arm, options, room)
    rng = np.random.default_rng(room.seed)
    progress("drawing motions")
    draw = partial(free_series, bounds, HARMONICS, options.duration)
    drawn = [draw(rng) for _ in range(DRAWN)]
    model = model_of(arm, drawn)
    worth = partial(information, model)
    best = max(drawn, key=worth)
    progress("improving the best of them")
    best = improved(best, bounds, worth, ROUNDS, rng)
    slow = slow_part(best, bounds, worth, rng)
    parts = [Part("fast", sure(best, bounds), 0.0), Part("slow", sure(slow, bounds), 0.0)]
    if options.payload:
        parts.append(Part("loaded", parts[0].series, options.payload))
    else:
        notices = (*notices, UNLOADED)
    if not weighed(arm).all():
        notices = (*notices, f"{arm.name} gives no masses: the noise is that of assumed ones")
    settings = plain(vars(options) | {name: getattr(room, name) for name in ROOM})
    told = tuple(told_by(model, parts))
    seconds = time.perf_counter() - began
    base = model.basis.shape[1]
    return MotionPlan(arm, tuple(parts), told, model.noise, base, settings, notices, seconds)


UNLOADED = (
    "without a known payload, currents cannot tell masses from drive gains; plan a part with one "
    "(payload=) where currents are logged"
)


def check_motion(options: MotionOptions) -> None:
    """Raise OptionError for options that make no sense."""
    if not SHORTEST <= options.duration <= LONGEST:
        raise OptionError(f"duration={options.duration:g}: give {SHORTEST:g} to {LONGEST:g} s")
    for name in ("speed", "acceleration"):
        value = getattr(options, name)
        if not 0.0 < value < np.inf:
            raise OptionError(f"{name}={value:g}: give a number above 0")
    if options.payload is not None and not 0.0 < options.payload < 3e3:
        raise OptionError(f"payload={options.payload:g}: give its mass in kg, above 0")
    if not 2.0 <= options.rows <= FASTEST_ROWS:
        raise OptionError(f"rows={options.rows:g}: give 2 to {FASTEST_ROWS:g} a second")


def bounds_of(
    robot: Robot, options: MotionOptions, room: PlanOptions
) -> tuple[Bounds, tuple[str, ...]]:
    """What the motion may do, and notices.  Raises OptionError."""
    lower, upper, notices = limits_of(robot, room.joints)
    lower, upper = (np.where(robot.passive, 0.0, limit) for limit in (lower, upper))
    radius = THICK * robot.reach() if room.body is None else room.body
    up = np.array([[0.0, 0.0, 1.0]])
    space = Room(robot, np.zeros((1, 3)), up, lower, upper, radius, room.floor)
    scale = np.where(robot.prismatic, 1e-3 * 180.0 / np.pi, 1.0)  # degrees to mm
    box = np.array(room.volume, dtype=float).reshape(-1, 3)
    return Bounds(space, box, scale * options.speed, scale * options.acceleration), notices


@dataclass(frozen=True, eq=False)
class Model:
    """What torques depend on.  basis: (10 n, r) of base parameters.  noise: (n,) [N m, N].

    links: (10 n,) inertial parameters, as given or assumed.
    """

    robot: Robot
    basis: Array
    links: Array
    noise: Array


def model_of(robot: Robot, drawn: Sequence[Series]) -> Model:
    """The model of an arm, its base parameters and noise as some motions show them."""
    known = weighed(robot)
    mass, com = masses_of(robot)
    given = robot if known.all() else replace(robot, mass=mass, com=com)
    links = inertial_parameters(given).ravel()
    columns = [regressor(robot, series.at(series.grid(ROWS_HZ))) for series in drawn]
    basis = base_parameters(np.concatenate(columns).reshape(-1, robot.joints * PER_LINK))
    span = np.ptp(np.concatenate([block @ links for block in columns]), axis=0)
    return Model(robot, basis, links, np.maximum(NOISE * span, LEAST_NOISE))


def friction(motion: Motion) -> Array:
    """(m, n, 2 n) columns of Coulomb and viscous friction of each joint."""
    m, n = motion.qd.shape
    out = np.zeros((m, n, 2 * n))
    moves = np.abs(motion.qd) > REST * np.abs(motion.qd).max(axis=0)
    for j in range(n):
        out[:, j, j] = np.sign(motion.qd[:, j]) * moves[:, j]
        out[:, j, n + j] = motion.qd[:, j]
    return out


def information(model: Model, series: Series) -> float:
    """Log-determinant of what a motion tells of base parameters and friction."""
    motion = series.at(series.grid(ROWS_HZ))
    columns = np.concatenate([regressor(model.robot, motion) @ model.basis, friction(motion)], -1)
    white = (columns / model.noise[:, None]).reshape(-1, columns.shape[-1])
    white = white[:, white.any(axis=0)]  # a joint without a drive has no friction
    sign, size = np.linalg.slogdet(white.T @ white)
    return float(size) if sign > 0.0 else -np.inf


def slow_part(best: Series, bounds: Bounds, worth: Any, rng: np.random.Generator) -> Series:
    """A series whose joints all peak at SLOW_SPEED, or below where limits say so."""
    slow = replace(bounds, speed=np.minimum(bounds.speed, SLOW_SPEED))
    period = max(SLOW_PERIOD, best.period)
    drawn = [free_series(slow, SLOW_HARMONICS, period, rng) for _ in range(DRAWN)]
    return max(drawn, key=worth)


def sure(series: Series, bounds: Bounds) -> Series:
    """The series, smaller where its points are not free between the rows that were looked at."""
    return shrunk(series, bounds, SURE_HZ) or series.sized(0.0)


def told_by(model: Model, parts: Sequence[Part]) -> list[Told]:
    """Sigma of friction, armature and drive gain of each joint, all fitted together with masses."""
    robot, n = model.robot, model.robot.joints
    rows = []
    for part in parts:
        motion = part.series.at(part.series.grid(ROWS_HZ))
        rigid = regressor(robot, motion)
        payload = part.payload * rigid[:, :, PER_LINK * (n - 1)]  # a point mass at the flange
        torque = rigid @ model.links + payload
        own = np.zeros((len(torque), n, 2 * n))
        for j in range(n):
            own[:, j, j], own[:, j, n + j] = motion.qdd[:, j], torque[:, j]
        rows.append(np.concatenate([rigid @ model.basis, friction(motion), own], axis=-1))
    columns = np.concatenate(rows) / model.noise[:, None]
    white = columns.reshape(-1, columns.shape[-1])
    sigma = sigmas(white)[model.basis.shape[1] :].reshape(4, n)
    out = []
    for kind, values in zip(("Coulomb", "viscous", "armature", "drive gain"), sigma, strict=True):
        for j, value in enumerate(values):
            unit, scale = unit_of(kind, bool(robot.prismatic[j]))
            value = np.inf if kind == "drive gain" and value > VAGUE_GAIN else value
            out.append(Told(kind, f"J{j + 1}", scale * float(value), unit))
    return out


def unit_of(kind: str, slides: bool) -> tuple[str, float]:
    """How people read a parameter's sigma, and the factor to it from SI."""
    if kind == "drive gain":
        return "%", 100.0
    turning = {"Coulomb": "N m", "viscous": "N m s/rad", "armature": "kg m^2"}
    sliding = {"Coulomb": "N", "viscous": "N s/m", "armature": "kg"}
    return (sliding if slides else turning)[kind], 1.0


def sigmas(white: Array) -> Array:
    """(p,) standard deviations by whitened columns (N, p), inf where others do as well."""
    scale = np.linalg.norm(white, axis=0)
    used = scale > 0.0
    out = np.full(white.shape[1], np.inf)
    _, size, right = np.linalg.svd(white[:, used] / scale[used], full_matrices=False)
    within = ((right / np.maximum(size, 1e-300)[:, None]) ** 2).sum(axis=0)
    sigma = np.sqrt(within)  # 1 for a column that no other resembles
    out[used] = np.where(sigma < NOT_APART, sigma / scale[used], np.inf)
    return out
