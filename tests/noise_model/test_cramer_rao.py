import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.optimize import curve_fit

from noise_model.plan.cramer_rao import (
    AMPLITUDE,
    POSITION,
    pixel_contrast,
    sampled_edge_sigma_mm,
    seam_covariance_mm2,
    speckle_image_sigma_mm,
    stripe_sigmas,
)

Float64 = NDArray[np.float64]


def line(x: Float64, A: float, x_0: float, w: float, b_0: float, b_1: float) -> Float64:
    return A * np.exp(-((x - x_0) ** 2) / (2 * w**2)) + b_0 + b_1 * x


def white_position_sigma_px(
    amplitude_e: float, width_px: float, noise_e: float, half_window_px: float = math.inf
) -> float:
    """The bound of the position, px, where every pixel has the same noise.

    With a = L / w over the window x_0 -+ L and the slope of the background unknown,

        sigma^2 = N^2 / A^2 / (G - 3 H^2 / (2 L^3)),
        G = (sqrt(pi)/2 erf(a) - a exp(-a^2)) / w,
        H = w (sqrt(2 pi) erf(a / sqrt 2) - 2 a exp(-a^2 / 2)),

    the integrals of the squared derivative and of the derivative times x; amplitude, width and offset are
    even in x - x_0 and cost nothing. Over a long window it is sqrt(2 / sqrt(pi)) sqrt(w) N / A. Pixels must
    be small against the stripe: 0.1 % off at w = 1 px, 8 % at 0.7 px.
    """
    if math.isinf(half_window_px):
        return math.sqrt(2.0 / math.sqrt(math.pi) * width_px) * noise_e / amplitude_e
    a = half_window_px / width_px
    G = (0.5 * math.sqrt(math.pi) * math.erf(a) - a * math.exp(-(a**2))) / width_px
    H = width_px * (math.sqrt(2.0 * math.pi) * math.erf(a / math.sqrt(2.0)) - 2.0 * a * math.exp(-0.5 * a**2))
    return noise_e / amplitude_e / math.sqrt(G - 1.5 * H**2 / half_window_px**3)


def speckle_depth_sigma_mm(
    wavelength_mm: float, sin_u_obs: float, triangulation_deg: float, contrast: float = 1.0
) -> float:
    """The distance uncertainty of laser triangulation by speckle alone, mm.

    delta_z = C lambda / (2 pi sin(u_obs) sin(theta)): C the speckle contrast, u_obs half the angle under
    which the point sees the lens' aperture, theta the angle between laser and camera (Dorsch, Haeusler and
    Herrmann 1994, Applied Optics 33(7) 1306-1314).
    """
    theta = math.radians(triangulation_deg)
    return contrast * wavelength_mm / (2.0 * math.pi * sin_u_obs * math.sin(theta))


@given(
    st.floats(1.0, 12.0),
    st.floats(-0.5, 0.5),
    st.floats(2.5, 8.0),
    st.floats(10.0, 1e4),
    st.floats(5.0, 300.0),
)
def test_white_noise_in_closed_form(w: float, shift: float, a: float, A: float, noise: float) -> None:
    # Nodes so fine that their sum is the integral, a twentieth of the width apart.
    half, n = a * w, round(40 * a)
    step = 2 * half / n
    x = (np.arange(n) + 0.5) * step - half
    sigmas = stripe_sigmas(x[None, :], np.array([A]), np.array([w]), np.full((1, n), noise**2), step)
    assert sigmas[0, POSITION] == pytest.approx(white_position_sigma_px(A, w, noise, half), rel=1e-3)
    # In whole pixels and with a known slope the long window's law holds, wherever the stripe lies.
    wide = np.arange(-100, 101) - shift
    known = stripe_sigmas(
        wide[None, :],
        np.array([A]),
        np.array([w]),
        np.full((1, 201), noise**2),
        prior_sigma=(np.inf, np.inf, np.inf, np.inf, 1e-9),
    )
    assert known[0, POSITION] == pytest.approx(white_position_sigma_px(A, w, noise), rel=1e-3)
    assert white_position_sigma_px(A, w, noise) == pytest.approx(math.sqrt(1.1284 * w) * noise / A, rel=1e-4)


def test_shot_noise_of_the_stripe_alone_is_its_width_over_the_root_of_its_charge() -> None:
    x = np.arange(-30, 31) + 0.0
    A, w = 900.0, 4.0
    variance = line(x, A, 0.0, w, 1e-6, 0.0)
    sigma = stripe_sigmas(
        x[None],
        np.array([A]),
        np.array([w]),
        variance[None],
        prior_sigma=(np.inf, np.inf, np.inf, 1e-9, 1e-9),
    )
    charge = A * w * math.sqrt(2 * math.pi)
    assert sigma[0, POSITION] == pytest.approx(w / math.sqrt(charge), rel=1e-6)
    # With the width unknown the amplitude's variance is 3/2 of that of a Poisson count.
    assert sigma[0, AMPLITUDE] == pytest.approx(A * math.sqrt(1.5 / charge), rel=1e-6)


@pytest.mark.slow
def test_maximum_likelihood_reaches_the_bound() -> None:
    rng = np.random.default_rng(11)
    x = np.arange(-22, 23) + 0.0
    truth = np.array([800.0, 0.37, 4.5, 2500.0, 60.0])
    mean = line(x, *truth)
    variance = mean + 45.0**2 + 80.0**2 / 12
    bound = stripe_sigmas((x - truth[1])[None], truth[:1], truth[2:3], variance[None])[0]
    fits = np.array(
        [
            curve_fit(line, x, rng.normal(mean, np.sqrt(variance)), truth, sigma=np.sqrt(variance))[0]
            for _ in range(3000)
        ]
    )
    # 3000 draws know a standard deviation to 1.3 %; the width's bound is felt to be curved.
    np.testing.assert_allclose(fits.std(axis=0), bound, rtol=0.06)
    assert fits[:, 1].std() == pytest.approx(bound[POSITION], rel=0.04)
    assert abs(fits[:, 1].mean() - truth[1]) < 3.5 * bound[POSITION] / math.sqrt(3000)


def test_fewer_nodes_and_priors() -> None:
    w, A = np.array([5.0, 2.0]), np.array([500.0, 300.0])
    t = np.linspace(-4, 4, 33)
    nodes = stripe_sigmas(t * w[:, None], A, w, np.full((2, 33), 900.0), spacing_px=w / 4)
    for i in range(2):
        assert nodes[i, POSITION] == pytest.approx(
            white_position_sigma_px(A[i], w[i], 30.0, 4.125 * w[i]), rel=2e-3
        )
    held = stripe_sigmas(
        t * w[:, None],
        A,
        w,
        np.full((2, 33), 900.0),
        w / 4,
        prior_sigma=(np.inf, np.inf, 0.01, np.inf, np.inf),
    )
    assert (held[:, 2] < 0.01).all()
    assert (held < nodes + 1e-12).all()


def test_no_stripe_is_no_number() -> None:
    sigmas = stripe_sigmas(
        np.tile(np.arange(-9.0, 10.0), (3, 1)),
        np.array([0.0, np.nan, 5.0]),
        np.array([1.0, 1.0, np.inf]),
        np.ones((3, 19)),
    )
    assert np.isnan(sigmas).all()


def test_speckle_in_the_image_is_speckle_in_depth() -> None:
    wavelength, N, f, distance = 690e-6, 8.0, 16.2, 145.0
    m = f / (distance - f)
    # Paraxial: the aperture's half angle as the point sees it.
    sin_u_obs = f / (2 * N) / distance
    for theta in (10.0, 24.0, 60.0):
        image = speckle_image_sigma_mm(wavelength, N * (1 + m), 0.7)
        depth = speckle_depth_sigma_mm(wavelength, sin_u_obs, theta, 0.7)
        assert image / (m * math.sin(math.radians(theta))) == pytest.approx(depth, rel=1e-12)
    # The abstract's limit: a coherent sensor knows distance to about lambda over the aperture squared.
    assert speckle_depth_sigma_mm(1.0, 0.1, 90.0) == pytest.approx(10.0 / (2 * math.pi))


@pytest.mark.slow
def test_a_speckled_spot_wanders_by_the_floor() -> None:
    # Rough spots behind a slit, summed phasor by phasor. The centroid of one that is a speckle wide wanders
    # by the floor; of a wide one by sqrt(s w / (4 sqrt(pi))), s the width of a speckle, and so by more.
    rng = np.random.default_rng(3)
    wavelength, sin_u = 1.0, 0.05
    floor = speckle_image_sigma_mm(wavelength, 1 / (2 * sin_u))
    speckle = wavelength / (2 * sin_u)
    # Ten samples a speckle.
    x = np.linspace(-60, 60, 121)
    for width, expected in ((0.717 * speckle, floor), (1.4 * speckle, 1.4 * floor)):
        centres = []
        for _ in range(1500):
            scatterers = rng.normal(0.0, width, 60)
            phase = 2 * np.pi * rng.random(60)
            field = np.sinc((x[:, None] - scatterers) / speckle) @ np.array([np.cos(phase), np.sin(phase)]).T
            image = np.sum(field**2, axis=1)
            centres.append(image @ x / image.sum())
        assert np.std(centres) == pytest.approx(expected, rel=0.06)


def test_pixels_average_speckle() -> None:
    assert pixel_contrast(690e-6, 8.0, 1e-6) == pytest.approx(1.0, abs=1e-6)
    s = 690e-6 * 8.0
    assert pixel_contrast(690e-6, 8.0, 10 * s) == pytest.approx(math.sqrt(0.1), rel=0.06)
    x = np.linspace(0, 1, 20001)
    brute = math.sqrt(2 * np.trapezoid((1 - x) * np.sinc(x * 1.34) ** 2, x))
    assert pixel_contrast(690e-6, 8.0, 1.34 * s) == pytest.approx(brute, rel=1e-6)


def test_a_groove_is_placed_as_by_least_squares() -> None:
    # Bevels and plates of a groove under an upright sheet: only z moves with the stripe's centre.
    rng = np.random.default_rng(5)
    y = np.linspace(-8, 8, 321)
    depth, half = 4.0, 2.3
    slope = np.where(np.abs(y) < half, np.sign(y) * depth / half, 0.0)
    normals = np.column_stack([np.zeros_like(y), -slope, np.ones_like(y)])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    moves = np.tile([0.0, 0.0, 0.16], (len(y), 1))
    sigma = rng.uniform(0.1, 0.4, len(y))
    covariance = seam_covariance_mm2(normals, moves, sigma)
    # z_i = -slope dy + dz + noise.
    design = np.column_stack([-slope, np.ones_like(y)])
    draws = design @ [0.03, -0.02] + 0.16 * sigma * rng.standard_normal((20000, len(y)))
    weighted = design / (0.16 * sigma[:, None])
    found = np.linalg.lstsq(weighted, (draws / (0.16 * sigma)).T, rcond=None)[0]
    np.testing.assert_allclose(np.cov(found), covariance, rtol=0.05, atol=0.03 * covariance[1, 1])
    np.testing.assert_allclose(found.mean(axis=1), [0.03, -0.02], atol=1e-4)
    np.testing.assert_allclose(seam_covariance_mm2(normals, moves, sigma, 4.0), covariance / 4.0, rtol=1e-12)


def test_a_flat_plate_says_nothing_of_the_side_but_an_edge_does() -> None:
    normals, moves = np.tile([0.0, 0.0, 1.0], (9, 1)), np.tile([0.0, 0.02, 0.1], (9, 1))
    sigma = np.full(9, 0.3)
    sigma[0] = np.nan
    assert np.isnan(seam_covariance_mm2(normals, moves, sigma)).all()
    covariance = seam_covariance_mm2(normals, moves, sigma, edge_sigma_mm=sampled_edge_sigma_mm(0.07))
    np.testing.assert_allclose(covariance, np.diag([0.07**2 / 12, 0.3**2 * 0.1**2 / 8]), rtol=1e-12)
    assert np.isnan(seam_covariance_mm2(normals, moves, np.full(9, np.nan), edge_sigma_mm=0.02)).all()
