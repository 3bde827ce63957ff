"""A camera's calibration in words: values with sigmas, what they rest on, what to beware of."""

from __future__ import annotations

import math
from collections.abc import Iterator

from arctrack.calibration_files.board_images import BoardImages
from arctrack.recording import SetupFile
from arctrack.report.camera.numbers import parameter_rows
from calibration.camera.calibrate import CameraCalibration
from calibration.camera.enough import GOOD_COVER, cover, empty_parts
from calibration.camera.halves import MOST_RATIO

DIM = (
    "the board is dim: light it from the side with LEDs of the laser's wavelength or a halogen lamp, and "
    "expose longer; the filter holds back all other light"
)

MANY_WRONG = 5
"""Corners that are named one by one; the page has all."""


def warnings(result: CameraCalibration, stated: SetupFile | None) -> Iterator[str]:
    """Yield what the user should know before trusting the values."""
    for name, reason in result.left_out.items():
        yield f"{name}: left out: {reason}"
    for wrong in result.wrong[:MANY_WRONG]:
        off_px = math.hypot(*wrong.residual_px.tolist())
        column, row = wrong.point_px.tolist()
        yield (
            f"{result.seen.names[wrong.view]}: corner {wrong.corner} at column {column:.1f}, row {row:.1f} "
            f"is {off_px:.2f} px off and left out"
        )
    if len(result.wrong) > MANY_WRONG:
        yield f"{len(result.wrong) - MANY_WRONG} more corners are off and left out; the page names them"
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
        yield f"{stated.path}: [camera] width, height: {before} before, {size[0]} x {size[1]} as the images"


def lines(result: CameraCalibration, images: BoardImages) -> Iterator[str]:
    """Yield the result, a line each."""
    shown, count = len(result.seen.names), len(images.views) + len(images.left_out)
    yield (
        f"{shown} of {count} images, {len(result.seen)} corners: {result.rms_px:.3f} px RMS; "
        f"noise of a corner {float(result.noise.sigma_px.mean()):.3f} px"
    )
    yield f"distortion: {result.order}"
    for row in parameter_rows(result):
        within = f"± {row.sigma}" if row.sigma else ""
        yield f"  {row.name:6} {row.value:>10} {within:<10} {row.unit}".rstrip()
    sigma = result.sigma_map()[1]
    yield (
        f"1 σ of the projection at {result.distance_mm:.0f} mm: {sigma.min():.3f} px at best, "
        f"{sigma.max():.3f} px at worst"
    )
    yield (
        f"halves of the images differ {result.ratio_of_halves:.2f} times as much as noise predicts, "
        f"{MOST_RATIO:g} at most"
    )
    if result.next_board is not None:
        yield f"one more image is worth most with the board {result.next_board.words}"
