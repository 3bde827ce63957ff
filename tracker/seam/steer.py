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

import numpy as np

from noise_model.arc.scene import Scene
from noise_model.arrays import Float64
from noise_model.kernel import kernel
from noise_model.surface.faces import ridge
from noise_model.surface.joint import SeamSegments, nearest_segment
from noise_model.transforms import inverted, multiplied
from tracker import checks, flags
from tracker.checks import Checks
from tracker.seam.correction import STOPPED, Correction, correct
from tracker.seam.gaussian_process import SPACING_MM, SeamHistory
from tracker.seam.joint_ends import Change, JointEnds, nominal_ends
from tracker.seam.locate import SeamSource, confidence
from tracker.seam.stretches import Stretches
from tracker.state import NAN

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


@dataclass(frozen=True)
class SeamAtTorch:
    """The seam's displacement and 1 sigma (2,) as (y, z) at the torch, mm, NaN where it is not known."""

    displacement_mm: Float64
    sigma_mm: Float64
    asked: Checks

    @classmethod
    def unknown(cls, asked: Checks) -> SeamAtTorch:
        """Return the seam at a torch where nothing is known of it."""
        return cls(np.full(2, np.nan), np.full(2, np.nan), asked)

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
    asked = Checks()
    if not asked.ask(checks.TORCH_BEFORE_END, torch_mm - end_mm, 0.0):
        return SeamAtTorch.unknown(asked)
    asked.ask(checks.TORCH_AFTER_START, start_mm - torch_mm, 0.0)
    if not asked.ask(checks.SEAM_MEASURED, len(history) > 0):
        return SeamAtTorch.unknown(asked)
    station_mm, last_mm = max(torch_mm, start_mm), float(history.stations_mm.max())
    displacement, sigma = history.at(station_mm)
    lost_mm = torch_mm - last_mm if torch_mm >= start_mm and not goes_on else 0.0
    stops = correction.when_lost == "stop"
    if stops and not asked.ask(checks.SEAM_NOT_LOST, lost_mm, SPACING_MM, flags.FOLLOW_STOPPED):
        return SeamAtTorch.unknown(asked)
    holds = correction.when_lost == "hold"
    if holds and not asked.ask(checks.SEAM_NOT_LOST, lost_mm, 0.0):
        held, _ = history.at(last_mm)
        displacement, sigma = held, np.hypot(sigma, displacement - held)
    else:
        asked.ask(checks.TORCH_MEASURED, history.is_measured(station_mm))
    if not asked.ask(checks.REACHED, lost_mm, correction.extrapolate_mm):
        return SeamAtTorch.unknown(asked)
    if not asked.ask(checks.TORCH_SIGMA, float(sigma.max()), correction.extrapolate_sigma_mm):
        return SeamAtTorch.unknown(asked)
    return SeamAtTorch(displacement, sigma, asked)


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


@kernel(allocates=True)
def torch_stations_mm(
    segments: SeamSegments, T_base_tool: Float64, T_joint_tool: Float64
) -> tuple[float, float, float]:
    """Return the torch's station, and those of the nominal line's ends as `nominal_ends` has them.

    Past a bend the torch may be on another segment than the sensor, `T_joint_tool`: each goes by its own.
    """
    tip = np.empty(3)
    for i in range(3):
        tip[i] = T_base_tool[i, 3]
    on = segments.frames[nearest_segment(segments, tip)]
    torch_mm = 0.0
    for i in range(3):
        torch_mm += on[i, 0] * (tip[i] - on[i, 3])
    start_mm, end_mm = nominal_ends(segments, multiplied(T_joint_tool, inverted(T_base_tool)))
    return torch_mm, start_mm, end_mm


def steer(
    correction: Correction,
    source: SeamSource,
    T_base_tool: Float64,
    nominal_scene: Scene,
    stretches: Stretches,
    steering: Steering,
    asked: Checks,
    is_seam_shown: bool,
    looked_mm: float,
    timestamp_s: float,
    lead: Lead = AT_ONCE,
) -> tuple[Steering, TorchOffset]:
    """Return the offset that is proposed to the gate, and what is handed on.

    `nominal_scene` is the pose seen from the nominal joint, `looked_mm` the station that the sensor looked
    at, `stretches` what is remembered of the seam, with the frame's own measurement. What is asked of the
    torch's place is added to what was `asked` of the frame, which says whether a seam that `is_seam_shown` is
    valid. The torch is taken for where it will be after the `lead`.
    """
    at_mm, *line_mm = torch_stations_mm(source.scene.segments, T_base_tool, nominal_scene.T_joint_tool)
    ends, torch_mm = steering.ends, at_mm + lead.way_mm
    if correction.ends_mm > 0.0 and not asked.flags & NO_LOOK:
        is_valid = is_seam_shown and not asked.flags & flags.INVALIDATING
        ends = ends.with_look(looked_mm, is_valid, (line_mm[0], line_mm[1]), correction.ends_mm)
    joint_mm = ends.stretch_mm((line_mm[0], line_mm[1]), correction.ends_mm)
    history = stretches.history_at(max(torch_mm, joint_mm[0]))
    there = seam_at_torch(correction, history, torch_mm, joint_mm, history is not stretches.history)
    height_mm = 0.0
    if correction.corrugation == "followed":
        height_mm = ridge(torch_mm, nominal_scene.shape.corrugation)[0]
    corrected = correct(correction, there.displacement_mm, height_mm)
    if steering.is_stopped or there.flags & flags.FOLLOW_STOPPED.mask:
        corrected = STOPPED
    asked.extend(tuple(there.asked.answers))
    asked.ask(checks.OFFSET_WITHIN, not corrected.is_limited)
    asked.ask(checks.FOLLOWING, not corrected.is_stopped)
    y_mm, z_mm = corrected.offset_mm.tolist()
    sigma_y_mm, sigma_z_mm = there.sigma_mm.tolist()
    sigma_y_mm, sigma_z_mm = NAN if math.isnan(y_mm) else sigma_y_mm, NAN if math.isnan(z_mm) else sigma_z_mm
    offset = TorchOffset(
        y_mm,
        z_mm,
        sigma_y_mm,
        sigma_z_mm,
        _confidence(source.weld_mm, steering, (sigma_y_mm, sigma_z_mm)),
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
