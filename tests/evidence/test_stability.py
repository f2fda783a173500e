"""How often searches of subsamples find a name."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from minimax_cal.evidence import stability
from minimax_cal.evidence.dictionary import Spec
from minimax_cal.evidence.library import Library
from minimax_cal.evidence.limits import PARTS, ROUNDS
from minimax_cal.evidence.noise import Noise, Problem, orthonormal
from minimax_cal.evidence.selection import select
from minimax_cal.evidence.stability import Repeats, halves, repeated, subsamples
from minimax_cal.ground.arrays import Array

A, B, C = ("a", "x"), ("b", "x"), ("c", "x")


def repeats(*names: set[tuple[str, str]], asked: int | None = None) -> Repeats:
    return Repeats(tuple(map(frozenset, names)), asked or len(names))


def test_a_frequency_is_the_share_of_subsamples_that_find_one_of_the_names():
    found = repeats({A}, {A, B}, {B}, {C})
    assert found.frequency({A}) == 0.5
    assert found.frequency({A, B}) == 0.75
    assert found.frequency(set()) == 0.0
    assert np.isnan(repeats({A}, {A}, asked=5).frequency({A}))  # most had too few rows
    assert repeats({A}, {A}, asked=4).frequency({A}) == 1.0


def test_a_name_takes_the_place_of_another_where_it_is_found_without_it():
    assert repeats({A}, {A}, {B}, {B}).instead_of({A}) == [B]
    assert repeats({A}, {A}, {A}, {A}, {A}, {B}).instead_of({A}) == []  # once in six
    assert repeats({A, C}, {A, C}, {B, C}, {B, C}).instead_of({A}) == [B]  # C is there anyhow


def test_every_group_is_left_out_as_often_and_stays_together():
    group = np.repeat(np.arange(30), 4)
    masks = np.array(subsamples(group))
    assert len(masks) == PARTS * ROUNDS
    assert np.all(masks.reshape(ROUNDS, PARTS, -1).sum(axis=1) == PARTS - 1)
    assert np.all(masks.reshape(len(masks), 30, 4) == masks.reshape(len(masks), 30, 4)[..., :1])
    assert np.all(masks.sum(axis=1) == 80)


def test_halves_keep_groups_together_and_every_group_is_in_one_of_a_pair() -> None:
    masks = np.array(halves(np.repeat(np.arange(9), 4), 2)).reshape(2, 2, 9, 4)
    assert np.all(masks[:, 0] != masks[:, 1])
    assert np.all(masks == masks[..., :1])
    assert np.all(masks[..., 0].sum(axis=2) == [4, 5])


@dataclass(frozen=True, eq=False)
class Straight:
    """A domain without a robot: y = sum of known regressors, each a law of one parameter."""

    problem: Problem
    regressors: Array

    def spec(self, term: Any) -> Spec | None:
        number = int(term.number)
        none = np.zeros((len(self.regressors), 0))
        free = np.zeros(1, dtype=bool)
        column = self.regressors[:, [number]]
        return Spec(term, term.text, (term.text, "x"), column, none, np.zeros(0, dtype=int), free,
                    1.0, 0, False)  # fmt: skip

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


def straight(rng: np.random.Generator, sizes: dict[int, float], rows: int = 240) -> Library:
    regressors = rng.normal(size=(rows, 30))
    error = rng.normal(size=rows) + sum(
        size * regressors[:, number] for number, size in sizes.items()
    )
    basis = orthonormal(rng.normal(size=(rows, 5)))
    error = error - basis @ (basis.T @ error)
    spread = rng.uniform(0.5, 1.5, rows)
    group = np.arange(rows) // 3
    measured = np.ones(rows, dtype=bool)
    problem = Problem(error, basis, spread / spread.mean(), 1.0, group, measured, 1e-9)
    return Library.of(Straight(problem, regressors), [Law(i) for i in range(30)], ())


def test_a_law_of_any_domain_is_found_again_and_a_faint_one_less_often(rng):
    whole = select(straight(rng, {3: 1.0, 7: 0.25}))
    names = [c.key for c in whole.chosen]
    assert ("law 3", "x") in names
    found = repeated(whole, subsamples(whole.library.rows.group))
    assert len(found.names) == PARTS * ROUNDS
    assert found.frequency({("law 3", "x")}) == 1.0
    assert found.frequency({("law 7", "x")}) < 1.0
    assert found.frequency({("law 1", "x")}) < 0.5


def test_rows_too_few_for_their_geometry_are_not_asked(rng):
    whole = select(straight(rng, {3: 5.0}, rows=27))
    found = repeated(whole, subsamples(whole.library.rows.group))
    assert found.names == ()
    assert np.isnan(found.frequency({("law 3", "x")}))


def test_subsamples_do_not_depend_on_what_was_drawn_before(rng, monkeypatch):
    group = np.arange(9)
    first = subsamples(group)
    rng.normal(size=3)
    np.testing.assert_array_equal(first, subsamples(group))
    monkeypatch.setattr(stability, "ROUNDS", 1)
    assert len(subsamples(group)) == PARTS
