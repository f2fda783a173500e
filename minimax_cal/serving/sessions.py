"""A session: a folder of plain files, which the command line reads as well."""

from __future__ import annotations

import os
import re
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import lru_cache
from hashlib import sha256
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
ABANDONED = 3600.0  # [s]; 256 MiB take less on any line to this machine itself
NAME = re.compile(r"[\w(][\w .()+@=-]{0,119}")
RESERVED = re.compile(r"(con|prn|aux|nul|com\d|lpt\d)(\..*)?", re.I)  # devices of Windows
SESSION = re.compile(r"[a-z0-9][a-z0-9-]{0,59}")

Limit = Annotated[float, Field(gt=0.0, le=1e6)] | None
Word = Annotated[str, Field(max_length=2000, pattern=r"^[^\x00-\x1f\x7f]*$")]
Reason = Annotated[str, Field(max_length=MOST_LETTERS, pattern=r"^[^\x00-\x1f\x7f]*$")]


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
    left_out: tuple[Annotated[str, Field(pattern=f"^{POINT.pattern}$", max_length=40)], ...] = ()
    reasons: dict[Annotated[str, Field(max_length=40)], Reason] = {}
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
        whole = {**self.choices.model_dump(), **changes}
        try:
            made = Choices.model_validate(whole)
        except ValidationError as error:
            first = error.errors()[0]
            where = ".".join(map(str, first["loc"]))
            raise OptionError(one_line(f"{where}: {first['msg']}")) from error
        for name in made.files():
            known = name in builtin_robots() and name == made.robot
            if name and not known and not self.file(GIVEN, name).is_file():
                raise OptionError(f"{visible(name)}: was not dropped here")
        write_whole(self.folder / CHOICES, json_text(made.model_dump(mode="json")))
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

    def take(self, kind: str, names: Sequence[str]) -> Choices:
        """Choose files that were dropped at once; they replace what they cannot stand beside.

        kind: measured, robot or targets.  Of measured files, those go that hold joint values, or
        points, as one of these does.  Raises OptionError.
        """
        now, new = self.choices, self.held(*names)
        gone = {
            "measured": [name for name in now.measured if self.held(name) & new],
            "robot": [],  # which can be chosen again
            "targets": [now.targets],
        }
        if kind not in gone or not names:
            raise OptionError("name the files, and what they are for")
        for name in {*gone[kind]} - {"", *names}:
            self.remove(name)
        every = list(dict.fromkeys([*self.choices.measured, *names]))
        return self.choose({kind: every if kind == "measured" else names[0]})

    def held(self, *names: str) -> frozenset[str]:
        """What dropped files say that they hold: joints, points, both or neither."""
        return frozenset().union(*(held_in(*mark(self.file(GIVEN, name))) for name in names))

    def remove(self, name: str) -> Choices:
        """Remove a file that was dropped, and every choice of it."""
        self.file(GIVEN, name).unlink(missing_ok=True)
        now = self.choices
        left = {key: "" for key in ("robot", "joints", "targets") if getattr(now, key) == name}
        return self.choose({"measured": [one for one in now.measured if one != name], **left})

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
    return sha256(Path(path).read_bytes()).hexdigest()


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
    if not NAME.fullmatch(name) or RESERVED.fullmatch(name) or name[-1] in " .":
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
        for path in (one.folder / GIVEN).glob(".*"):
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
    taken = {path.name for path in root.iterdir()}
    name = next(
        each for i in range(1, 10**6) if (each := stem if i == 1 else f"{stem}-{i}") not in taken
    )
    try:
        for folder in (root / name, root / name / GIVEN, root / name / LOG):
            folder.mkdir(mode=0o700)
    except OSError as error:
        raise CalibrationError(f"{root / name}: cannot be made ({error.strerror})") from error
    return Session(root / name)
