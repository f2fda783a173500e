"""Passed, not passed, not stated: by the upper 95 % limit, and never by too few poses."""

import math

import pytest

import minimax_cal as mc
from minimax_cal.fitting.beyond import Beyond, Fold
from minimax_cal.judging.tolerance import (
    MIN_POSES,
    NOT_PASSED,
    NOT_STATED,
    PASSED,
    Bound,
    Claim,
    Limit,
    beyond,
    elsewhere,
    judge,
    limits_of,
    overall,
)


def claim(poses: int, value: float = 0.1, high: float = 0.15) -> Claim:
    return Claim("inside", Bound(value, high), Bound(3 * value, 3 * high), poses, "some poses")


@pytest.mark.parametrize(
    ("poses", "value", "high", "limit", "verdict"),
    [
        (20, 0.10, 0.15, 0.16, PASSED),
        (20, 0.10, 0.15, 0.15, NOT_PASSED),  # under the limit, not equal to it
        (20, 0.10, 0.15, 0.12, NOT_PASSED),  # the value is under it, its 95 % limit is not
        (20, 0.10, 0.15, 0.05, NOT_PASSED),
        (2, 0.10, math.nan, 0.2, NOT_STATED),
        (2, 0.30, math.nan, 0.2, NOT_PASSED),  # seen is seen
    ],
)
def test_rms(poses, value, high, limit, verdict):
    assert judge(Limit("rms", limit), claim(poses, value, high)).verdict == verdict


def test_a_maximum_needs_poses_and_says_how_many():
    """The next pose exceeds all n so far with probability 1/(n + 1): at most 5 % from 19 on."""
    assert MIN_POSES == 19
    few, enough = (judge(Limit("max", 1.0), claim(n)) for n in (18, 19))
    assert few.verdict == NOT_STATED
    assert "18 poses are too few for a maximum: at least 19 are needed" in few.why
    assert enough.verdict == PASSED
    assert judge(Limit("max", 0.2), claim(5)).verdict == NOT_PASSED  # 0.3 was seen


def test_all_together():
    limits = Limit("rms", 1.0), Limit("rms", 0.01), Limit("max", 1.0)
    good, bad, open_ = (judge(limit, claim(10)) for limit in limits)
    assert overall((good,)) == PASSED
    assert overall((good, open_)) == NOT_STATED
    assert overall((good, open_, bad)) == NOT_PASSED


def test_beyond_is_of_the_worst_part():
    folds = (Fold("one end", 20, 0.2, 0.9, 0.2), Fold("the other", 30, 0.4, 0.8, 0.4))
    found = beyond(Beyond(folds, 0.3, 0.3, "", 0.5, 1.2))
    assert (found.rms, found.largest) == (Bound(0.4, 0.5), Bound(0.9, 1.2))
    assert "the other, 30 poses" in found.where
    assert judge(Limit("rms", 0.45), found).verdict == NOT_PASSED
    assert judge(Limit("rms", 0.55), found).verdict == PASSED
    nothing = judge(Limit("rms", 1.0), beyond(Beyond(reason="no part can be spared")))
    assert (nothing.verdict, nothing.why) == (NOT_STATED, "no part can be spared")


def test_nothing_is_passed_beyond_while_parts_could_not_be_judged():
    folds = (Fold("one end", 20, 0.2, 0.9, 0.2),)
    some = Beyond(folds, 0.2, 0.2, "", 0.3, 1.2, missed=("joint 2 at its low end",))
    found = judge(Limit("rms", 0.5), beyond(some))
    assert found.verdict == NOT_STATED
    assert "only 1 of 2 parts could be judged, not joint 2 at its low end" in found.why
    assert "1 of 2 parts could be judged" in beyond(some).where
    assert judge(Limit("rms", 0.1), beyond(some)).verdict == NOT_PASSED  # seen is seen


def test_what_is_passed_does_not_hide_what_is_seen_beyond():
    inside = claim(30)
    passed, failed = (judge(Limit("rms", size), inside) for size in (0.2, 0.12))
    away = beyond(Beyond((Fold("one end", 20, 0.3, 0.9, 0.2),), 0.3, 0.3, "", 0.4, 1.2))
    assert elsewhere(passed, away) == (
        "RMS error passed inside the measured region alone: outside them it is 0.300 mm, more than "
        "the 0.2 mm required"
    )
    assert elsewhere(failed, away) == ""
    assert elsewhere(judge(Limit("rms", 0.35), inside), away) == ""
    assert elsewhere(passed, inside) == ""
    assert elsewhere(passed, beyond(Beyond(reason="none"))) == ""


def test_limits_are_read():
    assert limits_of("rms 0.2, max 0.5") == (Limit("rms", 0.2), Limit("max", 0.5))
    assert limits_of("MAX=1mm") == (Limit("max", 1.0),)
    assert limits_of("") == ()
    for text in (
        "0.2",
        "rms",
        "rms -1",
        "rms 0",
        "mean 0.2",
        "rms 0.2 max 0.5",
        "rms 1e",
        "rms inf",
    ):
        with pytest.raises(mc.OptionError, match="write it in mm as rms"):
            limits_of(text)
    with pytest.raises(mc.OptionError, match="twice"):
        limits_of("rms 0.2, rms 0.3")


def test_the_upper_limits_of_beyond_are_in_the_file(robot):
    fit = mc.calibrate(robot, mc.simulate(robot, 100, 3, seed=1).data, "sum")
    assert fit.beyond.worst is not None
    assert fit.beyond.rms_high_mm > fit.beyond.worst_mm
    assert fit.beyond.max_high_mm > max(fold.max_mm for fold in fit.beyond.folds) * 0.9
    assert mc.Fit.from_dict(fit.to_dict()).beyond == fit.beyond
