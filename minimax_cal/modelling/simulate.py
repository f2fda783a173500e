"""Simulated measurements of a robot that is not quite its drawing."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import scipy

from minimax_cal.core.arrays import Array
from minimax_cal.core.errors import OptionError
from minimax_cal.core.option_fields import check_seed, option_field_in_group
from minimax_cal.measuring.measurements import Measurements
from minimax_cal.modelling.cell import Cell
from minimax_cal.robots import kinematics
from minimax_cal.robots.gravity_torques import joint_gravity_torques, link_masses_and_centres
from minimax_cal.robots.joint_sampling import random_joint_values_above_floor
from minimax_cal.robots.robot import Robot, load_robot
from minimax_cal.robots.transforms import build_transform

MAX_SIMULATED_POSES, MAX_SIMULATED_TARGETS = 1_000_000, 20


arm_option_field, instrument_option_field = (
    option_field_in_group("The arm"),
    option_field_in_group("The instrument"),
)


@dataclass(frozen=True)
class Truth:
    """How far the simulated arm is from nominal, and how well it is measured.

    length, angle: standard deviation of the errors of a, d [m] and theta, alpha, beta [rad].
    compliance: turn of every joint per gravity torque [rad/(N m)].  noise, noise_per_metre:
    standard deviation of each coordinate, and its growth with range [m, -].  distance: of the
    instrument from the robot [m].  circle: radius on which the targets sit on the flange [m].
    span: most that a joint turns from 0, within its limits [rad].
    """

    length: float = arm_option_field(
        0.5e-3, "The standard deviation of the errors of a and d.", "mm", flag="--length-error"
    )
    angle: float = arm_option_field(
        1.0e-3,
        "The standard deviation of the errors of theta, alpha, beta.",
        "mrad",
        flag="--angle-error",
    )
    compliance: float = arm_option_field(
        3.0e-7, "How far each joint turns under gravity's torque.", "urad/Nm"
    )
    noise: float = instrument_option_field(
        10e-6, "The standard deviation of a coordinate at the instrument.", "um"
    )
    noise_per_metre: float = instrument_option_field(
        2.5e-6, "How that noise grows with range.", "um/m"
    )
    distance: float = 3.0
    circle: float = 0.1
    span: float = np.pi


@dataclass(frozen=True, eq=False)
class Simulation:
    """data: the measurements.  cell: the true robot, base and targets (without its compliance)."""

    data: Measurements
    cell: Cell


def simulate(
    robot: Robot | str | Path,
    poses: int = 100,
    targets: int = 3,
    seed: int = 0,
    truth: Truth = Truth(),
) -> Simulation:
    """Measure an imperfect copy of a robot at random poses, from a random place.

    Parameters
    ----------
    robot
        Loaded, or a name or path.
    poses, targets
        How many.
    seed
        Of all that is random.
    truth
        How far the arm is from its drawing, and how well it is measured [m, rad].

    Returns
    -------
    Simulation
        The measurements, and the true arm behind them.

    Raises
    ------
    OptionError
        For counts that make no sense.

    Examples
    --------
    >>> data = mc.simulate("irb2600", 60, truth=mc.Truth(noise=20e-6)).data
    """
    robot = load_robot(robot)
    if not (1 <= poses <= MAX_SIMULATED_POSES and 1 <= targets <= MAX_SIMULATED_TARGETS):
        raise OptionError(
            f"simulate needs at least one pose and one target, at most {MAX_SIMULATED_POSES} and "
            f"{MAX_SIMULATED_TARGETS}"
        )
    check_seed(seed)
    for name, value in vars(truth).items():
        if not (np.isfinite(value) and value >= 0.0):
            raise OptionError(f"simulate: {name} {value:g} must be a finite number, 0 or more")
    rng = np.random.default_rng(seed)
    n = robot.joints
    errors = rng.normal(size=(n, 5)) * ([truth.length] * 2 + [truth.angle] * 3)
    real = robot.with_mdh(robot.mdh + errors)
    turn = scipy.spatial.transform.Rotation.random(rng=rng).as_matrix()
    aside = rng.normal(size=3)
    base = build_transform(turn, truth.distance * aside / np.linalg.norm(aside))
    angle = 2.0 * np.pi * (np.arange(targets) + 0.3 * rng.uniform(size=targets)) / targets
    spots = np.stack([np.cos(angle), np.sin(angle), 0.3 + 0.0 * angle], axis=1) * truth.circle
    cell = Cell(real, base, tuple(f"smr{i + 1}" for i in range(targets)), spots)
    q = random_joint_values_above_floor(robot, poses, rng, truth.span)
    y = cell.predict(q + truth.compliance * gravity(real, q))
    spread = truth.noise + truth.noise_per_metre * np.linalg.norm(y, axis=-1, keepdims=True)
    y = y + spread * rng.normal(size=y.shape)
    data = Measurements(
        q=q,
        y=y,
        target_names=cell.target_names,
        sliding=robot.prismatic,
        line=np.arange(poses) + 2,  # of a file: after the header
        columns={"order": np.arange(poses)},
        source=f"simulated {robot.name}",
        simulated=True,
    )
    return Simulation(data, cell)


def gravity(robot: Robot, q: Array) -> Array:
    """(m, n) gravity torques of the drives, in the controller's sense [N m], masses told or not."""
    links = kinematics.compute_link_frames(robot.mdh, robot.chain_joint_values(q), robot.prismatic)
    bend = joint_gravity_torques(links, *link_masses_and_centres(robot), robot.up).T
    return np.asarray(np.where(robot.prismatic, 0.0, bend) @ robot.joint_to_chain_matrix)
