"""The forward model of all frames of a recording, linearized in the nuisances, and the residuals.

Frames are rendered and passed through the effects at an anchor, the nuisances of the last fit; from there the
bins that count are continued along the nuisances: levels multiply, the black level adds, and what moves
camera or seam by its tolerance changes light along its derivatives (`Tangents`). So a fit renders only what
an effect itself moves.
"""

import copy
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import TypeVar

import cv2
import numpy as np

from noise_model.compiled.arrays import Float32, Float64, Int64
from noise_model.effects import REGISTRY, Effects, acting, apply_condition_effects, apply_setup_effects
from noise_model.effects.light import Light
from noise_model.forward import pass_on
from noise_model.instrument.camera import NARROW_PX, blur_inner
from noise_model.interreflection.model import BouncedLight, bounced_light
from noise_model.setup import Setup
from noise_model.surface.joint import BentSeam
from noise_model.view import View
from sim_to_real.data.binned import ObservedFrame, ObservedRecording, shows_one_face
from sim_to_real.fit.frame_light import (
    FrameLight,
    PredictedBins,
    Rendering,
    expected_dn,
    joined_inner,
    light_factor,
)
from sim_to_real.fit.nuisances import N_CAMERA, N_LEVELS, apply_levels, nuisances
from sim_to_real.fit.renderings import Renderings
from sim_to_real.fit.tangents import Tangents, tangents_at
from sim_to_real.fit.trend import Trend, effects_in_frame

Item = TypeVar("Item")

Result = TypeVar("Result")

FOURTH, ONE = np.array([1.0, -4.0, 6.0, -4.0, 1.0], dtype=np.float32), np.ones(1, dtype=np.float32)
"""The taps of a fourth difference, and of none."""

INTERREFLECTION = "interreflection"
"""The effect whose light takes longest to compute."""


class LinearizedModel:
    """The model of a recording's frames, with a cache of what it has rendered.

    All frames are rendered in one call, or in one call for each of `threads` at once: rendering lets go
    of the interpreter.
    """

    def __init__(self, observed: ObservedRecording, threads: int = 1) -> None:
        self.observed = observed
        self.nuisances = nuisances(observed)
        self.neutral = np.zeros(len(self.nuisances))
        self._tangents: list[Tangents] | None = None
        self.renderings = Renderings(observed)
        self._whole = [PredictedBins.whole(frame) for frame in observed.frames]
        self._near = [PredictedBins.near(frame) for frame in observed.frames]
        self._bounced: dict[tuple[int, tuple[int, ...]], BouncedLight] = {}
        self._threads = threads
        self._executor = ThreadPoolExecutor(threads)

    def anchored_at(self, anchor: Float64, effects: Effects, trend: Trend | None = None) -> "LinearizedModel":
        """Return the model with light's derivatives about nuisances (p,) and effects; caches are shared."""
        anchored = copy.copy(self)

        def tangents_of(frames: Sequence[PredictedBins]) -> list[Tangents]:
            observed = [bins.frame for bins in frames]
            here = effects_in_frame(effects, trend, self.observed.setup, observed[0])
            return tangents_at(self.renderings, self.nuisances, observed, anchor, here)

        anchored._tangents = self._over_calls(tangents_of, self._near, trend)
        return anchored

    def with_bins(self, chosen: Int64) -> "LinearizedModel":
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

        Half-way to the torch the seam deviates from the chord, like a straight edge whose far end is off by
        twice as much. Half of the change that this makes is the model's 1 sigma.
        """
        lights = self.lights(nuisance, effects)
        self.take_noise(
            self.over_frames(lambda frame: self._with_bend(frame, lights[frame.position], nuisance, effects))
        )

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
        true = apply_setup_effects(self.renderings.setup(effects, nuisance))
        seam, every = self.renderings.seam(frame, nuisance, effects), self._whole[frame.position].places
        faces = self.renderings.view([frame], [every], true, [seam]).faces.reshape(frame.keep.shape)
        return np.where(shows_one_face(faces)[frame.keep], frame.sigma_dn, np.inf)

    def _with_bend(
        self, frame: ObservedFrame, light: FrameLight, nuisance: Float64, effects: Effects
    ) -> Float64:
        spread_e = light.arc_factor * self.bend_spread_e(frame, frame.bins, nuisance, effects)
        return np.asarray(np.hypot(frame.sigma_dn, light.dn_per_e() * spread_e))

    def bend_spread_e(
        self, frame: ObservedFrame, bins: Int64, nuisance: Float64, effects: Effects
    ) -> Float32:
        """Return 1 sigma (n,) of the arc's light in bins (n,) that it reaches past edges that bend.

        See `widen_noise_for_bends`.
        """
        first, last, torch = frame.stations_mm
        curve = self.renderings.seam_curve(effects)
        # A gap may have bent the fitted seam further.
        coefficients = np.clip(nuisance[N_LEVELS:], -2.0, 2.0)
        deviation_mm = curve.chord_deviation_mm(coefficients, 0.5 * (first + last), torch)
        # A seam nearer to its chord counts as straight.
        if deviation_mm < 0.03 or frame.condition.arc_level == 0.0:
            return np.zeros(len(bins), dtype=np.float32)
        true = apply_setup_effects(self.renderings.setup(effects, nuisance))
        seam = self.renderings.seam(frame, nuisance, effects)
        arc_e = [
            self.renderings.view(
                [frame],
                [bins],
                true,
                [BentSeam(seam.lines, seam.ground._replace(y_mm=seam.ground.y_mm + offset_mm))],
            ).arc_e()
            for offset_mm in (0.0, 2.0 * deviation_mm, -2.0 * deviation_mm)
        ]
        spread_e = 0.5 * np.maximum(np.abs(arc_e[1] - arc_e[0]), np.abs(arc_e[2] - arc_e[0]))
        return np.asarray(spread_e, dtype=np.float32)

    def over_frames(self, of_frame: Callable[[ObservedFrame], Result]) -> list[Result]:
        """Return a function's result for each frame, in order."""
        return list(self.in_parallel(of_frame, self.observed.frames))

    def in_parallel(self, compute: Callable[[Item], Result], items: Sequence[Item]) -> Iterator[Result]:
        """Yield a function's result for each of some frames or calls, in order, computed in parallel."""
        if self._threads == 1:
            return map(compute, items)
        return self._executor.map(compute, items)

    def lights(self, anchor: Float64, effects: Effects, trend: Trend | None = None) -> list[FrameLight]:
        """Return the light in the bins of each frame at nuisances (p,) and effects; one may have a trend."""
        true = apply_setup_effects(self.renderings.setup(effects, anchor))
        every = self._whole if _spreads(true) else self._near

        def lights_of(frames: Sequence[PredictedBins]) -> list[FrameLight]:
            if trend is None:
                return self._lights_of(frames, true, anchor, effects)
            here = trend.effects_in_frame(effects, self.observed.setup, frames[0].frame)
            return self._lights_of(
                frames, apply_setup_effects(self.renderings.setup(here, anchor)), anchor, here
            )

        # Here and not where frames are rendered: several of them are at work at once there.
        self.renderings.trim_caches(self._threads if trend is None else len(every))
        return self._over_calls(lights_of, every, trend)

    def _over_calls(
        self,
        in_one_call: Callable[[Sequence[PredictedBins]], list[Result]],
        every: Sequence[PredictedBins],
        trend: Trend | None,
    ) -> list[Result]:
        """Return the results of all frames, all of one thread in one call; each alone if there is a trend."""
        n_calls = min(self._threads, len(every)) if trend is None else len(every)
        parts = np.array_split(np.arange(len(every)), max(n_calls, 1))
        calls = [tuple(every[n] for n in part) for part in parts if len(part)]
        return [result for results in self.in_parallel(in_one_call, calls) for result in results]

    def stated_values(self, name: str) -> dict[str, float]:
        """Return an effect's parameters as the setup states them, neutral if it does not."""
        return REGISTRY[name].complete(self.observed.setup.effects.get(name, {}))

    def residuals(self, lights: Sequence[FrameLight]) -> Float64:
        """Return the whitened residuals (n,) of all bins that count, frame after frame."""
        sensors = {light.sensor for light in lights}
        if len(sensors) > 1:
            return self._whitened(np.concatenate([light.mean_dn() for light in lights]))
        # The sensor responds to all frames at once.
        mean_e = np.concatenate([light.arc_e + light.laser_e + light.other_e for light in lights])
        black_dn = np.repeat([light.black_dn for light in lights], self.observed.counts)
        return self._whitened(expected_dn(mean_e, sensors.pop()) + black_dn)

    def residuals_at(self, anchor: Float64, effects: Effects) -> Float64:
        """Return the whitened residuals (n,) at nuisances (p,) and effects.

        They are those of `lights`, in less time: nothing is computed that extrapolates the light.
        """
        true = apply_setup_effects(self.renderings.setup(effects, anchor))
        spreads = _spreads(true)
        is_passed_on = spreads or any(effect.light or effect.image for effect, _ in acting(true))
        in_bins = self._passed_e if is_passed_on else self._emitted_e
        self.renderings.trim_caches(self._threads)
        mean_e = self._over_calls(
            lambda frames: [in_bins(frames, true, anchor, effects)],
            self._whole if spreads else self._near,
            None,
        )
        return self._whitened(expected_dn(np.concatenate(mean_e), true.sensor))

    def _whitened(self, mean_dn: Float64) -> Float64:
        """Return the whitened residuals (n,) of a prediction (n,), DN, of all bins that count."""
        frames = self.observed.frames
        recorded_dn = np.concatenate([frame.kept_dn for frame in frames])
        return np.asarray((recorded_dn - mean_dn) / np.concatenate([frame.sigma_dn for frame in frames]))

    def nuisance_columns(self, lights: Sequence[FrameLight]) -> Float64:
        """Return the derivatives (n, p) of these residuals with the nuisances."""
        assert self._tangents is not None
        parts = []
        for frame, light, tangents in zip(self.observed.frames, lights, self._tangents, strict=True):
            J = np.zeros((len(frame.sigma_dn), len(self.nuisances)))
            dn_per_e = light.dn_per_e()
            J[:, 0], J[:, 1], J[:, 2] = dn_per_e * light.arc_e, dn_per_e * light.laser_e, 1.0
            J[:, N_LEVELS:] = tangents.by_nuisance.of_light(light, J.shape[1] - N_LEVELS)
            parts.append(J / -frame.sigma_dn[:, np.newaxis])
        return np.concatenate(parts)

    def camera_columns(self, lights: Sequence[FrameLight]) -> Float64:
        """Return the changes (n, 6) of the whitened prediction with the camera's pose, the seam at rest."""
        assert self._tangents is not None
        return np.concatenate(
            [
                tangents.by_camera.of_light(light, N_CAMERA) / frame.sigma_dn[:, np.newaxis]
                for frame, light, tangents in zip(self.observed.frames, lights, self._tangents, strict=True)
            ]
        )

    def extrapolate(self, frame: ObservedFrame, light: FrameLight, by: Float64) -> FrameLight:
        """Return a frame's light extrapolated by (p,) from the nuisances at which it was rendered."""
        if not by.any():
            return light
        levels = np.exp(by[:2]).astype(np.float32)
        moving = by[N_LEVELS:].astype(np.float32)
        arc_e, laser_e = light.arc_e, light.laser_e
        if self._tangents is not None:
            tangents = self._tangents[frame.position].by_nuisance
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

    def laser_fourth_differences(self, anchor: Float64) -> list[Float32]:
        """Return the fourth difference of the laser's light from bin to bin (n,), e-, of each frame."""
        true = apply_setup_effects(self.renderings.setup({}, anchor))
        passed = self._passed_light(tuple(self._whole), true, anchor, {})
        return [
            _fourth_difference(light.laser)[bins.frame.keep]
            for bins, (_, light) in zip(self._whole, passed, strict=True)
        ]

    def keep_bounced(self, frame: ObservedFrame, view: View) -> None:
        """Let a frame's view take the light that bounces from the first view of the frame that had any.

        What bounces is smooth: where it was computed first it may stay, whatever nuisances move.
        """
        key = frame.index, view.shape
        self._bounced[key] = bounced_light(view, self._bounced.get(key))

    def bouncing_s(self, nuisance: Float64, effects: Effects) -> float:
        """Return the time that light that bounces takes in all frames, s, by that of one, which is kept.

        It is the arc's in nearly all.
        """
        lit = np.flatnonzero(self.observed.shows_arc)
        true = apply_setup_effects(self.renderings.setup(effects, nuisance))
        began_s = time.perf_counter()
        next(self._passed_light([self._whole[int(lit[0])]], true, nuisance, effects))
        return len(lit) * (time.perf_counter() - began_s) / self._threads

    def _passed_light(
        self, frames: Sequence[PredictedBins], true: Setup, anchor: Float64, effects: Effects
    ) -> Iterator[tuple[Rendering, Light]]:
        """Yield each frame's light as it was rendered, and after effects, lens and exposure."""
        every = self.renderings.render(frames, true, anchor, effects)
        for bins, rendered in zip(frames, every, strict=True):
            condition = apply_condition_effects(true, apply_levels(bins.frame.condition, anchor))
            light = Light.of(
                np.float32(condition.arc_level) * rendered.arc_e,
                np.float32(condition.laser_level) * rendered.laser_e,
            )
            view = replace(rendered.view, setup=true)
            if INTERREFLECTION in effects:
                self.keep_bounced(bins.frame, view)
            pass_on(true, light, view, condition)
            yield rendered, light

    def _passed_e(
        self, frames: Sequence[PredictedBins], true: Setup, anchor: Float64, effects: Effects
    ) -> Float32:
        """Return the charge (n,), e-, of the bins of frames that count."""
        passed = self._passed_light(frames, true, anchor, effects)
        return np.concatenate(
            [light.total.reshape(-1)[bins.kept] for bins, (_, light) in zip(frames, passed, strict=True)]
        )

    def _emitted_e(
        self, frames: Sequence[PredictedBins], true: Setup, anchor: Float64, effects: Effects
    ) -> Float32:
        """Return the charge (n,), e-, as `_passed_e` does where no effect acts on light that was emitted.

        All frames pass through lens and exposure together. Their bins are those near the ones that count.
        """
        conditions = [
            apply_condition_effects(true, apply_levels(bins.frame.condition, anchor)) for bins in frames
        ]
        arc_e, laser_e = self.renderings.sources_e(frames, true, anchor, effects)
        emitted_e = np.concatenate(
            [
                np.float32(condition.arc_level) * of_arc + np.float32(condition.laser_level) * of_laser
                for condition, of_arc, of_laser in zip(conditions, arc_e, laser_e, strict=True)
            ]
        )
        inner, around = joined_inner(frames)
        blurred_e = blur_inner(emitted_e, inner, around, true.camera.psf_sigma_px)[inner]
        exposures = np.array([condition.exposure_s for condition in conditions]) / true.camera.exposure_s
        counts = [len(bins.kept) for bins in frames]
        return np.asarray(blurred_e * np.repeat(exposures.astype(np.float32), counts))

    def _lights_of(
        self, frames: Sequence[PredictedBins], true: Setup, anchor: Float64, effects: Effects
    ) -> list[FrameLight]:
        lights = []
        passed = self._passed_light(frames, true, anchor, effects)
        for bins, (rendered, light) in zip(frames, passed, strict=True):
            kept, condition = bins.kept, bins.frame.condition
            exposure = condition.exposure_s / self.observed.setup.camera.exposure_s
            arc_e, laser_e = light.arc.reshape(-1)[kept], light.laser.reshape(-1)[kept]
            before = rendered.arc_e.reshape(-1)[kept], rendered.laser_e.reshape(-1)[kept]
            lights.append(
                FrameLight(
                    true.sensor,
                    arc_e,
                    laser_e,
                    light.other.reshape(-1)[kept],
                    light_factor(arc_e, before[0], condition.arc_level * exposure),
                    light_factor(laser_e, before[1], condition.laser_level * exposure),
                )
            )
        return lights


def _spreads(true: Setup) -> bool:
    """Return True if light spreads farther than to a bin's neighbours: whole frames are predicted then."""
    return true.camera.psf_sigma_px >= NARROW_PX or any(REGISTRY[name].spreads for name in true.effects)


def _fourth_difference(image: Float32) -> Float32:
    """Return the fourth difference of an image (h, w) along rows plus that along columns."""
    along_rows = cv2.sepFilter2D(image, -1, FOURTH, ONE, borderType=cv2.BORDER_REFLECT_101)
    along_columns = cv2.sepFilter2D(image, -1, ONE, FOURTH, borderType=cv2.BORDER_REFLECT_101)
    return np.asarray(along_rows + along_columns, dtype=np.float32)
