"""The forward model of a frame: mean and variance of what the sensor says, for setup, pose and condition.

Light goes source, illumination, surface, medium, optics, sensor; at each stage the effects of `setup.effects`
act. What geometry, source and surface make of a pose is rendered once and remembered (`Renderer`): what
changes only the image does not render it again.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TypeVar

import numpy as np
import numpy.typing as npt

from noise_model.arc.map import Scene, arc_at, arc_frame, arc_kernel, make_scenes
from noise_model.arrays import Bool, Float32, Float64, Int64, Integers
from noise_model.condition import Condition
from noise_model.effects import acting, apply_condition_effects, apply_setup_effects
from noise_model.effects.effect import Draw
from noise_model.effects.light import Light
from noise_model.instrument.camera import Rays, blur, blur_inner
from noise_model.instrument.sensor import expose, respond_moments, saturation_dn
from noise_model.setup import Setup
from noise_model.stripe import SheetSeen, crossed_by_borders, sheet_seen, stripe_light, stripe_reference
from noise_model.surface.brdf import lobe_numbers
from noise_model.surface.joint import NOMINAL_SEAM, Seam, SeamLine
from noise_model.surface.ray_casting import MISS
from noise_model.view import View

FILL_TOLERANCE, FILL_FLOOR, FILL_SAMPLE = 3e-4, 1e-4, 101
"""How closely a whole frame's arc map is filled: of its light, and of the brightest of every so many pixels.

That is as closely as the pixels' own integrals are taken.
"""

WITHIN_PIXEL_PX: Float64 = np.array([(i + 0.5, 7 * i % 16 + 0.5) for i in range(16)]) / 16.0 - 0.5
"""Points (16, 2) of a pixel, px off its centre, each in a row and a column of its own: a lattice rule."""

REMEMBERED = 4
"""How many poses a renderer remembers if it is not told otherwise."""


Kept = TypeVar("Kept")

Number = TypeVar("Number", np.float32, np.int32, np.bool_)


@dataclass(frozen=True, eq=False)
class Prediction:
    """What is expected of the pixels of a frame.

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
    """What a pose shows before any effect acts on the image, rendered when first asked for.

    Of a bent seam `view` is that of its middle stretch, and `stretches` are views of some pixels each, with
    their places in the flattened image.
    """

    view: View
    stretches: tuple[tuple[Integers, View], ...] = ()

    def with_metal(self, setup: Setup) -> Layers:
        """Return the layers of a setup that differs by its metal alone.

        Both share what their views keep: where rays end, what the laser reaches, the arc as the surface sees
        it. Nothing that is rendered here keeps what depends on the metal.
        """
        if setup is self.view.setup:
            return self
        return Layers(
            replace(self.view, setup=setup),
            tuple((pixels, replace(view, setup=setup)) for pixels, view in self.stretches),
        )

    @cached_property
    def arc_e(self) -> Float32:
        """The arc's light (...,), e- for `camera.exposure_s`, at its nominal output; 0 past the workpiece."""
        if not self.view.is_frame:
            return self.arc_e_in(np.ones(self.view.cos4.size, dtype=np.bool_)).reshape(self.view.shape)
        if not self.stretches:
            return _filled(self.view, self.view.scene, np.arange(self.view.cos4.size)).reshape(
                self.view.shape
            )
        return self._assembled(
            [(pixels, _filled(self.view, view.scene, pixels)) for pixels, view in self.stretches]
        )

    def arc_e_in(self, chosen: Bool) -> Float32:
        """Return the arc's light, as `arc_e`, of chosen ones (n,) of some pixels alone: (k,)."""
        light = np.zeros(chosen.size, dtype=np.float32)
        for pixels, view in self.stretches or ((np.arange(chosen.size), self.view),):
            mine = np.flatnonzero(chosen[pixels])
            light[pixels[mine]] = _arc_light(view, mine)
        return light[chosen]

    @cached_property
    def laser_e(self) -> Float32:
        """The laser stripe (...,), e- for `camera.exposure_s`, at its nominal output.

        In a whole frame a pixel that an edge or a shadow's border crosses has the mean across it: such
        shares tell where a stripe ends. The point-spread function, which holds the pixel's aperture, comes on
        top: an edge is somewhat softer than it should be, 0.74 px for 0.7.
        """
        setup = self.view.setup
        unit_e = setup.laser.peak_e / stripe_reference(setup)
        light = self._of_stretches(lambda view: stripe_light(view, unit_e))
        if not self.view.is_frame:
            return light
        sheet = SheetSeen(
            self._of_stretches(lambda view: sheet_seen(view).near),
            self._of_stretches(lambda view: sheet_seen(view).shaded),
        )
        across = crossed_by_borders(self.faces, sheet).reshape(-1, 2)
        for pixels, view in self.stretches or ((np.arange(light.size), self.view),):
            mine = np.flatnonzero(across[pixels].any(axis=1))
            offsets_px = WITHIN_PIXEL_PX * across[pixels[mine], np.newaxis]
            light.reshape(-1)[pixels[mine]] = stripe_light(view.about(mine, offsets_px), unit_e).mean(axis=1)
        return light

    @cached_property
    def faces(self) -> Integers:
        """The face that each pixel (...,) shows, `ray_casting.MISS` past the workpiece."""
        return self._of_stretches(lambda view: view.surface[2])

    def _of_stretches(self, render: Callable[[View], npt.NDArray[Number]]) -> npt.NDArray[Number]:
        if not self.stretches:
            return render(self.view)
        return self._assembled([(pixels, render(view)) for pixels, view in self.stretches])

    def _assembled(self, parts: Sequence[tuple[Integers, npt.NDArray[Number]]]) -> npt.NDArray[Number]:
        # Each pixel shows one of the stretches.
        image = np.empty(self.view.cos4.size, dtype=parts[0][1].dtype)
        for pixels, part in parts:
            image[pixels] = part
        return image.reshape(self.view.shape)


def _arc_light(view: View, pixels: Int64) -> Float32:
    """Return the arc's light in some of a view's pixels (k,)."""
    kept = view.keep("arc_kernel", lambda: arc_kernel(view.setup, view.scene))
    kernel = kept._replace(material=lobe_numbers(view.setup.material))
    xy = np.ascontiguousarray(view.xy.reshape(-1, 2))
    arc_e, faces = arc_at(kernel, xy, view.cos4.reshape(-1), pixels)
    arc_e[faces == MISS] = 0.0
    return arc_e


def _filled(frame: View, scene: Scene, pixels: Integers) -> Float32:
    """Return the arc's light (n,) of some pixels of a whole frame in a scene.

    The box about them is filled.
    """
    kernel = arc_kernel(frame.setup, scene)
    xy, cos4 = np.ascontiguousarray(frame.xy.reshape(-1, 2)), frame.cos4.reshape(-1)
    some_e, _ = arc_at(kernel, xy, cos4, np.arange(0, frame.cos4.size, FILL_SAMPLE))
    floor_e = FILL_FLOOR * float(np.nan_to_num(some_e).max())
    rows, columns = np.divmod(pixels, frame.shape[1])
    first = rows.min(), columns.min()
    box = tuple(slice(low, places.max() + 1) for low, places in zip(first, (rows, columns), strict=True))
    xy, cos4 = np.ascontiguousarray(frame.xy[box].reshape(-1, 2)), frame.cos4[box].ravel()
    shape = frame.cos4[box].shape
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
        self,
        setup: Setup,
        T_base_tool: Float64,
        seam: Seam = NOMINAL_SEAM,
        pixels: Integers | None = None,
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
    stretch: Integers | None = None,
) -> Layers:
    """Return the layers of a pose; `setup` is what is really there, `rays` are its camera's.

    `stretch` (n,) says which stretch of a bent seam each pixel shows, where that is not to be found anew:
    light is not quite steady from one to the next, and a small step's difference would show it.
    """
    if isinstance(seam, SeamLine):
        return Layers(View.of(setup, T_base_tool, seam, rays, pixels))
    view = View.of(setup, T_base_tool, seam.middle, rays, pixels, ground=seam.ground)
    if stretch is None:
        stretch = seam.stretch_at(view.surface[0][..., 0].reshape(-1))
    scenes = make_scenes(setup, T_base_tool, seam.lines, seam.ground)
    shown = [(np.flatnonzero(stretch == i), scene) for i, scene in enumerate(scenes)]
    return Layers(view, tuple((where, view.part(where, scene)) for where, scene in shown if len(where)))


def _remember(
    kept: OrderedDict[tuple[object, ...], Kept], key: tuple[object, ...], value: Kept, most: int
) -> None:
    kept[key] = value
    while len(kept) > most:
        kept.popitem(last=False)


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
        joint.station_origin_mm,
    )


def predict(
    setup: Setup,
    T_base_tool: Float64,
    condition: Condition,
    *,
    seam: Seam = NOMINAL_SEAM,
    renderer: Renderer | None = None,
    pixels: Integers | None = None,
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
        Where the true seam runs beside its nominal line, mm.
    renderer : Renderer, optional
        Remembers what was rendered.
    pixels : array (n,), optional
        Indices into the flattened image; by default all of it.

    Returns
    -------
    Prediction
        Its arrays are (H, W), or (n,) for some pixels.

    Raises
    ------
    ValueError
        For a pose whose camera stands below the surface, and for effects that cannot be.
    """
    true, light = _light(setup, T_base_tool, condition, seam, renderer, pixels, None)
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
        Where the true seam runs beside its nominal line, mm.
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
    true, light = _light(setup, T_base_tool, condition, seam, renderer, None, rng, part_seed)
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
    # The remembered view may be another setup's that renders alike, with another sensor or lens.
    pass_on(true, light, replace(layers.view, setup=true, part_seed=part_seed), condition, rng)
    return true, light


def pass_on(true: Setup, light: Light, view: View, condition: Condition, rng: Draw = None) -> None:
    """Let light go through the effects, the lens' point-spread function and the exposure, in their order.

    `true` and `condition` are what is really there; `light` is e- for `camera.exposure_s` and becomes that of
    the condition's exposure. `rng` draws the random effects, without it they add to the variance.
    """
    for effect, values in acting(true):
        if effect.light is not None:
            effect.light(light, view, condition, values, rng)
    if view.is_frame:
        light.pass_through(lambda image: blur(image, true.camera.psf_sigma_px))
    elif view.inner is not None:
        inner, around = view.inner
        light.pass_through(lambda values: blur_inner(values, inner, around, true.camera.psf_sigma_px))
    light.scale(condition.exposure_s / true.camera.exposure_s)
    for effect, values in acting(true):
        if effect.image is not None:
            effect.image(light, view, condition, values, rng)
