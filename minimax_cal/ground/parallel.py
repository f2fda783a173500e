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
from typing import Any

import threadpoolctl

from minimax_cal.ground.errors import CalibrationError, OptionError
from minimax_cal.ground.optional import optional

PATIENCE = 5.0  # for a scheduler, and for its first worker, to answer [s]
DESERTED = 30.0  # a cluster without workers, which a nanny may yet start again [s]
WATCH = 1.0  # how often that is looked at [s]
TIMED = 2  # calls from which the time of the others is known
CHUNK = 1.0  # seconds of work sent at once; sending takes some 5 ms
START = 2.0  # seconds that a process takes to import all and to load the compiled kernels (1.6)
AHEAD = 2  # chunks of a process, so that it never waits for the next
PARTS = 4  # the larger, the sooner all end together: a chunk is this part of a share of what waits
CLUSTER_SHARES = 16  # at least so many chunks of a cluster, whose workers come and go
LARGE = "1 GiB"  # of what is sent to a cluster at once, beyond which it warns
ONE_THREAD = dict.fromkeys(
    ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS"), "1"
)
JOBLIB = "minimax-cal[jobs]"
DISTRIBUTED = "minimax-cal[distributed]"

PLAIN: list[Any] = []  # the pool of this process that `beside` made last, which stays for the next

Numbered = Generator[tuple[int, Any], None, None]
Work = Sequence[tuple[Callable[..., Any], int, tuple[Any, ...]]]  # what `numbered` takes
Queue = deque[tuple[Callable[..., Any], int, tuple[Any, ...]]]


class WorkersLost(CalibrationError):
    """The processes that were at work are gone."""


def numbered(function: Callable[..., Any], number: int, call: tuple[Any, ...]) -> tuple[int, Any]:
    """One call where it runs."""
    return number, function(*call)


def share(
    function: Callable[..., Any],
    calls: Sequence[tuple[Any, ...]],
    modules: Iterable[str] = (),
    *,
    processes: int = -1,
    cluster: str = "",
) -> Numbered:
    """The number of each call and its result, in the order they finish; this process works as well.

    function: at the top of a module.  calls: the arguments of each, which may be brief: they go in
    chunks.  processes: on this machine, -1 for one a core.  cluster: address of a Dask scheduler,
    instead, whose workers need modules, too.  What a call does to its process it may do to this
    one: no calls that end it.  Calls are timed here; processes start only where all that is left
    takes longer than their start.  Raises OptionError for what a user can mend, WorkersLost, and
    what a call raises.
    """
    if processes == 0:
        raise OptionError("0 processes: give their number, or -1 for one a core")
    waiting = deque((function, number, call) for number, call in enumerate(calls))
    needed = {__name__, function.__module__, *modules}
    clock = Clock()
    if cluster and waiting:
        look_for(cluster)
        while waiting and clock.calls < TIMED:
            yield clock.time(waiting.popleft())
        chunks = chunked(waiting, clock.seconds, CLUSTER_SHARES)
        work = [(several, number, (chunk,)) for number, chunk in enumerate(chunks)]
        if work:
            for _, found in on_cluster(work, cluster, needed):
                yield from found
        return
    while waiting:
        yield clock.time(waiting.popleft())
        if processes != 1 and clock.seconds * len(waiting) > START:
            joblib = optional("joblib", "work in several processes", JOBLIB)
            count = min(joblib.effective_n_jobs(processes), len(waiting))
            if count > 1:
                yield from beside(waiting, clock, count)


class Clock:
    """Calls that are made here, and how long one takes."""

    def __init__(self) -> None:
        self.calls = 0
        self.all = 0.0
        self.first = 0.0  # which also loads what it needs
        self.threads = threadpoolctl.ThreadpoolController()

    def time(self, work: tuple[Callable[..., Any], int, tuple[Any, ...]]) -> tuple[int, Any]:
        """Make a call here, by one thread as everywhere else."""
        began = time.monotonic()
        with self.threads.limit(limits=1):
            out = numbered(*work)
        seconds = time.monotonic() - began
        self.calls, self.all = self.calls + 1, self.all + seconds
        self.first = self.first or seconds
        return out

    @property
    def seconds(self) -> float:
        """Of a call, as far as is known: 0 before the second."""
        return (self.all - self.first) / max(self.calls - 1, 1)


def beside(waiting: Queue, clock: Clock, count: int) -> Numbered:
    """Calls in count - 1 other processes and in this one, until all are done or at work."""
    loky = import_module("joblib.externals.loky")
    broken = import_module("joblib.externals.loky.process_executor").BrokenProcessPool
    # packed here: in the pool's thread a call could change meanwhile, by what one made here stores
    pack = import_module("joblib.externals.loky.backend.reduction").dumps
    pool = loky.get_reusable_executor(max_workers=count - 1, env=ONE_THREAD)
    PLAIN[:] = [pool]
    flying: set[Future[list[tuple[int, Any]]]] = set()
    try:
        while waiting or flying:
            while waiting and len(flying) < AHEAD * (count - 1):
                chunk = next(chunked(waiting, clock.seconds, PARTS * count))
                flying.add(pool.submit(unpacked, bytes(pack(chunk))))
            if waiting:
                yield clock.time(waiting.popleft())
            else:
                wait(flying, return_when=FIRST_COMPLETED)
            done = {future for future in flying if future.done()}
            flying -= done
            for future in done:
                yield from future.result()
    except broken as error:
        raise WorkersLost(
            "a process died: too little memory, or it was killed; start fewer at once "
            f"({type(error).__name__})"
        ) from error
    finally:
        for future in flying:
            future.cancel()


def chunked(waiting: Queue, seconds: float, shares: int) -> Iterator[list[Any]]:
    """Chunks of about `CHUNK` seconds, no larger than a share of what waits; they wait no more."""
    while waiting:
        size = min(int(CHUNK / max(seconds, 1e-6)), -(-len(waiting) // shares))
        yield [waiting.popleft() for _ in range(max(size, 1))]


def several(work: Work) -> list[tuple[int, Any]]:
    """Some calls where they run."""
    return [numbered(*each) for each in work]


def unpacked(chunk: bytes) -> list[tuple[int, Any]]:
    """Calls from the process that shares them."""
    return several(pickle.loads(chunk))


def on_cluster(work: Work, cluster: str, modules: set[str]) -> Numbered:
    """On a Dask cluster, which deals with workers that come and go.

    Not by joblib's Dask backend (1.6): it waits for ever when Dask itself fails, as where a job
    kills its worker, and it runs on this machine alone while the cluster has one worker.
    """
    distributed = optional("distributed", "a Dask cluster", DISTRIBUTED)
    large = {"distributed.admin.large-graph-warning-threshold": LARGE}  # calls bring their data
    with connected(cluster) as client, import_module("dask").config.set(large):
        need_modules(client, cluster, modules)
        futures = client.map(numbered, *zip(*work, strict=True), pure=False)
        try:
            yield from results_of(client, futures)
        except (distributed.KilledWorker, CancelledError, OSError) as error:
            raise WorkersLost(f"{cluster}: {' '.join(str(error).split())}") from error


def results_of(client: Any, futures: Sequence[Any]) -> Numbered:
    """Results as they arrive.  Raises OSError when nobody has been at work on them for long."""
    distributed = optional("distributed", "a Dask cluster", DISTRIBUTED)
    waiting, seen = set(futures), time.monotonic()
    while waiting:
        done: set[Any] = set()
        with suppress(distributed.TimeoutError), client.as_current():
            done = distributed.wait(waiting, timeout=WATCH, return_when="FIRST_COMPLETED").done
        for future in done:
            for result in fetched(future, distributed.TimeoutError):
                waiting.discard(future)
                yield result
        if client.status == "running" and client.scheduler_info()["workers"]:
            seen = time.monotonic()
        elif time.monotonic() - seen > DESERTED:
            raise OSError(
                f"no scheduler or no workers for {DESERTED:g} s; start them again, and then this"
            )


def fetched(future: Any, late: type[Exception]) -> list[tuple[int, Any]]:
    """The result of a call that is done, or nothing where its worker left before it was fetched.

    Dask makes such a call again elsewhere, but a client that asked already waits for ever.  Raises
    what the call raised.
    """
    if future.status == "error":
        return [future.result()]
    with suppress(late):
        return [future.result(timeout=DESERTED)]
    return []


def need_modules(client: Any, cluster: str, modules: set[str]) -> None:
    """Raises OptionError unless scheduler and workers have modules; Dask would lose its workers."""
    try:
        for module in modules:
            client.run_on_scheduler(import_module, module)
            client.run(import_module, module)
    except ModuleNotFoundError as error:
        raise OptionError(
            f"{cluster} has no module {error.name!r}; start scheduler and workers in the project's "
            f"folder, with the same packages: python -m dask worker {cluster} --nthreads 1"
        ) from error


@contextmanager
def connected(cluster: str) -> Iterator[Any]:
    """A client of the Dask scheduler, which has at least one worker.  Raises OptionError."""
    distributed = optional("distributed", "a Dask cluster", DISTRIBUTED)
    look_for(cluster)
    with distributed.Client(cluster, timeout=PATIENCE, set_as_default=False) as client:
        try:
            client.wait_for_workers(1, timeout=PATIENCE)
        except TimeoutError as error:
            raise OptionError(
                f"{cluster}: the scheduler has no workers; start some in the project's folder: "
                f"python -m dask worker {cluster} --nworkers N --nthreads 1"
            ) from error
        yield client


def look_for(cluster: str) -> None:
    """Raises OptionError unless a Dask scheduler answers soon; a client might wait for ever."""
    distributed = optional("distributed", "a Dask cluster", DISTRIBUTED)

    async def identity() -> Any:
        async with distributed.rpc(cluster, timeout=PATIENCE) as scheduler:
            return await scheduler.identity()

    try:
        found = asyncio.run(asyncio.wait_for(identity(), PATIENCE))["type"]
    except Exception as error:  # no such host, no answer, or an answer of something else
        what = " ".join(str(error).split()) or f"no answer in {PATIENCE:g} s"
        if isinstance(error, MemoryError):  # its first bytes were taken for a length
            what = "what answers there is something else"
        raise OptionError(
            f"no Dask scheduler at {cluster!r} ({what}); start one with python -m dask scheduler "
            "and give its address as tcp://host:port"
        ) from error
    if found != "Scheduler":
        raise OptionError(f"{cluster} is a Dask {found.lower()}; give the scheduler's address")
