"""How many tokens `minimax_cal` has; sizes.toml says how many it may have.

    python tests/sizes.py

Tokens of Python without comments, docstrings and layout: names may be long, lines may be short.
"""

from __future__ import annotations

import ast
import io
import sys
import tokenize
import tomllib
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
FILE = ROOT / "tests" / "sizes.toml"
LAYOUT = {
    tokenize.COMMENT, tokenize.NL, tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT,
    tokenize.ENDMARKER,
}  # fmt: skip
HOLDERS = (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)


def count_tokens(source: str) -> int:
    """Tokens of one file."""
    docstring_lines: set[int] = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, HOLDERS) and ast.get_docstring(node, clean=False) is not None:
            first = node.body[0]
            docstring_lines |= set(range(first.lineno, (first.end_lineno or 0) + 1))
    tokens = tokenize.generate_tokens(io.StringIO(source).readline)
    return sum(
        token.type not in LAYOUT and token.start[0] not in docstring_lines for token in tokens
    )


def count_package_tokens(package: str, root: Path = ROOT) -> int:
    """Tokens of all files of a package."""
    files = sorted((root / package).rglob("*.py"))
    return sum(count_tokens(path.read_text(encoding="utf-8")) for path in files)


def read_limits() -> dict[str, int]:
    """Largest number of tokens of each package, from sizes.toml."""
    limits: dict[str, int] = tomllib.loads(FILE.read_text(encoding="utf-8"))
    return limits


def main() -> int:
    """Print the sizes; 1 where one is above its limit."""
    too_large = False
    for package, limit in read_limits().items():
        size = count_package_tokens(package)
        print(f"{package}: {size} tokens of at most {limit}")
        too_large |= size > limit
    return int(too_large)


if __name__ == "__main__":
    sys.exit(main())
