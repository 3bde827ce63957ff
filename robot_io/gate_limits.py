"""The limits of the gate: what an offset must keep to, and why."""

from dataclasses import dataclass

from robot_io.stated_limit import check_limits, stated

BUS_RANGE_MM = 32.767
"""The largest offset that the bus can carry, mm."""


@dataclass(frozen=True)
class GateLimits:
    """Limits that an offset must keep to. Each field's metadata states `unit`, `role` and `source`.

    Raises
    ------
    ValueError
        For a limit that is not positive and finite, or that the bus cannot carry.
    """

    range_y_mm: float = stated(
        10.0, "mm", "largest offset across the seam", "a part that lies farther off is in the wrong place"
    )
    range_z_mm: float = stated(10.0, "mm", "largest offset of height", "as across the seam")
    rate_y_mm_s: float = stated(
        20.0,
        "mm/s",
        "fastest change across the seam, and approach after arming",
        "a seam that runs at 63 deg",
    )
    rate_z_mm_s: float = stated(20.0, "mm/s", "fastest change of height", "as across the seam")
    jump_mm: float = stated(
        3.0,
        "mm",
        "largest change between two captures; beyond it the tracker must be armed anew",
        "1 s of blindness at 10 mm/s along a seam at 17 deg to its path; a weld pool is some 5 mm wide",
    )
    capture_age_s: float = stated(
        0.2, "s", "oldest capture", "at 10 mm/s the torch goes 2 mm, a twentieth of the look-ahead"
    )
    confidence: float = stated(
        0.1,
        "",
        "least confidence",
        "a hand-eye tolerance of 0.05 deg alone holds that of a track near a half",
    )
    hold_s: float = stated(1.0, "s", "longest hold of the last offset", "10 mm of travel at 10 mm/s")
    sigma_y_mm: float = stated(
        0.5, "mm", "largest 1 sigma across the seam", "[follow] extrapolate_sigma_mm: none is known beyond"
    )
    sigma_z_mm: float = stated(0.5, "mm", "largest 1 sigma of height", "as across the seam")
    arc_required: bool = stated(
        True, "", "whether the arc must burn and the robot weld", "a search and a dry run need no arc"
    )

    def __post_init__(self) -> None:
        check_limits(self, "gate limit")
        for limit in ("range_y_mm", "range_z_mm"):
            if getattr(self, limit) > BUS_RANGE_MM:
                raise ValueError(f"gate limit {limit}: above {BUS_RANGE_MM} mm, which the bus cannot carry")
        if self.confidence > 1.0:
            raise ValueError(f"gate limit confidence: is {self.confidence}; it is a probability, at most 1")
