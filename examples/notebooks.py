"""Notebooks of the examples, for those who work in Jupyter.

python examples/notebooks.py [FOLDER]

The site runs the same scripts and shows their pictures; a block that begins with ``# %%`` is a
cell of text, what follows it one of code.
"""

import ast
import json
import sys
from pathlib import Path

HERE = Path(__file__).parent
EXAMPLES = ("tracker_to_report", "diagnose_a_gap", "papers_compared", "calibrate_and_judge")
MARK = "# %%"


def text_of(lines: list[str]) -> str:
    """Comments as text; the site's double backticks are Markdown's single ones."""
    return "\n".join(line.removeprefix("#").removeprefix(" ") for line in lines).replace("``", "`")


def cells_of(source: str) -> list[dict[str, object]]:
    """The cells of an example: its docstring, then text and code by turns."""
    title, _, about = (ast.get_docstring(ast.parse(source)) or "").partition("\n")
    intro = about.lstrip("=\n").replace("``", "`")
    out = [cell("markdown", f"# {title}\n\n{intro}")]
    body = source.split('"""', 2)[2]
    for number, block in enumerate(body.split(f"\n{MARK}\n")):
        lines = block.strip("\n").splitlines()
        said = 0
        while number and said < len(lines) and lines[said].startswith("#"):
            said += 1
        if said:
            out.append(cell("markdown", text_of(lines[:said])))
        if code := "\n".join(lines[said:]).strip("\n"):
            out.append(cell("code", code))
    return out


def cell(kind: str, text: str) -> dict[str, object]:
    """One cell of a notebook [nbformat 4.5]."""
    out: dict[str, object] = {"cell_type": kind, "metadata": {}, "source": text}
    return out | ({"execution_count": None, "outputs": []} if kind == "code" else {})


def notebook(source: str) -> dict[str, object]:
    """An example as a notebook without outputs."""
    cells = [{"id": f"cell-{number}", **each} for number, each in enumerate(cells_of(source))]
    kernel = {"display_name": "Python 3", "language": "python", "name": "python3"}
    about = {"kernelspec": kernel, "language_info": {"name": "python"}}
    return {"cells": cells, "metadata": about, "nbformat": 4, "nbformat_minor": 5}


def write(folder: Path) -> list[Path]:
    """Every example as a notebook in a folder."""
    folder.mkdir(parents=True, exist_ok=True)
    paths = []
    for name in EXAMPLES:
        source = (HERE / f"{name}.py").read_text(encoding="utf-8")
        path = folder / f"{name}.ipynb"
        path.write_text(json.dumps(notebook(source), indent=1) + "\n", encoding="utf-8")
        paths.append(path)
    return paths


if __name__ == "__main__":
    for written in write(Path(sys.argv[1]) if len(sys.argv) > 1 else Path()):
        print(f"written: {written}")
