"""All numbers of a frame by their names, for pages and exports."""

import math

from arctrack.replay.pages.drawing_spool import ReplayedFrame
from noise_model.compiled.arrays import Float64
from robot_io import Validity
from tracker.state import Frame

MEANINGS = {
    "time_s": "mid-exposure, s, on the recording's clock",
    "seam_x_mm": "the seam point, tool frame, along the travel",
    "seam_y_mm": "the seam point, tool frame, to the left of the travel",
    "seam_z_mm": "the seam point, tool frame, away from the work",
    "sigma_y_mm": "1 sigma of seam_y_mm, of measurement and calibration",
    "sigma_z_mm": "1 sigma of seam_z_mm, of measurement and calibration",
    "true_y_mm": "the true seam point of truth.csv, tool frame, to the left",
    "true_z_mm": "the true seam point of truth.csv, tool frame, away from the work",
    "offset_y_mm": "the offset that went to the bus, to the left",
    "offset_z_mm": "the offset that went to the bus, up",
    "proposed_y_mm": "the offset that the tracker proposed, to the left",
    "proposed_z_mm": "the offset that the tracker proposed, up",
    "proposed_sigma_y_mm": "1 sigma of proposed_y_mm",
    "proposed_sigma_z_mm": "1 sigma of proposed_z_mm",
    "gap_mm": "the joint's gap across the seam",
    "mismatch_mm": "height of the joint's left side less that of its right side",
    "confidence": "probability that both errors are below the setup's tolerance",
    "arc_level": "the arc's output over what the setup expects",
    "arc_level_sigma": "1 sigma of arc_level",
    "arc_height_mm": "the height of the arc's centre above the surface",
    "arc_height_sigma_mm": "1 sigma of arc_height_mm",
    "map_misfit": "residual of the arc map over its stated uncertainty",
    "fov_margin_mm": "distance of the seam from the nearer end of the profile",
    "compute_ms": "from the decoded frame and its pose to the track",
    "current_a": "the welding current",
    "exposure_ms": "the frame's exposure",
}
"""Each number's name, unit included, and what it is."""


def numbers(frame: Frame | None, seen: ReplayedFrame, true_mm: Float64 | None) -> dict[str, float]:
    """Return a frame's numbers by the names of `MEANINGS`, NaN where one is not known.

    `frame` is None where it could not be read, `true_mm` (3,) where no truth is known.
    """
    track, offset = seen.track, seen.offset
    x, y, z = track.seam_tool_mm
    values = (
        track.timestamp_s,
        *(x, y, z),
        *(track.sigma_y_mm, track.sigma_z_mm),
        *((math.nan, math.nan) if true_mm is None else true_mm[1:]),
        *(offset.offset_y_mm, offset.offset_z_mm),
        *(track.offset_y_mm, track.offset_z_mm),
        *(track.offset_sigma_y_mm, track.offset_sigma_z_mm),
        *(track.gap_mm, track.mismatch_mm),
        track.confidence,
        *(track.arc_level, track.arc_level_sigma),
        *seen.arc_height_mm,
        track.map_misfit,
        track.fov_margin_mm,
        seen.compute_ms,
        *((math.nan, math.nan) if frame is None else (frame.current_a, 1000.0 * frame.exposure_s)),
    )
    return {name: float(value) for name, value in zip(MEANINGS, values, strict=True)}


def on_bus(seen: ReplayedFrame) -> str:
    """Return what became of a frame's offset on the bus: `sent`, `held` or `none`."""
    return {Validity.VALID: "sent", Validity.HELD: "held"}.get(seen.offset.validity, "none")
