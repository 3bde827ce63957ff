"""Decoder of one image file to raw pixels: its header first, so that nothing too large is decoded.

Pillow reads the header, OpenCV decodes, since it alone keeps 16 bits in colour. What a header states of the
pixels is applied, refused, or reported. A file is decoded completely or not at all.
"""

import calendar
import io
import math
import time
import warnings
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
from PIL import ExifTags, Image, UnidentifiedImageError

from arctrack.errors import in_file
from arctrack.limits import LIMITS, size_problem
from arctrack.recording import png
from arctrack.recording.files import UnfitFileError, read_bytes
from arctrack.recording.importing import tiff_tags
from noise_model.compiled.arrays import Integers

FORMATS = ("BMP", "JPEG", "PNG")
LOSSY_FORMATS = ("JPEG", "MPO")
"""Pillow's names; MPO is a JPEG with further pictures behind it."""

COLOUR_MODES = ("P", "RGB", "RGBA")
MODES = ("L", "LA", "I", "I;16", *COLOUR_MODES)
"""Pillow's names of pixels that are read: a palette, colours, grey; 8 or 16 bits."""

LOSSY = "JPEG has changed the noise that sigmas are read from; have the camera write PNG, BMP or TIFF"
ENCODED = (
    "says that levels are not proportional to light; they are taken as stored: switch the camera's gamma off,"
    " or save without the tag"
)
TURNED = "asks to turn the image; it is taken as the sensor stored it"
"""Warnings of images that are read all the same."""

MAX_BYTES = LIMITS.png_bytes_per_px * LIMITS.image_px + LIMITS.spare_bytes

_ORIENTATION_TAG, _UPRIGHT = 274, 1
_TAKEN_TAGS = {36867: 37521, 306: 37520}
"""EXIF's DateTimeOriginal and DateTime, each with the tag of its part of a second."""

_LINEAR_GAMMA = 1.0


@dataclass(frozen=True)
class ImageHeader:
    """An image's properties by its header: `size` is (width, height), `doubts` are warnings, a line each.

    `taken_s` is the capture time by its tags, in s since 1970 on the camera's clock; NaN without a tag.
    """

    size: tuple[int, int]
    has_colours: bool
    is_lossy: bool
    doubts: tuple[str, ...]
    taken_s: float
    is_inverted: bool = False
    is_tiff: bool = False


class EncodedImage:
    """Image file whose header was read.

    Raises ArctrackError for a file that is missing, too large, damaged, or no image that can be read.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        try:
            self._content = read_bytes(path, MAX_BYTES)
            self._header = _header(self._content)
        except FileNotFoundError:
            raise in_file(path, "there is no such file") from None
        except OSError as error:
            raise in_file(path, f"cannot be read: {error.strerror or error}") from None
        except ValueError as error:
            raise in_file(path, str(error)) from None

    @property
    def size(self) -> tuple[int, int]:
        """Width and height, px."""
        return self._header.size

    @property
    def has_colours(self) -> bool:
        """Return True if pixels have colours, by themselves or by a palette."""
        return self._header.has_colours

    @property
    def is_lossy(self) -> bool:
        """Return True if the codec has changed the noise."""
        return self._header.is_lossy

    @property
    def doubts(self) -> tuple[str, ...]:
        """Warnings about the image, a line each."""
        return self._header.doubts

    @property
    def taken_s(self) -> float:
        """Capture time by its tags, s since 1970 on the camera's clock; NaN without them."""
        return self._header.taken_s

    def pixels(self) -> Integers:
        """Return the levels, black 0, (H, W) grey or (H, W, 3 or 4) blue first; ArctrackError if damaged."""
        # OpenCV prints more about a damaged image than the line that names it.
        verbosity = cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
        try:
            if self.is_lossy and not self._header.is_tiff:
                # OpenCV before 4.11 fills up a cut JPEG and says nothing.
                with Image.open(io.BytesIO(self._content), formats=FORMATS) as image:
                    image.load()
            # As stored: no turning by EXIF, no change of depth.
            pixels = cv2.imdecode(np.frombuffer(self._content, dtype=np.uint8), cv2.IMREAD_UNCHANGED)
        except (OSError, cv2.error):
            pixels = None
        finally:
            cv2.utils.logging.setLogLevel(verbosity)
        if pixels is None:
            raise in_file(self.path, "is truncated or damaged; copy it anew, or leave it out")
        if pixels.dtype not in (np.uint8, np.uint16):
            raise in_file(self.path, f"holds {pixels.dtype}: 8 or 16 bits without a sign are needed")
        if (
            self._header.is_tiff
            and pixels.ndim == 3
            and pixels.shape[2] == 4
            and not _is_opaque(pixels[..., 3])
        ):
            raise in_file(self.path, "its tag ExtraSamples has parts transparent: save it without alpha")
        if not self.has_colours and pixels.ndim == 3:
            # Grey and alpha come as colours.
            pixels = pixels[..., 0]
        # What libtiff decodes to 8 bits it has inverted already.
        is_inverted = self._header.is_inverted and pixels.dtype == np.uint16
        return np.asarray(np.iinfo(np.uint16).max - pixels if is_inverted else pixels)


def _is_opaque(alpha: npt.NDArray[Any]) -> bool:
    """Return True if alpha is full: where it is not, libtiff multiplies colours by it."""
    return bool((alpha == np.iinfo(alpha.dtype).max).all())


def _header(content: bytes) -> ImageHeader:
    """Return an image's header; ValueError names its problem."""
    if not content:
        raise UnfitFileError("is empty")
    if content.startswith(tiff_tags.SIGNATURES):
        return _tiff_header(content)
    try:
        with warnings.catch_warnings():
            # What is odd in a header either matters to the decoder, which then fails, or to nobody.
            warnings.simplefilter("ignore")
            warnings.simplefilter("error", Image.DecompressionBombWarning)
            image = Image.open(io.BytesIO(content), formats=FORMATS)
    except UnidentifiedImageError:
        raise UnfitFileError("is no JPEG, PNG, BMP or TIFF, or its header is damaged") from None
    except (Image.DecompressionBombWarning, Image.DecompressionBombError):
        raise UnfitFileError(_too_large()) from None
    with image:
        problem = size_problem(*image.size) or _misfit(image, content)
        if problem is None and image.format == "PNG":
            # Its checksums too: OpenCV may hand out what it could decode.
            png.header_of(content)
        if problem is not None:
            raise UnfitFileError(problem)
        is_lossy = image.format in LOSSY_FORMATS
        exif = image.getexif()
        return ImageHeader(
            image.size,
            image.mode in COLOUR_MODES,
            is_lossy,
            tuple(_doubts(image, is_lossy)),
            _taken_s({**exif, **exif.get_ifd(ExifTags.IFD.Exif)}),
        )


def _tiff_header(content: bytes) -> ImageHeader:
    tiff = tiff_tags.read_tiff_header(content)
    problem = size_problem(*tiff.size)
    if problem is None and tiff.size[0] * tiff.size[1] > LIMITS.image_px:
        problem = _too_large()
    if problem is not None:
        raise UnfitFileError(problem)
    return ImageHeader(
        tiff.size,
        tiff.photometric in (tiff_tags.RGB, tiff_tags.PALETTE),
        tiff.is_lossy,
        (*([LOSSY] if tiff.is_lossy else []), *(f"its tag {name} {ENCODED}" for name in tiff.encodings)),
        _taken_s(tiff.tags),
        tiff.photometric == tiff_tags.WHITE_IS_ZERO,
        is_tiff=True,
    )


def _taken_s(tags: Mapping[int, Any]) -> float:
    """Return when an image was taken, s since 1970 by the camera's clock; NaN if no tag says it."""
    for number, part in _TAKEN_TAGS.items():
        try:
            taken = time.strptime(str(tags[number]).strip("\0 "), "%Y:%m:%d %H:%M:%S")
            return calendar.timegm(taken) + float(f"0.{str(tags.get(part, '0')).strip()}")
        except (KeyError, ValueError):
            continue
    return math.nan


def _too_large() -> str:
    return f"is too large: {LIMITS.image_px / 1e6:.1f} million px are the most"


def _misfit(image: Image.Image, content: bytes) -> str | None:
    """Return the problem of an image's kind, None if it can be read."""
    if image.mode not in MODES:
        return f"holds pixels of kind {image.mode}: grey or RGB of 8 or 16 bits are needed"
    # A BMP states the bits of a pixel there.
    if image.format == "BMP" and int.from_bytes(content[28:30], "little") == 16:
        return "has 16 bits for three colours: save it with 8 bits each, or as grey"
    pages = getattr(image, "n_frames", 1)
    if pages > 1 and image.format not in LOSSY_FORMATS:
        return f"holds {pages} images: save each as a file of its own"
    return None


def _doubts(image: Image.Image, is_lossy: bool) -> Iterator[str]:
    """Yield warnings about an image, a line each."""
    if is_lossy:
        yield LOSSY
    info: dict[Any, Any] = image.info
    if image.format == "PNG":
        is_linear = info.get("gamma", _LINEAR_GAMMA) == _LINEAR_GAMMA
        tags = {"gAMA": not is_linear, "sRGB": "srgb" in info, "iCCP": "icc_profile" in info}
        yield from (f"its tag {tag} {ENCODED}" for tag, is_there in tags.items() if is_there)
    orientation = image.getexif().get(_ORIENTATION_TAG, _UPRIGHT)
    if orientation != _UPRIGHT:
        yield f"its tag Orientation = {orientation} {TURNED}"
