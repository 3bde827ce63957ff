"""Recordings of the example's sensor with a coarse camera: quick to simulate, to render and to diagnose."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from arctrack.recording import pose_at, read_recording
from arctrack.simulation.simulate import SimulationPlan, simulate_recording
from sim_to_real.data.binned import observe_along
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
    setup, frames, pose_at = recorded(path, effects, coarser=coarser)
    return held_against(replace(setup, effects=stated or {}), frames, pose_at)


class OnNominalSeam(SeamObservations):
    """Sightings of a seam that lies where the setup says."""

    def in_joint(self, setup):
        stations, displacements = super().in_joint(setup)
        return stations, np.zeros_like(displacements)


def held_against(setup, frames, pose_at):
    """The model held against frames; the seam is taken as nominal.

    Not the tracker's own error with so coarse a camera is looked at: a bin at an edge would show it.
    """
    poses = [
        lambda t, frame=frame: (pose_at(t) or pose_at(frame.timestamp_s)).T_base_tool for frame in frames
    ]
    sightings = SeamObservations.of(setup, frames, poses)
    nominal = OnNominalSeam(**vars(sightings))
    observed = observe_along(setup, frames, poses, nominal, frames[0].timestamp_s)
    expected = LinearizedModel(replace(observed, seam_observations=sightings))
    return expected.anchored_at(expected.neutral, {})


def of_stratum(expected, stratum):
    """The model of a recording's frames of one kind."""
    chosen = np.array([frame.stratum == stratum for frame in expected.observed.frames])
    some = LinearizedModel(expected.observed.subset(chosen))
    return some.anchored_at(some.neutral, {})
