"""Largest load of a bus by the messages, over bit rate and camera frame rate."""

import math
from dataclasses import dataclass

from robot_io.protocol.codec import FRAME_LENGTH
from robot_io.protocol.dbc import cycle_time_s, database

FRAME_MESSAGES = ("SeamOffset", "SeamPoint", "SeamGeometry", "TrackerStatus")
"""Messages that are sent with each frame of the camera."""


def frame_bits(length: int = FRAME_LENGTH) -> int:
    """Return the most bits that a frame of the standard format takes, the space behind it included.

    47 bits stand around the data, and of 34 bits of header and the data's every fourth may be a stuff bit
    (R. I. Davis et al., "Controller Area Network (CAN) schedulability analysis", Real-Time Systems 35, 2007).
    """
    return 47 + 8 * length + (34 + 8 * length - 1) // 4


def min_frame_bits(length: int = FRAME_LENGTH) -> int:
    """Return the fewest bits of such a frame: none of them is a stuff bit."""
    return 47 + 8 * length


@dataclass(frozen=True)
class ResponseTime:
    """Time of a message from its sender until it is on the bus, s, and the number of frames that includes."""

    time_s: float
    frames: int


def response_time_s(name: str, frame_rate_hz: float, bit_rate_bit_s: float) -> ResponseTime:
    """Return the longest time from the queueing of a message until its last bit is on the bus.

    One frame of lower priority may just have begun. All of higher priority go first, each as often as it
    comes meanwhile (Davis et al. 2007, Eq. 4 to 6, without jitter). Only this layout's messages count. Raises
    ValueError if those of higher priority leave it no room: it would wait for ever.
    """
    longest_s, bit_s = frame_bits() / bit_rate_bit_s, 1.0 / bit_rate_bit_s
    own = database().get_message_by_name(name)
    before = [layout for layout in database().messages if layout.frame_id < own.frame_id]
    rates_hz = [frame_rate_hz if m.name in FRAME_MESSAGES else 1.0 / cycle_time_s(m) for m in before]
    if longest_s * sum(rates_hz) >= 1.0:
        raise ValueError(f"{name}: messages of higher priority take all of {bit_rate_bit_s:g} bit/s")
    frames, waited = 1, 0
    while frames != waited:
        waited = frames
        frames = 1 + sum(math.ceil((waited * longest_s + bit_s) * rate_hz) for rate_hz in rates_hz)
    return ResponseTime((frames + 1) * longest_s, frames + 1)


def frames_per_s(frame_rate_hz: float) -> float:
    """Return the frames per second, 1/s, of all messages at a camera's frame rate."""
    return sum(
        frame_rate_hz if layout.name in FRAME_MESSAGES else 1.0 / cycle_time_s(layout)
        for layout in database().messages
    )


def load_share(frame_rate_hz: float, bit_rate_bit_s: float) -> float:
    """Return the share of a bit rate that all messages take at most at a camera's frame rate."""
    return frame_bits() * frames_per_s(frame_rate_hz) / bit_rate_bit_s
