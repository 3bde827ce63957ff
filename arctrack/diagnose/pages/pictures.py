"""The pictures of a diagnosis' page, each as a data URI: frames, differences, the map, curves."""

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from arctrack.diagnose.pages.words import percent, quantity
from arctrack.report import style
from arctrack.report.embedded import CHANGE, EXCESS, Scale, binned, coloured, png, scale, svg
from arctrack.report.image import visible
from noise_model.compiled.arrays import Float32, Integers
from noise_model.instrument.sensor import Sensor
from sim_to_real.diagnosis import Curve, HeldOutPrediction

FRAME_PX, MAP_PX = 640, 320
"""Pictures are shrunk to about these widths; a map's pixels are means, which show what noise hides."""

CURVE_LABELS = {
    "adds": "added [DN]",
    "times_arc": "arc light, recorded / predicted",
    "times_laser": "laser light, recorded / predicted",
    "times_light": "light, recorded / predicted",
}
"""Meaning of a free function of each form."""


@dataclass(frozen=True)
class FramePictures:
    """One held-out frame: recorded, predicted before and after, and residuals, on one scale in DN.

    `bin_px` is the bin width of the differences.
    """

    frame: int
    recorded: str
    before: str
    after: str
    left_before: str
    left_after: str
    scale: Scale
    bin_px: int


def telling_frame(predicted: HeldOutPrediction) -> int:
    """Return the place, among the held-out frames, of the one whose gap shrinks most, or is largest."""
    before = _mean_square(predicted.recorded, predicted.before, predicted.variance)
    after = _mean_square(predicted.recorded, predicted.after, predicted.variance_after)
    shrinks = before - after
    return int(np.argmax(shrinks if shrinks.max() > 0.0 else before))


def frame_pictures(predicted: HeldOutPrediction, place: int, sensor: Sensor) -> FramePictures:
    """Return the pictures of the held-out frame at a place of `predicted.frames`."""
    recorded = predicted.recorded[place]
    bin_px = max(1, math.ceil(recorded.shape[1] / MAP_PX))
    differences = []
    for mean, variance in (
        (predicted.before[place], predicted.variance[place]),
        (predicted.after[place], predicted.variance_after[place]),
    ):
        difference = np.where(np.isfinite(variance), recorded - mean, np.nan).astype(np.float32)
        differences.append(binned(difference, bin_px))
    limit = nice_limit(differences[0], 1.0)
    return FramePictures(
        frame=int(predicted.frames[place]),
        recorded=_grey(recorded, sensor),
        before=_grey(predicted.before[place], sensor),
        after=_grey(predicted.after[place], sensor),
        left_before=coloured(differences[0], CHANGE, -limit, limit),
        left_after=coloured(differences[1], CHANGE, -limit, limit),
        scale=scale(CHANGE, -limit, limit),
        bin_px=bin_px,
    )


def residual_map(z: Float32) -> tuple[str, Scale]:
    """Return the map of how far residuals (H, W) exceed their noise, in sigmas, and its scale."""
    shown = binned(z, max(1, math.ceil(z.shape[1] / MAP_PX)))
    limit = nice_limit(shown, 3.0)
    name, low = (CHANGE, -limit) if np.nanmin(shown, initial=0.0) < 0.0 else (EXCESS, 0.0)
    return coloured(shown, name, low, limit), scale(name, low, limit)


def curve_picture(curve: Curve) -> str:
    """Return a free function of a covariate about its mean, with its 95 % band."""
    figure = style.new_figure(5.0, 3.2, f"{quantity(curve.name)}: explains {percent(curve.r2)}")
    axes = style.plain(figure.subplots(), quantity(curve.name, curve.unit), CURVE_LABELS[curve.form])
    neutral = 0.0 if curve.form == "adds" else 1.0
    low, mean, high = (neutral + values for values in (curve.low, curve.mean, curve.high))
    axes.axhline(neutral, color=style.BLACK, linewidth=0.8)
    # A curve of so few points is drawn as points.
    if len(curve.centers) > 3:
        axes.plot(curve.centers, mean, marker="o", markersize=3, color=style.BLUE)
        axes.fill_between(curve.centers, low, high, color=style.SKY, alpha=0.45, linewidth=0)
    else:
        axes.set_xticks(curve.centers)
        axes.errorbar(curve.centers, mean, [mean - low, high - mean], fmt="o", markersize=4, color=style.BLUE)
    return svg(figure)


def nice_limit(values: Float32, least: float) -> float:
    """Return a scale's end: 1, 1.5, 2, 3, 4, 5, 6, 8 or their tenfolds, at least `least`."""
    known = np.abs(values[np.isfinite(values)])
    # The colours reach as far as this share of the pixels.
    reach = max(least, float(np.percentile(known, 99.5)) if known.size else least)
    decade = 10.0 ** math.floor(math.log10(reach))
    return next(step * decade for step in (1, 1.5, 2, 3, 4, 5, 6, 8, 10, 15) if step * decade >= reach)


def _mean_square(recorded: Integers, mean: Float32, variance: Float32) -> Float32:
    """Return each frame's mean whitened square (n,), large ones cut."""
    # A few saturated pixels do not choose the frame: none counts for more than 10 sigmas.
    square = np.minimum((recorded - mean) ** 2 / variance, 100.0)
    counts = np.isfinite(variance)
    return np.asarray(np.where(counts, square, 0.0).sum(axis=(1, 2)) / np.maximum(counts.sum(axis=(1, 2)), 1))


def _grey(image_dn: npt.NDArray[np.generic], sensor: Sensor) -> str:
    bin_px = max(1, math.ceil(image_dn.shape[1] / FRAME_PX))
    shown = np.nan_to_num(binned(image_dn.astype(np.float32), bin_px))
    return png(visible(np.rint(shown).clip(0.0, sensor.max_dn).astype(np.uint16), sensor))
