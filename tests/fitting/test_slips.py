"""Slips of whole files: each named before the fit with the mend that does it; sound data pass."""

import re
import shlex
import time
import warnings
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from conftest import run, shared
from numpy.testing import assert_allclose

import minimax_cal as mc
from minimax_cal.fitting.common_scale import estimate_common_length_change, estimate_point_scale
from minimax_cal.fitting.data_slips import (
    check_plausible,
    fit_base_to_nominal,
    warn_of_coarse_joints,
)
from minimax_cal.fitting.unknown_arm import build_rough_robot
from minimax_cal.measuring import file_mistakes
from minimax_cal.measuring.file_mistakes import apply_mends
from minimax_cal.modelling.simulate import Truth, simulate
from minimax_cal.robots.robot import robot_from_dict

ARMS = ("irb2600", "irb120", "ur10", "meca500", "ur5e", "scara_600")


def lost(data: mc.Measurements, row: int) -> mc.Measurements:
    """One point lost by a beam break: all later ones stand a row higher."""
    y = np.delete(data.y, row, axis=0)
    return replace(data.take(np.arange(data.poses - 1)), y=y)


def stale(data: mc.Measurements) -> mc.Measurements:
    y = data.y.copy()
    y[[7, 20, 33]] = y[[6, 19, 32]]
    return data.with_y(y)


def clipped(data: mc.Measurements) -> mc.Measurements:
    q = data.q.copy()
    q[:, 1] = np.minimum(q[:, 1], np.quantile(q[:, 1], 0.85))
    return replace(data, q=q)


SLIPS: dict[str, tuple[Callable[[mc.Measurements], mc.Measurements], str]] = {
    "shifted": (
        lambda d: file_mistakes.with_points_from_rows_ahead(d, 1),
        "one row above its joints; .*shift=-1 -o",
    ),
    "by three": (
        lambda d: file_mistakes.with_points_from_rows_ahead(d, -3),
        "three rows below .*--mend shift=3 -o",
    ),
    "reversed": (file_mistakes.with_points_reversed, "in reverse order; .*--mend reverse -o"),
    "lost": (lambda d: lost(d, 25), "from about this line .*--mend shift=-1@\\d+\\.\\. -o"),
    "stale": (stale, "points are those of the row before .* in 3 rows.*--leave-out 9,22,35 -o"),
    "joints": (
        lambda d: file_mistakes.with_joint_columns_ordered(d, [0, 2, 1, 3, 4, 5]),
        "columns of joints 2 and 3 look swapped; .*--mend joints=1:3:2:4:5:6 -o",
    ),
    "backwards": (
        lambda d: file_mistakes.with_joint_columns_ordered(d, [5, 4, 3, 2, 1, 0]),
        "joint columns look like those of the joints in reverse order",
    ),
    "inches": (lambda d: d.with_y(d.y / 25.4), "look like inches given as mm: .*--units smr=in"),
    "robot in inches": (lambda d: d.with_y(d.y * 25.4), "robot file look like inches"),
    "clipped": (clipped, "joint 2 looks clipped at .* export the joints unclipped"),
}


@pytest.mark.parametrize("name", SLIPS)
def test_a_slip_is_named_with_its_mend(name, robot, noisy):
    make, said = SLIPS[name]
    wrong = make(noisy.data)
    check_plausible(robot, noisy.data)  # what runs for the first time takes its time
    began = time.process_time()
    with pytest.raises(mc.DataError, match=said) as caught:
        mc.calibrate(robot, wrong)
    assert time.process_time() - began < 2.0
    assert "\n" not in str(caught.value)
    if mend := re.search(r"--mend (\S+) ", str(caught.value)):
        right = apply_mends(wrong, [mend[1]])
        check_plausible(robot, right)
        assert right.poses >= noisy.data.poses - 6


COMMANDS = {name: SLIPS[name][0] for name in (
    "shifted", "by three", "reversed", "lost", "stale", "joints", "backwards", "inches", "clipped",
)} | {"inches as metres": lambda d: d.with_y(d.y / 25.4)}  # fmt: skip


@pytest.mark.parametrize("name", COMMANDS)
def test_a_printed_command_mends_the_file(name, noisy, tmp_path, monkeypatch, capsys):
    """As it stands on the screen, in the folder of the file."""
    monkeypatch.chdir(tmp_path)
    good = noisy.data
    robot = mc.load_robot("irb2600")
    mc.write_measurements("good.csv", good)
    mc.write_measurements("wrong.csv", COMMANDS[name](good))
    if name == "inches as metres":
        text = (tmp_path / "wrong.csv").read_text()
        head, _, rest = text.partition("\n")
        (tmp_path / "wrong.csv").write_text(re.sub(r"_([xyz])_mm", r"_\1_m", head) + "\n" + rest)
    capsys.readouterr()
    assert run("calibrate", "irb2600", "wrong.csv", "--simulated", "--quiet") == 2
    said = capsys.readouterr().err
    command = re.search(r"minimax-cal (import .*? -o mended\.csv)", said)
    assert command, said
    assert run(*shlex.split(command[1]), "--quiet") == 0
    check_plausible(robot, mc.read_measurements("mended.csv"))
    assert run("calibrate", "irb2600", "mended.csv", "--simulated", "--quiet") == 0


def test_a_mended_file_calibrates(robot, noisy, tmp_path):
    robot.save(tmp_path / "arm.json")
    wrong, right = tmp_path / "wrong.csv", tmp_path / "right.csv"
    mc.write_measurements(wrong, lost(noisy.data, 25))
    assert run("calibrate", tmp_path / "arm.json", wrong, "--quiet") == 2
    assert run("import", wrong, "--mend", "shift=-1@27..", "-o", right, "--quiet") == 0
    assert run("calibrate", tmp_path / "arm.json", right, "--quiet") == 0
    assert run("import", wrong, "--mend", "shift=x", "--quiet") == 2
    assert run("import", wrong, "--mend", "joints=1:2", "--quiet") == 2


@pytest.mark.parametrize("how", ["", "shift", "shift=0", "shift=1@900..", "joints=1", "scale=-1"])
def test_what_no_mend_is(how, noisy):
    with pytest.raises(mc.OptionError, match="mend="):
        apply_mends(noisy.data, [how])


def test_the_wrong_convention_is_named(noisy, robot):
    standard = robot.to_dict()
    rows = [dict(row) for row in standard["joints"]]
    for key in ("a", "alpha", "beta"):
        for row, before in zip(rows, [{}, *standard["joints"][:-1]], strict=True):
            row[key] = before.get(key, 0.0)
    craig = {**standard, "convention": "modified", "joints": rows}
    check_plausible(robot_from_dict(craig), noisy.data)
    wrong = robot_from_dict({**craig, "convention": "standard"})
    with pytest.raises(mc.DataError, match=r'look like modified \(Craig\'s\) DH; set "convention"'):
        mc.calibrate(wrong, noisy.data)
    with pytest.raises(mc.RobotError, match="is this a table of standard DH"):
        robot_from_dict({**standard, "convention": "modified"})


def test_a_common_scale_that_no_drawing_error_explains():
    robot = mc.load_robot("fanuc_r2000ic_165f")
    good = simulate(robot, 80, 3, seed=3, truth=Truth(length=0.1e-3, angle=0.2e-3, compliance=0))
    assert (
        abs(
            estimate_point_scale(robot, good.data, fit_base_to_nominal(robot, good.data).state).gain
        )
        < 16.0
    )
    with pytest.raises(mc.DataError, match=r"points lie 1\.00\d+ times .*--mend scale=0\.99"):
        mc.calibrate(robot, good.data.with_y(1.003 * good.data.y))


@pytest.mark.parametrize("seed", [0, 3])
def test_a_scale_is_named_only_where_links_cannot_do_it(seed):
    """An arm with a slide whose twists are 36 mrad off: links to the noise, a scale to 2 mm."""
    half, rng = np.pi / 2.0, np.random.default_rng(seed)
    mdh = np.zeros((6, 5))
    mdh[:, 1] = [0.4, 0.15, 0.5, 0.0, 0.0, 0.1]
    mdh[:, 3] = [-half, half, 0.0, -half, half, 0.0]
    slide = np.arange(6) == 2
    robot = replace(build_rough_robot("six joints", mdh, slide), rough=False)
    twists = np.zeros((6, 5))
    twists[:, 3] = 0.036 * rng.choice([-1.0, 1.0], 6)
    q = rng.uniform(-1.0, 1.0, (60, 6)) * np.where(slide, 0.4, 2.0)
    pose = robot.with_mdh(mdh + twists).pose(q)
    spots = np.array([[0.1, 0.0, 0.15], [-0.05, 0.1, 0.15], [-0.05, -0.1, 0.2]])
    y = spots @ np.swapaxes(pose[:, :3, :3], 1, 2) + pose[:, None, :3, 3]
    data = replace(mc.measurements(q, y + 2e-5 * rng.normal(size=y.shape)), sliding=slide)
    fit = mc.calibrate(robot, data, "sum")
    assert fit.status == "converged"
    assert fit.accuracy["holdout"].rms_mm < 2.0 * 0.02 * np.sqrt(3.0)
    with pytest.raises(mc.DataError, match=r"points lie 1\.004\d+ times .*--mend scale=0\.99"):
        mc.calibrate(robot, data.with_y(1.0044 * data.y))


def test_a_fit_that_stretches_every_length_alike_says_so(robot):
    made = simulate(robot, 60, 3, seed=1, truth=Truth(length=0.05e-3, angle=1e-3, compliance=0))
    stretched = made.data.with_y(1.001 * made.data.y)
    with pytest.warns(mc.CalibrationWarning, match=r"changed by the same share, \+0\.(09|1)"):
        mc.calibrate(robot, stretched, "sum")


def test_lengths_that_are_off_at_random_have_no_common_share():
    rng = np.random.default_rng(0)
    drawn = mc.load_robot("irb2600").mdh
    found, sure = np.ones(drawn.shape, dtype=bool), np.zeros((drawn.size,) * 2)
    named = 0
    for _ in range(1000):
        change = rng.normal(size=drawn.shape) * ([0.5e-3] * 2 + [1e-3] * 3)
        named += estimate_common_length_change(drawn, change, found, sure) != 0.0
    assert named < 10  # one in a hundred
    stretched = 1e-3 * drawn * ([1.0] * 2 + [0.0] * 3)
    assert_allclose(estimate_common_length_change(drawn, stretched, found, sure), 1e-3, rtol=1e-9)
    assert (
        estimate_common_length_change(drawn, 0.5 * stretched, found, sure) == 0.0
    )  # a warm arm does so
    unsure = np.diag(np.full(drawn.size, 3e-3**2))
    assert estimate_common_length_change(drawn, stretched, found, unsure) == 0.0


def test_an_arm_that_bends_is_not_told_to_be_seen_in_another_scale():
    """Gravity stretches its fitted lengths by 0.08 to 0.2 %; the errors that it leaves say so."""
    named, shares = 0, []
    for seed in range(4, 64, 6):
        made = simulate("fanuc_r2000ic_165f", 60, 3, 2000 + seed, Truth(compliance=2e-6))
        with warnings.catch_warnings(record=True) as said:
            warnings.simplefilter("always")
            fit = mc.calibrate("fanuc_r2000ic_165f", made.data, "sum", simulated=True)
        named += any("same share" in str(one.message) for one in said)
        told = {p.name: p for p in fit.parameters}
        shares.append(np.mean([told[n].value / told[n].nominal - 1.0 for n in ("a2", "d4")]))
    assert named == 0
    assert np.mean(shares) > 5e-4


def test_rounded_joints_are_noticed_where_rounding_can_cost_what_is_missing(robot, noisy):
    rounded = replace(noisy.data, q=np.radians(np.round(np.degrees(noisy.data.q))))
    said = warn_of_coarse_joints(robot, rounded, check_plausible(robot, rounded))
    assert "joint values are whole degrees" in said
    exact = noisy.cell.predict(rounded.q)  # commanded so: nothing is missing
    assert not warn_of_coarse_joints(
        robot, rounded.with_y(exact), fit_base_to_nominal(robot, rounded.with_y(exact))
    )


def sound(seed: int) -> tuple[mc.Robot, mc.Measurements]:
    """A sound arm: errors of all sizes, levels, whole degrees, a path, a zero far off."""
    rng = np.random.default_rng(seed)
    robot = mc.load_robot(str(rng.choice(ARMS)))
    size = rng.choice([1.0, 2.0, 4.0])
    truth = Truth(length=0.4e-3 * size, angle=0.6e-3 * size, compliance=rng.choice([0.0, 2e-6]))
    made = simulate(robot, int(rng.choice([20, 40, 80])), int(rng.choice([1, 3])), seed, truth)
    q = made.data.q
    way = rng.choice(["random", "degrees", "levels", "path"])
    if way == "degrees":
        q = np.where(robot.prismatic, q, np.radians(np.round(np.degrees(q))))
    elif way == "levels":
        q = np.clip(q, *np.percentile(q, [20, 80], axis=0))
    elif way == "path":
        q = np.linspace(q[0], q[1], len(q)) + 0.1 * (q - q.mean(axis=0))
    noise = rng.normal(0.0, 2e-5, made.data.y.shape)
    data = replace(made.data, q=q, y=made.cell.predict(q) + noise, simulated=False)
    if rng.uniform() < 0.2 and not robot.prismatic[0]:
        q = q.copy()
        q[:, rng.integers(1, 3)] += rng.uniform(-0.1, 0.1)
        data = replace(data, q=q)
    return robot, data


@pytest.mark.parametrize("seeds", [range(12), pytest.param(range(12, 300), marks=pytest.mark.slow)])
def test_sound_data_are_never_refused(seeds):
    for seed in seeds:
        check_plausible(*sound(seed))


@pytest.mark.parametrize("name", ["fanuc_r2000", "irb120", "meca500_r", "qkm_hl6", "ur10_b"])
def test_real_data_are_not_refused(name):
    robot, path = shared(name)
    check_plausible(mc.load_robot(robot), mc.read_measurements(path))
