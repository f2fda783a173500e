"""The figures of the documentation's pages, written from what studies left in docs/figures.

    python -m experiments pages                  # rewrite the pages from docs/figures/*.json
    python -m experiments pages --run speed      # run a study again first; repeat --run, or "all"

A page has blocks between comments, each from the tables of one run; `RUNS` has the command of each
run, `BLOCKS` what is shown of its tables, and `made` the commands, versions and days of a page.
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

from experiments.algorithm_1 import WAYS
from experiments.record import ROOT, read_table, save_json
from minimax_cal.ground.errors import CalibrationError, OptionError
from minimax_cal.ground.files import read_text, write_whole
from minimax_cal.ground.tables import Table

DOCS = ROOT / "docs"
FIGURES, IMAGES = DOCS / "figures", DOCS / "images"
PAGES = ("solver_accuracy", "trust", "papers", "relative", "watch", "speed")
BLOCK = re.compile(r"(<!-- figures: ([\w/]+) -->\n).*?(<!-- end -->)", re.DOTALL)
NAN = "-"
MANY = 4  # claims that are not listed where all fail


@dataclass(frozen=True)
class Run:
    """A run whose figures pages show.

    command: words after ``python -m``, in the size that a page states.  pictures: file in
    docs/images: what the study calls it in its folder.
    """

    command: str
    pictures: Mapping[str, str]


RUNS = {
    "solver_accuracy": Run(
        "experiments solver_accuracy",
        {
            "subgradient.png": "subgradient",
            "profile_maros_meszaros.png": "profile_Maros-Meszaros",
        },
    ),
    "coverage": Run("experiments coverage --runs 100", {"coverage.png": "coverage"}),
    "external": Run("experiments external --arms irb120,fanuc_r2000,qkm_hl6 --halves 4", {}),
    "machine_gap": Run("experiments machine_gap --seed 7001 --every 16", {}),
    "blind_gap": Run(
        "experiments blind_gap --seed 2028 --every 60",
        {"blind_detectability.png": "blind_gap_detectability"},
    ),
    "fuzz": Run("tests.fuzz --cases 100 --seed 20261211", {}),
    "papers": Run(
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
    "algorithm_1": Run("experiments algorithm_1", {}),
    "warm_start": Run("experiments warm_start", {}),
    "relative": Run("experiments relative --seeds 8", {"relative.png": "relative"}),
    "one_session": Run(
        "experiments one_session --arms 24 --command compare --command check --command calibrate",
        {},
    ),
    "speed": Run("experiments speed", {}),
}


# ---- what a page shows of a table ----------------------------------------------------------------


@dataclass(frozen=True)
class Block:
    """A part of a page: of which run, the first words of a table's title, and its Markdown."""

    run: str
    title: str
    write: Callable[[Table], str]


def columns(
    text: str, keep: Callable[[dict[str, Any]], bool] | None = None
) -> Callable[[Table], str]:
    """Writes some columns of a table, and of its rows those that are kept.

    text: headers between bars, each as the page has it and, after "=", as the table has it.
    """
    pairs = [(shown.strip(), name.strip() or shown.strip()) for shown, _, name in
             (part.partition("=") for part in text.split("|"))]  # fmt: skip

    def write(table: Table) -> str:
        rows = [
            row
            for row in table.rows
            if keep is None or keep(dict(zip(table.header, row, strict=True)))
        ]
        chosen = [table.header.index(name) for _, name in pairs]
        some = replace(table, rows=tuple(rows)).only(*chosen)
        return body(replace(some, header=tuple(shown for shown, _ in pairs)))

    return write


def body(table: Table) -> str:
    """A table in Markdown, without its title."""
    return table.markdown().partition("\n\n")[2].rstrip()


# ---- QP backends ---------------------------------------------------------------------------------

DEFAULTS = "own defaults"


def backends(table: Table) -> str:
    """A row a backend: our two tolerances, and its own defaults beside them."""
    cells: dict[tuple[str, str], dict[str, str]] = {}
    for row in table.cells():
        named = dict(zip(table.header, row, strict=True))
        cells[named["backend"], named["setting"]] = named
    shown = (
        ("ours 1e-6", ("right %", "worst relative", "ms (shifted mean)")),
        ("ours 1e-9", ("right %",)),
        (DEFAULTS, ("right %", "wrongly claimed", "ms (shifted mean)")),
    )
    header = (
        "backend", "at 1e-6: right %", "worst relative", "ms", "at 1e-9: right %",
        "own defaults: right %", "wrongly claimed", "ms",
    )  # fmt: skip
    rows = [
        (
            name,
            *(cells.get((name, setting), {}).get(column, NAN)
              for setting, some in shown for column in some),
        )
        for name in dict.fromkeys(backend for backend, _ in cells)
    ]  # fmt: skip
    problems = table.rows[0][table.header.index("problems")]
    return f"{problems} problems.\n\n{right_aligned(header, rows)}"


def right_aligned(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A Markdown table of text whose columns after the first hold numbers."""
    lines = [header, ["---", *["---:"] * (len(header) - 1)], *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def reliability(table: Table) -> str:
    """What no backend, and which backends, get wrong with our settings and with their own."""
    records: list[dict[str, Any]] = [
        dict(zip(table.header, row, strict=True)) for row in table.rows
    ]
    short = [
        f"{r['backend']} {r['right %']:.1f} %"
        for r in records
        if r["setting"] == "ours 1e-6" and r["right %"] < 100.0
    ]
    lies = [r["backend"] for r in records if r["setting"] == DEFAULTS and r["wrongly claimed"]]
    claimed = sum(r["wrongly claimed"] for r in records if r["setting"] != DEFAULTS)
    return (
        f"Right on less than all at 1e-6: {', '.join(short) or 'none'}. Wrong answers called "
        f"solved: with our settings {claimed}; with their own defaults from "
        f"{', '.join(lies) or 'none'}."
    )


# ---- the papers ----------------------------------------------------------------------------------


def verdict_counts(table: Table) -> str:
    """How many items have which verdict."""
    found = Counter(str(row[table.header.index("verdict")]) for row in table.rows)
    return f"Of {len(table.rows)} items: " + ", ".join(f"{n} {v}" for v, n in found.items()) + "."


def items(table: Table) -> str:
    """The verdicts without their remarks; of claims that all failed it says so."""
    rows = []
    for row in table.rows:
        named = dict(zip(table.header, map(str, row), strict=True))
        claims = named["failed"].split("; ")
        many = len(claims) > MANY and not named["held"]
        failed = f"all {len(claims)}" if many else without_repeats(claims)
        arms = (re.sub(r", (real|simulated)", "", text) for text in (named["ours"], failed))
        verdict = ": ".join(filter(None, (named["claims"], named["verdict"])))
        rows.append((named["item"], named["paper"], *arms, verdict))
    header = ("item", "paper", "ours", "claims that failed", "claims that hold: verdict")
    return body(Table("", header, tuple(rows)))


def without_repeats(claims: Sequence[str]) -> str:
    """Claims in one line; the words that all of several end with are said once."""
    words = [claim.split() for claim in claims]
    ends = zip(*(one[:0:-1] for one in words), strict=False)
    same = len(list(takewhile(lambda column: len(set(column)) == 1, ends)))
    if len(words) == 1 or not same:
        return "; ".join(claims)
    starts = "; ".join(" ".join(one[:-same]).rstrip(":") for one in words)
    return f"{starts}: {' '.join(words[0][-same:])}"


def coverage(table: Table) -> str:
    """A row a case: sigmas from the scatter of the poses, and the worst parameter by noise."""
    cells = [dict(zip(table.header, row, strict=True)) for row in table.cells()]
    header = ("case", "runs", "all parameters %", "worst parameter %", "RMS error / sigma",
              "worst by noise alone %")  # fmt: skip
    rows = [
        (poses["case"], poses["runs"], poses["pooled %"], poses["least %"],
         poses["RMS error / sigma"], noise["least %"])
        for poses, noise in zip(cells[::2], cells[1::2], strict=True)
    ]  # fmt: skip
    return right_aligned(header, rows)


def criteria(table: Table) -> str:
    """The criteria of a blind study that have a limit; what is indented is a part of the above."""
    first = table.header.index("criterion")
    rows = [
        (str(row[first]).replace("  ", "of these: ", 1), *row[first + 1 :]) for row in table.rows
    ]
    return columns(
        "criterion | runs | found % =found | 95 % interval | limit | verdict",
        lambda row: bool(row["limit"]),
    )(with_interval(replace(table, rows=tuple(rows)), "low", "high"))


def with_interval(table: Table, low: str, high: str) -> Table:
    """One column more, of two others as text."""
    first, last = table.header.index(low), table.header.index(high)
    rows = [
        (*row, f"{cells[first]}-{cells[last]}")
        for row, cells in zip(table.rows, table.cells(), strict=True)
    ]
    return Table(table.title, (*table.header, "95 % interval"), tuple(rows), (*table.formats, ""))


def halves(table: Table) -> str:
    """The rates of halves of a session; of the other joint that is named without its interval."""
    some = replace(table.only(*range(8)), header=(*table.header[:5], "low", "high", "another %"))
    shown = "arms | cut by | command | cuts | right % | 95 % interval | another named % =another %"
    return columns(shown)(with_interval(some, "low", "high"))


def is_total(row: Mapping[str, Any]) -> bool:
    """Of all commands together."""
    return bool(row["command"] == "all")


RELATIVE = (
    "robot | measured | held out mm=held out RMS mm | nominal, true mm=true position, nominal "
    "RMS mm | true mm=true position RMS mm | expected mm=expected by sigmas mm | with the best "
    "scale mm=scaled, too: RMS mm"
)
BLOCKS = {
    "solver_accuracy/small": Block("solver_accuracy", "calibration, 6 rows:", backends),
    "solver_accuracy/small_words": Block("solver_accuracy", "calibration, 6 rows:", reliability),
    "solver_accuracy/large": Block("solver_accuracy", "calibration, 303 rows:", backends),
    "solver_accuracy/large_words": Block("solver_accuracy", "calibration, 303 rows:", reliability),
    "solver_accuracy/maros": Block("solver_accuracy", "Maros-Meszaros:", backends),
    "solver_accuracy/hard": Block("solver_accuracy", "hard:", backends),
    "solver_accuracy/cost": Block("solver_accuracy", "what solve costs", body),
    "solver_accuracy/subgradient": Block("solver_accuracy", "restarted averaged PDHG", body),
    "solver_accuracy/sqp": Block(
        "solver_accuracy",
        "minimax calibration",
        columns("backend | status | QPs | max F_i/m mm^2 | above the first | ms"),
    ),
    "coverage/parameters": Block(
        "coverage",
        "coverage of 95 % intervals of the identified",
        coverage,
    ),
    "coverage/held_out": Block(
        "coverage",
        "held-out accuracy",
        columns(
            "errors of | poses | runs | RMS % | largest %", lambda row: bool(row["poses"] == 20)
        ),
    ),
    "external/claims": Block(
        "external",
        "external over claimed",
        columns(
            "arm | way | inside: halves at 0.8-1.25 of the claim % =over within 0.8-1.25 % | "
            "outside: over typical, median=over typical, median | over worst, median | "
            "over worst, most | at most 1.25 of worst % =worst <= 1.25 %"
        ),
    ),
    "machine_gap/criteria": Block("machine_gap", "blind study", criteria),
    "blind_gap/criteria": Block("blind_gap", "blind study", criteria),
    "fuzz/cases": Block(
        "fuzz",
        "hostile runs",
        columns(
            "cases | ok | refusal | failure | traceback | hang | memory | crash | "
            "silently wrong | unclear | damage",
            is_total,
        ),
    ),
    "papers/counts": Block("papers", "the two papers", verdict_counts),
    "papers/items": Block("papers", "the two papers", items),
    "algorithm_1/steps": Block(
        "algorithm_1",
        "Algorithm 1",
        columns(
            "arm | way | start | step 1 | step 5 | step 10 | step 20",
            lambda row: row["way"] in WAYS,
        ),
    ),
    "warm_start/starts": Block(
        "warm_start",
        "eq. 32",
        columns(
            "arm | eq. 32 | sum mm² | RMSE(φ) mm | c=c: largest over sqrt(ε) | minimax from there, "
            "RMSE(φ) mm | Algorithm 1 from there, as printed | with a line search"
        ),
    ),
    "relative/identified": Block(
        "relative",
        "what is identifiable",
        columns(
            "measured | identified | rank by differences",
            lambda row: bool(row["robot"] == "IRB 2600"),
        ),
    ),
    "relative/stiff": Block("relative", "100 poses, 15 um, stiff", columns(RELATIVE)),
    "relative/bending": Block(
        "relative",
        "100 poses, 15 um, joints bend",
        columns("robot | measured | held out mm=held out RMS mm | true mm=true position RMS mm"),
    ),
    "relative/real": Block("relative", "real arms", body),
    "one_session/halves": Block(
        "one_session",
        "halves of one session",
        halves,
    ),
    "speed/ratios": Block("speed", "the peer's time over ours", body),
    "speed/seconds": Block("speed", "processor time", body),
    "speed/memory": Block("speed", "peak memory", body),
}


# ---- files ---------------------------------------------------------------------------------------


def figures_of(run: str) -> dict[str, Any]:
    """What is kept of a run in docs/figures.  Raises OptionError."""
    path = FIGURES / f"{run}.json"
    if not path.exists():
        raise OptionError(
            f"{path.relative_to(ROOT)} is not there: python -m experiments pages --run {run}"
        )
    content: dict[str, Any] = json.loads(read_text(path))
    return content


def table_with(title: str, tables: Sequence[Mapping[str, Any]], run: str) -> Mapping[str, Any]:
    """The table whose title begins so.  Raises OptionError."""
    for record in tables:
        if str(record["title"]).startswith(title):
            return record
    raise OptionError(f"run {run} has no table {title!r}: python -m experiments pages --run {run}")


def block_text(name: str) -> str:
    """What stands between the comments of a block.  Raises OptionError."""
    if name not in BLOCKS:
        raise OptionError(f"no block {name!r}; choose one of {', '.join(BLOCKS)}")
    block = BLOCKS[name]
    record = table_with(block.title, figures_of(block.run)["tables"], block.run)
    return block.write(read_table(record))


def made_text(runs: Sequence[str]) -> str:
    """The command, version, commit and day of each run."""
    rows = []
    for run in runs:
        made = figures_of(run)["made"]
        rows.append((f"`{made['command']}`", made["minimax-cal"], f"`{made['commit']}`",
                     made["date"]))  # fmt: skip
    return body(Table("", ("command", "version", "commit", "date"), tuple(rows)))


def written_page(text: str) -> str:
    """A page with every block written again.  Raises OptionError."""
    names = [found[2] for found in BLOCK.finditer(text)]
    runs = list(dict.fromkeys(BLOCKS[name].run for name in names if name in BLOCKS))

    def write(found: re.Match[str]) -> str:
        name = found[2]
        shown = made_text(runs) if name == "made" else block_text(name)
        return f"{found[1]}\n{shown}\n\n{found[3]}"

    return BLOCK.sub(write, text)


def write_pages() -> Iterator[Path]:
    """Rewrite the pages; yields those that changed.  Raises OptionError."""
    for name in PAGES:
        path = DOCS / f"{name}.md"
        text = read_text(path)
        if (new := written_page(text)) != text:
            write_whole(path, new)
            yield path


def run_study(name: str, jobs: int) -> None:
    """Run a study as `RUNS` says, and keep its tables and pictures.  Raises ClickException."""
    run = RUNS[name]
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder)
        words = [sys.executable, "-m", *shlex.split(run.command), "--json", str(out / "run.json")]
        if words[2] == "experiments":
            words += ["--out", folder, "--jobs", str(jobs)]
        click.echo(f"== {run.command}", err=True)
        ended = subprocess.run(words, cwd=ROOT, stdout=subprocess.DEVNULL, check=False).returncode
        if ended or not (out / "run.json").exists():
            raise click.ClickException(f"{run.command} ended with exit code {ended}")
        keep_figures(name, json.loads(read_text(out / "run.json")))
        for picture, made in run.pictures.items():
            shutil.copy(out / f"{made}.png", IMAGES / picture)


def keep_figures(name: str, content: Mapping[str, Any]) -> None:
    """Write docs/figures/NAME.json: how the run was made, and the tables that pages show."""
    titles = dict.fromkeys(block.title for block in BLOCKS.values() if block.run == name)
    tables = [table_with(title, content["tables"], name) for title in titles]
    FIGURES.mkdir(exist_ok=True)
    save_json(FIGURES / f"{name}.json", {"made": content["made"], "tables": tables})


@click.command("pages")
@click.option(
    "--run", "names", multiple=True, type=click.Choice([*RUNS, "all"]),
    help="Run this study again first; may be repeated.",
)  # fmt: skip
@click.option("--jobs", type=int, default=-1, show_default=True, help="Processes; -1: one a core.")
def main(names: tuple[str, ...], jobs: int) -> None:
    """Rewrite the figures of the documentation's pages from docs/figures."""
    try:
        for name in RUNS if "all" in names else dict.fromkeys(names):
            run_study(name, jobs)
        for path in write_pages():
            click.echo(f"wrote {path.relative_to(ROOT)}", err=True)
    except CalibrationError as error:
        click.echo(f"error: {error}", err=True)
        sys.exit(2)
