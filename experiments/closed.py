"""Does the interval of the share of the gap that is closed hold it on new poses?

    python -m experiments.closed [--quick] [--out FOLDER] [--json FILE] [--seed N] [--jobs N] ...

Simulated arms with one effect each are measured at 500 poses.  A hundred and ten, and the fifteen
that are measured twice, are diagnosed; the share that the diagnosis closes of the gap between
geometry alone and the noise is then taken on the other poses, where the noise is known.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import click
import numpy as np

import minimax_cal as mc
from experiments import sweep
from experiments.blind_gap import interval
from experiments.gap_cases import Case, Cause, make
from experiments.sweep import Study, study_options
from minimax_cal.ground.tables import Cell as Item
from minimax_cal.ground.tables import Table
from minimax_cal.measuring.accuracy import accuracy
from minimax_cal.measuring.history import with_history

LAWS = (("joint_compliance", "J2"), ("gear_error", "J3"), ("link_bending", "L2"),
        ("encoder_gain", "J2"), ("tool_flex", "all"))  # fmt: skip
POWERS = (500.0, 2000.0, 8000.0)  # lambda at the poses that are diagnosed
POSES, USED = 500, 125


@dataclass(frozen=True)
class Share:
    """What was closed: as told, with its interval, and on new poses."""

    told: float
    low: float
    high: float
    true: float

    @property
    def held(self) -> bool:
        """Whether the interval holds it."""
        return self.low <= self.true <= self.high


def case(seed: int) -> Case:
    """Laws, arms and powers in turn."""
    law, place = LAWS[seed % len(LAWS)]
    power = POWERS[seed % len(POWERS)] * POSES / USED
    robot = ("irb2600", "ur10e")[seed % 2]
    return Case(robot, "single", (Cause(law, place, power),), poses=POSES, seed=7000 + seed)


def run(seed: int) -> Share | None:
    """One arm; None where no interval is told."""
    made = make(case(seed))
    data = with_history(made.data)
    columns = {name: column for name, column in data.columns.items() if name != "split"}
    data = replace(data, columns=columns)
    names, count = np.unique(data.columns["pose"], return_counts=True)
    once = np.random.default_rng(seed).permutation(names[count == 1])
    some = [*names[count > 1], *once[: USED - np.count_nonzero(count > 1)]]
    rows = np.isin(data.columns["pose"], some)
    found = mc.diagnose(made.robot, data.take(rows), quick=True)
    ends = (found.cells[0], found.cells[-1])
    before, after = (accuracy(cell.error(data.take(~rows))).rms_mm ** 2 for cell in ends)
    true = (before - after) / (before - (1e3 * made.floor) ** 2)
    share = Share(found.closed, *found.closed_ci, true)
    return share if np.isfinite([share.told, share.low, share.high]).all() else None


def line(name: str, shares: Sequence[Share]) -> tuple[Item, ...]:
    """A row of the table."""
    held = sum(share.held for share in shares)
    low, high = (100.0 * end for end in interval(held, len(shares)))
    return (name, len(shares), 100.0 * held / len(shares), low, high,
            sum(s.true < s.low for s in shares), sum(s.true > s.high for s in shares),
            float(np.median([s.told for s in shares])), float(np.median([s.true for s in shares])),
            float(np.median([s.high - s.low for s in shares])))  # fmt: skip


@click.command()
@study_options("closed")
@click.option("--runs", type=click.IntRange(3), default=400, show_default=True)
def main(study: Study, runs: int) -> None:
    """The interval of the share closed, on poses that were not used."""
    seeds = [study.seed + number for number in range(2 if study.quick else runs)]
    found = study.sweep(run, seeds, "arms")
    pairs = [(seed, share) for seed, share in zip(seeds, found, strict=True) if share]
    groups = [(f"lambda {power:.0f}", [s for n, s in pairs if n % len(POWERS) == i])
              for i, power in enumerate(POWERS)]  # fmt: skip
    groups.append(("all", [share for _, share in pairs]))
    table = Table(
        "the share of the gap that is closed: its 95 % interval on new poses",
        ("arms with", "runs", "held %", "from", "to", "true is below", "above", "reported, median",
         "true, median", "width, median"),
        tuple(line(name, shares) for name, shares in groups if shares),
        ("", "d", ".1f", ".1f", ".1f", "d", "d", ".3f", ".3f", ".3f"),
    )  # fmt: skip
    names = ("arms", "runs", "held", "low", "high", "below", "above", "told", "true", "width")
    study.save([table], {"rows": [dict(zip(names, row, strict=True)) for row in table.rows]})


if __name__ == "__main__":
    sweep.start(__file__)
