"""Pictures of a camera's calibration: where boards were seen, what is left, how well what is known."""

import cv2
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from arctrack.report import style
from calibration.camera.calibrate import CameraCalibration
from noise_model.compiled.arrays import Float64, Integers

WIDTH_INCH = 7.0
COLOURS = "viridis"

SIGMA_LEVELS_PX = (0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0)


def _image_axes(result: CameraCalibration, title: str) -> tuple[Figure, Axes]:
    lens = result.scene.lens
    figure = style.new_figure(WIDTH_INCH, 0.8 + WIDTH_INCH * lens.height / lens.width, title)
    axes = style.plain(figure.subplots(), "column [px]", "row [px]")
    style.over_image(axes, lens.width, lens.height)
    axes.set_aspect("equal")
    axes.grid(visible=False)
    return figure, axes


def coverage(result: CameraCalibration, sample: Integers | None) -> Figure:
    """Return a figure of the corners over the first image, and of the best place of the next board."""
    figure, axes = _image_axes(result, "")
    if sample is not None:
        low, high = np.percentile(sample, [1.0, 99.5])
        # Size to which the image behind the corners is reduced, px.
        step = -(-max(sample.shape) // 800)
        axes.imshow(
            sample[::step, ::step],
            cmap="gray",
            vmin=low,
            vmax=max(high, low + 1.0),
            alpha=0.6,
            extent=(-0.5, sample.shape[1] - 0.5, sample.shape[0] - 0.5, -0.5),
        )
    for part in result.seen.slices:
        axes.plot(*result.seen.points_px[part].T, ".", markersize=3, alpha=0.9, rasterized=True)
    for wrong in result.wrong:
        axes.plot(*wrong.point_px, "x", color=style.VERMILLION, markersize=8, markeredgewidth=2)
    if result.next_board is not None:
        outline = cv2.convexHull(result.next_board.points_px.astype(np.float32))[:, 0]
        axes.plot(*np.vstack([outline, outline[:1]]).T, color=style.YELLOW, linewidth=2)
        axes.plot([], [], color=style.YELLOW, linewidth=2, label="where the next board is worth most")
    if result.wrong:
        axes.plot([], [], "x", color=style.VERMILLION, label="left out")
    if axes.get_legend_handles_labels()[0]:
        axes.legend(fontsize=8, loc="upper right", facecolor="#BBBBBB")
    return figure


def residuals(result: CameraCalibration) -> Figure:
    """Return the residuals as arrows over the image."""
    lens, vectors = result.scene.lens, result.scene.residuals(result.seen)
    typical = float(np.quantile(np.linalg.norm(vectors, axis=1), 0.95))
    # Length of the arrow of a residual of the 95 % quantile, over the image's width.
    stretch = 0.03 * lens.width / max(typical, 1e-12)
    figure, axes = _image_axes(result, f"Residuals, drawn {stretch:.0f} times as long")
    axes.quiver(
        *result.seen.points_px.T,
        *(stretch * vectors.T),
        angles="xy",
        scale_units="xy",
        scale=1.0,
        width=0.0018,
        color=style.BLUE,
    )
    return figure


def sigma_map(result: CameraCalibration) -> Figure:
    """Return the projection's sigma over the image, with the hull of what was seen."""
    figure, axes = _image_axes(result, f"1 σ of the projection at {result.distance_mm:.0f} mm")
    points, sigma = result.sigma_map()
    lens = result.scene.lens
    shown = axes.imshow(
        np.log10(sigma),
        extent=(-0.5, lens.width - 0.5, lens.height - 0.5, -0.5),
        cmap=COLOURS,
        interpolation="bilinear",
    )
    lines = axes.contour(
        points[..., 0], points[..., 1], sigma, SIGMA_LEVELS_PX, colors="white", linewidths=0.8
    )
    axes.clabel(lines, fmt=lambda level: f"{level:g} px", fontsize=8)
    hull = cv2.convexHull(result.seen.points_px.astype(np.float32))[:, 0]
    axes.plot(*np.vstack([hull, hull[:1]]).T, "--", color="white", linewidth=1.2, label="corners were seen")
    axes.legend(fontsize=8, loc="upper right", facecolor="#777777", labelcolor="white")
    bar = figure.colorbar(shown, ax=axes, label="px")
    low, high = np.log10(sigma.min()), np.log10(sigma.max())
    ticks = [level for level in SIGMA_LEVELS_PX if low <= np.log10(level) <= high]
    bar.set_ticks(list(np.log10(ticks)), labels=[f"{level:g}" for level in ticks])
    return figure


def warp(result: CameraCalibration) -> Figure:
    """Return the board's shape."""
    board = result.seen.board
    figure = style.new_figure(WIDTH_INCH, 3.6, "")
    axes = style.plain(figure.subplots(), "along the columns [mm]", "along the rows [mm]")
    axes.grid(visible=False)
    height_um = 1e3 * (board.bulge @ result.scene.warp_mm).reshape(board.rows, board.columns)
    x, y = (board.points_mm[:, n].reshape(board.rows, board.columns) for n in (0, 1))
    most = max(float(np.abs(height_um).max()), 1e-9)
    shown = axes.contourf(x, y, height_um, 16, cmap="RdBu_r", vmin=-most, vmax=most)
    axes.set_aspect("equal")
    axes.invert_yaxis()
    figure.colorbar(shown, ax=axes, label="height, away from the camera [µm]")
    if result.print_sigma_mm > 0.0:
        # Length of the arrow of a corner that is twice as far off as most, over the squares' side.
        stretch = 0.4 * board.square_mm / (2.0 * float(np.sqrt(np.mean(result.scene.print_mm**2))))
        arrows = stretch * result.scene.print_mm.T
        axes.quiver(x, y, *arrows, angles="xy", scale_units="xy", scale=1.0, width=0.004)
        axes.set_title(f"arrows: where corners are off, {stretch:.0f} times as long", loc="left", fontsize=10)
    return figure


def noise(result: CameraCalibration) -> Figure:
    """Return each image's noise of a corner, and its RMS residual."""
    figure = style.new_figure(WIDTH_INCH, 3.2, "")
    axes = style.plain(figure.subplots(), "image", "px")
    square = np.sum(result.scene.residuals(result.seen) ** 2, axis=1)
    rms = np.array([np.sqrt(0.5 * square[part].mean()) for part in result.seen.slices])
    places = np.arange(len(rms))
    axes.bar(places, rms, color=style.SKY, label="RMS residual along x or y")
    axes.plot(places, result.noise.sigma_px, "_", color=style.BLACK, markersize=10, label="1 σ it is given")
    axes.set_xticks(places, [name[-16:] for name in result.seen.names], rotation=60, ha="right", fontsize=7)
    axes.legend(fontsize=8)
    return figure


def halves(result: CameraCalibration) -> Figure:
    """Return a figure of the difference of two halves and its prediction, over the image."""
    ordered = sorted(result.halves, key=lambda difference: difference.ratio)
    middle = ordered[len(ordered) // 2]
    lens = result.scene.lens
    figure = style.new_figure(2.0 * WIDTH_INCH, 0.9 + WIDTH_INCH * lens.height / lens.width, "")
    most = max(float(np.linalg.norm(middle.shift_px, axis=1).max()), 2.0 * float(middle.sigma_px.max()))
    sizes: tuple[tuple[str, Float64], ...] = (
        ("how they differ", np.linalg.norm(middle.shift_px, axis=1)),
        ("1 σ that noise predicts, both axes together", np.sqrt(2.0) * middle.sigma_px),
    )
    for axes, (title, values) in zip(figure.subplots(1, 2), sizes, strict=True):
        style.plain(axes, "column [px]", "row [px]", title)
        shown = axes.scatter(
            *middle.points_px.T, c=values, s=60, marker="s", cmap=COLOURS, vmin=0.0, vmax=most
        )
        style.over_image(axes, lens.width, lens.height)
        axes.set_aspect("equal")
        figure.colorbar(shown, ax=axes, label="px")
    return figure


def orders(result: CameraCalibration) -> Figure:
    """Return a figure of each distortion's error on boards that its fit did not see."""
    figure = style.new_figure(WIDTH_INCH, 3.2, "")
    axes = style.plain(figure.subplots(), "distortion", "mean square of residuals over noise")
    best = min(result.scores, key=lambda each: each.mean)
    places = np.arange(len(result.scores))
    errors = [each.excess(best)[1] for each in result.scores]
    colours = [style.VERMILLION if each.name == result.order else style.BLUE for each in result.scores]
    for place, each, error, colour in zip(places, result.scores, errors, colours, strict=True):
        axes.errorbar(place, each.mean, error, fmt="o", color=colour, capsize=4)
    axes.set_yscale("log")
    axes.set_xticks(places, [each.name for each in result.scores])
    return figure
