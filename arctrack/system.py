"""Calls of the operating system that not every one has: locks, priorities, memory that stays.

Replay, check, inspect, calibrate, plan and diagnose run without any of them, in one process. A live run needs
them all, and says which are missing.
"""

import ctypes
import os
import select
import socket
from collections.abc import Collection, Iterator
from contextlib import contextmanager

from arctrack.errors import ArctrackError

try:
    import fcntl
    import resource
except ImportError:
    HAS_LOCKS = False
else:
    HAS_LOCKS = True

STARTS_CHILDREN = hasattr(select, "poll")
"""True if a process can hand open files to those that it starts, and these see it end."""

LIVE_NEEDS = {
    "file locks": HAS_LOCKS,
    "real-time priorities": hasattr(os, "sched_setscheduler"),
    "choice of processors": hasattr(os, "sched_setaffinity"),
    "reserved memory": hasattr(os, "posix_fallocate"),
    "message sockets": hasattr(socket, "SOCK_SEQPACKET") and hasattr(socket, "SOCK_CLOEXEC"),
    "owners of files": hasattr(os, "geteuid"),
    "child processes": STARTS_CHILDREN,
}
"""Needs of a live run, and True where this system meets them."""

_MCL_CURRENT, _MCL_FUTURE = 1, 2


def require_live(command: str) -> None:
    """Raise ArctrackError where this system lacks what a live run needs."""
    missing = [what for what, is_there in LIVE_NEEDS.items() if not is_there]
    if missing:
        raise ArctrackError(
            f"{command} needs Linux: this system lacks {', '.join(missing)}; replay, check, inspect, "
            "calibrate, plan and diagnose run here"
        )


def processors() -> list[int]:
    """Return the processors that this process may use; all, where the system does not say."""
    if hasattr(os, "sched_getaffinity"):
        return sorted(os.sched_getaffinity(0))
    return list(range(os.cpu_count() or 1))


def choose_processors(chosen: Collection[int]) -> None:
    """Run this process on some processors alone. Raises OSError where they are not to be had."""
    os.sched_setaffinity(0, chosen)


def choose_priority(priority: int) -> None:
    """Give this process a real-time priority, SCHED_FIFO. Raises OSError where it is not allowed."""
    os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))


@contextmanager
def scheduling_kept() -> Iterator[None]:
    """Give the process its processors and its priority back at the end of the block."""
    policy, parameters, allowed = os.sched_getscheduler(0), os.sched_getparam(0), os.sched_getaffinity(0)
    try:
        yield
    finally:
        os.sched_setaffinity(0, allowed)
        os.sched_setscheduler(0, policy, parameters)


def max_priority() -> int:
    """Return the highest real-time priority that this user may choose; 0 is none, -1 any."""
    soft, _ = resource.getrlimit(resource.RLIMIT_RTPRIO)
    return soft


def lock_memory() -> None:
    """Keep this process's memory from being swapped out. Raises OSError where it is not allowed."""
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.mlockall(_MCL_CURRENT | _MCL_FUTURE) != 0:
        number = ctypes.get_errno()
        raise OSError(number, os.strerror(number))


def max_locked_bytes() -> int | None:
    """Return how much memory this user may lock; None for no limit."""
    soft, _ = resource.getrlimit(resource.RLIMIT_MEMLOCK)
    return None if soft == resource.RLIM_INFINITY else soft


def reserve(file: int, n_bytes: int) -> None:
    """Give an open file its room. Raises OSError where there is none."""
    os.posix_fallocate(file, 0, n_bytes)


def lock(file: int) -> None:
    """Lock an open file for this process alone; it waits for readers that look whether it is locked."""
    fcntl.flock(file, fcntl.LOCK_EX)


def lock_if_free(file: int) -> bool:
    """Lock an open file for this process alone; return False if another one has a lock on it."""
    return _has_locked(file, fcntl.LOCK_EX)


def is_locked(file: int) -> bool:
    """Return True if a process holds a lock on an open file for itself alone."""
    if not _has_locked(file, fcntl.LOCK_SH):
        return True
    fcntl.flock(file, fcntl.LOCK_UN)
    return False


def _has_locked(file: int, kind: int) -> bool:
    try:
        fcntl.flock(file, kind | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True
