"""What a field of a dataclass is as an option of a command: unit, default and help in one place."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import MISSING, dataclass, field, fields
from functools import partial, wraps
from inspect import Parameter, signature
from typing import Any, TypeVar

from minimax_cal.core.errors import OptionError

Value = TypeVar("Value")
SI_PER_OPTION_UNIT = {  # what a unit of the command line is
    "": 1.0,
    "m": 1.0,
    "mm": 1e-3,
    "um": 1e-6,
    "um/m": 1e-6,
    "deg": math.pi / 180.0,
    "mrad": 1e-3,
    "urad": 1e-6,
    "urad/Nm": 1e-6,
    "kg": 1.0,
}


@dataclass(frozen=True)
class Option:
    """How people give a field.

    help: a sentence.  unit: of the number that they give, a key of SI.  metavar: what stands for
    the value in the help.  flag: the option's name where it is not the field's.  read: the value
    from a text.  values: how many the option takes.  many: what gathers those of an option that
    may be given several times; without `readers_by_field` they are names, also separated by commas.
    group: under which heading the help lists it.  hidden: whether it does not.
    """

    help: str = ""
    unit: str = ""
    metavar: str = ""
    flag: str = ""
    read: Callable[[str], Any] | None = None
    values: int = 1
    many: Callable[[Iterable[Any]], Any] | None = None
    group: str = ""
    hidden: bool = False


def option_field(default: Any, help: str = "", unit: str = "", **option_settings: Any) -> Any:
    """A field that is an option too.  default: SI, or dict.  help, unit, option_settings: see
    `Option`.
    """
    told = {"option": Option(help, unit, **option_settings)}
    if default is dict:
        return field(default_factory=dict, metadata=told)
    return field(default=default, metadata=told)


def option_field_in_group(help_heading: str) -> Callable[..., Any]:
    """`option_field` under a heading of the help."""
    return partial(option_field, group=help_heading)


# ---- as keywords of a function -----------------------------------------------------------------


def take_option_fields_as_keywords(
    *positional_fields: str,
    readers_by_field: Mapping[str, Callable[[Any], Any]] | None = None,
    **record_types: Any,
) -> Callable[[Callable[..., Value]], Callable[..., Value]]:
    """Make a function take the fields of records of options as keywords of its own.

    record_types: by the argument that gets it, a dataclass, or a pair of it and some fields' names.
    positional_fields: fields that need no keyword.  readers_by_field: what makes a field's value of
    what is given. Signature and docstring say the fields as the dataclass has them.
    """
    readers = readers_by_field or {}
    kinds = {at: one if isinstance(one, tuple) else (one, None) for at, one in record_types.items()}
    chosen = {
        at: [one for one in fields(kind) if names is None or one.name in names]
        for at, (kind, names) in kinds.items()
    }

    def made(verb: Callable[..., Value]) -> Callable[..., Value]:
        own = signature(verb)
        fixed = [one for name, one in own.parameters.items() if name not in kinds]
        more = [
            option_field_to_parameter(one, one.name in positional_fields)
            for at in chosen
            for one in chosen[at]
        ]
        known = own.replace(parameters=sorted([*fixed, *more], key=lambda each: each.kind))

        @wraps(verb)
        def asked(*given: Any, **named: Any) -> Value:
            try:
                bound = known.bind(*given, **named).arguments
            except TypeError as error:
                raise TypeError(f"{verb.__name__}() {error}") from None
            for at, (kind, _) in kinds.items():
                empty = [one.name for one in chosen[at] if one.default is MISSING]
                own = {one.name: bound.pop(one.name) for one in chosen[at] if one.name in bound}
                own = {n: one for n, one in own.items() if not (one is None and n in empty)}
                own = {n: readers[n](one) if n in readers else one for n, one in own.items()}
                bound[at] = kind(**own)
            return verb(**bound)

        asked.__signature__ = known  # type: ignore[attr-defined]
        del asked.__wrapped__  # its source has other arguments, which documentation would read
        for at, (kind, _) in kinds.items():
            asked.__doc__ = insert_field_docs(
                asked.__doc__ or "", at, kind, [one.name for one in chosen[at]]
            )
        return asked

    return made


def option_field_to_parameter(record_field: Any, is_positional: bool) -> Parameter:
    """A field as an argument; a mapping that is empty unless given as None."""
    kind = Parameter.POSITIONAL_OR_KEYWORD if is_positional else Parameter.KEYWORD_ONLY
    default = None if record_field.default is MISSING else record_field.default
    return Parameter(record_field.name, kind, default=default, annotation=record_field.type)


def insert_field_docs(
    docstring: str, parameter_name: str, record_type: Any, field_names: Sequence[str]
) -> str:
    """A docstring with what a record says of its fields in the place of an argument's entry."""
    every = "|".join(one.name for one in fields(record_type))
    said = " ".join((record_type.__doc__ or "").split())
    parts = re.split(rf"(?:^|(?<=\. ))((?:{every})(?:, (?:{every}))*): ", said)
    entries = ""
    for some, words in zip(parts[1::2], map(str.strip, parts[2::2]), strict=True):
        if kept := ", ".join(one for one in some.split(", ") if one in field_names):
            entries += f"    {kept}\n        {words[:1].upper()}{words[1:]}\n"
    return re.sub(rf"    {parameter_name}\n        .*\n", lambda _: entries, docstring)


def split_comma_separated_names(texts: Iterable[str]) -> tuple[str, ...]:
    """Names separated by commas, from an option that may be given several times."""
    return tuple(name.strip() for text in texts for name in text.split(",") if name.strip())


def check_excluded_effects_are_known(
    excluded_names: Iterable[str], known_effects: Collection[str]
) -> None:
    """Raise OptionError for an effect to leave out that nobody knows."""
    for name in excluded_names:
        if name not in known_effects:
            raise OptionError(f"no effect {name!r} to leave out; choose {', '.join(known_effects)}")


def parse_number_or_nan(text: str) -> float:
    """A number, NaN if it is none."""
    try:
        return float(text)
    except ValueError:
        return math.nan


def parse_finite_numbers(
    text: str,
    name: str,
    expected_form: str = "numbers separated by commas",
    required_count: int = 0,
) -> tuple[float, ...]:
    """Numbers separated by commas, so many unless 0.  Raises OptionError with how to give them."""
    parts = tuple(map(parse_number_or_nan, text.split(",")))
    if len(parts) != (required_count or len(parts)) or not all(map(math.isfinite, parts)):
        raise OptionError(f"{name}={text!r}: give {expected_form}")
    return parts


def parse_millimetre_triple_to_metres(text: str, name: str) -> tuple[float, ...]:
    """Three lengths in millimetres, in metres.  Raises OptionError."""
    return tuple(
        1e-3 * part for part in parse_finite_numbers(text, name, "x,y,z in mm, as 3000,0,500", 3)
    )


def parse_low_high_range(text: str, option_name: str, si_per_unit: float) -> tuple[float, float]:
    """LOW:HIGH in SI.  Raises OptionError."""
    parts = [si_per_unit * parse_number_or_nan(part) for part in text.split(":")]
    if len(parts) != 2 or any(map(math.isnan, parts)):
        raise OptionError(f"{option_name}={text!r}: give low:high, as 0.5:20")
    if not parts[0] < parts[1]:
        raise OptionError(f"{option_name}={text!r}: the limits are reversed; give low:high")
    return parts[0], parts[1]


# ---- seeds ---------------------------------------------------------------------------------------


def check_seed(seed: int) -> None:
    """Raise OptionError for a seed that NumPy's generators do not take."""
    if seed < 0:
        raise OptionError(f"seed {seed}: give a whole number, 0 or more")
