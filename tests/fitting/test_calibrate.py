import json
from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

import minimax_cal as mc
from minimax_cal.fitting.solve import fit_cell
from minimax_cal.modelling.simulate import Truth, simulate


def test_true_robot_is_found_without_noise(robot, clean):
    fit = mc.calibrate(robot, clean.data, "sum")
    assert fit.status == "converged"
    assert fit.accuracy["holdout"].max_mm < 1e-8
    assert fit.accuracy["nominal"].rms_mm > 0.5
    new = np.random.default_rng(0).uniform(-2, 2, (50, 6))
    assert_allclose(fit.predict(new), clean.cell.predict(new), rtol=0, atol=1e-10)


def test_each_accuracy_is_of_its_own_rows(robot, noisy):
    """Nominal and calibrated, trained and held out: none stands in the place of another."""
    fit = mc.calibrate(robot, noisy.data, "sum", holdout=0.3)
    for name, cell, rows in (
        ("nominal", fit.nominal, fit.held),
        ("nominal_train", fit.nominal, ~fit.held),
        ("holdout", fit.cell, fit.held),
        ("train", fit.cell, ~fit.held),
    ):
        away = noisy.data.y[rows] - cell.predict(noisy.data.q[rows])
        found = fit.accuracy[name]
        assert found.poses == rows.sum()
        assert_allclose(found.rms_mm, 1e3 * np.sqrt((away**2).sum(-1).mean()), rtol=1e-9)
        assert_allclose(found.max_mm, 1e3 * np.sqrt((away**2).sum(-1).max()), rtol=1e-9)
    assert len({fit.accuracy[name].rms_mm for name in fit.accuracy}) == 4


def test_minimax_lowers_the_largest_sum(robot, noisy):
    total = mc.calibrate(robot, noisy.data, "sum")
    worst = mc.calibrate(robot, noisy.data, "minimax")
    assert max(worst.accuracy["train"].sse_mm2) < max(total.accuracy["train"].sse_mm2)
    assert sum(worst.accuracy["train"].sse_mm2) > sum(total.accuracy["train"].sse_mm2)
    # measured by the public errors, not by the solver's own account
    solved = fit_cell(robot, worst.train, worst.options)
    f = np.array(worst.accuracy["train"].sse_mm2) / np.array(worst.accuracy["train"].counts)
    assert_allclose(f / f.max(), solved.optimum.f / solved.optimum.f.max(), rtol=1e-9)
    assert_allclose(worst.minimax.size, worst.accuracy["train"].sse_mm2)


def test_pose_objective_trades_position_for_orientation(robot, noisy):
    from experiments.poses import orientation_error, poses_of, triangle

    def turn(fit: mc.Fit) -> float:
        measured = noisy.data.y
        shape = triangle(measured)
        pose = [poses_of(shape, y) for y in (measured, fit.predict(noisy.data.q))]
        return float(np.sqrt(np.mean(orientation_error(*pose) ** 2)))

    total = mc.calibrate(robot, noisy.data, "sum", holdout=0.0)
    own = mc.calibrate(robot, noisy.data, "pose", holdout=0.0)
    wide = mc.calibrate(robot, noisy.data, "pose", holdout=0.0, lever=3.0)
    assert own.status == wide.status == "converged"
    assert turn(wide) < turn(own) < 1.02 * turn(total)
    assert wide.accuracy["train"].rms_mm > total.accuracy["train"].rms_mm
    assert own.accuracy["train"].rms_mm < 1.02 * total.accuracy["train"].rms_mm


def test_pose_needs_a_triangle(robot, noisy):
    two = noisy.data.keep(np.array([True, True, False]))
    with pytest.raises(mc.OptionError, match="three targets"):
        mc.calibrate(robot, two, "pose")


def test_worst_point_is_lowered(robot, noisy):
    total = mc.calibrate(robot, noisy.data, "sum")
    point = mc.calibrate(robot, noisy.data, "point")
    assert point.status == "converged"
    assert point.accuracy["train"].max_mm < 0.8 * total.accuracy["train"].max_mm
    table = point.minimax.table()
    assert "line" in str(table.rows[0][0])
    assert table.rows[0][1] == pytest.approx(point.accuracy["train"].max_mm, rel=1e-6)
    # a certificate: no direction lowers all active points, since the multipliers balance them
    assert point.minimax.kkt.residual < 1e-6
    assert point.minimax.multiplier.sum() == pytest.approx(1.0)


def test_single_target_objective_fits_that_target_alone(robot, noisy):
    fit = mc.calibrate(robot, noisy.data, "smr:2", holdout=0.0)
    alone = mc.calibrate(robot, noisy.data.only(1), "sum", holdout=0.0)
    assert_allclose(fit.accuracy["train"].sse_mm2[1], alone.accuracy["train"].sse_mm2[0], rtol=1e-6)
    total = mc.calibrate(robot, noisy.data, "sum", holdout=0.0)
    assert fit.accuracy["train"].sse_mm2[1] < total.accuracy["train"].sse_mm2[1]
    assert fit.accuracy["train"].sse_mm2[0] > total.accuracy["train"].sse_mm2[0]


def test_targets_measured_at_different_poses(robot):
    """One reflector a pose: F_i / m_i is compared, and no distance row exists."""
    made = simulate(robot, 120, 3, seed=11)
    y = np.full_like(made.data.y, np.nan)
    which = np.random.default_rng(0).choice(3, 120, p=(0.5, 0.3, 0.2))
    y[np.arange(120), which] = made.data.y[np.arange(120), which]
    fit = mc.calibrate(robot, made.data.with_y(y), "minimax")
    a = fit.accuracy["train"]
    assert len(set(a.counts)) == 3
    optimum = fit_cell(robot, fit.train, fit.options).optimum
    ratio = np.array(a.sse_mm2) / np.array(a.counts)
    assert_allclose(ratio / ratio.max(), optimum.f / optimum.f.max(), rtol=1e-9)
    assert len(fit.distances.mean) == 0
    assert fit.accuracy["holdout"].rms_mm < 0.6 * fit.accuracy["nominal"].rms_mm


def test_sigma_is_the_scatter_over_repeated_measurements(robot):
    """Pooled z-scores over 30 x 33 parameters: their mean square is one within 5 sigma."""
    truth = Truth(compliance=0)
    scores = []
    for seed in range(30):
        made = simulate(robot, 40, 3, seed, truth)
        fit = mc.calibrate(robot, made.data, "sum", holdout=0.0)
        # a noise-free run of the same cell gives the values that the noise disturbs
        perfect = made.data.with_y(made.cell.predict(made.data.q))
        exact = mc.calibrate(robot, perfect, "sum", holdout=0.0)
        for noisy, true in zip(fit.parameters, exact.parameters, strict=True):
            if noisy.identifiable and not noisy.name.startswith("base_r"):
                scores.append((noisy.value - true.value) / noisy.sigma)
    square = np.mean(np.square(scores))
    assert abs(square - 1.0) < 5 * np.sqrt(2 / len(scores)) * 2  # parameters correlate: twice


def test_fixed_parameters_stay_and_freed_ones_are_kept(robot, noisy):
    fit = mc.calibrate(robot, noisy.data, "sum", fix="a*, beta2", free=["d1"])
    by_name = {p.name: p for p in fit.parameters}
    assert by_name["alpha2"].identifiable  # a* is every a, not every name with an a in front
    assert by_name["a2"].value == by_name["a2"].nominal == 0.9
    assert np.isnan(by_name["a2"].sigma)
    assert by_name["a2"].reason == "fixed by the user"
    assert by_name["d1"].identifiable
    assert not by_name["base_z"].identifiable
    free = mc.calibrate(robot, noisy.data, "sum", free=["d1", "theta1"])
    plain = mc.calibrate(robot, noisy.data, "sum")
    assert_allclose(free.accuracy["holdout"].rms_mm, plain.accuracy["holdout"].rms_mm, rtol=1e-9)


def test_fixing_every_link_leaves_base_and_targets(robot, noisy):
    fit = mc.calibrate(robot, noisy.data, "sum", fix=["*"])
    assert sum(p.identifiable for p in fit.parameters) == 15
    assert_allclose(fit.accuracy["train"].rms_mm, fit.accuracy["nominal_train"].rms_mm, rtol=1e-9)


def test_parameters_that_are_not_identified_keep_their_value():
    for name in ("scara_600", "irb2600"):
        robot = mc.load_robot(name)
        fit = mc.calibrate(robot, simulate(robot, 60, 3, seed=4).data, free=["d1"])
        for p in fit.parameters:
            assert p.identifiable or p.value == p.nominal


def test_priors_help_when_poses_are_few(robot):
    made = simulate(robot, 60, 1, seed=12, truth=Truth(compliance=0, noise=2e-4))
    few = made.data.take(np.arange(11))
    rest = made.data.take(np.arange(11, 60))
    priors = {"a*": 0.5e-3, "d*": 0.5e-3, "theta*": 1e-3, "alpha*": 1e-3, "beta*": 1e-3}
    plain = mc.calibrate(robot, few, "sum", holdout=0.0)
    held = mc.calibrate(robot, few, "sum", holdout=0.0, priors=priors)
    worse, better = (mc.evaluate(fit.cell, rest).rms_mm for fit in (plain, held))
    assert better < 0.8 * worse
    too_few = made.data.take(np.arange(4))
    with pytest.raises(mc.DataError, match="give priors"):
        mc.calibrate(robot, too_few, "sum", holdout=0.0)
    assert mc.calibrate(robot, too_few, "sum", holdout=0.0, priors=priors).status == "converged"


def test_targets_that_follow_weigh_no_prior(robot, noisy):
    """smr:K is the calibration of that target alone, with priors too."""
    priors = {"a*": 1e-4, "d*": 1e-4, "theta*": 1e-4, "alpha*": 1e-4, "beta*": 1e-4}
    one = mc.calibrate(robot, noisy.data, "smr:1", priors=priors)
    alone = mc.calibrate(robot, noisy.data.only(0), "sum", priors=priors)
    told, known = (fit.estimator.model.prior.weight for fit in (one, alone))
    assert_allclose(told[told > 0.0], known[known > 0.0], rtol=0.01)  # where the rounds end
    assert_allclose(one.robot.mdh, alone.robot.mdh, rtol=0, atol=1e-6)


def test_a_tight_prior_pins_and_a_wide_one_does_nothing(robot, noisy):
    plain = mc.calibrate(robot, noisy.data, "sum", holdout=0.0)
    wide = mc.calibrate(robot, noisy.data, "sum", holdout=0.0, priors={"a2": 1e3})
    tight = mc.calibrate(robot, noisy.data, "sum", holdout=0.0, priors={"a2": 1e-9})
    value = {
        key: next(p for p in fit.parameters if p.name == "a2")
        for key, fit in (("plain", plain), ("wide", wide), ("tight", tight))
    }
    assert_allclose(value["wide"].value, value["plain"].value, atol=1e-10)
    assert_allclose(value["tight"].value, 0.9, atol=1e-9)
    assert value["tight"].sigma < 1e-3 * value["plain"].sigma


def test_minimax_takes_priors_too(robot, noisy):
    fit = mc.calibrate(robot, noisy.data, "minimax", priors={"a2": 1e-9})
    assert fit.status == "converged"
    assert_allclose(next(p.value for p in fit.parameters if p.name == "a2"), 0.9, atol=1e-8)


def test_u95_weights_the_fit(robot):
    made = simulate(robot, 80, 3, seed=13, truth=Truth(compliance=0))
    rng = np.random.default_rng(0)
    bad = np.arange(80) % 4 == 0
    y = made.data.y + bad[:, None, None] * 1e-3 * rng.normal(size=made.data.y.shape)
    blind = made.data.with_y(y)
    u95 = np.where(bad, 2e-3, 3e-5)
    told = replace(blind, columns={**blind.columns, "u95": u95})
    new = np.random.default_rng(1).uniform(-2, 2, (200, 6))
    truth = made.cell.predict(new)
    miss = [
        np.sqrt(((mc.calibrate(robot, d, "sum").predict(new) - truth) ** 2).mean())
        for d in (blind, told)
    ]
    assert miss[1] < 0.2 * miss[0]


def test_saved_fit_comes_back(robot, noisy, tmp_path):
    fit = mc.calibrate(robot, noisy.data)
    fit.save(tmp_path / "fit.json")
    cell = mc.load_cell(tmp_path / "fit.json")
    again = mc.evaluate(cell, noisy.data)
    assert_allclose(again.rms_mm, mc.evaluate(fit.cell, noisy.data).rms_mm, rtol=1e-9)
    # the calibrated robot is a robot: usable wherever one is
    assert_allclose(mc.load_robot(tmp_path / "fit.json").mdh, fit.robot.mdh, atol=1e-15)
    content = json.loads((tmp_path / "fit.json").read_text())
    assert content["schema"] == 1
    assert {"robot", "objective", "qp", "status", "iterations", "seconds"} <= set(content)
    for p in content["parameters"]:
        assert {"name", "value", "nominal", "sigma", "unit", "identifiable"} <= set(p)
        assert (p["sigma"] is None) == (not p["identifiable"])
        if not p["identifiable"]:
            assert p["value"] == pytest.approx(p["nominal"], abs=1e-12)
    assert set(content["accuracy"]) == {
        "nominal",
        "train",
        "holdout",
        "nominal_train",
        "holdout_trusted",
        "beyond",
        "cv",
    }


def test_no_holdout_is_said(robot, noisy):
    fit = mc.calibrate(robot, noisy.data, holdout=0.0)
    assert any("no pose is held out" in note for note in fit.notices)
    assert fit.to_dict()["accuracy"]["holdout"]["rms_mm"] is None
    assert "none was held out" in fit.headline()


def test_one_target_says_that_minimax_is_the_sum(robot):
    data = simulate(robot, 60, 1, seed=2).data
    fit = mc.calibrate(robot, data, "minimax")
    assert any("minimax and sum are the same" in note for note in fit.notices)
    assert fit.accuracy == mc.calibrate(robot, data, "sum").accuracy


def test_collinear_targets_are_a_notice(robot):
    made = simulate(robot, 60, 3, seed=2)
    spots = np.outer([0.0, 0.1, 0.25], [1.0, 0.0, 0.2])
    cell = replace(made.cell, target_positions=spots)
    fit = mc.calibrate(robot, made.data.with_y(cell.predict(made.data.q)))
    assert any("nearly on a line" in note for note in fit.notices)
    assert fit.accuracy["holdout"].max_mm < 1e-6


@pytest.mark.parametrize(
    ("options", "say"),
    [
        ({"objective": "median"}, "no objective 'median'"),
        ({"objective": "smr:7"}, "no target smr7"),
        ({"qp": "dacp"}, "daqp"),
        ({"fix": ["theta9"]}, "no parameter called 'theta9'"),
        ({"fix": ["d1"], "free": ["d1"]}, "both fixed and freed"),
        ({"priors": {"base_x": 1e-3}}, "no nominal value"),
        ({"fix": ["base_x"]}, "no nominal value"),
        ({"seed": -1}, "seed -1"),
        ({"distance_tolerance": float("inf")}, "distance tolerance inf"),
        ({"priors": {"a2": -1.0}}, "must be positive"),
        ({"holdout": 1.5}, "not a fraction"),
        ({"method": "newton"}, "no method 'newton'"),
        ({"hessian": "exact"}, "no hessian 'exact'"),
        ({"distance": "cubed"}, "no distance form 'cubed'"),
    ],
)
def test_wrong_choices_are_refused(options, say, robot, noisy):  # type: ignore[type-arg]
    with pytest.raises(mc.CalibrationError) as caught:
        mc.calibrate(robot, noisy.data, **options)
    assert say in str(caught.value)


def test_pose_after_a_search_over_base_rotations(robot, noisy):
    """A joint's zero off by a right angle: the search ends with several members at once."""
    off = robot.mdh.copy()
    off[3, 2] += np.pi / 2
    fit = mc.calibrate(robot.with_mdh(off), noisy.data, "pose")
    assert fit.accuracy["holdout"].rms_mm < fit.accuracy["nominal"].rms_mm


def test_a_holdout_that_leaves_nothing_is_refused(robot, noisy):
    with pytest.raises(mc.OptionError, match=r"\b60\b"):
        mc.calibrate(robot, noisy.data, holdout=0.995)


@pytest.mark.parametrize("objective", ["sum", "minimax", "point", "pose"])
def test_exact_data_are_a_success(objective, robot, clean):
    fit = mc.calibrate(robot, clean.data, objective)
    assert fit.status == "converged"
    assert fit.accuracy["holdout"].max_mm < 1e-6


def test_only_offsets_leave_the_rest_as_drawn(noisy, robot):
    fit = mc.calibrate(robot, noisy.data, "sum", only="offsets")
    change = fit.robot.mdh - robot.mdh
    assert np.flatnonzero(np.abs(change).max(axis=0)).tolist() == [2]  # theta
    known = [p.name for p in fit.parameters if p.identifiable and p.name[-1].isdigit()]
    assert known == ["theta2", "theta3", "theta4", "theta5"]
    assert fit.options.only == "offsets"
    fixed = [f"{kind}{j}" for kind in ("a", "d", "alpha", "beta") for j in range(1, 7)]
    same = mc.calibrate(robot, noisy.data, "sum", fix=fixed)
    assert (same.robot.mdh == fit.robot.mdh).all()
    with pytest.raises(mc.OptionError, match=r"lengths.*offsets"):
        mc.calibrate(robot, noisy.data, only="lengths")


@pytest.mark.parametrize("sigma", ["1e-300mm", "1e300mm"])
def test_a_prior_that_says_nothing_is_refused(robot, noisy, sigma):
    with pytest.raises(mc.OptionError, match=r"\ba2\b.*sigma"):
        mc.calibrate(robot, noisy.data, priors={"a2": sigma})
