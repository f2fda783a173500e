"""Whether the masses of a model are those of the arm, and which runs carry what at the flange."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from scipy.linalg import block_diag
from scipy.special import fdtrc

from minimax_cal.core.arrays import Array
from minimax_cal.core.linear_algebra import project_out
from minimax_cal.dynamics.laws import TorqueTerm
from minimax_cal.dynamics.logs.log_table import CURRENT_UNIT
from minimax_cal.dynamics.regressor import INERTIAL_PARAMETERS_PER_LINK
from minimax_cal.dynamics.result import pair_rms_by_joint
from minimax_cal.dynamics.torque_regression import (
    USUAL_FRICTION_GROUP,
    TorqueColumns,
    TorqueRegression,
)
from minimax_cal.dynamics.torque_rows import TorqueArm
from minimax_cal.selection.noise_model import estimate_noise_inflation, orthonormal_basis

MAX_CONTRADICTION_P = 1e-4  # p-value below which rows contradict a body that is not refitted
MAX_LIKELIHOOD_LOSS = 12.0  # of log likelihood, twice: links that explain as much
MIN_CHANGE_SIGMAS = 4.0  # by which a parameter of a changed link differs from the given
WEIGHED_COUNT = 4  # parameters of a link that gravity shows: its mass and first moments
MIN_SINGULAR_VALUE = 1e-10  # of the largest: what all runs carry alike is the last link's
LINK_COLUMN_GROUP = "link"  # part of a fit: parameters of the link that may have changed


@dataclass(frozen=True, eq=False)
class LinkChange:
    """A link whose parameters are not as given.  link_index: from 0.  inertial_parameters,
    inertial_parameter_sigmas: (10,).

    rms_before_and_after_by_joint: of each joint, the RMS that the body as given leaves of the
    fitted rows, and that with the link changed; rms_before: (n,) the first.  alternative_links:
    links that would explain as much.
    """

    link_index: int
    inertial_parameters: Array
    inertial_parameter_sigmas: Array
    rms_before_and_after_by_joint: dict[str, tuple[float, float]]
    rms_before: Array
    alternative_links: tuple[int, ...]


@dataclass(frozen=True, eq=False)
class MassTest:
    """Whether the rows agree with the masses as given; else the one link whose change suffices."""

    is_consistent: bool
    link_change: LinkChange | None = None

    def describe_masses(self, arm: TorqueArm, unit: str) -> tuple[str, ...]:
        """What is to be known of masses and gains.  unit: of the log."""
        if unit == CURRENT_UNIT and not arm.has_shared_inertial_parameters:
            return (
                "currents are judged in A: without drive gains each joint has masses of its own; "
                "give drive_gain= to test joint flexibility, drive gains and the masses of the "
                "model",
            )
        if not arm.nominal_inertial_parameters.any():
            return ("the model gives no masses: the rigid body is the one that the torques show",)
        if not self.is_consistent and self.link_change is None:
            return ("the masses of the model are not this arm's: the rigid body was refitted",)
        return ()


def compute_reduced_model_p_value(
    reduced_model_residuals: Array,
    full_model_residuals: Array,
    row_groups: Array,
    removed_column_count: int,
    full_model_dof: int,
) -> float:
    """p-value of what fewer parameters leave, by rows and by groups of rows [F test].

    reduced_model_residuals, full_model_residuals: (N,) whitened, of the fit with fewer parameters,
    and of the other.  row_groups: (N,) of rows that err together.  removed_column_count: parameters
    that are fewer.  full_model_dof: of the other.
    """
    more = max(
        float(
            reduced_model_residuals @ reduced_model_residuals
            - full_model_residuals @ full_model_residuals
        ),
        0.0,
    )
    wide = estimate_noise_inflation(
        reduced_model_residuals - full_model_residuals,
        reduced_model_residuals,
        row_groups,
        full_model_dof,
    )
    ratio = (
        more
        / max(removed_column_count, 1)
        / (float(full_model_residuals @ full_model_residuals) / full_model_dof)
        / wide
    )
    return float(fdtrc(max(removed_column_count, 1), full_model_dof, ratio))


def compare_masses_with_nominal(regression: TorqueRegression) -> MassTest:
    """Whether the rows agree with the masses as given, or with these but for one link.

    regression: of all that is named.  Usual friction and named laws are free in every case.
    """
    scene = regression.columns.scene
    arm, kept = scene.arm, regression.whitening.is_row_fitted
    if not (arm.has_shared_inertial_parameters and arm.nominal_inertial_parameters.any()):
        return MassTest(is_consistent=False)

    # Residuals of the free body, and of the body as given beside friction and laws.
    value = regression.solve_values(regression.column_groups)
    full = regression.whitened_torques - regression.whitened_design @ value
    free, dof = (
        arm.base_parameter_combinations.shape[1],
        len(regression.whitened_torques) - len(value),
    )
    rows = regression.columns.link_parameter_columns
    links = regression.whitening.whiten_rows(rows[kept])
    others = regression.column_indices_of_groups(regression.column_groups[1:])
    matrix = np.concatenate([regression.whitened_design[:, others], links], axis=1)
    error, count = (
        regression.whitened_torques - links @ arm.nominal_inertial_parameters,
        len(others),
    )

    def residuals_of(index: Array) -> Array:
        found = np.linalg.lstsq(matrix[:, index], error, rcond=None)[0]
        return np.asarray(error - matrix[:, index] @ found)

    given = residuals_of(np.arange(count))
    if (
        compute_reduced_model_p_value(given, full, regression.row_groups, free, dof)
        > MAX_CONTRADICTION_P
    ):
        return MassTest(is_consistent=True)

    # The link whose ten parameters, free, leave least.
    spans = {
        k: np.r_[
            :count,
            count + INERTIAL_PARAMETERS_PER_LINK * k : count
            + INERTIAL_PARAMETERS_PER_LINK * (k + 1),
        ]
        for k in range(scene.logs.joint_count)
    }
    residuals = {k: residuals_of(index) for k, index in spans.items()}
    squares = {k: float(part @ part) for k, part in residuals.items()}
    link = min(squares, key=lambda k: squares[k])
    p = compute_reduced_model_p_value(
        residuals[link], full, regression.row_groups, free - INERTIAL_PARAMETERS_PER_LINK, dof
    )
    if p < MAX_CONTRADICTION_P:
        return MassTest(is_consistent=False)
    limit = squares[link] * np.exp(MAX_LIKELIHOOD_LOSS / len(error))
    alike = tuple(k for k, square in squares.items() if k != link and square < limit)

    # Its change with uncertainty, and what it is worth.
    alone = replace(
        regression,
        whitened_design=matrix[:, spans[link]],
        whitened_torques=error,
        column_slices={
            USUAL_FRICTION_GROUP: slice(0, count),
            LINK_COLUMN_GROUP: slice(count, None),
        },
    )
    value = alone.solve_values([USUAL_FRICTION_GROUP, LINK_COLUMN_GROUP])
    sigma = alone.compute_sigmas([USUAL_FRICTION_GROUP, LINK_COLUMN_GROUP], value)
    if not np.any(np.abs(value[count:]) > MIN_CHANGE_SIGMAS * sigma[count:]):
        return MassTest(is_consistent=False)
    of_link = rows[
        ..., INERTIAL_PARAMETERS_PER_LINK * link : INERTIAL_PARAMETERS_PER_LINK * (link + 1)
    ]
    raw = np.concatenate([regression.unwhitened_design[..., others], of_link], axis=2)[kept]
    plain, joint, rms = (
        regression.columns.torques_to_explain[kept] - rows[kept] @ arm.nominal_inertial_parameters,
        regression.whitening.joint_index,
        [],
    )
    for some in (alone.solve_values([USUAL_FRICTION_GROUP]), value):
        total = np.bincount(joint, (plain - raw @ some) ** 2, minlength=len(kept))
        rms.append(np.sqrt(total / np.maximum(np.bincount(joint, minlength=len(kept)), 1)))
    worth = pair_rms_by_joint(*rms)
    return MassTest(
        is_consistent=False,
        link_change=LinkChange(link, value[count:], sigma[count:], worth, rms[0], alike),
    )


def find_payloads_by_run(columns: TorqueColumns, terms: Sequence[TorqueTerm]) -> list[TorqueTerm]:
    """The payloads that runs carry more than the lightest does: runs that carry alike have one.

    Each run is fitted with a last link of its own, beside one variant of every other law.  Runs are
    joined, the most alike first, until their rows contradict it.
    """
    logs, white = columns.scene.logs, columns.estimate_whitening(terms)
    kept, count = white.is_row_fitted, len(logs.names)
    run, group = (
        white.select_fitted_rows(logs.run_index),
        white.select_fitted_rows(logs.quarter_index),
    )

    # Normal equations of the runs' links, all else projected out [Schur complement].
    basis = orthonormal_basis(
        white.whiten_rows(columns.build_design_matrix_of_one_variant_each(terms)[kept])
    )
    link = np.moveaxis(
        logs.filter_to_rows(columns.scene.regressor[:, :, -INERTIAL_PARAMETERS_PER_LINK:]), 1, 0
    )
    link = white.whiten_rows(link[kept])
    link /= np.maximum(np.linalg.norm(link, axis=0), 1e-300)
    error = project_out(white.whiten_rows(columns.torques_to_explain[kept]), basis)
    each = [(link[run == r], basis[run == r]) for r in range(count)]
    shared = np.concatenate([own.T @ rows for rows, own in each], axis=1)
    gram = block_diag(*(rows.T @ rows for rows, _ in each)) - shared.T @ shared
    pull = np.concatenate([rows.T @ error[run == r] for r, (rows, _) in enumerate(each)])

    def residuals_of(value: Array) -> Array:
        """(N,) of last links (10 r,) of the runs."""
        moved = (link * value.reshape(count, -1)[run]).sum(axis=1)
        return np.asarray(error - project_out(moved, basis))

    # Agglomeration: the two loads that differ least are joined [Wald test of their difference].
    label = np.arange(count)  # which load a run has
    while True:
        loads = np.eye(label.max() + 1)
        own = np.kron(loads[label], np.eye(INERTIAL_PARAMETERS_PER_LINK))
        inner = own.T @ gram @ own
        inverse = np.linalg.pinv(inner, MIN_SINGULAR_VALUE, hermitian=True)
        value = inverse @ own.T @ pull
        pairs = []
        for a, b in combinations(range(len(loads)), 2):
            apart = np.kron(loads[a] - loads[b], np.eye(INERTIAL_PARAMETERS_PER_LINK))
            toward = (
                inverse @ apart.T @ np.linalg.pinv(apart @ inverse @ apart.T, MIN_SINGULAR_VALUE)
            )
            off = toward @ (apart @ value)
            pairs.append((float(off @ inner @ off), a, b, off))
        if not pairs:
            break
        _, a, b, off = min(pairs, key=lambda pair: pair[0])
        joined, full = residuals_of(own @ (value - off)), residuals_of(own @ value)
        dof = len(error) - basis.shape[1] - len(value)
        if (
            compute_reduced_model_p_value(joined, full, group, INERTIAL_PARAMETERS_PER_LINK, dof)
            < MAX_CONTRADICTION_P
        ):
            break
        label = np.where(label == b, a, label)
        label -= label > b

    lightest = int(np.argmin(value[::INERTIAL_PARAMETERS_PER_LINK]))
    heavier = [TorqueTerm("payload", f"L{logs.joint_count}",
                    {logs.names[r]: 1.0 for r in np.flatnonzero(label == k)})
               for k in range(len(loads)) if k != lightest]  # fmt: skip
    return select_payloads_with_weight(columns, terms, heavier)


def select_payloads_with_weight(
    columns: TorqueColumns, terms: Sequence[TorqueTerm], payloads: Sequence[TorqueTerm]
) -> list[TorqueTerm]:
    """The payloads that gravity shows, beside one variant of every other law: others are none."""
    every = [*{term.key: term for term in reversed(terms)}.values(), *payloads]
    normal = TorqueRegression.build(columns, columns.estimate_whitening(every), every)
    value = normal.solve_values(normal.column_groups)
    sure = np.abs(value) > MIN_CHANGE_SIGMAS * normal.compute_sigmas(normal.column_groups, value)
    return [
        term for term in payloads if sure[normal.column_slices[term.text]][:WEIGHED_COUNT].any()
    ]
