"""Displacement of the seam by a gap: the tracker's seam against that of a fit to all images."""

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from noise_model.effects import Effects, pose_time_s
from noise_model.setup import Setup
from sim_to_real.data.binned import PoseAt
from sim_to_real.fit.gauss_newton import Refit
from sim_to_real.fit.linearized_model import INTERREFLECTION, LinearizedModel
from sim_to_real.fit.nuisances import N_LEVELS, apply_nuisances
from tracker.state import Frame
from tracker.tracker import Tracker


class SeamErrors(NamedTuple):
    """Rms distances of the tracker's seam from a fit's, mm: of a tracker without its effects, and with."""

    lateral_mm: tuple[float, float]
    vertical_mm: tuple[float, float]

    @property
    def total_mm(self) -> tuple[float, float]:
        """Both axes together."""
        before, after = map(math.hypot, self.lateral_mm, self.vertical_mm)
        return before, after


UNKNOWN_ERRORS = SeamErrors((math.nan, math.nan), (math.nan, math.nan))
"""The errors of a seam that nobody looked at."""


def seam_errors_mm(
    setup: Setup, frames: Sequence[Frame], pose_at: PoseAt, model: LinearizedModel, best: Refit
) -> SeamErrors:
    """Return the errors of the tracker's seam against the best fit's; NaN where it sees none.

    The first are of a tracker without the fit's effects: they are what these do to the seam. The second are
    of a tracker with them. Both have the fit's camera and black level. Bounced light is left out: it takes
    seconds for each frame.
    """
    known = {name: values for name, values in best.effects.items() if name != INTERREFLECTION}
    off_mm = _rms_errors_mm(setup, {}, frames, pose_at, model, best)
    known_mm = _rms_errors_mm(setup, known, frames, pose_at, model, best) if known else off_mm
    lateral_mm, vertical_mm = zip(off_mm, known_mm, strict=True)
    return SeamErrors(lateral_mm, vertical_mm)


def _rms_errors_mm(
    setup: Setup,
    known: Effects,
    frames: Sequence[Frame],
    pose_at: PoseAt,
    model: LinearizedModel,
    best: Refit,
) -> tuple[float, float]:
    """Return the rms errors across the seam, y and z, mm."""
    assumed = replace(apply_nuisances(setup, best.nuisance), effects={**setup.effects, **known})
    tracker = Tracker(assumed)
    for frame in frames:
        if frame.laser_on:
            # Before the first pose and after the last one the frame's own pose is taken.
            pose = pose_at(pose_time_s(assumed, frame.timestamp_s)) or pose_at(frame.timestamp_s)
            tracker.step(frame, pose)
    history = tracker.state.history
    if history.n == 0:
        return math.nan, math.nan
    seam = model.renderings.seam_curve(best.effects)
    y_z, _ = seam.evaluate(best.nuisance[N_LEVELS:])
    true = np.column_stack(
        [np.interp(history.stations_mm, seam.stations_mm, displacement) for displacement in y_z]
    )
    y_mm, z_mm = np.sqrt(np.mean((history.displacements_mm - true) ** 2, axis=0)).tolist()
    return y_mm, z_mm
