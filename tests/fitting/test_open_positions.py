"""What positions depend on and the measurements do not determine, against the true arm."""

import json

import numpy as np
import pytest

from experiments.relative import NOISE, SIMULATORS, Arm, rms_mm, spot_of, true_errors
from minimax_cal.fitting.several import RelativeCalibration, relative
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
def test_where_nothing_is_open_the_sigma_holds_the_truth(name: str, kind: str) -> None:
    for seed in range(2):
        fit, ratio = calibrated(name, kind, seed)
        assert fit.positions_open == ()
        assert ratio < 3.0
        assert "By the parameters' sigmas alone" in fit.headline()


@pytest.mark.parametrize("name", SCALE)
def test_closures_without_a_length_leave_one_length_open(name: str) -> None:
    for seed in range(3):
        fit, _ = calibrated(name, "closures", seed)
        assert fit.positions_open == (SCALE[name],)
        assert np.isnan(fit.position_sigma)  # no sigma holds what is kept as drawn
    assert f"do not determine {SCALE[name]}" in fit.headline()
    content = json.loads(fit.json())
    assert content["positions_open"] == [SCALE[name]]
    assert content["position_sigma_mm"] is None
    assert RelativeCalibration.from_dict(content).headline() == fit.headline()


def test_what_the_user_fixes_is_not_open() -> None:
    fit, _ = calibrated("ur10", "closures", 1, fix="a2")
    assert fit.positions_open == ()
