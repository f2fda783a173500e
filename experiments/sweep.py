"""Many independent jobs, on this machine or a Dask cluster, resumed where they were interrupted.

    results = sweep(function, jobs, name="any_base")                          # all cores
    results = sweep(function, jobs, name="any_base", cluster="tcp://host:8786")

Each result is kept on disk as it arrives, under a key of all that it
depends on, so that the same call goes on from there.  Workers of a cluster must run the same code,
one job at a time: start them in the project's folder with
``python -m dask worker tcp://host:8786 --nworkers N --nthreads 1``.

A study takes its options from `study_options`, by which it can also be started.
"""

from __future__ import annotations

import ast
import dataclasses
import functools
import hashlib
import inspect
import io
import itertools
import pickle
import shlex
import sys
import warnings
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence
from contextlib import closing, suppress
from dataclasses import dataclass
from enum import Enum
from importlib import import_module
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import click
from click.core import ParameterSource
from rich.console import Console
from rich.progress import track

import minimax_cal
import qp_backends
from experiments.study_record import (
    build_environment_table,
    build_run_record,
    current_commit,
    table_to_json,
    write_figure_files,
    write_json,
    write_tables,
)
from minimax_cal.core import parallel
from minimax_cal.core.errors import CalibrationError, OptionError
from minimax_cal.core.files import write_file_atomically
from minimax_cal.core.optional_packages import import_optional
from minimax_cal.core.parallel import WorkersLostError
from minimax_cal.core.tables import Table

if TYPE_CHECKING:
    from matplotlib.figure import Figure

J = TypeVar("J")
R = TypeVar("R")

RESULT_CACHE_FOLDER = Path("results/cache")
LIBRARY_FOLDERS = tuple(Path(package.__path__[0]) for package in (minimax_cal, qp_backends))
SOLVER_PACKAGES = ("daqp", "osqp", "clarabel", "proxsuite", "quadprog", "piqp", "highspy", "scs")
NUMERICAL_PACKAGES = ("numpy", "scipy", "qpsolvers", "cvxpy", *SOLVER_PACKAGES)
ALLOWED_ARRAY_PICKLE_NAMES = {
    *itertools.product(("numpy._core.multiarray",), ("_reconstruct", "scalar")),
    *itertools.product(("numpy.core.multiarray",), ("_reconstruct", "scalar")),
    *itertools.product(("numpy._core.numeric", "numpy.core.numeric"), ("_frombuffer",)),
    *itertools.product(("numpy",), ("ndarray", "dtype")),
    *itertools.product(("pathlib",), ("PosixPath", "WindowsPath")),
}
OPTIONS_WITHOUT_EFFECT_ON_RESULTS = (
    "out",
    "json",
    "jobs",
    "cluster",
    "fresh",
)  # options that decide no figure
OUTPUT_MODULE_NAMES = {
    "__init__",
    "__main__",
    "index",
    "pages",
    "record",
    "sweep",
}  # files that shape no result


def sweep(
    function: Callable[[J], R],
    jobs: Sequence[J],
    *,
    name: str,
    description: str = "",
    jobs_in_parallel: int = -1,
    cluster: str = "",
    folder: Path = RESULT_CACHE_FOLDER,
    fresh: bool = False,
) -> list[R]:
    """The function's result for each job, in the order of the jobs.

    function: pure, at the top of a module.  jobs: plain data, holding their own seeds.
    jobs_in_parallel: processes on this machine, -1 for one a core; a cluster uses all it has.
    cluster: address of a Dask scheduler.  fresh: do not use what is kept in folder.
    Raises OptionError for what a user can mend.
    """
    if "<" in function.__qualname__ or function.__module__ == "__main__":
        raise TypeError(
            f"{function.__qualname__} must be at the top of a module; see `run_study_file`"
        )
    if jobs_in_parallel == 0:
        raise OptionError("--jobs 0: give the number of processes, or -1 for one a core")
    code = code_fingerprint(function)
    paths = [folder / name / f"{result_cache_key(name, function, job, code)}.part" for job in jobs]
    kept = [[] if fresh else read_cached_result(path) for path in paths]
    results: dict[int, R] = {number: found[0] for number, found in enumerate(kept) if found}
    if results:
        click.echo(f"{name}: {len(results)} of {len(jobs)} parts were kept", err=True)
    waiting = [number for number in range(len(jobs)) if number not in results]
    calls = [(function, jobs[number], code if cluster else "") for number in waiting]
    try:
        with closing(run_calls(calls, jobs_in_parallel, cluster, description or name)) as arriving:
            for at, result in arriving:
                number = waiting[at]
                write_cached_result(paths[number], result)
                results[number] = result
    finally:
        if len(results) < len(jobs):
            say = f"{name}: {len(results)} of {len(jobs)} parts are kept in {folder / name}"
            click.echo(f"{say}; the same command goes on from there", err=True)
    return [results[number] for number in range(len(jobs))]


Call = tuple[Callable[..., Any], Any, str]  # what `run_job_with_code_check` takes


def run_job_with_code_check(function: Callable[[J], R], job: J, expected_fingerprint: str) -> R:
    """One job where it runs; code, if any, is the fingerprint that it must find there."""
    if expected_fingerprint and code_fingerprint(function) != expected_fingerprint:
        raise OptionError(
            "a worker of the cluster runs other code or other versions of numpy, scipy or the QP "
            "solvers; bring it to the state of this machine and start it again"
        )
    return function(job)


def track_progress(items: Iterator[R], total: int, description: str) -> Iterator[R]:
    """The same items, with a bar and the time left on stderr if that is a terminal."""
    console = Console(stderr=True)
    off = not console.is_terminal
    yield from track(items, description, total, console=console, disable=off)


# ---- where jobs run --------------------------------------------------------------------------


def run_calls(
    calls: Sequence[Call], jobs_in_parallel: int, cluster: str, description: str
) -> Generator[tuple[int, Any], None, None]:
    """The number of each call of `run_job_with_code_check` and its result, in the order they
    finish.
    """
    if not calls:
        return
    modules = [calls[0][0].__module__]
    work = run_calls_in_parallel(
        run_job_with_code_check, calls, modules, processes=jobs_in_parallel, cluster=cluster
    )
    try:
        with closing(work):
            yield from track_progress(work, len(calls), description)
    except WorkersLostError as error:
        raise click.ClickException(str(error)) from error


def run_calls_in_parallel(
    function: Callable[..., Any],
    calls: Sequence[tuple[Any, ...]],
    modules: Iterable[str] = (),
    *,
    processes: int = -1,
    cluster: str = "",
) -> parallel.IndexedResults:
    """The number of each call and its result, in the order they finish.

    function: at the top of a module.  calls: the arguments of each.  processes: on this machine,
    -1 for one a core.  cluster: address of a Dask scheduler, instead, whose workers need modules,
    too.  Raises OptionError for what a user can mend, WorkersLost, and what a call raises.
    """
    if not calls:
        return
    work = [parallel.Task(function, number, call) for number, call in enumerate(calls)]
    needed = {parallel.__name__, function.__module__, *modules}
    arriving = (
        parallel.run_on_cluster(work, cluster, needed)
        if cluster
        else run_by_joblib(work, processes)
    )
    with closing(arriving):
        yield from arriving


def run_by_joblib(work: parallel.Tasks, processes: int) -> parallel.IndexedResults:
    """By joblib in processes of one thread each on this machine."""
    if processes == 0:
        raise OptionError("0 processes: give their number, or -1 for one a core")
    joblib = import_optional("joblib", "work in several processes", parallel.JOBLIB_REQUIREMENT)
    while parallel.REUSED_PROCESS_POOL:  # joblib would take it for a pool of its own
        parallel.REUSED_PROCESS_POOL.pop().shutdown(wait=True)
    with joblib.parallel_config(backend="loky", inner_max_num_threads=1):
        pool = joblib.Parallel(n_jobs=processes, return_as="generator_unordered")
        arriving = pool(joblib.delayed(parallel.call_with_index)(*each) for each in work)
        loky = import_module("joblib.externals.loky.process_executor")
        try:
            yield from arriving
        except loky.BrokenProcessPool as error:
            raise WorkersLostError(
                "a process died: too little memory, or it was killed; start fewer at once "
                f"({type(error).__name__})"
            ) from error
        finally:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # joblib regrets the jobs that are not finished
                arriving.close()


def import_optional_module(module: str, extra: str) -> Any:
    """An optional module.  Raises OptionError with the command that installs it."""
    return import_optional(module, "this", f"minimax-cal[{extra}]")


# ---- what is kept ----------------------------------------------------------------------------


def result_cache_key(name: str, function: Callable[..., Any], job: object, code: str) -> str:
    """Names a result by all that it depends on."""
    joblib = import_optional_module("joblib", "experiments")
    return str(joblib.hash((name, function.__module__, function.__qualname__, job, code)))


def read_cached_result(path: Path) -> list[Any]:
    """[result], or [] where there is none, it is damaged or holds more than data."""
    try:
        digest, content = path.read_bytes().split(b"\n", 1)
        if digest.decode() != hashlib.sha256(content).hexdigest():
            return []
        return [DataOnlyUnpickler(io.BytesIO(content)).load()]
    except Exception:  # whatever is wrong with a kept part, it can be computed again
        return []


class DataOnlyUnpickler(pickle.Unpickler):
    """Loads what results are made of: data classes, enumerations, paths, arrays; no function.

    The digest of a part finds damage, not malice: a part may come from anywhere.
    """

    def find_class(self, module: str, name: str) -> Any:
        """A class that holds data, or what NumPy makes arrays of.  Raises UnpicklingError."""
        if (module, name) in ALLOWED_ARRAY_PICKLE_NAMES:
            return super().find_class(module, name)
        found = getattr(sys.modules.get(module), name, None)  # nothing is imported for it
        holds = isinstance(found, type) and (
            dataclasses.is_dataclass(found) or issubclass(found, Enum)
        )
        if not holds:
            raise pickle.UnpicklingError(f"{module}.{name} is no data")
        return found


def write_cached_result(path: Path, result: object) -> None:
    """Keep a result: whole, or not at all.  Raises UnpicklingError for what is not data."""
    path.parent.mkdir(parents=True, exist_ok=True)
    content = pickle.dumps(result, protocol=pickle.HIGHEST_PROTOCOL)
    DataOnlyUnpickler(io.BytesIO(content)).load()  # else it would be computed again and again
    write_file_atomically(path, hashlib.sha256(content).hexdigest().encode() + b"\n" + content)


def code_fingerprint(function: Callable[..., Any]) -> str:
    """Digest of the libraries, of the study's own files and of the packages that compute.

    A study's files are the one with the function and those beside it that it imports.
    """
    files = list_library_files() + list_study_files(Path(inspect.getfile(function)))
    parts = [f"{path.name} {file_digest(path)}" for path in files] + list_package_versions()
    return hashlib.sha256("\n".join(parts).encode()).hexdigest()


@functools.cache
def list_library_files() -> tuple[Path, ...]:
    """Code and robots of our packages."""
    files = [path for folder in LIBRARY_FOLDERS for path in sorted(folder.rglob("*"))]
    return tuple(path for path in files if path.suffix in (".py", ".json"))


@functools.cache
def list_study_files(path: Path) -> tuple[Path, ...]:
    """The file and those in its folder that it imports, directly or not."""
    found: set[Path] = set()
    waiting = [path]
    while waiting:
        here = waiting.pop()
        if (
            here not in found
            and (here == path or here.stem not in OUTPUT_MODULE_NAMES)
            and here.exists()
        ):
            found.add(here)
            waiting += [here.with_name(f"{name}.py") for name in list_imported_names(here)]
    return tuple(sorted(found))


def list_imported_names(path: Path) -> set[str]:
    """Every part of every dotted name that a file imports."""
    names: list[str] = []
    for node in ast.walk(ast.parse(path.read_bytes())):
        if isinstance(node, ast.Import | ast.ImportFrom):
            names += [alias.name for alias in node.names]
        if isinstance(node, ast.ImportFrom):
            names.append(node.module or "")
    return {word for name in names for word in name.split(".") if word}


@functools.cache
def file_digest(path: Path) -> str:
    """Digest of a file as this process first saw it: its imports do not change later either."""
    return hashlib.sha256(path.read_bytes()).hexdigest()


def list_package_versions() -> list[str]:
    """The packages whose numbers end in results."""
    found = []
    for package in NUMERICAL_PACKAGES:
        with suppress(PackageNotFoundError):
            found.append(f"{package} {version(package)}")
    return found


# ---- options of every study ------------------------------------------------------------------


@dataclass(frozen=True)
class Study:
    """What the options of every study say.

    command: the words that start it, without those that decide no figure.
    """

    name: str
    quick: bool
    json: Path | None
    out: Path
    seed: int
    jobs: int
    cluster: str
    fresh: bool
    command: str = ""

    def sweep(
        self, function: Callable[[J], R], jobs: Sequence[J], description: str = ""
    ) -> list[R]:
        """The function's result for each job, as these options ask for."""
        return sweep(
            function,
            jobs,
            name=self.name,
            description=description,
            jobs_in_parallel=self.jobs,
            cluster=self.cluster,
            fresh=self.fresh,
        )

    def save(
        self,
        tables: Sequence[Table],
        content: Mapping[str, object],
        figures: Mapping[str, Figure] | None = None,
        packages: Iterable[str] = (),
    ) -> None:
        """Leave tables, with what they were made on, figures by name, and the JSON if asked for.

        packages: whose versions matter besides the usual ones.
        """
        packages = tuple(packages)
        write_tables(self.out, self.name, [*tables, build_environment_table(packages)])
        for name, figure in (figures or {}).items():
            write_figure_files(self.out, name, figure)
        if self.json:
            made = build_run_record(self.command, packages)
            records = [table_to_json(table) for table in tables]
            write_json(self.json, {**content, "made": made, "tables": records})


class StudyMisuse(click.ClickException):
    """A user's mistake, shown in one line."""

    exit_code = 2

    def show(self, file: Any = None) -> None:
        """One line on stderr."""
        click.echo("error: " + " ".join(self.message.split()), file=file, err=True)


def study_options(name: str) -> Callable[[Callable[..., None]], click.Command]:
    """Makes a command with the options of every study, its first argument: a `Study`.

    In the module that ``python -m`` runs it starts the study: the command is its last definition.
    """
    options = (
        click.option("--quick", is_flag=True, help="A small form of the study."),
        click.option("--json", type=click.Path(path_type=Path), help="Write its figures here."),
        click.option(
            "--out",
            type=click.Path(path_type=Path, file_okay=False),
            default=Path("results") / name,
            show_default=True,
            help="Folder of tables and pictures.",
        ),
        click.option("--seed", type=int, default=0, show_default=True),
        click.option(
            "--jobs", type=int, default=-1, show_default=True, help="Processes; -1: one a core."
        ),
        click.option("--cluster", default="", help="Dask scheduler to run on: tcp://host:port."),
        click.option(
            "--fresh", is_flag=True, help=f"Use no results kept in {RESULT_CACHE_FOLDER}."
        ),
    )
    fields = tuple(field.name for field in dataclasses.fields(Study))[1:-1]

    def decorate(function: Callable[..., None]) -> click.Command:
        if function.__module__ == "__main__" and Path(inspect.getfile(function)).stem == name:
            run_study_file(inspect.getfile(function))

        @functools.wraps(function)
        def command(**given: Any) -> None:
            current_commit()  # as it is now: a long run may see the next one
            words = format_study_command(name, click.get_current_context())
            study = Study(name, **{field: given.pop(field) for field in fields}, command=words)
            try:
                function(study, **given)
            except (CalibrationError, qp_backends.BackendError) as error:
                raise StudyMisuse(str(error)) from error

        for option in reversed(options):
            command = option(command)
        return click.command(name)(command)

    return decorate


def format_study_command(name: str, context: click.Context) -> str:
    """The words that run a study again to the same figures, from the options that were given."""
    words = ["python", "-m", "experiments", name]
    for option in context.command.params:
        source = context.get_parameter_source(option.name or "")
        if (
            source != ParameterSource.COMMANDLINE
            or option.name in OPTIONS_WITHOUT_EFFECT_ON_RESULTS
        ):
            continue
        value = context.params[option.name]
        if getattr(option, "is_flag", False):
            words += [option.opts[0] if value else option.secondary_opts[0]]
            continue
        for one in value if option.multiple else (value,):
            words += [option.opts[0], str(one)]
    return shlex.join(words)


def run_study_file(file: str) -> None:
    """Run the study in this file as ``python -m`` found it.

    The module is imported under its own name, since nothing of ``__main__`` reaches a cluster.
    """
    module = f"experiments.{Path(file).stem}"
    import_module(module).main(prog_name=f"python -m {module}")
