"""Effects whose size changes from frame to frame."""

from dataclasses import replace
from unittest.mock import patch

import numpy as np
import pytest

import arctrack.simulate
from noise_model.effects import REGISTRY
from noise_model.forward import draw_frame
from sim_to_real.fit.gauss_newton import FLICKER, MIN_EVIDENCE_NATS, refit
from sim_to_real.fit.trend import TREND_EFFECTS, Driver, Trend
from sim_to_real.search.hypothesis import cross_validated
from sim_to_real.search.probe_points import FAMILIES
from sim_to_real.search.score_test import score_trends
from sim_to_real.search.single_effects import Search, fit_single_effects, score_catalogue, with_trends
from tests.sim_to_real.small import small_recording

FINE = 3
"""So fine a camera sees an arc that moves by a millimetre and little else."""

GROWS_MM_S = 3.0
"""How fast the arc is blown to the left."""


@pytest.fixture(scope="module")
def observed(tmp_path_factory):
    return small_recording(tmp_path_factory.mktemp("change") / "nominal", {}).observed


@pytest.mark.parametrize("driver", Driver)
def test_a_driver_runs_from_minus_one_to_one(observed, driver):
    trend = Trend.of(observed, "arc_length", driver)
    u = [trend.driver_position(observed.setup, frame) for frame in observed.frames]
    assert (min(u), max(u)) == (pytest.approx(-1.0), pytest.approx(1.0))
    drives = {
        Driver.TIME: [frame.timestamp_s for frame in observed.frames],
        Driver.HEIGHT: [frame.pose_at(frame.timestamp_s)[2, 3] for frame in observed.frames],
    }
    # The example's seam lies in base's z = 0.
    np.testing.assert_allclose(np.corrcoef(u, drives[driver])[0, 1], 1.0)


def test_values_stay_within_their_bounds(observed):
    frame, last = observed.frames[0], observed.frames[-1]
    trend = replace(Trend.of(observed, "fume", Driver.TIME), amplitude=(1.0, 0.02, 0.0))
    fume = {"extinction_per_m": 0.5, "scatter": 0.1, "gathered_per_mm": 0.0}
    effects = {"gamma": {"gamma": 1.1}, "fume": fume}
    first = trend.effects_in_frame(effects, observed.setup, frame)
    assert first["gamma"] == effects["gamma"]
    assert first["fume"] == {**fume, "extinction_per_m": 0.0, "scatter": pytest.approx(0.08)}
    assert trend.effects_in_frame(effects, observed.setup, last)["fume"]["extinction_per_m"] == pytest.approx(
        1.5
    )


def search(expected, without=()):
    """A search that asks no pixels."""
    return Search(expected, without, lambda fits: np.zeros(len(fits)), lambda text, share: None)


def blown(setup, T_base_tool, condition, rng, **drawn):
    values = {"x_mm": 0.0, "y_mm": GROWS_MM_S * condition.timestamp_s}
    there = replace(setup, effects={**setup.effects, "arc_deflection": values})
    return draw_frame(there, T_base_tool, condition, rng, **drawn)


def changed(expected, *hypotheses):
    """What becomes of candidates if they may change, or of arc_deflection if there are none."""
    baseline = refit(expected, {}, expected.neutral, steps=0)
    among = {name for hypothesis in hypotheses for name in hypothesis.ids} or {"arc_deflection"}
    only = search(expected, [name for name in FAMILIES if name not in among])
    return with_trends(only, baseline, score_catalogue(only, baseline), hypotheses)


@pytest.mark.slow
def test_the_first_look_sees_by_what_an_effect_changes(tmp_path):
    with patch.object(arctrack.simulate, "draw_frame", blown):
        expected = small_recording(tmp_path / "blown", {}, FINE)
    baseline = refit(expected, {}, expected.neutral, steps=0)
    looks = score_trends(expected, baseline, score_catalogue(search(expected), baseline))
    best = looks[0]
    assert {look.trend.effect for look in looks} == set(TREND_EFFECTS)
    assert (best.trend.effect, best.trend.driver) == ("arc_deflection", Driver.TIME)
    assert best.residual_fraction < 0.8 * min(
        look.residual_fraction for look in looks if look.trend.effect != "arc_deflection"
    )
    # y alone: from 0 at the first frame.
    y = [parameter.name for parameter in REGISTRY["arc_deflection"].parameters].index("y_mm")
    assert best.trend.amplitude[y] == pytest.approx(GROWS_MM_S * best.trend.half_range, rel=0.2)
    assert best.start["y_mm"] == pytest.approx(GROWS_MM_S * best.trend.middle, rel=0.2)


@pytest.mark.slow
def test_an_arc_that_is_blown_ever_farther_grows_with_time(tmp_path):
    with patch.object(arctrack.simulate, "draw_frame", blown):
        expected = small_recording(tmp_path / "blown", {}, FINE)
    stays = cross_validated(expected, refit(expected, {"arc_deflection": {}}, expected.neutral))
    (changes,) = changed(expected, stays)
    # It is found, too, where it was not among the candidates as long as it stayed.
    (result,) = changed(expected)
    assert result.cv_mean_square == pytest.approx(changes.cv_mean_square, rel=0.01)
    trend, middle = changes.refit.trend, changes.refit.effects["arc_deflection"]
    assert trend.driver is Driver.TIME
    for u, timestamp_s in (
        (-1.0, trend.middle - trend.half_range),
        (1.0, trend.middle + trend.half_range),
    ):
        assert trend.values_at(middle, u)["y_mm"] == pytest.approx(GROWS_MM_S * timestamp_s, abs=0.1)
    # It leaves what a recording without any effect leaves.
    quiet = small_recording(tmp_path / "quiet", {}, FINE)
    nothing = cross_validated(quiet, refit(quiet, {}, quiet.neutral))
    assert changes.cv_mean_square < 1.1 * nothing.cv_mean_square < 0.5 * stays.cv_mean_square


@pytest.mark.slow
def test_an_arc_that_is_blown_aside_once_and_for_all_does_not_change(tmp_path):
    expected = small_recording(tmp_path / "stays", {"arc_deflection": {"y_mm": 1.0}}, FINE)
    stays = cross_validated(expected, refit(expected, {"arc_deflection": {}}, expected.neutral))
    assert changed(expected, stays) == [stays]


@pytest.mark.slow
def test_another_effect_is_found_beside_one_that_changes(tmp_path):
    glare = {"veiling_glare": {"share": 0.08}}

    def blown_behind_glare(setup, *arguments, **drawn):
        return blown(replace(setup, effects=glare), *arguments, **drawn)

    with patch.object(arctrack.simulate, "draw_frame", blown_behind_glare):
        expected = small_recording(tmp_path / "both", {}, FINE)
    stays = cross_validated(expected, refit(expected, {"arc_deflection": {}}, expected.neutral))
    (changes,) = changed(expected, stays)
    assert changes.refit.trend is not None
    others = [name for name in FAMILIES if name not in ("veiling_glare", "arc_length")]
    beside = search(expected, (FLICKER, *others))
    screened = score_catalogue(beside, changes.refit)
    # It looks on from where the fit has come to, its change included; a look is a straight line.
    assert all(score.residual_fraction < 1.01 for score in screened)
    best = fit_single_effects(beside, changes.refit, screened, changes.cv_mean_square)[0]
    assert best.ids == ("arc_deflection", "veiling_glare")
    assert best.refit.effects["veiling_glare"]["share"] == pytest.approx(0.08, abs=0.02)
    trend, middle = best.refit.trend, best.refit.effects["arc_deflection"]
    ends = [trend.values_at(middle, u)["y_mm"] for u in (-1.0, 1.0)]
    assert ends[1] - ends[0] == pytest.approx(2.0 * trend.half_range * GROWS_MM_S, abs=0.2)
    assert best.evidence - changes.evidence > MIN_EVIDENCE_NATS


@pytest.mark.slow
def test_what_pixels_speak_against_is_not_cleared_by_a_change_that_helps_little(tmp_path):
    expected = small_recording(tmp_path / "stays", {"arc_length": {"height_mm": 0.6}})
    stays = cross_validated(expected, refit(expected, {"arc_length": {}}, expected.neutral))
    refused = replace(stays, pixel_misfit=9.0, pixel_penalty_nats=25.0)
    assert changed(expected, refused) == [refused]
