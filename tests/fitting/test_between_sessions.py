"""What moved between the sessions of one fit: a joint's zero, a nest, the tool, or nothing."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

import minimax_cal as mc
from minimax_cal.cli.running import outcome
from minimax_cal.modelling.effects.table import NOTHING

ROBOT, POSES, SHIFT = "irb2600", 50, 5e-4
NOISE = 20e-6
MADE = mc.simulate(ROBOT, 2 * POSES, 3, 3, mc.Truth(compliance=0.0, noise=0.0, noise_per_metre=0.0))
LATE = np.arange(2 * POSES) >= POSES
FIVE = 5.0  # sigmas


def measured(
    joint: int | None = None, nest: int | None = None, away: bool = True, third: bool = False
) -> mc.Measurements:
    """Two sessions (or three, the middle one alone changed), the later ones seen from elsewhere."""
    session = np.arange(2 * POSES) * (3 if third else 2) // (2 * POSES)
    changed = session == 1
    q = MADE.data.q.copy()
    if joint is not None:
        q[:, joint - 1] += SHIFT * changed
    y = MADE.cell.predict(q)
    if nest is not None:
        flange = MADE.cell.base[:3, :3] @ MADE.cell.robot.pose(q)[:, :3, :3]
        y[:, nest] += changed[:, None] * (flange @ [3e-4, 0.0, -2e-4])
    if away:
        turn = Rotation.from_rotvec([0.1, -0.4, 0.3]).as_matrix()
        y = np.where((session > 0)[:, None, None], y @ turn.T + [1.0, -0.5, 0.2], y)
    y = y + NOISE * np.random.default_rng(1).normal(size=y.shape)
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
    assert abs(amount.value - SHIFT) < FIVE * amount.sigma < 0.1 * SHIFT
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
    assert freed.accuracy["holdout"].rms_mm < 1.2e3 * np.sqrt(3.0) * NOISE
    later = mc.simulate(ROBOT, 30, 3, 8).data.q
    q = later.copy()
    q[:, 2] += SHIFT
    turn = Rotation.from_rotvec([0.0, 0.5, 1.0]).as_matrix()
    y = MADE.cell.predict(q) @ turn.T + [0.3, 0.1, -2.0]
    new = replace(mc.measurements(later, y), columns={})
    after = mc.evaluate(freed, new, new_frame=True).rms_mm
    before = mc.evaluate(knocked, new, new_frame=True).rms_mm
    assert after < 1.2e3 * np.sqrt(3.0) * NOISE < 0.5 * before
    assert mc.evaluate(freed, new).rms_mm > 100.0  # in the frame of the first session
    held = mc.deliver(freed, "dh-csv")  # the arm as it was last is a geometry
    assert held.carries == ("encoder_zero:J3",)
    assert held.cell.robot is freed.cell.robot
    at_rest = replace(freed.cell, robot=held.cell.robot, effects=NOTHING)
    assert_allclose(at_rest.predict(later), freed.cell.predict(later), rtol=0, atol=1e-12)


def test_campaigns_on_the_command_line(tmp_path, capsys):
    data = measured(joint=3)
    paths = []
    for name in ("march", "june"):
        rows = data.columns["session"] == name
        paths.append(str(tmp_path / f"{name}.csv"))
        mc.write_measurements(paths[-1], replace(data.take(rows), columns={}))
    assert outcome(["calibrate", ROBOT, *paths, "--objective", "sum"]) == 0
    said = capsys.readouterr().err
    assert "moved between sessions: encoder zero at joint 3 from june on by +0.5" in said
    found = mc.diagnose(ROBOT, paths, quick=True)
    assert found.verdict == "named"
    (finding,) = found.effects
    assert finding.term.label == "encoder_zero:J3"
    assert_allclose(finding.values[0], SHIFT, atol=FIVE * finding.sigmas[0], rtol=0)
    assert any("encoder zero at joint 3: from june on by +0.5" in text for text in found.notices)
