"""The experiments that a diagnosis may ask for next: frames that are taken otherwise than those it has seen.

They are data alone: what a fit expects of them is `next`'s, what they really show is the recording's.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from noise_model.frames import Point

TILT_DEG, RAISE_MM, CURRENT, EXPOSURE, FASTER = 10.0, 2.0, 1.5, 0.5, 3.0
"""The changes that the experiments make: angle, height, and factors of the rest."""


@dataclass(frozen=True)
class Experiment:
    """One of the menu: laser and arc on, at the setup's exposure and current, but for what it says.

    `name` is what the report asks for, `key` a word for it in names of files. `exposure` and `current` are
    factors of the setup's, `speed` is one of the motion's; the tool is turned by the rotation vector
    `turn_deg` and moved by `move_mm`, both in its own frame.
    """

    key: str
    name: str
    laser_on: bool = True
    arc_on: bool = True
    exposure: float = 1.0
    current: float = 1.0
    turn_deg: Point = (0.0, 0.0, 0.0)
    move_mm: Point = (0.0, 0.0, 0.0)
    speed: float = 1.0


MENU = (
    Experiment("dark", "dark frames", laser_on=False, arc_on=False),
    Experiment("laser", "laser alone, arc off", arc_on=False),
    Experiment("arc", "arc alone, laser off", laser_on=False),
    Experiment("exposure", "a second exposure, half as long", exposure=EXPOSURE),
    Experiment("current", "a second current, half as much again", current=CURRENT),
    Experiment("raised", f"the torch raised by {RAISE_MM:g} mm", move_mm=(0.0, 0.0, RAISE_MM)),
    Experiment("sideways", f"the torch tilted sideways by {TILT_DEG:g} deg", turn_deg=(TILT_DEG, 0.0, 0.0)),
    Experiment(
        "along", f"the torch tilted along the seam by {TILT_DEG:g} deg", turn_deg=(0.0, TILT_DEG, 0.0)
    ),
    Experiment("faster", f"the same run {FASTER:g} times as fast", speed=FASTER),
)
"""What may be measured next."""

BY_NAME: Mapping[str, Experiment] = {experiment.name: experiment for experiment in MENU}
"""The menu by what the report asks for."""
