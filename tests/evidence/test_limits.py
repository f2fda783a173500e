"""Numbers that decide stand in one module, and are few."""

from minimax_cal.evidence import limits
from tests.thresholds import LIMITS, thresholds

MOST = 45


def test_numbers_that_decide_are_few_and_in_one_module():
    found = thresholds()
    assert [name for name in found if not name.startswith(LIMITS)] == []
    assert len(found) <= MOST
    assert found[f"{LIMITS}:BAND"] == limits.BAND
