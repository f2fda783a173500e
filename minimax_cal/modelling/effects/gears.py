"""What gears and encoders do to a joint: waves, gain, coupling, play, and joints still moving."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from minimax_cal.ground.arrays import Array
from minimax_cal.ground.errors import OptionError
from minimax_cal.modelling.effects.scene import (
    PLAIN,
    Choice,
    Columns,
    Effect,
    Scene,
    joint_of,
    mask_of,
    one_joint,
    turning,
    unmasked,
)

WITHIN = (0.25, 0.5, 2.0)  # least, usual and largest move after which a lag grows no more [rad]
LEAST_SWEEP = 0.5  # a joint must turn so far to show a gain or a slow wave [rad]


def sweeping(scene: Scene) -> list[int]:
    """Turning joints that move far enough to show what depends on their angle."""
    return [j for j in turning(scene) if np.ptp(scene.q[j]) > LEAST_SWEEP]


def swept_places(scene: Scene) -> tuple[str, ...]:
    """Each such joint, and all together."""
    joints = sweeping(scene)
    each = tuple(f"J{j + 1}" for j in joints)
    return (*each, "all") if len(joints) > 1 else each


def joints_at(place: str, choice: Choice) -> list[int]:
    """The joints that a place means: `all` those that the choice names."""
    return unmasked(choice["joints"]) if place == "all" else [joint_of(place)]


def at_all(place: str, joints: Sequence[int], choice: Choice = PLAIN[0]) -> Choice:
    """A choice that remembers which joints `all` meant, for data on which others would move."""
    return {**choice, "joints": mask_of(joints)} if place == "all" else choice


def wave(scene: Scene, joint: int, turns: float) -> Array:
    """(2, m) cos and sin of so many waves a turn."""
    return np.stack([np.cos(turns * scene.q[joint]), np.sin(turns * scene.q[joint])])


def waves(scene: Scene, place: str, choice: Choice) -> Columns:
    """dq_j = a cos(k q_j) + b sin(k q_j), k = turns; or the sum of that for k = 1 ... orders."""
    each = [choice["turns"]] if "turns" in choice else range(1, int(choice["orders"]) + 1)
    joints = joints_at(place, choice)
    parts = [one_joint(scene, j, wave(scene, j, k)) for j in joints for k in each]
    marks = [
        f"{j + 1 if len(joints) > 1 else ''}{f' {k}/turn' if len(each) > 1 else ''}"
        for j in joints
        for k in each
    ]
    names = tuple(f"{part}{mark}" for mark in marks for part in ("cos", "sin"))
    fixed = {"waves_per_turn": each[0]} if len(each) == 1 else {}
    return Columns(names, ("rad",) * len(names), np.concatenate(parts), fixed=fixed)


def every_order(found: Sequence[Choice], beside: Sequence[Choice]) -> Sequence[Choice]:
    """All orders up to the highest found at a joint, and at least two, but those found of `all`.

    Where a joint turns half of its sweep, once a turn is nearly geometry.  A fit of twice a turn
    alone then makes geometry stand for the other, which poses beyond that half do not share.
    """
    if any("joints" in choice for choice in found):
        return found
    highest = int(max(2.0, *(v for choice in found for v in choice.values())))
    had = {choice["turns"] for choice in beside}
    orders = [{"turns": float(k)} for k in range(1, highest + 1) if k not in had]
    whole: list[Choice] = [{"orders": float(highest)}] if len(orders) == highest else [*orders]
    return found if list(found) == whole else whole


GEAR_ERROR = Effect(
    "gear_error",
    "a gear or encoder disc that runs out of true, one to three times a turn",
    "dq_j = a cos(k q_j) + b sin(k q_j), k = 1, 2, 3",
    swept_places,
    waves,
    choices=lambda scene, place: [
        *(at_all(place, sweeping(scene), {"turns": turns}) for turns in (1.0, 2.0, 3.0)),
        *([] if place == "all" else [{"orders": 2.0}]),  # a joint may show none of them alone
    ],
    entire=every_order,
    lines=True,
    typical=5e-4,
    follows="angle",
)


def ratios(scene: Scene, place: str) -> Sequence[Choice]:
    """The gear's ratio and twice that, where the robot file tells it."""
    if place == "all":
        return ()
    ratio = scene.robot.ratio[joint_of(place)]
    return ({"turns": abs(ratio)}, {"turns": 2.0 * abs(ratio)}) if np.isfinite(ratio) else ()


def ripple(scene: Scene, place: str, choice: Choice) -> Columns:
    """`waves`, of as many a turn as a choice says."""
    if "turns" not in choice:
        raise OptionError(
            f"effect gear_ripple:{place}: the robot file gives no ratio; write "
            f"gear_ripple:{place}:turns=17"
        )
    return waves(scene, place, choice)


GEAR_RIPPLE = Effect(
    "gear_ripple",
    "ripple of the gear's teeth or wave generator, many times a turn",
    "dq_j = a cos(k q_j) + b sin(k q_j), k = gear ratio, twice that, or found by a periodogram",
    lambda scene: tuple(f"J{j + 1}" for j in sweeping(scene)),
    ripple,
    choices=ratios,
    lines=True,
    typical=5e-4,
    follows="wave",
)


def gain(scene: Scene, place: str, choice: Choice) -> Columns:
    """dq_j = g q_j."""
    joints = joints_at(place, choice)
    turn = np.concatenate([one_joint(scene, j, scene.q[j][None]) for j in joints])
    return Columns(tuple(f"g{j + 1}" for j in joints), ("1",) * len(joints), turn)


ENCODER_GAIN = Effect(
    "encoder_gain",
    "a wrong scale of the joint's encoder or gear ratio",
    "dq_j = g q_j",
    swept_places,
    gain,
    choices=lambda scene, place: [at_all(place, sweeping(scene))],
    typical=1e-3,
    follows="angle",
    linear=True,
)


def coupling(scene: Scene, place: str, choice: Choice) -> Columns:
    """dq_j = c q_i, i = source: drive i moves joint j, an entry of the robot file's `coupling`."""
    j, i = joint_of(place), int(choice["source"]) - 1
    turn = np.zeros((1, scene.joints, scene.poses))
    turn[0, j] = scene.q[i]
    return Columns((f"c{j + 1}{i + 1}",), ("1",), turn, fixed={"source_joint": i + 1.0})


def sources(scene: Scene, place: str) -> Sequence[Choice]:
    """The joints up to two before it that move far enough."""
    j = joint_of(place)
    return tuple({"source": i + 1.0} for i in sweeping(scene) if j - 2 <= i < j)


JOINT_COUPLING = Effect(
    "joint_coupling",
    "a joint's motor turns another joint too (wrist gears, linked arms)",
    "dq_j = c q_i",
    lambda scene: tuple(
        f"J{j + 1}"
        for j in np.flatnonzero(~scene.robot.prismatic)
        if j and sources(scene, f"J{j + 1}")
    ),
    coupling,
    choices=sources,
    typical=1e-2,
    follows="source",
    linear=True,
)


def moved(scene: Scene, stem: str) -> list[int]:
    """Joints whose column of the history varies; those that slide have no play in radians."""
    among = turning(scene) if stem == "approach" else range(scene.joints)
    return [j for j in among if scene.has(f"{stem}{j + 1}")]


def moved_places(scene: Scene, stem: str) -> tuple[str, ...]:
    """Each of these joints, and all together."""
    joints = moved(scene, stem)
    each = tuple(f"J{j + 1}" for j in joints)
    return (*each, "all") if len(joints) > 1 else each


def turns_by(
    scene: Scene, joints: Sequence[int], history: Array, letter: str, unit: str
) -> Columns:
    """Each of some joints turns by a parameter of its own times its history (n, m)."""
    turn = np.concatenate([one_joint(scene, j, history[j][None]) for j in joints])
    return Columns(tuple(f"{letter}{j + 1}" for j in joints), (unit,) * len(joints), turn)


def play(scene: Scene, place: str, choice: Choice) -> Columns:
    """dq_j = b/2 sign(last move of j)."""
    return turns_by(scene, joints_at(place, choice), 0.5 * scene.each("approach"), "b", "rad")


BACKLASH = Effect(
    "backlash",
    "play in the gear: the joint stops short on the side it came from",
    "dq_j = b/2 sign(last move of j)",
    lambda scene: moved_places(scene, "approach"),
    play,
    needs=lambda scene: (
        "" if moved(scene, "approach")
        else f"columns approach1 ... or the visit order, joints moving both ways{scene.untold}"
    ),
    choices=lambda scene, place: [at_all(place, moved(scene, "approach"))],
    typical=1e-3,
    follows="approach",
)  # fmt: skip


def unsettled(scene: Scene, place: str, choice: Choice) -> Columns:
    """dq_j = e (q_n - q_(n-1)), or a course of it that ends where moves are long."""
    move, within = scene.each("move"), choice.get("within", np.inf)
    course = within * np.tanh(move / within) if np.isfinite(within) else move
    columns = turns_by(scene, joints_at(place, choice), course, "e", "1")
    return replace(columns, fixed={"within": within} if np.isfinite(within) else {})


def settlings(scene: Scene, place: str) -> Sequence[Choice]:
    """In proportion to the move, and with an end."""
    return [at_all(place, moved(scene, "move"), choice) for choice in ({}, {"within": WITHIN[1]})]


def other_ends(scene: Scene, choice: Choice) -> Sequence[Choice]:
    """Ends near one that was chosen; shorter ones are play."""
    if "within" not in choice:
        return ()
    ends = [part * choice["within"] for part in (0.6, 0.8, 1.25, 1.6)]
    return [{**choice, "within": end} for end in ends if WITHIN[0] <= end <= WITHIN[2]]


SETTLING = Effect(
    "settling",
    "the joint had not settled, or was read back before it had",
    "dq_j = e m, m = q_n - q_(n-1), or e s tanh(m / s)",
    lambda scene: moved_places(scene, "move"),
    unsettled,
    finer=other_ends,
    needs=lambda scene: (
        "" if moved(scene, "move") else "the visit order (column order)" + scene.untold
    ),
    choices=settlings,
    typical=1e-2,
    follows="move",
)
