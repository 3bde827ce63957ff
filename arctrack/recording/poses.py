"""Where the robot was: poses.csv, or the pose messages of a CAN log, as T_base_tool over time."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path

import numpy as np

from arctrack.errors import in_file
from arctrack.limits import LIMITS
from arctrack.recording.files import UnfitFileError, check_file
from arctrack.recording.tables import PoseTable, read_poses_csv
from noise_model.arrays import Float64
from noise_model.surface.joint import Joint, seam_frame
from noise_model.transforms import invert, pose_matrix
from robot_io import BusLogError, BusLogReader, PoseAssembler, PoseAt, PoseBuffer, PoseKind, PoseStatus
from tracker.state import Pose

CSV_NAME = "poses.csv"
LOG_NAMES = ("can.asc", "can.blf", "can.log")

COVERAGE_PERIODS = 3.0
"""The poses may end this many of their periods before the last frame: it is extrapolated to."""

MIN_TRAVEL_MM = 5.0
"""A robot that went less far along the seam while frames were taken shows no direction of travel."""

REPEATED_S = 0.05
"""A pose of the bus that is not later than the one before, by less than this, is the same sample again."""


def read_poses(recording: Path, T_tool_controllertool: Float64 | None) -> tuple[PoseTable, list[str]]:
    """Read poses.csv, or else the CAN log; return T_base_tool and warnings.

    Raises ArctrackError if there is neither. `T_tool_controllertool` turns the poses of a controller
    whose tool frame is another one.
    """
    csv_path = recording / CSV_NAME
    logs = [recording / name for name in LOG_NAMES if (recording / name).exists()]
    warnings: list[str] = []
    if csv_path.exists() or not logs:
        if not csv_path.exists():
            raise in_file(
                csv_path, f"there are no poses: neither this file nor {', '.join(LOG_NAMES)} exists"
            )
        poses, warnings = read_poses_csv(csv_path)
    else:
        poses, skipped = _read_log(logs[0])
        if skipped:
            warnings.append(
                f"{logs[0]}: {skipped} frames of the bus were left out: foreign, damaged, lost, or a pose "
                "that is known already"
            )
    if T_tool_controllertool is None:
        return poses, warnings
    T_base_tool = poses.T_base_tool @ invert(T_tool_controllertool)
    return PoseTable(poses.path, poses.timestamps_s, T_base_tool), warnings


def check_coverage(poses: PoseTable, first_frame_s: float, last_frame_s: float) -> list[str]:
    """Return warnings on frames before the first pose or after the last; ArctrackError if all of them are."""
    first_s, last_s = float(poses.timestamps_s[0]), float(poses.timestamps_s[-1])
    if len(poses.timestamps_s) < 2:
        raise in_file(poses.path, "holds a single pose; two are the least to work with")
    if first_frame_s - last_s > COVERAGE_PERIODS * poses.period_s:
        raise in_file(
            poses.path,
            f"the poses stop before the frames: the last pose is at {last_s:.6f} s, the first frame at "
            f"{first_frame_s:.6f} s; record poses for as long as frames",
        )
    if first_s > last_frame_s:
        raise in_file(
            poses.path,
            f"the poses start after the frames: the first pose is at {first_s:.6f} s, the last frame at "
            f"{last_frame_s:.6f} s; both need one clock",
        )
    warnings = []
    if first_s > first_frame_s:
        warnings.append(
            f"{poses.path}: the first pose is at {first_s:.6f} s, the first frame at {first_frame_s:.6f} s: "
            "frames before two poses have none"
        )
    if last_frame_s - last_s > COVERAGE_PERIODS * poses.period_s:
        warnings.append(
            f"{poses.path}: the last pose is at {last_s:.6f} s, the last frame at {last_frame_s:.6f} s: "
            "frames after it have none"
        )
    return warnings


def runs_against_travel(poses: PoseTable, frames_s: Sequence[float], joint: Joint) -> bool:
    """Return whether the tool went along a joint's nominal line from its end to its start, frame by frame."""
    at_frames = np.searchsorted(poses.timestamps_s, frames_s).clip(max=len(poses.timestamps_s) - 1)
    origins_mm = poses.T_base_tool[np.unique(at_frames), :3, 3]
    steps_mm = [
        float((after - before) @ seam_frame(joint, before)[:3, 0]) for before, after in pairwise(origins_mm)
    ]
    # The median holds against a jump in the poses.
    return sum(steps_mm) < -MIN_TRAVEL_MM and float(np.median(steps_mm)) < 0.0


def pose_buffer(poses: PoseTable) -> PoseBuffer:
    """Return the buffer that answers as the live run would have."""
    buffer = PoseBuffer(max(2, len(poses.timestamps_s)))
    buffer.push_all(poses.timestamps_s, poses.T_base_tool)
    return buffer


def pose_at(buffer: PoseBuffer, timestamp_s: float) -> Pose | None:
    """Return the pose at a time, None where the buffer refuses one."""
    return _pose(buffer.at(timestamp_s))


def poses_at(buffer: PoseBuffer, timestamps_s: Sequence[float]) -> list[Pose | None]:
    """Return the pose at each time, asked for in one call; None where the buffer refuses one."""
    return [_pose(buffered) for buffered in buffer.at_all(timestamps_s)]


def _pose(buffered: PoseAt) -> Pose | None:
    if buffered.status is PoseStatus.REFUSED:
        return None
    return Pose(buffered.T_base_tool, extrapolated=buffered.status is PoseStatus.EXTRAPOLATED)


def _read_log(path: Path) -> tuple[PoseTable, int]:
    """Return the actual poses that a CAN log holds, and how many of its frames were left out."""
    assembler = PoseAssembler()
    times_s: list[float] = []
    poses: list[Float64] = []
    repeated = 0
    try:
        check_file(path, LIMITS.log_bytes)
        reader = BusLogReader(path)
        for received in reader:
            sample = assembler.push(received)
            if sample is None or sample.kind is not PoseKind.ACTUAL:
                continue
            if times_s and sample.timestamp_s <= times_s[-1]:
                if times_s[-1] - sample.timestamp_s < REPEATED_S:
                    repeated += 1
                    continue
                raise in_file(
                    path,
                    f"the pose at {sample.timestamp_s:.6f} s does not come after {times_s[-1]:.6f}: "
                    "times must rise",
                )
            if len(times_s) == LIMITS.csv_rows:
                raise in_file(path, f"holds more than {LIMITS.csv_rows} poses: that is the most")
            times_s.append(sample.timestamp_s)
            poses.append(pose_matrix(sample.position_base_mm, sample.quaternion_xyzw))
    except (BusLogError, UnfitFileError) as error:
        raise in_file(path, str(error).removeprefix(f"log {path}: ")) from None
    if not poses:
        raise in_file(path, "holds no whole pose of arctrack.dbc; were the pose messages logged?")
    return PoseTable(path, np.array(times_s), np.array(poses)), sum(reader.skipped.values()) + repeated
