"""Breakages of which it is known what they do, and answers of an independent code."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable
from typing import Any

import numpy as np

from .mutations import Rng, pick, table, text_of

Array = np.ndarray[Any, np.dtype[np.float64]]


# ---- changes that change nothing ---------------------------------------------------------------


def degrees(rows: list[list[str]], rng: Rng) -> None:
    """Joints in degrees, and so named."""
    degrees_called_radians(rows, rng)
    rows[0] = [name.replace("rad", "deg") for name in rows[0]]


def metres(rows: list[list[str]], rng: Rng) -> None:
    """Points in metres, and so named."""
    metres_called_millimetres(rows, rng)
    rows[0] = [re.sub("^(smr.*)_mm$", r"\1_m", name) for name in rows[0]]


def other_order(rows: list[list[str]], rng: Rng) -> None:
    """Rows in another order."""
    body = rows[1:]
    rows[1:] = [body[i] for i in rng.permutation(len(body))]


def other_columns(rows: list[list[str]], rng: Rng) -> None:
    """Columns in another order."""
    order = rng.permutation(len(rows[0]))
    rows[:] = [[row[i] for i in order] for row in rows]


def with_a_note(rows: list[list[str]], rng: Rng) -> None:
    """A column of words that nobody uses."""
    rows[:] = [[*row, "note" if row is rows[0] else "fine"] for row in rows]


def quoted_and_spaced(rows: list[list[str]], rng: Rng) -> None:
    """Blanks about the cells, and an empty line at the end."""
    rows[1:] = [[f" {cell} " for cell in row] for row in rows[1:]]
    rows.append([""] * len(rows[0]))


HARMLESS = (degrees, metres, other_order, other_columns, with_a_note, quoted_and_spaced)


# ---- changes that nobody may pass over in silence ----------------------------------------------


def columns(rows: list[list[str]], start: str) -> list[int]:
    """Where columns stand whose names begin so."""
    return [i for i, name in enumerate(rows[0]) if name.startswith(start)]


def scaled(rows: list[list[str]], at: list[int], factor: float) -> None:
    """Columns times a factor."""
    for row in rows[1:]:
        for i in at:
            row[i] = repr(float(row[i]) * factor)


def degrees_called_radians(rows: list[list[str]], rng: Rng) -> None:
    """Joints in degrees under the old names."""
    scaled(rows, columns(rows, "q"), 180.0 / math.pi)


def metres_called_millimetres(rows: list[list[str]], rng: Rng) -> None:
    """Points in metres under the old names."""
    scaled(rows, columns(rows, "smr"), 1e-3)


def inches(rows: list[list[str]], rng: Rng) -> None:
    """Points in inches under the old names."""
    scaled(rows, columns(rows, "smr"), 1.0 / 25.4)


def mirrored(rows: list[list[str]], rng: Rng) -> None:
    """One coordinate of all points with the other sign: a left-handed frame."""
    scaled(rows, [i for i in columns(rows, "smr") if "_y_" in rows[0][i]], -1.0)


def one_mirrored(rows: list[list[str]], rng: Rng) -> None:
    """One coordinate of one target with the other sign."""
    scaled(rows, [pick(rng, columns(rows, "smr"))], -1.0)


def joint_sign(rows: list[list[str]], rng: Rng) -> None:
    """A joint that counts the other way."""
    scaled(rows, [columns(rows, f"q{int(rng.integers(2, 6))}_")[0]], -1.0)


def shifted_rows(rows: list[list[str]], rng: Rng) -> None:
    """Points belong to the joints of the row before."""
    at = columns(rows, "smr")
    cells = [[row[i] for i in at] for row in rows[1:]]
    for row, other in zip(rows[1:], [cells[-1], *cells[:-1]], strict=True):
        for i, cell in zip(at, other, strict=True):
            row[i] = cell


def far_point(rows: list[list[str]], rng: Rng) -> None:
    """One point is a metre off."""
    row = rows[1 + int(rng.integers(len(rows) - 1))]
    i = pick(rng, columns(rows, "smr"))
    row[i] = repr(float(row[i]) + 1000.0)


FATAL = (
    degrees_called_radians, metres_called_millimetres, inches, mirrored, one_mirrored, joint_sign,
    shifted_rows, far_point,
)  # fmt: skip


def with_known(raw: bytes, way: Callable[[list[list[str]], Rng], None], rng: Rng) -> bytes:
    """Measurements after a change of which it is known what it does."""
    rows = [list(row) for row in table(raw)]
    way(rows, rng)
    return text_of(rows)


# ---- answers of an independent code ------------------------------------------------------------


def flange(robot: dict[str, Any], q: Array) -> Array:
    """(4, 4) pose in the base, link by link: Rz(sign q + theta) Tz(d) Tx(a) Rx(alpha) Ry(beta)."""
    length = {"mm": 1e-3, "m": 1.0}[robot.get("units", {}).get("length", "mm")]
    angle = {"rad": 1.0, "deg": math.pi / 180}[robot.get("units", {}).get("angle", "rad")]
    out = np.eye(4)
    for joint, value in zip(robot["joints"], q, strict=True):
        move, sign = np.eye(4), joint.get("sign", 1)
        turns = joint.get("type", "revolute") == "revolute"
        theta = angle * joint.get("theta", 0.0) + (sign * value if turns else 0.0)
        move[:3, 3] = 0.0, 0.0, length * joint.get("d", 0.0) + (0.0 if turns else sign * value)
        move[:3, :3] = turn(2, theta)
        across = np.eye(4)
        across[0, 3] = length * joint.get("a", 0.0)
        across[:3, :3] = turn(0, angle * joint.get("alpha", 0.0)) @ turn(
            1, angle * joint.get("beta", 0.0)
        )
        out = out @ move @ across
    return out


def turn(axis: int, angle: float) -> Array:
    """(3, 3) rotation about an axis."""
    c, s = math.cos(angle), math.sin(angle)
    i, j = [k for k in range(3) if k != axis]
    out = np.eye(3)
    out[i, i] = out[j, j] = c
    out[i, j], out[j, i] = (s, -s) if axis == 1 else (-s, s)
    return out


def rodrigues(vector: Array) -> Array:
    """(3, 3) rotation of a rotation vector."""
    angle = float(np.linalg.norm(vector))
    if angle == 0.0:
        return np.eye(3)
    x, y, z = vector / angle
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.asarray(np.eye(3) + math.sin(angle) * cross + (1.0 - math.cos(angle)) * cross @ cross)


def distances_mm(
    fit: dict[str, Any], rows: list[list[str]], moved: bool = False
) -> list[tuple[int, float]]:
    """Line of the file and distance [mm] of each measured point from where a fit has it.

    moved: the instrument stood elsewhere, the points are first laid on the fit's as one rigid body.
    """
    unit = {"rad": 1.0, "deg": math.pi / 180, "mm": 1e-3, "m": 1.0}
    at = {name: i for i, name in enumerate(rows[0])}
    base = rodrigues(np.array(fit["base"]["rotation_vector_rad"]))
    origin = np.array(fit["base"]["translation_mm"]) * 1e-3
    joints = sorted(
        (n for n in at if n.startswith("q") and n[1].isdigit()), key=lambda n: int(n[1])
    )
    lines, measured, expected = [], [], []
    for line, row in enumerate(rows[1:], 2):
        if not any(cell.strip() for cell in row):
            continue
        pose = flange(fit["robot"], [float(row[at[n]]) * unit[n.split("_")[1]] for n in joints])
        for name, place in fit["targets_mm"].items():
            length = "mm" if f"{name}_x_mm" in at else "m"
            cells = [row[at[f"{name}_{axis}_{length}"]] for axis in "xyz"]
            if not cells[0].strip():
                continue
            lines.append(line)
            measured.append(np.array(cells, dtype=float) * unit[length])
            expected.append(origin + base @ (pose[:3, :3] @ (np.array(place) * 1e-3) + pose[:3, 3]))
    there = np.array(expected)
    if moved:
        there = laid_on(there, np.array(measured))
    return list(zip(lines, 1e3 * np.linalg.norm(measured - there, axis=1), strict=True))


def laid_on(points: Array, others: Array) -> Array:
    """(n, 3) points after the rigid motion that brings them nearest to others (n, 3), by Kabsch."""
    middle, there = points.mean(axis=0), others.mean(axis=0)
    u, _, vt = np.linalg.svd((points - middle).T @ (others - there))
    vt[2] *= np.linalg.det(u @ vt)
    return np.asarray((points - middle) @ u @ vt + there)


def rms(values: list[float]) -> float:
    """Root of the mean square."""
    return math.sqrt(sum(v * v for v in values) / len(values))


def disagreement(
    answer: str, raw: bytes, fit_text: bytes | None, nominal: bool = False, moved: bool = False
) -> str:
    """Where the accuracy that a command printed is not that of its own robot on the file; ''.

    fit_text: the fit that was evaluated, None for one that the answer itself holds.  nominal: its
    arm before calibration was asked for.  moved: the frame was fitted anew to the file.
    """
    found = json.loads(answer)
    fit = json.loads(fit_text) if fit_text else found
    if nominal:
        fit = {**fit["nominal_cell"], "robot": fit["nominal_robot"]}
    if fit.get("effects") or fit.get("cell", {}).get("effects"):
        return ""  # they move the points, too
    rows = table(raw.removeprefix(b"\xef\xbb\xbf"))
    if fit_text:
        mine = [d for _, d in distances_mm(fit, rows, moved)]
        return unlike(found["accuracy"]["rms_mm"], rms(mine))
    held = dict(zip(found["poses"]["line"], found["poses"]["split"], strict=True))
    for part in ("train", "holdout"):
        mine = [d for line, d in distances_mm(fit, rows) if held.get(line) == part]
        if mine and (said := unlike(found["accuracy"][part]["rms_mm"], rms(mine))):
            return f"{part}: {said}"
    return ""


def unlike(theirs: float, mine: float) -> str:
    """'' for two RMS [mm] that agree to what nine digits of joints and six of mm can tell."""
    close = abs(theirs - mine) <= 1e-4 + 1e-6 * abs(mine)
    return "" if close else f"says {theirs:.6g} mm, is {mine:.6g} mm"
