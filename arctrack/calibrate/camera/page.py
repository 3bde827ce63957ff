"""calibrate_camera.html: the lens' values, what they rest on, and where to hold the board next."""

import math
from collections.abc import Iterator

import cv2
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from arctrack.calibrate.camera.board_images import BoardImages
from arctrack.calibrate.page import CalibrationPage, PagePicture, ValueRow, row_of, with_reasons
from arctrack.recording import SetupFile
from arctrack.recording.schema import keys_of
from arctrack.recording.sensor_tables import CameraTable
from arctrack.report import style
from arctrack.report.embedded import svg
from calibration.camera.calibrate import CameraCalibration
from calibration.camera.enough import GOOD_COVER, cover, empty_parts
from calibration.camera.halves import MAX_RATIO
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


def _draw_coverage(result: CameraCalibration, sample: Integers | None) -> Figure:
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


def _draw_residuals(result: CameraCalibration) -> Figure:
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


def _draw_sigma_map(result: CameraCalibration) -> Figure:
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


def _draw_warp(result: CameraCalibration) -> Figure:
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


def _draw_noise(result: CameraCalibration) -> Figure:
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


def _draw_halves(result: CameraCalibration) -> Figure:
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


def _draw_orders(result: CameraCalibration) -> Figure:
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


DIM = (
    "the board is dim: light it from the side with LEDs of the laser's wavelength or a halogen lamp, and "
    "expose longer; the filter holds back all other light"
)

MEANINGS = {
    "p1": "tangential distortion",
    "p2": "tangential distortion",
    "tau_x": "tilt of the sensor about the image's horizontal",
    "tau_y": "tilt of the sensor about the image's vertical",
    "warp_x_mm": "the board's rise in its middle, bent along its columns",
    "warp_y_mm": "the board's rise in its middle, bent along its rows",
}


def camera_page(result: CameraCalibration, images: BoardImages, stated: SetupFile | None) -> CalibrationPage:
    """Return the page's content; `stated` is the setup that the values go into, if any."""
    sigma = result.sigma_map()[1]
    lens = result.scene.lens
    count = len(images.views) + len(images.left_out)
    sentences = [
        *([f"{result.model_error[0].upper()}{result.model_error[1:]}."] if result.model_error else []),
        f"{len(result.seen.names)} of {count} images, {len(result.seen)} corners of {result.seen.board}: "
        f"{result.rms_px:.3f} px RMS; noise of a corner {float(result.noise.sigma_px.mean()):.3f} px.",
        f"The distortion is {result.order}. Coefficients that are not listed are 0.",
        f"Halves of the images differ {result.ratio_of_halves:.2f} times as much as noise predicts, "
        f"{MAX_RATIO:g} at most.",
    ]
    if result.next_board is not None:
        sentences.append(
            f"One more image is worth most with the board {result.next_board.words}: the projection's sigma "
            f"would be {result.next_board.sigma_px:.3f} px RMS over the image."
        )
    return CalibrationPage(
        title=f"arctrack calibrates a camera of {lens.width} × {lens.height} px",
        label="refused" if result.model_error else "lens",
        headline=f"known to {sigma.min():.2g} px at best and {sigma.max():.2g} px at worst, 1 σ at "
        f"{result.distance_mm:.0f} mm",
        sentences=tuple(sentences),
        rows=camera_rows(result),
        pictures=tuple(_pictures(result, images)),
        notes=tuple(camera_notes(result, stated, images.is_dim)),
        mark="unknown" if result.model_error else "no_gap",
        left_out=(*with_reasons(images.left_out | result.left_out), *_wrong_corners(result)),
    )


def camera_rows(result: CameraCalibration) -> tuple[ValueRow, ...]:
    """Return the lens' parameters and the board's warp."""
    values = [*result.scene.lens.values, *result.scene.warp_mm]
    stated = {key.name: key for key in keys_of(CameraTable)}
    rows = []
    for name, value, sigma in zip(result.names, values, result.sigma, strict=True):
        key = "" if name.endswith("_mm") else name
        if name in stated:
            meaning, unit = stated[name].field.description or "", stated[name].text("unit")
            rows.append(row_of(f"{meaning[:1].lower()}{meaning[1:]}", key, value, sigma, unit))
            continue
        unit = "rad" if name.startswith("tau") else "" if key else "mm"
        rows.append(row_of(MEANINGS.get(name, "radial distortion"), key, value, sigma, unit))
    if result.print_sigma_mm > 0.0:
        off = f"{result.print_sigma_mm:.4f}"
        rows.append(ValueRow("how far corners are off on the board as printed, 1 σ", "", off, "", "", "mm"))
    return tuple(rows)


def camera_notes(result: CameraCalibration, stated: SetupFile | None, is_dim: bool) -> Iterator[str]:
    """Yield what the user should know before trusting the values."""
    share, empty = cover(result.scene.lens, result.seen), empty_parts(result.scene.lens, result.seen)
    if share < GOOD_COVER:
        where = f", none of it in the {empty}" if empty else ""
        yield f"the boards cover {100.0 * share:.0f} % of the image{where}: beyond, the lens was not seen"
    if result.scatter > 1.0:
        yield (
            f"the images differ {math.sqrt(result.scatter):.1f} times as much as their corners' noise "
            "predicts, and sigmas are as much wider: the board is not quite as stated, or moved"
        )
    size = result.scene.lens.width, result.scene.lens.height
    if stated is not None and size != (stated.setup.camera.width, stated.setup.camera.height):
        before = f"{stated.setup.camera.width} x {stated.setup.camera.height}"
        yield (
            f"{stated.path}: [camera] width, height: {before} before, {size[0]} x {size[1]} as the images: "
            "recordings must have this size, too; images that were enlarged or reduced are no camera's"
        )
    if is_dim:
        yield DIM


def _wrong_corners(result: CameraCalibration) -> Iterator[str]:
    for wrong in result.wrong:
        off_px = math.hypot(*wrong.residual_px.tolist())
        column, row = wrong.point_px.tolist()
        yield (
            f"{result.seen.names[wrong.view]}: corner {wrong.corner} at column {column:.1f}, row {row:.1f} "
            f"is {off_px:.2f} px off"
        )


def _pictures(result: CameraCalibration, images: BoardImages) -> Iterator[PagePicture]:
    yield _picture(_draw_coverage(result, images.sample), "where corners were seen", "")
    yield _picture(
        _draw_sigma_map(result),
        "how well a point's place in the image is known, 1 σ, RMS over directions",
        "It is that of points at the boards' median distance. Beyond the dashed line the lens was not seen: "
        "the map believes in the distortion's form there.",
    )
    yield _picture(
        _draw_residuals(result),
        "how far corners are off",
        "Arrows of neighbours that point the same way show what the model lacks.",
    )
    yield _picture(
        _draw_halves(result),
        "two halves of the images, each with a lens of its own",
        "Left: how far apart both see a point. Right: how far noise lets them.",
    )
    if len(result.scores) > 1:
        yield _picture(
            _draw_orders(result),
            "how well each distortion predicts boards that its fit did not see",
            "Red is taken: the leanest within one standard error of the best, or against which the best has "
            "no strong evidence. Bars are standard errors of the difference to the best.",
        )
    yield _picture(
        _draw_noise(result),
        "the noise of a corner, image by image",
        "A blurred or dark image has noisier corners, and counts less.",
    )
    yield _picture(
        _draw_warp(result),
        "the board as it is",
        "Colours: a paraboloid, bent along the columns and along the rows.",
    )


def _picture(figure: Figure, caption: str, note: str) -> PagePicture:
    return PagePicture(svg(figure), caption, note)
