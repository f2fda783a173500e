"""Numbers that decide: those that the diagnosis and its evidence compare with a statistic.

    python tests/thresholds.py

Lists each number of `diagnosing` and `selection` that is in a comparison, by its name or as it is,
and each of `selection/thresholds.py`.  Whole numbers say how much is sought, or count things; what
is not above ROUNDING, outside the limits, ends iterations or tells rounding from values; 0 and 1
nobody chose.  The others are compared with a statistic.
"""

from __future__ import annotations

import ast
from pathlib import Path

ROOT = Path(__file__).parent.parent
ROOMS = ("diagnosing", "selection")
LIMITS = "minimax_cal.selection.thresholds"
ROUNDING = 1e-3

Numbers = dict[str, float]  # by module and name, or by place and value


def thresholds() -> Numbers:
    """The numbers that are compared with a statistic."""
    found = numbers(LIMITS)
    for room in ROOMS:
        for path in sorted((ROOT / "minimax_cal" / room).rglob("*.py")):
            place = str(path.relative_to(ROOT))
            known = owned(place.removesuffix(".py").replace("/", "."))
            for node in ast.walk(ast.parse(path.read_text())):
                if isinstance(node, ast.Compare):
                    found |= compared(node, known, place)
    return {
        name: value
        for name, value in found.items()
        if not float(value).is_integer() or (isinstance(value, float) and value > 1.0)
        if name.startswith(LIMITS) or value > ROUNDING
    }


def numbers(module: str) -> Numbers:
    """Names in capitals that a module sets to numbers."""
    path, out = ROOT / f"{module.replace('.', '/')}.py", Numbers()
    for node in ast.parse(path.read_text()).body if path.exists() else []:
        if isinstance(node, ast.Assign):
            target, value = node.targets[0], node.value
            pairs = [(each, value) for each in node.targets]
            if isinstance(target, ast.Tuple) and isinstance(value, ast.Tuple):
                pairs = list(zip(target.elts, value.elts, strict=True))
            named = [(t.id, v) for t, v in pairs if isinstance(t, ast.Name) and t.id.isupper()]
            plain = [(name, v.value) for name, v in named if isinstance(v, ast.Constant)]
            out |= {f"{module}:{k}": v for k, v in plain if isinstance(v, (int, float))}
    return out


def owned(module: str) -> dict[str, Numbers]:
    """Of each name of a number in a module, its own or imported, where it is defined."""
    out = {key.partition(":")[2]: {key: value} for key, value in numbers(module).items()}
    path = ROOT / f"{module.replace('.', '/')}.py"
    for node in ast.parse(path.read_text()).body:
        if isinstance(node, ast.ImportFrom) and node.module:
            known = numbers(node.module)
            keys = {alias.name: f"{node.module}:{alias.name}" for alias in node.names}
            out |= {name: {key: known[key]} for name, key in keys.items() if key in known}
    return out


def compared(node: ast.Compare, known: dict[str, Numbers], place: str) -> Numbers:
    """The numbers in a comparison."""
    out = Numbers()
    for leaf in ast.walk(node):
        if isinstance(leaf, ast.Name):
            out |= known.get(leaf.id, {})
        if isinstance(leaf, ast.Constant) and type(leaf.value) in (int, float):
            out[f"{place}:{leaf.lineno}: {leaf.value}"] = leaf.value
    return out


if __name__ == "__main__":
    every = thresholds()
    for name, value in every.items():
        print(f"{value:<10g} {name}")
    print(f"{len(every)} numbers are compared with a statistic")
