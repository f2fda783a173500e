"""The module of laws that no element holds: written beside the model, and used to judge it."""

from __future__ import annotations

import pprint
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from importlib import resources
from types import ModuleType
from typing import Any

from minimax_cal.dynamics.laws import Law
from minimax_cal.ground.arrays import Array
from minimax_cal.robots.mjcf import mujoco
from minimax_cal.simulators.chain import Chain
from minimax_cal.simulators.motion.numbers import Numbers

NUMBERS = "NUMBERS: dict[str, dict[str, Any]] = {}"  # in callback.py, to be filled
LAWS = "LAWS: dict[str, tuple[bool, Any]] = {}"
ENDING = "_friction.py"


def module_text(chain: Chain, numbers: Numbers, unit: Array, ratio: Array) -> str:
    """The module.  unit: (n,) torque per unit of the log.  ratio: (n,) of the gears."""
    told: dict[str, Any] = {}
    laws = {term.effect: term.law for term in numbers.laws}
    for j, name in enumerate(chain.names):
        pairs = zip(numbers.laws, numbers.value, strict=True)
        mine = [(t.effect, amounts_of(t.law, value, float(unit[j]), float(numbers.gain[j])),
                 dict(t.tuned)) for t, value in pairs if t.joint == j]  # fmt: skip
        told[name] = {
            "frictionloss": float(numbers.loss[j]),
            "damping": [float(v) for v in numbers.damping[j]],
            "fastest": float(numbers.fastest[j]),
            "laws": mine,
        }
        if any("gear" in laws[law].reads for law, *_ in mine):
            told[name]["gear"] = abs(float(ratio[j]))
    source = (resources.files("minimax_cal.simulators.motion") / "callback.py").read_text("utf-8")
    filled = pprint.pformat(told, width=96, sort_dicts=False)
    source = source.replace(NUMBERS, f"{NUMBERS[:-2]}{filled}")
    return source.replace(LAWS, f"{LAWS[:-1]}\n{laws_text(laws)}}}" if laws else LAWS)


def amounts_of(law: Law, value: Array, unit: float, gain: float) -> list[float]:
    """A law's parameters at the joint [N m, or its share of torque]."""
    pairs = zip(value, law.units, strict=False)
    return [float(v * (unit if of.startswith("t") else 1.0) / gain) for v, of in pairs]


def laws_text(laws: Mapping[str, Law]) -> str:
    """Laws as entries of the module: whether friction, and torque per unit of each parameter."""
    out = ""
    for name, law in laws.items():
        known = ", ".join([*sorted(law.reads), *law.tuned, "**_"])
        out += f"    # {law.words}\n"
        out += f'    "{name}": ({law.dry}, lambda {known}: ({", ".join(law.torque)},)),\n'
    return out


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
