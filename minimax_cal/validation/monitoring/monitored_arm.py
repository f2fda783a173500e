"""New measurements of a calibrated arm as rows of a linear problem, in units of their noise.

The new errors e of a calibrated arm are J_n x + J_k u + noise.  x is open: where the instrument
stands now, where the reflectors sit, and what has moved.  u is what the calibration did not know
and what its model lacks; the noise is that of its instrument and joints [evidence.noise].
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from minimax_cal.core.arrays import Array
from minimax_cal.fitting.fit import Fit
from minimax_cal.fitting.uncertainty import Estimator, PosewiseFit
from minimax_cal.measuring.measurements import Measurements
from minimax_cal.modelling.cell import Cell, build_measurements_at_rest
from minimax_cal.modelling.effects.table import effect_parameter_names_and_units
from minimax_cal.modelling.effects_in_model import ModelAtValues, extend_model_with_effects
from minimax_cal.modelling.global_start import fit_base_and_targets
from minimax_cal.modelling.nearby_fit import fit_within_bounds_from_start
from minimax_cal.modelling.parameters import ParameterNames, ParameterValues, joint_zero_indices
from minimax_cal.modelling.point_model import build_point_model
from minimax_cal.validation.monitoring.calibration_poses import (
    CalibrationPoses,
    build_calibration_poses,
    pose_noise_root,
)
from minimax_cal.validation.monitoring.placing import MonitoredRows

EFFECT_PLACING_PASSES = 3  # passes that place an arm with effects


class FootRows(NamedTuple):
    """Errors of the reflectors on the foot and their slope by the base, by their noise."""

    error: Array
    jacobian: Array


@dataclass(frozen=True, eq=False)
class MonitoredArm:
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
    names_old: ParameterNames
    variance: float
    fit: Fit
    frame: bool
    tool: bool
    foot: Array
    foot_now: Array
    foot_variance: float

    @cached_property
    def names(self) -> ParameterNames:
        """Of all parameters now."""
        robot, targets = self.cell.robot, self.cell.target_names
        scene = self.cell.pose_arm(
            build_measurements_at_rest(np.zeros((1, robot.joints)), targets, robot)
        )
        return ParameterNames.for_robot(
            robot, targets, effect_parameter_names_and_units(self.cell.effects.terms, scene)[0]
        )

    @cached_property
    def calibration_poses(self) -> CalibrationPoses | None:
        """Its own poses, None where its file has none; looked at when they are first asked for."""
        return build_calibration_poses(self.fit)

    @property
    def jitter(self) -> float:
        """Noise of the joints [rad]."""
        return (
            self.calibration_poses.jitter
            if self.calibration_poses
            else self.fit.uncertainty.noise.joint_jitter
        )

    @cached_property
    def is_open(self) -> Array:
        """(p,) True for base and targets that are not known from the calibration."""
        names, n = self.names, self.cell.robot.joints
        place = np.arange(names.parameter_count)
        base = (place >= 5 * n) & (place < 5 * n + 6)
        spots = (place >= 5 * n + 6) & (place < names.geometric_count)
        return np.asarray((base & (not self.frame)) | (spots & (not self.tool)))

    @cached_property
    def kept_covariance_root(self) -> Array:
        """(p, r) of what is kept: rows of what is open are zero."""
        old = {name: row for row, name in enumerate(self.names_old.all_names)}
        rows = np.array([old.get(name, -1) for name in self.names.all_names])
        kept = np.where((rows >= 0)[:, None], self.known[rows], 0.0)
        return np.where(self.is_open[:, None], 0.0, kept)

    @cached_property
    def unmeasured_covariance_root(self) -> Array:
        """(p, l) the same of what the calibration's own poses do not tell; all without them."""
        if self.calibration_poses is None:
            return self.kept_covariance_root
        kept = np.array(self.names_old.all_names)[self.calibration_poses.kept]
        some = np.isin(self.names.all_names, kept)
        return np.where(some[:, None], self.kept_covariance_root, 0.0)[
            :, : self.calibration_poses.latent.shape[2]
        ]

    @property
    def zero_parameters(self) -> Array:
        """(n,) the parameters that say where each joint's zero is."""
        return joint_zero_indices(self.cell.robot.prismatic)

    @cached_property
    def placed_start(self) -> ModelAtValues:
        """The arm as calibrated, where it fits the data best."""
        state = self.cell.parameter_values
        if not self.frame:
            found = fit_base_and_targets(
                build_point_model(self.cell.robot, self.data), self.cell.robot.mdh
            ).state
            state = replace(state, rotation=found.rotation, origin=found.origin)
            if not self.tool:
                state = replace(state, target_positions=found.target_positions)
        return self.fit_parameters_from(self.is_open, state)

    def fit_parameters_from(self, active: Array, state: ParameterValues) -> ModelAtValues:
        """Least squares over some parameters from a state that is near, and the model there."""
        terms, robot = self.cell.effects.terms, self.cell.robot
        plain = build_point_model(robot, self.data)
        for _ in range(EFFECT_PLACING_PASSES if terms else 1):
            model = plain
            if terms:
                model, state = extend_model_with_effects(plain, robot, self.data, state, terms)
            model = model.with_active(active)
            if active.any():
                state = fit_within_bounds_from_start(model, state).x.take(np.array(0))
        return ModelAtValues(model, state)

    def build_rows(self, active: Array, state: ParameterValues) -> MonitoredRows:
        """The errors linear about the best fit with some parameters free, by their noises."""
        model, state = self.fit_parameters_from(active, state)
        every = model.with_active(np.ones(model.names.parameter_count, dtype=bool))
        poses = PosewiseFit(Estimator(every, np.ones(len(model.y))), state)
        m, r, p = poses.jacobian.shape
        half = pose_noise_root(poses, self.variance, self.jitter)
        whole = [poses.error[..., None], poses.jacobian, poses.joint_motion]
        white = np.linalg.solve(half, np.concatenate(whole, axis=2))
        error = white[..., 0].reshape(-1)
        jacobian = white[..., 1 : 1 + p].reshape(m * r, p)
        latent = -jacobian @ self.kept_covariance_root
        row = np.repeat(np.arange(m), r)
        if len(self.foot):
            more, columns = self.foot_rows(state)
            base = self.base
            error = np.concatenate([error, more])
            latent = np.concatenate([latent, columns[:, base] @ self.known[base]])
            jacobian = np.concatenate([jacobian, columns])
            row = np.concatenate([row, np.full(len(more), -1)])
        count = 3 * int(model.pose_counts_by_target.sum()) + 3 * len(self.foot)
        arm = white[..., 1 + p :]
        return MonitoredRows(error, jacobian, latent, active, state, count, row, half, arm)

    @property
    def base(self) -> slice:
        """The parameters of the base, in the calibration as now."""
        n = self.cell.robot.joints
        return slice(5 * n, 5 * n + 6)

    def foot_rows(self, state: ParameterValues) -> FootRows:
        """What the reflectors on the foot say of the base, in units of their noise: errors, slope.

        Each is a mean of then and a mean of now.
        """
        n, f = self.cell.robot.joints, len(self.foot)
        # How far the foot's reflectors are from where they were.
        off = (self.foot_now - state.origin) @ state.rotation - self.foot
        error = np.asarray(off.reshape(-1) / np.sqrt(self.foot_variance))
        slope = np.zeros((f, 3, self.names.parameter_count))
        slope[..., 5 * n : 5 * n + 3] = np.eye(3)
        turned = np.cross(np.eye(3)[None], self.foot[:, None])  # (f, turn, 3)
        slope[..., 5 * n + 3 : 5 * n + 6] = np.swapaxes(turned, 1, 2)
        return FootRows(error, slope.reshape(3 * f, -1) / np.sqrt(self.foot_variance))
