import numpy as np
import pytest
from numpy.testing import assert_allclose
from problems_fit import study_of

import minimax_cal as mc
from experiments.gap_cases import Case, Cause, make
from minimax_cal.diagnosing.gap import climbed
from minimax_cal.diagnosing.harmful import HARM, harmful, owned, parts_without
from minimax_cal.diagnosing.joint import joint
from minimax_cal.diagnosing.study import Study, studied
from minimax_cal.fitting.options import Options, silent
from minimax_cal.fitting.solve import fit_cell
from minimax_cal.measuring.grouping import parts
from minimax_cal.modelling.effects.table import Term
from minimax_cal.modelling.simulate import simulate

PLAY = Term("backlash", "J2")
WAVES = Term("gear_error", "J3", {"orders": 2.0})
STEEP = Term("gear_error", "J2", {"orders": 3.0})


@pytest.fixture(scope="module")
def play() -> Study:
    return study_of(make(Case("irb2600", "single", (Cause("backlash", "J2", 1000.0),), seed=1)))


@pytest.fixture(scope="module")
def stepped() -> Study:
    """A joint 2 that is off by 0.4 mrad in some of its sweep: as if by waves, there."""
    robot = mc.load_robot("irb2600")
    ideal = simulate(robot, 120, seed=4)
    q = ideal.data.q
    low = q[:, 1] < np.quantile(q[:, 1], 0.6)
    turn = 4e-4 * np.tanh(40.0 * (q[:, 1] - np.quantile(q[:, 1], 0.3)))
    noise = 1e-5 * np.random.default_rng(4).normal(size=ideal.data.y.shape)
    data = ideal.data.with_y(ideal.cell.predict(q + turn[:, None] * np.eye(6)[1]) + noise)
    train = data.take(low)
    return studied(robot, train, fit_cell(robot, train, Options(objective="sum"), silent))


def test_parameters_are_those_of_each_effect(play: Study) -> None:
    fit = joint(play, (PLAY, WAVES))
    one, other = owned(fit, [(PLAY,), (WAVES,)])
    assert np.flatnonzero(one).tolist() == [len(one) - 5]
    assert np.flatnonzero(other).tolist() == list(range(len(one) - 4, len(one)))


def test_parts_without_an_effect_are_those_of_the_fit_without_it(play: Study) -> None:
    whole, bare = joint(play, (PLAY, WAVES)), joint(play, (PLAY,))
    folds = whole.spared([part.rows for part in parts(play.data)])
    assert len(folds) > 10
    none = np.zeros(whole.estimator.model.active.sum(), dtype=bool)
    full, less = parts_without(whole, folds, [none, owned(whole, [(PLAY,), (WAVES,)])[1]])
    assert_allclose(full, whole.cross_validated(folds), rtol=1e-9)
    # linear at another place: second order in changes of some 10 um
    assert_allclose(less, bare.cross_validated(folds), rtol=5e-3)


def test_an_effect_that_harms_beyond_the_poses_is_left(
    stepped: Study, monkeypatch: pytest.MonkeyPatch
) -> None:
    fit = joint(stepped, (STEEP,))
    folds = fit.spared([part.rows for part in parts(stepped.data)])
    assert HARM**2 * joint(stepped, ()).cross_validated(folds) < fit.cross_validated(folds)
    assert harmful(fit, [(STEEP,)]) == 0
    assert climbed(stepped, [(STEEP,)]).taken == ()
    monkeypatch.setattr("minimax_cal.diagnosing.harmful.HARM", np.inf)
    assert climbed(stepped, [(STEEP,)]).taken == (0,)  # between its poses it helps


def test_a_cause_that_is_there_harms_nothing(play: Study) -> None:
    assert harmful(joint(play, (PLAY,)), [(PLAY,)]) is None
    assert harmful(joint(play, ()), []) is None
