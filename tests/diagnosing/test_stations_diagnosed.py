"""Diagnoses of several stations, of a station that moved, and what the foot says of it."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

import minimax_cal as mc
from minimax_cal.diagnosing.curves import Leftover
from minimax_cal.diagnosing.result import Diagnosis

ROBOT = "irb2600"
BENT = mc.Truth(noise=20e-6, noise_per_metre=0.0)  # and compliance
MADE = mc.simulate(ROBOT, 120, 3, seed=4, truth=BENT)
ONE = MADE.data
SHIFT = np.array([0.6e-3, -0.8e-3, 0.0])  # 1 mm, in the measurement frame
LATE = np.arange(120) >= 70
SAMPLING = 1.0 / np.sqrt(2.0 * 9.0 * 24)  # relative, of an RMS over 24 poses of three targets
FOOT = np.array([[0.3, 0.2, 0.0], [-0.3, 0.2, 0.0], [0.0, -0.3, 0.1]])
FOOT_NOISE = 5e-6


def diagnosed(data: mc.Measurements) -> mc.Diagnosis:
    return mc.diagnose(ROBOT, data, quick=True)


@pytest.fixture(scope="module")
def plain() -> mc.Diagnosis:
    return diagnosed(ONE)


def test_two_stations_are_diagnosed_as_one(plain: mc.Diagnosis) -> None:
    session = np.where(np.arange(120) % 3 == 0, "a", "b")
    turn = Rotation.random(rng=np.random.default_rng(0)).as_matrix()
    y = np.where((session == "b")[:, None, None], ONE.y @ turn.T + 2.0, ONE.y)
    found = diagnosed(replace(ONE.with_y(y), columns={**ONE.columns, "session": session}))
    assert [f.term.label for f in found.effects] == [f.term.label for f in plain.effects]
    assert_allclose(
        [step.holdout.rms_mm for step in found.ladder[1:]],
        [step.holdout.rms_mm for step in plain.ladder[1:]],
        rtol=SAMPLING,
    )
    again = Diagnosis.from_dict(found.to_dict())
    assert again.data.frames.keys() == {"a", "b"}
    before, after = (d.cells[-1].error(d.data) for d in (found, again))
    assert_allclose(after, before, rtol=0, atol=1e-9)  # digits of millimetres
    left = Leftover.of(found.data, found.held, found.noise, found.cells, [])
    reach = mc.load_robot(ROBOT).reach()
    assert np.nanmax(np.linalg.norm(left.points, axis=-1)) < 1.5 * reach  # all about one base


def foot() -> dict[str, np.ndarray]:
    """Columns of three reflectors on the foot that move when the targets do."""
    base, rng = MADE.cell.base, np.random.default_rng(1)
    out = {}
    for number, spot in enumerate(FOOT):
        seen = base[:3, :3] @ spot + base[:3, 3] + LATE[:, None] * SHIFT
        seen = seen + FOOT_NOISE * rng.normal(size=seen.shape)
        out |= {f"base{number + 1}_{axis}": seen[:, i] for i, axis in enumerate("xyz")}
    return out


def test_a_jump_is_named_with_its_size_and_the_foot_judges_it(plain: mc.Diagnosis) -> None:
    data = ONE.with_y(ONE.y + LATE[:, None, None] * SHIFT)
    found = diagnosed(replace(data, columns={**data.columns, **foot()}))
    (jump,) = (f for f in found.effects if f.term.effect == "session_jump")
    assert jump.term.place == "frame"
    assert_allclose(jump.term.choice["since"], 70 / 119, rtol=1e-12)
    truth = np.concatenate([SHIFT @ MADE.cell.base[:3, :3], np.zeros(3)])
    assert np.all(np.abs(np.array(jump.values) - truth) < 4.0 * np.array(jump.sigmas))
    assert {f.term.label for f in found.effects} == {
        "session_jump:frame",
        *(f.term.label for f in plain.effects),
    }
    assert_allclose(found.ladder[-1].holdout.rms_mm, plain.ladder[-1].holdout.rms_mm, rtol=SAMPLING)
    (told,) = (text for text in found.notices if "on the foot" in text)
    assert told.endswith("they agree with it")
