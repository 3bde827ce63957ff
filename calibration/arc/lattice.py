"""The pixels of a frame in which the arc's light is compared with the model's, and that light.

They lie on a lattice over the image, off the stripe, off saturation and off the edges of the joint's faces.
What a pixel holds is the mean over a block about it: noise is no matter there.
"""

from dataclasses import dataclass

import cv2
import numpy as np

from calibration.arc_pixels import EDGE_PX, MAX_CHANGE, arc_light, off_stripe
from noise_model.compiled.arrays import Bool, Float64, Int64
from noise_model.forward import Layers, look
from noise_model.instrument.camera import Rays
from noise_model.instrument.sensor import linearise, saturation_dn, variance_e2
from noise_model.setup import Setup
from noise_model.surface.joint import SeamLine
from noise_model.surface.ray_casting import MISS
from tracker.geometry import SensorGeometry
from tracker.state import Frame

ACROSS, BLOCK_PX = 24, 5
"""Number of compared pixels in a row of the image, and side of the block that each averages."""

KEEP_OFF_SIGMAS = 6.0
"""Least distance of a pixel from the stripe, in the stripe's sigmas."""


@dataclass(frozen=True, eq=False)
class PixelSample:
    """A frame's pixels (n,) that are compared.

    `uv_px` (n, 2) are their places, `charge_e` what they hold and `noise_e` its 1 sigma, e-, and `map_e` the
    light that the setup expected when they were chosen. `T_base_tool` (4, 4) is the frame's pose.
    """

    frame: Frame
    T_base_tool: Float64
    uv_px: Int64
    charge_e: Float64
    noise_e: Float64
    map_e: Float64


def choose_pixels(
    geometry: SensorGeometry, rays: Rays, frame: Frame, T_base_tool: Float64, seam: SeamLine
) -> PixelSample:
    """Choose the pixels of a frame, as a setup and a seam let expect its light."""
    true = geometry.setup
    height, width = true.camera.height, true.camera.width
    spacing = max(1, width // ACROSS)
    u, v = (
        grid.ravel()
        for grid in np.meshgrid(
            np.arange(EDGE_PX, width - EDGE_PX, spacing), np.arange(EDGE_PX, height - EDGE_PX, spacing)
        )
    )
    places = [(0, 0), (EDGE_PX, 0), (-EDGE_PX, 0), (0, EDGE_PX), (0, -EDGE_PX)]
    around = np.concatenate([np.column_stack([u + du, v + dv]) for du, dv in places])
    arc_e, layers = _light(true, rays, frame, T_base_tool, seam, around)
    arc_e, faces = arc_e.reshape(len(places), -1), layers.faces.reshape(len(places), -1)
    use = (faces == faces[0]).all(axis=0) & (faces[0] != MISS) & (arc_e[0] > 0.0)
    use &= (np.abs(arc_e - arc_e[0]) <= MAX_CHANGE * arc_e[0]).all(axis=0)
    use &= _block_means(frame.image_dn >= saturation_dn(true.sensor), u, v) == 0.0
    if frame.laser_on:
        use &= off_stripe(geometry, T_base_tool, seam, (u, v), KEEP_OFF_SIGMAS)
    charge_e = _block_means(linearise(frame.image_dn.astype(np.float64), true.sensor), u, v)[use]
    noise_e = np.sqrt(variance_e2(np.maximum(charge_e, 0.0), true.sensor)) / BLOCK_PX
    return PixelSample(frame, T_base_tool, np.column_stack([u, v])[use], charge_e, noise_e, arc_e[0][use])


def expected_light(true: Setup, rays: Rays, lattice: PixelSample, seam: SeamLine) -> Float64:
    """Return the arc's light (n,), e-, that a setup, effects applied, lets expect at a seam."""
    return _light(true, rays, lattice.frame, lattice.T_base_tool, seam, lattice.uv_px)[0]


def _light(
    true: Setup, rays: Rays, frame: Frame, T_base_tool: Float64, seam: SeamLine, uv_px: Int64
) -> tuple[Float64, Layers]:
    """Return the arc's light (n,), e-, at pixels (n, 2), and their layers."""
    layers = look(true, T_base_tool, seam, rays, uv_px[:, 1] * true.camera.width + uv_px[:, 0])
    return arc_light(true, frame, layers).arc.astype(np.float64), layers


def _block_means(image: Float64 | Bool, u: Int64, v: Int64) -> Float64:
    """Return the means of an image (H, W) over blocks about pixels (n,)."""
    return np.asarray(cv2.blur(image.astype(np.float64), (BLOCK_PX, BLOCK_PX))[v, u])
