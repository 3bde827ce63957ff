"""How far a gap moves the seam: what the tracker finds, against where all of the images say the seam is."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from noise_model.setup import Setup
from sim_to_real.expected import BOUNCING, Effects, Expected
from sim_to_real.nuisances import really_there
from sim_to_real.observed import PoseAt
from sim_to_real.refit import Refit
from tracker.state import Frame
from tracker.step import Tracker


def seam_error_mm(
    setup: Setup,
    effects: Effects,
    frames: Sequence[Frame],
    pose_at: PoseAt,
    expected: Expected,
    best: Refit,
) -> float:
    """Return the rms distance, mm, of the tracker's seam from the best fit's; NaN where it sees none.

    The tracker takes the camera and black level of that fit, and the effects given: so that what remains is
    what those effects do to it. Light that bounces is left out: seconds for each frame, it is no light to
    track by.
    """
    known = {name: values for name, values in effects.items() if name != BOUNCING}
    taken = replace(really_there(setup, best.nuisance), effects={**setup.effects, **known})
    tracker = Tracker(taken)
    for frame in frames:
        if frame.laser_on:
            tracker.step(frame, pose_at(frame.timestamp_s))
    history = tracker.state.history
    if len(history) == 0:
        return float("nan")
    seam = expected.curve(best.effects)
    y_z, _ = seam.at(expected.seam_coefficients(best.nuisance))
    true = np.column_stack([np.interp(history.stations_mm, seam.stations_mm, of) for of in y_z])
    return float(np.sqrt(np.mean(np.sum((history.displacements_mm - true) ** 2, axis=1))))
