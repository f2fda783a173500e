"""Seeds of random numbers."""

from __future__ import annotations

from minimax_cal.ground.errors import OptionError


def check_seed(seed: int) -> None:
    """Raise OptionError for a seed that NumPy's generators do not take."""
    if seed < 0:
        raise OptionError(f"seed {seed}: give a whole number, 0 or more")
