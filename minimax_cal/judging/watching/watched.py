"""New measurements of a calibrated arm as rows of a linear problem, in units of their noise.

The new errors e of a calibrated arm are J_n x + J_k u + noise.  x is open: where the instrument
stands now, where the reflectors sit, and what has moved.  u is what the calibration did not know,
with its covariance; the noise is that of its instrument and joints [evidence.noise].
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from minimax_cal.evidence.noise import orthonormal
from minimax_cal.fitting.start import fit_base
from minimax_cal.fitting.uncertainty import Estimator, Poses
from minimax_cal.ground.arrays import Array
from minimax_cal.measuring.measurements import Measurements
from minimax_cal.modelling.cell import Cell, still
from minimax_cal.modelling.effects.table import names_of
from minimax_cal.modelling.joint_fit import extended
from minimax_cal.modelling.model import Model, model_of
from minimax_cal.modelling.near import nearby
from minimax_cal.modelling.parameters import Names, State, zero_positions
from minimax_cal.solvers.least_squares import solve_normal

PLENTY = 500  # poses that tell what more would
SAMPLES = 200  # of the calibration's own poses, as many at a time as are new
TINY = 1e-300  # in place of a zero
PLACINGS = 3  # passes that place an arm with effects


@dataclass(frozen=True, eq=False)
class Watched:
    """New measurements of a calibrated arm, and what of it is open.

    cell: as calibrated, with the targets of the data.  known: (p_old, r) root of the calibration's
    covariance, p_old its parameters by `names_old`.  variance, jitter: of its noise [m^2, rad].
    left: mean square of a coordinate that its fit left [m^2].
    frame, tool: whether the instrument stands, and the reflectors sit, where they did.
    foot: (f, 3) reflectors of the foot in the base as calibrated, and foot_now: as seen now [m].
    """

    cell: Cell
    data: Measurements
    known: Array
    names_old: Names
    variance: float
    jitter: float
    left: float
    frame: bool
    tool: bool
    foot: Array
    foot_now: Array

    @cached_property
    def names(self) -> Names:
        """Of all parameters now."""
        robot, targets = self.cell.robot, self.cell.target_names
        scene = self.cell.scene(still(np.zeros((1, robot.joints)), targets, robot))
        return Names(robot.joints, targets, names_of(self.cell.effects.terms, scene)[0])

    @cached_property
    def open(self) -> Array:
        """(p,) True for base and targets that are not known from the calibration."""
        names, n = self.names, self.cell.robot.joints
        place = np.arange(names.count)
        base = (place >= 5 * n) & (place < 5 * n + 6)
        spots = (place >= 5 * n + 6) & (place < names.geometric)
        return np.asarray((base & (not self.frame)) | (spots & (not self.tool)))

    @cached_property
    def root(self) -> Array:
        """(p, r) of what is kept: rows of what is open are zero."""
        old = {name: row for row, name in enumerate(self.names_old.all)}
        rows = np.array([old.get(name, -1) for name in self.names.all])
        kept = np.where((rows >= 0)[:, None], self.known[rows], 0.0)
        return np.where(self.open[:, None], 0.0, kept)

    @property
    def zeros(self) -> Array:
        """(n,) the parameters that say where each joint's zero is."""
        return zero_positions(self.cell.robot.prismatic)

    @cached_property
    def start(self) -> tuple[Model, State]:
        """The arm as calibrated, where it fits the data best."""
        state = self.cell.state
        if not self.frame:
            found = fit_base(model_of(self.cell.robot, self.data), self.cell.robot.mdh).state
            state = replace(state, rotation=found.rotation, origin=found.origin)
            if not self.tool:
                state = replace(state, target_positions=found.target_positions)
        return self.fitted(self.open, state)

    def fitted(self, active: Array, state: State) -> tuple[Model, State]:
        """Least squares over some parameters from a state that is near, and the model there."""
        terms, robot = self.cell.effects.terms, self.cell.robot
        plain = model_of(robot, self.data)
        for _ in range(PLACINGS if terms else 1):
            model = plain
            if terms:
                model, state = extended(plain, robot, self.data, state, terms)
            model = model.only(active)
            if active.any():
                state = nearby(model, state).x.take(np.array(0))
        return model, state

    def both(self, active: Array, state: State) -> Both:
        """The errors linear about the best fit with some parameters free, weighed either way."""
        return Both(*(self.rows(active, state, alike=alike) for alike in (False, True)))

    def rows(self, active: Array, state: State, *, alike: bool = False) -> Rows:
        """The same by the noises, or with every coordinate alike, as the fit left them."""
        model, state = self.fitted(active, state)
        every = model.only(np.ones(model.names.count, dtype=bool))
        poses = Poses.of(Estimator(every, np.ones(len(model.y))), state)
        m, r, p = poses.jacobian.shape
        wide = self.jitter**2 * poses.arm @ np.swapaxes(poses.arm, 1, 2)
        noise = wide + self.variance * np.eye(r)
        half = np.linalg.cholesky(
            np.broadcast_to(self.left * np.eye(r), noise.shape) if alike else noise
        )
        whole = np.concatenate([poses.error[..., None], poses.jacobian], axis=2)
        white = np.linalg.solve(half, whole).reshape(m * r, p + 1)
        jacobian = white[:, 1:]
        error, latent = white[:, 0], -jacobian @ self.root
        row = np.repeat(np.arange(m), r)
        if len(self.foot):
            more, columns = self.of_foot(state)
            n = self.cell.robot.joints
            past = self.known[5 * n : 5 * n + 6]
            error = np.concatenate([error, more])
            latent = np.concatenate([latent, columns[:, 5 * n : 5 * n + 6] @ past])
            jacobian = np.concatenate([jacobian, columns])
            row = np.concatenate([row, np.full(len(more), -1)])
        count = 3 * int(model.counts.sum()) + 3 * len(self.foot)
        return Rows(error, jacobian, latent, active, state, count, row, half)

    def of_foot(self, state: State) -> tuple[Array, Array]:
        """What the reflectors on the foot say of the base, in units of their noise: errors, slope.

        Each was seen once by then and once by now.
        """
        n, f = self.cell.robot.joints, len(self.foot)
        error = self.foot_error(self.foot_now, state)
        slope = np.zeros((f, 3, self.names.count))
        slope[..., 5 * n : 5 * n + 3] = np.eye(3)
        turned = np.cross(np.eye(3)[None], self.foot[:, None])  # (f, turn, 3)
        slope[..., 5 * n + 3 : 5 * n + 6] = np.swapaxes(turned, 1, 2)
        return error, slope.reshape(3 * f, -1) / np.sqrt(2.0 * self.variance)

    def foot_error(self, place: Array, state: State) -> Array:
        """(..., 3f) how far the foot's reflectors (..., f, 3) are from where they were, as rows."""
        off = (place - state.origin) @ state.rotation - self.foot
        return np.asarray(off.reshape(*off.shape[:-2], -1) / np.sqrt(2.0 * self.variance))


@dataclass(frozen=True, eq=False)
class Rows:
    """New errors in units of their noise, linear in all parameters.

    error: (N,).  jacobian: (N, p).  latent: (N, r) by what the calibration did not know, each of
    variance 1.  active: (p,) what is free.  state: about which.  count: coordinates that were
    measured.  pose: (N,) number of each row's pose, -1 for the foot, last.  half: (m, r, r) root of
    each pose's noise [m].
    """

    error: Array
    jacobian: Array
    latent: Array
    active: Array
    state: State
    count: int
    pose: Array
    half: Array

    @cached_property
    def whole(self) -> Array:
        """(N + r, free + r) columns of what is free and of what was not known, with its prior."""
        r = self.latent.shape[1]
        free = self.jacobian[:, self.active]
        return np.block([[free, self.latent], [np.zeros((r, free.shape[1])), np.eye(r)]])

    @cached_property
    def basis(self) -> Array:
        """(N + r, q) orthonormal span of `whole`."""
        return orthonormal(self.whole)

    @cached_property
    def left(self) -> Array:
        """(N + r,) what they leave of the error."""
        error = np.pad(self.error, (0, self.latent.shape[1]))
        return np.asarray(error - self.basis @ (self.basis.T @ error))

    @property
    def foot(self) -> int:
        """Coordinates of the foot."""
        return int(np.count_nonzero(self.pose < 0))

    @property
    def dof(self) -> int:
        """Degrees of freedom of what is left."""
        return max(self.count - int(self.basis.shape[1] - self.latent.shape[1]), 1)

    @property
    def mean_square(self) -> float:
        """Of what is left, in units of the noise."""
        return float(self.left @ self.left) / self.dof

    @property
    def scale(self) -> float:
        """By how much the noise is larger than it was, at least 1."""
        return float(np.sqrt(max(self.mean_square, 1.0)))

    def apart(self, columns: Array, basis: Array) -> Array:
        """(N + r, c) what of some parameters' motion a basis does not hold."""
        motion = np.pad(self.jacobian[:, columns], ((0, self.latent.shape[1]), (0, 0)))
        rest = motion - basis @ (basis.T @ motion)
        return np.asarray(rest - basis @ (basis.T @ rest))  # twice is enough

    def columns(self, more: Array) -> Array:
        """(N, q) what is free, what was not known, and some more parameters."""
        return np.hstack([self.jacobian[:, self.active], self.latent, self.jacobian[:, more]])

    def by_pose(self, columns: Array, most: int = PLENTY) -> tuple[Array, Array]:
        """Products of each pose's rows: (m, q, q), and its coordinates: (m,).

        q: what is free, what was not known, some more parameters, and the error last.  most: of
        more poses so many are taken, evenly.
        """
        every = np.concatenate([self.columns(columns), self.error[:, None]], axis=1)
        poses = np.unique(self.pose[self.pose >= 0])
        poses = poses[np.linspace(0, len(poses) - 1, min(len(poses), most)).astype(int)]
        parts = [every[self.pose == pose] for pose in poses]
        seen = [int(np.count_nonzero(part.any(axis=1))) for part in parts]
        return np.array([part.T @ part for part in parts]), np.array(seen, dtype=float)

    def share(self, columns: Array, held: Array) -> Array:
        """(c,) share of each motion that other parameters, (p,) True in held, do not imitate."""
        size = (self.jacobian[:, columns] ** 2).sum(axis=0)
        rest = size
        if held.any():
            basis = orthonormal(self.jacobian[:, held])
            off = self.jacobian[:, columns] - basis @ (basis.T @ self.jacobian[:, columns])
            rest = (off**2).sum(axis=0)
        return np.asarray(rest / np.where(size > 0.0, size, np.inf))

    def sizes(self, columns: Array) -> Array:
        """(c,) how large each score is, in sigmas, by the noise that the others leave."""
        by, sigma = self.scores(columns)
        square = np.nan_to_num((by / sigma * self.scale) ** 2)
        dof = max(self.dof - 1, 1)  # what is explained is no noise
        noise = np.maximum((self.dof * self.mean_square - square) / dof, 1.0)
        return np.asarray(np.sqrt(square / noise))

    def sigmas(self, columns: Array) -> Array:
        """(c,) of each parameter's change if the noise is what it was [SI]."""
        return replace(self, error=np.zeros_like(self.error)).scores(columns)[1]

    def scores(self, columns: Array) -> tuple[Array, Array]:
        """Each parameter's change if it alone moved besides, and its sigma: (c,) each [SI]."""
        rest = self.apart(columns, self.basis)
        size = (rest**2).sum(axis=0)
        size = np.where(size > 0.0, size, np.nan)
        return rest.T @ self.left / size, self.scale / np.sqrt(size)


@dataclass(frozen=True, eq=False)
class Both:
    """The same errors by the noises that the calibration found, and with all coordinates alike.

    The first tell most where noises are all there is; the second where the model lacks something in
    directions in which nothing is noisy.
    """

    noise: Rows
    alike: Rows


@dataclass(frozen=True, eq=False)
class Own:
    """The calibration's own poses, as new ones would be seen.

    rows: about the calibration itself.  foot: (m, 3f) errors of the reflectors on the foot at each
    pose, in units of noise, NaN where unseen.
    """

    rows: Both
    foot: Array

    @cached_property
    def single(self) -> Array:
        """(2,) share of the coordinates that so many independent ones would be [Box 1954].

        Points of a pose err together: (tr C)^2 / tr C^2 of the covariance C of a pose's errors,
        without bias from the number of poses.
        """
        return np.array([self.single_of(rows) for rows in (self.rows.noise, self.rows.alike)])

    @staticmethod
    def single_of(rows: Rows) -> float:
        """Of rows weighed one way."""
        m, r, _ = rows.half.shape
        error = rows.error[: m * r].reshape(m, r)
        square = (error**2).sum(axis=1)
        pairs = float(((error.T @ error) ** 2).sum() - (square**2).sum()) / (m * (m - 1))
        many = float(square.mean()) ** 2 / max(pairs, TINY)
        return float(min(many * m / (rows.count - rows.foot), 1.0))

    def spread(self, columns: Array, poses: int, seed: int) -> Array:
        """(2, c) by how much scores spread more than noises say, in samples of so many poses."""
        return np.array(
            [
                self.spread_of(rows, columns, poses, np.random.default_rng(seed))
                for rows in (self.rows.noise, self.rows.alike)
            ]
        )

    def spread_of(self, rows: Rows, columns: Array, poses: int, rng: np.random.Generator) -> Array:
        """(c,) of rows weighed one way."""
        whole, counts = self.samples(rows, columns, poses, rng)
        c, free = len(columns), int(rows.active.sum())
        q = whole.shape[-1] - c - 1  # what is free, and what was not known
        kept, rest = whole[:, :q, :q], whole[:, :q, q:]
        left = whole[:, q:, q:] - np.swapaxes(rest, 1, 2) @ solve_normal(kept, rest)
        score, size = left[:, :c, c], np.einsum("dcc->dc", left)[:, :c]
        dof = np.maximum(counts - free - 1.0, 1.0)[:, None]
        square = score**2 / np.where(size > 0.0, size, np.inf)
        noise = np.maximum((left[:, c, c, None] - square) / dof, 1.0)
        return np.asarray(np.maximum(np.sqrt((square / noise).mean(axis=0)), 1.0))

    def samples(
        self, rows: Rows, columns: Array, poses: int, rng: np.random.Generator
    ) -> tuple[Array, Array]:
        """Products as of `Rows.by_pose`: (s, q, q), and coordinates: (s,), of samples.

        The prior of what was not known is among them, and the foot as these poses see it.
        """
        gram, counts = rows.by_pose(columns)
        drawn = np.zeros((SAMPLES, len(gram)))
        for row in drawn:
            row[rng.permutation(len(gram))[: min(poses, len(gram) // 2)]] = 1.0
        whole = np.tensordot(drawn, gram, 1)
        free = int(rows.active.sum())
        prior = np.arange(free, free + rows.latent.shape[1])
        whole[:, prior, prior] += 1.0
        seen = np.isfinite(self.foot)
        error = drawn @ np.where(seen, self.foot, 0.0) / np.maximum(drawn @ seen, 1.0)
        slope = rows.columns(columns)[rows.pose < 0]
        slopes = np.broadcast_to(slope, (SAMPLES, *slope.shape))
        foot = np.concatenate([slopes, error[..., None]], axis=2)
        return whole + np.swapaxes(foot, 1, 2) @ foot, drawn @ counts + rows.foot
