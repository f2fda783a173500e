"""Are causes identified correctly on arms as shops have them?  Blind, under harder conditions.

    python -m experiments.machine_gap [--quick] [--out FOLDER] [--json FILE] [--seed N] [--jobs N]
        [--only CONDITION]... [--every N]

`machines` makes the arms; the diagnosis sees a robot file and a CSV.  Only confirmed
causes count; possible ones do not change the verdict.  Separable is a cause with lambda >= 50 of
which its own law explains so much more than the best other that 25 of lambda distinguish them.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from experiments.gap_cases import GapCause, SealedArm
from experiments.machines import (
    INSIDE_MACHINE_LAWS,
    MACHINE_MAKES,
    MECHANISM_LAWS,
    OUTSIDE_MACHINE_LAWS,
    MachineCase,
    build_and_measure_arm,
    list_law_places,
)
from experiments.resemblance import effect_similarities
from experiments.scoring import (
    Row,
    StudyCriterion,
    blind_study_command,
    build_criteria_table,
    build_misses_table,
    build_verdict_table,
    count_matched_truths,
    diagnose_sealed_arm,
    is_name_right,
    list_confirmed_causes,
    make_key_test,
    make_verdict_test,
    percentage_of_rows,
    save_blind_results,
    score_common_fields,
    select_cases,
    select_conditions,
)
from experiments.sweep import Study
from minimax_cal.core.arrays import Array
from minimax_cal.core.tables import Table

MACHINE_DETECTABILITY_LEVELS = (50.0, 100.0, 300.0, 1000.0, 5000.0)
CLEAR_MACHINE_LEVELS = (100.0, 300.0, 1000.0)
POSE_COUNT_CHOICES, POSE_COUNT_PROBABILITIES = (
    (40, 60, 100, 200, 600),
    (0.15, 0.25, 0.35, 0.2, 0.05),
)
POSE_SPREADS = ("whole", "half", "clusters")
MIN_SEEN_DETECTABILITY = 50.0 * (1.0 - 1e-6)  # lambda from which a cause must be seen
MIN_SEPARATING_DETECTABILITY = (
    25.0  # lambda (own rho^2 - best other's) from which it must be told apart
)
MAX_RATIO_TO_GEOMETRY = 1.05  # held-out RMS over that of geometry alone that is worse


@dataclass(frozen=True)
class MachineStudySize:
    """How many runs of each condition; of each law, where there are laws."""

    sound: int = 400
    single: int = 12
    orders: int = 60
    outside: int = 12
    pair: int = 120
    triple: int = 60
    mechanism: int = 24


QUICK_MACHINE_STUDY_SIZE = MachineStudySize(
    sound=40, single=3, orders=10, outside=3, pair=16, triple=8, mechanism=4
)


def draw_all_cases(seed: int, size: MachineStudySize) -> list[MachineCase]:
    """All cases of the study; each has a seed of its own."""
    rng = np.random.default_rng(seed)
    cases = [draw_case(rng, "sound") for _ in range(size.sound)]
    for law in INSIDE_MACHINE_LAWS:
        cases += [
            draw_case_with_laws(rng, "single", (law,), MACHINE_DETECTABILITY_LEVELS)
            for _ in range(size.single)
        ]
    cases += [
        draw_case_with_laws(rng, "orders", ("gear_error/orders",), CLEAR_MACHINE_LEVELS)
        for _ in range(size.orders)
    ]
    for law in OUTSIDE_MACHINE_LAWS:
        cases += [
            draw_case_with_laws(rng, "outside", (law,), (*CLEAR_MACHINE_LEVELS, 5000.0))
            for _ in range(size.outside)
        ]
    for condition, count, runs in (("pair", 2, size.pair), ("triple", 3, size.triple)):
        for _ in range(runs):
            effects = rng.choice(
                sorted({law.partition("/")[0] for law in INSIDE_MACHINE_LAWS}), count, False
            )
            laws = [
                str(rng.choice([i for i in INSIDE_MACHINE_LAWS if i.startswith(e)]))
                for e in effects
            ]
            cases.append(draw_case_with_laws(rng, condition, laws, CLEAR_MACHINE_LEVELS))
    for law in MECHANISM_LAWS:
        powers = (*CLEAR_MACHINE_LEVELS, 5000.0)
        cases += [
            draw_case_with_laws(rng, "mechanism", (law,), powers) for _ in range(size.mechanism)
        ]
    return [replace(case, seed=1_000_000 * seed + i) for i, case in enumerate(cases)]


def draw_case(rng: np.random.Generator, condition: str) -> MachineCase:
    """An arm under conditions drawn at random."""
    return MachineCase(
        robot=str(rng.choice(list(MACHINE_MAKES))),
        condition=condition,
        poses=int(rng.choice(POSE_COUNT_CHOICES, p=POSE_COUNT_PROBABILITIES)),
        spread=str(rng.choice(POSE_SPREADS, p=(0.5, 0.25, 0.25))),
        told=bool(rng.random() < 0.6),
        targets=int(rng.choice((1, 3), p=(0.2, 0.8))),
        off=bool(rng.random() < 0.25),
        oval=bool(rng.random() < 0.5),
        creep=bool(rng.random() < 0.2),
        jitter=float(rng.choice((3e-6, 6e-6, 12e-6))),
    )


def draw_case_with_laws(
    rng: np.random.Generator, condition: str, laws: Sequence[str], powers: Sequence[float]
) -> MachineCase:
    """Some laws together at some of their places, on an arm that can have them all."""
    while True:
        asked = draw_case(rng, condition)
        rooms = [list_law_places(law, asked.robot, asked.targets) for law in laws]
        if all(rooms):
            break
    causes = [
        GapCause(law, str(rng.choice(room)), float(rng.choice(powers)), int(rng.integers(2)))
        for law, room in zip(laws, rooms, strict=True)
    ]
    return replace(asked, causes=tuple(sorted(causes, key=lambda cause: -cause.power)))


# ---- one run -------------------------------------------------------------------------------------


def run_case(case: MachineCase) -> Row:
    """Make the files, let them be diagnosed, and score."""
    made = build_and_measure_arm(case)
    answer = diagnose_sealed_arm(made)
    return score_answer(case, made, answer.said, cause_similarities(made)) | {
        "seconds": answer.seconds
    }


def score_answer(
    case: MachineCase, made: SealedArm, diagnosis_json: Row, similarities: tuple[Array, Array]
) -> Row:
    """What an answer is worth, as plain data.

    diagnosis_json: the JSON of a diagnosis.  similarities: as `cause_similarities` tells.
    """
    sets = list_confirmed_causes(diagnosis_json)
    own, other = similarities
    power = np.array(made.powers)
    there = {"outliers": case.off, "frame_drift": case.creep}  # and small, but no wrong names
    names = [options[0] for options in sets]
    beside = [name for name in names if name in made.truth or not there.get(name[0])]
    return score_common_fields(case, made, diagnosis_json, beside) | {
        "asked": [case.robot, case.poses, case.spread, case.targets,
                  *(word for word in ("told", "off", "oval", "creep") if getattr(case, word))],
        "lambda": float(power.min(initial=np.inf)),
        "telling": float((power * (own - other)).min(initial=np.inf)),
        "left": float((power * (1.0 - np.maximum(own, other))).min(initial=np.inf)),
        "tentative": [[str(e["effect"]), str(e["place"])] for e in diagnosis_json.get("effects", [])
                      if not e.get("established", True)],
        "in_sets": count_matched_truths(made.truth, sets) == len(made.truth),
    }  # fmt: skip


def cause_similarities(sealed_arm: SealedArm) -> tuple[Array, Array]:
    """(c,) rho^2 of each cause's own law, and of the best other law."""
    own, other = np.zeros(len(sealed_arm.truth)), np.zeros(len(sealed_arm.truth))
    for i, (truth, part) in enumerate(zip(sealed_arm.truth, sealed_arm.parts, strict=True)):
        found = effect_similarities(sealed_arm.robot, sealed_arm.data, part)
        mine = [rho2 for name, rho2 in found.items() if is_name_right(name, truth)]
        rest = [rho2 for name, rho2 in found.items() if not is_name_right(name, truth)]
        own[i], other[i] = max(mine, default=0.0), max(rest, default=0.0)
    return own, other


# ---- criteria ------------------------------------------------------------------------------------


def names_a_cause(row: Row) -> bool:
    """A verdict that names; or none, where every confirmed cause is minor."""
    minor = row["verdict"] == "none" and bool(row["names"])
    return row["verdict"] in ("named", "one_of") or minor


def is_answer_right(row: Row) -> bool:
    """Every cause established and nothing else, in a verdict that names."""
    return bool(names_a_cause(row) and row["all_right"])


def is_separable(row: Row) -> bool:
    """Each cause is seen and can be told from the best other law."""
    return bool(
        row["lambda"] >= MIN_SEEN_DETECTABILITY and row["telling"] >= MIN_SEPARATING_DETECTABILITY
    )


def build_machine_criteria(rows: Sequence[Row]) -> list[StudyCriterion]:
    """What the diagnosis is held to, and what is only shown."""
    sound = select_conditions(rows, "sound")
    plain, orders, pairs, triples = (
        list(filter(is_separable, select_conditions(rows, *conditions)))
        for conditions in (("single", "orders"), ("orders",), ("pair",), ("triple",))
    )
    missing = [
        row
        for row in select_conditions(rows, "outside", "mechanism")
        if row["left"] >= MIN_SEEN_DETECTABILITY
    ]
    mechanisms = [row for row in missing if row["condition"] == "mechanism"]

    named = make_key_test("names")
    return [
        StudyCriterion(
            "no fault: nothing confirmed, not unknown",
            "false alarm",
            sound,
            lambda r: not named(r) and r["verdict"] != "unknown",
            0.985,
        ),
        StudyCriterion("  something confirmed", "", sound, named),
        StudyCriterion("one cause, separable: right", "not right", plain, is_answer_right, 0.95),
        StudyCriterion("  a wrong cause confirmed", "", plain, make_key_test("strange")),
        StudyCriterion(
            "  right, but minor: verdict none",
            "",
            plain,
            lambda r: is_answer_right(r) and r["verdict"] == "none",
        ),
        StudyCriterion("  verdict unknown", "", plain, make_verdict_test("unknown")),
        StudyCriterion("  two orders of one gear", "orders", orders, is_answer_right, 0.95),
        StudyCriterion(
            "one cause, lambda >= 50: in the sets",
            "",
            [
                r
                for r in select_conditions(rows, "single", "orders")
                if r["lambda"] >= MIN_SEEN_DETECTABILITY
            ],
            make_key_test("in_sets"),
        ),
        StudyCriterion(
            "outside the library, lambda (1 - rho^2) >= 50: unknown or not repeatable",
            "not unknown",
            missing,
            make_verdict_test("unknown", "not_repeatable"),
            0.80,
        ),
        StudyCriterion(
            "  of these mechanisms and memories",
            "",
            mechanisms,
            make_verdict_test("unknown", "not_repeatable"),
        ),
        StudyCriterion(
            "  none", "outside, but none", missing, make_verdict_test("none"), 0.08, False
        ),
        StudyCriterion(
            "  named for sure",
            "outside, but named",
            missing,
            make_verdict_test("named"),
            0.08,
            False,
        ),
        StudyCriterion("two causes, separable: right", "pair", pairs, is_answer_right, 0.90),
        StudyCriterion("three causes, separable: right", "triple", triples, is_answer_right, 0.80),
        StudyCriterion(
            "of all verdicts named, false",
            "false name",
            [r for r in rows if r["verdict"] == "named"],
            make_key_test("strange"),
            0.06,
            False,
        ),
        StudyCriterion(
            "held-out RMS more than 5 % above geometry alone",
            "worse",
            rows,
            lambda r: r["final_mm"] > MAX_RATIO_TO_GEOMETRY * r["geometric_mm"],
            0.005,
            False,
        ),
        StudyCriterion("crashed", "crash", rows, make_verdict_test("error"), 0.0, False),
    ]


def build_law_table(rows: Sequence[Row]) -> Table:
    """Separable single causes by their law."""
    seen = list(filter(is_separable, select_conditions(rows, "single", "orders")))
    lines = []
    for law in INSIDE_MACHINE_LAWS:
        own = [row for row in seen if row["laws"] == [law]]
        if own:
            wrong = Counter(":".join(n) for row in own for n in row["names"]
                            if row["strange"] and n not in row["truth"])  # fmt: skip
            lines.append((
                law, len(own), percentage_of_rows(own, is_answer_right),
                percentage_of_rows(own, make_verdict_test("unknown")),
                percentage_of_rows(own, make_key_test("strange")),
                ", ".join(name for name, _ in wrong.most_common(2)),
            ))  # fmt: skip
    return Table.from_rows(
        "separable single causes [%]",
        lines,
        "law | runs d | right .1f | unknown .1f | a strange name .1f | most often",
    )


QUICK_MACHINE_CASE_STRIDE = 40  # of the cases of --quick, each so many-th by itself


@blind_study_command("machine_gap")
def main(study: Study, only: tuple[str, ...], every: int | None) -> None:
    """Names on arms as shops have them."""
    cases = draw_all_cases(
        study.seed, QUICK_MACHINE_STUDY_SIZE if study.quick else MachineStudySize()
    )
    rows = study.sweep(
        run_case, select_cases(study, cases, only, every, QUICK_MACHINE_CASE_STRIDE), "diagnoses"
    )
    found = build_machine_criteria(rows)
    missed = build_misses_table(found, lambda row: " ".join(map(str, row["asked"])), "geometric_mm")
    save_blind_results(
        study,
        [build_criteria_table(found), build_verdict_table(rows), build_law_table(rows), missed],
        rows,
        {},
    )
