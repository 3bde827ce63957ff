"""The arc's light over a whole image, as the tracker predicts it for a stripe's band."""

import math

import numpy as np

from noise_model.arc.map import ArcKernel, arc_frame
from noise_model.compiled.arrays import Float32
from tracker.arc.level import ArcLevel
from tracker.arc.transmission import Transmission
from tracker.geometry import SensorGeometry


def arc_light(
    geometry: SensorGeometry, kernel: ArcKernel, transmission: Transmission | None, arc: ArcLevel
) -> tuple[Float32, Float32]:
    """Return the arc's light at its level, and all that is in the image without the laser, e-.

    Both are by scan line, (n_scan, n_pos); an unknown level counts as 1. NaN past the workpiece.
    """
    shape = (geometry.n_scan, geometry.n_pos)
    level = arc.level if math.isfinite(arc.level) else 1.0
    arc_e = arc_frame(kernel, geometry.xy, geometry.cos4, shape)
    other_e = np.zeros_like(arc_e)
    if transmission is not None:
        through = transmission.through(np.arange(arc_e.size), arc_e.ravel())
        arc_e, other_e = (light.reshape(shape) for light in through)
    arc_e = np.float32(level) * arc_e
    return arc_e, arc_e + other_e + np.float32(arc.black_e)
