"""The camera of a live cell, a process of its own: it renders from where the robot was, and publishes."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass
from multiprocessing.connection import Connection

import numpy as np

from arctrack.errors import ArctrackError
from arctrack.live.cameras.camera_line import read_line, remove_line
from arctrack.live.cameras.shared_frames import SharedFramesError, SharedFramesWriter
from arctrack.simulation.cell.robot import Robot
from arctrack.simulation.cell.weld.closed_loop import LoopPlan, setup_of, world_of
from arctrack.simulation.cell.weld.rendered_camera import RenderedCamera
from robot_io import RobotStatus, Switch
from tracker.state import Frame


@dataclass(frozen=True)
class Shot:
    """State of the robot at a capture.

    `captured_s` is on the machine's monotonic clock, `station_mm` the arc length along the path, `weave_s`
    the time in its weave, `offset_mm` the offset (y, z) that it has reached.
    """

    captured_s: float
    station_mm: float
    weave_s: float
    offset_mm: tuple[float, float]
    status: RobotStatus

    @classmethod
    def of(cls, robot: Robot, captured_s: float) -> Shot:
        """Return a robot's at a time."""
        y_mm, z_mm = robot.offset_mm.tolist()
        return cls(captured_s, robot.station_mm, robot.weave_s, (y_mm, z_mm), robot.status)


def run_camera(plan: LoopPlan, name: str, shots: Connection) -> None:
    """Publish a frame for each shot that comes, the newest where several wait, until the other end is closed.

    The laser is on unless a tracker drives its line (`arctrack.live.cameras.camera_line`) and lets it be
    off; the exposure is the setup's unless it says another. Once the camera is ready, its kernels
    compiled, it says so over the same connection. ArctrackError if its frames cannot be published.
    """
    setup = setup_of(plan)
    camera = setup.camera
    robot = Robot(world_of(plan, setup))
    sensor = RenderedCamera(robot, setup, setup, np.random.default_rng([plan.seed, 1]))
    sensor.look(0.0)
    # Before there are frames: a tracker takes the line once it finds them.
    remove_line(name)
    try:
        with SharedFramesWriter(name, camera.height, camera.width, setup.sensor.dtype) as frames:
            shots.send(True)
            _publish(shots, sensor, frames, name)
    except SharedFramesError as error:
        raise ArctrackError(f"--frames {name}: {error}") from None
    finally:
        remove_line(name)


def _publish(shots: Connection, sensor: RenderedCamera, frames: SharedFramesWriter, name: str) -> None:
    """Publish until the other end is closed."""
    robot, index = sensor.robot, 0
    while True:
        try:
            shot = shots.recv()
            while shots.poll():
                shot = shots.recv()
        except (EOFError, ConnectionResetError):
            return
        robot.station_mm, robot.weave_s = shot.station_mm, shot.weave_s
        robot.offset_mm, robot.status = np.array(shot.offset_mm), shot.status
        wanted = read_line(name)
        sensor.is_laser_on, sensor.exposure_s = time.monotonic() < wanted.laser_until_s, wanted.exposure_s
        image_dn = sensor.look(0.0)
        assert image_dn is not None
        frames.publish(
            Frame(
                index=index,
                timestamp_s=shot.captured_s,
                image_dn=image_dn,
                exposure_s=sensor.setup.camera.exposure_s
                if math.isnan(sensor.exposure_s)
                else sensor.exposure_s,
                current_a=shot.status.current_a,
                laser_on=sensor.is_laser_on,
                arc_on=shot.status.arc is Switch.ON,
            )
        )
        index += 1
