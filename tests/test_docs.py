"""Links of the documentation lead somewhere, and its commands print what it says they print."""

import ast
import importlib
import re
import runpy
import shlex
import subprocess
from collections.abc import Iterator
from pathlib import Path
from urllib.parse import urlsplit

import pytest
from conftest import ROOT, run
from test_folders import FOLDERS

from experiments.pages import PAGE_RUNS, read_run_figures
from experiments.pages import PAGES_WITH_FIGURES as GENERATED
from minimax_cal.instruments.instrument_registry import INSTRUMENT_CLASSES
from minimax_cal.modelling.effects import EFFECTS
from qp_backends import registry

DOCS = ROOT / "docs"
PAGES = sorted(DOCS.rglob("*.md"))


# ---- the pages as they are ---------------------------------------------------------------------


def slug(heading: str) -> str:
    """The anchor that a code forge, and our site, give a heading."""
    text = re.sub(r"[`*]|\[|\]\([^)]*\)", "", heading.strip().lower())
    return re.sub(r"[^\w\- ]", "", text).replace(" ", "-")


CONTRIBUTING = ROOT / "CONTRIBUTING.md"


@pytest.mark.parametrize(
    "page", [ROOT / "README.md", CONTRIBUTING, *PAGES], ids=lambda path: path.stem
)
def test_links_lead_to_files_and_headings(page):
    text = re.sub(r"```.*?```", "", page.read_text(), flags=re.S)
    for link in re.findall(r"\]\(([^)\s]+)\)", re.sub(r"`[^`]*`", "code", text)):
        path, _, anchor = link.partition("#")
        if urlsplit(link).scheme:
            continue
        target = page.parent / path if path else page
        assert target.exists(), f"{page.name}: {link}"
        if anchor and target.suffix == ".md":
            lines = re.sub(r"```.*?```", "", target.read_text(), flags=re.S).splitlines()
            headings = {slug(line.lstrip("#")) for line in lines if line.startswith("#")}
            assert anchor in headings, f"{page.name}: {link}"


def test_the_files_named_in_the_mathematics_are_there():
    text = (DOCS / "mathematics.md").read_text()
    named = re.findall(r"`([\w/]+\.py)`", text)
    assert len(named) > 10
    for name in named:
        assert (ROOT / "minimax_cal" / name).exists() or (ROOT / name).exists(), name
    rooms = {path.stem: path.parent.name for path in (ROOT / "minimax_cal").glob("*/*.py")}
    for name, function in set(re.findall(r"`(\w+)\.(\w+)`", text)) - {
        (n[:-3], "py") for n in named
    }:
        room = "" if name == "minimax_cal" else f".{rooms[name]}.{name}"
        module = importlib.import_module(f"minimax_cal{room}")
        assert callable(getattr(module, function)), f"{name}.{function}"


def test_the_rooms_are_those_of_the_folders():
    named = re.findall(r"^\| `(\w+)/` \|", CONTRIBUTING.read_text(), re.M)
    assert tuple(named) == FOLDERS


def test_the_walks_lead_past_what_is_there():
    """Each step names a file and what is defined in it."""
    walks = CONTRIBUTING.read_text().partition("## Three walks")[2].partition("\n## ")[0]
    steps = re.findall(r"`([\w/]+\.py)`: `(\w+)`", " ".join(walks.split()))
    assert len(steps) >= 20
    for file, name in steps:
        at = ROOT / file if (ROOT / file).exists() else ROOT / "minimax_cal" / file
        assert re.search(rf"^(class|def) {name}\b", at.read_text(), re.M), f"{file}: {name}"


def test_contributing_is_read_in_one_go():
    assert len(CONTRIBUTING.read_text().split()) <= 900


def test_what_is_to_be_copied_and_entered_is_there():
    text = CONTRIBUTING.read_text().partition("## Add\n")[2]
    ours = ("minimax_cal", "qp_backends", "experiments", "tests", "docs", "examples")
    every = (path for folder in ours for path in (ROOT / folder).rglob("*.py"))
    there = [path.relative_to(ROOT).as_posix() for path in every]
    code = {path: (ROOT / path).read_text() for path in there}
    for name in re.findall(r"`([\w/]+/\w+\.(?:py|md))`", text):
        if not (ROOT / name).exists() and "NAME" not in name:
            assert any(path.endswith(f"/{name}") for path in there), name
    for name in re.findall(r"`([A-Z_]{4,}|test_\w+)`", text):
        assert any(re.search(rf"^(def )?{name}\b", held, re.M) for held in code.values()), name


# ---- the commands ------------------------------------------------------------------------------


@pytest.fixture
def own_registries(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """What a page registers is forgotten after it."""
    monkeypatch.setattr(registry, "_registered", dict(registry._registered))
    before = [(known, dict(known)) for known in (EFFECTS, INSTRUMENT_CLASSES)]
    yield
    for known, names in before:
        known.clear()
        known.update(names)


def blocks(page: Path) -> Iterator[tuple[str, str]]:
    """Language and text of each fenced block."""
    yield from re.findall(r"^```(\w+)\n(.*?)^```", page.read_text(), flags=re.S | re.M)


def execute(line: str) -> None:
    """One line of a shell; its exit code is 0, or the one that its comment tells."""
    command, _, comment = line.partition("  #")
    expected = re.search(r"exit code (\d)", comment)
    program, *arguments = shlex.split(command)
    if program == "python":
        runpy.run_path(arguments[0], run_name="__main__")
    elif program == "minimax-cal":
        assert run(*arguments) == (int(expected[1]) if expected else 0), line


def same(said: str, found: str) -> bool:
    """Whether two words are the same; in numbers the last digit may be another one."""
    if said == found:
        return True
    number = re.compile(r"([(+-]*)(\d+(?:\.(\d+))?)(e[+-]\d+)?([;:,.)]*)")
    one, other = number.fullmatch(said.removesuffix("...")), number.fullmatch(found)
    if not (one and other) or one[1] != other[1]:
        return False
    last = 10.0 ** -len(one[3] or "") * float(f"1{one[4] or ''}")
    if said.endswith("..."):  # further digits follow
        return found.startswith(one[0]) or abs(float(one[2]) - float(other[2])) <= 2.0 * last
    values = [float(f"{x[2]}{x[4] or ''}") for x in (one, other)]
    return abs(values[0] - values[1]) <= (2.0 * last if one[3] else 0.0)


def printed(said: list[str], found: list[str]) -> int:
    """Where the words end in what was printed, 0 if they are not there."""
    for start in range(len(found) - len(said) + 1):
        if all(map(same, said, found[start : start + len(said)])):
            return start + len(said)
    return 0


def words(text: str) -> list[str]:
    """The words of a text, rules of tables left out: their length is no matter."""
    return [word for word in text.split() if word.strip("─")]


def chunks(text: str) -> Iterator[list[str]]:
    """The words of a block, cut where it leaves something out."""
    chunk: list[str] = []
    for word in words(text):
        if word == "...":
            yield chunk
            chunk = []
        else:
            chunk.append(word)
    yield chunk


PLAIN = {"mm", "deg", "mrad", "um"}  # units
RUN = [
    "index.md", "tutorial.md", "backends.md", "own_effect.md", "from_matlab.md",
    "several_instruments.md", "own_instrument.md", "mjcf_to_mjcf.md", "controller_pose.md",
    "hand_eye.md", "learned_policies.md",
]  # fmt: skip


@pytest.mark.parametrize("name", RUN)
def test_pages_print_what_they_say(name, tmp_path, monkeypatch, capsys, own_registries):
    pytest.importorskip("matplotlib", reason="pictures need pip install minimax-cal[plot]")
    if name in ("mjcf_to_mjcf.md", "learned_policies.md"):
        pytest.importorskip("mujoco", reason="needs mujoco: pip install minimax-cal[mujoco]")
    monkeypatch.chdir(tmp_path)
    (tmp_path / "examples").symlink_to(ROOT / "examples")
    scope: dict[str, object] = {}
    found: list[str] = []
    compared = 0
    for language, text in blocks(DOCS / name):
        if language == "bash":
            for line in text.splitlines():
                execute(line)
        elif language == "python":
            file = re.match(r"# (\w+\.py)\n", text)
            if file:
                Path(file[1]).write_text(text)
            else:
                exec(compile(text, name, "exec"), scope)
        elif language == "text":
            found = words(capsys.readouterr().out)
            for chunk in chunks(text):
                end = printed(chunk, found)
                assert end or not chunk, f"{name} does not print {' '.join(chunk)!r}:\n{found}"
                found, compared = found[end:], compared + len(chunk)
    assert compared > 1
    if name == "tutorial.md":
        for made in (
            "errors.png",
            "diagnosis.png",
            "diagnosis.json",
            "report.html",
            "calibrated.urdf",
            "corrected.csv",
        ):
            assert (tmp_path / made).stat().st_size > 1000, made


def test_what_corrected_targets_are_worth_is_what_the_page_prints(capsys):
    code, said = (
        next(
            text
            for kind, text in blocks(DOCS / "compensate.md")
            if kind == language and sign in text
        )
        for language, sign in (("python", "made.cell"), ("text", "held out: RMS"))
    )
    exec(compile(code, "compensate.md", "exec"), {})
    assert printed(words(said), words(capsys.readouterr().out))


def test_numbers_in_the_words_of_the_tutorial_stand_in_what_it_prints():
    text = (DOCS / "tutorial.md").read_text()
    printed_numbers = [
        float(number)
        for language, body in blocks(DOCS / "tutorial.md")
        if language == "text"
        for number in re.findall(r"\d+\.\d+", body)
    ]
    prose = re.sub(r"^```.*?^```", "", text, flags=re.S | re.M)
    told = re.findall(r"(\d+\.(\d+))\s+(?:mm|rad)\b", prose)
    assert told
    for number, digits in told:
        rounded = (round(one, len(digits)) for one in printed_numbers)
        assert float(number) in rounded, f"tutorial.md: no command prints {number}"


def test_a_wrong_number_is_noticed():
    assert same("0.5741", "0.5742")
    assert not same("0.5741", "0.5751")
    assert not same("2.59e-06", "2.59e-07")
    assert not same("33", "34")
    assert not printed(["RMS", "1.653"], ["RMS", "error", "1.653"])


def test_every_picture_is_made_by_a_command():
    """README's and the pages' pictures stand in `docs/pictures.py`; those of studies are theirs."""
    scope = runpy.run_path(str(DOCS / "pictures.py"), run_name="pictures")
    pages = "".join(page.read_text() for page in (*PAGES, ROOT / "README.md"))
    shown = re.findall(r"!\[[^]]*\]\((?:[\w./]*/)?([\w.]+)\)", pages)
    of_pages = {name: (study, figure) for study, run in PAGE_RUNS.items()
                for name, figure in run.pictures.items()}  # fmt: skip
    assert set(shown) == {*scope["OWN"], *scope["STUDIES"], *of_pages}
    for study, figure in (*scope["STUDIES"].values(), *of_pages.values()):
        folder = figure.rpartition("/")[0]  # `papers` runs others, each in a folder of its name
        for name in filter(None, (study, folder)):
            assert (ROOT / "experiments" / f"{name}.py").exists(), name


STAMP = re.compile(r"^Figures: (version|several versions up to) `([0-9a-f]{7})`\.$", re.MULTILINE)
# Pages whose tables came from runs of several versions; one that is made again leaves the list.
SEVERAL = {
    "simulator", "torques",
}  # fmt: skip


def figured_pages() -> dict[str, str]:
    """Text of each page by name whose figures a study prints, but for those of `pages`."""
    texts = {page.stem: page.read_text(encoding="utf-8") for page in DOCS.glob("*.md")}
    shown = (name for name, text in texts.items() if re.search(r"-m experiments[ .][a-z]", text))
    # the list is compared with what the command writes; mathematics and data have no figures
    others = ("errata", "mathematics", "data", *GENERATED)
    return {name: texts[name] for name in shown if name not in others}


def test_every_page_of_figures_is_of_one_version():
    stamps = {name: STAMP.findall(text) for name, text in figured_pages().items()}
    assert {name: len(found) for name, found in stamps.items() if len(found) != 1} == {}
    assert {name for name, ((kind, _),) in stamps.items() if kind != "version"} == SEVERAL


def test_the_versions_of_figures_are_commits():
    if not (ROOT / ".git").exists():
        pytest.skip("no git repository here")
    stamps = {stamp for text in figured_pages().values() for _, stamp in STAMP.findall(text)}
    stamps |= {read_run_figures(run)["made"]["commit"] for run in PAGE_RUNS}
    known = subprocess.run(
        ["git", "-C", str(ROOT), "rev-list", "--all"],
        capture_output=True, text=True, check=True,
    ).stdout.split()  # fmt: skip
    if len(known) < 100:
        pytest.skip("a shallow clone")
    assert {stamp for stamp in stamps if not any(one.startswith(stamp) for one in known)} == set()


def test_the_glossary_has_every_word_that_heads_a_table():
    """Some word of each header that the code writes out is in an entry."""
    heads: set[str] = set()
    for path in (ROOT / "minimax_cal").rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            given = []
            if isinstance(node, ast.Call) and getattr(node.func, "id", "") == "Table":
                given = [one for one in node.args[1:2] if isinstance(one, ast.Tuple)]
            if isinstance(node, ast.Assign) and getattr(node.targets[0], "id", "") == "header":
                given = [node.value] if isinstance(node.value, ast.Tuple) else []
            heads |= {str(e.value) for t in given for e in t.elts if isinstance(e, ast.Constant)}
    entries = [line.split("|")[1] for line in (DOCS / "glossary.md").read_text().splitlines()
               if line.startswith("|")]  # fmt: skip
    known = {word.lower() for entry in entries for word in re.findall(r"[A-Za-z]+", entry)} | PLAIN
    words = {head: re.findall(r"[A-Za-z]{2,}", head) for head in heads}
    unknown = {
        head for head, found in words.items()
        if found and not any(word.lower() in known for word in found)
    }  # fmt: skip
    assert not unknown, ", ".join(sorted(unknown))
