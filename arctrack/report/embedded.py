"""Pictures that lie within a page, as data URIs: values in colours and their scale, drawings."""

import io
from dataclasses import dataclass

import matplotlib as mpl
import numpy as np
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from PIL import Image

from arctrack.report.image import uri
from noise_model.compiled.arrays import Float32, UInt8

CHANGE, EXCESS, SCALE_PX = "RdBu_r", "viridis", 256


@dataclass(frozen=True)
class Scale:
    """Colour scale: its picture, and the values at its ends."""

    uri: str
    low: float
    high: float


def binned(image: Float32, bin_px: int) -> Float32:
    """Return means (h, w) over bins of an image (H, W), NaN where less than half of a bin is known."""
    h, w = image.shape[0] // bin_px, image.shape[1] // bin_px
    cut = image[: h * bin_px, : w * bin_px].reshape(h, bin_px, w, bin_px)
    known = np.isfinite(cut)
    count = known.sum(axis=(1, 3))
    mean = np.where(known, cut, 0.0).sum(axis=(1, 3)) / np.maximum(count, 1)
    return np.where(count >= 0.5 * bin_px**2, mean, np.nan).astype(np.float32)


def coloured(values: Float32, name: str, low: float, high: float) -> str:
    """Return values (H, W) in a colour map's colours, what is NaN in grey."""
    colours = mpl.colormaps[name].with_extremes(bad=(0.72, 0.72, 0.72))
    picture = colours(Normalize(low, high)(np.ma.masked_invalid(values)), bytes=True)
    return png(np.asarray(picture)[..., :3])


def scale(name: str, low: float, high: float) -> Scale:
    """Return a colour map's scale."""
    steps = np.linspace(0.0, 1.0, SCALE_PX)[np.newaxis]
    return Scale(png(np.asarray(mpl.colormaps[name](steps, bytes=True))[..., :3]), low, high)


def png(picture: UInt8) -> str:
    """Return a picture (H, W) or (H, W, 3)."""
    drawn = io.BytesIO()
    Image.fromarray(np.ascontiguousarray(picture)).save(drawn, format="png", optimize=True)
    return uri("image/png", drawn.getvalue())


def svg(figure: Figure) -> str:
    """Return a drawing; the same figure gives the same text: no date, no random names.

    Its letters stay letters: as shapes they would be half of it.
    """
    drawn = io.BytesIO()
    with mpl.rc_context({"svg.hashsalt": "arctrack", "svg.fonttype": "none"}):
        # Resolution of the parts of a drawing that are kept as pixels, where lines would be too many.
        figure.savefig(drawn, format="svg", dpi=200, metadata={"Date": None})
    return uri("image/svg+xml", drawn.getvalue())
