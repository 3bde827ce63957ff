"""Tags that change what a pixel means, in files of other writers: applied, refused by name, or told."""

from __future__ import annotations

import io
import struct
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from arctrack.errors import ArctrackError
from arctrack.recording.importing.image_decoder import EncodedImage
from noise_model.compiled.arrays import Integers

RNG = np.random.default_rng(7)
GREY8, GREY16 = RNG.integers(0, 256, (9, 14), np.uint8), RNG.integers(0, 65536, (9, 14), np.uint16)
COLOUR8, COLOUR16 = RNG.integers(0, 256, (9, 14, 3), np.uint8), RNG.integers(0, 65536, (9, 14, 3), np.uint16)
ALPHA8 = RNG.integers(0, 256, (9, 14, 4), np.uint8)
OPAQUE8 = np.dstack([COLOUR8, np.full((9, 14), 255, np.uint8)])
REVERSED = np.array([int(f"{byte:08b}"[::-1], 2) for byte in range(256)], np.uint8)
RAMP = np.arange(256, dtype=np.uint16) * 257


def tiff(pixels: Integers, tags: dict[int, object], order: str = "<", following: int = 0) -> bytes:
    """Return a TIFF 6.0 of one strip: with the tags that pixels need, and others, shorts or texts."""
    samples = pixels.shape[2] if pixels.ndim == 3 else 1
    raw = pixels.astype(pixels.dtype.newbyteorder(order)).tobytes()
    height, width = pixels.shape[:2]
    entries: dict[int, object] = {256: width, 257: height, 258: [8 * pixels.itemsize] * samples, 259: 1}
    entries |= {262: 1, 273: 8, 277: samples, 278: height, 279: len(raw)} | tags
    directory = 8 + len(raw) + len(raw) % 2
    behind = directory + 6 + 12 * len(entries)
    table, spare = struct.pack(order + "H", len(entries)), b""
    for number, value in sorted(entries.items()):
        kind, content = 3, b""
        if isinstance(value, str):
            kind, content = 2, value.encode() + b"\0"
            count = len(content)
        else:
            values = value if isinstance(value, list) else [value]
            count, content = len(values), struct.pack(f"{order}{len(values)}H", *values)
        if len(content) > 4:
            offset = behind + len(spare)
            spare += content + b"\0" * (len(content) % 2)
            content = struct.pack(order + "I", offset)
        table += struct.pack(order + "HHI", number, kind, count) + content.ljust(4, b"\0")
    head = (b"II*\0" if order == "<" else b"MM\0*") + struct.pack(order + "I", directory)
    raw += b"\0" * (len(raw) % 2)
    return head + raw + table + struct.pack(order + "I", following) + spare


def png(pixels: Integers, *chunks: tuple[bytes, bytes]) -> bytes:
    content = cv2.imencode(".png", pixels)[1].tobytes()
    extra = b"".join(
        struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))
        for name, data in chunks
    )
    return content[:33] + extra + content[33:]


def by_pillow(image: Image.Image, kind: str, **options: object) -> bytes:
    file = io.BytesIO()
    image.save(file, kind, **options)
    return file.getvalue()


def with_palette(levels: Integers, palette: Integers) -> Image.Image:
    image = Image.fromarray(levels).convert("P")
    image.putpalette(palette.astype(np.uint8).ravel().tolist())
    return image


def opened(content: bytes, folder: Path) -> EncodedImage:
    (folder / "image").write_bytes(content)
    return EncodedImage(folder / "image")


NEGATIVE = np.repeat(np.arange(256)[::-1, np.newaxis], 3, axis=1)
APPLIED = {
    "tiff, grey": (tiff(GREY16, {}), GREY16),
    "tiff, high byte first": (tiff(GREY16, {}, ">"), GREY16),
    "tiff, 8 bits, white is 0": (tiff(GREY8, {262: 0}), 255 - GREY8),
    "tiff, 16 bits, white is 0": (tiff(GREY16, {262: 0}), 65535 - GREY16),
    "tiff, white is 0, high byte first": (tiff(GREY16, {262: 0}, ">"), 65535 - GREY16),
    "tiff, bits from the low one": (tiff(REVERSED[GREY8], {266: 2}), GREY8),
    "tiff, 16 bits from the low one": (
        tiff(REVERSED[GREY16.view(np.uint8)].view(np.uint16), {266: 2}),
        GREY16,
    ),
    "tiff, a display range": (tiff(GREY16, {280: 100, 281: 2000}), GREY16),
    "tiff, ImageJ's display range": (tiff(GREY16, {270: "ImageJ=1.54f\nmin=100.0\nmax=2000.0\n"}), GREY16),
    "tiff, a table of greys": (tiff(GREY8, {262: 3, 320: [*RAMP[::-1].tolist()] * 3}), 255 - GREY8),
    "tiff, RGB": (tiff(COLOUR8, {262: 2}), COLOUR8[..., ::-1]),
    "tiff, RGB of 16 bits": (tiff(COLOUR16, {262: 2}, ">"), COLOUR16[..., ::-1]),
    "tiff, opaque": (tiff(OPAQUE8, {262: 2, 338: 2}), OPAQUE8[..., [2, 1, 0, 3]]),
    "tiff, differences": (by_pillow(Image.fromarray(GREY8), "TIFF", compression="tiff_lzw"), GREY8),
    "png, a transparent level": (png(GREY16, (b"tRNS", b"\x10\x20")), GREY16),
    "png, 12 of 16 bits": (png(GREY16 & 0xFFF0, (b"sBIT", b"\x0c")), GREY16 & 0xFFF0),
    "png, grey and alpha": (by_pillow(Image.fromarray(ALPHA8[..., :2], "LA"), "PNG"), ALPHA8[..., 0]),
    "bmp, a negative table": (by_pillow(with_palette(GREY8, NEGATIVE), "BMP"), 255 - GREY8),
}


@pytest.mark.filterwarnings("ignore:'mode' parameter is deprecated:DeprecationWarning")
@pytest.mark.parametrize(("content", "levels"), APPLIED.values(), ids=APPLIED)
def test_levels_are_those_that_the_tags_say(content: bytes, levels: Integers, tmp_path: Path) -> None:
    pixels = opened(content, tmp_path).pixels()
    if pixels.ndim == 3 and levels.ndim == 2:
        levels = np.repeat(levels[..., np.newaxis], 3, axis=2)
    np.testing.assert_array_equal(pixels, levels)
    assert pixels.dtype == levels.dtype


COLOURS = [*RAMP.tolist(), *RAMP[::-1].tolist(), *RAMP.tolist()]
PLANES = np.moveaxis(COLOUR16, -1, 0)
REFUSED = {
    "a sign": (tiff(GREY16, {339: 2}), "its tag SampleFormat = 2: levels with a sign, or floats"),
    "a sign of 8 bits": (tiff(GREY8, {339: 2}), "its tag SampleFormat = 2"),
    "half floats": (tiff(GREY16, {339: 3}), "its tag SampleFormat = 3"),
    "12 bits": (tiff(GREY16, {258: 12}), "its tag BitsPerSample = 12: save it with 8 or 16"),
    "unlike bits": (tiff(COLOUR8, {262: 2, 258: [8, 8, 16]}), "its tag BitsPerSample = (8, 8, 16)"),
    "a mosaic": (tiff(GREY16, {262: 32803}), "its tag PhotometricInterpretation = 32803: save it as grey"),
    "print colours": (tiff(ALPHA8, {262: 5}), "its tag PhotometricInterpretation = 5"),
    "luminance and colour": (tiff(COLOUR8, {262: 6}), "its tag PhotometricInterpretation = 6"),
    "turned": (tiff(GREY16, {274: 3}), "its tag Orientation = 3: it is turned"),
    "mirrored": (tiff(GREY8, {274: 2}), "its tag Orientation = 2: it is turned"),
    "transparent": (tiff(ALPHA8, {262: 2, 338: 2}), "its tag ExtraSamples has parts transparent"),
    "multiplied by alpha": (tiff(ALPHA8, {262: 2, 338: 1}), "its tag ExtraSamples has parts transparent"),
    "grey of three samples": (tiff(COLOUR8, {338: [0, 0]}), "its tag SamplesPerPixel = 3 in grey"),
    "planes of 16 bits": (
        tiff(PLANES, {256: 14, 257: 9, 258: [16] * 3, 262: 2, 277: 3, 284: 2}),
        "its tag PlanarConfiguration = 2: save colours of 16 bits pixel by pixel",
    ),
    "a table of colours": (tiff(GREY8, {262: 3, 320: COLOURS}), "its tag ColorMap shows levels as colours"),
    "a preview": (tiff(GREY16, {254: 1}), "its tag NewSubfileType = 1: it is a preview"),
    "a volume": (tiff(GREY16, {32997: 2}), "its tag ImageDepth = 2: it is a stack"),
    "ImageJ's stack": (tiff(GREY16, {270: "ImageJ=1.54f\nimages=3\n"}), "holds 3 images"),
    "a second page": (tiff(GREY16, {}, following=8), "holds several images"),
    "ImageJ's sign": (
        tiff(GREY16, {270: "ImageJ=1.54f\nc0=-32768.0\nc1=1.0\n"}),
        "its tag ImageDescription calibrates levels, c0 = -32768.0, c1 = 1.0",
    ),
    "an animation": (
        by_pillow(Image.fromarray(GREY8), "PNG", save_all=True, append_images=[Image.fromarray(255 - GREY8)]),
        "holds 2 images",
    ),
    "an inverted print": (
        by_pillow(Image.fromarray(ALPHA8, "CMYK"), "JPEG"),
        "holds pixels of kind CMYK: grey or RGB of 8 or 16 bits are needed",
    ),
    "5 bits a colour": (
        b"BM"
        + struct.pack("<IHHIIiiHHIIiiII", 54 + 32, 0, 0, 54, 40, 4, 4, 1, 16, 0, 32, 0, 0, 0, 0)
        + bytes(32),
        "has 16 bits for three colours",
    ),
}


@pytest.mark.filterwarnings("ignore:'mode' parameter is deprecated:DeprecationWarning")
@pytest.mark.parametrize(("content", "line"), REFUSED.values(), ids=REFUSED)
def test_a_tag_that_is_not_applied_is_refused(content: bytes, line: str, tmp_path: Path) -> None:
    with pytest.raises(ArctrackError) as refused:
        opened(content, tmp_path).pixels()
    assert f"image: {line}" in str(refused.value)


def turned_jpeg() -> bytes:
    exif = Image.Exif()
    exif[274] = 6
    return by_pillow(Image.fromarray(GREY8), "JPEG", exif=exif)


TOLD = {
    "gamma": (png(GREY8, (b"gAMA", (45455).to_bytes(4, "big"))), ["its tag gAMA says"]),
    "light": (png(GREY8, (b"gAMA", (100000).to_bytes(4, "big"))), []),
    "a screen's colours": (png(GREY16, (b"sRGB", b"\0")), ["its tag sRGB says"]),
    "a transfer function": (tiff(GREY16, {301: [*range(256)]}), ["its tag TransferFunction says"]),
    "jpeg in a tiff": (
        by_pillow(Image.fromarray(GREY8), "TIFF", compression="jpeg"),
        ["JPEG has changed the noise"],
    ),
    "a turned jpeg": (turned_jpeg(), ["JPEG has changed", "its tag Orientation = 6 asks to turn"]),
    "nothing": (tiff(GREY16, {}), []),
}


@pytest.mark.parametrize(("content", "lines"), TOLD.values(), ids=TOLD)
def test_what_leaves_the_levels_as_they_are_is_told(content: bytes, lines: list[str], tmp_path: Path) -> None:
    doubts = opened(content, tmp_path).doubts
    assert len(doubts) == len(lines)
    assert all(doubt.startswith(line) for doubt, line in zip(doubts, lines, strict=True))
