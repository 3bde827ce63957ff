"""Derivatives of frames' light with the nuisances that move camera and seam, for many frames in one call."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from noise_model.arrays import Float32, Float64, Int64
from noise_model.effects import Effects, apply_setup_effects
from noise_model.fit import Parameter
from noise_model.setup import Setup
from noise_model.sight import Sight
from noise_model.stripe import stripe_reference
from noise_model.surface.joint import BentSeam
from sim_to_real.data.binned import ObservedFrame
from sim_to_real.fit.nuisances import N_CAMERA, N_LEVELS, SEAM_FROM
from sim_to_real.fit.renderings import Renderings, joined
from tracker.seam.curve import N_MODES, SeamCurve

SEAM_STEPS = (("y_mm", 5e-4), ("z_mm", 5e-4), ("slope_y", 1.5e-5), ("slope_z", 1.5e-5))
"""Steps of the derivatives with a seam's place and direction.

Camera and seam can move so that the stripe hardly does: over 0.02 mm its curvature outweighed what is left,
and a corrugation's fit came nearer by a quarter of the way at a time.
"""

GROUND_STEP_MM = 5e-4
"""Step of the derivatives with the place of the seam under the arc."""

EDGE_SHARE, EDGE_E = 0.01, 2.0
"""An edge is what changes a bin's light over such a step by more than this share of it and so many e-."""


@dataclass(frozen=True, eq=False)
class Tangents:
    """Derivatives of the light of a frame's bins that count (n_moving, n), e-; None for a source off."""

    arc_e: Float32 | None
    laser_e: Float32 | None

    def subset(self, chosen: Int64) -> Tangents:
        """Return those of some bins (k,)."""
        arc_e, laser_e = (
            every if every is None else every[:, chosen] for every in (self.arc_e, self.laser_e)
        )
        return Tangents(arc_e, laser_e)


@dataclass(frozen=True, eq=False)
class _Step:
    """What frames see after a small step, and how long the step was."""

    sights: Sequence[Sight]
    length: float


class _Frames:
    """Frames whose light is to be rendered at an anchor and at small steps from it."""

    def __init__(
        self, renderings: Renderings, frames: Sequence[ObservedFrame], anchor: Float64, effects: Effects
    ) -> None:
        self.renderings, self.frames, self.anchor, self.effects = renderings, frames, anchor, effects
        self.curve: SeamCurve = renderings.seam_curve(effects)
        self.seams = [renderings.seam(frame, anchor, effects) for frame in frames]
        self.setup = renderings.setup(effects, anchor)
        self.here = self._looked(self.setup, self.seams)
        # Which stretch of the seam each bin shows.
        self.stretches = [sight.which for sight in self.here]

    def _looked(
        self, setup: Setup, seams: Sequence[BentSeam], stretches: Sequence[Int64] | None = None
    ) -> list[Sight]:
        true = apply_setup_effects(setup)
        return [
            self.renderings.look(
                frame, true, seam, frame.bins, None if stretches is None else stretches[n]
            ).sight
            for n, (frame, seam) in enumerate(zip(self.frames, seams, strict=True))
        ]

    def camera_steps(self, nuisances: Sequence[Parameter]) -> list[_Step]:
        """Return a step along each nuisance that moves the camera."""
        steps = []
        for j, parameter in enumerate(nuisances[N_LEVELS:SEAM_FROM], N_LEVELS):
            there = self.anchor.copy()
            there[j] += -parameter.step if self.anchor[j] > 0.0 else parameter.step
            setup = self.renderings.setup(self.effects, there)
            sights = self._looked(setup, self.seams, self.stretches)
            steps.append(_Step(sights, float(there[j] - self.anchor[j])))
        return steps

    def seam_steps(self) -> list[_Step]:
        """Return steps of the seam's place and direction, the arc standing where it did."""
        steps = []
        for name, step in SEAM_STEPS:
            seams = [
                replace(
                    seam,
                    lines=tuple(replace(line, **{name: getattr(line, name) + step}) for line in seam.lines),
                )
                for seam in self.seams
            ]
            steps.append(_Step(self._looked(self.setup, seams, self.stretches), step))
        return steps

    def ground_steps(self) -> list[_Step]:
        """Return steps of the place of the seam under the arc, to the left and up."""
        steps = []
        for axis in ("y_mm", "z_mm"):
            seams = [
                replace(
                    seam,
                    ground=replace(seam.ground, **{axis: getattr(seam.ground, axis) + GROUND_STEP_MM}),
                )
                for seam in self.seams
            ]
            steps.append(_Step(self._looked(self.setup, seams, self.stretches), GROUND_STEP_MM))
        return steps

    def along_modes(self, chosen: Sequence[bool], by_step: Sequence[Float32]) -> Float32:
        """Return the derivatives (m, n) along the seam's modes from those along steps (n,) of its places.

        A mode moves each bin's own stretch of the seam, and turns it about its middle. `by_step` are those
        along y, z and both slopes, then those along the ground's y and z, if the light knows of it.
        """
        by_y, by_z, by_slope_y, by_slope_z, *by_ground = by_step
        of_frames = [n for n, is_chosen in enumerate(chosen) if is_chosen]
        lines = [np.array([line.station_mm for line in self.seams[n].lines]) for n in of_frames]
        stations = np.concatenate([s[self.stretches[n]] for s, n in zip(lines, of_frames, strict=True)])
        counts = [len(self.stretches[n]) for n in of_frames]
        torch_mm = np.array([self.frames[n].stations_mm[2] for n in of_frames])
        by_mode = []
        for mode in range(self.curve.n_modes):
            displacement, slope = self.curve.mode_at(mode, stations)
            is_y = mode < N_MODES[0]
            by_place, by_slope = (by_y, by_slope_y) if is_y else (by_z, by_slope_z)
            change = displacement.astype(np.float32) * by_place + slope.astype(np.float32) * by_slope
            if by_ground:
                at_torch = np.repeat(self.curve.mode_at(mode, torch_mm)[0], counts).astype(np.float32)
                change += at_torch * by_ground[0 if is_y else 1]
            by_mode.append(change)
        return np.stack(by_mode) if by_mode else np.zeros((0, len(stations)), dtype=np.float32)


def tangents_at(
    renderings: Renderings,
    nuisances: Sequence[Parameter],
    frames: Sequence[ObservedFrame],
    anchor: Float64,
    effects: Effects,
) -> list[Tangents]:
    """Return the derivatives of frames' light at nuisances (p,) and effects."""
    moving = _Frames(renderings, frames, anchor, effects)
    steps = [*moving.camera_steps(nuisances), *moving.seam_steps()]
    is_lit = [frame.condition.arc_level > 0.0 for frame in frames]
    has_laser = [frame.condition.laser_level > 0.0 for frame in frames]

    def laser_e(sight: Sight) -> Float32:
        return sight.laser_e(sight.setup.laser.peak_e / stripe_reference(sight.setup))

    # The laser does not know where the arc stands.
    further = moving.ground_steps() if any(is_lit) else []
    arc = _slopes(moving, is_lit, Sight.arc_e, [*steps, *further])
    laser = _slopes(moving, has_laser, laser_e, steps)
    return [Tangents(*parts) for parts in zip(arc, laser, strict=True)]


def _slopes(
    moving: _Frames, chosen: Sequence[bool], light: Callable[[Sight], Float32], steps: Sequence[_Step]
) -> list[Float32 | None]:
    """Return the derivatives (n_moving, n) of a source's light in each of the frames that it lights."""
    here = joined(moving.here, chosen)
    if here is None:
        return [None] * len(chosen)
    here_e, by_step = light(here), []
    for step in steps:
        there = joined(step.sights, chosen)
        assert there is not None
        by_step.append(_slope(here_e, light(there), step.length))
    every = np.concatenate([by_step[:N_CAMERA], moving.along_modes(chosen, by_step[N_CAMERA:])])
    ends = np.cumsum([len(sight.cos4) for sight, is_in in zip(moving.here, chosen, strict=True) if is_in])
    parts = iter(np.split(every, ends[:-1], axis=1))
    return [np.ascontiguousarray(next(parts)) if is_in else None for is_in in chosen]


def _slope(here_e: Float32, there_e: Float32, step: float) -> Float32:
    """Return the derivative (n,) of light over a small step; 0 where an edge passes through the bin."""
    change = there_e - here_e
    is_edge = np.abs(change) > EDGE_SHARE * np.maximum(here_e, there_e) + EDGE_E
    return np.where(is_edge, np.float32(0.0), change / np.float32(step))
