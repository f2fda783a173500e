"""Small faults put into the code, one at a time: which do the tests notice?

    pytest -n auto --cov=minimax_cal --cov=qp_backends --cov-context=test  # who runs a line
    python tests/mutants.py                        # 200 faults over all rooms, always the same
    python tests/mutants.py minimax_cal/judging --count 40 --seed 2

A seeded sample of changes: another comparison, sign, operation, number, truth value or extreme.
Each is run in a copy of the project with the quickest of the tests that run its line; a test that
fails, or takes far longer, has noticed it.  Processes fork from one that has the libraries loaded.
"""

from __future__ import annotations

import argparse
import ast
import copy
import multiprocessing
import os
import random
import shutil
import sys
import tempfile
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree

from coverage import CoverageData

ROOT = Path(__file__).resolve().parent.parent
PATIENCE = 6.0  # times what the tests take without a fault
TRIED, MOST = 60, 20  # tests of a line that are timed, and that are asked
SERVER = multiprocessing.get_context("forkserver")
SERVER.set_forkserver_preload(
    ["pytest", "_pytest.assertion.rewrite", "numpy.testing", "scipy.optimize",
     "scipy.stats", "scipy.spatial", "scipy.cluster.vq", "pydantic", "click", "yaml", "daqp",
     "numba", "cvxpy"]
)  # fmt: skip
COMPARISONS = {
    ast.Lt: ast.GtE, ast.GtE: ast.Lt, ast.Gt: ast.LtE, ast.LtE: ast.Gt, ast.Eq: ast.NotEq,
    ast.NotEq: ast.Eq, ast.Is: ast.IsNot, ast.IsNot: ast.Is, ast.In: ast.NotIn, ast.NotIn: ast.In,
}  # fmt: skip
OPERATIONS = {
    ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.Div, ast.Div: ast.Mult, ast.Pow: ast.Mult,
    ast.BitAnd: ast.BitOr, ast.BitOr: ast.BitAnd, ast.MatMult: ast.Mult,
}  # fmt: skip
NAMES = {
    "min": "max", "max": "min", "minimum": "maximum", "maximum": "minimum", "argmin": "argmax",
    "argmax": "argmin", "any": "all", "all": "any", "sin": "cos", "cos": "sin", "sum": "mean",
    "mean": "sum", "nanmax": "nanmin", "ones": "zeros", "zeros": "ones", "cumsum": "cumprod",
}  # fmt: skip


def faults(node: ast.AST) -> Iterator[str]:
    """Make each change of one node in turn, and say what it is."""
    if isinstance(node, ast.Compare):
        for i, old in enumerate(node.ops):
            node.ops[i] = COMPARISONS[type(old)]()
            yield f"{type(old).__name__} -> {type(node.ops[i]).__name__}"
            node.ops[i] = old
    elif isinstance(node, ast.BinOp | ast.AugAssign) and type(node.op) in OPERATIONS:
        old_operation = node.op
        node.op = OPERATIONS[type(node.op)]()
        yield f"{type(old_operation).__name__} -> {type(node.op).__name__}"
        node.op = old_operation
    elif isinstance(node, ast.BoolOp):
        old_word = node.op
        node.op = ast.Or() if isinstance(old_word, ast.And) else ast.And()
        yield f"{type(old_word).__name__} -> {type(node.op).__name__}"
        node.op = old_word
    elif isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.USub | ast.Not | ast.Invert):
        old_sign, node.op = node.op, ast.UAdd()
        if isinstance(old_sign, ast.USub):
            yield "-x -> x"
        elif isinstance(old_sign, ast.Invert):
            node.op = ast.Invert()
            node.operand = ast.UnaryOp(ast.Invert(), node.operand)
            yield "~x -> x"
            node.operand = node.operand.operand
        else:
            node.op = ast.Not()
            node.operand = ast.UnaryOp(ast.Not(), node.operand)
            yield "not x -> x"
            node.operand = node.operand.operand
        node.op = old_sign
    elif isinstance(node, ast.Constant) and type(node.value) in (bool, int, float):
        old = node.value
        node.value = not old if isinstance(old, bool) else 2.0 * old + 1.0 if isinstance(
            old, float
        ) else old + 1  # fmt: skip
        yield f"{old!r} -> {node.value!r}"
        node.value = old
    elif isinstance(node, ast.Attribute | ast.Name):
        field = "attr" if isinstance(node, ast.Attribute) else "id"
        name = getattr(node, field)
        if name in NAMES:
            setattr(node, field, NAMES[name])
            yield f"{name} -> {NAMES[name]}"
            setattr(node, field, name)


def code(tree: ast.AST) -> Iterator[ast.AST]:
    """Nodes that run: no annotations, no texts."""
    for node in ast.iter_child_nodes(tree):
        if isinstance(node, ast.JoinedStr | ast.Raise | ast.Import | ast.ImportFrom):
            continue
        shown = copy.copy(node)
        for name in ("annotation", "returns"):
            if hasattr(shown, name):
                setattr(shown, name, None)
        if isinstance(node, ast.arg):
            continue
        yield node
        yield from code(shown)


def changes(source: str) -> list[tuple[int, str]]:
    """Line and kind of every change of a module."""
    return [
        (getattr(node, "lineno", 0), said)
        for node in code(ast.parse(source))
        for said in faults(node)
    ]


def mutated(source: str, number: int) -> str:
    """The module with its n-th change."""
    tree = ast.parse(source)
    count = 0
    for node in code(tree):
        for _ in faults(node):
            if count == number:
                return ast.unparse(tree)
            count += 1
    raise IndexError(number)


@dataclass(frozen=True)
class Mutant:
    """A change of a module, and the tests that run its line, the most special first."""

    module: str
    number: int
    line: int
    said: str
    tests: tuple[str, ...]

    @property
    def room(self) -> str:
        """The folder of a package, or the package."""
        return "/".join(self.module.split("/")[:-1][:2])


class Reached:
    """Which tests run which lines, from `pytest --cov --cov-context=test`."""

    def __init__(self, path: Path, root: Path) -> None:
        self.data = CoverageData(basename=str(path))
        self.data.read()
        self.root = root
        self.wide = Counter(  # modules that a test runs
            context
            for file in self.data.measured_files()
            for context in {c for line in self.data.contexts_by_lineno(file).values() for c in line}
        )

    def tests(self, module: str, line: int) -> tuple[str, ...]:
        """The tests of a line; of a line run at the import, those of the module."""
        by_line = self.data.contexts_by_lineno(str(self.root / module))
        found = set(by_line.get(line, []))
        if "" in found:
            found = {c for contexts in by_line.values() for c in contexts}
        ids = sorted(found - {""}, key=lambda c: (self.wide[c], c))
        return tuple(dict.fromkeys(c.rpartition("|")[0] for c in ids))[:TRIED]


def sample(count: int, seed: int, reached: Reached, only: list[str]) -> list[Mutant]:
    """Changes drawn from all modules, every room by the number of its possible ones."""
    chooser, every = random.Random(seed), []
    for package in ("minimax_cal", "qp_backends"):
        for path in sorted((ROOT / package).rglob("*.py")):
            module = str(path.relative_to(ROOT))
            if module.endswith("kernels/fast.py") or (only and not module.startswith(tuple(only))):
                continue
            found = changes(path.read_text(encoding="utf-8"))
            every += [(module, number, *each) for number, each in enumerate(found)]
    chosen = chooser.sample(every, min(count, len(every)))
    return [Mutant(*each, reached.tests(each[0], each[2])) for each in sorted(chosen)]


def tested(tree: str, tests: list[str], keep: bool, report: str) -> None:
    """Run tests of a tree in a process of their own.  report: where the times of each go."""
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 1)
    os.dup2(nowhere, 2)
    os.chdir(tree)
    os.environ |= {"PYTHONPATH": tree} | ({} if keep else {"PYTHONDONTWRITEBYTECODE": "1"})
    sys.path.insert(0, tree)
    sys.dont_write_bytecode = not keep
    import pytest

    more = [f"--junit-xml={report}"] if report else ["-x"]
    sys.exit(int(pytest.main([*more, "-q", "-p", "no:cacheprovider", "-m", "", *tests])))


def noticed(
    tree: Path, tests: list[str], limit: float, keep: bool = False, report: str = ""
) -> str:
    """'' if the tests pass in a tree, else how they noticed."""
    process = SERVER.Process(target=tested, args=(str(tree), tests, keep, report))
    process.start()
    process.join(limit)
    if process.exitcode is None:
        process.kill()
        return "time"
    return "failed" if process.exitcode else ""


def seconds_of(tree: Path, tests: list[str], report: Path) -> dict[str, float]:
    """What each test takes without a fault; those that do not pass are left out."""
    noticed(tree, tests, 3600.0, keep=True, report=str(report))
    out = {}
    for case in ElementTree.parse(report).iter("testcase"):
        if len(case) == 0:
            *folders, module = case.get("classname", "").split(".")
            name = f"{'/'.join([*folders, module])}.py::{case.get('name')}"
            out[name] = float(case.get("time", 0.0))
    return out


def main() -> None:
    """Print the survivors and the score of each room."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("modules", nargs="*", help="folders or files; all without")
    parser.add_argument("--count", type=int, default=200)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--coverage", type=Path, default=ROOT / ".coverage")
    chosen = parser.parse_args()
    os.environ |= {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    found = sample(chosen.count, chosen.seed, Reached(chosen.coverage, ROOT), chosen.modules)
    every, killed = Counter(one.room for one in found), Counter[str]()
    with tempfile.TemporaryDirectory() as folder:
        tree = Path(folder) / "tree"
        shutil.copytree(
            ROOT, tree, ignore=shutil.ignore_patterns(".git", ".venv*", "results", "__pycache__")
        )
        shared = ROOT.parent / "shared"
        if shared.exists():
            (Path(folder) / "shared").symlink_to(shared)
        known = sorted({test for one in found for test in one.tests})
        seconds = seconds_of(tree, known, Path(folder) / "times.xml")
        for one in found:
            tests = sorted((t for t in one.tests if t in seconds), key=seconds.__getitem__)[:MOST]
            path = tree / one.module
            source = path.read_text(encoding="utf-8")
            path.write_text(mutated(source, one.number), encoding="utf-8")
            limit = 60.0 + PATIENCE * sum(seconds[test] for test in tests)
            if tests and noticed(tree, tests, limit):
                killed[one.room] += 1
            else:
                text = source.splitlines()[one.line - 1].strip()
                print(f"{one.module}:{one.line}: {one.said}: {text}", flush=True)
            path.write_text(source, encoding="utf-8")
    for room, count in every.items():
        print(f"{room}: {killed[room]} of {count}")
    print(f"all: {killed.total()} of {every.total()} noticed", flush=True)


if __name__ == "__main__":
    main()
