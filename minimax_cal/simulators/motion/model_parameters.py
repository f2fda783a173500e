"""What a simulator's elements hold of an arm in motion: masses, friction, armature, springs.

Masses are pseudo-inertias, in coordinates in which all of them are physical.
A pseudo-inertia (4, 4) of a body is [[S, m c], [m c', m]] with S = tr(I) / 2 - I; it is positive
definite for every body that exists [Wensing, Kim, Slotine 2018].  With the drawn body's lower
factor L, L U U' L' of any upper triangular U with a positive diagonal is one [log-Cholesky, Rucker
and Wensing 2022], and U = 1 is the drawn body.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as ET

import numpy as np
from scipy.spatial.transform import Rotation

from minimax_cal.compensation.exporters.urdf_correction import link_frames_at_zero
from minimax_cal.core.arrays import Array
from minimax_cal.core.errors import OptionError
from minimax_cal.dynamics.laws import TorqueTerm
from minimax_cal.dynamics.regressor import INERTIA_MATRIX_LAYOUT, build_nominal_inertial_parameters
from minimax_cal.fitting.fit import Fit
from minimax_cal.robots.gravity_torques import (
    MIN_SIMULATED_LINK_MASS,
    known_link_mass_mask,
    link_masses_and_centres,
)
from minimax_cal.robots.mjcf_import import (
    MjcfModel,
    body_pose,
    format_exact_numbers,
    import_mujoco,
    read_mujoco_model,
)
from minimax_cal.robots.robot import Robot, load_robot
from minimax_cal.robots.transforms import a_alpha_beta_transform, build_transform, invert_transform
from minimax_cal.robots.urdf_robot import MJCF_SUFFIXES, is_urdf_source
from minimax_cal.robots.xml_document import XmlDocument
from minimax_cal.simulators.arm import SimulatedArm, build_simulated_arm
from minimax_cal.simulators.chain import ORIENTATION_ATTRIBUTES, ModelArm, build_model_arm
from minimax_cal.simulators.corrected_model import correct_model
from minimax_cal.simulators.elements import MIN_DAMPER_TIMESTEPS, set_servo_gains
from minimax_cal.simulators.mjcf import build_new_tree, write_document
from minimax_cal.simulators.mjcf_tree import MjcfTree, format_attributes, set_element

TRIANGLE_ROWS, TRIANGLE_COLUMNS = np.triu_indices(4)  # places of the ten coordinates in U
MIN_RELATIVE_SECOND_MOMENT = 1e-6  # of a body's largest second moment: no principal one is smaller
MIN_BODY_MASS = 1e-4  # of a body without a mass, to begin with [kg]
MASSLESS_BODY_WIDTH = 0.05  # of a body without a size, to begin with [m]


def pseudo_inertia_from_parameters(parameters: Array) -> Array:
    """(..., 4, 4) of inertial parameters (..., 10) about the origin of a frame."""
    about = parameters[..., 4 + INERTIA_MATRIX_LAYOUT]
    half = 0.5 * np.trace(about, axis1=-2, axis2=-1)
    out = np.empty((*parameters.shape[:-1], 4, 4))
    out[..., :3, :3] = half[..., None, None] * np.eye(3) - about
    out[..., :3, 3] = out[..., 3, :3] = parameters[..., 1:4]
    out[..., 3, 3] = parameters[..., 0]
    return out


def parameters_from_pseudo_inertia(pseudo: Array) -> Array:
    """(..., 10) inertial parameters of pseudo-inertias (..., 4, 4)."""
    second = pseudo[..., :3, :3]
    about = np.trace(second, axis1=-2, axis2=-1)[..., None, None] * np.eye(3) - second
    rows, columns = np.triu_indices(3)
    parts = [pseudo[..., 3, 3, None], pseudo[..., :3, 3], about[..., rows, columns]]
    return np.concatenate(parts, axis=-1)


def pseudo_inertia_from_inertia(mass: float, centre: Array, inertia: Array) -> Array:
    """(4, 4) of a body.  centre: (3,) [m].  inertia: (3, 3) about its centre of gravity [kg
    m^2].
    """
    return pseudo_inertia_from_second_moments(
        mass, centre, 0.5 * np.trace(inertia) * np.eye(3) - inertia
    )


def pseudo_inertia_from_second_moments(mass: float, centre: Array, second: Array) -> Array:
    """(4, 4) of a body.  second: (3, 3) second moments about its centre of gravity [kg m^2]."""
    out = mass * np.outer([*centre, 1.0], [*centre, 1.0])
    out[:3, :3] += second
    return out


def principal_second_moments(pseudo: Array, mass: float) -> tuple[Array, Array, Array]:
    """Centre of gravity (3,), principal second moments (3,) about it, and their axes (3, 3)."""
    centre = pseudo[:3, 3] / mass
    return centre, *np.linalg.eigh(pseudo[:3, :3] - mass * np.outer(centre, centre))


def nearest_physical_body(pseudo: Array) -> Array:
    """The nearest body that exists: no mass below LIGHTEST, none thinner than THINNEST."""
    mass = max(float(pseudo[3, 3]), MIN_BODY_MASS)
    centre, size, axes = principal_second_moments(pseudo, mass)
    least = max(
        MIN_RELATIVE_SECOND_MOMENT * float(size.max()),
        MIN_RELATIVE_SECOND_MOMENT * mass * MASSLESS_BODY_WIDTH**2,
    )
    return pseudo_inertia_from_second_moments(
        mass, centre, (axes * np.maximum(size, least)) @ axes.T
    )


@dataclass(frozen=True, eq=False)
class ModelBodies:
    """What each of n joints carries in a simulator's model.

    pseudo_inertias: (n, 4, 4) pseudo-inertia of the joint's body in its own frame.
    carried_pseudo_inertias: (n, 4, 4) of what else the joint alone carries, in the same frame.
    to_link: (n, 4, 4) pose of that frame in the link's frame of the robot [m].
    """

    pseudo_inertias: Array
    carried_pseudo_inertias: Array
    to_link: Array

    @staticmethod
    def read(chain: ModelArm) -> ModelBodies:
        """Of an arm in a compiled model."""
        model, data = chain.model, chain.compute_data_at_zero()
        links = link_frames_at_zero(chain.robot, chain.base)[1:]
        holder, bodies = chain.find_carrying_joints(), chain.body_ids
        drawn, beside, to_link = [], [], []
        for i, body in enumerate(bodies):
            own, others = np.zeros((2, 4, 4))
            for k in np.flatnonzero(holder == i):
                turn = data.ximat[k].reshape(3, 3)
                about = turn @ np.diag(model.body_inertia[k]) @ turn.T
                part = own if k == body else others
                part += pseudo_inertia_from_inertia(float(model.body_mass[k]), data.xipos[k], about)
            here = body_pose(data, body)
            back = invert_transform(here)
            drawn.append(nearest_physical_body(back @ own @ back.T))
            beside.append(back @ others @ back.T)
            to_link.append(invert_transform(links[i]) @ here)
        return ModelBodies(np.array(drawn), np.array(beside), np.array(to_link))

    def link_parameters(self, own: Array) -> Array:
        """(n, 10) parameters of the links in the robot's frames, of bodies (n, 4, 4)."""
        turn = self.to_link
        return parameters_from_pseudo_inertia(
            turn @ (own + self.carried_pseudo_inertias) @ np.swapaxes(turn, -1, -2)
        )

    def at_coordinates(self, coordinates: Array) -> Array:
        """(n, 4, 4) bodies at coordinates (n, 10); 0 is as drawn."""
        half = np.linalg.cholesky(self.pseudo_inertias) @ upper_triangular_factors(coordinates)
        return half @ np.swapaxes(half, -1, -2)

    def link_parameter_jacobian(self, coordinates: Array) -> Array:
        """(n, 10, 10) derivative of each link's parameters by its body's coordinates, one a row."""
        lower = self.to_link @ np.linalg.cholesky(self.pseudo_inertias)
        factor = upper_triangular_factors(coordinates)
        whole = lower @ factor
        size = np.where(
            TRIANGLE_ROWS == TRIANGLE_COLUMNS, factor[:, TRIANGLE_ROWS, TRIANGLE_COLUMNS], 1.0
        )
        left = np.moveaxis(lower[:, :, TRIANGLE_ROWS] * size[:, None], 1, 2)  # (n, 10, 4)
        right = np.moveaxis(whole[:, :, TRIANGLE_COLUMNS], 1, 2)
        change = left[..., :, None] * right[..., None, :]
        return parameters_from_pseudo_inertia(change + np.swapaxes(change, -1, -2))


def upper_triangular_factors(coordinates: Array) -> Array:
    """(n, 4, 4) upper triangular matrices of coordinates (n, 10)."""
    out, own = np.zeros((len(coordinates), 4, 4)), np.arange(4)
    out[:, TRIANGLE_ROWS, TRIANGLE_COLUMNS] = coordinates
    out[:, own, own] = np.exp(out[:, own, own])
    return out


def inertial_attributes(pseudo: Array) -> dict[str, Array]:
    """Attributes of an <inertial>: pos, quat, mass, diaginertia, of a body in its frame."""
    mass = float(pseudo[3, 3])
    centre, size, axes = principal_second_moments(pseudo, mass)
    size = np.maximum(
        size, MIN_RELATIVE_SECOND_MOMENT * size.max()
    )  # else rounding makes it thinner than nothing
    axes = axes * np.linalg.det(axes)
    turn = Rotation.from_matrix(build_transform(axes, np.zeros(3))[:3, :3])
    return {
        "pos": centre,
        "quat": turn.as_quat(scalar_first=True),
        "mass": np.array([mass]),
        "diaginertia": size.sum() - size,
    }


# ---- what elements hold --------------------------------------------------------------------------


POLYNOMIAL_TERMS = 3  # of the speed in MuJoCo's damping: v, v |v|, v^3; of the angle in its springs


@dataclass(frozen=True, eq=False)
class ModelParameters:
    """Of n joints, all in SI and at the joints.

    bodies: (n, 4, 4) pseudo-inertias of the joints' bodies in their own frames.
    armature: (n,) [kg m^2].  friction: (n,) [N m].  damping: (n, 3) of v, v |v|, v^3.
    stiffness: (n, 3) of x, x^2, x^3, x from spring_rest: (n,) [rad].
    gain: (n,) torque of the log per torque of the joint.  delay: by which torques are logged after
    the motion [s].
    laws, law_values: what no element holds, in the unit of the log.
    """

    bodies: Array
    armature: Array
    friction: Array
    damping: Array
    stiffness: Array
    spring_rest: Array
    gain: Array
    delay: float = 0.0
    laws: tuple[TorqueTerm, ...] = ()
    law_values: tuple[Array, ...] = ()

    @property
    def joint_count(self) -> int:
        """How many there are."""
        return len(self.armature)


def read_model_parameters(chain: ModelArm, bodies: ModelBodies) -> ModelParameters:
    """Those of a model; a MuJoCo without polynomials of speed and angle has 0 for them."""
    model, dofs, joints, n = (
        chain.model,
        chain.dof_indices,
        np.array(chain.joint_ids),
        len(chain.joint_ids),
    )
    damping, stiffness = np.zeros((2, n, POLYNOMIAL_TERMS))
    damping[:, 0], stiffness[:, 0] = model.dof_damping[dofs], model.jnt_stiffness[joints]
    if has_damping_polynomials(model):
        damping[:, 1:] = model.dof_dampingpoly[dofs]
        stiffness[:, 1:] = model.jnt_stiffnesspoly[joints]
    return ModelParameters(
        bodies=bodies.pseudo_inertias,
        armature=model.dof_armature[dofs],
        friction=model.dof_frictionloss[dofs],
        damping=damping,
        stiffness=stiffness,
        spring_rest=model.qpos_spring[chain.qpos_indices],
        gain=np.ones(n),
    )


def has_damping_polynomials(model: Any) -> bool:
    """Whether this MuJoCo has polynomials of the speed."""
    return hasattr(model, "dof_dampingpoly")


# ---- written into a model ------------------------------------------------------------------------


MAX_EQUAL_RELATIVE_CHANGE = 1e-12  # relative change of a number that is none
MAX_FRICTION_OFFSET = 4e-6  # friction moves the tool of a new file, at each joint, by no more [m]
HISTORY_MARGIN_SAMPLES = 2  # samples of a delayed signal beyond those of the delay
JOINT_ATTRIBUTES = {  # by their fields of `ModelParameters`
    "armature": "armature", "friction": "frictionloss", "damping": "damping",
    "stiffness": "stiffness",
}  # fmt: skip
MIN_DELAY_TIMESTEPS = 0.5  # a shorter delay is none


def write_model_parameters(
    document: XmlDocument, chain: ModelArm, given: ModelParameters, found: ModelParameters
) -> None:
    """Change a model's elements to the numbers found, where they differ from those given.

    Raises RobotError.
    """
    tree, is_same = (
        MjcfTree(document.root),
        partial(np.allclose, rtol=MAX_EQUAL_RELATIVE_CHANGE, atol=0.0),
    )
    parents = tree.find_parents()
    for i, joint in enumerate(tree.find_joints(chain)):
        # Masses and joints; the coefficients of a polynomial without zeros at their end.
        if not is_same(found.bodies[i], given.bodies[i]):
            set_inertia(parents[joint], found.bodies[i])
        for field, attribute in JOINT_ATTRIBUTES.items():
            pair = (np.atleast_1d(getattr(one, field)[i]) for one in (found, given))
            new, old = (v[: 1 + np.flatnonzero(v).max(initial=0)] for v in pair)
            if new.shape != old.shape or not is_same(new, old):
                joint.set(attribute, format_exact_numbers(new))
        if not is_same(found.stiffness[i], given.stiffness[i]):
            is_angle = chain.model.jnt_type[chain.joint_ids[i]] != 2 and tree.uses_degrees
            joint.set("springref", format_exact_numbers(np.degrees(found.spring_rest[i]) if is_angle
                                           else found.spring_rest[i]))  # fmt: skip

    # Motors of a joint put out what its drive does, of what is commanded.  A delay is of commands
    # that act late, or of torques that are read late.
    delay = delay_attributes(abs(found.delay), chain.timestep)
    for name, gain in zip(chain.joint_names, found.gain, strict=True):
        actuators = tree.find_actuators(name)
        for actuator in actuators if gain != 1.0 else ():
            old_gear = [float(v) for v in actuator.get("gear", "1").split()]
            actuator.set("gear", format_exact_numbers([old_gear[0] / gain, *old_gear[1:]]))
        if delay and found.delay > 0.0:
            sensors = tree.section_or_new("sensor")
            set_element(sensors, "jointactuatorfrc", f"{name}_torque", joint=name, **delay)
        elif delay:
            for actuator in actuators:
                actuator.attrib |= delay


def set_inertia(body: ET.Element, pseudo: Array) -> None:
    """Give a body the mass and inertia of a pseudo-inertia (4, 4), as its first element."""
    element = set_element(body, "inertial")
    for name in (*ORIENTATION_ATTRIBUTES, "fullinertia"):
        element.attrib.pop(name, None)
    element.attrib |= format_attributes(inertial_attributes(pseudo))
    if list(body).index(element) and body.find("joint") is not None:
        body.remove(element)
        body.insert(0, element)


def delay_attributes(delay: float, timestep: float) -> dict[str, str]:
    """Attributes of a signal with a delay [s]; none where it is no delay at that timestep [s]."""
    if delay < MIN_DELAY_TIMESTEPS * timestep:
        return {}
    count = math.ceil(delay / timestep) + HISTORY_MARGIN_SAMPLES
    return {"delay": format_exact_numbers([delay]), "nsample": str(count), "interp": "linear"}


def raise_servo_gains_for_friction(
    root: ET.Element, chain: ModelArm, parameters: ModelParameters
) -> None:
    """Let position servos of a new file hold the arm where it is commanded, for all its friction.

    A servo of gain k stops within friction / k of its command.
    """
    arm, tree = SimulatedArm.rigid(chain.robot), MjcfTree(root)
    needed = (
        parameters.friction
        * np.where(chain.robot.prismatic, 1.0, arm.largest_levers)
        / MAX_FRICTION_OFFSET
    )
    for i, name in enumerate(chain.joint_names):
        for servo in tree.find_actuators(name):
            if servo.tag != "position" or needed[i] <= float(servo.get("kp", "0")):
                continue
            inertia = float(servo.get("kv", "0")) ** 2 / (4.0 * float(servo.get("kp", "1")))
            damper = 2.0 * np.sqrt(needed[i] * inertia)
            step = chain.timestep
            set_servo_gains(servo, needed[i], max(damper, MIN_DAMPER_TIMESTEPS * step * needed[i]))


def new_model(
    robot: Robot, arm: SimulatedArm | None = None, target_names: Sequence[str] = ()
) -> XmlDocument:
    """A new file of a robot: its masses as drawn, position servos that hold it.

    arm: what bends in it, by springs of its own; nothing unless given.
    """
    tree = build_new_tree(
        arm or SimulatedArm.rigid(robot), target_names, with_springs=arm is not None
    )
    bodies = {str(body.get("name")): body for body in tree.root.iter("body")}
    drawn = build_nominal_inertial_parameters(robot)
    for i in np.flatnonzero(known_link_mass_mask(robot)):
        place = a_alpha_beta_transform(
            robot.mdh[i]
        )  # of the link's frame in that of its joint, the body's
        moved = place @ pseudo_inertia_from_parameters(drawn[i]) @ place.T
        if drawn[i, 0] > MIN_SIMULATED_LINK_MASS and np.linalg.eigvalsh(moved)[0] > 0.0:
            set_inertia(bodies[f"link{i + 1}"], moved)
    return XmlDocument(tree.root)


def find_links_with_other_masses(chain: ModelArm, pseudo_inertias: Array) -> list[str]:
    """Links whose masses MuJoCo did not take from the file.  pseudo_inertias: (n, 4, 4)."""
    got = ModelBodies.read(chain).pseudo_inertias
    off = np.abs(
        parameters_from_pseudo_inertia(got) - parameters_from_pseudo_inertia(pseudo_inertias)
    ).max(axis=1)
    size = np.abs(parameters_from_pseudo_inertia(pseudo_inertias)).max(axis=1)
    return [chain.joint_names[int(i)] for i in np.flatnonzero(off > 1e-6 * size)]


# ---- a model to be corrected ---------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class OpenedModel:
    """A model and its arm.  given: its file.  is_new: whether made of a robot file or URDF."""

    given: MjcfModel
    chain: ModelArm
    is_new: bool

    def with_document(self, document: XmlDocument) -> OpenedModel:
        """The same arm in a changed tree."""
        given = replace(self.given, document=document)
        return replace(self, given=given, chain=self.chain.with_model(given.compile_model()))

    def with_moved_bodies(self, given: MjcfModel) -> OpenedModel:
        """The arm of the same joints, whose bodies may stand elsewhere."""
        model = given.compile_model()
        joints = self.chain.find_joint_ids(model)
        chain = build_model_arm(model, joints, given.source, has_assumed_masses=given.assumed)
        return replace(self, given=given, chain=chain)

    def move_dampers_to_servos(self) -> OpenedModel:
        """The same, its servos with the dampers that joints of a new file hold for them.

        Along logs the damping of a joint is friction, and a servo's damper is part of its torque.
        """
        chain, tree = self.chain, MjcfTree(self.given.document.root)
        is_held = chain.has_servo_dampers()
        for i, joint in enumerate(tree.find_joints(chain)):
            if is_held[i]:
                servo = chain.model.actuator(chain.servo_ids[i])
                damper = float(joint.attrib.pop("damping")) / float(servo.gear[0]) ** 2
                set_element(tree.section_or_new("actuator"), "position", str(servo.name), kv=damper)
        return self.with_document(self.given.document)

    def has_correctable_servos(self) -> bool:
        """Whether every joint has a servo of its own that can be given other numbers."""
        chain, tree = self.chain, MjcfTree(self.given.document.root)
        tags = [{e.tag for e in tree.find_actuators(name)} for name in chain.joint_names]
        is_servo = all({"position", "general"} & some for some in tags)
        return is_servo and not chain.model.actuator_dyntype[chain.servo_ids].any()

    def write(self, path: Path) -> None:
        """Write the file, and what it includes and changed beside it."""
        write_document(self.given.document, self.given.folder, path)


def open_model(
    model: Path | str, joint_count: int, tip: str = "", *, with_free_joints: bool = True
) -> OpenedModel:
    """The arm of so many joints in a model's file; of a robot file or URDF a new model.

    with_free_joints: whether servos get the dampers that joints hold for them.  Raises
    CalibrationError.
    """
    import_mujoco()
    if Path(model).suffix.lower() in MJCF_SUFFIXES and not is_urdf_source(Path(model)):
        given = read_mujoco_model(model)
        chain = ModelArm.find_in_model(given, joint_count, tip)
        opened = OpenedModel(given, chain, is_new=False)
        return opened.move_dampers_to_servos() if with_free_joints else opened
    robot = load_robot(model)
    if robot.joints != joint_count:
        raise OptionError(f"{model}: has {robot.joints} joints, the logs have {joint_count}")
    given = MjcfModel(str(model), new_model(robot), Path())
    chain = ModelArm.find_in_model(given, joint_count)
    opened = OpenedModel(given, chain, is_new=True)
    return opened.move_dampers_to_servos() if with_free_joints else opened


def apply_calibration(opened: OpenedModel, fit: Fit) -> tuple[OpenedModel, tuple[str, ...]]:
    """The model with the arm of a static calibration in it, and notices."""
    names = fit.cell.target_names
    if opened.is_new:
        arm = build_simulated_arm(
            fit.cell, fit.train.q, link_masses_and_centres(fit.cell.robot, MIN_SIMULATED_LINK_MASS)
        )
        document = new_model(fit.cell.robot, arm, names)
        given = replace(opened.given, document=document)
        return opened.with_moved_bodies(given).move_dampers_to_servos(), ()
    nominal = fit.nominal.robot
    arm = build_simulated_arm(fit.cell, fit.train.q, opened.chain.find_masses(nominal))
    driven = bool((opened.chain.servo_ids >= 0).any())
    made = correct_model(opened.given, opened.chain, nominal, arm, names, with_servos=driven)
    notices = made.notices
    if not driven and (arm.encoder_gains.any() or arm.couplings):
        notices += (
            "not in the model: encoder gains and couplings, which only position servos hold",
        )
    return opened.with_moved_bodies(replace(opened.given, document=made.document)), notices
