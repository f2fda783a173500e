"""The group of all commands, and the exit code of each outcome."""

from __future__ import annotations

import io
import sys
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from contextvars import copy_context

import click

from minimax_cal.cli import INTERRUPTED, MISUSED, NO_MEMORY, is_out_of_memory
from minimax_cal.cli.commands import ENTRIES, WHOLE_HELP, Commands, Workflow
from minimax_cal.cli.stderr import AS_JSON, WRITTEN, complain, tell_written
from minimax_cal.ground.errors import CalibrationError, CalibrationWarning
from minimax_cal.ground.journal import all_or_none


@click.group(
    cls=Workflow,
    commands=Commands(ENTRIES),
    context_settings={"help_option_names": ["-h", "--help"]},
)
@WHOLE_HELP
@click.version_option(package_name="minimax-cal", prog_name="minimax-cal")
def cli() -> None:
    """Calibrate robot arms, and tell why a calibrated arm still misses."""


def outcome(arguments: Sequence[str] | None) -> int:
    """The exit code of a command line; whatever went wrong is one line of error."""
    return copy_context().run(run_command, arguments)


def run_command(arguments: Sequence[str] | None) -> int:
    """As `outcome`, which forgets what an option said about stderr."""
    AS_JSON.set(False)
    WRITTEN.set([])
    if sys.stdout is None:  # a file that is opened next would take its place
        return complain(
            "stdout is closed and the result would be lost; end with >/dev/null", MISUSED
        )
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")  # a terminal without the letter shows another
    code: int | None
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", CalibrationWarning)  # the notices say the same
            with whole_outputs():
                code = cli.main(args=arguments, prog_name="minimax-cal", standalone_mode=False)
    except CalibrationError as error:
        code = complain(said_by(error, arguments), MISUSED)
    except click.exceptions.NoArgsIsHelpError as error:
        click.echo(error.format_message())
        code = MISUSED
    except click.ClickException as error:
        context = getattr(error, "ctx", None)
        hint = f" (see {context.command_path} --help)" if context else ""
        code = complain(error.format_message() + hint, MISUSED)
    except (KeyboardInterrupt, click.Abort):
        code = complain("interrupted", INTERRUPTED)
    except Exception as error:
        if is_out_of_memory(error):
            code = complain(NO_MEMORY)
        elif isinstance(error, OSError):
            code = complain(f"the output cannot be written ({error.strerror})")
        else:
            code = numerical(error)
    return code or 0


@contextmanager
def whole_outputs() -> Iterator[None]:
    """Keep the files of a command that ends, and say so; else none, but for a lost stdout."""
    try:
        with all_or_none():
            yield
    except OSError:
        raise
    except BaseException:
        WRITTEN.set([])
        raise
    tell_written()


def said_by(error: CalibrationError, arguments: Sequence[str] | None) -> str:
    """What is wrong, with the options as the command that was asked for calls them."""
    from minimax_cal.cli.options import in_flags

    name = next(iter(sys.argv[1:] if arguments is None else arguments), "")
    return in_flags(str(error), cli.commands[name]) if name in ENTRIES else str(error)


def numerical(error: Exception) -> int:
    """The exit code of an error of the solvers; any other is raised."""
    from numpy.linalg import LinAlgError

    from qp_backends import BackendError

    if isinstance(error, BackendError):
        return complain(str(error), MISUSED)
    if isinstance(error, LinAlgError):
        return complain(f"the numbers did not work out ({error}): more poses may help")
    raise error
