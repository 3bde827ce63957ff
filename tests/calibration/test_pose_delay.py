from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from arctrack.nominal import nominal_setup
from calibration.pose_delay import PoseDelay, PoseTrack, fit_pose_delay
from noise_model.compiled.arrays import Float64
from tracker.seam_observations import SeamObservations

SETUP = nominal_setup("butt", "mild_steel")
SHEET_MM = 35.0
DELAY_S, NOISE_MM, SPEED_MM_S = 0.037, 0.05, 8.0
FRAMES_S = 1.0 + 0.1 * np.arange(40)


def weaving(time_s: Float64, period_s: float = 1.7) -> Float64:
    """Return the tool's sideways place and height (n, 2), mm."""
    swing = 2.0 * np.pi * time_s / period_s
    return np.column_stack([1.5 * np.sin(swing), 0.4 * np.cos(1.3 * swing)])


def straight(time_s: Float64) -> Float64:
    return np.zeros((len(time_s), 2))


def fitted(
    motion: Callable[[Float64], Float64], frames_s: Float64 = FRAMES_S, seam_mm: float = 0.4
) -> PoseDelay:
    """Return the delay of a level tool's recording: a seam that wanders, seen by a pinhole."""
    draw = np.random.default_rng(2)
    y_z = motion(frames_s)
    station = SPEED_MM_S * frames_s + SHEET_MM
    seam = np.column_stack([seam_mm * np.sin(station / 25.0), np.zeros(len(station))])
    seen = seam - y_z + NOISE_MM * draw.standard_normal(y_z.shape)
    points = np.column_stack([np.full(len(seen), SHEET_MM), seen])
    camera = SETUP.camera
    x, y, z = ((points - camera.T_tool_camera[:3, 3]) @ camera.T_tool_camera[:3, :3]).T
    image = np.column_stack([camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy])
    poses_s = np.arange(0.0, frames_s[-1] + 1.0, 0.008)
    T = np.tile(np.eye(4), (len(poses_s), 1, 1))
    T[:, 0, 3] = SPEED_MM_S * poses_s
    T[:, 1:3, 3] = motion(poses_s) + 0.01 * draw.standard_normal((len(poses_s), 2))
    track = PoseTrack.through(poses_s + DELAY_S, T)
    variances = np.full(y_z.shape, NOISE_MM**2)
    return fit_pose_delay(
        SETUP, SeamObservations(image, frames_s, variances, (track.at_time,) * len(image)), track
    )


@pytest.mark.slow
def test_a_weave_tells_the_delay_within_its_sigma() -> None:
    result = fitted(weaving)
    assert result.unestimated is None
    assert abs(result.delay_s - DELAY_S) < 3.5 * result.sigma_s
    # Cramer and Rao for a straight seam: noise over sideways and upward speed.
    speed = np.gradient(weaving(np.arange(0.0, 5.0, 0.01)), 0.01, axis=0)
    min_s = NOISE_MM / np.sqrt(len(FRAMES_S) * np.mean(np.sum(speed**2, axis=1)))
    assert 0.9 * min_s < result.sigma_s < 2.0 * min_s
    assert result.ln_likelihood.max() == 0.0
    assert result.delays_s[np.argmax(result.ln_likelihood)] == result.delay_s


@pytest.mark.slow
def test_a_straight_travel_tells_nothing_and_says_what_is_missing() -> None:
    result = fitted(straight)
    assert result.unestimated is not None
    assert "the motion is too weak" in result.unestimated
    assert "weave it sideways" in result.unestimated
    assert result.sigma_s > 0.02


@pytest.mark.slow
def test_a_weave_that_repeats_within_the_bounds_leaves_two_answers() -> None:
    # A fast even weave: the delay and the delay less a period are the same motion.
    result = fitted(lambda time_s: np.column_stack([np.sin(2.0 * np.pi * time_s / 0.4), 0.0 * time_s]))
    assert result.unestimated is not None
    assert "the motion repeats" in result.unestimated


def test_too_few_frames_are_refused() -> None:
    with pytest.raises(ValueError, match="the seam is seen in 5 frames with a pose, 8 are needed"):
        fitted(weaving, FRAMES_S[:5])


def test_a_track_is_linear_between_poses_and_stands_at_its_ends() -> None:
    T = np.tile(np.eye(4), (2, 1, 1))
    T[1, :3, 3] = 4.0, 2.0, 0.0
    T[1, :3, :3] = Rotation.from_euler("z", 2.0, degrees=True).as_matrix()
    track = PoseTrack.through(np.array([1.0, 2.0]), T)
    assert np.allclose(track.at_time(1.25)[:3, 3], [1.0, 0.5, 0.0])
    turn = Rotation.from_matrix(track.at_time(1.25)[:3, :3]).as_euler("xyz", degrees=True)
    assert np.allclose(turn, [0.0, 0.0, 0.5], atol=1e-5)
    assert np.array_equal(track.at_time(0.0), track.at_time(1.0))
    assert np.array_equal(track.at_time(9.0), track.at_time(2.0))
    assert track.covers(np.array([0.9, 1.0, 2.1])).tolist() == [False, True, False]


def test_smoothing_takes_jitter_off_and_leaves_the_weave() -> None:
    draw = np.random.default_rng(1)
    times_s = np.arange(0.0, 3.0, 0.008)
    T = np.tile(np.eye(4), (len(times_s), 1, 1))
    swing = 2.0 * np.sin(2.0 * np.pi * times_s)
    T[:, 1, 3] = swing + 0.02 * draw.standard_normal(len(times_s))
    smooth = PoseTrack.through(times_s, T).smooth()
    inner = slice(30, -30)
    off = smooth.numbers[inner, 1] - 2.0 * np.sin(2.0 * np.pi * smooth.times_s[inner])
    assert float(np.sqrt(np.mean(off**2))) < 0.4 * 0.02
    slow = replace(smooth, times_s=smooth.times_s[::20], numbers=smooth.numbers[::20])
    assert slow.smooth() is slow
