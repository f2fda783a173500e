"""The blind study of torques: its arms are what they are said to be, its judge counts rightly."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from experiments.driven_arms import draw_driven_arm
from experiments.motion_blind import (
    OUTSIDE_CONDITION,
    SINGLE_CONDITION,
    SOUND_CONDITION,
    TorqueDiagnosisReport,
    build_questions_table,
    oracle_visibility,
    run_case,
)
from experiments.motion_cases import (
    ALL_MOTION_CAUSES,
    INTEGRATION_GENERATOR,
    LIBRARY_MOTION_CAUSES,
    MotionCase,
    build_sound_arm,
    draw_arm,
    draw_excitation,
    simulate_case,
    simulate_logged_torques,
    slider_spring_hysteresis,
    torques_by_integration,
)
from experiments.motion_real import SIMULATED_MOTION_ARM, LeftOutRun
from experiments.motion_real import LeftOutRunReport as RealTold
from experiments.motion_real import diagnose_without_run as run_left
from minimax_cal.dynamics.laws import TORQUE_LAWS

# ---- motion blind --------------------------------------------------------------------------------


def test_two_generators_agree_where_friction_is_no_matter_of_taste():
    """MuJoCo's friction is soft about a reversal; rotor, body and the rest are the same."""
    pytest.importorskip("mujoco")
    from experiments.motion_cases import torques_by_mujoco

    rng = np.random.default_rng(4)
    robot = draw_arm(rng)
    plant = replace(build_sound_arm(rng, robot), armature=np.full(robot.joints, 0.2))
    motion = draw_excitation(rng, robot, 4.0, np.inf)
    (_, ours), (_, theirs) = torques_by_integration(plant, motion), torques_by_mujoco(plant, motion)
    off = np.abs(ours - theirs)
    assert_allclose(off[np.abs(motion.qd) > 0.2], 0.0, atol=2e-3)


@pytest.mark.parametrize("name", ALL_MOTION_CAUSES)
def test_every_cause_adds_torque_to_a_sound_arm(name):
    made = simulate_case(MotionCase(SINGLE_CONDITION, INTEGRATION_GENERATOR, ((name, 1),), 7))
    size = np.sqrt(np.mean(np.concatenate(made.signal) ** 2, axis=0))
    noise = np.sqrt(np.mean(np.concatenate(made.noise) ** 2, axis=0))
    assert size.max() > 0.5 * noise[np.argmax(size)]
    if name in LIBRARY_MOTION_CAUSES and name in TORQUE_LAWS and TORQUE_LAWS[name].torque:
        assert np.all(size[np.arange(len(size)) != 1] < 1e-6)


def test_a_sound_arm_has_nothing_to_be_seen():
    made = simulate_case(MotionCase(SOUND_CONDITION, INTEGRATION_GENERATOR, (), 7))
    again = simulate_case(MotionCase(SOUND_CONDITION, INTEGRATION_GENERATOR, (), 7))
    assert all(np.abs(part).max() < 1e-9 for part in made.signal)
    assert np.array_equal(made.runs[0].torque, again.runs[0].torque)
    assert not np.array_equal(
        made.runs[0].torque,
        simulate_case(MotionCase(SOUND_CONDITION, INTEGRATION_GENERATOR, (), 8)).runs[0].torque,
    )


def test_a_flexible_joint_moves_its_link_otherwise_than_its_motor():
    rng = np.random.default_rng(1)
    robot = draw_arm(rng)
    plant = replace(build_sound_arm(rng, robot), compliance=np.full(robot.joints, 1e-3))
    motion = draw_excitation(rng, robot, 2.0, np.inf)
    motor, _ = simulate_logged_torques(plant, INTEGRATION_GENERATOR, motion, 0.0)
    rigid, _ = torques_by_integration(plant, motion)
    assert_allclose(motor.q - motion.q, 1e-3 * rigid, atol=1e-12)


def test_a_hysteretic_cable_remembers_where_it_turned():
    there = np.linspace(0.0, 1.0, 101)
    way = slider_spring_hysteresis(np.concatenate([there, there[::-1]]), 0.2)
    assert way[100] == pytest.approx(1.0)
    assert way[-1] == pytest.approx(-1.0)
    assert way[20] == pytest.approx(1.0)  # 0.2 rad from where it began


def test_the_oracle_tells_a_rotor_from_other_laws_and_sees_no_payload_in_a_torque():
    case = MotionCase(SINGLE_CONDITION, INTEGRATION_GENERATOR, (("armature", 2),), 11)
    made = simulate_case(case)
    visible, separable = oracle_visibility(made, (("armature", "J3"),))
    assert visible > separable > 0.0
    twice = replace(made, signal=tuple(2.0 * part for part in made.signal))
    assert_allclose(
        oracle_visibility(twice, (("armature", "J3"),)), (4.0 * visible, 4.0 * separable), rtol=1e-6
    )


def told(
    condition: str, truth: str, verdict: str, *main: str, **more: object
) -> TorqueDiagnosisReport:
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
    return TorqueDiagnosisReport(
        MotionCase(condition, INTEGRATION_GENERATOR, causes, 0),
        verdict,
        (pair(truth),) if truth else (),
        tuple(map(pair, main)),
        **given,
    )


def test_answers_are_judged_by_the_truth():
    right = told(SINGLE_CONDITION, "stribeck J2", "named", "stribeck J2")
    kin = told(SINGLE_CONDITION, "stribeck J2", "named", "degressive J2")
    wrong = told(SINGLE_CONDITION, "stribeck J2", "named", "stribeck J3")
    unsure = told(SINGLE_CONDITION, "stribeck J2", "unknown", "stribeck J3")
    hidden = told(SINGLE_CONDITION, "drive_gain J1", "none", not_testable=("drive_gain",))
    faint = told(SINGLE_CONDITION, "stribeck J2", "none", separable=3.0)
    other = told(
        SINGLE_CONDITION, "armature J2", "one_of", "drive_gain J2", others=(("armature", "J2"),)
    )
    assert [one.is_right for one in (right, kin, wrong, unsure, other)] == [True, *[False] * 4]
    assert [one.is_related_to_truth for one in (right, kin, wrong, hidden, other)] == [
        True,
        True,
        False,
        True,
        True,
    ]
    assert [one.is_wrong for one in (right, kin, wrong, unsure, other)] == [
        False, False, True, False, False
    ]  # fmt: skip
    answers = [right, kin, wrong, unsure, hidden, faint, other,
               told(SOUND_CONDITION, "", "named", "cable J1"), told(SOUND_CONDITION, "", "named"),
               told(OUTSIDE_CONDITION, "hysteretic cable J1", "unknown"),
               told(OUTSIDE_CONDITION, "hysteretic cable J1", "named", "cable J1")]  # fmt: skip
    counts = {row[0]: row[1:3] for row in build_questions_table(answers).rows}
    assert counts["sound: a cause named or doubted"] == (2, 1)
    assert counts["single: right"] == (6, 1)
    assert counts["single: right, its family, or not distinguishable from it"] == (6, 4)
    assert counts["single: sure and wrong"] == (6, 1)
    assert counts["outside: unexplained said"] == (2, 1)
    assert counts["outside: sure and wrong"] == (2, 1)


def test_a_payload_that_nobody_told_is_named_with_its_mass():
    answer = run_case(MotionCase(SINGLE_CONDITION, INTEGRATION_GENERATOR, (("payload", 0),), 3))
    value, sigma, true = answer.mass
    assert answer.is_right
    assert value == pytest.approx(true, rel=0.03)
    assert abs(value - true) < 3.0 * sigma


# ---- motion real ---------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def left_out() -> RealTold:
    return run_left(LeftOutRun(SIMULATED_MOTION_ARM, 0, 0))


def test_withheld_effects_are_named_and_help_on_a_run_that_no_fit_saw(left_out):
    assert {"load_friction J2", "armature J3"} <= set(left_out.confirmed)
    before = left_out.reached[left_out.steps.index("usual friction refitted")]
    assert np.all(left_out.reached[-1, 1:] < 0.5 * before[1:])
    assert np.all(left_out.reached[-1] <= left_out.whole[-1])  # rows at rest only add


# ---- motion gap ----------------------------------------------------------------------------------


def test_an_arm_lacks_what_is_asked_for_and_repeats_by_its_seed():
    pytest.importorskip("mujoco", reason="needs mujoco: pip install minimax-cal[mujoco]")
    arm, again = (draw_driven_arm("scara_600", 2, ("friction", "payload")) for _ in range(2))
    assert arm.withheld.payload == again.withheld.payload > 0.0
    assert (arm.withheld.friction > 0.0).all()
    assert not arm.withheld.share.any()
    assert not arm.withheld.armature.any()
    real = arm.compile_real_arm()
    assert real.body_mass[-1] == pytest.approx(
        arm.compiled_file_model.body_mass[-1] + arm.withheld.payload
    )


# ---- servos --------------------------------------------------------------------------------------


def test_half_of_the_arms_have_elastic_joints_and_each_repeats_by_its_seed():
    pytest.importorskip("mujoco", reason="needs mujoco: pip install minimax-cal[mujoco]")
    from experiments.servos import draw_servo_arm, list_cases

    cases = list_cases(20, 5)
    assert sum(case.elastic for case in cases) == 10
    assert len({case.arm for case in cases}) == 4
    one, again = (draw_servo_arm("scara_600", 7, with_elastic_joints=True) for _ in range(2))
    assert one.delay == again.delay
    assert one.compiled_real_arm.njnt == 2 * one.arm.robot.joints
    assert ((one.gain >= 0.5) & (one.gain <= 2.0)).all()
    sound = draw_servo_arm("scara_600", 7, with_elastic_joints=False, with_sound_servos=True)
    assert (sound.gain == 1.0).all()
    assert sound.delay == 0.0
    assert np.allclose(sound.compiled_real_arm.actuator_gainprm[:, 0], sound.stiffness)
