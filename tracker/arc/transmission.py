"""The arc's light on its way to the pixels that the tracker looks at, through the setup's effects."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from noise_model.arc.scene import Scene
from noise_model.compiled.arrays import Float32, Int64
from noise_model.condition import Condition
from noise_model.effects import apply_condition_effects
from noise_model.effects.light import Light
from noise_model.forward import pass_on
from noise_model.instrument.camera import Rays
from noise_model.view import View
from tracker.geometry import SensorGeometry

ArcLight = Callable[[Int64], Float32]
"""The arc's light (n,), e-, at pixels (n,) by scan line, NaN past the workpiece."""


@dataclass(frozen=True, eq=False)
class Transmission:
    """Effects of a frame on the arc's light.

    `even` are the pixels (n,) of an even sample, by scan line, which light that spreads over the image is
    taken from, `even_arc_e` (n,) the arc's light there.
    """

    geometry: SensorGeometry
    scene: Scene
    condition: Condition
    even: Int64
    even_arc_e: Float32

    @classmethod
    def of(cls, geometry: SensorGeometry, scene: Scene, light: ArcLight, output: float) -> Transmission:
        """Return the transmission of a frame.

        `light` is the arc's at its expected output, which counts the exposure over the nominal one; `output`
        is that, or 0 if the arc is said to be off: metal glows less then. What drifts with time are laser and
        exposure: neither matters here.
        """
        setup = geometry.setup
        stated = Condition(0.0, output, setup.camera.exposure_s)
        # The exposure is in the output already, and the arc's own level is measured in each frame.
        condition = replace(apply_condition_effects(setup, stated), exposure_s=setup.camera.exposure_s)
        scan, position = geometry.even_sample
        even = scan * geometry.n_pos + position
        return cls(geometry, scene, condition, even, np.nan_to_num(light(even)))

    def through(self, pixels: Int64, arc_e: Float32) -> tuple[Float32, Float32]:
        """Return the light that arrives at some pixels (n,), by scan line: the arc's and all other.

        `arc_e` (n,) is the arc's light before, NaN where a pixel looks past the workpiece, and stays so.
        """
        geometry = self.geometry
        both = np.concatenate([self.even, pixels])
        scan, position = np.divmod(both, geometry.n_pos)
        uv = geometry.image_points(scan.astype(np.float64), position.astype(np.float64))
        rays = Rays(uv.astype(np.float32), geometry.xy[both], geometry.cos4[both])
        view = View.of_scene(geometry.setup, self.scene, rays, n_even=len(self.even))
        before = np.concatenate([self.even_arc_e, np.nan_to_num(arc_e)])
        light = Light.of(before, np.zeros_like(before))
        pass_on(geometry.setup, light, view, self.condition)
        arrived, other = (image[len(self.even) :] for image in (light.arc, light.other))
        return np.where(np.isfinite(arc_e), arrived, np.float32(np.nan)), other


NO_LIGHT = np.empty(0, np.float32)


def seen_arc(light: ArcLight, transmission: Transmission | None, pixels: Int64) -> tuple[Float32, Float32]:
    """Return the arc's light (n,) and the other light (n,), e-, at some pixels (n,), by scan line.

    NaN where a pixel looks past the workpiece. Without a `transmission` light stays as it is, and of other
    light, an empty array, there is none.
    """
    arc_e = light(pixels)
    return (arc_e, NO_LIGHT) if transmission is None else transmission.through(pixels, arc_e)
