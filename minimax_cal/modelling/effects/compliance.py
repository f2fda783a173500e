"""Joints that give way under gravity, and the spring that carries the upper arm."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from minimax_cal.core.arrays import Array
from minimax_cal.modelling.effects.scene import (
    Choice,
    Effect,
    EffectColumns,
    PosedArm,
    bit_mask_to_numbers,
    find_driven_revolute_joints,
    joint_index_from_place,
    numbers_to_bit_mask,
    one_joint,
    principal_variations,
)
from minimax_cal.robots.gravity_torques import STANDARD_GRAVITY

MIN_TOOL_TORQUE_SHARE = (
    0.1  # share of its weight's largest torque by which a tool's must vary on a joint
)
MIN_TORQUE_VARIATION_SHARE = (
    1e-3  # share of the largest torque's variation below which a joint carries nothing
)
LINK_GROUPS = ("upper arm", "forearm", "wrist")  # two links each
MIN_SEPARABLE_TORQUE_SHARE = (
    0.2  # share of a neighbour's torque that must differ from a joint's own
)
ALL_LINKS_GROUP = 3  # stands for all links together
SOFT_RANGE_SHARES = (
    0.15,
    0.5,
)  # of its largest torque, to which a joint gives way more than beyond
MIN_SOFT_RANGE_SHARE, MAX_SOFT_RANGE_SHARE = (
    0.03,
    1.5,
)  # the same, least and most: play that a load takes up, no end seen
ASSUMED_TOOL_OFFSET = (
    0.1  # lever of the kilogram that stands for a tool beside the flange's axis [m]
)


def joint_torque_variations(posed_arm: PosedArm) -> Array:
    """(n,) how much each joint's torque varies between the poses [N m]."""
    return np.asarray(posed_arm.gravity.std(axis=1))


def find_loaded_joints(posed_arm: PosedArm) -> list[int]:
    """Joints on which gravity's torque varies."""
    size = joint_torque_variations(posed_arm)
    return [
        j
        for j in range(posed_arm.joints)
        if size[j] > MIN_TORQUE_VARIATION_SHARE * max(size.max(), 1e-9)
    ]


def compliance_places(posed_arm: PosedArm) -> tuple[str, ...]:
    """Loaded joints, and all of them together."""
    joints = find_loaded_joints(posed_arm)
    single = tuple(f"J{j + 1}" for j in joints)
    return (*single, "all") if len(joints) > 1 else single


def torque_part_choices(posed_arm: PosedArm, place: str) -> Sequence[Choice]:
    """Which torques are told apart: bit 4 j + g for group g at joint j, g = 3 for the whole.

    With known masses or measured torques there is one torque a joint.  Without, the torques of
    upper arm, forearm and wrist are taken apart, because their masses are free; one that another
    explains as well is left out.  Nobody tells the tool's weight then either, and it may hang
    beside the flange's axis: all joints together are tried with that too (`tool`:
    `tool_offset_bit_mask`). A single joint is also tried as one that stiffens (`soft_range`):
    under the wrist's torque, or under that of all links with masses that are `from_masses`.
    """
    joints = find_loaded_joints(posed_arm) if place == "all" else [joint_index_from_place(place)]
    if posed_arm.has_known_masses or posed_arm.has_measured_torques:
        plain = {"parts": numbers_to_bit_mask([4 * j + ALL_LINKS_GROUP for j in joints])}
        return (plain, *stiffening_joint_choices(posed_arm, place, (ALL_LINKS_GROUP,)))
    chosen = []
    for j in joints:
        kept = np.ones((1, posed_arm.poses))
        for group in range(j // 2, len(LINK_GROUPS)):
            torque = link_group_torque_at_joint(posed_arm, j, group)
            basis = np.linalg.qr(kept.T)[0]
            rest = torque - basis @ (basis.T @ torque)
            if np.linalg.norm(rest) > 0.02 * np.linalg.norm(torque - torque.mean()) + 1e-9:
                chosen.append(4 * j + group)
                kept = np.concatenate([kept, torque[None]])
    if not chosen:
        return ()
    parts = {"parts": numbers_to_bit_mask(chosen)}
    tool = tool_offset_bit_mask(posed_arm) if place == "all" else 0.0
    wider = ({**parts, "tool": tool},) if tool else ()
    last, own = len(LINK_GROUPS) - 1, 4 * joints[0]
    several = (
        sum(max_torque_of_part(posed_arm, own + group) > 0.0 for group in range(len(LINK_GROUPS)))
        > 1
    )
    whole = [
        {**choice, "assumed": 1.0}
        for choice in stiffening_joint_choices(posed_arm, place, (ALL_LINKS_GROUP,))
    ]
    return (
        parts,
        *wider,
        *stiffening_joint_choices(posed_arm, place, (last,)),
        *(whole if several else ()),
    )


def stiffening_joint_choices(
    posed_arm: PosedArm, place: str, link_groups: Sequence[int]
) -> Sequence[Choice]:
    """A single joint that gives way most to the first of the torque of some links."""
    if place == "all":
        return ()
    parts = [4 * joint_index_from_place(place) + group for group in link_groups]
    return [
        {"parts": numbers_to_bit_mask([part]), "within": share * most}
        for part in parts
        if (most := max_torque_of_part(posed_arm, part)) > 0.0
        for share in SOFT_RANGE_SHARES
    ]


def is_stiffening_choice(choice: Choice) -> bool:
    """Whether a joint gives way most to the first of its torque, which no single number tells."""
    return bool(np.isfinite(choice.get("within", np.inf)))


def max_torque_of_part(posed_arm: PosedArm, torque_part: int) -> float:
    """The largest torque of some links about a joint [N m].  torque_part: 4 j + g, as in
    `torque_part_choices`.
    """
    return float(np.abs(link_group_torque_at_joint(posed_arm, *divmod(torque_part, 4))).max())


def refine_soft_range(posed_arm: PosedArm, choice: Choice) -> Sequence[Choice]:
    """Torques near that one to which a joint was found to give way most."""
    if "within" not in choice:
        return ()
    most = max_torque_of_part(
        posed_arm, bit_mask_to_numbers(choice["parts"])[0]
    )  # measured ones have no `from_masses`
    ends = [part * choice["within"] for part in (0.6, 0.8, 1.25, 1.6)]
    return [
        {**choice, "within": end}
        for end in ends
        if MIN_SOFT_RANGE_SHARE <= end / most <= MAX_SOFT_RANGE_SHARE
    ]


def tool_offset_bit_mask(posed_arm: PosedArm) -> float:
    """Joints on which a tool beside the flange's axis weighs: bit 2 j for its x, 2 j + 1 for y."""
    felt = (
        tool_offset_torques(posed_arm).std(axis=2)
        > MIN_TOOL_TORQUE_SHARE * STANDARD_GRAVITY * ASSUMED_TOOL_OFFSET
    )
    return numbers_to_bit_mask(
        [
            2 * j + axis
            for j in find_driven_revolute_joints(posed_arm)
            for axis in (0, 1)
            if felt[axis, j]
        ]
    )


def tool_offset_torques(posed_arm: PosedArm) -> Array:
    """(2, n, m) torques of a kilogram beside the flange's axis, along x and y, less one's on it.

    [N m]
    """
    one, com = np.zeros(posed_arm.joints), np.zeros((3, posed_arm.joints, 3))
    one[-1], com[0, -1, 0], com[1, -1, 1] = 1.0, ASSUMED_TOOL_OFFSET, ASSUMED_TOOL_OFFSET
    along_x, along_y, amid = (posed_arm.drive_gravity_torques(one, place) for place in com)
    return np.stack([along_x - amid, along_y - amid])


def link_group_torque_at_joint(posed_arm: PosedArm, joint: int, link_group: int) -> Array:
    """(m,) gravity's torque of some of the links about a joint [N m]."""
    return np.asarray(link_group_torques(posed_arm, link_group)[joint])


def link_group_torques(posed_arm: PosedArm, link_group: int, *, from_masses: bool = False) -> Array:
    """(n, m) gravity's torques of some of the links about all joints [N m].

    from_masses: computed in any case, also where torques are measured.
    """
    if link_group == ALL_LINKS_GROUP:
        return (
            posed_arm.drive_gravity_torques(*posed_arm.link_masses_and_centres)
            + posed_arm.payload_torques
            if from_masses
            else posed_arm.gravity
        )
    mass, com = posed_arm.link_masses_and_centres
    groups = np.minimum(np.arange(posed_arm.joints) // 2, len(LINK_GROUPS) - 1)
    torque = posed_arm.drive_gravity_torques(np.where(groups == link_group, mass, 0.0), com)
    return np.asarray(torque + posed_arm.payload_torques * (link_group == len(LINK_GROUPS) - 1))


def build_compliance_uncertainty_function(
    joint: int, torque_joint: int, torque_slope: Array | float = 1.0
) -> Callable[[PosedArm], Array]:
    """How a joint's turn by the torque about one may differ with the masses: asked for rarely.

    torque_slope: (m,) of the turn by the torque.
    """

    def doubt(scene: PosedArm) -> Array:
        shapes = principal_variations(
            scene.gravity_changes_per_sigma[:, torque_joint] * torque_slope
        )
        return np.asarray(np.einsum("rm,kcm->rkcm", shapes, scene.jacobian[joint]))

    return doubt


def joint_compliance_columns(posed_arm: PosedArm, place: str, choice: Choice) -> EffectColumns:
    """dq_j = c_j tau_j; and c_j times the torque of a tool on either side of the flange's axis.

    Or dq_j = c_j t tanh(tau_j / t), t = within: a gear that is soft while its teeth take the load
    up, and stiff beyond.
    """
    turns, names, doubts = [], [], {}
    within, parts = choice.get("within", np.inf), bit_mask_to_numbers(choice["parts"])
    groups = {part % 4 for part in parts}
    torques = {
        group: link_group_torques(posed_arm, group, from_masses="assumed" in choice)
        for group in groups
    }
    for number, part in enumerate(parts):
        j, group = divmod(part, 4)
        torque, slope = soft_start_torque_and_slope(torques[group][j], within)
        turns.append(one_joint(posed_arm, j, torque[None]))
        whole = group == ALL_LINKS_GROUP
        names.append(f"c{j + 1}" + ("" if whole else f" ({LINK_GROUPS[group]})"))
        if whole:
            doubts[number] = build_compliance_uncertainty_function(j, j, slope)
    positive = len(names)
    levers = bit_mask_to_numbers(choice.get("tool", 0.0))
    tool = tool_offset_torques(posed_arm) if levers else np.zeros((2, 0, 0))
    for number in levers:
        j, axis = divmod(number, 2)
        turns.append(one_joint(posed_arm, j, tool[axis, j][None]))
        names.append(f"c{j + 1} (tool {'xy'[axis]})")
    return EffectColumns(
        tuple(names),
        ("rad/(N m)",) * len(names),
        np.concatenate(turns),
        doubt=doubts,
        either=np.arange(len(names)) >= positive,
        fixed={soft_range_parameter_name(posed_arm): within}
        if is_stiffening_choice(choice)
        else {},
    )


def soft_range_parameter_name(posed_arm: PosedArm) -> str:
    """What the torque is called to which a joint gives way most: N m that somebody told, or not."""
    told = posed_arm.has_known_masses or posed_arm.has_measured_torques
    return "within_Nm" if told else "within_assumed_Nm"


class SoftTorque(NamedTuple):
    """(m,) torques that a joint's turn is proportional to, and their slopes by the torques."""

    torque: Array
    slope: Array


def soft_start_torque_and_slope(torque: Array, soft_range: float) -> SoftTorque:
    """(m,) t tanh(tau / t) of torques (m,), t = within, and its slopes; infinite: the torques."""
    if not 0.0 < soft_range < np.inf:
        return SoftTorque(torque, np.ones_like(torque))
    course = np.tanh(torque / soft_range)
    return SoftTorque(soft_range * course, 1.0 - course**2)


JOINT_COMPLIANCE = Effect(
    "joint_compliance",
    "gearboxes wind up under gravity",
    "dq_j = c_j tau_j(q), or c_j t tanh(tau_j / t) of a joint that stiffens",
    compliance_places,
    joint_compliance_columns,
    choices=torque_part_choices,
    finer=refine_soft_range,
    positive=True,
    follows="load",
)


def neighbour_torque_choices(posed_arm: PosedArm, place: str) -> Sequence[Choice]:
    """The loaded joints next to one, whose torques its own does not follow."""
    j, heavy = joint_index_from_place(place), find_loaded_joints(posed_arm)
    own = np.stack([np.ones(posed_arm.poses), posed_arm.gravity[j]])
    basis = np.linalg.qr(own.T)[0]
    out = []
    for i in (j - 1, j + 1):
        if i in heavy:
            torque = posed_arm.gravity[i]
            rest = torque - basis @ (basis.T @ torque)
            if np.linalg.norm(rest) > MIN_SEPARABLE_TORQUE_SHARE * np.linalg.norm(
                torque - torque.mean()
            ):
                out.append({"source": i + 1.0})
    return tuple(out)


def cross_compliance_columns(posed_arm: PosedArm, place: str, choice: Choice) -> EffectColumns:
    """dq_j = c tau_i, i = source."""
    j, i = joint_index_from_place(place), int(choice["source"]) - 1
    turn = one_joint(posed_arm, j, posed_arm.gravity[i][None])
    doubt, fixed = {0: build_compliance_uncertainty_function(j, i)}, {"source_joint": i + 1.0}
    return EffectColumns((f"c{j + 1}{i + 1}",), ("rad/(N m)",), turn, doubt=doubt, fixed=fixed)


CROSS_COMPLIANCE = Effect(
    "cross_compliance",
    "a joint is compliant under the load of its neighbour",
    "dq_j = c tau_i(q), i next to j",
    lambda scene: (
        tuple(
            f"J{j + 1}"
            for j in find_driven_revolute_joints(scene)
            if neighbour_torque_choices(scene, f"J{j + 1}")
        )
        if scene.has_known_masses or scene.has_measured_torques
        else ()
    ),
    cross_compliance_columns,
    needs=lambda scene: (
        ""
        if scene.has_known_masses or scene.has_measured_torques
        else "mass_kg and com_mm in the robot file, or columns tau1_Nm ..."
    ),
    choices=neighbour_torque_choices,
    follows="load",
    typical=1e-6,
)


def link_tilt_angles(posed_arm: PosedArm, joint: int) -> Array:
    """(m,) angle of a joint's link from the vertical about the joint's axis [rad]."""
    links = posed_arm.links
    up = np.broadcast_to(posed_arm.robot.up[:, None], links.z[joint].shape)
    axis, along = links.z[joint], links.after[joint] - links.before[joint]
    side = np.cross(up, along, axis=0)
    return np.asarray(np.arctan2((side * axis).sum(axis=0), (up * along).sum(axis=0)))


def gravity_spring_columns(posed_arm: PosedArm, place: str, choice: Choice) -> EffectColumns:
    """dq_j = k sin(b) (1 - s0 / s), s^2 = a^2 + L^2 - 2 a L cos b.

    b: the lean of the joint's link less the spring's zero, where its eye is nearest to its anchor.
    The eye sits at `eye` and the free length is `rest`, both in units of the distance L from the
    joint to its anchor.
    """
    joint = joint_index_from_place(place)
    angle = link_tilt_angles(posed_arm, joint) - choice["zero"]
    a, rest = choice["eye"], choice["rest"]
    length = np.sqrt(1.0 + a * a - 2.0 * a * np.cos(angle))
    pull = np.sin(angle) * (1.0 - rest / length)
    return EffectColumns(
        ("k",), ("rad",), one_joint(posed_arm, joint, pull[None]), fixed=dict(choice)
    )


def combine_spring_choices(
    zeros: Sequence[float], eyes: Sequence[float], rests: Sequence[float]
) -> list[Choice]:
    """Every combination."""
    return [{"zero": z, "eye": e, "rest": r} for z in zeros for e in eyes for r in rests]


def refine_spring_choice(posed_arm: PosedArm, choice: Choice) -> Sequence[Choice]:
    """Springs near one that was chosen."""
    zeros = choice["zero"] + np.linspace(-0.2, 0.2, 5)
    eyes = choice["eye"] + np.linspace(-0.1, 0.1, 3)
    rests = choice["rest"] + np.linspace(-0.1, 0.1, 3)
    return combine_spring_choices(zeros.tolist(), eyes.tolist(), rests.tolist())


def gravity_spring_places(posed_arm: PosedArm) -> tuple[str, ...]:
    """The shoulder: the first joint that turns about a level axis, where it swings upright.

    Springs at other joints have no direction of their own: with any zero they imitate two orders of
    a gear.
    """
    level = np.abs((posed_arm.links.z * posed_arm.robot.up[:, None]).sum(axis=1)).max(axis=1) < 0.5
    joints = np.flatnonzero(level & ~posed_arm.robot.prismatic)
    swings = (
        len(joints) > 0 and np.ptp(link_tilt_angles(posed_arm, int(joints[0]))) > MIN_SPRING_SWING
    )
    return (f"J{joints[0] + 1}",) if swings else ()


# Where a spring is shortest: the arm upright, or hanging (its anchor on the other side).
SPRING_ZERO_ANGLES = (-0.25, 0.0, 0.25, np.pi)
MIN_SPRING_SWING = 0.1  # least range of the lean [rad]


GRAVITY_COMPENSATOR = Effect(
    "gravity_compensator",
    "the spring that balances the upper arm",
    "dq_j = k a L sin(q_j - phi) (1 - s_0/s)",
    gravity_spring_places,
    gravity_spring_columns,
    choices=lambda scene, place: combine_spring_choices(
        SPRING_ZERO_ANGLES, (0.4, 0.55), (0.45, 0.65)
    ),
    finer=refine_spring_choice,
    typical=1e-2,
    follows="angle",
)
