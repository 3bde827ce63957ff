"""Grey PNGs of 8 or 16 bits, read so that a truncated or damaged one is always noticed.

OpenCV hands out what it could decode of a cut PNG and says nothing that a program could hear; so the
chunks and their checksums are walked before it may decode.
"""

from __future__ import annotations

import struct
import zlib

import cv2
import numpy as np

from noise_model.arrays import Integers

SIGNATURE = b"\x89PNG\r\n\x1a\n"


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


def decode(encoded: bytes) -> Integers:
    """Decode a whole PNG to its raw pixels; ValueError says what is wrong with it."""
    problem = problem_of(encoded)
    if problem is not None:
        raise ValueError(problem)
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
