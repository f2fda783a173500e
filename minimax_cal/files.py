"""Reading and writing whole files: an output is complete or absent."""

from __future__ import annotations

import json
import os
import tempfile
from pathlib import Path

from minimax_cal.errors import CalibrationError


def write_whole(path: Path | str, content: str | bytes) -> None:
    """Write content to path in one step: a reader sees the old file or the new one.

    Raises CalibrationError when the folder does not exist or cannot be written.
    """
    path = Path(path)
    raw = content.encode("utf-8") if isinstance(content, str) else content
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


def json_text(content: object) -> str:
    """JSON as this project writes it; NaN, which JSON does not know, raises ValueError."""
    return json.dumps(content, indent=1, allow_nan=False) + "\n"


def read_text(path: Path | str, *, kind: type[CalibrationError] = CalibrationError) -> str:
    """The text of a UTF-8 file, without a leading byte order mark; errors are of the kind given."""
    try:
        return Path(path).read_text(encoding="utf-8-sig")
    except OSError as error:
        raise kind(f"{path}: cannot be read ({error.strerror})") from error
    except UnicodeDecodeError as error:
        raise kind(f"{path}: is not UTF-8 text (byte {error.start}); save it as UTF-8") from error
