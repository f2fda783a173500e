"""Joints that give way under gravity, and the spring that carries the upper arm."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from minimax_cal.ground.arrays import Array
from minimax_cal.modelling.effects.scene import (
    Choice,
    Columns,
    Effect,
    Scene,
    joint_of,
    mask_of,
    one_joint,
    principal,
    turning,
    unmasked,
)
from minimax_cal.robots.gravity import G

TOUCHES = 0.1  # share of its weight's largest torque by which a tool's must vary on a joint
FELT = 1e-3  # share of the largest torque's variation below which a joint carries nothing
GROUPS = ("upper arm", "forearm", "wrist")  # two links each
ALIKE = 0.2  # share of a neighbour's torque that must differ from a joint's own
WHOLE = 3  # stands for all links together
SOFT = (0.15, 0.5)  # of its largest torque, to which a joint gives way more than beyond
SOFTEST, STIFFEST = 0.03, 1.5  # the same, least and most: play that a load takes up, no end seen
BESIDE_AXIS = 0.1  # lever of the kilogram that stands for a tool beside the flange's axis [m]


def varying(scene: Scene) -> Array:
    """(n,) how much each joint's torque varies between the poses [N m]."""
    return np.asarray(scene.gravity.std(axis=1))


def loaded(scene: Scene) -> list[int]:
    """Joints on which gravity's torque varies."""
    size = varying(scene)
    return [j for j in range(scene.joints) if size[j] > FELT * max(size.max(), 1e-9)]


def places(scene: Scene) -> tuple[str, ...]:
    """Loaded joints, and all of them together."""
    joints = loaded(scene)
    single = tuple(f"J{j + 1}" for j in joints)
    return (*single, "all") if len(joints) > 1 else single


def parts_of(scene: Scene, place: str) -> Sequence[Choice]:
    """Which torques are told apart: bit 4 j + g for group g at joint j, g = 3 for the whole.

    With known masses or measured torques there is one torque a joint.  Without, the torques of
    upper arm, forearm and wrist are taken apart, because their masses are free; one that another
    explains as well is left out.  Nobody tells the tool's weight then either, and it may hang
    beside the flange's axis: all joints together are tried with that too (`tool`: `beside_axis`).
    A single joint is also tried as one that stiffens (`within`): under the wrist's torque, or under
    that of all links with masses that are `assumed`.
    """
    joints = loaded(scene) if place == "all" else [joint_of(place)]
    if scene.known_masses or scene.measured_torques:
        plain = {"parts": mask_of([4 * j + WHOLE for j in joints])}
        return (plain, *stiffening(scene, place, (WHOLE,)))
    chosen = []
    for j in joints:
        kept = np.ones((1, scene.poses))
        for group in range(j // 2, len(GROUPS)):
            torque = torque_of(scene, j, group)
            basis = np.linalg.qr(kept.T)[0]
            rest = torque - basis @ (basis.T @ torque)
            if np.linalg.norm(rest) > 0.02 * np.linalg.norm(torque - torque.mean()) + 1e-9:
                chosen.append(4 * j + group)
                kept = np.concatenate([kept, torque[None]])
    if not chosen:
        return ()
    parts = {"parts": mask_of(chosen)}
    tool = beside_axis(scene) if place == "all" else 0.0
    wider = ({**parts, "tool": tool},) if tool else ()
    last, own = len(GROUPS) - 1, 4 * joints[0]
    several = sum(largest_torque(scene, own + group) > 0.0 for group in range(len(GROUPS))) > 1
    whole = [{**choice, "assumed": 1.0} for choice in stiffening(scene, place, (WHOLE,))]
    return (parts, *wider, *stiffening(scene, place, (last,)), *(whole if several else ()))


def stiffening(scene: Scene, place: str, groups: Sequence[int]) -> Sequence[Choice]:
    """A single joint that gives way most to the first of the torque of some links."""
    if place == "all":
        return ()
    parts = [4 * joint_of(place) + group for group in groups]
    return [
        {"parts": mask_of([part]), "within": share * most}
        for part in parts
        if (most := largest_torque(scene, part)) > 0.0
        for share in SOFT
    ]


def stiffens(choice: Choice) -> bool:
    """Whether a joint gives way most to the first of its torque, which no single number tells."""
    return bool(np.isfinite(choice.get("within", np.inf)))


def largest_torque(scene: Scene, part: int) -> float:
    """The largest torque of some links about a joint [N m].  part: 4 j + g, as in `parts_of`."""
    return float(np.abs(torque_of(scene, *divmod(part, 4))).max())


def other_ends(scene: Scene, choice: Choice) -> Sequence[Choice]:
    """Torques near that one to which a joint was found to give way most."""
    if "within" not in choice:
        return ()
    most = largest_torque(scene, unmasked(choice["parts"])[0])  # measured ones have no `assumed`
    ends = [part * choice["within"] for part in (0.6, 0.8, 1.25, 1.6)]
    return [{**choice, "within": end} for end in ends if SOFTEST <= end / most <= STIFFEST]


def beside_axis(scene: Scene) -> float:
    """Joints on which a tool beside the flange's axis weighs: bit 2 j for its x, 2 j + 1 for y."""
    felt = tool_torques(scene).std(axis=2) > TOUCHES * G * BESIDE_AXIS
    return mask_of([2 * j + axis for j in turning(scene) for axis in (0, 1) if felt[axis, j]])


def tool_torques(scene: Scene) -> Array:
    """(2, n, m) torques of a kilogram beside the flange's axis, along x and y, less one's on it.

    [N m]
    """
    one, com = np.zeros(scene.joints), np.zeros((3, scene.joints, 3))
    one[-1], com[0, -1, 0], com[1, -1, 1] = 1.0, BESIDE_AXIS, BESIDE_AXIS
    along_x, along_y, amid = (scene.torque(one, place) for place in com)
    return np.stack([along_x - amid, along_y - amid])


def torque_of(scene: Scene, joint: int, group: int) -> Array:
    """(m,) gravity's torque of some of the links about a joint [N m]."""
    return np.asarray(torques_of(scene, group)[joint])


def torques_of(scene: Scene, group: int, *, assumed: bool = False) -> Array:
    """(n, m) gravity's torques of some of the links about all joints [N m].

    assumed: computed in any case, also where torques are measured.
    """
    if group == WHOLE:
        return scene.torque(*scene.masses) + scene.payload if assumed else scene.gravity
    mass, com = scene.masses
    groups = np.minimum(np.arange(scene.joints) // 2, len(GROUPS) - 1)
    torque = scene.torque(np.where(groups == group, mass, 0.0), com)
    return np.asarray(torque + scene.payload * (group == len(GROUPS) - 1))


def differing(joint: int, about: int, slope: Array | float = 1.0) -> Callable[[Scene], Array]:
    """How a joint's turn by the torque about one may differ with the masses: asked for rarely.

    slope: (m,) of the turn by the torque.
    """

    def doubt(scene: Scene) -> Array:
        shapes = principal(scene.gravity_parts[:, about] * slope)
        return np.asarray(np.einsum("rm,kcm->rkcm", shapes, scene.jacobian[joint]))

    return doubt


def columns(scene: Scene, place: str, choice: Choice) -> Columns:
    """dq_j = c_j tau_j; and c_j times the torque of a tool on either side of the flange's axis.

    Or dq_j = c_j t tanh(tau_j / t), t = within: a gear that is soft while its teeth take the load
    up, and stiff beyond.
    """
    turns, names, doubts = [], [], {}
    within, parts = choice.get("within", np.inf), unmasked(choice["parts"])
    groups = {part % 4 for part in parts}
    torques = {group: torques_of(scene, group, assumed="assumed" in choice) for group in groups}
    for number, part in enumerate(parts):
        j, group = divmod(part, 4)
        torque, slope = taken_up(torques[group][j], within)
        turns.append(one_joint(scene, j, torque[None]))
        whole = group == WHOLE
        names.append(f"c{j + 1}" + ("" if whole else f" ({GROUPS[group]})"))
        if whole:
            doubts[number] = differing(j, j, slope)
    positive = len(names)
    levers = unmasked(choice.get("tool", 0.0))
    tool = tool_torques(scene) if levers else np.zeros((2, 0, 0))
    for number in levers:
        j, axis = divmod(number, 2)
        turns.append(one_joint(scene, j, tool[axis, j][None]))
        names.append(f"c{j + 1} (tool {'xy'[axis]})")
    return Columns(
        tuple(names),
        ("rad/(N m)",) * len(names),
        np.concatenate(turns),
        doubt=doubts,
        either=np.arange(len(names)) >= positive,
        fixed={told_as(scene): within} if stiffens(choice) else {},
    )


def told_as(scene: Scene) -> str:
    """What the torque is called to which a joint gives way most: N m that somebody told, or not."""
    told = scene.known_masses or scene.measured_torques
    return "within_Nm" if told else "within_assumed_Nm"


def taken_up(torque: Array, within: float) -> tuple[Array, Array]:
    """(m,) t tanh(tau / t) of torques (m,), t = within, and its slopes; infinite: the torques."""
    if not 0.0 < within < np.inf:
        return torque, np.ones_like(torque)
    course = np.tanh(torque / within)
    return within * course, 1.0 - course**2


JOINT_COMPLIANCE = Effect(
    "joint_compliance",
    "gearboxes wind up under gravity",
    "dq_j = c_j tau_j(q), or c_j t tanh(tau_j / t) of a joint that stiffens",
    places,
    columns,
    choices=parts_of,
    finer=other_ends,
    positive=True,
    follows="load",
)


def neighbours(scene: Scene, place: str) -> Sequence[Choice]:
    """The loaded joints next to one, whose torques its own does not follow."""
    j, heavy = joint_of(place), loaded(scene)
    own = np.stack([np.ones(scene.poses), scene.gravity[j]])
    basis = np.linalg.qr(own.T)[0]
    out = []
    for i in (j - 1, j + 1):
        if i in heavy:
            torque = scene.gravity[i]
            rest = torque - basis @ (basis.T @ torque)
            if np.linalg.norm(rest) > ALIKE * np.linalg.norm(torque - torque.mean()):
                out.append({"source": i + 1.0})
    return tuple(out)


def crossed(scene: Scene, place: str, choice: Choice) -> Columns:
    """dq_j = c tau_i, i = source."""
    j, i = joint_of(place), int(choice["source"]) - 1
    turn = one_joint(scene, j, scene.gravity[i][None])
    doubt, fixed = {0: differing(j, i)}, {"source_joint": i + 1.0}
    return Columns((f"c{j + 1}{i + 1}",), ("rad/(N m)",), turn, doubt=doubt, fixed=fixed)


CROSS_COMPLIANCE = Effect(
    "cross_compliance",
    "a joint is compliant under the load of its neighbour",
    "dq_j = c tau_i(q), i next to j",
    lambda scene: (
        tuple(f"J{j + 1}" for j in turning(scene) if neighbours(scene, f"J{j + 1}"))
        if scene.known_masses or scene.measured_torques
        else ()
    ),
    crossed,
    needs=lambda scene: (
        "" if scene.known_masses or scene.measured_torques
        else "mass_kg and com_mm in the robot file, or columns tau1_Nm ..."
    ),
    choices=neighbours,
    follows="load",
    typical=1e-6,
)  # fmt: skip


def lean(scene: Scene, joint: int) -> Array:
    """(m,) angle of a joint's link from the vertical about the joint's axis [rad]."""
    links = scene.links
    up = np.broadcast_to(scene.robot.up[:, None], links.z[joint].shape)
    axis, along = links.z[joint], links.after[joint] - links.before[joint]
    side = np.cross(up, along, axis=0)
    return np.asarray(np.arctan2((side * axis).sum(axis=0), (up * along).sum(axis=0)))


def spring(scene: Scene, place: str, choice: Choice) -> Columns:
    """dq_j = k sin(b) (1 - s0 / s), s^2 = a^2 + L^2 - 2 a L cos b.

    b: the lean of the joint's link less the spring's zero, where its eye is nearest to its anchor.
    The eye sits at `eye` and the free length is `rest`, both in units of the distance L from the
    joint to its anchor.
    """
    joint = joint_of(place)
    angle = lean(scene, joint) - choice["zero"]
    a, rest = choice["eye"], choice["rest"]
    length = np.sqrt(1.0 + a * a - 2.0 * a * np.cos(angle))
    pull = np.sin(angle) * (1.0 - rest / length)
    return Columns(("k",), ("rad",), one_joint(scene, joint, pull[None]), fixed=dict(choice))


def springs(zeros: Sequence[float], eyes: Sequence[float], rests: Sequence[float]) -> list[Choice]:
    """Every combination."""
    return [{"zero": z, "eye": e, "rest": r} for z in zeros for e in eyes for r in rests]


def finer_spring(scene: Scene, choice: Choice) -> Sequence[Choice]:
    """Springs near one that was chosen."""
    zeros = choice["zero"] + np.linspace(-0.2, 0.2, 5)
    eyes = choice["eye"] + np.linspace(-0.1, 0.1, 3)
    rests = choice["rest"] + np.linspace(-0.1, 0.1, 3)
    return springs(zeros.tolist(), eyes.tolist(), rests.tolist())


def spring_places(scene: Scene) -> tuple[str, ...]:
    """The shoulder: the first joint that turns about a level axis, where it swings upright.

    Springs at other joints have no direction of their own: with any zero they imitate two orders of
    a gear.
    """
    level = np.abs((scene.links.z * scene.robot.up[:, None]).sum(axis=1)).max(axis=1) < 0.5
    joints = np.flatnonzero(level & ~scene.robot.prismatic)
    swings = len(joints) > 0 and np.ptp(lean(scene, int(joints[0]))) > SWING
    return (f"J{joints[0] + 1}",) if swings else ()


# Where a spring is shortest: the arm upright, or hanging (its anchor on the other side).
ZEROS = (-0.25, 0.0, 0.25, np.pi)
SWING = 0.1  # least range of the lean [rad]


GRAVITY_COMPENSATOR = Effect(
    "gravity_compensator",
    "the spring that balances the upper arm",
    "dq_j = k a L sin(q_j - phi) (1 - s_0/s)",
    spring_places,
    spring,
    choices=lambda scene, place: springs(ZEROS, (0.4, 0.55), (0.45, 0.65)),
    finer=finer_spring,
    typical=1e-2,
    follows="angle",
)
