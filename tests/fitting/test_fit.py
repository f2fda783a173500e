"""A fit and its file: the same to the last digit; results for people."""

import html
import json
import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import minimax_cal as mc
from minimax_cal.core.arrays import Array
from minimax_cal.core.display_text import capitalise_sentence
from minimax_cal.core.files import convert_to_plain_json
from minimax_cal.core.record_fields import (
    derived_field_formats,
    format_record_fields,
    stored_field_formats,
)
from minimax_cal.fitting.set_aside_points import accuracy_with_set_aside
from minimax_cal.measuring.measurements import (
    SET_ASIDE_BY_FILE,
    SET_ASIDE_BY_TOOL,
    SET_ASIDE_BY_USER,
    Measurements,
)
from minimax_cal.measuring.set_aside_points import set_aside_points_named_by_user, set_points_aside
from minimax_cal.modelling.simulate import Simulation, Truth, simulate
from minimax_cal.reporting.html import ReportRequest, build_report, read_report_sources, render_html
from minimax_cal.validation.bootstrap import bootstrap
from minimax_cal.webapp.page_panels import read_fit_summary
from minimax_cal.webapp.sessions import file_version

# ---- fit -----------------------------------------------------------------------------------------


WAYS: dict[str, dict[str, Any]] = {
    "sum": {"objective": "sum"},
    "minimax": {"objective": "minimax"},
    "point": {"objective": "point", "trim": 0.02},
    "pose": {"objective": "pose", "lever": 0.3},
    "smr": {"objective": "smr:2"},
    "effects": {"effects": "joint_compliance:all,backlash:J3"},
    "robust": {"objective": "sum", "loss": "tukey"},
    "prior": {"objective": "sum", "priors": {"a*": 1e-3}, "holdout": 0.0},
    "one target": {"objective": "minimax"},
}


@pytest.fixture(scope="module", params=WAYS)
def fit(request: pytest.FixtureRequest, robot: mc.Robot, noisy: Simulation) -> mc.Fit:
    data = noisy.data
    if request.param == "one target":
        data = data.only(1)
    return mc.calibrate(robot, data, **WAYS[request.param])


@pytest.fixture
def saved(fit: mc.Fit, tmp_path: Path) -> mc.Fit:
    fit.save(tmp_path / "fit.json")
    return mc.load_fit(tmp_path / "fit.json")


def assert_same(read: Any, made: Any) -> None:
    """But for what millimetres and a rotation vector take of the last digits."""
    assert_allclose(read, made, rtol=1e-11, atol=1e-14)


def test_what_was_saved_comes_back(fit, saved, rng):
    q = rng.uniform(-2.0, 2.0, (20, 6))
    assert_same(saved.predict(q), fit.predict(q))
    assert_same(saved.covariance, fit.covariance)
    assert saved.summary() == fit.summary()
    assert repr(saved) == repr(fit)
    for name in ("value", "nominal", "sigma", "ci95"):
        assert_same(getattr(saved.parameters, name), getattr(fit.parameters, name))
    for key, error in fit.errors.items():
        assert_same(saved.errors[key], error)
    assert_array_equal(saved.held, fit.held)
    assert_same(saved.data.y, fit.data.y)
    assert_array_equal(saved.weights, fit.weights)
    assert vars(saved.identification).keys() == vars(fit.identification).keys()
    assert_array_equal(saved.identification.active, fit.identification.active)
    assert saved.options.settings() == fit.options.settings()


def test_the_robot_is_of_geometry_alone(fit, saved, robot, noisy):
    """`robot` is what a fit without effects finds; `cell` keeps the joint fit; each stands once."""
    content = fit.to_dict()
    joint = bool(fit.cell.effects.cause_terms)
    assert ("robot" in content["cell"]) is joint
    assert_same(saved.robot.mdh, fit.robot.mdh)
    assert_same(saved.geometric.base, fit.geometric.base)
    assert_same(saved.geometric.target_positions, fit.geometric.target_positions)
    assert_same(saved.cell.robot.mdh, fit.cell.robot.mdh)
    if joint:
        plain = mc.calibrate(robot, noisy.data)
        assert_allclose(fit.robot.mdh, plain.robot.mdh, rtol=0, atol=1e-9)
        assert np.abs(fit.cell.robot.mdh - plain.robot.mdh).max() > 1e-5
        assert not fit.geometric.effects.terms
    else:
        assert fit.robot is fit.cell.robot


@pytest.mark.parametrize("fit", ["point", "effects", "robust"], indirect=True)
def test_the_report_is_the_same(fit, saved):
    one, other = (
        render_html(
            build_report(read_report_sources([each]), ReportRequest("2026-01-31", appendix=True))
        )
        for each in (fit, saved)
    )
    strip = lambda page: [x for x in page.splitlines() if "SHA" not in x and "not saved" not in x]  # noqa: E731
    assert strip(one) == strip(other)


@pytest.mark.parametrize("fit", ["minimax", "effects", "prior"], indirect=True)
def test_every_fact_is_in_the_file_and_shown_everywhere(fit, tmp_path):
    """What `Fit` declares, by its key; in words in the summary, the report and the page."""
    content = fit.to_dict()
    facts = {**stored_field_formats(mc.Fit), **derived_field_formats(mc.Fit)}
    for name, known in facts.items():
        assert (known.key or name) in content or getattr(fit, name) is None
    said = fit.describe_solution()
    assert said.startswith(capitalise_sentence(format_record_fields(fit)))
    assert f"{fit.iterations} iterations" in said
    fit.save(tmp_path / "fit.json")
    assert said in fit.summary(10_000)
    assert said in html.unescape(
        render_html(
            build_report(read_report_sources([fit]), ReportRequest("2026-01-31", appendix=True))
        )
    )
    assert said in read_fit_summary(*file_version(tmp_path / "fit.json"))


def test_work_goes_on_from_a_saved_fit(fit, saved):
    assert_same(saved.estimator.model.weight, fit.estimator.model.weight)
    assert_same(saved.estimator.model.prior.weight, fit.estimator.model.prior.weight)
    assert_array_equal(saved.estimator.share, fit.estimator.share)
    assert_same(saved.distances.mean, fit.distances.mean)
    if fit.objective != "point":
        one, other = (bootstrap(each, 4, seed=1) for each in (fit, saved))
        assert_same(one.change, other.change)


def test_a_file_without_poses(fit, tmp_path):
    """What is told pose by pose is not in it; all else comes back."""
    path = tmp_path / "fit.json"
    fit.save(path, poses=False)
    content = json.loads(path.read_text())
    assert "poses" not in content
    assert not {"weights", "crossed"} & content["arrays"].keys()
    back = mc.load_fit(path)
    assert [p.name for p in back.parameters] == [p.name for p in fit.parameters]
    assert_same(back.parameters.value, fit.parameters.value)
    assert back.accuracy["train"].sse_mm2 == fit.accuracy["train"].sse_mm2
    assert convert_to_plain_json(back.beyond) == convert_to_plain_json(fit.beyond)
    assert not back.data.poses
    assert_same(back.predict(fit.data.q[:3]), fit.predict(fit.data.q[:3]))


def test_a_number_changed_by_hand_counts(fit):
    content = fit.to_dict()
    joint = content["cell"] if fit.cell.effects.cause_terms else content
    first = next(iter(joint["targets_mm"].values()))
    first[0] += 1.0
    moved = mc.Fit.from_dict(content).cell.target_positions - fit.cell.target_positions
    assert moved[0, 0] == pytest.approx(1e-3, abs=1e-12)
    assert np.count_nonzero(np.abs(moved) > 1e-12) == 1


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda c: c.pop("accuracy"), "'accuracy' is missing"),
        (lambda c: c.pop("covariance"), "does not hold a covariance"),
        (lambda c: c.pop("seconds"), "seconds: is missing"),
        (lambda c: c["accuracy"]["train"].update(points=[1]), "accuracy.train is not of"),
        (lambda c: c.update(schema=2), "is of schema 2"),
        (lambda c: c.pop("schema"), "does not say of which schema it is"),
        (lambda c: c["arrays"].update(prior="?"), "prior: holds something else"),
        (lambda c: c["parameters"][0].update(name="nonsense"), "cannot be read"),
        (lambda c: c["poses"]["q"].pop(), "its list of poses cannot be read"),
        (lambda c: c.update(status="fine"), "status: should be one of"),
        (
            lambda c: c["cell"].update(effects=[{"effect": "gremlin", "place": "J1"}]),
            "effect 'gremlin' is not known here; register it",
        ),
    ],
)
def test_a_broken_file_is_one_line(change, says, robot, noisy):
    content = json.loads(mc.calibrate(robot, noisy.data, "sum").json())
    change(content)
    with pytest.raises(mc.CalibrationError, match=says) as told:
        mc.Fit.from_dict(content, "fit.json")
    assert str(told.value).startswith("fit.json: ")
    assert "\n" not in str(told.value)


def test_results_show_themselves(robot, noisy):
    fit = mc.calibrate(robot, noisy.data, "sum")
    assert len(repr(fit)) < 400
    assert repr(fit.parameters) == "<45 parameters, 33 identified>"
    assert fit._repr_html_().count("<table>") == len(fit.tables())
    a2 = fit.parameters["a2"]
    assert fit.parameters[fit.parameters.names.index("a2")] is a2
    low, high = fit.parameters.ci95[fit.parameters.names.index("a2")]
    assert low < a2.value < high
    with pytest.raises(KeyError, match="no parameter 'a9'"):
        fit.parameters["a9"]


@pytest.mark.dev
def test_a_frame_of_parameters(robot, noisy):
    pytest.importorskip("pandas", reason="pandas is not installed: no frame to look at")
    frame = mc.calibrate(robot, noisy.data, "sum").parameters.frame()
    assert list(frame["name"][:2]) == ["a1", "d1"]
    assert frame["identifiable"].sum() == 33


@pytest.mark.parametrize(
    ("qp", "says"),
    [(lambda problem: problem.q[1:], "qp is to return x"), (7, "give the name of a backend")],
)
def test_a_wrong_qp_is_an_error_in_words(qp, says):
    data = mc.simulate("irb2600", 40, 2, seed=1).data
    with pytest.raises(mc.OptionError, match=says):
        mc.calibrate("irb2600", data, objective="minimax", qp=qp)


# ---- fit with them -------------------------------------------------------------------------------


TRUTH = Truth(noise=20e-6, noise_per_metre=0.0, compliance=0.0)
BAD = 5  # poses of which each is off


def spoilt(poses: int = 250) -> tuple[Measurements, Array]:
    """Measurements with a few poses that are off by 1 mm, and their lines."""
    data = simulate("irb120", poses, 3, seed=3, truth=TRUTH).data
    rng = np.random.default_rng(0)
    rows = rng.choice(poses, BAD, replace=False)
    y = data.y.copy()
    by = rng.normal(size=(BAD, 1, 3))
    y[rows] += 1e-3 * by / np.linalg.norm(by, axis=-1, keepdims=True)
    return data.with_y(y), data.line[rows]


def unticked(data: Measurements, lines: Array) -> Measurements:
    return set_aside_points_named_by_user(data, [f"{','.join(map(str, lines))}=looks odd"])


def test_points_weigh_as_much_as_they_would_among_all(rng):
    """Where a fifth is held out, a point set aside counts a fifth of a held-out one."""
    held, aside = rng.normal(size=(40, 2, 3)), 3.0 * rng.normal(size=(10, 2, 3))
    found = accuracy_with_set_aside(held, np.arange(40), aside, 0.2)
    squares = [np.sum(part**2, axis=(1, 2)) for part in (held, aside)]
    mean_square = (squares[0].sum() + 0.2 * squares[1].sum()) / (80 + 0.2 * 20)
    assert_allclose(found.rms_mm, 1e3 * np.sqrt(mean_square), rtol=1e-12)
    assert_allclose(sum(found.sse_mm2) / sum(found.counts), found.rms_mm**2, rtol=1e-12)
    both = np.linalg.norm(np.concatenate([held, aside]), axis=-1)
    assert found.max_mm == 1e3 * both.max()
    assert (found.poses, found.counts) == (50, (50, 50))
    alone = accuracy_with_set_aside(held, np.arange(40), aside[:0], 0.2)
    assert_allclose(alone.rms_mm, 1e3 * np.sqrt((held**2).sum(-1).mean()), rtol=1e-12)


def test_unticked_poses_are_listed_and_counted(tmp_path):
    """2 % of the poses: the claim without them is smaller, that with them is as before."""
    data, lines = spoilt()
    before = mc.calibrate("irb120", data, "sum").accuracy["holdout"].rms_mm
    fit = mc.calibrate("irb120", unticked(data, lines), "sum")
    assert {(p.row, p.target) for p in fit.set_aside} == {
        (line, name) for line in lines for name in data.target_names
    }
    assert {(p.why, p.by) for p in fit.set_aside} == {("looks odd", SET_ASIDE_BY_USER)}
    assert fit.with_them is not None
    without, counted = fit.accuracy["holdout"], fit.accuracy["holdout_with_them"]
    noise = 1e3 * np.sqrt(3.0) * TRUTH.noise
    assert without.rms_mm < 1.2 * noise
    whole = np.hypot(noise, 1.0 * np.sqrt(BAD / data.poses))  # what all poses together show
    assert_allclose(counted.rms_mm, whole, rtol=0.05)
    assert before > without.rms_mm
    assert_allclose(counted.max_mm, 1.0, rtol=0.1)
    assert counted.poses == without.poses + BAD
    said = f"{3 * BAD} points set aside by the user; with them RMS {counted.rms_mm:.3f} mm"
    assert said in fit.headline()
    fit.save(tmp_path / "fit.json")
    again = mc.load_fit(tmp_path / "fit.json")
    assert again.set_aside == fit.set_aside
    assert again.accuracy["holdout_with_them"] == counted
    assert again.to_dict()["set_aside"] == fit.to_dict()["set_aside"]
    assert again.with_them is not None
    assert again.with_them == fit.with_them
    assert again.with_them.rms_ci95_mm == fit.with_them.rms_ci95_mm


def test_few_poses_are_cross_validated_and_all_count():
    data, lines = spoilt(60)
    fit = mc.calibrate("irb120", unticked(data, lines), "sum", holdout=0.2)
    assert fit.error_crossed.size
    counted = fit.accuracy["holdout_with_them"]
    assert counted.poses == 60
    assert counted.rms_mm > 3.0 * fit.within.after.rms_mm


def test_without_any_nothing_is_said():
    fit = mc.calibrate("irb120", simulate("irb120", 60, 2, seed=1, truth=TRUTH).data, "sum")
    assert fit.set_aside == ()
    assert fit.to_dict()["set_aside"] == []
    assert "holdout_with_them" not in fit.to_dict()["accuracy"]
    assert "set aside" not in fit.headline()


@pytest.mark.parametrize("options", [{"trim": 0.05}, {"loss": "tukey"}])
def test_what_a_robust_fit_gives_no_weight_is_listed(options):
    data, lines = spoilt()
    fit = mc.calibrate("irb120", data, "sum", **options)
    train = set(fit.train.line)
    assert {p.row for p in fit.set_aside} == {line for line in lines if line in train}
    assert {p.by for p in fit.set_aside} == {SET_ASIDE_BY_TOOL}
    assert next(iter(options)) in fit.set_aside[0].why


def test_a_target_that_hardly_any_pose_shows_is_listed():
    data = simulate("irb120", 60, 3, seed=1, truth=TRUTH).data
    y = data.y.copy()
    y[2:, 2] = np.nan
    fit = mc.calibrate("irb120", data.with_y(y), "sum")
    assert [(p.row, p.target, p.by) for p in fit.set_aside] == [
        (line, "smr3", SET_ASIDE_BY_TOOL) for line in data.line[:2]]  # fmt: skip
    assert fit.accuracy["holdout_with_them"].rms_mm == fit.accuracy["holdout"].rms_mm or (
        fit.error_crossed.size
    )


def test_effects_and_sessions_reach_points_set_aside():
    """Their errors need the moves and the clock of the visits, which they were among."""
    data, lines = spoilt(120)
    marked = np.isin(data.line, lines)[:, None] & np.ones(3, dtype=bool)
    some = set_points_aside(data, marked, "marked deleted", SET_ASIDE_BY_FILE)
    fit = mc.calibrate("irb120", some, "sum", effects=["backlash:J1", "frame_drift"])
    assert {p.by for p in fit.set_aside} == {SET_ASIDE_BY_FILE}
    assert_allclose(fit.accuracy["holdout_with_them"].max_mm, 1.0, rtol=0.15)


# ---- many ----------------------------------------------------------------------------------------


def test_each_set_has_its_fit_or_its_error():
    sheets = [mc.simulate("irb120", 40, 1, seed).data for seed in range(2)]
    broken = sheets[0].take(np.arange(2))
    one, none, other = mc.calibrate_many("irb120", [sheets[0], broken, sheets[1]], jobs=1)
    assert isinstance(none, mc.CalibrationError)
    for fit, sheet in ((one, sheets[0]), (other, sheets[1])):
        assert isinstance(fit, mc.Fit)
        assert_array_equal(fit.robot.mdh, mc.calibrate("irb120", sheet).robot.mdh)


def test_a_fit_comes_back_whole_from_another_process():
    fit = mc.calibrate("irb120", mc.simulate("irb120", 40, 1, 0).data)
    again = pickle.loads(pickle.dumps(fit))
    assert_array_equal(again.error, fit.error)
    assert convert_to_plain_json(again.beyond) == convert_to_plain_json(fit.beyond)


def test_robots_and_data_are_as_many():
    with pytest.raises(mc.CalibrationError, match="2 robots for 1 data sets"):
        mc.calibrate_many(["irb120", "irb120"], [mc.simulate("irb120", 40, 1, 0).data])


def test_a_diagnosis_comes_back_whole_from_another_process():
    sheets = [mc.simulate("irb120", 40, 3, seed).data for seed in range(2)]
    one, other = mc.diagnose_many("irb120", [sheets[0], sheets[1].take(np.arange(2))], jobs=1)
    assert isinstance(one, mc.Diagnosis)
    assert isinstance(other, mc.CalibrationError)
    assert pickle.loads(pickle.dumps(one)).to_dict() == one.to_dict()
