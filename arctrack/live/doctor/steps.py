"""Step times of the tracker on this machine, on frames rendered from the setup itself."""

import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from arctrack.live.serve.latency import LatencyCounts, Quantiles
from noise_model.arc.scene import make_scene
from noise_model.condition import Condition
from noise_model.drawn_profile import draw_profile
from noise_model.forward import draw_frame
from noise_model.surface.joint import seam_frame
from tracker.state import Frame, Pose
from tracker.tracker import Tracker
from tracker.tracker_state import TrackerMemory

FRAMES = 8
SPACING_MM = 1.0

OnDone = Callable[[int], None]
"""Callback with the number of frames and steps done."""


class NotCompiledError(Exception):
    """A function that a step may need is not on disk."""


@dataclass(frozen=True)
class StepTimes:
    """Durations of tracker steps with a known seam, and of the first, searching step of a new tracker.

    `valid_share` is the share of the drawn frames with a valid track.
    """

    tracked: Quantiles
    searched: Quantiles
    valid_share: float


def require_compiled(tracker: Tracker) -> None:
    """Load all that a step may need; NotCompiledError for what would have to be compiled."""

    def refuse(function: str, *_: object) -> None:
        raise NotCompiledError(function)

    tracker.warm_up(refuse)


def time_steps(tracker: Tracker, steps: int, on_done: OnDone) -> StepTimes:
    """Draw frames along the nominal seam, and time a warm tracker on them; its state is not touched.

    `on_done` is called with the number of frames drawn and steps taken so far.
    """
    shown = []
    for index, pose in enumerate(_poses(tracker)):
        shown.append((_frame(tracker, index, pose), pose))
        on_done(index + 1)
    before = tracker.state
    tracked, searched, valid = LatencyCounts(), LatencyCounts(), 0
    try:
        for n in range(steps):
            frame, pose = shown[n % FRAMES]
            is_first = n % FRAMES == 0
            if is_first:
                tracker.state = TrackerMemory()
            began_s = time.perf_counter()
            track = tracker.step(frame, pose)
            (searched if is_first else tracked).add(time.perf_counter() - began_s)
            valid += track.valid
            on_done(FRAMES + n + 1)
    finally:
        tracker.state = before
    return StepTimes(tracked.quantiles(), searched.quantiles(), valid / steps)


def _poses(tracker: Tracker) -> list[Pose]:
    """Return poses of a torch upright over the middle of the nominal seam's first segment."""
    joint = tracker.geometry.setup.joint
    start, end = np.asarray(joint.seam_in_base_mm, dtype=np.float64)[:2]
    direction = (end - start) / np.linalg.norm(end - start)
    poses = []
    for n in range(FRAMES):
        point_base_mm = 0.5 * (start + end) + SPACING_MM * n * direction
        T_base_tool = seam_frame(joint, point_base_mm)
        T_base_tool[:3, 3] = point_base_mm
        poses.append(Pose(T_base_tool))
    return poses


def _frame(tracker: Tracker, index: int, pose: Pose) -> Frame:
    setup = tracker.geometry.setup
    exposure_s, rng = setup.camera.exposure_s, np.random.default_rng(index)
    if setup.profiler is None:
        image = draw_frame(setup, pose.T_base_tool, Condition(1.0, 1.0, exposure_s), rng)
    else:
        image = draw_profile(setup, make_scene(setup, pose.T_base_tool), rng)
    return Frame(index, 0.04 * index, image, exposure_s, setup.arc.current_a)
