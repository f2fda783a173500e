"""What names of columns and units mean: English, German, French, Spanish and Chinese."""

from __future__ import annotations

import difflib
import re
import unicodedata
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

ANY = ("rad", "deg", "mm", "m")
SIZES = ("mm", "m")


@dataclass(frozen=True)
class Kind:
    """What this project calls columns of one kind, without the unit, and the units they may have.

    The first is the one that is written.  text: whether cells are labels, never computed with.
    """

    stem: str
    units: tuple[str, ...] = ()
    text: bool = False

    @property
    def pattern(self) -> str:
        """Of the whole name, its last group the unit."""
        return f"{self.stem}_({'|'.join(self.units)})" if self.units else self.stem


OWN = {  # columns of measurements, by kind
    "q": Kind(r"q(\d+)", ANY),
    "smr": Kind(r"smr(\d+)_([xyz])", SIZES),
    "order": Kind("order"),
    "time": Kind("time", ("s",)),
    "temperature": Kind("temperature", ("C",)),
    "payload": Kind("payload", ("kg",)),
    "payload centre": Kind("payload_[xyz]", SIZES),
    "tool": Kind("tool", text=True),
    "tau": Kind(r"tau\d+", ("Nm",)),
    "approach": Kind(r"approach\d+"),
    "session": Kind("session", text=True),
    "group": Kind("group", text=True),
    "u95": Kind("u95", SIZES),
    "pose": Kind("pose", text=True),
    "split": Kind("split", text=True),
    "set_aside": Kind("set_aside", text=True),
    "simulated": Kind("simulated"),
    "qread": Kind(r"qread\d+", ANY),
    "base": Kind(r"base\d+_[xyz]", SIZES),
}
ANGLES = {"rad": 1.0, "deg": np.pi / 180.0, "mrad": 1e-3}
LENGTHS = {"mm": 1e-3, "m": 1.0, "um": 1e-6, "cm": 1e-2, "in": 0.0254}
TIMES = {"s": 1.0, "ms": 1e-3, "min": 60.0, "h": 3600.0}
TEMPERATURES = ("C", "K", "F")
OTHERS = ("kg", "Nm", "px")
ALIASES = {"°": "deg", "º": "deg", "µm": "um", "μm": "um", "inch": "in", "°C": "C", "°F": "F"}
ALIASES |= dict.fromkeys(("Grad", "grad", "grados", "degr\u00e9s", "\u5ea6"), "deg")
ALIASES |= {"\u5f27\u5ea6": "rad", "\u6beb\u7c73": "mm", "\u7c73": "m", "\u79d2": "s"}
ALIASES |= dict.fromkeys(("sec", "Sek", "sek", "Sekunden", "segundos", "secondes"), "s")
ALIASES |= {"degC": "C", "degF": "F", "degree": "deg", "degrees": "deg", "radians": "rad"}
ALIASES |= dict.fromkeys(
    ("MM", "millimeters", "Millimeter", "millim\u00e8tres", "mil\u00edmetros"), "mm"
)
ALIASES |= dict.fromkeys(("IN", "inches"), "in")
KNOWN = {*ANGLES, *LENGTHS, *TIMES, *TEMPERATURES, *OTHERS}
JOINTS = ("q|j|a|\u03b8|ax|axis|joint|theta|achse|achswert|gelenk|axe|articulation|eje|articulacion"
          "|\u5173\u8282|\u8f74")  # fmt: skip
NUMBERED = (  # of folded names
    f"(?:(?:robot(?:er)?|arm|ist|actual)[ _.-])?(?:{JOINTS})[ _.-]?(?P<joint>\\d+)"
    "(?:[ _.-]?(?:angle|winkel|ist|actual|position|pos|wert|value|angulo|\u89d2\u5ea6|\u89d2))?",
    "\u7b2c?(?P<joint>\\d+)(?:\u8f74|\u5173\u8282)(?:\u89d2\u5ea6|\u89d2)?",
)
QUATERNION = re.compile(r"q\d+")
# joints along the arm, where the names tell: a ROS log may sort them by alphabet
UR = ("shoulder_pan", "shoulder_lift", "elbow", "wrist_1", "wrist_2", "wrist_3")
YASKAWA = (tuple("slurbt"), tuple("sleurbt"))
ACTUAL = (
    "ist|istwert|actual|act|meas|measured|mess|messwert|mesure|medido|\u5b9e\u6d4b|\u6d4b\u91cf"
)
PLACE = (
    "pos|position|koordinate|coordinate|coord|coordonnee|coordenada|wert|value|valeur|valor"
    "|\u5750\u6807|\u503c"
)
SAID = f"(?:[ _.-]?(?:{ACTUAL}|{PLACE}))*"
AXIS = re.compile(
    f"(?:(?:{ACTUAL}|{PLACE})[ _.-]?)?([xyz]){SAID}|(?:(.+?)[ _.-])([xyz]){SAID}"
    "|([xyz])[ _.-]?(\\d+)"
)
MEASURED = re.compile(f"(?:(?:{PLACE})[ _.-]?)?(?:{ACTUAL})(?:[ _.-]?(?:{PLACE}))?")
NOMINAL = re.compile(  # no measured points: planned ones, differences, uncertainties
    r"u[ _]?\(?95\)?|target|goal|cmd|command|delta|d|tcp|robot|flange"
    r"|(?:.+[ _.-])?(?:soll|sollwert|nominal|nom|teorico|theorique"
    r"|\u7406\u8bba|abw|abweichung|dev|deviation|desv|desviacion|ecart|diff"
    r"|error|fehler|erreur|\u504f\u5dee|tol|toleranz|tolerance|tolerancia|\u516c\u5dee|std|sigma)"
)
WORDS = {  # plain names that mean the same in any file
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
SUMMARY = re.compile(  # of a row below a table, in folded words
    r"(?:mittel(?:wert)?|durchschnitt|mean|average|avg|moyenne|media|promedio|\u5e73\u5747\u503c?"
    r"|max(?:imum|imo)?|min(?:imum|imo)?|\u6700[\u5927\u5c0f]\u503c?|rms|sigma|std(?:ev|abw)?|stabw"
    r"|standardabweichung|standard deviation|ecart[ -]type|desviacion|\u6807\u51c6\u5dee"
    r"|sum(?:me|a)?|somme|total|anzahl|count|range|spannweite|\u603b\u8ba1|\u5408\u8ba1)\b"
)
SURE = ("tool", "temperature", "time")  # what means the same also beside names of this project
PLAIN = {word: meaning for meaning, words in WORDS.items() for word in words}


def own_kind(name: str) -> tuple[str, str, str]:
    """The kind of one of this project's columns, its name without the unit, and the unit; or ''."""
    for kind, own in OWN.items():
        if found := re.fullmatch(own.pattern, name):
            unit = found[found.re.groups] if own.units else ""
            return kind, name.removesuffix(f"_{unit}"), unit
    return "", name, ""


def kind_of(stem: str) -> str:
    """The kind of one of this project's columns, by its name without the unit; or ''."""
    return next((kind for kind, own in OWN.items() if re.fullmatch(own.stem, stem)), "")


def near(name: str, known: Iterable[str]) -> str:
    """A hint when a column's name is close to one that would be used; a 1 stands for any number."""
    numbers = {str(i) for i in range(1, 10)}
    every = [k.replace("1", i, 1) for k in known for i in (numbers if "1" in k else "1")]
    match = difflib.get_close_matches(name, sorted(every), 1, cutoff=0.75)
    return f" (did you mean {match[0]}?)" if match else ""


def folded(text: str) -> str:
    """Small letters without accents, in one width."""
    wide = unicodedata.normalize("NFKD", text.strip().lower())
    return unicodedata.normalize("NFC", "".join(c for c in wide if not unicodedata.combining(c)))


def is_summary(cell: str) -> bool:
    """Whether a row's first cell says that the row sums up others."""
    return bool(SUMMARY.match(folded(cell)))


def unit_name(text: str) -> str:
    """A unit as this project writes it, or ''."""
    text = unicodedata.normalize("NFKC", text).strip()
    names = [text, text.lower()][: len(text)]  # M and S are no units
    return next((unit for name in names if (unit := ALIASES.get(name, name)) in KNOWN), "")


def split_unit(name: str) -> tuple[str, str]:
    """A header's name without its unit, and the unit: 'X [mm]', 'x (mm)', 'x_mm', 'x mm'."""
    name = " ".join(unicodedata.normalize("NFKC", name).strip("\ufeff'\" \n").split())
    if (
        found := re.fullmatch("(.*?)\\s*[\\[(<\u3010]([^\\[\\](]*)[\\])>\u3011]", name)
    ) and unit_name(found[2]):
        return found[1].strip(), unit_name(found[2])
    if (found := re.fullmatch(r"(.+?)(?:[ _]|,\s*|\s+/\s*)([^ _,/]+)", name)) and unit_name(
        found[2]
    ):
        return found[1].strip(), unit_name(found[2])
    return name, ""


def stems_of(names: Sequence[str]) -> tuple[str, ...]:
    """A header's names in small letters, without units."""
    return tuple(split_unit(name)[0].lower() for name in names)


def plain(stem: str) -> str:
    """The meaning of a name that means the same in any file, or ''."""
    return PLAIN.get(folded(stem), "")


def joint_number(stem: str) -> int:
    """The joint that a header's name means, -1 for none."""
    found = (re.fullmatch(pattern, folded(stem)) for pattern in NUMBERED)
    return next((int(match["joint"]) for match in found if match), -1)


def along_arm(names: Sequence[str]) -> list[str]:
    """Names of joints that end in `_joint` along the arm, where they tell; else as they are."""
    found = [[name for name in names if name.endswith(f"{joint}_joint")] for joint in UR]
    if len(names) == len(UR) and all(len(same) == 1 for same in found):
        return [name for (name,) in found]
    return list(names)


def joints_of(stems: Sequence[str]) -> dict[str, str]:
    """Meanings q1 ... of names that are joints: numbered from 1 or 0, or a maker's names, letters.

    A tracker's q0 to q3 turn the target, not the arm.
    """
    named = along_arm([stem for stem in stems if stem.endswith("_joint")])
    turns = "q0" in stems and "q4" not in stems
    arm = [stem for stem in stems if not (QUATERNION.fullmatch(stem) and turns)]
    numbers = {stem: number for stem in arm if (number := joint_number(stem)) >= 0}
    found = {stem: f"q{number + (0 in numbers.values())}" for stem, number in numbers.items()}
    found |= {stem: f"q{i + 1}" for i, stem in enumerate(named)}
    for letters in () if found else reversed(YASKAWA):
        if set(letters) <= set(stems):
            return {letter: f"q{i + 1}" for i, letter in enumerate(letters)}
    return found


def points_of(stems: Sequence[str]) -> dict[str, str]:
    """Meanings smr1_x ... of the names that are coordinates of whole points, in their order."""
    axes: dict[str, dict[str, str]] = {}
    for stem in stems:
        found = AXIS.fullmatch(folded(stem))
        if not found or kind_of(stem) not in ("", "smr"):
            continue
        letter, target = found[1] or found[3] or found[4], (found[2] or found[5] or "").rstrip(".")
        if not NOMINAL.fullmatch(target):
            axes.setdefault(target, {}).setdefault(letter, stem)
    whole = [own for own in axes.values() if own.keys() == {"x", "y", "z"}]
    return {
        stem: f"smr{i + 1}_{letter}" for i, own in enumerate(whole) for letter, stem in own.items()
    }


def own_name(name: str, header: Sequence[str]) -> str:
    """One of this project's names with its unit in brackets, as q1 [rad], as it writes it."""
    stem, unit = split_unit(name)
    known = kind_of(stem.lower())
    new = f"{stem.lower()}_{unit}"
    return new if known and unit in OWN[known].units and new not in header else name


def is_understood(names: Sequence[str]) -> bool:
    """Whether most names of a would-be header mean joints, coordinates or a plain column."""
    stems = stems_of(names)
    known = {*joints_of(stems), *points_of(stems)} | {stem for stem in stems if plain(stem)}
    return 2 * sum(stem in known for stem in stems) >= len(stems)


def in_own_words(header: Sequence[str]) -> tuple[str, ...]:
    """A header with this project's names in place of others that mean the same.

    Beside its own joints or targets only what cannot mean anything else.
    """
    header, stems = [own_name(name, header) for name in header], stems_of(header)
    own = any(own_kind(name)[0] in ("q", "smr") for name in header)
    found = {} if own else joints_of(stems)
    found |= points_of(stems) if found else {axis: axis for axis in "xyz"}
    out, taken = list(header), {*header}
    for i, (name, stem) in enumerate(zip(header, stems, strict=True)):
        what, unit = found.get(stem, "" if own_kind(name)[0] else plain(stem)), split_unit(name)[1]
        units = OWN[kind].units if (kind := kind_of(what)) else (unit,)
        new = f"{what}_{unit}" if unit else what
        if what and (unit in units or not units) and new not in taken and (not own or what in SURE):
            out[i] = new
            taken.add(new)
    return tuple(out)
