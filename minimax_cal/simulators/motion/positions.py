"""A model corrected by commands and positions alone: drives, friction and rotors by its masses."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from minimax_cal.dynamics import drives as fitted
from minimax_cal.dynamics.laws import ARMATURE, FRICTION
from minimax_cal.dynamics.result import MotionEffect
from minimax_cal.ground.errors import OptionError
from minimax_cal.simulators.motion import drives
from minimax_cal.simulators.motion.bodies import Bodies
from minimax_cal.simulators.motion.correct import Candidate
from minimax_cal.simulators.motion.fit import Study
from minimax_cal.simulators.motion.judge import OWN_SERVOS, Judge
from minimax_cal.simulators.motion.numbers import given_numbers
from minimax_cal.simulators.motion.opened import Opened
from minimax_cal.simulators.motion.result import MotionRung, WrittenElement
from minimax_cal.simulators.motion.written import write_numbers

HELD = {FRICTION: ("friction", fitted.FRICTION, "frictionloss"),
        ARMATURE: ("armature", fitted.INERTIA, "armature")}  # fmt: skip
SCALE = (
    "commands and positions without torques: gains, friction and rotors are those for the masses "
    "of the model; were all masses k times as large, so would these be, and no position would "
    "change; a torque, or a weighed arm, tells k; dampers of servo and joint stand as one"
)


@dataclass(frozen=True, eq=False)
class Answer:
    """A corrected model, and what is said of it.

    rungs: after the first.  fitted: numbers of its body and the logs that told them, None without
    torques.  module: text beside it.  lost: what other simulators leave out.
    """

    opened: Opened
    served: drives.Served | None
    rungs: tuple[MotionRung, ...]
    effects: tuple[MotionEffect, ...]
    elements: tuple[WrittenElement, ...]
    fitted: tuple[Candidate, Study] | None
    module: str
    left_out: tuple[str, ...]
    notices: tuple[str, ...]
    lost: tuple[str, ...]


def by_positions(judge: Judge, opened: Opened, *, plain: bool) -> Answer:
    """What lowers the joint error under the logged commands, each step of it.

    Raises OptionError without servos to correct.
    """
    if judge.drives != OWN_SERVOS or not drives.can_write(opened):
        raise OptionError(
            f"{judge.runs[0].source}: no column of torque or current: then every run needs "
            "commands of all joints (q1_cmd_rad, ...), and the model position servos"
        )
    served, names = drives.serve(judge, opened, plain=plain), tuple(HELD)
    served = drives.kept(served, judge, with_body(opened, served, names))
    for name in reversed(names):
        less = tuple(one for one in names if one != name)
        bare, whole = (drives.joint_error(judge, with_body(opened, served, some), served)
                       for some in (less, names))  # fmt: skip
        names = less if bare < whole + drives.WORTH else names
    effects = tuple(drives.effects_of(served, judge, with_body(opened, served, names)))
    steps = list(drives.steps_with(served, effects, opened))
    driven = drives.with_drives(opened, served)
    steps += [(f"+ {name}", with_body(driven, served, names[: number + 1]))
              for number, name in enumerate(names)]  # fmt: skip
    rungs = tuple(judge.rung(name, one.chain) for name, one in steps)
    elements = tuple(WrittenElement(name, "file", HELD[name][2], {}) for name in names)
    return Answer(with_body(driven, served, names), served, rungs, effects, elements, None, "", (),
                  (SCALE,), tuple(drives.lost_late(effects)))  # fmt: skip


def with_body(opened: Opened, served: drives.Served, names: Sequence[str]) -> Opened:
    """The model with friction and rotors that were fitted beside the drives."""
    document = opened.given.document.copy()
    new = given = given_numbers(opened.chain, Bodies.of(opened.chain))
    for name in names:
        field, beside, _ = HELD[name]
        values = [old if fit is None else max(fit.beside[beside], 0.0)
                  for fit, old in zip(served.fits, getattr(given, field), strict=True)]  # fmt: skip
        new = new.put(**{field: np.array(values)})
    write_numbers(document, opened.chain, given, new)
    return opened.again(document)
