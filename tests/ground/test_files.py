"""Files that come and go whole, whatever lies in their way."""

import os
import stat
from pathlib import Path

import pytest

from minimax_cal.ground.errors import CalibrationError, DataError
from minimax_cal.ground.files import check_writable, read_raw, read_text, write_whole


def test_links_in_a_circle_are_said(tmp_path: Path) -> None:
    loop = tmp_path / "loop"
    loop.symlink_to(loop)
    for write in (check_writable, lambda path: write_whole(path, "text")):
        with pytest.raises(CalibrationError, match="its links lead nowhere"):
            write(loop)


def test_a_file_keeps_its_permissions(tmp_path: Path) -> None:
    path = tmp_path / "result.json"
    path.write_text("")
    path.chmod(0o600)
    write_whole(path, "text")
    assert stat.S_IMODE(path.stat().st_mode) == 0o600
    assert path.read_text() == "text"


@pytest.mark.skipif(not Path("/dev/zero").exists(), reason="there is no /dev/zero to read")
def test_what_never_ends_is_refused() -> None:
    with pytest.raises(DataError, match="is larger than 1 MiB"):
        read_raw("/dev/zero", kind=DataError, most=1 << 20)


def test_lines_end_alike(tmp_path: Path) -> None:
    path = tmp_path / "text"
    path.write_bytes(b"\xef\xbb\xbfa\r\nb\rc\n")
    assert read_text(path) == "a\nb\nc\n"
    assert os.listdir(tmp_path) == ["text"]


def test_a_name_may_be_long_and_not_longer(tmp_path: Path) -> None:
    write_whole(tmp_path / ("n" * 255), "text")
    assert os.listdir(tmp_path) == ["n" * 255]
    check_writable(tmp_path / ("n" * 254))
    for write in (check_writable, lambda path: write_whole(path, "text")):
        with pytest.raises(CalibrationError, match="its name is too long"):
            write(tmp_path / ("n" * 300))
    assert os.listdir(tmp_path) == ["n" * 255]
