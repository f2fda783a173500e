"""Calls in a process that can be ended."""

import math
import os
import time

import pytest

from experiments.clocked import Clocked


def test_answers_come_back_from_one_other_process() -> None:
    with Clocked(os.getpid, 10.0) as clocked:
        first = clocked.call()
        assert first != os.getpid()
        assert clocked.call() == first


def test_a_slow_call_is_ended_and_the_next_one_answered() -> None:
    with Clocked(time.sleep, 0.3) as clocked:
        began = time.monotonic()
        with pytest.raises(TimeoutError, match=r"0\.3 s"):
            clocked.call(60.0)
        assert time.monotonic() - began < 30.0
        assert clocked.call(0.0) is None


def test_an_error_there_is_one_here() -> None:
    with Clocked(math.sqrt, 10.0) as clocked:
        with pytest.raises(RuntimeError, match="ValueError"):
            clocked.call(-1.0)
        assert clocked.call(4.0) == 2.0


def test_a_process_that_dies_is_an_error_and_replaced() -> None:
    with Clocked(os._exit, 10.0) as clocked:
        for _ in range(2):
            with pytest.raises(RuntimeError, match="died"):
                clocked.call(3)
