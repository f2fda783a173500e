"""One fit from several instruments: what they tell together, and which of them tells what."""

import json
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

import minimax_cal as mc
from experiments.relative import NOISE, SIMULATORS, Arm
from minimax_cal.fitting.several import RelativeCalibration, relative
from minimax_cal.ground.arrays import Array
from minimax_cal.instruments import closures, read_relative, write_relative
from minimax_cal.modelling.model import model_of
from minimax_cal.modelling.start import fit_base
from minimax_cal.robots.kinematics import right_jacobian, rotation, rotation_vector
from minimax_cal.robots.sampling import random_poses

TOOL = np.array([[0.1, 0.0, 0.1], [0.0, 0.1, 0.1], [-0.1, -0.1, 0.2]])
SEEDS = range(6)


def tracker(arm: Arm, rng: np.random.Generator, poses: int, noise: float) -> mc.Measurements:
    q = random_poses(arm.robot, poses, rng)
    turn, shift = Rotation.random(rng=rng).as_matrix(), rng.normal(size=3)
    return mc.measurements(q, arm.place(q) @ turn.T + shift + noise * rng.normal(size=(poses, 3)))


def missed(arm: Arm, robot: mc.Robot) -> float:
    """RMS error of fresh poses of three points of a tool, base and tool fitted [mm]."""
    q = random_poses(arm.robot, 300, np.random.default_rng(98))
    pose = arm.real.pose(q)
    y = np.einsum("mij,kj->mki", pose[:, :3, :3], TOOL) + pose[:, None, :3, 3]
    fit = fit_base(model_of(robot, mc.measurements(q, y)), robot.mdh)
    return float(1e3 * np.sqrt(fit.mean_square))


@cache
def errors(name: str, seed: int) -> tuple[float, ...]:
    """Of the tracker, sockets, wires, tracker and sockets, tracker and wires."""
    arm, rng = Arm.of(name, seed, 0.0), np.random.default_rng([seed, 77])
    seen = tracker(arm, rng, 60, NOISE)
    sockets = SIMULATORS["closures_known"](arm, rng, 60, NOISE)
    wires = SIMULATORS["wires_3"](arm, rng, 60, NOISE).data
    known = {"known_distances": sockets.known}
    alone = mc.calibrate(arm.robot, seen, objective="sum", simulated=True)
    fits = (
        alone,
        relative(arm.robot, sockets.data, **known),
        relative(arm.robot, wires),
        relative(arm.robot, [seen, sockets.data], **known),
        relative(arm.robot, [seen, wires]),
    )
    return tuple(missed(arm, fit.robot) for fit in fits)


@pytest.mark.parametrize("name", ["irb2600", "ur10"])
def test_two_instruments_are_better_than_either(name):
    found = np.array([errors(name, seed) for seed in SEEDS])
    with_sockets = found[:, 3] / np.minimum(found[:, 0], found[:, 1])
    with_wires = found[:, 4] / np.minimum(found[:, 0], found[:, 2])
    assert with_sockets.max() < 1.03
    # as good as a tracker each, so that the better of two draws is often better than the mean says
    assert with_wires.max() < 1.2
    assert np.median(with_sockets) < 0.9
    assert np.median(with_wires) < 0.85


def test_a_rough_instrument_does_not_spoil_a_fine_one():
    """Each counts by its own noise: alike, wires 13 times as rough would triple the error."""
    ratios = []
    for seed in SEEDS:
        arm, rng = Arm.of("irb2600", seed, 0.0), np.random.default_rng([seed, 78])
        seen = tracker(arm, rng, 60, NOISE)
        wires = SIMULATORS["wires_3"](arm, rng, 60, 200e-6).data
        fit = relative(arm.robot, [seen, wires])
        noises = {one.kind: one.noise for one in fit.instruments}
        assert noises["points"] == pytest.approx(NOISE, rel=0.25)
        assert noises["distances"] == pytest.approx(200e-6, rel=0.25)
        alone = mc.calibrate(arm.robot, seen, objective="sum", simulated=True)
        ratios.append(missed(arm, fit.robot) / missed(arm, alone.robot))
    assert max(ratios) < 1.1
    assert np.median(ratios) < 1.02


def test_a_noise_that_is_given_counts_instead_of_the_residuals():
    arm, rng = Arm.of("irb2600", 2, 0.0), np.random.default_rng(3)
    seen, wires = tracker(arm, rng, 40, NOISE), SIMULATORS["wires_3"](arm, rng, 60, NOISE).data
    plain = relative(arm.robot, [seen, wires])
    told = relative(arm.robot, [seen, wires], noises={"distances": "0.3mm"})
    assert [one.noise for one in told.instruments][1] == pytest.approx(3e-4, rel=1e-9)
    sigmas = ({p.name: p.sigma for p in fit.parameters} for fit in (plain, told))
    before, after = (sigma["distances.anchor1_x"] for sigma in sigmas)
    assert after > 5.0 * before
    for noises, words in (
        ({"wire": 1e-4}, "noise wire: no file is called so; they are points, distances"),
        ({"points": -1.0}, "must be positive"),
        ({"points": "1 rad"}, "write FILE=SIGMA in mm"),
    ):
        with pytest.raises(mc.OptionError, match=words):
            relative(arm.robot, [seen, wires], noises=noises)


@cache
def all_kinds() -> tuple[Arm, RelativeCalibration]:
    arm, rng = Arm.of("ur10", 3, 0.0), np.random.default_rng(6)
    kinds = ("closures", "wires_1", "poses")
    data = [SIMULATORS[kind](arm, rng, 60, NOISE).data for kind in kinds]
    return arm, relative(arm.robot, [tracker(arm, rng, 40, NOISE), *data])


def test_sigmas_are_the_scatter_of_fits_together():
    z = []
    for seed in SEEDS:
        arm = Arm.of("irb2600", seed, 0.0)
        fits = []
        for noise in (0.0, NOISE):
            rng = np.random.default_rng([seed, 9])
            kinds = ("closures", "wires_1")
            data = [SIMULATORS[kind](arm, rng, 60, noise).data for kind in kinds]
            fits.append(relative(arm.robot, [tracker(arm, rng, 30, noise), *data]))
        clean, noisy = fits
        pairs = zip(noisy.parameters, clean.parameters, strict=True)
        z += [
            (a.value - b.value) / a.sigma
            for a, b in pairs
            if a.identifiable and b.identifiable and "base" not in a.name
        ]
    assert 0.75 < np.sqrt(np.mean(np.square(z))) < 1.25  # some 200 correlated numbers


def test_without_noise_all_kinds_together_find_the_true_arm():
    arm, rng = Arm.of("ur10", 3, 0.0), np.random.default_rng(6)
    kinds = ("closures", "wires_1", "poses")
    data = [SIMULATORS[kind](arm, rng, 60, 0.0).data for kind in kinds]
    fit = relative(arm.robot, [tracker(arm, rng, 40, 0.0), *data])
    assert fit.status == "converged"
    assert missed(arm, fit.robot) < 1e-5
    assert all(one.accuracy["holdout"].max_mm < 1e-5 for one in fit.instruments)


def test_what_only_one_instrument_determines_is_said():
    """A tracker that saw the last joints still gives the base, and wires alone see the wrist."""
    arm, rng = Arm.of("irb2600", 0, 0.0), np.random.default_rng(4)
    sockets = SIMULATORS["closures"](arm, rng, 60, NOISE).data
    q = random_poses(arm.robot, 60, rng)
    q[:, 3:] = q[0, 3:]
    seen = mc.measurements(q, arm.place(q) + NOISE * rng.normal(size=(60, 3)))
    fit = relative(arm.robot, [seen, sockets])
    told = {one.name: one for one in fit.instruments}
    assert "a5" in told["closures"].alone  # the tracker saw no turn of the wrist
    assert told["points"].directions_alone == 1  # the scale, which no closure has
    lengths = {name for name in told["points"].alone if name[0] in "ad" and name[1].isdigit()}
    assert {"a2", "d4"} <= lengths
    assert not {name for name in told["points"].alone if name.startswith("theta")}
    table = fit.alone_table().text(110)
    assert "closures" in table
    assert "a5" in table


def test_the_result_lists_each_file_and_comes_back(tmp_path):
    _, fit = all_kinds()
    assert [one.name for one in fit.instruments] == ["points", "closures", "distances", "poses"]
    path = tmp_path / "fit.json"
    fit.save(path)
    content = json.loads(path.read_text())
    assert content["measured"] == "several"
    for one in content["instruments"]:
        held = one["accuracy"]["holdout"]
        low, high = held["rms_ci95_mm"]
        assert low < held["rms_mm"] < high
        assert held["rms_mm"] < 0.1 * one["accuracy"]["nominal"]["rms_mm"]
        assert one["noise"] == pytest.approx(1e3 * NOISE, rel=0.5)
    again = RelativeCalibration.from_dict(content)
    assert [one.name for one in again.instruments] == [one.name for one in fit.instruments]
    assert again.files_table().text(100) == fit.files_table().text(100)
    assert_allclose(mc.load_robot(path).mdh, fit.robot.mdh, rtol=0, atol=1e-12)
    report = mc.report(path, tmp_path / "report.html")
    assert "only by" in Path(report).read_text()


def test_files_are_one_fit_and_named_by_their_stems(tmp_path):
    arm, rng = Arm.of("irb2600", 1, 0.0), np.random.default_rng(2)
    seen, sockets = tracker(arm, rng, 40, NOISE), SIMULATORS["closures"](arm, rng, 60, NOISE).data
    mc.write_measurements(tmp_path / "tracker.csv", seen)
    write_relative(tmp_path / "sockets.csv", sockets)
    files = [tmp_path / "tracker.csv", tmp_path / "sockets.csv"]
    fit = relative(arm.robot, files)
    assert [one.name for one in fit.instruments] == ["tracker", "sockets"]
    assert {"tracker.base_x", "tracker.smr1_x", "sockets.target_x"} <= {
        p.name for p in fit.parameters
    }
    assert read_relative(files[0]).kind == "points"
    # the order of files is no matter
    other = relative(arm.robot, files[::-1])
    assert_allclose(other.robot.mdh, fit.robot.mdh, rtol=0, atol=1e-8)


def test_a_slip_in_one_of_several_files_is_named():
    arm, rng = Arm.of("irb2600", 1, 0.0), np.random.default_rng(2)
    seen, sockets = tracker(arm, rng, 40, NOISE), SIMULATORS["closures"](arm, rng, 60, NOISE).data
    metres = mc.measurements(seen.q, 1e-3 * seen.y)
    with pytest.raises(mc.DataError, match="points look like metres given as millimetres"):
        relative(arm.robot, [metres, sockets])
    turned = closures(sockets.at.q * [1, 1, -1, 1, 1, 1], sockets.socket)
    with pytest.raises(mc.DataError, match="the sign of joint 3 looks reversed"):
        relative(arm.robot, [seen, turned])
    with pytest.raises(mc.DataError, match="use minimax-cal calibrate"):
        relative(arm.robot, [seen])
    with pytest.raises(mc.DataError, match="no file of measurements"):
        relative(arm.robot, [])
    with pytest.raises(mc.OptionError, match=r"offset= is for distances; .* holds points and "):
        relative(arm.robot, [seen, sockets], offset=True)


def test_the_right_jacobian_is_the_derivative_of_the_turn(rng):
    for size in (0.0, 1e-6, 0.3, 2.0):
        w = size * rng.normal(size=3)
        numbers: list[Array] = []
        for step in 1e-6 * np.eye(3):
            after, before = (
                rotation_vector(rotation(w).T @ rotation(w + sign * step)) for sign in (1, -1)
            )
            numbers.append((after - before) / 2e-6)
        assert_allclose(right_jacobian(w), np.array(numbers).T, rtol=0, atol=1e-9)
