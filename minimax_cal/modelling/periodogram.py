"""Lines in the residual: ripple of gears whose number of waves a turn nobody told."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import chdtrc

from minimax_cal.evidence.limits import APART, UNSTEADY
from minimax_cal.evidence.noise import Noise, remaining
from minimax_cal.ground.arrays import Array
from minimax_cal.modelling.effects.gears import sweeping
from minimax_cal.modelling.effects.scene import Scene, joint_of
from minimax_cal.modelling.effects.table import Term
from minimax_cal.modelling.rows import Posed

SLOWEST, FASTEST = 8.0, 260.0  # waves a turn that are looked for; no gear has fewer teeth
DENSITY = 4.0  # frequencies tried for each one that is independent
TIMES = (1, 2)  # waves of a gear in each turn of its motor
SEVERAL = 2.0  # a line is never found at once
BESIDE = 1.0  # a strain wave gear turns by one more or less than its ratio tells


def strongest_lines(
    scene: Scene,
    rows: Posed,
    noise: Noise,
    known: Array,
    *,
    heard: Sequence[Term] = (),
) -> list[tuple[Term, float]]:
    """The strongest line of each joint near its gear's ratio, and any, if it stays.

    A ratio is told by the robot, else by lines of other joints: arms have few kinds of gears.

    With the number of independent frequencies tried of such lines, at all joints; near ratios at
    the joint alone once another has a line: each gear of an arm whose gears err is asked for by
    itself.  known: (N, q) columns that are fitted already.  heard: lines that were found.
    """
    weight = noise.weights(rows)
    pull = weight * remaining(rows, weight, known)
    arms = rows.of(scene.jacobian)
    apart: list[tuple[Term, float]] = []
    near: list[Term] = []
    free: list[Term] = []
    tried_near, tried = SEVERAL, SEVERAL
    for j in sweeping(scene):
        score = (arms[:, j] * pull).reshape(scene.poses, -1).sum(axis=1)
        size = (arms[:, j] ** 2 * weight).reshape(scene.poses, -1).sum(axis=1)
        line, place = Line(scene.q[j], score, size), f"J{j + 1}"
        ratio, others = float(scene.robot.ratio[j]), elsewhere(place, heard)
        found = [line.strongest(*band) for band in expected(ratio, others)]
        here = sum(tries for _, tries in found)
        tried_near += here
        stay = [turns for turns, _ in found if bands(ratio) or line.stays(turns)]
        lines = [Term("gear_ripple", place, {"turns": turns}) for turns in stay]
        if others:
            apart += [(term, SEVERAL + here) for term in lines]
        else:
            near += lines
        turns, tries = line.strongest(SLOWEST, FASTEST)
        tried += tries
        if line.stays(turns):
            free.append(Term("gear_ripple", place, {"turns": turns}))
    return [*apart, *((term, tried_near) for term in near), *((term, tried) for term in free)]


def elsewhere(place: str, heard: Sequence[Term]) -> list[float]:
    """Waves a turn of lines at other joints."""
    return [term.choice["turns"] for term in heard if term.place != place]


def is_expected(scene: Scene, line: Term, heard: Sequence[Term]) -> bool:
    """Whether a line is where its gear's is, on an arm of which another gear has one."""
    joint, others = joint_of(line.place), elsewhere(line.place, heard)
    near = in_company(
        float(scene.robot.ratio[joint]), scene.q[joint], [line.choice["turns"]], others
    )
    return bool(others) and near


def in_company(ratio: float, q: Array, own: Sequence[float], others: Sequence[float]) -> bool:
    """Whether some line of a joint is where its gear's ratio tells, or of a kind with another line.

    To half of what the joint's sweep resolves.  q: (m,) its angles.  own, others: waves a turn of
    lines at the joint, and elsewhere.
    """
    loose = 0.5 / sweep(q)
    for number, turns in enumerate(own):
        near = expected(ratio, [*others, *own[:number], *own[number + 1 :]])
        if any(low - loose <= turns <= high + loose for low, high in near):
            return True
    return False


def sweep(q: Array) -> float:
    """Of angles (m,), in turns; a wave is resolved from another that makes one more in it."""
    return max(float(np.ptp(q)) / (2.0 * np.pi), 0.1)


def expected(ratio: float, others: Sequence[float]) -> list[tuple[float, float]]:
    """Where lines of a joint's gear may be: near its ratio, else where gears of others have theirs.

    ratio: NaN untold.  others: waves a turn of lines that were heard.
    """
    return bands(ratio) or alike(others)


def bands(ratio: float) -> list[tuple[float, float]]:
    """Where lines of a gear may be, whose ratio is told, of either sign; none for NaN."""
    size = abs(ratio)
    return [(k * (size - BESIDE), k * (size + BESIDE)) for k in TIMES if size > SLOWEST]


def alike(heard: Sequence[float]) -> list[tuple[float, float]]:
    """Where lines of a gear may be that is of the kind of others, whose lines were heard."""
    ratios = {one / k for one in heard for k in TIMES}
    wide = sorted(band for ratio in ratios for band in bands(ratio) if band[1] <= FASTEST)
    out: list[tuple[float, float]] = []
    for low, high in wide:
        if out and low <= out[-1][1]:
            out[-1] = (out[-1][0], max(high, out[-1][1]))
        else:
            out.append((low, high))
    return out


@dataclass(frozen=True, eq=False)
class Line:
    """What poses tell of waves of one joint's angle.

    q: (m,) angles.  score, size: (m,) weighed products of its motion with the errors and itself.
    """

    q: Array
    score: Array
    size: Array

    def gain(self, turns: Array) -> Array:
        """(f,) by equally spaced waves a turn."""
        return power(*sums(turns, self.q, self.score, self.size))

    def strongest(self, low: float, high: float) -> tuple[float, float]:
        """The strongest of a band, and the number of independent frequencies in it."""
        step = 1.0 / (DENSITY * sweep(self.q))
        turns = np.arange(low, high + step, step)
        near = turns[int(np.argmax(self.gain(turns)))] + step * np.linspace(-1.0, 1.0, 41)
        return float(near[int(np.argmax(self.gain(near)))]), len(turns) / DENSITY * 2.0

    def stays(self, turns: float, apart: float = APART) -> bool:
        """Whether both halves of the sweep show a wave, of the same frequency, size and phase.

        apart: of its gain, by which they may differ in any case.
        """
        low = self.q < np.median(self.q)
        if not low.any():  # most poses stand at one end: there are no two halves
            return False
        whole = float(self.gain(turns + np.array([0.0, 1e-3]))[0])
        more = -whole
        for half in (low, ~low):
            own = Line(self.q[half], self.score[half], self.size[half])
            near = turns + np.linspace(-1.0, 1.0, 41) / sweep(own.q)
            more += float(own.gain(near).max())
        return bool(chdtrc(4, more) > UNSTEADY or more < apart * whole)


def sums(turns: Array, q: Array, score: Array, size: Array) -> tuple[Array, Array, float]:
    """Sums over poses of score e^(i k q) and of size e^(2 i k q) for turns k (f,), and of size.

    turns: equally spaced, so that every wave is a product of one from a coarse grid and one of the
    few between, themselves powers: the sums over poses are products of two small matrices.
    """
    count = int(np.ceil(np.sqrt(len(turns))))
    step = np.exp(1j * (turns[1] - turns[0]) * q)
    fine = powers(np.ones_like(step), step, count)
    coarse = powers(np.exp(1j * turns[0] * q), fine[-1] * step, -(-len(turns) // count))
    pull = (coarse * score) @ fine.T
    square = (coarse**2 * size) @ (fine**2).T
    return pull.reshape(-1)[: len(turns)], square.reshape(-1)[: len(turns)], float(size.sum())


def powers(first: Array, step: Array, count: int) -> Array:
    """(count, m) first, then each times step.  first, step: (m,)."""
    out = np.empty((count, len(first)), dtype=complex)
    out[0] = first
    for i in range(1, count):
        np.multiply(out[i - 1], step, out=out[i])
    return out


def power(pull: Array, square: Array, whole: float) -> Array:
    """(f,) gain of a wave of each frequency.  pull, square, whole: as `sums` has them."""
    cc, ss, cs = 0.5 * (whole + square.real), 0.5 * (whole - square.real), 0.5 * square.imag
    det = np.maximum(cc * ss - cs * cs, 1e-12 * cc * ss + 1e-300)
    top = ss * pull.real**2 - 2.0 * cs * pull.real * pull.imag + cc * pull.imag**2
    return np.asarray(top / det)
