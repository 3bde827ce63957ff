"""Further forms of the hidden effects: each shows where its effect does, and otherwise than other forms."""

import dataclasses
import math

import numpy as np
import pytest
from worlds import ARC, BOTH, DARK, LASER, charge_of, moment_of, overfull_world, studio_of

from validation.second_renderer.world import (
    FORMS,
    FURTHER,
    apply_moment_effects,
    apply_world_effects,
    form_of,
    read_out,
)
from validation.second_renderer.world_effect import HiddenEffect
from validation.second_renderer.world_further_source import two_cavity
from validation.second_renderer.world_rays import ArcBody

pytestmark = pytest.mark.usefixtures("mitsuba")

TIMES_S = (0.3, 1.7)

IN_DARK = ("ambient_light", "black_level", "read_noise", "image_compression")
"""Effects that show where laser and arc are off."""


@pytest.fixture(scope="module")
def world():
    return overfull_world()


@pytest.fixture(scope="module")
def plain(world):
    studio = studio_of(world)
    return [frame_of(world, (), levels, studio=studio) for levels in (BOTH, DARK)]


def hidden(effect, form, world, strength=1.0, seed=4):
    values = form_of(HiddenEffect(effect, form)).draw(np.random.default_rng(seed), strength, world.setup)
    return (HiddenEffect(effect, form, values),)


def frame_of(world, acting, levels=BOTH, time_s=1.1, studio=None):
    """A frame's codes; equal arguments draw equal noise."""
    studio = studio_of(apply_world_effects(world, acting)) if studio is None else studio
    charge = charge_of(world, acting, levels=levels, time_s=time_s, studio=studio)
    moment = apply_moment_effects(moment_of(levels, time_s), acting)
    return read_out(studio.world, acting, moment, charge, np.random.default_rng(6)).astype(float)


def test_each_effect_has_one_further_form_that_is_new():
    assert set(FURTHER) == set(FORMS)
    for effect, form in FURTHER.items():
        assert form.name not in FORMS[effect]
        assert form_of(HiddenEffect(effect, form.name)) is form
        assert form.equation not in {other.equation for other in FORMS[effect].values()}


@pytest.mark.parametrize("effect", FURTHER)
def test_a_further_form_shows_otherwise_and_repeats(effect, world, plain):
    acting = hidden(effect, FURTHER[effect].name, world)
    frame, again = (frame_of(world, acting) for _ in range(2))
    np.testing.assert_array_equal(frame, again)
    assert np.mean(frame != plain[0]) > 0.002
    for other in FORMS[effect]:
        assert np.mean(frame != frame_of(world, hidden(effect, other, world))) > 0.002, other
    dark = frame_of(world, acting, DARK)
    # A bent response bends the noise about zero too.
    assert (np.mean(dark != plain[1]) > 0.002) == (effect in IN_DARK or effect == "gamma")


@pytest.mark.parametrize("effect", FURTHER)
def test_a_further_form_is_stronger_at_full_strength(effect, world):
    form = FURTHER[effect]
    weak, strong = (form.draw(np.random.default_rng(3), strength, world.setup) for strength in (0.0, 1.0))
    assert weak.keys() == strong.keys()
    assert weak != strong
    assert all(isinstance(value, float) and math.isfinite(value) for value in (weak | strong).values())


@pytest.mark.parametrize(
    "effect", ["arc_deflection", "arc_length", "exposure_drift", "hand_eye", "pose_delay"]
)
def test_what_drifts_differs_from_moment_to_moment(effect, world):
    acting = hidden(effect, FURTHER[effect].name, world)
    first, later = (apply_moment_effects(moment_of(BOTH, time_s), acting) for time_s in TIMES_S)
    before, after = (moment_of(BOTH, time_s) for time_s in TIMES_S)

    def changes(moment, plain):
        return {key: np.subtract(value, getattr(plain, key)).tolist() for key, value in vars(moment).items()}

    assert changes(first, before) != changes(later, after)


def test_a_spheroid_as_high_as_wide_is_the_sphere(world):
    studio = studio_of(world)
    sight = studio.sight(np.eye(4))
    body = studio.arc_body(sight, (0.0, 0.0, 0.0))
    sphere = studio.arc_light(sight, body)
    nearly = studio.arc_light(sight, ArcBody(body.center_mm, body.radius_mm, 1.0 + 1e-6))
    np.testing.assert_allclose(nearly, sphere, rtol=1e-4, atol=1e-3 * sphere.max())
    flat = studio.arc_light(sight, ArcBody(body.center_mm, body.radius_mm, 0.2))
    assert flat.sum() < 0.7 * sphere.sum()


def test_a_moved_camera_sees_what_one_mounted_so_sees(world):
    studio = studio_of(world)
    acting = (
        HiddenEffect(
            "hand_eye",
            "catalogue",
            {f"rot_{a}_deg": 0.3 for a in "xyz"} | {f"move_{a}_mm": 0.2 for a in "xyz"},
        ),
    )
    mounted = studio_of(apply_world_effects(world, acting)).sight(np.eye(4))
    moved = studio.sight(np.eye(4), (0.3, 0.3, 0.3), (0.2, 0.2, 0.2))
    np.testing.assert_allclose(moved.points, mounted.points, atol=1e-9)


def test_the_laser_keeps_its_power_on_another_metal(world):
    studio = studio_of(world)
    sight = studio.sight(np.eye(4))
    metal = world.setup.material
    brighter = studio.of_metal(
        dataclasses.replace(metal, kappa_diff=2.0 * metal.kappa_diff, kappa_spec=2.0 * metal.kappa_spec)
    )
    np.testing.assert_allclose(brighter.stripe(sight), 2.0 * studio.stripe(sight), rtol=1e-5)
    assert studio.world is world


def test_filled_wells_keep_the_charge(world):
    well = world.setup.sensor.full_well_e
    charge = np.full((40, 30), 100.0)
    charge[20, 7] = 4.5 * well
    filled = FURTHER["blooming"].charge(charge, world, {"spill": 0.8})
    assert filled.sum() - charge.sum() == pytest.approx(0.8 * 3.5 * well)
    assert not np.delete(filled - charge, 7, axis=1).any()
    # 1.4 wells to either side fill one neighbour, and a part of the next.
    np.testing.assert_allclose(filled[[19, 21], 7], well)
    np.testing.assert_allclose(filled[[18, 22], 7], 100.0 + 0.4 * well + 100.0, rtol=0.01)


def test_closed_forms(world):
    lossy = (HiddenEffect("vignetting", "cats_eye", {"loss": 0.4}),)
    bright, dimmed = (charge_of(world, acting, levels=ARC) for acting in ((), lossy))
    assert dimmed[0, 0] == pytest.approx(0.6 * bright[0, 0], rel=0.02)
    noisy = (HiddenEffect("read_noise", "rows", {"noise_ratio": 3.0}),)
    frame = read_out(world, noisy, moment_of(), np.full((900, 900), 2000.0), np.random.default_rng(2))
    assert frame.var() == pytest.approx((2000.0 + 9.0 * 45.0**2) / 80.0**2 + 1.0 / 12.0, rel=0.03)
    rows = frame.mean(axis=1).var()
    assert rows == pytest.approx(0.3 * 8.0 * 45.0**2 / 80.0**2, rel=0.15)
    half = world.setup.stated_filter.center_nm + 0.5 * world.setup.stated_filter.fwhm_nm
    assert float(two_cavity(world.setup.stated_filter, np.array(half))) == pytest.approx(0.5)
    speckled = (
        HiddenEffect("laser_speckle", "integrated", {"contrast": 0.3, "along_px": 1.5, "across_px": 0.5}),
    )
    even, grained = (charge_of(world, acting, levels=LASER) for acting in ((), speckled))
    lit = even > 0.1 * even.max()
    ratio = grained[lit] / even[lit]
    assert ratio.mean() == pytest.approx(1.0, abs=0.05)
    assert ratio.std() == pytest.approx(0.3, rel=0.15)
    assert ratio.min() > 0.0
