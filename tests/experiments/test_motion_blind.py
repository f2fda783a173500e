"""The blind study of torques: its arms are what they are said to be, its judge counts rightly."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from experiments.driven_arms import drawn_arm
from experiments.motion_blind import BEYOND, SINGLE, SOUND, Told, oracle, questions_table, run
from experiments.motion_cases import (
    CAUSES,
    LIBRARY,
    OWN,
    Case,
    by_integration,
    excitation,
    hysteresis,
    logged,
    make,
    some_arm,
    sound,
)
from experiments.motion_real import SIMULATED, Left
from experiments.motion_real import Told as RealTold
from experiments.motion_real import run as run_left
from minimax_cal.dynamics.laws import LAWS

# ---- motion blind --------------------------------------------------------------------------------


def test_two_generators_agree_where_friction_is_no_matter_of_taste():
    """MuJoCo's friction is soft about a reversal; rotor, body and the rest are the same."""
    pytest.importorskip("mujoco")
    from experiments.motion_cases import by_mujoco

    rng = np.random.default_rng(4)
    robot = some_arm(rng)
    plant = replace(sound(rng, robot), armature=np.full(robot.joints, 0.2))
    motion = excitation(rng, robot, 4.0, np.inf)
    (_, ours), (_, theirs) = by_integration(plant, motion), by_mujoco(plant, motion)
    off = np.abs(ours - theirs)
    assert_allclose(off[np.abs(motion.qd) > 0.2], 0.0, atol=2e-3)


@pytest.mark.parametrize("name", CAUSES)
def test_every_cause_adds_torque_to_a_sound_arm(name):
    made = make(Case(SINGLE, OWN, ((name, 1),), 7))
    size = np.sqrt(np.mean(np.concatenate(made.signal) ** 2, axis=0))
    noise = np.sqrt(np.mean(np.concatenate(made.noise) ** 2, axis=0))
    assert size.max() > 0.5 * noise[np.argmax(size)]
    if name in LIBRARY and name in LAWS and LAWS[name].torque:
        assert np.all(size[np.arange(len(size)) != 1] < 1e-6)


def test_a_sound_arm_has_nothing_to_be_seen():
    made = make(Case(SOUND, OWN, (), 7))
    again = make(Case(SOUND, OWN, (), 7))
    assert all(np.abs(part).max() < 1e-9 for part in made.signal)
    assert np.array_equal(made.runs[0].torque, again.runs[0].torque)
    assert not np.array_equal(made.runs[0].torque, make(Case(SOUND, OWN, (), 8)).runs[0].torque)


def test_a_flexible_joint_moves_its_link_otherwise_than_its_motor():
    rng = np.random.default_rng(1)
    robot = some_arm(rng)
    plant = replace(sound(rng, robot), compliance=np.full(robot.joints, 1e-3))
    motion = excitation(rng, robot, 2.0, np.inf)
    motor, _ = logged(plant, OWN, motion, 0.0)
    rigid, _ = by_integration(plant, motion)
    assert_allclose(motor.q - motion.q, 1e-3 * rigid, atol=1e-12)


def test_a_hysteretic_cable_remembers_where_it_turned():
    there = np.linspace(0.0, 1.0, 101)
    way = hysteresis(np.concatenate([there, there[::-1]]), 0.2)
    assert way[100] == pytest.approx(1.0)
    assert way[-1] == pytest.approx(-1.0)
    assert way[20] == pytest.approx(1.0)  # 0.2 rad from where it began


def test_the_oracle_tells_a_rotor_from_other_laws_and_sees_no_payload_in_a_torque():
    case = Case(SINGLE, OWN, (("armature", 2),), 11)
    made = make(case)
    visible, separable = oracle(made, (("armature", "J3"),))
    assert visible > separable > 0.0
    twice = replace(made, signal=tuple(2.0 * part for part in made.signal))
    assert_allclose(oracle(twice, (("armature", "J3"),)), (4.0 * visible, 4.0 * separable),
                    rtol=1e-6)  # fmt: skip


def told(condition: str, truth: str, verdict: str, *main: str, **more: object) -> Told:
    """An answer.  truth, main: as `armature J3`."""

    def pair(text: str) -> tuple[str, str]:
        effect, _, place = text.rpartition(" ")
        return effect, place

    causes = () if not truth else ((pair(truth)[0], 0),)
    given: dict[str, object] = {
        "minor": (),
        "others": (),
        "unexplained": (),
        "not_testable": (),
        "visible": 1e4,
        "separable": 1e4,
        "seconds": 1.0,
        "mass": (0.0, 0.0, 0.0),
    }
    given |= more
    return Told(Case(condition, OWN, causes, 0), verdict, (pair(truth),) if truth else (),
                tuple(map(pair, main)), **given)  # fmt: skip


def test_answers_are_judged_by_the_truth():
    right = told(SINGLE, "stribeck J2", "named", "stribeck J2")
    kin = told(SINGLE, "stribeck J2", "named", "degressive J2")
    wrong = told(SINGLE, "stribeck J2", "named", "stribeck J3")
    unsure = told(SINGLE, "stribeck J2", "unknown", "stribeck J3")
    hidden = told(SINGLE, "drive_gain J1", "none", not_testable=("drive_gain",))
    faint = told(SINGLE, "stribeck J2", "none", separable=3.0)
    other = told(SINGLE, "armature J2", "one_of", "drive_gain J2", others=(("armature", "J2"),))
    assert [one.right for one in (right, kin, wrong, unsure, other)] == [True, *[False] * 4]
    assert [one.related for one in (right, kin, wrong, hidden, other)] == [True, True, False, True,
                                                                          True]  # fmt: skip
    assert [one.wrong for one in (right, kin, wrong, unsure, other)] == [False, False, True, False,
                                                                        False]  # fmt: skip
    answers = [right, kin, wrong, unsure, hidden, faint, other,
               told(SOUND, "", "named", "cable J1"), told(SOUND, "", "named"),
               told(BEYOND, "hysteretic cable J1", "unknown"),
               told(BEYOND, "hysteretic cable J1", "named", "cable J1")]  # fmt: skip
    counts = {row[0]: row[1:3] for row in questions_table(answers).rows}
    assert counts["sound: a cause named or doubted"] == (2, 1)
    assert counts["single: right"] == (6, 1)
    assert counts["single: right, its family, or not distinguishable from it"] == (6, 4)
    assert counts["single: sure and wrong"] == (6, 1)
    assert counts["outside: unexplained said"] == (2, 1)
    assert counts["outside: sure and wrong"] == (2, 1)


def test_a_payload_that_nobody_told_is_named_with_its_mass():
    answer = run(Case(SINGLE, OWN, (("payload", 0),), 3))
    value, sigma, true = answer.mass
    assert answer.right
    assert value == pytest.approx(true, rel=0.03)
    assert abs(value - true) < 3.0 * sigma


# ---- motion real ---------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def left_out() -> RealTold:
    return run_left(Left(SIMULATED, 0, 0))


def test_withheld_effects_are_named_and_help_on_a_run_that_no_fit_saw(left_out):
    assert {"load_friction J2", "armature J3"} <= set(left_out.confirmed)
    before = left_out.reached[left_out.steps.index("usual friction refitted")]
    assert np.all(left_out.reached[-1, 1:] < 0.5 * before[1:])
    assert np.all(left_out.reached[-1] <= left_out.whole[-1])  # rows at rest only add


# ---- motion gap ----------------------------------------------------------------------------------


def test_an_arm_lacks_what_is_asked_for_and_repeats_by_its_seed():
    pytest.importorskip("mujoco", reason="needs mujoco: pip install minimax-cal[mujoco]")
    arm, again = (drawn_arm("scara_600", 2, ("friction", "payload")) for _ in range(2))
    assert arm.withheld.payload == again.withheld.payload > 0.0
    assert (arm.withheld.friction > 0.0).all()
    assert not arm.withheld.share.any()
    assert not arm.withheld.armature.any()
    real = arm.real()
    assert real.body_mass[-1] == pytest.approx(arm.known.body_mass[-1] + arm.withheld.payload)


# ---- servos --------------------------------------------------------------------------------------


def test_half_of_the_arms_have_elastic_joints_and_each_repeats_by_its_seed():
    pytest.importorskip("mujoco", reason="needs mujoco: pip install minimax-cal[mujoco]")
    from experiments.servos import drawn, drawn_cases

    cases = drawn_cases(20, 5)
    assert sum(case.elastic for case in cases) == 10
    assert len({case.arm for case in cases}) == 4
    one, again = (drawn("scara_600", 7, elastic=True) for _ in range(2))
    assert one.delay == again.delay
    assert one.real.njnt == 2 * one.arm.robot.joints
    assert ((one.gain >= 0.5) & (one.gain <= 2.0)).all()
    sound = drawn("scara_600", 7, elastic=False, sound=True)
    assert (sound.gain == 1.0).all()
    assert sound.delay == 0.0
    assert np.allclose(sound.real.actuator_gainprm[:, 0], sound.stiffness)
