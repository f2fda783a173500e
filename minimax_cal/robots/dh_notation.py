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
from typing import NamedTuple

import numpy as np

from minimax_cal.core.arrays import Array
from minimax_cal.core.errors import RobotError
from minimax_cal.robots.kinematics import ALPHA, BETA, MDH_NAMES, THETA, A, D

DH_FORMULAS = {
    "standard": "Rz(sign*q+theta) Tz(d) Tx(a) Rx(alpha) Ry(beta)",
    "modified": "Tx(a) Rx(alpha) Ry(beta) Rz(sign*q+theta) Tz(d)",
}
CRAIG_SHIFTED_COLUMNS = [A, ALPHA, BETA]  # what Craig's row i + 1 holds of the engine's row i
MAX_ROW_ROUNDING = 1e-9  # of an angle or a length that rounding changes [rad, m]


@cache
def link_parameter_names(joint_count: int, *, modified: bool) -> tuple[str, ...]:
    """See `DhNotation.parameter_names`."""
    later = modified * np.isin(np.arange(5), CRAIG_SHIFTED_COLUMNS)
    return tuple(
        f"{kind}{i + 1 + more}"
        for kind, more in zip(MDH_NAMES, later, strict=True)
        for i in range(joint_count)
    )


class FileLinkRows(NamedTuple):
    """Rows (n, 5) in a file's convention, and (5,) what follows the last joint of Craig's."""

    rows: Array
    end_row: Array


@dataclass(frozen=True, eq=False)
class DhNotation:
    """modified: whether rows are Craig's.  half_turn: whether the first one's alpha is 180 degrees.

    offset: (n,) that a file adds to theta, or to d of a slide [rad, m]; (0,) for none.
    """

    modified: bool = False
    half_turn: bool = False
    offset: Array = field(default_factory=lambda: np.zeros(0))

    def parameter_names(self, joint_count: int) -> tuple[str, ...]:
        """(5n,) of the engine's parameters, kind by kind, by the file's rows; see `links_of`.

        What follows the last joint of Craig's rows is of no row: its number is n + 1.
        """
        return link_parameter_names(joint_count, modified=self.modified)

    def values_in_file_convention(self, mdh: Array, prismatic: Array) -> Array:
        """(n, 5) the engine's rows with the values that the file's convention has for them."""
        out = np.array(mdh)
        out *= self.file_value_signs(len(out))
        if self.half_turn:
            out[0, ALPHA] -= np.pi
        if len(self.offset):
            own = np.where(prismatic, D, THETA)
            out[np.arange(len(out)), own] -= self.offset
        return out

    def file_value_signs(self, joint_count: int) -> Array:
        """(n, 5) -1 where the file's value falls as the engine's grows, else 1."""
        out = np.ones((joint_count, 5))
        if self.half_turn:
            out[0, [THETA, D]] = -1.0
        return out

    def rows_in_file_convention(self, mdh: Array, prismatic: Array) -> FileLinkRows:
        """(n, 5) rows as the file has them, and (5,) what follows the last joint of Craig's."""
        told = self.values_in_file_convention(mdh, prismatic)
        if not self.modified:
            return FileLinkRows(told, np.zeros(5))
        first = np.zeros(5)
        first[ALPHA] = np.pi * self.half_turn
        end, rows = told[-1].copy(), told.copy()
        rows[:, CRAIG_SHIFTED_COLUMNS] = np.vstack([first, told[:-1]])[:, CRAIG_SHIFTED_COLUMNS]
        end[[D, THETA]] = 0.0
        return FileLinkRows(rows, end)


STANDARD_NOTATION = DhNotation()


class ConvertedRows(NamedTuple):
    """Rows (n, 5) and signs (n,) of the kinematics, and how to write them as in the file."""

    mdh: Array
    joint_signs: Array
    notation: DhNotation


def convert_modified_rows(
    modified_rows: Array,
    joint_signs: Array,
    prismatic: Array,
    joint_offsets: Array,
    end_row: Array,
    source: str,
) -> ConvertedRows:
    """The engine's rows (n, 5) and signs (n,) of Craig's rows, and how to write them again.

    modified_rows: (n, 5) with theta and d without their offset (n,).  end_row: (5,) what follows
    the last joint. Raises RobotError where the first row moves the base.
    """
    lead = modified_rows[0, CRAIG_SHIFTED_COLUMNS]
    half_turn = bool(abs(abs(lead[1]) - np.pi) < MAX_ROW_ROUNDING)
    if np.abs(lead - [0.0, np.copysign(np.pi, lead[1]) * half_turn, 0.0]).max() > MAX_ROW_ROUNDING:
        raise RobotError(
            f"{source}: joints[0]: a, alpha and beta of the first row of modified DH lie before "
            "joint 1 and move the base alone: they must be 0 (alpha also 180 degrees); is this a "
            "table of standard DH?"
        )
    mdh = modified_rows.copy()
    mdh[:, CRAIG_SHIFTED_COLUMNS] = np.vstack([modified_rows[1:], end_row])[
        :, CRAIG_SHIFTED_COLUMNS
    ]
    return ConvertedRows(
        *apply_offsets_and_half_turn(mdh, joint_signs, prismatic, joint_offsets, half_turn),
        DhNotation(True, half_turn, joint_offsets),
    )


class RowsAndSigns(NamedTuple):
    """Rows (n, 5) and signs (n,) of the kinematics."""

    mdh: Array
    joint_signs: Array


def apply_offsets_and_half_turn(
    mdh: Array, joint_signs: Array, prismatic: Array, joint_offsets: Array, half_turn: bool
) -> RowsAndSigns:
    """The engine's rows and signs: offsets added, a half turn before joint 1 taken through it."""
    mdh, joint_signs = mdh.copy(), joint_signs.copy()
    if len(joint_offsets):
        mdh[np.arange(len(mdh)), np.where(prismatic, D, THETA)] += joint_offsets
    if half_turn:
        mdh[0, [THETA, D]] *= -1.0
        mdh[0, ALPHA] += np.pi
        joint_signs[0] *= -1.0
    return RowsAndSigns(mdh, joint_signs)
