"""All studies: ``python -m experiments`` lists them, ``NAME`` runs one, ``all`` runs every one.

python -m experiments all --quick [--out FOLDER] [--json FILE] [--seed N] [--jobs N]
                                  [--cluster tcp://host:port] [--fresh]
"""

from __future__ import annotations

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
from experiments.record import environment, save_json
from experiments.sweep import Study, needed, study_options
from minimax_cal.ground.errors import OptionError
from minimax_cal.ground.parallel import look_for

STUDIES = {  # name: (module with the command `main`, what it tells)
    "papers": (
        "experiments.papers",
        "Both papers item by item: all tables and figures, and a table of verdicts",
    ),
    "convergence": (
        "experiments.convergence",
        "From which starts the least-squares methods reach the minimum, and how fast",
    ),
    "any_base": ("experiments.any_base", "Starts for a robot whose base may stand anywhere"),
    "algorithm_1": (
        "experiments.algorithm_1",
        "Paper M's Algorithm 1 to the letter, with and without a line search",
    ),
    "conditions": (
        "experiments.conditions",
        "Errors, training and held out, under each way to fit, simulated and real",
    ),
    "splits": (
        "experiments.splits",
        "Minimax against the sum over many splits, at random and by groups",
    ),
    "methods": ("experiments.methods", "MDH, product of exponentials and minimax side by side"),
    "courses": (
        "experiments.courses",
        "Error against iteration from paper S's start, simulated and real",
    ),
    "solver_accuracy": (
        "experiments.solver_accuracy",
        "What each QP backend is worth: accuracy, reliability and time",
    ),
    "external": (
        "experiments.external",
        "Do claimed accuracies hold on poses set aside: halves, regions, ends of the session",
    ),
    "blind_gap": (
        "experiments.blind_gap",
        "Does a diagnosis name the true cause: sealed arms, wrong laws, deleted causes",
    ),
    "machine_gap": (
        "experiments.machine_gap",
        "The same on arms as shops have them: more makes, worse conditions, other forms of laws",
    ),
    "relative": (
        "experiments.relative",
        "What lengths, closures and poses tell beside a tracker, and how true their positions are",
    ),
    "relative_gap": (
        "experiments.relative_gap",
        "Does a diagnosis of several instruments name the true cause: sockets, wires, whole poses",
    ),
    "pixels": (
        "experiments.pixels",
        "What cameras tell of an arm: lenses that are wrong, bad starts, pixels that are too weak",
    ),
    "coverage": (
        "experiments.coverage",
        "Do 95 % intervals hold the truth: parameters, positions, held-out accuracy, bootstrap",
    ),
    "one_session": (
        "experiments.one_session",
        "Is anything said to have moved within one session, and is a move found",
    ),
    "errata": ("experiments.errata", "What is wrong in the papers as printed, by counter-example"),
    "simulator_gap": (
        "experiments.simulator_gap",
        "A simulated arm in MuJoCo: published gains, then corrected step by step, against the fit",
    ),
    "motion_real": (
        "experiments.motion_real",
        "Torques along trajectories, judged by runs that no fit saw: a real arm, a simulated one",
    ),
    "motion_gap": (
        "experiments.motion_gap",
        "Does a simulator's model, corrected by logs, move as the arm does on runs it never saw",
    ),
    "servos": (
        "experiments.servos",
        "Do logs with commands give a model the gains, delays and limits of the arm's drives",
    ),
    "motion_blind": (
        "experiments.motion_blind",
        "Are causes of torque named rightly: sound arms, causes withheld, laws outside the library",
    ),
    "speed": ("experiments.speed", "How fast the fits are, as ratios to peers in the same run"),
}


def study_command(name: str) -> click.Command:
    """The study called name.  Raises OptionError where there is none."""
    if name not in STUDIES:
        raise OptionError(f"no study {name!r}; choose all or one of {', '.join(STUDIES)}")
    module = STUDIES[name][0]
    try:
        command = import_module(module).main
    except ModuleNotFoundError as error:
        if error.name != module:
            raise
        raise OptionError(f"study {name} is not there yet ({module})") from error
    if not isinstance(command, click.Command):
        raise TypeError(f"{module}.main is not a click command")
    return command


def listing() -> str:
    """Names and descriptions of the studies."""
    width = max(map(len, STUDIES))
    lines = [f"  {name:{width}}  {about}" for name, (_, about) in STUDIES.items()]
    lines.append(f"  {'all':{width}}  Every study, into one folder with an index.html")
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
    about = STUDIES[name][1]
    try:
        command = study_command(name)
    except OptionError as error:
        return Outcome(name, about, "skipped", str(error))
    except Exception as error:  # a study must not end the others
        return Outcome(name, about, "failed", explained(error))
    before = stamps(study.out / name)
    failure = ""
    try:
        code = command.main(arguments_for(study, name), name, standalone_mode=False)
        failure = ending(code)
    except click.Abort:
        raise  # Ctrl-C is meant for all
    except SystemExit as error:
        failure = ending(error.code)
    except Exception as error:
        failure = explained(error)
    after = stamps(study.out / name)
    files = tuple(path for path, stamp in after.items() if before.get(path) != stamp)
    return Outcome(name, about, "failed" if failure else "done", failure, files)


def ending(code: object) -> str:
    """What an exit code or a last message tells of failure; nothing if all went well."""
    if isinstance(code, int):
        return f"exit code {code}" if code else ""
    return code if isinstance(code, str) else ""


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
        command = everything if name == "all" else study_command(name)
    except OptionError as error:
        click.echo(f"error: {error}", err=True)
        sys.exit(2)
    command.main(rest, f"python -m experiments {name}")


if __name__ == "__main__":
    main(sys.argv[1:])
