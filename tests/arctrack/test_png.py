"""PNGs of frames, decoded as other readers decode them; damage that checksums do not show is told too."""

import io
import struct
import zlib

import cv2
import numpy as np
import pytest
from PIL import Image

from arctrack.recording.png import SIGNATURE, decode, encode, header_of
from noise_model.compiled.arrays import Integers


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


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
@pytest.mark.parametrize("row_filter", [*range(5), None])
def test_rows_of_all_filters_are_read(dtype: type[np.integer], row_filter: int | None) -> None:
    image = np.random.default_rng(3).integers(0, np.iinfo(dtype).max + 1, (40, 33)).astype(dtype)
    chosen = cv2.IMWRITE_PNG_ALL_FILTERS if row_filter is None else 8 << row_filter
    done, encoded = cv2.imencode(".png", image, [cv2.IMWRITE_PNG_FILTER, chosen])
    assert done
    np.testing.assert_array_equal(decoded(encoded.tobytes()), image)


@pytest.mark.parametrize("shape", [(20, 30), (20, 30, 3)])
@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_a_cut_or_changed_file_is_told(dtype: type[np.integer], shape: tuple[int, ...]) -> None:
    whole = encode(np.random.default_rng(4).integers(0, 200, shape).astype(dtype))
    for length in range(1, len(whole)):
        with pytest.raises(ValueError, match=r"^is (truncated|no PNG)"):
            decoded(whole[:length])
    for place in range(len(SIGNATURE), len(whole) - 12):
        with pytest.raises(ValueError, match=r"^is (damaged|truncated)"):
            decoded(whole[:place] + bytes([whole[place] ^ 1]) + whole[place + 1 :])


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
