"""Does anything remain?  One test of all that might, whatever its law.

What a fit leaves is asked for motions that follow smooth functions of something: components of
variance [Rao and Kleffe 1988].  A component's score is the squared length of its products with the
rows; simulated white rows tell how large it is by chance, and how large the largest of all.  A
motion may scatter more than the rest, and a visit be off by itself, which is no such function:
flipped signs of whole visits [Winkler et al. 2014] must not score as much either.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import groupby

import numpy as np

from minimax_cal.evidence.limits import AUDIBLE, SCATTERS
from minimax_cal.evidence.noise import Noise, Problem
from minimax_cal.ground.arrays import Array
from minimax_cal.ground.linear_algebra import project_out

TOGETHER = 30  # visits to one pose in a block, whose cost grows with their cube


def evened(rows: Array, basis: Array, spread: Array, group: Array) -> Array:
    """Residuals (m, 3k) with the covariance they had before the fit [Bell & McCaffrey 2002].

    Rows of covariance V_g = `spread` (m, 3k, 3k), up to a factor, leave residuals of covariance
    V_g - H_gg V_g - V_g H_gg + sum_h H_gh V_h H_hg with H = QQ', Q = `basis` (m, 3k, p).  All
    visits to a pose are one block g: the fit ties them together; of very many so many at a time.
    """
    middle = np.tensordot(basis, spread @ basis, ((0, 1), (0, 1)))
    several = np.stack([group, times_before(group) // TOGETHER])
    _, place, count = np.unique(several, axis=1, return_inverse=True, return_counts=True)
    place, out = place.reshape(-1), np.empty_like(rows)
    for visits in np.unique(count):
        alike = np.flatnonzero(count[place] == visits)
        chosen = alike[np.argsort(place[alike], kind="stable")].reshape(-1, visits)
        wide = visits * rows.shape[1]
        block = np.zeros((len(chosen), visits, rows.shape[1], visits, rows.shape[1]))
        for visit in range(visits):
            block[:, visit, :, visit] = spread[chosen[:, visit]]
        even = unfollowed(
            rows[chosen].reshape(-1, wide),
            basis[chosen].reshape(-1, wide, basis.shape[2]),
            block.reshape(-1, wide, wide),
            middle,
        )
        out[chosen] = even.reshape(rows[chosen].shape)
    return out


def times_before(group: Array) -> Array:
    """(m,) how often each row's number stands before it."""
    order = np.argsort(group, kind="stable")
    known, first = group[order], np.arange(len(group))
    start = np.maximum.accumulate(np.where(np.append(True, known[1:] != known[:-1]), first, 0))
    out = np.empty_like(first)
    out[order] = first - start
    return out


def unfollowed(rows: Array, basis: Array, spread: Array, middle: Array) -> Array:
    """`evened` for blocks of one size.  middle: (p, p) sum of Q_g' V_g Q_g over all blocks."""
    back = np.swapaxes(basis, 1, 2)
    followed = basis @ (back @ spread)
    left = spread - followed - np.swapaxes(followed, 1, 2) + basis @ middle @ back
    factor = np.linalg.cholesky(spread)
    white = np.linalg.solve(factor, np.swapaxes(np.linalg.solve(factor, left), 1, 2))
    value, vector = np.linalg.eigh(0.5 * (white + np.swapaxes(white, 1, 2)))
    turned = np.swapaxes(vector, 1, 2) @ np.linalg.solve(factor, rows[..., None])
    stretch = 1.0 / np.sqrt(np.maximum(value, 0.1))  # a pose the fit has all but taken tells little
    return np.asarray((factor @ vector @ (stretch[..., None] * turned))[..., 0])


# ---- even errors ---------------------------------------------------------------------------------


DRAWS = 499  # of rows, and of signs: the least p-value that is reported is 0.002
ASKED = 40  # of the loudest, at most, are asked whether they scatter
FOLLOWING = " following "  # between a place and what drives it
SHOWN = 6  # components that are told at most


@dataclass(frozen=True, eq=False)
class Fading:
    """A covariance of the visits that fades from each to the next.

    order: (m,) the visits as they came.  keep: correlation of one with the next.
    """

    order: Array
    keep: float

    def score(self, felt: Array) -> Array:
        """(b,) squares of what is felt (d, m, b), each visit adding to what is kept of the past."""
        kept, total = np.zeros((len(felt), felt.shape[2])), np.zeros(felt.shape[2])
        for visit in self.order.tolist():
            kept = self.keep * kept + felt[:, visit]
            total += (kept**2).sum(axis=0)
        return total


@dataclass(frozen=True, eq=False)
class Component:
    """What may remain: motions of a place that follow functions of a driver.

    motion: (N, d) rows per unit.  feature: (w, f, m) of the visits, f functions in each of w ways,
    of which the loudest counts; or their covariance.
    """

    place: str
    driver: str
    motion: Array
    feature: Array | Fading

    @property
    def functions(self) -> int:
        """How many functions its motion may follow."""
        return self.feature.shape[1] if isinstance(self.feature, np.ndarray) else len(self.motion)


@dataclass(frozen=True)
class Remains:
    """A component that remains.

    score: as that of a standard normal variable.  p: chance that any of all components scores so
    much on white rows; 1 where any that is loud does by flipped signs.  share: of the square of
    what is left, as far as this component tells it.  functions: how many it may follow.
    """

    place: str
    driver: str
    score: float
    p: float
    share: float
    functions: int = 0

    @property
    def telling(self) -> tuple[float, int]:
        """What tells more of the error comes first, of equal ones that of fewer functions."""
        return -min(self.share, 1.0), self.functions

    @property
    def name(self) -> str:
        """For people."""
        return f"{self.place}{FOLLOWING}{self.driver}"


@dataclass(frozen=True, eq=False)
class Rest:
    """What is left, white under the null hypothesis.

    rows: (N,).  basis: (N, p) orthonormal span of all that was fitted.  root: (N,) square roots of
    the weights.  dof: degrees of freedom.  group: (m,) of visits to one pose, from 0.  turn:
    (m, r, r) rotations of a visit's measurements into its rows.
    """

    rows: Array
    basis: Array
    root: Array
    dof: int
    group: Array
    turn: Array

    @property
    def width(self) -> int:
        """Rows of a visit."""
        return int(self.turn.shape[1])

    @property
    def total(self) -> float:
        """Its square."""
        return float(self.rows @ self.rows)

    def even(self) -> Array:
        """(N,) the rows as large as they were before the fit."""
        m, r = len(self.rows) // self.width, self.width
        spread = np.broadcast_to(np.eye(r), (m, r, r))
        basis = self.basis.reshape(m, r, -1)
        return evened(self.rows.reshape(m, r), basis, spread, self.group).reshape(-1)

    def beside(self, drawn: Array) -> Array:
        """(N, 1 + b) the rows, and drawn ones (N, b) without what was fitted."""
        return np.concatenate([self.rows[:, None], project_out(drawn, self.basis)], axis=1)

    def felt(self, motion: Array, rows: Array) -> Array:
        """(d, m, b) products at each visit of motions (N, d) with rows (N, b)."""
        shape = len(self.group), self.width, -1
        weighted = motion * self.root[:, None]  # and of one size each, without those fitted
        size = np.linalg.norm(weighted, axis=0)
        moved = (weighted[:, size > 0.0] / size[size > 0.0]).reshape(shape)
        return np.asarray(np.einsum("mwd,mwb->dmb", moved, rows.reshape(shape), optimize=True))


def rest_of(rows: Problem, noise: Noise, known: Array, turn: Array) -> Rest:
    """Weighted rows without the span of nuisance and known columns (N, q).  turn: as in `Rest`."""
    root = np.sqrt(noise.weights(rows))
    columns = np.concatenate([rows.basis, known], axis=1) * root[:, None]
    norm = np.linalg.norm(columns, axis=0)
    basis = np.linalg.qr(columns[:, norm > 0] / norm[norm > 0])[0]
    rest = project_out(rows.error * root, basis)
    dof = rows.count - basis.shape[1]
    return Rest(rest, basis, root, dof, rows.group[:: turn.shape[1]], turn)


@dataclass(frozen=True, eq=False)
class Asked:
    """What was asked of a rest, and how loud each component of it is.

    score, p: (c,) as in `Remains`.  loud: numbers of those that chance does not make so loud, of
    which alone it is known whether they scatter.  drawn: (N, 1 + b) the rows, and rows by chance.
    """

    rest: Rest
    components: Sequence[Component]
    score: Array
    p: Array
    loud: Sequence[int]
    drawn: Array

    @property
    def loud_ones(self) -> tuple[Remains, ...]:
        """Components that the rest may hold, the loudest first."""
        return self.loudest(self.loud, SHOWN)

    def loudest(self, numbers: Sequence[int], most: int) -> tuple[Remains, ...]:
        """Of some components those that are least by chance."""
        order = sorted(numbers, key=lambda i: (self.p[i], -self.score[i], i))
        return tuple(self.told(i) for i in order[:most])

    def told(self, number: int) -> Remains:
        """What is known of a component: with its share of the rest's square beyond chance.

        With z features of variance v the score |z'r|^2 is that by chance plus v |z'z|^2 (MINQUE);
        by chance, of rows of variance s, it has the mean s tr z'z and the variance 2 s^2 |z'z|^2.
        """
        one = self.components[number]
        felt, feature = self.rest.felt(one.motion, self.drawn), one.feature
        if not isinstance(feature, Fading) and len(feature) > 1:
            ways = [score_of(way[None], felt[..., :1])[0] for way in feature]
            feature = feature[[int(np.argmax(ways))]]
        found, *chance = score_of(feature, felt).tolist()
        mean, spread = float(np.mean(chance)), float(np.var(chance))
        share = 2.0 * (found - mean) * mean / max(spread * self.rest.dof, 1e-300)
        return Remains(
            one.place,
            one.driver,
            float(self.score[number]),
            float(self.p[number]),
            float(max(share, 0.0)),
            one.functions,
        )


def asked(rest: Rest, components: Sequence[Component]) -> Asked:
    """Every component that moves anything, asked of the rest together."""
    rng = np.random.default_rng(0)
    moving = [one for one in components if np.any(one.motion)]
    # Drawn as measurements: the axes of rows that are alike, and all signs, are rounding's choice.
    measured = rng.normal(size=(len(rest.group), rest.width, DRAWS))
    white = (np.swapaxes(rest.turn, 1, 2) @ measured).reshape(-1, DRAWS)
    drawn = rest.beside(white * (rest.root > 0.0)[:, None])
    drawn[:, 1:] *= np.sqrt(rest.total / max(rest.dof, 1))
    if not moving:
        return Asked(rest, (), np.zeros(0), np.zeros(0), (), drawn)
    score, chance = largest(rest, moving, drawn)
    order = np.argsort(-score).tolist()
    loud = sorted([i for i in order if chance[i] < AUDIBLE][:ASKED] or order[:1])
    signs = np.repeat(rng.choice((-1.0, 1.0), (len(rest.group), DRAWS)), rest.width, axis=0)
    flipped = rest.beside(signs * rest.even()[:, None])
    _, by_signs = largest(rest, [moving[i] for i in loud], flipped)
    p = chance.copy()
    p[loud] = np.where(by_signs > SCATTERS, 1.0, chance[loud])
    return Asked(rest, moving, score, p, loud, drawn)


def score_of(feature: Array | Fading, felt: Array) -> Array:
    """(b,) the largest squared product of the ways (w, f, m) with what is felt (d, m, b)."""
    if isinstance(feature, Fading):
        return feature.score(felt)
    ways, count, visits = feature.shape
    told = feature.reshape(-1, visits) @ felt
    np.square(told, out=told)
    return np.asarray(told.reshape(len(felt), ways, count, -1).sum(axis=(0, 2)).max(axis=0))


def largest(rest: Rest, components: Sequence[Component], drawn: Array) -> tuple[Array, Array]:
    """(c,) scores as of a standard normal variable, and chance that the largest of all is so large.

    drawn: (N, 1 + DRAWS), the rows, and rows by chance.
    """
    # Squared products with the rows, of all components of one motion together.
    found: list[Array] = []
    for _, same in groupby(components, key=lambda one: id(one.motion)):
        several = list(same)
        felt = rest.felt(several[0].motion, drawn)
        found += [score_of(one.feature, felt) for one in several]
    scores = np.array(found)
    # Cube root of Wilson and Hilferty [1931], the degrees of freedom by the moments.
    mean, spread = scores[:, 1:].mean(axis=1)[:, None], scores[:, 1:].var(axis=1)[:, None]
    unit = 2.0 / 9.0 * spread / np.maximum(2.0 * mean**2, 1e-300)  # 2 / 9 of one over the freedom
    root = np.cbrt(scores / np.maximum(mean, 1e-300))
    score = (root - 1.0 + unit) / np.sqrt(np.maximum(unit, 1e-300))
    most = np.sort(score[:, 1:].max(axis=0))
    return score[:, 0], 1.0 - np.searchsorted(most, score[:, 0]) / (DRAWS + 1.0)
