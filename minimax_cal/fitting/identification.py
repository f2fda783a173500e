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

from minimax_cal.core.arrays import Array
from minimax_cal.core.display_text import format_first_names
from minimax_cal.instruments.instrument import RANDOM_POSE_COUNT, build_random_poses
from minimax_cal.modelling.parameters import ParameterNames, ParameterValues
from minimax_cal.modelling.point_model import PointModel
from minimax_cal.robots import kinematics
from minimax_cal.robots.robot import Robot
from minimax_cal.solvers.least_squares import solve_normal_equations

MAX_PARALLEL_SINE = np.sin(np.radians(5.0))  # neighbouring axes closer than this count as parallel
# Singular values of the column-scaled Jacobian, relative to the largest: below RANK a direction is
# redundant whatever the poses; below RESOLUTION these poses show it a thousand times weaker than
# others, and its estimate would be noise (a target 0.1 mm off the last axis "measures" the wrist).
MIN_RANK_RATIO = 1e-6
DEFAULT_RESOLUTION = 1e-3
MAX_NAMED_PARAMETERS = 4  # names in a reason
ALL_TARGETS_TEXT = "all targets moved together"


class ReasonKind(StrEnum):
    """Why a parameter keeps its nominal value, as files call it."""

    FIXED = "fixed"
    NO_MOTION = "no_motion"
    SAME_MOTION = "same_motion"
    NOT_TOLD = "not_determined"
    NO_SCALE = "no_scale"
    OTHER = "other"


REASON_TEXTS = {  # {} for the parameters that move the points alike
    ReasonKind.FIXED: "fixed by the user",
    ReasonKind.NO_MOTION: "moves no measured point",
    ReasonKind.SAME_MOTION: "same motion as {}",
    ReasonKind.NOT_TOLD: "these poses do not tell it from {}",
}
REASONS_BY_OTHER_PARAMETERS = (ReasonKind.SAME_MOTION, ReasonKind.NOT_TOLD)


@dataclass(frozen=True)
class NotIdentifiedReason:
    """Why a parameter keeps its nominal value.

    like: the identified parameters that together move the points as it does, the largest first.
    """

    text: str
    kind: ReasonKind = ReasonKind.OTHER
    like: tuple[str, ...] = ()


def describe_reason(kind: ReasonKind, similar_parameters: Sequence[str]) -> str:
    """A reason of BY_OTHERS in words."""
    return REASON_TEXTS[kind].format(format_first_names(similar_parameters, MAX_NAMED_PARAMETERS))


@dataclass(frozen=True, eq=False)
class Identification:
    """active: (p,) True where a parameter is identified.

    reasons: why each other parameter keeps its nominal value, by name.
    singular: singular values of the scaled Jacobian of the kept parameters, largest first.
    scale: (p,) root mean square motion of a point per unit of each parameter [m per unit].
    """

    active: Array
    reasons: Mapping[str, NotIdentifiedReason]
    singular: Array
    scale: Array

    @property
    def condition(self) -> float:
        """Condition number of the scaled Jacobian of the kept parameters (1/O2 of the field)."""
        return float(self.singular[0] / self.singular[-1])

    def is_not_fixed(self, names: Sequence[str]) -> Array:
        """(p,) True but for names that the user fixed."""
        return np.array(
            [
                self.reasons.get(name, NotIdentifiedReason("")).kind is not ReasonKind.FIXED
                for name in names
            ]
        )


@dataclass(frozen=True, eq=False)
class KeptParameters:
    """What is left while parameters are given up.

    active: (p,) True where a parameter is kept.  reasons: why others are not, by name; those of
    BY_OTHERS do not say yet by which.
    """

    names: ParameterNames
    active: Array
    reasons: Mapping[str, NotIdentifiedReason]

    def drop_parameters(
        self, gone: Array | list[int], kind: ReasonKind, text: str = ""
    ) -> KeptParameters:
        """Fewer.  gone: (p,) mask, or indices.  text: of the reason, WORDS unless given."""
        active, reason = self.active.copy(), NotIdentifiedReason(text or REASON_TEXTS[kind], kind)
        active[gone] = False
        lost = np.arange(len(active))[gone]
        named = dict.fromkeys((self.names.all_names[i] for i in lost), reason)
        return KeptParameters(self.names, active, {**self.reasons, **named})

    def build_identification(
        self, gram: Array, scale: Array, stems: Iterable[str], whole: str
    ) -> Identification:
        """The reasons written out, and the singular values.

        gram: (p, p).  scale: (p,), see `Identification`.  stems: points as smr1, of which several
        are one thing to the reader, called `whole`.
        """
        reasons, active = dict(self.reasons), self.active
        lost = [
            name for name, reason in reasons.items() if reason.kind in REASONS_BY_OTHER_PARAMETERS
        ]
        place = np.array([self.names.index_of_name(name) for name in lost], dtype=int)
        mixes = solve_normal_equations(gram[np.ix_(active, active)], gram[active][:, place])
        for name, i, mix in zip(lost, place, mixes.T, strict=True):
            like = self.find_similar_parameters(
                np.abs(mix) * scale[active] / scale[i], stems, whole
            )
            kind = reasons[name].kind
            reasons[name] = NotIdentifiedReason(describe_reason(kind, like), kind, like)
        scaled = gram[np.ix_(active, active)] / np.outer(scale[active], scale[active])
        singular = np.sqrt(np.maximum(np.linalg.eigvalsh(scaled)[::-1], 0.0))
        return Identification(active, reasons, singular, scale)

    def find_similar_parameters(
        self, share: Array, stems: Iterable[str], whole: str
    ) -> tuple[str, ...]:
        """The kept parameters that together move the points as one does, largest first.

        share: (kept,) of the motion.
        """
        names, chosen = self.names.all_names, np.flatnonzero(self.active)
        clear = chosen[np.argsort(-share)[: np.count_nonzero(share > 0.1 * share.max(initial=0.0))]]
        shown = [names[i] for i in clear]
        spots = [name for name in shown if name.rsplit("_", 1)[0] in stems]
        if len({name.rsplit("_", 1)[0] for name in spots}) > 1:
            shown = [name for name in shown if name not in spots] + [whole]
        return tuple(shown)


def redundancy_drop_order(robot: Robot, names: ParameterNames) -> Array:
    """Parameters in the order in which redundant ones are given up.

    First beta where the next axis is not parallel and d where it is (Hayati: a common normal of
    parallel axes is nowhere), then what repeats the base (d1, theta1) and the tool (the last
    link), then other link parameters from the wrist to the base, the base, and targets last.
    """
    n = robot.joints
    links = np.arange(5 * n).reshape(5, n)
    alpha, beta = robot.mdh[:, kinematics.ALPHA], robot.mdh[:, kinematics.BETA]
    parallel = np.hypot(np.sin(alpha), np.sin(beta)) < MAX_PARALLEL_SINE
    parallel[-1] = False
    a, d, theta, _, b = links
    first = [*b[~parallel], *d[parallel], d[0], theta[0], *links[[1, 2, 3, 0], -1]]
    rest = [*theta[::-1], *d[::-1], *a[::-1], *links[3][::-1], *b[parallel]]
    order = [*first, *rest, *range(5 * n, names.geometric_count)]
    return np.array(list(dict.fromkeys(int(i) for i in order)))


def select_length_to_keep(robot: Robot, allowed: Array, is_preferred: Array) -> list[int]:
    """The link length to keep as drawn where nothing tells the scale: the longest.

    An error of the drawing is then the smallest part of it.  allowed, is_preferred: (p,) what may
    be fitted, and what the user wants fitted.
    """
    lengths = np.abs(robot.mdh[:, :2].T.reshape(-1))
    chosen = np.flatnonzero(allowed[: len(lengths)])
    preferred = [i for i in chosen if not is_preferred[i]] or list(chosen)
    return [int(max(preferred, key=lambda i: lengths[i]))] if preferred else []


def identify_point_parameters(
    model: PointModel,
    state: ParameterValues,
    drop_order: Array,
    *,
    is_allowed: Array,
    reference_model: PointModel,
    has_prior: Array,
    resolution: float = DEFAULT_RESOLUTION,
) -> Identification:
    """The largest set of allowed parameters that the poses of the model determine.

    drop_order: the parameters, those to give up first at the front.  is_allowed: (p,) False for
    parameters the user fixed.  reference_model: a model with plenty of poses, to tell what no pose
    could show from what these poses do not.  has_prior: (p,) True where a prior stands in for
    poses.  resolution: relative singular value that counts as not measured.
    """
    kept, gram, scale = select_determined_parameters(
        model, state, drop_order, is_allowed, reference_model, has_prior, resolution
    )
    return kept.build_identification(
        gram_with_priors(gram, has_prior), scale, model.names.target_names, ALL_TARGETS_TEXT
    )


def select_determined_parameters(
    model: PointModel,
    state: ParameterValues,
    drop_order: Array,
    is_allowed: Array,
    reference_model: PointModel,
    has_prior: Array,
    resolution: float = DEFAULT_RESOLUTION,
) -> tuple[KeptParameters, Array, Array]:
    """What `identify_point_parameters` keeps, its reasons not yet in words; the Gram matrix, and
    the scale of each.

    Arguments as of `identify_point_parameters`; scale as `Identification.scale`.
    """
    names, gram = model.names, full_gram_matrix(model, state)
    scale = np.sqrt(np.diag(gram) / max(int(model.pose_counts_by_target.sum()), 1))
    kept = KeptParameters(names, is_allowed, {}).drop_parameters(~is_allowed, ReasonKind.FIXED)
    kept = kept.drop_parameters(kept.active & (scale <= 1e-12), ReasonKind.NO_MOTION)
    plain = full_gram_matrix(reference_model, replace(state, effects=np.zeros(0)))
    plain = np.pad(plain, (0, names.parameter_count - len(plain)))
    drop_order = order_prior_links_last(drop_order, names, has_prior)
    of_geometry = np.arange(names.parameter_count) < names.geometric_count
    gone = select_redundant_parameters(plain, kept.active & of_geometry, drop_order, MIN_RANK_RATIO)
    kept = kept.drop_parameters([i for i in gone if not has_prior[i]], ReasonKind.SAME_MOTION)
    gone = select_redundant_parameters(
        gram_with_priors(gram, has_prior), kept.active, drop_order, resolution
    )
    return kept.drop_parameters(gone, ReasonKind.NOT_TOLD), gram, scale


def order_prior_links_last(drop_order: Array, names: ParameterNames, has_prior: Array) -> Array:
    """The order with links that have a prior behind the other links.

    A prior tells how far a link may be from its drawing, so that of those that move points alike
    the ones without keep to it.  drop_order: indices.  has_prior: (p,) mask.
    """
    doubted = (has_prior & names.link_mask)[drop_order]
    last = int(np.flatnonzero(names.link_mask[drop_order])[-1]) + 1
    before, after = drop_order[:last], drop_order[last:]
    return np.concatenate([before[~doubted[:last]], before[doubted[:last]], after])


def gram_with_priors(gram: Array, has_prior: Array) -> Array:
    """A Gram matrix where a prior tells a parameter as well as the poses do.  has_prior: (p,)
    mask.
    """
    return np.asarray(gram + np.diag(np.where(has_prior, np.diag(gram), 0.0)))


def full_gram_matrix(model: PointModel, state: ParameterValues) -> Array:
    """The Gram matrix J'WJ of all parameters at a state: (p, p)."""
    every = np.ones(model.names.parameter_count, dtype=bool)
    return np.asarray(model.normal_equations(state, every).gram.sum(axis=0))


def count_generic_parameters(
    robot: Robot, reference_model: PointModel, drop_order: Array, is_allowed: Array
) -> int:
    """How many of the allowed parameters plenty of poses would determine, for targets anywhere."""
    known = GENERIC_COUNT_CACHE.setdefault(robot, {})
    asked = len(reference_model.y), drop_order.tobytes(), is_allowed.tobytes()
    if asked not in known:
        spots = np.random.default_rng(0).normal(size=(len(reference_model.y), 3))
        state = ParameterValues(robot.mdh, np.eye(3), np.zeros(3), 0.1 * robot.reach() * spots)
        gone = select_redundant_parameters(
            full_gram_matrix(reference_model, state), is_allowed, drop_order, MIN_RANK_RATIO
        )
        known[asked] = int(is_allowed.sum()) - len(gone)
    return known[asked]


# the answers of `count_generic_parameters`, and the joints of `build_reference_model`: every fit of
# a robot asks
GENERIC_COUNT_CACHE: WeakKeyDictionary[Robot, dict[tuple[int, bytes, bytes], int]] = (
    WeakKeyDictionary()
)
REFERENCE_JOINTS_CACHE: WeakKeyDictionary[Robot, Array] = WeakKeyDictionary()


def is_positive_definite(matrix: Array) -> bool:
    """Whether a symmetric matrix has positive eigenvalues alone."""
    try:
        np.linalg.cholesky(matrix)
    except np.linalg.LinAlgError:
        return False
    return True


def select_redundant_parameters(
    gram: Array, is_active: Array, drop_order: Array, min_rank_ratio: float
) -> list[int]:
    """The parameters to give up so that the Gram matrix of the others has full rank.

    Null vectors of the scaled Jacobian are eliminated one by one: the first parameter in order
    with a clear share in what is left of the null space goes, and takes one null vector along.
    """
    chosen = np.flatnonzero(is_active)
    if not len(chosen):
        return []
    scale = np.sqrt(np.diag(gram)[chosen])
    scale = np.where(scale > 0.0, scale, 1.0)
    alike = gram[np.ix_(chosen, chosen)] / np.outer(scale, scale)
    if is_positive_definite(alike - min_rank_ratio**2 * np.trace(alike) * np.eye(len(alike))):
        return []  # no eigenvalue is as small as the rank asks of the largest
    values, vectors = np.linalg.eigh(alike)
    null = vectors[:, values <= (min_rank_ratio**2) * values[-1]]
    gone: list[int] = []
    place = np.full(len(is_active), -1)
    place[chosen] = np.arange(len(chosen))
    rows = place[drop_order][place[drop_order] >= 0]
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


def build_reference_model(robot: Robot, model: PointModel) -> PointModel:
    """A model of the same cell at random poses over the joints' whole range."""
    if robot not in REFERENCE_JOINTS_CACHE:
        REFERENCE_JOINTS_CACHE[robot] = robot.chain_joint_values(
            build_random_poses(robot, RANDOM_POSE_COUNT).q
        )
    k = len(model.y)
    return PointModel(
        q=REFERENCE_JOINTS_CACHE[robot],
        prismatic=model.prismatic,
        y=np.zeros((k, 3, RANDOM_POSE_COUNT)),
        weight=np.ones((k, RANDOM_POSE_COUNT)),
        names=model.names,
        active=model.active,
        prior=model.prior,
    )
