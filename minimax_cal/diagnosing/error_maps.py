"""Joints whose error is a curve of their own angle that no formula tells: sought after the names.

A map enters where groups of poses that are left out tell that it helps, beside geometry, the
effects that were named, and more than slow laws of the same joint do: a gain, one to three waves.
Where its curve is one wave, that wave is named instead.  Laws of the same angle that the map makes
needless leave: lines of a free frequency are a series for such a curve.

Lines of gears are sought once more in the same way, near ratios that the robot tells or lines of
other joints have shown: where all that a model lacks passes for noise of the joints, the weights by
which effects are sought hide fine waves of the first ones, which move the targets most.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from minimax_cal.diagnosing.joint import Joint
from minimax_cal.diagnosing.left_out import (
    SHAPES,
    Beside,
    Block,
    Left,
    begun,
    by_joint,
    gain_chance,
)
from minimax_cal.diagnosing.result import Finding
from minimax_cal.evidence.limits import GAIN_LEVEL, NEARLY, NEEDLESS, ONE_WAVE
from minimax_cal.ground.arrays import Array
from minimax_cal.modelling.effects.gears import GEAR_RIPPLE, sweeping
from minimax_cal.modelling.effects.maps import FINEST, JOINT_ERROR_MAP, range_of, sines
from minimax_cal.modelling.effects.scene import BESIDE, Scene, joint_of
from minimax_cal.modelling.effects.table import EFFECTS, Term
from minimax_cal.modelling.periodogram import Line, elsewhere, expected

USUAL = 1e-3  # size of slow laws [rad]
SLOW = 4.0  # waves a turn of the slowest that is called a ripple


@dataclass(frozen=True, eq=False)
class Mapped:
    """terms: what is found, the largest gain first.  chances: that groups gain so much by accident.

    gains: of the square left out, over its variance.  again: share of the parts left out that are
    met better.  needless: terms that they replace.
    """

    terms: tuple[Term, ...] = ()
    chances: tuple[float, ...] = ()
    gains: tuple[float, ...] = ()
    again: tuple[float, ...] = ()
    needless: tuple[Term, ...] = ()

    def beside(self, effects: Sequence[Sequence[Term]]) -> list[Sequence[Term]]:
        """The effects of a ladder with the maps, without what these replace."""
        gone = {term.key for term in self.needless}
        kept = [terms for terms in effects if terms[0].key not in gone]
        had = {terms[0].key for terms in kept}
        return [*kept, *((term,) for term in self.terms if term.key not in had)]

    def findings(self, named: Sequence[Finding], scene: Scene) -> list[Finding]:
        """`beside` for findings; values are those of a fit that comes."""
        gone = {term.key for term in self.needless}
        out = [finding for finding in named if finding.term.key not in gone]
        for i, term in enumerate(self.terms):
            columns = term.columns(scene)
            none = (0.0,) * len(columns.names)
            names, units, chance = columns.names, columns.units, self.chances[i]
            new = Finding((term,), names, units, none, none, self.gains[i], chance)
            out.append(replace(new, fixed=columns.fixed, again=self.again[i]))
        return out


NO_MAPS = Mapped()


def error_maps(fit: Joint, exclude: Sequence[str] = ()) -> Mapped:
    """The error maps, and lines of gears, that a fit of geometry and named effects lacks.

    exclude: effects that are not sought.
    """
    left = Left.of(fit)
    if not len(left.parts):
        return Mapped()
    usual = begun(left).usual
    some = left.take(usual)
    if not len(some.parts):
        return Mapped()
    lines = fine_waves(fit, some) if GEAR_RIPPLE.name not in exclude else []
    maps: list[Found] = []
    if JOINT_ERROR_MAP.name not in exclude:
        maps = chosen(fit, some, [found.block for found in lines])
    if not (lines or maps):
        return Mapped()
    rippled = {term.place for term in fit.terms if term.effect == GEAR_RIPPLE.name}
    rippled |= {found.block.place for found in lines}
    needless = replaced(fit, left, usual, lines, maps)
    at = begun(without(fit, left, needless).take(usual))
    terms, gains, again = [], [], []
    for found in (*lines, *maps):
        wide = at.with_block(found.block)
        wave = GEAR_RIPPLE.name not in exclude and found.block.place not in rippled
        terms.append(found.term or term_of(fit, found.block, wide, at.variance, wave=wave))
        gains.append((at.square - wide.square) / wide.variance)
        fell = (at.error**2 - wide.error**2).sum(axis=1)
        again.append(float(np.mean([fell[part].sum() > 0.0 for part in at.parts])))
        at = wide
    chances = tuple(found.chance for found in (*lines, *maps))
    return Mapped(tuple(terms), chances, tuple(gains), tuple(again), needless)


@dataclass(frozen=True, eq=False)
class Found:
    """Functions that groups left out call for.  chance: of that by accident.

    term: what they are, None where the curve will tell.
    """

    block: Block
    chance: float
    term: Term | None = None


def fine_waves(fit: Joint, left: Left) -> list[Found]:
    """Lines of gears that a fit lacks, near their ratios, one a joint."""
    heard = [t for t in fit.terms if t.effect == GEAR_RIPPLE.name]
    silent = [
        j for j in sweeping(fit.study.scene) if f"J{j + 1}" not in {term.place for term in heard}
    ]
    waiting = [line for j in silent for line in strongest(fit, left, j, heard)]
    asked = 1 if heard else len(silent)  # each by itself, where another has a line
    at, out = begun(left), []
    for block, turns, tries in waiting:
        wide = at.with_block(block)
        chance = asked * tries * gain_chance(at, wide, left.group)
        if chance < GAIN_LEVEL:
            out.append(Found(block, chance, Term(GEAR_RIPPLE.name, block.place, {"turns": turns})))
            at = wide
    return out


def strongest(
    fit: Joint, left: Left, joint: int, heard: Sequence[Term]
) -> list[tuple[Block, float, float]]:
    """The strongest line of a joint near its gear's ratio, its waves a turn, and how many were
    tried; none if the halves of the sweep do not agree on it.
    """
    arm, at = left.arm[:, :, joint], begun(left)
    score, size = ((arm * other).sum(axis=1) / at.variance for other in (at.error, arm))
    line = Line(left.q[:, joint], score, size)
    place = f"J{joint + 1}"
    near = expected(float(fit.study.scene.robot.ratio[joint]), elsewhere(place, heard))
    if not near:
        return []
    found = [line.strongest(*band) for band in near]
    gains = [float(line.gain(turns + np.array([0.0, 1e-3]))[0]) for turns, _ in found]
    turns = found[int(np.argmax(gains))][0]
    if not line.stays(turns, NEARLY):
        return []
    wave = np.stack([f(turns * left.q[:, joint]) for f in (np.cos, np.sin)], axis=1)
    block = Block(place, arm[:, :, None] * wave[:, None], np.full((1, 2), USUAL))
    return [(block, turns, sum(tries for _, tries in found))]


def chosen(fit: Joint, left: Left, beside: Sequence[Block]) -> list[Found]:
    """The joints that have a map beside some blocks, the weightiest first."""
    sliding, at = fit.study.scene.robot.prismatic, begun(left)
    for block in beside:
        at = at.with_block(block)
    waiting = [block for block in by_joint(left) if not sliding[joint_of(block.place)]]
    out: list[Found] = []
    tries = len(waiting)
    while waiting:
        tried = [at.with_block(block) for block in waiting]
        for number in np.argsort([one.square for one in tried]).tolist():
            # Laws of the joint's own angle that have a name: its gain, and slow waves.
            joint = joint_of(waiting[number].place)
            q = left.q[:, joint]
            laws = np.stack([q, *(f(k * q) for k in (1, 2, 3) for f in (np.cos, np.sin))], axis=1)
            columns = left.arm[:, :, joint, None] * laws[:, None]
            slow = Block(f"J{joint + 1}", columns, np.full((1, laws.shape[1]), USUAL))
            plain = at.with_block(slow)
            each = [gain_chance(base, tried[number], left.group) for base in (at, plain)]
            chance = tries * max(each)
            if chance < GAIN_LEVEL:
                at = tried[number]
                out.append(Found(waiting.pop(number), chance))
                break
        else:
            return out
    return out


def term_of(fit: Joint, block: Block, at: Beside, variance: float, *, wave: bool) -> Term:
    """The map of a block that was just fitted, or the wave that it is, where that may be its name.

    variance: of a coordinate, with which its prior was weighed [m^2].
    """
    q, (size, length) = fit.study.scene.q[joint_of(block.place)], SHAPES[at.picked]
    low, high = range_of(q)
    x = np.linspace(q.min(), q.max(), 8 * block.columns.shape[-1])
    curve = at.value[-block.columns.shape[-1] :] @ sines(x, low, high, block.columns.shape[-1])
    turns, share = strongest_wave(x, curve)
    if wave and share > ONE_WAVE:
        return Term(GEAR_RIPPLE.name, block.place, {"turns": turns})
    size *= BESIDE / float(np.sqrt(variance))
    choice = {"low": low, "high": high, "length": length, "size": size}
    return Term(JOINT_ERROR_MAP.name, block.place, choice)


def strongest_wave(x: Array, curve: Array) -> tuple[float, float]:
    """Waves a turn that come nearest to a curve (g,), and the share of its square they explain."""
    least, most = 2.0 * np.pi / np.ptp(x), 2.0 * np.pi / FINEST
    turns = np.arange(max(least, SLOW), most, 0.1 * least)
    best, bare = (0.0, 0.0), curve - np.polyval(np.polyfit(x, curve, 1), x)
    for k in turns:
        columns = np.stack([np.ones_like(x), x, np.cos(k * x), np.sin(k * x)], axis=1)
        rest = curve - columns @ np.linalg.lstsq(columns, curve, rcond=None)[0]
        best = max(best, (1.0 - float(rest @ rest) / max(float(bare @ bare), 1e-300), float(k)))
    return best[1], best[0]


# ---- laws that a map makes needless ------------------------------------------------------------


def replaced(
    fit: Joint, left: Left, usual: Array, lines: Sequence[Found], maps: Sequence[Found]
) -> tuple[Term, ...]:
    """Named laws of the same angles as maps, without which groups left out are met as well."""
    blocks = [found.block for found in (*lines, *maps)]
    places = {found.block.place for found in maps}
    own = []  # a wave, or a gain: a part of any curve of its joint's angle
    for term in fit.terms:
        law = EFFECTS[term.effect]
        if term.place in places and law.of_angle and (law.lines or law.linear):
            own.append(term)
    least = squared(left, usual, blocks)
    bare = begun(without(fit, left, own).take(usual)).square
    gone: tuple[Term, ...] = ()
    for key in dict.fromkeys((t.effect, t.place) for t in own):
        fewer = (*gone, *(t for t in own if (t.effect, t.place) == key))
        if squared(without(fit, left, fewer), usual, blocks) - least < NEEDLESS * (bare - least):
            gone = fewer
    return gone


def squared(left: Left, usual: Array, blocks: Sequence[Block]) -> float:
    """The square of poses left out with maps of some joints [m^2]."""
    at = begun(left.take(usual))
    for block in blocks:
        at = at.with_block(block)
    return at.square


def without(fit: Joint, left: Left, gone: Sequence[Term]) -> Left:
    """What is left once some effects of a fit are not in it."""
    if not gone:
        return left
    scene, count = fit.study.scene, fit.model.names.geometric
    texts = {term.text for term in gone}
    owner = [t.text in texts for t in fit.terms for _ in t.columns(scene).names]
    names = np.concatenate([np.zeros(count, dtype=bool), owner])
    own = names[fit.estimator.model.active]
    value = np.concatenate([np.zeros(count), fit.state.effects])[fit.estimator.model.active]
    held = left.prior > 0.0  # of which nothing was taken away
    back = left.columns[..., own] @ np.where(held, 0.0, value)[own]
    kept = left.columns[..., ~own]
    return replace(left, y=left.y + back, columns=kept, prior=left.prior[~own])
