"""The gap in a simulator: rung by rung what the fit says, and the corrected file keeps it."""

import json
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import minimax_cal as mc
from minimax_cal.diagnosing.diagnosis import load_diagnosis
from minimax_cal.modelling.cell import build_measurements_at_rest
from minimax_cal.modelling.effects.table import Fitted, Term, parse_effect_terms
from minimax_cal.reporting.html import read_report_sources
from minimax_cal.robots.gravity_torques import assumed_link_masses_and_centres
from minimax_cal.robots.joint_sampling import random_joint_values_above_floor
from minimax_cal.simulators.result import GapStep, SimulatorGap
from tests.conftest import run, shared
from tests.problems_mjcf import published_like

mujoco = pytest.importorskip("mujoco", reason="needs mujoco: pip install minimax-cal[mujoco]")

from experiments import simulator_gap as study  # noqa: E402
from minimax_cal.robots.mjcf_import import read_mujoco_model  # noqa: E402
from minimax_cal.simulators import gap as gap_module  # noqa: E402
from minimax_cal.simulators.chain import find_model_arm  # noqa: E402
from minimax_cal.simulators.gap import carry_terms_to_known_masses  # noqa: E402

AGREES = 0.01  # between simulator and fit, held-out RMS [mm]
PLACED = 0.15  # of an error that the poses it is judged by have placed
NOISE_MM = 0.03  # RMS of 10 um an axis, with what 9 poses leave open
WITHIN = 1.1  # of the rung that holds only effects with an element
KEYS = {"name", "holdout_rms_mm", "holdout_max_mm"}
BEFORE = ["as given", "servo sag removed", "calibrated geometry"]  # names of the first rungs


@pytest.fixture(scope="module")
def few_moves() -> Iterator[None]:
    """Two dozen training poses place base and targets: every pose is a move of seconds."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(gap_module, "MAX_TRAINING_POSES", 24)
        yield


@pytest.fixture(scope="module")
def arm(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A published-like model, poses that its real twin took, and a fit of them."""
    folder = tmp_path_factory.mktemp("arm")
    robot = mc.load_robot("ur10")
    given = read_mujoco_model(published_like(folder, robot))
    weighs = find_model_arm(given.compile_model(), 6, given.source).robot
    truth = mc.Truth(compliance=3e-6)
    mc.write_measurements(folder / "poses.csv", mc.simulate(weighs, 60, seed=3, truth=truth).data)
    fit = mc.calibrate(robot, folder / "poses.csv", "sum", effects="joint_compliance:all")
    fit.save(folder / "fit.json")
    return folder


@pytest.fixture(scope="module")
def gap(arm: Path, few_moves: None) -> SimulatorGap:
    return mc.simulator_gap(
        arm / "arm.xml", arm / "poses.csv", fit=arm / "fit.json", write=arm / "corrected.xml"
    )


def test_the_ladder_falls_to_what_the_fit_says(arm, gap):
    names = [rung.name for rung in gap.rungs]
    assert names[:3] == BEFORE
    assert [name.split()[1] for name in names[3:]] == ["joint_compliance"]
    held = [rung.holdout_rms_mm for rung in gap.rungs]
    assert sorted(held, reverse=True) == held
    assert held[0] > 3.0 * held[1]  # published gains: the sag is most of it
    assert gap.rungs[0].sag_mrad > 5.0
    for rung in gap.rungs[2:]:
        assert abs(rung.holdout_rms_mm - rung.predicted_rms_mm) < AGREES
    fit = mc.load_fit(arm / "fit.json")
    assert gap.holdout_poses == int(fit.held.sum())
    assert abs(held[-1] - fit.accuracy["holdout"].rms_mm) < AGREES


def test_the_corrected_file_reproduces_the_last_rung(arm, gap):
    again = mc.simulator_gap(arm / "corrected.xml", arm / "poses.csv", fit=arm / "fit.json")
    assert abs(again.rungs[0].holdout_rms_mm - gap.rungs[-1].holdout_rms_mm) < 1e-3


def test_a_report_tells_that_the_simulator_met_another_arm(arm, gap):
    pytest.importorskip("plotly")
    fit = mc.load_fit(arm / "fit.json")
    assert read_report_sources([fit, gap]).notices == ()
    here = replace(gap.provenance, data_sha256="0" * 64)
    new = replace(gap, robot=fit.robot.name, provenance=here)
    (notice,) = read_report_sources([fit, new]).notices
    assert "measurements" in notice
    (notice,) = read_report_sources([fit, replace(new, robot="another")]).notices
    assert "another" in notice
    assert fit.robot.name in notice


def test_the_command_and_the_report(arm, gap, tmp_path, capsys):
    pytest.importorskip("plotly")
    pytest.importorskip("matplotlib")
    mc.export("ur10", "urdf", tmp_path / "arm.urdf", notify=lambda notice: None)
    ways = (arm / "poses.csv", "--fit", arm / "fit.json", "--write", tmp_path / "corrected.xml")
    more = ("--json", "-o", tmp_path / "gap.json", "--figure", tmp_path / "gap.svg")
    assert run("gap", tmp_path / "arm.urdf", *ways, *more) == 0
    said = capsys.readouterr()
    found = json.loads(said.out)
    assert "servo" in said.err  # a URDF has none: joints are set
    assert found["rungs"][0]["sag_mrad"] == 0.0
    assert [rung["name"] for rung in found["rungs"]][:2] == ["as given", "calibrated geometry"]
    last = found["rungs"][-1]
    assert abs(last["holdout_rms_mm"] - gap.rungs[-1].holdout_rms_mm) < AGREES
    assert mujoco.MjModel.from_xml_path(str(tmp_path / "corrected.xml")).nu == 6
    assert "<svg" in (tmp_path / "gap.svg").read_text()
    page = tmp_path / "report.html"
    assert run("report", arm / "fit.json", tmp_path / "gap.json", "-o", page) == 0
    assert f"{last['holdout_rms_mm']:.4f}" in page.read_text()
    assert run("report", tmp_path / "gap.json", "-o", page) == 2


def test_models_that_do_not_fit_are_refused(arm, tmp_path, capsys):
    other = tmp_path / "other.xml"
    mc.export("scara_600", "mjcf", other, notify=lambda notice: None)
    broken, empty = tmp_path / "broken.xml", tmp_path / "empty.xml"
    broken.write_text("<mujoco><worldbody><body><joint type='no'/></body></worldbody></mujoco>")
    empty.write_text("<mujoco><include file='gone.xml'/></mujoco>")
    for model, said in (
        (other, "6 hinges"),
        (broken, "MuJoCo"),
        (empty, "gone.xml"),
        (arm / "poses.csv", "XML"),
        (tmp_path / "absent.xml", "absent.xml"),
    ):
        assert run("gap", model, arm / "poses.csv", "--fit", arm / "fit.json") == 2
        assert said in capsys.readouterr().err
    mc.export("irb2600", "mjcf", other, notify=lambda notice: None)
    assert run("gap", other, arm / "poses.csv", "--fit", arm / "fit.json") == 2
    assert "nominal robot" in capsys.readouterr().err


@pytest.mark.slow  # the quick studies run it besides
def test_the_study_in_its_quick_form():
    result = study.run_trial(study.SimulatorTrial("ur10", 48, 0))
    for rung in result.gap.rungs[2:]:
        assert abs(rung.holdout_rms_mm - rung.predicted_rms_mm) < AGREES
    assert abs(result.alone_mm - result.gap.rungs[-1].holdout_rms_mm) < AGREES


@pytest.fixture(scope="module")
def stiffening(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An arm whose second joint gives way to light loads most, which no spring does, and a fit."""
    folder = tmp_path_factory.mktemp("stiffening")
    robot = study.add_light_masses(mc.load_robot("irb2600"))
    rng = np.random.default_rng(0)
    plain = mc.simulate(robot, 3, seed=0, truth=mc.Truth(noise=0.0)).cell
    q = random_joint_values_above_floor(robot, 100, rng, 2.0)
    effects = ("joint_compliance:all", "joint_compliance:J2:within=60", "base_flex:frame")
    scene = plain.pose_arm(mc.measurements(q, plain.predict(q)))
    found = parse_effect_terms(scene, effects)
    sizes = (3e-6, 1e-5, 5e-7)
    values = tuple(
        np.full(len(t.columns(scene).names), c) for t, c in zip(found, sizes, strict=True)
    )
    y = replace(plain, effects=Fitted(found, values)).predict(q)
    data = mc.measurements(q, y + 10e-6 * rng.normal(size=y.shape))
    mc.export(robot, "mjcf", folder / "arm.xml", notify=lambda notice: None)
    mc.write_measurements(folder / "poses.csv", data)
    mc.calibrate(robot, folder / "poses.csv", "sum", effects=effects).save(folder / "fit.json")
    return folder


@pytest.mark.slow
def test_an_effect_without_an_element_is_no_rung_and_what_was_fitted_beside_it_is_not_used(
    stiffening, monkeypatch
):
    monkeypatch.setattr(
        gap_module, "MAX_TRAINING_POSES", 100
    )  # what is left is much more than noise
    written = stiffening / "corrected.xml"
    ways = {"data": stiffening / "poses.csv", "fit": stiffening / "fit.json"}
    gap = mc.simulator_gap(stiffening / "arm.xml", **ways, write=written)
    effects = [rung.name.split()[1] for rung in gap.rungs[3:]]
    assert effects == ["joint_compliance", "base_flex"]
    held = [rung.holdout_rms_mm for rung in gap.rungs[2:]]
    assert sorted(held, reverse=True) == held
    assert gap.commands is not None
    assert gap.commands.holdout_rms_mm < 0.7 * held[-1]
    for rung in (*gap.rungs[2:], gap.commands):
        assert abs(rung.holdout_rms_mm - rung.predicted_rms_mm) < AGREES
    assert not gap_module.list_disagreements_with_fits([*gap.rungs, gap.commands])
    # the model that is driven with the map is another file than the best one without
    commands = mc.load_commands(stiffening / "corrected.commands.json")
    fit = mc.load_fit(stiffening / "fit.json")
    told = {"corrected.xml": (gap.rungs[-1], lambda q: q),
            "corrected.commands.xml": (gap.commands, commands)}  # fmt: skip
    for name, (rung, asked) in told.items():
        alone = driven(stiffening / name, fit, asked)
        assert abs(alone - rung.holdout_rms_mm) < PLACED * rung.holdout_rms_mm


def driven(path: Path, fit: mc.Fit, asked: Callable[[np.ndarray], np.ndarray]) -> float:
    """Held-out RMS of a file where it rests, placed as well as can be [mm]."""
    model, points = mujoco.MjModel.from_xml_path(str(path)), []
    data, names = mujoco.MjData(model), fit.data.target_names
    for q in fit.data.q[fit.held]:
        mujoco.mj_resetData(model, data)
        data.ctrl[:] = asked(q)
        for i in range(6):
            data.joint(f"joint{i + 1}").qpos[0] = q[i]
        mujoco.mj_step(model, data, 1500)
        points += [data.site(name).xpos.copy() for name in names]
    seen, real = np.array(points), fit.data.y[fit.held].reshape(-1, 3)
    _, off = Rotation.align_vectors(real - real.mean(axis=0), seen - seen.mean(axis=0))
    return float(1e3 * off / np.sqrt(len(real)))


def test_what_makes_the_simulator_worse_is_not_written(stiffening, tmp_path, monkeypatch):
    monkeypatch.setattr(gap_module, "MAX_TRAINING_POSES", 12)
    monkeypatch.setattr(gap_module, "MAX_RELATIVE_ERROR_RISE", -0.9)  # no rung is so much better
    monkeypatch.setattr(gap_module, "MAX_FORMULA_DISAGREEMENT_MM", -1.0)
    gap = mc.simulator_gap(
        stiffening / "arm.xml", stiffening / "poses.csv", fit=stiffening / "fit.json",
        write=tmp_path / "corrected.xml",
    )  # fmt: skip
    assert gap.rungs[-1].name == "calibrated geometry"
    assert [name in text for name, text in zip(("joint compliance", "base flex"), gap.left_out,
                                               strict=True)] == [True, True]  # fmt: skip
    assert all(any(text in notice for notice in gap.notices) for text in gap.left_out)
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "corrected.xml"))
    assert "base_flex_x" not in [model.joint(i).name for i in range(model.njnt)]


def test_a_simulator_that_does_other_than_the_fit_says_so():
    rung = GapStep("+ base_flex frame", 0.0950, 0.3, 0.0950, 0.3, 0.0, predicted_rms_mm=0.0800)
    (said,) = gap_module.list_disagreements_with_fits(
        [rung, replace(rung, predicted_rms_mm=0.0900)]
    )
    assert all(fact in said for fact in ("base flex", "0.0950 mm", "0.0800 mm"))
    assert not gap_module.list_disagreements_with_fits(
        [replace(rung, predicted_rms_mm=float("nan"))]
    )


@pytest.mark.slow
@pytest.mark.parametrize("name", ["irb120", "ur10_b"])
def test_real_arms_end_where_effects_with_an_element_end(name, tmp_path):
    robot, data = shared(name)
    mc.export(robot, "mjcf", tmp_path / "arm.xml", notify=lambda notice: None)
    mc.diagnose(robot, data).save(tmp_path / "diagnosis.json")
    gap = mc.simulator_gap(tmp_path / "arm.xml", data, diagnosis=tmp_path / "diagnosis.json")
    assert gap.rungs[-1].holdout_rms_mm < WITHIN * gap.rungs[-1].predicted_rms_mm
    ladder = load_diagnosis(tmp_path / "diagnosis.json").ladder
    assert np.isclose(gap.rungs[2].predicted_rms_mm, ladder[1].holdout.rms_mm, rtol=0.02)


def test_laws_chosen_for_guessed_masses_are_chosen_anew_for_told_ones():
    told = mc.load_robot("irb2600")
    mass, com = assumed_link_masses_and_centres(told.mdh)
    told = replace(told, mass=np.maximum(mass, 1.0), com=com)
    soft = Term("joint_compliance", "J2", {"parts": 128.0, "within": 9.0, "assumed": 1.0})
    every = Term("joint_compliance", "all", {"parts": 112.0})
    sag = Term("link_bending", "L2", {"tool": 1.0})
    known = Term("joint_compliance", "J3", {"parts": 2048.0, "within": 9.0})
    new = carry_terms_to_known_masses((soft, every, sag, known), told)
    assert [(t.label, dict(t.choice)) for t in new] == [
        ("joint_compliance:all", {}), ("joint_compliance:J2", {}), ("link_bending:L2", {}),
        (known.label, dict(known.choice)),
    ]  # fmt: skip
    assert carry_terms_to_known_masses((known, soft), mc.load_robot("irb2600")) == (known, soft)
    assert carry_terms_to_known_masses((known,), told) == (known,)


POST = "<geom name='pillar' type='capsule' size='.03 .6' pos='.45 0 .5'/>"


def beside_a_pillar(pillar: str = POST, servo: str = "position kp='3000' kv='90'") -> str:
    """An arm of three joints that turns its link of .4 m about a pillar .45 m away."""
    names = [f"turn{i}" for i in (1, 2, 3)]
    servos = "".join(f"<{servo} name='{name}' joint='{name}'/>" for name in names)
    axes, at = ("0 0 1", "0 1 0", "0 1 0"), ("0 0 .4", "0 0 .1", ".4 0 0")
    links = "".join(
        f"<body name='link{i}' pos='{place}'><joint name='{name}' axis='{axis}' armature='.1'/>"
        f"<geom type='capsule' fromto='0 0 0 {reach} 0 0' size='.02' mass='1'/>"
        for i, name, axis, place, reach in zip(
            "abc", names, axes, at, (0.01, 0.4, 0.2), strict=True
        )
    )
    return (
        "<mujoco><compiler angle='radian'/><option integrator='implicitfast'/><worldbody>"
        f"{pillar}{links}{3 * '</body>'}</worldbody><actuator>{servos}</actuator></mujoco>"
    )


def robot_of(path: Path) -> mc.Robot:
    given = read_mujoco_model(path)
    return find_model_arm(given.compile_model(), 3, given.source).robot


@pytest.fixture(scope="module")
def turned(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, mc.Measurements]:
    """Poses on either side of the pillar by turns, the first three in it."""
    folder, rng = tmp_path_factory.mktemp("pillar"), np.random.default_rng(5)
    side = np.where(np.arange(40) % 2, 1.0, -1.0)
    q = np.column_stack([side * rng.uniform(0.5, 1.3, 40), rng.uniform(-0.5, 0.5, (40, 2))])
    q[:3, 0] = 0.0
    model = mujoco.MjModel.from_xml_string(beside_a_pillar())
    model.body_pos[1:] += 1e-3 * rng.normal(size=(3, 3))
    data, spots = mujoco.MjData(model), np.array([[0.2, 0.05, 0.0], [0.15, -0.05, 0.03]])
    y = np.empty((40, 2, 3))
    for row, values in enumerate(q):
        data.qpos[:] = values
        mujoco.mj_forward(model, data)
        assert bool(data.ncon) == (row < 3)
        y[row] = data.xpos[3] + spots @ data.xmat[3].reshape(3, 3).T
    (folder / "arm.xml").write_text(beside_a_pillar())
    rows = build_measurements_at_rest(q, ("smr1", "smr2"), robot_of(folder / "arm.xml"))
    y += 1e-5 * rng.normal(size=y.shape)
    return folder, replace(rows, y=y, source="poses.csv")


def test_a_pillar_between_poses_is_nothing_that_an_arm_rests_on(turned):
    folder, data = turned
    (folder / "post.xml").write_text(beside_a_pillar())
    (folder / "free.xml").write_text(beside_a_pillar(""))
    apart = data.take(np.arange(3, len(data.q)))
    fit = mc.calibrate(robot_of(folder / "free.xml"), apart, "sum")
    post, free = (mc.simulator_gap(folder / f"{name}.xml", apart, fit=fit)
                  for name in ("post", "free"))  # fmt: skip
    for with_post, without in zip(post.rungs, free.rungs, strict=True):
        assert with_post.holdout_rms_mm == pytest.approx(without.holdout_rms_mm, rel=1e-6)
        assert with_post.sag_mrad == pytest.approx(without.sag_mrad, rel=1e-6)
    assert free.rungs[-1].holdout_rms_mm < NOISE_MM
    assert not any("touches" in text for text in post.notices)
    fit = mc.calibrate(fit.nominal.robot, data, "sum")
    whole = mc.simulator_gap(folder / "post.xml", data, fit=fit)
    (notice,) = [text for text in whole.notices if "touches" in text]
    assert "3 poses" in notice
    assert whole.holdout_poses == int(fit.held[3:].sum())
    assert whole.rungs[-1].holdout_rms_mm < NOISE_MM


def test_motors_named_as_their_joints(turned):
    folder, data = turned
    (folder / "named.xml").write_text(beside_a_pillar("", "motor"))
    fit = mc.calibrate(robot_of(folder / "named.xml"), data, "sum")
    gap = mc.simulator_gap(folder / "named.xml", data, fit=fit, write=folder / "corrected.xml")
    assert gap.rungs[-1].holdout_rms_mm < NOISE_MM
    model = mujoco.MjModel.from_xml_path(str(folder / "corrected.xml"))
    assert [model.actuator(i).name for i in range(6)] == [
        f"turn{i}{ending}" for ending in ("", "_servo") for i in (1, 2, 3)
    ]


def test_poses_of_another_arm_are_refused(arm):
    data = mc.simulate("irb2600", 30, 3, seed=1).data
    with pytest.raises(mc.DataError, match="of the calibrated arm"):
        mc.simulator_gap(arm / "arm.xml", data, fit=arm / "fit.json")
    metres = mc.simulate("ur10", 30, 3, seed=1).data
    with pytest.raises(mc.DataError, match="millimetres given as metres"):
        mc.simulator_gap(arm / "arm.xml", metres.with_y(1e3 * metres.y), fit=arm / "fit.json")
