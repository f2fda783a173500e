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

from experiments.gap_cases import Cause, Sealed
from experiments.machines import INSIDE, MAKES, MECHANISMS, OUTSIDE, Asked, make, places
from experiments.resemblance import resemblance
from experiments.scoring import (
    Criterion,
    Row,
    answers,
    asked,
    blind_study,
    chosen,
    has,
    headline,
    is_right,
    misses,
    of,
    pairing,
    save,
    scored,
    share_of,
    verdict_is,
    verdicts,
)
from experiments.sweep import Study
from minimax_cal.ground.arrays import Array
from minimax_cal.ground.tables import Table

POWERS = (50.0, 100.0, 300.0, 1000.0, 5000.0)
CLEAR = (100.0, 300.0, 1000.0)
POSES, SHARES = (40, 60, 100, 200, 600), (0.15, 0.25, 0.35, 0.2, 0.05)
SPREADS = ("whole", "half", "clusters")
SEEN = 50.0 * (1.0 - 1e-6)  # lambda from which a cause must be seen
APART = 25.0  # lambda (own rho^2 - best other's) from which it must be told apart
WORSE = 1.05  # held-out RMS over that of geometry alone that is worse


@dataclass(frozen=True)
class Size:
    """How many runs of each condition; of each law, where there are laws."""

    sound: int = 400
    single: int = 12
    orders: int = 60
    outside: int = 12
    pair: int = 120
    triple: int = 60
    mechanism: int = 24


QUICK = Size(sound=40, single=3, orders=10, outside=3, pair=16, triple=8, mechanism=4)


def plan(seed: int, size: Size) -> list[Asked]:
    """All cases of the study; each has a seed of its own."""
    rng = np.random.default_rng(seed)
    cases = [some_asked(rng, "sound") for _ in range(size.sound)]
    for law in INSIDE:
        cases += [some_cases(rng, "single", (law,), POWERS) for _ in range(size.single)]
    cases += [some_cases(rng, "orders", ("gear_error/orders",), CLEAR) for _ in range(size.orders)]
    for law in OUTSIDE:
        cases += [some_cases(rng, "outside", (law,), (*CLEAR, 5000.0)) for _ in range(size.outside)]
    for condition, count, runs in (("pair", 2, size.pair), ("triple", 3, size.triple)):
        for _ in range(runs):
            effects = rng.choice(sorted({law.partition("/")[0] for law in INSIDE}), count, False)
            laws = [str(rng.choice([i for i in INSIDE if i.startswith(e)])) for e in effects]
            cases.append(some_cases(rng, condition, laws, CLEAR))
    for law in MECHANISMS:
        powers = (*CLEAR, 5000.0)
        cases += [some_cases(rng, "mechanism", (law,), powers) for _ in range(size.mechanism)]
    return [replace(case, seed=1_000_000 * seed + i) for i, case in enumerate(cases)]


def some_asked(rng: np.random.Generator, condition: str) -> Asked:
    """An arm under conditions drawn at random."""
    return Asked(
        robot=str(rng.choice(list(MAKES))),
        condition=condition,
        poses=int(rng.choice(POSES, p=SHARES)),
        spread=str(rng.choice(SPREADS, p=(0.5, 0.25, 0.25))),
        told=bool(rng.random() < 0.6),
        targets=int(rng.choice((1, 3), p=(0.2, 0.8))),
        off=bool(rng.random() < 0.25),
        oval=bool(rng.random() < 0.5),
        creep=bool(rng.random() < 0.2),
        jitter=float(rng.choice((3e-6, 6e-6, 12e-6))),
    )


def some_cases(
    rng: np.random.Generator, condition: str, laws: Sequence[str], powers: Sequence[float]
) -> Asked:
    """Some laws together at some of their places, on an arm that can have them all."""
    while True:
        asked = some_asked(rng, condition)
        rooms = [places(law, asked.robot, asked.targets) for law in laws]
        if all(rooms):
            break
    causes = [
        Cause(law, str(rng.choice(room)), float(rng.choice(powers)), int(rng.integers(2)))
        for law, room in zip(laws, rooms, strict=True)
    ]
    return replace(asked, causes=tuple(sorted(causes, key=lambda cause: -cause.power)))


# ---- one run -------------------------------------------------------------------------------------


def run(case: Asked) -> Row:
    """Make the files, let them be diagnosed, and score."""
    made = make(case)
    answer = asked(made)
    return score(case, made, answer.said, likeness(made)) | {"seconds": answer.seconds}


def score(case: Asked, made: Sealed, said: Row, alike: tuple[Array, Array]) -> Row:
    """What an answer is worth, as plain data.

    said: the JSON of a diagnosis.  alike: as `likeness` tells.
    """
    sets = answers(said)
    own, other = alike
    power = np.array(made.powers)
    there = {"outliers": case.off, "frame_drift": case.creep}  # and small, but no wrong names
    names = [options[0] for options in sets]
    beside = [name for name in names if name in made.truth or not there.get(name[0])]
    return scored(case, made, said, beside) | {
        "asked": [case.robot, case.poses, case.spread, case.targets,
                  *(word for word in ("told", "off", "oval", "creep") if getattr(case, word))],
        "lambda": float(power.min(initial=np.inf)),
        "telling": float((power * (own - other)).min(initial=np.inf)),
        "left": float((power * (1.0 - np.maximum(own, other))).min(initial=np.inf)),
        "tentative": [[str(e["effect"]), str(e["place"])] for e in said.get("effects", [])
                      if not e.get("established", True)],
        "in_sets": pairing(made.truth, sets) == len(made.truth),
    }  # fmt: skip


def likeness(made: Sealed) -> tuple[Array, Array]:
    """(c,) rho^2 of each cause's own law, and of the best other law."""
    own, other = np.zeros(len(made.truth)), np.zeros(len(made.truth))
    for i, (truth, part) in enumerate(zip(made.truth, made.parts, strict=True)):
        found = resemblance(made.robot, made.data, part)
        mine = [rho2 for name, rho2 in found.items() if is_right(name, truth)]
        rest = [rho2 for name, rho2 in found.items() if not is_right(name, truth)]
        own[i], other[i] = max(mine, default=0.0), max(rest, default=0.0)
    return own, other


# ---- criteria ------------------------------------------------------------------------------------


def told(row: Row) -> bool:
    """A verdict that names; or none, where every confirmed cause is minor."""
    minor = row["verdict"] == "none" and bool(row["names"])
    return row["verdict"] in ("named", "one_of") or minor


def right(row: Row) -> bool:
    """Every cause established and nothing else, in a verdict that names."""
    return bool(told(row) and row["all_right"])


def separable(row: Row) -> bool:
    """Each cause is seen and can be told from the best other law."""
    return bool(row["lambda"] >= SEEN and row["telling"] >= APART)


def criteria(rows: Sequence[Row]) -> list[Criterion]:
    """What the diagnosis is held to, and what is only shown."""
    sound = of(rows, "sound")
    plain, orders, pairs, triples = (
        list(filter(separable, of(rows, *conditions)))
        for conditions in (("single", "orders"), ("orders",), ("pair",), ("triple",))
    )
    missing = [row for row in of(rows, "outside", "mechanism") if row["left"] >= SEEN]
    mechanisms = [row for row in missing if row["condition"] == "mechanism"]

    named = has("names")
    return [
        Criterion("no fault: nothing confirmed, not unknown", "false alarm", sound,
                  lambda r: not named(r) and r["verdict"] != "unknown", 0.985),
        Criterion("  something confirmed", "", sound, named),
        Criterion("one cause, separable: right", "not right", plain, right, 0.95),
        Criterion("  a wrong cause confirmed", "", plain, has("strange")),
        Criterion("  right, but minor: verdict none", "", plain,
                  lambda r: right(r) and r["verdict"] == "none"),
        Criterion("  verdict unknown", "", plain, verdict_is("unknown")),
        Criterion("  two orders of one gear", "orders", orders, right, 0.95),
        Criterion("one cause, lambda >= 50: in the sets", "",
                  [r for r in of(rows, "single", "orders") if r["lambda"] >= SEEN],
                  has("in_sets")),
        Criterion("outside the library, lambda (1 - rho^2) >= 50: unknown or not repeatable",
                  "not unknown", missing,
                  verdict_is("unknown", "not_repeatable"), 0.80),
        Criterion("  of these mechanisms and memories", "", mechanisms,
                  verdict_is("unknown", "not_repeatable")),
        Criterion("  none", "outside, but none", missing, verdict_is("none"), 0.08, False),
        Criterion("  named for sure", "outside, but named", missing, verdict_is("named"), 0.08,
                  False),
        Criterion("two causes, separable: right", "pair", pairs, right, 0.90),
        Criterion("three causes, separable: right", "triple", triples, right, 0.80),
        Criterion("of all verdicts named, false", "false name",
                  [r for r in rows if r["verdict"] == "named"],
                  has("strange"), 0.06, False),
        Criterion("held-out RMS more than 5 % above geometry alone", "worse", rows,
                  lambda r: r["final_mm"] > WORSE * r["geometric_mm"], 0.005, False),
        Criterion("crashed", "crash", rows, verdict_is("error"), 0.0, False),
    ]  # fmt: skip


def per_law(rows: Sequence[Row]) -> Table:
    """Separable single causes by their law."""
    seen = list(filter(separable, of(rows, "single", "orders")))
    lines = []
    for law in INSIDE:
        own = [row for row in seen if row["laws"] == [law]]
        if own:
            wrong = Counter(":".join(n) for row in own for n in row["names"]
                            if row["strange"] and n not in row["truth"])  # fmt: skip
            lines.append((
                law, len(own), share_of(own, right),
                share_of(own, verdict_is("unknown")),
                share_of(own, has("strange")),
                ", ".join(name for name, _ in wrong.most_common(2)),
            ))  # fmt: skip
    return Table.made(
        "separable single causes [%]",
        lines,
        "law | runs d | right .1f | unknown .1f | a strange name .1f | most often",
    )


SPARSE = 40  # of the cases of --quick, each so many-th by itself


@blind_study("machine_gap")
def main(study: Study, only: tuple[str, ...], every: int | None) -> None:
    """Names on arms as shops have them."""
    cases = plan(study.seed, QUICK if study.quick else Size())
    rows = study.sweep(run, chosen(study, cases, only, every, SPARSE), "diagnoses")
    found = criteria(rows)
    missed = misses(found, lambda row: " ".join(map(str, row["asked"])), "geometric_mm")
    save(study, [headline(found), verdicts(rows), per_law(rows), missed], rows, {})
