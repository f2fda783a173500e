"""Do the sigmas of effects predict how far two halves of a measurement differ?

    python -m experiments.halves [--quick] [--out FOLDER] [--json FILE] [--seed N] [--jobs N] ...

All poses are diagnosed; the confirmed effects are then fitted, with the geometry, to two
halves of the poses by themselves (repeated poses on one side).  z is the difference of a parameter
over the root of the sum of both variances: if the sigmas hold its standard deviation is 1.  Halves
differ in the poses alone, so that what the model lacks counts too.  Real arms where their
measurements are on this machine, and simulated ones.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import click
import numpy as np

import minimax_cal as mc
from experiments import sweep
from experiments.external import HALVES, RANDOM, REAL, SIMULATED, arm_of, aside, asked_for
from experiments.sweep import Study, study_options
from minimax_cal.diagnosing.joint import joint
from minimax_cal.diagnosing.study import studied
from minimax_cal.fitting.options import Options, silent
from minimax_cal.fitting.solve import fit_cell
from minimax_cal.ground.arrays import Array
from minimax_cal.ground.tables import Cell, Table
from minimax_cal.measuring.history import with_history
from minimax_cal.measuring.measurements import Measurements
from minimax_cal.modelling.effects.table import Term
from minimax_cal.robots.robot import Robot

FAR = 2.0  # of z


@dataclass(frozen=True)
class Arm:
    """One arm, and how many of its halves are compared."""

    name: str
    halves: int
    seed: int


def run(arm: Arm) -> list[list[float]]:
    """z of every parameter of every effect (halves, parameters); none without effects."""
    robot, data = arm_of(arm.name)
    data = with_history(data)
    found = mc.diagnose(robot, data, quick=True, seed=arm.seed)
    terms = [
        term for one in found.by_rung if one.established and not one.rows for term in one.terms
    ]
    if not terms:
        return []
    sides = [aside(data, RANDOM, arm.seed + number) for number in range(arm.halves)]
    return [z_between(robot, data, side, terms).tolist() for side in sides]


def z_between(robot: Robot, data: Measurements, side: Array, terms: Sequence[Term]) -> Array:
    """z of the effects' parameters between two sides of the poses, where both have a sigma."""
    values, variances = [], []
    for rows in (side, ~side):
        part = data.take(rows)
        fit = fit_cell(robot, part, Options(objective="sum"), silent)
        ours = joint(studied(robot, part, fit), terms)
        values.append(ours.state.effects)
        variances.append(ours.uncertainty.sigma[ours.model.names.geometric :] ** 2)
    z = (values[0] - values[1]) / np.sqrt(variances[0] + variances[1])
    return np.asarray(z[np.isfinite(z)])


def line(name: str, z: list[list[float]]) -> tuple[Cell, ...]:
    """A row of the table."""
    each = [float(np.sqrt(np.mean(np.square(half)))) for half in z]
    whole = np.concatenate([np.asarray(half) for half in z])
    size = np.abs(whole)
    return (name, len(z), len(whole) / len(z), float(np.sqrt(np.mean(size**2))), min(each),
            max(each), 100.0 * float(np.mean(size > FAR)), float(size.max()))  # fmt: skip


@click.command()
@study_options("halves")
@click.option("--arms", default=",".join((*REAL, *SIMULATED)), show_default=True)
@click.option("--halves", type=int, default=HALVES, show_default=True)
def main(study: Study, arms: str, halves: int) -> None:
    """Effects fitted to two halves of the poses: do their sigmas tell the difference?"""
    named = asked_for(arms)
    if study.quick:
        named, halves = [SIMULATED[0]], 2
    found = study.sweep(run, [Arm(name, halves, study.seed) for name in named], "arms")
    rows = [line(name, z) for name, z in zip(named, found, strict=True) if z and len(z[0])]
    table = Table(
        "effects fitted to two halves of the poses: z of their parameters",
        ("arm", "halves", "parameters", "sd of z", "least of a half", "most", "|z| > 2 %",
         "largest"),
        tuple(rows), ("", "d", ".0f", ".2f", ".2f", ".2f", ".1f", ".1f"),
    )  # fmt: skip
    names = ("arm", "halves", "parameters", "sd", "least", "most", "far_percent", "largest")
    study.save([table], {"rows": [dict(zip(names, row, strict=True)) for row in rows]})


if __name__ == "__main__":
    sweep.start(__file__)
