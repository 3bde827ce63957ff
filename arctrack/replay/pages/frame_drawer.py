"""A frame of a replay drawn: its picture in the video, what the page shows of it, its view for exports."""

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from arctrack.recording import Truth
from arctrack.replay.pages.drawing_spool import ReplayedFrame
from arctrack.replay.pages.overlay import picture_of
from arctrack.replay.pages.view import Profile, ReplayView, Viewer
from arctrack.report.data_uri import uri
from arctrack.report.image import jpeg, shrunk
from noise_model.compiled.arrays import Float64, UInt8
from noise_model.setup import Setup
from tracker.geometry import SensorGeometry
from tracker.state import Frame


@dataclass(frozen=True, eq=False)
class ToDraw:
    """A frame, None if it could not be read, what was seen of it, and what is to be drawn."""

    frame: Frame | None
    seen: ReplayedFrame
    in_video: bool
    on_page: bool
    exported: bool


@dataclass(frozen=True, eq=False)
class Drawn:
    """Drawn parts of a frame, None for those that were not requested.

    `picture` has the planes of the video's picture, `shown` is for the page, `view` is for exports.
    """

    picture: UInt8 | None
    shown: dict[str, Any] | None
    view: ReplayView | None


@dataclass(frozen=True, eq=False)
class FrameDrawer:
    """Renderer of single frames of a recording, in any order, in any process."""

    setup: Setup
    truth: Truth | None

    def __call__(self, asked: ToDraw) -> Drawn:
        """Draw a frame."""
        frame, seen = asked.frame, asked.seen
        view = self._viewer.view(frame, seen) if asked.on_page or asked.exported else None
        return Drawn(
            picture_of(self.setup, frame, seen.track, seen.offset) if asked.in_video else None,
            view_json(view) if view is not None and asked.on_page else None,
            view if asked.exported else None,
        )

    @cached_property
    def _viewer(self) -> Viewer:
        return Viewer(SensorGeometry.of(self.setup), self.truth)


FRAME_PX, MAP_PX = 640, 320
"""Pictures are shrunk to about these widths."""

MAX_LINES, MAX_POINTS = 400, 400
"""Largest number of the stripe's scan lines, and of a profile's points, on the page."""


def view_json(view: ReplayView) -> dict[str, Any]:
    """Return a view for the page: image points in tenths of a px, points in the laser plane in um."""
    step = max(1, math.ceil(len(view.stripe_px) / MAX_LINES))
    return {
        "frame": None if view.grey is None else _picture(view.grey, FRAME_PX),
        "arc": None if view.arc_grey is None else _picture(view.arc_grey, MAP_PX),
        "stripe": points_json(view.stripe_px[::step], 10.0),
        "saturated": np.flatnonzero(view.saturated[::step]).tolist(),
        "expected": points_json(view.expected_px[:: 2 * step], 10.0),
        "seam": None if view.seam_px is None else points_json(view.seam_px[None], 10.0)[0],
        "truth": None if view.truth_px is None else points_json(view.truth_px[None], 10.0)[0],
        "profile": None if view.profile is None else _profile_json(view.profile),
    }


def _profile_json(profile: Profile) -> dict[str, Any]:
    step = max(1, math.ceil(len(profile.points_mm) / MAX_POINTS))
    return {
        "points": points_json(profile.points_mm[::step, 1:], 1000.0),
        "off": np.flatnonzero(profile.off_section[::step]).tolist(),
        "section": points_json(profile.section_mm[:, 1:], 1000.0),
        "expected": points_json(profile.expected_mm[:, 1:], 1000.0),
    }


def points_json(points: Float64, scale: float) -> list[list[int] | None]:
    """Return points (n, 2) as whole numbers of a smaller unit, None where one is not known."""
    known = np.isfinite(points.sum(axis=1))
    whole = np.rint(np.where(known[:, None], points, 0.0) * scale).astype(int)
    listed: list[list[int] | None] = whole.tolist()
    for n in np.flatnonzero(~known):
        listed[n] = None
    return listed


def _picture(grey: UInt8, width_px: int) -> str:
    return uri("image/jpeg", jpeg(shrunk(grey, max(1, math.ceil(grey.shape[1] / width_px)))))
