"""The colours of images, by name."""

from enum import StrEnum


class Channel(StrEnum):
    """Channel of a colour that becomes the grey level."""

    RED = "red"
    GREEN = "green"
    BLUE = "blue"
    LUMINANCE = "luminance"


class Bayer(StrEnum):
    """The colours of a mosaic's first two rows, from the left."""

    RGGB = "RGGB"
    GRBG = "GRBG"
    GBRG = "GBRG"
    BGGR = "BGGR"
