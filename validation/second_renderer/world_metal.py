"""The metal's reflectance for the made recordings, in Dr.Jit: the stated lobe and others it may really have.

f_r = kappa_diff + kappa_spec S, S = G / cos(theta_r) fall(h), theta_r towards the camera (RECORDING.md,
`[material]`). The parts are kept apart, so that another metal's kappas need no new rendering. Nothing of
Dr.Jit is imported until it is called.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

GROOVE_RATIO = 9.0
"""How much narrower the lobe of grooves is along them than the metal's, and wider across, in its square."""

MIN_SQUARE = 1e-12
"""Keeps powers and quotients of a square finite."""


@dataclass(frozen=True)
class LobeShape:
    """How the lobe falls with the half vector's lean alpha from the normal.

    With X = c2 alpha^2 and t = tan(alpha):

    - `gaussian`: exp(-X), the stated one;
    - `two_lobes`: (1 - a) exp(-X) + a exp(-X / b^2), the second b times as wide;
    - `ggx`: (1 - a) exp(-X) + a / (1 + c2 t^2 / 2)^2, Walter et al. 2007;
    - `ward`: exp(-X (e^a cos^2 psi + e^-a sin^2 psi)), psi the lean's azimuth from the marks, b in degrees;
    - `slopes`: exp(-c2 (e^a p^2 + e^-a q^2)), p and q the half vector's slopes along and across the marks;
    - `grooves`: (1 - a) exp(-X) + a exp(-X (9 cos^2 psi + sin^2 psi / 9)), a share a of cylindrical grooves,
      which spread light across them alone, Poulin and Fournier 1990;
    - `exponential_power`: exp(-(c2 t^2)^a), Holzschuch and Pacanowski 2017.

    For the three with marks these run at b degrees to the left of travel on the plate. With a `tail` the
    exponentials of `gaussian` and `ward` are (1 + tail Y)^(-1/tail), a power law, instead of exp(-Y).
    """

    kind: str = "gaussian"
    a: float = 0.0
    b: float = 0.0
    tail: float = 0.0


STATED_LOBE = LobeShape()


def specular(c2: float, shape: LobeShape, n: Any, omega_i: Any, omega_r: Any) -> Any:
    """Return S = G / cos(theta_r) fall of unit vectors (Dr.Jit); 0 where either direction is below.

    G = min(1, 2 cos(alpha) cos(theta) / cos(beta)) with the smaller of the two cosines (Eq. 5).
    """
    import drjit as dr

    cos_i, cos_r = dr.dot(omega_i, n), dr.dot(omega_r, n)
    h = dr.normalize(omega_i + omega_r)
    cos_alpha = dr.dot(h, n)
    attenuation = dr.minimum(1.0, 2.0 * cos_alpha * dr.minimum(cos_i, cos_r) / dr.dot(h, omega_i))
    value = attenuation / cos_r * _fall(c2, shape, n, h, cos_alpha)
    return dr.select((cos_i > 0.0) & (cos_r > 0.0), value, 0.0)


def _fall(c2: float, shape: LobeShape, n: Any, h: Any, cos_alpha: Any) -> Any:
    import drjit as dr

    lean = h - n * cos_alpha
    sin2 = dr.dot(lean, lean)
    # From sine and cosine: in float32 an arccosine loses small angles.
    alpha = dr.atan2(dr.sqrt(sin2), cos_alpha)
    X = c2 * alpha * alpha
    tan2 = sin2 / (cos_alpha * cos_alpha)
    match shape.kind:
        case "gaussian":
            return _with_tail(shape.tail, X)
        case "two_lobes":
            return (1.0 - shape.a) * dr.exp(-X) + shape.a * dr.exp(-X / shape.b**2)
        case "ggx":
            wide = 1.0 + 0.5 * c2 * tan2
            return (1.0 - shape.a) * dr.exp(-X) + shape.a / (wide * wide)
        case "exponential_power":
            return dr.exp(-dr.power(dr.maximum(c2 * tan2, MIN_SQUARE), shape.a))
        case "grooves":
            along2 = _along_marks2(shape, n, lean)
            stretched = GROOVE_RATIO * along2 + (sin2 - along2) / GROOVE_RATIO
            grooved = dr.exp(-X * dr.select(sin2 > 0.0, stretched / sin2, 1.0))
            return (1.0 - shape.a) * dr.exp(-X) + shape.a * grooved
        case "ward" | "slopes":
            along2 = _along_marks2(shape, n, lean)
            stretched = math.exp(shape.a) * along2 + math.exp(-shape.a) * (sin2 - along2)
            if shape.kind == "slopes":
                return dr.exp(-c2 * stretched / (cos_alpha * cos_alpha))
            return _with_tail(shape.tail, X * dr.select(sin2 > 0.0, stretched / sin2, 1.0))
    raise ValueError(f"lobe shape {shape.kind!r} is not known")


def _with_tail(tail: float, Y: Any) -> Any:
    import drjit as dr

    return dr.power(1.0 + tail * Y, -1.0 / tail) if tail > 0.0 else dr.exp(-Y)


def _along_marks2(shape: LobeShape, n: Any, lean: Any) -> Any:
    """Return the square of the lean's part along the marks' projection on the face."""
    import drjit as dr

    mx, my = math.cos(math.radians(shape.b)), math.sin(math.radians(shape.b))
    m_n = mx * n.x + my * n.y
    along = mx * lean.x + my * lean.y
    return along * along / dr.maximum(1.0 - m_n * m_n, MIN_SQUARE)
