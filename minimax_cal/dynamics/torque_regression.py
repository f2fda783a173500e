"""Columns of joint torque: rigid body, usual friction, laws; their fits and the search among them.

Laws are sought by the same evidence as for positions, on whitened rows.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import NamedTuple

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from minimax_cal.core.arrays import Array
from minimax_cal.core.linear_algebra import project_out
from minimax_cal.dynamics.laws import TorqueTerm
from minimax_cal.dynamics.torque_rows import (
    ArmMotion,
    AutoregressiveWhitening,
    TorqueArm,
    compute_soft_speed_sign,
    estimate_autoregressive_whitening,
)
from minimax_cal.selection.candidate_library import LawColumns
from minimax_cal.selection.noise_model import LinearProblem, Noise, orthonormal_basis

RELATIVE_TORQUE_RIDGE = (
    1e-10  # of the squares of a column: keeps a fit of columns alike from running away
)
SIGN_CHANGE_SPEED_SHARES = np.geomspace(0.005, 0.1, 9)  # of a joint's largest speed
SIGN_CHANGE_SPEED_REFINEMENTS = np.geomspace(
    0.7, 1.4, 9
)  # of the best of these: a second, finer look
MIN_SIGN_CHANGE_GAIN = (
    0.15  # of the square of the remaining error that a softer friction must close
)
RIGID_BODY_GROUP, USUAL_FRICTION_GROUP = "rigid", "usual"  # parts of a fit beside the laws


class TermRows(NamedTuple):
    """The joints (k,) whose rows a law adds to, and what it adds (k, R, d)."""

    joint_indices: Array
    rows: Array


@dataclass(frozen=True, eq=False)
class TorqueColumns:
    """Filtered columns of a scene, each law's computed once.

    rows_by_term: by the text of a term, its joints (k,) and its rows (k, R, d).
    """

    scene: ArmMotion
    rows_by_term: dict[str, TermRows] = field(default_factory=dict)

    def build_term_rows(self, term: TorqueTerm) -> TermRows:
        """The joints (k,) whose rows a law adds to, and what it adds (k, R, d)."""
        if term.text not in self.rows_by_term:
            rows = self.scene.logs.filter_to_rows(term.build_columns(self.scene))
            whole = rows.ndim == 3
            joints = (
                np.arange(self.scene.logs.joint_count) if whole else np.array([term.joint_index])
            )
            by_joint = np.moveaxis(rows, 1, 0) if whole else rows[None]
            self.rows_by_term[term.text] = TermRows(joints, by_joint)
        return self.rows_by_term[term.text]

    @cached_property
    def rigid_body_columns(self) -> Array:
        """(n, R, p) of the rigid body; of each joint for itself where they share no parameters."""
        base = np.moveaxis(self.scene.base_parameter_rows, 1, 0)
        return (
            base
            if self.scene.arm.has_shared_inertial_parameters
            else build_block_diagonal_columns(base)
        )

    @cached_property
    def usual_friction_columns(self) -> Array:
        """(n, R, 2 n) Coulomb and viscous friction of every joint."""
        qd = self.scene.logs.motion.qd
        both = self.scene.logs.filter_to_rows(np.stack([self.scene.speed_sign, qd], axis=-1))
        return build_block_diagonal_columns(np.moveaxis(both, 1, 0))

    @cached_property
    def link_parameter_columns(self) -> Array:
        """(n, R, 10 n) of the inertial parameters of all links."""
        return np.moveaxis(self.scene.logs.filter_to_rows(self.scene.regressor), 1, 0)

    def build_design_matrix(self, terms: Sequence[TorqueTerm] = ()) -> Array:
        """(n, R, p) rigid body, usual friction and some laws: the columns of every fit."""
        parts = [self.rigid_body_columns, self.usual_friction_columns]
        for term in terms:
            joints, rows = self.build_term_rows(term)
            part = np.zeros((self.scene.logs.joint_count, *rows.shape[1:]))
            part[joints] = rows
            parts.append(part)
        return np.concatenate(parts, axis=2)

    @cached_property
    def torques_to_explain(self) -> Array:
        """(n, R) torques less those of what the flange is known to carry."""
        known = self.scene.logs.filter_to_rows(self.scene.known_payload_torque)
        return (self.scene.logs.row_torques - known).T

    def build_design_matrix_of_one_variant_each(self, terms: Sequence[TorqueTerm]) -> Array:
        """(n, R, p) rigid body, usual friction, a variant of every law, and all that runs carry."""
        first = {t.text if t.effect == "payload" else t.key: t for t in reversed(terms)}
        return self.build_design_matrix(list(first.values()))

    def fit_sign_change_speeds(self, terms: Sequence[TorqueTerm]) -> Array:
        """(n,) speeds over which friction changes its sign; as they are where that is soft enough.

        Simulators make it soft, and gears with much play.  A friction that is softer than it is
        drawn to be looks like a force without a law; one column beside all that is named says so.
        terms: what is named.
        """
        arm, logs = self.scene.arm, self.scene.logs
        soft, design = arm.soft.copy(), self.build_design_matrix(terms)
        for j in range(logs.joint_count):
            rows, qd = logs.fitted_row_mask_by_joint[:, j], logs.motion.qd[:, j, None]
            beside = design[j, rows]
            if np.count_nonzero(rows) < 2 * beside.shape[1]:
                continue
            beside[:, self.rigid_body_columns.shape[2] + 2 * j] = (
                0.0  # the Coulomb friction of this joint
            )
            basis = orthonormal_basis(beside)
            left = project_out(self.torques_to_explain[j, rows], basis)
            as_it_is = np.array([arm.soft[j]])
            rough = arm.fastest[j] * SIGN_CHANGE_SPEED_SHARES
            remaining, speeds = [], [as_it_is, rough]
            for number in range(3):  # as it is, softer, and finer about the best of these
                sense = logs.filter_to_rows(compute_soft_speed_sign(qd, speeds[number]))[rows]
                sense = project_out(sense, basis)
                size = np.maximum((sense**2).sum(axis=0), 1e-300)
                remaining.append(float(left @ left) - (left @ sense) ** 2 / size)
                if number == 1:
                    speeds.append(rough[np.argmin(remaining[1])] * SIGN_CHANGE_SPEED_REFINEMENTS)
            if remaining[2].min() < (1.0 - MIN_SIGN_CHANGE_GAIN) * remaining[0][0]:
                soft[j] = max(soft[j], speeds[2][np.argmin(remaining[2])])
        return soft

    def estimate_whitening(self, terms: Sequence[TorqueTerm]) -> AutoregressiveWhitening:
        """By what a fit of one variant of every law leaves: noise, were one of them true."""
        kept = self.scene.logs.fitted_row_mask_by_joint.T
        matrix, error = (
            self.build_design_matrix_of_one_variant_each(terms)[kept],
            self.torques_to_explain[kept],
        )
        return estimate_autoregressive_whitening(
            self.scene.logs, error - matrix @ solve_ridge_least_squares(matrix, error)
        )


def build_block_diagonal_columns(columns_by_joint: Array) -> Array:
    """(n, R, n d) columns (n, R, d) of each joint for itself."""
    n, count, d = columns_by_joint.shape
    out = np.zeros((n, count, n, d))
    out[range(n), :, range(n)] = columns_by_joint
    return out.reshape(n, count, n * d)


def solve_ridge_normal_equations(
    gram: Array, gradient: Array, relative_ridge: float = RELATIVE_TORQUE_RIDGE
) -> Array:
    """(p,) least squares by products (p, p) and (p,); columns alike share what they explain.

    relative_ridge: of the products with a unit diagonal.
    """
    scale = np.sqrt(np.maximum(np.diag(gram), 1e-300))
    unit = gram / np.outer(scale, scale) + relative_ridge * np.eye(len(gram))
    return np.asarray(np.linalg.solve(unit, gradient / scale) / scale)


def solve_ridge_least_squares(columns: Array, target: Array) -> Array:
    """(p,) values of columns (N, p), those alike sharing what they explain."""
    scale = np.maximum(np.linalg.norm(columns, axis=0), 1e-300)
    unit = columns / scale
    gram = unit.T @ unit + RELATIVE_TORQUE_RIDGE * np.eye(unit.shape[1])
    return np.asarray(np.linalg.solve(gram, unit.T @ target) / scale)


@dataclass(frozen=True, eq=False)
class TorqueDictionary:
    """The laws of torque as a dictionary, for whitened rows.

    rms_torque_by_joint: (n,) RMS torque of each joint, by which parameters are usual.
    """

    problem: LinearProblem
    columns: TorqueColumns
    whitening: AutoregressiveWhitening
    rms_torque_by_joint: Array

    @staticmethod
    def build(columns: TorqueColumns, whitening: AutoregressiveWhitening) -> TorqueDictionary:
        """Of whitened rows, rigid body and usual friction projected out."""
        logs, error = (
            columns.scene.logs,
            whitening.whiten_rows(columns.torques_to_explain[whitening.is_row_fitted]),
        )
        problem = LinearProblem(
            error=error,
            nuisance_basis=orthonormal_basis(
                whitening.whiten_rows(columns.build_design_matrix()[whitening.is_row_fitted])
            ),
            variance_ratio=np.zeros(len(error)),
            mean_variance_ratio=1.0,
            row_groups=np.unique(
                whitening.select_fitted_rows(logs.quarter_index), return_inverse=True
            )[1],
            measured=np.ones(len(error), dtype=bool),
            rounding_noise=0.0,
        )
        return TorqueDictionary(
            problem, columns, whitening, np.sqrt((logs.row_torques**2).mean(axis=0))
        )

    def spec(self, term: TorqueTerm) -> LawColumns | None:
        """A law with its columns; None where it adds nothing to any row."""
        joints, rows = self.columns.build_term_rows(term)
        out = np.zeros((len(self.problem.error), rows.shape[2]))
        for j, part in zip(joints, rows, strict=True):
            out[self.whitening.joint_index == j] = self.whitening.whiten_joint_rows(
                int(j), part[self.whitening.is_row_fitted[j]]
            )
        if not np.any(out):
            return None
        law, count = term.law, len(out)
        return LawColumns(
            term=term,
            text=term.text,
            key=term.key,
            columns=out,
            prior_variations=np.zeros((count, 0)),
            varied_parameters=np.zeros(0, dtype=int),
            nonnegative=np.full(out.shape[1], law.nonnegative),
            typical_size=law.typical
            * (self.rms_torque_by_joint[term.joint_index] if law.of_torque else 1.0),
            tuned_number_count=len(term.tuned),
            may_repeat_at_place=law.repeats,
        )

    def finer(self, term: TorqueTerm) -> list[TorqueTerm]:
        """The law with its tuned number closer together."""
        return term.finer()

    def lines(
        self, noise: Noise, known: Array, found: Sequence[TorqueTerm]
    ) -> list[tuple[TorqueTerm, float]]:
        """None: the waves of gears are tried at their ratios."""
        return []

    def is_expected(self, line: TorqueTerm, found: Sequence[TorqueTerm]) -> bool:
        """There are none."""
        return False


# ---- fits ----------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class FittedBody:
    """What fitted numbers say of the arm itself.

    rigid: (n, 10 n) inertial parameters by joint, or (1, 10 n) where joints share them.
    usual: (n, 2) Coulomb [unit of the log] and viscous friction [the same, s/rad].
    """

    rigid: Array
    usual: Array

    @staticmethod
    def from_base_parameters(
        arm: TorqueArm, base_parameters: Array, friction_coefficients: Array
    ) -> FittedBody:
        """Of fitted base parameters and friction (2 n,); the body is the nearest to the drawing."""
        each = base_parameters.reshape(-1, arm.base_parameter_combinations.shape[1])
        near = (
            arm.nominal_inertial_parameters
            + (each - arm.base_parameter_combinations.T @ arm.nominal_inertial_parameters)
            @ arm.base_parameter_combinations.T
        )
        return FittedBody(near, friction_coefficients.reshape(-1, 2))

    @staticmethod
    def fit_with_friction(scene: ArmMotion) -> FittedBody:
        """Rigid body and usual friction by plain least squares on the rows that are fitted."""
        columns, kept = TorqueColumns(scene), scene.logs.fitted_row_mask_by_joint.T
        value = solve_ridge_least_squares(
            columns.build_design_matrix()[kept], columns.torques_to_explain[kept]
        )
        return FittedBody.from_base_parameters(
            scene.arm, *np.split(value, [columns.rigid_body_columns.shape[2]])
        )

    def build_torque_columns(self, scene: ArmMotion) -> TorqueColumns:
        """Columns of a scene with this load and friction."""
        return TorqueColumns(self.apply_to_motion(scene))

    def apply_to_motion(self, scene: ArmMotion) -> ArmMotion:
        """A scene with this load and friction."""
        coulomb, viscous = self.usual.T
        friction = scene.speed_sign * coulomb + scene.logs.motion.qd * viscous
        return scene.with_body(
            np.broadcast_to(self.rigid, scene.inertial_parameters_by_joint.shape), friction
        )


@dataclass(frozen=True, eq=False)
class FittedTorqueTerm(TorqueTerm):
    """A law of a fit.  value: (d,) of its parameters."""

    value: Array


@dataclass(frozen=True, eq=False)
class TorqueModel:
    """Torques of an arm, as fitted.

    body: of the fit.  terms: its laws.  context: the body by which the laws know load and friction.
    held: (n, k) friction of each joint's bristles [unit of the log].
    delay: by which torques are logged after the motion [s].
    """

    name: str
    body: FittedBody
    terms: tuple[FittedTorqueTerm, ...]
    context: FittedBody
    held: Array
    delay: float

    def predict_torques(self, columns: TorqueColumns) -> Array:
        """(R, n) torques in the unit of the log.  columns: of a scene with this context."""
        scene = columns.scene
        base = (
            np.broadcast_to(self.body.rigid, scene.inertial_parameters_by_joint.shape)
            @ scene.arm.base_parameter_combinations
        )
        rigid = np.einsum("rjp,jp->jr", scene.base_parameter_rows, base)
        friction = columns.usual_friction_columns @ self.body.usual.ravel()
        out = rigid + friction + scene.logs.filter_to_rows(scene.known_payload_torque).T
        for term in self.terms:
            joints, rows = columns.build_term_rows(term)
            out[joints] += rows @ term.value
        return np.asarray(out.T + (self.held * scene.bristle_deflection_rows).sum(axis=-1))


@dataclass(frozen=True, eq=False)
class TorqueRegression:
    """Whitened rows of rigid body, usual friction and laws, ready for fits of any of their columns.

    unwhitened_design: (n, R, p) of all rows, not whitened.  whitened_design: (N, p).
    whitened_torques: (N,).  column_slices: which columns belong to what.  row_groups: (N,).
    """

    columns: TorqueColumns
    whitening: AutoregressiveWhitening
    terms: tuple[TorqueTerm, ...]
    unwhitened_design: Array
    whitened_design: Array
    whitened_torques: Array
    column_slices: dict[str, slice]
    row_groups: Array

    @staticmethod
    def build(
        columns: TorqueColumns, whitening: AutoregressiveWhitening, terms: Sequence[TorqueTerm]
    ) -> TorqueRegression:
        """Of all rows that are fitted."""
        raw, kept = columns.build_design_matrix(terms), whitening.is_row_fitted
        sizes = {
            RIGID_BODY_GROUP: columns.rigid_body_columns.shape[2],
            USUAL_FRICTION_GROUP: columns.usual_friction_columns.shape[2],
        }
        sizes |= {term.text: columns.build_term_rows(term)[1].shape[2] for term in terms}
        ends = np.cumsum([0, *sizes.values()]).tolist()
        place = dict(zip(sizes, map(slice, ends[:-1], ends[1:]), strict=True))
        return TorqueRegression(
            columns,
            whitening,
            tuple(terms),
            raw,
            whitening.whiten_rows(raw[kept]),
            whitening.whiten_rows(columns.torques_to_explain[kept]),
            place,
            whitening.select_fitted_rows(columns.scene.logs.quarter_index),
        )

    @staticmethod
    def build_with_estimated_whitening(
        columns: TorqueColumns, terms: Sequence[TorqueTerm]
    ) -> TorqueRegression:
        """Of some laws, whitened by what their own fit leaves [feasible generalised least squares].

        columns: of the rows.
        """
        rough = TorqueRegression.build(columns, columns.estimate_whitening(terms), terms)
        rest = rough.compute_unwhitened_residuals(rough.solve_values(rough.column_groups))
        return TorqueRegression.build(
            columns, estimate_autoregressive_whitening(columns.scene.logs, rest), terms
        )

    @property
    def column_groups(self) -> list[str]:
        """Rigid body, usual friction and all laws."""
        return list_column_groups(self.terms)

    def column_indices_of_groups(self, column_groups: Sequence[str]) -> Array:
        """(q,) columns of some parts."""
        return np.concatenate(
            [np.arange(self.whitened_design.shape[1])[self.column_slices[p]] for p in column_groups]
        )

    @cached_property
    def gram_matrix(self) -> Array:
        """(p, p) products of the columns."""
        return self.whitened_design.T @ self.whitened_design

    @cached_property
    def gradient(self) -> Array:
        """(p,) products of columns and error."""
        return self.whitened_design.T @ self.whitened_torques

    def solve_values(self, column_groups: Sequence[str]) -> Array:
        """(p,) values of some parts, 0 elsewhere."""
        index = self.column_indices_of_groups(column_groups)
        out = np.zeros(len(self.gram_matrix))
        out[index] = solve_ridge_normal_equations(
            self.gram_matrix[np.ix_(index, index)], self.gradient[index]
        )
        return out

    def compute_unwhitened_residuals(self, values: Array) -> Array:
        """(N,) what values leave of the rows, not whitened."""
        kept = self.whitening.is_row_fitted
        return np.asarray(
            self.columns.torques_to_explain[kept] - self.unwhitened_design[kept] @ values
        )

    def compute_sigmas(self, column_groups: Sequence[str], values: Array) -> Array:
        """(p,) standard deviations of the values of some parts, of rows that err by groups.

        The larger of that of white noise and of the sandwich over groups [Liang and Zeger 1986].
        """
        index = self.column_indices_of_groups(column_groups)
        gram = self.gram_matrix[np.ix_(index, index)]
        scale = np.sqrt(np.maximum(np.diag(gram), 1e-300))
        unit = gram / np.outer(scale, scale) + RELATIVE_TORQUE_RIDGE * np.eye(len(index))
        inverse = cho_solve(cho_factor(unit), np.eye(len(index)))
        rest = self.whitened_torques - self.whitened_design @ values
        dof = max(len(rest) - len(index), 1)
        count = int(self.row_groups.max()) + 1
        score = (
            np.array(
                [
                    rest[self.row_groups == g]
                    @ self.whitened_design[self.row_groups == g][:, index]
                    for g in range(count)
                ]
            )
            / scale
            @ inverse
        )
        sandwich = (score**2).sum(axis=0) * count / max(count - 1, 1)
        plain = np.diag(inverse) * float(rest @ rest) / dof
        out = np.zeros(len(values))
        out[index] = np.sqrt(np.maximum(sandwich, plain)) / scale
        return out

    def build_fitted_body(self, values: Array) -> FittedBody:
        """Rigid body and friction of values (p,)."""
        parts = (
            values[self.column_slices[part]] for part in (RIGID_BODY_GROUP, USUAL_FRICTION_GROUP)
        )
        return FittedBody.from_base_parameters(self.columns.scene.arm, *parts)

    def fit_torque_model(
        self, name: str, terms: Sequence[TorqueTerm], linearisation_body: FittedBody, delay: float
    ) -> TorqueModel:
        """The fit of rigid body, usual friction and some laws."""
        value = self.solve_values(list_column_groups(terms))
        found = tuple(
            FittedTorqueTerm(**vars(t), value=value[self.column_slices[t.text]]) for t in terms
        )
        bristles = self.columns.scene.bristle_deflection_rows
        held = fit_bristle_friction(
            bristles, (self.columns.torques_to_explain - self.unwhitened_design @ value).T
        )
        return TorqueModel(
            name, self.build_fitted_body(value), found, linearisation_body, held, delay
        )


def list_column_groups(terms: Sequence[TorqueTerm]) -> list[str]:
    """The parts of a fit with usual friction and some laws."""
    return [RIGID_BODY_GROUP, USUAL_FRICTION_GROUP, *(term.text for term in terms)]


def fit_bristle_friction(bristle_deflections: Array, residuals: Array) -> Array:
    """(n, 2) friction of bristles (R, n, 2) by what a fit misses (R, n); none below 0."""
    gram, pull = (
        np.einsum("rjk,rjl->jkl", bristle_deflections, bristle_deflections),
        np.einsum("rjk,rj->jk", bristle_deflections, residuals),
    )
    size = np.maximum(np.einsum("jkk->jk", gram), 1e-300)
    one = np.maximum(pull / size, 0.0)
    alone = np.where(np.arange(2) == (one * pull).argmax(axis=1)[:, None], one, 0.0)
    both = np.array([solve_ridge_normal_equations(*each) for each in zip(gram, pull, strict=True)])
    return np.where((both >= 0.0).all(axis=1, keepdims=True), both, alone)
