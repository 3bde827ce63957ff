"""overlay.mp4: every frame with what the tracker saw in it."""

import math
from fractions import Fraction
from pathlib import Path

import av
import cv2
import numpy as np

from arctrack.recording.ffv1 import VideoFile
from arctrack.report.image import annotate, frame_picture
from noise_model.compiled.arrays import UInt8
from noise_model.setup import Setup
from robot_io import SeamOffset, Validity
from tracker.state import Frame, Track

LINE_PX, LINES = 20, 3
PIXELS = "yuv420p"
"""Pixel format that every player knows; it halves both sides of its colour."""

INK, FAINT = (255, 255, 255), (160, 160, 160)


class OverlayVideo(VideoFile):
    """Writer of the video, picture by picture."""

    def __init__(self, path: Path, setup: Setup, rate_hz: float) -> None:
        rate = rate_hz if math.isfinite(rate_hz) else 10.0
        super().__init__(path, "libx264", Fraction(min(max(rate, 1.0), 60.0)).limit_denominator(1000))
        self._stream.width, self._stream.height = _size_px(setup)
        self._stream.pix_fmt = PIXELS
        self._stream.options = {"crf": "23", "preset": "veryfast"}

    def write(self, picture: UInt8) -> None:
        """Append what `picture_of` drew."""
        self._container.mux(self._stream.encode(av.VideoFrame.from_ndarray(picture, format=PIXELS)))


def picture_of(setup: Setup, frame: Frame | None, track: Track, offset: SeamOffset) -> UInt8:
    """Return the planes of a frame's picture in the video, those of a black one if it could not be read."""
    camera, zoom = setup.camera, _zoom(setup)
    if frame is None:
        picture = np.zeros((camera.height, camera.width, 3), dtype=np.uint8)
    else:
        picture = annotate(frame_picture(frame, setup), track, camera)
    if zoom > 1:
        picture = np.repeat(np.repeat(picture, zoom, axis=0), zoom, axis=1)
    width, height = _size_px(setup)
    canvas = np.zeros((height, width, 3), dtype=np.uint8)
    canvas[: picture.shape[0], : picture.shape[1]] = picture
    for n, (line, colour) in enumerate(zip(caption(frame, track, offset), (INK, INK, FAINT), strict=True)):
        corner = (8, picture.shape[0] + (n + 1) * LINE_PX - 2)
        cv2.putText(
            canvas, line, corner, cv2.FONT_HERSHEY_SIMPLEX, 0.5, colour, thickness=1, lineType=cv2.LINE_AA
        )
    drawn = av.VideoFrame.from_ndarray(canvas, format="bgr24").reformat(format=PIXELS)
    return np.asarray(drawn.to_ndarray(), dtype=np.uint8)


def caption(frame: Frame | None, track: Track, offset: SeamOffset) -> tuple[str, str, str]:
    """Return three lines: the frame's condition, seam and offset, flags."""
    condition = f"frame {track.frame}   t {track.timestamp_s:.3f} s"
    if frame is not None:
        lit = [name for name, on in (("laser", frame.laser_on), ("arc", frame.arc_on)) if on]
        current = f" {frame.current_a:.0f} A" if frame.arc_on and math.isfinite(frame.current_a) else ""
        condition += f"   {' + '.join(lit) or 'dark'}{current}   {1000 * frame.exposure_s:g} ms"
    seam = "seam unknown"
    if track.valid:
        seam = f"seam y {track.seam_tool_mm[1]:+.2f}  z {track.seam_tool_mm[2]:+.2f} mm"
    word = {Validity.VALID: "sent", Validity.HELD: "held"}.get(offset.validity)
    sent = "no offset"
    if word is not None:
        axes = (("y", offset.offset_y_mm), ("z", offset.offset_z_mm))
        known = "  ".join(f"{name} {value:+.2f}" for name, value in axes if math.isfinite(value))
        sent = f"offset {word} {known} mm"
    return condition, f"{seam}   {sent}", ", ".join(track.flag_names) or "no flags"


def _zoom(setup: Setup) -> int:
    return max(1, math.ceil(640 / setup.camera.width))


def _size_px(setup: Setup) -> tuple[int, int]:
    camera, zoom = setup.camera, _zoom(setup)
    return _even(camera.width * zoom), _even(camera.height * zoom + LINES * LINE_PX + 8)


def _even(size: int) -> int:
    return size + size % 2
