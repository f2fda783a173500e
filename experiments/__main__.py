"""All studies: ``python -m experiments`` lists them, ``NAME`` runs one, ``all`` runs every one.

python -m experiments all --quick [--out FOLDER] [--json FILE] [--seed N] [--jobs N]
                                  [--cluster tcp://host:port] [--fresh]
python -m experiments pages [--run NAME ...]    # the figures of the documentation's pages
"""

from __future__ import annotations

import ast
import json
import os
import shlex
import sys
import time
import traceback
from collections.abc import Sequence
from importlib import import_module
from pathlib import Path

import click

from experiments.index import StudyOutcome, write_index_page
from experiments.pages import main as pages
from experiments.study_record import build_environment_table, write_json
from experiments.sweep import Study, import_optional_module, study_options
from minimax_cal.core.errors import OptionError
from minimax_cal.core.parallel import check_scheduler_answers

STUDY_NAMES = (
    "papers", "convergence", "any_base", "algorithm_1", "warm_start", "conditions", "splits",
    "methods", "courses", "solver_accuracy", "external", "blind_gap", "machine_gap", "relative",
    "relative_gap", "agreement", "pixels", "coverage", "one_session", "errata", "simulator_gap",
    "motion_real", "motion_gap", "servos", "motion_blind", "speed",
)  # fmt: skip


def load_study_command(study_name: str) -> click.Command:
    """The study called name.  Raises OptionError where there is none."""
    if study_name not in STUDY_NAMES:
        raise OptionError(f"no study {study_name!r}; choose all or one of {', '.join(STUDY_NAMES)}")
    command: click.Command = import_module(f"experiments.{study_name}").main
    return command


def read_study_description(study_name: str) -> str:
    """What a study answers: the first line of its module, which is not imported for it."""
    text = Path(__file__).with_name(f"{study_name}.py").read_text(encoding="utf-8")
    return (ast.get_docstring(ast.parse(text)) or "").partition("\n")[0]


def format_study_list() -> str:
    """Names of the studies and what they answer."""
    lines = [f"  {name:16} {read_study_description(name)}" for name in STUDY_NAMES]
    lines.append(f"  {'all':16} Every study, into one folder with an index.html")
    lines.append(f"  {'pages':16} {read_study_description('pages')}")
    return "\n".join(["Usage: python -m experiments NAME [--help]", "", *lines])


def study_arguments(study: Study, study_name: str) -> list[str]:
    """The options of `all` as one study takes them, with its own places to write to."""
    folder = study.out / study_name
    return [
        *(["--quick"] if study.quick else []),
        *(["--fresh"] if study.fresh else []),
        *(["--cluster", study.cluster] if study.cluster else []),
        *("--seed", str(study.seed), "--jobs", str(study.jobs)),
        *("--out", str(folder), "--json", str(folder / f"{study_name}.json")),
    ]


def file_versions(folder: Path) -> dict[Path, tuple[int, int]]:
    """The files in a folder, with what changes when one is written again."""
    facts = {path: path.stat() for path in sorted(folder.glob("*")) if path.is_file()}
    return {path: (fact.st_ino, fact.st_mtime_ns) for path, fact in facts.items()}


def run_study_and_catch_errors(study: Study, study_name: str) -> StudyOutcome:
    """Run one study of all; what it raises is its outcome.  Files of earlier runs do not count."""
    before, failure = file_versions(study.out / study_name), ""
    try:
        options = study_arguments(study, study_name)
        failure = describe_exit_code(
            load_study_command(study_name).main(options, study_name, standalone_mode=False)
        )
    except click.Abort:
        raise  # Ctrl-C is meant for all
    except SystemExit as error:
        failure = describe_exit_code(error.code)
    except Exception as error:  # a study must not end the others
        failure = describe_error_in_one_line(error)
    after = file_versions(study.out / study_name)
    files = tuple(path for path, stamp in after.items() if before.get(path) != stamp)
    return StudyOutcome(
        study_name,
        read_study_description(study_name),
        "failed" if failure else "done",
        failure,
        files,
    )


def describe_exit_code(code: object) -> str:
    """What an exit code or a last message tells of failure; nothing if all went well."""
    return f"exit code {code}" if code and isinstance(code, int) else str(code or "")


def describe_error_in_one_line(error: Exception) -> str:
    """An error in one line; one that no user could cause is also printed with its traceback."""
    if isinstance(error, click.ClickException):
        return " ".join(error.format_message().split())
    traceback.print_exception(error)
    return " ".join(f"{type(error).__name__}: {error}".split())


def read_study_numbers(study: Study, outcome: StudyOutcome) -> object:
    """What a study wrote for other programs in this run."""
    path = study.out / outcome.name / f"{outcome.name}.json"
    return json.loads(path.read_text(encoding="utf-8")) if path in outcome.files else {}


@study_options("all")
def run_every_study(study: Study) -> None:
    """Run every study into a folder of its own, with one page about all."""
    import_optional_module("jinja2", "experiments")
    if study.cluster:
        check_scheduler_answers(study.cluster)
    study.out.mkdir(parents=True, exist_ok=True)
    outcomes = []
    seconds = {}
    for name in STUDY_NAMES:
        click.echo(f"== {name}", err=True)
        began = time.perf_counter()
        outcome = run_study_and_catch_errors(study, name)
        seconds[name] = time.perf_counter() - began
        say = f"{outcome.status}: {outcome.error}" if outcome.error else outcome.status
        click.echo(f"== {name} {say} ({seconds[name]:.0f} s)", err=True)
        outcomes.append(outcome)
    # where and how many do not change a number, so they do not change the page
    options = (["--quick"] if study.quick else []) + ["--seed", str(study.seed)]
    command = shlex.join(["python", "-m", "experiments", "all", *options])
    made_on = build_environment_table(("joblib", "distributed", "matplotlib"))
    click.echo(f"wrote {write_index_page(study.out, command, made_on, outcomes)}", err=True)
    if study.json:
        found = {
            outcome.name: {
                "status": outcome.status,
                "error": outcome.error,
                "seconds": seconds[outcome.name],
                "numbers": read_study_numbers(study, outcome),
            }
            for outcome in outcomes
        }
        write_json(study.json, {"studies": found})
    failed = [outcome.name for outcome in outcomes if outcome.status == "failed"]
    if failed:
        raise click.ClickException(f"failed: {', '.join(failed)}")


def main(arguments: Sequence[str]) -> None:
    """List the studies, or run what the first argument names with the rest as its options."""
    name, *rest = arguments or ("--help",)
    if name in ("-h", "--help"):
        click.echo(format_study_list())
        return
    if "--quick" in rest:  # half a minute of compiling, in each process, for seconds of loops
        os.environ.setdefault("MINIMAX_CAL_LOOPS", "plain")
    try:
        command = (
            run_every_study
            if name == "all"
            else pages
            if name == "pages"
            else load_study_command(name)
        )
    except OptionError as error:
        click.echo(f"error: {error}", err=True)
        sys.exit(2)
    command.main(rest, f"python -m experiments {name}")


if __name__ == "__main__":
    main(sys.argv[1:])
