"""Work on many recordings at once: child processes of this machine, or a cluster's."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import (
    BrokenExecutor,
    CancelledError,
    Executor,
    Future,
    ThreadPoolExecutor,
    as_completed,
)
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from threading import Lock
from typing import Any, Generic, Protocol, TypeVar, cast

from arctrack.child_process import WorkerProcess
from arctrack.errors import ArctrackError, as_line
from arctrack.system import STARTS_CHILDREN, processors

CONNECT_S = 10.0
"""Time-out of a cluster's scheduler."""

ENDS_S = 10.0
"""Time that an interrupted process may take to close its files."""

ENDED = "its process ended, for want of memory perhaps; try fewer --workers"

LOST = "the cluster lost it: its workers died, or the scheduler did; say the same again with --resume"


class RecordingJob(Protocol):
    """Work on one recording."""

    @property
    def recording(self) -> Path:
        """The recording's folder."""


Job = TypeVar("Job", bound=RecordingJob)
Result = TypeVar("Result")


@dataclass(frozen=True)
class FailedJob(Generic[Job]):
    """Work on a recording that failed, and why."""

    job: Job
    error: Exception

    @property
    def problem(self) -> str:
        """Message for people, in one line."""
        if isinstance(self.error, ArctrackError | OSError):
            return as_line(self.error, self.job.recording)
        if isinstance(self.error, BrokenExecutor):
            return f"{self.job.recording}: {self.error}"
        return f"{self.job.recording}: {type(self.error).__name__}: {self.error}"

    @property
    def foreseen(self) -> bool:
        """True if the user can mend it; otherwise it is a fault of arctrack's."""
        return isinstance(self.error, ArctrackError | BrokenExecutor | OSError)


def at_once(
    work: Callable[[Job], Result], jobs: Iterable[Job], executor: Executor
) -> Iterator[Result | FailedJob[Job]]:
    """Do the work on each recording wherever an executor runs it, and yield each result as it comes."""
    futures = {executor.submit(work, job): job for job in jobs}
    for future in as_completed(futures):
        try:
            yield future.result()
        except Exception as error:
            yield FailedJob(futures[future], BrokenExecutor(LOST) if _is_lost(error) else error)


def _is_lost(error: Exception) -> bool:
    """Return True of the error that stands for work which a cluster lost."""
    distributed = sys.modules.get("distributed")
    is_killed = distributed is not None and isinstance(error, distributed.KilledWorker)
    return is_killed or isinstance(error, CancelledError)


def executor_of(workers: int, scheduler: str | None) -> AbstractContextManager[Executor]:
    """Yield an executor of `workers` processes here, or on a Dask cluster where its `scheduler` is named."""
    return processes(workers) if scheduler is None else cluster(scheduler)


def check_choice(workers: int, scheduler: str | None) -> None:
    """Raise ArctrackError where both processes and a cluster are requested, or processes that cannot be."""
    if scheduler is not None and workers > 1:
        raise ArctrackError("--workers and --scheduler: take one of them")
    if workers > 1 and not STARTS_CHILDREN:
        raise ArctrackError(f"--workers {workers}: this system takes one recording at a time; leave it out")


def cores_each(workers: int, scheduler: str | None) -> int:
    """Return the number of this process's cores for each of `workers` recordings at once.

    One on a cluster, whose machines this one does not know, and where no process can use another core.
    """
    if scheduler is not None or not STARTS_CHILDREN:
        return 1
    return max(1, len(processors()) // workers)


class ProcessExecutor(ThreadPoolExecutor):
    """Executor whose threads have child processes do what is submitted.

    A process that ends by itself fails its task alone: the next one gets another process.
    """

    def __init__(self, count: int) -> None:
        super().__init__(count)
        self._started: list[WorkerProcess[Callable[[], Any], Any]] = []
        self._idle: list[WorkerProcess[Callable[[], Any], Any]] = []
        self._is_open, self._lock = True, Lock()

    def submit(self, work: Callable[..., Result], /, *args: Any, **kwargs: Any) -> Future[Result]:
        """Have a process do some work."""
        return super().submit(self._run, partial(work, *args, **kwargs))

    def interrupt(self) -> None:
        """Take no more work, interrupt what is at work, and end the processes."""
        self.shutdown(wait=False, cancel_futures=True)
        with self._lock:
            self._is_open = False
        for process in self._started:
            process.interrupt()
        for process in self._started:
            process.wait(ENDS_S)
        self.shutdown()
        for process in self._started:
            process.close()

    def _run(self, task: Callable[[], Result]) -> Result:
        with self._lock:
            if not self._is_open:
                raise CancelledError
            if not self._idle:
                self._idle.append(WorkerProcess(_call, BrokenExecutor(ENDED)))
                self._started.append(self._idle[-1])
            process = self._idle.pop()
        process.ask([task])
        try:
            (result,) = process.answers()
        except BrokenExecutor:
            raise
        except Exception:
            self._idle.append(process)
            raise
        self._idle.append(process)
        return cast(Result, result)


def _call(task: Callable[[], object]) -> object:
    return task()


@contextmanager
def processes(count: int) -> Iterator[Executor]:
    """Yield an executor of `count` child processes on this machine."""
    executor = ProcessExecutor(count)
    try:
        yield executor
    finally:
        executor.interrupt()


@contextmanager
def cluster(address: str) -> Iterator[Executor]:
    """Give an executor on a Dask cluster, whose workers must see the recordings under the same paths.

    ArctrackError if Dask is not installed or no scheduler answers.
    """
    try:
        from distributed import Client
    except ImportError:
        raise ArctrackError("--scheduler needs Dask: pip install 'arctrack[cluster]'") from None
    try:
        client = Client(address, timeout=CONNECT_S)
    except (OSError, ValueError) as error:
        raise ArctrackError(f"--scheduler {address}: no scheduler answers there: {error}") from None
    with client, client.get_executor(pure=False) as executor:
        yield executor
