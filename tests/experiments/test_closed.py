from numpy.testing import assert_allclose

from experiments.closed import POSES, POWERS, USED, Share, case, line, run


def test_laws_arms_and_powers_take_turns() -> None:
    cases = [case(seed) for seed in range(30)]
    assert len({(c.robot, c.causes[0].law, c.causes[0].power) for c in cases}) == 30
    assert {c.causes[0].power * USED / POSES for c in cases} == set(POWERS)


def test_a_strong_effect_is_closed_and_its_share_is_held() -> None:
    share = run(2)  # of lambda 8000
    assert share is not None
    assert 0.9 < share.low <= share.told <= share.high < 1.1
    assert 0.98 < share.true < 1.02  # what fitting 40 parameters leaves, and 375 poses tell
    assert share.held


def test_a_row_counts() -> None:
    shares = [Share(0.9, 0.8, 1.0, true) for true in (0.7, 0.85, 0.95, 1.1)]
    name, runs, held, low, high, below, above, told, true, width = line("arms", shares)
    assert (name, runs, held, below, above) == ("arms", 4, 50.0, 1, 1)
    assert_allclose([low, high], [6.8, 93.2], atol=0.05)  # Clopper and Pearson, 2 of 4
    assert_allclose([told, true, width], [0.9, 0.9, 0.2])
