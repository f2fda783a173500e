"""The generator of the blind study, against expectations of its own, and the study's scoring."""

import dataclasses
import json

import numpy as np
import pytest
from numpy.testing import assert_allclose

import minimax_cal as mc
from experiments import blind_gap, gap_cases, machines
from experiments.gap_cases import (
    DATA_FAULT_AMPLITUDES,
    GAP_ARMS,
    GAP_LAWS,
    GapCase,
    GapCause,
    GapTruth,
    MeasuredArm,
)
from experiments.machines import MACHINE_LAWS as SHOP_LAWS
from experiments.machines import MACHINE_MAKES, MachineCase
from minimax_cal.core.arrays import Array
from minimax_cal.core.files import convert_to_plain_json

# ---- gap cases -----------------------------------------------------------------------------------


ROBOTS = tuple(GAP_ARMS)


def world(robot: str = "irb2600", **options: float) -> MeasuredArm:
    return gap_cases.draw_measured_arm(GapCase(robot, "test", **options), np.random.default_rng(4))


def moved(place: MeasuredArm, cause: GapCause, amplitude: float, seed: int = 0) -> Array:
    """(m, k, 3) displacement of the points [m]."""
    still = gap_cases.measured_points_without_noise(place, gap_cases.zero_deviation(place))
    unit = GAP_LAWS[cause.law](place, cause, np.random.default_rng(seed))
    return gap_cases.measured_points_without_noise(place, unit * amplitude) - still


def seen(place: MeasuredArm, robot: mc.Robot, q: Array, spots: Array) -> Array:
    """Points by the package's forward kinematics: (m, k, 3) [m]."""
    pose = place.base @ robot.pose(q)
    return np.einsum("mij,kj->mki", pose[:, :3, :3], spots) + pose[:, None, :3, 3]


@pytest.mark.parametrize("robot", ROBOTS)
@pytest.mark.parametrize("law", GAP_LAWS)
def test_lambda_is_what_was_asked_for(law, robot):
    for place in gap_cases.list_law_places_on_robot(law, robot)[-1:]:
        power = 1.0 if law in DATA_FAULT_AMPLITUDES else 70.0
        sealed = gap_cases.build_and_measure_arm(
            GapCase(robot, "test", (GapCause(law, place, power, 1),), poses=60)
        )
        assert sealed.truth == ((law.partition("/")[0], place),)
        if law not in DATA_FAULT_AMPLITUDES:
            assert_allclose(sealed.powers, [70.0], rtol=1e-6)
        assert_allclose(sealed.parts[0], sealed.displacement, rtol=0, atol=1e-12)
        assert sealed.displacement.shape == (sealed.data.poses, 3, 3)


@pytest.mark.parametrize("robot", ROBOTS)
def test_forward_kinematics_is_the_packages(robot):
    place = world(robot)
    expected = seen(place, place.robot, place.q + place.jitter, place.spots)
    assert_allclose(
        gap_cases.measured_points_without_noise(place, gap_cases.zero_deviation(place)),
        expected,
        rtol=0,
        atol=1e-13,
    )


@pytest.mark.parametrize("robot", ROBOTS)
def test_torque_is_the_slope_of_potential_energy(robot):
    place = world(robot)
    q = place.q[:20]

    def energy(q: Array) -> Array:
        height = (
            gap_cases.link_centres_of_gravity(place.robot, gap_cases.link_frames(place.robot, q))
            @ place.robot.up
        )
        return np.asarray(gap_cases.STANDARD_GRAVITY * height @ place.robot.mass)

    for joint, step in enumerate(1e-30j * np.eye(6)):
        slope = energy(q + step).imag / 1e-30
        torque = gap_cases.gravity_torques(place.robot, q)[:, joint]
        assert_allclose(torque, -slope, rtol=0, atol=1e-10)


@pytest.mark.parametrize("robot", ROBOTS)
def test_jacobians_are_the_derivatives_of_the_points(robot):
    place = dataclasses.replace(world(robot, jitter=0.0), base=np.eye(4))
    geometry, joints = gap_cases.geometry_and_joint_jacobians(place)
    assert geometry.shape[-1] == 5 * 6 + 6 + 9
    step = 1e-6
    order = (2, 1, 0, 3, 4)  # theta, d, a, alpha, beta
    for part, column in enumerate(order):
        for joint in (0, 2, 5):
            ends = []
            for sign in (1.0, -1.0):
                mdh = place.robot.mdh.copy()
                mdh[joint, column] += sign * step
                ends.append(seen(place, place.robot.with_mdh(mdh), place.q, place.spots))
            slope = (ends[0] - ends[1]) / (2 * step)
            assert_allclose(geometry[..., 6 * part + joint], slope, rtol=0, atol=1e-8)
    for joint in range(6):
        ends = [
            seen(place, place.robot, place.q + s * np.eye(6)[joint], place.spots)
            for s in (step, -step)
        ]
        assert_allclose(joints[..., joint], (ends[0] - ends[1]) / (2 * step), rtol=0, atol=1e-8)


def test_geometry_alone_has_no_power():
    place = world()
    geometry, _ = gap_cases.geometry_and_joint_jacobians(place)
    ruler = gap_cases.build_detectability_measure(place, np.full(geometry.shape[:2], 1e-5), 6e-6)
    for column in (3, 20, 31, 40):
        motion = 1e-3 * geometry[..., column] @ place.base[:3, :3].T
        assert ruler.detectability(motion) < 1e-10
        assert np.linalg.norm(motion) > 1e-3


def test_target_laws_move_what_they_say():
    place = world(jitter=0.0)
    still = gap_cases.measured_points_without_noise(place, gap_cases.zero_deviation(place))
    offset = moved(place, GapCause("target_offset", "smr2", 1.0), 1e-4)
    assert np.all(offset[:, [0, 2]] == 0.0)
    along = np.sum(offset[:, 1] * still[:, 1], axis=1) / np.linalg.norm(still[:, 1], axis=1)
    assert_allclose(along, 1e-4, rtol=1e-9)
    size = np.linalg.norm(moved(place, GapCause("target_shift", "smr3", 1.0), 3e-4), axis=-1)
    assert np.all(size[:, :2] == 0.0)
    after = size[:, 2] > 0.0
    assert 0.3 <= after.mean() <= 0.7
    assert np.all(np.diff(after.astype(int)) >= 0)
    assert_allclose(size[after, 2], 3e-4, rtol=1e-9)


def test_a_beam_under_a_weight_at_its_end_sags_as_the_textbook_says():
    """One heavy point at the end of a level beam: slope F L^2 / 2EI, sag F L^3 / 3EI."""
    place = world()
    mdh = np.zeros((6, 5))
    mdh[1] = [1.3, 0.0, 0.0, 0.0, 0.0]
    mass = np.array([0.0, 0.0, 20.0, 0.0, 0.0, 0.0])
    bare = dataclasses.replace(place.robot, mdh=mdh, mass=mass, com=np.zeros((6, 3)))
    level = dataclasses.replace(place, robot=bare, q=np.zeros_like(place.q))
    unit = GAP_LAWS["link_bending"](
        level, GapCause("link_bending", "L2", 1.0), np.random.default_rng(0)
    )
    weight = 20.0 * gap_cases.STANDARD_GRAVITY
    assert_allclose(unit.links[:, 1, 5], -weight * 1.3**3 / 3.0, rtol=1e-12)
    assert_allclose(unit.links[:, 1, 1], weight * 1.3**2 / 2.0, rtol=1e-12)
    assert_allclose(unit.links[:, 1, [0, 2, 3, 4]], 0.0, atol=1e-9)


@pytest.mark.parametrize("robot", ROBOTS)
def test_the_session_is_as_described(robot):
    sealed = gap_cases.build_and_measure_arm(
        GapCase(robot, "test", (GapCause("backlash", "J1", 50.0),), poses=60)
    )
    data = sealed.data
    train = data.columns["split"] == "train"
    assert train.sum() == 60 + gap_cases.REVISITED_POSES
    assert (~train).sum() == gap_cases.HELD_OUT_POSES
    assert_allclose(data.columns["order"], np.arange(data.poses))
    assert np.all(np.diff(data.columns["time"]) > 15.0)
    labels, counts = np.unique(data.columns["pose"], return_counts=True)
    assert sorted(counts)[-gap_cases.REVISITED_POSES :] == [2] * gap_cases.REVISITED_POSES
    assert len(labels) == 60 + gap_cases.HELD_OUT_POSES
    for label in labels[counts == 2]:
        assert np.ptp(data.q[data.columns["pose"] == label], axis=0).max() == 0.0
        assert train[data.columns["pose"] == label].all()
    assert np.all((data.q >= sealed.robot.lower) & (data.q <= sealed.robot.upper))
    away = np.linalg.norm(data.y, axis=-1)
    assert 0.3 < away.min() < away.max() < 7.0


def test_the_robot_told_is_not_the_true_one():
    sealed = gap_cases.build_and_measure_arm(GapCase("irb2600", "test"))
    told, true = sealed.robot, sealed.true
    assert_allclose(told.mdh, mc.load_robot("irb2600").mdh)
    assert np.all(np.abs(true.mdh - told.mdh) > 0.0)
    assert np.all(np.abs(true.mass / told.mass - 1.0) < 0.4)
    assert np.std(true.mass / told.mass) > 0.03
    off = np.linalg.norm(true.com - told.com, axis=1) / np.linalg.norm(told.com, axis=1)
    assert_allclose(off, gap_cases.RELATIVE_MASS_ERROR, rtol=1e-9)


def test_noise_and_floor():
    """Without effect, the true robot leaves the noise and jitter that the floor says."""
    sums = []
    for seed in range(5):
        case = GapCase("irb2600", "none", seed=seed)
        sealed = gap_cases.build_and_measure_arm(case)
        place = gap_cases.draw_measured_arm(case, np.random.default_rng(seed))
        left = sealed.data.y - seen(place, place.robot, place.q, place.spots)
        held = sealed.data.columns["split"] == "holdout"
        sums.append(np.sum(left[held] ** 2, axis=-1).mean() / sealed.floor**2)
    assert_allclose(np.mean(sums), 1.0, atol=0.1)


def test_files_read_back_and_tell_no_secret(tmp_path):
    causes = (GapCause("joint_compliance", "J2", 100.0), GapCause("gear_error", "J3", 60.0, 1))
    sealed = gap_cases.build_and_measure_arm(
        GapCase("irb2600", "pair", causes, background=10.0, seed=9)
    )
    gap_cases.write_diagnosis_files(sealed, tmp_path)
    assert {path.name for path in tmp_path.iterdir()} == {"robot.json", "data.csv"}
    data = mc.read_measurements(tmp_path / gap_cases.DATA_FILE_NAME)
    robot = mc.load_robot(tmp_path / gap_cases.ROBOT_FILE_NAME)
    assert not data.notices
    assert_allclose(data.y, sealed.data.y, rtol=0, atol=1e-9)
    assert_allclose(data.q, sealed.data.q, rtol=0, atol=1e-9)
    assert_allclose(robot.mass, sealed.robot.mass)
    assert_allclose(robot.ratio, sealed.robot.ratio)
    assert sealed.truth == (("joint_compliance", "J2"), ("gear_error", "J3"))
    assert len(sealed.background) == 6
    assert_allclose(sealed.powers, [100.0, 60.0], rtol=1e-6)


def test_the_same_case_is_the_same_file():
    case = GapCase("ur10e", "single", (GapCause("tool_flex", "all", 50.0),), seed=3)
    first, second = gap_cases.build_and_measure_arm(case), gap_cases.build_and_measure_arm(case)
    assert np.array_equal(first.data.y, second.data.y)
    other = gap_cases.build_and_measure_arm(dataclasses.replace(case, seed=4))
    assert not np.array_equal(first.data.q, other.data.q)


# ---- scoring ---------------------------------------------------------------------------------


def truth_of(*names: tuple[str, str], power: float = 100.0, **more: object) -> GapTruth:
    none = np.zeros((len(names), 1, 3, 3))
    fields: dict[str, object] = dict(
        truth=names, background=(), displacement=none.sum(0), parts=none,
        powers=(power,) * len(names), power=power, amplitudes=(), floor=4e-5,
    )  # fmt: skip
    return GapTruth(**(fields | more))


def answer(verdict: str, *names: tuple[str, str], also: tuple[tuple[str, str], ...] = ()) -> dict:
    effects = [
        {
            "effect": effect,
            "place": place,
            "alternatives": [{"effect": e, "place": p, "rho2": 0.9} for e, p in also],
        }
        for effect, place in names
    ]
    gap = {"holdout_rms_mm": {"geometric": 0.06, "final": 0.041}, "noise_floor_mm": 0.04}
    return {"verdict": verdict, "effects": effects, "gap": gap}


J2, J3, ALL = ("gear_error", "J2"), ("gear_error", "J3"), ("gear_error", "all")
GAIN = ("encoder_gain", "J2")


@pytest.mark.parametrize(
    ("said", "truth", "expected"),
    [
        (J2, J2, "exact"),
        (J3, J2, "place"),
        (ALL, J2, "broad"),
        (J2, ALL, "broad"),
        (GAIN, J2, "wrong"),
        (("outliers", "smr1"), ("outliers", "all"), "exact"),
    ],
)
def test_match(said, truth, expected):
    row = blind_gap.score_answer(GapCase("irb2600", "one"), truth_of(truth), answer("named", said))
    assert row["match"] == expected


def test_score_of_single_answers():
    case = GapCase("irb2600", "single", (GapCause("gear_error", "J2", 100.0),))
    row = blind_gap.score_answer(case, truth_of(J2), answer("named", J2))
    assert (row["match"], row["in_set"], row["set_size"], row["sure"]) == ("exact", True, 1, True)
    assert row["all_right"]
    assert row["final_mm"] == 0.041
    row = blind_gap.score_answer(case, truth_of(J2), answer("one_of", GAIN, also=(J2, J3)))
    assert (row["match"], row["in_set"], row["set_size"], row["sure"]) == ("wrong", True, 3, False)
    assert (row["all_right"], row["all_in_sets"], row["strange"]) == (False, True, 1)
    row = blind_gap.score_answer(case, truth_of(J2), answer("unknown"))
    assert (row["match"], row["in_set"], row["set_size"]) == ("", False, 0)
    json.dumps(convert_to_plain_json(row), allow_nan=False)


def test_score_of_several_effects():
    causes = (GapCause("gear_error", "J2", 100.0), GapCause("encoder_gain", "J2", 100.0))
    case = GapCase("irb2600", "pair", causes)
    truth = truth_of(J2, GAIN)
    assert blind_gap.score_answer(case, truth, answer("named", GAIN, J2))["all_right"]
    assert not blind_gap.score_answer(case, truth, answer("named", J2, J3))["all_right"]
    assert not blind_gap.score_answer(case, truth, answer("named", J2))["all_right"]
    assert not blind_gap.score_answer(case, truth, answer("named", J2, GAIN, J3))["all_right"]
    # one answer cannot stand for two truths
    assert not blind_gap.score_answer(case, truth, answer("one_of", J2, also=(GAIN,)))[
        "all_in_sets"
    ]
    assert blind_gap.score_answer(case, truth, answer("one_of", J2, J3, also=(GAIN,)))[
        "all_in_sets"
    ]
    small = truth_of(J2, background=(GAIN,))
    assert blind_gap.score_answer(case, small, answer("named", J2, GAIN, J3))["strange"] == 1


def test_laws_of_joints_are_differences_of_forward_kinematics():
    place = world(jitter=0.0)
    last = np.concatenate([place.q[:1], place.q[:-1]])
    for cause, joint, dq in (
        (GapCause("encoder_gain", "J3", 1.0), 2, place.q[:, 2]),
        (GapCause("joint_coupling", "J5", 1.0), 4, place.q[:, 3]),
        (GapCause("joint_coupling", "J6", 1.0), 5, place.q[:, 4]),
        (GapCause("backlash", "J2", 1.0), 1, np.sign(place.q[:, 1] - last[:, 1])),
        (GapCause("settling", "J4", 1.0), 3, last[:, 3] - place.q[:, 3]),
    ):
        q = place.q.copy()
        q[:, joint] += 2e-4 * dq
        expected = seen(place, place.robot, q, place.spots)
        expected -= seen(place, place.robot, place.q, place.spots)
        assert_allclose(moved(place, cause, 2e-4), expected, rtol=0, atol=1e-13)


# ---- machines ------------------------------------------------------------------------------------


@pytest.mark.parametrize("robot", MACHINE_MAKES)
def test_an_arm_moves_as_the_package_says_slides_too(robot):
    place = machines.draw_measured_arm(
        MachineCase(robot, "test", poses=40), np.random.default_rng(4)
    )
    pose = place.base @ place.robot.pose(place.q + place.jitter)
    expected = np.einsum("mij,kj->mki", pose[:, :3, :3], place.spots) + pose[:, None, :3, 3]
    assert_allclose(
        gap_cases.measured_points_without_noise(place, gap_cases.zero_deviation(place)),
        expected,
        rtol=0,
        atol=1e-12,
    )


@pytest.mark.parametrize("law", SHOP_LAWS)
def test_lambda_is_what_was_asked_for_in_shops(law):
    able = [robot for robot in MACHINE_MAKES if machines.list_law_places(law, robot, 3)]
    for robot in (able[0], able[-1]):
        place = machines.list_law_places(law, robot, 3)[-1]
        made = machines.build_and_measure_arm(
            MachineCase(robot, "test", (GapCause(law, place, 70.0, 1),), poses=60)
        )
        assert_allclose(made.powers, [70.0], rtol=1e-5)
        assert made.parts.shape == (1, made.data.poses, 3, 3)
