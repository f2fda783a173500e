"""The documentation is built without a warning, and its commands print what it says they print."""

import dataclasses
import importlib
import inspect
import os
import re
import runpy
import shlex
import shutil
import subprocess
import sys
from collections.abc import Iterator
from html.parser import HTMLParser
from importlib.util import find_spec
from pathlib import Path
from urllib.parse import unquote, urldefrag, urlsplit

import click
import pytest
from conftest import ROOT, run
from test_folders import FOLDERS

import minimax_cal as mc
import qp_backends
from minimax_cal.cli.running import cli
from minimax_cal.modelling.effects import EFFECTS
from qp_backends import registry

DOCS = ROOT / "docs"
PAGES = sorted(DOCS.rglob("*.md"))
NEEDED = (
    "sphinx",
    "myst_parser",
    "furo",
    "sphinx_click",
    "sphinx_gallery",
    "ziamath",
    "matplotlib",
)


# ---- the site ----------------------------------------------------------------------------------


class Anchors(HTMLParser):
    """What a page links to, what it loads, and the names that links may lead to."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.links: list[str] = []
        self.loads: list[str] = []
        self.ids: set[str] = set()
        self.feed(path.read_text())

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        held = {name: value or "" for name, value in attrs}
        self.ids |= {held[name] for name in ("id", "name") if name in held}
        if tag == "a" and "href" in held:
            self.links.append(held["href"])
        self.loads += [held[name] for name in ("src", "data") if name in held]
        if tag == "link" and held.get("rel") not in (
            "index",
            "search",
            "next",
            "prev",
            "canonical",
        ):
            self.loads.append(held["href"])


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The documentation, built with warnings as errors from a copy."""
    missing = [name for name in NEEDED if find_spec(name) is None]
    if missing:
        pytest.skip(f"{', '.join(missing)} not installed: pip install minimax-cal[docs]")
    folder = tmp_path_factory.mktemp("docs")
    kept = shutil.ignore_patterns("_build", "examples", "__pycache__")
    shutil.copytree(DOCS, folder / "docs", ignore=kept)
    (folder / "examples").symlink_to(ROOT / "examples")
    command = [sys.executable, "-m", "sphinx", "-W", "--keep-going", "-q", "-b", "html"]
    built = subprocess.run(
        [*command, folder / "docs", folder / "html"],
        capture_output=True,
        text=True,
        cwd=ROOT,
        env={**os.environ, "MPLBACKEND": "agg", "OMP_NUM_THREADS": "1"},
    )
    assert built.returncode == 0, built.stderr
    assert not built.stderr.strip(), built.stderr
    return folder / "html"


@pytest.fixture(scope="module")
def built(site: Path) -> dict[Path, Anchors]:
    return {path: Anchors(path) for path in site.rglob("*.html")}


def test_every_page_is_reached_from_the_start(site: Path, built: dict[Path, Anchors]) -> None:
    waiting, reached = [site / "index.html"], set()
    while waiting:
        page = waiting.pop()
        if page in built and page not in reached:
            reached.add(page)
            links = (urldefrag(link).url for link in built[page].links)
            waiting += [(page.parent / link).resolve() for link in links if link]
    for page in PAGES:
        assert site / page.relative_to(DOCS).with_suffix(".html") in reached, page
    assert site / "examples" / "calibrate_and_judge.html" in reached
    assert site / "examples" / "diagnose_a_gap.html" in reached


def test_links_of_the_site_lead_somewhere(site: Path, built: dict[Path, Anchors]) -> None:
    for page, found in built.items():
        for link in found.links:
            parts = urlsplit(link)
            if parts.scheme:
                continue
            target = (page.parent / unquote(parts.path)).resolve() if parts.path else page
            assert target.exists(), f"{page.relative_to(site)}: {link}"
            if parts.fragment and target in built:
                assert unquote(parts.fragment) in built[target].ids, f"{page.name}: {link}"


def test_the_site_loads_nothing_from_outside(site: Path, built: dict[Path, Anchors]) -> None:
    for page, found in built.items():
        for load in found.loads:
            assert not urlsplit(load).netloc, f"{page.name} loads {load}"
            if not load.startswith("data:"):
                assert (page.parent / urlsplit(load).path).exists(), f"{page.name} loads {load}"
    for style in site.rglob("*.css"):
        assert not re.search(r"(url\(|@import)\s*['\"]?(https?:)?//", style.read_text()), style


def test_formulas_are_drawn(site: Path) -> None:
    page, text = (site / "mathematics.html").read_text(), (DOCS / "mathematics.md").read_text()
    assert (
        len(re.findall(r'<div class="math">\s*<svg', page))
        == len(re.findall(r"^\$\$$", text, re.M)) / 2
    )
    inline = re.sub(r"^\$\$$.*?^\$\$$", "", text, flags=re.M | re.S).count("$") / 2
    assert len(re.findall(r'<span class="math"[^>]*><svg', page)) == inline


def public(thing: object) -> Iterator[str]:
    """Attributes and methods of a class of ours, without those of Python itself."""
    if not inspect.isclass(thing):
        return
    if dataclasses.is_dataclass(thing):
        yield from (field.name for field in dataclasses.fields(thing))
    for name, member in vars(thing).items():
        kinds = (staticmethod, classmethod, property)
        if not name.startswith("_") and (inspect.isfunction(member) or isinstance(member, kinds)):
            yield name


@pytest.mark.parametrize("package", [mc, qp_backends], ids=lambda package: package.__name__)
def test_every_public_name_is_in_the_reference(site: Path, package: object) -> None:
    name = package.__name__  # type: ignore[attr-defined]
    ids = Anchors(site / "api" / f"{name}.html").ids
    for public_name in package.__all__:  # type: ignore[attr-defined]
        full, thing = f"{name}.{public_name}", getattr(package, public_name)
        assert f"module-{thing.__name__}" in ids if inspect.ismodule(thing) else full in ids, full
        for member in public(thing):
            assert f"{full}.{member}" in ids, f"{full}.{member}"


def test_docstrings_keep_their_words(site: Path) -> None:
    page = re.sub(r"<[^>]+>", "", (site / "api" / "minimax_cal.html").read_text())
    assert "names or patterns as beta*" in page  # a star is no emphasis here
    assert "Errors (k, m, 3) by the keys of accuracy [m]" in page  # quoted, with its brackets
    page = re.sub(r"<[^>]+>", "", (site / "api" / "qp_backends.html").read_text())
    assert "|xᵀPx + qᵀx + uᵀy⁺ - lᵀy⁻|, primal minus dual objective" in page  # nor is a bar a link


def commands(group: click.Group, path: str) -> Iterator[tuple[str, click.Command]]:
    for name, command in group.commands.items():
        yield f"{path}-{name}", command
        if isinstance(command, click.Group):
            yield from commands(command, f"{path}-{name}")


def test_every_command_and_option_is_in_the_reference(site: Path) -> None:
    page = Anchors(site / "api" / "cli.html")
    for path, command in commands(cli, "minimax-cal"):
        assert path in page.ids
        for parameter in command.params:
            if isinstance(parameter, click.Option):
                shown = {f"cmdoption-{path}-{name.lstrip('-')}" for name in parameter.opts}
                assert shown & page.ids, f"{path} {parameter.opts}"


def numbers(page: Path, row: str) -> list[list[float]]:
    """The numbers of all rows of a printed table that begin with a word."""
    text = re.sub(r"<[^>]+>", "", page.read_text())
    return [
        list(map(float, line.split()[1:]))
        for line in re.findall(rf"^ +{row} +[\d. ]+$", text, re.M)
    ]


def test_what_the_first_example_says_is_what_it_prints(site: Path) -> None:
    page = site / "examples" / "calibrate_and_judge.html"
    (right, wrong), (right_point, wrong_point) = (numbers(page, row) for row in ("sum", "point"))
    for least, point in ((right, right_point), (wrong, wrong_point)):
        assert point[1] < least[1]  # on the training poses each wins at its own game
        assert point[0] > least[0]
        assert point[2] > least[2]  # new poses: a larger RMS in both cases
    assert 0.9 < right_point[3] / right[3] < 1.1  # nothing gained where the model is right
    assert wrong_point[3] / wrong[3] < 0.85
    assert list((site / "_images").glob("sphx_glr_calibrate_and_judge_*.png"))


def test_what_the_second_example_says_is_what_it_prints(site: Path) -> None:
    page = re.sub(r"<[^>]+>", "", (site / "examples" / "diagnose_a_gap.html").read_text())
    found = re.findall(r"verdict (\w+), held-out RMS ([\d.]+) mm, ([\w:, ]+)", page)
    (named, left, which), (without, more, _) = found
    assert (named, which.strip()) == ("named", "joint_compliance:all")
    assert without != "named"
    assert float(more) > 1.5 * float(left)
    assert list((site / "_images").glob("sphx_glr_diagnose_a_gap_*.png"))


# ---- the pages as they are ---------------------------------------------------------------------


def slug(heading: str) -> str:
    """The anchor that a code forge, and our site, give a heading."""
    text = re.sub(r"[`*]|\[|\]\([^)]*\)", "", heading.strip().lower())
    return re.sub(r"[^\w\- ]", "", text).replace(" ", "-")


CONTRIBUTING = ROOT / "CONTRIBUTING.md"


@pytest.mark.parametrize(
    "page", [ROOT / "README.md", CONTRIBUTING, *PAGES], ids=lambda path: path.stem
)
def test_links_lead_to_files_and_headings(page: Path) -> None:
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


def test_the_files_named_in_the_mathematics_are_there() -> None:
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


def test_the_rooms_are_those_of_the_folders() -> None:
    named = re.findall(r"^\| `(\w+)/` \|", CONTRIBUTING.read_text(), re.M)
    assert tuple(named) == FOLDERS


def test_an_owner_stands_where_it_is_said_to_stand() -> None:
    rows = CONTRIBUTING.read_text().partition("| thing | owner | where |")[2].partition("\n\n")[0]
    for row in rows.splitlines()[2:]:
        _, _, owner, where, _ = row.split("|")
        first, *others = re.findall(r"`([\w/]+\.py)`", where)
        files = [ROOT / "minimax_cal" / first]
        files += [ROOT / "minimax_cal" / o if "/" in o else files[0].parent / o for o in others]
        text = "".join(path.read_text() for path in files)
        for name in re.findall(r"`\.?(\w+)", owner):
            said = rf"\b(class|def) {name}\b|^{name}\b"
            assert files[0].stem == name or re.search(said, text, re.M), row


def test_what_is_to_be_copied_and_entered_is_there() -> None:
    text = CONTRIBUTING.read_text().partition("## Add an effect")[2]
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
    before = dict(EFFECTS)
    yield
    EFFECTS.clear()
    EFFECTS.update(before)


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


RUN = ["index.md", "tutorial.md", "backends.md", "own_effect.md", "from_matlab.md"]


@pytest.mark.parametrize("name", RUN)
def test_pages_print_what_they_say(
    name: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    own_registries: None,
) -> None:
    pytest.importorskip("matplotlib", reason="pictures need pip install minimax-cal[plot]")
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


def test_a_wrong_number_is_noticed() -> None:
    assert same("0.5741", "0.5742")
    assert not same("0.5741", "0.5751")
    assert not same("2.59e-06", "2.59e-07")
    assert not same("33", "34")
    assert not printed(["RMS", "1.653"], ["RMS", "error", "1.653"])


def test_every_picture_is_made_by_a_command() -> None:
    """README's and the pages' pictures stand in `docs/pictures.py`; those of studies are theirs."""
    scope = runpy.run_path(str(DOCS / "pictures.py"), run_name="pictures")
    pages = "".join(page.read_text() for page in (*PAGES, ROOT / "README.md"))
    shown = re.findall(r"!\[[^]]*\]\((?:[\w./]*/)?([\w.]+)\)", pages)
    assert set(shown) == {*scope["OWN"], *scope["STUDIES"]}
    for study, figure in scope["STUDIES"].values():
        folder = figure.rpartition("/")[0]  # `papers` runs others, each in a folder of its name
        for name in filter(None, (study, folder)):
            assert (ROOT / "experiments" / f"{name}.py").exists(), name
