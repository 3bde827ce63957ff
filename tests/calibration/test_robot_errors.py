import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from calibration.camera.enough import UndeterminedError
from calibration.hand_eye_boards.kinematics import joint_motions
from calibration.hand_eye_boards.robot_error import JOINTS, NONE, SMOOTH

sys.path.append(str(Path(__file__).parents[2] / "benchmarks"))
from robot_errors import ArmWorld, calibrated, draw_arm, flange, seam_error

pytestmark = pytest.mark.slow


def arm(error: str, seed: int = 3, poses: int = 14) -> ArmWorld:
    return draw_arm(np.random.default_rng(seed), poses, error, 0.1)


def test_joint_offsets_are_found_within_their_sigmas() -> None:
    world = arm("joints")
    result = calibrated(world, with_angles=True)
    assert result.robot_error.name == JOINTS
    assert result.joints == (2, 3, 4, 5)
    offsets, sigma = result.joint_offsets
    assert np.abs((offsets - world.offsets_deg[1:5]) / sigma).max() < 3.5
    assert result.robot_error.rms_mm < 0.5 * result.robot_errors[0].rms_mm
    off, sigma_mm = seam_error(result)
    assert np.abs(off / sigma_mm).max() < 3.5
    assert sigma_mm.max() < 0.1


def test_a_tool_that_sags_is_found_without_joint_angles() -> None:
    result = calibrated(arm("sag"), with_angles=False)
    assert result.robot_error.name == SMOOTH
    off, sigma_mm = seam_error(result)
    assert np.abs(off / sigma_mm).max() < 3.5


def test_offsets_that_no_joint_angle_tells_are_in_the_sigma() -> None:
    results = [calibrated(arm("joints", seed, 12), with_angles=False) for seed in range(6)]
    assert {result.robot_error.name for result in results} == {SMOOTH}
    off, sigma_mm = np.swapaxes([seam_error(result) for result in results], 0, 1)
    assert np.sqrt(np.mean((off / sigma_mm) ** 2)) < 1.4
    assert np.median(sigma_mm) < 0.25
    # A pose that the robot states has these errors, whatever the boards know of them.
    assert all(result.pose_sigma[0] > result.robot_deg for result in results)


def test_a_robot_without_repeatable_error_is_given_none() -> None:
    results = [calibrated(arm("none", seed), with_angles=True) for seed in range(5)]
    assert [result.robot_error.name for result in results].count(NONE) >= 4


def test_motions_by_offsets_are_those_of_the_arm() -> None:
    """The kinematics are fitted to angles and poses alone, in a tool of its own."""
    world, step = arm("none"), 1e-5
    T_flange_tool = np.eye(4)
    T_flange_tool[:3, :3] = Rotation.from_rotvec([0.3, -0.5, 0.2]).as_matrix()
    T_flange_tool[:3, 3] = 40.0, -20.0, 250.0
    joints, motions = joint_motions(world.joint_rad, world.T_base_tool @ T_flange_tool)
    assert joints == (2, 3, 4, 5)
    for n, q in enumerate(world.joint_rad):
        for k, joint in enumerate(joints):
            moved = (
                np.linalg.inv(flange(q) @ T_flange_tool)
                @ flange(q + step * np.eye(6)[joint - 1])
                @ T_flange_tool
            )
            twist = np.append(Rotation.from_matrix(moved[:3, :3]).as_rotvec(), moved[:3, 3]) / step
            # The angles are rounded to 0.001 deg, which is 0.02 mm at a metre.
            assert motions[n, :3, k] == pytest.approx(twist[:3], abs=0.01)
            assert motions[n, 3:, k] == pytest.approx(twist[3:], abs=10.0)


def test_a_forearm_that_is_stated_by_base_is_understood() -> None:
    world = arm("joints")
    angles = world.joint_rad.copy()
    angles[:, 2] += angles[:, 1]
    result = calibrated(replace(world, joint_rad=angles), with_angles=True)
    assert result.robot_error.name == JOINTS


def test_joint_angles_that_make_other_poses_are_refused() -> None:
    world = arm("none")
    with pytest.raises(UndeterminedError, match=r"contradict each other .* check their units"):
        joint_motions(world.joint_rad[::-1], world.T_base_tool)
    with pytest.raises(UndeterminedError, match="6 poses with joint angles: 7 at least"):
        joint_motions(world.joint_rad[:6], world.T_base_tool[:6])
    result = calibrated(replace(world, joint_rad=np.degrees(world.joint_rad)), with_angles=True)
    assert result.no_joints is not None
    assert {score.name for score in result.robot_errors}.isdisjoint({JOINTS})
