"""Does minimax calibrate better than the sum?  Many splits, at random and by groups: paper M.

    python -m experiments.splits [--quick] [--out FOLDER] [--json FILE] [--seed N] ...

One split tells little: on held-out poses the two objectives differ by less than two splits do.
Random: so many training poses, the others held out.  By groups: the poses of a region of the joint
space (clusters by k-means) are held out together, each region once a clustering.  Ratios of minimax
over sum: below one minimax is better.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy.cluster.vq import kmeans2

from experiments.conditions import CONDITION_ROBOTS, list_available_robots, load_or_simulate_robot
from experiments.study_record import new_figure
from experiments.sweep import Study, study_options
from minimax_cal.core.arrays import Array
from minimax_cal.core.tables import Table
from minimax_cal.fitting.calibrate import calibrate
from minimax_cal.measuring.measurements import Measurements

if TYPE_CHECKING:
    from matplotlib.figure import Figure

REGIONS_PER_CLUSTERING = 6
SPLIT_WAYS = ("random", "by groups")
SPLIT_MEASURES = ("RMSE(phi)", "largest")


@dataclass(frozen=True)
class SplitJob:
    """One split of one robot.  train: training poses of a random one."""

    robot: str
    way: str
    split: int
    train: int
    seed: int


@dataclass(frozen=True)
class HeldOutErrors:
    """Held-out RMSE(phi) and largest error, under sum and under minimax [mm]."""

    sum: tuple[float, float]
    minimax: tuple[float, float]

    @property
    def ratio(self) -> tuple[float, float]:
        """Minimax over sum."""
        first, second = (b / a for a, b in zip(self.sum, self.minimax, strict=True))
        return first, second


def cluster_poses(q: Array, seed: int) -> Array:
    """(m,) the region of each pose: k-means on the joints, each measured by its spread.

    q: (m, n) [rad, m].
    """
    spread = q.std(axis=0)
    points = q / np.where(spread > 0.0, spread, 1.0)
    centres = [points[np.random.default_rng(seed).integers(len(points))]]
    while (
        len(centres) < REGIONS_PER_CLUSTERING
    ):  # each next one as far as can be from those there are
        apart = np.linalg.norm(points[:, None] - np.array(centres), axis=-1).min(axis=1)
        centres.append(points[apart.argmax()])
    _, label = kmeans2(points, np.array(centres), minit="matrix")
    return np.asarray(label)


def find_held_out_poses(data: Measurements, job: SplitJob) -> Array:
    """(m,) True where a pose is held out."""
    if job.way == "by groups":
        clustering, region = divmod(job.split, REGIONS_PER_CLUSTERING)
        return np.asarray(cluster_poses(data.q, 1000 * job.seed + clustering) == region)
    order = np.random.default_rng([job.seed, job.split]).permutation(data.poses)
    held = np.ones(data.poses, dtype=bool)
    held[order[: job.train]] = False
    return held


def run_split(job: SplitJob) -> HeldOutErrors:
    """Calibrate both ways and judge on the poses held out."""
    robot, data = load_or_simulate_robot(job.robot, job.seed + job.split)
    held = find_held_out_poses(data, job)
    out = {}
    for objective in ("sum", "minimax"):
        fit = calibrate(robot, data.take(~held), objective, holdout=0.0)
        some = data.take(held)
        distance = 1e3 * np.linalg.norm(some.y - fit.predict(some.q), axis=-1)
        phi = float(np.sqrt((distance**2).mean(axis=0).max()))
        out[objective] = (phi, float(distance.max()))
    return HeldOutErrors(out["sum"], out["minimax"])


def list_split_jobs(study: Study) -> list[SplitJob]:
    """Random splits and groups of every robot whose measurements are here."""
    robots = list_available_robots()
    count, clusterings = (2, 1) if study.quick else (24, 4)
    number = {
        "random": count,
        "by groups": 2 if study.quick else clusterings * REGIONS_PER_CLUSTERING,
    }
    return [
        SplitJob(name, way, split, CONDITION_ROBOTS[name][2], study.seed)
        for name in (robots[:2] if study.quick else robots)
        for way in SPLIT_WAYS
        for split in range(number[way])
    ]


def run_all_cases(study: Study) -> dict[SplitJob, HeldOutErrors]:
    """Every split."""
    jobs = list_split_jobs(study)
    return dict(zip(jobs, study.sweep(run_split, jobs, "splits"), strict=True))


@dataclass(frozen=True)
class RatioSpread:
    """Ratios over splits: median, quartiles, and how often minimax wins."""

    median: float
    low: float
    high: float
    wins: int
    splits: int


def ratio_spread(
    results: dict[SplitJob, HeldOutErrors], robot: str, way: str, measure: int
) -> RatioSpread:
    """How minimax fares on one robot."""
    ratio = minimax_over_sum_ratios(results, robot, way, measure)
    low, median, high = (float(x) for x in np.quantile(ratio, (0.25, 0.5, 0.75)))
    return RatioSpread(median, low, high, int((ratio < 1.0).sum()), len(ratio))


def minimax_over_sum_ratios(
    results: dict[SplitJob, HeldOutErrors], robot: str, way: str, measure: int
) -> Array:
    """(splits,) minimax over sum."""
    chosen = [held for job, held in results.items() if (job.robot, job.way) == (robot, way)]
    return np.array([held.ratio[measure] for held in chosen])


def list_studied_robots(results: dict[SplitJob, HeldOutErrors]) -> Sequence[str]:
    """The robots of a study."""
    return list(dict.fromkeys(job.robot for job in results))


def build_ratio_table(results: dict[SplitJob, HeldOutErrors]) -> Table:
    """Median, quartiles and wins."""
    rows = []
    for robot in list_studied_robots(results):
        for way in SPLIT_WAYS:
            for number, measure in enumerate(SPLIT_MEASURES):
                s = ratio_spread(results, robot, way, number)
                rows.append(
                    (
                        CONDITION_ROBOTS[robot][0],
                        way,
                        measure,
                        s.splits,
                        s.median,
                        s.low,
                        s.high,
                        s.wins,
                    )
                )
    return Table.from_rows(
        "minimax over sum on poses held out: below 1 minimax is better",
        rows,
        "robot | held out | measure | splits d | median .4f | lower quartile .4f | "
        "upper quartile .4f | minimax wins d",
    )


def draw_ratio_boxes(results: dict[SplitJob, HeldOutErrors]) -> Figure:
    """All ratios of RMSE(phi)."""
    rows = [(robot, way) for robot in list_studied_robots(results) for way in SPLIT_WAYS]
    figure = new_figure(7.0, 0.5 * len(rows) + 1.2)
    axes = figure.subplots()
    axes.boxplot(
        [minimax_over_sum_ratios(results, robot, way, 0) for robot, way in rows],
        orientation="horizontal",
        tick_labels=[f"{CONDITION_ROBOTS[robot][0]}, {way}" for robot, way in rows],
    )
    axes.axvline(1.0, color="0.5", ls=":")
    axes.set(xlabel="held-out RMSE(phi), minimax over sum")
    axes.invert_yaxis()
    return figure


def save_results(study: Study, results: dict[SplitJob, HeldOutErrors]) -> None:
    """Table and picture."""
    table = build_ratio_table(results)
    study.save([table], {"rows": table.to_records()}, {"splits": draw_ratio_boxes(results)})


@study_options("splits")
def main(study: Study) -> None:
    """Minimax against the sum over many splits, at random and by groups."""
    save_results(study, run_all_cases(study))
