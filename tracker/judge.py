"""Seam of a step from its joint: judged against the earlier frames, and remembered."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from tracker import checks, flags
from tracker.checks import FrameChecks
from tracker.joint import SLOTS
from tracker.observation import FrameInput, Reading
from tracker.seam.expected import ExpectedSeam
from tracker.seam.gaussian_process import MAX_STRETCHES, NO_HISTORY, WIDE_SIGMA_MM, SeamHistory
from tracker.seam.locate import SeamSource, confidence, locate
from tracker.state import Pair
from tracker.tracker_state import TrackerMemory

MAX_OFF_MM = 3.0 * WIDE_SIGMA_MM
"""A seam so far off its nominal line is none: the line would be another joint's."""

JUMP_SIGMAS, JUMP_FLOOR_MM = 5.0, 0.3
JUMPS_TO_RELEARN, RELEARN_MM, RELEARN_SHARE = 3, 1.5, 0.5
"""Jumps to one place that make it the seam's new place, if most frames show it there over such a way.

The rim of a tack shows a joint for some frames, or now and then: a seam shows it on and on.
"""

SURE_NATS = math.log(1e5)
"""Evidence, nats, at which one frame shows a new gap: chance reaches it in one of 1e5.

With less its seam waits for a second frame: a dark spot of the metal is elsewhere in that. So it does where a
line off the stripe shows it under a burning arc, for between two streaks there is one, and chance has no part
in these.
"""


class SeamEstimate(NamedTuple):
    """Seam in a frame: in the tool frame, mm, with 1 sigmas and confidence; NaN if there is none.

    The sigmas of y and z, mm, take in the calibration's errors.
    """

    seam_tool_mm: tuple[float, float, float] = (math.nan, math.nan, math.nan)
    sigma_y_mm: float = math.nan
    sigma_z_mm: float = math.nan
    confidence: float = math.nan


def judge(
    frame_checks: FrameChecks, given: FrameInput, expected: ExpectedSeam, reading: Reading
) -> tuple[TrackerMemory, SeamEstimate | None]:
    """Judge the joint that a look shows; return what is remembered, and the seam, None if none is shown."""
    source, before, joint = given.geometry.seam_source, given.state, reading.joint
    if joint is None:
        return _lost(before, reading), None
    located = locate(source, given.T_base_tool, reading.scene, joint.y_mm, joint.z_mm)
    off_mm = located.displacement_mm
    if not frame_checks.ask(checks.NEAR_NOMINAL, max(abs(off_mm[0]), abs(off_mm[1])), MAX_OFF_MM):
        return _lost(before, reading), None
    turn_mm2 = source.turn_mm(located.station_mm, expected.crossing) ** 2
    variance_mm2 = (
        float(joint.covariance_mm2[0, 0]) + turn_mm2,
        float(joint.covariance_mm2[1, 1]) + turn_mm2,
    )
    moves_mm = given.geometry.calibration_field.moves_mm(np.array(located.seam_tool_mm))
    calibration_y, calibration_z = np.sum((moves_mm @ expected.T_joint_tool[1:3, :3].T) ** 2, axis=0).tolist()
    steering = before.steering._replace(hand_eye_variance_mm2=(calibration_y, calibration_z))
    state = before._replace(steering=steering)
    by_line = bool(frame_checks.flags & flags.SEAM_BY_LINE.mask)
    by_gap = given.geometry.setup.joint.type in SLOTS and joint.evidence_nats < SURE_NATS
    burns = given.arc_burns or bool(reading.evidence.burns)
    is_doubtful = by_gap or (burns and by_line)
    state = remember(frame_checks, source, state, located.station_mm, off_mm, variance_mm2, is_doubtful)
    if state.history.n == 0:
        return state, None
    sigma_y_mm = math.sqrt(variance_mm2[0] + calibration_y)
    sigma_z_mm = math.sqrt(variance_mm2[1] + calibration_z)
    sure = confidence(source.weld_mm, sigma_y_mm, sigma_z_mm)
    return state, SeamEstimate(located.seam_tool_mm, sigma_y_mm, sigma_z_mm, sure)


def _lost(before: TrackerMemory, reading: Reading) -> TrackerMemory:
    """Return the state after a frame without a joint: a frame without a stripe says nothing of it."""
    return before if reading.stripe is None else before._replace(lost=before.lost + 1)


def remember(
    frame_checks: FrameChecks,
    source: SeamSource,
    before: TrackerMemory,
    station_mm: float,
    displacement_mm: Pair,
    variance_mm2: Pair,
    is_doubtful: bool = False,
) -> TrackerMemory:
    """Return the state with a seam that a frame shows, judged against the earlier frames.

    A first one that `is_doubtful` waits for another frame that shows it there too.
    """
    measured = station_mm, displacement_mm, variance_mm2
    history, beyond, jumps = before.history, before.beyond, before.jumps + 1
    if history.n == 0 and is_doubtful:
        away_mm, limit_mm = jump_of(source, beyond, *measured)
        is_shown_twice = beyond.n > 0 and away_mm[0] <= limit_mm[0] and away_mm[1] <= limit_mm[1]
        if not frame_checks.ask_whether(checks.SEAM_CONFIRMED, is_shown_twice):
            return before._replace(beyond=NO_HISTORY.with_measurement(*measured))
        history = beyond
    if history.n == 0 or _is_near(frame_checks, *jump_of(source, history, *measured)):
        history = history.with_measurement(*measured)
        return before._replace(history=history, beyond=NO_HISTORY, jumps=0, lost=0)
    away_mm, limit_mm = jump_of(source, beyond, *measured)
    if away_mm[0] > limit_mm[0] or away_mm[1] > limit_mm[1]:
        # Nor where the last jump was: what is here and there is no seam.
        jumps, beyond = 1, NO_HISTORY
    n = before.frames + 1
    jumped_at = n if jumps == 1 else before.jumped_at
    beyond = beyond.with_measurement(*measured)
    way_mm = abs(station_mm - float(beyond.stations_mm[0]))
    share = jumps / (1 + n - jumped_at)
    if jumps < JUMPS_TO_RELEARN or way_mm < RELEARN_MM or share < RELEARN_SHARE:
        return before._replace(beyond=beyond, jumps=jumps, jumped_at=jumped_at)
    # The torch comes to the new stretch later: until then it is on the one before, if that was one.
    behind = before.behind
    if history.n >= JUMPS_TO_RELEARN:
        behind = (*behind, history)[-MAX_STRETCHES:]
    return before._replace(
        history=beyond, beyond=NO_HISTORY, behind=behind, jumps=0, jumped_at=jumped_at, lost=0
    )


def _is_near(frame_checks: FrameChecks, away_mm: Pair, limit_mm: Pair) -> bool:
    """Return True if a seam lies where the earlier frames put it."""
    is_near_in_y = frame_checks.ask(checks.JUMP_Y, away_mm[0], limit_mm[0])
    return frame_checks.ask(checks.JUMP_Z, away_mm[1], limit_mm[1]) and is_near_in_y


def jump_of(
    source: SeamSource, history: SeamHistory, station_mm: float, displacement_mm: Pair, variance_mm2: Pair
) -> tuple[Pair, Pair]:
    """Return the distance of a seam from where a history puts it, and its limit, mm, in y and in z each."""
    there = source.seam_at(history, station_mm)
    away_y_mm, away_z_mm = (abs(a - b) for a, b in zip(displacement_mm, there.displacement_mm, strict=True))
    limit_y_mm, limit_z_mm = map(jump_limit_mm, there.sigma_mm, variance_mm2)
    return (away_y_mm, away_z_mm), (limit_y_mm, limit_z_mm)


def jump_limit_mm(expected_sigma_mm: float, variance_mm2: float) -> float:
    """Return the largest distance of a seam from where the earlier frames put it, mm, that is no jump."""
    return max(JUMP_SIGMAS * math.sqrt(expected_sigma_mm**2 + variance_mm2), JUMP_FLOOR_MM)
