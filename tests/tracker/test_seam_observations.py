"""Where sightings put the seam: a wrong camera, clock or plate bends it, the right one makes it straight."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sim_to_real.data.binned import observe
from tests.sim_to_real.small import example_setup, recorded
from tracker.seam_observations import SeamObservations

N = 9


def tool_at(time_s):
    """A tool that travels along the seam and swings: each pose sees a wrong camera otherwise."""
    T_base_tool = np.eye(4)
    turn_deg = [4.0 * np.sin(time_s), 3.0 * time_s, 2.0]
    T_base_tool[:3, :3] = Rotation.from_euler("zyx", turn_deg, degrees=True).as_matrix()
    T_base_tool[:3, 3] = 6.0 * time_s, np.sin(2.0 * time_s), 3.0
    return T_base_tool


def seen(setup, T_tool_camera, late_s=0.0):
    """The root of the straight V, found where the seam meets the sheet at poses that the clock shifts."""
    plane, camera = np.asarray(setup.laser.plane_in_tool), replace(setup.camera, T_tool_camera=T_tool_camera)
    root_mm = np.asarray(setup.joint.seam_in_base_mm[0]) - [0.0, 0.0, setup.joint.dimensions["depth_mm"]]
    image, times = [], np.linspace(0.5, 2.5, N)
    for time_s in times:
        T_tool_base = np.linalg.inv(tool_at(time_s + late_s))
        along, start = T_tool_base[:3, 0], T_tool_base[:3, :3] @ root_mm + T_tool_base[:3, 3]
        point = start - along * (plane[:3] @ start + plane[3]) / (plane[:3] @ along)
        in_camera = np.linalg.inv(T_tool_camera) @ [*point, 1.0]
        image.append(camera.project(in_camera[None, :3])[0])
    return SeamObservations(np.array(image), times, np.full((N, 2), 1e-4), (tool_at,) * N)


HAND_EYE = {
    "rot_x_deg": -0.2,
    "rot_y_deg": 0.4,
    "rot_z_deg": 0.7,
    "move_x_mm": 0.9,
    "move_y_mm": -0.5,
    "move_z_mm": 0.3,
}


def test_a_wrong_camera_bends_the_seam_and_the_right_one_does_not():
    setup = example_setup()
    turn = Rotation.from_rotvec([HAND_EYE[f"rot_{axis}_deg"] for axis in "xyz"], degrees=True).as_matrix()
    wrong = np.eye(4)
    wrong[:3, :3], wrong[:3, 3] = turn, (0.9, -0.5, 0.3)
    sightings = seen(setup, setup.camera.T_tool_camera @ wrong)
    _, as_stated = sightings.in_joint(setup)
    assert np.abs(as_stated).max() > 0.3
    _, known = sightings.in_joint(replace(setup, effects={"hand_eye": HAND_EYE}))
    np.testing.assert_allclose(known, 0.0, atol=1e-6)


def test_a_late_clock_bends_the_seam_and_the_right_one_does_not():
    setup = example_setup()
    sightings = seen(setup, setup.camera.T_tool_camera, late_s=0.05)
    _, as_stated = sightings.in_joint(setup)
    assert np.abs(as_stated[:, 0]).max() > 0.05
    result = [
        np.abs(sightings.in_joint(replace(setup, effects={"pose_delay": {"delay_s": s}}))[1]).max()
        for s in (0.05, -0.05)
    ]
    assert min(result) < 1e-6 < 0.05 < max(result)


def test_stations_and_displacements_are_those_of_a_seam_beside_the_nominal_line():
    setup = example_setup()
    sightings = seen(setup, setup.camera.T_tool_camera)
    moved = tuple((x, y - 0.25, z + 0.5) for x, y, z in setup.joint.seam_in_base_mm)
    stations, beside = sightings.in_joint(replace(setup, joint=replace(setup.joint, seam_in_base_mm=moved)))
    np.testing.assert_allclose(beside, np.tile([0.25, -0.5], (N, 1)), atol=1e-6)
    assert (np.diff(stations) > 0.0).all()


def test_the_tracker_sees_the_seam_in_each_frame_with_the_laser_on(tmp_path):
    setup, frames, pose_at = recorded(tmp_path / "recording", {})
    poses = [lambda t: pose_at(t).T_base_tool] * len(frames)
    sightings = SeamObservations.of(setup, frames, poses)
    assert len(sightings.timestamps_s) == sum(frame.laser_on for frame in frames)
    _, displacements = sightings.in_joint(setup)
    assert np.sqrt(np.mean(displacements**2)) == pytest.approx(0.0, abs=0.1)


def test_time_counts_from_the_recordings_first_frame(tmp_path):
    """A controller's uptime, or the Unix epoch: drifts begin with the recording."""
    setup, frames, pose_at = recorded(tmp_path / "recording", {})
    late = [replace(frame, timestamp_s=frame.timestamp_s + 1e4) for frame in frames]
    observed, shifted = observe(setup, frames, pose_at), observe(setup, late, lambda t: pose_at(t - 1e4))
    for here, there in zip(observed.frames, shifted.frames, strict=True):
        assert there.timestamp_s == here.timestamp_s + 1e4
        assert there.condition.timestamp_s == pytest.approx(here.condition.timestamp_s, abs=1e-6)
    assert observed.frames[0].condition.timestamp_s == 0.0


def test_what_nobody_saw_is_empty():
    setup = example_setup()
    stations, displacements = SeamObservations.of(setup, [], []).in_joint(setup)
    assert stations.shape == (0,)
    assert displacements.shape == (0, 2)
