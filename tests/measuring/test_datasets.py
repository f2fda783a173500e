"""Public sets, from files made here and a server on this machine; no other network."""

import hashlib
import threading
from collections.abc import Iterator
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose
from test_importers import tracker6d_text

import minimax_cal as mc
from minimax_cal.measuring import datasets
from minimax_cal.modelling.simulate import simulate

NAME = "Series_B/measurements_joint_configurations.csv"


class Quiet(SimpleHTTPRequestHandler):
    def log_message(self, format: str, *args: object) -> None:
        """Nothing on stderr."""


@pytest.fixture(scope="module")
def truth() -> mc.Measurements:
    return simulate(mc.load_robot("ur10"), 60, 1, seed=9).data


@pytest.fixture
def published(tmp_path: Path, truth: mc.Measurements, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder as the repository is, with a file of the set's form; and an empty cache."""
    monkeypatch.delenv(datasets.DATA_FOLDER_VARIABLE, raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setenv("NO_PROXY", "127.0.0.1")
    path = tmp_path / "repository" / NAME
    path.parent.mkdir(parents=True)
    path.write_text(tracker6d_text(truth))
    return tmp_path / "repository"


@pytest.fixture
def server(published: Path) -> Iterator[str]:
    with ThreadingHTTPServer(("127.0.0.1", 0), partial(Quiet, directory=published)) as server:
        thread = threading.Thread(target=server.serve_forever, daemon=True)
        thread.start()
        yield f"http://127.0.0.1:{server.server_address[1]}"
        server.shutdown()
        thread.join()


def source_at(url: str, sha256: str) -> datasets.Source:
    return datasets.Source(NAME, f"{url}/{NAME}", sha256, "MIT", "nobody")


def sha_of(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


def test_from_a_folder(published, truth, monkeypatch):
    robot, data = datasets.fetch_ur10("B", published)
    assert robot.joints == 6
    assert_allclose(data.q, truth.q, atol=1e-8)
    assert_allclose(data.y, truth.y, atol=2e-9)
    assert_allclose(data.columns["temperature"], 21.5)
    assert "MIT" in "".join(data.notices)
    assert sha_of(published / NAME) in "".join(data.notices)
    fit = mc.calibrate(robot, data, objective="sum")
    assert fit.accuracy["holdout"].rms_mm < fit.accuracy["nominal"].rms_mm
    monkeypatch.setenv(
        datasets.DATA_FOLDER_VARIABLE, str((published / NAME).parent)
    )  # the bare file is found too
    _, again = datasets.fetch_ur10()
    assert_allclose(again.y, data.y, rtol=0, atol=0)


def test_a_folder_without_the_file(published, tmp_path, monkeypatch):
    with pytest.raises(
        mc.DataError, match=r"measurements_random_poses.csv: is not there; download"
    ):
        datasets.fetch_ur10("C", published, unverified=True)
    monkeypatch.setenv(datasets.DATA_FOLDER_VARIABLE, str(tmp_path / "nowhere"))
    with pytest.raises(mc.DataError, match="is not there"):
        datasets.fetch_ur10()
    with pytest.raises(mc.OptionError, match="choose one of A, B, C, D"):
        datasets.fetch_ur10("E")


def test_an_unknown_hash_is_not_downloaded(published):
    for series, source in datasets.UR10.items():
        if not source.sha256:
            with pytest.raises(mc.DataError, match=r"not known.*unverified=True"):
                datasets.fetch_ur10(series)


def test_download_with_a_known_hash_is_cached(published, server, tmp_path, monkeypatch):
    source = source_at(server, sha_of(published / NAME))
    path = datasets.fetch(source)
    assert path.is_relative_to(tmp_path / "cache")
    assert path.read_bytes() == (published / NAME).read_bytes()
    (published / NAME).unlink()
    assert datasets.fetch(source) == path  # from the cache


def test_download_with_another_hash_is_refused(published, server, tmp_path):
    source = source_at(server, "0" * 64)
    with pytest.raises(mc.DataError, match="is not the file that was published"):
        datasets.fetch(source)
    assert not list((tmp_path / "cache").rglob("*.csv"))
    with pytest.raises(mc.DataError, match=r"expected 0000"):
        datasets.fetch(source, published)


def test_download_unverified_and_not_there(published, server, monkeypatch):
    monkeypatch.setitem(datasets.UR10, "B", source_at(server, datasets.UNKNOWN_HASH))
    _, data = datasets.fetch_ur10("B", unverified=True)
    assert "not verified" in data.notices[0]
    assert np.isfinite(data.y).all()
    missing = source_at(f"{server}/none", "0" * 64)
    with pytest.raises(mc.CalibrationError, match="cannot be downloaded"):
        datasets.fetch(missing)
