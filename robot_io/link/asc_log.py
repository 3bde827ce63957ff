"""Reader of the frames of an `.asc` as Vector's tools and python-can write it.

A line holds a time, a channel, an identifier or a message's name, Rx or Tx, and the data. Lines of CAN FD
hardware begin with `CANFD`, also where the frame is a classic one: bit 12 of the flags after the data tells.
Times count from the start that a date states, or from the line before where the head says `timestamps
relative`. (Source: python-can's `can.io.asc`, which reads and writes these lines.)
"""

import re
import unicodedata
from collections.abc import Iterator
from contextlib import suppress
from datetime import datetime

import can

from robot_io.link.bus_log import UNIX_TIME_FROM_S, BusLogError
from robot_io.link.text_logs import LogLines
from robot_io.protocol.dbc import database

_HEAD = re.compile(r"(?:date|begin\s+triggerblock)\s+(?P<date>\S.*)", re.IGNORECASE)
_BASE = re.compile(
    r"base\s+(?P<base>hex|dec)(?:\s+timestamps\s+(?P<times>absolute|relative))?", re.IGNORECASE
)
_TIMED = re.compile(r"(?P<time>\d+\.\d+)\s")
_CLASSIC = re.compile(
    r"(?P<time>\d+\.\d+)\s+(?P<channel>\d+)\s+(?P<id>\S+)\s+(?P<way>Rx|Tx)(?:\s+(?P<rest>.*))?$",
    re.IGNORECASE,
)
_ALMOST_CLASSIC = re.compile(r"\d\S*\s+\S+\s+\S+\s+(?:Rx|Tx)\s+[dr]\b", re.IGNORECASE)
_BEGIN = re.compile(r"date\s|base\s|//|;|(?:no\s+)?internal\s+events|begin\s+trigger|\d", re.IGNORECASE)
"""Beginnings of a log of Vector's tools."""

_FD = re.compile(
    r"(?P<time>\d+\.\d+)\s+CANFD\s+(?P<channel>\d+)\s+(?P<way>Rx|Tx)(?:\s+(?P<id>\S+)(?:\s+(?P<rest>.*))?)?$",
    re.IGNORECASE,
)
_NUMBER = {
    base: re.compile(rf"(?:0x)?(?P<number>[{digits}]+)(?P<extended>x?)$", re.IGNORECASE)
    for base, digits in ((16, "0-9a-f"), (10, "0-9"))
}
_DATE = re.compile(
    r"(?:\S+\s+)?(?P<month>\S+)\s+(?P<day>\d{1,2})\.?\s+(?P<hour>\d{1,2}):(?P<minute>\d\d):(?P<second>\d\d)"
    r"(?:[.,](?P<fraction>\d+))?(?:\s+(?P<half>[ap])\.?m\.?)?\s+(?P<year>\d{4})$",
    re.IGNORECASE,
)
_MONTHS = (
    "jan ene gen sty",
    "feb fev lut",
    "mar mrz mrt",
    "apr abr avr kwi",
    "may mai mag maj mei",
    "jun juin giu cze",
    "jul juil lug lip",
    "aug aou ago sie",
    "sep set wrz",
    "oct okt ott out paz",
    "nov lis",
    "dec dez dic gru",
)
"""Beginnings of the months' names, without accents, in English, German, French, Spanish, Italian, Portuguese,
Dutch, Scandinavian languages and Polish.
"""

_MONTH = {start: number for number, starts in enumerate(_MONTHS, 1) for start in starts.split()}


def asc_frames(lines: LogLines) -> Iterator[can.Message]:
    """Yield the frames of an `.asc`; lines that cannot be read are left out and counted.

    Raises BusLogError for a date that cannot be read.
    """
    base, is_relative = 16, False
    date, start_s, now_s = "", 0.0, 0.0
    is_begun = False
    for line in lines:
        is_begun = is_begun or _BEGIN.match(line) is not None
        if not is_begun:
            lines.leave_out(line)
            continue
        if base_line := _BASE.match(line):
            base = 10 if base_line["base"].lower() == "dec" else 16
            is_relative = (base_line["times"] or "").lower() == "relative"
            continue
        if (head := _HEAD.match(line)) and head["date"] != date:
            date = head["date"]
            if lines.is_unfinished:
                # The log is cut off in its head.
                return
            start_s, now_s = _start_s(date, lines), 0.0
            continue
        if is_relative and lines.unreadable:
            # Nobody knows how much time is lost with a line: all later ones rest on it.
            return
        if timed := _TIMED.match(line):
            now_s = float(timed["time"]) + (now_s if is_relative else 0.0)
        try:
            frame = _frame(line, base)
        except (ValueError, LookupError):
            lines.leave_out(line)
            continue
        if frame is not None:
            # The file holds microseconds; recording times come back to the nanosecond.
            frame.timestamp = start_s + now_s if start_s >= UNIX_TIME_FROM_S else round(now_s, 9)
            yield frame


def _frame(line: str, base: int) -> can.Message | None:
    """Return the frame of a line, None for a line that holds none of ours; ValueError for a part of one."""
    fd = _FD.match(line)
    match = fd or _CLASSIC.match(line)
    if match is None:
        if _ALMOST_CLASSIC.match(line):
            raise ValueError("a frame whose time or channel is no number")
        return None
    if not match["id"] or not match["rest"]:
        raise ValueError("no data")
    words = match["rest"].split()
    if fd:
        if match["id"].lower() == "errorframe":
            return None
        data, is_remote, is_fd = *_fd_data(words, base), _is_fd(words)
    elif words[0].lower() not in ("d", "r"):
        raise ValueError("neither data nor a request")
    else:
        is_remote, is_fd = words[0].lower() == "r", False
        data = bytearray() if is_remote else _data(words[2:], min(8, int(words[1], 16)), base)
    identified = _identifier(match["id"], base)
    if identified is None:
        return None
    return can.Message(
        arbitration_id=identified[0],
        is_extended_id=identified[1],
        is_remote_frame=is_remote,
        is_fd=is_fd,
        is_rx=match["way"].lower() == "rx",
        data=data,
        channel=match["channel"],
    )


def _identifier(text: str, base: int) -> tuple[int, bool] | None:
    """Return an identifier and whether it is extended; None for a name that is none of our messages."""
    if number := _NUMBER[base].match(text):
        return int(number["number"], base), bool(number["extended"])
    return next(
        (
            (message.frame_id, message.is_extended_frame)
            for message in database().messages
            if message.name == text
        ),
        None,
    )


def _data(words: list[str], length: int, base: int) -> bytearray:
    if len(words) < length:
        raise ValueError("a part of the data")
    return bytearray(int(word, base) for word in words[:length])


def _fd_words(words: list[str]) -> list[str]:
    """Return the words after the identifier of a CANFD line, without the message's name if there is one."""
    return words if words[0] in ("0", "1") else words[1:]


def _fd_data(words: list[str], base: int) -> tuple[bytearray, bool]:
    """Return the data of a CANFD line, and whether it is a request for data."""
    _brs, _esi, dlc, length, *data = _fd_words(words)
    return _data(data, int(length), base), int(length) == 0 and int(dlc, 16) > 0


def _is_fd(words: list[str]) -> bool:
    """Return True if a CANFD line's frame is one of CAN FD: duration, bits and flags follow its data."""
    _brs, _esi, _dlc, length, *data = _fd_words(words)
    behind = data[int(length) :]
    return len(behind) < 3 or bool(int(behind[2], 16) & (1 << 12))


def _start_s(date: str, lines: LogLines) -> float:
    """Return the Unix time, s, of a date in local time; BusLogError for a date that cannot be read."""
    match = _DATE.match(date)
    try:
        if match is None:
            return datetime.fromisoformat(date).timestamp()
        hour = int(match["hour"])
        if match["half"]:
            hour = hour % 12 + (12 if match["half"].lower() == "p" else 0)
        microsecond = int((match["fraction"] or "0").ljust(6, "0")[:6])
        day, minute, second = int(match["day"]), int(match["minute"]), int(match["second"])
        return datetime(
            int(match["year"]), _month(match["month"]), day, hour, minute, second, microsecond
        ).timestamp()
    except (ValueError, OverflowError):
        raise BusLogError(
            f"line {lines.number}: the date {date[:60]!r} cannot be read; "
            "write it as 'Wed May 01 09:59:59.000 am 2024'"
        ) from None


def _month(name: str) -> int:
    """Return the number of a month; ValueError for a name that is none."""
    # Written as UTF-8 or as Windows-1252.
    with suppress(UnicodeDecodeError):
        name = name.encode("latin-1").decode("utf-8")
    if digits := re.match(r"\d+", name):
        return int(digits[0])
    plain = unicodedata.normalize("NFKD", name.lower()).encode("ascii", "ignore").decode()
    number = _MONTH.get(plain[:4], _MONTH.get(plain[:3]))
    if number is None:
        raise ValueError("no month")
    return number
