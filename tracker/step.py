"""The heart: one frame and one pose in, one track out, the state handed on.

Live service, replay, tests and diagnosis call the same `step` and get the same numbers.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np

from noise_model.arc.map import Scene, arc_kernel, scene
from noise_model.arc_source import level as current_level
from noise_model.arrays import Float64
from noise_model.setup import Setup
from noise_model.surface.joint import SeamLine
from tracker import flags
from tracker.arc.level import UNKNOWN, ArcLevel, estimate_arc_level
from tracker.arc.transmission import Passage
from tracker.geometry import SensorGeometry
from tracker.joint import MeasuredJoint, fit_joint
from tracker.joint.type_check import is_another_type
from tracker.profile import Profile, triangulate
from tracker.seam.correction import UNSTATED, Correction
from tracker.seam.gaussian_process import SeamHistory
from tracker.seam.locate import (
    confidence,
    expected_seam,
    hand_eye_variance,
    locate,
    pose_flags,
    sources,
)
from tracker.seam.steer import Steering, steer
from tracker.state import Frame, Pose, Stripe, Track
from tracker.stripe.detection import (
    LEAST_RATIO,
    LEAST_SEEN,
    evidence_ratio,
    leaves_image,
    path_of,
    seen_share,
)
from tracker.stripe.expected import ExpectedStripe, expect_stripe
from tracker.stripe.read import FIT_SIGMAS, StripeReading, Work, arc_map_of, read_stripe

SEARCH_REACH_MM = 5.0
"""How far off its nominal place the seam is first looked for."""

TRACK_REACH_MM = 1.0
"""How far from its expected place it is looked for once it is known, beyond three sigmas of that place."""

MIN_SHARE, GOOD_SHARE = 0.2, 0.75
"""The share of the scan lines that the joint crosses which must hold a stripe, and below it is partial."""

ARC_OFF_SIGMAS = 5.0
MISFIT_LIMIT = 2.0
JOINT_CHI2_LIMIT = 9.0
UNEXPLAINED_LIMIT = 0.1
"""So large a share of the points near the seam may lie off the joint's shape: spatter, a tack weld's end."""

JUMP_SIGMAS, JUMP_FLOOR_MM = 5.0, 0.3
JUMPS_TO_RELEARN = 3
"""So many jumps in a row to one place are the seam's new place."""

MOST_STRETCHES = 8
"""So many stretches between jumps are remembered for the torch that comes after."""

LEAST_MARGIN_MM = 1.0
"""A seam nearer to the profile's end than this is out of view."""

CLEAR_MM = 1.0
"""So much farther than a stripe is followed its joint is looked for."""

LOST_TO_SEARCH = 3
"""So many frames without a joint widen the search to what it was at first."""

MOST_CURRENT_A, MOST_EXPOSURE_S = 1e4, 1e2
"""No welding current and no exposure reaches these: such a number is not known."""


@dataclass(frozen=True)
class TrackerState:
    """What one step hands to the next; it can be saved with a recording.

    `jumps` counts frames whose joint was elsewhere since it was where it should be, `lost` those in a row
    in which it was not found, `frames` all of them.
    `history` is the seam from its last jump on; `beyond` what has been measured elsewhere since, which
    becomes the history if it goes on so; `behind` are the latest stretches before, in which the torch may
    still stand.
    """

    history: SeamHistory = field(default_factory=SeamHistory)
    beyond: SeamHistory = field(default_factory=SeamHistory)
    behind: tuple[SeamHistory, ...] = ()
    steering: Steering = field(default_factory=Steering)
    jumps: int = 0
    lost: int = 0
    frames: int = 0

    def history_at(self, station_mm: float) -> SeamHistory:
        """Return the stretch of the seam that a station lies on: the latest that has measured it.

        Between two stretches it is that of the nearer one.
        """
        for measured in (self.history, *reversed(self.behind)):
            if measured.is_measured(station_mm):
                return measured
        stretch = self.history
        for before in reversed(self.behind):
            if len(stretch) and station_mm >= 0.5 * (before.stations_mm.max() + stretch.stations_mm.min()):
                return stretch
            stretch = before
        return stretch

    @property
    def lasting_flags(self) -> int:
        """The flags of every frame from now on, one that cannot be read as well."""
        return flags.FOLLOW_STOPPED.mask if self.steering.is_stopped else 0


def step(
    geometry: SensorGeometry,
    state: TrackerState,
    frame: Frame,
    pose: Pose | None,
    work: Work,
    use_arc_map: bool = True,
    correction: Correction = UNSTATED,
) -> tuple[TrackerState, Track]:
    """Track one frame.

    `geometry` is the setup with its tables, `pose` None where it was refused, `use_arc_map` False reads the
    stripe over a running median with one variance for all pixels instead, for comparison; `correction` says
    what of the seam's displacement is sent. Nothing about a frame raises: what fails is NaN with a flag.
    """
    return step_and_reading(geometry, state, frame, pose, work, use_arc_map, correction)[:2]


def step_and_reading(
    geometry: SensorGeometry,
    state: TrackerState,
    frame: Frame,
    pose: Pose | None,
    work: Work,
    use_arc_map: bool = True,
    correction: Correction = UNSTATED,
) -> tuple[TrackerState, Track, Reading | None]:
    """Return what `step` does and the look at the frame that it rests on, None where it took none."""
    state = replace(state, frames=state.frames + 1)
    track = Track(frame=frame.index, timestamp_s=frame.timestamp_s, flags=0)
    found = state.lasting_flags
    sensor, camera = geometry.setup.sensor, geometry.setup.camera
    if frame.image_dn.shape != (camera.height, camera.width) or frame.image_dn.dtype != sensor.dtype:
        return state, replace(track, flags=found | flags.FRAME_UNREADABLE.mask), None
    if pose is None:
        return state, replace(track, flags=found | flags.POSE_REFUSED.mask), None
    found |= flags.POSE_EXTRAPOLATED.mask if pose.extrapolated else 0
    blind = pose_flags(geometry.setup, pose.T_base_tool)
    if blind:
        return state, replace(track, flags=found | blind), None

    nominal = scene(geometry.setup, pose.T_base_tool)
    seam, seam_sigma = expected_seam(geometry.setup, nominal, state.history)
    reach_mm = min(SEARCH_REACH_MM, TRACK_REACH_MM + 3.0 * float(seam_sigma.max()))
    if state.lost >= LOST_TO_SEARCH:
        reach_mm = SEARCH_REACH_MM
    reading = _read(geometry, frame, pose, seam, reach_mm, work, use_arc_map)
    if reach_mm == SEARCH_REACH_MM:
        found |= flags.SEARCHED.mask
        reading = _read_again(geometry, frame, pose, nominal, seam, reading, work, use_arc_map)
    found |= reading.flags
    track = replace(
        track,
        arc_level=reading.arc.level,
        map_misfit=reading.arc.misfit,
        fov_margin_mm=reading.fov_margin_mm,
        stripe=reading.stripe,
    )
    if reading.joint is None:
        state = replace(state, lost=state.lost + (reading.stripe is not None))
        track = replace(track, flags=found)
    else:
        state, track = _follow(geometry, state, track, found, nominal, reading.view, reading.joint)
    steering, track = steer(
        correction,
        geometry.setup,
        pose.T_base_tool,
        nominal,
        state.history,
        state.history_at,
        state.steering,
        track,
        seam,
    )
    return replace(state, steering=steering), track, reading


@dataclass(frozen=True)
class Reading:
    """What one look at a frame, within a reach about an expected seam, has found."""

    flags: int
    view: Scene
    seam: SeamLine
    reach_mm: float
    arc: ArcLevel = UNKNOWN
    stripe: Stripe | None = None
    joint: MeasuredJoint | None = None
    fov_margin_mm: float = math.nan


def _read(
    geometry: SensorGeometry,
    frame: Frame,
    pose: Pose,
    seam: SeamLine,
    reach_mm: float,
    work: Work,
    use_arc_map: bool,
) -> Reading:
    """Look for arc, stripe and joint about a seam."""
    view = scene(geometry.setup, pose.T_base_tool, seam)
    if view.below_surface:
        return Reading(flags.BELOW_SURFACE.mask, view, seam, reach_mm)
    expected = expect_stripe(geometry, view)
    if expected is None:
        return Reading(flags.STRIPE_LOST.mask, view, seam, reach_mm)
    reach_px = reach_mm * geometry.pixels_per_mm
    output = expected_output(geometry.setup, frame)
    kernel = arc_kernel(geometry.setup, view, output)
    keep_off = reach_px + FIT_SIGMAS * float(expected.sigma_px.max())
    stripe_px = expected.position_px if frame.laser_on else None
    arc_map = arc_map_of(geometry, kernel)
    passage = Passage.of(geometry, view, arc_map.at, output if frame.arc_on else 0.0)
    arc = estimate_arc_level(geometry, arc_map.at, passage, frame.image_dn, stripe_px, keep_off)
    found = _arc_flags(arc)
    if not frame.laser_on:
        return Reading(found | flags.LASER_OFF.mask, view, seam, reach_mm, arc)

    look = read_stripe(geometry, arc_map, passage, arc, frame, expected, reach_px, work, use_arc_map)
    stripe = look.stripe
    share = float(np.isfinite(stripe.position_px).sum()) / max(int(expected.shown.sum()), 1)
    found |= flags.SATURATED.mask if stripe.saturated.any() else 0
    found |= (
        flags.STRIPE_LEAVES_IMAGE.mask if leaves_image(expected, stripe.position_px, geometry.n_pos) else 0
    )
    at = path_of(look.offsets_px, expected.position_px, stripe.position_px)
    is_lost = share < MIN_SHARE or evidence_ratio(look.score, at, expected.shown) < LEAST_RATIO
    if share < GOOD_SHARE and not is_lost:
        band = look.band
        seen = seen_share(expected, stripe.position_px, stripe.amplitude_e, band.variance, band.censored)
        is_lost = seen < LEAST_SEEN
    if is_lost:
        return Reading(found | flags.STRIPE_LOST.mask, view, seam, reach_mm, arc, stripe)
    found |= flags.STRIPE_PARTIAL.mask if share < GOOD_SHARE else 0
    # Of what is no stripe nothing is the second.
    found |= flags.TWO_STRIPES.mask if look.second_share > 0.0 else 0

    profile = profile_of(geometry, view, expected, look, reach_mm)
    joint = fit_joint(profile, geometry.setup.joint, *sources(geometry.setup, view, seam.station_mm))
    # A narrower look shows only what lies where the stated joint should.
    if reach_mm == SEARCH_REACH_MM and is_another_type(profile, geometry.setup.joint, joint):
        found |= flags.JOINT_TYPE_MISMATCH.mask
    if joint is None:
        return Reading(found | flags.JOINT_NOT_FOUND.mask, view, seam, reach_mm, arc, stripe)
    margin_mm = min(joint.y_mm - float(profile.y_mm[0]), float(profile.y_mm[-1]) - joint.y_mm)
    if margin_mm <= LEAST_MARGIN_MM:
        out = found | flags.SEAM_OUT_OF_VIEW.mask
        return Reading(out, view, seam, reach_mm, arc, stripe, fov_margin_mm=margin_mm)
    is_misfit = joint.chi2 > JOINT_CHI2_LIMIT or joint.unexplained > UNEXPLAINED_LIMIT
    found |= flags.JOINT_MISFIT.mask if is_misfit else 0
    return Reading(found, view, seam, reach_mm, arc, stripe, joint, margin_mm)


def profile_of(
    geometry: SensorGeometry, view: Scene, expected: ExpectedStripe, look: StripeReading, reach_mm: float
) -> Profile:
    """Return a stripe's profile, whose seam is looked for within the look's reach and a little beyond."""
    stripe, light = look.stripe, look.light(geometry.setup.camera.psf_sigma_px)
    position_px = stripe.position_px - expected.lean_px
    profile = triangulate(geometry, view, position_px, stripe.sigma_px, stripe.beside_px)
    return replace(profile, reach_mm=reach_mm + CLEAR_MM, light=light)


def _read_again(
    geometry: SensorGeometry,
    frame: Frame,
    pose: Pose,
    nominal: Scene,
    seam: SeamLine,
    first: Reading,
    work: Work,
    use_arc_map: bool,
) -> Reading:
    """Look again where a search has found the joint: the map for another place misleads, near its edges most.

    If the map misled the search itself, the joint is placed without it. If the second look holds hardly any
    stripe, there was none.
    """
    placed = first
    if first.joint is None and first.stripe is not None and use_arc_map:
        placed = _read(geometry, frame, pose, seam, SEARCH_REACH_MM, work, False)
    if placed.joint is None:
        return first
    setup = geometry.setup
    _, station, displacement = locate(
        setup, nominal.T_joint_tool, placed.view, placed.joint.y_mm, placed.joint.z_mm
    )
    there = replace(seam, station_mm=station, y_mm=float(displacement[0]), z_mm=float(displacement[1]))
    again = _read(geometry, frame, pose, there, TRACK_REACH_MM, work, use_arc_map)
    # What only a wrong map shows is no stripe: most of its lines are gone with the right one.
    if again.joint is None and _lines_held(again) >= MIN_SHARE * _lines_held(placed):
        return first
    # The narrow look does not see as far beside the stripe.
    wide = flags.JOINT_TYPE_MISMATCH.mask | flags.TWO_STRIPES.mask
    return replace(again, flags=again.flags | (placed.flags & wide))


def _lines_held(reading: Reading) -> int:
    """Return how many scan lines hold a stripe."""
    return 0 if reading.stripe is None else int(np.isfinite(reading.stripe.position_px).sum())


def _follow(
    geometry: SensorGeometry,
    state: TrackerState,
    track: Track,
    found: int,
    nominal: Scene,
    view: Scene,
    joint: MeasuredJoint,
) -> tuple[TrackerState, Track]:
    """Judge a measured joint against the earlier ones, and turn it into seam point and confidence."""
    setup = geometry.setup
    seam_tool, station, displacement = locate(setup, nominal.T_joint_tool, view, joint.y_mm, joint.z_mm)
    variance = np.diag(joint.covariance_mm2)
    expected, expected_sigma = state.history.at(station)
    limit = jump_limit_mm(expected_sigma, variance)
    history, beyond, behind, jumps, lost = state.history, SeamHistory(), state.behind, 0, 0
    if len(history) and (np.abs(displacement - expected) > limit).any():
        found |= flags.SEAM_JUMP.mask
        jumps, lost, beyond = state.jumps + 1, state.lost, state.beyond
        elsewhere, elsewhere_sigma = beyond.at(station)
        if (np.abs(displacement - elsewhere) > jump_limit_mm(elsewhere_sigma, variance)).any():
            # Nor where the last jump was: what is here and there is no seam.
            jumps, beyond = 1, SeamHistory()
        beyond = beyond.with_measurement(station, displacement, variance)
        if jumps >= JUMPS_TO_RELEARN:
            # The torch comes to the new stretch later: until then it is on the one before, if that was one.
            if len(history) >= JUMPS_TO_RELEARN:
                behind = (*behind, history)[-MOST_STRETCHES:]
            history, beyond, jumps, lost = beyond, SeamHistory(), 0, 0
    else:
        history = history.with_measurement(station, displacement, variance)
    hand_eye = hand_eye_variance(setup, nominal, seam_tool)
    steering = replace(state.steering, hand_eye_variance_mm2=(float(hand_eye[0]), float(hand_eye[1])))
    state = replace(
        state, history=history, beyond=beyond, behind=behind, steering=steering, jumps=jumps, lost=lost
    )
    sigma = np.sqrt(variance + hand_eye)
    return state, replace(
        track,
        flags=found,
        seam_tool_mm=(float(seam_tool[0]), float(seam_tool[1]), float(seam_tool[2])),
        sigma_y_mm=float(sigma[0]),
        sigma_z_mm=float(sigma[1]),
        gap_mm=joint.gap_mm,
        mismatch_mm=joint.mismatch_mm,
        confidence=confidence(setup, sigma),
        shape=joint.shape,
    )


def jump_limit_mm(expected_sigma_mm: Float64, variance_mm2: Float64) -> Float64:
    """Return how far (2,) a seam may lie from where the earlier frames put it, mm, without being a jump."""
    return np.asarray(np.maximum(JUMP_SIGMAS * np.sqrt(expected_sigma_mm**2 + variance_mm2), JUMP_FLOOR_MM))


def expected_output(setup: Setup, frame: Frame) -> float:
    """Return what the setup expects of the arc for a frame's current and exposure, over the nominal output.

    Without a known current, or with the arc said to be off, that is the nominal one, and so is an exposure.
    """
    nominal_s = setup.camera.exposure_s
    current = current_level(setup.arc, frame.current_a) if 0.0 < frame.current_a < MOST_CURRENT_A else 1.0
    exposure = frame.exposure_s / nominal_s if 0.0 < frame.exposure_s < MOST_EXPOSURE_S else 1.0
    return current * exposure


def _arc_flags(arc: ArcLevel) -> int:
    """Return the flags that the arc's level and misfit raise."""
    if arc is UNKNOWN:
        return flags.ARC_LEVEL_UNKNOWN.mask
    if arc.level < ARC_OFF_SIGMAS * arc.sigma:
        return flags.ARC_OFF.mask
    return flags.MAP_MISFIT.mask if arc.misfit > MISFIT_LIMIT else 0


class Tracker:
    """A thin holder of a setup's tables, the state and the scratch."""

    def __init__(self, setup: Setup, use_arc_map: bool = True, correction: Correction = UNSTATED) -> None:
        self.geometry = SensorGeometry.of(setup)
        self.state = TrackerState()
        self.use_arc_map = use_arc_map
        self.correction = correction
        self._work = Work.of(self.geometry)

    def step(self, frame: Frame, pose: Pose | None) -> Track:
        """Track one frame and keep the new state."""
        self.state, track = step(
            self.geometry, self.state, frame, pose, self._work, self.use_arc_map, self.correction
        )
        return track
