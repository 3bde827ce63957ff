"""From the seam along the path to the offset that is proposed to the gate.

What is asked is what is known of the seam where the torch stands, and not whether the present frame shows
it: the torch follows the measured stretch for the whole look-ahead while the sensor is blind or past the
joint's end. The seam is lost once the torch leaves that stretch. A frame that cannot be read and a pose that
is refused say nothing of where the torch is: for those, and for offsets that come too late, jump or lie out
of range, the gate holds what was sent last, by its age, and then refuses.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from noise_model.kernel import kernel
from noise_model.surface.faces import ridge
from tracker import checks, flags
from tracker.checks import Asked, ask, ask_raising, ask_whether
from tracker.seam.correction import Corrected, Correction, CorrectionNumbers, corrected
from tracker.seam.expected import ExpectedSeam
from tracker.seam.gaussian_process import SPACING_MM, SeamHistory, condition
from tracker.seam.joint_ends import Change, JointEnds, ends_with_look, is_seen, stretch_between
from tracker.seam.locate import confidence
from tracker.seam.stretches import Stretches, history_at
from tracker.state import UNKNOWN, Pair

NO_LOOK = flags.LASER_OFF.mask | flags.BELOW_SURFACE.mask | flags.SEAM_OUT_OF_VIEW.mask
"""A frame with these says nothing of whether there is a joint."""

_STOPPED = flags.FOLLOW_STOPPED.mask


class Steering(NamedTuple):
    """What is handed on from frame to frame.

    Once stopped it stays so: a new Steering, as a new Tracker has, is the only way to start again.
    `hand_eye_variance_mm2` (y, z) is what the hand-eye tolerance leaves of the latest measurement.
    """

    ends: JointEnds = JointEnds()
    is_stopped: bool = False
    hand_eye_variance_mm2: Pair = (0.0, 0.0)


class Lead(NamedTuple):
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
    asked = Asked.nothing()
    place = float(torch_mm), (float(stretch_mm[0]), float(stretch_mm[1])), goes_on
    displacement_mm, sigma_mm, _ = at_torch(asked, correction.numbers, history, *place)
    return SeamAtTorch(asked, displacement_mm, sigma_mm)


@kernel(allocates=True)
def at_torch(
    asked: Asked,
    correction: CorrectionNumbers,
    history: SeamHistory,
    torch_mm: float,
    stretch_mm: Pair,
    goes_on: bool,
) -> tuple[Pair, Pair, bool]:
    """Return `seam_at_torch`'s displacement and sigma, and whether following stops."""
    unknown, (start_mm, end_mm) = (math.nan, math.nan), stretch_mm
    if not ask(asked, checks.TORCH_BEFORE_END, torch_mm - end_mm, 0.0):
        return unknown, unknown, False
    ask(asked, checks.TORCH_AFTER_START, start_mm - torch_mm, 0.0)
    if not ask_whether(asked, checks.SEAM_MEASURED, history.stations_mm.shape[0] > 0):
        return unknown, unknown, False
    station_mm = max(torch_mm, start_mm)
    there = condition(history, station_mm)
    displacement, sigma = there.displacement_mm, there.sigma_mm
    lost_mm = torch_mm - there.last_mm if torch_mm >= start_mm and not goes_on else 0.0
    if correction.stops_when_lost and not ask_raising(
        asked, checks.SEAM_NOT_LOST, lost_mm, SPACING_MM, _STOPPED
    ):
        return unknown, unknown, True
    if correction.holds_when_lost and not ask(asked, checks.SEAM_NOT_LOST, lost_mm, 0.0):
        held = condition(history, there.last_mm).displacement_mm
        gone_y_mm, gone_z_mm = displacement[0] - held[0], displacement[1] - held[1]
        sigma = math.hypot(sigma[0], gone_y_mm), math.hypot(sigma[1], gone_z_mm)
        displacement = held
    else:
        ask_whether(asked, checks.TORCH_MEASURED, there.first_mm <= station_mm <= there.last_mm)
    if not ask(asked, checks.REACHED, lost_mm, correction.extrapolate_mm):
        return unknown, unknown, False
    if not ask(asked, checks.TORCH_SIGMA, max(sigma[0], sigma[1]), correction.extrapolate_sigma_mm):
        return unknown, unknown, False
    return displacement, sigma, False


class TorchOffset(NamedTuple):
    """What a track says of its offset and of the joint's ends; see `state.Track`."""

    offset_y_mm: float
    offset_z_mm: float
    offset_sigma_y_mm: float
    offset_sigma_z_mm: float
    offset_confidence: float
    valid_at_s: float
    joint_start_mm: Pair
    joint_end_mm: Pair


NO_OFFSET = TorchOffset(math.nan, math.nan, math.nan, math.nan, math.nan, math.nan, UNKNOWN, UNKNOWN)
"""The offset of a frame that says nothing of the torch."""


@kernel(allocates=True)
def steer(
    asked: Asked,
    correction: CorrectionNumbers,
    weld_mm: float,
    expected: ExpectedSeam,
    stretches: Stretches,
    steering: Steering,
    is_seam_shown: bool,
    timestamp_s: float,
    lead: Lead,
) -> tuple[Steering, TorchOffset]:
    """Return the offset that is proposed to the gate, and what is handed on.

    `weld_mm` is the weld's tolerance, `stretches` what is remembered of the seam, with the frame's own
    measurement. What is asked of the torch's place is added to what was `asked` of the frame, which says
    whether a seam that `is_seam_shown` is valid. The torch is taken for where it will be after the `lead`.
    """
    ends, torch_mm, raised = steering.ends, expected.torch_mm + lead.way_mm, asked.told[1]
    if correction.ends_mm > 0.0 and not raised & NO_LOOK:
        is_valid = is_seam_shown and not raised & flags.INVALIDATING
        ends = ends_with_look(ends, expected.line.station_mm, is_valid, expected.ends_mm, correction.ends_mm)
    joint_mm = stretch_between(ends, expected.ends_mm, correction.ends_mm)
    history, is_present = history_at(stretches.history, stretches.behind, max(torch_mm, joint_mm[0]))
    displacement_mm, sigma_mm, stops = at_torch(
        asked, correction, history, torch_mm, joint_mm, not is_present
    )
    height_mm = 0.0
    if correction.follows_corrugation:
        height_mm = ridge(torch_mm, expected.scene.shape.corrugation)[0]
    sent = corrected(correction, displacement_mm, height_mm)
    if steering.is_stopped or stops:
        sent = Corrected((math.nan, math.nan), False, True)
    ask_whether(asked, checks.OFFSET_WITHIN, not sent.is_limited)
    ask_whether(asked, checks.FOLLOWING, not sent.is_stopped)
    y_mm, z_mm = sent.offset_mm
    sigma_y_mm = math.nan if math.isnan(y_mm) else sigma_mm[0]
    sigma_z_mm = math.nan if math.isnan(z_mm) else sigma_mm[1]
    hand_eye_y, hand_eye_z = steering.hand_eye_variance_mm2
    offset = TorchOffset(
        y_mm,
        z_mm,
        sigma_y_mm,
        sigma_z_mm,
        _confidence(weld_mm, sigma_y_mm**2 + hand_eye_y, sigma_z_mm**2 + hand_eye_z),
        math.nan if math.isnan(y_mm) and math.isnan(z_mm) else timestamp_s + lead.time_s,
        _where(ends.start),
        _where(ends.end),
    )
    return Steering(ends, sent.is_stopped, steering.hand_eye_variance_mm2), offset


@kernel
def _confidence(weld_mm: float, variance_y_mm2: float, variance_z_mm2: float) -> float:
    """Return the probability that the offsets that are known are right within the tolerance, NaN for none."""
    knows_y, knows_z = math.isfinite(variance_y_mm2), math.isfinite(variance_z_mm2)
    if not (knows_y or knows_z):
        return math.nan
    sigma_y_mm = math.sqrt(variance_y_mm2) if knows_y else 0.0
    sigma_z_mm = math.sqrt(variance_z_mm2) if knows_z else 0.0
    return confidence(weld_mm, sigma_y_mm, sigma_z_mm)


@kernel
def _where(change: Change) -> Pair:
    """Return where a change was seen, its station and 1 sigma, mm; NaN where it was not."""
    if not is_seen(change):
        return math.nan, math.nan
    return change.station_mm, math.sqrt(change.variance_mm2)
