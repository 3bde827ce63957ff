"""What a step does after its look, in plain Python: the torch's seam, its correction and the joint's ends."""

from __future__ import annotations

import math
from typing import NamedTuple

from noise_model.surface.faces import ridge
from tracker import checks, flags
from tracker.checks import Asked, ask, ask_raising, ask_whether
from tracker.seam.correction import Correction
from tracker.seam.expected import ExpectedSeam
from tracker.seam.gaussian_process import SPACING_MM, SeamHistory
from tracker.seam.joint_ends import DECIDE_MM, FALSE_ALARM, FALSE_SHARE, FOUND_SHARE, Change, JointEnds
from tracker.seam.steer import NO_LOOK, Lead, Steering
from tracker.seam.stretches import Stretches

Pair = tuple[float, float]
UNKNOWN = (math.nan, math.nan)


class PlainOffset(NamedTuple):
    """What a track says of its offset: pairs are (y, z)."""

    offset_mm: Pair
    sigma_mm: Pair
    confidence: float
    valid_at_s: float


def plain_confidence(weld_mm: float, sigmas_mm: list[float]) -> float:
    """The probability that errors of these 1 sigmas, mm, all stay within the tolerance, mm; NaN of none."""
    if not sigmas_mm:
        return math.nan
    return math.prod(math.erf(weld_mm / math.sqrt(2.0) / sigma) for sigma in sigmas_mm)


def plain_history_at(stretches: Stretches, station_mm: float) -> SeamHistory:
    """The latest stretch that has measured a station, else that of the nearer of two."""
    past = stretches.behind.histories
    for measured in (stretches.history, *reversed(past)):
        if not past or (measured.n and min(measured.stations_mm) <= station_mm <= max(measured.stations_mm)):
            return measured
    stretch = stretches.history
    for before in reversed(past):
        if stretch.n and station_mm >= 0.5 * (max(before.stations_mm) + min(stretch.stations_mm)):
            return stretch
        stretch = before
    return stretch


def plain_ends(
    ends: JointEnds, station_mm: float, is_found: bool, nominal_mm: Pair, within_mm: float
) -> JointEnds:
    """The joint's ends after a look at a station; a change's own odds are held to their sum elsewhere."""
    ratio = FOUND_SHARE / FALSE_SHARE if is_found else (1.0 - FOUND_SHARE) / (1.0 - FALSE_SHARE)
    from_start_mm, from_end_mm = (station_mm - end_mm for end_mm in nominal_mm)
    if not is_behind(ends.start) and from_start_mm <= within_mm + DECIDE_MM:
        if from_start_mm >= -within_mm:
            return ends._replace(start=ends.start.with_look(station_mm, ratio))
    elif not is_behind(ends.end) and -within_mm <= from_end_mm <= within_mm + DECIDE_MM:
        return ends._replace(end=ends.end.with_look(station_mm, 1.0 / ratio))
    return ends


def is_behind(change: Change) -> bool:
    """Whether a change is behind."""
    return change.odds + change.before >= 1.0 / FALSE_ALARM


def is_passed(change: Change) -> bool:
    """Whether a change is behind and was passed while looking."""
    return is_behind(change) and change.odds > change.before


def plain_torch(
    asked: Asked, correction: Correction, history: SeamHistory, torch_mm: float, joint_mm: Pair, goes_on: bool
) -> tuple[Pair, Pair]:
    """The seam's displacement and 1 sigma where the torch stands."""
    start_mm, end_mm = joint_mm
    if not ask(asked, checks.TORCH_BEFORE_END, torch_mm - end_mm, 0.0):
        return UNKNOWN, UNKNOWN
    ask(asked, checks.TORCH_AFTER_START, start_mm - torch_mm, 0.0)
    if not ask_whether(asked, checks.SEAM_MEASURED, history.n > 0):
        return UNKNOWN, UNKNOWN
    station_mm = max(torch_mm, start_mm)
    there = history.point_at(station_mm)
    displacement, sigma = there.displacement_mm, there.sigma_mm
    lost_mm = torch_mm - max(history.stations_mm) if torch_mm >= start_mm and not goes_on else 0.0
    stops, mask = correction.when_lost == "stop", flags.FOLLOW_STOPPED.mask
    if stops and not ask_raising(asked, checks.SEAM_NOT_LOST, lost_mm, SPACING_MM, mask):
        return UNKNOWN, UNKNOWN
    if correction.when_lost == "hold" and not ask(asked, checks.SEAM_NOT_LOST, lost_mm, 0.0):
        held = history.point_at(max(history.stations_mm)).displacement_mm
        (y_mm, z_mm), (sigma_y, sigma_z) = displacement, sigma
        displacement = held
        sigma = math.hypot(sigma_y, y_mm - held[0]), math.hypot(sigma_z, z_mm - held[1])
    else:
        ask_whether(asked, checks.TORCH_MEASURED, history.is_measured(station_mm))
    if not ask(asked, checks.REACHED, lost_mm, correction.extrapolate_mm):
        return UNKNOWN, UNKNOWN
    if not ask(asked, checks.TORCH_SIGMA, max(sigma), correction.extrapolate_sigma_mm):
        return UNKNOWN, UNKNOWN
    return displacement, sigma


def plain_correct(correction: Correction, displacement_mm: Pair, height_mm: float) -> tuple[Pair, bool, bool]:
    """What is sent, whether a limit cut it, and whether following stops."""
    offset_mm, is_limited = [math.nan, math.nan], False
    for i, (axis, drawn_mm) in enumerate(((correction.y, 0.0), (correction.z, height_mm))):
        if not axis.enable:
            continue
        sent_mm = axis.gain * displacement_mm[i] + drawn_mm + axis.bias_mm
        if abs(sent_mm) > axis.limit_mm:
            if axis.at_limit == "stop":
                return UNKNOWN, False, True
            is_limited, sent_mm = True, math.copysign(axis.limit_mm, sent_mm)
        offset_mm[i] = sent_mm
    return (offset_mm[0], offset_mm[1]), is_limited, False


def plain_steer(
    asked: Asked,
    correction: Correction,
    weld_mm: float,
    expected: ExpectedSeam,
    stretches: Stretches,
    steering: Steering,
    is_seam_shown: bool,
    timestamp_s: float,
    lead: Lead,
) -> tuple[Steering, PlainOffset]:
    """What is handed on, and the offset that is proposed to the gate."""
    ends, torch_mm = steering.ends, expected.torch_mm + lead.way_mm
    if correction.ends_mm > 0.0 and not asked.flags & NO_LOOK:
        is_valid = is_seam_shown and not asked.flags & flags.INVALIDATING
        ends = plain_ends(ends, expected.line.station_mm, is_valid, expected.ends_mm, correction.ends_mm)
    joint_mm = (
        ends.start.station_mm if is_passed(ends.start) else expected.ends_mm[0] - correction.ends_mm,
        ends.end.station_mm if is_passed(ends.end) else expected.ends_mm[1] + correction.ends_mm,
    )
    history = plain_history_at(stretches, max(torch_mm, joint_mm[0]))
    goes_on = history is not stretches.history
    displacement_mm, sigma_mm = plain_torch(asked, correction, history, torch_mm, joint_mm, goes_on)
    follows = correction.corrugation == "followed"
    height_mm = ridge(torch_mm, expected.scene.shape.corrugation)[0] if follows else 0.0
    offset_mm, is_limited, stops = plain_correct(correction, displacement_mm, height_mm)
    if steering.is_stopped or asked.flags & flags.FOLLOW_STOPPED.mask:
        offset_mm, is_limited, stops = UNKNOWN, False, True
    ask_whether(asked, checks.OFFSET_WITHIN, not is_limited)
    ask_whether(asked, checks.FOLLOWING, not stops)
    known = [not math.isnan(value) for value in offset_mm]
    y_mm, z_mm = (sigma if is_known else math.nan for sigma, is_known in zip(sigma_mm, known, strict=True))
    sigmas = [
        math.sqrt(sigma**2 + hand_eye)
        for sigma, hand_eye, is_known in zip(sigma_mm, steering.hand_eye_variance_mm2, known, strict=True)
        if is_known
    ]
    valid_at_s = timestamp_s + lead.time_s if any(known) else math.nan
    offset = PlainOffset(offset_mm, (y_mm, z_mm), plain_confidence(weld_mm, sigmas), valid_at_s)
    return Steering(ends, stops, steering.hand_eye_variance_mm2), offset
