"""Poses that tell two effects apart: what one moves and the other, with the geometry, cannot.

The power of a set of poses is lambda (1 - rho^2), as `separate` has it: the square, in units of
noise, of what is left of an effect's motion as it was fitted once its rival, the geometry and the
other effects have imitated it on old and new poses together.  It is one over the variance of the
effect's amplitude in the fit that holds all of them, so that the best poses are a design for one
unknown (c-optimal); for two linear models that is the T-optimal design [Atkinson and Fedorov 1975].
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial

import numpy as np

from minimax_cal.diagnosing import next_measurement
from minimax_cal.diagnosing.next_measurement import PREPARE, Pair, Site
from minimax_cal.evidence.noise import identified, restricted
from minimax_cal.evidence.selection import best_variant
from minimax_cal.fitting.calibrate import calibrate
from minimax_cal.ground.arrays import Array
from minimax_cal.ground.errors import OptionError
from minimax_cal.measuring.history import with_history
from minimax_cal.measuring.measurements import Measurements
from minimax_cal.modelling.cell import Cell
from minimax_cal.modelling.dictionary import ArmLaws
from minimax_cal.modelling.effects.scene import Scene
from minimax_cal.modelling.effects.table import fields_of, parse
from minimax_cal.modelling.effects.table import terms as terms_of
from minimax_cal.modelling.joint_fit import scene_of
from minimax_cal.modelling.model import model_of
from minimax_cal.modelling.rows import linearised
from minimax_cal.planning.designs.criteria import Trace, size_of
from minimax_cal.planning.designs.exchange import Menu
from minimax_cal.robots.robot import Robot

ALIKE = 1e-4  # 1 - rho^2 over all candidates below which two effects are the same at every pose
FAINT = 1e-9  # information about anything beside the effect that is there in any case


@dataclass(frozen=True, eq=False)
class Question:
    """Two effects that data confuse, and the fitted cell that shows them."""

    site: Site
    pair: Pair


@dataclass(frozen=True, eq=False)
class Ahead(Site):
    """A site whose further poses are given: `old` and `more`, no revisits."""

    given: next_measurement.Plan = field(kw_only=True)

    @cached_property
    def plan(self) -> next_measurement.Plan:
        """What is given."""
        return self.given


def question(
    robot: Robot, data: Measurements, cell: Cell, pair: Sequence[str], seed: int
) -> Question:
    """Fit the effect in question to the data, with the effects of a cell that are not in the pair.

    robot: nominal.  pair: the effect and its rival, as joint_compliance:J2.  Raises OptionError.
    """
    asked = [parse(text)[:2] for text in pair]
    labels = {f"{name}:{place}" for name, place in asked}
    beside = [term for term in cell.effects.terms if term.label not in labels]
    for term in beside:
        for name, place in asked:
            if term.effect == name and "all" in (term.place, place or "all"):
                raise OptionError(
                    f"separate=: the fit holds {term.label}, and {name}:{place or 'all'} is part "
                    "of the same: ask about that, or give a fit without it"
                )
    data = with_history(data)
    fit = calibrate(robot, data, "sum", holdout=0.0, effects=(*beside, pair[0]))
    data = fit.cell.placed(data)
    state = replace(fit.cell.state, effects=np.zeros(0))
    model = model_of(robot, data)
    scene = scene_of(robot, data, model, state)
    rows = linearised(model, state, scene.jacobian)
    fitted = fit.cell.effects
    noise = restricted(rows, rows.of(fields_of(fitted.terms, scene)))
    (other,) = terms_of(scene, pair[1:], partial(best_variant, ArmLaws(scene, rows)))
    one, value = fitted.terms[-1], fitted.values[-1]
    if one.text == other.text:
        raise OptionError(f"separate=: {pair[0]} and {pair[1]} are the same effect")
    if not np.any(value):
        raise OptionError(f"separate=: the data show no {one.label}; name another")
    known = tuple(zip(fitted.terms[:-1], fitted.values[:-1], strict=True))
    return Question(Site(scene, model, state, noise, seed), Pair(one, value, other, known))


def further(scene: Scene, q: Array) -> Measurements:
    """Poses (m, n) measured one after another once the data at hand are."""
    last = int(np.argmax(scene.column("clock")))
    old = next_measurement.with_columns(scene.data, scene)
    return next_measurement.visited_after(scene, old.take(np.full(len(q), last)), np.array(q))


def with_poses(site: Site, q: Array, seen: Array, via: Array) -> Ahead:
    """The site with the stops (c, n) of a way that may be gone.

    seen: (c, k) of its targets.  via: (c,) stops at which nothing is measured.
    """
    scene, weight = site.scene, site.model.weight
    m = scene.poses
    old = next_measurement.with_columns(scene.data, scene)
    data = old.followed_by(further(scene, q).take(~via))
    at = {"old": (0, m), "more": (m, int((~via).sum()))} | {
        kind: (m, 0) for kind in (*PREPARE, "old") if kind not in ("more", "old")
    }
    usual = float(np.median(weight[weight > 0.0]))
    plan = next_measurement.Plan(data, np.concatenate([weight, usual * seen[~via].T], axis=1), at)
    return Ahead(scene, site.model, site.state, site.noise, site.seed, given=plan)


@dataclass(frozen=True, eq=False)
class Contest:
    """What each candidate tells about the effect's amplitude, and about all that may imitate it.

    menu: the last unknown is the amplitude, in units of what was fitted.
    alone: lambda over all candidates and old poses, the rival not fitted.
    """

    menu: Menu
    alone: float

    @property
    def criterion(self) -> Trace:
        """One over the power."""
        weight = np.zeros((self.menu.unknowns,) * 2)
        weight[-1, -1] = 1.0
        return Trace(weight)

    def power(self, chosen: Array) -> float:
        """lambda (1 - rho^2) of old poses and those chosen."""
        return 1.0 / size_of(self.criterion, self.menu.of(chosen))

    @property
    def now(self) -> float:
        """Of the old poses."""
        return self.power(np.zeros(0, dtype=int))

    @property
    def everything(self) -> float:
        """Of all candidates together."""
        return self.power(np.arange(self.menu.count))

    @property
    def alike(self) -> bool:
        """Whether no pose tells the two apart."""
        return self.everything <= ALIKE * self.alone


def contest(asked: Question, q: Array, seen: Array, via: Array) -> Contest:
    """What the stops (c, n) of a way would tell.  seen: (c, k).  via: as `with_poses`."""
    site = with_poses(asked.site, q, seen, via)
    mine, _, _ = next_measurement.fields(site, asked.pair.one)
    found = np.tensordot(asked.pair.value, mine.points, 1)[None]
    beside = next_measurement.beside(site, asked.pair.known)
    rival = list(next_measurement.fields(site, asked.pair.other)[:2])
    parts = [part.points for part in (*beside, *rival)]
    ridge = np.concatenate([part.ridge for part in (*beside, *rival)])
    columns = site.turned.of(np.concatenate([*parts, found]))
    rows = np.concatenate([site.geometry, columns], axis=1) * site.root[:, None]
    prior = np.diag(np.concatenate([np.zeros(site.geometry.shape[1]), ridge, [0.0]]))
    free = len(prior) - 1 - sum(len(part.ridge) for part in rival)
    old = site.lines(site.plan.rows("old", len(asked.site.scene.data.q)))
    return Contest(menu_of(rows, prior, old, site.whole.targets), alone(rows, prior, free))


def menu_of(rows: Array, prior: Array, old: slice, targets: int) -> Menu:
    """Rows (N, d) in a basis in which what imitates is told to the same accuracy by everything."""
    whole = rows.T @ rows + prior
    span = identified(whole[:-1, :-1])
    turn = np.zeros((len(whole), span.shape[1] + 1))
    turn[:-1, :-1], turn[-1, -1] = span, 1.0
    turned = rows @ turn
    at_hand = turned[old]
    base = at_hand.T @ at_hand + turn.T @ prior @ turn
    base[np.arange(len(base) - 1), np.arange(len(base) - 1)] += FAINT
    return Menu(turned[old.stop :].reshape(-1, 3 * targets, turn.shape[1]), base)


def alone(rows: Array, prior: Array, free: int) -> float:
    """lambda of the last column over all rows, only the first `free` columns imitating it."""
    kept = [*range(free), rows.shape[1] - 1]
    gram = (rows.T @ rows + prior)[np.ix_(kept, kept)]
    span = identified(gram[:-1, :-1])
    across = span.T @ gram[:-1, -1]
    return float(gram[-1, -1] - across @ across)


def otherwise(asked: Question) -> str:
    """What else would tell them apart, by `separate`: load, sides, time, reflectors on the foot."""
    return next_measurement.separate_with(asked.site, asked.pair)
