"""Picture of a frame for browsers: the image, its measurements, the profile, the arc's expected light.

This is the page's heavy work; it runs in a thread of its own.
"""

import json
import math
import struct
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from arctrack.live.journal.records import Entry, FrameView
from arctrack.replay.pages.drawing_spool import ReplayedFrame
from arctrack.replay.pages.view import Profile, ReplayView, Viewer
from noise_model.arc.map import arc_kernel
from noise_model.arc.scene import Scene, make_scene
from noise_model.compiled.arrays import Float32, Float64, UInt8
from noise_model.setup import Setup
from noise_model.transforms import invert, transform
from tracker import flags
from tracker.checks import FrameChecks
from tracker.geometry import SensorGeometry
from tracker.observation import Reading, expected_output, shows_arc
from tracker.stripe.read import arc_map_of

MAX_WIDTH_PX, JPEG_QUALITY = 960, 80
MAX_POINTS = 320
"""Largest number of points of a line: a screen shows no more."""

PICTURE, HEAT = 1, 2
"""The first byte of a binary message says what follows."""


@dataclass(frozen=True, eq=False)
class MonitorPicture:
    """A frame for the page: its position among the entries, its message, its JPEG alone."""

    position: int
    message: bytes
    jpeg: bytes


class RunViewers:
    """Viewers of a run's frames, with the setup of each job; another job's frames have the first one's."""

    def __init__(self, setups: Mapping[int, Setup]) -> None:
        self._setups = setups
        self._viewers: dict[int, Viewer] = {}

    def viewer(self, job_number: int) -> Viewer:
        """Return the viewer of a job."""
        if job_number not in self._viewers:
            setup = self._setups.get(job_number, next(iter(self._setups.values())))
            self._viewers[job_number] = Viewer(SensorGeometry.of(setup), None)
        return self._viewers[job_number]

    def view(self, entry: Entry, view: FrameView) -> tuple[ReplayedFrame, ReplayView]:
        """Return an entry with its view as a replay has it, and its drawing without the arc's light."""
        viewer = self.viewer(entry.job_number)
        reading = _reading(viewer.geometry.setup, entry, view)
        seen = ReplayedFrame(entry.inputs.pose, view.track, reading, entry.offset, entry.took_ms)
        return seen, viewer.view(entry.frame, seen, shows_arc_light=False)


class Painter:
    """Renderer of frames for the page, with the setup of each job."""

    def __init__(self, setups: Mapping[int, Setup]) -> None:
        self._viewers = RunViewers(setups)

    def paint(self, entry: Entry, view: FrameView) -> MonitorPicture:
        """Return the picture of an entry with its view."""
        viewer = self._viewers.viewer(entry.job_number)
        _, shown = self._viewers.view(entry, view)
        assert shown.grey is not None
        jpeg = _jpeg(shown.grey)
        height, width = shown.grey.shape
        profile = shown.profile
        content = {
            "kind": "picture",
            "position": view.position,
            "frame": entry.frame.index,
            "width": width,
            "height": height,
            "job": entry.job_number,
            "stripe": _line(shown.stripe_px, 1),
            "expected": _line(shown.expected_px, 1),
            "corners": _line(_corners_px(viewer.geometry, profile), 1),
            "seam": None if shown.seam_px is None else _rounded(shown.seam_px, 1),
            "is_valid": view.track.valid,
            "profile": None if profile is None else _profile(profile),
            "flags": [flag.meaning for flag in flags.FLAGS if view.track.flags & flag.mask],
        }
        header = json.dumps(content, allow_nan=False).encode()
        message = struct.pack("<BxxxI", PICTURE, len(header)) + header + jpeg
        return MonitorPicture(view.position, message, jpeg)

    def heat(self, entry: Entry, view: FrameView) -> bytes:
        """Return a message with the light of the arc that is expected in an entry's frame."""
        geometry = self._viewers.viewer(entry.job_number).geometry
        # 80 cells along the image's longer side.
        spacing = max(1, round(max(geometry.n_scan, geometry.n_pos) / 80))
        picture = _heat_picture(geometry, spacing, self._heat_e(geometry, spacing, entry, view))
        height, width = entry.frame.image_dn.shape
        reach = (picture.shape[1] * spacing / width, picture.shape[0] * spacing / height)
        content = {"kind": "heat", "reach": reach, "is_lit": bool(picture[..., 3].any())}
        header = json.dumps(content).encode()
        png = cv2.imencode(".png", picture)[1].tobytes()
        return struct.pack("<BxxxI", HEAT, len(header)) + header + png

    def _heat_e(self, geometry: SensorGeometry, spacing: int, entry: Entry, view: FrameView) -> Float32:
        """Return the arc's light (n,) on a grid of pixels, e-; NaN where none is expected."""
        scan, position = geometry.lattice(spacing)
        reading = _reading(geometry.setup, entry, view)
        if reading is None or reading.scene.below_surface or not shows_arc(geometry.setup, entry.frame):
            return np.full(len(scan), np.nan, np.float32)
        kernel = arc_kernel(geometry.setup, reading.scene, expected_output(geometry.setup, entry.frame))
        light_e = arc_map_of(geometry, kernel).at(scan * geometry.n_pos + position)
        level = reading.arc.level if math.isfinite(reading.arc.level) else 1.0
        return np.asarray(level * light_e, np.float32)


def _reading(setup: Setup, entry: Entry, view: FrameView) -> Reading | None:
    """Return the look at a frame that its view was made of, None where none was taken."""
    pose = entry.inputs.pose
    if pose is None or view.seam is None or view.arc is None:
        return None
    scene: Scene = make_scene(setup, pose.T_base_tool, view.seam)
    return Reading(
        FrameChecks(), scene, view.seam, view.reach_mm, view.arc, stripe=view.track.stripe, joint=view.joint
    )


def _jpeg(grey: UInt8) -> bytes:
    height, width = grey.shape
    if width > MAX_WIDTH_PX:
        size = (MAX_WIDTH_PX, round(height * MAX_WIDTH_PX / width))
        grey = np.asarray(cv2.resize(grey, size, interpolation=cv2.INTER_AREA), np.uint8)
    encoded = cv2.imencode(".jpg", grey, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])[1]
    return bytes(encoded.tobytes())


def _profile(profile: Profile) -> dict[str, Any]:
    """Return a profile as the page draws it: (y, z) in the tool frame, mm."""
    step = -(-len(profile.points_mm) // MAX_POINTS)
    return {
        "points": _line(profile.points_mm[:, 1:], 3),
        "off": profile.off_section[:: max(1, step)].astype(int).tolist(),
        "section": _line(profile.section_mm[:, 1:], 3),
        "expected": _line(profile.expected_mm[:, 1:], 3),
    }


def _corners_px(geometry: SensorGeometry, profile: Profile | None) -> Float64:
    """Return the fitted section's corners in the image (k, 2)."""
    if profile is None or not len(profile.section_mm):
        return np.empty((0, 2))
    camera = geometry.setup.camera
    return np.asarray(camera.project(transform(invert(camera.T_tool_camera), profile.section_mm)))


def _heat_picture(geometry: SensorGeometry, spacing: int, light_e: Float32) -> UInt8:
    """Return light (n,) of a lattice as a picture (H, W, 4) BGRA: by the square root, as the image is."""
    shape = (len(range(spacing // 2, geometry.n_scan, spacing)), -1)
    image_e = light_e.reshape(shape)
    if geometry.along_rows:
        image_e = image_e.T
    share = np.sqrt(np.clip(np.nan_to_num(image_e) / geometry.setup.sensor.full_well_e, 0.0, 1.0))
    colours = cv2.applyColorMap((255 * share).astype(np.uint8), cv2.COLORMAP_INFERNO)
    # The most light is not quite opaque.
    return np.dstack([colours, (190 * share).astype(np.uint8)])


def _line(points: Float64, digits: int) -> list[float | None]:
    """Return points (n, 2) one number after the other, None where they are not known."""
    step = max(1, -(-len(points) // MAX_POINTS))
    return _rounded(points[::step].ravel(), digits)


def _rounded(values: npt.NDArray[np.float64], digits: int) -> list[float | None]:
    return [round(v, digits) if math.isfinite(v) else None for v in values.tolist()]
