"""What gears and encoders do to a joint: waves, gain, coupling, play, and joints still moving."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from minimax_cal.core.arrays import Array
from minimax_cal.core.errors import OptionError
from minimax_cal.modelling.effects.scene import (
    DEFAULT_CHOICES,
    Choice,
    Effect,
    EffectColumns,
    PosedArm,
    bit_mask_to_numbers,
    find_driven_revolute_joints,
    joint_index_from_place,
    numbers_to_bit_mask,
    one_joint,
)

LAG_RANGE_CHOICES = (
    0.25,
    0.5,
    2.0,
)  # least, usual and largest move after which a lag grows no more [rad]
MIN_JOINT_SWEEP = 0.5  # a joint must turn so far to show a gain or a slow wave [rad]


def find_sweeping_joints(posed_arm: PosedArm) -> list[int]:
    """Turning joints that move far enough to show what depends on their angle."""
    return [
        j
        for j in find_driven_revolute_joints(posed_arm)
        if np.ptp(posed_arm.q[j]) > MIN_JOINT_SWEEP
    ]


def sweeping_joint_places(posed_arm: PosedArm) -> tuple[str, ...]:
    """Each such joint, and all together."""
    joints = find_sweeping_joints(posed_arm)
    each = tuple(f"J{j + 1}" for j in joints)
    return (*each, "all") if len(joints) > 1 else each


def joints_at_place(place: str, choice: Choice) -> list[int]:
    """The joints that a place means: `all` those that the choice names."""
    return (
        bit_mask_to_numbers(choice["joints"]) if place == "all" else [joint_index_from_place(place)]
    )


def choice_with_joints_of_all(
    place: str, joints: Sequence[int], choice: Choice = DEFAULT_CHOICES[0]
) -> Choice:
    """A choice that remembers which joints `all` meant, for data on which others would move."""
    return {**choice, "joints": numbers_to_bit_mask(joints)} if place == "all" else choice


def joint_angle_waves(posed_arm: PosedArm, joint: int, waves_per_turn: float) -> Array:
    """(2, m) cos and sin of so many waves a turn."""
    return np.stack(
        [np.cos(waves_per_turn * posed_arm.q[joint]), np.sin(waves_per_turn * posed_arm.q[joint])]
    )


def gear_wave_columns(posed_arm: PosedArm, place: str, choice: Choice) -> EffectColumns:
    """dq_j = a cos(k q_j) + b sin(k q_j), k = turns; or the sum of that for k = 1 ... orders."""
    each = [choice["turns"]] if "turns" in choice else range(1, int(choice["orders"]) + 1)
    joints = joints_at_place(place, choice)
    parts = [
        one_joint(posed_arm, j, joint_angle_waves(posed_arm, j, k)) for j in joints for k in each
    ]
    marks = [
        f"{j + 1 if len(joints) > 1 else ''}{f' {k}/turn' if len(each) > 1 else ''}"
        for j in joints
        for k in each
    ]
    names = tuple(f"{part}{mark}" for mark in marks for part in ("cos", "sin"))
    fixed = {"waves_per_turn": each[0]} if len(each) == 1 else {}
    return EffectColumns(names, ("rad",) * len(names), np.concatenate(parts), fixed=fixed)


def include_all_wave_orders(
    found_choices: Sequence[Choice], choices_of_all: Sequence[Choice]
) -> Sequence[Choice]:
    """All orders up to the highest found at a joint, and at least two, but those found of `all`.

    Where a joint turns half of its sweep, once a turn is nearly geometry.  A fit of twice a turn
    alone then makes geometry stand for the other, which poses beyond that half do not share.
    """
    if any("joints" in choice for choice in found_choices):
        return found_choices
    highest = int(max(2.0, *(v for choice in found_choices for v in choice.values())))
    had = {choice["turns"] for choice in choices_of_all}
    orders = [{"turns": float(k)} for k in range(1, highest + 1) if k not in had]
    whole: list[Choice] = [{"orders": float(highest)}] if len(orders) == highest else [*orders]
    return found_choices if list(found_choices) == whole else whole


GEAR_ERROR = Effect(
    "gear_error",
    "a gear or encoder disc that runs out of true, one to three times a turn",
    "dq_j = a cos(k q_j) + b sin(k q_j), k = 1, 2, 3",
    sweeping_joint_places,
    gear_wave_columns,
    choices=lambda scene, place: [
        *(
            choice_with_joints_of_all(place, find_sweeping_joints(scene), {"turns": turns})
            for turns in (1.0, 2.0, 3.0)
        ),
        *([] if place == "all" else [{"orders": 2.0}]),  # a joint may show none of them alone
    ],
    entire=include_all_wave_orders,
    lines=True,
    typical=5e-4,
    follows="angle",
)


def gear_ratio_choices(posed_arm: PosedArm, place: str) -> Sequence[Choice]:
    """The gear's ratio and twice that, where the robot file tells it."""
    if place == "all":
        return ()
    ratio = posed_arm.robot.ratio[joint_index_from_place(place)]
    return ({"turns": abs(ratio)}, {"turns": 2.0 * abs(ratio)}) if np.isfinite(ratio) else ()


def gear_ripple_columns(posed_arm: PosedArm, place: str, choice: Choice) -> EffectColumns:
    """`gear_wave_columns`, of as many a turn as a choice says."""
    if "turns" not in choice:
        raise OptionError(
            f"effect gear_ripple:{place}: the robot file gives no ratio; write "
            f"gear_ripple:{place}:turns=17"
        )
    return gear_wave_columns(posed_arm, place, choice)


GEAR_RIPPLE = Effect(
    "gear_ripple",
    "ripple of the gear's teeth or wave generator, many times a turn",
    "dq_j = a cos(k q_j) + b sin(k q_j), k = gear ratio, twice that, or found by a periodogram",
    lambda scene: tuple(f"J{j + 1}" for j in find_sweeping_joints(scene)),
    gear_ripple_columns,
    choices=gear_ratio_choices,
    lines=True,
    typical=5e-4,
    follows="wave",
)


def encoder_gain_columns(posed_arm: PosedArm, place: str, choice: Choice) -> EffectColumns:
    """dq_j = g q_j."""
    joints = joints_at_place(place, choice)
    turn = np.concatenate([one_joint(posed_arm, j, posed_arm.q[j][None]) for j in joints])
    return EffectColumns(tuple(f"g{j + 1}" for j in joints), ("1",) * len(joints), turn)


ENCODER_GAIN = Effect(
    "encoder_gain",
    "a wrong scale of the joint's encoder or gear ratio",
    "dq_j = g q_j",
    sweeping_joint_places,
    encoder_gain_columns,
    choices=lambda scene, place: [choice_with_joints_of_all(place, find_sweeping_joints(scene))],
    typical=1e-3,
    follows="angle",
    linear=True,
)


def joint_coupling_columns(posed_arm: PosedArm, place: str, choice: Choice) -> EffectColumns:
    """dq_j = c q_i, i = source: drive i moves joint j, an entry of the robot file's
    `joint_coupling_columns`.
    """
    j, i = joint_index_from_place(place), int(choice["source"]) - 1
    turn = np.zeros((1, posed_arm.joints, posed_arm.poses))
    turn[0, j] = posed_arm.q[i]
    return EffectColumns((f"c{j + 1}{i + 1}",), ("1",), turn, fixed={"source_joint": i + 1.0})


def coupling_source_choices(posed_arm: PosedArm, place: str) -> Sequence[Choice]:
    """The joints up to two before it that move far enough."""
    j = joint_index_from_place(place)
    return tuple({"source": i + 1.0} for i in find_sweeping_joints(posed_arm) if j - 2 <= i < j)


JOINT_COUPLING = Effect(
    "joint_coupling",
    "a joint's motor turns another joint too (wrist gears, linked arms)",
    "dq_j = c q_i",
    lambda scene: tuple(
        f"J{j + 1}"
        for j in np.flatnonzero(~scene.robot.prismatic)
        if j and coupling_source_choices(scene, f"J{j + 1}")
    ),
    joint_coupling_columns,
    choices=coupling_source_choices,
    typical=1e-2,
    follows="source",
    linear=True,
)


def find_joints_whose_column_varies(posed_arm: PosedArm, column_stem: str) -> list[int]:
    """Joints whose column of the history varies; those that slide have no play in radians."""
    among = (
        find_driven_revolute_joints(posed_arm)
        if column_stem == "approach"
        else range(posed_arm.joints)
    )
    return [j for j in among if posed_arm.column_varies(f"{column_stem}{j + 1}")]


def places_of_varying_column(posed_arm: PosedArm, column_stem: str) -> tuple[str, ...]:
    """Each of these joints, and all together."""
    joints = find_joints_whose_column_varies(posed_arm, column_stem)
    each = tuple(f"J{j + 1}" for j in joints)
    return (*each, "all") if len(joints) > 1 else each


def joint_history_columns(
    posed_arm: PosedArm, joints: Sequence[int], history: Array, parameter_letter: str, unit: str
) -> EffectColumns:
    """Each of some joints turns by a parameter of its own times its history (n, m)."""
    turn = np.concatenate([one_joint(posed_arm, j, history[j][None]) for j in joints])
    return EffectColumns(
        tuple(f"{parameter_letter}{j + 1}" for j in joints), (unit,) * len(joints), turn
    )


def backlash_columns(posed_arm: PosedArm, place: str, choice: Choice) -> EffectColumns:
    """dq_j = b/2 sign(last move of j)."""
    return joint_history_columns(
        posed_arm, joints_at_place(place, choice), 0.5 * posed_arm.each("approach"), "b", "rad"
    )


BACKLASH = Effect(
    "backlash",
    "play in the gear: the joint stops short on the side it came from",
    "dq_j = b/2 sign(last move of j)",
    lambda scene: places_of_varying_column(scene, "approach"),
    backlash_columns,
    needs=lambda scene: (
        ""
        if find_joints_whose_column_varies(scene, "approach")
        else (
            f"columns approach1 ... or the visit order, joints "
            f"moving both ways{scene.missing_order_clause}"
        )
    ),
    choices=lambda scene, place: [
        choice_with_joints_of_all(place, find_joints_whose_column_varies(scene, "approach"))
    ],
    typical=1e-3,
    follows="approach",
)


def settling_columns(posed_arm: PosedArm, place: str, choice: Choice) -> EffectColumns:
    """dq_j = e (q_n - q_(n-1)), or a course of it that ends where moves are long."""
    move, within = posed_arm.each("move"), choice.get("within", np.inf)
    course = within * np.tanh(move / within) if np.isfinite(within) else move
    columns = joint_history_columns(posed_arm, joints_at_place(place, choice), course, "e", "1")
    return replace(columns, fixed={"within": within} if np.isfinite(within) else {})


def settling_choices(posed_arm: PosedArm, place: str) -> Sequence[Choice]:
    """In proportion to the move, and with an end."""
    return [
        choice_with_joints_of_all(place, find_joints_whose_column_varies(posed_arm, "move"), choice)
        for choice in ({}, {"within": LAG_RANGE_CHOICES[1]})
    ]


def refine_lag_range(posed_arm: PosedArm, choice: Choice) -> Sequence[Choice]:
    """Ends near one that was chosen; shorter ones are play."""
    if "within" not in choice:
        return ()
    ends = [part * choice["within"] for part in (0.6, 0.8, 1.25, 1.6)]
    return [
        {**choice, "within": end}
        for end in ends
        if LAG_RANGE_CHOICES[0] <= end <= LAG_RANGE_CHOICES[2]
    ]


SETTLING = Effect(
    "settling",
    "the joint had not settled, or was read back before it had",
    "dq_j = e m, m = q_n - q_(n-1), or e s tanh(m / s)",
    lambda scene: places_of_varying_column(scene, "move"),
    settling_columns,
    finer=refine_lag_range,
    needs=lambda scene: (
        ""
        if find_joints_whose_column_varies(scene, "move")
        else "the visit order (column order)" + scene.missing_order_clause
    ),
    choices=settling_choices,
    typical=1e-2,
    follows="move",
)
