from .calibrated import CalibrationValues as CalibrationValues, with_calibrated as with_calibrated
from .frames import BadFrame as BadFrame
from .poses import pose_at as pose_at
from .reader import Recording as Recording, read_recording as read_recording, read_truth as read_truth
from .setup_file import (
    SetupFile as SetupFile,
    read_setup_file as read_setup_file,
    require_images as require_images,
    with_camera_pose as with_camera_pose,
    with_filter_curve as with_filter_curve,
)
from .setup_writer import format_setup as format_setup
from .tables import FrameRow as FrameRow, PoseTable as PoseTable, Truth as Truth
from .writer import RecordingWriter as RecordingWriter, VideoFormat as VideoFormat
