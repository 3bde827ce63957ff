"""A laser profiler's profile as bytes: what a sensor's program sends over TCP, and arctrack reads.

A message is a header of 32 bytes, a height of each column (float32, mm, NaN for none), in version 2 its
sigma (float32, mm, NaN where unknown), and an intensity of each column (uint16). All is
little-endian. docs/reference/profile_stream.md has the table.
"""

import struct
from typing import NamedTuple

import numpy as np

from noise_model.compiled.arrays import Float64, Integers

MAGIC, MAGIC_WITH_SIGMAS = b"ATPROF1\0", b"ATPROF2\0"
"""First bytes of each message: it is a profile, of this version."""

HEADER = struct.Struct("<8sQQq")
"""Magic, columns, number, time of the mid-exposure on the sensor's clock, ns."""

BYTES_A_COLUMN = {MAGIC: 6, MAGIC_WITH_SIGMAS: 10}

MAX_INTENSITY = 65_535
"""Largest intensity: 16 bits."""


class ProfileMessage(NamedTuple):
    """A profile as sent: its number, mid-exposure on the sensor's clock, ns, heights (n,), intensities (n,).

    Heights are in mm over z = 0 of the profile's frame, NaN for none; `sigma_mm` (n,) is None in version 1.
    """

    number: int
    time_ns: int
    z_mm: Float64
    intensity: Integers
    sigma_mm: Float64 | None = None


class ProfileMessageError(ValueError):
    """Bytes are no profile, or not of the columns that are expected."""


def pack_profile(
    number: int, time_ns: int, z_mm: Float64, intensity: Integers, sigma_mm: Float64 | None = None
) -> bytes:
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
    sigma_mm : array of float, (n,), optional
        1 sigma of each height, mm, NaN where unknown: for a setup whose [camera] states point_sigma = true.

    Returns
    -------
    bytes
        The message, of 32 + 6 n bytes, 32 + 10 n with sigmas.

    Raises
    ------
    ValueError
        Heights, intensities and sigmas are not of one length, or an intensity is out of its range.
    """
    heights, intensities = np.asarray(z_mm, "<f4"), np.asarray(intensity)
    if heights.ndim != 1 or heights.shape != intensities.shape:
        raise ValueError(f"profile {number}: {heights.shape} heights, {intensities.shape} intensities")
    if ((intensities < 0) | (intensities > MAX_INTENSITY)).any():
        raise ValueError(f"profile {number}: an intensity is not within 0 to {MAX_INTENSITY}")
    sigmas = np.empty(0, "<f4") if sigma_mm is None else np.asarray(sigma_mm, "<f4")
    if sigma_mm is not None and sigmas.shape != heights.shape:
        raise ValueError(f"profile {number}: {heights.shape} heights, {sigmas.shape} sigmas")
    magic = MAGIC if sigma_mm is None else MAGIC_WITH_SIGMAS
    header = HEADER.pack(magic, len(heights), number, time_ns)
    return header + heights.tobytes() + sigmas.tobytes() + intensities.astype("<u2").tobytes()


def take_profile(received: bytearray, columns: int) -> ProfileMessage | None:
    """Take the first profile out of what was received, None where it is not whole yet.

    Raises ProfileMessageError as soon as the bytes are no profile of so many columns.
    """
    begin = bytes(received[: len(MAGIC)])
    if not any(magic.startswith(begin) for magic in BYTES_A_COLUMN):
        raise ProfileMessageError(f"gives no profile: a message begins with {begin!r}")
    if len(received) < HEADER.size:
        return None
    magic, held, number, time_ns = HEADER.unpack_from(received)
    if held != columns:
        raise ProfileMessageError(f"gives {held} columns, the setup's [camera] states columns = {columns}")
    end = HEADER.size + columns * BYTES_A_COLUMN[magic]
    if len(received) < end:
        return None
    floats = np.frombuffer(received[HEADER.size : end - 2 * columns], "<f4").astype(np.float64)
    intensity = np.frombuffer(received[end - 2 * columns : end], "<u2").astype(np.uint16)
    del received[:end]
    z_mm, sigma_mm = floats[:columns], floats[columns:]
    return ProfileMessage(number, time_ns, z_mm, intensity, sigma_mm if len(sigma_mm) else None)
