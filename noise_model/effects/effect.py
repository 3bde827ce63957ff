"""Effect: an id, a stage, parameters, and where it acts on the way from source to pixel."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from enum import Enum
from functools import cached_property

import numpy as np

from noise_model.compiled.arrays import Float64, Integers
from noise_model.condition import Condition
from noise_model.effects.light import Light
from noise_model.fit import Parameter
from noise_model.instrument.sensor import Sensor
from noise_model.setup import Setup
from noise_model.spelling import cure_for
from noise_model.surface.joint import Joint
from noise_model.view import View

Values = Mapping[str, float]
"""An effect's parameters by name, all of them."""

Effects = Mapping[str, Values]
"""Effects that act, by name."""

Draw = np.random.Generator | None
"""None for the mean and variance of a random effect; a generator for one realisation of it."""

ANOTHER_VALUE, UNSTATED, ANY_FORM, ANY_SCENE = 0.05, 0.5, 1.0, 3.0
"""By which share an effect's form may be off if it is but another value of what a setup states.

And if it depends on much that no setup states: where the fume drifts, what else stands about a joint, what
mirrors the laser, how a drift goes on, how far dark current lifts the rows that are read last. And if it
stands for any form: a response that is no power. And if it shows any scene: the reflectances of scaled steel
and of paper, 3 % and 90 %, lie within two such of 16 %, their geometric mean.
"""

OnCodes = Callable[[Integers, Sensor, Values], Integers]

OnVariance = Callable[[Float64, Float64, Sensor, Values], Float64]

OnLight = Callable[[Light, View, Condition, Values, Draw], None]


class Stage(Enum):
    """Stage of an effect, in the order light takes; geometry and timing change what is rendered."""

    SOURCE = "source"
    ILLUMINATION = "illumination"
    SURFACE = "surface"
    MEDIUM = "medium"
    OPTICS = "optics"
    SENSOR = "sensor"
    GEOMETRY = "geometry"
    TIMING = "timing"


@dataclass(frozen=True)
class Effect:
    """One thing that the nominal model leaves out.

    `summary` says what, `equation` how it is modelled and `source` after whom. A parameter's `start` is its
    neutral value, at which the effect vanishes. `typical` are the values that the documentation shows it
    with. Of the places where an effect may act those are given that it needs:

    - `setup`: returns the setup that is really there, and is the only place then. What it changes in sensor,
      point-spread function or exposure needs no new rendering;
    - `condition`: returns the frame's real levels and exposure;
    - `light`: changes the light before the lens' point-spread function, e- for `camera.exposure_s`;
    - `image`: changes the charge behind it, e- for the frame's own exposure;
    - `codes`: changes a frame's DN behind the sensor, and `codes_variance` their predicted variance, DN^2.

    `is_followed` says whether it is predicted for a joint at all, `needs` names the optional sections of a
    setup that must be stated for it, `form_rel` by which share of what it does to an image its form may be
    off in a plant: as a function of its stage's coordinates, or of the place on the part if it `is_textured`.
    `spreads` says that it brings a pixel light from elsewhere in the image; the lens' point-spread function
    does so by itself.
    """

    id: str
    stage: Stage
    summary: str
    equation: str
    source: str
    parameters: tuple[Parameter, ...]
    typical: Values
    setup: Callable[[Setup, Values], Setup] | None = None
    condition: Callable[[Condition, Values], Condition] | None = None
    light: OnLight | None = None
    image: OnLight | None = None
    codes: OnCodes | None = None
    codes_variance: OnVariance | None = None
    is_followed: Callable[[Joint], bool] = lambda joint: True
    needs: tuple[str, ...] = ()
    form_rel: float = 0.1
    is_textured: bool = False
    spreads: bool = False

    def __post_init__(self) -> None:
        names = {parameter.name for parameter in self.parameters}
        if len(names) < len(self.parameters) or not set(self.typical) <= names:
            raise ValueError(f"{self.id}: its parameters' names do not fit")
        if self.setup is not None and (self.condition or self.light or self.image or self.codes):
            raise ValueError(f"{self.id}: what changes the setup is applied once and acts nowhere else")

    @property
    def neutral(self) -> dict[str, float]:
        """The parameters' neutral values."""
        return {parameter.name: parameter.start for parameter in self.parameters}

    @cached_property
    def _by_name(self) -> dict[str, Parameter]:
        return {parameter.name: parameter for parameter in self.parameters}

    def complete(self, values: Values) -> dict[str, float]:
        """Return all parameters, those not given neutral.

        Raises ValueError for an unknown name and for a value that is no finite number within its bounds.
        """
        known = self._by_name
        for name, value in values.items():
            if name not in known:
                raise ValueError(
                    f"[effects.{self.id}] {name}: is no parameter of it; {cure_for(name, known)}"
                )
            low, high = known[name].lower, known[name].upper
            if not low <= value <= high:
                unit = f" {known[name].unit}" if known[name].unit else ""
                raise ValueError(
                    f"[effects.{self.id}] {name} = {value:g}: must lie from {low:g} to {high:g}{unit}"
                )
        return self.neutral | {name: float(value) for name, value in values.items()}
