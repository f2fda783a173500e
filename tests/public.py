"""Tests that use the project only as its users may: `mc.*`, `qp_backends.*`, a command.

    python tests/public.py             # their names, as pytest takes them
    python tests/public.py REVISION    # run those of a revision with the code that stands here

They outlive every move inside.  A test counts if neither it nor what it uses of its module, of
conftest or of the modules beside names anything else of the packages.
"""

from __future__ import annotations

import ast
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
PACKAGES = ("minimax_cal", "qp_backends", "experiments")
DOORS = {"minimax_cal", "qp_backends", "minimax_cal.cli.main"}


def doors(tree: Path) -> set[str]:
    """Dotted names that are public: packages, what they offer, and where that is defined."""
    out = set(DOORS)
    for package in ("minimax_cal", "qp_backends"):
        source = (tree / package / "__init__.py").read_text(encoding="utf-8")
        for node in ast.walk(ast.parse(source)):
            if isinstance(node, ast.ImportFrom):
                out |= {dotted for _, dotted in imports(node)}
            elif isinstance(node, ast.Assign) and isinstance(node.value, ast.Dict | ast.List):
                out |= {
                    f"{package}.{n.value}" for n in ast.walk(node) if isinstance(n, ast.Constant)
                }
    return out


def imports(node: ast.AST) -> Iterator[tuple[str, str]]:
    """Local and dotted names of what a statement imports."""
    if isinstance(node, ast.Import):
        yield from ((name.asname or name.name.partition(".")[0], name.name) for name in node.names)
    elif isinstance(node, ast.ImportFrom) and node.module:
        yield from ((name.asname or name.name, f"{node.module}.{name.name}") for name in node.names)


def used(node: ast.AST) -> set[str]:
    """Names that a definition uses, its fixtures too; what it imports itself, dotted."""
    out = set()
    for part in ast.walk(node):
        if isinstance(part, ast.Name):
            out.add(part.id)
        elif isinstance(part, ast.arg):
            out.add(part.arg)
        out |= {dotted for _, dotted in imports(part)}
    return out


class Suite:
    """The test modules of a tree: what each name of theirs is, and uses."""

    def __init__(self, tree: Path) -> None:
        self.tree, self.doors = tree, doors(tree)
        self.paths = {path.stem: path for path in sorted(tree.glob("tests/**/*.py"))}
        self.uses: dict[str, dict[str, set[str]]] = {stem: {} for stem in self.paths}
        for stem, path in self.paths.items():
            for node in ast.parse(path.read_text(encoding="utf-8")).body:
                if isinstance(node, ast.FunctionDef | ast.ClassDef):
                    named, what = [node.name], used(node)
                elif isinstance(node, ast.Assign | ast.AnnAssign):
                    parts = node.targets if isinstance(node, ast.Assign) else [node.target]
                    named = [n.id for p in parts for n in ast.walk(p) if isinstance(n, ast.Name)]
                    what = used(node)
                else:
                    self.uses[stem] |= {name: {dotted} for name, dotted in imports(node)}
                    continue
                self.uses[stem] |= dict.fromkeys(named, what)

    def is_public(self, stem: str, name: str) -> bool:
        """Whether what a name leads to in the packages is there, and all of it is a door."""
        seen, left, some = set(), [(stem, name)], False
        while left:
            if (at := left.pop()) in seen:
                continue
            seen.add(at)
            for one in self.found(*at):
                package, _, rest = one.partition(".")
                if package == "tests":
                    package, _, rest = rest.rpartition(".")
                    package = package.rpartition(".")[2]
                if package in PACKAGES:
                    some = True
                    if one not in self.doors:
                        return False
                elif rest and package in self.paths:
                    left.append((package, rest))
                elif not rest:
                    left.append((at[0], one))
        return some

    def found(self, stem: str, name: str) -> set[str]:
        """What a name of a module uses: its own, or a fixture of conftest."""
        return self.uses[stem].get(name, self.uses["conftest"].get(name, set()) - {name})

    def public(self) -> Iterator[str]:
        """The tests, as pytest takes them."""
        for stem, path in self.paths.items():
            for name in self.uses[stem] if stem.startswith("test_") else ():
                if name.startswith("test_") and self.is_public(stem, name):
                    yield f"{path.relative_to(self.tree)}::{name}"


def without_internals(source: str) -> str:
    """A test module whose imports of what is gone bring a stand-in: its other tests still run."""
    lines = source.splitlines()
    for node in reversed(ast.parse(source).body):
        named = list(imports(node))
        if any(dotted.partition(".")[0] in PACKAGES for _, dotted in named):
            text = "\n".join(lines[node.lineno - 1 : node.end_lineno])
            names = " = ".join(name for name, _ in named)
            mock = "__import__('unittest.mock').mock.MagicMock()"
            kept = [f"try:\n    {text}\nexcept ImportError:\n    {names} = {mock}"]
            lines[node.lineno - 1 : node.end_lineno] = kept
    return "\n".join(lines) + "\n"


def run(revision: str) -> int:
    """The public tests of a revision with the packages that stand here."""
    with tempfile.TemporaryDirectory() as folder:
        tree = Path(folder)
        tar = subprocess.run(
            ["git", "-C", str(ROOT), "archive", revision], check=True, capture_output=True
        ).stdout
        subprocess.run(["tar", "-x", "-C", folder], input=tar, check=True)
        chosen = list(Suite(tree).public())
        for package in PACKAGES:
            subprocess.run(["rm", "-r", str(tree / package)], check=True)
            (tree / package).symlink_to(ROOT / package)
        for path in tree.glob("tests/**/*.py"):
            path.write_text(without_internals(path.read_text(encoding="utf-8")))
        command = [sys.executable, "-m", "pytest", "-q", "-n", "auto", *chosen]
        return subprocess.run(
            command, cwd=tree, env={**os.environ, "PYTHONPATH": folder}
        ).returncode


def main() -> int:
    """Print or run them."""
    if sys.argv[1:]:
        return run(sys.argv[1])
    print("\n".join(Suite(ROOT).public()))
    return 0


if __name__ == "__main__":
    sys.exit(main())
