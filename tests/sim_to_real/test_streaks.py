"""Lines of single frames, told from noise, from the model's own, and from what lasts."""

import math
from dataclasses import replace

import numpy as np
import pytest

from noise_model.transforms import invert
from sim_to_real.variance.streaks import is_persistent, lines_in_frame, search_lines, transient_lines
from tests.sim_to_real.scattered import BIN_PX, HEIGHT, NO_MORE, WIDTH, Scattering, recorded, streak

N_FRAMES = 12


def found_in(drawn, frames=lambda frames: frames):
    """The lines of a recording with something drawn, and whether they last."""
    expected, fitted = recorded(np.random.default_rng(5), Scattering(drawn=drawn), N_FRAMES)
    observed = replace(expected.observed, frames=tuple(frames(expected.observed.frames)))
    searched = search_lines(observed, fitted.lights, NO_MORE)
    result = [
        line
        for n, values in enumerate(searched)
        for line in lines_in_frame(n, values.bright, values.limit_dn)
    ]
    return result, is_persistent(observed, searched, result, dark=False)


def nothing():
    return np.zeros((N_FRAMES, HEIGHT, WIDTH))


def test_noise_and_smooth_light_have_no_lines():
    assert found_in(nothing())[0] == []


@pytest.mark.parametrize("angle", [0.2, 1.1, 2.5])
def test_a_streak_of_one_frame_is_found_where_it_is_and_does_not_last(angle):
    drawn = nothing()
    drawn[8] = streak(200.0, 150.0, angle, 45.0, 1.8, 1500.0)
    result, lasts = found_in(drawn)
    assert [line.position for line in result] == [8]
    assert not lasts.any()
    row, column = BIN_PX * result[0].bins.T + 0.5 * (BIN_PX - 1)
    beside = (row - 150.0) * math.cos(angle) - (column - 200.0) * math.sin(angle)
    along = (row - 150.0) * math.sin(angle) + (column - 200.0) * math.cos(angle)
    assert np.abs(beside).max() < 3.0 * BIN_PX
    assert 45.0 - 2.0 * BIN_PX < np.ptp(along) < 45.0 + 6.0 * BIN_PX


def test_what_stays_in_the_image_lasts():
    drawn = nothing() + streak(200.0, 150.0, 0.7, 45.0, 1.8, 1500.0)
    result, lasts = found_in(drawn)
    assert len(result) == N_FRAMES
    assert lasts.all()


def test_what_stays_on_the_part_lasts():
    """A scratch on the plate z = 0, seen by a pinhole from each frame's pose."""
    expected, _ = recorded(np.random.default_rng(5), Scattering(), N_FRAMES)
    camera = expected.observed.setup.camera
    drawn = nothing()
    for n, frame in enumerate(expected.observed.frames):
        T_camera_base = invert(frame.T_base_tool_in(expected.observed.setup) @ camera.T_tool_camera)
        ends = np.array([[40.0, 1.0, 0.0, 1.0], [41.0, 4.0, 0.0, 1.0]]) @ T_camera_base.T
        (u0, v0), (u1, v1) = ends[:, :2] / ends[:, 2:3] * camera.fx + (camera.cx, camera.cy)
        length = math.hypot(u1 - u0, v1 - v0)
        place = 0.5 * (u0 + u1), 0.5 * (v0 + v1), math.atan2(v1 - v0, u1 - u0)
        drawn[n] = streak(*place, length, 1.8, 1500.0)
    result, lasts = found_in(drawn)
    assert len(result) > N_FRAMES // 2
    assert len({line.place for line in result}) > len(result) // 2
    assert lasts.all()


def test_a_line_that_the_model_has_is_none_within_what_it_may_be_misplaced():
    drawn = nothing()
    drawn[8] = streak(200.0, 150.0, 0.7, 45.0, 1.8, 1500.0)
    own = drawn[8].reshape(HEIGHT // BIN_PX, BIN_PX, WIDTH // BIN_PX, BIN_PX).mean(axis=(1, 3))

    def stated(frames):
        moved = np.roll(own, 2, axis=1).astype(np.float32)
        return [replace(f, stated_e=f.stated_e + moved) if f.position == 8 else f for f in frames]

    assert len(found_in(drawn)[0]) == 1
    assert found_in(drawn, stated)[0] == []
    assert [line.position for line in found_in(2.5 * drawn, stated)[0]] == [8]


def test_wide_saturation_is_not_searched_and_a_saturated_streak_is_found():
    drawn = nothing()
    drawn[8, 140:180, 100:160] = 40_000.0
    drawn[9] = streak(200.0, 150.0, 0.7, 45.0, 1.8, 40_000.0)
    result, lasts = found_in(drawn)
    assert [line.position for line in result] == [9]
    assert not lasts.any()


def test_dark_lines_are_told_apart_and_those_beside_a_streak_are_its_own():
    drawn = nothing()
    drawn[8] = -streak(280.0, 40.0, 0.7, 45.0, 1.8, 700.0)
    # On a slope what is below a streak is darker than what is on either side.
    drawn[9] = streak(200.0, 190.0, 0.1, 45.0, 1.8, 1500.0)
    scattering = Scattering(drawn=drawn)
    expected, fitted = recorded(np.random.default_rng(5), scattering, N_FRAMES, with_stripe=False)
    searched = search_lines(expected.observed, fitted.lights, NO_MORE)
    assert lines_in_frame(9, searched[9].dark, searched[9].limit_dn)
    bright, dark = transient_lines(expected.observed, searched)
    assert [line.position for line in bright] == [9]
    assert [line.position for line in dark] == [8]


def test_a_streak_about_a_saturated_corner_is_found():
    """Where neither a line can be told, for the rim, nor a limit, for saturation."""
    drawn = nothing()
    drawn[8, HEIGHT - 24 :, :24] = 40_000.0
    drawn[8] += streak(47.0, HEIGHT - 47.0, 0.25 * math.pi, 115.0, 1.8, 3000.0)
    assert [line.position for line in found_in(drawn)[0]] == [8]
