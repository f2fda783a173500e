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

from experiments.index import Outcome, write_index
from experiments.pages import main as pages
from experiments.record import environment, save_json
from experiments.sweep import Study, needed, study_options
from minimax_cal.ground.errors import OptionError
from minimax_cal.ground.parallel import look_for

STUDIES = (
    "papers", "convergence", "any_base", "algorithm_1", "warm_start", "conditions", "splits",
    "methods", "courses", "solver_accuracy", "external", "blind_gap", "machine_gap", "relative",
    "relative_gap", "agreement", "pixels", "coverage", "one_session", "errata", "simulator_gap",
    "motion_real", "motion_gap", "servos", "motion_blind", "speed",
)  # fmt: skip


def study_command(name: str) -> click.Command:
    """The study called name.  Raises OptionError where there is none."""
    if name not in STUDIES:
        raise OptionError(f"no study {name!r}; choose all or one of {', '.join(STUDIES)}")
    command: click.Command = import_module(f"experiments.{name}").main
    return command


def about(name: str) -> str:
    """What a study answers: the first line of its module, which is not imported for it."""
    text = Path(__file__).with_name(f"{name}.py").read_text(encoding="utf-8")
    return (ast.get_docstring(ast.parse(text)) or "").partition("\n")[0]


def listing() -> str:
    """Names of the studies and what they answer."""
    lines = [f"  {name:16} {about(name)}" for name in STUDIES]
    lines.append(f"  {'all':16} Every study, into one folder with an index.html")
    lines.append(f"  {'pages':16} {about('pages')}")
    return "\n".join(["Usage: python -m experiments NAME [--help]", "", *lines])


def arguments_for(study: Study, name: str) -> list[str]:
    """The options of `all` as one study takes them, with its own places to write to."""
    folder = study.out / name
    return [
        *(["--quick"] if study.quick else []),
        *(["--fresh"] if study.fresh else []),
        *(["--cluster", study.cluster] if study.cluster else []),
        *("--seed", str(study.seed), "--jobs", str(study.jobs)),
        *("--out", str(folder), "--json", str(folder / f"{name}.json")),
    ]


def stamps(folder: Path) -> dict[Path, tuple[int, int]]:
    """The files in a folder, with what changes when one is written again."""
    facts = {path: path.stat() for path in sorted(folder.glob("*")) if path.is_file()}
    return {path: (fact.st_ino, fact.st_mtime_ns) for path, fact in facts.items()}


def attempt(study: Study, name: str) -> Outcome:
    """Run one study of all; what it raises is its outcome.  Files of earlier runs do not count."""
    before, failure = stamps(study.out / name), ""
    try:
        options = arguments_for(study, name)
        failure = ending(study_command(name).main(options, name, standalone_mode=False))
    except click.Abort:
        raise  # Ctrl-C is meant for all
    except SystemExit as error:
        failure = ending(error.code)
    except Exception as error:  # a study must not end the others
        failure = explained(error)
    after = stamps(study.out / name)
    files = tuple(path for path, stamp in after.items() if before.get(path) != stamp)
    return Outcome(name, about(name), "failed" if failure else "done", failure, files)


def ending(code: object) -> str:
    """What an exit code or a last message tells of failure; nothing if all went well."""
    return f"exit code {code}" if code and isinstance(code, int) else str(code or "")


def explained(error: Exception) -> str:
    """An error in one line; one that no user could cause is also printed with its traceback."""
    if isinstance(error, click.ClickException):
        return " ".join(error.format_message().split())
    traceback.print_exception(error)
    return " ".join(f"{type(error).__name__}: {error}".split())


def numbers(study: Study, outcome: Outcome) -> object:
    """What a study wrote for other programs in this run."""
    path = study.out / outcome.name / f"{outcome.name}.json"
    return json.loads(path.read_text(encoding="utf-8")) if path in outcome.files else {}


@study_options("all")
def everything(study: Study) -> None:
    """Run every study into a folder of its own, with one page about all."""
    needed("jinja2", "experiments")
    if study.cluster:
        look_for(study.cluster)
    study.out.mkdir(parents=True, exist_ok=True)
    outcomes = []
    seconds = {}
    for name in STUDIES:
        click.echo(f"== {name}", err=True)
        began = time.perf_counter()
        outcome = attempt(study, name)
        seconds[name] = time.perf_counter() - began
        say = f"{outcome.status}: {outcome.error}" if outcome.error else outcome.status
        click.echo(f"== {name} {say} ({seconds[name]:.0f} s)", err=True)
        outcomes.append(outcome)
    # where and how many do not change a number, so they do not change the page
    options = (["--quick"] if study.quick else []) + ["--seed", str(study.seed)]
    command = shlex.join(["python", "-m", "experiments", "all", *options])
    made_on = environment(("joblib", "distributed", "matplotlib"))
    click.echo(f"wrote {write_index(study.out, command, made_on, outcomes)}", err=True)
    if study.json:
        found = {
            outcome.name: {
                "status": outcome.status,
                "error": outcome.error,
                "seconds": seconds[outcome.name],
                "numbers": numbers(study, outcome),
            }
            for outcome in outcomes
        }
        save_json(study.json, {"studies": found})
    failed = [outcome.name for outcome in outcomes if outcome.status == "failed"]
    if failed:
        raise click.ClickException(f"failed: {', '.join(failed)}")


def main(arguments: Sequence[str]) -> None:
    """List the studies, or run what the first argument names with the rest as its options."""
    name, *rest = arguments or ("--help",)
    if name in ("-h", "--help"):
        click.echo(listing())
        return
    if "--quick" in rest:  # half a minute of compiling, in each process, for seconds of loops
        os.environ.setdefault("MINIMAX_CAL_LOOPS", "plain")
    try:
        command = everything if name == "all" else pages if name == "pages" else study_command(name)
    except OptionError as error:
        click.echo(f"error: {error}", err=True)
        sys.exit(2)
    command.main(rest, f"python -m experiments {name}")


if __name__ == "__main__":
    main(sys.argv[1:])
