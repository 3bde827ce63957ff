"""Step of the tracker: one frame and one pose in, one track out, the state handed on.

Live service, replay, tests and diagnosis call the same `step` and get the same numbers.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from noise_model.compiled.arrays import as_compiled_for
from tracker import checks, flags
from tracker.checks import FrameChecks
from tracker.geometry import SensorGeometry
from tracker.judge import SeamEstimate
from tracker.observation import MISFIT_LIMIT, FrameInput, Reading, exposure_ratio
from tracker.pipeline import FrameResult, track_frame
from tracker.seam.correction import UNSTATED, Correction
from tracker.seam.expected import expect_torch, is_rotation
from tracker.state import AT_ONCE, NAN, NO_SHAPE, Frame, OffsetLookAhead, Pose, Track, frame_misfit
from tracker.steer import steer
from tracker.stripe.read import Work
from tracker.tracker_state import TrackerMemory


@dataclass(frozen=True)
class StepInputs:
    """Inputs of a step other than the frame; with the frame they give the same track, bit for bit.

    `pose` is the tool's at the capture, None where it was refused; `lead` is the offset's look-ahead. Without
    `keeps_state` the step's findings, but for those of the arc, do not count for the next one, as where poses
    were doubted.
    """

    state: TrackerMemory
    pose: Pose | None
    lead: OffsetLookAhead = AT_ONCE
    keeps_state: bool = True


def step(
    geometry: SensorGeometry,
    state: TrackerMemory,
    frame: Frame,
    pose: Pose | None,
    work: Work,
    use_arc_map: bool = True,
    correction: Correction = UNSTATED,
    lead: OffsetLookAhead = AT_ONCE,
) -> tuple[TrackerMemory, Track, Reading | None]:
    """Track one frame; return the next state, the track, and the reading that it rests on, None without one.

    Nothing about a frame raises: what fails is NaN with a flag. One that contradicts the arc map is read as
    if no arc were stated, over an even background and by its own scatter, where it shows a seam so.

    `pose` is the tool's at the frame's time, None where it was refused; `work` is scratch. Without
    `use_arc_map` the stripe is read over a running median with one variance for all pixels, for comparison.
    `correction` is the part of the seam's displacement that is sent, `lead` when, and how much farther along
    the seam, it will act.
    """
    frame_checks = FrameChecks()
    form = frame.image_dn.shape, frame.image_dn.dtype
    if pose is None or pose.T_base_tool.shape != (4, 4) or form != geometry.frame_form:
        _check_form(frame_checks, geometry, frame, pose)
        return _refused(state, frame_checks, frame)
    frame, pose = _as_compiled_for(frame, pose)
    lead = OffsetLookAhead(float(lead.time_s), float(lead.way_mm))
    T_base_tool, extrapolated = pose.T_base_tool, bool(pose.extrapolated)
    given = FrameInput(
        geometry=geometry,
        state=state,
        frame=frame,
        T_base_tool=T_base_tool,
        is_extrapolated=extrapolated,
        work=work,
        use_arc_map=use_arc_map,
        correction=correction,
        lead=lead,
        arc_burns=frame.arc_on,
    )
    if state.earlier is not None and not state.earlier.uses_laser:
        return _follow_blind(given, frame_checks)
    tracked = _track_with_arc(given, frame_checks, frame.arc_on)
    if tracked is None:
        return _refused(state, frame_checks, frame)
    by_map = tracked.state, _track(frame, tracked), tracked.reading
    if not (use_arc_map and _contradicts_map(tracked.reading)):
        return by_map
    unlit = given._replace(frame=replace(frame, arc_on=False), arc_burns=True)
    plain = _track_with_arc(unlit, FrameChecks(), frame.arc_on)
    if plain is None or not _track(frame, plain).valid:
        return by_map
    return _as_contradicted(frame, plain, tracked.reading)


def _follow_blind(given: FrameInput, frame_checks: FrameChecks) -> tuple[TrackerMemory, Track, None]:
    """Return the step of a pass that follows an earlier one without the laser; the frame is its time."""
    source, frame, before = given.geometry.seam_source, given.frame, given.state
    frame_checks.ask_whether(checks.FRAME_FORMAT, True)
    frame_checks.ask_whether(checks.POSE_KNOWN, True)
    frame_checks.ask_whether(checks.POSE_BRACKETED, not given.is_extrapolated)
    if not frame_checks.ask_whether(checks.POSE_RIGID, is_rotation(given.T_base_tool.tolist())):
        return _refused(before, frame_checks, frame)
    frame_checks.ask_whether(checks.LASER_ON, False)
    expected = expect_torch(source, given.T_base_tool)
    steering, offset = steer(frame_checks, given, expected, before, False)
    track = Track(
        frame.index, frame.timestamp_s, frame_checks.flags, **offset._asdict(), checks=frame_checks.answers
    )
    return before._replace(steering=steering, frames=before.frames + 1), track, None


def _track_with_arc(given: FrameInput, frame_checks: FrameChecks, is_stated: bool) -> FrameResult | None:
    """Track a frame, and hold the arc in its picture against the frames before and against what is stated."""
    tracked = track_frame(given, frame_checks)
    burns = None if tracked is None else tracked.reading.evidence.burns
    if tracked is None or burns is None:
        return tracked
    before, contradiction = given.state.arc.burns, flags.ARC_UNANNOUNCED if burns else flags.ARC_NOT_SEEN
    frame_checks.ask(checks.ARC_AS_STATED, float(burns is is_stated), 1.0, contradiction)
    # An arc that ends as stated is not lost.
    if before is not None and (burns or is_stated):
        event = flags.ARC_IGNITED if burns else flags.ARC_LOST
        frame_checks.ask(checks.ARC_AS_BEFORE, float(burns is before), 1.0, event)
    arc = given.state.arc.after(tracked.reading.evidence, exposure_ratio(given.geometry.setup, given.frame))
    return tracked._replace(state=tracked.state._replace(arc=arc))


def _contradicts_map(reading: Reading) -> bool:
    """Return True if no level of the arc fits a frame off the stripe, or its misfit exceeds the limit.

    What the map predicts beneath the stripe is then evidence neither for a stripe nor against one.
    """
    if reading.flags & flags.LASER_OFF.mask:
        return False
    return bool(reading.flags & flags.ARC_LEVEL_UNKNOWN.mask) or reading.arc.misfit > MISFIT_LIMIT


def _as_contradicted(
    frame: Frame, plain: FrameResult, by_map: Reading
) -> tuple[TrackerMemory, Track, Reading]:
    """Return a step without the arc map, whose track says of the arc what the look with the map found."""
    reading, arc = plain.reading, by_map.arc
    for question in (checks.ARC_ON, checks.ARC_LEVEL_KNOWN, checks.ARC_LEVEL, checks.MAP_MISFIT):
        reading.checks.take_answer(by_map.checks, question)
    # It is not asked of a level that is none.
    if not reading.flags & (flags.ARC_LEVEL_UNKNOWN.mask | flags.MAP_MISFIT.mask):
        reading.checks.ask(checks.MAP_MISFIT, arc.misfit, MISFIT_LIMIT)
    track = replace(
        _track(frame, plain),
        arc_level=arc.level,
        arc_level_sigma=by_map.evidence.sigma,
        map_misfit=arc.misfit,
    )
    return plain.state, track, reading


def _refused(
    state: TrackerMemory, frame_checks: FrameChecks, frame: Frame
) -> tuple[TrackerMemory, Track, None]:
    """Return the result of a step that took no look."""
    if state.steering.is_stopped:
        frame_checks.ask_whether(checks.FOLLOWING, False)
    track = Track(frame.index, frame.timestamp_s, frame_checks.flags, checks=frame_checks.answers)
    return state._replace(frames=state.frames + 1), track, None


def _as_compiled_for(frame: Frame, pose: Pose) -> tuple[Frame, Pose]:
    """Return frame and pose in the layout that the kernels are compiled for: contiguous and writable."""
    image_dn, T_base_tool = frame.image_dn, as_compiled_for(pose.T_base_tool)
    if not image_dn.flags.carray:
        frame = replace(frame, image_dn=np.require(image_dn, requirements=("C", "W", "A")))
    return frame, pose if T_base_tool is pose.T_base_tool else replace(pose, T_base_tool=T_base_tool)


def _check_form(frame_checks: FrameChecks, geometry: SensorGeometry, frame: Frame, pose: Pose | None) -> None:
    """Test whether a frame has its form and a pose, and whether the pose has its own."""
    fits = frame_misfit(frame.image_dn.shape, frame.image_dn.dtype, geometry.setup) is None
    if not (
        frame_checks.ask_whether(checks.FRAME_FORMAT, fits)
        and frame_checks.ask_whether(checks.POSE_KNOWN, pose is not None)
    ):
        return
    assert pose is not None
    frame_checks.ask_whether(checks.POSE_BRACKETED, not pose.extrapolated)
    if pose.T_base_tool.shape != (4, 4):
        frame_checks.ask_whether(checks.POSE_RIGID, False)


def _track(frame: Frame, tracked: FrameResult) -> Track:
    """Return the track of a frame that a step looked at."""
    reading = tracked.reading
    shown = SeamEstimate() if tracked.shown is None else tracked.shown
    joint = None if tracked.shown is None else reading.joint
    return Track(
        frame.index,
        frame.timestamp_s,
        reading.flags,
        **shown._asdict(),
        **tracked.offset._asdict(),
        gap_mm=NAN if joint is None else joint.gap_mm,
        mismatch_mm=NAN if joint is None else joint.mismatch_mm,
        arc_level=reading.arc.level if reading.arc.is_on else NAN,
        arc_level_sigma=reading.evidence.sigma if reading.arc.is_on else NAN,
        map_misfit=reading.arc.misfit,
        fov_margin_mm=reading.fov_margin_mm,
        shape=NO_SHAPE if joint is None else joint.shape,
        stripe=reading.stripe,
        checks=reading.checks.answers,
    )
