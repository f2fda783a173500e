"""A fit and its file: the same to the last digit; results for people."""

import html
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import minimax_cal as mc
from minimax_cal.ground.facts import derived_facts, facts_in_words, stored_facts
from minimax_cal.ground.files import plain
from minimax_cal.ground.words import capitalise
from minimax_cal.judging.bootstrap import bootstrap
from minimax_cal.modelling.simulate import Simulation
from minimax_cal.reporting.html import Wording, compose, read_sources, render
from minimax_cal.serving.panels import fit_words
from minimax_cal.serving.sessions import mark

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
    joint = bool(fit.cell.effects.causes)
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


def test_the_report_is_the_same(fit, saved):
    one, other = (
        render(compose(read_sources([each]), Wording("2026-01-31"))) for each in (fit, saved)
    )
    strip = lambda page: [x for x in page.splitlines() if "SHA" not in x and "not saved" not in x]  # noqa: E731
    assert strip(one) == strip(other)


def test_every_fact_is_in_the_file_and_shown_everywhere(fit, tmp_path):
    """What `Fit` declares, by its key; in words in the summary, the report and the page."""
    content = fit.to_dict()
    facts = {**stored_facts(mc.Fit), **derived_facts(mc.Fit)}
    for name, known in facts.items():
        assert (known.key or name) in content or getattr(fit, name) is None
    said = fit.solution()
    assert said.startswith(capitalise(facts_in_words(fit)))
    assert f"{fit.iterations} iterations" in said
    fit.save(tmp_path / "fit.json")
    assert said in fit.summary(10_000)
    assert said in html.unescape(render(compose(read_sources([fit]), Wording("2026-01-31"))))
    assert said in fit_words(*mark(tmp_path / "fit.json"))


def test_work_goes_on_from_a_saved_fit(fit, saved):
    assert_same(saved.estimator.model.weight, fit.estimator.model.weight)
    assert_same(saved.estimator.model.prior.weight, fit.estimator.model.prior.weight)
    assert_array_equal(saved.estimator.share, fit.estimator.share)
    assert_same(saved.distances.mean, fit.distances.mean)
    if fit.objective != "point":
        one, other = (bootstrap(each, 4, seed=1) for each in (fit, saved))
        assert_same(one.change, other.change)


def test_the_estimator_gives_the_sigma_of_the_fit(fit):
    """Rebuilt where the fit ended; with effects the columns were linear a pass before: 1 %."""
    from minimax_cal.fitting.uncertainty import uncertainty_of

    units = fit.uncertainty.units[fit.estimator.model.names.geometric :]
    again = uncertainty_of(fit.estimator, fit.cell.state, fit.group, units)
    rtol = 1e-2 if fit.cell.effects.terms else 1e-9
    active = fit.uncertainty.active
    ratio = fit.widening * again.sigma[active] / fit.uncertainty.sigma[active]
    assert_allclose(ratio, 1.0, rtol=0, atol=rtol)


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
    assert plain(back.beyond) == plain(fit.beyond)
    assert not back.data.poses
    assert_same(back.predict(fit.data.q[:3]), fit.predict(fit.data.q[:3]))


def test_a_number_changed_by_hand_counts(fit):
    content = fit.to_dict()
    joint = content["cell"] if fit.cell.effects.causes else content
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
        (
            lambda c: c["arrays"].update(prior="?"),
            "prior: holds something else",
        ),
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
    [(lambda problem: problem.q, "returned ndarray"), (7, "give the name of a backend")],
)
def test_a_wrong_qp_is_an_error_in_words(qp, says):
    data = mc.simulate("irb2600", 40, 2, seed=1).data
    with pytest.raises(mc.OptionError, match=says):
        mc.calibrate("irb2600", data, objective="minimax", qp=qp)
