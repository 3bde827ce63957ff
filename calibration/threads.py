"""Number of threads of the calibrations' linear algebra."""

from __future__ import annotations

from contextlib import AbstractContextManager

from threadpoolctl import threadpool_limits


def one_thread() -> AbstractContextManager[object]:
    """Let BLAS compute with one thread: matrices are so small that several only wait for each other."""
    return threadpool_limits(1, user_api="blas")  # type: ignore[no-any-return]
