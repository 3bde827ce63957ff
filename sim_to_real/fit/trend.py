"""An effect whose size changes from frame to frame: along the weld, or with the torch's height over the seam.

Its parameters are theta + u beta in a frame, u running from -1 to 1 over the recording: arc blow grows along
a plate, fume gathers, and an arc is longer where the torch is higher.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum

import numpy as np

from noise_model.arc.map import make_scene
from noise_model.arrays import Float64
from noise_model.effects import REGISTRY, Values
from noise_model.fit import Parameter
from noise_model.setup import Setup
from sim_to_real.data.binned import Observed, ObservedFrame

CHANGING = ("arc_length", "arc_deflection", "arc_radius", "hot_metal_glow", "fume")
"""The effects that a weld itself changes while it goes on."""

LEAST_RANGE = 1e-6
"""What a driver's range is at least: what does not change drives nothing."""


class Driver(Enum):
    """What an effect's size changes with."""

    TIME = "time"
    HEIGHT = "the torch's height"

    @property
    def unit(self) -> str:
        """The unit it is counted in."""
        return "s" if self is Driver.TIME else "mm"


@dataclass(frozen=True)
class Change:
    """By how much an effect's parameters change, `by` (p,), while a driver goes from its `middle` by `half`.

    Time is in s from the recording's first frame, the torch's height over the nominal seam in mm.
    """

    effect: str
    driver: Driver
    middle: float
    half: float
    by: tuple[float, ...]

    @classmethod
    def of(cls, observed: Observed, effect: str, driver: Driver) -> Change:
        """Return no change yet, the driver's range being a recording's."""
        driven = [_drives(observed.setup, driver, frame) for frame in observed.frames]
        low, high = min(driven), max(driven)
        half = max(0.5 * (high - low), LEAST_RANGE)
        return cls(effect, driver, 0.5 * (low + high), half, (0.0,) * len(REGISTRY[effect].parameters))

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """What is fitted of it: as wide a prior as the effect's own, and as far as its bounds are apart."""
        return tuple(
            Parameter(
                f"{of.name}_by_{self.driver.name.lower()}",
                of.unit,
                0.0,
                of.prior_sigma,
                of.lower - of.upper,
                of.upper - of.lower,
                of.step,
            )
            for of in REGISTRY[self.effect].parameters
        )

    def share(self, setup: Setup, frame: ObservedFrame) -> float:
        """Return u of a frame, about -1 to 1."""
        return (_drives(setup, self.driver, frame) - self.middle) / self.half

    def shares(self, observed: Observed) -> Float64:
        """Return u of each residual (n,)."""
        of_frames = [self.share(observed.setup, frame) for frame in observed.frames]
        return np.repeat(of_frames, observed.counts)

    def at(self, effects: Mapping[str, Values], setup: Setup, frame: ObservedFrame) -> dict[str, Values]:
        """Return effects as they are in a frame."""
        return {**effects, self.effect: self.values(effects[self.effect], self.share(setup, frame))}

    def ends(self, middle: Values) -> tuple[dict[str, float], dict[str, float]]:
        """Return the effect's parameters where the driver is least and most."""
        return self.values(middle, -1.0), self.values(middle, 1.0)

    def values(self, middle: Values, u: float) -> dict[str, float]:
        """Return the effect's parameters where the driver is at u, within their bounds."""
        return {
            of.name: float(np.clip(middle[of.name] + u * by, of.lower, of.upper))
            for of, by in zip(REGISTRY[self.effect].parameters, self.by, strict=True)
        }


def effects_in(
    effects: Mapping[str, Values], change: Change | None, setup: Setup, frame: ObservedFrame
) -> Mapping[str, Values]:
    """Return effects as they are in a frame, where one of them may change."""
    return effects if change is None else change.at(effects, setup, frame)


def change_among(change: Change | None, effects: Mapping[str, Values]) -> Change | None:
    """Return a change if the effect that changes is among some."""
    return change if change is not None and change.effect in effects else None


def ends_of(effects: Mapping[str, Values], change: Change | None) -> tuple[Mapping[str, Values], ...]:
    """Return effects as they are at either end of a driver's range; as they are, if none changes."""
    if change is None:
        return (effects,)
    return tuple({**effects, change.effect: values} for values in change.ends(effects[change.effect]))


def _drives(setup: Setup, driver: Driver, frame: ObservedFrame) -> float:
    if driver is Driver.TIME:
        return frame.condition.timestamp_s
    return float(make_scene(setup, frame.pose_at(frame.timestamp_s)).T_joint_tool[2, 3])
