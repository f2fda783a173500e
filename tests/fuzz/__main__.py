"""Hostile runs of every command, and a table of how they ended.

python -m tests.fuzz --cases 10000 --seed 7          # the table; docs/trust.md has a last row
python -m tests.fuzz --seed 7 --only 4711            # one of them again, with its files
python -m tests.fuzz --each-option                   # every option with every odd value
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from collections import Counter
from contextlib import suppress
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from experiments.study_record import build_run_record, table_to_json, write_json
from minimax_cal.core.tables import Table

from .cases import EACH, case, each_option
from .running import GOOD, KINDS, Outcome, outcome, outcomes


def table_of(found: list[Outcome]) -> Table:
    """A row a command, a column a kind; the last row is of all."""
    count = Counter((each.command, each.kind) for each in found)
    commands = sorted({each.command for each in found})
    rows = [
        (name, sum(count[name, kind] for kind in KINDS), *(count[name, kind] for kind in KINDS))
        for name in commands
    ]
    total = ("all", len(found), *(sum(count[n, kind] for n in commands) for kind in KINDS))
    return Table.from_rows("hostile runs of every command", [*rows, total],
                      "command | cases d", *(f"{kind} d" for kind in KINDS))  # fmt: skip


def show(seed: int, number: int) -> None:
    """One case: what it is, its files in a folder, and how it ends."""
    one = case(seed, number)
    folder = Path(f"results/fuzz/{seed}-{number}")
    folder.mkdir(parents=True, exist_ok=True)
    for name, raw in one.files.items():
        (folder / name).write_bytes(raw)
    print(
        f"cd {folder}: {one.arguments}\nbroken: {one.broke}\nexpected: {one.expect or 'anything'}"
    )
    print(outcome(one))


def main() -> int:
    """Run them; 1 where something is none of GOOD."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--cases", type=int, help="default: 300, of --each-option all")
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", type=int)
    parser.add_argument("--json", type=Path, help="write the table here, for the pages")
    parser.add_argument("--each-option", dest="seed", action="store_const", const=EACH)
    chosen = parser.parse_args()
    whole = len(each_option()) - chosen.first if chosen.seed == EACH else 300
    count = whole if chosen.cases is None else chosen.cases
    if chosen.only is not None:
        show(chosen.seed, chosen.only)
        return 0
    began, found = time.perf_counter(), list[Outcome]()
    numbers = range(chosen.first, chosen.first + count)
    with suppress(KeyboardInterrupt):  # what was found until then
        for each in outcomes(chosen.seed, numbers):
            found.append(each)
            if each.kind not in GOOD:
                what = f"{each.kind}; {each.broke}; {each.detail}"
                print(f"{each.number} {each.command}: {what}", flush=True)
    table = table_of(found)
    print(table.markdown())
    if chosen.json:
        words = f"python -m tests.fuzz --cases {count} --seed {chosen.seed}"
        made = build_run_record(words)
        write_json(chosen.json, {"made": made, "tables": [table_to_json(table)]})
    slowest = max(found, key=lambda each: each.seconds)
    print(f"seed {chosen.seed}, {time.perf_counter() - began:.0f} s; the slowest took "
          f"{slowest.seconds:.1f} s ({slowest.number} {slowest.command})")  # fmt: skip
    return int(any(each.kind not in GOOD for each in found))


if __name__ == "__main__":
    sys.exit(main())
