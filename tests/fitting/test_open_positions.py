"""What positions depend on and the measurements do not determine, against the true arm."""

import json

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

import minimax_cal as mc
from experiments.relative import (
    NOISE,
    SIMULATORS,
    SPOT,
    Arm,
    place,
    rms_mm,
    spot_of,
    true_errors,
)
from minimax_cal.fitting.several import RelativeCalibration, relative
from minimax_cal.ground.arrays import Array
from minimax_cal.robots.sampling import random_poses

SCALE = {"irb2600": "d4", "ur10": "a2"}  # the longest length, kept as drawn where none is known


def calibrated(name: str, kind: str, seed: int, **options) -> tuple[RelativeCalibration, float]:  # type: ignore[no-untyped-def]
    """The result, and the true error of positions over its sigma."""
    arm = Arm.of(name, seed, 0.0)
    seen = SIMULATORS[kind](arm, np.random.default_rng([seed, 6]), 100, NOISE)
    fit = relative(arm.robot, seen.data, known_distances=seen.known, **options)
    q = random_poses(arm.robot, 300, np.random.default_rng(1))
    plain, _ = true_errors(arm, fit.robot, spot_of(fit), q)
    return fit, rms_mm(plain) / (1e3 * fit.position_sigma)


@pytest.mark.parametrize("kind", ["poses", "wires_3", "wires_1", "ball_bar", "closures_known"])
@pytest.mark.parametrize("name", SCALE)
def test_where_nothing_is_open_the_sigma_holds_the_truth(name, kind):
    for seed in range(2):
        fit, ratio = calibrated(name, kind, seed)
        assert fit.positions_open == ()
        assert ratio < 3.0
        assert "By the parameters' sigmas alone" in fit.headline()


@pytest.mark.parametrize("name", SCALE)
def test_closures_without_a_length_leave_one_length_open(name):
    for seed in range(3):
        fit, _ = calibrated(name, "closures", seed)
        assert fit.positions_open == (SCALE[name],)
        assert np.isnan(fit.position_sigma)  # no sigma holds what is kept as drawn
    assert f"do not determine {SCALE[name]}" in fit.headline()
    content = json.loads(fit.json())
    assert content["positions_open"] == [SCALE[name]]
    assert content["position_sigma_mm"] is None
    assert RelativeCalibration.from_dict(content).headline() == fit.headline()


def test_what_the_user_fixes_is_not_open():
    fit, _ = calibrated("ur10", "closures", 1, fix="a2")
    assert fit.positions_open == ()


@pytest.mark.parametrize("name", ["irb2600", "ur10"])
@pytest.mark.parametrize("on_axis", [True, False])
def test_one_reflector_on_the_last_axis_does_not_speak_for_the_tool(name, on_axis):
    """True errors of another point of the tool, whose offset and base are fitted by scipy."""
    arm, rng = Arm.of(name, 1, 0.0), np.random.default_rng(1)
    spot = np.array([0.0, 0.0, 0.1]) if on_axis else SPOT
    q, new = (random_poses(arm.robot, count, rng) for count in (80, 200))
    y = place(arm.real, q, spot) + NOISE * rng.normal(size=(80, 3))
    fit = mc.calibrate(arm.robot, mc.measurements(q, y[:, None]), objective="sum")
    said = [notice for notice in fit.notices if "other points of the tool" in notice]
    other = np.array([0.1, -0.05, 0.05])
    true = place(arm.real, new, other)

    def missed(x: Array) -> Array:
        here = place(fit.robot, new, x[6:])
        return (here @ Rotation.from_rotvec(x[:3]).as_matrix().T + x[3:6] - true).ravel()

    left = least_squares(missed, np.append(np.zeros(6), other)).fun.reshape(-1, 3)
    off_mm = rms_mm(np.linalg.norm(left, axis=1))
    assert bool(said) == on_axis == (off_mm > 3.0 * fit.accuracy["holdout"].rms_mm)
