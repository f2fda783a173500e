"""A real Dask cluster on loopback: the same results, and one line when something is wrong."""

import importlib.util
import json
import os
import subprocess
import sys
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import click
import numpy as np
import pytest
from conftest import run
from numpy.testing import assert_allclose, assert_array_equal
from test_sweep import ENVIRONMENT, JOBS, Job, kill_worker, missing, same, wait_for, work

import minimax_cal as mc
from experiments import sweep as module
from experiments.sweep import sweep
from minimax_cal.ground import parallel
from minimax_cal.ground.errors import OptionError


@pytest.fixture(scope="module")
def cluster(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """A real Dask scheduler and two worker processes on loopback."""
    if importlib.util.find_spec("distributed") is None:
        pytest.skip("distributed is not installed: pip install 'minimax-cal[distributed]'")
    folder = tmp_path_factory.mktemp("cluster")
    file, log = folder / "scheduler.json", (folder / "log").open("w")
    dask = [sys.executable, "-m", "dask"]
    settings = {"DASK_DISTRIBUTED__SCHEDULER__ALLOWED_FAILURES": "0"}
    place = dict(env=ENVIRONMENT | settings, cwd=folder, stdout=log, stderr=log)
    options = ["--host", "127.0.0.1", "--port", "0", "--dashboard-address", "127.0.0.1:0"]
    running = [
        subprocess.Popen([*dask, "scheduler", *options, "--scheduler-file", str(file)], **place)
    ]
    try:
        wait_for(file.exists)
        address = json.loads(file.read_text())["address"]
        size = ["--nworkers", "2", "--nthreads", "1", "--dashboard-address", "127.0.0.1:0"]
        running += [subprocess.Popen([*dask, "worker", address, *size], **place)]
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(parallel, "PATIENCE", 60.0)  # a loaded machine answers late
            yield address
    finally:
        for process in reversed(running):  # workers first: they sign off at the scheduler
            process.terminate()
            try:
                process.wait(10)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
        log.close()


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


def test_a_fleet_is_what_one_process_finds(cluster, tmp_path, capsys):
    cells = tmp_path / "cells.toml"
    lines = ['[defaults]\nrobot = "irb120"\nobjective = "sum"\ntolerance = "rms 0.5"']
    for name in ("0", "1"):
        sheet = mc.simulate("irb120", 30, 1, int(name)).data
        mc.write_measurements(tmp_path / f"{name}.csv", sheet)
        lines.append(f'[[cells]]\nname = "{name}"\ndata = "{name}.csv"')
    lines.append('[[cells]]\nname = "none"\ndata = "none.csv"')
    cells.write_text("\n".join(lines))
    assert run("fleet", cells, "--cluster", cluster, "--json") == 1
    told = json.loads(capsys.readouterr().out)
    assert [row["status"] for row in told["rows"]] == ["converged", "converged", "failed"]
    assert told == mc.fleet(cells, processes=1).to_dict()


def test_a_cluster_with_other_code_is_refused(cluster, tmp_path, monkeypatch):
    monkeypatch.setattr(module, "fingerprint", lambda function: "other")
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


@pytest.fixture
def deserted(tmp_path: Path) -> Iterator[tuple[str, list[subprocess.Popen[bytes]]]]:
    """A scheduler and its one worker, without a nanny; for tests that end them."""
    pytest.importorskip("distributed")
    file = tmp_path / "scheduler.json"
    quiet = dict(env=ENVIRONMENT, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    dask = [sys.executable, "-m", "dask"]
    place = ["--host", "127.0.0.1", "--port", "0", "--dashboard-address", "127.0.0.1:0"]
    running = [
        subprocess.Popen([*dask, "scheduler", *place, "--scheduler-file", str(file)], **quiet)
    ]
    try:
        wait_for(lambda: file.exists() and file.stat().st_size)
        address = json.loads(file.read_text())["address"]
        size = ["--no-nanny", "--nthreads", "1", "--dashboard-address", "127.0.0.1:0"]
        running += [subprocess.Popen([*dask, "worker", address, *size], **quiet)]
        yield address, running
    finally:
        for process in running:
            process.kill()
            process.wait()


@pytest.mark.parametrize("dead", ["worker", "scheduler"])
def test_a_deserted_cluster_is_not_waited_for(dead, deserted, tmp_path, monkeypatch):
    monkeypatch.setattr(parallel, "PATIENCE", 60.0)
    monkeypatch.setattr(parallel, "DESERTED", 1.0)
    monkeypatch.setattr(parallel, "WATCH", 0.2)
    address, running = deserted
    log = tmp_path / "log"
    jobs = [Job(seed, str(log), 0.3) for seed in range(100)]

    def end() -> None:
        wait_for(lambda: any(tmp_path.glob("deserted/*.part")))
        running[dead == "worker"].kill()

    with ThreadPoolExecutor(1) as other:
        ending = other.submit(end)
        with pytest.raises(click.ClickException, match="tcp://"):
            sweep(work, jobs, name="deserted", cluster=address, folder=tmp_path)
    ending.result()
    assert len(list(tmp_path.glob("deserted/*.part"))) >= 1  # what arrived is kept
