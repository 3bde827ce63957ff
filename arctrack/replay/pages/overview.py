"""overview.png: a whole replay on one page."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from arctrack.output import writing
from arctrack.recording import Recording, Truth
from arctrack.recording.score import errors_mm, score
from arctrack.report import style
from arctrack.report.image import frame_picture, seam_point_px, stripe_points_px
from noise_model.setup import Setup
from robot_io import SeamOffset, Validity
from tracker import flags
from tracker.state import Frame, Track

TIME = "time [s]"


@dataclass
class Overview:
    """Content of the overview, collected while a replay runs."""

    recording: Recording
    tracks: list[Track] = field(default_factory=list)
    offsets: list[SeamOffset] = field(default_factory=list)
    sample: tuple[Frame, Track] | None = None

    def add(self, frame: Frame | None, track: Track, offset: SeamOffset) -> None:
        """Take a frame, None if it could not be read; the one shown is valid and near the middle."""
        # Only the frame that is shown keeps its stripe: a long replay's would fill the memory.
        self.tracks.append(replace(track, stripe=None, checks=()))
        self.offsets.append(offset)
        first_half = len(self.tracks) <= (len(self.recording.rows) + 1) // 2
        if frame is not None and track.valid and (self.sample is None or (first_half and frame.arc_on)):
            self.sample = (frame, track)

    def save(self, path: Path, truth: Truth | None, counts: str) -> None:
        """Draw the page, entitled with the run's counts in words; ArctrackError if it cannot be written."""
        with writing(path):
            draw(self, truth, counts).savefig(path)


def draw(overview: Overview, truth: Truth | None, counts: str) -> Figure:
    """Return the page; `truth` is drawn and scored against where it is known."""
    tracks = overview.tracks
    figure = style.new_figure(13.0, 9.5, _title(overview, truth, counts))
    grid = figure.add_gridspec(4, 2, width_ratios=(1.25, 1.0))
    seam_axes = figure.add_subplot(grid[0, 0])
    _seam(seam_axes, tracks, truth, 1, "seam y, to the left, tool frame [mm]")
    _seam(figure.add_subplot(grid[1, 0], sharex=seam_axes), tracks, truth, 2, "seam z, up, tool frame [mm]")
    if truth is not None:
        _errors(figure.add_subplot(grid[2, 0], sharex=seam_axes), tracks, truth, overview.recording.setup)
    else:
        _confidence(figure.add_subplot(grid[2, 0], sharex=seam_axes), tracks)
    _arc(figure.add_subplot(grid[3, 0], sharex=seam_axes), tracks)
    _sample(figure.add_subplot(grid[0:2, 1]), overview)
    _offsets(figure.add_subplot(grid[2, 1], sharex=seam_axes), tracks, overview.offsets)
    _flags(figure.add_subplot(grid[3, 1], sharex=seam_axes), tracks)
    return figure


def _title(overview: Overview, truth: Truth | None, counts: str) -> str:
    tracks = overview.tracks
    text = f"{overview.recording.name}: {counts}"
    limit_mm = overview.recording.setup.tolerance.seam_mm
    scored = None if truth is None else score(tracks, truth, limit_mm)
    if scored is None:
        return text
    lateral, vertical = scored.lateral, scored.vertical
    return (
        f"{text}; RMS error {lateral.whole.rms:.3f} mm lateral, {vertical.whole.rms:.3f} mm vertical "
        f"(constant part removed: {lateral.without_constant.rms:.3f}, {vertical.without_constant.rms:.3f})"
    )


def _seam(axes: Axes, tracks: Sequence[Track], truth: Truth | None, axis: int, label: str) -> None:
    style.plain(axes, "", "mm", label)
    valid = [track for track in tracks if track.valid]
    if truth is not None:
        time_of = {track.frame: track.timestamp_s for track in tracks}
        shown = [n for n, frame in enumerate(truth.frames) if int(frame) in time_of]
        times_s = [time_of[int(truth.frames[n])] for n in shown]
        axes.plot(times_s, truth.seam_tool_mm[shown, axis], color=style.BLACK, linewidth=1, label="true")
    if valid:
        times = np.array([track.timestamp_s for track in valid])
        seam = np.array([track.seam_tool_mm[axis] for track in valid])
        sigma = np.array([track.sigma_y_mm if axis == 1 else track.sigma_z_mm for track in valid])
        axes.fill_between(
            times,
            seam - sigma,
            seam + sigma,
            color=style.SKY,
            alpha=0.3,
            lw=0,
            label="±1 σ, with calibration",
        )
        axes.plot(times, seam, "o", color=style.BLUE, markersize=4, label="measured")
    if valid or truth is not None:
        axes.legend(fontsize=8, loc="best", framealpha=0.8)


def _errors(axes: Axes, tracks: Sequence[Track], truth: Truth, setup: Setup) -> None:
    style.plain(axes, "", "mm", "measured − true")
    limit = setup.tolerance.seam_mm
    axes.axhspan(-limit, limit, color=style.GREEN, alpha=0.08, lw=0, label=f"±{limit:g} mm tolerance")
    axes.axhline(0.0, color=style.BLACK, linewidth=0.8)
    times = np.array([track.timestamp_s for track in tracks])
    errors = errors_mm(tracks, truth)
    axes.plot(times, errors[:, 0], "o", color=style.BLUE, markersize=4, label="lateral")
    axes.plot(times, errors[:, 1], "s", color=style.VERMILLION, markersize=4, label="vertical")
    axes.legend(fontsize=8, loc="best", ncols=3, framealpha=0.8)


def _confidence(axes: Axes, tracks: Sequence[Track]) -> None:
    style.plain(axes, "", "probability", "confidence that both errors stay in tolerance")
    valid = [track for track in tracks if track.valid]
    times = [track.timestamp_s for track in valid]
    axes.plot(times, [t.confidence for t in valid], "o", color=style.BLUE, markersize=4)
    axes.set_ylim(0.0, 1.02)


def _arc(axes: Axes, tracks: Sequence[Track]) -> None:
    style.plain(axes, TIME, "ratio", "arc level over the expected, and misfit of the arc map")
    times = [track.timestamp_s for track in tracks]
    axes.axhline(1.0, color=style.BLACK, linewidth=0.8)
    axes.plot(times, [t.arc_level for t in tracks], "o", color=style.ORANGE, markersize=4, label="arc level")
    axes.plot(times, [t.map_misfit for t in tracks], "x", color=style.GREY, markersize=5, label="map misfit")
    axes.set_ylim(bottom=0.0)
    axes.legend(fontsize=8, loc="best", ncols=2, framealpha=0.8)


def _sample(axes: Axes, overview: Overview) -> None:
    axes.set_title("no valid frame", loc="left", fontsize=10)
    axes.set_axis_off()
    if overview.sample is None:
        return
    frame, track = overview.sample
    setup = overview.recording.setup
    axes.set_axis_on()
    axes.set_title(
        f"frame {frame.index} at {frame.timestamp_s:.2f} s, brightness by √", loc="left", fontsize=10
    )
    axes.imshow(frame_picture(frame, setup), cmap="gray", vmin=0, vmax=255, interpolation="nearest")
    if track.stripe is not None:
        x, y = stripe_points_px(track.stripe).T
        axes.plot(x, y, ".", color=style.ORANGE, markersize=1.2, label="fitted stripe")
    point = seam_point_px(track, setup.camera)
    if point is not None:
        axes.plot(*point, "+", color=style.SKY, markersize=16, markeredgewidth=2, label="seam")
    axes.set_xlabel("column [px]")
    axes.set_ylabel("row [px]")
    axes.legend(fontsize=8, loc="upper right", markerscale=1.0, framealpha=0.8)


def _offsets(axes: Axes, tracks: Sequence[Track], offsets: Sequence[SeamOffset]) -> None:
    style.plain(axes, "", "mm", "offset on the bus (hollow: held)")
    axes.axhline(0.0, color=style.BLACK, linewidth=0.8)
    for validity, face in ((Validity.VALID, None), (Validity.HELD, "none")):
        chosen = [n for n, offset in enumerate(offsets) if offset.validity is validity]
        times = [tracks[n].timestamp_s for n in chosen]
        named = validity is Validity.VALID
        for name, marker, colour in (("y", "o", style.BLUE), ("z", "s", style.VERMILLION)):
            values = [getattr(offsets[n], f"offset_{name}_mm") for n in chosen]
            label = f"{name}" if named else None
            axes.plot(
                times, values, marker, color=colour, markerfacecolor=face or colour, markersize=4, label=label
            )
    axes.legend(fontsize=8, loc="best", ncols=2, framealpha=0.8)


def _flags(axes: Axes, tracks: Sequence[Track]) -> None:
    style.plain(axes, TIME, "", "flags (vermillion: the frame's seam is not used)")
    raised = [flag for flag in flags.FLAGS if any(track.flags & flag.mask for track in tracks)]
    for row, flag in enumerate(raised):
        times = [track.timestamp_s for track in tracks if track.flags & flag.mask]
        colour = style.VERMILLION if flag.invalidates else style.BLUE
        axes.plot(times, np.full(len(times), row), "|", color=colour, markersize=9, markeredgewidth=2)
    axes.set_yticks(range(len(raised)), [flag.name for flag in raised], fontsize=8)
    axes.set_ylim(len(raised) - 0.4, -0.6)
