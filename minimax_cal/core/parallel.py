"""Independent calls on all cores of this machine, or on the workers of a Dask cluster."""

from __future__ import annotations

import asyncio
import pickle
import time
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, CancelledError, Future, wait
from contextlib import contextmanager, suppress
from importlib import import_module
from typing import Any, NamedTuple

import threadpoolctl

from minimax_cal.core.errors import CalibrationError, OptionError
from minimax_cal.core.optional_packages import import_optional

SCHEDULER_TIMEOUT_SECONDS = 5.0  # for a scheduler, and for its first worker, to answer [s]
MAX_SECONDS_WITHOUT_WORKERS = (
    30.0  # a cluster without workers, which a nanny may yet start again [s]
)
CLUSTER_POLL_SECONDS = 1.0  # how often that is looked at [s]
MIN_TIMED_CALLS = 2  # calls from which the time of the others is known
CHUNK_SECONDS = 1.0  # seconds of work sent at once; sending takes some 5 ms
PROCESS_START_SECONDS = (
    2.0  # seconds that a process takes to import all and to load the compiled kernels (1.6)
)
CHUNKS_AHEAD_PER_PROCESS = 2  # chunks of a process, so that it never waits for the next
CHUNKS_PER_PROCESS_SHARE = (
    4  # the larger, the sooner all end together: a chunk is this part of a share of what waits
)
MIN_CLUSTER_CHUNKS = 16  # at least so many chunks of a cluster, whose workers come and go
CLUSTER_WARNING_SIZE = "1 GiB"  # of what is sent to a cluster at once, beyond which it warns
ONE_THREAD_ENVIRONMENT = dict.fromkeys(
    ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS"), "1"
)
JOBLIB_REQUIREMENT = "minimax-cal[jobs]"
DISTRIBUTED_REQUIREMENT = "minimax-cal[distributed]"

# The pool of this process that `run_in_processes_and_here` made last, which stays for the next.
REUSED_PROCESS_POOL: list[Any] = []


class Task(NamedTuple):
    """A call, with its number among all: what `call_with_index` takes."""

    function: Callable[..., Any]
    number: int
    arguments: tuple[Any, ...]


class IndexedResult(NamedTuple):
    """The number of a call, and what it returned."""

    number: int
    result: Any


IndexedResults = Generator[IndexedResult, None, None]
Tasks = Sequence[Task]
TaskQueue = deque[Task]


class WorkersLostError(CalibrationError):
    """The processes that were at work are gone."""


def call_with_index(
    function: Callable[..., Any], index: int, arguments: tuple[Any, ...]
) -> IndexedResult:
    """Make a call, and return its number with its result."""
    return IndexedResult(index, function(*arguments))


def run_in_parallel(
    function: Callable[..., Any],
    argument_tuples: Sequence[tuple[Any, ...]],
    required_modules: Iterable[str] = (),
    *,
    process_count: int = -1,
    scheduler_address: str = "",
) -> IndexedResults:
    """The number of each call and its result, in the order they finish; this process works as well.

    function: at the top of a module.  argument_tuples: the arguments of each, which may be brief:
    they go in chunks.  process_count: on this machine, -1 for one a core.  scheduler_address:
    address of a Dask scheduler, instead, whose workers need modules, too.  What a call does to its
    process it may do to this one: no calls that end it.  Calls are timed here; processes start only
    where all that is left takes longer than their start.  Raises OptionError for what a user can
    mend, WorkersLost, and what a call raises.
    """
    if process_count == 0:
        raise OptionError("0 processes: give their number, or -1 for one a core")
    waiting = deque(Task(function, number, call) for number, call in enumerate(argument_tuples))
    needed = {__name__, function.__module__, *required_modules}
    clock = CallTimer()
    if scheduler_address and waiting:
        check_scheduler_answers(scheduler_address)
        while waiting and clock.call_count < MIN_TIMED_CALLS:
            yield clock.run_and_time(waiting.popleft())
        chunks = pop_task_chunks(waiting, clock.mean_seconds, MIN_CLUSTER_CHUNKS)
        work = [Task(run_tasks, number, (chunk,)) for number, chunk in enumerate(chunks)]
        if work:
            for _, found in run_on_cluster(work, scheduler_address, needed):
                yield from found
        return
    while waiting:
        yield clock.run_and_time(waiting.popleft())
        if process_count != 1 and clock.mean_seconds * len(waiting) > PROCESS_START_SECONDS:
            joblib = import_optional("joblib", "work in several processes", JOBLIB_REQUIREMENT)
            count = min(joblib.effective_n_jobs(process_count), len(waiting))
            if count > 1:
                yield from run_in_processes_and_here(waiting, clock, count)


class CallTimer:
    """Calls that are made here, and how long one takes."""

    def __init__(self) -> None:
        self.call_count = 0
        self.total_seconds = 0.0
        self.first_call_seconds = 0.0  # which also loads what it needs
        self.threads = threadpoolctl.ThreadpoolController()

    def run_and_time(self, task: Task) -> IndexedResult:
        """Make a call here, by one thread as everywhere else."""
        began = time.monotonic()
        with self.threads.limit(limits=1):
            out = call_with_index(*task)
        seconds = time.monotonic() - began
        self.call_count, self.total_seconds = self.call_count + 1, self.total_seconds + seconds
        self.first_call_seconds = self.first_call_seconds or seconds
        return out

    @property
    def mean_seconds(self) -> float:
        """Mean seconds of a call, the first one left out; 0 before the second."""
        return (self.total_seconds - self.first_call_seconds) / max(self.call_count - 1, 1)


def run_in_processes_and_here(
    task_queue: TaskQueue, timer: CallTimer, process_count: int
) -> IndexedResults:
    """Calls in count - 1 other processes and in this one, until all are done or at work."""
    loky = import_module("joblib.externals.loky")
    broken = import_module("joblib.externals.loky.process_executor").BrokenProcessPool
    # packed here: in the pool's thread a call could change meanwhile, by what one made here stores
    pack = import_module("joblib.externals.loky.backend.reduction").dumps
    pool = loky.get_reusable_executor(max_workers=process_count - 1, env=ONE_THREAD_ENVIRONMENT)
    REUSED_PROCESS_POOL[:] = [pool]
    flying: set[Future[list[IndexedResult]]] = set()
    try:
        while task_queue or flying:
            while task_queue and len(flying) < CHUNKS_AHEAD_PER_PROCESS * (process_count - 1):
                chunk = next(
                    pop_task_chunks(
                        task_queue, timer.mean_seconds, CHUNKS_PER_PROCESS_SHARE * process_count
                    )
                )
                flying.add(pool.submit(run_pickled_tasks, bytes(pack(chunk))))
            if task_queue:
                yield timer.run_and_time(task_queue.popleft())
            else:
                wait(flying, return_when=FIRST_COMPLETED)
            done = {future for future in flying if future.done()}
            flying -= done
            for future in done:
                yield from future.result()
    except broken as error:
        raise WorkersLostError(
            "a process died: too little memory, or it was killed; start fewer at once "
            f"({type(error).__name__})"
        ) from error
    finally:
        for future in flying:
            future.cancel()


def pop_task_chunks(
    task_queue: TaskQueue, seconds_per_call: float, share_count: int
) -> Iterator[list[Task]]:
    """Chunks of about `CHUNK_SECONDS` seconds, no larger than a share of what waits; they wait no
    more.
    """
    while task_queue:
        size = min(
            int(CHUNK_SECONDS / max(seconds_per_call, 1e-6)), -(-len(task_queue) // share_count)
        )
        yield [task_queue.popleft() for _ in range(max(size, 1))]


def run_tasks(tasks: Tasks) -> list[IndexedResult]:
    """Some calls where they run."""
    return [call_with_index(*each) for each in tasks]


def run_pickled_tasks(pickled_tasks: bytes) -> list[IndexedResult]:
    """Calls from the process that shares them."""
    return run_tasks(pickle.loads(pickled_tasks))


def run_on_cluster(
    tasks: Tasks, scheduler_address: str, required_modules: set[str]
) -> IndexedResults:
    """On a Dask cluster, which deals with workers that come and go.

    Not by joblib's Dask backend (1.6): it waits for ever when Dask itself fails, as where a job
    kills its worker, and it runs on this machine alone while the cluster has one worker.
    """
    distributed = import_optional("distributed", "a Dask cluster", DISTRIBUTED_REQUIREMENT)
    large = {
        "distributed.admin.large-graph-warning-threshold": CLUSTER_WARNING_SIZE
    }  # calls bring their data
    with connect_to_cluster(scheduler_address) as client, import_module("dask").config.set(large):
        check_cluster_has_modules(client, scheduler_address, required_modules)
        futures = client.map(call_with_index, *zip(*tasks, strict=True), pure=False)
        try:
            yield from wait_for_results(client, futures)
        except (distributed.KilledWorker, CancelledError, OSError) as error:
            raise WorkersLostError(
                f"{scheduler_address}: {' '.join(str(error).split())}"
            ) from error


def wait_for_results(client: Any, futures: Sequence[Any]) -> IndexedResults:
    """Results as they arrive.  Raises OSError when nobody has been at work on them for long."""
    distributed = import_optional("distributed", "a Dask cluster", DISTRIBUTED_REQUIREMENT)
    waiting, seen = set(futures), time.monotonic()
    while waiting:
        done: set[Any] = set()
        with suppress(distributed.TimeoutError), client.as_current():
            done = distributed.wait(
                waiting, timeout=CLUSTER_POLL_SECONDS, return_when="FIRST_COMPLETED"
            ).done
        for future in done:
            for result in fetch_result_as_list(future, distributed.TimeoutError):
                waiting.discard(future)
                yield result
        if client.status == "running" and client.scheduler_info()["workers"]:
            seen = time.monotonic()
        elif time.monotonic() - seen > MAX_SECONDS_WITHOUT_WORKERS:
            raise OSError(
                f"no scheduler or no workers for {MAX_SECONDS_WITHOUT_WORKERS:g}"
                f" s; start them again, and then this"
            )


def fetch_result_as_list(future: Any, timeout_error_type: type[Exception]) -> list[IndexedResult]:
    """The result of a call that is done, or nothing where its worker left before it was fetched.

    Dask makes such a call again elsewhere, but a client that asked already waits for ever.  Raises
    what the call raised.
    """
    if future.status == "error":
        return [future.result()]
    with suppress(timeout_error_type):
        return [future.result(timeout=MAX_SECONDS_WITHOUT_WORKERS)]
    return []


def check_cluster_has_modules(client: Any, scheduler_address: str, modules: set[str]) -> None:
    """Raises OptionError unless scheduler and workers have modules; Dask would lose its workers."""
    try:
        for module in modules:
            client.run_on_scheduler(import_module, module)
            client.run(import_module, module)
    except ModuleNotFoundError as error:
        raise OptionError(
            f"{scheduler_address} has no module {error.name!r}; "
            f"start scheduler and workers in the project's "
            f"folder, with the same packages: python -m dask "
            f"worker {scheduler_address} --nthreads 1"
        ) from error


@contextmanager
def connect_to_cluster(scheduler_address: str) -> Iterator[Any]:
    """A client of the Dask scheduler, which has at least one worker.  Raises OptionError."""
    distributed = import_optional("distributed", "a Dask cluster", DISTRIBUTED_REQUIREMENT)
    check_scheduler_answers(scheduler_address)
    with distributed.Client(
        scheduler_address, timeout=SCHEDULER_TIMEOUT_SECONDS, set_as_default=False
    ) as client:
        try:
            client.wait_for_workers(1, timeout=SCHEDULER_TIMEOUT_SECONDS)
        except TimeoutError as error:
            raise OptionError(
                f"{scheduler_address}: the scheduler has no workers; "
                f"start some in the project's folder: "
                f"python -m dask worker {scheduler_address} --nworkers N --nthreads 1"
            ) from error
        yield client


def check_scheduler_answers(scheduler_address: str) -> None:
    """Raises OptionError unless a Dask scheduler answers soon; a client might wait for ever."""
    distributed = import_optional("distributed", "a Dask cluster", DISTRIBUTED_REQUIREMENT)

    async def identity() -> Any:
        async with distributed.rpc(
            scheduler_address, timeout=SCHEDULER_TIMEOUT_SECONDS
        ) as scheduler:
            return await scheduler.identity()

    try:
        found = asyncio.run(asyncio.wait_for(identity(), SCHEDULER_TIMEOUT_SECONDS))["type"]
    except Exception as error:  # no such host, no answer, or an answer of something else
        what = " ".join(str(error).split()) or f"no answer in {SCHEDULER_TIMEOUT_SECONDS:g} s"
        if isinstance(error, MemoryError):  # its first bytes were taken for a length
            what = "what answers there is something else"
        raise OptionError(
            f"no Dask scheduler at {scheduler_address!r} ({what}"
            f"); start one with python -m dask scheduler "
            "and give its address as tcp://host:port"
        ) from error
    if found != "Scheduler":
        raise OptionError(
            f"{scheduler_address} is a Dask {found.lower()}; give the scheduler's address"
        )
