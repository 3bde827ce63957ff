"""Effects whose size changes from frame to frame."""

from dataclasses import replace
from unittest.mock import patch

import numpy as np
import pytest

import arctrack.simulate
from noise_model.effects import REGISTRY
from noise_model.forward import draw_frame
from sim_to_real.fit.gauss_newton import FLICKER, NAMED_FROM, refit
from sim_to_real.fit.trend import CHANGING, Change, Driver
from sim_to_real.search.hypothesis import judged
from sim_to_real.search.probe_points import FAMILIES
from sim_to_real.search.score_test import screen_changes
from sim_to_real.search.single_effects import Search, candidates, looked, with_changes
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


def search(expected, without=()):
    """A search that asks no pixels."""
    return Search(expected, without, lambda fits: np.zeros(len(fits)), lambda text, share: None)


def blown(setup, T_base_tool, condition, rng, **drawn):
    values = {"x_mm": 0.0, "y_mm": GROWS_MM_S * condition.timestamp_s}
    there = replace(setup, effects={**setup.effects, "arc_deflection": values})
    return draw_frame(there, T_base_tool, condition, rng, **drawn)


def changed(expected, *found):
    """What becomes of candidates if they may change, or of arc_deflection if there are none."""
    baseline = refit(expected, {}, expected.neutral, steps=0)
    among = {name for one in found for name in one.ids} or {"arc_deflection"}
    only = search(expected, [name for name in FAMILIES if name not in among])
    return with_changes(only, baseline, looked(only, baseline), found)


def test_the_first_look_sees_by_what_an_effect_changes(tmp_path):
    with patch.object(arctrack.simulate, "draw_frame", blown):
        expected = small_recording(tmp_path / "blown", {}, FINE)
    baseline = refit(expected, {}, expected.neutral, steps=0)
    looks = screen_changes(expected, baseline, looked(search(expected), baseline))
    best = looks[0]
    assert {look.change.effect for look in looks} == set(CHANGING)
    assert (best.change.effect, best.change.driver) == ("arc_deflection", Driver.TIME)
    assert best.left < 0.8 * min(look.left for look in looks if look.change.effect != "arc_deflection")
    # y alone: from 0 at the first frame.
    y = [parameter.name for parameter in REGISTRY["arc_deflection"].parameters].index("y_mm")
    assert best.change.by[y] == pytest.approx(GROWS_MM_S * best.change.half, rel=0.2)
    assert best.start["y_mm"] == pytest.approx(GROWS_MM_S * best.change.middle, rel=0.2)


def test_an_arc_that_is_blown_ever_farther_grows_with_time(tmp_path):
    with patch.object(arctrack.simulate, "draw_frame", blown):
        expected = small_recording(tmp_path / "blown", {}, FINE)
    stays = judged(expected, refit(expected, {"arc_deflection": {}}, expected.neutral))
    (changes,) = changed(expected, stays)
    # It is found, too, where it was not among the candidates as long as it stayed.
    (found,) = changed(expected)
    assert found.left == pytest.approx(changes.left, rel=0.01)
    change, middle = changes.refit.change, changes.refit.effects["arc_deflection"]
    assert change.driver is Driver.TIME
    for u, timestamp_s in ((-1.0, change.middle - change.half), (1.0, change.middle + change.half)):
        assert change.values(middle, u)["y_mm"] == pytest.approx(GROWS_MM_S * timestamp_s, abs=0.1)
    # It leaves what a recording without any effect leaves.
    quiet = small_recording(tmp_path / "quiet", {}, FINE)
    nothing = judged(quiet, refit(quiet, {}, quiet.neutral))
    assert changes.left < 1.1 * nothing.left < 0.5 * stays.left


def test_an_arc_that_is_blown_aside_once_and_for_all_does_not_change(tmp_path):
    expected = small_recording(tmp_path / "stays", {"arc_deflection": {"y_mm": 1.0}}, FINE)
    stays = judged(expected, refit(expected, {"arc_deflection": {}}, expected.neutral))
    assert changed(expected, stays) == [stays]


def test_another_effect_is_found_beside_one_that_changes(tmp_path):
    glare = {"veiling_glare": {"share": 0.08}}

    def blown_behind_glare(setup, *of, **drawn):
        return blown(replace(setup, effects=glare), *of, **drawn)

    with patch.object(arctrack.simulate, "draw_frame", blown_behind_glare):
        expected = small_recording(tmp_path / "both", {}, FINE)
    stays = judged(expected, refit(expected, {"arc_deflection": {}}, expected.neutral))
    (changes,) = changed(expected, stays)
    assert changes.refit.change is not None
    others = [name for name in FAMILIES if name not in ("veiling_glare", "arc_length")]
    beside = search(expected, (FLICKER, *others))
    screened = looked(beside, changes.refit)
    # It looks on from where the fit has come to, its change included; a look is a straight line.
    assert all(one.left < 1.01 for one in screened)
    best = candidates(beside, changes.refit, screened, changes.left)[0]
    assert best.ids == ("arc_deflection", "veiling_glare")
    assert best.refit.effects["veiling_glare"]["share"] == pytest.approx(0.08, abs=0.02)
    change, middle = best.refit.change, best.refit.effects["arc_deflection"]
    ends = [change.values(middle, u)["y_mm"] for u in (-1.0, 1.0)]
    assert ends[1] - ends[0] == pytest.approx(2.0 * change.half * GROWS_MM_S, abs=0.2)
    assert best.evidence - changes.evidence > NAMED_FROM


def test_what_pixels_speak_against_is_not_cleared_by_a_change_that_helps_little(tmp_path):
    expected = small_recording(tmp_path / "stays", {"arc_length": {"height_mm": 0.6}})
    stays = judged(expected, refit(expected, {"arc_length": {}}, expected.neutral))
    refused = replace(stays, left_in_pixels=9.0, against=25.0)
    assert changed(expected, refused) == [refused]
