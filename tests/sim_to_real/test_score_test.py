"""The first look: what effects leave where they are tried, and where a fit of them starts."""

import math

import pytest

from sim_to_real.evidence.error_model import ErrorModel, LinearHypothesis
from sim_to_real.evidence.looks import Looks
from sim_to_real.evidence.policy import POLICY
from sim_to_real.fit.covariates import covariates
from sim_to_real.fit.gauss_newton import refit
from sim_to_real.search.score_test import score_effects
from tests.sim_to_real.small import small_recording

FINE = 3
"""So fine a camera resolves the stripe."""


def look(path, name, planted, stated=None):
    """Look at an effect in a recording that hides it: its score, and its likeliest start."""
    hidden = {name: planted}
    expected = small_recording(path / "recording", hidden, FINE, {name: stated} if stated else None)
    baseline = refit(expected, {}, expected.neutral, steps=0)
    scores = score_effects(expected, baseline, [name])
    errors = ErrorModel.of(expected, covariates(expected, baseline), baseline, scores, POLICY)
    start, *_ = Looks(LinearHypothesis.of(baseline), baseline.nuisance, scores, errors).starts_of(scores[0])
    return scores[0], start[name]


@pytest.mark.slow
def test_patches_are_found_one_beside_another(tmp_path):
    places = {"u_1": -0.5, "v_1": -0.3, "u_2": 0.4, "v_2": 0.3}
    planted = {**places, "radius_1": 0.2, "dimming_1": 0.5, "radius_2": 0.2, "dimming_2": 0.4}
    score, start = look(tmp_path, "dirty_window", planted)
    # A planted patch of 0.2 may be taken for two beside each other; the fit starts within each of both.
    seen = [(start[f"u_{n}"], start[f"v_{n}"]) for n in (1, 2, 3) if start[f"dimming_{n}"] > 0.1]
    for planted in ((-0.5, -0.3), (0.4, 0.3)):
        assert min(math.dist(planted, place) for place in seen) < 0.2
    assert score.residual_fraction < 0.4


@pytest.mark.slow
def test_one_patch_is_not_taken_for_several(tmp_path):
    _, start = look(tmp_path, "dirty_window", {"u_1": 0.42, "v_1": 0.15, "radius_1": 0.12, "dimming_1": 0.3})
    assert (start["u_1"], start["v_1"]) == pytest.approx((0.42, 0.15), abs=0.01)
    assert start["dimming_2"] == start["dimming_3"] == 0.0


@pytest.mark.slow
def test_a_long_delay_is_started_from_beyond_the_short_one_s_reach(tmp_path):
    """A straight line is followed to three times its place: 0.03 s from the short one."""
    _, start = look(tmp_path, "pose_delay", {"delay_s": -0.06})
    assert -0.08 < start["delay_s"] < -0.03


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "parameter", "value"),
    [("uneven_fan", "half_angle_deg", 5.6), ("plate_outline", "right_mm", 11.0)],
)
def test_what_ends_is_started_from_the_end_that_was_probed(tmp_path, name, parameter, value):
    """Between an end and no end light does not go straight: a share of the way would be far beyond."""
    score, start = look(tmp_path, name, {parameter: value})
    assert score.residual_fraction < 0.5
    assert start[parameter] == pytest.approx(value, rel=0.2)


@pytest.mark.slow
def test_what_the_setup_states_is_where_the_look_begins(tmp_path):
    first = {"u_1": -0.5, "v_1": -0.2, "radius_1": 0.3, "dimming_1": 0.3}
    both = {**first, "u_2": 0.45, "v_2": 0.25, "radius_2": 0.2, "dimming_2": 0.15}
    _, start = look(tmp_path / "patches", "dirty_window", both, first)
    assert {key: start[key] for key in first} == pytest.approx(first)
    assert (start["u_2"], start["v_2"]) == pytest.approx((0.45, 0.25), abs=0.2)
    assert start["dimming_2"] > 0.05
    score, start = look(tmp_path / "arc", "arc_length", {"height_mm": 0.7}, {"height_mm": 1.1})
    assert start["height_mm"] == pytest.approx(0.7, abs=0.1)
    assert abs(score.steps.item()) == pytest.approx(0.7)


@pytest.mark.slow
def test_a_fit_s_prior_is_about_what_the_setup_states(tmp_path):
    stated = {"arc_length": {"height_mm": 1.1}}
    expected = small_recording(tmp_path / "arc", {"arc_length": {"height_mm": 0.7}}, FINE, stated)
    fitted = refit(expected, {"arc_length": {"height_mm": 0.75}}, expected.neutral)
    assert fitted.quadratic.parameters[-1].start == 1.1
    assert fitted.effects["arc_length"]["height_mm"] == pytest.approx(0.7, abs=0.05)
