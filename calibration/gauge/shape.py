"""Gauges: a step of known height between two parallel faces, a V of known depth, or any flat plate."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from noise_model.compiled.arrays import Float64

FORMS = "step:HEIGHTmm or v:ANGLEdeg:DEPTHmm (the angle between the flanks)"
"""Notation of a gauge on a command line."""

_NUMBER = r"(\d+(?:\.\d+)?)"
_STEP = re.compile(rf"step:{_NUMBER}mm", re.IGNORECASE)
_V = re.compile(rf"v:{_NUMBER}deg:{_NUMBER}mm", re.IGNORECASE)


class Shape(StrEnum):
    """Shape of a gauge."""

    STEP = "step"
    V = "v"
    PLATE = "plate"


@dataclass(frozen=True)
class Gauge:
    """A gauge; its frame has x along the edge, y across it, z out of its top, the top at z = 0.

    A step is high at y < 0 and low at y > 0. The root of a V is at y = 0. `size_mm` is the step's height or
    the V's depth, `angle_deg` the angle between the V's flanks, 180 for a step. A plate is its top alone, and
    its size means nothing. Raises ValueError for a gauge that cannot be.
    """

    shape: Shape
    size_mm: float
    angle_deg: float = 180.0

    def __post_init__(self) -> None:
        if not self.size_mm > 0.0:
            raise ValueError("its size must be > 0 mm")
        if self.shape is Shape.V and not 10.0 <= self.angle_deg <= 170.0:
            raise ValueError("the angle between its flanks must be 10 to 170 deg")

    @classmethod
    def parse(cls, text: str) -> Gauge:
        """Return the gauge that a text such as step:10mm states; ValueError if it states none."""
        step, v = _STEP.fullmatch(text.strip()), _V.fullmatch(text.strip())
        if step is not None:
            return cls(Shape.STEP, float(step[1]))
        if v is not None:
            return cls(Shape.V, float(v[2]), float(v[1]))
        raise ValueError(f"{text!r} is no gauge: it is written as {FORMS}")

    def __str__(self) -> str:
        if self.shape is Shape.PLATE:
            return "plate"
        if self.shape is Shape.STEP:
            return f"step:{self.size_mm:g}mm"
        return f"v:{self.angle_deg:g}deg:{self.size_mm:g}mm"

    @property
    def noun(self) -> str:
        """Its word in a sentence."""
        return "plate" if self.shape is Shape.PLATE else "gauge"

    @property
    def pieces(self) -> tuple[int, ...]:
        """The faces that the stripe crosses, from y < 0 to y > 0."""
        return {Shape.STEP: (0, 1), Shape.V: (0, 1, 2, 0), Shape.PLATE: (0,)}[self.shape]

    @property
    def faces(self) -> tuple[Float64, Float64]:
        """The faces' normals (k, 3) and how far each lies along its own for a gauge of size 1 mm (k,).

        The last one of a step is the plane of its edge.
        """
        if self.shape is Shape.PLATE:
            return np.array([[0.0, 0.0, 1.0]]), np.array([0.0])
        if self.shape is Shape.STEP:
            return np.array([[0.0, 0.0, 1.0], [0.0, 0.0, 1.0], [0.0, 1.0, 0.0]]), np.array([0.0, -1.0, 0.0])
        s, c = math.sin(math.radians(0.5 * self.angle_deg)), math.cos(math.radians(0.5 * self.angle_deg))
        return np.array([[0.0, 0.0, 1.0], [0.0, c, s], [0.0, -c, s]]), np.array([0.0, -s, -s])


EDGE = 2
"""The face of a step that is the plane of its edge."""

PLATE = Gauge(Shape.PLATE, 1.0)
"""A flat plate, of which nothing else is known."""
