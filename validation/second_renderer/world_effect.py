"""What a hidden effect of a made recording is: its forms, and where each acts on the way to the pixel.

An effect has the form that DIAGNOSIS.md's catalogue is modelled with (`CATALOGUE`) and, for many, others;
beside these each has one further form (`world_further_*.py`), whose equation names its source.
Nothing of `noise_model.effects` is used.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np

from noise_model.compiled.arrays import Float64, Integers
from noise_model.setup import Setup
from validation.second_renderer.world_light import Studio, TrueWorld, WorldSight
from validation.second_renderer.world_rays import ArcBody

CATALOGUE = "catalogue"
"""The name of the form that the model's catalogue has too."""

Values = Mapping[str, float]
"""An effect's parameters by name."""

Generator = np.random.Generator


@dataclass(frozen=True)
class Moment:
    """One frame as it really is taken.

    `time_s` counts from the first frame of a run of `duration_s`, and on after it; `pose_time_s` is when the
    controller stamped the pose that the tool has. `laser_level` and `arc_level` are outputs over the true
    nominal ones, the current included; `arc_shift_mm` moves the arc's centre in the tool's frame;
    `tool_height_mm` is the tool's height over the nominal seam line. The camera is turned by the rotation
    vector `camera_turn_deg` and moved by `camera_move_mm` in its own frame.
    """

    index: int
    time_s: float
    duration_s: float
    pose_time_s: float
    laser_level: float
    arc_level: float
    exposure_s: float
    tool_height_mm: float
    arc_shift_mm: tuple[float, float, float] = (0.0, 0.0, 0.0)
    camera_turn_deg: tuple[float, float, float] = (0.0, 0.0, 0.0)
    camera_move_mm: tuple[float, float, float] = (0.0, 0.0, 0.0)


@dataclass(eq=False)
class WorldFrameLight:
    """The light of one frame on its way: images (H, W), e- for `camera.exposure_s`, later for the frame's.

    `arc` and `laser` go with their sources' output, `other` with neither. `draw` is this frame's own.
    """

    studio: Studio
    sight: WorldSight
    body: ArcBody
    moment: Moment
    draw: Generator
    arc: Float64
    laser: Float64
    other: Float64

    def scale(self, factor: float | Float64) -> None:
        """Multiply all light."""
        self.through(lambda image: image * factor)

    def through(self, operator: Callable[[Float64], Float64]) -> None:
        """Send all light through a linear operator on images."""
        self.arc, self.laser, self.other = operator(self.arc), operator(self.laser), operator(self.other)

    @property
    def total(self) -> Float64:
        """All light."""
        return self.arc + self.laser + self.other


@dataclass(frozen=True)
class EffectForm:
    """One functional form of an effect.

    `draw` gives parameters for a generator, a strength from 0 (about three times what noise and tolerance
    hide) to 1 (clearly visible) and the stated setup. Of the places where a form may act those are given that
    it needs, each with the parameters last:

    - `world` changes what is rendered; `moment` levels, exposure, arc and pose of a frame;
    - `light` acts before the lens' point-spread function, `image` behind it;
    - `charge` changes the expected charge (H, W), e-, of the frame's exposure;
    - `noise` draws the read noise (H, W), e-, in place of the stated Gaussian;
    - `response` gives the DN (H, W) over black of a charge, `offset` is added to the black level, DN;
    - `codes` changes the frame's codes (H, W) when all else is done.

    `in_dark` says that it shines where laser and arc are off.
    """

    name: str
    equation: str
    draw: Callable[[Generator, float, Setup], dict[str, float]]
    world: Callable[[TrueWorld, Values], TrueWorld] | None = None
    moment: Callable[[Moment, Values], Moment] | None = None
    light: Callable[[WorldFrameLight, Values], None] | None = None
    image: Callable[[WorldFrameLight, Values], None] | None = None
    charge: Callable[[Float64, TrueWorld, Values], Float64] | None = None
    noise: Callable[[Generator, tuple[int, int], float, Values], Float64] | None = None
    response: Callable[[Float64, TrueWorld, Values], Float64] | None = None
    offset: Callable[[Moment, tuple[int, int], Values], Float64] | None = None
    codes: Callable[[Integers, Values], Integers] | None = None
    in_dark: bool = False


@dataclass(frozen=True)
class HiddenEffect:
    """An effect that acts in a recording: its id, its form's name and its parameters."""

    id: str
    form: str
    values: Values = field(default_factory=dict)


def magnitude(strength: float, low: float, high: float) -> float:
    """Return a magnitude from low to high, evenly on a logarithmic scale."""
    return float(low * (high / low) ** strength)


def signed(draw: Generator, value: float) -> float:
    """Return a value with a drawn sign."""
    return float(value if draw.random() < 0.5 else -value)


def drawn_seed(draw: Generator) -> float:
    """Return a seed that a float holds exactly."""
    return float(draw.integers(2**31))


def direction(draw: Generator, length: float) -> tuple[float, float]:
    """Return a vector (2,) of a length in a drawn direction."""
    angle = draw.uniform(0.0, 2.0 * math.pi)
    return length * math.cos(angle), length * math.sin(angle)
