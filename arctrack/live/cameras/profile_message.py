"""A laser profiler's profile as bytes: what a sensor's program sends over TCP, and arctrack reads.

A message is a header of 32 bytes, a height of each column (float32, mm, NaN for none), and an intensity of
each column (uint16). All is little-endian. docs/reference/profile_stream.md has the table.
"""

import struct
from typing import NamedTuple

import numpy as np

from noise_model.compiled.arrays import Float64, Integers

MAGIC = b"ATPROF1\0"
"""First bytes of each message: it is a profile, of this version."""

HEADER = struct.Struct("<8sQQq")
"""Magic, columns, number, time of the mid-exposure on the sensor's clock, ns."""

BYTES_A_COLUMN = 6

MAX_INTENSITY = 65_535
"""Largest intensity: 16 bits."""


class ProfileMessage(NamedTuple):
    """A profile as sent: its number, mid-exposure on the sensor's clock, ns, heights (n,), intensities (n,).

    Heights are in mm over z = 0 of the profile's frame, NaN for none.
    """

    number: int
    time_ns: int
    z_mm: Float64
    intensity: Integers


class ProfileMessageError(ValueError):
    """Bytes are no profile, or not of the columns that are expected."""


def pack_profile(number: int, time_ns: int, z_mm: Float64, intensity: Integers) -> bytes:
    """Return the bytes of a profile, as kind "profile_tcp" of a cell's camera reads them.

    Parameters
    ----------
    number : int
        The profile's number: one more with each that the sensor takes.
    time_ns : int
        The time of its mid-exposure on the sensor's own clock, ns.
    z_mm : array of float, (n,)
        The heights of the columns over z = 0 of the profile's frame, mm; NaN for none.
    intensity : array of int, (n,)
        The intensities of the columns, 0 to 65535.

    Returns
    -------
    bytes
        The message, of 32 + 6 n bytes.

    Raises
    ------
    ValueError
        Heights and intensities are not of one length, or an intensity is out of its range.
    """
    heights, intensities = np.asarray(z_mm, "<f4"), np.asarray(intensity)
    if heights.ndim != 1 or heights.shape != intensities.shape:
        raise ValueError(f"profile {number}: {heights.shape} heights, {intensities.shape} intensities")
    if ((intensities < 0) | (intensities > MAX_INTENSITY)).any():
        raise ValueError(f"profile {number}: an intensity is not within 0 to {MAX_INTENSITY}")
    header = HEADER.pack(MAGIC, len(heights), number, time_ns)
    return header + heights.tobytes() + intensities.astype("<u2").tobytes()


def take_profile(received: bytearray, columns: int) -> ProfileMessage | None:
    """Take the first profile out of what was received, None where it is not whole yet.

    Raises ProfileMessageError as soon as the bytes are no profile of so many columns.
    """
    begin = bytes(received[: len(MAGIC)])
    if not MAGIC.startswith(begin):
        raise ProfileMessageError(f"gives no profile: a message begins with {begin!r}")
    if len(received) < HEADER.size:
        return None
    _, held, number, time_ns = HEADER.unpack_from(received)
    if held != columns:
        raise ProfileMessageError(f"gives {held} columns, the setup's [camera] states columns = {columns}")
    end = HEADER.size + columns * BYTES_A_COLUMN
    if len(received) < end:
        return None
    z_mm = np.frombuffer(received[HEADER.size : end], "<f4", columns).astype(np.float64)
    intensity = np.frombuffer(received[end - 2 * columns : end], "<u2").astype(np.uint16)
    del received[:end]
    return ProfileMessage(number, time_ns, z_mm, intensity)
