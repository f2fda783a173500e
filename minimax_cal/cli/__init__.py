"""The command line: a command is imported when it is used."""

from __future__ import annotations

import sys
from collections.abc import Sequence

FAILED, MISUSED, INTERRUPTED = 1, 2, 130  # exit codes


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command line; every outcome is an exit code and at most one line of error."""
    try:
        from minimax_cal.cli.running import outcome  # imports take long enough for a Ctrl-C

        code = outcome(arguments)
    except KeyboardInterrupt:
        print("error: interrupted", file=sys.stderr)
        code = INTERRUPTED
    sys.exit(code)
