"""What goes wrong through the user's input: one line that names the place and the mend."""

from __future__ import annotations

import re

NUMPY_ERROR_PATTERN = re.compile(
    r"shape|inhomogeneous|broadcast|dimension|convert|array|invalid literal"
)


class CalibrationError(Exception):
    """The input is wrong; the message says where, what, and what to do (exit code 2)."""


class RobotError(CalibrationError):
    """A robot file or name that cannot be used."""


class DataError(CalibrationError):
    """Measurements that cannot be used."""


class OptionError(CalibrationError):
    """A choice that does not exist or does not fit the data."""


class CalibrationWarning(UserWarning):
    """A result that should not be used before its reason has been looked at."""


def describe_file_content_error(error: Exception) -> str:
    """What is wrong with the content of a file, without Python's and NumPy's words for it."""
    text = str(error).partition("\n")[0]
    if isinstance(error, KeyError):
        return f"{text} is missing"
    if isinstance(error, CalibrationError):
        return text
    return (
        text
        if type(error) is ValueError and not NUMPY_ERROR_PATTERN.search(text)
        else "wrong kind or size"
    )
