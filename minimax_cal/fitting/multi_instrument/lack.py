"""What an arm does that no link holds, as several instruments see it.

Gears, bending and cables turn the joints by functions of the pose
(`modelling.rows.lack_of_fit_motions_by_pose`), the same ones in all files.  Each file's rows are
linear where the joint fit ended; how large the functions are, and how noisy each file is,
restricted maximum likelihood says.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from minimax_cal.core.arrays import Array
from minimax_cal.fitting.identification import DEFAULT_RESOLUTION
from minimax_cal.fitting.multi_instrument.instrument_fit import InstrumentFit, LackOfFit
from minimax_cal.fitting.multi_instrument.instrument_stack import InstrumentBlock
from minimax_cal.fitting.robust_fit import SQUARE_LOSS
from minimax_cal.instruments.protocol import slopes_by_arm_parameters
from minimax_cal.modelling.error_rows import lack_of_fit_motions_by_pose
from minimax_cal.modelling.parameters import ParameterValues, joint_zero_indices
from minimax_cal.robots.robot import Robot
from minimax_cal.selection.noise_model import fit_variance_components, orthonormal_basis
from minimax_cal.solvers.least_squares import solve_normal_equations

ROUNDS, INNER_ROUNDS = 6, 10  # in which noises, and functions of the pose, are weighed
MIN_VARIANCE = 1e-18  # of a row [m^2]
SAME_FUNCTION = 0.95  # of a motion that a law makes: it is that law
MIN_GAIN = 10.0  # in twice the log likelihood, of a lack that the rows show


@dataclass(frozen=True, eq=False)
class FileRows:
    """The rows of one file, linear where the joint fit ended.

    error: (r,) [m].  shared: (p, r) slopes by all parameters that were fitted, zero for those of
    other files.  links: (5n + 1, r) by every link, and by a delay of what was measured.  lack:
    (c, r) by the factors of functions of the pose.  degrees: independent numbers.
    """

    error: Array
    shared: Array
    links: Array
    lack: Array
    degrees: int

    @cached_property
    def span(self) -> Array:
        """(r, b) orthonormal, what links of its own take: as its rows tell
        (`DEFAULT_RESOLUTION`).
        """
        slopes = np.concatenate([self.shared, self.links]).T
        norm = np.linalg.norm(slopes, axis=0)
        span, size, _ = np.linalg.svd(slopes[:, norm > 0.0] / norm[norm > 0.0], full_matrices=False)
        return np.asarray(span[:, size > DEFAULT_RESOLUTION * size[0]])

    @cached_property
    def alone(self) -> RowsLeft:
        """What links of its own leave."""
        return RowsLeft.of(self, self.span)


@dataclass(frozen=True, eq=False)
class RowsLeft:
    """Error (r,) and lack (c, r) of a file without what a fit takes; degrees beyond the fit."""

    error: Array
    lack: Array
    degrees: float

    @staticmethod
    def of(file: FileRows, basis: Array) -> RowsLeft:
        """Without an orthonormal basis (r, b)."""
        error = file.error - basis @ (basis.T @ file.error)
        lack = file.lack - (file.lack @ basis) @ basis.T
        return RowsLeft(error, lack, float(file.degrees - basis.shape[1]))


def slopes_by_pose(robot: Robot, block: InstrumentBlock, x: ParameterValues) -> tuple[Array, Array]:
    """(1 + c, r) motion of the rows of a block by a delay [s] and by each factor of the lack.

    And (c, 2) the kind of each factor.  robot: with the links of the state.
    """
    rows, own = block.read_residual_rows(x), len(block.instrument.names)
    moving = np.zeros(5 * robot.joints + x.effects.size - own, dtype=bool)
    zeros = joint_zero_indices(robot.prismatic)
    moving[zeros] = True
    slopes = slopes_by_arm_parameters(block.flange(x, moving), rows)[np.argsort(np.argsort(zeros))]
    lack, kind = lack_of_fit_motions_by_pose(robot, block.arm.q[rows.pose], slopes.T[:, None, :])
    columns, none = block.instrument.at.columns, np.zeros(block.instrument.poses)
    rate = [columns.get(f"rate{j + 1}", none)[rows.pose] for j in range(robot.joints)]
    delay = (robot.sign[:, None] * np.array(rate) * slopes).sum(axis=0)
    both = np.concatenate([delay[None], lack[:, 0].T])
    return rows.eliminate_places_and_add_sums(both, row_weights=block.share)[1], kind


def rows_of_files(robot: Robot, fit: InstrumentFit) -> tuple[list[FileRows], Array]:
    """The rows of each file, and (c,) the group of each factor of the lack."""
    stack, place = fit.stack, np.flatnonzero(fit.problem.active)
    every, out, kind = (
        np.ones(stack.names.parameter_count, dtype=bool),
        [],
        np.zeros((0, 2), dtype=int),
    )
    arm, rows = robot.with_mdh(fit.state.mdh), stack.rows_by_block(fit.state, every)
    for i, (block, (error, slopes)) in enumerate(zip(stack.blocks, rows, strict=True)):
        by_pose_alone, kind = slopes_by_pose(arm, block, stack.state_of_block(fit.state, i))
        root = np.sqrt(np.broadcast_to(block.weight, error.shape))
        links = np.concatenate([slopes[: 5 * robot.joints], by_pose_alone[:1]])
        lack, degrees = by_pose_alone[1:], block.instrument.degrees_of_freedom
        out.append(FileRows(root * error, root * slopes[place], root * links, root * lack, degrees))
    return out, kind[:, 0] * (int(kind[:, 1].max(initial=0)) + 1) + kind[:, 1]


@dataclass(frozen=True, eq=False)
class Components:
    """noise: (b,) variance of a row of each file [m^2].  lack: (c,) of each factor; moment: (c, c)
    mean of the factors' products, given the rows.  gain: in twice the log likelihood by the lack.
    """

    noise: Array
    lack: Array
    moment: Array
    gain: float

    def if_shown(self, left: Sequence[RowsLeft]) -> Components:
        """The same; without any lack where the rows do not show one."""
        if self.gain >= MIN_GAIN:
            return self
        noise = [one.error @ one.error / max(one.degrees, 1.0) for one in left]
        none = 0.0 * self.moment
        return Components(np.maximum(noise, MIN_VARIANCE), 0.0 * self.lack, none, 0.0)


def estimate_components(left: Sequence[RowsLeft], groups: Array) -> Components:
    """Noises and sizes of the lack by restricted maximum likelihood.  groups: (c,)."""
    degrees = [max(one.degrees, 1.0) for one in left]
    pairs = list(zip(left, degrees, strict=True))
    noise = np.array([one.error @ one.error / d + MIN_VARIANCE for one, d in pairs])
    without = sum(d * (np.log(v) + 1.0) for d, v in zip(degrees, noise, strict=True))
    variance = np.ones(int(groups.max(initial=-1)) + 1)
    for _ in range(ROUNDS):
        gram = sum(one.lack @ one.lack.T / v for one, v in zip(left, noise, strict=True))
        gradient = sum(one.lack @ one.error / v for one, v in zip(left, noise, strict=True))
        square = sum(float(one.error @ one.error) / v for one, v in zip(left, noise, strict=True))
        found = fit_variance_components(
            gram, gradient, square, sum(degrees), groups, variance, INNER_ROUNDS, 0.0
        )
        variance = found.variance
        spread = found.second_moment - np.outer(found.mean, found.mean)
        before = noise
        noise = np.array([
            (((one.error - found.mean @ one.lack) ** 2).sum()
             + ((spread @ one.lack) * one.lack).sum()) / d
            for one, d in pairs
        ])  # fmt: skip
        noise = np.maximum(noise, MIN_VARIANCE)
    root = np.sqrt(found.variance[groups])
    inner = np.eye(len(root)) + gram * np.outer(root, root)
    explained = root * gradient @ np.linalg.solve(inner, root * gradient)
    logs = sum(d * np.log(v) for d, v in zip(degrees, before, strict=True))
    beside = logs + square - explained + np.linalg.slogdet(inner)[1]
    return Components(noise, found.variance[groups], found.second_moment, float(without - beside))


# ---- what it does to a fit -----------------------------------------------------------------------


def without_laws(fit: InstrumentFit, files: list[FileRows]) -> list[FileRows]:
    """The rows without those functions of the pose that a law of the fit is itself."""
    laws = np.flatnonzero(fit.problem.active) >= fit.stack.parameter_count_without_laws
    if not laws.any():
        return files
    basis = orthonormal_basis(np.concatenate([one.shared[laws] for one in files], axis=1).T)
    whole = np.concatenate([one.lack for one in files], axis=1)
    inside = ((whole @ basis) ** 2).sum(axis=1) >= SAME_FUNCTION * (whole**2).sum(axis=1)
    return [replace(one, lack=np.where(inside[:, None], 0.0, one.lack)) for one in files]


def with_lack(robot: Robot, fit: InstrumentFit) -> InstrumentFit:
    """The fit, its covariance with what the arm does that no link holds.

    The estimate is off by C sum w J L u, C the inverse normal matrix, J the slopes of the rows, L
    those by the factors u of the lack.  Noises are those that remain beside the lack.
    """
    files, groups = rows_of_files(robot, fit)
    files = without_laws(fit, files)
    problem, unit = fit.problem, float(fit.stack.precision.max())
    weights = fit.stack.precision / unit
    pairs = list(zip(weights, files, strict=True))
    prior = problem.prior / unit
    normal = sum(w * one.shared @ one.shared.T for w, one in pairs) + prior
    cover = solve_normal_equations(normal, np.eye(len(normal)))
    moved = cover @ sum(w * one.shared @ one.lack.T for w, one in pairs)
    left = [
        RowsLeft(
            one.error,
            one.lack - moved.T @ one.shared,
            one.degrees - w * float(((cover @ one.shared) * one.shared).sum()),
        )
        for w, one in pairs
    ]
    found = estimate_components(left, groups).if_shown(left)
    active = np.ix_(problem.active, problem.active)
    covariance = fit.covariance.copy()
    if problem.loss == SQUARE_LOSS and fit.worst is None:
        heavy = np.split(
            fit.stack.row_weights(fit.state), np.cumsum([len(o.error) for o in files])[:-1]
        )
        middle = float((fit.noise**2).min()) * prior
        noise = fit.stack.row_variances(found.noise)  # as given, where it is
        for (w, one), v, h in zip(pairs, noise, heavy, strict=True):
            middle = middle + w**2 * v * (one.shared * h) @ one.shared.T
        covariance[active] = cover @ middle @ cover
    covariance[active] += moved @ found.moment @ moved.T
    every = np.zeros((len(problem.active), moved.shape[1]))
    every[problem.active] = moved
    stiff = with_lack(robot, fit.geometric_fit) if fit.geometric_fit else None
    lack = LackOfFit(every, found.moment)
    return replace(fit, covariance=covariance, lack=lack, geometric_fit=stiff)
