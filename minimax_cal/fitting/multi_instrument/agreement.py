"""Whether several files agree on one arm, beside what an arm does that no link holds.

How large that is (`several.lack`), and how noisy each file is, fits of each file with links of its
own say.  Links of its own are then tested against those of all together: a score test in the
covariance of noise and lack.  A cause is a direction among these links.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import cast

import numpy as np
from scipy.spatial.transform import Rotation
from scipy.special import fdtrc

from minimax_cal.core.arrays import Array, rms
from minimax_cal.core.errors import DataError
from minimax_cal.fitting.common_scale import (
    MIN_SCALE_ERROR,
    fit_scale_of_lengths,
    is_not_tool_length,
)
from minimax_cal.fitting.contradiction import (
    BASE,
    CLOCK,
    JOINT_ZERO,
    ORDER_OF_ANGLES,
    SCALE,
    Contradiction,
    ContradictionCause,
    has_base_moved,
)
from minimax_cal.fitting.data_slips import MAX_REMAINING_OF_MENDED_SQUARE
from minimax_cal.fitting.identification import ReasonKind
from minimax_cal.fitting.multi_instrument.instrument_fit import InstrumentFit, fit_instruments
from minimax_cal.fitting.multi_instrument.lack import (
    Components,
    FileRows,
    estimate_components,
    rows_of_files,
)
from minimax_cal.fitting.multi_instrument.options import RelativeOptions, silent_progress
from minimax_cal.instruments.instrument import Instrument
from minimax_cal.instruments.tracker_points import TrackerPoints
from minimax_cal.instruments.whole_poses import WholePoses
from minimax_cal.measuring.measurements import Measurements
from minimax_cal.measuring.session_frames import session_labels as labels_of_sessions
from minimax_cal.modelling.parameters import flatten_link_parameters, joint_zero_indices
from minimax_cal.robots.kinematics import rotation_to_vector
from minimax_cal.robots.robot import Robot
from minimax_cal.solvers.least_squares import solve_normal_equations

MAX_P = 1e-4  # of no contradiction, below which files contradict each other
MAX_P_OF_NOTICE = 0.01  # of no common factor, below which one is worth a word
MIN_P_OF_REST = 1e-3  # of what a cause leaves, above which it explains the contradiction
MIN_LEAD = 12.0  # in twice the log likelihood, of a cause before its rivals
MIN_TOLD = 0.1  # of a link as far off as a bad drawing, beside noise: a direction that files tell
OFF_LENGTH, OFF_ANGLE = 1e-3, 1e-3  # how far links may differ between files [m, rad]
OFF_CLOCK = 1e-2  # and when they were measured [s]
MIN_SHARE = 0.3  # of the noise, by which files that differ move what was measured
DIFFERENCE = 1e-6  # of a central difference [m, rad]
ALIKE, SAME_TURN = 2.0, 1e-9  # what readings of rotations leave [m^2] / [m^2], and hold
MAX_REFITS = 3  # with a delay taken out
MIN_DOF = 15  # numbers beyond links of its own, of a file that is tested


@dataclass(frozen=True, eq=False)
class ScoreTest:
    """Links and delays of their own of all files but the first, tested beside those of all.

    score: (k,), information: (k, k) of them, whose unit is `unit` (k,) [SI].  dof: of the noise, of
    the file that tells it least.
    """

    score: Array
    information: Array
    unit: Array
    dof: float

    @staticmethod
    def of(files: list[FileRows], found: Components, unit: Array) -> ScoreTest:
        """unit: (5n + 1,) how far links, and delays, may differ between files [SI]."""
        fitted = [np.concatenate([one.shared, one.lack]) for one in files]
        pairs = list(zip(files, fitted, found.noise, strict=True))
        prior = np.concatenate([np.zeros(len(files[0].shared)), 1.0 / found.lack])
        normal = sum(z @ z.T / v for _, z, v in pairs) + np.diag(prior)
        gradient = sum(z @ one.error / v for one, z, v in pairs)
        own = [unit[:, None] * one.links for one, _, _ in pairs]
        beside = np.concatenate(
            [z @ c.T / v for (_, z, v), c in zip(pairs, own, strict=True)][1:], axis=1
        )
        score = np.concatenate(
            [c @ one.error / v for (one, _, v), c in zip(pairs, own, strict=True)][1:]
        )
        count = len(unit)
        plain = np.zeros((len(score),) * 2)
        for i, ((_, _, v), c) in enumerate(list(zip(pairs, own, strict=True))[1:]):
            part = slice(i * count, (i + 1) * count)
            plain[part, part] = c @ c.T / v
        taken = solve_normal_equations(normal, np.column_stack([beside, gradient]))
        return ScoreTest(
            score - beside.T @ taken[:, -1],
            plain - beside.T @ taken[:, :-1],
            np.tile(unit, len(files) - 1),
            float(min(one.alone.degrees for one in files)),
        )

    @cached_property
    def told(self) -> tuple[Array, Array]:
        """Eigenvalues (t,) and vectors (k, t) of what the files tell of differences."""
        values, vectors = np.linalg.eigh(0.5 * (self.information + self.information.T))
        kept = values > MIN_TOLD**2
        return values[kept], vectors[:, kept]

    @cached_property
    def statistic(self) -> float:
        """Of all differences together, chi-squared with `count` degrees of freedom."""
        values, vectors = self.told
        return float(((vectors.T @ self.score) ** 2 / values).sum())

    @property
    def count(self) -> int:
        """Number of differences that the files tell."""
        return len(self.told[0])

    def p_value(self, statistic: float, count: int) -> float:
        """Of so much in so many directions by chance."""
        return float(fdtrc(count, self.dof, statistic / count)) if count > 0 else 1.0

    def along(self, direction: Array) -> tuple[float, float]:
        """Statistic of one direction (k,) [SI], and how far along it the files differ."""
        direction = direction / self.unit
        told = float(direction @ self.information @ direction)
        if told < MIN_TOLD**2 * float(direction @ direction):  # own unknowns of the file take it
            return 0.0, 0.0
        pull = float(direction @ self.score)
        return pull**2 / told, pull / told


def causes(robot: Robot, mdh: Array, files: int) -> Iterator[tuple[int, str, str, str, Array]]:
    """File, kind, place, unit and direction (k,) of each cause, in the files but the first.

    What differs in the first differs in all others the other way.
    """
    links = 5 * robot.joints + 1
    lengths = np.where(
        np.arange(links) < 2 * robot.joints, np.append(flatten_link_parameters(mdh), 0.0), 0.0
    )
    kinds = [(SCALE, "", "1", lengths), (CLOCK, "", "s", np.eye(links)[-1])]
    for joint, at in enumerate(joint_zero_indices(robot.prismatic)):
        unit = "m" if robot.prismatic[joint] else "rad"
        kinds.append((JOINT_ZERO, f"J{joint + 1}", unit, np.eye(links)[at]))
    for file in range(1 if files == 2 else 0, files):
        for kind, place, unit, each in kinds:
            direction = np.zeros((files - 1, links))
            direction[slice(None) if file == 0 else file - 1] = -each if file == 0 else each
            yield file, kind, place, unit, direction.reshape(-1)


@dataclass(frozen=True)
class TestedCause:
    """A cause, what it gains in the statistic, and how far it moves what was measured [m]."""

    gain: float
    cause: ContradictionCause
    file: int
    motion: float


def tested_causes(
    robot: Robot, mdh: Array, files: list[FileRows], labels: list[str], test: ScoreTest
) -> list[TestedCause]:
    """Every cause, the one that gains most first."""
    out, links = [], [one.links for one in files[1:]]
    for file, kind, place, unit, direction in causes(robot, mdh, len(files)):
        gain, by = test.along(direction)
        each = zip(links, direction.reshape(len(links), -1), strict=True)
        motion = np.concatenate([part.T @ one for part, one in each])
        motion = motion[motion != 0.0]
        size = abs(by) * float(np.sqrt((motion**2).mean())) if len(motion) else 0.0
        out.append(
            TestedCause(gain, ContradictionCause(kind, place or labels[file], by, unit), file, size)
        )
    return sorted(out, key=lambda one: -one.gain)


def fit_delayed(robot: Robot, fit: InstrumentFit, label: str, delay: float) -> InstrumentFit:
    """The fit of the same files, with the joints of one where they were so much later [s]."""
    one = fit.training_data[label]
    rate = [one.at.columns[f"rate{j + 1}"] for j in range(robot.joints)]
    later = replace(one, at=replace(one.at, q=one.at.q + delay * np.stack(rate, axis=1)))
    return fit_instruments(
        robot, {**fit.training_data, label: later}, RelativeOptions(), silent_progress
    )


def find_contradictions(
    robot: Robot, fit: InstrumentFit, refits: int = MAX_REFITS
) -> tuple[Contradiction, ...]:
    """What the files of a fit contradict each other by; none where they agree, or there is one.

    Nothing is said of a difference that hardly moves what was measured beside noise and lack.  A
    delay moves joints by more than the fit is linear in: it is the cause where a fit without it
    leaves no contradiction.  refits: how often that is tried.
    """
    if len(fit.training_data) < 2:
        return ()
    files, groups = rows_of_files(robot, fit)
    timed = [one.links[-1].any() for one in files]
    if sum(timed) > 1:  # of a delay that all of these have the arm may be the cause
        files = [replace(o, shared=np.concatenate([o.shared, o.links[-1:]])) for o in files]
    last = np.argsort(timed, kind="stable")  # a lone recording in motion is held against the others
    files, every = [files[i] for i in last], [fit.stack.labels[i] for i in last]
    told = [one.alone.degrees >= MIN_DOF for one in files]  # the others have no fit of their own
    files = [one for one, known in zip(files, told, strict=True) if known]
    labels = [label for label, known in zip(every, told, strict=True) if known]
    if len(files) < 2:
        return ()
    counts = [2 * robot.joints, 3 * robot.joints, 1]
    unit = np.repeat([OFF_LENGTH, OFF_ANGLE, OFF_CLOCK], counts)
    found = estimate_components([one.alone for one in files], groups)
    test = ScoreTest.of(files, found, unit)
    if not test.count:
        return ()
    first, *rivals = tested_causes(robot, fit.state.mdh, files, labels, test)
    p_cause = test.p_value(first.gain, 1) * (1 + len(rivals))
    p = min(2.0 * min(test.p_value(test.statistic, test.count), p_cause), 1.0)
    numbers = sum(one.degrees for one in files)
    lack = [float((found.lack @ one.lack**2).mean()) for one in files]
    usual = float(np.sqrt(np.mean(found.noise + lack)))
    is_small = test.statistic - test.count < MIN_SHARE**2 * numbers
    if p > MAX_P or is_small or first.motion < MIN_SHARE * usual:
        return ()
    names = (labels[first.file], *(n for i, n in enumerate(labels) if i != first.file))

    def p_of_rest(one: TestedCause) -> float:
        return test.p_value(max(test.statistic - one.gain, 0.0), test.count - 1)

    is_alone = all(
        first.gain - one.gain > MIN_LEAD or p_of_rest(one) < MIN_P_OF_REST for one in rivals
    )
    named = first.cause if is_alone and p_of_rest(first) >= MIN_P_OF_REST else None
    if is_alone and not named and first.cause.kind == CLOCK and refits:
        delayed = fit_delayed(robot, fit, names[0], first.cause.by)
        rest = find_contradictions(robot, delayed, refits - 1)
        more = rest[0].cause if rest else replace(first.cause, by=0.0)
        if more and (more.kind, more.place) == (CLOCK, first.cause.place):
            named = replace(first.cause, by=first.cause.by + more.by)
    return (Contradiction(names, p, named),)


def find_other_order(robot: Robot, fit: InstrumentFit) -> tuple[Contradiction, ...]:
    """That rotations of a file are of another order, by which links of its own leave the noise.

    Another reading that leaves as little is a rival, and nothing is said.
    """
    out, (files, _) = [], rows_of_files(robot, fit)
    for i, (block, rows) in enumerate(zip(fit.stack.blocks, files, strict=True)):
        one, x = block.instrument, fit.stack.state_of_block(fit.state, i)
        if not isinstance(one, WholePoses):
            continue
        none = np.zeros(rows.links.shape[0] - 1 + 6 + x.effects.size, dtype=bool)
        given = float(rows.alone.error @ rows.alone.error)
        found = []
        for text, mended in one.propose_data_corrections():
            error = block.with_measurements(robot, mended, fit.stack.laws, x).rows(x, none)[0]
            left = error - rows.span @ (rows.span.T @ error)
            found.append((float(left @ left), text, mended.pose[:, :3, :3]))
        best, mend, turn = min(found, key=lambda each: each[0])
        degrees = max(rows.alone.degrees, 1.0)
        p = float(fdtrc(degrees, degrees, given / best))
        alike = [other for left, _, other in found if left < ALIKE * best]
        is_alone = all(np.allclose(other, turn, atol=SAME_TURN) for other in alike)
        if is_alone and best < MAX_REMAINING_OF_MENDED_SQUARE * given and p < MAX_P:
            apart = Rotation.from_matrix(turn.swapaxes(1, 2) @ one.pose[:, :3, :3]).magnitude()
            name = fit.stack.labels[i]
            others = (label for label in fit.stack.labels if label != name)
            cause = ContradictionCause(ORDER_OF_ANGLES, name, rms(np.asarray(apart)), "rad", mend)
            out.append(Contradiction((name, *others), p, cause))
    return tuple(out)


def find_moved_bases(fit: InstrumentFit) -> tuple[Contradiction, ...]:
    """Which bases moved between files of one frame, as far as the fit knows where they stand.

    Lengths know no frame.  Sessions of one file say that something moved, and contradict nothing.
    """
    framed = [i for i, one in enumerate(fit.stack.instruments) if isinstance(one, TrackerPoints)]
    dof = max(
        float(
            sum(one.degrees_of_freedom for one in fit.stack.instruments) - fit.problem.active.sum()
        ),
        1,
    )
    out = []
    for later, i in ((later, i) for at, later in enumerate(framed) for i in framed[:at]):
        place = np.concatenate([fit.stack.own_columns(i)[:6], fit.stack.own_columns(later)[:6]])
        covariance = fit.covariance[np.ix_(place, place)]
        own = fit.state.effects[place - fit.stack.names.geometric_count]

        def jump(own: Array, pair: tuple[int, int] = (i, later)) -> Array:
            (turn, origin), (turned, moved) = (
                cast(TrackerPoints, fit.stack.instruments[one]).base_rotation_and_origin(part)
                for one, part in zip(pair, np.split(own, 2), strict=True)
            )
            return np.concatenate([turn.T @ (moved - origin), rotation_to_vector(turn.T @ turned)])

        steps = DIFFERENCE * np.eye(12)
        slopes = np.array([jump(own + s) - jump(own - s) for s in steps]).T / (2.0 * DIFFERENCE)
        value, spread = jump(own), slopes @ covariance @ slopes.T
        if not np.isfinite(spread).all():
            continue
        p = float(fdtrc(6, dof, value @ solve_normal_equations(spread, value[:, None])[:, 0] / 6.0))
        shift, turn = float(np.linalg.norm(value[:3])), float(np.linalg.norm(value[3:]))
        if has_base_moved(shift, turn, p, MAX_P):
            first, name = fit.stack.labels[i], fit.stack.labels[later]
            out.append(Contradiction((name, first), p, ContradictionCause(BASE, name, shift, "m")))
    return tuple(out)


def find_other_scale(
    robot: Robot, fit: InstrumentFit, within: Array
) -> tuple[tuple[Contradiction, ...], str]:
    """That a lone file has another length standard than the drawing; where that is not sure, a
    notice.

    within: (5n,) how well the drawing is known [m, rad].
    """
    links, one = 5 * robot.joints, fit.stack.instruments[0]
    kept = {why.kind for why in fit.identification.reasons.values()}
    if (
        len(fit.training_data) > 1
        or robot.rough
        or not one.has_length
        or ReasonKind.NO_SCALE in kept
    ):
        return (), ""
    told = np.flatnonzero(fit.identification.active[:links] & is_not_tool_length(robot))
    covariance = fit.covariance[np.ix_(told, told)] + np.diag(within[told] ** 2)
    found = fit_scale_of_lengths(
        robot, told, flatten_link_parameters(fit.state.mdh - robot.mdh)[told], covariance
    )
    if not found or found.p_value > MAX_P_OF_NOTICE or abs(found.share) < MIN_SCALE_ERROR:
        return (), ""
    name, long = fit.stack.labels[0], "longer" if found.share > 0.0 else "shorter"
    if found.p_value < MAX_P:
        return (
            Contradiction(
                (name,), found.p_value, ContradictionCause(SCALE, name, found.share, "1")
            ),
        ), ""
    return (), (
        f"all lengths of the arm come out {100 * abs(found.share):.3g} % (sigma "
        f"{100 * found.sigma:.2g} %) {long} than drawn (p = {found.p_value:.0e}): check the scale, "
        f"units and temperature compensation of {name}"
    )


def find_contradicting_sessions(
    robot: Robot, data: Measurements, trusted: Array
) -> tuple[Contradiction, ...]:
    """The same of the sessions of a tracker, each with a frame of its own.

    trusted: (k, m) True for points that the fit believes.
    """
    label = labels_of_sessions(data)
    points = data.with_y(np.where(trusted.T[..., None], data.y, np.nan))
    trains: dict[str, Instrument] = {}
    for name in dict.fromkeys(label.tolist()):
        rows = (label == name) & trusted.any(axis=0)
        if 3 * int(trusted[:, rows].sum()) >= MIN_DOF:
            trains[name] = TrackerPoints(points.take(rows))
    if len(trains) < 2:
        return ()
    try:
        fit = fit_instruments(robot, trains, RelativeOptions(), silent_progress)
    except DataError:  # too few points for a fit of all
        return ()
    return find_contradictions(robot, fit)
