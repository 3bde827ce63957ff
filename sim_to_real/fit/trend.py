"""The trend of an effect whose size changes from frame to frame: with time, or with the torch's height.

In a frame its parameters are theta + u beta; u runs from -1 to 1 over the recording. Arc blow grows along a
plate, fume gathers, and an arc is longer where the torch is higher.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum

import numpy as np

from noise_model.arc.scene import make_scene
from noise_model.compiled.arrays import Float64
from noise_model.effects import REGISTRY, Values
from noise_model.fit import Parameter
from noise_model.setup import Setup
from sim_to_real.data.binned import ObservedFrame, ObservedRecording

TREND_EFFECTS = ("arc_length", "arc_deflection", "arc_radius", "hot_metal_glow", "fume")
"""The effects that change in the course of a weld."""

MIN_DRIVER_RANGE = 1e-6
"""The smallest range of a driver."""


class Driver(Enum):
    """The quantity that an effect's size changes with."""

    TIME = "time"
    HEIGHT = "the torch's height"

    @property
    def unit(self) -> str:
        """The driver's unit."""
        return "s" if self is Driver.TIME else "mm"


@dataclass(frozen=True)
class Trend:
    """The change of an effect's parameters, `amplitude` (p,), as a driver goes from `middle` by `half_range`.

    Time is in s from the recording's first frame, the torch's height is in mm above the nominal seam.
    """

    effect: str
    driver: Driver
    middle: float
    half_range: float
    amplitude: tuple[float, ...]

    @classmethod
    def of(cls, observed: ObservedRecording, effect: str, driver: Driver) -> "Trend":
        """Return a trend of amplitude 0 over the driver's range in a recording."""
        driven = [_driver_value(observed.setup, driver, frame) for frame in observed.frames]
        low, high = min(driven), max(driven)
        half = max(0.5 * (high - low), MIN_DRIVER_RANGE)
        return cls(effect, driver, 0.5 * (low + high), half, (0.0,) * len(REGISTRY[effect].parameters))

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """The fitted amplitudes: priors as wide as the effect's, bounds as far as its bounds are apart."""
        return tuple(
            Parameter(
                f"{parameter.name}_by_{self.driver.name.lower()}",
                parameter.unit,
                0.0,
                parameter.prior_sigma,
                parameter.lower - parameter.upper,
                parameter.upper - parameter.lower,
                parameter.step,
            )
            for parameter in REGISTRY[self.effect].parameters
        )

    def driver_position(self, setup: Setup, frame: ObservedFrame) -> float:
        """Return the driver's position u in a frame, about -1 to 1."""
        return (_driver_value(setup, self.driver, frame) - self.middle) / self.half_range

    def driver_positions(self, observed: ObservedRecording) -> Float64:
        """Return u for each residual (n,)."""
        positions = [self.driver_position(observed.setup, frame) for frame in observed.frames]
        return np.repeat(positions, observed.counts)

    def effects_in_frame(
        self, effects: Mapping[str, Values], setup: Setup, frame: ObservedFrame
    ) -> dict[str, Values]:
        """Return effects as they are in a frame."""
        u = self.driver_position(setup, frame)
        return {**effects, self.effect: self.values_at(effects[self.effect], u)}

    def values_at_ends(self, middle: Values) -> tuple[dict[str, float], dict[str, float]]:
        """Return the effect's parameters at the driver's smallest and largest value."""
        return self.values_at(middle, -1.0), self.values_at(middle, 1.0)

    def values_at(self, middle: Values, u: float) -> dict[str, float]:
        """Return the effect's parameters where the driver is at u, within their bounds."""
        return {
            parameter.name: float(
                np.clip(middle[parameter.name] + u * amplitude, parameter.lower, parameter.upper)
            )
            for parameter, amplitude in zip(REGISTRY[self.effect].parameters, self.amplitude, strict=True)
        }


def effects_in_frame(
    effects: Mapping[str, Values], trend: Trend | None, setup: Setup, frame: ObservedFrame
) -> Mapping[str, Values]:
    """Return effects as they are in a frame; one of them may have a trend."""
    return effects if trend is None else trend.effects_in_frame(effects, setup, frame)


def trend_among(trend: Trend | None, effects: Mapping[str, Values]) -> Trend | None:
    """Return a trend if its effect is among some, else None."""
    return trend if trend is not None and trend.effect in effects else None


def _driver_value(setup: Setup, driver: Driver, frame: ObservedFrame) -> float:
    if driver is Driver.TIME:
        return frame.condition.timestamp_s
    return float(make_scene(setup, frame.pose_at(frame.timestamp_s)).T_joint_tool[2, 3])
