"""The minimax of many draws of the same poses at once, each from a fit that is near.

Full steps of sequential quadratic programming [paper M, eq. 10-13], as `solvers.minimax` takes them
from a near start.  The QPs of a few targets and distances are solved in their multipliers: with
H = LL' of a draw and the rows B of its derivatives the step is d = -H^-1 B'z, and what the QP asks
of z involves B H^-1 B' alone, which has a row a target and a distance.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from minimax_cal.ground.arrays import Array
from minimax_cal.modelling.model import Model, arrays_of
from minimax_cal.modelling.parameters import State
from minimax_cal.robots.kernels import sums
from minimax_cal.robots.kernels.choice import kernels
from minimax_cal.solvers.minimax import Sqp

MAX_STEPS = 15  # SQP steps; a draw that takes more is no near one
CHANGES = 20  # of the set of active rows in a QP
SLIGHT = 1e-11  # a row of the QP broken by less is met


@dataclass(frozen=True, eq=False)
class Draw:
    """B draws of the poses of a model.

    times: (B, m) how often each row is drawn.  pairs: (l, 2) targets.  mean, tolerance: (B, l)
    their distance as drawn, and how far it may be off [m]; l may be 0.
    """

    times: Array
    pairs: Array
    mean: Array
    tolerance: Array

    def at(self, rows: Array) -> Draw:
        """Some of the draws."""
        return Draw(self.times[rows], self.pairs, self.mean[rows], self.tolerance[rows])


@dataclass(frozen=True, eq=False)
class Rows:
    """Every draw's problem at its state, scaled to about one.

    f: (B, k).  c: (B, l).  slope: (B, k + l, p) of both.  gram: (B, k, p, p) half the f's second
    derivatives.
    """

    f: Array
    c: Array
    slope: Array
    gram: Array

    def residual(self, z: Array) -> Array:
        """(B,) how far from optimal, as `minimax.Kkt`, with multipliers z (B, k + l)."""
        k = self.f.shape[1]
        mu, lam = z[:, :k], z[:, k:]
        stationarity = np.abs(np.einsum("br,brp->bp", z, self.slope)).max(axis=1)
        room = np.where(lam > 0.0, 1.0 - self.c, self.c + 1.0)
        slack = (mu * (self.f.max(axis=1, keepdims=True) - self.f)).sum(axis=1)
        slack += np.abs(lam * room).sum(axis=1)
        violation = np.maximum(np.abs(self.c) - 1.0, 0.0).max(axis=1, initial=0.0)
        return np.asarray(np.maximum(np.maximum(stationarity, slack), violation))

    def step(self, z: Array, floor: float) -> tuple[Array, Array, Array]:
        """Steps (B, p) and multipliers (B, k + l) of the QPs, and (B,) which were solved.

        z: multipliers for the Hessian and the rows that are active at first.
        """
        k = self.f.shape[1]
        weight = np.maximum(z[:, :k], floor / k)
        hessian = 2.0 * np.einsum("bk,bkpq->bpq", weight, self.gram, optimize=True)
        back = np.linalg.solve(hessian, np.swapaxes(self.slope, 1, 2))
        z, told = multipliers(self.slope @ back, self.f, self.c, np.sign(z))
        return -(back @ z[..., None])[..., 0], z, told


def multipliers(S: Array, f: Array, c: Array, sign: Array) -> tuple[Array, Array]:
    """Multipliers z (B, k + l) of min max (f - S z)_f with |(c - S z)_c| <= 1, by active sets.

    S: (B, k + l, k + l).  sign: (B, k + l) 1 for active functions, 1 or -1 for distances at their
    upper or lower bound, else 0.  Returns (B,) too, True where it came to an end.
    """
    (count, k), r = f.shape, S.shape[1]
    sign, told, every = sign.copy(), np.zeros(count, dtype=bool), np.arange(count)
    sign[~(sign[:, :k] > 0.0).any(axis=1), :k] = 1.0
    z, is_f = np.zeros((count, r)), np.arange(r) < k
    both = np.concatenate([f, c], axis=1)
    for _ in range(CHANGES):
        on = sign != 0.0
        matrix = np.zeros((count, r + 1, r + 1))
        matrix[:, :r, :r] = S * (on[:, :, None] & on[:, None]) + np.eye(r) * ~on[:, None]
        matrix[:, :r, r] = matrix[:, r, :r] = on & is_f
        right = np.concatenate([(both - np.where(is_f, 0.0, sign)) * on, np.ones((count, 1))], 1)
        solved = np.linalg.solve(matrix, right[..., None])[..., 0]
        z, ahead = solved[:, :r], both - np.einsum("brs,bs->br", S, solved[:, :r])
        over = np.where(is_f, ahead - solved[:, r:], np.abs(ahead) - 1.0)
        over[on] = -np.inf
        wrong = np.where(on, -z * np.where(is_f, 1.0, sign), -np.inf)
        drop, add = wrong.argmax(axis=1), over.argmax(axis=1)
        leaves, comes = wrong[every, drop] > 0.0, over[every, add] > SLIGHT
        told = ~(leaves | comes)
        if told.all():
            break
        sign[every[leaves], drop[leaves]] = 0.0
        comes &= ~leaves
        sense = np.where(is_f, 1.0, np.sign(ahead))
        sign[every[comes], add[comes]] = sense[every[comes], add[comes]]
    return z, told


@dataclass(frozen=True, eq=False)
class Redrawn:
    """The draws of a model's poses, with their scaling at a fit.

    counts: (B, k) points of each target.  size: (B,) largest mean square there [m^2].  scale:
    (B, p) divides a step's entries.
    """

    model: Model
    draw: Draw
    counts: Array
    size: Array
    scale: Array

    @staticmethod
    def of(model: Model, draw: Draw, fit: State) -> Redrawn:
        """The draws of poses, scaled at a fit."""
        count, p = len(draw.times), int(model.active.sum())
        counts = draw.times @ model.seen.T
        bare = Redrawn(model, draw, counts, np.ones(count), np.ones((count, p)))
        F, _, G = bare.normal(fit.repeat(count))
        size = np.maximum((F / counts).max(axis=1), 1e-18)
        mean = np.einsum("bkpp,bk->bp", G, 2.0 / counts) / F.shape[1]
        return Redrawn(model, draw, counts, size, np.sqrt(np.maximum(mean / size[:, None], 1e-30)))

    def at(self, rows: Array) -> Redrawn:
        """Some of the draws."""
        return Redrawn(
            self.model, self.draw.at(rows), self.counts[rows], self.size[rows], self.scale[rows]
        )

    def normal(self, x: State) -> tuple[Array, Array, Array]:
        """F (B, k), J'We (B, k, p), J'WJ (B, k, p, p) of every draw at its state."""
        q, prismatic, y, weight, fields, moved = self.model.sight
        parts, out, own = arrays_of(x), [], kernels()
        columns = sums.Columns.of(parts, np.flatnonzero(self.model.active))
        for b, times in enumerate(self.draw.times):
            rows = np.flatnonzero(times)
            more = (part[..., rows] if len(part) else part for part in (fields, moved))
            drawn = q[rows], prismatic, y[..., rows], weight[:, rows] * times[rows], *more
            at = tuple(part[b : b + 1] for part in parts)
            out.append(columns.normal(own, at, drawn))
        F, g, G = (np.concatenate(part) for part in zip(*out, strict=True))
        return F, g, G

    def rows(self, x: State) -> Rows:
        """The problems at their states."""
        F, g, G = self.normal(x)
        each, (a, b) = 1.0 / self.counts / self.size[:, None], self.draw.pairs.T
        spots, names = x.target_positions, self.model.names
        apart = spots[:, a] - spots[:, b]
        length = np.maximum(np.linalg.norm(apart, axis=-1), 1e-12)
        unit = apart / length[..., None] / self.draw.tolerance[..., None]
        normal = np.zeros((len(F), len(a), len(names.target_names), 3))
        normal[:, range(len(a)), a], normal[:, range(len(a)), b] = unit, -unit
        wide = np.zeros((len(F), len(a), names.count))
        wide[..., names.geometric - spots[0].size : names.geometric] = normal.reshape(
            len(F), len(a), -1
        )
        slope = np.concatenate([-2.0 * g * each[..., None], wide[..., self.model.active]], axis=1)
        both = each[..., None, None] / (self.scale[:, :, None] * self.scale[:, None])[:, None]
        return Rows(
            f=F * each,
            c=(length - self.draw.mean) / self.draw.tolerance,
            slope=slope / self.scale[:, None],
            gram=G * both,
        )

    def moved(self, x: State, d: Array) -> State:
        """The states after scaled steps d (B, p)."""
        full = np.zeros((len(d), self.model.names.count))
        full[:, self.model.active] = d / self.scale
        return x.step(full)


def solved_at_once(
    model: Model, fit: State, draw: Draw, mu: Array, settings: Sqp
) -> tuple[State, Array]:
    """The minimax of every draw, a batch of B states, and (B,) True where it was reached.

    model: with the fit's free parameters, without a prior.  mu: (k,) multipliers of the fit.
    """
    ends, good = fit.repeat(len(draw.times)), np.zeros(len(draw.times), dtype=bool)
    left, at, x = np.arange(len(good)), Redrawn.of(model, draw, fit), ends
    z = np.repeat(np.pad(mu, (0, len(draw.pairs)))[None], len(good), axis=0)
    for _ in range(MAX_STEPS):
        here = at.rows(x)
        done = here.residual(z) <= settings.tolerance
        d, z, told = here.step(z, settings.floor)
        done |= here.residual(z) <= settings.tolerance
        good[left[done]] = True
        ends = ends.put(left[done], x.take(done))
        stay = np.flatnonzero(~done & told & np.isfinite(d).all(axis=1))
        if not len(stay):
            break
        at, left, z = at.at(stay), left[stay], z[stay]
        x = at.moved(x.take(stay), d[stay])
    return ends, good
