"""Selection by evidence: names what is there, nothing where nothing is, and knows its rivals."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.optimize import lsq_linear

import minimax_cal as mc
from experiments.gap_cases import GapCase, GapCause, build_and_measure_arm
from experiments.resemblance import effect_similarities
from minimax_cal.core.arrays import Array
from minimax_cal.diagnosing.cause_search import select_arm_effects
from minimax_cal.diagnosing.study import (
    LEAST_SQUARES_OPTIONS,
    LinearisedGeometry,
    linearise_geometry,
)
from minimax_cal.fitting.cell_fit import fit_cell
from minimax_cal.fitting.options import Options, silent_progress
from minimax_cal.measuring.pose_groups import split_train_and_holdout
from minimax_cal.measuring.visit_history import add_history_columns
from minimax_cal.modelling.arm_laws import ArmLaws, build_library_of_testable_arm_laws
from minimax_cal.modelling.effects.table import Term
from minimax_cal.modelling.simulate import Truth, simulate
from minimax_cal.robots.gravity_torques import link_masses_and_centres
from minimax_cal.robots.robot import Robot
from minimax_cal.selection import forward_selection
from minimax_cal.selection.candidate_library import (
    CandidateLibrary,
    EqualShapeCandidates,
    LawColumns,
)
from minimax_cal.selection.candidate_tests import (
    are_prior_variations_plausible,
    build_candidate_tests,
    deviance_of_sign_constraints,
    list_columns_and_ridges,
)
from minimax_cal.selection.forward_selection import select_effects_by_evidence, tune_candidate
from minimax_cal.selection.noise_model import LinearProblem, Noise, orthonormal_basis
from minimax_cal.selection.stability_selection import (
    SubsampleSelections,
    build_half_masks,
    build_subsample_masks,
    find_alternatives,
    select_on_subsamples,
)
from minimax_cal.selection.thresholds import (
    FALSE_NAME_PROBABILITY,
    SUBSAMPLE_PART_COUNT,
    SUBSAMPLE_ROUND_COUNT,
)

# ---- selection -----------------------------------------------------------------------------------


def opened(
    *causes: GapCause, seed: int = 0, robot: str = "irb2600", poses: int = 100
) -> LinearisedGeometry:
    sealed = build_and_measure_arm(GapCase(robot, "single", causes, seed=seed, poses=poses))
    train, _, _ = split_train_and_holdout(add_history_columns(sealed.data), 0.2, 0)
    return study_of(sealed.robot, train)


def study_of(robot: mc.Robot, data: mc.Measurements) -> LinearisedGeometry:
    return linearise_geometry(
        robot, data, fit_cell(robot, data, Options(objective="sum"), silent_progress)
    )


@pytest.mark.parametrize(
    ("law", "place"),
    [
        ("joint_compliance", "J3"),
        ("gear_ripple", "J1"),
        ("encoder_gain", "J4"),
        ("joint_coupling", "J6"),
        ("thermal_growth", "all"),
        ("tool_flex", "all"),
        ("target_offset", "smr1"),
    ],
)
def test_a_plain_effect_is_named_and_sized(law, place):
    """lambda = 1000: effect and place exactly, and the noise is found beside it."""
    choice = select_arm_effects(opened(GapCause(law, place, 1000.0), seed=11), ())
    assert [c.key for c in choice.candidates] == [(law, place)]
    assert 12e-6 < np.sqrt(choice.noise.variance) < 25e-6


def test_a_joint_that_stiffens_is_told_as_its_compliance():
    """By a machine whose law is not ours: tau / (1 + 2 |tau| / most)."""
    choice = select_arm_effects(
        opened(GapCause("joint_compliance/hardening", "J3", 5000.0), seed=11), ()
    )
    (one,) = choice.candidates
    assert one.key == ("joint_compliance", "J3")
    assert one.term.choice["within"] > 0.0
    assert 12e-6 < np.sqrt(choice.noise.variance) < 25e-6


def test_masses_in_doubt_excuse_what_little_they_explain():
    """And not a law that is missing, for which they would have to be many sigma off."""
    robot = mc.load_robot("ur10")
    mass, com = link_masses_and_centres(robot)
    robot = replace(robot, mass=mass, com=com)
    made = simulate(robot, poses=150, seed=1, truth=Truth(compliance=2e-6))
    off = replace(robot, mass=mass * [1.0, 1.15, 0.9, 1.2, 1.0, 0.85])
    told = study_of(off, add_history_columns(made.data))
    for exclude, excused in (((), True), (("joint_compliance",), False)):
        choice = select_arm_effects(told, exclude)
        main, loose, _ = list_columns_and_ridges(choice.candidates, choice.candidate_fits)
        assert len(loose)
        assert (
            are_prior_variations_plausible(choice.library, choice.candidate_fits, choice.noise)
            == excused
        )
        assert choice.effect_and_variation_columns.shape[1] == len(main) + excused * len(loose)


def test_no_name_without_an_effect():
    for seed in range(5):
        choice = select_arm_effects(opened(seed=100 + seed), ())
        assert choice.candidates == ()


def test_two_effects_are_both_named():
    made = opened(GapCause("backlash", "J1", 300.0), GapCause("gear_error", "J3", 300.0), seed=4)
    choice = select_arm_effects(made, ())
    assert {c.key for c in choice.candidates} == {("backlash", "J1"), ("gear_error", "J3")}


def test_rivals_hold_the_truth_where_it_cannot_be_told():
    """A tilting base looks like a yielding second joint: whatever is named, both are in the set."""
    for seed in (1, 2):
        choice = select_arm_effects(opened(GapCause("base_flex", "frame", 60.0), seed=seed), ())
        table, named = choice.compare_with_others(0)
        found = find_alternatives(table, named)
        names = {named.candidate.key, *(other.candidate.key for other, _, _ in found)}
        assert ("base_flex", "frame") in names
        for _, rho2, power in found:
            assert 0.0 <= rho2 <= 1.0
            assert power >= 0.0


def test_two_effects_that_are_both_there_are_no_rivals():
    """Fits as good as one another, of which each is needed beside the other."""
    names = (("encoder_gain", "J2"), ("backlash", "J2"))
    made = opened(*(GapCause(*name, 300.0) for name in names), seed=4)
    lib = build_library_of_testable_arm_laws(made.scene, made.rows)
    table = build_candidate_tests(lib, ())
    pair = [next(c for c in lib.candidates if c.key == name) for name in names]
    for one, other in (pair, pair[::-1]):
        best = table.fit_candidate(one)
        assert other.key not in {
            found.candidate.key for found, _, _ in find_alternatives(table, best)
        }
        beside = build_candidate_tests(
            lib, (other,)
        )  # at noises of its own: the gain is the same to a tenth
        expected = beside.single_test_p_value(beside.fit_candidate(one))
        found = table.p_value_beside_candidate(best, other) / table.effective_test_count(one)
        assert_allclose(np.log(found), np.log(expected), rtol=0.1)


def test_a_cause_and_what_resembles_it_stay_rivals():
    """The one that is not there is of no use beside the truth, five times of five."""
    for seed in range(5):
        made = opened(GapCause("joint_compliance", "J2", 400.0), seed=seed)
        lib = build_library_of_testable_arm_laws(made.scene, made.rows)
        table = build_candidate_tests(lib, ())
        names = (("joint_compliance", "J2"), ("base_flex", "frame"))
        truth, like = (next(c for c in lib.candidates if c.key == name) for name in names)
        assert (
            table.p_value_beside_candidate(table.fit_candidate(like), truth)
            >= FALSE_NAME_PROBABILITY
        )
        assert table.p_value_beside_candidate(table.fit_candidate(truth), truth) == 1.0


def test_lambda_is_the_one_that_was_asked_for():
    """The generator's detectability and the diagnosis' agree to 35 %, masses being 15 % off."""
    made = opened(GapCause("joint_compliance", "J3", 400.0), seed=6)
    choice = select_arm_effects(made, ())
    table, one = choice.compare_with_others(0)
    size, rho2 = table.similarity_to_candidate(one, one.candidate)
    assert abs(size / 400.0 - 1.0) < 0.35
    assert rho2 > 1.0 - 1e-6


def test_values_are_those_of_least_squares():
    """Without jitter the fit beside the geometry is plain least squares on both."""
    made = opened(GapCause("encoder_gain", "J2", 500.0), seed=8)
    lib = build_library_of_testable_arm_laws(made.scene, made.rows)
    c = next(c for c in lib.candidates if c.key == ("encoder_gain", "J2"))
    settings = forward_selection.build_candidate_tests(lib, ()).projected_products
    still = int(np.flatnonzero(settings.noise_ratios == 0.0)[0])
    gain, value, *_ = (
        x[still] for x in settings.fit_all_candidates(EqualShapeCandidates.from_candidates([c]), 1)
    )
    matrix = np.concatenate(
        [made.rows.nuisance_basis, lib.candidate_columns[:, c.column_indices]], axis=1
    )
    expected, squares, *_ = np.linalg.lstsq(matrix, made.rows.error, rcond=None)
    assert_allclose(value[0, 0], expected[-1], rtol=1e-8)
    assert_allclose(settings.error_squares[still] - gain[0], squares[0], rtol=1e-8)


def yielding(study: LinearisedGeometry, tool: Array, stiff: Array) -> LinearisedGeometry:
    """The study of an arm without told masses that gives way, with 4 kg on its flange.

    tool: (3,) where they hang in the last frame [m].  stiff: (n,) compliances [rad/(N m)].
    """
    robot = study.scene.robot
    scene = replace(study.scene, robot=replace(robot, mass=np.full(6, np.nan)))
    mass, com = (part.copy() for part in scene.link_masses_and_centres)
    com[-1] = (mass[-1] * com[-1] + 4.0 * tool) / (mass[-1] + 4.0)
    mass[-1] += 4.0
    torque = scene.drive_gravity_torques(mass, com)
    moved = np.einsum("n,nm,nkcm->kcm", stiff, torque, scene.jacobian)
    rows = study.rows
    rest = rows.rows_from_fields(moved[None])[:, 0]
    rest -= rows.nuisance_basis @ (rows.nuisance_basis.T @ rest)
    return replace(study, scene=scene, rows=replace(rows, error=rows.error + rest))


SOFT = np.array([0.0, 1e-6, 1.5e-6, 1e-5, 1.5e-5, 4e-5])


def test_the_weight_of_an_untold_tool_is_found_beside_the_axis():
    made = yielding(opened(seed=3, poses=200), np.array([0.06, -0.08, 0.1]), SOFT)
    choice = select_arm_effects(made, ())
    (one,) = choice.candidates
    assert one.key == ("joint_compliance", "all")
    assert "tool" in one.term.choice
    value, sigma = choice.joint_estimates[0]
    assert (value > -4.0 * sigma)[one.nonnegative].all()
    names = one.term.columns(made.scene).names
    for j, a, lever in ((5, "x", 0.06), (5, "y", -0.08), (6, "x", 0.06), (6, "y", -0.08)):
        i = names.index(f"c{j} (tool {a})")
        assert abs(value[i] - SOFT[j - 1] * 4.0 * lever / 0.1) < 4.0 * sigma[i]


def test_a_tool_on_the_axis_needs_no_levers():
    made = yielding(opened(seed=3, poses=200), np.array([0.0, 0.0, 0.1]), SOFT)
    choice = select_arm_effects(made, ())
    assert [c.key for c in choice.candidates] == [("joint_compliance", "all")]
    assert "tool" not in choice.candidates[0].term.choice


def test_what_signs_cost_is_the_rise_of_the_bounded_square():
    """Against least squares with bounds on all rows: no compliance below 0."""
    made = yielding(opened(seed=5), np.array([0.0, 0.0, 0.1]), -SOFT)
    lib = build_library_of_testable_arm_laws(made.scene, made.rows)
    terms = ["joint_compliance:all", "backlash:J1", "link_bending:L2"]
    found = {c.term.label: c for c in lib.candidates if not c.term.choice.get("tool")}
    fits, chosen_ = [], []
    for text in terms:
        fits.append(
            forward_selection.build_candidate_tests(lib, chosen_, fits).fit_candidate(found[text])
        )
        chosen_.append(found[text])
    noise = forward_selection.estimate_noise_beside(lib, fits)
    main, loose, ridge = forward_selection.list_columns_and_ridges(chosen_, fits)
    weight = noise.row_weights(made.rows)
    free = np.column_stack(
        [made.rows.nuisance_basis, lib.candidate_columns[:, main], lib.candidate_columns[:, loose]]
    )
    count, none = made.rows.nuisance_basis.shape[1], np.zeros((len(loose), free.shape[1]))
    none[:, free.shape[1] - len(loose) :] = np.diag(np.sqrt(ridge))
    matrix = np.concatenate([free * np.sqrt(weight)[:, None], none])
    scale = np.linalg.norm(matrix, axis=0)
    right = np.concatenate([made.rows.error * np.sqrt(weight), np.zeros(len(loose))])
    low = np.full(matrix.shape[1], -np.inf)
    upward = np.concatenate([c.nonnegative for c in chosen_])
    low[count : count + len(upward)][upward] = 0.0
    bounded, plain = (
        2.0 * lsq_linear(matrix / scale, right, (least, np.inf), method="bvls", tol=1e-12).cost
        for least in (low, np.full_like(low, -np.inf))
    )
    assert bounded - plain > 100.0
    assert_allclose(deviance_of_sign_constraints(lib, fits, noise), bounded - plain, rtol=1e-5)
    for c, (value, sigma) in zip(
        chosen_, forward_selection.estimate_jointly(lib, fits, noise), strict=True
    ):
        assert (value >= -1e-9 * sigma)[c.nonnegative].all()


def test_the_open_variant_is_chosen_by_evidence():
    """A text leaves the moment of the shift open: the fit then uses the right one."""
    import minimax_cal as mc

    sealed = build_and_measure_arm(
        GapCase("irb2600", "single", (GapCause("target_shift", "smr2", 2000.0),), seed=9)
    )
    fit = mc.calibrate(sealed.robot, sealed.data, objective="sum", effects=["target_shift:smr2"])
    truth = float(np.sqrt((sealed.floor * 1e3) ** 2))
    assert fit.accuracy["holdout"].rms_mm < 1.1 * truth


def test_resemblance_knows_the_law():
    sealed = build_and_measure_arm(
        GapCase("irb2600", "single", (GapCause("gear_error", "J3", 300.0),), seed=1)
    )
    alike = effect_similarities(sealed.robot, sealed.data, sealed.displacement)
    assert alike["gear_error", "J3"] > 0.99
    assert alike["target_offset", "smr1"] < 0.2


# ---- stability -----------------------------------------------------------------------------------


A, B, C = ("a", "x"), ("b", "x"), ("c", "x")


def repeats(*names: set[tuple[str, str]], asked: int | None = None) -> SubsampleSelections:
    return SubsampleSelections(tuple(map(frozenset, names)), asked or len(names))


def test_a_frequency_is_the_share_of_subsamples_that_find_one_of_the_names():
    found = repeats({A}, {A, B}, {B}, {C})
    assert found.selection_frequency({A}) == 0.5
    assert found.selection_frequency({A, B}) == 0.75
    assert found.selection_frequency(set()) == 0.0
    assert np.isnan(repeats({A}, {A}, asked=5).selection_frequency({A}))  # most had too few rows
    assert repeats({A}, {A}, asked=4).selection_frequency({A}) == 1.0


def test_a_name_takes_the_place_of_another_where_it_is_found_without_it():
    assert repeats({A}, {A}, {B}, {B}).find_replacing_keys({A}) == [B]
    assert repeats({A}, {A}, {A}, {A}, {A}, {B}).find_replacing_keys({A}) == []  # once in six
    assert repeats({A, C}, {A, C}, {B, C}, {B, C}).find_replacing_keys({A}) == [
        B
    ]  # C is there anyhow


def test_every_group_is_left_out_as_often_and_stays_together():
    group = np.repeat(np.arange(30), 4)
    masks = np.array(build_subsample_masks(group))
    assert len(masks) == SUBSAMPLE_PART_COUNT * SUBSAMPLE_ROUND_COUNT
    assert np.all(
        masks.reshape(SUBSAMPLE_ROUND_COUNT, SUBSAMPLE_PART_COUNT, -1).sum(axis=1)
        == SUBSAMPLE_PART_COUNT - 1
    )
    assert np.all(masks.reshape(len(masks), 30, 4) == masks.reshape(len(masks), 30, 4)[..., :1])
    assert np.all(masks.sum(axis=1) == 80)


def test_halves_keep_groups_together_and_every_group_is_in_one_of_a_pair():
    masks = np.array(build_half_masks(np.repeat(np.arange(9), 4), 2)).reshape(2, 2, 9, 4)
    assert np.all(masks[:, 0] != masks[:, 1])
    assert np.all(masks == masks[..., :1])
    assert np.all(masks[..., 0].sum(axis=2) == [4, 5])


@dataclass(frozen=True, eq=False)
class Straight:
    """A domain without a robot: y = sum of known regressors, each a law of one parameter."""

    problem: LinearProblem
    regressors: Array

    def spec(self, term: Any) -> LawColumns | None:
        number = int(term.number)
        none = np.zeros((len(self.regressors), 0))
        free = np.zeros(1, dtype=bool)
        column = self.regressors[:, [number]]
        return LawColumns(
            term,
            term.text,
            (term.text, "x"),
            column,
            none,
            np.zeros(0, dtype=int),
            free,
            1.0,
            0,
            False,
        )

    def finer(self, term: Any) -> Sequence[Any]:
        return ()

    def lines(self, noise: Noise, known: Array, found: Sequence[Any]) -> list[tuple[Any, float]]:
        return []

    def is_expected(self, line: Any, found: Sequence[Any]) -> bool:
        return False


@dataclass(frozen=True)
class Law:
    number: int

    @property
    def text(self) -> str:
        return f"law {self.number}"


def straight(
    rng: np.random.Generator, sizes: dict[int, float], rows: int = 240
) -> CandidateLibrary:
    regressors = rng.normal(size=(rows, 30))
    error = rng.normal(size=rows) + sum(
        size * regressors[:, number] for number, size in sizes.items()
    )
    basis = orthonormal_basis(rng.normal(size=(rows, 5)))
    error = error - basis @ (basis.T @ error)
    spread = rng.uniform(0.5, 1.5, rows)
    group = np.arange(rows) // 3
    measured = np.ones(rows, dtype=bool)
    problem = LinearProblem(error, basis, spread / spread.mean(), 1.0, group, measured, 1e-9)
    return CandidateLibrary.from_terms(
        Straight(problem, regressors), [Law(i) for i in range(30)], ()
    )


def test_a_law_of_any_domain_is_found_again_and_a_faint_one_less_often(rng):
    whole = select_effects_by_evidence(straight(rng, {3: 1.0, 7: 0.25}))
    names = [c.key for c in whole.candidates]
    assert ("law 3", "x") in names
    found = select_on_subsamples(whole, build_subsample_masks(whole.library.problem.row_groups))
    assert len(found.found_keys) == SUBSAMPLE_PART_COUNT * SUBSAMPLE_ROUND_COUNT
    assert found.selection_frequency({("law 3", "x")}) == 1.0
    assert found.selection_frequency({("law 7", "x")}) < 1.0
    assert found.selection_frequency({("law 1", "x")}) < 0.5


def test_rows_too_few_for_their_geometry_are_not_asked(rng):
    whole = select_effects_by_evidence(straight(rng, {3: 5.0}, rows=27))
    found = select_on_subsamples(whole, build_subsample_masks(whole.library.problem.row_groups))
    assert found.found_keys == ()
    assert np.isnan(found.selection_frequency({("law 3", "x")}))


# ---- library -------------------------------------------------------------------------------------


POSES, MOVED = 400, 163


@pytest.fixture(scope="module")
def shifted(robot: Robot) -> LinearisedGeometry:
    """400 poses; the first of two targets sits 0.3 mm elsewhere after some of them."""
    sim = simulate(robot, POSES, 2, seed=1, truth=Truth(compliance=0.0))
    seats = sim.cell.target_positions + np.array([[2e-4, -1e-4, 2e-4], [0.0, 0.0, 0.0]])
    moved = replace(sim.cell, target_positions=seats).predict(sim.data.q)
    moved -= sim.cell.predict(sim.data.q)
    after = (np.arange(POSES) >= MOVED)[:, None, None]
    data = add_history_columns(sim.data.with_y(sim.data.y + np.where(after, moved, 0.0)))
    return linearise_geometry(
        robot, data, fit_cell(robot, data, LEAST_SQUARES_OPTIONS, silent_progress)
    )


def test_motions_that_differ_at_one_pose_are_two(shifted):
    clock = np.sort(shifted.scene.column("clock"))
    terms = [
        (Term("target_shift", target, {"since": float(clock[row])}), 1.0)
        for target in shifted.data.target_names
        for row in (*range(150, 180), POSES - 4)
    ]
    found = CandidateLibrary.without_candidates(ArmLaws(shifted.scene, shifted.rows)).add_terms(
        terms
    )
    every = np.concatenate([candidate.column_indices for candidate in found])
    assert len(np.unique(every)) == len(every) == 3 * len(terms)


def test_a_nest_moved_at_the_pose_at_which_it_did(shifted):
    found = select_effects_by_evidence(
        build_library_of_testable_arm_laws(shifted.scene, shifted.rows, ("gear_ripple",))
    ).candidates
    clock = np.sort(shifted.scene.column("clock"))
    assert [c.term.label for c in found] == ["target_shift:smr1"]
    assert found[0].term.choice["since"] == clock[MOVED]


@pytest.mark.parametrize("off", [-30, 1, 17, 30])
def test_a_moment_is_found_from_one_nearby(shifted, off):
    clock = np.sort(shifted.scene.column("clock"))
    term = Term("target_shift", "smr1", {"since": float(clock[MOVED + off])})
    lib = CandidateLibrary.without_candidates(ArmLaws(shifted.scene, shifted.rows))
    near = lib.add_terms([(term, 1.0)])
    table = build_candidate_tests(replace(lib, candidates=tuple(near)), ())
    assert (
        tune_candidate(table, table.fit_candidate(near[0])).candidate.term.choice["since"]
        == clock[MOVED]
    )
