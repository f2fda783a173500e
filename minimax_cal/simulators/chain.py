"""The arm in a model that MuJoCo has compiled: its joints in order, and the robot they make."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from minimax_cal.correcting.exporters.correct import match
from minimax_cal.ground.arrays import Array
from minimax_cal.ground.errors import CalibrationError, OptionError, RobotError
from minimax_cal.ground.files import json_of
from minimax_cal.robots.mjcf import body_name, drives, is_driven, mujoco, tree_of, way_to
from minimax_cal.robots.robot import Robot, robot_from_dict
from minimax_cal.robots.transforms import transform
from minimax_cal.robots.urdf import UrdfRobot, both_ends, to_robot

ROBOT = "minimax_cal_robot"  # the text under which a file of ours holds its robot whole
SAME_ROBOT = 1e-6  # a file's own robot may differ from its bodies by no more [m, rad]
UPRIGHT = np.array([1.0, 0.0, 0.0, 0.0])  # the quaternion of no turn, as MuJoCo has it
TURNS = ("quat", "axisangle", "euler", "xyaxes", "zaxis")  # forms of an orientation
Bodies = Sequence[int]
SHORTEST = 1e-5  # timestep with which an arm comes to rest in seconds [s]


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
        return np.array([self.servo(joint) for joint in self.joints])

    def servo(self, joint: int) -> int:
        """Id of the position actuator of a joint; -1 where there is none."""
        m = self.model
        for i in range(m.nu):
            is_servo = m.actuator_biasprm[i, 1] < 0.0 < m.actuator_gainprm[i, 0]
            if is_servo and drives(m, i, joint):
                return i
        return -1


def chain_of(model: Any, count: int, source: str, tip: str = "", *, unknown: bool = False) -> Chain:
    """The arm of so many joints in a model.

    tip: its last body.  unknown: whether its masses are assumed.  Raises RobotError.
    """
    step = model.opt.timestep
    if step < SHORTEST:
        raise RobotError(
            f"{source}: its timestep of {step:g} s is too short for an arm to come to rest; give "
            f'<option timestep="..."> of {SHORTEST:g} s or more'
        )
    return chain_along(model, joints_of(model, count, source, tip), source, unknown=unknown)


def chain_along(
    model: Any, joints: tuple[int, ...], source: str, *, unknown: bool = False
) -> Chain:
    """The arm of some joints (n,) of a model, by their ids from the foot.  Raises RobotError."""
    tip = body_name(model, int(model.jnt_bodyid[joints[-1]]))
    seen = to_robot(tree_of(model, source, joints), tip)
    down = model.opt.gravity
    size = float(np.linalg.norm(down))
    robot = robot_from_dict(seen.content, source)
    if size > 0.0:
        robot = replace(robot, up=-(seen.base[:3, :3].T @ down) / size)
    if unknown:
        robot = replace(robot, mass=robot.mass * np.nan, com=robot.com * np.nan)
    base = seen.base
    told = told_robot(model, source)
    if told is not None and told.joints == len(joints):
        with suppress(OptionError):  # the bodies were moved since: then they count
            place, off = match(told, seen)
            if off < SAME_ROBOT:
                robot, base = told, place
    return Chain(model, joints, seen, robot, base, size)


def id_of(model: Any, kind: str, name: str) -> int:
    """Of an element of a name, -1 where there is none.  kind: as `JOINT`."""
    return int(mujoco().mj_name2id(model, getattr(mujoco().mjtObj, f"mjOBJ_{kind}"), name))


def told_robot(model: Any, source: str) -> Robot | None:
    """The robot that a file of ours holds whole."""
    number = id_of(model, "TEXT", ROBOT)
    if number < 0:
        return None
    start, size = int(model.text_adr[number]), int(model.text_size[number])
    try:
        raw = bytes(model.text_data[start : start + size]).rstrip(b"\0")
        return robot_from_dict(json_of(raw), source)
    except (ValueError, CalibrationError):
        return None


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


def braked(model: Any) -> Array:
    """(njnt,) True where a joint holds the damper of its servo, as those of a new file of ours do.

    Whatever the integrator of the scene that the file is attached to, it takes that implicitly.
    """
    ours = id_of(model, "TEXT", ROBOT) >= 0
    bias = model.actuator_biasprm
    bare = [i for i in range(model.nu) if ours and bias[i, 1] < 0.0 and bias[i, 2] == 0.0]
    joints = range(model.njnt)
    return np.array([any(drives(model, i, j) for i in bare) for j in joints], dtype=bool)


def carrier(chain: Chain) -> int:
    """Id of the body that carries the targets: a tool of ours that sags, else the last one."""
    found, bodies = id_of(chain.model, "BODY", "tool"), chain.bodies
    ours = found >= 0 and holders(chain.model, bodies)[found] == len(bodies) - 1
    return found if ours else bodies[-1]


def fill_history(model: Any, data: Any) -> None:
    """Let delayed actuators have had their commands all the time: MuJoCo begins with 0."""
    for k, (count, _) in enumerate(getattr(model, "actuator_history", ())):
        if count:
            mujoco().mj_initCtrlHistory(model, data, k, None, np.full(count, data.ctrl[k]))


def at_zero(model: Any, joints: Sequence[int]) -> Any:
    """The model's data with the arm at joint values 0, all else as the file has it."""
    data = mujoco().MjData(model)
    for joint in joints:
        data.qpos[model.jnt_qposadr[joint]] = 0.0
    mujoco().mj_kinematics(model, data)
    return data


def holders(model: Any, bodies: Bodies) -> Array:
    """(nbody,) which joint, from 0, alone carries a body; -1 for none."""
    holder = np.full(model.nbody, -1)
    for body in range(1, model.nbody):
        own = bodies.index(body) if body in bodies else -1
        holder[body] = max(own, int(holder[model.body_parentid[body]]))
    return holder


def pose_at(position: Array, quaternion: Array = UPRIGHT) -> Array:
    """(4, 4) of a position and MuJoCo's quaternion, w first."""
    turn = Rotation.from_quat(quaternion, scalar_first=True).as_matrix()
    return transform(turn, np.array(position))


def own_pose(attributes: dict[str, str], compiler: dict[str, str]) -> Array:
    """(4, 4) that position and orientation of an element mean, in whatever form they stand."""
    kept = " ".join(f'{k}="{attributes[k]}"' for k in ("pos", *TURNS) if k in attributes)
    told = " ".join(f'{k}="{compiler[k]}"' for k in ("angle", "eulerseq") if k in compiler)
    model = mujoco().MjModel.from_xml_string(
        f"<mujoco><compiler {told}/><worldbody><body {kept}/></worldbody></mujoco>"
    )
    return pose_at(model.body_pos[1], model.body_quat[1])
