"""New measurements of a calibrated arm as rows of a linear problem, in units of their noise.

The new errors e of a calibrated arm are J_n x + J_k u + noise.  x is open: where the instrument
stands now, where the reflectors sit, and what has moved.  u is what the calibration did not know
and what its model lacks; the noise is that of its instrument and joints [evidence.noise].
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from minimax_cal.fitting.fit import Fit
from minimax_cal.fitting.uncertainty import Estimator, Poses
from minimax_cal.ground.arrays import Array
from minimax_cal.judging.watching.old import Old, noise_root, own_poses
from minimax_cal.judging.watching.placing import Rows
from minimax_cal.measuring.measurements import Measurements
from minimax_cal.modelling.cell import Cell, still
from minimax_cal.modelling.effects.table import names_of
from minimax_cal.modelling.joint_fit import extended
from minimax_cal.modelling.model import Model, model_of
from minimax_cal.modelling.near import nearby
from minimax_cal.modelling.parameters import Names, State, zero_positions
from minimax_cal.modelling.start import fit_base

PLACINGS = 3  # passes that place an arm with effects


@dataclass(frozen=True, eq=False)
class Watched:
    """New measurements of a calibrated arm, and what of it is open.

    cell: as calibrated, with the targets of the data.  known: (p_old, r) root of the calibration's
    covariance, p_old its parameters by `names_old`.  variance: of its noise [m^2].
    fit: the calibration.
    frame, tool: whether the instrument stands, and the reflectors sit, where they did.
    foot: (f, 3) reflectors of the foot in the base as calibrated, and foot_now: as seen now [m];
    foot_variance: of a coordinate of their difference [m^2].
    """

    cell: Cell
    data: Measurements
    known: Array
    names_old: Names
    variance: float
    fit: Fit
    frame: bool
    tool: bool
    foot: Array
    foot_now: Array
    foot_variance: float

    @cached_property
    def names(self) -> Names:
        """Of all parameters now."""
        robot, targets = self.cell.robot, self.cell.target_names
        scene = self.cell.scene(still(np.zeros((1, robot.joints)), targets, robot))
        return Names.of(robot, targets, names_of(self.cell.effects.terms, scene)[0])

    @cached_property
    def old(self) -> Old | None:
        """Its own poses, None where its file has none; looked at when they are first asked for."""
        return own_poses(self.fit)

    @property
    def jitter(self) -> float:
        """Noise of the joints [rad]."""
        return self.old.jitter if self.old else self.fit.uncertainty.noise.jitter

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

    @cached_property
    def held(self) -> Array:
        """(p, l) the same of what the calibration's own poses do not tell; all without them."""
        if self.old is None:
            return self.root
        kept = np.array(self.names_old.all)[self.old.kept]
        some = np.isin(self.names.all, kept)
        return np.where(some[:, None], self.root, 0.0)[:, : self.old.latent.shape[2]]

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

    def rows(self, active: Array, state: State) -> Rows:
        """The errors linear about the best fit with some parameters free, by their noises."""
        model, state = self.fitted(active, state)
        every = model.only(np.ones(model.names.count, dtype=bool))
        poses = Poses(Estimator(every, np.ones(len(model.y))), state)
        m, r, p = poses.jacobian.shape
        half = noise_root(poses, self.variance, self.jitter)
        whole = [poses.error[..., None], poses.jacobian, poses.arm]
        white = np.linalg.solve(half, np.concatenate(whole, axis=2))
        error = white[..., 0].reshape(-1)
        jacobian = white[..., 1 : 1 + p].reshape(m * r, p)
        latent = -jacobian @ self.root
        row = np.repeat(np.arange(m), r)
        if len(self.foot):
            more, columns = self.of_foot(state)
            base = self.base
            error = np.concatenate([error, more])
            latent = np.concatenate([latent, columns[:, base] @ self.known[base]])
            jacobian = np.concatenate([jacobian, columns])
            row = np.concatenate([row, np.full(len(more), -1)])
        count = 3 * int(model.counts.sum()) + 3 * len(self.foot)
        arm = white[..., 1 + p :]
        return Rows(error, jacobian, latent, active, state, count, row, half, arm)

    @property
    def base(self) -> slice:
        """The parameters of the base, in the calibration as now."""
        n = self.cell.robot.joints
        return slice(5 * n, 5 * n + 6)

    def of_foot(self, state: State) -> tuple[Array, Array]:
        """What the reflectors on the foot say of the base, in units of their noise: errors, slope.

        Each is a mean of then and a mean of now.
        """
        n, f = self.cell.robot.joints, len(self.foot)
        # How far the foot's reflectors are from where they were.
        off = (self.foot_now - state.origin) @ state.rotation - self.foot
        error = np.asarray(off.reshape(-1) / np.sqrt(self.foot_variance))
        slope = np.zeros((f, 3, self.names.count))
        slope[..., 5 * n : 5 * n + 3] = np.eye(3)
        turned = np.cross(np.eye(3)[None], self.foot[:, None])  # (f, turn, 3)
        slope[..., 5 * n + 3 : 5 * n + 6] = np.swapaxes(turned, 1, 2)
        return error, slope.reshape(3 * f, -1) / np.sqrt(self.foot_variance)
