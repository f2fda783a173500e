"""Are the same causes identified, whichever poses are held out?

    python -m experiments.ten_splits [--quick] [--out FOLDER] [--json FILE] [--seed N] [--jobs N]

All poses of an arm are diagnosed ten times, another fifth of them held out each time.  The tables
have the verdicts, the held-out accuracy, how much of the gap confirmed causes close, and in how
many splits each cause is confirmed, and listed at all.  Real arms where their
measurements are on this machine, and simulated ones.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import click
import numpy as np

import minimax_cal as mc
from experiments import sweep
from experiments.external import REAL, SIMULATED, arm_of, asked_for
from experiments.sweep import Study, study_options
from minimax_cal.ground.tables import Cell, Table
from minimax_cal.measuring.history import with_history

SPLITS = 10


@dataclass(frozen=True)
class Split:
    """One arm, and the seed of its held-out poses."""

    arm: str
    seed: int


@dataclass(frozen=True)
class Named:
    """A cause that was listed.  share: of the gap.  turns: of its lines, waves a turn."""

    name: str
    established: bool
    share: float
    turns: tuple[float, ...]


@dataclass(frozen=True)
class Told:
    """What a diagnosis says.

    geometric, final: RMS held out; sound: of the points that do not stand out [mm].  closed: share
    of the gap.
    """

    verdict: str
    geometric: float
    final: float
    sound: float
    closed: float
    causes: tuple[Named, ...]

    @property
    def by_established(self) -> float:
        """Share of the gap that established causes close."""
        return sum(one.share for one in self.causes if one.established)


def run(split: Split) -> Told:
    """The diagnosis of one split, without parts left out."""
    robot, data = arm_of(split.arm)
    found = mc.diagnose(robot, with_history(data), seed=split.seed, quick=True)
    causes = tuple(
        Named(
            f"{one.term.effect} {one.term.place}",
            one.established,
            float(np.nan_to_num(one.share)),
            tuple(
                term.choice["turns"] for term in one.shown or one.terms if "turns" in term.choice
            ),
        )
        for one in found.effects
    )
    steps = found.ladder
    closed = float("nan") if found.closed is None else float(found.closed)
    first, last = steps[1].holdout, steps[-1]
    accuracies = (first.rms_mm, last.holdout.rms_mm, last.trusted.rms_mm)
    return Told(found.verdict, *accuracies, closed, causes)


def arms_table(arms: Sequence[str], told: Sequence[Sequence[Told]]) -> Table:
    """Every arm: verdicts, and medians over its splits."""
    rows: list[tuple[Cell, ...]] = []
    for arm, own in zip(arms, told, strict=True):
        said = Counter(one.verdict for one in own)
        verdicts = ", ".join(f"{verdict} {count}" for verdict, count in said.most_common())
        middles = (float(np.median([getattr(one, name) for one in own])) for name in (
            "geometric", "final", "sound", "closed", "by_established"))  # fmt: skip
        before, after, sound, closed, sure = middles
        most = max(one.final for one in own)
        rows.append((arm, len(own), verdicts, before, after, most, sound, 100.0 * closed,
                     100.0 * sure))  # fmt: skip
    return Table(
        "diagnoses of all poses, a fifth of them held out; medians",
        ("arm", "splits", "verdicts", "geometry mm", "final mm", "worst split mm",
         "of sound points mm", "closed %", "by confirmed causes %"),
        tuple(rows),
        ("", "d", "", ".4f", ".4f", ".4f", ".4f", ".0f", ".0f"),
    )  # fmt: skip


def names_table(arms: Sequence[str], told: Sequence[Sequence[Told]]) -> Table:
    """Every cause that is established in some split, the largest of each arm first."""
    rows: list[tuple[Cell, ...]] = []
    for arm, own in zip(arms, told, strict=True):
        listed: dict[str, list[Named]] = {}
        for one in own:
            for cause in one.causes:
                listed.setdefault(cause.name, []).append(cause)
        mine: list[tuple[Cell, ...]] = []
        for name, causes in listed.items():
            sure = sum(cause.established for cause in causes)
            share = 100.0 * float(np.median([cause.share for cause in causes]))
            turns = ", ".join(f"{k:.1f}" for k in sorted(ends_of(causes)))
            if sure:
                mine.append((arm, name, share, sure, len(causes), turns))
        rows += sorted(mine, key=lambda row: -float(row[2] or 0.0))
    return Table(
        "causes that are confirmed in some split",
        ("arm", "cause", "share of gap %", "confirmed in", "listed in", "waves a turn"),
        tuple(rows),
        ("", "", ".1f", "d", "d", ""),
    )


def ends_of(causes: Sequence[Named]) -> set[float]:
    """The least and the most waves a turn of a cause's strongest lines."""
    first = [cause.turns[0] for cause in causes if cause.turns]
    return {round(min(first), 1), round(max(first), 1)} if first else set()


@click.command()
@study_options("ten_splits")
@click.option("--arms", default=",".join((*REAL, *SIMULATED)), show_default=True)
@click.option("--splits", type=int, default=SPLITS, show_default=True)
def main(study: Study, arms: str, splits: int) -> None:
    """Names of causes over ten choices of the poses held out."""
    named = asked_for(arms)
    if study.quick:
        named, splits = [SIMULATED[0], *(arm for arm in named if arm == "qkm_hl6")], 2
    jobs = [Split(arm, study.seed + number) for arm in named for number in range(splits)]
    found = study.sweep(run, jobs, "diagnoses")
    told = [found[i : i + splits] for i in range(0, len(found), splits)]
    tables = [arms_table(named, told), names_table(named, told)]
    keys = ("arm", "splits", "verdicts", "geometric_mm", "final_mm", "most_mm", "sound_mm",
            "closed_percent", "established_percent")  # fmt: skip
    causes = ("arm", "cause", "share_percent", "established", "listed", "turns")
    study.save(tables, {
        "arms": [dict(zip(keys, row, strict=True)) for row in tables[0].rows],
        "causes": [dict(zip(causes, row, strict=True)) for row in tables[1].rows],
    })  # fmt: skip


if __name__ == "__main__":
    sweep.start(__file__)
