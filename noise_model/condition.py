"""Condition of a frame: what is on while it is taken."""

from __future__ import annotations

from dataclasses import dataclass

from noise_model.arc_source import level as current_level
from noise_model.setup import Setup


@dataclass(frozen=True)
class Condition:
    """A frame's condition.

    Parameters
    ----------
    laser_level, arc_level : float
        Output over the nominal output, 0 for off.
    exposure_s : float
        The exposure, s.
    timestamp_s : float
        The time since the recording's first frame, s.

    Raises
    ------
    ValueError
        For a level below 0, and for an exposure that is not above 0.
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
        """Return the condition that a setup expects of a frame.

        The arc's level is (I / current_a)^current_exponent at a current I (`Arc`).

        Parameters
        ----------
        setup : Setup
            The nominal setup.
        laser_on, arc_on : bool
            Whether laser and arc are on.
        current_a : float
            The welding current I, A; where it is 0 or NaN the arc's level is 0.
        exposure_s : float
            The exposure, s.
        timestamp_s : float
            The time since the recording's first frame, s.

        Returns
        -------
        Condition
            Levels are 0 for what is off.
        """
        arc_level = current_level(setup.arc, current_a) if arc_on else 0.0
        return cls(float(laser_on), arc_level, exposure_s, timestamp_s)
