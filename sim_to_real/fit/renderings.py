"""Renderings of poses before any effect acts on the image: many frames in one call, and kept.

Geometry, source and surface are rendered for all frames of an anchor together. A cache is keyed by what each
part depends on: what happens to the arc does not change the laser's light, nor the other way round, and
another metal does not change what rays meet.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from noise_model.compiled.arrays import Bool, Float32, Float64, Int64
from noise_model.effects import REGISTRY, Effect, Effects, Stage, Values
from noise_model.instrument.camera import Camera, Rays
from noise_model.setup import Setup
from noise_model.stripe import stripe_reference
from noise_model.surface.joint import BentSeam
from noise_model.view import View
from sim_to_real.data.binned import ObservedFrame, ObservedRecording
from sim_to_real.fit.frame_light import PredictedBins, Rendering, nearest_rendered
from sim_to_real.fit.nuisances import N_LEVELS, apply_nuisances
from tracker.seam.curve import SeamCurve
from tracker.seam_observations import TRIANGULATION_EFFECTS

N_CACHED = 8
"""Number of cached renderings of a recording's frames."""

RENDERED_EFFECTS = frozenset(
    name for name, effect in REGISTRY.items() if effect.setup is not None or effect.stage is Stage.TIMING
) - {"gamma", "black_level", "read_noise", "defocus"}
"""The effects that need a new rendering."""

Frames = Sequence[PredictedBins]
"""Some bins of each of some frames, all of which are rendered in one call."""


@dataclass(frozen=True, eq=False)
class BinLight:
    """Light in bins (n,) of some frames, one frame after another; None for no frame.

    `arc` are the bins that count of frames that the arc lights, `laser` the rendered ones of those with the
    laser on.
    """

    arc: View | None
    laser: View | None


class Renderings:
    """The renderings of a recording's frames, the last of them kept."""

    def __init__(self, observed: ObservedRecording) -> None:
        self._observed = observed
        self._rendered: dict[tuple[object, ...], list[Rendering]] = {}
        self._of_sources: dict[tuple[object, ...], list[Float32]] = {}
        self._seen: dict[tuple[object, ...], BinLight] = {}
        self._rays: dict[tuple[object, ...], Rays] = {}
        self._pixel_rays: dict[tuple[object, ...], tuple[tuple[Int64, ...], Int64, Rays]] = {}
        self._curves: dict[tuple[object, ...], SeamCurve] = {}
        self._seams: dict[tuple[object, ...], BentSeam] = {}
        self._nearest_kept = [nearest_rendered(frame.keep) for frame in observed.frames]

    def trim_caches(self, n_calls: int) -> None:
        """Forget the oldest renderings but those of `n_calls` calls, each of them `N_CACHED` times."""
        for cache in (self._rendered, self._of_sources, self._seen):
            for oldest in list(cache)[: -N_CACHED * n_calls]:
                del cache[oldest]

    def setup(self, effects: Effects, nuisance: Float64) -> Setup:
        """Return the setup of bins with nuisances (p,), and effects in addition to those that it states."""
        stated, bin_px = self._observed.binned, self._observed.bin_px
        acting = {
            name: _in_bins(REGISTRY[name], values, bin_px)
            for name, values in {**stated.effects, **effects}.items()
        }
        return replace(apply_nuisances(stated, nuisance), effects=acting)

    def seam(self, frame: ObservedFrame, nuisance: Float64, effects: Effects) -> BentSeam:
        """Return the seam that a frame sees as nuisances (p,) and effects say."""
        coefficients = nuisance[N_LEVELS:]
        key = (_tracked_with(effects), coefficients.tobytes(), frame.stations_mm)
        # Most of what is rendered anew has the seam of what was rendered before.
        seam = self._seams.get(key)
        if seam is None:
            seam = self.seam_curve(effects).bent(coefficients, *frame.stations_mm)
            if len(self._seams) >= N_CACHED * len(self._observed.frames):
                self._seams = {}
            self._seams[key] = seam
        return seam

    def seam_curve(self, effects: Effects) -> SeamCurve:
        """Return the seam that a tracker with these effects in its setup finds."""
        key = _tracked_with(effects)
        if key not in self._curves:
            if len(self._curves) >= N_CACHED:
                self._curves = {}
            self._curves[key] = self._observed.seam_with(effects)
        return self._curves[key]

    def rays_of(self, camera: Camera) -> Rays:
        """Return the rays of a camera."""
        if camera.geometry not in self._rays:
            self._rays[camera.geometry] = Rays.of(camera)
        return self._rays[camera.geometry]

    def view(
        self,
        frames: Sequence[ObservedFrame],
        pixels: Sequence[Int64],
        true: Setup,
        seams: Sequence[BentSeam],
        stretch: Int64 | None = None,
    ) -> View:
        """Return the view of some bins (n,) of each frame in the true setup, see `View.along`."""
        key = (*(id(some) for some in pixels), true.camera.geometry)
        if key not in self._pixel_rays:
            if len(self._pixel_rays) >= N_CACHED * len(self._observed.frames):
                self._pixel_rays = {}
            # The pixels are kept with their rays: another array may not take their place.
            pose = np.repeat(np.arange(len(pixels)), [len(some) for some in pixels])
            rays = self.rays_of(true.camera).at(np.concatenate(pixels))
            self._pixel_rays[key] = tuple(pixels), pose, rays
        _, pose, rays = self._pixel_rays[key]
        poses = [frame.T_base_tool_in(true) for frame in frames]
        return View.along(true, poses, seams, pose, rays, stretch)

    def render(self, frames: Frames, true: Setup, anchor: Float64, effects: Effects) -> list[Rendering]:
        """Return the renderings of frames, before any effect acts on the image."""
        key = _key(frames, anchor, effects)
        if key not in self._rendered:
            sources_e = self.sources_e(frames, true, anchor, effects)
            views = [self._view(bins, true, anchor, effects) for bins in frames]
            self._rendered[key] = [Rendering(*parts) for parts in zip(views, *sources_e, strict=True)]
        return self._rendered[key]

    def sources_e(
        self, frames: Frames, true: Setup, anchor: Float64, effects: Effects
    ) -> tuple[list[Float32], list[Float32]]:
        """Return the arc's and the laser's light of frames as in their `Rendering`."""
        return self._arc_e(frames, true, anchor, effects), self._laser_e(frames, true, anchor, effects)

    def _view(self, bins: PredictedBins, true: Setup, anchor: Float64, effects: Effects) -> View:
        seam, rays = self.seam(bins.frame, anchor, effects), self.rays_of(true.camera)
        T_base_tool, pixels = bins.frame.T_base_tool_in(true), None if bins.inner is None else bins.places
        view = View.of(true, T_base_tool, seam.middle, rays, pixels, ground=seam.ground, coarse=True)
        return replace(view, inner=bins.inner)

    def _arc_e(self, frames: Frames, true: Setup, anchor: Float64, effects: Effects) -> list[Float32]:
        """Return the arc's light in the bins that are predicted (...,), e-.

        It is linear in a metal's kappas: what each of them reflects serves for all metals of the same lobe.
        """
        if "wrong_material" not in effects:
            return self._arc_of_metal(frames, true, anchor, effects, ())
        others = {name: values for name, values in effects.items() if name != "wrong_material"}
        metal = true.material
        diffuse, specular = (
            self._arc_of_metal(
                frames,
                replace(true, material=replace(metal, kappa_diff=kappa_diff, kappa_spec=kappa_spec)),
                anchor,
                others,
                (kappa_diff,),
            )
            for kappa_diff, kappa_spec in ((1.0, 0.0), (0.0, 1.0))
        )
        return [
            np.float32(metal.kappa_diff) * diffuse_e + np.float32(metal.kappa_spec) * specular_e
            for diffuse_e, specular_e in zip(diffuse, specular, strict=True)
        ]

    def _arc_of_metal(
        self, frames: Frames, true: Setup, anchor: Float64, effects: Effects, unit: tuple[float, ...]
    ) -> list[Float32]:
        """Return the arc's light in the bins that are predicted (...,), e-.

        `unit` is the part of a metal that shows alone.
        """
        key = (*unit, Stage.ILLUMINATION, *_key(frames, anchor, effects, Stage.ILLUMINATION))
        if key not in self._of_sources:
            seen = self._sights_of_bins(frames, true, anchor, effects)
            kept_e = np.zeros(0, dtype=np.float32)
            if seen.arc is not None:
                kept_e = replace(seen.arc, setup=true).arc_e()
            lights, start = [], 0
            for bins in frames:
                light = np.zeros(bins.nearest.shape, dtype=np.float32)
                if bins.frame.condition.arc_level > 0.0:
                    end = start + len(bins.kept)
                    everywhere = self._arc_everywhere(bins.frame, kept_e[start:end])
                    light, start = everywhere.reshape(-1)[bins.places].reshape(light.shape), end
                lights.append(light)
            self._of_sources[key] = lights
        return self._of_sources[key]

    def _laser_e(self, frames: Frames, true: Setup, anchor: Float64, effects: Effects) -> list[Float32]:
        """Return the laser's light in the bins that are predicted (...,), e-."""
        key = (Stage.SOURCE, *_key(frames, anchor, effects, Stage.SOURCE))
        if key not in self._of_sources:
            seen = self._sights_of_bins(frames, true, anchor, effects)
            rendered_e = np.zeros(0, dtype=np.float32)
            if seen.laser is not None:
                unit_e = true.laser.peak_e / stripe_reference(true)
                rendered_e = replace(seen.laser, setup=true).laser_e(unit_e)
            lights, start = [], 0
            for bins in frames:
                light = np.zeros(bins.nearest.shape, dtype=np.float32)
                if bins.frame.condition.laser_level > 0.0:
                    end = start + len(bins.rendered)
                    light, start = rendered_e[start:end][bins.nearest], end
                lights.append(light)
            self._of_sources[key] = lights
        return self._of_sources[key]

    def _arc_everywhere(self, frame: ObservedFrame, kept_e: Float32) -> Float32:
        """Return the arc's light in all bins (h, w) from that in those that count (n,), e-."""
        stated_e, nearest = frame.stated_arc_e, self._nearest_kept[frame.position]
        if not len(kept_e):
            return stated_e
        stated_kept_e = stated_e.reshape(-1)[frame.bins]
        # Where the stated arc gives less than 1/1000 of its brightest light, it does not determine another
        # arc's.
        is_lit = stated_kept_e > 1e-3 * float(stated_kept_e.max())
        factor = np.where(is_lit, kept_e / np.where(is_lit, stated_kept_e, 1.0), 0.0)
        everywhere = np.where(is_lit[nearest], stated_e * factor[nearest], kept_e[nearest]).astype(np.float32)
        everywhere.reshape(-1)[frame.bins] = kept_e
        return everywhere

    def _sights_of_bins(self, frames: Frames, true: Setup, anchor: Float64, effects: Effects) -> BinLight:
        """Return the views of lit bins; another metal does not change what rays meet."""
        key = _key(frames, anchor, effects, Stage.SURFACE)
        if key not in self._seen:
            observed = [bins.frame for bins in frames]
            seams = [self.seam(frame, anchor, effects) for frame in observed]
            view = self.view(observed, [bins.rendered for bins in frames], true, seams)
            counts, kept = [len(bins.rendered) for bins in frames], [bins.is_kept for bins in frames]
            is_lit, has_laser = lit_by_arc(observed), lit_by_laser(observed)
            self._seen[key] = BinLight(
                subset_or_none(view, np.repeat(is_lit, counts) & np.concatenate(kept)),
                subset_or_none(view, np.repeat(has_laser, counts)),
            )
        return self._seen[key]


def lit_by_arc(frames: Sequence[ObservedFrame]) -> Bool:
    """Return the mask (f,) of frames that the arc lights."""
    return np.array([frame.condition.arc_level > 0.0 for frame in frames], dtype=np.bool_)


def lit_by_laser(frames: Sequence[ObservedFrame]) -> Bool:
    """Return the mask (f,) of frames that the laser lights."""
    return np.array([frame.condition.laser_level > 0.0 for frame in frames], dtype=np.bool_)


def subset_or_none(view: View, chosen: Bool) -> View | None:
    """Return some of a view's pixels (n,), None for none."""
    return view.subset(chosen) if chosen.any() else None


def _key(
    frames: Frames, anchor: Float64, effects: Effects, unmoved_by: Stage | None = None
) -> tuple[object, ...]:
    """Return the cache key of frames' rendering; effects of the stage `unmoved_by` are left out."""
    rendering = tuple(
        (name, *values.items())
        for name, values in effects.items()
        if name in RENDERED_EFFECTS and REGISTRY[name].stage is not unmoved_by
    )
    return tuple(frames), anchor[N_LEVELS:].tobytes(), rendering


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
