"""The elements of an MJCF that make it bend, sag and play as an arm does; written into its tree.

Every spring has a damper of SPRING_TIME times its stiffness: the simulator takes dampers
implicitly, so that no spring is too stiff for its timestep, however light what hangs on it.
Springs feel all of gravity, though its bodies are compensated for the actuators: the compensation
counts as an actuator's force, and joints that are springs let none pass (`actuatorfrcrange`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from xml.etree import ElementTree as ET

import numpy as np

from minimax_cal.compensation.exporters.urdf_correction import link_frames_at_zero
from minimax_cal.compensation.exporters.urdf_file import centre_of_gravity_in_urdf_link
from minimax_cal.core.arrays import Array
from minimax_cal.robots.gravity_torques import (
    STANDARD_GRAVITY,
    assumed_link_inertia,
    joint_gravity_torques,
    link_mass_centres_in_base,
)
from minimax_cal.robots.joint_sampling import random_joint_values_above_floor
from minimax_cal.robots.kinematics import compute_link_frames, cross
from minimax_cal.robots.mjcf_import import format_exact_numbers
from minimax_cal.robots.robot import Robot
from minimax_cal.robots.transforms import (
    a_alpha_beta_transform,
    invert_transform,
    perpendicular_unit_vectors,
    theta_d_transform,
    translation,
)
from minimax_cal.simulators.arm import TOOL_LEVER, SimulatedArm
from minimax_cal.simulators.chain import ModelServos
from minimax_cal.simulators.mjcf_tree import (
    MjcfTree,
    add_element,
    format_attributes,
    pose_attributes,
    set_element,
)

SERVO_FREQUENCY = 15.0  # at the largest inertia: 1.5 s of rest leave 4e-9 [rad/s]
MIN_DAMPING_RATIO = 0.7  # with which a given damper stays
MIN_SERVO_POLE = 7.5  # of a given servo that stays [1/s]
MIN_GAIN_SHARE = 0.1  # of the largest gain, for joints that carry little: as published models do
MAX_GAIN_RATIO = 10.0  # to the largest gain that a smooth move needs
MAX_STIFF_SAG = 2e-6  # of the tool, by gravity at a joint that is stiff [m]
MIN_DAMPER_TIMESTEPS = 2.0  # in a damper's own time: then no stiffness shakes
NEGLIGIBLE_COMPLIANCE = 1e-12  # [rad/(N m)], and of sag [rad]
LOAD_SAMPLES = 200  # poses at which loads are looked for
SPRING_TIME = 0.02  # in which a spring comes to rest [s]
SPRING_INERTIA = 0.01  # of what a spring carries, its own: parallel hinges need some
SAG_WEIGHT = 1e-5  # mass of each weight that makes the tool sag, which no joint is to feel [kg]
BALANCER_ANCHOR = 0.3  # distance of the balancing spring's anchor from joint 2 [m]
MOTOR_COMPLIANCE = 1e-9  # of a joint that nothing but its motor holds [rad/(N m)]
MAX_TORQUE = 1e9  # of a joint where one side alone is limited [N m]
MAX_SPRING_ACTUATION = 1e-12  # of an actuator's force through a joint that is a spring [N m]
GAUSS_POINTS = (0.5 - 0.5 / np.sqrt(3.0), 0.5 + 0.5 / np.sqrt(3.0))  # of the unit interval


@dataclass(frozen=True, eq=False)
class ArmLayout:
    """An arm's elements in an MJCF.

    joint_names: of the n joints.  bodies: that carry them.  joints: their elements.
    joint_frames: (n, 4, 4) frame of joint i (z its axis, at joint value 0) in its body [m].
    anchors, axes: (n, 3) a point on each joint's axis [m] and its direction, in its body.
    servos, inertia, timestep: those of the model, inertia (n,) the largest about each joint
    [kg m^2]; zeros for a new file.
    """

    tree: MjcfTree
    joint_names: tuple[str, ...]
    bodies: tuple[ET.Element, ...]
    joints: tuple[ET.Element, ...]
    joint_frames: Array
    anchors: Array
    axes: Array
    servos: ModelServos
    inertia: Array
    timestep: float


@dataclass(frozen=True, eq=False)
class ServoDesign:
    """Gains that a corrected model gets.

    load_share: s of gravity that servos feel.  gain, damper: (n,) [N m/rad, N m s/rad].
    is_sprung: (n,) True where a spring of its own holds the joint's compliance.
    is_kept: (n,) True where gain and damper are those that the model has.
    gravity_torque: (n,) largest of each joint over the workspace [N m, slides N].
    """

    load_share: float
    gain: Array
    damper: Array
    is_sprung: Array
    is_kept: Array
    gravity_torque: Array


def design_servos(
    layout: ArmLayout, arm: SimulatedArm, *, with_springs: bool = False
) -> ServoDesign:
    """Gains that settle within a rest of 1.5 s, and the share of gravity that makes them exact.

    with_springs: whether springs of their own hold the compliance of joints, and no gain.
    """
    # Largest inertia and gravity torque of each joint, over poses all over the workspace.
    robot, mass, given = arm.robot, arm.mass, layout.servos
    q = random_joint_values_above_floor(robot, LOAD_SAMPLES, np.random.default_rng(0))
    links = compute_link_frames(robot.mdh, robot.chain_joint_values(q), robot.prismatic)
    at = link_mass_centres_in_base(links, arm.com)
    carried = np.cumsum(mass[::-1])[::-1]
    own = [assumed_link_inertia(robot.mdh, i, m) for i, m in enumerate(mass)]
    turning = np.cumsum(np.array(own)[::-1])[::-1]
    inertias = np.zeros((robot.joints, len(q)))
    for i in range(robot.joints):
        lever = cross(links.z[i][None], at[i:] - links.before[i][None])
        inertias[i] = np.einsum("k,kam,kam->m", mass[i:], lever, lever) + turning[i]
    weight = STANDARD_GRAVITY * carried[:, None] * np.einsum("nam,a->nm", links.z, robot.up)
    slides = robot.prismatic[:, None]
    torque = np.where(slides, weight, joint_gravity_torques(links, mass, arm.com, robot.up))
    torque = np.abs(torque).max(axis=1)
    inertia = np.where(slides, carried[:, None], inertias).max(axis=1)
    inertia = np.maximum(inertia, layout.inertia)

    # A servo under the share s of gravity with the gain s/c deflects as the compliance c does.
    needed = SERVO_FREQUENCY**2 * inertia
    ordinary = np.maximum(given.gain, np.maximum(needed, MIN_GAIN_SHARE * needed.max()))
    is_soft = arm.joint_compliances > NEGLIGIBLE_COMPLIANCE
    share = min(1.0, float((arm.joint_compliances * ordinary).max()))
    lever = np.where(robot.prismatic, 1.0, arm.largest_levers)
    stiff = np.maximum(ordinary, share * torque * lever / MAX_STIFF_SAG)
    gain = np.where(is_soft, share / np.where(is_soft, arm.joint_compliances, np.inf), stiff)
    is_sprung = np.zeros(len(gain), dtype=bool)
    if with_springs or gain.max() > MAX_GAIN_RATIO * ordinary.max():
        share, gain, is_sprung = 0.0, ordinary, is_soft

    # Critical damping, unless the model's own servo has the gain and is damped well enough.
    critical = 2.0 * np.sqrt(gain * inertia)
    damper = given.damper + given.joint_damping
    is_kept = np.isclose(gain, given.gain, rtol=1e-9)
    is_kept &= (damper >= MIN_DAMPING_RATIO * critical) & (damper <= gain / MIN_SERVO_POLE)
    new = np.maximum(critical, MIN_DAMPER_TIMESTEPS * layout.timestep * gain)
    return ServoDesign(share, gain, np.where(is_kept, damper, new), is_sprung, is_kept, torque)


def joint_frames_at_zero(robot: Robot) -> Array:
    """(n, 4, 4) frame of each joint in the base at joint values 0, z its axis [m]."""
    links = link_frames_at_zero(robot, np.eye(4))
    return np.array(
        [at @ theta_d_transform(row) for at, row in zip(links, robot.mdh, strict=False)]
    )


def write_arm_elements(
    layout: ArmLayout,
    arm: SimulatedArm,
    target_names: Sequence[str] | None = None,
    *,
    with_springs: bool = False,
    with_servos: bool = True,
) -> None:
    """Write what bends and plays in an arm into a tree, servos that hold it, and its targets.

    target_names: None writes no site, not even that of the flange.
    with_springs: whether joints that are compliant have springs of their own, whatever their
    servos: for friction that the servos carry.  with_servos: whether servos hold the arm; a model
    whose motors are given torques keeps these, and all its weight.
    """
    servos = design_servos(layout, arm, with_springs=with_springs or not with_servos)
    if with_servos:
        write_servos(layout, arm, servos)
    write_springs(layout, arm, servos, servos.load_share if with_servos else 1.0)
    if arm.balance:
        own = np.where(servos.is_sprung, arm.joint_compliances, 0.0)[1]
        held = 1.0 / servos.gain[1] if with_servos else MOTOR_COMPLIANCE
        write_balancer(layout, arm, 1.0 / (held + own))
    if target_names is not None:
        write_targets(layout, arm, target_names)


def write_servos(layout: ArmLayout, arm: SimulatedArm, servos: ServoDesign) -> None:
    """A position actuator a joint, of its name or of that which drives it now."""
    tree, given, share = layout.tree, layout.servos, servos.load_share

    # Gravity compensation: actuators feel a share of the weight of what the arm moves.
    if given.gravity_free or share < 1.0:
        for body in layout.bodies[0].iter("body"):
            body.set("gravcomp", format_exact_numbers([1.0 - share]))
    if share < 1.0 and not given.gravity_free:
        for joint, ends in zip(layout.joints, given.limits, strict=True):
            joint.set("actuatorgravcomp", "true")
            if np.isfinite(ends).any():
                joint.set("actuatorfrclimited", "true")
                joint.set(
                    "actuatorfrcrange", format_exact_numbers(np.clip(ends, -MAX_TORQUE, MAX_TORQUE))
                )

    couplings = ET.Element("tendon")
    for i, name in enumerate(layout.joint_names):
        # Gain and damper at the motor, whose gear holds the encoder's gain.
        servo = tree.servo_or_new(name)
        gear = 1.0 / (1.0 + arm.encoder_gains[i])
        if not servos.is_kept[i] or arm.encoder_gains[i]:
            damper = servos.damper[i]
            if given.damped_by_joint[i]:
                layout.joints[i].set("damping", format_exact_numbers([damper]))
                damper = 0.0
            damper = max(damper - given.joint_damping[i], 0.0) / gear**2
            set_servo_gains(servo, servos.gain[i] / gear**2, damper)
        tree.remove_elements("custom", "text", f"{name}_deflection")  # of a calibration before
        if arm.joint_compliances[i] > NEGLIGIBLE_COMPLIANCE and not servos.is_sprung[i]:
            text = (
                f"the gain of {servo.get('name')} is a spring: under gravity {name} turns by "
                f"{arm.joint_compliances[i]:.6g} rad/(N m); another gain is another deflection"
            )
            set_element(tree.section_or_new("custom"), "text", f"{name}_deflection", data=text)
        if arm.encoder_gains[i]:
            servo.set("gear", format_exact_numbers([gear]))

        # Couplings: the servo drives a linear combination of joints.
        others = [(j, c) for k, j, c in arm.couplings if k == i]
        if others:
            tendon = ET.SubElement(couplings, "fixed", name=f"{name}_drive")
            for j, coefficient in [(i, 1.0), *((j, -c) for j, c in others)]:
                ET.SubElement(
                    tendon,
                    "joint",
                    joint=layout.joint_names[j],
                    coef=format_exact_numbers([coefficient]),
                )
            servo.attrib.pop("joint", None)
            servo.set("tendon", f"{name}_drive")
    if len(couplings):
        tree.section_or_new("tendon").extend(couplings)


def set_servo_gains(servo: ET.Element, gain: float, damper: float) -> None:
    """Give a position actuator another gain [N m/rad] and damper [N m s/rad]."""
    if servo.tag == "position":
        for name in ("dampratio", "timeconst", "inheritrange"):
            servo.attrib.pop(name, None)
        servo.attrib |= format_attributes({"kp": gain, "kv": damper})
    else:
        servo.attrib |= format_attributes(
            {"gainprm": gain, "biastype": "affine", "biasprm": [0.0, -gain, -damper]}
        )


def add_spring(
    body: ET.Element,
    name: str,
    kind: str,
    origin: Array,
    axis: Array,
    stiffness: float,
    inertia: float,
    *,
    feels_all_gravity: bool = True,
) -> ET.Element:
    """A passive joint with a spring, the last of its body's joints.

    kind: hinge or slide.  origin, axis: (3,) in the body.  feels_all_gravity: or as much as the
    actuators do.
    """
    damping = SPRING_TIME * stiffness + 2.0 * np.sqrt(stiffness * inertia)  # comes to rest
    new = ET.Element("joint", format_attributes({
        "name": name, "type": kind, "pos": origin, "axis": axis, "stiffness": [stiffness],
        "springref": "0", "ref": "0", "limited": "false", "damping": [damping],
        "frictionloss": "0", "armature": [SPRING_INERTIA * inertia]
    }))  # fmt: skip
    if feels_all_gravity:
        ends = [-MAX_SPRING_ACTUATION, MAX_SPRING_ACTUATION]
        new.attrib |= format_attributes(
            {"actuatorgravcomp": "true", "actuatorfrclimited": "true", "actuatorfrcrange": ends}
        )
    places = [i for i, child in enumerate(body) if child.tag == "joint"]
    body.insert(places[-1] + 1 if places else 0, new)
    return new


def write_springs(
    layout: ArmLayout, arm: SimulatedArm, servos: ServoDesign, load_share: float
) -> None:
    """Passive joints with springs for what bends: joints, gears with play, links, the base.

    load_share: of gravity, that the joints of gears with play feel.
    """
    robot, bodies, seats, inertia = (
        arm.robot,
        layout.bodies,
        layout.joint_frames,
        arm.largest_inertias,
    )

    # Compliance of joints that no servo holds: a spring on the joint's axis.
    for i in np.flatnonzero(servos.is_sprung).tolist():
        kind = "slide" if robot.prismatic[i] else "hinge"
        add_spring(bodies[i], f"flex{i + 1}", kind, layout.anchors[i], layout.axes[i],
                   1.0 / arm.joint_compliances[i], inertia[i])  # fmt: skip

    # Backlash: a hinge with stops half the play away on either side, and a spring that holds it.
    for i in np.flatnonzero(arm.backlashes).tolist():
        sag = load_share * (servos.gravity_torque[i] * arm.largest_levers[i]) / MAX_STIFF_SAG
        hinge = add_spring(
            bodies[i], f"play{i + 1}", "hinge", layout.anchors[i], layout.axes[i],
            max(sag, inertia[i] / SPRING_TIME**2), inertia[i], feels_all_gravity=False
        )  # fmt: skip
        ends = np.array([-1.01, 1.01]) * (0.5 * abs(arm.backlashes[i]))  # the spring ends inside
        hinge.set("limited", "true")
        hinge.set(
            "range", format_exact_numbers(np.degrees(ends) if layout.tree.uses_degrees else ends)
        )

    # Links: hinges at the Gauss points have together the compliance of a cantilever, exactly.
    for i, flexibility in arm.link_flexibility.items():
        start = np.array([0.0, 0.0, -robot.mdh[i, 1]])
        end = np.array([robot.mdh[i, 0], 0.0, 0.0])
        length = float(np.linalg.norm(end - start))
        along = (end - start) / length
        across = perpendicular_unit_vectors(along)
        branch = next(b for b in bodies[i] if any(e is bodies[i + 1] for e in b.iter()))
        body = ET.Element("body", {"name": f"bend{i + 1}"})  # that carries the branch from now on
        add_element(body, "inertial", pos=[0.0, 0.0, 0.0], mass=1e-6, diaginertia=[1e-9] * 3)
        bodies[i].insert(list(bodies[i]).index(branch), body)
        bodies[i].remove(branch)
        body.append(branch)
        for point, share in enumerate(GAUSS_POINTS):
            at = seats[i, :3, :3] @ (start + share * (end - start)) + seats[i, :3, 3]
            twist = [along] if point == 0 else []  # one hinge for the whole link
            for letter, axis in zip("yzx", (*across, *twist), strict=False):
                soft = flexibility * length * (1.0 if letter == "x" else 0.5)
                add_spring(body, f"bend{i + 1}_{letter}{point + 1}", "hinge", at,
                           seats[i, :3, :3] @ axis, 1.0 / soft, inertia[i + 1])  # fmt: skip

    # Base: two level hinges at the foot, below the first joint.
    if arm.base_compliance > 0.0:
        foot = seats[0] @ invert_transform(theta_d_transform(robot.mdh[0]))
        first = next(i for i, e in enumerate(bodies[0]) if e.tag in ("joint", "freejoint"))
        for letter, axis in zip("xy", perpendicular_unit_vectors(robot.up), strict=True):
            hinge = add_spring(
                bodies[0],
                f"base_flex_{letter}",
                "hinge",
                foot[:3, 3],
                foot[:3, :3] @ axis,
                1.0 / arm.base_compliance,
                inertia[0],
            )
            bodies[0].remove(hinge)
            bodies[0].insert(first, hinge)


def write_balancer(layout: ArmLayout, arm: SimulatedArm, stiffness: float) -> None:
    """A tendon with a spring from the column to the upper arm [effects.compliance.spring].

    stiffness: of joint 2 [N m/rad].
    """
    robot, balance = arm.robot, arm.balance
    assert balance is not None
    at = joint_frames_at_zero(robot)
    axis, start = at[1][:3, 2], at[1][:3, 3] - robot.mdh[1, 1] * at[1][:3, 2]
    level = robot.up - axis * (axis @ robot.up)
    up = level / np.linalg.norm(level)
    along = (at[1] @ a_alpha_beta_transform(robot.mdh[1]))[:3, 3] - start
    along = along - axis * (axis @ along)
    along = along / np.linalg.norm(along)
    side = np.cos(balance.zero_angle) * up + np.sin(balance.zero_angle) * np.cross(axis, up)
    points = {"anchor": start + BALANCER_ANCHOR * side,
              "eye": start + BALANCER_ANCHOR * balance.eye_distance * along}  # fmt: skip
    pull = -balance.stiffness_law * stiffness / (balance.eye_distance * BALANCER_ANCHOR**2)
    tendon = add_element(
        layout.tree.section_or_new("tendon"),
        "spatial",
        name="balancer",
        stiffness=pull,
        springlength=balance.rest_length * BALANCER_ANCHOR,
    )
    for i, (name, point) in enumerate(points.items()):
        inside = layout.joint_frames[i] @ invert_transform(at[i])
        add_element(layout.bodies[i], "site", name=f"balancer_{name}",
                    pos=inside[:3, :3] @ point + inside[:3, 3], size=0.005)  # fmt: skip
        add_element(tendon, "site", site=f"balancer_{name}")


def write_targets(layout: ArmLayout, arm: SimulatedArm, target_names: Sequence[str]) -> None:
    """Sites of the flange and of each target, on a tool that sags where the fit's does.

    Weights turn the tool about the flange by arm.sag times the direction of gravity.  A hinge about
    n with the first moment R beyond it turns by (n x R) . g / k, which is across n: axes are chosen
    in whose directions sag has no part along themselves.
    """
    body, flange = (
        layout.bodies[-1],
        layout.joint_frames[-1] @ a_alpha_beta_transform(arm.robot.mdh[-1]),
    )
    write_site(layout, body, "flange", flange)
    is_soft = np.abs(arm.tool_sag).max() > NEGLIGIBLE_COMPLIANCE or arm.tool_extension.max() > 0.0
    if is_soft:
        axes = find_axes_orthogonal_to_their_images(arm.tool_sag)
        wanted = axes @ arm.tool_sag  # (3, 3) row i: turn about axis i per direction of gravity
        size = np.linalg.norm(wanted, axis=1)
        moment = np.cross(wanted, axes) / np.maximum(size, NEGLIGIBLE_COMPLIANCE)[:, None]
        moment = moment * SAG_WEIGHT * TOOL_LEVER
        spots = (moment - np.vstack([moment[1:], np.zeros((1, 3))])) / SAG_WEIGHT
        inertia = SAG_WEIGHT * TOOL_LEVER**2
        for i, letter in enumerate("xyz"):
            pose = pose_attributes(flange) if i == 0 else {}
            body = add_element(body, "body", name="tool" if i == 2 else f"tool_{i + 1}", **pose)
            add_element(body, "inertial", pos=spots[i], mass=SAG_WEIGHT, diaginertia=[inertia] * 3)
            if size[i] > NEGLIGIBLE_COMPLIANCE:
                stiffness = STANDARD_GRAVITY * SAG_WEIGHT * TOOL_LEVER / size[i]
                add_spring(body, f"tool_{letter}", "hinge", np.zeros(3), axes[i], stiffness,
                           3.0 * SAG_WEIGHT * TOOL_LEVER**2)  # fmt: skip
        for i in np.flatnonzero(arm.tool_extension > 0.0).tolist():
            add_spring(
                body,
                f"tool_slide_{'xyz'[i]}",
                "slide",
                np.zeros(3),
                np.eye(3)[i],
                STANDARD_GRAVITY * SAG_WEIGHT / arm.tool_extension[i],
                SAG_WEIGHT,
            )
    for name, point in zip(target_names, arm.target_positions, strict=True):
        write_site(
            layout, body, name, translation(*point) if is_soft else flange @ translation(*point)
        )


def write_site(layout: ArmLayout, body: ET.Element, name: str, pose: Array) -> None:
    """A site, moved where its body has one of the name; one on another body is removed."""
    for other in list(layout.tree.root.iter("body")):
        for old in [e for e in other.findall("site") if e.get("name") == name]:
            if other is not body:
                other.remove(old)
            for key in ("axisangle", "euler", "xyaxes", "zaxis", "fromto"):
                old.attrib.pop(key, None)
    set_element(body, "site", name, **pose_attributes(pose), size=0.005, group="4")


def set_link_mass(body: ET.Element, arm: SimulatedArm, link: int) -> None:
    """Give a body whose joint axis is z at its origin the mass of a link (from 0)."""
    centre = centre_of_gravity_in_urdf_link(replace(arm.robot, com=arm.com), link)
    inertia = assumed_link_inertia(arm.robot.mdh, link, arm.mass[link])
    set_element(body, "inertial", pos=centre, mass=arm.mass[link], diaginertia=[inertia] * 3)


def find_axes_orthogonal_to_their_images(matrix: Array) -> Array:
    """(3, 3) orthonormal rows n with n . matrix n = 0, of a matrix whose trace is 0."""
    half = 0.5 * (matrix + matrix.T)
    if np.abs(np.diag(half)).max() < NEGLIGIBLE_COMPLIANCE:
        return np.eye(3)
    _, vectors = np.linalg.eigh(half)
    first = vectors.sum(axis=1) / np.sqrt(3.0)
    plane = perpendicular_unit_vectors(first)
    _, turned = np.linalg.eigh(plane @ half @ plane.T)
    both = [(turned[:, 0] + sign * turned[:, 1]) / np.sqrt(2.0) for sign in (1.0, -1.0)]
    return np.array([first, *(way @ plane for way in both)])
