"""The heart: one frame and one pose in, one track out, the state handed on.

Live service, replay, tests and diagnosis call the same `step` and get the same numbers.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np
import numpy.typing as npt
from scipy.special import erf

from noise_model.arc import level as current_level
from noise_model.arc_map import CELL, ArcKernel, Scene, arc_band, arc_kernel, scene
from noise_model.frames import Float64, invert, transform
from noise_model.setup import Setup
from noise_model.surface import corrugation_height, seam_height_mm
from tracker import flags
from tracker.arc_level import MAP_SIGMA, UNKNOWN, ArcLevel, estimate_arc_level
from tracker.band import gather, median_background, place
from tracker.expected import ExpectedStripe, expect_stripe
from tracker.follow import SeamHistory
from tracker.geometry import SensorGeometry, to_laser_plane
from tracker.joint import MeasuredJoint, fit_joint
from tracker.profile import triangulate
from tracker.state import Frame, Pose, Stripe, Track
from tracker.stripe import OFFSET_STEP, best_path, fit_lines, matched_filter

SEARCH_REACH_MM = 5.0
"""How far off its nominal place the seam is first looked for."""

TRACK_REACH_MM = 1.0
"""How far from its expected place it is looked for once it is known, beyond three sigmas of that place."""

FIT_SIGMAS = 4.0
"""How many stripe sigmas of background the band holds beyond that reach."""

MIN_SHARE, GOOD_SHARE = 0.2, 0.75
"""The share of scan lines that must hold a stripe, and below which it is called partial."""

ARC_OFF_SIGMAS = 5.0
MISFIT_LIMIT = 2.0
JOINT_CHI2_LIMIT = 9.0
JUMP_SIGMAS, JUMP_FLOOR_MM = 5.0, 0.3
JUMPS_TO_RELEARN = 3
"""So many jumps in a row are the seam's new place."""

OFFSET_SIGMA_LIMIT_MM = 0.5
"""An offset less certain than this is not known."""

MEDIAN_HALF_PX = 30


@dataclass(frozen=True)
class TrackerState:
    """What one step hands to the next; it can be saved with a recording."""

    history: SeamHistory = field(default_factory=SeamHistory)
    jumps: int = 0
    frames: int = 0


@dataclass
class Work:
    """Preallocated scratch whose contents never matter, for bands up to `depth` pixels."""

    charge: npt.NDArray[np.float32]
    background: npt.NDArray[np.float32]
    censored: npt.NDArray[np.bool_]

    @classmethod
    def of(cls, geometry: SensorGeometry) -> Work:
        """Make room for the widest band of a sensor."""
        shape = (geometry.n_scan, geometry.n_pos)
        return cls(np.empty(shape, np.float32), np.empty(shape, np.float32), np.empty(shape, np.bool_))

    def band(self, depth: int) -> Work:
        """Return contiguous views (n_scan, depth) of the scratch."""
        n = len(self.charge) * depth
        charge, background, censored = (
            array.reshape(-1)[:n].reshape(-1, depth) for array in (self.charge, self.background, self.censored)
        )
        return Work(charge, background, censored)


def step(
    geometry: SensorGeometry,
    state: TrackerState,
    frame: Frame,
    pose: Pose | None,
    work: Work,
    use_arc_map: bool = True,
) -> tuple[TrackerState, Track]:
    """Track one frame.

    `geometry` is the setup with its tables, `pose` None where it was refused, `use_arc_map` False reads the
    stripe over a running median with one variance for all pixels instead, for comparison. Nothing about a
    frame raises: what fails is NaN with a flag.
    """
    state = replace(state, frames=state.frames + 1)
    track = Track(frame=frame.index, timestamp_s=frame.timestamp_s, flags=0)
    sensor, camera = geometry.setup.sensor, geometry.setup.camera
    if frame.image_dn.shape != (camera.height, camera.width) or frame.image_dn.dtype != sensor.dtype:
        return state, replace(track, flags=flags.FRAME_UNREADABLE.mask)
    if pose is None:
        return state, replace(track, flags=flags.POSE_REFUSED.mask)
    found = flags.POSE_EXTRAPOLATED.mask if pose.extrapolated else 0

    nominal = scene(geometry.setup, pose.T_base_tool)
    seam, seam_sigma = _expected_seam(geometry.setup, nominal, state.history)
    view = scene(geometry.setup, pose.T_base_tool, seam)
    expected = None if view.below_surface else expect_stripe(geometry, view)
    if expected is None:
        below = flags.BELOW_SURFACE.mask if view.below_surface else flags.STRIPE_LOST.mask
        return state, replace(track, flags=found | below)
    reach_mm = min(SEARCH_REACH_MM, TRACK_REACH_MM + 3.0 * float(seam_sigma.max()))
    if reach_mm == SEARCH_REACH_MM:
        found |= flags.SEARCHED.mask
    reach_px = reach_mm * _pixels_per_mm(geometry, view)

    kernel = arc_kernel(geometry.setup, view, _expected_output(geometry.setup, frame))
    keep_off = reach_px + FIT_SIGMAS * float(expected.sigma_px.max())
    stripe_px = expected.position_px if frame.laser_on else None
    arc = estimate_arc_level(geometry, kernel, frame.image_dn, stripe_px, keep_off)
    found |= _arc_flags(arc)
    track = replace(track, arc_level=arc.level, map_misfit=arc.misfit)
    if not frame.laser_on:
        return state, replace(track, flags=found | flags.LASER_OFF.mask)

    stripe = _read_stripe(geometry, kernel, arc, frame, expected, reach_px, work, use_arc_map)
    track = replace(track, stripe=stripe)
    share = float(np.mean(np.isfinite(stripe.position_px)))
    found |= flags.SATURATED.mask if stripe.saturated.any() else 0
    if share < MIN_SHARE:
        return state, replace(track, flags=found | flags.STRIPE_LOST.mask)
    found |= flags.STRIPE_PARTIAL.mask if share < GOOD_SHARE else 0

    profile = triangulate(geometry, view, stripe.position_px - expected.lean_px, stripe.sigma_px)
    joint = fit_joint(profile, geometry.setup.joint, *_sources(geometry.setup, view, seam.station_mm))
    if joint is None:
        return state, replace(track, flags=found | flags.JOINT_NOT_FOUND.mask)
    if not profile.y_mm[0] + 1.0 < joint.y_mm < profile.y_mm[-1] - 1.0:
        return state, replace(track, flags=found | flags.SEAM_OUT_OF_VIEW.mask)
    found |= flags.JOINT_MISFIT.mask if joint.chi2 > JOINT_CHI2_LIMIT else 0
    return _follow(geometry, state, track, found, nominal, view, joint, seam_sigma)


def _follow(
    geometry: SensorGeometry,
    state: TrackerState,
    track: Track,
    found: int,
    nominal: Scene,
    view: Scene,
    joint: MeasuredJoint,
    seam_sigma: Float64,
) -> tuple[TrackerState, Track]:
    """Judge a measured joint against the earlier ones, and turn it into seam point, offset and confidence."""
    setup = geometry.setup
    seam_tool = seam_point_tool(setup, view, joint.y_mm, joint.z_mm)
    station, y, z = transform(nominal.T_joint_tool, seam_tool)
    height = seam_height_mm(setup.joint) + float(corrugation_height(station, nominal.shape.corrugation))
    displacement = np.array([y, z - height])
    variance = np.diag(joint.covariance_mm2)
    surprise = np.abs([joint.y_mm, joint.z_mm - seam_height_mm(setup.joint)])
    limit = np.maximum(JUMP_SIGMAS * np.sqrt(seam_sigma**2 + variance), JUMP_FLOOR_MM)
    history, jumps = state.history, 0
    if len(history) and (surprise > limit).any():
        found |= flags.SEAM_JUMP.mask
        jumps = state.jumps + 1
        if jumps >= JUMPS_TO_RELEARN:
            history, jumps = SeamHistory(), 0
    else:
        history = history.with_measurement(float(station), displacement, variance)
    state = replace(state, history=history, jumps=jumps)

    torch_station = float(nominal.T_joint_tool[0, 3])
    offset, offset_sigma = history.at(torch_station)
    if not history.is_measured(torch_station):
        found |= flags.OFFSET_EXTRAPOLATED.mask
    if offset_sigma.max() > OFFSET_SIGMA_LIMIT_MM:
        found |= flags.OFFSET_UNKNOWN.mask
        offset, offset_sigma = np.full(2, np.nan), np.full(2, np.nan)

    sigma = np.sqrt(variance + _hand_eye_variance(geometry, nominal, seam_tool))
    tolerance = setup.tolerance.seam_mm
    confidence = float(np.prod(erf(tolerance / (math.sqrt(2.0) * sigma))))
    return state, replace(
        track,
        flags=found,
        seam_tool_mm=(float(seam_tool[0]), float(seam_tool[1]), float(seam_tool[2])),
        sigma_y_mm=float(sigma[0]),
        sigma_z_mm=float(sigma[1]),
        offset_y_mm=float(offset[0]),
        offset_z_mm=float(offset[1]),
        offset_sigma_y_mm=float(offset_sigma[0]),
        offset_sigma_z_mm=float(offset_sigma[1]),
        valid_at_s=track.timestamp_s,
        gap_mm=joint.gap_mm,
        mismatch_mm=joint.mismatch_mm,
        confidence=confidence,
    )


def _read_stripe(
    geometry: SensorGeometry,
    kernel: ArcKernel,
    arc: ArcLevel,
    frame: Frame,
    expected: ExpectedStripe,
    reach_px: float,
    work: Work,
    use_arc_map: bool,
) -> Stripe:
    """Find the stripe within `reach_px` of its expected place and fit its centre in every scan line."""
    half = math.ceil(reach_px + FIT_SIGMAS * float(expected.sigma_px.max()))
    lows, depth = place(expected.position_px, geometry.n_pos, half)
    band = work.band(depth)
    gather(
        frame.image_dn,
        geometry.along_rows,
        lows,
        geometry.charge_e,
        geometry.saturation_dn,
        band.charge,
        band.censored,
    )
    level = arc.level if math.isfinite(arc.level) else 1.0
    misfit = max(1.0, arc.misfit) if math.isfinite(arc.misfit) else 1.0
    map_sigma = MAP_SIGMA * misfit
    base_sigma = geometry.setup.tolerance.black_level_dn * geometry.setup.sensor.gain_e_per_dn
    dark_variance = geometry.dark_variance_e2
    if use_arc_map and level > 0.0:
        arc_band(kernel, geometry.xy, geometry.cos4, lows, band.background)
        band.background *= np.float32(level)
        band.background += np.float32(arc.black_e)
        variance = np.maximum(band.background, 0.0) + np.float32(dark_variance)
    elif use_arc_map:
        band.background[:] = arc.black_e
        variance = np.full_like(band.charge, dark_variance)
    else:
        median_background(band.charge, MEDIAN_HALF_PX, band.background)
        spread = 1.4826 * float(np.median(np.abs(band.charge - band.background)))
        # One variance for all pixels: so large that the signal's own shot noise does not count beside it.
        dark_variance = max(spread**2, dark_variance)
        variance = np.full_like(band.charge, dark_variance)

    offsets = np.arange(-math.floor(reach_px), math.floor(reach_px) + 1, OFFSET_STEP)
    score = np.empty((geometry.n_scan, len(offsets)), dtype=np.float32)
    matched_filter(
        band.charge - band.background, variance, expected.position_px, expected.sigma_px, lows, CELL, offsets, score
    )
    choice = np.empty(geometry.n_scan, dtype=np.int64)
    best_path(score, choice)
    start = np.where(choice >= 0, np.rint(expected.position_px) + offsets[choice], np.nan)
    fits = np.empty((geometry.n_scan, 5))
    saturated = np.empty(geometry.n_scan, dtype=np.bool_)
    fit_lines(
        band.charge,
        band.background,
        band.censored,
        start,
        expected.sigma_px,
        lows,
        CELL,
        dark_variance,
        map_sigma,
        base_sigma,
        fits,
        saturated,
    )
    return Stripe(fits[:, 0], fits[:, 1], fits[:, 2], saturated, geometry.along_rows)


def _expected_seam(setup: Setup, nominal: Scene, history: SeamHistory) -> tuple[SeamLine, Float64]:
    """Return the seam where it should meet the laser plane, and the 1 sigma (2,) of its y and z, mm."""
    station = float(transform(nominal.T_joint_tool, _sensor_point(setup))[0])
    seam, _ = history.at(station)
    # The plane may lean: the root of a groove is met elsewhere than the plate is.
    point = seam_point_tool(setup, nominal, float(seam[0]), float(seam[1]) + seam_height_mm(setup.joint))
    return history.line_at(float(transform(nominal.T_joint_tool, point)[0]))


def _sources(setup: Setup, view: Scene, station: float) -> tuple[Float64, Float64]:
    """Return where camera and laser stand, (3,) mm, with the corrugation's tangent plane at a station levelled."""
    corrugation = view.shape.corrugation
    ahead, here, behind = corrugation_height(station + np.array([0.5, 0.0, -0.5]), corrugation)
    laser_mm = transform(view.T_joint_tool, np.asarray(setup.laser.origin_in_tool_mm))
    sources = view.T_joint_camera[:3, 3].copy(), laser_mm
    for source in sources:
        source[2] -= here + (ahead - behind) * (source[0] - station)
    return sources


def _expected_output(setup: Setup, frame: Frame) -> float:
    """Return what the setup expects of the arc for a frame's current and exposure, over the nominal output.

    Without a known current, or with the arc said to be off, it is the nominal one.
    """
    known = math.isfinite(frame.current_a) and frame.current_a > 0.0
    output = current_level(setup.arc, frame.current_a) if known else 1.0
    return output * frame.exposure_s / setup.camera.exposure_s


def _arc_flags(arc: ArcLevel) -> int:
    """Return the flags that the arc's level and misfit raise."""
    if arc is UNKNOWN:
        return 0
    if arc.level < ARC_OFF_SIGMAS * arc.sigma:
        return flags.ARC_OFF.mask
    return flags.MAP_MISFIT.mask if arc.misfit > MISFIT_LIMIT else 0


def _sensor_point(setup: Setup) -> Float64:
    """Return the point of the laser plane below the laser at tool height, tool frame, mm."""
    x, y, _ = setup.laser.origin_in_tool_mm
    plane = np.asarray(setup.laser.plane_in_tool)
    point = np.array([x, y, 0.0])
    return point - (plane[:3] @ point + plane[3]) * plane[:3]


def _pixels_per_mm(geometry: SensorGeometry, view: Scene) -> float:
    """Return how far the stripe moves, px, per mm of height or of lateral place, whichever is more."""
    camera = geometry.setup.camera
    at = _sensor_point(geometry.setup)
    points = np.stack([at, at + [0.0, 0.0, 1.0], at + [0.0, 1.0, 0.0]])
    scan_points = geometry.scan_points(camera.project(transform(invert(camera.T_tool_camera), points)))
    return float(np.abs(scan_points[1:, 1] - scan_points[0, 1]).max())


def seam_point_tool(setup: Setup, view: Scene, y_mm: float, z_mm: float) -> Float64:
    """Return the point (3,), tool frame, where the seam through (y, z) of a scene's joint frame meets the sheet.

    `z_mm` counts from a corrugation's own height, which is added at the station that is found.
    """
    T_tool_joint = invert(view.T_joint_tool)
    plane = np.asarray(setup.laser.plane_in_tool)
    direction = T_tool_joint[:3, 0]
    x = float(transform(view.T_joint_tool, _sensor_point(setup))[0])
    point = np.zeros(3)
    for _ in range(20):
        height = float(corrugation_height(np.array(x), view.shape.corrugation))
        point = transform(T_tool_joint, np.array([x, y_mm, z_mm + height]))
        x -= float((plane[:3] @ point + plane[3]) / (plane[:3] @ direction))
    return point


def _hand_eye_variance(geometry: SensorGeometry, nominal: Scene, seam_tool: Float64) -> Float64:
    """Return the variance (2,) of the seam's (y, z), mm^2, that the stated hand-eye tolerance leaves.

    Each of the camera's three rotations and translations is off by its 1 sigma in turn; what is seen is kept.
    """
    camera, tolerance = geometry.setup.camera, geometry.setup.tolerance
    image = camera.project(transform(invert(camera.T_tool_camera), seam_tool[None, :]))
    total = np.zeros(2)
    R_joint_tool = nominal.T_joint_tool[:3, :3]
    angle = math.radians(tolerance.hand_eye_deg)
    for axis in range(6):
        T_camera_moved = np.eye(4)
        if axis < 3:
            a, b = [(1, 2), (2, 0), (0, 1)][axis]
            T_camera_moved[a, b], T_camera_moved[b, a] = -angle, angle
        else:
            T_camera_moved[axis - 3, 3] = tolerance.hand_eye_mm
        moved = replace(
            geometry, setup=replace(geometry.setup, camera=replace(camera, T_tool_camera=camera.T_tool_camera @ T_camera_moved))
        )
        point, _ = to_laser_plane(moved, image)
        shift = R_joint_tool @ (point[0] - seam_tool)
        total += shift[1:] ** 2
    return total


class Tracker:
    """A thin holder of a setup's tables, the state and the scratch."""

    def __init__(self, setup: Setup, use_arc_map: bool = True) -> None:
        self.geometry = SensorGeometry.of(setup)
        self.state = TrackerState()
        self.use_arc_map = use_arc_map
        self._work = Work.of(self.geometry)

    def step(self, frame: Frame, pose: Pose | None) -> Track:
        """Track one frame and keep the new state."""
        self.state, track = step(self.geometry, self.state, frame, pose, self._work, self.use_arc_map)
        return track
