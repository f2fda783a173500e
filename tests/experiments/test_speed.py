"""What docs/speed.md says about ratios is what a short race shows, to the order of magnitude."""

import re
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose

from experiments import speed, speed_peers

PAGE = Path(__file__).parents[2] / "docs" / "speed.md"
MAGNITUDE = 10.0  # other machines, other loads


@pytest.fixture(scope="module")
def case() -> speed.Case:
    return speed.case_of(60, 0)


@pytest.fixture(scope="module")
def raw(case: speed.Case) -> speed_peers.Raw:
    return speed.raw_of(case, speed.simulated(60, 0))


def told() -> dict[str, float]:
    """The ratios on the page."""
    rows = re.findall(r"^\| `(\w+)` \| ([\d.]+) \|", PAGE.read_text(), re.MULTILINE)
    return {name: float(value) for name, value in rows}


def test_the_peers_derivatives_are_those_of_their_squares(raw):
    u, step = 1e-3 * np.random.default_rng(0).normal(size=len(raw.free)), 1e-6
    around = [
        (raw.squares(u + step * v)[0] - raw.squares(u - step * v)[0]) / (2.0 * step)
        for v in np.eye(len(u))
    ]
    slope = raw.squares(u)[1]
    assert_allclose(np.stack(around, axis=-1), slope, rtol=0, atol=1e-6 * np.abs(slope).max())


def test_peers_and_we_reach_the_same_optimum(case, raw):
    ours = case.model.cost(speed.squares(case)).sum()
    theirs = (raw.rows(speed_peers.gauss_newton(raw))[0] ** 2).sum()
    assert_allclose(theirs, ours, rtol=1e-9)
    worst = raw.squares(speed_peers.slsqp(raw, *speed_peers.scaled(raw)))[0].max()
    assert_allclose(worst, speed.worst_target(case), rtol=speed.SAME)


def test_the_page_tells_the_order_of_magnitude(case, raw):
    pytest.importorskip("numba", reason="the page's ratios are those with numba")
    times = speed.race(
        {
            "squares": partial(speed.squares, case),
            "squares_numpy_gn": partial(speed_peers.gauss_newton, raw),
            "minimax": partial(speed.worst_target, case),
            "minimax_slsqp": partial(speed_peers.slsqp, raw, *speed_peers.scaled(raw)),
        },
        1,
    )
    ratios = {
        "squares_over_numpy_gn": times["squares_numpy_gn"] / times["squares"],
        "minimax_over_slsqp": times["minimax_slsqp"] / times["minimax"],
    }
    page = told()
    for name, ratio in ratios.items():
        assert page[name] / MAGNITUDE < ratio < page[name] * MAGNITUDE, name
