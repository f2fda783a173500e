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
from typing import Annotated, Any, Literal, NamedTuple

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from minimax_cal.core.display_text import (
    clean_and_shorten_to_one_line,
    replace_invisible_and_bidi_characters,
)
from minimax_cal.core.errors import CalibrationError, OptionError
from minimax_cal.core.files import format_json, parse_json, read_bytes, write_file_atomically
from minimax_cal.measuring.importers import read_in_first_fitting_format
from minimax_cal.measuring.importers.column_tables import ImportOptions
from minimax_cal.measuring.set_aside_points import MAX_REASON_LETTERS, SET_ASIDE_POINT_PATTERN
from minimax_cal.robots.robot import builtin_robots

UPLOAD_FOLDER, LOG_FOLDER = (
    "given",
    "log",
)  # folders of a session: what people dropped, how each step ended
CHOICES_FILE, SCRIPT_FILE = "session.json", "commands.sh"
MAX_UPLOADED_FILE_BYTES = 256 << 20  # of a file that is dropped: a million poses
MAX_UPLOADED_FILES, MAX_SESSION_BYTES = 200, 1 << 30  # of a session: how many, and their bytes
MAX_LEFT_OUT_POINTS = (
    1000  # points that are set aside one by one; their names fit on a command line
)
MAX_FILE_NAME_BYTES = (
    200  # of a dropped file; file systems take 255, of which a hidden part needs some
)
ABANDONED_FILE_SECONDS = 3600.0  # [s]; 256 MiB take less on any line to this machine itself
FILE_NAME_PATTERN = re.compile(r"[\w(][\w .()+@=-]{0,119}")
# Devices of Windows, whatever the ending [Microsoft, Naming Files, Paths, and Namespaces].
RESERVED_NAME_PATTERN = re.compile(
    r"(con|prn|aux|nul|(com|lpt)[\d\u00b9\u00b2\u00b3]) *(\..*)?", re.I
)
SESSION_NAME_PATTERN = re.compile(r"[a-z0-9][a-z0-9-]{0,59}")

LimitMm = Annotated[float, Field(gt=0.0, le=1e6)] | None
ShortText = Annotated[str, Field(max_length=2000, pattern=r"^[^\x00-\x1f\x7f]*$")]
PointName = Annotated[str, Field(max_length=40)]
PointText = Annotated[PointName, Field(pattern=f"^{SET_ASIDE_POINT_PATTERN.pattern}$")]
ReasonText = Annotated[str, Field(max_length=MAX_REASON_LETTERS, pattern=r"^[^\x00-\x1f\x7f]*$")]


FileContentKinds = Mapping[str, Iterable[str]]  # of dropped files: joints, points, both or neither


class SessionChoices(BaseModel):
    """What people chose on the page.

    robot: a built-in name, or a file that was dropped.  measured, targets: such files; joints: that
    of them which holds joint values.  left_out: points, as `--leave-out` names them; reasons: why,
    by point.  rms, most: what is required [mm].
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    robot: ShortText = ""
    measured: Annotated[tuple[ShortText, ...], Field(max_length=MAX_UPLOADED_FILES)] = ()
    joints: ShortText = ""
    targets: ShortText = ""
    units: ShortText = ""
    columns: ShortText = ""
    layout: Literal["", "pose", "target"] = ""
    decimal: Literal["", "point", "comma"] = ""
    left_out: Annotated[tuple[PointText, ...], Field(max_length=MAX_LEFT_OUT_POINTS)] = ()
    reasons: Annotated[dict[PointName, ReasonText], Field(max_length=MAX_LEFT_OUT_POINTS)] = {}
    objective: Literal["minimax", "sum", "point"] = "minimax"
    effects: bool = False
    quick: bool = False
    rms: LimitMm = None
    most: LimitMm = None
    claim: Literal["inside", "outside"] = "inside"
    poses: Annotated[int, Field(ge=1, le=1000)] = 20

    def named_files(self) -> set[str]:
        """The dropped files that are named somewhere."""
        return {*self.measured, self.joints, self.targets, self.robot}

    def changes_without_file(self, file_name: str) -> dict[str, Any]:
        """The changes that leave a file out of every choice."""
        left = {
            key: "" for key in ("robot", "joints", "targets") if getattr(self, key) == file_name
        }
        return {"measured": [one for one in self.measured if one != file_name], **left}


@dataclass(frozen=True)
class Session:
    """A folder: files that people dropped, what the commands wrote, and the choices."""

    folder: Path

    @property
    def name(self) -> str:
        """As the address of its page has it."""
        return self.folder.name

    @property
    def choices(self) -> SessionChoices:
        """Those made so far.  Raises OptionError for a file that holds none."""
        path = self.folder / CHOICES_FILE
        if not path.exists():
            return SessionChoices()
        try:
            return SessionChoices.model_validate(parse_json(read_bytes(path)))
        except ValueError as error:
            raise OptionError(f"{path}: holds no choices of a session; remove it") from error

    def update_choices(self, changes: Mapping[str, Any]) -> SessionChoices:
        """Make choices.  Raises OptionError; then nothing changes."""
        made = self.validate_changes(changes)
        write_file_atomically(self.folder / CHOICES_FILE, format_json(made.model_dump(mode="json")))
        return made

    def validate_changes(self, changes: Mapping[str, Any]) -> SessionChoices:
        """The choices with changes, of files that are there.  Raises OptionError."""
        now = self.choices
        whole = {**now.model_dump(), **changes}
        try:
            made = SessionChoices.model_validate(whole)
        except ValidationError as error:
            first = error.errors()[0]
            where = ".".join(map(str, first["loc"]))
            raise OptionError(clean_and_shorten_to_one_line(f"{where}: {first['msg']}")) from error
        for name in (
            made.named_files() - now.named_files()
        ):  # of one that is gone since, its command will say
            known = name in builtin_robots() and name == made.robot
            if name and not known and not self.resolve_file(UPLOAD_FOLDER, name).is_file():
                raise OptionError(
                    f"{replace_invisible_and_bidi_characters(name)}: was not dropped here"
                )
        return made

    def resolve_file(self, *parts: str) -> Path:
        """A file of the session.  Raises OptionError for a name that leads out of its folder."""
        *folders, name = parts
        if folders not in ([], [UPLOAD_FOLDER], [LOG_FOLDER]):
            raise OptionError("a session has no such folder")
        path = self.folder.joinpath(*folders, check_file_name(name))
        if not path.resolve().is_relative_to(self.folder.resolve()):
            raise OptionError(f"{name}: leads out of the session's folder")
        return path

    def list_uploaded_files(self) -> list[str]:
        """Names of the files that were dropped."""
        return sorted(
            path.name for path in (self.folder / UPLOAD_FOLDER).iterdir() if is_complete_file(path)
        )

    def available_bytes(self, file_name: str) -> int:
        """How many bytes a file may have that is dropped now.  Raises OptionError for none.

        Files that are being written count with the length that they are to have.
        """
        others = [
            path for path in (self.folder / UPLOAD_FOLDER).iterdir() if path.name != file_name
        ]
        left = MAX_SESSION_BYTES - sum(file_version(path)[2] for path in others)
        if len(others) >= MAX_UPLOADED_FILES or left <= 0:
            most = f"{MAX_UPLOADED_FILES} files and {MAX_SESSION_BYTES >> 30} GiB"
            raise OptionError(f"a session holds {most}; remove some, or begin another")
        return min(MAX_UPLOADED_FILE_BYTES, left)

    def reserve_upload_file(self, file_name: str, byte_count: int) -> Path:
        """A new hidden file as long as what will be written into it, so that others count it."""
        path = self.folder / UPLOAD_FOLDER / f".{file_name}.{os.urandom(4).hex()}"
        with open(os.open(path, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o600), "wb") as stream:
            stream.truncate(byte_count)
        return path

    def choose_files_and_delete_replaced(
        self, purpose: str, file_names: Sequence[str], content_kinds: FileContentKinds
    ) -> SessionChoices:
        """Choose files that were dropped at once; they replace what they cannot stand beside.

        purpose: measured, robot or targets.  content_kinds: of the measured files, old and new, as
        `read_content_kinds` says.  Of measured files, those go that hold joint values, or points,
        as one of the new does that can be read.  Raises OptionError; then nothing changes.
        """
        now = self.choices
        new = {content for name in file_names for content in content_kinds.get(name, ())}
        replaced = {
            "measured": {name for name in now.measured if new & {*content_kinds.get(name, ())}},
            "robot": set[str](),  # which can be chosen again
            "targets": {now.targets} - {""},
        }
        if purpose not in replaced or not file_names:
            raise OptionError("name the files, and what they are for")
        gone = replaced[purpose] - {*file_names}
        stay = [name for name in now.measured if name not in gone]
        chosen = [*dict.fromkeys([*stay, *file_names])] if purpose == "measured" else file_names[0]
        left = {key: "" for key in ("robot", "joints", "targets") if getattr(now, key) in gone}
        made = self.update_choices({**left, "measured": stay, purpose: chosen})
        for name in gone:
            self.resolve_file(UPLOAD_FOLDER, name).unlink(missing_ok=True)
        return made

    def read_content_kinds(self, file_name: str) -> frozenset[str]:
        """What a dropped file says that it holds: joints, points, both or neither."""
        return content_kinds_of_file_version(
            *file_version(self.resolve_file(UPLOAD_FOLDER, file_name))
        )

    def remove_uploaded_file(self, file_name: str) -> SessionChoices:
        """Remove a file that was dropped, and every choice of it.  Raises OptionError."""
        path = self.resolve_file(UPLOAD_FOLDER, file_name)
        made = self.update_choices(self.choices.changes_without_file(file_name))
        path.unlink(missing_ok=True)
        return made

    def list_written_files(self) -> list[Path]:
        """What the commands wrote."""
        return sorted(
            p for p in self.folder.iterdir() if is_complete_file(p) and p.name != CHOICES_FILE
        )

    def file_sha256(self, path: str) -> str:
        """SHA-256 of a file of the session, empty where there is none."""
        where = self.folder / path
        return sha256_of_file_version(*file_version(where)) if where.is_file() else ""

    def list_file_versions(self) -> tuple[FileVersion, ...]:
        """Versions of all files of the session, sorted; they differ once a file has changed."""
        every = (self.folder, self.folder / UPLOAD_FOLDER, self.folder / LOG_FOLDER)
        there = [folder for folder in every if folder.is_dir()]
        found = [path for folder in there for path in folder.iterdir() if is_complete_file(path)]
        return tuple(sorted(map(file_version, found)))


def file_version(path: Path) -> FileVersion:
    """Path, time of modification and length of a file; zeros of a file that is gone."""
    try:
        stat = path.stat()
    except OSError:  # just removed
        return FileVersion(str(path), 0, 0)
    return FileVersion(str(path), stat.st_mtime_ns, stat.st_size)


class FileVersion(NamedTuple):
    """A file as it was at a moment."""

    path: str
    modified_ns: int
    byte_count: int


@lru_cache(maxsize=256)
def sha256_of_file_version(path: str, modified_ns: int, byte_count: int) -> str:
    """SHA-256 of a file as it was at a moment."""
    with open(path, "rb") as stream:
        return file_digest(stream, "sha256").hexdigest()


@lru_cache(maxsize=256)
def content_kinds_of_file_version(path: str, modified_ns: int, byte_count: int) -> frozenset[str]:
    """Which of joints and points a file has by its own header as it was at a moment."""
    try:
        found = read_in_first_fitting_format(path, ImportOptions())
    except CalibrationError:
        return frozenset()
    kinds = {"joints": found.joint_columns, "points": found.target_numbers}
    return frozenset(kind for kind, some in kinds.items() if some and found.sheet.header)


def is_complete_file(path: Path) -> bool:
    """Whether a path is a whole file of the session: hidden ones are being written."""
    return not path.name.startswith(".") and path.is_file()


def check_file_name(name: str) -> str:
    """A file's name, if it is no more than that.  Raises OptionError."""
    shown = clean_and_shorten_to_one_line(name)[:60]
    if "/" in name or "\\" in name or name in (".", ".."):
        raise OptionError(f"file name {shown!r}: holds a path; give the name alone")
    long = len(name.encode("utf-8", "replace")) > MAX_FILE_NAME_BYTES
    if (
        long
        or not FILE_NAME_PATTERN.fullmatch(name)
        or RESERVED_NAME_PATTERN.fullmatch(name)
        or name[-1] in " ."
    ):
        raise OptionError(
            f"file name {shown!r}: rename it; letters, digits and _-+.()@= serve, 120 at most"
        )
    return name


def open_session(sessions_folder: Path, session_name: str) -> Session:
    """A session that is there.  Raises OptionError."""
    folder = sessions_folder / session_name
    if not SESSION_NAME_PATTERN.fullmatch(session_name) or not (folder / UPLOAD_FOLDER).is_dir():
        raise OptionError(f"no session {clean_and_shorten_to_one_line(session_name)[:60]!r}")
    return Session(folder)


def list_sessions(sessions_folder: Path) -> list[Session]:
    """All sessions, the latest first."""
    found = [
        Session(p)
        for p in sessions_folder.iterdir()
        if SESSION_NAME_PATTERN.fullmatch(p.name) and is_session_folder(p)
    ]
    return sorted(found, key=lambda one: one.folder.stat().st_mtime, reverse=True)


def remove_abandoned_partial_files(sessions_folder: Path) -> None:
    """Remove files that a server began to write and that nobody has written to for long."""
    for one in list_sessions(sessions_folder):
        for path in (*one.folder.glob(".*"), *(one.folder / UPLOAD_FOLDER).glob(".*")):
            with suppress(OSError):
                if time.time() - path.stat().st_mtime > ABANDONED_FILE_SECONDS:
                    path.unlink()


def is_session_folder(path: Path) -> bool:
    """Whether a folder is one of a session."""
    return (path / UPLOAD_FOLDER).is_dir()


def create_session_folder(sessions_folder: Path, title: str) -> Session:
    """A new folder, called after a title, or the day.  Raises CalibrationError."""
    words = re.sub(r"[^a-z0-9]+", "-", title.lower()).strip("-")[:40].strip("-")
    stem = words or time.strftime("%Y-%m-%d")
    if RESERVED_NAME_PATTERN.fullmatch(stem):
        stem = f"session-{stem}"
    taken = {path.name.casefold() for path in sessions_folder.iterdir()}
    numbered = (f"{stem}-{i}" for i in count(2))
    folder = sessions_folder / next(name for name in chain([stem], numbered) if name not in taken)
    made: list[Path] = []
    try:
        for each in (folder, folder / UPLOAD_FOLDER, folder / LOG_FOLDER):
            each.mkdir(mode=0o700)
            made.append(each)
    except OSError as error:
        for each in reversed(made):
            each.rmdir()
        raise CalibrationError(f"{folder}: cannot be made ({error.strerror})") from error
    return Session(folder)
