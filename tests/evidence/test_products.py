"""Products formed once: the same as sums over the rows that count, for any ratio of the noises."""

import gc
import weakref
from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from problems_fit import ROUNDING, check_products, rough_study, study

from minimax_cal.diagnosing.study import Study
from minimax_cal.evidence.bench import bench
from minimax_cal.evidence.library import Library
from minimax_cal.evidence.products import LEAST
from minimax_cal.evidence.ratios import NODES, interpolation, nodes
from minimax_cal.ground.arrays import Array
from minimax_cal.modelling.dictionary import ArmLaws, arm_library
from minimax_cal.modelling.effects.table import Term
from minimax_cal.modelling.periodogram import sums

RATIOS = np.array([0.0, 0.013, 0.4, 3.7, 1.0e4])


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


def test_products_are_the_sums_over_rows(rough):
    """Of what weighted least squares on the geometry leave of the columns."""
    products = arm_library(rough.scene, rough.rows).products
    index, sets = np.array([3, 17, 18]), np.array([[0, 5], [7, 30]])
    clear, raw = products.columns.clear, products.columns.raw
    p = products.columns.fixed - 1
    found = products.at(RATIOS, index)
    for i, ratio in enumerate(RATIOS):
        weight = 1.0 / (1.0 + ratio * rough.rows.variance_ratio)
        geometry = products.geometry * np.sqrt(weight)
        check_products(found, i, index, sets, clear[p:], geometry, weight, raw)


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
        late.products.at(RATIOS[:2], twice)
    index = np.concatenate([late.found[term.text].main for term in terms])
    same = np.concatenate([c.main for c in early.candidates[:6]])
    ours = late.products.at(RATIOS[:2], index).lines[:, :, index]
    theirs = early.products.at(RATIOS[:2], same).lines[:, :, same]
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
