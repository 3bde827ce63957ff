"""The heart: one frame and one pose in, one track out, the state handed on.

Live service, replay, tests and diagnosis call the same `step` and get the same numbers.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TypeGuard

import numpy as np

from noise_model.arrays import as_compiled_for
from tracker import checks, flags
from tracker.checks import Asked, ask, ask_whether, take_answer
from tracker.frame import TRACKS, FrameCall
from tracker.frame_pieces import REFUSED, TRACKED, FrameGiven, FrameTracked, begin, end, look_by, seen_by
from tracker.geometry import SensorGeometry
from tracker.joint.type_check import family_of, number_of
from tracker.look import MISFIT_LIMIT
from tracker.measure import Reading, fit_by_pieces, frame_light, look_through_effects
from tracker.seam.correction import UNSTATED, Correction
from tracker.seam.judge import SeamShown
from tracker.seam.steer import AT_ONCE, Lead, TorchOffset
from tracker.search import DONE, after_look, first_turn, settled
from tracker.state import NAN, NO_SHAPE, Frame, Pose, Track, frame_misfit
from tracker.stripe.read import Work
from tracker.tracker_state import TrackerState


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
    call: FrameCall | None = None,
) -> tuple[TrackerState, Track, Reading | None]:
    """Return what `step` does and the look at the frame that it rests on, None where it took none.

    The `call` is the setup's `prepared_call`, if there is one. A frame that contradicts the arc map and shows
    no seam over it is read as if no arc were stated: over an even background, by its own scatter.
    """
    by_map = _step_once(geometry, state, frame, pose, work, use_arc_map, correction, lead, call)
    if not (use_arc_map and _contradicts_map(by_map[2]) and not by_map[1].valid):
        return by_map
    without = replace(frame, arc_on=False)
    plain = _step_once(geometry, state, without, pose, work, use_arc_map, correction, lead, call)
    return _as_contradicted(*plain, by_map[2]) if plain[1].valid else by_map


def _contradicts_map(reading: Reading | None) -> TypeGuard[Reading]:
    """Return True if no level of the arc fits a frame off the stripe, or its misfit exceeds the limit.

    What the map predicts beneath the stripe is then no evidence against a stripe.
    """
    if reading is None or reading.flags & flags.LASER_OFF.mask:
        return False
    return bool(reading.flags & flags.ARC_LEVEL_UNKNOWN.mask) or reading.arc.misfit > MISFIT_LIMIT


def _as_contradicted(
    state: TrackerState, track: Track, reading: Reading | None, by_map: Reading
) -> tuple[TrackerState, Track, Reading | None]:
    """Return a step without the arc map, whose track says of the arc what the look with the map found."""
    assert reading is not None
    asked = reading.asked
    for question in (checks.ARC_ON, checks.ARC_LEVEL_KNOWN, checks.ARC_LEVEL, checks.MAP_MISFIT):
        take_answer(asked, by_map.asked, question)
    # It is not asked of a level that is none.
    if not asked.flags & (flags.ARC_LEVEL_UNKNOWN.mask | flags.MAP_MISFIT.mask):
        ask(asked, checks.MAP_MISFIT, by_map.arc.misfit, MISFIT_LIMIT)
    arc = by_map.arc
    told = replace(track, flags=asked.flags, checks=asked.answers, arc_level=arc.level, map_misfit=arc.misfit)
    return state, told, reading


def _step_once(
    geometry: SensorGeometry,
    state: TrackerState,
    frame: Frame,
    pose: Pose | None,
    work: Work,
    use_arc_map: bool,
    correction: Correction,
    lead: Lead,
    call: FrameCall | None,
) -> tuple[TrackerState, Track, Reading | None]:
    """Return what a step does that takes the frame's arc as it is said to be."""
    asked = Asked.nothing()
    if pose is None or not _is_readable(geometry, frame, pose):
        _ask_frame(asked, geometry, frame, pose)
        return _refused(state, asked, frame)
    frame, pose = _as_compiled_for(frame, pose)
    if not geometry.has_light_effects and geometry.setup.joint.type in TRACKS:
        track = TRACKS[geometry.setup.joint.type] if call is None else call
        tracked = track(asked, _given(geometry, state, frame, pose, work, use_arc_map, correction, lead))
        if tracked.ends == REFUSED:
            return _refused(state, asked, frame)
        if tracked.ends == TRACKED:
            return _shown(asked, frame, tracked)
    return step_by_step(geometry, state, frame, pose, work, use_arc_map, correction, lead)


def prepared_call(
    geometry: SensorGeometry, work: Work, use_arc_map: bool, correction: Correction
) -> FrameCall | None:
    """Return what tracks a setup's frames in one call, None where no one call serves them."""
    if geometry.has_light_effects or geometry.setup.joint.type not in TRACKS:
        return None
    (height, width), dtype = geometry.frame_form
    exposure_s, current_a = geometry.setup.camera.exposure_s, geometry.setup.arc.current_a
    dark = Frame(0, 0.0, np.zeros((height, width), dtype), exposure_s, current_a)
    given = _given(geometry, TrackerState(), dark, Pose(np.eye(4)), work, use_arc_map, correction, AT_ONCE)
    return FrameCall(geometry.setup.joint.type, given)


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
        number_of(family_of(geometry.setup.joint)),
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


def _shown(asked: Asked, frame: Frame, tracked: FrameTracked) -> tuple[TrackerState, Track, Reading]:
    """Return the state, the track and the look of a frame that was tracked."""
    aim, stripe, joint = tracked.aim, tracked.stripe, tracked.joint
    reading = Reading(
        asked,
        aim.scene,
        aim.seam,
        aim.reach_mm,
        tracked.arc,
        stripe if stripe.position_px.size else None,
        joint if joint.is_determined else None,
        tracked.fov_margin_mm,
        tracked.state.scatter,
        aim.scatter,
    )
    return tracked.state, _track(frame, asked, reading, tracked.shown, tracked.offset), reading


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
    """Take a step by its pieces, where Python comes in between."""
    asked = Asked.nothing()
    given = _given(geometry, state, frame, pose, work, use_arc_map, correction, lead)
    begun = begin(asked, given)
    if begun.ends == REFUSED:
        return _refused(state, asked, frame)
    turn = first_turn(asked, given, begun)
    while turn.looks != DONE:
        if geometry.has_light_effects:
            look = look_through_effects(turn.asked, geometry, frame, turn.aim, work)
        else:
            look = look_by(turn.asked, given, turn.aim)
        fitted = fit_by_pieces(turn.asked, geometry, turn.aim.scene, frame, look)
        turn = after_look(given, begun, turn, seen_by(turn.asked, given, turn.aim, look, fitted))
    return _shown(asked, frame, end(asked, given, begun, settled(asked, begun, turn)))


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
