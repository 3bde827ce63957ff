"""The images of a frame's explanation: the frame with what is drawn over it, the arc map, the residual."""

import io
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from PIL import Image
from PIL.ImageColor import getrgb

from arctrack.replay.explain import Explanation, StripeLook
from arctrack.report import style
from arctrack.report.data_uri import uri
from arctrack.report.embedded import CHANGE, Scale, binned, coloured, scale
from arctrack.report.image import seam_point_px, visible
from noise_model.compiled.arrays import Bool, Float64
from noise_model.instrument.sensor import Sensor, respond
from tracker.geometry import SensorGeometry

FRAME_PX, MAP_PX = 640, 320
"""Pictures are shrunk to about these widths; the residual's pixels are means, which show what noise hides."""

SATURATED = 255
"""The grey that stands for saturated pixels, which are drawn in a colour of their own."""

RESIDUAL_SIGMAS = 5.0
"""End of the residual's colour scale, sigmas."""

EXAGGERATIONS = (1, 2, 5, 10, 20, 50, 100, 200)
BAND_SHARE, SIGMA_QUANTILE = 1.0 / 24.0, 0.9
"""The stripe's sigma is enlarged so far that most scan lines' take no more than this share of the height."""


MARK_SHARE = 0.02
"""Half the size of a scan line's mark, over the image's height."""

MARK_PLACES = (-3.0, 3.0, -6.0, 6.0)
"""Places of a mark relative to the stripe, in half sizes: the first free one is used."""


@dataclass(frozen=True)
class Overlay:
    """Overlay of the frame, as SVG paths in its pixels; "" where there is none.

    `limits` are the band's, `sigma` the position ± `exaggeration` sigmas, `seam` the seam's point (x, y).
    """

    expected: str = ""
    limits: str = ""
    fitted: str = ""
    sigma: str = ""
    exaggeration: int = 1
    seam: tuple[float, float] | None = None


@dataclass(frozen=True)
class ArcPictures:
    """The predicted arc light, on the frame's scale, and the whitened residual with its colours."""

    predicted: str
    residual: str
    scale: Scale
    bin_px: int


def frame_picture(explanation: Explanation) -> str:
    """Return the frame in grey, by the square root, its saturated pixels in vermillion."""
    image, geometry = explanation.frame.image_dn, explanation.geometry
    return _grey(image, image >= geometry.saturation_dn, geometry.setup.sensor)


def arc_pictures(explanation: Explanation) -> ArcPictures | None:
    """Return the arc's pictures, None where no arc light could be predicted."""
    if explanation.look is None or explanation.look.arc is None:
        return None
    sensor, arc = explanation.geometry.setup.sensor, explanation.look.arc
    mean_dn = np.clip(respond(np.nan_to_num(arc.mean_e), sensor), 0.0, sensor.max_dn)
    bin_px = max(1, math.ceil(arc.whitened.shape[1] / MAP_PX))
    limit = RESIDUAL_SIGMAS
    return ArcPictures(
        _grey(mean_dn.astype(np.float32), np.zeros(mean_dn.shape, bool), sensor),
        coloured(binned(arc.whitened, bin_px), CHANGE, -limit, limit),
        scale(CHANGE, -limit, limit),
        bin_px,
    )


def overlay(explanation: Explanation) -> Overlay:
    """Return what is drawn over the frame."""
    camera, look = explanation.geometry.setup.camera, explanation.look
    # Where a seam was found is shown of a frame that is refused, too.
    point = seam_point_px(replace(explanation.track, flags=0), camera)
    seam = None if point is None else (float(point[0]), float(point[1]))
    if look is None or look.expected is None:
        return Overlay(seam=seam)
    expected = look.expected.shown_px
    rims = (expected - look.reach_px, expected + look.reach_px)
    drawn = Overlay(
        expected=path(explanation.geometry, expected),
        limits=" ".join(path(explanation.geometry, rim) for rim in rims),
        seam=seam,
    )
    return drawn if look.stripe is None else _with_stripe(drawn, explanation, look.stripe)


def marks(explanation: Explanation, scans: Sequence[int]) -> list[tuple[float, float]]:
    """Return where in the image (x, y), px, scan lines are marked, apart from each other."""
    look, camera = explanation.look, explanation.geometry.setup.camera
    if look is None or look.expected is None or look.stripe is None:
        return []
    fitted, size = look.stripe.reading.stripe.position_px, MARK_SHARE * camera.height
    stripe = np.where(np.isfinite(fitted), fitted, look.expected.position_px)
    most = np.array([camera.width, camera.height]) - size
    placed: list[Float64] = []
    for s in scans:
        tried = [
            np.clip(
                explanation.geometry.image_points(np.array([s]), stripe[[s]] + away * size)[0], size, most
            )
            for away in MARK_PLACES
        ]
        free = [point for point in tried if all(math.dist(point, other) > 2.5 * size for other in placed)]
        placed.append((free or tried)[0])
    return [(float(x), float(y)) for x, y in placed]


def path(geometry: SensorGeometry, position_px: Float64) -> str:
    """Return positions per scan line (n_scan,) as an SVG path in image pixels, broken where they are NaN.

    Nothing is drawn out of the image.
    """
    position = np.where((position_px >= 0.0) & (position_px < geometry.n_pos), position_px, np.nan)
    parts, is_down = [], False
    lines = np.arange(geometry.n_scan, dtype=np.float64)
    points = geometry.image_points(lines, position) + 0.5
    for x, y in points:
        if not math.isfinite(x + y):
            is_down = False
            continue
        parts.append(f"{'L' if is_down else 'M'}{x:.1f} {y:.1f}")
        is_down = True
    return "".join(parts)


def _with_stripe(drawn: Overlay, explanation: Explanation, look: StripeLook) -> Overlay:
    stripe = look.reading.stripe
    if not np.isfinite(stripe.position_px).any():
        return drawn
    room = (
        BAND_SHARE
        * explanation.geometry.setup.camera.height
        / float(np.nanquantile(stripe.sigma_px, SIGMA_QUANTILE))
    )
    times = max((k for k in EXAGGERATIONS if k <= room), default=1)
    rims = (stripe.position_px - times * stripe.sigma_px, stripe.position_px + times * stripe.sigma_px)
    return Overlay(
        drawn.expected,
        drawn.limits,
        path(explanation.geometry, stripe.position_px),
        " ".join(path(explanation.geometry, rim) for rim in rims),
        times,
        drawn.seam,
    )


def _grey(image_dn: npt.NDArray[np.generic], saturated: Bool, sensor: Sensor) -> str:
    """Return an image in grey by the square root, saturated pixels in vermillion."""
    bin_px = max(1, math.ceil(image_dn.shape[1] / FRAME_PX))
    shown = binned(image_dn.astype(np.float32), bin_px)
    grey = np.minimum(visible(shown, sensor), SATURATED - 1)
    grey[binned(saturated.astype(np.float32), bin_px) > 0.0] = SATURATED
    picture = Image.fromarray(grey).convert("L")
    palette = np.repeat(np.arange(256, dtype=np.uint8), 3)
    palette[-3:] = getrgb(style.VERMILLION)
    picture.putpalette(palette.tobytes())
    drawn = io.BytesIO()
    picture.save(drawn, format="png", optimize=True)
    return uri("image/png", drawn.getvalue())
