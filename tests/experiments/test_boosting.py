"""Boosting, which says what is left that has no name."""

import numpy as np
import pytest

from experiments.boosting import BINS, boost, grow


def test_trees_foretell_what_features_hold_and_no_noise():
    rng = np.random.default_rng(0)
    seen, new = rng.uniform(-1.0, 1.0, size=(2, 2000, 6))

    def law(x: np.ndarray) -> np.ndarray:
        return np.sign(x[:, 0]) + 0.5 * np.sin(3.0 * x[:, 1])

    trees = boost(seen, law(seen) + 0.1 * rng.normal(size=len(seen)), rng)
    off = law(new) - trees.predict(new)
    assert np.sqrt(np.mean(off**2)) < 0.25 * np.std(law(new))
    noise = boost(seen, rng.normal(size=len(seen)), rng).predict(new)
    assert np.std(noise) < 0.35


def test_a_tree_splits_where_a_step_is():
    bins = np.tile(np.arange(BINS), 40)[:, None]
    tree = grow(bins, np.where(bins[:, 0] > 9, 1.0, -1.0))
    assert (tree.feature[0, 0], tree.above[0, 0]) == (0, 9)
    assert tree.predict(np.array([[9], [10]])) == pytest.approx([-1.0, 1.0])
