"""Friction at rest by motors without input in MuJoCo: what they hold, and what a file gains."""

import json
from pathlib import Path

import numpy as np
import pytest
from dynamics.motions import three_joints
from dynamics.test_torques_diagnosed import stopping
from numpy.testing import assert_allclose

import minimax_cal as mc
from minimax_cal.ground.errors import OptionError
from tests.problems_mjcf import drive_alone

mujoco = pytest.importorskip("mujoco", reason="needs mujoco: pip install minimax-cal[mujoco]")

from minimax_cal.dynamics.rows import prepare  # noqa: E402
from minimax_cal.simulators.motion.fit import has_bristles  # noqa: E402
from minimax_cal.simulators.motion.judge import installed, inverse_torque  # noqa: E402
from minimax_cal.simulators.motion.numbers import Bodies, given_numbers, open_model, write_numbers  # noqa: E402

pytestmark = pytest.mark.skipif(not has_bristles(), reason="needs MuJoCo 3.16 or later")
HELD = np.array([[0.0, 4.0], [1.0, 2.0], [0.5, 0.0]])
YIELDS = np.array([[1e-4, 1e-3], [4e-4, 1e-3], [2e-4, 1e-3]])


@pytest.fixture(scope="module")
def robot(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("bristles") / "arm.json"
    path.write_text(json.dumps(three_joints().to_dict()))
    return path


def test_a_model_keeps_its_bristles_and_takes_their_torque_along_a_motion(robot):
    opened = open_model(robot, 3)
    chain, document = opened.chain, opened.given.document
    bare = given_numbers(chain, Bodies.of(chain))
    found = bare.put(bristles=HELD, yields=YIELDS, damped=np.zeros(3), friction=HELD.sum(axis=1))
    write_numbers(document, chain, bare, found)
    full = opened.again(document).chain
    read = given_numbers(full, Bodies.of(full))
    for name in ("bristles", "friction", "loss"):
        assert_allclose(getattr(read, name), getattr(found, name), rtol=1e-12, atol=1e-12)
    assert_allclose(read.yields[HELD > 0.0], YIELDS[HELD > 0.0], rtol=1e-12)
    logs = prepare([stopping(1)])
    bent, more = np.zeros((3, 2)), np.zeros_like(logs.torque)
    for i in range(1, len(more)):
        way = (logs.motion.q[i] - logs.motion.q[i - 1])[:, None]
        bent = np.sign(way) + (bent - np.sign(way)) * np.exp(-np.abs(way) / YIELDS)
        more[i] = (HELD * bent).sum(axis=1)
    assert_allclose(inverse_torque(full, logs) - inverse_torque(chain, logs), more, atol=1e-8)
    write_numbers(document, full, read, bare)
    assert b"dcmotor" not in opened.again(document).content(None)


def test_a_file_with_bristles_holds_rest_better_and_holds_still(robot, tmp_path):
    runs, out = [stopping(seed) for seed in range(4)], tmp_path / "arm.xml"
    plain = mc.motion_gap(robot, runs, driven=False)
    found = mc.motion_gap(robot, runs, driven=False, friction="dcmotor", write=out)
    assert found.rungs[-1].name == "+ friction at rest"
    whole = np.divide(found.rungs[-1].torque_rms, plain.rungs[-1].torque_rms)
    assert whole.max() < 0.15, whole
    assert max(found.rungs[-1].torque_rms_moving) < 0.15  # three times the noise
    opened = open_model(out, 3)
    read = given_numbers(opened.chain, Bodies.of(opened.chain))
    assert_allclose(read.bristles.sum(axis=1), [4.0, 3.0, 1.5], rtol=0.1)
    assert read.loss.min() >= 0.0
    q = np.random.default_rng(1).uniform(-1.0, 1.0, (3, 3))
    reached = drive_alone(out, q, ("flange",))
    model, data = opened.chain.model, mujoco.MjData(opened.chain.model)
    for row, site in zip(q[1:], reached.sites, strict=True):
        data.qpos[:3] = row
        mujoco.mj_kinematics(model, data)
        assert 1e3 * np.linalg.norm(site[0] - data.site("flange").xpos) < 0.02
    assert reached.speed < 2e-3


def test_file_and_module_together_do_what_the_last_step_says(robot, tmp_path):
    runs, out = [stopping(seed, 0.1) for seed in range(4)], tmp_path / "arm.xml"
    found = mc.motion_gap(robot, runs, driven=False, friction="dcmotor", write=out)
    opened, logs = open_model(out, 3), prepare(runs[-1:])
    assert given_numbers(opened.chain, Bodies.of(opened.chain)).bristles.sum() > 5.0
    with installed(Path(found.module).read_text(), opened.chain):
        off = logs.y - logs.filtered(inverse_torque(opened.chain, logs))
    assert_allclose(np.sqrt((off**2).mean(axis=0)), found.rungs[-1].torque_rms, rtol=1e-3)


def test_another_element_is_refused(robot):
    with pytest.raises(OptionError, match="give dcmotor"):
        mc.motion_gap(robot, [stopping(0)], friction="bristles")
