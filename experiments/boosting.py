"""Gradient boosting of small trees: what any smooth or broken function of some features foretells.

Squared error, features in equal shares of the rows, each tree on a random part of the rows
[Friedman 2001].  It knows no physics, and so says how much is left that has no name.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from minimax_cal.ground.arrays import Array

BINS = 24  # of a feature
DEPTH, TREES, RATE = 3, 60, 0.1  # of the trees, how many, and what each adds of its values
PART = 0.6  # of the rows that a tree sees
LEAST_ROWS = 40  # of a leaf


@dataclass(frozen=True, eq=False)
class Tree:
    """Splits by level: feature and bin of each node; values of the leaves."""

    feature: Array
    above: Array
    leaf: Array

    def predict(self, bins: Array) -> Array:
        """(m,) values of rows (m, f) in bins."""
        node, rows = np.zeros(len(bins), dtype=int), np.arange(len(bins))
        for feature, above in zip(self.feature, self.above, strict=True):
            node = 2 * node + (bins[rows, feature[node]] > above[node])
        return np.asarray(self.leaf[node])


@dataclass(frozen=True, eq=False)
class Boosted:
    """A sum of trees.  edges: (f, BINS - 1) of the bins."""

    edges: Array
    start: float
    trees: tuple[Tree, ...]

    def predict(self, features: Array) -> Array:
        """(m,) of features (m, f)."""
        bins = binned(features, self.edges)
        return np.asarray(sum((RATE * tree.predict(bins) for tree in self.trees),
                              np.full(len(bins), self.start)))  # fmt: skip


def binned(features: Array, edges: Array) -> Array:
    """(m, f) bin of every feature."""
    each = [np.searchsorted(edge, column) for edge, column in zip(edges, features.T, strict=True)]
    return np.stack(each, axis=1)


def boost(features: Array, values: Array, rng: np.random.Generator) -> Boosted:
    """Trees that foretell values (m,) by features (m, f)."""
    edges = np.quantile(features, np.arange(1, BINS) / BINS, axis=0).T
    bins, start = binned(features, edges), float(values.mean())
    left, trees = values - start, list[Tree]()
    for _ in range(TREES):
        rows = rng.random(len(left)) < PART
        trees.append(grow(bins[rows], left[rows]))
        left = left - RATE * trees[-1].predict(bins)
    return Boosted(edges, start, tuple(trees))


def grow(bins: Array, left: Array) -> Tree:
    """A tree of one depth everywhere."""
    node, features, aboves = np.zeros(len(left), dtype=int), list[Array](), list[Array]()
    for level in range(DEPTH):
        feature, above = best_splits(bins, left, node, 2**level)
        features.append(feature)
        aboves.append(above)
        node = 2 * node + (bins[np.arange(len(left)), feature[node]] > above[node])
    count = np.bincount(node, minlength=2**DEPTH)
    total = np.bincount(node, left, minlength=2**DEPTH)
    return Tree(stacked(features), stacked(aboves), total / np.maximum(count, 1))


def stacked(levels: list[Array]) -> Array:
    """(DEPTH, nodes) of the last level, those of earlier ones in front."""
    out = np.zeros((DEPTH, 2 ** (DEPTH - 1)), dtype=int)
    for row, level in zip(out, levels, strict=True):
        row[: len(level)] = level
    return out


def best_splits(bins: Array, left: Array, node: Array, nodes: int) -> tuple[Array, Array]:
    """Feature and bin (nodes,) that lower the squares of every node most."""
    gains = np.full((nodes, bins.shape[1], BINS), -np.inf)
    for f in range(bins.shape[1]):
        at = node * BINS + bins[:, f]
        count = np.bincount(at, minlength=nodes * BINS).reshape(nodes, BINS).cumsum(axis=1)
        total = np.bincount(at, left, minlength=nodes * BINS).reshape(nodes, BINS).cumsum(axis=1)
        rest = count[:, -1:] - count
        fits = (count >= LEAST_ROWS) & (rest >= LEAST_ROWS)
        gain = total**2 / np.maximum(count, 1) + (total[:, -1:] - total) ** 2 / np.maximum(rest, 1)
        gains[:, f] = np.where(fits, gain, -np.inf)
    best = gains.reshape(nodes, -1).argmax(axis=1)
    none = ~np.isfinite(gains.reshape(nodes, -1).max(axis=1))
    return best // BINS, np.where(none, BINS, best % BINS)
