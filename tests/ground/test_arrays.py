import warnings

import numpy as np
from numpy.testing import assert_array_equal

from minimax_cal.core.arrays import nanmedian_last_axis


def test_a_median_of_what_is_known_is_that_of_numpy_to_the_bit(rng):
    for m in (1, 2, 3, 8, 99, 100):
        for missing in (0.0, 0.3, 0.9):
            values = rng.normal(size=(5, 4, m)).round(2)  # with ties
            values[rng.random(values.shape) < missing] = np.nan
            values[0, 0] = np.nan
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", RuntimeWarning)  # of rows without any
                wanted = np.nanmedian(values, axis=-1)
            assert_array_equal(nanmedian_last_axis(values), wanted)
            assert_array_equal(nanmedian_last_axis(values[1, 2]), wanted[1, 2])
