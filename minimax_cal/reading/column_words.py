"""What names of columns and units mean: English, German, French, Spanish and Chinese."""

from __future__ import annotations

import difflib
import re
import unicodedata
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

JOINT_COLUMN_UNITS = ("rad", "deg", "mm", "m")
LENGTH_COLUMN_UNITS = ("mm", "m")


@dataclass(frozen=True)
class ColumnKind:
    """What this project calls columns of one kind, without the unit, and the units they may have.

    The first is the one that is written.  text: whether cells are labels, never computed with.
    """

    stem: str
    units: tuple[str, ...] = ()
    text: bool = False

    @property
    def full_name_pattern(self) -> str:
        """Of the whole name, its last group the unit."""
        return f"{self.stem}_({'|'.join(self.units)})" if self.units else self.stem


STANDARD_COLUMN_KINDS = {  # columns of measurements, by kind
    "q": ColumnKind(r"q(\d+)", JOINT_COLUMN_UNITS),
    "smr": ColumnKind(r"smr(\d+)_([xyz])", LENGTH_COLUMN_UNITS),
    "order": ColumnKind("order"),
    "time": ColumnKind("time", ("s",)),
    "temperature": ColumnKind("temperature", ("C",)),
    "payload": ColumnKind("payload", ("kg",)),
    "payload centre": ColumnKind("payload_[xyz]", LENGTH_COLUMN_UNITS),
    "tool": ColumnKind("tool", text=True),
    "tau": ColumnKind(r"tau\d+", ("Nm",)),
    "approach": ColumnKind(r"approach\d+"),
    "session": ColumnKind("session", text=True),
    "group": ColumnKind("group", text=True),
    "u95": ColumnKind("u95", LENGTH_COLUMN_UNITS),
    "pose": ColumnKind("pose", text=True),
    "split": ColumnKind("split", text=True),
    "set_aside": ColumnKind("set_aside", text=True),
    "simulated": ColumnKind("simulated"),
    "qread": ColumnKind(r"qread\d+", JOINT_COLUMN_UNITS),
    "base": ColumnKind(r"base\d+_[xyz]", LENGTH_COLUMN_UNITS),
}
RADIANS_PER_ANGLE_UNIT = {"rad": 1.0, "deg": np.pi / 180.0, "mrad": 1e-3}
METRES_PER_LENGTH_UNIT = {"mm": 1e-3, "m": 1.0, "um": 1e-6, "cm": 1e-2, "in": 0.0254}
COLUMN_SECONDS_PER_TIME_UNIT = {"s": 1.0, "ms": 1e-3, "min": 60.0, "h": 3600.0}
TEMPERATURE_UNITS = ("C", "K", "F")
OTHER_UNITS = ("kg", "Nm", "px")
UNIT_ALIASES = {"°": "deg", "º": "deg", "µm": "um", "μm": "um", "inch": "in", "°C": "C", "°F": "F"}
UNIT_ALIASES |= dict.fromkeys(("Grad", "grad", "grados", "degr\u00e9s", "\u5ea6"), "deg")
UNIT_ALIASES |= {"\u5f27\u5ea6": "rad", "\u6beb\u7c73": "mm", "\u7c73": "m", "\u79d2": "s"}
UNIT_ALIASES |= dict.fromkeys(("sec", "Sek", "sek", "Sekunden", "segundos", "secondes"), "s")
UNIT_ALIASES |= {"degC": "C", "degF": "F", "degree": "deg", "degrees": "deg", "radians": "rad"}
UNIT_ALIASES |= dict.fromkeys(
    ("MM", "millimeters", "Millimeter", "millim\u00e8tres", "mil\u00edmetros"), "mm"
)
UNIT_ALIASES |= dict.fromkeys(("IN", "inches"), "in")
KNOWN_UNITS = {
    *RADIANS_PER_ANGLE_UNIT,
    *METRES_PER_LENGTH_UNIT,
    *COLUMN_SECONDS_PER_TIME_UNIT,
    *TEMPERATURE_UNITS,
    *OTHER_UNITS,
}
JOINT_WORDS_REGEX = (
    "q|j|a|\u03b8|ax|axis|joint|theta|achse|achswert|gelenk|axe|articulation|eje|articulacion"
    "|\u5173\u8282|\u8f74"
)
NUMBERED_JOINT_PATTERNS = (  # of folded names
    f"(?:(?:robot(?:er)?|arm|ist|actual)[ _.-])?(?:{JOINT_WORDS_REGEX})[ _.-]?(?P<joint>\\d+)"
    "(?:[ _.-]?(?:angle|winkel|ist|actual|position|pos|wert|value|angulo|\u89d2\u5ea6|\u89d2))?",
    "\u7b2c?(?P<joint>\\d+)(?:\u8f74|\u5173\u8282)(?:\u89d2\u5ea6|\u89d2)?",
)
QUATERNION_NAME_PATTERN = re.compile(r"q\d+")
# joints along the arm, where the names tell: a ROS log may sort them by alphabet
UR_JOINT_NAMES = ("shoulder_pan", "shoulder_lift", "elbow", "wrist_1", "wrist_2", "wrist_3")
YASKAWA_JOINT_LETTERS = (tuple("slurbt"), tuple("sleurbt"))
MEASURED_WORDS_REGEX = (
    "ist|istwert|actual|act|meas|measured|mess|messwert|mesure|medido|\u5b9e\u6d4b|\u6d4b\u91cf"
)
POSITION_WORDS_REGEX = (
    "pos|position|koordinate|coordinate|coord|coordonnee|coordenada|wert|value|valeur|valor"
    "|\u5750\u6807|\u503c"
)
AXIS_SUFFIX_REGEX = f"(?:[ _.-]?(?:{MEASURED_WORDS_REGEX}|{POSITION_WORDS_REGEX}))*"
COORDINATE_NAME_PATTERN = re.compile(
    f"(?:(?:{MEASURED_WORDS_REGEX}|{POSITION_WORDS_REGEX})[ _.-]?)?([xyz]){AXIS_SUFFIX_REGEX}"
    f"|(?:(.+?)[ _.-])([xyz]){AXIS_SUFFIX_REGEX}"
    "|([xyz])[ _.-]?(\\d+)"
)
MEASURED_NAME_PATTERN = re.compile(
    f"(?:(?:{POSITION_WORDS_REGEX})[ _.-]?)?(?:{MEASURED_WORDS_REGEX}"
    f")(?:[ _.-]?(?:{POSITION_WORDS_REGEX}))?"
)
# no measured points: planned ones, differences, uncertainties
NOT_MEASURED_NAME_PATTERN = re.compile(
    r"u[ _]?\(?95\)?|target|goal|cmd|command|delta|d|tcp|robot|flange"
    r"|(?:.+[ _.-])?(?:soll|sollwert|nominal|nom|teorico|theorique"
    r"|\u7406\u8bba|abw|abweichung|dev|deviation|desv|desviacion|ecart|diff"
    r"|error|fehler|erreur|\u504f\u5dee|tol|toleranz|tolerance|tolerancia|\u516c\u5dee|std|sigma)"
)
WORDS_BY_MEANING = {  # plain names that mean the same in any file
    "time": ("time", "timestamp", "time stamp", "date time", "zeit", "zeitstempel", "uhrzeit",
             "datum uhrzeit", "horodatage", "heure", "date et heure", "temps", "tiempo", "hora",
             "marca de tiempo", "fecha y hora", "\u65f6\u95f4", "\u65f6\u95f4\u6233",
             "\u6d4b\u91cf\u65f6\u95f4"),
    "temperature": ("temperature", "temp", "measurement_temperature", "temperatur", "temp.",
                    "lufttemperatur", "temperatura", "\u6e29\u5ea6"),
    "target": ("target", "target name", "reflector", "smr", "ziel", "zielmarke", "reflektor",
               "cible", "reflecteur", "objetivo", "\u9776\u7403", "\u9776\u6807", "\u76ee\u6807"),
    "payload": ("payload", "traglast", "nutzlast", "last", "charge", "charge utile", "carga",
                "carga util", "\u8d1f\u8f7d"),
    "u95": ("u95", "u(95)", "u_95"),
    "pose": ("pose", "point", "point name", "pointid", "name", "id", "key", "no", "no.", "nr",
             "nr.", "pose no.", "pose nr.", "punkt", "punktname", "punkt-nr", "punkt-nr.",
             "punkt nr.", "pkt", "pkt.", "messpunkt", "bezeichnung", "nom", "nom du point",
             "punto", "nombre", "nombre del punto", "posicion", "\u70b9", "\u70b9\u540d",
             "\u70b9\u53f7", "\u6d4b\u70b9", "\u5e8f\u53f7", "\u540d\u79f0"),
    "tool": ("tool", "werkzeug", "outil", "herramienta", "adapter", "\u5de5\u5177"),
    "camera": ("camera", "kamera", "camara", "\u76f8\u673a"),
    "u": ("u",),
    "v": ("v",),
    "order": ("order",),
    "session": ("session",),
    "group": ("group",),
    "split": ("split",),
    "set_aside": ("set_aside",),
}  # fmt: skip
SUMMARY_ROW_PATTERN = re.compile(  # of a row below a table, in folded words
    r"(?:mittel(?:wert)?|durchschnitt|mean|average|avg|moyenne|media|promedio|\u5e73\u5747\u503c?"
    r"|max(?:imum|imo)?|min(?:imum|imo)?|\u6700[\u5927\u5c0f]\u503c?|rms|sigma|std(?:ev|abw)?|stabw"
    r"|standardabweichung|standard deviation|ecart[ -]type|desviacion|\u6807\u51c6\u5dee"
    r"|sum(?:me|a)?|somme|total|anzahl|count|range|spannweite|\u603b\u8ba1|\u5408\u8ba1)\b"
)
UNAMBIGUOUS_MEANINGS = (
    "tool",
    "temperature",
    "time",
)  # what means the same also beside names of this project
MEANING_BY_WORD = {word: meaning for meaning, words in WORDS_BY_MEANING.items() for word in words}


class StandardColumnName(NamedTuple):
    """The parts of one of this project's column names; all '' for another name."""

    kind: str
    name_without_unit: str
    unit: str


def parse_standard_column_name(name: str) -> StandardColumnName:
    """The kind of one of this project's columns, its name without the unit, and the unit; or ''."""
    for kind, own in STANDARD_COLUMN_KINDS.items():
        if found := re.fullmatch(own.full_name_pattern, name):
            unit = found[found.re.groups] if own.units else ""
            return StandardColumnName(kind, name.removesuffix(f"_{unit}"), unit)
    return StandardColumnName("", name, "")


def standard_column_kind(name_without_unit: str) -> str:
    """The kind of one of this project's columns, by its name without the unit; or ''."""
    return next(
        (
            kind
            for kind, own in STANDARD_COLUMN_KINDS.items()
            if re.fullmatch(own.stem, name_without_unit)
        ),
        "",
    )


def similar_column_hint(name: str, known_names: Iterable[str]) -> str:
    """A hint when a column's name is close to one that would be used; a 1 stands for any number."""
    numbers = {str(i) for i in range(1, 10)}
    every = [k.replace("1", i, 1) for k in known_names for i in (numbers if "1" in k else "1")]
    match = difflib.get_close_matches(name, sorted(every), 1, cutoff=0.75)
    return f" (did you mean {match[0]}?)" if match else ""


def fold_case_and_accents(text: str) -> str:
    """Small letters without accents, in one width."""
    wide = unicodedata.normalize("NFKD", text.strip().lower())
    return unicodedata.normalize("NFC", "".join(c for c in wide if not unicodedata.combining(c)))


def is_summary_cell(cell: str) -> bool:
    """Whether a row's first cell says that the row sums up others."""
    return bool(SUMMARY_ROW_PATTERN.match(fold_case_and_accents(cell)))


def standard_unit_name(text: str) -> str:
    """A unit as this project writes it, or ''."""
    text = unicodedata.normalize("NFKC", text).strip()
    names = [text, text.lower()][: len(text)]  # M and S are no units
    return next(
        (unit for name in names if (unit := UNIT_ALIASES.get(name, name)) in KNOWN_UNITS), ""
    )


class NameAndUnit(NamedTuple):
    """A header's name without its unit, and the unit, '' where it has none."""

    name: str
    unit: str


def split_name_and_unit(name: str) -> NameAndUnit:
    """A header's name without its unit, and the unit: 'X [mm]', 'x (mm)', 'x_mm', 'x mm'."""
    name = " ".join(unicodedata.normalize("NFKC", name).strip("\ufeff'\" \n").split())
    if (
        found := re.fullmatch("(.*?)\\s*[\\[(<\u3010]([^\\[\\](]*)[\\])>\u3011]", name)
    ) and standard_unit_name(found[2]):
        return NameAndUnit(found[1].strip(), standard_unit_name(found[2]))
    if (
        found := re.fullmatch(r"(.+?)(?:[ _]|,\s*|\s+/\s*)([^ _,/]+)", name)
    ) and standard_unit_name(found[2]):
        return NameAndUnit(found[1].strip(), standard_unit_name(found[2]))
    return NameAndUnit(name, "")


def names_without_units(names: Sequence[str]) -> tuple[str, ...]:
    """A header's names in small letters, without units."""
    return tuple(split_name_and_unit(name)[0].lower() for name in names)


def meaning_of_plain_name(name_without_unit: str) -> str:
    """The meaning of a name that means the same in any file, or ''."""
    return MEANING_BY_WORD.get(fold_case_and_accents(name_without_unit), "")


def joint_number_in_name(name_without_unit: str) -> int:
    """The joint that a header's name means, -1 for none."""
    found = (
        re.fullmatch(pattern, fold_case_and_accents(name_without_unit))
        for pattern in NUMBERED_JOINT_PATTERNS
    )
    return next((int(match["joint"]) for match in found if match), -1)


def sort_joint_names_along_arm(joint_names: Sequence[str]) -> list[str]:
    """Names of joints that end in `_joint` along the arm, where they tell; else as they are."""
    found = [
        [name for name in joint_names if name.endswith(f"{joint}_joint")]
        for joint in UR_JOINT_NAMES
    ]
    if len(joint_names) == len(UR_JOINT_NAMES) and all(len(same) == 1 for same in found):
        return [name for (name,) in found]
    return list(joint_names)


def joint_meanings_of_names(names_without_unit: Sequence[str]) -> dict[str, str]:
    """Meanings q1 ... of names that are joints: numbered from 1 or 0, or a maker's names, letters.

    A tracker's q0 to q3 turn the target, not the arm.
    """
    named = sort_joint_names_along_arm(
        [stem for stem in names_without_unit if stem.endswith("_joint")]
    )
    turns = "q0" in names_without_unit and "q4" not in names_without_unit
    arm = [
        stem
        for stem in names_without_unit
        if not (QUATERNION_NAME_PATTERN.fullmatch(stem) and turns)
    ]
    numbers = {stem: number for stem in arm if (number := joint_number_in_name(stem)) >= 0}
    found = {stem: f"q{number + (0 in numbers.values())}" for stem, number in numbers.items()}
    found |= {stem: f"q{i + 1}" for i, stem in enumerate(named)}
    for letters in () if found else reversed(YASKAWA_JOINT_LETTERS):
        if set(letters) <= set(names_without_unit):
            return {letter: f"q{i + 1}" for i, letter in enumerate(letters)}
    return found


def point_meanings_of_names(names_without_unit: Sequence[str]) -> dict[str, str]:
    """Meanings smr1_x ... of the names that are coordinates of whole points, in their order."""
    axes: dict[str, dict[str, str]] = {}
    for stem in names_without_unit:
        found = COORDINATE_NAME_PATTERN.fullmatch(fold_case_and_accents(stem))
        if not found or standard_column_kind(stem) not in ("", "smr"):
            continue
        letter, target = found[1] or found[3] or found[4], (found[2] or found[5] or "").rstrip(".")
        if not NOT_MEASURED_NAME_PATTERN.fullmatch(target):
            axes.setdefault(target, {}).setdefault(letter, stem)
    whole = [own for own in axes.values() if own.keys() == {"x", "y", "z"}]
    return {
        stem: f"smr{i + 1}_{letter}" for i, own in enumerate(whole) for letter, stem in own.items()
    }


def convert_to_standard_name(name: str, header: Sequence[str]) -> str:
    """One of this project's names with its unit in brackets, as q1 [rad], as it writes it."""
    stem, unit = split_name_and_unit(name)
    known = standard_column_kind(stem.lower())
    new = f"{stem.lower()}_{unit}"
    return (
        new if known and unit in STANDARD_COLUMN_KINDS[known].units and new not in header else name
    )


def is_understood_header(names: Sequence[str]) -> bool:
    """Whether most names of a would-be header mean joints, coordinates or a plain column."""
    stems = names_without_units(names)
    known = {*joint_meanings_of_names(stems), *point_meanings_of_names(stems)} | {
        stem for stem in stems if meaning_of_plain_name(stem)
    }
    return 2 * sum(stem in known for stem in stems) >= len(stems)


def convert_header_to_standard_names(header: Sequence[str]) -> tuple[str, ...]:
    """A header with this project's names in place of others that mean the same.

    Beside its own joints or targets only what cannot mean anything else.
    """
    header, stems = (
        [convert_to_standard_name(name, header) for name in header],
        names_without_units(header),
    )
    own = any(parse_standard_column_name(name)[0] in ("q", "smr") for name in header)
    found = {} if own else joint_meanings_of_names(stems)
    found |= point_meanings_of_names(stems) if found else {axis: axis for axis in "xyz"}
    out, taken = list(header), {*header}
    for i, (name, stem) in enumerate(zip(header, stems, strict=True)):
        what, unit = (
            found.get(
                stem, "" if parse_standard_column_name(name)[0] else meaning_of_plain_name(stem)
            ),
            split_name_and_unit(name)[1],
        )
        units = (
            STANDARD_COLUMN_KINDS[kind].units if (kind := standard_column_kind(what)) else (unit,)
        )
        new = f"{what}_{unit}" if unit else what
        if (
            what
            and (unit in units or not units)
            and new not in taken
            and (not own or what in UNAMBIGUOUS_MEANINGS)
        ):
            out[i] = new
            taken.add(new)
    return tuple(out)
