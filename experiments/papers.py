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
from experiments.verdicts import (
    NOT_COVERED_VERDICT,
    VERDICT_COLUMNS,
    PaperVerdict,
    build_verdicts_table,
)
from minimax_cal.core.files import write_file_atomically

JudgeResults = Callable[[Any], Iterable[PaperVerdict]]


def run_and_judge_study(
    study: Study, module: ModuleType, judge_results: JudgeResults, **options: int
) -> Iterable[PaperVerdict]:
    """Run one of the studies into a folder of its own, and judge what it found."""
    name = module.__name__.rpartition(".")[2]
    own = replace(study, name=name, out=study.out / name, json=None)
    found = module.run_all_cases(own, **options)
    module.save_results(own, found)
    return judge_results(found)


def collect_all_verdicts(study: Study, stride: int = 1) -> list[PaperVerdict]:
    """All verdicts, paper S first.  stride: of the starts of Table 2."""
    of = partial(run_and_judge_study, study)
    verdicts = [
        *verdicts_s.judge_model_equations(),
        *of(convergence, verdicts_s.judge_table_2, stride=stride),
        *of(courses, verdicts_s.judge_courses),
        *of(any_base, verdicts_s.judge_any_base),
        *verdicts_s.list_uncovered_items(),
        *of(methods, verdicts_m.judge_tables_1_and_4),
        *of(conditions, verdicts_m.judge_conditions),
        *of(splits, verdicts_m.judge_splits),
        *of(warm_start, verdicts_m.judge_warm_starts),
        *of(algorithm_1, verdicts_m.judge_algorithm_1),
        *verdicts_m.judge_subgradient_method(study.quick),
        *verdicts_m.list_uncovered_items(),
        *of(errata, verdicts_m.judge_errata),
    ]
    return [replace(verdict, quick=study.quick) for verdict in verdicts]


@study_options("papers")
@convergence.stride_option
def main(study: Study, every: int) -> None:
    """Every table and figure of the two papers, and a table of verdicts."""
    verdicts = collect_all_verdicts(study, every)
    table = build_verdicts_table(verdicts)
    content = {
        "verdicts": table.to_records(*VERDICT_COLUMNS),
        "count": dict(Counter(verdict.verdict for verdict in verdicts)),
        "not_covered": [
            verdict.remark for verdict in verdicts if verdict.verdict == NOT_COVERED_VERDICT
        ],
    }
    study.save([table], content)
    write_file_atomically(study.out / "verdicts.csv", table.csv())
