"""One image file to raw pixels: its header first, so that nothing too large is decoded, then all or nothing.

Pillow reads the header, OpenCV decodes, since it alone keeps 16 bits in colour.
"""

from __future__ import annotations

import io
import warnings
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from PIL import Image, UnidentifiedImageError

from arctrack.errors import in_file
from arctrack.limits import LIMITS, size_problem
from arctrack.recording import png
from arctrack.recording.files import UnfitFileError, read_bytes
from noise_model.arrays import Integers

FORMATS = ("BMP", "JPEG", "PNG", "TIFF")
LOSSY_FORMATS = ("JPEG", "MPO")
"""Pillow's names; MPO is a JPEG with further pictures behind it."""

COLOUR_MODES = ("P", "RGB", "RGBA")
MODES = ("L", "LA", "I", "I;16", "I;16B", *COLOUR_MODES)
"""Pillow's names of pixels that are read: a palette, colours, grey; 8 or 16 bits."""

MAX_BYTES = LIMITS.png_bytes_per_px * LIMITS.image_px + LIMITS.spare_bytes

_BITS_TAG, _ORIENTATION_TAG, _UPRIGHT = 258, 274, 1
"""TIFF 6.0, section 8: BitsPerSample, Orientation, and the first row at the top."""


class EncodedImage:
    """An image file whose header was read.

    Parameters
    ----------
    path : Path
        The file.

    Raises
    ------
    ArctrackError
        For a file that is missing, too large, damaged, or no image that can be read.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        try:
            self._content = read_bytes(path, MAX_BYTES)
            self.size, self.has_colours, self.is_lossy = _header(self._content)
        except FileNotFoundError:
            raise in_file(path, "there is no such file") from None
        except OSError as error:
            raise in_file(path, f"cannot be read: {error.strerror or error}") from None
        except ValueError as error:
            raise in_file(path, str(error)) from None

    def pixels(self) -> Integers:
        """Return the pixels as stored, (H, W) grey or (H, W, 3 or 4) blue first; ArctrackError if damaged."""
        try:
            if self.is_lossy:
                # OpenCV before 4.11 fills up a cut JPEG and says nothing.
                with Image.open(io.BytesIO(self._content), formats=FORMATS) as image:
                    image.load()
            # As stored: no turning by EXIF, no change of depth.
            pixels = cv2.imdecode(np.frombuffer(self._content, dtype=np.uint8), cv2.IMREAD_UNCHANGED)
        except (OSError, cv2.error):
            pixels = None
        if pixels is None:
            raise in_file(self.path, "is truncated or damaged; copy it anew, or leave it out")
        if pixels.dtype not in (np.uint8, np.uint16):
            raise in_file(self.path, f"holds {pixels.dtype}: 8 or 16 bits without a sign are needed")
        return np.asarray(pixels)


def _header(content: bytes) -> tuple[tuple[int, int], bool, bool]:
    """Return width and height, whether there are colours, and whether the codec is lossy.

    ValueError says what is wrong.
    """
    if not content:
        raise UnfitFileError("is empty")
    try:
        with warnings.catch_warnings():
            # What is odd in a header either matters to the decoder, which then fails, or to nobody.
            warnings.simplefilter("ignore")
            warnings.simplefilter("error", Image.DecompressionBombWarning)
            image = Image.open(io.BytesIO(content), formats=FORMATS)
    except UnidentifiedImageError:
        raise UnfitFileError("is no JPEG, PNG, BMP or TIFF, or its header is damaged") from None
    except (Image.DecompressionBombWarning, Image.DecompressionBombError):
        raise UnfitFileError(f"is too large: {LIMITS.image_px / 1e6:.1f} million px are the most") from None
    with image:
        problem = size_problem(*image.size) or _misfit(image)
        if problem is None and image.format == "PNG":
            # Its checksums too: OpenCV may hand out what it could decode.
            png.header_of(content)
        if problem is not None:
            raise UnfitFileError(problem)
        return image.size, image.mode in COLOUR_MODES, image.format in LOSSY_FORMATS


def _misfit(image: Image.Image) -> str | None:
    """Return what is wrong with an image's kind, None if it can be read."""
    if image.mode not in MODES:
        return f"holds pixels of kind {image.mode}: grey or RGB of 8 or 16 bits are needed"
    if image.format != "TIFF":
        return None
    pages = getattr(image, "n_frames", 1)
    if pages > 1:
        return f"holds {pages} images: save each as a file of its own"
    tags = getattr(image, "tag_v2", {})
    bits = tags.get(_BITS_TAG, (8,))
    depth = max(bits) if isinstance(bits, Sequence) else bits
    if depth not in (8, 16):
        return f"has {depth} bits a pixel: save it with 8 or 16"
    if tags.get(_ORIENTATION_TAG, _UPRIGHT) != _UPRIGHT:
        return f"its tag Orientation = {tags[_ORIENTATION_TAG]} has it turned: save it as the sensor gave it"
    return None
