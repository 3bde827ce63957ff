import dataclasses
import math

import numpy as np
import pytest
import scenes
from hypothesis import given
from hypothesis import strategies as st

from noise_model.surface.brdf import (
    MILD_STEEL,
    TABLE_1,
    ZN_COATED,
    Lobe,
    Material,
    alpha_squared,
    geometrical_attenuation,
    reflectance,
)
from validation.figures.mirror import SUS304, Mirror, mirror_direction, spike_radiance

NORMAL = np.array([0.0, 0.0, 1.0])


def direction(theta_deg, azimuth_deg=0.0):
    theta, azimuth = np.radians(theta_deg), np.radians(azimuth_deg)
    return np.stack(
        np.broadcast_arrays(np.sin(theta) * np.cos(azimuth), np.sin(theta) * np.sin(azimuth), np.cos(theta)),
        axis=-1,
    )


def f_r(material, omega_i, omega_r):
    return reflectance(omega_i, omega_r, NORMAL, material.kappa_diff, material.kappa_spec, material.c2)


def upper_directions(count, seed):
    rng = np.random.default_rng(seed)
    return direction(rng.uniform(0.0, 85.0, count), rng.uniform(0.0, 360.0, count))


@pytest.mark.parametrize("material", TABLE_1.values(), ids=TABLE_1)
def test_reflectance_is_the_printed_formula(material):
    # Written out in angles, as a second reading of Eq. 7.
    theta_i, theta_r = math.radians(40.0), math.radians(55.0)
    alpha = 0.5 * (theta_r - theta_i)
    expected = material.kappa_diff + material.kappa_spec / math.cos(theta_r) * math.exp(
        -material.c2 * alpha**2
    )
    assert f_r(material, direction(40.0, 180.0), direction(55.0)) == pytest.approx(expected, rel=1e-12)


def shaped(lobe, omega_i, omega_r, normal=NORMAL):
    return reflectance(omega_i, omega_r, normal, 0.1, 0.3, 40.0, lobe)


def test_a_short_tail_is_the_gaussian_and_a_long_one_falls_as_a_power():
    omega_i, omega_r = upper_directions(200, 1), upper_directions(200, 2)
    np.testing.assert_allclose(
        shaped(Lobe(tail=1e-8), omega_i, omega_r), shaped(Lobe(), omega_i, omega_r), rtol=1e-5
    )
    # nu = 1 is Cauchy's 1 / (1 + c2 alpha^2); at 20 degrees off the mirror alpha is 10 degrees.
    lobe = shaped(Lobe(tail=1.0), direction(30.0, 180.0), direction(50.0)) - 0.1
    expected = 0.3 / math.cos(math.radians(50.0)) / (1.0 + 40.0 * math.radians(10.0) ** 2)
    assert lobe == pytest.approx(expected, rel=1e-12)


def test_marks_narrow_the_lobe_along_them_and_widen_it_across():
    lobe = Lobe(anisotropy=0.6, marks_deg=90.0)
    # The half vector of a pair in the plane of azimuth psi leans by 8 degrees in that plane.
    for azimuth, factor in ((90.0, math.exp(0.6)), (0.0, math.exp(-0.6)), (45.0, math.cosh(0.6))):
        value = shaped(lobe, direction(20.0, azimuth + 180.0), direction(36.0, azimuth)) - 0.1
        expected = 0.3 / math.cos(math.radians(36.0)) * math.exp(-40.0 * factor * math.radians(8.0) ** 2)
        assert value == pytest.approx(expected, rel=1e-9)


def test_marks_go_with_a_tilted_face():
    # A turn of everything but the marks about the marks' own axis changes nothing.
    turn = np.array([[1.0, 0.0, 0.0], [0.0, 0.8, -0.6], [0.0, 0.6, 0.8]])
    omega_i, omega_r = upper_directions(100, 3), upper_directions(100, 4)
    lobe = Lobe(tail=0.5, anisotropy=0.8)
    np.testing.assert_allclose(
        shaped(lobe, omega_i @ turn.T, omega_r @ turn.T, turn @ NORMAL),
        shaped(lobe, omega_i, omega_r),
        rtol=1e-9,
    )


@pytest.mark.parametrize("wrong", [{"tail": -0.1}, {"tail": math.inf}, {"anisotropy": math.nan}])
def test_a_lobe_that_cannot_be_is_refused(wrong):
    with pytest.raises(ValueError, match="lobe"):
        Lobe(**wrong)


def test_mirror_direction_has_the_highest_exponent():
    omega_i = direction(50.0, 180.0)
    assert f_r(Material("lobe", 0.0, 1.0, 80.0), omega_i, direction(50.0)) == pytest.approx(
        1.0 / math.cos(math.radians(50.0))
    )


def test_nothing_comes_from_or_goes_below_the_surface():
    assert f_r(ZN_COATED, direction(95.0), direction(10.0)) == 0.0
    assert f_r(ZN_COATED, direction(10.0), direction(95.0)) == 0.0
    assert f_r(ZN_COATED, NORMAL, -NORMAL) == 0.0


def test_attenuation_is_symmetric_between_0_and_1_and_falls_at_grazing():
    omega_i, omega_r = upper_directions(2000, 1), upper_directions(2000, 2)
    G = geometrical_attenuation(omega_i, omega_r, NORMAL)
    np.testing.assert_allclose(G, geometrical_attenuation(omega_r, omega_i, NORMAL), atol=1e-14)
    assert ((G >= 0.0) & (G <= 1.0)).all()
    assert geometrical_attenuation(direction(60.0, 180.0), direction(89.0), NORMAL) < 0.2


@pytest.mark.parametrize("material", TABLE_1.values(), ids=TABLE_1)
def test_reciprocity_is_broken_by_the_cosine_of_incidence_and_by_nothing_else(material):
    lobe_only = dataclasses.replace(material, kappa_diff=0.0)
    omega_i, omega_r = upper_directions(2000, 3), upper_directions(2000, 4)
    there, back = f_r(lobe_only, omega_i, omega_r), f_r(lobe_only, omega_r, omega_i)
    np.testing.assert_allclose(there / omega_i[:, 2], back / omega_r[:, 2], rtol=1e-9, atol=1e-300)
    assert np.abs(there / back - 1.0).max() > 1.0


@pytest.mark.parametrize(
    ("material", "theta_i_deg", "peak_deg"), [(MILD_STEEL, 60.0, 61.9), (ZN_COATED, 30.0, 42.7)]
)
def test_the_off_specular_peak_comes_from_the_cosine_not_from_the_attenuation(
    material, theta_i_deg, peak_deg
):
    omega_i = direction(theta_i_deg, 180.0)
    theta_r = np.arange(0.0, 85.0, 0.01)
    curve = f_r(material, omega_i, direction(theta_r))
    peak = theta_r[np.argmax(curve)]
    assert peak == pytest.approx(peak_deg, abs=0.05)
    assert geometrical_attenuation(omega_i, direction(peak), NORMAL) == pytest.approx(1.0)
    # Where G = 1, d/d theta_r of exp(-c2 (theta_r - theta_i)^2 / 4) / cos(theta_r) vanishes there.
    assert 0.5 * material.c2 * math.radians(peak - theta_i_deg) == pytest.approx(
        math.tan(math.radians(peak)), rel=0.01
    )
    flattened = (curve - material.kappa_diff) * np.cos(np.radians(theta_r))
    assert theta_r[np.argmax(flattened)] == pytest.approx(theta_i_deg, abs=0.02)


def albedo(material, theta_i_deg):
    x, w = np.polynomial.legendre.leggauss(200)
    cos_r, weight_r = 0.5 * (x + 1.0), 0.5 * w
    azimuth, weight_azimuth = np.pi * (x + 1.0), np.pi * w
    theta_deg, azimuth_deg = np.meshgrid(np.degrees(np.arccos(cos_r)), np.degrees(azimuth), indexing="ij")
    values = f_r(material, direction(theta_i_deg, 180.0), direction(theta_deg, azimuth_deg))
    return float(np.einsum("ij,i,j->", values, weight_r * cos_r, weight_azimuth))


def test_a_lambertian_surface_reflects_pi_kappa():
    assert albedo(Material("white", 1.0 / np.pi, 0.0, 1.0), 40.0) == pytest.approx(1.0, rel=1e-9)


def test_steel_reflects_less_than_it_gets_and_zn_as_printed_is_only_relative():
    assert all(albedo(MILD_STEEL, theta_i) < 0.11 for theta_i in (0.0, 30.0, 60.0))
    assert albedo(ZN_COATED, 0.0) == pytest.approx(1.76, abs=0.01)


@pytest.mark.slow
@pytest.mark.parametrize("c2", [0.5, 8.331, 112.0, 2000.0])
@pytest.mark.parametrize(
    "lobe", [Lobe(), Lobe(tail=0.6), Lobe(tail=4.0), Lobe(0.0, 0.8), Lobe(0.6, -3.0, 20.0)]
)
def test_the_albedo_in_the_units_of_the_kappas_is_that_of_light_that_falls_straight(c2, lobe):
    """Against f_r cos(theta_r) summed over the upper half, with the lobe as the tests write it out."""
    metal = Material("metal", 0.02, 0.3, c2, lobe)
    theta = (np.arange(1500) + 0.5) / 1500 * np.pi / 2.0
    azimuth_deg = (np.arange(360) + 0.5) / 2.0
    total = 0.0
    for t in theta:
        half = direction(np.degrees(0.5 * t), azimuth_deg)
        lobe_fall = scenes.fall(np.full(len(half), 0.5 * t), half, NORMAL, metal).mean()
        f_r_cos = metal.kappa_diff * np.cos(t) + metal.kappa_spec * min(1.0, 2.0 * np.cos(t)) * lobe_fall
        total += 2.0 * np.pi * f_r_cos * np.sin(t) * np.pi / 2.0 / len(theta)
    assert metal.relative_albedo == pytest.approx(total, rel=2e-5)


def test_the_lobe_reflects_a_share_that_grows_as_it_widens():
    shares = [albedo(Material("lobe", 0.0, 0.1, c2), 20.0) for c2 in (100.0, 30.0, 10.0)]
    # d omega_r = 4 cos(beta) d omega_h: a narrow lobe holds 4 pi kappa_spec cos(theta_i) / c2.
    assert shares[0] == pytest.approx(4.0 * np.pi * 0.1 * math.cos(math.radians(20.0)) / 100.0, rel=0.02)
    assert shares == sorted(shares)


@given(st.floats(0.0, 1.0))
def test_alpha_squared_is_the_arccosine_squared(cos_alpha):
    assert alpha_squared(cos_alpha) == pytest.approx(math.acos(cos_alpha) ** 2, rel=1e-6, abs=1e-15)


def test_alpha_squared_over_its_whole_range():
    cosines = np.linspace(-1.0, 1.0, 20001)
    np.testing.assert_allclose(
        [alpha_squared(value) for value in cosines], np.arccos(cosines) ** 2, rtol=1e-6, atol=1e-15
    )
    assert alpha_squared(1.0 + 1e-12) == 0.0
    assert alpha_squared(-1.0 - 1e-12) == pytest.approx(math.pi**2)


def test_mirror_direction_is_the_law_of_reflection():
    np.testing.assert_allclose(
        mirror_direction(direction(35.0, 20.0), NORMAL), direction(35.0, 200.0), atol=1e-15
    )


def test_a_mirror_keeps_the_radiance_times_rho():
    def sky(omega_i):
        return 3.0 + omega_i[..., 0]

    omega_r = upper_directions(50, 5)
    seen = spike_radiance(Mirror("half", 0.5), omega_r, NORMAL, sky)
    np.testing.assert_allclose(seen, 0.5 * sky(omega_r * [-1.0, -1.0, 1.0]))
    assert spike_radiance(SUS304, direction(100.0), NORMAL, sky) == 0.0


def test_a_mirror_is_the_limit_of_a_narrow_reciprocal_lobe():
    # The lobe over cos(theta_i), of unit area over the half vectors, reflects a uniform sky of radiance 1 as
    # rho does, and so does the spike; without 1 / cos(theta_i) half of it would be missing at 60 deg.
    c2 = 4000.0
    narrow = Material("narrow", 0.0, c2 / (4.0 * np.pi), c2)
    offset, weight = np.polynomial.legendre.leggauss(120)
    theta = np.radians(60.0) + 0.2 * offset
    azimuth = np.pi + 0.25 * offset
    angles = np.meshgrid(np.degrees(theta), np.degrees(azimuth), indexing="ij")
    omega_i = direction(*angles)
    values = f_r(narrow, omega_i, np.broadcast_to(direction(60.0), omega_i.shape)) / omega_i[..., 2]
    reflected = np.einsum("ij,i,j->", values * omega_i[..., 2], 0.2 * weight * np.sin(theta), 0.25 * weight)
    assert reflected == pytest.approx(1.0, rel=0.01)


@pytest.mark.parametrize(
    ("change", "key"),
    [
        ({"c2": 0.0}, "c2"),
        ({"c2": -1.0}, "c2"),
        ({"c2": math.nan}, "c2"),
        ({"kappa_diff": -0.1}, "kappa_diff"),
        ({"kappa_spec": math.nan}, "kappa_spec"),
        ({"kappa_diff": 0.0, "kappa_spec": 0.0}, "reflects nothing"),
    ],
)
def test_an_impossible_material_is_refused(change, key):
    with pytest.raises(ValueError, match=key):
        dataclasses.replace(MILD_STEEL, **change)


@pytest.mark.parametrize("rho", [0.0, -0.5, 1.1, math.nan])
def test_an_impossible_mirror_is_refused(rho):
    with pytest.raises(ValueError, match="rho"):
        Mirror("bad", rho)


@pytest.mark.parametrize("tail", [1e-17, 1e-12, 1e-8, 1e-5])
def test_a_thin_tail_is_hardly_more_than_none(tail):
    omega_i, omega_r = np.array([0.5, 0.0, np.sqrt(0.75)]), NORMAL
    numbers = MILD_STEEL.kappa_diff, MILD_STEEL.kappa_spec, MILD_STEEL.c2
    plain = reflectance(omega_i, omega_r, NORMAL, *numbers)
    tailed = reflectance(omega_i, omega_r, NORMAL, *numbers, lobe=Lobe(tail=tail))
    assert tailed == pytest.approx(plain, rel=1e-2 * tail / 1e-5 + 1e-12)
