"""Arms whose joint is knocked while the tracker stands elsewhere."""

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

import minimax_cal as mc
from minimax_cal.core.arrays import Array
from minimax_cal.modelling.cell import Cell
from minimax_cal.modelling.simulate import Truth, simulate
from minimax_cal.robots import kinematics
from minimax_cal.robots.joint_sampling import random_joint_values_above_floor

SHIFT = 2e-4  # of a joint's zero [rad]


def seen_anew(cell: Cell, q: Array, truth: Truth, rng: np.random.Generator) -> mc.Measurements:
    """What a tracker elsewhere sees of an arm at some joints (m, n)."""
    base = np.eye(4)
    base[:3, :3] = Rotation.random(rng=rng).as_matrix()
    aside = rng.normal(size=3)
    base[:3, 3] = truth.distance * aside / np.linalg.norm(aside)
    y = replace(cell, base=base).predict(q)
    spread = truth.noise + truth.noise_per_metre * np.linalg.norm(y, axis=-1, keepdims=True)
    return mc.measurements(q, y + spread * rng.normal(size=y.shape))


def shifted(cell: Cell, joint: int, by: float) -> Cell:
    """An arm with the zero of a joint, counted from 0, shifted [rad]."""
    mdh = cell.robot.mdh.copy()
    mdh[joint, kinematics.THETA] += by
    return replace(cell, robot=cell.robot.with_mdh(mdh))


@dataclass(frozen=True)
class Checked:
    """Which joint was knocked, and what was named of the arm as it was and of the knocked one."""

    joint: str
    alarms: tuple[str, ...]
    named: tuple[str, ...]
    hidden: tuple[str, ...]


def checked(arm: str, seed: int) -> Checked:
    """One calibration on 60 poses, and two checks of it by ten others."""
    truth = Truth(compliance=0.0)
    made = simulate(arm, 60, 3, seed, truth)
    fit = mc.calibrate(arm, made.data, "sum")
    rng = np.random.default_rng([seed, 1])
    joint = 1 + seed % (made.cell.robot.joints - 2)
    q = random_joint_values_above_floor(made.cell.robot, 10, rng, truth.span)
    as_it_was, knocked = (
        mc.check(fit, seen_anew(shifted(made.cell, joint, by), q, truth, rng), "rms 0.2")
        for by in (0.0, SHIFT)
    )
    return Checked(
        f"J{joint + 1}",
        tuple(m.joint for m in as_it_was.moved),
        tuple(m.joint for m in knocked.moved),
        tuple(h.parameter for h in as_it_was.hidden),
    )
