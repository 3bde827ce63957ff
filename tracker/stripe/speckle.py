"""What laser speckle adds to the sigma of a stripe's centre, where the setup's effects state it.

Speckle multiplies the stripe's light A g(t), t = (r - r_0) / w, by grains of contrast C. The fit's centre is
linear in the pixels; with the background's slope b_1 beside it, and the variance V that the fit counts with,

    h = (A t g / w - q w t) / V / (H_11 - q H_12),  q = H_12 / H_22,
    H_11 = A^2 / w int t^2 g^2 / V,  H_12 = A w int t^2 g / V,  H_22 = w^3 int t^2 / V + 1 / sigma_b1^2,

and speckle of correlation rho moves it with

    sigma^2 = (A C w)^2 int int h g rho h g dt dt'.

Grains much smaller than the stripe give 0.40 C^2 K w where an even background's noise prevails, 0.14 C^2 K w
where the stripe's own does, K the pixels in a row that scatter as one, the sum of rho. The field's logarithm
is a Gaussian's (`noise_model.effects`): rho = (exp(s^2 exp(-x^2 / 4 grain^2)) - 1) / C^2, s^2 = ln(1 + C^2).
Neighbouring columns scatter alike too, K of them as one. For a stripe as narrow as a speckle see
`noise_model.plan.cramer_rao` (Dorsch, Haeusler and Herrmann 1994, Applied Optics 33(7) 1306-1314).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from noise_model.arc.map import CELL
from noise_model.arrays import Float32, Float64, Int64
from noise_model.effects import checked
from noise_model.setup import Setup
from tracker.stripe.fit import CORRELATION_PX, MIN_SIGMA_E, WINDOW_SIGMAS

NODES = 65
"""On how many nodes across a line's window the integrals run."""


@dataclass(frozen=True)
class Speckle:
    """A contrast, 0 for none, and its grain, px."""

    contrast: float
    grain_px: float

    @classmethod
    def of(cls, setup: Setup) -> Speckle:
        """Return the speckle that a setup states."""
        values = checked(setup.effects).get("laser_speckle", {"contrast": 0.0, "grain_px": 1.0})
        return cls(values["contrast"], values["grain_px"])

    def correlation(self, apart_px: Float64) -> Float64:
        """Return the correlation of pixels (...) that far apart."""
        rho = np.exp(-(apart_px**2) / (4.0 * self.grain_px**2))
        return np.asarray(np.expm1(math.log1p(self.contrast**2) * rho) / self.contrast**2)

    @property
    def alike(self) -> float:
        """How many pixels in a row, or columns, scatter as one: the sum of their correlation."""
        reach = math.ceil(12.0 * self.grain_px)
        return float(self.correlation(np.arange(-reach, reach + 1.0)).sum())

    def line_contrast(self, width_px: Float64) -> float:
        """Return by how much the brightness of stripes (n,) scatters from line to line, relative.

        A bell weighs 2 sqrt(pi) w pixels as one; so many of them over `alike` scatter each by the contrast.
        """
        if self.contrast == 0.0 or not np.isfinite(width_px).any():
            return self.contrast
        pixels = 2.0 * math.sqrt(math.pi) * float(np.nanmedian(width_px))
        return self.contrast * min(1.0, math.sqrt(self.alike / pixels))


def speckle_variance_px2(
    speckle: Speckle,
    amplitude_e: Float64,
    width_px: Float64,
    background_e: Float64,
    shot: float,
    dark_variance_e2: float,
    slope_sigma_e: Float64,
) -> Float64:
    """Return the variance (n,), px^2, that speckle adds to stripes' centres.

    `amplitude_e`, `width_px`, `background_e` (n,) are a line's, `slope_sigma_e` (n,), e-/px, what the fit
    knows beforehand of its background's slope; its variance of a pixel is `shot` times the mean plus
    `dark_variance_e2`. One correlation is taken for all lines, at their median width.
    """
    A, w = amplitude_e[:, np.newaxis], width_px[:, np.newaxis]
    t = np.linspace(-WINDOW_SIGMAS, WINDOW_SIGMAS, NODES)
    step = t[1] - t[0]
    bell = np.exp(-0.5 * t**2)
    V = shot * np.maximum(A * bell + background_e[:, np.newaxis], 0.0) + dark_variance_e2
    centre, slope = A * t * bell / w, w * t
    H_11, H_12, H_22 = (
        step * np.sum(w * a * b / V, axis=1) for a, b in ((centre, centre), (centre, slope), (slope, slope))
    )
    q = H_12 / (H_22 + slope_sigma_e**-2)
    h = (centre - q[:, np.newaxis] * slope) / V / (H_11 - q * H_12)[:, np.newaxis]
    moved = step * w * speckle.contrast * A * bell * h
    rho = speckle.correlation(float(np.median(width_px)) * (t[:, np.newaxis] - t))
    return np.asarray(np.sum((moved @ rho) * moved, axis=1))


def with_speckle(
    speckle: Speckle,
    fits: Float64,
    expected_px: Float64,
    background_e: Float32,
    lows: Int64,
    shot: float,
    dark_variance_e2: float,
    map_sigma: float,
    base_sigma_e: float,
) -> tuple[Float64, Float64]:
    """Return the lines' sigmas (n,), px, with speckle, and those with which they count beside others.

    `fits` (n, 5) and what follows are as `fit_lines` has them, `expected_px` (n,) the widths whose windows it
    read. Without speckle both are the fit's own. What speckle does to a fit's chi2 has widened that sigma
    already: it is taken back first.
    """
    if speckle.contrast == 0.0:
        return fits[:, 1], fits[:, 1]
    stated, together = np.full((2, len(fits)), np.nan)
    line = np.flatnonzero(np.isfinite(fits[:, 0]))
    if not len(line):
        return stated, together
    position, sigma, amplitude, width, chi2 = fits[line].T
    r = np.clip(np.rint(position).astype(np.int64) - lows[line // CELL], 0, background_e.shape[1] - 1)
    background = background_e[line, r].astype(np.float64)
    freedom = 2.0 * WINDOW_SIGMAS * expected_px[line]
    own = sigma**2 / np.maximum(chi2 - np.sqrt(2.0 / freedom), 1.0)
    slope_sigma = np.maximum(np.hypot(map_sigma * background, base_sigma_e), MIN_SIGMA_E) / CORRELATION_PX
    more = speckle_variance_px2(speckle, amplitude, width, background, shot, dark_variance_e2, slope_sigma)
    stated[line], together[line] = np.sqrt(own + more), np.sqrt(own + speckle.alike * more)
    return stated, together
