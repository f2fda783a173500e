"""How a robot file writes links: standard or Craig's DH, offsets of joints; exact both ways.

The engine knows one form, a row ``Rz(q + theta) Tz(d) Tx(a) Rx(alpha) Ry(beta)``.  Craig's rows
``Tx(a) Rx(alpha) Ry(beta) Rz(q + theta) Tz(d)`` [Craig 2005, eq. 3.6, with Hayati's beta] are the
same chain cut elsewhere: row i holds theta and d of the engine's row i, and a, alpha, beta of its
row i - 1.  Those of the first row turn the base and must be 0, or a half turn about x, which goes
through the first joint: ``Rx(pi) Rz(t) Tz(d) = Rz(-t) Tz(-d) Rx(pi)``.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cache

import numpy as np

from minimax_cal.ground.arrays import Array
from minimax_cal.ground.errors import RobotError
from minimax_cal.robots.kinematics import ALPHA, BETA, MDH_NAMES, THETA, A, D

FORMULAS = {
    "standard": "Rz(sign*q+theta) Tz(d) Tx(a) Rx(alpha) Ry(beta)",
    "modified": "Tx(a) Rx(alpha) Ry(beta) Rz(sign*q+theta) Tz(d)",
}
TAIL = [A, ALPHA, BETA]  # what Craig's row i + 1 holds of the engine's row i
SAME = 1e-9  # of an angle or a length that rounding changes [rad, m]


@cache
def names_of(joints: int, *, modified: bool) -> tuple[str, ...]:
    """See `Notation.names`."""
    later = modified * np.isin(np.arange(5), TAIL)
    return tuple(
        f"{kind}{i + 1 + more}"
        for kind, more in zip(MDH_NAMES, later, strict=True)
        for i in range(joints)
    )


@dataclass(frozen=True, eq=False)
class Notation:
    """modified: whether rows are Craig's.  half_turn: whether the first one's alpha is 180 degrees.

    offset: (n,) that a file adds to theta, or to d of a slide [rad, m]; (0,) for none.
    """

    modified: bool = False
    half_turn: bool = False
    offset: Array = field(default_factory=lambda: np.zeros(0))

    def names(self, joints: int) -> tuple[str, ...]:
        """(5n,) of the engine's parameters, kind by kind, by the file's rows; see `links_of`.

        What follows the last joint of Craig's rows is of no row: its number is n + 1.
        """
        return names_of(joints, modified=self.modified)

    def told(self, mdh: Array, prismatic: Array) -> Array:
        """(n, 5) the engine's rows with the values that the file's convention has for them."""
        out = np.array(mdh)
        out *= self.sense(len(out))
        if self.half_turn:
            out[0, ALPHA] -= np.pi
        if len(self.offset):
            own = np.where(prismatic, D, THETA)
            out[np.arange(len(out)), own] -= self.offset
        return out

    def sense(self, joints: int) -> Array:
        """(n, 5) -1 where the file's value falls as the engine's grows, else 1."""
        out = np.ones((joints, 5))
        if self.half_turn:
            out[0, [THETA, D]] = -1.0
        return out

    def written(self, mdh: Array, prismatic: Array) -> tuple[Array, Array]:
        """(n, 5) rows as the file has them, and (5,) what follows the last joint of Craig's."""
        told = self.told(mdh, prismatic)
        if not self.modified:
            return told, np.zeros(5)
        first = np.zeros(5)
        first[ALPHA] = np.pi * self.half_turn
        end, rows = told[-1].copy(), told.copy()
        rows[:, TAIL] = np.vstack([first, told[:-1]])[:, TAIL]
        end[[D, THETA]] = 0.0
        return rows, end


PLAIN = Notation()


def read(
    rows: Array, sign: Array, prismatic: Array, offset: Array, end: Array, source: str
) -> tuple[Array, Array, Notation]:
    """The engine's rows (n, 5) and signs (n,) of Craig's rows, and how to write them again.

    rows: (n, 5) with theta and d without their offset (n,).  end: (5,) what follows the last joint.
    Raises RobotError where the first row moves the base.
    """
    lead = rows[0, TAIL]
    half_turn = bool(abs(abs(lead[1]) - np.pi) < SAME)
    if np.abs(lead - [0.0, np.copysign(np.pi, lead[1]) * half_turn, 0.0]).max() > SAME:
        raise RobotError(
            f"{source}: joints[0]: a, alpha and beta of the first row of modified DH lie before "
            "joint 1 and move the base alone: they must be 0 (alpha also 180 degrees); is this a "
            "table of standard DH?"
        )
    mdh = rows.copy()
    mdh[:, TAIL] = np.vstack([rows[1:], end])[:, TAIL]
    return *straight(mdh, sign, prismatic, offset, half_turn), Notation(True, half_turn, offset)


def straight(
    mdh: Array, sign: Array, prismatic: Array, offset: Array, half_turn: bool
) -> tuple[Array, Array]:
    """The engine's rows and signs: offsets added, a half turn before joint 1 taken through it."""
    mdh, sign = mdh.copy(), sign.copy()
    if len(offset):
        mdh[np.arange(len(mdh)), np.where(prismatic, D, THETA)] += offset
    if half_turn:
        mdh[0, [THETA, D]] *= -1.0
        mdh[0, ALPHA] += np.pi
        sign[0] *= -1.0
    return mdh, sign
