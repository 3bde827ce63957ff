"""Recordings of the example's sensor with a coarse camera: quick to simulate, to render and to diagnose."""

from dataclasses import replace
from pathlib import Path
from unittest.mock import patch

import numpy as np

from arctrack.recording import pose_at, read_recording
from arctrack.simulate import SimulationPlan, simulate_recording
from sim_to_real.data.binned import observe
from sim_to_real.fit.linearized_model import LinearizedModel
from tracker.seam_observations import SeamObservations

EXAMPLE = Path(__file__).parents[2] / "examples" / "v_groove"
SMALL = 6
"""By so much the example's camera is coarser here."""

SMOOTH = {"laser_speckle": {"contrast": 0.0}}

EXACT = SimulationPlan(frames=12, seam_wander_mm=0.0, exact=True)
"""A run in which all is as stated."""


def example_setup(coarser=SMALL):
    setup = read_recording(EXAMPLE).setup
    return replace(setup, camera=setup.camera.coarser(coarser))


def recorded(path, effects, plan=EXACT, coarser=SMALL):
    """Simulate a recording with hidden effects; what `diagnose` takes of it: setup, frames and pose_at.

    These effects are all that there are: the laser does not speckle.
    """
    simulate_recording(path, example_setup(coarser), plan, hidden_effects={**SMOOTH, **effects})
    recording = read_recording(path)
    poses = recording.pose_buffer()
    return recording.setup, list(recording.frames()), lambda t: pose_at(poses, t)


def small_recording(path, effects, coarser=SMALL, stated=None):
    """The model held against such a recording, its setup stating effects; the seam is taken as nominal."""
    in_joint = SeamObservations.in_joint

    def nominal(sightings, setup):
        stations, displacements = in_joint(sightings, setup)
        return stations, np.zeros_like(displacements)

    # Not the tracker's own error with so coarse a camera is looked at: a bin at an edge would show it.
    with patch.object(SeamObservations, "in_joint", nominal):
        setup, frames, pose_at = recorded(path, effects, coarser=coarser)
        observed = observe(replace(setup, effects=stated or {}), frames, pose_at)
    expected = LinearizedModel(observed)
    return expected.anchored_at(expected.neutral, {})


def of_stratum(expected, stratum):
    """The model of a recording's frames of one kind."""
    chosen = np.array([frame.stratum == stratum for frame in expected.observed.frames])
    some = LinearizedModel(expected.observed.subset(chosen))
    return some.anchored_at(some.neutral, {})
