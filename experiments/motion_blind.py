"""Are causes of torque named rightly?  Blind: arms are made whose file and logs withhold the truth.

    python -m experiments.motion_blind [--quick] [--out FOLDER] [--json FILE] [--seed N] [--jobs N]
        [--arms N] [--cases N]

Arms of three and four joints, half by MuJoCo and half by an integration of LuGre friction: sound
ones, each cause of the library alone, two at once, and laws that the library does not hold.  An
oracle that knows the truth says which causes these logs can show at all, and tell from every other.
"""

from __future__ import annotations

import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import click
import numpy as np

import minimax_cal as mc
from experiments.motion_cases import (
    CAUSES,
    LIBRARY,
    MUJOCO,
    OUTSIDE,
    OWN,
    RATIO,
    Case,
    Made,
    make,
)
from experiments.record import rate
from experiments.sweep import Study, study_options
from minimax_cal.dynamics.diagnose import family
from minimax_cal.dynamics.given import MotionKnown
from minimax_cal.dynamics.laws import USUAL, terms_of
from minimax_cal.dynamics.model import Body, Columns, TorqueLaws
from minimax_cal.dynamics.regressor import PER_LINK
from minimax_cal.dynamics.result import MotionEffect
from minimax_cal.dynamics.rows import Arm, Logs, Scene, Whitening, prepare, whitening
from minimax_cal.evidence.noise import orthonormal
from minimax_cal.ground.arrays import Array
from minimax_cal.ground.tables import Table

VISIBLE = 50.0  # squared size, over the noise, from which a cause must be seen
SEPARABLE = 25.0  # the same beside the nearest other law, from which it must be told from that
SIGMAS = 1.96  # standard deviations of a 95 % interval
MASSES = ("payload", "link_inertia")  # names of masses that are not as given
ARMS, CASES = 80, 80  # sound arms; cases of each other condition
QUICK = 4
SOUND, SINGLE, PAIR, BEYOND = "sound", "single", "pair", "outside"
Name = tuple[str, str]  # effect, place


@dataclass(frozen=True)
class Told:
    """What a diagnosis says of a case, and what an oracle says could be said.

    truth: causes with their places; of a law outside the library its words.  main, minor: confirmed
    effects beside usual friction.  lone: whether one of the alternatives of the first is the truth.
    visible, separable: squared size over the noise of the (first) cause, alone and beside the
    nearest other law.  mass: of a payload that nobody told, as it is said, its standard deviation,
    and as it is [kg]; 0 where there is none.
    """

    case: Case
    verdict: str
    truth: tuple[Name, ...]
    main: tuple[Name, ...]
    minor: tuple[Name, ...]
    others: tuple[Name, ...]
    unexplained: tuple[Name, ...]
    not_testable: tuple[str, ...]
    visible: float
    separable: float
    seconds: float
    mass: tuple[float, float, float]

    @property
    def names(self) -> bool:
        """Whether a cause is identified that is more than usual friction."""
        return self.verdict == "named" and bool(self.main)

    @property
    def right(self) -> bool:
        """Whether the causes are those that are there, and no other."""
        return set(self.main) == set(self.truth) and self.verdict in ("named", "one_of")

    @property
    def related(self) -> bool:
        """Whether what is named is the truth, of its family, or cannot be told from it."""
        if self.verdict not in ("named", "one_of") or not self.main:
            return self.gain_hidden
        known = {(family(effect), place) for effect, place in self.truth}
        said = {(family(effect), place) for effect, place in (*self.main, *self.others)}
        if self.verdict == "one_of":
            return bool(known & said)
        return all((family(effect), place) in known for effect, place in self.main)

    @property
    def gain_hidden(self) -> bool:
        """Whether a drive gain is the truth, and is said to be no other than masses."""
        return self.truth[0][0] == "drive_gain" and "drive_gain" in self.not_testable

    @property
    def wrong(self) -> bool:
        """Whether a cause is identified that is not there."""
        return self.names and not self.related


def run(case: Case) -> Told:
    """Make a case, let it be diagnosed, and only then look at the truth."""
    made = make(case)
    began = time.process_time()
    found = mc.diagnose_motion(made.robot, made.runs, ratio=RATIO, payload=made.payload)
    seconds = time.process_time() - began
    beside = [e for e in found.effects if e.established and e.effect not in USUAL]
    main = [e for e in beside if not e.minor]
    truth = tuple(place_of(name, joint, made.robot.joints) for name, joint in case.causes)
    visible, separable = oracle(made, truth) if case.causes else (0.0, 0.0)
    return Told(
        case=case,
        verdict=found.verdict,
        truth=truth,
        main=tuple((e.effect, e.place) for e in main),
        minor=tuple((e.effect, e.place) for e in beside if e.minor),
        others=tuple((a.effect, a.place) for e in main[:1] for a in e.alternatives),
        unexplained=tuple((one.place, one.follows) for one in found.unexplained),
        not_testable=tuple(dict.fromkeys(one.effect for one in found.not_testable)),
        visible=visible,
        separable=separable,
        seconds=seconds,
        mass=mass_of(found.effects, made.extra),
    )


def mass_of(effects: Sequence[MotionEffect], extra: float) -> tuple[float, float, float]:
    """The mass of a payload that is named, its standard deviation, and the true one [kg]."""
    said = [one.parameters[0] for one in effects if one.effect == "payload"]
    return (said[0].value, said[0].sigma, extra) if said else (0.0, 0.0, extra)


def place_of(name: str, joint: int, joints: int) -> Name:
    """A cause and where it is, as a diagnosis says it."""
    if name == "delay":
        return name, "all"
    if name == "payload":
        return name, f"L{joints}"
    return name, f"{'L' if name in MASSES else 'J'}{joint % joints + 1}"


# ---- the oracle ----------------------------------------------------------------------------------


def oracle(made: Made, truth: tuple[Name, ...]) -> tuple[float, float]:
    """How clearly logs show what causes add, by themselves and beside the nearest other law.

    Squared sizes over the noise, whitened by the noise that was drawn, rigid body and usual
    friction taken out; where masses are the cause, usual friction alone.
    """
    logs = prepare(made.runs)
    ones = np.ones(made.robot.joints)
    arm = Arm.of(made.robot, ones, RATIO * ones, MotionKnown(made.payload).load, logs)
    scene = Scene.of(arm, logs)
    columns = Body.fit_with_friction(scene).build_columns(scene)
    kept = logs.fitted.T
    white = whitening(logs, of_runs(made, made.noise).y.T[kept])
    signal = white.white(of_runs(made, made.signal).y.T[kept])
    fields = by_masses if truth[0][0] in MASSES else by_laws
    basis, others = fields(columns, white, truth[0])
    left = signal - basis @ (basis.T @ signal)
    beside = [left - span @ (span.T @ left) for span in others]
    return float(left @ left), min((float(one @ one) for one in beside), default=np.inf)


def of_runs(made: Made, torques: Sequence[Array]) -> Logs:
    """The logs with other torques."""
    return prepare([replace(r, torque=t) for r, t in zip(made.runs, torques, strict=True)])


def by_laws(columns: Columns, white: Whitening, truth: Name) -> tuple[Array, list[Array]]:
    """What is always fitted, and the span of every law but the true one."""
    laws = TorqueLaws.of(columns, white)
    basis, spans = laws.problem.basis, []
    for term in terms_of(columns.scene, ())[0]:
        spec = laws.spec(term) if term.key != truth else None
        if spec is not None and term.effect != "payload":
            spans.append(beside(basis, spec.columns))
    return basis, spans


def by_masses(columns: Columns, white: Whitening, truth: Name) -> tuple[Array, list[Array]]:
    """Usual friction, and the span of every link but the true one."""
    scene, link = columns.scene, int(truth[1][1:]) - 1
    basis = orthonormal(white.white(columns.usual[white.kept]))
    rows = white.white(np.moveaxis(scene.logs.filtered(scene.regressor), 1, 0)[white.kept])
    parts = [rows[:, PER_LINK * k : PER_LINK * (k + 1)] for k in range(scene.logs.joints)]
    return basis, [beside(basis, part) for k, part in enumerate(parts) if k != link]


def beside(basis: Array, columns: Array) -> Array:
    """Orthonormal columns, with a basis taken out."""
    return orthonormal(columns - basis @ (basis.T @ columns))


# ---- cases and tables ----------------------------------------------------------------------------


def plan(seed: int, arms: int, cases: int) -> list[Case]:
    """All cases, each with a seed of its own; library and outside laws come round in turn."""
    rng = np.random.default_rng(seed)
    library, outside, out = list(LIBRARY), list(OUTSIDE), list[Case]()

    def add(condition: str, number: int, *names: str) -> None:
        causes = tuple((name, place(name)) for name in names)
        generator = (MUJOCO, OWN)[number % 2]
        out.append(Case(condition, generator, causes, int(rng.integers(2**31))))

    def place(name: str) -> int:
        return 1 if name == "link_inertia" else int(rng.integers(12))

    for number in range(arms):
        add(SOUND, number)
    for number in range(cases):
        add(SINGLE, number // len(library) + number, library[number % len(library)])
        add(BEYOND, number // len(outside) + number, outside[number % len(outside)])
    for number in range(cases // 2):
        add(PAIR, number, *rng.choice(library, 2, replace=False).tolist())
    return out


def shown(told: Sequence[Told], condition: str, least: float) -> list[Told]:
    """Cases of a condition that the logs show, and tell from every other law of the library."""
    cases = [one for one in told if one.case.condition == condition]
    return [one for one in cases if one.visible >= least and one.separable >= SEPARABLE]


def questions_table(told: Sequence[Told]) -> Table:
    """Each question, with its interval and what was asked for."""
    sound, pairs = ([one for one in told if one.case.condition == name] for name in (SOUND, PAIR))
    single, clear = shown(told, SINGLE, VISIBLE), shown(told, BEYOND, 0.0)
    paid = [one for one in single if one.truth[0][0] == "payload"]
    asked: list[tuple[str, list[Told], Iterable[bool], str]] = [
        ("sound: a cause named or doubted", sound,
         (bool(one.main) or one.verdict == "unknown" for one in sound), "<= 3"),
        ("sound: a minor effect confirmed", sound, (bool(one.minor) for one in sound), ""),
        ("single: right", single, (one.right for one in single), ">= 75"),
        ("single: right, its family, or not distinguishable from it", single,
         (one.related for one in single), ">= 92"),
        ("single: sure and wrong", single, (one.wrong for one in single), "<= 4"),
        ("single: nothing named", single, (not one.main for one in single), ""),
        ("payload: the link named, its mass within 3 %", paid,
         (abs(value - true) < 0.03 * true for value, _, true in (o.mass for o in paid)), ""),
        ("payload: the true mass within its 95 % interval", paid,
         (abs(value - true) < SIGMAS * sigma for value, sigma, true in (o.mass for o in paid)), ""),
        ("pair: both named, nothing else", pairs, (one.right for one in pairs), ""),
        ("pair: something named that is not there", pairs, (one.wrong for one in pairs), ""),
        ("outside: unexplained said", clear, (one.verdict == "unknown" for one in clear), ">= 80"),
        ("outside: sure and wrong", clear, (one.names for one in clear), "<= 8"),
    ]  # fmt: skip
    rows = []
    for question, own, holds, limit in asked:
        yes = sum(holds)
        share, low, high = rate(yes, len(own))
        rows.append((question, len(own), yes, share, f"{low:.0f} to {high:.0f}", limit))
    return Table.made(
        "Torques, blind", rows, "question | cases d | yes d | % .1f | 95 % interval | asked %"
    )


def causes_table(told: Sequence[Told]) -> Table:
    """What is said of each cause that the logs show and tell from others."""
    rows, every = [], (*shown(told, SINGLE, VISIBLE), *shown(told, BEYOND, 0.0))
    for name in CAUSES:
        own = [one for one in every if one.case.causes[0][0] == name]
        kinds = [
            (one.right, one.related, one.verdict == "unknown",
             not one.main and one.verdict != "unknown",
             one.wrong if name in LIBRARY else one.names) for one in own
        ]  # fmt: skip
        if own:
            rows.append((name, len(own), *np.sum(kinds, axis=0).tolist()))
    return Table.made(
        "Causes that the logs show",
        rows,
        "cause | cases d | right d | family d | unexplained d | nothing said d | sure and wrong d",
    )


def record(one: Told) -> dict[str, object]:
    """A case for JSON."""
    names = ("truth", "verdict", "main", "minor", "unexplained")
    return {
        **{name: getattr(one.case, name) for name in ("condition", "generator", "seed", "causes")},
        **{name: getattr(one, name) for name in names},
        "alternatives": one.others, "cpu_s": one.seconds,
        "visible": min(one.visible, 1e12), "separable": min(one.separable, 1e12),
    }  # fmt: skip


@study_options("motion_blind")
@click.option("--arms", type=int, default=ARMS, show_default=True, help="Sound arms.")
@click.option("--cases", type=int, default=CASES, show_default=True,
              help="Single causes, and laws outside; half as many pairs.")  # fmt: skip
def main(study: Study, arms: int, cases: int) -> None:
    """Causes of torque, withheld: are they named, and is what has no name said to have none?"""
    if study.quick:
        arms = cases = QUICK
    told = study.sweep(run, plan(study.seed, arms, cases), "diagnoses")
    tables = [questions_table(told), causes_table(told)]
    keys = ("question", "cases", "yes", "percent", "interval", "asked")
    study.save(tables, {"questions": tables[0].records(*keys), "cases": [*map(record, told)]})
