"""The project's words: those of `plain_words.txt` stand in no text that a person reads."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterable, Iterator
from pathlib import Path

import pytest
from conftest import ROOT

import minimax_cal as mc

LIST = ROOT / "tests" / "plain_words.txt"
CODE = ("minimax_cal", "experiments", "qp_backends", "examples")
HELPS = ("minimax_cal/cli/", "experiments/", "examples/")  # docstrings there are help and pages
PAGES = ("README.md", "CHANGELOG.md", "CONTRIBUTING.md", "paper.md")
FENCE = re.compile(r"^( *)(`{3,}|~{3,}).*?^\1\2[^\n]*$", re.S | re.M)
SPAN = re.compile(r"(`+)[^`]+\1|\b\w+\[")  # and JSON keys, as rungs[2]
ARGUMENTS = re.compile(  # of a docstring: their names are code
    r"\b\w+(?:, \w+)*:(?=\s)|^ {4}\w+(?:, \w+)*$", re.MULTILINE
)
HIDDEN = re.compile(r"<(script|style)\b.*?</\1>|\{[%#].*?[%#]\}|\{\{.*?\}\}|<[^>]*>", re.S)


def listed() -> dict[str, str]:
    """Pattern of each word that must go, and what to write instead."""
    lines = (line for line in LIST.read_text().splitlines() if line and not line.startswith("#"))
    return dict(re.split(r"\s{2,}", line, maxsplit=1) for line in lines)


INSTEAD = listed()
GONE = re.compile(rf"(?<![\w-])(?:{'|'.join(INSTEAD)})(?![\w-])".replace(" ", r"\s+"), re.I)


def lines_only(found: re.Match[str]) -> str:
    """As many line breaks as a part has that is left out, so that line numbers stay."""
    return "\n" * found[0].count("\n")


def prose(text: str) -> str:
    """A text without code blocks and code spans."""
    return SPAN.sub(lines_only, FENCE.sub(lines_only, text))


def faults(text: str, where: str, first: int = 1) -> Iterator[str]:
    """A line for each word that must go.  first: number of the text's first line."""
    for found in GONE.finditer(text):
        line = first + text.count("\n", 0, found.start())
        said = text[max(0, found.start() - 30) : found.end() + 30].replace("\n", " ")
        instead = next(new for old, new in INSTEAD.items() if matches(old, found[0]))
        yield f"{where}:{line}: {found[0]!r} in ...{said}...: {instead}"


def matches(pattern: str, text: str) -> bool:
    return bool(re.fullmatch(pattern.replace(" ", r"\s+"), text, re.I))


def docstrings(tree: ast.AST) -> dict[int, str]:
    """Docstring nodes by id, with the name of what they describe."""
    kinds = (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)
    return {
        id(node.body[0].value): getattr(node, "name", "")
        for node in ast.walk(tree)
        if isinstance(node, kinds) and node.body and isinstance(node.body[0], ast.Expr)
    }


def shown(path: Path) -> Iterator[tuple[int, str]]:
    """Strings of a file that people read: those with a blank; docstrings where pages show them.

    Line, and text without code.
    """
    tree, name = ast.parse(path.read_text()), path.relative_to(ROOT).as_posix()
    described = docstrings(tree)
    for node in ast.walk(tree):
        if not (isinstance(node, ast.Constant) and isinstance(node.value, str)):
            continue
        of = described.get(id(node))
        public = name.startswith(HELPS) or (of in mc.__all__ and name.startswith("minimax_cal"))
        if name.startswith("experiments/") and of:  # help shows what modules say
            public = False
        if " " in node.value.strip() and (of is None or public):
            text = prose(node.value)
            yield node.lineno, text if of is None else ARGUMENTS.sub(lines_only, text)


# ---- the tests ---------------------------------------------------------------------------------


def files(folders: Iterable[str], *endings: str) -> list[Path]:
    every = (path for folder in folders for path in sorted((ROOT / folder).rglob("*")))
    return [path for path in every if path.suffix in endings]


PAPERS = [*(ROOT / name for name in PAGES), *files(("docs", "examples"), ".md", ".rst")]


@pytest.mark.parametrize(
    ("paths", "texts"),
    [
        *((files([folder], ".py"), shown) for folder in CODE),
        (PAPERS, lambda path: [(1, prose(path.read_text()))]),
        (files(CODE, ".jinja"), lambda path: [(1, HIDDEN.sub(lines_only, path.read_text()))]),
    ],
    ids=[*CODE, "pages", "web pages"],
)
def test_what_people_read_is_in_plain_words(paths, texts):
    found = [
        fault
        for path in paths
        for line, text in texts(path)
        for fault in faults(text, str(path.relative_to(ROOT)), line)
    ]
    assert len(paths) > 4
    assert not found, "\n".join(found)


def test_a_word_that_must_go_is_noticed_and_code_is_not():
    assert [*faults(prose("one\nof the rungs"), "x")] == [
        f"x:2: 'rungs' in ...one of the rungs...: {INSTEAD['rungs?']}"
    ]
    assert not [*faults(prose("`--rung 2`, `rungs` and\n```text\na rung\n```\nthe step"), "x")]
    assert [*faults("poses at\nhand", "x")]
    assert not [*faults("the handle of a strung wire", "x")]
