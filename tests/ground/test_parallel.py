"""Calls shared between processes: same results, each once; few are not worth a process."""

import os
import threading
import time
from typing import ClassVar

import pytest

from experiments.sweep import run_calls_in_parallel
from minimax_cal.core.errors import OptionError
from minimax_cal.core.parallel import (
    PROCESS_START_SECONDS,
    CallTimer,
    WorkersLostError,
    deque,
    fetch_result_as_list,
    pop_task_chunks,
    run_in_parallel,
)

pytest.importorskip("joblib", reason="several processes need pip install minimax-cal[experiments]")
LONG = 0.1  # seconds of a call


def squared(number: int, seconds: float = 0.0) -> tuple[int, int]:
    """The square, and the process that made it."""
    time.sleep(seconds)
    return number**2, os.getpid()


class Noted:
    """A number that notes which thread packs it."""

    threads: ClassVar[set[int]] = set()

    def __reduce__(self) -> tuple[type, tuple[int]]:
        self.threads.add(threading.get_ident())
        return int, (3,)

    def __pow__(self, power: int) -> int:
        return 3**power


def died(parent: int) -> None:
    """Ends every process but one."""
    time.sleep(LONG)
    if os.getpid() != parent:
        os._exit(1)


@pytest.mark.parametrize("processes", [1, 2, 3])
def test_every_call_is_made_once(processes):
    count = int(1.5 * PROCESS_START_SECONDS / LONG)
    found = list(
        run_in_parallel(squared, [(n, LONG) for n in range(count)], process_count=processes)
    )
    assert sorted((number, each[0]) for number, each in found) == [(n, n**2) for n in range(count)]
    pids = {pid for _, (_, pid) in found}
    assert os.getpid() in pids  # this one works, too
    assert len(pids) <= processes


def test_both_ways_work_in_one_process():
    """The pool of the first is none of joblib's, which would lack what joblib gives its own."""
    brief = int(1.5 * PROCESS_START_SECONDS / LONG)
    for _ in range(2):
        found = list(run_in_parallel(squared, [(n, LONG) for n in range(brief)], process_count=2))
        assert len({pid for _, (_, pid) in found}) == 2
        whole = dict(run_calls_in_parallel(squared, [(n,) for n in range(4)], processes=2))
        assert [whole[n][0] for n in range(4)] == [0, 1, 4, 9]


def test_brief_work_starts_no_process(monkeypatch):
    monkeypatch.setattr(CallTimer, "mean_seconds", 1e-5)  # however busy the machine is
    found = dict(run_in_parallel(squared, [(n,) for n in range(300)], process_count=2))
    assert {pid for _, pid in found.values()} == {os.getpid()}


def test_chunks_shrink_towards_the_end():
    waiting = deque((squared, n, (n,)) for n in range(100))
    sizes = [len(chunk) for chunk in pop_task_chunks(waiting, 0.05, 4)]
    assert sum(sizes) == 100
    assert sizes[0] == 20  # a second
    assert sizes == sorted(sizes, reverse=True)
    assert sizes[-1] == 1


def test_a_process_that_dies_is_said():
    calls = [(os.getpid(),)] * int(3.0 * PROCESS_START_SECONDS / LONG)
    with pytest.raises(WorkersLostError, match="a process died"):
        list(run_in_parallel(died, calls, process_count=2))


def test_no_processes_are_refused():
    with pytest.raises(OptionError, match="0 processes"):
        list(run_in_parallel(squared, [(1,)], process_count=0))


class Future:
    """A call that is done: its result, or what it raised, or nothing where its worker left."""

    def __init__(self, status: str, result: object) -> None:
        self.status, self.given = status, result

    def result(self, timeout: float = 0.0) -> object:
        if isinstance(self.given, Exception):
            raise self.given
        return self.given


def test_a_result_that_is_lost_is_waited_for_again():
    assert fetch_result_as_list(Future("finished", (3, "x")), TimeoutError) == [(3, "x")]
    assert fetch_result_as_list(Future("finished", TimeoutError()), TimeoutError) == []
    with pytest.raises(TimeoutError):  # the call's own
        fetch_result_as_list(Future("error", TimeoutError()), TimeoutError)


def test_calls_are_packed_where_others_are_made():
    """In another thread they might change meanwhile, by what a call made here keeps for later."""
    calls = [(Noted(), LONG)] * int(4 * PROCESS_START_SECONDS / LONG)
    found = {
        number: result for number, (result, _) in run_in_parallel(squared, calls, process_count=2)
    }
    assert set(found.values()) == {9}
    assert Noted.threads == {threading.get_ident()}
