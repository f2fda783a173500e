"""Calibration without coordinates with what is known of the links: sockets, wires, poses."""

import json
from collections.abc import Mapping
from functools import cache

import numpy as np
import pytest
from numpy.testing import assert_allclose

import minimax_cal as mc
from minimax_cal.cli.running import outcome
from minimax_cal.fitting.several.result import RelativeCalibration
from minimax_cal.instruments import closures, distances, flange_poses
from minimax_cal.instruments.closing import reach
from minimax_cal.instruments.instrument import Instrument
from minimax_cal.modelling.simulate import Truth, simulate
from minimax_cal.robots.robot import robot_from_dict

QUARTER = np.pi / 2
PANDA = robot_from_dict(
    {
        "name": "panda", "convention": "modified", "units": {"length": "m", "angle": "rad"},
        "joints": [
            {"a": a, "d": d, "theta": 0.0, "alpha": alpha}
            for a, d, alpha in (
                (0.0, 0.333, 0.0), (0.0, 0.0, -QUARTER), (0.0, 0.316, QUARTER),
                (0.0825, 0.0, QUARTER), (-0.0825, 0.384, -QUARTER), (0.0, 0.0, QUARTER),
                (0.088, 0.107, QUARTER),
            )
        ],
    },
    "panda",
)  # fmt: skip
PRIOR = {"a*": "5mm", "d*": "5mm", "theta*": "20mrad", "alpha*": "20mrad", "beta*": "20mrad"}
BALL = np.array([0.03, -0.02, 0.1])
HOME = np.array([0.0, 0.3, 0.0, -1.9, 0.0, 2.2, 0.8])
SOCKETS, VISITS, TILT = 11, 4, 0.08  # a plate, four visits each that hardly turn the flange
JITTER, GAUGE = 1e-4, 20e-6  # of a joint [rad], of a known distance [m]


@cache
def plate(seed: int) -> tuple[mc.Robot, np.ndarray, list[str], list[tuple[str, str, float]]]:
    """A true arm, joints that hold the ball in eleven sockets, labels, three known distances."""
    rng = np.random.default_rng(seed)
    error = rng.normal(size=(7, 5)) * ([5e-3] * 2 + [20e-3] * 3)
    true = PANDA.with_mdh(PANDA.mdh + error)
    pose = true.pose(HOME[None])[0]
    centre = pose[:3, :3] @ BALL + pose[:3, 3]
    spots = centre + np.append(rng.uniform(-0.2, 0.2, (SOCKETS, 2)), np.zeros((SOCKETS, 1)), 1)
    joints, labels = [], []
    for number, spot in enumerate(spots):
        start = HOME + TILT * rng.normal(size=(3 * VISITS, 7))
        q, gap = reach(true, BALL, np.repeat(spot[None], len(start), axis=0), start)
        q = q[gap < 1e-9][:VISITS]
        joints.append(q + JITTER * rng.normal(size=q.shape))
        labels += [f"S{number}"] * len(q)
    known = [
        (f"S{a}", f"S{b}", float(np.linalg.norm(spots[a] - spots[b]) + GAUGE * rng.normal()))
        for a, b in ((0, 3), (1, 4), (2, 5))
    ]
    return true, np.concatenate(joints), labels, known


def fitted(seed: int, priors: Mapping[str, float | str] | None) -> RelativeCalibration:
    _, q, labels, known = plate(seed)
    return mc.relative(PANDA, closures(q, labels), known_distances=known, priors=priors)


def off(seed: int, robot: mc.Robot, ball: np.ndarray) -> float:
    """RMS error of positions about the plate once a base is fitted [m]."""
    q = HOME + 0.5 * np.random.default_rng(99).uniform(-1.0, 1.0, (200, 7))
    both = []
    for arm, spot in ((plate(seed)[0], BALL), (robot, ball)):
        pose = arm.pose(q)
        points = pose[:, :3, :3] @ spot + pose[:, :3, 3]
        both.append(points - points.mean(axis=0))
    u, _, v = np.linalg.svd(both[1].T @ both[0])
    turn = u @ np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ v))]) @ v
    return float(np.sqrt(((both[0] - both[1] @ turn) ** 2).sum(axis=1).mean()))


@pytest.mark.parametrize("seed", range(4))
def test_a_weak_prior_brings_a_panda_home_from_a_plate_of_sockets(seed):
    with_prior, plain = fitted(seed, PRIOR), fitted(seed, None)
    assert str(with_prior.status) == "converged"
    balls = [1e-3 * np.array(fit.instrument["target_mm"]) for fit in (with_prior, plain)]
    errors = [off(seed, f.robot, b) for f, b in zip((with_prior, plain), balls, strict=True)]
    assert errors[0] < 1.2 * errors[1]
    assert errors[0] < 0.5 * off(seed, PANDA, BALL)
    links = [p for p in with_prior.parameters if p.name[0] == "d" and p.identifiable]
    assert all(abs(p.value - p.nominal) < 4.0 * 5e-3 for p in links)  # four sigmas
    assert all(0.0 < p.sigma <= 5e-3 for p in links)


def test_a_firm_prior_keeps_the_drawing():
    firm = fitted(0, {"a*": 1e-9, "d*": 1e-9})
    for p in firm.parameters:
        if p.name[0] in "ad" and not p.name.startswith("alpha") and p.identifiable:
            assert abs(p.value - p.nominal) < 1e-8
            assert 0.0 < p.sigma < 2e-9


def wires() -> tuple[mc.Simulation, Instrument]:
    made = mc.simulate("irb2600", 60, 1, 2)
    point = made.cell.predict(made.data.q)[:, 0]
    anchors = np.array([[2.0, 0.0, 0.0], [0.0, 2.0, 1.0], [-1.0, -1.0, 2.0]])
    length = np.linalg.norm(point[:, None] - anchors, axis=-1)
    length = length + 15e-6 * np.random.default_rng(0).normal(size=length.shape)
    return made, distances(made.data.q, length)


def test_a_loose_prior_says_nothing():
    _, data = wires()
    loose, plain = (mc.relative("irb2600", data, priors=p) for p in ({"theta*": 1e3}, None))
    for one, other in zip(loose.parameters, plain.parameters, strict=True):
        assert_allclose(one.value, other.value, rtol=0, atol=1e-7)
        assert_allclose(one.sigma, other.sigma, rtol=1e-3)


def test_wires_and_poses_take_priors_too():
    made, lengths = wires()
    q = made.data.q
    pose = made.cell.base @ made.cell.robot.pose(q)
    for data in (lengths, flange_poses(q, pose)):
        fit = mc.relative("irb2600", data, priors={"alpha*": 1e-9})
        kept = [p for p in fit.parameters if p.name.startswith("alpha") and p.identifiable]
        assert kept
        assert all(abs(p.value - p.nominal) < 1e-7 for p in kept)


def test_what_no_prior_can_be_is_refused():
    with pytest.raises(mc.OptionError, match=r"target_x: .* have no nominal value to keep"):
        fitted(0, {"target_x": 1e-3})
    with pytest.raises(mc.OptionError, match="must be positive"):
        fitted(0, {"a2": -1.0})


def test_a_distance_that_no_prior_allows_is_refused():
    _, q, labels, known = plate(0)
    wrong = [(*known[0][:2], known[0][2] + 0.5), *known[1:]]
    with pytest.raises(mc.OptionError, match="check the labels and the length"):
        mc.relative(PANDA, closures(q, labels), known_distances=wrong, priors=PRIOR)


def test_the_command_takes_priors(tmp_path, capsys):
    _, q, labels, known = plate(2)
    head = ",".join([*(f"q{j + 1}_rad" for j in range(7)), "socket"])
    pairs = zip(q.tolist(), labels, strict=True)
    rows = [",".join([*map(repr, row), label]) for row, label in pairs]
    (tmp_path / "sockets.csv").write_text("\n".join([head, *rows]))
    (tmp_path / "panda.json").write_text(json.dumps(PANDA.to_dict()))
    given = [f"--known-distance={a},{b},{1e3 * length!r}" for a, b, length in known]
    priors = [f"--prior={name}={sigma}" for name, sigma in PRIOR.items()]
    files = [str(tmp_path / "panda.json"), str(tmp_path / "sockets.csv")]
    assert outcome(["relative", *files, *given, *priors]) == 0
    assert "converged" in capsys.readouterr().out


# ---- priors of links that points tell together alone -------------------------------------------


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("seen", ["tracker", "poses"])
def test_of_links_that_move_alike_priors_tell_each(seen, seed):
    """d2 and d3 of parallel axes: their sum is measured, their difference is what priors say.

    With equal priors s each gets half of the sum, and the sigma s / sqrt(2).
    """
    prior = {"d2": "0.4mm", "d3": "0.4mm"}
    truth = Truth(compliance=0.0, length=0.4e-3)
    robot = mc.load_robot("irb2600")
    made = simulate(robot, poses=60, targets=2, seed=seed, truth=truth)
    if seen == "tracker":
        fit = mc.calibrate(robot, made.data, objective="sum", priors=prior)
    else:
        pose = made.cell.robot.pose(made.data.q)
        pose[:, :3, 3] += 15e-6 * np.random.default_rng(seed).normal(size=(60, 3))
        fit = mc.relative(robot, flange_poses(made.data.q, pose), priors=prior)
    one, other = (next(p for p in fit.parameters if p.name == name) for name in prior)
    off = [p.value - p.nominal for p in (one, other)]
    true = made.cell.robot.mdh[1:3, 1] - robot.mdh[1:3, 1]
    assert_allclose(off[0], off[1], atol=2e-6)
    assert_allclose([one.sigma, other.sigma], 0.4e-3 / np.sqrt(2.0), rtol=0.02)
    assert np.abs(off - true).max() < 4.0 * one.sigma
