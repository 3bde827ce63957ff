"""calibrate_sensor.html: the photon transfer of flat and dark frames in words and pictures."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from matplotlib.ticker import FormatStrFormatter, LogLocator, NullFormatter
from scipy.ndimage import uniform_filter

from arctrack.calibrate.page import CalibrationPage, PagePicture, ValueRow, row_of, with_sigma
from arctrack.report import style
from arctrack.report.embedded import CHANGE, coloured, png, svg
from arctrack.report.image import visible
from calibration.sensor.flat_fields import IntervalEstimate, SensorCalibration
from calibration.sensor.levels import BOX_PX, Level
from calibration.sensor.still import StillCalibration
from noise_model.compiled.arrays import Float64

WORDS = {
    "gain_e_per_dn": ("gain", "gain_e_per_dn"),
    "black_level_dn": ("black level", "black_level_dn"),
    "read_noise_e": ("read noise", "read_noise_e"),
    "full_well_e": ("full well", "full_well_e"),
    "gamma": ("gamma", "gamma"),
    "dsnu_e": ("dark signal non-uniformity, DSNU", ""),
    "prnu_rel": ("photo response non-uniformity, PRNU", ""),
    "linearity_rel": ("linearity error, levels off the exposures' line", ""),
}
"""Name of each value, and its key in [sensor]."""

MAP_PX, MAP_SIGMAS = 160, 3.0
"""Size of a pattern's picture, pixels a side, and its range, sigmas."""


def sensor_rows(result: SensorCalibration) -> tuple[ValueRow, ...]:
    """Return the values for people, percents as such."""
    rows = []
    for name, (what, key) in WORDS.items():
        estimate = result[name]
        # Values that people read in %.
        factor, unit = (100.0, "%") if name in ("prnu_rel", "linearity_rel") else (1.0, estimate.unit)
        ends = (factor * estimate.low, factor * estimate.high)
        row = row_of(what, key, factor * estimate.value, factor * estimate.sigma, unit, ends=ends)
        rows.append(replace(row, sigma="held", interval="") if estimate.sigma == 0.0 else row)
    return tuple(rows)


def sensor_page(
    result: SensorCalibration, levels: Sequence[Level], source: str, warnings: Sequence[str]
) -> CalibrationPage:
    """Return the page's content."""
    gain, read = result["gain_e_per_dn"], result["read_noise_e"]
    well = "is seen" if result.well_is_seen else "is not seen: the charge at the last code stands for it"
    kept = result.levels
    fits = result.chi2_is_likely
    sentences = (
        f"{int(kept.is_lit.sum())} exposures below saturation, {kept.n_pixels} pixels each about the "
        f"image's middle; {kept.n_defects} defect pixels are left out.",
        f"The full well {well}.",
        f"χ² of means and variances is {result.chi2:.2f} per degree of freedom"
        + (
            ": the model explains the frames."
            if fits
            else ": more than chance; the sigmas are scaled by its root."
        ),
    )
    return CalibrationPage(
        title=f"arctrack calibrates the sensor of {source}",
        label="sensor",
        headline=(
            f"{gain.value:.4g} ± {gain.sigma:.2g} e-/DN, read noise {read.value:.3g} ± {read.sigma:.2g} e-"
        ),
        sentences=sentences,
        rows=sensor_rows(result),
        pictures=(
            PagePicture(
                _transfer(result),
                "photon transfer: variance from frame to frame over the mean",
                "Points are levels, with 1 σ of a variance of so many pixels; the line is the fit. Shot "
                "noise alone has the slope 1 for gamma 1, and 2 − 1/γ else.",
            ),
            PagePicture(
                _residuals(result),
                "left: variances off the fit; right: charges off the line of the exposures",
                "Noise within ±2 σ is chance. The band on the right is ± the linearity error.",
            ),
        ),
        maps=_maps(result, levels),
        mark="no_gap" if fits else "ambiguous",
        left_out=(*(f"{name}: is saturated" for name in result.left_out), *warnings),
    )


def _transfer(result: SensorCalibration) -> str:
    figure = style.new_figure(10.5, 4.6, "")
    axes = figure.add_subplot()
    style.plain(axes, "mean over black [DN]", "variance in time [DN²]")
    kept, fit = result.levels, result.fit
    black = result["black_level_dn"].value
    lit = kept.is_lit
    sigma = np.sqrt(fit.predicted.variance_of_variance / kept.n_pixels)
    over_black = kept.mean_dn - black
    axes.errorbar(
        over_black[lit],
        kept.variance_dn2[lit],
        sigma[lit],
        fmt="o",
        color=style.BLUE,
        markersize=4,
        label="flat",
    )
    charge = np.geomspace(0.2 * fit.charge_e[lit].min(), result["full_well_e"].value, 400)
    mean, variance = result.curve(charge)
    axes.plot(mean - black, variance, color=style.VERMILLION, linewidth=1.2, label="fit")
    axes.axhline(
        float(kept.variance_dn2[~lit].mean()),
        color=style.GREY,
        linewidth=1.0,
        dashes=(5, 3),
        label="dark frames",
    )
    axes.axvline(result.top_dn - black, color=style.BLACK, linewidth=0.8, dashes=(2, 2), label="saturation")
    axes.set_xscale("log")
    axes.set_yscale("log")
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        axis.set_major_formatter(FormatStrFormatter("%g"))
        axis.set_minor_formatter(NullFormatter())
    axes.set_ylim(0.5 * kept.variance_dn2.min(), 3.0 * kept.variance_dn2.max())
    axes.legend(fontsize=8)
    return svg(figure)


def _residuals(result: SensorCalibration) -> str:
    figure = style.new_figure(10.5, 3.4, "")
    noise, line = figure.subplots(1, 2)
    kept, fit = result.levels, result.fit
    sigma = np.sqrt(fit.predicted.variance_of_variance / kept.n_pixels)
    style.plain(noise, "charge [e-]", "σ", "variance − fit")
    noise.axhspan(-2.0, 2.0, color=style.GREY, alpha=0.12, lw=0)
    noise.plot(fit.charge_e, (kept.variance_dn2 - fit.predicted.variance_dn2) / sigma, "o", color=style.BLUE)
    style.plain(line, "exposure [ms]", "%", "charge over that of the exposures' line − 1")
    tau = 100.0 * result["linearity_rel"].value
    line.axhspan(-tau, tau, color=style.GREY, alpha=0.15, lw=0)
    line.plot(1e3 * kept.exposure_s[kept.is_lit], 100.0 * fit.departures, "o", color=style.BLUE)
    return svg(figure)


def _maps(result: SensorCalibration, levels: Sequence[Level]) -> tuple[PagePicture, ...]:
    """Return the pattern in the dark and of the brightest level that counts."""
    dark = next(level for level in levels if not level.is_lit)
    kept = max(result.levels.exposure_s[result.levels.is_lit])
    bright = next(level for level in levels if level.is_lit and level.exposure_s == kept)
    light = float(bright.mean_dn.mean()) - result["black_level_dn"].value
    pictures = []
    for level, scale, unit in ((dark, 1.0, "DN"), (bright, 100.0 / light, "% of the light")):
        pattern = scale * _middle(level)
        reach = MAP_SIGMAS * float(pattern.std())
        caption = (
            f"{level.name}, {pattern.shape[1]} × {pattern.shape[0]} px: ±{reach:.2g} {unit}, blue darker"
        )
        pictures.append(PagePicture(coloured(pattern.astype(np.float32), CHANGE, -reach, reach), caption))
    return tuple(pictures)


def _middle(level: Level) -> Float64:
    pattern = level.mean_dn - uniform_filter(level.mean_dn, BOX_PX)
    rows, columns = (slice(max((n - MAP_PX) // 2, 0), (n + MAP_PX) // 2) for n in pattern.shape)
    return np.asarray(pattern[rows, columns], dtype=np.float64)


def still_page(result: StillCalibration, source: str, warnings: Sequence[str]) -> CalibrationPage:
    """Return the page's content."""
    seen, gain = result.statistics, result["gain_e_per_dn"]
    rows = [_row(WORDS[name][0], name, estimate) for name, estimate in result.estimates.items()]
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
                _still_transfer(result),
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


def _still_transfer(result: StillCalibration) -> str:
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
