"""Times, rates, speeds and exposures of a recording, without its images."""

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from arctrack.recording import PoseTable, Recording
from arctrack.recording.files import FRAMES_CSV
from arctrack.recording.poses import COVERAGE_PERIODS
from noise_model.compiled.arrays import Bool, Float64

SPEEDS_MM_S = (0.1, 200.0)
"""A tool that moves at all moves neither more slowly nor faster."""

MAX_STEP_MM = 2.0
"""Largest step from pose to pose within which the tool's motion is taken as uniform."""

MAX_GAP_PERIODS = 4.0
"""A longer gap between two poses says nothing of the time between them."""

JUMP = 20.0
"""Ratio of a jump to the usual step between two poses; it also is longer than MAX_STEP_MM."""

MAX_EXPOSURE_RATIO = 50.0
"""A frame's exposure differs less from that of the setup."""

STILL_MM = 0.01
"""A tool that goes less far than this stands still."""


@dataclass(frozen=True)
class Timing:
    """Rates and speed, NaN where unknown, and what cannot be, a line each.

    `exposures_fit` says that those of the frames are about that of the setup.
    """

    frame_rate_hz: float
    pose_rate_hz: float
    speed_mm_s: float
    exposures_fit: bool
    warnings: tuple[str, ...]


def timing_of(recording: Recording) -> Timing:
    """Look at the times of frames and poses, at the tool's motion and at exposures."""
    poses = recording.poses
    frames_s = np.array([row.timestamp_s for row in recording.rows])
    odd = list(_exposures(recording))
    exposures_fit = not odd
    if len(poses.timestamps_s) < 2:
        odd.append(f"{poses.path}: holds a single pose; two are the least to work with")
        return Timing(recording.frame_rate_hz, math.nan, math.nan, exposures_fit, tuple(odd))
    steps_mm = np.linalg.norm(np.diff(poses.T_base_tool[:, :3, 3], axis=0), axis=1)
    speed_mm_s = float(np.median(steps_mm / np.diff(poses.timestamps_s)))
    odd += [*_coverage(poses, frames_s), *_speed(poses, speed_mm_s, steps_mm)]
    return Timing(recording.frame_rate_hz, 1.0 / poses.period_s, speed_mm_s, exposures_fit, tuple(odd))


def _uncovered(poses: PoseTable, frames_s: Float64) -> Bool:
    """Return which frames (n,) come before the second pose, too long after the last, or in a gap."""
    times_s, period_s = poses.timestamps_s, poses.period_s
    after = np.searchsorted(times_s, frames_s, side="right")
    within = np.clip(after, 1, len(times_s) - 1)
    gap_s = times_s[within] - times_s[within - 1]
    last_s = times_s[-1] + COVERAGE_PERIODS * period_s
    in_gap = (gap_s > MAX_GAP_PERIODS * period_s) & (after < len(times_s))
    return np.asarray((after < 2) | (frames_s > last_s) | in_gap)


def _coverage(poses: PoseTable, frames_s: Float64) -> Iterator[str]:
    uncovered = _uncovered(poses, frames_s)
    if uncovered.any():
        first_s, last_s = poses.timestamps_s[[0, -1]]
        yield (
            f"{poses.path}: {uncovered.sum()} of {len(frames_s)} frames have no pose: poses run from "
            f"{first_s:.3f} to {last_s:.3f} s, frames from {frames_s[0]:.3f} to {frames_s[-1]:.3f} s"
        )


def _speed(poses: PoseTable, speed_mm_s: float, steps_mm: Float64) -> Iterator[str]:
    low, high = SPEEDS_MM_S
    reach_mm = float(np.ptp(poses.T_base_tool[:, :3, 3], axis=0).max())
    if reach_mm > STILL_MM and not low <= speed_mm_s <= high:
        units = "places in m, or times in ms" if speed_mm_s < low else "times in another unit than s"
        yield f"{poses.path}: the tool moves at {speed_mm_s:.3g} mm/s; are {units}?"
    usual_mm = float(np.median(steps_mm))
    jumps = int((steps_mm > max(JUMP * usual_mm, MAX_STEP_MM)).sum())
    if jumps:
        yield (
            f"{poses.path}: {jumps} steps from pose to pose are over {JUMP:g} times the usual "
            f"{usual_mm:.3g} mm, up to {steps_mm.max():.3g} mm"
        )
    if usual_mm > MAX_STEP_MM:
        yield (
            f"{poses.path}: from pose to pose, {poses.period_s:.3g} s, the tool goes {usual_mm:.3g} mm; "
            "record poses more often"
        )


def _exposures(recording: Recording) -> Iterator[str]:
    rows, camera_s = recording.rows, recording.setup.camera.exposure_s
    frames_s = np.array([row.timestamp_s for row in rows])
    apart_s = float(np.median(np.diff(frames_s))) if len(rows) > 1 else math.inf
    usual_s = float(np.median([row.exposure_s for row in rows]))
    frames_csv = recording.path / FRAMES_CSV
    ratio = usual_s / camera_s
    is_too_long = usual_s > apart_s
    if not 1.0 / MAX_EXPOSURE_RATIO < ratio < MAX_EXPOSURE_RATIO:
        # What is longer than the time from frame to frame cannot be; else frames.csv is taken to be right.
        wrong = f"{frames_csv}: exposure_s" if is_too_long else f"{recording.setup_path}: [camera] exposure_s"
        yield (
            f"{wrong}: exposures are {usual_s:g} s in frames.csv, {camera_s:g} s in [camera], a ratio of "
            f"{ratio:.3g}; give seconds"
        )
    elif is_too_long:
        yield (
            f"{frames_csv}: exposure_s = {usual_s:g} is longer than from frame to frame, {apart_s:.3g} s; "
            "give seconds"
        )
