"""calibrate_camera.html: the lens' values, what they rest on, and where to hold the board next."""

import math
from collections.abc import Iterator

from matplotlib.figure import Figure

from arctrack.calibrate.camera import pictures as camera_pictures
from arctrack.calibrate.camera.board_images import BoardImages
from arctrack.calibrate.page import CalibrationPage, PagePicture, ValueRow, row_of, with_reasons
from arctrack.recording import SetupFile
from arctrack.recording.schema import keys_of
from arctrack.recording.sensor_tables import CameraTable
from arctrack.report.embedded import svg
from calibration.camera.calibrate import CameraCalibration
from calibration.camera.enough import GOOD_COVER, cover, empty_parts
from calibration.camera.halves import MAX_RATIO

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
    yield _picture(camera_pictures.coverage(result, images.sample), "where corners were seen", "")
    yield _picture(
        camera_pictures.sigma_map(result),
        "how well a point's place in the image is known, 1 σ, RMS over directions",
        "It is that of points at the boards' median distance. Beyond the dashed line the lens was not seen: "
        "the map believes in the distortion's form there.",
    )
    yield _picture(
        camera_pictures.residuals(result),
        "how far corners are off",
        "Arrows of neighbours that point the same way show what the model lacks.",
    )
    yield _picture(
        camera_pictures.halves(result),
        "two halves of the images, each with a lens of its own",
        "Left: how far apart both see a point. Right: how far noise lets them.",
    )
    if len(result.scores) > 1:
        yield _picture(
            camera_pictures.orders(result),
            "how well each distortion predicts boards that its fit did not see",
            "Red is taken: the leanest within one standard error of the best, or against which the best has "
            "no strong evidence. Bars are standard errors of the difference to the best.",
        )
    yield _picture(
        camera_pictures.noise(result),
        "the noise of a corner, image by image",
        "A blurred or dark image has noisier corners, and counts less.",
    )
    yield _picture(
        camera_pictures.warp(result),
        "the board as it is",
        "Colours: a paraboloid, bent along the columns and along the rows.",
    )


def _picture(figure: Figure, caption: str, note: str) -> PagePicture:
    return PagePicture(svg(figure), caption, note)
