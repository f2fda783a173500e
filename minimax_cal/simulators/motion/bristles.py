"""Friction at rest in a model: MuJoCo's `dcmotor` without input, whose LuGre friction is a bristle.

A bristle of friction F that yields after a way L [Dahl 1968] is one of LuGre of stiffness F / L and
the same friction at every speed.  MuJoCo takes its force at the beginning of a step: L is longer
where the inertia of the joint and the timestep ask for it.  A damper keeps a joint from creeping,
and brakes where it turns round: DAMPED is a small share of the critical one.
"""

from __future__ import annotations

import numpy as np

from minimax_cal.dynamics.model import held_friction
from minimax_cal.dynamics.scene import YIELD
from minimax_cal.ground.arrays import Array
from minimax_cal.robots.mjcf import mujoco
from minimax_cal.simulators.motion.fit import Study, weights, with_numbers
from minimax_cal.simulators.motion.numbers import Numbers

STABLE = 0.3  # timestep times frequency of a joint on its bristles, at most
DAMPED = 0.02  # of critical damping; 0.5 and more do worse than no bristle
ROUNDS = 2  # of fits, each with the ways of the one before


def has_bristles() -> bool:
    """Whether this MuJoCo has motors without input."""
    return hasattr(mujoco(), "mjtCtrlInput")


def fit_bristles(study: Study, numbers: Numbers, missed: Array) -> Numbers:
    """Numbers with bristles, by what the model misses on the runs to learn from (R, n)."""
    scene = with_numbers(study, study.scene, numbers)
    inertia = 1.0 / weights(study.chain, numbers)
    yields = np.broadcast_to(YIELD, numbers.bristles.shape)
    for _ in range(ROUNDS):
        held = held_friction(scene.stuck(yields), missed) * (scene.divisor / numbers.gain)[:, None]
        whole = np.maximum(held.sum(axis=1), 1e-300)
        held *= np.minimum(1.0, numbers.friction / whole)[:, None]
        slow = (float(study.chain.model.opt.timestep) / STABLE) ** 2 / inertia
        yields = np.maximum(YIELD, held.shape[1] * held * slow[:, None])
    damping = 2.0 * DAMPED * np.sqrt(inertia / np.maximum((held / yields).sum(axis=1), 1e-300))
    return numbers.put(bristles=held, yields=yields, damped=damping)
