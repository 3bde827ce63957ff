"""View of a replayed frame: pictures, stripe and seam in the image, profile and section; and its drawings."""

import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from arctrack.recording import Truth
from arctrack.replay.arc_light import arc_light
from arctrack.replay.pages.drawing_spool import ReplayedFrame
from arctrack.replay.pages.overlay import picture_of
from arctrack.report.image import frame_picture, jpeg, project_tool_point, shrunk, uri, visible
from noise_model.arc.map import arc_kernel
from noise_model.arc.scene import Scene
from noise_model.compiled.arrays import Bool, Float64, UInt8
from noise_model.instrument.sensor import respond
from noise_model.setup import Setup
from noise_model.surface.joint import corrugation_height
from noise_model.transforms import invert, transform
from tracker.geometry import SensorGeometry, meet_laser_plane, to_laser_plane
from tracker.joint.measured import off_section
from tracker.observation import Reading, expected_output, transmission_of
from tracker.profile import lines_of, triangulate
from tracker.state import SCAN, Y_MM, Frame, Stripe
from tracker.stripe.expected import expect_stripe

NO_POINTS, NO_LINES = np.empty((0, 3)), np.zeros(0, dtype=bool)


@dataclass(frozen=True, eq=False)
class Profile:
    """Points (n, 3) in the laser plane, mm, tool frame.

    `off_section` (n,) marks those off the fitted section; `section_mm` and `expected_mm` (k, 3) are the
    corners of the fitted section and of the expected one.
    """

    points_mm: Float64
    off_section: Bool
    section_mm: Float64
    expected_mm: Float64


@dataclass(frozen=True, eq=False)
class ReplayView:
    """A frame for people; image points are x, y in px.

    `grey` and `arc_grey` (H, W) are the frame and the light that is expected without the laser, on one scale;
    None where there is none. `stripe_px` and `expected_px` (n_scan, 2) are the fitted stripe and the expected
    one by scan line, NaN where there is none; `saturated` (n_scan,) says where pixels were censored.
    `seam_px` is the seam point that was measured, used or not, `truth_px` the true one.
    """

    grey: UInt8 | None
    arc_grey: UInt8 | None
    stripe_px: Float64
    saturated: Bool
    expected_px: Float64
    seam_px: Float64 | None
    truth_px: Float64 | None
    profile: Profile | None


class Viewer:
    """Maker of the views of a recording's frames, for the setup that its tracker had."""

    def __init__(self, geometry: SensorGeometry, truth: Truth | None) -> None:
        self.geometry, self.truth_mm = geometry, truth_by_frame(truth)

    def view(self, frame: Frame | None, seen: ReplayedFrame, shows_arc_light: bool = True) -> ReplayView:
        """Return the view of a frame, None if it could not be read.

        The light that is expected over the whole image takes most of the time; it can be left out.
        """
        geometry, track, reading = self.geometry, seen.track, seen.reading
        camera = geometry.setup.camera
        nowhere = np.full((geometry.n_scan, 2), np.nan)
        true_mm = self.truth_mm.get(track.frame)
        empty = ReplayView(
            grey=None if frame is None else frame_picture(frame, geometry.setup),
            arc_grey=None,
            stripe_px=nowhere,
            saturated=np.zeros(geometry.n_scan, dtype=bool),
            expected_px=nowhere,
            # Where a seam was found is shown of a frame that is refused, too.
            seam_px=project_tool_point(np.asarray(track.seam_tool_mm), camera),
            truth_px=None if true_mm is None else project_tool_point(true_mm, camera),
            profile=None,
        )
        if frame is None or reading is None or reading.scene.below_surface:
            return empty
        seen_so_far = empty
        if shows_arc_light and geometry.setup.profiler is None:
            seen_so_far = replace(empty, arc_grey=self._arc_grey(frame, reading))
        expected = expect_stripe(geometry, reading.scene)
        if expected is None:
            return seen_so_far
        lines = np.arange(geometry.n_scan, dtype=np.float64)
        inside = (expected.shown_px >= 0.0) & (expected.shown_px < geometry.n_pos)
        expected_px = geometry.image_points(lines, np.where(inside, expected.shown_px, np.nan))
        seen_so_far = replace(seen_so_far, expected_px=expected_px)
        stripe = track.stripe
        if stripe is None:
            return seen_so_far
        return replace(
            seen_so_far,
            stripe_px=geometry.image_points(lines, stripe.position_px),
            saturated=np.asarray(stripe.saturated, dtype=bool),
            profile=self._profile(reading, stripe, expected.bias_px),
        )

    def _arc_grey(self, frame: Frame, reading: Reading) -> UInt8:
        """Return the light that is expected without the laser, at the arc's level in the frame, as grey."""
        geometry = self.geometry
        output = expected_output(geometry.setup, frame)
        kernel = arc_kernel(geometry.setup, reading.scene, output)
        transmission = transmission_of(geometry, reading.scene, frame)
        _, mean_e = arc_light(geometry, kernel, transmission, reading.arc)
        image_e = mean_e.T if geometry.along_rows else mean_e
        sensor = geometry.setup.sensor
        return visible(np.clip(respond(np.nan_to_num(image_e), sensor), 0.0, sensor.max_dn), sensor)

    def _profile(self, reading: Reading, stripe: Stripe, bias_px: Float64) -> Profile | None:
        geometry, scene, joint = self.geometry, reading.scene, reading.joint
        centre_px = stripe.position_px - bias_px
        points = triangulate(geometry.stripe_source, scene, lines_of(stripe, bias_px)).points
        if not points.size:
            return None
        scan = points[SCAN]
        centres_px = geometry.image_points(scan, centre_px[scan.astype(np.int64)])
        points_mm, _ = to_laser_plane(geometry.setup, centres_px)
        ends_mm = float(points[Y_MM, 0]), float(points[Y_MM, -1])
        corners = np.empty((0, 2)) if joint is None else joint.corners_mm
        return Profile(
            points_mm,
            NO_LINES if joint is None else off_section(points, joint),
            self._in_laser_plane(scene, corners, ends_mm),
            self._in_laser_plane(scene, scene.shape.vertices, ends_mm),
        )

    def _in_laser_plane(self, scene: Scene, corners_mm: Float64, ends_mm: tuple[float, float]) -> Float64:
        """Return a section's corners (n, 2) as (y, z), joint frame, where the laser's sheet cuts it.

        It is cut off where the profile ends.
        """
        if not len(corners_mm):
            return NO_POINTS
        first, last = ends_mm
        y, z = corners_mm.T
        inside = (y > first) & (y < last)
        y = np.concatenate([[first], y[inside], [last]])
        z = np.concatenate([[np.interp(first, *corners_mm.T)], z[inside], [np.interp(last, *corners_mm.T)]])
        along_tool = np.tile(scene.T_joint_tool[0, :3], (len(y), 1))
        T_tool_joint = invert(scene.T_joint_tool)
        x = np.full(len(y), scene.T_joint_tool[0, 3])
        points_tool = NO_POINTS
        # A corrugation's height hangs on where the sheet cuts it, and that hardly on the height.
        for _ in range(2):
            raised = z + corrugation_height(x, scene.shape.corrugation)
            # The section's corners are followed along the seam from 1 m behind the torch to the sheet.
            behind = np.column_stack([np.full(len(y), scene.T_joint_tool[0, 3] - 1000.0), y, raised])
            points_tool = meet_laser_plane(self.geometry.setup, transform(T_tool_joint, behind), along_tool)
            x = transform(scene.T_joint_tool, points_tool)[:, 0]
        return points_tool


def truth_by_frame(truth: Truth | None) -> dict[int, Float64]:
    """Return the true seam point (3,), mm, tool frame, of each frame of which it is known."""
    if truth is None:
        return {}
    return dict(zip(truth.frames.tolist(), truth.seam_tool_mm, strict=True))


def stretches(points: Float64) -> list[Float64]:
    """Return the stretches (k, d) of points (n, d) between those that are NaN, of two points at least."""
    known = np.isfinite(points).all(axis=1)
    ends = np.flatnonzero(np.diff(np.concatenate([[False], known, [False]]).astype(np.int8)))
    return [points[first:last] for first, last in ends.reshape(-1, 2) if last - first > 1]


def chosen(points: Float64, which: Bool) -> Float64:
    """Return points (n, d), NaN where they are not among the chosen (n,)."""
    return np.where(which[:, None], points, np.nan)


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
