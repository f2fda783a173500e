"""The command line: a command is imported when it is used."""

from __future__ import annotations

import io
import sys
import warnings
from collections.abc import Sequence

import click

from minimax_cal.cli.commands import ENTRIES, Commands, Workflow
from minimax_cal.ground.errors import CalibrationError, CalibrationWarning
from minimax_cal.ground.words import one_line

FAILED, MISUSED, INTERRUPTED = 1, 2, 130  # exit codes


@click.group(
    cls=Workflow,
    commands=Commands(ENTRIES),
    context_settings={"help_option_names": ["-h", "--help"]},
)
@click.version_option(package_name="minimax-cal", prog_name="minimax-cal")
def cli() -> None:
    """Calibrate robot arms, and tell why a calibrated arm still misses."""


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command line; every outcome is an exit code and at most one line of error."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")  # a terminal without the letter shows another
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", CalibrationWarning)  # the notices say the same
            code = cli.main(args=arguments, prog_name="minimax-cal", standalone_mode=False)
    except CalibrationError as error:
        code = complain(str(error))
    except click.exceptions.NoArgsIsHelpError as error:
        click.echo(error.format_message())
        code = MISUSED
    except click.ClickException as error:
        context = getattr(error, "ctx", None)
        hint = f" (see {context.command_path} --help)" if context else ""
        code = complain(error.format_message() + hint)
    except (KeyboardInterrupt, click.Abort):
        code = complain("interrupted", INTERRUPTED)
    except OSError as error:
        code = complain(f"the output cannot be written ({error.strerror})", FAILED)
    except Exception as error:
        code = numerical(error)
    sys.exit(code or 0)


def numerical(error: Exception) -> int:
    """The exit code of an error of the solvers; any other is raised."""
    from numpy.linalg import LinAlgError

    from qp_backends import BackendError

    if isinstance(error, BackendError):
        return complain(str(error))
    if isinstance(error, LinAlgError):
        return complain(f"the numbers did not work out ({error}): more poses may help", FAILED)
    raise error


def complain(message: str, code: int = MISUSED) -> int:
    """One line on stderr."""
    click.echo(f"error: {one_line(message)}", err=True)
    return code
