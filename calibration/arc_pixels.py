"""The pixels of a frame in which the arc's light is compared with the model's.

They lie on a lattice over the image, off the stripe, off saturation and off the edges of the joint's faces:
what changes by a jump has no derivative. Each keeps the face and the stretch of the seam that it was chosen
for.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from noise_model.arc.scene import make_scene
from noise_model.compiled.arrays import Bool, Float64, Int64, Integers
from noise_model.condition import Condition
from noise_model.effects import apply_condition_effects, apply_setup_effects
from noise_model.effects.light import Light
from noise_model.forward import Layers, look, pass_on
from noise_model.instrument.camera import Rays
from noise_model.setup import Setup
from noise_model.surface.joint import BentSeam, SeamLine
from noise_model.surface.ray_casting import MISS
from noise_model.transforms import transform
from noise_model.view import View
from tracker.geometry import SensorGeometry
from tracker.seam.curve import SeamCurve
from tracker.state import Frame
from tracker.stripe.expected import expect_stripe

ACROSS = 26
"""Number of compared pixels in a row of the image."""

KEEP_OFF_SIGMAS = 5.0
"""Least distance of a pixel from the stripe, in the stripe's sigmas."""

EDGE_PX, MAX_CHANGE = 8, 0.3
"""A pixel counts if so far to each side the same face is seen and the light changes by a smaller share."""


@dataclass(frozen=True, eq=False)
class ArcPixels:
    """A frame's lattice (n,) of pixels, and those of it that are compared (k,).

    `pixels` are indices into the flattened image, an even sample of it; `stretch` and `faces` (n,) say which
    stretch of the seam and which face each shows; `compared` (n,). `charge_e` (k,) is what they hold,
    `place` (k, 2) where they lie as (u, v), from the image's middle in half widths. The stretches' stations
    and the torch's are in `stretches_mm` and `torch_mm`.
    """

    frame: Frame
    T_base_tool: Float64
    stretches_mm: tuple[float, ...]
    torch_mm: float
    pixels: Int64
    stretch: Int64
    faces: Integers
    compared: Bool
    charge_e: Float64
    place: Float64

    @classmethod
    def of(
        cls,
        geometry: SensorGeometry,
        rays: Rays,
        curve: SeamCurve,
        coefficients: Float64,
        frame: Frame,
        T_base_tool: Float64,
    ) -> ArcPixels:
        """Choose the pixels of a frame, the seam as a curve's coefficients (m,) say."""
        setup = geometry.setup
        first_mm, last_mm, torch_mm = make_scene(setup, T_base_tool).stations_mm
        seam = curve.bent(coefficients, first_mm, last_mm, torch_mm)
        height, width = rays.cos4.shape
        step_px = max(1, round(width / ACROSS))
        v, u = (
            axis.ravel() for axis in np.mgrid[step_px // 2 : height : step_px, step_px // 2 : width : step_px]
        )
        pixels = v * width + u
        seen = View.of(setup, T_base_tool, seam.middle, rays, pixels, ground=seam.ground)
        stretch = seam.stretch_at(seen.surface[0][:, 0])
        here = look(setup, T_base_tool, seam, rays, pixels, stretch)
        compared = (here.faces != MISS) & (frame.image_dn[v, u] < geometry.saturation_dn)
        for dv, du in ((EDGE_PX, 0), (-EDGE_PX, 0), (0, EDGE_PX), (0, -EDGE_PX)):
            neighbour = np.clip(v + dv, 0, height - 1) * width + np.clip(u + du, 0, width - 1)
            there = look(setup, T_base_tool, seam, rays, neighbour)
            compared &= there.faces == here.faces
            compared &= np.abs(there.arc_e - here.arc_e) <= MAX_CHANGE * here.arc_e
        if frame.laser_on:
            station_mm = transform(make_scene(setup, T_base_tool).T_joint_tool, setup.laser.point_mm)[0]
            line = curve.tangents(coefficients)(float(station_mm))
            compared &= off_stripe(geometry, T_base_tool, line, (u, v), KEEP_OFF_SIGMAS)
        charge_e = geometry.charge_e[frame.image_dn[v, u]].astype(np.float64)
        place = (np.column_stack([u, v]) - 0.5 * np.array([width, height])) / (0.5 * width)
        return cls(
            frame=frame,
            T_base_tool=T_base_tool,
            stretches_mm=tuple(line.station_mm for line in seam.lines),
            torch_mm=torch_mm,
            pixels=pixels,
            stretch=stretch,
            faces=here.faces,
            compared=compared,
            charge_e=charge_e[compared],
            place=place[compared],
        )

    def light(
        self, setup: Setup, rays: Rays, curve: SeamCurve, coefficients: Float64
    ) -> tuple[Float64, Float64]:
        """Return the arc's light and the other light (k,), e-, that a setup and a seam let expect.

        The arc's is NaN of a pixel that sees another face.
        """
        true = apply_setup_effects(setup)
        tangent_at = curve.tangents(coefficients)
        ground = tangent_at(self.torch_mm)._replace(slope_y=0.0, slope_z=0.0)
        seam = BentSeam(tuple(tangent_at(station) for station in self.stretches_mm), ground)
        seen = look(true, self.T_base_tool, seam, rays, self.pixels, self.stretch)
        light = arc_light(true, self.frame, seen)
        arc_e = np.where(seen.faces == self.faces, light.arc, np.nan)[self.compared]
        return arc_e.astype(np.float64), light.other[self.compared].astype(np.float64)


def arc_light(true: Setup, frame: Frame, layers: Layers) -> Light:
    """Return the light of a frame's pixels with the laser off, after effects, lens and exposure."""
    light = Light.of(layers.arc_e.copy(), np.zeros_like(layers.arc_e))
    current_a = frame.current_a if math.isfinite(frame.current_a) else true.arc.current_a
    stated = Condition.of(true, laser_on=False, arc_on=True, current_a=current_a, exposure_s=frame.exposure_s)
    condition = apply_condition_effects(true, stated)
    light.arc *= np.float32(condition.arc_level)
    pass_on(true, light, layers.view, condition)
    return light


def off_stripe(
    geometry: SensorGeometry, T_base_tool: Float64, seam: SeamLine, uv_px: tuple[Int64, Int64], sigmas: float
) -> Bool:
    """Return the mask (n,) of pixels farther than some of its sigmas from the stripe."""
    stripe = expect_stripe(geometry, make_scene(geometry.setup, T_base_tool, seam))
    if stripe is None:
        return np.ones(len(uv_px[0]), dtype=np.bool_)
    scan, position = uv_px if geometry.along_rows else uv_px[::-1]
    return np.asarray(np.abs(position - stripe.position_px[scan]) > sigmas * stripe.sigma_px[scan])
