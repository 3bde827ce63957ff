"""calibrate_sensor.html of a still stripe: sensor and speckle in words and pictures."""

from collections.abc import Sequence

import numpy as np

from arctrack.calibrate.page import CalibrationPage, PagePicture, ValueRow, row_of, with_sigma
from arctrack.report import style
from arctrack.report.embedded import png, svg
from arctrack.report.image import visible
from calibration.sensor.flat_fields import IntervalEstimate
from calibration.sensor.still import StillCalibration

WORDS = {"gain_e_per_dn": "gain", "black_level_dn": "black level", "read_noise_e": "read noise"}


def still_page(result: StillCalibration, source: str, warnings: Sequence[str]) -> CalibrationPage:
    """Return the page's content."""
    seen, gain = result.statistics, result["gain_e_per_dn"]
    rows = [_row(WORDS[name], name, estimate) for name, estimate in result.estimates.items()]
    speckle = result.speckle
    if speckle is not None:
        for what, value, sigma, unit in (
            ("speckle's contrast", speckle.contrast, speckle.contrast_sigma, ""),
            ("speckle's grain", speckle.grain_px, speckle.grain_sigma_px, "px"),
        ):
            half = speckle.half_width * sigma
            estimate = IntervalEstimate(value, sigma, value - half, value + half, unit)
            rows.append(_row(what, "", estimate))
    # With bins that much off the model, relative, the gain is not to be relied upon: the page is orange.
    is_fine = result.unlike_rel < 0.1
    headline, within = with_sigma(gain.value, gain.sigma)
    sentences = [
        f"{seen.n_frames} frames of a stripe that stands still to {np.abs(seen.shifts_px).max():.2f} px, "
        f"its brightness to {100.0 * np.abs(seen.brightness).max():.1f} %. Both are taken off.",
        f"Beyond that, parts of it shake by {result.shake_px:.3f} px and flicker by "
        f"{100.0 * result.flicker_rel:.1f} %.",
        "Black is the level of the darkest pixels. If light of the hall falls there, black lies lower and "
        "the read noise is smaller.",
    ]
    if result.is_read_noise_hidden:
        sentences.append(
            "Rounding hides the read noise: it is anything from 0 to 0.4 DN, and the middle is given."
        )
    if not is_fine:
        sentences.append(
            f"Variances lie {100.0 * result.unlike_rel:.0f} % off any line of the photon transfer: "
            "compression, sharpening or a speckle that moves. Take flat and dark frames."
        )
    if speckle is None:
        sentences.append("The stripe is too short, saturated or too faint to tell its speckle.")
    return CalibrationPage(
        title=f"arctrack calibrates the sensor of {source}",
        label="sensor, from a still stripe",
        headline=f"{headline} ± {within} e-/DN",
        sentences=tuple(sentences),
        rows=tuple(rows),
        pictures=(
            PagePicture(
                _transfer(result),
                "photon transfer: variance from frame to frame over the mean, and the same over the fit",
                "Each point is some hundred pixels or more of one brightness and one slope of the image. "
                "What the fit lies above the line of shot noise is shake and flicker.",
            ),
        ),
        maps=(
            PagePicture(
                png(visible(seen.image_dn, result.sensor)), "the mean of the frames, brightness by √"
            ),
        ),
        mark="no_gap" if is_fine else "ambiguous",
        left_out=tuple(warnings),
    )


def _row(what: str, key: str, estimate: IntervalEstimate) -> ValueRow:
    ends = (estimate.low, estimate.high)
    return row_of(what, key, estimate.value, estimate.sigma, estimate.unit, ends=ends)


def _transfer(result: StillCalibration) -> str:
    figure = style.new_figure(10.5, 4.2, "")
    curve, ratio = figure.subplots(1, 2)
    seen = result.statistics
    over_black = seen.mean_dn - seen.black_dn
    order = np.argsort(over_black)
    style.plain(curve, "mean over black [DN]", "variance in time [DN²]")
    curve.plot(over_black, seen.variance_dn2, ".", color=style.BLUE, markersize=4, label="bins of pixels")
    curve.plot(over_black, result.fitted_dn2, "_", color=style.VERMILLION, markersize=7, label="fit")
    if result.sensor.gamma == 1.0:
        line = over_black[order] / result["gain_e_per_dn"].value + seen.dark_variance_dn2
        curve.plot(over_black[order], line, color=style.GREY, linewidth=1.0, label="shot and read noise")
    curve.legend(fontsize=8)
    style.plain(ratio, "mean over black [DN]", "variance over fit")
    sigma = np.sqrt(2.0 / (seen.freedom * seen.n_pixels))
    ratio.errorbar(
        over_black, seen.variance_dn2 / result.fitted_dn2, sigma, fmt=".", color=style.BLUE, markersize=4
    )
    ratio.axhline(1.0, color=style.BLACK, linewidth=0.8)
    return svg(figure)
