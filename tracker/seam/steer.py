"""From the seam along the path to the offset that is proposed to the gate.

What is asked is what is known of the seam where the torch stands, and not whether the present frame shows
it: the torch follows the measured stretch for the whole look-ahead while the sensor is blind or past the
joint's end. The seam is lost once the torch leaves that stretch. A frame that cannot be read and a pose that
is refused say nothing of where the torch is: for those, and for offsets that come too late, jump or lie out
of range, the gate holds what was sent last, by its age, and then refuses.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import NamedTuple

from noise_model.surface.faces import ridge
from tracker import checks, flags
from tracker.checks import Asked, ask, ask_as, ask_raising, ask_whether
from tracker.seam.correction import STOPPED, Correction, correct
from tracker.seam.expected import ExpectedSeam
from tracker.seam.gaussian_process import SPACING_MM, SeamHistory
from tracker.seam.joint_ends import Change, JointEnds
from tracker.seam.locate import confidence
from tracker.seam.stretches import Stretches
from tracker.state import NAN, UNKNOWN, Pair

NO_LOOK = flags.LASER_OFF.mask | flags.BELOW_SURFACE.mask | flags.SEAM_OUT_OF_VIEW.mask
"""A frame with these says nothing of whether there is a joint."""


@dataclass(frozen=True)
class Steering:
    """What is handed on from frame to frame.

    Once stopped it stays so: a new Steering, as a new Tracker has, is the only way to start again.
    `hand_eye_variance_mm2` (y, z) is what the hand-eye tolerance leaves of the latest measurement.
    """

    ends: JointEnds = field(default_factory=JointEnds)
    is_stopped: bool = False
    hand_eye_variance_mm2: tuple[float, float] = (0.0, 0.0)


@dataclass(frozen=True)
class Lead:
    """How far ahead of the torch the offset is asked for: where it will be once the correction acts.

    Parameters
    ----------
    time_s : float
        From the capture until the correction acts, s.
    way_mm : float
        How far the torch goes along the seam meanwhile, mm.
    """

    time_s: float = 0.0
    way_mm: float = 0.0


AT_ONCE = Lead()
"""The offset of where the torch is at the capture."""


class SeamAtTorch(NamedTuple):
    """The seam's displacement and 1 sigma as (y, z) at the torch, mm, NaN where it is not known."""

    asked: Asked
    displacement_mm: Pair = UNKNOWN
    sigma_mm: Pair = UNKNOWN

    @property
    def flags(self) -> int:
        """What was noted of the torch's place."""
        return self.asked.flags


def seam_at_torch(
    correction: Correction,
    history: SeamHistory,
    torch_mm: float,
    stretch_mm: tuple[float, float],
    goes_on: bool = False,
) -> SeamAtTorch:
    """Return the seam where the torch stands; `stretch_mm` are the stations of the joint's start and end.

    Before the joint it is the seam at its start. Before what is measured of it the process is asked. Past
    the last measurement the seam is lost: its last place is held, at a sigma that takes in how far the
    process expects it to have gone since, or the process goes on, both within the correction's limits; or
    following stops, but not within SPACING_MM, where the joint's very end may lie. A seam that `goes_on` in
    another stretch beyond is not lost.
    """
    start_mm, end_mm = stretch_mm
    asked = Asked.nothing()
    if not ask(asked, checks.TORCH_BEFORE_END, torch_mm - end_mm, 0.0):
        return SeamAtTorch(asked)
    ask(asked, checks.TORCH_AFTER_START, start_mm - torch_mm, 0.0)
    if not ask_whether(asked, checks.SEAM_MEASURED, len(history) > 0):
        return SeamAtTorch(asked)
    station_mm = max(torch_mm, start_mm)
    there = history.point_at(station_mm)
    displacement, sigma = there.displacement_mm, there.sigma_mm
    lost_mm = torch_mm - there.last_mm if torch_mm >= start_mm and not goes_on else 0.0
    stops = correction.when_lost == "stop"
    if stops and not ask_raising(asked, checks.SEAM_NOT_LOST, lost_mm, SPACING_MM, flags.FOLLOW_STOPPED.mask):
        return SeamAtTorch(asked)
    holds = correction.when_lost == "hold"
    if holds and not ask(asked, checks.SEAM_NOT_LOST, lost_mm, 0.0):
        held = history.point_at(there.last_mm).displacement_mm
        (y_mm, z_mm), (sigma_y_mm, sigma_z_mm) = displacement, sigma
        sigma = math.hypot(sigma_y_mm, y_mm - held[0]), math.hypot(sigma_z_mm, z_mm - held[1])
        displacement = held
    else:
        ask_whether(asked, checks.TORCH_MEASURED, there.first_mm <= station_mm <= there.last_mm)
    if not ask(asked, checks.REACHED, lost_mm, correction.extrapolate_mm):
        return SeamAtTorch(asked)
    if not ask(asked, checks.TORCH_SIGMA, max(sigma), correction.extrapolate_sigma_mm):
        return SeamAtTorch(asked)
    return SeamAtTorch(asked, displacement, sigma)


class TorchOffset(NamedTuple):
    """What a track says of its offset and of the joint's ends; see `state.Track`."""

    offset_y_mm: float
    offset_z_mm: float
    offset_sigma_y_mm: float
    offset_sigma_z_mm: float
    offset_confidence: float
    valid_at_s: float
    joint_start_mm: tuple[float, float]
    joint_end_mm: tuple[float, float]


def steer(
    correction: Correction,
    weld_mm: float,
    expected: ExpectedSeam,
    stretches: Stretches,
    steering: Steering,
    asked: Asked,
    is_seam_shown: bool,
    timestamp_s: float,
    lead: Lead = AT_ONCE,
) -> tuple[Steering, TorchOffset]:
    """Return the offset that is proposed to the gate, and what is handed on.

    `weld_mm` is the weld's tolerance, `stretches` what is remembered of the seam, with the frame's own
    measurement. What is asked of the torch's place is added to what was `asked` of the frame, which says
    whether a seam that `is_seam_shown` is valid. The torch is taken for where it will be after the `lead`.
    """
    ends, torch_mm = steering.ends, expected.torch_mm + lead.way_mm
    if correction.ends_mm > 0.0 and not asked.flags & NO_LOOK:
        is_valid = is_seam_shown and not asked.flags & flags.INVALIDATING
        ends = ends.with_look(expected.line.station_mm, is_valid, expected.ends_mm, correction.ends_mm)
    joint_mm = ends.stretch_mm(expected.ends_mm, correction.ends_mm)
    history = stretches.history_at(max(torch_mm, joint_mm[0]))
    there = seam_at_torch(correction, history, torch_mm, joint_mm, history is not stretches.history)
    height_mm = 0.0
    if correction.corrugation == "followed":
        height_mm = ridge(torch_mm, expected.scene.shape.corrugation)[0]
    corrected = correct(correction, there.displacement_mm, height_mm)
    if steering.is_stopped or there.flags & flags.FOLLOW_STOPPED.mask:
        corrected = STOPPED
    ask_as(asked, there.asked)
    ask_whether(asked, checks.OFFSET_WITHIN, not corrected.is_limited)
    ask_whether(asked, checks.FOLLOWING, not corrected.is_stopped)
    y_mm, z_mm = corrected.offset_mm
    sigma_y_mm, sigma_z_mm = there.sigma_mm
    sigma_y_mm, sigma_z_mm = NAN if math.isnan(y_mm) else sigma_y_mm, NAN if math.isnan(z_mm) else sigma_z_mm
    offset = TorchOffset(
        y_mm,
        z_mm,
        sigma_y_mm,
        sigma_z_mm,
        _confidence(weld_mm, steering, (sigma_y_mm, sigma_z_mm)),
        NAN if math.isnan(y_mm) and math.isnan(z_mm) else timestamp_s + lead.time_s,
        _where(ends.start),
        _where(ends.end),
    )
    return Steering(ends, corrected.is_stopped, steering.hand_eye_variance_mm2), offset


def _confidence(weld_mm: float, steering: Steering, sigma_mm: tuple[float, float]) -> float:
    """Return the probability that the offsets that are known are right within the tolerance, NaN for none."""
    known = [
        math.sqrt(sigma**2 + hand_eye)
        for sigma, hand_eye in zip(sigma_mm, steering.hand_eye_variance_mm2, strict=True)
        if math.isfinite(sigma)
    ]
    return confidence(weld_mm, known) if known else NAN


def _where(change: Change) -> tuple[float, float]:
    return (change.station_mm, change.sigma_mm) if change.is_seen else (NAN, NAN)
