"""The first look: where a fit should start."""

import math
from dataclasses import replace

import numpy as np
import pytest
from small import small_recording

from noise_model.effects import REGISTRY
from sim_to_real.fit.gauss_newton import refit
from sim_to_real.search.identifiability import smallest_detectable
from sim_to_real.search.probe_points import effect_size
from sim_to_real.search.score_test import rescored, score_effects


def look(path, name, planted):
    """Look at an effect in a recording that hides it."""
    expected = small_recording(path / "recording", {name: planted})
    (score,) = score_effects(expected, refit(expected, {}, expected.neutral, steps=0), [name])
    return score


@pytest.mark.slow
def test_patches_are_found_one_beside_another(tmp_path):
    places = {"u_1": -0.5, "v_1": -0.3, "u_2": 0.4, "v_2": 0.3}
    result = look(
        tmp_path,
        "dirty_window",
        {**places, "radius_1": 0.2, "dimming_1": 0.5, "radius_2": 0.2, "dimming_2": 0.4},
    )
    # A planted patch of 0.2 may be taken for two beside each other; the fit starts within each of both.
    seen = [
        (result.start[f"u_{n}"], result.start[f"v_{n}"])
        for n in (1, 2, 3)
        if result.start[f"dimming_{n}"] > 0.1
    ]
    for planted in ((-0.5, -0.3), (0.4, 0.3)):
        assert min(math.dist(planted, place) for place in seen) < 0.2
    assert result.residual_fraction < 0.4


@pytest.mark.slow
def test_one_patch_is_not_taken_for_several(tmp_path):
    result = look(tmp_path, "dirty_window", {"u_1": 0.42, "v_1": 0.15, "radius_1": 0.12, "dimming_1": 0.3})
    assert (result.start["u_1"], result.start["v_1"]) == pytest.approx((0.42, 0.15), abs=0.01)
    assert result.start["dimming_2"] == result.start["dimming_3"] == 0.0


@pytest.mark.slow
def test_a_long_delay_is_started_from_beyond_the_short_one_s_reach(tmp_path):
    """A straight line is followed to three times its place: 0.03 s from the short one."""
    result = look(tmp_path, "pose_delay", {"delay_s": -0.06})
    assert -0.08 < result.start["delay_s"] < -0.03


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "parameter", "value"),
    [("uneven_fan", "half_angle_deg", 5.6), ("plate_outline", "right_mm", 11.0)],
)
def test_what_ends_is_started_from_the_end_that_was_probed(tmp_path, name, parameter, value):
    """Between an end and no end light does not go straight: a share of the way would be far beyond."""
    score = look(tmp_path, name, {parameter: value})
    assert score.residual_fraction < 0.5
    assert score.start[parameter] == pytest.approx(value, rel=0.2)
    # An end is a place, and has no smallest magnitude.
    at_end = replace(score, steps=np.zeros_like(score.steps))
    assert not smallest_detectable({name: score.signature}, [at_end])


@pytest.mark.slow
def test_what_the_setup_states_is_where_the_look_begins(tmp_path):
    first = {"u_1": -0.5, "v_1": -0.2, "radius_1": 0.3, "dimming_1": 0.3}
    both = {**first, "u_2": 0.45, "v_2": 0.25, "radius_2": 0.2, "dimming_2": 0.15}
    expected = small_recording(tmp_path / "patches", {"dirty_window": both}, stated={"dirty_window": first})
    (score,) = score_effects(expected, refit(expected, {}, expected.neutral, steps=0), ["dirty_window"])
    assert {key: score.start[key] for key in first} == pytest.approx(first)
    assert (score.start["u_2"], score.start["v_2"]) == pytest.approx((0.45, 0.25), abs=0.2)
    assert score.start["dimming_2"] > 0.05
    expected = small_recording(
        tmp_path / "arc", {"arc_length": {"height_mm": 0.7}}, stated={"arc_length": {"height_mm": 1.1}}
    )
    baseline = refit(expected, {}, expected.neutral, steps=0)
    (score,) = score_effects(expected, baseline, ["arc_length"])
    assert score.start["height_mm"] == pytest.approx(0.7, abs=0.1)
    assert abs(score.steps.item()) == pytest.approx(0.7)
    fitted = refit(expected, {"arc_length": score.start}, expected.neutral)
    assert fitted.quadratic.parameters[-1].start == 1.1
    assert effect_size(fitted.effects, expected.stated_values) == pytest.approx(0.4, abs=0.05)


@pytest.mark.slow
def test_what_is_seen_from_another_fit_is_what_a_look_from_there_would_see(tmp_path):
    """Of two effects one is fitted: beside it the other's places do about what they did without it."""
    hidden = {"gamma": {"gamma": 1.1}, "vignetting": {"loss": 0.15}}
    expected = small_recording(tmp_path / "both", hidden)
    baseline = refit(expected, {}, expected.neutral)
    screened = score_effects(expected, baseline, ["gamma", "vignetting", "blooming"])
    fitted = refit(expected, {"gamma": {}}, expected.neutral)
    seen = {item.id: item.residual_fraction for item in rescored(fitted, screened)}
    fresh = {
        item.id: item.residual_fraction
        for item in score_effects(expected, fitted, ["vignetting", "blooming"])
    }
    assert set(seen) == {"vignetting", "blooming"}
    assert seen["vignetting"] < 0.8 < 0.97 < seen["blooming"] <= 1.0
    assert seen == pytest.approx(fresh, abs=0.08)


def test_the_second_of_some_patches_has_a_size_too():
    neutral = REGISTRY["dirty_window"].neutral
    of_prior = next(p.prior_sigma for p in REGISTRY["dirty_window"].parameters if p.name == "dimming_2")
    second = {"dirty_window": {**neutral, "dimming_2": 0.3, "u_2": 0.5}}
    assert effect_size(second, lambda _: neutral) == pytest.approx(0.3 / of_prior)
