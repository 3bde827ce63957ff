"""The limits of the gate: what an offset must keep to, and why."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, fields

BUS_RANGE_MM = 32.767
"""The largest offset that the bus can carry, mm."""


def _limit(value: float, unit: str, role: str, source: str) -> float:
    limit: float = field(default=value, metadata={"unit": unit, "role": role, "source": source})
    return limit


@dataclass(frozen=True)
class GateLimits:
    """What an offset must keep to. Each number's metadata states its unit, its role and where it comes from.

    Parameters
    ----------
    range_y_mm, range_z_mm : float
        The largest offset, mm.
    rate_y_mm_s, rate_z_mm_s : float
        The largest change between two captures, mm/s, counted over at most `hold_s`; and how fast an axis
        approaches the seam after arming.
    jump_mm : float
        The largest change between two captures, mm, whatever time lies between. A seam that jumps further is
        not followed before the tracker is armed anew.
    capture_age_s : float
        The largest age of the capture, s.
    confidence : float
        The least confidence, 0 to 1.
    hold_s : float
        How long the last offset is held while none passes, s.
    sigma_y_mm, sigma_z_mm : float
        The largest sigma, mm.
    arc_required : bool
        Whether the robot must report that the arc is on and that it welds. A search and a
        dry run need neither.

    Raises
    ------
    ValueError
        For a limit that is not positive and finite, or that the bus cannot carry.
    """

    range_y_mm: float = _limit(
        10.0, "mm", "largest offset across the seam", "a part that lies farther off is in the wrong place"
    )
    range_z_mm: float = _limit(10.0, "mm", "largest offset of height", "as across the seam")
    rate_y_mm_s: float = _limit(
        20.0, "mm/s", "fastest change across the seam", "twice the fastest travel: a seam that runs at 63 deg"
    )
    rate_z_mm_s: float = _limit(20.0, "mm/s", "fastest change of height", "as across the seam")
    jump_mm: float = _limit(
        3.0,
        "mm",
        "largest change between two captures",
        "1 s of blindness at 10 mm/s along a seam at 17 deg to its path; a weld pool is some 5 mm wide",
    )
    capture_age_s: float = _limit(
        0.2, "s", "oldest capture", "at 10 mm/s the torch goes 2 mm, a twentieth of the look-ahead"
    )
    confidence: float = _limit(
        0.1,
        "",
        "least confidence",
        "a hand-eye tolerance of 0.05 deg alone holds that of a perfect measurement near a half",
    )
    hold_s: float = _limit(1.0, "s", "longest hold of the last offset", "10 mm of travel at 10 mm/s")
    sigma_y_mm: float = _limit(
        0.5,
        "mm",
        "largest 1 sigma across the seam",
        "[follow] extrapolate_sigma_mm: beyond no offset is known",
    )
    sigma_z_mm: float = _limit(0.5, "mm", "largest 1 sigma of height", "as across the seam")
    arc_required: bool = field(
        default=True,
        metadata={
            "unit": "",
            "role": "whether the arc must burn",
            "source": "a search and a dry run need no arc",
        },
    )

    def __post_init__(self) -> None:
        for limit in (f.name for f in fields(self) if f.name != "arc_required"):
            value = getattr(self, limit)
            if not (value > 0.0 and math.isfinite(value)):
                raise ValueError(f"gate limit {limit}: is {value}; it must be positive and finite")
        for limit in ("range_y_mm", "range_z_mm"):
            if getattr(self, limit) > BUS_RANGE_MM:
                raise ValueError(f"gate limit {limit}: above {BUS_RANGE_MM} mm, which the bus cannot carry")
        if self.confidence > 1.0:
            raise ValueError(f"gate limit confidence: is {self.confidence}; it is a probability, at most 1")
