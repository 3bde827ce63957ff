"""Place of the seam relative to its nominal line: in numbers, in words, and whether it is sought there."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from arctrack.recording import Recording
from noise_model.surface.joint import seam_frame, seam_height_mm
from noise_model.transforms import invert, transform
from tracker.geometry import SEARCH_REACH_MM
from tracker.state import Track


class SeamPlace(NamedTuple):
    """Lateral and vertical distance of a seam from its nominal place, left and up, mm; NaN where unknown."""

    y_mm: float
    z_mm: float

    @property
    def is_beyond_search(self) -> bool:
        """True if it lies farther off than a seam is sought.

        The image is searched by pixels: where height moves the stripe little, they reach farther in mm.
        """
        return max(abs(self.y_mm), abs(self.z_mm)) > SEARCH_REACH_MM

    def __str__(self) -> str:
        side = "left" if self.y_mm > 0.0 else "right"
        height = "above" if self.z_mm > 0.0 else "below"
        return (
            f"{abs(self.y_mm):.1f} mm to the {side} of its nominal line, {abs(self.z_mm):.1f} mm {height} it"
        )


UNKNOWN_PLACE = SeamPlace(math.nan, math.nan)


def seam_place(recording: Recording, tracks: Sequence[Track]) -> SeamPlace:
    """Return the median place of the seam in the valid tracks of a recording."""
    joint, poses, places = recording.setup.joint, recording.pose_buffer(), []
    for track in tracks:
        pose = recording.pose_at(poses, track.timestamp_s) if track.valid else None
        if pose is not None:
            seam = transform(pose.T_base_tool, np.array(track.seam_tool_mm))
            places.append(transform(invert(seam_frame(joint, seam)), seam)[1:])
    if not places:
        return UNKNOWN_PLACE
    y_mm, z_mm = np.median(places, axis=0).tolist()
    return SeamPlace(y_mm, z_mm - seam_height_mm(joint))
