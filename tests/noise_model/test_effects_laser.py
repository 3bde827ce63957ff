"""Fan, profile, ghost and light of the hall, against formulas written out here."""

import dataclasses

import numpy as np
import pytest
import scenes
from effect_scenes import CONDITIONS, affected, charge, cos4, light_of, nominal, on_the_plate, passed

from noise_model.condition import Condition
from noise_model.effects import apply_setup_effects
from noise_model.effects.pattern import normal_field
from noise_model.forward import predict
from noise_model.setup import Setup

LASER = CONDITIONS["laser"]


def fan_angle_deg(setup: Setup) -> np.ndarray:
    """The angle (H, W) to the fan's axis of what a level camera sees of a plate; the sheet is upright."""
    points, _ = on_the_plate(setup.camera)
    origin = np.array(setup.laser.origin_in_tool_mm)
    return np.degrees(np.arctan2(points[..., 1] - origin[1], origin[2]))


def test_an_uneven_fan_has_its_slope_and_its_end():
    setup = nominal("flat", psf_sigma_px=0.0)
    angle, plain = fan_angle_deg(setup), charge(setup, LASER)
    lit = plain > 1.0
    got = charge(affected(setup, uneven_fan={"slope": 0.4, "curvature": -0.2}), LASER)
    expected = 1.0 + 0.4 * angle / 10.0 - 0.2 * (angle / 10.0) ** 2
    np.testing.assert_allclose(got[lit] / plain[lit], expected[lit], rtol=1e-4)
    ended = charge(affected(setup, uneven_fan={"half_angle_deg": 4.0}), LASER)
    assert lit[np.abs(angle) > 5.0].any()
    np.testing.assert_allclose(
        ended[lit & (np.abs(angle) < 3.0)], plain[lit & (np.abs(angle) < 3.0)], rtol=1e-5
    )
    assert (ended[np.abs(angle) > 5.0] < 1e-3).all()


def test_a_stripes_profile_is_the_stated_one_with_another_width_and_exponent():
    setup = nominal("flat", psf_sigma_px=0.0)
    points, _ = on_the_plate(setup.camera)
    t = (points[..., 0] - setup.laser.origin_in_tool_mm[0]) / setup.laser.stripe_sigma_mm
    plain = charge(setup, LASER)
    got = charge(affected(setup, stripe_profile={"width_ratio": 1.5, "exponent": 3.0}), LASER)
    near = np.abs(t) < 4.0
    expected = np.exp(0.5 * t**2 - 0.5 * np.abs(t / 1.5) ** 3)
    np.testing.assert_allclose(got[near], (plain * expected)[near], rtol=2e-3, atol=0.01)
    # Long tails are rendered as far as they shine.
    tails = affected(setup, stripe_profile={"exponent": 1.2})
    assert apply_setup_effects(tails).laser.reach_sigmas > 15.0
    assert charge(tails, LASER)[np.abs(t) > 7.0].max() > 10.0


def test_a_ghost_is_the_stripe_elsewhere():
    setup = nominal(psf_sigma_px=0.0)
    laser = np.random.default_rng(3).uniform(0.0, 1000.0, (60, 80))
    # Half the diagonal of 80 x 60 px is 50 px.
    ghost = {"strength": 1.5, "along": 0.08, "across": -0.2}
    arc = np.full((60, 80), 50.0)
    got = passed(affected(setup, ghost_stripe=ghost), light_of(arc, laser))
    expected = laser.copy()
    expected[:-10, 4:] += 1.5 * laser[10:, :-4]
    np.testing.assert_allclose(got.laser, expected, rtol=1e-3)
    np.testing.assert_array_equal(got.arc, arc.astype(np.float32))


def test_light_of_the_hall_shines_in_the_dark_and_goes_with_the_exposure():
    setup = affected(nominal("flat", psf_sigma_px=0.0), ambient_light={"level_e": 2000.0})
    dark = CONDITIONS["dark"]
    np.testing.assert_allclose(charge(setup, dark), 2000.0 * cos4(setup.camera), rtol=1e-4)
    twice = Condition(0.0, 0.0, 2.0 * dark.exposure_s)
    np.testing.assert_allclose(charge(setup, twice), 2.0 * charge(setup, dark), rtol=1e-5)


def test_a_groove_sees_less_of_the_hall_and_its_sides_tell_where_the_lamp_is():
    effect = {"level_e": 2000.0, "from_left": 0.5}
    groove = affected(nominal(psf_sigma_px=0.0), ambient_light=effect)
    lit = charge(groove, CONDITIONS["dark"]) / cos4(groove.camera) / 2000.0
    # Walls that rise by 55 deg: n_z = cos 55 deg, n_y = -+ sin 55 deg.
    n_z, n_y = np.cos(np.radians(55.0)), np.sin(np.radians(55.0))
    walls = [1.0 + sign * 0.5 * n_y + 0.5 * (n_z - 1.0) for sign in (1.0, -1.0)]
    for level in (1.0, *walls):
        assert np.mean(np.abs(lit - level) < 1e-3) > 0.02


def test_a_scenes_texture_lies_on_the_part():
    effect = {"level_e": 2000.0, "texture": 0.3}
    setup = affected(nominal("flat", psf_sigma_px=0.0), ambient_light=effect)
    none = np.zeros((60, 80))
    first, second = (
        passed(setup, light_of(none), CONDITIONS["dark"], rng=np.random.default_rng(seed)).other
        for seed in (1, 2)
    )
    relative = first / (2000.0 * cos4(setup.camera))
    assert relative.std() == pytest.approx(0.3, rel=0.2)
    assert abs(np.corrcoef(first.ravel(), second.ravel())[0, 1]) < 0.3
    more = predict(setup, scenes.pose(), CONDITIONS["dark"]).variance_e2
    plain = predict(dataclasses.replace(setup, effects={}), scenes.pose(), CONDITIONS["dark"]).variance_e2
    expected = 2000.0 * cos4(setup.camera)
    np.testing.assert_allclose(more - plain, expected + (0.3 * expected) ** 2, rtol=1e-3)


def test_a_pattern_far_along_the_seam_takes_no_more_nodes_than_a_near_one():
    """A lattice from its origin to a place 10^8 px away would hold more numbers than any memory."""
    places = np.random.default_rng(1).uniform(0.0, 200.0, (4000, 2))
    places[::10] = np.nan
    far = normal_field(places + 1e8, 0.5, 7)
    assert not far[::10].any()
    seen = far[np.isfinite(places[:, 0])]
    assert seen.mean() == pytest.approx(0.0, abs=0.1)
    assert seen.std() == pytest.approx(1.0, abs=0.05)
    # A point's number is its own, whatever else is in view.
    np.testing.assert_array_equal(normal_field(places[1:2] + 1e8, 0.5, 7), far[1:2])
    assert not normal_field(places[:1], 0.5, 7).any()
