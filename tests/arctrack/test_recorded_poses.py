"""A replay of recordings whose poses are wrong: their offsets are refused, and the doubt is named."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from made import results_of
from scipy.spatial.transform import Rotation

from arctrack.control.frame_tracking import seam_measurement
from arctrack.control.recorded_poses import RecordedPoses, seam_limits
from arctrack.recording import Recording, read_recording
from arctrack.replay.replay import ReplayOptions, replay_recording
from arctrack.simulation.cell.robot import WELDING
from noise_model.compiled.arrays import Float64
from robot_io import (
    BusMessage,
    GateReason,
    Link,
    PoseKind,
    RobotPosePosition,
    RobotPoseRotation,
    Verdict,
)
from robot_io.poses.plausibility_limits import PlausibilityLimits
from robot_io.poses.pose_questions import Implausibility
from tracker.state import NAN, Pose, Track

EXAMPLE = Path(__file__).parents[2] / "examples" / "v_groove"
FAULT_S = 0.8
LIMITS = PlausibilityLimits()


def frozen(times_s: Float64, poses: Float64) -> Float64:
    return np.where((times_s >= FAULT_S)[:, None, None], poses[np.searchsorted(times_s, FAULT_S)], poses)


def y_flipped(_times_s: Float64, poses: Float64) -> Float64:
    flipped = poses.copy()
    flipped[:, 1, 3] *= -1.0
    return flipped


def conjugated(_times_s: Float64, poses: Float64) -> Float64:
    turned = poses.copy()
    turned[:, :3, :3] = poses[:, :3, :3].transpose(0, 2, 1)
    return turned


def drifting(times_s: Float64, poses: Float64) -> Float64:
    drifted = poses.copy()
    drifted[:, 1, 3] += 5.0 * (times_s - times_s[0])
    return drifted


def late(times_s: Float64, poses: Float64) -> Float64:
    return poses[np.searchsorted(times_s, times_s - 0.1)]


@pytest.fixture(scope="module")
def example() -> Recording:
    return read_recording(EXAMPLE)


def with_poses(recording: Recording, change: Callable[[Float64, Float64], Float64]) -> Recording:
    poses = recording.poses
    return replace(recording, poses=replace(poses, T_base_tool=change(poses.timestamps_s, poses.T_base_tool)))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("change", "min_frames"),
    [(frozen, 5), (y_flipped, 10), (conjugated, 3), (drifting, 15), (late, 15)],
)
def test_offsets_that_rest_on_wrong_poses_are_refused(
    example: Recording,
    tmp_path: Path,
    change: Callable[[Float64, Float64], Float64],
    min_frames: int,
) -> None:
    done = replay_recording(with_poses(example, change), tmp_path, ReplayOptions(pictures=False))
    rows = results_of(tmp_path)
    doubted = [row["pose_doubt"] == "contradicted" for row in rows]
    first = doubted.index(True)
    # The torch comes later to what was measured meanwhile: the doubt lasts.
    assert all(doubted[first:])
    assert len(rows) - first >= min_frames
    assert {row["offset_y_mm"] for row in rows[first:]} == {""}
    # Without an arc they are refused in any case.
    assert done.summary.refusals["pose_implausible"] == sum(row.arc_on for row in example.rows[first:])
    assert done.warnings == (
        f"poses.csv: the seam moves otherwise than the poses say: no offset is sent for {len(rows) - first} "
        f"frames, the first is {first}",
    )


@pytest.mark.slow
def test_right_poses_are_trusted(example: Recording, tmp_path: Path) -> None:
    done = replay_recording(example, tmp_path, ReplayOptions(pictures=False))
    assert done.summary.offsets == {Verdict.SEND.value: 18, Verdict.HOLD.value: 0, Verdict.REFUSE.value: 6}
    assert {row["pose_doubt"] for row in results_of(tmp_path)} == {""}
    written = json.loads((tmp_path / "summary.json").read_text())
    assert written["poses"] == {"robot_status": False, "doubts": {}}
    assert done.warnings == ()


def test_what_poses_alone_tell_is_asked_without_an_image(example: Recording) -> None:
    def jumps(times_s: Float64, poses: Float64) -> Float64:
        moved = poses.copy()
        moved[times_s >= FAULT_S, 2, 3] += 5.0
        return moved

    def stops(times_s: Float64, poses: Float64) -> Float64:
        return poses[times_s < FAULT_S]

    assert doubts_of(RecordedPoses(example, LIMITS)) == [None] * 3
    assert doubts_of(RecordedPoses(with_poses(example, jumps), LIMITS)) == [
        None,
        Implausibility.SPEED,
        Implausibility.NOT_REJOINED,
    ]
    short = replace(example.poses, timestamps_s=example.poses.timestamps_s[:100])
    short = replace(short, T_base_tool=example.poses.T_base_tool[:100])
    assert doubts_of(RecordedPoses(replace(example, poses=short), LIMITS))[1:] == [Implausibility.STOPPED] * 2


def doubts_of(poses: RecordedPoses) -> list[object]:
    found = []
    for now_s in (FAULT_S - 0.1, FAULT_S + 0.05, FAULT_S + 0.6):
        reason = poses.verdict(now_s)
        assert (reason is GateReason.NONE) == (poses.doubt is None)
        found.append(poses.doubt)
    return found


def test_a_log_brings_what_the_robot_said(example: Recording, tmp_path: Path) -> None:
    """Poses that stand still while the robot says that it moves: no image is needed to tell that."""
    log = tmp_path / "can.blf"
    turn = Rotation.from_euler("y", 8.0, degrees=True)
    with Link("virtual", "recorded", log_paths=[log]) as link:
        for n in range(100):
            now_s = 0.01 * n
            x_mm = 10.0 * min(now_s, 0.5)
            said: list[BusMessage] = [
                WELDS,
                RobotPosePosition(x_mm, 0.0, 40.0, PoseKind.ACTUAL),
                RobotPoseRotation.from_quaternion(tuple(turn.as_quat().tolist()), NAN),
            ]
            for message in said:
                link.send(message, now_s)
    # The controller has a tool frame of its own, 40 mm above ours and turned.
    T_tool_controllertool = np.eye(4)
    T_tool_controllertool[:3, :3] = turn.as_matrix()
    T_tool_controllertool[2, 3] = 40.0
    logged = replace(
        example,
        poses=replace(example.poses, path=log),
        T_tool_controllertool=T_tool_controllertool,
    )
    poses = RecordedPoses(logged, LIMITS)
    doubts = [(poses.verdict(now_s), poses.doubt)[1] for now_s in (0.45, 0.55, 0.7)]
    assert doubts == [None, None, Implausibility.FROZEN]
    assert poses.hears_robot


WELDS = replace(WELDING, path_section=None)


def test_the_image_is_asked_over_a_time_and_not_over_frames() -> None:
    assert [seam_limits(rate_hz).window for rate_hz in (NAN, 5.0, 40.0, 50.0, 500.0)] == [20, 10, 16, 20, 20]


def test_the_hand_eye_tolerance_is_no_scatter(example: Recording) -> None:
    pose = Pose(np.eye(4))
    track = Track(0, 0.0, 0, seam_tool_mm=(35.0, 0.5, -4.2), sigma_y_mm=0.05, sigma_z_mm=0.1)
    seam = seam_measurement(example.setup, track, pose, (0.04**2, 0.1**2))
    assert seam is not None
    assert seam.station_mm == pytest.approx(35.0)
    assert seam.displacement_mm == pytest.approx((0.5, -0.2))
    assert seam.sigma_mm == pytest.approx((0.03, 0.0), abs=1e-9)
    assert seam_measurement(example.setup, track, None, (0.0, 0.0)) is None
    assert seam_measurement(example.setup, Track(0, 0.0, 0), pose, (0.0, 0.0)) is None
