"""Lines to a terminal, a pipe or a file."""

from __future__ import annotations

import errno
import os
from typing import TextIO

NOBODY_READS = frozenset({errno.EPIPE, errno.EIO})
"""What is raised where a pipe's reader has ended, or a terminal was closed."""


def write_line(line: str, stream: TextIO) -> None:
    """Write a line at once; where nobody reads any more, this one and all that come are dropped."""
    try:
        print(line, file=stream, flush=True)
    except OSError as error:
        if error.errno not in NOBODY_READS:
            raise
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, stream.fileno())
        os.close(nowhere)
