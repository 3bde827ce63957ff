"""The heart: one frame and one pose in, one track out, the state handed on.

Live service, replay, tests and diagnosis call the same `step` and get the same numbers.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from noise_model.arrays import as_compiled_for
from tracker import checks
from tracker.checks import Asked, ask, ask_as, ask_whether
from tracker.frame import REFUSED, TRACKED, TRACKS, FrameGiven, FrameTracked, expect, reach_of
from tracker.geometry import SEARCH_REACH_MM, SensorGeometry
from tracker.measure import Reading, as_stated, frame_light, measure, measure_again
from tracker.seam.correction import UNSTATED, Correction
from tracker.seam.expected import ExpectedSeam, pose_checks
from tracker.seam.judge import Judged, SeamShown, judge
from tracker.seam.steer import AT_ONCE, Lead, TorchOffset
from tracker.state import NAN, NO_SHAPE, Frame, Pose, Track, frame_misfit
from tracker.stripe.read import Work
from tracker.tracker_state import TrackerState, state_after, stretches_of


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
    if pose is None or not _is_readable(geometry, frame, pose):
        _ask_frame(asked, geometry, frame, pose)
        return _refused(state, asked, frame)
    frame, pose = _as_compiled_for(frame, pose)
    in_one_call = None if geometry.has_light_effects else TRACKS.get(geometry.setup.joint.type)
    if in_one_call is not None:
        tracked: FrameTracked = in_one_call(
            asked, _given(geometry, state, frame, pose, work, use_arc_map, correction, lead)
        )
        if tracked.ends == REFUSED:
            return _refused(state, asked, frame)
        if tracked.ends == TRACKED:
            reading = _reading(asked, tracked, state)
            return tracked.state, _track(frame, asked, reading, tracked.shown, tracked.offset), reading
    return step_by_step(geometry, state, frame, pose, work, use_arc_map, correction, lead)


def _given(
    geometry: SensorGeometry,
    state: TrackerState,
    frame: Frame,
    pose: Pose,
    work: Work,
    use_arc_map: bool,
    correction: Correction,
    lead: Lead,
) -> FrameGiven:
    """Return what a frame is tracked with in one call."""
    return FrameGiven(
        geometry.look_source,
        geometry.stated_joint,
        correction.numbers,
        state,
        frame.image_dn,
        frame_light(geometry.setup, frame),
        pose.T_base_tool,
        bool(pose.extrapolated),
        float(frame.timestamp_s),
        Lead(float(lead.time_s), float(lead.way_mm)),
        work,
        use_arc_map,
    )


def _reading(asked: Asked, tracked: FrameTracked, before: TrackerState) -> Reading:
    """Return the look that a frame which was tracked in one call rests on."""
    return Reading(
        asked,
        tracked.scene,
        tracked.seam,
        tracked.reach_mm,
        tracked.arc,
        tracked.stripe if tracked.stripe.position_px.size else None,
        tracked.joint if tracked.joint.is_determined else None,
        tracked.fov_margin_mm,
        tracked.state.scatter,
        before.scatter,
    )


def step_by_step(
    geometry: SensorGeometry,
    state: TrackerState,
    frame: Frame,
    pose: Pose,
    work: Work,
    use_arc_map: bool,
    correction: Correction,
    lead: Lead,
) -> tuple[TrackerState, Track, Reading | None]:
    """Take a step by its pieces: a search, and what no one call serves."""
    asked, source = Asked.nothing(), geometry.look_source
    _ask_frame(asked, geometry, frame, pose)
    expected: ExpectedSeam = expect(source, state, pose.T_base_tool)
    if not pose_checks(asked, source.seam, expected.pose):
        return _refused(state, asked, frame)
    reach_mm: float = reach_of(state, expected)
    reading = measure(geometry, frame, pose, expected.line, reach_mm, work, use_arc_map, state.scatter)
    if not ask(asked, checks.REACH, reach_mm, SEARCH_REACH_MM):
        again = measure_again(
            geometry,
            frame,
            pose,
            expected.scene,
            expected.line,
            reading,
            work,
            use_arc_map,
            state.scatter,
        )
        reading = as_stated(again)
    ask_as(asked, reading.asked)
    joint, unknown = reading.joint, (NAN, NAN)
    judged: Judged = judge(
        asked,
        source.seam,
        correction.numbers,
        stretches_of(state),
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
    track = _track(frame, asked, reading, judged.shown, judged.offset)
    return state_after(state, judged.stretches, judged.steering, reading.scatter), track, reading


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


def _is_readable(geometry: SensorGeometry, frame: Frame, pose: Pose) -> bool:
    """Say whether a frame and a pose have their form."""
    image_dn = frame.image_dn
    return pose.T_base_tool.shape == (4, 4) and (image_dn.shape, image_dn.dtype) == geometry.frame_form


def _ask_frame(asked: Asked, geometry: SensorGeometry, frame: Frame, pose: Pose | None) -> None:
    """Ask whether a frame has its form and a pose, and whether the pose has its own."""
    fits = frame_misfit(frame.image_dn.shape, frame.image_dn.dtype, geometry.setup) is None
    is_known = ask_whether(asked, checks.FRAME_FORMAT, fits) and ask_whether(
        asked, checks.POSE_KNOWN, pose is not None
    )
    if is_known and pose is not None:
        ask_whether(asked, checks.POSE_BRACKETED, not pose.extrapolated)
        if pose.T_base_tool.shape != (4, 4):
            ask_whether(asked, checks.POSE_RIGID, False)


def _track(frame: Frame, asked: Asked, reading: Reading, shown: SeamShown, offset: TorchOffset) -> Track:
    """Return what a step says of a frame that it looked at."""
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
