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
    DATA_FAULT_AMPLITUDES,
    DISTORTED_LAW_NAMES,
    GAP_ARMS,
    LIBRARY_LAW_NAMES,
    OUTSIDE_LAW_NAMES,
    GapCase,
    GapCause,
    GapTruth,
    build_and_measure_arm,
    format_effect_option,
    list_law_places_on_robot,
)
from experiments.resemblance import effect_similarities
from experiments.scoring import (
    Name,
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
    match_kind,
    number_in_json,
    percentage_of_rows,
    save_blind_results,
    score_common_fields,
    select_cases,
    select_conditions,
)
from experiments.study_record import clopper_pearson_interval, new_figure
from experiments.sweep import Study
from minimax_cal.core.arrays import Array
from minimax_cal.core.tables import Table, TableCell

if TYPE_CHECKING:
    from matplotlib.figure import Figure

DETECTABILITY_LEVELS = (5.0, 15.0, 30.0, 50.0, 100.0, 300.0, 1000.0, 5000.0)  # detectability lambda
CLEAR_DETECTABILITY_LEVELS = (100.0, 300.0, 1000.0)
LIBRARY_EFFECTS = tuple(
    effect for effect in LIBRARY_LAW_NAMES if effect not in DATA_FAULT_AMPLITUDES
)
SINGLE_EFFECT_CONDITIONS = ("single", "poses", "rough")  # conditions with one effect of the library
ORACLE_CONDITIONS = (
    *SINGLE_EFFECT_CONDITIONS,
    "pair",
    "triple",
)  # conditions that the oracle can fit
MIN_VISIBLE_DETECTABILITY = 50.0 * (1.0 - 1e-6)  # lambda from which an effect must be seen
MIN_SEPARABLE_DETECTABILITY = (
    25.0  # lambda (1 - rho^2) from which it must be told from its nearest rival
)
MAX_RATIO_TO_ORACLE = 1.06  # held-out RMS over the oracle's that is good enough
ERROR_MAP_EFFECT = "joint_error_map"  # that a joint errs by its angle, which is true of these laws:
ANGLE_DEPENDENT_EFFECTS = ("gear_error", "gear_ripple", "encoder_gain")


# ---- the cases -----------------------------------------------------------------------------------


@dataclass(frozen=True)
class BlindStudySize:
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
    powers: tuple[float, ...] = DETECTABILITY_LEVELS
    clear: tuple[float, ...] = CLEAR_DETECTABILITY_LEVELS
    beyond: tuple[float, ...] = (*CLEAR_DETECTABILITY_LEVELS, 5000.0)
    removed: tuple[str, ...] = LIBRARY_EFFECTS


QUICK_BLIND_STUDY_SIZE = BlindStudySize(
    none=8, none_rough=0, single=1, poses=0, rough=0, pair=3, triple=1, background=1, outside=1,
    deleted=1, wrong_law=1, fault=1, powers=(300.0,), clear=(1000.0,), beyond=(1000.0,),
    removed=("joint_compliance", "gear_error", "backlash"),
)  # fmt: skip

ROUGH_CONDITIONS: tuple[dict[str, float], ...] = (
    {"jitter": 0.0},
    {"jitter": 20e-6},
    {"noise": 2.0},
)


def draw_all_cases(seed: int, size: BlindStudySize) -> list[GapCase]:
    """All cases of the study; each has a seed of its own."""
    rng = np.random.default_rng(seed)
    cases = [GapCase(draw_robot_name(rng), "none") for _ in range(size.none)]
    for _ in range(size.none_rough):
        robot = draw_robot_name(rng)
        cases += [replace(GapCase(robot, "none"), **rough) for rough in ROUGH_CONDITIONS]  # type: ignore[arg-type]
        cases += [GapCase(robot, "none", poses=poses) for poses in (60, 200)]
    for effect in LIBRARY_EFFECTS:
        for power in size.powers:
            cases += draw_single_law_cases(rng, "single", effect, power, size.single)
        for poses in (60, 200):
            for power in (50.0, 300.0):
                cases += draw_single_law_cases(rng, "poses", effect, power, size.poses, poses=poses)
        for rough in ROUGH_CONDITIONS:
            cases += draw_single_law_cases(rng, "rough", effect, 300.0, size.rough, **rough)
    for effect in size.removed:
        for power in size.clear:
            cases += draw_single_law_cases(
                rng, "deleted", effect, power, size.deleted, delete=(effect,)
            )
    cases += [draw_case_of_several_effects(rng, "pair", 2, size.clear) for _ in range(size.pair)]
    cases += [
        draw_case_of_several_effects(rng, "triple", 3, size.clear) for _ in range(size.triple)
    ]
    cases += [
        replace(draw_case_of_several_effects(rng, "background", 1, size.clear), background=10.0)
        for _ in range(size.background)
    ]
    for law in OUTSIDE_LAW_NAMES:
        for power in size.beyond:
            cases += draw_single_law_cases(rng, "outside", law, power, size.outside)
    for law in DISTORTED_LAW_NAMES:
        for power in size.clear:
            cases += draw_single_law_cases(rng, "wrong_law", law, power, size.wrong_law)
    for law in DATA_FAULT_AMPLITUDES:
        cases += draw_single_law_cases(rng, "fault", law, 1.0, size.fault)
    return [replace(case, seed=1_000_000 * seed + i) for i, case in enumerate(cases)]


def draw_robot_name(rng: np.random.Generator) -> str:
    """Two arms of three are the first."""
    return str(rng.choice(list(GAP_ARMS), p=(2 / 3, 1 / 3)))


def draw_cause(rng: np.random.Generator, robot: str, law: str, power: float) -> GapCause:
    """A law at one of its places on the robot."""
    return GapCause(
        law, str(rng.choice(list_law_places_on_robot(law, robot))), power, int(rng.integers(2))
    )


def draw_single_law_cases(
    rng: np.random.Generator, condition: str, law: str, power: float, count: int, **options: Any
) -> list[GapCase]:
    """Cases of one law, on robots that can have it."""
    out = []
    for _ in range(count):
        robot = draw_robot_name(rng)
        robot = (
            robot
            if list_law_places_on_robot(law, robot)
            else next(r for r in GAP_ARMS if list_law_places_on_robot(law, r))
        )
        out.append(GapCase(robot, condition, (draw_cause(rng, robot, law, power),), **options))
    return out


def draw_case_of_several_effects(
    rng: np.random.Generator, condition: str, count: int, powers: Sequence[float]
) -> GapCase:
    """Different effects at once, each of a power of its own, the largest first."""
    robot = draw_robot_name(rng)
    chosen = rng.choice(
        [e for e in LIBRARY_EFFECTS if list_law_places_on_robot(e, robot)], count, replace=False
    )
    causes = [draw_cause(rng, robot, str(e), float(rng.choice(powers))) for e in chosen]
    causes.sort(key=lambda cause: -cause.power)
    return GapCase(robot, condition, tuple(causes))


# ---- one run -------------------------------------------------------------------------------------


def run_case(case: GapCase) -> Row:
    """Make an arm, let its files be diagnosed, then look at the truth and score."""
    made = build_and_measure_arm(case)
    answer = diagnose_sealed_arm(made, seed=case.seed, exclude=case.delete)
    row = score_answer(case, made, answer.said) | {"seconds": answer.seconds}
    known = (case, made, answer.robot, answer.data)
    try:
        return row | nearest_alternative_scores(*known) | oracle_errors(*known)
    except Exception as error:  # the judge's trouble is shown, and costs no other run
        return row | {"trouble": f"{type(error).__name__}: {error}"}


def nearest_alternative_scores(
    case: GapCase, truth: GapTruth, robot: mc.Robot, data: mc.Measurements
) -> Row:
    """How alike the nearest rival in the library is to each cause (of the least telling first)."""
    if case.condition in ("none", "fault"):
        return {}
    found = []
    for name, power, part in zip(truth.truth, truth.powers, truth.parts, strict=True):
        alike = effect_similarities(robot, data, part)
        alike = {other: rho2 for other, rho2 in alike.items() if other[0] not in case.delete}
        rival, rho2 = find_nearest_alternative(name, alike)
        found.append((power * (1.0 - rho2), rho2, rival))
    telling, rho2, rival = min(found)
    return {"telling": telling, "rho2": rho2, "rival": list(rival)}


def find_nearest_alternative(truth: Name, similarities: dict[Name, float]) -> tuple[Name, float]:
    """The candidate that is most like the truth and is not the truth, and its rho^2."""
    others = {
        name: rho2
        for name, rho2 in similarities.items()
        if np.isfinite(rho2) and match_kind(name, truth) not in ("exact", "broad")
    }
    best = max(others, key=lambda name: others[name], default=("", ""))
    return best, float(min(1.0, others.get(best, 0.0)))


def oracle_errors(case: GapCase, truth: GapTruth, robot: mc.Robot, data: mc.Measurements) -> Row:
    """Held-out RMS [mm] of calibrations that know: the effects' names, or even their motion.

    The first is fitted with the library's laws of the true effects, and as good as those are; the
    second to points from which the true displacement is taken out, whatever any library holds.
    """
    if case.condition not in ORACLE_CONDITIONS:
        return {}
    effects = [format_effect_option(case.robot, cause) for cause in case.causes]
    freed = data.with_y(data.y - truth.displacement)
    told = mc.calibrate(robot, data, objective="sum", effects=effects)
    known = mc.calibrate(robot, freed, objective="sum")
    return {
        "oracle_mm": told.accuracy["holdout"].rms_mm,
        "known_mm": known.accuracy["holdout"].rms_mm,
    }


def score_answer(case: GapCase, truth: GapTruth, diagnosis_json: Row) -> Row:
    """What an answer is worth, as plain data.  diagnosis_json: the JSON of a diagnosis."""
    sets = list_confirmed_causes(diagnosis_json)
    names = [options[0] for options in sets]
    first = sets[0] if sets else []
    count = len(truth.truth)
    main = truth.truth[0] if count else ("", "")
    nan = float("nan")
    return score_common_fields(case, truth, diagnosis_json, names) | {
        "robot": case.robot,
        "poses": case.poses,
        "jitter": case.jitter,
        "noise": case.noise,
        "asked": max((cause.power for cause in case.causes), default=0.0),
        "lambda": truth.powers[0] if count else 0.0,
        "first": list(names[0]) if names else [],
        "set": [list(name) for name in first],
        "match": match_kind(names[0], main) if names and count else "",
        "in_set": bool(count and any(is_name_right(name, main) for name in first)),
        "set_size": len(first),
        "sure": str(diagnosis_json["verdict"]) == "named" and all(len(s) == 1 for s in sets),
        "all_in_sets": len(names) == count == count_matched_truths(truth.truth, sets),
        "said_floor_mm": number_in_json(diagnosis_json, "gap", "noise_floor_mm"),
        "floor_mm": 1e3 * truth.floor,
        **{"telling": nan, "rho2": nan, "rival": ["", ""], "oracle_mm": nan, "known_mm": nan},
    }


# ---- headline criteria ---------------------------------------------------------------------------


def names_a_cause(row: Row) -> bool:
    """Something was named, for sure or not."""
    return bool(row["names"]) or row["verdict"] in ("named", "one_of")


def is_first_name_right(row: Row) -> bool:
    """The first name is the truth, in the wide sense."""
    return row["match"] in ("exact", "broad")


def is_surely_wrong(row: Row) -> bool:
    """Named for sure, and not merely that the true cause's joint errs by its angle."""
    own = [
        [ERROR_MAP_EFFECT, place]
        for effect, place in row["truth"]
        if effect in ANGLE_DEPENDENT_EFFECTS
    ]
    return bool(row["sure"]) and any(name not in own for name in row["names"])


def is_close_to_oracle(row: Row) -> bool:
    """Held-out RMS about that of the oracle."""
    return bool(row["final_mm"] <= MAX_RATIO_TO_ORACLE * row["oracle_mm"])


def build_blind_criteria(rows: Sequence[Row]) -> list[StudyCriterion]:
    """What the diagnosis is held to, and what is only shown."""
    some = partial(select_conditions, rows)
    usual = {"poses": 100, "jitter": GapCase.jitter, "noise": 1.0}
    seen = [
        row for row in some(*SINGLE_EFFECT_CONDITIONS) if row["lambda"] >= MIN_VISIBLE_DETECTABILITY
    ]
    plain = [row for row in seen if row["telling"] >= MIN_SEPARABLE_DETECTABILITY]
    murky = [row for row in seen if row["telling"] < MIN_SEPARABLE_DETECTABILITY]
    outside = some("outside")
    beyond = [row for row in outside if row["telling"] >= MIN_VISIBLE_DETECTABILITY]
    told = [row for row in some("pair") if row["telling"] >= MIN_SEPARABLE_DETECTABILITY]
    three = [row for row in some("triple") if row["telling"] >= MIN_SEPARABLE_DETECTABILITY]
    judged = [row for row in some(*ORACLE_CONDITIONS) if np.isfinite(row["oracle_mm"])]

    unknown = make_verdict_test("unknown")
    return [
        StudyCriterion(
            "no effect: something named", "false alarm", some("none"), names_a_cause, 0.03, False
        ),
        StudyCriterion(
            "  of these, usual jitter, noise and poses",
            "",
            [r for r in some("none") if all(r[k] == v for k, v in usual.items())],
            names_a_cause,
        ),
        StudyCriterion(
            "one effect, lambda >= 50: truth in the set of the first",
            "not in set",
            seen,
            make_key_test("in_set"),
            0.99,
        ),
        StudyCriterion(
            "  first name right where lambda (1 - rho^2) >= 25",
            "wrong name",
            plain,
            is_first_name_right,
            0.95,
        ),
        StudyCriterion("    and its place exactly", "", plain, lambda r: r["match"] == "exact"),
        StudyCriterion("  elsewhere: verdict one_of", "", murky, make_verdict_test("one_of")),
        StudyCriterion("  elsewhere: first name right", "", murky, is_first_name_right),
        StudyCriterion("  verdict unknown", "", seen, unknown),
        StudyCriterion(
            "  a strange name beside or instead of the truth", "", seen, make_key_test("strange")
        ),
        StudyCriterion(
            "outside the library, lambda (1 - rho^2) >= 50: unknown",
            "outside, but named",
            beyond,
            unknown,
            0.90,
        ),
        StudyCriterion("  all of lambda >= 50: unknown", "", outside, unknown),
        StudyCriterion(
            "true effect deleted: named for sure",
            "sure without the truth",
            some("deleted"),
            make_key_test("sure"),
            0.15,
            False,
        ),
        StudyCriterion(
            "  of these, lambda (1 - rho^2) >= 25 of the best other: named for sure",
            "",
            [r for r in some("deleted") if r["telling"] >= MIN_SEPARABLE_DETECTABILITY],
            make_key_test("sure"),
        ),
        StudyCriterion(
            "  named for sure, and falsely", "", some("deleted"), is_surely_wrong, 0.15, False
        ),
        StudyCriterion("  unknown", "", some("deleted"), unknown),
        StudyCriterion(
            "two effects exactly right, each lambda (1 - rho^2) >= 25",
            "pair",
            told,
            make_key_test("all_right"),
            0.90,
        ),
        StudyCriterion("  all pairs exactly right", "", some("pair"), make_key_test("all_right")),
        StudyCriterion(
            "  all pairs within the sets", "", some("pair"), make_key_test("all_in_sets")
        ),
        StudyCriterion(
            f"held-out RMS <= {MAX_RATIO_TO_ORACLE} x oracle (fitted with the true effects)",
            "not close",
            judged,
            is_close_to_oracle,
            0.95,
        ),
        StudyCriterion(
            "  x that of points without the effect",
            "",
            judged,
            lambda r: r["final_mm"] <= MAX_RATIO_TO_ORACLE * r["known_mm"],
        ),
        StudyCriterion(
            "  the oracle itself",
            "",
            judged,
            lambda r: r["oracle_mm"] <= MAX_RATIO_TO_ORACLE * r["known_mm"],
        ),
        StudyCriterion(
            "three effects exactly right, each lambda (1 - rho^2) >= 25",
            "",
            three,
            make_key_test("all_right"),
        ),
        StudyCriterion(
            "  all triples within the sets", "", some("triple"), make_key_test("all_in_sets")
        ),
        StudyCriterion(
            "background of small effects: first name right",
            "",
            some("background"),
            is_first_name_right,
        ),
        StudyCriterion(
            "  truth in the set of the first", "", some("background"), make_key_test("in_set")
        ),
        StudyCriterion(
            "  a name that is not in the background either",
            "",
            some("background"),
            make_key_test("strange"),
        ),
        StudyCriterion(
            "wrong law of a known cause: first name right",
            "",
            some("wrong_law"),
            is_first_name_right,
        ),
        StudyCriterion("  unknown", "", some("wrong_law"), unknown),
        StudyCriterion("data fault named", "", some("fault"), is_first_name_right),
        StudyCriterion("crashed", "crash", rows, make_verdict_test("error"), 0.0, False),
    ]


def summarise_set_sizes_and_seconds(rows: Sequence[Row]) -> Iterator[tuple[TableCell, ...]]:
    """Lines of the headline that are no shares."""
    seen = [
        row
        for row in select_conditions(rows, *SINGLE_EFFECT_CONDITIONS)
        if row["lambda"] >= MIN_VISIBLE_DETECTABILITY
    ]
    sizes = np.array([row["set_size"] for row in seen if row["set_size"]], dtype=float)
    times = np.array([row["seconds"] for row in rows], dtype=float)
    for text, values, middle, bound in (
        ("one effect, lambda >= 50: mean size of the set", sizes, np.mean, "<= 2"),
        ("median seconds of a quick diagnosis", times, np.median, "< 0.5"),
    ):
        value, low, high = bootstrap_interval(values, middle)
        kept = "met" if value <= float(bound.split()[1]) else "MISSED"
        yield text, len(values), value, low, high, bound, kept if len(values) else ""


def bootstrap_interval(
    values: Array, statistic: Callable[[Array], Any]
) -> tuple[float, float, float]:
    """A mean or median, and its 95 % interval by resampling."""
    if not len(values):
        return float("nan"), float("nan"), float("nan")
    rng = np.random.default_rng(0)
    again = [float(statistic(rng.choice(values, len(values)))) for _ in range(500)]
    low, high = np.quantile(again, (0.025, 0.975))
    return float(statistic(values)), float(low), float(high)


# ---- other tables --------------------------------------------------------------------------------


def first_named_effect_or_verdict(row: Row) -> str:
    """Effect of the first name, or the verdict without one."""
    return str(row["first"][0]) if row["first"] else str(row["verdict"])


def build_confusion_table(rows: Sequence[Row]) -> Table:
    """Each true effect with its answers, the most frequent first."""
    seen = [
        row
        for row in select_conditions(rows, *SINGLE_EFFECT_CONDITIONS, "fault")
        if row["lambda"] >= MIN_VISIBLE_DETECTABILITY
    ]
    lines = []
    for effect in LIBRARY_LAW_NAMES:
        said = Counter(
            first_named_effect_or_verdict(row) for row in seen if row["truth"][0][0] == effect
        )
        often = ", ".join(f"{name} {count}" for name, count in said.most_common())
        lines += [(effect, said.total(), often)] if said else []
    return Table.from_rows(
        "true effect x first name, visible single effects",
        lines,
        "truth | runs d | first name, and how often",
    )


def build_effect_table(rows: Sequence[Row]) -> Table:
    """Names and sets of every effect that is visible alone."""
    seen = [
        row
        for row in select_conditions(rows, *SINGLE_EFFECT_CONDITIONS)
        if row["lambda"] >= MIN_VISIBLE_DETECTABILITY
    ]
    lines = []
    for effect in LIBRARY_EFFECTS:
        own = [row for row in seen if row["truth"][0][0] == effect]
        sized = [row["set_size"] for row in own if row["set_size"]]
        rivals = Counter(":".join(row["rival"]) for row in own if row["rival"][0])
        rho2 = [row["rho2"] for row in own if np.isfinite(row["rho2"])]
        if own:
            lines.append((
                effect, len(own), percentage_of_rows(own, lambda r: r["match"] == "exact"),
                percentage_of_rows(own, lambda r: r["match"] == "broad"),
                percentage_of_rows(own, make_key_test("in_set")),
                float(np.mean(sized)) if sized else float("nan"),
                percentage_of_rows(own, make_verdict_test("one_of")),
                percentage_of_rows(own, make_verdict_test("unknown")),
                percentage_of_rows(own, make_verdict_test("none")),
                float(np.median(rho2)) if rho2 else float("nan"),
                rivals.most_common(1)[0][0] if rivals else "",
            ))  # fmt: skip
    return Table.from_rows(
        "each effect, lambda >= 50 [%]",
        lines,
        "effect | runs d | right .1f | all/one .1f | in set .1f | set size .2f | "
        "one_of .1f | unknown .1f | none .1f | median rho^2 .3f | usual alternative",
    )


def group_rows_by_detectability(rows: Sequence[Row]) -> list[tuple[float, list[Row]]]:
    """Rows of the condition single by the lambda that was asked for."""
    single = select_conditions(rows, "single")
    powers = sorted({row["asked"] for row in single})
    return [(power, [row for row in single if row["asked"] == power]) for power in powers]


DETECTABILITY_MEASURES: tuple[tuple[str, Callable[[Row], bool]], ...] = (
    ("something found", lambda row: row["verdict"] not in ("none", "error")),
    ("truth in the set", make_key_test("in_set")),
    ("first name right", is_first_name_right),
)


def build_detectability_table(rows: Sequence[Row]) -> Table:
    """What is found, against lambda."""
    lines = [
        (power, len(own), *(percentage_of_rows(own, hit) for _, hit in DETECTABILITY_MEASURES),
         percentage_of_rows(own, make_verdict_test("unknown")))
        for power, own in group_rows_by_detectability(rows)
    ]  # fmt: skip
    title, shown = (
        "detectability: single effects against lambda [%]",
        [t for t, _ in DETECTABILITY_MEASURES],
    )
    return Table.from_rows(
        title, lines, "lambda .0f | runs d", *(f"{t} .1f" for t in shown), "unknown .1f"
    )


def build_gap_ratio_table(rows: Sequence[Row]) -> Table:
    """Held-out RMS against the oracle's, and the noise floor that was said against the true one."""
    lines = []
    for text, above, below in (
        ("held-out RMS / oracle", "final_mm", "oracle_mm"),
        ("held-out RMS, geometry only / oracle", "geometric_mm", "oracle_mm"),
        ("oracle / without the effect", "oracle_mm", "known_mm"),
        ("said noise floor / true", "said_floor_mm", "floor_mm"),
    ):
        for condition in dict.fromkeys(row["condition"] for row in rows):
            ratio = np.array(
                [row[above] / row[below] for row in select_conditions(rows, condition)], dtype=float
            )
            ratio = ratio[np.isfinite(ratio)]
            if len(ratio):
                quantiles = np.quantile(ratio, (0.05, 0.5, 0.95, 0.99))
                lines.append((text, condition, len(ratio), *map(float, quantiles),
                              float(ratio.max())))  # fmt: skip
    return Table.from_rows(
        "gap closed: quantiles of ratios",
        lines,
        "ratio | condition | runs d | 5 % .3f | 50 % .3f | 95 % .3f | 99 % .3f | largest .3f",
    )


# ---- pictures ------------------------------------------------------------------------------------

DETECTABILITY_COLOURS = ("#0072b2", "#009e73", "#d55e00")  # told apart by colour-blind eyes too


def draw_detectability_figure(rows: Sequence[Row]) -> Figure:
    """Shares against lambda with binomial bands."""
    figure = new_figure(7, 4.2)
    axes = figure.subplots()
    groups = group_rows_by_detectability(rows)
    powers = [power for power, _ in groups]
    for (text, hit), colour in zip(DETECTABILITY_MEASURES, DETECTABILITY_COLOURS, strict=True):
        shares = [percentage_of_rows(own, hit) for _, own in groups]
        bands = [clopper_pearson_interval(sum(map(hit, own)), len(own)) for _, own in groups]
        axes.plot(powers, shares, "o-", color=colour, label=text, ms=4)
        low, high = 100.0 * np.array(bands).reshape(-1, 2).T
        axes.fill_between(powers, low, high, color=colour, alpha=0.15, lw=0)
    axes.axvline(50.0, color="0.5", ls=":", lw=1)
    axes.set(xscale="log", ylim=(0, 102), xlabel="detectability lambda", ylabel="runs (%)")
    axes.grid(visible=True, alpha=0.3)
    axes.legend(frameon=False)
    return figure


# ---- the study -----------------------------------------------------------------------------------


QUICK_BLIND_CASE_STRIDE = 4  # of the cases of --quick, each so many-th by itself


@blind_study_command("blind_gap")
def main(study: Study, only: tuple[str, ...], every: int | None) -> None:
    """Blind judgement of diagnose."""
    cases = draw_all_cases(study.seed, QUICK_BLIND_STUDY_SIZE if study.quick else BlindStudySize())
    rows = study.sweep(
        run_case, select_cases(study, cases, only, every, QUICK_BLIND_CASE_STRIDE), "diagnoses"
    )
    found = build_blind_criteria(rows)
    tables = [
        build_criteria_table(found, *summarise_set_sizes_and_seconds(rows)),
        build_verdict_table(rows),
        build_confusion_table(rows),
        build_effect_table(rows),
        build_detectability_table(rows),
        build_gap_ratio_table(rows),
        build_misses_table(found, lambda row: f"{row['robot']} {row['poses']}", "oracle_mm"),
    ]
    save_blind_results(
        study, tables, rows, {"blind_gap_detectability": draw_detectability_figure(rows)}
    )
