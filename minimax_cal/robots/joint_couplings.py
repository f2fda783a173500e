"""Joints that others take along: linked arms, coupled wrists, palletisers, a URDF's `mimic`.

A joint of the chain turns by the sum over the controller's joint values, each times its entry of a
matrix (n, n); signs come after.  A joint whose own column is empty has no drive: its value is 0.
"""

from __future__ import annotations

import difflib
import re
from collections.abc import Mapping, Sequence

import numpy as np

from minimax_cal.core.arrays import Array
from minimax_cal.core.errors import RobotError

NO_COUPLING: Array = np.zeros((0, 0))
MAX_COUPLING_FACTOR = 1e3  # of a coupling: no gear between two joints of an arm is higher


def build_coupling_matrix(
    coupling: Mapping[str, Mapping[str, float]] | Sequence[Sequence[float]] | None,
    joint_names: Sequence[str],
    source: str,
) -> Array:
    """The matrix (n, n) of a robot file, (0, 0) for none.  Raises RobotError.

    coupling: rows, or by joint (J3, or its name) what other joints add to it; its own share is 1
    unless told, and 0 for a joint without a drive.  joint_names: of the n joints, '' for none.
    """
    if not coupling:
        return NO_COUPLING
    n = len(joint_names)
    if isinstance(coupling, Mapping):
        matrix = np.eye(n)
        for joint, shares in coupling.items():
            row = find_joint_index(joint, joint_names, source)
            for other, share in shares.items():
                matrix[row, find_joint_index(other, joint_names, source)] = share
    elif len(coupling) == n and all(len(row) == n for row in coupling):
        matrix = np.array(coupling, dtype=float)
    else:
        raise RobotError(
            f"{source}: coupling: must be {n} rows of {n} numbers, or as "
            '{"J3": {"J2": 1.0}}: joint 3 turns by its own value and that of joint 2'
        )
    if np.abs(matrix).max() > MAX_COUPLING_FACTOR:
        raise RobotError(f"{source}: coupling: {np.abs(matrix).max():g} cannot be")
    if (matrix == np.eye(n)).all():
        return NO_COUPLING
    check_independent_drives(matrix, source)
    return matrix


def check_independent_drives(matrix: Array, source: str) -> None:
    """Raise RobotError unless every drive moves the arm in a way of its own."""
    driven = matrix.any(axis=0)
    if np.any(alone := ~driven & ~matrix.any(axis=1)):
        number = int(np.argmax(alone)) + 1
        raise RobotError(
            f"{source}: coupling: joint {number} neither has a drive nor follows another joint; "
            "leave it out of the joints"
        )
    if np.linalg.matrix_rank(matrix[:, driven]) < np.count_nonzero(driven):
        raise RobotError(
            f"{source}: coupling: two joint values move the arm alike; check its numbers"
        )


def find_joint_index(joint_key: str, joint_names: Sequence[str], source: str) -> int:
    """Which joint a key means: J1 ... Jn, or its name.  Raises RobotError."""
    if joint_key in joint_names:
        return joint_names.index(joint_key)
    found = re.fullmatch(r"[Jj](\d+)", joint_key)
    if found and 1 <= int(found[1]) <= len(joint_names):
        return int(found[1]) - 1
    known = [*(f"J{i + 1}" for i in range(len(joint_names))), *filter(None, joint_names)]
    (near,) = difflib.get_close_matches(joint_key, known, 1, cutoff=0.0)
    raise RobotError(f"{source}: coupling: no joint {joint_key[:60]!r}; did you mean {near!r}?")


def coupling_to_dict(matrix: Array) -> dict[str, dict[str, float]]:
    """As a robot file has it: what differs from each joint by itself."""
    out: dict[str, dict[str, float]] = {}
    for i, j in np.argwhere(matrix != np.eye(len(matrix))).tolist():
        out.setdefault(f"J{i + 1}", {})[f"J{j + 1}"] = float(matrix[i, j])
    return out


def insert_passive_joint_zeros(driven_values: Array, passive_joints: Array) -> Array:
    """Values (..., n) of all joints, of those (..., c) with a drive: 0 for the others."""
    if (
        not passive_joints.any()
        or not driven_values.ndim
        or driven_values.shape[-1] != np.count_nonzero(~passive_joints)
    ):
        return driven_values
    out = np.zeros((*driven_values.shape[:-1], len(passive_joints)), dtype=driven_values.dtype)
    out[..., ~passive_joints] = driven_values
    return out
