"""Products of a part, from those of all rows: what searches of some rows alone find."""

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
from minimax_cal.diagnosing.study import Study
from minimax_cal.evidence.bench import bench
from minimax_cal.evidence.dictionary import Dictionary, Spec
from minimax_cal.evidence.library import Library
from minimax_cal.evidence.limits import LEAST_NOISE_DOF
from minimax_cal.evidence.noise import Noise, Problem, orthonormal, remaining, restricted
from minimax_cal.evidence.selection import NOTHING, Choice, select, tuned_again
from minimax_cal.evidence.sweeping import COUNT, Swept, ratios_about
from minimax_cal.ground.arrays import Array
from minimax_cal.modelling.dictionary import arm_library

NEAR = 0.5  # relative difference of a ratio among few from the likeliest of all


@pytest.fixture(scope="module")
def rough() -> Study:
    return rough_study()


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
    """Of what weighted least squares on the geometry leave of the columns."""
    index, sets = np.array([3, 17, 18]), np.array([[0, 5], [7, 30]])
    columns = swept.columns
    p = columns.fixed - 1
    ratios = swept.ratios[[0, 3, 1]]
    found = swept.at(ratios, index)
    for i, ratio in enumerate(ratios):
        weight = kept / (1.0 + ratio * rough.rows.variance_ratio)
        geometry = swept.geometry * np.sqrt(weight)
        check_products(found, i, index, sets, columns.clear[p:], geometry, weight, columns.raw)
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


def test_ratios_lie_about_those_of_the_whole():
    found = ratios_about([Noise(2.0, 1.0, 1.0), Noise(0.01, 1.0, 1.0)])
    assert found[0] == 0.0
    assert len(found) == COUNT + 1
    assert found[1] < 0.01 < 2.0 < found[-1]
    assert np.all(np.diff(ratios_about([Noise(0.0, 1.0, 0.0)])) > 0.0)


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
    ("causes", "poses"),
    [
        ((), 60),
        ((Cause("joint_compliance", "J3", 300.0),), 100),
        ((Cause("gear_error", "J2", 100.0), Cause("frame_drift", "frame", 300.0)), 100),
        ((Cause("backlash", "J1", 300.0), Cause("thermal_growth", "all", 1000.0)), 60),
    ],
)
def test_a_part_names_what_its_rows_alone_name(causes, poses):
    """From the same candidates, at the likeliest ratio of all and not of few."""
    made = study_of(make(Case("irb2600", "single", causes, seed=5, poses=poses)))
    choice = select(arm_library(made.scene, made.rows))
    for third in range(3):
        kept = made.rows.at(np.arange(made.data.poses) % 3 != third)
        found = select(choice.part(kept))
        terms = [c.term for c in choice.part(kept).candidates]
        alone = Library.of(Some(choice.library.dictionary, kept), terms, ())
        expected = select(alone)
        assert {c.key for c in found.chosen} == {c.key for c in expected.chosen}
        assert len(found.chosen) >= len(causes)


def left_by(choice: Choice) -> Array:
    """(N,) what geometry and effects, fitted to the rows that count, leave of all rows."""
    rows = choice.library.rows
    weight = choice.noise.weights(rows) * choice.library.products.kept
    return remaining(rows, weight, choice.known)


def test_a_part_is_searched_whatever_the_other_rows_hold(whole, rough, kept, rng):
    choice = select(whole.part(kept))
    names = {("backlash", "J2"), ("gear_ripple", "J4")}
    assert {c.key for c in choice.chosen} == names
    other = rough.rows.error + np.where(kept, 0.0, 1e-3 * rng.normal(size=len(kept)))
    lib = arm_library(rough.scene, replace(rough.rows, error=other))
    lines = [(c.term, c.tries) for c in whole.chosen if c.is_line]
    lib.with_terms(lines)
    spoilt = select(Choice(lib, (), whole.noise).part(kept))
    assert {c.key for c in spoilt.chosen} == names
    outside = np.sqrt(np.mean(left_by(choice)[~kept] ** 2))
    assert outside < 1.3 * np.sqrt(np.mean(left_by(choice)[kept] ** 2))
    assert outside < 0.9 * np.sqrt(np.mean(rough.rows.error[~kept] ** 2))


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
