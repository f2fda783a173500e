"""Files that come and go whole, whatever lies in their way."""

import errno
import os
import stat
from pathlib import Path
from typing import Any

import pytest

from minimax_cal.core.errors import CalibrationError, DataError
from minimax_cal.core.files import check_output_path, read_bytes, read_text, write_file_atomically


def test_links_in_a_circle_are_said(tmp_path):
    loop = tmp_path / "loop"
    loop.symlink_to(loop)
    for write in (check_output_path, lambda path: write_file_atomically(path, "text")):
        with pytest.raises(CalibrationError, match="its links lead nowhere"):
            write(loop)


def test_a_file_keeps_its_permissions(tmp_path):
    path = tmp_path / "result.json"
    path.write_text("")
    path.chmod(0o600)
    write_file_atomically(path, "text")
    assert stat.S_IMODE(path.stat().st_mode) == 0o600
    assert path.read_text() == "text"


@pytest.mark.skipif(not Path("/dev/zero").exists(), reason="there is no /dev/zero to read")
def test_what_never_ends_is_refused():
    with pytest.raises(DataError, match="is larger than 1 MiB"):
        read_bytes("/dev/zero", error_type=DataError, max_bytes=1 << 20)


def test_lines_end_alike(tmp_path):
    path = tmp_path / "text"
    path.write_bytes(b"\xef\xbb\xbfa\r\nb\rc\n")
    assert read_text(path) == "a\nb\nc\n"
    assert os.listdir(tmp_path) == ["text"]


def test_a_name_may_be_long_and_not_longer(tmp_path):
    write_file_atomically(tmp_path / ("n" * 255), "text")
    assert os.listdir(tmp_path) == ["n" * 255]
    check_output_path(tmp_path / ("n" * 254))
    for write in (check_output_path, lambda path: write_file_atomically(path, "text")):
        with pytest.raises(CalibrationError, match="its name is too long"):
            write(tmp_path / ("n" * 300))
    assert os.listdir(tmp_path) == ["n" * 255]


def listen(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """What is put on the disk and renamed, in its order."""
    heard: list[str] = []
    sync, replace = os.fsync, os.replace

    def fsync(handle: int) -> None:
        heard.append("folder" if stat.S_ISDIR(os.fstat(handle).st_mode) else "file")
        sync(handle)

    def renamed(*names: Any) -> None:
        heard.append("name")
        replace(*names)

    monkeypatch.setattr(os, "fsync", fsync)
    monkeypatch.setattr(os, "replace", renamed)
    return heard


@pytest.mark.skipif(os.name == "nt", reason="Windows cannot open a folder")
def test_file_and_folder_are_on_the_disk(tmp_path, monkeypatch):
    """A name must not reach the disk before its content, nor the caller hear "done" before both."""
    heard = listen(monkeypatch)
    monkeypatch.delenv("MINIMAX_CAL_NO_FSYNC", raising=False)
    write_file_atomically(tmp_path / "fit.json", "text")
    assert heard == ["file", "name", "folder"]
    heard.clear()
    monkeypatch.setenv("MINIMAX_CAL_NO_FSYNC", "1")
    write_file_atomically(tmp_path / "fit.json", "text")
    assert heard == ["name"]


@pytest.mark.parametrize(("number", "is_refused"), [(errno.EIO, True), (errno.EINVAL, False)])
def test_a_disk_that_fails_is_said(tmp_path, monkeypatch, number, is_refused):
    """EIO is a broken disk, EINVAL a file system that has no fsync."""
    path = tmp_path / "fit.json"
    path.write_text("old")

    def fsync(handle: int) -> None:
        raise OSError(number, os.strerror(number))

    monkeypatch.delenv("MINIMAX_CAL_NO_FSYNC", raising=False)
    monkeypatch.setattr(os, "fsync", fsync)
    if is_refused:
        with pytest.raises(CalibrationError, match="cannot be written"):
            write_file_atomically(path, "new")
    else:
        write_file_atomically(path, "new")
    assert path.read_text() == ("old" if is_refused else "new")
    assert os.listdir(tmp_path) == ["fit.json"]
