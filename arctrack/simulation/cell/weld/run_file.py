"""A closed loop's run as a table, a row for each frame."""

import csv
from collections.abc import Sequence
from pathlib import Path

from arctrack.output import writing
from arctrack.simulation.cell.weld.closed_loop import LoopFrame

RUN_CSV = "run.csv"
COLUMNS = (
    "time_s",
    "station_mm",
    "seam_y_mm",
    "seam_z_mm",
    "torch_y_mm",
    "torch_z_mm",
    "across_mm",
    "offset_y_mm",
    "offset_z_mm",
    "lag_s",
    "lag_sigma_s",
    "lead_mm",
    "validity",
    "reason",
    "flags",
)
"""Time and place are those at which a frame's offset was sent; `across_mm` is the torch with its weave.

`lag_s` is nan while it is unestimated.
"""


def write_run(path: Path, frames: Sequence[LoopFrame]) -> None:
    """Write a run's frames; ArctrackError if the file cannot be written."""
    with writing(path), path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(COLUMNS)
        for frame in frames:
            sample, offset = frame.sample, frame.offset
            numbers = (
                sample.time_s,
                sample.station_mm,
                *sample.seam_mm,
                *sample.torch_mm,
                sample.across_mm,
                offset.offset_y_mm,
                offset.offset_z_mm,
                frame.lag.lag_s,
                frame.lag.sigma_s,
                frame.look_ahead.way_mm,
            )
            names = (offset.validity.name, frame.reason.name, " ".join(frame.track.flag_names))
            writer.writerow([*(f"{number:.4f}" for number in numbers), *names])
