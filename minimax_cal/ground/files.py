"""Reading and writing whole files: an output is complete or absent."""

from __future__ import annotations

import json
import math
import os
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from minimax_cal.ground.arrays import Array
from minimax_cal.ground.errors import CalibrationError


def write_whole(path: Path | str, content: str | bytes) -> None:
    """Write content to path in one step: a reader sees the old file or the new one.

    Raises CalibrationError when the folder does not exist or cannot be written.
    """
    path = Path(path).resolve()  # a link keeps pointing at what is written
    raw = content.encode("utf-8") if isinstance(content, str) else content
    if path.exists() and not path.is_file():
        write_into(path, raw)
        return
    try:
        handle, name = tempfile.mkstemp(prefix=f".{path.name}.", dir=path.parent)
    except OSError as error:
        raise CalibrationError(f"{path}: cannot be written ({error.strerror})") from error
    try:
        with os.fdopen(handle, "wb") as stream:
            stream.write(raw)
        umask = os.umask(0)
        os.umask(umask)
        os.chmod(name, 0o666 & ~umask)  # mkstemp is private; a result is an ordinary file
        os.replace(name, path)
    except OSError as error:
        Path(name).unlink(missing_ok=True)
        raise CalibrationError(f"{path}: cannot be written ({error.strerror})") from error


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
    if path.is_dir():
        raise CalibrationError(f"{path}: is a folder; name a file")
    if not path.resolve().parent.is_dir():
        raise CalibrationError(f"{path}: cannot be written (there is no such folder)")


def json_text(content: object) -> str:
    """JSON as this project writes it; NaN, which JSON does not know, raises ValueError."""
    return json.dumps(content, indent=1, allow_nan=False) + "\n"


def plain(content: Any) -> Any:
    """Data as JSON holds them: arrays are lists, null where there is no finite number."""
    if isinstance(content, Mapping):
        return {key: plain(value) for key, value in content.items()}
    if isinstance(content, np.ndarray | np.generic):
        content = content.tolist()
    if isinstance(content, list | tuple):
        return [plain(value) for value in content]
    return None if isinstance(content, float) and not math.isfinite(content) else content


def read_text(path: Path | str, *, kind: type[CalibrationError] = CalibrationError) -> str:
    """The text of a UTF-8 file, without a leading byte order mark; errors are of the kind given."""
    try:
        return Path(path).read_text(encoding="utf-8-sig")
    except OSError as error:
        raise kind(f"{path}: cannot be read ({error.strerror})") from error
    except UnicodeDecodeError as error:
        raise kind(f"{path}: is not UTF-8 text (byte {error.start}); save it as UTF-8") from error


def finite(value: float) -> float | None:
    """For JSON: null where there is no finite number."""
    return value if math.isfinite(value) else None


def numbers(values: Any) -> Array:
    """An array of floats from JSON, NaN for null."""
    return np.array(values, dtype=float)


def number(value: float | None) -> float:
    """A number of a JSON; null is NaN."""
    return math.nan if value is None else float(value)
