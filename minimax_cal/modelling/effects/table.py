"""Every effect that can be fitted and named, and effects by their written form."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from minimax_cal.core.arrays import Array
from minimax_cal.core.errors import OptionError
from minimax_cal.core.files import convert_to_plain_json
from minimax_cal.measuring.session_frames import Frames
from minimax_cal.modelling.effects.axis_wobble import AXIS_WOBBLE
from minimax_cal.modelling.effects.bending import BASE_FLEX, LINK_BENDING, TOOL_FLEX
from minimax_cal.modelling.effects.compliance import (
    CROSS_COMPLIANCE,
    GRAVITY_COMPENSATOR,
    JOINT_COMPLIANCE,
)
from minimax_cal.modelling.effects.gears import (
    BACKLASH,
    ENCODER_GAIN,
    GEAR_ERROR,
    GEAR_RIPPLE,
    JOINT_COUPLING,
    SETTLING,
)
from minimax_cal.modelling.effects.joint_error_maps import JOINT_ERROR_MAP
from minimax_cal.modelling.effects.scene import (
    EFFECT_DRIVERS,
    MOVED_PARTS,
    Choice,
    Effect,
    EffectColumns,
    PosedArm,
)
from minimax_cal.modelling.effects.sudden_changes import ENCODER_ZERO
from minimax_cal.modelling.effects.time_effects import (
    FRAME_DRIFT,
    SESSION_JUMP,
    TARGET_OFFSET,
    TARGET_RESEAT,
    TARGET_SHIFT,
    THERMAL_GROWTH,
)
from minimax_cal.robots import kinematics

EFFECTS: dict[str, Effect] = {
    effect.name: effect
    for effect in (
        JOINT_COMPLIANCE,
        CROSS_COMPLIANCE,
        GRAVITY_COMPENSATOR,
        LINK_BENDING,
        BASE_FLEX,
        TOOL_FLEX,
        GEAR_ERROR,
        GEAR_RIPPLE,
        ENCODER_GAIN,
        JOINT_ERROR_MAP,
        JOINT_COUPLING,
        AXIS_WOBBLE,
        BACKLASH,
        SETTLING,
        ENCODER_ZERO,
        THERMAL_GROWTH,
        FRAME_DRIFT,
        SESSION_JUMP,
        TARGET_SHIFT,
        TARGET_RESEAT,
        TARGET_OFFSET,
    )
}


def register(effect: Effect) -> Effect:
    """Add an effect of one's own to the library of this process.

    Parameters
    ----------
    effect
        Its law gives metres and radians per unit of each parameter.

    Returns
    -------
    Effect
        The same effect.

    Raises
    ------
    OptionError
        For facts that are none.

    Examples
    --------
    >>> mc.register(effect)
    """
    for fact, known in (("moves", MOVED_PARTS), ("follows", EFFECT_DRIVERS)):
        if getattr(effect, fact) not in known:
            told = ", ".join(filter(None, known))
            raise OptionError(
                f"effect {effect.name}: {fact} {getattr(effect, fact)!r}; choose {told}"
            )
    EFFECTS[effect.name] = effect
    return effect


def check_effect_columns(label: str, columns: object, posed_arm: PosedArm) -> None:
    """Raise OptionError for a law that gives no `EffectColumns`, or of another shape than the
    scene's.
    """
    if not isinstance(columns, EffectColumns):
        raise OptionError(
            f"effect {label}: its law returned {type(columns).__name__}; give Columns"
        )
    count = len(columns.names)
    wanted = {
        "turn": (count, posed_arm.joints, posed_arm.poses),
        "shift": (count, posed_arm.targets, 3, posed_arm.poses),
    }
    for name, shape in wanted.items():
        part = np.shape(getattr(columns, name))
        if 0 not in part and part != shape:
            raise OptionError(f"effect {label}: {name} has the shape {part}; give {shape}")


@dataclass(frozen=True, eq=False)
class Term:
    """An effect at a place, one variant of its law chosen."""

    effect: str
    place: str
    choice: Choice = field(default_factory=dict)

    @property
    def label(self) -> str:
        """As joint_compliance:J2."""
        return f"{self.effect}:{self.place}"

    @property
    def key(self) -> tuple[str, str]:
        """Effect and place."""
        return self.effect, self.place

    @property
    def budget_step_name(self) -> str:
        """Its step of an error budget, as + joint_compliance J2."""
        return f"+ {self.effect} {self.place}"

    @property
    def frees_session_frames(self) -> bool:
        """Whether it is that of `session_frame_terms`, which says nothing of the robot."""
        return "sessions" in self.choice

    @property
    def ends_with_session(self) -> bool:
        """Whether it holds for the session of the measurements alone: its clock, nests, frames."""
        return EFFECTS[self.effect].ends_with_session or self.follows_clock

    @property
    def follows_clock(self) -> bool:
        """Whether it follows the time, and not the temperature or the sessions."""
        told = "temperature" in self.choice or "session" in self.choice or self.frees_session_frames
        return EFFECTS[self.effect].follows == "time" and not told

    @property
    def text(self) -> str:
        """As gear_error:J2:turns=2.0, with the whole choice."""
        return ":".join([self.label, *(f"{k}={float(v)!r}" for k, v in self.choice.items())])

    def columns(self, posed_arm: PosedArm) -> EffectColumns:
        """How points move per unit of its parameters."""
        text = self.text
        if text not in posed_arm.column_cache:
            if (
                len(posed_arm.column_cache) >= MAX_CACHED_LAWS
            ):  # a search looks at thousands, each a few times in a row
                del posed_arm.column_cache[next(iter(posed_arm.column_cache))]
            found = EFFECTS[self.effect].columns(posed_arm, self.place, self.choice)
            check_effect_columns(self.label, found, posed_arm)
            posed_arm.column_cache[text] = found
        return posed_arm.column_cache[text]


def session_frame_terms(session_frames: Frames) -> tuple[Term, ...]:
    """What frees the frames of all sessions but the first, where there are several."""
    if len(session_frames) < 2:
        return ()
    return (Term(SESSION_JUMP.name, "frame", {"sessions": float(len(session_frames))}),)


class ParsedEffect(NamedTuple):
    """An effect's name, its place ("" where the text has none), and the choice of its law."""

    effect: str
    place: str
    choice: dict[str, float]


def parse_effect_text(effect_text: str) -> ParsedEffect:
    """Parse ``effect:place`` or ``effect:place:turns=17``.  Raises OptionError."""
    name, _, rest = effect_text.strip().partition(":")
    place, _, more = rest.partition(":")
    choice: dict[str, float] = {}
    for part in filter(None, more.split(":")):
        key, equals, value = part.partition("=")
        try:
            choice[key] = float(value)
        except ValueError:
            equals = ""
        if not equals:
            raise OptionError(
                f"effect {effect_text!r}: write {part!r} as a name and number, turns=17"
            )
    if name not in EFFECTS:
        raise OptionError(f"no effect {name!r}; choose {', '.join(EFFECTS)}")
    return ParsedEffect(name, place, choice)


ChooseVariant = Callable[
    [Sequence[Term], Sequence[Term]], Term
]  # one of several, beside those chosen


def parse_effect_terms(
    posed_arm: PosedArm,
    effect_texts: Sequence[str | Term],
    choose_variant: ChooseVariant = lambda chosen, several: several[0],
) -> tuple[Term, ...]:
    """The effects that texts name.

    A text without a place means `all`, or the only place there is.  choose_variant: chooses among
    the variants of a law that a text leaves open.  Raises OptionError.
    """
    out: list[Term] = []
    for text in effect_texts:
        if isinstance(text, Term):
            out.append(text)
            continue
        name, place, given = parse_effect_text(text)
        effect = EFFECTS[name]
        if missing := effect.needs(posed_arm):
            raise OptionError(f"effect {name}: {posed_arm.data.source} lacks {missing}")
        places = tuple(effect.places(posed_arm))
        if not place:
            place = "all" if "all" in places or len(places) != 1 else places[0]
        if place not in places:
            here = ", ".join(places) or "none with these data"
            raise OptionError(f"effect {name}: no place {place!r}; choose {here}")
        choices = effect.choices(posed_arm, place)
        if given:  # what a diagnosis writes may be the whole of what it found
            choices = [*choices, *(one for c in choices for one in effect.entire([c], ()))]
        choices = select_open_variants(text, choices, given)
        several = [Term(name, place, choice) for choice in choices]
        try:
            term = choose_variant(out, several) if len(several) > 1 else several[0]
            term.columns(posed_arm)
        except KeyError as error:
            key = str(error.args[0])
            raise OptionError(
                f"effect {text!r}: these data suggest no {key}; write {name}:{place}:{key}=NUMBER"
            ) from error
        out.append(term)
    return tuple(out)


MAX_CACHED_LAWS = 300  # whose columns a scene keeps
POSITIVE_CHOICE_KEYS = frozenset(
    {"constant", "fast", "slow", "within"}
)  # above 0; infinite is straight
FREE_CHOICE_KEYS = frozenset({  # any number will do
    "turns", "constant", "fast", "slow", "within", "since", "zero", "eye", "rest",
    "low", "high", "length", "size",
})  # fmt: skip


def select_open_variants(
    effect_text: str, choices: Sequence[Choice], given_choice: Choice
) -> tuple[Choice, ...]:
    """The variants that a text leaves open.  Raises OptionError for one its law does not have."""
    known = {key for choice in choices for key in choice}
    for key, value in given_choice.items():
        if key not in known and (choices or key not in FREE_CHOICE_KEYS):
            said = f"choose {', '.join(sorted(known))}" if known else "its law has no such number"
            raise OptionError(f"effect {effect_text!r}: no choice {key!r}; {said}")
        listed = sorted({choice[key] for choice in choices if key in choice})
        if key in known - FREE_CHOICE_KEYS and value not in listed:
            offer = ", ".join(f"{number:g}" for number in listed)
            raise OptionError(f"effect {effect_text!r}: no {key} {value:g}; choose {offer}")
        low = 0.0 if key in POSITIVE_CHOICE_KEYS else -np.inf
        if not (value > low and (np.isfinite(value) or key in POSITIVE_CHOICE_KEYS)):
            raise OptionError(f"effect {effect_text!r}: {key} {value:g} is not possible")
    fixed = (
        given_choice.keys() - FREE_CHOICE_KEYS
    )  # what one variant has does not go with another's
    fitting = (
        [
            c
            for c in choices
            if given_choice.keys() <= c.keys() and all(c[key] == given_choice[key] for key in fixed)
        ]
        if choices
        else [{}]
    )
    if given_choice:
        fitting = [c for c in fitting if c.keys() == given_choice.keys()] or fitting
    if not fitting:
        raise OptionError(f"effect {effect_text!r}: no variant has {' and '.join(given_choice)}")
    asked = [tuple(sorted({**choice, **given_choice}.items())) for choice in fitting]
    return tuple(dict(one) for one in dict.fromkeys(asked))


@dataclass(frozen=True, eq=False)
class Fitted:
    """Effects with the values of their parameters: what a calibrated cell predicts with.

    values: d for each term, in the order of its columns.
    """

    terms: tuple[Term, ...]
    values: tuple[Array, ...]

    @staticmethod
    def from_pairs(terms_with_values: Iterable[tuple[Term, Array]]) -> Fitted:
        """Terms, each with its values."""
        listed = tuple(terms_with_values)
        return Fitted(tuple(term for term, _ in listed), tuple(value for _, value in listed))

    @property
    def terms_with_values(self) -> tuple[tuple[Term, Array], ...]:
        """Each term with its values."""
        return tuple(zip(self.terms, self.values, strict=True))

    def select_terms(self, is_kept: Callable[[Term], bool]) -> Fitted:
        """Some of the terms, with their values."""
        return Fitted.from_pairs(
            (term, value) for term, value in self.terms_with_values if is_kept(term)
        )

    @property
    def cause_terms(self) -> tuple[Term, ...]:
        """The terms that say something of the arm: all but the frames of several sessions."""
        return tuple(term for term in self.terms if not term.frees_session_frames)

    def joint_shifts(self, posed_arm: PosedArm) -> Array:
        """(m, n) by how much the joints turn, signs applied [rad, m]."""
        out = np.zeros((posed_arm.joints, posed_arm.poses))
        for term, value in self.terms_with_values:
            columns = term.columns(posed_arm)
            if columns.turn.size:
                out += np.einsum("d,dnm->nm", value, columns.turn)
        return out.T

    def target_shifts(self, posed_arm: PosedArm) -> Array:
        """(k, 3, m) by how much the targets move besides, in base axes [m]."""
        out = np.zeros(posed_arm.points.shape)
        for term, value in self.terms_with_values:
            columns = term.columns(posed_arm)
            if columns.shift.size:
                out += np.einsum("d,dkcm->kcm", value, columns.shift)
        return out

    def displaced_targets(self, posed_arm: PosedArm) -> Array:
        """(k, 3, m) the targets in the base frame with all effects, whatever their size [m]."""
        if not self.terms:
            return posed_arm.points
        links = kinematics.compute_link_frames(
            posed_arm.robot.mdh,
            posed_arm.angles.T + self.joint_shifts(posed_arm),
            posed_arm.robot.prismatic,
        )
        return kinematics.targets_in_base(links, posed_arm.target_positions) + self.target_shifts(
            posed_arm
        )

    def to_list(self) -> list[dict[str, object]]:
        """For JSON, in SI; an infinite time constant is null."""
        return [
            convert_to_plain_json(
                {"effect": t.effect, "place": t.place, "choice": t.choice, "values": value}
            )
            for t, value in self.terms_with_values
        ]


NO_EFFECTS = Fitted((), ())


def fitted_effects_from_list(content: Sequence[Mapping[str, Any]]) -> Fitted:
    """Effects from the JSON of a calibration.  Raises KeyError, TypeError, ValueError."""
    pairs = []
    for entry in content:
        name = str(entry["effect"])
        if name not in EFFECTS:
            raise ValueError(f"effect {name!r} is not known here")
        choice = {str(k): float("inf") if v is None else float(v)
                  for k, v in entry["choice"].items()}  # fmt: skip
        term = Term(name, str(entry["place"]), choice)
        pairs.append((term, np.array(entry["values"], dtype=float).reshape(-1)))
    return Fitted.from_pairs(pairs)


def effect_parameter_names_and_units(
    terms: Sequence[Term], posed_arm: PosedArm
) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Names, as joint_compliance:J2.c2 or of one of several lines gear_ripple:J4.cos 17/turn, and
    units of all parameters.
    """
    names: list[str] = []
    units: list[str] = []
    labels = [term.label for term in terms]
    for term in terms:
        columns = term.columns(posed_arm)
        own = (
            append_wave_count_to_names(columns.names, term)
            if labels.count(term.label) > 1
            else columns.names
        )
        names += [f"{term.label}.{name}" for name in own]
        units += columns.units
    return tuple(names), tuple(units)


def append_wave_count_to_names(names: Sequence[str], term: Term) -> tuple[str, ...]:
    """Parameters of one of several lines of a gear, called by its waves a turn."""
    turns = f" {term.choice['turns']:.4g}/turn" if "turns" in term.choice else ""
    return tuple(f"{name}{turns}" for name in names)


def effect_displacement_fields(terms: Sequence[Term], posed_arm: PosedArm) -> Array:
    """(e, k, 3, m) motion of the points in base axes per unit of each parameter."""
    return np.concatenate(
        [term.columns(posed_arm).target_displacements(posed_arm) for term in terms]
    )


def effect_prior_weights(terms: Sequence[Term], posed_arm: PosedArm) -> Array:
    """(e,) weights of the priors of all parameters, 0 where there is none [m^2 per unit^2]."""
    parts = [np.zeros(0)]
    for term in terms:
        columns = term.columns(posed_arm)
        parts.append(columns.ridge if len(columns.ridge) else np.zeros(len(columns.names)))
    return np.concatenate(parts)


# ---- bounds --------------------------------------------------------------------------------------


RELATIVE_BOUND_ROUNDING = 1e-9  # of a parameter's largest value
MAX_EFFECT_MOTION_PER_REACH = 0.02  # of the reach: no effect of a body moves a point farther


def effect_parameter_bounds(posed_arm: PosedArm, terms: Sequence[Term]) -> Array:
    """(e, 2) between which the parameters of effects must lie: of compliances not below 0."""
    out = [np.zeros((0, 2))]
    for term in terms:
        columns = term.columns(posed_arm)
        if len(columns.ridge):  # a prior holds them
            out.append(np.full((len(columns.names), 2), np.inf) * [-1.0, 1.0])
            continue
        fields = columns.target_displacements(posed_arm)
        size = np.sqrt((fields**2).sum(axis=2)).max(axis=(1, 2))
        most = MAX_EFFECT_MOTION_PER_REACH * posed_arm.robot.reach() / np.maximum(size, 1e-300)
        least = np.where(EFFECTS[term.effect].nonnegative_mask(columns), 0.0, -most)
        out.append(np.stack([least, most], axis=1))
    return np.concatenate(out)


def at_bound_mask(values: Array, bounds: Array) -> Array:
    """(e,) True for parameters that lie at one of their bounds (e, 2), but for rounding."""
    return np.asarray(near_lower_upper_bound_mask(values, bounds).any(axis=1))


def snap_to_near_bounds(values: Array, bounds: Array) -> Array:
    """(e,) the values, those at one of their bounds (e, 2) exactly there."""
    near = near_lower_upper_bound_mask(values, bounds)
    return np.where(near[:, 0], bounds[:, 0], np.where(near[:, 1], bounds[:, 1], values))


def near_lower_upper_bound_mask(values: Array, bounds: Array) -> Array:
    """(e, 2) which of its bounds each parameter is at, or beyond."""
    most = np.abs(bounds).max(axis=1, keepdims=True)
    near = RELATIVE_BOUND_ROUNDING * np.where(np.isfinite(most), most, 0.0)
    return np.asarray((values[:, None] - bounds) * [1.0, -1.0] <= near)
