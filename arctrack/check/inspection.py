"""The picture of `arctrack inspect`: a frame of each condition, and the robot's path."""

import math

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure, SubFigure

from arctrack.check.survey import ConditionSummary, Survey, path_over_seam
from arctrack.errors import in_file
from arctrack.recording import Recording
from arctrack.report import style
from arctrack.report.image import frame_picture
from noise_model.arc.scene import make_scene
from noise_model.compiled.arrays import Float64
from robot_io import PoseBuffer
from tracker.geometry import SensorGeometry
from tracker.state import Frame
from tracker.stripe.expected import expect_stripe

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
