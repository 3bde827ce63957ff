"""Effects whose size changes from frame to frame."""

from dataclasses import replace

import numpy as np
import pytest

from noise_model.effects import REGISTRY
from noise_model.forward import draw_frame
from sim_to_real.data.binned import stated_condition
from sim_to_real.evidence.weigh import weigh
from sim_to_real.fit.covariates import covariates
from sim_to_real.fit.gauss_newton import converge, refit
from sim_to_real.fit.trend import Driver, Trend
from tests.sim_to_real.small import EXACT, held_against, recorded, small_recording

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


def blown_recording(path):
    """The model held against a recording whose arc is blown ever farther to the left."""
    setup, frames, pose_at = recorded(path, {}, coarser=FINE)
    rng = np.random.default_rng(5)

    def blown(frame):
        condition = stated_condition(setup, frame, frames[0].timestamp_s)
        values = {"x_mm": 0.0, "y_mm": GROWS_MM_S * condition.timestamp_s}
        there = replace(setup, effects={**setup.effects, "arc_deflection": values})
        image_dn = draw_frame(there, pose_at(frame.timestamp_s).T_base_tool, condition, rng)
        return replace(frame, image_dn=image_dn)

    return held_against(setup, [blown(frame) for frame in frames], pose_at)


@pytest.mark.slow
def test_an_arc_that_is_blown_ever_farther_grows_with_time(tmp_path):
    expected = blown_recording(tmp_path / "blown")
    stays = refit(expected, {"arc_deflection": {}}, expected.neutral)
    trend = Trend.of(expected.observed, "arc_deflection", Driver.TIME)
    changes = converge(expected, refit(expected, stays.effects, stays.nuisance, trend=trend))
    middle = changes.effects["arc_deflection"]
    for u in (-1.0, 1.0):
        timestamp_s = trend.middle + u * trend.half_range
        assert changes.trend.values_at(middle, u)["y_mm"] == pytest.approx(GROWS_MM_S * timestamp_s, abs=0.1)
    # It leaves what recordings without any effect leave: 0.83 to 0.94, as their noise is drawn.
    left = []
    for seed in range(4):
        quiet = held_against(*recorded(tmp_path / f"quiet{seed}", {}, replace(EXACT, seed=seed), FINE))
        left.append(refit(quiet, {}, quiet.neutral).mean_square)
    assert changes.mean_square < 1.1 * np.mean(left)
    assert stays.mean_square > 1.6 * np.mean(left)


@pytest.mark.slow
def test_a_change_is_looked_for_where_a_constant_effect_leaves_something(tmp_path):
    expected = blown_recording(tmp_path / "blown")
    without = [name for name in REGISTRY if name != "arc_deflection"]
    before = refit(expected, {}, expected.neutral)
    weighed = weigh(expected, before, covariates(expected, before), without, lambda text, share: None)
    best = weighed.posterior.hypotheses[0]
    assert best.refit.trend is not None
    assert best.refit.trend.driver is Driver.TIME
    stays = next(h for h in weighed.posterior.hypotheses if h.refit.trend is None)
    assert best.exact > stays.exact + 10.0
