"""Reflectance of the base metal: Lambert + Torrance-Sparrow as the paper prints it (Eq. 5 and 7)."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numba
import numpy as np

from noise_model.frames import Float64


@dataclass(frozen=True)
class Material:
    """A row of the paper's Table 1: f_r = kappa_diff + kappa_spec G / cos(theta_r) exp(-c2 alpha^2), 1/sr.

    alpha is in radians. The kappas are relative: the paper normalised its grey levels.
    """

    name: str
    kappa_diff: float
    kappa_spec: float
    c2: float

    def __post_init__(self) -> None:
        for name in ("kappa_diff", "kappa_spec"):
            if not getattr(self, name) >= 0:
                raise ValueError(f"[material] {name} = {getattr(self, name)}: must be >= 0")
        if not self.kappa_diff + self.kappa_spec > 0:
            raise ValueError("[material] kappa_diff, kappa_spec: a surface that reflects nothing")
        if not self.c2 > 0:
            raise ValueError(f"[material] c2 = {self.c2}: must be > 0")


MILD_STEEL = Material("mild_steel", 0.021, 0.326, 112.0)
ZN_COATED = Material("zn_coated", 0.495, 0.153, 8.331)
TABLE_1 = {material.name: material for material in (MILD_STEEL, ZN_COATED)}


def reflectance(
    omega_i: Float64, omega_r: Float64, normal: Float64, kappa_diff: float, kappa_spec: float, c2: float
) -> Float64:
    """Return f_r (...,), 1/sr, for unit vectors (..., 3) towards the source and the viewer (Eq. 7).

    G = min(1, 2 cos(alpha) cos(theta_r) / cos(beta), 2 cos(alpha) cos(theta_i) / cos(beta)) (Eq. 5), with the
    half vector h, cos(alpha) = n.h and cos(beta) = omega_i.h. 0 where either direction is below the surface.

    As printed the lobe lacks Torrance and Sparrow's 1/cos(theta_i) and so is not reciprocal. It is kept so
    because Table 1's values were fitted with it.
    """
    cos_i = np.sum(omega_i * normal, axis=-1)
    cos_r = np.sum(omega_r * normal, axis=-1)
    half = omega_i + omega_r
    with np.errstate(divide="ignore", invalid="ignore"):
        half = half / np.linalg.norm(half, axis=-1, keepdims=True)
        cos_alpha = np.clip(np.sum(half * normal, axis=-1), -1.0, 1.0)
        cos_beta = np.sum(half * omega_i, axis=-1)
        shadowing = 2.0 * cos_alpha * np.minimum(cos_i, cos_r) / cos_beta
        lobe = np.minimum(1.0, shadowing) / cos_r * np.exp(-c2 * np.arccos(cos_alpha) ** 2)
        value = kappa_diff + kappa_spec * lobe
    return np.where((cos_i > 0) & (cos_r > 0), value, 0.0)


@numba.njit(inline="always")
def alpha_squared(cos_alpha: float) -> float:
    """Return arccos(cos_alpha)^2 to 1e-6 relative.

    arccos(1 - x)^2 = sum_{n >= 1} (2x)^n 2 / (n^2 C(2n, n)), the series of 4 arcsin(sqrt(x/2))^2, cut after
    eight terms and used up to 60 degrees; it saves the arccosine where the lobe matters.
    """
    if cos_alpha < 0.5:
        angle = math.acos(max(cos_alpha, -1.0))
        return angle * angle
    x = 1.0 - min(cos_alpha, 1.0)
    tail = 8.0 / 1575.0 + x * (4.0 / 2079.0 + x * (16.0 / 21021.0 + x * (2.0 / 6435.0)))
    return 2.0 * x * (1.0 + x * (1.0 / 6.0 + x * (2.0 / 45.0 + x * (1.0 / 70.0 + x * tail))))
