"""HALCON's camera parameters as text, in metres, and its distortions.

The file is that of `read_cam_par`, the models are those of the chapter Calibration of its reference manual.
Both distortions map the distorted image to the rays: OpenCV's, which go the other way, are fitted to them.
"""

import numpy as np

from arctrack.calibrate.exchange.lens_file import LensFile, fitted_lens
from arctrack.calibrate.exchange.stated_keys import StatedKeys
from noise_model.compiled.arrays import Float64

OTHERS = {
    "Magnification": "a telecentric lens is no pinhole",
    "Tilt": "a tilted lens has other parameters in OpenCV",
    "Vx": "a line camera is no area camera",
    "Vy": "a line camera is no area camera",
}
"""Parameters of HALCON's cameras that a setup cannot hold."""


def halcon_lens(keys: StatedKeys) -> LensFile:
    """Return the lens of HALCON's parameters of an area camera, by the division or the polynomial model."""
    for name, problem in OTHERS.items():
        if name in keys:
            keys.refuse(name, f"{problem}; calibrate it with `arctrack calibrate camera`")
    focus_m, sx_m, sy_m = keys.number("Focus"), keys.number("Sx"), keys.number("Sy")
    for name, value in (("Focus", focus_m), ("Sx", sx_m), ("Sy", sy_m)):
        if value <= 0.0:
            keys.refuse(name, "must be above 0, in m; a telecentric lens, of Focus 0, is no pinhole")
    size = keys.whole("ImageWidth"), keys.whole("ImageHeight")
    pinhole = focus_m / sx_m, focus_m / sy_m, keys.number("Cx"), keys.number("Cy")
    if "Poly1" not in keys:
        kappa = keys.number("Kappa") * focus_m**2
        if kappa == 0.0:
            return LensFile("HALCON", size, pinhole)

        def without_division(slopes: Float64) -> Float64:
            below = 1.0 + kappa * (slopes**2).sum(axis=1, keepdims=True)
            return np.where(below > 0.0, slopes / below, np.nan)

        return fitted_lens("HALCON", size, pinhole, without_division, "division")
    k1, k2, k3, p1, p2 = (keys.number(f"Poly{n}") for n in range(1, 6))

    def without_polynomial(slopes: Float64) -> Float64:
        x, y = focus_m * slopes.T
        r2 = x**2 + y**2
        radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
        return (
            np.column_stack(
                [
                    x * radial + p1 * (r2 + 2.0 * x**2) + 2.0 * p2 * x * y,
                    y * radial + p2 * (r2 + 2.0 * y**2) + 2.0 * p1 * x * y,
                ]
            )
            / focus_m
        )

    return fitted_lens("HALCON", size, pinhole, without_polynomial, "polynomial")
