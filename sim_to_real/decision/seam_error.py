"""How far a gap moves the seam: what the tracker finds, against where all of the images say the seam is."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from noise_model.effects import pose_time_s
from noise_model.setup import Setup
from sim_to_real.data.binned import PoseAt
from sim_to_real.fit.gauss_newton import Refit
from sim_to_real.fit.linearized_model import BOUNCING, Effects, Expected
from sim_to_real.fit.nuisances import really_there
from tracker.state import Frame
from tracker.tracker import Tracker


def seam_errors_mm(
    setup: Setup, frames: Sequence[Frame], pose_at: PoseAt, expected: Expected, best: Refit
) -> tuple[float, float]:
    """Return the rms distance, mm, of the tracker's seam from the best fit's; NaN where it sees none.

    First of a tracker that takes the camera and black level of that fit and knows nothing of its effects,
    then of one that knows them: the first is what those effects do to it. Light that bounces is left out:
    seconds for each frame, it is no light to track by.
    """
    known = {name: values for name, values in best.effects.items() if name != BOUNCING}
    off_mm = _seam_error_mm(setup, {}, frames, pose_at, expected, best)
    return off_mm, _seam_error_mm(setup, known, frames, pose_at, expected, best) if known else off_mm


def _seam_error_mm(
    setup: Setup,
    known: Effects,
    frames: Sequence[Frame],
    pose_at: PoseAt,
    expected: Expected,
    best: Refit,
) -> float:
    taken = replace(really_there(setup, best.nuisance), effects={**setup.effects, **known})
    tracker = Tracker(taken)
    for frame in frames:
        if frame.laser_on:
            # By its own clock; before the first pose and after the last one the frame's stands.
            pose = pose_at(pose_time_s(taken, frame.timestamp_s)) or pose_at(frame.timestamp_s)
            tracker.step(frame, pose)
    history = tracker.state.history
    if len(history) == 0:
        return float("nan")
    seam = expected.curve(best.effects)
    y_z, _ = seam.at(expected.seam_coefficients(best.nuisance))
    true = np.column_stack([np.interp(history.stations_mm, seam.stations_mm, of) for of in y_z])
    return float(np.sqrt(np.mean(np.sum((history.displacements_mm - true) ** 2, axis=1))))
