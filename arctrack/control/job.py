"""Job: what is tracked, and how, by the robot's number."""

import math
from dataclasses import dataclass, field, fields

from robot_io import GateLimits
from robot_io.poses.nominal_path import NominalPath, Vector
from tracker.seam.correction import UNSTATED, Correction

Range = tuple[float, float]


@dataclass(frozen=True)
class PartLimits:
    """Requirements on a part before the arc is lit; None requires nothing.

    Parameters
    ----------
    gap_mm, mismatch_mm : tuple (2,), optional
        The least and the largest gap and mismatch, mm.
    depth_mm : tuple (2,), optional
        The least and the largest depth of a groove, mm.
    angle_deg : tuple (2,), optional
        The least and the largest angle between a groove's faces, or between a joint's plates, degrees.
    looks : int
        How many frames in a row must say the same (chosen: a bad frame or two refuse no part).

    Raises
    ------
    ValueError
        For a range that is none, or without a look.
    """

    gap_mm: Range | None = None
    mismatch_mm: Range | None = None
    depth_mm: Range | None = None
    angle_deg: Range | None = None
    looks: int = 5

    def __post_init__(self) -> None:
        for name in PART_RANGES:
            limits = getattr(self, name)
            if limits is not None and not (limits[0] <= limits[1] and all(map(math.isfinite, limits))):
                raise ValueError(f"{name} = {list(limits)}: must be the least and the largest, both finite")
        if self.looks < 1:
            raise ValueError(f"looks = {self.looks}: must be at least 1")

    @property
    def required(self) -> bool:
        """True if anything is required."""
        return any(getattr(self, name) is not None for name in PART_RANGES)


PART_RANGES = tuple(f.name for f in fields(PartLimits) if f.name != "looks")
"""Quantities of a part that may have a required range."""


@dataclass(frozen=True)
class Bridging:
    """Limits of a stretch without a joint, such as a tack.

    Parameters
    ----------
    path : NominalPath
        The nominal seam: before its start and past its end no joint is missed.
    ahead_tool_mm : tuple (3,)
        Where the sensor looks at the seam, mm, tool frame.
    max_mm : float
        How far the sensor may go along the seam without seeing the joint, mm.

    Raises
    ------
    ValueError
        For a way that is not above 0.
    """

    path: NominalPath
    ahead_tool_mm: Vector
    max_mm: float

    def __post_init__(self) -> None:
        if not self.max_mm > 0.0:
            raise ValueError(f"bridge_mm = {self.max_mm}: must be > 0")


@dataclass(frozen=True)
class Job:
    """Job of a tracker: what is tracked, and how.

    Parameters
    ----------
    joint_type : str
        The joint's type, which the seam geometry states.
    limits : GateLimits
        What an offset must keep to.
    correction : Correction
        Which axes are corrected.
    offsets_in_search : bool
        Whether offsets go out while the robot commands SEARCH.
    poses_proven : bool
        Whether nothing goes out before `on_poses` said that the poses are to be trusted, and again and again.
    part : PartLimits
        What the part must be like before the arc is lit.
    bridging : Bridging, optional
        How far a stretch without a joint may reach; by default without end.
    uses_laser : bool
        Whether the laser goes on where the robot commands it.
    """

    joint_type: str
    limits: GateLimits = field(default_factory=GateLimits)
    correction: Correction = UNSTATED
    offsets_in_search: bool = False
    poses_proven: bool = False
    part: PartLimits = field(default_factory=PartLimits)
    bridging: Bridging | None = None
    uses_laser: bool = True


NO_JOB = Job("unknown")
"""Placeholder of the job while the robot names none that exists."""
