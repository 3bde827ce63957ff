"""Cramer-Rao bounds of a stripe and a seam, and the speckle floor below them.

A scan line's pixels are a Gaussian stripe on a background,

    mean(x) = A exp(-1/2 ((x - x_0) / w)^2) + b_0 + b_1 x,

each with its own predicted variance V: shot noise of stripe and arc light, read noise, quantisation. No
unbiased fit of A, x_0, w, b_0 and b_1 scatters less than the inverse of the Fisher information sum_i J_i
J_i^T / V_i, J the derivatives of the mean (Kay 1993, Fundamentals of Statistical Signal Processing, ch. 3).
The variance's own information on the stripe, a share of the order 1 / V of that, is left out.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from noise_model.compiled.arrays import Float64

PARAMETERS = ("amplitude", "position", "width", "offset", "slope")
"""Unknowns of a scan line: e-, px, px, e-, e-/px."""

POSITION, AMPLITUDE = PARAMETERS.index("position"), PARAMETERS.index("amplitude")

NO_PRIOR = (math.inf,) * len(PARAMETERS)

SPECKLE_NODES = 64


def stripe_sigmas(
    offsets_px: Float64,
    amplitude_e: Float64,
    width_px: Float64,
    variance_e2: Float64,
    spacing_px: npt.ArrayLike = 1.0,
    prior_sigma: npt.ArrayLike = NO_PRIOR,
) -> Float64:
    """Return the bounds (n, 5) of `PARAMETERS` in n scan lines, everything unknown at once.

    `offsets_px` (n, k): where the pixels lie from the stripe's centre; `amplitude_e`, `width_px` (n,);
    `variance_e2` (n, k). `spacing_px` (n,) or a number: how many pixels each of the k stands for, for a sum
    over fewer nodes. `prior_sigma` (5,) or (n, 5): 1 sigma known beforehand, infinite for nothing. NaN for a
    line whose amplitude or width is not > 0.
    """
    A = np.asarray(amplitude_e, dtype=np.float64)
    w = np.asarray(width_px, dtype=np.float64)
    n = len(A)
    good = (A > 0.0) & (w > 0.0) & np.isfinite(w)
    A, w = np.where(good, A, 1.0), np.where(good, w, 1.0)
    t = offsets_px / w[:, np.newaxis]
    g = np.exp(-0.5 * t**2)
    # In units of A, w, w, A and A / w all five derivatives are of the order of A.
    J = A[:, np.newaxis, np.newaxis] * np.stack([g, t * g, t**2 * g, np.ones_like(t), t], axis=1)
    weight = np.broadcast_to(spacing_px, (n,))[:, np.newaxis] / np.where(
        good[:, np.newaxis], variance_e2, 1.0
    )
    information = (J * weight[:, np.newaxis, :]) @ J.swapaxes(1, 2)
    units = np.stack([A, w, w, A, A / w], axis=1)
    known = (units / np.broadcast_to(prior_sigma, (n, len(PARAMETERS)))) ** 2
    information += known[:, :, np.newaxis] * np.eye(len(PARAMETERS))
    sigmas = units * np.sqrt(np.diagonal(np.linalg.inv(information), axis1=1, axis2=2))
    return np.where(good[:, np.newaxis], sigmas, np.nan)


def speckle_image_sigma_mm(wavelength_mm: float, image_f_number: float, contrast: float = 1.0) -> float:
    """Return the 1 sigma of a stripe's place in the image by speckle alone, mm: C lambda / (2 pi sin(u')).

    In depth that is delta_z = C lambda / (2 pi sin(u_obs) sin(theta)): C the speckle contrast, u_obs half the
    angle under which the point sees the lens' aperture, theta the angle between laser and camera (Dorsch,
    Haeusler and Herrmann 1994, Applied Optics 33(7) 1306-1314). By Abbe's sine condition
    sin(u_obs) = m sin(u') with m the magnification, and a height delta_z moves the image by
    m sin(theta) delta_z. sin(u') = 1 / (2 N'), N' = N (1 + m) the working f-number. It is a floor: the
    centroid of a stripe of 1 sigma w, much wider than a speckle s = lambda N', wanders by
    C sqrt(s w / (4 sqrt(pi))); both agree at w = 0.72 s.
    """
    return contrast * wavelength_mm * image_f_number / math.pi


def pixel_contrast(wavelength_mm: float, image_f_number: float, pixel_mm: float) -> float:
    """Return the contrast that is left of fully developed speckle after a pixel's width along the stripe.

    C^2 = 2/p integral_0^p (1 - x/p) sinc^2(x / s) dx, s = lambda N', the intensity's correlation under a
    square aperture (Goodman 2007, Speckle Phenomena in Optics, sec. 4.6): 1 for small pixels, sqrt(s / p) for
    large ones.
    """
    x, weight = np.polynomial.legendre.leggauss(SPECKLE_NODES)
    share = 0.5 * (x + 1.0)
    correlation = np.sinc(share * pixel_mm / (wavelength_mm * image_f_number)) ** 2
    return float(np.sqrt(np.sum(weight * (1.0 - share) * correlation)))


def seam_covariance_mm2(
    normals: Float64,
    moves_mm: Float64,
    sigma_px: Float64,
    lines: npt.ArrayLike = 1.0,
    edge_sigma_mm: float = math.inf,
) -> Float64:
    """Return the bound (2, 2) of the seam point's (y, z) from the scan lines that see the joint.

    The joint is displaced as a whole by D = (0, dy, dz). On a face with unit normal n (n, 3) a line's point
    then moves by p u along the laser plane, u (n, 3) the move for 1 px of stripe centre, and stays on the
    face if n.(p u - D) = 0: the centre moves by p = n.D / n.u, and the information is the sum of the
    gradients' outer products over sigma^2. `lines` (n,) is the number of equal scan lines for each;
    `edge_sigma_mm` is the additional information on y of an edge between two faces. Lines with a sigma that
    is NaN do not count. NaN where the lines leave a direction undetermined.
    """
    across = np.sum(normals * moves_mm, axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        gradient = normals[:, 1:] / across[:, np.newaxis]
        weight = np.broadcast_to(lines, across.shape) / sigma_px**2
    good = np.isfinite(gradient).all(axis=1) & np.isfinite(weight)
    information = (gradient[good] * weight[good, np.newaxis]).T @ gradient[good]
    information[0, 0] += edge_sigma_mm**-2
    # A direction that no line determines, up to rounding.
    if not np.linalg.det(information) > 1e-9 * np.trace(information) ** 2:
        return np.full((2, 2), np.nan)
    return np.linalg.inv(information)


def sampled_edge_sigma_mm(spacing_mm: float) -> float:
    """Return how well a step is placed that lies anywhere between two scan lines: spacing / sqrt(12)."""
    return spacing_mm / math.sqrt(12.0)
