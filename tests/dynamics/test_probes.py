"""What foretells rows that its fit did not see, and what does not."""

import numpy as np
import pytest
from dynamics.motions import simulated, three_joints
from numpy.testing import assert_allclose

import minimax_cal as mc
from minimax_cal.core.arrays import Array
from minimax_cal.core.linear_algebra import project_out
from minimax_cal.dynamics.regressor import JointMotion
from minimax_cal.dynamics.residual_structure import (
    MotionHistory,
    predicted_share_and_p_value,
    project_out_model_and_normalise,
)
from minimax_cal.dynamics.torque_rows import (
    ArmMotion,
    TorqueArm,
    compute_soft_speed_sign,
    resample_and_filter_runs,
)
from minimax_cal.selection.noise_model import orthonormal_basis

GROUP = np.repeat(np.arange(12), 60)


def red(rng: np.random.Generator) -> Array:
    """Noise that remembers for ten rows."""
    out = rng.normal(size=len(GROUP))
    for i in range(1, len(out)):
        out[i] += 0.9 * out[i - 1]
    return out / out.std()


def test_columns_foretell_what_holds_in_every_group_and_never_noise() -> None:
    rng = np.random.default_rng(2)
    chances = []
    for _ in range(30):
        noise, field = red(rng), rng.normal(size=(len(GROUP), 20))
        share, p = predicted_share_and_p_value(field, noise, GROUP, GROUP)
        assert share < 0.1
        chances.append(p)
        there, sure = predicted_share_and_p_value(field, noise + field[:, 3], GROUP, GROUP)
        assert there == pytest.approx(0.5, abs=0.1)
        assert sure < 1e-4
    assert min(chances) > 1e-3


def test_one_group_alone_is_no_evidence() -> None:
    rng = np.random.default_rng(3)
    field, left = rng.normal(size=(len(GROUP), 5)), 0.1 * rng.normal(size=len(GROUP))
    left += 10.0 * field[:, 0] * (GROUP == 4)
    assert predicted_share_and_p_value(field, left, GROUP, GROUP)[1] > 0.05


def test_what_the_model_imitates_is_no_probe() -> None:
    rng = np.random.default_rng(4)
    basis, columns = orthonormal_basis(rng.normal(size=(100, 6))), rng.normal(size=(100, 3))
    field = project_out_model_and_normalise(basis, columns)
    assert_allclose(basis.T @ field, 0.0, atol=1e-12)
    assert_allclose(np.mean(field**2, axis=0), 1.0)
    imitated = project_out_model_and_normalise(basis, basis @ rng.normal(size=(6, 2)))
    assert np.abs(imitated).max() < 1e-8
    assert_allclose(project_out(basis, basis), 0.0, atol=1e-12)


def test_a_spring_with_play_stays_within_it() -> None:
    logs = resample_and_filter_runs(simulated(seed=1, runs=2))
    arm = TorqueArm.build(three_joints(), np.ones(3), np.full(3, np.nan), np.zeros(10), logs)
    past = MotionHistory.build(ArmMotion.build(arm, logs))
    assert np.abs(past.play_positions).max() == pytest.approx(1.0)
    assert_allclose(
        past.play_positions[logs.run_starts[:-1]], 0.0, atol=1e-12
    )  # each run begins anew
    mean = np.abs(logs.motion.qd).mean(axis=0)
    assert_allclose(past.recent_speed_averages[..., 0].mean(axis=0), mean, rtol=0.1)


def test_friction_as_soft_as_a_simulator_has_it_is_no_cause() -> None:
    def softer(motion: JointMotion, rigid: Array, time: Array) -> Array:
        out = np.zeros_like(rigid)
        qd = motion.qd[:, 2]
        out[:, 2] = 1.5 * (compute_soft_speed_sign(qd, 0.1) - np.sign(qd))
        return out

    soft = mc.diagnose_motion(three_joints(), simulated(softer, seed=3))
    assert soft.arm.soft[2] == pytest.approx(0.1, rel=0.2)
    assert np.all(soft.arm.soft[:2] < 0.02)
    assert soft.unexplained == ()
    assert all(e.effect in ("coulomb", "viscous") for e in soft.main)
    (friction,) = (e for e in soft.effects if (e.effect, e.place) == ("coulomb", "J3"))
    assert friction.parameters[0].value == pytest.approx(1.5, rel=0.05)
