import copy
import json
import os
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import reduce
from operator import getitem
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")  # small matrices: threads only cost
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("MINIMAX_CAL_LOOPS", "plain")  # half a minute of compiling for brief loops
os.environ.setdefault("MINIMAX_CAL_NO_FSYNC", "1")  # what tests write outlives no power cut

import click
import numpy as np
import pytest
from browsing import browsing  # stands beside this
from click.testing import CliRunner

import minimax_cal as mc
from minimax_cal.cli import main, progress
from minimax_cal.cli.options import replace_arguments_by_flags
from minimax_cal.core.errors import CalibrationError
from minimax_cal.modelling.simulate import Simulation, Truth, simulate
from minimax_cal.planning import plan, plan_predictions, planning_task

progress.SECONDS_TO_FIRST_PROGRESS_LINE = (
    60.0  # tests compare stderr, and a busy machine takes more than a second
)

ROOT = Path(__file__).parent.parent
SHARED = ROOT.parent / "shared" / "data"


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """README, pages and the like come first: they take longest, and no process waits for them."""
    items.sort(key=lambda item: item.path.parent != Path(__file__).parent)


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_auto_num_workers(config: pytest.Config) -> int:
    """One more than cores: browsers, servers and clusters make their tests wait."""
    return (os.cpu_count() or 1) + 1


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> Any:
    """Tests beside each other stay in one process, which then makes their fixtures once."""
    from xdist.scheduler import WorkStealingScheduling

    return WorkStealingScheduling(config, log) if config.getoption("dist") == "load" else None


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(20260101)


@pytest.fixture(scope="session")
def robot() -> mc.Robot:
    return mc.load_robot("irb2600")


@pytest.fixture(scope="session")
def noisy(robot: mc.Robot) -> Simulation:
    """Geometric errors, compliance and tracker noise; its files look as those of a tracker."""
    made = simulate(robot, 60, 3, seed=5)
    return replace(made, data=replace(made.data, simulated=False))


@pytest.fixture(scope="session")
def fit(robot: mc.Robot, noisy: Simulation) -> mc.Fit:
    return mc.calibrate(robot, noisy.data, "sum")


@pytest.fixture(scope="session")
def clean(robot: mc.Robot) -> Simulation:
    """Geometric errors only: the true robot can be found to rounding."""
    return simulate(robot, 60, 3, seed=6, truth=Truth(compliance=0, noise=0, noise_per_metre=0))


@pytest.fixture(scope="session")
def results(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A calibration and a diagnosis of one file of measurements."""
    folder = tmp_path_factory.mktemp("report")
    made = simulate(mc.load_robot("ur10"), 50, 3, seed=1, truth=Truth(compliance=2e-6))
    mc.write_measurements(folder / "poses.csv", made.data)
    data = mc.read_measurements(folder / "poses.csv")
    mc.calibrate("ur10", data).save(folder / "fit.json")
    mc.diagnose("ur10", data).save(folder / "gap.json")
    return folder


@pytest.fixture(scope="module")
def few_candidates() -> Iterator[None]:
    """Plans sooner: what is written, seen and promised is the same; poses need not be best."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(plan, "REFINEMENT_STEP_FRACTIONS", (0.05,))
        patch.setattr(plan, "POSES_KEPT_PER_REFINEMENT", 60)
        patch.setattr(planning_task, "WORKSPACE_PREDICTION_POSES", 250)
        patch.setattr(plan_predictions, "COMPARED_POSE_COUNT_RATIOS", (0.5, 1.0))
        patch.setattr(plan_predictions, "RANDOM_DESIGNS_PER_MEDIAN", 20)
        yield


@pytest.fixture(scope="session")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    """The page to work in, served once for all tests that ask it."""
    from served import serving  # stands beside those tests

    with serving(tmp_path_factory.mktemp("sessions")) as found:
        yield found


@pytest.fixture(scope="session")
def downloads(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where the browser keeps what it is given."""
    return tmp_path_factory.mktemp("downloads")


@pytest.fixture(scope="session")
def driver(downloads: Path) -> Iterator[Any]:
    """The browser of all tests that look at pages."""
    with browsing(downloads) as found:
        yield found


@pytest.fixture(scope="session")
def browser() -> None:
    """Skips where no browser can print a page."""
    from minimax_cal.reporting.html import find_browser

    try:
        find_browser()
    except CalibrationError as error:
        pytest.skip(str(error))


def shared(name: str) -> tuple[str, str]:
    """Robot and measurement files of a real arm; skips where they are not there."""
    folder = SHARED / name
    if not folder.is_dir():
        pytest.skip(f"real measurements {folder} are not on this machine")
    return str(folder / "robot.json"), str(folder / "measurements.csv")


def run(first: object = "", *rest: object) -> int:
    """A command line in this process; its exit code.  first: words that blanks separate."""
    with pytest.raises(SystemExit) as ended:
        main([*str(first).split(), *map(str, rest)])
    code = ended.value.code
    return code if isinstance(code, int) else 0


@pytest.fixture
def says(capsys: pytest.CaptureFixture[str]) -> Callable[..., Any]:
    """What a command line says on stdout and stderr, having ended with this code."""

    def ask(*arguments: object, code: int = 0) -> Any:
        capsys.readouterr()
        assert run(*arguments) == code, capsys.readouterr().err
        return capsys.readouterr()

    return ask


@pytest.fixture
def answered(says: Callable[..., Any]) -> Callable[..., Any]:
    """What a command line answers in JSON, which stands on stdout alone."""
    return lambda *arguments: json.loads(says(*arguments, "--json").out)


@pytest.fixture
def refuses(says: Callable[..., Any]) -> Callable[..., None]:
    """Checks that a command line ends in one line of error that says so, and nothing else."""

    def check(words: str, *arguments: object) -> None:
        out, err = says(*arguments, code=2)
        (line,) = (line for line in err.splitlines() if line.startswith("error: "))
        assert words in line
        assert "Traceback" not in err
        assert out == ""

    return check


def invoked(command: click.Command, *arguments: object) -> tuple[int, str, str]:
    """Exit code, stdout, stderr of a command as `main` would run it."""
    result = CliRunner().invoke(command, [str(a) for a in arguments], standalone_mode=False)
    if isinstance(result.exception, CalibrationError | click.ClickException):
        return 2, result.stdout, replace_arguments_by_flags(str(result.exception), command)
    if result.exception:
        raise result.exception
    return int(result.return_value), result.stdout, result.stderr


def slipped(whole: Any, rng: np.random.Generator, odd: Sequence[Any], gone: float) -> Any:
    """A JSON with an odd value at one place, or its key gone in a share of the cases."""
    content, every = copy.deepcopy(whole), spots(whole)
    *way, last = every[rng.integers(len(every))]
    part = reduce(getitem, way, content)
    if gone and rng.random() < gone and isinstance(last, str):
        del part[last]
    else:
        part[last] = odd[rng.integers(len(odd))]
    return content


def spots(value: Any, at: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    """Every place in a JSON; of a long list the first entry only."""
    if not isinstance(value, dict | list):
        return []
    parts = value.items() if isinstance(value, dict) else enumerate(value[:1])
    return [spot for key, part in parts for spot in ((*at, key), *spots(part, (*at, key)))]
