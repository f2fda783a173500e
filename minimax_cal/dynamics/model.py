"""Columns of joint torque: rigid body, usual friction, laws; their fits and the search among them.

Laws are sought by the same evidence as for positions, on whitened rows.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import combinations

import numpy as np
from scipy.linalg import block_diag, cho_factor, cho_solve
from scipy.special import fdtrc

from minimax_cal.dynamics.laws import Term
from minimax_cal.dynamics.regressor import PER_LINK
from minimax_cal.dynamics.rows import YIELD, Arm, Scene, Whitening, sense_of, whitening
from minimax_cal.evidence.library import Spec
from minimax_cal.evidence.noise import Noise, Problem, inflation, orthonormal
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
        return (self.scene.logs.y - known).T

    def of_each(self, terms: Sequence[Term]) -> Array:
        """(n, R, p) rigid body, usual friction, a variant of every law, and all that runs carry."""
        first = {t.text if t.effect == "payload" else t.key: t for t in reversed(terms)}
        return self.design(list(first.values()))

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


def solve_ridged(gram: Array, pull: Array, ridge: float = RIDGE) -> Array:
    """(p,) least squares by products (p, p) with a unit diagonal and (p,)."""
    return np.linalg.solve(gram + ridge * np.eye(len(gram)), pull)


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
    problem = Problem(
        error=error,
        basis=orthonormal(nuisance),
        variance_ratio=np.zeros(len(error)),
        size=1.0,
        group=np.unique(white.rows(logs.quarter), return_inverse=True)[1],
        measured=np.ones(len(error), dtype=bool),
        exact=0.0,
    )
    return TorqueLaws(problem, columns, white, np.sqrt((logs.y**2).mean(axis=0)))


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
        group = white.rows(columns.scene.logs.quarter)
        return Normal(columns, white, tuple(terms), raw, white.white(raw[kept]),
                      white.white(columns.error[kept]), columns.places(terms), group)  # fmt: skip

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

    def rigid_model(self, name: str, context: Body) -> TorqueModel:
        """The fit of the rigid body alone."""
        body = self.body(self.solve([RIGID]))
        return TorqueModel(name, body, (), context, np.zeros((len(body.usual), len(YIELD))), 0.0)


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


def first_body(columns: Columns) -> Body:
    """Rigid body and usual friction by plain least squares on the rows that are fitted."""
    kept = columns.scene.logs.fitted.T
    value = least_squares(columns.design()[kept], columns.error[kept])
    return Body.of(columns.scene.arm, *np.split(value, [columns.rigid.shape[2]]))


# ---- where friction changes its sign -------------------------------------------------------------


SOFTER = np.geomspace(0.005, 0.1, 9)  # of a joint's largest speed
NEAR = np.geomspace(0.7, 1.4, 9)  # of the best of these: a second, finer look
WORTH = 0.15  # of the square of the remaining error that a softer friction must close


def softened(columns: Columns, terms: Sequence[Term]) -> Array:
    """(n,) speeds over which friction changes its sign; as they are where that is soft enough.

    Simulators make it soft, and gears with much play.  A friction that is softer than it is drawn
    to be looks like a force without a law; one column beside all that is named says so.

    columns: of a scene.  terms: what is named.
    """
    scene, arm = columns.scene, columns.scene.arm
    logs, error, out = scene.logs, columns.error, arm.soft.copy()
    design = columns.design(terms)
    for j in range(logs.joints):
        rows = logs.fitted[:, j]
        beside = design[j, rows]
        if np.count_nonzero(rows) < 2 * beside.shape[1]:
            continue
        beside[:, columns.rigid.shape[2] + 2 * j] = 0.0  # the Coulomb friction of this joint
        basis = orthonormal(beside)
        left = error[j, rows] - basis @ (basis.T @ error[j, rows])

        def remaining(speeds: Array, j: int = j, basis: Array = basis, left: Array = left) -> Array:
            sense = logs.filtered(sense_of(logs.motion.qd[:, j, None], speeds))[logs.fitted[:, j]]
            sense = sense - basis @ (basis.T @ sense)
            size = np.maximum((sense**2).sum(axis=0), 1e-300)
            return np.asarray(float(left @ left) - (left @ sense) ** 2 / size)

        rough = arm.fastest[j] * SOFTER
        found = rough[np.argmin(remaining(rough))] * NEAR
        softer = float(found[np.argmin(remaining(found))])
        as_it_is, then = remaining(np.array([arm.soft[j], softer]))
        if then < (1.0 - WORTH) * as_it_is:
            out[j] = max(out[j], softer)
    return out


# ---- whether masses are as given, and which runs carry alike -------------------------------------


CONTRADICTS = 1e-4  # p-value below which rows contradict a body that is not refitted
ALIKE = 12.0  # of log likelihood, twice: links that explain as much
SURE = 4.0  # standard deviations by which a parameter of a changed link differs from the given
WEIGHT = 4  # parameters of a link that gravity shows: its mass and first moments
ROUNDING = 1e-10  # of the largest singular value: what all runs carry alike is the last link's
LINK = "link"  # part of a fit: parameters of the link that may have changed


@dataclass(frozen=True, eq=False)
class LinkChange:
    """A link whose parameters are not as given.  link: from 0.  value, sigma: (10,).

    before, after: (n,) RMS that the body as given leaves of the fitted rows, and that with the
    link changed.  others: links that would explain as much.
    """

    link: int
    value: Array
    sigma: Array
    before: Array
    after: Array
    others: tuple[int, ...]


def contradiction(left: Array, full: Array, group: Array, columns: int, dof: int) -> float:
    """p-value of what fewer parameters leave, by rows and by groups of rows.

    left, full: (N,) whitened rest of the fit with fewer parameters, and of the other.  group: (N,).
    columns: parameters that are fewer.  dof: of the other.
    """
    more = max(float(left @ left - full @ full), 0.0)
    wide = inflation(left - full, left, group, dof)
    ratio = more / max(columns, 1) / (float(full @ full) / dof) / wide
    return float(fdtrc(max(columns, 1), dof, ratio))


def body_as_given(normal: Normal) -> tuple[bool, LinkChange | None]:
    """Whether the rows agree with the masses as given; else the one link whose change suffices.

    normal: of all that is named.  Usual friction and named laws are free in every case.
    """
    scene = normal.columns.scene
    arm, logs, white = scene.arm, scene.logs, normal.white
    if not (arm.shared and arm.drawn.any()):
        return False, None
    every = parts_of(normal.terms)
    value = normal.solve(every)
    full = normal.error - normal.matrix @ value
    free, dof = arm.base.shape[1], len(normal.error) - len(value)
    rows = normal.columns.links
    links = white.white(rows[white.kept])
    others = normal.index(every[1:])
    matrix = np.concatenate([normal.matrix[:, others], links], axis=1)
    error = normal.error - links @ arm.drawn
    count = len(others)
    spans = {k: np.r_[:count, count + PER_LINK * k : count + PER_LINK * (k + 1)]
             for k in range(logs.joints)}  # fmt: skip

    def left(index: Array) -> Array:
        found = np.linalg.lstsq(matrix[:, index], error, rcond=None)[0]
        return np.asarray(error - matrix[:, index] @ found)

    given = left(np.arange(count))
    if contradiction(given, full, normal.group, free, dof) > CONTRADICTS:
        return True, None
    rest = {k: left(index) for k, index in spans.items()}
    squares = {k: float(part @ part) for k, part in rest.items()}
    best = min(squares, key=lambda k: squares[k])
    if contradiction(rest[best], full, normal.group, free - PER_LINK, dof) < CONTRADICTS:
        return False, None
    limit = squares[best] * np.exp(ALIKE / len(error))
    alike = tuple(k for k, square in squares.items() if k != best and square < limit)
    alone = replace(normal, matrix=matrix[:, spans[best]], error=error,
                    place={FRICTION: slice(0, count), LINK: slice(count, None)})  # fmt: skip
    change = changed(alone, normal.raw[..., others], rows, best, alike)
    return False, change if np.any(np.abs(change.value) > SURE * change.sigma) else None


def changed(
    alone: Normal, beside: Array, rows: Array, link: int, others: tuple[int, ...]
) -> LinkChange:
    """The change of one link, with its uncertainty.

    alone: of friction and the link, less the torques of the body as given.  beside: (n, R, p) rows
    of friction, not whitened.  rows: (n, R, 10 n) of all links.
    """
    white, arm, count = alone.white, alone.columns.scene.arm, beside.shape[2]
    raw = np.concatenate([beside, rows[..., PER_LINK * link : PER_LINK * (link + 1)]], axis=2)
    value = alone.solve([FRICTION, LINK])
    sigma = alone.spread([FRICTION, LINK], value)
    plain = alone.columns.error[white.kept] - rows[white.kept] @ arm.drawn

    def rms(values: Array) -> Array:
        rest = plain - raw[white.kept] @ values
        squares = np.bincount(white.joint, rest**2, minlength=len(white.kept))
        return np.sqrt(squares / np.maximum(np.bincount(white.joint, minlength=len(squares)), 1))

    before = rms(alone.solve([FRICTION]))
    return LinkChange(link, value[count:], sigma[count:], before, rms(value), others)


def carried(columns: Columns, terms: Sequence[Term]) -> list[Term]:
    """The payloads that runs carry more than the lightest does: runs that carry alike have one.

    Each run is fitted with a last link of its own, beside one variant of every other law.  Runs are
    joined, the most alike first, until their rows contradict it.
    """
    logs = columns.scene.logs
    white = columns.whitening(terms)
    kept, count = white.kept, len(logs.names)
    run, group = white.rows(logs.run), white.rows(logs.quarter)
    basis = orthonormal(white.white(columns.of_each(terms)[kept]))
    link = np.moveaxis(logs.filtered(columns.scene.regressor[:, :, -PER_LINK:]), 1, 0)
    link = white.white(link[kept])
    link /= np.maximum(np.linalg.norm(link, axis=0), 1e-300)
    error = white.white(columns.error[kept])
    error = error - basis @ (basis.T @ error)
    each = [(link[run == r], basis[run == r]) for r in range(count)]
    shared = np.concatenate([own.T @ rows for rows, own in each], axis=1)
    gram = block_diag(*(rows.T @ rows for rows, _ in each)) - shared.T @ shared
    pull = np.concatenate([rows.T @ error[run == r] for r, (rows, _) in enumerate(each)])

    def left(value: Array) -> Array:
        """(N,) what last links (R, 10) of the runs leave."""
        moved = (link * value[run]).sum(axis=1)
        return np.asarray(error - moved + basis @ (basis.T @ moved))

    label = np.arange(count)  # which load a run has
    while True:
        loads = np.eye(label.max() + 1)[label]
        own = np.kron(loads, np.eye(PER_LINK))
        inverse = np.linalg.pinv(own.T @ gram @ own, ROUNDING, hermitian=True)
        value = inverse @ own.T @ pull
        pairs = []
        for a, b in combinations(range(loads.shape[1]), 2):
            apart = np.kron(np.eye(loads.shape[1])[a] - np.eye(loads.shape[1])[b], np.eye(PER_LINK))
            toward = inverse @ apart.T @ np.linalg.pinv(apart @ inverse @ apart.T, ROUNDING)
            off = toward @ (apart @ value)
            pairs.append((float(off @ own.T @ gram @ own @ off), a, b, off))
        full, dof = left((own @ value).reshape(count, -1)), len(error) - basis.shape[1] - len(value)
        if not pairs:
            break
        _, a, b, off = min(pairs, key=lambda pair: pair[0])
        joined = left((own @ (value - off)).reshape(count, -1))
        if contradiction(joined, full, group, PER_LINK, dof) < CONTRADICTS:
            break
        label = np.where(label == b, a, label)
        label -= label > b
    lightest = int(np.argmin(value[::PER_LINK]))
    return [Term("payload", f"L{logs.joints}",
                 {logs.names[r]: 1.0 for r in np.flatnonzero(label == k)})
            for k in range(loads.shape[1]) if k != lightest]  # fmt: skip


def weighing(columns: Columns, terms: Sequence[Term], loads: Sequence[Term]) -> list[Term]:
    """The payloads that gravity shows, beside one variant of every other law: others are none."""
    every = [*{term.key: term for term in reversed(terms)}.values(), *loads]
    normal, parts = Normal.of(columns, columns.whitening(every), every), parts_of(every)
    value = normal.solve(parts)
    sure = np.abs(value) > SURE * normal.spread(parts, value)
    return [term for term in loads if sure[normal.place[term.text]][:WEIGHT].any()]
