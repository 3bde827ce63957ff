"""Sixteen scan lines' weighted sums, the normal equations of their stripes' fits, and their solution.

The mean of a pixel is A g(t) + its background + offset + slope t, g(t) = exp(-t^2 / 2), t its place over the
stripe's width. Its derivatives with the five unknowns are g, t^k or products of both, so the information
matrix is made of a dozen sums, whatever amplitude and slope are. A lane is a line: all of them take the same
steps at once, and no sum is taken across lanes.
"""

from __future__ import annotations

from typing import NamedTuple

from noise_model.compiled.arrays import Float32
from noise_model.compiled.kernel import REDUCTION, kernel
from noise_model.compiled.lanes import N_LANES, Lanes, Mask, load, spread, where

COUNTS, HIDDEN, BEYOND = 1.0, 0.0, -1.0
"""State of a pixel: it counts; it is censored, a lower bound; it lies beyond its line's window."""


class Block(NamedTuple):
    """Pixels of sixteen lines, (n N_LANES,) each: a pixel of all lines, then the next of all lines.

    `charge` and `background` are e-, `kind` is COUNTS, HIDDEN or BEYOND.
    """

    charge: Float32
    background: Float32
    kind: Float32


class Unknowns(NamedTuple):
    """Fitted parameters, by lane: amplitude, place over width, offset, slope times width.

    With ln(width) these are five numbers of similar derivatives.
    """

    amplitude: Lanes
    place: Lanes
    offset: Lanes
    slope: Lanes


class PixelNoise(NamedTuple):
    """A pixel's variance: `shot` times its mean, `dark`, e-^2, and the square of `speckle` times the bell."""

    shot: Lanes
    dark: Lanes
    speckle: Lanes


class Prior(NamedTuple):
    """Priors of ln(width), offset and slope times width: 1 over their variances.

    `off_width` is how far ln(width) lies off its predicted value; offset and slope are 0 +- their sigma.
    """

    width: Lanes
    offset: Lanes
    slope: Lanes
    off_width: Lanes


class Moments(NamedTuple):
    """Sums over the lines' pixels, w a pixel's weight, g the bell and t the place over the width at it.

    `bell2_k` sums w g^2 t^k, `bell_k` w g t^k, `flat_k` w t^k; `off_k` and `off_bell_k` the same with the
    residual for one w; `chi2` w times the residual's square; `used` is how many pixels counted.
    """

    bell2_0: Lanes
    bell2_1: Lanes
    bell2_2: Lanes
    bell2_3: Lanes
    bell2_4: Lanes
    bell_0: Lanes
    bell_1: Lanes
    bell_2: Lanes
    bell_3: Lanes
    flat_0: Lanes
    flat_1: Lanes
    flat_2: Lanes
    off_bell_0: Lanes
    off_bell_1: Lanes
    off_bell_2: Lanes
    off_0: Lanes
    off_1: Lanes
    chi2: Lanes
    used: Lanes


class Equations(NamedTuple):
    """The information's lower triangle, h_ij, and the gradient, g_i.

    The unknowns are amplitude, place, ln width, offset and slope, in this order.
    """

    h_00: Lanes
    h_10: Lanes
    h_11: Lanes
    h_20: Lanes
    h_21: Lanes
    h_22: Lanes
    h_30: Lanes
    h_31: Lanes
    h_32: Lanes
    h_33: Lanes
    h_40: Lanes
    h_41: Lanes
    h_42: Lanes
    h_43: Lanes
    h_44: Lanes
    g_0: Lanes
    g_1: Lanes
    g_2: Lanes
    g_3: Lanes
    g_4: Lanes


class NewtonStep(NamedTuple):
    """The step H^-1 g, what it gains, g H^-1 g, variances of amplitude and place, and where H is positive.

    Where it is not, the numbers mean nothing.
    """

    step_0: Lanes
    step_1: Lanes
    step_2: Lanes
    step_3: Lanes
    step_4: Lanes
    gained: Lanes
    variance_0: Lanes
    variance_1: Lanes
    is_positive: Mask


@kernel(fastmath=REDUCTION)
def bells(t: Lanes) -> Lanes:
    """Return exp(-t^2 / 2) as `viterbi.bell` does."""
    v = spread(-0.03125) * t * t
    v = where(v > spread(-1.0), v, spread(-1.0))
    b = spread(1.0 / 24.0) + v * (spread(1.0 / 120.0) + v * spread(1.0 / 720.0))
    unity = spread(1.0)
    b = unity + v * (unity + v * (spread(0.5) + v * (spread(1.0 / 6.0) + v * b)))
    b *= b
    b *= b
    b *= b
    return b * b


@kernel(fastmath=REDUCTION)
def moments_of(block: Block, n: int, x: Unknowns, inverse_width: Lanes, noise: PixelNoise) -> Moments:
    """Return the moments of the lines' first n pixels at x."""
    zero, unity = spread(0.0), spread(1.0)
    speckled = noise.speckle * x.amplitude
    bell2_0, bell2_1, bell2_2, bell2_3, bell2_4 = zero, zero, zero, zero, zero
    bell_0, bell_1, bell_2, bell_3 = zero, zero, zero, zero
    flat_0, flat_1, flat_2 = zero, zero, zero
    off_bell_0, off_bell_1, off_bell_2, off_0, off_1 = zero, zero, zero, zero, zero
    chi2, used = zero, zero
    for j in range(n):
        t = spread(j) * inverse_width - x.place
        kind = load(block.kind, j * N_LANES)
        g = bells(t)
        mean = x.amplitude * g + load(block.background, j * N_LANES) + x.offset + x.slope * t
        residual = load(block.charge, j * N_LANES) - mean
        hidden = where(residual > zero, unity, zero)
        counts = where(kind > spread(HIDDEN), unity, where(kind < spread(HIDDEN), zero, hidden))
        grains = speckled * g
        lit = where(mean > zero, mean, zero)
        weight = counts / (noise.shot * lit + noise.dark + grains * grains)
        t2, off = t * t, weight * residual
        w_bell, off_bell = weight * g, off * g
        w_bell2, w_bell2_2 = w_bell * g, w_bell * g * t2
        bell2_0 += w_bell2
        bell2_1 += w_bell2 * t
        bell2_2 += w_bell2_2
        bell2_3 += w_bell2_2 * t
        bell2_4 += w_bell2_2 * t2
        bell_0 += w_bell
        bell_1 += w_bell * t
        bell_2 += w_bell * t2
        bell_3 += w_bell * t2 * t
        flat_0 += weight
        flat_1 += weight * t
        flat_2 += weight * t2
        off_bell_0 += off_bell
        off_bell_1 += off_bell * t
        off_bell_2 += off_bell * t2
        off_0 += off
        off_1 += off * t
        chi2 += off * residual
        used += counts
    return Moments(
        bell2_0=bell2_0,
        bell2_1=bell2_1,
        bell2_2=bell2_2,
        bell2_3=bell2_3,
        bell2_4=bell2_4,
        bell_0=bell_0,
        bell_1=bell_1,
        bell_2=bell_2,
        bell_3=bell_3,
        flat_0=flat_0,
        flat_1=flat_1,
        flat_2=flat_2,
        off_bell_0=off_bell_0,
        off_bell_1=off_bell_1,
        off_bell_2=off_bell_2,
        off_0=off_0,
        off_1=off_1,
        chi2=chi2,
        used=used,
    )


@kernel(fastmath=REDUCTION)
def normal_equations(m: Moments, x: Unknowns, prior: Prior) -> Equations:
    """Return the normal equations that the lines' moments give, with the priors.

    The mean's derivatives are g, A g t - slope, A g t^2, 1 and t.
    """
    A, slope = x.amplitude, x.slope
    double = spread(2.0) * slope
    return Equations(
        h_00=m.bell2_0,
        h_10=A * m.bell2_1 - slope * m.bell_0,
        h_11=A * (A * m.bell2_2 - double * m.bell_1) + slope * slope * m.flat_0,
        h_20=A * m.bell2_2,
        h_21=A * (A * m.bell2_3 - slope * m.bell_2),
        h_22=A * A * m.bell2_4 + prior.width,
        h_30=m.bell_0,
        h_31=A * m.bell_1 - slope * m.flat_0,
        h_32=A * m.bell_2,
        h_33=m.flat_0 + prior.offset,
        h_40=m.bell_1,
        h_41=A * m.bell_2 - slope * m.flat_1,
        h_42=A * m.bell_3,
        h_43=m.flat_1,
        h_44=m.flat_2 + prior.slope,
        g_0=m.off_bell_0,
        g_1=A * m.off_bell_1 - slope * m.off_0,
        g_2=A * m.off_bell_2 - prior.off_width * prior.width,
        g_3=m.off_0 - x.offset * prior.offset,
        g_4=m.off_1 - slope * prior.slope,
    )


@kernel(fastmath=REDUCTION)
def solve(e: Equations) -> NewtonStep:
    """Solve the lines' normal equations by H = L D L^T; written out, so that no number leaves its register.

    `c_ij` are the elements of L D, `i_j` those of 1 / D, and the variances the squares of L^-1's columns over
    D.
    """
    zero, unity = spread(0.0), spread(1.0)
    i_0 = unity / e.h_00
    l_10, l_20, l_30, l_40 = e.h_10 * i_0, e.h_20 * i_0, e.h_30 * i_0, e.h_40 * i_0
    d_1 = e.h_11 - l_10 * e.h_10
    i_1 = unity / d_1
    c_21, c_31, c_41 = e.h_21 - l_20 * e.h_10, e.h_31 - l_30 * e.h_10, e.h_41 - l_40 * e.h_10
    l_21, l_31, l_41 = c_21 * i_1, c_31 * i_1, c_41 * i_1
    d_2 = e.h_22 - l_20 * e.h_20 - l_21 * c_21
    i_2 = unity / d_2
    c_32 = e.h_32 - l_30 * e.h_20 - l_31 * c_21
    c_42 = e.h_42 - l_40 * e.h_20 - l_41 * c_21
    l_32, l_42 = c_32 * i_2, c_42 * i_2
    d_3 = e.h_33 - l_30 * e.h_30 - l_31 * c_31 - l_32 * c_32
    i_3 = unity / d_3
    c_43 = e.h_43 - l_40 * e.h_30 - l_41 * c_31 - l_42 * c_32
    l_43 = c_43 * i_3
    d_4 = e.h_44 - l_40 * e.h_40 - l_41 * c_41 - l_42 * c_42 - l_43 * c_43
    i_4 = unity / d_4
    is_positive = (e.h_00 > zero) & (d_1 > zero) & (d_2 > zero) & (d_3 > zero) & (d_4 > zero)

    y_1 = e.g_1 - l_10 * e.g_0
    y_2 = e.g_2 - l_20 * e.g_0 - l_21 * y_1
    y_3 = e.g_3 - l_30 * e.g_0 - l_31 * y_1 - l_32 * y_2
    y_4 = e.g_4 - l_40 * e.g_0 - l_41 * y_1 - l_42 * y_2 - l_43 * y_3
    z_0, z_1, z_2, z_3, step_4 = e.g_0 * i_0, y_1 * i_1, y_2 * i_2, y_3 * i_3, y_4 * i_4
    gained = e.g_0 * z_0 + y_1 * z_1 + y_2 * z_2 + y_3 * z_3 + y_4 * step_4
    step_3 = z_3 - l_43 * step_4
    step_2 = z_2 - l_32 * step_3 - l_42 * step_4
    step_1 = z_1 - l_21 * step_2 - l_31 * step_3 - l_41 * step_4
    step_0 = z_0 - l_10 * step_1 - l_20 * step_2 - l_30 * step_3 - l_40 * step_4

    b_2 = l_10 * l_21 - l_20
    b_3 = l_10 * l_31 - l_30 - l_32 * b_2
    b_4 = l_10 * l_41 - l_40 - l_42 * b_2 - l_43 * b_3
    variance_0 = i_0 + l_10 * l_10 * i_1 + b_2 * b_2 * i_2 + b_3 * b_3 * i_3 + b_4 * b_4 * i_4
    b_3 = l_21 * l_32 - l_31
    b_4 = l_21 * l_42 - l_41 - l_43 * b_3
    variance_1 = i_1 + l_21 * l_21 * i_2 + b_3 * b_3 * i_3 + b_4 * b_4 * i_4
    return NewtonStep(
        step_0=step_0,
        step_1=step_1,
        step_2=step_2,
        step_3=step_3,
        step_4=step_4,
        gained=gained,
        variance_0=variance_0,
        variance_1=variance_1,
        is_positive=is_positive,
    )
