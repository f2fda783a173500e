"""The diagnosis as a whole: verdicts, faults of the data, the ladder, words backed by numbers."""

import json
import re
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from conftest import run, shared
from numpy.testing import assert_allclose
from problems_fit import numbers, study_of

import minimax_cal as mc
from experiments import machines
from experiments.gap_cases import GapCase, GapCause, SealedArm, build_and_measure_arm
from minimax_cal.core.arrays import Array
from minimax_cal.diagnosing import cause_search as search
from minimax_cal.diagnosing.budget_steps import estimate_explained_fraction
from minimax_cal.diagnosing.cause_search import FoundCauses, judge_causes
from minimax_cal.diagnosing.confirmation import (
    find_unconfirmed,
    has_frequencies,
    is_mostly_unconfirmed,
    list_equivalent_keys,
    select_frequent,
)
from minimax_cal.diagnosing.diagnose import describe_contradiction
from minimax_cal.diagnosing.diagnosis import VERDICTS, AlternativeEffect, BudgetStep, Finding
from minimax_cal.diagnosing.diagnosis_sentences import CONTRADICTION_SENTENCE, VERDICT_OPENINGS
from minimax_cal.diagnosing.findings import add_untestable_alternatives
from minimax_cal.diagnosing.remaining_error import NO_REMAINING_COMPONENT
from minimax_cal.diagnosing.study import LinearisedGeometry
from minimax_cal.diagnosing.verdict import (
    ABOVE_NOISE_TEXT,
    CHANGING_CAUSES_TEXT,
    ONLY_MINOR_TEXT,
    TOO_FEW_POSES_TEXT,
    UNHELPFUL_CAUSES_TEXT,
    NoiseLimits,
    adjust_verdict_to_noise,
    describe_why_unconfirmed,
)
from minimax_cal.fitting.accuracy import Accuracy
from minimax_cal.fitting.data_slips import correct_misplaced_rows, match_misplaced_rows
from minimax_cal.fitting.noise_floor import AT_MOST, REPEATS, NoiseFloor
from minimax_cal.modelling.arm_laws import build_library_of_testable_arm_laws
from minimax_cal.modelling.cell import Cell, build_measurements_at_rest
from minimax_cal.modelling.effects.table import Term
from minimax_cal.modelling.simulate import Simulation
from minimax_cal.robots import kinematics
from minimax_cal.robots.gravity_torques import STANDARD_GRAVITY, assumed_link_masses_and_centres
from minimax_cal.robots.joint_sampling import random_joint_values_above_floor
from minimax_cal.robots.transforms import build_transform
from minimax_cal.selection import thresholds
from minimax_cal.selection.forward_selection import select_effects_by_evidence
from minimax_cal.selection.stability_selection import SubsampleSelections
from minimax_cal.selection.thresholds import (
    MIN_CONFIRMED_FREQUENCY,
    MIN_MODEL_FREQUENCY,
    REMAINING_STRUCTURE_P_VALUE,
    SUBSAMPLE_PART_COUNT,
    SUBSAMPLE_ROUND_COUNT,
)


def sealed(*causes: GapCause, seed: int = 1, condition: str = "single") -> SealedArm:
    return build_and_measure_arm(GapCase("irb2600", condition, causes, seed=seed))


@cache
def diagnosed(*causes: GapCause, seed: int = 1) -> mc.Diagnosis:
    """What is found on an arm, which is sound without causes."""
    made = sealed(*causes, seed=seed, condition="single" if causes else "none")
    return mc.diagnose(made.robot, made.data, quick=True)


@pytest.fixture(scope="module")
def plain() -> mc.Diagnosis:
    return diagnosed(GapCause("backlash", "J2", 1000.0))


def test_nothing_is_named_on_a_sound_arm() -> None:
    made, found = sealed(condition="none"), diagnosed()
    assert found.verdict == "none"
    assert found.effects == ()
    assert abs(found.floor.value / (1e3 * made.floor) - 1.0) < 0.1
    assert (found.meets_floor, found.floor_known) == (True, True)
    assert found.headline().startswith(VERDICT_OPENINGS["none"].removesuffix("."))


def test_the_gear_of_a_drive_that_moves_two_joints_is_named(rng: np.random.Generator) -> None:
    """Joint 3 turns by q3 - q2, drive 2 winds up by what it carries: minus the energy's slope."""
    arm = mc.load_robot("irb2600")
    mass, com = assumed_link_masses_and_centres(arm.mdh)
    linked = np.eye(6) - np.eye(6)[:, 2:3] * np.eye(6)[1]
    robot = replace(arm, mass=mass, com=com, coupling=linked)
    spots = np.array([[0.1, 0.0, 0.05], [-0.05, 0.09, 0.05], [-0.05, -0.08, 0.06]])
    q, carried = random_joint_values_above_floor(robot, 60, rng), rng.choice([0.0, 40.0], 60)

    def energy(values: Array) -> Array:
        turned, out = values @ linked.T * arm.sign, 0.0
        for i in range(6):
            last = kinematics.forward_kinematics(
                arm.mdh[: i + 1], turned[:, : i + 1], arm.prismatic[: i + 1]
            )
            out = out + mass[i] * STANDARD_GRAVITY * (last[:, 2, :3] @ com[i] + last[:, 2, 3])
        return np.asarray(
            out + carried * STANDARD_GRAVITY * (last[:, 2, :3] @ spots.mean(axis=0) + last[:, 2, 3])
        )

    torque = -energy(q + 1e-30j * np.eye(6)[1]).imag / 1e-30
    pose = robot.pose(q + 2e-6 * np.outer(torque, np.eye(6)[1]))
    y = spots @ np.swapaxes(pose[:, :3, :3], 1, 2) + pose[:, None, :3, 3] + [3.0, 1.0, 0.0]
    data = mc.measurements(q, y + 2e-5 * rng.normal(size=y.shape), payload=carried)
    found = mc.diagnose(robot, data, quick=True)
    (one,) = found.effects
    assert (found.verdict, one.term.effect, one.term.place) == ("named", "joint_compliance", "J2")
    assert abs(one.values[0] - 2e-6) < 4.0 * one.sigmas[0] < 1e-7


def test_a_plain_effect_is_named_with_its_size(plain: mc.Diagnosis) -> None:
    assert plain.verdict == "named"
    (one,) = plain.effects
    assert (one.term.effect, one.term.place) == ("backlash", "J2")
    assert one.p_value < 1e-6
    assert one.again == 1.0
    assert plain.closed > 0.7
    assert plain.closed_ci[0] <= plain.closed <= plain.closed_ci[1]
    assert one.after < one.before


def numbers_of(content: object) -> list[float]:
    """Every number in a JSON content."""
    if isinstance(content, bool):
        return []
    if isinstance(content, int | float):
        return [float(content)]
    if isinstance(content, str):  # what to measure next stands there as words
        return [float(text) for text in re.findall(r"(?<![\w.])\d+(?:\.\d+)?", content)]
    values = content.values() if isinstance(content, dict) else content
    if isinstance(content, dict | list):
        return [number for value in values for number in numbers_of(value)]  # type: ignore[union-attr]
    return []


@pytest.mark.parametrize(
    ("causes", "seed"),
    [
        ((), 1),
        ((GapCause("backlash", "J2", 1000.0),), 1),
        ((GapCause("outside_sum", "J2", 1000.0),), 1),
        ((GapCause("backlash", "J1", 500.0), GapCause("gear_error", "J3", 500.0)), 3),
        ((GapCause("outliers", "all", 1.0),), 7),
    ],
    ids=["none", "one", "outside", "two", "fault"],
)
def test_every_number_in_words_stands_in_the_json(causes: tuple[GapCause, ...], seed: int) -> None:
    found = diagnosed(*causes, seed=seed)
    said = json.loads(found.json())
    del said["reasons"]  # the words themselves
    known = numbers_of(said)
    shown = {f"{scale * value:.{digits}f}" for value in known for scale in (1, 100)
             for digits in (0, 1, 2, 3)} | {f"{value:.1g}" for value in known}  # fmt: skip
    text = re.sub(r"\b[JL]\d\b|smr\d|joint \d|link \d|95 %|angle \d", "", found.headline())
    for number in re.findall(r"(?<![\w.])\d+(?:\.\d+)?(?:e-?\d+)?", text):
        assert number in shown, f"{number} in {text!r}"


def test_an_arm_that_does_not_come_back_is_called_so() -> None:
    made = build_and_measure_arm(GapCase("irb2600", "rough", jitter=200e-6, seed=4))
    found = mc.diagnose(made.robot, made.data, quick=True)
    assert found.verdict == "not_repeatable"
    assert VERDICT_OPENINGS["not_repeatable"] in found.headline()


def test_a_law_outside_the_library_is_unknown() -> None:
    found = diagnosed(GapCause("outside_sum", "J2", 1000.0))
    assert found.verdict == "unknown"
    assert found.structure < REMAINING_STRUCTURE_P_VALUE
    assert VERDICT_OPENINGS["unknown"] in found.headline()


def test_without_the_true_effect_no_relative_is_named_with_confidence() -> None:
    made = sealed(GapCause("backlash", "J2", 1000.0))
    found = mc.diagnose(made.robot, made.data, exclude=("backlash",), quick=True)
    assert found.verdict == "unknown" or any(f.alternatives for f in found.effects)
    assert all(f.term.effect != "backlash" for f in found.effects)


def test_the_ladder_is_of_poses_that_no_fit_has_seen(plain: mc.Diagnosis) -> None:
    held = plain.held
    cell = plain.cells[-1]
    error = np.linalg.norm(cell.error(plain.data.take(held)), axis=-1)
    assert_allclose(plain.ladder[-1].holdout.rms_mm, 1e3 * np.sqrt(np.mean(error**2)), rtol=1e-9)
    again = mc.diagnose(
        sealed(GapCause("backlash", "J2", 1000.0)).robot,
        plain.data.with_y(np.where(held[:, None, None], plain.data.y + 5.0, plain.data.y)),
        quick=True,
    )
    assert [f.values for f in again.effects][-1:] != [] or again.effects == ()
    assert_allclose(again.ladder[1].train.rms_mm, plain.ladder[1].train.rms_mm, rtol=1e-6)
    # and the split column is kept
    assert (plain.data.columns["split"][plain.held] == "holdout").all()
    assert (plain.data.columns["split"][~plain.held] == "train").all()


def test_outliers_and_swapped_rows_are_named_and_mended() -> None:
    cause = GapCause("outliers", "all", 1.0)
    made, found = sealed(cause, seed=7), diagnosed(cause, seed=7)
    assert found.effects[0].term.effect == "outliers"
    last = found.ladder[-1]
    assert last.trusted.rms_mm < 1.1e3 * made.floor * 1.05
    assert last.holdout.rms_mm > 2.0 * last.trusted.rms_mm  # what is held out stays there
    made = sealed(GapCause("swapped_rows", "all", 1.0), seed=7)
    found = mc.diagnose(made.robot, made.data, quick=True)
    assert found.effects[0].term.effect == "swapped_rows"
    moved = np.flatnonzero(np.abs(made.displacement).max(axis=(1, 2)) > 0.01)
    assert sorted(found.effects[0].rows) == made.data.line[moved].tolist()
    assert found.ladder[-1].trusted.rms_mm < 1.1e3 * made.floor * 1.05


def test_rows_find_their_own_points_again() -> None:
    made = sealed(condition="none", seed=5)
    y = made.data.y.copy()
    y[[3, 8, 20]] = y[[8, 20, 3]]
    rows, source = match_misplaced_rows(made.robot, made.data.with_y(y))
    assert rows.tolist() == [3, 8, 20]
    back = correct_misplaced_rows(made.data.with_y(y), rows, source)
    assert_allclose(back.y, made.data.y, rtol=0, atol=0)
    assert not len(match_misplaced_rows(made.robot, made.data)[0])
    y = made.data.y.copy()
    y[4] += 0.5
    rows, source = match_misplaced_rows(made.robot, made.data.with_y(y))
    assert (rows.tolist(), source.tolist()) == ([4], [4])
    assert correct_misplaced_rows(made.data.with_y(y), rows, source).poses == made.data.poses - 1


def test_closed_share_is_of_squares_above_the_floor() -> None:
    rng = np.random.default_rng(0)
    before, after = (s * rng.normal(size=(4000, 3, 3)) for s in (2e-3, 1e-3))
    floor, group = NoiseFloor(np.sqrt(3.0) * 0.5, 0.8, 0.9, REPEATS), np.arange(4000)
    share, (low, high) = estimate_explained_fraction(before, after, group, floor, 0.0, rng)
    assert abs(share - (4.0 - 1.0) / (4.0 - 0.25)) < 0.02
    assert low < share < high
    _, (lower, higher) = estimate_explained_fraction(before, after, group, floor, 0.01, rng)
    assert higher - lower > 5.0 * (high - low)  # other training poses would have changed it
    none = estimate_explained_fraction(before * 0.0, before * 0.0, group, floor, 0.0, rng)
    assert np.isnan(none[0])


def test_computed_points_have_no_gap(clean: Simulation, robot: mc.Robot) -> None:
    found = mc.diagnose(robot, clean.data, quick=True)
    assert found.verdict == "none"
    assert found.ladder[1].holdout.rms_mm < 1e-6


def test_user_errors_say_what_to_do(robot: mc.Robot) -> None:
    made = sealed(condition="none")
    with pytest.raises(mc.OptionError, match="choose joint_compliance"):
        mc.diagnose(made.robot, made.data, exclude=("gremlins",), quick=True)
    columns = {k: v for k, v in made.data.columns.items() if k != "split"}
    with pytest.raises(mc.DataError, match="no pose is held out"):
        mc.diagnose(made.robot, replace(made.data, columns=columns), holdout=0.0, quick=True)
    degrees = replace(made.data, q=np.degrees(made.data.q) / 10.0)
    with pytest.raises(mc.DataError):
        mc.diagnose(made.robot, degrees, quick=True)


def test_one_target_is_enough() -> None:
    made = sealed(GapCause("encoder_gain", "J1", 2000.0), seed=2)
    alone = made.data.only(0)
    found = mc.diagnose(made.robot, alone, quick=True)
    assert found.verdict in VERDICTS
    assert "target_shift" in {name for name, _ in found.not_testable}


# ---- real arms ---------------------------------------------------------------------------------


def in_rows(name: str) -> mc.Diagnosis:
    """Of a real arm whose rows stand in the order of the visits."""
    robot, file = shared(name)
    return mc.diagnose(robot, mc.read_measurements(file).in_visit_order(), quick=True)


def test_gravity_is_named() -> None:
    gravity = {"joint_compliance", "link_bending"}
    qkm, fanuc = mc.diagnose(*shared("qkm_hl6"), quick=True), in_rows("fanuc_r2000")
    first = qkm.effects[0]
    assert {first.term.effect, *(a.effect for a in first.alternatives)} >= gravity
    assert fanuc.effects[0].term.effect in gravity
    for found in (qkm, fanuc):
        assert found.ladder[-1].holdout.rms_mm < 0.7 * found.ladder[1].holdout.rms_mm


@pytest.mark.slow
def test_meca_has_no_gravity() -> None:
    found = in_rows("meca500_r")
    gravity = {"joint_compliance", "link_bending", "base_flex", "gravity_compensator", "tool_flex"}
    assert not gravity & {f.term.effect for f in found.effects}
    assert ("backlash", "J6") in {(f.term.effect, f.term.place) for f in found.effects}


@pytest.mark.slow
def test_ur10_joints_err_by_curves_of_their_own_angle() -> None:
    found = mc.diagnose(*shared("ur10_b"), quick=True)
    places = {f.term.place for f in found.effects if f.term.effect == "joint_error_map"}
    assert places >= {"J1", "J2", "J3"}
    assert found.ladder[-1].holdout.rms_mm < 0.12


def irb120(every: int, *, read_back: bool = False) -> mc.Diagnosis:
    """The IRB 120's diagnosis on some of its rows, with commanded or read-back joints."""
    robot, path = shared("irb120")
    data = mc.read_measurements(path)
    q = np.stack([data.columns[f"qread{j + 1}"] for j in range(6)], axis=1)
    kept = {k: v for k, v in data.columns.items() if not k.startswith(("qread", "base"))}
    data = replace(data, q=q, columns=kept) if read_back else data
    rows = np.arange(0, data.poses, every)
    return mc.diagnose(mc.load_robot(robot), data.take(rows), quick=True)


@pytest.mark.slow
@pytest.mark.parametrize("every", [3, 1])
def test_irb120_gives_way_at_its_joints(every: int) -> None:
    found = irb120(every)
    assert found.effects[0].term.effect == "joint_compliance"
    final = found.ladder[-1].holdout
    assert final.rms_mm <= 0.10
    assert final.max_mm <= 0.35


@pytest.mark.slow
def test_read_back_joints_are_not_called_backlash() -> None:
    """Every row is needed: a row tells of its move only if the pose before it is there."""
    names = {f.term.effect for f in irb120(1, read_back=True).effects}
    assert names & {"readback", "settling"}
    assert "backlash" not in names


def test_another_robots_file_is_said() -> None:
    made = sealed(condition="none")
    longer = made.robot.mdh.copy()
    longer[1, 0] += 0.15  # the drawing of an arm that reaches farther
    found = mc.diagnose(made.robot.with_mdh(longer), made.data, quick=True)
    assert any("is the robot" in note for note in found.notices)
    assert not any("is the robot" in note for note in diagnosed().notices)


def test_the_whole_law_is_told_and_a_point_that_the_gap_hid() -> None:
    """A gear that errs by far more than what is left, and a held-out pose off by less than that."""
    made = build_and_measure_arm(
        GapCase("irb2600", "single", (GapCause("gear_error", "J3", 5e4),), seed=3)
    )
    bare = mc.diagnose(made.robot, made.data, quick=True)
    held, size = bare.data.line[bare.held], [step.holdout.rms_mm for step in bare.ladder[1:]]
    assert size[0] > 6.0 * size[-1]
    row = int(np.flatnonzero(made.data.line == held[3])[0])
    y = made.data.y.copy()
    y[row] += 1e-3 * np.sqrt(size[0] * size[-1]) * np.array([8.0, 0.0, 0.0])
    found = mc.diagnose(made.robot, made.data.with_y(y), quick=True)
    (gear,) = found.effects
    assert [term.text for term in gear.terms] == ["gear_error:J3:orders=2.0"]
    assert [term.text for term in gear.shown] == ["gear_error:J3:turns=1.0"]
    assert len(gear.names) == len(gear.values) == len(gear.sigmas) == 4
    assert all(sigma > 0.0 for sigma in gear.sigmas)
    (said,) = [notice for notice in found.notices if "that no effect found explains" in notice]
    assert f"{made.data.called(held[3])} smr1" in said
    last = found.ladder[-1]
    assert sum(last.holdout.counts) - sum(last.trusted.counts) == len(made.data.target_names)
    assert last.holdout.max_mm > 3.0 * last.trusted.max_mm


# ---- failed --------------------------------------------------------------------------------------


def mirrored(data: mc.Measurements) -> mc.Measurements:
    """One coordinate of one target with the wrong sign."""
    return data.with_y(data.y * np.array([[1.0, 1.0, 1.0], [-1.0, 1.0, 1.0]]))


def test_it_ends_with_one_and_writes_no_robot(
    robot: mc.Robot, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    data, out = tmp_path / "d.csv", tmp_path / "gap.json"
    mc.write_measurements(data, mirrored(mc.simulate(robot, 40, 2, seed=5).data))
    assert run("diagnose", "irb2600", data, "--quick", "--json", "-o", out) == 1
    said = capsys.readouterr()
    assert said.err.splitlines()[-1].startswith("error: failed: ")
    assert not out.exists()
    found = mc.Diagnosis.from_dict(json.loads(said.out))
    assert (found.status, found.verdict) == ("failed", "unknown")
    gone = replace(found.cells[0], base=build_transform(np.eye(3), np.array([3e5, 0.0, 0.0])))
    again = mc.Diagnosis.from_dict(json.loads(replace(found, cells=(gone,)).json()))
    assert_allclose(again.cells[0].base, gone.base, rtol=1e-9)  # wherever it ended
    assert found.headline() == CONTRADICTION_SENTENCE
    assert found.verdict == "unknown"
    with pytest.raises(mc.OptionError, match="contradicts its own data"):
        mc.export(found, "json")


def test_points_that_are_suspect_contradict_nothing(robot: mc.Robot) -> None:
    def scores(rms: float, points: int) -> Accuracy:
        return Accuracy(rms, rms, rms, points, (points * rms**2,), (points,))

    fits, open_end = scores(0.1, 80), NoiseFloor(0.1, 0.0, 0.1, AT_MOST)
    few_bad = BudgetStep("geometric", fits, scores(90.0, 20), scores(0.1, 16))
    assert describe_contradiction(robot, open_end, few_bad) == ""
    most_bad = BudgetStep("geometric", fits, scores(90.0, 20), scores(0.1, 8))
    assert 90.0 in numbers(describe_contradiction(robot, open_end, most_bad))
    known = NoiseFloor(0.1, 0.1, 0.1, REPEATS)
    off = BudgetStep("geometric", scores(5.5, 80), fits, fits)
    assert 50.0 in numbers(describe_contradiction(robot, known, off))
    assert describe_contradiction(robot, open_end, off) == ""


def test_an_arm_that_comes_back_well_may_bend(robot: mc.Robot) -> None:
    """Readings at standstill tell what the instrument does, not how large an effect may be."""
    made = mc.simulate(robot, 100, 3, seed=1, truth=mc.Truth(noise=0.0, noise_per_metre=0.0))
    rng = np.random.default_rng(1)
    twice = made.data.take(np.repeat(np.arange(100), 2))
    twice = twice.with_y(twice.y + 2e-6 * rng.normal(size=twice.y.shape))
    assert mc.calibrate(robot, twice, objective="sum").status == "converged"
    exact = NoiseFloor(0.002, 0.002, 0.002, REPEATS)

    def step(share: float) -> BudgetStep:
        rms = 1e3 * share * robot.reach()
        one = Accuracy(rms, rms, rms, 80, (80 * rms**2,), (80,))
        return BudgetStep("geometric", one, one, one)

    assert describe_contradiction(robot, exact, step(0.9e-3)) == ""
    assert 0.1 in numbers(describe_contradiction(robot, exact, step(1.1e-3)))


# ---- established ---------------------------------------------------------------------------------


def cause(effect: str, place: str, size: float = 100.0) -> Finding:
    return Finding((Term(effect, place),), ("x",), ("1",), (1.0,), (0.1,), size, 1e-9)


def named(*names: tuple[str, str]) -> frozenset[tuple[str, str]]:
    return frozenset(names)


def test_the_frequency_decides_what_is_established_and_what_is_in_the_model() -> None:
    count = SUBSAMPLE_PART_COUNT * SUBSAMPLE_ROUND_COUNT
    for times in range(count + 1):
        one = replace(cause("backlash", "J1"), again=times / count)
        assert one.established == (times >= count - 1)
        assert (select_frequent([one]) == [one]) == (times >= 8)
        assert one.evidence.endswith(f", {times / count:.2f}")
    assert MIN_MODEL_FREQUENCY < MIN_CONFIRMED_FREQUENCY < (count - 1) / count
    unasked = replace(cause("backlash", "J1"), again=float("nan"))
    assert select_frequent([unasked]) == [unasked]
    assert not has_frequencies([unasked])
    assert not unasked.established
    assert unasked.evidence == "possible"


def test_one_joint_and_all_of_them_stand_for_each_other() -> None:
    rival = AlternativeEffect("base_flex", "frame", 0.9, 5.0, 1.0)
    one = replace(cause("joint_compliance", "J2"), alternatives=(rival,))
    repeats = SubsampleSelections(
        (named(("joint_compliance", "all")), named(("joint_compliance", "J3"), ("backlash", "J1"))),
        2,
    )  # fmt: skip
    assert list_equivalent_keys(one, repeats) == {
        ("joint_compliance", "J2"), ("joint_compliance", "all"), ("base_flex", "frame")
    }  # fmt: skip
    every = replace(one, terms=(Term("joint_compliance", "all"),), alternatives=())
    assert list_equivalent_keys(every, repeats) == {
        ("joint_compliance", "J3"), ("joint_compliance", "all")
    }  # fmt: skip


@pytest.fixture(scope="module")
def geared() -> tuple[LinearisedGeometry, FoundCauses]:
    study = study_of(
        build_and_measure_arm(
            GapCase("irb2600", "single", (GapCause("gear_error", "J1", 300.0),), seed=4)
        )
    )
    choice = select_effects_by_evidence(build_library_of_testable_arm_laws(study.scene, study.rows))
    return study, FoundCauses((), (), choice, (), (NO_REMAINING_COMPONENT,), ())


def test_what_takes_the_place_of_a_name_is_its_alternative(
    geared: tuple[LinearisedGeometry, FoundCauses], monkeypatch: pytest.MonkeyPatch
) -> None:
    study, causes = geared
    (own,) = (named(candidate.key) for candidate in causes.selection.candidates)
    gain, play, other = ("encoder_gain", "J1"), ("backlash", "J6"), ("no such", "J1")
    found = (own, own, own, named(gain, other), named(gain, other), named(play))
    monkeypatch.setattr(
        search, "select_on_subsamples", lambda *args, **options: SubsampleSelections(found, 6)
    )
    (told,) = judge_causes(study.scene, causes, study.rows.row_groups).effects
    assert told.again == 5 / 6  # it, or what takes its place
    assert [(a.effect, a.place) for a in told.alternatives] == [gain]
    assert told.alternatives[0].loss > 0.0
    assert 0.0 < told.alternatives[0].rho2 < 1.0


def test_poses_too_few_to_ask_leave_an_effect_possible_below_the_budget() -> None:
    """Twenty poses of one target: two thirds of them tell the geometry and little more."""
    made = build_and_measure_arm(
        GapCase("irb2600", "single", (GapCause("joint_compliance", "J2", 2e4),), seed=3, poses=20)
    )
    data = made.data.keep(np.arange(len(made.data.target_names)) == 0).take(np.arange(20))
    columns = {name: column for name, column in data.columns.items() if name != "split"}
    told = mc.diagnose(made.robot, replace(data, columns=columns), quick=True)
    (one,) = told.effects
    assert one.term.key == ("joint_compliance", "J2")
    assert np.isnan(one.again)
    assert not one.established
    assert told.to_dict()["effects"][0]["frequency"] is None
    assert told.ladder[-1].name == "geometric"
    assert told.possible.holdout.rms_mm < 0.2 * told.ladder[-1].holdout.rms_mm


# ---- verdict -------------------------------------------------------------------------------------


def finding(effect: str, place: str, size: float = 100.0, again: float = 1.0) -> Finding:
    none = (0.0,)
    return Finding((Term(effect, place),), ("a",), ("rad",), none, none, size, 1e-9, again=again)


def test_a_name_that_helps_at_no_poses_left_out_holds_nothing() -> None:
    firm, weak = finding("gear_error", "J3"), finding("encoder_gain", "J2", 50.0, again=0.6)
    chance = replace(finding("backlash", "J1"), p_value=10.0 * thresholds.CERTAIN_P_VALUE)
    every = [firm, weak, chance]
    assert find_unconfirmed(every, [firm]) == [weak]
    assert find_unconfirmed(every, []) == [firm, weak]  # the ladder refused the first
    rival = AlternativeEffect("gear_error", "all", 0.9, 5.0, 1.0, "")
    for other in (finding("gear_error", "all"), finding("backlash", "J3")):
        assert find_unconfirmed([firm, other], [firm]) == [other][: other.term.effect == "backlash"]
    bending = replace(finding("link_bending", "L3"), alternatives=(rival,))
    assert find_unconfirmed([firm, bending], [firm]) == []  # which is told with it
    assert find_unconfirmed([firm, replace(bending, again=0.6)], [firm])  # by itself it changes
    assert not is_mostly_unconfirmed(every, [firm])
    assert is_mostly_unconfirmed(every, [])
    assert is_mostly_unconfirmed([firm, replace(weak, size=300.0)], [firm])
    assert describe_why_unconfirmed(every, [weak]) == CHANGING_CAUSES_TEXT
    assert describe_why_unconfirmed(every, [firm, weak]) == UNHELPFUL_CAUSES_TEXT
    assert (
        describe_why_unconfirmed(every, [firm, replace(weak, size=300.0)]) == CHANGING_CAUSES_TEXT
    )  # most of it changes
    few = [replace(one, again=float("nan")) for one in every]
    assert describe_why_unconfirmed(few, find_unconfirmed(few, [])) == TOO_FEW_POSES_TEXT


@pytest.fixture(scope="module")
def two_orders() -> mc.Diagnosis:
    causes = (GapCause("gear_error", "J3", 300.0, 0), GapCause("gear_error", "J3", 300.0, 1))
    made = build_and_measure_arm(GapCase("irb2600", "single", causes, seed=3))
    return mc.diagnose(made.robot, made.data, quick=True)


def test_two_orders_of_one_gear_are_one_effect(two_orders: mc.Diagnosis) -> None:
    assert two_orders.verdict in ("named", "one_of")
    (one,) = two_orders.effects
    assert one.term.key == ("gear_error", "J3")
    assert one.established
    assert set(one.names) == {f"{part} {k}/turn" for part in ("cos", "sin") for k in (1, 2)}


def test_the_file_tells_what_is_established_and_what_remains(two_orders: mc.Diagnosis) -> None:
    said = json.loads(two_orders.json())
    assert [e["established"] for e in said["effects"]] == [True]
    left = said["remaining"]
    assert set(left) == {"depends", "unexplained_mm", "noise_mm", "noise_from"}
    parts = [left["noise_mm"], left["unexplained_mm"], *(d["rms_mm"] for d in left["depends"][:1])]
    last = two_orders.ladder[-1].trusted.rms_mm
    assert np.hypot.reduce(parts) == pytest.approx(max(last, left["noise_mm"]))  # it closes
    assert set(said["remainder"]) == {"predictable_mm", "where", "unpredictable_mm", "floor_mm"}
    again = mc.Diagnosis.from_dict(said)
    assert again.remaining == two_orders.remaining
    assert json.loads(again.json())["effects"][0]["established"] is True
    assert said["effects"][0]["why_tentative"] is None


@pytest.mark.parametrize(
    ("again", "why"),
    [
        (0.8, "not found again without some of the poses"),
        (None, "poses too few to leave any out"),
    ],
)
def test_what_is_tentative_stays_so_in_a_file(
    two_orders: mc.Diagnosis, again: float | None, why: str
) -> None:
    said = json.loads(two_orders.json())
    told = {"established": False, "frequency": again, "why_tentative": why}
    said["effects"][0] |= told
    kept = json.loads(mc.Diagnosis.from_dict(said).json())["effects"][0]
    assert {key: kept[key] for key in told} == told


def test_an_old_file_holds_established_effects(two_orders: mc.Diagnosis) -> None:
    said = json.loads(two_orders.json())
    del said["effects"][0]["established"], said["effects"][0]["frequency"], said["remaining"]
    again = mc.Diagnosis.from_dict(said)
    assert all(found.established for found in again.effects)
    assert again.remaining is None


def test_what_could_not_be_tested_stands_among_the_alternatives_of_its_relatives() -> None:
    """Without masses a joint that yields to its own load may yield to its neighbour's."""
    robot = mc.load_robot("irb2600")
    bare = Cell(robot, np.eye(4), ("smr1",), np.full((1, 3), 0.1))
    scene = bare.pose_arm(
        build_measurements_at_rest(np.linspace(-1.0, 1.0, 60).reshape(10, 6), ("smr1",), robot)
    )
    assert not scene.has_known_masses
    (rival,) = add_untestable_alternatives(
        finding("joint_compliance", "J2"), scene, ()
    ).alternatives
    assert (rival.effect, rival.place) == ("cross_compliance", "J2")
    assert "mass_kg" in rival.separate_with
    assert not add_untestable_alternatives(
        finding("joint_compliance", "J2"), scene, (rival.effect,)
    ).alternatives
    assert not add_untestable_alternatives(finding("gear_error", "J2"), scene, ()).alternatives
    heavy = replace(robot, mass=np.full(6, 5.0), com=np.zeros((6, 3)))
    told = replace(bare, robot=heavy).pose_arm(scene.data)
    assert not add_untestable_alternatives(finding("joint_compliance", "J2"), told, ()).alternatives


# ---- last question -------------------------------------------------------------------------------


NAN = float("nan")
QUIET = NoiseLimits(
    highest_noise_mm=0.05,
    lowest_error_mm=0.04,
    lowest_visit_scatter_mm=NAN,
    expected_scatter_mm=NAN,
)
LOUD = replace(QUIET, lowest_error_mm=0.14)
UNKNOWN = replace(LOUD, highest_noise_mm=NAN)


@pytest.mark.parametrize(
    ("known", "meets"), [(QUIET, True), (LOUD, False), (UNKNOWN, None)], ids=str
)
def test_a_model_meets_the_noise_where_that_is_known(
    known: NoiseLimits, meets: bool | None
) -> None:
    assert known.is_down_to_noise is meets


@pytest.mark.parametrize(
    ("verdict", "known", "expected"),
    [
        ("none", QUIET, "none"),
        ("none", LOUD, "unknown"),  # a model at 0.14 mm beside a noise of 0.05 mm
        ("none", UNKNOWN, "none"),
        ("named", QUIET, "named"),
        ("named", LOUD, "unknown"),
        ("named", UNKNOWN, "named"),
        ("unknown", QUIET, "unknown"),
    ],
)
def test_the_verdict_reads_the_noise(verdict: str, known: NoiseLimits, expected: str) -> None:
    found = [sure(minor=False)] if verdict == "named" else []
    assert adjust_verdict_to_noise(verdict, "", found, known)[0] == expected


def sure(*, minor: bool) -> Finding:
    """A confirmed cause."""
    return replace(finding("gear_error", "J2"), minor=minor)


@pytest.mark.parametrize(
    ("known", "expected"), [(QUIET, "none"), (UNKNOWN, "none"), (LOUD, "unknown")]
)
def test_minor_causes_alone_carry_no_verdict(known: NoiseLimits, expected: str) -> None:
    verdict, why = adjust_verdict_to_noise("named", "", [sure(minor=True)], known)
    assert verdict == expected
    assert (why == ONLY_MINOR_TEXT) == (expected == "unknown")


def test_a_cause_that_carries_the_error_is_no_answer_to_noise_that_is_known() -> None:
    assert adjust_verdict_to_noise("named", "", [sure(minor=False)], LOUD) == (
        "unknown",
        ABOVE_NOISE_TEXT,
    )
    assert adjust_verdict_to_noise("one_of", "", [sure(minor=False)], QUIET) == ("one_of", "")


@pytest.mark.parametrize(("visits", "repeatable"), [(0.1, True), (0.2, False), (NAN, True)])
def test_an_arm_is_not_repeatable_whose_visits_scatter_more_than_it_may(
    visits: float, repeatable: bool
) -> None:
    known = replace(QUIET, lowest_visit_scatter_mm=visits, expected_scatter_mm=0.1)
    assert known.is_repeatable == repeatable
    expected = "none" if repeatable else "not_repeatable"
    assert adjust_verdict_to_noise("none", "", [], known)[0] == expected


def test_a_joint_on_two_seats_is_not_repeatable() -> None:
    """By its visits, beside what the distances between the targets say of the instrument."""
    made = machines.build_and_measure_arm(
        machines.MachineCase(
            "ur5e", "mechanism", (GapCause("outside_seats", "J2", 5000.0),), seed=5
        )
    )
    found = mc.diagnose(made.robot, made.data, quick=True)
    assert found.verdict == "not_repeatable"
    said = found.to_dict()
    assert said["floor_known"]
    assert isinstance(said["meets_floor"], bool)
