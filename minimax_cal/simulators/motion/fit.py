"""The numbers of a simulator's elements from logs: all of them in one fit, the masses physical.

Masses, armature, friction and what else is asked for are fitted together, on the rows and with the
noise of the motion diagnosis.  What torques do not tell stays near the model: each body by a prior
in its log-Cholesky coordinates, each armature by one of its own.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from copy import copy
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from minimax_cal.core.arrays import Array
from minimax_cal.dynamics.laws import FRICTION_CURVE_FAMILY, SimulatorElement, TorqueTerm
from minimax_cal.dynamics.regressor import INERTIAL_PARAMETERS_PER_LINK
from minimax_cal.dynamics.torque_regression import TorqueColumns, solve_ridge_normal_equations
from minimax_cal.dynamics.torque_rows import (
    ArmMotion,
    AutoregressiveWhitening,
    MotionLogs,
    TorqueArm,
)
from minimax_cal.robots.mjcf_import import import_mujoco
from minimax_cal.simulators.chain import ModelArm
from minimax_cal.simulators.motion.model_parameters import (
    POLYNOMIAL_TERMS,
    ModelBodies,
    ModelParameters,
    inertial_attributes,
    nearest_physical_body,
    read_model_parameters,
)

BODY_PRIOR_SIGMA = 0.5  # standard deviation of a body's log-Cholesky coordinates about the model's
ASSUMED_BODY_PRIOR_SIGMA = 1.5  # the same where the masses of the model are assumed
RELATIVE_ARMATURE_PRIOR_SIGMA = (
    0.5  # of the inertia by links, or torque / acceleration: deviation of an armature
)
LEVELLING_SPEED_SHARES = (
    0.5,
    0.7,
    1.0,
    1.4,
)  # of a joint's largest speed, where damping levels off
LOAD_ITERATIONS = 3  # of fits, each with the load and the friction of the one before
MAX_LEVENBERG_STEPS = 60  # of a fit, and trials of a step
START_LEVENBERG_DAMPING, MIN_LEVENBERG_DAMPING = (
    1e-4,
    1e-9,
)  # of the normal matrix with a unit diagonal
MIN_RELATIVE_SQUARES_FALL = 1e-7  # relative fall of the squares that ends a fit
IMPEDANCE_LIMITS = (1e-4, 0.9999)  # least and largest that MuJoCo takes [mjMINIMP, mjMAXIMP]
MIN_RELATIVE_FRICTION = 1e-6  # of a joint's largest torque: a smaller one has no say


@dataclass(frozen=True, eq=False)
class ElementSelection:
    """What is fitted; the rest stays as the model has it.

    elements: of those above.  link: the only one whose masses change, -1 for all. levelled_joints:
    joints whose damping levels off.  spring_joints, gain_joints: joints with a spring, or whose
    drive gain is off.  laws: that no element holds: masses and armature are fitted with them first,
    and kept.  spring_powers: powers of the angle in a spring's torque.
    """

    elements: frozenset[SimulatorElement]
    link: int = -1
    levelled_joints: tuple[int, ...] = ()
    spring_joints: tuple[int, ...] = ()
    gain_joints: tuple[int, ...] = ()
    laws: tuple[TorqueTerm, ...] = ()
    delay: float = 0.0
    spring_powers: int = POLYNOMIAL_TERMS - 1

    def without_element(self, element: SimulatorElement) -> ElementSelection:
        """All but one element."""
        return replace(self, elements=self.elements - {element})

    def without_law(self, effect: str) -> ElementSelection:
        """All but the laws of one effect."""
        return replace(self, laws=tuple(term for term in self.laws if term.effect != effect))


@dataclass(frozen=True, eq=False)
class ParameterColumn:
    """A number of one joint.  rows: (M,) torque of the log per unit.

    field, index, factor: what it adds to of `ModelParameters`, there, per unit.  lower_bound: its
    least value.  prior_mean, prior_sigma: of its prior, sd infinite for none.
    """

    field: str
    joint: int
    rows: Array
    index: Any
    factor: Array | float = 1.0
    lower_bound: float = 0.0
    prior_mean: float = 0.0
    prior_sigma: float = np.inf


@dataclass(frozen=True, eq=False)
class FitData:
    """Logs to learn from, and the arm of a model.

    scene: of these logs.  inertia: (n,) largest about each joint [kg m^2].  links: (N, 10 n)
    whitened rows of the links' parameters.  prior: of the bodies.  terms: laws of a diagnosis.
    """

    chain: ModelArm
    bodies: ModelBodies
    model_parameters: ModelParameters
    scene: ArmMotion
    whitening: AutoregressiveWhitening
    links: Array
    inertia: Array
    prior: float
    terms: tuple[TorqueTerm, ...]

    @staticmethod
    def of(
        chain: ModelArm,
        arm: TorqueArm,
        logs: MotionLogs,
        terms: tuple[TorqueTerm, ...],
        inertia: Array,
        prior: float,
    ) -> FitData:
        """Of the logs to learn from."""
        bodies, scene = ModelBodies.read(chain), ArmMotion.build(arm, logs)
        given = read_model_parameters(chain, bodies)
        columns = TorqueColumns(
            scene.with_body(
                share_links_among_joints(bodies.link_parameters(given.bodies)),
                scene.friction_torque,
            )
        )
        white = columns.estimate_whitening(terms)
        links = white.whiten_rows(columns.link_parameter_columns[white.is_row_fitted])
        return FitData(chain, bodies, given, columns.scene, white, links, inertia, prior, terms)

    def select_runs(self, runs: Sequence[int]) -> FitData:
        """Of some of the runs."""
        arm, logs = self.scene.arm, self.scene.logs.select_runs(runs)
        return FitData.of(self.chain, arm, logs, self.terms, self.inertia, self.prior)

    def whitened_torque(self, delay: float) -> Array:
        """(N,) whitened torques less those of a known payload; so much earlier [s]."""
        logs = self.scene.logs.with_torque_delay_removed(delay) if delay else self.scene.logs
        known = logs.filter_to_rows(self.scene.known_payload_torque)
        return self.whitening.whiten_rows(
            (logs.row_torques - known).T[self.whitening.is_row_fitted]
        )

    def with_masses(self, found: ModelParameters) -> FitData:
        """The same logs, for a model that has masses and armature already."""
        own = np.array([nearest_physical_body(body) for body in found.bodies])
        bodies = replace(self.bodies, pseudo_inertias=own)
        given = replace(self.model_parameters, bodies=own, armature=found.armature)
        scene = self.scene.with_body(
            share_links_among_joints(bodies.link_parameters(own)), self.scene.friction_torque
        )
        return replace(self, bodies=bodies, model_parameters=given, scene=scene)


def share_links_among_joints(links: Array) -> Array:
    """(n, 10 n) parameters that all joints share, of links (n, 10)."""
    return np.broadcast_to(links.ravel(), (len(links), links.size))


def fit_model_parameters(fit_data: FitData, selection: ElementSelection) -> ModelParameters:
    """The numbers that the logs show."""
    if selection.laws:
        curved = any(
            term.law.family == FRICTION_CURVE_FAMILY for term in selection.laws
        )  # which says it better
        first = fit_elements(
            fit_data, selection.without_element(SimulatorElement.LEVELLED) if curved else selection
        )
        fit_data = fit_data.with_masses(first)
        selection = (
            replace(selection, laws=())
            .without_element(SimulatorElement.MASSES)
            .without_element(SimulatorElement.ARMATURE)
        )
    return fit_elements(fit_data, selection)


def fit_elements(fit_data: FitData, selection: ElementSelection) -> ModelParameters:
    """All that is asked for, in one fit that is repeated with its own load and friction."""
    scene, numbers = fit_data.scene, fit_data.model_parameters
    late = selection.delay if SimulatorElement.DELAY in selection.elements else 0.0
    error = fit_data.whitened_torque(late)
    for _ in range(LOAD_ITERATIONS):
        columns = list(build_parameter_columns(fit_data, scene, selection))
        numbers = solve_parameters(
            fit_data, scene, selection, columns, error, replace(numbers, delay=late)
        )
        scene = update_scene_friction(fit_data, scene, numbers)
    return numbers


def build_parameter_columns(
    fit_data: FitData, scene: ArmMotion, selection: ElementSelection
) -> Iterator[ParameterColumn]:
    """The numbers that are linear, each of one joint."""
    motion, unit, given = scene.logs.motion, scene.torque_per_log_unit, fit_data.model_parameters
    for j in range(given.joint_count):
        qd, qdd = motion.qd[:, j], motion.qdd[:, j]
        if SimulatorElement.FRICTION in selection.elements:
            yield ParameterColumn("friction", j, scene.speed_sign[:, j] / unit[j], j)
            yield ParameterColumn("damping", j, qd / unit[j], (j, 0))
        if SimulatorElement.LEVELLED in selection.elements and j in selection.levelled_joints:
            for share in LEVELLING_SPEED_SHARES:
                powers = levelling_damping_coefficients(share * scene.arm.fastest[j])
                yield ParameterColumn("damping", j, speed_powers(qd) @ powers / unit[j], j, powers)
        if SimulatorElement.ARMATURE in selection.elements:
            whole = unit[j] * np.abs(scene.logs.torque[:, j]).max() / np.abs(qdd).max()
            doubt = max(
                given.armature[j],
                RELATIVE_ARMATURE_PRIOR_SIGMA * fit_data.inertia[j],
                RELATIVE_ARMATURE_PRIOR_SIGMA * whole,
            )
            yield ParameterColumn(
                "armature", j, qdd / unit[j], j, prior_mean=given.armature[j], prior_sigma=doubt
            )
        if SimulatorElement.SPRINGS in selection.elements and j in selection.spring_joints:
            for power in range(selection.spring_powers + 1):
                rows = motion.q[:, j] ** power / unit[j]
                yield ParameterColumn("spring", j, rows, (j, power), lower_bound=-np.inf)
        if SimulatorElement.GAIN in selection.elements and j in selection.gain_joints:
            yield ParameterColumn("gain", j, scene.load_torque[:, j], j, lower_bound=-np.inf)
    for number, term in enumerate(selection.laws):
        low = 0.0 if term.law.nonnegative else -np.inf
        for rows in term.build_columns(scene).T:
            yield ParameterColumn("law", term.joint_index, rows, number, lower_bound=low)


def speed_powers(qd: Array) -> Array:
    """(M, 3) powers of a speed as MuJoCo's damping takes them."""
    return np.stack([qd, qd * np.abs(qd), qd**3], axis=-1)


def levelling_damping_coefficients(speed: float) -> Array:
    """(3,) damping whose slope falls to 0 at a speed, and is negative nowhere."""
    return np.array([1.0, -1.0 / speed, 1.0 / (3.0 * speed**2)])


def clear_fitted_parameters(fit_data: FitData, selection: ElementSelection) -> ModelParameters:
    """The model's own numbers, 0 where they are fitted."""
    given, fitted = fit_data.model_parameters, selection.elements
    own, free = (
        SimulatorElement.FRICTION not in fitted,
        selection.spring_joints if SimulatorElement.SPRINGS in fitted else (),
    )
    stiffness = given.stiffness.copy()
    stiffness[list(free)] = 0.0
    return replace(
        given,
        friction=given.friction * own,
        damping=given.damping * own,
        armature=given.armature * (SimulatorElement.ARMATURE not in fitted),
        stiffness=stiffness,
    )


def solve_parameters(
    fit_data: FitData,
    scene: ArmMotion,
    selection: ElementSelection,
    columns: list[ParameterColumn],
    whitened_torque: Array,
    parameters: ModelParameters,
) -> ModelParameters:
    """One fit, with the load and the friction of the scene."""
    logs, white = scene.logs, fit_data.whitening
    kept = white.joint_index
    rows = logs.filter_to_rows(np.array([column.rows for column in columns]).T.reshape(
        len(logs.since), len(columns)))  # fmt: skip
    matrix = np.zeros((len(kept), len(columns)))
    for k, column in enumerate(columns):
        some = rows[white.is_row_fitted[column.joint], k]
        matrix[kept == column.joint, k] = white.whiten_joint_rows(column.joint, some)

    # Torque of what the model has and is not fitted [N m].
    own, motion = clear_fitted_parameters(fit_data, selection), fit_data.scene.logs.motion
    fixed = own.friction * fit_data.scene.speed_sign + own.armature * motion.qdd
    fixed += np.einsum("mjp,jp->mj", speed_powers(motion.qd), own.damping)
    x = motion.q - own.spring_rest
    fixed = sum((own.stiffness[:, p] * x ** (p + 1) for p in range(POLYNOMIAL_TERMS)), fixed)
    fixed = logs.filter_to_rows(fixed / scene.torque_per_log_unit)
    right = whitened_torque - white.whiten_rows(fixed.T[white.is_row_fitted])
    triangle = np.asarray(
        np.linalg.qr(np.hstack([fit_data.links, matrix, right[:, None]]), mode="r")
    )
    split = fit_data.links.shape[1]
    links, linear, right = triangle[:, :split], triangle[:, split:-1], triangle[:, -1]
    bodies, value = fit_bodies_and_columns(fit_data, selection, columns, (links, linear, right))
    return assemble_parameters(fit_data, selection, columns, bodies, value, parameters)


def fit_bodies_and_columns(
    fit_data: FitData,
    selection: ElementSelection,
    columns: list[ParameterColumn],
    condensed_rows: tuple[Array, Array, Array],
) -> tuple[Array, Array]:
    """Bodies (n, 4, 4) and linear numbers (k,) that explain condensed rows best."""
    links, linear, right = condensed_rows
    n, k = len(fit_data.bodies.pseudo_inertias), len(columns)
    free = np.zeros((n, INERTIAL_PARAMETERS_PER_LINK), dtype=bool)
    if SimulatorElement.MASSES in selection.elements:
        free[:] = np.arange(n)[:, None] == selection.link if selection.link >= 0 else True
    mean, sd, low = (np.array([getattr(c, name) for c in columns]).reshape(k)
                     for name in ("prior_mean", "prior_sigma", "lower_bound"))  # fmt: skip
    count = int(free.sum())

    least = np.concatenate([np.full(count, -np.inf), low])
    weight = np.concatenate([np.full(count, 1.0 / fit_data.prior), 1.0 / sd])
    middle = np.concatenate([np.zeros(count), mean])

    def coordinates(x: Array) -> Array:
        out = np.zeros((n, INERTIAL_PARAMETERS_PER_LINK))
        out[free] = x[:count]
        return out

    def residual(x: Array) -> Array:
        bodies = fit_data.bodies.at_coordinates(coordinates(x))
        left = links @ fit_data.bodies.link_parameters(bodies).ravel() + linear @ x[count:] - right
        return np.concatenate([left, (x - middle) * weight])

    def jacobian(x: Array) -> Array:
        slopes = fit_data.bodies.link_parameter_jacobian(coordinates(x))
        by_body = np.einsum(
            "rlp,lkp->rlk", links.reshape(len(links), n, INERTIAL_PARAMETERS_PER_LINK), slopes
        )
        top = np.hstack([by_body.reshape(len(links), -1)[:, free.ravel()], linear])
        return np.vstack([top, np.diag(weight)])

    beside = np.arange(len(middle)) >= count
    x = np.maximum(middle, least)  # first what fits the drawn bodies: else link 2 takes J1's rotor
    x = minimise_squares_with_bounds(residual, lambda x: jacobian(x) * beside, x, least)
    x = minimise_squares_with_bounds(residual, jacobian, x, least)
    return fit_data.bodies.at_coordinates(
        coordinates(x)
    ) if count else fit_data.bodies.pseudo_inertias, x[count:]


def minimise_squares_with_bounds(
    residual: Callable[[Array], Array],
    jacobian: Callable[[Array], Array],
    x: Array,
    lower_bounds: Array,
) -> Array:
    """(p,) where the squares are least, none below its bound [Levenberg-Marquardt, projected].

    x: (p,) to begin with.  lower_bounds: (p,) bounds, -inf where there is none.
    """
    damping, left = START_LEVENBERG_DAMPING, residual(x)
    for _ in range(MAX_LEVENBERG_STEPS):
        slope = jacobian(x)
        pull, gram = slope.T @ left, slope.T @ slope
        for _ in range(MAX_LEVENBERG_STEPS):
            free = (x > lower_bounds) | ~(pull > 0.0)  # the others are held at their bounds
            new = x.copy()
            new[free] -= solve_ridge_normal_equations(gram[np.ix_(free, free)], pull[free], damping)
            new = np.maximum(new, lower_bounds)
            with np.errstate(over="ignore", invalid="ignore"):  # too far a step is refused
                after = residual(new)
                gained = left @ left - after @ after
            if gained >= 0.0:
                break
            damping *= 10.0
        if not gained >= 0.0:
            return x
        x, left, damping = new, after, max(0.1 * damping, MIN_LEVENBERG_DAMPING)
        if gained <= MIN_RELATIVE_SQUARES_FALL * (left @ left):
            break
    return x


def assemble_parameters(
    fit_data: FitData,
    selection: ElementSelection,
    columns: list[ParameterColumn],
    bodies: Array,
    column_values: Array,
    parameters: ModelParameters,
) -> ModelParameters:
    """What was fitted, and the model's own for the rest; all at the joints."""
    own, n = clear_fitted_parameters(fit_data, selection), fit_data.model_parameters.joint_count
    found = {name: getattr(own, name).copy() for name in ("friction", "damping", "armature")}
    found |= {"gain": np.ones(n), "spring": np.zeros((n, POLYNOMIAL_TERMS))}
    for column, one in zip(columns, column_values, strict=True):
        if column.field in found:
            found[column.field][column.index] += one * column.factor
    gain, spring = found.pop("gain"), found.pop("spring")
    stiffness, rest = own.stiffness, own.spring_rest.copy()
    for j in selection.spring_joints if SimulatorElement.SPRINGS in selection.elements else ():
        stiffness[j], rest[j] = spring_from_torque_polynomial(spring[j] / gain[j])
    law = np.array([column.index if column.field == "law" else -1 for column in columns])
    return replace(
        parameters,
        **{name: (one.T / gain).T for name, one in found.items()},
        bodies=bodies,
        stiffness=stiffness,
        spring_rest=rest,
        gain=gain,
        laws=selection.laws,
        law_values=tuple(column_values[law == number] for number in range(len(selection.laws))),
    )


def spring_from_torque_polynomial(torque: Array) -> tuple[Array, float]:
    """Stiffness (3,) of x, x^2, x^3, and where x is 0, of a torque (3,) of 1, q, q^2.

    Of the two angles without torque the one nearer 0; without any, that of least torque.
    """
    offset, slope, bend = torque
    if abs(bend) < 1e-12:
        rest = -offset / slope if abs(slope) > 1e-12 else 0.0
        return np.array([slope, 0.0, 0.0]), float(rest)
    inside = slope**2 - 4.0 * bend * offset
    roots = np.array([-slope + s * np.sqrt(max(inside, 0.0)) for s in (-1.0, 1.0)]) / (2.0 * bend)
    rest = float(roots[np.argmin(np.abs(roots))])
    return np.array([slope + 2.0 * bend * rest, bend, 0.0]), rest


def update_scene_friction(
    fit_data: FitData, scene: ArmMotion, parameters: ModelParameters
) -> ArmMotion:
    """The scene with the load and the friction of some numbers, friction as MuJoCo has it.

    Friction is a soft constraint there: force = D (qdd + b qd) within its largest
    [MuJoCo, Computation: constraint solver].
    """
    scene = scene.with_body(
        share_links_among_joints(fit_data.bodies.link_parameters(parameters.bodies)),
        scene.friction_torque,
    )
    motion, chain, model = scene.logs.motion, fit_data.chain, copy(fit_data.chain.model)

    # The largest friction (M, n) at every sample: of the joint, and of laws that no element holds.
    least = (
        MIN_RELATIVE_FRICTION * np.abs(scene.logs.torque).max(axis=0) * scene.torque_per_log_unit
    )
    whole = np.maximum(parameters.friction, least + 1e-12) + np.zeros_like(motion.q)
    sliding = scene.with_body(scene.inertial_parameters_by_joint, scene.friction_torque)
    vars(sliding)["speed_sign"] = np.ones_like(motion.q)
    for term, value in zip(parameters.laws, parameters.law_values, strict=True):
        if term.law.dry and len(value):
            amount = (term.build_columns(sliding) @ value) * scene.torque_per_log_unit[
                term.joint_index
            ]
            whole[:, term.joint_index] = np.maximum(
                whole[:, term.joint_index] + amount, least[term.joint_index]
            )

    # D [kg m^2] from the inverse inertia of each joint at rest, with these masses; b [1/s].
    dofs = chain.dof_indices
    for body, pseudo in zip(chain.body_ids, parameters.bodies, strict=True):
        values = inertial_attributes(pseudo)
        model.body_mass[body], model.body_ipos[body] = values["mass"][0], values["pos"]
        model.body_iquat[body], model.body_inertia[body] = values["quat"], values["diaginertia"]
    model.dof_armature[dofs] = parameters.armature
    mj = import_mujoco()
    mj.mj_setConst(model, mj.MjData(model))
    weights = np.asarray(np.maximum(model.dof_invweight0[dofs], 1e-15))
    reference, impedance = model.dof_solref[dofs], model.dof_solimp[dofs]
    start, end = np.clip(impedance[:, :2].T, *IMPEDANCE_LIMITS)
    time = np.maximum(reference[:, 0], 2.0 * chain.timestep)
    rate = np.where(reference[:, 0] > 0.0, 2.0 / (end * time), -reference[:, 1] / end)
    stiffness = start / (1.0 - start) / weights
    sense = np.clip(stiffness * (motion.qdd + rate * motion.qd) / whole, -1.0, 1.0)
    vars(scene)["speed_sign"] = np.asarray(sense)
    return scene
