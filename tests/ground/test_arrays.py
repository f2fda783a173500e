import warnings

import numpy as np
from numpy.testing import assert_array_equal

from minimax_cal.ground.arrays import known_median


def test_a_median_of_what_is_known_is_that_of_numpy_to_the_bit(rng):
    for m in (1, 2, 3, 8, 99, 100):
        for missing in (0.0, 0.3, 0.9):
            values = rng.normal(size=(5, 4, m)).round(2)  # with ties
            values[rng.random(values.shape) < missing] = np.nan
            values[0, 0] = np.nan
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", RuntimeWarning)  # of rows without any
                wanted = np.nanmedian(values, axis=-1)
            assert_array_equal(known_median(values), wanted)
            assert_array_equal(known_median(values[1, 2]), wanted[1, 2])
