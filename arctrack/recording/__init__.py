"""Recordings: one reader, one writer, and the files that a replay writes."""

from arctrack.recording.calibrated import Calibrated, with_calibrated
from arctrack.recording.frames import BadFrame
from arctrack.recording.poses import pose_at
from arctrack.recording.reader import Recording, read_recording, read_truth
from arctrack.recording.setup_file import (
    SetupFile,
    format_setup,
    read_setup_file,
    with_camera_pose,
    with_filter_curve,
)
from arctrack.recording.tables import FrameRow, PoseTable, Truth
from arctrack.recording.writer import RecordingWriter, VideoFormat

__all__ = [
    "BadFrame",
    "Calibrated",
    "FrameRow",
    "PoseTable",
    "Recording",
    "RecordingWriter",
    "SetupFile",
    "Truth",
    "VideoFormat",
    "format_setup",
    "pose_at",
    "read_recording",
    "read_setup_file",
    "read_truth",
    "with_calibrated",
    "with_camera_pose",
    "with_filter_curve",
]
