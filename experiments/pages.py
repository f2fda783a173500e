"""The figures of the documentation's pages, written from what studies left in docs/figures.

    python -m experiments pages                  # rewrite the pages from docs/figures/*.json
    python -m experiments pages --run speed      # run a study again first; repeat --run, or "all"

A page has blocks between comments, each from the tables of one run; `PAGE_RUNS` has the command of
each run, `PAGE_BLOCKS` what is shown of its tables, and `made` the commands, versions and days of a
page.
"""

from __future__ import annotations

import json
import re
import shlex
import shutil
import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import takewhile
from pathlib import Path
from typing import Any

import click

from experiments.algorithm_1 import ALGORITHM_1_VARIANTS
from experiments.study_record import CHECKOUT_ROOT, table_from_json, write_json
from minimax_cal.core.errors import CalibrationError, OptionError
from minimax_cal.core.files import read_text, write_file_atomically
from minimax_cal.core.tables import Table

DOCS_FOLDER = CHECKOUT_ROOT / "docs"
DOCS_FIGURES_FOLDER, DOCS_IMAGES_FOLDER = DOCS_FOLDER / "figures", DOCS_FOLDER / "images"
PAGES_WITH_FIGURES = ("solver_accuracy", "trust", "papers", "relative", "watch", "speed")
FIGURE_BLOCK_PATTERN = re.compile(r"(<!-- figures: ([\w/]+) -->\n).*?(<!-- end -->)", re.DOTALL)
MISSING_CELL = "-"
MAX_LISTED_FAILED_CLAIMS = 4  # claims that are not listed where all fail


@dataclass(frozen=True)
class PageRun:
    """A run whose figures pages show.

    command: words after ``python -m``, in the size that a page states.  pictures: file in
    docs/images: what the study calls it in its folder.
    """

    command: str
    pictures: Mapping[str, str]


PAGE_RUNS = {
    "solver_accuracy": PageRun(
        "experiments solver_accuracy",
        {
            "subgradient.png": "subgradient",
            "profile_maros_meszaros.png": "profile_Maros-Meszaros",
        },
    ),
    "coverage": PageRun("experiments coverage --runs 100", {"coverage.png": "coverage"}),
    "external": PageRun("experiments external --arms irb120,fanuc_r2000,qkm_hl6 --halves 4", {}),
    "machine_gap": PageRun("experiments machine_gap --seed 7001 --every 16", {}),
    "blind_gap": PageRun(
        "experiments blind_gap --seed 2028 --every 60",
        {"blind_detectability.png": "blind_gap_detectability"},
    ),
    "fuzz": PageRun("tests.fuzz --cases 100 --seed 20261211", {}),
    "papers": PageRun(
        "experiments papers --every 7",
        {
            "papers_s_fig3.png": "convergence/rms_all_mm",
            "papers_s_fig4.png": "courses/s_fig4",
            "papers_s_fig5.png": "courses/s_fig5",
            "papers_s_fig6.png": "courses/s_fig6",
            "papers_m_fig2.png": "conditions/by_pose_irb120",
            "papers_m_fig5.png": "conditions/sums_irb120",
            "papers_m_fig6.png": "conditions/accuracy_irb120",
            "papers_splits.png": "splits/splits",
        },
    ),
    "algorithm_1": PageRun("experiments algorithm_1", {}),
    "warm_start": PageRun("experiments warm_start", {}),
    "relative": PageRun("experiments relative --seeds 8", {"relative.png": "relative"}),
    "one_session": PageRun(
        "experiments one_session --arms 24 --command compare --command check --command calibrate",
        {},
    ),
    "speed": PageRun("experiments speed", {}),
}


# ---- what a page shows of a table ----------------------------------------------------------------


@dataclass(frozen=True)
class PageBlock:
    """A part of a page: of which run, the first words of a table's title, and its Markdown."""

    run: str
    title: str
    write: Callable[[Table], str]


def make_column_writer(
    columns_text: str, keep_row: Callable[[dict[str, Any]], bool] | None = None
) -> Callable[[Table], str]:
    """Writes some columns of a table, and of its rows those that are kept.

    columns_text: headers between bars, each as the page has it and, after "=", as the table has it.
    """
    pairs = [(shown.strip(), name.strip() or shown.strip()) for shown, _, name in
             (part.partition("=") for part in columns_text.split("|"))]  # fmt: skip

    def write(table: Table) -> str:
        rows = [
            row
            for row in table.rows
            if keep_row is None or keep_row(dict(zip(table.header, row, strict=True)))
        ]
        chosen = [table.header.index(name) for _, name in pairs]
        some = replace(table, rows=tuple(rows)).select_columns(*chosen)
        return format_table_body(replace(some, header=tuple(shown for shown, _ in pairs)))

    return write


def format_table_body(table: Table) -> str:
    """A table in Markdown, without its title."""
    return table.markdown().partition("\n\n")[2].rstrip()


# ---- QP backends ---------------------------------------------------------------------------------

OWN_DEFAULTS_SETTING = "own defaults"


def format_backend_table(table: Table) -> str:
    """A row a backend: our two tolerances, and its own defaults beside them."""
    cells: dict[tuple[str, str], dict[str, str]] = {}
    for row in table.formatted_cells():
        named = dict(zip(table.header, row, strict=True))
        cells[named["backend"], named["setting"]] = named
    shown = (
        ("ours 1e-6", ("right %", "worst relative", "ms (shifted mean)")),
        ("ours 1e-9", ("right %",)),
        (OWN_DEFAULTS_SETTING, ("right %", "wrongly claimed", "ms (shifted mean)")),
    )
    header = (
        "backend", "at 1e-6: right %", "worst relative", "ms", "at 1e-9: right %",
        "own defaults: right %", "wrongly claimed", "ms",
    )  # fmt: skip
    rows = [
        (
            name,
            *(cells.get((name, setting), {}).get(column, MISSING_CELL)
              for setting, some in shown for column in some),
        )
        for name in dict.fromkeys(backend for backend, _ in cells)
    ]  # fmt: skip
    problems = table.rows[0][table.header.index("problems")]
    return f"{problems} problems.\n\n{format_right_aligned_table(header, rows)}"


def format_right_aligned_table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A Markdown table of text whose columns after the first hold numbers."""
    lines = [header, ["---", *["---:"] * (len(header) - 1)], *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def describe_backend_reliability(table: Table) -> str:
    """What no backend, and which backends, get wrong with our settings and with their own."""
    records: list[dict[str, Any]] = [
        dict(zip(table.header, row, strict=True)) for row in table.rows
    ]
    short = [
        f"{r['backend']} {r['right %']:.1f} %"
        for r in records
        if r["setting"] == "ours 1e-6" and r["right %"] < 100.0
    ]
    lies = [
        r["backend"]
        for r in records
        if r["setting"] == OWN_DEFAULTS_SETTING and r["wrongly claimed"]
    ]
    claimed = sum(r["wrongly claimed"] for r in records if r["setting"] != OWN_DEFAULTS_SETTING)
    return (
        f"Right on less than all at 1e-6: {', '.join(short) or 'none'}. Wrong answers called "
        f"solved: with our settings {claimed}; with their own defaults from "
        f"{', '.join(lies) or 'none'}."
    )


# ---- the papers ----------------------------------------------------------------------------------


def describe_verdict_counts(table: Table) -> str:
    """How many items have which verdict."""
    found = Counter(str(row[table.header.index("verdict")]) for row in table.rows)
    return f"Of {len(table.rows)} items: " + ", ".join(f"{n} {v}" for v, n in found.items()) + "."


def format_verdict_items(table: Table) -> str:
    """The verdicts without their remarks; of claims that all failed it says so."""
    rows = []
    for row in table.rows:
        named = dict(zip(table.header, map(str, row), strict=True))
        claims = named["failed"].split("; ")
        many = len(claims) > MAX_LISTED_FAILED_CLAIMS and not named["held"]
        failed = f"all {len(claims)}" if many else join_claims_without_repeats(claims)
        arms = (re.sub(r", (real|simulated)", "", text) for text in (named["ours"], failed))
        verdict = ": ".join(filter(None, (named["claims"], named["verdict"])))
        rows.append((named["item"], named["paper"], *arms, verdict))
    header = ("item", "paper", "ours", "claims that failed", "claims that hold: verdict")
    return format_table_body(Table("", header, tuple(rows)))


def join_claims_without_repeats(claims: Sequence[str]) -> str:
    """Claims in one line; the words that all of several end with are said once."""
    words = [claim.split() for claim in claims]
    ends = zip(*(one[:0:-1] for one in words), strict=False)
    same = len(list(takewhile(lambda column: len(set(column)) == 1, ends)))
    if len(words) == 1 or not same:
        return "; ".join(claims)
    starts = "; ".join(" ".join(one[:-same]).rstrip(":") for one in words)
    return f"{starts}: {' '.join(words[0][-same:])}"


def format_coverage_table(table: Table) -> str:
    """A row a case: sigmas from the scatter of the poses, and the worst parameter by noise."""
    cells = [dict(zip(table.header, row, strict=True)) for row in table.formatted_cells()]
    header = ("case", "runs", "all parameters %", "worst parameter %", "RMS error / sigma",
              "worst by noise alone %")  # fmt: skip
    rows = [
        (poses["case"], poses["runs"], poses["pooled %"], poses["least %"],
         poses["RMS error / sigma"], noise["least %"])
        for poses, noise in zip(cells[::2], cells[1::2], strict=True)
    ]  # fmt: skip
    return format_right_aligned_table(header, rows)


def format_criteria_table(table: Table) -> str:
    """The criteria of a blind study that have a limit; what is indented is a part of the above."""
    first = table.header.index("criterion")
    rows = [
        (str(row[first]).replace("  ", "of these: ", 1), *row[first + 1 :]) for row in table.rows
    ]
    return make_column_writer(
        "criterion | runs | found % =found | 95 % interval | limit | verdict",
        lambda row: bool(row["limit"]),
    )(add_interval_column(replace(table, rows=tuple(rows)), "low", "high"))


def add_interval_column(table: Table, low: str, high: str) -> Table:
    """One column more, of two others as text."""
    first, last = table.header.index(low), table.header.index(high)
    rows = [
        (*row, f"{cells[first]}-{cells[last]}")
        for row, cells in zip(table.rows, table.formatted_cells(), strict=True)
    ]
    return Table(table.title, (*table.header, "95 % interval"), tuple(rows), (*table.formats, ""))


def format_session_halves_table(table: Table) -> str:
    """The rates of halves of a session; of the other joint that is named without its interval."""
    some = replace(
        table.select_columns(*range(8)), header=(*table.header[:5], "low", "high", "another %")
    )
    shown = "arms | cut by | command | cuts | right % | 95 % interval | another named % =another %"
    return make_column_writer(shown)(add_interval_column(some, "low", "high"))


def is_row_of_all_commands(row: Mapping[str, Any]) -> bool:
    """Of all commands together."""
    return bool(row["command"] == "all")


RELATIVE_TABLE_COLUMNS = (
    "robot | measured | held out mm=held out RMS mm | nominal, true mm=true position, nominal "
    "RMS mm | true mm=true position RMS mm | expected mm=expected by sigmas mm | with the best "
    "scale mm=scaled, too: RMS mm"
)
PAGE_BLOCKS = {
    "solver_accuracy/small": PageBlock(
        "solver_accuracy", "calibration, 6 rows:", format_backend_table
    ),
    "solver_accuracy/small_words": PageBlock(
        "solver_accuracy", "calibration, 6 rows:", describe_backend_reliability
    ),
    "solver_accuracy/large": PageBlock(
        "solver_accuracy", "calibration, 303 rows:", format_backend_table
    ),
    "solver_accuracy/large_words": PageBlock(
        "solver_accuracy", "calibration, 303 rows:", describe_backend_reliability
    ),
    "solver_accuracy/maros": PageBlock("solver_accuracy", "Maros-Meszaros:", format_backend_table),
    "solver_accuracy/hard": PageBlock("solver_accuracy", "hard:", format_backend_table),
    "solver_accuracy/cost": PageBlock("solver_accuracy", "what solve costs", format_table_body),
    "solver_accuracy/subgradient": PageBlock(
        "solver_accuracy", "restarted averaged PDHG", format_table_body
    ),
    "solver_accuracy/sqp": PageBlock(
        "solver_accuracy",
        "minimax calibration",
        make_column_writer("backend | status | QPs | max F_i/m mm^2 | above the first | ms"),
    ),
    "coverage/parameters": PageBlock(
        "coverage",
        "coverage of 95 % intervals of the identified",
        format_coverage_table,
    ),
    "coverage/held_out": PageBlock(
        "coverage",
        "held-out accuracy",
        make_column_writer(
            "errors of | poses | runs | RMS % | largest %", lambda row: bool(row["poses"] == 20)
        ),
    ),
    "external/claims": PageBlock(
        "external",
        "external over claimed",
        make_column_writer(
            "arm | way | inside: halves at 0.8-1.25 of the claim % =over within 0.8-1.25 % | "
            "outside: over typical, median=over typical, median | over worst, median | "
            "over worst, most | at most 1.25 of worst % =worst <= 1.25 %"
        ),
    ),
    "machine_gap/criteria": PageBlock("machine_gap", "blind study", format_criteria_table),
    "blind_gap/criteria": PageBlock("blind_gap", "blind study", format_criteria_table),
    "fuzz/cases": PageBlock(
        "fuzz",
        "hostile runs",
        make_column_writer(
            "cases | ok | refusal | failure | traceback | hang | memory | crash | "
            "silently wrong | unclear | damage",
            is_row_of_all_commands,
        ),
    ),
    "papers/counts": PageBlock("papers", "the two papers", describe_verdict_counts),
    "papers/items": PageBlock("papers", "the two papers", format_verdict_items),
    "algorithm_1/steps": PageBlock(
        "algorithm_1",
        "Algorithm 1",
        make_column_writer(
            "arm | way | start | step 1 | step 5 | step 10 | step 20",
            lambda row: row["way"] in ALGORITHM_1_VARIANTS,
        ),
    ),
    "warm_start/starts": PageBlock(
        "warm_start",
        "eq. 32",
        make_column_writer(
            "arm | eq. 32 | sum mm² | RMSE(φ) mm | c=c: largest over sqrt(ε) | minimax from there, "
            "RMSE(φ) mm | Algorithm 1 from there, as printed | with a line search"
        ),
    ),
    "relative/identified": PageBlock(
        "relative",
        "what is identifiable",
        make_column_writer(
            "measured | identified | rank by differences",
            lambda row: bool(row["robot"] == "IRB 2600"),
        ),
    ),
    "relative/stiff": PageBlock(
        "relative", "100 poses, 15 um, stiff", make_column_writer(RELATIVE_TABLE_COLUMNS)
    ),
    "relative/bending": PageBlock(
        "relative",
        "100 poses, 15 um, joints bend",
        make_column_writer(
            "robot | measured | held out mm=held out RMS mm | true mm=true position RMS mm"
        ),
    ),
    "relative/real": PageBlock("relative", "real arms", format_table_body),
    "one_session/halves": PageBlock(
        "one_session",
        "halves of one session",
        format_session_halves_table,
    ),
    "speed/ratios": PageBlock("speed", "the peer's time over ours", format_table_body),
    "speed/seconds": PageBlock("speed", "processor time", format_table_body),
    "speed/memory": PageBlock("speed", "peak memory", format_table_body),
}


# ---- files ---------------------------------------------------------------------------------------


def read_run_figures(run_name: str) -> dict[str, Any]:
    """What is kept of a run in docs/figures.  Raises OptionError."""
    path = DOCS_FIGURES_FOLDER / f"{run_name}.json"
    if not path.exists():
        raise OptionError(
            f"{path.relative_to(CHECKOUT_ROOT)} is not there: "
            f"python -m experiments pages --run {run_name}"
        )
    content: dict[str, Any] = json.loads(read_text(path))
    return content


def find_table_by_title(
    title: str, tables: Sequence[Mapping[str, Any]], run_name: str
) -> Mapping[str, Any]:
    """The table whose title begins so.  Raises OptionError."""
    for record in tables:
        if str(record["title"]).startswith(title):
            return record
    raise OptionError(
        f"run {run_name} has no table {title!r}: python -m experiments pages --run {run_name}"
    )


def format_block(block_name: str) -> str:
    """What stands between the comments of a block.  Raises OptionError."""
    if block_name not in PAGE_BLOCKS:
        raise OptionError(f"no block {block_name!r}; choose one of {', '.join(PAGE_BLOCKS)}")
    block = PAGE_BLOCKS[block_name]
    record = find_table_by_title(block.title, read_run_figures(block.run)["tables"], block.run)
    return block.write(table_from_json(record))


def format_run_provenance(run_names: Sequence[str]) -> str:
    """The command, version, commit and day of each run."""
    rows = []
    for run in run_names:
        made = read_run_figures(run)["made"]
        rows.append((f"`{made['command']}`", made["minimax-cal"], f"`{made['commit']}`",
                     made["date"]))  # fmt: skip
    return format_table_body(Table("", ("command", "version", "commit", "date"), tuple(rows)))


def rewrite_page_blocks(page_text: str) -> str:
    """A page with every block written again.  Raises OptionError."""
    names = [found[2] for found in FIGURE_BLOCK_PATTERN.finditer(page_text)]
    runs = list(dict.fromkeys(PAGE_BLOCKS[name].run for name in names if name in PAGE_BLOCKS))

    def write(found: re.Match[str]) -> str:
        name = found[2]
        shown = format_run_provenance(runs) if name == "made" else format_block(name)
        return f"{found[1]}\n{shown}\n\n{found[3]}"

    return FIGURE_BLOCK_PATTERN.sub(write, page_text)


def rewrite_pages() -> Iterator[Path]:
    """Rewrite the pages; yields those that changed.  Raises OptionError."""
    for name in PAGES_WITH_FIGURES:
        path = DOCS_FOLDER / f"{name}.md"
        text = read_text(path)
        if (new := rewrite_page_blocks(text)) != text:
            write_file_atomically(path, new)
            yield path


def run_study_for_pages(name: str, process_count: int) -> None:
    """Run a study as `PAGE_RUNS` says, and keep its tables and pictures.  Raises ClickException."""
    run = PAGE_RUNS[name]
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder)
        words = [sys.executable, "-m", *shlex.split(run.command), "--json", str(out / "run.json")]
        if words[2] == "experiments":
            words += ["--out", folder, "--jobs", str(process_count)]
        click.echo(f"== {run.command}", err=True)
        ended = subprocess.run(
            words, cwd=CHECKOUT_ROOT, stdout=subprocess.DEVNULL, check=False
        ).returncode
        if ended or not (out / "run.json").exists():
            raise click.ClickException(f"{run.command} ended with exit code {ended}")
        write_run_figures(name, json.loads(read_text(out / "run.json")))
        for picture, made in run.pictures.items():
            shutil.copy(out / f"{made}.png", DOCS_IMAGES_FOLDER / picture)


def write_run_figures(name: str, content: Mapping[str, Any]) -> None:
    """Write docs/figures/NAME.json: how the run was made, and the tables that pages show."""
    titles = dict.fromkeys(block.title for block in PAGE_BLOCKS.values() if block.run == name)
    tables = [find_table_by_title(title, content["tables"], name) for title in titles]
    DOCS_FIGURES_FOLDER.mkdir(exist_ok=True)
    write_json(DOCS_FIGURES_FOLDER / f"{name}.json", {"made": content["made"], "tables": tables})


@click.command("pages")
@click.option(
    "--run", "names", multiple=True, type=click.Choice([*PAGE_RUNS, "all"]),
    help="Run this study again first; may be repeated.",
)  # fmt: skip
@click.option("--jobs", type=int, default=-1, show_default=True, help="Processes; -1: one a core.")
def main(names: tuple[str, ...], jobs: int) -> None:
    """Rewrite the figures of the documentation's pages from docs/figures."""
    try:
        for name in PAGE_RUNS if "all" in names else dict.fromkeys(names):
            run_study_for_pages(name, jobs)
        for path in rewrite_pages():
            click.echo(f"wrote {path.relative_to(CHECKOUT_ROOT)}", err=True)
    except CalibrationError as error:
        click.echo(f"error: {error}", err=True)
        sys.exit(2)
