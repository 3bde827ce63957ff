"""A calibration's values, rounded to what their sigmas warrant."""

from __future__ import annotations

from dataclasses import dataclass

from arctrack.report.calibration.page import with_sigma
from calibration.camera.calibrate import CameraCalibration

UNITS = {"fx": "px", "fy": "px", "cx": "px", "cy": "px", "tau_x": "rad", "tau_y": "rad"}
MEANINGS = {
    "fx": "focal length across the image",
    "fy": "focal length down the image",
    "cx": "principal point, column",
    "cy": "principal point, row",
    "p1": "tangential distortion",
    "p2": "tangential distortion",
    "tau_x": "tilt of the sensor about the image's horizontal",
    "tau_y": "tilt of the sensor about the image's vertical",
    "warp x": "the board's rise in its middle, bent along its columns",
    "warp y": "the board's rise in its middle, bent along its rows",
}


@dataclass(frozen=True)
class Row:
    """A parameter as people read it: value and sigma with two digits of the sigma."""

    name: str
    value: str
    sigma: str
    unit: str
    meaning: str


def parameter_rows(result: CameraCalibration) -> list[Row]:
    """Return the lens' parameters and the board's warp."""
    values = [*result.scene.lens.values, *result.scene.warp_mm]
    rows = []
    for name, value, sigma in zip(result.names, values, result.sigma, strict=True):
        label = name.removesuffix("_mm").replace("warp_", "warp ")
        unit = "mm" if name.endswith("_mm") else UNITS.get(name, "")
        meaning = MEANINGS.get(label, "radial distortion")
        rows.append(Row(label, *with_sigma(value, sigma), unit, meaning))
    if result.print_sigma_mm > 0.0:
        print_mm = f"{result.print_sigma_mm:.4f}"
        rows.append(Row("print", print_mm, "", "mm", "how far corners are off on the board as printed, 1 σ"))
    return rows
