"""Effects fitted together with the geometry: what was put into simulated data comes out again."""

import json
import runpy
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from conftest import ROOT
from numpy.testing import assert_allclose
from problems_fit import MASSES, SPOTS, weighty
from scipy.spatial.transform import Rotation

import minimax_cal as mc
from minimax_cal.core.arrays import Array
from minimax_cal.measuring.visit_history import add_history_columns
from minimax_cal.modelling.effects import EFFECTS, Term
from minimax_cal.modelling.effects.joint_error_maps import sine_count_over_span, sine_factor_sigmas
from minimax_cal.modelling.effects.table import Fitted, parse_effect_terms
from minimax_cal.modelling.effects_in_model import (
    extend_model_with_effects,
    pose_arm_at_values,
    split_values_by_effect,
)
from minimax_cal.modelling.parameters import ParameterValues
from minimax_cal.modelling.point_model import PointModel, build_point_model
from minimax_cal.robots import kinematics
from minimax_cal.robots.joint_sampling import random_joint_values_above_floor

EXAMPLE = ROOT / "examples" / "own_effect.py"
NOISE = 15e-6  # standard deviation of a coordinate [m]
FLOOR_MM = 1e3 * NOISE * np.sqrt(3.0)  # RMS distance that noise alone leaves
ROBOT = weighty(3)


def visited(poses: int = 90, seed: int = 1) -> mc.Measurements:
    """Poses that are not measured yet, with the columns that laws ask for."""
    rng = np.random.default_rng(seed)
    q = random_joint_values_above_floor(ROBOT, poses, rng)
    nothing = np.arange(poses * 9.0).reshape(poses, 3, 3)
    return mc.measurements(
        q,
        nothing,
        order=np.arange(poses, dtype=float),
        temperature=20.0 + 8.0 * rng.uniform(size=poses),
        payload=rng.choice([0.0, 5.0, 10.0], poses),
    )


def true_cell(robot: mc.Robot = ROBOT, seed: int = 2) -> mc.Cell:
    """A robot that is not quite its drawing, somewhere."""
    rng = np.random.default_rng(seed)
    mdh = robot.mdh + rng.normal(size=(6, 5)) * [3e-4, 3e-4, 5e-4, 5e-4, 5e-4]
    base = np.eye(4)
    base[:3, :3] = Rotation.from_rotvec([0.4, -0.8, 1.9]).as_matrix()
    base[:3, 3] = [2.0, 1.5, -0.7]
    return mc.Cell(robot.with_mdh(mdh), base, ("smr1", "smr2", "smr3"), SPOTS)


def with_effects(cell: mc.Cell, data: mc.Measurements, put: dict[str, list[float]]) -> mc.Cell:
    """The cell with effects of these values."""
    chosen = parse_effect_terms(cell.pose_arm(data), list(put))
    return replace(cell, effects=Fitted(chosen, tuple(map(np.array, put.values()))))


def measured(cell: mc.Cell, data: mc.Measurements, seed: int = 3) -> mc.Measurements:
    """The data as an instrument with noise sees the cell."""
    y = cell.follow(data)
    return data.with_y(y + np.random.default_rng(seed).normal(scale=NOISE, size=y.shape))


def seen(put: dict[str, list[float]]) -> mc.Measurements:
    """What an instrument sees of the true cell with effects."""
    data = visited()
    return measured(with_effects(true_cell(), data, put), data)


def values(fit: mc.Fit, text: str) -> list[tuple[float, float]]:
    """Value and sigma of each parameter of an effect."""
    stem = ":".join(text.split(":")[:2])
    return [(p.value, p.sigma) for p in fit.parameters if p.name.startswith(f"{stem}.")]


def check_found(fit: mc.Fit, put: dict[str, list[float]], sigmas: float = 4.0) -> None:
    """Every parameter within four of its sigmas, and one seen at ten or more."""
    for text, truth in put.items():
        found = values(fit, text)
        assert len(found) == len(truth)
        for (value, sigma), true in zip(found, truth, strict=True):
            assert abs(value - true) < sigmas * sigma
        assert max(abs(value) / sigma for value, sigma in found) > 10.0


# factors of sines as the prior of the curve has them
MAP = (
    1e-3
    * sine_factor_sigmas(2.0, 1.5, sine_count_over_span(1.5))
    * np.random.default_rng(4).normal(size=29)
)
CASES: dict[str, list[float]] = {
    "joint_compliance:J2": [6e-7],
    "cross_compliance:J2:source=3": [8e-7],
    "gravity_compensator:J2:zero=3.1:eye=0.4:rest=0.45": [2e-3],
    "gravity_compensator:J2:zero=0:eye=0.4:rest=0.45": [2e-3],
    "link_bending:L2": [3e-7],
    "base_flex:frame": [2e-7],
    "tool_flex:all:lever=1": [1e-3, 2e-4],
    "gear_error:J3:turns=2": [3e-4, -2e-4],
    "gear_ripple:J1:turns=17": [2e-4, 1e-4],
    "encoder_gain:J1": [4e-4],
    "joint_error_map:J1:low=-1:high=0.5:length=2:size=0.001": MAP.tolist(),
    "joint_coupling:J5:source=4": [5e-4],
    "axis_wobble:J1:turns=1": [2e-4, -3e-4],
    "axis_wobble:J4:turns=2": [2e-4, -3e-4, 4e-4, 1e-4],
    "backlash:all": [2e-4, -1e-4, 3e-4, 2e-4, 4e-4, 5e-4],
    "settling:J3": [1e-3],
    "encoder_zero:J3:since=0.4": [4e-4],
    "thermal_growth:all:constant=0.5:apart=0": [4e-4],
    "thermal_growth:all:temperature=1:apart=0": [1.2e-5],
    "thermal_growth:all:fast=0.15:slow=inf:apart=0": [4e-4, 2e-4],
    "frame_drift:frame:constant=0.5": [3e-4, -2e-4, 1e-4, 1e-4, -2e-4, 3e-4],
    "session_jump:frame:since=0.4": [3e-4, -2e-4, 1e-4, 1e-4, -2e-4, 3e-4],
    "target_shift:smr2:since=0.4": [1e-4, 2e-4, -3e-4],
    "target_reseat:all:since=0.4:apart=0": [1e-4, 2e-4, -3e-4, 1e-3, -2e-3, 1e-3],
    "target_offset:smr1": [5e-4],
}


def test_every_effect_is_put_in():
    assert {text.partition(":")[0] for text in CASES} == set(EFFECTS)


@pytest.mark.parametrize("text", CASES)
def test_an_effect_that_is_put_in_is_found(text):
    put = {text: CASES[text]}
    data = seen(put)
    fit = mc.calibrate(ROBOT, data, objective="sum", effects=[text])
    assert str(fit.status) == "converged"
    check_found(fit, put)
    # 72 poses of 3 targets for at most 40 parameters: 3 % above the noise, its own scatter 5 %
    assert fit.accuracy["holdout"].rms_mm < 1.15 * FLOOR_MM
    plain = mc.calibrate(ROBOT, data, objective="sum")
    assert plain.accuracy["holdout"].rms_mm > 1.3 * fit.accuracy["holdout"].rms_mm


@pytest.mark.parametrize("objective", ["sum", "minimax", "point", "pose", "smr:1"])
def test_effects_are_found_with_every_objective(objective):
    put = {"joint_compliance:all": [1e-6, 8e-7, 2e-6, 1e-5], "encoder_gain:J1": [3e-4]}
    data = visited()
    cell = with_effects(true_cell(), data, put)
    assert len(put["joint_compliance:all"]) == len(cell.effects.terms[0].columns(
        cell.pose_arm(data)).names)  # fmt: skip
    fit = mc.calibrate(ROBOT, measured(cell, data), objective=objective, effects=list(put))
    assert str(fit.status) == "converged"
    # the worst points decide alone, and the sigmas told are those of a sum over all points
    most, sigmas = (1.5, 12.0) if objective == "point" else (1.2, 4.0)
    check_found(fit, put, sigmas)
    assert fit.accuracy["holdout"].rms_mm < most * FLOOR_MM


def test_finite_turns_are_taken_in_the_second_pass():
    """4 mrad at a lever of 2 m: to first order alone the points would miss by 16 um."""
    put = {"joint_compliance:J2": [2.5e-6], "joint_compliance:J3": [5e-6]}
    data = visited()
    cell = with_effects(true_cell(), data, put)
    turn = cell.effects.joint_shifts(cell.pose_arm(data))
    assert np.abs(turn).max() > 3e-3
    data = data.with_y(cell.follow(data))  # no noise
    fit = mc.calibrate(ROBOT, data, objective="sum", effects=list(put))
    assert fit.accuracy["holdout"].max_mm < 1e-3
    for text, (true,) in put.items():
        assert_allclose(values(fit, text)[0][0], true, rtol=2e-4)  # `up` as the nominal base has it


def test_priors_are_weighed_against_the_noise_that_effects_leave():
    """The effect would pass for noise of a millimetre, and the priors then win over the data."""
    put = {"joint_compliance:J2": [2e-6]}
    priors = {"a*": 1e-3, "d*": 1e-3, "theta*": 1e-3, "alpha*": 1e-3}
    fit = mc.calibrate(ROBOT, seen(put), objective="sum", effects=list(put), priors=priors)
    check_found(fit, put)
    assert fit.accuracy["holdout"].rms_mm < 1.15 * FLOOR_MM


def test_each_of_several_lines_of_a_gear_has_a_name(tmp_path: Path):
    """The waves a turn tell one from another; a lone line goes without."""
    lines = {"gear_ripple:J3:turns=17": [2e-4, 1e-4], "gear_ripple:J3:turns=31.5": [-1e-4, 3e-4]}
    fit = mc.calibrate(ROBOT, seen(lines), objective="sum", effects=[*lines, "backlash:J2"])
    names = [p.name for p in fit.parameters if p.is_of_effect]
    assert names == [
        "gear_ripple:J3.cos 17/turn", "gear_ripple:J3.sin 17/turn",
        "gear_ripple:J3.cos 31.5/turn", "gear_ripple:J3.sin 31.5/turn", "backlash:J2.b2",
    ]  # fmt: skip
    fit.save(tmp_path / "fit.json")
    again = mc.load_fit(tmp_path / "fit.json")
    for name, value in zip(names, np.concatenate([*lines.values()]), strict=False):
        found = again.parameters[name]
        assert abs(found.value - value) < 4.0 * found.sigma
        assert found.sigma < 5e-5


# ---------------------------------------------------------------- what cannot be told


def test_an_effect_that_is_geometry_is_not_identified():
    """A wave that never turns is a constant: theta3, and nothing."""
    data = measured(true_cell(), visited())
    text = "gear_ripple:J3:turns=0"
    fit = mc.calibrate(ROBOT, data, objective="sum", effects=[text])
    cos, sin = (p for p in fit.parameters if p.name.startswith("gear_ripple:J3."))
    for parameter in (cos, sin):
        assert not parameter.identifiable
        assert parameter.value == 0.0
        assert np.isnan(parameter.sigma)
    assert "theta3" in cos.reason
    assert sin.reason == "moves no measured point"
    assert [value.tolist() for value in fit.cell.effects.values] == [[0.0, 0.0]]
    plain = mc.calibrate(ROBOT, data, objective="sum")
    assert_allclose(fit.predict(data.q), plain.predict(data.q), rtol=0, atol=1e-9)


def test_the_same_effect_twice_is_told_once():
    data = seen({"encoder_gain:J1": [4e-4]})
    fit = mc.calibrate(ROBOT, data, objective="sum", effects=["encoder_gain:J1", "encoder_gain:J1"])
    found = [p for p in fit.parameters if p.name == "encoder_gain:J1.g1"]
    assert sorted(p.identifiable for p in found) == [False, True]
    (value,) = (p.value for p in found if p.identifiable)
    assert_allclose(value, 4e-4, rtol=0.1)
    assert fit.accuracy["holdout"].rms_mm < 1.15 * FLOOR_MM


# ---------------------------------------------------------------- saving, predicting, evaluating


MANY = {
    "joint_compliance:J2": [6e-7],
    "backlash:J5": [4e-4],
    "frame_drift:frame:constant=inf": [2e-4, 0.0, 1e-4, 0.0, 1e-4, 0.0],
    "target_shift:smr3:since=0.5": [1e-4, 0.0, 2e-4],
    "thermal_growth:all:temperature=1:apart=0": [1e-5],
}


@pytest.fixture(scope="module")
def many() -> tuple[mc.Cell, mc.Measurements, mc.Fit]:
    """True cell, data and fit with several effects."""
    data = visited()
    cell = with_effects(true_cell(), data, MANY)
    data = measured(cell, data)
    return cell, data, mc.calibrate(ROBOT, data, objective="sum", effects=list(MANY))


def test_several_effects_are_found_at_once(many):
    check_found(many[2], MANY)


def test_a_saved_fit_predicts_the_same(many, tmp_path):
    _, data, fit = many
    fit.save(tmp_path / "fit.json")
    cell = mc.load_cell(tmp_path / "fit.json")
    assert_allclose(cell.predict(data.q), fit.predict(data.q), rtol=0, atol=1e-12)
    assert_allclose(cell.follow(data), fit.cell.follow(data), rtol=0, atol=1e-12)
    told = mc.evaluate(cell, data)
    both = [fit.accuracy[part] for part in ("train", "holdout")]
    assert_allclose(sum(told.sse_mm2), sum(sum(a.sse_mm2) for a in both), rtol=1e-9)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"effect": "magic"}, "effect 'magic' is not known here"),
        ({"effect": "backlash", "place": "J9"}, "do not fit its robot"),
        ({"choice": {}}, "do not fit its robot"),
        ({"values": [1.0, 2.0]}, "joint_compliance:J2: 2 values for c2"),
    ],
)
def test_a_spoilt_file_is_refused(many, tmp_path, change, message):
    content = json.loads(many[2].json())
    content["cell"]["effects"][0] |= change
    path = tmp_path / "fit.json"
    path.write_text(json.dumps(content))
    with pytest.raises(mc.CalibrationError, match=message):
        mc.load_cell(path)


def test_predictions_hold_what_is_there_at_rest(many):
    """Compliance without payload turns joint 2; nothing else acts before the session begins."""
    _, data, fit = many
    cell = replace(fit.cell, effects=Fitted((), ()))
    links = kinematics.compute_link_frames(cell.robot.mdh, data.q * ROBOT.sign, ROBOT.prismatic)
    centre = links.after + np.einsum("naim,na->nim", axes_of(links), ROBOT.com)
    pull = np.array([0.0, 0.0, -9.80665])
    torque = sum(np.cross((centre[i] - links.before[1]).T, MASSES[i] * pull) for i in range(1, 6))
    along = (np.asarray(torque) * links.z[1].T).sum(axis=1)
    turned = data.q.copy()
    turned[:, 1] += values(fit, "joint_compliance:J2")[0][0] * along
    assert_allclose(fit.predict(data.q), cell.predict(turned), rtol=0, atol=1e-12)
    assert np.abs(fit.predict(data.q) - cell.predict(data.q)).max() > 1e-4
    assert_allclose(fit.predict(data.q[3]), fit.predict(data.q)[[3]], rtol=0, atol=1e-12)


def axes_of(links: kinematics.LinkFrames) -> Array:
    """(n, axis, 3, m) of every frame: z is the next joint's axis."""
    z = np.concatenate([links.z[1:], links.axes[2:]])
    return np.stack([kinematics.cross(links.y, z), links.y, z], axis=1)


def test_new_data_bring_their_own_columns(many):
    cell, _, fit = many
    cell = replace(cell, sessions=fit.cell.sessions)  # the clock runs on
    new = visited(40, seed=11)
    new = replace(new, columns={**new.columns, "payload": np.full(40, 10.0)})
    new = measured(cell, new, seed=12)
    told = mc.evaluate(fit.cell, new)
    assert told.rms_mm < 1.2 * FLOOR_MM
    for name in ("payload", "temperature"):
        less = replace(new, columns={k: v for k, v in new.columns.items() if k != name})
        assert mc.evaluate(fit.cell, less).rms_mm > 1.5 * told.rms_mm
    other_way = replace(new, columns={**new.columns, "order": np.arange(40.0)[::-1]})
    assert mc.evaluate(fit.cell, other_way).rms_mm > 1.5 * told.rms_mm


# ---------------------------------------------------------------- wishes


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("joint_complience:J2", "no effect 'joint_complience'; choose joint_compliance, "),
        ("joint_compliance:J9", "no place 'J9'; choose J2, J3, "),
        ("joint_compliance:J1", "no place 'J1'; choose J2, J3, "),  # upright: carries nothing
        ("gear_ripple:J2", "the robot file gives no ratio; write gear_ripple:J2:turns=17"),
        ("gear_ripple", "choose J1, J2"),
        ("gear_error:J2:turns", "write 'turns' as a name and number, turns=17"),
        ("gear_error:J2:turns=two", "write 'turns=two' as a name and number"),
        ("gear_error:J2:turn=2", "no choice 'turn'; choose orders, turns"),
        ("joint_coupling:J5:source=5", "no source 5; choose 3, 4"),
        ("tool_flex:all:lever=3", "no lever 3; choose 0, 1, 2"),
        ("backlash:J2:turns=2", "no choice 'turns'; its law has no such number"),
        ("frame_drift:frame:constant=0", "constant 0 is not possible"),
        ("gear_error:J2:turns=nan", "turns nan is not possible"),
        ("thermal_growth:all:temperature=1:constant=0.5", "no variant has temperature and"),
        ("target_shift:frame", "no place 'frame'; choose smr1, smr2, smr3"),
        ("outliers", "no effect 'outliers'"),
    ],
)
def test_a_wrong_wish_is_explained(text, message):
    data = measured(true_cell(), visited(60))
    with pytest.raises(mc.OptionError, match=message.replace("(", r"\(")):
        mc.calibrate(ROBOT, data, objective="sum", effects=[text])


def test_missing_columns_are_named():
    data = measured(true_cell(), visited(60))
    rest = np.zeros(60)
    still = {f"{stem}{j + 1}": rest for stem in ("approach", "move") for j in range(6)}
    data = replace(data, columns={**still, "clock": rest, "followed": rest})
    for text, message in (
        ("thermal_growth", "time_s, order or temperature_C"),
        ("frame_drift", "order or time_s"),
        ("backlash:J2", "approach1"),
        ("settling:J2", "order"),
    ):
        with pytest.raises(mc.OptionError, match=f"{text.partition(':')[0]}: .* lacks .*{message}"):
            mc.calibrate(ROBOT, data, objective="sum", effects=[text])
    one = data.only(0)
    with pytest.raises(mc.OptionError, match="a second target"):
        mc.calibrate(ROBOT, one, objective="sum", effects=["target_shift:smr1"])


def test_few_poses_suggest_no_moment():
    """A session too short to look for the moment of a shift: one can still tell it."""
    cell, data = true_cell(), visited(10)
    scene = cell.pose_arm(add_history_columns(data))
    with pytest.raises(mc.OptionError, match="write target_shift:smr1:since=NUMBER"):
        parse_effect_terms(scene, ["target_shift:smr1"])
    (term,) = parse_effect_terms(scene, ["target_shift:smr1:since=0.5"])
    assert term.choice == {"since": 0.5}


def test_effects_may_be_terms_too():
    data = measured(true_cell(), visited(60))
    term = Term("gear_error", "J2", {"turns": 2.0})
    fit = mc.calibrate(ROBOT, data, objective="sum", effects=[term])
    assert fit.cell.effects.terms == (term,)
    assert json.loads(fit.json())["provenance"]["settings"]["effects"] == [term.text]


def test_targets_may_be_missing_at_some_poses():
    put = {"joint_compliance:J2": [6e-7], "target_offset:smr1": [3e-4]}
    data = seen(put)
    y = data.y.copy()
    gone = np.random.default_rng(5).uniform(size=(90, 3)) < 0.3
    gone[gone.all(axis=1), 0] = False
    y[gone] = np.nan
    fit = mc.calibrate(ROBOT, data.with_y(y), objective="minimax", effects=list(put))
    check_found(fit, put)
    assert fit.accuracy["holdout"].rms_mm < 1.2 * FLOOR_MM


# ---------------------------------------------------------------- the model


def joined(
    texts: dict[str, list[float]],
) -> tuple[mc.Measurements, tuple[Term, ...], ParameterValues, PointModel]:
    """Data, terms, and the extended model at a state where the effects have values."""
    data = add_history_columns(visited(30))
    cell = with_effects(true_cell(), data, texts)
    data = measured(cell, data)
    state = ParameterValues(
        cell.robot.mdh,
        cell.base[:3, :3],
        cell.base[:3, 3],
        cell.target_positions,
        np.concatenate(cell.effects.values),
    )
    model, state = extend_model_with_effects(
        build_point_model(ROBOT, data), ROBOT, data, state, cell.effects.terms
    )
    return data, cell.effects.terms, state, model


LARGE = {
    "joint_compliance:all": [3e-6, 3e-6, 3e-6, 3e-5],
    "thermal_growth:all:fast=0.15:slow=inf:apart=0": [4e-4, 2e-4],
    "frame_drift:frame:constant=0.5": [1e-3] * 6,
    "target_offset:smr2": [2e-3],
}


def test_the_model_at_its_values_is_the_cell():
    """Columns, and what finite turns add to them, give the exact points again."""
    data, chosen, state, model = joined(LARGE)
    effects = split_values_by_effect(
        chosen, pose_arm_at_values(ROBOT, data, model, state), state.effects
    )
    cell = mc.Cell.from_parameters(ROBOT, state, data.target_names, effects)
    expected = cell.error(data) @ state.rotation  # into base axes
    assert_allclose(model.point_errors(state), expected, rtol=0, atol=1e-12)


def test_columns_are_the_derivative_of_the_error():
    """Central differences of every parameter, where the error is zero (paper S, eq. 12 ff.)."""
    _, _, state, model = joined(LARGE)
    off = np.einsum("ij,mkj->kim", state.rotation, model.point_errors(state))
    model = replace(model, y=model.y - off)
    jacobian = model.point_jacobian(state)
    for i in range(model.names.parameter_count):
        size = np.abs(jacobian[..., i]).max()
        step = 1e-5 / size * np.eye(model.names.parameter_count)[i]
        up, down = (model.point_errors(state.step(sign * step)) for sign in (1.0, -1.0))
        slope = -(up - down) / (2.0 * step[i])
        assert_allclose(slope, jacobian[..., i], rtol=0, atol=1e-6 * size,
                        err_msg=model.names.all_names[i])  # fmt: skip


# ---------------------------------------------------------------- one's own effect


@pytest.fixture
def library() -> Iterator[None]:
    """The library of effects, put back afterwards."""
    kept = dict(EFFECTS)
    yield
    EFFECTS.clear()
    EFFECTS.update(kept)


@pytest.mark.usefixtures("library")
def test_the_example_finds_its_effect(capsys):
    runpy.run_path(str(EXAMPLE), run_name="__main__")
    first, second = capsys.readouterr().out.splitlines()
    value, sigma = float(first.split()[2]), float(first.split()[4])
    assert abs(value - 5e-5) < 4.0 * sigma
    before, after = (float(second.split()[i]) for i in (3, 6))
    assert after < 0.5 * before
