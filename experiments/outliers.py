"""What wrong points do to a calibration, and what losses and trimming do about them.

    python -m experiments.outliers [--quick] [--out FOLDER] [--json FILE] [--seed N] [--jobs N] ...

A share of the training points of arms with geometric errors and noise only is shifted in random
directions; the held-out poses are clean.  Each fit is compared with the one of the same objective
that has seen the clean points.  Suspects are counted against the points that were shifted.

Then a real arm whose large errors are no mistakes: on the IRB 120 the joints bend.  Robust fits
take the poses that show it for outliers, and list them, until joint compliance is in the model.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import click
import numpy as np

import minimax_cal as mc
from experiments import sweep
from experiments.real import here, real
from experiments.sweep import Study, study_options
from minimax_cal.ground.arrays import rms
from minimax_cal.ground.tables import Cell, Table
from minimax_cal.measuring.measurements import Measurements
from minimax_cal.modelling.simulate import Truth, simulate
from minimax_cal.robots.robot import load_robot

if TYPE_CHECKING:
    from matplotlib.figure import Figure

ROBOTS = ("irb2600", "ur10")
TRIM = 0.25  # more than the largest share of wrong points
SHARE, SHIFT = 5, 1.0  # the setting that the promise is about [%, mm]
SHARES = (0, 1, 2, 5, 10, 20)  # [%]
SHIFTS = (0.05, 0.075, 0.1, 0.125, 0.15, 0.2, 0.5, 1.0, 2.0, 5.0)  # [mm]
WAYS = {  # name: (objective, loss, trim)
    "sum": ("sum", "square", 0.0),
    "sum, huber": ("sum", "huber", 0.0),
    "sum, cauchy": ("sum", "cauchy", 0.0),
    "sum, tukey": ("sum", "tukey", 0.0),
    "sum, trimmed": ("sum", "square", TRIM),
    "minimax": ("minimax", "square", 0.0),
    "minimax, trimmed": ("minimax", "square", TRIM),
    "point": ("point", "square", 0.0),
    "point, trimmed": ("point", "square", TRIM),
}
MOST, RECALL, OTHERS = 1.05, 0.95, 0.10  # the promise for each robust way
COLOURS = ("#000000", "#e69f00", "#56b4e9", "#0072b2", "#009e73")  # [Okabe and Ito 2008]


@dataclass(frozen=True)
class Job:
    """One arm, measured at so many poses, with a share [%] of points shifted [mm]."""

    robot: str
    poses: int
    share: int
    shift: float
    seed: int


@dataclass(frozen=True)
class Result:
    """Of one way to fit.

    held, clean: held-out RMS, and that of the same objective fitted to clean points [mm].
    true, true_clean: the same against the true arm, without noise [mm].
    found, wrong, others: suspects that are wrong points, all wrong points, other suspects.
    """

    held: float
    clean: float
    true: float
    true_clean: float
    found: int
    wrong: int
    others: int
    status: str


def spoilt(data: Measurements, job: Job) -> tuple[Measurements, set[tuple[int, str]]]:
    """The data with shifted points, and which: (line, target)."""
    rng = np.random.default_rng([job.seed, job.share])
    rows, columns = np.nonzero(data.seen)
    chosen = rng.permutation(len(rows))[: round(0.01 * job.share * len(rows))]
    way = rng.normal(size=(len(chosen), 3))
    y = data.y.copy()
    y[rows[chosen], columns[chosen]] += (
        1e-3 * job.shift * way / np.linalg.norm(way, axis=1, keepdims=True)
    )
    wrong = {
        (int(data.line[row]), data.target_names[column])
        for row, column in zip(rows[chosen], columns[chosen], strict=True)
    }
    return data.with_y(y), wrong


def run(job: Job) -> dict[str, Result]:
    """Every way to fit on one set of measurements."""
    robot = load_robot(job.robot)
    made = simulate(robot, 2 * job.poses, 3, job.seed, Truth(compliance=0.0))
    train = made.data.take(np.arange(2 * job.poses) < job.poses)
    held = made.data.take(np.arange(2 * job.poses) >= job.poses)
    true = held.with_y(made.cell.predict(held.q))
    data, wrong = spoilt(train, job)
    clean = {
        objective: mc.calibrate(robot, train, objective, holdout=0.0).cell
        for objective in ("sum", "minimax", "point")
    }
    results = {}
    for name, (objective, loss, trim) in WAYS.items():
        fit = mc.calibrate(robot, data, objective, holdout=0.0, loss=loss, trim=trim)
        listed = {(one.line, one.target) for one in fit.suspects}
        results[name] = Result(
            mc.evaluate(fit.cell, held).rms_mm,
            mc.evaluate(clean[objective], held).rms_mm,
            mc.evaluate(fit.cell, true).rms_mm,
            mc.evaluate(clean[objective], true).rms_mm,
            len(listed & wrong),
            len(wrong),
            len(listed - wrong),
            str(fit.status),
        )
    return results


@dataclass(frozen=True)
class Row:
    """Results of one way over robots and seeds: what a table and a picture show."""

    way: str
    share: int
    shift: float
    fits: int
    held_mm: float
    ratio: float
    worst_ratio: float
    true_um: float
    true_clean_um: float
    recall: float
    others: float
    clean_lists: float
    converged: int

    @staticmethod
    def of(way: str, share: int, shift: float, results: Sequence[Result]) -> Row:
        """RMS over all; shares of all suspects; `clean_lists` only where nothing is wrong."""
        held, clean, true, true_clean = (
            np.array([getattr(result, name) for result in results])
            for name in ("held", "clean", "true", "true_clean")
        )
        found, wrong, others = (
            sum(getattr(result, name) for result in results)
            for name in ("found", "wrong", "others")
        )
        return Row(
            way,
            share,
            shift,
            len(results),
            rms(held),
            rms(held) / rms(clean),
            float((held / clean).max()),
            1e3 * rms(true),
            1e3 * rms(true_clean),
            found / wrong if wrong else np.nan,
            others / (found + others) if found + others else 0.0,
            np.nan if wrong else float(np.mean([result.others > 0 for result in results])),
            sum(result.status == "converged" for result in results),
        )

    @property
    def cells(self) -> tuple[Cell, ...]:
        """As a row of a table."""
        return (
            self.way, self.share, self.shift, self.fits, self.held_mm, self.ratio,
            self.worst_ratio, self.true_um, self.true_clean_um, 100.0 * self.recall,
            100.0 * self.others, 100.0 * self.clean_lists, self.converged,
        )  # fmt: skip

    @property
    def kept(self) -> str:
        """Whether the promise holds in this row."""
        good = self.ratio <= MOST and self.recall >= RECALL and self.others <= OTHERS
        return "yes" if good else "no"


def table_of(title: str, rows: Sequence[Row]) -> Table:
    """Held-out RMS, also against the true arm; recall and false alarms of the suspects.

    Others are a share of the suspects; false lists a share of the fits to clean points.
    """
    header = (
        "fit", "wrong %", "by mm", "fits", "held out mm", "/ clean", "worst / clean",
        "true arm um", "clean um", "recall %", "others %", "false lists %", "converged",
    )  # fmt: skip
    spec = ("", "d", "g", "d", ".4f", ".3f", ".3f", ".1f", ".1f", ".1f", ".1f", ".0f", "d")
    return Table(title, header, tuple(row.cells for row in rows), spec)


def promise(rows: Sequence[Row]) -> Table:
    """The promise at 5 % of points off by 1 mm, beside plain fits."""
    return Table(
        f"{SHARE} % of points off by {SHIFT:g} mm: held-out RMS within 5 % of the clean fit, "
        "recall >= 95 %, others <= 10 % of the list",
        ("fit", "held out / clean", "recall %", "others %", "holds"),
        tuple((r.way, r.ratio, 100.0 * r.recall, 100.0 * r.others, r.kept) for r in rows),
        ("", ".3f", ".1f", ".1f", ""),
    )


def picture(shares: Sequence[Row], shifts: Sequence[Row]) -> Figure:
    """Held-out RMS against the share of wrong points, and recall against their shift."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11, 4.6), layout="constrained")
    left, right = figure.subplots(1, 2)
    ways = [way for way, (objective, _, _) in WAYS.items() if objective == "sum"]
    lines = [(way, "-", colour) for way, colour in zip(ways, COLOURS, strict=True)]
    more = [("minimax", "--", "#000000"), ("minimax, trimmed", "--", "#009e73"),
            ("point", ":", "#000000"), ("point, trimmed", ":", "#009e73")]  # fmt: skip
    for way, style, colour in (*lines, *more):
        own = [row for row in shares if row.way == way]
        left.plot([r.share for r in own], [r.ratio for r in own], style, color=colour, marker=".",
                  label=way)  # fmt: skip
    left.axhline(MOST, color="#999999", linewidth=0.8)
    left.set(xlabel=f"points off by {SHIFT:g} mm (%)", yscale="log",
             ylabel="held-out RMS / that of the clean fit")  # fmt: skip
    for way, style, colour in lines:
        own = [row for row in shifts if row.way == way]
        right.plot([r.shift for r in own], [100.0 * r.recall for r in own], style, color=colour,
                   marker=".", label=way)  # fmt: skip
    right.axhline(100.0 * RECALL, color="#999999", linewidth=0.8)
    right.set(xlabel=f"shift of {SHARE} % of the points (mm)", xscale="log",
              ylabel="wrong points among the suspects (%)")  # fmt: skip
    for axes in (left, right):
        axes.grid(visible=True, alpha=0.3)
    right.set_ylim(0.0, 104.0)
    right.xaxis.set_major_formatter("{x:g}")
    figure.legend(*left.get_legend_handles_labels(), loc="outside lower center", frameon=False,
                  ncols=5, fontsize=8)  # fmt: skip
    figure.suptitle("IRB 2600 and UR10, simulated: geometric errors, noise and wrong points")
    return figure


# ---- a real arm with real effects ------------------------------------------------------------


@dataclass(frozen=True)
class RealJob:
    """The IRB 120 under one way to fit, with effects or without.  rows: of the file, 0 for all."""

    way: str
    effects: tuple[str, ...]
    seed: int
    rows: int


@dataclass(frozen=True)
class RealResult:
    """Held-out errors [mm], the suspects, and how many of them are whole poses."""

    rms: float
    median: float
    largest: float
    suspects: int
    together: int
    points: int


def run_real(job: RealJob) -> RealResult:
    """One fit to real measurements."""
    robot, data = real("irb120")
    if job.rows:
        data = data.take(np.arange(data.poses) < job.rows)
    objective, loss, trim = WAYS[job.way]
    fit = mc.calibrate(
        robot, data, objective, holdout=0.2, seed=job.seed, effects=job.effects,
        loss=loss, trim=trim,
    )  # fmt: skip
    error = 1e3 * np.linalg.norm(fit.errors["holdout"], axis=-1)
    return RealResult(
        fit.accuracy["holdout"].rms_mm,
        float(np.nanmedian(error)),
        fit.accuracy["holdout"].max_mm,
        len(fit.suspects),
        sum(one.together for one in fit.suspects),
        int(np.isfinite(fit.errors["train"][..., 0]).sum()),
    )


def real_table(jobs: Sequence[RealJob], results: Sequence[RealResult]) -> Table:
    """Means over the splits: before and after joint compliance is in the model."""
    rows: list[tuple[Cell, ...]] = []
    for key in dict.fromkeys((job.effects, job.way) for job in jobs):
        own = [r for job, r in zip(jobs, results, strict=True) if (job.effects, job.way) == key]

        def mean(name: str, own: Sequence[RealResult] = own) -> float:
            return float(np.mean([getattr(result, name) for result in own]))

        effects, way = key
        rows.append(
            (", ".join(effects) or "geometry alone", way, len(own), mean("points"),
             mean("suspects"), mean("together"), mean("rms"), mean("median"), mean("largest"))
        )  # fmt: skip
    return Table(
        "IRB 120, real: suspects are compliance, not mistakes (means over the splits)",
        ("model", "fit", "splits", "training points", "suspects", "of whole poses",
         "held out RMS mm", "median mm", "max mm"),
        tuple(rows),
        ("", "", "d", ".0f", ".1f", ".1f", ".4f", ".4f", ".3f"),
    )  # fmt: skip


def real_jobs(study: Study) -> list[RealJob]:
    """Splits of the real measurements; none where they are not on this machine."""
    if not here("irb120"):
        click.echo("IRB 120: its measurements are not on this machine", err=True)
        return []
    ways = ("sum", "sum, tukey") if study.quick else tuple(w for w in WAYS if "sum" in w)
    return [
        RealJob(way, effects, study.seed + split, 100 if study.quick else 0)
        for effects in ((), ("joint_compliance:all",))
        for way in ways
        for split in range(1 if study.quick else 3)
    ]


# ---- the study -------------------------------------------------------------------------------


def gathered(
    jobs: Sequence[Job], results: Sequence[dict[str, Result]], chosen: Callable[[Job], bool]
) -> list[Row]:
    """A row for each way and setting of the chosen jobs."""
    settings = sorted({(job.share, job.shift) for job in jobs if chosen(job)})
    pairs = list(zip(jobs, results, strict=True))
    return [
        Row.of(way, *at, [found[way] for job, found in pairs if (job.share, job.shift) == at])
        for way in WAYS
        for at in settings
    ]


@click.command()
@study_options("outliers")
@click.option("--seeds", type=int, default=5, show_default=True, help="Arms of each kind.")
def main(study: Study, seeds: int) -> None:
    """Wrong points: held-out accuracy and lists of suspects, simulated and real."""
    shares = (SHARE, 20) if study.quick else SHARES
    shifts = (SHIFT,) if study.quick else SHIFTS
    seeds, poses = (1, 40) if study.quick else (seeds, 100)
    settings = dict.fromkeys([(s, SHIFT) for s in shares] + [(SHARE, shift) for shift in shifts])
    jobs = [
        Job(robot, poses, share, shift, study.seed + seed)
        for share, shift in settings
        for robot in ROBOTS
        for seed in range(seeds)
    ]
    results = study.sweep(run, jobs, "wrong points")
    by_share = gathered(jobs, results, lambda job: job.shift == SHIFT)
    by_shift = gathered(jobs, results, lambda job: job.share == SHARE)
    told = [row for row in by_share if row.share == SHARE]
    summary = promise(told)
    tables = [
        summary,
        table_of(f"wrong points off by {SHIFT:g} mm", by_share),
        table_of(f"{SHARE} % of points wrong", by_shift),
    ]
    splits = real_jobs(study)
    if splits:
        tables.append(real_table(splits, study.sweep(run_real, splits, "IRB 120")))
    content: dict[str, object] = {
        "promise": {r.way: r.kept == "yes" for r in told},
        "by_share": [plain(row) for row in by_share],
        "by_shift": [plain(row) for row in by_shift],
    }
    if splits:
        content["irb120"] = [
            dict(zip(tables[-1].header, row, strict=True)) for row in tables[-1].rows
        ]
    study.save(tables, content, {"outliers": picture(by_share, by_shift)})


def plain(row: Row) -> dict[str, object]:
    """For JSON, which knows no NaN."""
    return {name: None if value != value else value for name, value in vars(row).items()}


if __name__ == "__main__":
    sweep.start(__file__)
