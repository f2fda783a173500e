"""Which rules of the diagnosis pay?  Each is taken out in turn, on seeds no rule has seen.

    python -m experiments.ablation [--quick] [--out FOLDER] [--json FILE] [--seed N] [--jobs N]
        [--only RULE]... [--arms LIST] [--splits N]

Every arm of a small `machine_gap`, and every split of real arms, is diagnosed with all rules and
without each.  A rule pays if without it more answers turn bad than good; one that changes nothing,
or as much for the better, has to go.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from importlib import import_module
from typing import Any

import click
import numpy as np
from scipy.stats import binomtest

import minimax_cal as mc
from experiments import sweep
from experiments.blind_gap import Row, clean, number_of
from experiments.external import REAL, arm_of, asked_for
from experiments.machine_gap import SEEN, Size, diagnosed, likeness, plan, right, score, separable
from experiments.machines import Asked, make
from experiments.sweep import Study, study_options
from minimax_cal.ground.errors import OptionError
from minimax_cal.ground.tables import Cell, Table

SIZE = Size(sound=8, single=1, orders=3, outside=1, pair=10, triple=5, mechanism=1)
FEWER = Size(sound=1, single=0, orders=0, outside=0, pair=1, triple=0, mechanism=0)
ALL = "all rules"


def nothing(*_: Any, **__: Any) -> tuple[()]:
    """None found."""
    return ()


def never(*_: Any, **__: Any) -> bool:
    """Not so."""
    return False


def always(*_: Any, **__: Any) -> bool:
    """So."""
    return True


def zero(*_: Any, **__: Any) -> float:
    """Nothing is owed."""
    return 0.0


def one(*_: Any, **__: Any) -> float:
    """As usual; certain."""
    return 1.0


def first(value: Any, *_: Any, **__: Any) -> Any:
    """What was given."""
    return value


def second(_: Any, value: Any, *__: Any, **___: Any) -> Any:
    """What was given second."""
    return value


def first_two(lib: Any, fits: Any, *_: Any, **__: Any) -> tuple[Any, Any]:
    """What was given."""
    return lib, fits


def no_prior(_: Any, values: Any, *__: Any) -> Any:
    """No weights."""
    return np.zeros(len(values))


def no_penalty(kind: Any, *_: Any) -> Any:
    """Any value costs nothing."""
    return np.zeros(len(kind.free))


def no_maps(*_: Any, **__: Any) -> Any:
    """No joint has one."""
    return import_module("minimax_cal.diagnosing.error_maps").NO_MAPS


# rule: what stands in its place, by module, or class, and name
RULES: dict[str, dict[str, object]] = {
    "replacement": {"evidence.selection:refined": first_two},
    "signs cost evidence": {"evidence.selection:against_signs": zero},
    "noise along a field by groups": {"evidence.bench:inflation": one},
    "usual sizes": {"evidence.bench:prior_penalty": no_penalty},
    "alternatives by luck": {"evidence.alternatives:LUCK": 0.0},
    "alternatives needed beside": {"evidence.bench:Bench.p_beside": one},
    "alternatives from subsamples": {"evidence.stability:Repeats.instead_of": nothing},
    "alternatives not testable": {"diagnosing.causes:with_untested": first},
    "flipped signs": {"evidence.remains:SCATTERS": 2.0},
    "worth of a remainder": {"diagnosing.what_remains:WORTH": 0.0},
    "each joint's own scatter": {"diagnosing.causes:weighed_anew": first},
    "joints read back": {"diagnosing.causes:read_back_fault": nothing},
    "mostly loose": {"diagnosing.verdict:mostly_loose": never},
    "ends of an angle or the time": {"diagnosing.gap:ends_of": nothing},
    "priors of effects by their size": {
        "diagnosing.joint:weights_of": no_prior,
        "diagnosing.trial:weights_of": no_prior,
    },
    "waves sought again by groups": {"diagnosing.error_maps:fine_waves": nothing},
    "maps of joints": {"diagnosing.diagnose:error_maps": no_maps},
    "causes beside maps": {"diagnosing.diagnose:beside_curves": second},
    "halves agree on a wave": {"modelling.periodogram:Line.stays": always},
    "many wrong points": {"diagnosing.diagnose:unpulled": nothing},
    "above the known noise": {"diagnosing.last_question:MAX_OVER_NOISE": 1e9},
}


@contextmanager
def without(rule: str) -> Iterator[None]:
    """Everything but a rule."""
    kept: list[tuple[Any, str, object]] = []
    for place, instead in RULES.get(rule, {}).items():
        module, _, path = place.partition(":")
        owner: Any = import_module(f"minimax_cal.{module}")
        *classes, name = path.split(".")
        for part in classes:
            owner = getattr(owner, part)
        kept.append((owner, name, getattr(owner, name)))
        setattr(owner, name, instead)
    try:
        yield
    finally:
        for owner, name, had in kept:
            setattr(owner, name, had)


@dataclass(frozen=True)
class Job:
    """An arm, and the rules that are taken out.

    arm: a simulated one, or the name of a real one.
    """

    arm: Asked | str
    rules: tuple[str, ...]
    seed: int = 0


def run(job: Job) -> dict[str, Row]:
    """What is said with all rules, and without each."""
    if isinstance(job.arm, str):
        robot, data = arm_of(job.arm)

        def answer() -> Row:
            return of_real(job.arm, mc.diagnose(robot, data, seed=job.seed, quick=True).to_dict())
    else:
        made = make(job.arm)
        alike = likeness(made)

        def answer() -> Row:
            return score(job.arm, made, diagnosed(made), alike)  # type: ignore[arg-type]

    out = {}
    for rule in (ALL, *job.rules):
        began = time.process_time()
        with without(rule):
            row = answer()
        out[rule] = row | {"cpu": time.process_time() - began}
    return out


def of_real(arm: Asked | str, said: Row) -> Row:
    """An answer about a real arm."""
    sure = [e for e in said["effects"] if e["established"]]
    return {
        "condition": "real",
        "arm": arm,
        "verdict": said["verdict"],
        "names": [[e["effect"], e["place"]] for e in sure],
        "final_mm": number_of(said["gap"], "holdout_rms_mm", "final"),
    }


# ---- what a rule is worth ------------------------------------------------------------------------


def good(row: Row) -> bool:
    """Whether an answer is what it should be."""
    if row["condition"] == "sound":
        return not row["names"] and row["verdict"] != "unknown"
    if row["condition"] in ("outside", "mechanism"):
        return row["left"] < SEEN or row["verdict"] in ("unknown", "not_repeatable")
    return right(row) if separable(row) else not row["strange"]


def false_name(row: Row) -> bool:
    """Whether something is named for sure that is not there."""
    return bool(row["verdict"] == "named" and row["strange"])


def line_of(rule: str, rows: Sequence[dict[str, Row]]) -> tuple[Cell, ...]:
    """What changes without a rule."""
    made = [(r[ALL], r[rule]) for r in rows if r[ALL]["condition"] != "real"]
    arms = [(r[ALL], r[rule]) for r in rows if r[ALL]["condition"] == "real"]

    def turned(of: Callable[[Row], bool]) -> tuple[int, int]:
        pairs = [(of(before), of(after)) for before, after in made]
        return pairs.count((True, False)), pairs.count((False, True))

    lost, gained = turned(good)
    fewer, more = turned(false_name)
    chance = binomtest(lost, lost + gained).pvalue if lost + gained else 1.0
    ratio = [after["final_mm"] / before["final_mm"] for before, after in (*made, *arms)]
    worse = sum(one > 1.01 for one in ratio)
    real = [after["final_mm"] / before["final_mm"] for before, after in arms]
    other = sum(a["names"] != b["names"] or a["verdict"] != b["verdict"] for a, b in arms)
    cpu = [sum(row["cpu"] for row in some) for some in zip(*(*made, *arms), strict=True)]
    return (
        rule,
        len(made),
        lost,
        gained,
        chance,
        more - fewer,
        worse,
        sum(one < 0.99 for one in ratio),
        len(arms),
        other,
        max(real, default=float("nan")),
        100.0 * (cpu[1] / cpu[0] - 1.0),
    )


def worth(rules: Sequence[str], rows: Sequence[dict[str, Row]]) -> Table:
    """Each rule in a line."""
    return Table(
        "without a rule: answers that turn bad and good, by McNemar's test; held-out RMS",
        ("rule", "arms", "turn bad", "turn good", "p-value", "more false names", "RMS > 1.01",
         "RMS < 0.99", "real arms", "say other", "largest RMS ratio", "CPU %"),
        tuple(line_of(rule, rows) for rule in rules),
        ("", "d", "d", "d", ".2g", "d", "d", "d", "d", "d", ".3f", "+.0f"),
    )  # fmt: skip


@click.command()
@study_options("ablation")
@click.option("--only", multiple=True, help="A rule to take out; may be repeated.")
@click.option("--arms", default=",".join(REAL), show_default=True, help="Real arms.")
@click.option("--simulated/--no-simulated", default=True, help="Simulated arms as well.")
@click.option("--splits", type=int, default=1, show_default=True, help="Of each real arm.")
def main(study: Study, only: tuple[str, ...], arms: str, simulated: bool, splits: int) -> None:
    """Which rules of the diagnosis pay."""
    for name in only:
        if name not in RULES:
            raise OptionError(f"--only {name}: choose {', '.join(RULES)}")
    rules = only or tuple(list(RULES)[:2] if study.quick else RULES)
    real = asked_for(arms) if arms and not study.quick else []
    jobs = [Job(arm, rules, seed) for arm in real for seed in range(splits)]
    cases = plan(study.seed, FEWER if study.quick else SIZE)
    cases = cases if simulated else []
    jobs += [Job(replace(case, poses=60) if study.quick else case, rules) for case in cases]
    rows = study.sweep(run, jobs, "arms with and without each rule")
    study.save([worth(rules, rows)], {"rows": [clean([*row.values()]) for row in rows]})


if __name__ == "__main__":
    sweep.start(__file__)
