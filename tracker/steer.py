"""Steering: the proposed offset from the seam along the path.

The offset depends on what is known of the seam where the torch stands, not on whether the present frame shows
it: the torch follows the measured stretch for the whole look-ahead while the sensor is blind or past the
joint's end. The seam is lost once the torch leaves that stretch. A frame that cannot be read and a pose that
is refused say nothing of where the torch is: for those, and for offsets that come too late, jump or lie out
of range, the gate holds what was sent last, by its age, and then refuses.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from tracker import checks, flags
from tracker.checks import FrameChecks
from tracker.judge import jump_limit_mm
from tracker.observation import FrameInput
from tracker.seam.correction import CorrectedOffset, Correction, correct
from tracker.seam.earlier_pass import MAX_TILT_OFF_DEG, EarlierPass, KnownSeam, tool_tilt_deg
from tracker.seam.expected import ExpectedSeam
from tracker.seam.gaussian_process import SPACING_MM, stretch_at
from tracker.seam.joint_ends import Change
from tracker.seam.locate import confidence, ridge_mm
from tracker.state import UNKNOWN, Pair
from tracker.tracker_state import Steering, TrackerMemory

NO_LOOK = flags.LASER_OFF.mask | flags.BELOW_SURFACE.mask | flags.SEAM_OUT_OF_VIEW.mask
"""A frame with these says nothing of whether there is a joint."""


class SeamAtTorch(NamedTuple):
    """The seam's displacement and 1 sigma as (y, z) at the torch, mm, NaN where it is not known."""

    displacement_mm: Pair = UNKNOWN
    sigma_mm: Pair = UNKNOWN
    stops_following: bool = False


def seam_at_torch(
    frame_checks: FrameChecks,
    known: KnownSeam,
    correction: Correction,
    torch_mm: float,
    stretch_mm: Pair,
    goes_on: bool = False,
) -> SeamAtTorch:
    """Return the seam where the torch stands; `stretch_mm` are the stations of the joint's start and end.

    Before the joint it is the seam at its start. Before its first measurement it is extrapolated by the
    process. Past the last measurement the seam is lost: its last position is held, at a sigma that includes
    the process's expected change since, or the process goes on, both within the correction's limits; or
    following stops, but not within SPACING_MM, where the joint's very end may lie. A seam that `goes_on` in
    another stretch beyond is not lost.
    """
    ask, (start_mm, end_mm) = frame_checks.ask, stretch_mm
    if not ask(checks.TORCH_BEFORE_END, torch_mm - end_mm, 0.0):
        return SeamAtTorch()
    ask(checks.TORCH_AFTER_START, start_mm - torch_mm, 0.0)
    station_mm = max(torch_mm, start_mm)
    if known.earlier is not None and not _is_as_before(frame_checks, known, station_mm):
        return SeamAtTorch()
    if not frame_checks.ask_whether(checks.SEAM_MEASURED, known.n > 0):
        return SeamAtTorch()
    there = known.at(station_mm)
    displacement, sigma = there.displacement_mm, there.sigma_mm
    lost_mm = torch_mm - there.last_mm if torch_mm >= start_mm and not goes_on else 0.0
    if correction.when_lost == "stop" and not ask(
        checks.SEAM_NOT_LOST, lost_mm, SPACING_MM, flags.FOLLOW_STOPPED
    ):
        return SeamAtTorch(stops_following=True)
    if correction.when_lost == "hold" and not ask(checks.SEAM_NOT_LOST, lost_mm, 0.0):
        held = known.at(there.last_mm).displacement_mm
        gone_y_mm, gone_z_mm = displacement[0] - held[0], displacement[1] - held[1]
        sigma = math.hypot(sigma[0], gone_y_mm), math.hypot(sigma[1], gone_z_mm)
        displacement = held
    else:
        frame_checks.ask_whether(checks.TORCH_MEASURED, there.first_mm <= station_mm <= there.last_mm)
    if not ask(checks.REACHED, lost_mm, correction.extrapolate_mm):
        return SeamAtTorch()
    if not ask(checks.TORCH_SIGMA, max(sigma), correction.extrapolate_sigma_mm):
        return SeamAtTorch()
    return SeamAtTorch(displacement, sigma)


def _is_as_before(frame_checks: FrameChecks, known: KnownSeam, station_mm: float) -> bool:
    """Return True if an earlier pass is usable, and does not contradict what is seen now at a station."""
    before = known.before(station_mm)
    if not frame_checks.ask_whether(checks.PASS_USABLE, before is not None):
        return False
    assert before is not None
    frame_checks.ask(checks.PASS_SHARE, known.share_before(station_mm), 0.5)
    seen = known.source.seam_at(known.history, station_mm)
    agrees = True
    for question, axis in ((checks.PASS_AGREES_Y, 0), (checks.PASS_AGREES_Z, 1)):
        away_mm = abs(seen.displacement_mm[axis] - before.displacement_mm[axis])
        limit_mm = jump_limit_mm(before.sigma_mm[axis], seen.sigma_mm[axis] ** 2)
        agrees = frame_checks.ask(question, away_mm, limit_mm) and agrees
    return agrees


class TorchOffset(NamedTuple):
    """A track's offset and ends of the joint; see `state.Track`."""

    offset_y_mm: float
    offset_z_mm: float
    offset_sigma_y_mm: float
    offset_sigma_z_mm: float
    offset_confidence: float
    valid_at_s: float
    joint_start_mm: Pair
    joint_end_mm: Pair


def steer(
    frame_checks: FrameChecks, given: FrameInput, expected: ExpectedSeam, state: TrackerMemory, is_shown: bool
) -> tuple[Steering, TorchOffset]:
    """Return the proposed offset, and the steering's next state.

    `state` includes the frame's own measurement. The frame's checks say whether a seam that `is_shown` is
    valid; those of the torch's position are added. The torch is taken to be where it will be after the lead.
    """
    steering, correction, lead = state.steering, given.correction, given.lead
    source = given.geometry.seam_source
    ends, torch_mm, raised = steering.ends, expected.torch_mm + lead.way_mm, frame_checks.flags
    if correction.ends_mm > 0.0 and not raised & NO_LOOK:
        is_valid = is_shown and not raised & flags.INVALIDATING
        ends = ends.with_look(expected.line.station_mm, is_valid, expected.ends_mm, correction.ends_mm)
    joint_mm = ends.stretch_mm(expected.ends_mm, correction.ends_mm)
    history, is_present = stretch_at(state.history, state.behind, max(torch_mm, joint_mm[0]))
    known = KnownSeam(source, history, state.earlier)
    seam = SeamAtTorch()
    if _is_tilted_as_stated(frame_checks, given, expected, state.earlier):
        seam = seam_at_torch(frame_checks, known, correction, torch_mm, joint_mm, not is_present)
    height_mm = 0.0
    if correction.corrugation == "followed":
        height_mm = ridge_mm(torch_mm, source.scene.shape.corrugation)
    sent = correct(correction, seam.displacement_mm, height_mm)
    if steering.is_stopped or seam.stops_following:
        sent = CorrectedOffset(UNKNOWN, False, True)
    frame_checks.ask_whether(checks.OFFSET_WITHIN, not sent.is_limited)
    frame_checks.ask_whether(checks.FOLLOWING, not sent.is_stopped)
    y_mm, z_mm = sent.offset_mm
    sigma_y_mm = math.nan if math.isnan(y_mm) else seam.sigma_mm[0]
    sigma_z_mm = math.nan if math.isnan(z_mm) else seam.sigma_mm[1]
    calibration_y, calibration_z = steering.hand_eye_variance_mm2
    if state.earlier is not None:
        # The same calibration's, of either pass.
        calibration_y, calibration_z = map(
            max, steering.hand_eye_variance_mm2, state.earlier.calibration_variance_mm2
        )
    weld_mm, timestamp_s = source.weld_mm, float(given.frame.timestamp_s)
    offset = TorchOffset(
        offset_y_mm=y_mm,
        offset_z_mm=z_mm,
        offset_sigma_y_mm=sigma_y_mm,
        offset_sigma_z_mm=sigma_z_mm,
        offset_confidence=_confidence(weld_mm, sigma_y_mm**2 + calibration_y, sigma_z_mm**2 + calibration_z),
        valid_at_s=math.nan if math.isnan(y_mm) and math.isnan(z_mm) else timestamp_s + lead.time_s,
        joint_start_mm=_where(ends.start),
        joint_end_mm=_where(ends.end),
    )
    return steering._replace(ends=ends, is_stopped=sent.is_stopped), offset


def _is_tilted_as_stated(
    frame_checks: FrameChecks, given: FrameInput, expected: ExpectedSeam, earlier: EarlierPass | None
) -> bool:
    """Return True if the tool leans as the pass states, or no earlier pass says how."""
    if earlier is None or earlier.history.n == 0:
        return True
    T_joint_tool = given.geometry.seam_source.T_joint_base[expected.torch_segment] @ given.T_base_tool
    off_deg = earlier.tilt_off_deg(expected.torch_mm, tool_tilt_deg(T_joint_tool))
    return frame_checks.ask(checks.PASS_TILT, off_deg, MAX_TILT_OFF_DEG)


def _confidence(weld_mm: float, variance_y_mm2: float, variance_z_mm2: float) -> float:
    """Return the probability that the offsets that are known are right within the tolerance, NaN for none."""
    knows_y, knows_z = math.isfinite(variance_y_mm2), math.isfinite(variance_z_mm2)
    if not (knows_y or knows_z):
        return math.nan
    sigma_y_mm = math.sqrt(variance_y_mm2) if knows_y else 0.0
    sigma_z_mm = math.sqrt(variance_z_mm2) if knows_z else 0.0
    return confidence(weld_mm, sigma_y_mm, sigma_z_mm)


def _where(change: Change) -> Pair:
    """Return the station of a change and its 1 sigma, mm; NaN where it was not seen."""
    return (change.station_mm, change.sigma_mm) if change.is_seen else UNKNOWN
