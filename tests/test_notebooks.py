"""The examples as notebooks: whole, and they run from end to end."""

import runpy

import pytest
from conftest import ROOT

MADE = runpy.run_path(str(ROOT / "examples" / "notebooks.py"))
EXAMPLES = MADE["EXAMPLES"]


@pytest.mark.parametrize("name", EXAMPLES)
def test_cells_hold_all_of_the_script(name):
    """Code cells one after the other are the script without its comments between them."""
    source = (ROOT / "examples" / f"{name}.py").read_text()
    cells = MADE["notebook"](source)["cells"]
    kinds = [cell["cell_type"] for cell in cells]
    assert kinds[:2] == ["markdown", "code"]
    assert cells[0]["source"].startswith("# ")
    code = "\n".join(cell["source"] for cell in cells if cell["cell_type"] == "code")
    compile(code, name, "exec")
    body = source.split('"""', 2)[2].splitlines()
    kept = [line for line in body if line.strip() and not line.startswith("#")]
    assert [line for line in code.splitlines() if line.strip()] == kept


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore::ResourceWarning")
@pytest.mark.parametrize("name", EXAMPLES)
def test_notebooks_run(name, tmp_path, monkeypatch):
    for package in ("nbclient", "nbformat", "ipykernel", "matplotlib", "plotly"):
        pytest.importorskip(package, reason="notebooks need pip install -e .[dev]")
    import nbformat
    from nbclient import NotebookClient

    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    paths = {path.stem: path for path in MADE["write"](tmp_path)}
    book = nbformat.read(paths[name], as_version=4)
    nbformat.validate(book)
    NotebookClient(book, timeout=600, resources={"metadata": {"path": str(tmp_path)}}).execute()
    shown = [out for cell in book.cells for out in cell.get("outputs", [])]
    assert any("image/png" in out.get("data", {}) for out in shown)
    assert not any(out["output_type"] == "error" for out in shown)
