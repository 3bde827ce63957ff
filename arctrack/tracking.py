"""The tracker of a recording."""

from __future__ import annotations

from arctrack.errors import in_file
from arctrack.recording import Recording
from tracker.tracker import Tracker


def tracker_of(recording: Recording, use_arc_map: bool) -> Tracker:
    """Return a tracker for a recording; ArctrackError if its setup's stripe is not in view."""
    try:
        return Tracker(recording.setup, use_arc_map, recording.correction)
    except ValueError as error:
        raise in_file(recording.setup_path, str(error)) from error
