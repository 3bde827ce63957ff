"""Control line of a camera: what a tracker wants of it, in memory shared by two processes.

The line holds how long the laser is on, the requested exposure, and when the arc is at its base current.
Laser and pulse hold until a time, which the driver of the line must renew: if it dies or stops, the time runs
out, and the laser goes off by itself.

A frame is centred in a base phase of a pulsed arc, where its light is least. The host's possible error,
SLACK_S, must fit on both sides: the age on the bus is rounded to 0.1 ms, the message waits some 0.5 ms for
others, a sleep ends up to 0.2 ms late, and the trigger command takes up to 1 ms.
"""

import math
import mmap
import os
import struct
import time
import zlib
from contextlib import suppress
from dataclasses import astuple, dataclass, replace
from pathlib import Path

from arctrack.live.journal.private_memory import open_private, private_path
from arctrack.live.journal.ring import LOOKS
from arctrack.system import reserve
from robot_io import RobotPulse

HOLD_S = 0.3
"""Time that the laser stays on after it was last switched on, s: twice the longest step."""

PULSE_HOLD_S = 0.35
"""Time for which a pulse holds after the robot sent it: three cycles and a half, two may be lost."""

_WANTED, _CHECKSUM = struct.Struct("<6d"), struct.Struct("<I")
_BYTES = _WANTED.size + _CHECKSUM.size


@dataclass(frozen=True)
class CaptureRequest:
    """Request of a tracker to a camera; times are on the host's monotonic clock.

    The laser is on until `laser_until_s`. NaN as `exposure_s` leaves the camera its own. `base_begin_s` is
    the begin of a base phase of the pulsed arc (NaN where no pulse is known); a base phase lasts `base_s` of
    each `period_s`, and this is known until `pulse_until_s`.
    """

    laser_until_s: float = 0.0
    exposure_s: float = math.nan
    base_begin_s: float = math.nan
    period_s: float = math.nan
    base_s: float = math.nan
    pulse_until_s: float = 0.0


WIRED_ON = CaptureRequest(laser_until_s=math.inf)
"""Request to a camera whose line nobody ever drove: its laser is on for good."""


def line_path(name: str) -> Path:
    """Return where the line of a camera's name lies."""
    return private_path(f"line-{name}")


class CameraLine:
    """Control line of the camera whose frames have this name; the laser is off at first."""

    def __init__(self, name: str) -> None:
        path = line_path(name)
        new = path.with_name(f"{path.name}.{os.getpid()}")
        new.unlink(missing_ok=True)
        file = open_private(new, os.O_RDWR | os.O_CREAT)
        try:
            reserve(file, _BYTES)
            self._memory = mmap.mmap(file, _BYTES)
        finally:
            os.close(file)
        self._write(CaptureRequest())
        # A camera finds a line that is whole, and never one that is not there.
        new.replace(path)

    def switch_laser(self, is_on: bool) -> None:
        """Switch the laser; on lasts for HOLD_S."""
        self._write(replace(self._wanted, laser_until_s=time.monotonic() + HOLD_S if is_on else 0.0))

    def want_exposure(self, exposure_s: float) -> None:
        """Request an exposure, s, from the next frame on."""
        self._write(replace(self._wanted, exposure_s=exposure_s))

    def tell_pulse(self, pulse: RobotPulse, came_at_s: float) -> None:
        """Set the arc's pulse as received from the robot at a monotonic time, s; none where it is unknown."""
        if not pulse.period_us or not pulse.base_us or not math.isfinite(pulse.begin_age_ms):
            self._write(replace(self._wanted, pulse_until_s=0.0))
            return
        self._write(
            replace(
                self._wanted,
                base_begin_s=came_at_s - pulse.begin_age_ms / 1000.0,
                period_s=pulse.period_us / 1e6,
                base_s=pulse.base_us / 1e6,
                pulse_until_s=came_at_s + PULSE_HOLD_S,
            )
        )

    def close(self) -> None:
        """Switch the laser off for good."""
        if not self._memory.closed:
            self.switch_laser(False)
            self._memory.close()

    def _write(self, wanted: CaptureRequest) -> None:
        self._wanted = wanted
        packed = _WANTED.pack(*astuple(wanted))
        self._memory[:] = packed + _CHECKSUM.pack(zlib.crc32(packed))


def read_line(name: str) -> CaptureRequest:
    """Return what is wanted of a camera; `WIRED_ON` where nobody ever drove its line."""
    for _ in range(LOOKS):
        try:
            file = open_private(line_path(name), os.O_RDONLY)
        except FileNotFoundError:
            return WIRED_ON
        with os.fdopen(file, "rb") as line:
            held = line.read()
        packed, checksum = held[: _WANTED.size], held[_WANTED.size :]
        if len(held) == _BYTES and checksum == _CHECKSUM.pack(zlib.crc32(packed)):
            return CaptureRequest(*_WANTED.unpack(packed))
    return CaptureRequest()


def remove_line(name: str) -> None:
    """Remove a line, as the camera does that begins or ends."""
    with suppress(FileNotFoundError):
        line_path(name).unlink()


SLACK_S = 0.002
"""Largest error of the time of an exposure: the sum of what is named above."""


def is_reached(wanted: CaptureRequest, exposure_s: float, now_s: float) -> bool:
    """Return whether a base phase is known, and is long enough for a frame that the host triggers."""
    return now_s < wanted.pulse_until_s and wanted.base_s >= exposure_s + 2.0 * SLACK_S


def trigger_at_s(wanted: CaptureRequest, exposure_s: float, due_s: float, now_s: float) -> float:
    """Return when the exposure of a due frame begins, s: in the first base phase from `due_s` on.

    It is `due_s` itself where no base phase is known that the exposure fits in.
    """
    if not is_reached(wanted, exposure_s, now_s):
        return due_s
    begin_s = wanted.base_begin_s + (wanted.base_s - exposure_s) / 2.0
    return begin_s + wanted.period_s * math.ceil((due_s - begin_s) / wanted.period_s)
