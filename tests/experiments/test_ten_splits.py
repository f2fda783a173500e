import pytest

import minimax_cal as mc
from experiments.external import SIMULATED, asked_for
from experiments.ten_splits import Named, Split, Told, arms_table, names_table, run


@pytest.mark.slow
def test_play_is_established_whichever_poses_are_held_out() -> None:
    told = [run(Split(SIMULATED[0], seed)) for seed in (0, 1)]
    for one in told:
        assert one.verdict == "named"
        assert [(cause.name, cause.established) for cause in one.causes] == [("backlash J2", True)]
        assert one.final < 0.6 * one.geometric
        assert abs(one.by_established - one.causes[0].share) < 1e-12


def test_causes_are_counted_split_by_split() -> None:
    first = (Named("backlash J1", True, 0.5, ()), Named("gear_ripple J2", True, 0.1, (100.2, 7.0)))
    second = (Named("gear_ripple J2", False, 0.2, (99.9,)), Named("settling J1", False, 0.1, ()))
    told = [Told("named", 1.0, 0.2, 0.2, 0.9, first),
            Told("unknown", 1.2, 0.4, 0.3, 0.7, second)]  # fmt: skip
    (arm,) = arms_table(["arm"], [told]).rows
    assert arm[:3] == ("arm", 2, "named 1, unknown 1")
    assert [round(float(value), 9) for value in arm[3:]] == [1.1, 0.3, 0.4, 0.25, 80.0, 30.0]  # type: ignore[arg-type]
    rows = names_table(["arm"], [told]).rows  # settling is established nowhere
    assert [row[1] for row in rows] == ["backlash J1", "gear_ripple J2"]
    assert [row[3:] for row in rows] == [(1, 1, ""), (1, 2, "99.9, 100.2")]
    assert abs(float(rows[1][2]) - 15.0) < 1e-9  # type: ignore[arg-type]


def test_an_arm_that_nobody_knows_is_a_users_error() -> None:
    with pytest.raises(mc.OptionError, match="--arms ur10: choose irb120"):
        asked_for("simulated play,ur10")
    assert asked_for("simulated play") == ["simulated play"]
