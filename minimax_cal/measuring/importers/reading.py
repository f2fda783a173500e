"""What the columns of a file mean, before they become measurements."""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from minimax_cal.ground.arrays import Array
from minimax_cal.ground.errors import DataError
from minimax_cal.measuring.importers.names import folded
from minimax_cal.measuring.importers.sheet import COMMA, POINT, Sheet, is_number

ANGLES = {"rad": 1.0, "deg": np.pi / 180.0, "mrad": 1e-3}
LENGTHS = {"mm": 1e-3, "m": 1.0, "um": 1e-6, "cm": 1e-2, "in": 0.0254}
TIMES = {"s": 1.0, "ms": 1e-3, "min": 60.0, "h": 3600.0}
TEMPERATURES = ("C", "K", "F")
OTHERS = ("kg", "Nm")
ALIASES = {"°": "deg", "º": "deg", "µm": "um", "μm": "um", "inch": "in", "°C": "C", "°F": "F"}
ALIASES |= dict.fromkeys(("Grad", "grad", "grados", "degr\u00e9s", "\u5ea6"), "deg")
ALIASES |= {"\u5f27\u5ea6": "rad", "\u6beb\u7c73": "mm", "\u7c73": "m", "\u79d2": "s"}
ALIASES |= dict.fromkeys(("sec", "Sek", "sek", "Sekunden", "segundos", "secondes"), "s")
ALIASES |= {"degC": "C", "degF": "F", "degree": "deg", "degrees": "deg", "radians": "rad"}
# joints along the arm, where the names tell: a ROS log may sort them by alphabet
UR = ("shoulder_pan", "shoulder_lift", "elbow", "wrist_1", "wrist_2", "wrist_3")
KNOWN = {*ANGLES, *LENGTHS, *TIMES, *TEMPERATURES, *OTHERS}
JOINT = re.compile(  # of folded names: English, German, French, Spanish, Chinese
    "(?:q|j|a|ax|axis|joint|theta|achse|achswert|gelenk|axe|articulation|eje|articulacion"
    "|\u5173\u8282|\u8f74)[ _.-]?(\\d+)"
    "(?:[ _.-]?(?:angle|winkel|ist|actual|position|pos|wert|value|angulo|\u89d2\u5ea6|\u89d2))?"
    "|\u7b2c?(\\d+)(?:\u8f74|\u5173\u8282)(?:\u89d2\u5ea6|\u89d2)?"
)
ACTUAL = (
    "ist|istwert|actual|act|meas|measured|mess|messwert|mesure|medido|\u5b9e\u6d4b|\u6d4b\u91cf"
)
PLACE = "pos|position|koordinate|coordinate|coord|coordonnee|coordenada|\u5750\u6807|\u503c"
SAID = f"(?:[ _.-]?(?:{ACTUAL}|{PLACE}))*"
AXIS = re.compile(f"(?:(?:{ACTUAL}|{PLACE})[ _.-]?)?([xyz]){SAID}|(?:(.+?)[ _.-])([xyz]){SAID}")
NOMINAL = re.compile(  # no measured points: planned ones, differences, uncertainties
    r"u[ _]?\(?95\)?|soll|sollwert|nominal|nom|teorico|theorique|target|goal|cmd|command|delta|abw"
    "|abweichung|dev|deviation|diff|ecart|\u7406\u8bba|std|sigma|d|tcp|robot"
)
POINT_NAME = re.compile(r"smr(\d+)_([xyz])")
WORDS = {  # plain names that mean the same in any file
    "time": ("time", "timestamp", "time stamp", "date time", "zeit", "zeitstempel", "uhrzeit",
             "horodatage", "heure", "temps", "tiempo", "hora", "marca de tiempo",
             "\u65f6\u95f4", "\u65f6\u95f4\u6233"),
    "temperature": ("temperature", "temp", "measurement_temperature", "temperatur", "temp.",
                    "lufttemperatur", "temperatura", "\u6e29\u5ea6"),
    "target": ("target", "target name", "reflector", "smr", "ziel", "zielmarke", "reflektor",
               "cible", "reflecteur", "objetivo", "\u9776\u7403", "\u9776\u6807", "\u76ee\u6807"),
    "u95": ("u95", "u(95)", "u_95"),
    "pose": ("pose", "point", "point name", "name", "id", "key", "no", "no.", "nr", "nr.",
             "punkt", "punktname", "punkt-nr", "punkt-nr.", "punkt nr.", "pkt", "pkt.",
             "messpunkt", "bezeichnung", "nom", "nom du point", "punto", "nombre",
             "nombre del punto", "\u70b9", "\u70b9\u540d", "\u70b9\u53f7", "\u6d4b\u70b9",
             "\u5e8f\u53f7", "\u540d\u79f0"),
    "tool": ("tool", "werkzeug", "outil", "herramienta", "adapter", "\u5de5\u5177"),
    "order": ("order",),
    "session": ("session",),
    "group": ("group",),
    "split": ("split",),
    "set_aside": ("set_aside",),
}  # fmt: skip
SOME = 8  # lines that a notice names
PLAIN = {word: meaning for meaning, words in WORDS.items() for word in words}


@dataclass(frozen=True)
class Told:
    """What the user said: columns of points and of joints, units by meaning, layout, decimal."""

    columns: str = ""
    joint_columns: str = ""
    units: Mapping[str, str] = field(default_factory=dict)
    layout: str = ""
    decimal: str = ""


def family_of(meaning: str) -> str:
    """A column's meaning without numbers and axes."""
    found = re.match(r"u95|[a-z]+", meaning)
    return found[0] if found else ""


@dataclass(frozen=True)
class Column:
    """One column: its name, what it means (as q3, smr1_x, u95, or '' for nothing), its unit.

    known: how the unit is known.  remark: why a column means nothing.
    """

    name: str
    meaning: str
    unit: str
    cells: tuple[str, ...]
    known: str = ""
    remark: str = ""

    @property
    def family(self) -> str:
        """Meaning without numbers and axes: q, smr, u95."""
        return family_of(self.meaning)


@dataclass(frozen=True, eq=False)
class Reading:
    """A file understood: columns of m cells each, and the line of each row.

    deleted: rows whose point the file itself says is not to be used.
    """

    format: str
    sheet: Sheet
    columns: tuple[Column, ...]
    line: Array
    notices: tuple[str, ...] = ()
    deleted: tuple[int, ...] = ()

    def find(self, meaning: str) -> Column | None:
        """The column with a meaning."""
        return next((c for c in self.columns if c.meaning == meaning), None)

    def column(self, meaning: str) -> Column:
        """The column with a meaning that is surely there."""
        return next(c for c in self.columns if c.meaning == meaning)

    @property
    def joints(self) -> tuple[Column, ...]:
        """Joint columns, by number."""
        found = [c for c in self.columns if c.family == "q"]
        return tuple(sorted(found, key=lambda c: int(c.meaning[1:])))

    @property
    def smrs(self) -> tuple[int, ...]:
        """Numbers of the targets that have columns."""
        found = (POINT_NAME.fullmatch(c.meaning) for c in self.columns)
        return tuple(sorted({int(m[1]) for m in found if m}))

    def take(self, rows: Array) -> Reading:
        """Some rows only.  rows: their indices, in order."""
        place = {int(row): i for i, row in enumerate(rows)}
        columns = tuple(replace(c, cells=tuple(c.cells[i] for i in rows)) for c in self.columns)
        deleted = tuple(place[row] for row in self.deleted if row in place)
        return replace(self, columns=columns, line=self.line[rows], deleted=deleted)

    def saying(self, *what: str) -> Reading:
        """With notices, after the name of its file."""
        said = tuple(f"{self.sheet.path}: {text}" for text in what)
        return replace(self, notices=(*self.notices, *said))

    def measured_again(self) -> Reading:
        """Without the rows that are marked deleted, which have others in their place."""
        gone = set(self.deleted)
        kept = [i for i in range(len(self.line)) if i not in gone]
        columns = tuple(replace(c, cells=tuple(c.cells[i] for i in kept)) for c in self.columns)
        told = replace(self, columns=columns, line=self.line[kept], deleted=())
        return told.noticing(f"left out: {self.where}")

    def kept_beside(self) -> Reading:
        """With rows that are marked deleted as points that are set aside."""
        gone = set(self.deleted)
        columns = tuple(
            replace(c, cells=tuple("" if i in gone else cell for i, cell in enumerate(c.cells)))
            if c.family == "u95"
            else c
            for c in self.columns
        )
        return replace(self, columns=columns).noticing(f"set aside: {self.where}")

    @property
    def where(self) -> str:
        """The lines that are marked deleted."""
        lines = [str(self.line[i]) for i in self.deleted]
        some = ", ".join(lines[:SOME]) + (" ..." if len(lines) > SOME else "")
        return f"line{'s' * (len(lines) > 1)} {some}"

    def noticing(self, what: str) -> Reading:
        """With a notice about points that are marked deleted."""
        notice = f"{self.sheet.path}: points that are marked deleted are {what}"
        return replace(self, notices=(*self.notices, notice))

    def numbers(self, column: Column, *, empty: bool = True) -> Array:
        """A column as floats, NaN where empty.  Raises DataError."""
        out = np.full(len(column.cells), np.nan)
        for i, cell in enumerate(column.cells):
            if cell or not empty:
                out[i] = self.number(column, i, cell)
        return out

    def number(self, column: Column, row: int, cell: str) -> float:
        """One cell.  Raises DataError."""
        decimal_comma = self.sheet.decimal == ","
        text = cell.replace(",", ".") if decimal_comma and COMMA.fullmatch(cell) else cell
        if POINT.fullmatch(text) and np.isfinite(float(text)):
            return float(text)
        mend = "complete it or delete the row"
        if COMMA.fullmatch(cell):
            mend = "use a decimal point"
        elif re.fullmatch(r"[-+]?\d{1,3}([.,' ]\d{3})+[.,]\d+", cell):
            mend = "take the thousands separators out"
        elif cell:
            mend = "mend it, or leave it empty where it was not measured"
            mend = mend if column.family != "q" else "mend it or delete the row"
        what = f"{cell!r} is not a finite number" if cell else "is empty"
        where = f"{self.sheet.path}:{self.line[row]}"
        raise DataError(f"{where}: column {column.name}: {what}; {mend}")


def unit_name(text: str) -> str:
    """A unit as this project writes it, or ''."""
    text = unicodedata.normalize("NFKC", text).strip()
    text = ALIASES.get(text, text)
    return text if text in KNOWN else ""


def split_unit(name: str) -> tuple[str, str]:
    """A header's name without its unit, and the unit: 'X [mm]', 'x (mm)', 'x_mm', 'x mm'."""
    name = unicodedata.normalize("NFKC", name).strip().lstrip("\ufeff").strip("'\"")
    if (
        found := re.fullmatch("(.*?)\\s*[\\[(<\u3010]([^\\[\\](]*)[\\])>\u3011]", name)
    ) and unit_name(found[2]):
        return found[1].strip(), unit_name(found[2])
    if (found := re.fullmatch(r"(.+)[ _]([^ _]+)", name)) and unit_name(found[2]):
        return found[1].strip(), unit_name(found[2])
    return name, ""


def stems(sheet: Sheet) -> tuple[str, ...]:
    """The header's names in small letters, without units."""
    return tuple(split_unit(name)[0].lower() for name in sheet.header)


def joint_names(sheet: Sheet) -> list[str]:
    """The header's names that end in `_joint`, along the arm."""
    return along_arm([name for name in stems(sheet) if name.endswith("_joint")])


def along_arm(names: list[str]) -> list[str]:
    """Names of joints along the arm, where they tell; else as they are."""
    told = [[name for name in names if name.endswith(f"{joint}_joint")] for joint in UR]
    if len(names) == len(UR) and all(len(found) == 1 for found in told):
        return [name for (name,) in told]
    return names


def plain(stem: str) -> str:
    """The meaning of a name that means the same in any file."""
    return PLAIN.get(folded(stem), "")


def joint_number(stem: str) -> int:
    """The joint that a header's name means, 0 for none."""
    found = JOINT.fullmatch(folded(stem))
    return int(found[1] or found[2]) if found else 0


def points_of(names: Sequence[str]) -> dict[str, str]:
    """Meanings smr1_x ... of the names that are coordinates of whole points, in their order."""
    axes: dict[str, dict[str, str]] = {}
    for name in names:
        found = AXIS.fullmatch(folded(name))
        if not found:
            continue
        letter, target = found[1] or found[3], found[2] or ""
        if not NOMINAL.fullmatch(target) and "measurement_std" not in target:
            axes.setdefault(target, {}).setdefault(letter, name)
    whole = [own for own in axes.values() if own.keys() == {"x", "y", "z"}]
    return {
        name: f"smr{i + 1}_{letter}" for i, own in enumerate(whole) for letter, name in own.items()
    }


def named_reading(
    title: str,
    sheet: Sheet,
    meaning: Callable[[str], str],
    units: Mapping[str, str] | None = None,
    remarks: Mapping[str, str] | None = None,
) -> Reading:
    """A file with a header.  meaning: of a stem.  units: that the format fixes, by family."""
    columns = []
    for i, name in enumerate(sheet.header):
        stem, unit = split_unit(name)
        what, known = meaning(stem.lower()), "header"
        if not unit:
            unit = (units or {}).get(family_of(what), "")
            known = "format" if unit else ""
        remark = "" if what else (remarks or {}).get(stem.lower(), "")
        cells = tuple(row[i] for row in sheet.cells)
        columns.append(Column(name, what, unit, cells, known, remark))
    return checked(Reading(title, sheet, tuple(one_name(columns)), sheet.line))


def one_name(columns: list[Column]) -> list[Column]:
    """The columns with one of several that name the points: the one that tells most apart."""
    named = [column for column in columns if column.meaning == "pose"]
    if len(named) < 2:
        return columns
    words = {c.name: any(not is_number(cell) for cell in c.cells) for c in named}
    best = max(named, key=lambda c: (len(set(c.cells)), words[c.name]))
    other = f"points have their names in column {best.name}"
    return [
        replace(c, meaning="", remark=other) if c.meaning == "pose" and c is not best else c
        for c in columns
    ]


def checked(reading: Reading) -> Reading:
    """The reading, if no meaning stands twice and every target is whole.  Raises DataError."""
    path = reading.sheet.path
    seen: dict[str, str] = {}
    for column in reading.columns:
        if column.meaning and column.meaning in seen:
            raise DataError(
                f"{path}: columns {seen[column.meaning]!r} and {column.name!r} both are "
                f"{column.meaning}; delete one, or say which with columns="
            )
        seen[column.meaning] = column.name
    for number in reading.smrs:
        for axis in "xyz":
            if f"smr{number}_{axis}" not in seen:
                raise DataError(f"{path}: target {number} has no column for {axis}; add it")
    numbers = [int(column.meaning[1:]) for column in reading.joints]
    if missing := sorted(set(range(1, max(numbers, default=0) + 1)) - set(numbers)):
        raise DataError(f"{path}: has no column for joint {missing[0]}; add it")
    return reading
