"""Images of a stripe on a gauge, with or without the robot's poses; or the frames of a recording."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from arctrack.calibrate.camera.board_images import reason_of
from arctrack.calibrate.robot_poses import PoseSource, read_robot_poses
from arctrack.errors import ArctrackError, in_file
from arctrack.recording import BadFrame, Recording, SetupFile
from arctrack.recording.importing.grey import channel_of_laser, grey
from arctrack.recording.importing.image_decoder import EncodedImage
from arctrack.recording.importing.image_files import distinct_names, find_images
from calibration.camera.known_lens import lens_from_camera
from calibration.camera.lens import Lens
from calibration.gauge.shape import Gauge
from calibration.gauge.sightings import PosedPieces
from calibration.gauge.stripe_pieces import Pieces, stripe_pieces
from noise_model.compiled.arrays import Float64, Integers
from noise_model.even_sample import evenly


@dataclass
class GaugeImages:
    """Stripes on a gauge in images.

    `shown` are those with the robot's poses; without poses the robot's is the identity. `left_out` maps
    unused images to the reason. `sample` (H, W) is the first image with the gauge, `sample_pieces` its
    stripe.
    """

    lens: Lens
    has_poses: bool
    shown: list[PosedPieces] = field(default_factory=list)
    left_out: dict[str, str] = field(default_factory=dict)
    warnings: list[str] = field(default_factory=list)
    sample: Integers | None = None
    sample_pieces: Pieces | None = None

    def add(self, name: str, image: Integers, T_base_tool: Float64, gauge: Gauge) -> None:
        """Look for the gauge in an image (H, W)."""
        if image.shape != (self.lens.height, self.lens.width):
            rows, columns = image.shape[:2]
            self.left_out[name] = (
                f"is {columns} x {rows} px, [camera] width and height say {self.lens.width} x "
                f"{self.lens.height}"
            )
            return
        pieces = stripe_pieces(image, self.lens, len(gauge.pieces))
        if isinstance(pieces, str):
            self.left_out[name] = pieces
            return
        self.shown.append(PosedPieces(name, pieces, T_base_tool))
        if self.sample is None:
            self.sample, self.sample_pieces = image, pieces


def read_gauge_images(
    sources: Sequence[Path],
    gauge: Gauge,
    stated: SetupFile,
    poses: PoseSource | None,
    progress: Callable[[int, int], None],
) -> GaugeImages:
    """Find a gauge's stripe in image files; without the robot's poses images are looked at one by one.

    ArctrackError where images or poses cannot be read, or do not belong together.
    """
    series = find_images(sources)
    names = distinct_names(series.paths)
    images = GaugeImages(_lens(stated), poses is not None)
    robot = None if poses is None else read_robot_poses(poses, series, stated)
    channel = channel_of_laser(stated.setup)
    for n, path in enumerate(series.paths):
        progress(n, len(series))
        if robot is not None and not robot.has(n):
            images.left_out[names[path]] = "has no pose"
            continue
        try:
            image = grey(EncodedImage(path).pixels(), channel)
        except ArctrackError as error:
            images.left_out[names[path]] = reason_of(error, path)
            continue
        T_base_tool = np.eye(4) if robot is None else robot.at(int(robot.rows[n]))
        images.add(names[path], image, T_base_tool, gauge)
    progress(len(series), len(series))
    return images


def read_gauge_frames(
    recording: Recording, gauge: Gauge, stated: SetupFile, progress: Callable[[int, int], None]
) -> GaugeImages:
    """Find a gauge's stripe in `MAX_FRAMES` frames at most of those that show the laser alone.

    ArctrackError where none does.
    """
    lit = [n for n, row in enumerate(recording.rows) if row.laser_on and not row.arc_on]
    if not lit:
        raise in_file(recording.path, "has no frame of the laser alone: take them with the arc off")
    # Number of frames of a recording that are used, evenly spread.
    chosen = [lit[n] for n in evenly(len(lit), 40)]
    images = GaugeImages(_lens(stated), has_poses=True)
    buffer = recording.pose_buffer()
    for done, frame in enumerate(recording.frames(chosen)):
        progress(done, len(chosen))
        if isinstance(frame, BadFrame):
            images.left_out[frame.path.name] = frame.problem
            continue
        name = f"frame {frame.index}"
        pose = recording.pose_at(buffer, frame.timestamp_s)
        if pose is None:
            images.left_out[name] = "has no pose"
            continue
        images.add(name, frame.image_dn, pose.T_base_tool, gauge)
    progress(len(chosen), len(chosen))
    return images


def _lens(stated: SetupFile) -> Lens:
    return lens_from_camera(stated.setup.camera)
