"""Which laws the rows call for: the same evidence as for positions, on whitened rows of torque."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from minimax_cal.dynamics.laws import Term
from minimax_cal.dynamics.rows import Whitening
from minimax_cal.dynamics.scene import Scene
from minimax_cal.evidence.library import Spec
from minimax_cal.evidence.noise import Noise, Problem, orthonormal
from minimax_cal.ground.arrays import Array

RIDGE = 1e-10  # of the squares of a column: keeps a fit of columns alike from running away
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

    def at_all(self, term: Term) -> Array:
        """(n, R, d) of all joints."""
        joints, rows = self.rows_of(term)
        out = np.zeros((self.scene.logs.joints, *rows.shape[1:]))
        out[joints] = rows
        return out

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
        every = (self.at_all(term) for term in terms)
        return np.concatenate([self.rigid, self.usual, *every], axis=2)

    def places(self, terms: Sequence[Term] = ()) -> dict[str, slice]:
        """Which of these columns belong to what."""
        size = {RIGID: self.rigid.shape[2], FRICTION: self.usual.shape[2]}
        size |= {term.text: self.rows_of(term)[1].shape[2] for term in terms}
        ends = np.cumsum([0, *size.values()]).tolist()
        return dict(zip(size, map(slice, ends[:-1], ends[1:]), strict=True))

    @cached_property
    def error(self) -> Array:
        """(n, R) torques less those of what the flange is known to carry."""
        known = self.scene.logs.filtered(self.scene.known_torque)
        return np.asarray((self.scene.logs.y - known).T)


def block_rows(each: Array) -> Array:
    """(n, R, n d) columns (n, R, d) of each joint for itself."""
    n, count, d = each.shape
    out = np.zeros((n, count, n, d))
    out[range(n), :, range(n)] = each
    return out.reshape(n, count, n * d)


def solve_ridged(gram: Array, pull: Array, ridge: float = RIDGE) -> Array:
    """(p,) least squares by products (p, p) with a unit diagonal and (p,)."""
    return np.asarray(np.linalg.solve(gram + ridge * np.eye(len(gram)), pull))


def solve_scaled(gram: Array, pull: Array, ridge: float = RIDGE) -> Array:
    """(p,) least squares by products (p, p) and (p,); columns alike share what they explain.

    ridge: of the products with a unit diagonal.
    """
    scale = np.sqrt(np.maximum(np.diag(gram), 1e-300))
    return np.asarray(solve_ridged(gram / np.outer(scale, scale), pull / scale, ridge) / scale)


def least_squares(columns: Array, error: Array) -> Array:
    """(p,) values of columns (N, p), those alike sharing what they explain."""
    scale = np.maximum(np.linalg.norm(columns, axis=0), 1e-300)
    unit = columns / scale
    return np.asarray(solve_ridged(unit.T @ unit, unit.T @ error) / scale)


@dataclass(frozen=True, eq=False)
class TorqueLaws:
    """The laws of torque as a dictionary, for whitened rows.

    size: (n,) RMS torque of each joint, by which parameters are usual.
    """

    problem: Problem
    columns: Columns
    white: Whitening
    size: Array

    def spec(self, term: Term) -> Spec | None:
        """A law with its columns; None where it adds nothing to any row."""
        joints, rows = self.columns.rows_of(term)
        out = np.zeros((len(self.problem.error), rows.shape[2]))
        for j, part in zip(joints, rows, strict=True):
            out[self.white.joint == j] = self.white.white_joint(int(j), part[self.white.kept[j]])
        if not np.any(out):
            return None
        law, d = term.law, out.shape[1]
        return Spec(
            term=term,
            text=term.text,
            key=term.key,
            columns=out,
            doubts=np.zeros((len(out), 0)),
            owner=np.zeros(0, dtype=int),
            nonnegative=np.full(d, law.nonnegative),
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


def dictionary_of(columns: Columns, white: Whitening) -> TorqueLaws:
    """The dictionary of whitened rows, rigid body and usual friction projected out."""
    nuisance = white.white(columns.design()[white.kept])
    error = white.white(columns.error[white.kept])
    logs = columns.scene.logs
    group = np.broadcast_to(logs.quarter, white.kept.shape)[white.kept]
    problem = Problem(
        error=error,
        basis=orthonormal(nuisance),
        variance_ratio=np.zeros(len(error)),
        size=1.0,
        group=np.unique(group, return_inverse=True)[1],
        measured=np.ones(len(error), dtype=bool),
        exact=0.0,
    )
    return TorqueLaws(problem, columns, white, np.sqrt((logs.y**2).mean(axis=0)))


def one_of_each(columns: Columns, terms: Sequence[Term]) -> Array:
    """(n, R, p) rigid body, usual friction, one variant of every law, and all that runs carry."""
    first = {t.text if t.effect == "payload" else t.key: t for t in reversed(terms)}
    return columns.design(list(first.values()))


def generous(columns: Columns, terms: Sequence[Term]) -> Array:
    """(N,) what a fit of one variant of every law leaves: noise, were one of them true."""
    kept = columns.scene.logs.fitted.T
    matrix = one_of_each(columns, terms)[kept]
    error = columns.error[kept]
    return np.asarray(error - matrix @ least_squares(matrix, error))
