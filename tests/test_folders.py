"""Imports point down: a folder imports only folders above it in this list."""

import ast
from pathlib import Path

import pytest

from minimax_cal.modelling.effects import EFFECTS

ROOT = Path(__file__).parent.parent
FOLDERS = (
    "core",
    "reading",
    "solvers",
    "selection",
    "robots",
    "measuring",
    "modelling",
    "instruments",
    "fitting",
    "validation",
    "diagnosing",
    "dynamics",
    "planning",
    "compensation",
    "simulators",
    "reporting",
    "webapp",
    "cli",
)
MODULES = sorted((ROOT / "minimax_cal").rglob("*.py"))


def imported(path: Path) -> set[str]:
    """Modules that a file imports, dotted."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and node.module:
            found |= {node.module, *(f"{node.module}.{name.name}" for name in node.names)}
        elif isinstance(node, ast.Import):
            found |= {name.name for name in node.names}
    return found


def test_every_folder_has_its_place():
    inside = (ROOT / "minimax_cal").iterdir()
    assert {p.name for p in inside if p.is_dir() and p.name != "__pycache__"} == set(FOLDERS)


@pytest.mark.parametrize("path", MODULES, ids=lambda p: str(p.relative_to(ROOT / "minimax_cal")))
def test_imports_point_down(path):
    folder = path.relative_to(ROOT / "minimax_cal").parts[0]
    allowed = {*FOLDERS[: FOLDERS.index(folder) + 1], "__init__"} if folder in FOLDERS else FOLDERS
    for module in imported(path):
        package, _, inner = module.partition(".")
        assert package not in ("experiments", "tests")
        if package == "minimax_cal" and inner:
            assert inner.partition(".")[0] in allowed, f"{folder} imports {module}"


def test_no_name_of_an_effect_is_compared():
    """What an effect does, it states; who must speak of one takes the name from its law."""
    above = {  # name their own: torques have laws of the same names
        "faults/target_steps.py",
        "faults/session_faults.py",
        "modelling/gear_periodogram.py",
        "dynamics/laws.py",
    }
    found = set()
    for path in MODULES:
        if path.parent.name != "effects" or path.parent.parent.name != "modelling":
            constants = (n.value for n in ast.walk(ast.parse(path.read_text()))
                         if isinstance(n, ast.Constant) and isinstance(n.value, str))  # fmt: skip
            if EFFECTS.keys() & set(constants):
                found.add("/".join(path.parts[-2:]))
    assert found == above


@pytest.mark.parametrize("path", sorted((ROOT / "qp_backends").glob("*.py")), ids=lambda p: p.stem)
def test_qp_backends_knows_no_robot(path):
    assert not any(module.startswith(("minimax_cal", "experiments")) for module in imported(path))
