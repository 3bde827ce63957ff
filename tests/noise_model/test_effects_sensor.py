"""Sensor against formulas written out here, and random effects against many frames."""

import dataclasses
import math

import numpy as np
import pytest
import scenes
from effect_scenes import (
    CONDITIONS,
    EXPOSURE_S,
    LATE_S,
    affected,
    charge,
    draws,
    light_of,
    nominal,
    passed,
)

from noise_model.condition import Condition
from noise_model.effects import apply_setup_effects
from noise_model.forward import Renderer, draw_frame, predict

BOTH = CONDITIONS["both"]
DEEP = {"bits": 12, "gain_e_per_dn": 20.0, "full_well_e": 80_000.0, "black_level_dn": 64.0}


def test_gamma_by_hand():
    """Eq. 20 where noise is small: DN = black + full_well / gain (e / full_well)^(gamma_stated gamma)."""
    setup = nominal(**DEEP, gamma=0.9, read_noise_e=5.0)
    got = predict(affected(setup, gamma={"gamma": 0.7}), scenes.pose(), BOTH)
    e = charge(setup, BOTH)
    bright = e > 2000.0
    assert bright.sum() > 500
    wanted = 64.0 + 4000.0 * (e / 80_000.0) ** 0.63
    np.testing.assert_allclose(got.mean_dn[bright], wanted[bright], atol=0.05)
    slope = 0.63 * 4000.0 / 80_000.0 * (e / 80_000.0) ** -0.37
    np.testing.assert_allclose(
        got.variance_dn2[bright], (slope**2 * (e + 25.0) + 1.0 / 12.0)[bright], rtol=5e-3
    )


def test_a_bent_response_by_hand():
    """DN over black: a parabola of the charge, as steep as stated at black and 1 - 2 bend at full well."""
    setup = nominal(**DEEP, read_noise_e=5.0)
    got = predict(affected(setup, gamma={"bend": 0.4}), scenes.pose(), BOTH)
    e = charge(setup, BOTH)
    bright = e > 2000.0
    np.testing.assert_allclose(
        got.mean_dn[bright], (64.0 + e / 20.0 - 0.4 * e**2 / (20.0 * 80_000.0))[bright], atol=0.05
    )


def test_another_black_level_moves_every_reading():
    setup = nominal(**DEEP)
    for condition in CONDITIONS.values():
        before = predict(setup, scenes.pose(), condition)
        after = predict(affected(setup, black_level={"offset_dn": 8.5}), scenes.pose(), condition)
        np.testing.assert_allclose(after.mean_dn, before.mean_dn + 8.5)
        np.testing.assert_allclose(after.variance_dn2, before.variance_dn2)


def test_read_noise_adds_its_square():
    setup = nominal(**DEEP)
    for condition in (CONDITIONS["dark"], BOTH):
        before = predict(setup, scenes.pose(), condition)
        after = predict(affected(setup, read_noise={"noise_ratio": 3.0}), scenes.pose(), condition)
        np.testing.assert_allclose(
            after.variance_dn2 - before.variance_dn2, (3.0**2 - 1.0) * 45.0**2 / 20.0**2, rtol=1e-5
        )
    dark = draws(affected(nominal(**DEEP), read_noise={"noise_ratio": 3.0}), CONDITIONS["dark"], 10)
    assert dark.std() == pytest.approx(math.hypot(135.0 / 20.0, math.sqrt(1.0 / 12.0)), rel=0.02)


def test_an_exposure_that_drifts_leaves_black_level_and_read_noise():
    setup = affected(nominal(**DEEP), exposure_drift={"rate_per_s": 0.1, "settle_s": 1000.0})
    late = dataclasses.replace(CONDITIONS["dark"], timestamp_s=5.0)
    before, after = predict(nominal(**DEEP), scenes.pose(), late), predict(setup, scenes.pose(), late)
    np.testing.assert_array_equal(before.mean_dn, after.mean_dn)
    np.testing.assert_array_equal(before.variance_dn2, after.variance_dn2)
    late = dataclasses.replace(BOTH, timestamp_s=5.0)
    np.testing.assert_allclose(charge(setup, late), math.exp(0.5) * charge(nominal(**DEEP), late), rtol=2e-3)


def overfull():
    rng = np.random.default_rng(7)
    image = rng.uniform(0.0, 15_000.0, (60, 80))
    image[28:31, 10:60] = 50_000.0
    return image


@pytest.mark.parametrize("reach_px", [0.5, 4.0, 300.0])
def test_blooming_by_hand(reach_px):
    """Each column on its own: every overfull pixel's share, falling away on either side."""
    setup = affected(nominal("flat", psf_sigma_px=0.0), blooming={"spill": 0.6, "reach_px": reach_px})
    image = overfull()
    got = passed(setup, light_of(image)).other
    excess = np.maximum(image - 20_400.0, 0.0)
    away = np.arange(1, 100_000)
    total = float(np.sum(np.exp(-away / reach_px)))
    for column in (5, 10, 40):
        wanted = np.zeros(60)
        for row in np.flatnonzero(excess[:, column]):
            distance = np.abs(np.arange(60) - row)
            share = np.where(distance > 0, np.exp(-distance / reach_px), 0.0)
            wanted += 0.5 * 0.6 * excess[row, column] * share / total
        np.testing.assert_allclose(got[:, column], wanted, rtol=1e-4, atol=1e-3)


def test_blooming_keeps_the_columns_charge():
    """What spills is the share of the excess, less what passes the rim, which a short reach does not."""
    setup = affected(nominal("flat", psf_sigma_px=0.0), blooming={"spill": 0.6, "reach_px": 2.0})
    image = overfull()
    got = passed(setup, light_of(image)).other
    excess = np.maximum(image - 20_400.0, 0.0)
    np.testing.assert_allclose(got.sum(axis=0), 0.6 * excess.sum(axis=0), rtol=1e-4, atol=1e-3)
    assert not got[:, 60:].any()


def test_a_column_glows_from_rim_to_rim_by_all_of_its_excess():
    setup = affected(nominal("flat", psf_sigma_px=0.0), blooming={"column_share": 0.5})
    image = overfull()
    got = passed(setup, light_of(image)).other
    excess = np.maximum(image - 20_400.0, 0.0).mean(axis=0)
    np.testing.assert_allclose(got, np.broadcast_to(0.5 * excess, got.shape), rtol=1e-5, atol=1e-3)


def test_the_pattern_is_the_same_in_every_frame_and_as_strong_as_said():
    setup = affected(nominal(**DEEP), fixed_pattern={"sigma_rel": 0.05})
    rng = np.random.default_rng(3)
    image = np.full((60, 80), 20_000.0)
    first, second = (passed(setup, light_of(image), rng=rng).arc.astype(np.float64) for _ in range(2))
    np.testing.assert_array_equal(first, second)
    # 4800 pixels: a spread is known to 1 %, neighbours have nothing in common.
    assert first.std() == pytest.approx(0.05 * 20_000.0, rel=0.04)
    unit = (first - first.mean()) / first.std()
    assert abs(np.mean(unit[:, 1:] * unit[:, :-1])) < 0.06
    expected = passed(setup, light_of(image))
    np.testing.assert_allclose(expected.variance_e2, 1000.0**2, rtol=1e-5)
    # The dark has none of it.
    dark = predict(setup, scenes.pose(), CONDITIONS["dark"])
    np.testing.assert_array_equal(
        dark.variance_dn2, predict(nominal(**DEEP), scenes.pose(), CONDITIONS["dark"]).variance_dn2
    )


def test_a_saturated_pixel_hides_its_pattern():
    setup = affected(nominal(), fixed_pattern={"sigma_rel": 0.05})
    bright = Condition(1.0, 1.0, 40.0 * EXPOSURE_S, LATE_S)
    got = predict(setup, scenes.pose(), bright)
    deep = got.mean_e > 30_000.0
    assert deep.sum() > 100
    np.testing.assert_allclose(got.mean_dn[deep], 255.0, atol=1e-3)
    assert (got.variance_dn2[deep] < 0.1).all()


def whitened(setup, condition, n, T_base_tool):
    """Residuals (n, H, W) of n frames over their sigmas."""
    renderer = Renderer()
    expected = predict(setup, T_base_tool, condition, renderer=renderer)
    frames = draws(setup, condition, n, T_base_tool=T_base_tool, renderer=renderer)
    return (frames - expected.mean_dn) / np.sqrt(expected.variance_dn2)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("effects", "independent"),
    [
        ({}, True),
        ({"laser_speckle": {"contrast": 0.3, "grain_px": 1.0}}, True),
        ({"read_noise": {"noise_ratio": 2.0}}, True),
        ({"spatter": {"rate_per_frame": 30.0, "peak_e": 150.0, "length_px": 6.0, "width_px": 1.5}}, True),
        ({"fixed_pattern": {"sigma_rel": 0.05}}, False),
        ({"fume": {}, "veiling_glare": {"share": 0.1}, "hot_metal_glow": {"peak_e": 3000.0}}, True),
        (
            {
                "laser_speckle": {"contrast": 0.2},
                "spatter": {"rate_per_frame": 30.0, "peak_e": 150.0, "length_px": 6.0},
                "fixed_pattern": {"sigma_rel": 0.03},
                "fume": {"extinction_per_m": 2.0},
                "vignetting": {"loss": 0.3},
                "veiling_glare": {"share": 0.1},
                "defocus": {"sigma_px": 1.0},
                "gamma": {"gamma": 0.8},
            },
            False,
        ),
    ],
)
def test_many_frames_have_the_predictions_mean_and_variance(effects, independent):
    """chi^2 of 120 frames within what the frames' own scatter leaves; pixel by pixel their mean."""
    setup = affected(nominal(width=40, height=30, **DEEP), **effects)
    n = 120
    r = whitened(setup, BOTH, n, scenes.pose((4.0, 0.5, 1.0), (3.0, -2.0, 4.0)))
    of_frame = np.mean(r**2, axis=(1, 2))
    # A pattern is the same in all frames: its pixels' scatter counts once.
    of_pixel = np.mean(r**2, axis=0)
    error = max(of_frame.std() / math.sqrt(n), of_pixel.std() / math.sqrt(of_pixel.size))
    assert error < 0.04
    assert np.mean(r**2) == pytest.approx(1.0, abs=4.0 * error)
    assert np.mean(r) == pytest.approx(
        0.0, abs=4.0 * max(r.mean(axis=(1, 2)).std() / math.sqrt(n), r.mean(axis=0).std() / 35.0)
    )
    if independent:
        means = r.mean(axis=0) * math.sqrt(n)
        # Correlated over a streak or a grain: 1200 pixels are at least 60 numbers.
        assert np.mean(means**2) == pytest.approx(1.0, abs=4.0 * math.sqrt(2.0 / 60.0))


def test_frames_with_effects_are_drawn_again_from_their_seed():
    setup = affected(
        nominal(width=40, height=30),
        arc_flicker={"sigma_rel": 0.2},
        laser_speckle={"contrast": 0.3},
        spatter={"rate_per_frame": 5.0},
        fixed_pattern={"sigma_rel": 0.05},
    )
    first, second = (draw_frame(setup, scenes.pose(), BOTH, np.random.default_rng(9)) for _ in range(2))
    np.testing.assert_array_equal(first, second)
    assert apply_setup_effects(setup).effects == setup.effects
