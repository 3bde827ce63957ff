"""Reader of grey PNGs of 8 or 16 bits that always notices a truncated or damaged one.

Chunks and their checksums are walked before anything is decoded: OpenCV returns what it could decode of a cut
PNG and reports nothing that a program could use. OpenCV decodes, except for grey pixels in rows of the filter
Sub, as OpenCV itself and so arctrack writes them: ISA-L inflates these three times as fast.
"""

import struct
from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt
from isal import isal_zlib

from arctrack.recording.png_rows import SUB, undo_sub
from noise_model.compiled.arrays import Integers

SIGNATURE = b"\x89PNG\r\n\x1a\n"

CHANNELS = {0: 1, 2: 3, 3: 3, 4: 2, 6: 4}
"""Channels of a PNG's colour types; 3 looks its colours up in a palette (W3C PNG, 11.2.1)."""

WRONG_HEADER = "is no PNG: its header is wrong"


@dataclass(frozen=True)
class PngHeader:
    """A PNG's properties of its pixels before they are decoded."""

    width: int
    height: int
    bits: int
    channels: int
    is_interlaced: bool

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
    """Return the problem of a PNG's bytes, None if it is whole."""
    if not encoded:
        return "is empty"
    if not encoded.startswith(SIGNATURE):
        return "is truncated" if SIGNATURE.startswith(encoded) else "is no PNG"
    for name, content in _chunks(encoded):
        checked = memoryview(encoded)[content.start - 4 : content.stop]
        if isal_zlib.crc32(checked) != int.from_bytes(encoded[content.stop : content.stop + 4]):
            return f"is damaged: the checksum of its {name.decode('latin-1')!r} chunk is wrong"
        if name == b"IEND":
            return None
    return f"is truncated after {len(encoded)} bytes"


def _chunks(encoded: bytes) -> Iterator[tuple[bytes, slice]]:
    """Yield each whole chunk's name and where its content lies: W3C PNG, 5.3."""
    position = len(SIGNATURE)
    while position + 8 <= len(encoded):
        length, name = struct.unpack_from(">I4s", encoded, position)
        content = slice(position + 8, position + 8 + length)
        position = content.stop + 4
        if position > len(encoded):
            return
        yield name, content


def header_of(encoded: bytes) -> PngHeader:
    """Return the header of a whole PNG, its pixels untouched; ValueError says what is wrong with it."""
    problem = problem_of(encoded)
    if problem is not None:
        raise ValueError(problem)
    name, content = next(_chunks(encoded))
    if (name, content.stop - content.start) != (b"IHDR", 13):
        raise ValueError(WRONG_HEADER)
    width, height, bits, colour, interlace = struct.unpack(">IIBBxxB", encoded[content])
    if not (width and height) or colour not in CHANNELS:
        raise ValueError(WRONG_HEADER)
    if bits not in (8, 16) and colour == 0:
        raise ValueError(f"has {bits} bits a pixel: grey levels of 8 or 16 are needed")
    return PngHeader(width, height, bits, CHANNELS[colour], interlace != 0)


def decode(encoded: bytes, header: PngHeader) -> Integers:
    """Decode a PNG to its raw pixels, with its `header_of`; ValueError says what is wrong with it."""
    pixels = _decode_sub(encoded, header) if header.channels == 1 and not header.is_interlaced else None
    if pixels is not None:
        return pixels
    try:
        image = cv2.imdecode(np.frombuffer(encoded, dtype=np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error as error:
        raise ValueError(f"cannot be decoded: {error.err}") from None
    if image is None:
        raise ValueError("cannot be decoded")
    return np.asarray(image, dtype=np.uint16 if image.dtype == np.uint16 else np.uint8)


def _decode_sub(encoded: bytes, header: PngHeader) -> Integers | None:
    """Decode a grey PNG of 8 or 16 bits, None if rows have other filters than Sub: W3C PNG, 9 and 10."""
    pixel_bytes = header.bits // 8
    row_bytes = header.width * pixel_bytes
    size = header.height * (1 + row_bytes)
    deflated = b"".join(encoded[content] for name, content in _chunks(encoded) if name == b"IDAT")
    try:
        inflated = isal_zlib.decompressobj().decompress(deflated, size)
    except isal_zlib.error as error:
        raise ValueError(f"cannot be decoded: {error}") from None
    if len(inflated) < size:
        raise ValueError(f"cannot be decoded: {len(inflated)} bytes of pixels where {size} are needed")
    filtered = np.frombuffer(inflated, np.uint8).reshape(header.height, 1 + row_bytes)
    filters = filtered[:, 0]
    # The filters of rows are 0 to 4 (W3C PNG, 9.2).
    if filters.max() >= 5:
        raise ValueError("cannot be decoded: a row's filter is of no known type")
    if (filters != SUB).any():
        return None
    rows = np.empty((header.height, row_bytes), np.uint8)
    undo_sub(filtered, pixel_bytes, rows)
    # The first byte is the higher one.
    return rows if pixel_bytes == 1 else rows.view(">u2").astype(np.uint16)


def encode(image_dn: Integers) -> bytes:
    """Encode a grey image (H, W), uint8 or uint16, as a PNG."""
    done, encoded = cv2.imencode(".png", image_dn)
    if not done:
        raise ValueError("the image cannot be encoded as a PNG")
    return encoded.tobytes()
