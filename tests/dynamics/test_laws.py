"""A law of torque states itself once: rows, curve, module and documentation agree."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from dynamics.motions import simulated, three_joints
from numpy.testing import assert_allclose

import minimax_cal as mc
from minimax_cal.core.errors import OptionError
from minimax_cal.core.tables import Table
from minimax_cal.dynamics.laws import LAW_QUANTITIES, TORQUE_EFFECT_WORDS, TORQUE_LAWS, Law, Tuned
from minimax_cal.dynamics.torque_rows import (
    ArmMotion,
    TorqueArm,
    compute_soft_speed_sign,
    resample_and_filter_runs,
)

DOCS = Path(__file__).parents[2] / "docs" / "torques.md"
WAVE = Law(
    "third_wave", "a third wave of the angle", ("np.cos(times * q)", "np.sin(times * q)"),
    ("cos", "sin"), ("t", "t"), tuned={"times": Tuned((3.0,))},
)  # fmt: skip


@pytest.fixture
def scene() -> ArmMotion:
    logs, robot = resample_and_filter_runs(simulated(seed=1, runs=2)), three_joints()
    arm = TorqueArm.build(robot, np.ones(3), np.full(3, 50.0), np.zeros(10), logs)
    return ArmMotion.build(arm, logs)


@pytest.fixture
def registered() -> Iterator[Law]:
    yield mc.register_law(WAVE)
    del TORQUE_LAWS[WAVE.name], TORQUE_EFFECT_WORDS[WAVE.name]


def test_a_curve_over_speed_is_the_law_along_it(scene: ArmMotion) -> None:
    v, seen = LAW_QUANTITIES["v"](scene, 0), []
    sense = compute_soft_speed_sign(scene.logs.motion.qd[:, 0], scene.arm.soft[0])
    for name, law in TORQUE_LAWS.items():
        for form in law.compute_friction_curves(v, sense, law.list_initial_tunings(scene, 0)[0]):
            assert_allclose(
                form,
                law.build_columns(scene, 0, law.list_initial_tunings(scene, 0)[0])[:, 0],
                rtol=1e-15,
            )
            seen.append(name)
    assert seen == ["degressive", "stribeck", "asymmetry"]


def test_a_registered_law_is_found_with_its_size(registered: Law) -> None:
    """Three waves a turn at joint 2: 2.5 N m of cosine, -1.5 of sine."""
    runs = simulated(
        lambda m, rigid, t: np.stack([0.0 * t, 2.5 * np.cos(3.0 * m.q[:, 1])
                                      - 1.5 * np.sin(3.0 * m.q[:, 1]), 0.0 * t], axis=1), seed=3,
    )  # fmt: skip
    found = mc.diagnose_motion(three_joints(), runs)
    (one,) = [e for e in found.effects if e.effect == registered.name]
    assert one.place == "J2"
    assert_allclose([p.value for p in one.parameters], [2.5, -1.5, 3.0], atol=0.1)
    assert one.words.startswith(registered.words)


def test_wrong_facts_are_refused() -> None:
    with pytest.raises(OptionError, match="a name and a unit"):
        mc.register_law(Law("two", "two", ("q", "v")))
    with pytest.raises(mc.OptionError, match="law 'stribeck': is built in"):
        mc.register_law(Law("stribeck", "mine", ("q",)))


def test_the_documentation_has_every_law() -> None:
    rows = [(law.name, law.words, ", ".join(law.torque).replace("np.", "") or None,
             ", ".join(law.held) or None) for law in TORQUE_LAWS.values()]  # fmt: skip
    table = Table.from_rows("Laws", rows, "name | law | torque per unit | held by").markdown()
    assert table[table.index("|") :].strip() in DOCS.read_text(encoding="utf-8")
