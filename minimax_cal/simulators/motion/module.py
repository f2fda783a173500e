"""The module of laws that no element holds: written beside the model, and used to judge it."""

from __future__ import annotations

import pprint
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import resources
from types import ModuleType
from typing import Any

from minimax_cal.dynamics.laws import Term
from minimax_cal.ground.arrays import Array
from minimax_cal.robots.mjcf import mujoco
from minimax_cal.simulators.chain import Chain
from minimax_cal.simulators.motion.numbers import Numbers

EMPTY = "NUMBERS: dict[str, dict[str, Any]] = {}"
ENDING = "_friction.py"
WAVES = {"gravity_spring": 2.0}  # times the angle
HELD = ("load_friction", "degressive", "stribeck", "angle_friction", "presliding", "asymmetry",
        "torque_ripple", "gravity_spring")  # fmt: skip


def module_text(chain: Chain, numbers: Numbers, unit: Array, ratio: Array) -> str:
    """The module.  unit: (n,) torque per unit of the log.  ratio: (n,) of the gears."""
    told: dict[str, Any] = {}
    for j, name in enumerate(chain.names):
        pairs = zip(numbers.laws, numbers.value, strict=True)
        laws = [law_of(term, value * unit[j] / numbers.gain[j], value / numbers.gain[j], numbers,
                       float(ratio[j])) for term, value in pairs if term.joint == j]  # fmt: skip
        told[name] = {
            "frictionloss": float(numbers.loss[j]),
            "damping": [float(v) for v in numbers.damping[j]],
            "laws": laws,
        }
    source = (resources.files("minimax_cal.simulators.motion") / "callback.py").read_text("utf-8")
    return source.replace(
        EMPTY,
        f"NUMBERS: dict[str, dict[str, Any]] = {pprint.pformat(told, width=96, sort_dicts=False)}",
    )


def law_of(
    term: Term, torque: Array, share: Array, numbers: Numbers, ratio: float
) -> tuple[str, dict[str, float]]:
    """A law with its numbers at the joint.  torque: (d,) [N m]; share: the same without a unit."""
    tuned, fastest = term.tuned, float(numbers.fastest[term.joint])
    amount = float(torque[0])
    match term.effect:
        case "load_friction":
            return term.effect, {"share": float(share[0])}
        case "degressive":
            return term.effect, {"amount": amount, "fastest": fastest, "power": tuned["power"]}
        case "stribeck":
            return term.effect, {"amount": amount, "fastest": fastest, "speed": tuned["speed"]}
        case "presliding":
            return term.effect, {"amount": amount, "length": tuned["length"]}
        case "asymmetry":
            return term.effect, {"amount": amount, "fastest": fastest}
        case "angle_friction":
            return term.effect, {"cos": amount, "sin": float(torque[1])}
    times = WAVES.get(term.effect, tuned.get("multiple", 1.0) * abs(ratio))
    return "waves", {"times": times, "cos": amount, "sin": float(torque[1])}


def loaded(text: str) -> ModuleType:
    """A module of a text."""
    made = ModuleType("friction")
    exec(compile(text, "friction", "exec"), vars(made))
    return made


@contextmanager
def installed(text: str, chain: Chain) -> Iterator[None]:
    """A model with its module, if the text is not empty; another callback comes back after it."""
    before = mujoco().get_mjcb_passive()
    try:
        if text:
            loaded(text).install(chain.model)
        yield
    finally:
        mujoco().set_mjcb_passive(before)
