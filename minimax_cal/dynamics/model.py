"""Columns of joint torque: rigid body, usual friction, laws; their fits and the search among them.

Laws are sought by the same evidence as for positions, on whitened rows.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from minimax_cal.dynamics.laws import Term
from minimax_cal.dynamics.rows import Arm, Scene, Whitening, sense_of, whitening
from minimax_cal.evidence.library import Spec
from minimax_cal.evidence.noise import Noise, Problem, orthonormal
from minimax_cal.ground.arrays import Array
from minimax_cal.ground.linear_algebra import project_out

RIDGE = 1e-10  # of the squares of a column: keeps a fit of columns alike from running away
SOFTER = np.geomspace(0.005, 0.1, 9)  # of a joint's largest speed
NEAR = np.geomspace(0.7, 1.4, 9)  # of the best of these: a second, finer look
WORTH = 0.15  # of the square of the remaining error that a softer friction must close
RIGID, FRICTION = "rigid", "usual"  # parts of a fit beside the laws


@dataclass(frozen=True, eq=False)
class Columns:
    """Filtered columns of a scene, each law's computed once.

    stored: by the text of a term, its joints (k,) and its rows (k, R, d).
    """

    scene: Scene
    stored: dict[str, tuple[Array, Array]] = field(default_factory=dict)

    def rows_of(self, term: Term) -> tuple[Array, Array]:
        """The joints (k,) whose rows a law adds to, and what it adds (k, R, d)."""
        if term.text not in self.stored:
            rows = self.scene.logs.filtered(term.columns(self.scene))
            whole = rows.ndim == 3
            joints = np.arange(self.scene.logs.joints) if whole else np.array([term.joint])
            self.stored[term.text] = joints, np.moveaxis(rows, 1, 0) if whole else rows[None]
        return self.stored[term.text]

    @cached_property
    def rigid(self) -> Array:
        """(n, R, p) of the rigid body; of each joint for itself where they share no parameters."""
        base = np.moveaxis(self.scene.base_rows, 1, 0)
        return base if self.scene.arm.shared else block_rows(base)

    @cached_property
    def usual(self) -> Array:
        """(n, R, 2 n) Coulomb and viscous friction of every joint."""
        qd = self.scene.logs.motion.qd
        both = self.scene.logs.filtered(np.stack([self.scene.sense, qd], axis=-1))
        return block_rows(np.moveaxis(both, 1, 0))

    @cached_property
    def links(self) -> Array:
        """(n, R, 10 n) of the inertial parameters of all links."""
        return np.moveaxis(self.scene.logs.filtered(self.scene.regressor), 1, 0)

    def design(self, terms: Sequence[Term] = ()) -> Array:
        """(n, R, p) rigid body, usual friction and some laws: the columns of every fit."""
        parts = [self.rigid, self.usual]
        for term in terms:
            joints, rows = self.rows_of(term)
            part = np.zeros((self.scene.logs.joints, *rows.shape[1:]))
            part[joints] = rows
            parts.append(part)
        return np.concatenate(parts, axis=2)

    @cached_property
    def error(self) -> Array:
        """(n, R) torques less those of what the flange is known to carry."""
        known = self.scene.logs.filtered(self.scene.known_torque)
        return (self.scene.logs.y - known).T

    def of_each(self, terms: Sequence[Term]) -> Array:
        """(n, R, p) rigid body, usual friction, a variant of every law, and all that runs carry."""
        first = {t.text if t.effect == "payload" else t.key: t for t in reversed(terms)}
        return self.design(list(first.values()))

    def soften_friction(self, terms: Sequence[Term]) -> Array:
        """(n,) speeds over which friction changes its sign; as they are where that is soft enough.

        Simulators make it soft, and gears with much play.  A friction that is softer than it is
        drawn to be looks like a force without a law; one column beside all that is named says so.
        terms: what is named.
        """
        arm, logs = self.scene.arm, self.scene.logs
        soft, design = arm.soft.copy(), self.design(terms)
        for j in range(logs.joints):
            rows, qd = logs.fitted[:, j], logs.motion.qd[:, j, None]
            beside = design[j, rows]
            if np.count_nonzero(rows) < 2 * beside.shape[1]:
                continue
            beside[:, self.rigid.shape[2] + 2 * j] = 0.0  # the Coulomb friction of this joint
            basis = orthonormal(beside)
            left = project_out(self.error[j, rows], basis)
            as_it_is = np.array([arm.soft[j]])
            rough = arm.fastest[j] * SOFTER
            remaining, speeds = [], [as_it_is, rough]
            for number in range(3):  # as it is, softer, and finer about the best of these
                sense = logs.filtered(sense_of(qd, speeds[number]))[rows]
                sense = project_out(sense, basis)
                size = np.maximum((sense**2).sum(axis=0), 1e-300)
                remaining.append(float(left @ left) - (left @ sense) ** 2 / size)
                if number == 1:
                    speeds.append(rough[np.argmin(remaining[1])] * NEAR)
            if remaining[2].min() < (1.0 - WORTH) * remaining[0][0]:
                soft[j] = max(soft[j], speeds[2][np.argmin(remaining[2])])
        return soft

    def whitening(self, terms: Sequence[Term]) -> Whitening:
        """By what a fit of one variant of every law leaves: noise, were one of them true."""
        kept = self.scene.logs.fitted.T
        matrix, error = self.of_each(terms)[kept], self.error[kept]
        return whitening(self.scene.logs, error - matrix @ least_squares(matrix, error))


def block_rows(each: Array) -> Array:
    """(n, R, n d) columns (n, R, d) of each joint for itself."""
    n, count, d = each.shape
    out = np.zeros((n, count, n, d))
    out[range(n), :, range(n)] = each
    return out.reshape(n, count, n * d)


def solve_scaled(gram: Array, pull: Array, ridge: float = RIDGE) -> Array:
    """(p,) least squares by products (p, p) and (p,); columns alike share what they explain.

    ridge: of the products with a unit diagonal.
    """
    scale = np.sqrt(np.maximum(np.diag(gram), 1e-300))
    unit = gram / np.outer(scale, scale) + ridge * np.eye(len(gram))
    return np.asarray(np.linalg.solve(unit, pull / scale) / scale)


def least_squares(columns: Array, error: Array) -> Array:
    """(p,) values of columns (N, p), those alike sharing what they explain."""
    scale = np.maximum(np.linalg.norm(columns, axis=0), 1e-300)
    unit = columns / scale
    gram = unit.T @ unit + RIDGE * np.eye(unit.shape[1])
    return np.asarray(np.linalg.solve(gram, unit.T @ error) / scale)


@dataclass(frozen=True, eq=False)
class TorqueLaws:
    """The laws of torque as a dictionary, for whitened rows.

    size: (n,) RMS torque of each joint, by which parameters are usual.
    """

    problem: Problem
    columns: Columns
    white: Whitening
    size: Array

    @staticmethod
    def of(columns: Columns, white: Whitening) -> TorqueLaws:
        """Of whitened rows, rigid body and usual friction projected out."""
        logs, error = columns.scene.logs, white.white(columns.error[white.kept])
        problem = Problem(
            error=error, basis=orthonormal(white.white(columns.design()[white.kept])),
            variance_ratio=np.zeros(len(error)), size=1.0,
            group=np.unique(white.rows(logs.quarter), return_inverse=True)[1],
            measured=np.ones(len(error), dtype=bool), exact=0.0,
        )  # fmt: skip
        return TorqueLaws(problem, columns, white, np.sqrt((logs.y**2).mean(axis=0)))

    def spec(self, term: Term) -> Spec | None:
        """A law with its columns; None where it adds nothing to any row."""
        joints, rows = self.columns.rows_of(term)
        out = np.zeros((len(self.problem.error), rows.shape[2]))
        for j, part in zip(joints, rows, strict=True):
            out[self.white.joint == j] = self.white.white_joint(int(j), part[self.white.kept[j]])
        if not np.any(out):
            return None
        law, count = term.law, len(out)
        return Spec(
            term=term,
            text=term.text,
            key=term.key,
            columns=out,
            doubts=np.zeros((count, 0)),
            owner=np.zeros(0, dtype=int),
            nonnegative=np.full(out.shape[1], law.nonnegative),
            typical=law.typical * (self.size[term.joint] if law.of_torque else 1.0),
            tuned=len(term.tuned),
            repeats=law.repeats,
        )

    def finer(self, term: Term) -> list[Term]:
        """The law with its tuned number closer together."""
        return term.finer()

    def lines(self, noise: Noise, known: Array, found: Sequence[Term]) -> list[tuple[Term, float]]:
        """None: the waves of gears are tried at their ratios."""
        return []

    def is_expected(self, line: Term, found: Sequence[Term]) -> bool:
        """There are none."""
        return False


# ---- fits ----------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Body:
    """What fitted numbers say of the arm itself.

    rigid: (n, 10 n) inertial parameters by joint, or (1, 10 n) where joints share them.
    usual: (n, 2) Coulomb [unit of the log] and viscous friction [the same, s/rad].
    """

    rigid: Array
    usual: Array

    @staticmethod
    def of(arm: Arm, rigid: Array, usual: Array) -> Body:
        """Of fitted base parameters and friction (2 n,); the body is the nearest to the drawing."""
        each = rigid.reshape(-1, arm.base.shape[1])
        near = arm.drawn + (each - arm.base.T @ arm.drawn) @ arm.base.T
        return Body(near, usual.reshape(-1, 2))

    @staticmethod
    def fit_with_friction(scene: Scene) -> Body:
        """Rigid body and usual friction by plain least squares on the rows that are fitted."""
        columns, kept = Columns(scene), scene.logs.fitted.T
        value = least_squares(columns.design()[kept], columns.error[kept])
        return Body.of(scene.arm, *np.split(value, [columns.rigid.shape[2]]))

    def build_columns(self, scene: Scene) -> Columns:
        """Columns of a scene with this load and friction."""
        return Columns(self.in_scene(scene))

    def in_scene(self, scene: Scene) -> Scene:
        """A scene with this load and friction."""
        coulomb, viscous = self.usual.T
        friction = scene.sense * coulomb + scene.logs.motion.qd * viscous
        return scene.with_body(np.broadcast_to(self.rigid, scene.rigid.shape), friction)


@dataclass(frozen=True, eq=False)
class FittedTerm(Term):
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
    body: Body
    terms: tuple[FittedTerm, ...]
    context: Body
    held: Array
    delay: float

    def predict(self, columns: Columns) -> Array:
        """(R, n) torques in the unit of the log.  columns: of a scene with this context."""
        scene = columns.scene
        base = np.broadcast_to(self.body.rigid, scene.rigid.shape) @ scene.arm.base
        rigid = np.einsum("rjp,jp->jr", scene.base_rows, base)
        friction = columns.usual @ self.body.usual.ravel()
        out = rigid + friction + scene.logs.filtered(scene.known_torque).T
        for term in self.terms:
            joints, rows = columns.rows_of(term)
            out[joints] += rows @ term.value
        return np.asarray(out.T + (self.held * scene.bristles).sum(axis=-1))


@dataclass(frozen=True, eq=False)
class Normal:
    """Whitened rows of rigid body, usual friction and laws, ready for fits of any of their columns.

    raw: (n, R, p) of all rows, not whitened.  matrix: (N, p).  error: (N,).  place: which columns
    belong to what.  group: (N,).
    """

    columns: Columns
    white: Whitening
    terms: tuple[Term, ...]
    raw: Array
    matrix: Array
    error: Array
    place: dict[str, slice]
    group: Array

    @staticmethod
    def of(columns: Columns, white: Whitening, terms: Sequence[Term]) -> Normal:
        """Of all rows that are fitted."""
        raw, kept = columns.design(terms), white.kept
        sizes = {RIGID: columns.rigid.shape[2], FRICTION: columns.usual.shape[2]}
        sizes |= {term.text: columns.rows_of(term)[1].shape[2] for term in terms}
        ends = np.cumsum([0, *sizes.values()]).tolist()
        place = dict(zip(sizes, map(slice, ends[:-1], ends[1:]), strict=True))
        return Normal(columns, white, tuple(terms), raw, white.white(raw[kept]),
                      white.white(columns.error[kept]), place,
                      white.rows(columns.scene.logs.quarter))  # fmt: skip

    @staticmethod
    def fit_whitened(columns: Columns, terms: Sequence[Term]) -> Normal:
        """Of some laws, whitened by what their own fit leaves [feasible generalised least squares].

        columns: of the rows.
        """
        rough = Normal.of(columns, columns.whitening(terms), terms)
        rest = rough.rest(rough.solve(rough.parts))
        return Normal.of(columns, whitening(columns.scene.logs, rest), terms)

    @property
    def parts(self) -> list[str]:
        """Rigid body, usual friction and all laws."""
        return parts_of(self.terms)

    def index(self, parts: Sequence[str]) -> Array:
        """(q,) columns of some parts."""
        return np.concatenate([np.arange(self.matrix.shape[1])[self.place[p]] for p in parts])

    @cached_property
    def gram(self) -> Array:
        """(p, p) products of the columns."""
        return self.matrix.T @ self.matrix

    @cached_property
    def pull(self) -> Array:
        """(p,) products of columns and error."""
        return self.matrix.T @ self.error

    def solve(self, parts: Sequence[str]) -> Array:
        """(p,) values of some parts, 0 elsewhere."""
        index = self.index(parts)
        out = np.zeros(len(self.gram))
        out[index] = solve_scaled(self.gram[np.ix_(index, index)], self.pull[index])
        return out

    def rest(self, value: Array) -> Array:
        """(N,) what values leave of the rows, not whitened."""
        kept = self.white.kept
        return np.asarray(self.columns.error[kept] - self.raw[kept] @ value)

    def spread(self, parts: Sequence[str], value: Array) -> Array:
        """(p,) standard deviations of the values of some parts, of rows that err by groups.

        The larger of that of white noise and of the sandwich over groups [Liang and Zeger 1986].
        """
        index = self.index(parts)
        gram = self.gram[np.ix_(index, index)]
        scale = np.sqrt(np.maximum(np.diag(gram), 1e-300))
        unit = gram / np.outer(scale, scale) + RIDGE * np.eye(len(index))
        inverse = cho_solve(cho_factor(unit), np.eye(len(index)))
        rest = self.error - self.matrix @ value
        dof = max(len(rest) - len(index), 1)
        count = int(self.group.max()) + 1
        score = np.array([rest[self.group == g] @ self.matrix[self.group == g][:, index]
                          for g in range(count)]) / scale @ inverse  # fmt: skip
        sandwich = (score**2).sum(axis=0) * count / max(count - 1, 1)
        plain = np.diag(inverse) * float(rest @ rest) / dof
        out = np.zeros(len(value))
        out[index] = np.sqrt(np.maximum(sandwich, plain)) / scale
        return out

    def body(self, value: Array) -> Body:
        """Rigid body and friction of values (p,)."""
        parts = (value[self.place[part]] for part in (RIGID, FRICTION))
        return Body.of(self.columns.scene.arm, *parts)

    def model(self, name: str, terms: Sequence[Term], context: Body, delay: float) -> TorqueModel:
        """The fit of rigid body, usual friction and some laws."""
        value = self.solve(parts_of(terms))
        found = tuple(FittedTerm(**vars(t), value=value[self.place[t.text]]) for t in terms)
        bristles = self.columns.scene.bristles
        held = held_friction(bristles, (self.columns.error - self.raw @ value).T)
        return TorqueModel(name, self.body(value), found, context, held, delay)


def parts_of(terms: Sequence[Term]) -> list[str]:
    """The parts of a fit with usual friction and some laws."""
    return [RIGID, FRICTION, *(term.text for term in terms)]


def held_friction(bent: Array, off: Array) -> Array:
    """(n, 2) friction of bristles (R, n, 2) by what a fit misses (R, n); none below 0."""
    gram, pull = np.einsum("rjk,rjl->jkl", bent, bent), np.einsum("rjk,rj->jk", bent, off)
    size = np.maximum(np.einsum("jkk->jk", gram), 1e-300)
    one = np.maximum(pull / size, 0.0)
    alone = np.where(np.arange(2) == (one * pull).argmax(axis=1)[:, None], one, 0.0)
    both = np.array([solve_scaled(*each) for each in zip(gram, pull, strict=True)])
    return np.where((both >= 0.0).all(axis=1, keepdims=True), both, alone)
