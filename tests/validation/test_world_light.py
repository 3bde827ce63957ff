"""The independent renderer against closed forms, and against the forward model on nominal scenes."""

import dataclasses
import math

import cv2
import numpy as np
import pytest
from sheet_twin import irradiance
from worlds import ARC, BOTH, charge_of, pose, setup_of, studio_of, world_of

from noise_model.condition import Condition
from noise_model.forward import predict
from noise_model.interreflection.model import bounced_light as modelled_bounces
from noise_model.surface.brdf import Lobe, Material, reflectance
from noise_model.surface.joint import BentSeam, SeamLine
from noise_model.view import View
from validation.second_renderer.agreement import BLOCK_PX
from validation.second_renderer.blocks import compare_blocks
from validation.second_renderer.world_bounce import STEP_PX, Bounces, bounced_light
from validation.second_renderer.world_light import TrueWorld, WorldLens
from validation.second_renderer.world_metal import STATED_LOBE, LobeShape
from validation.second_renderer.world_optics import point_spread
from validation.second_renderer.world_surface import Departure

pytestmark = pytest.mark.usefixtures("mitsuba")


def test_a_small_far_arc_lights_a_plate_as_a_point_does():
    setup = setup_of("flat", width=64)
    arc = dataclasses.replace(
        setup.arc, radius_mm=0.3, center_in_tool_mm=(0.0, 0.0, 25.0), on_surface=False, radiance_e=1.0e8
    )
    lambert = Material("lambert", 0.3, 0.0, 1.0)
    world = TrueWorld(dataclasses.replace(setup, arc=arc, material=lambert), np.eye(4))
    studio = studio_of(world)
    sight = studio.sight(np.eye(4))
    shown = studio.arc_light(sight, studio.arc_body(sight, (0.0, 0.0, 0.0))).ravel()
    np.testing.assert_allclose(sight.points[:, 2], 0.0, atol=1e-9)
    way = np.array([0.0, 0.0, 25.0]) - sight.points
    r = np.linalg.norm(way, axis=1)
    # The half ball's apparent area from below: half a disc less half of the base's ellipse.
    area = 0.5 * math.pi * 0.3**2 * (1.0 - 25.0 / r)
    want = 1.0e8 * 0.3 * area * (25.0 / r) / r**2 * sight.cos4
    # A pixel sees the few points of the lattice that face down the least.
    np.testing.assert_allclose(shown, want, rtol=0.08)
    assert np.mean(shown / want) == pytest.approx(1.0, abs=0.005)


def test_the_stripe_peaks_as_stated_on_the_reference_plate():
    studio = studio_of(world_of("flat", width=640))
    stripe = studio.stripe(studio.sight(np.eye(4)))
    middle = stripe[:, 319:321].mean(axis=1)
    assert middle.max() == pytest.approx(studio.world.setup.laser.peak_e, rel=0.005)


def test_the_sheet_falls_off_as_a_gaussian_and_with_depth():
    studio = studio_of(world_of("flat"))
    points = np.array([[35.0, 0.0, 0.0], [35.45, 0.0, 0.0], [35.0, 0.0, -140.0], [35.0, 140.0, 0.0]])
    up = np.broadcast_to([0.0, 0.0, 1.0], points.shape)
    got = studio.sheet(points, up, np.eye(4))
    # Twice as deep it is a quarter; 45 degrees aside cos(theta_i) / cos(psi) is 1.
    np.testing.assert_allclose(got, [1.0, math.exp(-0.5), 0.25, 1.0], rtol=1e-12)


def test_a_fan_ends_where_the_forward_model_ends_it():
    setup = setup_of("v_groove", "zn_coated", width=160)
    leaning = np.array([0.95, 0.1, -math.sqrt(1.0 - 0.95**2 - 0.1**2)])
    laser = dataclasses.replace(
        setup.laser,
        plane_in_tool=(*leaning.tolist(), -float(leaning @ setup.laser.origin_mm)),
        fan_half_angle_deg=6.0,
    )
    studio = studio_of(TrueWorld(dataclasses.replace(setup, laser=laser), np.eye(4)))
    rng = np.random.default_rng(3)
    points = laser.origin_mm + rng.uniform(-30.0, 30.0, (500, 3)) - [0.0, 0.0, 120.0]
    # Onto the sheet.
    points -= np.outer((points - laser.origin_mm) @ leaning, leaning)
    up = np.broadcast_to([0.0, 0.0, 1.0], points.shape)
    lit, modelled = studio.sheet(points, up, np.eye(4)), irradiance(points, up, laser)
    assert 100 < np.count_nonzero(lit) < 400
    np.testing.assert_allclose(lit, modelled, rtol=1e-9)


def test_the_point_spread_keeps_light_and_has_its_width():
    image = np.zeros((41, 51))
    image[20, 25] = 1000.0
    spread = point_spread(image, 0.7)
    v, u = np.mgrid[:41, :51]
    assert spread.sum() == pytest.approx(1000.0)
    assert np.sum(spread * (u - 25) ** 2) / 1000.0 == pytest.approx(0.49, rel=0.01)
    assert np.sum(spread * (v - 20) ** 2) / 1000.0 == pytest.approx(0.49, rel=0.01)


@pytest.mark.parametrize("material", ["mild_steel", "zn_coated"])
@pytest.mark.parametrize("joint", ["v_groove", "lap", "corrugation"])
def test_it_agrees_with_the_forward_model_on_nominal_scenes(joint, material):
    """Each judges the other: blocks away from shadow edges within 3 %, their median within 1 %."""
    setup = setup_of(joint, material, width=320)
    T_base_tool = pose((6.0, 1.2, 1.5), (2.0, -3.0, 4.0))
    for levels in (ARC, BOTH):
        made = charge_of(TrueWorld(setup, np.eye(4)), levels=levels, T_base_tool=T_base_tool)
        condition = Condition(laser_level=levels[0], arc_level=levels[1], exposure_s=0.005)
        predicted = predict(setup, T_base_tool, condition).mean_e.astype(np.float64)
        agreement = compare_blocks(made, predicted, np.zeros_like(predicted))
        assert agreement.n_blocks > 0.8 * (240 // BLOCK_PX) * (320 // BLOCK_PX)
        assert agreement.median_ratio == pytest.approx(1.0, abs=0.01)
        assert agreement.within >= 0.98, agreement


@pytest.mark.parametrize("joint", ["lap", "corrugation"])
def test_it_agrees_with_the_forward_model_where_the_seam_rises(joint):
    """Ridges lean with their sheet: upright ones would be off by 5 % on their flanks."""
    setup, rise = setup_of(joint, "zn_coated", width=320), 0.01
    T_base_tool = pose((6.0, 0.8, 1.5), (1.0, -1.0, 1.0))
    world = TrueWorld(setup, np.eye(4), Departure(z_slope=rise))
    made = charge_of(world, levels=ARC, T_base_tool=T_base_tool)

    def line_at(station_mm):
        return SeamLine(station_mm, z_mm=rise * station_mm, slope_z=rise)

    seam = BentSeam.along(line_at, (20.0, 60.0), 6.0, setup.joint.has_ridges)
    condition = Condition(laser_level=0.0, arc_level=1.0, exposure_s=0.005)
    predicted = predict(setup, T_base_tool, condition, seam=seam).mean_e.astype(np.float64)
    # The level is a nuisance: the model's arc stands upright on its sheet, the other one in the joint frame.
    predicted *= made.sum() / predicted.sum()
    agreement = compare_blocks(made, predicted, np.zeros_like(predicted))
    assert agreement.within >= 0.98, agreement


def test_a_pixels_sum_over_the_arc_has_converged():
    studio = studio_of(world_of("corrugation"))
    sight = studio.sight(pose())
    arc = studio.arc_body(sight, (0.0, 0.0, 0.0))
    seen = sight.points, sight.normals, -sight.directions, np.arange(len(sight.faces)) % 16, arc, 8.331
    assert (sight.faces >= 0).all()
    coarse, fine = (studio.caster.arc_light(*seen, STATED_LOBE, n)[0] for n in (160, 2000))
    lit = fine > 0.1 * fine.max()
    assert np.std(coarse[lit] / fine[lit]) < 0.015
    assert np.median(coarse[lit] / fine[lit]) == pytest.approx(1.0, abs=0.001)


def unit(vectors):
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


@pytest.fixture(scope="module")
def directions():
    draw = np.random.default_rng(3)
    normal = unit(np.array([0.0, 0.0, 1.0]) + 0.3 * draw.standard_normal((200, 3)))
    return normal, *(unit(normal + 0.5 * draw.standard_normal((200, 3))) for _ in range(2))


@pytest.mark.parametrize(
    ("shape", "modelled"),
    [
        (STATED_LOBE, Lobe()),
        (LobeShape(tail=0.7), Lobe(tail=0.7)),
        (LobeShape("ward", 0.6, 25.0, tail=0.7), Lobe(tail=0.7, anisotropy=0.6, marks_deg=25.0)),
        (LobeShape("ward", 0.6, 25.0), Lobe(anisotropy=0.6, marks_deg=25.0)),
        (LobeShape("two_lobes", 0.0, 2.0), Lobe()),
        (LobeShape("ggx", 0.0), Lobe()),
    ],
)
def test_lobes_of_the_catalogues_form_are_the_models(directions, shape, modelled):
    normal, omega_i, omega_r = directions
    got = studio_of(world_of("flat", width=16)).caster.lobe(normal, omega_i, omega_r, 12.0, shape)
    want = reflectance(omega_i, omega_r, normal, 0.0, 1.0, 12.0, modelled)
    np.testing.assert_allclose(got, want, rtol=2e-4, atol=1e-6)


@pytest.mark.parametrize(
    "shape", [LobeShape("two_lobes", 0.3, 2.0), LobeShape("ggx", 0.8), LobeShape("slopes", 0.6, 25.0)]
)
def test_other_lobes_are_as_their_docstring_says(directions, shape):
    normal, omega_i, omega_r = directions
    caster = studio_of(world_of("flat", width=16)).caster
    stated = caster.lobe(normal, omega_i, omega_r, 12.0, STATED_LOBE)
    half = unit(omega_i + omega_r)
    cos = np.sum(half * normal, axis=1)
    X, tan2 = 12.0 * np.arccos(cos) ** 2, 1.0 / cos**2 - 1.0
    if shape.kind == "two_lobes":
        fall = 0.7 * np.exp(-X) + 0.3 * np.exp(-X / 4.0)
    elif shape.kind == "ggx":
        fall = 0.2 * np.exp(-X) + 0.8 / (1.0 + 6.0 * tan2) ** 2
    else:
        marks = np.array([math.cos(math.radians(25.0)), math.sin(math.radians(25.0)), 0.0])
        marks = unit(marks - np.sum(marks * normal, axis=1, keepdims=True) * normal)
        p2 = (np.sum(half * marks, axis=1) / cos) ** 2
        fall = np.exp(-12.0 * (math.exp(0.6) * p2 + math.exp(-0.6) * (tan2 - p2)))
    seen = stated > 1e-4
    assert seen.sum() > 50
    np.testing.assert_allclose(
        caster.lobe(normal, omega_i, omega_r, 12.0, shape)[seen],
        (stated / np.exp(-X) * fall)[seen],
        rtol=2e-3,
    )


def test_a_lens_sends_rays_where_its_form_says():
    camera = setup_of().camera
    u, v = np.meshgrid([0.0, 40.0, 159.0], [0.0, 60.0, 119.0])
    uv = np.column_stack([u.ravel(), v.ravel()])
    xy = WorldLens("brown", -0.5, 2.0).rays(camera, uv)
    rays = np.column_stack([xy, np.ones(len(xy))])
    back, _ = cv2.projectPoints(
        rays, np.zeros(3), np.zeros(3), camera.matrix, np.array([-0.5, 2.0, 0.0, 0.0])
    )
    np.testing.assert_allclose(back[:, 0], uv, atol=1e-6)
    bent = WorldLens("division", 0.4).rays(camera, uv)
    straight = WorldLens().rays(camera, uv)
    r2 = np.sum(straight**2, axis=1, keepdims=True)
    np.testing.assert_allclose(bent * (1.0 + 0.4 * r2), straight, rtol=1e-12)


@pytest.mark.parametrize("joint", ["v_groove", "corrugation"])
def test_bounced_light_is_about_the_models_and_grows_with_the_albedo(joint):
    gathered = np.s_[STEP_PX // 2 :: STEP_PX, STEP_PX // 2 :: STEP_PX]
    setup = setup_of(joint, width=400)
    world = TrueWorld(setup, np.eye(4))
    studio = studio_of(world)
    sight = studio.sight(pose())
    body = studio.arc_body(sight, (0.0, 0.0, 0.0))
    arc, laser = bounced_light(studio, sight, body, Bounces(0.35))
    modelled = modelled_bounces(View.of(setup, pose())).arc_e(0.35)
    # Between them an image as small as this is too coarse.
    bright = modelled[gathered] > 0.15 * modelled.max()
    assert bright.sum() > 20
    assert np.median((arc[gathered] / np.maximum(modelled[gathered], 1.0))[bright]) == pytest.approx(
        1.0, abs=0.1
    )
    once, _ = bounced_light(studio, sight, body, Bounces(0.2, most=1))
    twice_as_bright, _ = bounced_light(studio, sight, body, Bounces(0.4, most=1))
    np.testing.assert_allclose(twice_as_bright, 2.0 * once, rtol=1e-5)
    if joint == "v_groove":
        outside = sight.faces.reshape(sight.shape) == 0
        assert arc[outside].max() == 0.0
    assert laser.max() > 0.0
