"""The study of pixels on small cells: its arms are judged by the arm that made the pixels."""

from dataclasses import replace

import numpy as np
import pytest

from experiments.pixels import (
    REACHED,
    WAYS,
    WEAK_OFF,
    Job,
    Start,
    Weak,
    reach,
    run,
    starts_table,
    ways_table,
    weak,
    weak_table,
)


def test_reprojection_is_better_than_poses_and_than_the_drawing() -> None:
    ways = ("hand-eye alone, arm as drawn", "poses by PnP, then whole poses",
            "reprojection, lenses freed")  # fmt: skip
    drawn, poses, pixels = (run(Job(way, 0, True)) for way in ways)
    assert pixels.error < 0.5 * poses.error < 0.25 * drawn.error
    assert pixels.error < 2.0 * pixels.sigma
    jobs = [Job(way, 0, True) for way in WAYS]
    table = ways_table(jobs, [replace(pixels, error=i + 1.0) for i in range(len(jobs))])
    assert [row[2] for row in table.rows] == [i + 1.0 for i in range(len(WAYS))]


def test_a_bad_start_is_reached_from_the_poses_of_images() -> None:
    depths, pixels = reach(Start(3, True))
    assert depths < REACHED < pixels
    assert [row[1] for row in starts_table([(depths, pixels)]).rows] == [1, 0]


def test_weak_pixels_leave_the_drawn_arm() -> None:
    job = Weak(WEAK_OFF[1], 1.0, 0)
    drawn, fitted, out, prior, kept = weak(job)
    assert kept
    assert out == pytest.approx(drawn)
    assert fitted > drawn
    assert prior < 1.03 * drawn
    (row,) = weak_table([job], [(drawn, fitted, out, prior, kept)]).rows
    assert np.allclose(row[5], 1.0)


@pytest.mark.usefixtures("few_candidates")
def test_planned_poses_lower_the_bound() -> None:
    given, planned = (
        run(Job(way, 0, True))
        for way in ("reprojection, lenses freed", "poses planned, lenses freed")
    )
    assert sum(planned.least) < 0.6 * sum(given.least)
    assert planned.error**2 < 4.0 * sum(planned.least)
