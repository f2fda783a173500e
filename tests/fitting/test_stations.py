"""Sessions measured from several stations, jumps, and the clock that a fit keeps."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.spatial.transform import Rotation

import minimax_cal as mc
from minimax_cal.fitting.calibrate import refit_with_options
from minimax_cal.fitting.session_frames import base_poses_in_sessions
from minimax_cal.measuring.session_frames import instrument_positions
from minimax_cal.modelling.cell import list_session_and_time_notices
from minimax_cal.modelling.effects.table import NO_EFFECTS

# ---- stations ------------------------------------------------------------------------------------


ROBOT = "irb2600"
NOISE = mc.Truth(noise=20e-6, noise_per_metre=0.0, compliance=0.0)
HELD = 24  # poses of three targets that judge each fit
SAMPLING = 1.0 / np.sqrt(2.0 * 9.0 * HELD)  # relative, of an RMS over so many coordinates
EXACT = 1e-12  # metres, of transforms there and back
SHIFT = np.array([0.6e-3, -0.8e-3, 0.0])  # 1 mm


def labelled(data: mc.Measurements, session: np.ndarray) -> mc.Measurements:
    return replace(data, columns={**data.columns, "session": session})


def elsewhere(data: mc.Measurements, session: np.ndarray, seed: int = 0) -> mc.Measurements:
    """The same points, those of each session but the first seen from anywhere, turned anyhow."""
    y, rng = data.y.copy(), np.random.default_rng(seed)
    for name in np.unique(session)[1:]:
        turn, away = Rotation.random(rng=rng).as_matrix(), 4.0 * rng.normal(size=3)
        y[session == name] = y[session == name] @ turn.T + away
    return labelled(data.with_y(y), session)


ONE = mc.simulate(ROBOT, 120, 3, seed=1, truth=NOISE).data
SESSION = np.where(np.arange(120) % 2 == 0, "monday", "tuesday")
TWO = elsewhere(ONE, SESSION)


@pytest.fixture(scope="module")
def saved(tmp_path_factory: pytest.TempPathFactory) -> tuple[mc.Fit, Path]:
    fit = mc.calibrate(ROBOT, TWO, "minimax")
    path = tmp_path_factory.mktemp("stations") / "fit.json"
    fit.save(path)
    return fit, path


@pytest.mark.parametrize("objective", ["sum", "minimax", "pose"])
def test_two_stations_calibrate_as_well_as_one(objective):
    one, two = (mc.calibrate(ROBOT, data, objective) for data in (ONE, TWO))
    assert str(two.status) == "converged"
    assert two.accuracy["holdout"].poses == HELD
    assert_allclose(
        two.accuracy["holdout"].rms_mm, one.accuracy["holdout"].rms_mm, rtol=SAMPLING, atol=0
    )
    for name in ("a2", "d4", "alpha1", "smr1_x"):  # the same data, six unknowns more
        a, b = one.parameters[name], two.parameters[name]
        assert abs(a.value - b.value) < 2.0 * b.sigma
        assert a.sigma < 1.05 * b.sigma < 1.5 * a.sigma


def test_the_station_is_found(saved):
    """Points of the second station, in the first one's frame, are those it would have measured."""
    fit, _ = saved
    common = fit.cell.align_to_first_session(TWO)
    assert list(fit.cell.sessions.frames) == ["monday", "tuesday"]
    assert_allclose(common.y, ONE.y, rtol=0, atol=30e-6)  # sigma of a frame, three metres away
    truth = base_poses_in_sessions(fit.cell.sessions.frames, fit.cell.base)
    told = [p for p in fit.parameters if p.is_of_effect]
    assert_allclose([p.value for p in told], truth, rtol=1e-12)
    assert all(0.0 < p.sigma < 3e-5 for p in told)
    assert_allclose(instrument_positions(common)[SESSION == "monday"], 0.0, atol=EXACT)
    away = np.linalg.inv(fit.cell.sessions.frames["tuesday"])[:3, 3]
    assert_allclose(
        np.linalg.norm(instrument_positions(common)[1]), np.linalg.norm(away), rtol=1e-12
    )


def test_a_saved_fit_places_each_session(saved):
    fit, path = saved
    again = mc.load_fit(path)
    assert_allclose(again.cell.error(again.data), fit.cell.error(fit.data), rtol=0, atol=1e-13)
    cell = mc.load_cell(path)
    assert_allclose(cell.error(TWO), fit.error, rtol=0, atol=1e-9)  # digits of millimetres
    # predictions are in the frame of each row's session
    assert_allclose(
        np.linalg.norm(TWO.y - cell.follow(TWO), axis=-1),
        np.linalg.norm(fit.error, axis=-1),
        rtol=0,
        atol=1e-9,
    )
    assert mc.evaluate(cell, TWO).rms_mm < 1.05 * mc.evaluate(cell, ONE).rms_mm
    assert list_session_and_time_notices(cell, TWO) == ()
    (said,) = list_session_and_time_notices(cell, labelled(TWO, np.full(120, "friday")))
    assert "session friday is new to the fit" in said
    (said,) = list_session_and_time_notices(cell, ONE)
    assert "no session is named" in said


def test_a_fit_of_stations_is_as_good_a_source_as_any(saved):
    fit, path = saved
    other = refit_with_options(fit, objective="sum")
    assert len(other.parameters) == len(fit.parameters)
    found = mc.bootstrap(other, 20)
    assert found.lost == 0
    said: list[object] = []
    mc.export(path, "dh-csv", notify=said.append)
    assert not any("session_jump" in str(text) for text in said)


def test_a_session_of_few_poses_is_placed_by_the_others():
    session = np.where(np.arange(120) < 5, "c", np.where(np.arange(120) % 2, "b", "a"))
    three = elsewhere(ONE, session, seed=3)
    fit = mc.calibrate(ROBOT, three, "sum", holdout=0.0)
    one = mc.calibrate(ROBOT, ONE, "sum", holdout=0.0)
    assert list(fit.cell.sessions.frames) == ["c", "b", "a"]
    assert_allclose(fit.accuracy["train"].rms_mm, one.accuracy["train"].rms_mm, rtol=0.02)


def test_one_session_costs_nothing():
    alone = mc.calibrate(ROBOT, labelled(ONE, np.full(120, "a")), "sum")
    plain = mc.calibrate(ROBOT, ONE, "sum")
    assert alone.cell.sessions.frames == {}
    assert_array_equal(alone.error, plain.error)


def test_a_session_without_points_enough_is_refused():
    data = elsewhere(ONE.only(0), np.where(np.arange(120) < 2, "a", "b"))
    with pytest.raises(mc.DataError, match=r"session 'a' has \d points to place"):
        mc.calibrate(ROBOT, data, "sum", holdout=0.0)


def test_a_session_held_out_whole_is_judged_in_the_first_frame():
    session = np.repeat(["a", "b"], 60)
    fit = mc.calibrate(ROBOT, labelled(ONE, session), "sum", holdout=0.5, holdout_by="session")
    assert fit.cell.sessions.frames == {}
    assert len(set(session[fit.held])) == 1
    assert any("held out whole: session" in text for text in fit.notices)
    assert fit.accuracy["holdout"].rms_mm < 2.0 * fit.accuracy["train"].rms_mm


def test_a_station_held_out_whole_fails_in_words():
    fit = mc.calibrate(ROBOT, TWO, "sum", holdout=0.5, holdout_by="session")
    assert str(fit.status) == "failed"
    assert mc.Fit.from_dict(fit.to_dict()).status == fit.status
    assert "NaN" not in fit.json()


# ---------------------------------------------------------------- jumps that nobody named


def jumped(data: mc.Measurements, row: int) -> mc.Measurements:
    return data.with_y(data.y + np.where(np.arange(data.poses) >= row, 1.0, 0.0)[:, None, None]
                       * SHIFT)  # fmt: skip


def test_a_station_that_moved_is_told_with_its_size_and_freed_on_request():
    moved = jumped(ONE, 70)
    plain, spoilt = mc.calibrate(ROBOT, ONE, "sum"), mc.calibrate(ROBOT, moved, "sum")
    assert not any("stand elsewhere" in text for text in plain.notices)
    (said,) = (text for text in spoilt.notices if "stand elsewhere" in text)
    assert f"line {ONE.line[70]} on by" in said
    told = float(said.partition("on by ")[2].split()[0])
    assert_allclose(told, 1.0, rtol=0.1)  # the geometry takes up a part of it
    freed = mc.calibrate(ROBOT, moved, "sum", effects=["session_jump"])
    assert not any("stand elsewhere" in text for text in freed.notices)
    assert_allclose(
        freed.accuracy["holdout"].rms_mm, plain.accuracy["holdout"].rms_mm, rtol=SAMPLING
    )
    (term,) = freed.cell.effects.terms
    assert_allclose(term.choice["since"], 70 / 119, rtol=1e-12)
    value = freed.cell.effects.values[0]
    sigma = freed.uncertainty.sigma[-6:] if freed.uncertainty else np.zeros(6)
    truth = np.concatenate([SHIFT @ freed.cell.base[:3, :3], np.zeros(3)])
    assert np.all(np.abs(value - truth) < 4.0 * sigma)


def test_no_jump_is_no_moment():
    with pytest.raises(mc.OptionError, match="write session_jump:frame:since=NUMBER"):
        mc.calibrate(ROBOT, ONE, "sum", effects=["session_jump"])


# ---------------------------------------------------------------- the clock


def test_a_part_read_as_a_file_of_its_own_has_the_time_of_the_fit(tmp_path):
    drift = ["frame_drift:frame:constant=0.5"]
    fit = mc.calibrate(ROBOT, ONE, "sum", effects=drift, holdout=0.0)
    fit.save(tmp_path / "fit.json")
    cell = mc.load_cell(tmp_path / "fit.json")
    late = np.arange(120) >= 96
    assert_allclose(cell.error(ONE.take(late)), fit.error[late], rtol=0, atol=1e-9)
    assert list_session_and_time_notices(cell, ONE.take(late)) == ()
    later = replace(ONE, columns={"order": ONE.columns["order"] + 1000})
    (said,) = list_session_and_time_notices(cell, later)
    assert "extrapolated: by order these poses lie from 8.4 to 9.4" in said
    (said,) = list_session_and_time_notices(cell, replace(ONE, columns={}))
    assert "does not run here" in said


def test_play_on_data_without_an_order_is_told():
    cell = mc.calibrate(ROBOT, ONE, "sum", effects=["backlash:all"]).cell
    assert list_session_and_time_notices(cell, ONE) == ()
    unordered = replace(ONE, columns={})
    (said,) = list_session_and_time_notices(cell, unordered)
    assert (
        "backlash of the whole arm depends on the way to a pose, which these data do not tell"
        in said
    )
    assert (
        list_session_and_time_notices(cell, replace(ONE, columns={"approach2": np.ones(ONE.poses)}))
        == ()
    )


# ---- between sessions ----------------------------------------------------------------------------


POSES, ZERO_MOVED = 50, 5e-4
SIGMA = 20e-6
MADE = mc.simulate(ROBOT, 2 * POSES, 3, 3, mc.Truth(compliance=0.0, noise=0.0, noise_per_metre=0.0))
FIVE = 5.0  # sigmas


def measured(
    joint: int | None = None, nest: int | None = None, away: bool = True, third: bool = False
) -> mc.Measurements:
    """Two sessions (or three, the middle one alone changed), the later ones seen from elsewhere."""
    session = np.arange(2 * POSES) * (3 if third else 2) // (2 * POSES)
    changed = session == 1
    q = MADE.data.q.copy()
    if joint is not None:
        q[:, joint - 1] += ZERO_MOVED * changed
    y = MADE.cell.predict(q)
    if nest is not None:
        flange = MADE.cell.base[:3, :3] @ MADE.cell.robot.pose(q)[:, :3, :3]
        y[:, nest] += changed[:, None] * (flange @ [3e-4, 0.0, -2e-4])
    if away:
        turn = Rotation.from_rotvec([0.1, -0.4, 0.3]).as_matrix()
        y = np.where((session > 0)[:, None, None], y @ turn.T + [1.0, -0.5, 0.2], y)
    y = y + SIGMA * np.random.default_rng(1).normal(size=y.shape)
    names = np.array(["march", "june", "july"])[session]
    return replace(MADE.data.with_y(y), columns={"session": names}, simulated=False)


def of_arm(fit: mc.Fit) -> list[str]:
    return [change.text for change in fit.moved if change.text]


@pytest.fixture(scope="module")
def knocked() -> mc.Fit:
    return mc.calibrate(ROBOT, measured(joint=3), "sum")


def test_the_joint_that_moved_is_named_with_size_and_interval(knocked):
    (joint, frame) = knocked.moved
    assert (joint.effect, joint.place, joint.session) == ("encoder_zero", "J3", "june")
    (amount,) = joint.amounts
    assert abs(amount.value - ZERO_MOVED) < FIVE * amount.sigma < 0.1 * ZERO_MOVED
    assert amount.low95 < amount.value < amount.high95
    assert frame.place == "frame"
    (said,) = (text for text in knocked.notices if "encoder zero at joint 3" in text)
    assert "from june on by +0.5" in said
    assert "mrad (95 %)" in said
    assert joint.text in said


def test_nothing_is_named_where_nothing_moved():
    fit = mc.calibrate(ROBOT, measured(), "sum")
    assert of_arm(fit) == []
    still = mc.calibrate(ROBOT, measured(away=False), "sum")
    assert of_arm(still) == []
    assert any("instrument and base stand as at first" in text for text in still.notices)


def test_a_nest_that_moved_is_named():
    fit = mc.calibrate(ROBOT, measured(nest=1), "sum")
    assert of_arm(fit) == ["target_shift:smr2:session=2.0"]
    sizes = [amount.value for amount in fit.moved[0].amounts]
    sigmas = [amount.sigma for amount in fit.moved[0].amounts]
    assert np.all(np.abs(np.array(sizes) - [3e-4, 0.0, -2e-4]) < FIVE * np.array(sigmas))


def test_a_change_of_one_session_alone_is_told_as_such():
    fit = mc.calibrate(ROBOT, measured(joint=4, third=True), "sum")
    assert of_arm(fit) == ["encoder_zero:J4:session=2.0:alone=1.0"]
    assert fit.moved[0].only
    assert "in session june alone" in fit.moved[0].sentence


def test_the_change_is_written_and_read(knocked, tmp_path):
    knocked.save(tmp_path / "fit.json")
    assert mc.load_fit(tmp_path / "fit.json").moved == knocked.moved


def test_a_fit_of_the_change_meets_the_noise_and_the_next_campaign(knocked):
    """The arm is that of the last session, for a campaign that is measured later as well."""
    freed = mc.calibrate(ROBOT, measured(joint=3), "sum", effects=[knocked.moved[0].text])
    assert of_arm(freed) == []
    assert freed.accuracy["holdout"].rms_mm < 1.2e3 * np.sqrt(3.0) * SIGMA
    later = mc.simulate(ROBOT, 30, 3, 8).data.q
    q = later.copy()
    q[:, 2] += ZERO_MOVED
    turn = Rotation.from_rotvec([0.0, 0.5, 1.0]).as_matrix()
    y = MADE.cell.predict(q) @ turn.T + [0.3, 0.1, -2.0]
    new = replace(mc.measurements(later, y), columns={})
    after = mc.evaluate(freed, new, new_frame=True).rms_mm
    before = mc.evaluate(knocked, new, new_frame=True).rms_mm
    assert after < 1.2e3 * np.sqrt(3.0) * SIGMA < 0.5 * before
    assert mc.evaluate(freed, new).rms_mm > 100.0  # in the frame of the first session
    held = mc.deliver(freed, "dh-csv")  # the arm as it was last is a geometry
    assert held.carries == ("encoder_zero:J3",)
    assert held.cell.robot is freed.cell.robot
    at_rest = replace(freed.cell, robot=held.cell.robot, effects=NO_EFFECTS)
    assert_allclose(at_rest.predict(later), freed.cell.predict(later), rtol=0, atol=1e-12)


def test_campaigns_on_the_command_line(tmp_path, says):
    data = measured(joint=3)
    paths = []
    for name in ("march", "june"):
        rows = data.columns["session"] == name
        paths.append(str(tmp_path / f"{name}.csv"))
        mc.write_measurements(paths[-1], replace(data.take(rows), columns={}))
    said = says("calibrate", ROBOT, *paths, "--objective", "sum", code=1).err
    assert "error: contradictory" in said
    assert "moved between sessions: encoder zero at joint 3 from june on by +0.5" in said
    found = mc.diagnose(ROBOT, paths, quick=True)
    assert found.verdict == "named"
    (finding,) = found.effects
    assert finding.term.label == "encoder_zero:J3"
    assert_allclose(finding.values[0], ZERO_MOVED, atol=FIVE * finding.sigmas[0], rtol=0)
    assert any("encoder zero at joint 3: from june on by +0.5" in text for text in found.notices)
