"""What the README prints is what its commands print."""

import re
import sys
import tomllib

import pytest
from conftest import ROOT, run

import minimax_cal as mc
from minimax_cal.diagnosing.diagnosis import load_diagnosis

README = (ROOT / "README.md").read_text()


def test_the_result_is_the_one_of_the_first_command():
    quoted = " ".join(
        line.removeprefix("> ") for line in README.splitlines() if line.startswith("> ")
    )
    fit = mc.calibrate("irb2600", ROOT / "examples" / "irb2600.csv")
    assert quoted in fit.headline()


def test_the_four_commands_print_what_is_quoted(tmp_path, monkeypatch, capsys):
    mujoco = pytest.importorskip("mujoco", reason="needs pip install minimax-cal[mujoco]")
    (tmp_path / "examples").symlink_to(ROOT / "examples")
    monkeypatch.chdir(tmp_path)
    part = README.partition("## Four commands")[2].partition("\n## ")[0]
    blocks = re.findall(r"```(bash|text)\n(.*?)```", part, flags=re.S)
    assert [kind for kind, _ in blocks].count("bash") == 4
    out = err = ""
    for kind, text in blocks:
        if kind == "bash":
            assert run(*text.split()[1:]) == 0, text
            out, err = capsys.readouterr()
        else:
            assert is_quoted(text.split(), out.split()), text
    diagnosis = load_diagnosis(tmp_path / "diagnosis.json")
    delivered = re.search(r"mjcf holds .*?held-out RMS (\S+) mm", " ".join(err.split()))
    assert delivered is not None  # the path ends at the last row of the diagnosis
    assert float(delivered[1]) == pytest.approx(diagnosis.ladder[-1].holdout.rms_mm, abs=2e-3)
    assert (tmp_path / "diagnosis.png").stat().st_size > 50_000
    assert mujoco.MjModel.from_xml_path(str(tmp_path / "robot.xml")).njnt == 6


def is_quoted(quoted: list[str], printed: list[str]) -> bool:
    """Whether words stand in a row in an output; the last digit may differ on another machine."""
    number = re.compile(r"\(?(\d+(?:\.\d+)?)[;:,.)]*")

    def same(said: str, found: str) -> bool:
        one, other = number.fullmatch(said), number.fullmatch(found)
        if one and other:
            return float(one[1]) == pytest.approx(float(other[1]), abs=2e-3)
        return said == found

    return any(
        all(map(same, quoted, printed[i : i + len(quoted)]))
        for i in range(len(printed) - len(quoted) + 1)
    )


def test_it_is_short():
    assert len(re.sub(r"```.*?```", "", README, flags=re.S).split()) <= 450


def test_the_python_examples_run(tmp_path, monkeypatch):
    pytest.importorskip("mujoco", reason="needs pip install minimax-cal[mujoco]")
    (tmp_path / "examples").symlink_to(ROOT / "examples")
    monkeypatch.chdir(tmp_path)
    for page in (README, (ROOT / "docs" / "commands.md").read_text()):
        blocks = re.findall(r"```(python|text)\n(.*?)```", page, flags=re.S)
        code = "\n".join(text for language, text in blocks if language == "python")
        scope: dict[str, object] = {}
        exec(compile(code, "page", "exec"), scope)
    assert mc.load_cell(tmp_path / "fit.json").target_names == ("smr1", "smr2", "smr3")
    assert f"{scope['found'].fun:.6f}" == blocks[-1][1].strip()


def test_all_brings_what_every_page_needs():
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"][
        "optional-dependencies"
    ]

    def parts(name: str) -> set[str]:
        inner = [re.fullmatch(r"minimax-cal\[(.*)\]", need) for need in extras[name]]
        named = [part for one in inner if one for part in one[1].split(",")]
        return {name}.union(*map(parts, named))

    assert set(re.findall(r"pip install --quiet \"\.\[(\w+)\]\"", README)) == {"all"}
    assert parts("all") >= {"plot", "backends", "report", "jobs", "app", "fast", "mujoco"}


def test_the_example_is_what_its_script_makes(tmp_path, monkeypatch):
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


def test_there_are_two_set_up_commands():
    (block,) = re.findall(r"```bash setup\n(.*?)```", README, flags=re.S)
    assert len(block.strip().splitlines()) == 2
