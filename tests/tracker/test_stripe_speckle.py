"""Speckle in a stripe's sigma: the closed form against fits of drawn fields, and frames with it stated."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import rendered

from noise_model.arc.map import make_scene
from noise_model.condition import Condition
from noise_model.forward import Renderer, draw_frame
from tracker.geometry import SensorGeometry
from tracker.state import Frame
from tracker.stripe.expected import expect_stripe
from tracker.stripe.speckle import Speckle, speckle_variance_px2
from tracker.tracker import Tracker


def test_fine_grains_give_the_limits_of_the_closed_form() -> None:
    amplitude, width, flat = np.array([1e4]), np.array([5.0]), np.array([1e-9])
    speckle = Speckle(0.1, 0.5)
    scale = speckle.contrast**2 * speckle.alike * 5.0
    own = speckle_variance_px2(speckle, amplitude, width, np.zeros(1), 1.0, 1e-6, flat)
    other = speckle_variance_px2(speckle, amplitude, width, np.array([1e9]), 1.0, 1.0, flat)
    # (sqrt(pi) / 2) / (2 pi) and sqrt(pi / 2) / 4 / (sqrt(pi) / 2)^2, but for what the grain is not small.
    assert own[0] / scale == pytest.approx(0.1410, rel=0.03)
    assert other[0] / scale == pytest.approx(0.3989, rel=0.03)


@pytest.mark.parametrize("grain_px", [0.5, 1.0, 3.0])
@pytest.mark.parametrize("background", [0.0, 3000.0])
def test_the_closed_form_is_what_a_weighted_fit_scatters_by(grain_px: float, background: float) -> None:
    """A linear fit of amplitude, centre, width, offset and slope to fields drawn by their correlation."""
    contrast, A, w, dark, slope_sigma = 0.2, 4000.0, 5.0, 2500.0, 3.0
    r = np.arange(-20.0, 21.0)
    g = np.exp(-0.5 * (r / w) ** 2)
    J = np.stack([g, A * g * r / w**2, A * g * r**2 / w**3, np.ones_like(r), r])
    weight = 1.0 / (A * g + background + dark)
    prior = np.diag([0.0, 0.0, 0.0, 0.0, slope_sigma**-2])
    pick = np.linalg.solve((J * weight) @ J.T + prior, J * weight)[1]
    apart = r[:, np.newaxis] - r
    s2 = math.log1p(contrast**2)
    covariance = np.expm1(s2 * np.exp(-(apart**2) / (4.0 * grain_px**2))) * np.outer(A * g, A * g)
    exact = pick @ covariance @ pick
    stated = speckle_variance_px2(
        Speckle(contrast, grain_px),
        np.array([A]),
        np.array([w]),
        np.array([background]),
        1.0,
        dark,
        np.array([slope_sigma]),
    )
    assert stated[0] == pytest.approx(exact, rel=0.05)


def test_grains_in_a_row_that_scatter_alike_are_counted() -> None:
    assert Speckle(0.01, 0.3).alike == pytest.approx(1.0 + 2.0 * math.exp(-1.0 / 0.36), rel=1e-3)
    assert Speckle(0.01, 3.0).alike == pytest.approx(2.0 * math.sqrt(math.pi) * 3.0, rel=1e-3)
    # A log-normal field is less alike than its logarithm.
    assert Speckle(0.9, 3.0).alike < Speckle(0.1, 3.0).alike


@pytest.mark.slow
@pytest.mark.parametrize(("contrast", "grain_px"), [(0.1, 1.0), (0.2, 0.5), (0.2, 2.0)])
def test_frames_with_speckle_scatter_by_the_stated_sigma(contrast: float, grain_px: float) -> None:
    plain = rendered.small_setup("v_groove")
    effects = {"laser_speckle": {"contrast": contrast, "grain_px": grain_px}}
    setup = replace(plain, effects=effects)
    pose, renderer, rng = rendered.pose_at(0.0), Renderer(), np.random.default_rng(5)
    expected = expect_stripe(SensorGeometry.of(plain), make_scene(plain, pose.T_base_tool))
    assert expected is not None
    true = expected.position_px + expected.bias_px
    bend = np.abs(np.gradient(np.gradient(expected.position_px))) > 0.02
    face = np.convolve(bend, np.ones(41), "same") == 0.0
    tracker, own, together, without = Tracker(setup), [], [], []
    blind = Tracker(plain)
    for n in range(12):
        condition = Condition(1.0, 1.0, rendered.EXPOSURE_S)
        image = draw_frame(setup, pose.T_base_tool, condition, rng, renderer=renderer)
        frame = Frame(n, 0.1 * n, image, rendered.EXPOSURE_S, rendered.CURRENT_A)
        stripe, unstated = tracker.step(frame, pose).stripe, blind.step(frame, pose).stripe
        assert stripe is not None
        assert unstated is not None
        own.append(((stripe.position_px - true) / stripe.sigma_px)[face])
        together.append(((stripe.smooth_px - true) / stripe.smooth_sigma_px)[face])
        without.append(((unstated.smooth_px - true) / unstated.smooth_sigma_px)[face])
    assert 0.9 <= np.nanmean(np.square(own)) <= 1.1
    # Of neighbours drawn through together there are only some hundred in these frames.
    assert 0.75 <= np.nanmean(np.square(together)) <= 1.25
    # The same frames without it stated: neighbours that scatter alike would count as independent.
    assert np.nanmean(np.square(without)) > np.nanmean(np.square(together))
