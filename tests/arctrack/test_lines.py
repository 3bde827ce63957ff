"""Lines to a pipe that is full, or that nobody reads."""

from __future__ import annotations

import os
import subprocess
import sys

from arctrack.cli.lines import MAX_WAITING, LineQueue

HELD = """
    import sys
    from arctrack.cli.lines import LineQueue
    lines = LineQueue(sys.stderr.fileno())
    with lines.started():
        for number in range(1000):
            lines.put(f"line {number}")
    print("over")
"""


def fill(writing: int) -> int:
    """Fill a pipe, and return how many bytes it holds."""
    os.set_blocking(writing, False)
    held = 0
    try:
        while True:
            held += os.write(writing, b"-" * 4096)
    except BlockingIOError:
        os.set_blocking(writing, True)
    return held


def test_a_full_pipe_holds_up_neither_who_says_something_nor_the_end() -> None:
    reading, writing = os.pipe()
    fill(writing)
    script = "\n".join(line[4:] for line in HELD.splitlines())
    ended = subprocess.run([sys.executable, "-c", script], stdout=subprocess.PIPE, stderr=writing, text=True)
    os.close(writing)
    os.close(reading)
    assert (ended.returncode, ended.stdout) == (0, "over\n")


def test_what_waited_is_written_once_a_full_pipe_is_read() -> None:
    reading, writing = os.pipe()
    held = fill(writing)
    lines = LineQueue(writing)
    with os.fdopen(reading, "rb") as reader:
        with lines.started():
            for number in range(10 * MAX_WAITING):
                lines.put(f"line {number}")
            reader.read(held)
            assert [reader.readline() for _ in range(3)] == [b"line 0\n", b"line 1\n", b"line 2\n"]
        os.close(writing)


def test_a_reader_that_has_ended_ends_nothing() -> None:
    reading, writing = os.pipe()
    os.close(reading)
    lines = LineQueue(writing)
    with lines.started():
        lines.put("nobody reads this")
        lines.put("nor this")
    os.close(writing)
