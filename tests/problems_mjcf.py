"""Made-up models of simulators: one as published ones are, with includes, defaults and meshes."""

from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

import minimax_cal as mc
from minimax_cal.robots.gravity_torques import assumed_link_masses_and_centres
from minimax_cal.robots.mjcf_import import format_exact_numbers
from minimax_cal.robots.transforms import build_transform, invert_transform
from minimax_cal.simulators.elements import joint_frames_at_zero

GAINS = (2000.0, 2000.0, 2000.0, 500.0, 500.0, 500.0)  # of the size that published arms have
TETRAHEDRON = """v 0 0 0
v 0.05 0 0
v 0 0.05 0
v 0 0 0.05
f 1 3 2
f 1 2 4
f 1 4 3
f 2 3 4
"""


def published_like(folder: Path, robot: mc.Robot, gains: tuple[float, ...] = GAINS) -> Path:
    """A model of a robot in frames of its own, written to a folder with what it includes.

    Angles in degrees; a turned foot; joints beside their bodies' origins and off their axes; a
    camera, a tool and a gripper; servos whose gains stand in default classes.
    """
    (folder / "assets").mkdir()
    (folder / "assets" / "part.obj").write_text(TETRAHEDRON)
    (folder / "parts.xml").write_text(
        "<mujocoinclude><asset><mesh name='part' file='part.obj'/></asset><default>"
        "<default class='arm'><joint armature='0.1' damping='1'/>"
        "<geom contype='0' conaffinity='0' group='2'/>"
        + "".join(
            f"<default class='size{i}'><general gaintype='fixed' biastype='affine' gainprm='{k}' "
            f"biasprm='0 -{k} -{0.2 * k}'/></default>"
            for i, k in enumerate(gains)
        )
        + "</default></default></mujocoinclude>"
    )
    path = folder / "arm.xml"
    path.write_text(
        "<mujoco model='made up'><!-- a remark --><compiler meshdir='assets' autolimits='true'/>"
        "<option integrator='implicitfast'/><include file='parts.xml'/>"
        "<worldbody><light pos='0 0 3'/><geom name='floor' type='plane' pos='0 0 -2' size='4 4 1' "
        "contype='0' conaffinity='0'/><frame pos='0.1 0 0' euler='0 0 90'>"
        f"{bodies(robot)}</frame></worldbody>"
        "<contact><exclude body1='part0' body2='part1'/></contact><actuator>"
        + "".join(
            f"<general name='servo{i}' class='size{i}' joint='axis{i}'/>" for i in range(len(gains))
        )
        + "<position name='fingers' joint='finger' kp='50000' kv='100'/></actuator>"
        "<sensor><jointpos joint='axis2'/></sensor></mujoco>"
    )
    return path


MASSES = (7.778, 12.93, 3.87, 1.96, 1.96, 0.202)  # of a UR10's links, as its maker has them [kg]
LIMITS = (330.0, 330.0, 150.0, 56.0, 56.0, 56.0)  # of its joints [N m]


def ur10_like(
    folder: Path,
    gains: tuple[float, ...] = (5000.0,) * 3 + (500.0,) * 3,
    option: str = "integrator='implicitfast'",
    limits: tuple[float, ...] = LIMITS,
    damping: float = 0.1,
) -> Path:
    """A model as menageries hold them: many lines, classes with gains and force limits, a key.

    damping: of each servo, as a share of its gain.
    """
    robot = mc.load_robot("ur10")
    at, lines, n = joint_frames_at_zero(robot), list[str](), robot.joints
    _, com = assumed_link_masses_and_centres(robot.mdh)
    for i, frame in enumerate(at):
        place = (invert_transform(at[i - 1]) if i else np.eye(4)) @ frame
        quat = Rotation.from_matrix(place[:3, :3]).as_quat(scalar_first=True)
        end = invert_transform(frame) @ (at[i + 1] if i + 1 < n else frame)
        centre = end[:3, :3] @ com[i] + end[:3, 3] if i + 1 < n else np.array([0.0, 0.0, 0.05])
        tab = "  " * (i + 2)
        lines += [
            (
                f"{tab}<body name='part{i + 1}' pos='{format_exact_numbers(place[:3, 3])}"
                f"' quat='{format_exact_numbers(quat)}'>"
            ),
            f"{tab}  <inertial mass='{MASSES[i]}' pos='{format_exact_numbers(centre)}'",
            f"{tab}            diaginertia='0.05 0.05 0.02'/>",
            f'{tab}  <joint name="joint{i + 1}" class="size{i + 1}"/> <!-- joint {i + 1} -->',
        ]
    lines += ["  " * (i + 2) + "</body>" for i in reversed(range(n))]
    classes = [
        f"    <default class='size{i + 1}'>\n      <position kp='{gains[i]}' "
        f"kv='{damping * gains[i]}' forcerange='-{limits[i]} {limits[i]}'/>\n    </default>"
        for i in range(n)
    ]
    servos = [f"    <position  name='joint{i + 1}' class='size{i + 1}' joint='joint{i + 1}' />"
              for i in range(n)]  # fmt: skip
    path = folder / "ur10.xml"
    path.write_text("\n".join([
        "<?xml version='1.0'?>", "<!-- as published -->", "<mujoco model='ur10 like'>",
        "  <compiler angle='radian' autolimits='true'/>",
        f"  <option {option}/>", "  <default>", "    <joint armature='0.1'  damping='1'/>",
        *classes, "  </default>", "  <worldbody>", *lines, "  </worldbody>", "  <actuator>",
        *servos, "  </actuator>", "  <keyframe>", f"    <key name='home' qpos='{'0 ' * n}'/>",
        "  </keyframe>", "</mujoco>", "<!-- the end -->", "",
    ]))  # fmt: skip
    return path


@dataclass(frozen=True)
class Reached:
    """sites: (m, k, 3) after each move [m].  speed: largest of any joint [rad/s, 2 m/s].

    limited: share of the timesteps with any actuator at its limit.
    """

    sites: np.ndarray
    speed: float
    limited: float


def drive_alone(
    path: Any, commands: np.ndarray, names: tuple[str, ...], play: np.ndarray | None = None
) -> Reached:
    """Smooth moves from command to command and 1.5 s of rest, in a loop that shares no code.

    path: of a model, its text, or itself compiled.
    The first row is where the arm begins, and not judged.  play: (m, n) where play hinges rest.
    """
    mujoco = import_module("mujoco")
    model = path
    if isinstance(path, Path):
        model = mujoco.MjModel.from_xml_path(str(path))
    elif isinstance(path, str):
        model = mujoco.MjModel.from_xml_string(path)
    data, n = mujoco.MjData(model), commands.shape[1]
    joints = [model.joint(j) for j in range(model.njnt) if not springs(model.joint(j).name)][:n]
    slides = np.array([joint.type[0] == mujoco.mjtJoint.mjJNT_SLIDE for joint in joints])
    at, dofs = [int(j.qposadr[0]) for j in joints], [int(j.dofadr[0]) for j in joints]
    before, dt = commands[0], model.opt.timestep
    data.qpos[at] = before
    sites, fastest, limited, steps = [], 0.0, 0, 0
    kinds = model.jnt_type[np.array(model.dof_jntid)] == mujoco.mjtJoint.mjJNT_SLIDE
    force_limits = np.where(model.actuator_forcelimited[:, None], model.actuator_forcerange, np.inf)
    torque_limits = np.where(model.jnt_actfrclimited[:, None], model.jnt_actfrcrange, np.inf)
    for row, target in enumerate(commands[1:], start=1):
        for i in range(n) if play is not None else ():
            hinge = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_JOINT, f"play{i + 1}")
            if hinge >= 0:
                model.qpos_spring[model.jnt_qposadr[hinge]] = play[row, i]
        peak = 1.875 * np.abs(target - before) / np.where(slides, 0.25, 1.0)
        length = max(2.0, float(peak.max()))
        for k in range(1, round((length + 1.5) / dt) + 1):
            s = min(k * dt / length, 1.0)
            data.ctrl[:n] = before + (target - before) * (10 * s**3 - 15 * s**4 + 6 * s**5)
            mujoco.mj_step(model, data)
            at_force = np.abs(data.actuator_force[:n]) >= force_limits[:n, 1] * (1 - 1e-9)
            ids = [int(j.id) for j in joints]
            at_torque = np.abs(data.qfrc_actuator[dofs]) >= torque_limits[ids, 1] * (1 - 1e-9)
            limited += bool(at_force.any() or at_torque.any())
            steps += 1
        assert sum(w.number for w in data.warning) == 0
        fastest = max(fastest, float(np.abs(data.qvel * np.where(kinds, 2.0, 1.0)).max()))
        sites.append([data.site(name).xpos.copy() for name in names])
        before = target
    return Reached(np.array(sites), fastest, limited / steps)


def springs(name: str) -> bool:
    """Whether a joint of a written file is passive."""
    return name.split("/")[-1].startswith(("flex", "play", "bend", "base_flex", "tool_"))


def bodies(robot: mc.Robot) -> str:
    """The arm's bodies, each in a frame of its own."""
    rng, at = np.random.default_rng(4), joint_frames_at_zero(robot)
    mass, com = assumed_link_masses_and_centres(robot.mdh)
    out, before, closing = "", np.eye(4), ""
    for i, frame in enumerate(at):
        turned = build_transform(Rotation.random(rng=rng).as_matrix(), 0.03 * rng.normal(size=3))
        body = frame @ turned
        place = invert_transform(before) @ body
        axis = turned[:3, :3].T @ [0.0, 0.0, robot.sign[i]]
        anchor = invert_transform(turned)[:3, 3]
        euler = Rotation.from_matrix(place[:3, :3]).as_euler("XYZ", degrees=True)
        end = at[i] @ invert_transform(at[i]) @ frame
        centre = invert_transform(turned) @ np.append(0.3 * com[i], 1.0)
        out += (
            f"<body name='part{i}' childclass='arm' pos='{format_exact_numbers(place[:3, 3])}' "
            f"euler='{format_exact_numbers(euler)}'><inertial "
            f"pos='{format_exact_numbers(centre[:3])}' "
            f"mass='{max(0.3 * mass[i], 0.5)}' diaginertia='0.1 0.1 0.1'/>"
            f"<joint name='axis{i}' pos='{format_exact_numbers(anchor)}"
            f"' axis='{format_exact_numbers(axis)}'/>"
            "<geom type='mesh' mesh='part'/>"
        )
        if i == 2:
            out += "<camera name='eye' pos='0 0 0.1'/>"
        closing += "</body>"
        before = end @ turned
    return (
        out + "<body name='tool_plate' pos='0 0 0.02'><geom type='box' size='.01 .01 .01' "
        "mass='0.2'/><site name='attachment'/><body name='finger_body' pos='0 0 .02'>"
        "<joint name='finger' type='slide' axis='1 0 0' range='0 0.02'/>"
        "<geom type='box' size='.01 .01 .01' mass='0.05'/></body></body>" + closing
    )
