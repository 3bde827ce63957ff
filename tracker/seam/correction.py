"""Correction sent of the seam's displacement: axes, gain, bias and limit, as `[follow]` states.

The correction is an absolute displacement that replaces the one before, so its gain is no integrator's: a
gain of 0.8 follows four fifths of the displacement, however often it is sent.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Literal, NamedTuple

AtLimit = Literal["saturate", "stop"]
WhenLost = Literal["hold", "extrapolate", "stop"]
CorrugationPath = Literal["in_path", "followed"]


@dataclass(frozen=True)
class AxisCorrection:
    """The correction of one axis: gain times displacement plus bias, within a limit.

    Parameters
    ----------
    enable : bool
        Whether the axis is corrected. An axis that is not enabled stays unknown.
    gain : float
        The share of the displacement that is sent, above 0 and at most 1.
    bias_mm : float
        What is added to it, mm.
    limit_mm : float
        The largest correction, mm.
    at_limit : str
        "saturate" sends the limit beyond it, "stop" stops following.

    Raises
    ------
    ValueError
        For a value out of its range.
    """

    enable: bool = True
    gain: float = 1.0
    bias_mm: float = 0.0
    limit_mm: float = math.inf
    at_limit: AtLimit = "saturate"

    def __post_init__(self) -> None:
        if not 0.0 < self.gain <= 1.0:
            raise ValueError(f"gain = {self.gain}: must be > 0 and at most 1")
        if not math.isfinite(self.bias_mm):
            raise ValueError(f"bias_mm = {self.bias_mm}: must be finite")
        if not self.limit_mm > 0.0:
            raise ValueError(f"limit_mm = {self.limit_mm}: must be > 0")
        if not abs(self.bias_mm) <= self.limit_mm:
            raise ValueError(f"bias_mm = {self.bias_mm}: is beyond limit_mm = {self.limit_mm}")


@dataclass(frozen=True)
class Correction:
    """Correction of the path by the seam: `[follow]` of recording.toml.

    Parameters
    ----------
    y, z : AxisCorrection
        The correction of each axis, joint frame.
    when_lost : str
        What is sent where the torch has passed the last measurement of the seam: "hold", "extrapolate" or
        "stop".
    extrapolate_mm : float
        How far past the last measurement that is sent at most, mm.
    extrapolate_sigma_mm : float
        Up to which 1 sigma it is sent, mm.
    ends_mm : float
        How far the joint's real ends may lie from those of its nominal line, mm. They are searched if it is
        not 0.
    corrugation : str
        "in_path" if the programmed path goes over a corrugation, "followed" if that path is flat.

    Raises
    ------
    ValueError
        For a value out of its range; it names the key.
    """

    y: AxisCorrection = field(default_factory=AxisCorrection)
    z: AxisCorrection = field(default_factory=AxisCorrection)
    when_lost: WhenLost = "extrapolate"
    extrapolate_mm: float = 10.0
    extrapolate_sigma_mm: float = 0.5
    ends_mm: float = 0.0
    corrugation: CorrugationPath = "in_path"

    def __post_init__(self) -> None:
        if not self.extrapolate_mm >= 0.0:
            raise ValueError(f"[follow] extrapolate_mm = {self.extrapolate_mm}: must be >= 0")
        if not self.extrapolate_sigma_mm > 0.0:
            raise ValueError(f"[follow] extrapolate_sigma_mm = {self.extrapolate_sigma_mm}: must be > 0")
        if not (self.ends_mm >= 0.0 and math.isfinite(self.ends_mm)):
            raise ValueError(f"[follow] ends_mm = {self.ends_mm}: must be >= 0 and finite")

    @property
    def enabled(self) -> tuple[bool, bool]:
        """True for each of y and z that is corrected."""
        return self.y.enable, self.z.enable


UNSTATED = Correction()
"""The correction where none is stated."""


class CorrectedOffset(NamedTuple):
    """A correction as (y, z), mm, NaN for an axis that is not enabled; both NaN once stopped."""

    offset_mm: tuple[float, float]
    is_limited: bool
    is_stopped: bool


def correct(
    correction: Correction, displacement_mm: tuple[float, float], height_mm: float = 0.0
) -> CorrectedOffset:
    """Return the offset that is sent for a seam's displacement as (y, z), mm.

    Each axis gets gain * displacement + bias, cut to its limit or stopped by it; a correction at its limit
    passes. `height_mm` is what the programmed path leaves out of the drawing, a corrugation's height: it is
    known and not measured, so z gets all of it whatever the gain.
    """
    y_mm, y_is_limited, y_stops = _sent(correction.y, displacement_mm[0], 0.0)
    z_mm, z_is_limited, z_stops = _sent(correction.z, displacement_mm[1], height_mm)
    if y_stops or z_stops:
        return CorrectedOffset((math.nan, math.nan), False, True)
    return CorrectedOffset((y_mm, z_mm), y_is_limited or z_is_limited, False)


def _sent(axis: AxisCorrection, displacement_mm: float, drawn_mm: float) -> tuple[float, bool, bool]:
    """Return an axis' offset, mm, whether its limit cut it, and whether that stops following."""
    if not axis.enable:
        return math.nan, False, False
    sent_mm = axis.gain * displacement_mm + drawn_mm + axis.bias_mm
    if not abs(sent_mm) > axis.limit_mm:
        return sent_mm, False, False
    return math.copysign(axis.limit_mm, sent_mm), True, axis.at_limit == "stop"
