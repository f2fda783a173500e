"""Whether several files agree on one arm, beside what an arm does that no link holds.

Each file's rows are linear where the joint fit ended.  What no link holds (gears, bending) turns
the joints by functions of the pose (`modelling.rows.by_pose`), the same ones in all files; how
large they are, and how noisy each file is, restricted maximum likelihood says of fits of each file
with links of its own.  Links of its own are then tested against those of all together: a score test
in the covariance of noise and functions.  A cause is a direction among these links.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.special import fdtrc

from minimax_cal.evidence.noise import fit_components, orthonormal
from minimax_cal.fitting.disagreement import JOINT_ZERO, SCALE, Cause, Contradiction
from minimax_cal.fitting.several.fit import InstrumentFit, fit_instruments
from minimax_cal.fitting.several.options import RelativeOptions, silent
from minimax_cal.fitting.several.stack import Block
from minimax_cal.ground.arrays import Array
from minimax_cal.ground.errors import DataError
from minimax_cal.instruments.instrument import Instrument
from minimax_cal.instruments.protocol import by_arm
from minimax_cal.instruments.tracker import Points
from minimax_cal.measuring.measurements import Measurements
from minimax_cal.measuring.stations import labels as labels_of_sessions
from minimax_cal.modelling.parameters import State, links_of, zero_positions
from minimax_cal.modelling.rows import by_pose
from minimax_cal.robots.robot import Robot
from minimax_cal.solvers.least_squares import solve_normal

MAX_P = 1e-4  # of no contradiction, below which files contradict each other
MIN_P_OF_REST = 1e-3  # of what a cause leaves, above which it explains the contradiction
MIN_LEAD = 12.0  # in twice the log likelihood, of a cause before its rivals
MIN_TOLD = 0.1  # of a link as far off as a bad drawing, beside noise: a direction that files tell
OFF_LENGTH, OFF_ANGLE = 1e-3, 1e-3  # how far links may differ between files [m, rad]
SAME = 1e-9  # of a direction: what is told of it is rounding
MIN_DOF = 15  # numbers beyond links of its own, of a file that is tested
ROUNDS = 6  # in which noises and functions of the pose are weighed against each other


@dataclass(frozen=True, eq=False)
class FileRows:
    """The rows of one file, linear where the joint fit ended, in units of metres.

    error: (r,).  shared: (p, r) slopes by all parameters that were fitted, zero for those of other
    files.  links: (5n, r) by every link.  lack: (c, r) by the factors of functions of the pose.
    degrees: independent numbers.
    """

    error: Array
    shared: Array
    links: Array
    lack: Array
    degrees: int

    @cached_property
    def alone(self) -> tuple[Array, Array, int]:
        """Error (r,) and lack (c, r) without what links of its own take, and degrees beyond these."""
        basis = orthonormal(np.concatenate([self.shared, self.links]).T)
        error = self.error - basis @ (basis.T @ self.error)
        lack = self.lack - (self.lack @ basis) @ basis.T
        return error, lack, self.degrees - basis.shape[1]


def lack_slopes(robot: Robot, block: Block, x: State) -> tuple[Array, Array]:
    """(c, r) motion of the rows of a block by each factor of the lack of fit, and (c, 2) its kind.

    robot: with the links of the state.
    """
    rows, links = block.read(x), np.zeros(5 * robot.joints + x.effects.size, dtype=bool)
    zeros = zero_positions(robot.prismatic)
    links[zeros] = True
    links = links[: 5 * robot.joints + x.effects.size - len(block.instrument.names)]
    slopes = by_arm(block.flange(x, links), rows)[np.argsort(np.argsort(zeros))]
    lack, kind = by_pose(robot, block.arm.q[rows.pose], slopes.T[:, None, :])
    return rows.settled(lack[:, 0].T, share=block.share)[1], kind


def rows_of_files(robot: Robot, fit: InstrumentFit) -> tuple[list[FileRows], Array]:
    """The rows of each file, and (c,) the group of each factor of the lack."""
    stack, active = fit.stack, fit.problem.active
    every, out, kind = np.ones(stack.names.count, dtype=bool), [], np.zeros((0, 2), dtype=int)
    place = np.flatnonzero(active)
    arm = robot.with_mdh(fit.state.mdh)
    for i, (block, (error, slopes)) in enumerate(
        zip(stack.blocks, stack.rows_by_block(fit.state, every), strict=True)
    ):
        lack, kind = lack_slopes(arm, block, stack.part(fit.state, i))
        links = slopes[: 5 * robot.joints]
        degrees = block.instrument.degrees
        root = np.sqrt(np.broadcast_to(block.weight, error.shape))
        out.append(
            FileRows(root * error, root * slopes[place], root * links, root * lack, degrees)
        )
    groups = kind[:, 0] * (int(kind[:, 1].max(initial=0)) + 1) + kind[:, 1]
    return out, groups


@dataclass(frozen=True, eq=False)
class Components:
    """noise: (b,) variance of a row of each file [m^2].  lack: (c,) of each factor."""

    noise: Array
    lack: Array


def estimate_components(files: list[FileRows], groups: Array) -> Components:
    """Noises and sizes of the lack, each file with links of its own, by restricted likelihood."""
    left = [one.alone for one in files]
    noise = np.array([float(error @ error) / dof for error, _, dof in left])
    noise = np.maximum(noise, 1e-18)
    lack, dof = np.zeros(len(groups)), sum(dof for _, _, dof in left)
    for _ in range(ROUNDS):
        gram = sum(l @ l.T / v for (_, l, _), v in zip(left, noise, strict=True))
        gradient = sum(l @ e / v for (e, l, _), v in zip(left, noise, strict=True))
        square = sum(float(e @ e) / v for (e, _, _), v in zip(left, noise, strict=True))
        found = fit_components(gram, gradient, square, dof, groups)
        spread = found.moment - np.outer(found.mean, found.mean)
        before = noise
        noise = np.array([
            (float(((e - found.mean @ l) ** 2).sum()) + float(((spread @ l) * l).sum())) / d
            for e, l, d in left
        ])  # fmt: skip
        noise, lack = np.maximum(noise, 1e-18), found.variance[groups]
        if np.all(np.abs(np.log(noise / before)) < 0.01):
            break
    return Components(noise, lack)


@dataclass(frozen=True, eq=False)
class ScoreTest:
    """Links of their own of all files but the first, tested beside those of all together.

    score: (k,), information: (k, k) of them, whose unit is `unit` (k,) [SI].  dof: of the noise, of
    the file that tells it least.
    """

    score: Array
    information: Array
    unit: Array
    dof: float

    @staticmethod
    def of(files: list[FileRows], found: Components, unit: Array) -> ScoreTest:
        """unit: (5n,) how far links may differ between files [SI]."""
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
        taken = solve_normal(normal, np.column_stack([beside, gradient]))
        return ScoreTest(
            score - beside.T @ taken[:, -1],
            plain - beside.T @ taken[:, :-1],
            np.tile(unit, len(files) - 1),
            float(min(one.alone[2] for one in files)),
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
        values, vectors = self.told
        part = vectors.T @ (direction / self.unit)
        told = float(part**2 @ values)
        if told <= SAME * float(part @ part):  # own unknowns of the file take it
            return 0.0, 0.0
        pull = float(part @ (vectors.T @ self.score))
        return pull**2 / told, pull / told


def causes(robot: Robot, mdh: Array, files: int) -> Iterator[tuple[int, str, str, str, Array]]:
    """File, kind, place, unit and direction (k,) of each cause, in the files but the first.

    What differs in the first differs in all others the other way.
    """
    links = 5 * robot.joints
    lengths = np.where(np.arange(links) < 2 * robot.joints, links_of(mdh), 0.0)
    kinds = [(SCALE, "", "1", lengths)]
    for joint, at in enumerate(zero_positions(robot.prismatic)):
        unit = "m" if robot.prismatic[joint] else "rad"
        kinds.append((JOINT_ZERO, f"J{joint + 1}", unit, np.eye(links)[at]))
    for file in range(1 if files == 2 else 0, files):
        for kind, place, unit, each in kinds:
            direction = np.zeros((files - 1, links))
            direction[slice(None) if file == 0 else file - 1] = -each if file == 0 else each
            yield file, kind, place, unit, direction.reshape(-1)


def find_contradictions(robot: Robot, fit: InstrumentFit) -> tuple[Contradiction, ...]:
    """What the files of a fit contradict each other by; none where they agree, or there is one."""
    if len(fit.trains) < 2:
        return ()
    files, groups = rows_of_files(robot, fit)
    known = [i for i, one in enumerate(files) if one.alone[2] >= MIN_DOF]  # else no fit of its own
    files, labels = [files[i] for i in known], [fit.stack.labels[i] for i in known]
    if len(files) < 2:
        return ()
    unit = np.repeat([OFF_LENGTH, OFF_ANGLE], [2 * robot.joints, 3 * robot.joints])
    test = ScoreTest.of(files, estimate_components(files, groups), unit)
    if not test.count:
        return ()
    tried = []
    for file, kind, place, unit_name, direction in causes(robot, fit.state.mdh, len(files)):
        tried.append((*test.along(direction), file, kind, place, unit_name))
    tried.sort(key=lambda one: -one[0])
    gain, by, file, kind, place, unit_name = tried[0]
    p_whole = test.p_value(test.statistic, test.count)
    p_cause = min(test.p_value(gain, 1) * len(tried), 1.0)
    p = min(2.0 * min(p_whole, p_cause), 1.0)
    if p > MAX_P:
        return ()
    names = [labels[file], *(name for i, name in enumerate(labels) if i != file)]
    rest = test.p_value(max(test.statistic - gain, 0.0), test.count - 1)
    alone = all(
        gain - other[0] > MIN_LEAD
        or test.p_value(max(test.statistic - other[0], 0.0), test.count - 1) < MIN_P_OF_REST
        for other in tried[1:]
    )
    if rest < MIN_P_OF_REST or not alone:
        return (Contradiction(tuple(names), p),)
    cause = Cause(kind, place or names[0], by, unit_name)
    return (Contradiction(tuple(names), p, cause),)



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
            trains[name] = Points(points.take(rows))
    if len(trains) < 2:
        return ()
    try:
        fit = fit_instruments(robot, trains, RelativeOptions(), silent)
    except DataError:  # too few points for a fit of all
        return ()
    return find_contradictions(robot, fit)
