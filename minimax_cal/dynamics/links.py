"""Whether the masses that a model gives are the arm's, all of them or all but one link's."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import fdtrc

from minimax_cal.dynamics.budget import parts_of
from minimax_cal.dynamics.model import FRICTION, Normal
from minimax_cal.dynamics.regressor import PER_LINK
from minimax_cal.evidence.noise import inflation
from minimax_cal.ground.arrays import Array

CONTRADICTS = 1e-4  # p-value below which rows contradict a body that is not refitted
ALIKE = 12.0  # of log likelihood, twice: links that explain as much
SURE = 4.0  # standard deviations by which a parameter of a changed link differs from the given
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
    rows = np.moveaxis(logs.filtered(scene.regressor), 1, 0)
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
    change = changed(normal, rows, error, best, alike)
    return False, change if np.any(np.abs(change.value) > SURE * change.sigma) else None


def changed(
    normal: Normal, rows: Array, error: Array, link: int, others: tuple[int, ...]
) -> LinkChange:
    """The change of one link, with its uncertainty.

    rows: (n, R, 10 n) of all links.  error: (N,) whitened, less the torques of the body as given.
    """
    white, arm = normal.white, normal.columns.scene.arm
    part = rows[..., PER_LINK * link : PER_LINK * (link + 1)]
    index = normal.index(parts_of(normal.terms)[1:])
    raw = np.concatenate([normal.raw[..., index], part], axis=2)
    count = len(index)
    matrix = white.white(raw[white.kept])
    places = {FRICTION: slice(0, count), LINK: slice(count, raw.shape[2])}
    alone = Normal(normal.columns, white, (), raw, matrix, error, places, normal.group)
    value = alone.solve([FRICTION, LINK])
    sigma = alone.spread([FRICTION, LINK], value)
    plain = normal.columns.error()[white.kept] - rows[white.kept] @ arm.drawn

    def rms(values: Array) -> Array:
        rest = plain - raw[white.kept] @ values
        squares = np.bincount(white.joint, rest**2, minlength=len(white.kept))
        return np.asarray(
            np.sqrt(squares / np.maximum(np.bincount(white.joint, minlength=len(squares)), 1))
        )

    before = rms(alone.solve([FRICTION]))
    return LinkChange(link, value[count:], sigma[count:], before, rms(value), others)
