"""How large each room is, against sizes.toml, which may only fall.

    python tests/sizes.py          # rooms, their code lines and tokens, and what the ratchet allows
    python tests/sizes.py --lower  # take over what is smaller now

Code lines hold code: no blanks, comments or docstrings.  Tokens show where lines were only joined:
a room's lines are lowered where its tokens fell by at least `TOKENS` of the same share.
"""

from __future__ import annotations

import ast
import io
import sys
import tokenize
import tomllib
from collections import Counter
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
FILE = ROOT / "tests" / "sizes.toml"
PACKAGES = ("minimax_cal", "qp_backends", "experiments", "tests")
FEATURES = {  # that may not grow either, wherever they stand
    "the drive": {
        "minimax_cal/dynamics/drives.py", "minimax_cal/simulators/motion/drives.py",
    },
}  # fmt: skip
TOKENS = 0.8
LAYOUT = {
    tokenize.COMMENT, tokenize.NL, tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT,
    tokenize.ENDMARKER,
}  # fmt: skip
HOLDERS = (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)


def measure(source: str) -> Counter[str]:
    """Code lines, tokens and files of one file."""
    docs: set[int] = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, HOLDERS) and ast.get_docstring(node, clean=False) is not None:
            docs |= set(range(node.body[0].lineno, (node.body[0].end_lineno or 0) + 1))
    tokens = [
        token
        for token in tokenize.generate_tokens(io.StringIO(source).readline)
        if token.type not in LAYOUT and token.start[0] not in docs
    ]
    lines = {line for token in tokens for line in range(token.start[0], token.end[0] + 1)}
    return Counter(lines=len(lines - docs), tokens=len(tokens), files=1)


def rooms(root: Path = ROOT) -> dict[str, Counter[str]]:
    """Sizes of the folders of minimax_cal, of its top, and of the other packages."""
    out: dict[str, Counter[str]] = {}
    for package in PACKAGES:
        for path in sorted((root / package).rglob("*.py")):
            parts = path.relative_to(root).parts
            deep = package == "minimax_cal" and len(parts) > 2
            of = (name for name, paths in FEATURES.items() if "/".join(parts) in paths)
            for row in ("/".join(parts[: 1 + deep]), *of):
                size = measure(path.read_text(encoding="utf-8"))
                out.setdefault(row, Counter()).update(size)
    return out


def allowed() -> dict[str, dict[str, int]]:
    """What sizes.toml says."""
    return tomllib.loads(FILE.read_text(encoding="utf-8"))


def exceeded(now: dict[str, Counter[str]], most: dict[str, dict[str, int]]) -> list[str]:
    """Where a room is larger than it may be, or is not listed."""
    return [
        f"{room}: {size} {now[room][size]}, at most {most.get(room, {}).get(size, 0)}"
        for room in now
        for size in now[room]
        if now[room][size] > most.get(room, {}).get(size, 0)
    ]


def lowered(
    now: dict[str, Counter[str]], most: dict[str, dict[str, int]]
) -> dict[str, dict[str, int]]:
    """What may be from now on; a room that is gone is listed no more."""
    out = {}
    for room, old in most.items():
        if room not in now:
            continue
        new = {size: min(count, now[room][size]) for size, count in old.items()}
        if new["tokens"] > old["tokens"] * (1.0 - TOKENS * (1.0 - new["lines"] / old["lines"])):
            new["lines"] = old["lines"]  # joined lines are no smaller room
        out[room] = new
    return out


def text(most: dict[str, dict[str, int]]) -> str:
    """The file."""
    rows = (
        f'"{room}" = {{ {", ".join(f"{size} = {count}" for size, count in sizes.items())} }}'
        for room, sizes in most.items()
    )
    return "# The ratchet: `python tests/sizes.py --lower`\n" + "\n".join(rows) + "\n"


def main() -> int:
    """Print the rooms; 1 where one has grown."""
    now, most = rooms(), allowed()
    if "--lower" in sys.argv[1:]:
        FILE.write_text(text(most := lowered(now, most)), encoding="utf-8")
    for room, sizes in now.items():
        told = (f"{size} {sizes[size]:7} of {most.get(room, {}).get(size, 0):7}" for size in sizes)
        print(f"{room:26}" + "   ".join(told))
    print("\n".join(grown := exceeded(now, most)))
    return int(bool(grown))


if __name__ == "__main__":
    sys.exit(main())
