"""Content of a recording, in words, numbers and a picture, without tracking it."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure, SubFigure

from arctrack.errors import in_file
from arctrack.recording import BadFrame, FrameRow, PoseTable, Recording
from arctrack.report import style
from arctrack.report.image import frame_picture
from noise_model.arc.scene import make_scene
from noise_model.compiled.arrays import Float64
from noise_model.instrument.sensor import saturation_dn
from noise_model.setup import Setup
from noise_model.surface.joint import seam_frame
from noise_model.transforms import invert, transform
from robot_io import PoseBuffer
from tracker.geometry import SensorGeometry
from tracker.state import Frame
from tracker.stripe.expected import expect_stripe


@dataclass(frozen=True)
class ConditionSummary:
    """All frames taken under one condition; the grey levels are over those that can be used.

    `sample` is the middle one of the usable frames.
    """

    laser_on: bool
    arc_on: bool
    current_a: float
    exposure_s: float
    frames: int
    mean_dn: float
    brightest_dn: int
    saturated_share: float
    sample: Frame | None = field(repr=False)

    @property
    def name(self) -> str:
        """The condition in words."""
        lit = [name for name, on in (("laser", self.laser_on), ("arc", self.arc_on)) if on]
        current = f" {self.current_a:g} A" if self.arc_on and math.isfinite(self.current_a) else ""
        return f"{' + '.join(lit) or 'dark'}{current}, {1000 * self.exposure_s:g} ms"


@dataclass(frozen=True)
class MotionSummary:
    """Motion of the robot, from its poses.

    `jitter_s` is the standard deviation of the time between two poses, `longest_gap_s` the longest;
    `travel_mm` is the distance from the first pose to the last, the speed is along the seam. Lateral position
    and height are those of the tool's origin over the nominal seam line (low, high), mm; `tilt_deg` is its
    largest angle to the surface normal.
    """

    first_s: float
    last_s: float
    rate_hz: float
    jitter_s: float
    longest_gap_s: float
    travel_mm: float
    travel_speed_mm_s: float
    lateral_mm: tuple[float, float]
    height_mm: tuple[float, float]
    tilt_deg: float


@dataclass(frozen=True)
class Survey:
    """A whole recording."""

    conditions: tuple[ConditionSummary, ...]
    motion: MotionSummary
    bad_frames: tuple[BadFrame, ...]


def survey(recording: Recording, on_frame: Callable[[int], None] | None = None) -> Survey:
    """Survey every frame and pose of a recording; `on_frame` is called with the number of frames done."""
    tallies: dict[tuple[bool, bool, float, float], _Tally] = {}
    middles = _middles(recording.rows)
    bad_frames: list[BadFrame] = []
    for n, frame in enumerate(recording.frames()):
        tally = tallies.setdefault(recording.rows[n].condition, _Tally(recording.rows[n]))
        tally.frames += 1
        if isinstance(frame, BadFrame):
            bad_frames.append(frame)
        else:
            tally.add(frame, recording.setup, n <= middles[recording.rows[n].condition])
        if on_frame is not None:
            on_frame(n + 1)
    conditions = tuple(tallies[key].condition() for key in sorted(tallies))
    return Survey(conditions, motion_of(recording.poses, recording.setup), tuple(bad_frames))


def path_over_seam(poses: PoseTable, setup: Setup) -> Float64:
    """Return the tool's origin (n, 3), mm, over the nominal seam: along it, to its left, above it."""
    origins = poses.T_base_tool[:, :3, 3]
    return np.array(
        [transform(invert(seam_frame(setup.joint, origin)), origin[None, :])[0] for origin in origins]
    )


def motion_of(poses: PoseTable, setup: Setup) -> MotionSummary:
    """Return how the robot moved."""
    gaps_s = np.diff(poses.timestamps_s)
    over_seam = path_over_seam(poses, setup)
    travel_mm = float(np.linalg.norm(poses.T_base_tool[-1, :3, 3] - poses.T_base_tool[0, :3, 3]))
    normal = np.asarray(setup.joint.surface_normal_in_base)
    upright = np.clip(poses.T_base_tool[:, :3, 2] @ normal, -1.0, 1.0)
    return MotionSummary(
        first_s=float(poses.timestamps_s[0]),
        last_s=float(poses.timestamps_s[-1]),
        rate_hz=1.0 / poses.period_s,
        jitter_s=float(gaps_s.std()),
        longest_gap_s=float(gaps_s.max()),
        travel_mm=travel_mm,
        # The median holds against a jump in the poses.
        travel_speed_mm_s=abs(float(np.median(np.diff(over_seam[:, 0]) / gaps_s))),
        lateral_mm=(float(over_seam[:, 1].min()), float(over_seam[:, 1].max())),
        height_mm=(float(over_seam[:, 2].min()), float(over_seam[:, 2].max())),
        tilt_deg=float(np.degrees(np.arccos(upright)).max()),
    )


class _Tally:
    """Sums over the frames of one condition."""

    def __init__(self, row: FrameRow) -> None:
        self.row = row
        self.frames = 0
        self.means_dn: list[float] = []
        self.brightest_dn = 0
        self.saturated: list[float] = []
        self.sample: Frame | None = None

    def add(self, frame: Frame, setup: Setup, up_to_middle: bool) -> None:
        self.means_dn.append(float(frame.image_dn.mean()))
        self.brightest_dn = max(self.brightest_dn, int(frame.image_dn.max()))
        self.saturated.append(float((frame.image_dn >= saturation_dn(setup.sensor)).mean()))
        if self.sample is None or up_to_middle:
            self.sample = frame

    def condition(self) -> ConditionSummary:
        return ConditionSummary(
            laser_on=self.row.laser_on,
            arc_on=self.row.arc_on,
            current_a=self.row.current_a,
            exposure_s=self.row.exposure_s,
            frames=self.frames,
            mean_dn=float(np.mean(self.means_dn)) if self.means_dn else math.nan,
            brightest_dn=self.brightest_dn,
            saturated_share=float(np.mean(self.saturated)) if self.saturated else math.nan,
            sample=self.sample,
        )


def _middles(rows: tuple[FrameRow, ...]) -> dict[tuple[bool, bool, float, float], int]:
    """Return the position of each condition's middle frame."""
    positions: dict[tuple[bool, bool, float, float], list[int]] = {}
    for n, row in enumerate(rows):
        positions.setdefault(row.condition, []).append(n)
    return {condition: indices[len(indices) // 2] for condition, indices in positions.items()}


COLUMNS = 5


def draw(recording: Recording, survey: Survey) -> Figure:
    """Return the picture; dashed lines are where the nominal joint, at its nominal place, puts the stripe.

    ArctrackError if the setup's stripe is not in view.
    """
    rows = math.ceil(len(survey.conditions) / COLUMNS)
    camera = recording.setup.camera
    cell_inch = 2.8 * camera.height / camera.width + 0.35
    title = (
        f"{recording.name}: a frame of each condition, brightness by √; dashed: the stripe's nominal place"
    )
    figure = style.new_figure(13.5, rows * cell_inch + 4.6, title)
    grid = figure.add_gridspec(2, 1, height_ratios=(rows * cell_inch, 4.2))
    sheet, paths = figure.add_subfigure(grid[0]), figure.add_subfigure(grid[1])
    try:
        geometry = SensorGeometry.of(recording.setup)
    except ValueError as error:
        raise in_file(recording.setup_path, str(error)) from error
    poses = recording.pose_buffer()
    cells = sheet.subplots(rows, COLUMNS, squeeze=False).ravel()
    for axes in cells:
        axes.set_axis_off()
    for axes, condition in zip(cells, survey.conditions, strict=False):
        _frame(axes, recording, condition, geometry, poses)
    _path(paths, recording)
    return figure


def expected_stripe_px(
    recording: Recording, geometry: SensorGeometry, poses: PoseBuffer, frame: Frame
) -> Float64 | None:
    """Return the image points (n, 2) x y of the nominal stripe, None where there is no pose or no stripe."""
    pose = recording.pose_at(poses, frame.timestamp_s)
    if pose is None:
        return None
    scene = make_scene(geometry.setup, pose.T_base_tool)
    expected = None if scene.below_surface else expect_stripe(geometry, scene)
    if expected is None:
        return None
    lines = np.arange(geometry.n_scan, dtype=np.float64)
    return geometry.image_points(lines, expected.shown_px)


def _frame(
    axes: Axes, recording: Recording, condition: ConditionSummary, geometry: SensorGeometry, poses: PoseBuffer
) -> None:
    axes.set_title(f"{condition.name}\n{condition.frames} frames", fontsize=9, loc="left")
    frame = condition.sample
    if frame is None:
        axes.text(0.5, 0.5, "none of them readable", ha="center", va="center")
        return
    camera = recording.setup.camera
    grey = frame_picture(frame, recording.setup)
    axes.imshow(grey, cmap="gray", vmin=0, vmax=255, interpolation="antialiased")
    stripe = expected_stripe_px(recording, geometry, poses, frame) if condition.laser_on else None
    if stripe is not None:
        axes.plot(*stripe.T, color=style.ORANGE, linewidth=0.9, dashes=(6, 4))
    style.over_image(axes, camera.width, camera.height)


def _path(paths: SubFigure, recording: Recording) -> None:
    times = recording.poses.timestamps_s
    over_seam = path_over_seam(recording.poses, recording.setup)
    frames_s = [row.timestamp_s for row in recording.rows]
    at_frames = [np.interp(frames_s, times, over_seam[:, axis]) for axis in range(3)]
    lateral, height, tilt = paths.subplots(1, 3)
    style.plain(lateral, "along the seam [mm]", "mm", "tool beside the nominal seam, + left")
    lateral.axhline(0.0, color=style.BLACK, linewidth=0.8)
    lateral.plot(over_seam[:, 0], over_seam[:, 1], color=style.BLUE, label="poses")
    lateral.plot(at_frames[0], at_frames[1], ".", color=style.VERMILLION, label="frames")
    lateral.legend(fontsize=8, loc="best")
    style.plain(height, "along the seam [mm]", "mm", "tool above the nominal seam line")
    height.plot(over_seam[:, 0], over_seam[:, 2], color=style.BLUE)
    height.plot(at_frames[0], at_frames[2], ".", color=style.VERMILLION)
    style.plain(tilt, "time [s]", "deg", "tool's tilt")
    z_axes = recording.poses.T_base_tool[:, :3, 2]
    tilt.plot(times, np.degrees(np.arcsin(z_axes[:, 0])), color=style.BLUE, label="towards base x")
    tilt.plot(
        times, np.degrees(np.arcsin(z_axes[:, 1])), color=style.GREEN, dashes=(5, 2), label="towards base y"
    )
    tilt.legend(fontsize=8, loc="best")
