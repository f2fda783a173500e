"""The command line: a command is imported when it is used."""

from __future__ import annotations

import atexit
import errno
import gc
import os
import signal
import sys
from collections.abc import Sequence
from types import FrameType

GARBAGE_COLLECTION_THRESHOLD = (
    500_000  # new objects after which Python looks for garbage: what is imported is none
)
FAILED_EXIT_CODE, MISUSE_EXIT_CODE, INTERRUPTED_EXIT_CODE = 1, 2, 130  # exit codes
SIGNAL_EXIT_CODE_OFFSET = 128  # beside its number, the exit code of a process that a signal ends
MIN_ADDRESS_SPACE_BYTES = (
    1 << 30
)  # bytes of address space: shared libraries and compiled kernels take it
NO_MEMORY_MESSAGE = "there is not enough memory for this; give fewer poses or samples"


class TerminatedBySignal(BaseException):
    """The process was asked to end, by the signal of a number."""


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command line; every outcome is an exit code and at most one line of error.

    arguments: those of the process unless given.
    """
    if arguments is None:  # a process of its own, which is to be brief
        gc.set_threshold(GARBAGE_COLLECTION_THRESHOLD)
        atexit.register(gc.freeze)  # what is left at the end is not looked through
        os.environ.setdefault("PYDANTIC_DISABLE_PLUGINS", "__all__")  # it looks everywhere for them
        raise_on_termination_signals()
    try:
        if mapped := address_space_limit_if_too_small():
            print(
                f"error: this process may map {mapped >> 20} MiB (ulimit -v); it needs "
                f"{MIN_ADDRESS_SPACE_BYTES >> 20} MiB", file=sys.stderr,
            )  # fmt: skip
            sys.exit(FAILED_EXIT_CODE)
        from minimax_cal.cli.command_runner import (
            run_command_line,
        )  # imports take long enough for a Ctrl-C

        code = run_command_line(arguments)
    except KeyboardInterrupt:
        print("error: interrupted", file=sys.stderr)
        code = INTERRUPTED_EXIT_CODE
    except TerminatedBySignal as ended:
        exit_without_waiting(SIGNAL_EXIT_CODE_OFFSET + ended.args[0])
    except (MemoryError, ImportError, OSError) as error:
        if not is_out_of_memory_error(error):
            raise
        print(f"error: {NO_MEMORY_MESSAGE}", file=sys.stderr)
        code = FAILED_EXIT_CODE
    sys.exit(code)


def raise_on_termination_signals() -> None:
    """Let TERM, and the end of the terminal, raise `TerminatedBySignal`: files are put in order
    then.
    """
    for name in ("SIGTERM", "SIGHUP"):  # Windows has no second
        number = getattr(signal, name, None)
        if number is not None and signal.getsignal(number) == signal.SIG_DFL:  # nohup ignores it
            signal.signal(number, raise_terminated_by_signal)


def raise_terminated_by_signal(signal_number: int, _: FrameType | None) -> None:
    """What a signal does."""
    raise TerminatedBySignal(signal_number)


def exit_without_waiting(exit_code: int) -> None:
    """End this process without waiting for threads, which may be at work for long."""
    print("error: terminated", file=sys.stderr, flush=True)
    os._exit(exit_code)


def address_space_limit_if_too_small() -> int:
    """The bytes that may be mapped, where they are too few; else 0.

    OpenBLAS would wait for ever then, or abort.
    """
    try:
        import resource
    except ImportError:  # Windows
        return 0
    most, _ = resource.getrlimit(resource.RLIMIT_AS)
    return most if most != resource.RLIM_INFINITY and most < MIN_ADDRESS_SPACE_BYTES else 0


def is_out_of_memory_error(error: BaseException) -> bool:
    """Whether an error, as also of a library that cannot be loaded, is of too little memory."""
    if isinstance(error, OSError):
        return error.errno in (errno.ENOMEM, errno.EAGAIN)
    mapped = "failed to map segment", "annot allocate memory"
    unloaded = isinstance(error, ImportError) and any(text in str(error) for text in mapped)
    return unloaded or isinstance(error, MemoryError)
