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
from experiments.convergence import (
    MAX_PAPER_ITERATIONS,
    MAX_SAME_MINIMUM_RATIO,
    PAPER_S_METHODS,
    ConvergenceSetting,
    paper_start_vector,
    perturb_by_rounding,
    run_paper_iteration,
    simulate_measurements,
    start_deviations,
)
from experiments.real_arms import has_measurements, read_real_arm
from experiments.speed import identify_parameters
from experiments.study_record import new_figure
from experiments.sweep import Study, study_options
from minimax_cal.core.arrays import Array
from minimax_cal.core.tables import Table
from minimax_cal.fitting.calibrate import calibrate
from minimax_cal.measuring.measurements import Measurements, measurements
from minimax_cal.robots.robot import Robot
from minimax_cal.validation.evaluation import evaluate

if TYPE_CHECKING:
    from matplotlib.figure import Figure

FIGURE_5_STARTS = ((-1.0, -1.0), (3.0, -2.8), (0.0, 0.0), (3.1, 3.1))  # Fig. 5 [rad]
SIMULATED_ARM_NAME = "IRB 2600, simulated"
REAL_COURSE_ARMS = {  # what it is called, its folder, the target that is used
    "IRB 120, real": ("irb120", 1),
    "UR10, real": ("ur10_b", 0),
    "Meca500, real": ("meca500_r", 0),
}
TRAINING_POSE_COUNT = 100
COPIES_PER_START = 9  # of each start of Fig. 5 and 6, the first of them as it is
LONGER_RUN_FACTOR = 10  # times the paper's limit of iterations, for Fig. 4
COURSE_PARAMETER_UNIT = "all, mm"


@dataclass(frozen=True)
class CourseJob:
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
class ErrorCourse:
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
        return bool(self.converged and self.end_mm**2 <= self.least_mm**2 * MAX_SAME_MINIMUM_RATIO)


@dataclass(frozen=True)
class CalibrationGain:
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


def load_and_split_arm(arm_name: str, seed: int) -> tuple[Robot, Measurements, Measurements]:
    """An arm, the poses it is calibrated from, and the others; one target."""
    if arm_name == SIMULATED_ARM_NAME:
        robot, data = simulate_measurements(ConvergenceSetting(seed=seed + 1))
        return (
            robot,
            data,
            simulate_measurements(ConvergenceSetting(seed=seed + 1, poses=300))[1].take(
                np.arange(60, 300)
            ),
        )
    folder, target = REAL_COURSE_ARMS[arm_name]
    robot, data = read_real_arm(folder)
    order = np.random.default_rng(seed).permutation(data.poses)
    one = measurements(data.q, data.y[:, [target]])
    return robot, one.take(order[:TRAINING_POSE_COUNT]), one.take(order[TRAINING_POSE_COUNT:])


def run_course(job: CourseJob) -> ErrorCourse:
    """The course of one method."""
    robot, data, _ = load_and_split_arm(job.arm, job.seed)
    model, _ = identify_parameters(robot, data)
    fit = calibrate(robot, data, "sum", holdout=0.0)
    begin = paper_start_vector(robot, *job.start)
    if job.copy:
        begin = perturb_by_rounding(begin, np.random.default_rng(job.copy))
    count, _, ended, costs = run_paper_iteration(
        job.method, COURSE_PARAMETER_UNIT, model, begin, job.cap, job.cap + 1
    )
    rms = 1e3 * np.sqrt(costs[np.isfinite(costs)] / data.poses)
    least = evaluate(fit.cell, data).rms_mm
    return ErrorCourse(rms, count, ended == pseudo_inverse.ENDED_CONVERGED, least)


def compute_calibration_gain(arm_name: str, seed: int) -> CalibrationGain:
    """Fig. 7: before and after."""
    robot, train, held = load_and_split_arm(arm_name, seed)
    fit = calibrate(robot, train, "sum", holdout=0.0)
    nominal, calibrated = (
        (evaluate(cell, train).rms_mm, evaluate(cell, held).rms_mm)
        for cell in (fit.nominal, fit.cell)
    )
    return CalibrationGain(arm_name, nominal, calibrated)


def list_available_arms() -> list[str]:
    """The real arms whose measurements are on this machine."""
    return [arm for arm, (folder, _) in REAL_COURSE_ARMS.items() if has_measurements(folder)]


def list_course_jobs(study: Study) -> list[CourseJob]:
    """Fig. 5 and Fig. 6."""
    cap = 100 if study.quick else MAX_PAPER_ITERATIONS
    arms = list_available_arms()[:1] if study.quick else list_available_arms()
    places = [
        *((SIMULATED_ARM_NAME, start) for start in FIGURE_5_STARTS),
        *((arm, (0.0, 0.0)) for arm in arms),
    ]
    copies = range(2 if study.quick else COPIES_PER_START)
    every = product(places, PAPER_S_METHODS, copies)
    return [CourseJob(*place, method, cap, study.seed, copy) for place, method, copy in every]


@dataclass(frozen=True, eq=False)
class CourseResults:
    """Fig. 5 and 6, Fig. 4 (the limit of each job is its second part), and Fig. 7."""

    courses: dict[CourseJob, ErrorCourse]
    longer: dict[CourseJob, ErrorCourse]
    gains: list[CalibrationGain]

    def courses_by_method(
        self, arm_name: str, start: tuple[float, float] = (0.0, 0.0)
    ) -> dict[str, list[ErrorCourse]]:
        """The courses of all copies of one start by method."""
        own = [(j, c) for j, c in self.courses.items() if (j.arm, j.start) == (arm_name, start)]
        return {method: [c for j, c in own if j.method == method] for method in PAPER_S_METHODS}


def run_all_cases(study: Study) -> CourseResults:
    """Everything."""
    jobs = list_course_jobs(study)
    courses = dict(zip(jobs, study.sweep(run_course, jobs, "courses"), strict=True))
    arms = [SIMULATED_ARM_NAME, *list_available_arms()]
    gains = [compute_calibration_gain(arm, study.seed) for arm in arms]
    return CourseResults(courses, run_longer_courses(study, jobs[0].cap), gains)


def run_longer_courses(study: Study, max_iterations: int) -> dict[CourseJob, ErrorCourse]:
    """Fig. 4: the first starts of a coarse grid that NLLM has not come back from, for longer."""
    theta, alpha = start_deviations(15)
    starts = zip(theta.tolist(), alpha.tolist(), strict=True)
    jobs = [
        CourseJob(SIMULATED_ARM_NAME, start, "nllm", max_iterations, study.seed) for start in starts
    ]
    ended = study.sweep(run_course, jobs, "which starts NLLM does not come back from")
    stuck = [job for job, course in zip(jobs, ended, strict=True) if not course.converged]
    some = stuck[: 1 if study.quick else 4]
    more = [
        CourseJob(j.arm, j.start, j.method, LONGER_RUN_FACTOR * max_iterations, j.seed)
        for j in some
    ]
    return dict(zip(more, study.sweep(run_course, more, "for longer"), strict=True))


def build_course_table(title: str, courses: dict[CourseJob, ErrorCourse]) -> Table:
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
            count_error_rises(course),
            "minimum" if course.minimum else "converged" if course.converged else "not converged",
        )
        for job, course in courses.items()
    ]
    return Table.from_rows(
        title,
        rows,
        "arm | start rad | method | moved d | iterations d | end mm .4f | "
        "least known mm .4f | rises d | ended",
    )


def count_error_rises(course: ErrorCourse) -> int:
    """How often the error rose from one iterate to the next."""
    return int(np.count_nonzero(np.diff(course.rms_mm) > 1e-9 * course.rms_mm[:-1]))


def build_gain_table(gains: Sequence[CalibrationGain]) -> Table:
    """Fig. 7 in numbers."""
    rows = []
    for g in gains:
        pairs = zip(g.nominal, g.calibrated, g.percent, strict=True)
        rows.append((g.arm, *(value for pair in pairs for value in pair)))
    return Table.from_rows(
        "RMS position error before and after the calibration (paper: improved by 72.46 %)",
        rows,
        "arm | nominal mm, training .4f | calibrated mm, training .4f | "
        "improved %, training .2f | nominal mm, held out .4f | calibrated mm, held out .4f | "
        "improved %, held out .2f",
    )


def draw_courses(panels: dict[str, dict[str, ErrorCourse]], panels_across: int) -> Figure:
    """Error against iteration, a panel each."""
    down = -(-len(panels) // panels_across)
    figure = new_figure(4.2 * panels_across, 3.2 * down)
    every = figure.subplots(down, panels_across, squeeze=False).ravel()
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


def draw_paper_figures(results: CourseResults) -> dict[str, Figure]:
    """Fig. 4, 5 and 6, by file name."""

    def upper(courses: dict[str, list[ErrorCourse]]) -> dict[str, ErrorCourse]:
        return {method.upper(): copies[0] for method, copies in courses.items()}

    five = {
        f"({s[0]:g}, {s[1]:g})": upper(results.courses_by_method(SIMULATED_ARM_NAME, s))
        for s in FIGURE_5_STARTS
    }
    arms = dict.fromkeys(job.arm for job in results.courses if job.arm != SIMULATED_ARM_NAME)
    six = {
        arm: upper(results.courses_by_method(arm))
        for arm in (*arms, *([] if arms else [SIMULATED_ARM_NAME]))
    }
    out = {"s_fig5": draw_courses(five, 2), "s_fig6": draw_courses(six, len(six))}
    if results.longer:
        named = {f"({j.start[0]:g}, {j.start[1]:g})": c for j, c in results.longer.items()}
        out["s_fig4"] = draw_courses({"NLLM": named}, 1)
    return out


def save_results(study: Study, results: CourseResults) -> None:
    """Tables and pictures."""
    tables = [
        build_course_table(
            "paper S, Fig. 5 and 6: to the letter, in mm; moved: 0 as it is, else by rounding",
            results.courses,
        ),
        build_course_table("paper S, Fig. 4: NLLM from where it did not come back", results.longer),
        build_gain_table(results.gains),
    ]
    content = {"gains": [{"arm": g.arm, "improved_percent": g.percent} for g in results.gains]}
    study.save(tables, content, draw_paper_figures(results))


@study_options("courses")
def main(study: Study) -> None:
    """Error against iteration from the paper's start: paper S, Fig. 4-7."""
    save_results(study, run_all_cases(study))
