"""The two papers, item by item: every table and figure, and one table of verdicts.

    python -m experiments papers [--quick] [--out FOLDER] [--json FILE] [--seed N] ...

Runs the studies that the papers need, each into a folder of its own, and writes verdicts.csv: item,
command, paper's figure, ours, verdict, remark, and which of its claims held and failed.  All hold:
reproduced; more than half: in part; else not.  A quick run says "too few to say" where fewer than
20 cases are behind it.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import replace
from functools import partial
from types import ModuleType
from typing import Any

from experiments import (
    algorithm_1,
    any_base,
    conditions,
    convergence,
    courses,
    errata,
    methods,
    splits,
    verdicts_m,
    verdicts_s,
    warm_start,
)
from experiments.sweep import Study, study_options
from experiments.verdicts import HEADER, MISSING, Verdict, table_of
from minimax_cal.ground.files import write_whole

Judged = Callable[[Any], Iterable[Verdict]]


def verdicts_of(
    study: Study, module: ModuleType, judged: Judged, **options: int
) -> Iterable[Verdict]:
    """Run one of the studies into a folder of its own, and judge what it found."""
    name = module.__name__.rpartition(".")[2]
    own = replace(study, name=name, out=study.out / name, json=None)
    found = module.study_of(own, **options)
    module.save(own, found)
    return judged(found)


def study_of(study: Study, every: int = 1) -> list[Verdict]:
    """All verdicts, paper S first.  every: of the starts of Table 2."""
    of = partial(verdicts_of, study)
    verdicts = [
        *verdicts_s.model(),
        *of(convergence, verdicts_s.table_2, every=every),
        *of(courses, verdicts_s.courses),
        *of(any_base, verdicts_s.anywhere),
        *verdicts_s.own_cell(),
        *of(methods, verdicts_m.tables_1_4),
        *of(conditions, verdicts_m.conditions),
        *of(splits, verdicts_m.many_splits),
        *of(warm_start, verdicts_m.warm_starts),
        *of(algorithm_1, verdicts_m.to_the_letter),
        *verdicts_m.subproblems(study.quick),
        *verdicts_m.own_cell(),
        *of(errata, verdicts_m.slips),
    ]
    return [replace(verdict, quick=study.quick) for verdict in verdicts]


@study_options("papers")
@convergence.every_start
def main(study: Study, every: int) -> None:
    """Every table and figure of the two papers, and a table of verdicts."""
    verdicts = study_of(study, every)
    table = table_of(verdicts)
    content = {
        "verdicts": table.records(*HEADER),
        "count": dict(Counter(verdict.verdict for verdict in verdicts)),
        "not_covered": [verdict.remark for verdict in verdicts if verdict.verdict == MISSING],
    }
    study.save([table], content)
    write_whole(study.out / "verdicts.csv", table.csv())
