"""Readers of text logs with one frame a line: of candump, PEAK's tools and python-can's `.csv`.

A log is cut off where its computer lost power: in the middle of a line, or in NUL bytes, with which file
systems fill what was not written.
"""

import io
import math
import re
from collections.abc import Callable, Iterator
from datetime import UTC, datetime, timedelta
from typing import BinaryIO

import can
from cantools.logreader import Parser

from robot_io.link.bus_log import UNIX_TIME_FROM_S, BusLogError

LONGEST_LINE = 65_536
"""Bytes: a line of a text log holds one frame."""


class LogLines:
    """Iterable of the lines of a text log.

    They are decoded as Latin-1, which never fails: of what is read of a log, only the names of months are
    beyond ASCII. `number` is the line read last, from 1; `is_unfinished` says that it has no end;
    `unreadable` are the numbers of unreadable lines.
    """

    def __init__(self, file: BinaryIO) -> None:
        self._file = file
        self.number = 0
        self.is_unfinished = False
        self.unreadable: list[int] = []
        self.first_unreadable = ""

    def __iter__(self) -> Iterator[str]:
        while content := self._file.readline(LONGEST_LINE):
            self.number += 1
            is_whole = len(content) < LONGEST_LINE
            while not content.endswith(b"\n") and (rest := self._file.readline(LONGEST_LINE)):
                is_whole, content = False, rest
            self.is_unfinished = not content.endswith(b"\n")
            line = content.decode("latin-1").strip(" \t\r\n\ufeff").removeprefix("ï»¿")
            if not is_whole or "\0" in line:
                self.leave_out(line if is_whole else f"a line of more than {LONGEST_LINE} characters")
            elif line:
                yield line

    def leave_out(self, line: str) -> None:
        """Count the line that was read last as one that cannot be read."""
        if self.number not in self.unreadable[-1:]:
            self.unreadable.append(self.number)
            self.first_unreadable = self.first_unreadable or line

    @property
    def damage(self) -> str | None:
        """Description of what cannot be read; None if all can."""
        if not self.unreadable:
            return None
        first, count = self.unreadable[0], len(self.unreadable)
        if self.is_unfinished and first == self.number:
            return f"is cut off in line {first}: what stands before it is read"
        if count == 1:
            return f"line {first} cannot be read: it is left out"
        return f"{count} lines cannot be read, the first is line {first}: they are left out"


LineReader = Callable[[str], can.Message | None]
"""Returns the frame of a line, None for a line that holds none; ValueError for a part of one."""

_CSV_HEADER = "timestamp,"
_TRC_START = re.compile(r";\$STARTTIME=([\d.]+)$")
_TRC_FRAME = re.compile(r"\b(?:Rx|Tx|DT)\b")
_TRC_STATE = re.compile(r"\S+\s+[\d.]+\s+(?:ST|EC|ER|EV)\s")
"""A state of the bus or of the device, counted or told as an event, as PEAK's tools write it since 2.0."""

_CANDUMP_TIME = re.compile(r"\((?P<time>[\d.]+|\d{4}-\d\d-\d\d [\d:.]+)\)\s")
_CANDUMP_WAY = re.compile(r"(?<=\s)(?:RX|TX)(?:\s+[-BE]){2}\s+")
"""Fields that `candump -x` puts before the identifier: the direction, bit rate switch and error state."""


def line_reader(suffix: str) -> LineReader:
    """Return the reader of the lines of a `.log`, a `.trc` or a `.csv`."""
    readers: dict[str, LineReader] = {".log": _CandumpLines(), ".trc": _TrcLines(), ".csv": _csv_line}
    return readers[suffix]


def text_frames(lines: LogLines, read_line: LineReader) -> Iterator[can.Message]:
    """Yield the frames of a text log; lines that cannot be read are left out and counted."""
    for line in lines:
        try:
            frame = read_line(line)
            if frame is not None and not math.isfinite(frame.timestamp):
                raise ValueError("no time")
        except BusLogError as error:
            raise BusLogError(f"line {lines.number}: {error}") from None
        except (ValueError, TypeError, LookupError, OverflowError, OSError):
            lines.leave_out(line)
            continue
        if frame is not None:
            yield frame


class _CandumpLines:
    def __init__(self) -> None:
        self._parser = Parser()
        self._before_s = 0.0

    def __call__(self, line: str) -> can.Message | None:
        if "#" in line:
            return next(iter(can.CanutilsLogReader(io.StringIO(line))))
        # As candump prints to its screen: no `-L`.
        frame = _cantools_frame(self._parser, _CANDUMP_WAY.sub("", line, count=1))
        if frame is None or _CANDUMP_TIME.match(line) is None:
            raise ValueError("no frame")
        if frame.timestamp < min(self._before_s, UNIX_TIME_FROM_S):
            raise BusLogError(
                f"the time falls back to {frame.timestamp:.6f}, as the steps of candump -td do: "
                "record by candump -L"
            )
        self._before_s = frame.timestamp
        return frame


def _csv_line(line: str) -> can.Message | None:
    if line.startswith(_CSV_HEADER):
        return None
    return next(iter(can.CSVReader(io.StringIO(f"{_CSV_HEADER}\n{line}"))))


class _TrcLines:
    def __init__(self) -> None:
        self._parser = Parser()
        self._start_s = 0.0

    def __call__(self, line: str) -> can.Message | None:
        if start := _TRC_START.match(line):
            # PEAK's start times count days from 1899-12-30 on.
            self._start_s = (datetime(1899, 12, 30, tzinfo=UTC) + timedelta(days=float(start[1]))).timestamp()
        if line.startswith(";"):
            return None
        frame = _cantools_frame(self._parser, line)
        if frame is None:
            # What is no frame is a state of the bus or of the device.
            if _TRC_FRAME.search(line) and not _TRC_STATE.match(line):
                raise ValueError("a part of a frame")
            return None
        frame.timestamp += self._start_s
        return frame


def _cantools_frame(parser: Parser, line: str) -> can.Message | None:
    """Return a frame of candump's screen or of PEAK's tools; its time is as the line has it."""
    parsed = parser.parse(line)
    if parsed is None:
        return None
    if parsed.timestamp is None:
        raise BusLogError("its frames have no times: record them by candump -L")
    stamp = parsed.timestamp
    return can.Message(
        timestamp=stamp.total_seconds() if isinstance(stamp, timedelta) else stamp.timestamp(),
        arbitration_id=parsed.frame_id & 0x1FFFFFFF,
        is_extended_id=parsed.is_extended_frame,
        is_remote_frame=parsed.is_remote_frame,
        data=parsed.data,
        channel=parsed.channel.removeprefix("pcan").replace("x", "1")
        if parsed.channel.startswith("pcan")
        else parsed.channel,
    )
