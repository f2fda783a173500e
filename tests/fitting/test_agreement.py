"""Files that do not agree on one arm are told, with what differs; files that agree never are.

The arms are those of `experiments.agreement`: matrices, springs and leaning axes of its own.
"""

import json
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
from conftest import SHARED, run
from numpy.testing import assert_allclose
from scipy import stats
from scipy.spatial.transform import Rotation

import minimax_cal as mc
from experiments.agreement import (
    AGREEMENT_ROBOTS,
    BASE_CONTRADICTION,
    JOINT_ZERO_CONTRADICTION,
    SCALE_CONTRADICTION,
    SIMULATED_EFFECTS,
    AgreementJob,
    PositionSigmaJob,
    SimulatedArm,
    fitted_target_position,
    homogeneous_transform,
    position_error_over_sigma,
    report_contradictions,
)
from minimax_cal.fitting.accuracy_claims import nominal_link_sigmas
from minimax_cal.fitting.contradiction import Contradiction, ContradictionCause
from minimax_cal.fitting.multi_instrument.agreement import ScoreTest
from minimax_cal.fitting.multi_instrument.instrument_fit import fit_instruments
from minimax_cal.fitting.multi_instrument.lack import Components, FileRows, with_lack
from minimax_cal.fitting.multi_instrument.options import RelativeOptions, silent_progress
from minimax_cal.fitting.multi_instrument.relative_calibration import (
    calibrated_position_sigma_of_instruments,
    first_instrument_targets,
    nominal_position_sigma_of_instruments,
    relative,
)
from minimax_cal.fitting.outcome import FileEvidence, FitEvidence, judge
from minimax_cal.instruments import Surface, contacts, distances
from minimax_cal.instruments.instrument import bare
from minimax_cal.measuring.visit_history import joint_rates
from minimax_cal.solvers.status import Status

DISAGREE = SHARED / "reports" / "files_disagree.py"


@pytest.mark.parametrize("seed", [2, 6, 9, 14])
def test_files_that_agree_are_no_contradiction(seed):
    """Of arms that bend, of files that see other joint ranges, or both."""
    assert report_contradictions(AgreementJob(seed)).status == "converged"


@pytest.mark.parametrize("cause", [SCALE_CONTRADICTION, JOINT_ZERO_CONTRADICTION])
@pytest.mark.parametrize("seed", [10_001, 10_003, 10_005])
def test_what_differs_between_files_is_named(seed, cause):
    told = report_contradictions(AgreementJob(seed, cause))
    assert told.status == "contradictory"
    assert told.right
    assert told.p < 1e-4


@pytest.mark.parametrize("seed", [10_001, 10_003, 10_005])
def test_a_base_that_moved_between_files_of_one_frame_is_named(seed):
    told = report_contradictions(AgreementJob(seed, BASE_CONTRADICTION))
    assert told.status == "contradictory"
    assert told.right
    assert told.p < 1e-4


MOVED = np.array([2e-3, -1e-3, 0.5e-3])  # of the base [m]
STOOD = homogeneous_transform(
    Rotation.from_rotvec([0.3, -0.5, 1.1]).as_matrix(), np.array([1.0, -2.0, 0.5])
)
GREW = homogeneous_transform(np.eye(3), np.array([0.0, 0.0, 1e-4]))
ELSEWHERE = homogeneous_transform(np.eye(3), np.array([0.5, 0.3, 0.0]))


@pytest.mark.parametrize(
    "after", [np.eye(4), ELSEWHERE, GREW, homogeneous_transform(np.eye(3), MOVED)]
)
def test_how_far_a_base_moved_is_told_of_whole_poses(after):
    arm = SimulatedArm(mc.load_robot("irb2600"), np.random.default_rng(3), "leaning", 2e-4)
    bases = STOOD, STOOD @ after
    files = [
        arm.simulate_measurement("poses", 60, 2e-5, base_pose=base, narrow=True) for base in bases
    ]
    found = relative(arm.robot, files)
    if np.allclose(after[:3, 3], MOVED):
        assert str(found.status) == "contradictory"
        (one,) = found.contradictions
        assert one.cause.kind == BASE_CONTRADICTION
        assert one.cause.by == pytest.approx(np.linalg.norm(MOVED), abs=2e-4)
        assert one.sentence in found.notices
    else:  # it stood still, grew in the sun, or the instrument was set up elsewhere
        assert str(found.status) == "converged"
        assert not found.contradictions


@pytest.mark.parametrize("after", [np.eye(4), ELSEWHERE, homogeneous_transform(np.eye(3), MOVED)])
def test_a_base_that_moved_between_sessions_contradicts_nothing(after):
    """Sessions say that something may have moved: a notice has by how much."""
    rng = np.random.default_rng(3)
    arm = SimulatedArm(mc.load_robot("irb2600"), rng, "leaning", 2e-4)
    q = arm.draw_joint_values(120, in_narrow_range=True)
    bases = np.repeat([STOOD, STOOD @ after], 60, axis=0)
    y = (bases @ arm.flange_poses(q) @ [0.06, -0.04, 0.1, 1.0])[:, None, :3]
    y += 2e-5 * rng.normal(size=y.shape)
    data = mc.measurements(q, y, session=np.repeat(["A", "B"], 60))
    fit = mc.calibrate(arm.robot, data, "sum")
    assert str(fit.status) == "converged"
    assert not fit.contradictions
    said = [one for one in fit.moved if one.place == "frame"]
    if np.allclose(after[:3, 3], MOVED):
        assert said[0].amounts[0].value == pytest.approx(np.linalg.norm(MOVED), abs=2e-4)
        assert any("stands elsewhere from B on" in notice for notice in fit.notices)


@pytest.mark.slow
def test_of_many_files_few_contradict_in_vain_and_most_causes_are_named():
    assert (
        sum(
            report_contradictions(AgreementJob(seed)).status == "contradictory"
            for seed in range(40)
        )
        <= 1
    )
    told = [
        report_contradictions(
            AgreementJob(10_000 + i, (SCALE_CONTRADICTION, JOINT_ZERO_CONTRADICTION)[i % 2])
        )
        for i in range(20)
    ]
    assert sum(one.status == "contradictory" for one in told) >= 17
    assert sum(one.right for one in told) >= 14


@pytest.mark.slow
@pytest.mark.parametrize("bends", [False, True])
@pytest.mark.parametrize("kinds", [("wires",), ("tracker", "poses")])
def test_sigmas_of_positions_are_true_on_arms_that_bend(kinds, bends):
    median = np.median(
        [position_error_over_sigma(PositionSigmaJob(seed, kinds, bends)) for seed in range(8)]
    )
    assert (0.6 if bends else 0.7) < median < (1.6 if bends else 1.4)


ANCHORS = 1.5 * np.stack(
    [np.cos([0.0, 2.0, 4.0]), np.sin([0.0, 2.0, 4.0]), [0.1, 0.5, 0.3]], axis=1
)


def recorded(arm, late, count=150, step=0.1):
    """Lengths of three wires while the arm moves, measured so much after its joints [s]."""
    rng, n = arm.rng, arm.robot.joints
    time = step * np.arange(count) + rng.uniform(0.0, 50.0)
    rate, phase, size = (rng.uniform(*ends, n) for ends in ((0.3, 1.2), (0.0, 6.28), (0.5, 1.0)))
    middle = 0.5 * (np.maximum(arm.robot.lower, -np.pi) + np.minimum(arm.robot.upper, np.pi))
    q, moved = (middle + size * np.sin(rate * t[:, None] + phase) for t in (time, time + late))
    place = (arm.flange_poses(moved) @ [0.06, -0.04, 0.1, 1.0])[:, None, :3]
    length = np.linalg.norm(place - ANCHORS, axis=-1)
    return distances(q, length + 3e-5 * rng.normal(size=length.shape), time=time)


@pytest.mark.parametrize("effect", ["", "leaning"])
@pytest.mark.parametrize("late", [0.0, 0.003, -0.01])
def test_a_file_measured_by_another_clock_is_named(effect, late):
    arm = SimulatedArm(mc.load_robot("irb2600"), np.random.default_rng(1), effect, 2e-4)
    found = relative(
        arm.robot, [arm.simulate_measurement("tracker", 50, 3e-5), recorded(arm, late)]
    )
    if not late:
        assert str(found.status) == "converged"
        assert not found.contradictions
        return
    assert str(found.status) == "contradictory"
    (one,) = found.contradictions
    assert (one.cause.kind, one.cause.place, one.cause.unit) == ("clock", "distances", "s")
    assert_allclose(one.cause.by, late, rtol=0.02)


def test_poses_at_which_the_arm_stood_have_no_clock(rng):
    """Joints of poses chosen at random say nothing of the speed between them."""
    still = bare(rng.normal(size=(40, 6)), {"time": 30.0 * np.arange(40)})
    assert not joint_rates(still).any()
    time = 0.1 * np.arange(200) + rng.uniform(0.0, 0.02, 200)
    moving = bare(np.sin(time)[:, None] * np.ones(6), {"time": time})
    assert_allclose(joint_rates(moving)[5:-5, 0], np.cos(time)[5:-5], atol=0.02)


def bent_arm(seed):
    """An arm whose effect moves it by more than its drawing is off, and what three wires say."""
    rng = np.random.default_rng([seed, 9])
    robot, effect = (
        mc.load_robot(AGREEMENT_ROBOTS[seed % len(AGREEMENT_ROBOTS)]),
        SIMULATED_EFFECTS[seed % len(SIMULATED_EFFECTS)],
    )
    arm = SimulatedArm(robot, rng, effect, 2e-3)
    return arm, arm.simulate_measurement("wires", 60, 3e-5, narrow=seed % 2 == 0)


@pytest.mark.parametrize("seed", [1, 17])
def test_a_bent_arm_is_held_against_a_drawn_one_that_bends_as_much(seed):
    """A drawing that is off by less than the arm bends is no better known for that."""
    arm, lengths = bent_arm(seed)
    found = relative(arm.robot, lengths)
    assert str(found.status) == "converged"
    off = arm.rms_position_error(found.robot, fitted_target_position(found))
    assert off < arm.rms_position_error(arm.robot, arm.spots[0])
    assert 0.6 * found.position_sigma < off < 1.6 * found.position_sigma
    # wires that tell the arm to a tenth of how it bends are no poor instrument
    assert not any("positions are poorly determined" in notice for notice in found.notices)


@pytest.mark.slow
def test_positions_of_a_drawn_arm_that_bends_are_claimed_as_they_are():
    """And whether the drawn arm is kept follows: mostly where it is the better one."""
    ratio, right = [], []
    for seed in range(16):
        arm, lengths = bent_arm(seed)
        fit = with_lack(
            arm.robot, fit_instruments(arm.robot, {"": lengths}, RelativeOptions(), silent_progress)
        )
        drawn = arm.rms_position_error(arm.robot, arm.spots[0])
        claimed = nominal_position_sigma_of_instruments(
            arm.robot, fit, nominal_link_sigmas(arm.robot)
        )
        ratio.append(drawn / claimed)
        (spot,) = first_instrument_targets(fit, fit.state)
        fitted = arm.rms_position_error(arm.robot.with_mdh(fit.state.mdh), spot)
        is_kept = calibrated_position_sigma_of_instruments(arm.robot, fit) > claimed
        right.append(is_kept == (fitted > drawn))
    assert 0.7 < np.median(ratio) < 1.4
    assert sum(right) >= 12


def two_files(rng, robot, **wrong):
    """A tracker and wires of an arm; wrong: of the wires."""
    arm = SimulatedArm(robot, rng)
    return [
        arm.simulate_measurement("tracker", 40, 2e-5),
        arm.simulate_measurement("wires", 60, 2e-5, **wrong),
    ]


def test_a_contradiction_keeps_the_drawn_arm_and_comes_back(tmp_path, refuses):
    robot = mc.load_robot("irb2600")
    found = relative(robot, two_files(np.random.default_rng(3), robot, length_factor=1.001))
    assert found.status == "contradictory"
    assert found.robot is robot
    (one,) = found.contradictions
    assert one.files == ("distances", "points")
    assert one.cause.kind == "scale"
    assert_allclose(one.cause.by, 1e-3, atol=5e-5)
    assert found.headline().startswith(one.sentence[:20].capitalize())
    assert one.sentence in found.notices
    path = tmp_path / "fit.json"
    found.save(path)
    content = json.loads(path.read_text())["contradictions"]
    assert content[0]["cause"]["kind"] == "scale"
    assert content[0]["files"] == ["distances", "points"]
    refuses("--keep-anyway", "export", path, "--to", "urdf", "-o", tmp_path / "arm.urdf")
    assert run("export", path, "--to", "urdf", "-o", tmp_path / "arm.urdf", "--keep-anyway") == 0
    assert run("report", path, "-o", tmp_path / "report.html") == 0


def test_a_joint_whose_zero_moved_between_files_is_named():
    robot = mc.load_robot("irb2600")
    moved = 1e-3 * np.eye(6)[2]
    found = relative(robot, two_files(np.random.default_rng(3), robot, joint_zero_errors=moved))
    (one,) = found.contradictions
    assert (one.cause.kind, one.cause.place, one.cause.unit) == ("joint_zero", "J3", "rad")
    assert_allclose(one.cause.by, 1e-3, atol=5e-5)
    assert relative(robot, two_files(np.random.default_rng(3), robot)).status == "converged"


def test_the_score_test_is_that_of_generalised_least_squares(rng):
    """Against the difference of two sums of squares in the whole covariance matrix."""
    links, own, lack, rows = 3, 2, 4, 40
    files = []
    for i in range(2):
        shared_slopes = np.zeros((links + 2 * own, rows))
        slopes = rng.normal(size=(links, rows))
        shared_slopes[:links] = slopes
        shared_slopes[links + own * i : links + own * (i + 1)] = rng.normal(size=(own, rows))
        parts = rng.normal(size=rows), shared_slopes, slopes, rng.normal(size=(lack, rows))
        files.append(FileRows(*parts, rows))
    noise, size = np.array([0.5, 2.0]), rng.uniform(0.1, 1.0, lack)
    test = ScoreTest.of(files, Components(noise, size, np.eye(lack), 0.0), np.ones(links))
    both = np.concatenate([one.lack for one in files], axis=1)
    covariance = np.diag(np.repeat(noise, rows)) + both.T @ np.diag(size) @ both
    white = np.linalg.inv(np.linalg.cholesky(covariance))
    error = white @ np.concatenate([one.error for one in files])
    plain = white @ np.concatenate([one.shared for one in files], axis=1).T
    apart = white @ np.concatenate([np.zeros((links, rows)), files[1].links], axis=1).T

    def left(columns):
        return ((error - columns @ np.linalg.lstsq(columns, error)[0]) ** 2).sum()

    assert_allclose(test.statistic, left(plain) - left(np.hstack([plain, apart])), rtol=1e-8)
    gain, by = test.along(np.eye(links)[1])
    one = np.hstack([plain, apart[:, [1]]])
    assert_allclose(gain, left(plain) - left(one), rtol=1e-8)
    assert_allclose(by, np.linalg.lstsq(one, error)[0][-1], rtol=1e-8)
    dof = rows - (links + own)
    assert_allclose(
        test.p_value(test.statistic, 3), stats.f.sf(test.statistic / 3.0, 3, dof), rtol=1e-9
    )


# ---- precedence ----------------------------------------------------------------------------------


def test_the_first_question_that_finds_something_says_how_a_fit_ended():
    robot = mc.load_robot("irb2600")
    sound = mc.relative(robot, two_files(np.random.default_rng(3), robot)).accuracy["train"]
    vague = FitEvidence(
        robot,
        robot.mdh,
        np.ones(30, dtype=bool),
        [FileEvidence({"training": (sound, sound)}, rotations={"training": 1e-3})],
        sigma=np.full(30, 0.1),
        drawn=np.full(30, 1e-4),
        position_sigma=2.0,
        drawn_sigma=1.0,
        worse="it is no better",
    )
    assert judge(vague, Status.CONVERGED).status is Status.NOT_DETERMINED
    assert judge(vague, Status.FAILED).status is Status.FAILED
    sure = replace(vague, position_sigma=0.5)
    assert judge(sure, Status.CONVERGED).status is Status.NO_BETTER
    assert judge(replace(sure, worse=""), Status.STALLED).status is Status.STALLED
    clash = replace(vague, contradictions=(Contradiction(("a", "b"), 1e-9),))
    assert judge(clash, Status.CONVERGED).status is Status.CONTRADICTORY
    turned = replace(clash, files=[replace(clash.files[0], rotations={"training": 0.06})])
    ended = judge(turned, Status.CONVERGED)
    assert ended.status is Status.FAILED
    assert "60 mrad" in ended.reason
    far = robot.mdh.copy()
    far[1, 0] += 0.06 * robot.reach()
    seen = replace(sound, rms_mm=1e4 * robot.reach())
    other = replace(clash, mdh=far, files=[replace(clash.files[0], drawn={"train": seen})])
    assert judge(other, Status.CONVERGED).status is Status.FAILED
    assert "a2" in judge(other, Status.CONVERGED).reason
    allowed = replace(other, allow_large_changes=True)
    assert judge(allowed, Status.CONVERGED).status is Status.CONTRADICTORY


def test_one_plane_does_not_determine_an_arm():
    robot, rng = mc.load_robot("irb2600"), np.random.default_rng(6)
    spot, q = np.array([0.06, -0.04, 0.1]), np.zeros((0, 6))
    true = robot.with_mdh(robot.mdh + rng.normal(size=(6, 5)) * [0, 0, 4e-4, 0, 0])
    while len(q) < 40:  # by the secant, on the height of the ball above the plane
        near = rng.uniform([-1.5, -0.5, -0.6, -2, -1.2, -2], [1.5, 1.2, 0.6, 2, 1.2, 2])
        two = np.tile(near, (2, 1))
        two[1, 1] += 0.05
        for _ in range(30):
            pose = true.pose(two)
            high = pose[:, 2, 3] + pose[:, 2, :3] @ spot - 0.4
            if abs(high[1] - high[0]) < 1e-14:
                break
            step = high[1] * (two[1, 1] - two[0, 1]) / (high[1] - high[0])
            two = np.array([two[1], two[1]])
            two[1, 1] -= step
        if abs(high[1]) < 1e-10 and -0.5 < two[1, 1] < 1.2:
            two[1, 1] += 2e-5 * rng.normal()
            q = np.concatenate([q, two[1:]])
    found = relative(robot, contacts(q, ["floor"] * len(q), [Surface("floor", "plane")]))
    assert found.status == "not_determined"
    assert found.robot is robot
    assert "do not determine" in found.reason


# ---- the report ----------------------------------------------------------------------------------


@pytest.mark.skipif(not DISAGREE.exists(), reason="reports are not on this machine")
def test_the_report_of_files_that_disagree(tmp_path, capsys):
    subprocess.run([sys.executable, DISAGREE, tmp_path], check=True)
    for files, code, words in (
        (("tracker.csv", "wires.csv"), 0, ""),
        (("tracker.csv", "wires_long.csv"), 1, "all lengths of wires_long are 0.0986 % longer"),
        (("tracker.csv", "wires_moved.csv"), 1, "the zero of joint 3 differs by +0.977 mrad"),
        (("plane.csv",), 1, "do not determine"),
    ):
        assert run("calibrate", "irb2600", *(tmp_path / name for name in files)) == code
        assert words in capsys.readouterr().err


def test_a_cause_is_a_sentence():
    cause = ContradictionCause("scale", "wires", -2e-3, "1")
    assert "0.2 % shorter" in Contradiction(("wires", "points"), 1e-9, cause).sentence
    assert "no single" in Contradiction(("wires", "points"), 1e-9).sentence
