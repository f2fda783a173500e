"""Faults of the data, found before any effect is fitted: points, rows, nests, sessions, joints.

Distances between targets tell without any model: a point that moved, rows with exchanged names, a
nest that shifted.  What lies across the plane of the targets they cannot show; there, and with one
or two targets, the residual of a fit must stand out grossly.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import combinations, permutations

import numpy as np
from scipy import stats

from minimax_cal.data import Measurements, groups
from minimax_cal.gates import transpositions
from minimax_cal.history import followed, moves, sessions, visits
from minimax_cal.kinematics import Array

FALSE_ALARM = 0.002  # of each test, over a whole data set
FEWEST = 8  # distances that give a centre and a scatter
NEAR = 8  # visits by which ranks may misplace a step
SHORTEST = 4  # visits on each side of a step
MATTERS = 1.5  # steps below so many times the scatter of a distance change nothing
MOST_STEPS = 5  # shifts of nests in one data set
NORMAL = 1.4826  # times the median deviation is sigma
TAIL = 1.6  # sigma: what 95 % of a fit's errors keep to (1.96 were they Gaussian)
FAINT = 1e-6  # no instrument measures a coordinate better [m]
GROSS, GROSS_TYPICAL = 7.5, 12.0  # times what 90 % of errors keep to, and the typical one
ALIKE = 9.0  # squared standard scores that are no reason to prefer one target to another
MOST_ORDERED = 5  # targets of which all orders are tried
UNSETTLED = 1e-5  # read-back joints nearer than that have settled [rad, m]
NO_ERROR: Array = np.zeros((0, 0, 3))


@dataclass(frozen=True)
class Amount:
    """A number about a fault.  value, sigma: in `unit`, SI; sigma is NaN where not known."""

    name: str
    value: float
    sigma: float
    unit: str


@dataclass(frozen=True, eq=False)
class Fault:
    """One thing wrong with the data, or a notice.

    effect: outliers, swapped_rows, target_shift or readback; as notices also mixed_units,
    session_jump and noise.  place: smr1, smr1 or smr2, all, frame.
    rows: (r,) rows of the data; of a shift all rows after it, as visited.
    targets: outliers (r,) the target of each row; swapped rows (r, k) in whose columns each
    target stands; shift: which nest it can be; else of length 0.
    notice: whether the data may be used as they are.
    """

    effect: str
    place: str
    rows: Array
    targets: Array
    parameters: tuple[Amount, ...]
    text: str
    notice: bool = False


@dataclass(frozen=True, eq=False)
class Between:
    """Distances between targets, less their usual value.

    pairs: (p, 2).  centre, sigma: (p,) median and robust scatter [m].
    off: (p, m) distance less centre, NaN where not both were measured [m].
    """

    pairs: Array
    centre: Array
    sigma: Array
    off: Array

    def of(self, target: int) -> Array:
        """(p,) True for the pairs with a target."""
        return np.asarray((self.pairs == target).any(axis=1))


def find_faults(data: Measurements, error: Array = NO_ERROR) -> tuple[Fault, ...]:
    """Everything found; each test looks at data mended by those before it.

    error: (k, m, 3) measured minus predicted by a fit, in the axes of the data as `Cell.error`
    gives them [m]; or of length 0 for none.
    """
    swapped = swapped_rows(data, error)
    mended_names = mended(data, swapped)
    if swapped and len(error):
        error = error.copy()
        error[:, swapped[0].rows] = np.nan  # of the names as they stood
    shifts = target_shifts(mended_names)
    outliers = outlying(mended_names, error, shifts)
    good = mended(mended_names, outliers)
    notices = (*mixed_units(data), *session_jumps(good, error), *noise(good))
    return (*swapped, *shifts, *outliers, *unsettled(data), *notices)


def mended(data: Measurements, faults: tuple[Fault, ...]) -> Measurements:
    """Swapped rows put right, outlying points NaN; the rows stay, and so does a shifted nest."""
    y = data.y.copy()
    for fault in faults:
        if fault.effect == "swapped_rows":
            y[fault.rows] = y[fault.rows[:, None], fault.targets]
    for fault in faults:
        if fault.effect == "outliers":
            y[fault.rows, fault.targets] = np.nan
    return data.with_y(y)


def between(data: Measurements) -> Between:
    """The distances of all pairs of targets that were measured together often enough."""
    pairs, centre, off = [], [], []
    for a, b in combinations(range(len(data.targets)), 2):
        distance = np.linalg.norm(data.y[:, a] - data.y[:, b], axis=-1)
        if np.isfinite(distance).sum() >= FEWEST:
            pairs.append((a, b))
            centre.append(float(np.nanmedian(distance)))
            off.append(distance - centre[-1])
    deviation = np.array(off).reshape(len(pairs), data.poses)
    return Between(
        np.array(pairs, dtype=int).reshape(-1, 2), np.array(centre), scatter(deviation), deviation
    )


def scatter(off: Array) -> Array:
    """(p,) robust standard deviation about the median of rows with NaN.  off: (p, m) [m]."""
    if not len(off):
        return np.zeros(0)
    middle = np.nanmedian(off, axis=1, keepdims=True)
    return np.asarray(np.maximum(NORMAL * np.nanmedian(np.abs(off - middle), axis=1), FAINT))


# ---- swapped rows -------------------------------------------------------------------------------


def swapped_rows(data: Measurements, error: Array = NO_ERROR) -> tuple[Fault, ...]:
    """Rows whose distances fit under other names of their targets, and not under their own.

    error: (k, m, 3) of a fit, in the axes of the data [m]; it tells orders apart whose distances
    are alike.
    """
    predicted = data.y - np.moveaxis(error, 0, 1) if len(error) else np.zeros_like(data.y)
    apart = between(data)
    if len(apart.pairs) < 3:
        return ()
    limit = outlier_limit(len(apart.pairs), data.poses, data.poses)
    cost = np.nansum((apart.off / apart.sigma[:, None]) ** 2, axis=0)
    orders: list[Array] = []
    rows: list[int] = []
    for row in np.flatnonzero(cost > 9.0 * limit):
        order, least = best_order(data.y[row], apart, predicted[row])
        if least < limit and np.any(order != np.arange(len(order))):
            rows.append(int(row))
            orders.append(order)
    if not rows:
        return ()
    lines = listed([str(data.line[row]) for row in rows])
    return (
        Fault(
            "swapped_rows",
            "all",
            np.array(rows),
            np.stack(orders),
            (Amount("rows", float(len(rows)), np.nan, ""),),
            f"targets stand under each other's names in {len(rows)} rows: lines {lines}",
        ),
    )


def best_order(point: Array, apart: Between, predicted: Array) -> tuple[Array, float]:
    """Where each target of a row seems to stand, and the squared deviation left over.

    point: (k, 3) [m].  predicted: (k, 3), zeros for unknown [m].  Of orders that fit alike (a
    triangle of equal sides) the one nearest to the prediction, else the least changed.
    """
    k = len(point)
    seen = np.flatnonzero(np.isfinite(point[:, 0]))
    count = len(seen)
    if count < 3:
        return np.arange(k), np.inf
    tried = permutations(range(count)) if count <= MOST_ORDERED else transpositions(count)
    found: list[tuple[float, float, Array]] = []
    for some in tried:
        order = np.arange(k)
        order[seen] = seen[list(some)]
        moved = point[order]
        distance = np.linalg.norm(moved[apart.pairs[:, 0]] - moved[apart.pairs[:, 1]], axis=-1)
        cost = float(np.nansum(((distance - apart.centre) / apart.sigma) ** 2))
        miss = float(np.nansum((moved - predicted)[seen] ** 2))
        changed = float((order != np.arange(k)).sum())
        found.append((cost, miss if predicted.any() else changed, order))
    least = min(cost for cost, _, _ in found)
    alike = [entry for entry in found if entry[0] < least + 4.0 * count]
    return min(alike, key=lambda entry: entry[1])[2], least


# ---- a nest that shifted ------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Step:
    """A step in the distances of one target: `at` is the first visit after it.

    change, sigma: (p,) of every pair [m].  targets: any one of these explains it, the best first.
    """

    at: int
    targets: Array
    change: Array
    sigma: Array


def target_shifts(data: Measurements) -> tuple[Fault, ...]:
    """Nests that moved during the session, as steps of their distances over the visits."""
    apart = between(data)
    order = visits(data)
    off = apart.off[:, order]
    faults: list[Fault] = []
    while len(faults) < MOST_STEPS and (step := find_step(off, apart)):
        off = off.copy()
        off[:, step[0].at :] -= (step[0].change * apart.of(int(step[0].targets[0])))[:, None]
        faults.append(shift_of(data, order, apart, step[0]))
    return tuple(faults)


def find_step(off: Array, apart: Between) -> list[Step]:
    """The clearest step, if one is beyond chance.  off: (p, m) by visit, NaN not measured [m].

    Ranks, so that no outlier counts for more than one visit; each pair's scan over all places is
    judged by a Bonferroni bound, with the scatter widened where neighbours are alike, and must do
    better than a steady drift.
    """
    pairs, m = off.shape
    best, place = np.zeros(pairs), np.zeros(pairs, dtype=int)
    for pair in range(pairs):
        known = np.flatnonzero(np.isfinite(off[pair]))
        if len(known) >= 2 * SHORTEST:
            best[pair], first = scan(off[pair, known])
            place[pair] = known[first]
    limit = float(stats.chi2.isf(FALSE_ALARM / max(pairs * m, 1), 1))
    if not pairs or best.max() < limit:
        return []
    at = int(place[best.argmax()])
    before, after = off[:, :at], off[:, at:]
    many = np.isfinite(before).sum(axis=1), np.isfinite(after).sum(axis=1)
    told = np.minimum(*many) >= 2
    change, sigma = np.zeros(pairs), np.full(pairs, np.inf)
    change[told] = np.nanmedian(after[told], axis=1) - np.nanmedian(before[told], axis=1)
    inside = np.concatenate(
        [
            before[told] - np.nanmedian(before[told], axis=1, keepdims=True),
            after[told] - np.nanmedian(after[told], axis=1, keepdims=True),
        ],
        axis=1,
    )
    share = 1.0 / many[0][told] + 1.0 / many[1][told]
    sigma[told] = 1.2533 * scatter(inside) * np.sqrt(share)  # of a median
    strength = (change / sigma) ** 2
    rest = np.array([strength[~apart.of(i)].sum() for i in range(int(apart.pairs.max()) + 1)])
    if np.abs(change[told]).max() < MATTERS * float(np.median(scatter(inside))):
        return []
    order = np.argsort(rest, kind="stable")
    targets = order[rest[order] <= rest.min() + ALIKE]
    at = place_of(off[told], change[told], scatter(inside), at)
    return [Step(at, targets, change, sigma)]


def place_of(off: Array, change: Array, sigma: Array, at: int) -> int:
    """First visit after a step, near a first guess, by least squares that outliers do not sway.

    off: (p, m) by visit [m].  change, sigma: (p,) of the step and of one distance [m].
    """
    middle = np.nanmedian(off[:, :at], axis=1)
    z = (off - middle[:, None]) / sigma[:, None]
    gain = np.clip(z**2, 0, 25.0) - np.clip((z - (change / sigma)[:, None]) ** 2, 0, 25.0)
    before = np.cumsum(np.nansum(gain, axis=0))  # lost by a later start
    low, high = max(at - NEAR, SHORTEST), min(at + NEAR, off.shape[1] - SHORTEST)
    return low + int(before[low - 1 : high].argmin())


def scan(value: Array) -> tuple[float, int]:
    """Largest squared standard score of a step in a series, and the first entry after it.

    value: (m,).  0 where a steady drift explains the series as well.
    """
    m = len(value)
    score = stats.norm.ppf((stats.rankdata(value) - 0.5) / m)
    score = (score - score.mean()) / max(float(score.std()), 1e-12)
    count = np.arange(SHORTEST, m - SHORTEST + 1)
    total = np.cumsum(score)[count - 1]
    gain = total**2 * m / (count * (m - count))
    first = int(count[gain.argmax()])
    inside = score - np.where(np.arange(m) < first, score[:first].mean(), score[first:].mean())
    alike = float(inside[1:] @ inside[:-1] / max(inside @ inside, 1e-12))
    wider = (1.0 + max(alike, 0.0)) / (1.0 - max(alike, 0.0))
    time = np.linspace(-1.0, 1.0, m)
    drift = (score @ time) ** 2 / (time @ time)
    strength = float(gain.max())
    if strength - drift < 0.1 * strength:
        return 0.0, first
    return strength / wider, first


def shift_of(data: Measurements, order: Array, apart: Between, step: Step) -> Fault:
    """The fault that a step stands for."""
    first = int(step.targets[0])
    own = np.flatnonzero(apart.of(first) & np.isfinite(step.sigma))
    size = in_plane(apart, own, first, step.change[own])
    rows = order[step.at :]
    amounts = [Amount("size", size, float(step.sigma[own].max()), "m")]
    for pair in own:
        a, b = (data.targets[i] for i in apart.pairs[pair])
        amounts.append(Amount(f"{a}-{b}", float(step.change[pair]), float(step.sigma[pair]), "m"))
    place = " or ".join(data.targets[i] for i in step.targets)
    text = (
        f"{place} moved by {1e3 * size:.3g} mm or more before line {data.line[rows[0]]} "
        f"(visit {step.at + 1} of {len(order)})"
    )
    return Fault("target_shift", place, rows, step.targets, tuple(amounts), text)


def in_plane(apart: Between, own: Array, target: int, change: Array) -> float:
    """Least shift of a target that changes its distances as seen [m].

    own: its pairs.  change: of each [m].
    """
    others = [int(apart.pairs[pair].sum() - target) for pair in own]
    cosine = np.eye(len(own))
    for i, j in combinations(range(len(own)), 2):
        both = np.isin(apart.pairs, (others[i], others[j])).all(axis=1)
        if both.any():
            a, b, c = apart.centre[own[i]], apart.centre[own[j]], apart.centre[both][0]
            cosine[i, j] = cosine[j, i] = np.clip((a * a + b * b - c * c) / (2 * a * b), -1, 1)
    return float(np.sqrt(max(change @ np.linalg.pinv(cosine, rcond=0.05) @ change, 0.0)))


# ---- outliers -----------------------------------------------------------------------------------


def outlying(
    data: Measurements, error: Array = NO_ERROR, shifts: tuple[Fault, ...] = ()
) -> tuple[Fault, ...]:
    """Single points that are elsewhere, by their distances and by the residual of a fit.

    error: (k, m, 3) [m], or of length 0.  shifts: nests that moved, so that the points after it
    are not taken for outliers.
    """
    found = dict.fromkeys(off_shape(data, error, shifts), "its distances to the others")
    if len(error):
        error = error.copy()
        for row, target in found:
            error[target, row] = np.nan
        found |= dict.fromkeys(off_fit(error), "the fit")
    if not found:
        return ()
    points = sorted(found)
    rows, targets = np.array(points).T
    named = listed([f"line {data.line[row]} {data.targets[target]}" for row, target in points])
    by = " and by ".join(sorted(set(found.values())))
    places = sorted({data.targets[target] for target in targets})
    return (
        Fault(
            "outliers",
            places[0] if len(places) == 1 else "all",
            rows,
            targets,
            (Amount("points", float(len(points)), np.nan, ""),),
            f"points that are elsewhere, by {by}: {named}",
        ),
    )


def off_fit(error: Array) -> list[tuple[int, int]]:
    """(row, target) of points that a fit misses grossly.  error: (k, m, 3) [m].

    A real arm's errors have tails, but bounded ones: far beyond what 90 % keep to, and the typical.
    """
    size = np.linalg.norm(error, axis=-1)
    known = size[np.isfinite(size)]
    if len(known) < FEWEST:
        return []
    limit = max(GROSS * float(np.quantile(known, 0.9)), GROSS_TYPICAL * float(np.median(known)))
    with np.errstate(invalid="ignore"):
        far = np.argwhere(size > max(limit, FAINT))
    return [(int(row), int(target)) for target, row in far]


def off_shape(
    data: Measurements, error: Array, shifts: tuple[Fault, ...] = ()
) -> list[tuple[int, int]]:
    """(row, target) of points that do not fit the shape of the targets.

    Without the guilty point of a row the others are judged anew.
    """
    apart = level(between(data), data, shifts)
    if not len(apart.pairs):
        return []
    up = heights(data, error)
    every = data.seen.T.copy()
    far = unlikely(apart, up, every)
    found: list[tuple[int, int]] = []
    while (far > 1.0).any():
        rows = np.flatnonzero(far.max(axis=0) > 1.0)
        for row in rows:
            which = guilty(apart, far[:, row], every[:, row], int(row))
            if len(which) > 1 and len(error) and np.isfinite(error[every[:, row], row]).all():
                which = which[[relative(error[:, row], every[:, row])[which].argmax()]]
            found += [(int(row), int(target)) for target in which]
            every[which, row] = False
        judged = np.isin(np.arange(data.poses), rows)
        up = np.where(judged, np.nan, up)  # a height is one over the others, the guilty among them
        far = np.where(judged, unlikely(apart, up, every), 0.0)
    return found


def guilty(apart: Between, far: Array, every: Array, row: int) -> Array:
    """The target that explains an unlikely row, or those that explain it alike.

    Its distances are off and the rest is not.  A point that moved across one of its edges changes
    one distance only; its neighbour might as well have moved.
    far: (k,) as `unlikely`.  every: (k,) the targets still believed.
    """
    squared = (apart.off[:, row] / apart.sigma) ** 2
    squared = np.where(every[apart.pairs].all(axis=1), squared, 0.0)
    rest = np.array([np.nansum(squared[~apart.of(i)]) for i in range(len(far))])
    rest = np.where(far > 1.0, rest, np.inf)
    return np.flatnonzero(rest <= rest.min() + ALIKE)


def relative(error: Array, every: Array) -> Array:
    """(k,) how far the error of each target is from the mean of the others.  error: (k, 3)."""
    count = int(every.sum())
    if count < 3:  # two differ by the same: the one that misses by more
        return np.where(every, np.linalg.norm(error, axis=1), -np.inf)
    mean = error[every].mean(axis=0)
    return np.where(every, np.linalg.norm(error - mean, axis=1), -np.inf)


def level(apart: Between, data: Measurements, shifts: tuple[Fault, ...]) -> Between:
    """The distances with the steps of shifted nests taken out."""
    off = apart.off.copy()
    for fault in shifts:
        later = np.zeros(data.poses, dtype=bool)
        later[fault.rows] = True
        if fault.rows.size == 0:
            continue
        for pair in np.flatnonzero(apart.of(int(fault.targets[0]))):
            a, b = (data.targets[i] for i in apart.pairs[pair])
            for amount in fault.parameters:
                if amount.name == f"{a}-{b}":
                    off[pair, later] -= amount.value
    if len(off):
        off -= np.nanmedian(off, axis=1, keepdims=True)
    return replace(apart, off=off, sigma=scatter(off))


def heights(data: Measurements, error: Array) -> Array:
    """(k, m) residual of each of three or more targets, across their plane, above the others [m].

    NaN where a target is missing.  Along the plane the distances say more: no turn of the flange
    changes them.
    """
    k = len(data.targets)
    if k < 3 or not len(error):
        return np.full((k, data.poses), np.nan)
    whole = data.seen.all(axis=1) & np.isfinite(error).all(axis=(0, 2))
    arm = data.y[whole] - data.y[whole].mean(axis=1, keepdims=True)
    across = np.linalg.svd(arm, full_matrices=False)[2][:, 2]
    sense = np.cross(arm[:, 0], arm[:, 1])
    across *= np.where((across * sense).sum(axis=1) < 0.0, -1.0, 1.0)[:, None]
    up = np.einsum("kmc,mc->km", error[:, whole], across)
    out = np.full((k, data.poses), np.nan)
    out[:, whole] = (up - up.mean(axis=0)) * k / (k - 1)
    return out


def unlikely(apart: Between, up: Array, every: Array) -> Array:
    """(k, m) squared Mahalanobis distance of what is known of each point, over its limit.

    up: (k, m) heights, NaN unknown [m].  every: (k, m) False for points already found.
    """
    k, m = up.shape
    out = np.zeros((k, m))
    for target in range(k):
        own = np.flatnonzero(apart.of(target))
        features = np.concatenate([apart.off[own], up[[target]]])
        others = apart.pairs[own].sum(axis=1) - target
        features[:-1][~(every[others] & every[target])] = np.nan
        usable = np.isfinite(apart.off[own]).sum(axis=1) >= FEWEST
        tall = np.isfinite(up[target]).sum() >= FEWEST
        features = features[np.append(usable, tall)]
        sigma = np.concatenate([apart.sigma[own][usable], [tilt(up[target])] if tall else []])
        if len(features):
            out[target] = mahalanobis(features / sigma[:, None], m)
    return out


def tilt(up: Array) -> float:
    """Scatter of heights, which hold the fit's errors too: wider where their tails are [m]."""
    known = np.abs(up[np.isfinite(up)])
    tail = float(np.quantile(known, 0.95)) / TAIL
    return max(float(scatter(up[None])[0]), tail)


def mahalanobis(z: Array, m: int) -> Array:
    """(m,) squared length of standard scores, correlation taken out, over the outlier limit.

    z: (f, m), NaN unknown.  Rows are judged by those scores they have.
    """
    known = np.isfinite(z)
    calm = np.where(known, np.clip(z, -2.5, 2.5), 0.0)
    both = known.astype(float) @ known.T
    correlation = calm @ calm.T / np.maximum(both, 1.0)
    size = np.sqrt(np.maximum(np.diag(correlation), 1e-12))
    correlation = np.clip(correlation / size[:, None] / size, -0.9, 0.9)
    np.fill_diagonal(correlation, 1.0)
    out = np.zeros(z.shape[1])
    for pattern in np.unique(known, axis=1).T:
        rows = (known == pattern[:, None]).all(axis=0)
        count = int(pattern.sum())
        if count:
            some = z[np.ix_(pattern, rows)]
            part = floored(correlation[np.ix_(pattern, pattern)])
            length = (some * np.linalg.solve(part, some)).sum(axis=0)
            out[rows] = length / outlier_limit(count, 3 * m, m)
    return out


def floored(correlation: Array) -> Array:
    """A correlation matrix without directions of no scatter, in which any point would be far."""
    value, vector = np.linalg.eigh(correlation)
    return np.asarray((vector * np.maximum(value, 0.1)) @ vector.T)


def outlier_limit(count: int, tests: int, m: int) -> float:
    """Squared standard score of `count` numbers that one of `tests` exceeds by a rare chance.

    Widened by what the robust scatter of m values may be wrong.
    """
    wider = 1.0 + 2.5 * 1.17 / np.sqrt(m)
    return float(stats.chi2.isf(FALSE_ALARM / tests, count) * wider**2)


# ---- notices ------------------------------------------------------------------------------------


def mixed_units(data: Measurements) -> tuple[Fault, ...]:
    """Sessions whose numbers are a unit apart from those of the first."""
    session = sessions(data)
    return tuple(
        Fault(
            "mixed_units",
            "all",
            np.flatnonzero(session == other),
            np.zeros(0, dtype=int),
            (Amount("ratio", ratio, np.nan, ""),),
            f"{what} from line {data.line[np.argmax(session == other)]} on ({word}) are about "
            f"{ratio:.3g} times those of the first session: another unit?",
        )
        for other in range(1, int(session.max()) + 1)
        for what, word, ratio in strange_ratios(data, session == 0, session == other)
    )


def strange_ratios(
    data: Measurements, first: Array, other: Array
) -> Iterator[tuple[str, str, float]]:
    """What two sessions give in different units, and how far apart."""
    size = [float(np.nanmedian(np.linalg.norm(data.y[s], axis=-1))) for s in (first, other)]
    ratio = size[1] / max(size[0], FAINT)
    for factor, word in ((1e3, "metres and millimetres"), (25.4, "inches and millimetres")):
        for f in (factor, 1.0 / factor):
            if abs(np.log(ratio / f)) < 0.5:
                yield "points", word, ratio
    turning = ~data.sliding
    if turning.any():
        wide = [float(np.median(np.ptp(data.q[s][:, turning], axis=0))) for s in (first, other)]
        if max(wide) > 4.0 * np.pi and min(wide) > 0.0:
            ratio = wide[1] / wide[0]
            if min(ratio, 1.0 / ratio) < 0.1:
                yield "joint values", "radians and degrees", ratio


def session_jumps(data: Measurements, error: Array = NO_ERROR) -> tuple[Fault, ...]:
    """A notice if the residual of a fit moves as a whole from session to session.

    The mean error of each pose's targets is explained by one small displacement (6) for all poses
    or one for each session (F-test).
    """
    session = sessions(data)
    if not len(error) or session.max() == 0:
        return ()
    count = np.maximum(np.isfinite(error[..., 0]).sum(axis=0), 1)[:, None]
    mean = np.nansum(error, axis=0) / count
    place = np.nansum(np.where(np.isfinite(error), np.moveaxis(data.y, 1, 0), np.nan), axis=0)
    known = np.isfinite(error[..., 0]).any(axis=0)
    rows, label = np.flatnonzero(known), session[known]
    many = np.bincount(label)
    if len(many) < 2 or many[many > 0].min() < FEWEST:
        return ()
    place = (place / count)[rows]
    place = place - place.mean(axis=0)
    lever = max(float(np.sqrt((place**2).mean())), FAINT)
    turn = np.cross(np.eye(3)[None], place[:, None] / lever)  # a turn about each axis, in levers
    design = np.concatenate([np.broadcast_to(np.eye(3), turn.shape), turn], axis=1)
    design = np.swapaxes(design, 1, 2)
    value = mean[rows].reshape(-1)
    one = design.reshape(-1, 6)
    each = np.concatenate(
        [np.where((label == s)[:, None, None], design, 0.0) for s in np.unique(label)], axis=2
    ).reshape(len(value), -1)
    left = [float(((value - a @ np.linalg.lstsq(a, value)[0]) ** 2).sum()) for a in (one, each)]
    spare, more = len(value) - each.shape[1], each.shape[1] - 6
    ratio = (left[0] - left[1]) / more / max(left[1] / spare, 1e-30)
    if stats.f.sf(ratio, more, spare) > 0.1 * FALSE_ALARM or left[0] < 1.1 * left[1]:
        return ()
    jump = float(np.sqrt(max(left[0] - left[1], 0.0) / len(rows)))
    return (
        Fault(
            "session_jump",
            "frame",
            rows[label > label[0]],
            np.zeros(0, dtype=int),
            (Amount("size", jump, np.nan, "m"),),
            "the whole robot stands elsewhere from session to session (about "
            f"{1e3 * jump:.3g} mm): was the instrument or the base moved, or is the workspace "
            "another one?",
            notice=True,
        ),
    )


def noise(data: Measurements) -> tuple[Fault, ...]:
    """A notice if the scatter of the distances, or of revisits, is not what `u95` says.

    Revisits hold the robot's own repeatability too: they can only show less than declared.
    """
    if "u95" not in data.columns or not np.isfinite(data.columns["u95"].astype(float)).any():
        return ()
    declared = float(np.nanmedian(data.columns["u95"].astype(float)))
    apart = between(data)
    if len(apart.pairs):
        seen, by = 1.96 * float(np.median(apart.sigma)) / np.sqrt(2.0), "the targets' distances"
    else:
        spread = revisit_scatter(data)
        if len(spread) < FEWEST:
            return ()
        seen, by = 1.96 * float(np.sqrt(np.median(spread) / stats.chi2.median(1))), "revisits"
    ratio = seen / declared
    if ratio > 0.5 and (ratio < 2.0 or by == "revisits"):
        return ()
    return (
        Fault(
            "noise",
            "all",
            np.zeros(0, dtype=int),
            np.zeros(0, dtype=int),
            (Amount("u95", seen, np.nan, "m"), Amount("declared", declared, np.nan, "m")),
            f"column u95_mm says {1e3 * declared:.3g} mm, {by} say {1e3 * seen:.3g} mm",
            notice=True,
        ),
    )


def revisit_scatter(data: Measurements) -> Array:
    """Squared differences of coordinates at poses visited again, halved: variances [m^2]."""
    group = groups(data)
    order = np.argsort(group, kind="stable")
    again = np.flatnonzero(np.diff(group[order]) == 0)[::2]
    change = data.y[order[again + 1]] - data.y[order[again]]
    return np.asarray(0.5 * change[np.isfinite(change)] ** 2)


# ---- read-back joints ---------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Lag:
    """How errors lie along the last moves.

    fraction: (r,) of the last move that was still to go, one for all joints of a row.
    explained: share of the squared errors along the own move; chance: along another row's.
    p: of the own move explaining more than the next row's so often by chance.
    """

    fraction: Array
    explained: float
    chance: float
    p: float


def lag(error: Array, path: Array) -> Lag:
    """The fraction of its last move that each row lacks [measured: irb120, 98 % explained].

    Joints of a coordinated move arrive together: all lack the same fraction when one reads them too
    early, but another one in each row.  error: (r, f), of joints or of points; path: (r, f) the
    move in the same coordinates (for points: Jacobian times move).
    """
    if len(error) < FEWEST:
        return Lag(np.zeros(len(error)), 0.0, 0.0, 1.0)
    total = np.maximum((error**2).sum(axis=1), 1e-300)
    along, other = ((error * p).sum(axis=1) for p in (path, np.roll(path, 1, axis=0)))
    length = np.maximum((path**2).sum(axis=1), 1e-300)
    own, strange = along**2 / length, other**2 / np.roll(length, 1)
    wins = int((own > strange).sum())
    return Lag(
        along / length,
        float(own.sum() / total.sum()),
        float(strange.sum() / total.sum()),
        float(stats.binomtest(wins, len(error), 0.5, alternative="greater").pvalue),
    )


def read_back(data: Measurements) -> Array:
    """(m, n) the `qread` columns, or of length 0 without them [rad, m]."""
    names = [f"qread{j + 1}" for j in range(data.q.shape[1])]
    if any(name not in data.columns for name in names):
        return np.zeros((0, data.q.shape[1]))
    return np.stack([data.columns[name].astype(float) for name in names], axis=1)


def unsettled(data: Measurements) -> tuple[Fault, ...]:
    """Joints read back before they had settled, where commanded and read ones are given.

    A notice if `qread` lags behind `q`, which then is right; a fault if q lags behind `qread`.
    """
    read = read_back(data)
    if not len(read):
        return ()
    apart = data.q - read
    known = np.isfinite(apart).all(axis=1)
    size = float(np.sqrt((apart[known] ** 2).mean())) if known.any() else 0.0
    if size < UNSETTLED:
        return ()
    rows = np.flatnonzero(known & followed(data) & moves(data).any(axis=1))
    found = lag(apart[rows], moves(data)[rows])
    many = data.q.shape[1] > 1
    lagging = many and found.p < 1e-3 and found.explained > max(0.3, 1.5 * found.chance)
    middle = float(np.median(found.fraction)) if lagging else 0.0
    says = f"read-back joints differ from the given ones by {1e3 * size:.3g} mrad RMS"
    if lagging:
        who = "qread was read" if middle > 0.0 else "q looks read"
        says += f"; {who} before the arm had settled ({100 * found.explained:.0f} % lies along the "
        says += f"last move, {1e3 * abs(middle):.2g} of a thousandth of it)"
    says += "; q is used as commanded" if middle >= 0.0 else "; give the commanded joints as q"
    return (
        Fault(
            "readback",
            "all",
            np.flatnonzero(known),
            np.zeros(0, dtype=int),
            (
                Amount("rms", size, np.nan, "rad"),
                Amount("fraction", middle, np.nan, ""),
                Amount("explained", found.explained, np.nan, ""),
            ),
            says,
            notice=middle >= 0.0,
        ),
    )


def looks_read_back(data: Measurements, error: Array, push: Array) -> tuple[Fault, ...]:
    """Whether the given joints themselves look read back too early, without others to compare.

    Errors of points then lie along each row's last move, by a fraction of its own; with backlash
    they lie better along the signs of the moves [irb120 read back: 77 % against 68 %; simulated
    backlash: 49 % against 62 %].
    error: (k, m, 3) of a fit [m].  push: (k, m, 3, n) displacement of each target per joint
    [m/rad], in the same axes.
    """
    move, sign_of = moves(data), np.sign(moves(data))
    rows = np.flatnonzero(followed(data) & move.any(axis=1))
    seen = np.asarray(np.isfinite(error).all(axis=-1))[..., None]
    flat = np.moveaxis(np.where(seen, error, 0.0), 1, 0).reshape(data.poses, -1)[rows]
    matrix = np.moveaxis(np.where(seen[..., None], push, 0.0), 1, 0)
    matrix = matrix.reshape(data.poses, flat.shape[1], -1)[rows]
    own, sign = (lag(flat, (matrix @ way[rows][:, :, None])[..., 0]) for way in (move, sign_of))
    if own.p > 1e-3 or own.explained < max(sign.explained, 0.5) + 0.02:
        return ()
    middle = float(np.median(own.fraction))
    return (
        Fault(
            "readback",
            "all",
            rows,
            np.zeros(0, dtype=int),
            (
                Amount("fraction", middle, np.nan, ""),
                Amount("explained", own.explained, np.nan, ""),
                Amount("explained_by_sign", sign.explained, np.nan, ""),
            ),
            "the joints look read back before the arm had settled: "
            f"{100 * own.explained:.0f} % of the errors lie along each pose's last move, by a "
            "fraction of its own; give the commanded joints",
        ),
    )


def round_joints(data: Measurements) -> float:
    """Share of turning joint values that are whole hundredths of a degree, zeros left out.

    Of joints read back about 0 to 1 in 50 are; many mean that somebody typed them.
    """
    degrees = np.degrees(data.q[:, ~data.sliding])
    degrees = degrees[np.abs(degrees) > 1e-6]
    if not len(degrees):
        return 0.0
    return float((np.abs(degrees * 100.0 - np.round(degrees * 100.0)) < 1e-4).mean())


def listed(names: list[str], most: int = 8) -> str:
    """Some names, and how many more there are."""
    more = f" and {len(names) - most} more" if len(names) > most else ""
    return ", ".join(names[:most]) + more
