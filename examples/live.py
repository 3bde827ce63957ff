"""Track frames and poses that are arrays of your own: `python examples/live.py`.

The arrays here are made up by the forward model. In a live run they come from your camera's and your robot's
software: replace `made_up` by what reads them, and `setup` by the setup of your sensor.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

import arctrack
from noise_model.condition import Condition
from noise_model.effects import pose_time_s
from noise_model.forward import draw_frame
from noise_model.surface.joint import SeamLine
from robot_io import PoseBuffer, PoseStatus

SEAM_LEFT_MM = 0.4
"""The made-up part lies this far to the left of the programmed path."""


@dataclass(frozen=True)
class Arrays:
    """What a camera and a robot give, on one clock.

    `images_dn` (n, height, width) are grey frames, uint8 or uint16; `frame_times_s` (n,) is mid-exposure.
    `positions_mm` (m, 3) and `quaternions_xyzw` (m, 4) are the tool's pose in base at `pose_times_s` (m,).
    """

    images_dn: npt.NDArray[np.uint8]
    frame_times_s: npt.NDArray[np.float64]
    positions_mm: npt.NDArray[np.float64]
    quaternions_xyzw: npt.NDArray[np.float64]
    pose_times_s: npt.NDArray[np.float64]


def made_up(setup: arctrack.Setup, n_frames: int = 20, speed_mm_s: float = 40.0) -> Arrays:
    """Return a straight run over a part that lies `SEAM_LEFT_MM` to the left, laser and arc on."""
    rng = np.random.default_rng(1)
    frame_times_s = 0.5 + 0.1 * np.arange(n_frames)
    pose_times_s = np.arange(0.0, frame_times_s[-1] + 0.1, 0.01)
    positions_mm = np.zeros((len(pose_times_s), 3))
    positions_mm[:, 0] = speed_mm_s * pose_times_s
    lit = Condition(laser_level=1.0, arc_level=1.0, exposure_s=setup.camera.exposure_s)
    images_dn = []
    for time_s in frame_times_s:
        T_base_tool = np.eye(4)
        T_base_tool[0, 3] = speed_mm_s * time_s
        images_dn.append(draw_frame(setup, T_base_tool, lit, rng, seam=SeamLine(y_mm=SEAM_LEFT_MM)))
    quaternions_xyzw = np.tile([0.0, 0.0, 0.0, 1.0], (len(pose_times_s), 1))
    return Arrays(np.array(images_dn), frame_times_s, positions_mm, quaternions_xyzw, pose_times_s)


def track(setup: arctrack.Setup, arrays: Arrays) -> list[arctrack.Track]:
    """Return a track a frame; a live loop does the same with each frame as it comes."""
    tracker = arctrack.Tracker(setup)
    # The first time on a machine this compiles, for a minute or several; afterwards no frame waits.
    tracker.warm_up()
    poses = PoseBuffer()
    tracks = []
    n_pushed = 0
    for index, (image_dn, time_s) in enumerate(zip(arrays.images_dn, arrays.frame_times_s, strict=True)):
        # A frame waits for the pose after it, so that its own can be interpolated.
        while n_pushed < len(arrays.pose_times_s) and arrays.pose_times_s[n_pushed] <= time_s + 0.01:
            poses.push_quaternion(
                arrays.pose_times_s[n_pushed],
                arrays.positions_mm[n_pushed],
                arrays.quaternions_xyzw[n_pushed],
            )
            n_pushed += 1
        at_frame = poses.at(pose_time_s(setup, time_s))
        pose = None
        if at_frame.status is not PoseStatus.REFUSED:
            pose = arctrack.Pose(at_frame.T_base_tool, at_frame.status is PoseStatus.EXTRAPOLATED)
        frame = arctrack.Frame(
            index, time_s, image_dn, exposure_s=setup.camera.exposure_s, current_a=setup.arc.current_a
        )
        tracks.append(tracker.step(frame, pose))
    return tracks


def main() -> None:
    """Print a line a frame: the seam point in the tool frame, the offset to send, and the flags."""
    # Your own: setup = arctrack.read_setup_file("my_sensor/recording.toml").setup
    setup = arctrack.read_setup_file("examples/v_groove/recording.toml").setup
    for result in track(setup, made_up(setup)):
        _, seam_y_mm, seam_z_mm = result.seam_tool_mm
        print(
            f"frame {result.frame:2d}  seam y {seam_y_mm:+.3f} mm, z {seam_z_mm:+.3f} mm  "
            f"offset y {result.offset_y_mm:+.3f} ± {result.offset_sigma_y_mm:.3f} mm  "
            f"{'valid' if result.valid else 'not valid'}  {' '.join(result.flag_names)}"
        )


if __name__ == "__main__":
    main()
