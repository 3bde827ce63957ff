"""Number of threads of the calibrations' linear algebra."""

from collections.abc import Iterator
from contextlib import contextmanager

from threadpoolctl import threadpool_limits


@contextmanager
def one_thread() -> Iterator[None]:
    """Let BLAS compute with one thread: matrices are so small that several only wait for each other."""
    with threadpool_limits(1, user_api="blas"):
        yield
