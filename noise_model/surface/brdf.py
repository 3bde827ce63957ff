"""Reflectance of the base metal: Lambert + Torrance-Sparrow (Eq. 5, 7) and the mirror spike (Eq. 6).

docs/explanation/paper.md lists where the printed equations and these functions part, and why.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from noise_model.compiled.arrays import Float64, Vector
from noise_model.compiled.kernel import kernel


@dataclass(frozen=True)
class Lobe:
    """Departure of a lobe from the paper's round Gaussian exp(-c2 alpha^2); none at the neutral values.

    `tail` nu >= 0 makes it (1 + nu c2 alpha^2)^(-1/nu): the slopes follow Student's t instead of a Gaussian,
    as on many rough surfaces (Ribardiere et al. 2017, Computer Graphics Forum 36(2) 421-429), nu = 1/2 and 1
    are the forms of Trowbridge and Reitz (1975) and of Cauchy. `anisotropy` a and `marks_deg` make it
    elliptical, as Ward (1992, SIGGRAPH 26(2) 265-272) does: c2 is exp(a) times as large where the half vector
    leans along the rolling marks and exp(-a) times across them; the marks lie at `marks_deg` to the left of
    travel on the plate, and on a tilted face along their projection.
    """

    tail: float = 0.0
    anisotropy: float = 0.0
    marks_deg: float = 0.0

    def __post_init__(self) -> None:
        if not 0 <= self.tail < math.inf:
            raise ValueError(f"lobe tail = {self.tail}: must be >= 0 and finite")
        if not (math.isfinite(self.anisotropy) and math.isfinite(self.marks_deg)):
            raise ValueError("lobe anisotropy, marks_deg: must be finite")

    @property
    def marks(self) -> tuple[float, float]:
        """The marks' direction (x, y) in the joint frame."""
        angle = math.radians(self.marks_deg)
        return math.cos(angle), math.sin(angle)


GAUSSIAN = Lobe()


@dataclass(frozen=True)
class Material:
    """A row of the paper's Table 1: f_r = kappa_diff + kappa_spec G / cos(theta_r) exp(-c2 alpha^2), 1/sr.

    The kappas are relative: the paper normalised its grey levels.

    Parameters
    ----------
    name : str
        The metal's name.
    kappa_diff : float
        The diffuse part, 1/sr.
    kappa_spec : float
        The specular part, 1/sr.
    c2 : float
        The lobe's narrowness, 1/rad^2; alpha is in radians.
    lobe : Lobe
        What the paper leaves out of the lobe's shape.

    Raises
    ------
    ValueError
        For a value out of its range.
    """

    name: str
    kappa_diff: float
    kappa_spec: float
    c2: float
    lobe: Lobe = GAUSSIAN

    def __post_init__(self) -> None:
        for name in ("kappa_diff", "kappa_spec"):
            if not getattr(self, name) >= 0:
                raise ValueError(f"[material] {name} = {getattr(self, name)}: must be >= 0")
        if not self.kappa_diff + self.kappa_spec > 0:
            raise ValueError("[material] kappa_diff, kappa_spec: a surface that reflects nothing")
        if not self.c2 > 0:
            raise ValueError(f"[material] c2 = {self.c2}: must be > 0")

    def __str__(self) -> str:
        if self == UNSTATED_METAL:
            return self.name
        # A name comes from a file, and may hold what a terminal obeys.
        name = self.name if self.name.isprintable() else repr(self.name)
        return f"{name}: kappa_diff {self.kappa_diff:g}, kappa_spec {self.kappa_spec:g}, c2 {self.c2:g}"

    @property
    def relative_albedo(self) -> float:
        """Share of normally incident light that is reflected, in the units of the kappas.

        The integral of f_r cos(theta_r) over the directions out, with the lobe's shape and G.
        """
        return math.pi * self.kappa_diff + self.kappa_spec * _lobe_albedo(self.c2, self.lobe)


UNSTATED_METAL = Material("an unstated metal", 1.0, 0.0, 1.0)
"""Stand-in for a metal that no setup states: it reflects evenly.

How bright a stripe is nobody needs it for: that is `[laser] peak_e`, whatever even metal it falls on.
"""

ALBEDO_NODES, ALBEDO_AZIMUTHS = 32, 128
"""Nodes of a lobe's albedo on either side of 60 degrees, where G begins to fall, and about the normal."""


@lru_cache(maxsize=256)
def _lobe_albedo(c2: float, lobe: Lobe) -> float:
    """Return the integral of G exp(-c2 alpha^2) d(omega_r), sr, for light that falls straight on.

    There alpha = theta_r / 2 and G = min(1, 2 cos(theta_r)). Gauss-Legendre in t of theta_r = w sinh(t), w
    the lobe's width, finds the middle of a narrow lobe as well as a long tail. About the normal, midpoints in
    phi of tan(psi) = exp(a) tan(phi), psi from the marks: c2 grows by m = dpsi / dphi there, and the share of
    a narrow lobe, as 1 / m, is the same for every phi.
    """
    phi = np.pi / 2.0 * (np.arange(ALBEDO_AZIMUTHS)[:, np.newaxis] + 0.5) / ALBEDO_AZIMUTHS
    a = lobe.anisotropy
    m = 1.0 / (np.exp(-a) * np.cos(phi) ** 2 + np.exp(a) * np.sin(phi) ** 2)
    width = 2.0 / np.sqrt(c2 * m)
    x, weight = np.polynomial.legendre.leggauss(ALBEDO_NODES)
    total = np.zeros_like(phi)
    for low, high in ((0.0, np.pi / 3.0), (np.pi / 3.0, np.pi / 2.0)):
        first, last = np.arcsinh(low / width), np.arcsinh(high / width)
        t = first + (last - first) * 0.5 * (x + 1.0)
        theta = width * np.sinh(t)
        attenuation = np.minimum(1.0, 2.0 * np.cos(theta))
        light = attenuation * _fall(np.sinh(t) ** 2, lobe.tail) * np.sin(theta) * width * np.cosh(t)
        total += 0.5 * (last - first) * (light @ weight)[:, np.newaxis]
    return float(2.0 * np.pi * np.mean(total * m))


MILD_STEEL = Material("mild_steel", 0.021, 0.326, 112.0)
ZN_COATED = Material("zn_coated", 0.495, 0.153, 8.331)
TABLE_1 = {material.name: material for material in (MILD_STEEL, ZN_COATED)}


def geometrical_attenuation(omega_i: Float64, omega_r: Float64, normal: Float64) -> Float64:
    """Return G (...,) of Torrance and Sparrow (1967) for unit vectors (..., 3), Eq. 5.

    G = min(1, 2 cos(alpha) cos(theta_r) / cos(beta), 2 cos(alpha) cos(theta_i) / cos(beta)), with the half
    vector h, cos(alpha) = n.h and cos(beta) = omega_i.h. Stands for both directions above the surface.
    """
    cos_alpha, cos_beta = _half_angle_cosines(omega_i, omega_r, normal)
    cos_lower = np.minimum(np.sum(omega_i * normal, axis=-1), np.sum(omega_r * normal, axis=-1))
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(np.minimum(1.0, 2.0 * cos_alpha * cos_lower / cos_beta))


def _half_angle_cosines(omega_i: Float64, omega_r: Float64, normal: Float64) -> tuple[Float64, Float64]:
    """Return cos(alpha) = n.h and cos(beta) = omega_i.h of the half vector h; NaN for opposite directions."""
    half = omega_i + omega_r
    with np.errstate(invalid="ignore"):
        half = half / np.linalg.norm(half, axis=-1, keepdims=True)
    cos_alpha = np.clip(np.sum(half * normal, axis=-1), -1.0, 1.0)
    return cos_alpha, np.sum(half * omega_i, axis=-1)


def reflectance(
    omega_i: Float64,
    omega_r: Float64,
    normal: Float64,
    kappa_diff: float,
    kappa_spec: float,
    c2: float,
    lobe: Lobe = GAUSSIAN,
) -> Float64:
    """Return f_r (...,), 1/sr, for unit vectors (..., 3) towards the source and the viewer (Eq. 7).

    f_r = kappa_diff + kappa_spec G / cos(theta_r) exp(-c2 alpha^2); 0 where either direction is below the
    surface. `lobe` gives the exponential another shape; with rolling marks the vectors are the joint frame's.

    As printed the lobe lacks Torrance and Sparrow's 1/cos(theta_i) and so is not reciprocal. It is kept so
    because Table 1's values were fitted with it.
    """
    cos_i = np.sum(omega_i * normal, axis=-1)
    cos_r = np.sum(omega_r * normal, axis=-1)
    cos_alpha, _ = _half_angle_cosines(omega_i, omega_r, normal)
    attenuation = geometrical_attenuation(omega_i, omega_r, normal)
    with np.errstate(divide="ignore", invalid="ignore"):
        exponent = c2 * np.arccos(cos_alpha) ** 2
        if lobe.anisotropy != 0.0:
            exponent = exponent * _marks_factor(omega_i + omega_r, normal, lobe)
        value = kappa_diff + kappa_spec * attenuation / cos_r * _fall(exponent, lobe.tail)
    return np.where((cos_i > 0) & (cos_r > 0), value, 0.0)


def _fall(exponent: Float64, tail: float) -> Float64:
    """Return a lobe's fall over c2 alpha^2 (...,): exp(-x), with a tail (1 + tail x)^(-1 / tail)."""
    return np.asarray(np.exp(-np.log1p(tail * exponent) / tail if tail != 0.0 else -exponent))


def _marks_factor(half: Float64, normal: Float64, lobe: Lobe) -> Float64:
    """Return by what rolling marks multiply c2 (...,): exp(a) cos^2(psi) + exp(-a) sin^2(psi).

    psi is the azimuth of the half vector's tangential part from the marks' projection onto the face.
    """
    marks = np.array([*lobe.marks, 0.0])
    marks = marks - np.sum(marks * normal, axis=-1, keepdims=True) * normal
    lean = half - np.sum(half * normal, axis=-1, keepdims=True) * normal
    length = np.linalg.norm(marks, axis=-1) * np.linalg.norm(lean, axis=-1)
    cos_psi = np.sum(marks * lean, axis=-1) / np.maximum(length, 1e-300)
    return np.asarray(np.exp(-lobe.anisotropy) + 2.0 * np.sinh(lobe.anisotropy) * cos_psi**2)


@kernel(inline=True)
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


LobeNumbers = tuple[float, float, float, float, float, float, float]
"""kappa_diff, kappa_spec, c2, tail, anisotropy and the marks' x and y, as the kernels take them."""


def lobe_numbers(material: Material) -> LobeNumbers:
    """Gather a material for the kernels."""
    lobe = material.lobe
    return (material.kappa_diff, material.kappa_spec, material.c2, lobe.tail, lobe.anisotropy, *lobe.marks)


@kernel(inline=True)
def lobe_fall(
    numbers: LobeNumbers,
    hx: float,
    hy: float,
    hz: float,
    nx: float,
    ny: float,
    nz: float,
    h: float,
    cos_alpha: float,
) -> float:
    """Return the lobe's fall, 1 at its middle: the kernels' twin of `reflectance`'s.

    (hx, hy, hz) is the half vector of length h, (nx, ny, nz) the normal.
    """
    _, _, c2, tail, anisotropy, mx, my = numbers
    exponent = c2 * alpha_squared(cos_alpha)
    if anisotropy != 0.0:
        m_n, h_n = mx * nx + my * ny, h * cos_alpha
        # |m|^2 = 1: what is left of it and of h in the face.
        square = (1.0 - m_n * m_n) * (h * h - h_n * h_n)
        along = mx * hx + my * hy - m_n * h_n
        cos2_psi = along * along / max(square, 1e-300)
        exponent *= math.exp(-anisotropy) + 2.0 * math.sinh(anisotropy) * min(1.0, cos2_psi)
    if tail == 0.0:
        return math.exp(-exponent)
    return math.exp(-math.log1p(tail * exponent) / tail)


@kernel(inline=True)
def reflected(numbers: LobeNumbers, omega_i: Vector, omega_r: Vector, normal: Vector) -> float:
    """Return f_r for unit vectors towards source, viewer and along the normal: the twin of `reflectance`."""
    nx, ny, nz = normal[0], normal[1], normal[2]
    cos_i = omega_i[0] * nx + omega_i[1] * ny + omega_i[2] * nz
    cos_r = omega_r[0] * nx + omega_r[1] * ny + omega_r[2] * nz
    if cos_i <= 0.0 or cos_r <= 0.0:
        return 0.0
    hx, hy, hz = omega_i[0] + omega_r[0], omega_i[1] + omega_r[1], omega_i[2] + omega_r[2]
    h = math.sqrt(hx * hx + hy * hy + hz * hz)
    cos_alpha = (cos_i + cos_r) / h
    attenuation = min(1.0, 4.0 * cos_alpha * min(cos_i, cos_r) / h)
    fall = lobe_fall(numbers=numbers, hx=hx, hy=hy, hz=hz, nx=nx, ny=ny, nz=nz, h=h, cos_alpha=cos_alpha)
    return numbers[0] + numbers[1] * attenuation / cos_r * fall
