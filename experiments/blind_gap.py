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

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

import minimax_cal as mc
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
    places,
    spec,
)
from experiments.record import canvas, interval
from experiments.resemblance import resemblance
from experiments.scoring import (
    Criterion,
    Name,
    Row,
    answers,
    asked,
    blind_study,
    chosen,
    has,
    headline,
    is_right,
    match,
    misses,
    number_of,
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
from minimax_cal.ground.tables import Cell, Table

if TYPE_CHECKING:
    from matplotlib.figure import Figure

POWERS = (5.0, 15.0, 30.0, 50.0, 100.0, 300.0, 1000.0, 5000.0)  # detectability lambda
CLEAR = (100.0, 300.0, 1000.0)
LIBRARY = tuple(effect for effect in EFFECTS if effect not in FAULTS)
ALONE = ("single", "poses", "rough")  # conditions with one effect of the library
FITTED = (*ALONE, "pair", "triple")  # conditions that the oracle can fit
VISIBLE = 50.0 * (1.0 - 1e-6)  # lambda from which an effect must be seen
SEPARABLE = 25.0  # lambda (1 - rho^2) from which it must be told from its nearest rival
CLOSE = 1.06  # held-out RMS over the oracle's that is good enough
MAP = "joint_error_map"  # that a joint errs by its angle, which is true of these laws:
OF_ANGLE = ("gear_error", "gear_ripple", "encoder_gain")


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
    """Make an arm, let its files be diagnosed, then look at the truth and score."""
    made = make(case)
    answer = asked(made, seed=case.seed, exclude=case.delete)
    row = score(case, made, answer.said) | {"seconds": answer.seconds}
    known = (case, made, answer.robot, answer.data)
    try:
        return row | rivals(*known) | oracle(*known)
    except Exception as error:  # the judge's trouble is shown, and costs no other run
        return row | {"trouble": f"{type(error).__name__}: {error}"}


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
    freed = data.with_y(data.y - truth.displacement)
    told = mc.calibrate(robot, data, objective="sum", effects=effects)
    known = mc.calibrate(robot, freed, objective="sum")
    return {
        "oracle_mm": told.accuracy["holdout"].rms_mm,
        "known_mm": known.accuracy["holdout"].rms_mm,
    }


def score(case: Case, truth: Truth, said: Row) -> Row:
    """What an answer is worth, as plain data.  said: the JSON of a diagnosis."""
    sets = answers(said)
    names = [options[0] for options in sets]
    first = sets[0] if sets else []
    count = len(truth.truth)
    main = truth.truth[0] if count else ("", "")
    nan = float("nan")
    return scored(case, truth, said, names) | {
        "robot": case.robot,
        "poses": case.poses,
        "jitter": case.jitter,
        "noise": case.noise,
        "asked": max((cause.power for cause in case.causes), default=0.0),
        "lambda": truth.powers[0] if count else 0.0,
        "first": list(names[0]) if names else [],
        "set": [list(name) for name in first],
        "match": match(names[0], main) if names and count else "",
        "in_set": bool(count and any(is_right(name, main) for name in first)),
        "set_size": len(first),
        "sure": str(said["verdict"]) == "named" and all(len(s) == 1 for s in sets),
        "all_in_sets": len(names) == count == pairing(truth.truth, sets),
        "said_floor_mm": number_of(said, "gap", "noise_floor_mm"),
        "floor_mm": 1e3 * truth.floor,
        **{"telling": nan, "rho2": nan, "rival": ["", ""], "oracle_mm": nan, "known_mm": nan},
    }


# ---- headline criteria ---------------------------------------------------------------------------


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
    some = partial(of, rows)
    usual = {"poses": 100, "jitter": Case.jitter, "noise": 1.0}
    seen = [row for row in some(*ALONE) if row["lambda"] >= VISIBLE]
    plain = [row for row in seen if row["telling"] >= SEPARABLE]
    murky = [row for row in seen if row["telling"] < SEPARABLE]
    outside = some("outside")
    beyond = [row for row in outside if row["telling"] >= VISIBLE]
    told = [row for row in some("pair") if row["telling"] >= SEPARABLE]
    three = [row for row in some("triple") if row["telling"] >= SEPARABLE]
    judged = [row for row in some(*FITTED) if np.isfinite(row["oracle_mm"])]

    unknown = verdict_is("unknown")
    return [
        Criterion("no effect: something named", "false alarm", some("none"), named, 0.03, False),
        Criterion(
            "  of these, usual jitter, noise and poses", "",
            [r for r in some("none") if all(r[k] == v for k, v in usual.items())], named,
        ),
        Criterion("one effect, lambda >= 50: truth in the set of the first", "not in set", seen,
                  has("in_set"), 0.99),
        Criterion("  first name right where lambda (1 - rho^2) >= 25", "wrong name", plain, right,
                  0.95),
        Criterion("    and its place exactly", "", plain, lambda r: r["match"] == "exact"),
        Criterion("  elsewhere: verdict one_of", "", murky, verdict_is("one_of")),
        Criterion("  elsewhere: first name right", "", murky, right),
        Criterion("  verdict unknown", "", seen, unknown),
        Criterion("  a strange name beside or instead of the truth", "", seen,
                  has("strange")),
        Criterion("outside the library, lambda (1 - rho^2) >= 50: unknown", "outside, but named",
                  beyond, unknown, 0.90),
        Criterion("  all of lambda >= 50: unknown", "", outside, unknown),
        Criterion("true effect deleted: named for sure", "sure without the truth", some("deleted"),
                  has("sure"), 0.15, False),
        Criterion("  of these, lambda (1 - rho^2) >= 25 of the best other: named for sure", "",
                  [r for r in some("deleted") if r["telling"] >= SEPARABLE], has("sure")),
        Criterion("  named for sure, and falsely", "", some("deleted"), false_for_sure, 0.15,
                  False),
        Criterion("  unknown", "", some("deleted"), unknown),
        Criterion("two effects exactly right, each lambda (1 - rho^2) >= 25", "pair", told,
                  has("all_right"), 0.90),
        Criterion("  all pairs exactly right", "", some("pair"), has("all_right")),
        Criterion("  all pairs within the sets", "", some("pair"), has("all_in_sets")),
        Criterion(f"held-out RMS <= {CLOSE} x oracle (fitted with the true effects)", "not close",
                  judged, close, 0.95),
        Criterion("  x that of points without the effect", "", judged,
                  lambda r: r["final_mm"] <= CLOSE * r["known_mm"]),
        Criterion("  the oracle itself", "", judged,
                  lambda r: r["oracle_mm"] <= CLOSE * r["known_mm"]),
        Criterion("three effects exactly right, each lambda (1 - rho^2) >= 25", "", three,
                  has("all_right")),
        Criterion("  all triples within the sets", "", some("triple"), has("all_in_sets")),
        Criterion("background of small effects: first name right", "", some("background"), right),
        Criterion("  truth in the set of the first", "", some("background"), has("in_set")),
        Criterion("  a name that is not in the background either", "", some("background"),
                  has("strange")),
        Criterion("wrong law of a known cause: first name right", "", some("wrong_law"), right),
        Criterion("  unknown", "", some("wrong_law"), unknown),
        Criterion("data fault named", "", some("fault"), right),
        Criterion("crashed", "crash", rows, verdict_is("error"), 0.0, False),
    ]  # fmt: skip


def no_shares(rows: Sequence[Row]) -> Iterator[tuple[Cell, ...]]:
    """Lines of the headline that are no shares."""
    seen = [row for row in of(rows, *ALONE) if row["lambda"] >= VISIBLE]
    sizes = np.array([row["set_size"] for row in seen if row["set_size"]], dtype=float)
    times = np.array([row["seconds"] for row in rows], dtype=float)
    for text, values, middle, bound in (
        ("one effect, lambda >= 50: mean size of the set", sizes, np.mean, "<= 2"),
        ("median seconds of a quick diagnosis", times, np.median, "< 0.5"),
    ):
        value, low, high = spread(values, middle)
        kept = "met" if value <= float(bound.split()[1]) else "MISSED"
        yield text, len(values), value, low, high, bound, kept if len(values) else ""


def spread(values: Array, middle: Callable[[Array], Any]) -> tuple[float, float, float]:
    """A mean or median, and its 95 % interval by resampling."""
    if not len(values):
        return float("nan"), float("nan"), float("nan")
    rng = np.random.default_rng(0)
    again = [float(middle(rng.choice(values, len(values)))) for _ in range(500)]
    low, high = np.quantile(again, (0.025, 0.975))
    return float(middle(values)), float(low), float(high)


# ---- other tables --------------------------------------------------------------------------------


def said_first(row: Row) -> str:
    """Effect of the first name, or the verdict without one."""
    return str(row["first"][0]) if row["first"] else str(row["verdict"])


def confusion(rows: Sequence[Row]) -> Table:
    """Each true effect with its answers, the most frequent first."""
    seen = [row for row in of(rows, *ALONE, "fault") if row["lambda"] >= VISIBLE]
    lines = []
    for effect in EFFECTS:
        said = Counter(said_first(row) for row in seen if row["truth"][0][0] == effect)
        often = ", ".join(f"{name} {count}" for name, count in said.most_common())
        lines += [(effect, said.total(), often)] if said else []
    return Table.made(
        "true effect x first name, visible single effects",
        lines,
        "truth | runs d | first name, and how often",
    )


def per_effect(rows: Sequence[Row]) -> Table:
    """Names and sets of every effect that is visible alone."""
    seen = [row for row in of(rows, *ALONE) if row["lambda"] >= VISIBLE]
    lines = []
    for effect in LIBRARY:
        own = [row for row in seen if row["truth"][0][0] == effect]
        sized = [row["set_size"] for row in own if row["set_size"]]
        rivals = Counter(":".join(row["rival"]) for row in own if row["rival"][0])
        rho2 = [row["rho2"] for row in own if np.isfinite(row["rho2"])]
        if own:
            lines.append((
                effect, len(own), share_of(own, lambda r: r["match"] == "exact"),
                share_of(own, lambda r: r["match"] == "broad"),
                share_of(own, has("in_set")),
                float(np.mean(sized)) if sized else float("nan"),
                share_of(own, verdict_is("one_of")),
                share_of(own, verdict_is("unknown")),
                share_of(own, verdict_is("none")),
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
    single = of(rows, "single")
    powers = sorted({row["asked"] for row in single})
    return [(power, [row for row in single if row["asked"] == power]) for power in powers]


SHOWN: tuple[tuple[str, Callable[[Row], bool]], ...] = (
    ("something found", lambda row: row["verdict"] not in ("none", "error")),
    ("truth in the set", has("in_set")),
    ("first name right", right),
)


def detectability(rows: Sequence[Row]) -> Table:
    """What is found, against lambda."""
    lines = [
        (power, len(own), *(share_of(own, hit) for _, hit in SHOWN),
         share_of(own, verdict_is("unknown")))
        for power, own in by_power(rows)
    ]  # fmt: skip
    title, shown = "detectability: single effects against lambda [%]", [t for t, _ in SHOWN]
    return Table.made(
        title, lines, "lambda .0f | runs d", *(f"{t} .1f" for t in shown), "unknown .1f"
    )


def shrink(rows: Sequence[Row]) -> Table:
    """Held-out RMS against the oracle's, and the noise floor that was said against the true one."""
    lines = []
    for text, above, below in (
        ("held-out RMS / oracle", "final_mm", "oracle_mm"),
        ("held-out RMS, geometry only / oracle", "geometric_mm", "oracle_mm"),
        ("oracle / without the effect", "oracle_mm", "known_mm"),
        ("said noise floor / true", "said_floor_mm", "floor_mm"),
    ):
        for condition in dict.fromkeys(row["condition"] for row in rows):
            ratio = np.array([row[above] / row[below] for row in of(rows, condition)], dtype=float)
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


# ---- the study -----------------------------------------------------------------------------------


SPARSE = 4  # of the cases of --quick, each so many-th by itself


@blind_study("blind_gap")
def main(study: Study, only: tuple[str, ...], every: int | None) -> None:
    """Blind judgement of diagnose."""
    cases = plan(study.seed, QUICK if study.quick else Size())
    rows = study.sweep(run, chosen(study, cases, only, every, SPARSE), "diagnoses")
    found = criteria(rows)
    tables = [
        headline(found, *no_shares(rows)),
        verdicts(rows),
        confusion(rows),
        per_effect(rows),
        detectability(rows),
        shrink(rows),
        misses(found, lambda row: f"{row['robot']} {row['poses']}", "oracle_mm"),
    ]
    save(study, tables, rows, {"blind_gap_detectability": detectability_picture(rows)})
