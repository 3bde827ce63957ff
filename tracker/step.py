"""The heart: one frame and one pose in, one track out, the state handed on.

Live service, replay, tests and diagnosis call the same `step` and get the same numbers.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from noise_model.arc.scene import Scene, make_scene
from noise_model.arrays import Float64
from tracker import checks, flags
from tracker.checks import Checks
from tracker.geometry import SEARCH_REACH_MM, SensorGeometry
from tracker.joint import MeasuredJoint
from tracker.measure import TRACK_REACH_MM, Reading, measure, measure_again
from tracker.seam.correction import UNSTATED, Correction
from tracker.seam.gaussian_process import WIDE_SIGMA_MM, SeamHistory
from tracker.seam.locate import (
    confidence,
    expected_seam,
    hand_eye_variance,
    locate,
    pose_checks,
)
from tracker.seam.steer import AT_ONCE, Lead, Steering, steer
from tracker.state import Frame, Pose, Track, frame_misfit
from tracker.stripe.read import Work
from tracker.stripe.scatter import NO_SCATTER, Scatter

JUMP_SIGMAS, JUMP_FLOOR_MM = 5.0, 0.3
JUMPS_TO_RELEARN, RELEARN_MM, RELEARN_SHARE = 3, 1.5, 0.5
"""So many jumps to one place are the seam's new place, if most frames show it there over such a way.

The rim of a tack shows a joint for some frames, or now and then: a seam shows it on and on.
"""

MAX_STRETCHES = 8
"""So many stretches between jumps are remembered for the torch that comes after."""

LOST_TO_FORGET = 10
"""So many frames in a row without a joint, and what was measured before no longer says where to look.

The torch, which comes later, is steered by it all the same.
"""

MAX_OFF_MM = 3.0 * WIDE_SIGMA_MM
"""A seam so far off its nominal line is none: the line would be another joint's."""

LOST_TO_SEARCH = 3
"""So many frames without a joint widen the search to what it was at first."""


@dataclass(frozen=True)
class TrackerState:
    """What one step hands to the next; it can be saved with a recording.

    Attributes
    ----------
    history : SeamHistory
        The seam from its last jump on.
    beyond : SeamHistory
        What has been measured elsewhere since. It becomes the history if it goes on so.
    behind : tuple of SeamHistory
        The latest stretches before, in which the torch may still stand.
    steering : Steering
        What the steering remembers.
    scatter : Scatter
        What the stripes so far show beyond their photons' noise.
    jumps : int
        How many frames had their joint elsewhere, since it was last where it should be.
    jumped_at : int
        The number of the frame that began them.
    lost : int
        How many frames in a row had no joint.
    frames : int
        How many frames were tracked.
    """

    history: SeamHistory = field(default_factory=SeamHistory)
    beyond: SeamHistory = field(default_factory=SeamHistory)
    behind: tuple[SeamHistory, ...] = ()
    steering: Steering = field(default_factory=Steering)
    scatter: Scatter = NO_SCATTER
    jumps: int = 0
    jumped_at: int = 0
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


@dataclass(frozen=True)
class StepInputs:
    """What a step took beside the frame; with the frame it gives the same track, bit for bit.

    Attributes
    ----------
    state : TrackerState
        What the step before handed on.
    pose : Pose or None
        The tool's pose at the capture, None where it was refused.
    lead : Lead
        How far ahead of the torch the offset was asked for.
    keeps_state : bool
        Whether what the step found counts for the next one: not where poses were doubted.
    """

    state: TrackerState
    pose: Pose | None
    lead: Lead = AT_ONCE
    keeps_state: bool = True


def step(
    geometry: SensorGeometry,
    state: TrackerState,
    frame: Frame,
    pose: Pose | None,
    work: Work,
    use_arc_map: bool = True,
    correction: Correction = UNSTATED,
    lead: Lead = AT_ONCE,
) -> tuple[TrackerState, Track]:
    """Track one frame.

    Nothing about a frame raises: what fails is NaN with a flag.

    Parameters
    ----------
    geometry : SensorGeometry
        The setup with its tables.
    state : TrackerState
        What the step before handed on.
    frame : Frame
        A raw frame and its condition.
    pose : Pose or None
        The tool's pose at the frame's time, None where it was refused.
    work : Work
        Scratch, written over.
    use_arc_map : bool
        False reads the stripe over a running median with one variance for all pixels, for comparison.
    correction : Correction
        What of the seam's displacement is sent.
    lead : Lead
        When, and how much farther along the seam, the correction will act.

    Returns
    -------
    TrackerState
        The state for the next step.
    Track
        The frame's result.
    """
    return step_and_reading(geometry, state, frame, pose, work, use_arc_map, correction, lead)[:2]


def step_and_reading(
    geometry: SensorGeometry,
    state: TrackerState,
    frame: Frame,
    pose: Pose | None,
    work: Work,
    use_arc_map: bool = True,
    correction: Correction = UNSTATED,
    lead: Lead = AT_ONCE,
) -> tuple[TrackerState, Track, Reading | None]:
    """Return what `step` does and the look at the frame that it rests on, None where it took none."""
    state = replace(state, frames=state.frames + 1)
    track = Track(frame=frame.index, timestamp_s=frame.timestamp_s, flags=0)
    asked = Checks()
    if not _can_look(asked, geometry, frame, pose) or pose is None:
        if state.steering.is_stopped:
            asked.ask(checks.FOLLOWING, False)
        return state, replace(track, flags=asked.flags, checks=tuple(asked.answers)), None

    frame, pose = _as_compiled_for(frame, pose)
    nominal_scene = make_scene(geometry.setup, pose.T_base_tool)
    confirmed = state.history if state.lost < LOST_TO_FORGET else SeamHistory()
    seam, seam_sigma = expected_seam(geometry.setup, nominal_scene, confirmed)
    reach_mm = min(SEARCH_REACH_MM, TRACK_REACH_MM + 3.0 * float(seam_sigma.max()))
    if state.lost >= LOST_TO_SEARCH:
        reach_mm = SEARCH_REACH_MM
    reading = measure(geometry, frame, pose, seam, reach_mm, work, use_arc_map, state.scatter)
    if not asked.ask(checks.REACH, reach_mm, SEARCH_REACH_MM):
        reading = measure_again(
            geometry, frame, pose, nominal_scene, seam, reading, work, use_arc_map, state.scatter
        )
    state = replace(state, scatter=reading.scatter)
    asked.extend(tuple(reading.checks.answers))
    track = replace(
        track,
        arc_level=reading.arc.level if reading.arc.is_on else np.nan,
        map_misfit=reading.arc.misfit,
        fov_margin_mm=reading.fov_margin_mm,
        stripe=reading.stripe,
    )
    if reading.joint is None:
        state = replace(state, lost=state.lost + (reading.stripe is not None))
    else:
        state, track = _follow(geometry, state, track, asked, nominal_scene, reading.scene, reading.joint)
    steering, track = steer(
        correction,
        geometry.setup,
        pose.T_base_tool,
        nominal_scene,
        state.history,
        state.history_at,
        state.steering,
        replace(track, flags=asked.flags, checks=tuple(asked.answers)),
        seam,
        lead,
    )
    return replace(state, steering=steering), track, reading


def _as_compiled_for(frame: Frame, pose: Pose) -> tuple[Frame, Pose]:
    """Return frame and pose in the layout that the kernels are compiled for: contiguous and writable."""
    image_dn = np.require(frame.image_dn, requirements=("C", "W"))
    T_base_tool = np.require(pose.T_base_tool, np.float64, ("C", "W"))
    if image_dn is not frame.image_dn:
        frame = replace(frame, image_dn=image_dn)
    if T_base_tool is not pose.T_base_tool:
        pose = replace(pose, T_base_tool=T_base_tool)
    return frame, pose


def _can_look(asked: Checks, geometry: SensorGeometry, frame: Frame, pose: Pose | None) -> bool:
    """Ask whether frame and pose allow a look at the joint."""
    fits = frame_misfit(frame.image_dn.shape, frame.image_dn.dtype, geometry.setup) is None
    if not asked.ask(checks.FRAME_FORMAT, fits) or not asked.ask(checks.POSE_KNOWN, pose is not None):
        return False
    assert pose is not None
    asked.ask(checks.POSE_BRACKETED, not pose.extrapolated)
    asked_of_pose = pose_checks(geometry.setup, pose.T_base_tool)
    asked.extend(tuple(asked_of_pose.answers))
    return asked_of_pose.flags == 0


def _follow(
    geometry: SensorGeometry,
    state: TrackerState,
    track: Track,
    asked: Checks,
    nominal_scene: Scene,
    scene: Scene,
    joint: MeasuredJoint,
) -> tuple[TrackerState, Track]:
    """Judge a measured joint against the earlier ones, and turn it into seam point and confidence."""
    setup = geometry.setup
    seam_tool, station, displacement = locate(
        setup, nominal_scene.T_joint_tool, scene, joint.y_mm, joint.z_mm
    )
    if not asked.ask(checks.NEAR_NOMINAL, float(np.abs(displacement).max()), MAX_OFF_MM):
        return replace(state, lost=state.lost + 1), track
    variance = np.diag(joint.covariance_mm2)
    expected, expected_sigma = state.history.at(station)
    limit = jump_limit_mm(expected_sigma, variance)
    history, beyond, behind, jumps, lost = state.history, SeamHistory(), state.behind, 0, 0
    jumped_at = state.jumped_at
    if len(history) and not _is_near(asked, np.abs(displacement - expected), limit):
        jumps, lost, beyond = state.jumps + 1, state.lost, state.beyond
        elsewhere, elsewhere_sigma = beyond.at(station)
        if (np.abs(displacement - elsewhere) > jump_limit_mm(elsewhere_sigma, variance)).any():
            # Nor where the last jump was: what is here and there is no seam.
            jumps, beyond = 1, SeamHistory()
        jumped_at = state.frames if jumps == 1 else jumped_at
        beyond = beyond.with_measurement(station, displacement, variance)
        way_mm = abs(station - float(beyond.stations_mm[0]))
        share = jumps / (1 + state.frames - jumped_at)
        if jumps >= JUMPS_TO_RELEARN and way_mm >= RELEARN_MM and share >= RELEARN_SHARE:
            # The torch comes to the new stretch later: until then it is on the one before, if that was one.
            if len(history) >= JUMPS_TO_RELEARN:
                behind = (*behind, history)[-MAX_STRETCHES:]
            history, beyond, jumps, lost = beyond, SeamHistory(), 0, 0
    else:
        history = history.with_measurement(station, displacement, variance)
    hand_eye = hand_eye_variance(setup, nominal_scene, seam_tool)
    steering = replace(state.steering, hand_eye_variance_mm2=(float(hand_eye[0]), float(hand_eye[1])))
    state = replace(
        state,
        history=history,
        beyond=beyond,
        behind=behind,
        steering=steering,
        jumps=jumps,
        jumped_at=jumped_at,
        lost=lost,
    )
    sigma = np.sqrt(variance + hand_eye)
    return state, replace(
        track,
        seam_tool_mm=(float(seam_tool[0]), float(seam_tool[1]), float(seam_tool[2])),
        sigma_y_mm=float(sigma[0]),
        sigma_z_mm=float(sigma[1]),
        gap_mm=joint.gap_mm,
        mismatch_mm=joint.mismatch_mm,
        confidence=confidence(setup, sigma),
        shape=joint.shape,
    )


def _is_near(asked: Checks, distance_mm: Float64, limit_mm: Float64) -> bool:
    """Ask whether a seam lies where the earlier frames put it, both (2,) as (y, z)."""
    near_y = asked.ask(checks.JUMP_Y, distance_mm[0], limit_mm[0])
    return asked.ask(checks.JUMP_Z, distance_mm[1], limit_mm[1]) and near_y


def jump_limit_mm(expected_sigma_mm: Float64, variance_mm2: Float64) -> Float64:
    """Return how far (2,) a seam may lie from where the earlier frames put it, mm, without being a jump."""
    return np.asarray(np.maximum(JUMP_SIGMAS * np.sqrt(expected_sigma_mm**2 + variance_mm2), JUMP_FLOOR_MM))
