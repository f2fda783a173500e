"""Error against iteration from the paper's start: paper S, Fig. 4 to 7.

    python -m experiments.courses [--quick] [--out FOLDER] [--json FILE] [--seed N] ...

The four methods to the letter, in millimetres: from the four deviations of Fig. 5 on the simulated
arm of `convergence`; NLLM alone for ten times as long from starts that it has not come back from
(Fig. 4); and on real arms, 100 poses, one target, from the base at the identity, the target at the
origin and nominal parameters (Fig. 6).  Steps without separation amplify rounding, so that each
start of both runs again and again, each of its values moved by a unit of rounding or not.  Fig. 7
is what the calibration brings there, by the library.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from typing import TYPE_CHECKING

import numpy as np

from experiments import pseudo_inverse
from experiments.convergence import CAP, PAPER, SAME, Setting, flat, grid, letter, measured, nudged
from experiments.real import here, real
from experiments.record import canvas
from experiments.speed import identified
from experiments.sweep import Study, study_options
from minimax_cal.fitting.calibrate import calibrate
from minimax_cal.ground.arrays import Array
from minimax_cal.ground.tables import Table
from minimax_cal.judging.saved import evaluate
from minimax_cal.measuring.measurements import Measurements, measurements
from minimax_cal.robots.robot import Robot

if TYPE_CHECKING:
    from matplotlib.figure import Figure

STARTS = ((-1.0, -1.0), (3.0, -2.8), (0.0, 0.0), (3.1, 3.1))  # Fig. 5 [rad]
SIMULATED = "IRB 2600, simulated"
ARMS = {  # what it is called, its folder, the target that is used
    "IRB 120, real": ("irb120", 1),
    "UR10, real": ("ur10_b", 0),
    "Meca500, real": ("meca500_r", 0),
}
POSES = 100
COPIES = 9  # of each start of Fig. 5 and 6, the first of them as it is
LONGER = 10  # times the paper's limit of iterations, for Fig. 4
UNIT = "all, mm"


@dataclass(frozen=True)
class Job:
    """One method from one start: deviations of theta_2 and alpha_3 [rad].

    copy: which copy of the start; 0 is the start itself, the others are moved by rounding.
    """

    arm: str
    start: tuple[float, float]
    method: str
    cap: int
    seed: int
    copy: int = 0


@dataclass(frozen=True, eq=False)
class Course:
    """RMS of every iterate [mm]; whether the step became small; the least RMS known [mm]."""

    rms_mm: Array
    iterations: int
    converged: bool
    least_mm: float

    @property
    def end_mm(self) -> float:
        """Where it ended."""
        return float(self.rms_mm[-1])

    @property
    def minimum(self) -> bool:
        """Whether it reached the minimum."""
        return bool(self.converged and self.end_mm**2 <= self.least_mm**2 * SAME)


@dataclass(frozen=True)
class Gain:
    """RMS of a nominal and of a calibrated arm [mm], training and held out."""

    arm: str
    nominal: tuple[float, float]
    calibrated: tuple[float, float]

    @property
    def percent(self) -> tuple[float, float]:
        """How much of the nominal RMS is gone, training and held out [%]."""
        both = zip(self.nominal, self.calibrated, strict=True)
        first, second = (100.0 * (1.0 - after / before) for before, after in both)
        return first, second


def divided(arm: str, seed: int) -> tuple[Robot, Measurements, Measurements]:
    """An arm, the poses it is calibrated from, and the others; one target."""
    if arm == SIMULATED:
        robot, data = measured(Setting(seed=seed + 1))
        return robot, data, measured(Setting(seed=seed + 1, poses=300))[1].take(np.arange(60, 300))
    folder, target = ARMS[arm]
    robot, data = real(folder)
    order = np.random.default_rng(seed).permutation(data.poses)
    one = measurements(data.q, data.y[:, [target]])
    return robot, one.take(order[:POSES]), one.take(order[POSES:])


def run(job: Job) -> Course:
    """The course of one method."""
    robot, data, _ = divided(job.arm, job.seed)
    model, _ = identified(robot, data)
    fit = calibrate(robot, data, "sum", holdout=0.0)
    begin = flat(robot, *job.start)
    if job.copy:
        begin = nudged(begin, np.random.default_rng(job.copy))
    count, _, ended, costs = letter(job.method, UNIT, model, begin, job.cap, job.cap + 1)
    rms = 1e3 * np.sqrt(costs[np.isfinite(costs)] / data.poses)
    least = evaluate(fit.cell, data).rms_mm
    return Course(rms, count, ended == pseudo_inverse.CONVERGED, least)


def gain(arm: str, seed: int) -> Gain:
    """Fig. 7: before and after."""
    robot, train, held = divided(arm, seed)
    fit = calibrate(robot, train, "sum", holdout=0.0)
    nominal, calibrated = (
        (evaluate(cell, train).rms_mm, evaluate(cell, held).rms_mm)
        for cell in (fit.nominal, fit.cell)
    )
    return Gain(arm, nominal, calibrated)


def present() -> list[str]:
    """The real arms whose measurements are on this machine."""
    return [arm for arm, (folder, _) in ARMS.items() if here(folder)]


def jobs_of(study: Study) -> list[Job]:
    """Fig. 5 and Fig. 6."""
    cap = 100 if study.quick else CAP
    arms = present()[:1] if study.quick else present()
    places = [*((SIMULATED, start) for start in STARTS), *((arm, (0.0, 0.0)) for arm in arms)]
    copies = range(2 if study.quick else COPIES)
    every = product(places, PAPER, copies)
    return [Job(*place, method, cap, study.seed, copy) for place, method, copy in every]


@dataclass(frozen=True, eq=False)
class Found:
    """Fig. 5 and 6, Fig. 4 (the limit of each job is its second part), and Fig. 7."""

    courses: dict[Job, Course]
    longer: dict[Job, Course]
    gains: list[Gain]

    def of(self, arm: str, start: tuple[float, float] = (0.0, 0.0)) -> dict[str, list[Course]]:
        """The courses of all copies of one start by method."""
        own = [(j, c) for j, c in self.courses.items() if (j.arm, j.start) == (arm, start)]
        return {method: [c for j, c in own if j.method == method] for method in PAPER}


def study_of(study: Study) -> Found:
    """Everything."""
    jobs = jobs_of(study)
    courses = dict(zip(jobs, study.sweep(run, jobs, "courses"), strict=True))
    arms = [SIMULATED, *present()]
    gains = [gain(arm, study.seed) for arm in arms]
    return Found(courses, longer(study, jobs[0].cap), gains)


def longer(study: Study, cap: int) -> dict[Job, Course]:
    """Fig. 4: the first starts of a coarse grid that NLLM has not come back from, for longer."""
    theta, alpha = grid(15)
    starts = zip(theta.tolist(), alpha.tolist(), strict=True)
    jobs = [Job(SIMULATED, start, "nllm", cap, study.seed) for start in starts]
    ended = study.sweep(run, jobs, "which starts NLLM does not come back from")
    stuck = [job for job, course in zip(jobs, ended, strict=True) if not course.converged]
    some = stuck[: 1 if study.quick else 4]
    more = [Job(j.arm, j.start, j.method, LONGER * cap, j.seed) for j in some]
    return dict(zip(more, study.sweep(run, more, "for longer"), strict=True))


def course_table(title: str, courses: dict[Job, Course]) -> Table:
    """How each course ended."""
    rows = [
        (
            job.arm,
            f"({job.start[0]:g}, {job.start[1]:g})",
            job.method.upper(),
            job.copy,
            course.iterations,
            course.end_mm,
            course.least_mm,
            rises(course),
            "minimum" if course.minimum else "converged" if course.converged else "not converged",
        )
        for job, course in courses.items()
    ]
    return Table.made(
        title,
        rows,
        "arm | start rad | method | moved d | iterations d | end mm .4f | "
        "least known mm .4f | rises d | ended",
    )


def rises(course: Course) -> int:
    """How often the error rose from one iterate to the next."""
    return int(np.count_nonzero(np.diff(course.rms_mm) > 1e-9 * course.rms_mm[:-1]))


def gain_table(gains: Sequence[Gain]) -> Table:
    """Fig. 7 in numbers."""
    rows = []
    for g in gains:
        pairs = zip(g.nominal, g.calibrated, g.percent, strict=True)
        rows.append((g.arm, *(value for pair in pairs for value in pair)))
    return Table.made(
        "RMS position error before and after the calibration (paper: improved by 72.46 %)",
        rows,
        "arm | nominal mm, training .4f | calibrated mm, training .4f | "
        "improved %, training .2f | nominal mm, held out .4f | calibrated mm, held out .4f | "
        "improved %, held out .2f",
    )


def picture(panels: dict[str, dict[str, Course]], across: int) -> Figure:
    """Error against iteration, a panel each."""
    down = -(-len(panels) // across)
    figure = canvas(4.2 * across, 3.2 * down)
    every = figure.subplots(down, across, squeeze=False).ravel()
    for axes in every[len(panels) :]:
        axes.set_axis_off()
    for axes, (title, courses) in zip(every, panels.items(), strict=False):
        for name, course in courses.items():
            shown = np.clip(course.rms_mm, None, 1e5)
            axes.plot(np.arange(1, len(shown) + 1), shown, marker=".", ms=3, label=name)
        axes.set(title=title, xscale="log", yscale="log", xlabel="iteration", ylabel="RMS (mm)")
        axes.grid(visible=True, alpha=0.3)
    every[0].legend(frameon=False, fontsize="small")
    return figure


def pictures(found: Found) -> dict[str, Figure]:
    """Fig. 4, 5 and 6, by file name."""

    def upper(courses: dict[str, list[Course]]) -> dict[str, Course]:
        return {method.upper(): copies[0] for method, copies in courses.items()}

    five = {f"({s[0]:g}, {s[1]:g})": upper(found.of(SIMULATED, s)) for s in STARTS}
    arms = dict.fromkeys(job.arm for job in found.courses if job.arm != SIMULATED)
    six = {arm: upper(found.of(arm)) for arm in (*arms, *([] if arms else [SIMULATED]))}
    out = {"s_fig5": picture(five, 2), "s_fig6": picture(six, len(six))}
    if found.longer:
        named = {f"({j.start[0]:g}, {j.start[1]:g})": c for j, c in found.longer.items()}
        out["s_fig4"] = picture({"NLLM": named}, 1)
    return out


def save(study: Study, found: Found) -> None:
    """Tables and pictures."""
    tables = [
        course_table(
            "paper S, Fig. 5 and 6: to the letter, in mm; moved: 0 as it is, else by rounding",
            found.courses,
        ),
        course_table("paper S, Fig. 4: NLLM from where it did not come back", found.longer),
        gain_table(found.gains),
    ]
    content = {"gains": [{"arm": g.arm, "improved_percent": g.percent} for g in found.gains]}
    study.save(tables, content, pictures(found))


@study_options("courses")
def main(study: Study) -> None:
    """Error against iteration from the paper's start: paper S, Fig. 4-7."""
    save(study, study_of(study))
