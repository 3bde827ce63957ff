import dataclasses

import numpy as np
import pytest

from noise_model.arc_source import Arc, level
from noise_model.surface.brdf import MILD_STEEL, TABLE_1, ZN_COATED, Material, reflectance
from validation.figures.hemisphere import (
    Hemisphere,
    PointSource,
    apparent_area,
    irradiance_extended,
    irradiance_point,
    is_seen,
    point_source,
    point_source_criterion,
    point_source_distance,
    point_source_error,
    reflected_radiance_extended,
    reflected_radiance_point,
)
from validation.figures.mirror import SUS304, Mirror

UP = np.array([0.0, 0.0, 1.0])
R = 2.0
ARC = Hemisphere(np.zeros(3), R, UP)
LAMBERT = Material("lambert", 1.0, 0.0, 1.0)


def unit(vectors):
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def at(H, tau_deg, azimuth_deg=0.0):
    """Points at a = H R, tau_deg from up."""
    tau, azimuth = np.radians(tau_deg), np.radians(azimuth_deg)
    direction = np.array([np.sin(tau) * np.cos(azimuth), np.sin(tau) * np.sin(azimuth), np.cos(tau)])
    return R * np.atleast_1d(H)[:, np.newaxis] * direction


def random_patches(count, seed, nearest=1.3):
    """Patches around the arc that look anywhere, and directions above each one's surface."""
    rng = np.random.default_rng(seed)
    a = R * np.exp(rng.uniform(np.log(nearest), np.log(20.0), count))
    points = a[:, np.newaxis] * unit(rng.normal(size=(count, 3)))
    normals = unit(rng.normal(size=(count, 3)))
    return points, normals, unit(normals + 0.8 * unit(rng.normal(size=(count, 3))))


def full_sphere(H, cos_theta):
    """E / L of a sphere at H = a / R, its centre at theta from the normal, cut by the horizon or not."""
    root, sin_theta = np.sqrt(H**2 - 1.0), np.sqrt(1.0 - cos_theta**2)
    cut = np.abs(cos_theta) < 1.0 / H
    sine = np.where(cut, root / (H * np.where(cut, sin_theta, 1.0)), 0.0)
    cosine = np.where(cut, -root * cos_theta / np.where(cut, sin_theta, 1.0), 0.0)
    beyond = np.sqrt(np.where(cut, 1.0 - (H * cos_theta) ** 2, 0.0))
    E_cut = (
        np.pi / 2.0
        - np.arcsin(np.clip(sine, -1.0, 1.0))
        + (cos_theta * np.arccos(np.clip(cosine, -1.0, 1.0)) - root * beyond) / H**2
    )
    return np.where(cut, E_cut, np.pi * np.maximum(cos_theta, 0.0) / H**2)


def brute_force(point, normal, omega_r, material, delta_limit=np.pi):
    """The integral on a plain grid of the upper half, every node tested for visibility."""
    tau = (np.arange(200) + 0.5) * (np.pi / 2.0) / 200
    delta = -delta_limit + (np.arange(400) + 0.5) * 2.0 * delta_limit / 400
    towards = unit(point - (point @ UP) * UP)
    tau, delta = (grid.ravel() for grid in np.meshgrid(tau, delta, indexing="ij"))
    level_axes = np.cos(delta)[:, np.newaxis] * towards + np.sin(delta)[:, np.newaxis] * np.cross(UP, towards)
    n_s = np.sin(tau)[:, np.newaxis] * level_axes + np.cos(tau)[:, np.newaxis] * UP
    r = np.linalg.norm(R * n_s - point, axis=1)
    omega_i = (R * n_s - point) / r[:, np.newaxis]
    cos_phi, cos_theta_i = -np.sum(omega_i * n_s, axis=1), omega_i @ normal
    dA = R**2 * np.sin(tau) * (np.pi / 2.0 / 200) * (2.0 * delta_limit / 400)
    kernel = np.where((cos_phi > 0) & (cos_theta_i > 0), cos_phi * cos_theta_i / r**2, 0.0)
    f_r = reflectance(
        omega_i,
        np.broadcast_to(omega_r, omega_i.shape),
        np.broadcast_to(normal, omega_i.shape),
        material.kappa_diff,
        material.kappa_spec,
        material.c2,
    )
    return float(np.sum(f_r * kernel * dA))


H_RANGE = np.array([1.2, 1.5, 2.0, 3.0, 5.0, 10.0, 30.0, 100.0])


def test_a_plate_through_the_centre():
    E = irradiance_extended(at(H_RANGE, 90.0, 25.0), np.tile(UP, (len(H_RANGE), 1)), ARC, radiance=7.0)
    root = np.sqrt(H_RANGE**2 - 1.0)
    np.testing.assert_allclose(E, 7.0 * (np.arctan(1.0 / root) - root / H_RANGE**2), rtol=3e-6)


def test_a_patch_that_faces_the_arc():
    points = at(H_RANGE, 90.0, -70.0)
    E = irradiance_extended(points, -unit(points), ARC)
    np.testing.assert_allclose(E, np.pi / (2.0 * H_RANGE**2), rtol=1e-9)


def test_a_patch_straight_above_sees_the_whole_disc():
    points = at(H_RANGE, 0.0)
    np.testing.assert_allclose(irradiance_extended(points, -unit(points), ARC), np.pi / H_RANGE**2, rtol=1e-9)


@pytest.mark.slow
def test_the_half_and_its_mirror_image_make_a_sphere():
    points, normals, _ = random_patches(400, seed=1)
    below = dataclasses.replace(ARC, up=-UP)
    E = irradiance_extended(points, normals, ARC, nodes=40) + irradiance_extended(
        points, normals, below, nodes=40
    )
    H = np.linalg.norm(points, axis=1) / R
    cos_theta = -np.sum(unit(points) * normals, axis=1)
    assert np.count_nonzero(np.abs(cos_theta) < 1.0 / H) > 50
    np.testing.assert_allclose(E * H**2, full_sphere(H, cos_theta) * H**2, atol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("material", [LAMBERT, *TABLE_1.values()], ids=lambda material: material.name)
def test_against_a_plain_grid(material):
    points, normals, omega_r = random_patches(25, seed=2)
    L_r = reflected_radiance_extended(points, normals, omega_r, ARC, material, nodes=32)
    brute = np.array([brute_force(*patch, material) for patch in zip(points, normals, omega_r, strict=True)])
    scale = np.pi * (R / np.linalg.norm(points, axis=1)) ** 2 * (material.kappa_diff + material.kappa_spec)
    assert np.count_nonzero(L_r > 1e-3 * scale) > 10
    np.testing.assert_allclose(L_r / scale, brute / scale, atol=2e-3)


@pytest.mark.slow
@pytest.mark.parametrize("material", TABLE_1.values(), ids=TABLE_1)
def test_more_nodes_change_little(material):
    points, normals, omega_r = random_patches(100, seed=3)
    coarse, fine = (
        reflected_radiance_extended(points, normals, omega_r, ARC, material, nodes=nodes)
        for nodes in (24, 64)
    )
    lit = fine > 1e-3 * fine.max()
    assert np.median(np.abs(coarse[lit] / fine[lit] - 1.0)) < 1e-8
    np.testing.assert_allclose(coarse[lit], fine[lit], rtol=5e-3)


def test_all_light_arrives():
    # A sphere round the arc catches what the half emits: pi L on 2 pi R^2.
    x, w = np.polynomial.legendre.leggauss(60)
    a = 3.0 * R
    points = a * np.column_stack([np.sqrt(1.0 - x**2), np.zeros_like(x), x])
    power = 2.0 * np.pi * a**2 * np.sum(w * irradiance_extended(points, -points / a, ARC))
    assert power == pytest.approx(2.0 * np.pi**2 * R**2, rel=1e-4)


def test_irradiance_is_what_a_white_lambertian_patch_reflects():
    points, normals, omega_r = random_patches(50, seed=4)
    E = irradiance_extended(points, normals, ARC)
    L_r = reflected_radiance_extended(points, normals, omega_r, ARC, LAMBERT)
    np.testing.assert_allclose(L_r, E, rtol=1e-12)


def test_scale_place_and_orientation_do_not_matter():
    points, normals, omega_r = random_patches(50, seed=5)
    turn, _ = np.linalg.qr(np.random.default_rng(6).normal(size=(3, 3)))
    turn *= np.linalg.det(turn)
    center = np.array([30.0, -20.0, 5.0])
    moved = Hemisphere(center, 3.0 * R, turn @ UP)
    args = (normals @ turn.T, omega_r @ turn.T)
    np.testing.assert_allclose(
        reflected_radiance_extended(center + 3.0 * points @ turn.T, *args, moved, ZN_COATED),
        reflected_radiance_extended(points, normals, omega_r, ARC, ZN_COATED),
        rtol=1e-4,
        atol=1e-7,
    )


def test_half_a_turn_of_delta_loses_light_above_the_base_only():
    level_patch, elevated = at(3.0, 90.0)[0], at(3.0, 30.0)[0]
    for point, low, high in ((level_patch, -1e-3, 1e-3), (elevated, 0.13, 0.16)):
        normal = -unit(point)
        all_of_it = brute_force(point, normal, normal, LAMBERT)
        printed = brute_force(point, normal, normal, LAMBERT, delta_limit=np.pi / 2.0)
        assert low < 1.0 - printed / all_of_it < high


def test_patches_that_see_nothing():
    points = np.concatenate([at(0.5, 40.0), at(5.0, 90.0), at(5.0, 180.0), np.zeros((1, 3))])
    normals = np.stack([UP, -UP, -UP, UP])
    # The second one's plane contains the base but for a rounding.
    np.testing.assert_allclose(irradiance_extended(points, normals, ARC), 0.0, atol=1e-30)
    L_r = reflected_radiance_extended(points, normals, normals, ARC, ZN_COATED)
    np.testing.assert_allclose(L_r, 0.0, atol=1e-30)
    assert irradiance_extended(np.empty((0, 3)), np.empty((0, 3)), ARC).shape == (0,)


def test_a_mirror_shows_the_arc_itself_at_any_distance():
    for H in (2.0, 20.0, 200.0):
        points = at(H, 90.0)
        omega_i = unit(np.array([[0.0, 0.0, 0.5 * R]]) - points)
        omega_r = omega_i * [-1.0, -1.0, 1.0]
        seen = reflected_radiance_extended(points, UP[np.newaxis], omega_r, ARC, Mirror("half", 0.5), 8.0)
        assert seen == pytest.approx(4.0)
        beside = unit(omega_r + 1.1 / H * np.array([0.0, 1.0, 0.0]))
        assert reflected_radiance_extended(points, UP[np.newaxis], beside, ARC, SUS304) == 0.0


@pytest.mark.slow
def test_a_mirror_shows_the_solid_angle_of_the_arc():
    # Directions over the hemisphere, weighted with cos(theta), must add up to the irradiance.
    x, w = np.polynomial.legendre.leggauss(400)
    sine2, azimuth = 0.5 * (x + 1.0), np.pi * x
    sines, azimuths = (grid.ravel() for grid in np.meshgrid(np.sqrt(sine2), azimuth, indexing="ij"))
    omega_r = np.column_stack([sines * np.cos(azimuths), sines * np.sin(azimuths), np.sqrt(1.0 - sines**2)])
    point = at(1.5, 70.0)
    shape = omega_r.shape
    L_r = reflected_radiance_extended(
        np.broadcast_to(point, shape), np.broadcast_to(UP, shape), omega_r, ARC, SUS304
    )
    E = np.sum(L_r * np.outer(0.25 * w, np.pi * w).ravel())
    tilted = irradiance_extended(point, UP[np.newaxis], ARC)[0]
    assert pytest.approx(tilted, rel=0.01) == E


def test_what_a_ray_meets():
    origin = np.array(
        [[10.0, 0.0, 0.5], [10.0, 0.0, -0.5], [10.0, 0.0, 0.5], [0.0, 0.0, 0.5], [10.0, 0.0, 3.0]]
    )
    along = np.array([[-1.0, 0, 0], [-1.0, 0, 0], [1.0, 0, 0], [-1.0, 0, 0], [-1.0, 0, 0]])
    assert is_seen(origin, along, ARC).tolist() == [True, False, False, False, False]


@pytest.mark.parametrize("tau_deg", [0.0, 40.0, 90.0, 110.0])
def test_apparent_area_is_the_irradiance_of_a_facing_patch_far_away(tau_deg):
    points = at(1e4, tau_deg)
    E = irradiance_extended(points, -unit(points), ARC, nodes=48)
    assert pytest.approx(apparent_area(points, ARC), rel=1e-3) == E * (1e4 * R) ** 2


@pytest.mark.parametrize("material", TABLE_1.values(), ids=TABLE_1)
def test_extended_and_point_agree_far_away_and_part_near(material):
    H = np.array([2.0, 3.0, 5.0, 10.0, 30.0, 100.0, 300.0])
    normals = np.tile(unit(np.array([-0.5, 0.2, 0.9])), (len(H), 1))
    omega_r = np.tile(unit(np.array([0.3, 0.1, 0.9])), (len(H), 1))
    error = np.abs(point_source_error(at(H, 90.0), normals, omega_r, ARC, material, nodes=48))
    assert error[0] > 0.03
    assert error[-1] < 3e-4
    assert (np.diff(error[H >= 10.0]) < 0.0).all()
    assert error[-1] / error[-2] == pytest.approx((100.0 / 300.0) ** 2, rel=0.1)


def test_a_plate_through_the_centre_needs_the_point_at_the_centroid():
    points, normals = at(300.0, 90.0), UP[np.newaxis]
    extended = irradiance_extended(points, normals, ARC)
    assert irradiance_point(points, normals, point_source(points, ARC)) == pytest.approx(extended, rel=1e-4)
    at_centre = PointSource(np.zeros(3), apparent_area(points, ARC))
    assert irradiance_point(points, normals, at_centre) == 0.0


def test_the_inverse_square_law_and_the_cosine():
    source = PointSource(np.array([0.0, 0.0, 10.0]), np.array(6.0))
    points = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, -10.0], [10.0, 0.0, 0.0], [0.0, 0.0, 20.0]])
    E = irradiance_point(points, np.tile(UP, (4, 1)), source)
    np.testing.assert_allclose(E, [0.06, 0.015, 0.06 / 2.0**1.5, 0.0])
    L_r = reflected_radiance_point(points, np.tile(UP, (4, 1)), np.tile(UP, (4, 1)), source, LAMBERT)
    np.testing.assert_allclose(L_r, E)


def test_the_criterion_on_a_plate():
    np.testing.assert_allclose(point_source_criterion(at(H_RANGE, 90.0), ARC), np.pi / (2.0 * H_RANGE**2))


def test_the_distance_from_which_the_point_source_is_good_enough():
    direction, normal, omega_r = at(1.0, 90.0)[0] / R, UP, unit(np.array([0.2, 0.0, 1.0]))
    distances = [
        point_source_distance(direction, normal, omega_r, ARC, ZN_COATED, tolerance)
        for tolerance in (0.1, 0.03, 0.01)
    ]
    assert distances == sorted(distances)
    beyond = np.geomspace(1.01, 100.0, 20) * distances[-1]
    fixed = np.tile(normal, (20, 1)), np.tile(omega_r, (20, 1))
    error = point_source_error(beyond[:, np.newaxis] * direction, *fixed, ARC, ZN_COATED)
    assert (np.abs(error) < 0.01).all()
    just_there = point_source_error(
        distances[-1] * direction[np.newaxis], normal[np.newaxis], omega_r[np.newaxis], ARC, ZN_COATED
    )
    assert np.abs(just_there) == pytest.approx(0.01, rel=0.02)


def mirror_geometry(H, theta_deg):
    """Patches level with the centre that see the arc's middle, and look back, at theta in one plane."""
    points = at(H, 90.0)
    towards = -unit(points)
    theta = np.radians(theta_deg)
    normals = np.cos(theta) * towards + np.sin(theta) * UP
    omega_r = 2.0 * np.sum(towards * normals, axis=1, keepdims=True) * normals - towards
    return points, normals, omega_r


def test_f_r_belongs_inside_the_integral():
    points, normals, omega_r = mirror_geometry(np.array([3.0, 10.0, 50.0]), 60.0)
    kappas = MILD_STEEL.kappa_diff, MILD_STEEL.kappa_spec, MILD_STEEL.c2
    outside = reflectance(-unit(points), omega_r, normals, *kappas) * irradiance_extended(
        points, normals, ARC
    )
    inside = reflected_radiance_extended(points, normals, omega_r, ARC, MILD_STEEL, nodes=48)
    np.testing.assert_allclose(outside / inside, [5.45, 1.35, 1.01], rtol=0.01)


def test_a_narrow_lobe_needs_the_extended_source_much_farther_out():
    points, normals, omega_r = mirror_geometry(np.array([1.0]), 60.0)
    in_the_lobe = point_source_distance(points[0] / R, normals[0], omega_r[0], ARC, MILD_STEEL, 0.1)
    on_a_plate = point_source_distance(
        points[0] / R, UP, unit(np.array([0.36, 0.0, 1.0])), ARC, MILD_STEEL, 0.1
    )
    assert in_the_lobe / R == pytest.approx(16.8, abs=0.2)
    assert on_a_plate / R == pytest.approx(2.36, abs=0.05)


@pytest.mark.slow
def test_a_distance_that_does_not_exist_is_refused():
    x, z = np.array([1.0, 0.0, 0.0]), UP
    with pytest.raises(ValueError, match="does not light"):
        point_source_distance(x, x, x, ARC, ZN_COATED, 0.01)
    with pytest.raises(ValueError, match="still"):
        point_source_distance(unit(x + z), -unit(x + z), -unit(x + z), ARC, MILD_STEEL, 1e-9)
    with pytest.raises(ValueError, match="tolerance"):
        point_source_distance(x, z, z, ARC, ZN_COATED, 0.0)


def test_facing_from_above_is_always_good_enough():
    assert point_source_distance(UP, -UP, -UP, ARC, LAMBERT, 1e-6) == pytest.approx(1.05 * R)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"radius_mm": 0.0}, "radius"),
        ({"radius_mm": -1.0}, "radius"),
        ({"radius_mm": np.nan}, "radius"),
        ({"up": np.array([0.0, 0.0, 2.0])}, "up"),
        ({"up": np.array([0.0, 0.0, np.nan])}, "up"),
        ({"center_mm": np.array([0.0, np.inf, 0.0])}, "centre"),
        ({"center_mm": np.zeros(2)}, "centre"),
    ],
)
def test_an_impossible_hemisphere_is_refused(change, message):
    with pytest.raises(ValueError, match=message):
        dataclasses.replace(ARC, **change)


def test_no_nodes_is_refused():
    with pytest.raises(ValueError, match="nodes"):
        irradiance_extended(at(2.0, 90.0), UP[np.newaxis], ARC, nodes=0)


STATED = Arc(2.0, (0.0, 0.0, 0.0), 3000.0, 120.0, 1.5)


@pytest.mark.parametrize(
    ("key", "value"),
    [(key, value) for key in ("radius_mm", "current_a") for value in (0.0, -1.0, np.nan)]
    + [("radiance_e", -1.0), ("radiance_e", np.nan)],
)
def test_an_impossible_arc_is_refused(key, value):
    with pytest.raises(ValueError, match=key):
        dataclasses.replace(STATED, **{key: value})


def test_an_arc_without_radiance_is_none():
    assert STATED.shines
    assert not dataclasses.replace(STATED, radiance_e=0.0).shines


def test_an_unknown_shape_is_refused():
    with pytest.raises(ValueError, match="shape"):
        dataclasses.replace(STATED, shape="cone")


def test_the_level_follows_the_current():
    assert level(STATED, 120.0) == 1.0
    assert level(STATED, 60.0) == pytest.approx(0.5**1.5)
    assert level(STATED, 0.0) == 0.0
