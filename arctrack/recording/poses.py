"""Robot poses T_base_tool over time: poses.csv, or the pose messages of a CAN log."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from arctrack.errors import in_file
from arctrack.limits import LIMITS
from arctrack.recording.files import UnfitFileError, check_file
from arctrack.recording.tables import PoseTable, read_poses_csv
from noise_model.compiled.arrays import Float64
from noise_model.surface.joint import Joint, seam_frame
from noise_model.transforms import invert, pose_matrix
from robot_io import (
    LOG_SUFFIXES,
    AmbiguousChannelError,
    BusLogError,
    BusLogReader,
    PoseAssembler,
    PoseAt,
    PoseBuffer,
    PoseKind,
    PoseStatus,
)
from tracker.state import Pose

CSV_NAME = "poses.csv"
LOG_NAMES = tuple(f"can{suffix}" for suffix in LOG_SUFFIXES)
CHANNEL_KEY = "can_channel"

COVERAGE_PERIODS = 3.0
"""The poses may end this many of their periods before the last frame: it is extrapolated to."""


def read_poses(
    recording: Path, T_tool_controllertool: Float64 | None, robot: Mapping[str, Any]
) -> tuple[PoseTable, list[str]]:
    """Read poses.csv, or else the CAN log; return T_base_tool and warnings.

    Raises ArctrackError if there is neither. `T_tool_controllertool` turns the poses of a controller
    whose tool frame is another one; `robot` is [robot] of the setup.
    """
    csv_path = recording / CSV_NAME
    logs = [recording / name for name in LOG_NAMES if (recording / name).exists()]
    warnings: list[str] = []
    if csv_path.exists() or not logs:
        if not csv_path.exists():
            others = sorted(path.name for path in recording.glob("can.*"))
            unread = _unread(others[0]) if others else ""
            raise in_file(
                csv_path, f"there are no poses: neither this file nor {', '.join(LOG_NAMES)} exists{unread}"
            )
        poses, warnings = read_poses_csv(csv_path)
    else:
        poses, warnings = read_log(logs[0], can_channel(robot))
        if len(logs) > 1:
            warnings.append(f"{logs[0]}: the poses are of this log; {logs[1].name} is not read")
    if T_tool_controllertool is None:
        return poses, warnings
    T_base_tool = poses.T_base_tool @ invert(T_tool_controllertool)
    return replace(poses, T_base_tool=T_base_tool), warnings


def _unread(name: str) -> str:
    """Return the cure for a log of the bus whose name is not read."""
    if name.lower() in LOG_NAMES:
        return f"; name {name} {name.lower()}"
    if name.lower().endswith(".gz"):
        return f"; {name} is packed by gzip: unpack it"
    return f"; {name} is of a format that is not read: save it as can.blf"


def check_coverage(poses: PoseTable, first_frame_s: float, last_frame_s: float) -> list[str]:
    """Return warnings on frames before the first pose or after the last; ArctrackError if all of them are."""
    first_s, last_s = float(poses.timestamps_s[0]), float(poses.timestamps_s[-1])
    if len(poses.timestamps_s) < 2:
        raise in_file(poses.path, poses.damage or "holds a single pose; two are the least to work with")
    if first_frame_s - last_s > COVERAGE_PERIODS * poses.period_s:
        is_short = last_s - first_s < last_frame_s - first_frame_s
        otherwise = "record poses for as long as frames" if is_short else "both need one clock"
        cure = _cure(poses, first_frame_s - last_s, otherwise)
        raise in_file(
            poses.path,
            f"the poses stop before the frames: the last pose is at {last_s:.6f} s, the first frame at "
            f"{first_frame_s:.6f} s; {cure}",
        )
    if first_s > last_frame_s:
        cure = _cure(poses, first_s - last_frame_s, "both need one clock")
        raise in_file(
            poses.path,
            f"the poses start after the frames: the first pose is at {first_s:.6f} s, the last frame at "
            f"{last_frame_s:.6f} s; {cure}",
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


def _cure(poses: PoseTable, apart_s: float, otherwise: str) -> str:
    """Return the cure for poses and frames that lie so far apart, s."""
    if poses.damage is not None:
        return poses.damage
    # Clocks of two time zones differ by half an hour at least, by 26 hours at most (IANA's time zones).
    if poses.path.suffix == ".asc" and 1800.0 <= apart_s <= 93_600.0:
        return "an .asc states local time: set TZ to the time zone in which it was written"
    return otherwise


def runs_against_travel(poses: PoseTable, frames_s: Sequence[float], joint: Joint) -> bool:
    """Return True if the tool went along a joint's nominal line from its end to its start, frame by frame."""
    at_frames = np.searchsorted(poses.timestamps_s, frames_s).clip(max=len(poses.timestamps_s) - 1)
    origins_mm = poses.T_base_tool[np.unique(at_frames), :3, 3]
    steps_mm = [
        float((after - before) @ seam_frame(joint, before)[:3, 0]) for before, after in pairwise(origins_mm)
    ]
    # The median holds against a jump in the poses.
    # A robot that went less far along the seam while frames were taken shows no direction of travel.
    return sum(steps_mm) < -5.0 and float(np.median(steps_mm)) < 0.0


def pose_buffer(poses: PoseTable) -> PoseBuffer:
    """Return the buffer that answers as the live run would have."""
    buffer = PoseBuffer(max(2, len(poses.timestamps_s)))
    buffer.push_all(poses.timestamps_s, poses.T_base_tool)
    return buffer


def pose_at(buffer: PoseBuffer, timestamp_s: float) -> Pose | None:
    """Return the pose at a time, None where the buffer refuses one."""
    return _pose(buffer.at(timestamp_s))


def poses_at(buffer: PoseBuffer, timestamps_s: Sequence[float]) -> list[Pose | None]:
    """Return the pose at each time, in one call; None where the buffer refuses one."""
    return [_pose(buffered) for buffered in buffer.at_all(timestamps_s)]


def _pose(buffered: PoseAt) -> Pose | None:
    if buffered.status is PoseStatus.REFUSED:
        return None
    return Pose(buffered.T_base_tool, extrapolated=buffered.status is PoseStatus.EXTRAPOLATED)


def can_channel(robot: Mapping[str, Any]) -> str | None:
    """Return the channel of a CAN log that [robot] of a setup names, None if it names none."""
    return None if robot.get(CHANNEL_KEY) is None else str(robot[CHANNEL_KEY])


def read_log(path: Path, channel: str | None) -> tuple[PoseTable, list[str]]:
    """Return the actual poses in a CAN log, and warnings on what was left out.

    Raises ArctrackError for a log without poses, and for one whose robot is ambiguous.
    """
    assembler = PoseAssembler()
    times_s: list[float] = []
    poses: list[Float64] = []
    repeated = 0
    try:
        check_file(path, LIMITS.log_bytes)
        reader = BusLogReader(path, channel)
        for received in reader:
            sample = assembler.push(received)
            if sample is None or sample.kind is not PoseKind.ACTUAL:
                continue
            if times_s and sample.timestamp_s <= times_s[-1]:
                # A pose of the bus that is not later than the one before, by less than this, is the same
                # sample again.
                if times_s[-1] - sample.timestamp_s < 0.05:
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
    except AmbiguousChannelError as error:
        problem = str(error).removeprefix(f"log {path}: ")
        raise in_file(
            path, f"{problem}; name the robot's by [robot] {CHANNEL_KEY} in recording.toml"
        ) from None
    except (BusLogError, UnfitFileError, OSError) as error:
        raise in_file(path, str(error).removeprefix(f"log {path}: ")) from None
    damage = reader.damage
    warnings = [] if damage is None else [f"{path}: {damage}"]
    if not poses:
        cure = damage or "were the pose messages logged?"
        raise in_file(path, f"holds no whole pose of arctrack.dbc; {cure}")
    skipped = sum(reader.skipped.values()) + repeated
    if skipped:
        warnings.append(
            f"{path}: {skipped} frames of the bus were left out: foreign, damaged, lost, or a pose that is "
            "known already"
        )
    return PoseTable(path, np.array(times_s), np.array(poses), damage), warnings
