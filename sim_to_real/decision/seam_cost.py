"""Cost of an effect in mm of seam: how far the tracker's seam moves while it does not know the effect.

Two ways lead there, both free of the images' noise. Expected frames are rendered with and without the effect
and tracked by the same tracker: the difference of its errors is the cost. What camera, lens or clock do is
triangulation alone: points of the image in which the seam is seen are triangulated with and without them.

The errors are of the point, so a plate that is tilted costs what it does to the reading: the tracker follows
a seam that has moved. The interval of a cost is that of the effect's parameters, propagated linearly: along
each principal axis of their covariance the cost is computed once more, one sigma off, and `N_DRAWS` sets of
such steps are drawn.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from noise_model.compiled.arrays import Float64, Integers
from noise_model.condition import Condition
from noise_model.effects import REGISTRY, Effects, Values, apply_setup_effects, pose_time_s
from noise_model.fit import within_bounds
from noise_model.forward import Renderer, predict
from noise_model.instrument.sensor import saturation_dn
from noise_model.setup import Setup
from noise_model.surface.joint import SeamLine, seam_frame, seam_height_mm, section
from noise_model.transforms import invert, transform
from sim_to_real.diagnosis import EffectCost, SeamShift
from sim_to_real.fit.renderings import RENDERED_EFFECTS
from tracker.geometry import SEARCH_REACH_MM
from tracker.seam.locate import ridge_mm, seam_displacement
from tracker.seam_observations import TRIANGULATION_EFFECTS, SeamObservations
from tracker.state import Frame, Pose
from tracker.tracker import Tracker
from tracker.tracker_state import TrackerMemory

TRIANGULATED_EFFECTS = TRIANGULATION_EFFECTS - {"surface_tilt"}
"""The effects of camera, lens and clock: what they cost is triangulation, and nothing is rendered for them.

A tilted plate is triangulated where it is; it costs what it does to the reading.
"""

RANDOM_EFFECTS = frozenset(
    {"arc_flicker", "laser_speckle", "spatter", "spatter_streaks", "fixed_pattern", "image_compression"}
)
"""Random effects that are drawn: their cost is the scatter of the seam, its mean shift is about none."""

UNRENDERED_EFFECTS = frozenset({"interreflection", "read_noise"})
"""Effects without a cost: bounced light takes seconds a frame, read noise shows in no expected frame."""

N_DRAWS = 400
"""Draws of an effect's parameters: the ends of a 95 % interval scatter by some 5 % of its half-width."""

MEETING_STEPS = 20
"""Steps by which the laser's sheet meets the seam: each leaves a share of the seam's slope, 0.5 at most."""

FINE_BITS = 16
"""Bits of rendered frames: steps of 1/256 of an 8-bit code move the seam by 0.1 um, whole ones by 2."""

UNKNOWN_SHIFT = SeamShift(math.nan, math.nan, math.nan, math.nan)
"""A shift where no seam was found."""

Course = Callable[[Float64], Float64]
"""Displacements (n, 2) of the true seam from its nominal line as y and z, mm, at stations (n,), mm."""

Shifts = Callable[[Values], Float64]
"""Shifts (n, 2) of the tracker's seam as y and z, mm, by an effect's parameters; NaN where it sees none."""


class SceneFrame(NamedTuple):
    """A frame to render: header, whose image does not count, poses by time, condition, true seam.

    The seam is taken as straight: rendering a bent one takes twice as long, and a cost is a difference.
    """

    header: Frame
    pose_at: Callable[[float], Float64]
    condition: Condition
    seam: SeamLine


class SeamTrial:
    """Expected frames, rendered with and without an effect and tracked by one that does not know it.

    `known` is the tracker's setup, whose random effects are left out. The tracker sees the frames in their
    order. `renderer` remembers their light without the effect.
    """

    def __init__(self, known: Setup, frames: Sequence[SceneFrame], renderer: Renderer) -> None:
        stated = {name: values for name, values in known.effects.items() if name not in RANDOM_EFFECTS}
        self._known = replace(known, effects=stated)
        self._frames = tuple(frames)
        self._renderer = renderer
        self._tracker = Tracker(_fine(self._known))
        self.without_mm = self._errors_mm([{}] * len(self._frames))
        """Errors (n, 2) of the tracker's seam without the effect, mm; NaN where it sees none."""

    def shifts_mm(self, name: str, values: Sequence[Values]) -> Float64:
        """Return by how much an effect shifts the tracker's seam in each frame (n, 2), y and z, mm.

        `values` (n,) are its parameters frame by frame.
        """
        return self._errors_mm([{name: of_frame} for of_frame in values]) - self.without_mm

    def _errors_mm(self, acting: Sequence[Effects]) -> Float64:
        """Return the errors (n, 2) with effects, frame by frame, once the tracker has seen all."""
        worlds = [replace(self._known, effects={**self._known.effects, **effects}) for effects in acting]
        images = [
            self._image(n, there, effects)
            for n, (there, effects) in enumerate(zip(worlds, acting, strict=True))
        ]
        self._tracker.state = TrackerMemory()
        errors = np.full((len(images), 2), np.nan)
        for is_last in (False, True):
            for n, (frame, there, image_dn) in enumerate(zip(self._frames, worlds, images, strict=True)):
                T_base_tool = frame.pose_at(pose_time_s(self._known, frame.header.timestamp_s))
                track = self._tracker.step(replace(frame.header, image_dn=image_dn), Pose(T_base_tool))
                if is_last and track.valid:
                    errors[n] = _error_mm(there, T_base_tool, np.array(track.seam_tool_mm), frame.seam)
        return errors

    def _image(self, n: int, there: Setup, effects: Effects) -> Integers:
        """Return the n-th expected frame, DN of `FINE_BITS`, with effects; random ones are drawn."""
        frame = self._frames[n]
        pose = frame.pose_at(pose_time_s(there, frame.header.timestamp_s))
        # What changes the image alone takes the light that is rendered without it.
        renderer = Renderer(1) if RENDERED_EFFECTS & effects.keys() else self._renderer
        rng = np.random.default_rng(n) if RANDOM_EFFECTS & effects.keys() else None
        expected = predict(there, pose, frame.condition, seam=frame.seam, renderer=renderer, rng=rng)
        mean_dn, sensor = expected.mean_dn, there.sensor
        for name, values in effects.items():
            codes = REGISTRY[name].codes
            if codes is not None:
                rounded = np.clip(np.rint(mean_dn), 0, sensor.max_dn).astype(sensor.dtype)
                mean_dn = codes(rounded, sensor, values).astype(np.float64)
        fine = _fine(self._known).sensor
        scaled = np.rint(mean_dn * 2.0 ** (FINE_BITS - sensor.bits))
        scaled[expected.saturated] = saturation_dn(fine)
        return np.clip(scaled, 0, fine.max_dn).astype(np.uint16)


def _error_mm(there: Setup, T_base_tool: Float64, seam_tool_mm: Float64, seam: SeamLine) -> Float64:
    """Return the distance (2,) of a tracked point from the true seam, y and z, mm."""
    true = apply_setup_effects(there)
    T_joint_tool = invert(seam_frame(true.joint, transform(T_base_tool, seam_tool_mm))) @ T_base_tool
    station_mm, displacement_mm = seam_displacement(true, T_joint_tool, seam_tool_mm)
    along_mm = station_mm - seam.station_mm
    return displacement_mm - (seam.y_mm + along_mm * seam.slope_y, seam.z_mm + along_mm * seam.slope_z)


def _fine(setup: Setup) -> Setup:
    """Return the setup whose sensor has `FINE_BITS`, and noise and response alike."""
    sensor, steps = setup.sensor, 2.0 ** (FINE_BITS - setup.sensor.bits)
    fine = replace(
        sensor,
        bits=FINE_BITS,
        gain_e_per_dn=sensor.gain_e_per_dn / steps,
        black_level_dn=sensor.black_level_dn * steps,
    )
    return replace(setup, sensor=fine)


def seam_in_images(
    there: Setup, times_s: Sequence[float], poses: Sequence[Callable[[float], Float64]], course: Course
) -> SeamObservations:
    """Return the points in which frames at some times see a seam, free of noise, in the setup that is there.

    `poses` (n) give the tool's (4, 4) for a time about each frame's.
    """
    true = apply_setup_effects(there)
    *normal, offset_mm = true.laser.plane
    points = np.empty((len(times_s), 3))
    for n, (time_s, pose_at) in enumerate(zip(times_s, poses, strict=True)):
        T_base_tool = pose_at(pose_time_s(true, time_s))
        T_joint_tool = (
            invert(seam_frame(true.joint, transform(T_base_tool, true.laser.point_mm))) @ T_base_tool
        )
        across = T_joint_tool[:3, :3] @ normal
        off_mm = offset_mm - across @ T_joint_tool[:3, 3]
        station_mm = float(transform(T_joint_tool, np.array(true.laser.point_mm))[0])
        for _ in range(MEETING_STEPS):
            on_seam = _on_seam(true, station_mm, course)
            station_mm -= float(across @ on_seam + off_mm) / across[0]
        points[n] = transform(invert(T_joint_tool), _on_seam(true, station_mm, course))
    image_px = np.empty((0, 2))
    if len(points):
        image_px = true.camera.project(transform(invert(true.camera.T_tool_camera), points))
    return SeamObservations(image_px, np.array(times_s), np.zeros((len(points), 2)), tuple(poses))


def _on_seam(true: Setup, station_mm: float, course: Course) -> Float64:
    """Return the seam's point (3,) at a station, joint frame, mm."""
    y_mm, z_mm = course(np.array([station_mm]))[0]
    height_mm = seam_height_mm(true.joint) + ridge_mm(station_mm, section(true.joint).corrugation)
    return np.array([station_mm, y_mm, z_mm + height_mm])


def triangulation_shifts_mm(
    seen: SeamObservations, known: Setup, name: str, values: Values, course: Course
) -> Float64:
    """Return by how much a tracker with a setup shifts the seam (n, 2), y and z, mm.

    Camera, lens or clock are really off as the effect says. `seen` are the points in which the seam was seen.
    Where the shift is beyond the tracker's search it is NaN: the tracker would find no seam there.
    """
    if not len(seen.image_px):
        return np.empty((0, 2))
    there = replace(known, effects={**known.effects, name: values})
    (assumed_mm, found_mm), (true_mm, real_mm) = seen.in_joint(known), seen.in_joint(there)
    # Along a bent seam another station has another true place.
    shifts_mm = found_mm - real_mm - (course(assumed_mm) - course(true_mm))
    is_in_reach = np.all(np.abs(shifts_mm) <= SEARCH_REACH_MM, axis=1, keepdims=True)
    return np.where(is_in_reach, shifts_mm, np.nan)


@dataclass(frozen=True, eq=False)
class Spread:
    """An effect's parameters and their covariance (p, p)."""

    values: Values
    covariance: Float64

    def one_sigma_off(self, name: str) -> list[dict[str, float]]:
        """Return the parameters moved by one sigma along each principal axis, within their bounds."""
        size, axes = np.linalg.eigh(self.covariance)
        centre, parameters = np.array(list(self.values.values())), REGISTRY[name].parameters
        moved = []
        for variance, axis in zip(size, axes.T, strict=True):
            step = math.sqrt(max(float(variance), 0.0)) * axis
            if step.any():
                inside = within_bounds(parameters, centre + step)
                moved.append(dict(zip(self.values, inside.tolist(), strict=True)))
        return moved


def cost_of(
    name: str, shifts_of: Shifts, spread: Spread, without_mm: Float64, *, is_named: bool
) -> EffectCost:
    """Return the cost of an effect that was found, with its 95 % interval.

    `without_mm` (n, 2) are the errors without the effect, NaN where the tracker sees no seam anyway.
    """
    fitted_mm = shifts_of(spread.values)
    off = spread.one_sigma_off(name)
    along = np.array([shifts_of(values) - fitted_mm for values in off]).reshape(len(off), *fitted_mm.shape)
    # A step that loses the seam says nothing of how far it moves.
    along = np.nan_to_num(along)
    draws = np.random.default_rng(0).standard_normal((N_DRAWS, len(along)))
    drawn = fitted_mm + np.tensordot(draws, along, 1)
    lateral, vertical = (_shift(fitted_mm[:, axis], drawn[:, :, axis]) for axis in (0, 1))
    return EffectCost(
        name, lateral, vertical, *_frames_lost(without_mm, fitted_mm), dict(spread.values), is_named=is_named
    )


def bound_of(name: str, shifts_of: Shifts, sizes: Sequence[Values], without_mm: Float64) -> EffectCost:
    """Return what an effect that was not found costs at most, at the smallest sizes that would show.

    The size with the largest shift counts, for its rms. `without_mm` is as in `cost_of`.
    """
    shifts = [shifts_of(values) for values in sizes]
    largest = max(range(len(sizes)), key=lambda n: np.nan_to_num(_rms(shifts[n]), nan=math.inf))
    lateral, vertical = (_bound(shifts[largest][:, axis]) for axis in (0, 1))
    lost = _frames_lost(without_mm, shifts[largest])
    return EffectCost(name, lateral, vertical, *lost, dict(sizes[largest]), is_bound=True)


def unknown_cost(name: str, values: Values, *, is_named: bool) -> EffectCost:
    """Return the cost of an effect that is not rendered."""
    return EffectCost(name, UNKNOWN_SHIFT, UNKNOWN_SHIFT, 0, 0, dict(values), is_named, is_rendered=False)


def ranked(costs: Sequence[EffectCost]) -> tuple[EffectCost, ...]:
    """Return costs, the largest first: first what was found, then bounds, last what is not known."""
    return tuple(sorted(costs, key=lambda cost: (cost.is_bound, not cost.is_rendered, -cost.max_mm)))


def _frames_lost(without_mm: Float64, shifts_mm: Float64) -> tuple[int, int]:
    """Return the number of frames that show the seam without an effect, and of those that lose it with it."""
    seen = np.isfinite(without_mm[:, 0])
    return int(seen.sum()), int(np.count_nonzero(seen & np.isnan(shifts_mm[:, 0])))


def _shift(at_mm: Float64, drawn_mm: Float64) -> SeamShift:
    known = np.isfinite(at_mm)
    if not known.any():
        return UNKNOWN_SHIFT
    value = _rms(at_mm)
    low, high = np.percentile(np.sqrt(np.mean(drawn_mm[:, known] ** 2, axis=1)), (2.5, 97.5))
    return SeamShift(value, min(float(low), value), max(float(high), value), float(at_mm[known].mean()))


def _bound(shifts_mm: Float64) -> SeamShift:
    if not np.isfinite(shifts_mm).any():
        return UNKNOWN_SHIFT
    return SeamShift(math.nan, 0.0, _rms(shifts_mm), math.nan)


def _rms(shifts_mm: Float64) -> float:
    """Return the rms of the shifts that are known; NaN without any."""
    known = shifts_mm[np.isfinite(shifts_mm)]
    return float(np.sqrt(np.mean(known**2))) if known.size else math.nan
