"""Does `diagnose` tell the truth?  Blind: it sees files, the truth is sealed until it has answered.

    python -m experiments.blind_gap [--quick] [--out FOLDER] [--json FILE] [--seed N] [--jobs N] ...
        [--only CONDITION]... [--every N]

`gap_cases` makes arms with known faults by laws of its own, finite and evaluated with the true
geometry and true masses; the robot file that the diagnosis is given is 15 % off.  Conditions: no
effect at all; each effect alone from invisible to plain; few and many poses; other repeatability
and noise than usual; two and three effects; a background of small ones; effects that no library
holds; the true effect deleted from the library; known causes with distorted laws; data faults.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any, Protocol, TypeVar

import click
import numpy as np

import minimax_cal as mc
from experiments import gap_cases, sweep
from experiments.gap_cases import (
    ARMS,
    DISTORTED,
    EFFECTS,
    FAULTS,
    OUTSIDE,
    Case,
    Cause,
    Truth,
    make,
    open_seal,
    places,
    spec,
    write,
)
from experiments.record import canvas, interval
from experiments.sweep import Study, study_options
from minimax_cal.diagnosing.diagnose import resemblance
from minimax_cal.ground.arrays import Array
from minimax_cal.ground.errors import OptionError
from minimax_cal.ground.tables import Cell, Table

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Row = dict[str, Any]
Name = tuple[str, str]  # effect, place

POWERS = (5.0, 15.0, 30.0, 50.0, 100.0, 300.0, 1000.0, 5000.0)  # detectability lambda
CLEAR = (100.0, 300.0, 1000.0)
LIBRARY = tuple(effect for effect in EFFECTS if effect not in FAULTS)
ALONE = ("single", "poses", "rough")  # conditions with one effect of the library
FITTED = (*ALONE, "pair", "triple")  # conditions that the oracle can fit
VISIBLE = 50.0 * (1.0 - 1e-6)  # lambda from which an effect must be seen
SEPARABLE = 25.0  # lambda (1 - rho^2) from which it must be told from its nearest rival
CLOSE = 1.06  # held-out RMS over the oracle's that is good enough
MOST_MISSES, MISSES_EACH = 40, 8
MAP = "joint_error_map"  # that a joint errs by its angle, which is true of these laws:
OF_ANGLE = ("gear_error", "gear_ripple", "encoder_gain")
NO_ANSWER = ("none", "unknown", "not_repeatable", "error")


# ---- the cases -----------------------------------------------------------------------------------


@dataclass(frozen=True)
class Size:
    """How many runs of each condition, per effect and power where there are those."""

    none: int = 300
    none_rough: int = 40
    single: int = 12
    poses: int = 3
    rough: int = 3
    pair: int = 300
    triple: int = 150
    background: int = 150
    outside: int = 12
    deleted: int = 6
    wrong_law: int = 16
    fault: int = 30
    powers: tuple[float, ...] = POWERS
    clear: tuple[float, ...] = CLEAR
    beyond: tuple[float, ...] = (*CLEAR, 5000.0)
    removed: tuple[str, ...] = LIBRARY


QUICK = Size(
    none=8, none_rough=0, single=1, poses=0, rough=0, pair=3, triple=1, background=1, outside=1,
    deleted=1, wrong_law=1, fault=1, powers=(300.0,), clear=(1000.0,), beyond=(1000.0,),
    removed=("joint_compliance", "gear_error", "backlash"),
)  # fmt: skip

ROUGH: tuple[dict[str, float], ...] = ({"jitter": 0.0}, {"jitter": 20e-6}, {"noise": 2.0})


def plan(seed: int, size: Size) -> list[Case]:
    """All cases of the study; each has a seed of its own."""
    rng = np.random.default_rng(seed)
    cases = [Case(some_robot(rng), "none") for _ in range(size.none)]
    for _ in range(size.none_rough):
        robot = some_robot(rng)
        cases += [replace(Case(robot, "none"), **rough) for rough in ROUGH]  # type: ignore[arg-type]
        cases += [Case(robot, "none", poses=poses) for poses in (60, 200)]
    for effect in LIBRARY:
        for power in size.powers:
            cases += several(rng, "single", effect, power, size.single)
        for poses in (60, 200):
            for power in (50.0, 300.0):
                cases += several(rng, "poses", effect, power, size.poses, poses=poses)
        for rough in ROUGH:
            cases += several(rng, "rough", effect, 300.0, size.rough, **rough)
    for effect in size.removed:
        for power in size.clear:
            cases += several(rng, "deleted", effect, power, size.deleted, delete=(effect,))
    cases += [together(rng, "pair", 2, size.clear) for _ in range(size.pair)]
    cases += [together(rng, "triple", 3, size.clear) for _ in range(size.triple)]
    cases += [
        replace(together(rng, "background", 1, size.clear), background=10.0)
        for _ in range(size.background)
    ]
    for law in OUTSIDE:
        for power in size.beyond:
            cases += several(rng, "outside", law, power, size.outside)
    for law in DISTORTED:
        for power in size.clear:
            cases += several(rng, "wrong_law", law, power, size.wrong_law)
    for law in FAULTS:
        cases += several(rng, "fault", law, 1.0, size.fault)
    return [replace(case, seed=1_000_000 * seed + i) for i, case in enumerate(cases)]


def some_robot(rng: np.random.Generator) -> str:
    """Two arms of three are the first."""
    return str(rng.choice(list(ARMS), p=(2 / 3, 1 / 3)))


def some_cause(rng: np.random.Generator, robot: str, law: str, power: float) -> Cause:
    """A law at one of its places on the robot."""
    return Cause(law, str(rng.choice(places(law, robot))), power, int(rng.integers(2)))


def several(
    rng: np.random.Generator, condition: str, law: str, power: float, count: int, **options: Any
) -> list[Case]:
    """Cases of one law, on robots that can have it."""
    out = []
    for _ in range(count):
        robot = some_robot(rng)
        robot = robot if places(law, robot) else next(r for r in ARMS if places(law, r))
        out.append(Case(robot, condition, (some_cause(rng, robot, law, power),), **options))
    return out


def together(rng: np.random.Generator, condition: str, count: int, powers: Sequence[float]) -> Case:
    """Different effects at once, each of a power of its own, the largest first."""
    robot = some_robot(rng)
    chosen = rng.choice([e for e in LIBRARY if places(e, robot)], count, replace=False)
    causes = [some_cause(rng, robot, str(e), float(rng.choice(powers))) for e in chosen]
    causes.sort(key=lambda cause: -cause.power)
    return Case(robot, condition, tuple(causes))


# ---- one run -------------------------------------------------------------------------------------


def run(case: Case) -> Row:
    """Make the files, let them be diagnosed, then open the seal and score."""
    with TemporaryDirectory() as name:
        folder = Path(name)
        write(make(case), folder)
        said, seconds = diagnosis(folder, case)
        truth = open_seal(folder)
        robot = mc.load_robot(folder / gap_cases.ROBOT)
        data = mc.read_measurements(folder / gap_cases.DATA)
    row = score(case, truth, said) | {"seconds": seconds}
    try:
        return row | rivals(case, truth, robot, data) | oracle(case, truth, robot, data)
    except Exception as error:  # the judge's trouble is shown, and costs no other run
        return row | {"trouble": f"{type(error).__name__}: {error}"}


def diagnosis(folder: Path, case: Case) -> tuple[Row, float]:
    """What `diagnose` makes of the files, as its JSON, and its time [s]."""
    began = time.perf_counter()
    try:
        found = mc.diagnose(
            folder / gap_cases.ROBOT,
            folder / gap_cases.DATA,
            seed=case.seed,
            exclude=case.delete,
            quick=True,  # what is claimed of other poses is not asked here
        )
        said: Row = found.to_dict()
    except Exception as error:  # a crash is an answer too, and a bad one
        said = {"verdict": "error", "trouble": f"{type(error).__name__}: {error}"}
    return said, time.perf_counter() - began


def rivals(case: Case, truth: Truth, robot: mc.Robot, data: mc.Measurements) -> Row:
    """How alike the nearest rival in the library is to each cause (of the least telling first)."""
    if case.condition in ("none", "fault"):
        return {}
    found = []
    for name, power, part in zip(truth.truth, truth.powers, truth.parts, strict=True):
        alike = resemblance(robot, data, part)
        alike = {other: rho2 for other, rho2 in alike.items() if other[0] not in case.delete}
        rival, rho2 = nearest(name, alike)
        found.append((power * (1.0 - rho2), rho2, rival))
    telling, rho2, rival = min(found)
    return {"telling": telling, "rho2": rho2, "rival": list(rival)}


def nearest(truth: Name, alike: dict[Name, float]) -> tuple[Name, float]:
    """The candidate that is most like the truth and is not the truth, and its rho^2."""
    others = {
        name: rho2
        for name, rho2 in alike.items()
        if np.isfinite(rho2) and match(name, truth) not in ("exact", "broad")
    }
    best = max(others, key=lambda name: others[name], default=("", ""))
    return best, float(min(1.0, others.get(best, 0.0)))


def oracle(case: Case, truth: Truth, robot: mc.Robot, data: mc.Measurements) -> Row:
    """Held-out RMS [mm] of calibrations that know: the effects' names, or even their motion.

    The first is fitted with the library's laws of the true effects, and as good as those are; the
    second to points from which the true displacement is taken out, whatever any library holds.
    """
    if case.condition not in FITTED:
        return {}
    effects = [spec(case.robot, cause) for cause in case.causes]
    freed = data.with_y(data.y - np.moveaxis(truth.displacement, 0, 1))
    told = mc.calibrate(robot, data, objective="sum", effects=effects)
    known = mc.calibrate(robot, freed, objective="sum")
    return {
        "oracle_mm": told.accuracy["holdout"].rms_mm,
        "known_mm": known.accuracy["holdout"].rms_mm,
    }


# ---- scoring an answer ---------------------------------------------------------------------------


def match(said: Name, truth: Name) -> str:
    """exact; broad (one joint for all, or all for one); place (another); or wrong."""
    if said[0] != truth[0]:
        return "wrong"
    if said[1] == truth[1] or truth[0] in FAULTS:
        return "exact"
    return "broad" if "all" in (said[1], truth[1]) else "place"


def is_right(said: Name, truth: Name) -> bool:
    """Effect and place agree, where all joints and one of them agree too."""
    return match(said, truth) in ("exact", "broad")


def pairing(truth: Sequence[Name], sets: Sequence[Sequence[Name]]) -> int:
    """How many truths find an answer of their own: the largest matching."""
    if not truth:
        return 0
    first, rest = truth[0], truth[1:]
    best = pairing(rest, sets)
    for i, options in enumerate(sets):
        if any(is_right(name, first) for name in options):
            best = max(best, 1 + pairing(rest, [*sets[:i], *sets[i + 1 :]]))
    return best


def answers(said: Row) -> list[list[Name]]:
    """Each confirmed cause of a diagnosis, before its alternatives."""
    sure = [effect for effect in said.get("effects", []) if effect.get("established", True)]
    return [
        [(str(e["effect"]), str(e["place"])) for e in (one, *one.get("alternatives", []))]
        for one in sure
    ]


def score(case: Case, truth: Truth, said: Row) -> Row:
    """What an answer is worth, as plain data.  said: the JSON of a diagnosis."""
    sets = answers(said)
    names = [options[0] for options in sets]
    main = truth.truth[0] if truth.truth else ("", "")
    gap = said.get("gap", {})
    count = len(truth.truth)
    known = (*truth.truth, *truth.background)
    return {
        "condition": case.condition,
        "robot": case.robot,
        "poses": case.poses,
        "jitter": case.jitter,
        "noise": case.noise,
        "seed": case.seed,
        "asked": max((cause.power for cause in case.causes), default=0.0),
        "laws": [cause.law for cause in case.causes],
        "truth": [list(name) for name in truth.truth],
        "lambda": truth.powers[0] if count else 0.0,
        "verdict": str(said["verdict"]),
        "names": [list(name) for name in names],
        "first": list(names[0]) if names else [],
        "set": [list(name) for name in sets[0]] if sets else [],
        "match": match(names[0], main) if names and count else "",
        "in_set": bool(sets and count and any(is_right(name, main) for name in sets[0])),
        "set_size": len(sets[0]) if sets else 0,
        "sure": str(said["verdict"]) == "named" and all(len(s) == 1 for s in sets),
        "all_right": len(names) == count == pairing(truth.truth, [[name] for name in names]),
        "all_in_sets": len(names) == count == pairing(truth.truth, sets),
        "strange": sum(not any(is_right(name, true) for true in known) for name in names),
        "final_mm": number_of(gap, "holdout_rms_mm", "final"),
        "geometric_mm": number_of(gap, "holdout_rms_mm", "geometric"),
        "said_floor_mm": number_of(gap, "noise_floor_mm"),
        "floor_mm": 1e3 * truth.floor,
        "telling": float("nan"),
        "rho2": float("nan"),
        "rival": ["", ""],
        "oracle_mm": float("nan"),
        "known_mm": float("nan"),
        "trouble": str(said.get("trouble", "")),
    }


def number_of(content: Any, *keys: str) -> float:
    """A number deep in a JSON object, NaN where there is none."""
    for key in keys:
        content = content.get(key) if isinstance(content, dict) else None
    return float(content) if isinstance(content, (int, float)) else float("nan")


# ---- headline criteria ---------------------------------------------------------------------------


@dataclass(frozen=True)
class Criterion:
    """A share of rows, and the limit that it must keep.

    reason: what a row that does not do its part is listed under.  good: whether a hit is.
    limit: of the share, NaN for none; the least one if a hit is good, else the largest.
    """

    text: str
    reason: str
    rows: Sequence[Row]
    hit: Callable[[Row], bool]
    limit: float = float("nan")
    good: bool = True

    def line(self) -> tuple[Cell, ...]:
        """Text, runs, share with its interval, limit and whether it is kept."""
        n = len(self.rows)
        hits = sum(map(self.hit, self.rows))
        share = hits / n if n else float("nan")
        low, high = interval(hits, n) if n else (share, share)
        kept = share >= self.limit if self.good else share <= self.limit
        bound = f"{'>=' if self.good else '<='} {100.0 * self.limit:.3g} %"
        shown = bound if np.isfinite(self.limit) else ""
        verdict = ("met" if kept else "MISSED") if shown and n else ""
        return (self.text, n, 100.0 * share, 100.0 * low, 100.0 * high, shown, verdict)

    def misses(self) -> list[Row]:
        """Rows that did not do their part, where there is a limit."""
        if not np.isfinite(self.limit):
            return []
        return [row for row in self.rows if self.hit(row) != self.good]


def named(row: Row) -> bool:
    """Something was named, for sure or not."""
    return bool(row["names"]) or row["verdict"] in ("named", "one_of")


def right(row: Row) -> bool:
    """The first name is the truth, in the wide sense."""
    return row["match"] in ("exact", "broad")


def false_for_sure(row: Row) -> bool:
    """Named for sure, and not merely that the true cause's joint errs by its angle."""
    own = [[MAP, place] for effect, place in row["truth"] if effect in OF_ANGLE]
    return bool(row["sure"]) and any(name not in own for name in row["names"])


def close(row: Row) -> bool:
    """Held-out RMS about that of the oracle."""
    return bool(row["final_mm"] <= CLOSE * row["oracle_mm"])


def criteria(rows: Sequence[Row]) -> list[Criterion]:
    """What the diagnosis is held to, and what is only shown."""

    def of(*conditions: str) -> list[Row]:
        return [row for row in rows if row["condition"] in conditions]

    usual = {"poses": 100, "jitter": Case.jitter, "noise": 1.0}
    seen = [row for row in of(*ALONE) if row["lambda"] >= VISIBLE]
    plain = [row for row in seen if row["telling"] >= SEPARABLE]
    murky = [row for row in seen if row["telling"] < SEPARABLE]
    outside = of("outside")
    beyond = [row for row in outside if row["telling"] >= VISIBLE]
    told = [row for row in of("pair") if row["telling"] >= SEPARABLE]
    three = [row for row in of("triple") if row["telling"] >= SEPARABLE]
    judged = [row for row in of(*FITTED) if np.isfinite(row["oracle_mm"])]

    def unknown(row: Row) -> bool:
        return bool(row["verdict"] == "unknown")

    return [
        Criterion("no effect: something named", "false alarm", of("none"), named, 0.03, False),
        Criterion(
            "  of these, usual jitter, noise and poses", "",
            [r for r in of("none") if all(r[k] == v for k, v in usual.items())], named,
        ),
        Criterion("one effect, lambda >= 50: truth in the set of the first", "not in set", seen,
                  lambda r: r["in_set"], 0.99),
        Criterion("  first name right where lambda (1 - rho^2) >= 25", "wrong name", plain, right,
                  0.95),
        Criterion("    and its place exactly", "", plain, lambda r: r["match"] == "exact"),
        Criterion("  elsewhere: verdict one_of", "", murky, lambda r: r["verdict"] == "one_of"),
        Criterion("  elsewhere: first name right", "", murky, right),
        Criterion("  verdict unknown", "", seen, unknown),
        Criterion("  a strange name beside or instead of the truth", "", seen,
                  lambda r: r["strange"] > 0),
        Criterion("outside the library, lambda (1 - rho^2) >= 50: unknown", "outside, but named",
                  beyond, unknown, 0.90),
        Criterion("  all of lambda >= 50: unknown", "", outside, unknown),
        Criterion("true effect deleted: named for sure", "sure without the truth", of("deleted"),
                  lambda r: r["sure"], 0.15, False),
        Criterion("  of these, lambda (1 - rho^2) >= 25 of the best other: named for sure", "",
                  [r for r in of("deleted") if r["telling"] >= SEPARABLE], lambda r: r["sure"]),
        Criterion("  named for sure, and falsely", "", of("deleted"), false_for_sure, 0.15,
                  False),
        Criterion("  unknown", "", of("deleted"), unknown),
        Criterion("two effects exactly right, each lambda (1 - rho^2) >= 25", "pair", told,
                  lambda r: r["all_right"], 0.90),
        Criterion("  all pairs exactly right", "", of("pair"), lambda r: r["all_right"]),
        Criterion("  all pairs within the sets", "", of("pair"), lambda r: r["all_in_sets"]),
        Criterion(f"held-out RMS <= {CLOSE} x oracle (fitted with the true effects)", "not close",
                  judged, close, 0.95),
        Criterion("  x that of points without the effect", "", judged,
                  lambda r: r["final_mm"] <= CLOSE * r["known_mm"]),
        Criterion("  the oracle itself", "", judged,
                  lambda r: r["oracle_mm"] <= CLOSE * r["known_mm"]),
        Criterion("three effects exactly right, each lambda (1 - rho^2) >= 25", "", three,
                  lambda r: r["all_right"]),
        Criterion("  all triples within the sets", "", of("triple"), lambda r: r["all_in_sets"]),
        Criterion("background of small effects: first name right", "", of("background"), right),
        Criterion("  truth in the set of the first", "", of("background"), lambda r: r["in_set"]),
        Criterion("  a name that is not in the background either", "", of("background"),
                  lambda r: r["strange"] > 0),
        Criterion("wrong law of a known cause: first name right", "", of("wrong_law"), right),
        Criterion("  unknown", "", of("wrong_law"), unknown),
        Criterion("data fault named", "", of("fault"), right),
        Criterion("crashed", "crash", rows, lambda r: r["verdict"] == "error", 0.0, False),
    ]  # fmt: skip


def headline(rows: Sequence[Row], all_criteria: Sequence[Criterion]) -> Table:
    """The criteria, and the two that are no shares."""
    seen = [row for row in rows if row["condition"] in ALONE and row["lambda"] >= VISIBLE]
    sizes = np.array([row["set_size"] for row in seen if row["set_size"]], dtype=float)
    times = np.array([row["seconds"] for row in rows], dtype=float)
    lines = [criterion.line() for criterion in all_criteria]
    for text, values, middle, limit in (
        ("one effect, lambda >= 50: mean size of the set", sizes, np.mean, 2.0),
        ("median seconds of a quick diagnosis", times, np.median, 0.5),
    ):
        value, low, high = spread(values, middle)
        kept = value <= limit if limit == 2.0 else value < limit
        lines.append((text, len(values), value, low, high,
                      f"{'<=' if limit == 2.0 else '<'} {limit:g}",
                      ("met" if kept else "MISSED") if len(values) else ""))  # fmt: skip
    return Table.made(
        "blind study: shares [%] with 95 % intervals, and the limits",
        lines,
        "criterion | runs d | found .1f | from .1f | to .1f | limit | verdict",
    )


def spread(values: Array, middle: Callable[[Array], Any]) -> tuple[float, float, float]:
    """A mean or median, and its 95 % interval by resampling."""
    if not len(values):
        return float("nan"), float("nan"), float("nan")
    rng = np.random.default_rng(0)
    again = [float(middle(rng.choice(values, len(values)))) for _ in range(500)]
    low, high = np.quantile(again, (0.025, 0.975))
    return float(middle(values)), float(low), float(high)


# ---- other tables --------------------------------------------------------------------------------


def share_of(rows: Sequence[Row], hit: Callable[[Row], Any]) -> float:
    """Share of rows [%], NaN without any."""
    return 100.0 * float(np.mean([bool(hit(row)) for row in rows])) if rows else float("nan")


def said_first(row: Row) -> str:
    """Effect of the first name, or the verdict without one."""
    return str(row["first"][0]) if row["first"] else str(row["verdict"])


def confusion(rows: Sequence[Row]) -> tuple[tuple[str, ...], tuple[str, ...], Array]:
    """True effects, answers, and how often they came together, of visible single effects."""
    seen = [
        row
        for row in rows
        if row["condition"] in (*ALONE, "fault") and row["lambda"] >= VISIBLE
    ]  # fmt: skip
    counts = Counter((row["truth"][0][0], said_first(row)) for row in seen)
    answers = {answer for _, answer in counts}
    columns = [*(e for e in EFFECTS if e in answers or any(t == e for t, _ in counts))]
    columns += sorted(answers - set(columns) - set(NO_ANSWER))
    columns += [answer for answer in NO_ANSWER if answer in answers]
    lines = [effect for effect in EFFECTS if any(t == effect for t, _ in counts)]
    table = np.array([[counts[line, column] for column in columns] for line in lines])
    return tuple(lines), tuple(columns), table.reshape(len(lines), len(columns))


def confusion_table(rows: Sequence[Row]) -> Table:
    """The confusion matrix, a line a true effect with its answers, the most frequent first."""
    lines, columns, counts = confusion(rows)

    def answers(row: Array) -> str:
        order = [int(i) for i in np.argsort(-row, kind="stable") if row[i]]
        return ", ".join(f"{columns[i]} {row[i]}" for i in order)

    return Table.made(
        "true effect x first name, visible single effects",
        ((line, int(c.sum()), answers(c)) for line, c in zip(lines, counts, strict=True)),
        "truth | runs d | first name, and how often",
    )


def per_effect(rows: Sequence[Row]) -> Table:
    """Names and sets of every effect that is visible alone."""
    seen = [row for row in rows if row["condition"] in ALONE and row["lambda"] >= VISIBLE]
    lines: list[tuple[Cell, ...]] = []
    for effect in LIBRARY:
        own = [row for row in seen if row["truth"][0][0] == effect]
        sized = [row["set_size"] for row in own if row["set_size"]]
        rivals = Counter(":".join(row["rival"]) for row in own if row["rival"][0])
        rho2 = [row["rho2"] for row in own if np.isfinite(row["rho2"])]
        if own:
            lines.append((
                effect, len(own), share_of(own, lambda r: r["match"] == "exact"),
                share_of(own, lambda r: r["match"] == "broad"),
                share_of(own, lambda r: r["in_set"]),
                float(np.mean(sized)) if sized else float("nan"),
                share_of(own, lambda r: r["verdict"] == "one_of"),
                share_of(own, lambda r: r["verdict"] == "unknown"),
                share_of(own, lambda r: r["verdict"] == "none"),
                float(np.median(rho2)) if rho2 else float("nan"),
                rivals.most_common(1)[0][0] if rivals else "",
            ))  # fmt: skip
    return Table.made(
        "each effect, lambda >= 50 [%]",
        lines,
        "effect | runs d | right .1f | all/one .1f | in set .1f | set size .2f | "
        "one_of .1f | unknown .1f | none .1f | median rho^2 .3f | usual alternative",
    )


def by_power(rows: Sequence[Row]) -> list[tuple[float, list[Row]]]:
    """Rows of the condition single by the lambda that was asked for."""
    single = [row for row in rows if row["condition"] == "single"]
    powers = sorted({row["asked"] for row in single})
    return [(power, [row for row in single if row["asked"] == power]) for power in powers]


SHOWN: tuple[tuple[str, Callable[[Row], bool]], ...] = (
    ("something found", lambda row: row["verdict"] not in ("none", "error")),
    ("truth in the set", lambda row: bool(row["in_set"])),
    ("first name right", right),
)


def detectability(rows: Sequence[Row]) -> Table:
    """What is found, against lambda."""
    return Table(
        "detectability: single effects against lambda [%]",
        ("lambda", "runs", *(text for text, _ in SHOWN), "unknown"),
        tuple(
            (power, len(own), *(share_of(own, hit) for _, hit in SHOWN),
             share_of(own, lambda row: row["verdict"] == "unknown"))
            for power, own in by_power(rows)
        ),
        (".0f", "d", ".1f", ".1f", ".1f", ".1f"),
    )  # fmt: skip


def shrink(rows: Sequence[Row]) -> Table:
    """Held-out RMS against the oracle's, and the noise floor that was said against the true one."""
    lines: list[tuple[Cell, ...]] = []
    for text, above, below in (
        ("held-out RMS / oracle", "final_mm", "oracle_mm"),
        ("held-out RMS, geometry only / oracle", "geometric_mm", "oracle_mm"),
        ("oracle / without the effect", "oracle_mm", "known_mm"),
        ("said noise floor / true", "said_floor_mm", "floor_mm"),
    ):
        for condition in dict.fromkeys(row["condition"] for row in rows):
            own = [row for row in rows if row["condition"] == condition]
            ratio = np.array([row[above] / row[below] for row in own], dtype=float)
            ratio = ratio[np.isfinite(ratio)]
            if len(ratio):
                quantiles = np.quantile(ratio, (0.05, 0.5, 0.95, 0.99))
                lines.append((text, condition, len(ratio), *map(float, quantiles),
                              float(ratio.max())))  # fmt: skip
    return Table.made(
        "gap closed: quantiles of ratios",
        lines,
        "ratio | condition | runs d | 5 % .3f | 50 % .3f | 95 % .3f | 99 % .3f | largest .3f",
    )


def verdicts(rows: Sequence[Row]) -> Table:
    """How often each verdict was given in each condition."""
    kinds = ("none", "named", "one_of", "unknown", "not_repeatable", "error")
    lines = []
    for condition in dict.fromkeys(row["condition"] for row in rows):
        own = [row for row in rows if row["condition"] == condition]
        counts = Counter(row["verdict"] for row in own)
        seconds = float(np.median([row["seconds"] for row in own]))
        lines.append((condition, len(own), *(counts[kind] for kind in kinds), seconds))
    return Table(
        "verdicts", ("condition", "runs", *kinds, "median s"), tuple(lines),
        ("", "d", *("d" for _ in kinds), ".2f"),
    )  # fmt: skip


def text_of(names: Sequence[Sequence[str]]) -> str:
    """Names as effect:place, joined."""
    return " + ".join(":".join(name) for name in names)


def misses(all_criteria: Sequence[Criterion]) -> Table:
    """The runs behind the limits, some of each reason, for those who mend the diagnosis."""
    lines: list[tuple[Cell, ...]] = []
    for criterion in all_criteria:
        for row in criterion.misses()[:MISSES_EACH]:
            others = [":".join(name) for name in row["set"][1:4]]
            said = f"{row['verdict']} {text_of(row['names'])}".strip()
            said += f" (or {', '.join(others)})" if others else ""
            lines.append((
                criterion.reason, f"{row['robot']} {row['poses']} #{row['seed']}",
                text_of([(law, place) for law, (_, place) in
                         zip(row["laws"], row["truth"], strict=True)]),
                row["trouble"][:60] or said, row["lambda"], row["rho2"],
                row["final_mm"] / row["oracle_mm"],
            ))  # fmt: skip
    total = sum(len(criterion.misses()) for criterion in all_criteria)
    shown = lines[:MOST_MISSES]
    return Table.made(
        f"misses: {len(shown)} of {total}",
        shown,
        "what | robot, poses, seed | truth | said | lambda .0f | rho^2 .3f | RMS/oracle .3f",
    )


def troubles(rows: Sequence[Row]) -> Table:
    """What went wrong in the diagnosis or in the judge, the most frequent first."""
    counts = Counter(row["trouble"][:120] for row in rows if row["trouble"])
    return Table.made("troubles", counts.most_common(10), "message | runs d")


# ---- pictures ------------------------------------------------------------------------------------

COLOURS = ("#0072b2", "#009e73", "#d55e00")  # told apart by colour-blind eyes too


def detectability_picture(rows: Sequence[Row]) -> Figure:
    """Shares against lambda with binomial bands."""
    figure = canvas(7, 4.2)
    axes = figure.subplots()
    groups = by_power(rows)
    powers = [power for power, _ in groups]
    for (text, hit), colour in zip(SHOWN, COLOURS, strict=True):
        shares = [share_of(own, hit) for _, own in groups]
        bands = [interval(sum(map(hit, own)), len(own)) for _, own in groups]
        axes.plot(powers, shares, "o-", color=colour, label=text, ms=4)
        low, high = 100.0 * np.array(bands).reshape(-1, 2).T
        axes.fill_between(powers, low, high, color=colour, alpha=0.15, lw=0)
    axes.axvline(50.0, color="0.5", ls=":", lw=1)
    axes.set(xscale="log", ylim=(0, 102), xlabel="detectability lambda", ylabel="runs (%)")
    axes.grid(visible=True, alpha=0.3)
    axes.legend(frameon=False)
    return figure


def confusion_picture(rows: Sequence[Row]) -> Figure:
    """The confusion matrix, each line as shares of its truth."""
    lines, columns, counts = confusion(rows)
    figure = canvas(9.5, 7.5)
    axes = figure.subplots()
    shares = 100.0 * counts / np.maximum(counts.sum(axis=1, keepdims=True), 1)
    axes.imshow(shares, cmap="Blues", vmin=0.0, vmax=100.0)
    for (i, j), share in np.ndenumerate(shares):
        if share:
            colour = "white" if share > 60.0 else "black"
            axes.text(j, i, f"{share:.0f}", ha="center", va="center", color=colour, fontsize=8)
    axes.set_xticks(range(len(columns)), columns, rotation=60, ha="right")
    axes.set_yticks(range(len(lines)), lines)
    axes.set(xlabel="first name", ylabel="truth")
    axes.set_title("share of each truth (%), visible single effects")
    return figure


def shrink_picture(rows: Sequence[Row]) -> Figure:
    """Distribution of the held-out RMS over the oracle's, before and after naming."""
    figure = canvas(7, 4.2)
    axes = figure.subplots()
    judged = [row for row in rows if np.isfinite(row["oracle_mm"])]
    for key, text, colour in (
        ("geometric_mm", "geometry only", COLOURS[2]),
        ("final_mm", "with what was named", COLOURS[0]),
    ):
        ratio = np.sort([row[key] / row["oracle_mm"] for row in judged])
        ratio = ratio[np.isfinite(ratio)]
        share = 100.0 * (np.arange(len(ratio)) + 1) / max(1, len(ratio))
        axes.step(ratio, share, where="post", color=colour, label=text)
    axes.axvline(CLOSE, color="0.5", ls=":", lw=1)
    axes.set(xlabel="held-out RMS / oracle's", ylabel="runs with less (%)", xlim=(0.95, 1.6))
    axes.grid(visible=True, alpha=0.3)
    axes.legend(frameon=False, loc="lower right")
    return figure


# ---- the study -----------------------------------------------------------------------------------


class Conditioned(Protocol):
    """A case of a condition."""

    @property
    def condition(self) -> str:
        """What it is run for."""


C = TypeVar("C", bound=Conditioned)


def chosen(
    study: Study, cases: Sequence[C], only: Sequence[str], every: int | None, sparse: int
) -> list[C]:
    """Cases of some conditions, each so many-th.  sparse: of --quick.  Raises OptionError."""
    conditions = tuple(dict.fromkeys(case.condition for case in cases))
    for name in only:
        if name not in conditions:
            raise OptionError(f"--only {name}: choose {', '.join(conditions)}")
    step = (sparse if study.quick else 1) if every is None else every
    if step < 1:
        raise OptionError(f"--every {every}: give a whole number, 1 or more")
    return [case for case in cases if not only or case.condition in only][::step]


SPARSE = 4  # of the cases of --quick, each so many-th by itself


@study_options("blind_gap")
@click.option("--only", multiple=True, help="A condition to run, such as pair; may be repeated.")
@click.option("--every", type=int, help="Run each N-th case alone [default: 1; with --quick 4].")
def main(study: Study, only: tuple[str, ...], every: int | None) -> None:
    """Blind judgement of diagnose."""
    cases = plan(study.seed, QUICK if study.quick else Size())
    rows = study.sweep(run, chosen(study, cases, only, every, SPARSE), "diagnoses")
    found = criteria(rows)
    tables = [
        headline(rows, found),
        verdicts(rows),
        confusion_table(rows),
        per_effect(rows),
        detectability(rows),
        shrink(rows),
        misses(found),
        *([troubles(rows)] if any(row["trouble"] for row in rows) else []),
    ]
    figures = {
        "blind_gap_detectability": detectability_picture(rows),
        "blind_gap_confusion": confusion_picture(rows),
        "blind_gap_oracle": shrink_picture(rows),
    }
    names = ("criterion", "runs", "found", "low", "high", "limit", "verdict")
    study.save(tables, {"criteria": tables[0].records(*names), "rows": rows}, figures)


if __name__ == "__main__":
    sweep.start(__file__)
