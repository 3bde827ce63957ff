"""replay.rrd: a replay for Rerun's viewer, in space and over time."""

from __future__ import annotations

import math
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from PIL.ImageColor import getrgb

from arctrack.recording import Recording
from arctrack.replay.pages.drawing_spool import ReplayedFrame
from arctrack.replay.pages.numbers import numbers
from arctrack.replay.pages.view import ReplayView, chosen, stretches
from arctrack.report import style
from arctrack.report.image import jpeg
from noise_model.compiled.arrays import Float64, UInt8
from tracker import flags
from tracker.state import Frame

TOOL, CAMERA = "base/tool", "base/tool/camera"
"""Places of tool and camera in the tree; lengths in space are mm."""

ARC_MAP, FLAGS, SETUP = "arc_map", "flags", "setup"

SERIES = {
    "seam/y": ("seam_y_mm", style.BLUE),
    "seam/z": ("seam_z_mm", style.VERMILLION),
    "seam/true_y": ("true_y_mm", style.SKY),
    "seam/true_z": ("true_z_mm", style.ORANGE),
    "sigma/y": ("sigma_y_mm", style.BLUE),
    "sigma/z": ("sigma_z_mm", style.VERMILLION),
    "offset/y": ("offset_y_mm", style.BLUE),
    "offset/z": ("offset_z_mm", style.VERMILLION),
    "arc/level": ("arc_level", style.BLUE),
    "arc/height": ("arc_height_mm", style.GREEN),
    "arc/misfit": ("map_misfit", style.VERMILLION),
    "confidence": ("confidence", style.BLUE),
}
"""The numbers over time: where each stands in the tree, its name and its colour."""

LINE_PX, POINT_PX = 0.8, 4.0
"""Half the width of lines and points on the screen."""


class RrdFile:
    """Writer of an RRD file, frame by frame; the context's end completes it.

    Its timelines are `frame` and `time`, s. What a frame does not have is cleared, for the viewer would go on
    showing the last.
    """

    def __init__(self, path: Path, recording: Recording) -> None:
        self._stream = rr.RecordingStream("arctrack")
        self._stream.save(path, default_blueprint=_blueprint())
        self._stream.send_recording_name(recording.name)
        self._flags = -1
        setup = recording.setup_path.read_text(encoding="utf-8")
        self._static(SETUP, rr.TextDocument(f"```toml\n{setup}\n```", media_type="text/markdown"))
        camera = recording.setup.camera
        pinhole = rr.Pinhole(
            image_from_camera=camera.matrix + np.array([[0.0, 0.0, 0.5], [0.0, 0.0, 0.5], [0.0, 0.0, 0.0]]),
            resolution=[camera.width, camera.height],
            camera_xyz=rr.ViewCoordinates.RDF,
            image_plane_distance=60.0,
        )
        self._static(CAMERA, pinhole)
        self._static(CAMERA, _transform(camera.T_tool_camera))
        for place, (name, colour) in SERIES.items():
            # The viewer's ground is dark; what is true is a thin line through the points.
            series = rr.SeriesLines if name.startswith("true") else rr.SeriesPoints
            self._static(place, series(colors=getrgb(colour), names=name))

    def add(
        self, frame: Frame | None, seen: ReplayedFrame, view: ReplayView, true_mm: Float64 | None
    ) -> None:
        """Append a frame, None if it could not be read."""
        track = seen.track
        self._stream.set_time("frame", sequence=track.frame)
        self._stream.set_time("time", duration=track.timestamp_s)
        self._log(f"{CAMERA}/image", _image(view.grey))
        self._log(ARC_MAP, _image(view.arc_grey))
        self._log(f"{CAMERA}/image/expected", _lines(view.expected_px, style.SKY, 1))
        self._log(f"{CAMERA}/image/stripe", _lines(view.stripe_px, style.ORANGE, 2))
        saturated_px = chosen(view.stripe_px, view.saturated)
        self._log(f"{CAMERA}/image/saturated", _lines(saturated_px, style.VERMILLION, 3))
        self._log(f"{CAMERA}/image/seam", _point(view.seam_px, style.YELLOW))
        self._log(f"{CAMERA}/image/true_seam", _point(view.truth_px, style.GREEN))
        if seen.pose is not None:
            self._log(TOOL, _transform(seen.pose.T_base_tool))
        profile, points, section = view.profile, None, None
        if profile is not None:
            points = rr.Points3D(profile.points_mm, colors=getrgb(style.GREY), radii=0.1)
            section = rr.LineStrips3D([profile.section_mm], colors=getrgb(style.GREEN), radii=0.05)
        self._log(f"{TOOL}/profile", points)
        self._log(f"{TOOL}/section", section if profile is not None and len(profile.section_mm) else None)
        seam_mm = None if math.isnan(track.seam_tool_mm[1]) else track.seam_tool_mm
        self._log(
            f"{TOOL}/seam",
            None if seam_mm is None else rr.Points3D([seam_mm], colors=getrgb(style.BLUE), radii=0.5),
        )
        values = numbers(frame, seen, true_mm)
        for place, (name, _) in SERIES.items():
            if math.isfinite(values[name]):
                self._log(place, rr.Scalars(values[name]))
        if track.flags != self._flags:
            self._flags = track.flags
            level = "ERROR" if track.flags & flags.INVALIDATING else "WARN" if track.flags else "INFO"
            self._log(FLAGS, rr.TextLog(", ".join(track.flag_names) or "no flags", level=level))

    def _log(self, place: str, what: Any | None) -> None:
        self._stream.log(place, rr.Clear(recursive=False) if what is None else what)

    def _static(self, place: str, what: Any) -> None:
        self._stream.log(place, what, static=True)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stream.disconnect()


def _blueprint() -> rrb.Blueprint:
    """Return how the viewer arranges it at first: pictures and space to the left, series to the right."""
    pictures = rrb.Horizontal(
        rrb.Spatial2DView(origin=f"{CAMERA}/image", name="frame"),
        rrb.Spatial2DView(origin=ARC_MAP, name="the arc's light, predicted"),
    )
    space = rrb.Spatial3DView(origin="base", name="in space, mm")
    series = [
        rrb.TimeSeriesView(origin="seam", name="seam, tool frame, mm"),
        rrb.TimeSeriesView(origin="offset", name="offset on the bus, mm"),
        rrb.TimeSeriesView(origin="arc", name="arc level and map misfit"),
        rrb.TextLogView(origin=FLAGS, name="flags"),
    ]
    return rrb.Blueprint(rrb.Horizontal(rrb.Vertical(pictures, space), rrb.Vertical(*series)))


def _image(grey: UInt8 | None) -> Any | None:
    return None if grey is None else rr.EncodedImage(contents=jpeg(grey), media_type="image/jpeg")


def _lines(points_px: Float64, colour: str, order: int) -> Any | None:
    # Rerun counts from the corner of the first pixel, arctrack from its middle.
    strips = [stretch + 0.5 for stretch in stretches(points_px)]
    if not strips:
        return None
    return rr.LineStrips2D(
        strips, colors=getrgb(colour), radii=rr.Radius.ui_points(LINE_PX), draw_order=float(order)
    )


def _point(point_px: Float64 | None, colour: str) -> Any | None:
    if point_px is None:
        return None
    return rr.Points2D([point_px + 0.5], colors=getrgb(colour), radii=rr.Radius.ui_points(POINT_PX))


def _transform(T_parent_child: Float64) -> Any:
    return rr.Transform3D(translation=T_parent_child[:3, 3], mat3x3=T_parent_child[:3, :3])
