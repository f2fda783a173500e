"""The command line: a command is imported when it is used."""

from __future__ import annotations

import atexit
import gc
import os
import sys
from collections.abc import Sequence

COLLECTED = 500_000  # new objects after which Python looks for garbage: what is imported is none
FAILED, MISUSED, INTERRUPTED = 1, 2, 130  # exit codes


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command line; every outcome is an exit code and at most one line of error.

    arguments: those of the process unless given.
    """
    if arguments is None:  # a process of its own, which is to be brief
        gc.set_threshold(COLLECTED)
        atexit.register(gc.freeze)  # what is left at the end is not looked through
        os.environ.setdefault("PYDANTIC_DISABLE_PLUGINS", "__all__")  # it looks everywhere for them
    try:
        from minimax_cal.cli.running import outcome  # imports take long enough for a Ctrl-C

        code = outcome(arguments)
    except KeyboardInterrupt:
        print("error: interrupted", file=sys.stderr)
        code = INTERRUPTED
    sys.exit(code)
