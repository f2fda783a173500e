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
    ALL_MOTION_CAUSES,
    GIVEN_GEAR_RATIO,
    INTEGRATION_GENERATOR,
    LIBRARY_MOTION_CAUSES,
    MUJOCO_GENERATOR,
    OUTSIDE_MOTION_CAUSES,
    MotionCase,
    MotionCaseData,
    simulate_case,
)
from experiments.study_record import percentage_with_interval
from experiments.sweep import Study, study_options
from minimax_cal.core.arrays import Array
from minimax_cal.core.tables import Table
from minimax_cal.dynamics.diagnose import effect_family
from minimax_cal.dynamics.known_inputs import MotionKnown
from minimax_cal.dynamics.laws import USUAL_FRICTION_EFFECTS, list_testable_terms
from minimax_cal.dynamics.regressor import INERTIAL_PARAMETERS_PER_LINK
from minimax_cal.dynamics.result import MotionEffect
from minimax_cal.dynamics.torque_regression import FittedBody, TorqueColumns, TorqueDictionary
from minimax_cal.dynamics.torque_rows import (
    ArmMotion,
    AutoregressiveWhitening,
    MotionLogs,
    TorqueArm,
    estimate_autoregressive_whitening,
    resample_and_filter_runs,
)
from minimax_cal.selection.noise_model import orthonormal_basis

MIN_VISIBLE_TORQUE_SIZE = 50.0  # squared size, over the noise, from which a cause must be seen
MIN_SEPARABLE_TORQUE_SIZE = (
    25.0  # the same beside the nearest other law, from which it must be told from that
)
INTERVAL_95_SIGMAS = 1.96  # standard deviations of a 95 % interval
MASS_EFFECTS = ("payload", "link_inertia")  # names of masses that are not as given
SOUND_ARM_COUNT, CASES_PER_CONDITION = 80, 80  # sound arms; cases of each other condition
QUICK_MOTION_CASES = 4
SOUND_CONDITION, SINGLE_CONDITION, PAIR_CONDITION, OUTSIDE_CONDITION = (
    "sound",
    "single",
    "pair",
    "outside",
)
Name = tuple[str, str]  # effect, place


@dataclass(frozen=True)
class TorqueDiagnosisReport:
    """What a diagnosis says of a case, and what an oracle says could be said.

    truth: causes with their places; of a law outside the library its words.  main, minor: confirmed
    effects beside usual friction.  lone: whether one of the alternatives of the first is the truth.
    visible, separable: squared size over the noise of the (first) cause, alone and beside the
    nearest other law.  mass: of a payload that nobody told, as it is said, its standard deviation,
    and as it is [kg]; 0 where there is none.
    """

    case: MotionCase
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
    def names_a_cause(self) -> bool:
        """Whether a cause is identified that is more than usual friction."""
        return self.verdict == "named" and bool(self.main)

    @property
    def is_right(self) -> bool:
        """Whether the causes are those that are there, and no other."""
        return set(self.main) == set(self.truth) and self.verdict in ("named", "one_of")

    @property
    def is_related_to_truth(self) -> bool:
        """Whether what is named is the truth, of its family, or cannot be told from it."""
        if self.verdict not in ("named", "one_of") or not self.main:
            return self.is_hidden_drive_gain
        known = {(effect_family(effect), place) for effect, place in self.truth}
        said = {(effect_family(effect), place) for effect, place in (*self.main, *self.others)}
        if self.verdict == "one_of":
            return bool(known & said)
        return all((effect_family(effect), place) in known for effect, place in self.main)

    @property
    def is_hidden_drive_gain(self) -> bool:
        """Whether a drive gain is the truth, and is said to be no other than masses."""
        return self.truth[0][0] == "drive_gain" and "drive_gain" in self.not_testable

    @property
    def is_wrong(self) -> bool:
        """Whether a cause is identified that is not there."""
        return self.names_a_cause and not self.is_related_to_truth


def run_case(case: MotionCase) -> TorqueDiagnosisReport:
    """Make a case, let it be diagnosed, and only then look at the truth."""
    made = simulate_case(case)
    began = time.process_time()
    found = mc.diagnose_motion(made.robot, made.runs, ratio=GIVEN_GEAR_RATIO, payload=made.payload)
    seconds = time.process_time() - began
    beside = [e for e in found.effects if e.established and e.effect not in USUAL_FRICTION_EFFECTS]
    main = [e for e in beside if not e.minor]
    truth = tuple(effect_and_place(name, joint, made.robot.joints) for name, joint in case.causes)
    visible, separable = oracle_visibility(made, truth) if case.causes else (0.0, 0.0)
    return TorqueDiagnosisReport(
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
        mass=payload_mass_sigma_and_truth(found.effects, made.extra),
    )


def payload_mass_sigma_and_truth(
    effects: Sequence[MotionEffect], extra: float
) -> tuple[float, float, float]:
    """The mass of a payload that is named, its standard deviation, and the true one [kg]."""
    said = [one.parameters[0] for one in effects if one.effect == "payload"]
    return (said[0].value, said[0].sigma, extra) if said else (0.0, 0.0, extra)


def effect_and_place(name: str, joint: int, joints: int) -> Name:
    """A cause and where it is, as a diagnosis says it."""
    if name == "delay":
        return name, "all"
    if name == "payload":
        return name, f"L{joints}"
    return name, f"{'L' if name in MASS_EFFECTS else 'J'}{joint % joints + 1}"


# ---- the oracle ----------------------------------------------------------------------------------


def oracle_visibility(case_data: MotionCaseData, truth: tuple[Name, ...]) -> tuple[float, float]:
    """How clearly logs show what causes add, by themselves and beside the nearest other law.

    Squared sizes over the noise, whitened by the noise that was drawn, rigid body and usual
    friction taken out; where masses are the cause, usual friction alone.
    """
    logs = resample_and_filter_runs(case_data.runs)
    ones = np.ones(case_data.robot.joints)
    arm = TorqueArm.build(
        case_data.robot,
        ones,
        GIVEN_GEAR_RATIO * ones,
        MotionKnown(case_data.payload).payload_inertial_parameters_per_kg,
        logs,
    )
    scene = ArmMotion.build(arm, logs)
    columns = FittedBody.fit_with_friction(scene).build_torque_columns(scene)
    kept = logs.fitted_row_mask_by_joint.T
    white = estimate_autoregressive_whitening(
        logs, logs_with_torques(case_data, case_data.noise).row_torques.T[kept]
    )
    signal = white.whiten_rows(logs_with_torques(case_data, case_data.signal).row_torques.T[kept])
    fields = (
        basis_and_other_mass_spans if truth[0][0] in MASS_EFFECTS else basis_and_other_law_spans
    )
    basis, others = fields(columns, white, truth[0])
    left = signal - basis @ (basis.T @ signal)
    beside = [left - span @ (span.T @ left) for span in others]
    return float(left @ left), min((float(one @ one) for one in beside), default=np.inf)


def logs_with_torques(case_data: MotionCaseData, torques: Sequence[Array]) -> MotionLogs:
    """The logs with other torques."""
    return resample_and_filter_runs(
        [replace(r, torque=t) for r, t in zip(case_data.runs, torques, strict=True)]
    )


def basis_and_other_law_spans(
    columns: TorqueColumns, white: AutoregressiveWhitening, truth: Name
) -> tuple[Array, list[Array]]:
    """What is always fitted, and the span of every law but the true one."""
    laws = TorqueDictionary.build(columns, white)
    basis, spans = laws.problem.nuisance_basis, []
    for term in list_testable_terms(columns.scene, ())[0]:
        spec = laws.spec(term) if term.key != truth else None
        if spec is not None and term.effect != "payload":
            spans.append(orthonormal_complement(basis, spec.columns))
    return basis, spans


def basis_and_other_mass_spans(
    columns: TorqueColumns, white: AutoregressiveWhitening, truth: Name
) -> tuple[Array, list[Array]]:
    """Usual friction, and the span of every link but the true one."""
    scene, link = columns.scene, int(truth[1][1:]) - 1
    basis = orthonormal_basis(
        white.whiten_rows(columns.usual_friction_columns[white.is_row_fitted])
    )
    rows = white.whiten_rows(
        np.moveaxis(scene.logs.filter_to_rows(scene.regressor), 1, 0)[white.is_row_fitted]
    )
    parts = [
        rows[:, INERTIAL_PARAMETERS_PER_LINK * k : INERTIAL_PARAMETERS_PER_LINK * (k + 1)]
        for k in range(scene.logs.joint_count)
    ]
    return basis, [orthonormal_complement(basis, part) for k, part in enumerate(parts) if k != link]


def orthonormal_complement(basis: Array, columns: Array) -> Array:
    """Orthonormal columns, with a basis taken out."""
    return orthonormal_basis(columns - basis @ (basis.T @ columns))


# ---- cases and tables ----------------------------------------------------------------------------


def draw_all_cases(seed: int, sound_arm_count: int, cases_per_condition: int) -> list[MotionCase]:
    """All cases, each with a seed of its own; library and outside laws come round in turn."""
    rng = np.random.default_rng(seed)
    library, outside, out = (
        list(LIBRARY_MOTION_CAUSES),
        list(OUTSIDE_MOTION_CAUSES),
        list[MotionCase](),
    )

    def add(condition: str, number: int, *names: str) -> None:
        causes = tuple((name, place(name)) for name in names)
        generator = (MUJOCO_GENERATOR, INTEGRATION_GENERATOR)[number % 2]
        out.append(MotionCase(condition, generator, causes, int(rng.integers(2**31))))

    def place(name: str) -> int:
        return 1 if name == "link_inertia" else int(rng.integers(12))

    for number in range(sound_arm_count):
        add(SOUND_CONDITION, number)
    for number in range(cases_per_condition):
        add(SINGLE_CONDITION, number // len(library) + number, library[number % len(library)])
        add(OUTSIDE_CONDITION, number // len(outside) + number, outside[number % len(outside)])
    for number in range(cases_per_condition // 2):
        add(PAIR_CONDITION, number, *rng.choice(library, 2, replace=False).tolist())
    return out


def select_visible_cases(
    reports: Sequence[TorqueDiagnosisReport], condition: str, min_visible: float
) -> list[TorqueDiagnosisReport]:
    """Cases of a condition that the logs show, and tell from every other law of the library."""
    cases = [one for one in reports if one.case.condition == condition]
    return [
        one
        for one in cases
        if one.visible >= min_visible and one.separable >= MIN_SEPARABLE_TORQUE_SIZE
    ]


def build_questions_table(reports: Sequence[TorqueDiagnosisReport]) -> Table:
    """Each question, with its interval and what was asked for."""
    sound, pairs = (
        [one for one in reports if one.case.condition == name]
        for name in (SOUND_CONDITION, PAIR_CONDITION)
    )
    single, clear = (
        select_visible_cases(reports, SINGLE_CONDITION, MIN_VISIBLE_TORQUE_SIZE),
        select_visible_cases(reports, OUTSIDE_CONDITION, 0.0),
    )
    paid = [one for one in single if one.truth[0][0] == "payload"]
    asked: list[tuple[str, list[TorqueDiagnosisReport], Iterable[bool], str]] = [
        (
            "sound: a cause named or doubted",
            sound,
            (bool(one.main) or one.verdict == "unknown" for one in sound),
            "<= 3",
        ),
        ("sound: a minor effect confirmed", sound, (bool(one.minor) for one in sound), ""),
        ("single: right", single, (one.is_right for one in single), ">= 75"),
        (
            "single: right, its family, or not distinguishable from it",
            single,
            (one.is_related_to_truth for one in single),
            ">= 92",
        ),
        ("single: sure and wrong", single, (one.is_wrong for one in single), "<= 4"),
        ("single: nothing named", single, (not one.main for one in single), ""),
        (
            "payload: the link named, its mass within 3 %",
            paid,
            (abs(value - true) < 0.03 * true for value, _, true in (o.mass for o in paid)),
            "",
        ),
        (
            "payload: the true mass within its 95 % interval",
            paid,
            (
                abs(value - true) < INTERVAL_95_SIGMAS * sigma
                for value, sigma, true in (o.mass for o in paid)
            ),
            "",
        ),
        ("pair: both named, nothing else", pairs, (one.is_right for one in pairs), ""),
        ("pair: something named that is not there", pairs, (one.is_wrong for one in pairs), ""),
        ("outside: unexplained said", clear, (one.verdict == "unknown" for one in clear), ">= 80"),
        ("outside: sure and wrong", clear, (one.names_a_cause for one in clear), "<= 8"),
    ]
    rows = []
    for question, own, holds, limit in asked:
        yes = sum(holds)
        share, low, high = percentage_with_interval(yes, len(own))
        rows.append((question, len(own), yes, share, f"{low:.0f} to {high:.0f}", limit))
    return Table.from_rows(
        "Torques, blind", rows, "question | cases d | yes d | % .1f | 95 % interval | asked %"
    )


def build_causes_table(reports: Sequence[TorqueDiagnosisReport]) -> Table:
    """What is said of each cause that the logs show and tell from others."""
    rows, every = (
        [],
        (
            *select_visible_cases(reports, SINGLE_CONDITION, MIN_VISIBLE_TORQUE_SIZE),
            *select_visible_cases(reports, OUTSIDE_CONDITION, 0.0),
        ),
    )
    for name in ALL_MOTION_CAUSES:
        own = [one for one in every if one.case.causes[0][0] == name]
        kinds = [
            (one.is_right, one.is_related_to_truth, one.verdict == "unknown",
             not one.main and one.verdict != "unknown",
             one.is_wrong if name in LIBRARY_MOTION_CAUSES else one.names_a_cause) for one in own
        ]  # fmt: skip
        if own:
            rows.append((name, len(own), *np.sum(kinds, axis=0).tolist()))
    return Table.from_rows(
        "Causes that the logs show",
        rows,
        "cause | cases d | right d | family d | unexplained d | nothing said d | sure and wrong d",
    )


def case_to_json(report: TorqueDiagnosisReport) -> dict[str, object]:
    """A case for JSON."""
    names = ("truth", "verdict", "main", "minor", "unexplained")
    return {
        **{
            name: getattr(report.case, name)
            for name in ("condition", "generator", "seed", "causes")
        },
        **{name: getattr(report, name) for name in names},
        "alternatives": report.others,
        "cpu_s": report.seconds,
        "visible": min(report.visible, 1e12),
        "separable": min(report.separable, 1e12),
    }


@study_options("motion_blind")
@click.option("--arms", type=int, default=SOUND_ARM_COUNT, show_default=True, help="Sound arms.")
@click.option("--cases", type=int, default=CASES_PER_CONDITION, show_default=True,
              help="Single causes, and laws outside; half as many pairs.")  # fmt: skip
def main(study: Study, arms: int, cases: int) -> None:
    """Causes of torque, withheld: are they named, and is what has no name said to have none?"""
    if study.quick:
        arms = cases = QUICK_MOTION_CASES
    told = study.sweep(run_case, draw_all_cases(study.seed, arms, cases), "diagnoses")
    tables = [build_questions_table(told), build_causes_table(told)]
    keys = ("question", "cases", "yes", "percent", "interval", "asked")
    study.save(
        tables, {"questions": tables[0].to_records(*keys), "cases": [*map(case_to_json, told)]}
    )
