"""Ten cells in one go: each is one row, a broken one too, and the page escapes what cells say."""

import json
from pathlib import Path

import numpy as np
import pytest
from conftest import run
from problems_watch import shifted

import minimax_cal as mc
from minimax_cal.modelling.simulate import Truth, simulate
from minimax_cal.reporting.fleet.overview import Fleet, Row

pytest.importorskip("jinja2", reason="needs pip install minimax-cal[fleet]")

CELLS = """
[defaults]
robot = "irb120"
tolerance = "rms 0.5"
objective = "sum"
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Ten cells: eight calibrations (one after a repair), a check, and a file that is broken."""
    folder = tmp_path_factory.mktemp("fleet")
    lines = [CELLS]
    for number in range(8):
        made = simulate("irb120", 24, 3, number, Truth(compliance=0.0))
        mc.write_measurements(folder / f"{number}.csv", made.data)
        lines.append(f'[[cells]]\nname = "cell {number}"\ndata = "{number}.csv"')
        if number == 0:
            fit = mc.calibrate("irb120", made.data, "sum")
            fit.save(folder / "old.json")
            cell = shifted(made.cell, 2, 1e-3)
            data = mc.measurements(made.data.q, made.data.y + cell.predict(made.data.q)
                                   - made.cell.predict(made.data.q))  # fmt: skip
            mc.write_measurements(folder / "0.csv", data)
            lines.append('fit = "old.json"')
            mc.write_measurements(folder / "ten.csv", made.data.take(made.data.q[:, 0] > 0))
    lines.append('[[cells]]\nname = "checked"\nfit = "old.json"\ncheck = "ten.csv"')
    (folder / "broken.csv").write_text("q1_rad,smr1_x_mm\n1,<script>\n")
    lines.append('[[cells]]\nname = "broken"\ndata = "broken.csv"')
    (folder / "cells.toml").write_text("\n".join(lines))
    return folder


def test_ten_cells(folder, tmp_path):
    found = mc.fleet(
        folder / "cells.toml", out=tmp_path / "fits", page=tmp_path / "page.html", processes=1
    )
    assert [row.cell for row in found.rows] == [
        *(f"cell {i}" for i in range(8)),
        "checked",
        "broken",
    ]
    assert [row.cell for row in found.failed] == ["broken"]
    told = {row.cell: row for row in found.rows}
    assert told["cell 0"].changed == ("J3",)
    assert told["checked"].verdict == "valid"
    alone = mc.calibrate("irb120", folder / "3.csv", "sum")
    assert told["cell 3"].rms_mm == alone.within.after.rms_mm
    kept = mc.load_fit(tmp_path / "fits" / "cell 3.json")
    np.testing.assert_allclose(kept.robot.mdh, alone.robot.mdh, rtol=0, atol=1e-14)
    assert Fleet.from_dict(json.loads(found.json())).json() == found.json()
    page = (tmp_path / "page.html").read_text()
    for row in found.rows:
        assert f">{row.cell}<" in page
    assert "<script" not in page


@pytest.mark.slow
def test_processes_say_what_one_says(folder):
    pytest.importorskip("joblib", reason="needs pip install minimax-cal[fleet]")
    one, two = (mc.fleet(folder / "cells.toml", processes=count).to_dict() for count in (1, 2))
    assert one == two


def test_the_command_goes_on_after_a_failed_cell(folder, tmp_path, says):
    text = (folder / "cells.toml").read_text().split("[[cells]]")
    short = folder / "short.toml"
    short.write_text("\n[[cells]]".join([text[0], text[-1], text[3]]))
    both = says("fleet", short, "--jobs", "1", "--json", code=1)
    told = json.loads(both.out)
    assert told["failed"] == 1
    assert [row["status"] for row in told["rows"]] == ["failed", "converged"]
    assert both.err.splitlines()[-1] == "error: 1 cells failed: broken"


def test_what_cells_say_is_escaped():
    row = Row("a", "<b>&", "calibrated", "converged", "", 1.0, 1.0, 1.0, (), "", "<img src=x>")
    page = Fleet((row,), "<i>").html()
    for bad in ("<b>", "<img", "<i>"):
        assert bad not in page
    assert "&lt;img" in page


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("cells = 3", "write [defaults] once"),
        ("[defaults]\nrobot = 'irb120'", "holds 0 cells"),
        ("[[cells]]\nname = 'a'", "give data"),
        ("[[cells]]\nname = 'a'\ndata = 'x.csv'", "needs robot"),
        ("[[cells]]\nname = '../a'\nrobot = 'b'\ndata = 'x.csv'", "it names a file"),
        ("[[cells]]\nname = 'a'\nrobt = 'b'\ndata = 'x.csv'", "robt: is not known"),
        ("[[cells]]\nname = 'a'\nfit = 'b'\ncheck = 'x.csv'", "and tolerance"),
        ("[[cells]]\nname='a'\nrobot='b'\ndata='x.csv'\ntolerance='0.2'", "write it in mm"),
        ("[[cells]]\nname='a'\nrobot='b'\ndata='x'\n[[cells]]\nname='A'\nrobot='b'\ndata='x'",
         "two cells are called"),
        ("[[cells]", "is not TOML"),
    ],
)  # fmt: skip
def test_a_wrong_file_is_one_line(text, said, tmp_path, says):
    (tmp_path / "cells.toml").write_text(text)
    err = says("fleet", tmp_path / "cells.toml", code=2).err
    assert said in err
    assert len(err.splitlines()) == 1


def test_a_wrong_place_is_one_line(folder, says):
    cells = folder / "cells.toml"
    for wrong in ((cells, "--jobs", 0), (cells, "--page", "page.png"), (folder / "none.toml",)):
        assert len(says("fleet", *wrong, code=2).err.splitlines()) == 1


def test_what_a_calibration_says_is_in_its_row(folder, tmp_path, capsys):
    """A fleet of the wrong robot looked like any other."""
    other = simulate("ur10", 24, 3, 1, Truth(compliance=0.0)).data
    mc.write_measurements(tmp_path / "other.csv", other)
    cells = tmp_path / "cells.toml"
    cells.write_text(f"{CELLS}[[cells]]\nname = 'a'\ndata = '{folder / '1.csv'}'\n")
    plain = mc.fleet(cells, processes=1).rows[0].notices
    assert plain == mc.calibrate("irb120", folder / "1.csv", "sum").notices
    cells.write_text("[defaults]\nrobot = 'irb2600'\n[[cells]]\nname = 'a'\ndata = 'other.csv'\n")
    run("fleet", cells, "--jobs", "1", "--json", "--page", tmp_path / "page.html")
    both = capsys.readouterr()
    (row,) = json.loads(both.out)["rows"]
    told = [text for text in row["notices"] if "the nominal robot misses by" in text]
    assert told
    assert f"notice: a: {told[0]}" in both.err
    assert "the nominal robot misses by" in (tmp_path / "page.html").read_text()
