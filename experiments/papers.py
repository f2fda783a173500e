"""The two papers, item by item: every table and figure, and one table of verdicts.

    python -m experiments papers [--quick] [--out FOLDER] [--json FILE] [--seed N] ...

Runs the studies that the papers need, each into a folder of its own, and writes verdicts.csv: item,
command, paper's figure, ours, verdict, remark.  A verdict follows from the figures of this run by
the rule that ends its remark; a quick run says "too few to say" where fewer than 20 cases are
behind it.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import replace
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
    sweep,
    verdicts_m,
    verdicts_s,
)
from experiments.sweep import Study, study_options
from experiments.verdicts import HEADER, HOLDS, MISSING, NO, Verdict, of_quick, table_of
from minimax_cal.ground.files import write_whole


def own(study: Study, name: str) -> Study:
    """The same options for one of the studies: its own kept parts, a folder of its own."""
    return replace(study, name=name, out=study.out / name, json=None)


def made_by(
    module: ModuleType, judged: Callable[[Any], Iterable[Verdict]]
) -> Callable[[Study], list[Verdict]]:
    """A study that finds (`study_of`) and saves, and the verdicts on what it found."""

    def make(study: Study) -> list[Verdict]:
        found = module.study_of(study)
        module.save(study, found)
        return list(judged(found))

    return make


def from_errata(study: Study) -> list[Verdict]:
    """Both papers as printed."""
    study.save([errata.table()], {})
    write_whole(study.out / "list.md", errata.page())
    count = len(errata.ERRATA)
    shown = sum(errata.stands(one) for one in errata.ERRATA)
    return [
        Verdict("S, M: the formulas as printed", "errata", f"{count} slips",
                f"{shown} shown by counter-example", HOLDS if shown == count else NO,
                "list with proofs: docs/errata.md")
    ]  # fmt: skip


STUDIES: dict[str, Callable[[Study], list[Verdict]]] = {
    "convergence": made_by(convergence, verdicts_s.table_2),
    "courses": made_by(courses, verdicts_s.courses),
    "any_base": made_by(any_base, verdicts_s.anywhere),
    "conditions": made_by(conditions, verdicts_m.conditions),
    "methods": made_by(methods, verdicts_m.tables_1_4),
    "splits": made_by(splits, verdicts_m.many_splits),
    "algorithm_1": made_by(algorithm_1, verdicts_m.to_the_letter),
    "errata": from_errata,
}


def study_of(study: Study) -> list[Verdict]:
    """All verdicts, paper S first."""
    found = {name: make(own(study, name)) for name, make in STUDIES.items()}
    verdicts = [
        *verdicts_s.model(),
        *found["convergence"],
        *found["courses"],
        *found["any_base"],
        *verdicts_s.own_cell(),
        *found["methods"],
        *found["conditions"],
        *found["splits"],
        *found["algorithm_1"],
        *verdicts_m.subproblems(study.quick),
        *verdicts_m.own_cell(),
        *found["errata"],
    ]
    return [of_quick(verdict) for verdict in verdicts] if study.quick else verdicts


@study_options("papers")
def main(study: Study) -> None:
    """Every table and figure of the two papers, and a table of verdicts."""
    verdicts = study_of(study)
    table = table_of(verdicts)
    content = {
        "verdicts": table.records(*HEADER),
        "count": dict(Counter(verdict.verdict for verdict in verdicts)),
        "not_covered": [verdict.remark for verdict in verdicts if verdict.verdict == MISSING],
    }
    study.save([table], content)
    write_whole(study.out / "verdicts.csv", table.csv())


if __name__ == "__main__":
    sweep.start(__file__)
