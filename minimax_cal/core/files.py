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
from typing import IO, Any, NamedTuple

import numpy as np

from minimax_cal.core.arrays import Array
from minimax_cal.core.errors import CalibrationError, OptionError
from minimax_cal.core.record_fields import LazyValue, record_to_file_values
from minimax_cal.core.write_journal import link_backup_in_journal, unused_hidden_path_in_folder_of

MAX_FILE_BYTES = 1 << 30  # bytes of a file that is read: a million poses take a quarter of this
NO_FSYNC_VARIABLE = (
    "MINIMAX_CAL_NO_FSYNC"  # "1" in the environment of studies that write many files
)
FSYNC_UNSUPPORTED_ERRNOS = (
    errno.EINVAL,
    errno.ENOSYS,
    errno.ENOTSUP,
)  # of file systems without fsync
MAX_JSON_NUMBER = (
    1e100  # no number of a result is larger; squares and products of these still are numbers
)


JsonValue = Any  # what JSON holds: object, list, text, number, truth value or None


def write_file_atomically(path: Path | str, content: str | bytes) -> None:
    """Write content to a path in one step: a reader sees the old file or the new one.

    So does who starts the machine again after a power cut: file and folder are on the disk before
    this returns.  Raises CalibrationError when the folder does not exist or cannot be written.
    """
    path = resolve_output_path(path)  # a link keeps pointing at what is written
    raw = content.encode("utf-8") if isinstance(content, str) else content
    if path.exists() and not path.is_file():
        write_to_pipe_or_device(path, raw)
        return
    with create_temporary_file_in_folder_of(path) as (handle, part):
        try:
            with os.fdopen(handle, "wb") as stream:
                stream.write(raw)
                flush_to_disk(stream)
            os.chmod(part, file_mode_or_umask_default(path))
            link_backup_in_journal(path)
            replace_file_durably(part, path)
        except OSError as error:
            raise CalibrationError(f"{path}: cannot be written ({error.strerror})") from error


def flush_to_disk(stream: IO[bytes]) -> None:
    """Flush what was written to an open file as far as the disk.  Raises OSError."""
    stream.flush()
    if os.environ.get(NO_FSYNC_VARIABLE) == "1":
        return
    try:
        os.fsync(stream.fileno())
    except OSError as error:
        if error.errno not in FSYNC_UNSUPPORTED_ERRNOS:
            raise


def replace_file_durably(new_file: Path | str, path: Path) -> None:
    """Give a file another's name, and put the folder with that name on the disk.

    Without the second a power cut can bring back the old entry [fsync(2), Linux].  Windows cannot
    open a folder, and its file systems keep a journal of names.  Raises OSError.
    """
    os.replace(new_file, path)
    if os.environ.get(NO_FSYNC_VARIABLE) == "1" or os.name == "nt":
        return
    folder = os.open(path.parent, os.O_RDONLY)
    try:
        os.fsync(folder)
    except OSError as error:
        if error.errno not in FSYNC_UNSUPPORTED_ERRNOS:
            raise
    finally:
        os.close(folder)


class TemporaryFile(NamedTuple):
    """An open file and its path."""

    descriptor: int
    path: Path


@contextmanager
def create_temporary_file_in_folder_of(path: Path) -> Iterator[TemporaryFile]:
    """Create a private, empty file in the folder of a path.  Raises CalibrationError.

    In the end it is gone, unless it has another name by then: the name is known before the file is
    there, so that no signal can leave it behind.
    """
    part = unused_hidden_path_in_folder_of(path)
    flags = os.O_CREAT | os.O_EXCL | os.O_WRONLY | getattr(os, "O_BINARY", 0)
    try:
        try:
            handle = os.open(part, flags, 0o600)
        except OSError as error:
            raise CalibrationError(f"{path}: cannot be written ({error.strerror})") from error
        yield TemporaryFile(handle, part)
    finally:
        with suppress(OSError):  # a folder that cannot be written holds no part
            part.unlink(missing_ok=True)


def resolve_output_path(path: Path | str) -> Path:
    """Where a path leads.  Raises CalibrationError for links in a circle and names too long."""
    try:
        there = Path(path).resolve()
        there.exists()
    except (OSError, RuntimeError) as error:
        long = isinstance(error, OSError) and error.errno == errno.ENAMETOOLONG
        why = "its name is too long" if long else "its links lead nowhere"
        raise CalibrationError(f"{path}: cannot be written ({why})") from error
    return there


def file_mode_or_umask_default(path: Path) -> int:
    """The permissions of a file that is there, else those of any new one."""
    if path.exists():
        return path.stat().st_mode & 0o777
    umask = os.umask(0)
    os.umask(umask)
    return 0o666 & ~umask


def write_to_pipe_or_device(path: Path, content: bytes) -> None:
    """Write to what is no regular file: a pipe or a device, never replaced."""
    try:
        with path.open("wb") as stream:
            stream.write(content)
    except OSError as error:
        raise CalibrationError(f"{path}: cannot be written ({error.strerror})") from error


def check_output_path(path: Path | str, allowed_suffixes: tuple[str, ...] = ()) -> None:
    """Raise CalibrationError now, before the work, if path cannot be written later.

    allowed_suffixes: the endings that are allowed, any if empty.
    """
    path = Path(path)
    if allowed_suffixes and path.suffix.lower() not in allowed_suffixes:
        raise CalibrationError(
            f"{path}: the file's ending must be one of {', '.join(allowed_suffixes)}"
        )
    there = resolve_output_path(path)
    if there.is_dir():
        raise CalibrationError(f"{path}: is a folder; name a file")
    if not there.parent.is_dir():
        raise CalibrationError(f"{path}: cannot be written (there is no such folder)")
    if there.is_file() or not there.exists():  # no pipe and no device
        with create_temporary_file_in_folder_of(there) as (handle, _):
            os.close(handle)


def create_folder(path: Path) -> Path:
    """The folder, made where it is not there.  Raises CalibrationError."""
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise CalibrationError(f"{path}: cannot be made ({error.strerror})") from error
    return path


def format_json(content: object) -> str:
    """JSON as this project writes it; NaN, which JSON does not know, raises ValueError."""
    return json.dumps(content, indent=1, allow_nan=False) + "\n"


def format_csv(rows: Iterable[Sequence[object]]) -> str:
    """CSV as this project writes it, the header first."""
    stream = io.StringIO()
    csv.writer(stream, lineterminator="\n").writerows(rows)
    return stream.getvalue()


def parse_json(text: str | bytes) -> JsonValue:
    """JSON whose every key stands once, of numbers to reckon with; NaN and Infinity are no JSON.

    Raises ValueError, also for lists in lists that Python's stack cannot hold.
    """
    try:
        return json.loads(
            text,
            parse_constant=reject_json_constant,
            object_pairs_hook=build_object_with_unique_keys,
            parse_float=parse_json_number,
            parse_int=parse_json_number,
        )
    except RecursionError as error:
        raise ValueError("its lists and objects are nested too deep") from error


def parse_json_number(text: str) -> float:
    """A number, an integer where it is one.  Raises ValueError beyond MOST."""
    value = float(text)
    if not abs(value) <= MAX_JSON_NUMBER:
        raise ValueError(f"the number {text[:20]} cannot be; at most {MAX_JSON_NUMBER:g}")
    return int(text) if text.lstrip("-").isdigit() else value


def reject_json_constant(constant: str) -> float:
    """NaN and Infinity are no JSON."""
    raise ValueError(f"{constant} is not a number that JSON knows")


def build_object_with_unique_keys(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """An object, if no key stands twice: which of the two would count?  Raises ValueError."""
    out = dict(pairs)
    if len(out) < len(pairs):
        keys = [key for key, _ in pairs]
        twice = next(key for key in keys if keys.count(key) > 1)
        raise ValueError(f"the key {twice[:60]!r} stands twice")
    return out


def convert_to_plain_json(content: Any) -> JsonValue:
    """Data as JSON holds them: arrays are lists, records their fields, null no finite number."""
    if isinstance(content, LazyValue):
        content = content.value
    if hasattr(content, "to_dict"):
        content = content.to_dict()
    elif is_dataclass(content) and not isinstance(content, type):
        content = record_to_file_values(content)
    elif hasattr(content, "_asdict"):
        content = content._asdict()
    if isinstance(content, Mapping):
        return {key: convert_to_plain_json(value) for key, value in content.items()}
    if isinstance(content, np.ndarray | np.generic):
        content = content.tolist()
    if isinstance(content, list | tuple):
        return [convert_to_plain_json(value) for value in content]
    return None if isinstance(content, float) and not math.isfinite(content) else content


def read_bytes(
    path: Path | str,
    *,
    error_type: type[CalibrationError] = CalibrationError,
    max_bytes: int = MAX_FILE_BYTES,
) -> bytes:
    """The bytes of a file or a pipe, no more than any result has; errors as `read_text`."""
    try:
        with Path(path).open("rb") as stream:
            raw = stream.read(max_bytes + 1)
    except OSError as error:
        raise error_type(f"{path}: cannot be read ({error.strerror})") from error
    if len(raw) > max_bytes:
        raise error_type(
            f"{path}: is larger than {max_bytes >> 20} MiB; split it, or check the name"
        )
    return raw


def read_text(path: Path | str, *, error_type: type[CalibrationError] = CalibrationError) -> str:
    """The text of a UTF-8 file, without a leading byte order mark; errors are of the kind given."""
    return decode_utf8_text(read_bytes(path, error_type=error_type), path, error_type=error_type)


def decode_utf8_text(raw: bytes, path: Path | str, *, error_type: type[CalibrationError]) -> str:
    """The text of the bytes of a file; as `read_text`."""
    try:
        text = raw.decode("utf-8-sig")
        return text.replace("\r\n", "\n").replace("\r", "\n")
    except UnicodeDecodeError as error:
        raise error_type(
            f"{path}: is not UTF-8 text (byte {error.start}); save it as UTF-8"
        ) from error


class NotSavedResultError(CalibrationError):
    """A file that holds no saved result."""


def read_saved_result_json(path: Path | str) -> Mapping[str, JsonValue]:
    """The JSON of a saved result.  Raises NotSaved."""
    try:
        content = parse_json(read_text(path, error_type=NotSavedResultError))
    except (ValueError, RecursionError) as error:
        raise NotSavedResultError(f"{path}: is not JSON ({error})") from error
    if not isinstance(content, Mapping):
        raise NotSavedResultError(f"{path}: is not a saved calibration")
    return content


def read_toml(path: Path | str) -> dict[str, Any]:
    """The content of a TOML file.  Raises OptionError."""
    text = read_text(path, error_type=OptionError)
    try:
        return tomllib.loads(text)
    except (ValueError, RecursionError) as error:  # numbers too long, tables too deep
        raise OptionError(f"{path}: is not TOML ({error})") from error


def finite_or_none(value: float) -> float | None:
    """For JSON: null where there is no finite number."""
    return value if math.isfinite(value) else None


def array_from_json(values: Any) -> Array:
    """An array of floats from JSON, NaN for null."""
    return np.array(values, dtype=float)


def float_from_json(value: float | None) -> float:
    """A number of a JSON; null is NaN."""
    return math.nan if value is None else float(value)
