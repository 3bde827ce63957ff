"""The forward model of all frames of a recording, linearized in the nuisances, and the residuals.

Frames are rendered and passed through the effects at an anchor, the nuisances of the last fit; from there the
bins that count are continued along the nuisances: levels multiply, the black level adds, and what moves
camera or seam by its tolerance changes light along its derivatives (`Tangents`). So a fit renders nothing but
what an effect itself moves.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import TypeVar

import cv2
import numpy as np

from noise_model.arrays import Float32, Float64, Int64
from noise_model.effects import REGISTRY, Effect, Stage, Values, apply_condition_effects, apply_setup_effects
from noise_model.effects.light import Light
from noise_model.forward import Layers, look, pass_on
from noise_model.instrument.camera import NARROW_PX, Camera, Rays
from noise_model.interreflection.model import BouncedLight, bounced_light
from noise_model.setup import Setup
from noise_model.surface.brdf import Material
from noise_model.surface.joint import BentSeam
from noise_model.view import View
from sim_to_real.data.binned import Observed, ObservedFrame, on_one_face
from sim_to_real.fit.frame_light import FrameLight, PredictedBins, Rendered, light_factor, nearest_rendered
from sim_to_real.fit.nuisances import N_CAMERA, N_LEVELS, SEAM_FROM, apply_levels, apply_nuisances, nuisances
from sim_to_real.fit.trend import Trend, effects_in_frame
from tracker.seam.curve import N_MODES, SeamCurve
from tracker.seam_observations import TRIANGULATION_EFFECTS

Effects = Mapping[str, Values]


Result = TypeVar("Result")

SEAM_STEPS = (("y_mm", 5e-4), ("z_mm", 5e-4), ("slope_y", 1.5e-5), ("slope_z", 1.5e-5))
"""Steps of the derivatives with a seam's place and direction.

Camera and seam can move so that the stripe hardly does: over 0.02 mm its curvature outweighed what is left,
and a corrugation's fit came nearer by a quarter of the way at a time.
"""

GROUND_STEP_MM = 5e-4
"""Step of the derivatives with the place of the seam under the arc."""

EDGE_SHARE, EDGE_E = 0.01, 2.0
"""An edge is what changes a bin's light over such a step by more than this share of it and so many e-."""

LIT_SHARE = 1e-3
"""Where the stated arc puts less than this share of its brightest light, it says nothing of another arc's."""

MIN_CHORD_DEVIATION_MM = 0.03
"""A seam that departs less from its chord is straight."""

MAX_SEAM_SIGMAS = 2.0
"""A fitted seam's bends are believed up to so many sigmas: a gap may have bent it."""

FOURTH, ONE = np.array([1.0, -4.0, 6.0, -4.0, 1.0], dtype=np.float32), np.ones(1, dtype=np.float32)
"""The taps of a fourth difference, and of none."""

N_CACHED = 8
"""So many renderings of a recording's frames are cached."""

RENDERED_EFFECTS = frozenset(
    name for name, effect in REGISTRY.items() if effect.setup is not None or effect.stage is Stage.TIMING
) - {"gamma", "black_level", "read_noise", "defocus"}
"""The effects that need a new rendering."""

SPREADING_EFFECTS = frozenset(name for name, effect in REGISTRY.items() if effect.spreads)
"""The effects by which a bin's light comes from elsewhere in the image."""

WRONG_MATERIAL = "wrong_material"
"""The effect that changes a metal's kappas alone."""

INTERREFLECTION = "interreflection"
"""The effect whose light takes longest to compute."""


@dataclass(frozen=True, eq=False)
class Tangents:
    """Derivatives of the light of a frame's bins that count (n_moving, n), e-; None for a source off."""

    arc_e: Float32 | None
    laser_e: Float32 | None

    def subset(self, chosen: Int64) -> Tangents:
        """Return those of some bins (k,)."""
        arc_e, laser_e = (
            of_all if of_all is None else of_all[:, chosen] for of_all in (self.arc_e, self.laser_e)
        )
        return Tangents(arc_e, laser_e)


class LinearizedModel:
    """The model of a recording's frames, with a cache of what it has rendered.

    It predicts `threads` frames at once: rendering lets go of the interpreter.
    """

    def __init__(self, observed: Observed, threads: int = 1) -> None:
        self.observed = observed
        self.nuisances = nuisances(observed)
        self.neutral = np.zeros(len(self.nuisances))
        self._tangents: list[Tangents] | None = None
        self._rendered: dict[tuple[object, ...], Rendered] = {}
        self._of_sources: dict[tuple[object, ...], Float32] = {}
        self._layers: dict[tuple[object, ...], Layers] = {}
        self._whole = [PredictedBins.whole(frame) for frame in observed.frames]
        self._near = [PredictedBins.near(frame) for frame in observed.frames]
        self._nearest_kept = [nearest_rendered(frame.keep) for frame in observed.frames]
        self._bounced: dict[int, BouncedLight] = {}
        self._rays: dict[tuple[object, ...], Rays] = {}
        self._curves: dict[tuple[object, ...], SeamCurve] = {}
        self._seams: dict[tuple[object, ...], BentSeam] = {}
        self._threads = threads
        self._executor = ThreadPoolExecutor(threads)

    def anchored_at(self, anchor: Float64, effects: Effects, trend: Trend | None = None) -> LinearizedModel:
        """Return the model with light's derivatives about nuisances (p,) and effects; caches are shared."""
        setup, anchored = self.observed.setup, copy.copy(self)
        anchored._tangents = self.over_frames(
            lambda frame: self._tangents_of(frame, anchor, effects_in_frame(effects, trend, setup, frame))
        )
        return anchored

    def with_bins(self, chosen: Int64) -> LinearizedModel:
        """Return the model of some bins alone; `chosen` (n,) are their places among those of all frames."""
        ends = np.cumsum(self.observed.counts)
        starts = ends - self.observed.counts
        parts = [chosen[(chosen >= s) & (chosen < e)] - s for s, e in zip(starts, ends, strict=True)]
        frames = [f.with_bins(part) for f, part in zip(self.observed.frames, parts, strict=True)]
        fewer = LinearizedModel(replace(self.observed, frames=tuple(frames)), self._threads)
        if self._tangents is not None:
            fewer._tangents = [t.subset(part) for t, part in zip(self._tangents, parts, strict=True)]
        return fewer

    def widen_noise_for_bends(self, nuisance: Float64, effects: Effects) -> None:
        """Widen the noise of bins that the arc lights past edges which the model takes to be straight.

        Half-way to the torch the seam strays from the chord, as an edge does whose far end lies twice as far
        beside. Half of what that would change is the model's 1 sigma.
        """
        self.take_noise(self.over_frames(lambda frame: self._with_bend(frame, nuisance, effects)))

    def mask_edges(self, nuisance: Float64, effects: Effects) -> None:
        """Leave out bins at the edges of faces, for nuisances (p,) and effects."""
        self.take_noise(self.over_frames(lambda frame: self._off_edges(frame, nuisance, effects)))

    def take_noise(self, sigmas_dn: Sequence[Float64]) -> None:
        """Set the noise of the bins that count, (n,) for each frame; inf leaves a bin out."""
        self.take_frames(
            replace(frame, sigma_dn=sigma_dn)
            for frame, sigma_dn in zip(self.observed.frames, sigmas_dn, strict=True)
        )

    def take_frames(self, frames: Iterable[ObservedFrame]) -> None:
        """Set other frames of the same poses and bins, with other images or noise."""
        self.observed = replace(self.observed, frames=tuple(frames))

    def _off_edges(self, frame: ObservedFrame, nuisance: Float64, effects: Effects) -> Float64:
        setup = apply_setup_effects(self._setup(effects, nuisance))
        seam = self.seam(frame, nuisance, effects)
        faces = look(setup, frame.T_base_tool_in(setup), seam, self._rays_of(setup.camera)).faces
        return np.where(on_one_face(faces)[frame.keep], frame.sigma_dn, np.inf)

    def _with_bend(self, frame: ObservedFrame, nuisance: Float64, effects: Effects) -> Float64:
        first, last, torch = frame.stations_mm
        curve = self.seam_curve(effects)
        coefficients = np.clip(self.seam_coefficients(nuisance), -MAX_SEAM_SIGMAS, MAX_SEAM_SIGMAS)
        deviation_mm = curve.chord_deviation_mm(coefficients, 0.5 * (first + last), torch)
        if deviation_mm < MIN_CHORD_DEVIATION_MM or frame.condition.arc_level == 0.0:
            return frame.sigma_dn
        setup = apply_setup_effects(self._setup(effects, nuisance))
        T_base_tool = frame.T_base_tool_in(setup)
        seam = self.seam(frame, nuisance, effects)
        arc_e = [
            look(
                setup,
                T_base_tool,
                BentSeam(seam.lines, replace(seam.ground, y_mm=seam.ground.y_mm + beside)),
                self._rays_of(setup.camera),
                frame.bins,
            ).arc_e
            for beside in (0.0, 2.0 * deviation_mm, -2.0 * deviation_mm)
        ]
        spread_e = 0.5 * np.maximum(np.abs(arc_e[1] - arc_e[0]), np.abs(arc_e[2] - arc_e[0]))
        light = self._frame_light(frame, setup, nuisance, effects)
        spread_dn = light.dn_per_e() * light.arc_factor * spread_e
        return np.asarray(np.hypot(frame.sigma_dn, spread_dn))

    def over_frames(self, of_frame: Callable[[ObservedFrame], Result]) -> list[Result]:
        """Return a function's result for each frame, in order."""
        return list(self.in_parallel(of_frame, self.observed.frames))

    def in_parallel(
        self, of_frame: Callable[[ObservedFrame], Result], frames: Sequence[ObservedFrame]
    ) -> Iterator[Result]:
        """Yield a function's result for each of some frames, in order, computed in parallel."""
        if self._threads == 1:
            return map(of_frame, frames)
        return self._executor.map(of_frame, frames)

    def lights(self, anchor: Float64, effects: Effects, trend: Trend | None = None) -> list[FrameLight]:
        """Return the light in the bins of each frame at nuisances (p,) and effects; one may have a trend."""
        true = apply_setup_effects(self._setup(effects, anchor))

        def of_frame(frame: ObservedFrame) -> FrameLight:
            if trend is None:
                return self._frame_light(frame, true, anchor, effects)
            effects_here = trend.effects_in_frame(effects, self.observed.setup, frame)
            return self._frame_light(
                frame, apply_setup_effects(self._setup(effects_here, anchor)), anchor, effects_here
            )

        # Here and not where frames are rendered: several of them are at work at once there.
        for cache in (self._rendered, self._of_sources, self._layers):
            for oldest in list(cache)[: -N_CACHED * len(self.observed.frames)]:
                del cache[oldest]
        return self.over_frames(of_frame)

    def stated_values(self, name: str) -> dict[str, float]:
        """Return an effect's parameters as the setup states them, neutral if it does not."""
        return REGISTRY[name].complete(self.observed.setup.effects.get(name, {}))

    def residuals(self, lights: Sequence[FrameLight]) -> Float64:
        """Return the whitened residuals (n,) of all bins that count, frame after frame."""
        return np.concatenate(
            [
                (frame.kept_dn - light.mean_dn()) / frame.sigma_dn
                for frame, light in zip(self.observed.frames, lights, strict=True)
            ]
        )

    def nuisance_columns(self, lights: Sequence[FrameLight]) -> Float64:
        """Return the derivatives (n, p) of these residuals with the nuisances."""
        assert self._tangents is not None
        parts = []
        for frame, light, tangents in zip(self.observed.frames, lights, self._tangents, strict=True):
            J = np.zeros((len(frame.sigma_dn), len(self.nuisances)))
            dn_per_e = light.dn_per_e()
            J[:, 0], J[:, 1], J[:, 2] = dn_per_e * light.arc_e, dn_per_e * light.laser_e, 1.0
            if tangents.arc_e is not None:
                J[:, N_LEVELS:] += (dn_per_e * light.arc_factor)[:, np.newaxis] * tangents.arc_e.T
            if tangents.laser_e is not None:
                J[:, N_LEVELS:] += (dn_per_e * light.laser_factor)[:, np.newaxis] * tangents.laser_e.T
            parts.append(J / -frame.sigma_dn[:, np.newaxis])
        return np.concatenate(parts)

    def seam(self, frame: ObservedFrame, nuisance: Float64, effects: Effects) -> BentSeam:
        """Return the seam that a frame sees as nuisances (p,) and effects say."""
        coefficients = self.seam_coefficients(nuisance)
        key = (_tracked_with(effects), coefficients.tobytes(), frame.stations_mm)
        # Most of what is rendered anew has the seam of what was rendered before.
        seam = self._seams.get(key)
        if seam is None:
            seam = self.seam_curve(effects).bent(coefficients, *frame.stations_mm)
            if len(self._seams) >= N_CACHED * len(self.observed.frames):
                self._seams = {}
            self._seams[key] = seam
        return seam

    def seam_curve(self, effects: Effects) -> SeamCurve:
        """Return the seam that a tracker with these effects in its setup finds."""
        key = _tracked_with(effects)
        if key not in self._curves:
            if len(self._curves) >= N_CACHED:
                self._curves = {}
            self._curves[key] = self.observed.seam_with(effects)
        return self._curves[key]

    def seam_coefficients(self, nuisance: Float64) -> Float64:
        """Return the seam's coefficients (m,) among the nuisances (p,)."""
        return nuisance[SEAM_FROM:]

    def extrapolated(self, frame: ObservedFrame, light: FrameLight, by: Float64) -> FrameLight:
        """Return a frame's light extrapolated by (p,) from the nuisances at which it was rendered."""
        if not by.any():
            return light
        levels = np.exp(by[:2]).astype(np.float32)
        moving = by[N_LEVELS:].astype(np.float32)
        arc_e, laser_e = light.arc_e, light.laser_e
        if self._tangents is not None:
            tangents = self._tangents[frame.position]
            if tangents.arc_e is not None:
                arc_e = arc_e + light.arc_factor * (moving @ tangents.arc_e)
            if tangents.laser_e is not None:
                laser_e = laser_e + light.laser_factor * (moving @ tangents.laser_e)
        return replace(
            light,
            arc_e=levels[0] * arc_e,
            laser_e=levels[1] * laser_e,
            arc_factor=levels[0] * light.arc_factor,
            laser_factor=levels[1] * light.laser_factor,
            black_dn=light.black_dn + float(by[2]),
        )

    def _setup(self, effects: Effects, nuisance: Float64) -> Setup:
        stated, bin_px = self.observed.binned, self.observed.bin_px
        acting = {
            name: _in_bins(REGISTRY[name], values, bin_px)
            for name, values in {**stated.effects, **effects}.items()
        }
        return replace(apply_nuisances(stated, nuisance), effects=acting)

    def _rays_of(self, camera: Camera) -> Rays:
        if camera.geometry not in self._rays:
            self._rays[camera.geometry] = Rays.of(camera)
        return self._rays[camera.geometry]

    def _render(self, bins: PredictedBins, true: Setup, anchor: Float64, effects: Effects) -> Rendered:
        key = _rendering_key(bins, anchor, effects)
        if key not in self._rendered:
            frame = bins.frame
            seam, rays = self.seam(frame, anchor, effects), self._rays_of(true.camera)
            T_base_tool, pixels = frame.T_base_tool_in(true), None if bins.inner is None else bins.places
            view = View.of(true, T_base_tool, seam.middle, rays, pixels, ground=seam.ground, coarse=True)
            self._rendered[key] = Rendered(
                replace(view, inner=bins.inner),
                self._arc_e(bins, true, anchor, effects),
                self._laser_e(bins, true, anchor, effects),
            )
        return self._rendered[key]

    def _arc_e(self, bins: PredictedBins, true: Setup, anchor: Float64, effects: Effects) -> Float32:
        """Return the arc's light in the bins that are predicted (...,), e-.

        It is linear in a metal's kappas: what each of them reflects serves for all metals of the same lobe.
        """
        if bins.frame.condition.arc_level == 0.0:
            return np.zeros(bins.nearest.shape, dtype=np.float32)
        metal = true.material
        if WRONG_MATERIAL not in effects:
            return self._arc_of_metal(bins, true, anchor, effects, metal, ())
        others = {name: values for name, values in effects.items() if name != WRONG_MATERIAL}
        diffuse_e, specular_e = (
            self._arc_of_metal(
                bins,
                true,
                anchor,
                others,
                replace(metal, kappa_diff=diffuse, kappa_spec=specular),
                (diffuse,),
            )
            for diffuse, specular in ((1.0, 0.0), (0.0, 1.0))
        )
        return np.float32(metal.kappa_diff) * diffuse_e + np.float32(metal.kappa_spec) * specular_e

    def _arc_of_metal(
        self,
        bins: PredictedBins,
        true: Setup,
        anchor: Float64,
        effects: Effects,
        metal: Material,
        unit: tuple[float, ...],
    ) -> Float32:
        """Return the arc's light in the bins that are predicted (...,), e-, of a metal.

        `unit` says which of its parts alone.
        """
        key = (*unit, Stage.ILLUMINATION, *_rendering_key(bins, anchor, effects, Stage.ILLUMINATION))
        if key not in self._of_sources:
            of_metal = true if metal is true.material else replace(true, material=metal)
            layers = self._layers_of(bins, true, anchor, effects).with_metal(of_metal)
            everywhere = self._arc_everywhere(bins.frame, layers.arc_e_in(bins.is_kept))
            self._of_sources[key] = everywhere.reshape(-1)[bins.places].reshape(bins.nearest.shape)
        return self._of_sources[key]

    def _laser_e(self, bins: PredictedBins, true: Setup, anchor: Float64, effects: Effects) -> Float32:
        """Return the laser's light in the bins that are predicted (...,), e-."""
        if bins.frame.condition.laser_level == 0.0:
            return np.zeros(bins.nearest.shape, dtype=np.float32)
        key = (Stage.SOURCE, *_rendering_key(bins, anchor, effects, Stage.SOURCE))
        if key not in self._of_sources:
            layers = self._layers_of(bins, true, anchor, effects).with_metal(true)
            self._of_sources[key] = layers.laser_e[bins.nearest]
        return self._of_sources[key]

    def _arc_everywhere(self, frame: ObservedFrame, kept_e: Float32) -> Float32:
        """Return the arc's light in all bins (h, w) from that in those that count (n,), e-."""
        stated_e, nearest = frame.stated_arc_e, self._nearest_kept[frame.position]
        if not len(kept_e):
            return stated_e
        stated_kept_e = stated_e.reshape(-1)[frame.bins]
        is_lit = stated_kept_e > LIT_SHARE * float(stated_kept_e.max())
        factor = np.where(is_lit, kept_e / np.where(is_lit, stated_kept_e, 1.0), 0.0)
        everywhere = np.where(is_lit[nearest], stated_e * factor[nearest], kept_e[nearest]).astype(np.float32)
        everywhere.reshape(-1)[frame.bins] = kept_e
        return everywhere

    def _layers_of(self, bins: PredictedBins, true: Setup, anchor: Float64, effects: Effects) -> Layers:
        """Return what bins show with some metal: another one does not change what rays meet."""
        key = _rendering_key(bins, anchor, effects, Stage.SURFACE)
        if key not in self._layers:
            seam, rays = self.seam(bins.frame, anchor, effects), self._rays_of(true.camera)
            T_base_tool = bins.frame.T_base_tool_in(true)
            self._layers[key] = look(true, T_base_tool, seam, rays, bins.rendered)
        return self._layers[key]

    def laser_fourth_differences(self, anchor: Float64) -> list[Float32]:
        """Return the fourth difference of the laser's light from bin to bin (n,), e-, of each frame."""
        true = apply_setup_effects(self._setup({}, anchor))

        def of_frame(frame: ObservedFrame) -> Float32:
            _, light = self._passed_light(self._whole[frame.position], true, anchor, {})
            return _fourth_difference(light.laser)[frame.keep]

        return self.over_frames(of_frame)

    def _passed_light(
        self, bins: PredictedBins, true: Setup, anchor: Float64, effects: Effects
    ) -> tuple[Rendered, Light]:
        """Return light as it was rendered, and after effects, lens and exposure."""
        rendered = self._render(bins, true, anchor, effects)
        condition = apply_condition_effects(true, apply_levels(bins.frame.condition, anchor))
        light = Light.of(
            np.float32(condition.arc_level) * rendered.arc_e,
            np.float32(condition.laser_level) * rendered.laser_e,
        )
        view = replace(rendered.view, setup=true)
        if INTERREFLECTION in effects:
            # What bounces is smooth: where it was computed first it may stay, for all that nuisances move.
            position = bins.frame.position
            self._bounced[position] = bounced_light(view, self._bounced.get(position))
        pass_on(true, light, view, condition)
        return rendered, light

    def _frame_light(
        self, frame: ObservedFrame, true: Setup, anchor: Float64, effects: Effects
    ) -> FrameLight:
        spreads = true.camera.psf_sigma_px >= NARROW_PX or not SPREADING_EFFECTS.isdisjoint(true.effects)
        bins = (self._whole if spreads else self._near)[frame.position]
        rendered, light = self._passed_light(bins, true, anchor, effects)
        kept = bins.kept
        exposure = frame.condition.exposure_s / self.observed.setup.camera.exposure_s
        arc_e, laser_e = light.arc.reshape(-1)[kept], light.laser.reshape(-1)[kept]
        return FrameLight(
            true.sensor,
            arc_e,
            laser_e,
            light.other.reshape(-1)[kept],
            light_factor(arc_e, rendered.arc_e.reshape(-1)[kept], frame.condition.arc_level * exposure),
            light_factor(laser_e, rendered.laser_e.reshape(-1)[kept], frame.condition.laser_level * exposure),
        )

    def _tangents_of(self, frame: ObservedFrame, anchor: Float64, effects: Effects) -> Tangents:
        setup = self._setup(effects, anchor)
        T_base_tool = frame.T_base_tool_in(setup)
        seam = self.seam(frame, anchor, effects)
        bins = frame.bins

        def rendered(setup: Setup, seam: BentSeam, stretch: Int64 | None) -> Layers:
            true = apply_setup_effects(setup)
            return look(true, T_base_tool, seam, self._rays_of(true.camera), bins, stretch)

        here = rendered(setup, seam, None)
        stretch = seam.stretch_at(here.view.surface[0][..., 0])
        steps = []
        for j, parameter in enumerate(self.nuisances[N_LEVELS:SEAM_FROM], N_LEVELS):
            there = anchor.copy()
            there[j] += -parameter.step if anchor[j] > 0.0 else parameter.step
            steps.append((rendered(self._setup(effects, there), seam, stretch), there[j] - anchor[j]))
        for name, step in SEAM_STEPS:
            steps.append((rendered(setup, _shifted(seam, name, step), stretch), step))
        # The laser does not know where the arc stands.
        on_ground = []
        for axis in ("y_mm", "z_mm"):
            moved_mm = getattr(seam.ground, axis) + GROUND_STEP_MM
            beside = replace(seam, ground=replace(seam.ground, **{axis: moved_mm}))
            if frame.condition.arc_level > 0.0:
                on_ground.append((rendered(setup, beside, stretch), GROUND_STEP_MM))
        # A mode moves each pixel's own stretch of the seam, and turns it about its middle.
        stations = np.array([line.station_mm for line in seam.lines])
        stations_of_bins = stations[stretch]
        curve = self.seam_curve(effects)
        modes = [curve.mode_at(n, stations_of_bins) for n in range(curve.n_modes)]
        at_torch = [curve.mode_at(n, np.array(frame.stations_mm[2]))[0] for n in range(curve.n_modes)]

        def slopes_of(
            light: Callable[[Layers], Float32], further: Sequence[tuple[Layers, float]] = ()
        ) -> Float32:
            by_step = [_slope(light(here), light(there), step) for there, step in (*steps, *further)]
            by_y, by_z, by_slope_y, by_slope_z, *by_ground = by_step[N_CAMERA:]
            by_mode = []
            for n, (displacement, slope) in enumerate(modes):
                is_y = n < N_MODES[0]
                by_place, by_slope = (by_y, by_slope_y) if is_y else (by_z, by_slope_z)
                change = displacement.astype(np.float32) * by_place + slope.astype(np.float32) * by_slope
                if by_ground:
                    change += np.float32(at_torch[n]) * by_ground[0 if is_y else 1]
                by_mode.append(change)
            return np.stack([*by_step[:N_CAMERA], *by_mode])

        return Tangents(
            slopes_of(lambda layers: layers.arc_e, on_ground) if frame.condition.arc_level > 0.0 else None,
            slopes_of(lambda layers: layers.laser_e) if frame.condition.laser_level > 0.0 else None,
        )


def _rendering_key(
    bins: PredictedBins, anchor: Float64, effects: Effects, unmoved_by: Stage | None = None
) -> tuple[object, ...]:
    """Return what bins' rendering depends on; effects of a stage that does not move it are left out.

    What happens to the arc does not change the laser's light, nor the other way round, and neither does
    metal change what rays meet.
    """
    rendering = tuple(
        (name, *values.items())
        for name, values in effects.items()
        if name in RENDERED_EFFECTS and REGISTRY[name].stage is not unmoved_by
    )
    return bins, anchor[N_LEVELS:].tobytes(), rendering


def _tracked_with(effects: Effects) -> tuple[object, ...]:
    """Return those effects, with their values, that change the seam which a tracker finds."""
    return tuple(
        (name, tuple(effects[name].items())) for name in sorted(TRIANGULATION_EFFECTS & set(effects))
    )


def _in_bins(effect: Effect, values: Values, bin_px: int) -> dict[str, float]:
    """Return an effect's values with lengths in the image counted in bins."""
    whole = effect.complete(values)
    for parameter in effect.parameters:
        if parameter.unit == "px":
            whole[parameter.name] = max(whole[parameter.name] / bin_px, parameter.lower)
    return whole


def _fourth_difference(image: Float32) -> Float32:
    """Return the fourth difference of an image (h, w) along rows plus that along columns."""
    along_rows = cv2.sepFilter2D(image, -1, FOURTH, ONE, borderType=cv2.BORDER_REFLECT_101)
    along_columns = cv2.sepFilter2D(image, -1, ONE, FOURTH, borderType=cv2.BORDER_REFLECT_101)
    return np.asarray(along_rows + along_columns, dtype=np.float32)


def _slope(here_e: Float32, there_e: Float32, step: float) -> Float32:
    """Return the derivative (n,) of light over a small step; 0 where an edge passes through the bin."""
    change = there_e - here_e
    is_edge = np.abs(change) > EDGE_SHARE * np.maximum(here_e, there_e) + EDGE_E
    return np.where(is_edge, np.float32(0.0), change / np.float32(step))


def _shifted(seam: BentSeam, name: str, by: float) -> BentSeam:
    lines = tuple(replace(line, **{name: getattr(line, name) + by}) for line in seam.lines)
    return BentSeam(lines, seam.ground)
