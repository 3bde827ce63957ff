"""A closed loop's run as a table of its frames, and as a picture of seam, torch and offsets over time."""

import csv
import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes

from arctrack.output import writing
from arctrack.report.style import BLACK, BLUE, GREEN, GREY, ORANGE, SKY, VERMILLION, new_figure, plain
from arctrack.simulation.cell.weld.closed_loop import ClosedLoop, ClosedLoopResult, LoopFrame
from robot_io import Validity

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


RUN_PICTURE = "run.png"
VALIDITY_COLOURS = {Validity.VALID: GREEN, Validity.HELD: ORANGE, Validity.REFUSED: VERMILLION}
AXES = ("across, y", "height, z")


def draw_run(path: Path, loop: ClosedLoop, result: ClosedLoopResult) -> None:
    """Draw a run; ArctrackError if the file cannot be written."""
    plan = loop.plan
    title = (
        f"Closed loop on a {plan.joint}, seam displaced by {plan.displaced_mm:+g} mm, "
        f"{plan.speed_mm_s:g} mm/s, weave {plan.weave_mm:g} mm at {plan.weave_hz:g} Hz, seed {plan.seed}"
    )
    if plan.event is not None:
        title += f"\n{plan.event.replace('_', ' ')}"
    figure = new_figure(11.0, 9.0, title)
    axes = figure.subplots(4, 1, sharex=True, height_ratios=(3, 2, 2, 0.7))
    for n in range(2):
        _draw_axis(axes[n], loop, n)
    _draw_error(axes[2], loop, result)
    _draw_validity(axes[3], loop.frames)
    for panel in axes:
        if math.isfinite(result.lock_s):
            panel.axvline(result.lock_s, color=GREY, linestyle="--", linewidth=1.0)
    axes[0].legend(loc="best", fontsize=8)
    with writing(path):
        figure.savefig(path)


def _draw_axis(axes: Axes, loop: ClosedLoop, n: int) -> None:
    times_s = [sample.time_s for sample in loop.samples]
    if n == 0:
        across_mm = [sample.across_mm for sample in loop.samples]
        axes.plot(times_s, across_mm, color=SKY, linewidth=0.6, label="torch with its weave")
    axes.plot(times_s, [s.seam_mm[n] for s in loop.samples], color=BLACK, linewidth=2.0, label="true seam")
    axes.plot(times_s, [s.torch_mm[n] for s in loop.samples], color=BLUE, label="torch without its weave")
    offsets = [(f.offset.offset_y_mm, f.offset.offset_z_mm)[n] for f in loop.frames]
    sent_s = [frame.sample.time_s for frame in loop.frames]
    axes.plot(sent_s, offsets, ".", color=VERMILLION, markersize=3, label="offset sent")
    plain(axes, "", "mm", AXES[n])


def _draw_error(axes: Axes, loop: ClosedLoop, result: ClosedLoopResult) -> None:
    times_s = [sample.time_s for sample in loop.samples]
    for n, colour in enumerate((BLUE, ORANGE)):
        off_mm = [sample.torch_mm[n] - sample.seam_mm[n] for sample in loop.samples]
        axes.plot(times_s, off_mm, color=colour, label=AXES[n])
    largest_mm = 2.0 * result.max_mm if math.isfinite(result.max_mm) else 1.0
    axes.set_ylim(-largest_mm, largest_mm)
    title = (
        f"torch off the seam; behind the dashed line {result.rms_mm:.3f} mm RMS, {result.max_mm:.3f} mm max"
    )
    plain(axes, "", "mm", title)
    axes.legend(loc="upper right", fontsize=8)


def _draw_validity(axes: Axes, frames: Sequence[LoopFrame]) -> None:
    times_s = np.array([frame.sample.time_s for frame in frames])
    for validity, colour in VALIDITY_COLOURS.items():
        is_of_kind = np.array([frame.offset.validity is validity for frame in frames])
        if is_of_kind.any():
            axes.plot(times_s[is_of_kind], np.zeros(is_of_kind.sum()), "|", color=colour, label=validity.name)
    axes.set_yticks([])
    plain(axes, "time, s", "", "validity")
    axes.legend(loc="upper right", fontsize=8, ncols=3)
