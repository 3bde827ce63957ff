"""arctrack meets the world: recordings, replay, pictures and the command line.

The names below are loaded when they are first used, so that `import arctrack` costs nothing.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from arctrack.errors import ArctrackError as ArctrackError
    from arctrack.live.cameras.profile_message import pack_profile as pack_profile
    from arctrack.nominal import nominal_setup as nominal_setup
    from arctrack.recording import BadFrame as BadFrame
    from arctrack.recording import Recording as Recording
    from arctrack.recording import RecordingWriter as RecordingWriter
    from arctrack.recording import read_recording as read_recording
    from arctrack.recording import read_setup_file as read_setup_file
    from arctrack.recording import read_truth as read_truth
    from arctrack.replay.replay import ReplayOptions as ReplayOptions
    from arctrack.replay.replay import replay_recording as replay_recording
    from arctrack.simulation.simulate import SimulationPlan as SimulationPlan
    from arctrack.simulation.simulate import simulate_recording as simulate_recording
    from arctrack.version import __version__ as __version__
    from noise_model.setup import Setup as Setup
    from tracker.state import Frame as Frame
    from tracker.state import Pose as Pose
    from tracker.state import Track as Track
    from tracker.tracker import Tracker as Tracker

_HOME_OF = {
    "ArctrackError": "arctrack.errors:ArctrackError",
    "BadFrame": "arctrack.recording:BadFrame",
    "Frame": "tracker.state:Frame",
    "Pose": "tracker.state:Pose",
    "Recording": "arctrack.recording:Recording",
    "RecordingWriter": "arctrack.recording:RecordingWriter",
    "ReplayOptions": "arctrack.replay.replay:ReplayOptions",
    "Setup": "noise_model.setup:Setup",
    "SimulationPlan": "arctrack.simulation.simulate:SimulationPlan",
    "Track": "tracker.state:Track",
    "Tracker": "tracker.tracker:Tracker",
    "nominal_setup": "arctrack.nominal:nominal_setup",
    "pack_profile": "arctrack.live.cameras.profile_message:pack_profile",
    "read_recording": "arctrack.recording:read_recording",
    "read_setup_file": "arctrack.recording:read_setup_file",
    "read_truth": "arctrack.recording:read_truth",
    "replay_recording": "arctrack.replay.replay:replay_recording",
    "simulate_recording": "arctrack.simulation.simulate:simulate_recording",
    "__version__": "arctrack.version:__version__",
}

__all__ = sorted(_HOME_OF)


def __getattr__(name: str) -> Any:
    home = _HOME_OF.get(name)
    if home is None:
        raise AttributeError(f"module 'arctrack' has no attribute {name!r}")
    module, _, attribute = home.partition(":")
    return getattr(import_module(module), attribute)


def __dir__() -> list[str]:
    return sorted({*globals(), *_HOME_OF})
