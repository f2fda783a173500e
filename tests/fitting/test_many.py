"""Many calibrations at once are those made one by one."""

import pickle

import numpy as np
import pytest
from numpy.testing import assert_array_equal

import minimax_cal as mc
from minimax_cal.ground.files import plain


def test_each_set_has_its_fit_or_its_error():
    sheets = [mc.simulate("irb120", 40, 1, seed).data for seed in range(2)]
    broken = sheets[0].take(np.arange(2))
    one, none, other = mc.calibrate_many("irb120", [sheets[0], broken, sheets[1]], jobs=1)
    assert isinstance(none, mc.CalibrationError)
    for fit, sheet in ((one, sheets[0]), (other, sheets[1])):
        assert isinstance(fit, mc.Fit)
        assert_array_equal(fit.robot.mdh, mc.calibrate("irb120", sheet).robot.mdh)


def test_a_fit_comes_back_whole_from_another_process():
    fit = mc.calibrate("irb120", mc.simulate("irb120", 40, 1, 0).data)
    again = pickle.loads(pickle.dumps(fit))
    assert_array_equal(again.error, fit.error)
    assert plain(again.beyond) == plain(fit.beyond)


def test_robots_and_data_are_as_many():
    with pytest.raises(mc.CalibrationError, match="2 robots for 1 data sets"):
        mc.calibrate_many(["irb120", "irb120"], [mc.simulate("irb120", 40, 1, 0).data])


def test_a_diagnosis_comes_back_whole_from_another_process():
    sheets = [mc.simulate("irb120", 40, 3, seed).data for seed in range(2)]
    one, other = mc.diagnose_many("irb120", [sheets[0], sheets[1].take(np.arange(2))], jobs=1)
    assert isinstance(one, mc.Diagnosis)
    assert isinstance(other, mc.CalibrationError)
    assert pickle.loads(pickle.dumps(one)).to_dict() == one.to_dict()
