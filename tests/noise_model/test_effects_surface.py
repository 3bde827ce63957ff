"""Surface and medium against formulas written out here."""

import dataclasses
import itertools
import math

import cv2
import numpy as np
import pytest
import scenes
from effect_scenes import (
    CONDITIONS,
    EXPOSURE_S,
    affected,
    charge,
    cos4,
    light_of,
    nominal,
    on_the_plate,
    passed,
)
from scipy.integrate import quad

from noise_model.condition import Condition
from noise_model.effects.medium import airlight_integral, gathered_depth_mm, streak_moments
from noise_model.forward import predict
from noise_model.instrument.spectrum import planck
from noise_model.stripe import stripe_reference
from noise_model.surface.brdf import Lobe, Material
from noise_model.transforms import invert, transform

ARC, LASER = CONDITIONS["arc"], CONDITIONS["laser"]


@pytest.mark.parametrize(
    ("effect", "values", "changes", "lobe"),
    [
        (
            "wrong_material",
            {"kappa_diff_ln": 1.5, "kappa_spec_ln": -0.7},
            (math.exp(1.5), math.exp(-0.7), 1.0),
            {},
        ),
        ("roughness_change", {"c2_ln": -0.9}, (1.0, 1.0, math.exp(-0.9)), {}),
        ("brdf_tail", {"tail": 0.6}, (1.0, 1.0, 1.0), {"tail": 0.6}),
        (
            "rolling_marks",
            {"anisotropy": 0.8, "marks_deg": 30.0},
            (1.0, 1.0, 1.0),
            {"anisotropy": 0.8, "marks_deg": 30.0},
        ),
    ],
)
@pytest.mark.parametrize("joint", ["flat", "lap"])
def test_the_arc_on_another_surface_node_by_node(effect, values, changes, lobe, joint):
    """The reflectance and the sum over the arc are written out in `scenes`."""
    stated = Material("glossy", 0.03, 0.3, 12.0)
    setup = nominal(joint, stated, psf_sigma_px=0.0)
    kappa_diff, kappa_spec, c2 = changes
    material = Material(
        "", stated.kappa_diff * kappa_diff, stated.kappa_spec * kappa_spec, stated.c2 * c2, Lobe(**lobe)
    )
    got = charge(affected(setup, **{effect: values}), ARC)
    before = charge(setup, ARC)
    camera = setup.camera
    eye = camera.T_tool_camera[:3, 3]
    center = np.array([0.0, 0.0, scenes.ARC_HEIGHT_MM.get(joint, 0.0)])
    changed = 0
    for row, column in ((5, 10), (20, 60), (30, 40), (45, 15), (55, 70)):
        ray = np.array([(column - camera.cx) / camera.fx, (row - camera.cy) / camera.fy, 1.0])
        d = camera.T_tool_camera[:3, :3] @ ray
        P = eye + scenes.march(setup.joint, eye, d) * d
        normal = scenes.normal_at(setup.joint, P)
        light = scenes.arc_light(setup.joint, P, normal, -d / np.linalg.norm(d), center, 3.0, material)
        wanted = setup.arc.radiance_e * light / float(ray @ ray) ** 2
        assert got[row, column] == pytest.approx(wanted, rel=5e-3)
        changed += abs(wanted / before[row, column] - 1.0) > 0.02
    assert changed >= 2


def test_the_stripe_keeps_its_stated_peak_on_another_metal():
    setup = nominal("flat", psf_sigma_px=0.0, width=321, height=241)
    stated = charge(setup, LASER)[:, 160].max()
    # The peak lies between two pixels.
    assert stated == pytest.approx(5000.0, rel=0.01)
    for effects in ({"wrong_material": {"kappa_diff_ln": 1.5}}, {"roughness_change": {"c2_ln": 1.0}}):
        assert charge(affected(setup, **effects), LASER)[:, 160].max() == pytest.approx(stated, rel=2e-3)
    assert stripe_reference(setup) > 0.0


@pytest.mark.parametrize("share", [0.0, 0.5, 1.0])
def test_a_peak_that_was_stated_for_another_metal_goes_with_its_reflectance(share):
    """Twice the kappas send on twice as much."""
    setup = nominal("flat", psf_sigma_px=0.0)
    twice = {"kappa_diff_ln": math.log(2.0), "kappa_spec_ln": math.log(2.0), "stripe_share": share}
    brighter = charge(affected(setup, wrong_material=twice), LASER)
    np.testing.assert_allclose(brighter, 2.0**share * charge(setup, LASER), rtol=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("material", ["mild_steel", "zn_coated"])
def test_light_bounces_with_the_albedo_whatever_the_units_of_the_kappas(material):
    """Ten times the kappas and a tenth of the radiance are the same metal under the same arc."""
    setup = nominal("v_groove", material, width=40, height=30)
    metal = setup.material
    tenfold = dataclasses.replace(metal, kappa_diff=10 * metal.kappa_diff, kappa_spec=10 * metal.kappa_spec)
    arc = dataclasses.replace(setup.arc, radiance_e=0.1 * setup.arc.radiance_e)
    bounced = [
        charge(affected(one, interreflection={"albedo": 0.6}), ARC) - charge(one, ARC)
        for one in (setup, dataclasses.replace(setup, material=tenfold, arc=arc))
    ]
    assert bounced[0].max() > 0.01 * charge(setup, ARC).max()
    np.testing.assert_allclose(bounced[1], bounced[0], rtol=1e-3, atol=1e-3 * bounced[0].max())


def test_the_airlight_integral_is_that_of_quadrature():
    rng = np.random.default_rng(6)
    origin, source = np.array([95.0, 0.0, 130.0]), np.array([0.0, 1.0, 2.0])
    directions = rng.normal(size=(20, 3)) + np.array([-1.0, 0.0, -2.0])
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    length = rng.uniform(20.0, 200.0, 20)
    got = airlight_integral(origin, directions, length, source, 3.0)
    for i in range(20):
        D = np.linalg.norm(np.cross(directions[i], source - origin))
        assert D > 3.0

        def falls(t, d=directions[i]):
            return 1.0 / float(np.sum((origin + t * d - source) ** 2))

        nearest = float(np.clip((source - origin) @ directions[i], 0.0, length[i]))
        wanted = sum(quad(falls, *ends)[0] for ends in ((0.0, nearest), (nearest, length[i])))
        assert got[i] == pytest.approx(wanted, rel=1e-8)
    # Through the source itself it stays finite.
    straight = (source - origin) / np.linalg.norm(source - origin)
    assert airlight_integral(origin, straight, np.array(200.0), source, 3.0) < math.pi / 3.0


@pytest.mark.parametrize("gathered_per_mm", [0.0, 1e-5, 0.02, 0.2])
def test_the_depth_of_gathered_fume_is_that_of_quadrature(gathered_per_mm):
    rng = np.random.default_rng(7)
    origin, source = np.array([95.0, 0.0, 130.0]), np.array([0.0, 1.0, 2.0])
    directions = rng.normal(size=(10, 3)) + np.array([-1.0, 0.0, -2.0])
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    length = rng.uniform(20.0, 200.0, 10)
    got = gathered_depth_mm(origin, directions, length, source, gathered_per_mm)
    for i in range(10):

        def thins(t, d=directions[i]):
            return 1.0 / (1.0 + gathered_per_mm**2 * float(np.sum((origin + t * d - source) ** 2)))

        assert got[i] == pytest.approx(quad(thins, 0.0, length[i], limit=200)[0], rel=1e-6)


def test_a_ray_through_the_arc_gathers_no_negative_light():
    """Within the source's radius neither part of the airlight falls off any more."""
    setup = nominal("flat", psf_sigma_px=0.0)
    eye = np.array([-20.0, 0.0, 135.0])
    camera = scenes.camera((tuple(eye), (0.0, 0.0, 1.0)), width=80, height=60, psf_sigma_px=0.0)
    values = {"extinction_per_m": 2.0, "scatter": 0.5, "gathered_per_mm": 0.3}
    setup = dataclasses.replace(setup, camera=camera, arc=dataclasses.replace(setup.arc, radius_mm=6.0))
    got = passed(affected(setup, fume=values), light_of(np.zeros((60, 80))), ARC).arc
    assert got.min() > 0.0
    points, omega_r = on_the_plate(camera)
    P, d = points[30, 40], -omega_r[30, 40]
    nearest = float(-eye @ d)
    assert np.linalg.norm(eye + nearest * d) < 6.0

    def scatters(t):
        # The ray's closest distance is held at the arc's radius.
        square = 36.0 + (t - nearest) ** 2
        return 1.0 / (square * (1.0 + 0.3**2 * square))

    length = float(np.linalg.norm(P - eye))
    A_eff = 0.5 * math.pi * 36.0 * (1.0 + eye[2] / np.linalg.norm(eye))
    wanted = 0.5 * 0.002 * A_eff / (4.0 * math.pi) * quad(scatters, 0.0, length, points=[nearest])[0]
    assert got[30, 40] == pytest.approx(setup.arc.radiance_e * cos4(camera)[30, 40] * wanted, rel=1e-3)


def test_the_fume_dims_by_beer_and_lambert():
    setup = nominal("flat", psf_sigma_px=0.0)
    points, _ = on_the_plate(setup.camera)
    d = np.linalg.norm(points - setup.camera.T_tool_camera[:3, 3], axis=-1)
    in_fume = affected(setup, fume={"extinction_per_m": 3.0, "scatter": 0.5})
    ratio = charge(in_fume, LASER) / np.maximum(charge(setup, LASER), 1e-9)
    lit = charge(setup, LASER) > 10.0
    np.testing.assert_allclose(ratio[lit], np.exp(-0.003 * d)[lit], rtol=1e-4)


@pytest.mark.parametrize("gathered_per_mm", [0.0, 0.03])
def test_the_fume_scatters_the_arcs_light(gathered_per_mm):
    """In proportion to its output, by the definition of albedo, and nothing of it in the laser's frames."""
    setup = nominal("flat", psf_sigma_px=0.0)
    beta, albedo = 0.002, 0.7
    values = {"extinction_per_m": 1000.0 * beta, "scatter": albedo, "gathered_per_mm": gathered_per_mm}
    in_fume = affected(setup, fume=values)
    got, before = charge(in_fume, ARC), charge(setup, ARC)
    points, omega_r = on_the_plate(setup.camera)
    eye = setup.camera.T_tool_camera[:3, 3]
    tau_p = math.acos(eye[2] / np.linalg.norm(eye))
    A_eff = math.pi * 9.0 / 2.0 * (1.0 + math.cos(tau_p))
    for row, column in ((3, 5), (30, 40), (50, 70)):
        P, d = points[row, column], -omega_r[row, column]
        length = float(np.linalg.norm(P - eye))

        def extinction(t, d=d):
            return beta / (1.0 + gathered_per_mm**2 * float(np.sum((eye + t * d) ** 2)))

        def scatters(t, d=d):
            return extinction(t, d) * A_eff / float(np.sum((eye + t * d) ** 2))

        scattered = albedo / (4.0 * math.pi) * quad(scatters, 0.0, length)[0]
        wanted = before[row, column] * math.exp(-quad(extinction, 0.0, length)[0])
        wanted += setup.arc.radiance_e * cos4(setup.camera)[row, column] * scattered
        assert got[row, column] == pytest.approx(wanted, rel=1e-4)
    half = Condition(0.0, 0.5, EXPOSURE_S)
    np.testing.assert_allclose(charge(in_fume, half), 0.5 * got, rtol=1e-5)


@pytest.mark.parametrize(("length", "width"), [(40.0, 2.0), (0.1, 3.0), (5.0, 5.0)])
def test_a_streaks_moments_are_sums_over_it(length, width):
    x = np.arange(-60.0, 60.0, 0.25)
    along = [
        0.5
        * (
            math.erf((t + length / 2) / width / math.sqrt(2))
            - math.erf((t - length / 2) / width / math.sqrt(2))
        )
        for t in x
    ]
    streak = np.multiply.outer(along, np.exp(-0.5 * (x / width) ** 2))
    first, second = streak_moments(length, width)
    assert first == pytest.approx(streak.sum() / 16.0, rel=1e-4)
    assert second == pytest.approx((streak**2).sum() / 16.0, rel=1e-4)


@pytest.mark.slow
@pytest.mark.parametrize("psf_sigma_px", [0.0, 2.0])
def test_many_frames_of_spatter_have_campbells_mean_and_variance(psf_sigma_px):
    """In the middle and at each side of the image, behind lens, vignetting and exposure."""
    values = {"rate_per_frame": 20.0, "peak_e": 1000.0, "length_px": 16.0, "width_px": 1.5}
    setup = affected(nominal("flat", psf_sigma_px=psf_sigma_px), spatter=values, vignetting={"loss": 0.5})
    dark, long = np.zeros((60, 80)), Condition(0.0, 1.0, 2.0 * EXPOSURE_S)
    expected = passed(setup, light_of(dark), long)
    rng = np.random.default_rng(4)
    n = 400
    drawn = np.array([passed(setup, light_of(dark), long, rng).other for _ in range(n)], dtype=np.float64)
    v, u = np.mgrid[:60, :80]
    everywhere, middle = np.ones((60, 80), dtype=bool), (abs(u - 39.5) < 30.0) & (abs(v - 29.5) < 20.0)
    sides = (u < 5, u >= 75, v < 5, v >= 55)
    for where, within in ((everywhere, 0.07), (middle, 0.1), *((side, 0.16) for side in sides)):
        for power, wanted in ((1, expected.other), (2, expected.variance_e2 + expected.other**2)):
            frames = np.mean(drawn[:, where] ** power / wanted[where], axis=1)
            error = frames.std() / math.sqrt(n)
            assert 4.0 * error < (within if power == 1 else 3.0 * within)
            assert frames.mean() == pytest.approx(1.0, abs=4.0 * error)


def test_spatter_is_the_arcs():
    setup = affected(nominal(), spatter={"rate_per_frame": 20.0})
    for name in ("dark", "laser"):
        np.testing.assert_array_equal(
            predict(setup, scenes.pose(), CONDITIONS[name]).variance_dn2,
            predict(nominal(), scenes.pose(), CONDITIONS[name]).variance_dn2,
        )


@pytest.mark.slow
def test_spatter_streaks_point_away_from_the_arc_and_grow_with_the_exposure():
    setup = nominal("flat", psf_sigma_px=0.0)
    streaks = {"rate_per_frame": 0.3, "speed_mm_per_ms": 0.8, "width_px": 0.6}
    arc_camera = transform(invert(setup.camera.T_tool_camera), np.array(setup.arc.center_in_tool_mm))
    arc_px, px_per_mm = setup.camera.project(arc_camera[np.newaxis])[0], setup.camera.fx / arc_camera[2]
    v, u = np.mgrid[:60, :80]
    middles = []
    for exposure_s, seed in itertools.product((EXPOSURE_S, 2.0 * EXPOSURE_S), range(60)):
        condition, rng = Condition(0.0, 1.0, exposure_s), np.random.default_rng(seed)
        light = passed(affected(setup, spatter_streaks=streaks), light_of(np.zeros((60, 80))), condition, rng)
        weight = light.other.astype(np.float64)
        edge = np.concatenate([weight[[0, -1]].ravel(), weight[:, [0, -1]].ravel()])
        # One streak that lies within the image.
        if (
            weight.sum() < 1.0
            or edge.max() > 1e-3 * weight.max()
            or cv2.connectedComponents((weight > 0.05 * weight.max()).astype(np.uint8))[0] != 2
        ):
            continue
        middle = np.array([np.average(u, weights=weight), np.average(v, weights=weight)])
        size, axes = np.linalg.eigh(np.cov(np.stack([u.ravel(), v.ravel()]), aweights=weight.ravel()))
        away = (middle - arc_px) / np.linalg.norm(middle - arc_px)
        assert abs(axes[:, 1] @ away) > 0.999
        flown_px = px_per_mm * 0.8 * 1e3 * exposure_s
        assert math.sqrt(12.0 * (size[1] - 0.6**2)) == pytest.approx(flown_px, rel=0.05)
        middles.append(middle)
    assert len(middles) > 5


def test_glare_runs_along_the_seam_from_the_arc():
    setup = nominal("flat", psf_sigma_px=0.0)
    glare = {"peak_e": 20_000.0, "width_mm": 2.0, "length_mm": 15.0}
    got = charge(affected(setup, groove_glare=glare), ARC) - charge(setup, ARC)
    points, _ = on_the_plate(setup.camera)
    x, y = points[..., 0], points[..., 1]
    expected = 20_000.0 * np.exp(-np.abs(x) / 15.0 - 0.5 * (y / 2.0) ** 2) * cos4(setup.camera)
    np.testing.assert_allclose(got, expected, rtol=1e-3, atol=0.5)


def test_a_stripes_ghost_is_where_the_law_of_reflection_puts_it():
    """The stripe on a V-groove's left face, as the right one shows it, and no light where no face mirrors."""
    setup = nominal("v_groove", width=160, height=120, psf_sigma_px=0.0)
    camera, x_mm, depth_mm = setup.camera, setup.laser.point_mm[0], setup.joint.dimensions["depth_mm"]
    half = math.radians(0.5 * setup.joint.dimensions["included_angle_deg"])
    root_mm = 0.5 * setup.joint.dimensions["root_gap_mm"]
    plain = charge(setup, LASER)
    full, part = (
        charge(affected(setup, mirrored_stripe={"strength": share}), LASER) - plain for share in (1.0, 0.5)
    )
    np.testing.assert_allclose(part, 0.5 * full, rtol=1e-3, atol=0.05)
    # The right face is that at y < 0; its normal points to the left and up.
    corner, normal = np.array([0.0, -root_mm, -depth_mm]), np.array([0.0, math.cos(half), math.sin(half)])
    shown = 0
    for height_mm in np.linspace(0.2, depth_mm - 0.2, 12):
        left = np.array([x_mm, root_mm + height_mm * math.tan(half), height_mm - depth_mm])
        image = left - 2.0 * ((left - corner) @ normal) * normal
        eye = camera.T_tool_camera[:3, 3]
        met = eye + ((corner - eye) @ normal) / ((image - eye) @ normal) * (image - eye)
        if -depth_mm + 0.2 < met[2] < -0.2:
            u, v = camera.project(transform(invert(camera.T_tool_camera), image)[np.newaxis])[0]
            assert full[round(v), round(u)] > 0.1 * plain.max()
            shown += 1
    assert shown > 2
    level = nominal("flat", psf_sigma_px=0.0)
    mirrors = affected(level, mirrored_stripe={"strength": 1.0})
    np.testing.assert_array_equal(charge(mirrors, LASER), charge(level, LASER))


def test_hot_metal_glows_as_planck_says():
    """1/T grows evenly along the plate, on a tilted plate too."""
    tilt = {"roll_deg": 10.0, "pitch_deg": -5.0}
    for effects in ({}, {"surface_tilt": tilt}):
        setup = nominal("flat", psf_sigma_px=0.0)
        glowing = affected(setup, hot_metal_glow={"peak_e": 60000.0, "length_mm": 8.0}, **effects)
        glow = charge(glowing, ARC) - charge(affected(setup, **effects), ARC)
        normal = scenes.pose(turn_deg=(10.0, -5.0, 0.0))[:3, 2] if effects else np.array([0.0, 0.0, 1.0])
        eye = setup.camera.T_tool_camera[:3, 3]
        _, omega_r = on_the_plate(setup.camera)
        points = eye - ((eye @ normal) / (omega_r @ normal))[..., np.newaxis] * omega_r
        # The arc's centre is the foot of the tool's origin on the plate, which is that origin.
        rho = np.linalg.norm(points, axis=-1)
        for row, column in np.ndindex(8, 8):
            at = 7 * row + 3, 10 * column + 4
            T = 1.0 / (1.0 / 1800.0 + rho[at] / 8.0 * 690.0 / 1.438777e7)
            wanted = 60000.0 * cos4(setup.camera)[at] * planck(690.0, T) / planck(690.0, 1800.0)
            assert glow[at] == pytest.approx(wanted, rel=1e-3, abs=0.02)
        assert glow.min() < 0.5 * glow.max()


def test_the_glow_knows_no_current_and_no_laser():
    setup = nominal()
    glowing = affected(setup, hot_metal_glow={"peak_e": 30000.0, "length_mm": 15.0})
    glow = [
        charge(glowing, Condition(1.0, level, EXPOSURE_S)) - charge(setup, Condition(1.0, level, EXPOSURE_S))
        for level in (0.3, 1.0)
    ]
    np.testing.assert_allclose(glow[0], glow[1], atol=0.01)
    assert glow[0].max() > 1000.0
    # It may go on while the arc is off.
    for share in (0.0, 0.4):
        lasting = affected(setup, hot_metal_glow={"peak_e": 3e4, "length_mm": 15.0, "arc_off_share": share})
        np.testing.assert_allclose(charge(lasting, LASER) - charge(setup, LASER), share * glow[1], atol=0.01)


def test_an_arc_blown_aside_heats_where_it_stands():
    glow = {"peak_e": 30000.0, "length_mm": 15.0}
    setup = nominal("flat", psf_sigma_px=0.0)
    blown = affected(setup, hot_metal_glow=glow, arc_deflection={"x_mm": 8.0})
    moved = dataclasses.replace(setup, arc=dataclasses.replace(setup.arc, center_in_tool_mm=(8.0, 0.0, 0.0)))
    np.testing.assert_array_equal(charge(blown, ARC), charge(affected(moved, hot_metal_glow=glow), ARC))
