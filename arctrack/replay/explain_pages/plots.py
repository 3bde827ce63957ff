"""The drawings of a frame's explanation: candidates, scan lines, sigmas, profile, the seam along the path."""

import math

import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.patches import Ellipse
from matplotlib.ticker import FormatStrFormatter, LogLocator, NullFormatter

from arctrack.replay.explain import Explanation, StepObservation, StripeLook
from arctrack.replay.explain_lines import NO_PATH, READ, UNLIT, SigmaParts, window_of
from arctrack.replay.explain_pages.words import scan_line
from arctrack.report import style
from arctrack.report.embedded import svg
from noise_model.arc.map import CELL
from noise_model.compiled.arrays import Bool, Float64
from tracker.joint.measured import off_section
from tracker.joint.section_fit import SIGMA_FLOOR_PX
from tracker.stripe.viterbi import GAIN_CAP, OFFSET_STEP

WIDTH_INCH = 10.5

CERTAIN_SIGMAS = math.sqrt(2.0 * GAIN_CAP)
"""A score from which on a candidate gains no more."""

PARTS = {
    "stripe": ("shot noise of the stripe", style.BLUE),
    "arc": ("shot noise of the arc", style.ORANGE),
    "map": ("uncertainty of the arc map", style.VERMILLION),
    "dark": ("read noise, steps of the DN", style.GREY),
    "width": ("unknown width", style.SKY),
    "misfit": ("misfit (χ² above its scatter), scatter of the lines", style.BLACK),
}
"""Parts of a sigma, bottom to top."""

FLOOR = ("floor that the joint's fit adds", style.GREEN)

CLOSE_MM = 3.0
"""Half-width of the close-up of the profile about the seam point."""


def candidates_picture(explanation: Explanation, look: StripeLook) -> str:
    """Return each candidate's gain in log-likelihood over scan lines and offsets, and the likeliest path."""
    reading = look.reading
    assert explanation.look is not None
    assert explanation.look.expected is not None
    figure = style.new_figure(WIDTH_INCH, 3.3, "Candidates: how far a stripe there stands out")
    axes = style.plain(figure.subplots(), f"{scan_line(explanation)} [px]", "off the expected stripe [px]")
    axes.grid(visible=False)
    score = np.maximum(reading.score, 0.0)
    # A streak of spatter must not pale the stripe.
    ceiling = max(1.2 * float(np.median(score.max(axis=1))), CERTAIN_SIGMAS)
    # Number of shades of grey of the scores: noise stays white.
    step = ceiling / 12
    low, high = int(reading.offsets_px[0]), int(reading.offsets_px[-1])
    half = 0.5 * OFFSET_STEP * reading.bin_px
    shown = axes.imshow(
        step * np.floor(score.T / step),
        cmap="Greys",
        vmin=0.0,
        vmax=ceiling,
        aspect="auto",
        interpolation="none",
        extent=(-0.5, len(score) - 0.5, high + half, low - half),
    )
    figure.colorbar(shown, ax=axes, label="score [σ]", pad=0.01)
    off = reading.start_px - explanation.look.expected.position_px
    lines = np.arange(len(off))
    axes.axhline(0.0, color=style.BLUE, linewidth=0.9, dashes=(6, 4), label="expected")
    axes.plot(lines, off, color=style.ORANGE, linewidth=1.2, label="likeliest path")
    refused = (look.refusals.why != READ) & (look.refusals.why != UNLIT)
    if refused.any():
        mark_px = np.where(look.refusals.why == NO_PATH, high, off)
        axes.plot(
            lines[refused], mark_px[refused], "x", color=style.VERMILLION, markersize=4, label="no stripe"
        )
    _legend(axes, 3)
    return svg(figure)


def line_picture(explanation: Explanation, look: StripeLook, s: int, title: str) -> str:
    """Return one scan line: its pixels over the band, its candidates, and the fit close by."""
    reading = look.reading
    assert explanation.look is not None
    assert explanation.look.expected is not None
    width, expected = (
        float(explanation.look.expected.sigma_px[s]),
        float(explanation.look.expected.position_px[s]),
    )
    figure = style.new_figure(WIDTH_INCH, 3.4, title)
    grid = figure.add_gridspec(2, 2, width_ratios=(1.35, 1.0), height_ratios=(1.3, 1.0))
    whole, close = figure.add_subplot(grid[0, 0]), figure.add_subplot(grid[:, 1])
    tried = figure.add_subplot(grid[1, 0], sharex=whole)
    low = int(reading.band.lows[s // CELL])
    positions_px = low + np.arange(reading.band.charge.shape[1])
    predicted = "arc map" if explanation.use_arc_map else "running median"
    start, fitted = float(reading.start_px[s]), float(reading.stripe.position_px[s])
    for axes in (whole, close):
        charge, background = reading.band.charge[s] / 1000.0, reading.band.background[s] / 1000.0
        censored = reading.band.censored[s]
        joined = "none" if axes is close else "-"
        axes.plot(
            positions_px, charge, color=style.GREY, linestyle=joined, linewidth=0.7, marker=".", markersize=3
        )
        axes.plot(positions_px[censored], charge[censored], "^", color=style.VERMILLION, label="saturated")
        axes.plot(positions_px, background, color=style.ORANGE, linewidth=1.3, label=predicted)
        axes.axvline(expected, color=style.BLUE, linewidth=0.9, dashes=(6, 4))
    style.plain(whole, "", "charge [1000 e-]")
    whole.tick_params(labelbottom=False)
    style.plain(close, "position [px]", "")
    if np.isfinite(fitted):
        x, mean = fitted_mean(explanation.look, look, s)
        close.plot(x, mean / 1000.0, color=style.GREEN, linewidth=1.5, label="fit")
        sigma = float(reading.stripe.sigma_px[s])
        close.axvspan(fitted - sigma, fitted + sigma, color=style.GREEN, alpha=0.35, lw=0, label="± 1 σ")
    middle = fitted if np.isfinite(fitted) else start if np.isfinite(start) else expected
    near = np.abs(positions_px - middle) <= 6.0 * width
    close.set_xlim(middle - 6.0 * width, middle + 6.0 * width)
    _frame_values(close, reading.band.charge[s, near] / 1000.0, reading.band.background[s, near] / 1000.0)
    handles, labels = close.get_legend_handles_labels()
    keep = [n for n, name in enumerate(labels) if name != "saturated" or reading.band.censored[s, near].any()]
    close.legend([handles[n] for n in keep], [labels[n] for n in keep], fontsize=8, loc="upper right")

    places, score = reading.around_px[s] + reading.offsets_px, reading.score[s]
    style.plain(tried, "position [px]", "score [σ]")
    tried.plot(places, score, color=style.BLACK, linewidth=0.9)
    tried.axhline(CERTAIN_SIGMAS, color=style.GREY, linewidth=0.9, dashes=(2, 2), label="above, no more gain")
    if np.isfinite(start):
        chosen = float(np.interp(start, places, score))
        tried.plot([start], [chosen], "o", color=style.ORANGE, markersize=6, label="chosen by the path")
    tried.legend(fontsize=8, loc="best", framealpha=0.8)
    tried.axvline(expected, color=style.BLUE, linewidth=0.9, dashes=(6, 4))
    return svg(figure)


def fitted_mean(look: StepObservation, stripe: StripeLook, s: int) -> tuple[Float64, Float64]:
    """Return positions over a line's fit window, px, and the charge that the fit expects there, e-."""
    reading, parts = stripe.reading, stripe.parts
    assert look.expected is not None
    window, _ = window_of(reading, look.expected, s)
    low = int(reading.band.lows[s // CELL])
    pixels = low + np.arange(window.start, window.stop)
    x = np.linspace(pixels[0], pixels[-1], 8 * len(pixels))
    position, _, amplitude, width = reading.fits[s, :4]
    background = np.interp(x, pixels, reading.band.background[s, window])
    u = x - position
    bell = amplitude * np.exp(-0.5 * (u / width) ** 2)
    return x, bell + background + parts.offset_e[s] + parts.slope_e_per_px[s] * u


def parts_with_floor(parts: SigmaParts) -> list[tuple[str, str, Float64]]:
    """Return label, colour and variance (n_scan,), px^2, of all parts of a line in the joint's fit."""
    listed = [(label, colour, getattr(parts, name)) for name, (label, colour) in PARTS.items()]
    floor = np.where(np.isfinite(parts.stripe), SIGMA_FLOOR_PX**2, np.nan)
    return [*listed, (*FLOOR, floor)]


def sigma_picture(explanation: Explanation, look: StripeLook) -> str:
    """Return each scan line's sigma, and what its variance is made of."""
    figure = style.new_figure(WIDTH_INCH, 4.6, "Where each scan line's σ comes from")
    upper, lower = figure.subplots(2, 1, sharex=True, height_ratios=(1.0, 1.4))
    parts, sigma = look.parts, look.reading.stripe.sigma_px
    lines = np.arange(len(sigma))
    style.plain(upper, "", "σ [px]")
    upper.plot(lines, sigma, color=style.BLACK, linewidth=1.0, label="as it is")
    without = sigma * np.sqrt(np.maximum(1.0 - parts.arc_share, 0.0))
    upper.plot(lines, without, color=style.BLUE, linewidth=1.0, label="without the arc")
    upper.axhline(SIGMA_FLOOR_PX, color=FLOOR[1], linewidth=0.9, dashes=(6, 4), label="the joint's floor")
    upper.set_yscale("log")
    upper.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    upper.yaxis.set_major_formatter(FormatStrFormatter("%g"))
    upper.yaxis.set_minor_formatter(NullFormatter())
    _legend(upper, 3)

    style.plain(lower, f"{scan_line(explanation)} [px]", "share of the variance [%]")
    # Number of bins of scan lines in which the sigma's parts are drawn.
    each = max(1, -(-len(lines) // 100))
    of_bins = [(label, colour, _binned(value, each)) for label, colour, value in parts_with_floor(parts)]
    total = np.sum([value for _, _, value in of_bins], axis=0)
    middles = (np.arange(len(total)) + 0.5) * each - 0.5
    below = np.zeros_like(total)
    for label, colour, value in of_bins:
        above = below + 100.0 * value / total
        lower.fill_between(middles, below, above, color=colour, lw=0, label=label, alpha=0.85)
        below = above
    lower.set_ylim(0.0, 100.0)
    lower.grid(visible=False)
    lower.legend(fontsize=8, loc="upper left", bbox_to_anchor=(1.005, 1.02), frameon=False)
    return svg(figure)


def profile_picture(explanation: Explanation, look: StepObservation) -> str:
    """Return the profile along the joint, the fitted section, the seam point, and the residuals."""
    profile, joint = look.profile, look.joint
    assert profile is not None
    figure = style.new_figure(
        WIDTH_INCH, 5.6, "The profile in the joint's frame, and the section fitted to it"
    )
    grid = figure.add_gridspec(2, 2, width_ratios=(1.6, 1.0), height_ratios=(1.6, 1.0))
    whole, close = figure.add_subplot(grid[0, 0]), figure.add_subplot(grid[:, 1])
    y, z = profile.y_mm, profile.z_mm
    expected = look.reading.scene.shape.vertices
    off = None if joint is None else off_section(profile.points, joint)
    margin = 0.03 * float(np.ptp(y))
    for axes in (whole, close):
        style.plain(axes, "y, to the left [mm]", "z, up [mm]")
        axes.plot(*expected.T, color=style.BLUE, linewidth=0.9, dashes=(6, 4), label="expected")
        _points(axes, y, z, off)
        if joint is not None:
            axes.plot(*joint.corners_mm.T, color=style.GREEN, linewidth=1.2, label="fitted section")
            axes.plot(
                joint.y_mm, joint.z_mm, "+", color=style.BLACK, markersize=13, mew=1.6, label="seam point"
            )
    whole.set_xlim(y[0] - margin, y[-1] + margin)
    _frame_values(whole, z)
    whole.set_xlabel("")
    whole.legend(fontsize=8, loc="best", framealpha=0.8)
    middle = (0.0, float(np.interp(0.0, *expected.T))) if joint is None else (joint.y_mm, joint.z_mm)
    close.set_xlim(middle[0] - CLOSE_MM, middle[0] + CLOSE_MM)
    close.set_ylim(middle[1] - 0.6 * CLOSE_MM, middle[1] + 1.4 * CLOSE_MM)
    close.set_aspect("equal", adjustable="box")
    residuals = figure.add_subplot(grid[1, 0], sharex=whole)
    if joint is None:
        close.set_title("about the expected seam", loc="left", fontsize=10)
        nominal = z - np.interp(y, *expected.T)
        style.plain(residuals, "y, to the left [mm]", "mm", "off the expected section")
        _points(residuals, y, nominal, off)
        return svg(figure)
    times = _ellipse(close, joint.covariance_mm2, middle)
    close.set_title(f"about the seam; ellipse: 1 σ, {times} times enlarged", loc="left", fontsize=10)
    over = z - np.interp(y, *joint.corners_mm.T)
    style.plain(residuals, "y, to the left [mm]", "mm", "off the fitted section")
    _points(residuals, y, over, off)
    residuals.axhline(0.0, color=style.GREEN, linewidth=1.0)
    spread = float(np.quantile(np.abs(over), 0.9))
    residuals.set_ylim(-4.0 * spread, 4.0 * spread)
    return svg(figure)


def history_picture(explanation: Explanation, look: StepObservation) -> str:
    """Return the seam along the path: what earlier frames put where, what this one measures, the torch."""
    history, seam, track = explanation.before.history, look.seam, explanation.track
    figure = style.new_figure(WIDTH_INCH, 4.6, "The seam's displacement from the programmed path")
    torch = look.torch_station_mm
    marks = [torch, look.reading.seam.station_mm, *history.stations_mm]
    # Places along the path at which the history is drawn.
    stations = np.linspace(min(marks) - 4.0, max(marks) + 4.0, 160)
    source = explanation.geometry.seam_source
    told = [source.seam_at(history, float(station))[:2] for station in stations]
    mean, sigma = (np.array([pair[n] for pair in told]) for n in (0, 1))
    rows = figure.subplots(2, 1, sharex=True)
    for axis, (axes, name) in enumerate(zip(rows, ("y, to the left", "z, up"), strict=True)):
        style.plain(axes, "", f"{name} [mm]")
        shown = []
        if history.n:
            known = (stations >= history.stations_mm.min()) & (stations <= look.reading.seam.station_mm)
            shown += [*(mean - sigma)[known, axis], *(mean + sigma)[known, axis]]
            axes.fill_between(
                stations, (mean - sigma)[:, axis], (mean + sigma)[:, axis], color=style.SKY, alpha=0.35, lw=0
            )
            axes.plot(
                stations,
                mean[:, axis],
                color=style.BLUE,
                lw=1.0,
                label="the earlier frames' seam, ± 1 σ of measurement",
            )
            axes.errorbar(
                history.stations_mm,
                history.displacements_mm[:, axis],
                np.sqrt(history.variances_mm2[:, axis]),
                fmt="o",
                color=style.BLUE,
                markersize=3.5,
                label="measured earlier",
            )
        if seam is not None:
            own = float(np.sqrt(seam.variance_mm2[axis]))
            displacement_mm = float(seam.displacement_mm[axis])
            if history.n:
                place, limit = float(seam.expected_mm[axis]), float(seam.limit_mm[axis])
                axes.errorbar(
                    seam.station_mm,
                    place,
                    limit,
                    fmt="none",
                    ecolor=style.GREY,
                    capsize=5,
                    lw=1.2,
                    label="beyond this a jump",
                )
                shown += [place - limit, place + limit]
            colour = style.GREEN if track.valid else style.VERMILLION
            axes.errorbar(
                seam.station_mm, displacement_mm, own, fmt="D", color=colour, markersize=6, label="this frame"
            )
            shown.append(displacement_mm)
        offset = (track.offset_y_mm, track.offset_z_mm)[axis]
        off_sigma = (track.offset_sigma_y_mm, track.offset_sigma_z_mm)[axis]
        axes.axvline(torch, color=style.BLACK, linewidth=0.8, dashes=(2, 2), label="the torch")
        if np.isfinite(offset):
            axes.errorbar(
                torch, offset, off_sigma, fmt="s", color=style.BLACK, markersize=5, capsize=4, label="offset"
            )
            shown += [offset - off_sigma, offset + off_sigma]
        _frame_values(axes, np.array(shown or [-1.0, 1.0]))
    rows[1].set_xlabel("along the path [mm]")
    rows[0].legend(fontsize=8, loc="upper left", bbox_to_anchor=(1.005, 1.02), frameon=False)
    return svg(figure)


def _points(axes: Axes, y: Float64, z: Float64, off: Bool | None) -> None:
    """Draw a profile's points, those apart that lie `off` the fitted section; None where there is no fit."""
    none = np.zeros(len(y), dtype=np.bool_)
    kinds = (
        (~none if off is None else none, ".", style.GREY, "measured, no fit"),
        (none if off is None else ~off, ".", style.SKY, "on the section"),
        (none if off is None else off, "x", style.VERMILLION, "off the section"),
    )
    for chosen, marker, colour, label in kinds:
        if chosen.any():
            axes.plot(y[chosen], z[chosen], marker, color=colour, markersize=4, label=label, rasterized=True)


def _ellipse(axes: Axes, covariance_mm2: Float64, middle: tuple[float, float]) -> int:
    """Draw a point's 1 sigma ellipse, enlarged; return how many times."""
    size, turn = np.linalg.eigh(covariance_mm2)
    small, large = np.sqrt(np.maximum(size, 0.0))
    # The seam's ellipse is drawn about so large.
    times = max((k for k in (1, 2, 5, 10, 20, 50, 100, 200, 500) if k * large <= 0.4), default=1)
    angle = float(np.degrees(np.arctan2(turn[1, 1], turn[0, 1])))
    diameters = (2.0 * times * large, 2.0 * times * small)
    axes.add_patch(Ellipse(middle, *diameters, angle=angle, fill=False, color=style.BLACK, linewidth=1.2))
    return times


def _binned(values: Float64, each: int) -> Float64:
    """Return means over bins of scan lines, NaN where a bin holds no value."""
    padded = np.concatenate([values, np.full(-len(values) % each, np.nan)]).reshape(-1, each)
    known = np.isfinite(padded)
    total = np.where(known, padded, 0.0).sum(axis=1)
    return np.where(known.any(axis=1), total / np.maximum(known.sum(axis=1), 1), np.nan)


def _frame_values(axes: Axes, *values: npt.NDArray[np.floating]) -> None:
    """Let an axis show these values and some room about them."""
    every = np.concatenate([v[np.isfinite(v)] for v in values])
    if every.size:
        low, high = float(every.min()), float(every.max())
        room = 0.08 * max(high - low, 1e-3)
        axes.set_ylim(low - room, high + room)


def _legend(axes: Axes, columns: int) -> None:
    axes.legend(fontsize=8, loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=columns, frameon=False)
