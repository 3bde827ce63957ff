"""Report of an error that is no user's mistake: one line, and a file with what led to it."""

import os
import select
import shlex
import sys
import tempfile
import traceback
from typing import NoReturn

from arctrack.cli.exit_codes import CRASHED, READER_GONE
from arctrack.printable import printable


def crash(error: BaseException) -> NoReturn:
    """Print that arctrack itself failed and where the traceback is kept, and end the process."""
    from arctrack.version import __version__

    lines = traceback.format_exception(error)
    text = f"arctrack {__version__}: {shlex.join(sys.argv)}\nPython {sys.version}\n\n{''.join(lines)}"
    try:
        # Each user's own (0600), under a name that nobody can take first.
        with tempfile.NamedTemporaryFile(
            "w", prefix="arctrack-", suffix=".txt", delete=False, encoding="utf-8", errors="backslashreplace"
        ) as file:
            file.write(text)
        kept = f"the traceback is in {file.name}, to report it with"
    except OSError:
        sys.stderr.write(text)
        kept = "the traceback stands above"
    what = printable(" ".join(f"{type(error).__name__}: {error}".split()))
    print(f"arctrack: error: arctrack itself failed, {what}; {kept}", file=sys.stderr)
    sys.exit(CRASHED)


def end_of_output(error: EOFError | BrokenPipeError) -> NoReturn:
    """End the process after a pipe or file ended: quietly if nobody reads the results, else as a crash."""
    if isinstance(error, BrokenPipeError) and _has_no_reader(sys.stdout.fileno()):
        # What is left to write has no reader; Python would complain of it at its end.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(READER_GONE)
    crash(error)


def _has_no_reader(descriptor: int) -> bool:
    ends = select.poll()
    ends.register(descriptor, 0)
    return bool(ends.poll(0))
