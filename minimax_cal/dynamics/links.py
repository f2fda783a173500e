"""Whether masses are as given, all of them or all but one link's, and which runs carry alike."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from scipy.linalg import block_diag
from scipy.special import fdtrc

from minimax_cal.dynamics.laws import Term
from minimax_cal.dynamics.model import FRICTION, Columns, Normal, parts_of
from minimax_cal.dynamics.regressor import PER_LINK
from minimax_cal.evidence.noise import inflation, orthonormal
from minimax_cal.ground.arrays import Array

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
        return np.asarray(
            np.sqrt(squares / np.maximum(np.bincount(white.joint, minlength=len(squares)), 1))
        )

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
