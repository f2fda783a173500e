"""The parts of an MJCF that make it bend, sag and play as an arm does; written into its tree.

Every spring has a damper of TIME times its stiffness: the simulator takes dampers implicitly, so
that no spring is too stiff for its timestep, however light what hangs on it.  Springs feel all of
gravity, though its bodies are compensated for the actuators: the compensation counts as an
actuator's force, and joints that are springs let none pass (`actuatorfrcrange`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from xml.etree import ElementTree as ET

import numpy as np
from scipy.spatial.transform import Rotation

from minimax_cal.correcting.exporters.correct import laid
from minimax_cal.ground.arrays import Array
from minimax_cal.robots.gravity import G, centres, inertia_of, torques
from minimax_cal.robots.kinematics import chain, cross
from minimax_cal.robots.mjcf import numbers
from minimax_cal.robots.robot import Robot
from minimax_cal.robots.sampling import random_poses
from minimax_cal.robots.transforms import head, inverse, level_to, shift, tail
from minimax_cal.simulators.arm import LEVER, Arm

SETTLES = 15.0  # a servo's frequency at the largest inertia: 1.5 s of rest leave 4e-9 [rad/s]
LEAST_RATIO, SLOWEST = 0.7, 7.5  # a given damper stays from this damping ratio to this pole [1/s]
SMALLEST = 0.1  # of the largest gain, for joints that carry little: as published models have them
WIDEST = 10.0  # gains are at most so much larger than the largest that a smooth move needs
SAG = 2e-6  # gravity moves the tool of a joint that is stiff by no more [m]
STEPS = 2.0  # a damper's own time is at least so many timesteps: then no stiffness shakes
NOTHING = 1e-12
SAMPLES = 200  # poses at which loads are looked for


@dataclass(frozen=True, eq=False)
class Drives:
    """The servos of a model as they are, all at the joints; of a new one there are none.

    gain, damper: (n,) [N m/rad, N m s/rad]; own: (n,) the part of damper that the joint itself has.
    limits: (n, 2) of the torque of each joint's actuators [N m].
    inertia: (n,) largest about each joint [kg m^2].  timestep: [s].
    gravity_free: whether actuators carry no gravity because the model's bodies float already.
    braked: (n,) True where the joint is to hold its servo's damper, which is implicit there.
    """

    gain: Array
    damper: Array
    own: Array
    limits: Array
    inertia: Array
    braked: Array
    timestep: float = 0.002
    gravity_free: bool = False

    @staticmethod
    def none(joints: int) -> Drives:
        """Of a new file."""
        nothing = np.zeros(joints)
        ends = np.array([[-np.inf, np.inf]] * joints)
        return Drives(nothing, nothing, nothing, ends, nothing, np.ones(joints, dtype=bool))


@dataclass(frozen=True, eq=False)
class Servos:
    """share: of gravity that bends the joints, s.  gain, damper: (n,) [N m/rad, N m s/rad].

    sprung: (n,) True where a spring of its own holds the joint's compliance.
    kept: (n,) True where gain and damper are those that the model has.
    """

    share: float
    gain: Array
    damper: Array
    sprung: Array
    kept: Array


def choose_servos(arm: Arm, drives: Drives, *, springs: bool = False) -> Servos:
    """Gains that settle within a rest of 1.5 s, and the share of gravity that makes them exact.

    springs: whether springs of their own hold what joints give way, and no gain.
    """
    inertia, torque = loads(arm)
    inertia = np.maximum(inertia, drives.inertia)
    needed = SETTLES**2 * inertia
    ordinary = np.maximum(drives.gain, np.maximum(needed, SMALLEST * needed.max()))
    lever = np.where(arm.robot.prismatic, 1.0, arm.reach)
    soft = arm.turn > NOTHING
    compliance = np.where(soft, arm.turn, np.inf)
    share = min(1.0, float((arm.turn * ordinary).max()))
    stiff = np.maximum(ordinary, share * torque * lever / SAG)
    gain = np.where(soft, share / compliance, stiff)
    sprung = np.zeros(len(gain), dtype=bool)
    if springs or gain.max() > WIDEST * ordinary.max():
        share, gain, sprung = 0.0, ordinary, soft
    critical = 2.0 * np.sqrt(gain * inertia)
    kept = np.isclose(gain, drives.gain, rtol=1e-9)
    kept &= (drives.damper >= LEAST_RATIO * critical) & (drives.damper <= gain / SLOWEST)
    new = np.maximum(critical, STEPS * drives.timestep * gain)
    return Servos(share, gain, np.where(kept, drives.damper, new), sprung, kept)


def loads(arm: Arm) -> tuple[Array, Array]:
    """(n,) largest inertia [kg m^2] and gravity torque [N m] of each joint, of slides kg and N.

    Over poses all over the workspace.
    """
    robot = arm.robot
    q = random_poses(robot, SAMPLES, np.random.default_rng(0))
    links = chain(robot.mdh, robot.turned(q), robot.prismatic)
    at = centres(links, arm.com)
    beyond = np.cumsum(arm.mass[::-1])[::-1]
    own = [inertia_of(robot.mdh, i, m) for i, m in enumerate(arm.mass)]
    turning = np.cumsum(np.array(own)[::-1])[::-1]
    inertia = np.zeros((robot.joints, len(q)))
    for i in range(robot.joints):
        lever = cross(links.z[i][None], at[i:] - links.before[i][None])
        inertia[i] = np.einsum("k,kam,kam->m", arm.mass[i:], lever, lever) + turning[i]
    torque = torques(links, arm.mass, arm.com, robot.up)
    force = G * beyond[:, None] * np.einsum("nam,a->nm", links.z, robot.up)
    slides = robot.prismatic[:, None]
    inertia, torque = np.where(slides, beyond[:, None], inertia), np.where(slides, force, torque)
    return inertia.max(axis=1), np.abs(torque).max(axis=1)


# ---- elements ------------------------------------------------------------------------------------


TIME = 0.02  # in which a spring comes to rest [s]
ROTOR = 0.01  # inertia of a spring itself, of what it carries: parallel hinges need some
FOOT = 1e-5  # mass of each weight that makes the tool sag, which no joint is to feel [kg]
ANCHOR = 0.3  # distance of the balancing spring's anchor from joint 2 [m]
RIGID = 1e-9  # compliance of a joint that nothing but its motor holds [rad/(N m)]
LARGEST = 1e9  # of a force where one side alone is limited [N m]
PASSES = 1e-12  # of an actuator's force through a joint that is a spring [N m]
GAUSS = (0.5 - 0.5 / np.sqrt(3.0), 0.5 + 0.5 / np.sqrt(3.0))


@dataclass(frozen=True, eq=False)
class Layout:
    """Where an arm stands in an MJCF.

    root: of the tree.  names: of the n joints.  bodies: that carry them.  joints: their elements.
    seats: (n, 4, 4) frame of joint i (z its axis, at joint value 0) in its body [m].
    anchors, axes: (n, 3) a point on each joint's axis [m] and its direction, in its body.
    degrees: whether the file counts angles in degrees.  drives: the servos that it has.
    """

    root: ET.Element
    names: tuple[str, ...]
    bodies: tuple[ET.Element, ...]
    joints: tuple[ET.Element, ...]
    seats: Array
    anchors: Array
    axes: Array
    drives: Drives
    degrees: bool = False


def as_text(attributes: Mapping[str, object]) -> dict[str, str]:
    """Attributes as they stand in a file; arrays become numbers."""
    return {
        key: value if isinstance(value, str) else numbers(np.asarray(value, dtype=float))
        for key, value in attributes.items()
    }


def part(parent: ET.Element, tag: str, **attributes: object) -> ET.Element:
    """A new element."""
    return ET.SubElement(parent, tag, as_text(attributes))


def known(parent: ET.Element, tag: str, name: str = "", **attributes: object) -> ET.Element:
    """The element of a name in its parent with other attributes, a new one where there is none."""
    for element in parent.findall(tag):
        if element.get("name", "") == name:
            element.attrib |= as_text(attributes)
            return element
    return part(parent, tag, **({"name": name} if name else {}), **attributes)


def forget(root: ET.Element, holder: str, tag: str, name: str) -> None:
    """Take the elements of a name out of the sections that hold them."""
    for one in root.iter(holder):
        for old in [e for e in one.findall(tag) if e.get("name") == name]:
            one.remove(old)


def parents_of(root: ET.Element) -> dict[ET.Element, ET.Element]:
    """Of every element below a root what it stands in."""
    return {child: parent for parent in root.iter() for child in parent}


def section(root: ET.Element, tag: str) -> ET.Element:
    """A section of the file, made where it is missing."""
    found = root.find(tag)
    return ET.SubElement(root, tag) if found is None else found


def frames(robot: Robot) -> Array:
    """(n, 4, 4) frame of each joint in the base at joint values 0, z its axis [m]."""
    frames_of_links = zip(laid(robot, np.eye(4)), robot.mdh, strict=False)
    return np.array([at @ head(row) for at, row in frames_of_links])


def equip(layout: Layout, arm: Arm, *, springs: bool = False, driven: bool = True) -> None:
    """Write the elements of an arm into a tree: what bends and plays, and servos that hold it.

    springs: whether joints that are compliant have springs of their own, whatever their servos: for
    friction that the servos carry.  driven: whether servos hold the arm; a model whose motors are
    given torques keeps these, and all its weight.
    """
    servos = choose_servos(arm, layout.drives, springs=springs or not driven)
    if driven:
        compensate_gravity(layout, servos.share)
        write_servos(layout, arm, servos)
    flexes(layout, arm, servos)
    plays(layout, arm, servos.share if driven else 1.0)
    bends(layout, arm)
    base(layout, arm)
    own = np.where(servos.sprung, arm.turn, 0.0)
    held = 1.0 / servos.gain if driven else np.full_like(own, RIGID)
    balancer(layout, arm, 1.0 / (held + own)[1:2])


def compensate_gravity(layout: Layout, share: float) -> None:
    """Let actuators carry all but a share of the gravity of what the arm moves."""
    if layout.drives.gravity_free or share < 1.0:
        for body in layout.bodies[0].iter("body"):
            body.set("gravcomp", numbers([1.0 - share]))
    if layout.drives.gravity_free or share == 1.0:
        return
    for joint, ends in zip(layout.joints, layout.drives.limits, strict=True):
        joint.set("actuatorgravcomp", "true")
        if np.isfinite(ends).any():
            joint.set("actuatorfrclimited", "true")
            joint.set("actuatorfrcrange", numbers(np.clip(ends, -LARGEST, LARGEST)))


def write_servos(layout: Layout, arm: Arm, servos: Servos) -> None:
    """A position actuator a joint, of its name or of that which drives it now."""
    tendons = ET.Element("tendon")
    for i, name in enumerate(layout.names):
        servo = servo_of(layout, name)
        gear = 1.0 / (1.0 + arm.gain[i])
        gain, damper = servos.gain[i] / gear**2, servos.damper[i]
        if not (servos.kept[i] and not arm.gain[i]):
            if layout.drives.braked[i]:
                layout.joints[i].set("damping", numbers([damper]))
                damper = 0.0
            tune(servo, gain, max(damper - layout.drives.own[i], 0.0) / gear**2)
        forget(layout.root, "custom", "text", f"{name}_deflection")  # of a calibration before
        if arm.turn[i] > NOTHING and not servos.sprung[i]:
            said = (f"the gain of {servo.get('name')} is a spring: under gravity {name} turns by "
                    f"{arm.turn[i]:.6g} rad/(N m); another gain is another deflection")  # fmt: skip
            known(section(layout.root, "custom"), "text", f"{name}_deflection", data=said)
        if arm.gain[i]:
            servo.set("gear", numbers([gear]))
        others = [(j, c) for k, j, c in arm.coupled if k == i]
        if others:
            fixed = part(tendons, "fixed", name=f"{name}_drive")
            part(fixed, "joint", joint=name, coef=1.0)
            for j, c in others:
                part(fixed, "joint", joint=layout.names[j], coef=-c)
            servo.attrib.pop("joint", None)
            servo.set("tendon", f"{name}_drive")
    if len(tendons):
        section(layout.root, "tendon").extend(tendons)


def servo_of(layout: Layout, joint: str) -> ET.Element:
    """The position actuator of a joint, a new one of a free name where there is none."""
    actuators, name = section(layout.root, "actuator"), joint
    for element in actuators:
        if element.get("joint") == joint and element.tag in ("position", "general"):
            return element
    while any(element.get("name") == name for element in layout.root.findall("actuator/*")):
        name += "_servo"
    return part(actuators, "position", name=name, joint=joint)


def tune(servo: ET.Element, gain: float, damper: float) -> None:
    """Give a position actuator another gain and damper."""
    if servo.tag == "position":
        for name in ("dampratio", "timeconst", "inheritrange"):
            servo.attrib.pop(name, None)
        servo.set("kp", numbers([gain]))
        servo.set("kv", numbers([damper]))
    else:
        servo.set("gainprm", numbers([gain]))
        servo.set("biastype", "affine")
        servo.set("biasprm", numbers([0.0, -gain, -damper]))


def spring(
    body: ET.Element,
    name: str,
    kind: str,
    at: Array,
    axis: Array,
    stiffness: float,
    inertia: float,
    *,
    loaded: bool = True,
) -> ET.Element:
    """A passive joint with a spring, the last of its body's joints.

    loaded: whether it feels all of gravity, or as much as the actuators do.
    """
    own = TIME * stiffness + 2.0 * np.sqrt(stiffness * inertia)  # lets it come to rest
    new = ET.Element("joint", as_text({
        "name": name, "type": kind, "pos": at, "axis": axis, "stiffness": [stiffness],
        "springref": "0", "ref": "0", "limited": "false", "damping": [own], "frictionloss": "0",
        "armature": [ROTOR * inertia],
    }))  # fmt: skip
    if loaded:
        passes = {"actuatorfrclimited": "true", "actuatorfrcrange": [-PASSES, PASSES]}
        new.attrib |= as_text({"actuatorgravcomp": "true", **passes})
    places = [i for i, child in enumerate(body) if child.tag == "joint"]
    body.insert(places[-1] + 1 if places else 0, new)
    return new


def flexes(layout: Layout, arm: Arm, servos: Servos) -> None:
    """A spring on the axis of each joint whose servo does not hold its compliance."""
    for i in np.flatnonzero(servos.sprung):
        spring(
            layout.bodies[i], f"flex{i + 1}", "slide" if arm.robot.prismatic[i] else "hinge",
            layout.anchors[i], layout.axes[i], 1.0 / arm.turn[i], arm.inertia[i],
        )  # fmt: skip


def plays(layout: Layout, arm: Arm, share: float) -> None:
    """A hinge with stops half the play away on either side, and a spring that holds it."""
    (_, torque), inertia = loads(arm), arm.inertia
    for i in np.flatnonzero(arm.play):
        half = 0.5 * abs(arm.play[i])
        held = max(share * (torque[i] * arm.reach[i]) / SAG, inertia[i] / TIME**2)
        new = spring(
            layout.bodies[i], f"play{i + 1}", "hinge", layout.anchors[i], layout.axes[i],
            held, inertia[i], loaded=False,
        )  # fmt: skip
        new.set("limited", "true")
        ends = np.array([-1.01, 1.01]) * half  # the spring ends inside the stops
        new.set("range", numbers(np.degrees(ends) if layout.degrees else ends))


def bends(layout: Layout, arm: Arm) -> None:
    """Hinges at the Gauss points of a link: together the compliance of a cantilever, exactly."""
    for i, flexibility in arm.bend.items():
        row = arm.robot.mdh[i]
        start, end = np.array([0.0, 0.0, -row[1]]), np.array([row[0], 0.0, 0.0])
        length = float(np.linalg.norm(end - start))
        seat = layout.seats[i]
        along = (end - start) / length
        across = level_to(along)
        body = wrapped(layout.bodies[i], layout.bodies[i + 1], f"bend{i + 1}")
        for point, share in enumerate(GAUSS):
            at = seat[:3, :3] @ (start + share * (end - start)) + seat[:3, 3]
            twist = [along] if point == 0 else []  # one hinge for the whole link
            for letter, axis in zip("yzx", (*across, *twist), strict=False):
                soft = flexibility * length * (1.0 if letter == "x" else 0.5)
                spring(
                    body, f"bend{i + 1}_{letter}{point + 1}", "hinge", at, seat[:3, :3] @ axis,
                    1.0 / soft, arm.inertia[i + 1],
                )  # fmt: skip


def wrapped(parent: ET.Element, child: ET.Element, name: str) -> ET.Element:
    """A new body in parent, in the same place, that holds what carries child from now on."""
    branch = next(b for b in parent if any(e is child for e in b.iter()))
    body = ET.Element("body", {"name": name})
    part(body, "inertial", pos=[0.0, 0.0, 0.0], mass=1e-6, diaginertia=[1e-9] * 3)
    parent.insert(list(parent).index(branch), body)
    parent.remove(branch)
    body.append(branch)
    return body


def base(layout: Layout, arm: Arm) -> None:
    """Two level hinges at the foot, and its height."""
    body, robot = layout.bodies[0], arm.robot
    foot = layout.seats[0] @ inverse(head(robot.mdh[0]))
    if arm.base > 0.0:
        level = level_to(robot.up)
        first = next(i for i, child in enumerate(body) if child.tag in ("joint", "freejoint"))
        for letter, axis in zip("xy", level, strict=True):
            new = spring(
                body, f"base_flex_{letter}", "hinge", foot[:3, 3], foot[:3, :3] @ axis,
                1.0 / arm.base, arm.inertia[0],
            )  # fmt: skip
            body.remove(new)
            body.insert(first, new)


def balancer(layout: Layout, arm: Arm, stiffness: Array) -> None:
    """A tendon with a spring from the column to the upper arm [effects.compliance.spring]."""
    if not arm.balance:
        return
    robot, told = arm.robot, arm.balance
    at = frames(robot)
    axis, start = at[1][:3, 2], at[1][:3, 3] - robot.mdh[1, 1] * at[1][:3, 2]
    level = robot.up - axis * (axis @ robot.up)
    up = level / np.linalg.norm(level)
    arm_end = at[1] @ tail(robot.mdh[1])
    along = arm_end[:3, 3] - start
    along = along - axis * (axis @ along)
    along = along / np.linalg.norm(along)
    anchor = start + ANCHOR * (np.cos(told.zero) * up + np.sin(told.zero) * np.cross(axis, up))
    eye = start + ANCHOR * told.eye * along
    for i, point, name in ((0, anchor, "anchor"), (1, eye, "eye")):
        inside = layout.seats[i] @ inverse(at[i])
        part(layout.bodies[i], "site", name=f"balancer_{name}",
             pos=inside[:3, :3] @ point + inside[:3, 3], size=0.005)  # fmt: skip
    pull = -told.k * stiffness[0] / (told.eye * ANCHOR**2)
    tendon = part(section(layout.root, "tendon"), "spatial", name="balancer", stiffness=pull,
                  springlength=told.rest * ANCHOR)  # fmt: skip
    part(tendon, "site", site="balancer_anchor")
    part(tendon, "site", site="balancer_eye")


# ---- targets, and the tool that carries them ---------------------------------------------------


def targets(layout: Layout, arm: Arm, names: Sequence[str]) -> None:
    """The flange, and a site for each target on the tool."""
    end = layout.seats[-1] @ tail(arm.robot.mdh[-1])
    mark(layout, layout.bodies[-1], "flange", end)
    soft = np.abs(arm.sag).max() > NOTHING or arm.drawn.max() > 0.0
    body = sagging(layout.bodies[-1], end, arm) if soft else layout.bodies[-1]
    for name, point in zip(names, arm.spots, strict=True):
        mark(layout, body, name, shift(*point) if soft else end @ shift(*point))


def mark(layout: Layout, body: ET.Element, name: str, pose: Array) -> None:
    """A site, moved where its body has one of the name; one on another body gives way."""
    for other in list(layout.root.iter("body")):
        for old in [e for e in other if e.tag == "site" and e.get("name") == name]:
            if other is not body:
                other.remove(old)
            for key in ("axisangle", "euler", "xyaxes", "zaxis", "fromto"):
                old.attrib.pop(key, None)
    known(body, "site", name, **at_pose(pose), size=0.005, group="4")


def at_pose(pose: Array) -> dict[str, Array]:
    """Attributes of what stands at a pose (4, 4), w of the quaternion first."""
    turn = Rotation.from_matrix(pose[:3, :3])
    return {"pos": pose[:3, 3], "quat": turn.as_quat(scalar_first=True)}


def sagging(body: ET.Element, end: Array, arm: Arm) -> ET.Element:
    """A tool whose weights turn it about the flange by sag times the direction of gravity.

    A hinge about n with the first moment R beyond it turns by (n x R) . g / k, which is across n:
    axes are chosen in whose directions sag has no part along themselves.
    """
    axes = across_themselves(arm.sag)
    wanted = axes @ arm.sag  # (3, 3) row i: turn about axis i per direction of gravity
    size = np.linalg.norm(wanted, axis=1)
    moment = np.cross(wanted, axes) / np.maximum(size, NOTHING)[:, None] * FOOT * LEVER
    spots = (moment - np.vstack([moment[1:], np.zeros((1, 3))])) / FOOT
    for i in range(3):
        body = part(body, "body", name="tool" if i == 2 else f"tool_{i + 1}")
        if i == 0:
            body.attrib |= as_text(at_pose(end))
        part(body, "inertial", pos=spots[i], mass=FOOT, diaginertia=[FOOT * LEVER**2] * 3)
        if size[i] > NOTHING:
            spring(body, f"tool_{'xyz'[i]}", "hinge", np.zeros(3), axes[i],
                   G * FOOT * LEVER / size[i], 3.0 * FOOT * LEVER**2)  # fmt: skip
    for i in range(3):
        if arm.drawn[i] <= 0.0:
            continue
        spring(body, f"tool_slide_{'xyz'[i]}", "slide", np.zeros(3), np.eye(3)[i],
               G * FOOT / arm.drawn[i], FOOT)  # fmt: skip
    return body


def across_themselves(matrix: Array) -> Array:
    """(3, 3) orthonormal rows n with n . matrix n = 0, of a matrix whose trace is 0."""
    half = 0.5 * (matrix + matrix.T)
    if np.abs(np.diag(half)).max() < NOTHING:
        return np.eye(3)
    _, vectors = np.linalg.eigh(half)
    first = vectors.sum(axis=1) / np.sqrt(3.0)
    plane = level_to(first)
    _, turned = np.linalg.eigh(plane @ half @ plane.T)
    both = (
        (turned[:, 0] + turned[:, 1]) / np.sqrt(2.0),
        (turned[:, 0] - turned[:, 1]) / np.sqrt(2.0),
    )
    return np.array([first, *(way @ plane for way in both)])
