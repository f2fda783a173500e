"""What keeps the page from being served is one line, before any browser opens."""

import socket
import sys

import pytest
from conftest import run


@pytest.mark.parametrize("missing", ["uvicorn", "starlette", "plotly.offline"])
def test_a_missing_extra_is_named(missing, tmp_path, monkeypatch, capsys):
    pytest.importorskip("uvicorn", reason="the page needs pip install minimax-cal[app]")
    monkeypatch.setitem(sys.modules, missing, None)
    assert run("serve", "--no-browser", "--folder", tmp_path / "sessions") == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert missing.partition(".")[0] in line
    assert "pip install" in line
    assert not (tmp_path / "sessions").exists()


def test_a_port_that_is_taken(tmp_path, capsys):
    pytest.importorskip("uvicorn", reason="the page needs pip install minimax-cal[app]")
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        assert run("serve", "--no-browser", "--folder", tmp_path, "--port", port) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(f"error: --port {port}: cannot be had")


def test_a_folder_that_cannot_be(tmp_path, capsys):
    pytest.importorskip("uvicorn", reason="the page needs pip install minimax-cal[app]")
    (tmp_path / "file").write_text("x")
    assert run("serve", "--no-browser", "--folder", tmp_path / "file" / "sessions") == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "cannot be made" in line
