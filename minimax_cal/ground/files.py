"""Reading and writing whole files: an output is complete or absent."""

from __future__ import annotations

import csv
import errno
import io
import json
import math
import os
import tomllib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import is_dataclass
from pathlib import Path
from typing import IO, Any

import numpy as np

from minimax_cal.ground.arrays import Array
from minimax_cal.ground.errors import CalibrationError, OptionError
from minimax_cal.ground.facts import Later, in_file
from minimax_cal.ground.journal import hidden_name, keep_old

LARGEST = 1 << 30  # bytes of a file that is read: a million poses take a quarter of this
NO_FSYNC = "MINIMAX_CAL_NO_FSYNC"  # "1" in the environment of studies that write many files
CANNOT_SYNC = (errno.EINVAL, errno.ENOSYS, errno.ENOTSUP)  # of file systems without fsync
MOST = 1e100  # no number of a result is larger; squares and products of these still are numbers


def write_whole(path: Path | str, content: str | bytes) -> None:
    """Write content to path in one step: a reader sees the old file or the new one.

    So does who starts the machine again after a power cut: file and folder are on the disk before
    this returns.  Raises CalibrationError when the folder does not exist or cannot be written.
    """
    path = resolved(path)  # a link keeps pointing at what is written
    raw = content.encode("utf-8") if isinstance(content, str) else content
    if path.exists() and not path.is_file():
        write_into(path, raw)
        return
    with hidden_part(path) as (handle, part):
        try:
            with os.fdopen(handle, "wb") as stream:
                stream.write(raw)
                put_on_disk(stream)
            os.chmod(part, mode_of(path))
            keep_old(path)
            replace_on_disk(part, path)
        except OSError as error:
            raise CalibrationError(f"{path}: cannot be written ({error.strerror})") from error


def put_on_disk(stream: IO[bytes]) -> None:
    """Flush what was written to an open file as far as the disk.  Raises OSError."""
    stream.flush()
    if os.environ.get(NO_FSYNC) == "1":
        return
    try:
        os.fsync(stream.fileno())
    except OSError as error:
        if error.errno not in CANNOT_SYNC:
            raise


def replace_on_disk(source: Path | str, path: Path) -> None:
    """Give a file another's name, and put the folder with that name on the disk.

    Without the second a power cut can bring back the old entry [fsync(2), Linux].  Windows cannot
    open a folder, and its file systems keep a journal of names.  Raises OSError.
    """
    os.replace(source, path)
    if os.environ.get(NO_FSYNC) == "1" or os.name == "nt":
        return
    folder = os.open(path.parent, os.O_RDONLY)
    try:
        os.fsync(folder)
    except OSError as error:
        if error.errno not in CANNOT_SYNC:
            raise
    finally:
        os.close(folder)


@contextmanager
def hidden_part(path: Path) -> Iterator[tuple[int, Path]]:
    """A new private file in the folder of a path, open, and its name.  Raises CalibrationError.

    In the end it is gone, unless it has another name by then: the name is known before the file is
    there, so that no signal can leave it behind.
    """
    part = hidden_name(path)
    flags = os.O_CREAT | os.O_EXCL | os.O_WRONLY | getattr(os, "O_BINARY", 0)
    try:
        try:
            handle = os.open(part, flags, 0o600)
        except OSError as error:
            raise CalibrationError(f"{path}: cannot be written ({error.strerror})") from error
        yield handle, part
    finally:
        with suppress(OSError):  # a folder that cannot be written holds no part
            part.unlink(missing_ok=True)


def resolved(path: Path | str) -> Path:
    """Where a path leads.  Raises CalibrationError for links in a circle and names too long."""
    try:
        there = Path(path).resolve()
        there.exists()
    except (OSError, RuntimeError) as error:
        long = isinstance(error, OSError) and error.errno == errno.ENAMETOOLONG
        why = "its name is too long" if long else "its links lead nowhere"
        raise CalibrationError(f"{path}: cannot be written ({why})") from error
    return there


def mode_of(path: Path) -> int:
    """The permissions of a file that is there, else those of any new one."""
    if path.exists():
        return path.stat().st_mode & 0o777
    umask = os.umask(0)
    os.umask(umask)
    return 0o666 & ~umask


def write_into(path: Path, raw: bytes) -> None:
    """Write to what is no regular file: a pipe or a device, never replaced."""
    try:
        with path.open("wb") as stream:
            stream.write(raw)
    except OSError as error:
        raise CalibrationError(f"{path}: cannot be written ({error.strerror})") from error


def check_writable(path: Path | str, suffixes: tuple[str, ...] = ()) -> None:
    """Raise CalibrationError now, before the work, if path cannot be written later.

    suffixes: the endings that are allowed, any if empty.
    """
    path = Path(path)
    if suffixes and path.suffix.lower() not in suffixes:
        raise CalibrationError(f"{path}: the file's ending must be one of {', '.join(suffixes)}")
    there = resolved(path)
    if there.is_dir():
        raise CalibrationError(f"{path}: is a folder; name a file")
    if not there.parent.is_dir():
        raise CalibrationError(f"{path}: cannot be written (there is no such folder)")
    if there.is_file() or not there.exists():  # no pipe and no device
        with hidden_part(there) as (handle, _):
            os.close(handle)


def made_folder(path: Path) -> Path:
    """The folder, made where it is not there.  Raises CalibrationError."""
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise CalibrationError(f"{path}: cannot be made ({error.strerror})") from error
    return path


def json_text(content: object) -> str:
    """JSON as this project writes it; NaN, which JSON does not know, raises ValueError."""
    return json.dumps(content, indent=1, allow_nan=False) + "\n"


def csv_text(rows: Iterable[Sequence[object]]) -> str:
    """CSV as this project writes it, the header first."""
    stream = io.StringIO()
    csv.writer(stream, lineterminator="\n").writerows(rows)
    return stream.getvalue()


def json_of(text: str | bytes) -> Any:
    """JSON whose every key stands once, of numbers to reckon with; NaN and Infinity are no JSON.

    Raises ValueError, also for lists in lists that Python's stack cannot hold.
    """
    try:
        return json.loads(
            text,
            parse_constant=refuse,
            object_pairs_hook=once,
            parse_float=within,
            parse_int=within,
        )
    except RecursionError as error:
        raise ValueError("its lists and objects are nested too deep") from error


def within(text: str) -> float:
    """A number, an integer where it is one.  Raises ValueError beyond MOST."""
    value = float(text)
    if not abs(value) <= MOST:
        raise ValueError(f"the number {text[:20]} cannot be; at most {MOST:g}")
    return int(text) if text.lstrip("-").isdigit() else value


def refuse(constant: str) -> float:
    """NaN and Infinity are no JSON."""
    raise ValueError(f"{constant} is not a number that JSON knows")


def once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """An object, if no key stands twice: which of the two would count?  Raises ValueError."""
    out = dict(pairs)
    if len(out) < len(pairs):
        keys = [key for key, _ in pairs]
        twice = next(key for key in keys if keys.count(key) > 1)
        raise ValueError(f"the key {twice[:60]!r} stands twice")
    return out


def plain(content: Any) -> Any:
    """Data as JSON holds them: arrays are lists, records their fields, null no finite number."""
    if isinstance(content, Later):
        content = content.value
    if hasattr(content, "to_dict"):
        content = content.to_dict()
    elif is_dataclass(content) and not isinstance(content, type):
        content = in_file(content)
    elif hasattr(content, "_asdict"):
        content = content._asdict()
    if isinstance(content, Mapping):
        return {key: plain(value) for key, value in content.items()}
    if isinstance(content, np.ndarray | np.generic):
        content = content.tolist()
    if isinstance(content, list | tuple):
        return [plain(value) for value in content]
    return None if isinstance(content, float) and not math.isfinite(content) else content


def read_raw(
    path: Path | str, *, kind: type[CalibrationError] = CalibrationError, most: int = LARGEST
) -> bytes:
    """The bytes of a file or a pipe, no more than any result has; errors as `read_text`."""
    try:
        with Path(path).open("rb") as stream:
            raw = stream.read(most + 1)
    except OSError as error:
        raise kind(f"{path}: cannot be read ({error.strerror})") from error
    if len(raw) > most:
        raise kind(f"{path}: is larger than {most >> 20} MiB; split it, or check the name")
    return raw


def read_text(path: Path | str, *, kind: type[CalibrationError] = CalibrationError) -> str:
    """The text of a UTF-8 file, without a leading byte order mark; errors are of the kind given."""
    return text_of(read_raw(path, kind=kind), path, kind=kind)


def text_of(raw: bytes, path: Path | str, *, kind: type[CalibrationError]) -> str:
    """The text of the bytes of a file; as `read_text`."""
    try:
        text = raw.decode("utf-8-sig")
        return text.replace("\r\n", "\n").replace("\r", "\n")
    except UnicodeDecodeError as error:
        raise kind(f"{path}: is not UTF-8 text (byte {error.start}); save it as UTF-8") from error


class NotSaved(CalibrationError):
    """A file that holds no saved result."""


def saved_content(path: Path | str) -> Mapping[str, Any]:
    """The JSON of a saved result.  Raises NotSaved."""
    try:
        content = json_of(read_text(path, kind=NotSaved))
    except (ValueError, RecursionError) as error:
        raise NotSaved(f"{path}: is not JSON ({error})") from error
    if not isinstance(content, Mapping):
        raise NotSaved(f"{path}: is not a saved calibration")
    return content


def read_toml(path: Path | str) -> dict[str, Any]:
    """The content of a TOML file.  Raises OptionError."""
    text = read_text(path, kind=OptionError)
    try:
        return tomllib.loads(text)
    except (ValueError, RecursionError) as error:  # numbers too long, tables too deep
        raise OptionError(f"{path}: is not TOML ({error})") from error


def finite(value: float) -> float | None:
    """For JSON: null where there is no finite number."""
    return value if math.isfinite(value) else None


def numbers(values: Any) -> Array:
    """An array of floats from JSON, NaN for null."""
    return np.array(values, dtype=float)


def number(value: float | None) -> float:
    """A number of a JSON; null is NaN."""
    return math.nan if value is None else float(value)
