"""camera.html: the values, what they rest on, and where to hold the board next."""

from __future__ import annotations

from pathlib import Path

from arctrack.calibration_files.board_images import BoardImages
from arctrack.output import write_whole
from arctrack.report import embedded
from arctrack.report.camera import pictures
from arctrack.report.camera.numbers import parameter_rows
from arctrack.report.template import environment
from calibration.camera.calibrate import CameraCalibration
from calibration.camera.enough import cover, empty_parts
from calibration.camera.halves import MOST_RATIO

TEMPLATE = "camera.html.j2"


def write_page(path: Path, result: CameraCalibration, images: BoardImages) -> None:
    """Write the page to a file; ArctrackError if it cannot be written."""
    write_whole(path, page(result, images))


def page(result: CameraCalibration, images: BoardImages) -> str:
    """Return the page, which needs no other file and no network."""
    sigma = result.sigma_map()[1]
    lens = result.scene.lens
    drawn = {
        "coverage": pictures.coverage(result, images.sample),
        "residuals": pictures.residuals(result),
        "sigma": pictures.sigma_map(result),
        "halves": pictures.halves(result),
        "warp": pictures.warp(result),
        "noise": pictures.noise(result),
        **({"orders": pictures.orders(result)} if len(result.held) > 1 else {}),
    }
    return (
        environment()
        .get_template(TEMPLATE)
        .render(
            result=result,
            images=images,
            left_out={**images.left_out, **result.left_out},
            rows=parameter_rows(result),
            best_px=float(sigma.min()),
            worst_px=float(sigma.max()),
            cover=cover(lens, result.seen),
            empty=empty_parts(lens, result.seen),
            most_ratio=MOST_RATIO,
            pictures={name: embedded.svg(figure) for name, figure in drawn.items()},
        )
    )
