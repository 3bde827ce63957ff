"""What is on while a frame is taken."""

from __future__ import annotations

from dataclasses import dataclass

from noise_model.arc_source import level as current_level
from noise_model.setup import Setup


@dataclass(frozen=True)
class Condition:
    """A frame's condition.

    `laser_level` and `arc_level` are outputs over the nominal ones, 0 for off; `timestamp_s` counts from the
    recording's first frame.
    """

    laser_level: float
    arc_level: float
    exposure_s: float
    timestamp_s: float = 0.0

    def __post_init__(self) -> None:
        for name in ("laser_level", "arc_level"):
            if not getattr(self, name) >= 0:
                raise ValueError(f"{name} = {getattr(self, name)}: must be >= 0")
        if not self.exposure_s > 0:
            raise ValueError(f"exposure_s = {self.exposure_s}: must be > 0")

    @classmethod
    def of(
        cls,
        setup: Setup,
        *,
        laser_on: bool,
        arc_on: bool,
        current_a: float,
        exposure_s: float,
        timestamp_s: float = 0.0,
    ) -> Condition:
        """Return what a setup expects of a frame: (I / I_0)^n of the arc's output at a current I."""
        arc_level = current_level(setup.arc, current_a) if arc_on else 0.0
        return cls(float(laser_on), arc_level, exposure_s, timestamp_s)
