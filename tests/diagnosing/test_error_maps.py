"""Curves of joints that no law has, and fits without a part of the poses."""

import json
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose

import minimax_cal as mc
from minimax_cal.core.arrays import Array
from minimax_cal.diagnosing import budget_steps, error_budget
from minimax_cal.diagnosing.budget_steps import fit_budget_steps
from minimax_cal.diagnosing.cause_search import FoundCauses, search_beside_maps, search_causes
from minimax_cal.diagnosing.curve_cross_validation import (
    CrossValidatedFit,
    CurveColumns,
    LinearResidual,
    cross_validate_residual,
)
from minimax_cal.diagnosing.error_budget import fit_error_budget, predicts_no_worse
from minimax_cal.diagnosing.error_map_search import find_strongest_wave, search_error_maps
from minimax_cal.diagnosing.joint_fit import GeometryEffectFit, fit_geometry_and_effects
from minimax_cal.diagnosing.study import (
    LEAST_SQUARES_OPTIONS,
    LinearisedGeometry,
    linearise_geometry,
)
from minimax_cal.fitting.accuracy import summarise_point_errors
from minimax_cal.fitting.cell_fit import fit_cell
from minimax_cal.fitting.options import silent_progress
from minimax_cal.measuring.visit_history import add_history_columns
from minimax_cal.modelling.effects.effect_names import format_effect
from minimax_cal.modelling.effects.joint_error_maps import sine_basis, sine_factor_sigmas
from minimax_cal.modelling.effects.table import EFFECTS, Term, parse_effect_terms
from minimax_cal.modelling.simulate import Simulation, Truth, simulate
from minimax_cal.robots.robot import Robot

Curve = Callable[[Array], Array]
NODES, FAR = np.arange(-2.0, 3.0, 0.15), np.arange(-7.0, 7.0, 0.15)
HEIGHTS = 3e-4 * np.random.default_rng(2).normal(size=len(NODES))


def bumps(q: Array) -> Array:
    """A curve of no period."""
    return np.asarray(np.interp(q, NODES, HEIGHTS))


def saw(q: Array) -> Array:
    """A curve with many lines."""
    return 3e-4 * (np.mod(q, 0.5) / 0.25 - 1.0)


@pytest.mark.parametrize("length", [0.1, 0.5])
def test_the_sines_are_a_matern_process(length: float) -> None:
    x, span = np.linspace(1.4, 1.6, 5), 3.0  # far from the ends, where it is pinned to nothing
    part = sine_basis(x, 0.0, span, 2000) * sine_factor_sigmas(length, span, 2000)[:, None]
    s = np.sqrt(3.0) * np.abs(x[:, None] - x) / length
    assert_allclose(part.T @ part, (1.0 + s) * np.exp(-s), atol=2e-3)  # 0.1 lengths to the ends


def test_curves_of_two_joints_are_found_and_hold_at_new_poses(robot: Robot) -> None:
    whole = geometric(robot, rigid(robot, 260, 2, 3), {1: saw, 2: saw}).study
    old, new = whole.data.take(np.arange(200)), whole.data.take(np.arange(200, 260))
    bare = fit_geometry_and_effects(
        linearise_geometry(
            robot, old, fit_cell(robot, old, LEAST_SQUARES_OPTIONS, silent_progress)
        ),
        (),
    )
    found = search_error_maps(bare)
    assert {term.label for term in found.terms} == {"joint_error_map:J2", "joint_error_map:J3"}
    assert max(found.p_values) < 1e-3
    before, after = (
        summarise_point_errors(fit.cell.error(new)).rms_mm
        for fit in (bare, fit_geometry_and_effects(bare.study, found.terms))
    )
    assert after < 0.6 * before


def test_a_single_wave_is_told_as_one(robot: Robot) -> None:
    bare = geometric(robot, rigid(robot, 220, 2, 4), {0: lambda q: 2e-4 * np.sin(17.0 * q)})
    (term,) = search_error_maps(bare).terms
    assert term.label == "gear_ripple:J1"
    assert abs(term.choice["turns"] - 17.0) < 0.2
    (curve,) = search_error_maps(bare, excluded_effects=["gear_ripple"]).terms
    assert curve.label == "joint_error_map:J1"


def test_slow_laws_of_the_same_angle_need_no_map(robot: Robot) -> None:
    slow = {2: lambda q: 1e-3 * q + 3e-4 * np.cos(2.0 * q)}
    assert search_error_maps(geometric(robot, rigid(robot, 120, 2, 5), slow)).terms == ()


def test_lines_that_a_map_makes_needless_leave(robot: Robot) -> None:
    bare = geometric(robot, rigid(robot, 220, 2, 6), {1: bumps})
    line, _ = find_strongest_wave(NODES, HEIGHTS)
    named = fit_geometry_and_effects(bare.study, [Term("gear_ripple", "J2", {"turns": line})])
    found = search_error_maps(named)
    assert [term.label for term in found.terms] == ["joint_error_map:J2"]
    assert [term.label for term in found.replaced_terms] == ["gear_ripple:J2"]


def test_a_fine_wave_is_found_at_a_ratio_that_another_joint_shows(robot: Robot) -> None:
    waves = {0: lambda q: 1e-4 * np.sin(200.0 * q), 1: lambda q: 2e-5 * np.cos(199.6 * q + 1.0)}
    bare = geometric(robot, rigid(robot, 240, 3, 8), waves)
    heard = fit_geometry_and_effects(bare.study, [Term("gear_ripple", "J1", {"turns": 200.0})])
    found = search_error_maps(heard)
    assert [term.label for term in found.terms] == ["gear_ripple:J2"]
    assert abs(found.terms[0].choice["turns"] - 199.6) < 0.2
    assert found.p_values[0] < 1e-3
    assert not search_error_maps(heard, excluded_effects=["gear_ripple"]).terms
    own = [(Term("gear_ripple", "J2", {"turns": 199.5}),)]
    assert found.merge_with_effects(own) == own  # a joint has its line already
    assert "gear_ripple:J2" not in [
        term.label for term in search_error_maps(bare).terms
    ]  # no ratio known


def test_the_strongest_wave_of_a_curve() -> None:
    x = np.linspace(-2.0, 1.5, 400)
    turns, share = find_strongest_wave(x, 0.3 + 0.1 * x + np.sin(21.3 * x + 0.4))
    assert abs(turns - 21.3) < 0.1
    assert share > 0.99
    assert find_strongest_wave(x, np.abs(np.sin(9.0 * x)) + np.sin(17.0 * x))[1] < 0.9


def test_a_diagnosis_tells_the_curve_and_a_fit_compensates_it(robot: Robot, tmp_path: Path) -> None:
    sim = rigid(robot, 220, 1, 3)
    q, data = sim.data.q, turned(sim, {1: bumps})
    told = mc.diagnose(robot, data, quick=True)
    (found,) = [f for f in told.effects if f.term.label == "joint_error_map:J2"]
    x, y, band = found.curve
    inside = (x > q[:, 1].min()) & (x < q[:, 1].max())
    off = (y - bumps(x))[inside]  # geometry may take a constant turn
    assert np.mean(np.abs(off - off.mean()) < 3.0 * band[inside]) > 0.9
    assert [p["name"] for p in found.parameters] == ["RMS", "largest"]
    again = mc.Diagnosis.from_dict(json.loads(told.json()))
    assert json.loads(again.json())["effects"] == json.loads(told.json())["effects"]

    told.save(tmp_path / "diagnosis.json")
    fit = mc.calibrate(robot, data, objective="sum", effects=tmp_path / "diagnosis.json")
    assert fit.accuracy["holdout"].rms_mm < 0.5 * told.ladder[1].holdout.rms_mm
    rows = fit.effect_table().rows
    assert [row[0].partition(",")[0] for row in rows] == [format_effect("joint_error_map", "J2")]
    fit.save(tmp_path / "fit.json")
    loaded = mc.load_fit(tmp_path / "fit.json")
    assert_allclose(loaded.predict(q), fit.predict(q), atol=1e-12)
    fixed = mc.compensate(loaded, q[:10])
    assert fixed.distance.max() < 2e-5


def test_what_stood_in_for_curves_is_named_no_more() -> None:
    """Names sought beside the maps: before them a series of waves of all joints passed for some."""
    robot = mc.load_robot("ur10")
    heights = 3e-4 * np.random.default_rng(2).normal(size=(2, len(FAR)))
    curves = {i: partial(np.interp, xp=FAR, fp=heights[i]) for i in range(2)}
    told = mc.diagnose(robot, turned(rigid(robot, 220, 1, 2), curves), quick=True)
    found = [f.term.label for f in told.effects]
    assert sorted(found) == [f"joint_error_map:J{number}" for number in (1, 2)]
    assert told.ladder[-1].holdout.rms_mm < 0.25 * told.ladder[1].holdout.rms_mm


@pytest.fixture(scope="module")
def bumpy(robot: Robot) -> tuple[LinearisedGeometry, FoundCauses]:
    """An arm with a curve in joint 2, and what is found of it without maps."""
    study = geometric(robot, rigid(robot, 220, 2, 6), {1: bumps}).study
    return study, search_causes(study, (), (), silent_progress)[1]


def test_what_curves_may_be_is_no_geometry_of_names(
    bumpy: tuple[LinearisedGeometry, FoundCauses],
) -> None:
    """Beside maps is projected out what the data tell of them; what their priors hold is not."""
    study, bare = bumpy
    (term,) = search_error_maps(fit_geometry_and_effects(study, ())).terms
    beside = search_beside_maps(study, bare, (term,))
    rows, wide = study.rows, beside.selection.library.problem
    assert_allclose(
        wide.nuisance_basis.T @ wide.nuisance_basis, np.eye(wide.nuisance_basis.shape[1]), atol=1e-9
    )
    assert_allclose(wide.nuisance_basis.T @ wide.error, 0.0, atol=1e-12)
    columns = term.columns(study.scene)
    fields = rows.rows_from_fields(
        columns.target_displacements(study.scene) / np.sqrt(columns.ridge)[:, None, None, None]
    )
    rest = fields - wide.nuisance_basis @ (wide.nuisance_basis.T @ fields)
    assert np.linalg.svd(rest, compute_uv=False)[0] <= 1.0 + 1e-9  # what is left priors hold
    assert {f.term.place for f in beside.effects} <= {"J2"}  # waves finer than a map has


def test_what_was_found_first_stays_where_the_new_model_is_worse(
    bumpy: tuple[LinearisedGeometry, FoundCauses], monkeypatch: pytest.MonkeyPatch
) -> None:
    study, bare = bumpy
    monkeypatch.setattr(error_budget, "predicts_no_worse", lambda one, other: False)
    causes, tried, ladder = fit_error_budget(study, bare, silent_progress)
    assert causes is tried
    assert tried.selection is bare.selection  # and with it its noise
    assert ladder.error_map_terms


def test_a_law_and_a_curve_much_smaller_are_both_told() -> None:
    """The law first, whose errors are too large for the prior of the curve."""
    sim = simulate("ur10", 150, 1, seed=1, truth=Truth(compliance=2e-6))
    heights = 1e-4 * np.random.default_rng(1).normal(size=len(FAR))
    data = turned(sim, {2: partial(np.interp, xp=FAR, fp=heights)})
    told = mc.diagnose("ur10", data, quick=True)
    first, second = (f.term.label for f in told.effects[:2])
    assert (first, second) == ("joint_compliance:all", "joint_error_map:J3")
    steps = [step.name for step in told.ladder[2:]]
    terms = Term("joint_compliance", "all"), Term("joint_error_map", "J3")
    assert steps[:2] == [term.budget_step_name for term in terms]
    rms = [step.holdout.rms_mm for step in told.ladder]
    assert rms[3] < 0.75 * rms[2] < 0.3 * rms[1]


@pytest.mark.parametrize("order", [(0, 1), (1, 0)])
def test_a_ladder_keeps_a_map_whatever_its_place_among_the_effects(
    order: tuple[int, int], monkeypatch: pytest.MonkeyPatch
) -> None:
    robot = mc.load_robot("ur10")
    sim = simulate(robot, 150, 1, seed=1, truth=Truth(compliance=2e-6))
    study = geometric(robot, sim, {2: lambda q: 0.3 * bumps(q)}).study
    plain, *_ = EFFECTS["joint_compliance"].choices(study.scene, "all")
    law = Term("joint_compliance", "all", plain)
    (curve,) = parse_effect_terms(study.scene, ["joint_error_map:J3:size=0.0001"])
    effects = [[(law,), (curve,)][number] for number in order]
    ladder = fit_budget_steps(study, effects, [True] * len(effects))
    assert [effects[number] for number in ladder.taken_numbers] == [(law,), (curve,)]
    assert ladder.error_map_terms == (curve,)
    bare = fit_budget_steps(study, [(law,)], [True])
    assert predicts_no_worse(ladder, bare)
    assert not predicts_no_worse(bare, ladder)
    monkeypatch.setattr(
        budget_steps,
        "order_by_motion_size",
        lambda trials, study, effects: list(range(len(effects))),
    )
    # the curve by itself is refused, and tried again
    assert (
        fit_budget_steps(study, effects, [True] * len(effects)).taken_numbers
        == ladder.taken_numbers
    )


# ---- left out ------------------------------------------------------------------------------------


def rigid(robot: Robot, poses: int, targets: int, seed: int) -> Simulation:
    return simulate(robot, poses, targets, seed=seed, truth=Truth(compliance=0.0))


def turned(sim: Simulation, curves: dict[int, Curve]) -> mc.Measurements:
    """The same of an arm whose joints turn by so much more [rad], by their own values."""
    q, turn = sim.data.q, np.zeros_like(sim.data.q)
    for number, curve in curves.items():
        turn[:, number] = curve(q[:, number])
    return sim.data.with_y(sim.data.y + sim.cell.predict(q + turn) - sim.cell.predict(q))


def geometric(robot: Robot, sim: Simulation, curves: dict[int, Curve]) -> GeometryEffectFit:
    data = add_history_columns(turned(sim, curves))
    return fit_geometry_and_effects(
        linearise_geometry(
            robot, data, fit_cell(robot, data, LEAST_SQUARES_OPTIONS, silent_progress)
        ),
        (),
    )


def test_a_fit_without_a_part_is_that_of_the_others(rng: np.random.Generator) -> None:
    y, columns = rng.normal(size=(20, 3)), rng.normal(size=(20, 3, 4))
    block = CurveColumns("J1", rng.normal(size=(20, 3, 5)), np.array([[0.3] * 5]))
    parts = np.arange(20) % 4 == np.arange(4)[:, None]
    after = CrossValidatedFit.cross_validate(
        parts, y, columns, np.zeros(columns.shape[-1])
    ).with_curve(block)
    penalty = np.diag(np.sqrt(after.ridge))
    for part in parts:
        rows = np.concatenate([after.columns[~part].reshape(-1, 9), penalty])
        told = np.concatenate([y[~part].reshape(-1), np.zeros(9)])
        value = np.linalg.lstsq(rows, told, rcond=None)[0]
        assert_allclose(after.error[part], y[part] - after.columns[part] @ value, atol=1e-9)


def test_the_prior_that_meets_the_parts_best_is_taken(rng: np.random.Generator) -> None:
    columns = rng.normal(size=(30, 3, 2))
    y = columns @ np.array([1.0, -2.0]) + 0.01 * rng.normal(size=(30, 3))
    parts = np.arange(30) % 5 == np.arange(5)[:, None]
    at = CrossValidatedFit.cross_validate(parts, y, rng.normal(size=(30, 3, 1)), np.zeros(1))
    sizes = [
        at.with_curve(CurveColumns("J1", columns, np.full((1, 2), s))).heldout_square
        for s in (1e-3, 2.0)
    ]
    both = at.with_curve(CurveColumns("J1", columns, np.array([[1e-3, 1e-3], [2.0, 2.0]])))
    assert_allclose(both.heldout_square, min(sizes), rtol=1e-12)
    assert sizes[1] < 0.01 * sizes[0]


def test_what_holds_a_fit_holds_it_without_a_part(robot: Robot) -> None:
    """Left out, each part is met as the fit with its priors meets it: a map has many columns."""
    bare = geometric(robot, rigid(robot, 60, 2, 3), {1: lambda q: 3e-4 * np.sin(9.0 * q)})
    choice = {"low": -1.6, "high": 2.4, "length": 0.35, "size": 3e-4}
    fit = fit_geometry_and_effects(bare.study, [Term("joint_error_map", "J2", choice)])
    left = LinearResidual.from_fit(fit)
    at = cross_validate_residual(left)
    assert_allclose(at.heldout_square, fit.cross_validate_folds(list(left.fold_masks)), rtol=1e-6)
    free = CrossValidatedFit.cross_validate(
        left.fold_masks, left.errors, left.columns, np.zeros(left.columns.shape[-1])
    )
    assert free.heldout_square > 1.5 * at.heldout_square  # as it would be without


def test_what_no_pose_shows_is_nothing(rng: np.random.Generator) -> None:
    """As a session's frame, once its poses stand out."""
    y, columns = rng.normal(size=(20, 3)), rng.normal(size=(20, 3, 4))
    columns[..., 2] = 0.0
    parts = np.arange(20) % 4 == np.arange(4)[:, None]
    some, whole = (
        CrossValidatedFit.cross_validate(
            parts, y, columns[..., kept], np.zeros(np.count_nonzero(kept))
        )
        for kept in (np.arange(4) != 2, np.ones(4, dtype=bool))
    )
    assert_allclose(whole.error, some.error, atol=1e-12)
