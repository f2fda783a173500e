"""The arm in a model that MuJoCo has compiled: its joints in order, and the robot they make."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from minimax_cal.compensation.exporters.urdf_correction import (
    link_frames_at_zero,
    match_robot_to_urdf,
)
from minimax_cal.core.arrays import Array
from minimax_cal.core.errors import CalibrationError, OptionError, RobotError
from minimax_cal.core.files import parse_json
from minimax_cal.robots.gravity_torques import STANDARD_GRAVITY, known_link_mass_mask
from minimax_cal.robots.joint_sampling import random_joint_values
from minimax_cal.robots.mjcf_import import (
    MjcfModel,
    body_name,
    body_pose,
    convert_model_to_urdf,
    find_joint_path_to_body,
    has_actuator,
    import_mujoco,
    is_driven_by_actuator,
)
from minimax_cal.robots.robot import Robot, robot_from_dict
from minimax_cal.robots.transforms import build_transform, invert_transform
from minimax_cal.robots.urdf_robot import UrdfRobot, convert_urdf_to_robot, split_root_and_tip

ROBOT_TEXT_NAME = "minimax_cal_robot"  # the text under which a file of ours holds its robot whole
MAX_ROBOT_TEXT_MISFIT = 1e-6  # a file's own robot may differ from its bodies by no more [m, rad]
ORIENTATION_ATTRIBUTES = ("quat", "axisangle", "euler", "xyaxes", "zaxis")
IMPLICIT_INTEGRATORS = (2, 3)  # mjINT_IMPLICIT, mjINT_IMPLICITFAST
MIN_TIMESTEP = 1e-5  # with which an arm comes to rest in seconds of computation [s]
INERTIA_SAMPLES = 200  # poses at which the largest inertia is looked for


@dataclass(frozen=True, eq=False)
class ModelServos:
    """The position servos of a model, reduced to the joints; zeros where a joint has none.

    gain, damper: (n,) of the servos [N m/rad, N m s/rad].  joint_damping: (n,) of the joints.
    limits: (n, 2) of the torque of each joint's actuators [N m].
    damped_by_joint: (n,) True where the joint is to hold its servo's damper: MuJoCo integrates that
    implicitly, whatever the integrator.
    gravity_free: whether actuators carry no gravity because the model's bodies float already.
    """

    gain: Array
    damper: Array
    joint_damping: Array
    limits: Array
    damped_by_joint: Array
    gravity_free: bool = False

    @staticmethod
    def of_joints_without_drives(joint_count: int) -> ModelServos:
        """All gains and damping 0 and torques unlimited, as a new file has it."""
        zeros, limits = np.zeros(joint_count), np.array([[-np.inf, np.inf]] * joint_count)
        return ModelServos(zeros, zeros, zeros, limits, np.ones(joint_count, dtype=bool))


class SimulationData(NamedTuple):
    """MuJoCo, a model, new data of it, and (n,) where the joints are in qpos and in forces."""

    mujoco: Any
    model: Any
    data: Any
    qpos_indices: Array
    dof_indices: Array


@dataclass(frozen=True, eq=False)
class ModelArm:
    """An arm in a compiled model.

    model: of MuJoCo; its contacts are off from then on: the arm is judged, not what is around it.
    joint_ids: their n ids, from the foot.  urdf_robot: the same arm as a URDF's would be,
    world to last body.  robot: that it is, nominal; masses NaN where they are assumed.
    base: (4, 4) frame 0 of the robot in the world [m].  gravity: [m/s^2].
    """

    model: Any
    joint_ids: tuple[int, ...]
    urdf_robot: UrdfRobot
    robot: Robot
    base: Array
    gravity: float

    def __post_init__(self) -> None:
        self.model.opt.disableflags |= int(import_mujoco().mjtDisableBit.mjDSBL_CONTACT)

    @staticmethod
    def find_in_model(given: MjcfModel, joint_count: int, tip: str = "") -> ModelArm:
        """The arm of so many joints in a model's file.  tip: its last body.  Raises RobotError."""
        model = given.compile_model()
        return find_model_arm(
            model, joint_count, given.source, tip, has_assumed_masses=given.assumed
        )

    @property
    def body_ids(self) -> tuple[int, ...]:
        """Ids of the bodies that the joints carry."""
        return tuple(int(self.model.jnt_bodyid[j]) for j in self.joint_ids)

    @property
    def joint_names(self) -> tuple[str, ...]:
        """Of the joints."""
        return tuple(self.model.joint(j).name for j in self.joint_ids)

    @property
    def qpos_indices(self) -> Array:
        """(n,) where the joints are in qpos."""
        return np.array(self.model.jnt_qposadr[list(self.joint_ids)])

    @property
    def dof_indices(self) -> Array:
        """(n,) where they are in qvel and forces."""
        return np.array(self.model.jnt_dofadr[list(self.joint_ids)])

    @property
    def timestep(self) -> float:
        """Of time [s]."""
        return float(self.model.opt.timestep)

    def create_data_with_indices(self) -> SimulationData:
        """MuJoCo, the model, new data of it, and (n,) where joints are in qpos and in forces."""
        mj = import_mujoco()
        return SimulationData(
            mj, self.model, mj.MjData(self.model), self.qpos_indices, self.dof_indices
        )

    def with_model(self, model: Any) -> ModelArm:
        """The same joints in another compiled model, whose bodies stand where they did."""
        return replace(self, model=model, joint_ids=self.find_joint_ids(model))

    def find_joint_ids(self, model: Any) -> tuple[int, ...]:
        """Of the joints of the same names in another model."""
        return tuple(int(model.joint(name).id) for name in self.joint_names)

    @property
    def servo_ids(self) -> Array:
        """(n,) ids of the position actuators of its joints, -1 where there is none."""
        m = self.model
        ids = [i for i in range(m.nu) if m.actuator_biasprm[i, 1] < 0.0 < m.actuator_gainprm[i, 0]]
        return np.array(
            [next((i for i in ids if is_driven_by_actuator(m, i, j)), -1) for j in self.joint_ids]
        )

    def read_servos(self) -> ModelServos:
        """The servos with their gains, dampers and force limits, as MuJoCo has compiled them."""
        model, joints, n = self.model, list(self.joint_ids), len(self.joint_ids)
        gain, damper, limits = np.zeros(n), np.zeros(n), np.array([[-np.inf, np.inf]] * n)
        for i, (joint, servo) in enumerate(zip(joints, self.servo_ids, strict=True)):
            if model.jnt_actfrclimited[joint]:
                limits[i] = model.jnt_actfrcrange[joint]
            if servo < 0:
                continue
            gear = model.actuator_gear[servo, 0]
            gain[i], damper[i] = -model.actuator_biasprm[servo, 1:3] * gear**2
            if model.actuator_forcelimited[servo]:
                ends = np.sort(model.actuator_forcerange[servo] * gear)
                limits[i] = max(limits[i, 0], ends[0]), min(limits[i, 1], ends[1])
        is_explicit = model.opt.integrator not in IMPLICIT_INTEGRATORS
        is_floating = (model.body_gravcomp[list(self.body_ids)] > 0.0).any()
        gravity_free = bool(is_floating and not model.jnt_actgravcomp[joints].any())
        return ModelServos(gain, damper, model.dof_damping[self.dof_indices], limits,
                           self.has_servo_dampers() | is_explicit, gravity_free)  # fmt: skip

    def has_servo_dampers(self) -> Array:
        """(n,) True where a joint holds the damper of its servo, as those of a new file of ours do.

        Whatever the integrator of the scene that the file is attached to, it takes that implicitly.
        """
        model = self.model
        ours, bias = find_id(model, "TEXT", ROBOT_TEXT_NAME) >= 0, model.actuator_biasprm
        bare = [i for i in range(model.nu) if ours and bias[i, 1] < 0.0 and bias[i, 2] == 0.0]
        return np.array(
            [any(is_driven_by_actuator(model, i, j) for i in bare) for j in self.joint_ids],
            dtype=bool,
        )

    @property
    def has_assumed_masses(self) -> bool:
        """Whether the model does not tell the masses of all links."""
        return not bool(known_link_mass_mask(self.robot).all())

    def find_masses(self, nominal: Robot) -> tuple[Array, Array] | None:
        """Masses (n,) [kg], their centres (n, 3) in the links of another robot of the arm [m].

        nominal: that robot.  None where the masses of the model are assumed.
        """
        if self.has_assumed_masses:
            return None
        base, _ = match_robot_to_urdf(nominal, self.urdf_robot)
        links, own = (
            link_frames_at_zero(nominal, base)[1:],
            link_frames_at_zero(self.robot, self.base)[1:],
        )
        com = [
            invert_transform(a)[:3, :3] @ (b[:3, :3] @ c + b[:3, 3] - a[:3, 3])
            for a, b, c in zip(links, own, self.robot.com, strict=True)
        ]
        return self.robot.mass, np.array(com)

    def check_force_limits(self, q: Array, source: str) -> None:
        """Raise RobotError where gravity alone asks for more than a joint's force limit.

        q: (m, n) poses that the arm is to hold [rad, m].
        """
        servos = self.read_servos()
        if servos.gravity_free:
            return
        mj, model, data, at, dofs = self.create_data_with_indices()
        for row in q:
            data.qpos[at] = row
            mj.mj_forward(model, data)
            needed = data.qfrc_bias[dofs]
            short = (needed <= servos.limits[:, 0]) | (needed >= servos.limits[:, 1])
            if short.any():
                i = int(np.argmax(short))
                unit = "N" if self.robot.prismatic[i] else "N m"
                limit = np.abs(servos.limits[i]).min()
                raise RobotError(
                    f"{source}: joint {self.joint_names[i]}: gravity asks for {abs(needed[i]):.4g} "
                    f"{unit} at a measured pose, its force limit is {limit:.4g} {unit}; raise the "
                    "limit (forcerange), or mend the masses"
                )

    def name_joints_with_filtered_commands(self) -> str:
        """The joints whose servos filter their commands, in words; empty where none does."""
        is_filtered = self.model.actuator_dyntype[self.servo_ids] * (self.servo_ids >= 0) > 0
        return ", ".join(np.array(self.joint_names)[is_filtered])

    def robot_under_gravity(self) -> Robot:
        """The robot, its vertical as long as the model's gravity over that of the earth.

        Raises OptionError for a model without gravity.
        """
        if self.gravity == 0.0:
            raise OptionError(
                "the model has no gravity; give it <option gravity=...>, as the arm has"
            )
        return replace(self.robot, up=self.robot.up * self.gravity / STANDARD_GRAVITY)

    def find_feed_forward_joints_by_actuator(self) -> dict[int, int]:
        """Ids of actuators that take the commanded speed of a joint, and which joint (from 0)."""
        ids = (find_id(self.model, "ACTUATOR", f"{name}_ahead") for name in self.joint_names)
        return {number: j for j, number in enumerate(ids) if number >= 0}

    def find_play_qpos_by_joint(self) -> dict[int, int]:
        """Joints (from 0) whose gear has play, and where the position in it is in qpos."""
        ids = (find_id(self.model, "JOINT", f"play{i + 1}") for i in range(len(self.joint_ids)))
        return {i: int(self.model.jnt_qposadr[k]) for i, k in enumerate(ids) if k >= 0}

    def find_carrying_joints(self) -> Array:
        """(nbody,) which joint (from 0), of several the last, carries a body; -1 for none."""
        model, bodies = self.model, self.body_ids
        joint = np.full(model.nbody, -1)
        for body in range(1, model.nbody):
            own = bodies.index(body) if body in bodies else -1
            joint[body] = max(own, int(joint[model.body_parentid[body]]))
        return joint

    @property
    def target_body(self) -> int:
        """Id of the body that carries the targets: a tool of ours that sags, else the last one."""
        tool, last = find_id(self.model, "BODY", "tool"), len(self.joint_ids) - 1
        is_ours = tool >= 0 and self.find_carrying_joints()[tool] == last
        return tool if is_ours else self.body_ids[-1]

    def compute_data_at_zero(self) -> Any:
        """The model's data with the arm at joint values 0, all else as the file has it."""
        mj, model, data, at, _ = self.create_data_with_indices()
        data.qpos[at] = 0.0
        mj.mj_kinematics(model, data)
        return data

    def find_poses_at_zero(self) -> Array:
        """(nbody, 4, 4) poses of all bodies in the world, the arm at joint values 0 [m]."""
        data = self.compute_data_at_zero()
        return np.array([body_pose(data, body) for body in range(self.model.nbody)])

    def largest_inertias_over_workspace(self) -> Array:
        """(n,) about each joint, its motor's with it, all over the workspace [kg m^2]."""
        mj, model, data, at, dofs = self.create_data_with_indices()
        column, out = np.zeros(model.nv), np.zeros(len(dofs))
        for row in random_joint_values(self.robot, (INERTIA_SAMPLES,), np.random.default_rng(0)):
            data.qpos[at] = row
            mj.mj_forward(model, data)
            for i, unit in enumerate(np.eye(model.nv)[dofs]):
                mj.mj_mulM(model, data, column, unit)
                out[i] = max(out[i], column[dofs[i]])
        return out


def find_model_arm(
    model: Any,
    joint_count: int,
    source: str,
    tip_name: str = "",
    *,
    has_assumed_masses: bool = False,
) -> ModelArm:
    """The arm of so many joints in a model.

    tip_name: its last body.  has_assumed_masses: whether its masses are assumed.  Raises
    RobotError.
    """
    step = model.opt.timestep
    if step < MIN_TIMESTEP:
        raise RobotError(
            f"{source}: its timestep of {step:g} s is too short for an arm to come to rest; give "
            f'<option timestep="..."> of {MIN_TIMESTEP:g} s or more'
        )
    return build_model_arm(
        model,
        find_arm_joint_ids(model, joint_count, source, tip_name),
        source,
        has_assumed_masses=has_assumed_masses,
    )


def build_model_arm(
    model: Any, joint_ids: tuple[int, ...], source: str, *, has_assumed_masses: bool = False
) -> ModelArm:
    """The arm of some joints (n,) of a model, by their ids from the foot.

    A file of ours holds its robot whole, as text: that counts, where the bodies still have it.
    has_assumed_masses: whether its masses are assumed.  Raises RobotError.
    """
    tip = body_name(model, int(model.jnt_bodyid[joint_ids[-1]]))
    seen = convert_urdf_to_robot(convert_model_to_urdf(model, source, joint_ids), tip)
    gravity = float(np.linalg.norm(model.opt.gravity))
    robot, base = robot_from_dict(seen.content, source), seen.base
    if gravity > 0.0:
        robot = replace(robot, up=-(base[:3, :3].T @ model.opt.gravity) / gravity)
    if has_assumed_masses:
        robot = replace(robot, mass=robot.mass * np.nan, com=robot.com * np.nan)
    text = find_id(model, "TEXT", ROBOT_TEXT_NAME)
    if text >= 0:
        start, size = int(model.text_adr[text]), int(model.text_size[text])
        with suppress(ValueError, CalibrationError):  # no robot, or bodies were moved since
            raw = bytes(model.text_data[start : start + size]).rstrip(b"\0")
            ours = robot_from_dict(parse_json(raw), source)
            if ours.joints == len(joint_ids):
                place, misfit = match_robot_to_urdf(ours, seen)
                if misfit < MAX_ROBOT_TEXT_MISFIT:
                    robot, base = ours, place
    return ModelArm(model, joint_ids, seen, robot, base, gravity)


def find_id(model: Any, kind: str, name: str) -> int:
    """Id of the element of a name, -1 where there is none.  kind: as in mjOBJ_JOINT."""
    return int(
        import_mujoco().mj_name2id(model, getattr(import_mujoco().mjtObj, f"mjOBJ_{kind}"), name)
    )


def find_arm_joint_ids(model: Any, joint_count: int, source: str, tip_name: str) -> tuple[int, ...]:
    """Ids of the joints from the foot to the tip, or of the only arm of so many joints.

    Where more lie on the way, those that an actuator drives; of several the driven arm.
    """
    found: dict[tuple[int, ...], list[str]] = {}
    sites = {model.site(i).name: int(model.site_bodyid[i]) for i in range(model.nsite)}
    tip_name = split_root_and_tip(
        tip_name, [*sites, *(model.body(i).name for i in range(model.nbody))]
    )[1]
    tip_name = model.body(sites[tip_name]).name if tip_name in sites else tip_name
    for body in range(1, model.nbody):
        name = model.body(body).name
        if tip_name and name != tip_name:
            continue
        way = find_joint_path_to_body(model, body)
        if len(way) > joint_count:
            way = tuple(j for j in way if has_actuator(model, j))
        if len(way) == joint_count:
            found.setdefault(way, []).append(name)
    if tip_name and not any(model.body(i).name == tip_name for i in range(model.nbody)):
        raise RobotError(f"{source}: has no body {tip_name!r}")
    actuated = [way for way in found if all(has_actuator(model, joint) for joint in way)]
    if len(found) == 1 or len(actuated) == 1:
        return actuated[0] if actuated else next(iter(found))
    if not found:
        most = max(
            (len(find_joint_path_to_body(model, b)) for b in range(1, model.nbody)), default=0
        )
        raise RobotError(
            f"{source}: no chain of {joint_count} hinges and "
            f"slides, as the measurements have joints "
            f"(the longest has {most})"
        )
    ends = ", ".join(names[0] or "a body without a name" for names in found.values())
    raise RobotError(
        f"{source}: several arms of {joint_count} joints ({ends}); name a body as tip="
    )


def fill_command_history(model: Any, data: Any) -> None:
    """Let delayed actuators have had their commands all the time: MuJoCo begins with 0."""
    for k, (count, _) in enumerate(getattr(model, "actuator_history", ())):
        if count:
            import_mujoco().mj_initCtrlHistory(model, data, k, None, np.full(count, data.ctrl[k]))


def pose_in_parent(model: Any, body: int) -> Array:
    """(4, 4) of a body in its parent body, as a model has it [m]."""
    turn = Rotation.from_quat(model.body_quat[body], scalar_first=True).as_matrix()
    return build_transform(turn, np.array(model.body_pos[body]))
