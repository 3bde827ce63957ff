"""Before the first frame: every path of a step taken once, so that nothing is compiled or loaded after it.

The frames are made up: the stripe where the setup expects it, the arc's light where the map predicts it, and
what may happen to both. Their pixels are larger than the camera's, since a path is the same in a small image.
Their tracks are thrown away.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace

import numpy as np

from noise_model.arc.map import arc_frame, arc_kernel
from noise_model.arc.scene import make_scene
from noise_model.compiled.arrays import Float32, Float64, Int64, Integers
from noise_model.compiled.compiler_events import compiler_events
from noise_model.compiled.forecast import Forecast
from noise_model.drawn_profile import draw_profile
from noise_model.setup import Setup
from noise_model.surface.joint import NOMINAL_SEAM, seam_frame
from tracker import observation
from tracker.arc.transmission import NO_LIGHT, Transmission
from tracker.geometry import SensorGeometry
from tracker.judge import JUMPS_TO_RELEARN
from tracker.observation import Aim, FrameInput
from tracker.seam.correction import Correction
from tracker.state import Frame, Pose
from tracker.step import step
from tracker.stripe.band import Band
from tracker.stripe.expected import ExpectedStripe, expect_stripe
from tracker.stripe.read import Work
from tracker.tracker_state import LOST_TO_SEARCH, TrackerMemory

NOTHING = np.empty((0, 0))

SHORTER_SIDE_PX = 240
"""Least number of pixels of a synthetic image's shorter side."""

TRACKED_FRAMES = 8
"""Number of consecutive frames that show the stripe in its place, 1 mm apart."""


@dataclass(frozen=True)
class WarmUp:
    """Cost of a warm-up: number of functions compiled, and the whole time."""

    compiled: int
    elapsed_s: float


OnCompiled = Callable[[str, int, float, float | None], None]
"""Hears a function's name as its compilation begins, how many there were before it, seconds so far and left.

How many are left is known where this machine has compiled the same before, else None.
"""


def warm_up(
    geometry: SensorGeometry,
    correction: Correction,
    use_arc_map: bool = True,
    on_compiled: OnCompiled | None = None,
) -> WarmUp:
    """Run every path of `step` for a setup's joint and types of numbers, and derive the setup's tables.

    A path that this process has run before for a setup of the same kind is not run again. `on_compiled` gets
    each function's name as its compilation begins (see `OnCompiled`).
    """
    began_s = time.perf_counter()
    forecast = Forecast(geometry.setup.joint.type)
    with forecast.running(), compilations_reported(on_compiled, forecast) as compiled:
        kind = _kind(geometry, use_arc_map)
        if kind not in _warm:
            small = _with_larger_pixels(geometry.setup)
            work, state = Work.of(small), TrackerMemory()
            for frame, pose in _frames(small):
                state, _, _ = step(small, state, frame, pose, work, use_arc_map, correction)
            _warm.add(kind)
        geometry.make_ready()
    if compiled:
        forecast.keep()
    return WarmUp(len(compiled), time.perf_counter() - began_s)


_warm: set[tuple[object, ...]] = set()
"""The kinds of setups for which this process has taken every path."""


def _kind(geometry: SensorGeometry, use_arc_map: bool) -> tuple[object, ...]:
    """Return the part of a setup that determines the functions of a step and their types."""
    setup = geometry.setup
    return (
        use_arc_map,
        geometry.along_rows,
        setup.joint.type,
        setup.joint.has_ridges,
        setup.profiler is None,
        setup.sensor.dtype,
        setup.missing,
        any(setup.camera.distortion),
        frozenset(setup.effects),
    )


def compile_arc(setup: Setup) -> None:
    """Compile what computes the arc's light, with what it needs: a step that sees no stripe."""
    small = _with_larger_pixels(setup)
    frame, pose = next(_frames(small))
    step(small, TrackerMemory(), replace(frame, laser_on=False), pose, Work.of(small))


def compile_stripe(setup: Setup) -> None:
    """Compile all else that steps of a setup call, in a process for it alone: from now on no arc shines."""
    observation.predict_light = _no_light
    small = _with_larger_pixels(replace(setup, arc=replace(setup.arc, radiance_e=0.0)))
    work, state = Work.of(small), TrackerMemory()
    for frame, pose in _frames(small):
        state, _, _ = step(small, state, frame, pose, work)


def _no_light(
    given: FrameInput, aim: Aim, pixels: Int64, band: Band | None
) -> tuple[Float32, Float32, Transmission | None]:
    """Return the light of `predict_light` where nothing shines."""
    if band is not None:
        band.background[:] = 0.0
    return np.zeros(len(pixels), np.float32), NO_LIGHT, None


def _with_larger_pixels(setup: Setup) -> SensorGeometry:
    """Return a setup of the same kind and the same view, whose image has SHORTER_SIDE_PX."""
    if setup.profiler is not None:
        return SensorGeometry.of(setup)
    camera = setup.camera
    by = max(1, min(camera.width, camera.height) // SHORTER_SIDE_PX)
    return SensorGeometry.of(replace(setup, camera=camera.coarser(by)))


def _frames(geometry: SensorGeometry) -> Iterator[tuple[Frame, Pose | None]]:
    """Yield made-up frames and poses in the order in which a state meets them."""
    rng = np.random.default_rng(0)
    *tracked, start, middle, end, beyond = _poses(geometry)
    index = 0

    def frame(image_dn: Integers, laser_on: bool = True, arc_on: bool = True) -> Frame:
        nonlocal index
        index += 1
        setup = geometry.setup
        current_a, exposure_s = setup.arc.current_a, setup.camera.exposure_s
        return Frame(index, 0.04 * index, image_dn, exposure_s, current_a, laser_on, arc_on)

    for pose in tracked:
        yield frame(_Picture.of(geometry, pose).image(rng)), pose
    shown = _Picture.of(geometry, middle)
    dark = shown.image(rng, stripe=0.0, arc=0.0)
    # Displacement of a seam that is to be searched.
    aside_px = geometry.pixels_per_mm * 3.0
    for arc in (0.0, 1.0, 3.0):
        yield frame(shown.image(rng, arc=arc), arc_on=arc > 0.0), middle
        yield frame(shown.image(rng, stripe=0.0, arc=arc), laser_on=False), middle
    # Too bright, with a reflection of its own, in part, and as noise alone.
    yield frame(shown.image(rng, stripe=10.0)), middle
    yield frame(shown.image(rng, ghost=0.5)), middle
    yield frame(shown.image(rng, share=0.6)), middle
    yield frame(shown.image(rng, share=0.1)), middle
    yield frame(np.full_like(dark, geometry.saturation_dn)), middle
    # A plate without a joint, which a closed one looks like, and a root that is as narrow as can be.
    joint = geometry.setup.joint
    others = [replace(joint, type="flat")]
    if "root_gap_mm" in joint.dimensions:
        others.append(replace(joint, dimensions={**joint.dimensions, "root_gap_mm": 0.0}))
    for other in others:
        shown_instead = SensorGeometry.of(replace(geometry.setup, joint=other))
        yield frame(_Picture.of(shown_instead, middle).image(rng)), middle
    # Elsewhere: a jump, which becomes the seam's place; then lost, searched and not where it should be.
    for moved_px in (0.3 * aside_px, aside_px):
        for _ in range(JUMPS_TO_RELEARN + 1):
            yield frame(shown.image(rng, aside_px=moved_px)), middle
    for _ in range(LOST_TO_SEARCH + 2):
        yield frame(dark), middle
    yield frame(shown.image(rng, aside_px=aside_px)), middle
    yield frame(shown.image(rng)), middle
    for _ in range(LOST_TO_SEARCH):
        yield frame(dark), middle
    yield frame(shown.image(rng, ghost=0.5)), middle
    # Before the joint's start and past its end; then from where nothing is seen.
    for pose in (start, end, beyond):
        yield frame(_Picture.of(geometry, pose).image(rng)), replace(pose, extrapolated=True)
    for tilted in _tilted(middle):
        yield frame(shown.image(rng)), tilted
    yield frame(shown.image(rng)), None


def _poses(geometry: SensorGeometry) -> list[Pose]:
    """Return poses of a torch upright over the nominal seam.

    TRACKED_FRAMES lead to the middle of its first segment, 1 mm apart; then come a place before the seam's
    start, that middle, a place before its end and one past it.
    """
    joint = geometry.setup.joint
    line = np.asarray(joint.seam_in_base_mm, dtype=np.float64)
    direction = (line[1] - line[0]) / np.linalg.norm(line[1] - line[0])
    onward = (line[-1] - line[-2]) / np.linalg.norm(line[-1] - line[-2])
    middle = 0.5 * (line[0] + line[1])
    points = [middle + (n - TRACKED_FRAMES) * direction for n in range(TRACKED_FRAMES)]
    points += [line[0] - 5.0 * direction, middle, line[-1] - 2.0 * onward, line[-1] + 5.0 * onward]
    return [Pose(_upright_at(geometry, point)) for point in points]


def _upright_at(geometry: SensorGeometry, point_base_mm: Float64) -> Float64:
    """Return T_base_tool of a torch that stands upright over a point of the nominal seam."""
    T_base_tool = seam_frame(geometry.setup.joint, point_base_mm)
    T_base_tool[:3, 3] = point_base_mm
    return T_base_tool


def _tilted(pose: Pose) -> Iterator[Pose]:
    """Yield the pose turned by some degrees about each axis, then so high and so low that nothing is seen."""
    for axis in range(3):
        i, j = (axis + 1) % 3, (axis + 2) % 3
        turned = np.eye(4)
        turned[i, i] = turned[j, j] = np.cos(0.05)
        turned[i, j], turned[j, i] = -np.sin(0.05), np.sin(0.05)
        yield replace(pose, T_base_tool=pose.T_base_tool @ turned)
    for height_mm in (500.0, -500.0):
        moved = np.eye(4)
        moved[2, 3] = height_mm
        yield replace(pose, T_base_tool=pose.T_base_tool @ moved)


@dataclass(frozen=True)
class _Picture:
    """Parts of a frame, scan line by scan line: stripe and arc's light (n_scan, n_pos), e-; or a profile."""

    geometry: SensorGeometry
    expected: ExpectedStripe | None
    arc_e: Float64
    profile: Integers

    @classmethod
    def of(cls, geometry: SensorGeometry, pose: Pose) -> _Picture:
        """Predict stripe and arc of a pose."""
        scene = make_scene(geometry.setup, pose.T_base_tool, NOMINAL_SEAM)
        if geometry.setup.profiler is not None:
            profile = draw_profile(geometry.setup, scene, np.random.default_rng(0))
            return cls(geometry, None, NOTHING, profile)
        arc_e = np.zeros((geometry.n_scan, geometry.n_pos))
        if geometry.setup.arc.shines:
            arc = arc_kernel(geometry.setup, scene, 1.0)
            seen_e = arc_frame(arc, geometry.xy, geometry.cos4, (geometry.n_scan, geometry.n_pos))
            arc_e = np.nan_to_num(seen_e).astype(np.float64)
        return cls(geometry, expect_stripe(geometry, scene), arc_e, NOTHING.astype(np.uint16))

    def image(
        self,
        rng: np.random.Generator,
        stripe: float = 1.0,
        arc: float = 1.0,
        ghost: float = 0.0,
        share: float = 1.0,
        aside_px: float = 0.0,
    ) -> Integers:
        """Return a frame (H, W) with these factors of the stripe, the arc, and a ghost next to the stripe.

        The stripe is in a share of those scan lines alone that show it, and displaced sideways.
        """
        geometry, sensor = self.geometry, self.geometry.setup.sensor
        if geometry.setup.profiler is not None:
            columns = np.arange(geometry.n_scan) * stripe <= share * geometry.n_scan
            return np.where(columns, np.roll(self.profile, round(aside_px), axis=1), 0).astype(np.uint16)
        charge_e = arc * self.arc_e
        if self.expected is not None:
            places = np.arange(geometry.n_pos) - self.expected.position_px[:, None] - aside_px
            sigma = self.expected.sigma_px[:, None]
            bells = np.exp(-0.5 * (places / sigma) ** 2) + ghost * np.exp(-0.5 * (places / sigma - 5.0) ** 2)
            shown = self.expected.shown
            held = shown & (np.cumsum(shown) <= share * shown.sum())
            # Brightness of the synthetic stripe.
            charge_e = charge_e + stripe * 0.3 * sensor.full_well_e * bells * held[:, None]
        noise_e = np.sqrt(charge_e + geometry.dark_variance_e2) * rng.standard_normal(charge_e.shape)
        codes = np.searchsorted(geometry.charge_e, charge_e + noise_e)
        image = np.minimum(codes, len(geometry.charge_e) - 1).astype(sensor.dtype)
        return np.ascontiguousarray(image.T if geometry.along_rows else image)


@contextmanager
def compilations_reported(
    on_compiled: OnCompiled | None, forecast: Forecast | None = None
) -> Iterator[list[str]]:
    """Yield a growing list of the functions that numba compiles within the block.

    `on_compiled` gets each name as its compilation begins (see `OnCompiled`); `forecast` is of what is
    compiled.
    """
    compiled: list[str] = []
    began_s = time.perf_counter()

    def on_begin(name: str) -> None:
        if on_compiled is not None:
            left_s = None if forecast is None else forecast.left_s()
            on_compiled(name, len(compiled), time.perf_counter() - began_s, left_s)
        compiled.append(name)

    def on_end(name: str) -> None:
        if forecast is not None:
            forecast.note_compiled(name)

    with compiler_events(on_begin, on_end):
        yield compiled
