"""What goes wrong through the user's input: one line that names the place and the mend."""


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
