"""Whether the masses that a model gives are the arm's, all of them or all but one link's."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import fdtrc

from minimax_cal.dynamics.budget import parts_of
from minimax_cal.dynamics.model import FRICTION, Normal
from minimax_cal.dynamics.regressor import PER_LINK
from minimax_cal.ground.arrays import Array

CONTRADICTS = 1e-4  # p-value below which rows contradict a body that is not refitted
ALIKE = 12.0  # of log likelihood, twice: links that explain as much
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


def contradiction(left: float, full: float, columns: int, dof: int) -> float:
    """p-value of what fewer parameters leave.  left, full: squares; columns: that are fewer."""
    ratio = max(left - full, 0.0) / max(columns, 1) / (full / dof)
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
    full = float(((normal.error - normal.matrix @ value) ** 2).sum())
    free, dof = arm.base.shape[1], len(normal.error) - len(value)
    rows = np.moveaxis(logs.filtered(scene.regressor), 1, 0)
    links = white.white(rows[white.kept])
    others = normal.index(every[1:])
    matrix = np.concatenate([normal.matrix[:, others], links], axis=1)
    error = normal.error - links @ arm.drawn
    count = len(others)
    spans = {k: np.r_[:count, count + PER_LINK * k : count + PER_LINK * (k + 1)]
             for k in range(logs.joints)}  # fmt: skip

    def left(index: Array) -> float:
        found = np.linalg.lstsq(matrix[:, index], error, rcond=None)[0]
        return float(((error - matrix[:, index] @ found) ** 2).sum())

    given = left(np.arange(count))
    if contradiction(given, full, free, dof) > CONTRADICTS:
        return True, None
    squares = {k: left(index) for k, index in spans.items()}
    best = min(squares, key=lambda k: squares[k])
    if contradiction(squares[best], full, free - PER_LINK, dof) < CONTRADICTS:
        return False, None
    limit = squares[best] * np.exp(ALIKE / len(error))
    alike = tuple(k for k, square in squares.items() if k != best and square < limit)
    return False, changed(normal, rows, error, best, alike)


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
