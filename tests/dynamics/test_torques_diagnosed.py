"""Simulated arms whose torques hold one effect that nobody told: is it named, and how large?"""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from conftest import run
from dynamics.motions import Extra, driven_torque, fourier, simulated, three_joints
from numpy.testing import assert_allclose

import minimax_cal as mc
from experiments.motion_cases import GIVEN_GEAR_RATIO, MUJOCO_GENERATOR, MotionCase, simulate_case
from minimax_cal.cli import torques
from minimax_cal.core.arrays import Array
from minimax_cal.dynamics.cross_validation import USUAL_FRICTION_STEP_NAME
from minimax_cal.dynamics.laws import TORQUE_EFFECT_WORDS, TorqueTerm
from minimax_cal.dynamics.mass_tests import select_payloads_with_weight
from minimax_cal.dynamics.regressor import (
    JointMotion,
    build_nominal_inertial_parameters,
    inverse_dynamics,
)
from minimax_cal.dynamics.torque_regression import TorqueColumns
from minimax_cal.dynamics.torque_rows import (
    ROW_RATE_HZ,
    ArmMotion,
    TorqueArm,
    resample_and_filter_runs,
)

ARM = three_joints()


def at(j: int, law: Extra) -> Extra:
    """More torque at one joint."""

    def more(motion: JointMotion, rigid: Array, time: Array) -> Array:
        out = np.zeros_like(rigid)
        out[:, j] = law(motion, rigid, time)
        return out

    return more


def compliant(j: int, compliance: float, turns: Array | None = None) -> Extra:
    """A drive whose gear turns back by its torque.  turns: as `driven_torque`."""

    def more(motion: JointMotion, rigid: Array, time: Array) -> Array:
        by = np.zeros_like(rigid)
        by[:, j] = -compliance * rigid[:, j]
        rate = np.gradient(by, time, axis=0)
        change = np.gradient(rate, time, axis=0)
        moved = JointMotion(motion.q + by, motion.qd + rate, motion.qdd + change)
        return driven_torque(moved, build_nominal_inertial_parameters(ARM), turns) - rigid

    return more


def late(seconds: float) -> Extra:
    """Torques that are logged after the motion, to the first order."""

    def more(motion: JointMotion, rigid: Array, time: Array) -> Array:
        friction = np.sign(motion.qd) * [4.0, 3.0, 1.5] + motion.qd * [3.0, 4.0, 1.0]
        return -seconds * np.gradient(rigid + friction, time, axis=0)

    return more


SINGLE = {
    "load_friction:J2": (
        at(1, lambda m, r, t: 0.07 * np.abs(r[:, 1]) * np.sign(m.qd[:, 1])), "share", 0.07, 0.05,
    ),
    "armature:J3": (at(2, lambda m, r, t: 0.3 * m.qdd[:, 2]), "inertia", 0.3, 0.02),
    "joint_flexibility:J2": (compliant(1, 4e-4), "compliance", 4e-4, 0.1),
    "delay:all": (late(0.006), "time", 0.006, 0.05),
    "cable:J1": (at(0, lambda m, r, t: 1.5 * m.q[:, 0]), "first", 1.5, 0.03),
    "torque_ripple:J1": (at(0, lambda m, r, t: 0.5 * np.cos(50.0 * m.q[:, 0])), "cos", 0.5, 0.1),
}  # fmt: skip


def names(found: mc.MotionDiagnosis) -> set[str]:
    """What is confirmed and matters, beside usual friction."""
    return {f"{e.effect}:{e.place}" for e in found.main if e.effect not in ("coulomb", "viscous")}


@pytest.mark.parametrize("name", SINGLE)
def test_one_effect_is_named_with_its_size(name: str) -> None:
    extra, parameter, value, off = SINGLE[name]
    found = mc.diagnose_motion(ARM, simulated(extra, seed=3), ratio=50.0)
    assert found.verdict == "named"
    assert names(found) == {name}
    (effect,) = (e for e in found.effects if f"{e.effect}:{e.place}" == name)
    (number,) = (p for p in effect.parameters if p.name == parameter)
    assert number.value == pytest.approx(value, rel=off)
    before, after = max(effect.worth.values(), key=lambda pair: pair[0] - pair[1])
    assert after < 0.8 * before
    usual = {f"{e.effect}:{e.place}" for e in found.effects if e.effect in ("coulomb", "viscous")}
    assert usual == {f"{kind}:J{j}" for kind in ("coulomb", "viscous") for j in (1, 2, 3)}


def test_flexibility_of_a_drive_that_moves_two_joints() -> None:
    """Joint 3 turns by q3 - q2: gear 2 winds up by the torque of drive 2, and turns both back."""
    turns = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, -1.0, 1.0]])
    runs = simulated(compliant(1, 4e-4, turns), seed=3, turns=turns)
    found = mc.diagnose_motion(replace(ARM, coupling=turns), runs)
    assert (found.verdict, names(found)) == ("named", {"joint_flexibility:J2"})
    value = next(e for e in found.main if e.effect == "joint_flexibility").parameters[0].value
    assert value == pytest.approx(4e-4, rel=0.1)


def test_a_rigid_body_alone_has_no_cause() -> None:
    found = mc.diagnose_motion(ARM, simulated(friction=False, seed=3))
    assert (found.verdict, found.effects, found.unexplained) == ("none", (), ())
    given, refitted, *_ = found.budget
    assert_allclose(given.holdout_rms, refitted.holdout_rms, rtol=0.05)  # the masses are right


@pytest.mark.parametrize("seed", [6, 11, 14])
def test_little_noise_on_a_sound_arm_makes_no_name_of_reversals(seed: int) -> None:
    """Rows so near that the filter mixes in the step of friction were taken for presliding."""
    found = mc.diagnose_motion(ARM, simulated(seed=seed, noise=0.01))
    assert {e.effect for e in found.effects} == {"coulomb", "viscous"}


def test_a_payload_that_nobody_told_is_the_last_link() -> None:
    found = mc.diagnose_motion(ARM, simulated(carried=2.0, seed=3))
    (effect,) = (e for e in found.effects if e.effect == "payload")
    mass = effect.parameters[0]
    assert effect.place == "L3"
    assert mass.value == pytest.approx(2.0, rel=0.03)
    assert abs(mass.value - 2.0) < 4.0 * mass.sigma


def payloads(found: mc.MotionDiagnosis) -> dict[tuple[str, ...], tuple[float, float]]:
    """Mass [kg] and its sigma of each payload, by the runs that carry it."""
    out = {}
    for effect in (e for e in found.effects if e.effect == "payload"):
        mass, *rest = effect.parameters
        out[tuple(sorted(p.name for p in rest if p.name[:3] == "run"))] = mass.value, mass.sigma
    return out


def test_a_payload_of_one_run_is_the_same_in_any_order_of_logs() -> None:
    runs = simulated(carried=(0.0, 0.0, 0.0, 2.6), seed=5, runs=4, seconds=15.0)
    values = []
    for order in ((0, 1, 2, 3), (3, 0, 1, 2), (0, 3, 2, 1)):
        found = mc.diagnose_motion(ARM, [runs[i] for i in order])
        (((named, (mass, sigma))),) = payloads(found).items()
        assert (found.verdict, named) == ("named", ("run3",))
        assert abs(mass - 2.6) < 4.0 * sigma < 0.03
        assert found.held_out.endswith(": run3")
        before, after = (np.array(step.holdout_rms) for step in found.budget[-2:])
        assert (after < 0.2 * before).all()
        values.append(mass)
    assert_allclose(values, values[0], rtol=1e-6)


def test_two_payloads_are_two() -> None:
    runs = simulated(carried=(0.0, 2.6, 1.2, 0.0, 2.6, 1.2), seed=5, runs=6, seconds=12.0)
    diagnosis = mc.diagnose_motion(ARM, runs[::-1])
    found, shown = payloads(diagnosis), diagnosis.effects_table().rows
    assert re.findall(r"run\d", shown[0][0]) == ["run4", "run1"]
    assert "at L3;" in diagnosis.headline()
    assert found.keys() == {("run1", "run4"), ("run2", "run5")}
    for (mass, sigma), true in zip(found.values(), (2.6, 1.2), strict=True):
        assert abs(mass - true) < 4.0 * sigma < 0.03


@pytest.mark.parametrize("mass", [0.0, 0.2])
def test_what_has_no_weight_is_no_payload(mass: float) -> None:
    logs = resample_and_filter_runs(simulated(carried=(0.0, mass, 0.0), seed=3))
    arm = TorqueArm.build(ARM, np.ones(3), ARM.ratio, np.zeros(10), logs)
    columns, term = (
        TorqueColumns(ArmMotion.build(arm, logs)),
        TorqueTerm("payload", "L3", {"run1": 1.0}),
    )
    assert select_payloads_with_weight(columns, [], [term]) == ([term] if mass else [])


def test_runs_that_differ_by_an_inertia_carry_no_payload() -> None:
    """Friction of another curve than the first that is tried made them differ."""
    pytest.importorskip("mujoco")
    made = simulate_case(MotionCase("single", MUJOCO_GENERATOR, (("degressive", 8),), 2078605665))
    found = mc.diagnose_motion(made.robot, made.runs, ratio=GIVEN_GEAR_RATIO, payload=made.payload)
    assert names(found) == {"degressive:J1"}


def test_currents_without_gains_show_no_kilograms() -> None:
    runs = simulated(carried=(0.0, 2.6, 0.0), seed=5)
    amperes = [replace(r, torque=r.torque / [10.0, 12.0, 8.0], unit="A") for r in runs]
    found = mc.diagnose_motion(ARM, amperes)
    assert not [p for e in found.effects for p in e.parameters if "kg" in p.unit]
    assert "payload" in {one.effect for one in found.not_testable}
    assert found.verdict == "unknown"


@pytest.mark.parametrize("scale", [
    [1.0, -1.0, 1.0], [1.0, 1.0 / 14.0, 1.0], [1.0 / 12.0, 1.0 / 14.0, 1.0 / 9.0],
])  # fmt: skip
def test_efforts_of_another_unit_or_sign_are_no_drive_gain(scale: list[float]) -> None:
    runs = [replace(run, torque=run.torque * scale) for run in simulated(seed=3)]
    found = mc.diagnose_motion(ARM, runs)
    assert names(found) == set()
    factors = dict(re.findall(r"joint (\d) are (\S+) times", "\n".join(found.notices)))
    assert abs(float(factors["2"]) - 1.0) > 0.5
    assert any("i1_A, i2_A" in notice for notice in found.notices)  # the columns of the mend
    assert "drive_gain" in {one.effect for one in found.not_testable}
    coulomb = {e.place: e.parameters[0].value for e in found.effects if e.effect == "coulomb"}
    for place, value in coulomb.items():
        j = int(place[1]) - 1
        assert value == pytest.approx([4.0, 3.0, 1.5][j] * scale[j], rel=0.05)


def test_a_known_payload_tells_the_drive_gains() -> None:
    """Currents of drives that are all 5 % weaker than given: with a known load that shows."""
    runs = simulated(carried=(3.0, 0.0, 3.0), seed=3)
    gain = np.array([10.0, 12.0, 8.0])
    amperes = [
        mc.Run(r.name, r.source, r.time, r.q, None, None, r.torque / (0.95 * gain), "A",
               0.0 if r.name == "run1" else 3.0)
        for r in runs
    ]  # fmt: skip
    given = {"drive_gain": gain, "payload": (3.0, (0.0, 0.0, 0.05))}
    found = mc.diagnose_motion(ARM, amperes, **given)  # type: ignore[arg-type]
    gains = {e.place: e.parameters[0].value for e in found.effects if e.effect == "drive_gain"}
    assert "J2" in gains
    assert gains["J2"] == pytest.approx(1.0 / 0.95 - 1.0, abs=0.02)
    assert found.unit == "A"


def test_what_has_no_law_is_unexplained() -> None:
    strange = at(1, lambda m, r, t: np.sin(2.0 * m.q[:, 0]) * np.cos(m.q[:, 2]))
    found = mc.diagnose_motion(ARM, simulated(strange, seed=3))
    assert found.verdict == "unknown"
    worst = found.unexplained[0]
    assert (worst.place, worst.follows) == ("J2", "other joints")
    assert 0.0 < worst.size < worst.noise
    assert worst.describe_structure("N m") in found.headline()


@pytest.mark.parametrize("law", [
    at(1, lambda m, r, t: 1.5 * np.sin(2.0 * m.q[:, 2]) * np.cos(m.q[:, 0])),
    at(2, lambda m, r, t: 0.6 * m.qdd[:, 0]),
])  # fmt: skip
def test_a_law_that_harms_the_joints_together_is_not_kept(law: Extra) -> None:
    """Two short runs with a law that has no name: others were kept that tripled a joint's error."""
    budget = mc.diagnose_motion(ARM, simulated(law, seed=2, runs=2, seconds=14.0)).budget
    usual, last = (np.array(budget[step].holdout_rms_moving) for step in (2, -1))
    assert np.log(last / usual).mean() < 0.1


def test_too_little_motion_is_said_before_any_name() -> None:
    short = mc.diagnose_motion(ARM, simulated(runs=1, seconds=20.0, seed=1))
    assert short.verdict == "unknown"
    (reason,) = short.too_little
    assert reason.startswith("20 s ")
    assert reason in short.headline()


def test_a_run_kept_out_is_seen_by_nothing() -> None:
    """Its own torques change what is said of it, and no number of the model."""
    runs = simulated(SINGLE["armature:J3"][0], seed=5)
    other = simulated(seed=77)[2]
    one = mc.diagnose_motion(ARM, runs, holdout_run="run2")
    two = mc.diagnose_motion(ARM, [*runs[:2], other], holdout_run="run2")
    assert one.held_out.endswith(": run2")
    assert one.held_run.name == "run2"
    assert [m.terms for m in one.models] == [m.terms for m in two.models]
    assert one.budget[-1].holdout_rms[2] < 0.3 * two.budget[-1].holdout_rms[2]


def csv_of(folder: Path, runs: list[mc.Run]) -> list[Path]:
    """The runs as files of this project."""
    out = []
    for each in runs:
        n = each.joints
        head = ["t_s", *(f"q{j + 1}_rad" for j in range(n)), *(f"tau{j + 1}_Nm" for j in range(n))]
        rows = np.column_stack([each.time, each.q, each.torque])
        path = folder / f"{each.name}.csv"
        np.savetxt(path, rows, delimiter=",", header=",".join(head), comments="", fmt="%.7g")
        out.append(path)
    return out


def test_the_command_writes_what_evaluate_reads(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    ARM.save(tmp_path / "arm.json")
    runs = simulated(SINGLE["load_friction:J2"][0], seed=4, runs=4)
    *learn, new = csv_of(tmp_path, runs)
    motion = tmp_path / "motion.json"
    assert run("torques", tmp_path / "arm.json", *learn, "-o", motion, "--json", "-q") == 0
    said = json.loads(capsys.readouterr().out)
    assert said == json.loads(motion.read_text())
    assert (said["kind"], said["verdict"], said["unit"]) == ("motion_diagnosis", "named", "N m")
    assert said["effects"][0]["worth"].keys() <= {"J1", "J2", "J3"}
    assert [step["name"] for step in said["budget"]][-1] == "+ load_friction"
    assert run("evaluate", motion, new, "--json") == 0
    judged = json.loads(capsys.readouterr().out)
    assert len(judged["rms"]) == len(judged["rms_moving"]) == 3
    assert judged["rungs"][-1]["rms"] == judged["rms"]
    claimed = np.array(said["budget"][-1]["holdout_rms_moving"])
    assert (np.array(judged["rms_moving"]) < 1.2 * claimed).all()
    assert run("torques", tmp_path / "arm.json", *learn) == 0
    out = capsys.readouterr().out
    assert f"{TORQUE_EFFECT_WORDS['load_friction']} at J2" in out
    assert run("diagnose", tmp_path / "arm.json", *learn) == 0
    again, err = capsys.readouterr()
    assert again.splitlines()[:8] == out.splitlines()[:8]
    assert err.startswith(f"taken: {learn[0]} holds torques of 3 joints")
    assert run("evaluate", motion, new) == 0
    assert USUAL_FRICTION_STEP_NAME in capsys.readouterr().out


def test_a_file_holds_the_whole_diagnosis(tmp_path: Path) -> None:
    found = mc.diagnose_motion(ARM, simulated(SINGLE["delay:all"][0], seed=3))
    found.save(tmp_path / "a.json")
    again = mc.load_motion(tmp_path / "a.json")
    again.save(tmp_path / "b.json")
    one, two = (json.loads((tmp_path / name).read_text()) for name in ("a.json", "b.json"))
    assert {**one, "robot": 0} == {**two, "robot": 0}
    fresh = simulated(SINGLE["delay:all"][0], seed=9)
    here, there = (mc.evaluate_motion(each, fresh) for each in (found, again))
    assert_allclose(here.steps[-1].rms, there.steps[-1].rms, rtol=1e-9)
    assert here.steps[-1].rms_moving[1] < 1.3 * found.budget[-1].holdout_rms_moving[1]
    assert found.held_run.time[1] == pytest.approx(1.0 / ROW_RATE_HZ)
    (tmp_path / "c.json").write_text(json.dumps({**one, "schema": 2}))
    with pytest.raises(mc.CalibrationError, match="is of schema 2, this version knows 1"):
        mc.load_motion(tmp_path / "c.json")


@pytest.mark.parametrize(
    ("more", "said"),
    [
        ({"drive_gain": [1.0, 2.0, 3.0]}, "holds torques, not currents"),
        ({"exclude": ["stiction"]}, "no effect 'stiction'"),
        ({"holdout_run": "run9"}, "no run 'run9'; choose run0, run1"),
        ({"holdout_run": ["run0", "run1"]}, "leaves no run to learn from"),
        ({"holdout": 1.5}, "must lie between 0 and 1"),
        ({"ratio": [1.0, 2.0]}, "one for each of 3 joints"),
    ],
)
def test_what_cannot_be_is_one_line(more: dict[str, object], said: str) -> None:
    with pytest.raises(mc.OptionError, match=said):
        mc.diagnose_motion(ARM, simulated(runs=2), **more)  # type: ignore[arg-type]


def test_the_command_says_what_an_option_must_be(capsys: pytest.CaptureFixture[str]) -> None:
    for option, value, said in (
        ("--payload", "two", "--payload 'two': give KG@x,y,z in kg and m, as 2@0,0,0.05"),
        ("--drive-gain", "1,x", "--drive-gain '1,x': give numbers separated by commas"),
    ):
        assert run("torques", "ur10", "run.csv", option, value) == 2
        assert said.split("'")[0].strip() in capsys.readouterr().err


def test_currents_without_a_gain_are_refused_before_the_search(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """A simulator counts in N m: said at once, not after minutes."""
    ARM.save(tmp_path / "arm.json")
    time = np.arange(0.0, 4.0, 0.02)
    rows = ["t_s,q1_rad,q2_rad,q3_rad,i1_A,i2_A,i3_A"]
    both = np.array([time, np.sin(time), np.cos(time), time / 9, time, -time, np.sqrt(time)]).T
    rows += [",".join(f"{value:.6f}" for value in row) for row in both]
    (tmp_path / "run.csv").write_text("\n".join(rows) + "\n")
    monkeypatch.setattr(torques, "diagnose_motion", None)
    ways = (tmp_path / "arm.json", tmp_path / "run.csv", "--write", tmp_path / "out.xml")
    assert run("torques", *ways) == 2
    assert "--drive-gain" in capsys.readouterr().err


def test_the_picture_shows_every_joint() -> None:
    pytest.importorskip("matplotlib")
    from minimax_cal.reporting.plots.motion_figure import build_motion_figure

    found = mc.diagnose_motion(ARM, simulated(seed=2, runs=2))
    cells = build_motion_figure(found).axes
    assert len(cells) == 9
    measured, predicted = (line.get_ydata() for line in cells[0].lines)
    off = np.asarray(measured) - np.asarray(predicted)
    assert np.sqrt(np.mean(off**2)) < 3.0 * found.budget[-1].holdout_rms[0]
    assert_allclose(cells[2].lines[0].get_xdata()[-1], found.budget[-1].holdout_rms_moving[0])


def stopping(seed: int, share: float = 0.0) -> mc.Run:
    """A run that stops and creeps back, with friction of bristles that yield after 1 mrad.

    share: of the load at joint 2 that is friction too.
    """
    rng, time = np.random.default_rng(seed), np.arange(0.0, 20.0, 0.01)
    rate = 0.5 - 0.5 * np.tanh(4.0 * (time - 14.0))  # of the motion, which ends at 14 s
    q = fourier(rng, np.cumsum(rate) * 0.01, 3, 0.15)[0]
    q -= np.sign(np.gradient(q, axis=0)[1380]) * 4e-4 * np.clip((time[:, None] - 15.0) / 4, 0, 1)
    qd = np.gradient(q, time, axis=0)
    motion = JointMotion(q, qd, np.gradient(qd, time, axis=0))
    rigid = inverse_dynamics(ARM, motion, build_nominal_inertial_parameters(ARM))
    torque = rigid + qd * [3.0, 4.0, 1.0]
    torque[:, 1] += share * np.abs(rigid[:, 1]) * np.sign(qd[:, 1])
    bent = np.zeros(3)
    for i in range(len(time)):
        step = q[i] - q[max(i - 1, 0)]
        sense = np.sign(step)
        bent = sense + (bent - sense) * np.exp(-np.abs(step) / 1e-3)
        torque[i] += bent * [4.0, 3.0, 1.5]
    torque += 0.05 * rng.normal(size=torque.shape)
    return mc.Run(f"run{seed}", f"run{seed}.csv", time, q, None, None, torque, "N m")


def test_a_joint_that_stops_keeps_the_friction_of_its_bristles() -> None:
    found = mc.diagnose_motion(ARM, [stopping(seed) for seed in range(3)])
    whole = np.array(mc.evaluate_motion(found, [stopping(7)]).steps[-1].rms)
    last = found.models[-1]
    bare = replace(found, models=(replace(last, held=np.zeros_like(last.held)),))
    assert np.all(whole < 0.25 * np.array(mc.evaluate_motion(bare, [stopping(7)]).steps[-1].rms))
    assert_allclose(last.held, [[0.0, 4.0], [0.0, 3.0], [0.0, 1.5]], rtol=0, atol=0.4)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_motor_that_turns_by_two_joints_is_named_with_its_friction(sign):
    """As of a coupled wrist, whose file tells no coupling; friction at its joints is none of it."""

    def more(motion, rigid, time):
        w = motion.qd[:, 2] + sign * motion.qd[:, 1]
        at_motor = 5.0 * np.sign(w) + 2.0 * w
        return np.stack([0.0 * w, sign * at_motor, at_motor], axis=1)

    found = mc.diagnose_motion(ARM, simulated(more, seed=3, noise=0.05))
    assert found.verdict in ("named", "one_of")
    (named,) = [one for one in found.effects if one.effect == "coupled_drive"]
    assert (named.place, named.established) == ("J3", True)
    values = [one.value for one in named.parameters]
    assert_allclose(values, [5.0, 2.0, sign], rtol=0.01)
    plain = mc.diagnose_motion(ARM, simulated(seed=3, noise=0.05))
    assert "coupled_drive" not in [one.effect for one in plain.effects]
