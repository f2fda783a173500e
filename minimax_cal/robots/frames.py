"""A frame as people write it: origin in mm, A, B, C in degrees; quaternion and rotation vector.

A turns about z, B about the y axis that results, C about the x axis that results then, as KUKA
does: the rotation is Rz(A) Ry(B) Rx(C).  And the links of an arm as its file writes them.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from minimax_cal.ground.arrays import Array
from minimax_cal.ground.tables import Table
from minimax_cal.ground.units import for_people, turned_for_people
from minimax_cal.robots.kinematics import MDH_NAMES, quaternion, rotation_vector
from minimax_cal.robots.transforms import from_rpy, level_rpy

if TYPE_CHECKING:
    from minimax_cal.robots.robot import Robot

CONVENTION = "A about z, then B about y, then C about x, each axis as turned: Rz(A) Ry(B) Rx(C)"
LENGTHS = ("a", "d")
Triple = tuple[float, float, float]


@dataclass(frozen=True)
class Frame:
    """A rigid motion: where a frame stands in another.  Angles A, B, C; B within 90 degrees."""

    xyz_mm: Triple
    abc_deg: Triple
    quaternion_wxyz: tuple[float, float, float, float]
    rotation_vector_rad: Triple

    @staticmethod
    def of(pose: Array) -> Frame:
        """From a pose (4, 4) [m]."""
        (length, _), (angle, _) = for_people("m"), turned_for_people("rad")
        x, y, z = (length * pose[:3, 3]).tolist()
        c, b, a = (angle * level_rpy(pose)).tolist()
        w, *v = quaternion(pose[:3, :3]).tolist()
        turn = rotation_vector(pose[:3, :3]).tolist()
        return Frame((x, y, z), (a, b, c), (w, *v), tuple(turn))

    @property
    def pose(self) -> Array:
        """(4, 4) [m]."""
        a, b, c = self.abc_deg
        scale, _ = turned_for_people("rad")
        xyz = np.array(self.xyz_mm) / for_people("m")[0]
        return from_rpy(xyz, np.array([c, b, a]) / scale)

    @property
    def distance_mm(self) -> float:
        """Of its origin."""
        return float(np.linalg.norm(self.xyz_mm))

    def to_dict(self) -> dict[str, Any]:
        """For JSON."""
        return {name: list(value) for name, value in vars(self).items()}


def frames_tables(frames: Mapping[str, Frame], title: str) -> tuple[Table, Table]:
    """Frames by their names as X, Y, Z and A, B, C, and as quaternions and rotation vectors."""
    return (
        Table.made(
            f"{title}; {CONVENTION}",
            [(name, *frame.xyz_mm, *frame.abc_deg) for name, frame in frames.items()],
            "frame | X mm .3f | Y mm .3f | Z mm .3f | A deg .4f | B deg .4f | C deg .4f",
        ),
        Table.made(
            "the same rotations as unit quaternions (w, x, y, z) and as rotation vectors",
            [(n, *f.quaternion_wxyz, *f.rotation_vector_rad) for n, f in frames.items()],
            "frame | w .6f | x .6f | y .6f | z .6f | rx rad .6f | ry rad .6f | rz rad .6f",
        ),
    )


def links_table(robot: Robot) -> Table:
    """Links and limits in millimetres and degrees, in the convention of the robot's file."""
    units = [turned_for_people("m" if name in LENGTHS else "rad") for name in MDH_NAMES]
    own, _ = robot.notation.written(robot.mdh, robot.prismatic)
    rows = (
        (f"J{i + 1}", *(size * part for (size, _), part in zip(units, link, strict=True)),
         scale * robot.lower[i], scale * robot.upper[i], unit)
        for i, link in enumerate(own)
        for scale, unit in [turned_for_people("m" if robot.prismatic[i] else "rad")]
    )  # fmt: skip
    heads = (f"{name} {unit} .3f" for name, (_, unit) in zip(MDH_NAMES, units, strict=True))
    craig = " (modified DH)" if robot.notation.modified else ""
    title = f"{robot.name}: links and limits{craig}"
    return Table.made(title, rows, "joint", *heads, "from .1f", "to .1f", "in")
