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

from experiments.gap_cases import Case, Cause, make
from minimax_cal.diagnosing.study import Study, studied
from minimax_cal.evidence import limits
from minimax_cal.evidence.bench import bench
from minimax_cal.evidence.library import Dictionary, Library, Spec
from minimax_cal.evidence.limits import LEAST_NOISE_DOF
from minimax_cal.evidence.noise import (
    NODES,
    Noise,
    Problem,
    find_ratio,
    fit_components,
    inflation,
    interpolation,
    nodes,
    orthonormal,
    restricted,
)
from minimax_cal.evidence.noise import (
    RATIOS as RATIOS,
)
from minimax_cal.evidence.products import LEAST
from minimax_cal.evidence.selection import NOTHING, Choice, select, tuned_again
from minimax_cal.evidence.sweeping import COUNT, Swept, ratios_about
from minimax_cal.fitting.options import Options, silent
from minimax_cal.fitting.solve import fit_cell
from minimax_cal.ground.arrays import Array
from minimax_cal.measuring.grouping import split
from minimax_cal.measuring.history import with_history
from minimax_cal.modelling.dictionary import ArmLaws, arm_library
from minimax_cal.modelling.effects.table import Term
from minimax_cal.modelling.periodogram import sums
from tests.thresholds import LIMITS, thresholds

# ---- products ------------------------------------------------------------------------------------


TRIED = np.array([0.0, 0.013, 0.4, 3.7, 1.0e4])


@pytest.fixture(scope="module")
def rough() -> Study:
    return rough_study()


@pytest.fixture(scope="module")
def lib(rough: Study) -> Library:
    return arm_library(rough.scene, rough.rows)


@pytest.mark.parametrize("decade", [-3, 0, 4])
def test_polynomials_of_a_decade_give_every_weight(decade):
    ratios = 10.0 ** np.linspace(decade, decade + 1, 101)
    variance = np.concatenate([[0.0], np.logspace(-9, 6, 301)])

    def weights(ratios: Array) -> Array:
        return np.asarray(1.0 / (1.0 + np.outer(ratios, variance)))

    between = interpolation(np.log10(ratios) - decade, NODES)
    found = between @ weights(nodes(decade))
    assert_allclose(found, weights(ratios), rtol=1e-9)


def check_sums(products: Any, ratios: Array, variance_ratio: Array, kept: Array | float) -> None:
    """Of what weighted least squares on the geometry leave of the columns."""
    index, sets = np.array([3, 17, 18]), np.array([[0, 5], [7, 30]])
    columns = products.columns
    clear, found = columns.clear[columns.fixed - 1 :], products.at(ratios, index)
    for i, ratio in enumerate(ratios):
        weight = kept / (1.0 + ratio * variance_ratio)
        geometry = products.geometry * np.sqrt(weight)
        check_products(found, i, index, sets, clear, geometry, weight, columns.raw)


def test_products_are_the_sums_over_rows(rough):
    products = arm_library(rough.scene, rough.rows).products
    check_sums(products, TRIED, rough.rows.variance_ratio, 1.0)


def test_columns_are_stored_without_what_geometry_imitates(lib, rough):
    clear = lib.products.clear(np.arange(lib.products.columns.count))
    size = np.linalg.norm(lib.columns, axis=0)
    assert np.all(ROUNDING * size >= np.abs(clear @ rough.rows.basis).T)
    assert_allclose(lib.columns - clear.T, rough.rows.basis @ (rough.rows.basis.T @ lib.columns),
                    rtol=0, atol=ROUNDING * np.abs(lib.columns).max())  # fmt: skip


def test_what_is_left_of_a_column_is_that_of_the_column_and_geometry(rough):
    """A thousand times as much geometry in it changes no product; geometry alone leaves least."""
    products = arm_library(rough.scene, rough.rows).products
    columns, basis = products.columns, rough.rows.basis
    column = columns.raw[:, 3]
    more = 1e3 * np.linalg.norm(column) * basis[:, 0]
    (again, alone) = columns.append(np.stack([column + more, more], axis=1))
    gram, _ = products.gram(np.zeros(1), np.array([3, again]))
    rest = columns.clear[columns.fixed + 3]
    assert_allclose(gram[0, :2, :2], rest @ rest, rtol=ROUNDING)
    assert np.linalg.eigvalsh(gram[0, :2, :2])[0] > 0.5 * LEAST * rest @ rest  # the same, twice
    gram, _ = products.gram(np.zeros(1), np.array([alone]))
    assert gram[0, 0, 0] == pytest.approx(LEAST * more @ more, rel=ROUNDING)


def test_candidates_stored_nowhere_compare_as_stored_ones(lib):
    chosen = [next(c for c in lib.candidates if c.key == ("joint_compliance", "all"))]
    term = Term("gear_ripple", "J4", {"turns": 33.3})
    table = bench(lib, chosen)
    aside = lib.aside([(term, 5.0)])
    loose = table.beside(aside).added(aside.candidates[0])
    (stored,) = lib.with_terms([(term, 5.0)])
    held = bench(lib, chosen).added(stored)
    assert_allclose(loose.value, held.value, rtol=1e-9)
    assert_allclose([loose.gain, loose.evidence], [held.gain, held.evidence], rtol=1e-8)


def test_where_no_line_is_sought_none_is_compared(lib):
    """No joint moves enough for a line: nothing aside, with and without effects chosen."""
    for chosen in ([], list(lib.candidates[:1])):
        assert bench(lib, chosen).beside(lib.aside(())).ranked(()) == []


def test_waves_on_a_grid_are_sums_over_poses(rng):
    q, score, size = rng.uniform(-3, 3, 40), rng.normal(size=40), rng.uniform(size=40)
    turns = np.arange(8.0, 260.0, 0.31)
    pull, square, whole = sums(turns, q, score, size)
    waves = np.exp(1j * np.outer(turns, q))
    assert_allclose(pull, waves @ score, rtol=0, atol=1e-11)
    assert_allclose(square, waves**2 @ size, rtol=0, atol=1e-11)
    assert whole == pytest.approx(size.sum())


def test_products_know_no_order_of_columns(rng):
    """Columns that come later have the same products as those that were there before."""
    quiet = study(6e-6, 1.0, 0)
    early = arm_library(quiet.scene, quiet.rows)
    late = Library.empty(ArmLaws(quiet.scene, quiet.rows))
    terms = [c.term for c in early.candidates][:6]
    for term in terms:  # one by one, products asked for in between
        (found,) = late.with_terms([(term, 1.0)])
        first = late.found[terms[0].text].main  # as two effects that share a column
        twice = np.concatenate([first, found.main, first])
        late.products.at(TRIED[:2], twice)
    index = np.concatenate([late.found[term.text].main for term in terms])
    same = np.concatenate([c.main for c in early.candidates[:6]])
    ours = late.products.at(TRIED[:2], index).lines[:, :, index]
    theirs = early.products.at(TRIED[:2], same).lines[:, :, same]
    assert_allclose(ours, theirs, rtol=1e-10, atol=1e-12 * np.abs(theirs).max())


def test_laws_leave_no_scene_behind(rough):
    """A scene keeps its laws, and its laws not the scene: it goes with the last name for it."""
    scene = replace(rough.scene)
    Term("link_bending", "L2").columns(scene).doubts(scene)
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
def whole(rough: Study) -> Choice:
    return select(arm_library(rough.scene, rough.rows))


@pytest.fixture(scope="module")
def kept(rough: Study) -> Array:
    """The rows of all poses but every sixth."""
    return rough.rows.at(np.arange(rough.scene.poses) % 6 != 2)


@pytest.fixture(scope="module")
def swept(whole: Choice, kept: Array) -> Swept:
    return Swept(whole.grams, kept)


def some_rows(rows: Problem, kept: Array) -> Problem:
    return Problem(rows.error[kept], orthonormal(rows.basis[kept]), rows.variance_ratio[kept],
                   rows.size, rows.group[kept], rows.measured[kept], rows.exact)  # fmt: skip


def test_products_of_a_part_are_sums_over_its_rows(swept, rough, kept):
    check_sums(swept, swept.ratios[[0, 3, 1]], rough.rows.variance_ratio, kept)
    span, basis = swept.swept.span, rough.rows.basis[kept]
    assert_allclose(span.T @ basis.T @ basis @ span, np.eye(span.shape[1]), rtol=0, atol=ROUNDING)


def test_the_noise_of_a_part_is_that_of_its_rows_alone(swept, rough, kept):
    alone = some_rows(rough.rows, kept)
    index = np.array([4, 9])
    expected = restricted(alone, swept.columns.raw[kept][:, index])
    found = swept.noise(index)
    assert found.ratio in swept.ratios
    assert_allclose(found.ratio, expected.ratio, rtol=NEAR)
    assert_allclose(found.variance, expected.variance, rtol=0.1)
    assert swept.dof(index) == alone.count - alone.basis.shape[1] - 2


def test_few_rows_have_the_noise_of_their_mean_square(whole, rough):
    """Fewer than `LEAST_NOISE_DOF` degrees of freedom tell no two noises apart."""
    number = np.arange(rough.scene.poses)
    parts = [Swept(whole.grams, rough.rows.at(number < count)) for count in (1, 2, 3)]
    few = next(part for part in parts if part.dof(NOTHING) < LEAST_NOISE_DOF)
    noise, error = few.noise(NOTHING), rough.rows.error[few.kept]
    assert noise.ratio == noise.jitter == 0.0
    assert_allclose(noise.variance, float(error @ error) / few.kept.sum(), rtol=1e-6)


def test_a_candidate_beside_others_is_least_squares_on_the_rows_that_count(whole, rough, kept):
    some = whole.part(kept)
    first, second = (next(c for c in some.candidates if c.key == key and not len(c.doubt))
                     for key in (("backlash", "J2"), ("gear_error", "J3")))  # fmt: skip
    one = bench(some, [first]).added(second)
    root = np.sqrt(kept / (1.0 + one.ratio * rough.rows.variance_ratio))[:, None]
    columns = some.columns[:, np.concatenate([first.main, second.main])]
    matrix = np.concatenate([rough.rows.basis, columns], axis=1) * root
    expected = np.linalg.lstsq(matrix, rough.rows.error * root[:, 0], rcond=None)[0]
    assert_allclose(one.value, expected[-2:], rtol=1e-8)


@dataclass(frozen=True, eq=False)
class Some:
    """A dictionary of some rows alone, which never held others."""

    of: Dictionary
    kept: Array

    @property
    def problem(self) -> Problem:
        return some_rows(self.of.problem, self.kept)

    def spec(self, term: Any) -> Spec | None:
        found = self.of.spec(term)
        if found is None:
            return None
        columns, doubts = found.columns[self.kept], found.doubts[self.kept]
        return replace(found, columns=columns, doubts=doubts)

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
        (1, (Cause("joint_compliance", "J3", 300.0),), 100),
        (2, (Cause("gear_error", "J2", 100.0), Cause("frame_drift", "frame", 300.0)), 100),
    ],
)
def test_a_part_names_what_its_rows_alone_name(third, causes, poses):
    """From the same candidates, at the likeliest ratio of all and not of few."""
    made = study_of(make(Case("irb2600", "single", causes, seed=5, poses=poses)))
    choice = select(arm_library(made.scene, made.rows))
    kept = made.rows.at(np.arange(made.data.poses) % 3 != third)
    part = choice.part(kept)
    found = select(part)
    terms = [c.term for c in part.candidates]
    alone = select(Library.of(Some(choice.library.dictionary, kept), terms, ()))
    assert {c.key for c in found.chosen} == {c.key for c in alone.chosen}
    assert len(found.chosen) >= len(causes)


def test_a_part_tunes_again_what_it_ends_with():
    """By its own rows: a nest that moved late is dated by those poses alone."""
    sealed = study_of(make(Case("irb2600", "single", (Cause("target_shift", "smr2", 1000.0),))))
    choice = select(arm_library(sealed.scene, sealed.rows))
    (one,) = choice.chosen
    clock = sealed.scene.data.columns["clock"]
    away = np.abs(clock - one.term.choice["since"]) < 0.05 * np.ptp(clock)
    part = select(choice.part(sealed.rows.at(~away)))
    (held,) = part.chosen  # of any moment among the rows left out: those give the same columns
    assert held.key == one.key
    assert abs(held.term.choice["since"] - one.term.choice["since"]) < 0.05 * np.ptp(clock)
    before = len(part.library.columns.T)
    (again,) = tuned_again(part).chosen
    assert again.term.key == one.key
    assert len(part.library.columns.T) == before


def test_a_part_that_shows_hardly_anything_of_a_cause_does_not_test_it():
    """A nest that moved late, and poses from before: rounding is left of its columns."""
    made = study(jitter=0.0, noise=1.0, seed=3)
    choice = select(arm_library(made.scene, made.rows))
    shift = next(c for c in choice.library.candidates if c.term.effect == "target_shift")
    since = made.scene.data.columns["clock"] < shift.term.choice["since"]
    part = choice.part(made.rows.at(since))
    assert shift.text not in {c.text for c in part.candidates}
    select(part)  # and no warning


def test_parts_leave_no_memory_behind(whole, kept):
    """Products are large: they go with the last name for them, not when a collector comes."""
    part = whole.part(kept)
    choice = select(part)
    assert choice.beside_others(0)
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

    return np.log10(find_ratio(cost))


@pytest.mark.parametrize("least", [-2.9, -2.02, -0.3, 0.0, 1.7183, 4.4, 4.95])
def test_the_likeliest_ratio_is_found_between_those_that_are_tried(least):
    assert_allclose(bowl(least), least, rtol=0, atol=1e-9)
    assert_allclose(bowl(least, bent=1.0), least, rtol=0, atol=1e-6)


def test_beyond_the_ends_it_is_the_end():
    assert_allclose([bowl(-4.5), bowl(7.0)], np.log10(RATIOS[[1, -1]]), atol=1e-12)


def test_it_is_none_where_none_is_better():
    assert find_ratio(lambda ratios: np.where(ratios > 0.0, 1.0, 0.0)) == 0.0
    assert find_ratio(lambda ratios: 0.0 * ratios) == 0.0


# ---- components ----------------------------------------------------------------------------------


def test_variances_of_groups_and_noise_are_found():
    rng = np.random.default_rng(0)
    group = np.repeat([0, 1, 2], 60)
    sigma = np.array([3.0, 0.0, 0.5])
    columns = rng.normal(size=(2000, 180))
    error = columns @ (sigma[group] * rng.normal(size=180)) + 2.0 * rng.normal(size=2000)
    basis = np.linalg.qr(rng.normal(size=(2000, 10)))[0]
    error, columns = (part - basis @ (basis.T @ part) for part in (error, columns))
    found = fit_components(
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
    assert found[f"{LIMITS}:BAND"] == limits.BAND


# ---- noise ---------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def quiet() -> Study:
    return study(6e-6, 1.0, 0)


def test_rotated_rows_keep_every_square(quiet, rng):
    fields = rng.normal(size=(4, *quiet.scene.points.shape))
    rows = quiet.rows.of(fields)
    assert_allclose(rows.T @ rows, fields.reshape(4, -1) @ fields.reshape(4, -1).T, rtol=1e-12)
    assert_allclose(quiet.rows.back(rows[:, 2]), fields[2], rtol=0, atol=1e-12)


def test_the_variance_of_a_row_is_that_of_its_direction(quiet):
    """Each rotated row has variance s^2 + t^2 |S'u|^2, and rows of a pose are uncorrelated."""
    rows, jacobian = quiet.rows, quiet.scene.jacobian
    arms = rows.of(jacobian)  # (N, n)
    pose = 7
    r = rows.weight.shape[1]
    own = arms.reshape(-1, r, jacobian.shape[0])[pose]
    expected = np.diag(rows.variance_ratio.reshape(-1, r)[pose] * rows.size)
    assert_allclose(own @ own.T, expected, rtol=0, atol=1e-9 * expected.max())


@pytest.mark.parametrize(("jitter", "noise"), [(0.0, 1.0), (6e-6, 1.0), (20e-6, 1.0), (6e-6, 2.0)])
def test_noise_and_jitter_are_found(jitter, noise):
    """Means over eight arms, within 15 % (a fifth of the mean instrument noise for no jitter)."""
    found = []
    for seed in range(8):
        made = study(jitter, noise, seed)
        away = np.linalg.norm(made.data.y, axis=-1).mean()
        one = restricted(made.rows, np.zeros((len(made.rows.error), 0)))
        truth = noise * (10e-6 + 2.5e-6 * away)
        found.append((one.jitter, np.sqrt(one.variance) / truth))
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
        rows = Problem(rest, basis, np.ones(n), 1.0, np.arange(n), np.ones(n, dtype=bool), 0.0)
        found.append(restricted(rows, np.zeros((n, 0))))
    total = [one.variance * (1.0 + one.ratio) for one in found]  # equal rows: only the sum counts
    assert abs(np.mean(total) - 1.0) < 4.0 * np.sqrt(2.0 / (n - p) / len(found))


def test_a_problem_without_freedom_has_a_noise(quiet):
    rows = quiet.rows
    few = Problem(
        rows.error[:9], np.eye(9), rows.variance_ratio[:9], rows.size, rows.group[:9],
        rows.measured[:9], rows.exact,
    )  # fmt: skip
    assert restricted(few, np.zeros((9, 0))).variance > 0.0


def test_missing_targets_count_for_nothing(robot):
    made = make(Case("irb2600", "none", seed=3))
    data = with_history(made.data)
    y = data.y.copy()
    y[::3, 1] = np.nan
    train, _, _ = split(data.with_y(y), 0.2, 0)
    one = studied(made.robot, train, fit_cell(made.robot, train, Options(objective="sum"), silent))
    assert one.rows.count == 3 * int(train.seen.sum())
    found = restricted(one.rows, np.zeros((len(one.rows.error), 0)))
    assert 12e-6 < np.sqrt(found.variance) < 25e-6


def test_a_field_is_as_noisy_as_its_groups_tell():
    """White rows: 1; an error that all rows of a group share: as many times as there are rows."""
    rng, n, count = np.random.default_rng(5), 3000, 6
    group = np.arange(n) // count
    field = np.sign(rng.normal(size=n // count))[group] * 0.1
    white = [inflation(field, field + rng.normal(size=n), group, n) for _ in range(40)]
    assert abs(np.mean(white) - 1.0) < 0.1
    shared = rng.normal(size=n // count)[group] * np.sqrt(0.5)
    alike = inflation(field, field + shared + np.sqrt(0.5) * rng.normal(size=n), group, n)
    assert abs(alike - (1.0 + 0.5 * (count - 1))) < 0.6  # variance of a sum of `count` rows


def test_one_wrong_group_makes_a_field_no_surer():
    rng, n = np.random.default_rng(6), 900
    group, law = np.arange(n) // 9, rng.normal(size=n)
    rest = rng.normal(size=n)
    rest[:9] += 30.0 * np.sign(law[:9])
    field = law * float(law @ rest) / float(law @ law)
    gain = float(field @ field) / float(np.var(rest - field))
    assert gain > 10.0  # as by rows alone: p = 0.001
    assert gain / inflation(field, rest, group, n) < 2.0


def test_ratios_lie_about_those_of_the_whole():
    found = ratios_about([Noise(2.0, 1.0, 1.0), Noise(0.01, 1.0, 1.0)])
    assert found[0] == 0.0
    assert len(found) == COUNT + 1
    assert found[1] < 0.01 < 2.0 < found[-1]
    assert np.all(np.diff(ratios_about([Noise(0.0, 1.0, 0.0)])) > 0.0)
