"""The figures of the documentation's pages are what the kept runs print, byte by byte."""

import json
import re

import numpy as np
import pytest
from click.testing import CliRunner
from numpy.testing import assert_allclose

from experiments import pages
from experiments.study_record import table_from_json, table_to_json
from experiments.sweep import study_options
from minimax_cal.core.errors import OptionError
from minimax_cal.core.tables import Table

NUMBER = re.compile(r"[-+]?[\d,]+(\.\d+)?(e[-+]?\d+)?( ?%)?")


def page_text(name: str) -> str:
    return (pages.DOCS_FOLDER / f"{name}.md").read_text(encoding="utf-8")


@pytest.mark.parametrize("name", pages.PAGES_WITH_FIGURES)
def test_a_page_is_what_the_command_writes(name):
    assert pages.rewrite_page_blocks(page_text(name)) == page_text(name)


@pytest.mark.parametrize("name", pages.PAGES_WITH_FIGURES)
def test_a_page_says_which_runs_made_it(name):
    blocks = [found[2] for found in pages.FIGURE_BLOCK_PATTERN.finditer(page_text(name))]
    assert blocks[-1] == "made"
    assert len(set(blocks)) == len(blocks) > 1
    for run in {pages.PAGE_BLOCKS[block].run for block in blocks[:-1]}:
        made = pages.read_run_figures(run)["made"]
        assert f"`{made['command']}`" in page_text(name)
        assert made["command"] == f"python -m {pages.PAGE_RUNS[run].command}"
        assert re.fullmatch(r"\d{4}-\d\d-\d\d", made["date"])
        assert re.fullmatch(r"[0-9a-f]{8,}", made["commit"]), f"{run}: commit, then run again"


def test_every_block_and_every_run_is_shown_somewhere():
    shown = {
        found[2]
        for name in pages.PAGES_WITH_FIGURES
        for found in pages.FIGURE_BLOCK_PATTERN.finditer(page_text(name))
    }
    assert shown == {*pages.PAGE_BLOCKS, "made"}
    assert {block.run for block in pages.PAGE_BLOCKS.values()} == set(pages.PAGE_RUNS)
    kept = {path.stem for path in pages.DOCS_FIGURES_FOLDER.glob("*.json")}
    assert kept == set(pages.PAGE_RUNS)


def tables_of(text: str) -> list[list[list[str]]]:
    """Cells of the body of each pipe table."""
    found = re.findall(r"^\|.*\|\n\|[-:| ]+\|\n((?:\|.*\|\n)+)", text, re.M)
    return [
        [
            [cell.strip() for cell in re.split(r"(?<!\\)\|", line)[1:-1]]
            for line in body.splitlines()
        ]
        for body in found
    ]


def is_of_figures(table: list[list[str]]) -> bool:
    """Whether half the cells of some column are numbers."""
    columns = zip(*table, strict=True)
    return any(2 * sum(bool(NUMBER.fullmatch(c)) for c in one) >= len(one) for one in columns)


@pytest.mark.parametrize("name", pages.PAGES_WITH_FIGURES)
def test_no_figures_stand_outside_of_blocks(name):
    text = page_text(name)
    assert any(map(is_of_figures, tables_of(text)))
    assert not [
        table
        for table in tables_of(pages.FIGURE_BLOCK_PATTERN.sub("", text))
        if is_of_figures(table)
    ]


def test_a_table_of_figures_is_noticed():
    assert is_of_figures(tables_of("| a | b |\n|---|---:|\n| x | 1.5 |\n| y | 12 % |\n")[0])
    assert not is_of_figures(tables_of("| a | b |\n|---|---|\n| x | `0` |\n| y | 1 of 3 |\n")[0])


def test_a_changed_figure_is_mended():
    text = page_text("watch")
    block = next(pages.FIGURE_BLOCK_PATTERN.finditer(text))[0]
    wrong = text.replace(block, re.sub(r"\d+\.\d", "0.0", block))
    assert wrong != text
    assert pages.rewrite_page_blocks(wrong) == text


def test_a_block_without_a_run_is_one_line():
    with pytest.raises(OptionError, match="no block 'watch/none'"):
        pages.rewrite_page_blocks("<!-- figures: watch/none -->\n<!-- end -->")


def test_a_table_survives_its_file(tmp_path):
    rows = [("a|b", 1, 0.5), ("c", 2, float("nan")), ("d", 3, float("inf"))]
    table = Table.from_rows("title", rows, "name | n d | value mm .3f")
    pages.write_json(tmp_path / "t.json", {"tables": [table_to_json(table)]})
    again = table_from_json(json.loads((tmp_path / "t.json").read_text())["tables"][0])
    assert again.markdown() == table.markdown()


def test_a_study_leaves_its_tables_and_its_command(tmp_path):
    @study_options("small")
    def small(study):
        study.save([Table.from_rows("first", [(1, 2.5)], "n d | x .1f")], {"rows": [1]})

    path = tmp_path / "s.json"
    words = ["--seed", "7", "--quick", "--out", str(tmp_path), "--json", str(path), "--jobs", "1"]
    assert CliRunner().invoke(small, words).exit_code == 0
    content = json.loads(path.read_text())
    assert content["rows"] == [1]
    assert content["made"]["command"] == "python -m experiments small --quick --seed 7"
    assert content["tables"][0]["rows"] == [[1, 2.5]]
    assert table_from_json(content["tables"][0]).formatted_cells() == [["1", "2.5"]]


def test_the_cost_of_solve_is_of_the_qps_that_a_calibration_asks():
    """Every answer is the same by all three ways, and each QP has the rows of the distances."""
    pytest.importorskip("daqp")
    from experiments.qp_cases import record_calibration_qps
    from experiments.solver_accuracy import (
        build_direct_call,
        build_raw_daqp_call,
        build_solve_cost_table,
    )
    from qp_backends import solve

    asked = record_calibration_qps(0)
    assert {len(problem.l) for problem in asked} == {6}  # three targets, three distances
    for problem in asked:
        x = solve(problem, "daqp", tolerance=1e-9).x
        call, read = build_direct_call(problem, "daqp")
        assert_allclose(read(call()).x, x, atol=1e-6)
        assert_allclose(build_raw_daqp_call(problem)()[0], x, atol=1e-6)
    row = build_solve_cost_table(asked[:1], ["daqp"], 1).rows[0]
    assert row[1] == 1
    ours, theirs, ratio, raw, over_raw = row[2:]
    assert_allclose([ours / theirs, ours / raw], [ratio, over_raw])
    assert min(ours, theirs, raw) > 0.0


def test_eq_32_with_its_constraint_is_slsqps():
    """Where the constraint binds: distances said to be 0.2 mm longer, to one micrometre."""
    from scipy import optimize

    from experiments.speed import (
        SpeedCase,
        fit_least_squares,
        identify_parameters,
        simulate_measurements,
        to_raw_arrays,
    )
    from experiments.warm_start import fit_sum_with_constraint
    from minimax_cal.fitting.minimax_problem import TargetDistanceLimits, measured_distances
    from minimax_cal.robots.robot import load_robot

    robot, data = load_robot("irb2600"), simulate_measurements(40, 3)
    model, free = fit_least_squares(robot, data)
    usual = measured_distances(data)
    kept = TargetDistanceLimits(usual.pairs, usual.mean + 2e-4, np.full(len(usual.mean), 1e-6))
    found = fit_sum_with_constraint(model, free, kept)
    assert str(found.status) == "converged"
    sums = model.target_costs(found.x).sum()
    assert sums > 1.001 * model.target_costs(free).sum()
    apart = found.x.target_positions[kept.pairs[:, 0]] - found.x.target_positions[kept.pairs[:, 1]]
    assert np.abs(np.linalg.norm(apart, axis=1) - kept.mean).max() <= 1e-6 * (1 + 1e-6)

    raw = to_raw_arrays(SpeedCase(robot, model, identify_parameters(robot, data)[1], None), data)
    raw = type(raw)(**{**vars(raw), "mean": kept.mean, "tolerance": kept.tolerance * 1e2})
    J = raw.errors_and_jacobian(np.zeros(len(raw.free)))[1]
    unit = 1.0 / np.sqrt((J**2).sum(axis=(1, 2, 3)))
    size = model.target_costs(free).sum()

    def value(u):
        return (raw.errors_and_jacobian(u * unit)[0] ** 2).sum() / size

    def slope(u):
        error, J = raw.errors_and_jacobian(u * unit)
        return -2.0 * (J * error).sum(axis=(1, 2, 3)) * unit / size

    limit = 1e-2  # of the distances, a micrometre in the tolerance of `raw`
    room = [
        {
            "type": "ineq",
            "fun": lambda u, side=side: limit - side * raw.scaled_target_distances(u * unit)[0],
            "jac": lambda u, side=side: -side * raw.scaled_target_distances(u * unit)[1] * unit,
        }
        for side in (1.0, -1.0)
    ]
    options = {"maxiter": 500, "ftol": 1e-14}
    other = optimize.minimize(value, np.zeros(len(unit)), jac=slope, constraints=room,
                              method="SLSQP", options=options)  # fmt: skip
    assert_allclose(sums / size, other.fun, rtol=1e-6)
