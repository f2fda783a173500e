import numpy as np
import pytest
from numpy.testing import assert_allclose

import minimax_cal as mc
from minimax_cal.fitting.floor import (
    AT_MOST,
    DECLARED,
    DISTANCES,
    REPEATS,
    RMS_OF_REPEATABILITY,
    Floor,
    by_distances,
    declared,
    floor_of,
    instrument_noise,
    instrument_of,
    of_coordinate,
    with_instrument,
)
from minimax_cal.measuring.measurements import Measurements

SIGMA = 1e-5


def visited(
    rng: np.random.Generator, times: int, poses: int = 200
) -> tuple[Measurements, np.ndarray]:
    """Poses visited several times, and errors of three targets."""
    q = np.repeat(rng.uniform(-2.0, 2.0, (poses, 6)), times, axis=0)
    q += 1e-5 * rng.normal(size=q.shape)
    error = SIGMA * rng.normal(size=(3, len(q), 3))
    error += 1e-3 * np.repeat(rng.normal(size=(3, poses, 3)), times, axis=1)  # of the model
    return mc.measurements(q, np.moveaxis(error, 0, 1)), error


@pytest.mark.parametrize("times", [2, 3, 5])
def test_visits_tell_the_noise_whatever_the_model(rng, times):
    data, error = visited(rng, times)
    found = floor_of(data, error, np.nan, 10.0)
    assert found.source == REPEATS
    # 600 to 3000 squares of three coordinates; a median is a little less sure than a mean
    assert_allclose(found.value, 1e3 * np.sqrt(3.0) * SIGMA, rtol=0.06)
    assert found.low < 1e3 * np.sqrt(3.0) * SIGMA < found.high


def test_a_few_wrong_visits_do_not_set_the_floor(rng):
    data, error = visited(rng, 2)
    error[:, :20] += 2e-3 * rng.normal(size=(3, 20, 3))
    found = floor_of(data, error, np.nan, 10.0)
    assert found.source == REPEATS
    assert_allclose(found.value, 1e3 * np.sqrt(3.0) * SIGMA, rtol=0.12)


def test_without_visits_or_promises_the_fit_tells_at_most(rng):
    q = rng.uniform(-2.0, 2.0, (30, 6))
    data = mc.measurements(q, rng.normal(size=(30, 1, 3)))
    error = SIGMA * rng.normal(size=(1, 30, 3))
    assert floor_of(data, error, np.nan, 0.3) == Floor(0.3, 0.0, 0.3, AT_MOST)
    assert floor_of(data, error, 1e-4, 0.3) == Floor(0.3, 0.0, 0.3, AT_MOST)
    assert floor_of(data, error, 1e-3, 0.3) == Floor(0.3, 0.0, 0.3, AT_MOST)
    told = floor_of(with_instrument(data, "0.0392mm"), error, 1e-4, 0.3)
    assert told.source == DECLARED
    both = np.hypot(np.sqrt(3.0) * 0.0392 / 1.959964, 0.1 * RMS_OF_REPEATABILITY)
    assert_allclose(told.value, both, rtol=1e-6)
    assert told.low < told.value


def test_no_floor_is_above_what_a_model_leaves():
    assert Floor(1.79, 0.0, 1.79, AT_MOST).beneath(0.273) == Floor(0.273, 0.0, 0.273, AT_MOST)
    assert Floor(0.1, 0.05, 0.4, REPEATS).beneath(0.3) == Floor(0.1, 0.05, 0.3, REPEATS)


def test_repeatability_is_mean_and_three_deviations(rng):
    distance = np.linalg.norm(rng.normal(size=(400_000, 3)), axis=1)
    promise = distance.mean() + 3.0 * distance.std()
    assert_allclose(np.sqrt((distance**2).mean()) / promise, RMS_OF_REPEATABILITY, rtol=3e-3)


def test_a_floor_is_drawn_between_its_ends(rng):
    known = Floor(0.02, 0.018, 0.023, REPEATS).drawn(20_000, rng)
    assert_allclose(np.quantile(known, [0.025, 0.5, 0.975]), [0.018, 0.02, 0.023], rtol=0.01)
    loose = Floor(0.1, 0.0, 0.1, AT_MOST)
    assert loose.least == 0.0
    assert_allclose(loose.drawn(20_000, rng).mean(), 0.05, rtol=0.02)


@pytest.mark.parametrize(
    ("text", "base", "more"),
    [("10um+2.5um/m", 1e-5, 2.5e-6), ("0.05mm", 5e-5, 0.0), (" 15 um + 6 um/m", 1.5e-5, 6e-6)],
)
def test_an_instrument_in_words(text, base, more):
    told = instrument_of(text)
    assert_allclose([told.base, told.per_metre], [base, more], rtol=1e-12)


@pytest.mark.parametrize("text", ["", "10", "10 parsec", "1.2.3um", "0um", "5um+3um", "2 m"])
def test_an_instrument_that_is_none(text):
    with pytest.raises(mc.OptionError, match=r"10um\+2.5um/m"):
        instrument_of(text)


def test_a_column_counts_more_than_the_option(rng):
    y = rng.normal(size=(5, 2, 3))
    bare = mc.measurements(rng.normal(size=(5, 6)), y)
    filled = with_instrument(bare, "10um+2um/m")
    far = np.linalg.norm(y, axis=-1).mean(axis=1)
    assert_allclose(filled.columns["u95"], 1e-5 + 2e-6 * far, rtol=1e-12)
    kept = with_instrument(mc.measurements(bare.q, y, u95=np.full(5, 3e-5)), "10um+2um/m")
    assert_allclose(kept.columns["u95"], 3e-5)
    assert "column u95_mm is used" in kept.notices[-1]
    assert declared(bare, np.nan) is None
    assert np.isnan(instrument_noise(bare))
    assert_allclose(instrument_noise(kept), 3e-5 / 1.959964, rtol=1e-6)  # of a coordinate


def test_a_fit_that_leaves_a_little_less_contradicts_no_distance():
    """What distances tell has an interval; what a fit leaves at most may be inside of it."""
    sigma, sure = 17e-6, 0.05
    told = of_coordinate(sigma)
    for most, source in ((1.2 * told, DISTANCES), (0.97 * told, DISTANCES), (0.8 * told, AT_MOST)):
        floor = by_distances((sigma, sure), np.nan, np.nan, most)
        assert floor.source == source
        assert floor.low <= floor.value <= floor.high <= most
        assert floor.value == min(told, most)
