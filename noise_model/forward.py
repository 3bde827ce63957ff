"""The forward model of a frame: mean and variance of what the sensor says, for setup, pose and condition.

Light goes source, illumination, surface, medium, optics, sensor; at each stage the effects of `setup.effects`
act. What geometry, source and surface make of a pose is rendered once and remembered (`Renderer`): what
changes only the image does not render it again.
"""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TypeVar

import numpy as np

from noise_model.arc.map import arc_at, arc_frame, arc_kernel
from noise_model.arc.scene import Scene
from noise_model.compiled.arrays import Bool, Float32, Float64, Int32, Int64, Integers
from noise_model.condition import Condition
from noise_model.effects import acting, apply_condition_effects, apply_setup_effects
from noise_model.effects.effect import Draw
from noise_model.effects.light import Light
from noise_model.instrument.camera import Rays, blur, blur_inner
from noise_model.instrument.sensor import expose, respond_moments, saturation_dn
from noise_model.setup import Setup
from noise_model.stripe import crossed_by_borders, stripe_reference
from noise_model.surface.joint import NOMINAL_SEAM, Seam, SeamLine
from noise_model.view import View

FILL_TOLERANCE, FILL_FLOOR, FILL_SAMPLE = 3e-4, 1e-4, 101
"""Tolerance of a frame's arc map: of its light, of its brightest light, and the stride that finds that.

That is as closely as the pixels' own integrals are taken.
"""

FILL_PIXELS = 4000
"""Number of pixels that take as long one by one as the filling of one stretch's box."""

WITHIN_PIXEL_PX: Float64 = np.array([(i + 0.5, 7 * i % 16 + 0.5) for i in range(16)]) / 16.0 - 0.5
"""Points (16, 2) of a pixel, px off its centre, each in a row and a column of its own: a lattice rule."""

REMEMBERED = 4
"""Default number of poses that a renderer remembers."""


Cached = TypeVar("Cached")


@dataclass(frozen=True, eq=False)
class Prediction:
    """Expected mean and variance of the pixels of a frame.

    Attributes
    ----------
    mean_e : array (...,)
        The mean charge, e-.
    variance_e2 : array (...,)
        The charge's variance, e-^2: shot noise, read noise and the effects' own scatter.
    mean_dn : array (...,)
        The mean grey level, DN, after response, full well and quantisation.
    variance_dn2 : array (...,)
        The grey level's variance, DN^2.
    saturated : array (...,)
        Whether the mean lies at the end of the scale.
    modes_e : dict
        Charges (...,), e-, by name. The pixels of one mode go up and down together, by one number of unit
        variance a frame. `variance_e2` does not hold them.
    """

    mean_e: Float32
    variance_e2: Float32
    mean_dn: Float64
    variance_dn2: Float64
    saturated: Bool
    modes_e: dict[str, Float32]


@dataclass(frozen=True, eq=False)
class Layers:
    """Light of a pose before any effect acts on the image, rendered when first needed.

    In `bent` each pixel looks at its own stretch of the seam; in `view`, which effects read, all look at the
    middle one. Along a straight seam they are the same.
    """

    view: View
    bent: View

    @cached_property
    def arc_e(self) -> Float32:
        """The arc's light (...,), e- for `camera.exposure_s`, at its nominal output; 0 past the workpiece."""
        bent = self.bent
        if not bent.is_frame or bent.which.size < FILL_PIXELS * len(bent.scenes):
            return bent.arc_e()
        light = np.empty(bent.which.size, dtype=np.float32)
        for n in np.unique(bent.which).tolist():
            pixels = np.flatnonzero(bent.which == n)
            light[pixels] = _filled(bent, bent.scenes[n], pixels)
        return light.reshape(bent.shape)

    @cached_property
    def laser_e(self) -> Float32:
        """The laser stripe (...,), e- for `camera.exposure_s`, at its nominal output.

        In a whole frame a pixel that an edge or a shadow's border crosses has the mean across it: such
        shares tell where a stripe ends. The point-spread function, which holds the pixel's aperture, comes on
        top: an edge is somewhat softer than it should be, 0.74 px for 0.7.
        """
        bent, setup = self.bent, self.bent.setup
        unit_e = setup.laser.peak_e / stripe_reference(setup)
        light = bent.laser_e(unit_e)
        if not bent.is_frame:
            return light
        across = crossed_by_borders(bent.faces, bent.sheet).reshape(-1, 2)
        crossed = np.flatnonzero(across.any(axis=1))
        offsets_px = WITHIN_PIXEL_PX * across[crossed, np.newaxis]
        around = bent.around(crossed, bent.rays.uv_px.reshape(-1, 1, 2)[crossed] + offsets_px)
        light.reshape(-1)[crossed] = around.laser_e(unit_e).mean(axis=1)
        return light

    @property
    def faces(self) -> Int32:
        """The face that each pixel (...,) shows, `ray_casting.MISS` past the workpiece."""
        return self.bent.faces


def _filled(frame: View, scene: Scene, pixels: Integers) -> Float32:
    """Return the arc's light (n,) of some pixels of a whole frame in a scene.

    The box about them is filled.
    """
    kernel = arc_kernel(frame.setup, scene)
    rays, xy, cos4 = frame.rays, frame.rays.flat.xy, frame.rays.flat.cos4
    some_e, _ = arc_at(kernel, xy, cos4, np.arange(0, cos4.size, FILL_SAMPLE))
    floor_e = FILL_FLOOR * float(np.nan_to_num(some_e).max())
    rows, columns = np.divmod(pixels, frame.shape[1])
    first = rows.min(), columns.min()
    box = tuple(slice(low, places.max() + 1) for low, places in zip(first, (rows, columns), strict=True))
    xy, cos4 = np.ascontiguousarray(rays.xy[box].reshape(-1, 2)), rays.cos4[box].ravel()
    shape = rays.cos4[box].shape
    filled = arc_frame(kernel, xy, cos4, (shape[0], shape[1]), FILL_TOLERANCE, floor_e)
    # A polynomial through what is dark may swing below.
    light: Float32 = np.maximum(np.nan_to_num(filled[rows - first[0], columns - first[1]]), np.float32(0.0))
    return light


class Renderer:
    """Renders a pose's light, and remembers that of the last poses.

    Parameters
    ----------
    remembered : int
        How many poses it remembers.
    """

    def __init__(self, remembered: int = REMEMBERED) -> None:
        self._remembered = remembered
        self._rays: OrderedDict[tuple[object, ...], Rays] = OrderedDict()
        self._layers: OrderedDict[tuple[object, ...], Layers] = OrderedDict()

    def layers(
        self, setup: Setup, T_base_tool: Float64, seam: Seam = NOMINAL_SEAM, pixels: Integers | None = None
    ) -> Layers:
        """Return the layers of a pose; `setup` is what is really there (`effects.apply_setup_effects`)."""
        of_pixels = None if pixels is None else np.asarray(pixels).tobytes()
        key = (*_rendered_with(setup), T_base_tool.tobytes(), seam, of_pixels)
        if key not in self._layers:
            layers = look(setup, T_base_tool, seam, self._rays_of(setup), pixels)
            _remember(self._layers, key, layers, self._remembered)
        self._layers.move_to_end(key)
        return self._layers[key]

    def _rays_of(self, setup: Setup) -> Rays:
        key = setup.camera.geometry
        if key not in self._rays:
            _remember(self._rays, key, Rays.of(setup.camera), self._remembered)
        return self._rays[key]


def look(
    setup: Setup,
    T_base_tool: Float64,
    seam: Seam,
    rays: Rays,
    pixels: Integers | None = None,
    stretch: Int64 | None = None,
) -> Layers:
    """Return the layers of a pose; `setup` is what is really there, `rays` are its camera's.

    `stretch` (n,) is each pixel's stretch of a bent seam, see `View.along`.
    """
    if isinstance(seam, SeamLine):
        view = View.of(setup, T_base_tool, seam, rays, pixels)
        return Layers(view, view)
    view = View.of(setup, T_base_tool, seam.middle, rays, pixels, ground=seam.ground)
    if stretch is None:
        # What effects ask of the middle stretch is traced once.
        stretch = seam.stretch_at(view.surface[0][..., 0].ravel())
    return Layers(view, View.along(setup, [T_base_tool], [seam], view.which, view.rays, stretch))


def _remember(
    cache: OrderedDict[tuple[object, ...], Cached], key: tuple[object, ...], value: Cached, max_size: int
) -> None:
    cache[key] = value
    while len(cache) > max_size:
        cache.popitem(last=False)


def _rendered_with(setup: Setup) -> tuple[object, ...]:
    """Return all of a setup that a pose's layers depend on, to compare by."""
    joint = setup.joint
    return (
        setup.camera.geometry,
        setup.camera.T_tool_camera.tobytes(),
        setup.filter,
        setup.laser,
        setup.arc,
        setup.material,
        (joint.type, *sorted(joint.dimensions.items()), joint.seam_in_base_mm, joint.surface_normal_in_base),
        joint.surface_normals_in_base,
        joint.station_origin_mm,
        joint.section_mm,
    )


def predict(
    setup: Setup,
    T_base_tool: Float64,
    condition: Condition,
    *,
    seam: Seam = NOMINAL_SEAM,
    renderer: Renderer | None = None,
    pixels: Integers | None = None,
    rng: Draw = None,
) -> Prediction:
    """Return mean and variance of a frame, or of some pixels of it.

    Pixels that look past the workpiece are dark. Some pixels alone are predicted at their centres, without
    point-spread function and blooming. Light that spreads over the image then comes from their own mean: take
    an even sample.

    Parameters
    ----------
    setup : Setup
        The nominal setup, with the effects that act.
    T_base_tool : array (4, 4)
        The tool's pose, mm.
    condition : Condition
        The frame's condition.
    seam : SeamLine or BentSeam
        Where the true seam runs relative to its nominal line, mm.
    renderer : Renderer, optional
        Remembers what was rendered.
    pixels : array (n,), optional
        Indices into the flattened image; by default all of it.
    rng : numpy.random.Generator, optional
        Draws the random effects, which then add nothing to the variance.

    Returns
    -------
    Prediction
        Its arrays are (H, W), or (n,) for some pixels.

    Raises
    ------
    ValueError
        For a pose whose camera stands below the surface, and for effects that cannot be.
    """
    true, light = _light(setup, T_base_tool, condition, seam, renderer, pixels, rng)
    mean_e = light.total
    variance_e2 = np.maximum(mean_e, 0.0) + light.variance_e2 + np.float32(true.sensor.read_noise_e**2)
    mean_dn, variance_dn2 = respond_moments(mean_e, variance_e2, true.sensor)
    for effect, values in acting(true):
        if effect.codes_variance is not None:
            variance_dn2 = effect.codes_variance(mean_dn, variance_dn2, true.sensor, values)
    saturated = mean_dn >= saturation_dn(true.sensor) - 0.5
    return Prediction(mean_e, variance_e2, mean_dn, variance_dn2, saturated, light.modes)


def draw_frame(
    setup: Setup,
    T_base_tool: Float64,
    condition: Condition,
    rng: np.random.Generator,
    *,
    seam: Seam = NOMINAL_SEAM,
    renderer: Renderer | None = None,
    part_seed: int | None = None,
) -> Integers:
    """Draw one frame at random: random effects, shot noise, read noise, response.

    Parameters
    ----------
    setup : Setup
        The nominal setup, with the effects that act.
    T_base_tool : array (4, 4)
        The tool's pose, mm.
    condition : Condition
        The frame's condition.
    rng : numpy.random.Generator
        Where the noise comes from.
    seam : SeamLine or BentSeam
        Where the true seam runs relative to its nominal line, mm.
    renderer : Renderer, optional
        Remembers what was rendered.
    part_seed : int, optional
        Which part it is: the pattern on its metal stays where it is from frame to frame. By default each
        frame shows another part.

    Returns
    -------
    array (H, W)
        Grey levels, DN, in the sensor's type.

    Raises
    ------
    ValueError
        For a pose whose camera stands below the surface, and for effects that cannot be.
    """
    true, light = _light(
        setup=setup,
        T_base_tool=T_base_tool,
        condition=condition,
        seam=seam,
        renderer=renderer,
        pixels=None,
        rng=rng,
        part_seed=part_seed,
    )
    image_dn = expose(light.total.astype(np.float64), true.sensor, rng)
    for effect, values in acting(true):
        if effect.codes is not None:
            image_dn = effect.codes(image_dn, true.sensor, values)
    return image_dn


def _light(
    setup: Setup,
    T_base_tool: Float64,
    condition: Condition,
    seam: Seam,
    renderer: Renderer | None,
    pixels: Integers | None,
    rng: Draw,
    part_seed: int | None = None,
) -> tuple[Setup, Light]:
    """Return the setup that is really there and the charge (...,) that reaches the pixels."""
    true = apply_setup_effects(setup)
    condition = apply_condition_effects(true, condition)
    layers = (renderer or Renderer()).layers(true, T_base_tool, seam, pixels)
    if layers.view.scene.below_surface:
        raise ValueError("the camera stands below the surface at this pose")
    dark = np.zeros(layers.view.shape, dtype=np.float32)
    light = Light.of(
        np.float32(condition.arc_level) * layers.arc_e if condition.arc_level > 0.0 else dark,
        np.float32(condition.laser_level) * layers.laser_e if condition.laser_level > 0.0 else dark,
    )
    # The remembered view may be another setup's that renders equally, with another sensor or lens.
    pass_on(true, light, replace(layers.view, setup=true, part_seed=part_seed), condition, rng)
    return true, light


def pass_on(true: Setup, light: Light, view: View, condition: Condition, rng: Draw = None) -> None:
    """Let light go through the effects, the lens' point-spread function and the exposure, in their order.

    `true` and `condition` are what is really there; `light` is e- for `camera.exposure_s` and becomes that of
    the condition's exposure. `rng` draws the random effects, without it they add to the variance.
    """
    effects = tuple(acting(true))
    for effect, values in effects:
        if effect.light is not None:
            effect.light(light, view, condition, values, rng)
    if view.is_frame:
        light.pass_through(lambda image: blur(image, true.camera.psf_sigma_px))
    elif view.inner is not None:
        inner, around = view.inner
        light.pass_through(lambda values: blur_inner(values, inner, around, true.camera.psf_sigma_px))
    light.scale(condition.exposure_s / true.camera.exposure_s)
    for effect, values in effects:
        if effect.image is not None:
            effect.image(light, view, condition, values, rng)
