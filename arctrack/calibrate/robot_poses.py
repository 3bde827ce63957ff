"""The robot's poses at a series of images, as a user states where they are and how they are written."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from arctrack.errors import in_file
from arctrack.recording import SetupFile
from arctrack.recording.importing.columns import UNKNOWN_IMAGE, check_all_named
from arctrack.recording.importing.image_files import ImageSeries
from arctrack.recording.importing.pose_files import JOINT_NAMES, PoseFile, known_names, read_poses
from arctrack.recording.importing.units import Units
from arctrack.recording.poses import can_channel
from noise_model.compiled.arrays import Float64, Int64
from noise_model.transforms import invert


@dataclass(frozen=True)
class PoseSource:
    """Source of the robot's poses and their notation, as a user states it; see `read_poses`."""

    path: Path
    translations: Path | None = None
    rotation: str | None = None
    units: Units = field(default_factory=Units)
    columns: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class RobotPoses:
    """The robot's poses at images.

    `rows` (images,) are the numbers of each image's pose in `file`; `T_controllertool_tool` (4, 4) is mm.
    """

    file: PoseFile
    rows: Int64
    T_controllertool_tool: Float64

    def has(self, image: int) -> bool:
        """Return True if an image, by its position in the series, has a pose."""
        return bool(self.rows[image] != UNKNOWN_IMAGE)

    def at(self, rows: int | Int64) -> Float64:
        """Return T_base_tool (..., 4, 4), mm, of rows of the file."""
        return np.asarray(self.file.T_base_tool[rows] @ self.T_controllertool_tool)


def read_robot_poses(source: PoseSource, series: ImageSeries, stated: SetupFile) -> RobotPoses:
    """Read the robot's poses at images, of which some may lack one, in the setup's tool.

    ArctrackError where they cannot be read, or are another number than the images and nothing says which is
    whose.
    """
    poses, files = read_poses(
        source.path,
        source.translations,
        source.rotation,
        source.units,
        source.columns,
        series,
        False,
        may_lack=True,
        with_joints=True,
        can_channel=can_channel(stated.robot),
    )
    if files:
        known = (*known_names(source.rotation), *JOINT_NAMES[0], "time", "frame", "file")
        check_all_named(source.columns, known, files)
    if poses.rows is None and len(poses.T_base_tool) != len(series):
        counts = f"{len(poses.T_base_tool)} poses for {len(series)} images"
        raise in_file(source.path, f"has {counts}: add a column file or frame that says which is whose")
    rows = np.arange(len(series)) if poses.rows is None else poses.rows
    to_tool = np.eye(4) if stated.T_tool_controllertool is None else invert(stated.T_tool_controllertool)
    return RobotPoses(poses, rows, to_tool)
