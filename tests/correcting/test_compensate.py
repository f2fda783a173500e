import csv
import json
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from conftest import invoked
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

import minimax_cal as mc
from minimax_cal.cli.compensate import compensate_command
from minimax_cal.compensation.deliverable import AccuracyFigures, Delivered
from minimax_cal.compensation.joint_compensation import (
    NOMINAL_FRAME_CHOICES,
    Compensation,
    compensate,
    convert_targets_to_measurements,
)
from minimax_cal.compensation.target_file import ADDED_TARGET_COLUMNS, read_target_file
from minimax_cal.core.arrays import Array
from minimax_cal.modelling.effects.table import NO_EFFECTS, Fitted, Term
from minimax_cal.modelling.inverse_with_effects import (
    InverseOutcome,
    InverseProblem,
    build_flange_cell,
)
from minimax_cal.modelling.simulate import Simulation, Truth, gravity, simulate
from minimax_cal.robots.joint_sampling import random_joint_values_above_floor


@pytest.fixture(scope="module")
def sim(robot: mc.Robot) -> Simulation:
    return simulate(robot, 100, 3, seed=5)


@pytest.fixture(scope="module")
def fit(robot: mc.Robot, sim: Simulation) -> mc.Fit:
    return mc.calibrate(robot, sim.data, effects=["joint_compliance:all"])


@pytest.fixture(scope="module")
def saved(fit: mc.Fit, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("fit") / "fit.json"
    fit.save(path)
    return path


def true_points(sim: Simulation, q: Array) -> Array:
    """Where the reflectors of the true robot are, its compliance included."""
    return sim.cell.predict(q + Truth().compliance * gravity(sim.cell.robot, q))


def off(robot: mc.Robot, rng: np.random.Generator, size: float = 1.0) -> mc.Robot:
    """A robot with errors of half a millimetre and a milliradian."""
    error = rng.normal(size=robot.mdh.shape) * [5e-4, 5e-4, 1e-3, 1e-3, 1e-3]
    return robot.with_mdh(robot.mdh + size * error)


def cell_of(robot: mc.Robot, effects: Fitted = NO_EFFECTS) -> mc.Cell:
    spots = np.array([[0.1, 0.0, 0.03], [-0.05, 0.09, 0.03], [-0.05, -0.09, 0.03]])
    return mc.Cell(robot, np.eye(4), ("smr1", "smr2", "smr3"), spots, effects)


def test_joints_that_count_the_other_way(robot, rng):
    """The same arm with other joint signs: the same corrections, with these signs."""
    sign = np.array([1.0, -1.0, 1.0, -1.0, -1.0, 1.0])
    wrong = off(robot, rng)
    stiff = Fitted((Term("link_bending", "L2"),), (np.array([1e-6]),))
    q = regular(robot, random_joint_values_above_floor(robot, 40, rng))
    plain = compensate(cell_of(wrong, stiff), q, robot, frame="own")
    other = replace(robot, sign=sign, lower=-robot.upper, upper=-robot.lower)
    turned = replace(wrong, sign=sign, lower=-robot.upper, upper=-robot.lower)
    found = compensate(cell_of(turned, stiff), q * sign, other, frame="own")
    assert_allclose(found.q, plain.q * sign, rtol=0, atol=1e-9)
    assert np.abs(plain.q - q).max() > 1e-4
    for frame in ("best-fit", "flange"):  # a base placed by poses of the two models
        same = compensate(cell_of(other), q * sign, other, frame=frame)
        assert_allclose(same.q, q * sign, rtol=0, atol=1e-7)


def regular(robot: mc.Robot, q: Array) -> Array:
    """The poses at which no two wrist axes and no links line up."""
    flange = robot.pose(q)[:, :3, 3]
    clear = (np.abs(np.sin(q[:, 4])) > 0.3) & (np.hypot(flange[:, 0], flange[:, 1]) > 0.5)
    return q[clear & (np.abs(q[:, 2]) < 1.0)]


def apart(one: Array, other: Array) -> tuple[Array, Array]:
    """Distance and angle between poses."""
    turn = Rotation.from_matrix(np.swapaxes(one[:, :3, :3], 1, 2) @ other[:, :3, :3])
    return np.linalg.norm(one[:, :3, 3] - other[:, :3, 3], axis=1), turn.magnitude()


def test_the_true_robot_comes_to_the_nominal_targets(robot, sim, fit):
    q = regular(robot, random_joint_values_above_floor(robot, 400, np.random.default_rng(10)))
    found = compensate(fit, q)
    assert not found.failed.any()
    goal = fit.nominal.predict(q)
    before = np.linalg.norm(true_points(sim, q) - goal, axis=-1)
    after = np.linalg.norm(true_points(sim, found.q) - goal, axis=-1)
    assert np.sqrt(np.mean(before**2)) > 1e-3
    assert 1e3 * np.sqrt(np.mean(after**2)) < fit.accuracy["holdout"].rms_mm
    assert 1e3 * after.max() < 3.0 * fit.accuracy["holdout"].rms_mm


@pytest.mark.parametrize("frame", ["flange", "own"])
def test_frames_lay_the_flange_where_they_say(robot, sim, fit, frame):
    q = regular(robot, random_joint_values_above_floor(robot, 100, np.random.default_rng(3)))
    found = compensate(fit, q, frame=frame)
    assert not found.failed.any()
    base = fit.nominal.base if frame == "flange" else fit.cell.base
    goal = replace(fit.cell, robot=robot, base=base, effects=NO_EFFECTS).predict(q)
    after = np.linalg.norm(true_points(sim, found.q) - goal, axis=-1)
    assert 1e3 * after.max() < 3.0 * fit.accuracy["holdout"].rms_mm


def test_an_arm_as_drawn_is_left_alone(robot, rng):
    q = random_joint_values_above_floor(robot, 50, rng)
    for frame in NOMINAL_FRAME_CHOICES:
        found = compensate(cell_of(robot), q, robot, frame=frame)
        assert_allclose(found.q, q, rtol=0, atol=1e-9)
        assert set(found.outcome) == {InverseOutcome.REACHED}


def test_limits_hold_and_are_reported(robot, rng):
    real = robot.with_mdh(robot.mdh + np.array([0, 0, -0.01, 0, 0]) * np.eye(6)[:, [2]])
    q = np.array([[0.3, 0.2, 1.3085, 0.4, 0.8, 0.1], [0.3, 0.2, 0.5, 0.4, 0.8, 0.1]])
    found = compensate(cell_of(real), q, robot, frame="own")
    assert found.outcome == (InverseOutcome.LIMIT, InverseOutcome.REACHED)
    assert found.q[0, 2] == robot.upper[2]
    assert np.all((found.q >= robot.lower) & (found.q <= robot.upper))
    # least squares: no allowed motion of the other joints lowers the cost
    lever = float(np.sqrt(np.mean(np.square(cell_of(real).target_positions).sum(axis=1))))

    def cost(at: Array) -> float:
        distance, angle = apart(robot.pose(q[:1]), real.pose(at[None]))
        return float(distance[0] ** 2 + (lever * angle[0]) ** 2)

    for j in (0, 1, 3, 4, 5):
        for step in (-1e-3, 1e-3):
            assert cost(found.q[0] + step * np.eye(6)[j]) > cost(found.q[0])
    assert "limit at line 1" in found.complaint()


def test_a_stretched_arm_that_is_too_short_gets_as_near_as_it_can(robot):
    real = robot.with_mdh(robot.mdh - np.array([0, 2e-3, 0, 0, 0]) * np.eye(6)[:, [3]])
    elbow = -np.arctan2(938.0, 150.0)  # forearm in line with the upper arm
    found = compensate(cell_of(real), [[0.2, 0.3, elbow, 0.0, 0.7, 0.0]], robot, frame="own")
    assert found.outcome[0].failed
    assert 0.0 < found.distance[0] <= found.distance_before[0]
    assert np.abs(found.q - found.commanded).max() < np.pi / 36 + 1e-12
    easy = [0.2, 0.3, 0.4, 0.1, 0.7, 0.2]  # a target that is met changes nothing about it
    both = compensate(cell_of(real), [*found.commanded.tolist(), easy], robot, frame="own")
    assert not both.outcome[1].failed
    assert_allclose(both.q[0], found.q[0], rtol=0, atol=1e-9)


def test_a_straight_wrist_is_not_swung_about(robot, rng):
    q = random_joint_values_above_floor(robot, 30, rng)
    q[:, 4] = 0.0
    found = compensate(cell_of(off(robot, rng)), q, robot, frame="own")
    change = np.abs(found.q - q).max(axis=1)
    missed = found.failed
    assert missed.any()
    assert change.max() < np.pi / 36 + 1e-12
    assert {o for o in found.outcome if o.failed} <= {
        InverseOutcome.SINGULAR,
        InverseOutcome.CHANGE,
    }
    before = np.hypot(found.distance_before, 0.1 * found.angle_before)
    assert np.all(np.hypot(found.distance, 0.1 * found.angle) < 1.1 * before)


def test_scara_corrects_what_four_joints_can(rng):
    robot = mc.load_robot("scara_600")
    real = off(robot, rng)
    q = rng.uniform([-1.5, 0.6, 0.03, -2.0], [1.5, 2.0, 0.17, 2.0], (40, 4))
    found = compensate(cell_of(real), q, robot, frame="own")
    assert set(found.outcome) <= {InverseOutcome.CLOSEST, InverseOutcome.REACHED}
    assert not found.failed.any()
    assert found.distance.max() < 1e-5 < 1e-4 < found.distance_before.max()
    assert found.angle.max() > 1e-5  # the tilt remains
    assert "fewer than six joints" in found.summary()
    edge = q[:1].copy()
    edge[0, 2] = 0.0
    raised = robot.with_mdh(robot.mdh + np.array([0, 1e-3, 0, 0, 0]) * np.eye(4)[:, [2]])
    assert compensate(cell_of(raised), edge, robot, frame="own").outcome == (InverseOutcome.LIMIT,)


def test_a_redundant_arm_changes_least(rng):
    bend = np.pi / 2 * np.array([-1, 1, -1, 1, -1, 1, 0])
    mdh = np.stack([np.zeros(7), [0.34, 0, 0.4, 0, 0.4, 0, 0.126], np.zeros(7), bend,
                    np.zeros(7)], axis=1)  # fmt: skip
    seven = mc.Robot("seven axes", mdh, np.ones(7), np.zeros(7, bool), np.full(7, -3.0),
                     np.full(7, 3.0), np.full(7, np.nan), np.full(7, np.nan),
                     np.full((7, 3), np.nan), np.array([0.0, 0.0, 1.0]))  # fmt: skip
    real = off(seven, rng, 0.1)
    q = rng.uniform(0.5, 1.2, (20, 7))
    found = compensate(cell_of(real), q, seven, frame="own")
    assert set(found.outcome) == {InverseOutcome.REACHED}
    reach = InverseProblem(
        build_flange_cell(cell_of(real)),
        convert_targets_to_measurements(q, real, 0.0),
        seven.pose(q),
        0.1,
        1e-5,
        0.1,
    )
    residual, jacobian = reach.residual_and_jacobian(q, reach.goal, np.zeros_like(q))
    least = (np.linalg.pinv(jacobian) @ residual[..., None])[..., 0]
    assert_allclose(found.q - q, least, rtol=0, atol=0.02 * np.abs(least).max())


def effect(name: str, place: str, value: list[float], **choice: float) -> Fitted:
    return Fitted((Term(name, place, choice),), (np.array(value),))


@pytest.mark.parametrize(
    "effects",
    [
        effect("joint_compliance", "J2", [2e-6], parts=2.0**7),
        effect("link_bending", "L2", [1e-6]),
        effect("base_flex", "frame", [5e-7]),
        effect("gear_ripple", "J3", [2e-4, 1e-4], turns=121.0),
        effect("backlash", "J5", [1e-3]),
        effect("settling", "J1", [1e-2]),
        effect("thermal_growth", "all", [3e-4], temperature=1.0, apart=0.0),
    ],
    ids=lambda e: e.terms[0].label,
)
def test_every_kind_of_effect_is_corrected(robot, rng, effects):
    q = regular(robot, random_joint_values_above_floor(robot, 60, rng))
    columns = {"temperature": np.full(len(q), 32.0), "payload": np.full(len(q), 12.0)}
    data = replace(convert_targets_to_measurements(q, robot, 0.0), columns=columns).in_visit_order()
    cell = cell_of(off(robot, rng), effects)
    found = compensate(cell, data, robot, frame="own")
    assert set(found.outcome) == {InverseOutcome.REACHED}
    # as measured points: an independent way through Cell.follow
    goal = cell_of(robot).predict(q)
    reached = cell.follow(replace(data, q=found.q))
    assert_allclose(reached, goal, rtol=0, atol=1e-7)
    plain = compensate(replace(cell, effects=NO_EFFECTS), data, robot, frame="own")
    assert np.abs(cell.follow(replace(data, q=plain.q)) - goal).max() > 1e-5


def test_what_moves_only_reflectors_is_left_out(robot, rng):
    q = regular(robot, random_joint_values_above_floor(robot, 20, rng))
    cell = cell_of(robot, effect("target_offset", "all", [1e-3]))
    found = compensate(cell, q, robot)
    assert_allclose(found.q, q, rtol=0, atol=1e-9)
    assert any("target offset" in notice for notice in found.notices)


def test_play_that_pulls_both_ways_is_told(robot):
    """A joint is to turn back by less than its play: no side is the one it comes from."""
    q = np.repeat([[0.3, 0.2, -0.4, 0.4, 0.8, 0.1]], 3, axis=0)
    q[:, 0] += [0.0, 0.1, 0.2]
    q[:, 4] += [0.0, 0.1, 0.1 - 2e-4]
    cell = cell_of(robot, effect("backlash", "J5", [1e-3]))
    found = compensate(cell, q, robot, frame="own")
    assert found.outcome == (InverseOutcome.REACHED, InverseOutcome.REACHED, InverseOutcome.STALLED)
    assert_allclose(found.q[1, 4] - q[1, 4], -5e-4, rtol=0, atol=1e-9)
    assert_allclose(found.angle[2], 1e-3, rtol=0.1)  # told as it is, not as hoped
    assert "stalled at line 3" in found.complaint()
    sided = replace(
        convert_targets_to_measurements(q, robot, 0.0), columns={"approach5": np.ones(3)}
    )
    again = compensate(cell, sided, robot, frame="own")
    assert set(again.outcome) == {InverseOutcome.REACHED}
    assert_allclose(again.q[:, 4] - q[:, 4], -5e-4, rtol=0, atol=1e-9)


def test_the_saved_fit_gives_the_same(robot, fit, saved):
    q = regular(robot, random_joint_values_above_floor(robot, 50, np.random.default_rng(8)))
    for frame in NOMINAL_FRAME_CHOICES:
        here, there = compensate(fit, q, frame=frame), compensate(saved, q, frame=frame)
        assert_allclose(here.q, there.q, rtol=0, atol=1e-8)
    given = compensate(saved, q, robot)
    assert_allclose(given.q, compensate(fit, q).q, rtol=0, atol=1e-8)
    # without the calibration's nominal base it is placed by the models: near, not equal
    bare = compensate(fit.cell, q, robot)
    assert any("placed by" in notice for notice in bare.notices)
    assert np.abs(bare.q - given.q).max() < 5e-3


def test_wrong_input_is_told(robot, fit):
    q = np.zeros((1, 6))
    for wrong in (
        lambda: compensate(fit, q, frame="moon"),
        lambda: compensate(fit, q, tolerance=0.0),
        lambda: compensate(fit, q, lever=-1.0),
        lambda: compensate(fit, q, clock=2.0),
        lambda: compensate(fit, np.zeros((1, 5))),
        lambda: compensate(fit, np.zeros((0, 6))),
        lambda: compensate(fit, [[0.0, 0, 0, 0, 0, np.nan]]),
        lambda: compensate(fit, [["a"] * 6]),
        lambda: compensate(fit, 60.0 * np.ones((1, 6))),
        lambda: compensate(fit.cell, q),
        lambda: compensate(fit, q, mc.load_robot("scara_600")),
        lambda: compensate(fit, q, replace(robot, sign=-robot.sign)),
    ):
        with pytest.raises(mc.CalibrationError):
            wrong()


def test_tables_hold_what_a_hand_reckons():
    """Two targets of two joints, a turn and a slide; of nine missed ones eight are named."""
    found = Compensation(
        q=np.array([[0.101, 0.2], [0.3, 0.398]]),
        commanded=np.array([[0.1, 0.2], [0.3, 0.4]]),
        distance=np.array([3e-6, 4e-6]),
        angle=np.array([0.0, 2e-6]),
        distance_before=np.array([3e-3, 4e-3]),
        angle_before=np.array([1e-3, 7e-3]),
        outcome=(InverseOutcome.REACHED, InverseOutcome.LIMIT),
        sliding=np.array([False, True]),
        line=np.array([2, 3]),
        name="two",
        frame="own",
        notices=(),
    )
    own = Delivered(
        "compensate", "geometry", (), (), cell_of(mc.load_robot("ur10")), None,
        AccuracyFigures(0.07, 0.2, 0.08, 0.1, 0.3), AccuracyFigures(),
    )  # fmt: skip
    assert [row[0] for row in found.tables()[0].rows] == ["as commanded", "missed, by the model"]
    found = replace(found, delivered=own)
    pose, ends, joints = found.tables()
    rms = np.sqrt(12.5)
    assert pose.rows[0] == ("as commanded", 2, *map(pytest.approx, (rms, 4.0, 5.0, 7.0)))
    small = (4e-3, 4e-3, 2e-3, 2e-3)
    assert pose.rows[1] == ("missed, by the model", 1, *map(pytest.approx, small))
    assert pose.rows[2][:4] == ("corrected, on the arm", 1, 0.07, 0.2)
    assert ends.rows == (
        ("reached", 1, InverseOutcome.REACHED.advice),
        ("limit", 1, InverseOutcome.LIMIT.advice),
    )
    assert joints.rows == (
        ("J1", "mrad", pytest.approx(np.sqrt(0.5)), pytest.approx(1.0)),
        ("J2", "mm", pytest.approx(np.sqrt(2.0)), pytest.approx(2.0)),
    )
    assert found.headline() == (
        "1 of 2 targets corrected, which are off by up to 3.000 mm, 1.000 mrad as commanded; "
        "1 missed, which stay off by up to 0.004 mm, 0.002 mrad. Expect on the arm: held-out RMS "
        "0.070 mm, largest 0.200 mm; outside the measured region RMS 0.080 mm, worst region "
        "0.100 mm RMS, largest 0.300 mm."
    )
    assert found.complaint().startswith("1 of 2 targets are missed: limit at line 3: ")
    told = found.to_dict()
    assert told["missed"] == 1
    assert told["targets"][1] == {
        "line": 3, "status": "limit", "q": [0.3, 0.398],
        **dict(zip(("residual_mm", "residual_mrad", "before_mm", "before_mrad"),
                   map(pytest.approx, (4e-3, 2e-3, 4.0, 7.0)), strict=True)),
    }  # fmt: skip
    for count, says in ((8, "line 1, 2, 3, 4, 5, 6, 7, 8: "), (9, "7, 8 and 1 more: ")):
        many = replace(found, outcome=(InverseOutcome.LIMIT,) * count, line=np.arange(count) + 1)
        assert says in many.complaint()


def test_the_start_of_the_session_and_20_degrees_are_taken(robot, rng):
    q = regular(robot, random_joint_values_above_floor(robot, 20, rng))[:2]
    warming = cell_of(robot, effect("thermal_growth", "all", [3e-4], constant=0.5, apart=0.0))
    first = compensate(warming, q, robot, frame="own")
    last = compensate(warming, q, robot, frame="own", clock=1.0)
    assert_allclose(first.q, compensate(warming, q, robot, frame="own", clock=0.0).q)
    assert np.abs(last.q - first.q).max() > 1e-5
    assert any("taken at 0 of it" in notice for notice in first.notices)
    assert any("taken at 1 of it" in notice for notice in last.notices)
    hot = cell_of(robot, effect("thermal_growth", "all", [3e-4], temperature=1.0, apart=0.0))
    measured = replace(
        convert_targets_to_measurements(q, robot, 0.0), columns={"temperature": np.full(2, 30.0)}
    )
    for targets, told in ((q, True), (measured, False)):
        notices = compensate(hot, targets, robot, frame="own").notices
        assert any("taken at 20 C" in notice for notice in notices) == told


@pytest.mark.parametrize(("part", "told"), [(6, False), (7, True), (3, True), (4, False)])
def test_a_compliance_of_measured_torques_asks_for_them(part, told, robot, rng):
    cell = cell_of(robot, effect("joint_compliance", "J2", [2e-6], parts=2.0**part))
    found = compensate(
        cell,
        regular(robot, random_joint_values_above_floor(robot, 20, rng))[:1],
        robot,
        frame="own",
    )
    assert any("fitted to measured torques" in notice for notice in found.notices) == told


def write(path: Path, header: str, *rows: str) -> Path:
    path.write_text("\n".join([header, *rows]) + "\n")
    return path


run = partial(invoked, compensate_command)
DEGREES = "name,q1_deg,q2_deg,q3_deg,q4_deg,q5_deg,q6_deg,payload_kg,speed"


def test_command_keeps_the_file_and_corrects_the_joints(saved, tmp_path):
    rows = ["pick,10,20,-15,30,40,50,0,v100", "place,-40,5,10,-60,55,0,5,v50"]
    targets = write(tmp_path / "targets.csv", DEGREES, *rows)
    out = tmp_path / "out.csv"
    code, text, notes = run(saved, targets, "-o", out)
    assert code == 0
    assert "corrected" in text
    assert "2 of 2 targets" in text
    assert "column speed is kept and not used" in notes
    with out.open() as stream:
        header, *body = csv.reader(stream)
    assert header == [*DEGREES.split(","), *ADDED_TARGET_COLUMNS]
    expected = compensate(saved, read_target_file(targets).data)
    for i, row in enumerate(body):
        assert row[0] == rows[i].split(",")[0]
        assert row[7:9] == rows[i].split(",")[7:9]
        assert row[-1] == "reached"
        assert float(row[-3]) < 1e-3
        assert_allclose(np.radians([float(c) for c in row[1:7]]), expected.q[i], atol=1e-10)
    code, text, notes = run(saved, targets)
    assert text == out.read_text()  # a pipe gets the file, the reader the summary
    assert "corrected" in notes
    code, text, notes = run(saved, targets, "--json", "-q", "--robot", "irb2600")
    content = json.loads(text)
    assert notes == ""
    assert content["missed"] == 0
    assert len(content["targets"]) == 2
    assert run(saved, out)[0] == 2  # corrected already


def test_targets_in_german_come_back_under_their_names(saved, tmp_path):
    head = "Name;" + ";".join(f"Achse {i} [°]" for i in range(1, 7)) + ";Werkzeug"
    german, out = tmp_path / "Ziele.csv", tmp_path / "out.csv"
    german.write_bytes(f"{head}\r\nGreifpunkt ä;10;20,5;-15;30;40;50;A\r\n".encode("cp1252"))
    same = write(tmp_path / "t.csv", DEGREES, "pick,10,20.5,-15,30,40,50,0,v")
    assert_allclose(read_target_file(german).data.q, read_target_file(same).data.q, rtol=0, atol=0)
    assert run(saved, german, "-o", out)[0] == 0
    with out.open() as stream:
        assert next(csv.reader(stream)) == [*head.split(";"), *ADDED_TARGET_COLUMNS]


def test_command_says_which_targets_are_missed(saved, tmp_path):
    header = ",".join(f"q{i}_rad" for i in range(1, 7))
    far = write(tmp_path / "far.csv", header, "0.1,0.2,0.3,0.4,0.8,0", "0.1,0.2,0.3,0.4,0,0")
    out = tmp_path / "out.csv"
    code, _, notes = run(saved, far, "-o", out)
    assert code == 1
    assert "1 of 2 targets are missed" in notes
    assert "line 3" in notes
    assert out.read_text().count("reached") == 1


@pytest.mark.parametrize(
    ("header", "row", "word"),
    [
        ("x,y", "1,2", "no joint columns"),
        ("q1_rad,q2_rad", "0,0", "2 joint columns"),
        (DEGREES, "a,1,2,3,four,5,6,0,v", "four"),
        (DEGREES, "a,1,2,3,,5,6,0,v", "is empty"),
        (DEGREES, "a,1,2", "3 cells"),
        (DEGREES, "a,1,2,3,4,50,6,-50,v", "t.csv:2: column payload_kg: -50 cannot be"),
        (DEGREES, "a,1,2,3,4,50,6,5000,v", "t.csv:2: column payload_kg: 5000 cannot be"),
        (DEGREES.replace("speed", "temperature_C"), "a,1,2,3,4,50,6,0,-300", "-300 cannot be"),
        (DEGREES.replace("_deg", "_rad"), "a,10,20,30,40,50,60,0,v", "degrees?"),
        (DEGREES.replace("q3_deg", "q3_mm"), "a,1,2,3,4,5,6,0,v", "joint 3"),
        ("q1_rad;q2_rad", "0;0", "2 joint columns"),
        ("Achse 1,Achse 2", "0,0", "Achse 1 has no unit: write Achse 1 [deg], or [rad]"),
    ],
)
def test_command_tells_slips(saved, tmp_path, header, row, word):
    code, _, said = run(saved, write(tmp_path / "t.csv", header, row))
    assert code == 2
    assert word in said


def test_command_tells_wrong_files(saved, tmp_path):
    targets = write(tmp_path / "t.csv", DEGREES, "a,1,2,3,4,50,6,0,v")
    assert run(saved, tmp_path / "none.csv")[0] == 2
    assert run(targets, targets)[0] == 2
    assert run(saved, write(tmp_path / "empty.csv", ""))[0] == 2
    assert run(saved, write(tmp_path / "bare.csv", DEGREES))[0] == 2
    assert run(saved, targets, "--frame", "moon")[0] == 2
    assert run(saved, targets, "-o", tmp_path / "no" / "folder.csv")[0] == 2
    alone = tmp_path / "cell.json"
    alone.write_text(json.dumps(mc.load_fit(saved).cell.whole()))
    code, _, said = run(alone, targets)
    assert code == 2
    assert f"{alone}: does not tell its nominal robot; give --robot" in said
    assert run(alone, targets, "--robot", "irb2600", "-q")[0] == 0
