"""The arm in a model that MuJoCo has compiled: its joints in order, and the robot they make."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from minimax_cal.correcting.exporters.correct import laid, match
from minimax_cal.ground.arrays import Array
from minimax_cal.ground.errors import CalibrationError, OptionError, RobotError
from minimax_cal.ground.files import json_of
from minimax_cal.robots.gravity import G, weighed
from minimax_cal.robots.mjcf import (
    Given,
    body_name,
    body_pose,
    drives,
    is_driven,
    mujoco,
    tree_of,
    way_to,
)
from minimax_cal.robots.robot import Robot, robot_from_dict
from minimax_cal.robots.sampling import random_joints
from minimax_cal.robots.transforms import inverse, transform
from minimax_cal.robots.urdf import UrdfRobot, both_ends, to_robot

ROBOT = "minimax_cal_robot"  # the text under which a file of ours holds its robot whole
SAME_ROBOT = 1e-6  # a file's own robot may differ from its bodies by no more [m, rad]
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
    def none(joint_count: int) -> ModelServos:
        """Of a new file."""
        zeros, limits = np.zeros(joint_count), np.array([[-np.inf, np.inf]] * joint_count)
        return ModelServos(zeros, zeros, zeros, limits, np.ones(joint_count, dtype=bool))


@dataclass(frozen=True, eq=False)
class Chain:
    """An arm in a compiled model.

    model: of MuJoCo; its contacts are off from then on: the arm is judged, not what is around it.
    joints: their n ids, from the foot.  seen: the same arm as a URDF's would be,
    world to last body.  robot: that it is, nominal; masses NaN where they are assumed.
    base: (4, 4) frame 0 of the robot in the world [m].  gravity: [m/s^2].
    """

    model: Any
    joints: tuple[int, ...]
    seen: UrdfRobot
    robot: Robot
    base: Array
    gravity: float

    def __post_init__(self) -> None:
        self.model.opt.disableflags |= int(mujoco().mjtDisableBit.mjDSBL_CONTACT)

    @staticmethod
    def find(given: Given, joint_count: int, tip: str = "") -> Chain:
        """The arm of so many joints in a model's file.  tip: its last body.  Raises RobotError."""
        model = given.compiled()
        return chain_of(model, joint_count, given.source, tip, unknown=given.assumed)

    @property
    def bodies(self) -> tuple[int, ...]:
        """Ids of the bodies that the joints carry."""
        return tuple(int(self.model.jnt_bodyid[j]) for j in self.joints)

    @property
    def names(self) -> tuple[str, ...]:
        """Of the joints."""
        return tuple(self.model.joint(j).name for j in self.joints)

    @property
    def places(self) -> Array:
        """(n,) where the joints are in qpos."""
        return np.array(self.model.jnt_qposadr[list(self.joints)])

    @property
    def dofs(self) -> Array:
        """(n,) where they are in qvel and forces."""
        return np.array(self.model.jnt_dofadr[list(self.joints)])

    @property
    def step(self) -> float:
        """Of time [s]."""
        return float(self.model.opt.timestep)

    def fresh(self) -> tuple[Any, Any, Any, Array, Array]:
        """MuJoCo, the model, new data of it, and (n,) where joints are in qpos and in forces."""
        mj = mujoco()
        return mj, self.model, mj.MjData(self.model), self.places, self.dofs

    def in_model(self, model: Any) -> Chain:
        """The same joints in another compiled model, whose bodies stand where they did."""
        return replace(self, model=model, joints=self.ids_in(model))

    def ids_in(self, model: Any) -> tuple[int, ...]:
        """Of the joints of the same names in another model."""
        return tuple(int(model.joint(name).id) for name in self.names)

    @property
    def servos(self) -> Array:
        """(n,) ids of the position actuators of its joints, -1 where there is none."""
        m = self.model
        ids = [i for i in range(m.nu) if m.actuator_biasprm[i, 1] < 0.0 < m.actuator_gainprm[i, 0]]
        return np.array([next((i for i in ids if drives(m, i, j)), -1) for j in self.joints])

    def read_servos(self) -> ModelServos:
        """The servos with their gains, dampers and force limits, as MuJoCo has compiled them."""
        model, joints, n = self.model, list(self.joints), len(self.joints)
        gain, damper, limits = np.zeros(n), np.zeros(n), np.array([[-np.inf, np.inf]] * n)
        for i, (joint, servo) in enumerate(zip(joints, self.servos, strict=True)):
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
        is_floating = (model.body_gravcomp[list(self.bodies)] > 0.0).any()
        gravity_free = bool(is_floating and not model.jnt_actgravcomp[joints].any())
        return ModelServos(gain, damper, model.dof_damping[self.dofs], limits,
                           self.has_servo_dampers() | is_explicit, gravity_free)  # fmt: skip

    def has_servo_dampers(self) -> Array:
        """(n,) True where a joint holds the damper of its servo, as those of a new file of ours do.

        Whatever the integrator of the scene that the file is attached to, it takes that implicitly.
        """
        model = self.model
        ours, bias = find_id(model, "TEXT", ROBOT) >= 0, model.actuator_biasprm
        bare = [i for i in range(model.nu) if ours and bias[i, 1] < 0.0 and bias[i, 2] == 0.0]
        return np.array([any(drives(model, i, j) for i in bare) for j in self.joints], dtype=bool)

    @property
    def has_assumed_masses(self) -> bool:
        """Whether the model does not tell the masses of all links."""
        return not bool(weighed(self.robot).all())

    def find_masses(self, nominal: Robot) -> tuple[Array, Array] | None:
        """Masses (n,) [kg], their centres (n, 3) in the links of another robot of the arm [m].

        nominal: that robot.  None where the masses of the model are assumed.
        """
        if self.has_assumed_masses:
            return None
        base, _ = match(nominal, self.seen)
        links, own = laid(nominal, base)[1:], laid(self.robot, self.base)[1:]
        com = [
            inverse(a)[:3, :3] @ (b[:3, :3] @ c + b[:3, 3] - a[:3, 3])
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
        mj, model, data, at, dofs = self.fresh()
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
                    f"{source}: joint {self.names[i]}: gravity asks for {abs(needed[i]):.4g} "
                    f"{unit} at a measured pose, its force limit is {limit:.4g} {unit}; raise the "
                    "limit (forcerange), or mend the masses"
                )

    def find_filtered_servos(self) -> str:
        """The joints whose servos filter their commands, in words; empty where none does."""
        is_filtered = self.model.actuator_dyntype[self.servos] * (self.servos >= 0) > 0
        return ", ".join(np.array(self.names)[is_filtered])

    def robot_under_gravity(self) -> Robot:
        """The robot, its vertical as long as the model's gravity over that of the earth.

        Raises OptionError for a model without gravity.
        """
        if self.gravity == 0.0:
            raise OptionError(
                "the model has no gravity; give it <option gravity=...>, as the arm has"
            )
        return replace(self.robot, up=self.robot.up * self.gravity / G)

    def find_feed_forward(self) -> dict[int, int]:
        """Ids of actuators that take the commanded speed of a joint, and which joint (from 0)."""
        ids = (find_id(self.model, "ACTUATOR", f"{name}_ahead") for name in self.names)
        return {number: j for j, number in enumerate(ids) if number >= 0}

    def find_plays(self) -> dict[int, int]:
        """Joints (from 0) whose gear has play, and where the position in it is in qpos."""
        ids = (find_id(self.model, "JOINT", f"play{i + 1}") for i in range(len(self.joints)))
        return {i: int(self.model.jnt_qposadr[k]) for i, k in enumerate(ids) if k >= 0}

    def find_carrying_joints(self) -> Array:
        """(nbody,) which joint (from 0), of several the last, carries a body; -1 for none."""
        model, bodies = self.model, self.bodies
        joint = np.full(model.nbody, -1)
        for body in range(1, model.nbody):
            own = bodies.index(body) if body in bodies else -1
            joint[body] = max(own, int(joint[model.body_parentid[body]]))
        return joint

    @property
    def carrier(self) -> int:
        """Id of the body that carries the targets: a tool of ours that sags, else the last one."""
        tool, last = find_id(self.model, "BODY", "tool"), len(self.joints) - 1
        is_ours = tool >= 0 and self.find_carrying_joints()[tool] == last
        return tool if is_ours else self.bodies[-1]

    def data_at_zero(self) -> Any:
        """The model's data with the arm at joint values 0, all else as the file has it."""
        mj, model, data, at, _ = self.fresh()
        data.qpos[at] = 0.0
        mj.mj_kinematics(model, data)
        return data

    def find_poses_at_zero(self) -> Array:
        """(nbody, 4, 4) poses of all bodies in the world, the arm at joint values 0 [m]."""
        data = self.data_at_zero()
        return np.array([body_pose(data, body) for body in range(self.model.nbody)])

    def find_largest_inertias(self) -> Array:
        """(n,) about each joint, its motor's with it, all over the workspace [kg m^2]."""
        mj, model, data, at, dofs = self.fresh()
        column, out = np.zeros(model.nv), np.zeros(len(dofs))
        for row in random_joints(self.robot, (INERTIA_SAMPLES,), np.random.default_rng(0)):
            data.qpos[at] = row
            mj.mj_forward(model, data)
            for i, unit in enumerate(np.eye(model.nv)[dofs]):
                mj.mj_mulM(model, data, column, unit)
                out[i] = max(out[i], column[dofs[i]])
        return out


def chain_of(model: Any, count: int, source: str, tip: str = "", *, unknown: bool = False) -> Chain:
    """The arm of so many joints in a model.

    tip: its last body.  unknown: whether its masses are assumed.  Raises RobotError.
    """
    step = model.opt.timestep
    if step < MIN_TIMESTEP:
        raise RobotError(
            f"{source}: its timestep of {step:g} s is too short for an arm to come to rest; give "
            f'<option timestep="..."> of {MIN_TIMESTEP:g} s or more'
        )
    return chain_along(model, joints_of(model, count, source, tip), source, unknown=unknown)


def chain_along(
    model: Any, joints: tuple[int, ...], source: str, *, unknown: bool = False
) -> Chain:
    """The arm of some joints (n,) of a model, by their ids from the foot.

    A file of ours holds its robot whole, as text: that counts, where the bodies still have it.
    unknown: whether its masses are assumed.  Raises RobotError.
    """
    tip = body_name(model, int(model.jnt_bodyid[joints[-1]]))
    seen = to_robot(tree_of(model, source, joints), tip)
    gravity = float(np.linalg.norm(model.opt.gravity))
    robot, base = robot_from_dict(seen.content, source), seen.base
    if gravity > 0.0:
        robot = replace(robot, up=-(base[:3, :3].T @ model.opt.gravity) / gravity)
    if unknown:
        robot = replace(robot, mass=robot.mass * np.nan, com=robot.com * np.nan)
    text = find_id(model, "TEXT", ROBOT)
    if text >= 0:
        start, size = int(model.text_adr[text]), int(model.text_size[text])
        with suppress(ValueError, CalibrationError):  # no robot, or bodies were moved since
            raw = bytes(model.text_data[start : start + size]).rstrip(b"\0")
            ours = robot_from_dict(json_of(raw), source)
            if ours.joints == len(joints):
                place, misfit = match(ours, seen)
                if misfit < SAME_ROBOT:
                    robot, base = ours, place
    return Chain(model, joints, seen, robot, base, gravity)


def find_id(model: Any, kind: str, name: str) -> int:
    """Id of the element of a name, -1 where there is none.  kind: as in mjOBJ_JOINT."""
    return int(mujoco().mj_name2id(model, getattr(mujoco().mjtObj, f"mjOBJ_{kind}"), name))


def joints_of(model: Any, count: int, source: str, tip: str) -> tuple[int, ...]:
    """Ids of the joints from the foot to the tip, or of the only arm of so many joints.

    Where more lie on the way, those that an actuator drives; of several the driven arm.
    """
    found: dict[tuple[int, ...], list[str]] = {}
    sites = {model.site(i).name: int(model.site_bodyid[i]) for i in range(model.nsite)}
    tip = both_ends(tip, [*sites, *(model.body(i).name for i in range(model.nbody))])[1]
    tip = model.body(sites[tip]).name if tip in sites else tip
    for body in range(1, model.nbody):
        name = model.body(body).name
        if tip and name != tip:
            continue
        way = way_to(model, body)
        if len(way) > count:
            way = tuple(j for j in way if is_driven(model, j))
        if len(way) == count:
            found.setdefault(way, []).append(name)
    if tip and not any(model.body(i).name == tip for i in range(model.nbody)):
        raise RobotError(f"{source}: has no body {tip!r}")
    actuated = [way for way in found if all(is_driven(model, joint) for joint in way)]
    if len(found) == 1 or len(actuated) == 1:
        return actuated[0] if actuated else next(iter(found))
    if not found:
        most = max((len(way_to(model, b)) for b in range(1, model.nbody)), default=0)
        raise RobotError(
            f"{source}: no chain of {count} hinges and slides, as the measurements have joints "
            f"(the longest has {most})"
        )
    ends = ", ".join(names[0] or "a body without a name" for names in found.values())
    raise RobotError(f"{source}: several arms of {count} joints ({ends}); name a body as tip=")


def fill_history(model: Any, data: Any) -> None:
    """Let delayed actuators have had their commands all the time: MuJoCo begins with 0."""
    for k, (count, _) in enumerate(getattr(model, "actuator_history", ())):
        if count:
            mujoco().mj_initCtrlHistory(model, data, k, None, np.full(count, data.ctrl[k]))


def pose_in_parent(model: Any, body: int) -> Array:
    """(4, 4) of a body in its parent body, as a model has it [m]."""
    turn = Rotation.from_quat(model.body_quat[body], scalar_first=True).as_matrix()
    return transform(turn, np.array(model.body_pos[body]))
