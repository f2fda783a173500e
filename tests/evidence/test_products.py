"""Products formed once: the same as sums over the rows that count, for any ratio of the noises."""

import gc
import weakref
from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from problems_fit import study

from experiments.gap_cases import Case, Cause, make
from minimax_cal.diagnosing.study import Study, studied
from minimax_cal.evidence.bench import bench
from minimax_cal.evidence.library import Library
from minimax_cal.evidence.noise import FREE, Problem, orthonormal, remaining, restricted
from minimax_cal.evidence.ratios import NODES, interpolation, nodes
from minimax_cal.evidence.selection import Choice, select
from minimax_cal.fitting.options import Options, silent
from minimax_cal.fitting.solve import fit_cell
from minimax_cal.ground.arrays import Array
from minimax_cal.measuring.history import with_history
from minimax_cal.modelling.dictionary import ArmLaws, arm_library
from minimax_cal.modelling.effects.table import Term
from minimax_cal.modelling.periodogram import sums

RATIOS = np.array([0.0, 0.013, 0.4, 3.7, 1.0e4])
ROUNDING = 1e-9  # of products, relative to the largest of their columns


@pytest.fixture(scope="module")
def rough() -> Study:
    """100 poses with play in a joint, a gear's line, and joints that do not come back."""
    causes = (Cause("backlash", "J2", 400.0), Cause("gear_ripple", "J4", 400.0))
    sealed = make(Case("irb2600", "pair", causes, seed=4))
    data = with_history(sealed.data)
    fit = fit_cell(sealed.robot, data, Options(objective="sum"), silent)
    return studied(sealed.robot, data, fit)


@pytest.fixture(scope="module")
def lib(rough: Study) -> Library:
    return arm_library(rough.scene, rough.rows)


@pytest.fixture(scope="module")
def poses(rough: Study) -> Array:
    """All but every sixth."""
    return np.asarray(np.arange(rough.scene.poses) % 6 != 2)


def kept_rows(rough: Study, poses: Array) -> Array:
    return np.repeat(poses, rough.rows.weight.shape[1])


@pytest.mark.parametrize("decade", [-3, 0, 4])
def test_polynomials_of_a_decade_give_every_weight(decade: int) -> None:
    ratios = 10.0 ** np.linspace(decade, decade + 1, 101)
    variance = np.concatenate([[0.0], np.logspace(-9, 6, 301)])

    def weights(ratios: Array) -> Array:
        return np.asarray(1.0 / (1.0 + np.outer(ratios, variance)))

    between = interpolation(np.log10(ratios) - decade, NODES)
    found = between @ weights(nodes(decade))
    assert_allclose(found, weights(ratios), rtol=1e-9)


@pytest.mark.parametrize("some", [False, True])
def test_products_are_the_sums_over_rows_that_count(
    lib: Library, rough: Study, poses: Array, some: bool
) -> None:
    """Of what weighted least squares on the geometry leave of the columns."""
    kept = kept_rows(rough, poses) if some else np.ones(len(rough.rows.error), dtype=bool)
    products = lib.products.of(kept) if some else arm_library(rough.scene, rough.rows).products
    index, sets = np.array([3, 17, 18]), np.array([[0, 5], [7, 30]])
    clear, raw = products.columns.clear, products.columns.raw
    p = products.columns.fixed - 1
    found = products.at(RATIOS, index)
    within = found.among(sets)
    for i, ratio in enumerate(RATIOS):
        weight = kept / (1.0 + ratio * rough.rows.variance_ratio)
        geometry, root = products.geometry() * np.sqrt(weight), np.sqrt(weight)
        basis = np.linalg.qr(geometry.T)[0]
        every = clear[p:] * root
        rest = every - (every @ basis) @ basis.T
        size = np.linalg.norm(clear[p:], axis=1)
        gram, atol = rest @ rest.T, ROUNDING * np.outer(size, size)
        assert np.all(np.abs(found.lines[i] - gram[1 + index, 1:]) <= atol[1 + index, 1:])
        assert np.all(np.abs(found.error[i] - gram[0]) <= atol[0])
        assert np.all(np.abs(found.pull[i] - gram[1 + index, 0]) <= atol[1 + index, 0])
        for c, pair in enumerate(1 + sets):
            off = np.abs(within[i, c] - gram[np.ix_(pair, pair)])
            assert np.all(off <= atol[np.ix_(pair, pair)])
        assert_allclose(found.whole[i], weight @ raw**2, rtol=ROUNDING)
        assert_allclose(found.square[i], every[0] @ every[0], rtol=ROUNDING)
        assert_allclose(found.logs[i], np.linalg.slogdet(geometry @ geometry.T)[1], atol=1e-8)
        lower = found.factor[i]
        assert_allclose(lower @ lower.T, geometry @ geometry.T, rtol=ROUNDING, atol=1e-9)
        shared = geometry @ every[np.concatenate([[0], 1 + index])].T
        assert_allclose(lower @ found.part[i], shared, rtol=ROUNDING, atol=ROUNDING * size.max())


def test_columns_are_stored_without_what_geometry_imitates(lib: Library, rough: Study) -> None:
    clear = lib.products.clear(np.arange(lib.products.columns.count))
    size = np.linalg.norm(lib.columns, axis=0)
    assert np.all(ROUNDING * size >= np.abs(clear @ rough.rows.basis).T)
    assert_allclose(lib.columns - clear.T, rough.rows.basis @ (rough.rows.basis.T @ lib.columns),
                    rtol=0, atol=ROUNDING * np.abs(lib.columns).max())  # fmt: skip


def test_the_noise_of_some_poses_is_that_of_their_rows_alone(
    lib: Library, rough: Study, poses: Array
) -> None:
    rows, kept = rough.rows, kept_rows(rough, poses)
    alone = Problem(rows.error[kept], orthonormal(rows.basis[kept]), rows.variance_ratio[kept],
                    rows.size, rows.group[kept], rows.measured[kept], rows.exact)  # fmt: skip
    assert alone.count == 3 * int(np.count_nonzero(rough.model.weight[:, poses]))
    index = np.array([4, 9])
    found = lib.only(rough.rows.at(poses)).products.noise(index)
    expected = restricted(alone, lib.columns[kept][:, index])
    assert_allclose(found.ratio, expected.ratio, rtol=1e-6)
    assert_allclose(found.variance, expected.variance, rtol=1e-7)


def test_the_span_of_some_poses_is_orthonormal_there(
    lib: Library, rough: Study, poses: Array
) -> None:
    rows = kept_rows(rough, poses)
    products = lib.products.of(rows)
    p = len(products.span)
    basis = rough.rows.basis[rows] @ products.span
    assert_allclose(basis.T @ basis, np.eye(basis.shape[1]), rtol=0, atol=ROUNDING)
    beside = products.beside(None)
    for number in (0, -1):  # coordinates of the geometry's own columns, at both ends of RATIOS
        weight = 1.0 / (1.0 + beside.sums.ratios[number] * rough.rows.variance_ratio[rows])
        half = np.sqrt(weight)[:, None] * rough.rows.basis[rows]
        gram = half.T @ half
        square = beside.part[number, :, :p].T @ beside.part[number, :, :p]
        assert_allclose(square, gram, rtol=0, atol=ROUNDING * np.abs(gram).max())


def test_few_rows_have_the_noise_of_their_mean_square(lib: Library, rough: Study) -> None:
    """Fewer than `FREE` degrees of freedom tell no two noises apart."""
    none = np.zeros(0, dtype=int)
    number = np.arange(rough.scene.poses)
    some = [kept_rows(rough, number < count) for count in (1, 2, 3)]
    rows = next(rows for rows in some if lib.products.of(rows).dof(none) < FREE)
    noise = lib.products.of(rows).noise(none)
    error = rough.rows.error[rows]
    assert noise.ratio == noise.jitter == 0.0
    assert_allclose(noise.variance, float(error @ error) / rows.sum(), rtol=1e-6)


def test_a_candidate_beside_others_is_least_squares_on_the_poses_that_count(
    lib: Library, rough: Study, poses: Array
) -> None:
    some = lib.only(rough.rows.at(poses))
    first, second = (next(c for c in some.candidates if c.key == key and not len(c.doubt))
                     for key in (("backlash", "J2"), ("gear_error", "J3")))  # fmt: skip
    one = bench(some, [first]).added(second)
    rows = rough.rows
    root = np.sqrt(kept_rows(rough, poses) / (1.0 + one.ratio * rows.variance_ratio))[:, None]
    columns = lib.columns[:, np.concatenate([first.main, second.main])]
    matrix = np.concatenate([rows.basis, columns], axis=1) * root
    expected = np.linalg.lstsq(matrix, rows.error * root[:, 0], rcond=None)[0]
    assert_allclose(one.value, expected[-2:], rtol=1e-8)


def test_candidates_stored_nowhere_compare_as_stored_ones(lib: Library) -> None:
    chosen = [next(c for c in lib.candidates if c.key == ("joint_compliance", "all"))]
    term = Term("gear_ripple", "J4", {"turns": 33.3})
    table = bench(lib, chosen)
    aside = lib.aside([(term, 5.0)])
    loose = table.beside(aside).added(aside.candidates[0])
    (stored,) = lib.with_terms([(term, 5.0)])
    held = bench(lib, chosen).added(stored)
    assert_allclose(loose.value, held.value, rtol=1e-9)
    assert_allclose([loose.gain, loose.evidence], [held.gain, held.evidence], rtol=1e-8)


def test_where_no_line_is_sought_none_is_compared(lib: Library) -> None:
    """No joint moves enough for a line: nothing aside, with and without effects chosen."""
    for chosen in ([], list(lib.candidates[:1])):
        assert bench(lib, chosen).beside(lib.aside(())).ranked(()) == []


def left_by(choice: Choice) -> Array:
    """(N,) what geometry and effects, fitted to the rows that count, leave of all rows."""
    rows = choice.library.rows
    weight = choice.noise.weights(rows) * choice.library.products.kept
    return remaining(rows, weight, choice.known)


def test_a_selection_from_some_poses_looks_at_no_other(
    lib: Library, rough: Study, poses: Array, rng: np.random.Generator
) -> None:
    """Errors of the others, whatever they are, change nothing; they are predicted besides."""
    choice = select(lib.only(rough.rows.at(poses)))
    assert {c.key for c in choice.chosen} == {("backlash", "J2"), ("gear_ripple", "J4")}
    kept = kept_rows(rough, poses)
    other = rough.rows.error + np.where(kept, 0.0, 1e-3 * rng.normal(size=len(kept)))
    spoilt_lib = arm_library(rough.scene, replace(rough.rows, error=other))
    spoilt = select(spoilt_lib.only(rough.rows.at(poses)))
    assert [c.term.text for c in spoilt.chosen] == [c.term.text for c in choice.chosen]
    for one, again in zip(choice.fits, spoilt.fits, strict=True):
        assert_allclose(again.value, one.value, rtol=1e-6)
    left = left_by(choice)
    assert_allclose((left_by(spoilt) - other)[kept], (left - rough.rows.error)[kept], atol=1e-9)
    outside = np.sqrt(np.mean(left[~kept] ** 2))
    assert outside < 1.3 * np.sqrt(np.mean(left[kept] ** 2))
    assert outside < 0.9 * np.sqrt(np.mean(rough.rows.error[~kept] ** 2))


def test_waves_on_a_grid_are_sums_over_poses(rng: np.random.Generator) -> None:
    q, score, size = rng.uniform(-3, 3, 40), rng.normal(size=40), rng.uniform(size=40)
    turns = np.arange(8.0, 260.0, 0.31)
    pull, square, whole = sums(turns, q, score, size)
    waves = np.exp(1j * np.outer(turns, q))
    assert_allclose(pull, waves @ score, rtol=0, atol=1e-11)
    assert_allclose(square, waves**2 @ size, rtol=0, atol=1e-11)
    assert whole == pytest.approx(size.sum())


def test_products_know_no_order_of_columns(rng: np.random.Generator) -> None:
    """Columns that come later have the same products as those that were there before."""
    quiet = study(6e-6, 1.0, 0)
    early = arm_library(quiet.scene, quiet.rows)
    late = Library.empty(ArmLaws(quiet.scene, quiet.rows))
    terms = [c.term for c in early.candidates][:6]
    for term in terms:  # one by one, products asked for in between
        (found,) = late.with_terms([(term, 1.0)])
        first = late.found[terms[0].text].main  # as two effects that share a column
        twice = np.concatenate([first, found.main, first])
        late.products.at(RATIOS[:2], twice)
    index = np.concatenate([late.found[term.text].main for term in terms])
    same = np.concatenate([c.main for c in early.candidates[:6]])
    ours = late.products.at(RATIOS[:2], index).lines[:, :, index]
    theirs = early.products.at(RATIOS[:2], same).lines[:, :, same]
    assert_allclose(ours, theirs, rtol=1e-10, atol=1e-12 * np.abs(theirs).max())


def test_a_part_that_shows_hardly_anything_of_a_cause_does_not_test_it() -> None:
    """A nest that moved late, and poses from before: rounding is left of its columns."""
    made = study(jitter=0.0, noise=1.0, seed=3)
    whole = arm_library(made.scene, made.rows)
    shift = next(c for c in whole.candidates if c.term.effect == "target_shift")
    since = made.scene.data.columns["clock"] < shift.term.choice["since"]
    part = whole.only(made.rows.at(since))
    assert shift not in part.candidates
    select(part)  # and no warning


def test_parts_leave_no_memory_behind(lib: Library, rough: Study, poses: Array) -> None:
    """Products are large: they go with the last name for them, not when a collector comes."""
    part = lib.only(rough.rows.at(poses))
    choice = select(part)
    assert choice.benches
    held = [weakref.ref(part.products), *map(weakref.ref, part.products.formed.values())]
    gc.disable()
    try:
        del part, choice
        assert [one() for one in held] == [None] * len(held)
    finally:
        gc.enable()


def test_laws_leave_no_scene_behind(rough: Study) -> None:
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
