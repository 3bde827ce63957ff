"""Effects whose size changes from frame to frame."""

from dataclasses import replace
from unittest.mock import patch

import numpy as np
import pytest

import arctrack.simulate
from noise_model.forward import draw_frame
from sim_to_real.change import Change, Driver
from sim_to_real.refit import refit
from sim_to_real.select import judged, with_changes
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
    change = Change.of(observed, "arc_length", driver)
    u = [change.share(observed.setup, frame) for frame in observed.frames]
    assert (min(u), max(u)) == (pytest.approx(-1.0), pytest.approx(1.0))
    drives = {
        Driver.TIME: [frame.timestamp_s for frame in observed.frames],
        Driver.HEIGHT: [frame.pose_at(frame.timestamp_s)[2, 3] for frame in observed.frames],
    }
    # The example's seam lies in base's z = 0.
    np.testing.assert_allclose(np.corrcoef(u, drives[driver])[0, 1], 1.0)


def test_values_stay_within_their_bounds(observed):
    frame, last = observed.frames[0], observed.frames[-1]
    change = replace(Change.of(observed, "fume", Driver.TIME), by=(1.0, 0.02, 0.0))
    fume = {"extinction_per_m": 0.5, "scatter": 0.1, "gathered_per_mm": 0.0}
    effects = {"gamma": {"gamma": 1.1}, "fume": fume}
    first = change.at(effects, observed.setup, frame)
    assert first["gamma"] == effects["gamma"]
    assert first["fume"] == {**fume, "extinction_per_m": 0.0, "scatter": pytest.approx(0.08)}
    assert change.at(effects, observed.setup, last)["fume"]["extinction_per_m"] == pytest.approx(1.5)


def blown(setup, T_base_tool, condition, rng, **drawn):
    values = {"x_mm": 0.0, "y_mm": GROWS_MM_S * condition.timestamp_s}
    there = replace(setup, effects={"arc_deflection": values})
    return draw_frame(there, T_base_tool, condition, rng, **drawn)


def test_an_arc_that_is_blown_ever_farther_grows_with_time(tmp_path):
    with patch.object(arctrack.simulate, "draw_frame", blown):
        expected = small_recording(tmp_path / "blown", {}, FINE)
    stays = judged(expected, refit(expected, {"arc_deflection": {}}, expected.neutral))
    (changes,) = with_changes(expected, [stays], lambda text, share: None)
    change, middle = changes.refit.change, changes.refit.effects["arc_deflection"]
    assert change.driver is Driver.TIME
    for u, timestamp_s in ((-1.0, change.middle - change.half), (1.0, change.middle + change.half)):
        assert change.values(middle, u)["y_mm"] == pytest.approx(GROWS_MM_S * timestamp_s, abs=0.1)
    assert changes.left < 1.0 < stays.left


def test_an_arc_that_is_blown_aside_once_and_for_all_does_not_change(tmp_path):
    expected = small_recording(tmp_path / "stays", {"arc_deflection": {"y_mm": 1.0}}, FINE)
    stays = judged(expected, refit(expected, {"arc_deflection": {}}, expected.neutral))
    assert with_changes(expected, [stays], lambda text, share: None) == [stays]
