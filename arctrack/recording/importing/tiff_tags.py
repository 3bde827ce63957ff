"""The tags of a TIFF that change what a pixel means: applied when it is decoded, or refused by name.

Tags and their values are those of TIFF 6.0; ImageDepth is SGI's, ImageDescription holds what ImageJ states.
"""

import io
import re
import struct
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from PIL import TiffImagePlugin

from arctrack.recording.files import UnfitFileError

SIGNATURES = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")
"""The first bytes of a TIFF and a BigTIFF, the lower byte first or last."""

WHITE_IS_ZERO, BLACK_IS_ZERO, RGB, PALETTE = 0, 1, 2, 3
"""Values of PhotometricInterpretation that are read."""

ENCODINGS = {"GrayResponseCurve": 291, "TransferFunction": 301, "ICCProfile": 34675}
"""Tags that say that levels are not proportional to light."""


@dataclass(frozen=True)
class Tag:
    """A tag of which some values alone are read: its number, the value that it has unless it is there."""

    name: str
    number: int
    default: int
    is_read: Callable[[int], bool]
    cure: str


TAGS = (
    Tag("NewSubfileType", 254, 0, lambda value: not value & 5, "it is a preview or a mask: save the image"),
    Tag("BitsPerSample", 258, 1, lambda value: value in (8, 16), "save it with 8 or 16"),
    Tag(
        "PhotometricInterpretation",
        262,
        BLACK_IS_ZERO,
        lambda value: value <= PALETTE,
        "save it as grey or RGB",
    ),
    Tag("Orientation", 274, 1, lambda value: value == 1, "it is turned: save it as the sensor gave it"),
    Tag(
        "SampleFormat",
        339,
        1,
        lambda value: value in (1, 4),
        "levels with a sign, or floats: save them as integers from 0 on, 8 or 16 bits",
    ),
    Tag("ImageDepth", 32997, 1, lambda value: value == 1, "it is a stack: save each image as a file"),
)


@dataclass(frozen=True)
class TiffHeader:
    """A TIFF's properties of its pixels; `bits` are those of a sample."""

    size: tuple[int, int]
    bits: int
    samples: int
    photometric: int
    is_lossy: bool
    tags: TiffImagePlugin.ImageFileDirectory_v2

    @property
    def encodings(self) -> tuple[str, ...]:
        """The tags that say that levels are not proportional to light."""
        return tuple(name for name, number in ENCODINGS.items() if number in self.tags)


def read_tiff_header(content: bytes) -> TiffHeader:
    """Return the header of a TIFF's only image; UnfitFileError names a tag that is not read, and the cure."""
    tags = _first_directory(content)
    for tag in TAGS:
        values = _values(tags, tag.number, tag.default)
        for value in values:
            if not tag.is_read(value):
                raise UnfitFileError(f"its tag {tag.name} = {value}: {tag.cure}")
        if len(set(values)) > 1:
            raise UnfitFileError(f"its tag {tag.name} = {values}: save all samples alike")
    # JPEG of both kinds, JPEG 2000, LERC, DNG's JPEG, WebP and JPEG XL.
    header = TiffHeader(
        (_number(tags, 256, 0), _number(tags, 257, 0)),
        _number(tags, 258, 1),
        _number(tags, 277, 1),
        _number(tags, 262, BLACK_IS_ZERO),
        _number(tags, 259, 1) in (6, 7, 34712, 34887, 34892, 50001, 52546),
        tags,
    )
    # ImageJ writes large stacks behind one directory.
    stated = re.search(r"^images=(\d+)", str(tags.get(270, "")), re.MULTILINE)
    count = int(stated[1]) if stated else 1
    if tags.next != 0 or count > 1:
        raise UnfitFileError(
            f"holds {count if count > 1 else 'several'} images: save each as a file of its own"
        )
    is_grey = header.photometric in (WHITE_IS_ZERO, BLACK_IS_ZERO)
    if header.photometric == PALETTE:
        # A table of colours displays levels to people: it need not rise, so no colour determines a level.
        table = np.array(_values(header.tags, 320, 0))
        if header.bits != 8 or header.samples != 1 or table.size != 3 * 256:
            raise UnfitFileError("its tag ColorMap is no table for 8 bits: save the levels as grey")
        red, green, blue = table.reshape(3, 256)
        if (red != green).any() or (red != blue).any():
            raise UnfitFileError("its tag ColorMap shows levels as colours: save the levels as grey")
    elif header.samples not in ((1, 2) if is_grey and header.bits == 8 else (1,) if is_grey else (3, 4)):
        kind = "grey" if is_grey else "RGB"
        raise UnfitFileError(f"its tag SamplesPerPixel = {header.samples} in {kind}: save it as grey or RGB")
    if _number(header.tags, 284, 1) != 1 and header.samples > 1 and header.bits == 16:
        raise UnfitFileError("its tag PlanarConfiguration = 2: save colours of 16 bits pixel by pixel")
    _check_calibration(str(tags.get(270, "")))
    return header


def _first_directory(content: bytes) -> TiffImagePlugin.ImageFileDirectory_v2:
    file = io.BytesIO(content)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            # Pillow goes on without what a cut file lacks.
            warnings.filterwarnings("error", message=".*orrupt EXIF data")
            is_big = 43 in content[2:4]
            tags = TiffImagePlugin.ImageFileDirectory_v2(file.read(16 if is_big else 8))
            file.seek(tags.next)
            tags.load(file)
            # Values are parsed when they are asked for.
            dict(tags)
    except (UserWarning, SyntaxError, ValueError, TypeError, KeyError, OverflowError, OSError, struct.error):
        raise UnfitFileError(
            "is truncated, or its header is damaged; copy it anew, or leave it out"
        ) from None
    return tags


def _check_calibration(description: str) -> None:
    """Raise UnfitFileError if ImageJ says that levels are not what is stored, as of 16 bits with a sign."""
    stated = dict(re.findall(r"^(c[01])=(\S+)", description, re.MULTILINE))
    if description.startswith("ImageJ") and (float(stated.get("c0", 0)), float(stated.get("c1", 1))) != (
        0,
        1,
    ):
        raise UnfitFileError(
            f"its tag ImageDescription calibrates levels, c0 = {stated.get('c0', '0')}, "
            f"c1 = {stated.get('c1', '1')}: save the levels without a calibration"
        )


def _values(tags: TiffImagePlugin.ImageFileDirectory_v2, number: int, default: int) -> tuple[Any, ...]:
    value = tags.get(number, default)
    return value if isinstance(value, tuple) else (value,)


def _number(tags: TiffImagePlugin.ImageFileDirectory_v2, number: int, default: int) -> int:
    return int(_values(tags, number, default)[0])
