from dataclasses import replace
from functools import cache
from itertools import pairwise

import numpy as np
import pytest
from numpy.testing import assert_allclose

import minimax_cal as mc
from minimax_cal.diagnosing import residual_curves
from minimax_cal.diagnosing.diagnosis import Diagnosis
from minimax_cal.measuring.visit_history import add_history_columns
from minimax_cal.modelling.effects.curve_axes import curve_axis_of_effect
from minimax_cal.modelling.effects.table import EFFECTS, Fitted, Term
from minimax_cal.modelling.simulate import Truth, simulate
from minimax_cal.reporting.plots import diagnosis_figure, error_figure
from minimax_cal.reporting.plots.error_figure import new_figure, write_figure
from minimax_cal.robots.gravity_torques import assumed_link_masses_and_centres

ROBOT = mc.load_robot("ur10")
CASES: dict[str, tuple[str, str, dict[str, float], list[float]]] = {
    "backlash": ("backlash", "J3", {}, [4e-4]),
    "shift": ("target_shift", "smr2", {"since": 0.6}, [3e-4, 2e-4, 0.0]),
    "drift": ("frame_drift", "frame", {"constant": 0.3}, [3e-4, 2e-4, 1e-4, 0.0, 0.0, 1e-4]),
    "offset": ("target_offset", "smr2", {}, [3e-4]),
}


def test_a_long_name_stays_in_its_picture():
    pytest.importorskip("matplotlib")
    robot = replace(ROBOT, name="A robot of a make and of a type with a name that goes on " * 3)
    fit = mc.calibrate(robot, simulate(ROBOT, 40).data, "sum")
    figure = error_figure.plot_errors(fit)
    figure.canvas.draw()
    (title,) = [text for text in figure.texts if text.get_text().startswith("A robot")]
    box = title.get_window_extent()
    assert 0.0 < box.x0 < box.x1 < figure.bbox.width


@cache
def diagnosed(case: str, targets: int = 3) -> Diagnosis:
    """A UR10 with one effect, or none."""
    made = simulate(ROBOT, 60, targets, seed=3, truth=Truth(compliance=0.0))
    data = made.data
    if case in CASES:
        effect, place, choice, values = CASES[case]
        scene = made.cell.pose_arm(add_history_columns(data))
        one = Fitted((Term(effect, place, choice),), (np.array(values),))
        moved = np.moveaxis(one.displaced_targets(scene) - scene.points, -1, 0)
        data = data.with_y(data.y + moved @ made.cell.base[:3, :3].T)
    else:
        data = replace(data, columns={})
    return mc.diagnose(ROBOT, data, quick=True)


def test_a_picture_of_each_kind_and_the_same_file_again(tmp_path):
    made = []
    for name in ("gap.png", "gap.pdf", "gap.svg", "again.svg"):
        diagnosis_figure.save_diagnosis(diagnosed("backlash"), tmp_path / name)
        made.append((tmp_path / name).read_bytes())
    for raw, start in zip(made, (b"\x89PNG", b"%PDF", b"<?xml", b"<?xml"), strict=True):
        assert raw.startswith(start)
    assert made[2] == made[3]


@pytest.mark.parametrize("targets", [1, 3])
def test_nothing_found_no_order_and_one_target(targets, tmp_path):
    found = replace(diagnosed("none", targets), robot="arm $x_{$")  # a name may hold a dollar
    assert not found.effects
    diagnosis_figure.save_diagnosis(found, tmp_path / "gap.svg")
    assert (tmp_path / "gap.svg").exists()
    left = found.leftover()
    assert len(left.errors) == 1
    assert len(residual_curves.build_residual_curve(left).y) == 1
    assert "no order" in residual_curves.build_visit_order_curve(left).title
    assert diagnosis_figure.describe_verdict(found) == "no cause beyond geometry and noise"


def test_backlash_is_drawn_against_the_last_move_and_is_gone_after():
    left = diagnosed("backlash").leftover()
    curve = residual_curves.build_residual_curve(left)
    assert "joint 3" in curve.title
    assert curve.xlabel == "last move of joint 3 (deg)"
    before, after, law = curve.y
    assert np.std(after) < 0.4 * np.std(before)
    known = curve.x != 0.0
    side = law[known] * np.sign(curve.x[known])
    assert_allclose(np.quantile(side, 0.8), 0.2, rtol=0.1)  # mrad: half of the play on either side
    assert side.max() < 0.3  # the ridge only ever makes turns less


@pytest.mark.parametrize(
    ("case", "label", "late"),
    [
        ("shift", "time in the session", np.hypot(0.3, 0.2)),
        ("drift", "time in the session", np.nan),
        ("offset", "distance from the instrument (m)", 0.3),
    ],
)
def test_effects_on_targets_are_drawn_along_their_motion(case, label, late, tmp_path):
    left = diagnosed(case).leftover()
    curve = residual_curves.build_residual_curve(left)
    assert curve.xlabel.startswith(label)
    before, after, law = curve.y
    assert np.sqrt(np.mean(after**2)) < 0.5 * np.sqrt(np.mean(before**2))
    if np.isfinite(late):
        assert curve.x.shape == (1, 60)  # of the one target
        assert_allclose(np.median(law[curve.x > 0.62]), late, rtol=0.1)
    diagnosis_figure.save_diagnosis(diagnosed(case), tmp_path / "gap.png")
    assert (tmp_path / "gap.png").stat().st_size > 50_000


@pytest.mark.parametrize("rungs", [2, 12, 30])
def test_no_rung_touches_another(rungs):
    """In a quarter of the picture that `save_diagnosis` draws, four ninths of its height."""
    found = diagnosed("backlash")
    more = [replace(found.ladder[-1], name=f"+ gear_ripple J{i}") for i in range(rungs)]
    figure = new_figure(6.25, 10.0 * 4.0 / 9.0)
    axes = figure.subplots()
    diagnosis_figure.draw_error_budget(axes, replace(found, ladder=(*found.ladder[:2], *more)))
    figure.canvas.draw()
    boxes = [text.get_window_extent() for text in axes.get_yticklabels()]
    assert len(boxes) == rungs + 2
    assert all(upper.y0 > lower.y1 for upper, lower in pairwise(boxes))
    assert boxes[0].height > 5.0  # and can be read


def test_errors_are_those_of_the_ladder():
    found = diagnosed("backlash")
    left = found.leftover()
    for distance, step in zip(
        left.error_distances(), (found.ladder[1], found.ladder[-1]), strict=True
    ):
        assert_allclose(np.sqrt(np.mean(distance[found.held] ** 2)), step.holdout.rms_mm)
    rms = residual_curves.build_visit_order_curve(left).y[1]
    assert_allclose(np.sqrt(np.mean(rms[found.held] ** 2)), found.ladder[-1].holdout.rms_mm)


@pytest.mark.parametrize("name", list(EFFECTS))
def test_every_effect_has_something_to_be_drawn_against(name):
    """With its unit, one number for each pose."""
    scene, effect = diagnosed("backlash").leftover().scene, EFFECTS[name]
    if name == "cross_compliance":  # asks for masses, which this robot does not tell
        mass, com = assumed_link_masses_and_centres(scene.robot.mdh)
        scene = replace(scene, robot=replace(scene.robot, mass=mass, com=com))
    place = effect.places(scene)[0]
    choices = effect.choices(scene, place) or ({"turns": 100.0},)
    for choice in choices:
        label, values = curve_axis_of_effect(scene, Term(name, place, choice), 2)
        assert values.shape == (60,)
        assert np.isfinite(values).all()
        assert np.ptp(values) > 0.0
        assert label.endswith(")")


def test_powers_on_a_logarithmic_axis_are_set_as_mathematics(tmp_path):
    figure = new_figure(4, 3)
    axes = figure.subplots()
    axes.plot([1.0, 1e4], [1.0, 1e4])
    axes.set(xscale="log", yscale="log", title="$5")
    write_figure(figure, tmp_path / "picture.svg")
    labels = [*axes.get_xticklabels(), *axes.get_yticklabels()]
    assert len(labels) >= 4
    assert all(label.get_parse_math() for label in labels)
