"""What the README prints is what its commands print."""

import re
import sys
import tomllib
from pathlib import Path

import pytest
from conftest import ROOT, run

import minimax_cal as mc

README = (ROOT / "README.md").read_text()


def test_the_result_is_the_one_of_the_first_command() -> None:
    quoted = " ".join(
        line.removeprefix("> ") for line in README.splitlines() if line.startswith("> ")
    )
    fit = mc.calibrate("irb2600", ROOT / "examples" / "irb2600.csv")
    assert quoted in fit.headline()


def test_the_diagnosis_is_what_its_commands_print(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    part = README.partition("## Why does a calibrated arm still miss?")[2].partition("\n## ")[0]
    blocks = re.findall(r"```bash\n(.*?)```", part, flags=re.S)
    out = ""
    for line in "".join(blocks).splitlines():
        command = line.partition("#")[0].split()
        assert command[0] == "minimax-cal"
        assert run(*command[1:]) == 0, line
        out += capsys.readouterr().out
    (text,) = re.findall(r"```text\n(.*?)```", part, flags=re.S)
    quoted, printed = text.split(), out.split()
    number = re.compile(r"\(?(\d+(?:\.\d+)?)[;:,.)]*")
    for said, found in zip(quoted, printed[: len(quoted)], strict=True):
        one, other = number.fullmatch(said), number.fullmatch(found)
        if one and other:  # the last digit may differ on another machine
            assert float(one[1]) == pytest.approx(float(other[1]), abs=2e-3), (said, found)
        else:
            assert said == found
    assert (tmp_path / "diagnosis.png").stat().st_size > 50_000
    assert (ROOT / "docs" / "images" / "diagnosis.png").read_bytes().startswith(b"\x89PNG")
    assert mc.load_cell(tmp_path / "fit.json").effects.terms[0].label == "joint_compliance:all"


def test_the_python_examples_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    code = "\n".join(re.findall(r"```python\n(.*?)```", README, flags=re.S))
    (tmp_path / "examples").symlink_to(ROOT / "examples")
    monkeypatch.chdir(tmp_path)
    exec(compile(code, "README.md", "exec"), {})
    assert mc.load_cell(tmp_path / "fit.json").target_names == ("smr1", "smr2", "smr3")


def test_all_brings_what_is_said() -> None:
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"][
        "optional-dependencies"
    ]

    def parts(name: str) -> set[str]:
        inner = [re.fullmatch(r"minimax-cal\[(.*)\]", need) for need in extras[name]]
        named = [part for one in inner if one for part in one[1].split(",")]
        return {name}.union(*map(parts, named))

    (said,) = re.findall(r"No index has the package yet.*?\n\n", README, flags=re.S)
    several, _, rest = said.partition('`".[all]"`')
    (left_out,) = re.findall(r"all of these but `(\w+)`", rest)
    assert {*re.findall(r"\.\[(\w+)\]", several)} - parts("all") == {left_out}
    (backends,) = re.findall(r"QP backends ([\w,\s]+);", rest)
    assert set(re.split(r",\s+|\s+and\s+", backends)) == parts("backends") - {"backends"}
    assert "backends" in parts("all")


def test_the_example_is_what_its_script_makes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(str(ROOT / "examples"))
    import make

    make.make(tmp_path)
    made, kept = (
        mc.read_measurements(folder / "irb2600.csv") for folder in (tmp_path, ROOT / "examples")
    )
    assert abs(made.q - kept.q).max() <= 2e-9  # the digits of the file
    assert abs(made.y - kept.y).max() <= 2e-9
    assert (tmp_path / "irb2600.svg").stat().st_size > 10_000
    sys.modules.pop("make")


def test_the_map_names_what_is_there() -> None:
    rows = [line for line in README.splitlines() if line.startswith("| `")]
    named = set()
    for row in rows:
        first, *others = re.findall(r"`([^`]+)`", row.split("|")[1])
        folder = (ROOT / first).parent  # the others of a row lie beside the first
        for full in (ROOT / first, *(folder / other for other in others)):
            assert full.exists(), full
            named.add(full.resolve())
    for module in (ROOT / "minimax_cal").glob("*.py"):
        assert module.name == "__init__.py" or module.resolve() in named, module.name


def test_there_are_two_set_up_commands() -> None:
    (block,) = re.findall(r"```bash setup\n(.*?)```", README, flags=re.S)
    assert len(block.strip().splitlines()) == 2
