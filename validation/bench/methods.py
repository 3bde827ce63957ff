"""Methods in the benchmark: the interface of one, arctrack's own, and how a stripe's readers find a seam."""

from __future__ import annotations

import importlib
import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Protocol

import cv2
import numpy as np
from scipy.ndimage import median_filter

from arctrack.errors import ArctrackError
from noise_model.compiled.arrays import Float64, Integers
from noise_model.setup import Setup
from noise_model.transforms import transform
from tracker.state import Frame, Pose
from tracker.tracker import Tracker
from validation.bench.scenes import BenchScene

NOTHING_MM = np.full(3, math.nan)


@dataclass(frozen=True)
class MethodReading:
    """What a method says of a frame; whatever it does not say is NaN.

    `stripe_px` (n,) is the stripe in each scan line and `stripe_sigma_px` (n,) its 1 sigma, px; `seam_mm`
    (3,) the seam in the tool frame, `seam_sigma_mm` (2,) the 1 sigmas of its y and z, mm. The seam may be
    used if it `is_valid`.
    """

    stripe_px: Float64 | None = None
    stripe_sigma_px: Float64 | None = None
    seam_mm: Float64 = field(default_factory=lambda: NOTHING_MM)
    seam_sigma_mm: Float64 | None = None
    is_valid: bool = False


class Method(Protocol):
    """A method: told of a scene, then asked about each of its frames in turn."""

    def begin(self, scene: BenchScene) -> None:
        """Get ready for a scene; of its truth a method may take the first frame's seam, and say so."""

    def read(self, image: Integers, frame: Frame, pose: Pose) -> MethodReading:
        """Read a frame. The stripe in `image` runs from left to right: a scan line is a column."""


StripeReader = Callable[[Integers, float], Float64]
"""An image (H, W) and the stripe's sigma, px, in; the stripe's row in each column (W,) out, NaN for none."""

CORNERS = ("v_groove", "half_v", "fillet", "outside_corner")
"""Joints whose seam is a corner of their section."""

FAR_PX = 2.0
"""A corner is so far off the straight line between the stripe's ends, in sigmas of the stripe, at least."""


class FromStripe:
    """A stripe's reader. Where the seam is a corner, it is the place farthest off the line between the ends.

    Douglas and Peucker 1973, Cartographica 10(2) 112. Of other joints it says no seam.
    """

    def __init__(self, reader: StripeReader) -> None:
        self._reader = reader

    def begin(self, scene: BenchScene) -> None:
        """Take the stripe's width, and the setup to triangulate with."""
        self._scene = scene

    def read(self, image: Integers, frame: Frame, pose: Pose) -> MethodReading:
        """Read the stripe, and the corner of it."""
        rows = self._reader(image, self._scene.width_px)
        is_corner = self._scene.setup.joint.type in CORNERS
        corner = corner_of(rows, FAR_PX * self._scene.width_px) if is_corner else None
        if corner is None:
            return MethodReading(rows)
        column, row = corner
        pixel = (column, row) if self._scene.along_rows else (row, column)
        return MethodReading(rows, seam_mm=on_sheet(self._scene.setup, np.array(pixel)), is_valid=True)


def corner_of(rows: Float64, far_px: float) -> tuple[float, float] | None:
    """Return column and row of the point farthest off the chord of a stripe (n,), None below `far_px`.

    Rows are medians of five neighbours: one line that is wrong is no corner.
    """
    columns = np.flatnonzero(np.isfinite(rows))
    if len(columns) < 10:
        return None
    smooth = median_filter(rows[columns], 5, mode="nearest")
    chord = np.interp(columns, columns[[0, -1]], smooth[[0, -1]])
    off = np.abs(smooth - chord)
    far = int(np.argmax(off))
    return None if off[far] < far_px else (float(columns[far]), float(smooth[far]))


def on_sheet(setup: Setup, pixel: Float64) -> Float64:
    """Return where a pixel's ray meets the laser sheet (3,), mm, tool frame."""
    x, y = setup.camera.normalised(pixel[np.newaxis])[0]
    eye = setup.camera.T_tool_camera[:3, 3]
    ray = transform(setup.camera.T_tool_camera, np.array([x, y, 1.0])) - eye
    plane = setup.laser.plane
    return np.asarray(eye - ray * (plane[:3] @ eye + plane[3]) / (plane[:3] @ ray))


class Arctrack:
    """arctrack's tracker, as a replay runs it; `use_arc_map` says whether it predicts the arc's light."""

    def __init__(self, use_arc_map: bool = True) -> None:
        self._use_arc_map = use_arc_map

    def begin(self, scene: BenchScene) -> None:
        """Build the tracker of the scene's setup."""
        self._tracker = Tracker(scene.setup, use_arc_map=self._use_arc_map)

    def read(self, image: Integers, frame: Frame, pose: Pose) -> MethodReading:
        """Track the frame."""
        track = self._tracker.step(frame, pose)
        stripe, sigma = track.stripe, np.array([track.sigma_y_mm, track.sigma_z_mm])
        return MethodReading(
            None if stripe is None else stripe.position_px,
            None if stripe is None else stripe.sigma_px,
            np.asarray(track.seam_tool_mm),
            sigma,
            track.valid,
        )


class PatchTracker:
    """A tracker of the seam's patch, told where it is in the first frame, and a Kalman filter behind it.

    The filter has a constant velocity in the image (Kalman 1960, J. Basic Eng. 82, 35). The patch is followed
    by normalised correlation (Lewis 1995, Vision Interface, 120), or by a kernelised correlation filter
    (Henriques et al. 2015, IEEE TPAMI 37(3) 583).
    """

    PATCH_SIGMAS = 8.0
    """Half the patch's side, in sigmas of the stripe."""

    def __init__(self, kernelised: bool) -> None:
        self._kernelised = kernelised

    def begin(self, scene: BenchScene) -> None:
        """Take the first frame's seam, which this method has to be told."""
        first = scene.frames[0].seam_px
        self._scene = scene
        self._start = first if scene.along_rows else first[::-1]
        self._half = max(round(self.PATCH_SIGMAS * scene.width_px), 8)
        self._is_started = False

    def read(self, image: Integers, frame: Frame, pose: Pose) -> MethodReading:
        """Follow the patch into the frame."""
        if not np.isfinite(self._start).all():
            return MethodReading()
        grey = cv2.normalize(image, np.empty(0), 0, 255, cv2.NORM_MINMAX).astype(np.uint8)
        if not self._is_started:
            self._is_started = True
            place: Float64 | None = self._begun(grey)
        else:
            place = self._followed(grey)
        if place is None:
            return MethodReading()
        pixel = place if self._scene.along_rows else place[::-1]
        return MethodReading(seam_mm=on_sheet(self._scene.setup, pixel), is_valid=True)

    def _begun(self, grey: Integers) -> Float64:
        u, v = np.round(self._start).astype(int).tolist()
        self._aside = self._start - (u, v)
        half, (height, width) = self._half, grey.shape
        low_u, low_v = max(u - half, 0), max(v - half, 0)
        box = low_u, low_v, min(u + half + 1, width) - low_u, min(v + half + 1, height) - low_v
        self._centre = np.array([u - low_u, v - low_v], dtype=np.float64)
        if self._kernelised:
            self._kcf = cv2.TrackerKCF.create()
            self._kcf.init(cv2.cvtColor(grey, cv2.COLOR_GRAY2BGR), box)
        else:
            self._patch = grey[box[1] : box[1] + box[3], box[0] : box[0] + box[2]].copy()
        self._filter = cv2.KalmanFilter(4, 2)
        self._filter.transitionMatrix = np.array(
            [[1, 0, 1, 0], [0, 1, 0, 1], [0, 0, 1, 0], [0, 0, 0, 1]], np.float32
        )
        self._filter.measurementMatrix = np.eye(2, 4, dtype=np.float32)
        self._filter.processNoiseCov = np.diag([0.25, 0.25, 1.0, 1.0]).astype(np.float32)
        self._filter.measurementNoiseCov = np.eye(2, dtype=np.float32)
        self._filter.errorCovPost = np.diag([1.0, 1.0, 25.0, 25.0]).astype(np.float32)
        self._filter.statePost = np.array([*self._start, 0.0, 0.0], np.float32).reshape(4, 1)
        return self._start

    def _followed(self, grey: Integers) -> Float64 | None:
        predicted = self._filter.predict()[:2, 0]
        if self._kernelised:
            is_found, box = self._kcf.update(cv2.cvtColor(grey, cv2.COLOR_GRAY2BGR))
            if not is_found:
                return None
            corner = np.array(box[:2], dtype=np.float64)
        else:
            reach = 2 * self._half
            low = np.maximum(np.round(predicted - self._centre).astype(int) - reach, 0)
            high = low + np.array(self._patch.shape[::-1]) + 2 * reach
            window = grey[low[1] : high[1], low[0] : high[0]]
            if any(w < p for w, p in zip(window.shape, self._patch.shape, strict=True)):
                return None
            likeness = cv2.matchTemplate(window, self._patch, cv2.TM_CCOEFF_NORMED)
            corner = low + np.array(cv2.minMaxLoc(likeness)[3], dtype=np.float64)
        measured = (corner + self._centre + self._aside).astype(np.float32).reshape(2, 1)
        return np.asarray(self._filter.correct(measured)[:2, 0], dtype=np.float64)


def method_named(text: str) -> Method:
    """Return a stranger's method, named as `module:function`: a function of image and width, or a class."""
    module, _, name = text.partition(":")
    try:
        named = getattr(importlib.import_module(module), name)
    except (ImportError, AttributeError, ValueError) as error:
        raise ArctrackError(f"--method {text}: {error}; give MODULE:NAME, such as mine:read") from None
    method: Method = named() if isinstance(named, type) else FromStripe(named)
    return method
