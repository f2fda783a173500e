"""A model of joint torques: rigid body, usual friction and named laws, and its fit."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from minimax_cal.dynamics.laws import Term
from minimax_cal.dynamics.rows import Whitening
from minimax_cal.dynamics.scene import YIELD, Arm, Scene
from minimax_cal.dynamics.search import (
    FRICTION,
    RIDGE,
    RIGID,
    Columns,
    least_squares,
    solve_scaled,
)
from minimax_cal.ground.arrays import Array


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
        group = np.broadcast_to(columns.scene.logs.quarter, kept.shape)[kept]
        return Normal(columns, white, tuple(terms), raw, white.white(raw[kept]),
                      white.white(columns.error[kept]), columns.places(terms), group)  # fmt: skip

    def index(self, parts: Sequence[str]) -> Array:
        """(q,) columns of some parts."""
        return np.concatenate([np.arange(self.matrix.shape[1])[self.place[p]] for p in parts])

    @cached_property
    def gram(self) -> Array:
        """(p, p) products of the columns."""
        return np.asarray(self.matrix.T @ self.matrix)

    @cached_property
    def pull(self) -> Array:
        """(p,) products of columns and error."""
        return np.asarray(self.matrix.T @ self.error)

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
        value = self.solve([RIGID, FRICTION, *(t.text for t in terms)])
        found = tuple(FittedTerm(**vars(t), value=value[self.place[t.text]]) for t in terms)
        bristles = self.columns.scene.bristles
        held = held_friction(bristles, (self.columns.error - self.raw @ value).T)
        return TorqueModel(name, self.body(value), found, context, held, delay)

    def rigid_model(self, name: str, context: Body) -> TorqueModel:
        """The fit of the rigid body alone."""
        body = self.body(self.solve([RIGID]))
        return TorqueModel(name, body, (), context, np.zeros((len(body.usual), len(YIELD))), 0.0)


def held_friction(bent: Array, off: Array) -> Array:
    """(n, 2) friction of bristles (R, n, 2) by what a fit misses (R, n); none below 0."""
    gram, pull = np.einsum("rjk,rjl->jkl", bent, bent), np.einsum("rjk,rj->jk", bent, off)
    size = np.maximum(np.einsum("jkk->jk", gram), 1e-300)
    one = np.maximum(pull / size, 0.0)
    alone = np.where(np.arange(2) == (one * pull).argmax(axis=1)[:, None], one, 0.0)
    both = np.array([solve_scaled(*each) for each in zip(gram, pull, strict=True)])
    return np.where((both >= 0.0).all(axis=1, keepdims=True), both, alone)


def first_body(columns: Columns) -> Body:
    """Rigid body and usual friction by plain least squares on the rows that are fitted."""
    kept = columns.scene.logs.fitted.T
    value = least_squares(columns.design()[kept], columns.error[kept])
    return Body.of(columns.scene.arm, *np.split(value, [columns.rigid.shape[2]]))
