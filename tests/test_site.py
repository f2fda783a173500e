"""The documentation's site is built without a warning, whole, and says what its examples print."""

import dataclasses
import inspect
import os
import re
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
from conftest import ROOT
from test_docs import DOCS, PAGES

import minimax_cal as mc
import qp_backends
from minimax_cal.cli.command_runner import cli

pytestmark = pytest.mark.site
NEEDED = (
    "sphinx",
    "myst_parser",
    "furo",
    "sphinx_click",
    "sphinx_gallery",
    "ziamath",
    "matplotlib",
)


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


def test_every_page_is_reached_from_the_start(site, built):
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


def test_links_of_the_site_lead_somewhere(site, built):
    for page, found in built.items():
        for link in found.links:
            parts = urlsplit(link)
            if parts.scheme:
                continue
            target = (page.parent / unquote(parts.path)).resolve() if parts.path else page
            assert target.exists(), f"{page.relative_to(site)}: {link}"
            if parts.fragment and target in built:
                assert unquote(parts.fragment) in built[target].ids, f"{page.name}: {link}"


def test_the_site_loads_nothing_from_outside(site, built):
    for page, found in built.items():
        for load in found.loads:
            assert not urlsplit(load).netloc, f"{page.name} loads {load}"
            if not load.startswith("data:"):
                assert (page.parent / urlsplit(load).path).exists(), f"{page.name} loads {load}"
    for style in site.rglob("*.css"):
        assert not re.search(r"(url\(|@import)\s*['\"]?(https?:)?//", style.read_text()), style


def test_formulas_are_drawn(site):
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
def test_every_public_name_is_in_the_reference(site, package):
    name = package.__name__
    ids = Anchors(site / "api" / f"{name}.html").ids
    for public_name in package.__all__:
        full, thing = f"{name}.{public_name}", getattr(package, public_name)
        assert f"module-{thing.__name__}" in ids if inspect.ismodule(thing) else full in ids, full
        for member in public(thing):
            assert f"{full}.{member}" in ids, f"{full}.{member}"


def test_docstrings_keep_their_words(site):
    page = re.sub(r"<[^>]+>", "", (site / "api" / "minimax_cal.html").read_text())
    assert "Names or patterns as beta*" in page  # a star is no emphasis here
    assert "Errors (m, k, 3) by the keys of accuracy [m]" in page  # quoted, with its brackets
    page = re.sub(r"<[^>]+>", "", (site / "api" / "qp_backends.html").read_text())
    assert "|xᵀPx + qᵀx + uᵀy⁺ - lᵀy⁻|, primal minus dual objective" in page  # nor is a bar a link


def commands(group: click.Group, path: str) -> Iterator[tuple[str, click.Command]]:
    for name, command in group.commands.items():
        yield f"{path}-{name}", command
        if isinstance(command, click.Group):
            yield from commands(command, f"{path}-{name}")


def test_every_command_and_option_is_in_the_reference(site):
    page = Anchors(site / "api" / "cli.html")
    for path, command in commands(cli, "minimax-cal"):
        assert path in page.ids
        for parameter in command.params:
            if isinstance(parameter, click.Option) and not parameter.hidden:
                shown = {f"cmdoption-{path}-{name.lstrip('-')}" for name in parameter.opts}
                assert shown & page.ids, f"{path} {parameter.opts}"


def numbers(page: Path, row: str) -> list[list[float]]:
    """The numbers of all rows of a printed table that begin with a word."""
    text = re.sub(r"<[^>]+>", "", page.read_text())
    return [
        list(map(float, line.split()[1:]))
        for line in re.findall(rf"^ +{row} +[\d. ]+$", text, re.M)
    ]


def test_what_the_first_example_says_is_what_it_prints(site):
    page = site / "examples" / "calibrate_and_judge.html"
    (right, wrong), (right_point, wrong_point) = (numbers(page, row) for row in ("sum", "point"))
    for least, point in ((right, right_point), (wrong, wrong_point)):
        assert point[1] < least[1]  # on the training poses each wins at its own game
        assert point[0] > least[0]
        assert point[2] > least[2]  # new poses: a larger RMS in both cases
    assert 0.9 < right_point[3] / right[3] < 1.1  # nothing gained where the model is right
    assert wrong_point[3] / wrong[3] < 0.85
    assert list((site / "_images").glob("sphx_glr_calibrate_and_judge_*.png"))


def test_what_the_second_example_says_is_what_it_prints(site):
    page = re.sub(r"<[^>]+>", "", (site / "examples" / "diagnose_a_gap.html").read_text())
    found = re.findall(r"verdict (\w+), held-out RMS ([\d.]+) mm, ([\w:, ]+)", page)
    (named, left, which), (without, more, _) = found
    assert (named, which.strip()) == ("named", "joint_compliance:all")
    assert without != "named"
    assert float(more) > 1.5 * float(left)
    follows = [float(one) for one in re.findall(r"still following something: ([\d.]+) mm", page)]
    assert follows[0] < 0.2 * follows[1]
    assert list((site / "_images").glob("sphx_glr_diagnose_a_gap_*.png"))
