"""A session: a folder of plain files, which the command line reads as well."""

from __future__ import annotations

import os
import re
import time
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import lru_cache
from hashlib import file_digest
from itertools import chain, count
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from minimax_cal.ground.errors import CalibrationError, OptionError
from minimax_cal.ground.files import json_of, json_text, read_raw, write_whole
from minimax_cal.ground.words import one_line, visible
from minimax_cal.measuring.importers import read_any
from minimax_cal.measuring.importers.tables import Given
from minimax_cal.measuring.set_aside import MOST_LETTERS, POINT
from minimax_cal.robots.robot import builtin_robots

GIVEN, LOG = "given", "log"  # folders of a session: what people dropped, how each step ended
CHOICES, SCRIPT = "session.json", "commands.sh"
MOST_BYTES = 256 << 20  # of a file that is dropped: a million poses
MOST_FILES, MOST_TOGETHER = 200, 1 << 30  # of a session: how many, and their bytes
MAX_LEFT_OUT = 1000  # points that are set aside one by one; their names fit on a command line
MAX_NAME_BYTES = 200  # of a dropped file; file systems take 255, of which a hidden part needs some
ABANDONED = 3600.0  # [s]; 256 MiB take less on any line to this machine itself
NAME = re.compile(r"[\w(][\w .()+@=-]{0,119}")
# Devices of Windows, whatever the ending [Microsoft, Naming Files, Paths, and Namespaces].
RESERVED = re.compile(r"(con|prn|aux|nul|(com|lpt)[\d\u00b9\u00b2\u00b3]) *(\..*)?", re.I)
SESSION = re.compile(r"[a-z0-9][a-z0-9-]{0,59}")

Limit = Annotated[float, Field(gt=0.0, le=1e6)] | None
Word = Annotated[str, Field(max_length=2000, pattern=r"^[^\x00-\x1f\x7f]*$")]
PointName = Annotated[str, Field(max_length=40)]
Point = Annotated[PointName, Field(pattern=f"^{POINT.pattern}$")]
Reason = Annotated[str, Field(max_length=MOST_LETTERS, pattern=r"^[^\x00-\x1f\x7f]*$")]


Contents = Mapping[str, Iterable[str]]  # of dropped files: joints, points, both or neither


class Choices(BaseModel):
    """What people chose on the page.

    robot: a built-in name, or a file that was dropped.  measured, targets: such files; joints: that
    of them which holds joint values.  left_out: points, as `--leave-out` names them; reasons: why,
    by point.  rms, most: what is required [mm].
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    robot: Word = ""
    measured: Annotated[tuple[Word, ...], Field(max_length=MOST_FILES)] = ()
    joints: Word = ""
    targets: Word = ""
    units: Word = ""
    columns: Word = ""
    layout: Literal["", "pose", "target"] = ""
    decimal: Literal["", "point", "comma"] = ""
    left_out: Annotated[tuple[Point, ...], Field(max_length=MAX_LEFT_OUT)] = ()
    reasons: Annotated[dict[PointName, Reason], Field(max_length=MAX_LEFT_OUT)] = {}
    objective: Literal["minimax", "sum", "point"] = "minimax"
    effects: bool = False
    quick: bool = False
    rms: Limit = None
    most: Limit = None
    claim: Literal["inside", "outside"] = "inside"
    poses: Annotated[int, Field(ge=1, le=1000)] = 20

    def files(self) -> set[str]:
        """The dropped files that are named somewhere."""
        return {*self.measured, self.joints, self.targets, self.robot}

    def without(self, name: str) -> dict[str, Any]:
        """The changes that leave a file out of every choice."""
        left = {key: "" for key in ("robot", "joints", "targets") if getattr(self, key) == name}
        return {"measured": [one for one in self.measured if one != name], **left}


@dataclass(frozen=True)
class Session:
    """A folder: files that people dropped, what the commands wrote, and the choices."""

    folder: Path

    @property
    def name(self) -> str:
        """As the address of its page has it."""
        return self.folder.name

    @property
    def choices(self) -> Choices:
        """Those made so far.  Raises OptionError for a file that holds none."""
        path = self.folder / CHOICES
        if not path.exists():
            return Choices()
        try:
            return Choices.model_validate(json_of(read_raw(path)))
        except ValueError as error:
            raise OptionError(f"{path}: holds no choices of a session; remove it") from error

    def choose(self, changes: Mapping[str, Any]) -> Choices:
        """Make choices.  Raises OptionError; then nothing changes."""
        made = self.checked(changes)
        write_whole(self.folder / CHOICES, json_text(made.model_dump(mode="json")))
        return made

    def checked(self, changes: Mapping[str, Any]) -> Choices:
        """The choices with changes, of files that are there.  Raises OptionError."""
        now = self.choices
        whole = {**now.model_dump(), **changes}
        try:
            made = Choices.model_validate(whole)
        except ValidationError as error:
            first = error.errors()[0]
            where = ".".join(map(str, first["loc"]))
            raise OptionError(one_line(f"{where}: {first['msg']}")) from error
        for name in made.files() - now.files():  # of one that is gone since, its command will say
            known = name in builtin_robots() and name == made.robot
            if name and not known and not self.file(GIVEN, name).is_file():
                raise OptionError(f"{visible(name)}: was not dropped here")
        return made

    def file(self, *parts: str) -> Path:
        """A file of the session.  Raises OptionError for a name that leads out of its folder."""
        *folders, name = parts
        if folders not in ([], [GIVEN], [LOG]):
            raise OptionError("a session has no such folder")
        path = self.folder.joinpath(*folders, plain_name(name))
        if not path.resolve().is_relative_to(self.folder.resolve()):
            raise OptionError(f"{name}: leads out of the session's folder")
        return path

    def given(self) -> list[str]:
        """Names of the files that were dropped."""
        return sorted(path.name for path in (self.folder / GIVEN).iterdir() if is_whole(path))

    def room(self, name: str) -> int:
        """How many bytes a file may have that is dropped now.  Raises OptionError for none.

        Files that are being written count with the length that they are to have.
        """
        others = [path for path in (self.folder / GIVEN).iterdir() if path.name != name]
        left = MOST_TOGETHER - sum(mark(path)[2] for path in others)
        if len(others) >= MOST_FILES or left <= 0:
            most = f"{MOST_FILES} files and {MOST_TOGETHER >> 30} GiB"
            raise OptionError(f"a session holds {most}; remove some, or begin another")
        return min(MOST_BYTES, left)

    def part(self, name: str, size: int) -> Path:
        """A new hidden file as long as what will be written into it, so that others count it."""
        path = self.folder / GIVEN / f".{name}.{os.urandom(4).hex()}"
        with open(os.open(path, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o600), "wb") as stream:
            stream.truncate(size)
        return path

    def take(self, kind: str, names: Sequence[str], contents: Contents) -> Choices:
        """Choose files that were dropped at once; they replace what they cannot stand beside.

        kind: measured, robot or targets.  contents: of the measured files, old and new, as `held`
        says.  Of measured files, those go that hold joint values, or points, as one of the new does
        that can be read.  Raises OptionError; then nothing changes.
        """
        now = self.choices
        new = {content for name in names for content in contents.get(name, ())}
        replaced = {
            "measured": {name for name in now.measured if new & {*contents.get(name, ())}},
            "robot": set[str](),  # which can be chosen again
            "targets": {now.targets} - {""},
        }
        if kind not in replaced or not names:
            raise OptionError("name the files, and what they are for")
        gone = replaced[kind] - {*names}
        stay = [name for name in now.measured if name not in gone]
        chosen = [*dict.fromkeys([*stay, *names])] if kind == "measured" else names[0]
        left = {key: "" for key in ("robot", "joints", "targets") if getattr(now, key) in gone}
        made = self.choose({**left, "measured": stay, kind: chosen})
        for name in gone:
            self.file(GIVEN, name).unlink(missing_ok=True)
        return made

    def held(self, name: str) -> frozenset[str]:
        """What a dropped file says that it holds: joints, points, both or neither."""
        return held_in(*mark(self.file(GIVEN, name)))

    def remove(self, name: str) -> Choices:
        """Remove a file that was dropped, and every choice of it.  Raises OptionError."""
        path = self.file(GIVEN, name)
        made = self.choose(self.choices.without(name))
        path.unlink(missing_ok=True)
        return made

    def files(self) -> list[Path]:
        """What the commands wrote."""
        return sorted(p for p in self.folder.iterdir() if is_whole(p) and p.name != CHOICES)

    def digest(self, path: str) -> str:
        """SHA-256 of a file of the session, empty where there is none."""
        where = self.folder / path
        return digest_of(*mark(where)) if where.is_file() else ""

    def stamp(self) -> tuple[tuple[str, int, int], ...]:
        """Changes whenever a file of the session does."""
        every = (self.folder, self.folder / GIVEN, self.folder / LOG)
        there = [folder for folder in every if folder.is_dir()]
        found = [path for folder in there for path in folder.iterdir() if is_whole(path)]
        return tuple(sorted(map(mark, found)))


def mark(path: Path) -> tuple[str, int, int]:
    """What changes when a file does: name, moment and length."""
    try:
        stat = path.stat()
    except OSError:  # just removed
        return str(path), 0, 0
    return str(path), stat.st_mtime_ns, stat.st_size


@lru_cache(maxsize=256)
def digest_of(path: str, moment: int, size: int) -> str:
    """SHA-256 of a file as it was at a moment."""
    with open(path, "rb") as stream:
        return file_digest(stream, "sha256").hexdigest()


@lru_cache(maxsize=256)
def held_in(path: str, moment: int, size: int) -> frozenset[str]:
    """Which of joints and points a file has by its own header as it was at a moment."""
    try:
        found = read_any(path, Given())
    except CalibrationError:
        return frozenset()
    kinds = {"joints": found.joints, "points": found.smrs}
    return frozenset(kind for kind, some in kinds.items() if some and found.sheet.header)


def is_whole(path: Path) -> bool:
    """Whether a path is a whole file of the session: hidden ones are being written."""
    return not path.name.startswith(".") and path.is_file()


def plain_name(name: str) -> str:
    """A file's name, if it is no more than that.  Raises OptionError."""
    shown = one_line(name)[:60]
    if "/" in name or "\\" in name or name in (".", ".."):
        raise OptionError(f"file name {shown!r}: holds a path; give the name alone")
    long = len(name.encode("utf-8", "replace")) > MAX_NAME_BYTES
    if long or not NAME.fullmatch(name) or RESERVED.fullmatch(name) or name[-1] in " .":
        raise OptionError(
            f"file name {shown!r}: rename it; letters, digits and _-+.()@= serve, 120 at most"
        )
    return name


def session(root: Path, name: str) -> Session:
    """A session that is there.  Raises OptionError."""
    folder = root / name
    if not SESSION.fullmatch(name) or not (folder / GIVEN).is_dir():
        raise OptionError(f"no session {one_line(name)[:60]!r}")
    return Session(folder)


def sessions(root: Path) -> list[Session]:
    """All sessions, the latest first."""
    found = [Session(p) for p in root.iterdir() if SESSION.fullmatch(p.name) and has_given(p)]
    return sorted(found, key=lambda one: one.folder.stat().st_mtime, reverse=True)


def remove_parts(root: Path) -> None:
    """Remove files that a server began to write and that nobody has written to for long."""
    for one in sessions(root):
        for path in (*one.folder.glob(".*"), *(one.folder / GIVEN).glob(".*")):
            with suppress(OSError):
                if time.time() - path.stat().st_mtime > ABANDONED:
                    path.unlink()


def has_given(path: Path) -> bool:
    """Whether a folder is one of a session."""
    return (path / GIVEN).is_dir()


def new_session(root: Path, title: str) -> Session:
    """A new folder, called after a title, or the day.  Raises CalibrationError."""
    words = re.sub(r"[^a-z0-9]+", "-", title.lower()).strip("-")[:40].strip("-")
    stem = words or time.strftime("%Y-%m-%d")
    if RESERVED.fullmatch(stem):
        stem = f"session-{stem}"
    taken = {path.name.casefold() for path in root.iterdir()}
    numbered = (f"{stem}-{i}" for i in count(2))
    folder = root / next(name for name in chain([stem], numbered) if name not in taken)
    made: list[Path] = []
    try:
        for each in (folder, folder / GIVEN, folder / LOG):
            each.mkdir(mode=0o700)
            made.append(each)
    except OSError as error:
        for each in reversed(made):
            each.rmdir()
        raise CalibrationError(f"{folder}: cannot be made ({error.strerror})") from error
    return Session(folder)
