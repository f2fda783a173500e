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

from minimax_cal.dynamics.laws import CURVE, Element, Term
from minimax_cal.dynamics.model import Columns, solve_scaled
from minimax_cal.dynamics.regressor import PER_LINK
from minimax_cal.dynamics.rows import Arm, Logs, Scene, Whitening
from minimax_cal.ground.arrays import Array
from minimax_cal.robots.mjcf import mujoco
from minimax_cal.simulators.chain import Chain
from minimax_cal.simulators.motion.numbers import (
    POWERS,
    Bodies,
    Numbers,
    given_numbers,
    inertial,
    physical,
)

PRIOR = 0.5  # standard deviation of a body's log-Cholesky coordinates about the model's
PRIOR_ASSUMED = 1.5  # the same where the masses of the model are assumed
ROTOR = 0.5  # of the inertia by links, or torque / acceleration: deviation of an armature
LEVELS_OFF = (0.5, 0.7, 1.0, 1.4)  # of a joint's largest speed, where damping levels off
ROUNDS = 3  # of fits, each with the load and the friction of the one before
STEPS = 60  # of a fit, and trials of a step
FIRST_DAMPING, LEAST_DAMPING = 1e-4, 1e-9  # of the normal matrix with a unit diagonal
CLOSE = 1e-7  # relative fall of the squares that ends a fit
IMPEDANCES = (1e-4, 0.9999)  # least and largest that MuJoCo takes [mjMINIMP, mjMAXIMP]
LEAST_FRICTION = 1e-6  # of a joint's largest torque: a smaller one has no say


@dataclass(frozen=True, eq=False)
class Asked:
    """What is fitted; the rest stays as the model has it.

    elements: of those above.  link: the only one whose masses change, -1 for all.
    curved: joints whose damping levels off.  sprung, geared: joints with a spring, or whose drive
    gain is off.  laws: that no element holds: masses and armature are fitted with them first, and
    kept.  bent: powers of the angle in a spring's torque.
    """

    elements: frozenset[Element]
    link: int = -1
    curved: tuple[int, ...] = ()
    sprung: tuple[int, ...] = ()
    geared: tuple[int, ...] = ()
    laws: tuple[Term, ...] = ()
    late: float = 0.0
    bent: int = POWERS - 1

    def without(self, element: Element) -> Asked:
        """All but one element."""
        return replace(self, elements=self.elements - {element})

    def without_law(self, effect: str) -> Asked:
        """All but the laws of one effect."""
        return replace(self, laws=tuple(term for term in self.laws if term.effect != effect))


@dataclass(frozen=True, eq=False)
class Column:
    """A number of one joint.  rows: (M,) torque of the log per unit.

    field, at, by: what it adds to of `Numbers`, there, per unit.  low: its least value.  mean, sd:
    of its prior, sd infinite for none.
    """

    field: str
    joint: int
    rows: Array
    at: Any
    by: Array | float = 1.0
    low: float = 0.0
    mean: float = 0.0
    sd: float = np.inf


@dataclass(frozen=True, eq=False)
class Study:
    """Logs to learn from, and the arm of a model.

    scene: of these logs.  inertia: (n,) largest about each joint [kg m^2].  links: (N, 10 n)
    whitened rows of the links' parameters.  prior: of the bodies.  terms: laws of a diagnosis.
    """

    chain: Chain
    bodies: Bodies
    given: Numbers
    scene: Scene
    white: Whitening
    links: Array
    inertia: Array
    prior: float
    terms: tuple[Term, ...]

    @staticmethod
    def of(chain: Chain, arm: Arm, logs: Logs, terms: tuple[Term, ...], inertia: Array,
           prior: float) -> Study:  # fmt: skip
        """Of the logs to learn from."""
        bodies, scene = Bodies.of(chain), Scene.of(arm, logs)
        given = given_numbers(chain, bodies)
        columns = Columns(scene.with_body(of_all(bodies.links(given.bodies)), scene.friction))
        white = columns.whitening(terms)
        links = white.white(columns.links[white.kept])
        return Study(chain, bodies, given, columns.scene, white, links, inertia, prior, terms)

    def only(self, runs: Sequence[int]) -> Study:
        """Of some of the runs."""
        arm, logs = self.scene.arm, self.scene.logs.only(runs)
        return Study.of(self.chain, arm, logs, self.terms, self.inertia, self.prior)

    def error(self, late: float) -> Array:
        """(N,) whitened torques less those of a known payload; so much earlier [s]."""
        logs = self.scene.logs.earlier(late) if late else self.scene.logs
        known = logs.filtered(self.scene.known_torque)
        return self.white.white((logs.y - known).T[self.white.kept])

    def with_masses(self, found: Numbers) -> Study:
        """The same logs, for a model that has masses and armature already."""
        own = np.array([physical(body) for body in found.bodies])
        bodies = replace(self.bodies, drawn=own)
        given = replace(self.given, bodies=own, armature=found.armature)
        scene = self.scene.with_body(of_all(bodies.links(own)), self.scene.friction)
        return replace(self, bodies=bodies, given=given, scene=scene)


def of_all(links: Array) -> Array:
    """(n, 10 n) parameters that all joints share, of links (n, 10)."""
    return np.broadcast_to(links.ravel(), (len(links), links.size))


def fit_numbers(study: Study, asked: Asked) -> Numbers:
    """The numbers that the logs show."""
    if asked.laws:
        curved = any(term.law.family == CURVE for term in asked.laws)  # which says it better
        first = fit_elements(study, asked.without(Element.LEVELLED) if curved else asked)
        study = study.with_masses(first)
        asked = replace(asked, laws=()).without(Element.MASSES).without(Element.ARMATURE)
    return fit_elements(study, asked)


def fit_elements(study: Study, asked: Asked) -> Numbers:
    """All that is asked for, in one fit that is repeated with its own load and friction."""
    scene, numbers = study.scene, study.given
    late = asked.late if Element.DELAY in asked.elements else 0.0
    error = study.error(late)
    for _ in range(ROUNDS):
        columns = list(columns_of(study, scene, asked))
        numbers = solved(study, scene, asked, columns, error, replace(numbers, late=late))
        scene = with_numbers(study, scene, numbers)
    return numbers


def columns_of(study: Study, scene: Scene, asked: Asked) -> Iterator[Column]:
    """The numbers that are linear, each of one joint."""
    motion, unit, given = scene.logs.motion, scene.divisor, study.given
    for j in range(given.joints):
        qd, qdd = motion.qd[:, j], motion.qdd[:, j]
        if Element.FRICTION in asked.elements:
            yield Column("friction", j, scene.sense[:, j] / unit[j], j)
            yield Column("damping", j, qd / unit[j], (j, 0))
        if Element.LEVELLED in asked.elements and j in asked.curved:
            for share in LEVELS_OFF:
                powers = levelling(share * scene.arm.fastest[j])
                yield Column("damping", j, speeds(qd) @ powers / unit[j], j, powers)
        if Element.ARMATURE in asked.elements:
            whole = unit[j] * np.abs(scene.logs.torque[:, j]).max() / np.abs(qdd).max()
            doubt = max(given.armature[j], ROTOR * study.inertia[j], ROTOR * whole)
            yield Column("armature", j, qdd / unit[j], j, mean=given.armature[j], sd=doubt)
        if Element.SPRINGS in asked.elements and j in asked.sprung:
            for power in range(asked.bent + 1):
                rows = motion.q[:, j] ** power / unit[j]
                yield Column("spring", j, rows, (j, power), low=-np.inf)
        if Element.GAIN in asked.elements and j in asked.geared:
            yield Column("gain", j, scene.load[:, j], j, low=-np.inf)
    for number, term in enumerate(asked.laws):
        low = 0.0 if term.law.nonnegative else -np.inf
        for rows in term.columns(scene).T:
            yield Column("law", term.joint, rows, number, low=low)


def speeds(qd: Array) -> Array:
    """(M, 3) powers of a speed as MuJoCo's damping takes them."""
    return np.stack([qd, qd * np.abs(qd), qd**3], axis=-1)


def levelling(speed: float) -> Array:
    """(3,) damping whose slope falls to 0 at a speed, and is negative nowhere."""
    return np.array([1.0, -1.0 / speed, 1.0 / (3.0 * speed**2)])


def kept_numbers(study: Study, asked: Asked) -> Numbers:
    """The model's own numbers, 0 where they are fitted."""
    given, fitted = study.given, asked.elements
    own, free = Element.FRICTION not in fitted, asked.sprung if Element.SPRINGS in fitted else ()
    stiffness = given.stiffness.copy()
    stiffness[list(free)] = 0.0
    return replace(
        given,
        friction=given.friction * own,
        damping=given.damping * own,
        armature=given.armature * (Element.ARMATURE not in fitted),
        stiffness=stiffness,
    )


def solved(
    study: Study,
    scene: Scene,
    asked: Asked,
    columns: list[Column],
    error: Array,
    before: Numbers,
) -> Numbers:
    """One fit, with the load and the friction of the scene."""
    logs, white = scene.logs, study.white
    kept = white.joint
    rows = logs.filtered(np.array([column.rows for column in columns]).T.reshape(
        len(logs.since), len(columns)))  # fmt: skip
    matrix = np.zeros((len(kept), len(columns)))
    for k, column in enumerate(columns):
        some = rows[white.kept[column.joint], k]
        matrix[kept == column.joint, k] = white.white_joint(column.joint, some)

    # Torque of what the model has and is not fitted [N m].
    own, motion = kept_numbers(study, asked), study.scene.logs.motion
    fixed = own.friction * study.scene.sense + own.armature * motion.qdd
    fixed += np.einsum("mjp,jp->mj", speeds(motion.qd), own.damping)
    x = motion.q - own.rest
    fixed = sum((own.stiffness[:, p] * x ** (p + 1) for p in range(POWERS)), fixed)
    fixed = logs.filtered(fixed / scene.divisor)
    right = error - white.white(fixed.T[white.kept])
    triangle = np.asarray(np.linalg.qr(np.hstack([study.links, matrix, right[:, None]]), mode="r"))
    split = study.links.shape[1]
    links, linear, right = triangle[:, :split], triangle[:, split:-1], triangle[:, -1]
    bodies, value = joint_fit(study, asked, columns, (links, linear, right))
    return numbers_of(study, asked, columns, bodies, value, before)


def joint_fit(
    study: Study, asked: Asked, columns: list[Column], rows: tuple[Array, Array, Array]
) -> tuple[Array, Array]:
    """Bodies (n, 4, 4) and linear numbers (k,) that explain condensed rows best."""
    links, linear, right = rows
    n, k = len(study.bodies.drawn), len(columns)
    free = np.zeros((n, PER_LINK), dtype=bool)
    if Element.MASSES in asked.elements:
        free[:] = np.arange(n)[:, None] == asked.link if asked.link >= 0 else True
    mean, sd, low = (np.array([getattr(c, name) for c in columns]).reshape(k)
                     for name in ("mean", "sd", "low"))  # fmt: skip
    count = int(free.sum())

    least = np.concatenate([np.full(count, -np.inf), low])
    weight = np.concatenate([np.full(count, 1.0 / study.prior), 1.0 / sd])
    middle = np.concatenate([np.zeros(count), mean])

    def coordinates(x: Array) -> Array:
        out = np.zeros((n, PER_LINK))
        out[free] = x[:count]
        return out

    def residual(x: Array) -> Array:
        bodies = study.bodies.at(coordinates(x))
        left = links @ study.bodies.links(bodies).ravel() + linear @ x[count:] - right
        return np.concatenate([left, (x - middle) * weight])

    def jacobian(x: Array) -> Array:
        slopes = study.bodies.slopes(coordinates(x))
        by_body = np.einsum("rlp,lkp->rlk", links.reshape(len(links), n, PER_LINK), slopes)
        top = np.hstack([by_body.reshape(len(links), -1)[:, free.ravel()], linear])
        return np.vstack([top, np.diag(weight)])

    beside = np.arange(len(middle)) >= count
    x = np.maximum(middle, least)  # first what fits the drawn bodies: else link 2 takes J1's rotor
    x = least_within(residual, lambda x: jacobian(x) * beside, x, least)
    x = least_within(residual, jacobian, x, least)
    return study.bodies.at(coordinates(x)) if count else study.bodies.drawn, x[count:]


def least_within(
    residual: Callable[[Array], Array],
    jacobian: Callable[[Array], Array],
    x: Array,
    least: Array,
) -> Array:
    """(p,) where the squares are least, none below its bound [Levenberg-Marquardt, projected].

    x: (p,) to begin with.  least: (p,) bounds, -inf where there is none.
    """
    damping, left = FIRST_DAMPING, residual(x)
    for _ in range(STEPS):
        slope = jacobian(x)
        pull, gram = slope.T @ left, slope.T @ slope
        for _ in range(STEPS):
            free = (x > least) | ~(pull > 0.0)  # the others are held at their bounds
            new = x.copy()
            new[free] -= solve_scaled(gram[np.ix_(free, free)], pull[free], damping)
            new = np.maximum(new, least)
            with np.errstate(over="ignore", invalid="ignore"):  # too far a step is refused
                after = residual(new)
                gained = left @ left - after @ after
            if gained >= 0.0:
                break
            damping *= 10.0
        if not gained >= 0.0:
            return x
        x, left, damping = new, after, max(0.1 * damping, LEAST_DAMPING)
        if gained <= CLOSE * (left @ left):
            break
    return x


def numbers_of(
    study: Study,
    asked: Asked,
    columns: list[Column],
    bodies: Array,
    value: Array,
    before: Numbers,
) -> Numbers:
    """What was fitted, and the model's own for the rest; all at the joints."""
    own, n = kept_numbers(study, asked), study.given.joints
    found = {name: getattr(own, name).copy() for name in ("friction", "damping", "armature")}
    found |= {"gain": np.ones(n), "spring": np.zeros((n, POWERS))}
    for column, one in zip(columns, value, strict=True):
        if column.field in found:
            found[column.field][column.at] += one * column.by
    gain, spring = found.pop("gain"), found.pop("spring")
    stiffness, rest = own.stiffness, own.rest.copy()
    for j in asked.sprung if Element.SPRINGS in asked.elements else ():
        stiffness[j], rest[j] = spring_of(spring[j] / gain[j])
    law = np.array([column.at if column.field == "law" else -1 for column in columns])
    return replace(
        before,
        **{name: (one.T / gain).T for name, one in found.items()},
        bodies=bodies,
        stiffness=stiffness,
        rest=rest,
        gain=gain,
        laws=asked.laws,
        value=tuple(value[law == number] for number in range(len(asked.laws))),
    )


def spring_of(torque: Array) -> tuple[Array, float]:
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


def with_numbers(study: Study, scene: Scene, numbers: Numbers) -> Scene:
    """The scene with the load and the friction of some numbers, friction as MuJoCo has it.

    Friction is a soft constraint there: force = D (qdd + b qd) within its largest
    [MuJoCo, Computation: constraint solver].
    """
    scene = scene.with_body(of_all(study.bodies.links(numbers.bodies)), scene.friction)
    motion, chain, model = scene.logs.motion, study.chain, copy(study.chain.model)

    # The largest friction (M, n) at every sample: of the joint, and of laws that no element holds.
    least = LEAST_FRICTION * np.abs(scene.logs.torque).max(axis=0) * scene.divisor
    whole = np.maximum(numbers.friction, least + 1e-12) + np.zeros_like(motion.q)
    sliding = scene.with_body(scene.rigid, scene.friction)
    vars(sliding)["sense"] = np.ones_like(motion.q)
    for term, value in zip(numbers.laws, numbers.value, strict=True):
        if term.law.dry and len(value):
            amount = (term.columns(sliding) @ value) * scene.divisor[term.joint]
            whole[:, term.joint] = np.maximum(whole[:, term.joint] + amount, least[term.joint])

    # D [kg m^2] from the inverse inertia of each joint at rest, with these masses; b [1/s].
    dofs = chain.dofs
    for body, pseudo in zip(chain.bodies, numbers.bodies, strict=True):
        values = inertial(pseudo)
        model.body_mass[body], model.body_ipos[body] = values["mass"][0], values["pos"]
        model.body_iquat[body], model.body_inertia[body] = values["quat"], values["diaginertia"]
    model.dof_armature[dofs] = numbers.armature
    mj = mujoco()
    mj.mj_setConst(model, mj.MjData(model))
    weights = np.asarray(np.maximum(model.dof_invweight0[dofs], 1e-15))
    reference, impedance = model.dof_solref[dofs], model.dof_solimp[dofs]
    start, end = np.clip(impedance[:, :2].T, *IMPEDANCES)
    time = np.maximum(reference[:, 0], 2.0 * chain.step)
    rate = np.where(reference[:, 0] > 0.0, 2.0 / (end * time), -reference[:, 1] / end)
    stiffness = start / (1.0 - start) / weights
    sense = np.clip(stiffness * (motion.qdd + rate * motion.qd) / whole, -1.0, 1.0)
    vars(scene)["sense"] = np.asarray(sense)
    return scene
