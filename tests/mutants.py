"""Small faults put into a module, one at a time: which do its tests notice?

    python tests/mutants.py minimax_cal/robots/kinematics.py tests/robots/test_kinematics.py
    python tests/mutants.py MODULE TEST... --count 20 --seed 1
    python tests/mutants.py MODULE TEST... --line 88  # of the same sample, those of a line

A seeded sample of changes: another comparison, sign, operation, number, truth value or extreme.
Each is run in a copy of the project; a test that fails, or runs six times as long, has killed
it.  Processes fork from one that has the libraries loaded.
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
import time
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
PATIENCE = 6.0  # times what the tests take without a fault
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


def mutants(source: str) -> list[tuple[int, str, str]]:
    """Line, what was changed, and the whole source with that change."""
    tree = ast.parse(source)
    return [
        (getattr(node, "lineno", 0), said, ast.unparse(tree))
        for node in code(tree)
        for said in faults(node)
    ]


def tested(tree: str, tests: list[str], keep: bool) -> None:
    """Run tests of a tree in a process of their own.  keep: the compiled modules."""
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 1)
    os.dup2(nowhere, 2)
    os.chdir(tree)
    os.environ |= {"PYTHONPATH": tree} | ({} if keep else {"PYTHONDONTWRITEBYTECODE": "1"})
    sys.path.insert(0, tree)
    sys.dont_write_bytecode = not keep
    import pytest

    sys.exit(int(pytest.main(["-x", "-q", "-p", "no:cacheprovider", *tests])))


def noticed(tree: Path, tests: list[str], limit: float, keep: bool = False) -> str:
    """'' if the tests pass in a tree, else how they noticed."""
    process = SERVER.Process(target=tested, args=(str(tree), tests, keep))
    process.start()
    process.join(limit)
    if process.exitcode is None:
        process.kill()
        return "time"
    return "failed" if process.exitcode else ""


def main() -> None:
    """Print the survivors and the score."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("module")
    parser.add_argument("tests", nargs="+")
    parser.add_argument("--count", type=int, default=60)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--line", type=int, action="append", help="those of the sample alone")
    chosen = parser.parse_args()
    source = (ROOT / chosen.module).read_text()
    every = mutants(source)
    sample = random.Random(chosen.seed).sample(every, min(chosen.count, len(every)))
    sample = [each for each in sample if not chosen.line or each[0] in chosen.line]
    os.environ |= {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    with tempfile.TemporaryDirectory() as folder:
        tree = Path(folder) / "tree"
        shutil.copytree(
            ROOT, tree, ignore=shutil.ignore_patterns(".git", ".venv*", "results", "__pycache__")
        )
        began = time.perf_counter()
        if said := noticed(tree, chosen.tests, 3600.0, keep=True):
            raise SystemExit(f"the tests {said} without any fault")
        limit = max(60.0, PATIENCE * (time.perf_counter() - began))
        survivors = []
        for line, what, mutated in sorted(sample):
            (tree / chosen.module).write_text(mutated)
            if not noticed(tree, chosen.tests, limit):
                survivors.append(line)
                print(f"{chosen.module}:{line}: {what}: {source.splitlines()[line - 1].strip()}",
                      flush=True)  # fmt: skip
    killed = len(sample) - len(survivors)
    share = 100 * killed / len(sample)
    print(f"{chosen.module}: {killed} of {len(sample)} killed ({share:.0f} %), "
          f"of {len(every)} possible", flush=True)  # fmt: skip


if __name__ == "__main__":
    main()
