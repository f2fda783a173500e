import hashlib
import importlib.util
import json
import math
import os
import pickle
import re
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from types import ModuleType
from typing import Any

import click
import numpy as np
import pytest
from click.testing import CliRunner, Result
from numpy.testing import assert_allclose, assert_array_equal

import minimax_cal as mc
from experiments import __main__ as studies
from experiments import sweep as module
from experiments.study_record import write_figure_files, write_json, write_tables
from experiments.sweep import Study, study_options, sweep
from minimax_cal.core import parallel
from minimax_cal.core.errors import OptionError
from minimax_cal.core.tables import Table

# ---- sweep ---------------------------------------------------------------------------------------


HERE = Path(__file__).parent  # which workers import too, where there is no conftest
ENVIRONMENT = os.environ | {"PYTHONPATH": os.pathsep.join([str(HERE.parents[1]), str(HERE)])}


@dataclass(frozen=True)
class Job:
    seed: int
    log: str = ""
    seconds: float = 0.0


@dataclass(frozen=True)
class Found:
    seed: int
    values: np.ndarray
    process: int


def work(job: Job) -> Found:
    """Numbers that depend on the job alone; later jobs are faster, so they finish out of order."""
    time.sleep(job.seconds or 0.01 * (5 - job.seed % 5))
    if job.log:
        with Path(job.log).open("a") as stream:
            stream.write(f"{job.seed}\n")
    matrix = np.random.default_rng(job.seed).normal(size=(20, 20))
    return Found(job.seed, np.linalg.svd(matrix)[1], os.getpid())


def kill_worker(job: int) -> int:
    if job == 1:
        os._exit(9)
    return job


def missing(job: int) -> int:
    raise ModuleNotFoundError(f"no extra for {job}")


JOBS = [Job(seed) for seed in range(12)]


def same(left: list[Found], right: list[Found]) -> bool:
    """Equal to the last bit and in the same order."""
    pairs = zip(left, right, strict=True)
    return all(a.seed == b.seed and a.values.tobytes() == b.values.tobytes() for a, b in pairs)


@pytest.fixture(scope="module")
def expected() -> list[Found]:
    return [work(job) for job in JOBS]


# ---- on this machine -------------------------------------------------------------------------


@pytest.mark.parametrize("processes", [1, 2])
def test_results_in_the_order_of_the_jobs(processes, expected, tmp_path):
    found = sweep(work, JOBS, name="order", jobs_in_parallel=processes, folder=tmp_path)
    assert same(found, expected)
    assert (os.getpid() in {each.process for each in found}) == (processes == 1)


def test_kept_results_are_used_unless_fresh(tmp_path, capsys):
    log = tmp_path / "log"
    jobs = [Job(seed, str(log)) for seed in range(4)]
    one = dict(name="kept", jobs_in_parallel=1, folder=tmp_path)
    first = sweep(work, jobs[:3], **one)
    again = sweep(work, jobs, **one)
    assert same(again[:3], first)
    assert log.read_text().split() == ["0", "1", "2", "3"]
    assert "3 of 4 parts were kept" in capsys.readouterr().err
    sweep(work, jobs, fresh=True, **one)
    assert len(log.read_text().split()) == 8


def test_damaged_parts_are_computed_again(expected, tmp_path):
    one = dict(name="damage", jobs_in_parallel=1, folder=tmp_path)
    sweep(work, JOBS, **one)
    paths = sorted((tmp_path / "damage").iterdir())
    assert len(paths) == len(JOBS)
    paths[0].write_bytes(b"")
    paths[1].write_bytes(paths[1].read_bytes()[:-7])
    flipped = bytearray(paths[2].read_bytes())
    flipped[-20] ^= 1
    paths[2].write_bytes(bytes(flipped))
    nonsense = b"not a pickle"
    paths[3].write_bytes(hashlib.sha256(nonsense).hexdigest().encode() + b"\n" + nonsense)
    gone = pickle.dumps(Found(0, np.zeros(1), 0)).replace(b"Found", b"Gonee")
    paths[4].write_bytes(hashlib.sha256(gone).hexdigest().encode() + b"\n" + gone)
    assert [len(module.read_cached_result(path)) for path in paths[:6]] == [0, 0, 0, 0, 0, 1]
    assert same(sweep(work, JOBS, **one), expected)
    assert all(module.read_cached_result(path) for path in paths)


class Trap:
    """Runs code when a pickle is loaded without care."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> Any:
        return Path.touch, (self.path,)


def test_a_part_holds_data_and_runs_nothing(tmp_path):
    """Whoever writes into the cache can still make no code run."""
    part, sprung = tmp_path / "x.part", tmp_path / "sprung"
    for content in (pickle.dumps(Trap(sprung)), pickle.dumps([os.system, "true"])):
        part.write_bytes(hashlib.sha256(content).hexdigest().encode() + b"\n" + content)
        assert module.read_cached_result(part) == []
    assert not sprung.exists()
    with pytest.raises(pickle.UnpicklingError, match="is no data"):
        module.write_cached_result(part, work)
    good = {"a": (Found(1, np.arange(3.0), 2), None), "b": [np.float64(2.5), Path("x"), "y"]}
    module.write_cached_result(part, good)
    (found,) = module.read_cached_result(part)
    assert found["a"][0].values.tolist() == [0.0, 1.0, 2.0]
    assert found["b"] == good["b"]


def test_a_process_that_dies_ends_the_sweep_in_a_word(tmp_path):
    with pytest.raises(click.ClickException, match="a process died"):
        sweep(kill_worker, [0, 1, 2], name="dead", jobs_in_parallel=2, folder=tmp_path)


def wait_for(ready: Any, seconds: float = 120.0) -> None:
    until = time.monotonic() + seconds
    while not ready():
        assert time.monotonic() < until, "waited in vain"
        time.sleep(0.05)


SCRIPT = """
import signal
import sys
from pathlib import Path
from experiments.sweep import sweep
from test_sweep import Job, work
signal.signal(signal.SIGINT, signal.default_int_handler)  # which background jobs may ignore
folder = Path(sys.argv[1])
jobs = [Job(seed, str(folder / "log"), 0.15) for seed in range(20)]
sweep(work, jobs, name="interrupted", jobs_in_parallel=2, folder=folder)
"""


@pytest.mark.skipif(sys.platform == "win32", reason="Ctrl-C is sent as a signal")
def test_an_interrupted_sweep_resumes(tmp_path):
    child = subprocess.Popen(
        [sys.executable, "-c", SCRIPT, str(tmp_path)],
        env=ENVIRONMENT,
        stderr=subprocess.PIPE,
        text=True,
    )
    wait_for(lambda: len(list(tmp_path.glob("interrupted/*.part"))) >= 4)
    child.send_signal(signal.SIGINT)
    _, said = child.communicate(timeout=120)
    assert child.returncode != 0
    kept = len(list(tmp_path.glob("interrupted/*.part")))
    assert 4 <= kept < 20
    assert f"{kept} of 20 parts are kept" in said
    log = tmp_path / "log"
    log.unlink()
    jobs = [Job(seed, str(log), 0.15) for seed in range(20)]
    found = sweep(work, jobs, name="interrupted", jobs_in_parallel=2, folder=tmp_path)
    assert len(log.read_text().split()) == 20 - kept
    assert same(found, [work(Job(seed)) for seed in range(20)])


def test_functions_and_options_that_cannot_work(tmp_path):
    with pytest.raises(TypeError, match="top of a module"):
        sweep(lambda job: job, [1], name="lambda", folder=tmp_path)
    with pytest.raises(OptionError, match="--jobs 0"):
        sweep(work, JOBS, name="none", jobs_in_parallel=0, folder=tmp_path)
    assert sweep(work, [], name="empty", folder=tmp_path) == []


# ---- options of a study ----------------------------------------------------------------------


@study_options("toy")
@click.option("--more", default=1)
def toy(study: Study, more: int) -> None:
    click.echo(f"{study} {more}")
    study.sweep(work, JOBS[:2])


def run_toy(*arguments: str) -> Result:
    return CliRunner().invoke(toy, arguments)


def test_nobody_at_the_address(tmp_path, monkeypatch):
    pytest.importorskip("distributed")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(parallel, "SCHEDULER_TIMEOUT_SECONDS", 1.0)
    with socket.create_server(("127.0.0.1", 0)) as silent:  # it listens, but never says a word
        port = silent.getsockname()[1]
        for address in (f"tcp://127.0.0.1:{port}", "nonsense", "tcp://127.0.0.1:1"):
            began = time.monotonic()
            result = run_toy("--cluster", address)
            assert time.monotonic() - began < 30  # a loaded machine takes its time, too
            assert result.exit_code == 2
            line = result.stderr.splitlines()[-1]
            assert line.startswith(f"error: no Dask scheduler at {address!r}")


@pytest.mark.parametrize(
    ("package", "extra", "options"),
    [("distributed", "distributed", ["--cluster", "tcp://h:1"]), ("joblib", "experiments", [])],
)
def test_a_missing_package_is_named(package, extra, options, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(sys.modules, package, None)
    result = run_toy(*options)
    assert result.exit_code == 2
    assert f'pip install ".[{extra}]"' in result.stderr.splitlines()[-1]


# ---- all studies -----------------------------------------------------------------------------


HOSTILE = "<script>alert('x')</script> & \"quoted\" | bar"


def fake(name: str, monkeypatch: pytest.MonkeyPatch, body: Any) -> None:
    """A module of the studies with a command `main` that does body(study)."""
    made = ModuleType(name)
    made.main = study_options(name)(body)
    monkeypatch.setitem(sys.modules, f"experiments.{name}", made)


def good(study: Study) -> None:
    from matplotlib.figure import Figure

    table = Table(HOSTILE, ("what", HOSTILE), ((HOSTILE, 1.5), ("b", 2.0)), ("", ".2f"))
    write_tables(study.out, study.name, [table])
    figure = Figure(figsize=(1, 1))
    figure.subplots()
    write_figure_files(study.out, "a picture", figure)
    assert study.json
    write_json(study.json, {"seed": study.seed, "quick": study.quick, "unknown": [math.nan]})


def bad(study: Study) -> None:
    raise ValueError(HOSTILE)


def test_all_studies_make_one_page(tmp_path, monkeypatch, capsys):
    fake("fake_bad", monkeypatch, bad)
    fake("fake_good", monkeypatch, good)
    monkeypatch.setattr(studies, "STUDY_NAMES", ("fake_bad", "fake_good"))
    monkeypatch.setattr(studies, "read_study_description", lambda name: HOSTILE)
    out, numbers = tmp_path / "out", tmp_path / "all.json"
    (out / "fake_good").mkdir(parents=True)
    (out / "fake_good" / "old_1.csv").write_text("of an earlier run")
    (out / "fake_good" / "old.html").write_text("<table><tr><td>stale</td></tr></table>")
    options = ["--quick", "--seed", "7", "--out", str(out), "--json", str(numbers)]
    result = CliRunner().invoke(studies.run_every_study, options)
    assert result.exit_code == 1
    assert result.stderr.splitlines()[-1] == "Error: failed: fake_bad"
    page = (out / "index.html").read_text()
    assert "<script" not in page
    assert "ValueError: &lt;script&gt;" in page
    assert "stale" not in page
    assert "old_1.csv" not in page
    assert '<td class="right">1.50</td>' in page
    assert "python -m experiments all --quick --seed 7" in page
    for url in ("a%20picture.png", "a%20picture.svg", "fake_good_1.csv", "fake_good.tex"):
        assert f'"fake_good/{url}"' in page
    assert "http" not in page
    assert str(tmp_path) not in page
    found = json.loads(numbers.read_text())["studies"]
    assert [found[name]["status"] for name in found] == ["failed", "done"]
    assert found["fake_good"]["numbers"] == {
        "schema": 1,
        "seed": 7,
        "quick": True,
        "unknown": [None],
    }
    CliRunner().invoke(studies.run_every_study, options)
    assert (out / "index.html").read_text() == page


def test_studies_are_listed_and_run_by_name(monkeypatch, capsys, tmp_path):
    studies.main([])
    listed = capsys.readouterr().out
    for name in studies.STUDY_NAMES:
        assert re.search(rf"^  {name} +\w.{{30,}}$", listed, re.MULTILINE), name
    with pytest.raises(SystemExit) as ended:
        studies.main(["speeed"])
    assert ended.value.code == 2
    assert capsys.readouterr().err.startswith("error: no study 'speeed'")
    fake("fake_good", monkeypatch, good)
    monkeypatch.setattr(studies, "STUDY_NAMES", ("fake_good",))
    with pytest.raises(SystemExit) as ended:
        studies.main(["fake_good", "--out", str(tmp_path), "--json", str(tmp_path / "x.json")])
    assert ended.value.code == 0
    assert (tmp_path / "fake_good.md").exists()


# ---- cluster -------------------------------------------------------------------------------------


@contextmanager
def dask(folder: Path, *worker: str, **more: Any) -> Iterator[tuple[str, list[Any]]]:
    """A real Dask scheduler on loopback and its worker, as their address and processes."""
    if importlib.util.find_spec("distributed") is None:
        pytest.skip("distributed is not installed: pip install 'minimax-cal[distributed]'")
    file, here = folder / "scheduler.json", ["--dashboard-address", "127.0.0.1:0"]
    quiet = {"cwd": folder, "stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    start = partial(subprocess.Popen, env=ENVIRONMENT | more, **quiet)
    command = [sys.executable, "-m", "dask"]
    place = ["--host", "127.0.0.1", "--port", "0", "--scheduler-file", str(file)]
    running = [start([*command, "scheduler", *place, *here])]
    try:
        wait_for(lambda: file.exists() and file.stat().st_size)
        address = json.loads(file.read_text())["address"]
        running.append(start([*command, "worker", address, *worker, *here]))
        yield address, running
    finally:
        for process in reversed(running):  # workers first: they sign off at the scheduler
            process.terminate()
            try:
                process.wait(10)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()


@pytest.fixture(scope="module")
def cluster(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """A cluster of two worker processes."""
    size = ("--nworkers", "2", "--nthreads", "1")
    failures = {"DASK_DISTRIBUTED__SCHEDULER__ALLOWED_FAILURES": "0"}
    folder = tmp_path_factory.mktemp("cluster")
    patched = pytest.MonkeyPatch.context()
    with dask(folder, *size, **failures) as (address, _), patched as patch:
        patch.setattr(parallel, "SCHEDULER_TIMEOUT_SECONDS", 60.0)  # a loaded machine answers late
        yield address


def test_a_cluster_gives_the_same_results(cluster, tmp_path):
    expected = [work(job) for job in JOBS]
    found = sweep(work, JOBS, name="dask", cluster=cluster, folder=tmp_path)
    assert same(found, expected)
    processes = {each.process for each in found}
    assert len(processes) == 2
    assert os.getpid() not in processes
    again = sweep(work, JOBS, name="dask", folder=tmp_path)  # kept: no matter where it ran
    assert same(again, expected)
    assert {each.process for each in again} == processes


def test_calibrate_many_is_what_one_process_finds(cluster):
    sheets = [mc.simulate("irb120", 30, 1, seed).data for seed in range(2)]
    broken = sheets[0].take(np.arange(2))
    found = mc.calibrate_many("irb120", [sheets[0], broken, sheets[1]], cluster=cluster)
    assert isinstance(found[1], mc.CalibrationError)
    for fit, sheet in zip(found[::2], sheets, strict=True):
        assert isinstance(fit, mc.Fit)
        assert_array_equal(fit.robot.mdh, mc.calibrate("irb120", sheet).robot.mdh)


@pytest.mark.slow
def test_a_diagnosis_is_what_one_process_finds(cluster):
    data = mc.simulate("irb120", 60, 1, 1, truth=mc.Truth(compliance=3e-6)).data
    alone, found = mc.diagnose("irb120", data), mc.diagnose("irb120", data, cluster=cluster)
    assert found.verdict == alone.verdict
    assert [f.term.text for f in found.effects] == [f.term.text for f in alone.effects]
    assert_allclose(found.beyond.typical_mm, alone.beyond.typical_mm, rtol=1e-12)


def test_a_cluster_with_other_code_is_refused(cluster, tmp_path, monkeypatch):
    monkeypatch.setattr(module, "code_fingerprint", lambda function: "other")
    with pytest.raises(OptionError, match="other code"):
        sweep(work, JOBS, name="other", cluster=cluster, folder=tmp_path)


def test_a_cluster_without_the_study_is_refused(cluster, tmp_path, monkeypatch):
    (tmp_path / "only_here.py").write_text("def work(job):\n    return job\n")
    monkeypatch.syspath_prepend(tmp_path)
    import only_here

    with pytest.raises(OptionError, match="no module 'only_here'"):
        sweep(only_here.work, [1, 2], name="lost", cluster=cluster, folder=tmp_path)


def test_errors_of_a_job_come_back_from_a_cluster(cluster, tmp_path):
    with pytest.raises(ModuleNotFoundError, match="no extra for"):
        sweep(missing, [1, 2], name="error", cluster=cluster, folder=tmp_path)


def test_a_job_that_kills_its_worker_ends_the_sweep(cluster, tmp_path):
    with pytest.raises(click.ClickException, match="worker"):  # joblib's backend waits for ever
        sweep(kill_worker, [0, 1], name="killed", cluster=cluster, folder=tmp_path)


@pytest.mark.parametrize("dead", ["worker", "scheduler"])
def test_a_deserted_cluster_is_not_waited_for(dead, tmp_path, monkeypatch):
    monkeypatch.setattr(parallel, "SCHEDULER_TIMEOUT_SECONDS", 60.0)
    monkeypatch.setattr(parallel, "MAX_SECONDS_WITHOUT_WORKERS", 1.0)
    monkeypatch.setattr(parallel, "CLUSTER_POLL_SECONDS", 0.2)
    jobs = [Job(seed, str(tmp_path / "log"), 0.3) for seed in range(100)]
    with dask(tmp_path, "--no-nanny", "--nthreads", "1") as (address, running):

        def end() -> None:
            wait_for(lambda: any(tmp_path.glob("deserted/*.part")))
            running[dead == "worker"].kill()

        with ThreadPoolExecutor(1) as other:
            ending = other.submit(end)
            with pytest.raises(click.ClickException, match="tcp://"):
                sweep(work, jobs, name="deserted", cluster=address, folder=tmp_path)
        ending.result()
    assert len(list(tmp_path.glob("deserted/*.part"))) >= 1  # what arrived is kept
