"""Derivatives of frames' light with the nuisances that move camera and seam, for many frames in one call."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from noise_model.compiled.arrays import Bool, Float32, Float64, Int64
from noise_model.effects import Effects, apply_setup_effects
from noise_model.fit import Parameter
from noise_model.setup import Setup
from noise_model.stripe import stripe_reference
from noise_model.surface.joint import BentSeam, SeamLine
from noise_model.view import View
from sim_to_real.data.binned import ObservedFrame
from sim_to_real.fit.frame_light import FrameLight
from sim_to_real.fit.nuisances import N_CAMERA, N_LEVELS, SEAM_FROM
from sim_to_real.fit.renderings import Renderings, lit_by_arc, lit_by_laser

SEAM_STEPS = (("y_mm", 5e-4), ("z_mm", 5e-4), ("slope_y", 1.5e-5), ("slope_z", 1.5e-5))
"""Steps of the derivatives with a seam's place and direction.

Camera and seam can move so that the stripe hardly does: over 0.02 mm its curvature outweighed what is left,
and a corrugation's fit came nearer by a quarter of the way at a time.
"""

EDGE_SHARE, EDGE_E = 0.01, 2.0
"""Least change of a bin's light over a step at an edge: relative, and in e-."""


@dataclass(frozen=True, eq=False)
class LightSlopes:
    """Derivatives of the light of a frame's bins that count (m, n), e-; None for a source off."""

    arc_e: Float32 | None
    laser_e: Float32 | None

    def subset(self, chosen: Int64) -> "LightSlopes":
        """Return those of some bins (k,)."""
        arc_e, laser_e = (
            every if every is None else every[:, chosen] for every in (self.arc_e, self.laser_e)
        )
        return LightSlopes(arc_e, laser_e)

    def of_light(self, light: FrameLight, m: int) -> Float64:
        """Return the derivatives (n, m) of the mean, DN, of light that has passed effects and lens."""
        by_e = np.zeros((len(light.arc_e), m))
        for slopes_e, factor in ((self.arc_e, light.arc_factor), (self.laser_e, light.laser_factor)):
            if slopes_e is not None:
                by_e += (factor * slopes_e).T
        return light.dn_per_e()[:, np.newaxis] * by_e


@dataclass(frozen=True, eq=False)
class Tangents:
    """Derivatives with the nuisances that move camera and seam, and with the camera's pose alone.

    As a nuisance the camera takes the seam with it: what it saw in the image stays there.
    """

    by_nuisance: LightSlopes
    by_camera: LightSlopes

    def subset(self, chosen: Int64) -> "Tangents":
        """Return those of some bins (k,)."""
        return Tangents(self.by_nuisance.subset(chosen), self.by_camera.subset(chosen))


Step = tuple[View, float]
"""The frames' view after a small step, and the step's length."""


class _Frames:
    """Frames whose light is to be rendered at an anchor and at small steps from it."""

    def __init__(
        self, renderings: Renderings, frames: Sequence[ObservedFrame], anchor: Float64, effects: Effects
    ) -> None:
        self.renderings, self.frames, self.anchor, self.effects = renderings, frames, anchor, effects
        self.seams = [renderings.seam(frame, anchor, effects) for frame in frames]
        self.setup = renderings.setup(effects, anchor)
        self.counts = [len(frame.bins) for frame in frames]
        lines = [len(seam.lines) for seam in self.seams]
        self.here = self._see(self.setup, self.seams, None)
        # Which stretch of its frame's seam each bin shows.
        self.stretch = self.here.which - np.repeat(np.cumsum([0, *lines[:-1]]), self.counts)

    def _see(self, setup: Setup, seams: Sequence[BentSeam], stretch: Int64 | None) -> View:
        true, bins = apply_setup_effects(setup), [frame.bins for frame in self.frames]
        return self.renderings.view(self.frames, bins, true, seams, stretch)

    def camera_steps(self, nuisances: Sequence[Parameter]) -> list[Step]:
        """Return a step along each nuisance that moves the camera."""
        steps = []
        for j, parameter in enumerate(nuisances[N_LEVELS:SEAM_FROM], N_LEVELS):
            there = self.anchor.copy()
            there[j] += -parameter.step if self.anchor[j] > 0.0 else parameter.step
            view = self._see(self.renderings.setup(self.effects, there), self.seams, self.stretch)
            steps.append((view, float(there[j] - self.anchor[j])))
        return steps

    def seam_steps(self) -> list[Step]:
        """Return steps of the seam's place and direction, the arc standing where it did."""
        steps = []
        for name, step in SEAM_STEPS:
            seams = [
                replace(seam, lines=tuple(_moved(line, name, step) for line in seam.lines))
                for seam in self.seams
            ]
            steps.append((self._see(self.setup, seams, self.stretch), step))
        return steps

    def ground_steps(self) -> list[Step]:
        """Return steps of the place of the seam under the arc, to the left and up."""
        steps = []
        for axis in ("y_mm", "z_mm"):
            step_mm = 5e-4
            seams = [replace(seam, ground=_moved(seam.ground, axis, step_mm)) for seam in self.seams]
            steps.append((self._see(self.setup, seams, self.stretch), step_mm))
        return steps

    def along_modes(self, chosen: Bool, by_step: Sequence[Float32]) -> Float32:
        """Return the derivatives (m, n) along the seam's modes from those along steps (n,) of its places.

        A mode moves each bin's own stretch of the seam, and turns it about its middle. `chosen` (f,) are the
        frames of the n bins. `by_step` are the derivatives along y, z and both slopes, then those along the
        ground's y and z, if the light knows of it.
        """
        by_y, by_z, by_slope_y, by_slope_z, *by_ground = by_step
        curve = self.renderings.seam_curve(self.effects)
        stations = np.concatenate([[line.station_mm for line in seam.lines] for seam in self.seams])
        places_mm = stations[self.here.which[np.repeat(chosen, self.counts)]]
        torch_mm = np.array([frame.stations_mm[2] for frame in self.frames])
        by_mode = np.zeros((curve.n_modes, len(places_mm)), dtype=np.float32)
        for mode, change in enumerate(by_mode):
            moved, turned = (part.astype(np.float32) for part in curve.mode_at(mode, places_mm))
            change += moved[0] * by_y + moved[1] * by_z + turned[0] * by_slope_y + turned[1] * by_slope_z
            if by_ground:
                at_torch = np.repeat(curve.mode_at(mode, torch_mm)[0], self.counts * chosen, axis=1)
                change += np.sum(at_torch.astype(np.float32) * by_ground, axis=0)
        return by_mode


def tangents_at(
    renderings: Renderings,
    nuisances: Sequence[Parameter],
    frames: Sequence[ObservedFrame],
    anchor: Float64,
    effects: Effects,
) -> list[Tangents]:
    """Return the derivatives of frames' light at nuisances (p,) and effects."""
    moving, is_lit = _Frames(renderings, frames, anchor, effects), lit_by_arc(frames)
    steps = [*moving.camera_steps(nuisances), *moving.seam_steps()]
    # The laser does not know where the arc stands.
    further = moving.ground_steps() if is_lit.any() else []
    arc = _slopes(moving, is_lit, View.arc_e, [*steps, *further])
    laser = _slopes(moving, lit_by_laser(frames), _laser_e, steps)
    return [
        Tangents(LightSlopes(arc_e, laser_e), LightSlopes(by_camera_arc_e, by_camera_laser_e))
        for (arc_e, by_camera_arc_e), (laser_e, by_camera_laser_e) in zip(arc, laser, strict=True)
    ]


def _laser_e(view: View) -> Float32:
    return view.laser_e(view.setup.laser.peak_e / stripe_reference(view.setup))


def _slopes(
    moving: _Frames, chosen: Bool, light: Callable[[View], Float32], steps: Sequence[Step]
) -> list[tuple[Float32, Float32] | tuple[None, None]]:
    """Return the derivatives of a source's light in each of the frames (f,) that it lights.

    They are those with the nuisances (n_moving, n), and those with the camera's pose alone (6, n).
    """
    bins = np.repeat(chosen, moving.counts)
    if not bins.any():
        none = [np.zeros((n, 0), dtype=np.float32) for n in (len(moving.anchor) - N_LEVELS, N_CAMERA)]
        return [(none[0], none[1]) if lit else (None, None) for lit in chosen]
    here_e = light(moving.here.subset(bins))
    by_step = [_slope(here_e, light(view.subset(bins)), length) for view, length in steps]
    by_camera, every = np.stack(by_step[:N_CAMERA]), moving.along_modes(chosen, by_step[N_CAMERA:])
    every[:N_CAMERA] += by_camera
    ends = np.cumsum(np.compress(chosen, moving.counts))[:-1]
    parts = zip(np.split(every, ends, axis=1), np.split(by_camera, ends, axis=1), strict=True)
    return [next(parts) if lit else (None, None) for lit in chosen]


def _moved(line: SeamLine, name: str, by: float) -> SeamLine:
    return line._replace(**{name: getattr(line, name) + by})


def _slope(here_e: Float32, there_e: Float32, step: float) -> Float32:
    """Return the derivative (n,) of light over a small step; 0 where an edge passes through the bin."""
    change = there_e - here_e
    is_edge = np.abs(change) > EDGE_SHARE * np.maximum(here_e, there_e) + EDGE_E
    return np.where(is_edge, np.float32(0.0), change / np.float32(step))
