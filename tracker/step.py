"""The heart: one frame and one pose in, one track out, the state handed on.

Live service, replay, tests and diagnosis call the same `step` and get the same numbers.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from noise_model.arrays import as_compiled_for
from tracker import checks, flags
from tracker.checks import Asked, ask, ask_as, ask_whether
from tracker.geometry import SEARCH_REACH_MM, SensorGeometry
from tracker.measure import TRACK_REACH_MM, Reading, measure, measure_again
from tracker.seam.correction import UNSTATED, Correction
from tracker.seam.expected import expect_seam, pose_checks
from tracker.seam.gaussian_process import NO_HISTORY, SeamHistory
from tracker.seam.judge import Judged, judge
from tracker.seam.steer import AT_ONCE, Lead, Steering
from tracker.seam.stretches import PastStretches, Stretches
from tracker.state import NAN, NO_SHAPE, Frame, Pose, Track, frame_misfit
from tracker.stripe.read import Work
from tracker.stripe.scatter import NO_SCATTER, Scatter

LOST_TO_FORGET = 10
"""So many frames in a row without a joint, and what was measured before no longer says where to look.

The torch, which comes later, is steered by it all the same.
"""

LOST_TO_SEARCH = 3
"""So many frames without a joint widen the search to what it was at first."""


class TrackerState(NamedTuple):
    """What one step hands to the next; it can be saved with a recording.

    Attributes
    ----------
    history : SeamHistory
        The seam from its last jump on.
    beyond : SeamHistory
        What has been measured elsewhere since. It becomes the history if it goes on so.
    behind : PastStretches
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

    history: SeamHistory = NO_HISTORY
    beyond: SeamHistory = NO_HISTORY
    behind: PastStretches = PastStretches()
    steering: Steering = Steering()
    scatter: Scatter = NO_SCATTER
    jumps: int = 0
    jumped_at: int = 0
    lost: int = 0
    frames: int = 0

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
    asked = Asked.nothing()
    if not _is_readable(asked, geometry, frame, pose) or pose is None:
        return _refused(state, asked, frame)
    frame, pose = _as_compiled_for(frame, pose)
    source = geometry.seam_source
    confirmed = state.history if state.lost < LOST_TO_FORGET else NO_HISTORY
    expected = expect_seam(source, pose.T_base_tool, confirmed)
    if not pose_checks(asked, source, expected.pose):
        return _refused(state, asked, frame)
    seam, scene = expected.line, expected.scene
    reach_mm = min(SEARCH_REACH_MM, TRACK_REACH_MM + 3.0 * max(expected.sigma_mm))
    if state.lost >= LOST_TO_SEARCH:
        reach_mm = SEARCH_REACH_MM
    reading = measure(geometry, frame, pose, seam, reach_mm, work, use_arc_map, state.scatter)
    if not ask(asked, checks.REACH, reach_mm, SEARCH_REACH_MM):
        reading = measure_again(geometry, frame, pose, scene, seam, reading, work, use_arc_map, state.scatter)
    ask_as(asked, reading.asked)
    joint, unknown = reading.joint, (NAN, NAN)
    judged = judge(
        asked,
        source,
        correction.numbers,
        Stretches(state.history, state.beyond, state.behind, state.jumps, state.jumped_at, state.lost),
        state.steering,
        state.frames + 1,
        expected,
        reading.scene,
        unknown if joint is None else (joint.y_mm, joint.z_mm),
        unknown if joint is None else (joint.covariance_mm2[0, 0], joint.covariance_mm2[1, 1]),
        reading.stripe is not None,
        float(frame.timestamp_s),
        lead,
    )
    stretches = judged.stretches
    track = _track(frame, asked, reading, judged)
    state = TrackerState(
        stretches.history,
        stretches.beyond,
        stretches.behind,
        judged.steering,
        reading.scatter,
        stretches.jumps,
        stretches.jumped_at,
        stretches.lost,
        state.frames + 1,
    )
    return state, track, reading


def _refused(state: TrackerState, asked: Asked, frame: Frame) -> tuple[TrackerState, Track, None]:
    """Return what a step does that took no look."""
    if state.steering.is_stopped:
        ask_whether(asked, checks.FOLLOWING, False)
    track = Track(frame.index, frame.timestamp_s, asked.flags, checks=asked.answers)
    return state._replace(frames=state.frames + 1), track, None


def _as_compiled_for(frame: Frame, pose: Pose) -> tuple[Frame, Pose]:
    """Return frame and pose in the layout that the kernels are compiled for: contiguous and writable."""
    image_dn, T_base_tool = frame.image_dn, as_compiled_for(pose.T_base_tool)
    if not image_dn.flags.carray:
        frame = replace(frame, image_dn=np.require(image_dn, requirements=("C", "W", "A")))
    return frame, pose if T_base_tool is pose.T_base_tool else replace(pose, T_base_tool=T_base_tool)


def _is_readable(asked: Asked, geometry: SensorGeometry, frame: Frame, pose: Pose | None) -> bool:
    """Ask whether a frame has its form and a pose, and whether the pose has its own."""
    fits = frame_misfit(frame.image_dn.shape, frame.image_dn.dtype, geometry.setup) is None
    if not ask_whether(asked, checks.FRAME_FORMAT, fits) or not ask_whether(
        asked, checks.POSE_KNOWN, pose is not None
    ):
        return False
    assert pose is not None
    ask_whether(asked, checks.POSE_BRACKETED, not pose.extrapolated)
    return pose.T_base_tool.shape == (4, 4) or ask_whether(asked, checks.POSE_RIGID, False)


def _track(frame: Frame, asked: Asked, reading: Reading, judged: Judged) -> Track:
    """Return what a step says of a frame that it looked at."""
    shown, offset = judged.shown, judged.offset
    joint = reading.joint if shown.is_shown else None
    return Track(
        frame.index,
        frame.timestamp_s,
        asked.flags,
        seam_tool_mm=shown.seam_tool_mm,
        sigma_y_mm=shown.sigma_y_mm,
        sigma_z_mm=shown.sigma_z_mm,
        offset_y_mm=offset.offset_y_mm,
        offset_z_mm=offset.offset_z_mm,
        offset_sigma_y_mm=offset.offset_sigma_y_mm,
        offset_sigma_z_mm=offset.offset_sigma_z_mm,
        offset_confidence=offset.offset_confidence,
        valid_at_s=offset.valid_at_s,
        gap_mm=NAN if joint is None else joint.gap_mm,
        mismatch_mm=NAN if joint is None else joint.mismatch_mm,
        confidence=shown.confidence,
        joint_start_mm=offset.joint_start_mm,
        joint_end_mm=offset.joint_end_mm,
        arc_level=reading.arc.level if reading.arc.is_on else NAN,
        map_misfit=reading.arc.misfit,
        fov_margin_mm=reading.fov_margin_mm,
        shape=NO_SHAPE if joint is None else joint.shape,
        stripe=reading.stripe,
        checks=asked.answers,
    )
