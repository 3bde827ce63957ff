"""The first look: where a fit should start."""

import pytest
from small import small_recording

from sim_to_real.refit import refit
from sim_to_real.screen import screen


def look(path, name, planted):
    """Look at an effect in a recording that hides it."""
    expected = small_recording(path / "recording", {name: planted})
    (found,) = screen(expected, refit(expected, {}, expected.neutral, steps=0), [name])
    return found


def test_patches_are_found_one_beside_another(tmp_path):
    places = {"u_1": -0.5, "v_1": -0.3, "u_2": 0.4, "v_2": 0.3}
    found = look(
        tmp_path,
        "dirty_window",
        {**places, "radius_1": 0.2, "dimming_1": 0.5, "radius_2": 0.2, "dimming_2": 0.4},
    )
    seen = sorted((found.start[f"u_{n}"], found.start[f"v_{n}"], found.start[f"dimming_{n}"]) for n in (1, 2))
    for (u, v, dimming), (u_planted, v_planted) in zip(seen, [(-0.5, -0.3), (0.4, 0.3)], strict=True):
        assert (u, v) == pytest.approx((u_planted, v_planted), abs=0.15)
        assert dimming > 0.1
    assert found.left < 0.4


def test_one_patch_is_not_taken_for_several(tmp_path):
    found = look(tmp_path, "dirty_window", {"u_1": 0.42, "v_1": 0.15, "radius_1": 0.12, "dimming_1": 0.3})
    assert (found.start["u_1"], found.start["v_1"]) == pytest.approx((0.42, 0.15), abs=0.01)
    assert found.start["dimming_2"] == found.start["dimming_3"] == 0.0


def test_a_long_delay_is_started_from_beyond_the_short_one_s_reach(tmp_path):
    """A straight line is followed to three times its place: 0.03 s from the short one."""
    found = look(tmp_path, "pose_delay", {"delay_s": -0.06})
    assert -0.08 < found.start["delay_s"] < -0.03
