"""Products formed once: the same as sums over the rows that count, for any ratio of the noises."""

import gc
import weakref
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose
from problems_fit import ROUNDING, check_products, rough_study, study, study_of

from experiments.gap_cases import GapCase, GapCause, build_and_measure_arm
from minimax_cal.core.arrays import Array
from minimax_cal.diagnosing.study import LinearisedGeometry, linearise_geometry
from minimax_cal.fitting.cell_fit import fit_cell
from minimax_cal.fitting.options import Options, silent_progress
from minimax_cal.measuring.pose_groups import split_train_and_holdout
from minimax_cal.measuring.visit_history import add_history_columns
from minimax_cal.modelling.arm_laws import ArmLaws, build_library_of_testable_arm_laws
from minimax_cal.modelling.effects.table import Term
from minimax_cal.modelling.gear_periodogram import sum_wave_products
from minimax_cal.selection import noise_model
from minimax_cal.selection import thresholds as noise_thresholds
from minimax_cal.selection.candidate_library import CandidateLibrary, LawColumns, LawDictionary
from minimax_cal.selection.candidate_tests import build_candidate_tests
from minimax_cal.selection.forward_selection import (
    NO_COLUMNS,
    EffectSelection,
    retune_selection,
    select_effects_by_evidence,
)
from minimax_cal.selection.gram_products import MIN_PROJECTED_SQUARE_FRACTION
from minimax_cal.selection.noise_model import (
    CHEBYSHEV_NODES_PER_DECADE,
    LinearProblem,
    Noise,
    chebyshev_interpolation,
    decade_noise_ratios,
    estimate_noise_by_reml,
    estimate_noise_inflation,
    find_best_noise_ratio,
    fit_variance_components,
    orthonormal_basis,
)
from minimax_cal.selection.subsample_products import (
    SUBSAMPLE_RATIO_COUNT,
    SubsampleProducts,
    build_ratio_grid,
)
from minimax_cal.selection.thresholds import MIN_NOISE_DEGREES_OF_FREEDOM
from tests.thresholds import LIMITS, thresholds

# ---- products ------------------------------------------------------------------------------------


TRIED = np.array([0.0, 0.013, 0.4, 3.7, 1.0e4])


@pytest.fixture(scope="module")
def rough() -> LinearisedGeometry:
    return rough_study()


@pytest.fixture(scope="module")
def lib(rough: LinearisedGeometry) -> CandidateLibrary:
    return build_library_of_testable_arm_laws(rough.scene, rough.rows)


@pytest.mark.parametrize("decade", [-3, 0, 4])
def test_polynomials_of_a_decade_give_every_weight(decade):
    ratios = 10.0 ** np.linspace(decade, decade + 1, 101)
    variance = np.concatenate([[0.0], np.logspace(-9, 6, 301)])

    def weights(ratios: Array) -> Array:
        return np.asarray(1.0 / (1.0 + np.outer(ratios, variance)))

    between = chebyshev_interpolation(np.log10(ratios) - decade, CHEBYSHEV_NODES_PER_DECADE)
    found = between @ weights(decade_noise_ratios(decade))
    assert_allclose(found, weights(ratios), rtol=1e-9)


def check_sums(products: Any, ratios: Array, variance_ratio: Array, kept: Array | float) -> None:
    """Of what weighted least squares on the geometry leave of the columns."""
    index, sets = np.array([3, 17, 18]), np.array([[0, 5], [7, 30]])
    columns = products.columns
    clear, found = (
        columns.projected_columns[columns.fixed - 1 :],
        products.products_at_ratios(ratios, index),
    )
    for i, ratio in enumerate(ratios):
        weight = kept / (1.0 + ratio * variance_ratio)
        geometry = products.geometry_columns * np.sqrt(weight)
        check_products(found, i, index, sets, clear, geometry, weight, columns.candidate_columns)


def test_products_are_the_sums_over_rows(rough):
    products = build_library_of_testable_arm_laws(rough.scene, rough.rows).products
    check_sums(products, TRIED, rough.rows.variance_ratio, 1.0)


def test_columns_are_stored_without_what_geometry_imitates(lib, rough):
    clear = lib.products.projected_candidate_columns(np.arange(lib.products.columns.count))
    size = np.linalg.norm(lib.candidate_columns, axis=0)
    assert np.all(ROUNDING * size >= np.abs(clear @ rough.rows.nuisance_basis).T)
    basis = rough.rows.nuisance_basis
    assert_allclose(lib.candidate_columns - clear.T, basis @ (basis.T @ lib.candidate_columns),
                    rtol=0, atol=ROUNDING * np.abs(lib.candidate_columns).max())  # fmt: skip


def test_what_is_left_of_a_column_is_that_of_the_column_and_geometry(rough):
    """A thousand times as much geometry in it changes no product; geometry alone leaves least."""
    products = build_library_of_testable_arm_laws(rough.scene, rough.rows).products
    columns, basis = products.columns, rough.rows.nuisance_basis
    column = columns.candidate_columns[:, 3]
    more = 1e3 * np.linalg.norm(column) * basis[:, 0]
    (again, alone) = columns.append(np.stack([column + more, more], axis=1))
    gram, _ = products.projected_gram_at_ratios(np.zeros(1), np.array([3, again]))
    rest = columns.projected_columns[columns.fixed + 3]
    assert_allclose(gram[0, :2, :2], rest @ rest, rtol=ROUNDING)
    assert (
        np.linalg.eigvalsh(gram[0, :2, :2])[0] > 0.5 * MIN_PROJECTED_SQUARE_FRACTION * rest @ rest
    )  # the same, twice
    gram, _ = products.projected_gram_at_ratios(np.zeros(1), np.array([alone]))
    assert gram[0, 0, 0] == pytest.approx(MIN_PROJECTED_SQUARE_FRACTION * more @ more, rel=ROUNDING)


def test_candidates_stored_nowhere_compare_as_stored_ones(lib):
    chosen = [next(c for c in lib.candidates if c.key == ("joint_compliance", "all"))]
    term = Term("gear_ripple", "J4", {"turns": 33.3})
    table = build_candidate_tests(lib, chosen)
    aside = lib.build_temporary_candidates([(term, 5.0)])
    loose = table.with_temporary_candidates(aside).fit_candidate(aside.candidates[0])
    (stored,) = lib.add_terms([(term, 5.0)])
    held = build_candidate_tests(lib, chosen).fit_candidate(stored)
    assert_allclose(loose.values, held.values, rtol=1e-9)
    assert_allclose(
        [loose.likelihood_gain, loose.evidence], [held.likelihood_gain, held.evidence], rtol=1e-8
    )


def test_where_no_line_is_sought_none_is_compared(lib):
    """No joint moves enough for a line: nothing aside, with and without effects chosen."""
    for chosen in ([], list(lib.candidates[:1])):
        assert (
            build_candidate_tests(lib, chosen)
            .with_temporary_candidates(lib.build_temporary_candidates(()))
            .rank_candidates(())
            == []
        )


def test_waves_on_a_grid_are_sums_over_poses(rng):
    q, score, size = rng.uniform(-3, 3, 40), rng.normal(size=40), rng.uniform(size=40)
    turns = np.arange(8.0, 260.0, 0.31)
    pull, square, whole = sum_wave_products(turns, q, score, size)
    waves = np.exp(1j * np.outer(turns, q))
    assert_allclose(pull, waves @ score, rtol=0, atol=1e-11)
    assert_allclose(square, waves**2 @ size, rtol=0, atol=1e-11)
    assert whole == pytest.approx(size.sum())


def test_products_know_no_order_of_columns(rng):
    """Columns that come later have the same products as those that were there before."""
    quiet = study(6e-6, 1.0, 0)
    early = build_library_of_testable_arm_laws(quiet.scene, quiet.rows)
    late = CandidateLibrary.without_candidates(ArmLaws(quiet.scene, quiet.rows))
    terms = [c.term for c in early.candidates][:6]
    for term in terms:  # one by one, products asked for in between
        (found,) = late.add_terms([(term, 1.0)])
        first = late.later_candidates[
            terms[0].text
        ].column_indices  # as two effects that share a column
        twice = np.concatenate([first, found.column_indices, first])
        late.products.products_at_ratios(TRIED[:2], twice)
    index = np.concatenate([late.later_candidates[term.text].column_indices for term in terms])
    same = np.concatenate([c.column_indices for c in early.candidates[:6]])
    ours = late.products.products_at_ratios(TRIED[:2], index).products_with_candidates[:, :, index]
    theirs = early.products.products_at_ratios(TRIED[:2], same).products_with_candidates[:, :, same]
    assert_allclose(ours, theirs, rtol=1e-10, atol=1e-12 * np.abs(theirs).max())


def test_laws_leave_no_scene_behind(rough):
    """A scene keeps its laws, and its laws not the scene: it goes with the last name for it."""
    scene = replace(rough.scene)
    Term("link_bending", "L2").columns(scene).displacement_uncertainties(scene)
    held = weakref.ref(scene)
    gc.disable()
    try:
        del scene
        assert held() is None
    finally:
        gc.enable()


# ---- sweeping ------------------------------------------------------------------------------------


NEAR = 0.5  # relative difference of a ratio among few from the likeliest of all


@pytest.fixture(scope="module")
def whole(rough: LinearisedGeometry) -> EffectSelection:
    return select_effects_by_evidence(build_library_of_testable_arm_laws(rough.scene, rough.rows))


@pytest.fixture(scope="module")
def kept(rough: LinearisedGeometry) -> Array:
    """The rows of all poses but every sixth."""
    return rough.rows.row_mask_of_poses(np.arange(rough.scene.poses) % 6 != 2)


@pytest.fixture(scope="module")
def swept(whole: EffectSelection, kept: Array) -> SubsampleProducts:
    return SubsampleProducts(whole.shared_grams, kept)


def some_rows(rows: LinearProblem, kept: Array) -> LinearProblem:
    return LinearProblem(
        rows.error[kept],
        orthonormal_basis(rows.nuisance_basis[kept]),
        rows.variance_ratio[kept],
        rows.mean_variance_ratio,
        rows.row_groups[kept],
        rows.measured[kept],
        rows.rounding_noise,
    )


def test_products_of_a_part_are_sums_over_its_rows(swept, rough, kept):
    check_sums(swept, swept.ratios[[0, 3, 1]], rough.rows.variance_ratio, kept)
    span, basis = swept.swept.span, rough.rows.nuisance_basis[kept]
    assert_allclose(span.T @ basis.T @ basis @ span, np.eye(span.shape[1]), rtol=0, atol=ROUNDING)


def test_the_noise_of_a_part_is_that_of_its_rows_alone(swept, rough, kept):
    alone = some_rows(rough.rows, kept)
    index = np.array([4, 9])
    expected = estimate_noise_by_reml(alone, swept.columns.candidate_columns[kept][:, index])
    found = swept.estimate_noise(index)
    assert found.joint_to_instrument_ratio in swept.ratios
    assert_allclose(found.joint_to_instrument_ratio, expected.joint_to_instrument_ratio, rtol=NEAR)
    assert_allclose(found.variance, expected.variance, rtol=0.1)
    assert (
        swept.degrees_of_freedom(index)
        == alone.measured_row_count - alone.nuisance_basis.shape[1] - 2
    )


def test_few_rows_have_the_noise_of_their_mean_square(whole, rough):
    """Fewer than `MIN_NOISE_DEGREES_OF_FREEDOM` degrees of freedom tell no two noises apart."""
    number = np.arange(rough.scene.poses)
    parts = [
        SubsampleProducts(whole.shared_grams, rough.rows.row_mask_of_poses(number < count))
        for count in (1, 2, 3)
    ]
    few = next(
        part for part in parts if part.degrees_of_freedom(NO_COLUMNS) < MIN_NOISE_DEGREES_OF_FREEDOM
    )
    noise, error = few.estimate_noise(NO_COLUMNS), rough.rows.error[few.kept]
    assert noise.joint_to_instrument_ratio == noise.joint_jitter == 0.0
    assert_allclose(noise.variance, float(error @ error) / few.kept.sum(), rtol=1e-6)


def test_a_candidate_beside_others_is_least_squares_on_the_rows_that_count(whole, rough, kept):
    some = whole.take_rows(kept)
    first, second = (next(c for c in some.candidates
                          if c.key == key and not len(c.variation_column_indices))
                     for key in (("backlash", "J2"), ("gear_error", "J3")))  # fmt: skip
    one = build_candidate_tests(some, [first]).fit_candidate(second)
    root = np.sqrt(kept / (1.0 + one.noise_ratio * rough.rows.variance_ratio))[:, None]
    columns = some.candidate_columns[
        :, np.concatenate([first.column_indices, second.column_indices])
    ]
    matrix = np.concatenate([rough.rows.nuisance_basis, columns], axis=1) * root
    expected = np.linalg.lstsq(matrix, rough.rows.error * root[:, 0], rcond=None)[0]
    assert_allclose(one.values, expected[-2:], rtol=1e-8)


@dataclass(frozen=True, eq=False)
class Some:
    """A dictionary of some rows alone, which never held others."""

    of: LawDictionary
    kept: Array

    @property
    def problem(self) -> LinearProblem:
        return some_rows(self.of.problem, self.kept)

    def spec(self, term: Any) -> LawColumns | None:
        found = self.of.spec(term)
        if found is None:
            return None
        columns, doubts = found.columns[self.kept], found.prior_variations[self.kept]
        return replace(found, columns=columns, prior_variations=doubts)

    def finer(self, term: Any) -> Sequence[Any]:
        return ()

    def lines(self, noise: Noise, known: Array, found: Sequence[Any]) -> list[tuple[Any, float]]:
        return []

    def is_expected(self, line: Any, found: Sequence[Any]) -> bool:
        return self.of.is_expected(line, found)


@pytest.mark.parametrize(
    ("third", "causes", "poses"),
    [
        (0, (), 60),
        (1, (GapCause("joint_compliance", "J3", 300.0),), 100),
        (2, (GapCause("gear_error", "J2", 100.0), GapCause("frame_drift", "frame", 300.0)), 100),
    ],
)
def test_a_part_names_what_its_rows_alone_name(third, causes, poses):
    """From the same candidates, at the likeliest ratio of all and not of few."""
    made = study_of(
        build_and_measure_arm(GapCase("irb2600", "single", causes, seed=5, poses=poses))
    )
    choice = select_effects_by_evidence(build_library_of_testable_arm_laws(made.scene, made.rows))
    kept = made.rows.row_mask_of_poses(np.arange(made.data.poses) % 3 != third)
    part = choice.take_rows(kept)
    found = select_effects_by_evidence(part)
    terms = [c.term for c in part.candidates]
    alone = select_effects_by_evidence(
        CandidateLibrary.from_terms(Some(choice.library.dictionary, kept), terms, ())
    )
    assert {c.key for c in found.candidates} == {c.key for c in alone.candidates}
    assert len(found.candidates) >= len(causes)


def test_a_part_tunes_again_what_it_ends_with():
    """By its own rows: a nest that moved late is dated by those poses alone."""
    sealed = study_of(
        build_and_measure_arm(
            GapCase("irb2600", "single", (GapCause("target_shift", "smr2", 1000.0),))
        )
    )
    choice = select_effects_by_evidence(
        build_library_of_testable_arm_laws(sealed.scene, sealed.rows)
    )
    (one,) = choice.candidates
    clock = sealed.scene.data.columns["clock"]
    away = np.abs(clock - one.term.choice["since"]) < 0.05 * np.ptp(clock)
    part = select_effects_by_evidence(choice.take_rows(sealed.rows.row_mask_of_poses(~away)))
    (held,) = part.candidates  # of any moment among the rows left out: those give the same columns
    assert held.key == one.key
    assert abs(held.term.choice["since"] - one.term.choice["since"]) < 0.05 * np.ptp(clock)
    before = len(part.library.candidate_columns.T)
    (again,) = retune_selection(part).candidates
    assert again.term.key == one.key
    assert len(part.library.candidate_columns.T) == before


def test_a_part_that_shows_hardly_anything_of_a_cause_does_not_test_it():
    """A nest that moved late, and poses from before: rounding is left of its columns."""
    made = study(jitter=0.0, noise=1.0, seed=3)
    choice = select_effects_by_evidence(build_library_of_testable_arm_laws(made.scene, made.rows))
    shift = next(c for c in choice.library.candidates if c.term.effect == "target_shift")
    since = made.scene.data.columns["clock"] < shift.term.choice["since"]
    part = choice.take_rows(made.rows.row_mask_of_poses(since))
    assert shift.text not in {c.text for c in part.candidates}
    select_effects_by_evidence(part)  # and no warning


def test_parts_leave_no_memory_behind(whole, kept):
    """Products are large: they go with the last name for them, not when a collector comes."""
    part = whole.take_rows(kept)
    choice = select_effects_by_evidence(part)
    assert choice.compare_with_others(0)
    held = weakref.ref(part.products)
    gc.disable()
    try:
        del part, choice
        assert held() is None
    finally:
        gc.enable()


# ---- ratios --------------------------------------------------------------------------------------


def bowl(least: float, bent: float = 0.0) -> Array:
    """The ratio of least cost where that is a bowl about a power of ten, and 1e3 without joints."""

    def cost(ratios: Array) -> Array:
        off = np.log10(np.where(ratios > 0.0, ratios, 1.0)) - least
        return np.where(ratios > 0.0, off**2 + bent * off**4, 1e3)

    return np.log10(find_best_noise_ratio(cost))


@pytest.mark.parametrize("least", [-2.9, -2.02, -0.3, 0.0, 1.7183, 4.4, 4.95])
def test_the_likeliest_ratio_is_found_between_those_that_are_tried(least):
    assert_allclose(bowl(least), least, rtol=0, atol=1e-9)
    assert_allclose(bowl(least, bent=1.0), least, rtol=0, atol=1e-6)


def test_beyond_the_ends_it_is_the_end():
    assert_allclose(
        [bowl(-4.5), bowl(7.0)],
        np.log10(noise_model.SEARCHED_NOISE_RATIOS[[1, -1]]),
        atol=1e-12,
    )


def test_it_is_none_where_none_is_better():
    assert find_best_noise_ratio(lambda ratios: np.where(ratios > 0.0, 1.0, 0.0)) == 0.0
    assert find_best_noise_ratio(lambda ratios: 0.0 * ratios) == 0.0


# ---- components ----------------------------------------------------------------------------------


def test_variances_of_groups_and_noise_are_found():
    rng = np.random.default_rng(0)
    group = np.repeat([0, 1, 2], 60)
    sigma = np.array([3.0, 0.0, 0.5])
    columns = rng.normal(size=(2000, 180))
    error = columns @ (sigma[group] * rng.normal(size=180)) + 2.0 * rng.normal(size=2000)
    basis = np.linalg.qr(rng.normal(size=(2000, 10)))[0]
    error, columns = (part - basis @ (basis.T @ part) for part in (error, columns))
    found = fit_variance_components(
        columns.T @ columns, columns.T @ error, float(error @ error), 1990, group
    )
    assert abs(np.sqrt(found.noise) / 2.0 - 1.0) < 0.05
    spread = np.sqrt(found.variance)
    assert np.all(np.abs(spread[[0, 2]] / sigma[[0, 2]] - 1.0) < 0.2)
    assert spread[1] < 0.05


# ---- limits --------------------------------------------------------------------------------------


MOST = 45


def test_numbers_that_decide_are_few_and_in_one_module():
    found = thresholds()
    assert [name for name in found if not name.startswith(LIMITS)] == []
    assert len(found) <= MOST
    assert (
        found[f"{LIMITS}:ALTERNATIVE_EVIDENCE_DEFICIT"]
        == noise_thresholds.ALTERNATIVE_EVIDENCE_DEFICIT
    )


# ---- noise ---------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def quiet() -> LinearisedGeometry:
    return study(6e-6, 1.0, 0)


def test_rotated_rows_keep_every_square(quiet, rng):
    fields = rng.normal(size=(4, *quiet.scene.points.shape))
    rows = quiet.rows.rows_from_fields(fields)
    assert_allclose(rows.T @ rows, fields.reshape(4, -1) @ fields.reshape(4, -1).T, rtol=1e-12)
    assert_allclose(quiet.rows.rows_to_points(rows[:, 2]), fields[2], rtol=0, atol=1e-12)


def test_the_variance_of_a_row_is_that_of_its_direction(quiet):
    """Each rotated row has variance s^2 + t^2 |S'u|^2, and rows of a pose are uncorrelated."""
    rows, jacobian = quiet.rows, quiet.scene.jacobian
    arms = rows.rows_from_fields(jacobian)  # (N, n)
    pose = 7
    r = rows.weight.shape[1]
    own = arms.reshape(-1, r, jacobian.shape[0])[pose]
    expected = np.diag(rows.variance_ratio.reshape(-1, r)[pose] * rows.mean_variance_ratio)
    assert_allclose(own @ own.T, expected, rtol=0, atol=1e-9 * expected.max())


@pytest.mark.parametrize(("jitter", "noise"), [(0.0, 1.0), (6e-6, 1.0), (20e-6, 1.0), (6e-6, 2.0)])
def test_noise_and_jitter_are_found(jitter, noise):
    """Means over eight arms, within 15 % (a fifth of the mean instrument noise for no jitter)."""
    found = []
    for seed in range(8):
        made = study(jitter, noise, seed)
        away = np.linalg.norm(made.data.y, axis=-1).mean()
        one = estimate_noise_by_reml(made.rows, np.zeros((len(made.rows.error), 0)))
        truth = noise * (10e-6 + 2.5e-6 * away)
        found.append((one.joint_jitter, np.sqrt(one.variance) / truth))
    mean_jitter, mean_ratio = np.mean(found, axis=0)
    assert abs(mean_ratio - 1.0) < 0.1
    assert abs(mean_jitter - jitter) < max(0.15 * jitter, 2e-6)


def test_the_variance_counts_what_the_fit_took(rng):
    """Half of the rows' freedom is in the fit: dividing by their number would say 0.5."""
    n, p = 300, 150
    found = []
    for _ in range(20):
        basis = np.linalg.qr(rng.normal(size=(n, p)))[0]
        noise = rng.normal(size=n)
        rest = noise - basis @ (basis.T @ noise)
        rows = LinearProblem(
            rest, basis, np.ones(n), 1.0, np.arange(n), np.ones(n, dtype=bool), 0.0
        )
        found.append(estimate_noise_by_reml(rows, np.zeros((n, 0))))
    total = [
        one.variance * (1.0 + one.joint_to_instrument_ratio) for one in found
    ]  # equal rows: only the sum counts
    assert abs(np.mean(total) - 1.0) < 4.0 * np.sqrt(2.0 / (n - p) / len(found))


def test_a_problem_without_freedom_has_a_noise(quiet):
    rows = quiet.rows
    few = LinearProblem(
        rows.error[:9], np.eye(9), rows.variance_ratio[:9], rows.mean_variance_ratio,
        rows.row_groups[:9], rows.measured[:9], rows.rounding_noise,
    )  # fmt: skip
    assert estimate_noise_by_reml(few, np.zeros((9, 0))).variance > 0.0


def test_missing_targets_count_for_nothing(robot):
    made = build_and_measure_arm(GapCase("irb2600", "none", seed=3))
    data = add_history_columns(made.data)
    y = data.y.copy()
    y[::3, 1] = np.nan
    train, _, _ = split_train_and_holdout(data.with_y(y), 0.2, 0)
    one = linearise_geometry(
        made.robot, train, fit_cell(made.robot, train, Options(objective="sum"), silent_progress)
    )
    assert one.rows.measured_row_count == 3 * int(train.seen.sum())
    found = estimate_noise_by_reml(one.rows, np.zeros((len(one.rows.error), 0)))
    assert 12e-6 < np.sqrt(found.variance) < 25e-6


def test_a_field_is_as_noisy_as_its_groups_tell():
    """White rows: 1; an error that all rows of a group share: as many times as there are rows."""
    rng, n, count = np.random.default_rng(5), 3000, 6
    group = np.arange(n) // count
    field = np.sign(rng.normal(size=n // count))[group] * 0.1
    white = [
        estimate_noise_inflation(field, field + rng.normal(size=n), group, n) for _ in range(40)
    ]
    assert abs(np.mean(white) - 1.0) < 0.1
    shared = rng.normal(size=n // count)[group] * np.sqrt(0.5)
    alike = estimate_noise_inflation(
        field, field + shared + np.sqrt(0.5) * rng.normal(size=n), group, n
    )
    assert abs(alike - (1.0 + 0.5 * (count - 1))) < 0.6  # variance of a sum of `count` rows


def test_one_wrong_group_makes_a_field_no_surer():
    rng, n = np.random.default_rng(6), 900
    group, law = np.arange(n) // 9, rng.normal(size=n)
    rest = rng.normal(size=n)
    rest[:9] += 30.0 * np.sign(law[:9])
    field = law * float(law @ rest) / float(law @ law)
    gain = float(field @ field) / float(np.var(rest - field))
    assert gain > 10.0  # as by rows alone: p = 0.001
    assert gain / estimate_noise_inflation(field, rest, group, n) < 2.0


def test_ratios_lie_about_those_of_the_whole():
    found = build_ratio_grid([Noise(2.0, 1.0, 1.0), Noise(0.01, 1.0, 1.0)])
    assert found[0] == 0.0
    assert len(found) == SUBSAMPLE_RATIO_COUNT + 1
    assert found[1] < 0.01 < 2.0 < found[-1]
    assert np.all(np.diff(build_ratio_grid([Noise(0.0, 1.0, 0.0)])) > 0.0)
