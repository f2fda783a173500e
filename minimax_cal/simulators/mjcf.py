"""The exporter `mjcf`: a new file of a calibrated arm, or a given one with the arm in it.

The world of a new file is the robot's base frame, in metres and radians; joint values are the
controller's.
"""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import NamedTuple
from xml.etree import ElementTree as ET

import numpy as np

from minimax_cal.compensation.exporters.export_job import ExportedFile, ExportJob, joint_origins
from minimax_cal.compensation.exporters.urdf_file import describe_inertia_assumptions
from minimax_cal.core.errors import OptionError
from minimax_cal.core.files import write_file_atomically
from minimax_cal.modelling.cell import Cell, build_measurements_at_rest
from minimax_cal.modelling.effects.table import Fitted, Term
from minimax_cal.robots.gravity_torques import STANDARD_GRAVITY
from minimax_cal.robots.mjcf_import import import_mujoco, read_mujoco_model, set_asset_directories
from minimax_cal.robots.transforms import a_alpha_beta_transform
from minimax_cal.robots.xml_document import XmlDocument, XmlWriteOptions
from minimax_cal.simulators.arm import (
    SimulatedArm,
    assign_effects_without_masses,
    build_simulated_arm,
    sample_workspace,
)
from minimax_cal.simulators.chain import ROBOT_TEXT_NAME, ModelArm, ModelServos, find_model_arm
from minimax_cal.simulators.corrected_model import correct_model
from minimax_cal.simulators.drive import measure_target_offsets
from minimax_cal.simulators.elements import ArmLayout, set_link_mass, write_arm_elements
from minimax_cal.simulators.mjcf_tree import MjcfTree, add_element, pose_attributes

ROD_RADIUS = 0.02  # of the links that are drawn [m]
NEW_TIMESTEP = 0.002  # of a new file [s]


def build_mjcf_file(job: ExportJob) -> ExportedFile:
    """A new MJCF, or the given one corrected; a command map beside it where effects need one.

    A given model keeps its own masses, unless those are assumed.
    Raises CalibrationError.
    """
    if not job.model:
        cell = job.cell or Cell(job.robot, np.eye(4), (), np.zeros((0, 3)))
        arm, base = build_simulated_arm(cell, job.q), np.eye(4)
        content = build_new_tree(arm, cell.target_names).to_bytes()
        beside, chain = dict[str, bytes](), None
        notices: tuple[str, ...] = (describe_inertia_assumptions(job.robot),)
        if find_spec("mujoco") and cell.target_names:
            model = import_mujoco().MjModel.from_xml_string(content.decode())
            chain = find_model_arm(model, job.robot.joints, job.source)
    else:
        if job.cell is None or not job.fitted:
            raise OptionError(
                f"{job.source}: mjcf= is corrected by a calibration: give one, not a robot"
            )
        cell, given = job.cell, read_mujoco_model(job.model)
        chain = ModelArm.find_in_model(given, job.robot.joints, job.tip)
        arm = build_simulated_arm(cell, job.q, chain.find_masses(job.nominal))
        q = sample_workspace(job.robot) if job.q is None else job.q
        chain.check_force_limits(q, given.source)
        made = correct_model(given, chain, job.nominal, arm, cell.target_names)
        chain = chain.with_model(
            given.compile_model(made.document.root)
        )  # before assets are renamed
        content, beside = format_document(made.document, given.folder, job.path)
        base, notices = made.base, made.notices
    offsets = None if chain is None else partial(measure_target_offsets, chain, cell, arm, base)
    beside |= arm.format_command_map(cell)
    return ExportedFile(content, (*notices, *arm.list_limitations()), beside, offsets)


def list_effects_held_by_mjcf(cell: Cell) -> tuple[Term, ...]:
    """The effects of a cell that elements hold, or a command map; those of 0 need nothing."""
    data = build_measurements_at_rest(
        np.zeros((1, cell.robot.joints)), cell.target_names, cell.robot
    )
    alone = ((term, replace(cell, effects=Fitted.from_pairs([(term, values)])))
             for term, values in cell.effects.terms_with_values)  # fmt: skip
    return tuple(
        term for term, one in alone if not assign_effects_without_masses(one, data).left_out
    )


class DocumentFiles(NamedTuple):
    """The bytes of a document, and of the files beside it by their ending."""

    content: bytes
    companion_files: dict[str, bytes]


def format_document(document: XmlDocument, source: Path, path: Path | None) -> DocumentFiles:
    """The text of a changed document at path: beside the given one its bytes but for the changes.

    Elsewhere it says where its assets are.  What it includes and what changed is in files of their
    own, by the ending that takes the place of the path's.  source: folder of the given file.
    """
    here = source.resolve()
    is_elsewhere = path is not None and path.resolve().parent != here
    if is_elsewhere and path is not None and any(e.get("file") for e in document.root.iter()):
        set_asset_directories(document.root, Path(os.path.relpath(here, path.resolve().parent)))
    if not document.pieces:
        return DocumentFiles(MjcfTree(document.root).to_bytes(), {})
    how = XmlWriteOptions(is_elsewhere, path.stem if path else "")
    return DocumentFiles(document.to_bytes(how), how.beside)


def write_document(document: XmlDocument, source: Path, path: Path) -> None:
    """Write a changed document to a path, and what it includes and changed beside it."""
    content, beside = format_document(document, source, path)
    for ending, text in beside.items():
        write_file_atomically(path.with_suffix(ending), text)
    write_file_atomically(path, content)


def build_new_tree(
    arm: SimulatedArm, target_names: Sequence[str], *, with_springs: bool = False
) -> MjcfTree:
    """A new file of an arm: bodies link1 ... linkn, masses, servos, springs, and rods to see.

    with_springs: as in `write_arm_elements`.
    """
    robot, n = arm.robot, arm.robot.joints
    root = ET.Element("mujoco", {"model": robot.name})
    root.append(ET.Comment(" written by minimax-cal; world = base of the robot; m, rad "))
    add_element(root, "compiler", angle="radian", autolimits="true")
    add_element(root, "option", gravity=-STANDARD_GRAVITY * robot.up, integrator="implicitfast",
                timestep=NEW_TIMESTEP)  # fmt: skip
    custom = add_element(root, "custom")
    add_element(custom, "text", name=ROBOT_TEXT_NAME, data=json.dumps(robot.to_dict()))
    parent, bodies, joints = add_element(root, "worldbody"), [], []
    for i, pose in enumerate(joint_origins(robot)[:-1]):
        at = pose_attributes(arm.mount @ pose if i == 0 else pose)
        parent = add_element(parent, "body", name=f"link{i + 1}", **at)
        bodies.append(parent)
        set_link_mass(parent, arm, i)

        # The joint, with limits where both ends are known.
        ends = np.array([robot.lower[i], robot.upper[i]])
        limits = {"range": ends} if np.isfinite(ends).all() else {}
        joints.append(add_element(
            parent, "joint", name=f"joint{i + 1}", type="slide" if robot.prismatic[i] else "hinge",
            axis=[0.0, 0.0, float(robot.sign[i])], **limits,
        ))  # fmt: skip

        # A rod along the joint axis and one along the link, that touch nothing.
        row, origin = robot.mdh[i], np.zeros(3)
        for start, end in (
            (np.array([0.0, 0.0, -row[1]]), origin),
            (origin, a_alpha_beta_transform(row)[:3, 3]),
        ):
            if np.linalg.norm(end - start) > ROD_RADIUS:
                add_element(
                    parent, "geom", type="capsule", fromto=np.concatenate([start, end]),
                    size=[ROD_RADIUS], contype="0", conaffinity="0", group="2", mass="0",
                )  # fmt: skip
    add_element(root, "actuator")
    axes = np.array([[0.0, 0.0, 1.0]]) * robot.sign[:, None]
    names = tuple(f"joint{i + 1}" for i in range(n))
    tree = MjcfTree(root)
    layout = ArmLayout(tree, names, tuple(bodies), tuple(joints),
                    np.broadcast_to(np.eye(4), (n, 4, 4)), np.zeros((n, 3)), axes,
                    ModelServos.of_joints_without_drives(n), np.zeros(n), NEW_TIMESTEP)  # fmt: skip
    write_arm_elements(layout, arm, target_names, with_springs=with_springs)
    return tree
