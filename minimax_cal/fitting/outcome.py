"""How any fit ended: one list of questions, asked of what was fitted, whatever instrument saw it.

A fit tells its evidence, file by file; `judge` asks the questions in their order, and the first one
that finds something says how it ended.  Status, exit code, first sentence, files, report and page
read the outcome and nothing else.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from minimax_cal.core.arrays import Array
from minimax_cal.core.display_text import format_first_names
from minimax_cal.core.units import display_unit_of_change
from minimax_cal.fitting.accuracy import Accuracy
from minimax_cal.fitting.contradiction import Contradiction
from minimax_cal.fitting.data_slips import describe_other_arm
from minimax_cal.fitting.outliers import MIN_POINTS_LEFT
from minimax_cal.modelling.parameters import ParameterNames, flatten_link_parameters
from minimax_cal.robots.robot import Robot
from minimax_cal.solvers.status import Status

MAX_MISS_OF_REACH = 0.01  # of the reach: a fit that misses by more contradicts its own data
MAX_MISS_OF_FLOOR = 50.0  # times the floor, likewise
YIELDS = 0.001  # of the reach: so much a sound arm may bend, however well it comes back
MAX_ROTATION_MISS = 0.05  # RMS by which no calibrated arm misses measured rotations [rad]
MIN_CHANGE_SIGMAS = 3.0  # a change below so many sigmas is not shown
MAX_NAMED = 5  # values that a reason names
JUDGED = (Status.CONVERGED, Status.ITERATION_LIMIT, Status.STALLED)  # with an arm to compare


@dataclass(frozen=True)
class FileEvidence:
    """How well a fit meets one of its files.

    source: empty where there is only one.  check: what to check where it contradicts the arm.
    scores: by part of the poses, accuracy over all rows and without outliers.  rotations: RMS by
    part [rad].  drawn: accuracy of the drawn arm by part.  floor: of noise [mm], and how it is
    known; None where it is not.
    """

    scores: Mapping[str, tuple[Accuracy, Accuracy]]
    source: str = ""
    check: str = "the sign of each coordinate"
    rotations: Mapping[str, float] = field(default_factory=dict)
    drawn: Mapping[str, Accuracy] = field(default_factory=dict)
    floor: tuple[float, str] | None = None


@dataclass(frozen=True, eq=False)
class FitEvidence:
    """What the outcome of a fit is judged by.

    robot: as drawn.  mdh: (n, 5) as calibrated.  active: (5n,) True for adopted links.  sigma:
    (5n,) of these, lack of fit included, NaN where not known; drawn: (5n,) of the drawing [m, rad].
    position_sigma, drawn_sigma: RMS over the joints' range by which positions of the calibrated and
    of the drawn arm are known [m]; NaN where not known.  objection: what an instrument itself holds
    against the fit, computed: why its points were not measured, worse: why the drawn arm is no
    worse, outliers: to be checked where the drawn arm is kept; each empty for none.  doubts: that
    decide nothing.
    """

    robot: Robot
    mdh: Array
    active: Array
    files: Sequence[FileEvidence]
    sigma: Array
    drawn: Array
    position_sigma: float = np.nan
    drawn_sigma: float = np.nan
    allow_large_changes: bool = False
    objection: str = ""
    computed: str = ""
    contradictions: tuple[Contradiction, ...] = ()
    worse: str = ""
    outliers: str = ""
    doubts: tuple[str, ...] = ()


@dataclass(frozen=True)
class Outcome:
    """How a fit ended, and why where its arm is not to be used as it is."""

    status: Status
    reason: str = ""


def find_missed_rows(evidence: FitEvidence) -> str:
    """Why the fit contradicts its own rows; empty where it does not."""
    found = (missed_rows(evidence.robot, one) for one in evidence.files)
    return next(filter(None, found), "")


def missed_rows(robot: Robot, file: FileEvidence) -> str:
    """Why a fit contradicts the rows of a file; empty where it does not."""
    limit = 1e3 * MAX_MISS_OF_REACH * robot.reach()
    what = f"{100 * MAX_MISS_OF_REACH:g} % of the arm's reach"
    if file.floor and MAX_MISS_OF_FLOOR * file.floor[0] < limit:
        limit = MAX_MISS_OF_FLOOR * file.floor[0]
        what = f"{MAX_MISS_OF_FLOOR:g} times the noise floor ({file.floor[1]})"
        if limit < 1e3 * YIELDS * robot.reach():
            limit = 1e3 * YIELDS * robot.reach()
            what += f" and {100 * YIELDS:g} % of the arm's reach"
    of_file = f" of {file.source}" if file.source else ""
    for name, (whole, trusted) in file.scores.items():
        few = sum(trusted.counts) < MIN_POINTS_LEFT * sum(whole.counts)
        miss = whole.rms_mm if few else trusted.rms_mm  # where most are suspects it is the fit
        if miss > limit:
            return (
                f"the fit misses the {name} poses{of_file} by {miss:.3g} mm, more than {what}, "
                "suspects aside: it is no calibration of this arm; check the robot file, joint "
                f"signs, units and {file.check}"
            )
    return ""


def find_missed_rotations(evidence: FitEvidence) -> str:
    """Why measured rotations are those of another convention; empty where they are met."""
    for file in evidence.files:
        for name, miss in file.rotations.items():
            if miss > MAX_ROTATION_MISS:
                of_file = f" of {file.source}" if file.source else ""
                return (
                    f"the fit misses the rotations of the {name} poses{of_file} by "
                    f"{1e3 * miss:.3g} mrad RMS: check what their columns hold (a rotation vector, "
                    "a quaternion with w first, or Euler angles in another order)"
                )
    return ""


def find_another_arm(evidence: FitEvidence) -> str:
    """Why the measured arm is not the drawn one; empty where it is.

    A large change is one of the arm only where the drawn arm misses what was measured: else the
    measurements do not show it.
    """
    robot, seen = evidence.robot, [a.rms_mm for one in evidence.files for a in one.drawn.values()]
    if evidence.allow_large_changes or max(seen, default=np.inf) < 1e3 * YIELDS * robot.reach():
        return ""
    return describe_other_arm(robot, evidence.mdh, evidence.active)


def find_contradictions(evidence: FitEvidence) -> str:
    """How files contradict each other; empty where they do not."""
    return "; ".join(one.sentence for one in evidence.contradictions)


def find_undetermined_values(evidence: FitEvidence) -> str:
    """Why the drawing is known better than what was measured; empty where it is not.

    Values count that are less sure than drawn and whose change is not shown.  One of them alone may
    be: of lengths that move the arm alike each is poorly known, and the arm is not.  What decides
    are positions.
    """
    robot, drawn = evidence.robot, evidence.drawn
    vague = select_vague_links(robot, evidence.mdh, evidence.active, evidence.sigma, drawn)
    if robot.rough or not vague.any() or not evidence.position_sigma > evidence.drawn_sigma:
        return ""
    names, times = ParameterNames.for_robot(robot, ()), evidence.sigma / drawn
    worst = [i for i in np.argsort(-np.nan_to_num(times)) if vague[i]]
    named = []
    for i in worst:
        scale, unit = display_unit_of_change("m" if names.linear_mask[i] else "rad")
        named.append(f"{names.all_names[i]} (sigma {scale * evidence.sigma[i]:.3g} {unit})")
    return (
        f"these measurements do not determine "
        f"{format_first_names(named, MAX_NAMED)}: positions of the "
        f"calibrated arm are known to {1e3 * evidence.position_sigma:.3g} mm, of the drawn one to "
        f"{1e3 * evidence.drawn_sigma:.3g} mm (drawn_within of the robot); the drawn arm is kept; "
        "measure more poses, and directions that are not measured yet, or fix these parameters"
        f"{evidence.outliers}"
    )


def select_vague_links(
    robot: Robot, mdh: Array, active: Array, sigma: Array, drawn: Array
) -> Array:
    """(5n,) True for adopted links that are less sure than drawn and whose change is not shown.

    Arguments as the fields of `FitEvidence`.
    """
    change = np.abs(flatten_link_parameters(mdh - robot.mdh))
    with np.errstate(invalid="ignore"):
        return np.asarray(active & (sigma > drawn) & (change < MIN_CHANGE_SIGMAS * sigma))


QUESTIONS: tuple[tuple[Status, Callable[[FitEvidence], str]], ...] = (  # the first one that finds
    (Status.FAILED, lambda evidence: evidence.objection),
    (Status.FAILED, find_missed_rows),
    (Status.FAILED, find_missed_rotations),
    (Status.FAILED, find_another_arm),
    (Status.FAILED, lambda evidence: evidence.computed),
    (Status.CONTRADICTORY, find_contradictions),
    (Status.NOT_DETERMINED, find_undetermined_values),
    (Status.NO_BETTER, lambda evidence: evidence.worse and evidence.worse + evidence.outliers),
)


def judge(evidence: FitEvidence, ended: Status) -> Outcome:
    """How a fit ended.  ended: how its solver did; a fit that never arrived has no arm to keep."""
    for status, find in QUESTIONS:
        reason = find(evidence) if status is Status.FAILED or ended in JUDGED else ""
        if reason:
            return Outcome(status, reason)
    return Outcome(ended)
