"""Texts as rows and numbers: whole tables at once as cell by cell."""

import numpy as np
import pytest
from numpy.testing import assert_array_equal

import minimax_cal as mc
from minimax_cal.reading.column_words import convert_header_to_standard_names
from minimax_cal.reading.text_sheet import (
    build_text_sheet,
    parse_numbers,
    parse_sheet_table,
    read_text_sheet,
)


@pytest.mark.parametrize(("delimiter", "sign"), [",.", ";.", "\t.", ";,", "\t,"])
def test_a_table_read_at_once_is_that_of_its_cells(delimiter, sign):
    rng = np.random.default_rng(0)
    values = rng.normal(size=(20_000, 4)) * 10.0 ** rng.integers(-30, 30, (20_000, 4))
    rows = [delimiter.join(map(repr, row)).replace(".", sign) for row in values.tolist()]
    table = parse_sheet_table(
        build_text_sheet("x.csv", "\n".join([delimiter.join("abcd"), *rows, ""]))
    )
    assert table.block is not None
    assert table.decimal == sign
    assert_array_equal(table.block, values)
    assert_array_equal(table.line, np.arange(len(values)) + 2)
    assert_array_equal(parse_numbers([row[2] for row in table.cells]), values[:, 2])


@pytest.mark.parametrize(
    "row", ["1,,3", "1,x,3", "1,null,3", "1,[2],3", "1,1_0,3", '1,"2",3', "1,1e999,3", "01,2,3"]
)
def test_what_is_no_plain_number_is_left_to_the_cells(row):
    table = parse_sheet_table(build_text_sheet("x.csv", f"a,b,c\n1,2,3\n{row}\n4,5,6\n"))
    assert table.block is None
    assert table.cells[1] == tuple(row.replace('"', "").split(","))


@pytest.mark.parametrize("cell", ["1,234", "12,345", "-1,234"])
def test_a_comma_that_may_part_thousands_is_asked_about(cell):
    sheet = build_text_sheet("x.csv", f"a;b\n{cell};{cell}\n{cell};7\n")
    with pytest.raises(mc.DataError, match=r"x.csv:2: column a: .* decimal comma or be thousands"):
        parse_sheet_table(sheet)
    assert parse_sheet_table(sheet, ",").cells[0][0].replace(",", ".") == cell.replace(",", ".")


def test_words_that_mean_a_column_of_this_project():
    german = ["Pose", "Achse 1 [°]", "Achse 2 [°]", "Zeit [s]", "Werkzeug", "Prüfer"]
    assert convert_header_to_standard_names(german) == (
        "pose",
        "q1_deg",
        "q2_deg",
        "time_s",
        "tool",
        "Prüfer",
    )
    own = ["q1_deg", "name", "id", "outil"]
    assert convert_header_to_standard_names(own) == ("q1_deg", "name", "id", "tool")
    assert convert_header_to_standard_names(["Ziel", "X [mm]", "y_mm"]) == (
        "target",
        "x_mm",
        "y_mm",
    )


def test_a_file_without_columns_or_text(tmp_path):
    for content, said in ((b"word\n", "no columns"), (b"\0\1\2", "not a text"), (b" ", "empty")):
        (tmp_path / "x").write_bytes(content)
        with pytest.raises(mc.DataError, match=said):
            parse_sheet_table(read_text_sheet(tmp_path / "x"))
