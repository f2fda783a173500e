"""Whether the masses of a model are those of the arm, and which runs carry what at the flange."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from scipy.linalg import block_diag
from scipy.special import fdtrc

from minimax_cal.dynamics.laws import Term
from minimax_cal.dynamics.logs.table import CURRENT
from minimax_cal.dynamics.model import FRICTION, Columns, Normal
from minimax_cal.dynamics.regressor import PER_LINK
from minimax_cal.dynamics.result import worth_by_joint
from minimax_cal.dynamics.rows import Arm
from minimax_cal.evidence.noise import inflation, orthonormal
from minimax_cal.ground.arrays import Array
from minimax_cal.ground.linear_algebra import project_out

MAX_CONTRADICTION_P = 1e-4  # p-value below which rows contradict a body that is not refitted
MAX_LIKELIHOOD_LOSS = 12.0  # of log likelihood, twice: links that explain as much
MIN_CHANGE_SIGMAS = 4.0  # by which a parameter of a changed link differs from the given
WEIGHED_COUNT = 4  # parameters of a link that gravity shows: its mass and first moments
MIN_SINGULAR_VALUE = 1e-10  # of the largest: what all runs carry alike is the last link's
LINK = "link"  # part of a fit: parameters of the link that may have changed


@dataclass(frozen=True, eq=False)
class LinkChange:
    """A link whose parameters are not as given.  link: from 0.  value, sigma: (10,).

    worth: of each joint, the RMS that the body as given leaves of the fitted rows, and that with
    the link changed; before: (n,) the first.  others: links that would explain as much.
    """

    link: int
    value: Array
    sigma: Array
    worth: dict[str, tuple[float, float]]
    before: Array
    others: tuple[int, ...]


@dataclass(frozen=True, eq=False)
class MassTest:
    """Whether the rows agree with the masses as given; else the one link whose change suffices."""

    agrees: bool
    change: LinkChange | None = None

    def describe(self, arm: Arm, unit: str) -> tuple[str, ...]:
        """What is to be known of masses and gains.  unit: of the log."""
        if unit == CURRENT and not arm.shared:
            return (
                "currents are judged in A: without drive gains each joint has masses of its own; "
                "give drive_gain= to test joint flexibility, drive gains and the masses of the "
                "model",
            )
        if not arm.drawn.any():
            return ("the model gives no masses: the rigid body is the one that the torques show",)
        if not self.agrees and self.change is None:
            return ("the masses of the model are not this arm's: the rigid body was refitted",)
        return ()


def contradiction_p_value(
    residuals: Array, full: Array, group: Array, column_count: int, dof: int
) -> float:
    """p-value of what fewer parameters leave, by rows and by groups of rows [F test].

    residuals, full: (N,) whitened, of the fit with fewer parameters, and of the other.  group: (N,)
    of rows that err together.  column_count: parameters that are fewer.  dof: of the other.
    """
    more = max(float(residuals @ residuals - full @ full), 0.0)
    wide = inflation(residuals - full, residuals, group, dof)
    ratio = more / max(column_count, 1) / (float(full @ full) / dof) / wide
    return float(fdtrc(max(column_count, 1), dof, ratio))


def compare_with_given_masses(normal: Normal) -> MassTest:
    """Whether the rows agree with the masses as given, or with these but for one link.

    normal: of all that is named.  Usual friction and named laws are free in every case.
    """
    scene = normal.columns.scene
    arm, kept = scene.arm, normal.white.kept
    if not (arm.shared and arm.drawn.any()):
        return MassTest(agrees=False)

    # Residuals of the free body, and of the body as given beside friction and laws.
    value = normal.solve(normal.parts)
    full = normal.error - normal.matrix @ value
    free, dof = arm.base.shape[1], len(normal.error) - len(value)
    rows = normal.columns.links
    links = normal.white.white(rows[kept])
    others = normal.index(normal.parts[1:])
    matrix = np.concatenate([normal.matrix[:, others], links], axis=1)
    error, count = normal.error - links @ arm.drawn, len(others)

    def residuals_of(index: Array) -> Array:
        found = np.linalg.lstsq(matrix[:, index], error, rcond=None)[0]
        return np.asarray(error - matrix[:, index] @ found)

    given = residuals_of(np.arange(count))
    if contradiction_p_value(given, full, normal.group, free, dof) > MAX_CONTRADICTION_P:
        return MassTest(agrees=True)

    # The link whose ten parameters, free, leave least.
    spans = {k: np.r_[:count, count + PER_LINK * k : count + PER_LINK * (k + 1)]
             for k in range(scene.logs.joints)}  # fmt: skip
    residuals = {k: residuals_of(index) for k, index in spans.items()}
    squares = {k: float(part @ part) for k, part in residuals.items()}
    link = min(squares, key=lambda k: squares[k])
    p = contradiction_p_value(residuals[link], full, normal.group, free - PER_LINK, dof)
    if p < MAX_CONTRADICTION_P:
        return MassTest(agrees=False)
    limit = squares[link] * np.exp(MAX_LIKELIHOOD_LOSS / len(error))
    alike = tuple(k for k, square in squares.items() if k != link and square < limit)

    # Its change with uncertainty, and what it is worth.
    alone = replace(normal, matrix=matrix[:, spans[link]], error=error,
                    place={FRICTION: slice(0, count), LINK: slice(count, None)})  # fmt: skip
    value = alone.solve([FRICTION, LINK])
    sigma = alone.spread([FRICTION, LINK], value)
    if not np.any(np.abs(value[count:]) > MIN_CHANGE_SIGMAS * sigma[count:]):
        return MassTest(agrees=False)
    of_link = rows[..., PER_LINK * link : PER_LINK * (link + 1)]
    raw = np.concatenate([normal.raw[..., others], of_link], axis=2)[kept]
    plain, joint, rms = normal.columns.error[kept] - rows[kept] @ arm.drawn, normal.white.joint, []
    for some in (alone.solve([FRICTION]), value):
        total = np.bincount(joint, (plain - raw @ some) ** 2, minlength=len(kept))
        rms.append(np.sqrt(total / np.maximum(np.bincount(joint, minlength=len(kept)), 1)))
    worth = worth_by_joint(*rms)
    return MassTest(
        agrees=False, change=LinkChange(link, value[count:], sigma[count:], worth, rms[0], alike)
    )


def find_payloads(columns: Columns, terms: Sequence[Term]) -> list[Term]:
    """The payloads that runs carry more than the lightest does: runs that carry alike have one.

    Each run is fitted with a last link of its own, beside one variant of every other law.  Runs are
    joined, the most alike first, until their rows contradict it.
    """
    logs, white = columns.scene.logs, columns.whitening(terms)
    kept, count = white.kept, len(logs.names)
    run, group = white.rows(logs.run), white.rows(logs.quarter)

    # Normal equations of the runs' links, all else projected out [Schur complement].
    basis = orthonormal(white.white(columns.of_each(terms)[kept]))
    link = np.moveaxis(logs.filtered(columns.scene.regressor[:, :, -PER_LINK:]), 1, 0)
    link = white.white(link[kept])
    link /= np.maximum(np.linalg.norm(link, axis=0), 1e-300)
    error = project_out(white.white(columns.error[kept]), basis)
    each = [(link[run == r], basis[run == r]) for r in range(count)]
    shared = np.concatenate([own.T @ rows for rows, own in each], axis=1)
    gram = block_diag(*(rows.T @ rows for rows, _ in each)) - shared.T @ shared
    pull = np.concatenate([rows.T @ error[run == r] for r, (rows, _) in enumerate(each)])

    def residuals_of(value: Array) -> Array:
        """(N,) of last links (10 r,) of the runs."""
        moved = (link * value.reshape(count, -1)[run]).sum(axis=1)
        return np.asarray(error - project_out(moved, basis))

    # Agglomeration: the two loads that differ least are joined [Wald test of their difference].
    label = np.arange(count)  # which load a run has
    while True:
        loads = np.eye(label.max() + 1)
        own = np.kron(loads[label], np.eye(PER_LINK))
        inner = own.T @ gram @ own
        inverse = np.linalg.pinv(inner, MIN_SINGULAR_VALUE, hermitian=True)
        value = inverse @ own.T @ pull
        pairs = []
        for a, b in combinations(range(len(loads)), 2):
            apart = np.kron(loads[a] - loads[b], np.eye(PER_LINK))
            toward = (
                inverse @ apart.T @ np.linalg.pinv(apart @ inverse @ apart.T, MIN_SINGULAR_VALUE)
            )
            off = toward @ (apart @ value)
            pairs.append((float(off @ inner @ off), a, b, off))
        if not pairs:
            break
        _, a, b, off = min(pairs, key=lambda pair: pair[0])
        joined, full = residuals_of(own @ (value - off)), residuals_of(own @ value)
        dof = len(error) - basis.shape[1] - len(value)
        if contradiction_p_value(joined, full, group, PER_LINK, dof) < MAX_CONTRADICTION_P:
            break
        label = np.where(label == b, a, label)
        label -= label > b

    lightest = int(np.argmin(value[::PER_LINK]))
    heavier = [Term("payload", f"L{logs.joints}",
                    {logs.names[r]: 1.0 for r in np.flatnonzero(label == k)})
               for k in range(len(loads)) if k != lightest]  # fmt: skip
    return select_weighed_payloads(columns, terms, heavier)


def select_weighed_payloads(
    columns: Columns, terms: Sequence[Term], payloads: Sequence[Term]
) -> list[Term]:
    """The payloads that gravity shows, beside one variant of every other law: others are none."""
    every = [*{term.key: term for term in reversed(terms)}.values(), *payloads]
    normal = Normal.of(columns, columns.whitening(every), every)
    value = normal.solve(normal.parts)
    sure = np.abs(value) > MIN_CHANGE_SIGMAS * normal.spread(normal.parts, value)
    return [term for term in payloads if sure[normal.place[term.text]][:WEIGHED_COUNT].any()]
