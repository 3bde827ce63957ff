"""PNGs of frames, decoded as other readers decode them; damage that checksums do not show is told too."""

import io
import struct
import zlib

import cv2
import numpy as np
import pytest
from PIL import Image

from arctrack.recording.png import SIGNATURE, decode, encode, header_of
from arctrack.recording.png_rows import AVERAGE, NONE, PAETH, SUB, UP, unfilter
from noise_model.arrays import Integers, UInt8

FILTERS = (NONE, SUB, UP, AVERAGE, PAETH)


def chunk(name: bytes, content: bytes) -> bytes:
    return struct.pack(">I", len(content)) + name + content + struct.pack(">I", zlib.crc32(name + content))


def png(
    rows: bytes, width: int = 7, height: int = 5, bits: int = 8, colour: int = 0, methods: bytes = b"\0\0\0"
) -> bytes:
    """Return a PNG of these filtered rows, its checksums right."""
    header = struct.pack(">IIBB", width, height, bits, colour) + methods
    parts = (chunk(b"IHDR", header), chunk(b"IDAT", zlib.compress(rows)), chunk(b"IEND", b""))
    return SIGNATURE + b"".join(parts)


def decoded(encoded: bytes) -> Integers:
    return decode(encoded, header_of(encoded))


def unfiltered(filtered: UInt8, pixel_bytes: int) -> UInt8:
    """Undo the filters as the standard says it, byte by byte: the kernel's twin."""
    rows = np.zeros((len(filtered) + 1, filtered.shape[1] - 1 + pixel_bytes), int)
    for y, (of_type, *values) in enumerate(filtered.astype(int), 1):
        for x, value in enumerate(values, pixel_bytes):
            a, b, c = rows[y, x - pixel_bytes], rows[y - 1, x], rows[y - 1, x - pixel_bytes]
            nearest = min((a, b, c), key=lambda neighbour: abs(a + b - c - neighbour))
            rows[y, x] = (value + (0, a, b, (a + b) // 2, nearest)[of_type]) % 256
    return rows[1:, pixel_bytes:].astype(np.uint8)


@pytest.mark.parametrize("pixel_bytes", [1, 2])
def test_rows_are_unfiltered_as_the_standard_says(pixel_bytes: int) -> None:
    rng = np.random.default_rng(3)
    filtered = rng.integers(0, 256, (40, 1 + 12 * pixel_bytes), dtype=np.uint8)
    filtered[:, 0] = rng.permutation(np.repeat(FILTERS, 8))
    rows = np.zeros((41, 12 * pixel_bytes), np.uint8)
    assert unfilter(filtered, pixel_bytes, rows)
    np.testing.assert_array_equal(rows[1:], unfiltered(filtered, pixel_bytes))
    filtered[20, 0] = 5
    assert not unfilter(filtered, pixel_bytes, rows)


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_what_other_programs_write_is_read(dtype: type[np.integer]) -> None:
    # Pillow chooses each row's filter by the row.
    smooth = np.add.outer(np.arange(60) ** 2, 5 * np.arange(80)) + np.random.default_rng(5).integers(
        0, 9, (60, 80)
    )
    image = smooth.astype(dtype)
    file = io.BytesIO()
    Image.fromarray(image).save(file, "PNG")
    for encoded in (file.getvalue(), encode(image), encode(np.asfortranarray(image))):
        read = decoded(encoded)
        assert (read.dtype, read.flags.c_contiguous) == (dtype, True)
        np.testing.assert_array_equal(read, image)


def test_a_colour_picture_is_read_as_opencv_reads_it() -> None:
    image = np.random.default_rng(6).integers(0, 256, (5, 7, 3)).astype(np.uint8)
    done, encoded = cv2.imencode(".png", image)
    assert done
    np.testing.assert_array_equal(decoded(encoded.tobytes()), image)


ROWS = bytes(5 * 8)


@pytest.mark.parametrize(
    ("encoded", "problem"),
    [
        (png(ROWS[:-1]), "cannot be decoded: 39 bytes of pixels where 40 are needed"),
        (png(ROWS[:8] + b"\5" + ROWS[9:]), "cannot be decoded: a row's filter is of no known type"),
        (SIGNATURE + chunk(b"IEND", b""), "is no PNG: its header is wrong"),
        (png(ROWS, height=0), "is no PNG: its header is wrong"),
        (png(ROWS, width=0), "is no PNG: its header is wrong"),
        (png(ROWS, colour=5), "is no PNG: its header is wrong"),
        (png(ROWS, bits=12), "has 12 bits a pixel: grey levels of 8 or 16 are needed"),
        (png(ROWS, bits=4), "has 4 bits a pixel: grey levels of 8 or 16 are needed"),
    ],
)
def test_what_is_wrong_behind_right_checksums_is_said(encoded: bytes, problem: str) -> None:
    with pytest.raises(ValueError, match=f"^{problem}$"):
        decoded(encoded)


def test_a_broken_stream_behind_right_checksums_is_told() -> None:
    whole = zlib.compress(np.random.default_rng(7).integers(0, 4, 40).astype(np.uint8).tobytes())
    header = chunk(b"IHDR", struct.pack(">IIBB", 7, 5, 8, 0) + b"\0\0\0")
    for broken in (b"", b"\0" + whole[1:], whole[:2] + b"\xff" * (len(whole) - 2)):
        encoded = SIGNATURE + header + chunk(b"IDAT", broken) + chunk(b"IEND", b"")
        with pytest.raises(ValueError, match=r"^cannot be decoded: "):
            decoded(encoded)


def test_no_more_is_inflated_than_the_header_says() -> None:
    assert decoded(png(ROWS + bytes(10_000_000))).shape == (5, 7)
