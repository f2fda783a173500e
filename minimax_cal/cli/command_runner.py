"""The group of all commands, and the exit code of each outcome."""

from __future__ import annotations

import io
import sys
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from contextvars import copy_context

import click

from minimax_cal.cli import (
    INTERRUPTED_EXIT_CODE,
    MISUSE_EXIT_CODE,
    NO_MEMORY_MESSAGE,
    is_out_of_memory_error,
)
from minimax_cal.cli.command_group import (
    COMMAND_MODULES,
    HELP_ALL_OPTION,
    LazyCommands,
    OrderedCommandGroup,
)
from minimax_cal.cli.stderr_events import (
    IS_JSON_PROGRESS,
    UNREPORTED_WRITTEN_FILES,
    report_error,
    report_written_paths,
)
from minimax_cal.core.errors import CalibrationError, CalibrationWarning
from minimax_cal.core.write_journal import undo_writes_on_error


@click.group(
    cls=OrderedCommandGroup,
    commands=LazyCommands(COMMAND_MODULES),
    context_settings={"help_option_names": ["-h", "--help"]},
)
@HELP_ALL_OPTION
@click.version_option(package_name="minimax-cal", prog_name="minimax-cal")
def cli() -> None:
    """Calibrate robot arms, and tell why a calibrated arm still misses."""


def run_command_line(arguments: Sequence[str] | None) -> int:
    """The exit code of a command line; whatever went wrong is one line of error."""
    return copy_context().run(run_command_in_context, arguments)


def run_command_in_context(arguments: Sequence[str] | None) -> int:
    """As `run_command_line`, which forgets what an option said about stderr."""
    IS_JSON_PROGRESS.set(False)
    UNREPORTED_WRITTEN_FILES.set([])
    if sys.stdout is None:  # a file that is opened next would take its place
        return report_error(
            "stdout is closed and the result would be lost; end with >/dev/null", MISUSE_EXIT_CODE
        )
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")  # a terminal without the letter shows another
    code: int | None
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", CalibrationWarning)  # the notices say the same
            with keep_outputs_only_on_success():
                code = cli.main(args=arguments, prog_name="minimax-cal", standalone_mode=False)
    except CalibrationError as error:
        code = report_error(format_error_with_flags(error, arguments), MISUSE_EXIT_CODE)
    except click.exceptions.NoArgsIsHelpError as error:
        click.echo(error.format_message())
        code = MISUSE_EXIT_CODE
    except click.ClickException as error:
        context = getattr(error, "ctx", None)
        hint = f" (see {context.command_path} --help)" if context else ""
        code = report_error(error.format_message() + hint, MISUSE_EXIT_CODE)
    except (KeyboardInterrupt, click.Abort):
        code = report_error("interrupted", INTERRUPTED_EXIT_CODE)
    except Exception as error:
        if is_out_of_memory_error(error):
            code = report_error(NO_MEMORY_MESSAGE)
        elif isinstance(error, OSError):
            code = report_error(f"the output cannot be written ({error.strerror})")
        else:
            code = report_numerical_error(error)
    return code or 0


@contextmanager
def keep_outputs_only_on_success() -> Iterator[None]:
    """Keep the files of a command that ends, and say so; else none, but for a lost stdout."""
    try:
        with undo_writes_on_error():
            yield
    except OSError:
        raise
    except BaseException:
        UNREPORTED_WRITTEN_FILES.set([])
        raise
    report_written_paths()


def format_error_with_flags(error: CalibrationError, arguments: Sequence[str] | None) -> str:
    """What is wrong, with the options as the command that was asked for calls them."""
    from minimax_cal.cli.options import replace_arguments_by_flags

    name = next(iter(sys.argv[1:] if arguments is None else arguments), "")
    return (
        replace_arguments_by_flags(str(error), cli.commands[name])
        if name in COMMAND_MODULES
        else str(error)
    )


def report_numerical_error(error: Exception) -> int:
    """The exit code of an error of the solvers; any other is raised."""
    from numpy.linalg import LinAlgError

    from qp_backends import BackendError

    if isinstance(error, BackendError):
        return report_error(str(error), MISUSE_EXIT_CODE)
    if isinstance(error, LinAlgError):
        return report_error(f"the numbers did not work out ({error}): more poses may help")
    raise error
