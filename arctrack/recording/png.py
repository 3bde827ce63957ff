"""Grey PNGs of 8 or 16 bits, read so that a truncated or damaged one is always noticed.

OpenCV hands out what it could decode of a cut PNG and says nothing that a program could hear; so the
chunks and their checksums are walked before it may decode.
"""

from __future__ import annotations

import struct
import zlib
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from noise_model.arrays import Integers

SIGNATURE = b"\x89PNG\r\n\x1a\n"

CHANNELS = {0: 1, 2: 3, 3: 3, 4: 2, 6: 4}
"""Channels of a PNG's colour types; 3 looks its colours up in a palette (W3C PNG, 11.2.1)."""


@dataclass(frozen=True)
class Header:
    """What a PNG says of its pixels before they are decoded."""

    width: int
    height: int
    bits: int
    channels: int

    @property
    def shape(self) -> tuple[int, ...]:
        """The shape of the decoded array."""
        grey = (self.height, self.width)
        return grey if self.channels == 1 else (*grey, self.channels)

    @property
    def dtype(self) -> npt.DTypeLike:
        """The type of the decoded array: fewer than 8 bits come as 8."""
        return np.uint16 if self.bits == 16 else np.uint8


def problem_of(encoded: bytes) -> str | None:
    """Return what is wrong with a PNG's bytes, None if it is whole."""
    if not encoded:
        return "is empty"
    if not encoded.startswith(SIGNATURE):
        return "is truncated" if SIGNATURE.startswith(encoded) else "is no PNG"
    position = len(SIGNATURE)
    while position + 8 <= len(encoded):
        length, name = struct.unpack_from(">I4s", encoded, position)
        end = position + 12 + length
        if end > len(encoded):
            break
        (checksum,) = struct.unpack_from(">I", encoded, end - 4)
        if zlib.crc32(encoded[position + 4 : end - 4]) != checksum:
            return f"is damaged: the checksum of its {name.decode('latin-1')!r} chunk is wrong"
        if name == b"IEND":
            return None
        position = end
    return f"is truncated after {len(encoded)} bytes"


def header_of(encoded: bytes) -> Header:
    """Return the header of a whole PNG, its pixels untouched; ValueError says what is wrong with it."""
    problem = problem_of(encoded)
    if problem is not None:
        raise ValueError(problem)
    length, name, width, height, bits, colour = struct.unpack_from(">I4sIIBB", encoded, len(SIGNATURE))
    if (length, name) != (13, b"IHDR") or colour not in CHANNELS:
        raise ValueError("is no PNG: its header is wrong")
    if bits < 8 and colour == 0:
        raise ValueError(f"has {bits} bits a pixel: grey levels of 8 or 16 are needed")
    return Header(width, height, bits, CHANNELS[colour])


def decode(encoded: bytes) -> Integers:
    """Decode a PNG that `header_of` found whole to its raw pixels; ValueError says what is wrong with it."""
    try:
        image = cv2.imdecode(np.frombuffer(encoded, dtype=np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error as error:
        raise ValueError(f"cannot be decoded: {error.err}") from None
    if image is None:
        raise ValueError("cannot be decoded")
    return np.asarray(image, dtype=np.uint16 if image.dtype == np.uint16 else np.uint8)


def encode(image_dn: Integers) -> bytes:
    """Encode a grey image (H, W), uint8 or uint16, as a PNG."""
    done, encoded = cv2.imencode(".png", image_dn)
    if not done:
        raise ValueError("the image cannot be encoded as a PNG")
    return encoded.tobytes()
