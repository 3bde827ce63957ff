"""End of a recorded frame's exposure."""

from __future__ import annotations

from arctrack.recording.tables import FrameRow


def exposed_s(row: FrameRow) -> float:
    """Return a frame's end of exposure, s."""
    return row.timestamp_s + row.exposure_s / 2.0
