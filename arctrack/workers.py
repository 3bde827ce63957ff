"""Work on many recordings at once: processes of this machine, or a cluster's."""

from __future__ import annotations

import multiprocessing
import os
import time
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import BrokenExecutor, Executor, ProcessPoolExecutor, as_completed
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from pathlib import Path
from threading import Thread
from typing import Generic, Protocol, TypeVar

from arctrack.errors import ArctrackError, as_line

CONNECT_S = 10.0
"""Time-out of a cluster's scheduler."""


class RecordingJob(Protocol):
    """Work on one recording."""

    @property
    def recording(self) -> Path:
        """The recording's folder."""
        ...


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
            return f"{self.job.recording}: its process ended, for want of memory perhaps; try fewer --workers"
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
            yield FailedJob(futures[future], error)


def executor_of(workers: int, scheduler: str | None) -> AbstractContextManager[Executor]:
    """Yield an executor of `workers` processes here, or on a Dask cluster where its `scheduler` is named."""
    return processes(workers) if scheduler is None else cluster(scheduler)


def check_choice(workers: int, scheduler: str | None) -> None:
    """Raise ArctrackError where both processes and a cluster are requested."""
    if scheduler is not None and workers > 1:
        raise ArctrackError("--workers and --scheduler: take one of them")


def cores_each(workers: int, scheduler: str | None) -> int:
    """Return the number of this process's cores for each of `workers` recordings at once.

    One on a cluster, whose machines this one does not know.
    """
    if scheduler is not None:
        return 1
    # Not every system says which cores a process is held to.
    held = getattr(os, "sched_getaffinity", None)
    cores = os.cpu_count() if held is None else len(held(0))
    return max(1, (cores or 1) // workers)


@contextmanager
def processes(count: int) -> Iterator[Executor]:
    """Yield an executor of `count` processes on this machine; they end if this one is killed."""
    # A forked process would inherit the locks of threads that it does not have.
    spawn = multiprocessing.get_context("spawn")
    executor = ProcessPoolExecutor(count, mp_context=spawn, initializer=end_with_parent)
    try:
        yield executor
    finally:
        executor.shutdown(cancel_futures=True)


def end_with_parent(after_s: float = 0.0) -> None:
    """Let this process end some time after the one that started it has: nobody takes its results then."""
    parent = multiprocessing.parent_process()
    assert parent is not None

    def end() -> None:
        parent.join()
        time.sleep(after_s)
        os._exit(1)

    Thread(target=end, name="ends with parent", daemon=True).start()


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
