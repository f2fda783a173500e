import numpy as np
from numpy.testing import assert_allclose

from experiments.external import RANDOM, SIMULATED, arm_of, aside
from experiments.halves import Arm, line, run, z_between
from minimax_cal.measuring.history import with_history
from minimax_cal.modelling.effects.table import Term


def test_the_halves_of_an_arm_with_play_differ_as_their_sigmas_say() -> None:
    """The one parameter of the arm's one effect, ten halves: |z| of 3.5 is one in two thousand."""
    z = np.array(run(Arm(SIMULATED[0], 10, 0)))
    assert z.shape == (10, 1)
    assert 0.3 < np.sqrt(np.mean(z**2)) < 1.9  # 99.9 % of ten independent ones
    assert np.abs(z).max() < 3.5


def test_sides_are_alike() -> None:
    robot, data = arm_of(SIMULATED[0])
    data = with_history(data)
    side = aside(data, RANDOM, 3)
    play = [Term("backlash", "J2")]
    both = [z_between(robot, data, rows, play) for rows in (side, ~side)]
    assert_allclose(both[0], -both[1], rtol=1e-9)


def test_a_row_counts_every_half() -> None:
    name, halves, count, sd, least, most, far, largest = line("arm", [[1.0, -1.0], [3.0, 1.0]])
    assert (name, halves, count) == ("arm", 2, 2.0)
    assert_allclose([sd, least, most], [np.sqrt(3.0), 1.0, np.sqrt(5.0)])
    assert (far, largest) == (25.0, 3.0)
