"""Which parameters the data can tell, and why the others not.

Positions move in the same way under several parameters (d1 and the base's z).  Of each such family
one member is left at its nominal value.  Which one is a matter of taste: predictions are the same.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from weakref import WeakKeyDictionary

import numpy as np

from minimax_cal.ground.arrays import Array
from minimax_cal.ground.words import name_first
from minimax_cal.instruments.instrument import PLENTY, anywhere
from minimax_cal.modelling.model import Model
from minimax_cal.modelling.parameters import Names, State
from minimax_cal.robots import kinematics
from minimax_cal.robots.robot import Robot
from minimax_cal.solvers.least_squares import solve_normal

PARALLEL = np.sin(np.radians(5.0))  # neighbouring axes closer than this count as parallel
# Singular values of the column-scaled Jacobian, relative to the largest: below RANK a direction is
# redundant whatever the poses; below RESOLUTION these poses show it a thousand times weaker than
# others, and its estimate would be noise (a target 0.1 mm off the last axis "measures" the wrist).
RANK_TOLERANCE = 1e-6
RESOLUTION = 1e-3
MAX_NAMED = 4  # names in a reason
TOGETHER = "all targets moved together"


class Because(StrEnum):
    """Why a parameter keeps its nominal value, as files call it."""

    FIXED = "fixed"
    NO_MOTION = "no_motion"
    SAME_MOTION = "same_motion"
    NOT_TOLD = "not_determined"
    NO_SCALE = "no_scale"
    OTHER = "other"


WORDS = {  # {} for the parameters that move the points alike
    Because.FIXED: "fixed by the user",
    Because.NO_MOTION: "moves no measured point",
    Because.SAME_MOTION: "same motion as {}",
    Because.NOT_TOLD: "these poses do not tell it from {}",
}
BY_OTHERS = (Because.SAME_MOTION, Because.NOT_TOLD)


@dataclass(frozen=True)
class Reason:
    """Why a parameter keeps its nominal value.

    like: the identified parameters that together move the points as it does, the largest first.
    """

    text: str
    kind: Because = Because.OTHER
    like: tuple[str, ...] = ()


def name_reason(kind: Because, like: Sequence[str]) -> str:
    """A reason of BY_OTHERS in words."""
    return WORDS[kind].format(name_first(like, MAX_NAMED))


@dataclass(frozen=True, eq=False)
class Identification:
    """active: (p,) True where a parameter is identified.

    reasons: why each other parameter keeps its nominal value, by name.
    singular: singular values of the scaled Jacobian of the kept parameters, largest first.
    scale: (p,) root mean square motion of a point per unit of each parameter [m per unit].
    """

    active: Array
    reasons: Mapping[str, Reason]
    singular: Array
    scale: Array

    @property
    def condition(self) -> float:
        """Condition number of the scaled Jacobian of the kept parameters (1/O2 of the field)."""
        return float(self.singular[0] / self.singular[-1])

    def asked(self, names: Sequence[str]) -> Array:
        """(p,) True but for names that the user fixed."""
        return np.array([self.reasons.get(name, Reason("")).kind is not Because.FIXED
                         for name in names])  # fmt: skip


@dataclass(frozen=True, eq=False)
class Kept:
    """What is left while parameters are given up.

    active: (p,) True where a parameter is kept.  reasons: why others are not, by name; those of
    BY_OTHERS do not say yet by which.
    """

    names: Names
    active: Array
    reasons: Mapping[str, Reason]

    def without(self, gone: Array | list[int], kind: Because, text: str = "") -> Kept:
        """Fewer.  gone: (p,) mask, or indices.  text: of the reason, WORDS unless given."""
        active, reason = self.active.copy(), Reason(text or WORDS[kind], kind)
        active[gone] = False
        lost = np.arange(len(active))[gone]
        named = dict.fromkeys((self.names.all[i] for i in lost), reason)
        return Kept(self.names, active, {**self.reasons, **named})

    def identification(
        self, gram: Array, scale: Array, stems: Iterable[str], whole: str
    ) -> Identification:
        """The reasons written out, and the singular values.

        gram: (p, p).  scale: (p,), see `Identification`.  stems: points as smr1, of which several
        are one thing to the reader, called `whole`.
        """
        reasons, active = dict(self.reasons), self.active
        lost = [name for name, reason in reasons.items() if reason.kind in BY_OTHERS]
        place = np.array([self.names.index(name) for name in lost], dtype=int)
        mixes = solve_normal(gram[np.ix_(active, active)], gram[active][:, place])
        for name, i, mix in zip(lost, place, mixes.T, strict=True):
            like = self.partners(np.abs(mix) * scale[active] / scale[i], stems, whole)
            kind = reasons[name].kind
            reasons[name] = Reason(name_reason(kind, like), kind, like)
        scaled = gram[np.ix_(active, active)] / np.outer(scale[active], scale[active])
        singular = np.sqrt(np.maximum(np.linalg.eigvalsh(scaled)[::-1], 0.0))
        return Identification(active, reasons, singular, scale)

    def partners(self, share: Array, stems: Iterable[str], whole: str) -> tuple[str, ...]:
        """The kept parameters that together move the points as one does, largest first.

        share: (kept,) of the motion.
        """
        names, chosen = self.names.all, np.flatnonzero(self.active)
        clear = chosen[np.argsort(-share)[: np.count_nonzero(share > 0.1 * share.max(initial=0.0))]]
        shown = [names[i] for i in clear]
        spots = [name for name in shown if name.rsplit("_", 1)[0] in stems]
        if len({name.rsplit("_", 1)[0] for name in spots}) > 1:
            shown = [name for name in shown if name not in spots] + [whole]
        return tuple(shown)


def drop_order(robot: Robot, names: Names) -> Array:
    """Parameters in the order in which redundant ones are given up.

    First beta where the next axis is not parallel and d where it is (Hayati: a common normal of
    parallel axes is nowhere), then what repeats the base (d1, theta1) and the tool (the last
    link), then other link parameters from the wrist to the base, the base, and targets last.
    """
    n = robot.joints
    links = np.arange(5 * n).reshape(5, n)
    alpha, beta = robot.mdh[:, kinematics.ALPHA], robot.mdh[:, kinematics.BETA]
    parallel = np.hypot(np.sin(alpha), np.sin(beta)) < PARALLEL
    parallel[-1] = False
    a, d, theta, _, b = links
    first = [*b[~parallel], *d[parallel], d[0], theta[0], *links[[1, 2, 3, 0], -1]]
    rest = [*theta[::-1], *d[::-1], *a[::-1], *links[3][::-1], *b[parallel]]
    order = [*first, *rest, *range(5 * n, names.geometric)]
    return np.array(list(dict.fromkeys(int(i) for i in order)))


def scale_keeper(robot: Robot, allowed: Array, wanted: Array) -> list[int]:
    """The link length to keep as drawn where nothing tells the scale: the longest.

    An error of the drawing is then the smallest part of it.  allowed, wanted: (p,) what may be
    fitted, and what the user wants fitted.
    """
    lengths = np.abs(robot.mdh[:, :2].T.reshape(-1))
    chosen = np.flatnonzero(allowed[: len(lengths)])
    preferred = [i for i in chosen if not wanted[i]] or list(chosen)
    return [int(max(preferred, key=lambda i: lengths[i]))] if preferred else []


def identify(
    model: Model,
    state: State,
    order: Array,
    *,
    allowed: Array,
    reference: Model,
    known: Array,
    resolution: float = RESOLUTION,
) -> Identification:
    """The largest set of allowed parameters that the poses of the model determine.

    order: the parameters, those to give up first at the front.  allowed: (p,) False for parameters
    the user fixed.  reference: a model with plenty of poses, to tell what no pose could show from
    what these poses do not.  known: (p,) True where a prior stands in for poses.  resolution:
    relative singular value that counts as not measured.
    """
    kept, gram, scale = determined(model, state, order, allowed, reference, known, resolution)
    return kept.identification(with_priors(gram, known), scale, model.names.target_names, TOGETHER)


def determined(
    model: Model,
    state: State,
    order: Array,
    allowed: Array,
    reference: Model,
    known: Array,
    resolution: float = RESOLUTION,
) -> tuple[Kept, Array, Array]:
    """What `identify` keeps, its reasons not yet in words; the Gram matrix, and the scale of each.

    Arguments as of `identify`; scale as `Identification.scale`.
    """
    names, gram = model.names, gram_of(model, state)
    scale = np.sqrt(np.diag(gram) / max(int(model.counts.sum()), 1))
    kept = Kept(names, allowed, {}).without(~allowed, Because.FIXED)
    kept = kept.without(kept.active & (scale <= 1e-12), Because.NO_MOTION)
    plain = gram_of(reference, replace(state, effects=np.zeros(0)))
    plain = np.pad(plain, (0, names.count - len(plain)))
    order = doubted_last(order, names, known)
    of_geometry = np.arange(names.count) < names.geometric
    gone = redundant(plain, kept.active & of_geometry, order, RANK_TOLERANCE)
    kept = kept.without([i for i in gone if not known[i]], Because.SAME_MOTION)
    gone = redundant(with_priors(gram, known), kept.active, order, resolution)
    return kept.without(gone, Because.NOT_TOLD), gram, scale


def doubted_last(order: Array, names: Names, known: Array) -> Array:
    """The order with links that have a prior behind the other links.

    A prior tells how far a link may be from its drawing, so that of those that move points alike
    the ones without keep to it.  order: indices.  known: (p,) mask.
    """
    doubted = (known & names.links)[order]
    last = int(np.flatnonzero(names.links[order])[-1]) + 1
    before, after = order[:last], order[last:]
    return np.concatenate([before[~doubted[:last]], before[doubted[:last]], after])


def with_priors(gram: Array, known: Array) -> Array:
    """A Gram matrix where a prior tells a parameter as well as the poses do.  known: (p,) mask."""
    return np.asarray(gram + np.diag(np.where(known, np.diag(gram), 0.0)))


def gram_of(model: Model, state: State) -> Array:
    """The Gram matrix J'WJ of all parameters at a state: (p, p)."""
    every = np.ones(model.names.count, dtype=bool)
    return np.asarray(model.normal(state, every).gram.sum(axis=0))


def generic_count(robot: Robot, reference: Model, order: Array, allowed: Array) -> int:
    """How many of the allowed parameters plenty of poses would determine, for targets anywhere."""
    known = COUNTED.setdefault(robot, {})
    asked = len(reference.y), order.tobytes(), allowed.tobytes()
    if asked not in known:
        spots = np.random.default_rng(0).normal(size=(len(reference.y), 3))
        state = State(robot.mdh, np.eye(3), np.zeros(3), 0.1 * robot.reach() * spots)
        gone = redundant(gram_of(reference, state), allowed, order, RANK_TOLERANCE)
        known[asked] = int(allowed.sum()) - len(gone)
    return known[asked]


# the answers of `generic_count`, and the joints of `plenty_of_poses`: every fit of a robot asks
COUNTED: WeakKeyDictionary[Robot, dict[tuple[int, bytes, bytes], int]] = WeakKeyDictionary()
DRAWN: WeakKeyDictionary[Robot, Array] = WeakKeyDictionary()


def definite(matrix: Array) -> bool:
    """Whether a symmetric matrix has positive eigenvalues alone."""
    try:
        np.linalg.cholesky(matrix)
    except np.linalg.LinAlgError:
        return False
    return True


def redundant(gram: Array, active: Array, order: Array, rank: float) -> list[int]:
    """The parameters to give up so that the Gram matrix of the others has full rank.

    Null vectors of the scaled Jacobian are eliminated one by one: the first parameter in order
    with a clear share in what is left of the null space goes, and takes one null vector along.
    """
    chosen = np.flatnonzero(active)
    if not len(chosen):
        return []
    scale = np.sqrt(np.diag(gram)[chosen])
    scale = np.where(scale > 0.0, scale, 1.0)
    alike = gram[np.ix_(chosen, chosen)] / np.outer(scale, scale)
    if definite(alike - rank**2 * np.trace(alike) * np.eye(len(alike))):
        return []  # no eigenvalue is as small as the rank asks of the largest
    values, vectors = np.linalg.eigh(alike)
    null = vectors[:, values <= (rank**2) * values[-1]]
    gone: list[int] = []
    place = np.full(len(active), -1)
    place[chosen] = np.arange(len(chosen))
    rows = place[order][place[order] >= 0]
    null, waits = null[rows], np.ones(len(rows), dtype=bool)  # in the order of giving up
    for share in (0.05, 1e-3, 0.0):
        at = 0
        while null.shape[1]:
            clear = waits[at:] & (np.einsum("ij,ij->i", null[at:], null[at:]) > share**2)
            if not clear.any():
                break
            at += int(clear.argmax())
            # turn the null space so that one vector alone holds p; drop that vector
            mirror = null[at].copy()
            mirror[0] += math.copysign(math.sqrt(mirror @ mirror), mirror[0])
            turned = (null @ mirror * (2.0 / (mirror @ mirror)))[:, None] * mirror
            null = (null - turned)[:, 1:]
            gone.append(int(chosen[rows[at]]))
            waits[at] = False
    return gone


def plenty_of_poses(robot: Robot, model: Model) -> Model:
    """A model of the same cell at random poses over the joints' whole range."""
    if robot not in DRAWN:
        DRAWN[robot] = robot.turned(anywhere(robot, PLENTY).q)
    k = len(model.y)
    return Model(
        q=DRAWN[robot],
        prismatic=model.prismatic,
        y=np.zeros((k, 3, PLENTY)),
        weight=np.ones((k, PLENTY)),
        names=model.names,
        active=model.active,
        prior=model.prior,
    )
